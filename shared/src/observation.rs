//! What a module observes: the one definition, called by training and by the firmware.
//!
//! Only what a real module can know: its encoders, its IMU, the current in its motors, its place in the chain, and (by chain
//! kinematics over the published joint angles) the head and the goal in its own frame. No global position, no linear velocity,
//! no height, no clock, no module number.
//!
//! | index | field | unit | frame | scale |
//! |---|---|---|---|---|
//! | 0..3 | vector to the first point, the goal | robot units | own | / 10, clipped to +-2 |
//! | 3..6 | direction to the goal | - | own | unit vector |
//! | 6 | ln(1 + distance of the [`Seeker`] to the goal) | ln(robot units) | - | 1 |
//! | 7 | the goal is known | - | - | 0 or 1; if 0, fields 0..7 are 0 |
//! | 8..11 | up (against gravity), by the attitude filter | - | own | unit vector |
//! | 11..14 | angular rate | rad/s | own | / 5 |
//! | 14..18 | joint angles, head end first | rad | joint | 1 |
//! | 18..22 | joint speeds | rad/s | joint | / 5 |
//! | 22..24 | measured torque, yaw and pitch | of the limit | axis | 1 |
//! | 24..27 | vector to the head link | robot units | own | / 10, clipped to +-2 |
//! | 27 | place in the chain | - | - | 0 head .. 1 tail |
//! | 28..31 | vector to the second point | robot units | own | / 10, clipped to +-2 |
//! | 31..34 | direction to the second point | - | own | unit vector |
//! | 34 | ln(1 + distance of the head to the second point) | ln(robot units) | - | 1 |
//! | 35 | the second point is known | - | - | 0 or 1; if 0, fields 28..35 are 0 |
//! | 36..39 | vector to the third point | robot units | own | / 10, clipped to +-2 |
//! | 39 | the third point is known | - | - | 0 or 1; if 0, fields 36..39 are 0 |
//! | 40..42 | torque commanded in the last control step, yaw and pitch | of the limit | axis | 1 |
//! | 42..44 | the own motors work, yaw and pitch | - | axis | 1, or 0 if dead |
//! | 44 | share of the motors of the next module towards the head that work | - | - | 0, 1/2 or 1 |
//! | 45 | the same towards the tail | - | - | 0, 1/2 or 1 |
//! | 46 | ln(1 + distance of the own frame to the first point) | ln(robot units) | - | 1; 0 if the goal is not known |
//! | 47 | ln(1 + distance of the own frame to the head link) | ln(robot units) | - | 1 |
//!
//! The first [`BASE`] fields are the paper's protocol. A network takes those alone or all of them
//! ([`crate::policy::Shape::inputs`]).
//!
//! "Own" is the frame of the module's second link ([`crate::robot::Geometry::OWN_LINK`]); distances are measured from the centre of the
//! head link, or, if every module seeks a place of its own, from the origin of the own frame. What the three points are is the
//! task's matter ([`crate::policy::Task::observed`]); they arrive in GOAL frames.

use nalgebra::Vector3;

use crate::kinematics::Pose;
use crate::robot::{AXES, MAX_JOINTS};

/// Numbers in an observation.
pub const SIZE: usize = 48;

/// How many of them, the first, are the paper's protocol.
pub const BASE: usize = 40;

/// Points of the scene that a module observes at most.
pub const POINTS: usize = 3;

/// One observation, raw: not yet normalised by the policy's statistics.
pub type Observation = [f32; SIZE];

/// Name of each field, in order; generated documents (policy manifests, plots) take them from here.
pub const NAMES: [&str; SIZE] = [
    "goal_x",
    "goal_y",
    "goal_z",
    "goal_direction_x",
    "goal_direction_y",
    "goal_direction_z",
    "goal_log_distance",
    "goal_known",
    "up_x",
    "up_y",
    "up_z",
    "rate_x",
    "rate_y",
    "rate_z",
    "angle_0",
    "angle_1",
    "angle_2",
    "angle_3",
    "speed_0",
    "speed_1",
    "speed_2",
    "speed_3",
    "torque_yaw",
    "torque_pitch",
    "head_x",
    "head_y",
    "head_z",
    "place",
    "second_x",
    "second_y",
    "second_z",
    "second_direction_x",
    "second_direction_y",
    "second_direction_z",
    "second_log_distance",
    "second_known",
    "third_x",
    "third_y",
    "third_z",
    "third_known",
    "commanded_yaw",
    "commanded_pitch",
    "works_yaw",
    "works_pitch",
    "works_towards_head",
    "works_towards_tail",
    "own_goal_log_distance",
    "own_head_log_distance",
];

/// Who is to come to the goal.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Seeker {
    /// The head.
    #[default]
    Head,
    /// Each module, to a goal of its own.
    Each,
}

/// What a module is told of the scene, by GOAL frames.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Told {
    /// The goal and up to two more points, robot units, frame of the head link.
    pub points: [Option<Vector3<f32>>; POINTS],
    /// Who is to come to the first of them.
    pub seeker: Seeker,
}

impl Told {
    /// A goal for the head, and no other point.
    pub fn goal(goal: Vector3<f32>) -> Self {
        Told { points: [Some(goal), None, None], seeker: Seeker::Head }
    }
}

/// What a module knows of its motors and of those of the modules next to it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motors {
    /// Torque commanded in the last control step, as a fraction of the limit, yaw and pitch.
    pub commanded: [f32; AXES],
    /// Whether the own motors work, yaw and pitch.
    pub work: [bool; AXES],
    /// Share of the motors that work of the next module towards the head and of the next towards the tail: 0 if it is silent, 1 where the chain
    /// ends, for nobody is missing there.
    pub beside: [f32; 2],
}

impl Motors {
    /// Nothing commanded, and all motors work.
    pub const SOUND: Motors = Motors { commanded: [0.0; AXES], work: [true; AXES], beside: [1.0; 2] };
}

/// One sample of a module's own sensors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensors {
    /// Joint angles, rad; joints that do not exist read 0.
    pub joint_angles: [f32; MAX_JOINTS],
    /// Joint speeds, rad/s.
    pub joint_speeds: [f32; MAX_JOINTS],
    /// Direction against gravity in the own frame: a unit vector from the firmware's attitude filter (gyroscope and accelerometer). Zeros if
    /// it is not known, and of another length if what the accelerometer feels in the mean is not 1 g.
    pub up: [f32; 3],
    /// Angular rate in the own frame (gyroscope), rad/s.
    pub angular_rate: [f32; 3],
    /// Torque measured at the motors (current), as a fraction of the limit, yaw and pitch.
    pub torque: [f32; AXES],
    /// Motor temperature, degrees Celsius.
    pub temperature: f32,
}

impl Sensors {
    /// Sensors that read nothing but zeros: what an unpowered or zeroed sensor board delivers.
    pub const ZERO: Sensors = Sensors {
        joint_angles: [0.0; MAX_JOINTS],
        joint_speeds: [0.0; MAX_JOINTS],
        up: [0.0; 3],
        angular_rate: [0.0; 3],
        torque: [0.0; AXES],
        temperature: 0.0,
    };

    /// Whether the sample can be true: everything finite, and an accelerometer that feels gravity. A module whose sensors fail this
    /// test tells its neighbours to mask its message ([`crate::wire::Health::sensors_plausible`]).
    pub fn plausible(&self) -> bool {
        let norm2: f32 = self.up.iter().map(|u| u * u).sum();
        let numbers = [&self.joint_angles[..], &self.joint_speeds, &self.angular_rate, &self.torque];
        (0.25..4.0).contains(&norm2) && numbers.into_iter().flatten().all(|v| v.is_finite())
    }
}

/// Vector to a point (/ 10, clipped), direction to it, ln(1 + `distance`), and that it is known.
fn point_fields(o: &mut [f32; 8], here: Vector3<f32>, distance: f32) {
    let from_here = norm(here).max(1e-3);
    for axis in 0..3 {
        o[axis] = (here[axis] / 10.0).clamp(-2.0, 2.0);
        o[3 + axis] = here[axis] / from_here;
    }
    o[6] = libm::logf(1.0 + distance);
    o[7] = 1.0;
}

fn norm(v: Vector3<f32>) -> f32 {
    libm::sqrtf(v.dot(&v))
}

/// Builds the observation of a module.
///
/// `motors` is what it knows of motors; `place` is 0 at the head and 1 at the tail; `head` the pose of the head link in the own frame
/// ([`crate::kinematics::Chain::head_seen_from`]); `told` what this module is told of the scene.
///
/// A module whose sensors are not [plausible](Sensors::plausible) observes nothing: all zeros, the paper's observation fault.
pub fn observe(sensors: &Sensors, motors: &Motors, place: f32, head: &Pose, told: &Told) -> Observation {
    let mut o = [0.0; SIZE];
    if !sensors.plausible() {
        return o;
    }
    let [goal, second, third] = told.points;
    if let Some(goal) = goal {
        let here = head.point(goal);
        let distance = match told.seeker {
            Seeker::Head => norm(goal),
            Seeker::Each => norm(here),
        };
        if let Some(fields) = o.first_chunk_mut() {
            point_fields(fields, here, distance);
        }
        o[46] = libm::logf(1.0 + norm(here));
    }
    if let Some(second) = second
        && let Some(fields) = o.get_mut(28..).and_then(|o| o.first_chunk_mut())
    {
        point_fields(fields, head.point(second), norm(second));
    }
    if let Some(third) = third {
        let here = head.point(third);
        for axis in 0..3 {
            o[36 + axis] = (here[axis] / 10.0).clamp(-2.0, 2.0);
        }
        o[39] = 1.0;
    }
    for axis in 0..3 {
        o[8 + axis] = sensors.up[axis];
        o[11 + axis] = sensors.angular_rate[axis] / 5.0;
        o[24 + axis] = (head.position[axis] / 10.0).clamp(-2.0, 2.0);
    }
    for joint in 0..MAX_JOINTS {
        o[14 + joint] = sensors.joint_angles[joint];
        o[18 + joint] = sensors.joint_speeds[joint] / 5.0;
    }
    o[22] = sensors.torque[0];
    o[23] = sensors.torque[1];
    o[27] = place;
    for axis in 0..AXES {
        o[40 + axis] = motors.commanded[axis];
        o[42 + axis] = f32::from(u8::from(motors.work[axis]));
        o[44 + axis] = motors.beside[axis];
    }
    o[47] = libm::logf(1.0 + norm(head.position));
    o
}

/// Place of `module` in a chain of `modules`: 0 at the head, 1 at the tail.
pub fn place(module: usize, modules: usize) -> f32 {
    if modules < 2 { 0.0 } else { module as f32 / (modules - 1) as f32 }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::kinematics::Chain;
    use crate::robot::Geometry;

    fn level() -> Sensors {
        Sensors { up: [0.0, 0.0, 1.0], ..Sensors::ZERO }
    }

    #[test]
    fn the_goal_arrives_in_the_own_frame() {
        let chain = Chain::new(Geometry::default());
        let o = observe(
            &level(),
            &Motors::SOUND,
            place(1, 8),
            &chain.head_seen_from(1),
            &Told::goal(Vector3::new(0.0, 5.0, 0.0)),
        );
        // Module 1's second link is 2.5 units behind the head.
        assert!((o[0] - 0.25).abs() < 1e-6 && (o[1] - 0.5).abs() < 1e-6);
        let direction: f32 = o[3..6].iter().map(|v| v * v).sum();
        assert!((direction - 1.0).abs() < 1e-5 && (o[4] / o[3] - 2.0).abs() < 1e-5, "{o:?}");
        assert!((o[6] - libm::logf(6.0)).abs() < 1e-6);
        assert_eq!(o[7], 1.0);
        assert!((o[27] - 1.0 / 7.0).abs() < 1e-6);
    }

    #[test]
    fn three_points_arrive_and_distances_are_those_of_the_seeker() {
        let chain = Chain::new(Geometry::default());
        let points = [(3.0, 4.0), (0.0, -2.0), (-30.0, 1.0)].map(|(x, y)| Some(Vector3::new(x, y, 0.0)));
        let head = chain.head_seen_from(1);
        let by_head = observe(&level(), &Motors::SOUND, 0.0, &head, &Told { points, seeker: Seeker::Head });
        let each = observe(&level(), &Motors::SOUND, 0.0, &head, &Told { points, seeker: Seeker::Each });
        assert!((by_head[6] - libm::logf(6.0)).abs() < 1e-6);
        // 2.5 units behind the head it is 5.5 along and 4 aside.
        assert!((each[6] - libm::logf(1.0 + libm::hypotf(5.5, 4.0))).abs() < 1e-6);
        assert!(by_head[..6] == each[..6] && by_head[7..] == each[7..]);
        assert!((by_head[46] - libm::logf(1.0 + libm::hypotf(5.5, 4.0))).abs() < 1e-6);
        assert!((by_head[47] - libm::logf(3.5)).abs() < 1e-6);
        assert!((each[28] - 0.25).abs() < 1e-6 && (each[29] + 0.2).abs() < 1e-6 && each[35] == 1.0);
        assert!((each[34] - libm::logf(3.0)).abs() < 1e-6 && (each[32] / each[31] + 0.8).abs() < 1e-5);
        assert!(each[36] == -2.0 && (each[37] - 0.1).abs() < 1e-6 && each[39] == 1.0);
    }

    #[test]
    fn what_is_known_of_motors_comes_behind_the_papers_fields() {
        let chain = Chain::new(Geometry::default());
        let motors = Motors { commanded: [0.25, -0.5], work: [true, false], beside: [0.5, 1.0] };
        let told = Told::goal(Vector3::new(1.0, 2.0, 3.0));
        let [o, sound] =
            [motors, Motors::SOUND].map(|motors| observe(&level(), &motors, 0.5, &chain.head_seen_from(3), &told));
        assert_eq!(o[BASE..46], [0.25, -0.5, 1.0, 0.0, 0.5, 1.0]);
        assert_eq!(sound[BASE..46], [0.0, 0.0, 1.0, 1.0, 1.0, 1.0]);
        assert!(o[..BASE] == sound[..BASE] && o[46..] == sound[46..]);
    }

    #[test]
    fn an_unknown_goal_is_all_zero_and_implausible_sensors_observe_nothing() {
        let chain = Chain::new(Geometry::default());
        let mut sensors = level();
        assert!(sensors.plausible());
        let o = observe(&sensors, &Motors::SOUND, 0.0, &chain.head_seen_from(0), &Told::default());
        assert!(o[..8].iter().chain(&o[28..BASE]).all(|v| *v == 0.0) && o[10] == 1.0 && o[46] == 0.0);
        sensors.angular_rate[1] = f32::NAN;
        assert!(!sensors.plausible() && !Sensors::ZERO.plausible());
        assert_eq!(observe(&sensors, &Motors::SOUND, 0.5, &chain.head_seen_from(0), &Told::default()), [0.0; SIZE]);
    }
}
