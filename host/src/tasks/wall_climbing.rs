//! Wall Climbing: get over a wall that is higher than the snake, until the tail is over it (paper, Table I, last row).
//!
//! | | |
//! |---|---|
//! | start | straight, at rest, head at the origin, facing +x |
//! | wall | across the way, its near face `wall_distance` units ahead of the head, turned by up to `wall_bearing`, too long to go round |
//! | goal | behind the wall, so far that a straight snake with its head there has its tail over the wall |
//! | reward `paper` | how far the head has come along the normal of the wall |
//! | left to do (`progress`) | mean over the modules of the way left: to the foot of the wall, up, across, and down behind it; no module counts as farther than those ahead of it |
//! | success | the centre of the last link is behind the far face; ends the episode |
//! | points on the bus | 0: the goal, 1: the foot of the near face, nearest to the head, 2: the middle of the top above it |
//! | imagined distance | what is left to do from `p'` |
//! | why so hard | 1.0 to 1.6 units are 1.25 to 2 bodies high: none can be crept over flat, all can be reached by one module put upright (2 units). The tail has to be over it, not the head alone. The paper states no height |
//!
//! If each module's way counted for itself, a snake would lie down along the foot of the wall, which brings most modules most of
//! their way, and never leave it.

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{Course, Gate, Point, Rules, Verdict, Words, between, check_number, check_range, either_side};
use crate::robot::Robot;
use crate::sim::Snake;
use crate::sim::scene::{Scene, Solid};

/// Half the length of the wall, units: nobody gets round it within an episode.
const HALF_LENGTH: f32 = 40.0;

/// Settings of the task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WallClimbing {
    /// Lowest and highest wall, units.
    pub wall_height: [f32; 2],
    /// Thickness of the wall, units.
    pub wall_thickness: f32,
    /// Nearest and farthest near face, units from the head.
    pub wall_distance: [f32; 2],
    /// The wall's normal lies within this angle to either side of straight ahead, degrees.
    pub wall_bearing: f32,
}

impl Default for WallClimbing {
    fn default() -> Self {
        WallClimbing { wall_height: [1.0, 1.6], wall_thickness: 1.0, wall_distance: [2.0, 5.0], wall_bearing: 20.0 }
    }
}

/// The wall of a course.
struct Wall {
    /// Direction across the wall, away from the start.
    normal: [f32; 2],
    /// Along the normal, from the world's origin: near face.
    near: f32,
    thickness: f32,
    height: f32,
}

impl Wall {
    fn of(course: &Course) -> Self {
        let Some(solid) = course.scene.solids.first() else { unreachable!("the course of this task has a wall") };
        let (sin, cos) = libm::sincosf(solid.yaw);
        let middle = solid.position[0] * cos + solid.position[1] * sin;
        Wall {
            normal: [cos, sin],
            near: middle - solid.half[0],
            thickness: 2.0 * solid.half[0],
            height: 2.0 * solid.half[2],
        }
    }

    fn along(&self, p: Point) -> f32 {
        p[0] * self.normal[0] + p[1] * self.normal[1]
    }

    /// The way from `p` over the wall to `beyond` units behind the far face, for a body of this radius: level to the foot of the wall,
    /// up, and level again.
    fn left(&self, p: Point, radius: f32, beyond: f32) -> f32 {
        let ahead = self.near + self.thickness + beyond - self.along(p);
        let to_face = self.near - radius - self.along(p);
        // Far off the wall nothing needs to be lifted yet.
        let near = (1.0 - to_face / 2.0).clamp(0.0, 1.0);
        let climb = (self.height + radius - p[2]).max(0.0);
        if self.along(p) > self.near + self.thickness {
            ahead.max(0.0)
        } else {
            ahead.max(0.0) + climb * near + self.height * (1.0 - near)
        }
    }
}

impl Rules for WallClimbing {
    fn validate(&self, robot: &Robot) -> Result<(), String> {
        let diameter = 2.0 * robot.link_radius;
        check_range("wall_height", self.wall_height, [diameter, 10.0])
            .map_err(|e| format!("{e}: a wall is higher than the snake, {diameter} units"))?;
        check_number("wall_thickness", self.wall_thickness, [0.5, 20.0])?;
        let clear = 0.5 * robot.link_length + robot.link_radius;
        check_range("wall_distance", self.wall_distance, [clear, 50.0])
            .map_err(|e| format!("{e}: nearer, the wall would stand on the snake"))?;
        check_number("wall_bearing", self.wall_bearing, [0.0, 60.0])
    }

    fn goal_radius(&self) -> f32 {
        0.0
    }

    fn words(&self) -> Words {
        Words { measure: "tail to the far side of the wall", done: "over the wall", missed: "not over the wall" }
    }

    fn course(&self, seed: u64, robot: &Robot) -> Course {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let (height, away) = (between(&mut rng, self.wall_height), between(&mut rng, self.wall_distance));
        let yaw = either_side(&mut rng, self.wall_bearing);
        let (sin, cos) = libm::sincosf(yaw);
        let half = [0.5 * self.wall_thickness, HALF_LENGTH, 0.5 * height];
        let middle = away + half[0];
        let solid = Solid { half, position: [middle * cos, middle * sin, half[2]], yaw, roll: 0.0 };
        let beyond = away + self.wall_thickness + robot.links() as f32 * robot.link_length + 2.0;
        Course {
            scene: Scene { solids: vec![solid], block: None },
            goal: [beyond * cos, beyond * sin, robot.link_radius],
            marks: Vec::new(),
        }
    }

    fn point(&self, course: &Course, snake: &Snake, number: u8) -> Option<Point> {
        let wall = Wall::of(course);
        // The head moved across to the plane at this distance along the normal.
        let across = |to: f32, z: f32| {
            let head = snake.head();
            let by = to - wall.along(head);
            [head[0] + by * wall.normal[0], head[1] + by * wall.normal[1], z]
        };
        match number {
            0 => Some(course.goal),
            1 => Some(across(wall.near, 0.0)),
            2 => Some(across(wall.near + 0.5 * wall.thickness, wall.height)),
            _ => None,
        }
    }

    fn verdict(&self, course: &Course, snake: &Snake, _gate: &mut Gate) -> Verdict {
        let wall = Wall::of(course);
        let tail_left = wall.near + wall.thickness - wall.along(snake.tail());
        let positions: Vec<Point> = (0..snake.robot().modules).map(|m| snake.module_position(m)).collect();
        Verdict {
            paper: wall.along(snake.head()),
            left: self.imagined_distance(course, snake, &positions),
            distance: tail_left.max(0.0),
            success: tail_left < 0.0,
        }
    }

    fn imagined_distance(&self, course: &Course, snake: &Snake, positions: &[Point]) -> f32 {
        let (wall, robot) = (Wall::of(course), snake.robot());
        let module = robot.links_per_module as f32 * robot.link_length;
        let count = positions.len();
        let left = positions.iter().enumerate().scan(0.0f32, |most, (m, p)| {
            // To where the module is when the tail is just over the wall and the snake is straight.
            *most = most.max(wall.left(*p, robot.link_radius, (count - m) as f32 * module));
            Some(*most)
        });
        left.sum::<f32>() / count.max(1) as f32
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The course with a wall of this height at this distance, across.
    fn course(height: f32, near: f32) -> Course {
        let solid = Solid {
            half: [0.5, HALF_LENGTH, 0.5 * height],
            position: [near + 0.5, 0.0, 0.5 * height],
            yaw: 0.0,
            roll: 0.0,
        };
        Course { scene: Scene { solids: vec![solid], block: None }, ..Course::default() }
    }

    #[test]
    fn what_is_left_falls_all_the_way_over_the_wall() {
        let task = WallClimbing::default();
        for seed in 0..20 {
            let course = task.course(seed, &Robot::default());
            let (wall, radius) = (Wall::of(&course), 0.4);
            let (far, top) = (wall.near + wall.thickness, wall.height + radius);
            // To the foot, up the face, round the edge, across, round the other edge, down, and on.
            let arc = |corner: f32, from: f32, to: f32| -> Vec<[f32; 2]> {
                (0..=20)
                    .map(|k| libm::sincosf(from + (to - from) * k as f32 / 20.0))
                    .map(|(sin, cos)| [corner + radius * cos, wall.height + radius * sin])
                    .collect()
            };
            let (quarter, half) = (std::f32::consts::FRAC_PI_2, std::f32::consts::PI);
            let line = |a: [f32; 2], b: [f32; 2]| -> Vec<[f32; 2]> {
                (0..=40)
                    .map(|k| k as f32 / 40.0)
                    .map(|s| [a[0] + s * (b[0] - a[0]), a[1] + s * (b[1] - a[1])])
                    .collect()
            };
            let way = [
                line([wall.near - 6.0, radius], [wall.near - radius, radius]),
                line([wall.near - radius, radius], [wall.near - radius, wall.height]),
                arc(wall.near, half, quarter),
                line([wall.near, top], [far, top]),
                arc(far, quarter, 0.0),
                line([far + radius, wall.height], [far + radius, radius]),
                line([far + radius, radius], [far + 2.0, radius]),
            ]
            .concat();
            let left: Vec<f32> = way
                .iter()
                .map(|[along, z]| [along * wall.normal[0], along * wall.normal[1], *z])
                .map(|p| wall.left(p, radius, 2.0))
                .collect();
            for (k, pair) in left.windows(2).enumerate() {
                assert!(pair[1] <= pair[0] + 1e-4, "seed {seed}: rises at {:?}: {pair:?}", way[k + 1]);
            }
            assert!(left[0] > wall.height + 6.0 && left[left.len() - 1].abs() < 1e-3, "{left:?}");
        }
    }

    #[test]
    fn success_is_the_tail_behind_the_wall() {
        let robot = Robot::default();
        // The snake lies from 0 to -15.5.
        let snake = Snake::new(&robot);
        let verdict = |near: f32| WallClimbing::default().verdict(&course(1.2, near), &snake, &mut Gate::default());
        assert!(!verdict(2.0).success && !verdict(-1.0).success && !verdict(-8.0).success && !verdict(-16.0).success);
        assert!(verdict(-16.6).success);
        assert!((verdict(-8.0).distance - 8.5).abs() < 1e-3 && verdict(-16.6).distance == 0.0);
        assert!(verdict(2.0).left > verdict(-1.0).left && verdict(-1.0).left > verdict(-8.0).left);
        assert!(verdict(-17.6).left < 1.0, "{:?}", verdict(-17.6));
    }

    #[test]
    fn the_wall_stands_where_it_should_and_is_too_long_to_go_round() {
        let (task, robot) = (WallClimbing::default(), Robot::default());
        for seed in 0..200 {
            let course = task.course(seed, &robot);
            let wall = Wall::of(&course);
            assert!(
                (1.0..=1.6).contains(&wall.height) && (1.999..=5.001).contains(&wall.near),
                "{} {}",
                wall.height,
                wall.near
            );
            assert!(wall.along(course.goal) > wall.near + wall.thickness + 16.0);
            let snake = Snake::in_scene(&robot, &course.scene);
            assert_eq!(task.point(&course, &snake, 0), Some(course.goal));
            let foot = task.point(&course, &snake, 1).unwrap();
            assert!((wall.along(foot) - wall.near).abs() < 1e-4 && foot[2] == 0.0);
            assert_eq!(task.point(&course, &snake, 2).unwrap()[2], wall.height);
            assert!(wall.along([0.25, 0.0, 0.4]) + robot.link_radius <= wall.near);
        }
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let default = WallClimbing::default;
        for (bad, words) in [
            (WallClimbing { wall_height: [0.5, 1.0], ..default() }, "a wall is higher than the snake, 0.8 units"),
            (WallClimbing { wall_height: [2.0, 1.0], ..default() }, "the smaller first"),
            (WallClimbing { wall_thickness: -1.0, ..default() }, "wall_thickness = -1; it must be from 0.5 to 20"),
            (WallClimbing { wall_thickness: f32::NAN, ..default() }, "wall_thickness = NaN"),
            (WallClimbing { wall_distance: [0.1, 2.0], ..default() }, "the wall would stand on the snake"),
            (WallClimbing { wall_bearing: 90.0, ..default() }, "wall_bearing = 90"),
        ] {
            let message = bad.validate(&Robot::default()).unwrap_err();
            assert!(message.contains(words), "{message}");
        }
        assert_eq!(default().validate(&Robot::default()), Ok(()));
    }
}
