//! Whether the own motors work, told from the torque that was commanded and the torque that was measured. The environment of the training runs the
//! same code, so that the policy learns to live with what it is told.
//!
//! A motor is taken for dead when in [`DOUBTS`] control steps in a row, as far as they tell anything, it was asked for torque and gave none; it is taken for sound again with the first
//! torque that it gives. A step tells something if this command and the one before ask for more than [`ASKED`] in the same direction: then a motor that
//! lags behind its command, by its slew or a late command, gives torque all the same.
//!
//! False alarms: a motor of two thirds of its nominal strength gives .13 where .2 are asked for, and is in doubt below [`NONE`], .06. With a current sense
//! whose noise is .02 of the torque limit (standard deviation) that takes 3.7 of them, p = 1e-4, three times in a row: at most 1e-12 a step, less than
//! one false alarm in a thousand years of 20 steps a second, of a motor that is always at the edge.

use composer_shared::robot::AXES;

/// Steps in a row that give a motor up.
pub const DOUBTS: u8 = 3;
/// Torque that has to be asked for, as a fraction of the limit.
pub const ASKED: f32 = 0.2;
/// Torque that is as good as none, as a fraction of the limit.
pub const NONE: f32 = 0.06;

/// What is known of the motors of a module.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorHealth {
    /// Command of the step before.
    before: [f32; AXES],
    doubts: [u8; AXES],
}

impl Default for MotorHealth {
    fn default() -> Self {
        Self::new()
    }
}

impl MotorHealth {
    /// Motors that nothing is known of are sound.
    pub const fn new() -> Self {
        Self { before: [0.0; AXES], doubts: [0; AXES] }
    }

    /// After a control step: the torque that was commanded in it and the torque that was measured at its end, yaw and pitch, as fractions of the limit.
    /// To be left out where the module's sensors cannot be believed, and while its motors are off.
    pub fn update(&mut self, commanded: [f32; AXES], measured: [f32; AXES]) {
        let axes = self.before.iter_mut().zip(&mut self.doubts).zip(commanded).zip(measured);
        for (((before, doubts), commanded), measured) in axes {
            let gives = measured.abs() >= NONE;
            let asked = if commanded < 0.0 { (-commanded).min(-*before) } else { commanded.min(*before) };
            if gives {
                *doubts = 0;
            } else if asked > ASKED {
                *doubts = doubts.saturating_add(1).min(DOUBTS);
            }
            *before = commanded;
        }
    }

    /// Whether each motor works, yaw and pitch.
    pub fn work(&self) -> [bool; AXES] {
        self.doubts.map(|doubts| doubts < DOUBTS)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers from -1 to 1 (xorshift).
    fn numbers() -> impl FnMut() -> f32 {
        let mut bits = 0x2545_f491_4f6c_dd1du64;
        move || {
            bits ^= bits << 13;
            bits ^= bits >> 7;
            bits ^= bits << 17;
            (bits >> 40) as f32 / (1u64 << 23) as f32 - 1.0
        }
    }

    #[test]
    fn a_dead_motor_is_given_up_after_three_steps_that_ask_for_torque_and_believed_again_at_once() {
        let mut health = MotorHealth::new();
        // The first command has none before it.
        for works in [true, true, true, false] {
            health.update([0.5, -0.5], [0.01, -0.4]);
            assert_eq!(health.work(), [works, true]);
        }
        // What asks for nothing tells nothing.
        health.update([0.0, 0.0], [0.0, 0.0]);
        assert_eq!(health.work(), [false, true]);
        health.update([0.5, 0.0], [0.3, 0.0]);
        assert_eq!(health.work(), [true, true]);
        // Nor does a command that turns round every step.
        for step in 0..100 {
            let torque = if step % 2 == 0 { 0.9 } else { -0.9 };
            health.update([torque; AXES], [0.0; AXES]);
        }
        assert_eq!(health.work(), [true, true]);
    }

    #[test]
    fn weak_motors_that_lag_and_a_noisy_current_sense_raise_no_alarm_in_a_million_steps_and_dead_ones_do_in_half_a_second()
     {
        let mut number = numbers();
        // Twelve uniform numbers: a variance of 4.
        let mut noise = move || 0.02 * 0.5 * (0..12).map(|_| number()).sum::<f32>();
        let (mut health, mut torque, mut motor) = (MotorHealth::new(), [0.0f32; AXES], [0.0f32; AXES]);
        let mut number = numbers();
        for step in 0..1_000_000 {
            for (axis, (torque, motor)) in torque.iter_mut().zip(&mut motor).enumerate() {
                // A gait that swings, and changes.
                let swing = libm::sinf(step as f32 * (0.2 + 0.1 * axis as f32)) + 0.5 * number();
                *torque = (*torque + (swing - *torque).clamp(-0.5, 0.5)).clamp(-1.0, 1.0);
                // It gets seven tenths of the way within the step.
                *motor += 0.7 * (*torque - *motor);
            }
            health.update(torque, motor.map(|t| 0.67 * t + noise()));
            assert_eq!(health.work(), [true; AXES], "step {step}");
        }
        let mut waited = 0;
        while health.work() != [false; AXES] {
            waited += 1;
            for (axis, torque) in torque.iter_mut().enumerate() {
                let swing = libm::sinf(waited as f32 * (0.2 + 0.1 * axis as f32));
                *torque = (*torque + (swing - *torque).clamp(-0.5, 0.5)).clamp(-1.0, 1.0);
            }
            health.update(torque, [noise(), noise()]);
        }
        assert!(waited <= 10, "{waited}");
    }
}
