//! Safe torque off: the way from a stop to the power stage that does not wait for the control step.
//!
//! A module computes for milliseconds, and only then looks at the frames that came meanwhile. A stop must not wait so long. So the interrupt that
//! takes frames from the CAN controller, and the one that samples the stop input, tell [`TorqueOff`]; the current loops ask it every time they run, and
//! let the motors coast whatever the main loop has commanded. The main loop tells its controller ([`Controller::follow_stop`]) before every
//! poll, and takes back what the controller makes of it after: only a release that the controller knows, newer than the stop, ends it.
//! A stop also gets here when so many frames wait that the queue to the main loop is full.
//!
//! The state is that of [`StopLatch`], kept in an atomic, so that interrupts of any priority may use it.
//!
//! [`Controller::follow_stop`]: crate::controller::Controller::follow_stop

use core::sync::atomic::{AtomicU16, Ordering};

use composer_shared::wire::{EmergencyStop, Frame, Function, Message, StopCommand, StopCount, StopLatch};

use crate::controller::Micros;

/// Until the motors coast after the interrupt: one period of the current loops, microseconds.
pub const WITHIN_US: Micros = 100;

/// Bit of the state that says stopped; the lower ones are the count.
const STOPPED: u16 = 1 << 8;

fn pack(latch: StopLatch) -> u16 {
    u16::from(latch.count().number()) | if latch.stopped() { STOPPED } else { 0 }
}

fn unpack(state: u16) -> StopLatch {
    let [count, _] = state.to_le_bytes();
    StopLatch::new(state & STOPPED != 0, StopCount::new(count))
}

/// What interrupts a module while it computes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Interrupt<'a> {
    /// The CAN controller received a frame.
    Frame(&'a Frame),
    /// The stop input was open for long enough.
    StopInput,
}

/// Whether the motors are to coast because of a stop, known at once.
#[derive(Debug, Default)]
pub struct TorqueOff(AtomicU16);

impl Clone for TorqueOff {
    fn clone(&self) -> Self {
        TorqueOff(AtomicU16::new(pack(self.latch())))
    }
}

impl TorqueOff {
    /// Nobody has stopped anything yet.
    pub const fn new() -> Self {
        TorqueOff(AtomicU16::new(0))
    }

    fn update(&self, change: impl Fn(&mut StopLatch)) -> StopLatch {
        let changed = |state| {
            let mut latch = unpack(state);
            change(&mut latch);
            pack(latch)
        };
        let mut state = self.0.load(Ordering::Acquire);
        loop {
            let next = changed(state);
            match self.0.compare_exchange_weak(state, next, Ordering::AcqRel, Ordering::Acquire) {
                Ok(_) => return unpack(next),
                Err(newer) => state = newer,
            }
        }
    }

    /// From the interrupt of the CAN controller: looks at a frame before it is queued.
    #[inline(never)] // The linked image is checked from here on: `tests/tests/image.rs`.
    pub fn hear(&self, frame: &Frame) {
        if frame.function() == Some(Function::EmergencyStop)
            && let Ok(Message::EmergencyStop(stop)) = Message::parse(frame)
            && stop.command() == StopCommand::Stop
        {
            self.update(|latch| {
                latch.command(StopCommand::Stop, stop.count());
            });
        }
    }

    /// From the interrupt that samples the stop input: it is open. Gives what to tell the others at once, if this is news.
    #[inline(never)] // Like `hear`.
    pub fn trip(&self, node: u8, fd: bool) -> Option<Frame> {
        let before = self.is_off();
        let latch = self.update(|latch| {
            latch.command(StopCommand::Stop, StopCount::UNKNOWN);
        });
        (!before)
            .then(|| Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, latch.count())).emit(node, fd))
    }

    /// Whether the motors must coast.
    pub fn is_off(&self) -> bool {
        self.latch().stopped()
    }

    /// What the controller has to follow.
    pub fn latch(&self) -> StopLatch {
        unpack(self.0.load(Ordering::Acquire))
    }

    /// What the controller knows: the newer one counts.
    pub fn follow(&self, controller: StopLatch) {
        self.update(|latch| {
            latch.hear(controller.stopped(), controller.count());
        });
    }

    /// Begins anew, with what was kept through a restart.
    pub fn restart(&self, kept: StopLatch) {
        self.0.store(pack(kept), Ordering::Release);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_shared::wire::STATION;

    fn frame(command: StopCommand, count: u8) -> Frame {
        Message::EmergencyStop(EmergencyStop::new(command, 0, StopCount::new(count))).emit(STATION, true)
    }

    #[test]
    fn a_stop_takes_the_torque_and_only_a_newer_release_that_the_controller_knows_gives_it_back() {
        let off = TorqueOff::new();
        assert!(!off.is_off());
        off.hear(&frame(StopCommand::Stop, 0));
        assert!(off.is_off(), "of unknown count");
        off.hear(&frame(StopCommand::Release, 0));
        assert!(off.is_off(), "the controller has to take the release");
        off.follow(StopLatch::default());
        off.follow(StopLatch::new(true, StopCount::new(1)));
        assert!(off.is_off(), "the controller is behind, then knows");
        off.follow(StopLatch::new(false, StopCount::new(2)));
        assert!(!off.is_off());
        off.hear(&frame(StopCommand::Stop, 1));
        assert!(!off.is_off(), "a stop of the past");
        off.hear(&frame(StopCommand::Stop, 2));
        assert!(off.is_off(), "of a stop and a release with equal counts the stop wins");
    }

    #[test]
    fn the_stop_input_is_told_once_and_again_after_a_release() {
        let off = TorqueOff::new();
        assert_eq!(
            off.trip(3, true),
            Some(Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::new(1))).emit(3, true))
        );
        assert_eq!(off.trip(3, true), None);
        assert!(off.is_off() && off.clone().is_off());
        off.follow(StopLatch::new(false, StopCount::new(2)));
        assert!(!off.is_off() && off.trip(3, true).is_some() && off.is_off(), "still open");
    }

    #[test]
    fn what_was_kept_through_a_restart_holds() {
        for (stopped, count) in [(false, 0), (false, 15), (true, 1), (true, 15)] {
            let kept = StopLatch::new(stopped, StopCount::new(count));
            let off = TorqueOff::new();
            off.restart(kept);
            assert_eq!((off.latch(), off.is_off()), (kept, stopped));
        }
    }

    #[test]
    fn other_frames_change_nothing() {
        let off = TorqueOff::new();
        for id in 0x40..0x800 {
            off.hear(&Frame::new(id, true, &[1, 0, 1, 0, 0, 0, 0, 0]).unwrap());
        }
        off.hear(&Frame::new(0x7f, true, &[]).unwrap());
        assert!(!off.is_off());
    }
}
