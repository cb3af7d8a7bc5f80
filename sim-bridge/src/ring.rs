//! The cable closed to a ring: what the station does with a second CAN port at the tail end.
//!
//! A cable that is cut leaves two buses. With one port the station talks to one of them; the other loses the goal, the stop, and after the dead man's
//! time its torque. So the station has a port at either end of the line, as the masters of industrial rings have (cable redundancy), and joins the parts:
//! what one port hears and the other does not, it repeats there. To the modules that is one bus again, a frame slower.
//!
//! As long as the line is whole both ports hear the same, and nothing may be repeated: a module that hears its own number would
//! believe that it is another's too. So frames are compared. One that the other port does not hear within [`WINDOW_NS`] was heard
//! alone; after [`ALONE`] of those in a row the line counts as broken, and as whole again with the first frame that both ports hear. Frames that get lost at one
//! port now and then do not make such a row, and the row is complete before a module counts as dead. A stop does not wait for that: it does no harm twice.
//!
//! [`Ring`] is without I/O.

use std::collections::VecDeque;

use composer_shared::wire::{Frame, Function};

/// What a frame may be late at one port against the other, ns.
pub const WINDOW_NS: u64 = 20_000_000;

/// So many frames in a row that only one port heard: less than one cycle of three modules. With a tenth of all frames lost at each port, that happens
/// to a whole line once in 10^9 frames.
pub const ALONE: u32 = 12;

/// One of the two ports.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// The station's first one.
    Near,
    /// At the tail end of the line.
    Far,
}

impl Side {
    /// The other one.
    #[must_use]
    pub fn other(self) -> Self {
        match self {
            Side::Near => Side::Far,
            Side::Far => Side::Near,
        }
    }
}

/// A frame that one port heard.
#[derive(Clone, Copy, Debug)]
struct Alone {
    at_ns: u64,
    side: Side,
    frame: Frame,
}

/// Decides what is repeated.
#[derive(Clone, Debug, Default)]
pub struct Ring {
    /// Frames of the last [`WINDOW_NS`] that the other port has not heard, in order.
    waiting: VecDeque<Alone>,
    alone: u32,
}

impl Ring {
    /// The line is whole.
    pub fn new() -> Self {
        Ring::default()
    }

    /// Whether the line is broken, and its parts are joined.
    pub fn joins(&self) -> bool {
        self.alone >= ALONE
    }

    /// Both ports heard or sent a frame at the same time.
    pub fn hear_both(&mut self, now_ns: u64) {
        self.expire(now_ns);
        self.waiting.clear();
        self.alone = 0;
    }

    /// The port on this side heard a frame, or the station sent one of its own there. Whether the other port is to repeat it.
    ///
    /// What a port repeats must not come here.
    pub fn hear(&mut self, side: Side, frame: &Frame, now_ns: u64) -> bool {
        self.expire(now_ns);
        match self.waiting.iter().find(|alone| alone.frame == *frame) {
            Some(alone) if alone.side != side => {
                self.hear_both(now_ns);
                return false;
            }
            // Once is enough, and what goes round ends here.
            Some(_) => return false,
            None => self.waiting.push_back(Alone { at_ns: now_ns, side, frame: *frame }),
        }
        self.joins() || frame.function() == Some(Function::EmergencyStop)
    }

    /// Counts those that the other port will not hear any more.
    fn expire(&mut self, now_ns: u64) {
        while self.waiting.front().is_some_and(|alone| now_ns.saturating_sub(alone.at_ns) > WINDOW_NS) {
            self.waiting.pop_front();
            self.alone = self.alone.saturating_add(1);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::{EmergencyStop, Message, StopCommand, StopCount};

    const MS: u64 = 1_000_000;

    fn frame(number: u64) -> Frame {
        Frame::new(0x200 + (number % 8) as u16, true, &number.to_le_bytes()).unwrap()
    }

    /// Sends frames 2 ms apart that only one port hears, and gives those that are repeated.
    fn alone(ring: &mut Ring, from: u64, count: u64) -> usize {
        (from..from + count).filter(|n| ring.hear(Side::Near, &frame(*n), n * 2 * MS)).count()
    }

    #[test]
    fn a_line_that_broke_is_joined_within_a_cycle_and_left_alone_when_it_is_whole() {
        let mut ring = Ring::new();
        (0..100).for_each(|n| ring.hear_both(n * 2 * MS));
        // Twelve, and as many as come within the window.
        assert_eq!(alone(&mut ring, 100, 22), 0);
        assert!(!ring.joins());
        assert_eq!(alone(&mut ring, 122, 10), 10);
        assert!(ring.joins() && ring.hear(Side::Far, &frame(999), 264 * MS), "both ways");
        ring.hear_both(266 * MS);
        assert!(!ring.joins() && !ring.hear(Side::Far, &frame(1000), 267 * MS));
    }

    #[test]
    fn a_line_that_is_mended_while_frames_come_late_is_known_to_be_whole() {
        let mut ring = Ring::new();
        assert!(alone(&mut ring, 0, 40) > 0 && ring.joins());
        assert!(ring.hear(Side::Near, &frame(40), 80 * MS));
        assert!(!ring.hear(Side::Near, &frame(40), 81 * MS), "what was repeated comes round");
        assert!(!ring.hear(Side::Far, &frame(40), 82 * MS) && !ring.joins());
    }

    #[test]
    fn frames_that_come_late_or_get_lost_at_one_port_do_not_join_anything() {
        let mut ring = Ring::new();
        let mut repeated = 0;
        for n in 0..20_000u64 {
            let now = n * MS;
            // Every other one is lost at the far port, the others come there 15 ms later.
            repeated += usize::from(ring.hear(Side::Near, &frame(n), now));
            if n >= 15 && n % 2 == 0 {
                repeated += usize::from(ring.hear(Side::Far, &frame((n - 15) & !1), now));
            }
        }
        assert_eq!(repeated, 0);
    }

    #[test]
    fn a_stop_is_repeated_before_anybody_knows_that_the_line_is_broken() {
        let stop = Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::new(3))).emit(0x7f, true);
        let mut ring = Ring::new();
        assert!(ring.hear(Side::Near, &stop, 0));
        assert!(!ring.hear(Side::Far, &stop, MS), "it comes around: the line is whole");
    }
}
