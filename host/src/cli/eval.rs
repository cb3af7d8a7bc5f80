//! `snakectl eval`: a policy in the simulator, without a bus.

use std::path::PathBuf;
use std::sync::Arc;

use anyhow::{Result, bail};

use super::common::{Common, REPLAYED, table, write_replay};
use crate::env::knows_fault;
use crate::eval::Trial;
use crate::policy_source::PolicySource;
use crate::recorder::record;

/// Arguments of `eval`.
#[derive(clap::Args, Clone, Debug)]
pub struct Arguments {
    #[command(flatten)]
    common: Common,
    /// Write the first episodes as one HTML page to look at
    #[arg(long, value_name = "FILE")]
    replay: Option<PathBuf>,
}

/// Runs the verb.
pub fn run(arguments: &Arguments) -> Result<()> {
    let common = &arguments.common;
    let source = PolicySource::load(&common.policy)?;
    let config = Arc::new(common.environment(&source)?);
    common.fault.check(config.robot.modules)?;
    if let Some(fault) = common.fault.faults.iter().find(|fault| !knows_fault(&fault.kind)) {
        bail!("{fault} happens on a bus: `snakectl sil` has one; eval knows action, observation, unplug and cut");
    }
    let bar = common.bar();
    let draw = common.draw();
    let trial = Trial {
        config: &config,
        episodes: common.episodes() as usize,
        seed: common.seed(),
        faults: &draw,
        threads: common.threads.unwrap_or_else(super::cores),
    };
    let policy = source.policy()?;
    let mut report = trial.evaluate(&*policy, &common.fault.to_string(), &|| bar.inc(1));
    report.physics = common.physics.to_string();
    bar.finish_and_clear();
    if let Some(path) = &arguments.replay {
        let title = format!("{} in the simulator", config.task.task().title());
        write_replay(&config, &title, record(&trial, &*policy, REPLAYED), &common.policy, path)?;
    }
    if common.json {
        println!("{}", serde_json::to_string(&report)?);
        return Ok(());
    }
    print!("{}", table(&report));
    if let Some(path) = &arguments.replay {
        println!("  written: {}", path.display());
    }
    Ok(())
}
