//! Collecting experience: the environments of a group take each step together, every group on whichever thread is free.
//!
//! No group waits for another, and nothing an environment does depends on which thread runs it or when.

use std::ops::Range;
use std::time::{Duration, Instant};

use composer_shared::observation::Observation;
use rand_chacha::ChaCha8Rng;

use super::buffer::{Decisions, RolloutBuffer, Trajectory};
use super::{ActorCritic, Drawn, Teams};
use crate::environment::{Environment, Lesson, PRIVILEGED, View, with_itself};
use crate::methods::normalise::{Frozen, Running};
use crate::methods::random::{Stream, derive_seed, normal_noise, stream};
use crate::methods::ranks::{self, Opened, Parcel, Ranks};
use crate::methods::workers::Workers;
use crate::tasks::Point;

/// Actions of a module under a control policy: yaw and pitch torque as a fraction of the limit.
pub const ACTIONS: usize = 2;

/// Numbers a module has in a rollout.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Widths {
    /// Numbers of an observation that the policy takes.
    pub inputs: usize,
    /// Numbers that it remembers.
    pub memory: usize,
}

impl Widths {
    /// Those of a control policy.
    pub fn of(policy: &impl ActorCritic) -> Self {
        Self { inputs: policy.inputs(), memory: policy.memory() }
    }
}

/// An environment, where it is in its sequence of episodes, and how it got there.
pub struct RolloutWorker {
    pub(crate) environment: Box<dyn Environment>,
    pub(crate) index: usize,
    modules: usize,
    /// Number of the running episode.
    pub episode: u64,
    /// What it was to be like.
    pub lesson: Lesson,
    /// Actions since its reset, all modules of a step together.
    pub actions: Vec<[f32; ACTIONS]>,
    /// What its modules remember, `[module][memory]`; zeros at the start of an episode.
    pub memory: Vec<f32>,
    pub(crate) view: View,
    observations: Running,
    privileged: Running,
    gamma: f32,
    /// Running discounted sum of the rewards of the episode.
    discounted: f32,
    returns: Running,
}

impl RolloutWorker {
    /// Starts the first episode of the environment `index` of a run.
    pub fn new(
        environment: Box<dyn Environment>,
        index: usize,
        run_seed: u64,
        gamma: f32,
        widths: Widths,
        lesson: Lesson,
    ) -> Self {
        Self::restore(environment, index, run_seed, gamma, widths, (0, lesson), Vec::new())
    }

    /// Brings an environment back to where it was: starts its episode again and replays the actions. What its modules remember is not brought back.
    pub fn restore(
        mut environment: Box<dyn Environment>,
        index: usize,
        run_seed: u64,
        gamma: f32,
        widths: Widths,
        (episode, lesson): (u64, Lesson),
        actions: Vec<[f32; ACTIONS]>,
    ) -> Self {
        environment.teach(&lesson);
        environment.reset(episode_seed(run_seed, index, episode));
        let modules = environment.modules();
        let mut discounted = 0.0;
        for step in actions.chunks_exact(modules.max(1)) {
            discounted = gamma * discounted + environment.step(step).reward;
        }
        let mut view = View::default();
        environment.view(&mut view);
        Self {
            environment,
            index,
            modules,
            episode,
            lesson,
            actions,
            memory: vec![0.0; modules * widths.memory],
            view,
            observations: Running::new(widths.inputs),
            privileged: Running::new(PRIVILEGED),
            gamma,
            discounted,
            returns: Running::new(1),
        }
    }

    /// Modules of the environment.
    pub fn modules(&self) -> usize {
        self.modules
    }
}

/// Seed of an episode. Independent of everything else that is drawn in the run.
pub fn episode_seed(run_seed: u64, environment: usize, episode: u64) -> u64 {
    derive_seed(run_seed, Stream::Episode, environment as u64, episode)
}

/// A second policy that decides beside the control policy in the same rollouts, and what that means.
pub trait Companion: Send + Sync {
    /// What it is called in the metrics.
    fn name(&self) -> &'static str;

    /// What its error is called there.
    fn error_name(&self) -> &'static str;

    /// What it earns for `actions` before the step is taken; `plan` gets what they stand for.
    fn plan(&self, environment: &dyn Environment, acts: &[bool], actions: &[f32], plan: &mut Vec<Point>) -> f32;

    /// By how much the step that was taken missed the plan.
    fn error(&self, environment: &dyn Environment, acts: &[bool], plan: &[Point]) -> f32;

    /// What is taken off the control policy's reward for an error of 1.
    fn weight(&self) -> f32;

    /// Steps that a plan is kept for; a new one is made earlier when an episode or a rollout begins.
    fn hold(&self) -> usize {
        1
    }

    /// Whether the control policy pays for the growth of the error in a step instead of for the error after it.
    fn telescopes(&self) -> bool {
        false
    }

    /// Whether every module pays for its own error alone.
    fn each(&self) -> bool {
        false
    }

    /// Whether the control policy is told what it would do.
    fn tells(&self) -> bool {
        false
    }

    /// Tells it: puts the mean actions, `[module][outputs]`, where the control policy takes them from.
    fn tell(&self, means: &[f32], observations: &mut [Observation]) {
        let _ = (means, observations);
    }

    /// What is taken off its own reward for the error that is left when a plan ends.
    fn feasible(&self) -> f32 {
        0.0
    }

    /// What it earns for a plan that it keeps.
    fn keep(&self, environment: &dyn Environment, plan: &[Point]) -> f32 {
        let _ = (environment, plan);
        0.0
    }

    /// By how much each module missed the plan; 0 for those that do not act.
    fn errors(&self, environment: &dyn Environment, acts: &[bool], plan: &[Point]) -> Vec<f32> {
        let _ = (environment, acts);
        vec![0.0; plan.len()]
    }
}

/// A plan, and the step of the rollout that it was made in.
#[derive(Clone, Debug, Default)]
struct Plan {
    points: Vec<Point>,
    since: Option<usize>,
}

/// What all environments of an iteration have in common.
pub struct Iteration<'a, C> {
    /// The control policy.
    pub policy: &'a C,
    /// The policy beside it with the seed of its random streams, if the method has one.
    pub companion: Option<(&'a C, u64, &'a dyn Companion)>,
    /// Statistics of the observations.
    pub observations: Frozen,
    /// Statistics of the privileged numbers.
    pub privileged: Frozen,
    /// Statistics of the running discounted sums of rewards, if rewards are divided by their standard deviation.
    pub rewards: Option<Frozen>,
    /// Seed of the run.
    pub run_seed: u64,
    /// What the episodes that begin in it are to be like.
    pub lesson: Lesson,
    /// Number of the iteration.
    pub iteration: u64,
    /// Steps each environment takes.
    pub steps: usize,
}

/// Processor time of a rollout, summed over the threads.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Split {
    /// Inside the environments.
    pub physics: Duration,
    /// Everything else: the policy, the noise, book-keeping.
    pub inference: Duration,
}

/// Runs an iteration: fills `buffer` (as many environments as workers) and takes what was seen into the statistics of
/// observations, privileged numbers and running discounted sums of rewards.
pub fn collect<C: ActorCritic>(
    environments: &mut [RolloutWorker],
    buffer: &mut RolloutBuffer,
    iteration: &Iteration<C>,
    workers: &Workers,
    [observations, privileged, returns]: [&mut Running; 3],
) -> Split {
    let mut scratch: Vec<(C::Scratch, Split)> = (0..workers.threads()).map(|_| Default::default()).collect();
    let RolloutBuffer { trajectories, control, companion } = buffer;
    let own = own_environments::<C>(environments.len(), workers);
    let groups =
        environments[own.clone()].chunks_mut(C::TOGETHER).zip(trajectories[own.clone()].chunks_mut(C::TOGETHER));
    let decisions = control[own.clone()].chunks_mut(C::TOGETHER).zip(companion[own.clone()].chunks_mut(C::TOGETHER));
    workers.for_each(groups.zip(decisions), &mut scratch, |((group, to), (control, companion)), (scratch, split)| {
        let began = Instant::now();
        let physics = run(group, to, control, companion, iteration, scratch);
        split.physics += physics;
        split.inference += began.elapsed().saturating_sub(physics);
    });
    if let Some(ranks) = workers.ranks() {
        gather_from_ranks::<C>(environments, buffer, ranks);
    }
    // In the order of the environments, so that rounding does not depend on the threads.
    for environment in environments {
        let inputs = iteration.policy.inputs();
        observations.merge(&std::mem::replace(&mut environment.observations, Running::new(inputs)));
        privileged.merge(&std::mem::replace(&mut environment.privileged, Running::new(PRIVILEGED)));
        returns.merge(&std::mem::replace(&mut environment.returns, Running::new(1)));
    }
    let mut total = Split::default();
    for (_, split) in scratch {
        total.physics += split.physics;
        total.inference += split.inference;
    }
    total
}

/// The environments that run in this process: all of them, or this rank's share of the groups.
fn own_environments<C: ActorCritic>(all: usize, workers: &Workers) -> Range<usize> {
    environments_of::<C>(all, |groups| workers.ranks().map_or(0..groups, |ranks| ranks.share(groups)))
}

fn environments_of<C: ActorCritic>(all: usize, share: impl Fn(usize) -> Range<usize>) -> Range<usize> {
    let groups = share(all.div_ceil(C::TOGETHER));
    groups.start * C::TOGETHER..(groups.end * C::TOGETHER).min(all)
}

/// Hands all ranks what the environments of each went through: afterwards everybody has all of it, but for the environments themselves.
fn gather_from_ranks<C: ActorCritic>(
    environments: &mut [RolloutWorker],
    buffer: &mut RolloutBuffer,
    ranks: &dyn Ranks,
) {
    let all = environments.len();
    let RolloutBuffer { trajectories, control, companion } = buffer;
    let mut parcel = Parcel::default();
    for i in environments_of::<C>(all, |groups| ranks.share(groups)) {
        parcel.trajectory(&trajectories[i], [&control[i], &companion[i]]);
        let worker = &environments[i];
        parcel.list(&[worker.episode]);
        parcel.list(&worker.actions);
        parcel.list(&worker.memory);
        let statistics = worker.observations.numbers().chain(worker.privileged.numbers());
        let numbers = statistics.chain(worker.returns.numbers()).chain(worker.lesson.numbers());
        parcel.list(&numbers.collect::<Vec<_>>());
    }
    for (rank, bytes) in ranks.all_gather(parcel.bytes()).iter().enumerate().filter(|(rank, _)| *rank != ranks.rank()) {
        let mut opened = Opened::new(bytes);
        for i in environments_of::<C>(all, |groups| ranks::share(groups, rank, ranks.count())) {
            opened.trajectory(&mut trajectories[i], [&mut control[i], &mut companion[i]]);
            let worker = &mut environments[i];
            worker.episode = opened.list().first().copied().unwrap_or_default();
            (worker.actions, worker.memory) = (opened.list(), opened.list());
            let mut numbers = opened.list::<f64>().into_iter();
            let inputs = worker.observations.mean().len();
            let of = |size, numbers: &mut _| Running::from_numbers(size, numbers).unwrap_or_else(|| Running::new(size));
            worker.observations = of(inputs, &mut numbers);
            worker.privileged = of(PRIVILEGED, &mut numbers);
            worker.returns = of(1, &mut numbers);
            worker.lesson = Lesson::from_numbers(&mut numbers).unwrap_or_default();
        }
    }
}

/// What a policy is told of a group, and what it says.
#[derive(Default)]
struct Exchange {
    observations: Vec<f32>,
    heard: Vec<u64>,
    modules: Vec<usize>,
    /// What the modules remember, `[rows, memory]`, for a policy that does.
    memory: Vec<f32>,
    noise: Vec<f32>,
    drawn: Drawn,
}

impl Exchange {
    /// Draws an action for each module of the group and hands every environment's to its decisions.
    fn decide<C: ActorCritic>(
        &mut self,
        policy: &C,
        rngs: &mut [ChaCha8Rng],
        scratch: &mut C::Scratch,
        decisions: &mut [Decisions],
    ) {
        let Self { observations, heard, modules, memory, noise, drawn } = self;
        noise.clear();
        drawn.actions.clear();
        drawn.log_probabilities.clear();
        for (rng, n) in rngs.iter_mut().zip(&*modules) {
            normal_noise(rng, *n, policy.outputs(), noise);
        }
        let teams = Teams { observations, privileged: &[], heard, modules };
        match policy.memory() {
            0 => policy.sample(teams, noise, scratch, &mut drawn.actions, &mut drawn.log_probabilities),
            _ => policy.sample_remembering(teams, memory, noise, scratch, drawn),
        }
        let (mut actions, mut log_probabilities) = (&drawn.actions[..], &drawn.log_probabilities[..]);
        let (of_actions, of_log) = (actions.len() / heard.len(), log_probabilities.len() / heard.len());
        for (decisions, n) in decisions.iter_mut().zip(modules) {
            let (own, rest) = actions.split_at(*n * of_actions);
            decisions.actions.extend_from_slice(own);
            actions = rest;
            let (own, rest) = log_probabilities.split_at(*n * of_log);
            decisions.log_probabilities.extend_from_slice(own);
            log_probabilities = rest;
        }
    }
}

/// The steps of the environments of one group. Returns the time spent in them.
fn run<C: ActorCritic>(
    group: &mut [RolloutWorker],
    trajectories: &mut [Trajectory],
    control: &mut [Decisions],
    companion: &mut [Decisions],
    iteration: &Iteration<C>,
    scratch: &mut C::Scratch,
) -> Duration {
    let mut physics = Duration::ZERO;
    let mut exchange = Exchange { modules: group.iter().map(|worker| worker.modules).collect(), ..Default::default() };
    let noise = |seed, group: &[RolloutWorker]| -> Vec<ChaCha8Rng> {
        let of = |worker: &RolloutWorker| stream(seed, Stream::Noise, iteration.iteration, worker.index as u64);
        group.iter().map(of).collect()
    };
    let mut rngs = noise(iteration.run_seed, group);
    let mut companion_rngs = iteration.companion.map_or_else(Vec::new, |(_, seed, _)| noise(seed, group));
    let mut plans = vec![Plan::default(); group.len()];
    let mut endings = Vec::new();
    for (worker, trajectory) in group.iter().zip(&mut *trajectories) {
        trajectory.clear(worker.modules);
    }
    control.iter_mut().chain(&mut *companion).for_each(Decisions::clear);
    for step in 0..iteration.steps {
        exchange.observations.clear();
        exchange.heard.clear();
        for (worker, trajectory) in group.iter_mut().zip(&mut *trajectories) {
            tell(&mut worker.view, iteration, scratch);
            let first = trajectory.observations.len();
            for module in 0..worker.modules {
                worker.observations.push(&worker.view.observations[module]);
                worker.privileged.push(&worker.view.privileged[module]);
                iteration.observations.apply(&worker.view.observations[module], &mut trajectory.observations);
                iteration.privileged.apply(&worker.view.privileged[module], &mut trajectory.privileged);
                trajectory.heard.push(worker.view.heard[module] | 1 << module);
            }
            trajectory.acts.extend_from_slice(&worker.view.acts);
            exchange.observations.extend_from_slice(&trajectory.observations[first..]);
            exchange.heard.extend_from_slice(&trajectory.heard[step * worker.modules..]);
        }
        if let Some((policy, _, rules)) = iteration.companion {
            exchange.decide(policy, &mut companion_rngs, scratch, companion);
            for (((worker, decisions), trajectory), plan) in
                group.iter().zip(&mut *companion).zip(&*trajectories).zip(&mut plans)
            {
                let n = worker.modules;
                let actions = &decisions.actions[step * n * policy.outputs()..];
                let anew = plan.since.is_none_or(|since| step - since >= rules.hold());
                let acts = &trajectory.acts[step * n..];
                let reward = if anew {
                    plan.since = Some(step);
                    rules.plan(&*worker.environment, acts, actions, &mut plan.points)
                } else {
                    rules.keep(&*worker.environment, &plan.points)
                };
                decisions.rewards.push(reward);
                decisions.counts.push(anew);
            }
        }
        exchange.memory.clear();
        for (worker, decisions) in group.iter().zip(&mut *control) {
            decisions.memory.extend_from_slice(&worker.memory);
            exchange.memory.extend_from_slice(&worker.memory);
        }
        exchange.decide(iteration.policy, &mut rngs, scratch, control);
        let mut remembered = &exchange.memory[..];
        for worker in &mut *group {
            let (own, rest) = remembered.split_at(worker.memory.len());
            worker.memory.copy_from_slice(own);
            remembered = rest;
        }
        for (((worker, decisions), trajectory), plan) in
            group.iter_mut().zip(&mut *control).zip(&mut *trajectories).zip(&plans)
        {
            let paying = iteration.companion.filter(|(_, _, rules)| rules.telescopes() || rules.each());
            let errors = |worker: &RolloutWorker, trajectory: &Trajectory| {
                paying.map(|(_, _, rules)| {
                    let acts = &trajectory.acts[step * worker.modules..];
                    rules.errors(&*worker.environment, acts, &plan.points)
                })
            };
            let before = errors(worker, trajectory);
            let n = worker.modules;
            let actions = decisions.actions[step * n * ACTIONS..].as_chunks::<ACTIONS>().0;
            worker.actions.extend_from_slice(actions);

            let began = Instant::now();
            let outcome = worker.environment.step(actions);
            physics += began.elapsed();
            worker.discounted = worker.gamma * worker.discounted + outcome.reward;
            worker.returns.push(&[worker.discounted]);
            let mut reward =
                iteration.rewards.as_ref().map_or(outcome.reward, |rewards| rewards.scaled(outcome.reward));
            if let Some((_, _, rules)) = iteration.companion {
                let error = rules.error(&*worker.environment, &trajectory.acts[step * n..], &plan.points);
                trajectory.companion_errors.push(error);
                match (before, errors(worker, trajectory)) {
                    (Some(before), Some(after)) => {
                        let grown = |(before, after): (&f32, &f32)| {
                            rules.weight() * (after - if rules.telescopes() { *before } else { 0.0 })
                        };
                        let paid: Vec<f32> = before.iter().zip(&after).map(grown).collect();
                        if rules.each() {
                            decisions.own.extend(paid.iter().map(|paid| -paid));
                        } else {
                            let acting = trajectory.acts[step * n..].iter().filter(|acts| **acts).count();
                            reward -= paid.iter().sum::<f32>() / acting.max(1) as f32;
                        }
                    }
                    _ => reward -= rules.weight() * error,
                }
            }
            decisions.rewards.push(reward);
            trajectory.rewards.push(outcome.reward);
            endings.push(outcome.terminated || outcome.truncated);

            let began = Instant::now();
            let truncated = outcome.truncated && !outcome.terminated;
            let last = step + 1 == iteration.steps;
            if outcome.terminated || truncated {
                if truncated {
                    worker.environment.view(&mut worker.view);
                    tell(&mut worker.view, iteration, scratch);
                    finals(trajectory, &worker.view, iteration);
                }
                worker.episode += 1;
                worker.actions.clear();
                worker.discounted = 0.0;
                worker.memory.fill(0.0);
                worker.lesson = iteration.lesson;
                worker.environment.teach(&worker.lesson);
                worker.environment.reset(episode_seed(iteration.run_seed, worker.index, worker.episode));
                trajectory.episodes.push(outcome);
            }
            worker.environment.view(&mut worker.view);
            physics += began.elapsed();

            trajectory.terminated.push(outcome.terminated);
            trajectory.truncated.push(truncated);
            if last && !truncated {
                tell(&mut worker.view, iteration, scratch);
                finals(trajectory, &worker.view, iteration);
            }
        }
        if let Some((_, _, rules)) = iteration.companion {
            let last = step + 1 == iteration.steps;
            for (((decisions, trajectory), plan), ended) in
                companion.iter_mut().zip(&*trajectories).zip(&mut plans).zip(endings.drain(..))
            {
                let Some(since) = plan.since else { continue };
                if ended || last || step + 1 - since >= rules.hold() {
                    if let (true, Some(error)) = (rules.feasible() > 0.0, trajectory.companion_errors.last()) {
                        decisions.rewards[since] -= rules.feasible() * error;
                    }
                    if ended {
                        plan.since = None;
                    }
                }
            }
        }
        endings.clear();
    }
    physics
}

/// Tells the control policy what the companion would do, if it is one that tells.
fn tell<C: ActorCritic>(view: &mut View, iteration: &Iteration<C>, scratch: &mut C::Scratch) {
    let Some((policy, _, rules)) = iteration.companion.filter(|(_, _, rules)| rules.tells()) else { return };
    let mut normalised = Vec::new();
    view.observations.iter().for_each(|observation| iteration.observations.apply(observation, &mut normalised));
    let heard: Vec<u64> = with_itself(&view.heard).collect();
    let modules = [heard.len()];
    let teams = Teams { observations: &normalised, privileged: &[], heard: &heard, modules: &modules };
    let (mut means, noise) = (Vec::new(), vec![0.0; heard.len() * policy.outputs()]);
    policy.sample(teams, &noise, scratch, &mut means, &mut Vec::new());
    rules.tell(&means, &mut view.observations);
}

/// Appends a final view to a trajectory.
fn finals<C: ActorCritic>(trajectory: &mut Trajectory, view: &View, iteration: &Iteration<C>) {
    for (module, (observation, privileged)) in view.observations.iter().zip(&view.privileged).enumerate() {
        iteration.observations.apply(observation, &mut trajectory.final_observations);
        iteration.privileged.apply(privileged, &mut trajectory.final_privileged);
        trajectory.final_heard.push(view.heard[module] | 1 << module);
    }
}
