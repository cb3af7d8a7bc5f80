//! Arming, emergency stop, resets, and frames that are not what they seem: each test is named after what once went wrong.

use super::*;
use crate::failsafe::FaultSet;

impl Net {
    /// A robot of eight that nobody has armed, with a station that does not either.
    fn unarmed() -> Self {
        let mut net = Net::eight();
        net.armed = false;
        (0..8).for_each(|node| net.plug(node));
        net
    }

    /// What the module keeps for its next start.
    fn retained(&self, node: usize) -> Retained {
        self.at(node).retained()
    }

    /// The module resets, and knows what it kept.
    fn reset(&mut self, node: u8, said: ResetCause) {
        let boot = Boot::new(said, self.retained(usize::from(node)).words());
        self.unplug(node.into());
        self.start(node, boot);
    }

    fn driving(&self) -> Vec<usize> {
        (0..self.nodes.len()).filter(|i| self.nodes[*i].is_some() && self.outputs[*i].motors_enabled).collect()
    }

    /// The code of the last answer of a module.
    fn last_code(&self, node: u8) -> Option<ServiceCode> {
        let last = self.log.iter().rev().find(|(_, f)| f.id == Function::ServiceResponse.id(node))?;
        match Message::parse(&last.1) {
            Ok(Message::ServiceResponse(answer)) => ServiceCode::from_number(answer.code),
            _ => None,
        }
    }

    fn last_heartbeat(&self, node: u8) -> Heartbeat {
        let last = self.log.iter().rev().find(|(_, f)| f.id == Function::Heartbeat.id(node)).unwrap();
        let Ok(Message::Heartbeat(heartbeat)) = Message::parse(&last.1) else { panic!() };
        heartbeat
    }
}

/// Loses all frames of a function on their way to these modules.
fn losing(function: Function, to: &'static [usize]) -> Loss {
    Box::new(move |_, frame, node| frame.function() == Some(function) && to.contains(&node))
}

// Arming

#[test]
fn a_robot_that_nobody_armed_does_not_move_though_it_hears_the_station() {
    let mut net = Net::unarmed();
    for _ in 0..100 {
        net.run(PERIOD);
        assert_eq!(net.driving(), []);
    }
    assert!(net.live().all(|n| n.mode() == Mode::Disarmed && n.faults().is_empty() && n.heard() == 0xff));
    net.request(3, Operation::Arm, 0);
    net.run(2 * PERIOD);
    assert_eq!((net.driving(), net.last_code(3)), (vec![3], Some(ServiceCode::Ok)));
    net.request(ALL_MODULES, Operation::Arm, 0);
    net.run(2 * PERIOD);
    assert_eq!(net.driving().len(), 8);
    net.request(3, Operation::Disarm, 0);
    assert!(!net.outputs[3].motors_enabled, "in the same poll");
    net.run(2 * PERIOD);
    assert_eq!(net.driving().len(), 7);
}

/// It used to pull at up to half of its torque from 139 to 999 ms after power-up.
#[test]
fn a_module_that_has_heard_nobody_since_power_up_does_not_move() {
    let mut net = Net::unarmed();
    (0..8).filter(|i| *i != 4).for_each(|i| net.unplug(i));
    for _ in 0..400 {
        net.run(PERIOD / 10);
        assert_eq!(net.driving(), []);
    }
}

#[test]
fn a_module_that_is_plugged_in_joins_an_armed_robot_within_a_second() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.unplug(3);
    net.run(SECOND + 120_000);
    net.start(3, Boot::default());
    net.run(SECOND + 2 * PERIOD);
    assert_eq!(net.driving().len(), 8);
}

#[test]
fn after_a_watchdog_reset_or_a_brown_out_a_module_stays_disarmed_says_why_and_counts() {
    let mut net = Net::eight();
    net.run(SECOND);
    for (count, said) in [(1, ResetCause::Watchdog), (2, ResetCause::PowerOn), (3, ResetCause::Pin)] {
        net.reset(3, said);
        net.run(3 * SECOND);
        // The station goes on to arm the others.
        assert_eq!(net.driving(), [0, 1, 2, 4, 5, 6, 7]);
        assert_eq!((net.at(3).boot().resets_in_a_row(), net.retained(3).resets), (count, count));
        assert_eq!(net.last_code(3), Some(ServiceCode::NotArmable));
        let heartbeat = net.last_heartbeat(3);
        assert_eq!((heartbeat.fault, heartbeat.mode), (Fault::Restarted as u8, Mode::Disarmed as u8));
        assert_eq!(net.at(0).heard(), 0xff, "it takes part");
    }
    assert_eq!(net.at(3).boot().cause, ResetCause::Pin);
    net.request(3, Operation::Arm, 1);
    net.run(2 * PERIOD);
    assert_eq!((net.driving().len(), net.retained(3).resets, net.last_code(3)), (8, 0, Some(ServiceCode::Ok)));
    net.assert_in_step();
}

#[test]
fn a_restart_that_was_asked_for_needs_no_acknowledgement() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.nodes[3].as_mut().unwrap().expect_restart();
    net.reset(3, ResetCause::Software);
    net.run(SECOND + 3 * PERIOD);
    assert_eq!(net.driving().len(), 8);
}

#[test]
fn every_request_is_answered_with_a_code() {
    let mut net = Net::unarmed();
    net.run(SECOND);
    for (operation, value, code) in [
        (Operation::Arm as u8, 2, ServiceCode::OutOfRange),
        (Operation::Store as u8, 0, ServiceCode::UnknownOperation),
        (200, 0, ServiceCode::UnknownOperation),
        (Operation::Clear as u8, 0, ServiceCode::Ok),
        (Operation::Arm as u8, 0, ServiceCode::Ok),
        (Operation::Arm as u8, 0, ServiceCode::Ok),
        (Operation::Clear as u8, 0, ServiceCode::Armed),
        (Operation::Disarm as u8, 0, ServiceCode::Ok),
    ] {
        let request = ServiceRequest { destination: 5, operation, sequence: 9, index: 3, value };
        let sent = net.log.len();
        net.inject(Message::ServiceRequest(request).emit(STATION, true));
        let answers = net.log[sent..].iter().filter(|(_, f)| f.function() == Some(Function::ServiceResponse));
        let answers: Vec<_> = answers.map(|(_, f)| (f.module(), Message::parse(f).unwrap())).collect();
        assert_eq!(answers, [(5, Message::ServiceResponse(request.answer(code, 0)))]);
    }
    let sent = net.log.len();
    net.request(ALL_MODULES, Operation::Disarm, 0);
    net.settle();
    let answered = net.log[sent..].iter().filter(|(_, f)| f.function() == Some(Function::ServiceResponse)).count();
    assert_eq!(answered, 8);
}

#[test]
fn a_jog_moves_one_axis_slewed_and_ends_by_itself_by_a_stop_and_by_a_fault() {
    let mut net = Net::unarmed();
    net.run(SECOND);
    let jog = |net: &mut Net, axis, torque, us| net.nodes[2].as_mut().unwrap().jog(axis, torque, us);
    assert_eq!(jog(&mut net, 2, 1.0, 1000), Err(ServiceCode::NoSuchRegister));
    assert_eq!(jog(&mut net, 0, f32::NAN, 1000), Err(ServiceCode::OutOfRange));
    assert_eq!(jog(&mut net, 0, 1e6, 1000), Err(ServiceCode::OutOfRange));
    let slew = net.policy.limits().torque_slew;
    for end in 0..3 {
        assert_eq!(jog(&mut net, 1, -20.0, 500_000), Ok(()));
        net.poll(2, None);
        let (mut before, mut at) = (0.0f32, net.now);
        for _ in 0..40 {
            net.run(10_000);
            let torque = net.outputs[2].torque;
            assert!((torque[1] - before).abs() <= slew * (net.now - at + JOG_STEP_US) as f32 / 1e6);
            assert_eq!((torque[0], net.outputs[2].motors_enabled, net.at(2).mode()), (0.0, true, Mode::Service));
            (before, at) = (torque[1], net.now);
        }
        assert_eq!(before, -20.0);
        match end {
            0 => net.run(120_000),
            1 => {
                net.station_says(StopCommand::Stop);
                assert!(!net.outputs[2].motors_enabled);
                assert_eq!(jog(&mut net, 1, -20.0, 500_000), Err(ServiceCode::NotArmable));
                net.nodes.iter_mut().flatten().for_each(Controller::release);
                net.run(PERIOD);
            }
            _ => {
                net.sensors[2].temperature = 90.0;
                net.poll(2, None);
            }
        }
        assert_eq!(net.outputs[2].torque, [0.0; 2]);
        assert!(!net.outputs[2].motors_enabled);
    }
    net.sensors[2].temperature = 25.0;
    net.request(2, Operation::Arm, 0);
    assert_eq!(jog(&mut net, 1, -20.0, 500_000), Err(ServiceCode::Armed));
}

// Emergency stop

#[test]
fn receivers_that_lost_the_stop_are_told_by_every_state_and_still_stand_half_a_minute_later() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.loss = losing(Function::EmergencyStop, &[2, 5]);
    net.station_says(StopCommand::Stop);
    net.run(PERIOD);
    for _ in 0..30 {
        assert_eq!(net.driving(), []);
        net.run(SECOND);
    }
    assert!(net.live().all(|n| n.mode() == Mode::Stopped && n.faults().number() == 32));
    // A release reaches them in the same way; it moves nobody.
    net.armed = false;
    net.inject(
        Message::EmergencyStop(EmergencyStop::new(StopCommand::Release, 0, StopCount::UNKNOWN)).emit(STATION, true),
    );
    net.run(2 * PERIOD);
    assert!(net.live().all(|n| n.mode() == Mode::Disarmed));
}

#[test]
fn a_stopped_robot_repeats_it() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.station_says(StopCommand::Stop);
    let sent = net.log.len();
    net.run(3 * SECOND);
    for module in 0..8 {
        let repeated = net.log[sent..].iter().filter(|(_, f)| f.id == Function::EmergencyStop.id(module)).count();
        assert!((4..=6).contains(&repeated), "{repeated} by {module}");
    }
    net.station_says(StopCommand::Release);
    let sent = net.log.len();
    net.run(SECOND);
    assert!(!net.log[sent..].iter().any(|(_, f)| f.function() == Some(Function::EmergencyStop)));
}

#[test]
fn a_stop_in_one_part_of_a_cut_robot_stops_all_of_it_once_the_cable_is_mended() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.part = vec![0, 0, 0, 0, 1, 1, 1, 1];
    net.run(SECOND / 2);
    net.station_says(StopCommand::Stop);
    net.run(SECOND / 2);
    assert_eq!(net.driving(), [4, 5, 6, 7]);
    net.part = vec![0; 8];
    net.run(2 * PERIOD);
    assert_eq!(net.driving(), []);
    net.run(20 * SECOND);
    assert_eq!(net.driving(), []);
    // And a release while it is cut again is the newest word, wherever it was heard.
    net.part = vec![0, 0, 0, 0, 1, 1, 1, 1];
    net.run(SECOND / 2);
    net.station_says(StopCommand::Release);
    net.run(SECOND / 2);
    assert_eq!(net.driving(), [0, 1, 2, 3]);
    net.part = vec![0; 8];
    net.run(SECOND + 3 * PERIOD);
    assert_eq!(net.driving().len(), 8);
    net.assert_in_step();
}

#[test]
fn a_stop_asked_for_while_bus_off_is_told_when_the_bus_is_back() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.status[6] = BusStatus::BusOff;
    net.part[6] = 1;
    net.run(PERIOD);
    net.nodes[6].as_mut().unwrap().emergency_stop(0);
    net.run(PERIOD);
    assert_eq!(net.driving(), [0, 1, 2, 3, 4, 5, 7]);
    net.status[6] = BusStatus::ErrorActive;
    net.part[6] = 0;
    net.poll(6, None);
    net.settle();
    assert_eq!(net.driving(), []);
}

#[test]
fn a_stopped_robot_whose_supply_breaks_in_stays_stopped() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.station_says(StopCommand::Stop);
    net.run(PERIOD);
    (0..8).for_each(|node| net.reset(node, ResetCause::PowerOn));
    for _ in 0..100 {
        net.run(PERIOD);
        assert_eq!(net.driving(), []);
    }
    assert!(net.live().all(|n| n.mode() == Mode::Stopped && n.faults().contains(Fault::Restarted)));
    // One that was off for longer has forgotten it, and is told by the others.
    net.unplug(2);
    net.run(SECOND);
    net.start(2, Boot::default());
    net.run(3 * PERIOD);
    assert_eq!(net.at(2).mode(), Mode::Stopped);
    // Arming is refused until a release, and a release arms nobody who has not been looked after.
    net.request(ALL_MODULES, Operation::Arm, 1);
    assert_eq!(net.last_code(5), Some(ServiceCode::NotArmable));
    net.station_says(StopCommand::Release);
    net.run(SECOND + 3 * PERIOD);
    assert_eq!(net.driving().len(), 8);
}

#[test]
fn frames_from_before_a_stop_or_release_change_nothing() {
    let mut net = Net::eight();
    net.run(SECOND);
    for count in 1..40 {
        let command = if count % 2 == 1 { StopCommand::Stop } else { StopCommand::Release };
        let before: Vec<Frame> = net.log.iter().rev().take(40).map(|(_, f)| *f).collect();
        net.station_says(command);
        let stopped = net.at(3).failsafe.stop();
        assert_eq!((stopped.stopped(), stopped.count().number()), (count % 2 == 1, (count - 1) % 15 + 1));
        for frame in before.into_iter().filter(|f| f.module() < 8 && f.function() == Some(Function::State)) {
            (0..8).filter(|node| *node != usize::from(frame.module())).for_each(|node| net.poll(node, Some(&frame)));
        }
        net.run(2 * PERIOD);
        assert!(net.live().all(|n| n.failsafe.stop() == stopped));
        assert_eq!(net.driving().len(), if count % 2 == 1 { 0 } else { 8 });
    }
}

#[test]
fn a_stop_and_a_release_at_the_same_moment_are_a_stop() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.station_says(StopCommand::Stop);
    net.run(PERIOD);
    // Module 6 cannot hear the release, and stops in the meantime for a reason of its own, having heard of another release.
    net.part[6] = 1;
    net.station_says(StopCommand::Release);
    net.run(PERIOD);
    let six = net.nodes[6].as_mut().unwrap();
    six.release();
    six.emergency_stop(0);
    net.part[6] = 0;
    net.run(2 * PERIOD);
    assert_eq!(net.driving(), []);
}

// Blind, and without a station

#[test]
fn a_module_whose_encoders_are_dead_relaxes_instead_of_pulling_for_ever() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.sensors[4].joint_angles = [f32::NAN; 4];
    net.run(PERIOD);
    assert_eq!((net.outputs[4].torque, net.driving()), ([0.0; 2], vec![0, 1, 2, 3, 5, 6, 7]));
    assert_eq!((net.at(4).faults().number(), net.at(4).mode()), (39, Mode::Relaxed));
    net.run(10 * SECOND);
    assert_eq!(net.driving().len(), 7);
    net.sensors[4] = level();
    net.run(PERIOD);
    let step = net.policy.limits().torque_slew * 0.05;
    assert!(net.outputs[4].motors_enabled && net.outputs[4].torque.iter().all(|t| t.abs() <= step), "from zero");
    net.assert_in_step();
}

/// Ten minutes after the station had vanished every module still pulled.
#[test]
fn a_robot_that_lost_its_station_relaxes_and_disarms_after_the_dead_mans_time() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.station = false;
    net.run(1_900_000);
    assert_eq!(net.driving().len(), 8);
    net.run(200_000);
    assert_eq!(net.driving(), []);
    assert!(net.live().all(|n| n.faults().number() == 47 && n.mode() == Mode::Disarmed));
    net.run(600 * SECOND);
    assert_eq!((net.driving(), net.at(3).heard()), (vec![], 0xff));
    net.armed = false;
    net.station = true;
    net.run(SECOND);
    assert_eq!(net.driving(), [], "its frames alone arm nobody");
    assert!(net.live().all(|n| n.faults().is_empty()));
    net.armed = true;
    net.run(2 * PERIOD);
    assert_eq!(net.driving().len(), 8);
}

#[test]
fn the_dead_mans_time_can_be_switched_off() {
    let mut net = Net::eight();
    net.safety.dead_man_ms = 0;
    (0..8).for_each(|node| net.plug(node));
    net.run(SECOND);
    net.station = false;
    net.run(60 * SECOND);
    assert_eq!(net.driving().len(), 8);
}

// Frames that are not what they seem

#[test]
fn one_stray_frame_with_its_number_silences_no_module() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.inject(Message::Telemetry(Telemetry::default()).emit(0, true));
    net.inject(Message::State(State::new(net.at(0).cycle() as u8, Health(1), &[0.0; 4])).emit(3, true));
    net.run(SECOND);
    net.assert_in_step();
    assert_eq!((net.time_keeper(), net.at(5).heard(), net.driving().len()), (Some(0), 0xff, 8));
}

#[test]
fn forty_replayed_frames_silence_no_module() {
    for pace in [0, 1_000, 12_500] {
        let mut net = Net::eight();
        net.run(SECOND);
        let recorded: Vec<Frame> = (0..8)
            .flat_map(|m| {
                net.log.iter().rev().filter(move |(_, f)| f.module() == m).take(5).map(|(_, f)| *f).collect::<Vec<_>>()
            })
            .collect();
        assert_eq!(recorded.len(), 40);
        net.run(SECOND);
        for frame in recorded {
            net.inject(frame);
            net.run(pace);
        }
        net.run(SECOND);
        net.assert_in_step();
        assert_eq!((net.at(5).heard(), net.driving().len()), (0xff, 8), "one every {pace} us");
    }
}

#[test]
fn a_module_whose_number_is_taken_says_so_rarely_and_is_cleared_by_command() {
    let mut net = Net::eight();
    net.unplug(5);
    net.run(SECOND);
    twin(&mut net, 5, 3);
    net.run(SECOND);
    let sent = net.log.len();
    net.run(20 * SECOND);
    assert_eq!(net.at(5).faults().number(), 35);
    let said = |f: &Frame| matches!(Message::parse(f), Ok(Message::Heartbeat(h)) if f.module() == 3 && h.fault == 35);
    let count = net.log[sent..].iter().filter(|(_, f)| said(f)).count();
    assert!((8..=12).contains(&count), "{count} in 20 s");
    assert!(net.outputs[3].motors_enabled, "the one that was there first goes on");
    // The older one goes, the newcomer may have the number now.
    net.unplug(3);
    net.nodes.swap(3, 5);
    net.outputs.swap(3, 5);
    net.run(SECOND);
    assert!(net.at(3).faults().contains(Fault::DuplicateNode), "not by itself");
    net.request(3, Operation::Disarm, 0);
    net.request(3, Operation::Clear, 0);
    net.run(SECOND + 3 * PERIOD);
    net.assert_in_step();
    assert_eq!(net.driving(), [0, 1, 2, 3, 4, 6, 7]);
}

#[test]
fn modules_that_disagree_on_how_many_they_are_have_a_fault() {
    let mut net = Net::eight();
    net.run(SECOND);
    net.unplug(5);
    let config = Config::new(5, 12, BusKind::Fd, &net.policy);
    net.nodes[5] = Some(Controller::new(config, net.policy, Boot::default(), net.now).unwrap());
    net.outputs[5].deadline = net.now;
    net.run(3 * SECOND);
    assert_eq!((net.at(5).faults().number(), net.driving()), (48, vec![0, 1, 2, 3, 4, 6, 7]));
    assert_eq!(net.last_code(5), Some(ServiceCode::NotArmable));
    // Here the head is the one that differs: everybody else says so.
    let mut net = Net::unarmed();
    let config = Config::new(0, 12, BusKind::Fd, &net.policy);
    net.nodes[0] = Some(Controller::new(config, net.policy, Boot::default(), net.now).unwrap());
    net.run(SECOND);
    assert!((1..8).all(|i| net.at(i).faults().number() == 48));
    net.plug(0);
    net.run(SECOND);
    net.assert_in_step();
}

#[test]
fn a_neighbour_with_another_version_of_the_protocol_is_a_fault() {
    let mut net = Net::eight();
    net.run(SECOND);
    let foreign = Heartbeat { protocol: PROTOCOL_VERSION + 1, ..net.at(3).heartbeat() };
    net.loss = losing(Function::Heartbeat, &[]);
    net.inject(Message::Heartbeat(foreign).emit(3, true));
    net.run(PERIOD);
    assert!((0..8).all(|i| i == 3 || net.at(i).faults().number() == 49));
    net.request(ALL_MODULES, Operation::Disarm, 0);
    net.request(ALL_MODULES, Operation::Arm, 0);
    assert_eq!((net.last_code(6), net.last_code(3)), (Some(ServiceCode::NotArmable), Some(ServiceCode::Ok)));
    net.run(SECOND);
    net.assert_in_step();
}

#[test]
fn a_sync_of_a_distant_past_moves_no_cycle() {
    let mut net = Net::eight();
    net.run(7 * SECOND);
    let cycle = net.at(5).cycle();
    assert!(cycle > 110);
    // To module 0 they have its own number; to the others they come from the time-keeper or, after a cut, from nearer the head than it.
    for old in [19, 20, 19, 19, cycle - 10, cycle + 1000] {
        net.inject(Message::Sync(Sync::new(old, 8, 8)).emit(0, true));
        net.run(PERIOD);
        net.assert_in_step();
    }
    assert_eq!(net.at(5).cycle(), cycle + 6);
    net.part = vec![0, 0, 0, 1, 1, 1, 1, 1];
    net.run(SECOND / 2);
    let cycle = net.at(5).cycle();
    let before = net.at(5).stats().stale;
    for node in 3..8 {
        net.poll(node, Some(&Message::Sync(Sync::new(19, 8, 8)).emit(0, true)));
    }
    net.settle();
    net.run(PERIOD);
    assert_eq!((net.at(5).cycle(), net.at(5).time_keeper()), (cycle + 1, Some(3)));
    assert_eq!(net.at(5).stats().stale, before + 1);
}

// Time

/// 37.5 ms apart it used to change by a third more than the limit allows.
#[test]
fn the_slew_limit_holds_whatever_the_time_between_two_actions() {
    let policy = policy(1, &[]);
    for apart in [5_000, 20_000, 37_500, 45_000, 49_900, 50_000, 80_000] {
        let mut config = Config::new(3, 8, BusKind::Fd, &policy);
        config.safety.caps.torque_slew = 30.0;
        config.safety.dead_man_ms = 0;
        let mut module = Controller::new(config, policy, Boot::default(), 0).unwrap();
        module.arm(false).unwrap();
        let (mut now, mut last_act, mut before, mut most) = (0, None, [0.0f32; 2], 0.0f32);
        let mut acted = 0;
        for cycle in 0..400u16 {
            let until = now + apart;
            let mut sync = Some(Message::Sync(Sync::new(cycle, 8, 8)).emit(0, true));
            while now < until {
                let outputs = module.poll(now, &level(), sync.take().as_ref(), BusStatus::ErrorActive);
                if module.stats().acted != acted {
                    acted = module.stats().acted;
                    let seconds = last_act.map_or(0.05, |last: Micros| (now - last) as f32 / 1e6);
                    for (torque, before) in outputs.torque.iter().zip(before) {
                        let rate = (torque - before).abs() / seconds;
                        assert!(rate <= 30.001, "{rate} a second, {seconds} s apart");
                        most = most.max(rate);
                    }
                    (last_act, before) = (Some(now), outputs.torque);
                }
                now = outputs.deadline.min(until);
            }
        }
        // Cycles that are shorter than what neighbours are waited for are cut short.
        assert!(acted == 0 || most > 15.0, "{apart}: {most}");
        assert!(apart < 37_500 || acted > 300, "{apart}: {acted}");
    }
}

#[test]
fn the_watchdog_latches_before_the_hardware_resets_the_chip() {
    const HARDWARE: u32 = 50_000;
    let policy = policy(1, &[]);
    let mut config = Config::new(0, 1, BusKind::Fd, &policy);
    config.timing = config.timing.watched_by(HARDWARE);
    config.safety.dead_man_ms = 0;
    config.check().unwrap();
    let mut module = Controller::new(config, policy, Boot::default(), 0).unwrap();
    module.arm(false).unwrap();
    let mut now = 0;
    while now < SECOND {
        let torque = module.torque().map(|torque| torque / policy.limits().torque);
        now = module.poll(now, &Sensors { torque, ..level() }, None, BusStatus::ErrorActive).deadline;
    }
    assert!(module.faults().is_empty());
    // Just before the hardware bites.
    now += Micros::from(HARDWARE) - 10_000;
    assert!(!module.poll(now, &level(), None, BusStatus::ErrorActive).motors_enabled);
    assert_eq!((module.faults().number(), module.arm(false)), (33, Ok(())), "an armed module stays so, and relaxed");
    module.disarm();
    assert_eq!(module.arm(true), Err(ServiceCode::NotArmable));
    module.release();
    assert_eq!((module.faults(), module.arm(false)), (FaultSet::EMPTY, Ok(())));
}
