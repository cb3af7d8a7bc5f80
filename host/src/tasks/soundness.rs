//! Whether the scenes hold: nothing passes through walls, tube or block, whatever the motors do.
//!
//! Every physics step of every episode is checked. The bounded tests run with the others; for the 1,000 episodes a task:
//! `cargo test --release -p composer-host --lib -- --ignored --nocapture a_thousand`.

use composer_shared::policy::Task;
use rapier3d::math::{Pose, Rotation, Vector};

use super::tube_crossing::TubeCrossing;
use super::{Point, TaskConfig};
use crate::methods::mix;
use crate::robot::Robot;
use crate::sim::Snake;
use crate::sim::scene::Block;

/// A box in the world.
pub(super) struct Cuboid {
    half: [f32; 3],
    pose: Pose,
}

impl Cuboid {
    pub(super) fn new(half: [f32; 3], [x, y, z]: [f32; 3], [a, b, c, d]: [f32; 4]) -> Self {
        Cuboid { half, pose: Pose::from_parts(Vector::new(x, y, z), Rotation::from_xyzw(a, b, c, d)) }
    }

    fn local(&self, point: Point) -> [f32; 3] {
        self.pose.inverse_transform_point(Vector::from(point)).to_array()
    }

    /// How far below the nearest face the point is; negative outside.
    pub(super) fn depth(&self, point: Point) -> f32 {
        let local = self.local(point);
        (0..3).map(|axis| self.half[axis] - local[axis].abs()).fold(f32::INFINITY, f32::min)
    }

    /// How far outside the point is; 0 inside.
    pub(super) fn distance(&self, point: Point) -> f32 {
        let local = self.local(point);
        let outside = [0, 1, 2].map(|axis| (local[axis].abs() - self.half[axis]).max(0.0));
        super::distance(outside, [0.0; 3])
    }

    /// Whether the way from `a` to `b` leads through the box, made smaller by `margin` on every side.
    fn crossed(&self, a: Point, b: Point, margin: f32) -> bool {
        let (a, b) = (self.local(a), self.local(b));
        let (mut enters, mut leaves) = (0.0f32, 1.0f32);
        for axis in 0..3 {
            let half = (self.half[axis] - margin).max(0.0);
            let way = b[axis] - a[axis];
            if way.abs() < 1e-9 {
                if a[axis].abs() > half {
                    return false;
                }
                continue;
            }
            let (one, two) = ((-half - a[axis]) / way, (half - a[axis]) / way);
            enters = enters.max(one.min(two));
            leaves = leaves.min(one.max(two));
        }
        enters <= leaves
    }
}

/// The worst of a number of episodes; lengths in units.
#[derive(Clone, Copy, Debug, Default)]
struct Worst {
    /// Episodes in which a link came within a tenth of its radius of a solid or the block.
    touched: usize,
    /// How far a link's centre was below the face of a solid, of the block, of the ground; negative: never.
    in_solid: f32,
    in_block: f32,
    in_ground: f32,
    /// Ways of link centres, from one physics step to the next, through a solid.
    crossings: usize,
    /// Ways out of the tube besides its ends.
    escapes: usize,
    /// Of the block: height of its centre above that at rest, depth of its lowest corner below the ground, speed, units/s.
    block_rise: f32,
    block_sunk: f32,
    block_speed: f32,
    block_way: f32,
    /// Of the snake.
    link_speed: f32,
    link_height: f32,
    joint_gap: f32,
}

impl Worst {
    fn none() -> Self {
        let never = f32::NEG_INFINITY;
        Worst { in_solid: never, in_block: never, in_ground: never, ..Worst::default() }
    }

    fn and(self, other: Self) -> Self {
        Worst {
            touched: self.touched + other.touched,
            in_solid: self.in_solid.max(other.in_solid),
            in_block: self.in_block.max(other.in_block),
            in_ground: self.in_ground.max(other.in_ground),
            crossings: self.crossings + other.crossings,
            escapes: self.escapes + other.escapes,
            block_rise: self.block_rise.max(other.block_rise),
            block_sunk: self.block_sunk.max(other.block_sunk),
            block_speed: self.block_speed.max(other.block_speed),
            block_way: self.block_way.max(other.block_way),
            link_speed: self.link_speed.max(other.link_speed),
            link_height: self.link_height.max(other.link_height),
            joint_gap: self.joint_gap.max(other.joint_gap),
        }
    }
}

/// Full torque on every motor, reversed at random (even seeds) or as a wave that drives the snake forward, of random frequency and
/// phase, with pitch at random (odd seeds).
struct BangBang {
    seed: u64,
    hold: u64,
    frequency: f32,
    lag: f32,
}

impl BangBang {
    fn new(seed: u64) -> Self {
        let share = |n: u64| (mix(seed ^ n) >> 40) as f32 / (1u64 << 24) as f32;
        BangBang { seed, hold: 1 + mix(seed ^ 11) % 15, frequency: 0.45 + 0.25 * share(12), lag: 0.8 + 0.6 * share(13) }
    }

    fn torque(&self, control_step: u64, module: usize) -> [f32; 2] {
        let time = control_step as f32 * 0.05;
        let bits = mix(self.seed ^ mix((control_step / self.hold) << 8 | module as u64));
        let sign = |bit: u64| if bits >> bit & 1 == 1 { 1.0 } else { -1.0 };
        if self.seed.is_multiple_of(2) {
            return [sign(0), sign(1)];
        }
        let wave = libm::sinf(std::f32::consts::TAU * self.frequency * time - self.lag * module as f32);
        [if self.seed & 2 == 0 { wave } else { wave.signum() }, if bits >> 2 & 3 == 0 { sign(1) } else { 0.0 }]
    }
}

/// One episode of 125 control steps at full torque.
fn episode(task: &TaskConfig, robot: &Robot, seed: u64) -> Worst {
    let in_tube = task.task() == Task::TubeCrossing && seed % 4 < 2;
    let mut task = task.clone();
    if in_tube {
        task.rules.tube_crossing.tube_bend = 0.0;
    }
    let mut course = task.rules().course(mix(seed), robot);
    // Half of the snakes start in the tube.
    if in_tube {
        let by = course.marks[0][0] + 4.0;
        course.marks.iter_mut().chain(course.scene.solids.iter_mut().map(|s| &mut s.position)).for_each(|p| p[0] -= by);
    }
    let mut snake = Snake::in_scene(robot, &course.scene);
    let mut touched = false;
    let solids: Vec<Cuboid> =
        course.scene.solids.iter().map(|s| Cuboid::new(s.half, s.position, s.rotation())).collect();
    let pilot = BangBang::new(seed);
    let mut worst = Worst::none();
    let mut before: Vec<Point> = snake.poses().map(|(p, _)| p).collect();
    let tube = (task.task() == Task::TubeCrossing).then_some(&task.rules.tube_crossing);
    let inside = |tube: &TubeCrossing, p: Point| {
        let (along, within) = tube.seen_from(&course, p);
        (within, along, TubeCrossing::length(&course))
    };
    for step in 0..125 {
        for module in 0..robot.modules {
            snake.set_torque(module, pilot.torque(step, module).map(|t| t * robot.torque_limit));
        }
        for _ in 0..snake.steps_in(0.05) {
            let block_before = snake.block();
            snake.step();
            let now: Vec<Point> = snake.poses().map(|(p, _)| p).collect();
            for (&a, &b) in before.iter().zip(&now) {
                for solid in &solids {
                    let depth = solid.depth(b);
                    worst.in_solid = worst.in_solid.max(depth);
                    touched |= depth > -1.1 * robot.link_radius;
                    worst.crossings += usize::from(solid.crossed(a, b, 0.02));
                }
                worst.in_ground = worst.in_ground.max(-b[2]);
                if let Some(tube) = tube {
                    let ((was, from, length), (is, to, _)) = (inside(tube, a), inside(tube, b));
                    let middle = |s: f32| s > 0.5 && s < length - 0.5;
                    worst.escapes += usize::from(was && !is && middle(from) && middle(to));
                }
            }
            if let (Some(was), Some((position, rotation)), Some(block)) =
                (block_before, snake.block(), course.scene.block)
            {
                block_checks(&mut worst, &snake, &block, was.0, position, rotation, robot);
            }
            before = now;
        }
    }
    worst.touched = worst.touched.max(usize::from(touched));
    worst.link_speed = snake.motion().peak_link_speed;
    worst.link_height = snake.motion().peak_height;
    worst.joint_gap = snake.joint_gap();
    worst
}

fn block_checks(
    worst: &mut Worst,
    snake: &Snake,
    block: &Block,
    was: Point,
    position: Point,
    rotation: [f32; 4],
    robot: &Robot,
) {
    let cuboid = Cuboid::new(block.half, position, rotation);
    for (link, _) in snake.poses() {
        let depth = cuboid.depth(link);
        worst.in_block = worst.in_block.max(depth);
        worst.touched = worst.touched.max(usize::from(depth > -1.1 * robot.link_radius));
    }
    let corners = (0..8).map(|c| {
        let corner = [0, 1, 2].map(|axis| if c >> axis & 1 == 1 { block.half[axis] } else { -block.half[axis] });
        cuboid.pose.transform_point(Vector::from(corner)).z
    });
    worst.block_sunk = worst.block_sunk.max(-corners.fold(f32::INFINITY, f32::min));
    worst.block_rise = worst.block_rise.max(position[2] - block.half[2]);
    worst.block_speed = worst.block_speed.max(super::distance(was, position) / robot.physics_step);
    worst.block_way = worst.block_way.max(super::distance(position, block.position));
}

/// The tasks with something to pass through.
const SCENES: [Task; 3] = [Task::WallClimbing, Task::TubeCrossing, Task::BlockPushing];

fn episodes(task: Task, count: u64) -> Worst {
    let (mut task, robot) = (TaskConfig::new(task), Robot::default());
    // Nearer than the tasks have it, so that more of the episodes touch something.
    task.rules.wall_climbing.wall_distance = [0.7, 2.0];
    task.rules.block_pushing.block_distance = [2.1, 3.3];
    task.rules.block_pushing.block_bearing = 60.0;
    task.rules.tube_crossing.entrance_distance = [0.7, 1.5];
    task.rules.tube_crossing.tube_bend = 90.0;
    if task.task() == Task::TubeCrossing {
        task.rules.tube_crossing.entrance_bearing = 0.0;
    }
    task.validate(&robot).unwrap();
    let threads = std::thread::available_parallelism().map_or(1, usize::from);
    let all = crate::eval::parallel(count as usize, threads, |seed| episode(&task, &robot, seed as u64));
    all.into_iter().fold(Worst::none(), Worst::and)
}

/// Says what is wrong, if anything is.
fn check(task: Task, worst: &Worst, count: u64) {
    let robot = Robot::default();
    let touched = match task {
        Task::TubeCrossing => worst.touched as u64 > count / 2,
        _ => worst.touched as u64 > count / 10,
    };
    assert!(touched, "{task}: the episodes hardly touch anything: {worst:?}");
    assert!(worst.crossings == 0 && worst.escapes == 0, "{task}: {worst:?}");
    // A link's centre stays outside everything, and outside what does not give way by a quarter of its radius.
    let clear = -0.25 * robot.link_radius;
    assert!(worst.in_solid < clear && worst.in_block < 0.0 && worst.in_ground < clear, "{task}: {worst:?}");
    assert!(worst.block_rise < 0.5 && worst.block_sunk < 0.1 && worst.block_speed < 60.0, "{task}: {worst:?}");
}

#[test]
fn nothing_passes_through_walls_tube_or_block_at_full_torque() {
    for task in SCENES {
        check(task, &episodes(task, 16), 16);
    }
}

#[test]
#[ignore = "minutes"]
fn nothing_passes_through_them_in_a_thousand_episodes() {
    for task in SCENES {
        let worst = episodes(task, 1000);
        println!("{task}, 1000 episodes: {worst:?}");
        check(task, &worst, 1000);
    }
}
