//! TD3 (Fujimoto et al. 2018): two critics whose lesser counts, noise on the target's action, an actor that is stepped less often, and targets
//! that follow slowly.

use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use burn::tensor::Tensor;
use composer_shared::observation::BASE;
use rand::{Rng, RngExt};

use super::replay::{ReplayBuffer, Transitions};
use crate::environment::{Environment, Lesson, Outcome, with_itself};
use crate::methods::config::TrainConfig;
use crate::methods::on_policy::autodiff::{Seen, seen};
use crate::methods::on_policy::collect::{ACTIONS, episode_seed};
use crate::methods::on_policy::{RolloutWorker, Widths};
use crate::methods::parameters::Adam;
use crate::methods::random::{Stream, normal_noise, stream};
use crate::methods::ranks::Ranks;
use crate::methods::tensors::{Layout, Weights, floats, scalar};
use crate::methods::{
    Algorithm, EpisodeState, LearnerState, MakeEnvironment, Report, State, Times, TrainedPolicy, checked,
    episode_scalars,
};

/// The paper's observation; nobody remembers anything.
const WIDTHS: Widths = Widths { inputs: BASE, memory: 0 };

/// The networks of a deterministic method, as functions of their weights.
pub trait DeterministicActorCritic: Clone + Send + Sync + 'static {
    /// The actor's parameters, and those of both critics.
    fn layouts(&self) -> [Layout; 2];

    /// The actions, `[rows, ACTIONS]`, each within -1 to 1.
    fn act(&self, actor: &Weights, seen: &Seen) -> Tensor<2>;

    /// What both critics say of actions, `[rows, 1]` or `[teams, 1]`.
    fn values(&self, critic: &Weights, seen: &Seen, actions: Tensor<2>) -> [Tensor<2>; 2];

    /// What evaluation runs.
    fn policy(&self, actor: &[f32]) -> TrainedPolicy;
}

/// Settings of TD3.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Td3Settings {
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
    pub gamma: f32,
    /// Share of the networks that their targets take over.
    pub tau: f32,
    /// Learning rate of both optimisers.
    pub learning_rate: f32,
    /// Standard deviation of the noise on the actions taken.
    pub exploration: f32,
    /// Standard deviation of the noise on the targets' actions.
    pub target_noise: f32,
    /// Most of it.
    pub target_noise_clip: f32,
    /// Updates of the critics for one of the actor and the targets.
    pub delay: u64,
}

/// What an update came to.
#[derive(Clone, Debug, Default)]
pub struct UpdateStats {
    /// Loss of both critics.
    pub critic_loss: f64,
    /// Loss of the actor, if it was stepped.
    pub actor_loss: Option<f64>,
    /// What the critics should have said.
    pub targets: Vec<f32>,
    /// Gradient of the critics' loss.
    pub critic_gradient: Vec<f32>,
    /// Gradient of the actor's.
    pub actor_gradient: Vec<f32>,
}

/// Actor and critics, their targets and optimisers.
#[derive(Clone, Debug)]
pub struct Td3<N> {
    /// The networks.
    pub networks: N,
    layouts: [Layout; 2],
    /// Parameters of the actor and of the critics.
    pub online: [Vec<f32>; 2],
    /// Those of their targets.
    pub targets: [Vec<f32>; 2],
    /// Their optimisers.
    pub adams: [Adam; 2],
}

impl<N: DeterministicActorCritic> Td3<N> {
    /// With these parameters, whose targets are the same.
    pub fn new(networks: N, online: [Vec<f32>; 2]) -> Self {
        let adams = [0, 1].map(|part: usize| Adam::new(online[part].len(), 1e-8));
        Self { layouts: networks.layouts(), networks, targets: online.clone(), online, adams }
    }

    /// One update of the critics and, if `with_actor`, of the actor and all targets; `noise` is that on the targets' actions before it is
    /// clipped, `[rows, ACTIONS]`.
    pub fn update(
        &mut self,
        batch: &Transitions,
        noise: &[f32],
        settings: &Td3Settings,
        with_actor: bool,
    ) -> UpdateStats {
        let [actor_layout, critic_layout] = &self.layouts;
        let (modules, rows) = (batch.modules, batch.heard.len());
        let targets = {
            let [actor, critic] = [0, 1].map(|part| Weights::new(&self.layouts[part], &self.targets[part]));
            let next = seen(&actor, &batch.next_observations, &batch.next_heard, modules);
            let clip = settings.target_noise_clip;
            let noise = actor.tensor(noise, [rows, ACTIONS]).clamp(-clip, clip);
            let actions = (self.networks.act(&actor, &next) + noise).clamp(-1.0, 1.0);
            let [first, second] = self.networks.values(&critic, &next, actions);
            let values = floats(first.min_pair(second));
            let each = values.len() / batch.len();
            let of = |(i, value): (usize, f32)| {
                let team = i / each;
                batch.rewards[team] + settings.gamma * (1.0 - batch.done[team]) * value
            };
            values.into_iter().enumerate().map(of).collect::<Vec<f32>>()
        };
        let critic = Weights::tracked(critic_layout, &self.online[1]);
        let now = seen(&critic, &batch.observations, &batch.heard, modules);
        let actions = critic.tensor(&batch.actions, [rows, ACTIONS]);
        let target = critic.tensor(&targets, [targets.len(), 1]);
        let [first, second] = self.networks.values(&critic, &now, actions).map(|value| value - target.clone());
        let loss = (first.clone() * first).mean() + (second.clone() * second).mean();
        let critic_loss = scalar(&loss.clone().inner());
        let critic_gradient = critic.gradients(critic_layout, &loss);
        self.adams[1].step(&mut self.online[1], &critic_gradient, settings.learning_rate);
        let mut stats = UpdateStats { critic_loss, targets, critic_gradient, ..UpdateStats::default() };
        if with_actor {
            // The critic as it is after its step.
            let actor = Weights::tracked(actor_layout, &self.online[0]);
            let critic = Weights::passed(critic_layout, &self.online[1]);
            let [value, _] = self.networks.values(&critic, &now, self.networks.act(&actor, &now));
            let loss = value.mean().neg();
            stats.actor_loss = Some(scalar(&loss.clone().inner()));
            stats.actor_gradient = actor.gradients(actor_layout, &loss);
            self.adams[0].step(&mut self.online[0], &stats.actor_gradient, settings.learning_rate);
            for (target, online) in self.targets.iter_mut().zip(&self.online) {
                for (target, online) in target.iter_mut().zip(online) {
                    *target = settings.tau * online + (1.0 - settings.tau) * *target;
                }
            }
        }
        stats
    }

    /// The actor's weights, to act with.
    pub fn actor(&self) -> Weights {
        Weights::new(&self.layouts[0], &self.online[0])
    }

    /// The critics' weights.
    pub fn critic(&self) -> Weights {
        Weights::new(&self.layouts[1], &self.online[1])
    }

    /// The layout of the actor's parameters and of the critics'.
    pub fn layouts(&self) -> &[Layout; 2] {
        &self.layouts
    }
}

/// A run of TD3 between two iterations.
pub struct OffPolicy<N> {
    config: TrainConfig,
    settings: Td3Settings,
    learner: Td3<N>,
    environments: Vec<RolloutWorker>,
    replay: ReplayBuffer,
    iteration: u64,
    updates: u64,
}

impl<N: DeterministicActorCritic> OffPolicy<N> {
    /// A run that has not begun.
    pub fn new(config: &TrainConfig, settings: Td3Settings, learner: Td3<N>, make: MakeEnvironment) -> Result<Self> {
        let mut environments = Vec::with_capacity(settings.environments);
        for index in 0..settings.environments {
            let environment = checked(make(index)?, index)?;
            environments.push(RolloutWorker::new(
                environment,
                index,
                config.seed,
                settings.gamma,
                WIDTHS,
                Lesson::default(),
            ));
        }
        let modules = environments.first().context("there must be an environment")?.modules();
        if let Some(other) = environments.iter().find(|worker| worker.modules() != modules) {
            bail!(
                "{} keeps transitions of snakes of one length; these have {modules} and {} modules: set lengths = []",
                config.method,
                other.modules()
            );
        }
        let replay = ReplayBuffer::new(settings.replay, modules);
        Ok(Self { config: config.clone(), settings, learner, environments, replay, iteration: 0, updates: 0 })
    }

    /// Takes one step in every environment. Returns the transitions and the outcomes of the episodes that ended.
    fn step(&mut self, actor: &Weights, random: bool, rng: &mut impl Rng) -> (Transitions, Vec<Outcome>) {
        let modules = self.environments[0].modules();
        let mut new = Transitions { modules, ..Transitions::default() };
        for worker in &self.environments {
            new.observations.extend(raw(&worker.view));
            new.heard.extend(with_itself(&worker.view.heard));
        }
        new.actions = if random {
            (0..new.heard.len() * ACTIONS).map(|_| rng.random_range(-1.0..1.0)).collect()
        } else {
            let seen = seen(actor, &new.observations, &new.heard, modules);
            let mut noise = Vec::new();
            normal_noise(rng, new.heard.len(), ACTIONS, &mut noise);
            let means = floats(self.learner.networks.act(actor, &seen));
            let explored = |(mean, noise): (f32, f32)| (mean + self.settings.exploration * noise).clamp(-1.0, 1.0);
            means.into_iter().zip(noise).map(explored).collect()
        };
        let mut outcomes = Vec::new();
        let actions = new.actions.as_chunks::<ACTIONS>().0.chunks_exact(modules);
        for (worker, actions) in self.environments.iter_mut().zip(actions) {
            worker.actions.extend_from_slice(actions);
            let outcome = worker.environment.step(actions);
            worker.environment.view(&mut worker.view);
            new.rewards.push(outcome.reward);
            new.done.push(f32::from(u8::from(outcome.terminated)));
            new.next_observations.extend(raw(&worker.view));
            new.next_heard.extend(with_itself(&worker.view.heard));
            if outcome.terminated || outcome.truncated {
                worker.episode += 1;
                worker.actions.clear();
                worker.environment.reset(episode_seed(self.config.seed, worker.index, worker.episode));
                worker.environment.view(&mut worker.view);
                outcomes.push(outcome);
            }
        }
        (new, outcomes)
    }
}

impl<N: DeterministicActorCritic> Algorithm for OffPolicy<N> {
    fn iterate(&mut self) -> Result<Report> {
        let began = Instant::now();
        let settings = self.settings;
        let mut rng = stream(self.config.seed, Stream::Noise, self.iteration, 0);
        let actor = self.learner.actor();
        let mut outcomes = Vec::new();
        let mut rewards = 0.0;
        for step in 0..settings.rollout_steps {
            let taken = self.iteration * self.steps_per_iteration() + (step * settings.environments) as u64;
            let (new, ended) = self.step(&actor, taken < settings.random_steps, &mut rng);
            rewards += new.rewards.iter().map(|r| f64::from(*r)).sum::<f64>();
            self.replay.push(&new);
            outcomes.extend(ended);
        }
        let rollout = began.elapsed();
        let steps = self.steps_per_iteration();
        let [mut critic_loss, mut actor_loss, mut critic_steps, mut actor_steps] = [0.0, 0.0, 0.0f64, 0.0f64];
        let mut rng = stream(self.config.seed, Stream::Shuffle, self.iteration, 0);
        // Fractions of an update are carried over to the next iteration.
        let due = ((self.iteration + 1) * steps) as f64 * settings.updates_per_step;
        while self.updates < due as u64 {
            let batch = self.replay.sample(settings.batch, &mut rng);
            let mut noise = Vec::new();
            normal_noise(&mut rng, batch.heard.len(), ACTIONS, &mut noise);
            noise.iter_mut().for_each(|x| *x *= settings.target_noise);
            let stats = self.learner.update(&batch, &noise, &settings, self.updates.is_multiple_of(settings.delay));
            critic_loss += stats.critic_loss;
            critic_steps += 1.0;
            if let Some(loss) = stats.actor_loss {
                actor_loss += loss;
                actor_steps += 1.0;
            }
            self.updates += 1;
        }
        if !self.learner.online.iter().flatten().all(|p| p.is_finite()) {
            bail!(
                "training diverged in iteration {}: a weight is no longer a finite number. The last checkpoint is from before; \
                 a lower learning_rate may help",
                self.iteration + 1
            );
        }
        self.iteration += 1;
        let wall = began.elapsed();
        let times = Times { steps, wall, physics: rollout, update: wall.saturating_sub(rollout), ..Times::default() };
        let mut scalars = episode_scalars(&outcomes.iter().collect::<Vec<_>>());
        scalars.extend([
            ("charts/step_reward".into(), rewards / steps as f64),
            ("charts/learning_rate".into(), f64::from(settings.learning_rate)),
            ("losses/critic_loss".into(), critic_loss / critic_steps.max(1.0)),
            ("losses/actor_loss".into(), actor_loss / actor_steps.max(1.0)),
            ("losses/updates".into(), self.updates as f64),
        ]);
        Ok(Report { times, scalars })
    }

    fn policy(&self) -> TrainedPolicy {
        self.learner.networks.policy(&self.learner.online[0])
    }

    fn iteration(&self) -> u64 {
        self.iteration
    }

    fn steps_per_iteration(&self) -> u64 {
        (self.settings.environments * self.settings.rollout_steps) as u64
    }

    fn join_ranks(&mut self, _ranks: Arc<dyn Ranks>) -> Result<()> {
        bail!(
            "{} learns in one process: its updates are one after the other, on batches too small to share",
            self.config.method
        )
    }

    fn save(&self) -> State {
        let Td3 { online: [actor, critic], targets: [actor_target, critic_target], adams: [a, c], .. } = &self.learner;
        let online = [actor, &a.first, &a.second, critic, &c.first, &c.second].map(Clone::clone);
        let none = Vec::new;
        let targets = [actor_target.clone(), none(), none(), critic_target.clone(), none(), none()];
        let episode = |worker: &RolloutWorker| EpisodeState { number: worker.episode, actions: worker.actions.clone() };
        State {
            iteration: self.iteration,
            learners: vec![
                LearnerState { adam_steps: [a.steps, c.steps], parameters: online, ..LearnerState::default() },
                LearnerState { parameters: targets, ..LearnerState::default() },
            ],
            statistics: vec![self.updates as f64],
            episodes: self.environments.iter().map(episode).collect(),
            replay: self.replay.numbers(),
        }
    }

    fn load(&mut self, state: &State, make: MakeEnvironment) -> Result<()> {
        let wrong = || anyhow::anyhow!("the checkpoint is of other networks than {} has here", self.config.method);
        let [online, targets] = &state.learners[..] else { return Err(wrong()) };
        let lengths = [0, 1].map(|part: usize| self.learner.online[part].len());
        let [actor, a1, a2, critic, c1, c2] = &online.parameters;
        let [actor_target, .., critic_target, _, _] = &targets.parameters;
        let fits = [actor, a1, a2, actor_target].iter().all(|v| v.len() == lengths[0])
            && [critic, c1, c2, critic_target].iter().all(|v| v.len() == lengths[1]);
        let [updates] = state.statistics[..] else { return Err(wrong()) };
        if !fits || state.episodes.len() != self.environments.len() || !self.replay.restore(&state.replay) {
            return Err(wrong());
        }
        let adam = |first: &Vec<f32>, second: &Vec<f32>, steps| Adam {
            first: first.clone(),
            second: second.clone(),
            steps,
            epsilon: 1e-8,
        };
        self.learner.online = [actor.clone(), critic.clone()];
        self.learner.targets = [actor_target.clone(), critic_target.clone()];
        self.learner.adams = [adam(a1, a2, online.adam_steps[0]), adam(c1, c2, online.adam_steps[1])];
        self.updates = updates as u64;
        for (index, EpisodeState { number, actions }) in state.episodes.iter().enumerate() {
            let (seed, gamma) = (self.config.seed, self.settings.gamma);
            let environment: Box<dyn Environment> = checked(make(index)?, index)?;
            self.environments[index] = RolloutWorker::restore(
                environment,
                index,
                seed,
                gamma,
                WIDTHS,
                (*number, Lesson::default()),
                actions.clone(),
            );
        }
        self.iteration = state.iteration;
        Ok(())
    }
}

/// Observations of teams as a method without normalisation takes them.
pub fn raw(view: &crate::environment::View) -> Vec<f32> {
    let mut all = Vec::with_capacity(view.observations.len() * BASE);
    view.observations.iter().for_each(|observation| all.extend_from_slice(&observation[..BASE]));
    all
}
