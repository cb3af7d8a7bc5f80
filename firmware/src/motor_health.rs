//! Whether the own motors work, told from the torque that was commanded and the torque that was measured. The environment of the training runs the
//! same code, so that the policy learns to live with what it is told.
//!
//! A motor is taken for dead when in [`STEPS`] control steps in a row, as far as they tell anything, it was asked for torque and gave none; it is taken for
//! sound again when in as many steps it gave torque in the direction that was asked for. A step tells something if this command and the one before ask
//! for more than [`ASKED`] in the same direction: then a motor that lags behind its command, by its slew or a late command, gives torque all the same.
//!
//! **Motion.** A motor that already turns in the direction of its torque at nearly its no-load speed ([`FAST`]) cannot draw a current: its own voltage is
//! in the way. Such a step tells nothing.
//!
//! **False alarms.** A motor of two thirds of its nominal strength gives .13 where .2 are asked for, and is in doubt below [`NONE`], .06. With a current sense
//! whose noise is .02 of the torque limit (standard deviation) that takes 3.7 of them, p = 1e-4, three times in a row: at most 1e-12 a step, less than
//! one false alarm in a thousand years of 20 steps a second, of a motor that is always at the edge. A dead motor is believed again by its noise alone as rarely:
//! p = 1e-3 a step, three times in a row. Under the sensor model, in episodes of every task on robots of `vary-lab`, the tests of the host find none,
//! and a dead motor is found within half a second of asking it for torque.

use composer_shared::observation::Sensors;
use composer_shared::robot::AXES;

/// Steps in a row that change what is believed of a motor.
pub const STEPS: u8 = 3;
/// Torque that has to be asked for, as a fraction of the limit.
pub const ASKED: f32 = 0.2;
/// Torque that is as good as none, as a fraction of the limit.
pub const NONE: f32 = 0.06;
/// Share of the no-load speed from which on a motor may give no torque in the direction in which it turns.
pub const FAST: f32 = 0.9;

/// What is known of one motor.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Motor {
    dead: bool,
    /// Command of the step before.
    before: f32,
    /// Steps in a row that speak against what is believed.
    against: u8,
}

impl Motor {
    /// `along`: the joint's speed in the direction of the command, as a share of the no-load speed.
    fn update(&mut self, commanded: f32, measured: f32, along: f32) {
        if !commanded.is_finite() {
            return;
        }
        let direction = if commanded < 0.0 { -1.0 } else { 1.0 };
        let asked = (direction * commanded).min(direction * self.before);
        self.before = commanded;
        let gives = measured.abs() >= NONE;
        let against = match self.dead {
            // Torque from a motor that is sound ends all doubt, whether it was asked for or not.
            false if gives => Some(false),
            false if along < FAST => (asked > ASKED).then_some(true),
            false => None,
            true => (asked > ASKED).then_some(direction * measured >= NONE),
        };
        self.against = match against {
            Some(true) => self.against.saturating_add(1),
            Some(false) => 0,
            None => self.against,
        };
        if self.against >= STEPS {
            (self.dead, self.against) = (!self.dead, 0);
        }
    }
}

/// What is known of the motors of a module: nothing at first, and they count as sound.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct MotorHealth([Motor; AXES]);

impl MotorHealth {
    /// After a control step: the torque that was commanded in it, yaw and pitch, as a fraction of the limit, and what the sensors read at its end;
    /// `no_load_speed` of the motors, rad/s. A sample that cannot be believed tells nothing.
    pub fn update(&mut self, commanded: [f32; AXES], sensors: &Sensors, no_load_speed: f32) {
        if !sensors.plausible() {
            return;
        }
        let axes = self.0.iter_mut().zip(commanded).zip(sensors.torque);
        for (axis, ((motor, commanded), measured)) in axes.enumerate() {
            // Even joints yaw, odd joints pitch.
            let speeds = sensors.joint_speeds.iter().skip(axis).step_by(AXES);
            let along = speeds.fold(0.0, |most: f32, speed| most.max(if commanded < 0.0 { -speed } else { *speed }));
            motor.update(commanded, measured, along / no_load_speed);
        }
    }

    /// Whether each motor works, yaw and pitch.
    pub fn work(&self) -> [bool; AXES] {
        self.0.map(|motor| !motor.dead)
    }
}

/// Share of motors that work, as neighbours are told.
pub fn share(work: [bool; AXES]) -> f32 {
    work.iter().filter(|works| **works).count() as f32 / AXES as f32
}

#[cfg(test)]
mod tests {
    use super::*;

    const NO_LOAD: f32 = 3.0;

    fn sample(torque: [f32; AXES]) -> Sensors {
        Sensors { up: [0.0, 0.0, 1.0], torque, ..Sensors::ZERO }
    }

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
    fn a_dead_motor_is_given_up_after_three_steps_that_ask_for_torque_and_believed_again_after_three_that_get_it() {
        let mut health = MotorHealth::default();
        let mut update = |commanded, torque| {
            health.update(commanded, &sample(torque), NO_LOAD);
            health.work()
        };
        // The first command has none before it.
        for works in [true, true, true, false] {
            assert_eq!(update([0.5, -0.5], [0.01, -0.4]), [works, true]);
        }
        // What asks for nothing tells nothing, and torque in the wrong direction is none.
        assert_eq!(update([0.0, 0.0], [0.0, 0.0]), [false, true]);
        for _ in 0..10 {
            assert_eq!(update([0.5, 0.0], [-0.3, 0.0]), [false, true]);
        }
        for works in [false, false, true] {
            assert_eq!(update([0.5, 0.0], [0.3, 0.0]), [works, true]);
        }
        // Nor does a command that turns round every step.
        for step in 0..100 {
            let torque = if step % 2 == 0 { 0.9 } else { -0.9 };
            assert_eq!(update([torque; AXES], [0.0; AXES]), [true, true]);
        }
    }

    #[test]
    fn what_tells_nothing_changes_nothing() {
        let mut health = MotorHealth::default();
        for _ in 0..10 {
            health.update([1.0; AXES], &Sensors::ZERO, NO_LOAD);
            let fast = Sensors { joint_speeds: [0.0, 0.0, 2.8, -2.8], ..sample([0.0; AXES]) };
            health.update([1.0, -1.0], &fast, NO_LOAD);
            health.update([f32::NAN; AXES], &sample([0.0; AXES]), NO_LOAD);
        }
        assert_eq!((health.work(), share(health.work())), ([true; AXES], 1.0));
        // Against its direction no speed is an excuse.
        for _ in 0..4 {
            let braking = Sensors { joint_speeds: [-2.8, 0.0, 0.0, 0.0], ..sample([0.0; AXES]) };
            health.update([1.0, 0.0], &braking, NO_LOAD);
        }
        assert_eq!((health.work(), share(health.work())), ([false, true], 0.5));
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn weak_motors_that_lag_and_a_noisy_current_sense_raise_no_alarm_in_a_million_steps_and_dead_ones_do_in_half_a_second()
     {
        let mut number = numbers();
        // Twelve uniform numbers: a variance of 4.
        let mut noise = move || 0.02 * 0.5 * (0..12).map(|_| number()).sum::<f32>();
        let (mut health, mut torque, mut motor) = (MotorHealth::default(), [0.0f32; AXES], [0.0f32; AXES]);
        let mut number = numbers();
        for step in 0..1_000_000 {
            for (axis, (torque, motor)) in torque.iter_mut().zip(&mut motor).enumerate() {
                // A gait that swings, and changes.
                let swing = libm::sinf(step as f32 * (0.2 + 0.1 * axis as f32)) + 0.5 * number();
                *torque = (*torque + (swing - *torque).clamp(-0.5, 0.5)).clamp(-1.0, 1.0);
                // It gets seven tenths of the way within the step.
                *motor += 0.7 * (*torque - *motor);
            }
            health.update(torque, &sample(motor.map(|t| 0.67 * t + noise())), NO_LOAD);
            assert_eq!(health.work(), [true; AXES], "step {step}");
        }
        let mut waited = 0;
        while health.work() != [false; AXES] {
            waited += 1;
            for (axis, torque) in torque.iter_mut().enumerate() {
                let swing = libm::sinf(waited as f32 * (0.2 + 0.1 * axis as f32));
                *torque = (*torque + (swing - *torque).clamp(-0.5, 0.5)).clamp(-1.0, 1.0);
            }
            health.update(torque, &sample([noise(), noise()]), NO_LOAD);
        }
        assert!(waited <= 10, "{waited}");
        // Noise alone does not bring it back.
        for step in 0..1_000_000 {
            for (axis, torque) in torque.iter_mut().enumerate() {
                let swing = libm::sinf((waited + step) as f32 * (0.2 + 0.1 * axis as f32));
                *torque = (*torque + (swing - *torque).clamp(-0.5, 0.5)).clamp(-1.0, 1.0);
            }
            health.update(torque, &sample([noise(), noise()]), NO_LOAD);
            assert_eq!(health.work(), [false; AXES], "step {step}");
        }
    }
}
