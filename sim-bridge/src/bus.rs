//! A CAN or CAN-FD bus in virtual time (ns): arbitration, acknowledgement, fault confinement, topology, disturbances.
//!
//! Nodes sit along a line; the cable can be cut between any two of them, and the pieces go on independently. Each node has
//! [`MAILBOXES`] transmit mailboxes; the lowest identifier in them takes part in arbitration, equal identifiers in order of arrival. What
//! is not on the wire can be cancelled.
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
//! - a node that goes bus-off loses what was in its mailboxes.

use std::cmp::Reverse;
use std::collections::{BinaryHeap, VecDeque};

use composer_shared::wire::Frame;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::frame_bits::{self, BitRates, BitStream, INTERFRAME_BITS};

/// Most nodes on a bus.
pub const MAX_NODES: usize = 128;
/// Transmit mailboxes of a node. Bosch's M_CAN has up to 32; a driver of a controller with fewer gets the same effect by cancelling a
/// less urgent frame for a more urgent one.
pub const MAILBOXES: usize = 16;

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

/// How a node takes part in the bus (ISO 11898-1:2015, 12.1.4.1).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ErrorState {
    /// Signals errors with a dominant flag.
    #[default]
    Active,
    /// Signals errors with a recessive flag, which disturbs nobody.
    Passive,
    /// Takes no part.
    BusOff,
}

/// Transmit and receive error counters and the rules that change them (ISO 11898-1:2015, 12.1.4.2, rules a to l).
///
/// Rules d, e and f (errors within an error flag) cannot arise here.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct ErrorCounters {
    /// Transmit error counter.
    pub transmit: u16,
    /// Receive error counter.
    pub receive: u16,
}

impl ErrorCounters {
    /// Rules i, j, k: error passive when a counter exceeds 127, bus-off when the transmit counter exceeds 255.
    pub fn state(self) -> ErrorState {
        if self.transmit > 255 {
            ErrorState::BusOff
        } else if self.transmit > 127 || self.receive > 127 {
            ErrorState::Passive
        } else {
            ErrorState::Active
        }
    }

    /// Rules a and b: a receiver that detects an error adds 1, and 8 more if it sees a dominant bit right after its own error flag,
    /// which means that it was the first to detect the error.
    pub fn receive_error(&mut self, first: bool) {
        self.receive = (self.receive + if first { 9 } else { 1 }).min(255);
    }

    /// Rule c: a transmitter that sends an error flag adds 8, except (exception 1) an error-passive one that misses an acknowledgement
    /// and sees no dominant bit while it sends its flag: a node alone on the bus does not drive itself bus-off.
    pub fn transmit_error(&mut self, missing_acknowledgement: bool) {
        if !(missing_acknowledgement && self.state() == ErrorState::Passive) {
            self.transmit += 8;
        }
    }

    /// Rule g: a successful transmission takes 1 off.
    pub fn transmitted(&mut self) {
        self.transmit = self.transmit.saturating_sub(1);
    }

    /// Rule h: a successful reception takes 1 off, or brings a counter above 127 to a value between 119 and 127 (here 127).
    pub fn received(&mut self) {
        self.receive = if self.receive > 127 { 127 } else { self.receive.saturating_sub(1) };
    }
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
}

#[derive(Clone, Debug, Default)]
struct Node {
    attached: bool,
    counters: ErrorCounters,
    mailboxes: Vec<Mail>,
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

    /// How many more frames `node` can take.
    pub fn room(&self, node: usize) -> usize {
        if self.has_room(node) { MAILBOXES - self.nodes[node].mailboxes.len() } else { 0 }
    }

    /// Puts a frame in a mailbox of `node`, to be sent from `ready_ns` on. Gives the frame back if there is no room.
    pub fn send(&mut self, node: usize, frame: &Frame, ready_ns: u64) -> Result<(), Frame> {
        if !self.has_room(node) {
            return Err(*frame);
        }
        self.order += 1;
        let mail = Mail { frame: *frame, ready_ns, order: self.order, duplicated: false };
        self.nodes[node].mailboxes.push(mail);
        self.pending |= bit(node);
        self.notice(node);
        Ok(())
    }

    /// Takes back the frames of `node` that are not on the wire and for which `which` says so.
    pub fn cancel(&mut self, node: usize, which: impl Fn(&Frame) -> bool) {
        let slot = &mut self.nodes[node];
        let sending = slot.sending;
        slot.mailboxes.retain(|mail| Some(mail.order) == sending || !which(&mail.frame));
        self.forget_if_empty(node);
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
                    self.nodes[node].sending = None;
                    self.nodes[node].counters.transmit_error(false);
                    self.nodes[node].stats.transmit_errors += 1;
                    self.nodes[node].held_ns = since + self.bits_ns(SUSPEND);
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
                    slot.sending = None;
                    slot.counters.transmit_error(missing_acknowledgement && losers & bit(node) == 0);
                    slot.stats.transmit_errors += 1;
                }
                for node in nodes(joined & !transmitters & !losers) {
                    self.nodes[node].counters.receive_error(first == Some(node));
                    self.nodes[node].stats.receive_errors += 1;
                }
                for node in nodes((transmitters | losers) & present) {
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
            if duplicate && !mail.duplicated {
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
mod tests {
    use super::*;
    use crate::frame_bits::length;
    use proptest::prelude::*;

    const BIT: u64 = 1000;

    fn classic(count: usize) -> Bus {
        Bus::new(BusConfig { rates: BitRates::CLASSIC_1M, automatic_recovery: true }, count, 1)
    }

    fn frame(id: u16, byte: u8) -> Frame {
        Frame::new(id, false, &[byte; 8]).unwrap()
    }

    fn run(bus: &mut Bus, until: u64) -> Vec<Event> {
        std::iter::from_fn(|| bus.poll(until)).collect()
    }

    /// Time, identifier and receivers of what was delivered.
    fn delivered(events: &[Event]) -> Vec<(u64, u16, Nodes)> {
        let one = |event: &Event| match *event {
            Event::Delivered { at_ns, frame, receivers, .. } => Some((at_ns, frame.id, receivers)),
            _ => None,
        };
        events.iter().filter_map(one).collect()
    }

    fn duration(frame: &Frame) -> u64 {
        BitRates::CLASSIC_1M.ns(length(frame))
    }

    fn counters(transmit: u16, receive: u16) -> ErrorCounters {
        ErrorCounters { transmit, receive }
    }

    #[test]
    fn a_frame_takes_its_bits() {
        let mut bus = classic(3);
        bus.send(1, &frame(0x181, 0x55), 5_000).unwrap();
        let events = run(&mut bus, 1_000_000);
        assert_eq!(delivered(&events), [(5_000 + duration(&frame(0x181, 0x55)), 0x181, 0b101)]);
        let busy = duration(&frame(0x181, 0x55)) + 3 * BIT;
        assert_eq!(bus.load(1_000_000), busy as f64 / 1e6);
        assert_eq!(bus.stats().worst_latency_ns, duration(&frame(0x181, 0x55)));
    }

    #[test]
    fn the_data_phase_of_an_fd_frame_is_faster() {
        let mut bus = Bus::new(BusConfig::default(), 2, 1);
        let frame = Frame::new(0x201, true, &[0x5a; 64]).unwrap();
        bus.send(0, &frame, 0).unwrap();
        let at = delivered(&run(&mut bus, 1_000_000))[0].0;
        assert_eq!(at, BitRates::FD_1M_5M.ns(length(&frame)));
        assert!((136_000..=165_800).contains(&at));
    }

    #[test]
    fn the_lowest_identifier_wins_and_the_others_follow_after_three_bits() {
        let mut bus = classic(4);
        // Node 0 takes the bus half a bit earlier, but start of frame is not sampled yet when the others come in.
        bus.send(0, &frame(0x300, 1), 0).unwrap();
        bus.send(1, &frame(0x200, 2), BIT / 2).unwrap();
        bus.send(2, &frame(0x100, 3), BIT).unwrap();
        // This one is too late for the first frame.
        bus.send(3, &frame(0x001, 4), BIT + 1).unwrap();
        let got = delivered(&run(&mut bus, 1_000_000));
        assert_eq!(got.iter().map(|d| d.1).collect::<Vec<_>>(), [0x100, 0x001, 0x200, 0x300]);
        let mut end = 0;
        for (at, byte, id) in got.iter().zip([3, 4, 2, 1]).map(|(d, byte)| (d.0, byte, d.1)) {
            assert_eq!(at, end + duration(&frame(id, byte)));
            end = at + 3 * BIT;
        }
    }

    #[test]
    fn a_node_sends_its_most_urgent_mailbox_first_and_equal_identifiers_in_order() {
        let mut bus = classic(2);
        for (id, byte) in [(0x300, 1), (0x300, 2), (0x100, 3)] {
            bus.send(0, &frame(id, byte), 0).unwrap();
        }
        for byte in 0..MAILBOXES as u8 - 3 {
            bus.send(0, &frame(0x400, byte), 0).unwrap();
        }
        assert!(!bus.has_room(0));
        assert_eq!(bus.send(0, &frame(0x000, 9), 0), Err(frame(0x000, 9)));
        // 3 is on the wire and cannot be taken back any more.
        assert_eq!(bus.poll(BIT), None);
        bus.cancel(0, |frame| frame.id == 0x400 || frame.id == 0x100);
        let events = run(&mut bus, 1_000_000);
        let bytes = events.iter().map(|event| match event {
            Event::Delivered { frame, .. } => frame.data[0],
            other => panic!("{other:?}"),
        });
        assert_eq!(bytes.collect::<Vec<_>>(), [3, 1, 2]);
        assert!(bus.has_room(0));
    }

    /// Rule c, exception 1: without acknowledgement the transmit counter stops where the node becomes error passive.
    #[test]
    fn a_lone_node_becomes_error_passive_and_never_bus_off() {
        let mut bus = classic(1);
        bus.send(0, &frame(0x100, 0), 0).unwrap();
        let events = run(&mut bus, 1_000_000_000);
        assert_eq!(bus.counters(0), counters(128, 0));
        let states: Vec<_> = events.iter().filter(|event| matches!(event, Event::State { .. })).collect();
        assert!(matches!(states[..], [Event::State { state: ErrorState::Passive, .. }]));
        let errors: Vec<u64> =
            events.iter().filter(|event| matches!(event, Event::ErrorFrame { .. })).map(Event::at_ns).collect();
        // Up to the acknowledgement slot, 6 bits of flag, 8 of delimiter; then 3 of intermission, and 8 of suspend once passive.
        let stream = BitStream::new(&frame(0x100, 0));
        let attempt = (stream.ack as u64 + 1 + 6 + 8 + 3) * BIT;
        assert_eq!(errors[0], attempt - 3 * BIT);
        assert!(errors[..16].windows(2).all(|pair| pair[1] - pair[0] == attempt));
        assert!(errors[16..].windows(2).all(|pair| pair[1] - pair[0] == attempt + 8 * BIT));
    }

    #[test]
    fn company_ends_the_retries_of_a_lone_node() {
        let mut bus = classic(2);
        bus.unplug(0, 1);
        bus.send(0, &frame(0x100, 0), 0).unwrap();
        assert!(delivered(&run(&mut bus, 10_000_000)).is_empty());
        bus.plug(10_000_000, 1);
        let got = delivered(&run(&mut bus, 20_000_000));
        assert_eq!(got.len(), 1);
        assert_eq!(got[0].2, 0b10);
        // Rule g: 128 - 1 = 127, error active again (rule j).
        assert_eq!((bus.counters(0), bus.state(0)), (counters(127, 0), ErrorState::Active));
    }

    #[test]
    fn identical_frames_at_once_both_succeed() {
        let mut bus = classic(3);
        bus.send(0, &frame(0x100, 7), 0).unwrap();
        bus.send(1, &frame(0x100, 7), 0).unwrap();
        let events = run(&mut bus, 1_000_000);
        assert!(matches!(events[..], [Event::Delivered { transmitters: 0b011, receivers: 0b100, .. }]));
        assert_eq!(bus.stats().error_frames, 0);
        assert!(bus.has_room(0) && bus.next_event_ns() == u64::MAX);
    }

    /// Rules a and c: a bit error where the two frames differ.
    #[test]
    fn one_identifier_at_two_nodes_is_a_bit_error() {
        let mut bus = classic(3);
        bus.send(0, &frame(0x100, 0xff), 0).unwrap();
        bus.send(1, &frame(0x100, 0x0f), 0).unwrap();
        let first = bus.poll(1_000_000).unwrap();
        // SOF, identifier 00100000000 with a stuff bit after 00000, three control bits with one more, DLC 1000 and then the first bit of data.
        let [a, b] = [BitStream::new(&frame(0x100, 0xff)), BitStream::new(&frame(0x100, 0x0f))];
        let at = (0..).find(|&k| a.bits[k] != b.bits[k]).unwrap();
        let run = (0..=at).rev().take_while(|&k| !b.bits[k]).count();
        let end = (at + 1 + 12 - run + 8) as u64 * BIT;
        assert_eq!(first, Event::ErrorFrame { at_ns: end, transmitters: 0b011, segment: 0 });
        assert_eq!([0, 1, 2].map(|node| bus.counters(node)), [counters(8, 0), counters(8, 0), counters(0, 1)]);
        // They collide until both are error passive; a passive flag disturbs nobody, so that one gets through, then the other.
        let events = run_all(&mut bus);
        let got = delivered(&events);
        assert_eq!(got.len(), 2);
        assert_eq!(bus.stats().error_frames, 16);
        // 0x0f is dominant where they differ: node 1 goes first. 16 * 8 = 128, one more bit error for node 0, one success each.
        assert_eq!([0, 1].map(|node| bus.counters(node)), [counters(135, 0), counters(127, 0)]);
        assert_eq!([0, 1].map(|node| bus.state(node)), [ErrorState::Passive, ErrorState::Active]);
    }

    fn run_all(bus: &mut Bus) -> Vec<Event> {
        run(bus, 1_000_000_000)
    }

    /// Rules a, b, c, g, h, i, k.
    #[test]
    fn the_counters_follow_the_rules() {
        let mut c = counters(0, 0);
        c.transmitted();
        c.received();
        assert_eq!(c, counters(0, 0));
        c.receive_error(false);
        assert_eq!(c, counters(0, 1));
        c.receive_error(true);
        assert_eq!(c, counters(0, 10));
        c.received();
        assert_eq!(c, counters(0, 9));
        c.transmit_error(false);
        c.transmitted();
        assert_eq!(c, counters(7, 9));
        for (pair, state) in [
            ((127, 127), ErrorState::Active),
            ((128, 0), ErrorState::Passive),
            ((0, 128), ErrorState::Passive),
            ((255, 0), ErrorState::Passive),
            ((256, 0), ErrorState::BusOff),
        ] {
            assert_eq!(counters(pair.0, pair.1).state(), state, "{pair:?}");
        }
        let mut passive = counters(128, 200);
        passive.received();
        assert!((119..=127).contains(&passive.receive));
        passive.transmit_error(true);
        assert_eq!(passive.transmit, 128);
        passive.transmit_error(false);
        assert_eq!(passive.transmit, 136);
    }

    /// Rule k: bus-off above 255. Rule l: back after 128 times 11 recessive bits.
    #[test]
    fn bus_off_and_recovery() {
        let mut bus = classic(3);
        bus.set_disturbance(Disturbance { corrupt: 1.0, ..Disturbance::default() });
        bus.send(0, &frame(0x100, 0x55), 0).unwrap();
        let mut off = 0;
        while let Some(event) = bus.poll(1_000_000_000) {
            if let Event::State { at_ns, node: 0, state: ErrorState::BusOff } = event {
                off = at_ns;
                break;
            }
        }
        // 32 errors of 8 exceed 255; the receivers count 1 each (rule a).
        assert_eq!(bus.stats().error_frames, 32);
        assert_eq!([0, 1, 2].map(|node| bus.counters(node)), [counters(256, 0), counters(0, 32), counters(0, 32)]);
        assert!(!bus.has_room(0));
        bus.set_disturbance(Disturbance::default());
        let back = bus.poll(1_000_000_000).unwrap();
        let recovery = (3 + 128 * 11) * BIT;
        assert_eq!(back, Event::State { at_ns: off + recovery, node: 0, state: ErrorState::Active });
        assert_eq!(bus.counters(0), counters(0, 0));
        assert_eq!(bus.node_stats(0).bus_off, 1);
        bus.send(0, &frame(0x100, 0x55), off + recovery).unwrap();
        assert_eq!(delivered(&run_all(&mut bus)).len(), 1);
    }

    /// Rule l on a busy bus: each frame ends in 11 recessive bits, however short the gap.
    #[test]
    fn recovery_counts_frames_on_a_busy_bus() {
        let mut bus = classic(3);
        bus.set_disturbance(Disturbance { corrupt: 1.0, ..Disturbance::default() });
        bus.send(0, &frame(0x100, 0x55), 0).unwrap();
        while bus.state(0) != ErrorState::BusOff {
            bus.poll(1_000_000_000).unwrap();
        }
        bus.set_disturbance(Disturbance::default());
        let now = bus.next_event_ns().min(10_000_000);
        bus.set_babble(now, 1, Some(frame(0x200, 0x55)));
        let mut frames = 0;
        loop {
            match bus.poll(now + 1_000_000_000).unwrap() {
                Event::Delivered { .. } => frames += 1,
                Event::State { node: 0, state: ErrorState::Active, .. } => break,
                _ => {}
            }
        }
        assert!((126..=128).contains(&frames), "{frames}");
    }

    #[test]
    fn without_automatic_recovery_a_node_stays_off_until_told() {
        let mut bus = Bus::new(BusConfig { rates: BitRates::CLASSIC_1M, automatic_recovery: false }, 2, 1);
        bus.set_disturbance(Disturbance { corrupt: 1.0, ..Disturbance::default() });
        bus.send(0, &frame(0x100, 0x55), 0).unwrap();
        run(&mut bus, 100_000_000);
        assert_eq!(bus.state(0), ErrorState::BusOff);
        bus.recover(100_000_000, 0);
        let events = run(&mut bus, 200_000_000);
        let at = events[0].at_ns() - 100_000_000;
        assert!((127 * 11 * BIT..=128 * 11 * BIT).contains(&at), "{at}");
        assert_eq!(bus.state(0), ErrorState::Active);
    }

    #[test]
    fn an_error_passive_node_suspends_itself_for_eight_bits() {
        let mut bus = classic(3);
        bus.set_disturbance(Disturbance { corrupt: 1.0, ..Disturbance::default() });
        bus.send(0, &frame(0x100, 0x55), 0).unwrap();
        while bus.state(0) == ErrorState::Active {
            bus.poll(1_000_000_000).unwrap();
        }
        bus.set_disturbance(Disturbance::default());
        bus.send(0, &frame(0x101, 0x55), 0).unwrap();
        bus.send(0, &frame(0x102, 0x55), 0).unwrap();
        // Error passive at 128: the frame that brings it to 127 is not followed by a suspension, so raise it well above.
        bus.nodes[0].counters.transmit = 200;
        let got = delivered(&run_all(&mut bus));
        for pair in got.windows(2) {
            let gap = pair[1].0 - pair[0].0 - duration(&frame(pair[1].1, 0x55));
            assert_eq!(gap, (3 + 8) * BIT);
        }
        // An error-active node goes in between although its identifier is higher.
        bus.send(0, &frame(0x100, 1), 500_000_000_000).unwrap();
        bus.send(0, &frame(0x101, 2), 500_000_000_000).unwrap();
        bus.send(1, &frame(0x700, 3), 500_000_000_000).unwrap();
        let order: Vec<u16> = delivered(&run(&mut bus, 600_000_000_000)).iter().map(|d| d.1).collect();
        assert_eq!(order, [0x100, 0x700, 0x101]);
    }

    /// Rule b: the receiver that alone saw the error sees a dominant bit after its flag, from the flags of the others.
    #[test]
    fn a_receiver_that_misreads_counts_nine() {
        let mut bus = classic(3);
        bus.set_misread(1, 1.0);
        bus.send(0, &frame(0x100, 0x55), 0).unwrap();
        assert!(matches!(bus.poll(1_000_000), Some(Event::ErrorFrame { .. })));
        assert_eq!([0, 1, 2].map(|node| bus.counters(node)), [counters(8, 0), counters(0, 9), counters(0, 1)]);
        // After 15 of them it is error passive and disturbs nobody any more: the frame gets through to the other.
        let got = delivered(&run(&mut bus, 100_000_000));
        assert_eq!(got.len(), 1);
        assert_eq!(got[0].2, 0b100);
        assert_eq!(bus.state(1), ErrorState::Passive);
    }

    #[test]
    fn corrupted_frames_are_sent_again_until_they_arrive() {
        let mut bus = classic(3);
        bus.set_disturbance(Disturbance { corrupt: 0.2, ..Disturbance::default() });
        let mut got = Vec::new();
        for k in 0..200u16 {
            bus.send(usize::from(k % 3), &frame(0x100 + k, k as u8), u64::from(k) * 300_000).unwrap();
            got.extend(delivered(&run(&mut bus, u64::from(k + 1) * 300_000)));
        }
        got.extend(delivered(&run_all(&mut bus)));
        let mut ids: Vec<u16> = got.iter().map(|d| d.1).collect();
        ids.sort_unstable();
        assert_eq!(ids, (0x100..0x100 + 200).collect::<Vec<_>>());
        let errors = bus.stats().error_frames;
        assert!((25..85).contains(&errors), "{errors}");
    }

    #[test]
    fn losses_delays_and_duplicates() {
        let mut bus = classic(2);
        let send = |bus: &mut Bus, count: u64| {
            let start = bus.next_event_ns().min(1 << 60);
            assert_eq!(start, 1 << 60, "idle");
            let base = bus.order * 1_000_000;
            for k in 0..count {
                bus.send(0, &frame(0x100, k as u8), base + k * 1_000_000).unwrap();
                while bus.next_event_ns() <= base + (k + 1) * 1_000_000 && !bus.has_room(0) {
                    bus.poll(base + (k + 1) * 1_000_000);
                }
                EVENTS.with_borrow_mut(|e| e.extend(run(bus, base + (k + 1) * 1_000_000 - 1)));
            }
            EVENTS.with_borrow_mut(|e| {
                e.extend(run(bus, u64::MAX - 1));
                std::mem::take(e)
            })
        };
        thread_local! { static EVENTS: std::cell::RefCell<Vec<Event>> = const { std::cell::RefCell::new(Vec::new()) }; }
        bus.set_disturbance(Disturbance { drop: 0.1, ..Disturbance::default() });
        let got = delivered(&send(&mut bus, 1000));
        let lost = got.iter().filter(|d| d.2 == 0).count();
        assert!((60..150).contains(&lost) && bus.stats().dropped == lost as u64, "{lost}");

        bus.set_disturbance(Disturbance { duplicate: 0.1, ..Disturbance::default() });
        let twice = send(&mut bus, 1000).len() - 1000;
        assert!((60..150).contains(&twice) && bus.stats().duplicated == twice as u64, "{twice}");

        bus.set_disturbance(Disturbance { delay_ns: 3_000_000, ..Disturbance::default() });
        let events = send(&mut bus, 300);
        let (mut sent, mut arrived) = (Vec::new(), Vec::new());
        for event in events {
            match event {
                Event::Delivered { at_ns, frame, late, receivers, .. } => {
                    if !late {
                        sent.push(at_ns);
                    }
                    if receivers != 0 {
                        arrived.push((at_ns, frame.data[0]));
                    }
                }
                other => panic!("{other:?}"),
            }
        }
        assert_eq!(arrived.len(), 300);
        let bytes: Vec<u8> = (0..300u64).map(|k| k as u8).collect();
        assert_eq!(arrived.iter().map(|a| a.1).collect::<Vec<_>>(), bytes, "order is kept");
        let late: Vec<u64> = arrived.iter().zip(&sent).map(|(a, sent)| a.0 - sent).collect();
        assert!(late.iter().all(|l| *l <= 3_000_000) && late.iter().any(|l| *l > 1_500_000));
    }

    #[test]
    fn a_babbling_node_starves_what_is_less_urgent() {
        let mut bus = classic(3);
        bus.set_babble(0, 2, Some(frame(0x0ff, 0x55)));
        bus.send(0, &frame(0x080, 1), 0).unwrap();
        bus.send(1, &frame(0x181, 2), 0).unwrap();
        let ids: Vec<u16> = delivered(&run(&mut bus, 50_000_000)).iter().map(|d| d.1).collect();
        assert!(ids.contains(&0x080) && !ids.contains(&0x181) && ids.len() > 350);
        assert!(bus.load(50_000_000) > 0.99);
        bus.set_babble(50_000_000, 2, None);
        assert!(delivered(&run(&mut bus, 51_000_000)).iter().any(|d| d.1 == 0x181));
        assert_eq!(bus.next_event_ns(), u64::MAX);
    }

    #[test]
    fn a_cut_makes_two_buses_and_mending_makes_one() {
        let mut bus = classic(4);
        bus.set_cut(0, 1, true);
        bus.send(0, &frame(0x100, 1), 0).unwrap();
        bus.send(3, &frame(0x200, 2), 0).unwrap();
        let mut got = delivered(&run(&mut bus, 1_000_000));
        got.sort_by_key(|d| d.1);
        // At the same time, each to its own side.
        assert_eq!(got.iter().map(|d| (d.1, d.2)).collect::<Vec<_>>(), [(0x100, 0b0010), (0x200, 0b0100)]);
        assert_eq!(got[0].0, duration(&frame(0x100, 1)));
        assert_eq!(got[1].0, duration(&frame(0x200, 2)));
        bus.set_cut(1_000_000, 1, false);
        bus.send(3, &frame(0x200, 2), 1_000_000).unwrap();
        assert_eq!(delivered(&run(&mut bus, 2_000_000))[0].2, 0b0111);
    }

    #[test]
    fn a_cut_destroys_the_frame_in_flight_and_it_is_sent_again() {
        let mut bus = classic(4);
        bus.send(1, &frame(0x100, 1), 0).unwrap();
        assert_eq!(bus.poll(40_000), None);
        bus.set_cut(40_000, 1, true);
        let events = run(&mut bus, 1_000_000);
        let errors = events.iter().filter(|event| matches!(event, Event::ErrorFrame { .. })).count();
        assert_eq!(errors, 2, "one on each side");
        assert_eq!(delivered(&events).iter().map(|d| d.2).collect::<Vec<_>>(), [0b0001]);
        assert_eq!(
            [0, 1, 2, 3].map(|n| bus.counters(n)),
            [counters(0, 0), counters(7, 0), counters(0, 1), counters(0, 1)]
        );
    }

    #[test]
    fn unplugging_the_transmitter_destroys_its_frame() {
        let mut bus = classic(3);
        bus.send(1, &frame(0x100, 1), 0).unwrap();
        bus.send(0, &frame(0x200, 2), 0).unwrap();
        assert_eq!(bus.poll(40_000), None);
        bus.unplug(40_000, 1);
        assert!(!bus.plugged(1) && !bus.has_room(1));
        assert_eq!(bus.send(1, &frame(0x100, 1), 0), Err(frame(0x100, 1)));
        let got = delivered(&run(&mut bus, 1_000_000));
        assert_eq!(got.iter().map(|d| (d.1, d.2)).collect::<Vec<_>>(), [(0x200, 0b100)]);
        assert_eq!(bus.stats().error_frames, 1);
        // A node that was plugged in hears what starts 11 bits later.
        bus.plug(1_000_000, 1);
        bus.send(0, &frame(0x200, 2), 1_000_000).unwrap();
        bus.send(0, &frame(0x201, 2), 1_000_000).unwrap();
        let got = delivered(&run(&mut bus, 2_000_000));
        assert_eq!(got.iter().map(|d| d.2).collect::<Vec<_>>(), [0b100, 0b110]);
    }

    proptest! {
        /// Whatever happens: time does not run backwards, nothing panics, and the same calls give the same events.
        #[test]
        fn the_bus_is_deterministic_and_never_stuck(
            calls in proptest::collection::vec((0u8..10, 0usize..6, any::<u16>(), 0u64..400_000), 1..120), seed in any::<u64>(),
        ) {
            let simulate = || {
                let config = BusConfig { rates: BitRates::FD_1M_5M, automatic_recovery: true };
                let mut bus = Bus::new(config, 6, seed);
                bus.set_disturbance(Disturbance { drop: 0.1, delay_ns: 300_000, corrupt: 0.1, duplicate: 0.1 });
                let (mut now, mut events) = (0, Vec::new());
                for &(call, node, value, wait) in &calls {
                    match call {
                        0 => bus.unplug(now, node),
                        1 => bus.plug(now, node),
                        2 => bus.set_cut(now, node, value % 2 == 0),
                        3 => bus.set_babble(now, node, (value % 3 == 0).then(|| frame(value & 0x7ff, 1))),
                        4 => bus.set_misread(node, f64::from(value % 5) / 10.0),
                        _ => {
                            let frame = Frame::new(value & 0x30f, value % 2 == 0, &value.to_le_bytes()).unwrap();
                            let _ = bus.send(node, &frame, now);
                        }
                    }
                    now += wait;
                    events.extend(run(&mut bus, now));
                }
                (events, bus.stats())
            };
            let (events, stats) = simulate();
            prop_assert!(events.windows(2).all(|pair| pair[0].at_ns() <= pair[1].at_ns()));
            prop_assert_eq!((events, stats), simulate());
        }
    }
}
