//! The paper's five tasks (Table I), one file each.
//!
//! A task's settings ([`Rules`]) draw a [`Course`] for every episode: the scene and where to go in it. [`Judge`] watches an episode and
//! says after every control step what it is worth. Environment and simulated bus use the same.
//!
//! Two rewards are offered for every task: `paper`, the reward of Table I in units (times 0.1; the learner's value normalisation makes
//! the factor immaterial), and `progress`, the decrease of what is left to do, and 2 on success. `progress` is denser, and another objective: it
//! replaces the paper's reward instead of adding to it and has no discount in its difference, so that the theorem of potential-based shaping
//! (Ng, Harada, Russell 1999) does not apply and the optimal policies may differ. Both pay most for getting done, and soon.
//!
//! How hard a task is follows from the robot's size, the paper and published tasks, not from what a policy scores; each file's table says why its
//! numbers are what they are.

pub mod block_pushing;
pub mod goal_reaching;
pub mod shape_formation;
pub mod tube_crossing;
pub mod wall_climbing;

#[cfg(test)]
mod soundness;

use composer_shared::CRC_32;
use composer_shared::policy::Task;
use pathfinding::kuhn_munkres::kuhn_munkres_min;
use pathfinding::matrix::Matrix;
use rand::{Rng, RngExt};
use serde::{Deserialize, Serialize};

use self::block_pushing::BlockPushing;
use self::goal_reaching::GoalReaching;
use self::shape_formation::ShapeFormation;
use self::tube_crossing::TubeCrossing;
use self::wall_climbing::WallClimbing;
use crate::robot::Robot;
use crate::sim::{Scene, Snake};

/// A point or a vector in the world, units.
pub type Point = [f32; 3];

/// Which reward the learner gets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reward {
    /// The paper's (Table I).
    Paper,
    /// The decrease of what is left to do.
    #[default]
    Progress,
}

/// Settings that all tasks have.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TaskSettings {
    /// Which task, by its name on the command line.
    #[serde(with = "task_name")]
    pub name: Task,
    /// Control steps before the episode is cut, for a snake of up to eight modules ([`TaskSettings::cap_for`]); the value of the last
    /// state is bootstrapped.
    pub cap: u32,
    /// Reward of the training.
    pub reward: Reward,
    /// Taken off the reward of a step for each unit that the highest link is above one and a half link diameters. The paper has
    /// no such term; without it the fastest policies rear up and throw themselves at the goal.
    pub rearing_penalty: f32,
}

impl Default for TaskSettings {
    fn default() -> Self {
        TaskSettings { name: Task::GoalReaching, cap: 125, reward: Reward::Progress, rearing_penalty: 0.0 }
    }
}

/// The longest snake that has no more control steps than [`TaskSettings::cap`]: the paper's.
const CAPPED_MODULES: usize = 8;

impl TaskSettings {
    /// Control steps before the episode of a snake of so many modules is cut. Beyond eight modules they grow with its length: a longer snake has
    /// farther to go before its tail is where its head was, and the slack of the shape tasks grows with it.
    pub fn cap_for(&self, modules: usize) -> u32 {
        let scaled = (u64::from(self.cap) * modules.max(CAPPED_MODULES) as u64).div_ceil(CAPPED_MODULES as u64);
        scaled.min(u32::MAX.into()) as u32
    }

    /// Checks the settings; the error is a sentence.
    pub fn validate(&self) -> Result<(), String> {
        if !(self.rearing_penalty >= 0.0 && self.rearing_penalty.is_finite()) {
            return Err(format!("rearing_penalty = {}; it must be zero or more", self.rearing_penalty));
        }
        if self.cap == 0 {
            return Err("cap = 0; an episode needs at least one step".into());
        }
        Ok(())
    }
}

pub(crate) mod task_name {
    use composer_shared::policy::Task;
    use serde::de::Error;
    use serde::{Deserialize, Deserializer, Serializer};

    pub fn serialize<S: Serializer>(task: &Task, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.serialize_str(task.name())
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Task, D::Error> {
        let name = String::deserialize(deserializer)?;
        Task::from_name(&name).ok_or_else(|| {
            let names = Task::ALL.map(Task::name);
            D::Error::custom(format!("there is no task `{name}`; the tasks are {}", names.join(", ")))
        })
    }
}

/// The scene of an episode, and where to go in it. World frame: the snake starts along x with its head at the origin, facing +x.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Course {
    /// What stands on the ground.
    pub scene: Scene,
    /// Where to go: the goal of the head, or of the block, or the middle of the targets.
    pub goal: Point,
    /// Further places that the task needs, such as the targets of the modules or the centre line of the tube.
    pub marks: Vec<Point>,
}

/// What a control step led to.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Verdict {
    /// The paper's reward of this moment (Table I), units.
    pub paper: f32,
    /// What is left to do, units; falls to about zero on success.
    pub left: f32,
    /// What success is measured by, units: the paper's second column.
    pub distance: f32,
    /// The task is done.
    pub success: bool,
}

/// What people are told of a task.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Words {
    /// What [`Verdict::distance`] is the distance of.
    pub measure: &'static str,
    /// Said of an episode that succeeded.
    pub done: &'static str,
    /// Said of one that did not.
    pub missed: &'static str,
}

/// The settings of one task: how its scenes are drawn and what counts.
pub trait Rules {
    /// Checks the settings for a robot; the error is a sentence.
    fn validate(&self, robot: &Robot) -> Result<(), String>;
    /// Distance that counts as success, units, where it is a ball round the goal; 0 where it is not.
    fn goal_radius(&self) -> f32;
    /// What [`Verdict::distance`] must fall below, units; 0 where that is not what counts.
    fn threshold(&self) -> f32 {
        self.goal_radius()
    }
    /// What people are told of it.
    fn words(&self) -> Words;
    /// The course of the episode with this seed.
    fn course(&self, seed: u64, robot: &Robot) -> Course;
    /// Point `number` of the scene in the world, as the station tells it ([`Task::observed`]).
    fn point(&self, course: &Course, snake: &Snake, number: u8) -> Option<Point>;
    /// What the state of the snake is worth. `inside` is what the judge remembers: whether the task's gate was taken.
    fn verdict(&self, course: &Course, snake: &Snake, gate: &mut Gate) -> Verdict;
    /// How far the modules would be from the state that completes the task if they were at `positions` (world, units): the distance
    /// d(p', g) of the imagination policy's reward (paper, section III-B).
    fn imagined_distance(&self, course: &Course, snake: &Snake, positions: &[Point]) -> f32;
    /// The same, measured by where each module by itself should be, where that is not the same.
    fn imagined_distance_of_each(&self, course: &Course, snake: &Snake, positions: &[Point]) -> f32 {
        self.imagined_distance(course, snake, positions)
    }
}

/// What has to be remembered of an episode.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Gate {
    /// On this side: not in the tube.
    #[default]
    Before,
    /// In it, through its entrance.
    Inside,
    /// In it, from the wrong end.
    Astray,
    /// Through.
    Passed,
}

/// A task with its settings.
#[derive(Clone, Debug, PartialEq)]
pub struct TaskConfig {
    /// What all tasks have.
    pub settings: TaskSettings,
    /// Those of each task; the one in use is that of `settings.name`.
    pub rules: AllRules,
}

/// Settings of every task.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct AllRules {
    /// Goal Reaching.
    pub goal_reaching: GoalReaching,
    /// Block Pushing.
    pub block_pushing: BlockPushing,
    /// Shape Formation.
    pub shape_formation: ShapeFormation,
    /// Tube Crossing.
    pub tube_crossing: TubeCrossing,
    /// Wall Climbing.
    pub wall_climbing: WallClimbing,
}

impl TaskConfig {
    /// A task with its default settings.
    pub fn new(task: Task) -> Self {
        TaskConfig { settings: TaskSettings { name: task, ..TaskSettings::default() }, rules: AllRules::default() }
    }

    /// Which task.
    pub fn task(&self) -> Task {
        self.settings.name
    }

    /// Its rules.
    pub fn rules(&self) -> &(dyn Rules + Send + Sync) {
        match self.settings.name {
            Task::GoalReaching => &self.rules.goal_reaching,
            Task::BlockPushing => &self.rules.block_pushing,
            Task::ShapeFormation => &self.rules.shape_formation,
            Task::TubeCrossing => &self.rules.tube_crossing,
            Task::WallClimbing => &self.rules.wall_climbing,
        }
    }

    /// Checks the settings for a robot; the error is a sentence.
    pub fn validate(&self, robot: &Robot) -> Result<(), String> {
        self.settings.validate()?;
        self.rules().validate(robot)
    }

    /// The settings of the task in use that an episode depends on, by name: its scenes, what counts as success, and the cap. What only the reward
    /// of a training depends on is not among them.
    pub fn judged(&self) -> serde_json::Map<String, serde_json::Value> {
        let rules = &self.rules;
        let text = match self.settings.name {
            Task::GoalReaching => serde_json::to_string(&rules.goal_reaching),
            Task::BlockPushing => serde_json::to_string(&rules.block_pushing),
            Task::ShapeFormation => serde_json::to_string(&rules.shape_formation),
            Task::TubeCrossing => serde_json::to_string(&rules.tube_crossing),
            Task::WallClimbing => serde_json::to_string(&rules.wall_climbing),
        };
        // By way of the text, in which a 32-bit number has no more digits than it needs.
        let mut settings: serde_json::Map<_, _> =
            text.and_then(|text| serde_json::from_str(&text)).expect("rules are plain data");
        settings.insert("cap".into(), self.settings.cap.into());
        settings
    }

    /// CRC-32 of the task's name and [`TaskConfig::judged`], one `name value` a line in the order of the names; what a policy image says it was
    /// trained for. Never 0, which means that it is not known.
    pub fn digest(&self) -> u32 {
        let mut lines: Vec<String> = self.judged().iter().map(|(name, value)| format!("{name} {value}\n")).collect();
        lines.sort();
        let text = format!("{}\n{}", self.settings.name, lines.concat());
        CRC_32.checksum(text.as_bytes()).max(1)
    }

    /// How the settings that an episode depends on differ from those of `other`, such as `success_distance = 1 instead of 1.5`; empty if they do not.
    pub fn differences(&self, other: &TaskConfig) -> Vec<String> {
        let (ours, theirs) = (self.judged(), other.judged());
        let differ = ours.iter().filter(|(name, value)| theirs.get(*name) != Some(value));
        let none = serde_json::Value::Null;
        differ
            .map(|(name, value)| format!("{name} = {value} instead of {}", theirs.get(name).unwrap_or(&none)))
            .collect()
    }
}

/// Watches an episode.
#[derive(Clone, Debug)]
pub struct Judge {
    course: Course,
    gate: Gate,
    verdict: Verdict,
    steps: u32,
    low_steps: u32,
}

impl Judge {
    /// The start of the episode with this seed: the snake in its scene, and the judge.
    pub fn start(task: &TaskConfig, seed: u64, robot: &Robot) -> (Snake, Judge) {
        let course = task.rules().course(seed, robot);
        let snake = Snake::in_scene(robot, &course.scene);
        let mut gate = Gate::default();
        let verdict = task.rules().verdict(&course, &snake, &mut gate);
        (snake, Judge { course, gate, verdict, steps: 0, low_steps: 0 })
    }

    /// After a physics step: what must not be missed between two control steps.
    pub fn watch(&mut self, task: &TaskConfig, snake: &Snake) {
        if task.settings.name == Task::TubeCrossing {
            task.rules().verdict(&self.course, snake, &mut self.gate);
        }
    }

    /// After a control step: the reward for it.
    pub fn step(&mut self, task: &TaskConfig, snake: &Snake) -> f32 {
        let before = self.verdict;
        self.verdict = task.rules().verdict(&self.course, snake, &mut self.gate);
        self.steps += 1;
        let (height, radius) = (snake.height(), snake.robot().link_radius);
        self.low_steps += u32::from(height < 4.0 * radius);
        let earned = match task.settings.reward {
            Reward::Paper => 0.1 * self.verdict.paper,
            Reward::Progress => before.left - self.verdict.left + if self.verdict.success { 2.0 } else { 0.0 },
        };
        earned - task.settings.rearing_penalty * (height - 3.0 * radius).max(0.0)
    }

    /// The course.
    pub fn course(&self) -> &Course {
        &self.course
    }

    /// The verdict of the last control step.
    pub fn verdict(&self) -> Verdict {
        self.verdict
    }

    /// Control steps so far.
    pub fn steps(&self) -> u32 {
        self.steps
    }

    /// Those of them whose highest link centre stayed below two link diameters.
    pub fn low_steps(&self) -> u32 {
        self.low_steps
    }

    /// Moves the goal of a task that has a place to go to, on the ground; false for a task whose goal is part of its scene.
    pub fn move_goal(&mut self, task: &TaskConfig, [x, y]: [f32; 2]) -> bool {
        let movable = matches!(task.task(), Task::GoalReaching | Task::BlockPushing);
        if movable {
            self.course.goal = [x, y, self.course.goal[2]];
        }
        movable
    }

    /// Point `number` of the scene in the frame of the head link, as the station tells it.
    pub fn point_from_head(&self, task: &TaskConfig, snake: &Snake, number: u8) -> Option<Point> {
        task.rules().point(&self.course, snake, number).map(|point| snake.in_head_frame(point))
    }
}

/// Distance of two points.
pub fn distance(a: Point, b: Point) -> f32 {
    let square: f32 = a.iter().zip(&b).map(|(a, b)| (a - b) * (a - b)).sum();
    libm::sqrtf(square)
}

/// An even draw from a range given as least and most.
fn between(rng: &mut impl Rng, [least, most]: [f32; 2]) -> f32 {
    least + (most - least) * rng.random::<f32>()
}

/// An even draw from -`most` to `most` degrees, in rad.
fn either_side(rng: &mut impl Rng, most_degrees: f32) -> f32 {
    most_degrees.to_radians() * (2.0 * rng.random::<f32>() - 1.0)
}

/// A range of a setting must rise within limits.
fn check_range(key: &str, [least, most]: [f32; 2], [low, high]: [f32; 2]) -> Result<(), String> {
    if least >= low && most >= least && most <= high {
        return Ok(());
    }
    Err(format!("{key} = [{least}, {most}]; it must be two numbers from {low} to {high}, the smaller first"))
}

/// A number of a setting must lie within limits.
fn check_number(key: &str, value: f32, [low, high]: [f32; 2]) -> Result<(), String> {
    if value >= low && value <= high {
        return Ok(());
    }
    Err(format!("{key} = {value}; it must be from {low} to {high}"))
}

/// Wasserstein distance of two shapes of as many points (Villani 2009; paper, section III-B): the least mean distance over all ways to
/// assign the points of one to those of the other, exact.
pub fn wasserstein(positions: &[Point], targets: &[Point]) -> f32 {
    // The assignment is solved on whole numbers, which have an order.
    const STEPS: f32 = 65_536.0;
    let costs = positions.iter().map(|p| targets.iter().map(|t| (STEPS * distance(*p, *t)) as i64).collect::<Vec<_>>());
    let Ok(costs) = Matrix::from_rows(costs) else { return 0.0 };
    if costs.rows == 0 || costs.rows > costs.columns {
        return 0.0;
    }
    let (_, assignment) = kuhn_munkres_min(&costs);
    let sum: f32 = assignment.iter().zip(positions).map(|(t, p)| distance(*p, targets[*t])).sum();
    sum / positions.len() as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_wasserstein_distance_is_that_of_the_best_of_all_assignments() {
        let mut bits = 1u32;
        let mut number = move || {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (bits >> 8) as f32 / 1e6
        };
        for _ in 0..50 {
            let mut shape = || -> Vec<Point> { (0..5).map(|_| [number(), number(), number()]).collect() };
            let (p, t) = (shape(), shape());
            let mut best = f32::INFINITY;
            let mut order = [0usize, 1, 2, 3, 4];
            permute(&mut order, 0, &mut |order| {
                best = best.min(order.iter().zip(&p).map(|(t_, p)| distance(*p, t[*t_])).sum::<f32>() / 5.0);
            });
            assert!((wasserstein(&p, &t) - best).abs() < 1e-3, "{} {best}", wasserstein(&p, &t));
        }
        let shape = [[0.0; 3], [1.0, 2.0, 3.0]];
        assert_eq!(wasserstein(&shape, &[shape[1], shape[0]]), 0.0);
    }

    #[test]
    fn the_cap_grows_with_the_snake_beyond_eight_modules() {
        let settings = TaskSettings::default();
        let caps = [1, 3, 7, 8, 9, 10, 11, 16, 64].map(|modules| settings.cap_for(modules));
        assert_eq!(caps, [125, 125, 125, 125, 141, 157, 172, 250, 1000]);
        assert_eq!(TaskSettings { cap: u32::MAX, ..settings }.cap_for(64), u32::MAX);
    }

    #[test]
    fn the_digest_is_of_what_an_episode_depends_on() {
        let digests: Vec<u32> = Task::ALL.map(|task| TaskConfig::new(task).digest()).into();
        assert!(digests.iter().enumerate().all(|(i, d)| *d != 0 && !digests[..i].contains(d)));
        let default = TaskConfig::new(Task::BlockPushing);
        let mut other = default.clone();
        other.settings.rearing_penalty = 0.4;
        other.settings.reward = Reward::Paper;
        other.rules.wall_climbing.wall_bearing = 1.0;
        assert_eq!((other.digest(), other.differences(&default).len()), (default.digest(), 0));
        other.rules.block_pushing.success_distance = 1.25;
        assert_ne!(other.digest(), default.digest());
        assert_eq!(other.differences(&default), ["success_distance = 1.25 instead of 1.0"]);
        other.settings.cap = 126;
        assert_eq!(other.differences(&default).len(), 2);
    }

    fn permute(order: &mut [usize; 5], from: usize, each: &mut impl FnMut(&[usize; 5])) {
        if from == order.len() {
            each(order);
        }
        for k in from..order.len() {
            order.swap(from, k);
            permute(order, from + 1, each);
            order.swap(from, k);
        }
    }
}
