//! SMP, shared modular policies (Huang et al. 2020): the same small networks in every module, which pass messages of length 1 from tail to head
//! and back, trained with TD3. The snake is a chain whose root is the head.
//!
//! As in the authors' code (huangwl18/modular-rl, as it runs by default):
//!
//! - Up, from the tail: Linear to 64, normalised to unit length, the child's message beside it, tanh, Linear, tanh, Linear to 32, unit length. Down,
//!   from the head: the own upward message and the parent's message; tanh; one network for the action, one for the message.
//! - **Every module has a Q of its own** (its "sum" over the body runs over an axis of length 1): each regresses on the team's reward and its own
//!   target, the actor maximises their mean.
//! - PyTorch's initial weights, no normalisation of observations or rewards, Adam with epsilon 1e-8 and no limit of the gradient.
//! - TD3's settings; an update for every environment step, batches of 100, 10,000 steps at random first.
//!
//! Ours: two actions a module (it has one), so the head of the action network gives two and the critic takes both; messages that are not heard
//! are zeros. Mended: what follows a time limit is the last view, not the first of the next episode; the last step of an
//! episode counts.
//!
//! One update of the original's 400-300 networks costs 70 ms, as much as more than a hundred environment steps: `updates_per_step` and
//! `widths` are settings, and whoever changes them should say so beside the result. The replay buffer holds 200,000 steps where the original's holds a
//! million.

use anyhow::{Result, bail};
use composer_shared::observation::BASE;
use serde::{Deserialize, Serialize};

use super::config::TrainConfig;
use super::layers::{Matrix, Memory, Network, Packed, Tape};
use super::layout::{Activation, Layout, Scheme};
use super::off_policy::td3::{DeterministicActorCritic, OffPolicy, Seen, Sight, Td3, Td3Settings, act, raw};
use super::on_policy::collect::ACTIONS;
use super::random::{Stream, stream};
use super::{MakeEnvironment, Method, SavedWeights, TrainedPolicy};
use crate::environment::{View, with_itself};
use crate::policy::{Memories, Policy};

/// Numbers in a message.
const MESSAGE: usize = 32;
/// Width of the networks on the way up.
const WIDTH: usize = 64;

/// Networks of the twin critics.
const CRITICS: [&str; 2] = ["baseQ1", "baseQ2"];

/// Actor and twin critics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Smp {
    /// Widths of the hidden layers of the networks on the way down.
    pub widths: [usize; 2],
}

impl Smp {
    fn down(self, layout: &mut Layout, name: &str, inputs: usize, outputs: usize) {
        let [first, second] = self.widths;
        layout.linear(&format!("down.{name}.l1"), inputs, first, Scheme::Uniform);
        layout.linear(&format!("down.{name}.l2"), first, second, Scheme::Uniform);
        layout.linear(&format!("down.{name}.l3"), second, outputs, Scheme::Uniform);
    }

    fn up(layout: &mut Layout, inputs: usize) {
        layout.linear("up.fc1", inputs, WIDTH, Scheme::Uniform);
        layout.linear("up.fc2", WIDTH + MESSAGE, WIDTH, Scheme::Uniform);
        layout.linear("up.fc3", WIDTH, MESSAGE, Scheme::Uniform);
    }

    /// The two hidden layers of a network on the way down.
    fn hidden(t: &mut Tape, w: Network, name: &str, x: Matrix) -> Matrix {
        let x = t.activated(w, &format!("down.{name}.l1"), Activation::Relu, x);
        t.activated(w, &format!("down.{name}.l2"), Activation::Relu, x)
    }

    /// The messages of all modules, upwards, and to each from its parent.
    fn messages(t: &mut Tape, w: Network, seen: &Seen, inputs: Matrix) -> [Matrix; 2] {
        let own = t.linear(w, "up.fc1", inputs);
        let own = t.unit(own);
        let silence = t.input(&vec![0.0; seen.teams * MESSAGE], MESSAGE);
        let mut up: Vec<Matrix> = Vec::with_capacity(seen.modules);
        for module in (0..seen.modules).rev() {
            let child = match up.last() {
                Some(message) => t.scaled(*message, seen.hears(module, module + 1)),
                None => silence,
            };
            let x = t.beside(&[own.rows(seen.place(module)), child]);
            let x = t.tanh(x);
            let x = t.linear(w, "up.fc2", x);
            let x = t.tanh(x);
            let x = t.linear(w, "up.fc3", x);
            up.push(t.unit(x));
        }
        up.reverse();
        let mut from_parent = vec![silence];
        for module in 0..seen.modules - 1 {
            let x = t.beside(&[up[module], from_parent[module]]);
            let x = t.tanh(x);
            let x = Self::hidden(t, w, "msg_base", x);
            let x = t.linear(w, "down.msg_base.l3", x);
            let x = t.unit(x);
            from_parent.push(t.scaled(x, seen.hears(module + 1, module)));
        }
        [up, from_parent].map(|messages| t.below(&messages))
    }
}

impl DeterministicActorCritic for Smp {
    fn layouts(&self) -> [Layout; 2] {
        let (mut actor, mut critic) = (Layout::default(), Layout::default());
        Self::up(&mut actor, BASE);
        self.down(&mut actor, "action_base", 2 * MESSAGE, ACTIONS);
        self.down(&mut actor, "msg_base", 2 * MESSAGE, MESSAGE);
        Self::up(&mut critic, BASE + ACTIONS);
        self.down(&mut critic, CRITICS[0], 2 * MESSAGE + ACTIONS, 1);
        self.down(&mut critic, CRITICS[1], 2 * MESSAGE + ACTIONS, 1);
        self.down(&mut critic, "msg_base", 2 * MESSAGE, MESSAGE);
        [actor, critic]
    }

    fn act(&self, t: &mut Tape, actor: Network, seen: &Seen) -> Matrix {
        let messages = Self::messages(t, actor, seen, seen.observations);
        let x = t.beside(&messages);
        let x = t.tanh(x);
        let x = Self::hidden(t, actor, "action_base", x);
        let x = t.linear(actor, "down.action_base.l3", x);
        t.tanh(x)
    }

    fn values<const N: usize>(&self, t: &mut Tape, critic: Network, seen: &Seen, actions: Matrix) -> [Matrix; N] {
        let inputs = t.beside(&[seen.observations, actions]);
        let [up, from_parent] = Self::messages(t, critic, seen, inputs);
        let x = t.beside(&[up, actions, from_parent]);
        std::array::from_fn(|i| {
            let hidden = Self::hidden(t, critic, CRITICS[i], x);
            t.linear(critic, &format!("down.{}.l3", CRITICS[i]), hidden)
        })
    }

    fn policy(&self, actor: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Weights(SavedWeights { widths: self.widths.to_vec(), ..SavedWeights::raw(Method::Smp, actor) })
    }
}

/// Settings of `smp`, the authors' but for the size of the replay buffer.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct SmpConfig {
    /// Environments side by side.
    pub environments: usize,
    /// Steps each takes in an iteration.
    pub rollout_steps: usize,
    /// Updates for each environment step.
    pub updates_per_step: f64,
    /// Transitions of an update.
    pub batch: usize,
    /// Transitions that are kept.
    pub replay: usize,
    /// Environment steps at the start whose actions are uniformly random.
    pub random_steps: u64,
    /// Discount per control step.
    pub gamma: f64,
    /// Share of the networks that their targets take over.
    pub tau: f64,
    /// Learning rate of both optimisers.
    pub learning_rate: f64,
    /// Standard deviation of the noise on the actions taken.
    pub exploration: f64,
    /// Standard deviation of the noise on the targets' actions.
    pub target_noise: f64,
    /// Most of it.
    pub target_noise_clip: f64,
    /// Updates of the critics for one of the actor and the targets.
    pub delay: u64,
    /// Widths of the hidden layers of the networks on the way down.
    pub widths: [usize; 2],
}

impl Default for SmpConfig {
    fn default() -> Self {
        Self {
            environments: 4,
            rollout_steps: 32,
            updates_per_step: 1.0,
            batch: 100,
            replay: 200_000,
            random_steps: 10_000,
            gamma: 0.99,
            tau: 0.046,
            learning_rate: 5e-4,
            exploration: 0.126,
            target_noise: 0.2,
            target_noise_clip: 0.5,
            delay: 2,
            widths: [400, 300],
        }
    }
}

impl SmpConfig {
    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        let counts = [
            ("environments", self.environments, 4096),
            ("rollout_steps", self.rollout_steps, 65_536),
            ("batch", self.batch, 65_536),
            ("replay", self.replay, 10_000_000),
            ("delay", self.delay as usize, 1000),
            ("widths", self.widths[0].min(self.widths[1]), 4096),
            ("widths", self.widths[0].max(self.widths[1]), 4096),
        ];
        for (key, value, most) in counts {
            if !(1..=most).contains(&value) {
                bail!("smp.{key} is {value}; it must be from 1 to {most}");
            }
        }
        for (key, value) in [("gamma", self.gamma), ("tau", self.tau)] {
            if !(0.0..=1.0).contains(&value) {
                bail!("smp.{key} is {value}; it must be from 0 to 1");
            }
        }
        if !(self.learning_rate.is_finite() && self.learning_rate > 0.0) {
            bail!("smp.learning_rate is {}; it must be a number above 0", self.learning_rate);
        }
        let rest = [
            ("updates_per_step", self.updates_per_step),
            ("exploration", self.exploration),
            ("target_noise", self.target_noise),
            ("target_noise_clip", self.target_noise_clip),
        ];
        for (key, value) in rest {
            if !(value.is_finite() && value >= 0.0) {
                bail!("smp.{key} is {value}; it must be 0 or more");
            }
        }
        Ok(())
    }

    fn settings(&self) -> Td3Settings {
        Td3Settings {
            environments: self.environments,
            rollout_steps: self.rollout_steps,
            updates_per_step: self.updates_per_step,
            batch: self.batch,
            replay: self.replay,
            random_steps: self.random_steps,
            gamma: self.gamma as f32,
            tau: self.tau as f32,
            learning_rate: self.learning_rate as f32,
            exploration: self.exploration as f32,
            target_noise: self.target_noise as f32,
            target_noise_clip: self.target_noise_clip as f32,
            delay: self.delay,
        }
    }
}

/// A run of SMP.
pub fn new(config: &TrainConfig, make: MakeEnvironment) -> Result<OffPolicy<Smp>> {
    let networks = Smp { widths: config.smp.widths };
    let layouts = networks.layouts();
    let initial =
        [0, 1].map(|part: usize| layouts[part].initial(&mut stream(config.seed, Stream::Weights, 3, part as u64)));
    OffPolicy::new(config, config.smp.settings(), Td3::new(networks, initial), make)
}

/// An actor that acts without noise.
pub struct SmpPolicy {
    networks: Smp,
    actor: Packed,
}

impl SmpPolicy {
    /// Of what was saved; none if it does not fit.
    pub fn new(saved: &SavedWeights) -> Option<Self> {
        let networks = Smp { widths: saved.widths[..].try_into().ok()? };
        let [layout, _] = networks.layouts();
        (layout.len() == saved.parameters.len())
            .then(|| Self { networks, actor: Packed::new(&layout, &saved.parameters) })
    }
}

impl Policy for SmpPolicy {
    fn act(
        &self,
        view: &View,
        _noise: u64,
        _memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        _attention: Option<&mut Vec<f32>>,
    ) {
        let heard: Vec<u64> = with_itself(&view.heard).collect();
        let sight = Sight { modules: view.observations.len(), observations: &raw(view), heard: &heard };
        let all = act(&self.networks, &self.actor, sight, &mut Memory::default());
        actions.clear();
        actions.extend_from_slice(all.as_chunks::<ACTIONS>().0);
    }
}

#[cfg(test)]
mod tests {
    use super::super::off_policy::Transitions;
    use super::super::random::numbers;
    use super::*;

    /// Teams of which hardly any hears all its neighbours: every message that counts, and every one that does not.
    fn batch(teams: usize, modules: usize) -> Transitions {
        let rows = teams * modules;
        let heard = |seed: u64| {
            let heard = numbers(rows, seed).into_iter().enumerate();
            heard.map(|(i, x)| x.to_bits() as u64 & ((1 << modules) - 1) | 1 << (i % modules)).collect::<Vec<u64>>()
        };
        Transitions {
            modules,
            observations: numbers(rows * BASE, 1),
            heard: heard(2),
            actions: numbers(rows * ACTIONS, 3).iter().map(|a| a.clamp(-1.0, 1.0)).collect(),
            rewards: numbers(teams, 4),
            done: (0..teams).map(|team| f32::from(u8::from(team % 3 == 0))).collect(),
            next_observations: numbers(rows * BASE, 5),
            next_heard: heard(6),
        }
    }

    #[test]
    fn gradients_are_what_differences_of_the_losses_say() {
        let (teams, modules) = (60, 4);
        let batch = batch(teams, modules);
        let noise = numbers(teams * modules * ACTIONS, 7);
        // Nothing moves, so the actor's loss is by the same critic however its weights are.
        let config = SmpConfig { learning_rate: 0.0, ..SmpConfig::default() };
        let networks = Smp { widths: [24, 20] };
        let layouts = networks.layouts();
        // Larger than at the start of a run, where hardly anything that comes in shows in what goes out.
        let initial = [0, 1].map(|part: usize| {
            let initial = layouts[part].initial(&mut stream(3, Stream::Weights, 3, part as u64));
            initial.into_iter().map(|weight| 2.0 * weight).collect::<Vec<f32>>()
        });
        let update = |online: [Vec<f32>; 2]| {
            let mut td3 = Td3::new(networks, initial.clone());
            td3.online = online;
            td3.update(&batch, &noise, &config.settings(), true)
        };
        let stats = update(initial.clone());
        for (part, gradient) in [&stats.actor_gradient, &stats.critic_gradient].into_iter().enumerate() {
            for entry in layouts[part].entries() {
                // Along the gradient of one entry the loss rises by its length.
                let gradient = &gradient[entry.range()];
                let length = gradient.iter().map(|g| f64::from(*g).powi(2)).sum::<f64>().sqrt();
                let step = 0.005;
                let moved = [-step, step].map(|step| {
                    let mut online = initial.clone();
                    let of = online[part][entry.range()].iter_mut().zip(gradient);
                    of.for_each(|(weight, g)| *weight += (step * f64::from(*g) / length) as f32);
                    let stats = update(online);
                    [stats.actor_loss.unwrap(), stats.critic_loss][part]
                });
                let rise = (moved[1] - moved[0]) / (2.0 * step);
                let near = 0.01 * length + 1e-5;
                assert!(length > 1e-3, "{}: {length}", entry.name);
                assert!((rise - length).abs() < near, "{}: {rise} instead of {length}", entry.name);
            }
        }
    }
}
