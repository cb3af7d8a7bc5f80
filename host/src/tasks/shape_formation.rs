//! Shape Formation: every module to a target of its own, together a shape (paper, Table I, third row).
//!
//! | | |
//! |---|---|
//! | start | straight, at rest, head at the origin, facing +x |
//! | targets | one a module, a module's length apart along a curve: line, arc, C, S, U, ring or spiral, each as often, bent to either side; its middle up to `place` units from the snake's, turned by up to `heading` |
//! | | targets lie at least 1.6 times the success distance from the modules, in the mean: the snake must move. Bend, place and heading are drawn anew until they do, the kind is not; of a line that leaves places and headings near their limits. Of eight modules or more, every kind finds such targets (a line of eight in one draw of 57); of fewer, some never do, lines first, and the farthest of 1,000 draws counts |
//! | reward `paper` | `-sum_i d(module_i, target_i)` |
//! | left to do (`progress`) | `sum_i d(module_i, target_i)` |
//! | success | mean over the modules of `d(module_i, target_i)` < 1.25 units: the paper's sum is below `n d_g`; ends the episode |
//! | points on the bus | i: the target of module i |
//! | why so hard | 1.25 units are five eighths of a module's length: in the mean a module has to be nearer to its own target than to its neighbour's. At the start it is at least 2 units, one module, off. The paper states no distance |
//! | imagined distance | Wasserstein distance between `p'` and the targets: the least mean distance over all assignments |
//!
//! A module is where its own link is ([`composer_shared::robot::Geometry::OWN_LINK`]).

use std::f32::consts::PI;

use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{Course, Gate, Point, Rules, Verdict, Words, check_number, distance, either_side};
use crate::robot::Robot;
use crate::sim::{Scene, Snake};

/// Targets lie at least this many times the success distance from the modules at the start, in the mean.
const START_APART: f32 = 1.6;

/// Draws of one kind of shape before the farthest of them is taken.
const DRAWS: usize = 1000;

/// Settings of the task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct ShapeFormation {
    /// The shapes that are drawn from, evenly.
    pub shapes: Vec<Shape>,
    /// Farthest that the middle of the shape lies from the middle of the snake at the start, units.
    pub place: f32,
    /// The shape's direction from tail to head lies within this angle to either side of the snake's at the start, degrees.
    pub heading: f32,
    /// Mean distance of the modules to their targets that counts as formed, units; a module is 2 units long.
    pub success_distance: f32,
}

impl Default for ShapeFormation {
    fn default() -> Self {
        ShapeFormation { shapes: Shape::ALL.to_vec(), place: 1.25, heading: 25.0, success_distance: 1.25 }
    }
}

/// Kinds of shapes, by what their curvature does from head to tail.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Shape {
    /// None.
    Line,
    /// The same all along, up to a bit over a right angle.
    Arc,
    /// The same all along, about half a circle.
    C,
    /// To one side, then to the other.
    S,
    /// Straight legs and half a circle between them.
    U,
    /// Nearly a full circle.
    Ring,
    /// Tighter and tighter, about a full circle.
    Spiral,
}

impl Shape {
    /// All of them.
    pub const ALL: [Shape; 7] = [Shape::Line, Shape::Arc, Shape::C, Shape::S, Shape::U, Shape::Ring, Shape::Spiral];

    /// Least and most angle that the curve turns through, degrees.
    fn bend(self) -> [f32; 2] {
        match self {
            Shape::Line => [0.0, 0.0],
            Shape::Arc => [45.0, 110.0],
            Shape::C => [150.0, 240.0],
            Shape::S => [80.0, 150.0],
            Shape::U => [160.0, 190.0],
            Shape::Ring => [300.0, 320.0],
            Shape::Spiral => [240.0, 320.0],
        }
    }

    /// The tightest curvature, as a multiple of the mean.
    fn tightest(self) -> f32 {
        match self {
            Shape::Line | Shape::Arc | Shape::C | Shape::Ring => 1.0,
            Shape::S => 2.0,
            Shape::U => 3.0,
            Shape::Spiral => 1.65,
        }
    }

    /// Share of the bend that is done at share `u` of the length, 0 to 1 both.
    fn turned(self, u: f32) -> f32 {
        match self {
            Shape::Line | Shape::Arc | Shape::C | Shape::Ring => u,
            // There and back again: the curvature changes its sign in the middle.
            Shape::S => 1.0 - (2.0 * u - 1.0).abs(),
            // Straight legs of a third each.
            Shape::U => (3.0 * u - 1.0).clamp(0.0, 1.0),
            // Tighter and tighter.
            Shape::Spiral => 0.35 * u + 0.65 * u * u,
        }
    }
}

/// `count` points on a curve, `spacing` apart along it, from the origin along x.
fn curve(kind: Shape, bend: f32, count: usize, spacing: f32) -> Vec<[f32; 2]> {
    const FINE: usize = 32;
    let length = (count - 1).max(1) as f32 * spacing;
    let step = spacing / FINE as f32;
    let mut at = [0.0f32; 2];
    let mut points = vec![at];
    for k in 0..(count - 1) * FINE {
        let middle = (k as f32 + 0.5) * step / length;
        let (sin, cos) = libm::sincosf(bend * kind.turned(middle));
        at = [at[0] + step * cos, at[1] + step * sin];
        if (k + 1) % FINE == 0 {
            points.push(at);
        }
    }
    points
}

/// Where the modules are at the start.
fn start_positions(robot: &Robot) -> Vec<Point> {
    let own = composer_shared::robot::Geometry::OWN_LINK.min(robot.links_per_module - 1);
    let link = |module: usize| (module * robot.links_per_module + own) as f32;
    (0..robot.modules).map(|module| [-link(module) * robot.link_length, 0.0, robot.link_radius]).collect()
}

fn mean_distance(positions: &[Point], targets: &[Point]) -> f32 {
    positions.iter().zip(targets).map(|(p, t)| distance(*p, *t)).sum::<f32>() / targets.len().max(1) as f32
}

impl ShapeFormation {
    fn targets(kind: Shape, seed_rng: &mut ChaCha8Rng, robot: &Robot, place: f32, heading: f32) -> Vec<Point> {
        let [least, most] = kind.bend();
        let side = if seed_rng.random() { 1.0 } else { -1.0 };
        let bend = (least + (most - least) * seed_rng.random::<f32>()).to_radians();
        // A short snake cannot bend so far: no module turns by more than its yaw joints can hold.
        let held = 0.9 * robot.torque_limit / robot.stiffness * robot.links_per_module.div_ceil(2) as f32;
        let bend = side * bend.min(held * (robot.modules - 1) as f32 / kind.tightest());
        let spacing = robot.links_per_module as f32 * robot.link_length;
        let points = curve(kind, bend, robot.modules, spacing);
        let n = points.len() as f32;
        let middle = [0, 1].map(|axis| points.iter().map(|p| p[axis]).sum::<f32>() / n);
        // From the first point, the head's, to the last: against the snake's direction.
        let (first, last) = (points[0], points[points.len() - 1]);
        let chord = libm::atan2f(last[1] - first[1], last[0] - first[0]);
        let turn = PI - chord + either_side(seed_rng, heading);
        let (sin, cos) = libm::sincosf(turn);
        let (away, bearing) = (place * libm::sqrtf(seed_rng.random::<f32>()), 2.0 * PI * seed_rng.random::<f32>());
        let (by, bx) = libm::sincosf(bearing);
        let start = start_positions(robot);
        let snake_middle = 0.5 * (start[0][0] + start[start.len() - 1][0]);
        points
            .iter()
            .map(|p| {
                let [x, y] = [p[0] - middle[0], p[1] - middle[1]];
                [snake_middle + away * bx + cos * x - sin * y, away * by + sin * x + cos * y, robot.link_radius]
            })
            .collect()
    }

    /// The kind of shape of an episode, and the targets.
    fn draw(&self, seed: u64, robot: &Robot) -> (Shape, Vec<Point>) {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let start = start_positions(robot);
        // The kind first, and for good: what is rejected must not thin out the kinds that lie near the straight snake.
        let kind = self.shapes[rng.random_range(0..self.shapes.len())];
        // A shape that the straight snake has nearly got already is no task.
        let (mut marks, mut farthest) = (Vec::new(), f32::NEG_INFINITY);
        for _ in 0..DRAWS {
            let targets = Self::targets(kind, &mut rng, robot, self.place, self.heading);
            let apart = mean_distance(&start, &targets);
            if apart > farthest {
                (marks, farthest) = (targets, apart);
            }
            if farthest >= START_APART * self.success_distance {
                break;
            }
        }
        (kind, marks)
    }
}

impl Rules for ShapeFormation {
    fn validate(&self, robot: &Robot) -> Result<(), String> {
        if robot.modules < 3 {
            return Err(format!("{} modules cannot form a shape; at least 3 are needed", robot.modules));
        }
        if self.shapes.is_empty() {
            return Err("shapes = []; at least one shape is needed, such as \"line\"".into());
        }
        check_number("place", self.place, [0.0, 50.0])?;
        check_number("heading", self.heading, [0.0, 180.0])?;
        check_number("success_distance", self.success_distance, [0.01, 100.0])
    }

    fn goal_radius(&self) -> f32 {
        0.0
    }

    fn threshold(&self) -> f32 {
        self.success_distance
    }

    fn words(&self) -> Words {
        Words { measure: "modules to their targets, mean", done: "shape formed", missed: "shape not formed" }
    }

    fn course(&self, seed: u64, robot: &Robot) -> Course {
        let (_, marks) = self.draw(seed, robot);
        let n = marks.len() as f32;
        let goal = [0, 1, 2].map(|axis| marks.iter().map(|p| p[axis]).sum::<f32>() / n);
        Course { scene: Scene::default(), goal, marks }
    }

    fn point(&self, course: &Course, _snake: &Snake, number: u8) -> Option<Point> {
        course.marks.get(usize::from(number)).copied()
    }

    fn verdict(&self, course: &Course, snake: &Snake, _gate: &mut Gate) -> Verdict {
        let positions: Vec<Point> = (0..snake.robot().modules).map(|m| snake.module_position(m)).collect();
        let mean = mean_distance(&positions, &course.marks);
        let sum = mean * course.marks.len() as f32;
        Verdict { paper: -sum, left: sum, distance: mean, success: mean < self.success_distance }
    }

    fn imagined_distance(&self, course: &Course, _snake: &Snake, positions: &[Point]) -> f32 {
        super::wasserstein(positions, &course.marks)
    }

    fn imagined_distance_of_each(&self, course: &Course, _snake: &Snake, positions: &[Point]) -> f32 {
        mean_distance(positions, &course.marks)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn targets_are_a_modules_length_apart_and_never_within_a_body_of_each_other() {
        for modules in (3..=16).chain([24, 32, 48, 64]) {
            let robot = Robot { modules, ..Robot::default() };
            let spacing = robot.links_per_module as f32 * robot.link_length;
            for kind in Shape::ALL {
                for seed in 0..20 {
                    let draw =
                        || ShapeFormation::targets(kind, &mut ChaCha8Rng::seed_from_u64(seed), &robot, 3.0, 45.0);
                    let targets = draw();
                    assert_eq!(targets, draw());
                    assert_eq!(targets.len(), modules);
                    for (i, a) in targets.iter().enumerate() {
                        assert_eq!(a[2], robot.link_radius);
                        for (j, b) in targets.iter().enumerate().skip(i + 1) {
                            let apart = distance(*a, *b);
                            // A chord of the curve is shorter than the curve.
                            assert!(
                                j > i + 1 || (0.75 * spacing..=1.001 * spacing).contains(&apart),
                                "{kind:?} {modules}: {apart}"
                            );
                            assert!(apart > 2.0 * robot.link_radius, "{kind:?} of {modules}, {i} and {j}: {apart}");
                        }
                    }
                }
            }
        }
    }

    #[test]
    fn the_curve_is_as_long_as_the_snake() {
        for kind in Shape::ALL {
            for bend in kind.bend().map(f32::to_radians) {
                // Points so dense that chord and curve are the same.
                let points = curve(kind, bend, 64, 0.1);
                let way: f32 = points.windows(2).map(|p| libm::hypotf(p[1][0] - p[0][0], p[1][1] - p[0][1])).sum();
                assert!((way - 6.3).abs() < 0.03, "{kind:?}: {way}");
                let heading = |p: &[[f32; 2]]| libm::atan2f(p[1][1] - p[0][1], p[1][0] - p[0][0]);
                let turned: Vec<f32> =
                    points.windows(3).map(|p| libm::remainderf(heading(&p[1..]) - heading(p), 2.0 * PI)).collect();
                let most = turned.iter().fold(0.0f32, |a, b| a.max(b.abs()));
                assert!(most <= 1.02 * kind.tightest() * bend / 63.0 + 1e-4, "{kind:?}: {most}");
            }
        }
    }

    #[test]
    fn the_heads_target_comes_first_and_the_shape_lies_by_the_snake() {
        let (robot, mut kinds) = (Robot::default(), 0.0f32);
        let task = ShapeFormation { heading: 30.0, place: 2.0, ..ShapeFormation::default() };
        let snake = Snake::new(&robot);
        let positions: Vec<Point> = (0..8).map(|m| snake.module_position(m)).collect();
        let middle = positions.iter().map(|p| p[0]).sum::<f32>() / 8.0;
        for seed in 0..200 {
            let course = task.course(seed, &robot);
            let (head, tail) = (course.marks[0], course.marks[7]);
            let heading = libm::atan2f(head[1] - tail[1], head[0] - tail[0]).to_degrees();
            assert!(heading.abs() <= 30.1, "{heading}");
            assert!(distance(course.goal, [middle, 0.0, robot.link_radius]) < 2.001);
            let verdict = task.verdict(&course, &snake, &mut Gate::default());
            assert!((verdict.distance * 8.0 - verdict.left).abs() < 1e-2 && verdict.paper == -verdict.left);
            kinds = kinds.max(verdict.distance);
            // Each module at its target is the shape formed.
            assert_eq!(task.imagined_distance(&course, &snake, &course.marks), 0.0);
        }
        assert!(kinds > 3.0, "{kinds}");
    }

    #[test]
    fn every_kind_of_shape_is_drawn_as_often_and_lies_apart_from_the_straight_snake() {
        const SEEDS: u64 = 3500;
        let robot = Robot::default();
        let (task, start) = (ShapeFormation::default(), start_positions(&robot));
        let mut drawn = [[0usize; 2]; Shape::ALL.len()];
        for seed in 0..SEEDS {
            let (kind, targets) = task.draw(seed, &robot);
            let [all, near] = &mut drawn[kind as usize];
            *all += 1;
            *near += usize::from(mean_distance(&start, &targets) < START_APART * task.success_distance);
        }
        println!("{drawn:?}");
        for ([all, near], kind) in drawn.into_iter().zip(Shape::ALL) {
            // Three standard deviations of a share of a seventh.
            assert!((all as f64 / SEEDS as f64 - 1.0 / 7.0).abs() < 0.018, "{kind:?}: {all}");
            assert_eq!(near, 0, "{kind:?}");
        }
        // Three modules in a line have no such place: the farthest one is taken.
        let (task, robot) = (ShapeFormation { shapes: vec![Shape::Line], ..task }, Robot { modules: 3, ..robot });
        let (start, targets) = (start_positions(&robot), task.draw(1, &robot).1);
        let apart = mean_distance(&start, &targets);
        assert!(apart > 1.0 && apart < START_APART * task.success_distance, "{apart}");
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let robot = Robot::default();
        let default = ShapeFormation::default;
        for (bad, words) in [
            (ShapeFormation { place: -1.0, ..default() }, "place = -1"),
            (ShapeFormation { heading: 200.0, ..default() }, "heading = 200"),
            (ShapeFormation { success_distance: 0.0, ..default() }, "success_distance = 0"),
        ] {
            let message = bad.validate(&robot).unwrap_err();
            assert!(message.contains(words), "{message}");
        }
        let short = Robot { modules: 2, ..Robot::default() };
        assert!(default().validate(&short).unwrap_err().contains("2 modules cannot form a shape"));
        assert_eq!(default().validate(&robot), Ok(()));
    }
}
