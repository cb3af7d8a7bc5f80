//! What keeps a module whose software runs wild from taking the bus: a bus guardian.
//!
//! A module may send under its own number, and what modules send ([wire format](composer_shared::wire)); the rest is refused. Of what is as urgent as
//! the control traffic it may send [`BUDGET`] frames in a control period, more than any schedule asks for. One that wants more is *shut* for [`SHUT_PERIODS`]: it
//! hears everything and acts, but to the others it is silent, and they go on as if it were unplugged. After that it may try again. Some stops
//! a period pass in any case, because nothing may keep a module from stopping the robot. Answers, telemetry and heartbeats are less urgent than all
//! control traffic and take only what it leaves, so they are not counted.
//!
//! It stands between the software and the transmit slots, so it cannot help against a CAN controller or a transceiver that jams the bus by itself. Against that the board
//! would need a transceiver that does the same (such as NXP's TJA115x: identifiers that may be sent, and protection against flooding).

use composer_shared::wire::{Frame, Function};

use crate::controller::Micros;

/// Control frames of a module in a control period. On a classic bus a latent in eight pieces, SYNC and STATE are ten. A module that yields to another time-keeper
/// starts a cycle anew just after its own: with what was left of the one before, three of them fall into a period, which begins anywhere.
pub const BUDGET: u8 = 32;

/// Stops of a module in a control period that pass whatever else it sends.
pub const STOPS: u8 = 2;

/// Control periods for which a module is silent that sent too much.
pub const SHUT_PERIODS: u64 = 20;

/// What becomes of a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Admission {
    /// It may be sent.
    Admitted,
    /// It may not.
    Refused,
    /// It may not, and neither may what still waits: the budget has just been exceeded.
    Shut,
}

/// The guard of one module.
#[derive(Clone, Copy, Debug)]
pub struct Guard {
    /// None: any.
    node: Option<u8>,
    since: Micros,
    sent: u8,
    stops: u8,
    shut_until: Option<Micros>,
}

impl Guard {
    /// That of a module with this number; none if that is not known here.
    pub const fn new(node: Option<u8>) -> Self {
        Guard { node, since: 0, sent: 0, stops: 0, shut_until: None }
    }

    /// The module has this number now; what it sent counts on.
    pub fn set_node(&mut self, node: Option<u8>) {
        self.node = node;
    }

    /// When a module that is shut may send again.
    pub fn shut_until(&self) -> Option<Micros> {
        self.shut_until
    }

    /// Looks at a frame that is to be sent, in a robot with this control period.
    pub fn admit(&mut self, now: Micros, period: Micros, frame: &Frame) -> Admission {
        if now.saturating_sub(self.since) >= period {
            (self.since, self.sent, self.stops) = (now, 0, 0);
        }
        self.shut_until = self.shut_until.filter(|until| now < *until);
        let own = self.node.is_none_or(|node| frame.module() == node);
        match frame.function() {
            Some(Function::EmergencyStop) if own && self.stops < STOPS => {
                self.stops += 1;
                return Admission::Admitted;
            }
            _ if self.shut_until.is_some() => return Admission::Refused,
            Some(Function::ServiceResponse | Function::Telemetry | Function::Heartbeat) if own => {
                return Admission::Admitted;
            }
            _ => {}
        }
        let may = matches!(
            frame.function(),
            Some(Function::Sync | Function::State | Function::Latent | Function::LatentFragment)
        );
        // What it may not send counts as well.
        self.sent = self.sent.saturating_add(1);
        if self.sent > BUDGET {
            self.shut_until = Some(now.saturating_add(SHUT_PERIODS.saturating_mul(period)));
            Admission::Shut
        } else if own && may {
            Admission::Admitted
        } else {
            Admission::Refused
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: Micros = 50_000;

    fn frame(id: u16) -> Frame {
        Frame::new(id, true, &[0; 8]).unwrap()
    }

    #[test]
    fn the_busiest_schedule_passes() {
        let mut guard = Guard::new(Some(5));
        for cycle in 0..100u64 {
            // Three times in a period: SYNC, STATE, a latent in eight pieces. And answers to hundreds of questions.
            for id in [0x085, 0x185].into_iter().chain([0x285; 8]).cycle().take(30) {
                assert_eq!(guard.admit(cycle * PERIOD, PERIOD, &frame(id)), Admission::Admitted);
            }
            for _ in 0..200 {
                for id in [0x385, 0x405, 0x485] {
                    assert_eq!(guard.admit(cycle * PERIOD, PERIOD, &frame(id)), Admission::Admitted);
                }
            }
            for _ in 0..STOPS {
                assert_eq!(guard.admit(cycle * PERIOD, PERIOD, &frame(0x005)), Admission::Admitted);
            }
        }
    }

    #[test]
    fn whoever_floods_is_shut_and_may_try_again() {
        let mut guard = Guard::new(Some(5));
        let mut admitted = 0;
        for now in (0..4_000_000).step_by(100) {
            admitted += u32::from(guard.admit(now, PERIOD, &frame(0x185)) == Admission::Admitted);
        }
        // At the start and after each second.
        assert_eq!(admitted, 4 * u32::from(BUDGET));
        assert!(guard.shut_until().is_some());
        assert_eq!(guard.admit(3_999_999, PERIOD, &frame(0x485)), Admission::Refused);
        assert_eq!(guard.admit(3_999_999, PERIOD, &frame(0x005)), Admission::Admitted, "but a stop");
    }

    #[test]
    fn nobody_speaks_for_others_and_nobody_says_what_is_not_his() {
        for id in [0x006, 0x07f, 0x086, 0x0ff, 0x17f, 0x105, 0x184, 0x305, 0x37f, 0x505, 0x785, 0x7ff, 0x485 - 1] {
            assert_ne!(Guard::new(Some(5)).admit(0, PERIOD, &frame(id)), Admission::Admitted, "{id:#x}");
        }
        let mut guard = Guard::new(Some(5));
        let shut = (0..100).filter(|_| guard.admit(0, PERIOD, &frame(0x0ff)) == Admission::Shut).count();
        assert_eq!(shut, 1);
    }
}
