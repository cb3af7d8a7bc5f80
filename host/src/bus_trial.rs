//! Sets of episodes with complete controllers, each with the frozen policy, on a simulated CAN bus.

use std::cell::RefCell;
use std::io;
use std::sync::Arc;
use std::time::Instant;

use anyhow::{Result, bail};
use composer_firmware::controller::BusKind;
use composer_shared::policy::Policy;
use composer_shared::robot::AXES;
use composer_shared::wire::Frame;
use composer_sim_bridge::capture::Capture;
use composer_sim_bridge::computer::{InProcess, Launcher};
use composer_sim_bridge::external_plant::Address;
use composer_sim_bridge::faults::{FaultKind, FaultPlan, PlannedFault};
use composer_sim_bridge::frame_bits::BitRates;
use composer_sim_bridge::qemu::Qemu;
use composer_sim_bridge::sil::{self, CycleView, Outside, SilConfig, SilReport, Watch};
use serde::Serialize;

use crate::env::EnvConfig;
use crate::eval::{episode_seed, parallel};
use crate::external::Elsewhere;
use crate::mcap::Recording;
use crate::outcome::{Episode, Report};
use crate::recorder::Recorder;
use crate::sil::SnakePlant;

/// The bus and what it does to every frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BusSettings {
    /// Kind of bus.
    pub kind: BusKind,
    /// Nominal bit rate, bit/s, if not the usual one.
    pub bitrate: Option<u32>,
    /// Bit rate of the data phase of CAN-FD, bit/s, if not the usual one.
    pub data_bitrate: Option<u32>,
    /// Receivers lose frames with this probability.
    pub drop: Option<f64>,
    /// Receivers see frames up to this many milliseconds late.
    pub delay: Option<f64>,
    /// The station has one port only, at the head end: a cable that is cut takes it from the tail.
    pub one_port: bool,
    /// Modules that babble get past the guards of their ports: their CAN controllers are broken, not their software.
    pub no_guard: bool,
    /// A module whose sensors say what cannot be true relaxes, as on a board, instead of acting on zeros.
    pub blind_relaxes: bool,
}

impl Default for BusSettings {
    fn default() -> Self {
        Self {
            kind: BusKind::Fd,
            bitrate: None,
            data_bitrate: None,
            drop: None,
            delay: None,
            one_port: false,
            no_guard: false,
            blind_relaxes: false,
        }
    }
}

/// Results on the bus: those of `eval`, and the bus's own.
#[derive(Clone, Debug, Serialize)]
pub struct BusReport {
    /// As `eval` reports.
    #[serde(flatten)]
    pub task: Report,
    /// "classic" or "fd".
    pub bus: &'static str,
    /// Share of the time in which the bus was busy, mean over the episodes.
    pub bus_load: f64,
    /// Largest age of a latent when it was acted on, ms.
    pub latent_age_max_ms: f64,
    /// Times that a live neighbour's latent was missing when a module acted.
    pub deadline_misses: u64,
    /// Error frames on the bus.
    pub error_frames: u64,
    /// Virtual time by wall time of one thread, physics included.
    pub realtime_factor: f64,
    /// Emulated modules that somebody else ended.
    pub lost: usize,
    /// What the comparison with controllers in this process came to.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub parity: Option<Parity>,
}

/// A comparison of emulated modules with controllers in this process.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize)]
pub struct Parity {
    /// Control cycles compared, over all episodes.
    pub cycles: u64,
    /// Torques compared: yaw and pitch of every module at every physics step.
    pub torques: u64,
    /// Those of them whose bits differ.
    pub different: u64,
    /// Episodes in which anything else differs: their length, the bus, the modules' counters.
    pub other: u64,
}

impl Parity {
    fn of(ours: &Outcome, theirs: &Outcome) -> Self {
        let (a, b) = (ours.plant.trace(), theirs.plant.trace());
        let same = a.iter().flatten().zip(b.iter().flatten()).filter(|(a, b)| a == b).count();
        let torques = AXES * a.len().max(b.len());
        Parity {
            cycles: u64::from(ours.plant.judge().steps()),
            torques: torques as u64,
            different: (torques - same) as u64,
            other: u64::from(ours.report != theirs.report || ours.plant.episode() != theirs.plant.episode()),
        }
    }

    fn add(self, other: Self) -> Self {
        Parity {
            cycles: self.cycles + other.cycles,
            torques: self.torques + other.torques,
            different: self.different + other.different,
            other: self.other + other.other,
        }
    }

    /// Whether there is no difference.
    pub fn holds(&self) -> bool {
        self.different == 0 && self.other == 0
    }
}

/// Everything that defines a set of episodes on the bus.
pub struct BusTrial<'a> {
    /// The environment.
    pub config: Arc<EnvConfig>,
    /// The policy image.
    pub image: &'a [u8],
    /// Episodes.
    pub episodes: usize,
    /// Seed of the set.
    pub seed: u64,
    /// Faults of each episode.
    pub fault: &'a FaultPlan,
    /// The bus.
    pub bus: BusSettings,
    /// In what the physics differ from the robot's own, for the report.
    pub physics: String,
    /// Threads; the result does not depend on their number.
    pub threads: usize,
    /// How many of the first episodes to record.
    pub record: usize,
    /// The emulated modules, if the controllers do not run in this process.
    pub qemu: Option<&'a Qemu>,
    /// Compare them with controllers in this process.
    pub parity: bool,
    /// The plant, if it is not this program's own physics.
    pub elsewhere: Option<Elsewhere>,
}

/// What is written down while episodes run.
#[derive(Default)]
pub struct Written<'w> {
    /// How many of the first episodes.
    pub episodes: usize,
    /// The frames on the bus, and what the modules were told and answered.
    pub capture: Option<Capture<'w>>,
    /// All that there is to see.
    pub recording: Option<RefCell<Recording>>,
}

/// Everybody who looks at an episode.
struct Watching<'a, 'w> {
    written: Option<&'a Written<'w>>,
    recorder: &'a mut Option<Recorder>,
}

impl Watching<'_, '_> {
    /// The episode begins.
    fn begin(&self, plant: &SnakePlant) -> io::Result<()> {
        let Some(written) = self.written else { return Ok(()) };
        if let Some(capture) = &written.capture {
            capture.begin_run();
        }
        written.recording.as_ref().map_or(Ok(()), |recording| recording.borrow_mut().begin_episode(plant))
    }
}

impl Watch<SnakePlant> for Watching<'_, '_> {
    fn frame(&mut self, at_ns: u64, piece: usize, frame: &Frame) -> io::Result<()> {
        let Some(written) = self.written else { return Ok(()) };
        if let Some(mut capture) = written.capture.as_ref() {
            Watch::<SnakePlant>::frame(&mut capture, at_ns, piece, frame)?;
        }
        written.recording.as_ref().map_or(Ok(()), |recording| recording.borrow_mut().frame(at_ns, piece, frame))
    }

    fn cycle(&mut self, view: &CycleView<'_>, plant: &SnakePlant) -> io::Result<()> {
        if let Some(recorder) = self.recorder {
            recorder.cycle(view, plant);
        }
        let Some(written) = self.written else { return Ok(()) };
        if let Some(mut capture) = written.capture.as_ref() {
            capture.cycle(view, plant)?;
        }
        written.recording.as_ref().map_or(Ok(()), |recording| recording.borrow_mut().cycle(view, plant))
    }
}

/// One episode on the bus, and how long it took.
struct Run {
    episode: Episode,
    report: SilReport,
    wall: f64,
    recorded: Option<crate::replay::Episode>,
    parity: Option<Parity>,
}

/// What became of the plant, and the report.
struct Outcome {
    plant: SnakePlant,
    report: SilReport,
}

impl BusTrial<'_> {
    fn sil_config(&self, seed: u64) -> SilConfig {
        let usual = SilConfig::new(self.bus.kind);
        let mut sil = SilConfig { ring: !self.bus.one_port, guard: !self.bus.no_guard, ..usual };
        sil.safety.blind_relaxes = self.bus.blind_relaxes;
        if let Some(nominal) = self.bus.bitrate {
            sil.rates = BitRates { nominal, data: sil.rates.data.max(nominal) };
        }
        if let Some(data) = self.bus.data_bitrate {
            sil.rates.data = data;
        }
        let mut plan = self.fault.clone();
        let planned = |kind| PlannedFault { kind, at_ns: None, until_ns: None };
        let varied = self.config.vary.lost(&self.config, seed).map(f64::from);
        plan.faults.extend(self.bus.drop.or(varied.filter(|lost| *lost > 0.0)).map(|p| planned(FaultKind::Drop(p))));
        plan.faults.extend(self.bus.delay.map(|ms| planned(FaultKind::Delay((ms * 1e6) as u64))));
        sil.faults = plan.draw(seed, self.config.robot.modules);
        sil.seed = seed;
        sil
    }

    fn episode(&self, index: usize, written: Option<&Written<'_>>) -> Result<Run> {
        let seed = episode_seed(self.seed, index as u64);
        let sil = self.sil_config(seed);
        let policy = Policy::parse(self.image).map_err(|e| anyhow::anyhow!("{e}"))?;
        let local = InProcess::new(policy);
        let name = format!("episode {}", index + 1);
        let mut recorder = None;
        let start = Instant::now();
        let ours = match self.qemu {
            Some(qemu) => {
                self.simulate(qemu, policy, &sil, written, (index < self.record).then_some(&name), &mut recorder)
            }
            None => self.simulate(&local, policy, &sil, written, (index < self.record).then_some(&name), &mut recorder),
        }
        .map_err(|error| match self.qemu.is_some() || self.elsewhere.is_some() {
            true => error.context(name.clone()),
            false => error,
        })?;
        let wall = start.elapsed().as_secs_f64();
        for lost in &ours.report.lost {
            eprintln!(
                "note: {name}: module {} was lost at {:.3} s: {}",
                lost.module,
                lost.at_ns as f64 * 1e-9,
                lost.how
            );
        }
        let parity = match self.parity {
            false => None,
            true => Some(Parity::of(&ours, &self.simulate(&local, policy, &sil, None, None, &mut None)?)),
        };
        let Outcome { plant, report } = ours;
        let episode = plant.episode();
        let recorded = recorder.map(|r| r.finish(&episode, &report));
        Ok(Run { episode, report, wall, recorded, parity })
    }

    /// Runs one episode with the controllers of `launcher`; `recorder` becomes one if it gets a name.
    fn simulate<L: Launcher>(
        &self,
        launcher: &L,
        policy: Policy<'_>,
        sil: &SilConfig,
        written: Option<&Written<'_>>,
        recorded: Option<&String>,
        recorder: &mut Option<Recorder>,
    ) -> Result<Outcome> {
        let mut plant = match &self.elsewhere {
            Some(elsewhere) => SnakePlant::elsewhere(self.config.clone(), sil.seed, elsewhere)?,
            None => SnakePlant::new(self.config.clone(), sil.seed),
        };
        if self.parity {
            plant.keep_trace();
        }
        *recorder = recorded.map(|name| Recorder::new(name, &plant, &sil.faults));
        let report = self.watched(launcher, &mut plant, policy, sil, None, Watching { written, recorder })?;
        if let Some(trouble) = plant.trouble() {
            bail!("at {:.3} s {trouble}", report.duration_ns as f64 * 1e-9);
        }
        Ok(Outcome { plant, report })
    }

    /// Runs an episode while somebody looks.
    fn watched<L: Launcher>(
        &self,
        launcher: &L,
        plant: &mut SnakePlant,
        policy: Policy<'_>,
        sil: &SilConfig,
        outside: Option<&mut dyn Outside>,
        mut watching: Watching<'_, '_>,
    ) -> Result<SilReport, sil::SilError> {
        watching.begin(plant).map_err(sil::SilError::Capture)?;
        match watching.written.and_then(|written| written.capture.as_ref()) {
            None => sil::run_watched(launcher, plant, policy, sil, outside, &mut watching),
            Some(capture) => sil::run_watched(&capture.recording(launcher), plant, policy, sil, outside, &mut watching),
        }
    }

    fn check(&self) -> Result<()> {
        self.fault.check(self.config.robot.modules)?;
        if self.bus.drop.is_some_and(|p| !(0.0..=1.0).contains(&p)) {
            bail!("--drop is a probability: 0 to 1");
        }
        if self.bus.delay.is_some_and(|ms| !(0.0..=1000.0).contains(&ms)) {
            bail!("--delay is 0 to 1000 ms");
        }
        Ok(())
    }

    /// Runs the first episode with somebody outside, who may be its station, until they end it or for `limit_ns`. It goes on when the task is done.
    pub fn live(
        &self,
        outside: &mut dyn Outside,
        station: bool,
        limit_ns: u64,
        written: &Written<'_>,
    ) -> Result<SilReport> {
        self.check()?;
        let seed = episode_seed(self.seed, 0);
        let sil = SilConfig { station, limit_ns, ..self.sil_config(seed) };
        let policy = Policy::parse(self.image).map_err(|e| anyhow::anyhow!("{e}"))?;
        let mut plant = match &self.elsewhere {
            Some(elsewhere) => SnakePlant::elsewhere(self.config.clone(), seed, elsewhere)?,
            None => SnakePlant::new(self.config.clone(), seed),
        };
        plant.make_endless();
        let (outside, watching) = (Some(outside), Watching { written: Some(written), recorder: &mut None });
        let report = match self.qemu {
            Some(qemu) => self.watched(qemu, &mut plant, policy, &sil, outside, watching),
            None => self.watched(&InProcess::new(policy), &mut plant, policy, &sil, outside, watching),
        }?;
        match plant.trouble() {
            Some(trouble) => bail!("at {:.3} s {trouble}", report.duration_ns as f64 * 1e-9),
            None => Ok(report),
        }
    }

    /// Runs all episodes, those that are written down first, one after the other. `progress` is called after each.
    pub fn run(
        &self,
        written: &Written<'_>,
        progress: &(dyn Fn() + Sync),
    ) -> Result<(BusReport, Vec<crate::replay::Episode>)> {
        self.check()?;
        let mut runs = Vec::with_capacity(self.episodes);
        let alone = written.episodes.min(self.episodes);
        for index in 0..alone {
            runs.push(self.episode(index, Some(written))?);
            progress();
        }
        // A server serves one after the other; the second would wait for its greeting.
        let served = matches!(&self.elsewhere, Some(Elsewhere { address: Address::Tcp(_), .. }));
        let threads = if served { 1 } else { self.threads };
        let rest = parallel(self.episodes - alone, threads, |index| {
            let run = self.episode(index + alone, None);
            progress();
            run
        });
        for run in rest {
            runs.push(run?);
        }
        let n = runs.len() as f64;
        let episodes: Vec<Episode> = runs.iter().map(|r| r.episode).collect();
        let virtual_time: f64 = runs.iter().map(|r| r.report.duration_ns as f64 * 1e-9).sum();
        let report = BusReport {
            task: Report {
                physics: self.physics.clone(),
                ..Report::new(&episodes, &self.config, &self.fault.to_string())
            },
            bus: if self.bus.kind == BusKind::Fd { "fd" } else { "classic" },
            bus_load: runs.iter().map(|r| r.report.bus_load).sum::<f64>() / n,
            latent_age_max_ms: runs.iter().map(|r| r.report.latent_age_max_ms).fold(0.0, f64::max),
            deadline_misses: runs.iter().map(|r| r.report.deadline_misses).sum(),
            error_frames: runs.iter().map(|r| r.report.error_frames).sum(),
            realtime_factor: virtual_time / runs.iter().map(|r| r.wall).sum::<f64>().max(1e-9),
            lost: runs.iter().map(|r| r.report.lost.len()).sum(),
            parity: runs.iter().filter_map(|r| r.parity).reduce(Parity::add),
        };
        Ok((report, runs.into_iter().filter_map(|r| r.recorded).collect()))
    }
}
