//! `snakectl bench`: speed of physics, training and bus on this machine, side by side in one run.

mod firmware;

use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result};
use composer_shared::policy::Task;
use composer_sim_bridge::plant::Bench;
use composer_sim_bridge::sil::{self, SilConfig};

use crate::env::{EnvConfig, SnakeEnv};
use crate::environment::{Environment, Told, Trivial, View};
use crate::eval::{DEFAULT_SEED, episode_seed, parallel};
use crate::methods::{Differentiation, Method, Times, TrainConfig, mix};
use crate::mjcf::mjcf;
use crate::policy::{Memories, Policy, Random};
use crate::policy_source::PolicySource;
use crate::robot::{Robot, Solver};
use crate::run::RunConfig;
use crate::sil::SnakePlant;
use crate::sim::open_loop::Experiment;
use crate::sim::{Scene, Snake};
use crate::train::Trainer;

/// Lengths at which cost is measured.
const LENGTHS: [usize; 4] = [8, 16, 32, 64];

/// Arguments of `bench`.
#[derive(clap::Args, Clone, Debug)]
#[command(args_conflicts_with_subcommands = true)]
pub struct Arguments {
    #[command(subcommand)]
    what: Option<What>,
    /// Seconds for each figure
    #[arg(long, default_value_t = 5.0)]
    seconds: f64,
    /// A Python with MuJoCo: runs it on its own MJCF of the robot, with its own contacts, beside the solvers here
    #[arg(long, value_name = "PYTHON")]
    mujoco: Option<PathBuf>,
}

#[derive(clap::Subcommand, Clone, Debug)]
enum What {
    /// Count the instructions of the controller on an emulated Cortex-M4F instead (needs qemu-system-arm).
    Firmware(firmware::Arguments),
    /// Measure the controllers on the bus alone, with physics and without.
    Bus {
        /// Seconds for each figure
        #[arg(long, default_value_t = 5.0)]
        seconds: f64,
    },
    /// Measure learning alone, with environments that cost nothing.
    Learning {
        /// Seconds for each figure
        #[arg(long, default_value_t = 5.0)]
        seconds: f64,
    },
}

/// Control steps per second over all threads.
fn physics(task: Task, robot: &Robot, threads: usize, seconds: f64) -> f64 {
    let config = Arc::new(EnvConfig::new(task, robot.clone()));
    let rates = parallel(threads, threads, |thread| {
        let mut env = SnakeEnv::new(config.clone());
        let (mut view, mut actions) = (View::default(), Vec::new());
        let (start, mut steps, mut seed) = (Instant::now(), 0u64, thread as u64);
        while start.elapsed().as_secs_f64() < seconds {
            env.view(&mut view);
            Random.act(&view, seed ^ steps, &mut Memories::default(), &mut actions, None);
            let outcome = env.step(&actions);
            steps += 1;
            if outcome.terminated || outcome.truncated {
                seed += threads as u64;
                env.reset(seed);
            }
        }
        steps as f64 / start.elapsed().as_secs_f64()
    });
    rates.iter().sum()
}

/// Control steps per second of each task on one thread. They take turns, so that other load on the machine slows all of them alike.
fn scenes(robot: &Robot, seconds: f64) -> Vec<(Task, f64)> {
    const TURNS: usize = 10;
    let mut rates: Vec<(Task, f64)> = Task::ALL.map(|task| (task, 0.0)).into();
    for _ in 0..TURNS {
        for (task, rate) in &mut rates {
            *rate += physics(*task, robot, 1, seconds / TURNS as f64) / TURNS as f64;
        }
    }
    rates
}

/// Time spent in training iterations after the first, which warms up.
fn training(config: &RunConfig, seconds: f64) -> Result<Times> {
    let make =
        |index: usize| -> Result<Box<dyn Environment>> { Ok(Box::new(SnakeEnv::new(config.environment(index)?))) };
    let mut trainer = Trainer::new(&config.train, &make, "benchmark")?;
    trainer.iterate()?;
    let (start, mut times) = (Instant::now(), Times::default());
    while start.elapsed().as_secs_f64() < seconds || times.steps == 0 {
        times.add(&trainer.iterate()?.times);
    }
    Ok(times)
}

/// One way to learn, and what its iterations took.
struct Learning {
    name: String,
    threads: usize,
    trainer: Trainer,
    /// Milliseconds for inference and for the update of 2,048 environment steps.
    milliseconds: Vec<[f64; 2]>,
}

/// What is measured of learning: COMPOSER's two ways to the gradient, and baselines, in shorter iterations with minibatches of the size that
/// they have.
fn ways() -> Vec<(String, TrainConfig)> {
    let composer = [Differentiation::Manual, Differentiation::Automatic].map(|gradient| {
        let name = format!("composer, {}", format!("{gradient:?}").to_lowercase());
        (name, TrainConfig { gradient, ..TrainConfig::default() })
    });
    let baselines = [Method::Ppo, Method::Mappo, Method::Mat, Method::MatDec, Method::Smp].map(|method| {
        let mut config = TrainConfig { method, ..TrainConfig::default() };
        (config.ppo.environments, config.ppo.minibatches) = (8, 8);
        (config.mat.environments, config.mat.minibatches) = (8, 8);
        (config.mat_dec.environments, config.mat_dec.minibatches) = (8, 8);
        (config.smp.rollout_steps, config.smp.random_steps) = (4, 0);
        (method.name().to_owned(), config)
    });
    composer.into_iter().chain(baselines).collect()
}

/// Learning with environments that cost nothing, each way on one thread and on all. They take turns, so that other load on the machine slows
/// all of them alike.
fn learning(modules: usize, cores: usize, seconds: f64) -> Result<Vec<Learning>> {
    let make = |_: usize| -> Result<Box<dyn Environment>> { Ok(Box::new(Trivial::new(modules, Told::Head))) };
    let mut learning = Vec::new();
    for (name, config) in ways() {
        for threads in if cores > 1 { vec![1, cores] } else { vec![1] } {
            let config = TrainConfig { threads, ..config.clone() };
            let mut trainer = Trainer::new(&config, &make, "benchmark")?;
            trainer.iterate()?;
            learning.push(Learning { name: name.clone(), threads, trainer, milliseconds: Vec::new() });
        }
    }
    let start = Instant::now();
    while start.elapsed().as_secs_f64() < seconds * learning.len() as f64 || learning[0].milliseconds.len() < 3 {
        for way in &mut learning {
            let times = way.trainer.iterate()?.times;
            let of = |part: Duration| 1e3 * part.as_secs_f64() * 2048.0 / times.steps as f64;
            way.milliseconds.push([of(times.wall.saturating_sub(times.update)), of(times.update)]);
        }
    }
    Ok(learning)
}

/// The table of learning.
fn learnings(modules: usize, cores: usize, seconds: f64) -> Result<()> {
    println!("\nlearning alone, {modules} modules, ms for 2,048 environment steps: median (least)");
    println!("{:>20} {:>8} {:>16} {:>16}", "method", "threads", "inference", "update");
    for mut way in learning(modules, cores, seconds)? {
        let [inference, update] = [0, 1].map(|part| {
            way.milliseconds.sort_by(|a, b| a[part].total_cmp(&b[part]));
            format!("{:.0} ({:.0})", way.milliseconds[way.milliseconds.len() / 2][part], way.milliseconds[0][part])
        });
        println!("{:>20} {:>8} {inference:>16} {update:>16}", way.name, way.threads);
    }
    Ok(())
}

/// How fast complete controllers run on the bus.
#[derive(Clone, Copy, Debug)]
struct BusSpeed {
    /// Virtual time by wall time of one thread, whole episodes with physics.
    with_physics: f64,
    /// The same on a bench, where nothing moves.
    alone: f64,
    /// Share of the time in which the bus was busy.
    load: f64,
}

fn bus(image: &[u8], robot: &Robot, seconds: f64) -> Result<BusSpeed> {
    let config = Arc::new(EnvConfig::new(Task::GoalReaching, robot.clone()));
    let sil = SilConfig::new(composer_firmware::controller::BusKind::Fd);
    let (start, mut virtual_ns, mut load, mut episodes) = (Instant::now(), 0u64, 0.0, 0u64);
    while start.elapsed().as_secs_f64() < seconds {
        let mut plant = SnakePlant::new(config.clone(), episode_seed(DEFAULT_SEED, episodes));
        let report = sil::run(&mut plant, image, &sil, None, &mut |_, _| {})?;
        virtual_ns += report.duration_ns;
        load += report.bus_load;
        episodes += 1;
    }
    let with_physics = virtual_ns as f64 * 1e-9 / start.elapsed().as_secs_f64();
    let (start, mut virtual_ns) = (Instant::now(), 0u64);
    while start.elapsed().as_secs_f64() < seconds {
        let mut bench = Bench { modules: robot.modules, steps: 2000 };
        virtual_ns += sil::run(&mut bench, image, &sil, None, &mut |_, _| {})?.duration_ns;
    }
    let alone = virtual_ns as f64 * 1e-9 / start.elapsed().as_secs_f64();
    Ok(BusSpeed { with_physics, alone, load: load / episodes.max(1) as f64 })
}

/// The table of the bus.
fn buses(robot: &Robot, seconds: f64) -> Result<()> {
    let source = PolicySource::load("goal-reaching")?;
    let Some(image) = source.image() else { return Ok(()) };
    println!("\ncontrollers on the CAN-FD bus (1M/5M), times real time, one thread");
    println!("{:>8} {:>13} {:>16} {:>10}", "modules", "with physics", "without physics", "bus load");
    for modules in LENGTHS {
        let speed = bus(image, &robot.with_modules(modules)?, seconds)?;
        println!("{modules:>8} {:>13.1} {:>16.1} {:>8.1} %", speed.with_physics, speed.alone, 100.0 * speed.load);
    }
    Ok(())
}

/// Sweeps of the direct solver in a step, and wall time of one with its share of the rest of the step, us; random torques.
fn sweeps(robot: &Robot, seconds: f64) -> [f64; 2] {
    let (mut snake, start) = (Snake::new(robot), Instant::now());
    let mut number = 0u64;
    while start.elapsed().as_secs_f64() < seconds {
        for module in 0..robot.modules {
            let torque = [0, 1].map(|_| {
                number += 1;
                robot.torque_limit * ((mix(number) >> 40) as f32 / (1u64 << 23) as f32 - 1.0)
            });
            snake.set_torque(module, torque);
        }
        (0..snake.steps_in(0.05)).for_each(|_| snake.step());
    }
    let effort = snake.effort();
    let (steps, sweeps) = (effort.steps.max(1) as f64, effort.sweeps.max(1) as f64);
    [sweeps / steps, 1e6 * start.elapsed().as_secs_f64() / sweeps]
}

/// The open-loop gait on one thread with each solver, and with MuJoCo's: speed, and where the head comes to.
fn gaits(robot: &Robot, mujoco: Option<&Path>) -> Result<()> {
    println!("\nthe open-loop gait of 10 s, one thread, side by side");
    println!("{:>28} {:>16} {:>8} {:>14}", "", "physics steps/s", "step, s", "head x, units");
    let row =
        |name: &str, rate: f64, step: f64, head: f64| println!("{name:>28} {rate:>16.0} {step:>8.3} {head:>14.2}");
    for solver in [Solver::Direct, Solver::Rapier] {
        let robot = Robot { solver, ..robot.clone() };
        let start = Instant::now();
        let outcome = Experiment::Gait.run(&robot);
        let rate = f64::from(Experiment::Gait.seconds() / robot.physics_step) / start.elapsed().as_secs_f64();
        row(solver.name(), rate, f64::from(robot.physics_step), f64::from(outcome.links[0][0]));
    }
    let Some(python) = mujoco else { return Ok(()) };
    let model = tempfile::Builder::new().suffix(".xml").tempfile()?;
    std::fs::write(model.path(), mjcf(robot, &Scene::default(), Default::default()))?;
    let output = std::process::Command::new(python)
        .args([
            "sim-bridge/examples/mujoco_plant.py",
            "--gait",
            "--own-contacts",
            "--internal-step",
            "1/100",
            "--model",
        ])
        .arg(model.path())
        .output()
        .with_context(|| format!("cannot start {}", python.display()))?;
    let told: serde_json::Value = serde_json::from_slice(&output.stdout).with_context(|| {
        format!("{} did not run the gait: {}", python.display(), String::from_utf8_lossy(&output.stderr).trim())
    })?;
    let number = |key: &str| told[key].as_f64().with_context(|| format!("the gait of MuJoCo has no {key}"));
    row("MuJoCo, its own contacts", number("physics_steps_per_s")?, 0.01, number("head_x")?);
    Ok(())
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    match &arguments.what {
        Some(What::Firmware(arguments)) => return firmware::run(arguments),
        Some(What::Bus { seconds }) => return buses(&Robot::default(), *seconds),
        Some(What::Learning { seconds }) => return learnings(Robot::default().modules, super::cores(), *seconds),
        None => {}
    }
    let seconds = arguments.seconds;
    let cores = super::cores();
    let robot = Robot::default();
    let substeps = EnvConfig::new(Task::GoalReaching, robot.clone()).substeps();
    println!("physics alone, control steps/s (0.05 s, {substeps} physics steps each), random torques");
    println!(
        "{:>8} {:>12} {:>12} {:>16} {:>12}",
        "modules", "one thread", "all threads", "sweeps a step", "us a sweep"
    );
    let goal = Task::GoalReaching;
    for modules in LENGTHS {
        let robot = robot.with_modules(modules)?;
        let (one, all) = (physics(goal, &robot, 1, seconds), physics(goal, &robot, cores, seconds));
        let [sweeps, microseconds] = sweeps(&robot, seconds);
        println!("{modules:>8} {one:>12.0} {all:>12.0} {sweeps:>16.1} {microseconds:>12.1}");
    }
    gaits(&robot, arguments.mujoco.as_deref())?;
    println!("\nthe same with each task's scene, {} modules, one thread, side by side", robot.modules);
    println!("{:>16} {:>16} {:>14}", "task", "control steps/s", "of the first");
    let rates = scenes(&robot, seconds);
    for (task, rate) in &rates {
        println!("{:>16} {rate:>16.0} {:>14.2}", task.name(), rate / rates[0].1);
    }
    println!("\ntraining, {} modules, {cores} threads", robot.modules);
    println!("{:>24} {:>20} {:>9} {:>10} {:>7}", "method", "environment steps/s", "physics", "inference", "update");
    for method in [Method::Composer, Method::ComposerNoImagination] {
        let train = TrainConfig { method, ..TrainConfig::default() };
        let times = training(&RunConfig { train, ..RunConfig::default() }, 3.0 * seconds)?;
        let [physics, inference, update] = times.shares().map(|share| 100.0 * share);
        println!(
            "{:>24} {:>20.0} {physics:>7.0} % {inference:>8.0} % {update:>5.0} %",
            method.name(),
            times.steps_per_second()
        );
    }
    learnings(robot.modules, cores, seconds)?;
    buses(&robot, seconds)
}
