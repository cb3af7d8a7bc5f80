//! Scenarios: episodes on the simulated bus with faults, and what is expected of the robot, as data. A suite of them is what a team's CI runs before a
//! robot is switched on.
//!
//! ```toml
//! about = "Module 3 loses its power and gets it back"
//! task = "goal-reaching"          # or policy = "FILE"
//! episodes = 20
//! faults = "unplug:#3@1s..2s"     # as for `snakectl sil --fault`
//!
//! [expect]
//! success_rate = 0.9
//! dead_seen_within = 3            # control cycles
//! rejoins_within = "1s"
//! ```
//!
//! An expectation that nothing in the scenario could ever test is refused when the file is read, and one that no episode came to test is broken.

use std::collections::BTreeMap;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_firmware::controller::BusKind;
use composer_shared::policy::{Policy, Task};
use composer_shared::robot::MAX_MODULES;
use composer_shared::wire::{Message, Mode, StopCommand};
use composer_sim_bridge::candump::parse_frame;
use composer_sim_bridge::computer::Launcher;
use composer_sim_bridge::faults::{Fault, FaultPlan, ScheduledFault, parse_time};
use composer_sim_bridge::sil::{self, Clock, CycleView, Injected, SilConfig};
use serde::{Deserialize, Serialize};

use crate::env::EnvConfig;
use crate::eval::episode_seed;
use crate::outcome::Episode;
use crate::sil::SnakePlant;
use crate::stats::wilson;

/// A scenario as it is written.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// What is tested, and why.
    pub about: String,
    /// The task whose shipped policy is tested.
    #[serde(default, with = "task_name", skip_serializing_if = "Option::is_none")]
    pub task: Option<Task>,
    /// A policy image or run, instead of the one that ships.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub policy: Option<String>,
    /// Modules of the snake; otherwise the robot's.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub modules: Option<usize>,
    /// Robot file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub robot: Option<std::path::PathBuf>,
    /// Ranges that every episode draws its robot from ([`crate::vary`]), or changes of the form KEY=VALUE.
    #[serde(default)]
    pub vary: Vec<String>,
    /// Episodes.
    #[serde(default = "one")]
    pub episodes: usize,
    /// Their seed.
    #[serde(default = "one_seed")]
    pub seed: u64,
    /// What goes wrong, as for `snakectl sil --fault`.
    #[serde(default)]
    pub faults: String,
    /// Kind of bus: "fd" or "classic".
    #[serde(default)]
    pub bus: Bus,
    /// Number of modules between the head end of the cable and the station.
    #[serde(default)]
    pub station_behind: usize,
    /// The station has one port only, at the head end: a cable that is cut takes it from the tail.
    #[serde(default)]
    pub one_port: bool,
    /// Modules that babble get past the guards of their ports.
    #[serde(default)]
    pub no_guard: bool,
    /// Modules whose sensors say what cannot be true relax, as on a board, instead of acting on zeros.
    #[serde(default)]
    pub blind_relaxes: bool,
    /// What the station orders, in order of time.
    #[serde(default)]
    pub command: Vec<Command>,
    /// Clocks that are not exact.
    #[serde(default)]
    pub clock: Vec<Drift>,
    /// Frames of a foreign device at the tail end of the cable, in order of time.
    #[serde(default)]
    pub inject: Vec<Foreign>,
    /// What must come of it.
    pub expect: Expectations,
}

/// Most frames that one line injects.
const MOST_INJECTED: usize = 100_000;

fn one() -> usize {
    1
}

fn one_seed() -> u64 {
    crate::eval::DEFAULT_SEED
}

/// Tasks by their names.
mod task_name {
    use super::Task;
    use serde::{Deserialize, Deserializer, Serialize, Serializer};

    pub fn serialize<S: Serializer>(task: &Option<Task>, s: S) -> Result<S::Ok, S::Error> {
        task.map(Task::name).serialize(s)
    }

    pub fn deserialize<'de, D: Deserializer<'de>>(d: D) -> Result<Option<Task>, D::Error> {
        let name = String::deserialize(d)?;
        let names = Task::ALL.map(Task::name).join(", ");
        let unknown = || serde::de::Error::custom(format!("there is no task `{name}`; the tasks are {names}"));
        Task::from_name(&name).map(Some).ok_or_else(unknown)
    }
}

/// Kind of bus.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Bus {
    /// CAN-FD.
    #[default]
    Fd,
    /// CAN 2.0.
    Classic,
}

/// Something that the station orders.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Command {
    /// When, such as "1.5s".
    pub at: String,
    /// "stop" or "release".
    pub send: Order,
}

/// See [`Command::send`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Order {
    /// All motors relax until the release.
    Stop,
    /// The stop is over.
    Release,
}

/// A clock that runs too fast, or too slow.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Drift {
    /// Whose.
    pub module: usize,
    /// By how much, parts in a million.
    pub ppm: f64,
}

/// A frame of a foreign device.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Foreign {
    /// When it is sent first, such as "1s".
    pub at: String,
    /// What, as candump and cansend write it: `003#010000`, `283##1...`.
    pub frame: String,
    /// How often.
    #[serde(default = "one")]
    pub times: usize,
    /// Time from one to the next.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub every: Option<String>,
}

/// What must come of a scenario. What is left out is not looked at; that no torque exceeds the policy's limit always is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Expectations {
    /// Share of the episodes in which the goal is reached, at least. Broken if the episodes speak against it: if the upper end of their 95 %
    /// interval (Wilson) lies below.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub success_rate: Option<f64>,
    /// So many whole control cycles after a module was unplugged nobody believes it alive any more; the one in which it was unplugged does not
    /// count.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub dead_seen_within: Option<u32>,
    /// So long after a module was plugged in again all believe it alive, and it attends to others.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rejoins_within: Option<String>,
    /// From so long after a stop until the release nobody applies a torque.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub no_torque_after_stop: Option<String>,
    /// So many control cycles after anything was unplugged, plugged in, cut or mended, the modules of each piece of cable follow one time-keeper.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub one_time_keeper_within: Option<u32>,
    /// No latent is older when it is acted on.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub latent_age: Option<String>,
    /// No module acts more often than this, of a hundred control cycles, without a live neighbour's latent.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub deadline_misses_percent: Option<f64>,
    /// No module goes longer than this without acting while it is plugged in; its start counts.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub longest_gap: Option<String>,
    /// No link is ever faster, units/s.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub link_speed: Option<f32>,
    /// The bus is not busier, in percent of the time.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bus_load_percent: Option<f64>,
}

/// What was broken, and in which episode if it was one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Broken {
    /// The episode, from 0; none if it is all of them together.
    pub episode: Option<usize>,
    /// What was expected and what happened instead.
    pub what: String,
}

/// What came of a scenario.
#[derive(Clone, Debug, PartialEq)]
pub struct Verdict {
    /// Share of the episodes in which the goal was reached.
    pub success_rate: f64,
    /// Episodes that ran.
    pub episodes: usize,
    /// Each expectation that was broken, once, with the first episode in which it was.
    pub broken: Vec<Broken>,
    /// How often each expectation could be tested.
    pub tested: BTreeMap<&'static str, u64>,
}

/// A scenario that has been read and can run.
#[derive(Clone, Debug)]
pub struct Ready {
    /// As it is written.
    pub scenario: Scenario,
    faults: FaultPlan,
    commands: Vec<(u64, StopCommand)>,
    injected: Vec<Injected>,
    /// Whatever stops the robot or releases it, whoever sends it, in order of time.
    orders: Vec<(u64, StopCommand)>,
    limits: Limits,
}

/// Times of the expectations, ns.
#[derive(Clone, Copy, Debug, Default)]
struct Limits {
    rejoins: Option<u64>,
    stop: Option<u64>,
    latent_age: Option<u64>,
    gap: Option<u64>,
}

impl Scenario {
    /// Reads a scenario; the sentence says what is wrong with the file.
    pub fn load(path: &Path) -> Result<Ready> {
        let text =
            std::fs::read_to_string(path).with_context(|| format!("cannot read the scenario {}", path.display()))?;
        Self::parse(&text).with_context(|| format!("the scenario {} cannot be", path.display()))
    }

    /// Reads the text of one.
    pub fn parse(text: &str) -> Result<Ready> {
        let scenario: Scenario =
            toml::from_str(text).map_err(|error| anyhow::anyhow!("{}", error.message().trim().replace('\n', " ")))?;
        let time = |name: &str, text: &str| parse_time(text).with_context(|| format!("{name} = \"{text}\""));
        let faults: FaultPlan = scenario.faults.parse().context("faults")?;
        let mut commands = Vec::new();
        for command in &scenario.command {
            let order = if command.send == Order::Stop { StopCommand::Stop } else { StopCommand::Release };
            commands.push((time("command.at", &command.at)?, order));
        }
        if !commands.is_sorted_by_key(|(at, _)| *at) {
            bail!("the commands are not in order of time: write the earliest first");
        }
        let mut injected = Vec::new();
        for foreign in &scenario.inject {
            let frame = parse_frame(&foreign.frame)
                .map_err(|e| anyhow::anyhow!("inject.frame = \"{}\": {e}", foreign.frame))?;
            let (at, every) = (time("inject.at", &foreign.at)?, foreign.every.as_deref());
            let every = match every {
                Some(every) => time("inject.every", every)?,
                None if foreign.times > 1 => {
                    bail!("inject.times = {} says nothing of when: add every = \"10ms\"", foreign.times)
                }
                None => 0,
            };
            if !(1..=MOST_INJECTED).contains(&foreign.times) {
                bail!("inject.times = {} cannot be: 1 to {MOST_INJECTED} frames are possible", foreign.times);
            }
            let after = |k: u64| at.saturating_add(every.saturating_mul(k));
            injected.extend((0..foreign.times as u64).map(|k| Injected { at_ns: after(k), frame }));
        }
        injected.sort_by_key(|injected| injected.at_ns);
        if scenario.task.is_none() && scenario.policy.is_none() {
            bail!("neither task nor policy is named: whose policy is tested?");
        }
        if scenario.task.is_some() && scenario.policy.is_some() {
            bail!("task and policy are both named: a policy does what it was trained for, leave the task out");
        }
        if scenario.episodes == 0 {
            bail!("episodes = 0 tests nothing: at least 1 is possible");
        }
        if let Some(clock) =
            scenario.clock.iter().find(|clock| clock.module >= MAX_MODULES || !(-1e5..=1e5).contains(&clock.ppm))
        {
            bail!(
                "clock: module {} and {} ppm cannot be: up to 100000 ppm of a module from 0 to {}",
                clock.module,
                clock.ppm,
                MAX_MODULES - 1
            );
        }
        let expect = &scenario.expect;
        if *expect == Expectations::default() {
            bail!("nothing is expected: write at least one line below [expect]");
        }
        let option = |name: &str, text: &Option<String>| text.as_deref().map(|text| time(name, text)).transpose();
        let limits = Limits {
            rejoins: option("expect.rejoins_within", &expect.rejoins_within)?,
            stop: option("expect.no_torque_after_stop", &expect.no_torque_after_stop)?,
            latent_age: option("expect.latent_age", &expect.latent_age)?,
            gap: option("expect.longest_gap", &expect.longest_gap)?,
        };
        let foreign = injected.iter().filter_map(|injected| match Message::parse(&injected.frame) {
            Ok(Message::EmergencyStop(stop)) => Some((injected.at_ns, stop.command())),
            _ => None,
        });
        let mut orders: Vec<_> = commands.iter().copied().chain(foreign).collect();
        orders.sort_by_key(|(at, _)| *at);
        let ready = Ready { faults, commands, injected, orders, limits, scenario };
        ready.check()?;
        Ok(ready)
    }
}

impl Ready {
    /// Whether every expectation can be tested.
    fn check(&self) -> Result<()> {
        use composer_sim_bridge::faults::FaultKind;
        let expect = &self.scenario.expect;
        let unplugs = || self.faults.faults.iter().filter(|fault| matches!(fault.kind, FaultKind::Unplug(_)));
        let never = |name: &str, why: &str| bail!("{name} can never be tested: {why}");
        if expect.dead_seen_within.is_some() && unplugs().next().is_none() {
            never("expect.dead_seen_within", "no module is unplugged; write it into faults, such as \"unplug:#3@1s\"")?;
        }
        if expect.rejoins_within.is_some() && !unplugs().any(|fault| fault.until_ns.is_some()) {
            never(
                "expect.rejoins_within",
                "no module is plugged in again; say when, as in faults = \"unplug:#3@1s..2s\"",
            )?;
        }
        if expect.no_torque_after_stop.is_some() && !self.orders.iter().any(|(_, order)| *order == StopCommand::Stop) {
            never("expect.no_torque_after_stop", "nobody stops the robot; add [[command]] with send = \"stop\"")?;
        }
        for (name, share, most) in [
            ("success_rate", expect.success_rate, 1.0),
            ("deadline_misses_percent", expect.deadline_misses_percent, 100.0),
            ("bus_load_percent", expect.bus_load_percent, 100.0),
        ] {
            if share.is_some_and(|share| !(0.0..=most).contains(&share)) {
                bail!("expect.{name} = {} can never be: it lies between 0 and {most}", share.unwrap_or(f64::NAN));
            }
        }
        Ok(())
    }

    /// The name of the policy, for whoever loads it.
    pub fn policy(&self) -> &str {
        match (&self.scenario.policy, self.scenario.task) {
            (Some(policy), _) => policy,
            (None, task) => task.map_or("", Task::name),
        }
    }

    /// The set-up of the bus in the episode with this seed.
    fn sil(&self, seed: u64, modules: usize) -> SilConfig {
        let scenario = &self.scenario;
        let mut sil = SilConfig::new(if scenario.bus == Bus::Fd { BusKind::Fd } else { BusKind::Classic });
        sil.faults = self.faults.draw(seed, modules);
        sil.seed = seed;
        sil.station_behind = scenario.station_behind;
        sil.ring = !scenario.one_port;
        sil.guard = !scenario.no_guard;
        sil.safety.blind_relaxes = scenario.blind_relaxes;
        sil.commands.clone_from(&self.commands);
        sil.injected.clone_from(&self.injected);
        let last = scenario.clock.iter().map(|clock| clock.module + 1).max().unwrap_or(0);
        sil.clocks = vec![Clock::default(); last];
        for clock in &scenario.clock {
            sil.clocks[clock.module].drift_ppb = (clock.ppm * 1000.0) as i32;
        }
        sil
    }

    /// Whether a robot of so many modules can do it.
    pub fn fits(&self, modules: usize) -> Result<()> {
        self.faults.check(modules)?;
        if let Some(clock) = self.scenario.clock.iter().find(|clock| clock.module >= modules) {
            bail!("clock: there is no module {}; the robot has {modules}, numbered from 0", clock.module);
        }
        if self.scenario.station_behind > modules {
            bail!("station_behind = {}; the robot has {modules} modules", self.scenario.station_behind);
        }
        Ok(())
    }

    /// Runs episode `index`. `policy` is on every module; `launcher` makes their computers.
    pub fn episode<L: Launcher>(
        &self,
        launcher: &L,
        config: &Arc<EnvConfig>,
        policy: Policy<'_>,
        index: usize,
    ) -> Result<Observed> {
        let seed = episode_seed(self.scenario.seed, index as u64);
        let sil = self.sil(seed, config.robot.modules);
        let mut plant = SnakePlant::new(config.clone(), seed);
        let mut watch = Watch::new(self, config, &sil.faults);
        let report = sil::run_on(launcher, &mut plant, policy, &sil, None, &mut |cycle, _| watch.cycle(cycle))?;
        watch.end(&report);
        let episode = plant.episode();
        watch.expect("link_speed", self.scenario.expect.link_speed, |most| {
            (episode.motion.peak_link_speed > most)
                .then(|| format!("a link came to {:.1} units/s", episode.motion.peak_link_speed))
        });
        Ok(Observed { episode, broken: watch.broken, tested: watch.tested })
    }

    /// The verdict on all episodes, in order.
    pub fn verdict(&self, observed: &[Observed]) -> Verdict {
        let successes = observed.iter().filter(|o| o.episode.success).count();
        let mut verdict = Verdict {
            success_rate: successes as f64 / observed.len().max(1) as f64,
            episodes: observed.len(),
            broken: Vec::new(),
            tested: BTreeMap::new(),
        };
        for (index, one) in observed.iter().enumerate() {
            for (name, what) in &one.broken {
                if !verdict.broken.iter().any(|known| known.what.starts_with(name)) {
                    verdict.broken.push(Broken { episode: Some(index), what: format!("{name}: {what}") });
                }
            }
            for (name, times) in &one.tested {
                *verdict.tested.entry(name).or_default() += times;
            }
        }
        if let Some(least) = self.scenario.expect.success_rate {
            let (low, high) = wilson(successes, observed.len());
            verdict.tested.insert("success_rate", observed.len() as u64);
            if high < least {
                let what =
                    format!("success_rate: {:.3} [{low:.3}, {high:.3}] instead of {least}", verdict.success_rate);
                verdict.broken.push(Broken { episode: None, what });
            }
        }
        let untested: Vec<_> = verdict.tested.iter().filter(|(_, times)| **times == 0).map(|(name, _)| *name).collect();
        for name in untested {
            let what = format!("{name}: no episode lasted long enough to test it");
            verdict.broken.push(Broken { episode: None, what });
        }
        verdict
    }
}

/// What was seen in an episode.
#[derive(Clone, Debug)]
pub struct Observed {
    /// What came of it.
    pub episode: Episode,
    /// Which expectations were broken, and how, the first time.
    broken: Vec<(&'static str, String)>,
    tested: BTreeMap<&'static str, u64>,
}

/// Looks at an episode while it runs.
struct Watch<'a> {
    ready: &'a Ready,
    faults: &'a [ScheduledFault],
    period_ns: u64,
    torque_limit: f32,
    broken: Vec<(&'static str, String)>,
    tested: BTreeMap<&'static str, u64>,
    /// Faults whose death or return has been looked at.
    seen: Vec<[bool; 2]>,
}

impl<'a> Watch<'a> {
    fn new(ready: &'a Ready, config: &EnvConfig, faults: &'a [ScheduledFault]) -> Self {
        let expect = &ready.scenario.expect;
        let of_time = [
            ("dead_seen_within", expect.dead_seen_within.is_some()),
            ("rejoins_within", expect.rejoins_within.is_some()),
            ("no_torque_after_stop", expect.no_torque_after_stop.is_some()),
            ("one_time_keeper_within", expect.one_time_keeper_within.is_some()),
        ];
        Watch {
            ready,
            faults,
            period_ns: (f64::from(config.control_period) * 1e9).round() as u64,
            torque_limit: config.robot.torque_limit,
            broken: Vec::new(),
            tested: of_time.into_iter().filter(|(_, asked)| *asked).map(|(name, _)| (name, 0)).collect(),
            seen: vec![[false; 2]; faults.len()],
        }
    }

    fn broke(&mut self, name: &'static str, what: String) {
        if !self.broken.iter().any(|(known, _)| *known == name) {
            self.broken.push((name, what));
        }
    }

    /// Tests a limit that is asked for; `exceeded` says how it was.
    fn expect<T: Copy + std::fmt::Display>(
        &mut self,
        name: &'static str,
        limit: Option<T>,
        exceeded: impl FnOnce(T) -> Option<String>,
    ) {
        let Some(limit) = limit else { return };
        *self.tested.entry(name).or_default() += 1;
        if let Some(what) = exceeded(limit) {
            self.broke(name, format!("{what}; at most {limit} was expected"));
        }
    }

    /// At the end of a control cycle.
    fn cycle(&mut self, view: &CycleView) {
        let now = view.at_ns;
        let plugged = || view.modules.iter().enumerate().filter(|(_, module)| module.plugged);
        for (number, module) in plugged() {
            let most = self.torque_limit * 1.000_001;
            if let Some(largest) = module.torque.into_iter().find(|torque| !(-most..=most).contains(torque)) {
                self.broke("torque_limit", format!("module {number} applied {largest} at {}", seconds(now)));
            }
        }
        let expect = &self.ready.scenario.expect;
        for (index, scheduled) in self.faults.iter().enumerate() {
            let Fault::Unplug(hit) = scheduled.fault else { continue };
            let others = || plugged().filter(|(number, _)| *number != hit);
            if let Some(cycles) = expect.dead_seen_within
                && now >= scheduled.at_ns + (u64::from(cycles) + 1) * self.period_ns
                && scheduled.until_ns.is_none_or(|until| now < until)
                && !std::mem::replace(&mut self.seen[index][0], true)
            {
                *self.tested.entry("dead_seen_within").or_default() += 1;
                if let Some((number, _)) = others().find(|(_, module)| module.alive & 1 << hit != 0) {
                    let what = format!(
                        "at {} module {number} still believes module {hit} alive, unplugged at {}",
                        seconds(now),
                        seconds(scheduled.at_ns)
                    );
                    self.broke("dead_seen_within", what);
                }
            }
            if let (Some(within), Some(until)) = (self.ready.limits.rejoins, scheduled.until_ns)
                && now >= until + within
                && !std::mem::replace(&mut self.seen[index][1], true)
            {
                *self.tested.entry("rejoins_within").or_default() += 1;
                let back =
                    view.modules.get(hit).is_some_and(|module| module.plugged && module.heard & !(1 << hit) != 0);
                let missed = others().find(|(_, module)| module.alive & 1 << hit == 0);
                if !back || missed.is_some() {
                    let who = missed.map_or(format!("module {hit} itself attends to nobody"), |(n, _)| {
                        format!("module {n} does not believe it alive")
                    });
                    self.broke(
                        "rejoins_within",
                        format!("module {hit} was plugged in at {}; at {} {who}", seconds(until), seconds(now)),
                    );
                }
            }
        }
        if let Some(after) = self.ready.limits.stop {
            let last = self.ready.orders.iter().rev().find(|(at, _)| *at <= now);
            if let Some((at, StopCommand::Stop)) = last
                && now >= at + after
            {
                *self.tested.entry("no_torque_after_stop").or_default() += 1;
                if let Some((number, module)) = plugged().find(|(_, module)| module.torque != [0.0; 2]) {
                    let what = format!(
                        "module {number} applies {:?} at {}, stopped at {}",
                        module.torque,
                        seconds(now),
                        seconds(*at)
                    );
                    self.broke("no_torque_after_stop", what);
                }
            }
        }
        if let Some(cycles) = expect.one_time_keeper_within {
            let line = self.faults.iter().filter(|f| f.fault.changes_line());
            let changed =
                line.flat_map(|f| [Some(f.at_ns), f.until_ns]).flatten().filter(|at| *at <= now).max().unwrap_or(0);
            if now >= changed + u64::from(cycles) * self.period_ns {
                *self.tested.entry("one_time_keeper_within").or_default() += 1;
                if let Some(what) = several_time_keepers(view) {
                    self.broke("one_time_keeper_within", format!("at {} {what}", seconds(now)));
                }
            }
        }
    }

    /// When it is over.
    fn end(&mut self, report: &sil::SilReport) {
        let (expect, limits) = (&self.ready.scenario.expect, self.ready.limits);
        let ms = |ns: u64| ns as f64 * 1e-6;
        self.expect("latent_age", limits.latent_age.map(ms), |most| {
            (report.latent_age_max_ms > most).then(|| format!("a latent was {:.2} ms old", report.latent_age_max_ms))
        });
        self.expect("bus_load_percent", expect.bus_load_percent, |most| {
            (100.0 * report.bus_load > most)
                .then(|| format!("the bus was busy in {:.1} % of the time", 100.0 * report.bus_load))
        });
        self.expect("deadline_misses_percent", expect.deadline_misses_percent, |most| {
            let worst = report.modules.iter().enumerate().max_by_key(|(_, module)| module.stats.deadline_misses)?;
            let share = 100.0 * f64::from(worst.1.stats.deadline_misses) / f64::from(worst.1.stats.acted.max(1));
            (share > most).then(|| format!("module {} missed a latent in {share:.1} % of its cycles", worst.0))
        });
        self.expect("longest_gap", limits.gap.map(ms), |most| {
            let worst =
                report.modules.iter().enumerate().max_by(|a, b| a.1.longest_gap_ms.total_cmp(&b.1.longest_gap_ms))?;
            (worst.1.longest_gap_ms > most)
                .then(|| format!("module {} did not act for {:.1} ms", worst.0, worst.1.longest_gap_ms))
        });
    }
}

fn seconds(ns: u64) -> String {
    format!("{:.3} s", ns as f64 * 1e-9)
}

/// Two modules of one piece of cable that follow different time-keepers, in words.
fn several_time_keepers(view: &CycleView) -> Option<String> {
    view.pieces().into_iter().find_map(|piece| {
        let mut followers = piece.into_iter().filter_map(|number| {
            let module = &view.modules[number];
            Some((number, module.time_keeper.filter(|_| module.mode != Mode::Boot)?))
        });
        let (first, its) = followers.next()?;
        let (other, keeper) = followers.find(|(_, keeper)| *keeper != its)?;
        Some(format!("module {first} follows {its} and module {other} follows {keeper}"))
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::robot::Robot;
    use composer_shared::policies;
    use composer_sim_bridge::computer::InProcess;

    fn refused(text: &str) -> String {
        format!("{:#}", Scenario::parse(text).unwrap_err())
    }

    #[test]
    fn what_cannot_be_or_never_be_tested_is_refused_in_one_sentence() {
        let with =
            |lines: &str, expect: &str| format!("about = \"x\"\ntask = \"goal-reaching\"\n{lines}\n[expect]\n{expect}");
        for (text, words) in [
            (with("colour = 1", "success_rate = 0.5"), "unknown field `colour`"),
            (with("", "sucess_rate = 0.5"), "unknown field `sucess_rate`"),
            (with("", ""), "nothing is expected"),
            (with("", "success_rate = 1.5"), "success_rate = 1.5 can never be"),
            (with("", "dead_seen_within = 3"), "can never be tested: no module is unplugged"),
            (with("faults = \"unplug:1\"", "rejoins_within = \"1s\""), "no module is plugged in again"),
            (with("", "no_torque_after_stop = \"2ms\""), "nobody stops the robot"),
            (with("faults = \"explode:1\"", "success_rate = 0.5"), "unknown fault `explode`"),
            (with("episodes = 0", "success_rate = 0.5"), "tests nothing"),
            (with("", "latent_age = \"20\""), "is not a time"),
            (with("[[inject]]\nat = \"1s\"\nframe = \"zz\"", "success_rate = 0.5"), "inject.frame = \"zz\""),
            (
                with(
                    "[[inject]]\nat = \"1s\"\nframe = \"123#\"\ntimes = 4000000000\nevery = \"1ms\"",
                    "success_rate = 0.5",
                ),
                "inject.times = 4000000000 cannot be: 1 to 100000 frames",
            ),
            (with("[[clock]]\nmodule = 1\nppm = 1e9", "success_rate = 0.5"), "clock"),
            ("about = \"x\"\n[expect]\nsuccess_rate = 0.5".into(), "neither task nor policy"),
            ("about = \"x\"\ntask = \"dancing\"\n[expect]\nsuccess_rate = 0.5".into(), "no task `dancing`"),
        ] {
            let error = refused(&text);
            assert!(error.contains(words) && !error.contains('\n'), "{error}");
        }
    }

    fn run(text: &str) -> Verdict {
        let ready = Scenario::parse(text).unwrap();
        let policy = Policy::parse(policies::shipped("goal-reaching").unwrap()).unwrap();
        let config = Arc::new(EnvConfig::new(Task::GoalReaching, Robot::default()));
        let launcher = InProcess::new(policy);
        let observed: Vec<_> = (0..ready.scenario.episodes)
            .map(|index| ready.episode(&launcher, &config, policy, index).unwrap())
            .collect();
        ready.verdict(&observed)
    }

    #[test]
    fn a_module_that_comes_and_goes_is_seen_to_and_a_promise_too_many_is_broken() {
        let text = |expect: &str| {
            format!("about = \"x\"\ntask = \"goal-reaching\"\nfaults = \"unplug:#3@0.2s..0.7s\"\n[expect]\n{expect}")
        };
        let kept = run(&text("dead_seen_within = 4\nrejoins_within = \"400ms\"\nlink_speed = 100.0"));
        assert_eq!(kept.broken, []);
        assert_eq!((kept.tested["dead_seen_within"], kept.tested["rejoins_within"], kept.episodes), (1, 1, 1));
        let broken = run(&text("dead_seen_within = 0\nlink_speed = 0.1\nlatent_age = \"10us\""));
        let words: Vec<&str> = broken.broken.iter().map(|b| b.what.split(':').next().unwrap()).collect();
        assert_eq!(words, ["dead_seen_within", "latent_age", "link_speed"]);
        assert!(broken.broken[0].what.contains("believes module 3 alive") && broken.broken[0].episode == Some(0));
        // An episode that is over before the module comes back tests nothing.
        let late = run(
            "about = \"x\"\ntask = \"goal-reaching\"\nfaults = \"unplug:#3@0.1s..100s\"\n[expect]\nrejoins_within = \"1s\"",
        );
        assert!(late.broken[0].what.contains("no episode lasted long enough"), "{late:?}");
    }
}
