//! Goal Reaching: bring the head to a goal on the ground (paper, Table I, first row).
//!
//! | | |
//! |---|---|
//! | start | straight, at rest, head at the origin, facing +x |
//! | goal | a point at rest height, `goal_distance` units from the head in any direction |
//! | reward `paper` | `-d(head, goal)` |
//! | left to do (`progress`) | `d(head, goal)` |
//! | success | `d(head, goal) < 2` units (the paper's `d_g`); ends the episode |
//! | points on the bus | 0: the goal |
//! | imagined distance | mean over the modules of `d(p'_i, goal)` |
//! | why so hard | 2 units are one module, an eighth of the snake. The paper does not state its distances; 10 to 25 units are inferred from the final distances and steps of its tables |
//!
//! Observation: [`composer_shared::observation`]. `d` is measured from the centre of the head link.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{Course, Gate, Point, Rules, Verdict, Words, between, distance, either_side};
use crate::robot::Robot;
use crate::sim::Snake;

/// Settings of the task; the defaults are the paper's difficulty, see `success` in the module documentation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoalReaching {
    /// Nearest and farthest goal, units from the head.
    pub goal_distance: [f32; 2],
    /// Goals lie within this angle to either side of straight ahead, degrees; 180 is every direction.
    pub goal_bearing: f32,
    /// Distance that counts as reached, units.
    pub success_distance: f32,
}

impl Default for GoalReaching {
    fn default() -> Self {
        GoalReaching { goal_distance: [10.0, 25.0], goal_bearing: 180.0, success_distance: 2.0 }
    }
}

impl Rules for GoalReaching {
    fn validate(&self, _robot: &Robot) -> Result<(), String> {
        let [near, far] = self.goal_distance;
        if !(near > self.success_distance && far >= near && far < 100.0) {
            return Err(format!(
                "goal_distance = [{near}, {far}] with success_distance = {}: goals must lie beyond the success distance and within 100 units",
                self.success_distance
            ));
        }
        super::check_number("goal_bearing", self.goal_bearing, [0.0, 180.0])?;
        super::check_number("success_distance", self.success_distance, [0.01, 100.0])
    }

    fn goal_radius(&self) -> f32 {
        self.success_distance
    }

    fn words(&self) -> Words {
        Words { measure: "head to goal", done: "goal reached", missed: "goal not reached" }
    }

    fn course(&self, seed: u64, robot: &Robot) -> Course {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let distance = between(&mut rng, self.goal_distance);
        let (sin, cos) = libm::sincosf(either_side(&mut rng, self.goal_bearing));
        Course { goal: [distance * cos, distance * sin, robot.link_radius], ..Course::default() }
    }

    fn point(&self, course: &Course, _snake: &Snake, number: u8) -> Option<Point> {
        (number == 0).then_some(course.goal)
    }

    fn verdict(&self, course: &Course, snake: &Snake, _gate: &mut Gate) -> Verdict {
        let distance = snake.head_distance(course.goal);
        Verdict { paper: -distance, left: distance, distance, success: distance < self.success_distance }
    }

    fn imagined_distance(&self, course: &Course, _snake: &Snake, positions: &[Point]) -> f32 {
        positions.iter().map(|p| distance(*p, course.goal)).sum::<f32>() / positions.len().max(1) as f32
    }
}

/// Where a goal lies, seen from the head at the start.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Bearing {
    /// Within 60 degrees of straight ahead.
    Ahead,
    /// 60 to 120 degrees to either side.
    Aside,
    /// More than 120 degrees off.
    Behind,
}

impl Bearing {
    /// All three, in the order of reports.
    pub const ALL: [Bearing; 3] = [Bearing::Ahead, Bearing::Aside, Bearing::Behind];

    /// The bearing of a goal given relative to the head.
    pub fn of(goal: Point) -> Self {
        match libm::atan2f(goal[1], goal[0]).abs().to_degrees() {
            a if a < 60.0 => Bearing::Ahead,
            a if a <= 120.0 => Bearing::Aside,
            _ => Bearing::Behind,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn goals_lie_in_every_direction_at_the_distance_asked_for() {
        let (task, robot) = (GoalReaching::default(), Robot::default());
        let mut seen = [0; 3];
        for seed in 0..600 {
            let goal = task.course(seed, &robot).goal;
            assert_eq!(goal, task.course(seed, &robot).goal);
            let distance = goal[0].hypot(goal[1]);
            assert!((10.0..=25.0).contains(&distance));
            seen[Bearing::ALL.iter().position(|b| *b == Bearing::of(goal)).unwrap()] += 1;
        }
        assert!(seen.iter().all(|n| (140..260).contains(n)), "{seen:?}");
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let bad = GoalReaching { goal_distance: [1.0, 5.0], ..GoalReaching::default() };
        assert!(bad.validate(&Robot::default()).unwrap_err().contains("beyond the success distance"));
        let bad = GoalReaching { goal_bearing: f32::NAN, ..GoalReaching::default() };
        assert!(bad.validate(&Robot::default()).unwrap_err().contains("goal_bearing"));
    }
}
