//! A campaign: seeded random schedules of everything that can go wrong, rules that must hold whatever happens, and for each rule that is broken the
//! shortest schedule that still breaks it.
//!
//! A schedule is text, as [`FaultPlan`] reads it, with what the station orders (`stop@1s`, `release@1.5s`) and clocks that are not exact
//! (`clock:#3/150ppm`): it is drawn from its number, and number, task and text give the same run bit for bit.
//!
//! | rule | what must hold |
//! |---|---|
//! | `torque_limit` | no module applies more than the policy's torque limit |
//! | `slew` | no torque changes faster than the slew limit, but for letting go; not even when a module is armed, released or plugged in |
//! | `unplugged` | a module without power applies no torque |
//! | `stopped` | a module whose emergency stop was latched a control cycle ago, and is, applies no torque |
//! | `stop_holds` | on an undisturbed line every module is stopped a control cycle after the station's stop, and stays so until its release |
//! | `one_time_keeper` | some cycles after the last disturbance the modules of each piece of cable follow one time-keeper |
//! | `takeovers` | on a line without losses nobody takes the time over without need |
//! | `dead_masked` | nobody attends to a module that was gone before the last cycle began: of the next it may have spoken, if its own clock ran ahead |
//! | `dead_seen` | a module that is gone is believed alive for as many cycles as a neighbour may be silent, and no longer |
//! | `alive_again` | some cycles after the last disturbance all modules of a piece of cable believe each other alive |
//! | `attention` | the attention weights of an action sum to one |
//! | `panic` | nothing panics |

use std::fmt;
use std::io::Write;
use std::panic::{AssertUnwindSafe, catch_unwind};
use std::str::FromStr;
use std::sync::Arc;

use composer_firmware::controller::BusKind;
use composer_shared::observation::Sensors;
use composer_shared::policy::Policy;
use composer_shared::robot::{AXES, MAX_MODULES};
use composer_shared::wire::{Fault as ModuleFault, Mode, StopCommand};
use composer_sim_bridge::Plant;
use composer_sim_bridge::computer::Launcher;
use composer_sim_bridge::faults::{Fault, FaultKind, FaultPlan, PlannedFault, ScheduledFault, Target, parse_time};
use composer_sim_bridge::sil::{self, Clock, CycleView, SilConfig};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;

use crate::env::EnvConfig;
use crate::eval::episode_seed;
use crate::sil::SnakePlant;

/// How long a schedule lasts, ns: 60 control cycles.
pub const LENGTH_NS: u64 = 3_000_000_000;
/// Time is drawn in steps of this, ns.
const GRAIN_NS: u64 = 5_000_000;
/// Control cycles in which the line must have settled after a disturbance.
const SETTLED: u64 = 12;
/// Control cycles, that in which it goes included, in which a module that is gone may still be believed alive.
const SEEN: u64 = composer_shared::robot::DEAD_AFTER as u64 + 1;
/// Periods in which a torque may go without a new one, when cycles are lost.
const LOST_CYCLES: u64 = 3;
/// Takeovers that something unplugged, plugged in, cut or mended may bring with it on either side.
const TAKEOVERS: u32 = 3;
/// Most runs that shrinking a schedule may take.
const SHRINKING: usize = 400;

/// One thing that happens in a schedule.
#[derive(Clone, Debug, PartialEq)]
pub enum Item {
    /// Something breaks, or is mended.
    Fault(PlannedFault),
    /// The station orders something, ns.
    Order(u64, StopCommand),
    /// A module's clock runs too fast, parts in a million.
    Clock(usize, i32),
}

/// Everything that happens in a run.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Schedule {
    /// In no particular order.
    pub items: Vec<Item>,
    /// Classic CAN instead of CAN-FD.
    pub classic: bool,
}

impl fmt::Display for Schedule {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |ns: &u64| format!("{}ms", *ns as f64 * 1e-6);
        let mut words: Vec<String> = self
            .items
            .iter()
            .map(|item| match item {
                Item::Fault(fault) => fault.to_string(),
                Item::Order(at, StopCommand::Stop) => format!("stop@{}", ms(at)),
                Item::Order(at, StopCommand::Release) => format!("release@{}", ms(at)),
                Item::Clock(module, ppm) => format!("clock:#{module}/{ppm}ppm"),
            })
            .collect();
        words.extend(self.classic.then(|| "classic".into()));
        f.write_str(if words.is_empty() { "none".into() } else { words.join(",") }.as_str())
    }
}

impl FromStr for Schedule {
    type Err = anyhow::Error;

    fn from_str(text: &str) -> Result<Self, Self::Err> {
        let mut schedule = Schedule::default();
        for word in text.split(',').map(str::trim).filter(|word| !matches!(*word, "" | "none")) {
            let order = |at: &str, command| Ok::<_, Self::Err>(Item::Order(parse_time(at)?, command));
            let item = if word == "classic" {
                schedule.classic = true;
                continue;
            } else if let Some(at) = word.strip_prefix("stop@") {
                order(at, StopCommand::Stop)?
            } else if let Some(at) = word.strip_prefix("release@") {
                order(at, StopCommand::Release)?
            } else if let Some(clock) = word.strip_prefix("clock:#") {
                let read = clock.strip_suffix("ppm").and_then(|clock| clock.split_once('/'));
                let read = read.and_then(|(module, ppm)| Some((module.parse().ok()?, ppm.parse().ok()?)));
                let Some((module, ppm)) =
                    read.filter(|(module, ppm): &(usize, i32)| *module < MAX_MODULES && ppm.abs() <= 100_000)
                else {
                    anyhow::bail!(
                        "`{word}` is no clock; write the module and up to 100000 ppm, as in `clock:#3/150ppm`"
                    );
                };
                Item::Clock(module, ppm)
            } else {
                let plan: FaultPlan = word.parse()?;
                let Some(fault) = plan.faults.into_iter().next() else { continue };
                Item::Fault(fault)
            };
            schedule.items.push(item);
        }
        Ok(schedule)
    }
}

impl Schedule {
    /// Schedule number `number` of a campaign, for a robot of so many modules.
    pub fn draw(seed: u64, number: u64, modules: usize) -> Self {
        let rng = &mut ChaCha8Rng::seed_from_u64(crate::methods::mix(seed ^ crate::methods::mix(number ^ 0xca3b_a160)));
        let time = |rng: &mut ChaCha8Rng, from: u64, to: u64| {
            let (from, to) = (from / GRAIN_NS, (to / GRAIN_NS).max(from / GRAIN_NS + 1));
            rng.random_range(from..to) * GRAIN_NS
        };
        let mut items = Vec::new();
        for _ in 0..rng.random_range(1..=6) {
            let module = rng.random_range(0..modules as u64) as usize;
            let target = Target::Module(module);
            // Most things end well before the run does, so that the mending is seen.
            let at = time(rng, 0, LENGTH_NS / 2);
            let until = (rng.random::<f32>() < 0.7).then(|| time(rng, at + GRAIN_NS, LENGTH_NS * 3 / 4));
            let fault = |kind| Item::Fault(PlannedFault { kind, at_ns: Some(at), until_ns: until });
            let item = match rng.random_range(0..13u32) {
                0 | 1 => fault(FaultKind::Unplug(target)),
                // A brown-out.
                2 => Item::Fault(PlannedFault {
                    kind: FaultKind::BrownOut(target),
                    at_ns: Some(at),
                    until_ns: Some(at + rng.random_range(1..=20) * GRAIN_NS),
                }),
                3 if modules > 1 => fault(FaultKind::Cut(Some(module.min(modules - 2)))),
                4 => fault(FaultKind::Action(target)),
                5 => fault(FaultKind::Observation(target)),
                6 => fault(FaultKind::Stuck(target)),
                7 => fault(FaultKind::Drop(0.01 * f64::from(rng.random_range(1..=20u32)))),
                8 => fault(FaultKind::Delay(u64::from(rng.random_range(1..=40u32)) * 250_000)),
                9 => fault(FaultKind::Corrupt(
                    0.01 * f64::from(rng.random_range(1..=10u32)),
                    rng.random::<bool>().then_some(module),
                )),
                10 => fault(FaultKind::Duplicate(0.01 * f64::from(rng.random_range(1..=20u32)))),
                11 => Item::Clock(module, rng.random_range(-300..=300)),
                _ => {
                    let stop = Item::Order(at, StopCommand::Stop);
                    if let Some(until) = until {
                        items.push(Item::Order(until, StopCommand::Release));
                    }
                    stop
                }
            };
            items.push(item);
        }
        Schedule { items, classic: rng.random::<f32>() < 0.25 }
    }

    /// Whether a robot of so many modules can suffer it.
    pub fn check(&self, modules: usize) -> anyhow::Result<()> {
        self.plan().check(modules)?;
        if let Some(Item::Clock(module, _)) =
            self.items.iter().find(|item| matches!(item, Item::Clock(m, _) if *m >= modules))
        {
            anyhow::bail!("clock:#{module}: the robot has {modules} modules, numbered from 0");
        }
        Ok(())
    }

    fn plan(&self) -> FaultPlan {
        let fault = |item: &Item| if let Item::Fault(fault) = item { Some(*fault) } else { None };
        FaultPlan { faults: self.items.iter().filter_map(fault).collect() }
    }

    /// The set-up of the bus.
    fn sil(&self, seed: u64, modules: usize) -> SilConfig {
        let mut sil = SilConfig::new(if self.classic { BusKind::Classic } else { BusKind::Fd });
        sil.faults = self.plan().draw(seed, modules);
        sil.seed = seed;
        sil.limit_ns = LENGTH_NS;
        sil.clocks = vec![Clock::default(); modules];
        for item in &self.items {
            match *item {
                Item::Order(at, command) => sil.commands.push((at, command)),
                Item::Clock(module, ppm) => sil.clocks[module].drift_ppb = ppm * 1000,
                Item::Fault(_) => {}
            }
        }
        sil.commands.sort_by_key(|(at, _)| *at);
        sil
    }

    /// Schedules that are a little less: without one item, or with one that lasts half as long or begins half as late.
    fn smaller(&self) -> Vec<Schedule> {
        let mut smaller = Vec::new();
        for index in 0..self.items.len() {
            let mut without = self.clone();
            without.items.remove(index);
            smaller.push(without);
        }
        if self.classic {
            smaller.push(Schedule { classic: false, ..self.clone() });
        }
        let grain = |ns: u64| ns / GRAIN_NS * GRAIN_NS;
        for (index, item) in self.items.iter().enumerate() {
            let mut with = |item: Item| {
                let mut other = self.clone();
                other.items[index] = item;
                smaller.push(other);
            };
            match *item {
                Item::Fault(PlannedFault { kind, at_ns: Some(at), until_ns }) => {
                    if let Some(until) = until_ns {
                        let length = grain((until - at) / 2);
                        if length > 0 {
                            with(Item::Fault(PlannedFault { kind, at_ns: Some(at), until_ns: Some(at + length) }));
                        }
                    }
                    let earlier = grain(at / 2);
                    if earlier < at {
                        let until_ns = until_ns.map(|until| until - (at - earlier));
                        with(Item::Fault(PlannedFault { kind, at_ns: Some(earlier), until_ns }));
                    }
                }
                Item::Order(at, command) if grain(at / 2) < at => with(Item::Order(grain(at / 2), command)),
                Item::Clock(module, ppm) if ppm / 2 != 0 => with(Item::Clock(module, ppm / 2)),
                _ => {}
            }
        }
        smaller
    }
}

/// A rule that was broken.
#[derive(Clone, Debug, PartialEq, Eq, serde::Serialize, serde::Deserialize)]
pub struct Broken {
    /// Which, see the [module](self).
    pub rule: String,
    /// What happened.
    pub what: String,
}

/// What a campaign runs on.
pub struct Campaign<'a, L> {
    /// The environment.
    pub config: Arc<EnvConfig>,
    /// The policy of every module.
    pub policy: Policy<'a>,
    /// Makes the modules' computers.
    pub launcher: &'a L,
    /// Seed of the campaign.
    pub seed: u64,
}

impl<L: Launcher + Sync> Campaign<'_, L> {
    /// The schedule of this number.
    pub fn schedule(&self, number: u64) -> Schedule {
        Schedule::draw(self.seed, number, self.config.robot.modules)
    }

    /// Runs a schedule under the number it was drawn with; the first rule that it breaks.
    ///
    /// # Errors
    ///
    /// If it cannot run at all.
    pub fn run(&self, schedule: &Schedule, number: u64) -> anyhow::Result<Option<Broken>> {
        self.run_captured(schedule, number, None)
    }

    /// The same, with all frames of the bus written as a candump log.
    ///
    /// # Errors
    ///
    /// If it cannot run at all, or if the log cannot be written.
    pub fn run_captured(
        &self,
        schedule: &Schedule,
        number: u64,
        capture: Option<&mut dyn Write>,
    ) -> anyhow::Result<Option<Broken>> {
        let seed = episode_seed(self.seed, number);
        let sil = schedule.sil(seed, self.config.robot.modules);
        let mut plant = Watched::new(SnakePlant::new(self.config.clone(), seed), &self.config, &sil);
        let mut rules = Rules::new(&self.config, &sil);
        let run = catch_unwind(AssertUnwindSafe(|| {
            sil::run_on(self.launcher, &mut plant, self.policy, &sil, capture, &mut |view, plant: &Watched| {
                if rules.broken.is_none() {
                    rules.broken.clone_from(&plant.broken);
                }
                rules.cycle(view);
            })
        }));
        match run {
            Ok(report) => {
                rules.end(&report?);
                Ok(rules.broken)
            }
            Err(panic) => {
                let words =
                    panic.downcast_ref::<String>().cloned().or(panic.downcast_ref::<&str>().map(|s| s.to_string()));
                Ok(Some(Broken { rule: "panic".into(), what: words.unwrap_or_default() }))
            }
        }
    }

    /// The smallest schedule found that still breaks the same rule, and how.
    ///
    /// # Errors
    ///
    /// If one cannot run at all.
    pub fn shrink(&self, schedule: &Schedule, number: u64, broken: &Broken) -> anyhow::Result<(Schedule, Broken)> {
        let (mut best, mut how) = (schedule.clone(), broken.clone());
        let mut runs = 0;
        'smaller: loop {
            for candidate in best.smaller() {
                runs += 1;
                if runs > SHRINKING {
                    return Ok((best, how));
                }
                if let Some(found) = self.run(&candidate, number)?
                    && found.rule == broken.rule
                {
                    (best, how) = (candidate, found);
                    continue 'smaller;
                }
            }
            return Ok((best, how));
        }
    }
}

/// The snake, and what its motors are told, looked at in every step.
struct Watched {
    plant: SnakePlant,
    limit: f32,
    /// Largest change of a torque in a control period, and since when each module has had its torque.
    slew: f32,
    torque: Vec<[f32; AXES]>,
    changed_ns: Vec<u64>,
    /// Modules whose motors die and come back: what they do then is not the controller's.
    dying: u64,
    period_ns: u64,
    now_ns: u64,
    broken: Option<Broken>,
}

impl Watched {
    fn new(plant: SnakePlant, config: &EnvConfig, sil: &SilConfig) -> Self {
        let modules = config.robot.modules;
        let dead = |f: &ScheduledFault| if let Fault::ActuatorDead(module) = f.fault { 1 << module } else { 0 };
        Watched {
            plant,
            limit: config.robot.torque_limit,
            slew: config.robot.torque_slew,
            torque: vec![[0.0; AXES]; modules],
            changed_ns: vec![0; modules],
            dying: sil.faults.iter().map(dead).fold(0, |all: u64, one: u64| all | one),
            period_ns: (f64::from(config.control_period) * 1e9) as u64,
            now_ns: 0,
            broken: None,
        }
    }

    fn broke(&mut self, rule: &str, what: String) {
        self.broken
            .get_or_insert(Broken { rule: rule.into(), what: format!("at {:.3} s {what}", self.now_ns as f64 * 1e-9) });
    }
}

impl Plant for Watched {
    fn modules(&self) -> usize {
        self.plant.modules()
    }

    fn step_ns(&self) -> u64 {
        self.plant.step_ns()
    }

    fn sensors(&self, module: usize) -> Sensors {
        self.plant.sensors(module)
    }

    fn point(&self, number: u8) -> Option<[f32; 3]> {
        self.plant.point(number)
    }

    fn set_torque(&mut self, module: usize, torque: [f32; AXES]) {
        let was = self.torque[module];
        for axis in 0..AXES {
            let new = torque[axis];
            if new.is_nan() || new.abs() > self.limit * 1.000_001 {
                self.broke("torque_limit", format!("module {module} applied {new}"));
            }
            // What the plant sees moves by whole steps.
            let since = (self.now_ns - self.changed_ns[module]).clamp(self.period_ns, LOST_CYCLES * self.period_ns);
            let most = self.slew * (since + self.plant.step_ns()) as f32 * 1e-9 + 0.01 * self.limit;
            // Letting go is no slewing.
            if new != 0.0 && self.dying & 1 << module == 0 && (new - was[axis]).abs() > most {
                self.broke(
                    "slew",
                    format!("module {module} went from {} to {new} in {:.1} ms", was[axis], since as f64 * 1e-6),
                );
            }
        }
        if torque != was {
            self.torque[module] = torque;
            self.changed_ns[module] = self.now_ns;
        }
        self.plant.set_torque(module, torque);
    }

    fn step(&mut self) {
        self.plant.step();
        self.now_ns += self.plant.step_ns();
    }

    /// Arrived or not, the run goes on: what is broken late must be seen too.
    fn done(&self) -> bool {
        false
    }
}

/// The rules that are looked at once a control cycle.
struct Rules<'a> {
    period_ns: u64,
    /// Whether nothing that goes on disturbs the frames for good.
    line: Vec<ScheduledFault>,
    orders: &'a [(u64, StopCommand)],
    /// Whether no frame is lost, late or twice, and all clocks are exact.
    lossless: bool,
    /// Cycle of each module at the last look, and how many it has started one a period until now.
    in_step: Vec<(u16, u32)>,
    /// Modules stopped at the end of the last cycle.
    stopped: u64,
    broken: Option<Broken>,
}

impl<'a> Rules<'a> {
    fn new(config: &EnvConfig, sil: &'a SilConfig) -> Self {
        // What can keep frames from their receivers, or change which modules there are.
        let disturbs = |fault: &&ScheduledFault| {
            !matches!(fault.fault, Fault::ActuatorDead(_) | Fault::SensorZeroed(_) | Fault::SensorStuck(_))
        };
        let line: Vec<ScheduledFault> = sil.faults.iter().filter(disturbs).copied().collect();
        Rules {
            lossless: line.iter().all(|scheduled| scheduled.fault.changes_line())
                && sil.clocks.iter().all(|clock| clock.drift_ppb == 0),
            orders: &sil.commands,
            period_ns: (f64::from(config.control_period) * 1e9).round() as u64,
            line,
            in_step: vec![(0, 0); config.robot.modules],
            stopped: 0,
            broken: None,
        }
    }

    fn broke(&mut self, rule: &str, at: u64, what: String) {
        self.broken.get_or_insert(Broken { rule: rule.into(), what: format!("at {:.3} s {what}", at as f64 * 1e-9) });
    }

    /// Whether the line has had so many cycles to settle, and nothing disturbs it.
    fn quiet_for(&self, now: u64, cycles: u64) -> bool {
        self.line.iter().all(|scheduled| {
            let over = |at: u64| now < at || now >= at + cycles * self.period_ns;
            // A module that is gone or a cable that is cut stays so without disturbing anybody.
            let disturbing = scheduled.active(now) && !scheduled.fault.changes_line();
            !disturbing && over(scheduled.at_ns) && scheduled.until_ns.is_none_or(over)
        })
    }

    fn cycle(&mut self, view: &CycleView) {
        let now = view.at_ns;
        let mut stopped = 0u64;
        for ((last, steps), module) in self.in_step.iter_mut().zip(view.modules) {
            *steps = if module.plugged && module.cycle == last.wrapping_add(1) { *steps + 1 } else { 0 };
            *last = module.cycle;
        }
        for (number, module) in view.modules.iter().enumerate() {
            let torque = module.torque != [0.0; AXES];
            if !module.plugged {
                if torque {
                    self.broke("unplugged", now, format!("module {number} applies {:?} without power", module.torque));
                }
                continue;
            }
            if module.faults.contains(ModuleFault::EmergencyStop) {
                stopped |= 1 << number;
                if self.stopped & 1 << number != 0 && torque {
                    self.broke("stopped", now, format!("module {number} is stopped and applies {:?}", module.torque));
                }
            }
            let sum: i64 = module.attention.iter().map(|weight| i64::from(*weight)).sum();
            if module.heard != 0 && module.mode != Mode::Boot && sum != 0 && (sum - 32767).abs() > 64 {
                self.broke(
                    "attention",
                    now,
                    format!("the weights of module {number} sum to {:.4}", sum as f64 / 32767.0),
                );
            }
            if self.lossless {
                self.gone(view, number);
            }
        }
        if self.line.is_empty() {
            self.stop_holds(view);
        }
        self.stopped = stopped;
        if !self.quiet_for(now, SETTLED) {
            return;
        }
        for piece in view.pieces() {
            self.piece(view, &piece);
        }
    }

    /// The rules about what a module makes of those that are gone.
    fn gone(&mut self, view: &CycleView, number: usize) {
        let module = &view.modules[number];
        for (index, gone) in self.line.iter().enumerate() {
            let (Fault::Unplug(hit) | Fault::BrownOut(hit)) = gone.fault else { continue };
            if hit == number || !gone.active(view.at_ns) {
                continue;
            }
            let cycles = u64::from(view.cycle).saturating_sub(gone.at_ns / self.period_ns);
            let since = gone.at_ns as f64 * 1e-9;
            // Without its time-keeper a piece of cable has no cycles for a while, and nobody acts anew.
            let acted = self.in_step[number].1;
            if cycles >= 2 && acted >= 2 && module.heard & 1 << hit != 0 {
                return self.broke(
                    "dead_masked",
                    view.at_ns,
                    format!("module {number} attends to module {hit}, gone since {since:.3} s"),
                );
            }
            // A module that has only just started counts from then on.
            let alone = self.line.iter().enumerate().all(|(other, fault)| {
                let long_ago = |at: u64| at > view.at_ns || at + SETTLED * self.period_ns < gone.at_ns;
                other == index || long_ago(fault.at_ns) && fault.until_ns.is_none_or(long_ago)
            });
            if cycles >= SEEN && alone && u64::from(acted) > SEEN && view.cuts == 0 && module.alive & 1 << hit != 0 {
                return self.broke(
                    "dead_seen",
                    view.at_ns,
                    format!("module {number} believes module {hit} alive, gone since {since:.3} s"),
                );
            }
        }
    }

    /// The station's stop, heard by all.
    fn stop_holds(&mut self, view: &CycleView) {
        let last = self.orders.iter().rev().find(|(at, _)| *at <= view.at_ns);
        let Some((at, StopCommand::Stop)) = last else { return };
        if view.at_ns < at + self.period_ns {
            return;
        }
        for (number, module) in view.modules.iter().enumerate() {
            if module.torque != [0.0; AXES] || !module.faults.contains(ModuleFault::EmergencyStop) {
                let what =
                    format!("module {number} applies {:?}, stopped at {:.3} s", module.torque, *at as f64 * 1e-9);
                return self.broke("stop_holds", view.at_ns, what);
            }
        }
    }

    /// When it is over.
    fn end(&mut self, report: &sil::SilReport) {
        let takeovers: u32 = report.modules.iter().map(|module| module.stats.takeovers).sum();
        let most = 1 + TAKEOVERS * self.line.len() as u32;
        if self.lossless && takeovers > most {
            self.broke(
                "takeovers",
                report.duration_ns,
                format!("the time was taken over {takeovers} times; {most} would do"),
            );
        }
    }

    /// The rules about the modules that hang on one piece of cable, long after the last disturbance.
    fn piece(&mut self, view: &CycleView, modules: &[usize]) {
        let [first, ..] = *modules else { return };
        for &number in modules {
            let (its, firsts) = (view.modules[number].time_keeper, view.modules[first].time_keeper);
            if its != firsts {
                self.broke(
                    "one_time_keeper",
                    view.at_ns,
                    format!("module {first} follows {firsts:?} and module {number} follows {its:?}"),
                );
            }
            for &other in modules {
                if view.modules[number].alive & 1 << other == 0 {
                    self.broke(
                        "alive_again",
                        view.at_ns,
                        format!("module {number} does not believe module {other} alive"),
                    );
                }
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::Robot;
    use composer_shared::policies;
    use composer_shared::policy::Task;
    use composer_sim_bridge::computer::InProcess;

    fn with(job: impl FnOnce(&Campaign<InProcess>)) {
        let policy = Policy::parse(policies::shipped("goal-reaching").unwrap()).unwrap();
        let launcher = InProcess::new(policy);
        let config = Arc::new(EnvConfig::new(Task::GoalReaching, Robot::default()));
        job(&Campaign { config, policy, launcher: &launcher, seed: 1 });
    }

    #[test]
    fn schedules_are_drawn_from_their_number_and_read_back_from_their_text() {
        for number in 0..500 {
            let schedule = Schedule::draw(7, number, 8);
            assert_eq!(schedule, Schedule::draw(7, number, 8));
            schedule.check(8).unwrap();
            let again: Schedule = schedule.to_string().parse().unwrap();
            assert_eq!(again.to_string(), schedule.to_string());
            assert_eq!(again.sil(number, 8), schedule.sil(number, 8), "{schedule}");
        }
        for (text, words) in
            [("clock:#3/fast", "clock:#3/150ppm"), ("stop@1", "is not a time"), ("explode", "unknown fault")]
        {
            assert!(text.parse::<Schedule>().unwrap_err().to_string().contains(words), "{text}");
        }
        assert!("clock:#9/1ppm".parse::<Schedule>().unwrap().check(8).is_err());
    }

    #[test]
    fn no_rule_is_broken_by_the_first_schedules() {
        with(|campaign| {
            for number in 0..40 {
                let schedule = campaign.schedule(number);
                let broken = campaign.run(&schedule, number).unwrap();
                assert_eq!(broken, None, "number {number}: {schedule}");
            }
        });
    }

    #[test]
    fn a_broken_rule_is_shrunk_to_what_breaks_it() {
        // A rule that is broken by design: nobody can see a module's death while frames are lost.
        with(|campaign| {
            let schedule: Schedule =
                "action:#2@100ms,drop:1@0ms..2s,unplug:#3@1s..1.2s,clock:#1/100ppm".parse().unwrap();
            let breaks = |schedule: &Schedule| schedule.to_string().contains("drop:1");
            // The real shrinker on a rule of the test's own.
            let mut best = schedule.clone();
            while let Some(smaller) = best.smaller().into_iter().find(breaks) {
                best = smaller;
            }
            assert_eq!(best.to_string(), "drop:1@0s..5ms");
            assert!(campaign.run(&best, 1).unwrap().is_none());
        });
    }
}
