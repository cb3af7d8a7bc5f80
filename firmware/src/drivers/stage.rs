//! Both motors of a module in step: what the interrupt of the current loops does, without the chip.
//!
//! The board reads its converter, calls [`Stage::run`] and keeps the answer; the main loop says what it wants by a [`Command`] and takes what was
//! [`Measured`]. Each side may be faster than the other: what is to happen once ([`Command::rearm`]) is kept until the loops have seen it, and of the supply the extremes
//! are kept until the main loop has.

use composer_shared::robot::AXES;
use embedded_hal::digital::OutputPin;
use embedded_hal::pwm::SetDutyCycle;

use super::motor::{Motor, MotorConfig, Trip};
use crate::node_page::{LOWEST_SUPPLY, MotorCalibration};
use crate::power::Power;
use crate::supply::Extremes;

/// Weight of a new sample in the mean torque: about a millisecond at 10 kHz.
const SMOOTHING: f32 = 0.1;

/// What the main loop wants.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Command {
    /// Torques, yaw and pitch, in the robot's torque unit; none: coast.
    pub torque: Option<[f32; AXES]>,
    /// Motors that were cut off and may begin again, by axis.
    pub rearm: [bool; AXES],
}

impl Command {
    /// This command after one that the loops may not have seen: what was to happen once still is.
    #[must_use]
    pub fn after(self, unseen: Command) -> Self {
        let [yaw, pitch] = self.rearm;
        let [unseen_yaw, unseen_pitch] = unseen.rearm;
        Command { torque: self.torque, rearm: [yaw || unseen_yaw, pitch || unseen_pitch] }
    }

    /// What the loops do of it: with safe torque off ([`crate::torque_off`]) the motors coast.
    #[must_use]
    pub fn unless(self, off: bool) -> Self {
        Command { torque: self.torque.filter(|_| !off), ..self }
    }

    /// What is left of it when the loops have seen it.
    #[must_use]
    pub fn seen(self) -> Self {
        Command { rearm: [false; AXES], ..self }
    }
}

/// What the converter read, as parts of its range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Readings {
    /// Current senses, yaw and pitch.
    pub currents: [f32; AXES],
    /// The divider of the supply.
    pub supply: f32,
}

/// What the loops report.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured {
    /// Currents of the last run, A.
    pub current: [f32; AXES],
    /// Torques by the currents, smoothed, in the robot's torque unit. Zero where the current cannot be measured.
    pub torque: [f32; AXES],
    /// What cut a motor off.
    pub trip: [Option<Trip>; AXES],
    /// The supply in the last run, V.
    pub volts: f32,
    /// Lowest and highest supply since the main loop looked; none before the first run.
    pub supply: Option<Extremes>,
    /// Counts the runs of the loops.
    pub loops: u32,
}

impl Measured {
    /// Before the first run.
    pub const NOTHING: Measured =
        Measured { current: [0.0; AXES], torque: [0.0; AXES], trip: [None; AXES], volts: 0.0, supply: None, loops: 0 };

    /// What the controller is told.
    pub fn power(&self) -> Power {
        Power { supply: self.supply, trips: self.trip }
    }

    /// What is left of it when the main loop has looked.
    #[must_use]
    pub fn taken(self) -> Self {
        Measured { supply: self.supply.map(|_| Extremes::steady(self.volts)), ..self }
    }
}

/// The motors with what was measured of them.
#[derive(Debug)]
pub struct Stage<P, D, E> {
    axes: [(Motor<P, D, E>, MotorCalibration); AXES],
    /// Supply voltage at the end of the converter's range, V.
    supply_range: f32,
    /// The two supplies before, V: one sample alone may be a spike on the wire.
    before: [f32; 2],
}

/// What the driver of a motor is to know of it; `bandwidth` (rad/s) and `period` (s) are those of the current loops.
pub fn motor_config(calibration: &MotorCalibration, bandwidth: f32, period: f32) -> MotorConfig {
    let MotorCalibration { torque_constant, current_limit, cut_off, resistance, inductance, .. } = *calibration;
    MotorConfig {
        torque_constant,
        current_limit,
        cut_off,
        resistance,
        inductance,
        bandwidth,
        period,
        lowest_supply: LOWEST_SUPPLY,
    }
}

impl<P: SetDutyCycle, D: OutputPin, E: OutputPin> Stage<P, D, E> {
    /// Motors that coast. The divider makes `supply_range` volts the end of the converter's range.
    pub fn new(axes: [(Motor<P, D, E>, MotorCalibration); AXES], supply_range: f32) -> Self {
        Stage { axes, supply_range, before: [f32::NAN; 2] }
    }

    /// Goes on by one period of the current loops.
    pub fn run(&mut self, command: Command, last: Measured, readings: Readings) -> Measured {
        let volts = readings.supply * self.supply_range;
        let mut starved = false;
        let mut measured = Measured { loops: last.loops.wrapping_add(1), volts, ..last };
        for (axis, (motor, calibration)) in self.axes.iter_mut().enumerate() {
            let of = |values: [f32; AXES]| values.get(axis).copied();
            if command.rearm.get(axis).is_some_and(|rearm| *rearm) {
                motor.rearm();
            }
            let current = of(readings.currents).map_or(f32::NAN, |reading| calibration.current(reading));
            motor.set_torque(command.torque.and_then(of));
            motor.step(current, volts);
            starved |= motor.starved();
            let known = if current.is_nan() { 0.0 } else { motor.torque(current) };
            if let Some(torque) = measured.torque.get_mut(axis) {
                *torque += SMOOTHING * (known - *torque);
            }
            if let Some(place) = measured.current.get_mut(axis) {
                *place = current;
            }
            if let Some(trip) = measured.trip.get_mut(axis) {
                *trip = motor.trip();
            }
        }
        // A dip that a motor had to coast for counts at once, any other sample only with the two before.
        let [a, b] = self.before;
        let counts = if starved || a.is_nan() || b.is_nan() { volts } else { a.min(b).max(a.max(b).min(volts)) };
        self.before = [b, volts];
        measured.supply = Some(last.supply.map_or(Extremes::steady(counts), |extremes| extremes.with(counts)));
        measured
    }

    /// Lets both motors coast at once; the next run goes on.
    pub fn coast(&mut self) {
        self.axes.iter_mut().for_each(|(motor, _)| motor.coast());
    }
}

#[cfg(test)]
mod tests {
    use super::super::motor::tests::{Line, SUPPLY};
    use super::*;
    use crate::limits::Caps;
    use crate::node_page::Calibration;
    use crate::power::PowerWatch;
    use crate::safety::Safety;
    use crate::supply::Supply;
    use composer_shared::robot::Limits;

    /// Volts at the end of the converter's range.
    const RANGE: f32 = 36.3;
    const STEADY: Readings = Readings { currents: [0.5; AXES], supply: SUPPLY / RANGE };

    struct Bench {
        stage: Stage<Line, Line, Line>,
        enable: [Line; AXES],
        measured: Measured,
    }

    impl Bench {
        fn new() -> Self {
            let enable = [Line::default(), Line::default()];
            let calibrations = Calibration::NOMINAL.motors;
            let mut axes = enable.iter().zip(calibrations).map(|(enable, calibration)| {
                let config = motor_config(&calibration, 3000.0, 1e-4);
                (Motor::new(Line::default(), Line::default(), enable.clone(), config), calibration)
            });
            let axes = core::array::from_fn(|_| axes.next().unwrap());
            Bench { stage: Stage::new(axes, RANGE), enable, measured: Measured::NOTHING }
        }

        fn run(&mut self, command: Command, readings: Readings) {
            self.measured = self.stage.run(command, self.measured, readings);
        }

        fn driven(&self) -> [bool; AXES] {
            self.enable.each_ref().map(|enable| enable.0.get() == 1)
        }
    }

    /// The reading of a current sense for a current, A.
    fn sense(current: f32) -> f32 {
        0.5 + current / 6.6
    }

    #[test]
    fn a_trip_stays_with_its_axis_and_every_torque_stays_a_number() {
        let mut bench = Bench::new();
        let command = Command { torque: Some([8.0, 8.0]), ..Command::default() };
        for _ in 0..3 {
            bench.run(command, Readings { currents: [sense(2.9), sense(0.1)], ..STEADY });
        }
        assert_eq!(bench.measured.trip, [Some(Trip::Overcurrent), None]);
        assert_eq!(bench.driven(), [false, true]);
        bench.run(command, Readings { currents: [0.5, f32::NAN], ..STEADY });
        assert_eq!(bench.measured.trip, [Some(Trip::Overcurrent), Some(Trip::CurrentSense)]);
        assert!(bench.measured.torque.iter().all(|torque| torque.is_finite()), "{:?}", bench.measured);
        // Coasting and beginning to drive again is no rearming, as a gap of SYNC makes it.
        for torque in [None, Some([8.0; AXES])] {
            bench.run(Command { torque, ..Command::default() }, STEADY);
        }
        assert_eq!(bench.driven(), [false, false]);
        // Each axis has its own.
        bench.run(Command { rearm: [false, true], ..command }, STEADY);
        assert_eq!((bench.measured.trip, bench.driven()), ([Some(Trip::Overcurrent), None], [false, true]));
    }

    #[test]
    fn what_is_to_happen_once_is_not_lost_and_happens_once() {
        let unseen = Command { torque: Some([1.0; AXES]), rearm: [true, false] };
        let next = Command { torque: None, rearm: [false, false] }.after(unseen);
        assert_eq!(next, Command { torque: None, rearm: [true, false] });
        assert_eq!(next.seen(), Command { torque: None, rearm: [false; AXES] });
    }

    #[test]
    fn a_dip_between_two_looks_of_the_main_loop_is_reported_and_a_spike_on_the_wire_is_not() {
        let mut bench = Bench::new();
        let volts = |volts: f32| Readings { supply: volts / RANGE, ..STEADY };
        let supply = |bench: &Bench| bench.measured.supply.unwrap();
        let coast = Command::default();
        for v in [12.0, 12.0, 12.0, 3.0, 12.0, 12.0, 30.0, 12.0, 12.0] {
            bench.run(coast, volts(v));
        }
        assert!((supply(&bench).lowest - 12.0).abs() < 0.01 && (supply(&bench).highest - 12.0).abs() < 0.01);
        for v in [8.0, 8.0, 12.0, 12.0] {
            bench.run(coast, volts(v));
        }
        assert!((supply(&bench).lowest - 8.0).abs() < 0.01);
        bench.measured = bench.measured.taken();
        assert!((supply(&bench).lowest - 12.0).abs() < 0.01, "looked at, and over");
        // A single sample that a motor had to coast for is no matter of taste.
        let drive = Command { torque: Some([8.0; AXES]), ..coast };
        for v in [12.0, 5.0, 12.0, 12.0] {
            bench.run(drive, volts(v));
        }
        assert_eq!(bench.driven(), [false; AXES]);
        assert!((supply(&bench).lowest - 5.0).abs() < 0.01);
    }

    /// The rail goes and comes back; the main loop looks every millisecond, relaxes by what it sees, and slews from zero.
    #[test]
    fn when_the_rail_returns_torque_grows_at_the_pace_of_the_slew_limit() {
        let mut bench = Bench::new();
        let mut watch = PowerWatch::new(Safety::BOARD.supply);
        let limits = Limits::default();
        let (mut torque, mut largest) = (80.0f32, 0.0f32);
        let mut current = 1.0;
        for tick in 0..6000u64 {
            let rail = if (100..103).contains(&tick) { 5.0 } else { SUPPLY };
            if tick % 10 == 0 {
                watch.follow(tick * 100, &bench.measured.power());
                bench.measured = bench.measured.taken();
                let good = watch.supply() == Supply::Good;
                torque = if good { Caps::NONE.command(&limits, torque, 1.0, 1e-3) } else { 0.0 };
            }
            let wanted = (watch.supply() == Supply::Good).then_some([torque, 0.0]);
            let command = Command { torque: wanted, ..Command::default() };
            bench.run(command, Readings { currents: [sense(current), 0.5], supply: rail / RANGE });
            // A motor that follows at once.
            current = if bench.driven()[0] { torque / 80.0 } else { 0.0 };
            if tick >= 100 {
                let since = (tick - 100) as f32 * 1e-4;
                largest = largest.max(current * 80.0 - limits.torque_slew * since);
                assert!(since > 0.1 || current == 0.0, "{current} A {since} s after the dip");
            }
        }
        assert!(largest <= 0.0, "{largest} more than the slew limit allows");
        assert!(current > 0.9, "and in the end it is all there: {current} A");
    }
}
