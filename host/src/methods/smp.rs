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
//! One update of the original's 400-300 networks costs a tenth of a second, as much as a thousand environment steps: `updates_per_step` and
//! `widths` are settings, and whoever changes them should say so beside the result. The replay buffer holds 200,000 steps where the original's holds a
//! million.

use anyhow::{Result, bail};
use burn::tensor::Tensor;
use composer_shared::observation::BASE;
use serde::{Deserialize, Serialize};

use super::config::TrainConfig;
use super::off_policy::td3::{DeterministicActorCritic, OffPolicy, Td3, Td3Settings, raw};
use super::on_policy::autodiff::{Seen, seen};
use super::on_policy::collect::ACTIONS;
use super::random::{Stream, stream};
use super::tensors::{Activation, Layout, Scheme, Weights, floats};
use super::{MakeEnvironment, Method, SavedWeights, TrainedPolicy};
use crate::environment::{View, with_itself};
use crate::policy::{Memories, Policy};

/// Numbers in a message.
const MESSAGE: usize = 32;
/// Width of the networks on the way up.
const WIDTH: usize = 64;

/// Actor and twin critics.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Smp {
    /// Widths of the hidden layers of the networks on the way down.
    pub widths: [usize; 2],
}

/// Messages of all modules, head first, `[teams, MESSAGE]` each: upwards, and to each from its parent.
struct Messages {
    up: Vec<Tensor<2>>,
    from_parent: Vec<Tensor<2>>,
}

/// Rows of unit length.
fn unit(x: Tensor<2>) -> Tensor<2> {
    let length = (x.clone() * x.clone()).sum_dim(1).sqrt().clamp_min(1e-12);
    x / length
}

/// The part of `[teams * modules, columns]` that belongs to one module.
fn of_module(x: &Tensor<2>, seen: &Seen, module: usize) -> Tensor<2> {
    let columns = x.dims()[1];
    x.clone().reshape([seen.teams, seen.modules, columns]).narrow(1, module, 1).reshape([seen.teams, columns])
}

/// What is one `[teams, columns]` a module, as `[teams * modules, columns]`.
fn all_modules(parts: &[Tensor<2>], seen: &Seen) -> Tensor<2> {
    let columns = parts[0].dims()[1];
    let parts = parts.iter().map(|part| part.clone().reshape([seen.teams, 1, columns])).collect();
    Tensor::cat(parts, 1).reshape([seen.teams * seen.modules, columns])
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

    fn through(w: &Weights, name: &str, x: Tensor<2>) -> Tensor<2> {
        let names = ["l1", "l2", "l3"].map(|layer| format!("down.{name}.{layer}"));
        w.mlp(&names.each_ref().map(String::as_str), Activation::Relu, x)
    }

    /// Both ways of the messages, for inputs `[teams * modules, ..]`.
    fn messages(w: &Weights, seen: &Seen, inputs: Tensor<2>) -> Messages {
        let own = unit(w.linear("up.fc1", inputs));
        let silence = w.tensor(&vec![0.0; seen.teams * MESSAGE], [seen.teams, MESSAGE]);
        // 1 where module `to` hears module `from`, else 0.
        let hears = |to: usize, from: usize| {
            let mask = seen.mask.clone().narrow(1, to, 1).narrow(2, from, 1).reshape([seen.teams, 1]);
            mask.clamp(-1.0, 0.0) + 1.0
        };
        let mut up: Vec<Tensor<2>> = Vec::with_capacity(seen.modules);
        for module in (0..seen.modules).rev() {
            let child = match up.last() {
                Some(message) => message.clone() * hears(module, module + 1),
                None => silence.clone(),
            };
            let x = Tensor::cat(vec![of_module(&own, seen, module), child], 1).tanh();
            up.push(unit(w.linear("up.fc3", w.linear("up.fc2", x).tanh())));
        }
        up.reverse();
        let mut from_parent = vec![silence];
        for module in 0..seen.modules - 1 {
            let x = Tensor::cat(vec![up[module].clone(), from_parent[module].clone()], 1).tanh();
            from_parent.push(unit(Self::through(w, "msg_base", x)) * hears(module + 1, module));
        }
        Messages { up, from_parent }
    }
}

impl DeterministicActorCritic for Smp {
    fn layouts(&self) -> [Layout; 2] {
        let (mut actor, mut critic) = (Layout::default(), Layout::default());
        Self::up(&mut actor, BASE);
        self.down(&mut actor, "action_base", 2 * MESSAGE, ACTIONS);
        self.down(&mut actor, "msg_base", 2 * MESSAGE, MESSAGE);
        Self::up(&mut critic, BASE + ACTIONS);
        self.down(&mut critic, "baseQ1", 2 * MESSAGE + ACTIONS, 1);
        self.down(&mut critic, "baseQ2", 2 * MESSAGE + ACTIONS, 1);
        self.down(&mut critic, "msg_base", 2 * MESSAGE, MESSAGE);
        [actor, critic]
    }

    fn act(&self, w: &Weights, seen: &Seen) -> Tensor<2> {
        let Messages { up, from_parent } = Self::messages(w, seen, seen.observations.clone());
        let (up, from_parent) = (all_modules(&up, seen), all_modules(&from_parent, seen));
        Self::through(w, "action_base", Tensor::cat(vec![up, from_parent], 1).tanh()).tanh()
    }

    fn values(&self, w: &Weights, seen: &Seen, actions: Tensor<2>) -> [Tensor<2>; 2] {
        let inputs = Tensor::cat(vec![seen.observations.clone(), actions.clone()], 1);
        let Messages { up, from_parent } = Self::messages(w, seen, inputs);
        let x = Tensor::cat(vec![all_modules(&up, seen), actions, all_modules(&from_parent, seen)], 1);
        ["baseQ1", "baseQ2"].map(|name| Self::through(w, name, x.clone()))
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
    actor: Weights,
}

impl SmpPolicy {
    /// Of what was saved; none if it does not fit.
    pub fn new(saved: &SavedWeights) -> Option<Self> {
        let networks = Smp { widths: saved.widths[..].try_into().ok()? };
        let [layout, _] = networks.layouts();
        (layout.len() == saved.parameters.len())
            .then(|| Self { networks, actor: Weights::new(&layout, &saved.parameters) })
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
        let modules = view.observations.len();
        let heard: Vec<u64> = with_itself(&view.heard).collect();
        let seen = seen(&self.actor, &raw(view), &heard, modules);
        let all = floats(self.networks.act(&self.actor, &seen));
        actions.clear();
        actions.extend_from_slice(all.as_chunks::<ACTIONS>().0);
    }
}
