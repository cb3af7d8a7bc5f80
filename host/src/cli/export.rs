//! `snakectl export`: from a training run to a policy image, its manifest, and the metrics of its run.

use std::path::{Path, PathBuf};
use std::sync::Arc;

use anyhow::{Context, Result};
use composer_shared::policy::Policy;
use composer_sim_bridge::faults::FaultPlan;
use serde::Serialize;

use super::policy_file::load_run;
use crate::eval::{Pilot, Report, Trial, healthy};
use crate::files::write_whole;
use crate::freeze::{Parity, freeze, parity};
use crate::run::RunConfig;

/// Seeds of the episodes that scales are taken from, and of those that parity is measured on.
const CALIBRATION_SEED: u64 = 0xca11;
const HELD_OUT_SEED: u64 = 0x4e1d;

/// Arguments of `export`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Folder of the training run
    run: PathBuf,
    /// Policy image to write
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Episodes that scales are taken from, and as many others that parity is measured on
    #[arg(long, default_value_t = 24, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    episodes: u64,
    /// Episodes for each figure of the manifest
    #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    measured_episodes: u64,
}

/// Seed of the manifest's figures, the default of `eval`.
const MANIFEST_SEED: u64 = 1;

/// What is written beside an image: where it comes from and what it can do.
#[derive(Serialize)]
struct Manifest {
    task: &'static str,
    image_bytes: usize,
    crc32: String,
    /// Version control's name of the state that trained or at least froze it; "unknown" outside a repository.
    commit: String,
    trained_with_faults: bool,
    /// Wall time of the run, since it was started or last resumed, on the machine that trained it, s.
    wall_seconds: f64,
    parity: Parity,
    measured: Vec<Measured>,
    run: RunConfig,
}

/// One row of measured success: the integer policy in the simulator (`snakectl eval`).
#[derive(Serialize)]
struct Measured {
    fault: String,
    modules: usize,
    episodes: usize,
    success_rate: f64,
    success_rate_se: f64,
    steps_mean: f64,
}

fn measure(trial: &Trial, policy: Policy, modules: usize, fault: &str) -> Result<Report> {
    let plan: FaultPlan = fault.parse().with_context(|| format!("the fault {fault}"))?;
    let draw = |seed, modules| plan.draw(seed, modules);
    let robot = trial.config.robot.with_modules(modules)?;
    let config = Arc::new(crate::env::EnvConfig { robot, ..(**trial.config).clone() });
    Ok(Trial { config: &config, faults: &draw, ..*trial }.evaluate(Pilot::Integer(policy), fault, &|| {}))
}

fn commit() -> String {
    let output =
        std::process::Command::new("git").args(["rev-parse", "HEAD"]).stderr(std::process::Stdio::null()).output();
    match output {
        Ok(output) if output.status.success() => String::from_utf8_lossy(&output.stdout).trim().to_string(),
        _ => "unknown".into(),
    }
}

/// Wall time that the last line of a run's metrics tells.
fn wall_seconds(run: &Path) -> f64 {
    let text = std::fs::read_to_string(run.join("metrics.jsonl")).unwrap_or_default();
    let last = text.lines().last().and_then(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    last.and_then(|line| line["time/wall_seconds"].as_f64()).unwrap_or(0.0)
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let (config, network) = load_run(&arguments.run)?;
    let env = Arc::new(config.evaluation());
    let draw = |seed, modules| config.faults.draw(seed, modules);
    let trial = Trial {
        config: &env,
        episodes: arguments.episodes as usize,
        seed: CALIBRATION_SEED,
        faults: if config.faults.probability > 0.0 { &draw } else { &healthy },
        threads: super::cores(),
    };
    let image = freeze(&network, &config.meta(), &trial.observations(&network))?;
    let policy = Policy::parse(&image).map_err(|e| anyhow::anyhow!("the frozen image is refused: {e}"))?;
    let held_out = Trial { seed: HELD_OUT_SEED, ..trial }.observations(&network);
    let parity = parity(&network, &policy, &held_out);
    let mut measured = Vec::new();
    let measuring = Trial {
        config: &env,
        episodes: arguments.measured_episodes as usize,
        seed: MANIFEST_SEED,
        faults: &healthy,
        threads: super::cores(),
    };
    let own = config.robot.modules;
    let faults = ["none", "unplug:1", "unplug:2", "action:1", "action:2", "observation:1"];
    let lengths = [9, 10, 11, 16].map(|modules| (modules, "none"));
    for (modules, fault) in faults.map(|fault| (own, fault)).into_iter().chain(lengths) {
        let report = measure(&measuring, policy, modules, fault)?;
        measured.push(Measured {
            fault: report.fault,
            modules,
            episodes: report.episodes,
            success_rate: report.success_rate,
            success_rate_se: report.success_rate_se,
            steps_mean: report.steps_mean,
        });
    }
    let manifest = Manifest {
        task: policy.task().name(),
        image_bytes: image.len(),
        crc32: format!("{:08x}", policy.crc()),
        commit: commit(),
        trained_with_faults: policy.trained_with_faults(),
        wall_seconds: wall_seconds(&arguments.run),
        parity,
        measured,
        run: config.clone(),
    };
    let metrics = std::fs::read(arguments.run.join("metrics.jsonl"))
        .with_context(|| format!("cannot read the metrics of {}", arguments.run.display()))?;
    write_whole(&arguments.out, &image)?;
    write_whole(&arguments.out.with_extension("toml"), toml::to_string(&manifest)?.as_bytes())?;
    write_whole(&arguments.out.with_extension("metrics.jsonl"), &metrics)?;
    for m in &manifest.measured {
        println!(
            "{:>2} modules, {:<14} success {:.3} +- {:.3}, {:.1} steps",
            m.modules, m.fault, m.success_rate, m.success_rate_se, m.steps_mean
        );
    }
    println!(
        "{}: {} bytes, CRC-32 {:08x}\nfloat against integer actions on {} held-out samples: rms {:.5}, 99 % within {:.5}, max {:.5} of the torque limit",
        arguments.out.display(),
        image.len(),
        policy.crc(),
        parity.samples,
        parity.rms,
        parity.p99,
        parity.max
    );
    Ok(())
}
