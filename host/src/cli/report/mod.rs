//! `snakectl report`: the published comparisons, from nothing. Killed, it goes on where it was; what is done is skipped.

mod faults;
mod imagination;
mod paper;
mod physics;
mod policies;
mod robustness;

use anyhow::Result;

/// Arguments of `report`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    #[command(subcommand)]
    which: Which,
}

/// What can be published.
#[derive(clap::Subcommand, Clone, Debug)]
enum Which {
    /// The paper's comparison: COMPOSER, its ablations and five baselines on all five tasks.
    Paper(paper::Arguments),
    /// The policies that ship: trained with several seeds, frozen, measured; the one of the median success over all rows goes to shared/policies.
    Policies(policies::Arguments),
    /// The physics alone: open-loop experiments over steps, tolerances and solvers, against a far finer reference.
    Physics(physics::Arguments),
    /// The policies that ship on other physics: a finer step, another solver, other friction, mass and stiffness.
    Robustness(robustness::Arguments),
    /// The policies that ship with every module broken, and every pair: success as a map.
    Faults(faults::Arguments),
    /// Variants of the imagination policy against none, on the tasks where the paper finds it ahead.
    Imagination(imagination::Arguments),
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    match &arguments.which {
        Which::Paper(arguments) => paper::run(arguments),
        Which::Policies(arguments) => policies::run(arguments),
        Which::Physics(arguments) => physics::run(arguments),
        Which::Robustness(arguments) => robustness::run(arguments),
        Which::Faults(arguments) => faults::run(arguments),
        Which::Imagination(arguments) => imagination::run(arguments),
    }
}
