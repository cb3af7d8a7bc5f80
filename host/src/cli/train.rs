//! `snakectl train`: from nothing to a policy.

use std::path::{Path, PathBuf};

use anyhow::{Result, bail};
use composer_shared::policy::Task;

use super::task_by_name;
use crate::methods::{Method, ranks};
use crate::robot::Robot;
use crate::run::RunConfig;
use crate::run_folder::{CONFIG_FILE, load_config, train_in};
use crate::train::Beside;

/// Arguments of `train`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// What to learn: goal-reaching, block-pushing, shape-formation, tube-crossing or wall-climbing [default: the settings file's, else
    /// goal-reaching]
    #[arg(value_parser = task_by_name)]
    task: Option<Task>,
    /// composer (self-attention and imagination policy), its ablations composer-no-imagination, composer-no-attention and
    /// composer-neither, or a baseline: ppo, mappo, mat, mat_dec or smp
    /// [default: the settings file's, else composer]
    #[arg(long)]
    method: Option<Method>,
    /// Seed of the run: same seed, same policy, bit for bit [default: 1]
    #[arg(long)]
    seed: Option<u64>,
    /// Environment steps in all
    #[arg(long)]
    steps: Option<u64>,
    /// Robot file [default: the paper's 8 x 4 links]
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// Settings file, in the form of the config.toml of any run folder; what it leaves out keeps its default
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Folder for checkpoint, metrics and TensorBoard files [default: runs/TASK-METHOD-SEED]
    #[arg(long, value_name = "DIR")]
    out: Option<PathBuf>,
    /// Go on with the run in this folder as if it had never stopped
    #[arg(long, value_name = "DIR", conflicts_with_all = ["out", "config", "method", "seed"])]
    resume: Option<PathBuf>,
    /// Share the work with the other processes that `composer-ranks` has started (host/mpi): it starts every rank so
    #[arg(long)]
    ranks: bool,
    /// Change one setting, such as learning_rate=3e-4 or faults.probability=0.5; may be repeated
    #[arg(long = "set", value_name = "KEY=VALUE")]
    settings: Vec<String>,
}

/// Runs the verb.
pub fn run(arguments: Arguments) -> Result<()> {
    let resuming = arguments.resume.is_some();
    let mut config = match (&arguments.resume, &arguments.config) {
        (Some(folder), _) => load_config(&folder.join(CONFIG_FILE))?,
        (None, Some(file)) => load_config(file)?,
        (None, None) => RunConfig::default(),
    };
    if let Some(task) = arguments.task {
        let asked_for = arguments.resume.is_some() || arguments.config.is_some();
        if asked_for && config.task.name != task {
            bail!(
                "the settings are for {}, not for {task}: leave the task out, or choose other settings",
                config.task.name
            );
        }
        config.task.name = task;
    }
    if let Some(file) = &arguments.robot {
        config.robot = Robot::load(file)?;
    }
    if let Some(method) = arguments.method {
        config.train.method = method;
    }
    if let Some(seed) = arguments.seed {
        config.train.seed = seed;
    }
    if let Some(steps) = arguments.steps {
        config.train.total_steps = steps;
    }
    for setting in &arguments.settings {
        config.set(setting)?;
    }
    config.validate()?;
    let name = format!("{}-{}-{}", config.task.name, config.train.method, config.train.seed);
    let out = arguments.resume.or(arguments.out).unwrap_or_else(|| Path::new("runs").join(name));
    let ranks = arguments.ranks.then(ranks::on_standard_input).transpose()?;
    let Some(summary) = train_in(&config, &out, resuming, &Beside { name: None, ranks })? else { return Ok(()) };
    println!(
        "{} after {} steps, {:.0} s since the start or the last resumption: {}",
        if summary.interrupted { "stopped" } else { "done" },
        summary.steps,
        summary.wall.as_secs_f64(),
        out.display()
    );
    for (name, value) in summary.evaluation.iter().filter(|_| !summary.interrupted) {
        println!("  {name} {value:.3}");
    }
    Ok(())
}
