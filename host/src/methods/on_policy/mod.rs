//! On-policy learning with clipped losses (PPO's and its relatives'): what all such methods share.
//!
//! A method brings its networks, as an [`ActorCritic`]; it may let the ratio of new to old density be one a module, one an action
//! dimension or one a team ([`Ratio`]), and value a whole team or every module ([`Valued`]). The rest is here: rollouts ([`mod@collect`]), the
//! rollout buffer with generalised advantage estimation ([`buffer`]), minibatches and optimiser ([`mod@update`]).

pub mod autodiff;
pub mod buffer;
pub mod collect;
pub mod losses;
pub mod taped;
pub mod update;

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use composer_shared::observation::BASE;

pub use self::buffer::{Batch, Decisions, RolloutBuffer, Trajectory};
pub use self::collect::{Companion, Iteration, RolloutWorker, Widths, collect};
pub use self::update::{Learner, OnPolicySettings, UpdateStats, Workspace, update};
use super::config::TrainConfig;
use super::curriculum::{Curriculum, CurriculumConfig};
use super::normalise::{Frozen, Running};
use super::ranks::Ranks;
use super::{Algorithm, EpisodeState, LearnerState, MakeEnvironment, Report, State, Times, TrainedPolicy, checked};
use crate::environment::{Lesson, Outcome, PRIVILEGED};

/// What the ratio of new to old density, and its clip, are taken over.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ratio {
    /// All actions of one module.
    Module,
    /// Each action of a module for itself.
    Dimension,
    /// All actions of all modules of a team.
    Team,
}

/// What a critic puts a value on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Valued {
    /// The whole team: one number.
    Team,
    /// Every module: one number each.
    Module,
}

/// What some teams see at one moment each. A row is one module; the rows of a team lie together, head first.
#[derive(Clone, Copy, Debug)]
pub struct Teams<'a> {
    /// Normalised observations, `[rows, inputs]`.
    pub observations: &'a [f32],
    /// Normalised privileged numbers, `[rows, PRIVILEGED]`; empty where nobody values.
    pub privileged: &'a [f32],
    /// Who hears whom, one mask a row, own bit set; bit i stands for module i of the team.
    pub heard: &'a [u64],
    /// Modules of each team.
    pub modules: &'a [usize],
}

/// What a policy draws for some teams, appended to what is there.
#[derive(Clone, Debug, Default)]
pub struct Drawn {
    /// Actions, unclipped, `[rows, outputs]`.
    pub actions: Vec<f32>,
    /// Logarithm of their densities: one a row, or one an action where that is what the ratio is taken over.
    pub log_probabilities: Vec<f32>,
}

/// A loss summed over a batch, its gradient, and what else is told about it.
#[derive(Clone, Debug, Default)]
pub struct Gradient {
    /// Gradient of the loss over the flat parameters.
    pub gradient: Vec<f32>,
    /// The clipped loss of the policy.
    pub policy_loss: f64,
    /// The loss of the values.
    pub value_loss: f64,
    /// Weighted sum of (ratio - 1) - ln ratio: an estimate of the KL divergence between the old and the new policy.
    pub kl: f64,
    /// Weighted share of ratios that were clipped.
    pub clipped: f64,
}

impl Gradient {
    /// Nothing yet, over `len` parameters.
    pub fn clear(&mut self, len: usize) {
        self.gradient.clear();
        self.gradient.resize(len, 0.0);
        (self.policy_loss, self.value_loss, self.kl, self.clipped) = (0.0, 0.0, 0.0, 0.0);
    }

    /// Adds another batch's.
    pub fn add(&mut self, other: &Gradient) {
        self.gradient.iter_mut().zip(&other.gradient).for_each(|(a, b)| *a += b);
        self.policy_loss += other.policy_loss;
        self.value_loss += other.value_loss;
        self.kl += other.kl;
        self.clipped += other.clipped;
    }

    /// Adds one over all parameters, the actor's `of_actor` first, to those of the parts that are asked for. The parts have no parameter in
    /// common, so one way back serves both.
    fn hand_over(mut self, of_actor: usize, actor: Option<&mut Gradient>, critic: Option<&mut Gradient>) {
        let of_critic =
            Gradient { gradient: self.gradient.split_off(of_actor), value_loss: self.value_loss, ..Self::default() };
        if let Some(to) = actor {
            to.add(&self);
        }
        if let Some(to) = critic {
            to.add(&of_critic);
        }
    }
}

/// What the losses need besides the batch.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LossSettings {
    /// Ratios are clipped to 1 +- this.
    pub clip: f32,
    /// Weight of the entropy bonus.
    pub entropy: f32,
    /// Weight of one team in the mean over a minibatch.
    pub team_weight: f32,
}

/// The two parts that parameters come in, each with an optimiser and a limit on its gradient's norm. A method that steps both networks with
/// one optimiser has all its parameters in the actor's part.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Part {
    /// The actor's.
    Actor,
    /// The critic's.
    Critic,
}

/// The networks of an on-policy method: the policy of one module, shared by all, and the values.
pub trait ActorCritic: Send + Sync + 'static {
    /// Working memory of one thread.
    type Scratch: Default + Send;

    /// Teams that go through the networks together, in rollouts: each group of so many environments goes in step.
    const TOGETHER: usize;
    /// Numbers of an observation that it takes, the first.
    fn inputs(&self) -> usize {
        BASE
    }

    /// Actions of a module.
    fn outputs(&self) -> usize;

    /// The most modules that it can decide for, if there is a limit.
    fn most_modules(&self) -> Option<usize> {
        None
    }

    /// Numbers that a module remembers from one step to the next.
    fn memory(&self) -> usize {
        0
    }

    /// What the ratio is taken over.
    fn ratio(&self) -> Ratio;

    /// What is valued.
    fn valued(&self) -> Valued;

    /// Samples whose gradient is computed together in an update.
    fn block(&self) -> usize;

    /// Logarithm of the standard deviation of each action.
    fn log_sigma(&self) -> Vec<f32>;

    /// Takes other parameters.
    fn load(&mut self, part: Part, parameters: &[f32]);

    /// Draws an action for each row with standard normal `noise`, `[rows, outputs]`; zeros give the mean. Appends the actions, unclipped, and
    /// the logarithms of their densities: one a row, or one an action where that is what the ratio is taken over.
    fn sample(
        &self,
        teams: Teams,
        noise: &[f32],
        scratch: &mut Self::Scratch,
        actions: &mut Vec<f32>,
        log_probabilities: &mut Vec<f32>,
    );

    /// The same of modules that remember: `memory`, `[rows, memory]`, is what they remembered before, and then what they do.
    fn sample_remembering(
        &self,
        teams: Teams,
        memory: &mut [f32],
        noise: &[f32],
        scratch: &mut Self::Scratch,
        drawn: &mut Drawn,
    ) {
        let _ = memory;
        self.sample(teams, noise, scratch, &mut drawn.actions, &mut drawn.log_probabilities);
    }

    /// Appends the values on the critic's scale: one a team or one a row.
    fn values(&self, teams: Teams, scratch: &mut Self::Scratch, values: &mut Vec<f32>);

    /// Adds losses and gradients over a batch: those of the actor's part and of the critic's, if asked for.
    fn gradient(
        &self,
        batch: &Batch,
        loss: LossSettings,
        scratch: &mut Self::Scratch,
        actor: Option<&mut Gradient>,
        critic: Option<&mut Gradient>,
    );

    /// Writes a sum of gradients to `to` in the order of the parameters.
    fn finish(&self, part: Part, sum: &[f32], loss: LossSettings, to: &mut Vec<f32>) {
        let _ = (part, loss);
        to.clear();
        to.extend_from_slice(sum);
    }

    /// Raises the standard deviations in the actor's parameters to at least `sigma`.
    fn floor_sigma(&self, parameters: &mut [f32], sigma: f32) {
        let _ = (parameters, sigma);
    }

    /// Changes the critic's parameters so that its values stay the same on the reward's scale while its own moves from (mean, standard
    /// deviation) to other ones: the "preserving outputs" half of PopArt.
    fn rescale(&self, critic: &mut [f32], from: [f32; 2], to: [f32; 2]) {
        let _ = (critic, from, to);
    }

    /// The policy as it is, with the statistics of its observations: what evaluation runs.
    fn policy(&self, mean: &[f32], std: &[f32]) -> TrainedPolicy;

    /// The same where it is told what the policy beside it would do.
    fn told_policy(&self, companion: &Self, mean: &[f32], std: &[f32]) -> TrainedPolicy {
        let _ = companion;
        self.policy(mean, std)
    }
}

/// A second policy that learns beside the control policy, from the same rollouts.
pub struct CompanionLearner<C> {
    /// Its networks.
    pub learner: Learner<C>,
    /// What it earns and what it means for the control policy.
    pub rules: Box<dyn Companion>,
    /// Its update.
    pub settings: OnPolicySettings,
}

/// Observations that statistics from elsewhere stand for.
const KNOWN: f64 = 1e6;

/// An on-policy method between two iterations.
pub struct OnPolicy<C: ActorCritic> {
    config: TrainConfig,
    settings: OnPolicySettings,
    control: Learner<C>,
    companion: Option<CompanionLearner<C>>,
    observations: Running,
    privileged: Running,
    returns: Running,
    /// None: the settings are those of the environments, all along.
    curriculum: Option<Curriculum>,
    environments: Vec<RolloutWorker>,
    buffer: RolloutBuffer,
    iteration: u64,
    workspace: Workspace<C>,
}

impl<C: ActorCritic> OnPolicy<C> {
    /// A run that has not begun.
    pub fn new(
        config: &TrainConfig,
        settings: OnPolicySettings,
        control: Learner<C>,
        companion: Option<CompanionLearner<C>>,
        make: MakeEnvironment,
    ) -> Result<Self> {
        let taught = config.curriculum != CurriculumConfig::default() || config.second.from > 0;
        let curriculum = taught.then(|| Curriculum::new(&config.curriculum, &config.second));
        let lesson = curriculum.as_ref().map_or_else(Lesson::default, Curriculum::lesson);
        let mut environments = Vec::with_capacity(settings.environments);
        for index in 0..settings.environments {
            let environment = checked(make(index)?, index)?;
            let widths = Widths::of(&control.networks);
            environments.push(RolloutWorker::new(environment, index, config.seed, settings.gamma, widths, lesson));
        }
        Ok(Self {
            observations: Running::new(control.networks.inputs()),
            privileged: Running::new(PRIVILEGED),
            returns: Running::new(1),
            curriculum,
            buffer: RolloutBuffer::new(settings.environments),
            environments,
            iteration: 0,
            workspace: Workspace::new(config.threads()).context("the threads cannot be started")?,
            config: config.clone(),
            settings,
            control,
            companion,
        })
    }

    /// Normalises observations by these statistics from now on, which change slowly.
    pub fn know(&mut self, mean: &[f32], std: &[f32]) {
        self.observations = Running::known(mean, std, KNOWN);
    }

    /// The control policy and its critic as they are now.
    pub fn control(&self) -> &Learner<C> {
        &self.control
    }

    /// The policy beside it, if there is one.
    pub fn companion(&self) -> Option<&Learner<C>> {
        self.companion.as_ref().map(|companion| &companion.learner)
    }

    /// The numbers of all normalisers that are in use.
    fn statistics(&self) -> Vec<f64> {
        let returns = self.settings.reward_clip.map(|_| self.returns.numbers());
        let lessons = || self.environments.iter().flat_map(|worker| worker.lesson.numbers());
        let curriculum = self.curriculum.iter().flat_map(|curriculum| curriculum.numbers().chain(lessons()));
        let memories = self.environments.iter().flat_map(|worker| worker.memory.iter().map(|m| f64::from(*m)));
        let numbers = self.observations.numbers().chain(self.privileged.numbers());
        numbers.chain(returns.into_iter().flatten()).chain(curriculum).chain(memories).collect()
    }

    fn learners(&self) -> impl Iterator<Item = &Learner<C>> {
        [Some(&self.control), self.companion.as_ref().map(|companion| &companion.learner)].into_iter().flatten()
    }

    fn learners_mut(&mut self) -> impl Iterator<Item = &mut Learner<C>> {
        let companion = self.companion.as_mut().map(|companion| &mut companion.learner);
        [Some(&mut self.control), companion].into_iter().flatten()
    }
}

impl<C: ActorCritic> Algorithm for OnPolicy<C> {
    fn iterate(&mut self) -> Result<Report> {
        let began = Instant::now();
        let iteration = Iteration {
            policy: &self.control.networks,
            companion: self.companion.as_ref().map(|c| (&c.learner.networks, c.learner.seed, &*c.rules)),
            observations: match self.settings.observation_clip {
                Some(clip) => Frozen::with_clip(&self.observations, clip),
                None => Frozen::off(self.control.networks.inputs()),
            },
            privileged: Frozen::new(&self.privileged),
            rewards: self.settings.reward_clip.map(|clip| Frozen::with_clip(&self.returns, clip)),
            run_seed: self.config.seed,
            lesson: self.curriculum.as_ref().map_or_else(Lesson::default, Curriculum::lesson),
            iteration: self.iteration,
            steps: self.settings.rollout_steps,
        };
        let statistics = [&mut self.observations, &mut self.privileged, &mut self.returns];
        let workers = &self.workspace.workers;
        let split = collect(&mut self.environments, &mut self.buffer, &iteration, workers, statistics);
        let rollout = began.elapsed();
        let (second, steps) = (&self.config.second, self.iteration * self.steps_per_iteration());
        // The first stage may be all there is.
        let first = if second.from > 0 { second.from } else { self.config.total_steps };
        let constant = second.has_begun(steps).then_some(second.learning_rate as f32);
        let linear = self.settings.learning_rate_at(self.iteration, first.div_ceil(self.steps_per_iteration()));
        let adaptive = self.settings.kl_target > 0.0;
        let rate_of = |learner: &Learner<C>| constant.unwrap_or(if adaptive { learner.learning_rate } else { linear });
        let learning_rate = rate_of(&self.control);
        let workspace = &mut self.workspace;
        let RolloutBuffer { trajectories, control, companion } = &mut self.buffer;
        let stats =
            update(&mut self.control, trajectories, control, &self.settings, learning_rate, self.iteration, workspace);
        let companion_stats = self.companion.as_mut().map(|CompanionLearner { learner, settings, .. }| {
            let rate = rate_of(learner);
            let stats = update(learner, trajectories, companion, settings, rate, self.iteration, workspace);
            (stats, rate)
        });
        if !self.learners().all(Learner::is_finite) {
            bail!(
                "training diverged in iteration {}: a weight is no longer a finite number. The last checkpoint is from before; \
                 a lower learning_rate may help",
                self.iteration + 1
            );
        }
        self.iteration += 1;
        let taken = self.steps_per_iteration();
        if let Some(curriculum) = &mut self.curriculum {
            curriculum.take(self.buffer.trajectories.iter().flat_map(|trajectory| &trajectory.episodes), taken);
        }

        let wall = began.elapsed();
        // The threads' own times, scaled to the wall time of the rollout they fill together.
        let busy = (split.physics + split.inference).as_secs_f64().max(1e-9);
        let physics = rollout.mul_f64(split.physics.as_secs_f64() / busy);
        let times = Times {
            steps: self.steps_per_iteration(),
            wall,
            physics,
            inference: rollout.saturating_sub(physics),
            update: wall.saturating_sub(rollout),
        };
        let RolloutBuffer { trajectories, companion, .. } = &self.buffer;
        let episodes: Vec<&Outcome> = trajectories.iter().flat_map(|trajectory| &trajectory.episodes).collect();
        let steps = self.steps_per_iteration() as f64;
        let rewards: f64 = trajectories.iter().flat_map(|t| &t.rewards).map(|r| f64::from(*r)).sum();
        let mut scalars = super::episode_scalars(&episodes);
        scalars.extend([
            ("charts/step_reward".into(), rewards / steps),
            ("charts/learning_rate".into(), f64::from(learning_rate)),
            ("charts/sigma".into(), self.control.sigma()),
        ]);
        scalars.extend(stats.scalars().map(|(name, value)| (format!("losses/{name}"), value)));
        scalars.extend(self.curriculum.iter().flat_map(Curriculum::scalars));
        if let (Some(CompanionLearner { learner, rules, .. }), Some((stats, rate))) = (&self.companion, companion_stats)
        {
            let rewards: f64 = companion.iter().flat_map(|d| &d.rewards).map(|r| f64::from(*r)).sum();
            let errors: f64 = trajectories.iter().flat_map(|t| &t.companion_errors).map(|e| f64::from(*e)).sum();
            let name = rules.name();
            scalars.push((format!("{name}/reward"), rewards / steps));
            scalars.push((format!("{name}/{}", rules.error_name()), errors / steps));
            scalars.push((format!("{name}/learning_rate"), f64::from(rate)));
            scalars.push((format!("{name}/sigma"), learner.sigma()));
            scalars.extend(stats.scalars().map(|(key, value)| (format!("{name}/{key}"), value)));
        }
        Ok(Report { times, scalars })
    }

    fn policy(&self) -> TrainedPolicy {
        let (mean, std) = (self.observations.mean(), self.observations.std());
        match self.companion.as_ref().filter(|companion| companion.rules.tells()) {
            Some(companion) => self.control.networks.told_policy(&companion.learner.networks, &mean, &std),
            None => self.control.networks.policy(&mean, &std),
        }
    }

    fn iteration(&self) -> u64 {
        self.iteration
    }

    fn steps_per_iteration(&self) -> u64 {
        (self.settings.environments * self.settings.rollout_steps) as u64
    }

    fn join_ranks(&mut self, ranks: Arc<dyn Ranks>) -> Result<()> {
        self.workspace.workers.join_ranks(ranks);
        Ok(())
    }

    fn save(&self) -> State {
        let episode = |worker: &RolloutWorker| EpisodeState { number: worker.episode, actions: worker.actions.clone() };
        State {
            iteration: self.iteration,
            learners: self.learners().map(Learner::state).collect(),
            statistics: self.statistics(),
            episodes: self.environments.iter().map(episode).collect(),
            replay: Vec::new(),
        }
    }

    fn load(&mut self, state: &State, make: MakeEnvironment) -> Result<()> {
        let learners = self.learners().count();
        if state.learners.len() != learners {
            bail!(
                "the checkpoint has {} policies where the method {} has {learners}",
                state.learners.len(),
                self.config.method
            );
        }
        for (learner, state) in self.learners_mut().zip(&state.learners) {
            learner.restore(state)?;
        }
        let mut numbers = state.statistics.iter().copied();
        let widths = Widths::of(&self.control.networks);
        let inputs = widths.inputs;
        let statistics = (|| {
            Some((Running::from_numbers(inputs, &mut numbers)?, Running::from_numbers(PRIVILEGED, &mut numbers)?))
        })();
        let Some((observations, privileged)) = statistics else {
            bail!("the checkpoint has too few statistics: it is of another version");
        };
        (self.observations, self.privileged) = (observations, privileged);
        if self.settings.reward_clip.is_some() {
            let Some(returns) = Running::from_numbers(1, &mut numbers) else {
                bail!("the checkpoint has too few statistics: it is of another version");
            };
            self.returns = returns;
        }
        let mut lessons = vec![Lesson::default(); self.environments.len()];
        if let Some(curriculum) = &mut self.curriculum {
            let mut restored = || {
                curriculum.restore(&mut numbers)?;
                lessons.iter_mut().try_for_each(|lesson| {
                    *lesson = Lesson::from_numbers(&mut numbers)?;
                    Some(())
                })
            };
            if restored().is_none() {
                bail!("the checkpoint has too few statistics: it is of another version");
            }
        }
        if state.episodes.len() != self.environments.len() {
            bail!(
                "the checkpoint has {} environments, the settings say {}",
                state.episodes.len(),
                self.environments.len()
            );
        }
        for (index, EpisodeState { number, actions }) in state.episodes.iter().enumerate() {
            let environment = checked(make(index)?, index)?;
            self.environments[index] = RolloutWorker::restore(
                environment,
                index,
                self.config.seed,
                self.settings.gamma,
                widths,
                (*number, lessons[index]),
                actions.clone(),
            );
        }
        for memory in self.environments.iter_mut().flat_map(|worker| &mut worker.memory) {
            let Some(number) = numbers.next() else {
                bail!("the checkpoint has too few statistics: it is of another version");
            };
            *memory = number as f32;
        }
        self.iteration = state.iteration;
        Ok(())
    }
}

impl<C: ActorCritic> Learner<C> {
    /// What a checkpoint keeps of it.
    pub fn state(&self) -> LearnerState {
        let Learner { actor, critic, actor_adam, critic_adam, value_norm, learning_rate, .. } = self;
        let vectors = [actor, &actor_adam.first, &actor_adam.second, critic, &critic_adam.first, &critic_adam.second];
        LearnerState {
            adam_steps: [actor_adam.steps, critic_adam.steps],
            parameters: vectors.map(Clone::clone),
            value_norm: value_norm.numbers(),
            learning_rate: *learning_rate,
        }
    }

    /// Brings a new one to where it was.
    pub fn restore(&mut self, state: &LearnerState) -> Result<()> {
        let Learner { actor, critic, actor_adam, critic_adam, value_norm, learning_rate, .. } = self;
        let vectors = [
            actor,
            &mut actor_adam.first,
            &mut actor_adam.second,
            critic,
            &mut critic_adam.first,
            &mut critic_adam.second,
        ];
        for (to, from) in vectors.into_iter().zip(&state.parameters) {
            if to.len() != from.len() {
                bail!(
                    "the checkpoint has {} parameters where this version of the network has {}",
                    from.len(),
                    to.len()
                );
            }
            to.clone_from(from);
        }
        [actor_adam.steps, critic_adam.steps] = state.adam_steps;
        value_norm.restore(state.value_norm);
        *learning_rate = state.learning_rate;
        self.networks.load(Part::Actor, &self.actor);
        self.networks.load(Part::Critic, &self.critic);
        Ok(())
    }
}
