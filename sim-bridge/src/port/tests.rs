//! The port on a bus: among others that flood it, behind a cut cable, bus-off, and with a module that does not listen.

use composer_shared::wire::Function;

use super::*;
use crate::bus::{BusConfig, Event};

const MS: u64 = 1_000_000;
const PERIOD: Micros = 50_000;

fn frame(function: Function, node: u8, mark: u8) -> Frame {
    Frame::new(function.id(node), true, &[mark; 8]).unwrap()
}

/// A bus with a port at its first node.
struct Bench {
    bus: Bus,
    port: Port,
    now: u64,
    /// What others received: when, and the frame.
    heard: Vec<(u64, Frame)>,
}

impl Bench {
    fn new(nodes: usize) -> Self {
        let bus = Bus::new(BusConfig::default(), nodes, 1);
        Bench { bus, port: Port::new(PERIOD), now: 0, heard: Vec::new() }
    }

    fn send(&mut self, function: Function, mark: u8) {
        let mut port = self.port.at(&mut self.bus, 0, self.now);
        port.send(&frame(function, 0, mark));
        port.poll();
    }

    fn run(&mut self, until: u64) {
        while self.now < until {
            self.now = self.bus.next_event_ns().min(self.port.next_ns()).clamp(self.now, until);
            while let Some(event) = self.bus.poll(self.now) {
                if let Event::Delivered { at_ns, frame, transmitters: 1, .. } = event {
                    self.heard.push((at_ns, frame));
                }
                self.port.at(&mut self.bus, 0, self.now).poll();
            }
            self.port.at(&mut self.bus, 0, self.now).poll();
        }
    }

    fn told(&self) -> Vec<(u16, u8)> {
        self.heard.iter().map(|(_, frame)| (frame.id >> 7, frame.data[0])).collect()
    }
}

/// Three frames that lose every arbitration fill the slots of the chip. With a queue behind them instead of slots by urgency SYNC would wait for
/// ever, and every module would take the time over.
#[test]
fn a_flood_does_not_keep_sync_off_the_bus() {
    let mut bench = Bench::new(3);
    bench.bus.set_babble(0, 2, Some(Frame::new(0x0ff, true, &[0x55; 8]).unwrap()));
    bench.run(MS);
    for function in [Function::Heartbeat, Function::Telemetry, Function::Latent, Function::State] {
        bench.send(function, 1);
    }
    bench.run(20 * MS);
    assert!(bench.heard.is_empty(), "the flood wins");
    bench.send(Function::Sync, 2);
    bench.run(50 * MS);
    assert_eq!(bench.told(), [(1, 2)]);
    // At most one frame of the flood was before it.
    assert!(bench.heard[0].0 < 20 * MS + 130_000, "{}", bench.heard[0].0);
    // State displaced the heartbeat, SYNC the telemetry.
    assert_eq!(bench.port.counts().displaced, 2);
    // What does not get out for so long is given up instead of told when the flood ends.
    bench.bus.set_babble(bench.now, 2, None);
    bench.run(52 * MS);
    let late: Vec<u16> = bench.told()[1..].iter().map(|(function, _)| *function).collect();
    assert_eq!(late, [3, 4, 8, 9]);
}

#[test]
fn nothing_stale_goes_out_when_a_cable_is_mended() {
    let mut bench = Bench::new(2);
    bench.bus.set_cut(0, 0, true);
    bench.send(Function::EmergencyStop, 1);
    for function in [Function::Sync, Function::State, Function::Latent, Function::Telemetry] {
        bench.send(function, 19);
    }
    bench.run(120 * MS);
    bench.send(Function::State, 21);
    bench.run(140 * MS);
    assert!(bench.heard.is_empty());
    bench.bus.set_cut(bench.now, 0, false);
    bench.run(145 * MS);
    assert_eq!(bench.told(), [(0, 1), (3, 21), (8, 19)]);
    assert_eq!(bench.port.counts().stale, 3);
}

#[test]
fn nothing_of_before_bus_off_goes_out_after_it_but_a_stop() {
    let mut bench = Bench::new(2);
    bench.bus.set_disturbance(crate::bus::Disturbance { corrupt: 1.0, ..Default::default() });
    bench.send(Function::Sync, 1);
    bench.send(Function::EmergencyStop, 1);
    while bench.bus.state(0) != ErrorState::BusOff {
        bench.run(bench.now + 10_000);
    }
    bench.send(Function::State, 2);
    let status = bench.port.at(&mut bench.bus, 0, bench.now).status();
    assert_eq!((status.bus, status.transmit_errors, status.counts.bus_off), (BusStatus::BusOff, 256, 1));
    bench.bus.set_disturbance(Default::default());
    bench.run(bench.now + 10 * MS);
    bench.send(Function::State, 3);
    bench.run(bench.now + MS);
    assert_eq!(bench.told(), [(0, 1), (3, 3)]);
    assert_eq!(bench.port.at(&mut bench.bus, 0, bench.now).status().bus, BusStatus::ErrorActive);
}

#[test]
fn what_a_module_does_not_come_to_is_lost_and_counted() {
    let mut bench = Bench::new(1);
    for mark in 0..RECEIVED as u8 + 5 {
        bench.port.hear(&frame(Function::State, 3, mark));
    }
    assert_eq!(bench.port.counts().overflowed, 5);
    let mut port = bench.port.at(&mut bench.bus, 0, 0);
    let first: Vec<u8> = std::iter::from_fn(|| port.receive()).map(|frame| frame.data[0]).collect();
    assert_eq!(first, (0..RECEIVED as u8).collect::<Vec<_>>());
}

#[test]
fn a_frame_that_is_still_computed_takes_no_slot() {
    let mut bench = Bench::new(2);
    bench.port.send_at(&frame(Function::Latent, 0, 1), 200_000);
    bench.port.send_at(&frame(Function::Heartbeat, 0, 1), 0);
    assert_eq!(bench.port.next_ns(), 0);
    bench.run(150_000);
    assert_eq!((bench.told(), bench.port.next_ns()), (vec![(9, 1)], 200_000));
    bench.run(MS);
    assert_eq!(bench.told(), [(9, 1), (4, 1)]);
    assert!(bench.heard[1].0 > 200_000);
}
