//! `snakectl report faults`: what each broken module costs, and each pair of them ([`crate::fault_map`]).

use std::path::PathBuf;

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use crate::cli::task_by_name;
use crate::fault_map::{FaultMaps, Specialists};

/// Arguments of `report faults`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Tasks, separated by commas [default: all five]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Episodes of each module by itself, the first of the published ones
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Episodes of each pair of modules
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pair_episodes: u64,
    /// Train a specialist for each fault of one module that is not mastered, and compare with it
    #[arg(long)]
    specialists: bool,
    /// Success from which on a fault is mastered
    #[arg(long, value_name = "SHARE", default_value_t = 0.9)]
    mastered: f64,
    /// Environment steps of a specialist
    #[arg(long, default_value_t = 500_000)]
    specialist_steps: u64,
    /// Folder of the settings, TASK.toml, from which a specialist takes the learner's
    #[arg(long, value_name = "DIR", default_value = "host/configs")]
    configs: PathBuf,
    /// Folder of the runs of `report policies`: each specialist begins with the one that ships of its task [default: from nothing]
    #[arg(long, value_name = "DIR")]
    start: Option<PathBuf>,
    /// Change one setting of every specialist, such as learning_rate=3e-4; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
    /// Specialists side by side, each on its share of the cores [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
    /// Threads [default: one a core]
    #[arg(long)]
    threads: Option<usize>,
    /// Folder of the cells that are done
    #[arg(long, value_name = "DIR", default_value = "runs/faults")]
    runs: PathBuf,
    /// Folder for figures, table and data
    #[arg(long, value_name = "DIR", default_value = "host/results/faults")]
    out: PathBuf,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let arguments = arguments.clone();
    let out = arguments.out.display().to_string();
    let specialists = arguments.specialists.then_some(Specialists {
        mastered: arguments.mastered,
        steps: arguments.specialist_steps,
        configs: arguments.configs,
        start: arguments.start,
        settings: arguments.settings,
        jobs: arguments.jobs,
    });
    let maps = FaultMaps {
        tasks: if arguments.tasks.is_empty() { Task::ALL.to_vec() } else { arguments.tasks },
        episodes: arguments.episodes,
        pair_episodes: arguments.pair_episodes,
        specialists,
        threads: arguments.threads.unwrap_or_else(crate::cli::cores),
        runs: arguments.runs,
        out: arguments.out,
    };
    let Some(table) = maps.publish()? else { bail!("stopped; the same command goes on from here") };
    print!("{table}");
    println!("\nwritten to {out}");
    Ok(())
}
