//! Inertial sensor: ST LSM6DSO over SPI, acceleration and angular rate.
//!
//! SPI mode 3 (or 0), at most 10 MHz. The first byte of a transfer is the register, with bit 7 set for reading; further bytes go to or
//! come from the registers after it (LSM6DSO datasheet, "SPI bus interface").
//!
//! | register | address | written | means |
//! |---|---|---|---|
//! | WHO_AM_I | 0x0f | | reads 0x6c |
//! | CTRL1_XL | 0x10 | 0x88 | accelerometer 1.66 kHz, +-4 g: 0.122 mg a step |
//! | CTRL2_G | 0x11 | 0x8c | gyroscope 1.66 kHz, +-2000 degrees/s: 70 mdps a step |
//! | CTRL3_C | 0x12 | 0x01, 0x44 | software reset; then block data update and address increment |
//! | CTRL4_C | 0x13 | 0x04 | I2C off |
//! | CTRL9_XL | 0x18 | 0xe2 | I3C off |
//! | STATUS_REG | 0x1e | | bit 0 new acceleration, 1 new rate, 2 new temperature |
//! | OUTX_L_G .. OUTZ_H_A | 0x22 .. 0x2d | | rate, then acceleration: x, y, z, 16 bits each, little-endian |

use embedded_hal::delay::DelayNs;
use embedded_hal::spi::{Error as _, ErrorKind, Operation, SpiDevice};
use nalgebra::{Matrix3, Vector3};

const READ: u8 = 0x80;
const WHO_AM_I: u8 = 0x0f;
const IDENTITY: u8 = 0x6c;
const CTRL1_XL: u8 = 0x10;
const CTRL3_C: u8 = 0x12;
const CTRL9_XL: u8 = 0x18;
const STATUS_REG: u8 = 0x1e;

const SOFTWARE_RESET: u8 = 0x01;
/// CTRL1_XL to CTRL4_C.
const SETTINGS: [u8; 4] = [0x88, 0x8c, 0x44, 0x04];
const NO_I3C: u8 = 0xe2;

const NEW_ACCELERATION: u8 = 1;
const NEW_RATE: u8 = 2;
/// Bits of STATUS_REG that are always zero.
const STATUS_ZERO: u8 = 0xf8;

/// A step of the accelerometer, in g.
const G_PER_STEP: f32 = 0.122e-3;
/// A step of the gyroscope, rad/s.
const RATE_PER_STEP: f32 = 70e-3 * core::f32::consts::PI / 180.0;

/// Why there is no sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ImuError {
    /// The SPI port failed.
    Bus(ErrorKind),
    /// Another chip answers, or none (0x00, 0xff): what WHO_AM_I read.
    Identity(u8),
    /// The chip did not come back from its reset.
    Reset,
    /// The settings do not read as they were written.
    Settings,
    /// There is nothing new: the chip lost its settings (brown-out), or is read too fast.
    Stale,
    /// The line stays high.
    NoAnswer,
}

impl ImuError {
    /// What is wrong, in words.
    pub const fn name(self) -> &'static str {
        match self {
            ImuError::Bus(_) => "the SPI port failed",
            ImuError::Identity(_) => "this is no LSM6DSO",
            ImuError::Reset => "it does not come back from its reset",
            ImuError::Settings => "it does not keep its settings",
            ImuError::Stale => "nothing new",
            ImuError::NoAnswer => "no answer",
        }
    }
}

impl core::fmt::Display for ImuError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.name())
    }
}

impl core::error::Error for ImuError {}

/// One sample, in the module's own frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Motion {
    /// Specific force: the acceleration that is felt, in g; at rest a unit vector against gravity.
    pub force: [f32; 3],
    /// Angular rate, rad/s.
    pub rate: [f32; 3],
}

/// The chip, alone on its chip select.
#[derive(Debug)]
pub struct Lsm6dso<S> {
    spi: S,
    mounting: Matrix3<f32>,
}

impl<S: SpiDevice> Lsm6dso<S> {
    /// The chip behind `spi`. `mounting` turns its axes into the module's own frame, row by row.
    pub fn new(spi: S, mounting: [[f32; 3]; 3]) -> Self {
        let [a, b, c] = mounting;
        Lsm6dso { spi, mounting: Matrix3::from([a, b, c]).transpose() }
    }

    /// Checks that it is the right chip, resets it and sets it up. The first sample is there after 80 ms.
    /// Call it again when the chip has lost its settings.
    pub fn init(&mut self, delay: &mut impl DelayNs) -> Result<(), ImuError> {
        let [identity] = self.read(WHO_AM_I)?;
        if identity != IDENTITY {
            return Err(ImuError::Identity(identity));
        }
        self.write(CTRL3_C, [SOFTWARE_RESET])?;
        // 50 us by the datasheet.
        let mut patience = 5;
        loop {
            delay.delay_us(100);
            let [control] = self.read(CTRL3_C)?;
            if control & SOFTWARE_RESET == 0 {
                break;
            }
            patience -= 1;
            if patience == 0 {
                return Err(ImuError::Reset);
            }
        }
        self.write(CTRL9_XL, [NO_I3C])?;
        // Last what starts the conversions. The reset leaves the address increment on.
        self.write(CTRL1_XL, SETTINGS)?;
        if self.read(CTRL1_XL)? != SETTINGS {
            return Err(ImuError::Settings);
        }
        Ok(())
    }

    /// The latest sample. At least 700 us must lie between two calls, so that there is a new one.
    pub fn sample(&mut self) -> Result<Motion, ImuError> {
        // Status, a reserved byte, temperature, rate, acceleration: one burst, so that all belong together.
        let burst: [u8; 16] = self.read(STATUS_REG)?;
        let [status, _, _, _, data @ ..] = burst;
        if status & STATUS_ZERO != 0 {
            return Err(ImuError::NoAnswer);
        }
        if status & (NEW_ACCELERATION | NEW_RATE) != NEW_ACCELERATION | NEW_RATE {
            return Err(ImuError::Stale);
        }
        let [rx, ry, rz, ax, ay, az] = words(data);
        let turned = |v: [i16; 3], scale: f32| (self.mounting * Vector3::from(v.map(f32::from)) * scale).into();
        Ok(Motion { force: turned([ax, ay, az], G_PER_STEP), rate: turned([rx, ry, rz], RATE_PER_STEP) })
    }

    /// What of the module's own frame is in the axes of the chip.
    pub fn in_its_axes(&self, vector: [f32; 3]) -> [f32; 3] {
        (self.mounting.transpose() * Vector3::from(vector)).into()
    }

    fn read<const N: usize>(&mut self, register: u8) -> Result<[u8; N], ImuError> {
        let mut content = [0; N];
        self.spi
            .transaction(&mut [Operation::Write(&[register | READ]), Operation::Read(&mut content)])
            .map_err(|e| ImuError::Bus(e.kind()))?;
        Ok(content)
    }

    fn write<const N: usize>(&mut self, register: u8, content: [u8; N]) -> Result<(), ImuError> {
        self.spi
            .transaction(&mut [Operation::Write(&[register]), Operation::Write(&content)])
            .map_err(|e| ImuError::Bus(e.kind()))
    }
}

fn words(bytes: [u8; 12]) -> [i16; 6] {
    let mut words = [0; 6];
    for (word, bytes) in words.iter_mut().zip(bytes.as_chunks().0) {
        *word = i16::from_le_bytes(*bytes);
    }
    words
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use embedded_hal_mock::eh1::delay::NoopDelay;
    use embedded_hal_mock::eh1::spi::{Mock, Transaction};
    use std::vec;
    use std::vec::Vec;

    pub const STRAIGHT: [[f32; 3]; 3] = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];

    fn read(register: u8, content: &[u8]) -> Vec<Transaction<u8>> {
        vec![
            Transaction::transaction_start(),
            Transaction::write_vec(vec![register | 0x80]),
            Transaction::read_vec(content.to_vec()),
            Transaction::transaction_end(),
        ]
    }

    fn write(register: u8, content: &[u8]) -> Vec<Transaction<u8>> {
        vec![
            Transaction::transaction_start(),
            Transaction::write_vec(vec![register]),
            Transaction::write_vec(content.to_vec()),
            Transaction::transaction_end(),
        ]
    }

    /// The bus while one sample is read.
    pub fn burst(status: u8, rate: [i16; 3], acceleration: [i16; 3]) -> Vec<Transaction<u8>> {
        let mut bytes = vec![status, 0, 0, 0];
        bytes.extend(rate.into_iter().chain(acceleration).flat_map(i16::to_le_bytes));
        read(0x1e, &bytes)
    }

    fn with<T>(
        expected: &[Vec<Transaction<u8>>],
        mounting: [[f32; 3]; 3],
        f: impl Fn(&mut Lsm6dso<Mock<u8>>) -> T,
    ) -> T {
        let mut spi = Mock::new(&expected.concat());
        let result = f(&mut Lsm6dso::new(spi.clone(), mounting));
        spi.done();
        result
    }

    fn init(expected: &[Vec<Transaction<u8>>]) -> Result<(), ImuError> {
        with(expected, STRAIGHT, |imu| imu.init(&mut NoopDelay))
    }

    #[test]
    fn it_is_checked_reset_and_set_up() {
        let who = read(0x0f, &[0x6c]);
        let reset = write(0x12, &[0x01]);
        let settings = write(0x10, &[0x88, 0x8c, 0x44, 0x04]);
        let i3c = write(0x18, &[0xe2]);
        let done =
            [who.clone(), reset.clone(), read(0x12, &[0x05]), read(0x12, &[0x04]), i3c.clone(), settings.clone()];
        let good = [&done[..], &[read(0x10, &[0x88, 0x8c, 0x44, 0x04])]].concat();
        assert_eq!(init(&good), Ok(()));
        let bad = [&done[..], &[read(0x10, &[0x88, 0x00, 0x44, 0x04])]].concat();
        assert_eq!(init(&bad), Err(ImuError::Settings));
        for other in [0x00, 0xff, 0x6a] {
            assert_eq!(init(&[read(0x0f, &[other])]), Err(ImuError::Identity(other)));
        }
        let stuck: Vec<_> = [who, reset].into_iter().chain(vec![read(0x12, &[0x05]); 5]).collect();
        assert_eq!(init(&stuck), Err(ImuError::Reset));
    }

    #[test]
    fn at_rest_it_feels_one_g() {
        // 1 g at 0.122 mg a step, 1 rad/s at 70 mdps a step: the sensitivities of the datasheet.
        let one_g = (1.0 / 0.122e-3) as i16;
        let one_rad = (1.0f32.to_degrees() / 0.070) as i16;
        let motion = with(&[burst(3, [0, 0, one_rad], [0, 0, one_g])], STRAIGHT, |imu| imu.sample()).unwrap();
        assert!((motion.force[2] - 1.0).abs() < 1e-3 && motion.force[0] == 0.0, "{motion:?}");
        assert!((motion.rate[2] - 1.0).abs() < 2e-3, "{motion:?}");
        // Bit 2 is a new temperature, which nobody needs.
        let full = with(&[burst(7, [i16::MIN; 3], [i16::MAX; 3])], STRAIGHT, |imu| imu.sample()).unwrap();
        assert!(
            (full.force[0] - 4.0).abs() < 0.01 && (full.rate[0] + 2293.76f32.to_radians()).abs() < 0.01,
            "{full:?}"
        );
    }

    #[test]
    fn the_mounting_turns_both() {
        // The chip's x points down, its z points ahead.
        let mounting = [[0.0, 0.0, 1.0], [0.0, 1.0, 0.0], [-1.0, 0.0, 0.0]];
        let motion = with(&[burst(3, [-100, 20, 30], [-8197, 0, 0])], mounting, |imu| imu.sample()).unwrap();
        assert!((motion.force[2] - 1.0).abs() < 1e-3 && motion.force[0] == 0.0 && motion.force[1] == 0.0, "{motion:?}");
        let steps = motion.rate.map(|r| r / RATE_PER_STEP);
        assert!(steps.iter().zip([30.0, 20.0, 100.0]).all(|(a, b)| (a - b).abs() < 1e-3), "{steps:?}");
    }

    #[test]
    fn old_and_missing_samples_are_errors() {
        for status in [0, 1, 2, 4] {
            let result = with(&[burst(status, [0; 3], [0; 3])], STRAIGHT, |imu| imu.sample());
            assert_eq!(result, Err(ImuError::Stale), "{status}");
        }
        let high = with(&[burst(0xff, [-1; 3], [-1; 3])], STRAIGHT, |imu| imu.sample());
        assert_eq!(high, Err(ImuError::NoAnswer));
    }

    #[test]
    fn a_failing_port() {
        struct Broken;
        impl embedded_hal::spi::ErrorType for Broken {
            type Error = ErrorKind;
        }
        impl SpiDevice for Broken {
            fn transaction(&mut self, _: &mut [Operation<'_, u8>]) -> Result<(), ErrorKind> {
                Err(ErrorKind::ModeFault)
            }
        }
        let mut imu = Lsm6dso::new(Broken, STRAIGHT);
        assert_eq!(imu.sample(), Err(ImuError::Bus(ErrorKind::ModeFault)));
        assert_eq!(imu.init(&mut NoopDelay), Err(ImuError::Bus(ErrorKind::ModeFault)));
    }
}
