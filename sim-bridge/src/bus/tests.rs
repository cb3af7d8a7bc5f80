//! The bus against ISO 11898-1: times, order, errors, and the pieces of a cut cable.

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
    assert!(!bus.has_room(0));
    assert_eq!(bus.send(0, &frame(0x000, 9), 0), Err(frame(0x000, 9)));
    let events = run(&mut bus, 1_000_000);
    let bytes = events.iter().map(|event| match event {
        Event::Delivered { frame, .. } => frame.data[0],
        other => panic!("{other:?}"),
    });
    assert_eq!(bytes.collect::<Vec<_>>(), [3, 1, 2]);
    assert!(bus.has_room(0));
}

#[test]
fn mail_is_taken_back_unless_it_is_on_the_wire_and_gets_through() {
    for through in [true, false] {
        let mut bus = classic(2);
        let mail = [(0x100, 1), (0x200, 2), (0x300, 3)].map(|(id, byte)| bus.send(0, &frame(id, byte), 0).unwrap());
        bus.set_disturbance(Disturbance { corrupt: if through { 0.0 } else { 1.0 }, ..Disturbance::default() });
        // The first is on the wire.
        assert_eq!(bus.poll(BIT), None);
        bus.take_back(0, mail[0]);
        bus.take_back(0, mail[1]);
        assert_eq!(
            mail.map(|m| bus.outcome(0, m)),
            [MailOutcome::Pending, MailOutcome::Returned, MailOutcome::Pending]
        );
        bus.set_disturbance(Disturbance::default());
        let ids: Vec<u16> = delivered(&run(&mut bus, 1_000_000)).iter().map(|d| d.1).collect();
        // Destroyed, it is not tried again.
        let (sent, outcome) =
            if through { (vec![0x100, 0x300], MailOutcome::Sent) } else { (vec![0x300], MailOutcome::Returned) };
        assert_eq!((ids, bus.outcome(0, mail[0]), bus.outcome(0, mail[2])), (sent, outcome, MailOutcome::Sent));
        assert_eq!(bus.next_event_ns(), u64::MAX);
    }
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
    assert_eq!([0, 1, 2, 3].map(|n| bus.counters(n)), [counters(0, 0), counters(7, 0), counters(0, 1), counters(0, 1)]);
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
