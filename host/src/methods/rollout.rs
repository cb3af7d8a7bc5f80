//! Collecting experience: each environment runs its steps of an iteration on its own, on whichever thread is free.
//!
//! No environment waits for another, and nothing an environment does depends on which thread runs it or when.

use std::time::{Duration, Instant};

use composer_shared::observation::{Observation, SIZE};
use rand_chacha::ChaCha8Rng;

use super::actor::{Actor, ActorScratch};
use super::actor_critic::{OUT, log_probability};
use super::buffer::{Experience, Lane, Track};
use super::imagination::{DISPLACEMENT, Imagination, follow_error};
use super::normalise::Running;
use super::{Stream, Workers, derive_seed, normal_pair, stream};
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
    /// The control policy's actor.
    pub policy: &'a Actor,
    /// The imagination policy, if the method has one.
    pub imagination: Option<Imagination<'a>>,
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

/// Runs an iteration: fills `experience` (as many environments as slots) and takes what was seen into `observations` and `privileged`.
pub fn collect(
    slots: &mut [Slot],
    experience: &mut Experience,
    iteration: Iteration,
    workers: &Workers,
    observations: &mut Running,
    privileged: &mut Running,
) -> Split {
    let mut scratch = vec![(ActorScratch::default(), Split::default()); workers.threads()];
    let Experience { lanes, control, imagination } = experience;
    let items = slots.iter_mut().zip(lanes).zip(control.iter_mut().zip(imagination));
    workers.for_each(items, &mut scratch, |((slot, lane), (control, imagination)), (scratch, split)| {
        let began = Instant::now();
        let physics = run(slot, lane, control, imagination, &iteration, scratch);
        split.physics += physics;
        split.inference += began.elapsed().saturating_sub(physics);
    });
    // In the order of the environments, so that rounding does not depend on the threads.
    for slot in slots {
        observations.merge(&std::mem::replace(&mut slot.observations, Running::new(SIZE)));
        privileged.merge(&std::mem::replace(&mut slot.privileged, Running::new(PRIVILEGED)));
    }
    let mut total = Split::default();
    for (_, split) in scratch {
        total.physics += split.physics;
        total.inference += split.inference;
    }
    total
}

/// One policy in the rollout of one environment.
struct Player<'a, const A: usize> {
    policy: &'a Actor,
    track: &'a mut Track<A>,
    rng: ChaCha8Rng,
    log_sigma: [f32; A],
    sigma: [f32; A],
}

impl<'a, const A: usize> Player<'a, A> {
    fn new(policy: &'a Actor, track: &'a mut Track<A>, rng: ChaCha8Rng) -> Self {
        let log_sigma = std::array::from_fn(|i| policy.log_sigma()[i]);
        Self { policy, track, rng, log_sigma, sigma: log_sigma.map(f32::exp) }
    }

    /// Draws an action for each module from what it observes and hears, and returns them all.
    fn act(&mut self, observations: &[f32], heard: &[u64], scratch: &mut ActorScratch) -> &[[f32; A]] {
        let first = self.track.actions.len();
        let means = self.policy.means(observations, heard, &[heard.len()], scratch);
        for mean in means.as_chunks::<A>().0 {
            // Numbers come in pairs; the last is thrown away if there is an odd number of actions.
            let mut pair = [0.0; 2];
            let action = std::array::from_fn(|i| {
                if i % 2 == 0 {
                    pair = normal_pair(&mut self.rng);
                }
                mean[i] + self.sigma[i] * pair[i % 2]
            });
            self.track.actions.push(action);
            self.track.log_probabilities.push(log_probability(action, *mean, self.log_sigma));
        }
        &self.track.actions[first..]
    }
}

/// The steps of one environment. Returns the time spent in it.
fn run(
    slot: &mut Slot,
    lane: &mut Lane,
    control: &mut Track<OUT>,
    imagination: &mut Track<DISPLACEMENT>,
    iteration: &Iteration,
    scratch: &mut ActorScratch,
) -> Duration {
    let n = slot.modules;
    let mut physics = Duration::ZERO;
    let index = slot.index as u64;
    let noise = |seed| stream(seed, Stream::Noise, iteration.iteration, index);
    lane.clear(n);
    control.clear();
    imagination.clear();
    let mut control = Player::new(iteration.policy, control, noise(iteration.run_seed));
    let mut imagination = iteration
        .imagination
        .map(|settings| (settings, Player::new(settings.policy, imagination, noise(settings.seed))));
    let mut imagined = Vec::with_capacity(n);
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
        let (observations, heard, acts) =
            (&lane.observations[first..], &lane.heard[step * n..], &lane.acts[step * n..]);
        if let Some((settings, player)) = &mut imagination {
            let actions = player.act(observations, heard, scratch);
            settings.imagine(&*slot.environment, acts, actions, &mut imagined);
            player.track.rewards.push(slot.environment.imagined_reward(&imagined));
        }
        let actions = control.act(observations, heard, scratch);
        slot.actions.extend_from_slice(actions);

        let began = Instant::now();
        let outcome = slot.environment.step(actions);
        physics += began.elapsed();
        let mut reward = outcome.reward;
        if let Some((settings, _)) = &imagination {
            let error = follow_error(&*slot.environment, acts, &imagined);
            lane.follow_errors.push(error);
            reward -= settings.follow * error;
        }
        control.track.rewards.push(reward);
        lane.rewards.push(outcome.reward);

        let began = Instant::now();
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
