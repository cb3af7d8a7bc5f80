//! Tube Crossing: through a closed tube that is narrower than a coiled snake, to a goal behind it (paper, Table I, fourth row).
//!
//! | | |
//! |---|---|
//! | start | straight, at rest, head at the origin, facing +x |
//! | tube | its entrance `entrance_distance` units ahead of the head within `entrance_bearing`, `tube_length` long, bent by up to `tube_bend`; walls, bevels and a roof on the ground |
//! | goal | `goal_beyond` units behind the exit, straight on |
//! | reward `paper` | `-d(head, tube) - d(head, goal)`; `d(head, tube)` is the distance to the entrance, 0 once the head is in |
//! | left to do (`progress`) | the way of the head: to the entrance, through the tube, to the goal |
//! | success | the head has gone through the tube and `d(head, goal) < 2` units; ends the episode |
//! | points on the bus | 0: the goal, 1: the entrance's centre, 2: the middle of the tube's centre line |
//! | imagined distance | mean over the modules of the way left from `p'_i` |

use std::f32::consts::PI;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{Course, Gate, Point, Rules, Verdict, between, check_number, check_range, distance, either_side};
use crate::robot::Robot;
use crate::sim::Snake;
use crate::sim::scene::{Scene, Solid};

/// Straight pieces that the tube is made of.
const PIECES: usize = 8;
/// Thickness of its walls, units: thicker than a link at full speed moves in a physics step.
const THICKNESS: f32 = 0.6;
/// The bevel between wall and roof, as a share of the width.
const BEVEL: f32 = 0.25;

/// Settings of the task.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TubeCrossing {
    /// Inner width of the tube, units.
    pub tube_width: f32,
    /// Inner height of the tube, units.
    pub tube_height: f32,
    /// Shortest and longest tube along its centre line, units.
    pub tube_length: [f32; 2],
    /// Most angle that the tube turns through, to either side, degrees.
    pub tube_bend: f32,
    /// Nearest and farthest entrance, units from the head.
    pub entrance_distance: [f32; 2],
    /// Entrances lie, and point, within this angle to either side of straight ahead, degrees.
    pub entrance_bearing: f32,
    /// Distance of the goal behind the exit, units.
    pub goal_beyond: f32,
    /// Distance that counts as reached, units.
    pub success_distance: f32,
}

impl Default for TubeCrossing {
    fn default() -> Self {
        TubeCrossing {
            tube_width: 2.4,
            tube_height: 2.0,
            tube_length: [8.0, 12.0],
            tube_bend: 45.0,
            entrance_distance: [1.5, 3.0],
            entrance_bearing: 15.0,
            goal_beyond: 4.0,
            success_distance: 2.0,
        }
    }
}

/// Where a point is with respect to the tube.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Place {
    /// Along the centre line, units; below 0 before the entrance, above the length behind the exit.
    along: f32,
    /// Within walls and roof, if it is along the tube.
    within: bool,
}

/// The pieces of the centre line of a course: marks are its corners, from the entrance to the exit.
fn place(course: &Course, width: f32, height: f32, p: Point) -> Place {
    let mut best = (f32::INFINITY, Place { along: 0.0, within: false });
    let mut before = 0.0;
    let last = course.marks.len() - 2;
    for (k, ends) in course.marks.windows(2).enumerate() {
        let [a, b] = [ends[0], ends[1]];
        let length = libm::hypotf(b[0] - a[0], b[1] - a[1]);
        let axis = [(b[0] - a[0]) / length, (b[1] - a[1]) / length];
        let [x, y] = [p[0] - a[0], p[1] - a[1]];
        let s = x * axis[0] + y * axis[1];
        let aside = (y * axis[0] - x * axis[1]).abs();
        let outside = (-s).max(s - length).max(0.0);
        let away = outside * outside + aside * aside;
        if away < best.0 {
            let open = (k == 0 && s < 0.0) || (k == last && s > length);
            let s = if open { s } else { s.clamp(0.0, length) };
            best = (away, Place { along: before + s, within: aside < 0.5 * width && p[2] < height });
        }
        before += length;
    }
    best.1
}

impl TubeCrossing {
    fn place(&self, course: &Course, p: Point) -> Place {
        place(course, self.tube_width, self.tube_height, p)
    }

    /// Place of a point along the centre line, units, and whether it is within walls and roof.
    #[cfg(test)]
    pub(super) fn seen_from(&self, course: &Course, p: Point) -> (f32, bool) {
        let place = self.place(course, p);
        (place.along, place.within)
    }

    pub(super) fn length(course: &Course) -> f32 {
        course.marks.windows(2).map(|ends| distance(ends[0], ends[1])).sum()
    }

    /// The way to the goal of a point that has passed the tube, is in it, or has it before it.
    fn left(&self, course: &Course, p: Point, gate: Gate) -> f32 {
        match gate {
            Gate::Passed => distance(p, course.goal),
            Gate::Inside => (Self::length(course) - self.place(course, p).along).max(0.0) + self.goal_beyond,
            Gate::Before | Gate::Astray => distance(p, course.marks[0]) + Self::length(course) + self.goal_beyond,
        }
    }

    /// The panels of the tube: two walls, two bevels and a roof for each piece of the centre line. Inner faces meet edge to edge.
    fn solids(&self, marks: &[Point]) -> Vec<Solid> {
        let (width, height) = (self.tube_width, self.tube_height);
        let bevel = BEVEL * width.min(height);
        let pieces: Vec<_> = marks.windows(2).map(|ends| (ends[0], ends[1])).collect();
        let yaw = |k: usize| {
            let (a, b) = pieces[k];
            libm::atan2f(b[1] - a[1], b[0] - a[0])
        };
        // Half the turn to the left at the joint of two pieces, as its tangent.
        let turn = |k: usize| libm::tanf(0.5 * wrapped(yaw(k + 1) - yaw(k)));
        let mut solids = Vec::new();
        for (k, (a, b)) in pieces.iter().enumerate() {
            let yaw = yaw(k);
            let (sin, cos) = libm::sincosf(yaw);
            let length = libm::hypotf(b[0] - a[0], b[1] - a[1]);
            let turns = [if k > 0 { turn(k - 1) } else { 0.0 }, if k + 1 < pieces.len() { turn(k) } else { 0.0 }];
            // A panel whose inner face has its middle at (y, z), spans `edges` (y), and faces back along -(cos, sin) of `roll`. It is
            // as long as face and back need to meet those of the next piece, on the inside of a bend shorter than the centre line.
            let mut panel = |[y, z]: [f32; 2], edges: [f32; 2], half_width: f32, roll: f32| {
                let (nz, ny) = libm::sincosf(roll);
                let back = THICKNESS * ny;
                let [before, beyond] = turns.map(|turn| {
                    let over = edges.iter().flat_map(|edge| [-turn * edge, -turn * (edge + back)]);
                    over.fold(f32::NEG_INFINITY, f32::max)
                });
                let (x, y, z) = (0.5 * (length + beyond - before), y + 0.5 * back, z + 0.5 * THICKNESS * nz);
                solids.push(Solid {
                    half: [0.5 * (length + before + beyond), 0.5 * THICKNESS, half_width],
                    position: [a[0] + cos * x - sin * y, a[1] + sin * x + cos * y, z],
                    yaw,
                    roll,
                });
            };
            let (half, wall) = (0.5 * width, height - bevel);
            let (eighth, quarter) = (0.25 * PI, 0.5 * PI);
            // Their backs meet too.
            let mitre = THICKNESS * libm::tanf(0.5 * eighth);
            for side in [1.0f32, -1.0] {
                let (out, up) = if side > 0.0 { (0.0, eighth) } else { (PI, PI - eighth) };
                let (outer, inner) = (side * half, side * (half - bevel));
                panel([outer, 0.5 * (wall + mitre)], [outer, outer], 0.5 * (wall + mitre), out);
                let slope = std::f32::consts::FRAC_1_SQRT_2 * bevel + mitre;
                panel([0.5 * (outer + inner), height - 0.5 * bevel], [outer, inner], slope, up);
            }
            panel([0.0, height], [half, -half], half - bevel + mitre, quarter);
        }
        solids
    }
}

/// An angle as one from -pi to pi.
fn wrapped(angle: f32) -> f32 {
    libm::remainderf(angle, 2.0 * PI)
}

impl Rules for TubeCrossing {
    fn validate(&self, robot: &Robot) -> Result<(), String> {
        let diameter = 2.0 * robot.link_radius;
        let least = 1.25 * diameter;
        check_number("tube_width", self.tube_width, [least, 20.0])
            .map_err(|e| format!("{e}: the snake is {diameter} units thick and needs some room"))?;
        check_number("tube_height", self.tube_height, [least, 20.0])
            .map_err(|e| format!("{e}: the snake is {diameter} units thick and needs some room"))?;
        check_range("tube_length", self.tube_length, [1.0, 100.0])?;
        check_number("tube_bend", self.tube_bend, [0.0, 180.0])?;
        let radius = self.tube_length[0] / self.tube_bend.to_radians().max(1e-3);
        if radius < self.tube_width {
            return Err(format!(
                "tube_bend = {} over tube_length = {:?} bends with a radius of {radius:.1} units; it must be at least the tube's width, {}",
                self.tube_bend, self.tube_length, self.tube_width
            ));
        }
        let clear = 0.5 * robot.link_length + robot.link_radius;
        check_range("entrance_distance", self.entrance_distance, [clear, 50.0])
            .map_err(|e| format!("{e}: nearer, the tube would stand on the snake"))?;
        check_number("entrance_bearing", self.entrance_bearing, [0.0, 45.0])?;
        check_number("success_distance", self.success_distance, [0.01, 100.0])?;
        check_number("goal_beyond", self.goal_beyond, [self.success_distance, 50.0])
            .map_err(|e| format!("{e}: nearer, the goal would be reached inside the tube"))
    }

    fn goal_radius(&self) -> f32 {
        self.success_distance
    }

    fn course(&self, seed: u64, robot: &Robot) -> Course {
        let mut rng = ChaCha8Rng::seed_from_u64(seed);
        let length = between(&mut rng, self.tube_length);
        let bend = either_side(&mut rng, self.tube_bend);
        let away = between(&mut rng, self.entrance_distance);
        let bearing = either_side(&mut rng, self.entrance_bearing);
        let heading = bearing + either_side(&mut rng, self.entrance_bearing);
        let (sin, cos) = libm::sincosf(bearing);
        let mut at = [away * cos, away * sin, robot.link_radius];
        let mut marks = vec![at];
        let piece = length / PIECES as f32;
        for k in 0..PIECES {
            let (sin, cos) = libm::sincosf(heading + bend * (k as f32 + 0.5) / PIECES as f32);
            at = [at[0] + piece * cos, at[1] + piece * sin, at[2]];
            marks.push(at);
        }
        let (sin, cos) = libm::sincosf(heading + bend);
        let goal = [at[0] + self.goal_beyond * cos, at[1] + self.goal_beyond * sin, at[2]];
        Course { scene: Scene { solids: self.solids(&marks), block: None }, goal, marks }
    }

    fn point(&self, course: &Course, _snake: &Snake, number: u8) -> Option<Point> {
        match number {
            0 => Some(course.goal),
            1 => course.marks.first().copied(),
            2 => course.marks.get(PIECES / 2).copied(),
            _ => None,
        }
    }

    fn verdict(&self, course: &Course, snake: &Snake, gate: &mut Gate) -> Verdict {
        let head = snake.head();
        let (place, length) = (self.place(course, head), Self::length(course));
        let inside = place.within && (0.0..=length).contains(&place.along);
        *gate = match *gate {
            // Who slips in from behind has not crossed it, wherever it comes out.
            Gate::Before if inside => {
                if place.along < 0.5 * length {
                    Gate::Inside
                } else {
                    Gate::Astray
                }
            }
            Gate::Inside | Gate::Astray if inside => *gate,
            Gate::Inside if place.along > length => Gate::Passed,
            Gate::Passed => Gate::Passed,
            _ => Gate::Before,
        };
        let to_goal = distance(head, course.goal);
        let to_tube = if matches!(gate, Gate::Before | Gate::Astray) { distance(head, course.marks[0]) } else { 0.0 };
        Verdict {
            paper: -to_tube - to_goal,
            left: self.left(course, head, *gate),
            distance: to_goal,
            success: *gate == Gate::Passed && to_goal < self.success_distance,
        }
    }

    fn imagined_distance(&self, course: &Course, _snake: &Snake, positions: &[Point]) -> f32 {
        let length = Self::length(course);
        let left = positions.iter().map(|p| {
            let place = self.place(course, *p);
            let gate = match place.along {
                s if s > length => Gate::Passed,
                s if s > 0.0 && place.within => Gate::Inside,
                _ => Gate::Before,
            };
            self.left(course, *p, gate)
        });
        left.sum::<f32>() / positions.len().max(1) as f32
    }
}
