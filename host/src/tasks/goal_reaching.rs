//! Goal Reaching (paper, Table I): bring the head to a point on the ground.
//!
//! | what | value |
//! |---|---|
//! | scene | level ground; the snake lies straight, its head at the origin, facing +x |
//! | goal | a point at rest height, `goal_distance` units from the head in any direction |
//! | reward `paper` | `-0.1 d(head, goal)` a step (the paper's `-d`; the learner's value normalisation makes the factor immaterial) |
//! | reward `progress` | decrease of `d(head, goal)` in units, and 2 on success: the same optimum by potential shaping, denser |
//! | `rearing_penalty` | taken off for rearing up; 0 unless set |
//! | success | `d(head, goal) < 2` units (the paper's `d_g`); ends the episode |
//! | cap | 125 control steps of 0.05 s; the value of the last state is bootstrapped |
//!
//! Observation: [`composer_shared::observation`]. `d` is measured from the centre of the head link.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

/// Which reward the learner gets.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Reward {
    /// The paper's: minus the distance.
    #[default]
    Paper,
    /// The decrease of the distance.
    Progress,
}

/// Settings of the task; the defaults are the paper's difficulty, see the module documentation.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct GoalReaching {
    /// Nearest and farthest goal, units from the head.
    pub goal_distance: [f32; 2],
    /// Goals lie within this angle to either side of straight ahead, degrees; 180 is every direction.
    pub goal_bearing: f32,
    /// Distance that counts as reached, units.
    pub success_distance: f32,
    /// Control steps before the episode is cut.
    pub cap: u32,
    /// Reward of the training.
    pub reward: Reward,
    /// Taken off the reward of a step for each unit that the highest link is above one and a half link diameters. The paper has
    /// no such term; without it the fastest policies rear up and throw themselves at the goal.
    pub rearing_penalty: f32,
}

impl Default for GoalReaching {
    fn default() -> Self {
        GoalReaching {
            goal_distance: [10.0, 25.0],
            goal_bearing: 180.0,
            success_distance: 2.0,
            cap: 125,
            reward: Reward::Paper,
            rearing_penalty: 0.0,
        }
    }
}

impl GoalReaching {
    /// Checks the settings; the error is a sentence.
    pub fn validate(&self) -> Result<(), String> {
        let [near, far] = self.goal_distance;
        if !(near > self.success_distance && far >= near && far < 100.0) {
            return Err(format!(
                "goal_distance = [{near}, {far}] with success_distance = {}: goals must lie beyond the success distance and within 100 units",
                self.success_distance
            ));
        }
        if !(self.goal_bearing >= 0.0 && self.goal_bearing <= 180.0) {
            return Err(format!("goal_bearing = {}; it is an angle of 0 to 180 degrees", self.goal_bearing));
        }
        if self.success_distance.is_nan() || self.success_distance <= 0.0 {
            return Err(format!("success_distance = {}; it must be above zero", self.success_distance));
        }
        if !(self.rearing_penalty >= 0.0 && self.rearing_penalty.is_finite()) {
            return Err(format!("rearing_penalty = {}; it must be zero or more", self.rearing_penalty));
        }
        if self.cap == 0 {
            return Err("cap = 0; an episode needs at least one step".into());
        }
        Ok(())
    }

    /// The goal of an episode, relative to a head at the origin facing +x, at the given height.
    pub fn goal(&self, seed: u64, height: f32) -> [f32; 3] {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let [near, far] = self.goal_distance;
        let distance = near + (far - near) * rng.random::<f32>();
        let bearing = self.goal_bearing.to_radians() * (2.0 * rng.random::<f32>() - 1.0);
        let (sin, cos) = libm::sincosf(bearing);
        [distance * cos, distance * sin, height]
    }

    /// The reward for coming from distance `before` to `after`, with the highest link `too_high` units above one and a half
    /// link diameters.
    pub fn reward(&self, before: f32, after: f32, success: bool, too_high: f32) -> f32 {
        let task = match self.reward {
            Reward::Paper => -0.1 * after,
            Reward::Progress => before - after + if success { 2.0 } else { 0.0 },
        };
        task - self.rearing_penalty * too_high.max(0.0)
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
    pub fn of(goal: [f32; 3]) -> Self {
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
        let task = GoalReaching::default();
        let mut seen = [0; 3];
        for seed in 0..600 {
            let goal = task.goal(seed, 0.4);
            assert_eq!(goal, task.goal(seed, 0.4));
            let distance = goal[0].hypot(goal[1]);
            assert!((10.0..=25.0).contains(&distance));
            seen[Bearing::ALL.iter().position(|b| *b == Bearing::of(goal)).unwrap()] += 1;
        }
        assert!(seen.iter().all(|n| (140..260).contains(n)), "{seen:?}");
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let bad = GoalReaching { goal_distance: [1.0, 5.0], ..GoalReaching::default() };
        assert!(bad.validate().unwrap_err().contains("beyond the success distance"));
        assert!(GoalReaching { cap: 0, ..GoalReaching::default() }.validate().is_err());
    }
}
