//! The command line. Every verb is a thin layer over the library.

mod bench;
mod bus;
mod campaign;
mod common;
mod dbc;
mod demo;
mod eval;
mod export;
mod flash;
mod key;
mod mjcf;
mod physics;
mod replay;
mod report;
mod sign;
mod sil;
mod test;
mod train;
mod update;

use std::process::ExitCode;

use clap::{Parser, Subcommand};
use composer_shared::policy::Task;

use crate::side_by_side::cores;

/// Decentralised controllers for modular snake robots: train, evaluate, freeze, and prove them on a simulated CAN bus.
#[derive(Parser)]
#[command(name = "snakectl", version, about, max_term_width = 110, args_conflicts_with_subcommands = true)]
struct Arguments {
    #[command(subcommand)]
    verb: Option<Verb>,
    /// Without a verb: the demonstration
    #[command(flatten)]
    demonstration: demo::Arguments,
}

#[derive(Subcommand)]
#[allow(clippy::large_enum_variant)] // There is one, once.
enum Verb {
    /// Train a policy from nothing.
    Train(train::Arguments),
    /// Evaluate a policy in the simulator, without a bus.
    Eval(eval::Arguments),
    /// Freeze a training run to an integer policy image.
    Export(export::Arguments),
    /// Run complete controllers with a frozen policy on a simulated CAN bus.
    Sil(sil::Arguments),
    /// Run one module of a capture again, and say whether it does the same, torque by torque and frame by frame.
    Replay(replay::Arguments),
    /// Run scenarios on the simulated bus: faults, and what is expected of the robot, as data.
    Test(test::Arguments),
    /// Search for a schedule of faults that breaks a rule, and shrink it.
    Campaign(campaign::Arguments),
    /// Make a published comparison from nothing: figure, table, data.
    Report(report::Arguments),
    /// Measure the speed of physics, training and bus on this machine.
    Bench(bench::Arguments),
    /// Show the shipped policy of one task on the simulated bus.
    Demo(demo::OneTask),
    /// Make a module of a board: image, policy and node page by a debug probe.
    Flash(flash::Arguments),
    /// Make a key, or show one: only policies that are signed with it are then taken by modules that have it.
    Key(key::Arguments),
    /// Sign a policy.
    Sign(sign::Arguments),
    /// Bring a policy to all modules of a robot over its bus.
    Update(update::Arguments),
    /// Watch and command a robot on its bus, a real one or a simulated one in real time.
    Bus(bus::Arguments),
    /// Print the bus's message database in DBC form.
    Dbc(dbc::Arguments),
    /// Print robot and scene as a model for MuJoCo.
    Mjcf(mjcf::Arguments),
}

/// Where `cargo qemu-image` and `cargo qemu-bench` put an image: in the same target folder as this program, which lies in
/// `target/release` or, a test, below.
fn built_image(name: &str) -> Option<std::path::PathBuf> {
    let program = std::env::current_exe().ok()?;
    let release = program.parent()?;
    let target = if release.ends_with("deps") { release.parent()?.parent()? } else { release.parent()? };
    Some(target.join("thumbv7em-none-eabihf/firmware").join(name))
}

/// Parses the command line, runs the verb, and reports an error as one sentence.
pub fn main() -> ExitCode {
    // `snakectl ... | head` ends quietly when its reader does; without this the next print would panic.
    #[cfg(unix)]
    let _ = signal_hook::flag::register_conditional_shutdown(
        signal_hook::consts::SIGPIPE,
        141,
        std::sync::Arc::new(std::sync::atomic::AtomicBool::new(true)),
    );
    let arguments = Arguments::parse();
    let result = match arguments.verb {
        Some(Verb::Train(arguments)) => train::run(arguments),
        Some(Verb::Eval(arguments)) => eval::run(&arguments),
        Some(Verb::Export(arguments)) => export::run(&arguments),
        Some(Verb::Sil(arguments)) => sil::run(&arguments),
        Some(Verb::Replay(arguments)) => replay::run(&arguments),
        Some(Verb::Test(arguments)) => test::run(&arguments),
        Some(Verb::Campaign(arguments)) => campaign::run(&arguments),
        Some(Verb::Report(arguments)) => report::run(&arguments),
        Some(Verb::Bench(arguments)) => bench::run(&arguments),
        Some(Verb::Flash(arguments)) => flash::run(&arguments),
        Some(Verb::Key(arguments)) => key::run(&arguments),
        Some(Verb::Sign(arguments)) => sign::run(&arguments),
        Some(Verb::Update(arguments)) => update::run(&arguments),
        Some(Verb::Bus(arguments)) => bus::run(&arguments),
        Some(Verb::Dbc(arguments)) => dbc::run(&arguments),
        Some(Verb::Mjcf(arguments)) => mjcf::run(&arguments),
        Some(Verb::Demo(arguments)) => demo::run_one(&arguments),
        None => demo::run(&arguments.demonstration),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("snakectl: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Becomes true when somebody wants this program to end: Ctrl-C, SIGTERM, a terminal that closes. A second Ctrl-C ends it at once.
fn interrupted() -> std::io::Result<std::sync::Arc<std::sync::atomic::AtomicBool>> {
    use std::sync::{Arc, atomic::AtomicBool};
    let flag = Arc::new(AtomicBool::new(false));
    #[cfg(unix)]
    use signal_hook::consts::SIGHUP;
    for signal in [
        signal_hook::consts::SIGINT,
        signal_hook::consts::SIGTERM,
        #[cfg(unix)]
        SIGHUP,
    ] {
        signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&flag))?;
        signal_hook::flag::register(signal, Arc::clone(&flag))?;
    }
    Ok(flag)
}

/// A task by its name, for the command line.
fn task_by_name(name: &str) -> Result<Task, String> {
    let names = Task::ALL.map(Task::name);
    Task::from_name(name).ok_or_else(|| format!("there is no such task; the tasks are {}", names.join(", ")))
}
