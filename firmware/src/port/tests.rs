//! The sender on a CAN controller with three slots that sends the most urgent frame first.

use std::collections::VecDeque;
use std::vec::Vec;

use composer_shared::wire::{Goal, Message};
use proptest::prelude::*;

use super::*;

const PERIOD: Micros = 50_000;

/// What a chip has in its slots, and what of it is on the wire.
#[derive(Default)]
struct Chip {
    slots: [Option<Frame>; SLOTS],
    outcome: [Option<Outcome>; SLOTS],
    aborted: [bool; SLOTS],
    wire: Option<usize>,
    sent: Vec<Frame>,
}

impl Slots for Chip {
    fn load(&mut self, slot: usize, frame: &Frame) {
        assert!(self.slots[slot].is_none(), "slot {slot} has a frame");
        (self.slots[slot], self.outcome[slot], self.aborted[slot]) = (Some(*frame), None, false);
    }

    fn abort(&mut self, slot: usize) {
        assert!(self.slots[slot].is_some() && !self.aborted[slot]);
        self.aborted[slot] = true;
        if self.wire != Some(slot) {
            (self.slots[slot], self.outcome[slot]) = (None, Some(Outcome::Returned));
        }
    }

    fn outcome(&mut self, slot: usize) -> Outcome {
        if self.slots[slot].is_some() {
            return Outcome::Pending;
        }
        self.outcome[slot].take().expect("asked about a slot that was not loaded")
    }
}

impl Chip {
    /// The bus is free: the most urgent frame goes onto the wire.
    fn start(&mut self) {
        let slots = self.slots.iter().enumerate().filter_map(|(n, frame)| Some((n, (*frame)?)));
        self.wire = self.wire.or(slots.min_by_key(|(_, frame)| frame.id).map(|(n, _)| n));
    }

    /// The frame on the wire got through, or was destroyed: then it is tried again unless it was asked back.
    fn end(&mut self, through: bool) {
        let Some(slot) = self.wire.take() else { return };
        if through {
            self.sent.extend(self.slots[slot].take());
            self.outcome[slot] = Some(Outcome::Sent);
        } else if self.aborted[slot] {
            self.slots[slot] = None;
            self.outcome[slot] = Some(Outcome::Returned);
        }
    }

    fn ids(&self) -> Vec<u16> {
        let mut ids: Vec<u16> = self.slots.iter().flatten().map(|frame| frame.id).collect();
        ids.sort_unstable();
        ids
    }

    /// Lets everything through until nothing is left; what went over the wire.
    fn drain(&mut self, sender: &mut Sender, now: Micros) -> Vec<Frame> {
        self.sent.clear();
        for _ in 0..100 {
            sender.poll(now, self);
            self.start();
            self.end(true);
        }
        std::mem::take(&mut self.sent)
    }
}

fn frame(function: Function, mark: u8) -> Frame {
    Frame::new(function.id(5), true, &[mark, 0, 0, 0, 0, 0, 0, 0]).unwrap()
}

fn ids(functions: &[Function]) -> Vec<u16> {
    functions.iter().map(|function| function.id(5)).collect()
}

fn filled() -> (Sender, Chip) {
    let (mut sender, mut chip) = (Sender::new(PERIOD), Chip::default());
    for function in [Function::Heartbeat, Function::Telemetry, Function::Latent] {
        sender.push(0, &frame(function, 1));
    }
    sender.poll(0, &mut chip);
    assert_eq!(chip.ids(), ids(&[Function::Latent, Function::Telemetry, Function::Heartbeat]));
    (sender, chip)
}

/// On a bus full of somebody else's frames nothing of these three ever gets through; SYNC must be able to.
#[test]
fn three_frames_that_cannot_be_sent_do_not_block_sync() {
    let (mut sender, mut chip) = filled();
    sender.push(10, &frame(Function::Sync, 1));
    sender.poll(10, &mut chip);
    assert_eq!(chip.ids(), ids(&[Function::Sync, Function::Latent, Function::Telemetry]));
    // The heartbeat came back and is sent when its turn comes.
    let sent: Vec<u16> = chip.drain(&mut sender, 20).iter().map(|frame| frame.id).collect();
    assert_eq!(sent, ids(&[Function::Sync, Function::Latent, Function::Telemetry, Function::Heartbeat]));
    let Counts { sent, displaced, replaced, stale, crowded, .. } = sender.counts();
    assert_eq!((sent, displaced, replaced, stale, crowded), (4, 1, 0, 0, 0));
}

#[test]
fn an_urgent_frame_does_not_wait_for_one_on_the_wire() {
    let (mut sender, mut chip) = (Sender::new(PERIOD), Chip::default());
    sender.push(0, &frame(Function::Heartbeat, 1));
    sender.poll(0, &mut chip);
    chip.start();
    for function in [Function::Telemetry, Function::Latent, Function::Sync] {
        sender.push(1, &frame(function, 1));
    }
    sender.poll(1, &mut chip);
    // The heartbeat is on the wire and stays there; telemetry made room as well.
    assert_eq!(chip.ids(), ids(&[Function::Sync, Function::Latent, Function::Heartbeat]));
    chip.end(true);
    let sent: Vec<u16> = chip.drain(&mut sender, 2).iter().map(|frame| frame.id).collect();
    assert_eq!(sent, ids(&[Function::Sync, Function::Latent, Function::Telemetry]));
    assert_eq!(sender.counts().sent, 4);
}

#[test]
fn a_frame_that_was_asked_back_and_destroyed_is_sent_later() {
    let (mut sender, mut chip) = filled();
    chip.start();
    assert_eq!(chip.wire.map(|slot| chip.slots[slot].unwrap().id), Some(Function::Latent.id(5)));
    for function in [Function::EmergencyStop, Function::Sync, Function::State] {
        sender.push(1, &frame(function, 1));
    }
    sender.poll(1, &mut chip);
    chip.end(false);
    let sent: Vec<u16> = chip.drain(&mut sender, 2).iter().map(|frame| frame.id).collect();
    let all = [Function::EmergencyStop, Function::Sync, Function::State, Function::Latent, Function::Telemetry];
    assert_eq!(sent, [ids(&all), ids(&[Function::Heartbeat])].concat());
}

#[test]
fn the_newest_of_a_function_replaces_the_older_wherever_it_is() {
    let (mut sender, mut chip) = filled();
    // In a slot, waiting, and on the wire.
    sender.push(1, &frame(Function::State, 1));
    chip.start();
    sender.push(2, &frame(Function::State, 2));
    sender.push(2, &frame(Function::Heartbeat, 2));
    sender.push(2, &frame(Function::Latent, 2));
    sender.poll(2, &mut chip);
    chip.end(true);
    let first = std::mem::take(&mut chip.sent);
    let sent = chip.drain(&mut sender, 3);
    let told: Vec<(u16, u8)> = first.iter().chain(&sent).map(|frame| (frame.id >> 7, frame.data[0])).collect();
    assert_eq!(told, [(4, 1), (3, 2), (4, 2), (8, 1), (9, 2)]);
    assert_eq!(sender.counts().replaced, 2);
}

#[test]
fn what_belongs_together_replaces_nothing() {
    let goal = |cycle, point, x| Message::Goal(Goal::new(cycle, point, Some([x, 0.0, 0.0]))).emit(0x7f, true);
    assert!(!supersedes(&goal(7, 1, 0.0), &goal(7, 0, 0.0)));
    assert!(supersedes(&goal(7, 1, 0.0), &goal(7, 1, 2.0)));
    assert!(supersedes(&goal(8, 0, 0.0), &goal(7, 1, 0.0)));
    let piece = |cycle: u8, index: u8| {
        Frame::new(Function::LatentFragment.id(5), false, &[index << 4 | cycle, 1, 2, 3, 4, 5, 6, 7]).unwrap()
    };
    assert!(!supersedes(&piece(3, 1), &piece(3, 0)));
    assert!(supersedes(&piece(3, 1), &piece(3, 1)) && supersedes(&piece(4, 0), &piece(3, 1)));
    // Others' frames are none of its business, and neither are functions that it does not know.
    assert!(!supersedes(&frame(Function::State, 1), &Frame { id: 0x186, ..frame(Function::State, 1) }));
    let unknown = Frame::new(0x385, true, &[0; 8]).unwrap();
    assert!(!supersedes(&unknown, &unknown));

    let mut sender = Sender::new(PERIOD);
    (0..8).for_each(|index| sender.push(0, &piece(3, index)));
    let sent = Chip::default().drain(&mut sender, 0);
    let mut pieces: Vec<u8> = sent.iter().map(|frame| frame.data[0] >> 4).collect();
    pieces.sort_unstable();
    assert_eq!(pieces, [0, 1, 2, 3, 4, 5, 6, 7]);
}

/// A module whose cable is cut sends its SYNC without end. When the cable is mended it must not tell a cycle that is long past.
#[test]
fn nothing_stale_goes_out_on_reconnect() {
    let (mut sender, mut chip) = (Sender::new(PERIOD), Chip::default());
    for function in [Function::EmergencyStop, Function::Sync, Function::State, Function::Telemetry, Function::Heartbeat]
    {
        sender.push(0, &frame(function, 1));
    }
    sender.poll(0, &mut chip);
    chip.start();
    chip.end(false);
    assert_eq!(sender.due(), Some(PERIOD));
    sender.poll(PERIOD - 1, &mut chip);
    assert_eq!(sender.counts().stale, 0);
    sender.poll(PERIOD, &mut chip);
    assert_eq!((sender.counts().stale, sender.due()), (2, Some(10 * PERIOD)));
    sender.push(10 * PERIOD, &frame(Function::State, 2));
    let sent: Vec<u16> = chip.drain(&mut sender, 10 * PERIOD).iter().map(|frame| frame.id).collect();
    assert_eq!(sent, ids(&[Function::EmergencyStop, Function::State]));
    assert_eq!((sender.counts().stale, sender.due()), (4, None));
}

#[test]
fn bus_off_forgets_all_but_a_stop() {
    let (mut sender, mut chip) = filled();
    sender.push(1, &frame(Function::EmergencyStop, 1));
    sender.push(1, &frame(Function::State, 1));
    sender.poll(1, &mut chip);
    // The chip loses its slots.
    let mut chip = Chip::default();
    sender.set_bus_off(true);
    sender.poll(2, &mut chip);
    sender.push(3, &frame(Function::Sync, 2));
    sender.poll(3, &mut chip);
    assert_eq!(lifetime(&frame(Function::EmergencyStop, StopCommand::Release as u8), PERIOD), 10 * PERIOD);
    assert_eq!(chip.ids(), [], "nothing goes to a CAN controller that is bus-off");
    sender.set_bus_off(false);
    sender.push(4, &frame(Function::State, 3));
    let sent: Vec<(u16, u8)> = chip.drain(&mut sender, 4).iter().map(|frame| (frame.id >> 7, frame.data[0])).collect();
    assert_eq!(sent, [(0, 1), (3, 3)]);
    assert_eq!(sender.counts().bus_off, 1);
}

#[test]
fn what_has_no_room_is_the_least_urgent() {
    let mut sender = Sender::new(PERIOD);
    let answer = |mark| Frame::new(0x385, true, &[mark; 8]).unwrap();
    (0..WAITING as u8 + 4).for_each(|mark| sender.push(0, &answer(mark)));
    sender.push(0, &frame(Function::Sync, 1));
    assert_eq!((sender.room(), sender.counts().crowded), (0, 5));
    let sent = Chip::default().drain(&mut sender, 0);
    assert_eq!(sent[0].id, Function::Sync.id(5));
    assert_eq!(sent.len(), WAITING);
}

proptest! {
    /// Whatever is offered and whatever becomes of it: no frame is lost without being counted, none is sent twice, and nothing that waits
    /// is more urgent than all that lies in the slots.
    #[test]
    fn every_frame_is_accounted_for(steps in proptest::collection::vec((0u8..12, any::<bool>(), 0u64..20_000), 1..300)) {
        let (mut sender, mut chip) = (Sender::new(PERIOD), Chip::default());
        let (mut now, mut offered, mut off) = (0, 0u32, false);
        let mut sent = VecDeque::new();
        for (what, through, time) in steps {
            match what {
                0..8 => {
                    let function = Function::ALL[usize::from(what) % Function::ALL.len()];
                    offered += 1;
                    sender.push(now, &Frame { data: [offered as u8; 64], ..frame(function, 0) });
                }
                8 if !off => chip.start(),
                9 if !off => chip.end(through),
                10 if through => {
                    off = !off;
                    (chip.slots, chip.outcome, chip.wire) = Default::default();
                    sender.set_bus_off(off);
                }
                _ => now += time,
            }
            sender.poll(now, &mut chip);
            sent.extend(chip.sent.drain(..));
            let inside = sender.slots.iter().flatten().count() + sender.waiting.iter().flatten().count();
            let Counts { sent: through, replaced, stale, crowded, .. } = sender.counts();
            prop_assert_eq!(offered, through + replaced + stale + crowded + inside as u32);
            prop_assert_eq!(chip.slots.iter().flatten().count(), sender.slots.iter().flatten().count());
            let stuck = sender.slots.iter().flatten().filter(|loaded| !loaded.aborting);
            if let (Some(last), Some(first)) = (stuck.map(|l| l.queued.frame.id).max(), sender.waiting.iter().flatten().map(|q| q.frame.id).min())
                && sender.slots.iter().all(Option::is_some)
            {
                prop_assert!(last <= first, "{} waits behind {}", first, last);
            }
        }
        prop_assert_eq!(sent.len() as u32, sender.counts().sent);
    }
}
