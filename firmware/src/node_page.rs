//! The node page: what makes a module this one of the robot, and what was measured on its own hardware. It lies in a flash page of its own
//! ([`crate::memory_map`]), is written by the host (`snakectl flash`) and read by the board at power-up, so that all modules run the
//! same image and the same policy.
//!
//! # Layout, version 3
//!
//! 248 bytes, all numbers little-endian; `f32` is IEEE 754 binary32. "Not a number" and infinities lie outside of every range. Torque is in the robot's
//! torque unit.
//!
//! | offset | type | field | accepted |
//! |---|---|---|---|
//! | 0 | u8\[8\] | magic | the ASCII characters `COMPNODE` |
//! | 8 | u16 | layout version | 3 |
//! | 10 | u8 | number of this module, 0 is the head | 0 to modules - 1 |
//! | 11 | u8 | modules of the robot | 1 to 64 |
//! | 12 | u8 | after bus-off: 0 recover, 1 stay off until a restart | 0, 1 |
//! | 13 | u8 | while the sensors say what cannot be true: 0 relax, 1 act on zeros as the paper's observation fault does | 0, 1 |
//! | 14 | u16 | dead-man time, ms: so long without a frame of the station, and the module relaxes and disarms; 0 never | 0, 200 to 60000 |
//! | 16 + 12 j | u16 | encoder of joint j: what it reads when the joint is straight | 0 to 16383 |
//! | 18 + 12 j | u8 | encoder of joint j: 1 if it counts down while the joint angle grows | 0, 1 |
//! | 19 + 12 j | u8 | reserved | 0 |
//! | 20 + 12 j | f32 | least angle of joint j, rad | -3.1 to -0.05 |
//! | 24 + 12 j | f32 | greatest angle of joint j, rad | 0.05 to 3.1 |
//! | 64 | f32\[9\] | rotation from the axes of the inertial sensor to the module's own frame, row by row | a rotation |
//! | 100 | f32 | cap of the torque; the policy's limit counts where it is smaller | 0.001 to 1000000 |
//! | 104 | f32 | cap of the slew, torque per second; likewise | 0.001 to 100000000 |
//! | 108 | f32 | cap of the motor temperature, degrees Celsius; likewise | 30 to 150 |
//! | 112 | f32 | supply below which the motors relax, V | 6 to 60 |
//! | 116 | f32 | supply above which the motors relax, V | 1.2 times the lower one to 60 |
//! | 120 + 28 m | f32 | motor m (0 yaw, 1 pitch): torque units per ampere; negative if the wires are swapped | magnitude 0.001 to 1000000 |
//! | 124 + 28 m | f32 | largest current, A | 0.001 to 100 |
//! | 128 + 28 m | f32 | current that cuts the motor off, A | the largest current to 95 % of what the current sense can say in either direction |
//! | 132 + 28 m | f32 | winding resistance, ohm | 0.001 to 1000 |
//! | 136 + 28 m | f32 | winding inductance, H | 0.000001 to 1 |
//! | 140 + 28 m | f32 | current sense: A from one end of the converter's range to the other; negative if it is turned | magnitude 0.001 to 1000 |
//! | 144 + 28 m | f32 | current sense: reading without current, part of the range | 0 to 1 |
//! | 176 | u32 | reserved | 0 |
//! | 180 | u8\[32\] | key A: Ed25519 public key of who may change the policy; 0 none | all |
//! | 212 | u8\[32\] | key B, likewise: for the time in which keys are changed | all |
//! | 244 | u32 | CRC-32 (ISO-HDLC) of bytes 0 to 243 | |
//!
//! A joint may not be allowed all of half a turn: an encoder of a single turn could not tell its ends apart. Nor may the cut-off lie where the current sense
//! has no more readings: it could never happen.
//!
//! A module without a key takes policies that nobody signed, and says so in HEARTBEAT (`threat-model.md`).
//!
//! Version 1 had no limits, and version 2 no keys; pages of them are refused, because nobody said how far the joints of the module may go, or who may change its policy.

use core::fmt;

use composer_shared::CRC_32;
use composer_shared::robot::{AXES, MAX_JOINTS, MAX_MODULES};
use composer_shared::update::{KEY_SIZE, Key};

use crate::drivers::encoder::{JointCalibration, STEPS};
use crate::failsafe::BusOffPolicy;
use crate::limits::{Caps, JointRange};
use crate::safety::Safety;
use crate::supply::Thresholds;

/// Bytes of a node page; a multiple of 8, the least that the flash writes.
pub const SIZE: usize = 248;
/// Version of the layout that this code reads and writes.
pub const VERSION: u16 = 3;
/// The first bytes of every node page.
pub const MAGIC: [u8; 8] = *b"COMPNODE";

const VERSION_AT: usize = 8;
const NODE_AT: usize = 10;
const MODULES_AT: usize = 11;
const BUS_OFF_AT: usize = 12;
const BLIND_AT: usize = 13;
const DEAD_MAN_AT: usize = 14;
const JOINTS_AT: usize = 16;
const JOINT_SIZE: usize = 12;
const MOUNTING_AT: usize = JOINTS_AT + JOINT_SIZE * MAX_JOINTS;
const CAPS_AT: usize = MOUNTING_AT + 9 * 4;
const SUPPLY_AT: usize = CAPS_AT + 3 * 4;
const MOTORS_AT: usize = SUPPLY_AT + 2 * 4;
const MOTOR_SIZE: usize = 7 * 4;
const RESERVED_AT: usize = MOTORS_AT + MOTOR_SIZE * AXES;
const KEYS_AT: usize = RESERVED_AT + 4;
const CRC_AT: usize = KEYS_AT + 2 * KEY_SIZE;
const _: () = assert!(CRC_AT + 4 == SIZE);

/// How far the rows of a rotation may be from orthonormal.
const ORTHONORMAL: f32 = 1e-3;
/// How far a joint may be allowed to go, rad.
pub const FARTHEST: f32 = 3.1;
/// How far it must be allowed to go at least, rad.
const NEAREST: f32 = 0.05;
/// The part of what a current sense can say in which a cut-off must lie: noise must not hide it at the end.
const SENSIBLE: f32 = 0.95;
/// Below this supply the bridges of the board switch themselves off, V.
pub const LOWEST_SUPPLY: f32 = 6.0;

/// A motor and its current sense, as measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorCalibration {
    /// Torque per ampere, in the robot's torque unit, gear included. Negative if the wires are swapped.
    pub torque_constant: f32,
    /// Largest current, A.
    pub current_limit: f32,
    /// Current that cuts the motor off, A.
    pub cut_off: f32,
    /// Winding resistance, ohm.
    pub resistance: f32,
    /// Winding inductance, H.
    pub inductance: f32,
    /// Current from one end of the converter's range to the other, A.
    pub sense_range: f32,
    /// Reading without current, as a part of the converter's range.
    pub sense_zero: f32,
}

impl MotorCalibration {
    /// The current (A) for a reading as a part of the converter's range.
    pub fn current(&self, reading: f32) -> f32 {
        (reading - self.sense_zero) * self.sense_range
    }

    /// The largest current that the sense can say in both directions, A.
    pub fn measurable(&self) -> f32 {
        self.sense_range.abs() * self.sense_zero.min(1.0 - self.sense_zero)
    }
}

/// What was measured on the hardware of one module.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Calibration {
    /// How the encoders sit, head end first.
    pub joints: [JointCalibration; MAX_JOINTS],
    /// Rotation from the axes of the inertial sensor to the module's own frame, row by row.
    pub imu_mounting: [[f32; 3]; 3],
    /// Motors, yaw and pitch.
    pub motors: [MotorCalibration; AXES],
}

impl Calibration {
    /// What the board's parts say on paper, for hardware that nobody measured: encoders that were never zeroed, an inertial sensor that sits straight, gear
    /// motors of 80 torque units (0.2 N m) per ampere. `host/configs/calibration.toml` says the same in SI units; a test compares them.
    pub const NOMINAL: Calibration = Calibration {
        joints: [JointCalibration { zero: 0, reversed: false }; MAX_JOINTS],
        imu_mounting: [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]],
        motors: [MotorCalibration {
            torque_constant: 80.0,
            current_limit: 1.2,
            cut_off: 2.5,
            resistance: 4.0,
            inductance: 1e-3,
            sense_range: 6.6,
            sense_zero: 0.5,
        }; AXES],
    };
}

/// A node page, checked.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct NodePage {
    /// The module's number, 0 is the head.
    pub node: u8,
    /// Modules of the robot.
    pub modules: u8,
    /// What to do after bus-off.
    pub bus_off: BusOffPolicy,
    /// What it keeps to, whatever its policy wants.
    pub safety: Safety,
    /// What was measured.
    pub calibration: Calibration,
    /// Who may change its policy: Ed25519 public keys, or [`composer_shared::update::NO_KEY`].
    pub keys: [Key; 2],
}

/// Why a node page is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodePageError {
    /// The flash is erased: no module was made of this board yet.
    Empty,
    /// Fewer bytes than a node page has.
    TooShort {
        /// Bytes given.
        length: usize,
    },
    /// The first bytes are not [`MAGIC`].
    Magic,
    /// Another layout version.
    Version {
        /// The version it has.
        found: u16,
    },
    /// The checksum is not that of the bytes before it.
    Checksum {
        /// As stored.
        stored: u32,
        /// As computed.
        computed: u32,
    },
    /// A field with a value that cannot be.
    Value {
        /// What it is.
        field: &'static str,
        /// What is accepted.
        accepted: &'static str,
    },
}

impl fmt::Display for NodePageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match *self {
            Self::Empty => write!(f, "the node page is empty: write it with `snakectl flash --node N`"),
            Self::TooShort { length } => {
                write!(f, "the node page is cut short: it has {length} bytes where {SIZE} are needed")
            }
            Self::Magic => write!(f, "this is not a node page: it does not begin with COMPNODE"),
            Self::Version { found: 1 } => write!(
                f,
                "the node page has layout version 1, which says nothing of limits, and this build reads version {VERSION}: write it again with `snakectl flash`"
            ),
            Self::Version { found: 2 } => write!(
                f,
                "the node page has layout version 2, which says nothing of keys, and this build reads version {VERSION}: write it again with `snakectl flash`"
            ),
            Self::Version { found } => write!(
                f,
                "the node page has layout version {found}, this build reads version {VERSION}: write it again with `snakectl flash`"
            ),
            Self::Checksum { stored, computed } => {
                write!(f, "the node page is damaged: its CRC-32 should be {stored:08x} and is {computed:08x}")
            }
            Self::Value { field, accepted } => {
                write!(f, "the node page has a {field} that cannot be: accepted is {accepted}")
            }
        }
    }
}

impl core::error::Error for NodePageError {}

impl NodePage {
    /// Reads a node page from the flash region it lies in; bytes after it are ignored.
    pub fn parse(region: &[u8]) -> Result<Self, NodePageError> {
        let short = NodePageError::TooShort { length: region.len() };
        // An older page may be shorter, and should be called old.
        if let Some([magic @ .., low, high]) = region.first_chunk::<{ VERSION_AT + 2 }>()
            && *magic == MAGIC
        {
            let found = u16::from_le_bytes([*low, *high]);
            if found != VERSION {
                return Err(NodePageError::Version { found });
            }
        }
        let bytes = region.first_chunk::<SIZE>().ok_or(short)?;
        let field = |at: usize| bytes.get(at).copied();
        let word = |at: usize| bytes.get(at..).and_then(|rest| rest.first_chunk::<4>()).map(|b| u32::from_le_bytes(*b));
        // All offsets lie within the page, so `short` cannot happen from here on. It saves the board from a panic.
        let byte = |at: usize| field(at).ok_or(short);
        let float = |at: usize| word(at).map(f32::from_bits).ok_or(short);

        let magic = bytes.first_chunk::<8>().ok_or(short)?;
        if *magic == [0xff; 8] {
            return Err(NodePageError::Empty);
        }
        if *magic != MAGIC {
            return Err(NodePageError::Magic);
        }
        let stored = word(CRC_AT).ok_or(short)?;
        let computed = CRC_32.checksum(bytes.get(..CRC_AT).ok_or(short)?);
        if stored != computed {
            return Err(NodePageError::Checksum { stored, computed });
        }

        let bus_off = match byte(BUS_OFF_AT)? {
            0 => BusOffPolicy::Recover,
            1 => BusOffPolicy::Latch,
            _ => return Err(NodePageError::Value { field: "choice after bus-off", accepted: "0 or 1" }),
        };
        let blind_relaxes = match byte(BLIND_AT)? {
            0 => true,
            1 => false,
            _ => return Err(NodePageError::Value { field: "choice while blind", accepted: "0 or 1" }),
        };
        let half = |at: usize| Ok(u16::from_le_bytes([byte(at)?, byte(at + 1)?]));
        let dead_man_ms = half(DEAD_MAN_AT)?;
        let mut reserved = word(RESERVED_AT).ok_or(short)?;
        let mut joints = Calibration::NOMINAL.joints;
        let mut ranges = Safety::BOARD.joints;
        for (j, (joint, range)) in joints.iter_mut().zip(&mut ranges).enumerate() {
            let at = JOINTS_AT + JOINT_SIZE * j;
            joint.zero = half(at)?;
            joint.reversed = match byte(at + 2)? {
                0 => false,
                1 => true,
                _ => return Err(NodePageError::Value { field: "direction of an encoder", accepted: "0 or 1" }),
            };
            reserved |= u32::from(byte(at + 3)?);
            *range = JointRange { min: float(at + 4)?, max: float(at + 8)? };
        }
        if reserved != 0 {
            return Err(NodePageError::Value { field: "reserved byte", accepted: "0" });
        }
        let mut imu_mounting = [[0.0; 3]; 3];
        for (i, value) in imu_mounting.iter_mut().flatten().enumerate() {
            *value = float(MOUNTING_AT + 4 * i)?;
        }
        let caps = Caps { torque: float(CAPS_AT)?, torque_slew: float(CAPS_AT + 4)?, temperature: float(CAPS_AT + 8)? };
        let supply = Thresholds { under: float(SUPPLY_AT)?, over: float(SUPPLY_AT + 4)? };
        let motor = |m: usize| {
            let float = |i: usize| float(MOTORS_AT + MOTOR_SIZE * m + 4 * i);
            Ok(MotorCalibration {
                torque_constant: float(0)?,
                current_limit: float(1)?,
                cut_off: float(2)?,
                resistance: float(3)?,
                inductance: float(4)?,
                sense_range: float(5)?,
                sense_zero: float(6)?,
            })
        };
        let calibration = Calibration { joints, imu_mounting, motors: [motor(0)?, motor(1)?] };
        let safety = Safety { joints: ranges, caps, supply, dead_man_ms, blind_relaxes };
        let key = |at: usize| bytes.get(at..).and_then(|rest| rest.first_chunk()).copied().ok_or(short);
        let keys = [key(KEYS_AT)?, key(KEYS_AT + KEY_SIZE)?];
        let page = NodePage { node: byte(NODE_AT)?, modules: byte(MODULES_AT)?, bus_off, safety, calibration, keys };
        page.check()?;
        Ok(page)
    }

    /// The bytes to write; refuses what [`NodePage::parse`] would refuse.
    pub fn encode(&self) -> Result<[u8; SIZE], NodePageError> {
        self.check()?;
        let mut bytes = [0; SIZE];
        // All offsets lie within the page. Not by indices: a module that stores its page must not panic.
        let mut put = |at: usize, what: &[u8]| {
            bytes.iter_mut().skip(at).zip(what).for_each(|(to, from)| *to = *from);
        };
        put(0, &MAGIC);
        put(VERSION_AT, &VERSION.to_le_bytes());
        put(NODE_AT, &[self.node]);
        put(MODULES_AT, &[self.modules]);
        put(BUS_OFF_AT, &[u8::from(self.bus_off == BusOffPolicy::Latch)]);
        let Safety { joints: ranges, caps, supply, dead_man_ms, blind_relaxes } = self.safety;
        put(BLIND_AT, &[u8::from(!blind_relaxes)]);
        put(DEAD_MAN_AT, &dead_man_ms.to_le_bytes());
        for (j, (joint, range)) in self.calibration.joints.iter().zip(ranges).enumerate() {
            let at = JOINTS_AT + JOINT_SIZE * j;
            put(at, &joint.zero.to_le_bytes());
            put(at + 2, &[u8::from(joint.reversed)]);
            put(at + 4, &range.min.to_le_bytes());
            put(at + 8, &range.max.to_le_bytes());
        }
        let limits = [caps.torque, caps.torque_slew, caps.temperature, supply.under, supply.over];
        for (i, value) in limits.iter().enumerate() {
            put(CAPS_AT + 4 * i, &value.to_le_bytes());
        }
        for (i, value) in self.calibration.imu_mounting.iter().flatten().enumerate() {
            put(MOUNTING_AT + 4 * i, &value.to_le_bytes());
        }
        for (m, motor) in self.calibration.motors.iter().enumerate() {
            let MotorCalibration { torque_constant, current_limit, cut_off, .. } = *motor;
            let MotorCalibration { resistance, inductance, sense_range, sense_zero, .. } = *motor;
            let fields = [torque_constant, current_limit, cut_off, resistance, inductance, sense_range, sense_zero];
            for (i, value) in fields.iter().enumerate() {
                put(MOTORS_AT + MOTOR_SIZE * m + 4 * i, &value.to_le_bytes());
            }
        }
        put(KEYS_AT, self.keys.as_flattened());
        if let Some((body, crc)) = bytes.split_last_chunk_mut::<4>() {
            *crc = CRC_32.checksum(body).to_le_bytes();
        }
        Ok(bytes)
    }

    /// Whether it can be.
    pub fn check(&self) -> Result<(), NodePageError> {
        let within = |value: f32, low: f32, high: f32| value >= low && value <= high;
        let Calibration { joints, imu_mounting, motors } = &self.calibration;
        let Safety { joints: ranges, caps, supply, dead_man_ms, .. } = &self.safety;
        let checks = [
            ((1..=MAX_MODULES).contains(&usize::from(self.modules)), "number of modules", "1 to 64"),
            (self.node < self.modules, "number of this module", "0 to the number of modules - 1"),
            (joints.iter().all(|joint| joint.zero < STEPS), "zero of an encoder", "0 to 16383"),
            (
                ranges.iter().all(|range| within(range.min, -FARTHEST, -NEAREST)),
                "least angle of a joint",
                "-3.1 to -0.05 rad",
            ),
            (
                ranges.iter().all(|range| within(range.max, NEAREST, FARTHEST)),
                "greatest angle of a joint",
                "0.05 to 3.1 rad",
            ),
            (
                *dead_man_ms == 0 || (200..=60_000).contains(dead_man_ms),
                "dead-man time",
                "0 (never), or 200 to 60000 ms",
            ),
            (
                is_rotation(imu_mounting),
                "mounting of the inertial sensor",
                "a rotation: orthonormal rows, right-handed",
            ),
            (within(caps.torque, 1e-3, 1e6), "cap of the torque", "0.001 to 1000000 torque units"),
            (within(caps.torque_slew, 1e-3, 1e8), "cap of the slew", "0.001 to 100000000 torque units per second"),
            (within(caps.temperature, 30.0, 150.0), "cap of the motor temperature", "30 to 150 degrees Celsius"),
            (within(supply.under, LOWEST_SUPPLY, 60.0), "lowest supply", "6 to 60 V"),
            (within(supply.over, 1.2 * supply.under, 60.0), "highest supply", "1.2 times the lowest to 60 V"),
            (
                every(motors, |m| within(m.torque_constant.abs(), 1e-3, 1e6)),
                "torque constant",
                "0.001 to 1000000 torque units per ampere",
            ),
            (every(motors, |m| within(m.current_limit, 1e-3, 100.0)), "current limit", "0.001 to 100 A"),
            (every(motors, |m| within(m.resistance, 1e-3, 1e3)), "winding resistance", "0.001 to 1000 ohm"),
            (every(motors, |m| within(m.inductance, 1e-6, 1.0)), "winding inductance", "0.000001 to 1 H"),
            (
                every(motors, |m| within(m.sense_range.abs(), 1e-3, 1e3)),
                "range of the current sense",
                "0.001 to 1000 A",
            ),
            (every(motors, |m| within(m.sense_zero, 0.0, 1.0)), "zero of the current sense", "0 to 1"),
            (
                every(motors, |m| within(m.cut_off, m.current_limit, SENSIBLE * m.measurable())),
                "cut-off current",
                "the current limit to 95 % of what the current sense can say in either direction; beyond that it could never cut off",
            ),
        ];
        match checks.into_iter().find(|(good, ..)| !good) {
            Some((_, field, accepted)) => Err(NodePageError::Value { field, accepted }),
            None => Ok(()),
        }
    }
}

/// Whether all motors are `good`.
fn every(motors: &[MotorCalibration; AXES], good: impl Fn(&MotorCalibration) -> bool) -> bool {
    motors.iter().all(good)
}

/// Whether the rows are of unit length, at right angles, and right-handed.
fn is_rotation(rows: &[[f32; 3]; 3]) -> bool {
    let [a, b, c] = rows;
    let dot = |p: &[f32; 3], q: &[f32; 3]| p[0] * q[0] + p[1] * q[1] + p[2] * q[2];
    let cross = [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]];
    let near = |value: f32, wanted: f32| (value - wanted).abs() < ORTHONORMAL;
    near(dot(a, a), 1.0)
        && near(dot(b, b), 1.0)
        && near(dot(a, b), 0.0)
        && cross.iter().zip(c).all(|(x, y)| near(*x, *y))
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use composer_shared::update::NO_KEY;
    use proptest::prelude::*;
    use std::string::ToString;
    use std::vec::Vec;

    pub fn page() -> NodePage {
        let [motor, _] = Calibration::NOMINAL.motors;
        let mut joints = [JointCalibration { zero: 0, reversed: false }; MAX_JOINTS];
        joints[2] = JointCalibration { zero: 0x1234, reversed: true };
        NodePage {
            node: 3,
            modules: 8,
            bus_off: BusOffPolicy::Latch,
            safety: Safety {
                joints: [-2.0, -2.1, -2.2, -2.3].map(|min| JointRange { min, max: 1.5 }),
                caps: Caps { torque: 60.0, torque_slew: 300.0, temperature: 75.0 },
                supply: Thresholds { under: 9.5, over: 15.0 },
                dead_man_ms: 0x1234,
                blind_relaxes: false,
            },
            calibration: Calibration {
                joints,
                imu_mounting: [[0.0, 1.0, 0.0], [-1.0, 0.0, 0.0], [0.0, 0.0, 1.0]],
                motors: [motor, MotorCalibration { torque_constant: -79.0, ..motor }],
            },
            keys: [NO_KEY; 2],
        }
    }

    fn mended(mut bytes: [u8; SIZE]) -> [u8; SIZE] {
        let crc = CRC_32.checksum(&bytes[..CRC_AT]);
        bytes[CRC_AT..].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    #[test]
    fn the_bytes_are_those_of_the_table() {
        let keys = [[0xa5; KEY_SIZE], core::array::from_fn(|i| i as u8)];
        let bytes = NodePage { keys, ..page() }.encode().unwrap();
        assert_eq!(bytes[..16], *b"COMPNODE\x03\0\x03\x08\x01\x01\x34\x12");
        assert_eq!(bytes[40..44], [0x34, 0x12, 1, 0]);
        assert_eq!(bytes[44..48], (-2.2f32).to_le_bytes());
        assert_eq!(bytes[60..64], 1.5f32.to_le_bytes());
        assert_eq!(bytes[68..72], 1.0f32.to_le_bytes());
        assert_eq!(bytes[100..104], 60.0f32.to_le_bytes());
        assert_eq!(bytes[104..108], 300.0f32.to_le_bytes());
        assert_eq!(bytes[108..112], 75.0f32.to_le_bytes());
        assert_eq!(bytes[112..116], 9.5f32.to_le_bytes());
        assert_eq!(bytes[116..120], 15.0f32.to_le_bytes());
        assert_eq!(bytes[120..124], 80.0f32.to_le_bytes());
        assert_eq!(bytes[148..152], (-79.0f32).to_le_bytes());
        assert_eq!(bytes[172..176], 0.5f32.to_le_bytes());
        assert_eq!(bytes[176..180], [0; 4]);
        // The same checksum as the policy image's: of "123456789" it is 0xcbf43926.
        assert_eq!(CRC_32.checksum(b"123456789"), 0xcbf4_3926);
        assert_eq!((&bytes[180..212], &bytes[212..214], bytes[243]), (&[0xa5; 32][..], &[0, 1][..], 31));
        assert_eq!(bytes[244..], CRC_32.checksum(&bytes[..244]).to_le_bytes());
    }

    #[test]
    fn what_was_written_is_read() {
        let mut region = [0xff; 4096];
        region[..SIZE].copy_from_slice(&page().encode().unwrap());
        assert_eq!(NodePage::parse(&region), Ok(page()));
    }

    #[test]
    fn every_reason_to_refuse_has_a_name() {
        let good = page().encode().unwrap();
        assert_eq!(NodePage::parse(&[0xff; 4096]), Err(NodePageError::Empty));
        assert_eq!(NodePage::parse(&good[..SIZE - 1]), Err(NodePageError::TooShort { length: SIZE - 1 }));
        assert_eq!(NodePage::parse(&[0; SIZE]), Err(NodePageError::Magic));
        let mut bytes = good;
        bytes[8] = 4;
        assert_eq!(NodePage::parse(&bytes), Err(NodePageError::Version { found: 4 }));
        let mut bytes = good;
        bytes[70] ^= 4;
        assert!(matches!(NodePage::parse(&bytes), Err(NodePageError::Checksum { .. })));

        let nan = f32::NAN.to_le_bytes();
        let cases: [(usize, &[u8], &str); 28] = [
            (10, &[8], "number of this module"),
            (11, &[0], "number of modules"),
            (11, &[65], "number of modules"),
            (12, &[2], "choice after bus-off"),
            (13, &[2], "choice while blind"),
            (14, &[199, 0], "dead-man time"),
            (14, &[0xff, 0xff], "dead-man time"),
            (43, &[1], "reserved byte"),
            (177, &[1], "reserved byte"),
            (17, &[0x40], "zero of an encoder"),
            (18, &[2], "direction of an encoder"),
            (20, &(-3.15f32).to_le_bytes(), "least angle of a joint"),
            (32, &0.0f32.to_le_bytes(), "least angle of a joint"),
            (24, &3.15f32.to_le_bytes(), "greatest angle of a joint"),
            (60, &nan, "greatest angle of a joint"),
            (68, &nan, "mounting of the inertial sensor"),
            (100, &0.0f32.to_le_bytes(), "cap of the torque"),
            (104, &f32::INFINITY.to_le_bytes(), "cap of the slew"),
            (108, &200.0f32.to_le_bytes(), "cap of the motor temperature"),
            (112, &5.9f32.to_le_bytes(), "lowest supply"),
            (116, &9.6f32.to_le_bytes(), "highest supply"),
            (116, &nan, "highest supply"),
            (120, &0.0f32.to_le_bytes(), "torque constant"),
            (152, &nan, "current limit"),
            (156, &1.0f32.to_le_bytes(), "cut-off current"),
            (164, &f32::INFINITY.to_le_bytes(), "winding inductance"),
            (172, &(-0.1f32).to_le_bytes(), "zero of the current sense"),
            (172, &0.99f32.to_le_bytes(), "cut-off current"),
        ];
        for (at, what, wanted) in cases {
            let mut bytes = good;
            bytes[at..at + what.len()].copy_from_slice(what);
            match NodePage::parse(&mended(bytes)) {
                Err(NodePageError::Value { field, .. }) => assert_eq!(field, wanted, "byte {at}"),
                other => panic!("byte {at}: {other:?}"),
            }
        }
    }

    #[test]
    fn a_cut_off_beyond_the_converters_range_is_refused() {
        // 6.6 A from end to end: at most 3.3 A in either direction, of which 95 % can be told from the end.
        for (cut_off, good) in [(2.5, true), (3.1, true), (3.2, false), (10.0, false), (f32::NAN, false)] {
            let mut page = page();
            page.calibration.motors[1].cut_off = cut_off;
            assert_eq!(page.encode().is_ok(), good, "{cut_off} A");
            let mut bytes = self::page().encode().unwrap();
            bytes[156..160].copy_from_slice(&f32::to_le_bytes(cut_off));
            assert_eq!(NodePage::parse(&mended(bytes)).is_ok(), good, "{cut_off} A, read");
        }
        // A sense whose zero is not in the middle says less in one direction.
        let mut page = page();
        page.calibration.motors[0].sense_zero = 0.3;
        let error = page.encode().unwrap_err().to_string();
        assert_eq!(
            error,
            "the node page has a cut-off current that cannot be: accepted is the current limit to 95 % of what the current sense can say in either direction; beyond that it could never cut off"
        );
    }

    #[test]
    fn a_page_of_version_1_is_refused_in_words() {
        let mut bytes = [0; SIZE];
        bytes[..16].copy_from_slice(b"COMPNODE\x01\0\x03\x08\0\0\0\0");
        let error = NodePage::parse(&bytes).unwrap_err();
        assert_eq!(error, NodePageError::Version { found: 1 });
        assert_eq!(
            error.to_string(),
            "the node page has layout version 1, which says nothing of limits, and this build reads version 3: write it again with `snakectl flash`"
        );
        // It was 128 bytes long.
        assert_eq!(NodePage::parse(&bytes[..128]), Err(NodePageError::Version { found: 1 }));
    }

    #[test]
    fn the_defaults_of_the_board_are_a_page() {
        let page = NodePage { safety: Safety::BOARD, calibration: Calibration::NOMINAL, ..page() };
        assert_eq!(NodePage::parse(&page.encode().unwrap()), Ok(page));
        assert!(page.safety.dead_man_ms > 0 && page.safety.blind_relaxes, "the safe choices are the default");
    }

    #[test]
    fn a_mirror_is_no_rotation() {
        let mut page = page();
        page.calibration.imu_mounting[2][2] = -1.0;
        let error = page.encode().unwrap_err();
        assert_eq!(
            error.to_string(),
            "the node page has a mounting of the inertial sensor that cannot be: accepted is a rotation: orthonormal rows, right-handed"
        );
    }

    proptest! {
        /// Any damage is noticed, and nothing panics.
        #[test]
        fn damage_is_noticed(at in 0..SIZE, flip in 1u8..) {
            let mut bytes = page().encode().unwrap();
            bytes[at] ^= flip;
            prop_assert!(NodePage::parse(&bytes).is_err());
        }

        #[test]
        fn any_bytes_with_a_good_checksum(tail in proptest::collection::vec(any::<u8>(), SIZE - 10), length in 0..SIZE) {
            let head: Vec<u8> = MAGIC.into_iter().chain(VERSION.to_le_bytes()).chain(tail).collect();
            let bytes = mended(head.try_into().unwrap());
            if let Ok(page) = NodePage::parse(&bytes) {
                prop_assert_eq!(page.encode(), Ok(bytes));
            }
            prop_assert!(NodePage::parse(&bytes[..length]).is_err());
        }
    }
}
