//! What several verbs share: which policy on which episodes, the table of a report, and the page of a replay.

use std::path::{Path, PathBuf};

use anyhow::{Context, Result};
use composer_shared::policy::Task;
use composer_sim_bridge::faults::{FaultPlan, ScheduledFault};
use indicatif::{ProgressBar, ProgressStyle};

use super::physics::Physics;
use super::task_by_name;
use crate::env::EnvConfig;
use crate::eval::{DEFAULT_SEED, PUBLISHED_EPISODES, PUBLISHED_SEED};
use crate::outcome::Report;
use crate::policy_source::PolicySource;
use crate::robot::Robot;
use crate::stats::with_interval;

/// Episodes in a replay.
pub const REPLAYED: usize = 4;

/// What to evaluate and how; `sil` takes the same.
#[derive(clap::Args, Clone, Debug)]
pub struct Common {
    /// A policy image, a run folder, the name of a shipped policy, or a baseline: still, random
    pub policy: String,
    /// What is to be done, for a baseline [default: goal-reaching]; a policy does what it was trained for
    #[arg(long, value_parser = task_by_name)]
    pub task: Option<Task>,
    /// Episodes to run
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=1_000_000))]
    pub episodes: u64,
    /// Modules of the snake, 1 to 64 [default: the robot's]
    #[arg(long)]
    pub modules: Option<usize>,
    /// Robot file [default: the paper's 8 x 4 links]
    #[arg(long, value_name = "FILE")]
    pub robot: Option<PathBuf>,
    /// Faults: action:K, observation:K, unplug:K, cut and more; several separated by commas
    #[arg(long, default_value = "none")]
    pub fault: FaultPlan,
    /// Seed of the episodes; training never draws the same ones
    #[arg(long, default_value_t = DEFAULT_SEED)]
    pub seed: u64,
    /// The episodes behind the published figures, instead of --seed and --episodes
    #[arg(long, conflicts_with_all = ["seed", "episodes"])]
    pub published: bool,
    #[command(flatten)]
    pub physics: Physics,
    /// Print one JSON object and nothing else
    #[arg(long)]
    pub json: bool,
    /// Threads [default: one a core]; the result does not depend on it
    #[arg(long)]
    pub threads: Option<usize>,
}

impl Common {
    /// The robot asked for.
    pub fn robot(&self) -> Result<Option<Robot>> {
        let file = self.robot.as_deref().map(Robot::load).transpose()?;
        match self.modules {
            None => Ok(file),
            Some(modules) => Ok(Some(file.unwrap_or_default().with_modules(modules)?)),
        }
    }

    /// How many episodes.
    pub fn episodes(&self) -> u64 {
        if self.published { PUBLISHED_EPISODES } else { self.episodes }
    }

    /// Their seed.
    pub fn seed(&self) -> u64 {
        if self.published { PUBLISHED_SEED } else { self.seed }
    }

    /// The environment of a policy with everything that was asked for.
    pub fn environment(&self, source: &PolicySource) -> Result<EnvConfig> {
        self.physics.apply(source.environment(self.task, self.robot()?.as_ref())?)
    }

    /// Faults of an episode.
    pub fn draw(&self) -> impl Fn(u64, usize) -> Vec<ScheduledFault> + Sync {
        |seed, modules| self.fault.draw(seed, modules)
    }

    /// A progress bar over the episodes, hidden when nobody looks.
    pub fn bar(&self) -> ProgressBar {
        if self.json { ProgressBar::hidden() } else { episode_bar(&self.policy, self.episodes()) }
    }
}

/// A progress bar over some episodes.
pub fn episode_bar(policy: &str, episodes: u64) -> ProgressBar {
    let bar = ProgressBar::new(episodes);
    if let Ok(style) = ProgressStyle::with_template("{msg} [{bar:40}] {pos}/{len} episodes, {eta} left") {
        bar.set_style(style);
    }
    bar.set_message(policy.to_string());
    bar
}

/// The report for people: the paper's three columns, success (with its 95 % interval) by bearing, and the motion.
pub fn table(report: &Report) -> String {
    let mut text = format!(
        "{} episodes, {} modules, fault {}{}\n  success   {}\n  distance  {:.2} +- {:.2} units\n  steps     {:.1} +- {:.1}, at most {}\n  ",
        report.episodes,
        report.modules,
        report.fault,
        if report.physics.is_empty() { String::new() } else { format!(", {}", report.physics) },
        with_interval(report.success_rate, report.success_low, report.success_high, 3),
        report.distance_mean,
        report.distance_se,
        report.steps_mean,
        report.steps_se,
        report.cap
    );
    let bearings: Vec<_> = report
        .by_bearing
        .iter()
        .filter(|b| b.episodes > 0)
        .map(|b| {
            let success = with_interval(b.success_rate, b.success_low, b.success_high, 2);
            format!("{:?} {success} of {}", b.bearing, b.episodes).to_lowercase()
        })
        .collect();
    text += &bearings.join("  ");
    text += &format!(
        "\n  peak link speed {:.1} units/s, peak height {:.2} units, peak joint speed {:.2} rad/s, below two link diameters in {:.1} % of steps\n",
        report.peak_link_speed,
        report.peak_height,
        report.peak_joint_speed,
        100.0 * report.low_share
    );
    let effort = report.effort;
    // Of another engine nothing is known.
    if effort.steps > 0 {
        text += &format!(
            "  physics   {} steps of {:.1} sweeps, {} with the loads of friction held, {} not converged\n",
            effort.steps,
            effort.sweeps as f64 / effort.steps as f64,
            effort.held,
            effort.capped
        );
    }
    text
}

/// Writes recorded episodes as one page.
pub fn write_replay(
    config: &EnvConfig,
    title: &str,
    episodes: Vec<crate::replay::Episode>,
    policy: &str,
    path: &Path,
) -> Result<()> {
    let mut recording = crate::recorder::recording(config, title, policy);
    for episode in episodes {
        recording.push(episode);
    }
    recording.write_html(path).with_context(|| format!("no replay in {}", path.display()))
}
