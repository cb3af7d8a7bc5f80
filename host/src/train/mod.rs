//! The training loop: collect, learn, log, save, until the steps are used up or somebody presses Ctrl-C.

pub mod checkpoint;
pub mod metrics;
pub mod progress;
pub mod tensorboard;

use std::path::Path;
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use composer_shared::observation::SIZE;
use serde::{Deserialize, Serialize};

use self::checkpoint::{Checkpoint, Episode, LearnerState};
use self::metrics::Metrics;
use self::progress::{Progress, Times};
use crate::environment::{Environment, PRIVILEGED};
use crate::methods::actor::Actor;
use crate::methods::actor_critic::ActorLayout;
use crate::methods::buffer::Experience;
use crate::methods::imagination::{Imagination, ImaginationConfig};
use crate::methods::normalise::{Running, ValueNorm};
use crate::methods::ppo::{Learner, PpoSettings, RATE_LIMITS, Workspace, update};
use crate::methods::rollout::{Frozen, Iteration, Slot, collect};
use crate::methods::{Differentiation, Method, Stream, derive_seed};
use crate::network::Network;

/// Settings of the learner. Every field has a default, so that a TOML file needs to name only what it changes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TrainConfig {
    /// How the policy is built and trained.
    pub method: Method,
    /// Seed of the run: same seed, same policy, bit for bit, on the same kind of processor.
    pub seed: u64,
    /// Environment steps (control steps of one snake) in all.
    pub total_steps: u64,
    /// Environments side by side.
    pub environments: usize,
    /// Steps each takes in an iteration.
    pub rollout_steps: usize,
    /// Minibatches an epoch.
    pub minibatches: usize,
    /// Epochs of the actor at most; [`TrainConfig::kl_stop`] may end them.
    pub epochs: usize,
    /// Epochs of the critic.
    pub critic_epochs: usize,
    /// Discount per control step, 0 to 1. Higher looks further ahead and learns slower.
    pub gamma: f64,
    /// Decay of generalised advantage estimation, 0 to 1.
    pub lambda: f64,
    /// Ratios of new to old density count up to 1 +- this.
    pub clip: f64,
    /// Estimated KL divergence at which the actor stops learning from an iteration.
    pub kl_stop: f64,
    /// Adam's learning rate at the start.
    pub learning_rate: f64,
    /// Share of it that is left at the end; linear in between. Without effect if `kl_target` is set.
    pub learning_rate_end: f64,
    /// KL divergence an update of the actor should come to. Above 0 the learning rate of each policy is divided by 1.5 after an iteration
    /// whose last minibatch was beyond twice that, multiplied by 1.5 if it was below half of it, and stays between 1e-5 and 1e-2.
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
    /// Least standard deviation of an action, as a fraction of the torque limit (for the imagination policy: of its bound); 0 for none.
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
    /// The imagination policy, for the methods that have one.
    pub imagination: ImaginationConfig,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            method: Method::Composer,
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
            imagination: ImaginationConfig::default(),
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
        let limits = [
            ("environments", self.environments, 1, 4096),
            ("rollout_steps", self.rollout_steps, 1, 65_536),
            ("minibatches", self.minibatches, 1, self.environments.saturating_mul(self.rollout_steps).max(1)),
            ("epochs", self.epochs, 1, 1000),
            ("critic_epochs", self.critic_epochs, 1, 1000),
            ("threads", self.threads, 0, 1024),
        ];
        for (key, value, low, high) in limits {
            if !(low..=high).contains(&value) {
                bail!("{key} is {value}; it must be from {low} to {high}");
            }
        }
        if self.total_steps == 0 {
            bail!("total_steps is 0; it must be at least 1");
        }
        self.imagination.validate()
    }

    /// Environment steps in an iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        (self.environments * self.rollout_steps) as u64
    }

    /// Iterations of the whole run.
    pub fn iterations(&self) -> u64 {
        self.total_steps.div_ceil(self.steps_per_iteration())
    }

    /// Learning rate of an iteration, if it falls linearly.
    pub fn learning_rate_at(&self, iteration: u64) -> f32 {
        let done = iteration as f64 / self.iterations().max(1) as f64;
        (self.learning_rate * (1.0 - done * (1.0 - self.learning_rate_end))) as f32
    }

    /// The part that the update of the control policy needs. That of the imagination policy differs in discount and epochs.
    pub fn ppo(&self) -> PpoSettings {
        PpoSettings {
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
            kl_target: self.kl_target as f32,
            sigma_min: self.sigma_min as f32,
            gradient: self.gradient,
        }
    }
}

/// What a run came to.
#[derive(Clone, Debug)]
pub struct TrainSummary {
    /// The policy at the end.
    pub network: Network,
    /// Environment steps taken, those before a resumption included.
    pub steps: u64,
    /// Iterations done.
    pub iterations: u64,
    /// Whether the run was stopped before its end (and can be resumed).
    pub interrupted: bool,
    /// Wall time since the start or the last resumption.
    pub wall: Duration,
    /// What the last evaluation said.
    pub evaluation: Vec<(String, f64)>,
}

/// Makes the environment of an index. The same index must always give the same environment.
pub type MakeEnvironment<'a> = &'a dyn Fn(usize) -> Result<Box<dyn Environment>>;

/// Judges a policy after so many steps; what it returns goes into the metrics under these names.
pub type Evaluate<'a> = &'a mut dyn FnMut(&Network, u64) -> Vec<(String, f64)>;

/// A run between two iterations.
pub struct Trainer {
    config: TrainConfig,
    fingerprint: String,
    control: Learner,
    imagination: Option<Learner>,
    observations: Running,
    privileged: Running,
    slots: Vec<Slot>,
    experience: Experience,
    iteration: u64,
    workspace: Workspace,
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

impl Trainer {
    /// A run that has not begun.
    pub fn new(config: &TrainConfig, make: MakeEnvironment, fingerprint: &str) -> Result<Self> {
        config.validate()?;
        let mut slots = Vec::with_capacity(config.environments);
        for index in 0..config.environments {
            slots.push(Slot::new(checked(make(index)?, index)?, index, config.seed));
        }
        let epsilon = config.adam_epsilon as f32;
        let rate = config.learning_rate as f32;
        let layout = ActorLayout::control(config.method);
        let control = Learner::new(layout, config.seed, config.sigma as f32, 1.0, epsilon, rate);
        let imagination = config.method.imagination().then(|| {
            let seed = derive_seed(config.seed, Stream::Imagination, 0, 0);
            let sigma = config.imagination.sigma as f32;
            // What is imagined earns a tenth of a unit: a critic that starts with numbers of size 1 would take long to get there.
            Learner::new(ActorLayout::imagination(), seed, sigma, 0.01, epsilon, rate)
        });
        Ok(Self {
            control,
            imagination,
            observations: Running::new(SIZE),
            privileged: Running::new(PRIVILEGED),
            experience: Experience::new(config.environments),
            slots,
            iteration: 0,
            workspace: Workspace::new(config.threads()).context("the threads cannot be started")?,
            config: config.clone(),
            fingerprint: fingerprint.into(),
        })
    }

    /// A run as a checkpoint has it. The settings must be those of the checkpoint; only how long it runs, how often it evaluates and
    /// saves, and the threads may differ.
    pub fn resume(
        checkpoint: &Checkpoint,
        config: &TrainConfig,
        make: MakeEnvironment,
        fingerprint: &str,
    ) -> Result<Self> {
        if checkpoint.fingerprint != fingerprint {
            bail!(
                "the checkpoint is of another robot or task: it was trained for `{}`, this is `{fingerprint}`",
                checkpoint.fingerprint
            );
        }
        let mut was = config_of(checkpoint)?;
        was.total_steps = config.total_steps;
        was.evaluate_every = config.evaluate_every;
        was.evaluation_episodes = config.evaluation_episodes;
        was.checkpoint_seconds = config.checkpoint_seconds;
        was.threads = config.threads;
        if was != *config {
            let (was, is) = (settings_of(&was)?, settings_of(config)?);
            let changed = was.iter().filter(|setting| !is.contains(setting));
            let changed: Vec<_> = changed.map(|(key, value)| format!("{key} (it was {value})")).collect();
            bail!("a resumed run keeps its settings, but these were changed: {}", changed.join(", "));
        }
        let mut trainer = Self::new(config, make, fingerprint)?;
        trainer.iteration = checkpoint.iteration;
        let learners = || [Some(&trainer.control), trainer.imagination.as_ref()].into_iter().flatten();
        if checkpoint.learners.len() != learners().count() {
            bail!(
                "the checkpoint has {} policies where the method {} has {}",
                checkpoint.learners.len(),
                config.method,
                learners().count()
            );
        }
        let learners = [Some(&mut trainer.control), trainer.imagination.as_mut()].into_iter().flatten();
        for (learner, state) in learners.zip(&checkpoint.learners) {
            restore(learner, state)?;
        }
        let mut numbers = checkpoint.statistics.iter().copied();
        let statistics =
            (|| Some((Running::from_numbers(SIZE, &mut numbers)?, Running::from_numbers(PRIVILEGED, &mut numbers)?)))();
        let Some((observations, privileged)) = statistics else {
            bail!("the checkpoint has too few statistics: it is of another version");
        };
        (trainer.observations, trainer.privileged) = (observations, privileged);
        if checkpoint.episodes.len() != config.environments {
            bail!(
                "the checkpoint has {} environments, the settings say {}",
                checkpoint.episodes.len(),
                config.environments
            );
        }
        for (index, episode) in checkpoint.episodes.iter().enumerate() {
            let environment = checked(make(index)?, index)?;
            let slot = Slot::restore(environment, index, config.seed, episode.number, episode.actions.clone());
            trainer.slots[index] = slot;
        }
        Ok(trainer)
    }

    /// All that [`Trainer::resume`] needs.
    pub fn checkpoint(&self) -> Result<Checkpoint> {
        let episode = |slot: &Slot| Episode { number: slot.episode, actions: slot.actions.clone() };
        Ok(Checkpoint {
            config: toml::to_string(&self.config).context("the settings cannot be written as TOML")?,
            fingerprint: self.fingerprint.clone(),
            iteration: self.iteration,
            learners: [Some(&self.control), self.imagination.as_ref()].into_iter().flatten().map(state).collect(),
            statistics: self.observations.numbers().chain(self.privileged.numbers()).collect(),
            episodes: self.slots.iter().map(episode).collect(),
        })
    }

    /// Collects and learns once.
    pub fn iterate(&mut self) -> Result<Report> {
        let began = Instant::now();
        let policy = Actor::new(self.control.layout, &self.control.actor);
        let settings = &self.config.imagination;
        let imagined_by = self.imagination.as_ref().map(|learner| Actor::new(learner.layout, &learner.actor));
        let imagination = self.imagination.as_ref().zip(imagined_by.as_ref()).map(|(learner, policy)| Imagination {
            policy,
            seed: learner.seed,
            bound: settings.bound as f32,
            follow: settings.follow as f32,
        });
        let iteration = Iteration {
            policy: &policy,
            imagination,
            observations: Frozen::new(&self.observations),
            privileged: Frozen::new(&self.privileged),
            run_seed: self.config.seed,
            iteration: self.iteration,
            steps: self.config.rollout_steps,
        };
        let (observations, privileged) = (&mut self.observations, &mut self.privileged);
        let workers = &self.workspace.workers;
        let split = collect(&mut self.slots, &mut self.experience, iteration, workers, observations, privileged);
        let rollout = began.elapsed();
        let linear = self.config.learning_rate_at(self.iteration);
        let adaptive = self.config.kl_target > 0.0;
        let rate_of = |learner: &Learner| if adaptive { learner.learning_rate } else { linear };
        let learning_rate = rate_of(&self.control);
        let ppo = self.config.ppo();
        let workspace = &mut self.workspace;
        let Experience { lanes, control, imagination } = &mut self.experience;
        let stats = update(&mut self.control, lanes, control, &ppo, learning_rate, self.iteration, workspace);
        let imagination_stats = self.imagination.as_mut().map(|learner| {
            let epochs = settings.epochs;
            let ppo = PpoSettings { gamma: settings.gamma as f32, epochs, critic_epochs: epochs, ..ppo };
            let rate = rate_of(learner);
            let stats = update(learner, lanes, imagination, &ppo, rate, self.iteration, workspace);
            (stats, rate)
        });
        if ![Some(&self.control), self.imagination.as_ref()].into_iter().flatten().all(Learner::is_finite) {
            bail!(
                "training diverged in iteration {}: a weight is no longer a finite number. The last checkpoint is from before; \
                 a lower learning_rate may help",
                self.iteration + 1
            );
        }
        self.iteration += 1;

        let wall = began.elapsed();
        // The threads' own times, scaled to the wall time of the rollout they fill together.
        let busy = (split.physics + split.inference).as_secs_f64().max(1e-9);
        let physics = rollout.mul_f64(split.physics.as_secs_f64() / busy);
        let times = Times {
            steps: self.config.steps_per_iteration(),
            wall,
            physics,
            inference: rollout.saturating_sub(physics),
            update: wall.saturating_sub(rollout),
        };
        let Experience { lanes, imagination, .. } = &self.experience;
        let episodes: Vec<_> = lanes.iter().flat_map(|lane| &lane.episodes).collect();
        let mean = |f: &dyn Fn(&crate::environment::Outcome) -> f64| {
            episodes.iter().map(|outcome| f(outcome)).sum::<f64>() / episodes.len() as f64
        };
        let steps = self.config.steps_per_iteration() as f64;
        let rewards: f64 = lanes.iter().flat_map(|lane| &lane.rewards).map(|r| f64::from(*r)).sum();
        let mut scalars = vec![
            ("charts/episodic_return".to_string(), mean(&|o| f64::from(o.episode_return))),
            ("charts/episodic_length".into(), mean(&|o| f64::from(o.steps))),
            ("charts/success_rate".into(), mean(&|o| f64::from(u8::from(o.success)))),
            ("charts/final_distance".into(), mean(&|o| f64::from(o.distance))),
            ("charts/episodes".into(), episodes.len() as f64),
            ("charts/step_reward".into(), rewards / steps),
            ("charts/learning_rate".into(), f64::from(learning_rate)),
            ("charts/sigma".into(), self.control.sigma()),
        ];
        scalars.extend(stats.scalars().map(|(name, value)| (format!("losses/{name}"), value)));
        if let (Some(learner), Some((stats, rate))) = (&self.imagination, imagination_stats) {
            let rewards: f64 = imagination.iter().flat_map(|track| &track.rewards).map(|r| f64::from(*r)).sum();
            let errors: f64 = lanes.iter().flat_map(|lane| &lane.follow_errors).map(|e| f64::from(*e)).sum();
            scalars.push(("imagination/reward".into(), rewards / steps));
            scalars.push(("imagination/follow_error".into(), errors / steps));
            scalars.push(("imagination/learning_rate".into(), f64::from(rate)));
            scalars.push(("imagination/sigma".into(), learner.sigma()));
            scalars.extend(stats.scalars().map(|(name, value)| (format!("imagination/{name}"), value)));
        }
        Ok(Report { times, scalars })
    }

    /// The policy as it is now.
    pub fn network(&self) -> Network {
        let learner = &self.control;
        learner.layout.network(&learner.actor, self.observations.mean(), self.observations.std())
    }

    /// Environment steps taken.
    pub fn steps(&self) -> u64 {
        self.iteration * self.config.steps_per_iteration()
    }

    /// Iterations done.
    pub fn iteration(&self) -> u64 {
        self.iteration
    }

    /// The control policy and its critic as they are now.
    pub fn control(&self) -> &Learner {
        &self.control
    }

    /// The imagination policy and its critic, if the method has one.
    pub fn imagination(&self) -> Option<&Learner> {
        self.imagination.as_ref()
    }
}

/// What a checkpoint keeps of a learner.
fn state(learner: &Learner) -> LearnerState {
    let Learner { actor, critic, actor_adam, critic_adam, value_norm, learning_rate, .. } = learner;
    let vectors = [actor, &actor_adam.first, &actor_adam.second, critic, &critic_adam.first, &critic_adam.second];
    LearnerState {
        adam_steps: [actor_adam.steps, critic_adam.steps],
        parameters: vectors.map(Clone::clone),
        value_norm: value_norm.numbers(),
        learning_rate: *learning_rate,
    }
}

/// Brings a new learner to where one was.
fn restore(learner: &mut Learner, state: &LearnerState) -> Result<()> {
    let Learner { actor, critic, actor_adam, critic_adam, value_norm, learning_rate, .. } = learner;
    let vectors =
        [actor, &mut actor_adam.first, &mut actor_adam.second, critic, &mut critic_adam.first, &mut critic_adam.second];
    for (to, from) in vectors.into_iter().zip(&state.parameters) {
        if to.len() != from.len() {
            bail!("the checkpoint has {} parameters where this version of the network has {}", from.len(), to.len());
        }
        to.clone_from(from);
    }
    [actor_adam.steps, critic_adam.steps] = state.adam_steps;
    *value_norm = ValueNorm::from_numbers(&mut state.value_norm.into_iter()).unwrap_or_default();
    *learning_rate = state.learning_rate;
    Ok(())
}

/// All settings with their values, those of a section after its name and a point.
fn settings_of(config: &TrainConfig) -> Result<Vec<(String, toml::Value)>> {
    let settings = toml::Table::try_from(config)?.into_iter().flat_map(|(key, value)| match value {
        toml::Value::Table(section) => {
            section.into_iter().map(|(name, value)| (format!("{key}.{name}"), value)).collect()
        }
        value => vec![(key, value)],
    });
    Ok(settings.collect())
}

fn checked(environment: Box<dyn Environment>, index: usize) -> Result<Box<dyn Environment>> {
    let modules = environment.modules();
    if !(1..=composer_shared::robot::MAX_MODULES).contains(&modules) {
        bail!("environment {index} has {modules} modules; there must be 1 to {}", composer_shared::robot::MAX_MODULES);
    }
    Ok(environment)
}

/// The settings a checkpoint was made with.
pub fn config_of(checkpoint: &Checkpoint) -> Result<TrainConfig> {
    toml::from_str(&checkpoint.config).context("the settings in the checkpoint are of another version of this program")
}

/// Trains a policy; the checkpoint, `metrics.jsonl` and the TensorBoard files go to the folder `out`.
///
/// `fingerprint` says in the caller's words what is trained for (robot, task, difficulty); a checkpoint of another is refused. With
/// `resume` the run in `out` goes on as if it had never stopped. Ctrl-C or SIGTERM ends the run with a checkpoint after the running
/// iteration; a second one ends it at once. A `name` tells the progress of runs that go on side by side apart.
pub fn train(
    config: &TrainConfig,
    make: MakeEnvironment,
    fingerprint: &str,
    out: &Path,
    resume: bool,
    name: Option<&str>,
    on_evaluate: Evaluate,
) -> Result<TrainSummary> {
    let began = Instant::now();
    config.validate()?;
    std::fs::create_dir_all(out).with_context(|| format!("the folder {} cannot be made", out.display()))?;
    let mut trainer = if resume {
        let checkpoint = Checkpoint::read(out)?;
        Trainer::resume(&checkpoint, config, make, fingerprint)
            .with_context(|| format!("the run in {} cannot be resumed", out.display()))?
    } else {
        if out.join(checkpoint::FILE).exists() {
            bail!("{} already holds a run: resume it with --resume, or choose another folder", out.display());
        }
        Trainer::new(config, make, fingerprint)?
    };
    // Before anything is computed: a folder that cannot be written to must not cost an hour.
    trainer.checkpoint()?.write(out)?;
    let cannot_log = || format!("the metrics cannot be written to {}; the last checkpoint is whole", out.display());
    let mut metrics = Metrics::open(out, trainer.iteration(), trainer.steps()).with_context(cannot_log)?;

    let stop = Signals::new()?;
    let mut progress = Progress::new(config.iterations() * config.steps_per_iteration(), trainer.steps(), name);
    let mut saved = Instant::now();
    let mut evaluation = Vec::new();
    let mut interrupted = false;
    while trainer.iteration() < config.iterations() {
        let before = trainer.steps();
        let report = trainer.iterate()?;
        let steps = trainer.steps();
        let last = trainer.iteration() == config.iterations();

        let [physics, inference, update] = report.times.shares();
        let mut scalars = report.scalars.clone();
        scalars.extend([
            ("charts/SPS".into(), report.times.steps_per_second()),
            ("time/physics_share".into(), physics),
            ("time/inference_share".into(), inference),
            ("time/update_share".into(), update),
            ("time/wall_seconds".into(), began.elapsed().as_secs_f64()),
        ]);
        let due = config.evaluate_every > 0 && (last || steps / config.evaluate_every > before / config.evaluate_every);
        if due {
            evaluation = on_evaluate(&trainer.network(), steps);
            scalars.extend(evaluation.iter().cloned());
        }
        metrics.write(trainer.iteration(), steps, &scalars).with_context(cannot_log)?;
        let shown = [
            ("success", report.get("charts/success_rate")),
            ("return", report.get("charts/episodic_return")),
            ("kl", report.get("losses/approx_kl")),
        ];
        progress.update(steps, &report.times, &shown);

        interrupted = stop.raised() && !last;
        if last || interrupted || saved.elapsed().as_secs_f64() >= config.checkpoint_seconds {
            trainer.checkpoint()?.write(out)?;
            saved = Instant::now();
        }
        if interrupted {
            progress.say(&format!("stopped after {steps} steps; {} is saved, --resume goes on", out.display()));
            break;
        }
    }
    progress.finish();
    Ok(TrainSummary {
        network: trainer.network(),
        steps: trainer.steps(),
        iterations: trainer.iteration(),
        interrupted,
        wall: began.elapsed(),
        evaluation,
    })
}

/// Notices Ctrl-C and SIGTERM while it lives; the second one ends the process.
pub(crate) struct Signals {
    flag: Arc<AtomicBool>,
    registered: Vec<signal_hook::SigId>,
}

impl Signals {
    /// Starts to notice them.
    pub(crate) fn new() -> Result<Self> {
        use signal_hook::consts::{SIGINT, SIGTERM};
        let flag = Arc::new(AtomicBool::new(false));
        let mut registered = Vec::new();
        for signal in [SIGINT, SIGTERM] {
            // In this order: the first signal raises the flag, the next one finds it raised and ends the process.
            registered.push(
                signal_hook::flag::register_conditional_shutdown(signal, 130, Arc::clone(&flag))
                    .context("no handler for Ctrl-C can be set up")?,
            );
            registered.push(
                signal_hook::flag::register(signal, Arc::clone(&flag))
                    .context("no handler for Ctrl-C can be set up")?,
            );
        }
        Ok(Self { flag, registered })
    }

    /// Whether there was one.
    pub(crate) fn raised(&self) -> bool {
        self.flag.load(Ordering::Relaxed)
    }
}

impl Drop for Signals {
    fn drop(&mut self) {
        for id in self.registered.drain(..) {
            signal_hook::low_level::unregister(id);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::environment::{Drift, Told, Trivial, View};
    use crate::methods::imagination::displacement;

    fn small(method: Method) -> TrainConfig {
        TrainConfig {
            method,
            environments: 4,
            rollout_steps: 24,
            minibatches: 2,
            epochs: 2,
            critic_epochs: 2,
            ..Default::default()
        }
    }

    /// Teams of different sizes, one with a dead module.
    fn teams(index: usize) -> Result<Box<dyn Environment>> {
        let team = Trivial::new(3 + index % 3, Told::Head);
        Ok(Box::new(if index == 2 { team.with_dead(1) } else { team }))
    }

    #[test]
    fn six_iterations_are_three_and_a_resumption_and_three() {
        for method in Method::ALL {
            // With a learning rate that falls and with one that is adapted.
            let kl_target = if method.imagination() { 0.01 } else { 0.0 };
            let config = TrainConfig { total_steps: 6 * 96, kl_target, ..small(method) };
            let mut straight = Trainer::new(&config, &teams, "trivial").unwrap();
            let reports: Vec<_> = (0..6).map(|_| straight.iterate().unwrap().scalars).collect();

            let folder = tempfile::tempdir().unwrap();
            let mut first = Trainer::new(&TrainConfig { threads: 1, ..config.clone() }, &teams, "trivial").unwrap();
            for expected in &reports[..3] {
                // NaN is not equal to itself; the text is.
                assert_eq!(format!("{:?}", first.iterate().unwrap().scalars), format!("{expected:?}"));
            }
            first.checkpoint().unwrap().write(folder.path()).unwrap();
            drop(first);
            let checkpoint = Checkpoint::read(folder.path()).unwrap();
            assert!(checkpoint.episodes.iter().any(|episode| !episode.actions.is_empty()));
            let mut second = Trainer::resume(&checkpoint, &config, &teams, "trivial").unwrap();
            for expected in &reports[3..] {
                assert_eq!(format!("{:?}", second.iterate().unwrap().scalars), format!("{expected:?}"));
            }
            assert_eq!(second.checkpoint().unwrap(), straight.checkpoint().unwrap());
            assert_eq!(second.network(), straight.network());
        }
    }

    #[test]
    fn a_whole_run_can_be_stopped_and_resumed_through_its_folder() {
        let make: MakeEnvironment = &teams;
        let quiet = |_: &Network, steps: u64| vec![("eval/steps".to_string(), steps as f64)];
        let config = TrainConfig { total_steps: 4 * 96, evaluate_every: 200, ..small(Method::Mappo) };
        let (a, b) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let whole = train(&config, make, "trivial", a.path(), false, None, &mut { quiet }).unwrap();
        assert_eq!((whole.steps, whole.iterations, whole.interrupted), (384, 4, false));
        assert_eq!(whole.evaluation, [("eval/steps".to_string(), 384.0)]);

        // The learning rate depends on the length of the run, so the half run must know the whole length: stop it by hand.
        let mut half = Trainer::new(&config, make, "trivial").unwrap();
        half.iterate().unwrap();
        half.iterate().unwrap();
        half.checkpoint().unwrap().write(b.path()).unwrap();
        let resumed = train(&config, make, "trivial", b.path(), true, None, &mut { quiet }).unwrap();
        assert_eq!(resumed.network, whole.network);
        assert_eq!(Checkpoint::read(a.path()).unwrap(), Checkpoint::read(b.path()).unwrap());
        let lines = std::fs::read_to_string(b.path().join(metrics::FILE)).unwrap();
        assert_eq!(lines.lines().count(), 2, "{lines}");
        assert!(lines.contains("losses/approx_kl"), "{lines}");
    }

    #[test]
    fn what_cannot_be_resumed_is_refused_with_a_reason() {
        let config = small(Method::Mappo);
        let checkpoint = Trainer::new(&config, &teams, "trivial").unwrap().checkpoint().unwrap();
        let refused = |config: &TrainConfig, fingerprint: &str| {
            Trainer::resume(&checkpoint, config, &teams, fingerprint).err().unwrap().to_string()
        };
        assert!(refused(&config, "snake").contains("another robot or task"));
        let changed = TrainConfig { gamma: 0.5, total_steps: 7, ..config.clone() };
        let error = refused(&changed, "trivial");
        assert!(error.contains("gamma (it was 0.97)") && !error.contains("total_steps"), "{error}");
        let imagination = ImaginationConfig { follow: 3.0, ..config.imagination.clone() };
        let error = refused(&TrainConfig { imagination, ..config.clone() }, "trivial");
        assert!(error.contains("imagination.follow (it was 0.1)") && !error.contains("bound"), "{error}");
        let mut without = checkpoint.clone();
        without.learners.clear();
        let error = Trainer::resume(&without, &config, &teams, "trivial").err().unwrap().to_string();
        assert!(error.contains("0 policies where the method mappo has 1"), "{error}");
        let longer = TrainConfig { total_steps: 2_000_000, threads: 3, ..config.clone() };
        assert!(Trainer::resume(&checkpoint, &longer, &teams, "trivial").is_ok());

        let folder = tempfile::tempdir().unwrap();
        let run = |resume| {
            train(&config, &teams, "trivial", folder.path(), resume, None, &mut |_, _| Vec::new())
                .err()
                .unwrap()
                .to_string()
        };
        assert!(run(true).contains("holds no checkpoint"));
        checkpoint.write(folder.path()).unwrap();
        assert!(run(false).contains("already holds a run"));
    }

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
        let config = small(Method::Mappo);
        let checkpoint = Trainer::new(&config, &teams, "trivial").unwrap().checkpoint().unwrap();
        assert_eq!(config_of(&checkpoint).unwrap(), config);
    }

    #[test]
    fn an_adapted_learning_rate_grows_while_the_policy_hardly_moves() {
        let config = TrainConfig { kl_target: 1.0, kl_stop: 10.0, ..small(Method::Composer) };
        let mut trainer = Trainer::new(&config, &teams, "trivial").unwrap();
        let rates = [0, 1, 2].map(|_| trainer.iterate().unwrap());
        for (report, expected) in rates.iter().zip([5e-4, 7.5e-4, 1.125e-3]) {
            for name in ["charts/learning_rate", "imagination/learning_rate"] {
                assert!((report.get(name) - expected).abs() < 1e-8, "{name}: {}", report.get(name));
            }
        }
    }

    #[test]
    fn the_learning_rate_falls_linearly() {
        let config =
            TrainConfig { total_steps: 20_480, learning_rate: 1.0, learning_rate_end: 0.1, ..Default::default() };
        assert_eq!(config.iterations(), 10);
        assert_eq!(config.learning_rate_at(0), 1.0);
        assert!((config.learning_rate_at(5) - 0.55).abs() < 1e-6);
    }

    /// Mean reward of a policy without noise on episodes it was not trained on.
    fn reward(network: &Network, modules: usize, told: Told) -> f32 {
        let mut team = Trivial::new(modules, told);
        let mut view = View::default();
        let mut actions = vec![[0.0; 2]; modules];
        let total: f32 = (0..200)
            .map(|seed| {
                team.reset(seed);
                team.view(&mut view);
                network.act(&view.observations, &view.heard, &mut actions, None);
                team.step(&actions).reward
            })
            .sum();
        total / 200.0
    }

    fn trained(method: Method, total_steps: u64, make: MakeEnvironment) -> Trainer {
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
        let mut trainer = Trainer::new(&config, make, "trivial").unwrap();
        while trainer.iteration() < config.iterations() {
            trainer.iterate().unwrap();
        }
        trainer
    }

    fn learn(method: Method, told: Told) -> Network {
        trained(method, 30_000, &|_| Ok(Box::new(Trivial::new(4, told)))).network()
    }

    #[test]
    fn the_imagination_points_at_the_target_and_the_control_policy_follows() {
        let drift: MakeEnvironment = &|_| Ok(Box::new(Drift::new(3)));
        let trainer = trained(Method::ComposerNoAttention, 40_000, drift);
        let network = trainer.network();
        let learner = trainer.imagination().unwrap();
        let imagination = Actor::new(learner.layout, &learner.actor);
        let bound = trainer.config.imagination.bound as f32;
        let mut scratch = Default::default();
        let (mut env, mut view) = (Drift::new(3), View::default());
        let (mut earned, mut possible, mut distance) = (0.0, 0.0, 0.0);
        for seed in 0..100 {
            env.reset(seed);
            for _ in 0..Drift::STEPS {
                env.view(&mut view);
                let normalised: Vec<f32> = view
                    .observations
                    .iter()
                    .flat_map(|o| (0..SIZE).map(|i| ((o[i] - network.mean[i]) / network.std[i]).clamp(-5.0, 5.0)))
                    .collect();
                let means = imagination.means(&normalised, &view.heard, &[3], &mut scratch).as_chunks().0;
                let imagined: Vec<_> = (0..3).map(|m| env.place(m, displacement(means[m], bound))).collect();
                earned += env.imagined_reward(&imagined);
                let best = view.observations.iter().map(|o| o[0].hypot(o[1]).min(bound)).sum::<f32>() / 3.0;
                possible += best;
                let mut actions = [[0.0; 2]; 3];
                network.act(&view.observations, &view.heard, &mut actions, None);
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
        let network = trained(Method::Mappo, 10_000, drift).network();
        let mut apart = 0.0;
        for seed in 0..100 {
            env.reset(seed);
            for _ in 0..Drift::STEPS {
                env.view(&mut view);
                let mut actions = [[0.0; 2]; 3];
                network.act(&view.observations, &view.heard, &mut actions, None);
                let outcome = env.step(&actions);
                apart += if outcome.truncated { outcome.distance / 100.0 } else { 0.0 };
            }
        }
        assert!(apart > 1.5, "{apart}");
    }

    #[test]
    fn all_methods_solve_the_trivial_task() {
        for method in Method::ALL {
            let network = learn(method, Told::All);
            let reward = reward(&network, 4, Told::All);
            assert!(reward > 0.95, "{method}: {reward}");
        }
    }

    #[test]
    fn only_attention_carries_the_target_from_the_head() {
        let reward_of = |method| reward(&learn(method, Told::Head), 4, Told::Head);
        let attention = reward_of(Method::ComposerNoImagination);
        assert!(attention > 0.95, "{attention}");
        // Three of four modules can do no better than zero: 1 - 3/4 * 1/3.
        let alone = reward_of(Method::Mappo);
        assert!(alone < 0.8, "{alone}");
    }
}
