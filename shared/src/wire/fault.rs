//! What can be wrong with a module, what follows from it, and what ends it: one table, from which the firmware takes what it does
//! and which `wire-format.md` repeats.

/// What holds a module's torque back (numbers as in moteus: from 96 on). None of these is a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum LimitedBy {
    /// The policy gets what it asks for.
    Nothing = 0,
    /// The torque limit.
    Torque = 96,
    /// The slew limit.
    Slew = 97,
    /// A joint at its end: the torque that would bend it further is held back.
    JointAngle = 98,
    /// The motors are relaxed.
    Relaxed = 99,
}

impl LimitedBy {
    /// All of them.
    pub const ALL: [LimitedBy; 5] =
        [LimitedBy::Nothing, LimitedBy::Torque, LimitedBy::Slew, LimitedBy::JointAngle, LimitedBy::Relaxed];
}

/// What is wrong with a module (numbers as in moteus: from 32 on; they never change their meaning). What each does to the motors and
/// what clears it is said by [`Fault::effect`], [`Fault::forbids_arming`] and [`Fault::clearing`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
#[repr(u8)]
pub enum Fault {
    /// An emergency stop is latched.
    EmergencyStop = 32,
    /// The controller was not polled in time: the processor was overloaded or hung.
    Watchdog = 33,
    /// No cycle was started for too long.
    SyncLost = 34,
    /// Another node sends under this module's number.
    DuplicateNode = 35,
    /// A neighbour runs another policy; its latents are ignored.
    PolicyMismatch = 36,
    /// A motor is too hot, or its temperature is not a number.
    OverTemperature = 37,
    /// A joint is beyond its limit; torque that would bend it further is held back.
    JointAngle = 38,
    /// The sensors read what cannot be true; the neighbours ignore this module.
    Sensors = 39,
    /// The CAN controller went bus-off.
    BusOff = 40,
    /// Nobody was heard for too long.
    Isolated = 41,
    /// The module restarted though nobody asked for it: watchdog, brown-out, a fault of the processor.
    Restarted = 42,
    /// The supply is too low for the motors.
    UnderVoltage = 43,
    /// The supply is too high for the motors.
    OverVoltage = 44,
    /// A motor was cut off, for its current or because that cannot be measured. Once too often, and it stays off.
    OverCurrent = 45,
    /// A joint was outside its limits when the module was to be armed.
    OutsideLimit = 46,
    /// The station was not heard for too long.
    StationLost = 47,
    /// A neighbour believes the robot to have another number of modules.
    ModuleCount = 48,
    /// A neighbour speaks another version of this protocol.
    ProtocolVersion = 49,
    /// A motor does not give the torque that it is told; which one STATE says.
    MotorDead = 50,
}

/// What a fault does to the motors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Effect {
    /// Nothing: it is reported.
    On,
    /// An axis gets no torque that would bend its joints further outwards.
    Outwards,
    /// An axis gets no torque.
    Axis,
    /// No torque while it lasts.
    Relaxed,
    /// No torque, and the module has to be armed anew.
    Disarmed,
    /// No torque, and the module sends nothing but, rarely, a HEARTBEAT.
    Silent,
    /// As the module is configured.
    Configured,
}

impl Effect {
    /// How `wire-format.md` says it.
    pub const fn text(self) -> &'static str {
        match self {
            Effect::On => "on",
            Effect::Outwards => "on, not further outwards",
            Effect::Axis => "its axis relaxed",
            Effect::Relaxed => "relaxed",
            Effect::Disarmed => "relaxed, disarmed",
            Effect::Silent => "relaxed, silent",
            Effect::Configured => "by configuration",
        }
    }
}

/// What ends a fault. A restart ends all but a latched stop, and may itself be [`Fault::Restarted`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Clearing {
    /// The end of its cause.
    Itself,
    /// A release from the station.
    Release,
    /// The service operation CLEAR.
    Clear,
    /// The service operation ARM with the acknowledgement.
    Acknowledgement,
}

impl Fault {
    /// All of them.
    pub const ALL: [Fault; 19] = [
        Fault::EmergencyStop,
        Fault::Watchdog,
        Fault::SyncLost,
        Fault::DuplicateNode,
        Fault::PolicyMismatch,
        Fault::OverTemperature,
        Fault::JointAngle,
        Fault::Sensors,
        Fault::BusOff,
        Fault::Isolated,
        Fault::Restarted,
        Fault::UnderVoltage,
        Fault::OverVoltage,
        Fault::OverCurrent,
        Fault::OutsideLimit,
        Fault::StationLost,
        Fault::ModuleCount,
        Fault::ProtocolVersion,
        Fault::MotorDead,
    ];

    /// The fault with this number.
    pub fn from_number(number: u8) -> Option<Self> {
        Self::ALL.into_iter().find(|f| *f as u8 == number)
    }

    /// What it does to the motors.
    pub const fn effect(self) -> Effect {
        self.rule().0
    }

    /// Whether a module that has it refuses to be armed ([`super::ServiceCode::NotArmable`]).
    pub const fn forbids_arming(self) -> bool {
        self.rule().1
    }

    /// What ends it.
    pub const fn clearing(self) -> Clearing {
        self.rule().2
    }

    /// What ends it, in words.
    pub const fn cleared_by(self) -> &'static str {
        self.rule().3
    }

    /// The table: effect, whether it forbids arming, what ends it.
    const fn rule(self) -> (Effect, bool, Clearing, &'static str) {
        use Clearing::{Acknowledgement, Clear, Itself, Release};
        match self {
            Fault::EmergencyStop => (Effect::Disarmed, true, Release, "a release from the station"),
            Fault::Watchdog => (Effect::Relaxed, true, Release, "a release from the station, or a restart"),
            Fault::SyncLost => (Effect::Relaxed, false, Itself, "the next SYNC"),
            Fault::DuplicateNode => (Effect::Silent, true, Clear, "CLEAR, or a restart"),
            Fault::PolicyMismatch => (Effect::On, false, Itself, "the neighbour agreeing, or falling silent"),
            Fault::OverTemperature => (Effect::Relaxed, false, Itself, "the motor 5 degrees below the limit"),
            Fault::JointAngle => (Effect::Outwards, false, Itself, "the joint within its limit"),
            Fault::Sensors => (Effect::Relaxed, false, Itself, "plausible readings"),
            Fault::BusOff => (Effect::Configured, false, Itself, "recovery, or, if it is latched, a restart"),
            Fault::Isolated => (Effect::Relaxed, false, Itself, "the next frame heard"),
            Fault::Restarted => (Effect::Disarmed, true, Acknowledgement, "ARM with the acknowledgement"),
            Fault::UnderVoltage => (Effect::Relaxed, false, Itself, "the supply within its limits"),
            Fault::OverVoltage => (Effect::Relaxed, false, Itself, "the supply within its limits"),
            Fault::OverCurrent => {
                (Effect::Axis, true, Clear, "a second's rest; the fourth in short order by CLEAR, or a restart")
            }
            Fault::OutsideLimit => (Effect::Relaxed, true, Itself, "the joint within its limits"),
            Fault::StationLost => (Effect::Disarmed, false, Itself, "the next frame from the station"),
            Fault::ModuleCount => (Effect::On, true, Itself, "the neighbour agreeing, or falling silent"),
            Fault::ProtocolVersion => (Effect::On, true, Itself, "the neighbour agreeing, or falling silent"),
            Fault::MotorDead => (Effect::On, false, Itself, "the motor giving what it is told for some cycles"),
        }
    }
}
