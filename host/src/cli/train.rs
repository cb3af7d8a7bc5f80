//! `snakectl train`: from nothing to a policy.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_shared::policy::Task;
use crc::{CRC_32_ISO_HDLC, Crc};

use super::policy_file::{CONFIG_FILE, NETWORK_FILE, load_config};
use super::task_by_name;
use crate::env::SnakeEnv;
use crate::eval::{Trial, curve_seed, healthy};
use crate::files::{create_folder, write_whole};
use crate::methods::{Method, TrainedPolicy};
use crate::outcome::Report;
use crate::robot::Robot;
use crate::run::RunConfig;
use crate::train::{TrainSummary, train};

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
    let summary = train_in(&config, &out, resuming, None)?;
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

/// Starts a run in the folder `out`, or goes on with the one that is there. Judges the policy every so often, healthy and (if it trains with
/// faults) faulty, and keeps the policy of the last judgement. `name`: as in [`train()`].
pub fn train_in(config: &RunConfig, out: &Path, resuming: bool, name: Option<&str>) -> Result<TrainSummary> {
    create_folder(out)?;
    if !resuming {
        if out.join(CONFIG_FILE).exists() {
            bail!("{} already holds a run: go on with --resume {0}, or choose another --out", out.display());
        }
        write_whole(&out.join(CONFIG_FILE), toml::to_string(config)?.as_bytes())?;
    }
    let evaluation = Arc::new(config.evaluation());
    let faulty = |seed, modules| config.faults.draw(seed, modules);
    let mut evaluate = |policy: &TrainedPolicy, _steps: u64| {
        let trial = Trial {
            config: &evaluation,
            episodes: config.train.evaluation_episodes.max(1) as usize,
            seed: curve_seed(config.train.seed),
            faults: &healthy,
            threads: config.train.threads(),
        };
        let runs = policy.policy();
        let report = trial.evaluate(&*runs, "none", &|| {});
        let mut scalars = scalars(&report, "evaluation");
        if config.faults.probability > 0.0 {
            let report = Trial { faults: &faulty, ..trial }.evaluate(&*runs, "as trained", &|| {});
            scalars.extend(self::scalars(&report, "evaluation_faults"));
        }
        // A run that is killed keeps the policy of its last evaluation; a failure to write shows at the checkpoint.
        let _ = save_policy(out, policy);
        scalars
    };
    let make = |index: usize| -> Result<Box<dyn crate::environment::Environment>> {
        Ok(Box::new(SnakeEnv::new(config.environment(index)?)))
    };
    let summary = train(&config.train, &make, &fingerprint(config), out, resuming, name, &mut evaluate)?;
    save_policy(out, &summary.policy)?;
    Ok(summary)
}

/// What goes into the metrics from an evaluation.
fn scalars(report: &Report, prefix: &str) -> Vec<(String, f64)> {
    [
        ("success_rate", report.success_rate),
        ("distance_mean", report.distance_mean),
        ("steps_mean", report.steps_mean),
        ("low_share", report.low_share),
        ("peak_link_speed", report.peak_link_speed),
    ]
    .into_iter()
    .map(|(name, value)| (format!("{prefix}/{name}"), value))
    .collect()
}

fn save_policy(out: &Path, policy: &TrainedPolicy) -> Result<()> {
    let text = serde_json::to_vec(policy).context("the policy cannot be written as JSON")?;
    write_whole(&out.join(NETWORK_FILE), &text)
}

/// What a checkpoint must agree with to be resumed: everything but the learner's own settings, which it checks itself.
fn fingerprint(config: &RunConfig) -> String {
    let world = RunConfig { train: Default::default(), ..config.clone() };
    let digest = Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(toml::to_string(&world).unwrap_or_default().as_bytes());
    format!(
        "{} on {} with {} modules, settings {digest:08x}",
        config.task.name, config.robot.name, config.robot.modules
    )
}
