//! The command line. Every verb is a thin layer over the library.

mod eval;
mod export;
mod policy_file;
mod train;

use std::process::ExitCode;

use clap::{Parser, Subcommand};

pub use policy_file::PolicySource;

/// Decentralised controllers for modular snake robots: train, evaluate, freeze, and prove them on a simulated CAN bus.
#[derive(Parser)]
#[command(name = "snakectl", version, about, max_term_width = 110)]
struct Arguments {
    #[command(subcommand)]
    verb: Option<Verb>,
}

#[derive(Subcommand)]
enum Verb {
    /// Train a policy from nothing.
    Train(train::Arguments),
    /// Evaluate a policy in the simulator, without a bus.
    Eval(eval::Arguments),
    /// Freeze a training run to an integer policy image.
    Export(export::Arguments),
}

/// Parses the command line, runs the verb, and reports an error as one sentence.
pub fn main() -> ExitCode {
    let arguments = Arguments::parse();
    let result = match arguments.verb {
        Some(Verb::Train(arguments)) => train::run(arguments),
        Some(Verb::Eval(arguments)) => eval::run(&arguments),
        Some(Verb::Export(arguments)) => export::run(&arguments),
        None => Ok(()),
    };
    match result {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("snakectl: {error:#}");
            ExitCode::FAILURE
        }
    }
}

/// Threads to use when nobody says otherwise: one a core.
fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}
