//! `snakectl flash`: makes a module of a board, by the tool `probe-rs` and a debug probe.

use std::io::ErrorKind;
use std::path::PathBuf;
use std::process::{Command, Output};

use anyhow::{Context, Result, bail};
use composer_firmware::failsafe::BusOffPolicy;
use composer_firmware::node_page::NodePage;
use composer_firmware::update::records::of_new_module;
use composer_shared::policy::Policy;
use composer_shared::update::{Key, NO_KEY};

use crate::files::{create_folder, write_whole};
use crate::flash::{CHIP, IMAGE, NOMINAL_CALIBRATION, Plan, calibration, check_image};
use crate::robot::Robot;
use crate::signing;

/// Arguments of `flash`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Number of this module; 0 is the head
    #[arg(long, value_name = "N")]
    node: u8,
    /// Modules of the robot
    #[arg(long, value_name = "M", default_value_t = 8)]
    modules: u8,
    /// Policy image, signed or not, or the name of one that ships
    #[arg(long, value_name = "FILE", default_value = "goal-reaching")]
    policy: String,
    /// Public key of who may change policy and limits later, as `snakectl key new` writes it; a second one for the time in which keys are changed. Without any the module
    /// takes what nobody signed
    #[arg(long, value_name = "FILE")]
    key: Vec<PathBuf>,
    /// What was measured on this module, and its limits; without it the nominal values of host/configs/calibration.toml
    #[arg(long, value_name = "FILE")]
    calibration: Option<PathBuf>,
    /// What to do after bus-off: go on, or stay silent until a restart
    #[arg(long, value_enum, default_value_t = BusOff::Recover)]
    bus_off: BusOff,
    /// The firmware, as `cargo image-stm32g474` builds it
    #[arg(long, value_name = "FILE", default_value = IMAGE)]
    image: PathBuf,
    /// The robot, for its unit of torque; without it the one that ships
    #[arg(long, value_name = "FILE")]
    robot: Option<PathBuf>,
    /// The chip as probe-rs calls it
    #[arg(long, default_value = CHIP)]
    chip: String,
    /// Which probe (VID:PID or VID:PID:SERIAL), if there are several; `probe-rs list` shows them
    #[arg(long)]
    probe: Option<String>,
    /// Write node page and policy into a folder, print the commands, and do not run them
    #[arg(long)]
    dry_run: bool,
    /// The folder of --dry-run
    #[arg(long, value_name = "DIR", default_value = "module", requires = "dry_run")]
    out: PathBuf,
}

#[derive(Clone, Copy, Debug, PartialEq, clap::ValueEnum)]
enum BusOff {
    Recover,
    Latch,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let package = super::update::load(&arguments.policy)?;
    let page = node_page(arguments)?;
    let bytes = page.encode().context("this module cannot be made")?;
    check_image(&arguments.image)?;
    let temporary = tempfile::tempdir().context("cannot make a temporary folder")?;
    let folder = if arguments.dry_run { &*arguments.out } else { temporary.path() };
    create_folder(folder)?;
    let plan = Plan {
        image: arguments.image.clone(),
        policy: folder.join("policy.bin"),
        records: folder.join("records.bin"),
        node_page: folder.join("node-page.bin"),
        chip: arguments.chip.clone(),
        probe: arguments.probe.clone(),
    };
    // An image that nobody signed needs no header.
    write_whole(&plan.policy, if package.signed() { package.bytes() } else { package.image() })?;
    write_whole(&plan.records, &of_new_module(package.header().counter))?;
    write_whole(&plan.node_page, &bytes)?;
    if !arguments.dry_run {
        find_probe()?;
    }
    if arguments.calibration.is_none() {
        eprintln!(
            "snakectl: without --calibration the module gets nominal values and limits, and encoders that were never zeroed"
        );
    }
    if arguments.dry_run {
        for (_, step) in plan.steps() {
            let words: Vec<_> = step.iter().map(|word| quoted(&word.to_string_lossy())).collect();
            println!("probe-rs {}", words.join(" "));
        }
        return Ok(());
    }
    for (what, step) in plan.steps() {
        println!("{what}");
        let output = probe_rs(Command::new("probe-rs").args(&step))?;
        if !output.status.success() {
            bail!(
                "probe-rs could not {what}: {}; is the module powered, its SWD cable in place, and the chip a {}?",
                reason(&output),
                arguments.chip
            );
        }
    }
    println!("{}", summary(&page, package.image()));
    Ok(())
}

fn node_page(arguments: &Arguments) -> Result<NodePage> {
    let robot = arguments.robot.as_deref().map(Robot::load).transpose()?.unwrap_or_default();
    let (text, name) = match &arguments.calibration {
        Some(path) => {
            let name = path.display().to_string();
            let text = std::fs::read_to_string(path);
            (text.with_context(|| format!("cannot read the calibration {name}"))?, name)
        }
        None => (NOMINAL_CALIBRATION.to_string(), "host/configs/calibration.toml".to_string()),
    };
    let (calibration, safety) = calibration(&text, &robot).with_context(|| format!("{name} is no calibration"))?;
    let bus_off = match arguments.bus_off {
        BusOff::Recover => BusOffPolicy::Recover,
        BusOff::Latch => BusOffPolicy::Latch,
    };
    Ok(NodePage {
        node: arguments.node,
        modules: arguments.modules,
        bus_off,
        safety,
        calibration,
        keys: keys(&arguments.key)?,
    })
}

fn keys(files: &[PathBuf]) -> Result<[Key; 2]> {
    let mut keys = [NO_KEY; 2];
    if files.len() > keys.len() {
        bail!("a module has room for two keys: --key is given {} times", files.len());
    }
    for (key, file) in keys.iter_mut().zip(files) {
        *key = signing::public_key(file)?;
    }
    Ok(keys)
}

/// What the module is now.
fn summary(page: &NodePage, policy: &[u8]) -> String {
    let (tag, torque) = Policy::parse(policy).map_or((0, 0.0), |p| (p.tag(), p.limits().torque));
    let part = |motor: usize| {
        let motor = &page.calibration.motors[motor];
        let reached = (motor.current_limit * motor.torque_constant.abs()).min(page.safety.caps.torque);
        (reached / torque * 100.0).min(100.0)
    };
    format!(
        "module {} of {}, policy {tag:04x}; its motors reach {:.0} % (yaw) and {:.0} % (pitch) of the policy's torque",
        page.node,
        page.modules,
        part(0),
        part(1)
    )
}

/// Says so if there is no probe.
fn find_probe() -> Result<()> {
    let output = probe_rs(Command::new("probe-rs").arg("list"))?;
    if !output.status.success() {
        bail!("probe-rs cannot list the debug probes: {}", reason(&output));
    }
    if String::from_utf8_lossy(&output.stdout).contains("No debug probes were found") {
        bail!(
            "there is no debug probe: connect one (ST-LINK, J-Link, CMSIS-DAP) to this computer and to the module's SWD; \
             on Linux it needs the udev rules of https://probe.rs/docs/getting-started/probe-setup/ too"
        );
    }
    Ok(())
}

fn probe_rs(command: &mut Command) -> Result<Output> {
    match command.output() {
        Err(error) if error.kind() == ErrorKind::NotFound => bail!(
            "probe-rs is not installed, or not on the PATH: `cargo install probe-rs-tools --locked`, or see https://probe.rs; \
             --dry-run shows what it would do"
        ),
        output => output.context("cannot start probe-rs"),
    }
}

/// What probe-rs complains about, in one line.
fn reason(output: &Output) -> String {
    let text = String::from_utf8_lossy(&output.stderr);
    let lines: Vec<_> = text.lines().map(str::trim).filter(|line| !line.is_empty()).collect();
    if lines.is_empty() { format!("it ended with {}", output.status) } else { lines.join(" ") }
}

/// A word as a POSIX shell takes it.
fn quoted(word: &str) -> String {
    let plain = |c: char| c.is_ascii_alphanumeric() || "-_./:=,+@".contains(c);
    if !word.is_empty() && word.chars().all(plain) {
        word.to_string()
    } else {
        format!("'{}'", word.replace('\'', r"'\''"))
    }
}
