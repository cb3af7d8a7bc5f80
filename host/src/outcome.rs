//! What came of episodes: of one, and of a set of them.

use serde::Serialize;

use crate::env::EnvConfig;
use crate::sim::{Effort, Motion, Snake};
use crate::stats::wilson;
use crate::tasks::Judge;
use crate::tasks::goal_reaching::Bearing;

/// What came of one episode.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Episode {
    /// The goal was reached.
    pub success: bool,
    /// Distance at the end, units.
    pub distance: f32,
    /// Control steps taken.
    pub steps: u32,
    /// Where the goal lay.
    pub bearing: Bearing,
    /// Extremes of the motion.
    pub motion: Motion,
    /// Steps whose highest link stayed below two link diameters.
    pub low_steps: u32,
    /// What the direct solver did.
    pub effort: Effort,
}

impl Episode {
    /// What came of an episode that is over.
    pub fn new(judge: &Judge, snake: &Snake) -> Self {
        let verdict = judge.verdict();
        Episode {
            success: verdict.success,
            distance: verdict.distance,
            steps: judge.steps(),
            bearing: Bearing::of(judge.course().goal),
            motion: snake.motion(),
            low_steps: judge.low_steps(),
            effort: snake.effort(),
        }
    }
}

/// A share of episodes.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ByBearing {
    /// Ahead, aside or behind.
    pub bearing: Bearing,
    /// Episodes with such a goal.
    pub episodes: usize,
    /// Share of them that reached it.
    pub success_rate: f64,
    /// Lower end of its 95 % interval (Wilson).
    pub success_low: f64,
    /// Upper end.
    pub success_high: f64,
}

/// Results over all episodes: the paper's three columns, success with its 95 % interval and the means with their standard errors, and the motion.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Report {
    /// Episodes.
    pub episodes: usize,
    /// Share of successes.
    pub success_rate: f64,
    /// Lower end of its 95 % interval ([`wilson`]).
    pub success_low: f64,
    /// Upper end.
    pub success_high: f64,
    /// Mean distance at the end, units.
    pub distance_mean: f64,
    /// Its standard error.
    pub distance_se: f64,
    /// Mean number of control steps (the cap where the goal was not reached).
    pub steps_mean: f64,
    /// Its standard error.
    pub steps_se: f64,
    /// The cap: control steps before an episode is cut.
    pub cap: u32,
    /// Modules of the snake.
    pub modules: usize,
    /// In what the physics differ from the robot's own, such as `finer=2`; empty if in nothing.
    #[serde(skip_serializing_if = "String::is_empty")]
    pub physics: String,
    /// The faults injected, as on the command line; "none" without.
    pub fault: String,
    /// Success by where the goal lay.
    pub by_bearing: Vec<ByBearing>,
    /// Fastest link of all episodes, units/s.
    pub peak_link_speed: f64,
    /// Highest link centre of all episodes, units above the ground.
    pub peak_height: f64,
    /// Fastest joint of all episodes, rad/s.
    pub peak_joint_speed: f64,
    /// Share of control steps in which the whole body stayed below two link diameters.
    pub low_share: f64,
    /// What the direct solver did in all episodes.
    pub effort: Effort,
}

impl Report {
    /// Summarises episodes.
    pub fn new(episodes: &[Episode], config: &EnvConfig, fault: &str) -> Self {
        let n = episodes.len().max(1) as f64;
        let mean_se = |value: &dyn Fn(&Episode) -> f64| {
            let mean = episodes.iter().map(value).sum::<f64>() / n;
            let variance = episodes.iter().map(|e| (value(e) - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
            (mean, (variance / n).sqrt())
        };
        let max = |value: &dyn Fn(&Episode) -> f32| f64::from(episodes.iter().map(value).fold(0.0, f32::max));
        let successes = episodes.iter().filter(|e| e.success).count();
        let (success_low, success_high) = wilson(successes, episodes.len());
        let (distance_mean, distance_se) = mean_se(&|e| f64::from(e.distance));
        let (steps_mean, steps_se) = mean_se(&|e| f64::from(e.steps));
        let total_steps: u64 = episodes.iter().map(|e| u64::from(e.steps)).sum();
        let low_steps: u64 = episodes.iter().map(|e| u64::from(e.low_steps)).sum();
        let by_bearing = Bearing::ALL
            .into_iter()
            .map(|bearing| {
                let of: Vec<_> = episodes.iter().filter(|e| e.bearing == bearing).collect();
                let successes = of.iter().filter(|e| e.success).count();
                let (success_low, success_high) = wilson(successes, of.len());
                let success_rate = successes as f64 / of.len().max(1) as f64;
                ByBearing { bearing, episodes: of.len(), success_rate, success_low, success_high }
            })
            .collect();
        Report {
            episodes: episodes.len(),
            success_rate: successes as f64 / n,
            success_low,
            success_high,
            distance_mean,
            distance_se,
            steps_mean,
            steps_se,
            cap: config.cap(),
            modules: config.robot.modules,
            physics: String::new(),
            fault: fault.into(),
            by_bearing,
            peak_link_speed: max(&|e| e.motion.peak_link_speed),
            peak_height: max(&|e| e.motion.peak_height),
            peak_joint_speed: max(&|e| e.motion.peak_joint_speed),
            low_share: low_steps as f64 / total_steps.max(1) as f64,
            effort: episodes.iter().map(|e| e.effort).sum(),
        }
    }
}
