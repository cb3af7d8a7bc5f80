//! `snakectl export`: from a training run to a policy image.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Result;
use composer_shared::policy::Policy;

use super::policy_file::load_run;
use crate::eval::{Trial, healthy};
use crate::files::write_whole;
use crate::freeze::{freeze, parity};

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
    write_whole(&arguments.out, &image)?;
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
