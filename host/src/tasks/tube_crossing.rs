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
//! | why so hard | 2.4 units are three bodies wide, too narrow to turn round in; 8 to 12 units are half to three quarters of the snake, so that it is held on both sides for most of its length; the goal is reached only from the far end. The paper states no sizes |

use std::f32::consts::PI;

use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::{Course, Gate, Point, Rules, Verdict, Words, between, check_number, check_range, distance, either_side};
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

    /// What a head at `p` makes of the gate. Who slips in from behind has not crossed the tube, wherever it comes out.
    fn passage(&self, course: &Course, p: Point, gate: Gate) -> Gate {
        let (place, length) = (self.place(course, p), Self::length(course));
        let inside = place.within && (0.0..=length).contains(&place.along);
        match gate {
            Gate::Before if inside && place.along < 0.5 * length => Gate::Inside,
            Gate::Before if inside => Gate::Astray,
            Gate::Inside | Gate::Astray if inside => gate,
            Gate::Inside if place.along > length => Gate::Passed,
            Gate::Passed => Gate::Passed,
            _ => Gate::Before,
        }
    }

    /// Whether the front edges of the walls stand clear of the snake at the start, however the entrance lies and points.
    fn clear_of_start(&self, robot: &Robot) -> bool {
        let front = 0.5 * robot.link_length + robot.link_radius;
        let most = self.entrance_bearing.to_radians();
        let shares = (0..=8).map(|k| k as f32 / 8.0);
        let angles = || shares.clone().map(move |s| most * (2.0 * s - 1.0));
        angles().flat_map(|bearing| angles().map(move |turn| (bearing, bearing + turn))).all(|(bearing, heading)| {
            let ((by, bx), (sin, cos)) = (libm::sincosf(bearing), libm::sincosf(heading));
            [1.0f32, -1.0].into_iter().all(|side| {
                shares.clone().all(|s| {
                    let aside = side * (0.5 * self.tube_width + s * THICKNESS);
                    let x = self.entrance_distance[0] * bx - aside * sin;
                    let y = self.entrance_distance[0] * by + aside * cos;
                    x > front || y.abs() > robot.link_radius
                })
            })
        })
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
        if !self.clear_of_start(robot) {
            return Err(format!(
                "entrance_distance = {:?} with entrance_bearing = {}: the tube would stand on the snake; a larger distance or a smaller bearing keeps it clear",
                self.entrance_distance, self.entrance_bearing
            ));
        }
        check_number("success_distance", self.success_distance, [0.01, 100.0])?;
        check_number("goal_beyond", self.goal_beyond, [self.success_distance, 50.0])
            .map_err(|e| format!("{e}: nearer, the goal would be reached inside the tube"))
    }

    fn goal_radius(&self) -> f32 {
        self.success_distance
    }

    fn words(&self) -> Words {
        Words {
            measure: "head to goal",
            done: "through the tube to the goal",
            missed: "not through the tube to the goal",
        }
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
        *gate = self.passage(course, head, *gate);
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

#[cfg(test)]
mod tests {
    use super::super::soundness::Cuboid;
    use super::super::{Judge, TaskConfig};
    use super::*;
    use composer_shared::policy::Task;

    fn task(bend: f32) -> TubeCrossing {
        TubeCrossing { tube_bend: bend, entrance_bearing: 0.0, ..TubeCrossing::default() }
    }

    fn panels(course: &Course) -> Vec<Cuboid> {
        course.scene.solids.iter().map(|s| Cuboid::new(s.half, s.position, s.rotation())).collect()
    }

    /// A point `along` the centre line, `aside` to its left and at height `z`.
    fn at(course: &Course, along: f32, aside: f32, z: f32) -> Point {
        let piece = TubeCrossing::length(course) / PIECES as f32;
        let k = ((along / piece).floor().max(0.0) as usize).min(PIECES - 1);
        let (a, b) = (course.marks[k], course.marks[k + 1]);
        let axis = [(b[0] - a[0]) / piece, (b[1] - a[1]) / piece];
        let s = along - k as f32 * piece;
        [a[0] + axis[0] * s - axis[1] * aside, a[1] + axis[1] * s + axis[0] * aside, z]
    }

    #[test]
    fn a_point_is_placed_along_and_within_the_tube() {
        let robot = Robot::default();
        for bend in [0.0, 45.0, 90.0] {
            let task = task(bend);
            for seed in 0..20 {
                let course = task.course(seed, &robot);
                let length = TubeCrossing::length(&course);
                assert!((8.0..=12.0).contains(&length), "{length}");
                let near = |p: Point, along: f32, within: bool| {
                    let place = task.place(&course, p);
                    // Beside a bend the next piece may be the nearer one.
                    assert!(
                        (place.along - along).abs() < 0.8 && place.within == within,
                        "{p:?}: {place:?}, not {along}"
                    );
                };
                near(at(&course, -2.0, 0.0, 0.4), -2.0, true);
                near(at(&course, length + 2.0, 0.0, 0.4), length + 2.0, true);
                for share in [0.02f32, 0.3, 0.5, 0.8, 0.98] {
                    for aside in [-1.0f32, -0.5, 0.0, 0.5, 1.0] {
                        near(at(&course, share * length, aside, 0.4), share * length, true);
                        near(at(&course, share * length, aside, 2.5), share * length, false);
                    }
                    near(at(&course, share * length, 1.8, 0.4), share * length, false);
                    near(at(&course, share * length, -1.8, 0.4), share * length, false);
                }
            }
        }
    }

    #[test]
    fn the_panels_are_closed_and_leave_the_inside_free() {
        let robot = Robot::default();
        for (bend, width, height) in
            [(0.0, 2.4, 2.0), (45.0, 2.4, 2.0), (90.0, 2.4, 2.0), (180.0, 1.6, 1.2), (90.0, 1.2, 3.0)]
        {
            let task = TubeCrossing { tube_width: width, tube_height: height, ..task(bend) };
            task.validate(&robot).unwrap();
            let bevel = BEVEL * width.min(height);
            for seed in 0..3 {
                let course = task.course(seed, &robot);
                let (panels, length) = (panels(&course), TubeCrossing::length(&course));
                let in_panel = |p: Point, by: f32| panels.iter().any(|panel| panel.depth(p) > by);
                for step in 0..=160 {
                    let along = 0.01 + step as f32 / 160.0 * (length - 0.02);
                    // From the centre line outwards in every direction across the tube: free, then a panel of full thickness.
                    for angle in (0..=24).map(|k| PI * k as f32 / 24.0) {
                        let (up, out) = libm::sincosf(angle);
                        let ray = |reach: f32| at(&course, along, reach * out, 0.2 + reach * up);
                        let walls = 0.5 * width / out.abs().max(1e-6);
                        let roof = (height - 0.2) / up.max(1e-6);
                        let slopes = (0.5 * width + height - bevel - 0.2) / (out.abs() + up);
                        let face = walls.min(roof).min(slopes);
                        // A bend's inside is the nearer the more it turns in a piece.
                        let inner = face * (1.0 - 0.15 * (bend / 180.0)) - 0.02;
                        let free = (0..50).all(|k| !in_panel(ray(inner * k as f32 / 50.0), 0.0));
                        assert!(
                            free,
                            "seed {seed}, bend {bend}: a panel stands inside at {along} of {length}, angle {angle}"
                        );
                        let closed = (0..40).any(|k| in_panel(ray(face * 1.01 + 0.02 * k as f32), -1e-4));
                        assert!(closed, "seed {seed}, bend {bend}: a gap at {along} of {length}, angle {angle}");
                    }
                }
            }
        }
    }

    #[test]
    fn the_tube_never_stands_on_the_snake() {
        let robot = Robot::default();
        let body: Vec<Point> = (-9..640).map(|k| [-0.025 * k as f32, 0.0, robot.link_radius]).collect();
        let mut refused = 0;
        for seed in 0..300u64 {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let mut draw = |range| between(&mut rng, range);
            let task = if seed < 50 {
                TubeCrossing::default()
            } else {
                let nearest = draw([0.65, 1.2]);
                TubeCrossing {
                    tube_width: draw([1.0, 3.0]),
                    tube_length: [12.6, 14.0],
                    tube_bend: draw([0.0, 180.0]),
                    entrance_distance: [nearest, nearest + 0.2],
                    entrance_bearing: draw([0.0, 45.0]),
                    ..TubeCrossing::default()
                }
            };
            if task.validate(&robot).is_err() {
                refused += 1;
                continue;
            }
            for course in 0..10 {
                let panels = panels(&task.course(100 * seed + course, &robot));
                for panel in &panels {
                    assert!(body.iter().all(|p| panel.distance(*p) > 0.99 * robot.link_radius), "{task:?}");
                }
            }
        }
        assert!((10..150).contains(&refused), "{refused} refused");
    }

    #[test]
    fn only_the_way_through_from_the_front_counts() {
        let task = task(45.0);
        let course = task.course(3, &Robot::default());
        let length = TubeCrossing::length(&course);
        // The gate after a way along (along, aside, z), in steps of a tenth of a unit.
        let walk = |way: &[[f32; 3]]| {
            let mut gate = Gate::Before;
            for ends in way.windows(2) {
                let steps = (10.0 * distance(ends[0], ends[1])).ceil() as usize;
                for step in 0..=steps {
                    let share = step as f32 / steps as f32;
                    let [along, aside, z] = [0, 1, 2].map(|i| ends[0][i] + share * (ends[1][i] - ends[0][i]));
                    gate = task.passage(&course, at(&course, along, aside, z), gate);
                }
            }
            gate
        };
        let behind = length + 3.0;
        assert_eq!(walk(&[[-2.0, 0.0, 0.4], [behind, 0.0, 0.4]]), Gate::Passed);
        assert_eq!(walk(&[[-2.0, 0.0, 0.4], [0.6 * length, 0.5, 1.0]]), Gate::Inside);
        // In and out again; round it; over it.
        assert_eq!(walk(&[[-2.0, 0.0, 0.4], [0.6 * length, 0.0, 0.4], [-2.0, 0.0, 0.4]]), Gate::Before);
        assert_eq!(walk(&[[-2.0, 0.0, 0.4], [-1.0, 3.0, 0.4], [behind, 3.0, 0.4], [behind, 0.0, 0.4]]), Gate::Before);
        assert_eq!(walk(&[[-2.0, 0.0, 0.4], [-1.0, 0.0, 3.0], [behind, 0.0, 3.0], [behind, 0.0, 0.4]]), Gate::Before);
        // Round it, in from behind, up to its front and back out.
        let round = [[-1.0, 3.0, 0.4], [behind, 3.0, 0.4], [behind, 0.0, 0.4], [0.1 * length, 0.0, 0.4]];
        assert_eq!(walk(&round), Gate::Astray);
        assert_eq!(walk(&[&round[..], &[[behind, 0.0, 0.4]]].concat()), Gate::Before);
        assert_eq!(walk(&[&round[..], &[[-1.0, 0.0, 0.4]]].concat()), Gate::Before);
    }

    #[test]
    fn a_wave_drives_the_snake_through_a_straight_tube() {
        let robot = Robot::default();
        let mut config = TaskConfig::new(Task::TubeCrossing);
        config.rules.tube_crossing = TubeCrossing { tube_length: [8.0, 8.0], ..task(0.0) };
        let (mut snake, mut judge) = Judge::start(&config, 1, &robot);
        let mut left = judge.verdict().left;
        for step in 0..400 {
            for module in 0..robot.modules {
                let wave = libm::sinf(2.0 * PI * 0.5 * 0.05 * step as f32 - 1.3 * module as f32);
                snake.set_torque(module, [0.5 * robot.torque_limit * wave, 0.0]);
            }
            for _ in 0..5 {
                snake.step();
                judge.watch(&config, &snake);
            }
            judge.step(&config, &snake);
            assert!(judge.verdict().left < left + 1.0, "the way left jumps from {left} to {}", judge.verdict().left);
            left = judge.verdict().left;
            if judge.verdict().success {
                return;
            }
        }
        panic!("the snake is stuck: {:?}, head at {:?}", judge.verdict(), snake.head());
    }

    #[test]
    fn settings_that_cannot_be_are_refused() {
        let default = TubeCrossing::default;
        for (bad, words) in [
            (TubeCrossing { tube_width: 0.7, ..default() }, "tube_width = 0.7; it must be from 1"),
            (TubeCrossing { tube_height: 0.8, ..default() }, "tube_height = 0.8; it must be from 1"),
            (TubeCrossing { tube_length: [5.0, 4.0], ..default() }, "tube_length = [5, 4]"),
            (
                TubeCrossing { tube_length: [2.0, 4.0], tube_bend: 180.0, ..default() },
                "bends with a radius of 0.6 units",
            ),
            (TubeCrossing { tube_bend: f32::NAN, ..default() }, "tube_bend = NaN"),
            (TubeCrossing { entrance_distance: [0.2, 1.0], ..default() }, "the tube would stand on the snake"),
            (
                TubeCrossing { tube_width: 1.0, entrance_distance: [0.7, 1.0], entrance_bearing: 45.0, ..default() },
                "a smaller bearing keeps it clear",
            ),
            (TubeCrossing { goal_beyond: 1.0, ..default() }, "reached inside the tube"),
            (TubeCrossing { goal_beyond: 60.0, ..default() }, "goal_beyond = 60"),
            (TubeCrossing { success_distance: 0.0, ..default() }, "success_distance = 0"),
        ] {
            let message = bad.validate(&Robot::default()).unwrap_err();
            assert!(message.contains(words), "{message}");
        }
        assert_eq!(default().validate(&Robot::default()), Ok(()));
    }
}
