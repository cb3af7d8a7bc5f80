//! Rows of policies that ship.

use std::sync::Arc;

use anyhow::{Context, Result};
use composer_shared::policy::Policy;
use composer_sim_bridge::faults::FaultPlan;

use super::policies::world;
use crate::cli::PolicySource;
use crate::cli::export::Measured;
use crate::env::EnvConfig;
use crate::eval::{PUBLISHED_SEED, Trial};
use crate::rows::Rows;

/// The first `episodes` published episodes of a policy that ships, unless they are there already; `words` say what is special about them.
pub fn measured(
    rows: &Rows,
    source: &PolicySource,
    config: &EnvConfig,
    words: &dyn std::fmt::Display,
    plan: &FaultPlan,
    (episodes, threads): (u64, usize),
) -> Result<Measured> {
    let image = source.image().context("what ships is an image")?;
    let crc = Policy::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?.crc();
    let key = format!("{} {crc:08x} {words} episodes={episodes} world={:08x}", config.task.task(), world(config));
    rows.get(&key, || {
        let draw = |seed, modules| plan.draw(seed, modules);
        let trial = Trial {
            config: &Arc::new(config.clone()),
            episodes: episodes as usize,
            seed: PUBLISHED_SEED,
            faults: &draw,
            threads,
        };
        Ok(trial.evaluate(&*source.policy()?, &plan.to_string(), &|| {}).into())
    })
}
