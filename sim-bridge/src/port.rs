//! The CAN port of a simulated node: the firmware's own [`Sender`] on the mailboxes of the simulated bus, and the queue of received frames.
//!
//! The chip's receive FIFO holds three frames, and an interrupt empties it sooner than three more can come. What a module may miss is decided by
//! the queue behind it, [`RECEIVED`] frames: while the controller computes, nobody takes anything out of it.

use std::collections::VecDeque;

use composer_firmware::controller::{BusStatus, Micros};
use composer_firmware::port::{
    CanPort, Counts, Outcome, PortStatus, RECEIVED, SLOTS, Sender, Slots, WAITING, count, element, supersedes,
};
use composer_shared::wire::Frame;

use crate::bus::Bus;
use crate::confinement::ErrorState;

const NEVER: u64 = u64::MAX;
/// Time from one try to the next of software that runs wild, ns; it tries whenever a frame got through, too.
const BABBLE_NS: u64 = 100_000;

/// The CAN port of a node.
#[derive(Clone, Debug)]
pub struct Port {
    sender: Sender,
    /// The mail in each slot, by its number on the bus.
    mail: [u64; SLOTS],
    /// Frames that are still being computed, with the time when they are ready, ns.
    coming: Vec<(u64, Frame)>,
    received: VecDeque<Frame>,
    overflowed: u32,
    off: bool,
    /// What the software of the module sends again and again, since it runs wild.
    babble: Option<Frame>,
    next_ns: u64,
}

impl Port {
    /// The port of a node in a robot with this control period, us.
    pub fn new(period: Micros) -> Self {
        Port {
            sender: Sender::new(period),
            mail: [0; SLOTS],
            coming: Vec::new(),
            received: VecDeque::new(),
            overflowed: 0,
            off: false,
            babble: None,
            next_ns: NEVER,
        }
    }

    /// It has the [guard](composer_firmware::port::guard) of the board's, for a module with this number.
    pub fn guard(&mut self, node: u8) {
        self.sender.guard(Some(node));
    }

    /// The software of the module sends this frame again and again from now on.
    pub fn set_babble(&mut self, frame: Option<Frame>) {
        self.babble = frame;
    }

    /// When it has to be polled at the latest, ns; `u64::MAX` if there is nothing to do.
    pub fn next_ns(&self) -> u64 {
        self.next_ns
    }

    /// Frames that can wait without displacing others.
    pub fn room(&self) -> usize {
        self.sender.room().saturating_sub(self.coming.len())
    }

    /// Takes a frame that is ready to be sent at `ready_ns`.
    pub fn send_at(&mut self, frame: &Frame, ready_ns: u64) {
        debug_assert!(self.coming.len() < WAITING);
        self.coming.retain(|(_, older)| !supersedes(frame, older));
        self.coming.push((ready_ns, *frame));
        self.next_ns = self.next_ns.min(ready_ns);
    }

    /// Takes a frame from the bus; it is lost if too many wait already. It comes through the chip's message memory, as on the board.
    pub fn hear(&mut self, frame: &Frame) {
        let mut words = [0; element::WORDS];
        element::encode(frame, |number, word| words[number] = word);
        let Some(frame) = element::decode(|number| words[number]) else { return };
        if self.received.len() < RECEIVED {
            self.received.push_back(frame);
        } else {
            count(&mut self.overflowed);
        }
    }

    /// Whether there are received frames.
    pub fn has_received(&self) -> bool {
        !self.received.is_empty()
    }

    /// What happened so far.
    pub fn counts(&self) -> Counts {
        Counts { overflowed: self.overflowed, ..self.sender.counts() }
    }

    /// The port at its place on the bus, at this time, ns.
    pub fn at<'a>(&'a mut self, bus: &'a mut Bus, node: usize, now: u64) -> Attached<'a> {
        Attached { port: self, bus, node, now }
    }
}

/// A [`Port`] at its place on the bus.
#[derive(Debug)]
pub struct Attached<'a> {
    port: &'a mut Port,
    bus: &'a mut Bus,
    node: usize,
    now: u64,
}

impl CanPort for Attached<'_> {
    fn send(&mut self, frame: &Frame) {
        self.port.send_at(frame, self.now);
    }

    fn room(&self) -> usize {
        self.port.room()
    }

    fn receive(&mut self) -> Option<Frame> {
        self.port.received.pop_front()
    }

    fn poll(&mut self) {
        let Attached { port, bus, node, now } = self;
        let (node, now) = (*node, *now);
        if !bus.plugged(node) {
            return;
        }
        let off = bus.state(node) == ErrorState::BusOff;
        if off != port.off {
            port.off = off;
            port.sender.set_bus_off(off);
        }
        let us = now / 1000;
        let sender = &mut port.sender;
        port.coming.retain(|(ready, frame)| {
            if *ready <= now {
                sender.push(us, frame);
            }
            *ready > now
        });
        if let Some(frame) = &port.babble {
            sender.push(us, frame);
        }
        sender.poll(us, &mut Mailboxes { bus, node, mail: &mut port.mail, now });
        let coming = port.coming.iter().map(|(ready, _)| *ready).min().unwrap_or(NEVER);
        // While it is off nothing becomes of what waits.
        let due = sender.due().filter(|_| !off).map_or(NEVER, |due| due.saturating_mul(1000).max(now + 1));
        let again = port.babble.map_or(NEVER, |_| match sender.shut_until() {
            Some(until) => (until * 1000).max(now + BABBLE_NS),
            None => now + BABBLE_NS,
        });
        port.next_ns = coming.min(due).min(again);
    }

    fn status(&self) -> PortStatus {
        let counters = self.bus.counters(self.node);
        PortStatus {
            bus: bus_status(counters.state()),
            transmit_errors: counters.transmit,
            receive_errors: counters.receive,
            counts: self.port.counts(),
        }
    }
}

/// The error state in the firmware's words.
pub fn bus_status(state: ErrorState) -> BusStatus {
    match state {
        ErrorState::Active => BusStatus::ErrorActive,
        ErrorState::Passive => BusStatus::ErrorPassive,
        ErrorState::BusOff => BusStatus::BusOff,
    }
}

/// The mailboxes of a node as slots of its CAN controller.
struct Mailboxes<'a> {
    bus: &'a mut Bus,
    node: usize,
    mail: &'a mut [u64; SLOTS],
    now: u64,
}

impl Slots for Mailboxes<'_> {
    fn load(&mut self, slot: usize, frame: &Frame) {
        // There is room: as many mailboxes as slots.
        self.mail[slot] = self.bus.send(self.node, frame, self.now).unwrap_or_default();
    }

    fn abort(&mut self, slot: usize) {
        self.bus.take_back(self.node, self.mail[slot]);
    }

    fn outcome(&mut self, slot: usize) -> Outcome {
        self.bus.outcome(self.node, self.mail[slot])
    }
}

#[cfg(test)]
mod tests;
