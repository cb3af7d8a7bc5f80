//! `snakectl sil`: complete controllers, each with the frozen policy, on a simulated CAN bus.

use std::io::Write;
use std::path::PathBuf;
use std::sync::Arc;
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use composer_firmware::controller::{BusKind, Timing};
use composer_shared::policy::Policy;
use composer_shared::robot::AXES;
use composer_sim_bridge::computer::{InProcess, Launcher};
use composer_sim_bridge::external_plant::{self, Address};
use composer_sim_bridge::faults::{FaultKind, PlannedFault};
use composer_sim_bridge::frame_bits::BitRates;
use composer_sim_bridge::qemu::{self, Qemu};
use composer_sim_bridge::sil::{self, SilConfig, SilReport};
use serde::Serialize;

use super::PolicySource;
use super::eval::{Common, table};
use crate::env::EnvConfig;
use crate::eval::{Episode, Report, episode_seed, parallel};
use crate::external::Elsewhere;
use crate::files::write_whole;
use crate::recorder::Recorder;
use crate::sil::SnakePlant;

/// Kind of bus, on the command line.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum Bus {
    /// Classic CAN: 8-byte frames, a latent in 8 fragments.
    Classic,
    /// CAN-FD with bit-rate switching: a latent in one frame.
    #[default]
    Fd,
}

/// The bus and its faults.
#[derive(clap::Args, Clone, Debug, Default)]
pub struct BusOptions {
    /// Kind of bus
    #[arg(long, value_enum, default_value_t = Bus::Fd)]
    pub bus: Bus,
    /// Nominal bit rate, bit/s [default: 1000000]
    #[arg(long, value_name = "B")]
    pub bitrate: Option<u32>,
    /// Bit rate of the data phase of CAN-FD, bit/s [default: 5000000]
    #[arg(long, value_name = "B")]
    pub data_bitrate: Option<u32>,
    /// Receivers lose frames with this probability
    #[arg(long, value_name = "P")]
    pub drop: Option<f64>,
    /// Receivers see frames up to this many milliseconds late
    #[arg(long, value_name = "MS")]
    pub delay: Option<f64>,
}

/// What the controllers run on.
#[derive(clap::Args, Clone, Debug)]
pub struct Emulation {
    /// Run every module's firmware image in an emulated microcontroller of its own (needs qemu-system-arm)
    #[arg(long)]
    pub qemu: bool,
    /// Image of the module, an ELF file [default: the one that `cargo qemu-image` builds]
    #[arg(long, value_name = "FILE", requires = "qemu")]
    pub qemu_image: Option<PathBuf>,
    /// Seconds after which an emulated module that does not answer is given up
    #[arg(long, value_name = "S", requires = "qemu", default_value_t = qemu::PATIENCE.as_secs_f64())]
    pub qemu_timeout: f64,
    /// Run every episode in this process too, and compare all torques bit for bit
    #[arg(long, requires = "qemu")]
    pub parity: bool,
}

impl Emulation {
    /// The emulated modules, tried out; none if they are not asked for.
    fn launcher(&self, image: &[u8]) -> Result<Option<Qemu>> {
        if !self.qemu {
            return Ok(None);
        }
        if !(0.001..=86_400.0).contains(&self.qemu_timeout) {
            bail!("--qemu-timeout is 0.001 to 86400 s");
        }
        let firmware = match &self.qemu_image {
            Some(file) => file.clone(),
            None => super::built_image("composer-qemu")
                .context("it is not known where this program lies: say where the image is with --qemu-image")?,
        };
        let qemu = Qemu::new(&firmware, image, Duration::from_secs_f64(self.qemu_timeout))?;
        let policy = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
        if !qemu.probe(&policy)?.same_controller {
            eprintln!(
                "note: {} was not built from the sources of this program; `cargo qemu-image` builds it anew",
                firmware.display()
            );
        }
        Ok(Some(qemu))
    }
}

/// What the controllers control.
#[derive(clap::Args, Clone, Debug)]
pub struct PlantOptions {
    /// Control a plant elsewhere: a command that is started for every episode, or tcp:127.0.0.1:PORT (see sim-bridge/plant-protocol.md)
    #[arg(long, value_name = "CMD")]
    plant: Option<Address>,
    /// Seconds after which a plant that does not answer is given up
    #[arg(long, value_name = "S", requires = "plant", default_value_t = external_plant::PATIENCE.as_secs_f64())]
    plant_timeout: f64,
}

impl PlantOptions {
    fn elsewhere(&self) -> Result<Option<Elsewhere>> {
        if !(0.001..=86_400.0).contains(&self.plant_timeout) {
            bail!("--plant-timeout is 0.001 to 86400 s");
        }
        let patience = Duration::from_secs_f64(self.plant_timeout);
        Ok(self.plant.clone().map(|address| Elsewhere { address, patience }))
    }
}

/// Arguments of `sil`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    #[command(flatten)]
    common: Common,
    #[command(flatten)]
    bus: BusOptions,
    #[command(flatten)]
    emulation: Emulation,
    #[command(flatten)]
    plant: PlantOptions,
    /// Write the frames of the first episode as a candump log
    #[arg(long, value_name = "FILE")]
    capture: Option<PathBuf>,
    /// Write the first episodes as one HTML page to look at
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,
}

/// Episodes in a replay.
pub const REPLAYED: usize = 4;

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
    /// Episodes, seed, faults.
    pub common: &'a Common,
    /// The bus.
    pub bus: &'a BusOptions,
    /// How many of the first episodes to record.
    pub record: usize,
    /// The emulated modules, if the controllers do not run in this process.
    pub qemu: Option<&'a Qemu>,
    /// Compare them with controllers in this process.
    pub parity: bool,
    /// The plant, if it is not this program's own physics.
    pub elsewhere: Option<Elsewhere>,
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
        let kind = if self.bus.bus == Bus::Fd { BusKind::Fd } else { BusKind::Classic };
        let mut sil = SilConfig::new(kind);
        if let Some(nominal) = self.bus.bitrate {
            sil.rates = BitRates { nominal, data: sil.rates.data.max(nominal) };
        }
        if let Some(data) = self.bus.data_bitrate {
            sil.rates.data = data;
        }
        let mut plan = self.common.fault.clone();
        let planned = |kind| PlannedFault { kind, at_ns: None, until_ns: None };
        plan.faults.extend(self.bus.drop.map(|p| planned(FaultKind::Drop(p))));
        plan.faults.extend(self.bus.delay.map(|ms| planned(FaultKind::Delay((ms * 1e6) as u64))));
        sil.faults = plan.draw(seed, self.config.robot.modules);
        sil.seed = seed;
        sil
    }

    fn episode(&self, index: usize, capture: Option<&mut dyn Write>) -> Result<Run> {
        let seed = episode_seed(self.common.seed(), index as u64);
        let sil = self.sil_config(seed);
        let policy = Policy::parse(self.image).map_err(|e| anyhow::anyhow!("{e}"))?;
        let local = InProcess::new(policy);
        let name = format!("episode {}", index + 1);
        let mut recorder = None;
        let start = Instant::now();
        let ours = match self.qemu {
            Some(qemu) => {
                self.simulate(qemu, policy, &sil, capture, (index < self.record).then_some(&name), &mut recorder)
            }
            None => self.simulate(&local, policy, &sil, capture, (index < self.record).then_some(&name), &mut recorder),
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
        capture: Option<&mut dyn Write>,
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
        let report = sil::run_on(launcher, &mut plant, policy, sil, capture, &mut |cycle, plant| {
            if let Some(recorder) = recorder {
                recorder.cycle(cycle, plant);
            }
        })?;
        if let Some(trouble) = plant.trouble() {
            bail!("at {:.3} s {trouble}", report.duration_ns as f64 * 1e-9);
        }
        Ok(Outcome { plant, report })
    }

    /// Runs all episodes. `progress` is called after each.
    pub fn run(
        &self,
        capture: Option<&mut dyn Write>,
        progress: &(dyn Fn() + Sync),
    ) -> Result<(BusReport, Vec<crate::replay::Episode>)> {
        let episodes = self.common.episodes() as usize;
        self.common.fault.check(self.config.robot.modules)?;
        if self.bus.drop.is_some_and(|p| !(0.0..=1.0).contains(&p)) {
            bail!("--drop is a probability: 0 to 1");
        }
        if self.bus.delay.is_some_and(|ms| !(0.0..=1000.0).contains(&ms)) {
            bail!("--delay is 0 to 1000 ms");
        }
        let mut runs = Vec::with_capacity(episodes);
        let alone = usize::from(capture.is_some());
        if capture.is_some() {
            runs.push(self.episode(0, capture)?);
            progress();
        }
        // A server serves one after the other; the second would wait for its greeting.
        let served = matches!(&self.elsewhere, Some(Elsewhere { address: Address::Tcp(_), .. }));
        let threads = if served { 1 } else { self.common.threads.unwrap_or_else(super::cores) };
        let rest = parallel(episodes - alone, threads, |index| {
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
                physics: self.common.physics.to_string(),
                ..Report::new(&episodes, &self.config, &self.common.fault.to_string())
            },
            bus: if self.bus.bus == Bus::Fd { "fd" } else { "classic" },
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

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let common = &arguments.common;
    let source = PolicySource::load(&common.policy)?;
    let Some(image) = source.image() else {
        bail!(
            "{} is no policy image: sil runs what is flashed, so freeze the run first with `snakectl export`",
            common.policy
        );
    };
    let config = Arc::new(common.environment(&source)?);
    warn_if_crowded(&arguments.bus, &config);
    let record = if arguments.replay.is_some() { REPLAYED } else { 0 };
    let qemu = arguments.emulation.launcher(image)?;
    let trial = BusTrial {
        config: config.clone(),
        image,
        common,
        bus: &arguments.bus,
        record,
        qemu: qemu.as_ref(),
        parity: arguments.emulation.parity,
        elsewhere: arguments.plant.elsewhere()?,
    };
    let mut captured = Vec::new();
    let capture: Option<&mut dyn Write> = if arguments.capture.is_some() { Some(&mut captured) } else { None };
    let bar = common.bar();
    let (report, recorded) = trial.run(capture, &|| bar.inc(1))?;
    bar.finish_and_clear();
    if let Some(path) = &arguments.capture {
        write_whole(path, &captured)?;
    }
    if let Some(path) = &arguments.replay {
        let title = format!("{} on the simulated bus", config.task.task().title());
        write_replay(&config, &title, recorded, &common.policy, path)?;
    }
    if common.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print!("{}{}", table(&report.task), bus_table(&report));
        for path in arguments.capture.iter().chain(&arguments.replay) {
            println!("  written: {}", path.display());
        }
    }
    if report.parity.is_some_and(|parity| !parity.holds()) {
        bail!("the emulated modules and those in this process do not do the same: see the line about parity");
    }
    Ok(())
}

/// Says so if the frames of a cycle do not fit the control period (at the default bit rates): it still runs, but the tail is never heard.
fn warn_if_crowded(bus: &BusOptions, config: &EnvConfig) {
    let kind = if bus.bus == Bus::Fd { BusKind::Fd } else { BusKind::Classic };
    let modules = config.robot.modules as u8;
    let needed_ms = f64::from(Timing::bus_time_us(kind, modules, config.task.task().points(modules))) * 1e-3;
    let period_ms = f64::from(config.control_period) * 1e3;
    if bus.bitrate.is_none() && needed_ms > period_ms {
        eprintln!(
            "note: {} modules need {needed_ms:.0} ms of a {} bus in every {period_ms:.0} ms; those farthest from the head will not be heard",
            config.robot.modules,
            if kind == BusKind::Fd { "CAN-FD" } else { "classic CAN" }
        );
    }
}

/// The lines about the bus.
pub fn bus_table(report: &BusReport) -> String {
    let mut text = format!(
        "  bus {}: load {:.1} %, oldest latent {:.1} ms, {} deadline misses, {} error frames, {:.*} times real time\n",
        report.bus,
        100.0 * report.bus_load,
        report.latent_age_max_ms,
        report.deadline_misses,
        report.error_frames,
        if report.realtime_factor < 10.0 { 2 } else { 0 },
        report.realtime_factor
    );
    if let Some(parity) = &report.parity {
        text += &format!(
            "  parity with controllers in this process: {} torques of {} control cycles compared, {} differ; {} episodes differ in anything else\n",
            parity.torques, parity.cycles, parity.different, parity.other
        );
    }
    text
}

/// Writes recorded episodes as one page.
pub fn write_replay(
    config: &EnvConfig,
    title: &str,
    episodes: Vec<crate::replay::Episode>,
    policy: &str,
    path: &std::path::Path,
) -> Result<()> {
    let mut recording = crate::recorder::recording(config, title, policy);
    for episode in episodes {
        recording.push(episode);
    }
    recording.write_html(path).with_context(|| format!("no replay in {}", path.display()))
}
