//! A brushed DC motor behind an H-bridge, driven by its current.
//!
//! The bridge has a PWM input (duty: voltage), a direction input and an enable input that floats the motor when low ("phase/enable"
//! mode, for example TI DRV8874 or DRV8701). Torque is proportional to current, so a torque command becomes a current set-point and a PI
//! loop makes the motor follow it. [`Motor::step`] is called at a fixed rate, with the current measured in that period.
//!
//! The loop cancels the motor's own pole: with resistance R, inductance L and bandwidth w the gains are `kp = w L` and `ki = w R`, and the
//! current follows its set-point like a low-pass of first order with w.
//!
//! # Cut-off
//!
//! [`TRIP_AFTER`] samples in a row beyond the cut-off current, a current that is not a number, or an output that fails let the motor coast
//! until [`Motor::rearm`]: [`Motor::trip`] says why. How often it may be rearmed is for [`crate::trips`] to say.
//!
//! Without supply it coasts, too. When the supply is back it does not pull with all that was asked of it at once: it stays [starved](Motor::starved) until it was
//! told to coast, which is what the controller does at the fault that follows ([`crate::supply`]); torque then grows from zero.

use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;

/// Samples beyond the cut-off current that trip: one alone may be a spike on the wire.
pub const TRIP_AFTER: u8 = 3;

/// What is on the shaft, and how it is to be driven.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorConfig {
    /// Torque per ampere, in the robot's torque unit, gear included. Negative: the wires are swapped.
    pub torque_constant: f32,
    /// Largest current set-point, A.
    pub current_limit: f32,
    /// Current that trips, A.
    pub cut_off: f32,
    /// Winding resistance, ohm.
    pub resistance: f32,
    /// Winding inductance, H.
    pub inductance: f32,
    /// Bandwidth of the current loop, rad/s; at most a tenth of the rate of [`Motor::step`] times 2 pi.
    pub bandwidth: f32,
    /// Time between two steps, s.
    pub period: f32,
    /// Supply voltage below which nothing is driven, V.
    pub lowest_supply: f32,
}

/// Why a motor coasts until it is rearmed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Trip {
    /// Too much current.
    Overcurrent,
    /// The measured current is not a number.
    CurrentSense,
    /// A pin or the PWM failed.
    Output,
}

impl Trip {
    /// What is wrong, in words.
    pub const fn name(self) -> &'static str {
        match self {
            Trip::Overcurrent => "overcurrent",
            Trip::CurrentSense => "no current reading",
            Trip::Output => "an output failed",
        }
    }
}

/// One motor with its bridge.
#[derive(Debug)]
pub struct Motor<P, D, E> {
    pwm: P,
    direction: D,
    enable: E,
    config: MotorConfig,
    /// Wanted current, A; none: coast.
    set_point: Option<f32>,
    /// Integral part of the voltage, V.
    integral: f32,
    beyond: u8,
    trip: Option<Trip>,
    starved: bool,
    driving: bool,
}

impl<P: SetDutyCycle, D: OutputPin, E: OutputPin> Motor<P, D, E> {
    /// A motor that coasts.
    pub fn new(pwm: P, direction: D, enable: E, config: MotorConfig) -> Self {
        let mut motor = Motor {
            pwm,
            direction,
            enable,
            config,
            set_point: None,
            integral: 0.0,
            beyond: 0,
            trip: None,
            starved: false,
            driving: true,
        };
        motor.coast();
        motor
    }

    /// Sets the torque (robot's torque unit) to follow from the next step on; none, or not a number, lets the motor coast.
    pub fn set_torque(&mut self, torque: Option<f32>) {
        let limit = self.config.current_limit;
        self.set_point = torque
            .map(|torque| torque / self.config.torque_constant)
            .filter(|current| !current.is_nan())
            .map(|current| current.max(-limit).min(limit));
        self.starved &= self.set_point.is_some();
    }

    /// The torque that a measured current (A) means.
    pub fn torque(&self, current: f32) -> f32 {
        current * self.config.torque_constant
    }

    /// Goes on by one period: `current` (A) was measured, the supply has `supply` volts. Returns the voltage put on the motor, V.
    pub fn step(&mut self, current: f32, supply: f32) -> f32 {
        self.watch(current);
        let (Some(set_point), None) = (self.set_point, self.trip) else {
            self.coast();
            return 0.0;
        };
        // Also without a reading of the supply.
        self.starved |= supply.is_nan() || supply < self.config.lowest_supply;
        if self.starved {
            self.coast();
            return 0.0;
        }
        let error = set_point - current;
        let wanted = self.config.bandwidth * self.config.inductance * error + self.integral;
        let voltage = wanted.max(-supply).min(supply);
        // At the end of its range the integral may only come back: otherwise it would have to be unwound later.
        if voltage == wanted || (wanted > 0.0) != (error > 0.0) {
            self.integral += self.config.bandwidth * self.config.resistance * self.config.period * error;
            self.integral = self.integral.max(-supply).min(supply);
        }
        if self.drive(voltage / supply).is_err() {
            self.trip = Some(Trip::Output);
            self.coast();
            return 0.0;
        }
        voltage
    }

    /// Lets the motor coast at once, whatever its set-point; the next [`Motor::step`] goes on.
    pub fn coast(&mut self) {
        self.integral = 0.0;
        if !self.driving {
            return;
        }
        // Both are tried even if one fails: either alone takes the force off the motor.
        let floating = self.enable.set_low();
        let off = self.pwm.set_duty_cycle_fully_off();
        if floating.is_err() || off.is_err() {
            self.trip = Some(Trip::Output);
        } else {
            self.driving = false;
        }
    }

    /// Whether the motor had to coast for want of supply and has not been told to coast since.
    pub fn starved(&self) -> bool {
        self.starved
    }

    /// Why the motor coasts until it is rearmed, if it does.
    pub fn trip(&self) -> Option<Trip> {
        self.trip
    }

    /// Allows the motor to be driven again after a trip.
    pub fn rearm(&mut self) {
        self.trip = None;
        self.beyond = 0;
    }

    fn watch(&mut self, current: f32) {
        if current.is_nan() {
            self.trip = Some(Trip::CurrentSense);
        } else if current.abs() > self.config.cut_off {
            self.beyond = self.beyond.saturating_add(1);
            if self.beyond >= TRIP_AFTER {
                self.trip = Some(Trip::Overcurrent);
            }
        } else {
            self.beyond = 0;
        }
    }

    /// Drives with a part of the supply voltage, -1 to 1.
    fn drive(&mut self, part: f32) -> Result<(), ()> {
        let most = self.pwm.max_duty_cycle();
        // The conversion saturates; the minimum is against rounding up beyond the full duty.
        let duty = ((part.abs() * f32::from(most) + 0.5) as u16).min(most);
        let enabled = core::mem::replace(&mut self.driving, true);
        self.direction.set_state((part < 0.0).into()).map_err(drop)?;
        self.pwm.set_duty_cycle(duty).map_err(drop)?;
        if enabled { Ok(()) } else { self.enable.set_high().map_err(drop) }
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;
    use embedded_hal_mock::eh1::MockError;
    use embedded_hal_mock::eh1::digital::{Mock as Pin, State, Transaction as Set};
    use embedded_hal_mock::eh1::pwm::{Mock as Pwm, Transaction as Duty};
    use proptest::prelude::*;
    use std::cell::Cell;
    use std::convert::Infallible;
    use std::rc::Rc;

    /// 80 torque units at 1 A, a small gear motor at 12 V.
    const CONFIG: MotorConfig = MotorConfig {
        torque_constant: 80.0,
        current_limit: 1.2,
        cut_off: 2.5,
        resistance: 4.0,
        inductance: 1e-3,
        bandwidth: 3000.0,
        period: 1e-4,
        lowest_supply: 6.0,
    };
    pub const SUPPLY: f32 = 12.0;

    /// What the bridge was told, shared with the test.
    #[derive(Clone, Default)]
    pub struct Line(pub Rc<Cell<u16>>);

    impl embedded_hal::pwm::ErrorType for Line {
        type Error = Infallible;
    }
    impl SetDutyCycle for Line {
        fn max_duty_cycle(&self) -> u16 {
            4251
        }
        fn set_duty_cycle(&mut self, duty: u16) -> Result<(), Infallible> {
            assert!(duty <= 4251);
            self.0.set(duty);
            Ok(())
        }
    }
    impl embedded_hal::digital::ErrorType for Line {
        type Error = Infallible;
    }
    impl OutputPin for Line {
        fn set_low(&mut self) -> Result<(), Infallible> {
            self.0.set(0);
            Ok(())
        }
        fn set_high(&mut self) -> Result<(), Infallible> {
            self.0.set(1);
            Ok(())
        }
    }

    /// A motor and what the driver does to it: L di/dt = u - R i - e, solved exactly over a period.
    struct Bench {
        motor: Motor<Line, Line, Line>,
        pwm: Line,
        direction: Line,
        enable: Line,
        resistance: f32,
        current: f32,
        back_emf: f32,
        supply: f32,
    }

    impl Bench {
        fn new(config: MotorConfig) -> Self {
            let (pwm, direction, enable) = (Line::default(), Line::default(), Line::default());
            let motor = Motor::new(pwm.clone(), direction.clone(), enable.clone(), config);
            let resistance = config.resistance;
            Bench { motor, pwm, direction, enable, resistance, current: 0.0, back_emf: 0.0, supply: SUPPLY }
        }

        /// The voltage as the pins say it.
        fn voltage(&self) -> f32 {
            let part = f32::from(self.pwm.0.get()) / 4251.0;
            if self.direction.0.get() == 1 { -part * self.supply } else { part * self.supply }
        }

        fn run(&mut self, steps: usize) {
            for _ in 0..steps {
                self.motor.step(self.current, self.supply);
                if self.enable.0.get() == 0 {
                    self.current = 0.0;
                    continue;
                }
                let end = (self.voltage() - self.back_emf) / self.resistance;
                let decay = (-CONFIG.period * self.resistance / CONFIG.inductance).exp();
                self.current = end + (self.current - end) * decay;
            }
        }
    }

    #[test]
    fn the_current_follows_like_a_low_pass() {
        let mut bench = Bench::new(CONFIG);
        bench.motor.set_torque(Some(60.0));
        // One time constant is 3.3 periods: after ten the rest is a twentieth, after a hundred nothing but the step of the PWM.
        bench.run(10);
        assert!((0.65..0.77).contains(&bench.current), "{}", bench.current);
        let mut peak = 0.0f32;
        for _ in 0..90 {
            bench.run(1);
            peak = peak.max(bench.current);
        }
        assert!((bench.motor.torque(bench.current) - 60.0).abs() < 0.2, "{}", bench.current);
        assert!(peak < 0.75 * 1.05, "overshoot to {peak} A");
        bench.motor.set_torque(Some(-60.0));
        bench.run(100);
        assert!((bench.motor.torque(bench.current) + 60.0).abs() < 0.2, "{}", bench.current);
        assert_eq!(bench.direction.0.get(), 1);
    }

    #[test]
    fn it_holds_against_speed_and_a_wrong_resistance() {
        let mut bench = Bench::new(CONFIG);
        bench.resistance = 5.0;
        bench.back_emf = 4.0;
        bench.motor.set_torque(Some(80.0));
        bench.run(300);
        assert!((bench.current - 1.0).abs() < 0.005, "{}", bench.current);
    }

    #[test]
    fn the_set_point_is_limited() {
        let mut bench = Bench::new(CONFIG);
        bench.motor.set_torque(Some(1e9));
        bench.run(200);
        assert!((bench.current - CONFIG.current_limit).abs() < 0.01, "{}", bench.current);
        bench.motor.set_torque(Some(f32::NEG_INFINITY));
        bench.run(200);
        assert!((bench.current + CONFIG.current_limit).abs() < 0.01, "{}", bench.current);
        assert_eq!(bench.motor.trip(), None);
    }

    #[test]
    fn it_does_not_wind_up_at_the_end_of_the_supply() {
        let mut bench = Bench::new(CONFIG);
        // Faster than the supply can drive: 11 V of back-EMF leave 0.25 A of the 1 A asked for, for a whole second.
        bench.back_emf = 11.0;
        bench.motor.set_torque(Some(80.0));
        bench.run(10_000);
        assert!((bench.current - 0.25).abs() < 0.01, "{}", bench.current);
        // As soon as less is asked for, it is there.
        bench.motor.set_torque(Some(8.0));
        bench.run(15);
        assert!((bench.current - 0.1).abs() < 0.02, "{}", bench.current);
    }

    #[test]
    fn overcurrent_latches_until_rearmed() {
        let mut bench = Bench::new(CONFIG);
        bench.motor.set_torque(Some(40.0));
        bench.run(50);
        for spike in [3.0, 3.0, 0.5, -3.0, 3.0] {
            bench.motor.step(spike, SUPPLY);
        }
        assert_eq!((bench.motor.trip(), bench.enable.0.get()), (None, 1), "two in a row may be noise");
        bench.motor.step(-3.0, SUPPLY);
        assert_eq!(bench.motor.trip(), Some(Trip::Overcurrent));
        assert_eq!((bench.enable.0.get(), bench.pwm.0.get()), (0, 0));
        bench.current = 0.0;
        bench.motor.set_torque(Some(40.0));
        bench.run(100);
        assert_eq!((bench.enable.0.get(), bench.current), (0, 0.0), "it stays off");
        bench.motor.rearm();
        bench.run(100);
        assert!((bench.current - 0.5).abs() < 0.01);
    }

    #[test]
    fn no_reading_no_supply_no_command_no_force() {
        let mut bench = Bench::new(CONFIG);
        assert_eq!(bench.enable.0.get(), 0, "it coasts after power-up");
        bench.motor.set_torque(Some(40.0));
        bench.run(20);
        for supply in [5.9, f32::NAN, -1.0] {
            bench.supply = supply;
            bench.run(1);
            assert_eq!((bench.enable.0.get(), bench.pwm.0.get()), (0, 0));
        }
        bench.supply = SUPPLY;
        bench.run(10);
        assert_eq!(bench.enable.0.get(), 0, "the supply is back, and nobody has said that the motor may be");
        bench.motor.set_torque(None);
        bench.run(1);
        bench.motor.set_torque(Some(40.0));
        bench.run(1);
        assert_eq!(bench.enable.0.get(), 1);
        for torque in [None, Some(f32::NAN)] {
            bench.motor.set_torque(Some(40.0));
            bench.run(2);
            bench.motor.set_torque(torque);
            bench.run(1);
            assert_eq!((bench.enable.0.get(), bench.pwm.0.get()), (0, 0));
        }
        bench.motor.step(f32::NAN, SUPPLY);
        assert_eq!(bench.motor.trip(), Some(Trip::CurrentSense));
    }

    #[test]
    fn a_supply_that_comes_back_does_not_bring_back_the_torque() {
        let mut bench = Bench::new(CONFIG);
        bench.motor.set_torque(Some(80.0));
        bench.run(100);
        assert!((bench.current - 1.0).abs() < 0.01);
        bench.supply = 5.0;
        bench.run(1);
        bench.supply = SUPPLY;
        // It used to have 95 % of the torque again after 0.8 ms.
        for _ in 0..1000 {
            bench.motor.set_torque(Some(80.0));
            bench.run(1);
            assert_eq!((bench.current, bench.motor.starved(), bench.motor.trip()), (0.0, true, None));
        }
        bench.motor.set_torque(None);
        assert!(!bench.motor.starved());
    }

    #[test]
    fn swapped_wires() {
        let mut bench = Bench::new(MotorConfig { torque_constant: -80.0, ..CONFIG });
        bench.motor.set_torque(Some(40.0));
        bench.run(100);
        assert!((bench.current + 0.5).abs() < 0.01);
        assert!((bench.motor.torque(bench.current) - 40.0).abs() < 0.5);
    }

    #[test]
    fn the_bridge_is_told_in_a_safe_order() {
        let off = Duty::set_duty_cycle(0);
        let mut pwm = Pwm::new(&[off.clone(), Duty::max_duty_cycle(100), Duty::set_duty_cycle(38), off]);
        let mut direction = Pin::new(&[Set::set(State::High)]);
        let mut enable = Pin::new(&[Set::set(State::Low), Set::set(State::High), Set::set(State::Low)]);
        let mut motor = Motor::new(pwm.clone(), direction.clone(), enable.clone(), CONFIG);
        motor.set_torque(Some(-120.0));
        let voltage = motor.step(0.0, 9.6);
        assert!((voltage + 1.2 * 3.0).abs() < 1e-5, "{voltage}");
        motor.coast();
        motor.coast();
        pwm.done();
        direction.done();
        enable.done();
    }

    #[test]
    fn an_output_that_fails_trips() {
        let off = Duty::set_duty_cycle(0);
        let failed = Duty::set_duty_cycle(38).with_error(MockError::Io(std::io::ErrorKind::BrokenPipe));
        let mut pwm = Pwm::new(&[off.clone(), Duty::max_duty_cycle(100), failed, off]);
        let mut direction = Pin::new(&[Set::set(State::Low)]);
        let mut enable = Pin::new(&[Set::set(State::Low), Set::set(State::Low)]);
        let mut motor = Motor::new(pwm.clone(), direction.clone(), enable.clone(), CONFIG);
        motor.set_torque(Some(120.0));
        assert_eq!(motor.step(0.0, 9.6), 0.0);
        assert_eq!(motor.trip(), Some(Trip::Output));
        pwm.done();
        direction.done();
        enable.done();
    }

    proptest! {
        /// Whatever is measured and asked for: no panic, never more than the supply, and coasting when tripped.
        #[test]
        fn anything_at_all(steps in proptest::collection::vec((any::<f32>(), any::<f32>(), proptest::option::of(any::<f32>())), 1..50)) {
            let mut bench = Bench::new(CONFIG);
            for (current, supply, torque) in steps {
                bench.motor.set_torque(torque);
                let voltage = bench.motor.step(current, supply);
                prop_assert!(voltage == 0.0 || voltage.abs() <= supply, "{voltage} V of {supply} V");
                if bench.motor.trip().is_some() {
                    prop_assert_eq!((bench.enable.0.get(), bench.pwm.0.get()), (0, 0));
                }
            }
        }
    }
}
