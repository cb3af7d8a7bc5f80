//! Collecting experience: each environment runs its steps of an iteration on its own, on whichever thread is free.
//!
//! No environment waits for another, and nothing an environment does depends on which thread runs it or when.

use std::sync::Mutex;
use std::time::{Duration, Instant};

use composer_shared::observation::{Observation, SIZE};

use super::actor_critic::{OUT, log_probability};
use super::buffer::Lane;
use super::inference::{Inference, Scratch};
use super::normalise::Running;
use super::{Stream, derive_seed, normal_pair, stream};
use crate::environment::{Environment, PRIVILEGED, View};

/// Normalised numbers are clipped to this.
pub const CLIP: f32 = 5.0;

/// An environment, where it is in its sequence of episodes, and how it got there.
pub struct Slot {
    environment: Box<dyn Environment>,
    index: usize,
    modules: usize,
    /// Number of the running episode.
    pub episode: u64,
    /// Actions since its reset, all modules of a step together.
    pub actions: Vec<[f32; OUT]>,
    view: View,
    observations: Running,
    privileged: Running,
}

impl Slot {
    /// Starts the first episode of the environment `index` of a run.
    pub fn new(environment: Box<dyn Environment>, index: usize, run_seed: u64) -> Self {
        Self::restore(environment, index, run_seed, 0, Vec::new())
    }

    /// Brings an environment back to where it was: starts its episode again and replays the actions.
    pub fn restore(
        mut environment: Box<dyn Environment>,
        index: usize,
        run_seed: u64,
        episode: u64,
        actions: Vec<[f32; OUT]>,
    ) -> Self {
        environment.reset(episode_seed(run_seed, index, episode));
        let modules = environment.modules();
        for step in actions.chunks_exact(modules.max(1)) {
            environment.step(step);
        }
        let mut view = View::default();
        environment.view(&mut view);
        Self {
            environment,
            index,
            modules,
            episode,
            actions,
            view,
            observations: Running::new(SIZE),
            privileged: Running::new(PRIVILEGED),
        }
    }

    /// Modules of the environment.
    pub fn modules(&self) -> usize {
        self.modules
    }
}

/// Seed of an episode. Independent of everything else that is drawn in the run.
pub fn episode_seed(run_seed: u64, environment: usize, episode: u64) -> u64 {
    derive_seed(run_seed, Stream::Episode, environment as u64, episode)
}

/// Mean and one over the standard deviation of some numbers, frozen for an iteration.
#[derive(Clone, Copy, Debug)]
pub struct Frozen<const N: usize> {
    mean: [f32; N],
    scale: [f32; N],
}

impl<const N: usize> Frozen<N> {
    /// The statistics as they are now.
    pub fn new(running: &Running) -> Self {
        Self { mean: running.mean(), scale: running.std::<N>().map(f32::recip) }
    }

    fn apply(&self, x: &[f32; N], out: &mut Vec<f32>) {
        out.extend((0..N).map(|i| ((x[i] - self.mean[i]) * self.scale[i]).clamp(-CLIP, CLIP)));
    }
}

/// What all environments of an iteration have in common.
#[derive(Clone, Copy)]
pub struct Iteration<'a> {
    /// The actor.
    pub policy: &'a Inference,
    /// Statistics of the observations.
    pub observations: Frozen<SIZE>,
    /// Statistics of the privileged numbers.
    pub privileged: Frozen<PRIVILEGED>,
    /// Seed of the run.
    pub run_seed: u64,
    /// Number of the iteration.
    pub iteration: u64,
    /// Steps each environment takes.
    pub steps: usize,
}

/// Processor time of a rollout, summed over the threads.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Split {
    /// Inside the environments.
    pub physics: Duration,
    /// Everything else: the policy, the noise, book-keeping.
    pub inference: Duration,
}

/// Runs an iteration: fills `lanes` (one per slot) and takes what was seen into `observations` and `privileged`.
pub fn collect(
    slots: &mut [Slot],
    lanes: &mut [Lane],
    iteration: Iteration,
    threads: usize,
    observations: &mut Running,
    privileged: &mut Running,
) -> Split {
    let split = {
        let work = Mutex::new(slots.iter_mut().zip(lanes.iter_mut()));
        let worker = || {
            let mut split = Split::default();
            let mut scratch = Scratch::default();
            loop {
                // The lock is held only to take the next environment; no panic can happen inside.
                let next = work.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).next();
                let Some((slot, lane)) = next else { return split };
                let began = Instant::now();
                let physics = run(slot, lane, &iteration, &mut scratch);
                split.physics += physics;
                split.inference += began.elapsed().saturating_sub(physics);
            }
        };
        std::thread::scope(|scope| {
            let others: Vec<_> = (1..threads.max(1)).map(|_| scope.spawn(worker)).collect();
            let mut total = worker();
            for other in others {
                match other.join() {
                    Ok(split) => {
                        total.physics += split.physics;
                        total.inference += split.inference;
                    }
                    Err(panic) => std::panic::resume_unwind(panic),
                }
            }
            total
        })
    };
    // In the order of the environments, so that rounding does not depend on the threads.
    for slot in slots {
        observations.merge(&std::mem::replace(&mut slot.observations, Running::new(SIZE)));
        privileged.merge(&std::mem::replace(&mut slot.privileged, Running::new(PRIVILEGED)));
    }
    split
}

/// The steps of one environment. Returns the time spent in it.
fn run(slot: &mut Slot, lane: &mut Lane, iteration: &Iteration, scratch: &mut Scratch) -> Duration {
    let n = slot.modules;
    let mut physics = Duration::ZERO;
    let mut means = vec![[0.0; OUT]; n];
    let mut rng = stream(iteration.run_seed, Stream::Noise, iteration.iteration, slot.index as u64);
    let log_sigma = iteration.policy.log_sigma;
    let sigma = log_sigma.map(f32::exp);
    lane.clear(n);
    for step in 0..iteration.steps {
        let first = lane.observations.len();
        for module in 0..n {
            slot.observations.push(&slot.view.observations[module]);
            slot.privileged.push(&slot.view.privileged[module]);
            iteration.observations.apply(&slot.view.observations[module], &mut lane.observations);
            iteration.privileged.apply(&slot.view.privileged[module], &mut lane.privileged);
            lane.heard.push(slot.view.heard[module] | 1 << module);
        }
        lane.acts.extend_from_slice(&slot.view.acts);
        iteration.policy.means(&lane.observations[first..], &lane.heard[step * n..], &mut means, scratch);
        for mean in &means {
            let noise = normal_pair(&mut rng);
            let action = std::array::from_fn(|i| mean[i] + sigma[i] * noise[i]);
            lane.actions.push(action);
            lane.log_probabilities.push(log_probability(action, *mean, log_sigma));
        }
        let actions = &lane.actions[step * n..];
        slot.actions.extend_from_slice(actions);

        let began = Instant::now();
        let outcome = slot.environment.step(actions);
        let truncated = outcome.truncated && !outcome.terminated;
        let last = step + 1 == iteration.steps;
        if outcome.terminated || truncated {
            if truncated {
                slot.environment.view(&mut slot.view);
                finals(lane, &slot.view, iteration);
            }
            slot.episode += 1;
            slot.actions.clear();
            slot.environment.reset(episode_seed(iteration.run_seed, slot.index, slot.episode));
            lane.episodes.push(outcome);
        }
        slot.environment.view(&mut slot.view);
        physics += began.elapsed();

        lane.rewards.push(outcome.reward);
        lane.terminated.push(outcome.terminated);
        lane.truncated.push(truncated);
        if last && !truncated {
            finals(lane, &slot.view, iteration);
        }
    }
    physics
}

/// Appends a final view to a lane.
fn finals(lane: &mut Lane, view: &View, iteration: &Iteration) {
    let observations: &[Observation] = &view.observations;
    for (observation, privileged) in observations.iter().zip(&view.privileged) {
        iteration.observations.apply(observation, &mut lane.final_observations);
        iteration.privileged.apply(privileged, &mut lane.final_privileged);
    }
}
