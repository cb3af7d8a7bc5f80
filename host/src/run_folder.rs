//! The folder of a training run: its settings, its policy, its metrics, and how a run in it begins and goes on.

use std::fs::File;
use std::path::Path;
use std::sync::Arc;

use anyhow::{Context, Result, bail};
use composer_shared::CRC_32;
use composer_shared::policy::Policy;
use serde_json::Value;

use crate::distil::{self, distil};
use crate::env::{FaultTraining, SnakeEnv};
use crate::eval::{Trial, curve_seed, healthy};
use crate::files::{create_folder, write_whole};
use crate::freeze::{Parity, freeze, parity};
use crate::methods::TrainedPolicy;
use crate::outcome::Report;
use crate::run::RunConfig;
use crate::train::{Beside, TrainSummary, checkpoint, follow, metrics as log, train};

/// Seeds of the episodes that scales are taken from, of those that parity is measured on, and of those that a network learns another in.
const CALIBRATION_SEED: u64 = 0xca11;
const HELD_OUT_SEED: u64 = 0x4e1d;
const DISTILLED_SEED: u64 = 0xd157;

/// Episodes that scales are taken from, and as many others that parity is measured on.
pub const CALIBRATION_EPISODES: u64 = 24;

/// Settings of a run, in its folder.
pub const CONFIG_FILE: &str = "config.toml";
/// Policy of a run as of its last evaluation, in its folder.
pub const NETWORK_FILE: &str = "network.json";

/// Reads a settings file.
pub fn load_config(path: &Path) -> Result<RunConfig> {
    let text = std::fs::read_to_string(path).with_context(|| format!("cannot read the settings {}", path.display()))?;
    toml::from_str(&text)
        .map_err(|e| anyhow::anyhow!("{} has settings that do not fit: {}", path.display(), e.message()))
}

/// The settings and the policy of a run folder.
pub fn load_run(folder: &Path) -> Result<(RunConfig, TrainedPolicy)> {
    let config = load_config(&folder.join(CONFIG_FILE))
        .with_context(|| format!("{} is no folder of a training run", folder.display()))?;
    let path = folder.join(NETWORK_FILE);
    let text = std::fs::read(&path).with_context(|| {
        format!("cannot read {}; a run writes it at its first evaluation and at its end", path.display())
    })?;
    let policy: TrainedPolicy =
        serde_json::from_slice(&text).with_context(|| format!("{} is damaged", path.display()))?;
    policy.check().with_context(|| format!("{} is damaged", path.display()))?;
    Ok((config, policy))
}

/// Starts a run in the folder `out`, or goes on with the one that is there. Judges the policy every so often, healthy and (if it trains with
/// faults) faulty, and keeps the policy of the last judgement. None: the run is that of another rank, which this one only helped.
pub fn train_in(config: &RunConfig, out: &Path, resuming: bool, beside: &Beside) -> Result<Option<TrainSummary>> {
    let make = |index: usize| -> Result<Box<dyn crate::environment::Environment>> {
        Ok(Box::new(SnakeEnv::new(config.environment(index)?)))
    };
    if beside.follows() {
        follow(&config.train, &make, &fingerprint(config), out, resuming, beside)?;
        return Ok(None);
    }
    create_folder(out)?;
    if !resuming {
        if out.join(CONFIG_FILE).exists() {
            bail!("{} already holds a run: go on with --resume {0}, or choose another --out", out.display());
        }
        write_whole(&out.join(CONFIG_FILE), toml::to_string(config)?.as_bytes())?;
    }
    let evaluation = Arc::new(config.evaluation());
    let faulty = |seed, modules| config.faults.draw(seed, modules);
    let mut evaluate = |policy: &TrainedPolicy, _steps: u64| {
        let trial = Trial {
            config: &evaluation,
            episodes: config.train.evaluation_episodes.max(1) as usize,
            seed: curve_seed(config.train.seed),
            faults: &healthy,
            threads: config.train.threads(),
        };
        let runs = policy.policy();
        let report = trial.evaluate(&*runs, "none", &|| {});
        let mut scalars = scalars(&report, "evaluation");
        if config.faults.probability > 0.0 {
            let report = Trial { faults: &faulty, ..trial }.evaluate(&*runs, "as trained", &|| {});
            scalars.extend(self::scalars(&report, "evaluation_faults"));
        }
        // A run that is killed keeps the policy of its last evaluation; a failure to write shows at the checkpoint.
        let _ = save_policy(out, policy);
        scalars
    };
    let summary = train(&config.train, &make, &fingerprint(config), out, resuming, beside, &mut evaluate)?;
    save_policy(out, &summary.policy)?;
    Ok(Some(summary))
}

/// What goes into the metrics from an evaluation.
fn scalars(report: &Report, prefix: &str) -> Vec<(String, f64)> {
    [
        ("success_rate", report.success_rate),
        ("distance_mean", report.distance_mean),
        ("steps_mean", report.steps_mean),
        ("low_share", report.low_share),
        ("peak_link_speed", report.peak_link_speed),
    ]
    .into_iter()
    .map(|(name, value)| (format!("{prefix}/{name}"), value))
    .collect()
}

fn save_policy(out: &Path, policy: &TrainedPolicy) -> Result<()> {
    let text = serde_json::to_vec(policy).context("the policy cannot be written as JSON")?;
    write_whole(&out.join(NETWORK_FILE), &text)
}

/// What a checkpoint must agree with to be resumed: everything but the learner's own settings, which it checks itself.
fn fingerprint(config: &RunConfig) -> String {
    let world = RunConfig { train: Default::default(), ..config.clone() };
    let mut world = toml::Table::try_from(&world).unwrap_or_default();
    if let Some(faults) = world.get_mut("faults").and_then(toml::Value::as_table_mut) {
        // What runs of before these settings trained for is what their defaults say.
        let defaults = toml::Table::try_from(FaultTraining::default()).unwrap_or_default();
        for key in ["mixed", "latest", "fixed"] {
            if faults.get(key) == defaults.get(key) {
                faults.remove(key);
            }
        }
    }
    // The learner's settings are here by their defaults alone, and those of before had no such one.
    let imagination = world.get_mut("train").and_then(|train| train.get_mut("imagination"));
    if let Some(imagination) = imagination.and_then(toml::Value::as_table_mut) {
        imagination.remove("told");
    }
    let digest = CRC_32.checksum(toml::to_string(&world).unwrap_or_default().as_bytes());
    format!(
        "{} on {} with {} modules, settings {digest:08x}",
        config.task.name, config.robot.name, config.robot.modules
    )
}

/// Refuses a folder that holds a run with other settings; whether there is one with these.
pub fn begun(folder: &Path, config: &RunConfig) -> Result<bool> {
    let file = folder.join(CONFIG_FILE);
    if !file.exists() {
        return Ok(false);
    }
    let mut was = load_config(&file)?;
    was.train.threads = config.train.threads;
    if was != *config {
        bail!("{} holds a run with other settings; choose another --runs folder", folder.display());
    }
    Ok(true)
}

/// Trains a run on `threads` threads, or goes on with it. False: interrupted, the next time it goes on from there.
///
/// A process at a time: another that wants the same run waits.
pub fn trained(folder: &Path, config: &RunConfig, threads: usize) -> Result<bool> {
    let mut config = config.clone();
    config.train.threads = threads;
    let _alone = alone(folder)?;
    let mut begun = begun(folder, &config)?;
    if begun && !folder.join(checkpoint::FILE).exists() {
        // Killed before anything was computed.
        std::fs::remove_file(folder.join(CONFIG_FILE))?;
        begun = false;
    }
    let name = folder.file_name().unwrap_or_default().to_string_lossy();
    let beside = Beside { name: Some(&name), ranks: None };
    Ok(train_in(&config, folder, begun, &beside)?.is_some_and(|summary| !summary.interrupted))
}

/// Waits until no other process works in a folder; none begins to as long as the file lives.
pub fn alone(folder: &Path) -> Result<File> {
    create_folder(folder)?;
    let path = folder.join(".lock");
    let file = File::create(&path).with_context(|| format!("cannot write {}", path.display()))?;
    if file.try_lock().is_err() {
        eprintln!("{}: another process works on it; waiting", folder.display());
        file.lock().with_context(|| format!("cannot lock {}", path.display()))?;
    }
    Ok(file)
}

/// Freezes the policy of a run folder, with scales of `episodes` episodes; the difference of float and integer actions is that of as many others.
/// A network that is not of the image's form, of modules that act alone, is learnt by one that is ([`distil()`]) in four times as many.
pub fn freeze_run(folder: &Path, episodes: u64, threads: usize) -> Result<(RunConfig, Vec<u8>, Parity)> {
    let (config, policy) = load_run(folder)?;
    policy.runs_on_modules().with_context(|| format!("{} cannot be frozen", folder.display()))?;
    let decides = policy.policy();
    let env = Arc::new(config.evaluation());
    let draw = |seed, modules| config.faults.draw(seed, modules);
    let trial = Trial {
        config: &env,
        episodes: episodes as usize,
        seed: CALIBRATION_SEED,
        faults: if config.faults.probability > 0.0 { &draw } else { &healthy },
        threads,
    };
    let learnt;
    let network = match policy.network() {
        Ok(network) => network,
        Err(_) => {
            learnt = distil(&*decides, &Trial { seed: DISTILLED_SEED, ..trial }, distil::UPDATES);
            &learnt
        }
    };
    let image = freeze(network, &config.meta(), &trial.observations(&*decides))?;
    let frozen = Policy::parse(&image).map_err(|e| anyhow::anyhow!("the frozen image is refused: {e}"))?;
    let held_out = Trial { seed: HELD_OUT_SEED, ..trial };
    let parity = match &policy {
        TrainedPolicy::Composer(network) => parity(network, &frozen, &held_out.observations(&*decides)),
        _ => distil::parity(&*decides, &frozen, &held_out),
    };
    Ok((config, image, parity))
}

/// The metrics of a run, one object an iteration.
pub fn metrics(folder: &Path) -> Result<Vec<Value>> {
    let path = folder.join(log::FILE);
    let text = std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))?;
    text.lines()
        .map(|line| serde_json::from_str(line).with_context(|| format!("{} is damaged", path.display())))
        .collect()
}

/// Wall time that a run has taken by its metrics, s; 0 without any. Each time that it was resumed they count from 0 again.
pub fn wall_seconds(run: &Path) -> f64 {
    let lines = metrics(run).unwrap_or_default();
    let readings = lines.iter().filter_map(|line| line["time/wall_seconds"].as_f64());
    let (before, last) = readings.fold((0.0, 0.0), |(before, last), now| match now < last {
        true => (before + last, now),
        false => (before, now),
    });
    before + last
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_time_before_an_interruption_counts() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(wall_seconds(folder.path()), 0.0);
        let lines = [1.0, 2.5, 0.5, 0.25, 4.0].map(|time| format!("{{\"time/wall_seconds\":{time}}}\n"));
        std::fs::write(folder.path().join(log::FILE), lines.concat()).unwrap();
        assert_eq!(wall_seconds(folder.path()), 2.5 + 0.5 + 4.0);
    }
}
