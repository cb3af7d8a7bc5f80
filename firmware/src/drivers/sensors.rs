//! All sensors of a module together: what the controller polls with.
//!
//! A reading that fails once is bridged with the one before, because a flipped bit on a wire is no reason to go blind. After
//! [`HOLD`] failures in a row it is not a number, the sample is not [plausible](Sensors::plausible), and the controller reports fault 39.

use composer_shared::observation::Sensors;
use composer_shared::robot::{AXES, MAX_JOINTS};
use embedded_hal::delay::DelayNs;
use embedded_hal::spi::SpiDevice;

use super::encoder::{As5047p, EncoderError, JointCalibration, SpeedEstimator};
use super::imu::{ImuError, Lsm6dso, Motion};
use crate::attitude::Attitude;

/// Failures in a row that are bridged.
pub const HOLD: u8 = 4;

/// Bandwidth of the speed estimate, rad/s: 25 Hz, two and a half times what a control period of 50 ms can use.
pub const SPEED_BANDWIDTH: f32 = 157.0;

/// A joint with its encoder.
#[derive(Debug)]
pub struct Joint<S, D> {
    encoder: As5047p<S, D>,
    calibration: JointCalibration,
    estimator: SpeedEstimator,
    angle: f32,
    speed: f32,
    /// Time since the last good reading, s.
    since: f32,
    failures: u8,
    error: Option<EncoderError>,
    /// The last reading, if it succeeded.
    reading: Option<u16>,
    errors: u32,
}

impl<S: SpiDevice, D: DelayNs> Joint<S, D> {
    /// A joint that was not read yet.
    pub fn new(encoder: As5047p<S, D>, calibration: JointCalibration) -> Self {
        Joint {
            encoder,
            calibration,
            estimator: SpeedEstimator::new(SPEED_BANDWIDTH),
            angle: f32::NAN,
            speed: f32::NAN,
            since: 0.0,
            failures: 0,
            error: None,
            reading: None,
            errors: 0,
        }
    }

    fn read(&mut self, seconds: f32) {
        self.since += seconds;
        let result = self.encoder.angle();
        self.reading = result.ok();
        match result {
            Ok(reading) => {
                self.angle = self.calibration.angle(reading);
                self.speed = self.estimator.update(self.angle, self.since);
                (self.since, self.failures, self.error) = (0.0, 0, None);
            }
            Err(error) => {
                self.error = Some(error);
                self.errors = self.errors.saturating_add(1);
                self.failures = self.failures.saturating_add(1);
                if self.failures > HOLD {
                    (self.angle, self.speed) = (f32::NAN, f32::NAN);
                    self.estimator.reset();
                }
            }
        }
    }
}

/// What the chips read, before calibration.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RawReadings {
    /// The encoders, if their last reading succeeded.
    pub encoders: [Option<u16>; MAX_JOINTS],
    /// Readings of each that failed.
    pub encoder_errors: [u32; MAX_JOINTS],
    /// The last specific force in the axes of the inertial sensor, g; not a number before the first.
    pub force: [f32; 3],
    /// The last angular rate likewise, rad/s.
    pub rate: [f32; 3],
    /// Readings of the inertial sensor that failed.
    pub imu_errors: u32,
}

/// The sensors of a module.
#[derive(Debug)]
pub struct ModuleSensors<E, I, D> {
    joints: [Joint<E, D>; MAX_JOINTS],
    /// Joints that exist.
    count: usize,
    imu: Lsm6dso<I>,
    attitude: Attitude,
    rate: [f32; 3],
    /// Time since the last good reading of the inertial sensor, s.
    imu_since: f32,
    imu_failures: u8,
    imu_error: Option<ImuError>,
    imu_errors: u32,
    /// The last reading of the inertial sensor.
    motion: Motion,
}

impl<E: SpiDevice, I: SpiDevice, D: DelayNs> ModuleSensors<E, I, D> {
    /// The sensors of a module whose first `count` joints exist; the others read 0 and their encoders are left alone.
    pub fn new(joints: [Joint<E, D>; MAX_JOINTS], count: usize, imu: Lsm6dso<I>) -> Self {
        ModuleSensors {
            joints,
            count,
            imu,
            attitude: Attitude::UNKNOWN,
            rate: [f32::NAN; 3],
            imu_since: 0.0,
            imu_failures: 0,
            imu_error: None,
            imu_errors: 0,
            motion: Motion { force: [f32::NAN; 3], rate: [f32::NAN; 3] },
        }
    }

    /// Sets up the inertial sensor: at the start, and whenever [`ModuleSensors::imu_lost`].
    pub fn init(&mut self, delay: &mut impl DelayNs) -> Result<(), ImuError> {
        let result = self.imu.init(delay);
        self.imu_error = result.err();
        self.imu_failures = 0;
        result
    }

    /// Reads everything, `seconds` after the last time; every reading of the inertial sensor goes through the [attitude filter](crate::attitude).
    /// `torque` (fractions of the limit) and `temperature` (degrees Celsius) come from the motors.
    pub fn sample(&mut self, seconds: f32, torque: [f32; AXES], temperature: f32) -> Sensors {
        let mut sensors = Sensors { torque, temperature, ..Sensors::ZERO };
        let readings = sensors.joint_angles.iter_mut().zip(&mut sensors.joint_speeds);
        for (joint, (angle, speed)) in self.joints.iter_mut().take(self.count).zip(readings) {
            joint.read(seconds);
            (*angle, *speed) = (joint.angle, joint.speed);
        }
        self.imu_since += seconds;
        match self.imu.sample() {
            Ok(motion) => {
                self.attitude.update(motion.rate, motion.force, self.imu_since);
                self.rate = motion.rate;
                self.motion = motion;
                (self.imu_since, self.imu_failures, self.imu_error) = (0.0, 0, None);
            }
            Err(error) => {
                self.imu_error = Some(error);
                self.imu_errors = self.imu_errors.saturating_add(1);
                self.imu_failures = self.imu_failures.saturating_add(1);
                if self.imu_failures > HOLD {
                    (self.attitude, self.rate) = (Attitude::UNKNOWN, [f32::NAN; 3]);
                }
            }
        }
        (sensors.up, sensors.angular_rate) = (self.attitude.up(), self.rate);
        sensors
    }

    /// Whether the inertial sensor has been silent for so long that it should be set up anew: a hundred samples.
    pub fn imu_lost(&self) -> bool {
        self.imu_failures >= 100
    }

    /// What failed in the last sample, for the log: joint by joint, then the inertial sensor.
    pub fn errors(&self) -> ([Option<EncoderError>; MAX_JOINTS], Option<ImuError>) {
        (self.joints.each_ref().map(|joint| joint.error), self.imu_error)
    }

    /// What the chips read last.
    pub fn raw(&self) -> RawReadings {
        RawReadings {
            encoders: self.joints.each_ref().map(|joint| joint.reading),
            encoder_errors: self.joints.each_ref().map(|joint| joint.errors),
            force: self.imu.in_its_axes(self.motion.force),
            rate: self.imu.in_its_axes(self.motion.rate),
            imu_errors: self.imu_errors,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::encoder::tests::{GOOD, sample};
    use super::super::imu::tests::{STRAIGHT, burst};
    use super::*;
    use embedded_hal_mock::eh1::delay::NoopDelay;
    use embedded_hal_mock::eh1::spi::{Mock, Transaction};
    use std::vec::Vec;

    const LEVEL: [i16; 3] = [0, 0, 8197];

    struct Chips {
        encoders: [Mock<u8>; MAX_JOINTS],
        imu: Mock<u8>,
    }

    fn module(count: usize) -> (ModuleSensors<Mock<u8>, Mock<u8>, NoopDelay>, Chips) {
        let chips = Chips { encoders: core::array::from_fn(|_| Mock::new(&[])), imu: Mock::new(&[]) };
        let joints = chips.encoders.each_ref().map(|spi| {
            let calibration = JointCalibration { zero: 0, reversed: false };
            Joint::new(As5047p::new(spi.clone(), NoopDelay), calibration)
        });
        (ModuleSensors::new(joints, count, Lsm6dso::new(chips.imu.clone(), STRAIGHT)), chips)
    }

    impl Chips {
        /// Answers with these angles (none: magnet lost), the inertial sensor with this.
        fn answer(&mut self, angles: &[Option<u16>], imu: Vec<Transaction<u8>>) {
            for (spi, angle) in self.encoders.iter_mut().zip(angles) {
                spi.update_expectations(&sample(angle.unwrap_or(0), if angle.is_some() { GOOD } else { 0x9ff }));
            }
            self.imu.update_expectations(&imu);
        }

        fn done(&mut self) {
            self.encoders.iter_mut().for_each(Mock::done);
            self.imu.done();
        }
    }

    fn good_imu() -> Vec<Transaction<u8>> {
        burst(3, [0, 0, 0], LEVEL)
    }

    #[test]
    fn a_whole_sample() {
        let (mut module, mut chips) = module(4);
        chips.answer(&[Some(0), Some(4096), Some(12288), Some(1)], good_imu());
        let sensors = module.sample(1e-3, [0.5, -0.25], 31.0);
        assert!(sensors.plausible(), "{sensors:?}");
        assert!((sensors.joint_angles[1] - core::f32::consts::FRAC_PI_2).abs() < 1e-6);
        assert!((sensors.joint_angles[2] + core::f32::consts::FRAC_PI_2).abs() < 1e-6);
        assert_eq!((sensors.torque, sensors.temperature), ([0.5, -0.25], 31.0));
        assert_eq!(module.errors(), ([None; 4], None));
        let raw = module.raw();
        assert_eq!((raw.encoders, raw.encoder_errors), ([Some(0), Some(4096), Some(12288), Some(1)], [0; 4]));
        assert!((raw.force[2] - 1.0).abs() < 1e-3 && raw.rate == [0.0; 3] && raw.imu_errors == 0, "{raw:?}");
        chips.done();
    }

    #[test]
    fn a_joint_that_does_not_exist_reads_zero() {
        let (mut module, mut chips) = module(3);
        chips.answer(&[Some(5); 3], good_imu());
        let sensors = module.sample(1e-3, [0.0; 2], 31.0);
        assert_eq!((sensors.joint_angles[3], sensors.joint_speeds[3]), (0.0, 0.0));
        assert!(sensors.plausible());
        chips.done();
    }

    #[test]
    fn one_lost_sample_is_bridged_and_a_lost_magnet_is_not() {
        let (mut module, mut chips) = module(4);
        chips.answer(&[Some(100); 4], good_imu());
        let before = module.sample(1e-3, [0.0; 2], 30.0);
        for _ in 0..HOLD {
            chips.answer(&[Some(100), None, Some(100), Some(100)], good_imu());
            let bridged = module.sample(1e-3, [0.0; 2], 30.0);
            assert!(bridged.plausible() && bridged.joint_angles == before.joint_angles);
            assert_eq!(module.errors().0[1], Some(EncoderError::MagnetTooWeak));
            assert_eq!(module.raw().encoders[..2], [Some(100), None]);
            chips.done();
        }
        chips.answer(&[Some(100), None, Some(100), Some(100)], good_imu());
        let blind = module.sample(1e-3, [0.0; 2], 30.0);
        assert!(blind.joint_angles[1].is_nan() && !blind.plausible());
        assert_eq!(module.raw().encoder_errors, [0, u32::from(HOLD) + 1, 0, 0]);
        assert_eq!(blind.joint_angles[0], before.joint_angles[0], "the others go on");
        chips.answer(&[Some(100); 4], good_imu());
        assert!(module.sample(1e-3, [0.0; 2], 30.0).plausible(), "and it comes back");
        chips.done();
    }

    #[test]
    fn a_silent_inertial_sensor_is_not_plausible_and_set_up_anew() {
        let (mut module, mut chips) = module(4);
        chips.answer(&[Some(0); 4], good_imu());
        assert!(module.sample(1e-3, [0.0; 2], 30.0).plausible());
        for i in 1..=100u8 {
            assert!(!module.imu_lost());
            chips.answer(&[Some(0); 4], burst(0, [0; 3], LEVEL));
            let sensors = module.sample(1e-3, [0.0; 2], 30.0);
            assert_eq!(sensors.plausible(), i <= HOLD, "after {i}");
            chips.done();
        }
        assert!(module.imu_lost() && module.errors().1 == Some(ImuError::Stale));
        assert_eq!(module.raw().imu_errors, 100);
    }

    #[test]
    fn an_impact_does_not_tilt_it() {
        let (mut module, mut chips) = module(4);
        let mut sample = |level: [i16; 3]| {
            chips.answer(&[Some(0); 4], burst(3, [0, 0, 0], level));
            let sensors = module.sample(1e-3, [0.0; 2], 30.0);
            chips.done();
            sensors
        };
        (0..500).for_each(|_| _ = sample(LEVEL));
        let hit = sample([i16::MAX, 0, i16::MIN]);
        assert!(hit.plausible() && hit.up[2] > 0.999, "{hit:?}");
    }

    #[test]
    fn nothing_is_plausible_before_the_first_reading() {
        let (mut module, mut chips) = module(4);
        chips.answer(&[None; 4], burst(0, [0; 3], LEVEL));
        assert!(!module.sample(1e-3, [0.0; 2], 30.0).plausible());
        chips.done();
    }
}
