//! Is the supply fit to drive with? Thresholds with hysteresis, and the extremes of what was measured between two polls.
//!
//! A rail that sags takes the motors with it: without a fault they would coast, and pull with all they were asked for the moment the rail is back. So too
//! little (fault 43) or too much (fault 44, a motor that brakes pumps up the rail) *relaxes* the module until the supply has been good for [`SETTLE_US`],
//! and then torques grow from zero at the pace of the slew limit. The driver of a motor that had to coast for want of supply waits for that, too
//! ([`crate::drivers::motor`]).

use serde::{Deserialize, Serialize};

use crate::controller::Micros;

/// How much better than its threshold the supply must be to count as good again, as a part of the threshold.
pub const HYSTERESIS: f32 = 0.05;
/// How long it must be so, microseconds.
pub const SETTLE_US: u32 = 100_000;

/// Between which voltages a module drives its motors, V.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Thresholds {
    /// Below this it relaxes.
    pub under: f32,
    /// Above this it relaxes.
    pub over: f32,
}

/// The lowest and the highest voltage since the last look, V.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Extremes {
    /// Lowest; not a number if a measurement was none.
    pub lowest: f32,
    /// Highest.
    pub highest: f32,
}

impl Extremes {
    /// A supply that stood still.
    pub const fn steady(volts: f32) -> Self {
        Extremes { lowest: volts, highest: volts }
    }

    /// Takes `volts` in.
    #[must_use]
    pub fn with(self, volts: f32) -> Self {
        // What is no number must not get lost: `f32::min` would drop it.
        let keep = |kept: f32, better: bool| if kept.is_nan() || better { kept } else { volts };
        Extremes { lowest: keep(self.lowest, self.lowest <= volts), highest: keep(self.highest, self.highest >= volts) }
    }
}

/// What is wrong with the supply.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Supply {
    /// Nothing.
    #[default]
    Good,
    /// Too little, or it was so less than [`SETTLE_US`] ago. No reading counts as none.
    Under,
    /// Too much, or it was so less than [`SETTLE_US`] ago.
    Over,
}

/// Follows the supply from poll to poll.
#[derive(Clone, Debug)]
pub struct SupplyWatch {
    thresholds: Thresholds,
    state: Supply,
    /// Since when it has been good, while `state` still says that it is not.
    good_since: Option<Micros>,
}

impl SupplyWatch {
    /// A supply that is good until measured.
    pub fn new(thresholds: Thresholds) -> Self {
        SupplyWatch { thresholds, state: Supply::Good, good_since: None }
    }

    /// What is wrong now.
    pub fn state(&self) -> Supply {
        self.state
    }

    /// Takes what was measured since the last time.
    pub fn follow(&mut self, now: Micros, measured: Extremes) -> Supply {
        let Thresholds { under, over } = self.thresholds;
        // Without a fault the thresholds count as they are, with one the better ones do.
        let better = if self.state == Supply::Good { 0.0 } else { HYSTERESIS };
        let enough = measured.lowest >= under * (1.0 + better);
        let too_much = measured.highest > over * (1.0 - better);
        if enough && !too_much {
            let since = *self.good_since.get_or_insert(now);
            if now.saturating_sub(since) >= u64::from(SETTLE_US) {
                self.state = Supply::Good;
            }
        } else {
            self.good_since = None;
            // Between the two thresholds of a side the fault stays what it was.
            if measured.lowest.is_nan() || measured.lowest < under {
                self.state = Supply::Under;
            } else if measured.highest > over {
                self.state = Supply::Over;
            }
        }
        if self.state == Supply::Good {
            self.good_since = None;
        }
        self.state
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const THRESHOLDS: Thresholds = Thresholds { under: 10.0, over: 15.0 };

    #[test]
    fn a_supply_that_sags_is_a_fault_until_it_has_been_good_for_a_while() {
        let mut watch = SupplyWatch::new(THRESHOLDS);
        for (ms, volts, state) in [
            (0, 12.0, Supply::Good),
            (1, 10.0, Supply::Good),
            (2, 9.9, Supply::Under),
            (3, 12.0, Supply::Under),
            (102, 12.0, Supply::Under),
            // Above the threshold, but not enough to begin again.
            (103, 10.2, Supply::Under),
            (110, 10.6, Supply::Under),
            (209, 10.6, Supply::Under),
            (210, 10.6, Supply::Good),
            (211, 10.2, Supply::Good),
            (212, f32::NAN, Supply::Under),
        ] {
            assert_eq!(watch.follow(ms * 1000, Extremes::steady(volts)), state, "at {ms} ms with {volts} V");
        }
    }

    #[test]
    fn a_supply_that_is_pumped_up_is_a_fault_too() {
        let mut watch = SupplyWatch::new(THRESHOLDS);
        for (ms, volts, state) in [
            (0, 15.0, Supply::Good),
            (1, 15.1, Supply::Over),
            (500, 14.5, Supply::Over),
            (501, 14.2, Supply::Over),
            (601, 14.2, Supply::Good),
            (602, 14.9, Supply::Good),
            (603, 16.0, Supply::Over),
            (604, 5.0, Supply::Under),
        ] {
            assert_eq!(watch.follow(ms * 1000, Extremes::steady(volts)), state, "at {ms} ms with {volts} V");
        }
    }

    #[test]
    fn a_dip_between_two_polls_is_not_missed() {
        let mut watch = SupplyWatch::new(THRESHOLDS);
        let measured = Extremes::steady(12.0).with(6.0).with(12.5);
        assert_eq!(measured, Extremes { lowest: 6.0, highest: 12.5 });
        assert_eq!(watch.follow(0, measured), Supply::Under);
        let measured = Extremes::steady(12.0).with(f32::NAN).with(12.0);
        assert!(measured.lowest.is_nan() && measured.highest.is_nan());
    }

    proptest! {
        /// Whatever it does: no good word about a supply that is bad, and none sooner than it has settled.
        #[test]
        fn never_good_while_it_is_bad(steps in proptest::collection::vec((1u64..60_000, prop_oneof![any::<f32>(), 8.0f32..17.0]), 1..100)) {
            let mut watch = SupplyWatch::new(THRESHOLDS);
            let (mut now, mut bad_at) = (0, None);
            for (wait, volts) in steps {
                now += wait;
                let state = watch.follow(now, Extremes::steady(volts));
                if !(10.0..=15.0).contains(&volts) {
                    bad_at = Some(now);
                }
                if state == Supply::Good {
                    prop_assert!(bad_at.is_none_or(|at| now - at >= u64::from(SETTLE_US)));
                }
            }
        }
    }
}
