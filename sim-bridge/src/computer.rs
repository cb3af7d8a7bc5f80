//! What runs the controller of one module: the simulation's own process, or something at the end of a wire.

use composer_firmware::controller::{Boot, BusStatus, Config, ConfigError, FaultSet, Micros, Outputs, Retained, Stats};
use composer_firmware::emulated::Emulated;
use composer_firmware::node_page::Calibration;
use composer_firmware::torque_off::Interrupt;
use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::{Frame, Mode, NOBODY};

use crate::policy_flash::Policies;

/// Why a computer does not answer.
#[derive(Debug, thiserror::Error)]
pub enum Trouble {
    /// It was taken away by somebody else: a module that was unplugged. The robot goes on without it.
    #[error("{0}")]
    Gone(String),
    /// The configuration is refused.
    #[error("{0}")]
    Config(ConfigError),
    /// It failed: a run with it means nothing.
    #[error(transparent)]
    Failed(Box<dyn std::error::Error + Send + Sync>),
}

/// The inputs of [`Emulated::poll`].
#[derive(Clone, Copy, Debug)]
pub struct Poll<'a> {
    /// The module's clock, us.
    pub now: Micros,
    /// What its sensors read.
    pub sensors: &'a Sensors,
    /// The frame that it received.
    pub frame: Option<&'a Frame>,
    /// How its CAN controller is.
    pub bus: BusStatus,
    /// Frames that its CAN port has room for: so many may be taken after the poll without asking again.
    pub room: usize,
}

/// What a poll came to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Answer {
    /// The outputs.
    pub outputs: Outputs,
    /// How often the controller has acted.
    pub acted: u32,
    /// The module's number; 255 if it is off.
    pub node: u8,
}

/// What a module is at, for whoever looks on.
#[derive(Clone, Copy, Debug)]
pub struct Status<'a> {
    /// What it is at.
    pub mode: Mode,
    /// Number of its control cycle.
    pub cycle: u16,
    /// Whose SYNC it follows.
    pub time_keeper: Option<u8>,
    /// Modules that it believes alive, as a bit mask.
    pub alive: u64,
    /// Modules that it attended over in its last action, as a bit mask.
    pub heard: u64,
    /// Attention weights of its last action by module, Q15.
    pub attention: &'a [u16; MAX_MODULES],
    /// Its active faults.
    pub faults: FaultSet,
    /// Its counters.
    pub stats: Stats,
    /// What it keeps for its next start.
    pub retained: Retained,
}

/// A computer with a module's controller. Asking is apart from waiting for the answer, so that the computers of several modules can work at the
/// same time; each `ask` is followed by its answer before the next.
pub trait Computer {
    /// Begins a poll.
    fn ask_poll(&mut self, poll: &Poll<'_>) -> Result<(), Trouble>;

    /// What that came to.
    fn answer(&mut self) -> Result<Answer, Trouble>;

    /// The next frame to send; `room` of them fit.
    fn next_frame(&mut self, room: usize) -> Result<Option<Frame>, Trouble>;

    /// Something interrupts what it computes. Whether its motors coast now, and what it tells the others at once.
    fn interrupt(&mut self, interrupt: Interrupt<'_>) -> Result<(bool, Option<Frame>), Trouble>;

    /// Begins to look what the module is at.
    fn ask_status(&mut self) -> Result<(), Trouble>;

    /// Waits until that is known.
    fn await_status(&mut self) -> Result<(), Trouble>;

    /// What the module was at when it was last asked.
    fn status(&self) -> Status<'_>;
}

/// Switches computers on.
pub trait Launcher {
    /// What it switches on.
    type Computer: Computer;

    /// A controller with this configuration begins at `now` of its own clock, and so did its start come about.
    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Self::Computer, Trouble>;
}

impl<L: Launcher> Launcher for &L {
    type Computer = L::Computer;

    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Self::Computer, Trouble> {
        (**self).start(config, boot, now)
    }
}

/// Modules in this process.
#[derive(Clone, Debug)]
pub struct InProcess<'a> {
    policy: Policy<'a>,
    mounted: Vec<Calibration>,
}

impl<'a> InProcess<'a> {
    /// Modules with this policy.
    pub fn new(policy: Policy<'a>) -> Self {
        InProcess { policy, mounted: Vec::new() }
    }

    /// The same with hardware that is mounted like this, by number; modules beyond the list have the nominal one. Their first node pages say so.
    pub fn mounted(self, mounted: Vec<Calibration>) -> Self {
        InProcess { mounted, ..self }
    }
}

impl<'a> Launcher for InProcess<'a> {
    type Computer = Local<'a>;

    fn start(&self, config: Config, boot: Boot, now: Micros) -> Result<Local<'a>, Trouble> {
        let mut module = Emulated::new(self.policy, Policies::default());
        let mounted = self.mounted.get(usize::from(config.node)).copied().unwrap_or(Calibration::NOMINAL);
        module.start(config, boot, now, mounted).map_err(Trouble::Config)?;
        let outputs = Outputs { torque: Default::default(), motors_enabled: false, deadline: now };
        Ok(Local { module, outputs })
    }
}

/// A module in this process.
#[derive(Debug)]
pub struct Local<'a> {
    module: Emulated<'a, Policies>,
    outputs: Outputs,
}

impl<'a> Local<'a> {
    /// The module.
    pub fn module(&mut self) -> &mut Emulated<'a, Policies> {
        &mut self.module
    }
}

impl Computer for Local<'_> {
    fn ask_poll(&mut self, poll: &Poll<'_>) -> Result<(), Trouble> {
        self.outputs = self.module.poll(poll.now, poll.sensors, poll.frame, poll.bus);
        Ok(())
    }

    fn answer(&mut self) -> Result<Answer, Trouble> {
        let controller = self.module.controller();
        let acted = controller.map_or(0, |controller| controller.stats().acted);
        let node = controller.map_or(NOBODY, |controller| controller.config().node);
        Ok(Answer { outputs: self.outputs, acted, node })
    }

    fn next_frame(&mut self, _room: usize) -> Result<Option<Frame>, Trouble> {
        Ok(self.module.next_frame())
    }

    fn interrupt(&mut self, interrupt: Interrupt<'_>) -> Result<(bool, Option<Frame>), Trouble> {
        Ok(self.module.interrupt(interrupt))
    }

    fn ask_status(&mut self) -> Result<(), Trouble> {
        Ok(())
    }

    fn await_status(&mut self) -> Result<(), Trouble> {
        Ok(())
    }

    fn status(&self) -> Status<'_> {
        const NOTHING: &[u16; MAX_MODULES] = &[0; MAX_MODULES];
        let Some(controller) = self.module.controller() else {
            return Status {
                mode: Mode::Boot,
                cycle: 0,
                time_keeper: None,
                alive: 0,
                heard: 0,
                attention: NOTHING,
                faults: FaultSet::EMPTY,
                stats: Stats::default(),
                retained: Retained::default(),
            };
        };
        Status {
            mode: controller.mode(),
            cycle: controller.cycle(),
            time_keeper: controller.time_keeper(),
            alive: controller.alive(),
            heard: controller.heard(),
            attention: controller.attention(),
            faults: controller.faults(),
            stats: *controller.stats(),
            retained: controller.retained(),
        }
    }
}
