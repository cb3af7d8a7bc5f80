//! Why the module started, and what it still knows from before.
//!
//! A board keeps two words where a reset does not clear them (RAM that the start-up code leaves alone, or backup registers): [`Retained::words`]. At
//! the next start [`Boot::new`] makes of them, and of what the chip says of the reset, what the controller has to know. Words that do not check are
//! what a memory without power leaves behind: then the module was switched on.

use composer_shared::wire::{StopCount, StopLatch};
use serde::{Deserialize, Serialize};

/// Why the chip started.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u8)]
pub enum ResetCause {
    /// Power was switched on.
    #[default]
    PowerOn = 1,
    /// Somebody asked for it: the service operation RESTART.
    Commanded = 2,
    /// The reset pin.
    Pin = 3,
    /// The watchdog, or a processor that failed and waited for it.
    Watchdog = 4,
    /// The supply broke in for a short time.
    BrownOut = 5,
    /// The software reset the chip, and nobody asked for it.
    Software = 6,
    /// Anything else.
    Other = 7,
}

impl ResetCause {
    /// Whether the module may be armed without anybody having looked after it.
    pub const fn clean(self) -> bool {
        matches!(self, ResetCause::PowerOn | ResetCause::Commanded)
    }
}

/// What a module remembers through a reset.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Retained {
    /// The emergency stop.
    pub stop: StopLatch,
    /// Unclean resets since somebody acknowledged one, or since power-on; saturating.
    pub resets: u8,
    /// The next reset is one that somebody asked for.
    pub commanded: bool,
}

/// In the check word, so that neither zeros nor ones nor two equal words check.
const MARK: u32 = 0x5afe_c0de;

impl Retained {
    /// As two words, the second of which checks the first.
    pub const fn words(self) -> [u32; 2] {
        let flags = self.stop.stopped() as u32 | (self.commanded as u32) << 1;
        let word = flags | (self.stop.count().number() as u32) << 4 | (self.resets as u32) << 8;
        [word, check(word)]
    }

    /// What two words say, if they check.
    pub const fn from_words([word, checked]: [u32; 2]) -> Option<Self> {
        if checked != check(word) || word >> 16 != 0 || word & 0xc != 0 {
            return None;
        }
        let stop = StopLatch::new(word & 1 != 0, StopCount::new((word >> 4 & 15) as u8));
        Some(Retained { stop, resets: (word >> 8) as u8, commanded: word & 2 != 0 })
    }
}

/// A multiplicative hash: any bit that flips changes about half of it.
const fn check(word: u32) -> u32 {
    (word ^ MARK).wrapping_mul(0x9e37_79b1).rotate_left(15) ^ MARK
}

/// What a controller has to know of its start.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Boot {
    /// Why the chip started.
    pub cause: ResetCause,
    /// Unclean resets in a row, this one included; saturating.
    pub resets: u8,
    /// The emergency stop as it was before.
    pub stop: StopLatch,
}

impl Boot {
    /// A start for which the chip names this cause, with the words that were kept, if they check. A chip does not know a power-on from
    /// a supply that broke in; what was kept does.
    pub const fn new(said: ResetCause, words: [u32; 2]) -> Self {
        match (Retained::from_words(words), said) {
            (None, cause) => {
                Boot { cause, resets: !cause.clean() as u8, stop: StopLatch::new(false, StopCount::UNKNOWN) }
            }
            (Some(kept), said) => Boot::after(kept, said),
        }
    }

    /// A start after which `kept` is still known.
    pub const fn after(kept: Retained, said: ResetCause) -> Self {
        let cause = match said {
            ResetCause::Software if kept.commanded => ResetCause::Commanded,
            ResetCause::PowerOn => ResetCause::BrownOut,
            said => said,
        };
        let resets = if cause.clean() { 0 } else { kept.resets.saturating_add(1) };
        Boot { cause, resets, stop: kept.stop }
    }

    /// The number of the cause, for the bus.
    pub const fn reason(&self) -> u8 {
        self.cause as u8
    }

    /// Unclean resets in a row.
    pub const fn resets_in_a_row(&self) -> u8 {
        self.resets
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn stopped() -> StopLatch {
        StopLatch::new(true, StopCount::new(9))
    }

    #[test]
    fn what_is_kept_comes_back_and_nothing_else_checks() {
        for resets in [0, 1, 255] {
            for commanded in [false, true] {
                for stop in [StopLatch::default(), stopped(), StopLatch::new(false, StopCount::new(15))] {
                    let kept = Retained { stop, resets, commanded };
                    let words = kept.words();
                    assert_eq!(Retained::from_words(words), Some(kept));
                    for bit in 0..64 {
                        let mut wrong = words;
                        wrong[bit / 32] ^= 1 << (bit % 32);
                        assert_eq!(Retained::from_words(wrong), None, "{kept:?} with bit {bit} flipped");
                    }
                }
            }
        }
        for word in [0, u32::MAX, 0xaaaa_aaaa, 1] {
            assert_eq!(Retained::from_words([word; 2]), None);
        }
    }

    #[test]
    fn a_supply_that_breaks_in_is_no_clean_power_on() {
        let lost = [0; 2];
        assert_eq!(Boot::new(ResetCause::PowerOn, lost), Boot::default());
        let kept = Retained { stop: stopped(), resets: 2, commanded: false };
        let boot = Boot::new(ResetCause::PowerOn, kept.words());
        assert_eq!(boot, Boot { cause: ResetCause::BrownOut, resets: 3, stop: stopped() });
        assert!(!boot.cause.clean());
        let many = Retained { resets: 255, ..kept };
        assert_eq!(Boot::new(ResetCause::Watchdog, many.words()).resets, 255);
        assert_eq!(Boot::new(ResetCause::Watchdog, lost).resets, 1);
    }

    #[test]
    fn a_restart_that_was_asked_for_is_clean_but_forgets_no_stop() {
        let kept = Retained { stop: stopped(), resets: 2, commanded: true };
        let boot = Boot::new(ResetCause::Software, kept.words());
        assert_eq!(boot, Boot { cause: ResetCause::Commanded, resets: 0, stop: stopped() });
        // The watchdog came first.
        assert_eq!(Boot::new(ResetCause::Watchdog, kept.words()).cause, ResetCause::Watchdog);
    }
}
