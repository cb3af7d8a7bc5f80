//! The networks of COMPOSER in rollouts and updates: gradients against slopes and against automatic differentiation, ratios, threads.

use composer_shared::observation::{BASE, SIZE};
use composer_shared::policy::{MEMORY, distance_bucket};
use rand::RngExt;

use super::float::FloatPolicy;
use super::*;
use crate::environment::{Drift, Environment, Lesson, PRIVILEGED, Told, Trivial, View};
use crate::methods::Method;
use crate::methods::imagination::displacement;
use crate::methods::normalise::{Frozen, Running};
use crate::methods::on_policy::buffer::gather;
use crate::methods::on_policy::update::{adapted, all_samples};
use crate::methods::on_policy::{
    Decisions, Iteration, RolloutBuffer, RolloutWorker, Trajectory, Widths, Workspace, collect, update,
};
use crate::methods::parameters::Block;
use crate::methods::random::stream;
use crate::methods::workers::Workers;
use crate::methods::{Algorithm, config::TrainConfig, imagination::ImaginationConfig};
use crate::network::Network;
use crate::policy::Memories;

type Learner = super::Learner<Networks>;

/// Learners with policies that are not the initial ones, and a rollout of theirs with teams of different sizes, one of which has a
/// dead module.
struct Rollout {
    control: Learner,
    imagination: Learner,
    buffer: RolloutBuffer,
}

/// The paper's shape of a method's actor, and that of one with all that an actor can have.
fn shapes(method: Method) -> Vec<Shape> {
    let paper = Shape::paper(method.attention(), ACTIONS);
    let all = Shape { inputs: SIZE, memory: MEMORY, distance_bias: method.attention(), ..paper };
    vec![paper, all]
}

fn rollout(method: Method) -> Rollout {
    rollout_of(shapes(method)[0])
}

fn rollout_of(shape: Shape) -> Rollout {
    let teams: [Box<dyn Environment>; 3] = [
        Box::new(Trivial::new(4, Told::Head)),
        Box::new(Trivial::new(3, Told::All)),
        Box::new(Trivial::new(5, Told::Head).with_dead(2)),
    ];
    rollout_with(shape, teams.into(), ImaginationConfig { bound: 0.5, follow: 0.25, ..Default::default() })
}

fn rollout_with(shape: Shape, teams: Vec<Box<dyn Environment>>, rules: ImaginationConfig) -> Rollout {
    let networks = |shape| Networks::new(shape, Differentiation::Manual);
    let mut control = networks(shape).learner(5, 0.45, 1.0, 1e-5, 1e-3);
    let imagines = Shape { inputs: shape.inputs, ..Shape::paper(false, DISPLACEMENT) };
    let mut imagination = networks(imagines).learner(6, 0.45, 1.0, 1e-5, 1e-3);
    let mut rng = stream(9, Stream::Weights, 7, 7);
    for learner in [&mut control, &mut imagination] {
        learner.actor.iter_mut().chain(&mut learner.critic).for_each(|p| *p += 0.3 * (rng.random::<f32>() - 0.5));
        learner.networks.load(Part::Actor, &learner.actor);
        learner.networks.load(Part::Critic, &learner.critic);
    }
    let mut workers: Vec<_> = teams
        .into_iter()
        .enumerate()
        .map(|(i, team)| RolloutWorker::new(team, i, 5, 0.9, Widths::of(&control.networks), Lesson::default()))
        .collect();
    let mut buffer = RolloutBuffer::new(workers.len());
    let (mut observations, mut privileged) = (Running::new(shape.inputs), Running::new(PRIVILEGED));
    let rules = Imagination(rules);
    let iteration = Iteration {
        policy: &control.networks,
        companion: Some((&imagination.networks, imagination.seed, &rules)),
        observations: Frozen::new(&observations),
        privileged: Frozen::new(&privileged),
        rewards: None,
        run_seed: 5,
        lesson: Lesson::default(),
        iteration: 0,
        steps: 16,
    };
    collect(
        &mut workers,
        &mut buffer,
        &iteration,
        &Workers::new(2).unwrap(),
        [&mut observations, &mut privileged, &mut Running::new(1)],
    );
    Rollout { control, imagination, buffer }
}

const LOSS: LossSettings = LossSettings { clip: 0.2, entropy: 0.0, team_weight: 1.0 };

const SETTINGS: OnPolicySettings = OnPolicySettings {
    environments: 3,
    rollout_steps: 16,
    learning_rate: 1e-3,
    learning_rate_end: 1.0,
    standardise: Standardise::Rollout(1e-8),
    observation_clip: Some(CLIP),
    reward_clip: None,
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
};

fn batch_of(
    trajectories: &[Trajectory],
    decisions: &[Decisions],
    samples: &[(u32, u32)],
    weight: f32,
    target: impl Fn(f32) -> f32,
) -> Batch {
    let mut batch = Batch::default();
    gather((trajectories, decisions), samples, Valued::Team, weight, target, &mut batch);
    batch
}

fn means(layout: ActorLayout, parameters: &[f32], batch: &Batch) -> Vec<f32> {
    let mut scratch = ActorScratch::default();
    let memory = Remembered { before: &batch.memory, follows: &batch.follows };
    Actor::new(layout, parameters)
        .means(&batch.observations, &batch.heard, &batch.modules, memory, &mut scratch)
        .to_vec()
}

fn critic_values(parameters: &[f32], batch: &Batch) -> Vec<f32> {
    let mut scratch = CriticScratch::default();
    let layout = CriticLayout::new(batch.observations.len() / batch.rows());
    Critic::new(layout, parameters)
        .values(&batch.observations, &batch.privileged, &batch.modules, &mut scratch)
        .to_vec()
}

fn actor_gradient(layout: ActorLayout, parameters: &[f32], batch: &Batch) -> Gradient {
    let (mut sum, mut ordered) = (Gradient::default(), Vec::new());
    sum.clear(layout.len);
    let actor = Actor::new(layout, parameters);
    actor.gradient(batch, LOSS, &mut ActorScratch::default(), &mut sum);
    actor.finish(&sum.gradient, false, &mut ordered);
    Gradient { gradient: ordered, ..sum }
}

fn critic_gradient(parameters: &[f32], batch: &Batch, weight: f32) -> Gradient {
    let (mut sum, mut ordered) = (Gradient::default(), Vec::new());
    sum.clear(parameters.len());
    let critic = Critic::new(CriticLayout::new(batch.observations.len() / batch.rows()), parameters);
    critic.gradient(batch, weight, &mut CriticScratch::default(), &mut sum);
    critic.finish(&sum.gradient, false, &mut ordered);
    Gradient { gradient: ordered, ..sum }
}

fn ratio_is_one(name: &str, learner: &Learner, trajectories: &[Trajectory], decisions: &[Decisions]) {
    let batch = batch_of(trajectories, decisions, &all_samples(trajectories), 1.0, |r| r);
    let layout = *learner.networks.actor.layout();
    let means = means(layout, &learner.actor, &batch);
    let log_sigma = &learner.actor[layout.log_sigma.range()];
    let mut checked = 0;
    for (row, weight) in batch.weights.iter().enumerate() {
        if *weight > 0.0 {
            let outputs = layout.outputs();
            let vector = |v: &[f32]| -> Vec<f32> { v[row * outputs..(row + 1) * outputs].to_vec() };
            let new = log_probability(&vector(&batch.actions), &vector(&means), log_sigma);
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
    for shape in Method::COMPOSERS.into_iter().flat_map(shapes) {
        let Rollout { control, imagination, buffer } = rollout_of(shape);
        ratio_is_one(&format!("{shape:?}"), &control, &buffer.trajectories, &buffer.control);
        ratio_is_one("imagination", &imagination, &buffer.trajectories, &buffer.companion);
    }
}

#[test]
fn the_control_policy_pays_for_not_following() {
    let RolloutBuffer { trajectories, control, companion } = rollout(Method::Composer).buffer;
    for ((trajectory, control), imagination) in trajectories.iter().zip(&control).zip(&companion) {
        assert_eq!((trajectory.companion_errors.len(), imagination.rewards.len()), (16, 16));
        for (step, error) in trajectory.companion_errors.iter().enumerate() {
            // Modules of this team never move: the error is how long the displacement was, on average over those that act.
            let at = step * trajectory.modules..(step + 1) * trajectory.modules;
            let acting = || {
                imagination.actions.as_chunks::<DISPLACEMENT>().0[at.clone()]
                    .iter()
                    .zip(&trajectory.acts[at.clone()])
                    .filter(|(_, acts)| **acts)
            };
            let lengths = acting().map(|(u, _)| 0.5 * u.iter().map(|x| x * x).sum::<f32>().sqrt().min(1.0));
            let expected = lengths.sum::<f32>() / acting().count() as f32;
            assert!((error - expected).abs() < 1e-5, "{error} {expected}");
            assert_eq!(control.rewards[step], trajectory.rewards[step] - 0.25 * error);
        }
    }
}

#[test]
fn targets_are_held_and_paid_for_by_coming_nearer() {
    let shape = shapes(Method::Composer)[0];
    let rules = ImaginationConfig { bound: 3.0, follow: 0.5, hold: 6, telescope: true, ..Default::default() };
    let teams = || -> Vec<Box<dyn Environment>> { vec![Box::new(Drift::new(3)), Box::new(Drift::new(4))] };
    let RolloutBuffer { trajectories, control, companion } = rollout_with(shape, teams(), rules.clone()).buffer;
    for ((trajectory, control), imagination) in trajectories.iter().zip(&control).zip(&companion) {
        // An episode of points has sixteen steps, as the rollout.
        let made: Vec<usize> = (0..16).filter(|step| imagination.counts[*step]).collect();
        assert_eq!(made, [0, 6, 12]);
        assert!(control.counts.is_empty() && control.own.is_empty());
        // What is paid within a target is half of what the error grew by after its first step.
        for first in [0, 6] {
            let paid: f32 = (first + 1..first + 6).map(|step| -control.rewards[step]).sum();
            let grown = trajectory.companion_errors[first + 5] - trajectory.companion_errors[first];
            assert!((paid - 0.5 * grown).abs() < 1e-5, "{paid} {grown}");
        }
    }
    // Each for itself: the mean of what the modules pay is what all paid before.
    let each = ImaginationConfig { each: true, ..rules.clone() };
    let own = rollout_with(shape, teams(), each).buffer;
    for (together, own) in control.iter().zip(&own.control) {
        let modules = own.own.len() / 16;
        for (step, paid) in own.own.chunks_exact(modules).enumerate() {
            let mean = paid.iter().sum::<f32>() / modules as f32;
            assert!((mean - together.rewards[step]).abs() < 1e-5 && own.rewards[step] == 0.0);
        }
    }
    // What is missed at the end of a target comes off what was earned for it.
    let feasible = rollout_with(shape, teams(), ImaginationConfig { feasible: 0.5, ..rules }).buffer;
    for ((trajectory, before), after) in feasible.trajectories.iter().zip(&companion).zip(&feasible.companion) {
        for step in 0..16 {
            let end = [(0, 5), (6, 11), (12, 15)].iter().find(|(first, _)| *first == step).map(|(_, end)| *end);
            let missed = end.map_or(0.0, |end| 0.5 * trajectory.companion_errors[end]);
            assert!((before.rewards[step] - after.rewards[step] - missed).abs() < 1e-5, "step {step}");
        }
    }
    // The gradient knows of what each module got for itself.
    let Rollout { control, buffer: RolloutBuffer { trajectories, control: mut decisions, .. }, .. } =
        rollout_with(shape, teams(), ImaginationConfig { each: true, hold: 6, telescope: true, ..Default::default() });
    let batch = shaken(&trajectories, &mut decisions);
    assert_eq!(batch.own.len(), batch.rows());
    let layout = *control.networks.actor.layout();
    let (automatic, manual) =
        (layout.autodiff(&control.actor, &batch, LOSS), actor_gradient(layout, &control.actor, &batch));
    same("each", &manual, &automatic, &layout.blocks());
}

#[test]
fn attention_needs_the_masks_of_the_rollout() {
    let Rollout { control: learner, buffer: RolloutBuffer { trajectories, control: decisions, .. }, .. } =
        rollout(Method::ComposerNoImagination);
    let mut batch = batch_of(&trajectories, &decisions, &all_samples(&trajectories), 1.0, |r| r);
    let layout = *learner.networks.actor.layout();
    let right = means(layout, &learner.actor, &batch);
    // A team acts the same alone as among others, bit for bit ...
    let alone = batch_of(&trajectories[1..2], &decisions[1..2], &[(0, 3)], 1.0, |r| r);
    let at = ACTIONS * (16 * 4 + 3 * 3);
    assert_eq!(means(layout, &learner.actor, &alone), right[at..at + ACTIONS * 3]);
    // ... but who hears whom must.
    batch.heard.iter_mut().for_each(|heard| *heard = 0b11111);
    let wrong = means(layout, &learner.actor, &batch);
    assert!(right.iter().zip(&wrong).any(|(a, b)| (a - b).abs() > 1e-3));
}

/// A batch whose ratios lie on both sides of the clip, with advantages of both signs.
fn shaken(trajectories: &[Trajectory], decisions: &mut [Decisions]) -> Batch {
    let mut rng = stream(3, Stream::Shuffle, 0, 0);
    for (trajectory, decision) in trajectories.iter().zip(&mut *decisions) {
        decision.advantages = (0..trajectory.steps()).map(|_| rng.random_range(-1.0..1.0)).collect();
        decision.returns = (0..trajectory.steps()).map(|_| rng.random_range(-1.0..1.0)).collect();
        // Ratios of 0.67, 0.9, 1.1 and 1.5: none so near the edges of the clip that a small step crosses one.
        let offsets = [-0.4, -0.1, 0.1, 0.4];
        decision.log_probabilities.iter_mut().for_each(|l| *l += offsets[rng.random_range(0..4)]);
    }
    batch_of(trajectories, decisions, &all_samples(trajectories), 1.0 / 176.0, |r| 0.5 * r)
}

/// Compares a gradient with central differences of the loss, along each of some single parameters and along the gradient.
fn against_differences(parameters: &[f32], gradient: &[f32], loss: impl Fn(&[f32]) -> f64, blocks: &[Block]) {
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
        assert!((single - expected).abs() < 0.05 * expected.abs() + 2e-4, "{}: {expected}, slope {single}", block.name);
    }
}

fn clipped_loss(learner: &Learner, batch: &Batch) {
    let layout = *learner.networks.actor.layout();
    // The loss again, in double precision and from its formula.
    let loss = |parameters: &[f32]| -> f64 {
        let means = means(layout, parameters, batch);
        let log_sigma = &parameters[layout.log_sigma.range()];
        let mut sum = 0.0;
        let advantages = batch.advantages.iter().zip(&batch.modules);
        let mut advantages = advantages.flat_map(|(advantage, n)| std::iter::repeat_n(f64::from(*advantage), *n));
        for row in 0..batch.weights.len() {
            let outputs = layout.outputs();
            let vector = |v: &[f32]| -> Vec<f32> { v[row * outputs..(row + 1) * outputs].to_vec() };
            let new = log_probability(&vector(&batch.actions), &vector(&means), log_sigma);
            let ratio = f64::from(new - batch.log_probabilities[row]).exp();
            let advantage = advantages.next().unwrap();
            let gain = (ratio * advantage).min(ratio.clamp(0.8, 1.2) * advantage);
            sum -= gain * f64::from(batch.weights[row]);
        }
        sum
    };
    let result = actor_gradient(layout, &learner.actor, batch);
    assert!((result.policy_loss - loss(&learner.actor)).abs() < 1e-5);
    assert!(result.clipped > 0.1 && result.clipped < 0.9, "{}", result.clipped);
    against_differences(&learner.actor, &result.gradient, loss, &layout.blocks());
}

#[test]
fn the_gradient_of_the_clipped_loss_is_its_slope() {
    // With attention and without, with memory and without.
    for shape in [Method::Composer, Method::ComposerNeither].into_iter().flat_map(shapes) {
        let Rollout {
            control,
            imagination,
            buffer: RolloutBuffer { trajectories, control: mut of_control, companion: mut of_imagination },
        } = rollout_of(shape);
        clipped_loss(&control, &shaken(&trajectories, &mut of_control));
        clipped_loss(&imagination, &shaken(&trajectories, &mut of_imagination));
    }
}

/// Some critic, and a batch.
fn critic() -> (Vec<f32>, Batch) {
    let Rollout { control, buffer: RolloutBuffer { trajectories, control: mut decisions, .. }, .. } =
        rollout(Method::ComposerNeither);
    (control.critic, shaken(&trajectories, &mut decisions))
}

#[test]
fn the_gradient_of_the_value_loss_is_its_slope() {
    let (critic, batch) = critic();
    let layout = CriticLayout::new(batch.observations.len() / batch.rows());
    let loss = |parameters: &[f32]| -> f64 {
        let values = critic_values(parameters, &batch);
        values.iter().zip(&batch.targets).map(|(v, t)| 0.25 * f64::from(v - t).powi(2)).sum()
    };
    let result = critic_gradient(&critic, &batch, 0.5);
    assert!((result.value_loss - loss(&critic)).abs() < 1e-4);
    against_differences(&critic, &result.gradient, loss, &layout.blocks());
}

/// Largest difference between two gradients of the same loss by the largest number of the block it is in.
fn same(name: &str, manual: &Gradient, automatic: &Gradient, blocks: &[Block]) {
    assert!(
        [(manual.policy_loss, automatic.policy_loss), (manual.value_loss, automatic.value_loss)]
            .iter()
            .all(|(m, a)| (m - a).abs() < 1e-5 * a.abs().max(0.1)),
        "{name}"
    );
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
    for shape in Method::COMPOSERS.into_iter().flat_map(shapes) {
        let Rollout {
            control,
            imagination,
            buffer: RolloutBuffer { trajectories, control: mut of_control, companion: mut of_imagination },
        } = rollout_of(shape);
        let batches = [
            (&control, shaken(&trajectories, &mut of_control)),
            (&imagination, shaken(&trajectories, &mut of_imagination)),
        ];
        for (learner, batch) in batches {
            let layout = *learner.networks.actor.layout();
            let automatic = layout.autodiff(&learner.actor, &batch, LOSS);
            let manual = actor_gradient(layout, &learner.actor, &batch);
            same(&format!("{shape:?}"), &manual, &automatic, &layout.blocks());
            let layout = CriticLayout::new(batch.observations.len() / batch.rows());
            let automatic = layout.autodiff(&learner.critic, &batch, 0.01);
            let manual = critic_gradient(&learner.critic, &batch, 0.01);
            same("critic", &manual, &automatic, &layout.blocks());
        }
    }
}

#[test]
fn what_is_remembered_goes_on_through_a_rollout_and_begins_anew_with_an_episode() {
    let shape = shapes(Method::ComposerNoImagination)[1];
    let Rollout { control, buffer: RolloutBuffer { trajectories, control: decisions, .. }, .. } = rollout_of(shape);
    let layout = *control.networks.actor.layout();
    for (trajectory, decisions) in trajectories.iter().zip(&decisions) {
        let width = trajectory.modules * MEMORY;
        let memory = |step: usize| &decisions.memory[step * width..(step + 1) * width];
        for step in 0..16 {
            // Episodes of a trivial team have ten steps.
            let begins = step % Trivial::STEPS as usize == 0;
            assert_eq!(memory(step).iter().all(|m| *m == 0.0), begins, "step {step}");
        }
    }
    // Step by step from what was kept, or in one piece: the same to the last bit.
    let (trajectory, decisions) = (&trajectories[..1], &decisions[..1]);
    let whole = batch_of(trajectory, decisions, &all_samples(trajectory), 1.0, |r| r);
    assert_eq!(whole.follows.iter().filter(|follows| !**follows).count(), 2);
    let together = means(layout, &control.actor, &whole);
    let outputs = ACTIONS * trajectory[0].modules;
    for step in 0..16 {
        let alone = batch_of(trajectory, decisions, &[(0, step)], 1.0, |r| r);
        assert_eq!(alone.follows, [false]);
        let at = step as usize * outputs;
        assert_eq!(means(layout, &control.actor, &alone), together[at..at + outputs]);
    }
}

#[test]
fn distances_fall_into_thirteen_buckets() {
    let of = |from, to| distance_bucket(from, to);
    assert_eq!([0, 1, 2, 3, 4, 5, 8, 9, 16, 17, 63].map(|to| of(0, to)), [6, 7, 8, 9, 9, 10, 10, 11, 11, 12, 12]);
    assert_eq!([1, 2, 4, 8, 16, 63].map(|from| of(from, 0)), [5, 4, 3, 2, 1, 0]);
    assert_eq!(of(40, 40), 6);
}

#[test]
fn both_ways_to_the_gradient_learn_the_same() {
    let [manual, automatic] = [Differentiation::Manual, Differentiation::Automatic].map(|gradient| {
        let Rollout { mut control, mut buffer, .. } = rollout(Method::Composer);
        control.networks.gradient = gradient;
        let mut workspace = Workspace::new(2).unwrap();
        let (trajectories, decisions) = (&buffer.trajectories, &mut buffer.control);
        update(&mut control, trajectories, decisions, &SETTINGS, 1e-3, 0, &mut workspace);
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
    let Rollout { mut control, mut buffer, .. } = rollout(Method::ComposerNeither);
    let settings = OnPolicySettings { kl_target: 1.0, kl_stop: 10.0, ..SETTINGS };
    let mut workspace = Workspace::new(1).unwrap();
    update(&mut control, &buffer.trajectories, &mut buffer.control, &settings, 1e-3, 0, &mut workspace);
    assert_eq!(control.learning_rate, 1.5e-3);
}

#[test]
fn sigma_stays_above_its_least() {
    let Rollout { mut control, mut buffer, .. } = rollout(Method::ComposerNeither);
    let settings = OnPolicySettings { sigma_min: 0.6, ..SETTINGS };
    let mut workspace = Workspace::new(1).unwrap();
    update(&mut control, &buffer.trajectories, &mut buffer.control, &settings, 1e-3, 0, &mut workspace);
    let log_sigma = &control.actor[control.networks.actor.layout().log_sigma.range()];
    assert!(log_sigma.iter().all(|l| *l >= 0.6f32.ln()), "{log_sigma:?}");
}

#[test]
fn rescaling_the_critic_keeps_its_values() {
    let (mut critic, batch) = critic();
    let layout = CriticLayout::new(batch.observations.len() / batch.rows());
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
        let Rollout { mut control, mut imagination, mut buffer } = rollout(Method::Composer);
        let RolloutBuffer { trajectories, control: of_control, companion: of_imagination } = &mut buffer;
        let mut workspace = Workspace::new(threads).unwrap();
        let stats = [
            update(&mut control, trajectories, of_control, &SETTINGS, 1e-3, 0, &mut workspace),
            update(&mut imagination, trajectories, of_imagination, &SETTINGS, 1e-3, 0, &mut workspace),
        ];
        (control.state(), imagination.state(), stats)
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
    let Rollout { control: mut learner, mut buffer, .. } = rollout(Method::ComposerNeither);
    let settings = OnPolicySettings { kl_stop: 1e-4, epochs: 10, ..SETTINGS };
    let mut workspace = Workspace::new(1).unwrap();
    let (trajectories, decisions) = (&buffer.trajectories, &mut buffer.control);
    let stats = update(&mut learner, trajectories, decisions, &settings, 1e-2, 0, &mut workspace);
    assert!(stats.actor_minibatches < 20 && stats.approx_kl > 1e-4, "{stats:?}");
    assert_eq!(learner.critic_adam.steps, 4);
    assert_eq!(learner.actor_adam.steps, stats.actor_minibatches as u64);
}

fn network_of(trainer: &OnPolicy<Networks>) -> Network {
    trainer.policy().network().unwrap().clone()
}

fn trained(method: Method, total_steps: u64, make: MakeEnvironment) -> OnPolicy<Networks> {
    let config = TrainConfig {
        method,
        total_steps,
        environments: 16,
        rollout_steps: 20,
        learning_rate: 1e-3,
        gamma: 0.0,
        imagination: ImaginationConfig { follow: 1.0, ..Default::default() },
        ..Default::default()
    };
    let mut trainer = new(&config, make).unwrap();
    while trainer.iteration() * trainer.steps_per_iteration() < total_steps {
        trainer.iterate().unwrap();
    }
    trainer
}

#[test]
fn the_imagination_points_at_the_target_and_the_control_policy_follows() {
    let drift: MakeEnvironment = &|_| Ok(Box::new(Drift::new(3)));
    let trainer = trained(Method::ComposerNoAttention, 40_000, drift);
    let network = network_of(&trainer);
    let imagination = &trainer.companion().unwrap().networks.actor;
    let bound = ImaginationConfig::default().bound as f32;
    let mut scratch = ActorScratch::default();
    let (mut env, mut view) = (Drift::new(3), View::default());
    let (mut earned, mut possible, mut distance) = (0.0, 0.0, 0.0);
    for seed in 0..100 {
        env.reset(seed);
        for _ in 0..Drift::STEPS {
            env.view(&mut view);
            let normalised: Vec<f32> = view
                .observations
                .iter()
                .flat_map(|o| (0..BASE).map(|i| ((o[i] - network.mean[i]) / network.std[i]).clamp(-5.0, 5.0)))
                .collect();
            let means =
                imagination.means(&normalised, &view.heard, &[3], Remembered::default(), &mut scratch).as_chunks().0;
            let imagined: Vec<_> = (0..3).map(|m| env.place(m, displacement(means[m], bound))).collect();
            earned += env.imagined_reward(&imagined);
            let best = view.observations.iter().map(|o| o[0].hypot(o[1]).min(bound)).sum::<f32>() / 3.0;
            possible += best;
            let mut actions = [[0.0; 2]; 3];
            FloatPolicy::new(&network).act(
                &mut [[0.0; MEMORY]; 3],
                &view.observations,
                &view.heard,
                &mut actions,
                None,
            );
            let outcome = env.step(&actions);
            if outcome.truncated {
                distance += outcome.distance / 100.0;
            }
        }
    }
    // Nearly the shortest way that there is, and the points arrive, although the task itself pays nothing.
    assert!(earned > 0.9 * possible, "{earned} of {possible}");
    assert!(distance < 0.3, "{distance}");
    // Without imagination nobody tells them where to go.
    let network = network_of(&trained(Method::ComposerNeither, 10_000, drift));
    let mut apart = 0.0;
    for seed in 0..100 {
        env.reset(seed);
        for _ in 0..Drift::STEPS {
            env.view(&mut view);
            let mut actions = [[0.0; 2]; 3];
            FloatPolicy::new(&network).act(
                &mut [[0.0; MEMORY]; 3],
                &view.observations,
                &view.heard,
                &mut actions,
                None,
            );
            let outcome = env.step(&actions);
            apart += if outcome.truncated { outcome.distance / 100.0 } else { 0.0 };
        }
    }
    assert!(apart > 1.5, "{apart}");
}

#[test]
fn the_control_policy_is_told_what_is_imagined_and_the_imagination_does_not_look_at_it() {
    let config = TrainConfig {
        method: Method::Composer,
        environments: 3,
        rollout_steps: 20,
        learning_rate: 1e-3,
        imagination: ImaginationConfig { told: true, attention: true, ..Default::default() },
        ..Default::default()
    };
    let mut trainer = new(&config, &|index| {
        let team = Trivial::new(3 + index, Told::Head);
        Ok(Box::new(if index == 2 { team.with_dead(1) } else { team }))
    })
    .unwrap();
    for _ in 0..4 {
        let report = trainer.iterate().unwrap();
        // What was told in the rollout is what the update sees, of both.
        for name in ["losses/first_minibatch_kl", "imagination/first_minibatch_kl"] {
            assert!(report.get(name).abs() < 1e-6, "{name}: {}", report.get(name));
        }
    }
    let policy = trainer.policy();
    policy.check().unwrap();
    let TrainedPolicy::Told(networks) = &policy else { panic!("{policy:?}") };
    let told = |network: &Network| -> Vec<f32> {
        network.encoder.weights.chunks_exact(TOLD_INPUTS).flat_map(|row| row[BASE..].to_vec()).collect()
    };
    assert!(told(&networks.imagination).iter().all(|w| *w == 0.0));
    assert!(told(&networks.control).iter().all(|w| *w != 0.0));
    // It was told something, never more than the bound.
    let [mean, std] = [&networks.control.mean, &networks.control.std].map(|numbers| &numbers[BASE..]);
    assert!(mean.iter().any(|m| m.abs() > 1e-3) && mean.iter().zip(std).all(|(m, s)| m.abs() < 1.0 && *s <= 1.0));

    let text = serde_json::to_string(&policy).unwrap();
    assert_eq!(serde_json::from_str::<TrainedPolicy>(&text).unwrap(), policy);
    assert!(policy.runs_on_modules().unwrap_err().to_string().contains("needs the imagination policy, too"));

    let act = |policy: &TrainedPolicy| {
        let (mut team, mut view, mut actions) = (Trivial::new(4, Told::Head), View::default(), Vec::new());
        team.reset(3);
        team.view(&mut view);
        policy.policy().act(&view, 0, &mut Memories::default(), &mut actions, None);
        actions
    };
    let mut other = networks.clone();
    other.imagination.output.bias[0] += 1.0;
    assert_ne!(act(&policy), act(&TrainedPolicy::Told(other.clone())));
    // What it imagines is all that it is told.
    for row in other.control.encoder.weights.chunks_exact_mut(TOLD_INPUTS) {
        row[BASE..].fill(0.0);
    }
    let mut same = other.clone();
    same.imagination.output.bias[0] -= 1.0;
    assert_eq!(act(&TrainedPolicy::Told(other.clone())), act(&TrainedPolicy::Told(same)));
    other.imagination.inputs = BASE;
    assert_eq!(
        other.check().unwrap_err().to_string(),
        "a network takes 40 fields of the observation, 43 were expected"
    );
}
