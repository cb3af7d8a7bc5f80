//! The update: values, advantages, then epochs of minibatches, each split over the threads.
//!
//! Sums are taken over chunks of fixed size in a fixed order, so the result does not depend on the number of threads.

use rand::RngExt;
use rand_chacha::ChaCha8Rng;

use super::buffer::{Batch, Decisions, Trajectory, gather};
use super::{ActorCritic, Gradient, LossSettings, Part, Teams};
use crate::environment::PRIVILEGED;
use crate::methods::layout::Layout;
use crate::methods::normalise::{Forgetting, ValueNorm};
use crate::methods::parameters::{Adam, clip_norm};
use crate::methods::random::{Stream, stream};
use crate::methods::ranks::{self, Opened, Parcel, Ranks};
use crate::methods::workers::Workers;

/// Samples (steps of one environment) that one thread takes at a time.
const CHUNK: usize = 64;
/// Steps that go through a memory in one piece; what they remembered before is as it was in the rollout.
pub const STRETCH: usize = 16;
/// The adaptive learning rate changes by this factor and stays within these limits (as in rsl_rl).
const RATE_FACTOR: f32 = 1.5;
/// Limits of the adaptive learning rate.
pub const RATE_LIMITS: [f32; 2] = [1e-5, 1e-2];

/// How advantages are given mean 0 and standard deviation 1.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Standardise {
    /// Once for all of a rollout, by their own standard deviation and this.
    Rollout(f64),
    /// Each minibatch for itself, by the estimate of the standard deviation from a sample and this.
    Minibatch(f64),
}

/// Settings of rollout and update.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OnPolicySettings {
    /// Environments side by side.
    pub environments: usize,
    /// Steps each takes in an iteration.
    pub rollout_steps: usize,
    /// Minibatches an epoch.
    pub minibatches: usize,
    /// Epochs of the actor at most.
    pub epochs: usize,
    /// Epochs of the critic.
    pub critic_epochs: usize,
    /// Discount per control step.
    pub gamma: f32,
    /// Decay of generalised advantage estimation.
    pub lambda: f32,
    /// Clip of the ratio.
    pub clip: f32,
    /// The actor stops for this iteration when the estimated KL divergence of a minibatch exceeds this.
    pub kl_stop: f32,
    /// Weight of the entropy bonus.
    pub entropy: f32,
    /// Limit of the norm of the gradient of the actor's part.
    pub actor_grad_norm: f32,
    /// Limit of the norm of the gradient of the critic's part.
    pub critic_grad_norm: f32,
    /// Learning rate at the start.
    pub learning_rate: f64,
    /// Share of it that is left at the end; linear in between.
    pub learning_rate_end: f64,
    /// KL divergence that the learning rate is adapted to; 0 leaves it alone.
    pub kl_target: f32,
    /// Least standard deviation of an action.
    pub sigma_min: f32,
    /// What the advantages are divided by.
    pub standardise: Standardise,
    /// Observations are normalised and cut off at this; none: they go in raw.
    pub observation_clip: Option<f32>,
    /// Rewards are divided by the standard deviation of their running discounted sum and cut off at this; none: they stay as they are.
    pub reward_clip: Option<f32>,
}

impl OnPolicySettings {
    /// Learning rate of an iteration, if it falls linearly.
    pub fn learning_rate_at(&self, iteration: u64, iterations: u64) -> f32 {
        let done = iteration as f64 / iterations.max(1) as f64;
        (self.learning_rate * (1.0 - done * (1.0 - self.learning_rate_end))) as f32
    }
}

/// One policy with its critic: everything that is learnt of it.
#[derive(Clone, Debug)]
pub struct Learner<C> {
    /// The networks, with the parameters below.
    pub networks: C,
    /// Seed of its random streams.
    pub seed: u64,
    /// The actor's parameters.
    pub actor: Vec<f32>,
    /// The critic's parameters; none where one optimiser steps all of them.
    pub critic: Vec<f32>,
    /// The actor's optimiser.
    pub actor_adam: Adam,
    /// The critic's optimiser.
    pub critic_adam: Adam,
    /// Scale of the critic.
    pub value_norm: ValueNorm,
    /// Learning rate of the next update, if it is adapted.
    pub learning_rate: f32,
}

impl<C: ActorCritic> Learner<C> {
    /// A learner that has learnt nothing, with these initial parameters.
    pub fn new(
        mut networks: C,
        seed: u64,
        actor: Vec<f32>,
        critic: Vec<f32>,
        value_norm: ValueNorm,
        adam_epsilon: f32,
        learning_rate: f32,
    ) -> Self {
        networks.load(Part::Actor, &actor);
        networks.load(Part::Critic, &critic);
        Self {
            networks,
            seed,
            actor_adam: Adam::new(actor.len(), adam_epsilon),
            critic_adam: Adam::new(critic.len(), adam_epsilon),
            actor,
            critic,
            value_norm,
            learning_rate,
        }
    }

    /// The same of networks made `with` parameters of these layouts, the actor's part first.
    pub fn untrained(
        layouts: [Layout; 2],
        with: impl FnOnce(Vec<f32>) -> C,
        seed: u64,
        forgetting: Forgetting,
        rate: f64,
    ) -> Self {
        let initial = |part: usize| layouts[part].initial(&mut stream(seed, Stream::Weights, 2, part as u64));
        let [actor, critic] = [initial(0), initial(1)];
        let networks = with([&actor[..], &critic].concat());
        Self::new(networks, seed, actor, critic, ValueNorm::new(forgetting), 1e-5, rate as f32)
    }

    /// Standard deviation of the actions as it is now, mean over their dimensions.
    pub fn sigma(&self) -> f64 {
        let log_sigma = self.networks.log_sigma();
        log_sigma.iter().map(|l| f64::from(l.exp())).sum::<f64>() / log_sigma.len() as f64
    }

    /// Whether every weight is a finite number.
    pub fn is_finite(&self) -> bool {
        self.actor.iter().chain(&self.critic).all(|p| p.is_finite())
    }
}

/// What an update did, for the logs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct UpdateStats {
    /// Mean clipped loss of the actor over its minibatches.
    pub policy_loss: f64,
    /// Mean loss of the critic over its minibatches, on its own scale.
    pub value_loss: f64,
    /// Estimated KL divergence of the last minibatch of the actor.
    pub approx_kl: f64,
    /// The same of the very first minibatch, before anything was learnt: rounding only, or rollout and update disagree.
    pub first_kl: f64,
    /// Share of clipped ratios over the actor's minibatches.
    pub clip_fraction: f64,
    /// Entropy of one module's action distribution, nat.
    pub entropy: f64,
    /// Share of the variance of the returns that the critic explained before the update.
    pub explained_variance: f64,
    /// Norm of the actor's gradient before clipping, mean.
    pub actor_grad_norm: f64,
    /// Norm of the critic's gradient before clipping, mean.
    pub critic_grad_norm: f64,
    /// Minibatches of the actor before the KL stop.
    pub actor_minibatches: usize,
}

impl UpdateStats {
    /// The numbers with the names they are logged under, CleanRL's where it has them.
    pub fn scalars(&self) -> [(&'static str, f64); 10] {
        [
            ("policy_loss", self.policy_loss),
            ("value_loss", self.value_loss),
            ("approx_kl", self.approx_kl),
            ("first_minibatch_kl", self.first_kl),
            ("clipfrac", self.clip_fraction),
            ("entropy", self.entropy),
            ("explained_variance", self.explained_variance),
            ("actor_grad_norm", self.actor_grad_norm),
            ("critic_grad_norm", self.critic_grad_norm),
            ("actor_minibatches", self.actor_minibatches as f64),
        ]
    }
}

/// Threads and memory for updates, kept from one to the next.
pub struct Workspace<C: ActorCritic> {
    /// The threads.
    pub workers: Workers,
    /// One a thread.
    scratch: Vec<Scratch<C>>,
    /// The sum over each chunk of a minibatch: the actor's, then the critic's.
    actor: Vec<Gradient>,
    critic: Vec<Gradient>,
}

impl<C: ActorCritic> Workspace<C> {
    /// Starts so many threads.
    ///
    /// # Errors
    ///
    /// If the system does not give them.
    pub fn new(threads: usize) -> anyhow::Result<Self> {
        let workers = Workers::new(threads)?;
        let scratch = (0..workers.threads()).map(|_| Scratch::default()).collect();
        Ok(Self { workers, scratch, actor: Vec::new(), critic: Vec::new() })
    }
}

struct Scratch<C: ActorCritic> {
    batch: Batch,
    networks: C::Scratch,
    modules: Vec<usize>,
}

impl<C: ActorCritic> Default for Scratch<C> {
    fn default() -> Self {
        Self { batch: Batch::default(), networks: C::Scratch::default(), modules: Vec::new() }
    }
}

/// All (trajectory, step) pairs, in order.
pub(crate) fn all_samples(trajectories: &[Trajectory]) -> Vec<(u32, u32)> {
    let of = |(index, trajectory): (usize, &Trajectory)| {
        (0..trajectory.steps()).map(move |t| (index as u32, t as u32)).collect::<Vec<_>>()
    };
    trajectories.iter().enumerate().flat_map(of).collect()
}

/// What the critic says, on its own scale, of views of teams of `modules` modules: `[view][module][inputs]` and
/// `[view][module][PRIVILEGED]`.
fn values<C: ActorCritic>(
    networks: &C,
    modules: usize,
    [observations, privileged]: [&[f32]; 2],
    heard: &[u64],
    scratch: &mut Scratch<C>,
) -> Vec<f32> {
    let mut values = Vec::with_capacity(heard.len());
    let block = networks.block();
    let blocks = observations
        .chunks(block * modules * networks.inputs())
        .zip(privileged.chunks(block * modules * PRIVILEGED))
        .zip(heard.chunks(block * modules));
    for ((observations, privileged), heard) in blocks {
        scratch.modules.clear();
        scratch.modules.resize(heard.len() / modules, modules);
        let teams = Teams { observations, privileged, heard, modules: &scratch.modules };
        networks.values(teams, &mut scratch.networks, &mut values);
    }
    values
}

/// Fills in the values, advantages and returns of all decisions. Returns the explained variance.
pub fn estimate_advantages<C: ActorCritic>(
    trajectories: &[Trajectory],
    decisions: &mut [Decisions],
    learner: &Learner<C>,
    settings: &OnPolicySettings,
    workspace: &mut Workspace<C>,
) -> f64 {
    let Learner { networks, value_norm: norm, .. } = learner;
    let valued = networks.valued();
    let mut all = vec![[Vec::new(), Vec::new()]; trajectories.len()];
    let Workspace { workers, scratch, .. } = workspace;
    workers.for_each(trajectories.iter().zip(&mut all), scratch, |(trajectory, [steps, finals]), scratch| {
        let Trajectory { observations, privileged, heard, final_observations, final_privileged, final_heard, .. } =
            trajectory;
        *steps = values(networks, trajectory.modules, [observations, privileged], heard, scratch);
        let last = [&final_observations[..], final_privileged];
        *finals = values(networks, trajectory.modules, last, final_heard, scratch);
    });
    let (mut n, mut sum, mut square, mut error, mut error_square) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for ((trajectory, decisions), [values, finals]) in trajectories.iter().zip(&mut *decisions).zip(&all) {
        let denormalised = |values: &[f32]| -> Vec<f32> { values.iter().map(|v| norm.denormalise(*v)).collect() };
        decisions.values.clone_from(values);
        let (values, finals) = (denormalised(values), denormalised(finals));
        let width = trajectory.valued(valued);
        decisions.estimate(trajectory, &values, &finals, width, settings.gamma, settings.lambda);
        for (value, target) in values.iter().zip(&decisions.returns) {
            let (target, e) = (f64::from(*target), f64::from(target - value));
            n += 1.0;
            sum += target;
            square += target * target;
            error += e;
            error_square += e * e;
        }
    }
    let variance = square / n - (sum / n) * (sum / n);
    if variance > 1e-12 { 1.0 - (error_square / n - (error / n) * (error / n)) / variance } else { 0.0 }
}

/// One iteration's learning of one policy from what happened and what it did in it.
pub fn update<C: ActorCritic>(
    learner: &mut Learner<C>,
    trajectories: &[Trajectory],
    decisions: &mut [Decisions],
    settings: &OnPolicySettings,
    learning_rate: f32,
    iteration: u64,
    workspace: &mut Workspace<C>,
) -> UpdateStats {
    let workers = workspace.workers.clone();
    workers.enter(|| update_within(learner, trajectories, decisions, settings, learning_rate, iteration, workspace))
}

fn update_within<C: ActorCritic>(
    learner: &mut Learner<C>,
    trajectories: &[Trajectory],
    decisions: &mut [Decisions],
    settings: &OnPolicySettings,
    learning_rate: f32,
    iteration: u64,
    workspace: &mut Workspace<C>,
) -> UpdateStats {
    let mut stats = UpdateStats {
        explained_variance: estimate_advantages(trajectories, decisions, learner, settings, workspace),
        ..Default::default()
    };
    if let Standardise::Rollout(epsilon) = settings.standardise {
        standardise(decisions, epsilon);
    }
    if learner.value_norm.forgetting == Forgetting::Iterations {
        let returns: Vec<f32> = decisions.iter().flat_map(|d| d.returns.iter().copied()).collect();
        let before = [learner.value_norm.mean(), learner.value_norm.std()];
        learner.value_norm.update(&returns);
        let after = [learner.value_norm.mean(), learner.value_norm.std()];
        learner.networks.rescale(&mut learner.critic, before, after);
        learner.networks.load(Part::Critic, &learner.critic);
    }

    let decisions = &*decisions;
    let valued = learner.networks.valued();
    let mut samples = all_samples(trajectories);
    // Those of each trajectory.
    let in_order: Vec<Vec<(u32, u32)>> = samples.chunk_by(|a, b| a.0 == b.0).map(<[_]>::to_vec).collect();
    let size = samples.len().div_ceil(settings.minibatches).max(1);
    let chunk_count = size.div_ceil(CHUNK);
    let Workspace { workers, scratch, actor: actor_sums, critic: critic_sums } = workspace;
    actor_sums.resize_with(chunk_count, Gradient::default);
    critic_sums.resize_with(chunk_count, Gradient::default);
    let (mut actor_gradient, mut critic_gradient) = (Vec::new(), Vec::new());
    let mut learning = true;
    let (mut actor_count, mut critic_count) = (0.0f64, 0.0f64);
    let of_critic_len = learner.critic.len();
    for epoch in 0..settings.epochs.max(settings.critic_epochs) {
        let mut rng = stream(learner.seed, Stream::Shuffle, iteration, epoch as u64);
        if learner.networks.memory() == 0 {
            shuffle(&mut samples, &mut rng);
        } else {
            // Stretches of steps that follow each other, in any order: the gradient goes back through what is remembered within them.
            let mut stretches: Vec<&[(u32, u32)]> = in_order.iter().flat_map(|steps| steps.chunks(STRETCH)).collect();
            shuffle(&mut stretches, &mut rng);
            samples = stretches.concat();
        }
        for minibatch in samples.chunks(size) {
            let with_actor = learning && epoch < settings.epochs;
            let with_critic = epoch < settings.critic_epochs && of_critic_len > 0;
            if !with_actor && !with_critic {
                continue;
            }
            let acting: usize = minibatch
                .iter()
                .map(|(index, t)| {
                    let trajectory = &trajectories[*index as usize];
                    let first = *t as usize * trajectory.modules;
                    if !decisions[*index as usize].counted(*t as usize) {
                        return 0;
                    }
                    trajectory.acts[first..first + trajectory.modules].iter().filter(|acts| **acts).count()
                })
                .sum();
            let weight = 1.0 / acting.max(1) as f32;
            let team_weight = 1.0 / minibatch.len() as f32;
            let loss = LossSettings { clip: settings.clip, entropy: settings.entropy, team_weight };
            let of_minibatch = |all: fn(&Decisions) -> &[f32]| {
                minibatch.iter().flat_map(move |(index, t)| {
                    let width = trajectories[*index as usize].valued(valued);
                    &all(&decisions[*index as usize])[*t as usize * width..(*t as usize + 1) * width]
                })
            };
            if learner.value_norm.forgetting == Forgetting::Minibatches {
                learner.value_norm.update(&of_minibatch(|d| &d.returns).copied().collect::<Vec<_>>());
            }
            let [mean, std] = match settings.standardise {
                Standardise::Rollout(_) => [0.0, 1.0],
                Standardise::Minibatch(epsilon) => of_sample(of_minibatch(|d| &d.advantages), epsilon),
            };
            let (norm, networks) = (learner.value_norm, &learner.networks);
            let (lengths, by_blocks) = ([learner.actor.len(), of_critic_len], learner.networks.block());
            let of_all = minibatch.len().div_ceil(CHUNK);
            let own = workers.ranks().map_or(0..of_all, |ranks| ranks.share(of_all));
            let chunks = minibatch.chunks(CHUNK).zip(actor_sums.iter_mut().zip(critic_sums.iter_mut()));
            workers.for_each(
                chunks.skip(own.start).take(own.len()),
                scratch,
                |(chunk, (of_actor, of_critic)), scratch| {
                    of_actor.clear(lengths[0]);
                    of_critic.clear(lengths[1]);
                    let Scratch { batch, networks: scratch, .. } = scratch;
                    for block in chunk.chunks(by_blocks) {
                        gather((trajectories, decisions), block, valued, weight, |r| norm.normalise(r), batch);
                        if let Standardise::Minibatch(_) = settings.standardise {
                            batch.advantages.iter_mut().for_each(|a| *a = (*a - mean) / std);
                        }
                        let (actor, critic) =
                            (with_actor.then_some(&mut *of_actor), with_critic.then_some(&mut *of_critic));
                        networks.gradient(batch, loss, scratch, actor, critic);
                    }
                },
            );
            let chunks = of_all;
            if let Some(ranks) = workers.ranks() {
                gather_from_ranks(&mut actor_sums[..chunks], &mut critic_sums[..chunks], ranks);
            }
            let Learner { networks, actor: parameters, critic: critic_parameters, actor_adam, critic_adam, .. } =
                &mut *learner;
            let finish = |part, sum: &Gradient, to: &mut Vec<f32>| networks.finish(part, &sum.gradient, loss, to);
            let actor_step = || {
                let sum = add_up(&mut actor_sums[..chunks]);
                let mut norm = None;
                if sum.kl <= f64::from(settings.kl_stop) {
                    finish(Part::Actor, sum, &mut actor_gradient);
                    norm = Some(clip_norm(&mut actor_gradient, settings.actor_grad_norm));
                    actor_adam.step(parameters, &actor_gradient, learning_rate);
                    if settings.sigma_min > 0.0 {
                        networks.floor_sigma(parameters, settings.sigma_min);
                    }
                }
                ([sum.policy_loss, sum.value_loss, sum.kl, sum.clipped], norm)
            };
            let critic_step = || {
                let sum = add_up(&mut critic_sums[..chunks]);
                finish(Part::Critic, sum, &mut critic_gradient);
                let norm = clip_norm(&mut critic_gradient, settings.critic_grad_norm);
                critic_adam.step(critic_parameters, &critic_gradient, learning_rate);
                (sum.value_loss, norm)
            };
            let (of_actor, of_critic) = workers.join(|| with_actor.then(actor_step), || with_critic.then(critic_step));
            if let Some(([policy_loss, value_loss, kl, clipped], norm)) = of_actor {
                stats.approx_kl = kl;
                if actor_count == 0.0 {
                    stats.first_kl = kl;
                }
                if let Some(norm) = norm {
                    learner.networks.load(Part::Actor, &learner.actor);
                    actor_count += 1.0;
                    stats.actor_grad_norm += f64::from(norm);
                    stats.policy_loss += policy_loss;
                    stats.clip_fraction += clipped;
                    if of_critic_len == 0 {
                        critic_count += 1.0;
                        stats.value_loss += value_loss;
                    }
                } else {
                    learning = false;
                }
            }
            if let Some((value_loss, norm)) = of_critic {
                learner.networks.load(Part::Critic, &learner.critic);
                critic_count += 1.0;
                stats.critic_grad_norm += f64::from(norm);
                stats.value_loss += value_loss;
            }
        }
        if !learning && (of_critic_len == 0 || epoch + 1 >= settings.critic_epochs) {
            break;
        }
    }
    learner.learning_rate = adapted(learning_rate, stats.approx_kl as f32, settings.kl_target);
    let (a, c) = (actor_count.max(1.0), critic_count.max(1.0));
    stats.policy_loss /= a;
    stats.clip_fraction /= a;
    stats.actor_grad_norm /= a;
    stats.value_loss /= c;
    stats.critic_grad_norm /= c;
    stats.actor_minibatches = actor_count as usize;
    let log_sigma = learner.networks.log_sigma();
    stats.entropy = log_sigma.iter().map(|l| f64::from(*l) + 1.418_938_533_204_672_7).sum();
    stats
}

/// Fisher and Yates's.
fn shuffle<T>(list: &mut [T], rng: &mut ChaCha8Rng) {
    for i in (1..list.len()).rev() {
        list.swap(i, rng.random_range(0..=i));
    }
}

/// Hands all ranks the sums over the chunks of each.
fn gather_from_ranks(actor: &mut [Gradient], critic: &mut [Gradient], ranks: &dyn Ranks) {
    let mut parcel = Parcel::default();
    for i in ranks.share(actor.len()) {
        parcel.gradient(&actor[i]);
        parcel.gradient(&critic[i]);
    }
    for (rank, bytes) in ranks.all_gather(parcel.bytes()).iter().enumerate().filter(|(rank, _)| *rank != ranks.rank()) {
        let mut opened = Opened::new(bytes);
        for i in ranks::share(actor.len(), rank, ranks.count()) {
            opened.gradient(&mut actor[i]);
            opened.gradient(&mut critic[i]);
        }
    }
}

/// Adds all up in the first, in order.
fn add_up(sums: &mut [Gradient]) -> &Gradient {
    let (first, others) = sums.split_at_mut(1);
    others.iter().for_each(|other| first[0].add(other));
    &first[0]
}

/// The learning rate after an update that moved the policy by `kl`: less if that was far above `target`, more if far below.
pub(crate) fn adapted(rate: f32, kl: f32, target: f32) -> f32 {
    let [low, high] = RATE_LIMITS;
    if target == 0.0 {
        rate
    } else if kl > 2.0 * target {
        (rate / RATE_FACTOR).max(low)
    } else if kl < 0.5 * target {
        (rate * RATE_FACTOR).min(high)
    } else {
        rate
    }
}

/// Mean of some numbers, and `epsilon` more than the standard deviation that they let expect of all such numbers.
fn of_sample<'a>(numbers: impl Iterator<Item = &'a f32> + Clone, epsilon: f64) -> [f32; 2] {
    let n = numbers.clone().count() as f64;
    let mean = numbers.clone().map(|a| f64::from(*a)).sum::<f64>() / n.max(1.0);
    let variance = numbers.map(|a| (f64::from(*a) - mean).powi(2)).sum::<f64>() / (n - 1.0).max(1.0);
    [mean as f32, (variance.sqrt() + epsilon) as f32]
}

/// Gives all advantages mean 0 and standard deviation 1.
fn standardise(decisions: &mut [Decisions], epsilon: f64) {
    let n = decisions.iter().map(|d| d.advantages.len()).sum::<usize>().max(1) as f64;
    let all = || decisions.iter().flat_map(|d| d.advantages.iter().map(|a| f64::from(*a)));
    let mean = all().sum::<f64>() / n;
    let std = (all().map(|a| (a - mean) * (a - mean)).sum::<f64>() / n).sqrt();
    for decisions in decisions {
        for advantage in &mut decisions.advantages {
            *advantage = ((f64::from(*advantage) - mean) / (std + epsilon)) as f32;
        }
        for own in &mut decisions.own {
            *own = (f64::from(*own) / (std + epsilon)) as f32;
        }
    }
}
