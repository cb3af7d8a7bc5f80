//! The CAN port: frames by their urgency through the few transmit slots of a CAN controller.
//!
//! A CAN controller sends the most urgent of the frames in its slots, and a frame in a slot stays there until it got through. On a busy bus
//! three reports would thus keep a SYNC from ever taking part in arbitration. [`Sender`] decides what lies in the slots: a frame that is more
//! urgent than the least urgent one in them takes its place, and what it displaced comes back and waits. It is a state machine without I/O;
//! the registers of a chip, or a simulated bus, are the [`Slots`] that it works on. [`element`] turns frames into what lies in the memory of
//! Bosch's M_CAN, of which the FDCAN of the STM32G4 is one.
//!
//! Nothing old goes out:
//! - a newer frame of a function replaces the older one, wherever that is ([`supersedes`]);
//! - a frame that could not be sent within its time ([`lifetime`]) is given up, so that a module whose cable is mended does not tell what was
//!   true before;
//! - what waited when the CAN controller went bus-off is given up, and again when it comes back.
//!
//! The one exception is a stop: it waits as long as it takes. Its count tells receivers whether it still means something. A release does not.
//!
//! A module whose software runs wild is shut out by its [`guard`].

use composer_shared::wire::{Frame, Function, StopCommand};

use crate::controller::{BusStatus, Micros};

pub mod element;
pub mod guard;

use guard::{Admission, Guard};

/// Transmit slots. The FDCAN of an STM32G4 has three, and so have most CAN controllers that have any number.
pub const SLOTS: usize = 3;

/// Frames that wait for a slot: a latent in eight pieces and one frame of each other function, with room to spare.
pub const WAITING: usize = 16;

/// Received frames that wait while the controller computes. A control step of 64 modules takes 2.8 ms
/// ([`crate::budget::step_us`]), in which at most 50 frames of the shortest kind go over a bus at 1 and 5 Mbit/s.
pub const RECEIVED: usize = 64;

/// A CAN port as the main loop of a module sees it. It knows what time it is.
pub trait CanPort {
    /// Takes a frame to send. It never blocks: what has no room any more is the least urgent that waits.
    fn send(&mut self, frame: &Frame);

    /// Frames that can wait without displacing others.
    fn room(&self) -> usize;

    /// The next received frame.
    fn receive(&mut self) -> Option<Frame>;

    /// What got through makes room, and what is out of date is given up.
    fn poll(&mut self);

    /// How the CAN controller is, and what happened so far.
    fn status(&self) -> PortStatus;

    /// Sends what `next` offers, as long as there is room.
    fn send_all(&mut self, mut next: impl FnMut() -> Option<Frame>) {
        while self.room() > 0
            && let Some(frame) = next()
        {
            self.send(&frame);
        }
        self.poll();
    }
}

/// How a CAN port is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct PortStatus {
    /// Error state (ISO 11898-1 fault confinement).
    pub bus: BusStatus,
    /// Transmit error counter; 256 stands for bus-off.
    pub transmit_errors: u16,
    /// Receive error counter.
    pub receive_errors: u16,
    /// What happened since power-up.
    pub counts: Counts,
}

/// What happened at a CAN port since power-up; the counters saturate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Counts {
    /// Frames sent.
    pub sent: u32,
    /// Frames that were taken out of a slot for a more urgent one, to be sent later.
    pub displaced: u32,
    /// Frames that a newer one replaced before they were sent.
    pub replaced: u32,
    /// Frames that were given up because they were too old, or because of bus-off.
    pub stale: u32,
    /// Frames that had no room to wait.
    pub crowded: u32,
    /// Received frames that were lost because the controller did not come to them.
    pub overflowed: u32,
    /// Times the CAN controller went bus-off.
    pub bus_off: u32,
    /// Frames that the [`guard`] refused.
    pub guarded: u32,
}

/// Counts one more.
pub fn count(counter: &mut u32) {
    *counter = counter.saturating_add(1);
}

/// What became of the frame in a slot.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Outcome {
    /// It waits for its turn, or is on the wire.
    Pending,
    /// It got through; the slot is free.
    Sent,
    /// It was taken back before it got through; the slot is free.
    Returned,
}

/// The transmit slots of a CAN controller, numbers 0 to [`SLOTS`] - 1, which sends the frame with the lowest identifier in them first.
pub trait Slots {
    /// Puts a frame into a free slot, to be sent until it gets through or is taken back.
    fn load(&mut self, slot: usize, frame: &Frame);

    /// Asks for the frame in a slot back. If it is on the wire it may still get through, but it is not tried again.
    fn abort(&mut self, slot: usize);

    /// What became of the frame in a slot. Asked until it is not pending any more, then not before the next [`Slots::load`].
    fn outcome(&mut self, slot: usize) -> Outcome;
}

/// Whether `new` makes `old` out of date: the same function of the same module, except what belongs together. The points of a cycle (GOAL), the
/// pieces of a latent (LATENT_FRAGMENT), and what belongs to questions and answers.
pub fn supersedes(new: &Frame, old: &Frame) -> bool {
    let ([cycle, which, ..], [old_cycle, old_which, ..]) = (new.data, old.data);
    new.id == old.id
        && match new.function() {
            // Bit 0 of the second byte says whether the point is known.
            Some(Function::Goal) => cycle != old_cycle || which >> 1 == old_which >> 1,
            // The first byte is the piece and the cycle.
            Some(Function::LatentFragment) => cycle & 15 != old_cycle & 15 || cycle == old_cycle,
            Some(Function::EmergencyStop | Function::Sync | Function::State | Function::Latent) => true,
            Some(Function::Telemetry | Function::Heartbeat) => true,
            _ => false,
        }
}

fn is_stop(frame: &Frame) -> bool {
    let [command, ..] = frame.data;
    frame.function() == Some(Function::EmergencyStop) && command == StopCommand::Stop as u8
}

/// How long a frame is worth sending, in a robot with this control period: control traffic a period, reports and answers ten; a stop for ever.
pub fn lifetime(frame: &Frame, period: Micros) -> Micros {
    match frame.function() {
        Some(Function::EmergencyStop) if is_stop(frame) => Micros::MAX,
        Some(Function::Sync | Function::Goal | Function::State | Function::Latent | Function::LatentFragment) => period,
        _ => 10 * period,
    }
}

/// A frame and when it came.
#[derive(Clone, Copy, Debug)]
struct Queued {
    frame: Frame,
    since: Micros,
    /// Counts the frames that came: of equally urgent ones the older goes first.
    order: u64,
}

impl Queued {
    /// Lower is more urgent.
    fn urgency(&self) -> (u16, u64) {
        (self.frame.id, self.order)
    }

    fn stale(&self, now: Micros, period: Micros) -> bool {
        now.saturating_sub(self.since) >= lifetime(&self.frame, period)
    }
}

/// A frame in a slot.
#[derive(Clone, Copy, Debug)]
struct Loaded {
    queued: Queued,
    /// It was asked back.
    aborting: bool,
    /// Why it is out of date, and not to be sent again if it comes back.
    obsolete: Option<Obsolete>,
}

#[derive(Clone, Copy, Debug)]
enum Obsolete {
    Replaced,
    Stale,
}

/// Decides which frames lie in the transmit slots, and keeps those that wait.
#[derive(Clone, Debug)]
pub struct Sender {
    period: Micros,
    slots: [Option<Loaded>; SLOTS],
    waiting: [Option<Queued>; WAITING],
    order: u64,
    off: bool,
    guard: Option<Guard>,
    counts: Counts,
}

impl Sender {
    /// One of a module with this control period, with nothing to send.
    pub const fn new(period: Micros) -> Self {
        let counts =
            Counts { sent: 0, displaced: 0, replaced: 0, stale: 0, crowded: 0, overflowed: 0, bus_off: 0, guarded: 0 };
        Sender { period, slots: [None; SLOTS], waiting: [None; WAITING], order: 0, off: false, guard: None, counts }
    }

    /// Sets the control period.
    pub fn set_period(&mut self, period: Micros) {
        self.period = period;
    }

    /// From now on it sends what a module may, with this number if it is known, and no more.
    pub fn guard(&mut self, node: Option<u8>) {
        self.guard.get_or_insert(Guard::new(node)).set_node(node);
    }

    /// Until when its [`guard`] keeps it silent, if it does.
    pub fn shut_until(&self) -> Option<Micros> {
        self.guard.as_ref().and_then(Guard::shut_until)
    }

    /// What happened so far; receiving is not its business.
    pub fn counts(&self) -> Counts {
        self.counts
    }

    /// Frames that can wait without displacing others.
    pub fn room(&self) -> usize {
        self.waiting.iter().filter(|place| place.is_none()).count()
    }

    /// Takes a frame to send. It goes to a slot with the next [`Sender::poll`].
    #[inline(never)] // The linked image is checked from here on: `tests/tests/image.rs`.
    pub fn push(&mut self, now: Micros, frame: &Frame) {
        match self.guard.as_mut().map_or(Admission::Admitted, |guard| guard.admit(now, self.period, frame)) {
            Admission::Admitted => {}
            Admission::Refused => return count(&mut self.counts.guarded),
            Admission::Shut => {
                count(&mut self.counts.guarded);
                return self.give_up_all();
            }
        }
        for loaded in self.slots.iter_mut().flatten() {
            if supersedes(frame, &loaded.queued.frame) {
                // Counted when it comes back: it may be on the wire.
                loaded.obsolete.get_or_insert(Obsolete::Replaced);
            }
        }
        for place in &mut self.waiting {
            if place.is_some_and(|queued| supersedes(frame, &queued.frame)) {
                *place = None;
                count(&mut self.counts.replaced);
            }
        }
        self.order += 1;
        self.keep(Queued { frame: *frame, since: now, order: self.order });
    }

    /// Goes on to `now`: looks what became of the frames in the slots, gives up what is out of date, and fills the slots with the most urgent.
    #[inline(never)] // Like `push`.
    pub fn poll(&mut self, now: Micros, slots: &mut impl Slots) {
        self.collect(slots);
        self.give_up(now);
        if self.off {
            return;
        }
        for (number, loaded) in self.slots.iter_mut().enumerate() {
            if let Some(loaded) = loaded.as_mut().filter(|loaded| loaded.obsolete.is_some() && !loaded.aborting) {
                loaded.aborting = true;
                slots.abort(number);
            }
        }
        self.collect(slots);
        // Each turn fills a slot, or asks for one that is filled; so it ends before that.
        for _ in 0..2 * SLOTS + WAITING {
            if !self.improve(slots) {
                break;
            }
        }
    }

    /// When something will be out of date, if nothing else happens.
    pub fn due(&self) -> Option<Micros> {
        let loaded =
            self.slots.iter().flatten().filter(|loaded| loaded.obsolete.is_none()).map(|loaded| &loaded.queued);
        let due = |queued: &Queued| queued.since.saturating_add(lifetime(&queued.frame, self.period));
        loaded.chain(self.waiting.iter().flatten()).map(due).min().filter(|due| *due < Micros::MAX)
    }

    /// The CAN controller went bus-off, and lost what was in its slots, or came back. Both times what waits is out of date, but for a stop.
    pub fn set_bus_off(&mut self, off: bool) {
        if off && !self.off {
            count(&mut self.counts.bus_off);
        }
        self.off = off;
        let stop = |queued: &Queued| is_stop(&queued.frame);
        for place in &mut self.waiting {
            if place.take_if(|queued| !stop(queued)).is_some() {
                count(&mut self.counts.stale);
            }
        }
        for place in 0..SLOTS {
            match self.slots.get_mut(place).and_then(Option::take) {
                Some(loaded) if stop(&loaded.queued) && loaded.obsolete.is_none() => self.keep(loaded.queued),
                Some(_) => count(&mut self.counts.stale),
                None => {}
            }
        }
    }

    /// What waits is not sent any more, but for a stop.
    fn give_up_all(&mut self) {
        for place in &mut self.waiting {
            if place.take_if(|queued| !is_stop(&queued.frame)).is_some() {
                count(&mut self.counts.guarded);
            }
        }
        for loaded in self.slots.iter_mut().flatten() {
            if !is_stop(&loaded.queued.frame) {
                loaded.obsolete.get_or_insert(Obsolete::Stale);
            }
        }
    }

    /// Lets a frame wait. Without room the least urgent one has to go.
    fn keep(&mut self, queued: Queued) {
        if let Some(place) = self.waiting.iter_mut().find(|place| place.is_none()) {
            *place = Some(queued);
            return;
        }
        count(&mut self.counts.crowded);
        if let Some(last) = self.waiting.iter_mut().flatten().max_by_key(|waiting| waiting.urgency())
            && queued.urgency() < last.urgency()
        {
            *last = queued;
        }
    }

    /// Takes note of what became of the frames in the slots.
    fn collect(&mut self, slots: &mut impl Slots) {
        for number in 0..SLOTS {
            let Some(place) = self.slots.get_mut(number) else { continue };
            let Some(loaded) = *place else { continue };
            let outcome = slots.outcome(number);
            if outcome != Outcome::Pending {
                *place = None;
            }
            match (outcome, loaded.obsolete) {
                (Outcome::Pending, _) => {}
                (Outcome::Sent, _) => count(&mut self.counts.sent),
                (Outcome::Returned, Some(Obsolete::Replaced)) => count(&mut self.counts.replaced),
                (Outcome::Returned, Some(Obsolete::Stale)) => count(&mut self.counts.stale),
                (Outcome::Returned, None) => {
                    count(&mut self.counts.displaced);
                    self.keep(loaded.queued);
                }
            }
        }
    }

    fn give_up(&mut self, now: Micros) {
        let period = self.period;
        for place in &mut self.waiting {
            if place.take_if(|queued| queued.stale(now, period)).is_some() {
                count(&mut self.counts.stale);
            }
        }
        for loaded in self.slots.iter_mut().flatten() {
            if loaded.queued.stale(now, period) {
                loaded.obsolete.get_or_insert(Obsolete::Stale);
            }
        }
    }

    /// Brings the most urgent waiting frame nearer to the wire; whether there was something to do.
    fn improve(&mut self, slots: &mut impl Slots) -> bool {
        let waiting = self.waiting.iter_mut().filter(|place| place.is_some());
        let Some(best) = waiting.min_by_key(|place| place.as_ref().map(Queued::urgency)) else { return false };
        let Some(queued) = *best else { return false };
        if let Some((number, place)) = self.slots.iter_mut().enumerate().find(|(_, place)| place.is_none()) {
            *best = None;
            *place = Some(Loaded { queued, aborting: false, obsolete: None });
            slots.load(number, &queued.frame);
            return true;
        }
        // Only one of them can be on the wire. If that one is asked back it stays a while, and the next less urgent one has to go as well.
        let pending = self.slots.iter_mut().enumerate().filter_map(|(n, place)| Some((n, place.as_mut()?)));
        let pending = pending.filter(|(_, loaded)| !loaded.aborting && loaded.queued.frame.id > queued.frame.id);
        let Some((number, last)) = pending.max_by_key(|(_, loaded)| loaded.queued.urgency()) else { return false };
        last.aborting = true;
        slots.abort(number);
        self.collect(slots);
        true
    }
}

#[cfg(test)]
mod tests;
