//! Settings of a learner.

use anyhow::{Result, bail};
use composer_shared::observation::{BASE, SIZE};
use composer_shared::policy::MEMORY;
use serde::{Deserialize, Serialize};

use super::Method;
use super::baselines::{MappoConfig, MatConfig, MatDecConfig, PpoConfig};
use super::composer::Differentiation;
use super::curriculum::{CurriculumConfig, Pretraining, SecondStage};
use super::imagination::ImaginationConfig;
use super::on_policy::update::RATE_LIMITS;
use super::smp::SmpConfig;

/// Settings of the learner. Every field has a default, so that a TOML file needs to name only what it changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// How the policy is built and trained.
    pub method: Method,
    /// Numbers of an observation that the modules of COMPOSER take, the first: 40, the paper's protocol, or 48, with what a module knows of motors and of
    /// distances.
    pub inputs: usize,
    /// Channels of the embedding that they remember: 0, the paper's protocol, or 16. More: slow things can be told from one another, such as a motor that
    /// does not answer; an update takes a fifth longer.
    pub memory: usize,
    /// Whether their attention has a learnt bias by distance along the chain, which carries to longer robots than were trained on.
    pub distance_bias: bool,
    /// Folder of a finished run of COMPOSER whose policy this one begins with, with what it knew of the observations; its critic begins anew. Empty: from
    /// nothing.
    pub start: String,
    /// Seed of the run: same seed, same policy, bit for bit, on the same kind of processor.
    pub seed: u64,
    /// Environment steps (control steps of one snake) in all.
    pub total_steps: u64,
    /// Environments side by side.
    pub environments: usize,
    /// Steps each takes in an iteration. Higher: rewards that come later are seen before the critic is asked, gradients are less noisy, updates fewer.
    pub rollout_steps: usize,
    /// Minibatches an epoch.
    pub minibatches: usize,
    /// Epochs of the actor at most; [`TrainConfig::kl_stop`] may end them.
    pub epochs: usize,
    /// Epochs of the critic.
    pub critic_epochs: usize,
    /// Discount per control step, 0 to 1. Higher looks further ahead and learns slower.
    pub gamma: f64,
    /// Decay of generalised advantage estimation, 0 to 1. Higher: trusts the critic less, and is noisier.
    pub lambda: f64,
    /// Ratios of new to old density count up to 1 +- this.
    pub clip: f64,
    /// Estimated KL divergence at which the actor stops learning from an iteration.
    pub kl_stop: f64,
    /// Adam's learning rate at the start.
    pub learning_rate: f64,
    /// Share of it that is left at the end of the (first) stage; linear in between. Without effect if `kl_target` is set.
    pub learning_rate_end: f64,
    /// KL divergence an update of the actor should come to. Above 0 the learning rate of each policy is divided by 1.5 after an iteration
    /// whose last minibatch was beyond twice that, multiplied by 1.5 if it was below half of it, and stays between 1e-5 and 1e-2.
    /// Higher: learns in larger steps for as long as the run goes on, and ends noisier.
    pub kl_target: f64,
    /// Adam's epsilon.
    pub adam_epsilon: f64,
    /// Limit of the norm of the actor's gradient, over all its parameters.
    pub actor_grad_norm: f64,
    /// The same for the critic.
    pub critic_grad_norm: f64,
    /// Weight of the entropy bonus.
    pub entropy: f64,
    /// Standard deviation of the actions at the start, as a fraction of the torque limit.
    pub sigma: f64,
    /// Least standard deviation of an action, as a fraction of the torque limit (for the imagination policy: of its bound); 0 for none. Higher: goes on
    /// trying other ways, and learns for motors that do not quite what they are told.
    pub sigma_min: f64,
    /// What computes the gradients: `manual` (written by hand, fast) or `automatic` (burn's autodiff, the reference).
    pub gradient: Differentiation,
    /// Environment steps between two evaluations; 0 for none.
    pub evaluate_every: u64,
    /// Episodes of each evaluation.
    pub evaluation_episodes: u64,
    /// Seconds between two checkpoints.
    pub checkpoint_seconds: f64,
    /// Threads; 0 for one per core. The result does not depend on it.
    pub threads: usize,
    /// A run before the run, on the robot as it should be; for COMPOSER and its ablations.
    pub pretraining: Pretraining,
    /// What the episodes are like as the run goes on; for the on-policy methods.
    pub curriculum: CurriculumConfig,
    /// A second stage at a constant rate; for the on-policy methods.
    pub second: SecondStage,
    /// The imagination policy, for the methods that have one.
    pub imagination: ImaginationConfig,
    /// `ppo`, whose settings count there instead of those above; what is not among them is shared by all methods.
    pub ppo: PpoConfig,
    /// `mappo`, likewise.
    pub mappo: MappoConfig,
    /// `mat`, likewise.
    pub mat: MatConfig,
    /// `mat_dec`, likewise.
    pub mat_dec: MatDecConfig,
    /// `smp`, likewise.
    pub smp: SmpConfig,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            method: Method::Composer,
            inputs: BASE,
            memory: 0,
            distance_bias: false,
            start: String::new(),
            seed: 1,
            total_steps: 1_000_000,
            environments: 32,
            rollout_steps: 64,
            minibatches: 4,
            epochs: 5,
            critic_epochs: 5,
            gamma: 0.97,
            lambda: 0.95,
            clip: 0.2,
            kl_stop: 0.03,
            learning_rate: 5e-4,
            learning_rate_end: 0.1,
            kl_target: 0.0,
            adam_epsilon: 1e-5,
            actor_grad_norm: 0.5,
            critic_grad_norm: 1.0,
            entropy: 0.0,
            sigma: 0.45,
            sigma_min: 0.0,
            gradient: Differentiation::default(),
            evaluate_every: 100_000,
            evaluation_episodes: 50,
            checkpoint_seconds: 60.0,
            threads: 0,
            curriculum: CurriculumConfig::default(),
            pretraining: Pretraining::default(),
            second: SecondStage::default(),
            imagination: ImaginationConfig::default(),
            ppo: PpoConfig::default(),
            mappo: MappoConfig::default(),
            mat: MatConfig::default(),
            mat_dec: MatDecConfig::default(),
            smp: SmpConfig::default(),
        }
    }
}

impl TrainConfig {
    /// Threads to work on: those that are set, or one a core.
    pub fn threads(&self) -> usize {
        match self.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        }
    }

    /// Says what is wrong with the settings, if anything is.
    pub fn validate(&self) -> Result<()> {
        let positive = [
            ("learning_rate", self.learning_rate),
            ("adam_epsilon", self.adam_epsilon),
            ("actor_grad_norm", self.actor_grad_norm),
            ("critic_grad_norm", self.critic_grad_norm),
            ("sigma", self.sigma),
            ("clip", self.clip),
            ("kl_stop", self.kl_stop),
        ];
        for (key, value) in positive {
            if !(value.is_finite() && value > 0.0) {
                bail!("{key} is {value}; it must be a number above 0");
            }
        }
        let shares = [("gamma", self.gamma), ("lambda", self.lambda), ("learning_rate_end", self.learning_rate_end)];
        for (key, value) in shares {
            if !(0.0..=1.0).contains(&value) {
                bail!("{key} is {value}; it must be from 0 to 1");
            }
        }
        for (key, value) in [("entropy", self.entropy), ("kl_target", self.kl_target), ("sigma_min", self.sigma_min)] {
            if !(value.is_finite() && value >= 0.0) {
                bail!("{key} is {value}; it must be 0 or more");
            }
        }
        let [low, high] = RATE_LIMITS.map(f64::from);
        if self.kl_target > 0.0 && !(low..=high).contains(&self.learning_rate) {
            bail!("learning_rate is {}; with a kl_target it must be from 0.00001 to 0.01", self.learning_rate);
        }
        if self.sigma_min > self.sigma {
            bail!("sigma_min is {}; it must not be above sigma, {}", self.sigma_min, self.sigma);
        }
        let imagination = self.imagination.sigma;
        if self.method.imagination() && self.sigma_min > imagination {
            bail!("sigma_min is {}; it must not be above imagination.sigma, {imagination}", self.sigma_min);
        }
        if self.checkpoint_seconds.is_nan() || self.checkpoint_seconds < 0.0 {
            bail!("checkpoint_seconds is {}; it must be 0 or more", self.checkpoint_seconds);
        }
        let samples = |environments: usize| environments.saturating_mul(self.rollout_steps).max(1);
        let before = &self.pretraining;
        let limits = [
            ("environments", self.environments, 1, 4096),
            ("pretraining.environments", before.environments, 1, 4096),
            ("rollout_steps", self.rollout_steps, 1, 65_536),
            ("minibatches", self.minibatches, 1, samples(self.environments)),
            ("pretraining.minibatches", before.minibatches, 1, samples(before.environments)),
            ("epochs", self.epochs, 1, 1000),
            ("critic_epochs", self.critic_epochs, 1, 1000),
            ("threads", self.threads, 0, 1024),
        ];
        for (key, value, low, high) in limits {
            if !(low..=high).contains(&value) {
                bail!("{key} is {value}; it must be from {low} to {high}");
            }
        }
        if self.inputs != BASE && self.inputs != SIZE {
            bail!("inputs is {}; it must be {BASE}, the paper's protocol, or {SIZE}", self.inputs);
        }
        if self.imagination.told && self.method.imagination() && self.inputs != BASE {
            bail!("inputs is {}; with imagination.told it must be {BASE}", self.inputs);
        }
        if self.memory != 0 && self.memory != MEMORY {
            bail!("memory is {}; it must be 0 or {MEMORY}", self.memory);
        }
        if self.distance_bias && !self.method.attention() {
            bail!("distance_bias is of no use to {}, which has no attention", self.method);
        }
        if self.total_steps == 0 {
            bail!("total_steps is 0; it must be at least 1");
        }
        self.pretraining.validate()?;
        if self.pretraining.steps > 0 && !Method::COMPOSERS.contains(&self.method) {
            bail!("pretraining.steps is {}; {} begins from nothing: it must be 0", self.pretraining.steps, self.method);
        }
        if self.pretraining.steps > 0 && !self.start.is_empty() {
            bail!("a run begins with what was pretrained or with start = {:?}, not with both", self.start);
        }
        self.curriculum.validate()?;
        self.second.validate()?;
        self.imagination.validate()?;
        self.ppo.validate()?;
        self.mappo.validate()?;
        self.mat.validate()?;
        self.mat_dec.validate()?;
        self.smp.validate()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn settings_are_checked() {
        TrainConfig::default().validate().unwrap();
        for (text, complaint) in [
            ("gamma = 1.5", "gamma is 1.5; it must be from 0 to 1"),
            ("environments = 0", "environments is 0; it must be from 1 to 4096"),
            ("minibatches = 1000000", "minibatches is 1000000; it must be from 1 to 2048"),
            ("sigma = 0.0", "sigma is 0; it must be a number above 0"),
            ("total_steps = 0", "total_steps is 0"),
            ("learning_rate = nan", "learning_rate is NaN"),
            ("entropy = -0.1", "entropy is -0.1; it must be 0 or more"),
            ("kl_target = -0.01", "kl_target is -0.01; it must be 0 or more"),
            ("kl_target = 0.01\nlearning_rate = 0.1", "learning_rate is 0.1; with a kl_target it must be from 0.00001"),
            ("sigma_min = 0.5", "sigma_min is 0.5; it must not be above sigma, 0.45"),
            ("sigma = 0.8\nsigma_min = 0.5", "sigma_min is 0.5; it must not be above imagination.sigma, 0.45"),
            (
                "method = \"mappo\"\npretraining.steps = 9",
                "pretraining.steps is 9; mappo begins from nothing: it must be 0",
            ),
            (
                "start = \"a\"\npretraining.steps = 9",
                "begins with what was pretrained or with start = \"a\", not with both",
            ),
            ("pretraining.environments = 0", "pretraining.environments is 0; it must be from 1 to 4096"),
            ("pretraining.minibatches = 0", "pretraining.minibatches is 0; it must be from 1 to 2048"),
            ("pretraining.blind = -0.5", "pretraining.blind is -0.5; it must be from 0 to 1"),
            ("inputs = 48\nimagination.told = true", "inputs is 48; with imagination.told it must be 40"),
        ] {
            let config: TrainConfig = toml::from_str(text).unwrap();
            let error = config.validate().unwrap_err().to_string();
            assert!(error.contains(complaint), "{error}");
        }
        assert!(toml::from_str::<TrainConfig>("gammma = 1.0").unwrap_err().message().contains("gammma"));
        assert!(
            toml::from_str::<TrainConfig>("method = \"ppo2\"")
                .unwrap_err()
                .message()
                .contains("composer-no-imagination")
        );
    }

    #[test]
    fn the_learning_rate_falls_linearly() {
        let config = TrainConfig { learning_rate: 1.0, learning_rate_end: 0.1, ..Default::default() };
        let settings = config.composer_settings();
        assert_eq!(settings.learning_rate_at(0, 10), 1.0);
        assert!((settings.learning_rate_at(5, 10) - 0.55).abs() < 1e-6);
    }
}
