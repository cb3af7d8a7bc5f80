//! What the light of a module says: on is well, so many flashes in a row name a trouble.

use crate::controller::Micros;
use crate::failsafe::{Fault, FaultSet};

/// Flashes of a module without a node page.
pub const NO_PAGE: u8 = 1;
/// Flashes of a module without a policy that it can run.
pub const NO_POLICY: u8 = 2;
/// Flashes of a module whose crystal does not start.
pub const NO_CRYSTAL: u8 = 3;
/// Flashes of a module whose number is taken.
pub const NUMBER_TAKEN: u8 = 4;
/// Flashes of a stopped module.
pub const STOPPED: u8 = 5;

/// How long the light is on in a flash, and off after it, microseconds.
pub const STEP_US: Micros = 200_000;

/// Flashes in a row for these faults; 0: the light is on.
pub fn flashes(faults: FaultSet) -> u8 {
    if faults.contains(Fault::DuplicateNode) {
        NUMBER_TAKEN
    } else if faults.contains(Fault::EmergencyStop) {
        STOPPED
    } else {
        0
    }
}

/// Whether the light is on at `now`: so many flashes, then a pause as long as three.
pub fn lit(flashes: u8, now: Micros) -> bool {
    let steps = 2 * (u64::from(flashes) + 3);
    let step = now / STEP_US % steps;
    flashes == 0 || (step % 2 == 1 && step < 2 * u64::from(flashes))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn so_many_flashes_and_a_pause() {
        for count in [NO_PAGE, NO_POLICY, NO_CRYSTAL, NUMBER_TAKEN, STOPPED] {
            let on: std::vec::Vec<bool> = (0..2 * (u64::from(count) + 3)).map(|k| lit(count, k * STEP_US)).collect();
            assert_eq!(on.iter().filter(|on| **on).count(), usize::from(count));
            assert!(on[2 * usize::from(count)..].iter().all(|on| !on), "the pause is longer than a flash");
        }
        assert!((0..9).all(|k| lit(0, k * STEP_US)));
    }
}
