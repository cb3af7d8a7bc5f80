//! `snakectl export`: from a training run to a policy image, its manifest, and the metrics of its run. `report policies` does the same with several runs.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use composer_shared::policy::{Policy, Task};
use composer_sim_bridge::faults::FaultPlan;
use serde::{Deserialize, Serialize};

use crate::env::EnvConfig;
use crate::eval::{PUBLISHED_EPISODES, PUBLISHED_SEED, Trial};
use crate::files::write_whole;
use crate::freeze::Parity;
use crate::outcome::Report;
use crate::run::RunConfig;
use crate::run_folder::{CALIBRATION_EPISODES, freeze_run, metrics_with_pretraining, wall_seconds};
use crate::stats::with_interval;
use crate::vary::{self, Variation};

/// Arguments of `export`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Folder of the training run
    run: PathBuf,
    /// Policy image to write
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Episodes that scales are taken from, and as many others that parity is measured on
    #[arg(long, default_value_t = CALIBRATION_EPISODES, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    episodes: u64,
    /// Episodes for each figure of the manifest, the first of the published ones (`snakectl eval --published`)
    #[arg(long, default_value_t = PUBLISHED_EPISODES, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    measured_episodes: u64,
}

/// What is written beside an image: where it comes from and what it can do.
#[derive(Serialize)]
pub(super) struct Manifest {
    task: &'static str,
    image_bytes: usize,
    /// Digest of the task's settings, as the image has it.
    task_digest: String,
    crc32: String,
    /// Version control's name of the state that trained or at least froze it; "unknown" outside a repository.
    commit: String,
    trained_with_faults: bool,
    /// Wall time of the run, since it was started or last resumed, on the machine that trained it, s.
    wall_seconds: f64,
    parity: Parity,
    measured: Vec<Measured>,
    /// The same of all seeds that it was chosen from, if it was: that of the median success.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    seeds: Vec<SeedRows>,
    run: RunConfig,
}

/// What a policy of one of several seeds can do.
#[derive(Clone, Serialize)]
pub(super) struct SeedRows {
    /// Seed of the run.
    pub seed: u64,
    /// Its rows.
    pub measured: Vec<Measured>,
}

/// One row of measured success: the integer policy in the simulator (`snakectl eval --published`). It is easier there than in training:
/// [`RunConfig::evaluation`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Measured {
    /// The faults injected.
    pub fault: String,
    /// Modules of the snake.
    pub modules: usize,
    /// What robot and physics are, if they are not those of the training.
    #[serde(default, skip_serializing_if = "String::is_empty")]
    pub on: String,
    /// Episodes.
    pub episodes: usize,
    /// Share of successes.
    pub success_rate: f64,
    /// Lower end of its 95 % interval (Wilson).
    pub success_low: f64,
    /// Upper end.
    pub success_high: f64,
    /// Mean number of control steps.
    pub steps_mean: f64,
    /// Control steps before an episode is cut.
    pub cap: u32,
}

impl From<Report> for Measured {
    fn from(report: Report) -> Self {
        Measured {
            fault: report.fault,
            modules: report.modules,
            on: String::new(),
            episodes: report.episodes,
            success_rate: report.success_rate,
            success_low: report.success_low,
            success_high: report.success_high,
            steps_mean: report.steps_mean,
            cap: report.cap,
        }
    }
}

/// On what a row is measured.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum On {
    /// The robot as it should be.
    Nominal,
    /// Another robot and floor in every episode ([`vary::LAB`]).
    Lab,
    /// The physics step divided by four.
    Finer,
}

impl On {
    /// In tables and data; nothing for the robot as it should be.
    fn words(self) -> &'static str {
        match self {
            On::Nominal => "",
            On::Lab => vary::LAB_NAME,
            On::Finer => "physics step / 4",
        }
    }
}

/// A row of what is measured of a policy.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Row {
    /// Modules of the snake.
    pub modules: usize,
    /// Faults.
    pub fault: &'static str,
    /// Robot and physics.
    pub on: On,
}

impl std::fmt::Display for Row {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{} modules={}", self.fault, self.modules)?;
        match self.on {
            On::Nominal => Ok(()),
            on => write!(f, " on={}", on.words()),
        }
    }
}

/// The rows that are measured of a policy that was trained on `own` modules: faults, other robots, finer physics, then lengths; the longest
/// of them only where a task is the same for any length.
pub(super) fn rows(task: Task, own: usize) -> Vec<Row> {
    let faults = ["none", "unplug:1", "unplug:2", "action:1", "action:2", "observation:1"];
    let longest = (task == Task::GoalReaching).then_some(32);
    let others = [On::Lab, On::Finer].map(|on| Row { modules: own, fault: "none", on });
    let nominal = |modules, fault| Row { modules, fault, on: On::Nominal };
    let lengths = [9, 10, 11, 12, 16].into_iter().chain(longest).map(|modules| nominal(modules, "none"));
    faults.map(|fault| nominal(own, fault)).into_iter().chain(others).chain(lengths).collect()
}

/// Measures one row on the published episodes.
pub(super) fn measure(config: &EnvConfig, image: &[u8], row: Row, episodes: u64, threads: usize) -> Result<Measured> {
    let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let plan: FaultPlan = row.fault.parse().with_context(|| format!("the fault {}", row.fault))?;
    let draw = |seed, modules| plan.draw(seed, modules);
    let mut config = EnvConfig { robot: config.robot.with_modules(row.modules)?, ..config.clone() };
    match row.on {
        On::Nominal => {}
        On::Lab => config.vary = Variation::from_toml(vary::LAB).map_err(anyhow::Error::msg)?,
        On::Finer => config = config.finer(4),
    }
    let config = Arc::new(config);
    let trial = Trial { config: &config, episodes: episodes as usize, seed: PUBLISHED_SEED, faults: &draw, threads };
    let report = trial.evaluate(&policy, row.fault, &|| {});
    Ok(Measured { on: row.on.words().into(), ..report.into() })
}

/// A frozen policy with what is known of it.
pub(super) struct Exported<'a> {
    /// The settings of its run.
    pub config: RunConfig,
    /// Folder of the run.
    pub run: &'a Path,
    /// The image.
    pub image: &'a [u8],
    /// Floats against integers.
    pub parity: Parity,
    /// Its rows.
    pub measured: Vec<Measured>,
    /// Those of all seeds that it was chosen from.
    pub seeds: Vec<SeedRows>,
}

impl Exported<'_> {
    /// Writes image, manifest and metrics side by side.
    pub fn write(self, out: &Path, metrics: &[u8]) -> Result<()> {
        let policy = Policy::parse(self.image).map_err(|e| anyhow::anyhow!("{e}"))?;
        let manifest = Manifest {
            task: policy.task().name(),
            image_bytes: self.image.len(),
            task_digest: format!("{:08x}", policy.task_digest()),
            crc32: format!("{:08x}", policy.crc()),
            commit: commit(),
            trained_with_faults: policy.trained_with_faults(),
            wall_seconds: wall_seconds(self.run),
            parity: self.parity,
            measured: self.measured,
            seeds: self.seeds,
            run: self.config,
        };
        write_whole(out, self.image)?;
        write_whole(&out.with_extension("toml"), toml::to_string(&manifest)?.as_bytes())?;
        write_whole(&out.with_extension("metrics.jsonl"), metrics)
    }
}

fn commit() -> String {
    let output =
        std::process::Command::new("git").args(["rev-parse", "HEAD"]).stderr(std::process::Stdio::null()).output();
    match output {
        Ok(output) if output.status.success() => String::from_utf8_lossy(&output.stdout).trim().to_string(),
        _ => "unknown".into(),
    }
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let threads = super::cores();
    let (config, image, parity) = freeze_run(&arguments.run, arguments.episodes, threads)?;
    let env = config.evaluation();
    let measured = rows(config.task.name, config.robot.modules)
        .into_iter()
        .map(|row| measure(&env, &image, row, arguments.measured_episodes, threads))
        .collect::<Result<Vec<_>>>()?;
    let metrics = metrics_with_pretraining(&arguments.run)?;
    for m in &measured {
        println!(
            "{:>2} modules, {:<14} {:<16} success {}, {:.1} steps of at most {}",
            m.modules,
            m.fault,
            m.on,
            with_interval(m.success_rate, m.success_low, m.success_high, 3),
            m.steps_mean,
            m.cap
        );
    }
    let exported = Exported { config, run: &arguments.run, image: &image, parity, measured, seeds: Vec::new() };
    exported.write(&arguments.out, metrics.as_bytes())?;
    let policy = Policy::parse(&image).map_err(|e| anyhow::anyhow!("{e}"))?;
    println!(
        "{}: {} bytes, CRC-32 {:08x}\nfloat against integer actions on {} held-out samples: rms {:.5}, 99 % within {:.5}, max {:.5} of the torque limit",
        arguments.out.display(),
        image.len(),
        policy.crc(),
        parity.samples,
        parity.rms,
        parity.p99,
        parity.max
    );
    Ok(())
}
