//! `snakectl report paper`: the paper's comparison, from nothing ([`crate::paper`]).

use std::path::PathBuf;

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use crate::cli::task_by_name;
use crate::methods::Method;
use crate::paper::gather::gather;
use crate::paper::publish::publish;
use crate::paper::tune::{FILE, Tuned};
use crate::paper::work::{tune, work};
use crate::paper::{Comparison, protocol};
use crate::run_folder::wall_seconds;
use crate::shard::Shard;

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
    /// Train and measure nothing: publish what the runs that are done come to
    #[arg(long)]
    so_far: bool,
    /// Work on one part alone, such as 2/8, in the folder --out, and publish nothing; the parts may be anywhere, and begun again as often as needed
    #[arg(long, value_name = "I/N", conflicts_with_all = ["so_far", "runs", "merge"], requires = "out")]
    shard: Option<Shard>,
    /// Train and measure nothing: publish what the parts in these folders come to together
    #[arg(long, value_name = "DIR", num_args = 1.., conflicts_with = "runs")]
    merge: Vec<PathBuf>,
    /// Episodes of each point, the first of the published ones
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    episodes: u64,
    /// Folder of the training runs [default: runs/paper]
    #[arg(long, value_name = "DIR")]
    runs: Option<PathBuf>,
    /// Folder for tables, figures, data and page; of a part: for its runs [default: host/results/paper]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Tune first: so many trials of every method on every task, each of half the steps; what is best goes to tuned.json in the folder of the runs
    #[arg(long, value_name = "TRIALS", conflicts_with_all = ["shard", "merge", "tuned", "so_far"], value_parser = clap::value_parser!(u64).range(1..=1000))]
    tune: Option<u64>,
    /// Every run once more with the settings of this file, which --tune has written
    #[arg(long, value_name = "FILE")]
    tuned: Option<PathBuf>,
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
        tuned: arguments.tuned.as_deref().map(Tuned::load).transpose()?,
    };
    let out = arguments.out.clone().unwrap_or_else(|| "host/results/paper".into());
    let episodes = arguments.episodes;
    if arguments.shard.is_some() {
        return match work(&comparison, arguments.shard, &out, episodes, arguments.jobs)? {
            true => Ok(()),
            false => bail!("stopped; the same command goes on from here"),
        };
    }
    let runs = arguments.runs.clone().unwrap_or_else(|| "runs/paper".into());
    if let Some(trials) = arguments.tune {
        let Some(tuned) = tune(&comparison, trials, &runs, arguments.jobs)? else {
            bail!("stopped; the same command goes on from here");
        };
        println!("{}", serde_json::to_string_pretty(&tuned.settings)?);
        println!("written to {}; --tuned trains with it", runs.join(FILE).display());
        return Ok(());
    }
    if !arguments.so_far && arguments.merge.is_empty() && !work(&comparison, None, &runs, episodes, arguments.jobs)? {
        bail!("stopped; the same command goes on from here");
    }
    let outs = if arguments.merge.is_empty() { vec![runs] } else { arguments.merge.clone() };
    let tables = publish(&gather(&comparison, &outs, episodes, arguments.so_far)?, &out)?;
    let runs = comparison.runs()?;
    let trained = runs.iter().flat_map(|run| outs.iter().map(|out| wall_seconds(&run.folder(out)))).sum::<f64>();
    println!("{tables}\n{:.1} hours of training, each run on its share of the cores", trained / 3600.0);
    println!("written to {}", out.display());
    Ok(())
}
