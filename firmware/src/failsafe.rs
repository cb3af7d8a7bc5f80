//! When the motors relax, and why: numbered faults, limits, the watchdog and the emergency stop.
//!
//! A *fault* ([`Fault`], numbers from 32) says that something is wrong; most relax the motors. A *limit* ([`LimitedBy`], numbers
//! from 96) says that all is well but the policy does not get all the torque it asks for.
//!
//! | fault | relaxes | set by | cleared by |
//! |---|---|---|---|
//! | 32 emergency stop | yes | an EMERGENCY_STOP frame from anybody, or locally | a release from the station |
//! | 33 watchdog | yes | a poll later than the promised deadline plus its grace | a release, or a restart |
//! | 34 sync lost | yes | no SYNC for `sync_lost_after` periods | the next SYNC |
//! | 35 duplicate node | yes, and silent | a frame with the module's own number | a restart |
//! | 36 policy mismatch | no | a neighbour's latent with another policy tag | that neighbour agreeing or silent |
//! | 37 over-temperature | yes | a motor above the limit, or a reading that is not a number | 5 degrees below the limit |
//! | 38 joint angle | the axis, outwards | a joint beyond its limit ([`crate::limits`]), at every poll | the joint within its limit |
//! | 39 sensors | no | readings that cannot be true | readings that can |
//! | 40 bus-off | if latched | the CAN controller | recovery, or a restart ([`BusOffPolicy`]) |
//! | 41 isolated | yes | hearing nobody for `isolated_after` periods | the next frame heard |
//! | 43 undervoltage | yes | the supply below its threshold ([`crate::supply`]) | a supply that has been good for a tenth of a second |
//! | 44 overvoltage | yes | the supply above its threshold | likewise |
//! | 45 over-current | the axis | a motor that its driver cut off ([`crate::trips`]) | a rest; after three cut-offs [`Failsafe::clear_cut_offs`], or a restart |
//! | 46 outside limit | yes | a joint beyond its limit when it was first read | the joint within its limit |

use composer_shared::observation::Sensors;
use composer_shared::robot::{AXES, Limits};
pub use composer_shared::wire::{Fault, LimitedBy};
use serde::{Deserialize, Serialize};

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
    const RELAXING: FaultSet = FaultSet(
        bit(Fault::EmergencyStop)
            | bit(Fault::Watchdog)
            | bit(Fault::SyncLost)
            | bit(Fault::DuplicateNode)
            | bit(Fault::OverTemperature)
            | bit(Fault::Isolated)
            | bit(Fault::UnderVoltage)
            | bit(Fault::OverVoltage)
            | bit(Fault::OutsideLimit),
    );

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

/// Keeps the faults and applies the limits.
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
    /// When the next poll was promised at the latest; none before the first.
    promised: Option<Micros>,
}

impl Failsafe {
    /// No faults. `limits` are the policy's. A poll may come `grace_us` later than promised.
    pub fn new(limits: Limits, safety: Safety, bus_off: BusOffPolicy, grace_us: u32) -> Self {
        Failsafe {
            joints: Joints::new(safety.joints, limits.joint_angle),
            power: PowerWatch::new(safety.supply),
            limits,
            safety,
            bus_off,
            grace_us,
            faults: FaultSet::EMPTY,
            promised: None,
        }
    }

    /// All active faults.
    pub fn faults(&self) -> FaultSet {
        self.faults
    }

    /// Whether a fault keeps the motors relaxed.
    pub fn relaxed(&self) -> bool {
        self.faults.0 & FaultSet::RELAXING.0 != 0 || self.bus_off_latched()
    }

    /// Whether the module must not send.
    pub fn silenced(&self) -> bool {
        self.faults.contains(Fault::DuplicateNode) || self.faults.contains(Fault::BusOff)
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

    /// Latches the emergency stop.
    pub fn stop(&mut self) {
        self.faults.set(Fault::EmergencyStop, true);
    }

    /// The station's release: ends the emergency stop and the watchdog's latch, nothing else.
    pub fn release(&mut self) {
        self.faults.set(Fault::EmergencyStop, false);
        self.faults.set(Fault::Watchdog, false);
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
        self.joints.follow(sensors);
        self.faults.set(Fault::JointAngle, self.joints.beyond());
        self.faults.set(Fault::OutsideLimit, self.joints.started_beyond());
    }

    /// Follows supply and motors.
    pub fn check_power(&mut self, now: Micros, power: &Power) {
        self.power.follow(now, power);
        self.faults.set(Fault::UnderVoltage, self.power.supply() == Supply::Under);
        self.faults.set(Fault::OverVoltage, self.power.supply() == Supply::Over);
        self.faults.set(Fault::OverCurrent, self.power.trips().any());
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

    /// What joints and motors bear of these torques now. At every poll: never more than was commanded, so the next command grows from here.
    pub fn bearable(&self, torque: [f32; AXES]) -> [f32; AXES] {
        let mut torque = self.joints.limit(torque);
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

    fn failsafe() -> Failsafe {
        let limits =
            Limits { torque: 80.0, torque_slew: 800.0, joint_angle: 3.1, temperature: 80.0, ..Limits::default() };
        Failsafe::new(limits, Safety::POLICY, BusOffPolicy::Recover, 1000)
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
        failsafe.release();
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
        failsafe.release();
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
        assert!(!failsafe.relaxed());
        failsafe.stop();
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
