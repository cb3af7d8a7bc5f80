//! What becomes of a motor that its driver cut off: it is allowed again after a rest, a few times; then it stays off until somebody says otherwise.
//!
//! A cut-off stays with its axis: the other motor and all sensors go on. While an axis is cut off fault 45 says so on the bus. More than [`MOST`] cut-offs
//! without [`FORGET_US`] of peace between them are a broken motor, cable or bridge, and the fault latches: cleared by the CLEAR command or a restart.

use composer_shared::robot::AXES;

use crate::controller::Micros;
use crate::drivers::motor::Trip;

/// How long a motor that was cut off rests, microseconds.
pub const REST_US: u32 = 1_000_000;
/// Cut-offs that are forgiven.
pub const MOST: u8 = 3;
/// After so long without a cut-off those before are forgotten, microseconds.
pub const FORGET_US: u32 = 60_000_000;

/// One axis.
#[derive(Clone, Copy, Debug, Default)]
struct Axis {
    /// Why the driver has the motor off.
    trip: Option<Trip>,
    /// When it was cut off last.
    at: Micros,
    /// Cut-offs that are not forgotten; saturating.
    count: u8,
    /// The driver was told to begin again and has not said yet that it did.
    told: bool,
}

impl Axis {
    fn latched(&self) -> bool {
        self.count > MOST
    }
}

/// The cut-offs of a module's motors.
#[derive(Clone, Debug, Default)]
pub struct Trips {
    axes: [Axis; AXES],
    /// Cut-offs since power-up, by axis; saturating.
    total: [u16; AXES],
}

impl Trips {
    /// Takes what the drivers say: why each motor is off, if it is.
    pub fn follow(&mut self, now: Micros, reported: [Option<Trip>; AXES]) {
        for ((axis, total), trip) in self.axes.iter_mut().zip(&mut self.total).zip(reported) {
            if !axis.latched() && now.saturating_sub(axis.at) >= u64::from(FORGET_US) {
                axis.count = 0;
            }
            // A new one: also one that comes right after the driver was told to begin again.
            if trip.is_some() && axis.trip.is_none() {
                axis.at = now;
                axis.count = axis.count.saturating_add(1);
                *total = total.saturating_add(1);
            }
            axis.trip = trip;
            axis.told &= trip.is_some();
        }
    }

    /// Which drivers are to begin again now. Each is told once for each cut-off, or once more after another rest if it did not follow.
    pub fn rearm(&mut self, now: Micros) -> [bool; AXES] {
        self.axes.each_mut().map(|axis| {
            let rested = now.saturating_sub(axis.at) >= u64::from(REST_US);
            let now_is_the_time = axis.trip.is_some() && rested && !axis.latched();
            if now_is_the_time {
                // A driver that trips again before the next look shows no gap: count it as if it had.
                if axis.told {
                    axis.count = axis.count.saturating_add(1);
                }
                (axis.at, axis.told) = (now, true);
            }
            now_is_the_time
        })
    }

    /// Whether the motor of an axis is off.
    pub fn off(&self, axis: usize) -> bool {
        self.axes.get(axis).is_none_or(|axis| axis.trip.is_some() || axis.latched())
    }

    /// Whether a motor is off.
    pub fn any(&self) -> bool {
        (0..AXES).any(|axis| self.off(axis))
    }

    /// Whether no motor is off, and none was for so long that it is forgotten.
    pub fn quiet(&self) -> bool {
        self.axes.iter().all(|axis| axis.trip.is_none() && axis.count == 0)
    }

    /// Whether a motor stays off until [`Trips::clear`].
    pub fn latched(&self) -> bool {
        self.axes.iter().any(Axis::latched)
    }

    /// Why each motor is off.
    pub fn reasons(&self) -> [Option<Trip>; AXES] {
        self.axes.map(|axis| axis.trip)
    }

    /// Cut-offs since power-up, by axis.
    pub fn total(&self) -> [u16; AXES] {
        self.total
    }

    /// Somebody has looked after it: what was latched may begin again, and nothing is held against it.
    pub fn clear(&mut self) {
        for axis in &mut self.axes {
            (axis.count, axis.told) = (0, false);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const OVERCURRENT: Option<Trip> = Some(Trip::Overcurrent);
    const SECOND: Micros = 1_000_000;

    /// A driver that trips whenever it is allowed, as with a shorted motor, for so many seconds; how often it was allowed to begin again.
    fn shorted(trips: &mut Trips, from: Micros, seconds: u64) -> u32 {
        let mut times = 0;
        let mut trip = OVERCURRENT;
        for now in (from..from + seconds * SECOND).step_by(1000) {
            trips.follow(now, [trip, None]);
            trip = OVERCURRENT;
            if trips.rearm(now)[0] {
                times += 1;
                // For a moment it does drive.
                trip = None;
            }
        }
        times
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn a_shorted_motor_is_given_up_after_a_few_and_begins_again_only_when_told() {
        let mut trips = Trips::default();
        assert_eq!(shorted(&mut trips, 0, 600), u32::from(MOST));
        assert!(trips.latched() && trips.off(0));
        assert_eq!(trips.total(), [u16::from(MOST) + 1, 0]);
        // Time alone forgives nothing.
        assert_eq!(shorted(&mut trips, 1200 * SECOND, 10), 0);
        trips.clear();
        assert!(!trips.latched() && trips.off(0));
        assert!(shorted(&mut trips, 2000 * SECOND, 600) <= u32::from(MOST) + 1);
        assert!(trips.latched());
    }

    #[test]
    #[cfg_attr(miri, ignore = "takes hours there")]
    fn a_driver_that_never_shows_a_gap_is_given_up_too() {
        let mut trips = Trips::default();
        let mut times = 0;
        for now in (0..600 * SECOND).step_by(1000) {
            trips.follow(now, [None, OVERCURRENT]);
            times += u32::from(trips.rearm(now)[1]);
        }
        assert!(times <= u32::from(MOST) + 1, "{times}");
        assert!(trips.latched());
    }

    #[test]
    fn a_trip_stays_with_its_axis_and_is_over_after_a_rest() {
        let mut trips = Trips::default();
        trips.follow(0, [None, Some(Trip::CurrentSense)]);
        assert!(!trips.off(0) && trips.off(1) && trips.any() && !trips.latched());
        assert_eq!(trips.reasons(), [None, Some(Trip::CurrentSense)]);
        assert_eq!(trips.rearm(SECOND - 1), [false; AXES]);
        assert_eq!(trips.rearm(SECOND), [false, true]);
        trips.follow(SECOND + 1000, [None; AXES]);
        assert!(!trips.any());
    }

    #[test]
    fn what_was_long_ago_is_forgotten() {
        let mut trips = Trips::default();
        for i in 0..20 {
            let now = i * 2 * u64::from(FORGET_US);
            trips.follow(now, [OVERCURRENT, None]);
            assert_eq!(trips.rearm(now + SECOND), [true, false], "{i}");
            trips.follow(now + SECOND + 1000, [None; AXES]);
        }
        assert!(!trips.latched());
        assert_eq!(trips.total(), [20, 0]);
    }
}
