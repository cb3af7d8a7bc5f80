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

use self::checkpoint::{Checkpoint, Episode};
use self::metrics::Metrics;
use self::progress::{Progress, Times};
use crate::environment::{Environment, PRIVILEGED};
use crate::methods::Method;
use crate::methods::actor_critic::ActorLayout;
use crate::methods::buffer::Lane;
use crate::methods::inference::Inference;
use crate::methods::normalise::{Running, ValueNorm};
use crate::methods::ppo::{Learner, PpoSettings, update};
use crate::methods::rollout::{Frozen, Iteration, Slot, collect};
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
    /// Share of it that is left at the end; linear in between.
    pub learning_rate_end: f64,
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
    /// Environment steps between two evaluations; 0 for none.
    pub evaluate_every: u64,
    /// Episodes of each evaluation.
    pub evaluation_episodes: u64,
    /// Seconds between two checkpoints.
    pub checkpoint_seconds: f64,
    /// Threads; 0 for one per core. The result does not depend on it.
    pub threads: usize,
}

impl Default for TrainConfig {
    fn default() -> Self {
        Self {
            method: Method::ComposerNoImagination,
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
            adam_epsilon: 1e-5,
            actor_grad_norm: 0.5,
            critic_grad_norm: 1.0,
            entropy: 0.0,
            sigma: 0.45,
            evaluate_every: 100_000,
            evaluation_episodes: 50,
            checkpoint_seconds: 60.0,
            threads: 0,
        }
    }
}

impl TrainConfig {
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
        if !(self.entropy.is_finite() && self.entropy >= 0.0) {
            bail!("entropy is {}; it must be 0 or more", self.entropy);
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
        Ok(())
    }

    /// Environment steps in an iteration.
    pub fn steps_per_iteration(&self) -> u64 {
        (self.environments * self.rollout_steps) as u64
    }

    /// Iterations of the whole run.
    pub fn iterations(&self) -> u64 {
        self.total_steps.div_ceil(self.steps_per_iteration())
    }

    /// Learning rate of an iteration.
    pub fn learning_rate_at(&self, iteration: u64) -> f32 {
        let done = iteration as f64 / self.iterations().max(1) as f64;
        (self.learning_rate * (1.0 - done * (1.0 - self.learning_rate_end))) as f32
    }

    /// The part that the update needs.
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
    learner: Learner,
    observations: Running,
    privileged: Running,
    slots: Vec<Slot>,
    lanes: Vec<Lane>,
    iteration: u64,
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
        Ok(Self {
            learner: Learner::new(config.method, config.seed, config.sigma as f32, config.adam_epsilon as f32),
            observations: Running::new(SIZE),
            privileged: Running::new(PRIVILEGED),
            lanes: vec![Lane::default(); config.environments],
            slots,
            iteration: 0,
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
            let (was, is) = (toml::Table::try_from(&was)?, toml::Table::try_from(config)?);
            let changed = was.iter().filter(|(key, value)| is.get(*key) != Some(value));
            let changed: Vec<_> = changed.map(|(key, value)| format!("{key} (it was {value})")).collect();
            bail!("a resumed run keeps its settings, but these were changed: {}", changed.join(", "));
        }
        let mut trainer = Self::new(config, make, fingerprint)?;
        trainer.iteration = checkpoint.iteration;
        let learner = &mut trainer.learner;
        let [actor, actor_first, actor_second, critic, critic_first, critic_second] = &checkpoint.parameters;
        for (to, from) in [
            (&mut learner.actor, actor),
            (&mut learner.actor_adam.first, actor_first),
            (&mut learner.actor_adam.second, actor_second),
            (&mut learner.critic, critic),
            (&mut learner.critic_adam.first, critic_first),
            (&mut learner.critic_adam.second, critic_second),
        ] {
            if to.len() != from.len() {
                bail!(
                    "the checkpoint has {} parameters where this version of the network has {}",
                    from.len(),
                    to.len()
                );
            }
            to.clone_from(from);
        }
        [learner.actor_adam.steps, learner.critic_adam.steps] = checkpoint.adam_steps;
        let mut numbers = checkpoint.statistics.iter().copied();
        let statistics = (|| {
            Some((
                Running::from_numbers(SIZE, &mut numbers)?,
                Running::from_numbers(PRIVILEGED, &mut numbers)?,
                ValueNorm::from_numbers(&mut numbers)?,
            ))
        })();
        let Some((observations, privileged, value_norm)) = statistics else {
            bail!("the checkpoint has too few statistics: it is of another version");
        };
        (trainer.observations, trainer.privileged, trainer.learner.value_norm) = (observations, privileged, value_norm);
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
        let learner = &self.learner;
        let vectors = [
            &learner.actor,
            &learner.actor_adam.first,
            &learner.actor_adam.second,
            &learner.critic,
            &learner.critic_adam.first,
            &learner.critic_adam.second,
        ];
        let numbers = self.observations.numbers().chain(self.privileged.numbers()).chain(learner.value_norm.numbers());
        let episode = |slot: &Slot| Episode { number: slot.episode, actions: slot.actions.clone() };
        Ok(Checkpoint {
            config: toml::to_string(&self.config).context("the settings cannot be written as TOML")?,
            fingerprint: self.fingerprint.clone(),
            iteration: self.iteration,
            adam_steps: [learner.actor_adam.steps, learner.critic_adam.steps],
            parameters: vectors.map(Clone::clone),
            statistics: numbers.collect(),
            episodes: self.slots.iter().map(episode).collect(),
        })
    }

    /// Collects and learns once.
    pub fn iterate(&mut self) -> Result<Report> {
        let began = Instant::now();
        let threads = match self.config.threads {
            0 => std::thread::available_parallelism().map_or(1, usize::from),
            threads => threads,
        };
        let policy = Inference::new(&ActorLayout::new(self.config.method), &self.learner.actor);
        let iteration = Iteration {
            policy: &policy,
            observations: Frozen::new(&self.observations),
            privileged: Frozen::new(&self.privileged),
            run_seed: self.config.seed,
            iteration: self.iteration,
            steps: self.config.rollout_steps,
        };
        let (observations, privileged) = (&mut self.observations, &mut self.privileged);
        let split = collect(&mut self.slots, &mut self.lanes, iteration, threads, observations, privileged);
        let rollout = began.elapsed();
        let learning_rate = self.config.learning_rate_at(self.iteration);
        let stats = update(
            &mut self.learner,
            self.config.method,
            &mut self.lanes,
            &self.config.ppo(),
            learning_rate,
            (self.config.seed, self.iteration),
            threads,
        );
        if !self.learner.actor.iter().chain(&self.learner.critic).all(|p| p.is_finite()) {
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
        let episodes: Vec<_> = self.lanes.iter().flat_map(|lane| &lane.episodes).collect();
        let mean = |f: &dyn Fn(&crate::environment::Outcome) -> f64| {
            episodes.iter().map(|outcome| f(outcome)).sum::<f64>() / episodes.len() as f64
        };
        let rewards: f64 = self.lanes.iter().flat_map(|lane| &lane.rewards).map(|r| f64::from(*r)).sum();
        let sigma = &self.learner.actor[ActorLayout::new(self.config.method).log_sigma.range()];
        let scalars = [
            ("charts/episodic_return", mean(&|o| f64::from(o.episode_return))),
            ("charts/episodic_length", mean(&|o| f64::from(o.steps))),
            ("charts/success_rate", mean(&|o| f64::from(u8::from(o.success)))),
            ("charts/final_distance", mean(&|o| f64::from(o.distance))),
            ("charts/episodes", episodes.len() as f64),
            ("charts/step_reward", rewards / self.config.steps_per_iteration() as f64),
            ("charts/learning_rate", f64::from(learning_rate)),
            ("charts/sigma", sigma.iter().map(|l| f64::from(l.exp())).sum::<f64>() / sigma.len() as f64),
            ("losses/policy_loss", stats.policy_loss),
            ("losses/value_loss", stats.value_loss),
            ("losses/approx_kl", stats.approx_kl),
            ("losses/first_minibatch_kl", stats.first_kl),
            ("losses/clipfrac", stats.clip_fraction),
            ("losses/entropy", stats.entropy),
            ("losses/explained_variance", stats.explained_variance),
            ("losses/actor_grad_norm", stats.actor_grad_norm),
            ("losses/critic_grad_norm", stats.critic_grad_norm),
            ("losses/actor_minibatches", stats.actor_minibatches as f64),
        ];
        Ok(Report { times, scalars: scalars.into_iter().map(|(name, value)| (name.into(), value)).collect() })
    }

    /// The policy as it is now.
    pub fn network(&self) -> Network {
        let layout = ActorLayout::new(self.config.method);
        layout.network(&self.learner.actor, self.observations.mean(), self.observations.std())
    }

    /// Environment steps taken.
    pub fn steps(&self) -> u64 {
        self.iteration * self.config.steps_per_iteration()
    }

    /// Iterations done.
    pub fn iteration(&self) -> u64 {
        self.iteration
    }

    /// What is learnt so far.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }
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
/// iteration; a second one ends it at once.
pub fn train(
    config: &TrainConfig,
    make: MakeEnvironment,
    fingerprint: &str,
    out: &Path,
    resume: bool,
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
    let mut progress = Progress::new(config.iterations() * config.steps_per_iteration(), trainer.steps());
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

/// Notices Ctrl-C and SIGTERM while it lives.
struct Signals {
    flag: Arc<AtomicBool>,
    registered: Vec<signal_hook::SigId>,
}

impl Signals {
    fn new() -> Result<Self> {
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

    fn raised(&self) -> bool {
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
    use crate::environment::{Told, Trivial, View};

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
            let config = TrainConfig { total_steps: 6 * 96, ..small(method) };
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
        let whole = train(&config, make, "trivial", a.path(), false, &mut { quiet }).unwrap();
        assert_eq!((whole.steps, whole.iterations, whole.interrupted), (384, 4, false));
        assert_eq!(whole.evaluation, [("eval/steps".to_string(), 384.0)]);

        // The learning rate depends on the length of the run, so the half run must know the whole length: stop it by hand.
        let mut half = Trainer::new(&config, make, "trivial").unwrap();
        half.iterate().unwrap();
        half.iterate().unwrap();
        half.checkpoint().unwrap().write(b.path()).unwrap();
        let resumed = train(&config, make, "trivial", b.path(), true, &mut { quiet }).unwrap();
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
        let longer = TrainConfig { total_steps: 2_000_000, threads: 3, ..config.clone() };
        assert!(Trainer::resume(&checkpoint, &longer, &teams, "trivial").is_ok());

        let folder = tempfile::tempdir().unwrap();
        let run = |resume| {
            train(&config, &teams, "trivial", folder.path(), resume, &mut |_, _| Vec::new()).err().unwrap().to_string()
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

    fn learn(method: Method, told: Told) -> Network {
        let config = TrainConfig {
            method,
            total_steps: 30_000,
            environments: 16,
            rollout_steps: 20,
            learning_rate: 1e-3,
            gamma: 0.0,
            ..Default::default()
        };
        let mut trainer = Trainer::new(&config, &|_| Ok(Box::new(Trivial::new(4, told))), "trivial").unwrap();
        while trainer.iteration() < config.iterations() {
            trainer.iterate().unwrap();
        }
        trainer.network()
    }

    #[test]
    fn both_methods_solve_the_trivial_task() {
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
