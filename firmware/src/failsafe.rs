//! When the motors relax, and why: arming, the emergency stop, numbered faults, limits and the watchdog.
//!
//! # Arming
//!
//! A module starts *disarmed*: it takes part in the control cycle, and its motors are off. ARM from the station arms it, unless a fault forbids it
//! ([`Fault::forbids_arming`]). It is disarmed by DISARM, by a stop, and when the station is not heard for [`Safety::dead_man_ms`]. After a reset
//! that was not clean ([`Boot`]) it has fault 42 and needs ARM with an acknowledgement, once.
//!
//! ```text
//!  boot ----first cycle----> disarmed <----------------------- service
//!                             |   ^  \___________JOG___________^ |  end of the jog, any fault
//!                             |   |                              |
//!                           ARM   DISARM, station lost           |
//!                             v   |                              |
//!             fault that relaxes  |                              |
//!  relaxed <------------------- armed (active; alone, if it hears nobody)
//!     \______fault gone_________^  |
//!                                  |
//!  any of them -- EMERGENCY_STOP, or a neighbour that knows of it --> stopped -- release --> disarmed
//! ```
//!
//! # Emergency stop
//!
//! Stops and releases are counted ([`StopLatch`]); the newest wins, wherever it comes from, and of two equal ones the stop. The latch survives bus-off,
//! a cut cable and a reset ([`Retained`]).
//!
//! # Faults and limits
//!
//! A *fault* ([`Fault`], numbers from 32) says that something is wrong. What each does to the motors, whether it forbids arming and what clears it stands in one
//! table, [`Fault::effect`], [`Fault::forbids_arming`] and [`Fault::clearing`], which `wire-format.md` prints and this module obeys. They are set by:
//!
//! | fault | set by |
//! |---|---|
//! | 32 EmergencyStop | the latch |
//! | 33 Watchdog | a poll later than the promised deadline plus its grace |
//! | 34 SyncLost | no SYNC for `sync_lost_after` periods |
//! | 35 DuplicateNode | frames with the module's own number, in several cycles ([`crate::conflict`]) |
//! | 36 PolicyMismatch | a neighbour's latent with another policy tag |
//! | 37 OverTemperature | a motor above the limit, or a reading that is not a number |
//! | 38 JointAngle | a joint beyond its limit ([`crate::limits`]), at every poll |
//! | 39 Sensors | readings that cannot be true; relaxes unless [`Safety::blind_relaxes`] says otherwise |
//! | 40 BusOff | the CAN controller; what follows says [`BusOffPolicy`] |
//! | 41 Isolated | hearing nobody for `isolated_after` periods |
//! | 42 Restarted | a reset that was not clean |
//! | 43 UnderVoltage, 44 OverVoltage | the supply beyond its thresholds ([`crate::supply`]) |
//! | 45 OverCurrent | a motor that its driver cut off ([`crate::trips`]); it forbids arming, and needs CLEAR, only when it stays off |
//! | 46 OutsideLimit | a joint beyond its limit when it was first read |
//! | 47 StationLost | an armed module hearing nothing from the station for [`Safety::dead_man_ms`] |
//! | 48 ModuleCount | the time-keeper's SYNC with another number of modules |
//! | 49 ProtocolVersion | a neighbour's HEARTBEAT with another version |
//! | 50 MotorDead | measured torque that contradicts the command ([`crate::motor_health`]) |
//!
//! A *limit* ([`LimitedBy`], numbers from 96) says that all is well but the policy does not get all the torque it asks for.

use composer_shared::observation::Sensors;
use composer_shared::robot::{AXES, Limits};
use composer_shared::wire::{Clearing, Effect, Health, ServiceCode, StopCommand, StopCount, StopLatch};
pub use composer_shared::wire::{Fault, LimitedBy};
use serde::{Deserialize, Serialize};

use crate::boot::{Boot, Retained};
use crate::controller::Micros;
use crate::limits::Joints;
use crate::power::{Power, PowerWatch};
use crate::safety::Safety;
use crate::supply::Supply;

/// How far below the limit a motor must cool before it is used again, degrees Celsius.
const COOL_DOWN: f32 = 5.0;

/// A set of faults.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FaultSet(u32);

impl FaultSet {
    /// None.
    pub const EMPTY: FaultSet = FaultSet(0);
    /// Those that relax the motors. A latched bus-off does too, see [`Failsafe::relaxed`].
    pub const RELAXING: FaultSet = {
        let (mut set, mut i) = (0, 0);
        while i < Fault::ALL.len() {
            if matches!(Fault::ALL[i].effect(), Effect::Relaxed | Effect::Disarmed | Effect::Silent) {
                set |= bit(Fault::ALL[i]);
            }
            i += 1;
        }
        FaultSet(set)
    };
    /// Those that forbid arming.
    pub const FORBIDDING: FaultSet = {
        let (mut set, mut i) = (0, 0);
        while i < Fault::ALL.len() {
            if Fault::ALL[i].forbids_arming() {
                set |= bit(Fault::ALL[i]);
            }
            i += 1;
        }
        FaultSet(set)
    };

    /// Whether `fault` is in it.
    pub const fn contains(self, fault: Fault) -> bool {
        self.0 & bit(fault) != 0
    }

    /// Whether there is none.
    pub const fn is_empty(self) -> bool {
        self.0 == 0
    }

    /// The faults, lowest number first.
    pub fn iter(self) -> impl Iterator<Item = Fault> {
        Fault::ALL.into_iter().filter(move |f| self.contains(*f))
    }

    /// The lowest number, or 0: what HEARTBEAT says.
    pub fn number(self) -> u8 {
        self.iter().next().map_or(0, |f| f as u8)
    }

    /// Whether the two have one in common.
    pub const fn meets(self, other: FaultSet) -> bool {
        self.0 & other.0 != 0
    }

    /// The same without this one.
    #[must_use]
    pub const fn without(self, fault: Fault) -> Self {
        FaultSet(self.0 & !bit(fault))
    }

    /// As a mask: bit n says fault 32 + n.
    pub const fn bits(self) -> u32 {
        self.0
    }

    fn set(&mut self, fault: Fault, active: bool) {
        if active {
            self.0 |= bit(fault);
        } else {
            self.0 &= !bit(fault);
        }
    }
}

const fn bit(fault: Fault) -> u32 {
    // Fault numbers start at 32, and there are fewer than 32.
    1 << (fault as u32 & 31)
}

/// How the CAN controller is (ISO 11898-1 fault confinement).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum BusStatus {
    /// Few errors.
    #[default]
    ErrorActive,
    /// Many errors: it may no longer destroy the frames of others.
    ErrorPassive,
    /// Too many: it neither sends nor receives.
    BusOff,
}

/// What happens after bus-off.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum BusOffPolicy {
    /// The CAN port recovers (128 times 11 recessive bits) and the module goes on. Until then it acts as an isolated one.
    #[default]
    Recover,
    /// The motors relax and the module stays silent until it is restarted.
    Latch,
}

/// Keeps the faults, the emergency stop and whether the module is armed, and applies the limits.
#[derive(Clone, Debug)]
pub struct Failsafe {
    /// The policy's.
    limits: Limits,
    /// The module's own.
    safety: Safety,
    bus_off: BusOffPolicy,
    grace_us: u32,
    faults: FaultSet,
    joints: Joints,
    power: PowerWatch,
    stop: StopLatch,
    armed: bool,
    boot: Boot,
    /// Unclean resets that nobody has acknowledged.
    resets: u8,
    /// The next reset is one that somebody asked for.
    commanded: bool,
    /// When the next poll was promised at the latest; none before the first.
    promised: Option<Micros>,
}

impl Failsafe {
    /// Disarmed, and as the start was. `limits` are the policy's. A poll may come `grace_us` later than promised.
    pub fn new(limits: Limits, safety: Safety, bus_off: BusOffPolicy, grace_us: u32, boot: Boot) -> Self {
        let mut faults = FaultSet::EMPTY;
        faults.set(Fault::Restarted, !boot.cause.clean());
        faults.set(Fault::EmergencyStop, boot.stop.stopped());
        Failsafe {
            joints: Joints::new(safety.joints, limits.joint_angle),
            power: PowerWatch::new(safety.supply),
            limits,
            safety,
            bus_off,
            grace_us,
            faults,
            stop: boot.stop,
            armed: false,
            boot,
            resets: boot.resets,
            commanded: false,
            promised: None,
        }
    }

    /// All active faults.
    pub fn faults(&self) -> FaultSet {
        self.faults
    }

    /// Whether the motors are kept relaxed, by a fault or because the module is not armed.
    pub fn relaxed(&self) -> bool {
        !self.armed || !self.fit()
    }

    /// Whether no fault keeps the motors relaxed.
    pub fn fit(&self) -> bool {
        let faults = if self.safety.blind_relaxes { self.faults } else { self.faults.without(Fault::Sensors) };
        !faults.meets(FaultSet::RELAXING) && !self.bus_off_latched()
    }

    /// Whether the station has armed the module.
    pub fn armed(&self) -> bool {
        self.armed
    }

    /// The station's ARM. The acknowledgement says that somebody knows of an unclean reset. Refused while a fault forbids it; a module that is armed stays so.
    pub fn arm(&mut self, acknowledge: bool) -> Result<(), ServiceCode> {
        if acknowledge {
            self.resets = 0;
            self.clear(Clearing::Acknowledgement);
        }
        if !self.armed && self.faults.meets(FaultSet::FORBIDDING) {
            return Err(ServiceCode::NotArmable);
        }
        self.armed = true;
        Ok(())
    }

    /// Takes the arming back.
    pub fn disarm(&mut self) {
        self.armed = false;
    }

    /// The emergency stop.
    pub fn stop(&self) -> StopLatch {
        self.stop
    }

    /// Why the module started.
    pub fn boot(&self) -> &Boot {
        &self.boot
    }

    /// What to keep for the next start.
    pub fn retained(&self) -> Retained {
        Retained { stop: self.stop, resets: self.resets, commanded: self.commanded }
    }

    /// The next reset is one that somebody asked for.
    pub fn expect_restart(&mut self) {
        self.commanded = true;
    }

    /// Whether the module must not send, whatever else it may say when it is [silent](Effect::Silent).
    pub fn silenced(&self) -> bool {
        self.faults.contains(Fault::DuplicateNode) || self.bus_off()
    }

    /// Whether the CAN controller is off.
    pub fn bus_off(&self) -> bool {
        self.faults.contains(Fault::BusOff)
    }

    /// Whether the CAN port may recover from bus-off.
    pub fn may_recover(&self) -> bool {
        self.bus_off == BusOffPolicy::Recover
    }

    fn bus_off_latched(&self) -> bool {
        self.faults.contains(Fault::BusOff) && self.bus_off == BusOffPolicy::Latch
    }

    /// Sets or clears a fault that its cause decides alone. Latched ones have their own methods.
    pub fn set(&mut self, fault: Fault, active: bool) {
        self.faults.set(fault, active);
    }

    /// Takes a stop or a release. A release ends the watchdog's latch, too.
    pub fn command_stop(&mut self, command: StopCommand, count: StopCount) {
        let newer = count == StopCount::UNKNOWN || count.newer_than(self.stop.count());
        self.stop.command(command, count);
        if command == StopCommand::Release && newer && !self.stop.stopped() {
            self.clear(Clearing::Release);
        }
        self.follow_stop();
    }

    /// Takes what another module says of itself.
    pub fn hear_stop(&mut self, health: Health) {
        if self.stop.hear(health.has(Health::EMERGENCY_STOP), health.stop_count()) {
            self.follow_stop();
        }
    }

    /// Takes what another latch of this robot says.
    pub fn follow(&mut self, other: StopLatch) {
        if self.stop.hear(other.stopped(), other.count()) {
            self.follow_stop();
        }
    }

    fn follow_stop(&mut self) {
        self.faults.set(Fault::EmergencyStop, self.stop.stopped());
        self.armed &= !self.stop.stopped();
    }

    /// Ends the faults that are ended in this way.
    pub fn clear(&mut self, by: Clearing) {
        for fault in Fault::ALL {
            if fault.clearing() == by {
                self.faults.set(fault, false);
            }
        }
    }

    /// Follows how long the station has been silent: an armed module does not go on without it.
    pub fn check_station(&mut self, silence: Micros) {
        let dead_man = u64::from(self.safety.dead_man_ms) * 1000;
        if dead_man == 0 || silence <= dead_man {
            self.faults.set(Fault::StationLost, false);
        } else if self.armed {
            self.faults.set(Fault::StationLost, true);
            self.armed = false;
        }
    }

    /// Latches the watchdog if this poll comes too late.
    pub fn check_poll(&mut self, now: Micros) {
        if self.promised.is_some_and(|promised| now > promised.saturating_add(u64::from(self.grace_us))) {
            self.faults.set(Fault::Watchdog, true);
        }
    }

    /// Notes when the next poll is due.
    pub fn promise(&mut self, deadline: Micros) {
        self.promised = Some(deadline);
    }

    /// Follows the CAN controller's state.
    pub fn check_bus(&mut self, status: BusStatus) {
        let off = status == BusStatus::BusOff;
        if off || !self.bus_off_latched() {
            self.faults.set(Fault::BusOff, off);
        }
    }

    /// Follows the motor temperature, degrees Celsius.
    pub fn check_temperature(&mut self, temperature: f32) {
        let hot = self.faults.contains(Fault::OverTemperature);
        let limit = self.safety.caps.temperature_limit(&self.limits);
        let limit = if hot { limit - COOL_DOWN } else { limit };
        // A reading that is not a number counts as too hot.
        self.faults.set(Fault::OverTemperature, temperature.is_nan() || temperature > limit);
    }

    /// Follows the joints, by the latest readings: at every poll, because within a cycle a joint gets far.
    pub fn check_joints(&mut self, sensors: &Sensors) {
        if self.joints.follow(sensors) {
            self.faults.set(Fault::JointAngle, self.joints.beyond());
            self.faults.set(Fault::OutsideLimit, self.joints.started_beyond());
        }
    }

    /// Follows supply and motors.
    pub fn check_power(&mut self, now: Micros, power: &Power) {
        if self.power.follow(now, power) {
            self.faults.set(Fault::UnderVoltage, self.power.supply() == Supply::Under);
            self.faults.set(Fault::OverVoltage, self.power.supply() == Supply::Over);
            self.faults.set(Fault::OverCurrent, self.power.trips().any());
        }
    }

    /// Supply and cut-offs.
    pub fn power(&self) -> &PowerWatch {
        &self.power
    }

    /// Which motors that were cut off may begin again now, see [`crate::trips::Trips::rearm`].
    pub fn rearm(&mut self, now: Micros) -> [bool; AXES] {
        self.power.rearm(now)
    }

    /// The station's command to try motors again that were cut off too often.
    pub fn clear_cut_offs(&mut self) {
        self.power.clear();
    }

    /// Follows what the sample of a cycle says of the sensors.
    pub fn check_sample(&mut self, sensors: &Sensors) {
        self.faults.set(Fault::Sensors, !sensors.plausible());
    }

    /// The torque of one axis, without anything that relaxes: within the limit and slewed.
    pub fn command_axis(&self, previous: f32, action: f32, seconds: f32) -> f32 {
        self.safety.caps.command(&self.limits, previous, action, seconds)
    }

    /// The torques to command for the actions (-1 to 1), `seconds` after the `previous` ones, and what held them back. Zero when relaxed. What of it
    /// the joints bear says [`Failsafe::bearable`].
    pub fn command(&self, previous: [f32; AXES], action: [f32; AXES], seconds: f32) -> ([f32; AXES], LimitedBy) {
        if self.relaxed() {
            return ([0.0; AXES], LimitedBy::Relaxed);
        }
        let mut reason = LimitedBy::Nothing;
        let mut torque = [0.0; AXES];
        for ((torque, previous), action) in torque.iter_mut().zip(previous).zip(action) {
            *torque = self.safety.caps.command(&self.limits, previous, action, seconds);
            let most = self.safety.caps.torque_limit(&self.limits);
            let wanted = action * self.limits.torque;
            if (action.abs() >= 1.0 || wanted.abs() > most) && reason == LimitedBy::Nothing {
                reason = LimitedBy::Torque;
            }
            if (wanted.max(-most).min(most) - *torque).abs() > 1e-3 * self.limits.torque && action.abs() <= 1.0 {
                reason = LimitedBy::Slew;
            }
        }
        (torque, reason)
    }

    /// Whether joints and motors bear all torques now.
    #[inline]
    pub fn bears_all(&self) -> bool {
        self.joints.free() && self.power.quiet()
    }

    /// What joints and motors bear of these torques now. At every poll: never more than was commanded, so the next command grows from here.
    pub fn bearable(&self, torque: [f32; AXES]) -> [f32; AXES] {
        let mut torque = self.joints.limit(torque);
        if self.power.quiet() {
            return torque;
        }
        for (axis, torque) in torque.iter_mut().enumerate() {
            if self.power.trips().off(axis) {
                *torque = 0.0;
            }
        }
        torque
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::format;

    fn failsafe() -> Failsafe {
        let limits =
            Limits { torque: 80.0, torque_slew: 800.0, joint_angle: 3.1, temperature: 80.0, ..Limits::default() };
        let mut failsafe = Failsafe::new(limits, Safety::POLICY, BusOffPolicy::Recover, 1000, Boot::default());
        failsafe.arm(false).unwrap();
        failsafe
    }

    fn level() -> Sensors {
        Sensors { up: [0.0, 0.0, 1.0], temperature: 25.0, ..Sensors::ZERO }
    }

    #[test]
    fn every_fault_has_its_own_bit() {
        let mut seen = 0u32;
        for fault in Fault::ALL {
            assert_eq!(seen & bit(fault), 0);
            seen |= bit(fault);
            let mut set = FaultSet::EMPTY;
            set.set(fault, true);
            assert_eq!(set.number(), fault as u8);
            set.set(fault, false);
            assert!(set.is_empty());
        }
    }

    /// The table in `shared`, which `wire-format.md` prints, against what happens.
    #[test]
    fn every_fault_does_what_the_table_says_and_ends_by_what_it_says() {
        let document = include_str!("failsafe.rs");
        for fault in Fault::ALL {
            let mut failsafe = failsafe();
            failsafe.check_joints(&level());
            failsafe.set(fault, true);
            let relaxed = matches!(fault.effect(), Effect::Relaxed | Effect::Disarmed | Effect::Silent);
            assert_eq!(failsafe.relaxed(), relaxed, "{fault:?}");
            let (torque, limited_by) = failsafe.command([0.0; 2], [0.1; 2], 0.05);
            assert_eq!((torque == [0.0; 2], limited_by == LimitedBy::Relaxed), (relaxed, relaxed), "{fault:?}");
            assert_eq!(failsafe.silenced(), fault.effect() == Effect::Silent || fault == Fault::BusOff, "{fault:?}");
            failsafe.disarm();
            assert_eq!(failsafe.arm(false).is_err(), fault.forbids_arming(), "{fault:?}");
            for by in [Clearing::Release, Clearing::Clear, Clearing::Acknowledgement] {
                let mut failsafe = failsafe.clone();
                failsafe.clear(by);
                assert_eq!(failsafe.faults().contains(fault), by != fault.clearing(), "{fault:?} {by:?}");
            }
            // The module's documentation says what sets it.
            let number = format!("{} {fault:?}", fault as u8);
            let rows = document.lines().filter(|line| line.starts_with("//! | ") && line.contains(&number));
            assert_eq!(rows.count(), 1, "{number}");
        }
        // What disarms: the two that happen while armed do.
        let mut failsafe = failsafe();
        failsafe.check_station(2_000_001);
        assert!(!failsafe.armed() && failsafe.faults().contains(Fault::StationLost));
        failsafe.check_station(0);
        assert!(failsafe.faults().is_empty() && failsafe.relaxed());
        failsafe.arm(false).unwrap();
        failsafe.command_stop(StopCommand::Stop, StopCount::UNKNOWN);
        assert!(!failsafe.armed());
        failsafe.command_stop(StopCommand::Release, StopCount::UNKNOWN);
        assert!(failsafe.faults().is_empty() && failsafe.relaxed());
    }

    #[test]
    fn the_watchdog_latches_until_released() {
        let mut failsafe = failsafe();
        failsafe.check_poll(1_000_000);
        assert!(!failsafe.relaxed(), "nothing was promised before the first poll");
        failsafe.promise(10_000);
        failsafe.check_poll(11_000);
        assert!(!failsafe.relaxed());
        failsafe.check_poll(11_001);
        failsafe.promise(20_000);
        failsafe.check_poll(15_000);
        assert_eq!(failsafe.faults().number(), 33);
        assert!(failsafe.relaxed());
        failsafe.command_stop(StopCommand::Release, StopCount::UNKNOWN);
        assert!(!failsafe.relaxed());
    }

    #[test]
    fn a_hot_motor_relaxes_until_it_has_cooled() {
        let mut failsafe = failsafe();
        for (temperature, relaxed) in [(80.0, false), (80.5, true), (76.0, true), (75.0, false), (f32::NAN, true)] {
            failsafe.check_temperature(temperature);
            assert_eq!(failsafe.relaxed(), relaxed, "{temperature}");
        }
        assert_eq!(failsafe.faults().number(), 37);
    }

    #[test]
    fn bus_off_recovers_or_latches() {
        let mut failsafe = failsafe();
        failsafe.check_bus(BusStatus::BusOff);
        assert!(failsafe.silenced() && !failsafe.relaxed());
        failsafe.check_bus(BusStatus::ErrorActive);
        assert!(failsafe.faults().is_empty());

        failsafe.bus_off = BusOffPolicy::Latch;
        failsafe.check_bus(BusStatus::BusOff);
        failsafe.check_bus(BusStatus::ErrorActive);
        failsafe.command_stop(StopCommand::Release, StopCount::UNKNOWN);
        assert!(failsafe.silenced() && failsafe.relaxed());
        assert_eq!(failsafe.faults().number(), 40);
    }

    #[test]
    fn limits_are_applied_and_named() {
        let mut failsafe = failsafe();
        let command = |f: &Failsafe, previous, action| f.command(previous, action, 0.05);
        assert_eq!(command(&failsafe, [0.0; 2], [0.25, -0.25]), ([20.0, -20.0], LimitedBy::Nothing));
        assert_eq!(command(&failsafe, [0.0; 2], [0.75, 0.0]), ([40.0, 0.0], LimitedBy::Slew));
        assert_eq!(command(&failsafe, [70.0, 0.0], [1.0, 0.0]), ([80.0, 0.0], LimitedBy::Torque));
        failsafe.check_joints(&level());
        let bent = Sensors { joint_angles: [0.0, -3.12, 0.0, 0.0], ..level() };
        failsafe.check_joints(&bent);
        assert_eq!(failsafe.bearable([8.0, -8.0]), [8.0, 0.0]);
        assert_eq!(failsafe.bearable([8.0, 8.0]), [8.0, 8.0]);
        assert_eq!(failsafe.faults().number(), 38);
        assert!(!failsafe.relaxed());
        failsafe.check_joints(&level());
        failsafe.check_sample(&Sensors::ZERO);
        assert_eq!(failsafe.faults().number(), 39);
        assert!(failsafe.relaxed(), "a blind module pulls at nothing");
        failsafe.safety.blind_relaxes = false;
        assert!(!failsafe.relaxed(), "the paper's observation fault");
        failsafe.command_stop(StopCommand::Stop, StopCount::UNKNOWN);
        assert_eq!(command(&failsafe, [70.0; 2], [1.0; 2]), ([0.0; 2], LimitedBy::Relaxed));
        assert_eq!(failsafe.faults().iter().map(|f| f as u8).collect::<std::vec::Vec<_>>(), [32, 39]);
    }

    #[test]
    fn a_policy_cannot_raise_the_limits_of_the_module() {
        let mut failsafe = failsafe();
        failsafe.safety.caps = crate::limits::Caps { torque: 30.0, torque_slew: 400.0, temperature: 60.0 };
        assert_eq!(failsafe.command([0.0; 2], [1.0, 0.1], 0.05), ([20.0, 8.0], LimitedBy::Slew));
        assert_eq!(failsafe.command([20.0, 0.0], [0.5, 0.0], 0.05), ([30.0, 0.0], LimitedBy::Torque));
        failsafe.check_temperature(61.0);
        assert_eq!(failsafe.faults().number(), 37);
    }

    #[test]
    fn the_supply_and_a_cut_off_motor_are_faults_with_their_effects() {
        let mut failsafe = failsafe();
        failsafe.power = PowerWatch::new(crate::supply::Thresholds { under: 9.0, over: 16.0 });
        let supply = |volts| Some(crate::supply::Extremes::steady(volts));
        let trips = [None, Some(crate::drivers::motor::Trip::Overcurrent)];
        failsafe.check_joints(&level());
        for (volts, number) in [(12.0, 0), (8.0, 43), (17.0, 44)] {
            failsafe.check_power(0, &Power { supply: supply(volts), trips: [None; AXES] });
            assert_eq!((failsafe.faults().number(), failsafe.relaxed()), (number, number != 0), "{volts} V");
        }
        failsafe.check_power(1_000_000, &Power { supply: supply(12.0), trips });
        failsafe.check_power(1_100_000, &Power { supply: supply(12.0), trips });
        assert_eq!((failsafe.faults().number(), failsafe.relaxed()), (45, false));
        assert_eq!(failsafe.bearable([5.0, 5.0]), [5.0, 0.0], "the other motor goes on");
    }
}
