//! The update of PPO: values, advantages, then epochs of minibatches, each split over the threads.
//!
//! Sums are taken over chunks of fixed size in a fixed order, so the result does not depend on the number of threads.

use composer_shared::observation::SIZE;
use rand::RngExt;

use super::actor::{Actor, ActorScratch};
use super::actor_critic::{ActorLayout, Batch, CriticLayout, Gradient, PpoLoss};
use super::buffer::{Lane, Track, gather};
use super::critic::{Critic, CriticScratch};
use super::normalise::ValueNorm;
use super::{Adam, Differentiation, Stream, Workers, clip_norm, stream};
use crate::environment::PRIVILEGED;

/// Samples (steps of one environment) that one thread takes at a time.
const CHUNK: usize = 64;
/// Samples that go through a network together: few enough that what its layers put out stays in the cache of a core.
const BLOCK: usize = 16;
/// The adaptive learning rate changes by this factor and stays within these limits (as in rsl_rl).
const RATE_FACTOR: f32 = 1.5;
/// Limits of the adaptive learning rate.
pub const RATE_LIMITS: [f32; 2] = [1e-5, 1e-2];

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
    /// KL divergence that the learning rate is adapted to; 0 leaves it alone.
    pub kl_target: f32,
    /// Least standard deviation of an action.
    pub sigma_min: f32,
    /// Who computes the gradients.
    pub gradient: Differentiation,
}

/// One policy with its critic: everything that is learnt of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Learner {
    /// Where things are in the actor's parameters.
    pub layout: ActorLayout,
    /// Seed of its random streams.
    pub seed: u64,
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
    /// Learning rate of the next update, if it is adapted.
    pub learning_rate: f32,
}

impl Learner {
    /// A learner that has learnt nothing; `sigma` is the standard deviation of the actions at the start, `value_gain` the gain of the
    /// critic's output.
    pub fn new(
        layout: ActorLayout,
        seed: u64,
        sigma: f32,
        value_gain: f32,
        adam_epsilon: f32,
        learning_rate: f32,
    ) -> Self {
        let actor = layout.initial(seed, sigma);
        let critic = CriticLayout::default().initial(seed, value_gain);
        Self {
            layout,
            seed,
            actor_adam: Adam::new(actor.len(), adam_epsilon),
            critic_adam: Adam::new(critic.len(), adam_epsilon),
            actor,
            critic,
            value_norm: ValueNorm::default(),
            learning_rate,
        }
    }

    /// Standard deviation of the actions as it is now, mean over their dimensions.
    pub fn sigma(&self) -> f64 {
        let log_sigma = &self.actor[self.layout.log_sigma.range()];
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
#[derive(Debug)]
pub struct Workspace {
    /// The threads.
    pub workers: Workers,
    /// One a thread.
    scratch: Vec<Scratch>,
    /// The sum over each chunk of a minibatch: the actor's, then the critic's.
    actor: Vec<Gradient>,
    critic: Vec<Gradient>,
}

impl Workspace {
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

#[derive(Debug, Default)]
struct Scratch {
    batch: Batch,
    actor: ActorScratch,
    critic: CriticScratch,
    modules: Vec<usize>,
}

/// All (lane, step) pairs, in order.
fn all_samples(lanes: &[Lane]) -> Vec<(u32, u32)> {
    lanes.iter().enumerate().flat_map(|(l, lane)| (0..lane.steps()).map(move |t| (l as u32, t as u32))).collect()
}

/// What the critic says of views of teams of `modules` modules on the reward's scale: `[view][module][SIZE]` and
/// `[view][module][PRIVILEGED]`.
fn values(
    critic: &Critic,
    norm: ValueNorm,
    modules: usize,
    observations: &[f32],
    privileged: &[f32],
    scratch: &mut Scratch,
) -> Vec<f32> {
    let mut values = Vec::with_capacity(observations.len() / (modules * SIZE));
    let blocks = observations.chunks(BLOCK * modules * SIZE).zip(privileged.chunks(BLOCK * modules * PRIVILEGED));
    for (observations, privileged) in blocks {
        scratch.modules.clear();
        scratch.modules.resize(observations.len() / (modules * SIZE), modules);
        let block = critic.values(observations, privileged, &scratch.modules, &mut scratch.critic);
        values.extend(block.iter().map(|value| norm.denormalise(*value)));
    }
    values
}

/// Fills in the advantages and returns of all tracks. Returns the explained variance.
pub fn estimate_advantages<const A: usize>(
    lanes: &[Lane],
    tracks: &mut [Track<A>],
    learner: &Learner,
    settings: &PpoSettings,
    workspace: &mut Workspace,
) -> f64 {
    let critic = Critic::new(&learner.critic);
    let norm = learner.value_norm;
    let mut all = vec![[Vec::new(), Vec::new()]; lanes.len()];
    let Workspace { workers, scratch, .. } = workspace;
    workers.for_each(lanes.iter().zip(&mut all), scratch, |(lane, [steps, finals]), scratch| {
        *steps = values(&critic, norm, lane.modules, &lane.observations, &lane.privileged, scratch);
        *finals = values(&critic, norm, lane.modules, &lane.final_observations, &lane.final_privileged, scratch);
    });
    let (mut n, mut sum, mut square, mut error, mut error_square) = (0.0, 0.0, 0.0, 0.0, 0.0);
    for ((lane, track), [values, finals]) in lanes.iter().zip(&mut *tracks).zip(&all) {
        track.estimate(lane, values, finals, settings.gamma, settings.lambda);
        for (value, target) in values.iter().zip(&track.returns) {
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

/// One iteration's learning of one policy from `lanes` and what it did in them.
pub fn update<const A: usize>(
    learner: &mut Learner,
    lanes: &[Lane],
    tracks: &mut [Track<A>],
    settings: &PpoSettings,
    learning_rate: f32,
    iteration: u64,
    workspace: &mut Workspace,
) -> UpdateStats {
    let workers = workspace.workers.clone();
    workers.enter(|| update_within(learner, lanes, tracks, settings, learning_rate, iteration, workspace))
}

fn update_within<const A: usize>(
    learner: &mut Learner,
    lanes: &[Lane],
    tracks: &mut [Track<A>],
    settings: &PpoSettings,
    learning_rate: f32,
    iteration: u64,
    workspace: &mut Workspace,
) -> UpdateStats {
    let mut stats = UpdateStats {
        explained_variance: estimate_advantages(lanes, tracks, learner, settings, workspace),
        ..Default::default()
    };
    let (actor_layout, critic_layout) = (learner.layout, CriticLayout::default());
    standardise(tracks);

    let returns: Vec<f32> = tracks.iter().flat_map(|track| track.returns.iter().copied()).collect();
    let before = [learner.value_norm.mean(), learner.value_norm.std()];
    learner.value_norm.update(&returns);
    critic_layout.rescale(&mut learner.critic, before, [learner.value_norm.mean(), learner.value_norm.std()]);
    let norm = learner.value_norm;

    let tracks = &*tracks;
    let mut samples = all_samples(lanes);
    let size = samples.len().div_ceil(settings.minibatches).max(1);
    let chunk_count = size.div_ceil(CHUNK);
    let Workspace { workers, scratch, actor: actor_sums, critic: critic_sums } = workspace;
    actor_sums.resize_with(chunk_count, Gradient::default);
    critic_sums.resize_with(chunk_count, Gradient::default);
    let loss = PpoLoss { clip: settings.clip };
    let mut actor = Actor::new(actor_layout, &learner.actor);
    let mut critic = Critic::new(&learner.critic);
    let (mut actor_gradient, mut critic_gradient) = (Vec::new(), Vec::new());
    let mut learning = true;
    let (mut actor_count, mut critic_count) = (0.0f64, 0.0f64);
    for epoch in 0..settings.epochs.max(settings.critic_epochs) {
        let mut rng = stream(learner.seed, Stream::Shuffle, iteration, epoch as u64);
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
            let value_weight = 1.0 / minibatch.len() as f32;
            let chunks = minibatch.chunks(CHUNK).zip(actor_sums.iter_mut().zip(critic_sums.iter_mut()));
            workers.for_each(chunks, scratch, |(chunk, (of_actor, of_critic)), scratch| {
                of_actor.clear(actor_layout.len);
                of_critic.clear(critic_layout.len);
                let Scratch { batch, actor: actor_scratch, critic: critic_scratch, .. } = scratch;
                let gathered = |samples: &[(u32, u32)], batch: &mut Batch| {
                    gather((lanes, tracks), samples, weight, |r| norm.normalise(r), batch);
                };
                match settings.gradient {
                    Differentiation::Manual => {
                        for block in chunk.chunks(BLOCK) {
                            gathered(block, batch);
                            if with_actor {
                                actor.gradient(batch, loss, actor_scratch, of_actor);
                            }
                            if with_critic {
                                critic.gradient(batch, value_weight, critic_scratch, of_critic);
                            }
                        }
                    }
                    Differentiation::Automatic => {
                        gathered(chunk, batch);
                        if with_actor {
                            *of_actor = actor_layout.autodiff(actor.parameters(), batch, loss);
                        }
                        if with_critic {
                            *of_critic = critic_layout.autodiff(critic.parameters(), batch, value_weight);
                        }
                    }
                }
            });
            let chunks = minibatch.len().div_ceil(CHUNK);
            let ordered = settings.gradient == Differentiation::Automatic;
            let Learner { actor: parameters, critic: critic_parameters, actor_adam, critic_adam, .. } = learner;
            let actor_step = || {
                let sum = add_up(&mut actor_sums[..chunks]);
                let [loss, kl, clipped] = [sum.loss, sum.kl, sum.clipped];
                let mut norm = None;
                if kl <= f64::from(settings.kl_stop) {
                    actor.finish(&sum.gradient, ordered, &mut actor_gradient);
                    let log_sigma = actor_layout.log_sigma.range();
                    // The entropy of a normal distribution is ln sigma and a constant.
                    actor_gradient[log_sigma.clone()].iter_mut().for_each(|g| *g -= settings.entropy);
                    norm = Some(clip_norm(&mut actor_gradient, settings.actor_grad_norm));
                    actor_adam.step(parameters, &actor_gradient, learning_rate);
                    if settings.sigma_min > 0.0 {
                        let least = settings.sigma_min.ln();
                        parameters[log_sigma].iter_mut().for_each(|l| *l = l.max(least));
                    }
                    actor.load(parameters);
                }
                (loss, kl, clipped, norm)
            };
            let critic_step = || {
                let sum = add_up(&mut critic_sums[..chunks]);
                critic.finish(&sum.gradient, ordered, &mut critic_gradient);
                let norm = clip_norm(&mut critic_gradient, settings.critic_grad_norm);
                critic_adam.step(critic_parameters, &critic_gradient, learning_rate);
                critic.load(critic_parameters);
                (sum.loss, norm)
            };
            let (of_actor, of_critic) = workers.join(|| with_actor.then(actor_step), || with_critic.then(critic_step));
            if let Some((loss, kl, clipped, norm)) = of_actor {
                stats.approx_kl = kl;
                if actor_count == 0.0 {
                    stats.first_kl = kl;
                }
                if let Some(norm) = norm {
                    actor_count += 1.0;
                    stats.actor_grad_norm += f64::from(norm);
                    stats.policy_loss += loss;
                    stats.clip_fraction += clipped;
                } else {
                    learning = false;
                }
            }
            if let Some((loss, norm)) = of_critic {
                critic_count += 1.0;
                stats.critic_grad_norm += f64::from(norm);
                stats.value_loss += loss;
            }
        }
        if !learning && epoch + 1 >= settings.critic_epochs {
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
    let log_sigma = &learner.actor[actor_layout.log_sigma.range()];
    stats.entropy = log_sigma.iter().map(|l| f64::from(*l) + 1.418_938_533_204_672_7).sum();
    stats
}

/// Adds all up in the first, in order.
fn add_up(sums: &mut [Gradient]) -> &Gradient {
    let (first, others) = sums.split_at_mut(1);
    others.iter().for_each(|other| first[0].add(other));
    &first[0]
}

/// The learning rate after an update that moved the policy by `kl`: less if that was far above `target`, more if far below.
fn adapted(rate: f32, kl: f32, target: f32) -> f32 {
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

/// Gives the advantages of a batch mean 0 and standard deviation 1.
fn standardise<const A: usize>(tracks: &mut [Track<A>]) {
    let n = tracks.iter().map(|track| track.advantages.len()).sum::<usize>().max(1) as f64;
    let all = || tracks.iter().flat_map(|track| track.advantages.iter().map(|a| f64::from(*a)));
    let mean = all().sum::<f64>() / n;
    let std = (all().map(|a| (a - mean) * (a - mean)).sum::<f64>() / n).sqrt();
    for track in tracks {
        for advantage in &mut track.advantages {
            *advantage = ((f64::from(*advantage) - mean) / (std + 1e-8)) as f32;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::{Environment, Told, Trivial};
    use crate::methods::Method;
    use crate::methods::actor_critic::{OUT, log_probability};
    use crate::methods::buffer::Experience;
    use crate::methods::imagination::{DISPLACEMENT, Imagination};
    use crate::methods::normalise::Running;
    use crate::methods::rollout::{Frozen, Iteration, Slot, collect};

    /// Learners with policies that are not the initial ones, and a rollout of theirs with teams of different sizes, one of which has a
    /// dead module.
    struct Rollout {
        control: Learner,
        imagination: Learner,
        experience: Experience,
    }

    fn rollout(method: Method) -> Rollout {
        let mut control = Learner::new(ActorLayout::control(method), 5, 0.45, 1.0, 1e-5, 1e-3);
        let mut imagination = Learner::new(ActorLayout::imagination(), 6, 0.45, 1.0, 1e-5, 1e-3);
        let mut rng = stream(9, Stream::Weights, 7, 7);
        for learner in [&mut control, &mut imagination] {
            learner.actor.iter_mut().chain(&mut learner.critic).for_each(|p| *p += 0.3 * (rng.random::<f32>() - 0.5));
        }
        let teams: [Box<dyn Environment>; 3] = [
            Box::new(Trivial::new(4, Told::Head)),
            Box::new(Trivial::new(3, Told::All)),
            Box::new(Trivial::new(5, Told::Head).with_dead(2)),
        ];
        let mut slots: Vec<_> = teams.into_iter().enumerate().map(|(i, team)| Slot::new(team, i, 5)).collect();
        let mut experience = Experience::new(3);
        let (mut observations, mut privileged) = (Running::new(SIZE), Running::new(crate::environment::PRIVILEGED));
        let imagined_by = Actor::new(imagination.layout, &imagination.actor);
        let iteration = Iteration {
            policy: &Actor::new(control.layout, &control.actor),
            imagination: Some(Imagination { policy: &imagined_by, seed: imagination.seed, bound: 0.5, follow: 0.25 }),
            observations: Frozen::new(&observations),
            privileged: Frozen::new(&privileged),
            run_seed: 5,
            iteration: 0,
            steps: 16,
        };
        collect(&mut slots, &mut experience, iteration, &Workers::new(2).unwrap(), &mut observations, &mut privileged);
        Rollout { control, imagination, experience }
    }

    const SETTINGS: PpoSettings = PpoSettings {
        minibatches: 2,
        epochs: 2,
        critic_epochs: 2,
        gamma: 0.9,
        lambda: 0.9,
        clip: 0.2,
        kl_stop: 1.0,
        entropy: 0.0,
        actor_grad_norm: 0.5,
        critic_grad_norm: 1.0,
        kl_target: 0.0,
        sigma_min: 0.0,
        gradient: Differentiation::Manual,
    };

    fn batch_of<const A: usize>(
        lanes: &[Lane],
        tracks: &[Track<A>],
        samples: &[(u32, u32)],
        weight: f32,
        target: impl Fn(f32) -> f32,
    ) -> Batch {
        let mut batch = Batch::default();
        gather((lanes, tracks), samples, weight, target, &mut batch);
        batch
    }

    fn means(layout: ActorLayout, parameters: &[f32], batch: &Batch) -> Vec<f32> {
        let mut scratch = ActorScratch::default();
        Actor::new(layout, parameters).means(&batch.observations, &batch.heard, &batch.modules, &mut scratch).to_vec()
    }

    fn critic_values(parameters: &[f32], batch: &Batch) -> Vec<f32> {
        let mut scratch = CriticScratch::default();
        Critic::new(parameters).values(&batch.observations, &batch.privileged, &batch.modules, &mut scratch).to_vec()
    }

    fn actor_gradient(layout: ActorLayout, parameters: &[f32], batch: &Batch) -> Gradient {
        let (mut sum, mut ordered) = (Gradient::default(), Vec::new());
        sum.clear(layout.len);
        let actor = Actor::new(layout, parameters);
        actor.gradient(batch, PpoLoss { clip: 0.2 }, &mut ActorScratch::default(), &mut sum);
        actor.finish(&sum.gradient, false, &mut ordered);
        Gradient { gradient: ordered, ..sum }
    }

    fn critic_gradient(parameters: &[f32], batch: &Batch, weight: f32) -> Gradient {
        let (mut sum, mut ordered) = (Gradient::default(), Vec::new());
        sum.clear(parameters.len());
        let critic = Critic::new(parameters);
        critic.gradient(batch, weight, &mut CriticScratch::default(), &mut sum);
        critic.finish(&sum.gradient, false, &mut ordered);
        Gradient { gradient: ordered, ..sum }
    }

    fn ratio_is_one<const A: usize>(name: &str, learner: &Learner, lanes: &[Lane], tracks: &[Track<A>]) {
        let batch = batch_of(lanes, tracks, &all_samples(lanes), 1.0, |r| r);
        let layout = learner.layout;
        let means = means(layout, &learner.actor, &batch);
        let log_sigma = std::array::from_fn(|i| learner.actor[layout.log_sigma.offset + i]);
        let mut checked = 0;
        for (row, weight) in batch.weights.iter().enumerate() {
            if *weight > 0.0 {
                let vector = |v: &[f32]| -> [f32; A] { std::array::from_fn(|i| v[row * A + i]) };
                let new = log_probability(vector(&batch.actions), vector(&means), log_sigma);
                let ratio = (new - batch.log_probabilities[row]).exp();
                assert!((ratio - 1.0).abs() < 1e-4, "{name} row {row}: {ratio}");
                checked += 1;
            }
        }
        assert_eq!(checked, 16 * (4 + 3 + 4));
        // The same seen from the loss: no divergence, nothing clipped.
        let first = actor_gradient(layout, &learner.actor, &batch);
        assert!(first.kl.abs() < 1e-6 && first.clipped == 0.0, "{first:?}");
    }

    #[test]
    fn ratio_is_one_on_the_first_minibatch_with_masks_and_padding() {
        for method in Method::ALL {
            let Rollout { control, imagination, experience } = rollout(method);
            ratio_is_one(method.name(), &control, &experience.lanes, &experience.control);
            ratio_is_one("imagination", &imagination, &experience.lanes, &experience.imagination);
        }
    }

    #[test]
    fn the_control_policy_pays_for_not_following() {
        let Experience { lanes, control, imagination } = rollout(Method::Composer).experience;
        for ((lane, control), imagination) in lanes.iter().zip(&control).zip(&imagination) {
            assert_eq!((lane.follow_errors.len(), imagination.rewards.len()), (16, 16));
            for (step, error) in lane.follow_errors.iter().enumerate() {
                // Modules of this team never move: the error is how long the displacement was, on average over those that act.
                let at = step * lane.modules..(step + 1) * lane.modules;
                let acting =
                    || imagination.actions[at.clone()].iter().zip(&lane.acts[at.clone()]).filter(|(_, acts)| **acts);
                let lengths = acting().map(|(u, _)| 0.5 * u.iter().map(|x| x * x).sum::<f32>().sqrt().min(1.0));
                let expected = lengths.sum::<f32>() / acting().count() as f32;
                assert!((error - expected).abs() < 1e-5, "{error} {expected}");
                assert_eq!(control.rewards[step], lane.rewards[step] - 0.25 * error);
            }
        }
    }

    #[test]
    fn attention_needs_the_masks_of_the_rollout() {
        let Rollout { control: learner, experience: Experience { lanes, control: tracks, .. }, .. } =
            rollout(Method::ComposerNoImagination);
        let mut batch = batch_of(&lanes, &tracks, &all_samples(&lanes), 1.0, |r| r);
        let layout = learner.layout;
        let right = means(layout, &learner.actor, &batch);
        // A team acts the same alone as among others, bit for bit ...
        let alone = batch_of(&lanes[1..2], &tracks[1..2], &[(0, 3)], 1.0, |r| r);
        let at = OUT * (16 * 4 + 3 * 3);
        assert_eq!(means(layout, &learner.actor, &alone), right[at..at + OUT * 3]);
        // ... but who hears whom must.
        batch.heard.iter_mut().for_each(|heard| *heard = 0b11111);
        let wrong = means(layout, &learner.actor, &batch);
        assert!(right.iter().zip(&wrong).any(|(a, b)| (a - b).abs() > 1e-3));
    }

    /// A batch whose ratios lie on both sides of the clip, with advantages of both signs.
    fn shaken<const A: usize>(lanes: &[Lane], tracks: &mut [Track<A>]) -> Batch {
        let mut rng = stream(3, Stream::Shuffle, 0, 0);
        for (lane, track) in lanes.iter().zip(&mut *tracks) {
            track.advantages = (0..lane.steps()).map(|_| rng.random_range(-1.0..1.0)).collect();
            track.returns = (0..lane.steps()).map(|_| rng.random_range(-1.0..1.0)).collect();
            // Ratios of 0.67, 0.9, 1.1 and 1.5: none so near the edges of the clip that a small step crosses one.
            let offsets = [-0.4, -0.1, 0.1, 0.4];
            track.log_probabilities.iter_mut().for_each(|l| *l += offsets[rng.random_range(0..4)]);
        }
        batch_of(lanes, tracks, &all_samples(lanes), 1.0 / 176.0, |r| 0.5 * r)
    }

    /// Compares a gradient with central differences of the loss, along each of some single parameters and along the gradient.
    fn against_differences(
        parameters: &[f32],
        gradient: &[f32],
        loss: impl Fn(&[f32]) -> f64,
        blocks: &[crate::methods::Block],
    ) {
        let slope = |direction: &dyn Fn(usize) -> f32, h: f32| {
            let moved = |sign: f32| -> Vec<f32> {
                parameters.iter().enumerate().map(|(i, p)| p + sign * h * direction(i)).collect()
            };
            (loss(&moved(1.0)) - loss(&moved(-1.0))) / (2.0 * f64::from(h))
        };
        for block in blocks.iter().filter(|block| !block.is_empty()) {
            // Along the gradient of this block: the slope is its norm.
            let norm = gradient[block.range()].iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
            assert!(norm > 1e-5, "{} has no gradient", block.name);
            let inside = |i: usize| if block.range().contains(&i) { gradient[i] / norm as f32 } else { 0.0 };
            let along = slope(&inside, 4e-3);
            assert!((along - norm).abs() < 0.03 * norm + 2e-4, "{}: norm {norm}, slope {along}", block.name);
            // And at its largest single parameter.
            let largest = block.range().max_by(|a, b| gradient[*a].abs().total_cmp(&gradient[*b].abs())).unwrap();
            let single = slope(&|i| if i == largest { 1.0 } else { 0.0 }, 1e-2);
            let expected = f64::from(gradient[largest]);
            assert!(
                (single - expected).abs() < 0.05 * expected.abs() + 2e-4,
                "{}: {expected}, slope {single}",
                block.name
            );
        }
    }

    fn clipped_loss<const A: usize>(learner: &Learner, batch: &Batch) {
        let layout = learner.layout;
        // The loss again, in double precision and from its formula.
        let loss = |parameters: &[f32]| -> f64 {
            let means = means(layout, parameters, batch);
            let log_sigma = std::array::from_fn(|i| parameters[layout.log_sigma.offset + i]);
            let mut sum = 0.0;
            let advantages = batch.advantages.iter().zip(&batch.modules);
            let mut advantages = advantages.flat_map(|(advantage, n)| std::iter::repeat_n(f64::from(*advantage), *n));
            for row in 0..batch.weights.len() {
                let vector = |v: &[f32]| -> [f32; A] { std::array::from_fn(|i| v[row * A + i]) };
                let new = log_probability(vector(&batch.actions), vector(&means), log_sigma);
                let ratio = f64::from(new - batch.log_probabilities[row]).exp();
                let advantage = advantages.next().unwrap();
                let gain = (ratio * advantage).min(ratio.clamp(0.8, 1.2) * advantage);
                sum -= gain * f64::from(batch.weights[row]);
            }
            sum
        };
        let result = actor_gradient(layout, &learner.actor, batch);
        assert!((result.loss - loss(&learner.actor)).abs() < 1e-5);
        assert!(result.clipped > 0.1 && result.clipped < 0.9, "{}", result.clipped);
        against_differences(&learner.actor, &result.gradient, loss, &layout.blocks());
    }

    #[test]
    fn the_gradient_of_the_clipped_loss_is_its_slope() {
        // With attention and without.
        for method in [Method::Composer, Method::Mappo] {
            let Rollout {
                control,
                imagination,
                experience: Experience { lanes, control: mut of_control, imagination: mut of_imagination },
            } = rollout(method);
            clipped_loss::<OUT>(&control, &shaken(&lanes, &mut of_control));
            clipped_loss::<DISPLACEMENT>(&imagination, &shaken(&lanes, &mut of_imagination));
        }
    }

    /// Some critic, and a batch.
    fn critic() -> (Vec<f32>, Batch) {
        let Rollout { control, experience: Experience { lanes, control: mut tracks, .. }, .. } = rollout(Method::Mappo);
        (control.critic, shaken(&lanes, &mut tracks))
    }

    #[test]
    fn the_gradient_of_the_value_loss_is_its_slope() {
        let (critic, batch) = critic();
        let layout = CriticLayout::default();
        let loss = |parameters: &[f32]| -> f64 {
            let values = critic_values(parameters, &batch);
            values.iter().zip(&batch.targets).map(|(v, t)| 0.25 * f64::from(v - t).powi(2)).sum()
        };
        let result = critic_gradient(&critic, &batch, 0.5);
        assert!((result.loss - loss(&critic)).abs() < 1e-4);
        against_differences(&critic, &result.gradient, loss, &layout.blocks());
    }

    /// Largest difference between two gradients of the same loss by the largest number of the block it is in.
    fn same(name: &str, manual: &Gradient, automatic: &Gradient, blocks: &[crate::methods::Block]) {
        assert!((manual.loss - automatic.loss).abs() < 1e-5 * automatic.loss.abs().max(0.1), "{name}");
        assert!((manual.kl - automatic.kl).abs() < 1e-5 && (manual.clipped - automatic.clipped).abs() < 1e-6, "{name}");
        for block in blocks.iter().filter(|block| !block.is_empty()) {
            let (manual, automatic) = (&manual.gradient[block.range()], &automatic.gradient[block.range()]);
            let size = automatic.iter().fold(0.0f32, |size, g| size.max(g.abs()));
            let apart = manual.iter().zip(automatic).fold(0.0f32, |apart, (m, a)| apart.max((m - a).abs()));
            assert!(size > 0.0 && apart < 1e-4 * size, "{name} {}: {apart} of {size}", block.name);
        }
    }

    #[test]
    fn gradients_by_hand_are_those_of_automatic_differentiation() {
        for method in Method::ALL {
            let Rollout {
                control,
                imagination,
                experience: Experience { lanes, control: mut of_control, imagination: mut of_imagination },
            } = rollout(method);
            let batches =
                [(&control, shaken(&lanes, &mut of_control)), (&imagination, shaken(&lanes, &mut of_imagination))];
            for (learner, batch) in batches {
                let layout = learner.layout;
                let automatic = layout.autodiff(&learner.actor, &batch, PpoLoss { clip: 0.2 });
                let manual = actor_gradient(layout, &learner.actor, &batch);
                same(method.name(), &manual, &automatic, &layout.blocks());
                let layout = CriticLayout::default();
                let automatic = layout.autodiff(&learner.critic, &batch, 0.01);
                let manual = critic_gradient(&learner.critic, &batch, 0.01);
                same("critic", &manual, &automatic, &layout.blocks());
            }
        }
    }

    #[test]
    fn both_ways_to_the_gradient_learn_the_same() {
        let [manual, automatic] = [Differentiation::Manual, Differentiation::Automatic].map(|gradient| {
            let Rollout { mut control, mut experience, .. } = rollout(Method::Composer);
            let settings = PpoSettings { gradient, ..SETTINGS };
            let mut workspace = Workspace::new(2).unwrap();
            let (lanes, tracks) = (&experience.lanes, &mut experience.control);
            update(&mut control, lanes, tracks, &settings, 1e-3, 0, &mut workspace);
            control
        });
        let apart = |a: &[f32], b: &[f32]| a.iter().zip(b).fold(0.0f32, |apart, (a, b)| apart.max((a - b).abs()));
        assert!(apart(&manual.actor, &automatic.actor) < 2e-4);
        assert!(apart(&manual.critic, &automatic.critic) < 2e-4);
    }

    #[test]
    fn the_learning_rate_follows_the_divergence() {
        for (kl, expected) in [(0.021, 1e-3 / 1.5), (0.019, 1e-3), (0.006, 1e-3), (0.004, 1.5e-3)] {
            assert_eq!(adapted(1e-3, kl, 0.01), expected);
        }
        assert_eq!([adapted(1e-5, 1.0, 0.01), adapted(1e-2, 0.0, 0.01), adapted(1.0, 1.0, 0.0)], [1e-5, 1e-2, 1.0]);
        let Rollout { mut control, mut experience, .. } = rollout(Method::Mappo);
        let settings = PpoSettings { kl_target: 1.0, kl_stop: 10.0, ..SETTINGS };
        let mut workspace = Workspace::new(1).unwrap();
        update(&mut control, &experience.lanes, &mut experience.control, &settings, 1e-3, 0, &mut workspace);
        assert_eq!(control.learning_rate, 1.5e-3);
    }

    #[test]
    fn sigma_stays_above_its_least() {
        let Rollout { mut control, mut experience, .. } = rollout(Method::Mappo);
        let settings = PpoSettings { sigma_min: 0.6, ..SETTINGS };
        let mut workspace = Workspace::new(1).unwrap();
        update(&mut control, &experience.lanes, &mut experience.control, &settings, 1e-3, 0, &mut workspace);
        let log_sigma = &control.actor[control.layout.log_sigma.range()];
        assert!(log_sigma.iter().all(|l| *l >= 0.6f32.ln()), "{log_sigma:?}");
    }

    #[test]
    fn rescaling_the_critic_keeps_its_values() {
        let (mut critic, batch) = critic();
        let layout = CriticLayout::default();
        let before = critic_values(&critic, &batch);
        layout.rescale(&mut critic, [1.0, 2.0], [-3.0, 5.0]);
        let after = critic_values(&critic, &batch);
        for (before, after) in before.iter().zip(&after) {
            assert!((before * 2.0 + 1.0 - (after * 5.0 - 3.0)).abs() < 1e-4);
        }
    }

    #[test]
    fn an_update_does_not_depend_on_the_threads() {
        let results = [1, 2, 3].map(|threads| {
            let Rollout { mut control, mut imagination, mut experience } = rollout(Method::Composer);
            let Experience { lanes, control: of_control, imagination: of_imagination } = &mut experience;
            let mut workspace = Workspace::new(threads).unwrap();
            let stats = [
                update(&mut control, lanes, of_control, &SETTINGS, 1e-3, 0, &mut workspace),
                update(&mut imagination, lanes, of_imagination, &SETTINGS, 1e-3, 0, &mut workspace),
            ];
            (control, imagination, stats)
        });
        assert_eq!(results[0], results[1]);
        assert_eq!(results[0], results[2]);
        for stats in results[0].2 {
            assert_eq!(stats.actor_minibatches, 4);
            assert!(stats.first_kl.abs() < 1e-6, "{stats:?}");
        }
    }

    #[test]
    fn the_actor_stops_at_the_kl_limit() {
        let Rollout { control: mut learner, mut experience, .. } = rollout(Method::Mappo);
        let settings = PpoSettings { kl_stop: 1e-4, epochs: 10, ..SETTINGS };
        let mut workspace = Workspace::new(1).unwrap();
        let (lanes, tracks) = (&experience.lanes, &mut experience.control);
        let stats = update(&mut learner, lanes, tracks, &settings, 1e-2, 0, &mut workspace);
        assert!(stats.actor_minibatches < 20 && stats.approx_kl > 1e-4, "{stats:?}");
        assert_eq!(learner.critic_adam.steps, 4);
        assert_eq!(learner.actor_adam.steps, stats.actor_minibatches as u64);
    }
}
