//! What a learner sees of a robot made of modules, and two trivial such robots to test learners with.

use composer_shared::observation::{Observation, SIZE};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::tasks::Point;

/// Extra numbers per module that only the critic sees, and only in training (linear velocity, height, fault flags ...).
pub const PRIVILEGED: usize = 16;

/// One moment of a multi-module environment as the learner sees it. Every vector has one entry a module, head first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct View {
    /// What each module observes, raw (not normalised).
    pub observations: Vec<Observation>,
    /// What only the critic sees, raw.
    pub privileged: Vec<[f32; PRIVILEGED]>,
    /// Bit j of `heard[i]`: module i hears the latent of module j. A module always hears itself; its own bit is implied.
    pub heard: Vec<u64>,
    /// False for a dead module: its action has no effect and is left out of the loss.
    pub acts: Vec<bool>,
}

impl View {
    /// Makes room for exactly `modules` modules: zero observations, everybody hears everybody, everybody acts.
    pub fn clear(&mut self, modules: usize) {
        let all = if modules >= 64 { u64::MAX } else { (1 << modules) - 1 };
        self.observations.clear();
        self.observations.resize(modules, [0.0; SIZE]);
        self.privileged.clear();
        self.privileged.resize(modules, [0.0; PRIVILEGED]);
        self.heard.clear();
        self.heard.resize(modules, all);
        self.acts.clear();
        self.acts.resize(modules, true);
    }
}

/// Masks of who hears whom, one a module from the first on, with every module's own bit set.
pub fn with_itself(heard: &[u64]) -> impl Iterator<Item = u64> + '_ {
    heard.iter().enumerate().map(|(module, heard)| heard | 1 << module)
}

/// Kinds of faults that a [`Lesson`] tells apart: motors dead, sensors blind, unplugged.
pub const KINDS: usize = 3;
/// Places along the robot that it tells apart.
pub const PLACES: usize = 8;
/// A kind at a place: number `kind * PLACES + place`.
pub const TROUBLES: usize = KINDS * PLACES;

/// The place of a module, head first: of eight modules each has its own.
pub fn place_of(module: usize, modules: usize) -> usize {
    let gaps = modules.max(2) - 1;
    ((2 * module * (PLACES - 1) + gaps) / (2 * gaps)).min(PLACES - 1)
}

/// What the episodes that begin now are to be like. By default they are as the environment's settings have them.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Lesson {
    /// The share of episodes with faults is that of the settings times this.
    pub faults: f32,
    /// Share of the episodes in which what varies is drawn; 0 to 1.
    pub varied: f32,
    /// Share of the faults that is drawn in proportion to `failure`; 0 to 1.
    pub failure_share: f32,
    /// How often episodes with each trouble fail, 0 to 1.
    pub failure: [f32; TROUBLES],
}

impl Default for Lesson {
    fn default() -> Self {
        Self { faults: 1.0, varied: 1.0, failure_share: 0.0, failure: [0.5; TROUBLES] }
    }
}

impl Lesson {
    /// All numbers it is made of; [`Lesson::from_numbers`] takes them back.
    pub fn numbers(&self) -> impl Iterator<Item = f64> {
        [self.faults, self.varied, self.failure_share].into_iter().chain(self.failure).map(f64::from)
    }

    /// One of these numbers; none if they are too few.
    pub fn from_numbers(numbers: &mut impl Iterator<Item = f64>) -> Option<Self> {
        let mut next = || numbers.next().map(|x| x as f32);
        let mut lesson = Self { faults: next()?, varied: next()?, failure_share: next()?, failure: [0.0; TROUBLES] };
        for failure in &mut lesson.failure {
            *failure = next()?;
        }
        Some(lesson)
    }
}

/// What one step of an environment led to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Outcome {
    /// Reward of the step, shared by all modules.
    pub reward: f32,
    /// The episode ended in a terminal state (such as success): nothing can be earned after it.
    pub terminated: bool,
    /// The episode was cut off (time limit): more could have been earned, so the learner bootstraps.
    pub truncated: bool,
    /// The task has been solved.
    pub success: bool,
    /// Distance that is left, in robot units (or whatever the task measures).
    pub distance: f32,
    /// Steps since the reset.
    pub steps: u32,
    /// Sum of the rewards since the reset.
    pub episode_return: f32,
    /// Faults that the episode has had so far: bit i for trouble i (see [`TROUBLES`]).
    pub troubles: u32,
}

/// A robot of several modules with a task.
///
/// Deterministic: the same seed and the same actions give the same bits. A training run is resumed by that promise alone: its
/// checkpoint holds the seed of each running episode and the actions taken in it, not the state of any physics.
pub trait Environment: Send {
    /// How many modules there are, the same in every episode.
    fn modules(&self) -> usize;
    /// Starts an episode; everything random in it comes from the seed.
    fn reset(&mut self, seed: u64);
    /// Says what the episodes from the next reset on are to be like. Without effect on an environment that has no faults and varies nothing.
    fn teach(&mut self, lesson: &Lesson) {
        let _ = lesson;
    }
    /// Writes what is seen now.
    fn view(&self, view: &mut View);
    /// Applies one action per module (unclipped; the environment clips) for one control step.
    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome;
    /// The point of the world that lies at `offset` from a module, in the module's own frame; units. All zeros give the module's place.
    fn place(&self, module: usize, offset: [f32; 3]) -> Point;
    /// What the imagination policy earns for imagining the modules at `positions` (world, units) one step from now: the more, the nearer
    /// they would be to the state that completes the task (paper, section III-B, `R^H`).
    fn imagined_reward(&self, positions: &[Point]) -> f32;
    /// The same, measured by where each module by itself should be.
    fn imagined_reward_of_each(&self, positions: &[Point]) -> f32 {
        self.imagined_reward(positions)
    }
    /// How far towards a target (world, units) a module could go on a straight line, for the walls and the ground.
    fn clipped(&self, module: usize, target: Point) -> Point {
        let _ = module;
        target
    }
}

/// Who is told the target of a [`Trivial`] environment.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Told {
    /// Every module.
    All,
    /// Module 0 alone, so that the others must hear it from there.
    Head,
}

/// The simplest task that still needs every module: each must output the target that is drawn at reset, and that stands in the first
/// two fields of the observation of those who are told.
///
/// The reward of a step is `1 - mean squared error` over the modules that act, at most 1. An episode has [`Trivial::STEPS`] steps and
/// ends by truncation. With [`Told::Head`] a team of n that cannot talk earns at most 1 - (n - 1) / 3n on average, by the head alone.
///
/// The modules stay at the origin, whatever they do; they are imagined best at the target as a point of the plane.
#[derive(Clone, Debug)]
pub struct Trivial {
    modules: usize,
    told: Told,
    dead: Option<usize>,
    target: [f32; 2],
    steps: u32,
    episode_return: f32,
}

impl Trivial {
    /// Steps in an episode.
    pub const STEPS: u32 = 10;

    /// A team of `modules`, of which those in `told` know the target.
    pub fn new(modules: usize, told: Told) -> Self {
        Self { modules, told, dead: None, target: [0.0; 2], steps: 0, episode_return: 0.0 }
    }

    /// The same with one dead module, which nobody hears and whose action counts for nothing.
    pub fn with_dead(mut self, module: usize) -> Self {
        self.dead = Some(module);
        self
    }
}

impl Environment for Trivial {
    fn modules(&self) -> usize {
        self.modules
    }

    fn reset(&mut self, seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        self.target = [rng.random_range(-1.0..1.0), rng.random_range(-1.0..1.0)];
        self.steps = 0;
        self.episode_return = 0.0;
    }

    fn view(&self, view: &mut View) {
        view.clear(self.modules);
        for module in 0..self.modules {
            let o = &mut view.observations[module];
            o[27] = composer_shared::observation::place(module, self.modules);
            if self.told == Told::All || module == 0 {
                o[..2].copy_from_slice(&self.target);
                o[7] = 1.0;
            }
            view.privileged[module][..2].copy_from_slice(&self.target);
        }
        if let Some(dead) = self.dead {
            view.acts[dead] = false;
            for heard in &mut view.heard {
                *heard &= !(1 << dead);
            }
        }
    }

    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome {
        let mut error = 0.0;
        let mut acting = 0.0f32;
        for (module, action) in actions.iter().enumerate() {
            if self.dead != Some(module) {
                acting += 1.0;
                error += (0..2).map(|i| (action[i].clamp(-1.0, 1.0) - self.target[i]).powi(2)).sum::<f32>() / 2.0;
            }
        }
        let distance = error / acting.max(1.0);
        let reward = 1.0 - distance;
        self.steps += 1;
        self.episode_return += reward;
        Outcome {
            reward,
            terminated: false,
            truncated: self.steps >= Self::STEPS,
            success: distance < 0.05,
            distance,
            steps: self.steps,
            episode_return: self.episode_return,
            troubles: 0,
        }
    }

    fn place(&self, _module: usize, offset: [f32; 3]) -> Point {
        offset
    }

    fn imagined_reward(&self, positions: &[Point]) -> f32 {
        let [x, y] = self.target;
        -mean_distance(positions.iter().map(|p| (*p, [x, y, 0.0])))
    }
}

/// The simplest body that can follow an imagination: points in a plane, each turned its own way, that move as told, and a target for each.
///
/// The task pays nothing. Whoever learns to move the points to their targets has learnt it from the imagination policy, which is paid for
/// imagining them nearer. Module i observes its target in its own frame in the first two fields; its action is its velocity in its own
/// frame, as a fraction of [`Drift::SPEED`]. An episode has [`Drift::STEPS`] steps and ends by truncation.
#[derive(Clone, Debug)]
pub struct Drift {
    positions: Vec<Point>,
    headings: Vec<f32>,
    targets: Vec<Point>,
    steps: u32,
}

impl Drift {
    /// Steps in an episode.
    pub const STEPS: u32 = 16;
    /// Farthest that a point moves along an axis in a step, units.
    pub const SPEED: f32 = 0.5;
    /// Targets lie within this of the points at the start along each axis, units.
    const RANGE: f32 = 3.0;

    /// So many points.
    pub fn new(modules: usize) -> Self {
        let (positions, headings, targets) = (vec![[0.0; 3]; modules], vec![0.0; modules], vec![[0.0; 3]; modules]);
        let mut drift = Self { positions, headings, targets, steps: 0 };
        drift.reset(0);
        drift
    }

    /// Mean distance of the points from their targets, units.
    fn distance(&self, positions: &[Point]) -> f32 {
        mean_distance(positions.iter().copied().zip(self.targets.iter().copied()))
    }
}

impl Environment for Drift {
    fn modules(&self) -> usize {
        self.positions.len()
    }

    fn reset(&mut self, seed: u64) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        self.steps = 0;
        let mut number = |range: f32| rng.random_range(-range..range);
        for module in 0..self.positions.len() {
            self.headings[module] = number(std::f32::consts::PI);
            self.positions[module] = [number(Self::RANGE), number(Self::RANGE), 0.0];
            let [x, y, z] = self.positions[module];
            self.targets[module] = [x + number(Self::RANGE), y + number(Self::RANGE), z];
        }
    }

    fn view(&self, view: &mut View) {
        view.clear(self.positions.len());
        for (module, observation) in view.observations.iter_mut().enumerate() {
            let (sin, cos) = libm::sincosf(self.headings[module]);
            let [x, y] = [0, 1].map(|axis| self.targets[module][axis] - self.positions[module][axis]);
            observation[..2].copy_from_slice(&[cos * x + sin * y, cos * y - sin * x]);
            observation[27] = composer_shared::observation::place(module, self.positions.len());
        }
    }

    fn step(&mut self, actions: &[[f32; 2]]) -> Outcome {
        for (module, action) in actions.iter().enumerate() {
            let [x, y] = action.map(|a| Self::SPEED * a.clamp(-1.0, 1.0));
            self.positions[module] = self.place(module, [x, y, 0.0]);
        }
        self.steps += 1;
        let distance = self.distance(&self.positions);
        Outcome {
            truncated: self.steps >= Self::STEPS,
            success: distance < Self::SPEED,
            distance,
            steps: self.steps,
            ..Outcome::default()
        }
    }

    fn place(&self, module: usize, [x, y, z]: [f32; 3]) -> Point {
        let (sin, cos) = libm::sincosf(self.headings[module]);
        let at = self.positions[module];
        [at[0] + cos * x - sin * y, at[1] + sin * x + cos * y, at[2] + z]
    }

    fn imagined_reward(&self, positions: &[Point]) -> f32 {
        self.distance(&self.positions) - self.distance(positions)
    }
}

fn mean_distance(pairs: impl ExactSizeIterator<Item = (Point, Point)>) -> f32 {
    let count = pairs.len().max(1) as f32;
    pairs.map(|(p, q)| libm::sqrtf((0..3).map(|axis| (p[axis] - q[axis]).powi(2)).sum())).sum::<f32>() / count
}
