//! What is seen of a run while it goes on, and what it was like.

use composer_firmware::controller::{FaultSet, Stats};
use composer_firmware::port::Counts;
use composer_shared::robot::{AXES, MAX_MODULES};
use composer_shared::wire::Mode;

use crate::bus;
use crate::confinement::{ErrorCounters, ErrorState};
use crate::faults::{Fault, ScheduledFault};

/// One module at the end of a control cycle.
#[derive(Clone, Copy, Debug)]
pub struct ModuleView<'a> {
    /// Whether it is plugged in. If not, all else is empty.
    pub plugged: bool,
    /// What it is at.
    pub mode: Mode,
    /// Number of its control cycle.
    pub cycle: u16,
    /// Whose SYNC it follows.
    pub time_keeper: Option<u8>,
    /// Modules that it believes alive, itself included, as a bit mask.
    pub alive: u64,
    /// Modules that it attended over in its last action, itself included, as a bit mask.
    pub heard: u64,
    /// Attention weights of its last action by module, Q15 (32767 is 1).
    pub attention: &'a [u16; MAX_MODULES],
    /// The torque that the plant applies (yaw, pitch).
    pub torque: [f32; AXES],
    /// Its active faults.
    pub faults: FaultSet,
    /// Its error state on the bus.
    pub bus: ErrorState,
}

/// The robot at the end of a control cycle.
#[derive(Clone, Debug)]
pub struct CycleView<'a> {
    /// Number of the cycle, from 0, by true time.
    pub cycle: u32,
    /// Its end, ns.
    pub at_ns: u64,
    /// The modules, head first.
    pub modules: &'a [ModuleView<'a>],
    /// Modules behind which the cable is cut, as a bit mask.
    pub cuts: u64,
    /// What is wrong now.
    pub faults: &'a [Fault],
}

impl CycleView<'_> {
    /// The modules that are plugged in, by the pieces of cable that they hang on, head first.
    pub fn pieces(&self) -> Vec<Vec<usize>> {
        let mut pieces = vec![Vec::new()];
        for (number, module) in self.modules.iter().enumerate() {
            if let Some(piece) = pieces.last_mut().filter(|_| module.plugged) {
                piece.push(number);
            }
            if self.cuts & 1 << number != 0 {
                pieces.push(Vec::new());
            }
        }
        pieces
    }
}

/// What became of one module.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ModuleReport {
    /// Its controller's counters, added up if it was plugged in again.
    pub stats: Stats,
    /// Its counters on the bus.
    pub bus: bus::NodeStats,
    /// Its error counters at the end.
    pub errors: ErrorCounters,
    /// What happened at its CAN port while it was plugged in last.
    pub port: Counts,
    /// Longest time between two actions while plugged in, ms. From its start to its first action counts too, and from its
    /// last to the end.
    pub longest_gap_ms: f64,
}

/// A module that was lost though no fault of the plan took it: somebody else ended its computer.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Lost {
    /// Which module.
    pub module: usize,
    /// When it was noticed, ns.
    pub at_ns: u64,
    /// What happened.
    pub how: String,
}

/// What a run was like.
#[derive(Clone, Debug, PartialEq)]
pub struct SilReport {
    /// Length, ns of virtual time.
    pub duration_ns: u64,
    /// Control cycles that the module with the most of them started.
    pub cycles: u32,
    /// Share of the time in which the bus was busy, 0 to 1.
    pub bus_load: f64,
    /// Largest age of a latent when it was acted on, from the start of its cycle to the torque at the motor, ms.
    pub latent_age_max_ms: f64,
    /// Cycles in which a live neighbour's latent was missing when a module acted, over all modules.
    pub deadline_misses: u64,
    /// Frames sent successfully.
    pub frames: u64,
    /// Error frames.
    pub error_frames: u64,
    /// Frames lost at receivers.
    pub dropped: u64,
    /// Longest time from a frame being ready to its reception, ms.
    pub frame_latency_max_ms: f64,
    /// The faults that occurred.
    pub faults: Vec<ScheduledFault>,
    /// Modules that somebody else took away; never any in the own process.
    pub lost: Vec<Lost>,
    /// Whether the run ended by [`super::SilConfig::limit_ns`] instead of the plant being done.
    pub cut_short: bool,
    /// The modules, head first.
    pub modules: Vec<ModuleReport>,
}
