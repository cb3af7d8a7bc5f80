//! `snakectl sil`: complete controllers, each with the frozen policy, on a simulated CAN bus.

use std::cell::RefCell;
use std::fs::File;
use std::io::BufWriter;
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::time::Duration;

use anyhow::{Context, Result, bail};
use composer_firmware::controller::BusKind;
use composer_shared::policy::Policy;
use composer_sim_bridge::capture::{Capture, Format, Heading};
use composer_sim_bridge::external_plant::{self, Address};
use composer_sim_bridge::qemu::{self, Qemu};
use composer_sim_bridge::sil::SilError;

use super::common::{Common, REPLAYED, table, write_replay};
use crate::bus_trial::{BusReport, BusSettings, BusTrial, Written};
use crate::external::Elsewhere;
use crate::mcap::Recording;
use crate::policy_source::PolicySource;

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
    /// The station has one port only, at the head end, and none at the tail end: a cable that is cut takes it from the tail
    #[arg(long)]
    pub one_port: bool,
    /// Modules that babble get past the guards of their ports: their CAN controllers are broken, not their software
    #[arg(long)]
    pub no_guard: bool,
    /// A module whose sensors say what cannot be true relaxes, as a board does unless told otherwise (`blind_acts`); without this it acts on zeros, as the
    /// paper's does
    #[arg(long)]
    pub blind_relaxes: bool,
}

impl BusOptions {
    /// The bus that is asked for.
    pub fn settings(&self) -> BusSettings {
        let kind = if self.bus == Bus::Fd { BusKind::Fd } else { BusKind::Classic };
        BusSettings {
            kind,
            bitrate: self.bitrate,
            data_bitrate: self.data_bitrate,
            drop: self.drop,
            delay: self.delay,
            one_port: self.one_port,
            no_guard: self.no_guard,
            blind_relaxes: self.blind_relaxes,
        }
    }
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
}

impl Emulation {
    /// The emulated modules, tried out; none if they are not asked for.
    pub fn launcher(&self, image: &[u8]) -> Result<Option<Qemu>> {
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

/// The bus in real time.
#[derive(clap::Args, Clone, Debug)]
pub struct LiveOptions {
    /// Offer the bus to other programs in real time, as a serial CAN adapter: slcan:PATH, a link to a pseudo-terminal; may be given several times.
    /// Goes on until Ctrl-C
    #[arg(long, value_name = "slcan:PATH", value_parser = live_path, conflicts_with_all = ["parity", "replay", "published", "episodes"])]
    live: Vec<PathBuf>,
    /// How many times as fast as real time
    #[arg(long, value_name = "X", default_value_t = 1.0, requires = "live")]
    pace: f64,
    /// No station on the bus: whoever opens the terminal is the station
    #[arg(long, requires = "live")]
    no_station: bool,
    /// Let programs break and mend the robot while it runs: 127.0.0.1:PORT, one line a command, such as `unplug 3`; `help` says what there is
    #[arg(long, value_name = "ADDRESS", requires = "live")]
    control: Option<SocketAddr>,
    /// End after so many seconds of the simulation
    #[arg(long, value_name = "S", requires = "live")]
    seconds: Option<f64>,
}

fn live_path(text: &str) -> Result<PathBuf, String> {
    match text.strip_prefix("slcan:") {
        Some(path) if !path.is_empty() => Ok(path.into()),
        _ => Err("the bus is offered as slcan:PATH, where PATH is where the terminal is to be found".into()),
    }
}

/// What is written down.
#[derive(clap::Args, Clone, Debug)]
pub struct Files {
    /// Write the frames of the first episode as a candump log, or, if its name ends in .pcap, for Wireshark
    #[arg(long, value_name = "FILE")]
    capture: Option<PathBuf>,
    /// Record the first episode for Foxglove, Rerun and other programs that read MCAP files: poses, bus, joints, torques, attention, faults
    #[arg(long, value_name = "FILE.mcap")]
    record: Option<PathBuf>,
    /// Write so many of the first episodes into these files
    #[arg(long, value_name = "N", default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    capture_episodes: u32,
    /// Write beside it, as FILE.modules, what every module was told and answered, so that `snakectl replay` can run one of them again
    #[arg(long, requires = "capture")]
    replayable: bool,
}

/// The files, open.
struct Opened {
    log: Option<(PathBuf, BufWriter<File>)>,
    transcript: Option<(PathBuf, BufWriter<File>)>,
    record: Option<(PathBuf, File)>,
}

impl Files {
    fn open(&self) -> Result<Opened> {
        let pcap = |path: &&PathBuf| path.extension().is_some_and(|extension| extension == "pcap");
        if self.replayable && self.capture.as_ref().is_some_and(|path| pcap(&path)) {
            bail!("--replayable goes with a candump log: `snakectl replay` does not read pcap files");
        }
        let create = |path: PathBuf| match File::create(&path) {
            Ok(file) => Ok((path, file)),
            Err(error) => Err(error).with_context(|| format!("cannot write {}", path.display())),
        };
        let buffered = |path| create(path).map(|(path, file)| (path, BufWriter::new(file)));
        let log = self.capture.clone().map(buffered).transpose()?;
        let transcript = self.capture.as_deref().filter(|_| self.replayable).map(transcript_of);
        let record = self.record.clone().map(create).transpose()?;
        Ok(Opened { log, transcript: transcript.map(buffered).transpose()?, record })
    }
}

/// Where the transcript of a log lies.
pub fn transcript_of(log: &Path) -> PathBuf {
    let mut name = log.as_os_str().to_owned();
    name.push(".modules");
    name.into()
}

impl Opened {
    /// What is to be written down in these files, of runs with this policy.
    fn written(&mut self, policy: &str, trial: &BusTrial<'_>, episodes: usize) -> Result<Written<'_>> {
        let mut written = Written::default();
        if let Some((path, log)) = &mut self.log {
            let pcap = path.extension().is_some_and(|extension| extension == "pcap");
            let mut capture = Capture::new(log, if pcap { Format::Pcap } else { Format::Candump })?;
            if let Some((_, transcript)) = &mut self.transcript {
                let image = Policy::parse(trial.image).map_err(|e| anyhow::anyhow!("{e}"))?;
                let heading = Heading::new(policy, &image, trial.config.robot.modules);
                capture = capture.with_transcript(transcript, &heading);
            }
            written.capture = Some(capture);
        }
        if let Some((path, file)) = &self.record {
            let recording =
                Recording::new(file.try_clone()?).with_context(|| format!("cannot write {}", path.display()))?;
            written.recording = Some(RefCell::new(recording));
        }
        let any = written.capture.is_some() || written.recording.is_some();
        Ok(Written { episodes: if any { episodes } else { 0 }, ..written })
    }

    fn paths(&self) -> impl Iterator<Item = &PathBuf> {
        let record = self.record.iter().map(|(path, _)| path);
        self.log.iter().chain(&self.transcript).map(|(path, _)| path).chain(record)
    }
}

/// What has been written is whole.
fn finish(written: Written<'_>) -> Result<()> {
    let recorded = written.recording.map_or(Ok(()), |recording| recording.into_inner().finish());
    let captured = written.capture.map_or(Ok(()), Capture::finish);
    Ok(recorded.and(captured).map_err(SilError::Capture)?)
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
    /// Run every episode in this process too, and compare all torques bit for bit
    #[arg(long, requires = "qemu")]
    parity: bool,
    #[command(flatten)]
    plant: PlantOptions,
    #[command(flatten)]
    live: LiveOptions,
    #[command(flatten)]
    files: Files,
    /// Write the first episodes as one HTML page to look at
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,
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
    let record = if arguments.replay.is_some() { REPLAYED } else { 0 };
    let qemu = arguments.emulation.launcher(image)?;
    let trial = BusTrial {
        config: config.clone(),
        image,
        episodes: common.episodes() as usize,
        seed: common.seed(),
        fault: &common.fault,
        bus: arguments.bus.settings(),
        physics: common.physics.to_string(),
        threads: common.threads.unwrap_or_else(super::cores),
        record,
        qemu: qemu.as_ref(),
        parity: arguments.parity,
        elsewhere: arguments.plant.elsewhere()?,
    };
    let mut files = arguments.files.open()?;
    let written = files.written(&common.policy, &trial, arguments.files.capture_episodes as usize)?;
    if !arguments.live.live.is_empty() {
        run_live(&trial, &arguments.live, &written)?;
        return finish(written);
    }
    let bar = common.bar();
    let (report, recorded) = trial.run(&written, &|| bar.inc(1))?;
    bar.finish_and_clear();
    finish(written)?;
    if let Some(path) = &arguments.replay {
        let title = format!("{} on the simulated bus", config.task.task().title());
        write_replay(&config, &title, recorded, &common.policy, path)?;
    }
    if common.json {
        println!("{}", serde_json::to_string(&report)?);
    } else {
        print!("{}{}", table(&report.task), bus_table(&report));
        for path in files.paths().chain(&arguments.replay) {
            println!("  written: {}", path.display());
        }
    }
    if report.parity.is_some_and(|parity| !parity.holds()) {
        bail!("the emulated modules and those in this process do not do the same: see the line about parity");
    }
    Ok(())
}

/// Offers the bus in real time until Ctrl-C.
#[cfg(unix)]
fn run_live(trial: &BusTrial<'_>, options: &LiveOptions, written: &Written<'_>) -> Result<()> {
    use composer_sim_bridge::control::Control;
    use composer_sim_bridge::live::{Live, Terminal};
    if !(0.001..=1000.0).contains(&options.pace) {
        bail!("--pace is 0.001 to 1000 times real time");
    }
    if options.seconds.is_some_and(|seconds| !(0.001..=1e9).contains(&seconds)) {
        bail!("--seconds is 0.001 to 1000000000");
    }
    let ended = super::interrupted()?;
    let control = options.control.map(Control::listen).transpose()?;
    let open = |path: &PathBuf| Terminal::open(path, trial.bus.kind == BusKind::Fd);
    let terminals = options.live.iter().map(open).collect::<Result<Vec<_>, _>>()?;
    for path in &options.live {
        eprintln!("{} modules on the bus slcan:{}; Ctrl-C ends it", trial.config.robot.modules, path.display());
    }
    if let Some(control) = &control {
        eprintln!("commands are taken at {}", control.address());
    }
    let mut live = Live::new(terminals, options.pace, &ended).commanded(control);
    let limit_ns = options.seconds.map_or(u64::MAX, |seconds| (seconds * 1e9) as u64);
    let report = trial.live(&mut live, !options.no_station, limit_ns, written)?;
    for lost in &report.lost {
        eprintln!("note: module {} was lost at {:.3} s: {}", lost.module, lost.at_ns as f64 * 1e-9, lost.how);
    }
    let frames: u64 = live.terminals().iter().map(Terminal::lost).sum();
    if frames > 0 {
        eprintln!("note: {frames} frames were lost because a program did not read its terminal");
    }
    let behind = live.behind().as_secs_f64();
    println!(
        "{:.1} s simulated, {} frames, {behind:.1} s behind the clock",
        report.duration_ns as f64 * 1e-9,
        report.frames
    );
    Ok(())
}

#[cfg(not(unix))]
fn run_live(_: &BusTrial<'_>, _: &LiveOptions, _: &Written<'_>) -> Result<()> {
    bail!("--live needs pseudo-terminals, which Linux and macOS have");
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
