//! What an image says about itself besides its numbers: the task, and the robot that it was trained on.

use core::fmt;

use super::PolicyError;
use crate::observation::{POINTS, Seeker};
use crate::robot::{Geometry, Limits, MAX_JOINTS};

/// What the policy was trained to do.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum Task {
    /// Bring the head to a goal.
    GoalReaching = 0,
    /// Push a block to a goal.
    BlockPushing = 1,
    /// Take a given shape.
    ShapeFormation = 2,
    /// Go through a tube.
    TubeCrossing = 3,
    /// Get over a wall.
    WallClimbing = 4,
}

impl Task {
    /// All tasks, in the order of their numbers.
    pub const ALL: [Task; 5] =
        [Task::GoalReaching, Task::BlockPushing, Task::ShapeFormation, Task::TubeCrossing, Task::WallClimbing];

    /// The name on the command line and in file names.
    pub const fn name(self) -> &'static str {
        match self {
            Task::GoalReaching => "goal-reaching",
            Task::BlockPushing => "block-pushing",
            Task::ShapeFormation => "shape-formation",
            Task::TubeCrossing => "tube-crossing",
            Task::WallClimbing => "wall-climbing",
        }
    }

    /// The paper's name of it.
    pub const fn title(self) -> &'static str {
        match self {
            Task::GoalReaching => "Goal Reaching",
            Task::BlockPushing => "Block Pushing",
            Task::ShapeFormation => "Shape Formation",
            Task::TubeCrossing => "Tube Crossing",
            Task::WallClimbing => "Wall Climbing",
        }
    }

    /// The task of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        Task::ALL.into_iter().find(|task| task.name() == name)
    }

    /// Points of the scene that the station tells a robot of `modules` modules in each cycle.
    pub const fn points(self, modules: u8) -> u8 {
        match self {
            Task::GoalReaching => 1,
            Task::BlockPushing => 2,
            Task::ShapeFormation => modules,
            Task::TubeCrossing | Task::WallClimbing => 3,
        }
    }

    /// Which points module `module` of `modules` observes as its first, second and third.
    ///
    /// | task | first, the goal | second | third |
    /// |---|---|---|---|
    /// | goal-reaching | 0, the goal | | |
    /// | block-pushing | 0, the goal of the block | 1, the block's centre | |
    /// | shape-formation | its own target | the target of the next module towards the head | towards the tail |
    /// | tube-crossing | 0, the goal behind the exit | 1, the entrance's centre | 2, the middle of the tube |
    /// | wall-climbing | 0, the goal behind the wall | 1, the foot of the wall's near face, nearest to the head | 2, the top above it |
    pub const fn observed(self, module: u8, modules: u8) -> [Option<u8>; POINTS] {
        match self {
            Task::GoalReaching => [Some(0), None, None],
            Task::BlockPushing => [Some(0), Some(1), None],
            Task::ShapeFormation => {
                [Some(module), module.checked_sub(1), if module + 1 < modules { Some(module + 1) } else { None }]
            }
            Task::TubeCrossing | Task::WallClimbing => [Some(0), Some(1), Some(2)],
        }
    }

    /// Who is to come to the goal.
    pub const fn seeker(self) -> Seeker {
        match self {
            Task::ShapeFormation => Seeker::Each,
            _ => Seeker::Head,
        }
    }

    pub(super) fn from_number(number: u8) -> Option<Self> {
        Task::ALL.into_iter().find(|task| *task as u8 == number)
    }
}

impl fmt::Display for Task {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// Which modules are told where the goal is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
#[repr(u8)]
pub enum GoalKnownTo {
    /// Every module (the paper's setting).
    All = 0,
    /// The head alone; attention has to carry it along.
    Head = 1,
}

impl GoalKnownTo {
    /// The name on the command line: `all` or `head`.
    pub const fn name(self) -> &'static str {
        match self {
            GoalKnownTo::All => "all",
            GoalKnownTo::Head => "head",
        }
    }

    /// The setting of that name.
    pub fn from_name(name: &str) -> Option<Self> {
        [GoalKnownTo::All, GoalKnownTo::Head].into_iter().find(|setting| setting.name() == name)
    }
}

impl fmt::Display for GoalKnownTo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}

/// What an image says about itself besides its numbers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Meta {
    /// What it was trained to do.
    pub task: Task,
    /// Who is told the goal.
    pub goal_known_to: GoalKnownTo,
    /// Whether the hidden layer sees the context (`composer`) or the embedding alone (`mappo`).
    pub attention: bool,
    /// Whether it was trained with modules that fail.
    pub trained_with_faults: bool,
    /// The chain it was trained on.
    pub geometry: Geometry,
    /// The limits it was trained with.
    pub limits: Limits,
    /// Time from one action to the next, in microseconds.
    pub control_period_us: u32,
    /// Time constant with which the joints of a module without torque straighten, in seconds
    /// ([`Chain::miss`](crate::kinematics::Chain::miss)).
    pub relax_seconds: f32,
    /// Digest of the settings of the task that it was trained for; 0: not known. A module only carries it: whoever evaluates the policy
    /// can tell whether it does so on the same task.
    pub task_digest: u32,
}

impl Meta {
    pub(super) fn check(&self) -> Result<(), PolicyError> {
        let Geometry { links_per_module, link_length } = self.geometry;
        let limits = &self.limits;
        let within = |value: f32, low: f32, high: f32| value >= low && value <= high;
        let checks = [
            ((2..=MAX_JOINTS).contains(&usize::from(links_per_module)), "links per module", "2 to 4"),
            (within(link_length, 1e-3, 1e3), "link length", "0.001 to 1000 robot units"),
            (within(limits.torque, 1e-6, 1e6), "torque limit", "0.000001 to 1000000"),
            (within(limits.torque_slew, 1e-6, 1e9), "torque slew limit", "0.000001 to 1000000000 per second"),
            (within(limits.joint_angle, 1e-3, 10.0), "joint angle limit", "0.001 to 10 rad"),
            (within(limits.joint_speed, 1e-3, 1e4), "joint speed limit", "0.001 to 10000 rad/s"),
            (within(limits.temperature, -100.0, 1000.0), "temperature limit", "-100 to 1000 degrees Celsius"),
            ((1_000..=10_000_000).contains(&self.control_period_us), "control period", "1000 to 10000000 us"),
            (within(self.relax_seconds, 1e-4, 1e3), "relaxation time", "0.0001 to 1000 s"),
        ];
        match checks.into_iter().find(|(good, ..)| !good) {
            Some((_, field, range)) => Err(PolicyError::Value { field, range }),
            None => Ok(()),
        }
    }
}
