//! What the on-policy baselines have in common: their settings, how a run of one begins, and the policy that is left at its end.

use anyhow::{Result, bail};
use composer_shared::observation::BASE;
use serde::{Deserialize, Serialize};

use super::config::TrainConfig;
use super::layout::Layout;
use super::mappo::Mappo;
use super::mat::Mat;
use super::mat_dec::MatDec;
use super::normalise::Forgetting;
use super::on_policy::collect::ACTIONS;
use super::on_policy::taped::{Taped, TapedNetworks};
use super::on_policy::update::Standardise;
use super::on_policy::{ActorCritic, Learner, OnPolicy, OnPolicySettings, Teams};
use super::ppo::{self, Ppo};
use super::smp::SmpPolicy;
use super::{Algorithm, MakeEnvironment, Method, checked};
use crate::environment::{View, with_itself};
use crate::policy::{Memories, Policy};

/// Declares the settings of a baseline, with its authors' as defaults.
macro_rules! settings {
    ($(#[$meta:meta])* $name:ident, $section:literal {
        $environments:literal environments, $rollout_steps:literal steps, $minibatches:literal minibatches, $epochs:literal epochs,
        gamma $gamma:literal, clip $clip:literal, entropy $entropy:literal, grad_norm $grad_norm:literal,
        learning_rate $learning_rate:literal to $learning_rate_end:literal
    }) => {
        $(#[$meta])*
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
        #[serde(deny_unknown_fields, default)]
        pub struct $name {
            /// Environments side by side.
            pub environments: usize,
            /// Steps each takes in an iteration.
            pub rollout_steps: usize,
            /// Minibatches an epoch.
            pub minibatches: usize,
            /// Epochs an iteration.
            pub epochs: usize,
            /// Discount per control step.
            pub gamma: f64,
            /// Decay of generalised advantage estimation.
            pub lambda: f64,
            /// Clip of ratios and values.
            pub clip: f64,
            /// Weight of the entropy bonus.
            pub entropy: f64,
            /// Limit of the norm of each optimiser's gradient.
            pub grad_norm: f64,
            /// Adam's learning rate at the start.
            pub learning_rate: f64,
            /// Share of it that is left at the end; linear in between.
            pub learning_rate_end: f64,
        }

        impl Default for $name {
            fn default() -> Self {
                Self {
                    environments: $environments,
                    rollout_steps: $rollout_steps,
                    minibatches: $minibatches,
                    epochs: $epochs,
                    gamma: $gamma,
                    lambda: 0.95,
                    clip: $clip,
                    entropy: $entropy,
                    grad_norm: $grad_norm,
                    learning_rate: $learning_rate,
                    learning_rate_end: $learning_rate_end,
                }
            }
        }

        impl $name {
            /// Rollout and update, but for what belongs to the method.
            fn on_policy(&self) -> OnPolicySettings {
                OnPolicySettings {
                    environments: self.environments,
                    rollout_steps: self.rollout_steps,
                    minibatches: self.minibatches,
                    epochs: self.epochs,
                    critic_epochs: self.epochs,
                    gamma: self.gamma as f32,
                    lambda: self.lambda as f32,
                    clip: self.clip as f32,
                    kl_stop: f32::INFINITY,
                    entropy: self.entropy as f32,
                    actor_grad_norm: self.grad_norm as f32,
                    critic_grad_norm: self.grad_norm as f32,
                    learning_rate: self.learning_rate,
                    learning_rate_end: self.learning_rate_end,
                    kl_target: 0.0,
                    sigma_min: 0.0,
                    standardise: Standardise::Rollout(1e-5),
                    observation_clip: None,
                    reward_clip: None,
                }
            }

            /// Says what is wrong with the settings, if anything is.
            pub fn validate(&self) -> Result<()> {
                check($section, &self.on_policy())
            }
        }
    };
}

settings! {
    /// Settings of `ppo`: CleanRL's for continuous control, its 2,048 steps an iteration in 32 environments, its 32 minibatches.
    PpoConfig, "ppo" {
        32 environments, 64 steps, 32 minibatches, 10 epochs,
        gamma 0.99, clip 0.2, entropy 0.0, grad_norm 0.5, learning_rate 3e-4 to 0.0
    }
}
settings! {
    /// Settings of `mappo`: HARL's for its Ant 4x2.
    MappoConfig, "mappo" {
        20 environments, 200 steps, 1 minibatches, 5 epochs,
        gamma 0.99, clip 0.1, entropy 0.0, grad_norm 10.0, learning_rate 5e-4 to 1.0
    }
}
settings! {
    /// Settings of `mat`: those released for multi-agent MuJoCo.
    MatConfig, "mat" {
        40 environments, 100 steps, 40 minibatches, 10 epochs,
        gamma 0.99, clip 0.05, entropy 0.001, grad_norm 0.5, learning_rate 5e-5 to 1.0
    }
}
settings! {
    /// Settings of `mat_dec`: MAT's.
    MatDecConfig, "mat_dec" {
        40 environments, 100 steps, 40 minibatches, 10 epochs,
        gamma 0.99, clip 0.05, entropy 0.001, grad_norm 0.5, learning_rate 5e-5 to 1.0
    }
}

/// Says what is wrong with the settings of a section, if anything is.
fn check(section: &str, settings: &OnPolicySettings) -> Result<()> {
    let steps = settings.environments.saturating_mul(settings.rollout_steps);
    let counts = [
        ("environments", settings.environments, 4096),
        ("rollout_steps", settings.rollout_steps, 65_536),
        ("minibatches", settings.minibatches, steps.max(1)),
        ("epochs", settings.epochs, 1000),
    ];
    for (key, value, most) in counts {
        if !(1..=most).contains(&value) {
            bail!("{section}.{key} is {value}; it must be from 1 to {most}");
        }
    }
    for (key, value) in [("gamma", settings.gamma), ("lambda", settings.lambda)] {
        if !(0.0..=1.0).contains(&value) {
            bail!("{section}.{key} is {value}; it must be from 0 to 1");
        }
    }
    let positive = [
        ("clip", settings.clip),
        ("grad_norm", settings.actor_grad_norm),
        ("learning_rate", settings.learning_rate as f32),
    ];
    for (key, value) in positive {
        if !(value.is_finite() && value > 0.0) {
            bail!("{section}.{key} is {value}; it must be a number above 0");
        }
    }
    if !(0.0..=1.0).contains(&settings.learning_rate_end) {
        bail!("{section}.learning_rate_end is {}; it must be from 0 to 1", settings.learning_rate_end);
    }
    if !(settings.entropy.is_finite() && settings.entropy >= 0.0) {
        bail!("{section}.entropy is {}; it must be 0 or more", settings.entropy);
    }
    Ok(())
}

/// A learner of `networks` that has learnt nothing.
pub fn learner<N: TapedNetworks>(networks: N, seed: u64, forgetting: Forgetting, rate: f64) -> Learner<Taped<N>> {
    Learner::untrained(networks.layouts(), |parameters| Taped::new(networks, parameters), seed, forgetting, rate)
}

/// The modules that all environments have, for a method whose critic is made for a number of them.
fn one_length(environments: usize, make: MakeEnvironment, method: Method) -> Result<usize> {
    let first = checked(make(0)?, 0)?.modules();
    for index in 1..environments {
        let modules = make(index)?.modules();
        if modules != first {
            bail!(
                "{method} learns on snakes of one length, because its critic sees all modules side by side; these have {first} and \
                 {modules} modules: set lengths = []"
            );
        }
    }
    Ok(first)
}

/// A run of PPO.
pub fn ppo(config: &TrainConfig, make: MakeEnvironment) -> Result<Box<dyn Algorithm>> {
    let settings = OnPolicySettings {
        standardise: Standardise::Minibatch(1e-8),
        observation_clip: Some(ppo::OBSERVATION_CLIP),
        reward_clip: Some(10.0),
        ..config.ppo.on_policy()
    };
    for index in 0..settings.environments {
        let modules = make(index)?.modules();
        if modules > ppo::MOST_MODULES {
            bail!("ppo is made for at most {} modules; environment {index} has {modules}", ppo::MOST_MODULES);
        }
    }
    let networks = Ppo { modules: ppo::MOST_MODULES };
    let learner = learner(networks, config.seed, Forgetting::Off, config.ppo.learning_rate);
    Ok(Box::new(OnPolicy::new(config, settings, learner, None, make)?))
}

/// A run of MAPPO.
pub fn mappo(config: &TrainConfig, make: MakeEnvironment) -> Result<Box<dyn Algorithm>> {
    let settings = config.mappo.on_policy();
    let networks = Mappo::harl(one_length(settings.environments, make, Method::Mappo)?);
    let learner = learner(networks, config.seed, Forgetting::Minibatches, config.mappo.learning_rate);
    Ok(Box::new(OnPolicy::new(config, settings, learner, None, make)?))
}

/// A run of MAT.
pub fn mat(config: &TrainConfig, make: MakeEnvironment) -> Result<Box<dyn Algorithm>> {
    let learner = learner(Mat, config.seed, Forgetting::Minibatches, config.mat.learning_rate);
    Ok(Box::new(OnPolicy::new(config, config.mat.on_policy(), learner, None, make)?))
}

/// A run of MAT_dec.
pub fn mat_dec(config: &TrainConfig, make: MakeEnvironment) -> Result<Box<dyn Algorithm>> {
    let learner = learner(MatDec, config.seed, Forgetting::Minibatches, config.mat_dec.learning_rate);
    Ok(Box::new(OnPolicy::new(config, config.mat_dec.on_policy(), learner, None, make)?))
}

/// What is left of a baseline at the end of its training.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SavedWeights {
    /// The method.
    pub method: Method,
    /// Modules that its networks are made for, where they are made for a number of them.
    pub modules: usize,
    /// Widths of its hidden layers, where they are a setting.
    pub widths: Vec<usize>,
    /// All parameters.
    pub parameters: Vec<f32>,
    /// Mean of each field of the observation.
    pub mean: Vec<f32>,
    /// Standard deviation of each field.
    pub std: Vec<f32>,
    /// Normalised observations are cut off here.
    pub clip: f32,
}

impl SavedWeights {
    /// Of a method that takes observations as they are.
    pub fn raw(method: Method, parameters: &[f32]) -> Self {
        Self {
            method,
            modules: 0,
            widths: Vec::new(),
            parameters: parameters.to_vec(),
            mean: vec![0.0; BASE],
            std: vec![1.0; BASE],
            clip: f32::MAX,
        }
    }

    /// Of a method that takes them normalised by these statistics, as COMPOSER does.
    pub fn normalising(method: Method, parameters: &[f32], mean: &[f32], std: &[f32]) -> Self {
        Self { mean: mean.to_vec(), std: std.to_vec(), clip: super::normalise::CLIP, ..Self::raw(method, parameters) }
    }

    /// The observations as the networks take them.
    pub fn normalised(&self, view: &View) -> Vec<f32> {
        let of = |(i, x): (usize, &f32)| ((x - self.mean[i]) / self.std[i]).clamp(-self.clip, self.clip);
        view.observations.iter().flat_map(|observation| observation[..BASE].iter().enumerate().map(of)).collect()
    }

    /// Says what is wrong with it, if anything is.
    pub fn check(&self) -> Result<()> {
        let expected = match self.method {
            Method::Ppo => parameters_of(&Ppo { modules: self.modules }),
            Method::Mappo => parameters_of(&Mappo::harl(self.modules)),
            Method::Mat => parameters_of(&Mat),
            Method::MatDec => parameters_of(&MatDec),
            Method::Smp if SmpPolicy::new(self).is_some() => self.parameters.len(),
            method => bail!("its parameters are none of {method}"),
        };
        if self.parameters.len() != expected || self.mean.len() != BASE || self.std.len() != BASE {
            bail!("it has {} parameters where {} has {expected}", self.parameters.len(), self.method);
        }
        if self.parameters.iter().chain(&self.mean).chain(&self.std).any(|x| !x.is_finite()) {
            bail!("a number is not finite: training has diverged, use an earlier checkpoint");
        }
        Ok(())
    }

    /// What evaluation runs.
    pub fn policy(&self) -> Box<dyn Policy + '_> {
        match self.method {
            Method::Ppo => self.with(Ppo { modules: self.modules }),
            Method::Mappo => self.with(Mappo::harl(self.modules)),
            Method::Mat => self.with(Mat),
            Method::MatDec => self.with(MatDec),
            Method::Smp => match SmpPolicy::new(self) {
                Some(policy) => Box::new(policy),
                None => Box::new(crate::policy::Still),
            },
            // `check` refuses it.
            _ => Box::new(crate::policy::Still),
        }
    }

    fn with<N: TapedNetworks>(&self, networks: N) -> Box<dyn Policy + '_> {
        Box::new(MeanPolicy::new(self, Taped::new(networks, self.parameters.clone())))
    }
}

fn parameters_of(networks: &impl TapedNetworks) -> usize {
    networks.layouts().iter().map(Layout::len).sum()
}

/// Networks that act without noise.
pub struct MeanPolicy<'a, C> {
    saved: &'a SavedWeights,
    networks: C,
}

impl<'a, C: ActorCritic> MeanPolicy<'a, C> {
    /// Networks with the weights that were saved of them.
    pub fn new(saved: &'a SavedWeights, networks: C) -> Self {
        Self { saved, networks }
    }
}

impl<C: ActorCritic> Policy for MeanPolicy<'_, C> {
    fn act(
        &self,
        view: &View,
        _noise: u64,
        _memories: &mut Memories,
        actions: &mut Vec<[f32; 2]>,
        _attention: Option<&mut Vec<f32>>,
    ) {
        let all = view.observations.len();
        // Modules beyond those that the networks are made for hang limp.
        let n = self.networks.most_modules().map_or(all, |most| all.min(most));
        let (observations, heard) = (self.saved.normalised(view), with_itself(&view.heard).collect::<Vec<u64>>());
        let teams =
            Teams { observations: &observations[..n * BASE], privileged: &[], heard: &heard[..n], modules: &[n] };
        let (mut means, mut densities) = (Vec::new(), Vec::new());
        self.networks.sample(teams, &vec![0.0; n * ACTIONS], &mut C::Scratch::default(), &mut means, &mut densities);
        actions.clear();
        actions.extend_from_slice(means.as_chunks::<ACTIONS>().0);
        actions.resize(all, [0.0; ACTIONS]);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Gains of the initial matrices by the end of their names; the biases are zeros.
    fn gains(layout: &Layout, parameters: &[f32], expected: &[(&str, f32)], other: f32) {
        for entry in layout.entries().iter().filter(|entry| entry.rows > 1) {
            // All singular values of an orthogonal matrix times a gain are the gain.
            let square: f32 = parameters[entry.range()].iter().map(|w| w * w).sum();
            let gain = (square / entry.rows.min(entry.columns) as f32).sqrt();
            let of = |(end, _): &&(&str, f32)| entry.name.ends_with(&format!("{end}.weight"));
            let expected = expected.iter().find(of).map_or(other, |(_, gain)| *gain);
            assert!((gain - expected).abs() < 1e-4, "{}: {gain} instead of {expected}", entry.name);
        }
        for entry in layout.entries().iter().filter(|entry| entry.name.ends_with("bias")) {
            assert!(
                entry.name.contains("_bias") || parameters[entry.range()].iter().all(|b| *b == 0.0),
                "{}",
                entry.name
            );
        }
    }

    #[test]
    fn initial_weights_have_the_authors_gains() {
        let root2 = std::f32::consts::SQRT_2;
        let small = ["query", "key", "value", "proj", "mlp.2", "decoder.head.3"].map(|name| (name, 0.01));
        let Learner { networks, .. } = learner(Mat, 3, Forgetting::Off, 1e-3);
        gains(networks.layout(), networks.parameters(), &small, root2);
        let Learner { networks, .. } = learner(MatDec, 3, Forgetting::Off, 1e-3);
        let more = [&small[..], &[("decoder.mlp.7", 0.01)]].concat();
        gains(networks.layout(), networks.parameters(), &more, root2);
        for networks in [Mappo::harl(8), Mappo::on_policy(8)] {
            let Learner { networks, .. } = learner(networks, 3, Forgetting::Off, 1e-3);
            gains(networks.layout(), networks.parameters(), &[("fc_mean", 0.01)], root2);
        }
        let Learner { networks, .. } = learner(Ppo { modules: 11 }, 3, Forgetting::Off, 1e-3);
        gains(networks.layout(), networks.parameters(), &[("actor_mean.4", 0.01)], root2);
    }
}
