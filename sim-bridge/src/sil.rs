//! Software in the loop: complete module controllers on the simulated bus, controlling a [`Plant`].
//!
//! One discrete-event loop in virtual time (ns) joins the plant, which advances in its own steps, one firmware controller a module
//! ([`run`]: in this process; [`run_on`]: on any [computer](crate::computer)),
//! the ground station and the [`Bus`] between them. At time 0 the first SYNC is sent: the controllers were switched on so much earlier that the
//! head takes the time over just then. So control cycle c covers the same time as control step c of an environment without a bus. The station has armed
//! them by then; it does so once a second from then on, for those that are plugged in later.
//!
//! - Sensors are sampled from the plant's state after its last whole step.
//! - A torque that a controller has computed at time t acts from the first plant step that begins at t or later, never before.
//! - Computing takes time: [`SilConfig::encode_latency_us`] from the last STATE needed until LATENT is ready to be sent,
//!   [`SilConfig::act_latency_us`] from the last LATENT needed until the torque is at the motor. Meanwhile received frames wait.
//!   A stop does not wait: it takes the torque by an interrupt, in [`WITHIN_US`] ([`composer_firmware::torque_off`]).
//! - Modules and station send and receive through a [`Port`], which is the board's.
//! - An unplugged module is gone: no controller, no torque from the next plant step on. Plugged in again, a fresh controller starts. One whose supply broke
//!   in knows what it kept ([`Retained`]), and waits for somebody to acknowledge that.
//!   A module whose computer somebody else takes away is unplugged too, until a fault unplugs it and it is plugged in again.
//! - With a dead actuator the plant gets no torque, whatever the controller says; with a zeroed sensor the controller reads
//!   [`Sensors::ZERO`], with a stuck one always the same sample.
//!
//! The line is the station, then the modules from the head to the tail (the station elsewhere with [`SilConfig::station_behind`]), then the station's second port
//! ([`SilConfig::ring`]), then, only if there are frames to inject, a foreign node, then the nodes that somebody [`Outside`] plays. Without those everything follows from the plant, the policy image and the configuration: the same
//! ones give the same run, bit for bit.

mod change;
mod config;
mod outside;
mod report;
mod simulation;

use std::collections::VecDeque;
use std::io::{self, Write};

use composer_firmware::budget::step_us;
use composer_firmware::controller::{
    Boot, BusKind, BusOffPolicy, BusStatus, Config, FaultSet, Micros, ResetCause, Retained, Stats, Timing,
};
use composer_firmware::port::CanPort;
use composer_firmware::torque_off::{Interrupt, WITHIN_US};
use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::{AXES, MAX_MODULES};
use composer_shared::wire::{Frame, Function, Mode, STATION, StopCommand};

use crate::bus::{self, Bus, BusConfig, Disturbance, Event};
use crate::candump;
use crate::computer::{Computer, InProcess, Launcher, Poll, Trouble};
use crate::faults::Fault;
use crate::plant::Plant;
use crate::port::Port;
use crate::ring::{Ring, Side};
use crate::station::Station;

pub use change::{Change, Refusal};
pub use config::{Clock, Injected, SilConfig, SilError, cycle_us};
pub use outside::{Outside, Turn};
pub use report::{CycleView, Lost, ModuleReport, ModuleView, SilReport};
pub use simulation::{Simulation, Watch};

const NEVER: u64 = u64::MAX;
/// How long before time 0 the station arms the robot, us.
const BEFORE_US: u64 = 1_000;

/// Frames that may wait for a mailbox of a node [`Outside`]; more are lost, as in an adapter.
const OUTSIDE_QUEUE: usize = 1024;

#[derive(Clone, Copy, Debug, Default, PartialEq)]
enum SensorState {
    #[default]
    Good,
    Zeroed,
    Stuck(Sensors),
}

struct Module<C> {
    controller: Option<C>,
    /// Somebody else took the controller away: it does not come back by itself.
    lost: bool,
    /// What the controller that is gone kept for the next one, if only its supply broke in.
    kept: Option<Retained>,
    clock: Clock,
    port: Port,
    next_poll_ns: u64,
    /// It computes until then.
    busy_until_ns: u64,
    /// What the controller answered last.
    commanded: [f32; AXES],
    /// Torques on their way to the motor, with their times.
    coming: VecDeque<(u64, [f32; AXES])>,
    /// What the controller's motors do now.
    motor: [f32; AXES],
    /// What the plant was told.
    applied: Option<[f32; AXES]>,
    sensors: SensorState,
    actuator_dead: bool,
    babble: Option<u16>,
    misread: f64,
    /// What the plant's sensors read in this plant step.
    sample: Option<Sensors>,
    acted: u32,
    acted_ns: u64,
    longest_gap_ns: u64,
    /// Counters of controllers that are gone.
    past: Stats,
}

fn add(past: &Stats, now: &Stats) -> Stats {
    let sum = u32::saturating_add;
    Stats {
        cycles: sum(past.cycles, now.cycles),
        acted: sum(past.acted, now.acted),
        deadline_misses: sum(past.deadline_misses, now.deadline_misses),
        latent_age_us: now.latent_age_us,
        latent_age_max_us: past.latent_age_max_us.max(now.latent_age_max_us),
        malformed: sum(past.malformed, now.malformed),
        foreign: sum(past.foreign, now.foreign),
        stale: sum(past.stale, now.stale),
        takeovers: sum(past.takeovers, now.takeovers),
        without_sync: sum(past.without_sync, now.without_sync),
    }
}

fn timing_of(config: &SilConfig, policy: &Policy<'_>, modules: usize) -> Timing {
    config.timing.unwrap_or_else(|| Timing::for_policy(policy, config.bus, modules.max(1) as u8))
}

/// The station's second port.
struct Far {
    node: usize,
    port: Port,
    ring: Ring,
}

struct Engine<'c, L: Launcher> {
    config: SilConfig,
    policy: Policy<'c>,
    launcher: L,
    bus: Bus,
    station: Station,
    /// GOAL frames of this cycle that wait for room in the station's CAN port.
    telling: VecDeque<Frame>,
    station_port: Port,
    station_node: usize,
    /// The station's second port, if it has one.
    far: Option<Far>,
    foreign_node: usize,
    act_latency_ns: u64,
    modules: Vec<Module<L::Computer>>,
    lost: Vec<Lost>,
    /// What starts (`true`) and ends, in order of time; `next_change` is the first that has not.
    changes: Vec<(u64, bool, Fault)>,
    next_change: usize,
    active: Vec<Fault>,
    next_command: usize,
    next_press: usize,
    next_injected: usize,
    /// The first of the nodes that somebody outside plays.
    outside_node: usize,
    /// Their frames that wait for a mailbox.
    outside_waiting: VecDeque<(usize, Frame)>,
    /// The earliest of the modules' next polls.
    next_poll_ns: u64,
}

/// Runs an episode with the controllers in this process: from now until the plant is done.
///
/// `image` is the policy image of all modules. `capture` gets a candump log: interface `can0` is the piece of cable at the head end, `can1` the
/// next one after a cut, and so on. `observer` is called at the end of each control cycle, and at the end of the run.
pub fn run<P: Plant + ?Sized>(
    plant: &mut P,
    image: &[u8],
    config: &SilConfig,
    capture: Option<&mut dyn Write>,
    observer: &mut dyn FnMut(&CycleView<'_>, &P),
) -> Result<SilReport, SilError> {
    let policy = Policy::parse(image).map_err(SilError::Policy)?;
    run_on(&InProcess::new(policy), plant, policy, config, capture, observer)
}

/// The same with controllers that `launcher` starts, all with this policy.
pub fn run_on<P: Plant + ?Sized, L: Launcher>(
    launcher: &L,
    plant: &mut P,
    policy: Policy<'_>,
    config: &SilConfig,
    capture: Option<&mut dyn Write>,
    observer: &mut dyn FnMut(&CycleView<'_>, &P),
) -> Result<SilReport, SilError> {
    run_with(launcher, plant, policy, config, None, capture, observer)
}

/// The same with somebody outside who takes part, until the plant is done or they end it.
pub fn run_with<P: Plant + ?Sized, L: Launcher>(
    launcher: &L,
    plant: &mut P,
    policy: Policy<'_>,
    config: &SilConfig,
    outside: Option<&mut dyn Outside>,
    capture: Option<&mut dyn Write>,
    observer: &mut dyn FnMut(&CycleView<'_>, &P),
) -> Result<SilReport, SilError> {
    let mut watch = Observed { capture, observer };
    run_watched(launcher, plant, policy, config, outside, &mut watch)
}

/// The same with somebody who looks at more than the ends of the cycles.
pub fn run_watched<P: Plant + ?Sized, L: Launcher>(
    launcher: &L,
    plant: &mut P,
    policy: Policy<'_>,
    config: &SilConfig,
    outside: Option<&mut dyn Outside>,
    watch: &mut dyn Watch<P>,
) -> Result<SilReport, SilError> {
    let nodes = outside.as_ref().map_or(0, |outside| outside.nodes());
    let mut simulation = Simulation::with_nodes(launcher, plant, policy, config.clone(), nodes)?;
    simulation.run(outside, watch)?;
    simulation.report()
}

/// A candump log, and somebody who looks at every cycle.
struct Observed<'a, 'b, P: ?Sized> {
    capture: Option<&'a mut dyn Write>,
    observer: &'b mut dyn FnMut(&CycleView<'_>, &P),
}

impl<P: ?Sized> Watch<P> for Observed<'_, '_, P> {
    fn frame(&mut self, at_ns: u64, piece: usize, frame: &Frame) -> io::Result<()> {
        match &mut self.capture {
            Some(out) => candump::write_entry(*out, at_ns, &candump::interface(piece), frame),
            None => Ok(()),
        }
    }

    fn cycle(&mut self, view: &CycleView<'_>, plant: &P) -> io::Result<()> {
        (self.observer)(view, plant);
        Ok(())
    }
}

impl<'c, L: Launcher> Engine<'c, L> {
    fn new(config: SilConfig, launcher: L, policy: Policy<'c>, count: usize, outside: usize) -> Result<Self, SilError> {
        let period = u64::from(timing_of(&config, &policy, count).period_us);
        let ring = config.station && config.ring;
        let far = ring.then(|| Far { node: count + 1, port: Port::new(period), ring: Ring::new() });
        let foreign_node = count + 1 + usize::from(ring);
        let outside_node = foreign_node + usize::from(!config.injected.is_empty());
        let nodes = outside_node + outside;
        let bus_config = BusConfig { rates: config.rates, automatic_recovery: config.bus_off == BusOffPolicy::Recover };
        let mut changes = Vec::new();
        for scheduled in &config.faults {
            changes.push((scheduled.at_ns, true, scheduled.fault));
            changes.extend(scheduled.until_ns.map(|until| (until, false, scheduled.fault)));
        }
        changes.sort_by_key(|change| change.0);
        let act_latency_us = config.act_latency_us.map_or(step_us(count as u8, policy.shape().memory > 0), u64::from);
        let mut engine = Engine {
            policy,
            launcher,
            bus: Bus::new(bus_config, nodes, config.seed),
            station: Station::new(config.bus == BusKind::Fd, policy.task().points(count as u8)),
            telling: VecDeque::new(),
            station_port: Port::new(period),
            station_node: config.station_behind.min(count),
            far,
            foreign_node,
            modules: Vec::with_capacity(count),
            lost: Vec::new(),
            changes,
            next_change: 0,
            active: Vec::new(),
            next_command: 0,
            next_press: 0,
            next_injected: 0,
            outside_node,
            outside_waiting: VecDeque::new(),
            next_poll_ns: 0,
            act_latency_ns: 1000 * act_latency_us,
            config,
        };
        if !engine.config.station {
            engine.bus.unplug(0, engine.station_node);
        }
        for module in 0..count {
            engine.modules.push(Module {
                controller: None,
                lost: false,
                kept: None,
                clock: engine.config.clock(module),
                port: Port::new(period),
                next_poll_ns: 0,
                busy_until_ns: 0,
                commanded: [0.0; AXES],
                coming: VecDeque::new(),
                motor: [0.0; AXES],
                applied: None,
                sensors: SensorState::Good,
                actuator_dead: false,
                babble: None,
                misread: 0.0,
                sample: None,
                acted: 0,
                acted_ns: 0,
                longest_gap_ns: 0,
                past: Stats::default(),
            });
        }
        // Switched on so long ago that the head, which hears nobody, takes the time over at 0.
        let timing = engine.timing();
        let wait =
            u64::from(timing.takeover_periods) * u64::from(timing.period_us) + u64::from(timing.takeover_stagger_us);
        for module in 0..count {
            let started = engine.modules[module].clock.offset_us;
            engine.modules[module].clock.offset_us += wait;
            let controller = engine.start(module, Boot::default(), started)?;
            engine.modules[module].controller = Some(controller);
        }
        if engine.config.station {
            engine.arm_before_the_start()?;
        }
        Ok(engine)
    }

    /// The station arms the robot a moment before time 0. That is not seen on the bus, and takes no time of the run.
    fn arm_before_the_start(&mut self) -> Result<(), SilError> {
        let arm = self.station.arm(false);
        for module in 0..self.modules.len() {
            let state = &mut self.modules[module];
            let now = state.clock.offset_us.saturating_sub(BEFORE_US);
            let Some(controller) = &mut state.controller else { continue };
            let poll = Poll { now, sensors: &Sensors::ZERO, frame: Some(&arm), bus: BusStatus::ErrorActive, room: 1 };
            let mut arm = || {
                controller.ask_poll(&poll)?;
                controller.answer()?;
                // Its answer.
                controller.next_frame(1)
            };
            if let Err(trouble) = arm() {
                self.lose(module, 0, trouble)?;
            }
        }
        Ok(())
    }

    fn start(&self, module: usize, boot: Boot, now: Micros) -> Result<L::Computer, SilError> {
        let config = &self.config;
        let node = config.numbers.get(module).copied().unwrap_or(module as u8);
        let mut setup = Config::new(node, self.modules.len() as u8, config.bus, &self.policy);
        setup.bus_off = config.bus_off;
        setup.safety = config.safety;
        setup.timing = config.timing.unwrap_or(setup.timing);
        self.launcher.start(setup, boot, now).map_err(|trouble| match trouble {
            Trouble::Config(error) => SilError::Config(error),
            error => SilError::Computer { module, error },
        })
    }

    fn timing(&self) -> Timing {
        timing_of(&self.config, &self.policy, self.modules.len())
    }

    /// The node of a module, by its place in the line.
    fn node(&self, module: usize) -> usize {
        module + usize::from(module >= self.station_node)
    }

    /// The module at a node, if it is one.
    fn module(&self, node: usize) -> Option<usize> {
        if node == self.station_node {
            return None;
        }
        Some(node - usize::from(node > self.station_node)).filter(|module| *module < self.modules.len())
    }

    /// When something happens next, the plant apart.
    fn next_ns(&self) -> u64 {
        let change = self.changes.get(self.next_change).map_or(NEVER, |change| change.0);
        let command = self.config.commands.get(self.next_command).map_or(NEVER, |command| command.0);
        let press = self.config.presses.get(self.next_press).map_or(NEVER, |press| press.0);
        let injected = self.config.injected.get(self.next_injected).filter(|_| self.bus.has_room(self.foreign_node));
        let injected = injected.map_or(NEVER, |injected| injected.at_ns);
        let far = self.far.as_ref().map_or(NEVER, |far| far.port.next_ns());
        let ports = self
            .modules
            .iter()
            .fold(self.station_port.next_ns().min(far), |next, state| next.min(state.port.next_ns()));
        change.min(command).min(press).min(injected).min(self.next_poll_ns).min(ports).min(self.bus.next_event_ns())
    }

    /// Starts and ends faults.
    fn change_faults<P: Plant + ?Sized>(&mut self, plant: &P, now: u64) -> Result<(), SilError> {
        let mut changed = false;
        while let Some(&(at, starts, fault)) = self.changes.get(self.next_change)
            && at <= now
        {
            self.next_change += 1;
            changed = true;
            if starts {
                self.active.push(fault);
            } else if let Some(index) = self.active.iter().position(|active| *active == fault) {
                self.active.remove(index);
            }
        }
        if changed { self.obey_faults(plant, now) } else { Ok(()) }
    }

    /// Makes bus and modules as the active faults have them.
    fn obey_faults<P: Plant + ?Sized>(&mut self, plant: &P, now: u64) -> Result<(), SilError> {
        let either = |p: f64, q: f64| 1.0 - (1.0 - p) * (1.0 - q);
        let mut disturbance = Disturbance::default();
        let mut cuts = 0u64;
        for fault in &self.active {
            match *fault {
                Fault::Drop(p) => disturbance.drop = either(disturbance.drop, p),
                Fault::Delay(ns) => disturbance.delay_ns = disturbance.delay_ns.max(ns),
                Fault::Corrupt(p) => disturbance.corrupt = either(disturbance.corrupt, p),
                Fault::Duplicate(p) => disturbance.duplicate = either(disturbance.duplicate, p),
                Fault::Cut(module) => cuts |= 1u64.checked_shl(module as u32).unwrap_or(0),
                _ => {}
            }
        }
        self.bus.set_disturbance(disturbance);
        for module in 0..self.modules.len().saturating_sub(1) {
            let node = self.node(module);
            self.bus.set_cut(now, node, cuts >> module & 1 == 1);
        }
        for module in 0..self.modules.len() {
            self.set_module_faults(plant, module, now)?;
        }
        Ok(())
    }

    fn set_module_faults<P: Plant + ?Sized>(&mut self, plant: &P, module: usize, now: u64) -> Result<(), SilError> {
        let node = self.node(module);
        let mine = |fault: &&Fault| fault.module() == Some(module);
        let has = |wanted: Fault| self.active.contains(&wanted);
        let broken_in = has(Fault::BrownOut(module));
        let unplugged = broken_in || has(Fault::Unplug(module));
        let dead = has(Fault::ActuatorDead(module));
        let zeroed = has(Fault::SensorZeroed(module));
        let stuck = has(Fault::SensorStuck(module));
        let babble = self.active.iter().filter(mine).find_map(|fault| match fault {
            Fault::Babble(_, id) => Some(*id),
            _ => None,
        });
        let misread = self.active.iter().filter(mine).fold(0.0f64, |p, fault| match fault {
            Fault::Misread(_, q) => p.max(*q),
            _ => p,
        });
        let babble = babble.filter(|_| !unplugged);
        let state = &mut self.modules[module];
        state.actuator_dead = dead;
        state.sensors = match state.sensors {
            _ if zeroed => SensorState::Zeroed,
            SensorState::Stuck(sample) if stuck => SensorState::Stuck(sample),
            _ if stuck => SensorState::Stuck(plant.sensors(module)),
            _ => SensorState::Good,
        };
        if state.misread != misread {
            state.misread = misread;
            self.bus.set_misread(node, misread);
        }
        state.lost &= !unplugged;
        if unplugged && state.controller.is_some() {
            self.retire(module)?;
            let state = &mut self.modules[module];
            state.kept = state.controller.as_ref().filter(|_| broken_in).map(|c| c.status().retained);
            self.unplug(module, now);
        } else if !unplugged && state.controller.is_none() && !state.lost {
            self.plug(module, now)?;
        }
        let state = &mut self.modules[module];
        if state.babble != babble {
            state.babble = babble;
            let frame = babble.and_then(|id| Frame::new(id, self.config.bus == BusKind::Fd, &[0x55; 8]));
            if self.config.guard {
                state.port.set_babble(frame);
                self.poll_port(node, now, true);
            } else {
                self.bus.set_babble(now, node, frame);
            }
        }
        Ok(())
    }

    /// Asks for the last time what a module counted, before it is unplugged or the run ends.
    fn retire(&mut self, module: usize) -> Result<(), SilError> {
        let Some(controller) = &mut self.modules[module].controller else { return Ok(()) };
        let asked = controller.ask_status().and_then(|()| controller.await_status());
        match asked {
            // Too late to matter.
            Ok(()) | Err(Trouble::Gone(_)) => Ok(()),
            Err(error) => Err(SilError::Computer { module, error }),
        }
    }

    /// Goes on without a module that somebody else took away; any other trouble ends the run.
    fn lose(&mut self, module: usize, now: u64, trouble: Trouble) -> Result<(), SilError> {
        let Trouble::Gone(how) = trouble else { return Err(SilError::Computer { module, error: trouble }) };
        self.lost.push(Lost { module, at_ns: now, how });
        self.modules[module].lost = true;
        self.unplug(module, now);
        Ok(())
    }

    fn unplug(&mut self, module: usize, now: u64) {
        let node = self.node(module);
        self.bus.unplug(now, node);
        let period = u64::from(self.timing().period_us);
        let state = &mut self.modules[module];
        if let Some(controller) = state.controller.take() {
            state.past = add(&state.past, &controller.status().stats);
        }
        state.longest_gap_ns = state.longest_gap_ns.max(now.saturating_sub(state.acted_ns));
        state.next_poll_ns = NEVER;
        state.port = Port::new(period);
        state.commanded = [0.0; AXES];
        state.coming.clear();
        state.coming.push_back((now, [0.0; AXES]));
        state.babble = None;
    }

    fn plug(&mut self, module: usize, now: u64) -> Result<(), SilError> {
        let node = self.node(module);
        // Their memory outlasts a supply that breaks in; that it does is what tells it from power-on.
        let boot = self.modules[module].kept.take().map(|kept| Boot::after(kept, ResetCause::PowerOn));
        let controller = self.start(module, boot.unwrap_or_default(), self.modules[module].clock.show(now))?;
        let state = &mut self.modules[module];
        state.controller = Some(controller);
        state.next_poll_ns = now;
        state.busy_until_ns = now;
        state.acted = 0;
        state.acted_ns = now;
        self.next_poll_ns = self.next_poll_ns.min(now);
        self.bus.plug(now, node);
        Ok(())
    }

    /// A plant step has ended at `now`; the next begins with these torques.
    fn apply_torques<P: Plant + ?Sized>(&mut self, plant: &mut P, now: u64) {
        for (module, state) in self.modules.iter_mut().enumerate() {
            state.sample = None;
            while let Some(&(at, torque)) = state.coming.front()
                && at <= now
            {
                state.motor = torque;
                state.coming.pop_front();
            }
            let torque = if state.actuator_dead { [0.0; AXES] } else { state.motor };
            if state.applied != Some(torque) {
                state.applied = Some(torque);
                plant.set_torque(module, torque);
            }
        }
    }

    /// Sends what the station and the foreign device have planned.
    fn send_scripted(&mut self, now: u64) {
        while let Some(&(at, command)) = self.config.commands.get(self.next_command)
            && at <= now
        {
            self.next_command += 1;
            self.order(command, now);
        }
        let foreign = self.foreign_node;
        while let Some(injected) = self.config.injected.get(self.next_injected)
            && injected.at_ns <= now
            && self.bus.has_room(foreign)
        {
            self.next_injected += 1;
            let _ = self.bus.send(foreign, &injected.frame, now);
        }
    }

    /// The station stops the robot, or releases it.
    fn order(&mut self, command: StopCommand, now: u64) {
        for frame in self.station.command(command) {
            self.station_port.send_at(&frame, now);
        }
    }

    /// Opens the stop inputs of modules that are on.
    fn press_stop_inputs(&mut self, now: u64) -> Result<(), SilError> {
        while let Some(&(at, module)) = self.config.presses.get(self.next_press)
            && at <= now
        {
            self.next_press += 1;
            if module < self.modules.len() {
                self.interrupt(module, Interrupt::StopInput, now)?;
            }
        }
        Ok(())
    }

    /// Interrupts what a module computes. If its motors coast from then on, no torque that is on its way gets to them.
    fn interrupt(&mut self, module: usize, interrupt: Interrupt<'_>, now: u64) -> Result<(), SilError> {
        let node = self.node(module);
        let state = &mut self.modules[module];
        let Some(controller) = &mut state.controller else { return Ok(()) };
        let (off, told) = match controller.interrupt(interrupt) {
            Ok(done) => done,
            Err(trouble) => return self.lose(module, now, trouble),
        };
        if off {
            let at = now + 1000 * WITHIN_US;
            state.coming.retain(|(ready, _)| *ready < at);
            state.coming.push_back((at, [0.0; AXES]));
            state.commanded = [0.0; AXES];
        }
        if let Some(frame) = told {
            state.port.send_at(&frame, now);
            self.poll_port(node, now, true);
        }
        Ok(())
    }

    /// Takes a frame of a node outside; lost if there is no such node, or too many wait.
    fn enqueue_outside(&mut self, node: usize, frame: Frame) {
        let node = self.outside_node.saturating_add(node);
        if node < self.bus.count() && self.outside_waiting.len() < OUTSIDE_QUEUE {
            self.outside_waiting.push_back((node, frame));
        }
    }

    /// Hands frames of the nodes outside to their CAN ports, as many as fit.
    fn send_outside(&mut self, now: u64) {
        let bus = &mut self.bus;
        self.outside_waiting.retain(|(node, frame)| !bus.has_room(*node) || bus.send(*node, frame, now).is_err());
    }

    /// Goes on with the ports that have something to do.
    fn poll_ports(&mut self, now: u64) {
        for node in 0..self.outside_node {
            self.poll_port(node, now, false);
        }
    }

    /// Goes on with the port of a node, if it is a module's or the station's; without `always` only if it has something to do.
    fn poll_port(&mut self, node: usize, now: u64, always: bool) {
        let port = match self.module(node) {
            Some(module) => &mut self.modules[module].port,
            None if node == self.station_node => &mut self.station_port,
            None => match &mut self.far {
                Some(far) if node == far.node => &mut far.port,
                _ => return,
            },
        };
        if always || port.next_ns() <= now {
            port.at(&mut self.bus, node, now).poll();
        }
    }

    fn handle<P: Plant + ?Sized, W: ?Sized>(
        &mut self,
        plant: &P,
        event: &Event,
        watch: &mut dyn Watch<W>,
    ) -> Result<(), SilError> {
        match event {
            Event::Delivered { at_ns, frame, receivers, segment, late, transmitters } => {
                if !late {
                    watch.frame(*at_ns, self.bus.cuts_before(*segment) as usize, frame)?;
                }
                let mut asked = 0;
                for node in bus::nodes(*receivers) {
                    if let Some(module) = self.module(node) {
                        if frame.function() == Some(Function::EmergencyStop) {
                            self.interrupt(module, Interrupt::Frame(frame), *at_ns)?;
                        }
                        self.modules[module].port.hear(frame);
                        if self.idle(module, *at_ns) {
                            asked |= 1 << module;
                            self.ask(plant, module, *at_ns)?;
                        }
                    }
                }
                for node in bus::nodes(*receivers) {
                    if node == self.station_node {
                        self.tell_station(plant, frame, *at_ns);
                    } else if let Some(module) = self.module(node).filter(|module| asked >> module & 1 == 1) {
                        self.act(module, *at_ns)?;
                    }
                }
                self.join(frame, *receivers, *transmitters, *late, *at_ns);
                if !late {
                    // A slot is free again.
                    for node in bus::nodes(*transmitters) {
                        if node == self.station_node {
                            self.tell(*at_ns);
                        }
                        self.poll_port(node, *at_ns, true);
                    }
                }
            }
            Event::State { at_ns, node, .. } => {
                self.poll_port(*node, *at_ns, true);
                if let Some(module) = self.module(*node)
                    && self.idle(module, *at_ns)
                {
                    self.ask(plant, module, *at_ns)?;
                    self.act(module, *at_ns)?;
                }
            }
            Event::ErrorFrame { at_ns, transmitters, .. } => {
                // What was asked back while it was on the wire is here again.
                bus::nodes(*transmitters).for_each(|node| self.poll_port(node, *at_ns, true));
            }
        }
        Ok(())
    }

    /// What one port of the station heard and the other did not, it may repeat there.
    fn join(&mut self, frame: &Frame, receivers: bus::Nodes, transmitters: bus::Nodes, late: bool, now: u64) {
        let Some(far) = &mut self.far else { return };
        let at = |nodes: bus::Nodes, node: usize| nodes >> node & 1 == 1;
        let sent = if late { 0 } else { transmitters };
        let sides = [(Side::Near, self.station_node), (Side::Far, far.node)];
        let [near, tail] = sides.map(|(_, node)| at(receivers | sent, node));
        let (side, node) = match (near, tail) {
            (true, true) => return far.ring.hear_both(now),
            (true, false) => sides[0],
            (false, true) => sides[1],
            (false, false) => return,
        };
        // What it repeats does not come back; what it says of its own goes to both parts.
        let own = frame.module() == STATION && side == Side::Near;
        if at(sent, node) && !own {
            return;
        }
        if far.ring.hear(side, frame, now) {
            let ready = now + u64::from(self.config.station_latency_us) * 1000;
            match side {
                Side::Near => far.port.send_at(frame, ready),
                Side::Far => self.station_port.send_at(frame, ready),
            }
        }
    }

    /// Whether a module can be polled. If it computes, it is polled when it is done.
    fn idle(&mut self, module: usize, now: u64) -> bool {
        let state = &mut self.modules[module];
        let idle = state.busy_until_ns <= now;
        if !idle {
            state.next_poll_ns = state.next_poll_ns.min(state.busy_until_ns);
            self.next_poll_ns = self.next_poll_ns.min(state.next_poll_ns);
        }
        idle
    }

    fn tell_station<P: Plant + ?Sized>(&mut self, plant: &P, frame: &Frame, now: u64) {
        if let Some(frames) = self.station.receive(frame, |number| plant.point(number)) {
            // What was still to be told of the last cycle is out of date; what of it is in the port, a newer GOAL replaces.
            self.telling = frames;
            self.tell(now + u64::from(self.config.station_latency_us) * 1000);
        }
    }

    /// Hands the station's GOAL frames to its CAN port, as many as fit.
    fn tell(&mut self, ready: u64) {
        while self.station_port.room() > 0
            && let Some(frame) = self.telling.pop_front()
        {
            self.station_port.send_at(&frame, ready);
        }
    }

    fn poll_due<P: Plant + ?Sized>(&mut self, plant: &P, now: u64) -> Result<(), SilError> {
        if self.next_poll_ns > now {
            return Ok(());
        }
        let due = |module: &Module<L::Computer>| module.next_poll_ns <= now;
        for module in 0..self.modules.len() {
            if due(&self.modules[module]) {
                self.ask(plant, module, now)?;
            }
        }
        for module in 0..self.modules.len() {
            if due(&self.modules[module]) {
                self.act(module, now)?;
            }
        }
        self.next_poll_ns = self.modules.iter().map(|state| state.next_poll_ns).min().unwrap_or(NEVER);
        Ok(())
    }

    /// Polls a module, with the next frame that it received. Nothing comes of it before [`Engine::act`], so several can be asked at once.
    fn ask<P: Plant + ?Sized>(&mut self, plant: &P, module: usize, now: u64) -> Result<(), SilError> {
        let node = self.node(module);
        let state = &mut self.modules[module];
        let mut port = state.port.at(&mut self.bus, node, now);
        let (frame, bus, room) = (port.receive(), port.status().bus, port.room());
        let Some(controller) = &mut state.controller else { return Ok(()) };
        let sensors = match &state.sensors {
            SensorState::Good => &*state.sample.get_or_insert_with(|| plant.sensors(module)),
            SensorState::Zeroed => &Sensors::ZERO,
            SensorState::Stuck(sample) => sample,
        };
        let poll = Poll { now: state.clock.show(now), sensors, frame: frame.as_ref(), bus, room };
        match controller.ask_poll(&poll) {
            Ok(()) => Ok(()),
            Err(trouble) => self.lose(module, now, trouble),
        }
    }

    /// What a module that was polled does.
    fn act(&mut self, module: usize, now: u64) -> Result<(), SilError> {
        let state = &mut self.modules[module];
        let Some(controller) = &mut state.controller else { return Ok(()) };
        let answer = match controller.answer() {
            Ok(answer) => answer,
            Err(trouble) => return self.lose(module, now, trouble),
        };
        if self.config.guard {
            state.port.guard(answer.node);
        }
        let acted = answer.acted != state.acted;
        if acted {
            state.acted = answer.acted;
            state.longest_gap_ns = state.longest_gap_ns.max(now - state.acted_ns);
            state.acted_ns = now;
        }
        let outputs = answer.outputs;
        let encoded_ns = self.pump(module, now)?;
        let state = &mut self.modules[module];
        if state.controller.is_none() {
            return Ok(());
        }
        let torque = if outputs.motors_enabled { outputs.torque } else { [0.0; AXES] };
        let ready_ns = encoded_ns + self.act_latency_ns;
        if torque != state.commanded {
            state.commanded = torque;
            state.coming.push_back((ready_ns, torque));
        }
        state.busy_until_ns = if acted { ready_ns } else { encoded_ns };
        let due = state.clock.reaches(outputs.deadline).max(now + 1);
        // A frame that came while it computed is taken as soon as it can be.
        let due = if state.port.has_received() { now } else { due };
        state.next_poll_ns = due.max(state.busy_until_ns);
        self.next_poll_ns = self.next_poll_ns.min(state.next_poll_ns);
        Ok(())
    }

    /// Hands the controller's frames to its CAN port. Returns when what it encoded for them is ready, ns.
    fn pump(&mut self, module: usize, now: u64) -> Result<u64, SilError> {
        let node = self.node(module);
        let encoded_ns = now + u64::from(self.config.encode_latency_us) * 1000;
        let mut ready_ns = now;
        loop {
            let state = &mut self.modules[module];
            let room = state.port.room();
            let Some(controller) = state.controller.as_mut().filter(|_| room > 0) else { break };
            let frame = match controller.next_frame(room) {
                Ok(Some(frame)) => frame,
                Ok(None) => break,
                Err(trouble) => {
                    self.lose(module, now, trouble)?;
                    break;
                }
            };
            let encoded = matches!(frame.function(), Some(Function::Latent | Function::LatentFragment));
            let at = if encoded { encoded_ns } else { now };
            ready_ns = ready_ns.max(at);
            state.port.send_at(&frame, at);
        }
        self.poll_port(node, now, true);
        Ok(ready_ns)
    }

    fn view(
        &mut self,
        cycle: u32,
        at_ns: u64,
        seen: &mut dyn FnMut(&CycleView<'_>) -> io::Result<()>,
    ) -> Result<(), SilError> {
        const NOTHING: &[u16; MAX_MODULES] = &[0; MAX_MODULES];
        self.ask_all(at_ns)?;
        let modules: Vec<ModuleView<'_>> = self
            .modules
            .iter()
            .enumerate()
            .map(|(module, state)| {
                let status = state.controller.as_ref().map(Computer::status);
                let status = status.as_ref();
                ModuleView {
                    plugged: status.is_some(),
                    mode: status.map_or(Mode::Boot, |s| s.mode),
                    cycle: status.map_or(0, |s| s.cycle),
                    time_keeper: status.and_then(|s| s.time_keeper),
                    alive: status.map_or(0, |s| s.alive),
                    heard: status.map_or(0, |s| s.heard),
                    attention: status.map_or(NOTHING, |s| s.attention),
                    torque: state.applied.unwrap_or_default(),
                    faults: status.map_or(FaultSet::EMPTY, |s| s.faults),
                    bus: self.bus.state(self.node(module)),
                }
            })
            .collect();
        let cuts = self.active.iter().fold(0, |set, fault| match fault {
            Fault::Cut(module) => set | 1u64.checked_shl(*module as u32).unwrap_or(0),
            _ => set,
        });
        seen(&CycleView { cycle, at_ns, modules: &modules, cuts, faults: &self.active })?;
        Ok(())
    }

    /// Looks what all modules are at.
    fn ask_all(&mut self, now: u64) -> Result<(), SilError> {
        for answer in [false, true] {
            for module in 0..self.modules.len() {
                let Some(controller) = &mut self.modules[module].controller else { continue };
                let done = if answer { controller.await_status() } else { controller.ask_status() };
                if let Err(trouble) = done {
                    self.lose(module, now, trouble)?;
                }
            }
        }
        Ok(())
    }

    fn report(&mut self, now: u64, cut_short: bool) -> Result<SilReport, SilError> {
        self.ask_all(now)?;
        let modules: Vec<ModuleReport> = self
            .modules
            .iter()
            .enumerate()
            .map(|(module, state)| {
                let last = state.controller.as_ref().map_or(0, |_| now.saturating_sub(state.acted_ns));
                let node = self.node(module);
                ModuleReport {
                    stats: state.controller.as_ref().map_or(state.past, |c| add(&state.past, &c.status().stats)),
                    bus: self.bus.node_stats(node),
                    errors: self.bus.counters(node),
                    port: state.port.counts(),
                    longest_gap_ms: state.longest_gap_ns.max(last) as f64 / 1e6,
                }
            })
            .collect();
        let age = modules.iter().map(|module| module.stats.latent_age_max_us).max().unwrap_or(0);
        let age = if age > 0 { f64::from(age) + self.act_latency_ns as f64 / 1e3 } else { 0.0 };
        let stats = self.bus.stats();
        Ok(SilReport {
            duration_ns: now,
            cycles: modules.iter().map(|module| module.stats.cycles).max().unwrap_or(0),
            bus_load: self.bus.load(now),
            latent_age_max_ms: age / 1e3,
            deadline_misses: modules.iter().map(|module| u64::from(module.stats.deadline_misses)).sum(),
            frames: stats.frames,
            error_frames: stats.error_frames,
            dropped: stats.dropped,
            frame_latency_max_ms: stats.worst_latency_ns as f64 / 1e6,
            faults: self.config.faults.iter().filter(|fault| fault.at_ns <= now).copied().collect(),
            lost: self.lost.clone(),
            cut_short,
            modules,
        })
    }
}

#[cfg(test)]
pub(crate) mod tests;
