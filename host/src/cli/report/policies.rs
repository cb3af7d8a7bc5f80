//! `snakectl report policies`: every policy that ships, from nothing ([`crate::release`]).

use std::path::PathBuf;

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use crate::cli::task_by_name;
use crate::eval::PUBLISHED_EPISODES;
use crate::release::{Release, measure_again, release};

/// Arguments of `report policies`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Tasks, separated by commas [default: all five]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Seeds, from 1 on
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u64).range(1..=100))]
    seeds: u64,
    /// Training runs side by side, each on its share of the cores [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
    /// Train nothing: freeze, measure and ship what the runs have come to
    #[arg(long)]
    only_freeze: bool,
    /// Neither train nor freeze: measure again what was published, from the images; for physics that have changed
    #[arg(long, conflicts_with_all = ["only_freeze", "settings"])]
    again: bool,
    /// Change one setting of every run, such as total_steps=4096; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Episodes of each row, the first of the published ones
    #[arg(long, default_value_t = PUBLISHED_EPISODES, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Folder of the settings, TASK.toml
    #[arg(long, value_name = "DIR", default_value = "host/configs")]
    configs: PathBuf,
    /// Folder of the training runs
    #[arg(long, value_name = "DIR", default_value = "runs/policies")]
    runs: PathBuf,
    /// Folder that the policies ship from
    #[arg(long, value_name = "DIR", default_value = "shared/policies")]
    ship: PathBuf,
    /// Folder for the tables and the data
    #[arg(long, value_name = "DIR", default_value = "host/results/policies")]
    out: PathBuf,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let arguments = arguments.clone();
    let tasks = if arguments.tasks.is_empty() { Task::ALL.to_vec() } else { arguments.tasks };
    let out = arguments.out.display().to_string();
    let wanted = Release {
        tasks,
        seeds: arguments.seeds,
        jobs: arguments.jobs,
        only_freeze: arguments.only_freeze,
        settings: arguments.settings,
        episodes: arguments.episodes,
        configs: arguments.configs,
        runs: arguments.runs,
        ship: arguments.ship,
        out: arguments.out,
    };
    let tables = if arguments.again { Some(measure_again(&wanted)?) } else { release(&wanted)? };
    let Some(tables) = tables else { bail!("stopped; the same command goes on from here") };
    print!("{tables}");
    println!("\nwritten to {out}");
    Ok(())
}
