//! What a controller is told at its start: which module it is, of how many, on which bus, and when things happen.

use composer_shared::policy::Policy;
use composer_shared::robot::ROOM;
use composer_shared::wire::FRAGMENTS;
use serde::{Deserialize, Serialize};

use crate::failsafe::BusOffPolicy;
use crate::safety::Safety;

/// Kind of bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum BusKind {
    /// CAN 2.0 with 8-byte frames: a latent travels in eight pieces.
    Classic,
    /// CAN-FD with 64-byte frames and bit-rate switch.
    Fd,
}

/// When things happen within and over control cycles.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Timing {
    /// Control period.
    pub period_us: u32,
    /// After the start of a cycle: observe with the STATE frames that came.
    pub state_deadline_us: u32,
    /// After the start of a cycle: act on the latents that came. Longer waits for more latents under load, shorter acts fresher.
    pub collect_deadline_us: u32,
    /// Periods without SYNC after which the next module keeps the time.
    pub takeover_periods: u8,
    /// How much later each further candidate takes over; longer than a SYNC can be delayed by traffic.
    pub takeover_stagger_us: u32,
    /// Cycles without a frame after which a neighbour counts as dead.
    pub dead_after: u8,
    /// Periods without any frame after which a module relaxes its motors.
    pub isolated_after: u8,
    /// Periods without SYNC after which a module relaxes its motors.
    pub sync_lost_after: u8,
    /// A poll is asked for at least so often, whether something is due or not.
    pub poll_within_us: u32,
    /// How much later than promised a poll may come before the watchdog latches.
    pub poll_grace_us: u32,
    /// Cycles for which a point of the scene holds when no new one comes.
    pub goal_memory: u8,
}

impl Timing {
    /// The defaults for a policy's control period and a bus of 1 Mbit/s (data phase of FD: 5 Mbit/s): the collection deadline is twice the
    /// bus time of all modules' frames plus 5 ms, at least 20 % and at most 80 % of the period; the state deadline is a third of it.
    pub fn for_policy(policy: &Policy<'_>, bus: BusKind, modules: u8) -> Self {
        let period_us = policy.control_period_us();
        let points = policy.task().points(modules);
        let needed = Self::bus_time_us(bus, modules, points).saturating_mul(2).saturating_add(5_000);
        let collect_deadline_us = needed.max(period_us / 5).min(period_us / 5 * 4);
        Timing {
            period_us,
            state_deadline_us: collect_deadline_us / 3,
            collect_deadline_us,
            takeover_periods: 2,
            takeover_stagger_us: period_us / 10,
            dead_after: composer_shared::robot::DEAD_AFTER,
            isolated_after: 20,
            sync_lost_after: 4,
            poll_within_us: period_us,
            poll_grace_us: period_us,
            goal_memory: 4,
        }
    }

    /// The same for a board whose hardware watchdog resets it after `watchdog_us`: a late poll is noticed, and fault 33 latched, well before.
    #[must_use]
    pub fn watched_by(self, watchdog_us: u32) -> Self {
        Timing { poll_within_us: (watchdog_us / 10).max(1), poll_grace_us: (watchdog_us / 5 * 3).max(1), ..self }
    }

    /// About how long SYNC, `points` GOAL frames and the STATE and LATENT frames of all modules occupy the bus in one cycle, with
    /// worst-case bit stuffing at 1 Mbit/s and 5 Mbit/s. If this exceeds the period, the modules farthest from the head are never
    /// heard.
    pub fn bus_time_us(bus: BusKind, modules: u8, points: u8) -> u32 {
        let (short, latent) = match bus {
            BusKind::Classic => (135, 135 * FRAGMENTS as u32),
            BusKind::Fd => (56, 169),
        };
        u32::from(modules) * (short + latent) + (1 + u32::from(points)) * short
    }
}

/// What makes one module different from the next.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Config {
    /// This module's number: 0 is the head.
    pub node: u8,
    /// Modules of the robot, 1 to 64.
    pub modules: u8,
    /// The bus they are on.
    pub bus: BusKind,
    /// What to do after bus-off.
    pub bus_off: BusOffPolicy,
    /// What it keeps to, whatever its policy wants.
    pub safety: Safety,
    /// When things happen.
    pub timing: Timing,
}

impl Config {
    /// Module `node` of `modules` with the default timing and no limits but the policy's, recovering from bus-off.
    pub fn new(node: u8, modules: u8, bus: BusKind, policy: &Policy<'_>) -> Self {
        let timing = Timing::for_policy(policy, bus, modules);
        Config { node, modules, bus, bus_off: BusOffPolicy::Recover, safety: Safety::POLICY, timing }
    }

    /// Whether a controller accepts it; if not, why.
    pub fn check(&self) -> Result<(), ConfigError> {
        if self.modules == 0 || usize::from(self.modules) > ROOM {
            return Err(ConfigError::Modules(self.modules));
        }
        if self.node >= self.modules {
            return Err(ConfigError::Node { node: self.node, modules: self.modules });
        }
        let t = &self.timing;
        if t.period_us < 1000 {
            return Err(ConfigError::Period(t.period_us));
        }
        if t.state_deadline_us == 0
            || t.state_deadline_us >= t.collect_deadline_us
            || t.collect_deadline_us >= t.period_us
        {
            return Err(ConfigError::Deadlines {
                state: t.state_deadline_us,
                collect: t.collect_deadline_us,
                period: t.period_us,
            });
        }
        let counts = [
            ("takeover_periods", u32::from(t.takeover_periods)),
            ("takeover_stagger_us", t.takeover_stagger_us),
            ("dead_after", u32::from(t.dead_after)),
            ("isolated_after", u32::from(t.isolated_after)),
            ("sync_lost_after", u32::from(t.sync_lost_after)),
            ("poll_within_us", t.poll_within_us),
            ("poll_grace_us", t.poll_grace_us),
        ];
        counts.into_iter().find(|(_, n)| *n == 0).map_or(Ok(()), |(field, _)| Err(ConfigError::Zero(field)))
    }
}

/// Why a configuration is refused.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ConfigError {
    /// No modules, or more than there are identifiers for.
    Modules(u8),
    /// The module is not one of the robot's.
    Node {
        /// Its number.
        node: u8,
        /// How many there are.
        modules: u8,
    },
    /// The control period is too short.
    Period(u32),
    /// The deadlines are not in order.
    Deadlines {
        /// State deadline, microseconds.
        state: u32,
        /// Collection deadline, microseconds.
        collect: u32,
        /// Control period, microseconds.
        period: u32,
    },
    /// A field of [`Timing`] that must not be zero.
    Zero(&'static str),
}

impl core::fmt::Display for ConfigError {
    fn fmt(&self, f: &mut core::fmt::Formatter<'_>) -> core::fmt::Result {
        match *self {
            ConfigError::Modules(n) => write!(f, "{n} modules cannot be: a robot has 1 to {ROOM}"),
            ConfigError::Node { node, modules } => {
                write!(
                    f,
                    "module {node} cannot be one of {modules}: they are numbered 0 to {}",
                    modules.saturating_sub(1)
                )
            }
            ConfigError::Period(us) => {
                write!(f, "a control period of {us} us is too short: at least 1000 us are needed")
            }
            ConfigError::Deadlines { state, collect, period } => write!(
                f,
                "the deadlines must be in order, 0 < state < collection < period, but are {state}, {collect} and {period} us"
            ),
            ConfigError::Zero(field) => write!(f, "{field} is 0, but must be at least 1"),
        }
    }
}

impl core::error::Error for ConfigError {}
