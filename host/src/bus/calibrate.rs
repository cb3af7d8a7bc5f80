//! Calibration of a module on the bench: how its inertial sensor sits, where its joints are straight, which way its motors and encoders turn, and
//! how far its joints go.
//!
//! Nothing here is kept: the registers of the node page are written, and `store` keeps them. All of it is refused by a module that is armed.

use composer_shared::registers::{Name, Register};
use composer_shared::robot::MAX_JOINTS;
use composer_shared::wire::Operation;
use std::time::Duration;

use super::BusError;
use super::station::Station;

/// A vector in the axes of the chip or of the module.
pub type Vector = [f32; 3];
/// A rotation, row by row: from the axes of the chip to those of the module.
pub type Rotation = [[f32; 3]; 3];

/// Readings that a measurement is the mean of.
const READINGS: usize = 12;
/// How far the length of gravity may be from 1 g.
const GRAVITY_OFF: f32 = 0.1;
/// How much a reading may move while it is taken, g.
const RESTLESS: f32 = 0.05;
/// How far from a right angle two poses may be, rad (10 degrees).
const SKEW: f32 = 0.175;
/// The largest correction of a mounting that one pose can give, rad (45 degrees): beyond, it is rather another mounting.
const LEVEL_MOST: f32 = 0.785;
/// Steps of an encoder in a turn.
const STEPS: i32 = 16384;
/// How far an encoder must move in a jog to be said to move, steps (0.9 degrees).
const MOVED: i32 = 40;
/// What an encoder without a reading says.
const NO_READING: u32 = u32::MAX;

fn refuse<T>(reason: impl Into<String>) -> Result<T, BusError> {
    Err(BusError::Refusal(reason.into()))
}

fn dot(a: Vector, b: Vector) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

fn cross(a: Vector, b: Vector) -> Vector {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn scaled(a: Vector, by: f32) -> Vector {
    a.map(|x| x * by)
}

fn unit(a: Vector) -> Vector {
    scaled(a, 1.0 / dot(a, a).sqrt())
}

fn applied(rotation: &Rotation, v: Vector) -> Vector {
    rotation.map(|row| dot(row, v))
}

fn transposed(m: &Rotation) -> Rotation {
    [0, 1, 2].map(|i| [m[0][i], m[1][i], m[2][i]])
}

fn product(a: &Rotation, b: &Rotation) -> Rotation {
    let columns = transposed(b);
    a.map(|row| columns.map(|column| dot(row, column)))
}

/// The angle by which one rotation has to be turned to be the other, rad.
pub fn angle_between(a: &Rotation, b: &Rotation) -> f32 {
    let between = product(a, &transposed(b));
    let trace = between[0][0] + between[1][1] + between[2][2];
    ((trace - 1.0) / 2.0).clamp(-1.0, 1.0).acos()
}

/// The mounting of an inertial sensor from what it feels in two poses: the module flat, its z axis up; and the module on its tail, its x axis (to the
/// head) up. The first counts fully, the second for the direction around it.
pub fn mounting(flat: Vector, nose_up: Vector) -> Result<Rotation, BusError> {
    for (pose, force) in [("flat", flat), ("nose up", nose_up)] {
        gravity(force).or_else(|error| refuse(format!("pose \"{pose}\": {error}")))?;
    }
    let z = unit(flat);
    let between = dot(z, unit(nose_up)).clamp(-1.0, 1.0).acos();
    let skew = between - std::f32::consts::FRAC_PI_2;
    if skew.abs() > SKEW {
        return refuse(format!(
            "between the two poses lie {:.0} degrees instead of 90: lay the module flat, then stand it up on its tail, the head end above",
            between.to_degrees()
        ));
    }
    let x = unit(nose_up);
    let x = unit([0, 1, 2].map(|i| x[i] - dot(x, z) * z[i]));
    Ok([x, cross(z, x), z])
}

/// The mounting that a module that lies flat has, if `before` is about right: turned by the least angle that brings what it feels upright.
pub fn levelled(before: &Rotation, flat: Vector) -> Result<Rotation, BusError> {
    gravity(flat)?;
    let felt = unit(applied(before, flat));
    let angle = felt[2].clamp(-1.0, 1.0).acos();
    if angle > LEVEL_MOST {
        return refuse(format!(
            "by its mounting the module lies {:.0} degrees off level: lay it flat, or find the mounting by two poses (calibrate N imu)",
            angle.to_degrees()
        ));
    }
    let axis = cross(felt, [0.0, 0.0, 1.0]);
    let length = dot(axis, axis).sqrt();
    if length < 1e-6 {
        return Ok(*before);
    }
    // Rodrigues' formula.
    let [x, y, z] = scaled(axis, 1.0 / length);
    let (s, c) = angle.sin_cos();
    let turn = [
        [c + x * x * (1.0 - c), x * y * (1.0 - c) - z * s, x * z * (1.0 - c) + y * s],
        [y * x * (1.0 - c) + z * s, c + y * y * (1.0 - c), y * z * (1.0 - c) - x * s],
        [z * x * (1.0 - c) - y * s, z * y * (1.0 - c) + x * s, c + z * z * (1.0 - c)],
    ];
    let [a, b, _] = product(&turn, before);
    // Rounding must not add up over many calibrations.
    let a = unit(a);
    let b = unit([0, 1, 2].map(|i| b[i] - dot(a, b) * a[i]));
    Ok([a, b, cross(a, b)])
}

/// Whether this can be gravity.
fn gravity(force: Vector) -> Result<(), BusError> {
    let length = dot(force, force).sqrt();
    if length.is_finite() && (length - 1.0).abs() <= GRAVITY_OFF {
        return Ok(());
    }
    refuse(format!("the sensor feels {length:.2} g instead of 1 g: is the module at rest, and the sensor whole?"))
}

/// The middle of encoder readings, which wrap at a turn.
pub fn middle(readings: &[u16]) -> Option<u16> {
    let first = i32::from(*readings.first()?);
    let off = |reading: &u16| (i32::from(*reading) - first + STEPS / 2).rem_euclid(STEPS) - STEPS / 2;
    let sum: i32 = readings.iter().map(off).sum();
    let mean = (sum as f32 / readings.len() as f32).round() as i32;
    Some((first + mean).rem_euclid(STEPS) as u16)
}

/// How far an encoder went, steps, the shorter way.
fn way(from: u16, to: u16) -> i32 {
    (i32::from(to) - i32::from(from) + STEPS / 2).rem_euclid(STEPS) - STEPS / 2
}

/// Which way something turned as people see it: the joint's positive direction is the rear to the left (yaw) or down (pitch).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Turned {
    /// The rear turned left, or down.
    Positive,
    /// The rear turned right, or up.
    Negative,
}

/// What a jog has shown of one axis.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Polarity {
    /// The motor's wires are swapped with regard to what the node page says.
    pub swap_motor: bool,
    /// Joints of the axis whose encoder counts the other way than the node page says.
    pub swap_encoder: [bool; MAX_JOINTS],
}

/// What follows from a jog with a torque that ought to turn the joints of an axis in the positive direction: which way they `turned` as people saw it, and
/// by how much each encoder has grown by the node page (steps; none: it did not move).
pub fn polarity(turned: Turned, grown: [Option<i32>; MAX_JOINTS]) -> Polarity {
    let positive = turned == Turned::Positive;
    Polarity {
        swap_motor: !positive,
        swap_encoder: grown.map(|steps| steps.is_some_and(|steps| (steps > 0) != positive)),
    }
}

/// Limits of a joint from the ends it was moved to, `margin` (rad) inside of them.
pub fn limits(low: f32, high: f32, margin: f32) -> Result<(f32, f32), BusError> {
    let (low_spec, high_spec) = (Register::JointMin.spec().range(), Register::JointMax.spec().range());
    let (low, high) = (low + margin, high - margin);
    if f64::from(low) > low_spec.1 || f64::from(high) < high_spec.0 {
        return refuse(format!(
            "the joint goes from {:.2} to {:.2} rad, less its margin of {margin} rad: it must go past {} and {} rad around its zero; is it zeroed, and free?",
            low - margin,
            high + margin,
            low_spec.1 as f32,
            high_spec.0 as f32
        ));
    }
    Ok((low.max(low_spec.0 as f32), high.min(high_spec.1 as f32)))
}

/// A module on the bench.
pub struct Bench<'a> {
    station: &'a mut Station,
    node: u8,
}

/// An axis with its joints, by name.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub enum Axis {
    /// Joints 0 and 2.
    Yaw,
    /// Joints 1 and 3.
    Pitch,
}

impl Axis {
    /// Its number.
    pub fn index(self) -> u8 {
        self as u8
    }

    /// Its joints.
    pub fn joints(self) -> [u8; 2] {
        [self.index(), self.index() + 2]
    }
}

/// How a jog is driven.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Jog {
    /// Current as a part of the motor's largest; the module takes no more than half of it.
    pub part: f32,
    /// How long, at most 2 s.
    pub time: Duration,
}

impl Default for Jog {
    fn default() -> Self {
        Jog { part: 0.25, time: Duration::from_millis(500) }
    }
}

impl<'a> Bench<'a> {
    /// Module `node`.
    pub fn new(station: &'a mut Station, node: u8) -> Self {
        Bench { station, node }
    }

    fn read(&mut self, number: u8) -> Result<u32, BusError> {
        self.station.request(self.node, Operation::Read, number, 0)
    }

    fn float(&mut self, register: Register, offset: u8) -> Result<f32, BusError> {
        Ok(f32::from_bits(self.read(register.spec().first + offset)?))
    }

    fn write(&mut self, register: Register, offset: u8, bits: u32) -> Result<(), BusError> {
        let number = register.spec().first + offset;
        self.station.request(self.node, Operation::Write, number, bits).map(|_| ()).map_err(|error| match error {
            BusError::Refused { node, code, .. } => {
                BusError::Refused { node, what: format!("to write {}", Name(number)), code }
            }
            error => error,
        })
    }

    /// What the accelerometer feels at rest, g, in the axes of the chip.
    pub fn force(&mut self) -> Result<Vector, BusError> {
        let mut readings = Vec::new();
        for _ in 0..READINGS {
            readings.push([
                self.float(Register::Acceleration, 0)?,
                self.float(Register::Acceleration, 1)?,
                self.float(Register::Acceleration, 2)?,
            ]);
        }
        let mean = [0, 1, 2].map(|i| readings.iter().map(|reading| reading[i]).sum::<f32>() / READINGS as f32);
        let far = |reading: &Vector| reading.iter().zip(mean).any(|(a, b)| (a - b).abs() > RESTLESS || !a.is_finite());
        if readings.iter().any(far) {
            return refuse(format!(
                "module {} does not lie still, or its inertial sensor gives no readings",
                self.node
            ));
        }
        gravity(mean)?;
        Ok(mean)
    }

    fn mounting(&mut self) -> Result<Rotation, BusError> {
        let mut rows = [[0.0; 3]; 3];
        for (i, value) in (0..).zip(rows.iter_mut().flatten()) {
            *value = self.float(Register::ImuMounting, i)?;
        }
        Ok(rows)
    }

    fn set_mounting(&mut self, rows: &Rotation) -> Result<(), BusError> {
        (0..).zip(rows.as_flattened()).try_for_each(|(i, value)| self.write(Register::ImuMounting, i, value.to_bits()))
    }

    /// The module lies flat: corrects the mounting of its inertial sensor. Gives the correction, rad.
    pub fn level(&mut self) -> Result<f32, BusError> {
        let (before, force) = (self.mounting()?, self.force()?);
        let after = levelled(&before, force)?;
        self.set_mounting(&after)?;
        Ok(angle_between(&before, &after))
    }

    /// The mounting of its inertial sensor from two poses; `pose` is called before each is measured, with what is to be done. Gives how far it is from what the
    /// module had, rad.
    pub fn imu(&mut self, mut pose: impl FnMut(&str) -> Result<(), BusError>) -> Result<f32, BusError> {
        let before = self.mounting()?;
        pose("lay the module flat, its upper side up")?;
        let flat = self.force()?;
        pose("stand it on its tail, the head end up")?;
        let after = mounting(flat, self.force()?)?;
        self.set_mounting(&after)?;
        Ok(angle_between(&before, &after))
    }

    fn encoder(&mut self, joint: u8) -> Result<Option<u16>, BusError> {
        let mut readings = Vec::new();
        for _ in 0..READINGS / 4 {
            match self.read(Register::EncoderRaw.spec().first + joint)? {
                NO_READING => return Ok(None),
                reading => readings.push(reading as u16),
            }
        }
        Ok(middle(&readings))
    }

    /// The joints are straight, as they are: makes that their zero. Gives each with its old and new reading.
    pub fn zero(&mut self, joints: &[u8]) -> Result<Vec<(u8, u16, u16)>, BusError> {
        let mut zeroed = Vec::new();
        for &joint in joints {
            let Some(now) = self.encoder(joint)? else {
                return refuse(format!(
                    "the encoder of joint {joint} of module {} gives no reading: is its magnet in place, and its cable?",
                    self.node
                ));
            };
            let before = self.read(Register::EncoderZero.spec().first + joint)? as u16;
            zeroed.push((joint, before, now));
        }
        for (joint, _, now) in &zeroed {
            self.write(Register::EncoderZero, *joint, u32::from(*now))?;
        }
        Ok(zeroed)
    }

    /// Drives an axis with a current in the direction that the node page calls positive (or the other), and returns at once.
    fn push(&mut self, axis: Axis, jog: Jog, positive: bool) -> Result<(), BusError> {
        let largest = self.float(Register::CurrentLimit, axis.index())?;
        let constant = self.float(Register::TorqueConstant, axis.index())?;
        // A positive torque.
        let sign = if (constant > 0.0) == positive { 1.0 } else { -1.0 };
        let milliamps = (sign * jog.part * largest * 1000.0).round() as i16;
        let value = u32::from(milliamps as u16) | (jog.time.as_millis().min(2000) as u32) << 16;
        self.station.request(self.node, Operation::Jog, axis.index(), value).map(|_| ())
    }

    /// Drives an axis for some time, and gives by how much each of its joints has gone at most, rad, by the node page.
    pub fn jog(&mut self, axis: Axis, jog: Jog, positive: bool) -> Result<[f32; 2], BusError> {
        let joints = axis.joints();
        let before = [self.float(Register::JointAngle, joints[0])?, self.float(Register::JointAngle, joints[1])?];
        self.push(axis, jog, positive)?;
        let end = self.station.now() + jog.time;
        let mut most = [0.0f32; 2];
        while self.station.now() < end {
            for k in 0..2 {
                let way = self.float(Register::JointAngle, joints[k])? - before[k];
                if way.abs() > most[k].abs() {
                    most[k] = way;
                }
            }
        }
        Ok(most)
    }

    /// Waits until joints rest, a limited time.
    fn settle(&mut self, joints: [u8; 2]) -> Result<(), BusError> {
        const LONGEST: Duration = Duration::from_secs(3);
        let (start, number) = (self.station.now(), Register::EncoderRaw.spec().first);
        let mut last = [0; 2];
        loop {
            let now = [self.read(number + joints[0])?, self.read(number + joints[1])?];
            let still = now.iter().zip(last).all(|(now, last)| way(last as u16, *now as u16).abs() < MOVED / 6);
            if still || self.station.now() - start > LONGEST {
                return Ok(());
            }
            last = now;
            self.station.pause(Duration::from_millis(100))?;
        }
    }

    /// Which way motor and encoders of an axis turn: drives it in what ought to be the positive direction, asks `see` which way it turned, and writes what follows.
    pub fn polarity(
        &mut self,
        axis: Axis,
        jog: Jog,
        see: impl FnOnce() -> Result<Turned, BusError>,
    ) -> Result<Polarity, BusError> {
        let joints = axis.joints();
        self.settle(joints)?;
        let (mut before, mut reversed) = ([None; MAX_JOINTS], [false; MAX_JOINTS]);
        for joint in joints {
            before[usize::from(joint)] = self.encoder(joint)?;
            reversed[usize::from(joint)] = self.read(Register::EncoderReversed.spec().first + joint)? != 0;
        }
        self.push(axis, jog, true)?;
        // Of the second half of the jog, when the joints have got going.
        self.station.pause(jog.time / 2)?;
        let end = self.station.now() + jog.time / 2;
        let mut ways: [Vec<i32>; MAX_JOINTS] = Default::default();
        while self.station.now() < end {
            for joint in joints {
                let k = usize::from(joint);
                let raw = self.read(Register::EncoderRaw.spec().first + joint)?;
                if let Some(before) = before[k].filter(|_| raw != NO_READING) {
                    ways[k].push(way(before, raw as u16) * if reversed[k] { -1 } else { 1 });
                }
            }
        }
        let grown = ways.map(|ways| {
            let mean = ways.iter().sum::<i32>() / ways.len().max(1) as i32;
            (mean.abs() >= MOVED).then_some(mean)
        });
        if grown == [None; MAX_JOINTS] {
            return refuse(format!(
                "no encoder of the {} axis of module {} moved: is the motor powered and connected, and a quarter of its current enough? (--current)",
                format!("{axis:?}").to_lowercase(),
                self.node
            ));
        }
        let found = polarity(see()?, grown);
        if found.swap_motor {
            let constant = self.float(Register::TorqueConstant, axis.index())?;
            self.write(Register::TorqueConstant, axis.index(), (-constant).to_bits())?;
        }
        for joint in joints {
            let k = usize::from(joint);
            if found.swap_encoder[k] {
                self.write(Register::EncoderReversed, joint, u32::from(!reversed[k]))?;
            }
        }
        Ok(found)
    }

    /// How far the joints of an axis go: drives it both ways, gently and in short pushes, until it goes no further or past `guard` (rad), and writes limits `margin`
    /// (rad) inside. Gives the limits of each joint that moved.
    pub fn range(&mut self, axis: Axis, jog: Jog, guard: f32, margin: f32) -> Result<Vec<(u8, f32, f32)>, BusError> {
        let joints = axis.joints();
        let mut ends = [[0.0f32; 2]; 2];
        for (k, joint) in joints.into_iter().enumerate() {
            ends[k] = [self.float(Register::JointAngle, joint)?; 2];
        }
        for positive in [false, true] {
            let (start, longest) = (self.station.now(), Duration::from_secs(20));
            let mut moved = start;
            let mut pushed: Option<Duration> = None;
            let mut from = [0.0; 2];
            for (from, joint) in from.iter_mut().zip(joints) {
                *from = self.float(Register::JointAngle, joint)?;
            }
            let mut furthest = [0.0f32; 2];
            // It has found its end if it did not go on for a whole push.
            while self.station.now() - moved < jog.time && self.station.now() - start < longest {
                // The next push begins before the last one ends, so that the joint does not spring back.
                if pushed.is_none_or(|at| self.station.now() - at > jog.time / 2) {
                    self.push(axis, jog, positive)?;
                    pushed = Some(self.station.now());
                }
                for (k, joint) in joints.into_iter().enumerate() {
                    let angle = self.float(Register::JointAngle, joint)?;
                    if (angle - from[k]).abs() > furthest[k] + 0.005 {
                        furthest[k] = (angle - from[k]).abs();
                        moved = self.station.now();
                    }
                    let [low, high] = &mut ends[k];
                    (*low, *high) = (low.min(angle), high.max(angle));
                }
                if ends.as_flattened().iter().any(|end| end.abs() > guard) {
                    break;
                }
            }
            self.station.request(self.node, Operation::Jog, axis.index(), 0)?;
            self.station.pause(jog.time)?;
        }
        let mut found = Vec::new();
        for (k, joint) in joints.into_iter().enumerate() {
            let [low, high] = ends[k];
            // The last joint of the last module does not exist.
            if high - low > 0.01 || k == 0 {
                let (low, high) = limits(low, high, margin)?;
                found.push((joint, low, high));
            }
        }
        for (joint, low, high) in &found {
            self.write(Register::JointMin, *joint, low.to_bits())?;
            self.write(Register::JointMax, *joint, high.to_bits())?;
        }
        Ok(found)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::bus::Transport;
    use composer_firmware::controller::{Boot, BusKind, BusStatus, Config};
    use composer_firmware::emulated::Emulated;
    use composer_firmware::node_page::Calibration;
    use composer_firmware::update::NoPolicies;
    use composer_shared::observation::Sensors;
    use composer_shared::policy::{IMAGE_SIZE, Policy, random_image};
    use composer_shared::wire::Frame;
    use std::collections::VecDeque;
    use std::sync::{Arc, Mutex, OnceLock};

    const STRAIGHT: Rotation = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    /// A rotation about an axis.
    fn turn(axis: Vector, angle: f32) -> Rotation {
        let [x, y, z] = unit(axis);
        let (s, c) = angle.sin_cos();
        [
            [c + x * x * (1.0 - c), x * y * (1.0 - c) - z * s, x * z * (1.0 - c) + y * s],
            [y * x * (1.0 - c) + z * s, c + y * y * (1.0 - c), y * z * (1.0 - c) - x * s],
            [z * x * (1.0 - c) - y * s, z * y * (1.0 - c) + x * s, c + z * z * (1.0 - c)],
        ]
    }

    #[test]
    fn a_mounting_is_found_from_two_poses_whatever_it_is() {
        for k in 0..50 {
            let k = k as f32;
            let truth = turn([(k * 1.3).sin(), (k * 0.7).cos(), (k * 2.1).sin() + 0.1], 0.2 + k * 0.06);
            let back = transposed(&truth);
            // The module is not quite flat the second time, and the sensor's scale is a little off.
            let flat = scaled(applied(&back, [0.0, 0.0, 1.0]), 1.02);
            let nose_up = scaled(applied(&back, unit([1.0, 0.0, 0.05])), 0.97);
            let found = mounting(flat, nose_up).unwrap();
            assert!(angle_between(&found, &truth) < 2e-3, "{k}: {}", angle_between(&found, &truth));
        }
        for (flat, nose_up, word) in [
            ([0.0, 0.0, 1.0], [0.0, 0.0, 1.0], "0 degrees instead of 90"),
            ([0.0, 0.0, 0.5], [1.0, 0.0, 0.0], "pose \"flat\": the sensor feels 0.50 g"),
            ([0.0, 0.0, 1.0], [f32::NAN, 0.0, 0.0], "pose \"nose up\""),
        ] {
            let error = mounting(flat, nose_up).unwrap_err().to_string();
            assert!(error.contains(word), "{error}");
        }
    }

    #[test]
    fn a_mounting_is_levelled_from_one_pose() {
        for k in 0..30 {
            let k = k as f32;
            let tilt = turn([k.sin(), k.cos(), 0.0], 0.02 * k);
            let before = turn([1.0, 2.0, 3.0], k);
            // What is really so: the same mounting, a little tilted.
            let truth = product(&tilt, &before);
            let flat = applied(&transposed(&truth), [0.0, 0.0, 1.0]);
            let after = levelled(&before, flat).unwrap();
            let up = applied(&after, flat);
            assert!(dot(up, [0.0, 0.0, 1.0]) > 0.99999, "{k}: {up:?}");
            assert!((angle_between(&before, &after) - 0.02 * k).abs() < 2e-3, "no more than needed");
            assert!(angle_between(&product(&after, &transposed(&after)), &STRAIGHT) < 1e-3, "a rotation");
        }
        assert!(levelled(&STRAIGHT, [1.0, 0.0, 0.0]).unwrap_err().to_string().contains("90 degrees off level"));
    }

    #[test]
    fn readings_wrap() {
        assert_eq!(middle(&[16380, 4, 16382, 2]), Some(0));
        assert_eq!(middle(&[100, 102]), Some(101));
        assert_eq!(middle(&[]), None);
        assert_eq!((way(16380, 4), way(4, 16380), way(0, 8191)), (8, -8, 8191));
    }

    #[test]
    fn a_jog_tells_wires_and_encoders_apart() {
        let grown = [Some(200), None, Some(-200), None];
        let found = polarity(Turned::Positive, grown);
        assert_eq!((found.swap_motor, found.swap_encoder), (false, [false, false, true, false]));
        let found = polarity(Turned::Negative, grown);
        assert_eq!((found.swap_motor, found.swap_encoder), (true, [true, false, false, false]));
    }

    #[test]
    fn limits_lie_inside_of_the_ends_and_around_zero() {
        assert_eq!(limits(-1.25, 1.0, 0.25).unwrap(), (-1.0, 0.75));
        assert_eq!(limits(-3.15, 3.15, 0.02).unwrap(), (-3.1, 3.1));
        assert!(limits(0.2, 1.0, 0.05).unwrap_err().to_string().contains("is it zeroed, and free?"));
        assert!(limits(-0.05, 0.05, 0.05).is_err());
    }

    /// A module on a bench: its own controller and service, motors that turn its joints, ends that stop them, and somebody who lays it down.
    struct Rig {
        module: Emulated<'static, NoPolicies>,
        sensors: Arc<Mutex<Sensors>>,
        now_us: u64,
        inbox: VecDeque<Frame>,
        outbox: VecDeque<Frame>,
    }

    /// Where the joints end, rad.
    const ENDS: (f32, f32) = (-1.3, 1.1);

    impl Rig {
        fn step(&mut self) {
            self.now_us += 1000;
            let frame = self.inbox.pop_front();
            let mut sensors = self.sensors.lock().unwrap();
            let outputs = self.module.poll(self.now_us, &sensors, frame.as_ref(), BusStatus::ErrorActive);
            let torque = if outputs.motors_enabled { outputs.torque } else { [0.0; 2] };
            for (joint, angle) in sensors.joint_angles.iter_mut().enumerate() {
                // A full torque turns a joint by 3 rad/s.
                *angle = (*angle + torque[joint % 2] / 80.0 * 3.0 * 0.001).clamp(ENDS.0, ENDS.1);
            }
            self.outbox.extend(std::iter::from_fn(|| self.module.next_frame()));
        }
    }

    impl Transport for Rig {
        fn send(&mut self, frame: &Frame) -> Result<(), BusError> {
            self.inbox.push_back(*frame);
            Ok(())
        }

        fn receive(&mut self, patience: Duration) -> Result<Option<Frame>, BusError> {
            for _ in 0..=patience.as_millis() {
                if self.outbox.is_empty() {
                    self.step();
                }
            }
            Ok(self.outbox.pop_front())
        }

        fn fd(&self) -> bool {
            true
        }

        fn now(&self) -> Duration {
            Duration::from_micros(self.now_us)
        }
    }

    /// A module whose node page is wrong in everything that can be calibrated, and how its hardware really is.
    fn wrong() -> (Station, Arc<Mutex<Sensors>>, Calibration) {
        static IMAGE: OnceLock<[u8; IMAGE_SIZE]> = OnceLock::new();
        let image = IMAGE.get_or_init(|| {
            let mut image = [0; IMAGE_SIZE];
            random_image(3, &mut image);
            image
        });
        let policy = Policy::parse(image).unwrap();
        let mut truth = Calibration::NOMINAL;
        truth.imu_mounting =
            product(&turn([0.2, 1.0, 0.1], 0.1), &[[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]]);
        for (joint, zero) in truth.joints.iter_mut().zip([5000, 16380, 3, 9000]) {
            joint.zero = zero;
        }
        truth.joints[2].reversed = true;
        truth.motors[0].torque_constant *= -1.0;
        let mut module = Emulated::new(policy, NoPolicies);
        module.start(Config::new(0, 1, BusKind::Fd, &policy), Boot::default(), 0, Calibration::NOMINAL).unwrap();
        module.hardware().mounted = truth;
        let sensors = Sensors { up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO };
        let sensors = Arc::new(Mutex::new(sensors));
        let (inbox, outbox) = (VecDeque::new(), VecDeque::new());
        let mut rig = Rig { module, sensors: sensors.clone(), now_us: 0, inbox, outbox };
        (0..300).for_each(|_| rig.step());
        (Station::new(Box::new(rig)), sensors, truth)
    }

    /// Stores, restarts, and gives what the module senses then: joint angles, up.
    fn afterwards(station: &mut Station) -> ([f32; 4], Vector) {
        super::super::config::store(station, 0).unwrap();
        station.request(0, Operation::Restart, 0, 0).unwrap();
        station.pause(Duration::from_millis(400)).unwrap();
        let mut bench = Bench::new(station, 0);
        let angles = [0, 1, 2, 3].map(|joint| bench.float(Register::JointAngle, joint).unwrap());
        (angles, [0, 1, 2].map(|i| bench.float(Register::Up, i).unwrap()))
    }

    #[test]
    fn a_module_with_known_errors_is_calibrated_over_the_bus() {
        let (mut station, sensors, truth) = wrong();
        let mut bench = Bench::new(&mut station, 0);
        let by = bench
            .imu(|pose| {
                sensors.lock().unwrap().up = if pose.contains("tail") { [1.0, 0.0, 0.0] } else { [0.0, 0.0, 1.0] };
                Ok(())
            })
            .unwrap();
        assert!(by > 1.5, "{by}");
        assert!(angle_between(&bench.mounting().unwrap(), &truth.imu_mounting) < 1e-3);
        sensors.lock().unwrap().up = [0.0, 0.0, 1.0];
        let zeroed = bench.zero(&[0, 1, 2, 3]).unwrap();
        assert_eq!(zeroed.iter().map(|(.., now)| *now).collect::<Vec<_>>(), [5000, 16380, 3, 9000]);

        // Somebody watches which way the rear turns.
        for axis in [Axis::Yaw, Axis::Pitch] {
            let watch = || {
                let angle = sensors.lock().unwrap().joint_angles[usize::from(axis.index())];
                Ok(if angle > 0.0 { Turned::Positive } else { Turned::Negative })
            };
            let found = bench.polarity(axis, Jog::default(), watch).unwrap();
            let swapped = if axis == Axis::Yaw { (true, [false, false, true, false]) } else { (false, [false; 4]) };
            assert_eq!((found.swap_motor, found.swap_encoder), swapped, "{axis:?}");
        }
        let before = sensors.lock().unwrap().joint_angles;
        let (angles, up) = afterwards(&mut station);
        for (angle, truth) in angles.iter().zip(before) {
            assert!((angle - truth).abs() < 1e-3, "{angles:?} {before:?}");
        }
        assert!(up[2] > 0.9999, "{up:?}");

        // All is right now: what ought to turn left turns left, and the ends are found.
        let mut bench = Bench::new(&mut station, 0);
        let ways = bench.jog(Axis::Yaw, Jog::default(), false).unwrap();
        assert!(ways.iter().all(|way| *way < -0.05), "{ways:?}");
        for axis in [Axis::Yaw, Axis::Pitch] {
            let found = bench.range(axis, Jog::default(), 2.8, 0.05).unwrap();
            assert_eq!(found.len(), 2);
            for (joint, low, high) in found {
                assert!(
                    (low - ENDS.0 - 0.05).abs() < 2e-3 && (high - ENDS.1 + 0.05).abs() < 2e-3,
                    "{joint}: {low} {high}"
                );
            }
        }
        // And once more nothing is found to correct.
        let by = bench.level().unwrap();
        assert!(by < 2e-3, "{by}");
    }

    #[test]
    fn a_module_that_does_not_lie_still_does_not_move_or_is_armed_is_not_calibrated() {
        let (mut station, sensors, _) = wrong();
        sensors.lock().unwrap().up = [0.0, 0.0, 0.3];
        let mut bench = Bench::new(&mut station, 0);
        assert!(bench.level().unwrap_err().to_string().contains("0.30 g instead of 1 g"));
        sensors.lock().unwrap().up = [0.0, 1.0, 0.0];
        assert!(bench.level().unwrap_err().to_string().contains("degrees off level"));
        sensors.lock().unwrap().up = [0.0, 0.0, 1.0];
        // Blocked at both ends: it cannot move.
        sensors.lock().unwrap().joint_angles = [ENDS.0; 4];
        let still = bench.polarity(Axis::Yaw, Jog::default(), || unreachable!()).unwrap_err().to_string();
        assert!(still.contains("no encoder of the yaw axis of module 0 moved"), "{still}");
        sensors.lock().unwrap().joint_angles = [0.0; 4];
        station.request(0, Operation::Arm, 0, 0).unwrap();
        let mut bench = Bench::new(&mut station, 0);
        let armed = bench.zero(&[0]).unwrap_err().to_string();
        assert!(armed.contains("module 0 refuses to write encoder_zero_0: refused while armed"), "{armed}");
        let armed = bench.jog(Axis::Pitch, Jog::default(), true).unwrap_err().to_string();
        assert!(armed.contains("module 0 refuses JOG"), "{armed}");
    }
}
