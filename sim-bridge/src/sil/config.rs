//! How a run is set up, and why one cannot be.

use std::io;

use composer_firmware::controller::{BusKind, BusOffPolicy, ConfigError, Micros, Timing};
use composer_firmware::safety::Safety;
use composer_shared::policy::PolicyError;
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::{FRAGMENTS, Frame, StopCommand};

use super::NEVER;
use crate::computer::Trouble;
use crate::faults::ScheduledFault;
use crate::frame_bits::{BitRates, Format, worst_case};

/// A module's clock against true time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clock {
    /// What it shows more than the others, us.
    pub offset_us: u64,
    /// How much faster it runs, parts per billion (1 ppm is 1000). Held within +-10 %.
    pub drift_ppb: i32,
}

impl Clock {
    fn drift(self) -> i128 {
        i128::from(self.drift_ppb.clamp(-100_000_000, 100_000_000))
    }

    /// What it shows at true time `ns`, us.
    pub(super) fn show(self, ns: u64) -> Micros {
        if self.drift_ppb == 0 {
            return self.offset_us + ns / 1000;
        }
        let passed = i128::from(ns) + (i128::from(ns) * self.drift()).div_euclid(1_000_000_000);
        self.offset_us + (passed / 1000) as u64
    }

    /// The first true time, ns, at which it shows `us` or more.
    pub(super) fn reaches(self, us: Micros) -> u64 {
        let passed = us.saturating_sub(self.offset_us).saturating_mul(1000);
        if self.drift_ppb == 0 {
            return passed;
        }
        // Within a few ns of the true one, because both divisions round.
        let rate = 1_000_000_000 + self.drift();
        let mut ns = (i128::from(passed) * 1_000_000_000 / rate).min(i128::from(NEVER)) as u64;
        while ns < NEVER && self.show(ns) < us {
            ns += 1;
        }
        while ns > 0 && self.show(ns - 1) >= us {
            ns -= 1;
        }
        ns
    }
}

/// A frame that a foreign device sends.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Injected {
    /// When, ns.
    pub at_ns: u64,
    /// What.
    pub frame: Frame,
}

/// How a run is set up.
#[derive(Clone, Debug, PartialEq)]
pub struct SilConfig {
    /// Kind of bus.
    pub bus: BusKind,
    /// Its bit rates.
    pub rates: BitRates,
    /// What goes wrong and when ([`crate::faults::FaultPlan::draw`]).
    pub faults: Vec<ScheduledFault>,
    /// Seed of everything random on the bus: losses, delays, corruption.
    pub seed: u64,
    /// From the last STATE needed (or the state deadline) until LATENT is ready to be sent, us. The default, 200, is well above what
    /// a Cortex-M4 at 170 MHz needs for the observation and the encoder.
    pub encode_latency_us: u32,
    /// From the last LATENT needed (or the collection deadline) until the torque is at the motor, us. None, the default, takes what a whole control
    /// step of that many modules may take on the Cortex-M4F ([`composer_firmware::budget::step_us`]): 662 for 8 modules, 2787 for 64.
    pub act_latency_us: Option<u32>,
    /// From hearing SYNC until GOAL is ready to be sent, us. Default 50.
    pub station_latency_us: u32,
    /// Clocks of the modules, head first; those not listed are exact.
    pub clocks: Vec<Clock>,
    /// Configured numbers of the modules, head first; those not listed have the right one.
    pub numbers: Vec<u8>,
    /// Whether there is a station. Without one nobody tells the robot anything, unless somebody outside ([`super::Outside`]) does.
    pub station: bool,
    /// Number of modules between the head end of the cable and the station: 0 puts it at the head end.
    pub station_behind: usize,
    /// Whether the station has a second port at the tail end of the cable, and joins the parts of a cable that is cut ([`crate::ring`]). Its first one is at the head
    /// end then, for a cut anywhere ([`SilConfig::station_behind`] is 0).
    pub ring: bool,
    /// Whether the ports of the modules have the guard of the board's ([`composer_firmware::port::guard`]): then a module that babbles is one whose software runs wild.
    /// Without it, it is one whose CAN controller does.
    pub guard: bool,
    /// Stops and releases that the station sends, with their times in ns.
    pub commands: Vec<(u64, StopCommand)>,
    /// When the stop input of which module has been open for long enough, with the times in ns, in their order.
    pub presses: Vec<(u64, usize)>,
    /// Frames of a foreign device at the tail end of the cable, in order of time.
    pub injected: Vec<Injected>,
    /// What controllers do after bus-off.
    pub bus_off: BusOffPolicy,
    /// What modules keep to whatever their policy wants. By default as on a board without limits of its own, but a module whose sensors read nothing goes
    /// on with an observation of zeros, as in the paper.
    pub safety: Safety,
    /// Timing of the control cycle; none takes the default for policy, bus and number of modules.
    pub timing: Option<Timing>,
    /// The run ends here even if the plant is not done, ns. Default 10 minutes.
    pub limit_ns: u64,
}

impl SilConfig {
    /// A healthy robot on a bus of this kind: 1 Mbit/s, with 5 Mbit/s in the data phase of FD.
    pub fn new(bus: BusKind) -> Self {
        SilConfig {
            bus,
            rates: if bus == BusKind::Fd { BitRates::FD_1M_5M } else { BitRates::CLASSIC_1M },
            faults: Vec::new(),
            seed: 0,
            encode_latency_us: 200,
            act_latency_us: None,
            station_latency_us: 50,
            clocks: Vec::new(),
            numbers: Vec::new(),
            station: true,
            station_behind: 0,
            ring: true,
            guard: true,
            commands: Vec::new(),
            presses: Vec::new(),
            injected: Vec::new(),
            bus_off: BusOffPolicy::Recover,
            safety: Safety { blind_relaxes: false, ..Safety::POLICY },
            timing: None,
            limit_ns: 600_000_000_000,
        }
    }

    pub(super) fn clock(&self, module: usize) -> Clock {
        self.clocks.get(module).copied().unwrap_or_default()
    }
}

/// Time that the frames of a control cycle take at most on a bus of this kind, with the worst bit stuffing, us: SYNC, so many GOAL frames, and STATE and LATENT
/// of so many modules.
pub fn cycle_us(bus: BusKind, rates: BitRates, modules: usize, points: usize) -> u64 {
    let (short, latent) = match bus {
        BusKind::Fd => (worst_case(Format::FdBrs, 8), worst_case(Format::FdBrs, 64)),
        BusKind::Classic => (worst_case(Format::Classic, 8), worst_case(Format::Classic, 8)),
    };
    let pieces = if bus == BusKind::Fd { 1 } else { FRAGMENTS as u64 };
    let [short, latent] = [short, latent].map(|length| rates.with_interframe_ns(length));
    ((1 + points + modules) as u64 * short + modules as u64 * pieces * latent) / 1000
}

/// Why a run cannot be made.
#[derive(Debug, thiserror::Error)]
pub enum SilError {
    /// The policy image is refused.
    #[error("{0}")]
    Policy(PolicyError),
    /// A controller refuses its configuration.
    #[error("{0}")]
    Config(ConfigError),
    /// The plant has no modules, or more than fit on a bus.
    #[error("{0} modules cannot be simulated: a robot has 1 to {MAX_MODULES}")]
    Modules(usize),
    /// The bit rates make no sense.
    #[error(
        "bit rates of {nominal} and {data} bit/s cannot be: the nominal rate is 10000 to 1000000, the data rate at least as much and at most 8000000"
    )]
    Rates {
        /// Nominal bit rate, bit/s.
        nominal: u32,
        /// Data bit rate, bit/s.
        data: u32,
    },
    /// The frames of a control cycle take longer than a module waits for them: those farthest from the head would never be heard.
    #[error(
        "{modules} modules do not fit on this bus: the frames of a control cycle take {} ms, and a module waits {} ms for them; {most} modules fit{instead}",
        .needed_us / 1000, .waited_us / 1000
    )]
    Crowded {
        /// Modules of the robot.
        modules: usize,
        /// Modules that fit.
        most: usize,
        /// Time of the frames of a cycle, us.
        needed_us: u64,
        /// Time after which a module acts on what it has, us ([`Timing::collect_deadline_us`]).
        waited_us: u64,
        /// What has more room, if anything has.
        instead: &'static str,
    },
    /// The plant's step is zero.
    #[error("the plant's step is 0 ns, but must be at least 1")]
    Step,
    /// The computer of a module failed.
    #[error("module {module}: {error}")]
    Computer {
        /// Which module.
        module: usize,
        /// Why.
        error: Trouble,
    },
    /// What is to be written down of the run cannot be.
    #[error("what is to be written down cannot be written: {0}")]
    Capture(#[from] io::Error),
}
