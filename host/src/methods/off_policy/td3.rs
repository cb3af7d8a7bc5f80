//! TD3 (Fujimoto et al. 2018): two critics whose lesser counts, noise on the target's action, an actor that is stepped less often, and targets
//! that follow slowly.

use std::ops::Range;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Context, Result, bail};
use composer_shared::observation::BASE;
use rand::{Rng, RngExt};

use super::replay::{ReplayBuffer, Transitions};
use crate::environment::{Environment, Lesson, Outcome, with_itself};
use crate::methods::config::TrainConfig;
use crate::methods::layers::{Matrix, Memory, Network, Packed, Tape};
use crate::methods::layout::Layout;
use crate::methods::on_policy::collect::{ACTIONS, episode_seed};
use crate::methods::on_policy::{RolloutWorker, Widths};
use crate::methods::parameters::Adam;
use crate::methods::random::{Stream, normal_noise, stream};
use crate::methods::ranks::Ranks;
use crate::methods::{
    Algorithm, EpisodeState, LearnerState, MakeEnvironment, Report, State, Times, TrainedPolicy, checked,
    episode_scalars,
};

/// The paper's observation; nobody remembers anything.
const WIDTHS: Widths = Widths { inputs: BASE, memory: 0 };

/// What some teams of equal length see.
#[derive(Clone, Copy, Debug)]
pub struct Sight<'a> {
    /// Modules of each team.
    pub modules: usize,
    /// Observations, `[teams][module][BASE]`.
    pub observations: &'a [f32],
    /// Who heard whom, `[teams][module]`, own bit set.
    pub heard: &'a [u64],
}

/// The same on a tape. **The rows of modules at the same place in their teams lie together here**: row `module * teams + team`, so that one
/// place of all teams is a piece.
#[derive(Clone, Debug)]
pub struct Seen {
    /// Teams.
    pub teams: usize,
    /// Modules of each.
    pub modules: usize,
    /// Observations, `[rows, BASE]`.
    pub observations: Matrix,
    /// Who is heard by each, one mask a row.
    heard: Vec<u64>,
}

impl Seen {
    fn new(t: &mut Tape, sight: Sight) -> Self {
        let (modules, teams) = (sight.modules, sight.heard.len() / sight.modules);
        let observations = t.input(&turned(sight.observations, teams, modules), BASE);
        Self { teams, modules, observations, heard: turned(sight.heard, teams, modules) }
    }

    /// The rows of one place.
    pub fn place(&self, module: usize) -> Range<usize> {
        module * self.teams..(module + 1) * self.teams
    }

    /// 1 for each team in which module `to` hears module `from`, else 0.
    pub fn hears(&self, to: usize, from: usize) -> Vec<f32> {
        self.heard[self.place(to)].iter().map(|heard| (heard >> from & 1) as f32).collect()
    }
}

/// What is `[first, second, ..]` as `[second, first, ..]`: from teams of modules to places of teams, or back.
fn turned<T: Copy>(numbers: &[T], first: usize, second: usize) -> Vec<T> {
    let width = numbers.len() / (first * second).max(1);
    let mut turned = Vec::with_capacity(numbers.len());
    for j in 0..second {
        for i in 0..first {
            turned.extend_from_slice(&numbers[(i * second + j) * width..][..width]);
        }
    }
    turned
}

/// The networks of a deterministic method, as functions of their weights.
pub trait DeterministicActorCritic: Clone + Send + Sync + 'static {
    /// The actor's parameters, and those of both critics.
    fn layouts(&self) -> [Layout; 2];

    /// The actions, `[rows, ACTIONS]`, each within -1 to 1.
    fn act(&self, t: &mut Tape, actor: Network, seen: &Seen) -> Matrix;

    /// What the first N critics, of two, say of actions, `[rows, 1]`.
    fn values<const N: usize>(&self, t: &mut Tape, critic: Network, seen: &Seen, actions: Matrix) -> [Matrix; N];

    /// What evaluation runs.
    fn policy(&self, actor: &[f32]) -> TrainedPolicy;
}

/// The actions of teams, `[teams][module][ACTIONS]`.
pub fn act<N: DeterministicActorCritic>(networks: &N, actor: &Packed, sight: Sight, memory: &mut Memory) -> Vec<f32> {
    let mut t = Tape::new(memory);
    let actor = t.network(actor);
    let seen = Seen::new(&mut t, sight);
    let actions = networks.act(&mut t, actor, &seen);
    turned(&t.numbers(actions), seen.modules, seen.teams)
}

/// What both critics say of actions of teams, `[teams][module]`.
pub fn values<N: DeterministicActorCritic>(
    networks: &N,
    critic: &Packed,
    sight: Sight,
    actions: &[f32],
    memory: &mut Memory,
) -> [Vec<f32>; 2] {
    let mut t = Tape::new(memory);
    let critic = t.network(critic);
    let seen = Seen::new(&mut t, sight);
    let actions = t.input(&turned(actions, seen.teams, seen.modules), ACTIONS);
    let values: [Matrix; 2] = networks.values(&mut t, critic, &seen, actions);
    values.map(|value| turned(&t.numbers(value), seen.modules, seen.teams))
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
    /// What an update computes with, either of the two above in turn.
    packed: [Packed; 2],
    memory: Memory,
}

impl<N: DeterministicActorCritic> Td3<N> {
    /// With these parameters, whose targets are the same.
    pub fn new(networks: N, online: [Vec<f32>; 2]) -> Self {
        let adams = [0, 1].map(|part: usize| Adam::new(online[part].len(), 1e-8));
        let (layouts, targets, memory) = (networks.layouts(), online.clone(), Memory::default());
        let packed = [0, 1].map(|part: usize| Packed::new(&layouts[part], &online[part]));
        Self { networks, layouts, online, targets, adams, packed, memory }
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
        let Self { networks, layouts, online, targets: followers, adams, packed, memory } = self;
        let [actor, critic] = packed;
        let (modules, teams) = (batch.modules, batch.len());
        let rows = batch.heard.len();
        let share = 1.0 / rows as f32;
        let gradient = |part: usize, of: &Packed, t: Tape, values: &[(Matrix, &[f32])]| {
            let (mut sum, mut gradient) = (vec![0.0; of.len()], vec![0.0; layouts[part].len()]);
            t.backward(values, &mut sum);
            of.unpack(&sum, &mut gradient);
            gradient
        };

        actor.load(&followers[0]);
        critic.load(&followers[1]);
        let next = Sight { modules, observations: &batch.next_observations, heard: &batch.next_heard };
        let mut actions = act(networks, actor, next, memory);
        let clip = settings.target_noise_clip;
        actions.iter_mut().zip(noise).for_each(|(a, noise)| *a = (*a + noise.clamp(-clip, clip)).clamp(-1.0, 1.0));
        let [first, second] = values(networks, critic, next, &actions, memory);
        let of = |(row, (first, second)): (usize, (f32, f32))| {
            let team = row / modules;
            batch.rewards[team] + settings.gamma * (1.0 - batch.done[team]) * first.min(second)
        };
        let targets: Vec<f32> = first.into_iter().zip(second).enumerate().map(of).collect();

        critic.load(&online[1]);
        let sight = Sight { modules, observations: &batch.observations, heard: &batch.heard };
        let mut t = Tape::new(memory);
        let network = t.learning(critic);
        let now = Seen::new(&mut t, sight);
        let actions = t.input(&turned(&batch.actions, teams, modules), ACTIONS);
        let values: [Matrix; 2] = networks.values(&mut t, network, &now, actions);
        let turned_targets = turned(&targets, teams, modules);
        let errors = values.map(|value| {
            t.numbers(value).iter().zip(&turned_targets).map(|(value, target)| value - target).collect::<Vec<f32>>()
        });
        let critic_loss = errors.iter().flatten().map(|error| f64::from(share * error * error)).sum();
        let of = errors.map(|errors| errors.iter().map(|error| 2.0 * share * error).collect::<Vec<f32>>());
        let critic_gradient = gradient(1, critic, t, &[(values[0], &of[0]), (values[1], &of[1])]);
        adams[1].step(&mut online[1], &critic_gradient, settings.learning_rate);
        let mut stats = UpdateStats { critic_loss, targets, critic_gradient, ..UpdateStats::default() };
        if with_actor {
            actor.load(&online[0]);
            // The critic as it is after its step.
            critic.load(&online[1]);
            let mut t = Tape::new(memory);
            let (learning, passed) = (t.learning(actor), t.network(critic));
            let now = Seen::new(&mut t, sight);
            let actions = networks.act(&mut t, learning, &now);
            let [value] = networks.values(&mut t, passed, &now, actions);
            stats.actor_loss = Some(-t.numbers(value).iter().map(|value| f64::from(share * value)).sum::<f64>());
            stats.actor_gradient = gradient(0, actor, t, &[(value, &vec![-share; rows])]);
            adams[0].step(&mut online[0], &stats.actor_gradient, settings.learning_rate);
            for (target, online) in followers.iter_mut().zip(&*online) {
                for (target, online) in target.iter_mut().zip(online) {
                    *target = settings.tau * online + (1.0 - settings.tau) * *target;
                }
            }
        }
        stats
    }

    /// The actor's weights, to act with.
    pub fn actor(&self) -> Packed {
        Packed::new(&self.layouts[0], &self.online[0])
    }

    /// The critics' weights.
    pub fn critic(&self) -> Packed {
        Packed::new(&self.layouts[1], &self.online[1])
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
    fn step(&mut self, actor: &Packed, random: bool, rng: &mut impl Rng) -> (Transitions, Vec<Outcome>) {
        let modules = self.environments[0].modules();
        let mut new = Transitions { modules, ..Transitions::default() };
        for worker in &self.environments {
            new.observations.extend(raw(&worker.view));
            new.heard.extend(with_itself(&worker.view.heard));
        }
        new.actions = if random {
            (0..new.heard.len() * ACTIONS).map(|_| rng.random_range(-1.0..1.0)).collect()
        } else {
            let mut noise = Vec::new();
            normal_noise(rng, new.heard.len(), ACTIONS, &mut noise);
            let Td3 { networks, memory, .. } = &mut self.learner;
            let sight = Sight { modules, observations: &new.observations, heard: &new.heard };
            let means = act(networks, actor, sight, memory);
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
