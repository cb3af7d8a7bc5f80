//! What is measured of a policy that is trained: its rows of the tables, one episode to look at, and where its modules attend.
//!
//! Everything is measured where the run is, and kept beside it, so that a merge only reads.

use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result};
use composer_shared::policy::{Policy as Image, Task};
use composer_sim_bridge::faults::FaultPlan;
use serde::{Deserialize, Serialize};

use crate::bus_trial::{BusSettings, BusTrial, Written};
use crate::env::{EnvConfig, SnakeEnv};
use crate::eval::{DEFAULT_SEED, PUBLISHED_SEED, Trial, episode_seed, healthy, run_episode};
use crate::outcome::Report;
use crate::policy::Policy;
use crate::recorder::{recording, simulate};
use crate::rows::Rows;

/// Faults of the paper's Table II, and its words for them.
pub const FAULTS: [(&str, &str); 4] = [
    ("none", "0 faults"),
    ("action:1", "1 dead actuator"),
    ("action:2", "2 dead actuators"),
    ("observation:1", "1 blind module"),
];
/// Lengths of the paper's Table III.
pub const LENGTHS: [usize; 4] = [8, 9, 10, 11];
/// The task of both tables.
pub const TABLED: Task = Task::GoalReaching;
/// Tasks of the paper's attention figure.
pub const ATTENDED: [Task; 3] = [Task::GoalReaching, Task::WallClimbing, Task::TubeCrossing];
/// Share of the frames that the bus loses.
pub const LOST: f64 = 0.01;
/// Attention matrices in a figure, evenly over the episode.
const MAPS: usize = 5;
/// Episodes that are tried for a successful one.
const TRIED: u64 = 100;

/// What is measured: a fault, a length, in the simulator or on the bus that loses frames.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Point {
    /// The fault.
    pub fault: &'static str,
    /// Modules of the snake.
    pub modules: usize,
    /// As an integer controller in every module, on the bus.
    pub bus: bool,
}

impl Point {
    /// Everything that is measured of a policy of a task.
    pub fn all(task: Task) -> Vec<Point> {
        let mut points = vec![Point { fault: "none", modules: 8, bus: false }];
        if task == TABLED {
            points.extend(FAULTS[1..].iter().map(|(fault, _)| Point { fault, modules: 8, bus: false }));
            points.extend(LENGTHS[1..].iter().map(|&modules| Point { fault: "none", modules, bus: false }));
        }
        let on_bus: Vec<_> = points.iter().map(|point| Point { bus: true, ..*point }).collect();
        points.into_iter().chain(on_bus).collect()
    }
}

impl std::fmt::Display for Point {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "{}{} modules={}", if self.bus { "bus " } else { "" }, self.fault, self.modules)
    }
}

/// What came of the episodes of a point.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Cell {
    /// Episodes.
    pub episodes: usize,
    /// Share of successes.
    pub success_rate: f64,
    /// Lower end of its 95 % interval (Wilson).
    pub success_low: f64,
    /// Upper end.
    pub success_high: f64,
    /// Mean distance at the end, units.
    pub distance: f64,
    /// Mean number of control steps.
    pub steps: f64,
}

impl From<Report> for Cell {
    fn from(report: Report) -> Self {
        Cell {
            episodes: report.episodes,
            success_rate: report.success_rate,
            success_low: report.success_low,
            success_high: report.success_high,
            distance: report.distance_mean,
            steps: report.steps_mean,
        }
    }
}

/// Where the modules attended in an episode.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Attended {
    /// Times since its start, s.
    pub times: Vec<f32>,
    /// Modules of the snake.
    pub modules: usize,
    /// A matrix for each time, row-major, 0 to 1; row: the attending module.
    pub matrices: Vec<Vec<f32>>,
}

/// A policy to measure, and where its results are kept.
pub struct Measured<'a> {
    /// Its results.
    pub rows: &'a Rows,
    /// What the results depend on, besides the point: digest of the policy.
    pub digest: &'a str,
    /// Environment of its task, healthy.
    pub env: &'a EnvConfig,
    /// Episodes of a point, the first of the published ones.
    pub episodes: u64,
}

impl Measured<'_> {
    fn key(&self, words: &str) -> String {
        format!("{words} episodes={} policy={}", self.episodes, self.digest)
    }

    /// A point of the tables, if it has been measured.
    pub fn found(&self, point: Point) -> Option<Cell> {
        self.rows.find(&self.key(&point.to_string()))
    }

    /// Measures a point; on the bus with this image.
    pub fn cell(&self, point: Point, policy: &dyn Policy, image: Option<&[u8]>, threads: usize) -> Result<Cell> {
        self.rows.get(&self.key(&point.to_string()), || {
            let plan: FaultPlan = point.fault.parse().with_context(|| format!("the fault {}", point.fault))?;
            let config = EnvConfig { robot: self.env.robot.with_modules(point.modules)?, ..self.env.clone() };
            let (config, episodes) = (Arc::new(config), self.episodes as usize);
            if !point.bus {
                let draw = |seed, modules| plan.draw(seed, modules);
                let trial = Trial { config: &config, episodes, seed: PUBLISHED_SEED, faults: &draw, threads };
                return Ok(trial.evaluate(policy, point.fault, &|| {}).into());
            }
            let trial = BusTrial {
                config,
                image: image.context("what goes onto the bus is an image")?,
                episodes,
                seed: PUBLISHED_SEED,
                fault: &plan,
                bus: BusSettings { drop: Some(LOST), ..BusSettings::default() },
                physics: String::new(),
                threads,
                record: 0,
                qemu: None,
                parity: false,
                elsewhere: None,
            };
            Ok(trial.run(&Written::default(), &|| {})?.0.task.into())
        })
    }

    /// An episode for the replay page, as [`crate::replay::Recording::encoded`] has it, if it is there.
    pub fn found_replay(&self) -> Option<String> {
        self.rows.find(&format!("replay policy={}", self.digest))
    }

    /// The first of the episodes that people get who do not choose one, for the replay page.
    pub fn replay(&self, name: &str, policy: &dyn Policy) -> Result<String> {
        self.rows.get(&format!("replay policy={}", self.digest), || {
            let mut recording = recording(self.env, name, name);
            let mut env = SnakeEnv::new(Arc::new(self.env.clone()));
            recording.push(simulate(self.env, &mut env, policy, name, episode_seed(DEFAULT_SEED, 0), &[]));
            Ok(recording.encoded()?.remove(0))
        })
    }

    /// Where the modules attended, if that is there: none in it if no episode succeeded.
    pub fn found_attention(&self) -> Option<Option<Attended>> {
        self.rows.find(&format!("attention policy={}", self.digest))
    }

    /// Where the modules attend in the first successful of some episodes; none if none of them succeeds.
    pub fn attention(&self, policy: &dyn Policy) -> Result<Option<Attended>> {
        self.rows.get(&format!("attention policy={}", self.digest), || {
            let mut env = SnakeEnv::new(Arc::new(self.env.clone()));
            let seeds = (0..TRIED).map(|index| episode_seed(DEFAULT_SEED, index));
            let successful = |seed: &u64| run_episode(&mut env, policy, *seed, &healthy(*seed, 0), |_, _| {}).success;
            let Some(seed) = { seeds }.find(successful) else { return Ok(None) };
            let episode = simulate(self.env, &mut env, policy, "attention", seed, &[]);
            let frames: Vec<_> = episode.frames().iter().filter(|frame| frame.attention.is_some()).collect();
            let (mut times, mut matrices) = (Vec::new(), Vec::new());
            for k in (0..MAPS).filter(|_| !frames.is_empty()) {
                let frame = frames[k * (frames.len() - 1) / (MAPS - 1)];
                times.push(frame.time);
                let bytes = frame.attention.iter().flatten();
                matrices.push(bytes.map(|byte| f32::from(*byte) / 255.0).collect());
            }
            Ok(Some(Attended { times, modules: self.env.robot.modules, matrices }))
        })
    }
}

/// Measures some points of a policy and what there is to look at, as far as that is not done; `image`: what goes onto the bus, made when it is needed, or why there is none.
pub fn measure(
    measured: &Measured,
    name: &str,
    policy: &dyn Policy,
    points: Vec<Point>,
    attends: bool,
    image: impl FnOnce() -> Result<Result<Vec<u8>, String>>,
    threads: usize,
) -> Result<()> {
    let (on_bus, in_simulator): (Vec<_>, Vec<_>) = points.into_iter().partition(|point| point.bus);
    for point in in_simulator {
        measured.cell(point, policy, None, threads)?;
    }
    measured.replay(name, policy)?;
    if attends {
        measured.attention(policy)?;
    }
    if on_bus.iter().all(|point| measured.found(*point).is_some()) {
        return Ok(());
    }
    if let Ok(image) = image()? {
        Image::parse(&image).map_err(|e| anyhow::anyhow!("{name}: {e}"))?;
        for point in on_bus {
            measured.cell(point, policy, Some(&image), threads)?;
        }
    }
    Ok(())
}

/// The results that are kept in a folder.
pub fn kept(folder: &Path) -> Result<Rows> {
    Rows::open(&folder.join("measured.json"))
}
