//! A CAN or CAN-FD bus in virtual time (ns): arbitration, acknowledgement, fault confinement, topology, disturbances.
//!
//! Nodes sit along a line; the cable can be cut between any two of them, and the pieces go on independently. Each node has
//! [`MAILBOXES`] transmit mailboxes; the lowest identifier in them takes part in arbitration, equal identifiers in order of arrival. A frame can
//! be taken back; if it is on the wire it may still get through, but it is not tried again.
//!
//! What follows ISO 11898-1:2015:
//! - frame lengths from the actual bits ([`crate::frame_bits`]), 3 bits of intermission, 8 more (suspend transmission) after a frame for an
//!   error-passive node that sent it;
//! - arbitration by identifier among all nodes whose frame is ready when start of frame is sampled (one bit time after the bus was taken);
//! - two nodes sending one identifier at once: the first bit that differs is a bit error of the node that sent it recessive; identical
//!   frames both succeed;
//! - acknowledgement by any other participating node; a missing one is an error of the transmitter;
//! - fault confinement with its counters, see [`ErrorCounters`]; bus-off, and recovery after 128 sequences of 11 recessive bits;
//! - a node that is plugged in takes part after 11 recessive bits.
//!
//! What is simplified:
//! - the flags of an error frame take 12 bits less the run of equal bits that the receivers had already seen (they detect the sixth), at the
//!   nominal rate; then 8 bits of delimiter and 3 of intermission. Overload frames do not occur;
//! - counters change at the end of the frame or error frame, not in the middle of it;
//! - plugging and cutting destroys the frames in flight on that piece of cable, if its transmitter was unplugged or the cable changed;
//! - a frame counts as received at the end of its end-of-frame field (receivers take it one bit earlier);
//! - a node that goes bus-off loses what was in its mailboxes at once.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

use composer_firmware::port::{Outcome as MailOutcome, SLOTS};
use composer_shared::wire::Frame;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::confinement::{ErrorCounters, ErrorState};
use crate::frame_bits::{self, BitRates, BitStream, INTERFRAME_BITS};

/// Most nodes on a bus.
pub const MAX_NODES: usize = 128;
/// Transmit mailboxes of a node, as many as the FDCAN of the board has. What lies in them, [`crate::port`] decides.
pub const MAILBOXES: usize = SLOTS;

const ERROR_FLAG: u32 = 6;
const ERROR_DELIMITER: u32 = 8;
const SUSPEND: u32 = 8;
const INTEGRATION: u32 = 11;
const RECOVERY_SEQUENCES: u32 = 128;
const NEVER: u64 = u64::MAX;

/// A set of nodes, bit k for node k.
pub type Nodes = u128;

fn bit(node: usize) -> Nodes {
    1 << node
}

/// The nodes of a set, lowest first.
pub fn nodes(mut set: Nodes) -> impl Iterator<Item = usize> {
    std::iter::from_fn(move || {
        let node = set.trailing_zeros() as usize;
        set &= set.wrapping_sub(1);
        (node < MAX_NODES).then_some(node)
    })
}

/// What a bus is made of.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BusConfig {
    /// Bit rates.
    pub rates: BitRates,
    /// Whether a node that went bus-off starts its recovery by itself. Otherwise it waits for [`Bus::recover`].
    pub automatic_recovery: bool,
}

impl Default for BusConfig {
    fn default() -> Self {
        BusConfig { rates: BitRates::FD_1M_5M, automatic_recovery: true }
    }
}

/// Disturbances of everything on the bus, each drawn from its own seeded stream.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Disturbance {
    /// Probability that a receiver loses a frame after acknowledging it, per frame and receiver.
    pub drop: f64,
    /// A receiver's software sees each frame later by a time uniform in 0 to this, ns. Order is kept.
    pub delay_ns: u64,
    /// Probability that a bit of a frame is flipped on the wire: an error frame and a retransmission.
    pub corrupt: f64,
    /// Probability that a transmitter sends a frame again after it was received (it missed the end of the acknowledgement).
    pub duplicate: f64,
}

/// Something that happened on the bus.
#[derive(Clone, Debug, PartialEq)]
pub enum Event {
    /// A frame was received.
    Delivered {
        /// Time, ns.
        at_ns: u64,
        /// The frame.
        frame: Frame,
        /// Who sent it: more than one only if they sent identical frames at once. Their mailboxes are free again.
        transmitters: Nodes,
        /// Who received it.
        receivers: Nodes,
        /// Lowest node of the piece of cable.
        segment: usize,
        /// A delayed copy for one receiver; the frame was on the wire earlier and has been reported then.
        late: bool,
    },
    /// An error frame ended.
    ErrorFrame {
        /// Time, ns.
        at_ns: u64,
        /// Who sent the frame that was destroyed.
        transmitters: Nodes,
        /// Lowest node of the piece of cable.
        segment: usize,
    },
    /// A node's error state changed.
    State {
        /// Time, ns.
        at_ns: u64,
        /// The node.
        node: usize,
        /// Its new state.
        state: ErrorState,
    },
}

impl Event {
    /// When it happened, ns.
    pub fn at_ns(&self) -> u64 {
        match *self {
            Event::Delivered { at_ns, .. } | Event::ErrorFrame { at_ns, .. } | Event::State { at_ns, .. } => at_ns,
        }
    }
}

/// What a node has seen.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct NodeStats {
    /// Frames sent successfully.
    pub sent: u64,
    /// Frames received, after losses.
    pub received: u64,
    /// Own transmissions that ended in an error.
    pub transmit_errors: u64,
    /// Errors seen as a receiver.
    pub receive_errors: u64,
    /// Times it went bus-off.
    pub bus_off: u64,
}

/// What happened on a bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct BusStats {
    /// Frames sent successfully.
    pub frames: u64,
    /// Error frames.
    pub error_frames: u64,
    /// Frames lost at a receiver.
    pub dropped: u64,
    /// Frames sent twice.
    pub duplicated: u64,
    /// Longest time from a frame being ready to its reception, ns.
    pub worst_latency_ns: u64,
    /// Busy time with intermissions, ns, times the nodes on the piece of cable.
    busy_node_ns: u128,
}

#[derive(Clone, Copy, Debug)]
struct Mail {
    frame: Frame,
    ready_ns: u64,
    order: u64,
    duplicated: bool,
    /// It is on the wire and was asked back.
    aborted: bool,
}

#[derive(Clone, Debug, Default)]
struct Node {
    attached: bool,
    counters: ErrorCounters,
    mailboxes: Vec<Mail>,
    /// Mail that was taken back, by its order, until somebody asks.
    returned: Vec<u64>,
    /// The mail on the wire, by its order.
    sending: Option<u64>,
    /// The frame that it floods the bus with, and since when.
    babble: Option<(Frame, u64)>,
    /// Seen by this node alone: probability of a frame that it misreads.
    misread: f64,
    /// It takes part in frames that start from here on.
    joins_ns: u64,
    /// Suspend transmission: it starts nothing before this.
    held_ns: u64,
    recovering: bool,
    recessive_sequences: u32,
    /// The error state that the outside knows of.
    reported: ErrorState,
    stats: NodeStats,
}

impl Node {
    /// The mail on the wire did not get through. If it was asked back it is not tried again.
    fn not_sent(&mut self) {
        let Some(sending) = self.sending.take() else { return };
        if let Some(index) = self.mailboxes.iter().position(|mail| mail.order == sending && mail.aborted) {
            self.mailboxes.swap_remove(index);
            self.returned.push(sending);
        }
    }

    /// When it has something to send, if ever.
    fn ready_ns(&self) -> u64 {
        let mails = self.mailboxes.iter().map(|mail| mail.ready_ns);
        mails.chain(self.babble.map(|(_, since)| since)).min().unwrap_or(NEVER)
    }

    /// Its most urgent frame and the order of its mail; none for the babbled one.
    fn candidate(&self, now: u64) -> Option<(&Frame, Option<u64>)> {
        let ready = self.mailboxes.iter().filter(|mail| mail.ready_ns <= now);
        let best = ready.min_by_key(|mail| (mail.frame.id, mail.order));
        match (best, self.babble.as_ref().map(|(frame, _)| frame)) {
            (Some(mail), babble) if babble.is_none_or(|b| mail.frame.id < b.id) => {
                Some((&mail.frame, Some(mail.order)))
            }
            (_, babble) => babble.map(|frame| (frame, None)),
        }
    }
}

#[derive(Clone, Debug)]
enum Outcome {
    Delivered {
        frame: Frame,
        /// Identical frames may have several senders.
        transmitters: Nodes,
        /// Error-passive nodes that lost a collision within the frame without disturbing it.
        losers: Nodes,
        /// Error-passive nodes that misread it.
        deaf: Nodes,
    },
    Destroyed {
        transmitters: Nodes,
        losers: Nodes,
        missing_acknowledgement: bool,
        /// The receiver that detected the error alone.
        first: Option<usize>,
    },
}

#[derive(Clone, Debug)]
enum Phase {
    /// Free from `since`; recessive bits before `counted` went into the recovery of nodes that are bus-off.
    Idle {
        since: u64,
        counted: u64,
    },
    Arbitration {
        sof: u64,
    },
    Busy {
        sof: u64,
        outcome: Outcome,
    },
}

#[derive(Clone, Debug)]
struct Segment {
    members: Nodes,
    phase: Phase,
    /// When something happens here next.
    next: u64,
}

/// A frame on its way to a receiver's software. Ordered by time, then by order of arrival.
#[derive(Clone, Debug, PartialEq, Eq)]
struct Delayed {
    at_ns: u64,
    order: u64,
    receiver: usize,
    transmitters: Nodes,
    segment: usize,
    frame: Frame,
}

impl Ord for Delayed {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.at_ns, self.order).cmp(&(other.at_ns, other.order))
    }
}

impl PartialOrd for Delayed {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

/// The bus.
///
/// Time advances by [`Bus::poll`] alone; calls that change something take the present time, which must not be ahead of
/// [`Bus::next_event_ns`].
#[derive(Clone, Debug)]
pub struct Bus {
    config: BusConfig,
    bit_ns: u64,
    disturbance: Disturbance,
    nodes: Vec<Node>,
    segments: Vec<Segment>,
    /// Bit k: the cable is cut between node k and node k + 1.
    cuts: Nodes,
    /// Nodes with something to send.
    pending: Nodes,
    off: Nodes,
    attached: Nodes,
    /// Nodes plugged in lately, which may not take part yet.
    joining: Nodes,
    /// Nodes with an error counter that is not zero.
    troubled: Nodes,
    order: u64,
    delayed: BinaryHeap<Reverse<Delayed>>,
    last_delivery_ns: Vec<u64>,
    events: VecDeque<Event>,
    stats: BusStats,
    drop_rng: ChaCha8Rng,
    delay_rng: ChaCha8Rng,
    corrupt_rng: ChaCha8Rng,
    duplicate_rng: ChaCha8Rng,
}

fn stream(seed: u64, number: u64) -> ChaCha8Rng {
    let mut rng = ChaCha8Rng::seed_from_u64(seed);
    rng.set_stream(number);
    rng
}

impl Bus {
    /// A whole, idle bus of `count` nodes (at most [`MAX_NODES`]; more are cut off) in line order, all plugged in.
    pub fn new(config: BusConfig, count: usize, seed: u64) -> Self {
        let count = count.min(MAX_NODES);
        let all = if count == MAX_NODES { Nodes::MAX } else { bit(count) - 1 };
        let node = Node { attached: true, recovering: true, ..Node::default() };
        Bus {
            config,
            bit_ns: config.rates.nominal_ns(1),
            disturbance: Disturbance::default(),
            nodes: vec![node; count],
            segments: vec![Segment { members: all, phase: Phase::Idle { since: 0, counted: 0 }, next: NEVER }],
            cuts: 0,
            pending: 0,
            off: 0,
            attached: all,
            joining: 0,
            troubled: 0,
            order: 0,
            delayed: BinaryHeap::new(),
            last_delivery_ns: vec![0; count],
            events: VecDeque::new(),
            stats: BusStats::default(),
            drop_rng: stream(seed, 1),
            delay_rng: stream(seed, 2),
            corrupt_rng: stream(seed, 3),
            duplicate_rng: stream(seed, 4),
        }
    }

    /// Number of nodes, plugged in or not.
    pub fn count(&self) -> usize {
        self.nodes.len()
    }

    /// Error counters of a node.
    pub fn counters(&self, node: usize) -> ErrorCounters {
        self.nodes[node].counters
    }

    /// Error state of a node.
    pub fn state(&self, node: usize) -> ErrorState {
        self.nodes[node].counters.state()
    }

    /// What a node has seen.
    pub fn node_stats(&self, node: usize) -> NodeStats {
        self.nodes[node].stats
    }

    /// What happened so far.
    pub fn stats(&self) -> BusStats {
        self.stats
    }

    /// Share of the time up to `now` in which the bus was busy (intermissions included), as the average node saw it.
    pub fn load(&self, now: u64) -> f64 {
        self.stats.busy_node_ns as f64 / (now.max(1) as f64 * self.nodes.len().max(1) as f64)
    }

    /// Whether a node can take another frame.
    pub fn has_room(&self, node: usize) -> bool {
        let slot = &self.nodes[node];
        slot.attached && self.off & bit(node) == 0 && slot.mailboxes.len() < MAILBOXES
    }

    /// Puts a frame in a mailbox of `node`, to be sent from `ready_ns` on. Gives the number of this mail, or the frame back if there is no room.
    pub fn send(&mut self, node: usize, frame: &Frame, ready_ns: u64) -> Result<u64, Frame> {
        if !self.has_room(node) {
            return Err(*frame);
        }
        self.order += 1;
        let mail = Mail { frame: *frame, ready_ns, order: self.order, duplicated: false, aborted: false };
        self.nodes[node].mailboxes.push(mail);
        self.pending |= bit(node);
        self.notice(node);
        Ok(self.order)
    }

    /// Takes back the mail of `node` with this number. If it is on the wire it may still get through.
    pub fn take_back(&mut self, node: usize, number: u64) {
        let slot = &mut self.nodes[node];
        let Some(index) = slot.mailboxes.iter().position(|mail| mail.order == number) else { return };
        if slot.sending == Some(number) {
            slot.mailboxes[index].aborted = true;
        } else {
            slot.mailboxes.swap_remove(index);
            slot.returned.push(number);
            self.forget_if_empty(node);
        }
    }

    /// What became of the mail of `node` with this number. That it came back is told once.
    pub fn outcome(&mut self, node: usize, number: u64) -> MailOutcome {
        let slot = &mut self.nodes[node];
        if let Some(index) = slot.returned.iter().position(|returned| *returned == number) {
            slot.returned.swap_remove(index);
            MailOutcome::Returned
        } else if slot.mailboxes.iter().any(|mail| mail.order == number) {
            MailOutcome::Pending
        } else {
            MailOutcome::Sent
        }
    }

    /// Sets the disturbances of the bus.
    pub fn set_disturbance(&mut self, disturbance: Disturbance) {
        self.disturbance = disturbance;
    }

    /// The present disturbances of the bus.
    pub fn disturbance(&self) -> Disturbance {
        self.disturbance
    }

    /// Makes `node` misread each frame with this probability (a disturbance at one receiver).
    pub fn set_misread(&mut self, node: usize, probability: f64) {
        self.nodes[node].misread = probability;
    }

    /// Makes `node` send this frame without end, as fast as the bus lets it; none ends it.
    pub fn set_babble(&mut self, now: u64, node: usize, frame: Option<Frame>) {
        if !self.nodes[node].attached {
            return;
        }
        self.nodes[node].babble = frame.map(|frame| (frame, now));
        self.pending |= bit(node);
        self.forget_if_empty(node);
        self.notice(node);
    }

    /// Takes a node off the bus and forgets its state.
    pub fn unplug(&mut self, now: u64, node: usize) {
        let Node { stats, misread, .. } = self.nodes[node];
        self.nodes[node] = Node { stats, misread, recovering: true, ..Node::default() };
        for set in [&mut self.attached, &mut self.pending, &mut self.off, &mut self.joining, &mut self.troubled] {
            *set &= !bit(node);
        }
        self.delayed.retain(|Reverse(delayed)| delayed.receiver != node);
        let Some(index) = self.segment_of(node) else { return };
        let (bit_ns, segment) = (self.bit_ns, &mut self.segments[index]);
        if let Phase::Busy { outcome, .. } = &mut segment.phase {
            let (Outcome::Delivered { transmitters, .. } | Outcome::Destroyed { transmitters, .. }) = *outcome;
            if transmitters & bit(node) != 0 {
                *outcome = Outcome::Destroyed {
                    transmitters: transmitters & !bit(node),
                    losers: 0,
                    missing_acknowledgement: false,
                    first: None,
                };
                segment.next = now + u64::from(2 * ERROR_FLAG + ERROR_DELIMITER) * bit_ns;
            }
        }
    }

    /// Plugs a node in, with fresh error counters and empty mailboxes.
    pub fn plug(&mut self, now: u64, node: usize) {
        if self.attached & bit(node) != 0 {
            return;
        }
        let Node { stats, misread, .. } = self.nodes[node];
        let joins_ns = now + u64::from(INTEGRATION) * self.bit_ns;
        self.nodes[node] = Node { attached: true, recovering: true, joins_ns, stats, misread, ..Node::default() };
        self.last_delivery_ns[node] = now;
        self.attached |= bit(node);
        self.joining |= bit(node);
    }

    /// Whether a node is plugged in.
    pub fn plugged(&self, node: usize) -> bool {
        self.nodes[node].attached
    }

    /// Starts the recovery of a node that is bus-off, where it is not automatic.
    pub fn recover(&mut self, now: u64, node: usize) {
        if self.off & bit(node) != 0 && !self.nodes[node].recovering {
            let Some(index) = self.segment_of(node) else { return };
            self.count_idle(index, now);
            self.nodes[node].recovering = true;
            self.nodes[node].recessive_sequences = 0;
            self.schedule(index);
        }
    }

    /// Cuts the cable between `position` and the next node, or mends it.
    pub fn set_cut(&mut self, now: u64, position: usize, cut: bool) {
        if position + 1 >= self.nodes.len() || (self.cuts & bit(position) != 0) == cut {
            return;
        }
        self.cuts ^= bit(position);
        for index in 0..self.segments.len() {
            self.count_idle(index, now);
        }
        let old = std::mem::take(&mut self.segments);
        let (mut members, mut pieces) = (0, Vec::new());
        for node in 0..self.nodes.len() {
            members |= bit(node);
            if self.cuts & bit(node) != 0 || node + 1 == self.nodes.len() {
                pieces.push(std::mem::take(&mut members));
            }
        }
        for members in pieces {
            if let Some(same) = old.iter().find(|segment| segment.members == members) {
                self.segments.push(same.clone());
                continue;
            }
            let (mut since, mut involved, mut busy) = (now, 0, false);
            for segment in old.iter().filter(|segment| segment.members & members != 0) {
                match segment.phase {
                    Phase::Idle { since: idle, .. } => since = since.max(idle),
                    Phase::Arbitration { .. } => busy = true,
                    Phase::Busy { sof, ref outcome } => {
                        busy = true;
                        let (Outcome::Delivered { transmitters, .. } | Outcome::Destroyed { transmitters, .. }) =
                            *outcome;
                        involved |= transmitters;
                        let shared = (segment.members & members).count_ones();
                        self.stats.busy_node_ns += u128::from(now - sof) * u128::from(shared);
                    }
                }
            }
            let (phase, next) = if busy {
                let outcome = Outcome::Destroyed {
                    transmitters: involved & members & self.attached,
                    losers: 0,
                    missing_acknowledgement: false,
                    first: None,
                };
                let end = now + u64::from(2 * ERROR_FLAG + ERROR_DELIMITER) * self.bit_ns;
                (Phase::Busy { sof: now, outcome }, end)
            } else {
                (Phase::Idle { since, counted: since }, NEVER)
            };
            self.segments.push(Segment { members, phase, next });
        }
        for index in 0..self.segments.len() {
            self.schedule(index);
        }
    }

    /// How many cuts there are between the first node and this one: the number of its piece of cable.
    pub fn cuts_before(&self, node: usize) -> u32 {
        (self.cuts & (bit(node) - 1)).count_ones()
    }

    /// When something happens next, ns; `u64::MAX` if nothing will.
    pub fn next_event_ns(&self) -> u64 {
        if !self.events.is_empty() {
            return 0;
        }
        let delayed = self.delayed.peek().map_or(NEVER, |Reverse(delayed)| delayed.at_ns);
        self.segments.iter().fold(delayed, |next, segment| next.min(segment.next))
    }

    /// Advances to the next event that the outside can see, but not beyond `until` (ns, inclusive).
    pub fn poll(&mut self, until: u64) -> Option<Event> {
        loop {
            if let Some(event) = self.events.pop_front() {
                return Some(event);
            }
            let segment = self.segments.iter().enumerate().min_by_key(|(_, segment)| segment.next);
            let (index, next) = segment.map_or((0, NEVER), |(index, segment)| (index, segment.next));
            if let Some(Reverse(delayed)) = self.delayed.peek()
                && delayed.at_ns <= next.min(until)
            {
                let Some(Reverse(delayed)) = self.delayed.pop() else { continue };
                self.nodes[delayed.receiver].stats.received += 1;
                return Some(Event::Delivered {
                    at_ns: delayed.at_ns,
                    frame: delayed.frame,
                    transmitters: delayed.transmitters,
                    receivers: bit(delayed.receiver),
                    segment: delayed.segment,
                    late: true,
                });
            }
            if next > until || next == NEVER {
                return None;
            }
            match self.segments[index].phase {
                Phase::Idle { .. } => self.leave_idle(index, next),
                Phase::Arbitration { sof } => self.arbitrate(index, sof, next),
                Phase::Busy { .. } => self.finish(index, next),
            }
        }
    }

    fn segment_of(&self, node: usize) -> Option<usize> {
        self.segments.iter().position(|segment| segment.members & bit(node) != 0)
    }

    fn bits_ns(&self, bits: u32) -> u64 {
        self.config.rates.nominal_ns(bits)
    }

    fn forget_if_empty(&mut self, node: usize) {
        let slot = &self.nodes[node];
        if slot.babble.is_none() && slot.mailboxes.is_empty() {
            self.pending &= !bit(node);
        }
    }

    /// When a node could take the bus, if it is free.
    fn start_ns(&self, node: usize) -> u64 {
        let slot = &self.nodes[node];
        slot.ready_ns().max(slot.held_ns).max(slot.joins_ns)
    }

    /// A node has something new to send.
    fn notice(&mut self, node: usize) {
        let Some(index) = self.segment_of(node) else { return };
        if let Phase::Idle { since, .. } = self.segments[index].phase
            && self.off & bit(node) == 0
        {
            let start = self.start_ns(node).max(since);
            let segment = &mut self.segments[index];
            segment.next = segment.next.min(start);
        }
    }

    /// Sets the time of the next event of an idle piece.
    fn schedule(&mut self, index: usize) {
        let Phase::Idle { since, counted } = self.segments[index].phase else { return };
        let members = self.segments[index].members;
        let mut next = NEVER;
        for node in nodes(members & self.pending & self.attached & !self.off) {
            next = next.min(self.start_ns(node).max(since));
        }
        for node in nodes(members & self.off).filter(|&node| self.nodes[node].recovering) {
            let missing = RECOVERY_SEQUENCES.saturating_sub(self.nodes[node].recessive_sequences);
            next = next.min(counted + u64::from(missing) * self.bits_ns(INTEGRATION));
        }
        self.segments[index].next = next;
    }

    /// Counts the sequences of 11 recessive bits of an idle bus for the nodes that recover from bus-off (rule l).
    fn count_idle(&mut self, index: usize, now: u64) {
        let sequence = self.bits_ns(INTEGRATION).max(1);
        let segment = &mut self.segments[index];
        let Phase::Idle { counted, .. } = &mut segment.phase else { return };
        let sequences = now.saturating_sub(*counted) / sequence;
        *counted += sequences * sequence;
        for node in nodes(segment.members & self.off) {
            let slot = &mut self.nodes[node];
            slot.recessive_sequences = slot.recessive_sequences.saturating_add(sequences.min(1 << 16) as u32);
        }
    }

    /// Rule l: counters at zero and error active again.
    fn recover_ready(&mut self, index: usize, now: u64) {
        for node in nodes(self.segments[index].members & self.off) {
            let slot = &mut self.nodes[node];
            if slot.recovering && slot.recessive_sequences >= RECOVERY_SEQUENCES {
                slot.counters = ErrorCounters::default();
                slot.recessive_sequences = 0;
                self.off &= !bit(node);
                self.troubled &= !bit(node);
                slot.reported = ErrorState::Active;
                self.events.push_back(Event::State { at_ns: now, node, state: ErrorState::Active });
            }
        }
    }

    /// Who takes part in a frame that started at `sof`: plugged in for long enough and not bus-off.
    fn taking_part(&mut self, index: usize, sof: u64) -> Nodes {
        let members = self.segments[index].members & self.attached & !self.off;
        let mut waiting = 0;
        for node in nodes(members & self.joining) {
            if self.nodes[node].joins_ns <= sof {
                self.joining &= !bit(node);
            } else {
                waiting |= bit(node);
            }
        }
        members & !waiting
    }

    fn leave_idle(&mut self, index: usize, now: u64) {
        self.count_idle(index, now);
        self.recover_ready(index, now);
        let ready = self.segments[index].members & self.pending & self.attached & !self.off;
        if nodes(ready).any(|node| self.start_ns(node) <= now) {
            self.segments[index].phase = Phase::Arbitration { sof: now };
            self.segments[index].next = now + self.bit_ns;
        } else {
            self.schedule(index);
        }
    }

    fn arbitrate(&mut self, index: usize, sof: u64, now: u64) {
        let members = self.segments[index].members & self.attached & !self.off;
        let (mut transmitters, mut frame, mut same) = (0, None::<&Frame>, true);
        for node in nodes(members & self.pending) {
            let slot = &self.nodes[node];
            if slot.held_ns > sof || slot.joins_ns > sof {
                continue;
            }
            let Some((mine, _)) = slot.candidate(now) else { continue };
            match frame {
                Some(best) if best.id < mine.id => {}
                Some(best) if best.id == mine.id => {
                    transmitters |= bit(node);
                    same &= best == mine;
                }
                _ => (transmitters, frame, same) = (bit(node), Some(mine), true),
            }
        }
        let Some(mut frame) = frame.copied() else {
            // Whoever took the bus is gone.
            self.segments[index].phase = Phase::Idle { since: now, counted: now };
            self.schedule(index);
            return;
        };
        let mut losers = 0;
        if !same {
            match self.collide(transmitters, now) {
                Collision::Destroyed { losers, stream, at } => {
                    let left = transmitters & !losers;
                    let outcome =
                        Outcome::Destroyed { transmitters: left, losers, missing_acknowledgement: false, first: None };
                    let end = sof + self.destroyed_ns(&stream, at, false, left);
                    self.occupy(index, sof, end, outcome);
                    return;
                }
                Collision::Survived { winner, winners, losers: lost } => {
                    (transmitters, frame, losers) = (winners, winner, lost);
                }
            }
        }
        if self.disturbance.corrupt > 0.0 && self.corrupt_rng.random::<f64>() < self.disturbance.corrupt {
            let stream = BitStream::new(&frame);
            let at = self.corrupt_rng.random_range(stream.control..stream.ack);
            let end = sof + self.destroyed_ns(&stream, at, true, transmitters);
            let outcome = Outcome::Destroyed { transmitters, losers, missing_acknowledgement: false, first: None };
            self.occupy(index, sof, end, outcome);
            return;
        }
        let receivers = self.taking_part(index, sof) & !transmitters & !losers;
        let mut misread = 0;
        for node in nodes(receivers) {
            let probability = self.nodes[node].misread;
            if probability > 0.0 && self.corrupt_rng.random::<f64>() < probability {
                misread |= bit(node);
            }
        }
        if receivers & !misread == 0 {
            // Nobody acknowledges: the error flag starts with the acknowledgement delimiter.
            let stream = BitStream::new(&frame);
            let end = sof
                + self.config.rates.ns(stream.length_of(stream.ack + 1))
                + self.bits_ns(ERROR_FLAG + ERROR_DELIMITER);
            let outcome = Outcome::Destroyed { transmitters, losers, missing_acknowledgement: true, first: None };
            self.occupy(index, sof, end, outcome);
            return;
        }
        if let Some(first) = nodes(misread).find(|&node| self.state(node) == ErrorState::Active) {
            // A checksum error is signalled from the first bit of end of frame on; the others answer one bit later.
            let stream = BitStream::new(&frame);
            let end = sof
                + self.config.rates.ns(stream.length_of(stream.ack + 2))
                + self.bits_ns(1 + ERROR_FLAG + ERROR_DELIMITER);
            let outcome =
                Outcome::Destroyed { transmitters, losers, missing_acknowledgement: false, first: Some(first) };
            self.occupy(index, sof, end, outcome);
            return;
        }
        let end = sof + self.config.rates.ns(frame_bits::length(&frame));
        self.occupy(index, sof, end, Outcome::Delivered { frame, transmitters, losers, deaf: misread });
    }

    fn occupy(&mut self, index: usize, sof: u64, end: u64, outcome: Outcome) {
        let (Outcome::Delivered { transmitters, losers, .. } | Outcome::Destroyed { transmitters, losers, .. }) =
            outcome;
        for node in nodes(transmitters | losers) {
            let slot = &mut self.nodes[node];
            slot.sending = slot.candidate(sof + self.bit_ns).and_then(|(_, order)| order);
        }
        let segment = &mut self.segments[index];
        segment.phase = Phase::Busy { sof, outcome };
        segment.next = end;
    }

    /// Time from start of frame to the end of the delimiter of an error frame, if the error is at bit `at`.
    fn destroyed_ns(&self, stream: &BitStream, at: usize, flipped: bool, transmitters: Nodes) -> u64 {
        let active = nodes(transmitters).any(|node| self.state(node) == ErrorState::Active);
        // An active flag continues a run of dominant bits, a passive one (or a silent transmitter) a run of recessive ones.
        let level = !active;
        let wire = |k: usize| stream.bits[k] != (flipped && k == at);
        let run = (0..=at).rev().take_while(|&k| wire(k) == level).count().min(6) as u32;
        self.config.rates.ns(stream.length_of(at + 1)) + self.bits_ns(2 * ERROR_FLAG - run + ERROR_DELIMITER)
    }

    /// Several nodes passed arbitration with the same identifier and different frames.
    fn collide(&self, transmitters: Nodes, now: u64) -> Collision {
        let mut streams: Vec<(usize, Frame, BitStream)> = nodes(transmitters)
            .filter_map(|node| self.nodes[node].candidate(now).map(|(frame, _)| (node, *frame, BitStream::new(frame))))
            .collect();
        let mut losers = 0;
        let mut at = 0;
        loop {
            let dominant = streams.iter().any(|(_, _, stream)| stream.bits.get(at) == Some(&false));
            let recessive: Vec<usize> =
                streams.iter().filter(|(_, _, stream)| stream.bits.get(at) == Some(&true)).map(|s| s.0).collect();
            if dominant && !recessive.is_empty() {
                // The bit on the wire is dominant: whoever sent it recessive has a bit error.
                if recessive.iter().any(|&node| self.state(node) == ErrorState::Active) {
                    streams.retain(|(node, _, _)| !recessive.contains(node));
                    let stream = streams.swap_remove(0).2;
                    return Collision::Destroyed { losers, stream, at };
                }
                losers = recessive.iter().fold(losers, |set, &node| set | bit(node));
                streams.retain(|(node, _, _)| !recessive.contains(node));
            }
            at += 1;
            if streams.len() < 2 || at >= streams[0].2.bits.len() {
                let winners = streams.iter().fold(0, |set, s| set | bit(s.0));
                return Collision::Survived { winner: streams[0].1, winners, losers };
            }
        }
    }

    /// The end of a frame or error frame.
    fn finish(&mut self, index: usize, now: u64) {
        let since = now + self.bits_ns(INTERFRAME_BITS);
        let idle = Phase::Idle { since, counted: since };
        let Phase::Busy { sof, outcome } = std::mem::replace(&mut self.segments[index].phase, idle) else { return };
        let members = self.segments[index].members;
        self.stats.busy_node_ns += u128::from(since - sof) * u128::from(members.count_ones());
        let present = members & self.attached & !self.off;
        let joined = self.taking_part(index, sof);
        let segment = members.trailing_zeros() as usize;
        // Acknowledgement delimiter, end of frame and intermission (or error delimiter and intermission) are 11 recessive bits.
        for node in nodes(members & self.off) {
            self.nodes[node].recessive_sequences += 1;
        }
        self.recover_ready(index, now);
        match outcome {
            Outcome::Delivered { frame, transmitters, losers, deaf } => {
                self.stats.frames += 1;
                for node in nodes(transmitters & present) {
                    self.sent(node, now);
                }
                self.troubled |= (losers | deaf) & present;
                for node in nodes(losers & present) {
                    self.nodes[node].not_sent();
                    self.nodes[node].counters.transmit_error(false);
                    self.nodes[node].stats.transmit_errors += 1;
                    self.nodes[node].held_ns = since + self.bits_ns(SUSPEND);
                    self.forget_if_empty(node);
                }
                for node in nodes(deaf & present) {
                    self.nodes[node].counters.receive_error(false);
                    self.nodes[node].stats.receive_errors += 1;
                }
                let receivers = joined & !transmitters & !losers & !deaf;
                nodes(receivers & self.troubled).for_each(|node| self.nodes[node].counters.received());
                let receivers = self.lose_or_delay(&frame, transmitters, receivers, segment, now);
                nodes(receivers).for_each(|node| self.nodes[node].stats.received += 1);
                self.events.push_back(Event::Delivered {
                    at_ns: now,
                    frame,
                    transmitters,
                    receivers,
                    segment,
                    late: false,
                });
            }
            Outcome::Destroyed { transmitters, losers, missing_acknowledgement, first } => {
                self.stats.error_frames += 1;
                self.troubled |= joined | transmitters & present;
                for node in nodes((transmitters | losers) & present) {
                    let slot = &mut self.nodes[node];
                    slot.not_sent();
                    slot.counters.transmit_error(missing_acknowledgement && losers & bit(node) == 0);
                    slot.stats.transmit_errors += 1;
                }
                for node in nodes(joined & !transmitters & !losers) {
                    self.nodes[node].counters.receive_error(first == Some(node));
                    self.nodes[node].stats.receive_errors += 1;
                }
                for node in nodes((transmitters | losers) & present) {
                    self.forget_if_empty(node);
                    if self.state(node) != ErrorState::Active {
                        self.nodes[node].held_ns = since + self.bits_ns(SUSPEND);
                    }
                }
                self.events.push_back(Event::ErrorFrame { at_ns: now, transmitters, segment });
            }
        }
        for node in nodes(present & self.troubled) {
            let state = self.state(node);
            if state != self.nodes[node].reported {
                self.nodes[node].reported = state;
                self.events.push_back(Event::State { at_ns: now, node, state });
                if state == ErrorState::BusOff {
                    self.go_off(node);
                }
            }
            if self.nodes[node].counters == ErrorCounters::default() {
                self.troubled &= !bit(node);
            }
        }
        self.schedule(index);
    }

    fn go_off(&mut self, node: usize) {
        let recovering = self.config.automatic_recovery;
        let slot = &mut self.nodes[node];
        slot.mailboxes.clear();
        slot.returned.clear();
        slot.sending = None;
        slot.recovering = recovering;
        slot.recessive_sequences = 0;
        slot.stats.bus_off += 1;
        self.off |= bit(node);
        self.forget_if_empty(node);
    }

    /// A transmitter's side of a successful frame.
    fn sent(&mut self, node: usize, now: u64) {
        let duplicate =
            self.disturbance.duplicate > 0.0 && self.duplicate_rng.random::<f64>() < self.disturbance.duplicate;
        let slot = &mut self.nodes[node];
        slot.counters.transmitted();
        slot.stats.sent += 1;
        let sending = slot.sending.take();
        if let Some(index) = slot.mailboxes.iter().position(|mail| Some(mail.order) == sending) {
            let mail = &mut slot.mailboxes[index];
            self.stats.worst_latency_ns = self.stats.worst_latency_ns.max(now.saturating_sub(mail.ready_ns));
            if duplicate && !mail.duplicated && !mail.aborted {
                mail.duplicated = true;
                self.stats.duplicated += 1;
            } else {
                slot.mailboxes.swap_remove(index);
            }
        }
        if slot.counters.state() == ErrorState::Passive {
            slot.held_ns = now + self.config.rates.nominal_ns(INTERFRAME_BITS + SUSPEND);
        }
        self.forget_if_empty(node);
    }

    /// Applies losses and delays; returns who has the frame now.
    fn lose_or_delay(
        &mut self,
        frame: &Frame,
        transmitters: Nodes,
        receivers: Nodes,
        segment: usize,
        now: u64,
    ) -> Nodes {
        let Disturbance { drop, delay_ns, .. } = self.disturbance;
        if drop == 0.0 && delay_ns == 0 && self.delayed.is_empty() {
            return receivers;
        }
        let mut at_once = 0;
        for node in nodes(receivers) {
            if drop > 0.0 && self.drop_rng.random::<f64>() < drop {
                self.stats.dropped += 1;
                continue;
            }
            let wait = if delay_ns > 0 { self.delay_rng.random_range(0..=delay_ns) } else { 0 };
            let at_ns = self.last_delivery_ns[node].max(now + wait);
            self.last_delivery_ns[node] = at_ns;
            if at_ns == now {
                at_once |= bit(node);
            } else {
                self.order += 1;
                let order = self.order;
                self.delayed.push(Reverse(Delayed {
                    at_ns,
                    order,
                    receiver: node,
                    transmitters,
                    segment,
                    frame: *frame,
                }));
            }
        }
        at_once
    }
}

enum Collision {
    Destroyed { losers: Nodes, stream: BitStream, at: usize },
    Survived { winner: Frame, winners: Nodes, losers: Nodes },
}

#[cfg(test)]
mod tests;
