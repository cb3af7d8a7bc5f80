//! COMPOSER (Zhang, Niu, Liu, Zhao; section III) and its ablations.
//!
//! One policy, shared by all modules: an encoder of what the module observes, self-attention over the latents of the modules it hears, a
//! hidden layer over both, two torques ([`actor`]). A critic that sees the whole team, in training alone ([`critic`]). An imagination
//! policy beside it, which the control policy is rewarded for following ([`imagination`](super::imagination)). Trained like MAPPO: the ratio is one a
//! module, its clip too, the value and so the advantage is the team's.
//!
//! Where this is not the paper's:
//!
//! - The raw embedding skips the attention, so that a module that hears nobody still acts; the critic is privileged and pools, so that
//!   it works for any number of modules.
//! - The value loss is not clipped; values are kept on the returns' scale by PopArt.
//! - Orthogonal weights, a hundredth of that in the last layer, a small standard deviation at the start, observations normalised by
//!   statistics that are pooled over the modules; a stop at a limit of the KL divergence.
//!
//! The gradients are written by hand ([`actor`], [`critic`]) and checked against burn's ([`autodiff`]).

pub mod actor;
pub mod autodiff;
pub mod critic;
pub mod float;
pub mod fused;
#[cfg(test)]
mod tests;
pub mod told;

use std::path::Path;

use anyhow::{Context, Result, bail};
use serde::{Deserialize, Serialize};

use self::actor::{Actor, ActorLayout, ActorScratch, Remembered, Shape, log_probability};
use self::critic::{Critic, CriticLayout, CriticScratch};
use self::told::ToldNetworks;
use super::config::TrainConfig;
use super::imagination::{DISPLACEMENT, Imagination, TOLD_INPUTS};
use super::normalise::{CLIP, Forgetting, ValueNorm};
use super::on_policy::collect::ACTIONS;
use super::on_policy::update::Standardise;
use super::on_policy::{
    ActorCritic, Batch, CompanionLearner, Drawn, Gradient, Learner, LossSettings, OnPolicy, OnPolicySettings, Part,
    Ratio, Teams, Valued,
};
use super::random::{Stream, derive_seed};
use super::{MakeEnvironment, TrainedPolicy};
use crate::network::Network;
use crate::run_folder::load_run;

/// Which code computes the gradients.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Differentiation {
    /// The backward passes written by hand for these two networks ([`actor`], [`critic`]).
    #[default]
    Manual,
    /// burn's automatic differentiation ([`autodiff`]): several times slower, the same up to rounding. The reference for the former.
    Automatic,
}

/// Actor and critic of the control policy or of the imagination policy.
#[derive(Clone, Debug)]
pub struct Networks {
    /// The actor.
    pub actor: Actor,
    /// Its critic.
    pub critic: Critic,
    /// Who computes the gradients.
    pub gradient: Differentiation,
    /// Numbers of an observation that they look at, the first; the weights of others stay zero.
    seen: usize,
}

/// Working memory of both.
#[derive(Clone, Debug, Default)]
pub struct Scratch {
    actor: ActorScratch,
    critic: CriticScratch,
}

impl Networks {
    /// Networks of zeros, with an actor of this shape.
    pub fn new(shape: Shape, gradient: Differentiation) -> Self {
        let (layout, critic) = (ActorLayout::new(shape), CriticLayout::new(shape.inputs));
        Self {
            actor: Actor::new(layout, &vec![0.0; layout.len]),
            critic: Critic::new(critic, &vec![0.0; critic.len]),
            gradient,
            seen: shape.inputs,
        }
    }

    /// The same that look at the first numbers of an observation alone.
    pub fn seeing(self, seen: usize) -> Self {
        Self { seen, ..self }
    }

    /// Zeros for what they do not look at, in parameters or a gradient.
    fn hide(&self, part: Part, parameters: &mut [f32]) {
        let first = match part {
            Part::Actor => self.actor.layout().encoder,
            Part::Critic => self.critic.layout().first,
        };
        for row in parameters[first.range()].chunks_exact_mut(first.columns) {
            row[self.seen..self.inputs()].fill(0.0);
        }
    }

    /// A learner with initial weights; `sigma` is the standard deviation of the actions, `value_gain` the gain of the critic's output.
    pub fn learner(self, seed: u64, sigma: f32, value_gain: f32, epsilon: f32, learning_rate: f32) -> Learner<Self> {
        let mut actor = self.actor.layout().initial(seed, sigma);
        let mut critic = self.critic.layout().initial(seed, value_gain);
        self.hide(Part::Actor, &mut actor);
        self.hide(Part::Critic, &mut critic);
        Learner::new(self, seed, actor, critic, ValueNorm::new(Forgetting::Iterations), epsilon, learning_rate)
    }
}

impl Networks {
    /// Appends actions around the means that lie in `scratch`, and the logarithms of their densities.
    fn draw(&self, noise: &[f32], scratch: &Scratch, actions: &mut Vec<f32>, log_probabilities: &mut Vec<f32>) {
        let (outputs, log_sigma) = (self.outputs(), self.actor.log_sigma());
        for (mean, noise) in scratch.actor.means.chunks_exact(outputs).zip(noise.chunks_exact(outputs)) {
            let first = actions.len();
            actions.extend((0..outputs).map(|i| mean[i] + log_sigma[i].exp() * noise[i]));
            log_probabilities.push(log_probability(&actions[first..], mean, log_sigma));
        }
    }
}

impl ActorCritic for Networks {
    type Scratch = Scratch;

    const TOGETHER: usize = 1;

    fn block(&self) -> usize {
        match self.gradient {
            // Few enough that what the layers put out stays in the cache of a core.
            Differentiation::Manual => 16,
            Differentiation::Automatic => 64,
        }
    }

    fn inputs(&self) -> usize {
        self.actor.layout().inputs()
    }

    fn outputs(&self) -> usize {
        self.actor.layout().outputs()
    }

    fn memory(&self) -> usize {
        self.actor.layout().memory()
    }

    fn ratio(&self) -> Ratio {
        Ratio::Module
    }

    fn valued(&self) -> Valued {
        Valued::Team
    }

    fn log_sigma(&self) -> Vec<f32> {
        self.actor.log_sigma().to_vec()
    }

    fn load(&mut self, part: Part, parameters: &[f32]) {
        match part {
            Part::Actor => self.actor.load(parameters),
            Part::Critic => self.critic.load(parameters),
        }
    }

    fn sample(
        &self,
        teams: Teams,
        noise: &[f32],
        scratch: &mut Scratch,
        actions: &mut Vec<f32>,
        log_probabilities: &mut Vec<f32>,
    ) {
        let (observations, modules) = (teams.observations, teams.modules);
        self.actor.means(observations, teams.heard, modules, Remembered::default(), &mut scratch.actor);
        self.draw(noise, scratch, actions, log_probabilities);
    }

    fn sample_remembering(
        &self,
        teams: Teams,
        memory: &mut [f32],
        noise: &[f32],
        scratch: &mut Scratch,
        drawn: &mut Drawn,
    ) {
        let follows = vec![false; teams.modules.len()];
        let before = Remembered { before: memory, follows: &follows };
        self.actor.means(teams.observations, teams.heard, teams.modules, before, &mut scratch.actor);
        scratch.actor.remembered(memory);
        self.draw(noise, scratch, &mut drawn.actions, &mut drawn.log_probabilities);
    }

    fn values(&self, teams: Teams, scratch: &mut Scratch, values: &mut Vec<f32>) {
        let Teams { observations, privileged, modules, .. } = teams;
        values.extend_from_slice(self.critic.values(observations, privileged, modules, &mut scratch.critic));
    }

    fn gradient(
        &self,
        batch: &Batch,
        loss: LossSettings,
        scratch: &mut Scratch,
        actor: Option<&mut Gradient>,
        critic: Option<&mut Gradient>,
    ) {
        match self.gradient {
            Differentiation::Manual => {
                if let Some(sum) = actor {
                    self.actor.gradient(batch, loss, &mut scratch.actor, sum);
                }
                if let Some(sum) = critic {
                    self.critic.gradient(batch, loss.team_weight, &mut scratch.critic, sum);
                }
            }
            Differentiation::Automatic => {
                if let Some(sum) = actor {
                    sum.add(&self.actor.layout().autodiff(self.actor.parameters(), batch, loss));
                }
                if let Some(sum) = critic {
                    let layout = self.critic.layout();
                    sum.add(&layout.autodiff(self.critic.parameters(), batch, loss.team_weight));
                }
            }
        }
    }

    fn finish(&self, part: Part, sum: &[f32], loss: LossSettings, to: &mut Vec<f32>) {
        let ordered = self.gradient == Differentiation::Automatic;
        match part {
            Part::Actor => {
                self.actor.finish(sum, ordered, to);
                // The entropy of a normal distribution is ln sigma and a constant.
                to[self.actor.layout().log_sigma.range()].iter_mut().for_each(|g| *g -= loss.entropy);
            }
            Part::Critic => self.critic.finish(sum, ordered, to),
        }
        self.hide(part, to);
    }

    fn floor_sigma(&self, parameters: &mut [f32], sigma: f32) {
        let least = sigma.ln();
        parameters[self.actor.layout().log_sigma.range()].iter_mut().for_each(|l| *l = l.max(least));
    }

    fn rescale(&self, critic: &mut [f32], from: [f32; 2], to: [f32; 2]) {
        self.critic.layout().rescale(critic, from, to);
    }

    fn policy(&self, mean: &[f32], std: &[f32]) -> TrainedPolicy {
        TrainedPolicy::Composer(Box::new(self.actor.network(mean, std)))
    }

    fn told_policy(&self, companion: &Self, mean: &[f32], std: &[f32]) -> TrainedPolicy {
        let (control, imagination) = (self.actor.network(mean, std), companion.actor.network(mean, std));
        TrainedPolicy::Told(Box::new(ToldNetworks { control, imagination }))
    }
}

/// COMPOSER or one of its ablations, as the settings say.
pub fn new(config: &TrainConfig, make: MakeEnvironment) -> Result<OnPolicy<Networks>> {
    let settings = config.composer_settings();
    let (epsilon, rate) = (config.adam_epsilon as f32, config.learning_rate as f32);
    let told = config.method.imagination() && config.imagination.told;
    let inputs = if told { TOLD_INPUTS } else { config.inputs };
    let shape = Shape {
        inputs,
        memory: config.memory,
        distance_bias: config.distance_bias,
        ..Shape::paper(config.method.attention(), ACTIONS)
    };
    let networks = Networks::new(shape, config.gradient);
    let mut control = networks.learner(config.seed, config.sigma as f32, 1.0, epsilon, rate);
    let start = begin(&mut control, config)?;
    let companion = config.method.imagination().then(|| {
        let seed = derive_seed(config.seed, Stream::Imagination, 0, 0);
        let imagination = &config.imagination;
        // It never leaves the training, where nobody has to talk. What is imagined earns a tenth of a unit: a critic that
        // starts with numbers of size 1 would take long to get there.
        let shape = Shape { inputs, ..Shape::paper(imagination.attention, DISPLACEMENT) };
        // What it says itself is nothing to look at.
        let networks = Networks::new(shape, config.gradient).seeing(config.inputs);
        CompanionLearner {
            learner: networks.learner(seed, imagination.sigma as f32, 0.01, epsilon, rate),
            rules: Box::new(Imagination(imagination.clone())),
            settings: OnPolicySettings {
                gamma: imagination.gamma as f32,
                epochs: imagination.epochs,
                critic_epochs: imagination.epochs,
                ..settings
            },
        }
    });
    let mut algorithm = OnPolicy::new(config, settings, control, companion, make)?;
    if let Some(network) = start {
        algorithm.know(&network.mean, &network.std);
    }
    Ok(algorithm)
}

/// Gives the control policy the weights of the run that it begins with, if it does with one.
fn begin(control: &mut Learner<Networks>, config: &TrainConfig) -> Result<Option<Network>> {
    if config.start.is_empty() {
        return Ok(None);
    }
    let (_, policy) = load_run(Path::new(&config.start)).context("the run to start from")?;
    let network = policy.network()?;
    let layout = *control.networks.actor.layout();
    if layout != ActorLayout::new(Shape::of(network)) {
        bail!(
            "the network of {} has another shape than these settings: method, inputs, memory and distance_bias must be those of its run",
            config.start
        );
    }
    control.actor = layout.parameters(network);
    control.actor[layout.log_sigma.range()].fill((config.sigma as f32).ln());
    control.networks.load(Part::Actor, &control.actor);
    Ok(Some(network.clone()))
}

impl TrainConfig {
    /// Rollout and update of the control policy. The imagination policy's differ in discount and epochs.
    pub fn composer_settings(&self) -> OnPolicySettings {
        OnPolicySettings {
            environments: self.environments,
            rollout_steps: self.rollout_steps,
            minibatches: self.minibatches,
            epochs: self.epochs,
            critic_epochs: self.critic_epochs,
            gamma: self.gamma as f32,
            lambda: self.lambda as f32,
            clip: self.clip as f32,
            kl_stop: self.kl_stop as f32,
            entropy: self.entropy as f32,
            actor_grad_norm: self.actor_grad_norm as f32,
            critic_grad_norm: self.critic_grad_norm as f32,
            learning_rate: self.learning_rate,
            learning_rate_end: self.learning_rate_end,
            kl_target: self.kl_target as f32,
            sigma_min: self.sigma_min as f32,
            standardise: Standardise::Rollout(1e-8),
            observation_clip: Some(CLIP),
            reward_clip: None,
        }
    }
}
