//! `snakectl report paper`: the paper's comparison, from nothing ([`crate::paper`]).

use std::path::PathBuf;

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use crate::cli::task_by_name;
use crate::methods::Method;
use crate::paper::work::{Progress, progress, work};
use crate::paper::{Comparison, Shard, protocol};

/// Arguments of `report paper`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Methods, separated by commas, in the order in which they are worked on [default: all eight, the cheap ones first]
    #[arg(long, value_name = "METHOD", value_delimiter = ',')]
    methods: Vec<Method>,
    /// Tasks, separated by commas [default: all five]
    #[arg(long, value_name = "TASK", value_delimiter = ',', value_parser = task_by_name)]
    tasks: Vec<Task>,
    /// Seeds, separated by commas [default: 1,2,3]
    #[arg(long, value_name = "SEED", value_delimiter = ',')]
    seeds: Vec<u64>,
    /// Environment steps of each run, of Block Pushing twice as many [default: the protocol's]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1_000_000_000))]
    steps: Option<u64>,
    /// Training runs side by side, each on its share of the cores [default: the cores]
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..=1000))]
    jobs: Option<u64>,
    /// Train nothing: say how far the runs are
    #[arg(long)]
    so_far: bool,
    /// Work on one part of the runs alone, such as 2/8
    #[arg(long, value_name = "I/N")]
    shard: Option<Shard>,
    /// Folder of the training runs
    #[arg(long, value_name = "DIR", default_value = "runs/paper")]
    runs: PathBuf,
    /// Change one setting of every run, such as mat.minibatches=4; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    fn or<T: Clone>(chosen: &[T], all: &[T]) -> Vec<T> {
        if chosen.is_empty() { all.to_vec() } else { chosen.to_vec() }
    }
    let comparison = Comparison {
        methods: or(&arguments.methods, &protocol::METHODS),
        tasks: or(&arguments.tasks, &Task::ALL),
        seeds: or(&arguments.seeds, &protocol::SEEDS),
        steps: arguments.steps,
        settings: arguments.settings.clone(),
    };
    let mut runs = comparison.runs()?;
    if let Some(shard) = arguments.shard {
        runs = shard.select(runs);
    }
    if !arguments.so_far && !work(&runs, &arguments.runs, arguments.jobs)? {
        bail!("stopped; the same command goes on from here");
    }
    let mut done = 0;
    for run in &runs {
        done += usize::from(progress(run, &arguments.runs)? == Progress::Trained);
    }
    println!("{done} of {} runs are trained", runs.len());
    Ok(())
}
