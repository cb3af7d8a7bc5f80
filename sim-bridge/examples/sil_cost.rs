//! What a simulated control cycle costs without any physics: `cargo run --release -p composer-sim-bridge --example sil_cost`.
//!
//! Prints CPU time per control cycle (50 ms of the robot's time) for controllers, bus and station together, the policy's share of it
//! (one encoding and one action a module, measured apart), and how many times faster than real time that is.

use std::time::Instant;

use composer_firmware::controller::BusKind;
use composer_shared::observation::{SIZE, Sensors};
use composer_shared::policy::{IMAGE_SIZE, Latent, Memory, Policy, random_image};
use composer_shared::robot::MAX_MODULES;
use composer_sim_bridge::Plant;
use composer_sim_bridge::sil::{SilConfig, run};

const CYCLES: usize = 500;

/// A robot that does not move.
struct Still {
    modules: usize,
    steps: usize,
}

impl Plant for Still {
    fn modules(&self) -> usize {
        self.modules
    }

    fn step_ns(&self) -> u64 {
        10_000_000
    }

    fn sensors(&self, module: usize) -> Sensors {
        Sensors { joint_angles: [0.01 * module as f32; 4], up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO }
    }

    fn point(&self, _: u8) -> Option<[f32; 3]> {
        Some([5.0, 3.0, 0.0])
    }

    fn set_torque(&mut self, _module: usize, _torque: [f32; 2]) {}

    fn step(&mut self) {
        self.steps += 1;
    }

    fn done(&self) -> bool {
        self.steps >= 5 * CYCLES
    }
}

/// CPU time of this thread in seconds where Linux tells it, so that other load on the machine does not count; else time of day.
fn cpu_seconds(start: Instant) -> f64 {
    let stat = std::fs::read_to_string("/proc/thread-self/schedstat").ok();
    let ns = stat.and_then(|stat| stat.split_ascii_whitespace().next()?.parse::<f64>().ok());
    ns.map_or(start.elapsed().as_secs_f64(), |ns| ns / 1e9)
}

/// Time of one encoding and one action over `modules` latents, in microseconds.
fn policy_us(image: &[u8], modules: usize) -> f64 {
    let Ok(policy) = Policy::parse(image) else { return f64::NAN };
    let heard = u64::MAX >> (MAX_MODULES - modules);
    let latents = [Latent::ZERO; MAX_MODULES];
    let (clock, rounds) = (Instant::now(), 20_000);
    let start = cpu_seconds(clock);
    let (mut sum, mut memory) = (0.0, Memory::EMPTY);
    for round in 0..rounds {
        let encoded = policy.encode(&mut memory, &[round as f32 * 1e-3; SIZE]);
        sum += policy.act(&encoded, &latents, heard, None, 0)[0];
    }
    std::hint::black_box(sum);
    (cpu_seconds(clock) - start) * 1e6 / f64::from(rounds)
}

fn main() {
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    println!("bus      modules  us/cycle  of it policy  realtime factor  bus load  missed deadlines");
    for bus in [BusKind::Fd, BusKind::Classic] {
        for modules in [8, 16, 32, 64] {
            let mut plant = Still { modules, steps: 0 };
            let clock = Instant::now();
            let start = cpu_seconds(clock);
            let report = match run(&mut plant, &image, &SilConfig::new(bus), None, &mut |_, _| {}) {
                Ok(report) => report,
                Err(error) => return eprintln!("{error}"),
            };
            let us = (cpu_seconds(clock) - start) * 1e6 / CYCLES as f64;
            let policy = policy_us(&image, modules) * modules as f64;
            let name = if bus == BusKind::Fd { "fd" } else { "classic" };
            let (load, missed) = (100.0 * report.bus_load, report.deadline_misses);
            println!("{name:8} {modules:7}  {us:8.1}  {policy:12.1}  {:15.0}  {load:7.1}%  {missed}", 50_000.0 / us);
        }
    }
}
