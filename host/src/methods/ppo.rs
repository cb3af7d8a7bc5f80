//! The update of PPO: values, advantages, then epochs of minibatches, each split over the threads.
//!
//! Sums are taken over chunks of fixed size in a fixed order, so the result does not depend on the number of threads.

use std::sync::Mutex;

use rand::RngExt;

use super::actor_critic::{ActorLayout, Batch, CriticLayout, Gradient, PpoLoss};
use super::buffer::{Lane, gather, gather_finals};
use super::normalise::ValueNorm;
use super::{Adam, Method, Stream, clip_norm, stream};

/// Samples (steps of one environment) in one graph of tensors: small enough that a graph stays in the cache of a core, large enough
/// that the overhead of a tensor operation does not count.
pub const CHUNK: usize = 64;

/// Settings of the update. See [`crate::train::TrainConfig`], where they are documented and checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PpoSettings {
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
    /// Limit of the actor's gradient norm.
    pub actor_grad_norm: f32,
    /// Limit of the critic's gradient norm.
    pub critic_grad_norm: f32,
}

/// Everything that is learnt.
#[derive(Clone, Debug, PartialEq)]
pub struct Learner {
    /// The actor's parameters.
    pub actor: Vec<f32>,
    /// The critic's parameters.
    pub critic: Vec<f32>,
    /// The actor's optimiser.
    pub actor_adam: Adam,
    /// The critic's optimiser.
    pub critic_adam: Adam,
    /// Scale of the critic.
    pub value_norm: ValueNorm,
}

impl Learner {
    /// A learner that has learnt nothing.
    pub fn new(method: Method, run_seed: u64, sigma: f32, adam_epsilon: f32) -> Self {
        let actor = ActorLayout::new(method).initial(run_seed, sigma);
        let critic = CriticLayout::default().initial(run_seed);
        Self {
            actor_adam: Adam::new(actor.len(), adam_epsilon),
            critic_adam: Adam::new(critic.len(), adam_epsilon),
            actor,
            critic,
            value_norm: ValueNorm::default(),
        }
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
    /// Largest difference of a ratio from 1 on the very first minibatch: rounding only, or rollout and update disagree.
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

/// Applies `task` to every element of `items` on `threads` threads; results in the order of the items.
pub(crate) fn parallel<T: Sync, R: Send>(items: &[T], threads: usize, task: impl Fn(&T) -> R + Sync) -> Vec<R> {
    let next = Mutex::new(0..items.len());
    let worker = || {
        let mut done = Vec::new();
        loop {
            let index = next.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).next();
            let Some(index) = index else { return done };
            done.push((index, task(&items[index])));
        }
    };
    let mut done = std::thread::scope(|scope| {
        let others: Vec<_> = (1..threads.clamp(1, items.len().max(1))).map(|_| scope.spawn(worker)).collect();
        let mut done = worker();
        for other in others {
            match other.join() {
                Ok(more) => done.extend(more),
                Err(panic) => std::panic::resume_unwind(panic),
            }
        }
        done
    });
    done.sort_by_key(|(index, _)| *index);
    done.into_iter().map(|(_, result)| result).collect()
}

/// All (lane, step) pairs, in order.
fn all_samples(lanes: &[Lane]) -> Vec<(u32, u32)> {
    lanes.iter().enumerate().flat_map(|(l, lane)| (0..lane.steps()).map(move |t| (l as u32, t as u32))).collect()
}

/// Fills in the advantages and returns of all lanes. Returns the explained variance.
pub fn estimate_advantages(lanes: &mut [Lane], learner: &Learner, settings: &PpoSettings, threads: usize) -> f64 {
    let layout = CriticLayout::default();
    let norm = learner.value_norm;
    let values = parallel(lanes, threads, |lane| {
        let samples: Vec<_> = (0..lane.steps()).map(|t| (0, t as u32)).collect();
        let values = |batch: &Batch| -> Vec<f32> {
            layout.values(&learner.critic, batch).into_iter().map(|v| norm.denormalise(v)).collect()
        };
        let steps = values(&gather(std::slice::from_ref(lane), &samples, lane.modules, 0.0, |r| r));
        (steps, values(&gather_finals(lane)))
    });
    let (mut n, mut sum, mut square, mut error, mut error_square) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for (lane, (values, finals)) in lanes.iter_mut().zip(&values) {
        lane.estimate(values, finals, settings.gamma, settings.lambda);
        for (value, target) in values.iter().zip(&lane.returns) {
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

/// One iteration's learning from `lanes`.
pub fn update(
    learner: &mut Learner,
    method: Method,
    lanes: &mut [Lane],
    settings: &PpoSettings,
    learning_rate: f32,
    (run_seed, iteration): (u64, u64),
    threads: usize,
) -> UpdateStats {
    let mut stats =
        UpdateStats { explained_variance: estimate_advantages(lanes, learner, settings, threads), ..Default::default() };
    let (actor, critic) = (ActorLayout::new(method), CriticLayout::default());
    standardise(lanes);

    let returns: Vec<f32> = lanes.iter().flat_map(|lane| lane.returns.iter().copied()).collect();
    let before = [learner.value_norm.mean(), learner.value_norm.std()];
    learner.value_norm.update(&returns);
    critic.rescale(&mut learner.critic, before, [learner.value_norm.mean(), learner.value_norm.std()]);
    let norm = learner.value_norm;

    let lanes = &*lanes;
    let modules = lanes.iter().map(|lane| lane.modules).max().unwrap_or(0);
    let mut samples = all_samples(lanes);
    let size = samples.len().div_ceil(settings.minibatches).max(1);
    let loss = PpoLoss { clip: settings.clip };
    let mut learning = true;
    let (mut actor_count, mut critic_count) = (0.0f64, 0.0f64);
    for epoch in 0..settings.epochs.max(settings.critic_epochs) {
        let mut rng = stream(run_seed, Stream::Shuffle, iteration, epoch as u64);
        for i in (1..samples.len()).rev() {
            samples.swap(i, rng.random_range(0..=i));
        }
        for minibatch in samples.chunks(size) {
            let with_actor = learning && epoch < settings.epochs;
            let with_critic = epoch < settings.critic_epochs;
            if !with_actor && !with_critic {
                continue;
            }
            let acting: usize = minibatch
                .iter()
                .map(|(l, t)| {
                    let lane = &lanes[*l as usize];
                    let first = *t as usize * lane.modules;
                    lane.acts[first..first + lane.modules].iter().filter(|acts| **acts).count()
                })
                .sum();
            let weight = 1.0 / acting.max(1) as f32;
            let chunks: Vec<_> = minibatch.chunks(CHUNK).collect();
            let gradients = parallel(&chunks, threads, |chunk| {
                let batch = gather(lanes, chunk, modules, weight, |r| norm.normalise(r));
                let of_actor = if with_actor { actor.gradient(&learner.actor, &batch, loss) } else { Gradient::default() };
                let of_critic = if with_critic {
                    critic.gradient(&learner.critic, &batch, 1.0 / minibatch.len() as f32)
                } else {
                    Gradient::default()
                };
                (of_actor, of_critic)
            });
            let (mut of_actor, mut of_critic) = (Gradient::default(), Gradient::default());
            for (a, c) in &gradients {
                of_actor.add(a);
                of_critic.add(c);
            }
            if with_actor {
                stats.approx_kl = of_actor.kl;
                if actor_count == 0.0 {
                    stats.first_kl = of_actor.kl;
                }
                if of_actor.kl > f64::from(settings.kl_stop) {
                    learning = false;
                } else {
                    // The entropy of a normal distribution is ln sigma and a constant.
                    of_actor.gradient[actor.log_sigma.range()].iter_mut().for_each(|g| *g -= settings.entropy);
                    let norm = clip_norm(&mut of_actor.gradient, settings.actor_grad_norm);
                    learner.actor_adam.step(&mut learner.actor, &of_actor.gradient, learning_rate);
                    actor_count += 1.0;
                    stats.actor_grad_norm += f64::from(norm);
                    stats.policy_loss += of_actor.loss;
                    stats.clip_fraction += of_actor.clipped;
                }
            }
            if with_critic {
                let norm = clip_norm(&mut of_critic.gradient, settings.critic_grad_norm);
                learner.critic_adam.step(&mut learner.critic, &of_critic.gradient, learning_rate);
                critic_count += 1.0;
                stats.critic_grad_norm += f64::from(norm);
                stats.value_loss += of_critic.loss;
            }
        }
        if !learning && epoch + 1 >= settings.critic_epochs {
            break;
        }
    }
    let (a, c) = (actor_count.max(1.0), critic_count.max(1.0));
    stats.policy_loss /= a;
    stats.clip_fraction /= a;
    stats.actor_grad_norm /= a;
    stats.value_loss /= c;
    stats.critic_grad_norm /= c;
    stats.actor_minibatches = actor_count as usize;
    let log_sigma = &learner.actor[actor.log_sigma.range()];
    stats.entropy = log_sigma.iter().map(|l| f64::from(*l) + 1.418_938_533_204_672_7).sum();
    stats
}

/// Gives the advantages of a batch mean 0 and standard deviation 1.
fn standardise(lanes: &mut [Lane]) {
    let n = lanes.iter().map(Lane::steps).sum::<usize>().max(1) as f64;
    let all = || lanes.iter().flat_map(|lane| lane.advantages.iter().map(|a| f64::from(*a)));
    let mean = all().sum::<f64>() / n;
    let std = (all().map(|a| (a - mean) * (a - mean)).sum::<f64>() / n).sqrt();
    for lane in lanes {
        for advantage in &mut lane.advantages {
            *advantage = ((f64::from(*advantage) - mean) / (std + 1e-8)) as f32;
        }
    }
}
