//! The emergency stop as every node of a robot keeps it: which stop or release is the newest.

use serde::{Deserialize, Serialize};

use super::StopCommand;

/// The number of a stop or release: 1 to [`StopCount::LAST`], then 1 again. Every stop and every release counts, so that the newest
/// wins wherever news of an older one is still on its way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopCount(u8);

impl StopCount {
    /// No stop was ever heard of; in an EMERGENCY_STOP: the sender does not know, and means the next one.
    pub const UNKNOWN: StopCount = StopCount(0);
    /// The largest number.
    pub const LAST: u8 = 15;

    /// The count with this number; what is no count is [`StopCount::UNKNOWN`].
    pub const fn new(number: u8) -> Self {
        StopCount(if number > Self::LAST { 0 } else { number })
    }

    /// Its number, 0 to 15.
    pub const fn number(self) -> u8 {
        self.0
    }

    /// That of the next stop or release.
    #[must_use]
    pub const fn next(self) -> Self {
        StopCount(if self.0 >= Self::LAST { 1 } else { self.0 + 1 })
    }

    /// Whether it is ahead of `other` by 1 to 7, counted in a circle. Every known count is newer than none.
    pub const fn newer_than(self, other: StopCount) -> bool {
        if self.0 == 0 || other.0 == 0 {
            return self.0 != 0 && other.0 == 0;
        }
        let ahead = (self.0 + Self::LAST - other.0) % Self::LAST;
        ahead >= 1 && ahead <= Self::LAST / 2
    }
}

/// Whether the robot is stopped, as far as one node knows.
///
/// ```
/// use composer_shared::wire::{StopCommand, StopCount, StopLatch};
///
/// let mut latch = StopLatch::default();
/// latch.command(StopCommand::Stop, StopCount::UNKNOWN);
/// assert!(latch.stopped());
/// // What a neighbour tells of the time before the stop changes nothing.
/// latch.hear(false, StopCount::UNKNOWN);
/// assert!(latch.stopped());
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct StopLatch {
    stopped: bool,
    count: StopCount,
}

impl StopLatch {
    /// What a node remembers. A stop always has a count.
    pub const fn new(stopped: bool, count: StopCount) -> Self {
        let count = if stopped && count.0 == 0 { count.next() } else { count };
        StopLatch { stopped, count }
    }

    /// Whether the stop is latched.
    pub const fn stopped(self) -> bool {
        self.stopped
    }

    /// Number of the last stop or release.
    pub const fn count(self) -> StopCount {
        self.count
    }

    /// Takes a stop or release; one of unknown count is the next one, unless it asks for what is so already. Returns whether anything
    /// changed from stopped to released or back.
    pub fn command(&mut self, command: StopCommand, count: StopCount) -> bool {
        let stop = command == StopCommand::Stop;
        if count == StopCount::UNKNOWN {
            return stop != self.stopped && self.hear(stop, self.count.next());
        }
        self.hear(stop, count)
    }

    /// Takes what another node says of itself: the newer of the two counts, and of two equal ones the stop. Returns whether this
    /// node's own state changed.
    pub fn hear(&mut self, stopped: bool, count: StopCount) -> bool {
        let before = self.stopped;
        if count.newer_than(self.count) {
            *self = StopLatch { stopped, count };
        } else if count == self.count && count != StopCount::UNKNOWN {
            self.stopped |= stopped;
        }
        self.stopped != before
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_two_counts_at_most_one_is_newer_and_the_next_one_is() {
        for a in 0..=15 {
            let count = StopCount::new(a);
            assert!(count.next().newer_than(count) && !count.newer_than(count));
            assert!((1..=15).contains(&count.next().number()));
            for b in 0..=15 {
                let other = StopCount::new(b);
                assert!(!(count.newer_than(other) && other.newer_than(count)), "{a} {b}");
                assert!(a == b || count.newer_than(other) || other.newer_than(count), "{a} {b}");
            }
        }
        assert_eq!(StopCount::new(16), StopCount::UNKNOWN);
    }

    #[test]
    fn the_newest_wins_and_at_equal_counts_the_stop() {
        let at = |stopped, count| StopLatch::new(stopped, StopCount::new(count));
        let hear = |mut latch: StopLatch, stopped, count| {
            latch.hear(stopped, StopCount::new(count));
            (latch.stopped(), latch.count().number())
        };
        assert_eq!(hear(at(true, 3), false, 2), (true, 3), "an old release");
        assert_eq!(hear(at(false, 4), true, 3), (false, 4), "an old stop");
        assert_eq!(hear(at(true, 3), false, 4), (false, 4), "a new release");
        assert_eq!(hear(at(false, 15), true, 1), (true, 1), "a new stop, past the end of the circle");
        assert_eq!(hear(at(false, 3), true, 3), (true, 3), "somebody stopped while somebody released");
        assert_eq!(hear(at(true, 3), false, 3), (true, 3));
        assert_eq!(hear(at(true, 3), false, 0), (true, 3), "who knows nothing says nothing");
        assert_eq!(hear(at(false, 0), false, 9), (false, 9));
    }

    #[test]
    fn a_command_without_a_count_is_the_next_one_and_may_be_repeated() {
        let mut latch = StopLatch::default();
        for _ in 0..3 {
            latch.command(StopCommand::Stop, StopCount::UNKNOWN);
            assert_eq!(latch, StopLatch::new(true, StopCount::new(1)));
        }
        for _ in 0..3 {
            latch.command(StopCommand::Release, StopCount::UNKNOWN);
            assert_eq!(latch, StopLatch::new(false, StopCount::new(2)));
        }
        assert!(StopLatch::new(true, StopCount::UNKNOWN).count() != StopCount::UNKNOWN);
    }
}
