//! Whole robots on an ideal bus: frames arrive at once, the lowest identifier first.

use std::boxed::Box;
use std::collections::VecDeque;
use std::string::ToString;
use std::vec;
use std::vec::Vec;

use composer_shared::policy::{IMAGE_SIZE, Shape, Task, random_image, random_image_of, seal};
use composer_shared::wire::{ALL_MODULES, Function};
use proptest::prelude::*;

use crate::motor_health::share;
use crate::safety::Safety;

use super::*;

mod arming;
mod limits;
mod schedules;

const PERIOD: Micros = 50_000;
const SECOND: Micros = 1_000_000;

/// An untrained policy; bytes of its header can be changed.
fn policy(seed: u32, patch: &[(usize, u8)]) -> Policy<'static> {
    let image = Box::leak(Box::new([0; IMAGE_SIZE]));
    random_image(seed, image);
    for (at, value) in patch {
        image[*at] = *value;
    }
    seal(image);
    Policy::parse(image).unwrap()
}

fn with_memory() -> Policy<'static> {
    let image = Box::leak(Box::new([0; IMAGE_SIZE]));
    random_image_of(Shape::FULL, 3, image);
    Policy::parse(image).unwrap()
}

fn goal_known_to_head() -> Policy<'static> {
    policy(1, &[(11, 1)])
}

fn without_attention() -> Policy<'static> {
    policy(1, &[(28, 0)])
}

fn of_task(task: Task) -> Policy<'static> {
    policy(7, &[(10, task as u8)])
}

/// Where a test puts the point of this number.
fn shifted(goal: [f32; 3], point: u8) -> [f32; 3] {
    [goal[0], goal[1] - 1.5 * f32::from(point), goal[2]]
}

fn level() -> Sensors {
    Sensors { up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO }
}

/// Whether this receiver loses the frame.
type Loss = Box<dyn FnMut(Micros, &Frame, usize) -> bool>;

struct Net {
    now: Micros,
    policy: Policy<'static>,
    bus: BusKind,
    nodes: Vec<Option<Controller<'static>>>,
    outputs: Vec<Outputs>,
    sensors: Vec<Sensors>,
    /// Motors that give nothing; the others give what they are told.
    dead: Vec<[bool; AXES]>,
    status: Vec<BusStatus>,
    mailbox: Vec<Option<Frame>>,
    /// What modules keep to that are plugged in from now on.
    safety: Safety,
    /// Which part of a cut cable a node is on; the station is on part 0.
    part: Vec<u8>,
    goal: Option<[f32; 3]>,
    station: bool,
    /// Modules are armed when they are plugged in, and by the station once a second.
    armed: bool,
    arm_at: Micros,
    injected: VecDeque<(u8, Frame)>,
    loss: Loss,
    log: Vec<(Micros, Frame)>,
}

impl Net {
    fn new(modules: u8, bus: BusKind, policy: Policy<'static>) -> Self {
        let n = usize::from(modules);
        let mut net = Net {
            now: 0,
            policy,
            bus,
            nodes: vec![None; n],
            outputs: vec![Outputs { torque: [0.0; 2], motors_enabled: false, deadline: 0 }; n],
            sensors: vec![level(); n],
            dead: vec![[false; AXES]; n],
            status: vec![BusStatus::ErrorActive; n],
            mailbox: vec![None; n],
            safety: Safety::POLICY,
            part: vec![0; n],
            goal: Some([3.0, 1.0, 0.0]),
            station: true,
            armed: true,
            arm_at: 0,
            injected: VecDeque::new(),
            loss: Box::new(|_, _, _| false),
            log: Vec::new(),
        };
        for node in 0..modules {
            net.plug(node);
        }
        net
    }

    fn eight() -> Self {
        Net::new(8, BusKind::Fd, policy(1, &[]))
    }

    fn plug(&mut self, node: u8) {
        self.start(node, Boot::default());
        if self.armed {
            self.nodes[usize::from(node)].as_mut().unwrap().arm(false).unwrap();
        }
    }

    /// A module that starts, disarmed.
    fn start(&mut self, node: u8, boot: Boot) {
        let config = Config::new(node, self.nodes.len() as u8, self.bus, &self.policy);
        let config = Config { safety: self.safety, ..config };
        let i = usize::from(node);
        self.nodes[i] = Some(Controller::new(config, self.policy, boot, self.now).unwrap());
        self.outputs[i] = Outputs { torque: [0.0; AXES], motors_enabled: false, deadline: self.now };
    }

    fn unplug(&mut self, node: usize) {
        self.nodes[node] = None;
        self.mailbox[node] = None;
    }

    fn at(&self, node: usize) -> &Controller<'static> {
        self.nodes[node].as_ref().unwrap()
    }

    fn live(&self) -> impl Iterator<Item = &Controller<'static>> {
        self.nodes.iter().flatten()
    }

    fn poll(&mut self, node: usize, frame: Option<&Frame>) {
        if let Some(controller) = &mut self.nodes[node] {
            let (mut sensors, plausible) = (self.sensors[node], self.sensors[node].plausible());
            for (axis, torque) in sensors.torque.iter_mut().enumerate().filter(|_| plausible) {
                let given = controller.torque()[axis] / self.policy.limits().torque;
                *torque = if self.dead[node][axis] { 0.0 } else { given };
            }
            let outputs = controller.poll(self.now, &sensors, frame, self.status[node]);
            assert!(outputs.deadline > self.now);
            assert!(outputs.torque.iter().all(|t| t.abs() <= self.policy.limits().torque));
            assert!(outputs.motors_enabled || outputs.torque == [0.0; 2]);
            let may_drive =
                controller.mode() != Mode::Stopped && (controller.armed() || controller.mode() == Mode::Service);
            assert!(may_drive || !outputs.motors_enabled, "module {node} drives, and nobody allowed it");
            self.outputs[node] = outputs;
        }
    }

    /// Sends a frame from outside onto part 0 of the bus.
    fn inject(&mut self, frame: Frame) {
        self.injected.push_back((0, frame));
        self.settle();
    }

    fn station_says(&mut self, command: StopCommand) {
        self.inject(Message::EmergencyStop(EmergencyStop::new(command, 0, StopCount::UNKNOWN)).emit(STATION, true));
        if command == StopCommand::Release {
            self.request(ALL_MODULES, Operation::Arm, 0);
        }
    }

    fn request(&mut self, destination: u8, operation: Operation, value: u32) {
        let request = ServiceRequest { destination, operation: operation as u8, sequence: 7, index: 0, value };
        self.inject(Message::ServiceRequest(request).emit(STATION, true));
    }

    fn settle(&mut self) {
        loop {
            for (slot, node) in self.mailbox.iter_mut().zip(&mut self.nodes) {
                if slot.is_none() {
                    *slot = node.as_mut().and_then(|n| n.next_frame());
                }
            }
            let from_node = (0..self.nodes.len())
                .filter(|i| self.mailbox[*i].is_some())
                .min_by_key(|i| self.mailbox[*i].unwrap().id);
            let (part, frame, sender) = if let Some((part, frame)) = self.injected.pop_front() {
                (part, frame, usize::MAX)
            } else if let Some(i) = from_node {
                (self.part[i], self.mailbox[i].take().unwrap(), i)
            } else {
                return;
            };
            self.log.push((self.now, frame));
            for i in 0..self.nodes.len() {
                if i != sender && self.part[i] == part && !(self.loss)(self.now, &frame, i) {
                    self.poll(i, Some(&frame));
                }
            }
            if self.station
                && part == 0
                && let Ok(Message::Sync(sync)) = Message::parse(&frame)
            {
                for point in 0..self.policy.task().points(self.nodes.len() as u8) {
                    let goal = Message::Goal(Goal::new(sync.cycle as u8, point, self.goal.map(|g| shifted(g, point))));
                    self.injected.push_back((0, goal.emit(STATION, self.bus == BusKind::Fd)));
                }
                if self.armed && self.now >= self.arm_at {
                    self.arm_at = self.now + SECOND;
                    let arm = Operation::Arm as u8;
                    let arm =
                        ServiceRequest { destination: ALL_MODULES, operation: arm, sequence: 0, index: 0, value: 0 };
                    self.injected.push_back((0, Message::ServiceRequest(arm).emit(STATION, self.bus == BusKind::Fd)));
                }
            }
        }
    }

    fn run(&mut self, time: Micros) {
        let until = self.now + time;
        loop {
            let due = |(node, outputs): (&Option<Controller>, &Outputs)| node.as_ref().map(|_| outputs.deadline);
            let next = self.nodes.iter().zip(&self.outputs).filter_map(due).min();
            let Some(next) = next.filter(|next| *next <= until) else {
                self.now = until;
                return;
            };
            self.now = next.max(self.now);
            for i in 0..self.nodes.len() {
                if self.outputs[i].deadline <= self.now {
                    self.poll(i, None);
                }
            }
            self.settle();
        }
    }

    /// Who keeps the time, if all live modules agree.
    fn time_keeper(&self) -> Option<u8> {
        let first = self.live().next()?.time_keeper();
        self.live().all(|n| n.time_keeper() == first).then_some(first)?
    }

    fn assert_in_step(&self) {
        let first = self.live().next().unwrap();
        for node in self.live() {
            assert_eq!(node.cycle(), first.cycle(), "module {}", node.config().node);
            assert_eq!(node.time_keeper(), first.time_keeper(), "module {}", node.config().node);
            assert!(node.faults().is_empty(), "module {}: {:?}", node.config().node, node.faults());
        }
    }

    fn sent(&self, function: Function) -> impl Iterator<Item = &(Micros, Frame)> {
        self.log.iter().filter(move |(_, frame)| frame.function() == Some(function))
    }
}

// The ordinary course

#[test]
fn eight_modules_agree_from_power_up() {
    for bus in [BusKind::Fd, BusKind::Classic] {
        let mut net = Net::new(8, bus, policy(1, &[]));
        net.run(5 * SECOND);
        net.assert_in_step();
        assert_eq!(net.time_keeper(), Some(0));
        for (node, outputs) in net.live().zip(&net.outputs) {
            let stats = node.stats();
            assert_eq!((stats.deadline_misses, stats.malformed, stats.stale, stats.foreign), (0, 0, 0, 0));
            assert_eq!(stats.acted, stats.cycles);
            assert!(stats.cycles >= 97, "{stats:?}");
            assert_eq!((node.heard(), node.alive()), (0xff, 0xff));
            assert!(node.attention().iter().map(|w| u32::from(*w)).sum::<u32>() > 32_000);
            assert!(outputs.motors_enabled);
            assert_eq!(node.mode(), Mode::Active);
        }
        assert_eq!(net.live().map(|n| n.stats().takeovers).sum::<u32>(), 1);
        // Every module reports every ten cycles.
        for module in 0..8 {
            for function in [Function::Telemetry, Function::Heartbeat] {
                let count = net.sent(function).filter(|(_, f)| f.module() == module).count();
                assert!((9..=12).contains(&count), "{function:?} of {module}: {count}");
            }
        }
    }
}

#[test]
fn the_torques_are_those_of_the_training_loop_to_the_last_bit() {
    let mut died = false;
    for (bus, policy) in [
        (BusKind::Fd, policy(7, &[])),
        (BusKind::Classic, policy(7, &[])),
        (BusKind::Fd, without_attention()),
        (BusKind::Fd, with_memory()),
        (BusKind::Fd, of_task(Task::ShapeFormation)),
        (BusKind::Classic, of_task(Task::TubeCrossing)),
    ] {
        let mut net = Net::new(5, bus, policy);
        // The paper's observation fault.
        net.safety.blind_relaxes = false;
        net.plug(2);
        let mut chain = Chain::new(policy.geometry());
        let mut torques = [[0.0f32; 2]; 5];
        let (mut memories, mut health) = ([Memory::EMPTY; 5], [MotorHealth::default(); 5]);
        let relax = relax_factor(50_000, policy.relax_seconds());
        for cycle in 0..30 {
            let started = net.at(3).stats().cycles;
            for (i, sensors) in net.sensors.iter_mut().enumerate() {
                let x = (cycle * 5 + i) as f32;
                sensors.joint_angles = core::array::from_fn(|j| libm::sinf(x + j as f32));
                sensors.joint_speeds = core::array::from_fn(|j| libm::cosf(x * j as f32));
                sensors.angular_rate = [libm::sinf(3.0 * x), 0.1, -0.2];
                sensors.torque = torques[i].map(|t| t / policy.limits().torque);
                // The yaw motor of module 3 dies on the way.
                net.dead[3][0] = cycle > 10;
                if i == 3 && cycle > 10 {
                    sensors.torque[0] = 0.0;
                }
            }
            // Module 2's accelerometer dies on the way.
            net.sensors[2].up = if cycle > 15 { [0.0; 3] } else { [0.0, 0.0, 1.0] };
            net.goal = Some([cycle as f32 * 0.3, 4.0, -0.5]);
            while net.at(3).stats().cycles == started {
                net.run(PERIOD / 10);
            }
            net.run(PERIOD / 2);

            for (i, sensors) in net.sensors.iter().enumerate() {
                let commanded = torques[i].map(|torque| torque / policy.limits().torque);
                health[i].update(commanded, sensors, policy.limits().joint_speed);
                match sensors.plausible() {
                    true => chain.hear(i, &sensors.joint_angles.map(quantise_angle)),
                    false => chain.miss(i, relax),
                }
            }
            let point = |p: u8| Goal::new(0, p, net.goal.map(|g| shifted(g, p))).position().map(Vector3::from);
            let encoded: [Encoded; 5] = core::array::from_fn(|i| {
                let points = policy.task().observed(i as u8, 5).map(|number| number.and_then(point));
                let told = Told { points, seeker: policy.task().seeker() };
                let commanded = torques[i].map(|torque| torque / policy.limits().torque);
                let beside = |j: Option<usize>| match j.filter(|j| *j < 5) {
                    Some(j) if !net.sensors[j].plausible() => 0.0,
                    Some(j) => share(health[j].work()),
                    None => 1.0,
                };
                let beside = [beside(i.checked_sub(1)), beside(Some(i + 1))];
                let motors = Motors { commanded, work: health[i].work(), beside };
                let head = chain.head_seen_from(i);
                policy.encode(&mut memories[i], &observe(&net.sensors[i], &motors, place(i, 5), &head, &told))
            });
            let mut latents = [Default::default(); ROOM];
            let mut plausible = 0;
            for i in 0..5 {
                latents[i] = encoded[i].latent;
                plausible |= u64::from(net.sensors[i].plausible()) << i;
            }
            for i in 0..5 {
                let heard = if policy.attention() { plausible } else { 0 };
                let action = policy.act(&encoded[i], &latents, heard, None, i);
                for axis in 0..2 {
                    torques[i][axis] = policy.limits().command(torques[i][axis], action[axis], 0.05);
                }
                assert_eq!(net.outputs[i].torque, torques[i], "cycle {cycle} module {i}");
            }
        }
        assert!(torques.iter().flatten().any(|t| t.abs() > 1.0), "the test policy does nothing");
        died |= !health[3].work()[0];
    }
    assert!(died, "nobody found the dead motor");
}

#[test]
fn sixty_four_modules_and_one_alone() {
    let mut net = Net::new(64, BusKind::Fd, policy(1, &[]));
    net.run(SECOND);
    net.assert_in_step();
    assert!(net.live().all(|n| n.heard() == u64::MAX));

    let mut net = Net::new(1, BusKind::Fd, policy(1, &[]));
    net.station = false;
    net.safety.dead_man_ms = 0;
    net.plug(0);
    net.run(10 * SECOND);
    net.assert_in_step();
    assert!(net.outputs[0].motors_enabled, "a robot of one module is not isolated");
}

#[test]
fn telemetry_names_whom_it_attends_to() {
    let mut net = Net::eight();
    net.run(SECOND);
    let telemetry = net.at(3).telemetry();
    assert_eq!(telemetry.heard, 8);
    let attention = net.at(3).attention();
    assert!(telemetry.attends_to != 3 && telemetry.attends_to < 8);
    assert!((0..8).filter(|j| *j != 3).all(|j| attention[j] <= attention[usize::from(telemetry.attends_to)]));
    assert_eq!(telemetry.temperature, 25);
}

// Time-keeping

#[test]
fn the_next_in_line_takes_over_without_a_gap_in_the_numbers() {
    let mut net = Net::eight();
    net.run(SECOND);
    let (cycle, before) = (net.at(1).cycle(), net.sent(Function::Sync).last().unwrap().0);
    net.unplug(0);
    net.run(SECOND);
    net.assert_in_step();
    assert_eq!(net.time_keeper(), Some(1));
    let (after, frame) = *net.sent(Function::Sync).find(|(t, _)| *t > before).unwrap();
    assert_eq!(after - before, 2 * PERIOD + PERIOD / 10);
    let Ok(Message::Sync(sync)) = Message::parse(&frame) else { panic!() };
    assert_eq!((sync.cycle, frame.module()), (cycle + 2, 1));
    assert_eq!(net.at(5).heard(), 0xfe);
}

#[test]
fn the_two_first_die_together() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.unplug(0);
    net.unplug(1);
    net.run(SECOND);
    net.assert_in_step();
    assert_eq!(net.time_keeper(), Some(2));
    assert_eq!(net.live().map(|n| n.stats().takeovers).sum::<u32>(), 1);
    assert_eq!(net.at(7).alive(), 0xfc);
}

#[test]
fn each_module_can_die_alone() {
    for dead in 0..8 {
        let mut net = Net::eight();
        net.run(SECOND);
        net.unplug(dead);
        net.run(SECOND);
        net.assert_in_step();
        for node in net.live() {
            assert_eq!(node.heard(), 0xff & !(1 << dead));
            // Waited for while it could have come back, never after.
            assert!((1..=4).contains(&node.stats().deadline_misses), "{:?}", node.stats());
        }
    }
}

#[test]
fn the_head_takes_the_time_back_after_plugging_in() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.unplug(0);
    net.run(SECOND);
    net.plug(0);
    let misses = net.at(4).stats().deadline_misses;
    net.run(SECOND);
    net.assert_in_step();
    assert_eq!((net.time_keeper(), net.at(4).heard()), (Some(0), 0xff));
    assert_eq!(net.at(4).stats().deadline_misses, misses, "coming back disturbs nobody");
    // A module in the middle comes and goes without touching the time.
    net.unplug(3);
    net.run(SECOND);
    net.plug(3);
    net.run(SECOND);
    net.assert_in_step();
    assert_eq!((net.time_keeper(), net.at(4).heard(), net.at(3).heard()), (Some(0), 0xff, 0xff));
}

#[test]
fn the_head_missing_at_power_up() {
    let mut net = Net::eight();
    net.unplug(0);
    net.unplug(1);
    net.run(SECOND);
    net.assert_in_step();
    assert_eq!((net.time_keeper(), net.at(2).heard()), (Some(2), 0xfc));
}

#[test]
fn two_that_start_at_once_become_one() {
    // They cannot hear each other at first.
    let mut net = Net::new(4, BusKind::Fd, policy(1, &[]));
    net.part = vec![0, 1, 2, 3];
    net.run(400_000);
    assert!(net.live().all(|n| n.time_keeper() == Some(n.config().node)));
    net.part = vec![0; 4];
    net.run(3 * PERIOD);
    net.assert_in_step();
    assert_eq!((net.time_keeper(), net.at(3).heard()), (Some(0), 0xf));
}

#[test]
fn a_cut_chain_goes_on_in_two_parts_and_becomes_one_again() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.part = vec![0, 0, 0, 1, 1, 1, 1, 1];
    net.run(SECOND);
    assert_eq!((net.at(0).time_keeper(), net.at(2).time_keeper()), (Some(0), Some(0)));
    assert_eq!((net.at(3).time_keeper(), net.at(7).time_keeper()), (Some(3), Some(3)));
    assert_eq!((net.at(1).heard(), net.at(6).heard()), (0x07, 0xf8));
    assert!(net.outputs.iter().all(|o| o.motors_enabled));
    // The rear part's clock is off by some time and some cycles.
    net.nodes[5] = None;
    net.run(3 * SECOND + 17_000);
    net.part = vec![0; 8];
    net.run(5 * PERIOD);
    net.assert_in_step();
    assert_eq!((net.time_keeper(), net.at(7).heard(), net.at(0).heard()), (Some(0), 0xdf, 0xdf));
}

#[test]
fn a_lost_sync_costs_nothing() {
    let mut net = Net::eight();
    net.run(SECOND);
    let acted: Vec<_> = net.live().map(|n| n.stats().acted).collect();
    net.loss = Box::new(|now, frame, to| {
        frame.function() == Some(Function::Sync)
            && to == 4
            && (SECOND..SECOND + 5 * PERIOD).contains(&now)
            && (now / PERIOD).is_multiple_of(2)
    });
    net.run(SECOND);
    net.assert_in_step();
    let node = net.at(4).stats();
    assert!((2..=3).contains(&node.without_sync), "{node:?}");
    assert_eq!(node.takeovers, 0);
    assert!(net.live().zip(acted).all(|(n, before)| n.stats().acted - before == 20));
    assert_eq!(net.live().map(|n| n.stats().deadline_misses).sum::<u32>(), 0);
}

#[test]
fn without_any_sync_the_motors_relax_and_a_sync_brings_them_back() {
    // A module that hears nothing but the station, and whose turn as time-keeper is far off.
    let policy = policy(1, &[]);
    let mut config = Config::new(7, 8, BusKind::Fd, &policy);
    config.timing.takeover_periods = 50;
    let mut module = Controller::new(config, policy, Boot::default(), 0).unwrap();
    module.arm(false).unwrap();
    let mut now = 0;
    let sync = |cycle| Message::Sync(Sync::new(cycle, 8, 8)).emit(0, true);
    let goal = Message::Goal(Goal::new(0, 0, None)).emit(STATION, true);
    module.poll(now, &level(), Some(&sync(1)), BusStatus::ErrorActive);
    let mut relaxed_at = None;
    while now < 10 * PERIOD {
        now += 10_000;
        let outputs = module.poll(now, &level(), Some(&goal), BusStatus::ErrorActive);
        if now > PERIOD && relaxed_at.is_none() && !outputs.motors_enabled {
            relaxed_at = Some(now);
        }
    }
    assert_eq!(relaxed_at, Some(4 * PERIOD + 10_000));
    assert_eq!((module.faults().number(), module.mode()), (34, Mode::Relaxed));
    let outputs = module.poll(now, &level(), Some(&sync(9)), BusStatus::ErrorActive);
    assert!(module.faults().is_empty() && !outputs.motors_enabled);
    now = outputs.deadline;
    for _ in 0..4 {
        let outputs = module.poll(now, &level(), None, BusStatus::ErrorActive);
        now = outputs.deadline;
    }
    assert!(module.poll(now, &level(), None, BusStatus::ErrorActive).motors_enabled);
}

#[test]
fn a_babbling_time_keeper_does_not_drive_the_cycle() {
    let mut net = Net::eight();
    net.run(SECOND);
    let cycles = net.at(5).stats().cycles;
    for _ in 0..1400 {
        let cycle = net.at(5).cycle();
        net.inject(Message::Sync(Sync::new(cycle.wrapping_add(1), 8, 8)).emit(0, true));
        net.inject(Message::Sync(Sync::new(cycle.wrapping_sub(1), 8, 8)).emit(0, true));
        net.run(500);
    }
    // Fourteen periods went by; four times the beat is the most that can be forced.
    assert!(net.at(5).stats().cycles - cycles <= 57);
    assert!(net.at(5).stats().stale > 300);
    assert!(net.at(0).faults().contains(Fault::DuplicateNode));
}

// Late, missing, wrong

#[test]
fn a_late_latent_is_masked_and_the_deadline_kept() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.loss = Box::new(|_, frame, to| frame.id == Function::Latent.id(6) && to == 2);
    net.run(2 * PERIOD);
    assert_eq!((net.at(2).heard(), net.at(3).heard()), (0xbf, 0xff));
    let stats = *net.at(2).stats();
    assert_eq!(stats.deadline_misses, 2);
    assert_eq!(stats.latent_age_us, net.at(2).config().timing.collect_deadline_us);
    assert_eq!(net.at(3).stats().latent_age_us, 0);
    net.loss = Box::new(|_, _, _| false);
    net.run(PERIOD);
    assert_eq!(net.at(2).heard(), 0xff);
}

#[test]
fn a_lost_fragment_masks_its_latent_only() {
    let mut net = Net::new(4, BusKind::Classic, policy(1, &[]));
    net.run(SECOND);
    let mut count = 0;
    net.loss = Box::new(move |_, frame, to| {
        let hit = frame.id == Function::LatentFragment.id(1) && to == 2;
        count += u32::from(hit);
        hit && count == 5
    });
    net.run(PERIOD);
    assert_eq!((net.at(2).heard(), net.at(3).heard()), (0b1101, 0b1111));
    net.run(PERIOD);
    assert_eq!(net.at(2).heard(), 0b1111);
    assert_eq!(net.live().map(|n| n.stats().malformed).sum::<u32>(), 0);
}

#[test]
fn implausible_sensors_mask_a_module_everywhere_and_where_the_simulation_wants_it_it_still_acts() {
    let mut net = Net::eight();
    net.safety.blind_relaxes = false;
    net.plug(4);
    net.sensors[4] = Sensors::ZERO;
    net.run(SECOND);
    assert_eq!((net.at(1).heard(), net.at(4).heard()), (0xef, 0xff));
    assert_eq!(net.at(4).faults().number(), 39);
    assert!(net.outputs[4].motors_enabled);
    assert_eq!(net.live().map(|n| n.stats().deadline_misses).sum::<u32>(), 0, "nobody waits for it");
    net.sensors[4] = level();
    net.run(2 * PERIOD);
    net.assert_in_step();
    assert_eq!(net.at(1).heard(), 0xff);
}

#[test]
fn a_neighbour_with_another_policy_is_ignored_with_a_fault() {
    let mut net = Net::eight();
    net.policy = policy(2, &[]);
    assert_ne!(net.policy.tag(), net.at(0).policy.tag());
    net.plug(3);
    net.run(SECOND);
    assert_eq!((net.at(1).heard(), net.at(3).heard()), (0xf7, 0x08));
    assert!(net.live().all(|n| n.faults().number() == 36));
    assert!(net.outputs.iter().all(|o| o.motors_enabled));
    net.unplug(3);
    net.run(SECOND);
    net.assert_in_step();
}

#[test]
fn malformed_and_foreign_frames_are_counted_and_change_nothing() {
    let mut net = Net::eight();
    net.run(SECOND);
    let junk = [
        Frame::new(0x183, true, &[1, 2, 3]).unwrap(),
        Frame::new(0x305, true, &[0; 8]).unwrap(),
        Frame::new(0x1c0, true, &[0; 8]).unwrap(),
        Frame::new(0x7ff, false, &[]).unwrap(),
        Frame { id: 0xffff, fd: true, brs: true, len: 255, data: [0xaa; 64] },
        Frame::new(0x002, true, &[2, 0]).unwrap(), // A release that does not come from the station.
    ];
    for frame in junk {
        net.inject(frame);
    }
    let foreign = Message::State(State::new(0, Health(1), &[0.0; 4])).emit(20, true);
    net.inject(foreign);
    net.run(SECOND);
    net.assert_in_step();
    for node in net.live() {
        assert_eq!((node.stats().malformed, node.stats().foreign), (junk.len() as u32, 1));
        assert_eq!((node.heard(), node.stats().deadline_misses), (0xff, 0));
    }
}

#[test]
fn a_flood_of_frames_does_not_hold_up_the_cycle() {
    let mut net = Net::eight();
    net.run(SECOND);
    // Module 6 babbles telemetry and old latents all the time, and its real latents never get out.
    net.loss = Box::new(|_, frame, _| frame.id == Function::Latent.id(6));
    let until = net.now + SECOND;
    let acted = net.at(2).stats().acted;
    while net.now < until {
        let old = net.at(2).cycle().wrapping_sub(3) as u8;
        net.inject(Message::State(State::new(old, Health(1), &[0.0; 4])).emit(6, true));
        net.inject(Message::Telemetry(Telemetry::default()).emit(6, true));
        net.run(100);
    }
    assert!((19..=21).contains(&(net.at(2).stats().acted - acted)));
    // Alive, but not waited for.
    assert_eq!((net.at(2).alive(), net.at(2).heard()), (0xff, 0xbf));
}

#[test]
fn hearing_nobody_a_module_acts_alone_then_relaxes_then_comes_back() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.part[5] = 1;
    net.run(10 * PERIOD);
    assert_eq!((net.at(5).mode(), net.at(5).heard()), (Mode::Alone, 0x20));
    assert!(net.outputs[5].motors_enabled);
    net.run(15 * PERIOD);
    assert_eq!((net.at(5).mode(), net.at(5).faults().number()), (Mode::Relaxed, 41));
    assert!(!net.outputs[5].motors_enabled);
    net.part[5] = 0;
    net.run(3 * PERIOD);
    net.assert_in_step();
    assert!(net.outputs[5].motors_enabled);
    assert_eq!(net.at(0).heard(), 0xff);
}

// Goal

#[test]
fn a_goal_holds_for_four_cycles() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.station = false;
    let start = net.at(2).cycle();
    for _ in 0..8 {
        net.run(PERIOD);
        let age = net.at(2).cycle() - start;
        assert_eq!(net.at(2).points[0].position.is_some(), age <= 4, "after {age} cycles");
    }
    // Nobody waits for a station that is silent: all act at once again.
    assert_eq!(net.at(2).stats().latent_age_us, 0);
    net.station = true;
    net.run(2 * PERIOD);
    assert_eq!(net.at(2).points[0].position, Some([3.0, 1.0, 0.0]));
    // The station knows that there is none.
    net.goal = None;
    net.run(2 * PERIOD);
    assert_eq!(net.at(2).points[0].position, None);
}

#[test]
fn a_goal_for_the_head_alone_moves_the_others_only_through_attention() {
    let torques = |policy: Policy<'static>, goal| {
        let mut net = Net::new(3, BusKind::Fd, policy);
        net.goal = Some(goal);
        // What a module does comes back to it as torque, and is nobody's word.
        net.dead.fill([true; AXES]);
        net.run(300_000);
        (net.at(0).encoded, net.at(1).encoded)
    };
    let (near, far) = ([1.0, 0.0, 0.0], [-20.0, 9.0, 0.0]);
    let (a, b) = (torques(goal_known_to_head(), near), torques(goal_known_to_head(), far));
    assert!(a.0 != b.0 && a.1 == b.1);
    let (a, b) = (torques(policy(1, &[]), near), torques(policy(1, &[]), far));
    assert!(a.0 != b.0 && a.1 != b.1);
}

#[test]
fn a_module_keeps_the_points_of_its_task_and_waits_for_them() {
    let mut net = Net::new(4, BusKind::Fd, of_task(Task::ShapeFormation));
    net.run(SECOND);
    let at = |p| Some(shifted([3.0, 1.0, 0.0], p));
    assert_eq!(net.at(0).points.map(|p| p.position), [at(0), None, at(1)]);
    assert_eq!(net.at(2).points.map(|p| p.position), [at(2), at(1), at(3)]);
    assert_eq!(net.at(3).points.map(|p| p.position), [at(3), at(2), None]);
    // The station tells it no more about point 2: it acts at the state deadline on what it has, and forgets the point in the end.
    net.loss = Box::new(|_, frame, _| matches!(Message::parse(frame), Ok(Message::Goal(goal)) if goal.point() == 2));
    net.run(SECOND);
    assert_eq!(net.at(2).points.map(|p| p.position), [None, at(1), at(3)]);
    assert_eq!(net.at(0).points.map(|p| p.position), [at(0), None, at(1)]);
    assert!(net.at(2).stats().acted > 30 && net.at(0).stats().acted > 30);
}

// Failing safe

#[test]
fn an_emergency_stop_latches_in_the_same_poll_until_the_station_releases_it() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.station_says(StopCommand::Stop);
    assert!(net.outputs.iter().all(|o| !o.motors_enabled && o.torque == [0.0; 2]));
    net.run(2 * SECOND);
    assert!(net.live().all(|n| n.faults().number() == 32 && n.mode() == Mode::Stopped));
    // The cycle goes on: the robot can be watched.
    assert_eq!(net.at(3).heard(), 0xff);
    // A module cannot release; a module that comes in does not move either.
    net.inject(Frame::new(0x001, true, &[2, 0, 0]).unwrap());
    net.unplug(3);
    net.run(SECOND);
    net.plug(3);
    net.run(SECOND);
    assert!(net.outputs.iter().all(|o| !o.motors_enabled));
    net.station_says(StopCommand::Release);
    assert!(net.outputs.iter().all(|o| !o.motors_enabled), "motors start with the next action, from zero");
    net.run(PERIOD);
    net.assert_in_step();
    let step = net.policy.limits().torque_slew * 0.05;
    assert!(net.outputs.iter().all(|o| o.motors_enabled && o.torque.iter().all(|t| t.abs() <= step)));
}

#[test]
fn any_module_can_stop_all() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.nodes[6].as_mut().unwrap().emergency_stop(0);
    net.poll(6, None);
    net.settle();
    assert!(net.outputs.iter().all(|o| !o.motors_enabled));
    // Modules that this robot does not have may stop it, too.
    net.station_says(StopCommand::Release);
    net.run(PERIOD);
    net.inject(Message::EmergencyStop(EmergencyStop::new(StopCommand::Stop, 0, StopCount::UNKNOWN)).emit(40, true));
    assert!(net.outputs.iter().all(|o| !o.motors_enabled));
}

#[test]
fn a_hung_processor_latches_the_watchdog() {
    let mut net = Net::eight();
    net.run(SECOND);
    // Module 2 is not polled for three periods.
    let frozen = net.nodes[2].take();
    net.run(3 * PERIOD);
    net.nodes[2] = frozen;
    net.run(SECOND);
    assert_eq!((net.at(2).faults().number(), net.outputs[2].motors_enabled), (33, false));
    assert_eq!(net.at(0).heard(), 0xff, "it still tells what it senses");
    net.station_says(StopCommand::Release);
    net.run(2 * PERIOD);
    net.assert_in_step();
    assert!(net.outputs[2].motors_enabled);
}

/// Makes the controller in slot `slot` one that believes to be `node`.
fn twin(net: &mut Net, slot: usize, node: u8) {
    let config = Config::new(node, 8, BusKind::Fd, &net.policy);
    let mut controller = Controller::new(config, net.policy, Boot::default(), net.now).unwrap();
    controller.arm(false).unwrap();
    net.nodes[slot] = Some(controller);
    net.outputs[slot].deadline = net.now;
}

#[test]
fn a_newcomer_with_a_number_that_is_taken_falls_silent_and_disturbs_nobody() {
    for wait in [0, 13_000, 49_999] {
        let mut net = Net::eight();
        net.unplug(5);
        net.run(SECOND + wait);
        let sent = net.log.len();
        twin(&mut net, 5, 3);
        net.run(SECOND);
        assert_eq!((net.at(5).faults().number(), net.outputs[5].motors_enabled), (35, false));
        net.unplug(5);
        net.assert_in_step();
        assert_eq!(net.at(0).heard(), 0xdf);
        // Nobody sent twice under one identifier within a cycle.
        let states: Vec<_> = net.log[sent..].iter().filter(|(_, f)| f.id == Function::State.id(3)).collect();
        assert!(states.windows(2).all(|s| s[1].0 - s[0].0 > PERIOD / 2));
    }
}

#[test]
fn two_modules_with_one_number_from_power_up_relax_and_fall_silent() {
    let mut net = Net::eight();
    twin(&mut net, 5, 3);
    net.run(2 * SECOND);
    for i in [3, 5] {
        assert_eq!((net.at(i).faults().number(), net.outputs[i].motors_enabled), (35, false));
    }
    // Three cycles, until it is certain; then only that it is silent.
    assert!(net.log.iter().filter(|(_, f)| f.module() == 3 && f.function() != Some(Function::Heartbeat)).count() < 20);
    assert_eq!((net.at(0).heard(), net.time_keeper()), (0xd7, Some(0)));
    // A release does not help; numbering one of them anew and restarting does.
    net.station_says(StopCommand::Release);
    net.run(SECOND);
    assert!(net.at(3).faults().contains(Fault::DuplicateNode));
    net.plug(3);
    net.plug(5);
    net.run(SECOND);
    net.assert_in_step();
}

#[test]
fn bus_off_recovers_by_itself_or_latches() {
    for policy in [BusOffPolicy::Recover, BusOffPolicy::Latch] {
        let mut net = Net::eight();
        net.nodes[4].as_mut().unwrap().config.bus_off = policy;
        let limits = net.policy.limits();
        let mut failsafe = Failsafe::new(limits, Safety::POLICY, policy, 50_000, Boot::default());
        failsafe.arm(false).unwrap();
        net.nodes[4].as_mut().unwrap().failsafe = failsafe;
        net.run(SECOND);
        net.status[4] = BusStatus::BusOff;
        net.part[4] = 1;
        net.run(4 * PERIOD);
        assert_eq!(net.at(4).faults().number(), 40);
        assert_eq!(net.outputs[4].motors_enabled, policy == BusOffPolicy::Recover);
        net.status[4] = BusStatus::ErrorActive;
        net.part[4] = 0;
        net.run(SECOND);
        assert_eq!(net.at(4).may_recover_bus(), policy == BusOffPolicy::Recover);
        match policy {
            BusOffPolicy::Recover => net.assert_in_step(),
            BusOffPolicy::Latch => assert_eq!((net.at(4).faults().number(), net.at(0).heard()), (40, 0xef)),
        }
    }
}

#[test]
fn a_hot_motor_relaxes_in_the_same_poll() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.sensors[1].temperature = 81.0;
    net.poll(1, None);
    assert_eq!((net.at(1).faults().number(), net.outputs[1].motors_enabled), (37, false));
    assert_eq!(net.at(1).telemetry().limited_by, LimitedBy::Relaxed as u8);
    net.run(SECOND);
    assert_eq!(net.at(0).heard(), 0xff);
    net.sensors[1].temperature = 70.0;
    net.run(PERIOD);
    net.assert_in_step();
}

#[test]
fn faults_are_told_at_once() {
    let mut net = Net::eight();
    net.run(SECOND + 2 * PERIOD);
    net.sensors[6].temperature = 90.0;
    net.run(PERIOD);
    let (_, frame) = net.sent(Function::Heartbeat).filter(|(_, f)| f.module() == 6).last().unwrap();
    let Ok(Message::Heartbeat(heartbeat)) = Message::parse(frame) else { panic!() };
    assert_eq!((heartbeat.fault, heartbeat.mode), (37, Mode::Relaxed as u8));
    assert_eq!(heartbeat.health.motors_work(), [true, true]);
}

// Configuration

#[test]
fn deadlines_leave_room_for_the_bus() {
    let policy = policy(1, &[]);
    for (bus, modules) in [(BusKind::Fd, 8), (BusKind::Fd, 64), (BusKind::Classic, 8), (BusKind::Classic, 16)] {
        let timing = Timing::for_policy(&policy, bus, modules);
        assert!(timing.collect_deadline_us > Timing::bus_time_us(bus, modules, 1) * 3 / 2, "{bus:?} {modules}");
        assert!(timing.collect_deadline_us <= 40_000);
        assert!(Config::new(0, modules, bus, &policy).check().is_ok());
    }
}

#[test]
fn wrong_configurations_are_refused_in_a_sentence() {
    let policy = policy(1, &[]);
    let refuse = |change: fn(&mut Config)| {
        let mut config = Config::new(0, 8, BusKind::Fd, &policy);
        change(&mut config);
        Controller::new(config, policy, Boot::default(), 0).map(|_| ()).unwrap_err().to_string()
    };
    assert_eq!(refuse(|c| c.node = 8), "module 8 cannot be one of 8: they are numbered 0 to 7");
    assert_eq!(refuse(|c| c.modules = 65), "65 modules cannot be: a robot has 1 to 64");
    assert_eq!(refuse(|c| c.modules = 0), "0 modules cannot be: a robot has 1 to 64");
    assert!(refuse(|c| c.timing.period_us = 0).contains("at least 1000 us"));
    assert!(refuse(|c| c.timing.collect_deadline_us = 50_000).contains("in order"));
    assert_eq!(refuse(|c| c.timing.dead_after = 0), "dead_after is 0, but must be at least 1");
}

#[test]
fn a_controller_is_small() {
    // Most of it: 64 latents of 48 bytes and as many half-received ones.
    std::println!("size_of::<Controller>() = {}", size_of::<Controller>());
    assert!(size_of::<Controller>() <= 11_000, "{}", size_of::<Controller>());
}

// Anything at all

fn any_frame() -> impl Strategy<Value = Frame> {
    let function = prop_oneof![9 => 0u16..8, 1 => 8u16..16];
    let module = prop_oneof![8 => 0u16..5, 1 => 5u16..128, 2 => Just(0x7fu16)];
    let good_len = prop_oneof![Just(true), Just(true), Just(true), Just(false)];
    (function, module, good_len, prop::collection::vec(any::<u8>(), 64), 0u8..4, any::<u8>()).prop_map(
        |(function, module, good_len, bytes, near, len)| {
            let mut data: [u8; 64] = bytes.try_into().unwrap();
            if good_len {
                // Mostly well-formed: small numbers where cycles, commands and flags are, no padding.
                data[0] = if function == 5 { data[0] & 0x7f } else { near };
                data[1] &= if function == 1 { 0 } else { 15 };
                if function == 1 {
                    data[3] = 5;
                }
                if function == 0 {
                    data[2] &= 15;
                }
                data[52..].fill(0);
            }
            let len = match function {
                _ if !good_len => len,
                0 => 3,
                1 => 4,
                4 => 64,
                _ => 8,
            };
            Frame { id: function << 7 | module, fd: true, brs: true, len, data }
        },
    )
}

fn any_sensors() -> impl Strategy<Value = Sensors> {
    let strange = prop_oneof![6 => -3.0f32..3.0, 1 => Just(f32::NAN), 1 => Just(f32::INFINITY), 1 => Just(-1e30f32)];
    (prop::collection::vec(strange, 14), 0.0f32..90.0).prop_map(|(v, temperature)| Sensors {
        joint_angles: core::array::from_fn(|i| v[i]),
        joint_speeds: core::array::from_fn(|i| v[4 + i]),
        up: core::array::from_fn(|i| v[8 + i]),
        angular_rate: core::array::from_fn(|i| v[11 + i]),
        torque: [v[0], v[13]],
        temperature,
    })
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever is received whenever: no panic, torque within its limits, slewed, and a deadline ahead.
    #[test]
    fn anything_is_survived(
        start in prop_oneof![Just(0u64), Just(u64::MAX - 2_000_000), any::<u64>()],
        classic in any::<bool>(),
        steps in prop::collection::vec(
            (
                prop_oneof![20 => 0u64..3_000, 5 => 0u64..60_000, 1 => any::<u64>()],
                prop::option::of(any_frame()),
                prop::option::weighted(0.2, any_sensors()),
                0u8..40,
            ),
            1..400,
        ),
    ) {
        let policy = policy(3, &[]);
        let limits = policy.limits();
        let bus = if classic { BusKind::Classic } else { BusKind::Fd };
        let mut module = Controller::new(Config::new(2, 5, bus, &policy), policy, Boot::default(), start).unwrap();
        module.arm(false).unwrap();
        let (mut now, mut latest) = (start, start);
        let mut sensors = level();
        let mut last = [0.0f32; 2];
        let (mut last_act, mut acted) = (start, 0);
        for (step, frame, new_sensors, status) in steps {
            // Sometimes a wild jump, also backwards.
            now = if step > 60_000 { step } else { now.saturating_add(step) };
            latest = latest.max(now);
            sensors = new_sensors.unwrap_or(sensors);
            let status = if status == 0 { BusStatus::BusOff } else { BusStatus::ErrorActive };
            let outputs = module.poll(now, &sensors, frame.as_ref(), status);
            prop_assert!(outputs.deadline > latest || latest == u64::MAX);
            prop_assert!(outputs.deadline <= latest.saturating_add(PERIOD));
            prop_assert!(outputs.motors_enabled || outputs.torque == [0.0; 2]);
            for (torque, last) in outputs.torque.iter().zip(last) {
                prop_assert!(torque.abs() <= limits.torque);
                // Away from zero never faster than the slew limit; a relaxed motor drops to zero at once.
                if torque.abs() > last.abs() {
                    let time = if last_act == start { PERIOD } else { (latest - last_act).min(PERIOD) };
                    let step = (torque - last).abs();
                    prop_assert!(step <= limits.torque_slew * time as f32 / 1e6 + 1e-3, "{step} in {time} us");
                }
            }
            if module.stats().acted != acted {
                acted = module.stats().acted;
                last_act = latest;
            }
            last = outputs.torque;
            let frames: Vec<_> = core::iter::from_fn(|| module.next_frame()).take(20).collect();
            prop_assert!(frames.len() < 15);
            for frame in frames {
                prop_assert_eq!(frame.module(), 2);
                prop_assert!(Message::parse(&frame).is_ok(), "{:?}", frame);
            }
        }
    }
}

#[derive(Clone, Copy, Debug)]
enum Event {
    Unplug(usize),
    Plug(usize),
    Cut(usize),
    Mend,
    Loss(u32),
    Wait(Micros),
}

fn any_event() -> impl Strategy<Value = Event> {
    prop_oneof![
        (0usize..6).prop_map(Event::Unplug),
        (0usize..6).prop_map(Event::Plug),
        (1usize..6).prop_map(Event::Cut),
        Just(Event::Mend),
        (0u32..60).prop_map(Event::Loss),
        (0u64..400_000).prop_map(Event::Wait),
        (0u64..400_000).prop_map(Event::Wait),
        (0u64..400_000).prop_map(Event::Wait),
    ]
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 48, failure_persistence: None, ..ProptestConfig::default() })]

    /// Whatever happened to cable, frames and modules: once all is well again the robot is one again, within a second and a half.
    #[test]
    fn the_robot_heals(events in prop::collection::vec(any_event(), 1..25), seed in any::<u32>()) {
        let mut net = Net::new(6, BusKind::Fd, policy(1, &[]));
        for event in events {
            match event {
                Event::Unplug(node) => net.unplug(node),
                Event::Plug(node) if net.nodes[node].is_none() => net.plug(node as u8),
                Event::Plug(_) => {}
                Event::Cut(at) => net.part = (0..6).map(|i| u8::from(i >= at)).collect(),
                Event::Mend => net.part = vec![0; 6],
                Event::Loss(percent) => {
                    let mut state = seed;
                    net.loss = Box::new(move |_, _, _| {
                        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
                        (state >> 16) % 100 < percent
                    });
                }
                Event::Wait(time) => net.run(time),
            }
        }
        net.part = vec![0; 6];
        net.loss = Box::new(|_, _, _| false);
        for node in 0..6 {
            if net.nodes[usize::from(node)].is_none() {
                net.plug(node);
            }
        }
        net.run(3 * SECOND / 2);
        net.assert_in_step();
        prop_assert_eq!(net.time_keeper(), Some(0));
        let misses: Vec<_> = net.live().map(|n| n.stats().deadline_misses).collect();
        net.run(SECOND / 2);
        prop_assert!(net.live().all(|n| n.heard() == 0x3f));
        prop_assert!(net.live().zip(misses).all(|(n, before)| n.stats().deadline_misses == before));
        prop_assert!(net.outputs.iter().all(|o| o.motors_enabled));
    }
}

// Motors

/// A motor dies, is found, told in STATE, HEARTBEAT and to the neighbours, and works again.
#[test]
fn a_dead_motor_is_found_and_told() {
    let mut net = Net::eight();
    let follow = |net: &mut Net, dead: bool| {
        for _ in 0..40 {
            net.dead[4][1] = dead;
            for i in 0..8 {
                // Something to do: targets that go round.
                net.sensors[i].joint_angles = [libm::sinf((net.now / PERIOD) as f32 * 0.3 + i as f32); 4];
            }
            net.run(PERIOD);
        }
    };
    let last_state = |net: &Net| {
        let (_, frame) = net.sent(Function::State).filter(|(_, f)| f.module() == 4).last().unwrap();
        let Ok(Message::State(state)) = Message::parse(frame) else { panic!() };
        state.health.motors_work()
    };
    net.run(SECOND);
    for dead in [false, true, false] {
        follow(&mut net, dead);
        assert_eq!(last_state(&net), [true, !dead]);
        assert_eq!(net.at(4).faults().number(), if dead { 50 } else { 0 });
        assert_eq!(net.at(4).mode(), Mode::Active, "it goes on");
        let beside = |i: usize, j| net.at(i).neighbours.motors(Some(j));
        assert_eq!(
            [beside(3, 4), beside(5, 4), beside(4, 3)],
            [if dead { 0.5 } else { 1.0 }, if dead { 0.5 } else { 1.0 }, 1.0]
        );
    }
}
