//! Block Pushing: push a free block to a goal with any part of the body (paper, Table I, second row).
//!
//! | | |
//! |---|---|
//! | start | straight, at rest, head at the origin, facing +x |
//! | block | a box `block_distance` units from the head, within `block_bearing` of straight ahead, turned at random |
//! | goal | `goal_distance` units beyond the block, within `goal_bearing` of the line from the head through the block |
//! | reward `paper` | `-d(head, block) - d(block, goal)` |
//! | left to do (`progress`) | `d(head, P) + 2 d(block, goal)`, where P is the place behind the block from which it is pushed |
//! | success | `d(block, goal) < 1` unit; ends the episode |
//! | points on the bus | 0: the goal, 1: the block's centre |
//! | imagined distance | mean over the modules of `d(p'_i, P)` |
//! | why so hard | 1 unit, half an edge of the block, is what SomoGym's PlanarBlockPushing asks for; the paper states none. The block is as long as a module; the goal lies at least three times the success distance away |
//!
//! Distances are measured on the ground plane between centres. The block has friction on the ground and on the body.

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{Course, Gate, Point, Rules, Verdict, Words, between, check_number, check_range, distance, either_side};
use crate::robot::Robot;
use crate::sim::Snake;
use crate::sim::scene::{Block, Scene};

/// Settings of the task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct BlockPushing {
    /// Edges of the block: length, width, height, units.
    pub block_size: [f32; 3],
    /// Mass of the block, kg.
    pub block_mass: f32,
    /// Its coefficient of friction with ground and body.
    pub block_friction: f32,
    /// Nearest and farthest block, units from the head.
    pub block_distance: [f32; 2],
    /// Blocks lie within this angle to either side of straight ahead, degrees.
    pub block_bearing: f32,
    /// Nearest and farthest goal, units from the block.
    pub goal_distance: [f32; 2],
    /// Goals lie within this angle to either side of the line from the head through the block, degrees.
    pub goal_bearing: f32,
    /// Distance of the block to the goal that counts as there, units.
    pub success_distance: f32,
}

impl Default for BlockPushing {
    fn default() -> Self {
        BlockPushing {
            block_size: [2.0, 2.0, 1.0],
            block_mass: 0.01,
            block_friction: 0.5,
            block_distance: [3.0, 5.0],
            block_bearing: 20.0,
            goal_distance: [3.0, 6.0],
            goal_bearing: 20.0,
            success_distance: 1.0,
        }
    }
}

impl BlockPushing {
    fn block(snake: &Snake) -> Point {
        snake.block().map_or([0.0; 3], |(position, _)| position)
    }

    /// The place on the far side of the block from the goal, a link's radius off its circumference.
    fn push_from(&self, block: Point, goal: Point, radius: f32) -> Point {
        let apart = [block[0] - goal[0], block[1] - goal[1]];
        let length = libm::hypotf(apart[0], apart[1]).max(1e-3);
        let reach = (0.5 * self.block_size[0].max(self.block_size[1]) + radius) / length;
        [block[0] + reach * apart[0], block[1] + reach * apart[1], radius]
    }
}

fn flat(a: Point, b: Point) -> f32 {
    libm::hypotf(a[0] - b[0], a[1] - b[1])
}

impl Rules for BlockPushing {
    fn validate(&self, robot: &Robot) -> Result<(), String> {
        for edge in self.block_size {
            check_number("an edge of block_size", edge, [0.1, 10.0])?;
        }
        check_number("block_mass", self.block_mass, [1e-4, 10.0])?;
        check_number("block_friction", self.block_friction, [0.0, 5.0])?;
        let half_diagonal = 0.5 * self.block_size[0].hypot(self.block_size[1]);
        let clear = half_diagonal + 0.5 * robot.link_length + robot.link_radius;
        check_range("block_distance", self.block_distance, [clear, 100.0])
            .map_err(|e| format!("{e}: nearer, the block would stand on the snake"))?;
        check_number("block_bearing", self.block_bearing, [0.0, 90.0])?;
        check_number("success_distance", self.success_distance, [0.01, 100.0])?;
        check_range("goal_distance", self.goal_distance, [1.001 * self.success_distance, 100.0])
            .map_err(|e| format!("{e}: nearer, the block would be at its goal from the start"))?;
        check_number("goal_bearing", self.goal_bearing, [0.0, 180.0])
    }

    fn goal_radius(&self) -> f32 {
        self.success_distance
    }

    fn words(&self) -> Words {
        Words { measure: "block to goal", done: "block at the goal", missed: "block not at the goal" }
    }

    fn course(&self, seed: u64, _robot: &Robot) -> Course {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (away, bearing) = (between(&mut rng, self.block_distance), either_side(&mut rng, self.block_bearing));
        let (further, turn) = (between(&mut rng, self.goal_distance), either_side(&mut rng, self.goal_bearing));
        let (sin, cos) = libm::sincosf(bearing);
        let half = self.block_size.map(|edge| 0.5 * edge);
        let position = [away * cos, away * sin, half[2]];
        let (sin, cos) = libm::sincosf(bearing + turn);
        let goal = [position[0] + further * cos, position[1] + further * sin, half[2]];
        let yaw = std::f32::consts::PI * rng.random::<f32>();
        let block = Block { half, position, yaw, mass: self.block_mass, friction: self.block_friction };
        Course { scene: Scene { solids: Vec::new(), block: Some(block) }, goal, marks: Vec::new() }
    }

    fn point(&self, course: &Course, snake: &Snake, number: u8) -> Option<Point> {
        match number {
            0 => Some(course.goal),
            1 => Some(Self::block(snake)),
            _ => None,
        }
    }

    fn verdict(&self, course: &Course, snake: &Snake, _gate: &mut Gate) -> Verdict {
        let (head, block) = (snake.head(), Self::block(snake));
        let to_goal = flat(block, course.goal);
        let behind = self.push_from(block, course.goal, snake.robot().link_radius);
        Verdict {
            paper: -flat(head, block) - to_goal,
            left: flat(head, behind) + 2.0 * to_goal,
            distance: to_goal,
            success: to_goal < self.success_distance,
        }
    }

    fn imagined_distance(&self, course: &Course, snake: &Snake, positions: &[Point]) -> f32 {
        let behind = self.push_from(Self::block(snake), course.goal, snake.robot().link_radius);
        positions.iter().map(|p| distance(*p, behind)).sum::<f32>() / positions.len().max(1) as f32
    }

    fn imagined_distance_of_each(&self, course: &Course, snake: &Snake, positions: &[Point]) -> f32 {
        let robot = snake.robot();
        let block = Self::block(snake);
        let behind = self.push_from(block, course.goal, robot.link_radius);
        let way = flat(block, course.goal).max(1e-3);
        let axis = [(course.goal[0] - block[0]) / way, (course.goal[1] - block[1]) / way];
        // Once the head is there it goes as far as the block has to.
        let on = if flat(snake.head(), behind) < robot.link_length { way } else { 0.0 };
        let module = robot.links_per_module as f32 * robot.link_length;
        let of = |(number, p): (usize, &Point)| {
            let along = on - number as f32 * module;
            distance(*p, [behind[0] + along * axis[0], behind[1] + along * axis[1], behind[2]])
        };
        positions.iter().enumerate().map(of).sum::<f32>() / positions.len().max(1) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::super::soundness::Cuboid;
    use super::*;

    #[test]
    fn block_and_goal_lie_where_they_should_and_clear_of_the_snake() {
        let robot = Robot::default();
        let near = BlockPushing { block_distance: [2.07, 2.3], block_bearing: 90.0, ..BlockPushing::default() };
        for task in [BlockPushing::default(), near] {
            task.validate(&robot).unwrap();
            for seed in 0..300 {
                let course = task.course(seed, &robot);
                assert_eq!(course, task.course(seed, &robot));
                let block = course.scene.block.unwrap();
                let away = flat(block.position, [0.0; 3]);
                assert!(away >= task.block_distance[0] - 1e-3 && away <= task.block_distance[1] + 1e-3, "{away}");
                let further = flat(block.position, course.goal);
                let [least, most] = task.goal_distance;
                assert!((least - 1e-3..=most + 1e-3).contains(&further), "{further}");
                let snake = Snake::in_scene(&robot, &course.scene);
                let (position, rotation) = snake.block().unwrap();
                let cuboid = Cuboid::new(block.half, position, rotation);
                assert!(snake.poses().all(|(link, _)| cuboid.distance(link) >= robot.link_radius));
                let start = task.verdict(&course, &snake, &mut Gate::default());
                assert!(!start.success && (start.distance - further).abs() < 1e-4);
                assert_eq!(task.point(&course, &snake, 1), Some(block.position));
            }
        }
    }

    #[test]
    fn the_place_to_push_from_lies_behind_the_block() {
        let task = BlockPushing::default();
        let place = task.push_from([5.0, 0.0, 0.5], [9.0, 0.0, 0.5], 0.4);
        assert!((place[0] - (5.0 - 1.0 - 0.4)).abs() < 1e-5 && place[1] == 0.0, "{place:?}");
        // A block at its goal has no side from which to push; the place stays finite.
        assert!(task.push_from([5.0, 0.0, 0.5], [5.0, 0.0, 0.5], 0.4).iter().all(|v| v.is_finite()));
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let default = BlockPushing::default;
        for (bad, words) in [
            (BlockPushing { block_size: [0.0, 1.0, 1.0], ..default() }, "an edge of block_size = 0"),
            (BlockPushing { block_mass: 0.0, ..default() }, "block_mass = 0"),
            (BlockPushing { block_friction: -0.1, ..default() }, "block_friction = -0.1"),
            (BlockPushing { block_distance: [2.0, 4.0], ..default() }, "the block would stand on the snake"),
            (BlockPushing { goal_distance: [0.5, 4.0], ..default() }, "the block would be at its goal from the start"),
            (BlockPushing { goal_distance: [4.0, 400.0], ..default() }, "goal_distance = [4, 400]"),
            (BlockPushing { goal_bearing: 200.0, ..default() }, "goal_bearing = 200"),
            (BlockPushing { success_distance: f32::INFINITY, ..default() }, "success_distance = inf"),
        ] {
            let message = bad.validate(&Robot::default()).unwrap_err();
            assert!(message.contains(words), "{message}");
        }
        assert_eq!(default().validate(&Robot::default()), Ok(()));
    }
}
