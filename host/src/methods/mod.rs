//! The learning methods, one file each, and what they share.
//!
//! A method is an [`Algorithm`]: it iterates, hands over its policy, saves and loads. [`on_policy`] is one for every method that brings its
//! networks as an [`on_policy::ActorCritic`], [`off_policy`] for those with a replay buffer. What they share further: flat parameters with an optimiser ([`parameters`]), normalisers
//! ([`normalise`]), random streams ([`random`]) and threads ([`workers`]).

pub mod baselines;
pub mod composer;
pub mod config;
pub mod curriculum;
pub mod imagination;
pub(crate) mod kernels;
pub mod layers;
pub mod layout;
pub mod mappo;
pub mod mat;
pub mod mat_dec;
pub mod normalise;
pub mod off_policy;
pub mod on_policy;
pub mod parameters;
pub mod ppo;
pub mod random;
pub mod ranks;
pub(crate) mod simd;
pub mod smp;
pub mod tensors;
pub mod workers;

use std::sync::Arc;
use std::time::Duration;

use anyhow::{Result, bail};
use serde::{Deserialize, Serialize};

pub use self::baselines::SavedWeights;
pub use self::composer::Differentiation;
use self::composer::float::FloatPolicy;
use self::composer::told::{ToldNetworks, ToldPolicy};
pub use self::config::TrainConfig;
use self::ranks::Ranks;
use crate::environment::{Environment, Outcome};
use crate::network::Network;
use crate::policy::Policy;
pub(crate) use composer_shared::random::mix;

/// How a policy is built and trained.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// COMPOSER (paper, section III): self-attention over the latents of the modules heard, and the imagination policy ([`imagination`]).
    Composer,
    /// COMPOSER without the imagination policy.
    ComposerNoImagination,
    /// COMPOSER without attention: modules do not talk.
    ComposerNoAttention,
    /// COMPOSER with neither: its actor, alone with what its own module observes.
    ComposerNeither,
    /// PPO, central and zero-padded ([`ppo`]).
    Ppo,
    /// MAPPO ([`mappo`]).
    Mappo,
    /// MAT ([`mat`]).
    Mat,
    /// MAT_dec ([`mat_dec`]).
    #[serde(rename = "mat_dec")]
    MatDec,
    /// SMP ([`smp`]).
    Smp,
}

impl Method {
    /// Every method, in the order of the documentation.
    pub const ALL: [Method; 9] = [
        Method::Composer,
        Method::ComposerNoImagination,
        Method::ComposerNoAttention,
        Method::ComposerNeither,
        Method::Ppo,
        Method::Mappo,
        Method::Mat,
        Method::MatDec,
        Method::Smp,
    ];

    /// COMPOSER and its ablations.
    pub const COMPOSERS: [Method; 4] =
        [Method::Composer, Method::ComposerNoImagination, Method::ComposerNoAttention, Method::ComposerNeither];

    /// Name on the command line and in files.
    pub fn name(self) -> &'static str {
        match self {
            Method::Composer => "composer",
            Method::ComposerNoImagination => "composer-no-imagination",
            Method::ComposerNoAttention => "composer-no-attention",
            Method::ComposerNeither => "composer-neither",
            Method::Ppo => "ppo",
            Method::Mappo => "mappo",
            Method::Mat => "mat",
            Method::MatDec => "mat_dec",
            Method::Smp => "smp",
        }
    }

    /// The method of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Self::ALL.into_iter().find(|method| method.name() == name)
    }

    /// Whether its modules act alone, on their own observations, by a network that is not of the image's form: such a one can learn what theirs
    /// does ([`crate::distil`]).
    pub(crate) fn acts_alone(self) -> bool {
        matches!(self, Method::Mappo | Method::MatDec)
    }

    /// Why a policy of this method has no network of the image's form, in a sentence.
    fn why_not_frozen(self) -> &'static str {
        match self {
            Method::Mappo | Method::MatDec => {
                "mappo and mat_dec normalise every layer, which the image's network does not"
            }
            Method::Ppo => {
                "ppo decides for all modules in one place, so there is nothing that a module could run alone"
            }
            Method::Mat => {
                "mat lets the modules decide one after the other, which no control step of the bus has time for"
            }
            Method::Smp => {
                "smp passes messages from tail to head and back, which no control step of the bus has time for"
            }
            _ => "its network is none of COMPOSER's",
        }
    }

    /// Whether the actor attends to the latents of other modules.
    pub fn attention(self) -> bool {
        matches!(self, Method::Composer | Method::ComposerNoImagination)
    }

    /// Whether an imagination policy guides the training.
    pub fn imagination(self) -> bool {
        matches!(self, Method::Composer | Method::ComposerNoAttention)
    }
}

impl std::fmt::Display for Method {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.write_str(self.name())
    }
}

impl std::str::FromStr for Method {
    type Err = String;

    fn from_str(name: &str) -> Result<Self, String> {
        Self::from_name(name).ok_or_else(|| {
            let names: Vec<_> = Self::ALL.iter().map(|method| method.name()).collect();
            format!("there is no method `{name}`; the methods are {}", names.join(", "))
        })
    }
}

/// Makes the environment of an index. The same index must always give the same environment.
pub type MakeEnvironment<'a> = &'a dyn Fn(usize) -> Result<Box<dyn Environment>>;

/// A learning method with all that it has learnt so far.
pub trait Algorithm: Send {
    /// Collects experience and learns once.
    ///
    /// # Errors
    ///
    /// If training diverged.
    fn iterate(&mut self) -> Result<Report>;

    /// The policy as it is now.
    fn policy(&self) -> TrainedPolicy;

    /// Iterations done.
    fn iteration(&self) -> u64;

    /// Environment steps in an iteration.
    fn steps_per_iteration(&self) -> u64;

    /// All that [`Algorithm::load`] needs to go on bit for bit.
    fn save(&self) -> State;

    /// Brings a new one to where another was.
    ///
    /// # Errors
    ///
    /// If that was of another method, other settings or another version.
    fn load(&mut self, state: &State, make: MakeEnvironment) -> Result<()>;

    /// Shares the work with other processes from now on; all of them must have the same settings and be at the same iteration.
    ///
    /// # Errors
    ///
    /// If the method cannot.
    fn join_ranks(&mut self, ranks: Arc<dyn Ranks>) -> Result<()>;
}

/// A run of the method that the settings name, which has not begun.
///
/// # Errors
///
/// If the settings are not possible, or an environment cannot be made.
pub fn create(config: &TrainConfig, make: MakeEnvironment) -> Result<Box<dyn Algorithm>> {
    config.validate()?;
    Ok(match config.method {
        Method::Composer | Method::ComposerNoImagination | Method::ComposerNoAttention | Method::ComposerNeither => {
            Box::new(composer::new(config, make)?)
        }
        Method::Ppo => baselines::ppo(config, make)?,
        Method::Mappo => baselines::mappo(config, make)?,
        Method::Mat => baselines::mat(config, make)?,
        Method::MatDec => baselines::mat_dec(config, make)?,
        Method::Smp => Box::new(smp::new(config, make)?),
    })
}

/// What training hands over: a policy with all that it needs.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(untagged)]
pub enum TrainedPolicy {
    /// The network of COMPOSER or one of its ablations, which can be frozen.
    Composer(Box<Network>),
    /// Those of COMPOSER where the control policy is told what is imagined, which cannot.
    Told(Box<ToldNetworks>),
    /// That of a baseline, which cannot.
    Weights(SavedWeights),
}

impl TrainedPolicy {
    /// The network that can be frozen to integers and run on modules.
    ///
    /// # Errors
    ///
    /// If the method has none.
    pub fn network(&self) -> Result<&Network> {
        match self {
            TrainedPolicy::Composer(network) => Ok(network),
            TrainedPolicy::Told(_) => {
                bail!("with imagination.told it needs the imagination policy, too, for which the image has no room")
            }
            TrainedPolicy::Weights(saved) => bail!("{}", saved.method.why_not_frozen()),
        }
    }

    /// Whether modules can run it, each for itself: its network, or one that has learnt what it does.
    ///
    /// # Errors
    ///
    /// If they cannot: why.
    pub fn runs_on_modules(&self) -> Result<()> {
        match self {
            TrainedPolicy::Weights(saved) if saved.method.acts_alone() => Ok(()),
            _ => self.network().map(drop),
        }
    }

    /// Says what is wrong with it, if anything is.
    pub fn check(&self) -> Result<()> {
        match self {
            TrainedPolicy::Composer(network) => Ok(network.check()?),
            TrainedPolicy::Told(networks) => networks.check(),
            TrainedPolicy::Weights(saved) => saved.check(),
        }
    }

    /// What decides the torques.
    pub fn policy(&self) -> Box<dyn Policy + '_> {
        match self {
            TrainedPolicy::Composer(network) => Box::new(FloatPolicy::new(network)),
            TrainedPolicy::Told(networks) => Box::new(ToldPolicy::new(networks)),
            TrainedPolicy::Weights(saved) => saved.policy(),
        }
    }
}

/// What an iteration did.
#[derive(Clone, Debug)]
pub struct Report {
    /// Where the time went.
    pub times: Times,
    /// The same seed always gives the same numbers here.
    pub scalars: Vec<(String, f64)>,
}

impl Report {
    /// The number of that name; NaN if there is none.
    pub fn get(&self, name: &str) -> f64 {
        self.scalars.iter().find(|(key, _)| key == name).map_or(f64::NAN, |(_, value)| *value)
    }
}

/// Where the time of some iterations went, wall time on all cores but for the two parts of the rollout.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Times {
    /// Environment steps.
    pub steps: u64,
    /// Wall time.
    pub wall: Duration,
    /// Wall time of the rollouts, the part spent in the environments.
    pub physics: Duration,
    /// Wall time of the rollouts, the part spent in the policy and in book-keeping.
    pub inference: Duration,
    /// Wall time of the updates.
    pub update: Duration,
}

impl Times {
    /// Adds another span of time.
    pub fn add(&mut self, other: &Times) {
        self.steps += other.steps;
        self.wall += other.wall;
        self.physics += other.physics;
        self.inference += other.inference;
        self.update += other.update;
    }

    /// Environment steps per second.
    pub fn steps_per_second(&self) -> f64 {
        self.steps as f64 / self.wall.as_secs_f64().max(1e-9)
    }

    /// Shares of physics, inference and update, 0 to 1.
    pub fn shares(&self) -> [f64; 3] {
        let total = (self.physics + self.inference + self.update).as_secs_f64().max(1e-9);
        [self.physics, self.inference, self.update].map(|part| part.as_secs_f64() / total)
    }
}

/// The state of an algorithm between two iterations.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct State {
    /// Iterations done.
    pub iteration: u64,
    /// What each of its policies has learnt, the control policy first.
    pub learners: Vec<LearnerState>,
    /// Statistics: whatever numbers the normalisers are made of.
    pub statistics: Vec<f64>,
    /// One entry per environment.
    pub episodes: Vec<EpisodeState>,
    /// The replay buffer of an off-policy method, in numbers of its own; else empty.
    pub replay: Vec<f32>,
}

/// A running episode of one environment: replaying its actions after the reset leads back to where it was.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct EpisodeState {
    /// Its number, which gives its seed.
    pub number: u64,
    /// Actions since the reset.
    pub actions: Vec<[f32; 2]>,
}

/// One policy and its critic.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LearnerState {
    /// Steps taken by the actor's and the critic's optimiser.
    pub adam_steps: [u64; 2],
    /// Parameters, then both moments of Adam: of the actor, then of the critic.
    pub parameters: [Vec<f32>; 6],
    /// Statistics of the returns.
    pub value_norm: [f64; 3],
    /// Learning rate of the next update, if it is adapted.
    pub learning_rate: f32,
}

/// The environment, if it is one that can be trained in.
fn checked(environment: Box<dyn Environment>, index: usize) -> Result<Box<dyn Environment>> {
    let modules = environment.modules();
    if !(1..=composer_shared::robot::MAX_MODULES).contains(&modules) {
        bail!("environment {index} has {modules} modules; there must be 1 to {}", composer_shared::robot::MAX_MODULES);
    }
    Ok(environment)
}

/// What is logged of the episodes that ended in an iteration.
fn episode_scalars(episodes: &[&Outcome]) -> Vec<(String, f64)> {
    let mean =
        |f: &dyn Fn(&Outcome) -> f64| episodes.iter().map(|outcome| f(outcome)).sum::<f64>() / episodes.len() as f64;
    vec![
        ("charts/episodic_return".into(), mean(&|o| f64::from(o.episode_return))),
        ("charts/episodic_length".into(), mean(&|o| f64::from(o.steps))),
        ("charts/success_rate".into(), mean(&|o| f64::from(u8::from(o.success)))),
        ("charts/final_distance".into(), mean(&|o| f64::from(o.distance))),
        ("charts/episodes".into(), episodes.len() as f64),
    ]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn methods_have_names() {
        for method in Method::ALL {
            assert_eq!(method.name().parse::<Method>(), Ok(method));
            assert_eq!(serde_json::to_string(&method).unwrap(), format!("\"{}\"", method.name()));
        }
        assert!("composers".parse::<Method>().unwrap_err().contains("composer-neither, ppo, mappo, mat, mat_dec, smp"));
    }
}
