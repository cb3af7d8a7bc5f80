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
}

impl PowerWatch {
    /// Everything good.
    pub fn new(thresholds: Thresholds) -> Self {
        PowerWatch { supply: SupplyWatch::new(thresholds), trips: Trips::default() }
    }

    /// Takes what the board says.
    pub fn follow(&mut self, now: Micros, power: &Power) {
        if let Some(measured) = power.supply {
            self.supply.follow(now, measured);
        }
        self.trips.follow(now, power.trips);
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
