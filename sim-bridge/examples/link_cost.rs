//! What a poll of an emulated module costs in wall time, with QEMU's buffer before the UART and without.
//!
//!     cargo qemu-image
//!     cargo run --release -p composer-sim-bridge --example link_cost [IMAGE]

use std::path::Path;
use std::time::Instant;

use composer_firmware::controller::{Boot, BusKind, Config};
use composer_shared::observation::Sensors;
use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
use composer_shared::wire::{Frame, Function};
use composer_sim_bridge::computer::{Computer, Launcher, Poll};
use composer_sim_bridge::qemu::{PATIENCE, Qemu};

fn main() -> Result<(), Box<dyn std::error::Error>> {
    let built = "target/thumbv7em-none-eabihf/firmware/composer-qemu".to_string();
    let firmware = std::env::args().nth(1).unwrap_or(built);
    let mut image = [0; IMAGE_SIZE];
    random_image(1, &mut image);
    let policy = Policy::parse(&image)?;
    println!("wall time of a poll, us, one module alone and eight at once, mean of 500 each");
    println!("{:<28} {:>8} {:>8}", "", "alone", "eight");
    for (name, buffered) in [("buffered", true), ("unbuffered", false)] {
        let qemu = Qemu::new(Path::new(&firmware), &image, PATIENCE)?;
        let qemu = if buffered { qemu } else { qemu.unbuffered() };
        // Of a module that this robot does not have: thrown away after it was parsed, so that the link is what costs.
        let latent = Frame::new(Function::Latent.id(60), true, &[0x55; 64]);
        for (what, frame) in [("time alone", None), ("a latent", latent)] {
            let mut micros = Vec::new();
            for modules in [1, 8] {
                let start = |_| qemu.start(Config::new(1, 8, BusKind::Fd, &policy), Boot::default(), 0);
                let mut computers: Vec<_> = (0..modules).map(start).collect::<Result<_, _>>()?;
                let mut begin = Instant::now();
                for round in 0..501 {
                    if round == 1 {
                        // They have booted.
                        begin = Instant::now();
                    }
                    let now = 100_000 + round;
                    let sensors = &Sensors::ZERO;
                    let poll = Poll { now, sensors, frame: frame.as_ref(), bus: Default::default(), room: 16 };
                    computers.iter_mut().try_for_each(|computer| computer.ask_poll(&poll))?;
                    computers.iter_mut().try_for_each(|computer| computer.answer().map(drop))?;
                }
                micros.push(begin.elapsed().as_secs_f64() * 1e6 / 500.0 / modules as f64);
            }
            println!("{:<28} {:>8.0} {:>8.0}", format!("{name}, {what}"), micros[0], micros[1]);
        }
    }
    Ok(())
}
