//! What a module observes: the one definition, called by training and by the firmware.
//!
//! Only what a real module can know: its encoders, its IMU, the current in its motors, its place in the chain, and (by chain
//! kinematics over the published joint angles) the head and the goal in its own frame. No global position, no linear velocity,
//! no height, no clock, no module number.
//!
//! | index | field | unit | frame | scale |
//! |---|---|---|---|---|
//! | 0..3 | vector to the goal | robot units | own | / 10, clipped to +-2 |
//! | 3..6 | direction to the goal | - | own | unit vector |
//! | 6 | ln(1 + distance to the goal) | ln(robot units) | - | 1 |
//! | 7 | the goal is known | - | - | 0 or 1; if 0, fields 0..7 are 0 |
//! | 8..11 | up (against gravity) | - | own | unit vector |
//! | 11..14 | angular rate | rad/s | own | / 5 |
//! | 14..18 | joint angles, head end first | rad | joint | 1 |
//! | 18..22 | joint speeds | rad/s | joint | / 5 |
//! | 22..24 | measured torque, yaw and pitch | of the limit | axis | 1 |
//! | 24..27 | vector to the head link | robot units | own | / 10, clipped to +-2 |
//! | 27 | place in the chain | - | - | 0 head .. 1 tail |
//!
//! "Own" is the frame of the module's second link ([`crate::robot::Geometry::OWN_LINK`]); distances of the goal are measured
//! from the centre of the head link.

use nalgebra::Vector3;

use crate::kinematics::Pose;
use crate::robot::{AXES, MAX_JOINTS};

/// Numbers in an observation.
pub const SIZE: usize = 28;

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
];

/// One sample of a module's own sensors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sensors {
    /// Joint angles, rad; joints that do not exist read 0.
    pub joint_angles: [f32; MAX_JOINTS],
    /// Joint speeds, rad/s.
    pub joint_speeds: [f32; MAX_JOINTS],
    /// Direction against gravity in the own frame (accelerometer), about a unit vector.
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

/// Builds the observation of a module.
///
/// `place` is 0 at the head and 1 at the tail; `head` the pose of the head link in the own frame
/// ([`crate::kinematics::Chain::head_seen_from`]); `goal` the goal in the frame of the head link (robot units), if this module is told.
///
/// A module whose sensors are not [plausible](Sensors::plausible) observes nothing: all zeros, the paper's observation fault.
pub fn observe(sensors: &Sensors, place: f32, head: &Pose, goal: Option<Vector3<f32>>) -> Observation {
    let mut o = [0.0; SIZE];
    if !sensors.plausible() {
        return o;
    }
    if let Some(goal) = goal {
        let to_goal = head.point(goal);
        // The distance counts from the head, the direction from here.
        let distance = libm::sqrtf(goal.dot(&goal));
        let from_here = libm::sqrtf(to_goal.dot(&to_goal)).max(1e-3);
        for axis in 0..3 {
            o[axis] = (to_goal[axis] / 10.0).clamp(-2.0, 2.0);
            o[3 + axis] = to_goal[axis] / from_here;
        }
        o[6] = libm::logf(1.0 + distance);
        o[7] = 1.0;
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
        let o = observe(&level(), place(1, 8), &chain.head_seen_from(1), Some(Vector3::new(0.0, 5.0, 0.0)));
        // Module 1's second link is 2.5 units behind the head.
        assert!((o[0] - 0.25).abs() < 1e-6 && (o[1] - 0.5).abs() < 1e-6);
        let direction: f32 = o[3..6].iter().map(|v| v * v).sum();
        assert!((direction - 1.0).abs() < 1e-5 && (o[4] / o[3] - 2.0).abs() < 1e-5, "{o:?}");
        assert!((o[6] - libm::logf(6.0)).abs() < 1e-6);
        assert_eq!(o[7], 1.0);
        assert!((o[27] - 1.0 / 7.0).abs() < 1e-6);
    }

    #[test]
    fn an_unknown_goal_is_all_zero_and_implausible_sensors_observe_nothing() {
        let chain = Chain::new(Geometry::default());
        let mut sensors = level();
        assert!(sensors.plausible());
        let o = observe(&sensors, 0.0, &chain.head_seen_from(0), None);
        assert!(o[..8].iter().all(|v| *v == 0.0) && o[10] == 1.0);
        sensors.angular_rate[1] = f32::NAN;
        assert!(!sensors.plausible() && !Sensors::ZERO.plausible());
        assert_eq!(observe(&sensors, 0.5, &chain.head_seen_from(0), None), [0.0; SIZE]);
    }
}
