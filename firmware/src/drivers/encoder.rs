//! Magnetic joint encoder: ams AS5047P over SPI, 14 bits a turn.
//!
//! Chosen over the cheaper AS5600 because a module has four joints: an AS5600 has one fixed I2C address, so four of them need a
//! multiplexer, and its answers carry no checksum. Four AS5047P share one SPI bus with a chip select each, every frame has a
//! parity bit and an error flag, and one that hangs does not block the others.
//!
//! # On the bus
//!
//! SPI mode 1, at most 10 MHz, 16-bit frames, the most significant bit first, chip select high for at least 350 ns between frames
//! (AS5047P datasheet, "SPI timing"). The answer to a command comes with the *next* frame:
//!
//! | frame | bit 15 | bit 14 | bits 13 to 0 |
//! |---|---|---|---|
//! | command | even parity of the other 15 | 1: read | register |
//! | answer | even parity of the other 15 | 1: one of the frames before was bad, see ERRFL | content |
//!
//! | register | address | content |
//! |---|---|---|
//! | NOP | 0x0000 | 0 |
//! | ERRFL | 0x0001 | bit 0 framing error, 1 invalid command, 2 parity error; reading clears it |
//! | DIAAGC | 0x3ffc | bits 0 to 7 gain, 8 ready (LF), 9 CORDIC overflow (COF), 10 magnet too strong (MAGH), 11 too weak (MAGL) |
//! | ANGLECOM | 0x3fff | angle with dynamic error compensation, 16384 a turn |

use core::f32::consts::TAU;

use embedded_hal::delay::DelayNs;
use embedded_hal::spi::{Error as _, ErrorKind, Operation, SpiDevice};

/// Steps in a turn.
pub const STEPS: u16 = 1 << 14;

const NOP: u16 = 0x0000;
const ERRFL: u16 = 0x0001;
const DIAAGC: u16 = 0x3ffc;
const ANGLECOM: u16 = 0x3fff;

const CONTENT: u16 = 0x3fff;
const READ: u16 = 1 << 14;
const ERROR_FLAG: u16 = 1 << 14;
const PARITY: u16 = 1 << 15;

const READY: u16 = 1 << 8;
const CORDIC_OVERFLOW: u16 = 1 << 9;
const TOO_STRONG: u16 = 1 << 10;
const TOO_WEAK: u16 = 1 << 11;

/// From chip select to the first clock, and between two frames: 350 ns each.
const PAUSE_NS: u32 = 350;

/// Why there is no angle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EncoderError {
    /// The SPI port failed.
    Bus(ErrorKind),
    /// An answer has the wrong parity: noise on the wire.
    Parity,
    /// The encoder says that one of our frames was bad; the bits of ERRFL.
    Refused(u8),
    /// Nobody answers: the line stays high or low.
    NoAnswer,
    /// The encoder is still starting (10 ms after power-up) or compensating its offsets.
    NotReady,
    /// The angle could not be computed.
    CordicOverflow,
    /// The magnet is too close or too strong.
    MagnetTooStrong,
    /// The magnet is lost, too far or too weak.
    MagnetTooWeak,
}

impl EncoderError {
    /// What is wrong, in words.
    pub const fn name(self) -> &'static str {
        match self {
            EncoderError::Bus(_) => "the SPI port failed",
            EncoderError::Parity => "wrong parity",
            EncoderError::Refused(_) => "the encoder got a bad frame",
            EncoderError::NoAnswer => "no answer",
            EncoderError::NotReady => "not ready",
            EncoderError::CordicOverflow => "CORDIC overflow",
            EncoderError::MagnetTooStrong => "magnet too strong",
            EncoderError::MagnetTooWeak => "magnet lost or too weak",
        }
    }
}

impl core::fmt::Display for EncoderError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        f.write_str(self.name())
    }
}

impl core::error::Error for EncoderError {}

/// The chip, alone on its chip select.
#[derive(Debug)]
pub struct As5047p<S, D> {
    spi: S,
    delay: D,
}

impl<S: SpiDevice, D: DelayNs> As5047p<S, D> {
    /// The chip behind `spi`, which must be in mode 1 and not faster than 10 MHz.
    pub fn new(spi: S, delay: D) -> Self {
        As5047p { spi, delay }
    }

    /// The angle now, 0 to [`STEPS`] - 1. Three frames on the bus, five after an error.
    pub fn angle(&mut self) -> Result<u16, EncoderError> {
        // What comes with the first frame answers something older.
        self.exchange(ANGLECOM)?;
        let angle = self.exchange(DIAAGC)?;
        let diagnosis = self.exchange(NOP)?;
        if diagnosis & CORDIC_OVERFLOW != 0 {
            Err(EncoderError::CordicOverflow)
        } else if diagnosis & READY == 0 {
            // The gain starts in the middle and is never nought with a ready encoder: an empty register is a line held low.
            Err(if diagnosis == 0 && angle == 0 { EncoderError::NoAnswer } else { EncoderError::NotReady })
        } else if diagnosis & TOO_STRONG != 0 {
            Err(EncoderError::MagnetTooStrong)
        } else if diagnosis & TOO_WEAK != 0 {
            Err(EncoderError::MagnetTooWeak)
        } else {
            Ok(angle)
        }
    }

    /// Sends a read command and returns the content that the command before asked for.
    fn exchange(&mut self, register: u16) -> Result<u16, EncoderError> {
        let answer = self.frame(register)?;
        if answer == u16::MAX {
            return Err(EncoderError::NoAnswer);
        }
        if !answer.count_ones().is_multiple_of(2) {
            return Err(EncoderError::Parity);
        }
        if answer & ERROR_FLAG != 0 {
            // Reading the register clears it, so that the next sample starts anew.
            self.frame(ERRFL)?;
            let flags = self.frame(NOP)?;
            return Err(EncoderError::Refused((flags & 7) as u8));
        }
        Ok(answer & CONTENT)
    }

    fn frame(&mut self, register: u16) -> Result<u16, EncoderError> {
        let mut word = command(register).to_be_bytes();
        let mut operations = [Operation::DelayNs(PAUSE_NS), Operation::TransferInPlace(&mut word)];
        let result = self.spi.transaction(&mut operations);
        self.delay.delay_ns(PAUSE_NS);
        result.map_err(|e| EncoderError::Bus(e.kind()))?;
        Ok(u16::from_be_bytes(word))
    }
}

/// The frame that reads `register`.
const fn command(register: u16) -> u16 {
    let word = register | READ;
    if word.count_ones().is_multiple_of(2) { word } else { word | PARITY }
}

/// How an encoder sits in its joint.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct JointCalibration {
    /// What the encoder reads when the joint is straight, 0 to [`STEPS`] - 1.
    pub zero: u16,
    /// The encoder counts down while the joint angle (see [`composer_shared::kinematics`]) grows.
    pub reversed: bool,
}

impl JointCalibration {
    /// The joint angle for a reading, -pi to pi rad.
    pub fn angle(&self, reading: u16) -> f32 {
        // In whole steps, where turning over costs nothing: -8192 to 8191.
        let steps = (reading.wrapping_sub(self.zero) << 2) as i16 >> 2;
        let angle = f32::from(steps) * (TAU / f32::from(STEPS));
        if self.reversed { -angle } else { angle }
    }
}

/// Speed from angles by a tracking loop of second order: it follows a constant speed without lag and smooths the steps of the encoder,
/// which at a thousand samples a second would be 0.4 rad/s each in plain differences.
#[derive(Clone, Copy, Debug)]
pub struct SpeedEstimator {
    /// Natural frequency of the critically damped loop, rad/s.
    bandwidth: f32,
    state: Option<(f32, f32)>,
}

impl SpeedEstimator {
    /// A loop of this bandwidth, rad/s; its step must be well below 1 / `bandwidth`.
    pub fn new(bandwidth: f32) -> Self {
        SpeedEstimator { bandwidth, state: None }
    }

    /// The speed (rad/s) after `angle` (rad) was read `seconds` after the sample before. The first one gives zero.
    pub fn update(&mut self, angle: f32, seconds: f32) -> f32 {
        let Some((mut followed, mut speed)) = self.state else {
            self.state = Some((angle, 0.0));
            return 0.0;
        };
        followed = wrap(followed + speed * seconds);
        let error = wrap(angle - followed);
        // Critical damping: 2 w and w^2. After a late sample w is less, or the loop would be unstable.
        let bandwidth = self.bandwidth.min(0.5 / seconds);
        followed = wrap(followed + 2.0 * bandwidth * seconds * error);
        speed += bandwidth * bandwidth * seconds * error;
        self.state = Some((followed, speed));
        speed
    }

    /// Forgets everything: the next sample is the first.
    pub fn reset(&mut self) {
        self.state = None;
    }
}

/// An angle brought to -pi .. pi.
fn wrap(angle: f32) -> f32 {
    angle - TAU * libm::roundf(angle / TAU)
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use core::f32::consts::PI;
    use embedded_hal_mock::eh1::delay::NoopDelay;
    use embedded_hal_mock::eh1::spi::{Mock, Transaction};
    use std::vec;
    use std::vec::Vec;

    /// An answer with its parity, as the chip sends it.
    pub fn answer(content: u16) -> u16 {
        if content.count_ones().is_multiple_of(2) { content } else { content | PARITY }
    }

    fn frame(sent: u16, received: u16) -> Vec<Transaction<u8>> {
        vec![
            Transaction::transaction_start(),
            Transaction::delay(PAUSE_NS),
            Transaction::transfer_in_place(sent.to_be_bytes().to_vec(), received.to_be_bytes().to_vec()),
            Transaction::transaction_end(),
        ]
    }

    /// The bus while one sample is read: what the chip answers to ANGLECOM and DIAAGC.
    pub fn sample(angle: u16, diagnosis: u16) -> Vec<Transaction<u8>> {
        // The commands as the datasheet has them: 0xffff reads ANGLECOM, 0x7ffc with its parity is 0xfffc, a NOP is 0xc000.
        [frame(0xffff, 0), frame(0xfffc, answer(angle)), frame(0xc000, answer(diagnosis))].concat()
    }

    fn read(expected: &[Vec<Transaction<u8>>]) -> Result<u16, EncoderError> {
        let mut spi = Mock::new(&expected.concat());
        let result = As5047p::new(spi.clone(), NoopDelay).angle();
        spi.done();
        result
    }

    /// Ready, gain in the middle.
    pub const GOOD: u16 = READY | 0x80;

    #[test]
    fn commands_have_even_parity() {
        for (register, word) in [(ANGLECOM, 0xffff), (DIAAGC, 0xfffc), (NOP, 0xc000), (ERRFL, 0x4001)] {
            assert_eq!(command(register), word, "{register:#x}");
        }
    }

    #[test]
    fn a_good_sample() {
        assert_eq!(read(&[sample(0x1234, GOOD)]), Ok(0x1234));
        assert_eq!(read(&[sample(0, GOOD)]), Ok(0));
        assert_eq!(read(&[sample(STEPS - 1, GOOD)]), Ok(STEPS - 1));
    }

    #[test]
    fn what_the_chip_complains_about() {
        for (diagnosis, error) in [
            (0x80, EncoderError::NotReady),
            (GOOD | CORDIC_OVERFLOW, EncoderError::CordicOverflow),
            (READY | TOO_STRONG, EncoderError::MagnetTooStrong),
            (READY | TOO_WEAK | 0xff, EncoderError::MagnetTooWeak),
        ] {
            assert_eq!(read(&[sample(77, diagnosis)]), Err(error));
        }
    }

    #[test]
    fn one_flipped_bit_is_noticed() {
        for bit in 0..16 {
            let bad = answer(0x0321) ^ 1 << bit;
            let expected = [frame(0xffff, 0), frame(0xfffc, bad)];
            assert_eq!(read(&expected), Err(EncoderError::Parity), "bit {bit}");
        }
    }

    #[test]
    fn an_error_flag_is_read_and_so_cleared() {
        let flagged = answer(0x0321 | ERROR_FLAG);
        let expected = [frame(0xffff, 0), frame(0xfffc, flagged), frame(0x4001, 0), frame(0xc000, answer(4))];
        assert_eq!(read(&expected), Err(EncoderError::Refused(4)));
    }

    #[test]
    fn nobody_there() {
        assert_eq!(read(&[frame(0xffff, 0xffff)]), Err(EncoderError::NoAnswer));
        assert_eq!(read(&[sample(0, 0)]), Err(EncoderError::NoAnswer));
    }

    #[test]
    fn a_failing_port() {
        struct Broken;
        impl embedded_hal::spi::ErrorType for Broken {
            type Error = ErrorKind;
        }
        impl SpiDevice for Broken {
            fn transaction(&mut self, _: &mut [Operation<'_, u8>]) -> Result<(), ErrorKind> {
                Err(ErrorKind::Overrun)
            }
        }
        assert_eq!(As5047p::new(Broken, NoopDelay).angle(), Err(EncoderError::Bus(ErrorKind::Overrun)));
    }

    #[test]
    fn zero_and_direction() {
        let quarter = STEPS / 4;
        for (zero, reversed, reading, angle) in [
            (0, false, quarter, PI / 2.0),
            (0, true, quarter, -PI / 2.0),
            (quarter, false, 0, -PI / 2.0),
            // Across the jump of the encoder, not of the joint.
            (STEPS - 100, false, 100, 200.0 * TAU / 16384.0),
            (100, false, STEPS - 100, -200.0 * TAU / 16384.0),
            (0, false, STEPS / 2, -PI),
        ] {
            let got = JointCalibration { zero, reversed }.angle(reading);
            assert!((got - angle).abs() < 1e-6, "{zero} {reversed} {reading}: {got} instead of {angle}");
        }
    }

    #[test]
    fn the_speed_follows_without_lag_across_the_turn() {
        let mut estimator = SpeedEstimator::new(150.0);
        let calibration = JointCalibration { zero: 0, reversed: false };
        let mut worst: f32 = 0.0;
        for i in 0..3000 {
            // 3 rad/s, as the encoder sees it: in whole steps, over the end of the turn.
            let turned = 3.0 * i as f32 * 1e-3 / TAU * f32::from(STEPS);
            let speed = estimator.update(calibration.angle(turned as u16 % STEPS), 1e-3);
            if i > 100 {
                worst = worst.max((speed - 3.0).abs());
            }
        }
        assert!(worst < 0.15, "{worst}");
        estimator.reset();
        assert_eq!(estimator.update(1.0, 1e-3), 0.0);
        assert!(estimator.update(1.0, 1e-3).abs() < 1e-6, "a joint at rest has no speed");
    }

    #[test]
    fn a_late_sample_does_not_upset_the_speed() {
        let mut estimator = SpeedEstimator::new(150.0);
        for seconds in [1e-3, 0.05, 1.0, 1e-3, 1e-3] {
            let speed = estimator.update(0.5, seconds);
            assert!(speed.abs() < 1e-6);
        }
        for i in 0..200 {
            let speed = estimator.update(if i % 2 == 0 { 0.5 } else { 0.6 }, 0.05);
            assert!(speed.abs() < 2.0, "0.1 rad in 50 ms are 2 rad/s, not {speed}");
        }
    }
}
