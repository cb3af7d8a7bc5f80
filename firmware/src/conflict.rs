//! Does another node use this module's number? Not every frame that says so is one: a frame can be a recording, or come back from
//! a gateway that echoes.
//!
//! A twin that takes part sends STATE or SYNC of the present cycle, again and again; a recording is of another cycle. Both count, the fresh ones
//! `FRESH` times as much, but only once a period, and periods without any count against it. At `CERTAIN` it is a twin.

use crate::controller::Micros;

/// How much more a frame of the present cycle says than an old one.
const FRESH: u8 = 4;
/// From here on it is a twin: three periods with fresh frames, or twelve with old ones.
const CERTAIN: u8 = 12;

/// What is known of a twin.
#[derive(Clone, Debug, Default)]
pub struct Conflict {
    score: u8,
    /// What this period has added already.
    counted: u8,
    /// When this period began.
    since: Micros,
    /// When the last frame with this module's own number came.
    heard: Option<Micros>,
}

impl Conflict {
    /// Nobody was heard.
    pub const fn new(now: Micros) -> Self {
        Conflict { score: 0, counted: 0, since: now, heard: None }
    }

    /// A frame with this module's own number came, at `now`; `fresh` if it belongs to the present. Returns whether that makes it certain.
    pub fn hear(&mut self, now: Micros, period: Micros, fresh: bool) -> bool {
        let periods = now.saturating_sub(self.since) / period.max(1);
        if periods > 0 {
            // The first of them ends the period that was counted, all others were silent.
            let silent = u8::try_from(periods - 1).unwrap_or(u8::MAX);
            self.score = self.score.saturating_sub(silent);
            (self.counted, self.since) = (0, now);
        }
        let worth = if fresh { FRESH } else { 1 };
        self.score = self.score.saturating_add(worth.saturating_sub(self.counted));
        self.counted = self.counted.max(worth);
        self.heard = Some(now);
        self.score >= CERTAIN
    }

    /// Whether a frame with this module's own number came within the last `time`.
    pub fn suspected(&self, now: Micros, time: Micros) -> bool {
        self.heard.is_some_and(|heard| now.saturating_sub(heard) < time)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Micros = 50_000;

    #[test]
    fn a_twin_that_takes_part_is_certain_in_the_third_period() {
        let mut conflict = Conflict::new(0);
        for cycle in 0..3 {
            for frame in 0..3 {
                let certain = conflict.hear(cycle * PERIOD + frame * 700, PERIOD, true);
                assert_eq!(certain, cycle == 2, "{cycle} {frame}");
            }
        }
    }

    #[test]
    fn one_frame_or_a_recording_of_forty_is_no_twin() {
        let mut conflict = Conflict::new(0);
        assert!(!conflict.hear(7, PERIOD, true));
        // Five frames of each of eight modules, over as many cycles as they were recorded in.
        for cycle in 10..15 {
            for frame in 0..8 {
                assert!(!conflict.hear(cycle * PERIOD + frame * 300, PERIOD, false));
            }
        }
        // One now and then, for ever.
        for k in 0..1000 {
            assert!(!conflict.hear((100 + 6 * k) * PERIOD, PERIOD, true));
        }
    }

    #[test]
    fn a_twin_that_keeps_another_time_is_certain_after_a_while() {
        let mut conflict = Conflict::new(0);
        assert_eq!((0..20).position(|k| conflict.hear(k * PERIOD, PERIOD, false)), Some(11));
        assert!(conflict.suspected(12 * PERIOD, 3 * PERIOD) && !conflict.suspected(14 * PERIOD, 3 * PERIOD));
    }

    #[test]
    fn a_clock_at_its_end_does_no_harm() {
        let mut conflict = Conflict::new(u64::MAX);
        assert!(!conflict.hear(u64::MAX, 0, true));
        assert!(!conflict.hear(u64::MAX, PERIOD, true));
    }
}
