//! Evaluation: whole episodes on seeds that training never draws, without exploration noise.
//!
//! An evaluation is easier than the training ([`crate::run::RunConfig::evaluation`]): the torque takes effect after the least delay of those trained
//! with, no latent is missed, the snake has the robot's own length, and without `--fault` nothing is broken.

use std::sync::Arc;
use std::sync::atomic::{AtomicUsize, Ordering};

use composer_shared::observation::Observation;
use composer_shared::policy::{Encoded, Latent, Policy};
use composer_shared::robot::MAX_MODULES;
use composer_sim_bridge::faults::ScheduledFault;
use serde::Serialize;

use crate::env::{EnvConfig, SnakeEnv};
use crate::environment::{Environment, View};
use crate::methods::mix;
use crate::network::Network;
use crate::sim::{Motion, Snake};
use crate::stats::wilson;
use crate::tasks::Judge;
use crate::tasks::goal_reaching::Bearing;

/// Who decides the torques.
#[derive(Clone, Copy)]
#[allow(clippy::large_enum_variant)] // A view into an image; it is copied once an episode.
pub enum Pilot<'a> {
    /// The network as it was trained, in 32-bit floats.
    Float(&'a Network),
    /// The frozen integer policy, as the modules run it.
    Integer(Policy<'a>),
    /// Nobody: all torques stay zero. A baseline.
    Still,
    /// A new random torque for each motor and step. A baseline.
    Random,
}

impl Pilot<'_> {
    /// The actions of all modules for one step; `attention` gets the weights, row-major, if there are any.
    pub fn act(&self, view: &View, noise: u64, actions: &mut Vec<[f32; 2]>, attention: Option<&mut Vec<f32>>) {
        let modules = view.observations.len();
        actions.clear();
        actions.resize(modules, [0.0; 2]);
        match self {
            Pilot::Float(network) => {
                let attention = attention.map(|a| {
                    a.clear();
                    a.resize(modules * modules, 0.0);
                    a.as_mut_slice()
                });
                network.act(&view.observations, &view.heard, actions, attention);
            }
            Pilot::Integer(policy) => {
                let encoded: Vec<Encoded> = view.observations.iter().map(|o| policy.encode(o)).collect();
                let mut latents = [Latent::default(); MAX_MODULES];
                for (slot, e) in latents.iter_mut().zip(&encoded) {
                    *slot = e.latent;
                }
                let mut rows = attention;
                if let Some(rows) = rows.as_deref_mut() {
                    rows.clear();
                }
                for (module, own) in encoded.iter().enumerate() {
                    let mut weights = [0u16; MAX_MODULES];
                    actions[module] = policy.act(own, &latents, view.heard[module], Some(&mut weights), module);
                    if let Some(rows) = rows.as_deref_mut() {
                        rows.extend(weights[..modules].iter().map(|&w| f32::from(w) / 32767.0));
                    }
                }
            }
            Pilot::Still => {}
            Pilot::Random => {
                for (index, action) in actions.iter_mut().enumerate() {
                    *action = [0, 1].map(|axis| {
                        let bits = mix(noise ^ mix((2 * index + axis) as u64));
                        (bits >> 40) as f32 / (1u64 << 23) as f32 - 1.0
                    });
                }
            }
        }
    }
}

/// Seed of evaluation episode `index`. Training derives its seeds from other constants, so that it never sees these episodes.
pub fn episode_seed(seed: u64, index: u64) -> u64 {
    mix(mix(seed ^ 0x0e7a_1e7a_1e7a_1e7a) ^ index)
}

/// Seed of the episodes behind every published figure, and of nothing else: nobody trains, chooses settings or looks on the way by them.
pub const PUBLISHED_SEED: u64 = 0x9b11_5ed0_0e91_50de;
/// Episodes of a published figure, at least.
pub const PUBLISHED_EPISODES: u64 = 500;
/// Seed of the episodes that people get who do not choose one.
pub const DEFAULT_SEED: u64 = 1;
/// Seed that those of the evaluations during a training are derived from.
pub const CURVE_SEED: u64 = 0x7a1e;

/// Seed of the evaluations during the training with this seed: each run is looked at on episodes of its own, so that the mean over several runs is
/// one over as many more episodes.
pub fn curve_seed(run_seed: u64) -> u64 {
    mix(CURVE_SEED ^ mix(run_seed))
}

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
        }
    }
}

/// Faults of an episode, from its seed and the number of modules.
pub type FaultDraw<'a> = dyn Fn(u64, usize) -> Vec<ScheduledFault> + Sync + 'a;

/// Runs one episode; `each` sees the environment, the actions and the attention weights after every step.
pub fn run_episode(
    env: &mut SnakeEnv,
    pilot: Pilot,
    seed: u64,
    faults: &[ScheduledFault],
    mut each: impl FnMut(&SnakeEnv, &View),
) -> Episode {
    env.reset_with(seed, faults);
    let (mut view, mut actions) = (View::default(), Vec::new());
    for step in 0u64.. {
        env.view(&mut view);
        pilot.act(&view, mix(seed ^ step), &mut actions, None);
        each(env, &view);
        let outcome = env.step(&actions);
        if outcome.terminated || outcome.truncated {
            return Episode::new(env.judge(), env.snake());
        }
    }
    unreachable!("an episode ends at its cap")
}

/// Runs `job(index)` for every index below `count` on `threads` threads and returns the results in order.
pub fn parallel<T: Send>(count: usize, threads: usize, job: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let mut results: Vec<(usize, T)> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads.max(1))
            .map(|_| {
                scope.spawn(|| {
                    let mut done = Vec::new();
                    loop {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        if index >= count {
                            return done;
                        }
                        done.push((index, job(index)));
                    }
                })
            })
            .collect();
        workers.into_iter().flat_map(|w| w.join().expect("a worker thread does not panic")).collect()
    });
    results.sort_by_key(|r| r.0);
    results.into_iter().map(|r| r.1).collect()
}

/// A set of episodes to run.
#[derive(Clone, Copy)]
pub struct Trial<'a> {
    /// The environment.
    pub config: &'a Arc<EnvConfig>,
    /// Episodes.
    pub episodes: usize,
    /// Seed of the set.
    pub seed: u64,
    /// Faults of each episode.
    pub faults: &'a FaultDraw<'a>,
    /// Threads; the result does not depend on their number.
    pub threads: usize,
}

impl Trial<'_> {
    /// Runs every episode and hands it to `job` in between: (index, environment, seed, faults).
    fn run<T: Send>(&self, job: impl Fn(&mut SnakeEnv, u64, &[ScheduledFault]) -> T + Sync) -> Vec<T> {
        parallel(self.episodes, self.threads, |index| {
            let seed = episode_seed(self.seed, index as u64);
            let faults = (self.faults)(seed, self.config.robot.modules);
            job(&mut SnakeEnv::new(self.config.clone()), seed, &faults)
        })
    }

    /// Evaluates a pilot; `fault` names the faults in the report, `progress` is called after each episode.
    pub fn evaluate(&self, pilot: Pilot, fault: &str, progress: &(dyn Fn() + Sync)) -> Report {
        let episodes = self.run(|env, seed, faults| {
            let episode = run_episode(env, pilot, seed, faults, |_, _| {});
            progress();
            episode
        });
        Report::new(&episodes, self.config, fault)
    }

    /// Runs the first `count` episodes again and records them.
    pub fn record(&self, pilot: Pilot, count: usize) -> Vec<crate::replay::Episode> {
        let mut env = SnakeEnv::new(self.config.clone());
        let record = |index: usize| {
            let seed = episode_seed(self.seed, index as u64);
            let faults = (self.faults)(seed, self.config.robot.modules);
            let name = format!("episode {}", index + 1);
            crate::recorder::simulate(self.config, &mut env, pilot, &name, seed, &faults)
        };
        (0..count.min(self.episodes)).map(record).collect()
    }

    /// Observations of all modules at every step, for calibrating and checking a frozen policy.
    pub fn observations(&self, network: &Network) -> Vec<Vec<Observation>> {
        let episodes = self.run(|env, seed, faults| {
            let mut steps = Vec::new();
            run_episode(env, Pilot::Float(network), seed, faults, |_, view| steps.push(view.observations.clone()));
            steps
        });
        episodes.into_iter().flatten().collect()
    }
}

/// No faults.
pub fn healthy(_seed: u64, _modules: usize) -> Vec<ScheduledFault> {
    Vec::new()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    #[test]
    fn published_curve_and_default_episodes_are_apart() {
        const EPISODES: u64 = 10_000;
        let mut seeds = vec![PUBLISHED_SEED, DEFAULT_SEED, CURVE_SEED];
        seeds.extend((0..4).map(curve_seed));
        assert_eq!(seeds.iter().collect::<HashSet<_>>().len(), seeds.len());
        let episodes = seeds.iter().flat_map(|seed| (0..EPISODES).map(move |index| episode_seed(*seed, index)));
        assert_eq!(episodes.collect::<HashSet<_>>().len() as u64, seeds.len() as u64 * EPISODES);
    }
}
