//! `snakectl bench firmware`: instructions of the controller's parts on an emulated Cortex-M4F.

use std::collections::BTreeMap;
use std::io::ErrorKind;
use std::path::PathBuf;
use std::process::{Command, Output, Stdio};
use std::time::{Duration, Instant};

use anyhow::{Context, Result, bail};
use composer_firmware::budget::{CLOCK_HZ, CYCLES_PER_100_INSTRUCTIONS, MEMORY_INSTRUCTIONS, step_instructions};
use composer_sim_bridge::qemu::{PROGRAM, QemuError};

/// What it emulates, and how it counts.
const CONDITIONS: [&str; 11] = [
    "-M",
    "mps2-an386",
    "-nographic",
    "-monitor",
    "none",
    "-serial",
    "none",
    "-icount",
    "shift=0",
    "-semihosting-config",
    "enable=on,target=native",
];
/// Longest that it may take.
const PATIENCE: Duration = Duration::from_secs(120);

/// Arguments of `bench firmware`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Image that counts, an ELF file [default: the one that `cargo qemu-bench` builds]
    #[arg(long, value_name = "FILE")]
    image: Option<PathBuf>,
    /// Print the counts as one JSON object
    #[arg(long)]
    json: bool,
}

/// Runs the image to its end.
fn emulate(image: &PathBuf) -> Result<Output> {
    let mut command = Command::new(PROGRAM);
    command.args(CONDITIONS).arg("-kernel").arg(image).stdin(Stdio::null());
    let mut child = match command.stdout(Stdio::piped()).stderr(Stdio::piped()).spawn() {
        Err(error) if error.kind() == ErrorKind::NotFound => return Err(QemuError::Missing.into()),
        started => started.with_context(|| format!("{PROGRAM} cannot be started"))?,
    };
    // It prints less than a pipe holds, so that nobody has to read along.
    let start = Instant::now();
    while child.try_wait()?.is_none() {
        if start.elapsed() > PATIENCE {
            child.kill()?;
            child.wait()?;
            bail!("{} did not come to an end within {} s", image.display(), PATIENCE.as_secs());
        }
        std::thread::sleep(Duration::from_millis(10));
    }
    Ok(child.wait_with_output()?)
}

/// The counts by name, from lines `name = count`.
fn counts(text: &str) -> BTreeMap<&str, u64> {
    let pairs = text.lines().filter_map(|line| line.split_once(" = "));
    pairs.filter_map(|(name, count)| Some((name, count.parse().ok()?))).collect()
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let default = || {
        crate::cli::built_image("composer-qemu-bench")
            .context("it is not known where this program lies: say where the image is with --image")
    };
    let image = arguments.image.clone().map_or_else(default, Ok)?;
    if !image.is_file() {
        bail!("there is no image that counts at {}: build it with `cargo qemu-bench`", image.display());
    }
    let output = emulate(&image)?;
    // Semihosting prints to standard error.
    let text = [output.stdout, output.stderr].concat();
    let text = String::from_utf8_lossy(&text);
    if !output.status.success() {
        // After a crash the emulator prints all registers.
        bail!("{} failed: {}", image.display(), text.lines().next().unwrap_or("it said nothing"));
    }
    let counts = counts(&text);
    let count = |name: &str| {
        counts.get(name).copied().with_context(|| format!("{} counts no {name}: is it up to date?", image.display()))
    };
    // The repeated call may take an instruction or two more than the empty one.
    if count("calibration")?.abs_diff(1000) > 5 {
        bail!("{PROGRAM} does not count one nanosecond an instruction: a thousand NOPs took {}", count("calibration")?);
    }
    if arguments.json {
        println!("{}", serde_json::to_string(&counts)?);
        return Ok(());
    }

    println!("instructions on an emulated Cortex-M4F ({PROGRAM} -M mps2-an386 -icount shift=0), shipped policy\n");
    let part = |title: &str, name: &str| -> Result<()> {
        println!("{title:<44} {:>8}", count(name)?);
        Ok(())
    };
    for module in [0, 3, 7, 63] {
        part(&format!("kinematics, the head seen from module {module}"), &format!("kinematics/{module}"))?;
    }
    part("attitude filter, one update", "attitude")?;
    part("observation", "observation")?;
    part("encode", "encode")?;
    part("encode, with a memory and the whole observation", "encode_memory")?;
    for modules in [8, 16, 32, 64] {
        part(&format!("attention over {modules} modules"), &format!("attention/{modules}"))?;
    }
    part("actor, without the attention", "actor")?;
    for (title, name) in [("STATE", "state"), ("LATENT", "latent")] {
        part(&format!("framing, {title} built"), &format!("emit/{name}"))?;
        part(&format!("framing, {title} parsed"), &format!("parse/{name}"))?;
    }

    part("service, a frame when nothing is asked", "service/idle")?;
    part("service, a register read and answered", "service/read")?;
    part("update, the signature of a policy", "update/signature")?;
    part("update, a kilobyte of its digest", "update/kilobyte")?;

    println!("\n{:<44} {:>8} {:>10}", "fully connected int8, 64 x 64, requantised", "", "MAC/insn");
    let (dsp, portable) = (count("dense64/dsp")?, count("dense64/portable")?);
    for (title, instructions) in [("with the DSP extension", dsp), ("portable", portable)] {
        println!("{title:<44} {instructions:>8} {:>10.3}", 4096.0 / instructions as f64);
    }
    println!("{:<44} {:>8.2}", "ratio", portable as f64 / dsp as f64);

    println!(
        "\none whole control step of the last module on the bus, CAN-FD, all frames parsed; ms of the longest at {} MHz",
        CLOCK_HZ / 1_000_000
    );
    let cycles = f64::from(CYCLES_PER_100_INSTRUCTIONS) / 100.0;
    let most = format!("{cycles} cycles/insn");
    println!("{:>8} {:>10} {:>10} {:>14} {most:>16} {:>12}", "modules", "mean", "longest", "1 cycle/insn", "may take");
    for (name, more) in [("control_step", 0), ("control_step_memory", MEMORY_INSTRUCTIONS)] {
        if more > 0 {
            println!("the same with a memory, a bias by distance and the whole observation");
        }
        for modules in [8, 16, 32, 64] {
            let mean = count(&format!("{name}/{modules}/mean"))?;
            let longest = count(&format!("{name}/{modules}/max"))?;
            let ms = longest as f64 * 1e3 / f64::from(CLOCK_HZ);
            let budget = step_instructions(modules) + more;
            println!("{modules:>8} {mean:>10} {longest:>10} {ms:>14.2} {:>16.2} {budget:>12}", cycles * ms);
        }
    }
    println!("\na controller is {} bytes, whatever the number of modules", count("controller_bytes")?);
    Ok(())
}
