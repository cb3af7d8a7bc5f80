//! The power side of a module: what the board says of its supply and motors, and what follows from it.
//!
//! It is beside [`Sensors`](composer_shared::observation::Sensors), not in them: policies know nothing of it.

use composer_shared::robot::AXES;

use crate::controller::Micros;
use crate::drivers::motor::Trip;
use crate::supply::{Extremes, Supply, SupplyWatch, Thresholds};
use crate::trips::Trips;

/// What a board measured since the last poll.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Power {
    /// The supply, V; none if this board does not measure it.
    pub supply: Option<Extremes>,
    /// Why the driver of each motor (yaw, pitch) has it off, if it has.
    pub trips: [Option<Trip>; AXES],
}

/// Supply and cut-offs of a module, from poll to poll.
#[derive(Clone, Debug)]
pub struct PowerWatch {
    supply: SupplyWatch,
    trips: Trips,
    /// What was said last.
    last: Power,
    /// All is good and has been for long: the same words once more change nothing.
    quiet: bool,
}

impl PowerWatch {
    /// Everything good.
    pub fn new(thresholds: Thresholds) -> Self {
        let (trips, last) = (Trips::default(), Power::default());
        PowerWatch { supply: SupplyWatch::new(thresholds), trips, last, quiet: true }
    }

    /// Takes what the board says. Answers whether that may change anything: frames come faster than measurements.
    #[inline]
    pub fn follow(&mut self, now: Micros, power: &Power) -> bool {
        if self.quiet && power.supply == self.last.supply && power.trips.iter().all(Option::is_none) {
            return false;
        }
        self.follow_news(now, power);
        true
    }

    fn follow_news(&mut self, now: Micros, power: &Power) {
        self.last = *power;
        if let Some(measured) = power.supply {
            self.supply.follow(now, measured);
        }
        self.trips.follow(now, power.trips);
        self.quiet = self.supply() == Supply::Good && self.trips.quiet();
    }

    /// Whether no motor is off and the supply is good.
    #[inline]
    pub fn quiet(&self) -> bool {
        self.quiet
    }

    /// What is wrong with the supply.
    pub fn supply(&self) -> Supply {
        self.supply.state()
    }

    /// What was cut off.
    pub fn trips(&self) -> &Trips {
        &self.trips
    }

    /// Which motors' drivers are to begin again now, see [`Trips::rearm`].
    pub fn rearm(&mut self, now: Micros) -> [bool; AXES] {
        self.trips.rearm(now)
    }

    /// Somebody has looked after the motors, see [`Trips::clear`].
    pub fn clear(&mut self) {
        self.trips.clear();
    }
}
