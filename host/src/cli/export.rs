//! `snakectl export`: from a training run to a policy image, its manifest, and the metrics of its run. `report policies` does the same with several runs.

use std::path::PathBuf;

use anyhow::Result;
use composer_shared::policy::Policy;

use crate::eval::PUBLISHED_EPISODES;
use crate::release::export::Exported;
use crate::release::measured::{measure, rows};
use crate::run_folder::{CALIBRATION_EPISODES, freeze_run, metrics_with_pretraining};
use crate::stats::with_interval;

/// Arguments of `export`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    /// Folder of the training run
    run: PathBuf,
    /// Policy image to write
    #[arg(short, long, value_name = "FILE")]
    out: PathBuf,
    /// Episodes that scales are taken from, and as many others that parity is measured on
    #[arg(long, default_value_t = CALIBRATION_EPISODES, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    episodes: u64,
    /// Episodes for each figure of the manifest, the first of the published ones (`snakectl eval --published`)
    #[arg(long, default_value_t = PUBLISHED_EPISODES, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    measured_episodes: u64,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let threads = super::cores();
    let (config, image, parity) = freeze_run(&arguments.run, arguments.episodes, threads)?;
    let env = config.evaluation();
    let measured = rows(config.task.name, config.robot.modules)
        .into_iter()
        .map(|row| measure(&env, &image, row, arguments.measured_episodes, threads))
        .collect::<Result<Vec<_>>>()?;
    let metrics = metrics_with_pretraining(&arguments.run)?;
    for m in &measured {
        println!(
            "{:>2} modules, {:<14} {:<16} success {}, {:.1} steps of at most {}",
            m.modules,
            m.fault,
            m.on,
            with_interval(m.success_rate, m.success_low, m.success_high, 3),
            m.steps_mean,
            m.cap
        );
    }
    let exported = Exported { config, run: &arguments.run, image: &image, parity, measured, seeds: Vec::new() };
    exported.write(&arguments.out, metrics.as_bytes())?;
    let policy = Policy::parse(&image).map_err(|e| anyhow::anyhow!("{e}"))?;
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
