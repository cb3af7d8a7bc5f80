//! A run that goes on as far as somebody wants it to, who may look at it and change it in between.

use std::io;

use composer_firmware::controller::BusKind;
use composer_shared::policy::Policy;
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::Frame;

use super::{Change, CycleView, Engine, Outside, Refusal, SilConfig, SilError, SilReport, Turn, cycle_us, timing_of};
use crate::bus::{self, Event};
use crate::computer::Launcher;
use crate::frame_bits::BitRates;
use crate::plant::Plant;

/// Looks at a run while it goes on. An error ends the run.
pub trait Watch<P: ?Sized> {
    /// A frame has been on the wire, on the piece of cable of this number from the head end.
    fn frame(&mut self, _at_ns: u64, _piece: usize, _frame: &Frame) -> io::Result<()> {
        Ok(())
    }

    /// The end of a control cycle, and of the run.
    fn cycle(&mut self, _view: &CycleView<'_>, _plant: &P) -> io::Result<()> {
        Ok(())
    }
}

/// Nobody looks.
impl<P: ?Sized> Watch<P> for () {}

/// A plant, its controllers and their bus, at some moment of a run.
///
/// It goes on by [`advance`](Simulation::advance) and is the same run, bit for bit, however often it stops on the way. What is to happen can be
/// planned ([`SilConfig::faults`]), or be done between two calls ([`Simulation::change`]).
pub struct Simulation<'p, P, L: Launcher> {
    engine: Engine<'p, L>,
    plant: P,
    step_ns: u64,
    period_ns: u64,
    next_step: u64,
    next_view: u64,
    cycle: u32,
    now: u64,
}

/// Refuses more modules than the bus has room for.
fn check_room(config: &SilConfig, policy: &Policy<'_>, modules: usize) -> Result<(), SilError> {
    let room = |modules: usize| {
        let waited_us = u64::from(timing_of(config, policy, modules).collect_deadline_us);
        let points = usize::from(policy.task().points(modules as u8));
        (cycle_us(config.bus, config.rates, modules, points), waited_us)
    };
    let fits = |modules: usize| {
        let (needed, waited) = room(modules);
        needed <= waited
    };
    if fits(modules) {
        return Ok(());
    }
    let most = (1..modules).rev().find(|modules| fits(*modules)).unwrap_or(0);
    let (needed_us, waited_us) = room(modules);
    let instead = if config.bus == BusKind::Classic { ", or more on CAN-FD" } else { "" };
    Err(SilError::Crowded { modules, most, needed_us, waited_us, instead })
}

impl<'p, P: Plant, L: Launcher> Simulation<'p, P, L> {
    /// A run of `plant` at time 0: all modules have this policy, `launcher` makes their computers.
    ///
    /// # Errors
    ///
    /// If the configuration makes no sense, or a computer cannot be started.
    pub fn new(launcher: L, plant: P, policy: Policy<'p>, config: SilConfig) -> Result<Self, SilError> {
        Self::with_nodes(launcher, plant, policy, config, 0)
    }

    /// The same, with so many nodes that somebody outside plays.
    pub(super) fn with_nodes(
        launcher: L,
        plant: P,
        policy: Policy<'p>,
        config: SilConfig,
        outside: usize,
    ) -> Result<Self, SilError> {
        let count = plant.modules();
        if count == 0 || count > MAX_MODULES {
            return Err(SilError::Modules(count));
        }
        let BitRates { nominal, data } = config.rates;
        if !(10_000..=1_000_000).contains(&nominal) || !(nominal..=8_000_000).contains(&data) {
            return Err(SilError::Rates { nominal, data });
        }
        check_room(&config, &policy, count)?;
        let step_ns = plant.step_ns();
        if step_ns == 0 {
            return Err(SilError::Step);
        }
        let engine = Engine::new(config, launcher, policy, count, outside)?;
        let period_ns = u64::from(engine.timing().period_us) * 1000;
        Ok(Simulation { engine, plant, step_ns, period_ns, next_step: step_ns, next_view: period_ns, cycle: 0, now: 0 })
    }

    /// The time, ns.
    pub fn now_ns(&self) -> u64 {
        self.now
    }

    /// Length of a control cycle, ns.
    pub fn period_ns(&self) -> u64 {
        self.period_ns
    }

    /// The plant.
    pub fn plant(&self) -> &P {
        &self.plant
    }

    /// Whether it is over: the plant is done, or [`SilConfig::limit_ns`] is reached.
    pub fn over(&self) -> bool {
        self.plant.done() || self.now >= self.engine.config.limit_ns
    }

    /// Goes on for so long, ns, or until it is over.
    ///
    /// # Errors
    ///
    /// If a module's computer fails.
    pub fn advance(&mut self, ns: u64) -> Result<(), SilError> {
        self.advance_watched(ns, &mut ())
    }

    /// The same while somebody looks.
    ///
    /// # Errors
    ///
    /// If a module's computer fails, or whoever looks has an error.
    pub fn advance_watched(&mut self, ns: u64, watch: &mut dyn Watch<P>) -> Result<(), SilError> {
        let until = self.now.saturating_add(ns);
        while self.now < until && !self.over() {
            self.step(self.next_ns().min(until), None, watch)?;
        }
        Ok(())
    }

    /// Goes on for so many control cycles, or until it is over.
    ///
    /// # Errors
    ///
    /// If a module's computer fails.
    pub fn advance_cycles(&mut self, cycles: u32) -> Result<(), SilError> {
        self.advance(u64::from(cycles) * self.period_ns)
    }

    /// Goes on until it is over or somebody outside ends it.
    pub(super) fn run<W: Plant + ?Sized>(
        &mut self,
        mut outside: Option<&mut dyn Outside>,
        watch: &mut dyn Watch<W>,
    ) -> Result<(), SilError>
    where
        P: std::borrow::Borrow<W>,
    {
        while !self.over() {
            let mut next = self.next_ns();
            if let Some(outside) = &mut outside {
                match outside.wait(self.now, next) {
                    Turn::GoOn => {}
                    Turn::Send { node, at_ns, frame } => {
                        next = at_ns.clamp(self.now, next);
                        self.engine.enqueue_outside(node, frame);
                    }
                    Turn::Change(change) => {
                        let outcome = self.change(change)?;
                        outside.changed(self.now, outcome);
                        continue;
                    }
                    Turn::End => break,
                }
            }
            self.step(next, outside.as_deref_mut().map(|outside| outside as _), watch)?;
        }
        Ok(())
    }

    /// Something changes now. Gives the reason if it cannot.
    ///
    /// # Errors
    ///
    /// If a module's computer fails.
    pub fn change(&mut self, change: Change) -> Result<Result<(), Refusal>, SilError> {
        self.engine.change(&mut self.plant, change, self.now)
    }

    /// What the robot is at now.
    ///
    /// # Errors
    ///
    /// If a module's computer fails.
    pub fn look<R>(&mut self, look: impl FnOnce(&CycleView<'_>) -> R) -> Result<R, SilError> {
        let (mut look, mut seen) = (Some(look), None);
        self.engine.view(self.cycle, self.now, &mut |view| {
            seen = look.take().map(|look| look(view));
            Ok(())
        })?;
        seen.ok_or_else(|| SilError::Capture(io::ErrorKind::Other.into()))
    }

    /// What it was like so far.
    ///
    /// # Errors
    ///
    /// If a module's computer fails.
    pub fn report(&mut self) -> Result<SilReport, SilError> {
        self.engine.report(self.now, !self.plant.done())
    }

    /// When something happens next, ns.
    fn next_ns(&self) -> u64 {
        self.engine.next_ns().min(self.next_step).min(self.engine.config.limit_ns)
    }

    /// Does what is to be done at `now`, before which nothing is.
    fn step<W: ?Sized>(
        &mut self,
        now: u64,
        mut outside: Option<&mut dyn Outside>,
        watch: &mut dyn Watch<W>,
    ) -> Result<(), SilError>
    where
        P: std::borrow::Borrow<W>,
    {
        let Simulation { engine, plant, .. } = self;
        self.now = now;
        engine.change_faults(plant, now)?;
        if self.next_step <= now {
            plant.step();
            engine.apply_torques(plant, now);
            self.next_step += self.step_ns;
            if now >= self.next_view || plant.done() {
                engine.view(self.cycle, now, &mut |view| watch.cycle(view, (*plant).borrow()))?;
                self.cycle += 1;
                self.next_view += self.period_ns;
                if plant.done() {
                    return Ok(());
                }
            }
        }
        engine.send_scripted(now);
        engine.press_stop_inputs(now)?;
        engine.send_outside(now);
        engine.poll_ports(now);
        while let Some(event) = engine.bus.poll(now) {
            if let (Some(outside), Event::Delivered { frame, receivers, .. }) = (&mut outside, &event) {
                let first = engine.outside_node;
                bus::nodes(*receivers).filter(|node| *node >= first).for_each(|node| outside.hear(node - first, frame));
            }
            engine.handle(plant, &event, watch)?;
        }
        engine.poll_due(plant, now)
    }
}
