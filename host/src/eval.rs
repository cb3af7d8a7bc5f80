//! Evaluation: whole episodes on seeds that training never draws, without exploration noise.
//!
//! An evaluation is easier than the training ([`crate::run::RunConfig::evaluation`]): the torque takes effect after the least delay of those trained
//! with, no latent is missed, the snake has the robot's own length, and without `--fault` nothing is broken.

use std::sync::Arc;

use composer_shared::observation::Observation;
use composer_sim_bridge::faults::ScheduledFault;

use crate::env::{EnvConfig, SnakeEnv};
use crate::environment::{Environment, View};
use crate::methods::mix;
use crate::methods::workers::Workers;
use crate::outcome::{Episode, Report};
use crate::policy::{Memories, Policy};

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

/// Faults of an episode, from its seed and the number of modules.
pub type FaultDraw<'a> = dyn Fn(u64, usize) -> Vec<ScheduledFault> + Sync + 'a;

/// Runs one episode; `each` sees the environment, the actions and the attention weights after every step.
pub fn run_episode(
    env: &mut SnakeEnv,
    policy: &dyn Policy,
    seed: u64,
    faults: &[ScheduledFault],
    mut each: impl FnMut(&SnakeEnv, &View),
) -> Episode {
    env.reset_with(seed, faults);
    let (mut view, mut memories, mut actions) = (View::default(), Memories::default(), Vec::new());
    for step in 0u64.. {
        env.view(&mut view);
        policy.act(&view, mix(seed ^ step), &mut memories, &mut actions, None);
        each(env, &view);
        let outcome = env.step(&actions);
        if outcome.terminated || outcome.truncated {
            return Episode::new(env.judge(), env.snake());
        }
    }
    unreachable!("an episode ends at its cap")
}

/// Runs `job(index)` for every index below `count` on `threads` threads and returns the results in order.
///
/// # Panics
///
/// If the system does not give so many threads.
pub fn parallel<T: Send>(count: usize, threads: usize, job: impl Fn(usize) -> T + Sync) -> Vec<T> {
    Workers::new(threads).expect("the system gives threads").map(count, job)
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
    pub(crate) fn run<T: Send>(&self, job: impl Fn(&mut SnakeEnv, u64, &[ScheduledFault]) -> T + Sync) -> Vec<T> {
        parallel(self.episodes, self.threads, |index| {
            let seed = episode_seed(self.seed, index as u64);
            let faults = (self.faults)(seed, self.config.robot.modules);
            job(&mut SnakeEnv::new(self.config.clone()), seed, &faults)
        })
    }

    /// Evaluates a policy; `fault` names the faults in the report, `progress` is called after each episode.
    pub fn evaluate(&self, policy: &dyn Policy, fault: &str, progress: &(dyn Fn() + Sync)) -> Report {
        let episodes = self.run(|env, seed, faults| {
            let episode = run_episode(env, policy, seed, faults, |_, _| {});
            progress();
            episode
        });
        Report::new(&episodes, self.config, fault)
    }

    /// Observations of all modules at every step of every episode, for calibrating and checking a frozen policy.
    pub fn observations(&self, policy: &dyn Policy) -> Vec<Vec<Vec<Observation>>> {
        self.run(|env, seed, faults| {
            let mut steps = Vec::new();
            run_episode(env, policy, seed, faults, |_, view| steps.push(view.observations.clone()));
            steps
        })
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
