//! Ends of joints, supply and cut-offs, seen from a whole module.

use super::*;
use crate::drivers::motor::Trip;
use crate::limits::{Caps, JointRange};
use crate::safety::Safety;
use crate::supply::{Extremes, Thresholds};

const SUPPLY: Thresholds = Thresholds { under: 9.0, over: 16.0 };
/// The module that is looked at.
const NODE: usize = 3;

/// A robot that has been moving for a second, whose modules keep to `safety`.
fn moving(safety: Safety) -> Net {
    let mut net = Net::eight();
    net.safety = safety;
    (0..8).for_each(|node| net.plug(node));
    net.run(SECOND);
    assert!(net.outputs.iter().all(|o| o.motors_enabled && o.torque.iter().all(|t| *t != 0.0)));
    net
}

impl Net {
    fn power(&mut self, supply: f32, trips: [Option<Trip>; 2]) {
        let supply = Some(Extremes::steady(supply));
        self.nodes[NODE].as_mut().unwrap().set_power(Power { supply, trips });
    }

    /// Bends the joints of the yaw axis in the direction of its torque to this angle as an encoder of a single turn reads it, and polls once.
    fn bend(&mut self, angle: f32) {
        let read = angle - core::f32::consts::TAU * libm::roundf(angle / core::f32::consts::TAU);
        self.sensors[NODE].joint_angles[0] = read;
        self.poll(NODE, None);
    }
}

#[test]
fn a_joint_that_passes_its_end_within_a_cycle_loses_its_outward_torque_at_the_next_poll() {
    let mut net = moving(Safety::POLICY);
    let way = net.outputs[NODE].torque[0].signum();
    let acted = net.at(NODE).stats().acted;
    let before = net.outputs[NODE].torque;
    net.bend(way * 2.9);
    assert_eq!(net.outputs[NODE].torque, before);
    net.bend(way * 3.05);
    assert!((net.outputs[NODE].torque[0] - before[0] / 2.0).abs() < 0.01 * before[0].abs(), "half of the ramp");
    // 3.16 rad read -3.12: outwards stays outwards.
    for angle in [3.09, 3.11, 3.16, 3.3] {
        net.bend(way * angle);
        if angle > 3.1 {
            assert_eq!(net.outputs[NODE].torque, [0.0, before[1]], "at {angle}");
            assert_eq!(net.at(NODE).faults().number(), 38);
            assert_eq!(net.at(NODE).telemetry().limited_by, LimitedBy::JointAngle as u8);
        }
    }
    assert_eq!(net.at(NODE).stats().acted, acted, "all of it within one cycle");
    // The policy wants outwards or inwards as it likes; it only gets inwards.
    for _ in 0..200 {
        net.run(PERIOD);
        assert!(net.outputs[NODE].motors_enabled && net.outputs[NODE].torque[0] * way <= 0.0);
    }
    // It is let go where it stands, and torque comes back by the slew limit, not at once.
    net.bend(way * 2.0);
    let last = net.outputs[NODE].torque[0];
    net.run(PERIOD);
    assert!((net.outputs[NODE].torque[0] - last).abs() <= net.policy.limits().torque_slew * 0.05 + 1e-3);
    assert!(net.at(NODE).faults().is_empty());
}

#[test]
fn inward_torque_is_allowed_beyond_the_end() {
    let mut net = moving(Safety::POLICY);
    let way = net.outputs[NODE].torque[0].signum();
    let before = net.outputs[NODE].torque;
    for angle in [2.0, 3.0, 3.12, 3.16] {
        net.bend(-way * angle);
        assert_eq!(net.outputs[NODE].torque, before, "at {angle} of the other side");
    }
    assert_eq!(net.at(NODE).faults().number(), 38);
}

#[test]
fn a_joint_that_starts_outside_its_limit_is_a_fault_of_its_own() {
    let mut net = Net::eight();
    net.sensors[NODE].joint_angles[2] = 3.12;
    net.run(SECOND);
    let faults: Vec<u8> = net.at(NODE).faults().iter().map(|fault| fault as u8).collect();
    assert_eq!((faults, net.outputs[NODE].motors_enabled), (std::vec![38, 46], false));
    assert!(net.outputs.iter().enumerate().all(|(node, o)| o.motors_enabled == (node != NODE)));
    // Brought back by hand.
    net.sensors[NODE].joint_angles[2] = 3.0;
    net.run(2 * PERIOD);
    net.assert_in_step();
    // And beyond once more: not the start any more.
    net.sensors[NODE].joint_angles[2] = 3.12;
    net.run(PERIOD);
    assert_eq!((net.at(NODE).faults().number(), net.outputs[NODE].motors_enabled), (38, true));
    assert!(!net.at(NODE).faults().contains(Fault::OutsideLimit));
}

#[test]
fn each_joint_has_its_own_ends_and_the_module_its_own_caps() {
    let policy = Net::eight().policy.limits();
    let caps = Caps { torque: policy.torque / 100.0, torque_slew: policy.torque_slew, temperature: 60.0 };
    let mut joints = Safety::POLICY.joints;
    joints[2] = JointRange { min: -0.5, max: 0.25 };
    let mut net = moving(Safety { joints, caps, ..Safety::POLICY });
    for _ in 0..40 {
        net.run(PERIOD);
        let largest = net.outputs.iter().flat_map(|o| o.torque).fold(0.0f32, |most, t| most.max(t.abs()));
        assert!(largest <= caps.torque, "{largest}");
    }
    net.sensors[NODE].joint_angles[2] = 0.3;
    net.poll(NODE, None);
    assert_eq!(net.at(NODE).faults().number(), 38);
    assert!(net.outputs[NODE].torque[0] <= 0.0);
    net.sensors[NODE].joint_angles = [0.0, 0.0, 0.0, 0.3];
    net.poll(NODE, None);
    assert!(net.at(NODE).faults().is_empty(), "another joint goes further");
    net.sensors[NODE].temperature = 61.0;
    net.poll(NODE, None);
    assert_eq!(net.at(NODE).faults().number(), 37, "the policy would let it become hotter");
}

#[test]
fn a_supply_that_sags_relaxes_and_torque_grows_from_zero_when_it_is_back() {
    let mut net = moving(Safety { supply: SUPPLY, ..Safety::POLICY });
    net.power(12.0, [None; 2]);
    net.run(PERIOD);
    net.assert_in_step();
    for (volts, number) in [(5.0, 43), (f32::NAN, 43), (17.0, 44)] {
        // A dip of less than a millisecond, between two polls.
        net.power(volts, [None; 2]);
        net.poll(NODE, None);
        assert_eq!((net.at(NODE).faults().number(), net.outputs[NODE].motors_enabled), (number, false), "{volts} V");
        net.power(12.0, [None; 2]);
        net.run(PERIOD);
        assert!(!net.outputs[NODE].motors_enabled, "not before it has settled");
        // In steps of a millisecond, until it moves again: never faster than the slew limit.
        let mut last = [0.0f32; 2];
        let step = net.policy.limits().torque_slew * 0.05 + 1e-3;
        for _ in 0..400 {
            net.run(1000);
            let torque = net.outputs[NODE].torque;
            assert!(torque.iter().zip(last).all(|(t, last)| (t - last).abs() <= step), "{last:?} to {torque:?}");
            last = torque;
        }
        net.assert_in_step();
    }
}

#[test]
fn a_cut_off_motor_leaves_the_other_one_and_the_sensors_alone() {
    let mut net = moving(Safety::POLICY);
    net.power(12.0, [Some(Trip::Overcurrent), None]);
    net.poll(NODE, None);
    assert_eq!(net.at(NODE).faults().number(), 45);
    for _ in 0..10 {
        net.run(PERIOD);
        let Outputs { torque, motors_enabled, .. } = net.outputs[NODE];
        assert!(motors_enabled && torque[0] == 0.0 && torque[1] != 0.0, "{torque:?}");
        assert_eq!(net.at(NODE).faults().number(), 45, "the sensors go on: no fault 39");
        assert!(net.at(NODE).heartbeat().health.sensors_plausible());
        assert_eq!(net.at(0).heard(), 0xff, "and the others attend to it");
    }
    // It is allowed again after a rest, whatever happens on the bus; and begins from zero.
    assert_eq!(net.nodes[NODE].as_mut().unwrap().rearm(), [false; 2]);
    net.run(SECOND);
    assert_eq!(net.nodes[NODE].as_mut().unwrap().rearm(), [true, false]);
    net.power(12.0, [None; 2]);
    net.run(PERIOD);
    assert!(net.at(NODE).faults().is_empty());
    assert!(net.outputs[NODE].torque[0].abs() <= net.policy.limits().torque_slew * 0.05 + 1e-3);
}

#[test]
fn a_gap_of_sync_does_not_arm_a_cut_off_motor_and_the_fourth_cut_off_stays() {
    let mut net = moving(Safety::POLICY);
    for cut_off in 1..=4 {
        net.power(12.0, [Some(Trip::Overcurrent), None]);
        net.poll(NODE, None);
        assert_eq!(net.at(NODE).faults().number(), 45);
        // The module loses the bus, relaxes, and is back: no new chance for the motor.
        net.part[NODE] = 1;
        net.run(SECOND / 4);
        net.part[NODE] = 0;
        net.run(SECOND / 4);
        assert_eq!(net.nodes[NODE].as_mut().unwrap().rearm(), [false; 2], "cut-off {cut_off}");
        net.run(SECOND);
        assert_eq!(net.nodes[NODE].as_mut().unwrap().rearm(), [cut_off <= 3, false], "cut-off {cut_off}");
        net.power(12.0, [None; 2]);
        net.run(PERIOD);
    }
    assert!(net.at(NODE).power().trips().latched());
    net.run(100 * SECOND);
    assert_eq!(
        (net.at(NODE).faults().number(), net.outputs[NODE].torque[0]),
        (45, 0.0),
        "time alone does not clear it"
    );
    net.nodes[NODE].as_mut().unwrap().failsafe.clear_cut_offs();
    net.run(PERIOD);
    net.assert_in_step();
}
