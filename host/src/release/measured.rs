//! What a policy can do: rows of success, each on the published episodes.

use std::sync::Arc;

use anyhow::{Context, Result};
use composer_shared::CRC_32;
use composer_shared::policy::{Policy, Task};
use composer_sim_bridge::faults::FaultPlan;
use serde::{Deserialize, Serialize};

use crate::env::EnvConfig;
use crate::eval::{PUBLISHED_SEED, Trial};
use crate::outcome::Report;
use crate::policy;
use crate::policy_source::PolicySource;
use crate::rows::Rows;
use crate::sim::PHYSICS;
use crate::vary::{self, Variation};

/// One row of measured success: the integer policy in the simulator (`snakectl eval --published`). It is easier there than in training:
/// [`crate::run::RunConfig::evaluation`].
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Measured {
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
pub enum On {
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
pub struct Row {
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
pub fn rows(task: Task, own: usize) -> Vec<Row> {
    let faults = ["none", "unplug:1", "unplug:2", "action:1", "action:2", "observation:1"];
    let longest = (task == Task::GoalReaching).then_some(32);
    let others = [On::Lab, On::Finer].map(|on| Row { modules: own, fault: "none", on });
    let nominal = |modules, fault| Row { modules, fault, on: On::Nominal };
    let lengths = [9, 10, 11, 12, 16].into_iter().chain(longest).map(|modules| nominal(modules, "none"));
    faults.map(|fault| nominal(own, fault)).into_iter().chain(others).chain(lengths).collect()
}

/// Measures one row on the published episodes.
pub fn measure(config: &EnvConfig, image: &[u8], row: Row, episodes: u64, threads: usize) -> Result<Measured> {
    let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let plan: FaultPlan = row.fault.parse().with_context(|| format!("the fault {}", row.fault))?;
    let mut config = EnvConfig { robot: config.robot.with_modules(row.modules)?, ..config.clone() };
    match row.on {
        On::Nominal => {}
        On::Lab => config.vary = Variation::from_toml(vary::LAB).map_err(anyhow::Error::msg)?,
        On::Finer => config = config.finer(4),
    }
    let measured = published_episodes(config, &policy, &plan, (episodes, threads));
    // As the row has it: a plan may be written in several ways.
    Ok(Measured { fault: row.fault.into(), on: row.on.words().into(), ..measured })
}

/// The first `episodes` published episodes of any policy, with faults as planned.
pub fn published_episodes(
    config: EnvConfig,
    policy: &dyn policy::Policy,
    plan: &FaultPlan,
    (episodes, threads): (u64, usize),
) -> Measured {
    let draw = |seed, modules| plan.draw(seed, modules);
    let config = Arc::new(config);
    let trial = Trial { config: &config, episodes: episodes as usize, seed: PUBLISHED_SEED, faults: &draw, threads };
    trial.evaluate(policy, &plan.to_string(), &|| {}).into()
}

/// What an evaluation depends on besides the policy: physics, robot, task, delay, sensors.
pub fn world(env: &crate::env::EnvConfig) -> u32 {
    let text = format!(
        "{PHYSICS} {} {:08x} {:?} {:?} {:?}",
        env.robot.fingerprint(),
        env.task.digest(),
        env.delay,
        env.relax_seconds,
        env.sensors
    );
    CRC_32.checksum(text.as_bytes())
}

/// The first `episodes` published episodes of a policy that ships, unless they are there already; `words` say what is special about them.
pub fn measured(
    rows: &Rows,
    source: &PolicySource,
    config: &EnvConfig,
    words: &dyn std::fmt::Display,
    plan: &FaultPlan,
    (episodes, threads): (u64, usize),
) -> Result<Measured> {
    let image = source.image().context("what ships is an image")?;
    let crc = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?.crc();
    let key = format!("{} {crc:08x} {words} episodes={episodes} world={:08x}", config.task.task(), world(config));
    rows.get(&key, || Ok(published_episodes(config.clone(), &*source.policy()?, plan, (episodes, threads))))
}
