//! Settings tuned equally for all: every method gets the same number of trials on every task, so that a baseline that loses does not lose by its settings.
//!
//! A trial is a run of half the protocol's steps with a seed that is used for nothing else ([`SEED`]). The first trial has the method's own settings; the
//! others draw each knob anew, the same draw for every task: the learning rate within a factor of four either way, and what else its authors tune
//! ([`knobs`]). The best trial is that of the highest success in the second half of its learning curve, on episodes of its own; of equals, the earlier.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::{Context, Result, bail};
use composer_shared::policy::Task;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use serde::{Deserialize, Serialize};

use super::work::{Progress, progress};
use super::{Comparison, Run, protocol};
use crate::files::write_whole;
use crate::methods::Method;
use crate::run_folder::metrics;

/// Seed of the first trial; the others count on from it.
pub const SEED: u64 = 1_000_000;
/// Share of the protocol's steps that a trial has.
const SHARE: f64 = 0.5;
/// What the best settings are kept in.
pub const FILE: &str = "tuned.json";

/// A setting that is tuned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Knob {
    /// Around its default, evenly in its logarithm, within a factor of four either way.
    Rate(&'static str, f64),
    /// One of these.
    Choice(&'static str, &'static [f64]),
}

/// What is tuned of a method.
pub fn knobs(method: Method) -> Vec<Knob> {
    use Knob::{Choice, Rate};
    let defaults = crate::methods::TrainConfig::default();
    match method {
        Method::Ppo => vec![
            Rate("ppo.learning_rate", defaults.ppo.learning_rate),
            Choice("ppo.clip", &[0.1, 0.2, 0.3]),
            Choice("ppo.gamma", &[0.97, 0.99]),
            Choice("ppo.entropy", &[0.0, 0.001, 0.01]),
        ],
        Method::Mappo => vec![
            Rate("mappo.learning_rate", defaults.mappo.learning_rate),
            Choice("mappo.clip", &[0.1, 0.2, 0.3]),
            Choice("mappo.gamma", &[0.97, 0.99]),
            Choice("mappo.entropy", &[0.0, 0.001, 0.01]),
        ],
        Method::Mat => vec![
            Rate("mat.learning_rate", defaults.mat.learning_rate),
            Choice("mat.clip", &[0.05, 0.1, 0.2]),
            Choice("mat.gamma", &[0.97, 0.99]),
            Choice("mat.entropy", &[0.0, 0.001, 0.01]),
        ],
        Method::MatDec => vec![
            Rate("mat_dec.learning_rate", defaults.mat_dec.learning_rate),
            Choice("mat_dec.clip", &[0.05, 0.1, 0.2]),
            Choice("mat_dec.gamma", &[0.97, 0.99]),
            Choice("mat_dec.entropy", &[0.0, 0.001, 0.01]),
        ],
        Method::Smp => vec![
            Rate("smp.learning_rate", defaults.smp.learning_rate),
            Choice("smp.tau", &[0.005, 0.02, 0.046]),
            Choice("smp.gamma", &[0.97, 0.99]),
            Choice("smp.exploration", &[0.126, 0.2, 0.4]),
        ],
        _ => vec![
            Rate("train.learning_rate", protocol::COMPOSER_RATE),
            Choice("train.clip", &[0.1, 0.2, 0.3]),
            Choice("train.gamma", &[0.97, 0.99]),
            Choice("train.entropy", &[0.0, 0.001, 0.01]),
        ],
    }
}

/// The settings of a trial, `key=value`; none for the first one.
pub fn settings(method: Method, trial: u64) -> Vec<String> {
    let mut rng = ChaCha8Rng::seed_from_u64(SEED + trial);
    let draw = |knob: Knob| match knob {
        Knob::Rate(key, default) => format!("{key}={:.3e}", default * 4f64.powf(rng.random_range(-1.0..1.0))),
        Knob::Choice(key, values) => format!("{key}={:?}", values[rng.random_range(0..values.len())]),
    };
    if trial == 0 { Vec::new() } else { knobs(method).into_iter().map(draw).collect() }
}

/// The best settings of each method on each task.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tuned {
    /// Trials that each had.
    pub trials: u64,
    /// By the task's name and the method's: `key=value`.
    pub settings: BTreeMap<String, BTreeMap<String, Vec<String>>>,
}

impl Tuned {
    /// Reads those that a tuning has written.
    ///
    /// # Errors
    ///
    /// If there are none, or something else.
    pub fn load(path: &Path) -> Result<Self> {
        let text = std::fs::read(path)
            .with_context(|| format!("cannot read {}; `report paper --tune TRIALS` writes it", path.display()))?;
        serde_json::from_slice(&text).with_context(|| format!("{} holds no tuned settings", path.display()))
    }

    /// Those of a method on a task; none if it has not been tuned there.
    pub fn of(&self, task: Task, method: Method) -> Option<&[String]> {
        Some(self.settings.get(task.name())?.get(method.name())?)
    }
}

/// Folder of the trials in an output.
pub fn folder(out: &Path) -> PathBuf {
    out.join("tuning")
}

/// All trials, the first ones of all methods first.
///
/// # Errors
///
/// If a setting is not possible.
pub fn trials(comparison: &Comparison, count: u64) -> Result<Vec<Run>> {
    let steps = (comparison.steps.unwrap_or(protocol::STEPS) as f64 * SHARE).ceil() as u64;
    let mut runs = Vec::new();
    for trial in 0..count {
        for &method in &comparison.methods {
            for &task in &comparison.tasks {
                let mut config = protocol::settings(task, method, SEED + trial, Some(steps));
                for setting in comparison.settings.iter().chain(&settings(method, trial)) {
                    config.set(setting)?;
                }
                config.validate()?;
                runs.push(Run { name: format!("{task}-{method}-{trial}"), config, tuned: false });
            }
        }
    }
    Ok(runs)
}

/// Mean success over the second half of a learning curve.
fn score(run: &Run, out: &Path) -> Result<f64> {
    let half = run.config.train.total_steps as f64 / 2.0;
    let log = metrics(&run.folder(out))?;
    let late = log.iter().filter(|line| line["global_step"].as_f64().is_some_and(|step| step > half));
    let values: Vec<f64> = late.filter_map(|line| line["evaluation/success_rate"].as_f64()).collect();
    Ok(if values.is_empty() { 0.0 } else { values.iter().sum::<f64>() / values.len() as f64 })
}

/// Chooses the best of all trials and writes them to `out/tuned.json`.
///
/// # Errors
///
/// If a trial is not done.
pub fn choose(comparison: &Comparison, count: u64, out: &Path) -> Result<Tuned> {
    let mut tuned = Tuned { trials: count, ..Tuned::default() };
    let runs = trials(comparison, count)?;
    for &task in &comparison.tasks {
        for &method in &comparison.methods {
            let mut best: Option<(f64, u64)> = None;
            for run in runs.iter().filter(|run| run.task() == task && run.method() == method) {
                if progress(run, &folder(out))? != Progress::Trained {
                    bail!("the trial {} is not done; the same command goes on with it", run.name);
                }
                let score = score(run, &folder(out))?;
                if best.is_none_or(|(highest, _)| score > highest) {
                    best = Some((score, run.seed() - SEED));
                }
            }
            let trial = best.map_or(0, |(_, trial)| trial);
            let of_task = tuned.settings.entry(task.name().into()).or_default();
            of_task.insert(method.name().into(), settings(method, trial));
        }
    }
    write_whole(&out.join(FILE), serde_json::to_string_pretty(&tuned)?.as_bytes())?;
    Ok(tuned)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_method_has_as_many_knobs_and_every_trial_possible_settings_and_a_seed_of_its_own() {
        let comparison = Comparison::default();
        let runs = trials(&comparison, 4).unwrap();
        assert_eq!(runs.len(), 4 * 8 * 5);
        let published: Vec<u64> = comparison.runs().unwrap().iter().map(Run::seed).collect();
        for run in &runs {
            assert!(!published.contains(&run.seed()));
            assert_eq!(knobs(run.method()).len(), 4);
        }
        // The first trial is what the comparison has, the others differ.
        assert_eq!(settings(Method::Mat, 0), Vec::<String>::new());
        for method in protocol::METHODS {
            let all: Vec<_> = (0..8).map(|trial| settings(method, trial)).collect();
            assert!(all.iter().enumerate().all(|(i, one)| !all[..i].contains(one)), "{method}");
        }
    }
}
