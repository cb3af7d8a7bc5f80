//! How far a joint may go and how hard a motor may pull: pure functions, which [`crate::failsafe`] calls at every poll.
//!
//! Two say what is allowed, and the smaller counts: the policy image ([`Limits`], what the policy was trained with) and the node page of the module
//! ([`Caps`], [`JointRange`]: what its mechanics and motors bear). No policy can raise what the page says.
//!
//! # Ends of a joint
//!
//! Torque that pushes a joint outwards falls in a straight line over the last [`RAMP`] before the end and is zero from there on. Torque inwards is
//! always allowed. An encoder counts a single turn, so a joint pushed to 3.16 rad reads -3.12, and one pushed to 3.3 rad reads -2.98, which could be a good
//! angle. So the angle is followed from sample to sample by the short way ([`JointWatch`]), and 3.3 rad it is.
//!
//! A joint that is beyond an end when it is first read has no such past, and nobody knows which way leads back. Fault 46 then keeps the whole module
//! relaxed until somebody has brought it back.

use core::f32::consts::{PI, TAU};

use composer_shared::observation::Sensors;
use composer_shared::robot::{AXES, Limits, MAX_JOINTS, slew};
use serde::{Deserialize, Serialize};

/// How far before its end a joint gets less outward torque, rad; a quarter of the range where that is less.
pub const RAMP: f32 = 0.1;

/// Readings beyond this are no angles of a joint, rad: two turns.
const ABSURD: f32 = 2.0 * TAU;
/// No joint goes so far beyond its end, rad: a reading that says so is wrong, or those before were.
const OVERSHOOT: f32 = 1.0;
/// So many of them in a row, and those before were.
const ANEW_AFTER: u8 = 100;

/// Where a joint may be, rad.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct JointRange {
    /// Least angle.
    pub min: f32,
    /// Greatest angle.
    pub max: f32,
}

impl JointRange {
    /// All that an encoder of a single turn can say.
    pub const TURN: JointRange = JointRange { min: -PI, max: PI };

    /// What lies in this range and within `limit` of straight.
    pub fn within(self, limit: f32) -> Self {
        JointRange { min: self.min.max(-limit), max: self.max.min(limit) }
    }

    fn contains(self, angle: f32) -> bool {
        angle >= self.min && angle <= self.max
    }

    /// How far an angle lies beyond an end, rad; 0 between them.
    fn overshoot(self, angle: f32) -> f32 {
        (angle - self.max).max(self.min - angle).max(0.0)
    }
}

/// The angle that reads like `reading` and is nearest to `near`, rad.
fn unwrapped(reading: f32, near: f32) -> f32 {
    let way = reading - near;
    // Nearly always: rounding is dear on a processor that cannot.
    if way.abs() <= PI { reading } else { near + (way - TAU * libm::roundf(way / TAU)) }
}

/// An end of a joint's range.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum End {
    /// The least angle.
    Min,
    /// The greatest angle.
    Max,
}

/// Follows one joint from sample to sample.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct JointWatch {
    /// Its last known angle, rad, however many turns that is.
    angle: Option<f32>,
    /// The last reading was no angle, or none that can be.
    lost: bool,
    /// Readings in a row that cannot be.
    wrong: u8,
    /// It is beyond an end.
    beyond: bool,
    /// A true sample was seen.
    started: bool,
    /// It was beyond an end in the first true sample, and has been ever since.
    started_beyond: bool,
}

impl JointWatch {
    /// Takes the next reading (rad) of a joint with this range. `true_sample`: the sample that it belongs to can be believed
    /// ([`Sensors::plausible`]); others are followed, but are no start.
    pub fn follow(&mut self, range: JointRange, reading: f32, true_sample: bool) {
        self.lost = reading.is_nan() || reading.abs() > ABSURD;
        if self.lost {
            return;
        }
        let starts = true_sample && !self.started;
        let anew = unwrapped(reading, (range.min + range.max) / 2.0);
        let followed = self.angle.filter(|_| !starts).map(|before| unwrapped(reading, before));
        let wrong = followed.is_some_and(|angle| range.overshoot(angle) > OVERSHOOT);
        self.wrong = if wrong { self.wrong.saturating_add(1) } else { 0 };
        if wrong && self.wrong < ANEW_AFTER {
            self.lost = true;
            return;
        }
        let angle = followed.filter(|_| !wrong).unwrap_or(anew);
        self.angle = Some(angle);
        self.beyond = !range.contains(angle);
        self.started_beyond = self.beyond && (starts || self.started_beyond);
        self.started |= true_sample;
    }

    /// Whether the same reading once more would change nothing.
    fn settled(&self) -> bool {
        self.started && !self.lost
    }

    /// Whether the joint is beyond an end.
    pub fn beyond(&self) -> bool {
        self.beyond
    }

    /// Whether it has been there since it was first read.
    pub fn started_beyond(&self) -> bool {
        self.started_beyond
    }

    /// The part (0 to 1) of a torque of this sign that the joint bears.
    pub fn allows(&self, range: JointRange, outward: End) -> f32 {
        let Some(angle) = self.angle.filter(|_| !self.lost) else {
            // Nobody knows which way is out.
            return 0.0;
        };
        let rest = match outward {
            End::Min => angle - range.min,
            End::Max => range.max - angle,
        };
        let ramp = RAMP.min((range.max - range.min) / 4.0);
        if rest >= ramp { 1.0 } else { (rest / ramp).max(0.0) }
    }
}

/// All joints of a module.
#[derive(Clone, Debug)]
pub struct Joints {
    ranges: [JointRange; MAX_JOINTS],
    watches: [JointWatch; MAX_JOINTS],
    /// The angles that were followed last, if there is nothing more to be learned from the same ones.
    last: Option<[f32; MAX_JOINTS]>,
    /// All joints bear all torques.
    free: bool,
}

impl Joints {
    /// Joints that were not read yet. `policy` is how far from straight the policy's robot may bend a joint, rad.
    pub fn new(ranges: [JointRange; MAX_JOINTS], policy: f32) -> Self {
        let ranges = ranges.map(|range| range.within(policy));
        Joints { ranges, watches: [JointWatch::default(); MAX_JOINTS], last: None, free: false }
    }

    /// Takes the latest sample. Answers whether it says anything new: frames come faster than samples.
    #[inline]
    pub fn follow(&mut self, sensors: &Sensors) -> bool {
        let differ = |last: &[f32; MAX_JOINTS]| {
            last.iter().zip(&sensors.joint_angles).fold(0, |differ, (a, b)| differ | (a.to_bits() ^ b.to_bits()))
        };
        if self.last.as_ref().is_some_and(|last| differ(last) == 0) {
            return false;
        }
        self.follow_news(sensors);
        true
    }

    fn follow_news(&mut self, sensors: &Sensors) {
        let believed = sensors.plausible();
        for ((watch, range), angle) in self.watches.iter_mut().zip(self.ranges).zip(sensors.joint_angles) {
            watch.follow(range, angle, believed);
        }
        let settled = believed && self.watches.iter().all(JointWatch::settled);
        self.last = settled.then_some(sensors.joint_angles);
        let ends = [End::Min, End::Max];
        let mut joints = self.watches.iter().zip(self.ranges);
        self.free = joints.all(|(watch, range)| ends.iter().all(|end| watch.allows(range, *end) >= 1.0));
    }

    /// Whether all joints bear all torques.
    #[inline]
    pub fn free(&self) -> bool {
        self.free
    }

    /// Whether a joint is beyond an end.
    pub fn beyond(&self) -> bool {
        self.watches.iter().any(JointWatch::beyond)
    }

    /// Whether a joint has been beyond an end since it was first read.
    pub fn started_beyond(&self) -> bool {
        self.watches.iter().any(JointWatch::started_beyond)
    }

    /// The torques (yaw, pitch) that the joints bear of those wanted. Even joints yaw, odd joints pitch; of the joints of an axis the one that bears
    /// least counts.
    pub fn limit(&self, torque: [f32; AXES]) -> [f32; AXES] {
        if self.free {
            return torque;
        }
        let mut limited = torque;
        for (axis, torque) in limited.iter_mut().enumerate() {
            let outward = if *torque < 0.0 { End::Min } else { End::Max };
            let own = self.watches.iter().zip(self.ranges).skip(axis).step_by(AXES);
            let part = own.fold(1.0f32, |part, (watch, range)| part.min(watch.allows(range, outward)));
            // Not `*= part`: that would make a zero out of what is no number only by chance.
            *torque = if part >= 1.0 { *torque } else { *torque * part };
        }
        limited
    }
}

/// What the module itself bears, whatever the policy says; the smaller of both counts.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Caps {
    /// Largest torque of a motor, in the robot's torque unit.
    pub torque: f32,
    /// Fastest change of a torque, per second.
    pub torque_slew: f32,
    /// Motor temperature above which the module relaxes, degrees Celsius.
    pub temperature: f32,
}

impl Caps {
    /// No smaller than any policy.
    pub const NONE: Caps = Caps { torque: f32::INFINITY, torque_slew: f32::INFINITY, temperature: f32::INFINITY };

    /// The largest torque, the policy's or the module's.
    pub fn torque_limit(&self, policy: &Limits) -> f32 {
        smaller(policy.torque, self.torque)
    }

    /// The temperature above which the module relaxes, degrees Celsius.
    pub fn temperature_limit(&self, policy: &Limits) -> f32 {
        smaller(policy.temperature, self.temperature)
    }

    /// The torque to command after `previous`, when the policy wants `action` (-1 to 1, of the *policy's* torque limit) and `seconds` passed.
    /// An action that is not a number counts as zero.
    pub fn command(&self, policy: &Limits, previous: f32, action: f32, seconds: f32) -> f32 {
        let most = self.torque_limit(policy);
        let action = if action.is_nan() { 0.0 } else { action.clamp(-1.0, 1.0) };
        let wanted = (action * policy.torque).max(-most).min(most);
        let step = smaller(policy.torque_slew, self.torque_slew) * seconds;
        // The command itself stays within the limit even if `previous` was not.
        slew(previous, wanted, step).max(-most).min(most)
    }
}

/// The smaller of two limits; what is not a number allows nothing.
fn smaller(a: f32, b: f32) -> f32 {
    if a.is_nan() || b.is_nan() { 0.0 } else { a.min(b) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const RANGE: JointRange = JointRange { min: -1.5, max: 3.1 };

    fn sample(angle: f32) -> Sensors {
        Sensors { joint_angles: [angle; MAX_JOINTS], up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO }
    }

    fn joints() -> Joints {
        Joints::new([RANGE; MAX_JOINTS], 3.1)
    }

    /// What an encoder of a single turn says.
    fn read(angle: f32) -> f32 {
        angle - TAU * libm::roundf(angle / TAU)
    }

    #[test]
    fn a_joint_pushed_across_pi_stays_outside_and_only_inward_torque_brings_it_back() {
        let mut joints = joints();
        for true_angle in [2.0, 3.0, 3.09, 3.12, 3.15, 3.16, 3.3, 3.5, 3.16] {
            joints.follow(&sample(read(true_angle)));
            let [outward, _] = joints.limit([40.0, 0.0]);
            let [inward, _] = joints.limit([-40.0, 0.0]);
            assert_eq!(joints.beyond(), true_angle > 3.1, "{true_angle}");
            assert_eq!(inward, -40.0, "{true_angle}");
            if true_angle >= 3.1 {
                assert_eq!(outward, 0.0, "{true_angle} reads {}", read(true_angle));
            }
            assert!(!joints.started_beyond());
        }
        joints.follow(&sample(3.0));
        assert!(!joints.beyond());
        assert!((joints.limit([40.0, 0.0])[0] - 40.0).abs() < 1e-3, "0.1 rad before the end all is allowed again");
    }

    #[test]
    fn minimum_and_maximum_differ_from_joint_to_joint_and_the_policys_may_be_smaller() {
        let mut ranges = [JointRange::TURN; MAX_JOINTS];
        ranges[2] = JointRange { min: -0.5, max: 1.0 };
        let mut joints = Joints::new(ranges, 2.0);
        let mut angles = sample(0.0);
        for (joint, angle, limited) in [
            (0, 1.85, [40.0, 40.0]),
            (0, 2.05, [0.0, 40.0]),
            (1, 2.05, [40.0, 0.0]),
            (2, 0.95, [20.0, 40.0]),
            (2, 1.05, [0.0, 40.0]),
            (3, 1.05, [40.0, 40.0]),
        ] {
            angles.joint_angles = [0.0; MAX_JOINTS];
            joints.follow(&angles);
            angles.joint_angles[joint] = angle;
            joints.follow(&angles);
            let got = joints.limit([40.0; AXES]);
            assert!(got.iter().zip(limited).all(|(a, b)| (a - b).abs() < 1e-3), "joint {joint} at {angle}: {got:?}");
        }
    }

    #[test]
    fn outward_torque_falls_in_a_line_before_the_end() {
        let mut joints = joints();
        for (angle, up, down) in
            [(2.9, 1.0, 1.0), (3.05, 0.5, 1.0), (3.09, 0.1, 1.0), (-1.45, 1.0, 0.5), (-1.5, 1.0, 0.0)]
        {
            joints.follow(&sample(0.5));
            joints.follow(&sample(angle));
            assert!((joints.limit([80.0, 0.0])[0] - 80.0 * up).abs() < 0.02, "{angle}");
            assert!((joints.limit([-80.0, 0.0])[0] + 80.0 * down).abs() < 0.02, "{angle}");
        }
        let narrow = JointRange { min: -0.1, max: 0.1 };
        let mut joints = Joints::new([narrow; MAX_JOINTS], 3.1);
        joints.follow(&sample(0.0));
        assert_eq!(joints.limit([80.0, -80.0]), [80.0, -80.0], "a narrow range still has a middle without a ramp");
    }

    #[test]
    fn starting_outside_a_limit_is_a_fault_of_its_own_until_it_is_inside() {
        let mut joints = joints();
        // Samples that cannot be believed are no start: all zeros before the sensors were read, a dead gyroscope.
        joints.follow(&Sensors::ZERO);
        joints.follow(&Sensors { up: [0.0; 3], ..sample(-2.0) });
        assert!(!joints.started_beyond());
        joints.follow(&sample(-2.0));
        assert!(joints.beyond() && joints.started_beyond());
        joints.follow(&sample(f32::NAN));
        assert!(joints.started_beyond(), "not to know does not end it");
        joints.follow(&sample(-1.4));
        assert!(!joints.beyond() && !joints.started_beyond());
        joints.follow(&sample(-1.6));
        assert!(joints.beyond() && !joints.started_beyond(), "it went there later");
    }

    #[test]
    fn one_wrong_reading_is_forgotten_with_the_next_right_one() {
        for wrong in [-3.1, -2.0, -1.0, 0.0, 1.0, 3.1] {
            let mut joints = Joints::new([JointRange { min: -3.1, max: 3.1 }; MAX_JOINTS], 3.1);
            for reading in [2.5, 2.6, wrong, 2.6] {
                joints.follow(&sample(reading));
            }
            assert!(!joints.beyond(), "{wrong}");
            assert_eq!(joints.limit([40.0, -40.0]), [40.0, -40.0], "{wrong}");
        }
    }

    #[test]
    fn a_joint_that_nobody_knows_gets_no_torque_and_keeps_its_end() {
        let mut joints = joints();
        assert_eq!(joints.limit([40.0, -40.0]), [0.0, 0.0]);
        joints.follow(&sample(3.0));
        joints.follow(&sample(3.12));
        for lost in [f32::NAN, f32::INFINITY, 1e30] {
            joints.follow(&sample(lost));
            assert_eq!(joints.limit([40.0, -40.0]), [0.0, 0.0]);
        }
        joints.follow(&sample(read(3.2)));
        assert_eq!(joints.limit([40.0, 0.0])[0], 0.0);
        assert_eq!(joints.limit([-40.0, 0.0])[0], -40.0);
    }

    #[test]
    fn a_policy_cannot_raise_what_the_module_bears_and_the_module_not_what_the_policy_does() {
        let policy = Limits { torque: 80.0, torque_slew: 800.0, temperature: 120.0, ..Limits::default() };
        let caps = Caps { torque: 50.0, torque_slew: 400.0, temperature: 70.0 };
        assert_eq!(caps.command(&policy, 0.0, 1.0, 0.05), 20.0);
        assert_eq!(caps.command(&policy, 45.0, 1.0, 0.05), 50.0);
        assert_eq!(caps.command(&policy, 70.0, 1.0, 0.001), 50.0, "at once, even if it was more");
        assert_eq!(caps.command(&policy, 0.0, 0.1, 0.05), 8.0, "an action means the same as without the cap");
        assert_eq!(caps.temperature_limit(&policy), 70.0);
        let wide = Caps { torque: 1e3, torque_slew: 1e4, temperature: 200.0 };
        assert_eq!(wide.command(&policy, 0.0, 1.0, 0.05), 40.0);
        assert_eq!((wide.torque_limit(&policy), wide.temperature_limit(&policy)), (80.0, 120.0));
        let broken = Caps { torque: f32::NAN, ..wide };
        assert_eq!(broken.command(&policy, 0.0, 1.0, 0.05), 0.0);
    }

    proptest! {
        /// Without caps a command is the policy's, bit for bit.
        #[test]
        fn without_caps_nothing_changes(previous in -80.0f32..80.0, action in -1.5f32..1.5, seconds in 0.0f32..0.2) {
            let policy = Limits::default();
            let expected = policy.command(previous, action, seconds);
            prop_assert_eq!(Caps::NONE.command(&policy, previous, action, seconds).to_bits(), expected.to_bits());
        }

        /// Whatever way a joint takes, as long as it is no faster than half a turn between two samples: no outward torque beyond an end.
        #[test]
        fn no_outward_torque_beyond_an_end(min in -3.1f32..-0.5, max in 0.5f32..3.1, steps in proptest::collection::vec(-1.0f32..1.0, 1..200)) {
            let mut joints = Joints::new([JointRange { min, max }; MAX_JOINTS], 3.1);
            let mut angle: f32 = 0.0;
            joints.follow(&sample(angle));
            for step in steps {
                // The mechanics end somewhere beyond the limit.
                angle = (angle + step).clamp(min - 0.9, max + 0.9);
                joints.follow(&sample(read(angle)));
                let [up, _] = joints.limit([80.0, 0.0]);
                let [down, _] = joints.limit([-80.0, 0.0]);
                // Rounding may move the end by a little.
                prop_assert!(angle <= max + 1e-5 || up == 0.0, "{angle}: {up}");
                prop_assert!(angle >= min - 1e-5 || down == 0.0, "{angle}: {down}");
                prop_assert!(angle < max || down == -80.0, "inwards from {angle}: {down}");
                prop_assert!(angle > min || up == 80.0, "inwards from {angle}: {up}");
            }
        }

        /// Anything at all: never more than was wanted, never another direction, never what is no number out of a number.
        #[test]
        fn whatever_is_read(readings in proptest::collection::vec(any::<f32>(), 1..50), torque in -PI..PI) {
            let mut joints = joints();
            for reading in readings {
                joints.follow(&sample(reading));
                for limited in joints.limit([torque; AXES]) {
                    prop_assert!(limited.abs() <= torque.abs() && limited * torque >= 0.0);
                }
            }
        }
    }
}
