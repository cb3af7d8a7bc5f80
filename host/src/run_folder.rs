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
use crate::methods::curriculum::Pretraining;
use crate::methods::{TrainConfig, TrainedPolicy};
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
/// Folder of the run before a run, in its folder.
pub const PRETRAINING_FOLDER: &str = "pretraining";
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

/// Starts a run in the folder `out`, or goes on with the one that is there; the one before it, if it has one, is in a folder of its own in there. Judges
/// the policy every so often, healthy and (if it trains with faults) faulty, and keeps the policy of the last judgement. None: the run is that of
/// another rank, which this one only helped.
pub fn train_in(config: &RunConfig, out: &Path, resuming: bool, beside: &Beside) -> Result<Option<TrainSummary>> {
    let make = |index: usize| -> Result<Box<dyn crate::environment::Environment>> {
        Ok(Box::new(SnakeEnv::new(config.environment(index)?)))
    };
    if beside.ranks.is_some() && config.train.pretraining.steps > 0 {
        bail!(
            "pretraining.steps is {}; a run over several processes begins from nothing or with train.start: it must be 0",
            config.train.pretraining.steps
        );
    }
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
    let mut learner = config.train.clone();
    let mut resuming = resuming;
    if let Some(before) = config.pretraining() {
        let folder = out.join(PRETRAINING_FOLDER);
        learner = TrainConfig { start: folder.display().to_string(), pretraining: Pretraining::default(), ..learner };
        resuming &= out.join(checkpoint::FILE).exists();
        if !resuming {
            let name = beside.name.map_or_else(String::new, |name| format!("{name}/")) + PRETRAINING_FOLDER;
            let beside = Beside { name: Some(&name), ranks: None };
            let summary = train_in(&before, &folder, resume_or_clear(&folder, &before)?, &beside)?;
            if summary.as_ref().is_none_or(|summary| summary.interrupted) {
                return Ok(summary);
            }
        }
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
    let summary = train(&learner, &make, &fingerprint(config), out, resuming, beside, &mut evaluate)?;
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
    // The learner's settings are here by their defaults alone, and those of before had not these.
    if let Some(train) = world.get_mut("train").and_then(toml::Value::as_table_mut) {
        train.remove("pretraining");
        if let Some(imagination) = train.get_mut("imagination").and_then(toml::Value::as_table_mut) {
            imagination.remove("told");
        }
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

/// Whether a folder holds a run to go on with; one that was killed before its first checkpoint is cleared away, one with other settings refused.
fn resume_or_clear(folder: &Path, config: &RunConfig) -> Result<bool> {
    let begun = begun(folder, config)?;
    let saved = folder.join(checkpoint::FILE).exists();
    if begun && !saved {
        std::fs::remove_file(folder.join(CONFIG_FILE))?;
    }
    Ok(begun && saved)
}

/// Trains a run on `threads` threads, or goes on with it. False: interrupted, the next time it goes on from there.
///
/// A process at a time: another that wants the same run waits.
pub fn trained(folder: &Path, config: &RunConfig, threads: usize) -> Result<bool> {
    let mut config = config.clone();
    config.train.threads = threads;
    let _alone = alone(folder)?;
    let begun = resume_or_clear(folder, &config)?;
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
    metrics_text(folder)?
        .lines()
        .map(|line| {
            serde_json::from_str(line).with_context(|| format!("{} is damaged", folder.join(log::FILE).display()))
        })
        .collect()
}

fn metrics_text(folder: &Path) -> Result<String> {
    let path = folder.join(log::FILE);
    std::fs::read_to_string(&path).with_context(|| format!("cannot read {}", path.display()))
}

/// The lines of the metrics of a run, those of the one before it first, if there was one.
pub fn metrics_with_pretraining(folder: &Path) -> Result<String> {
    let before = folder.join(PRETRAINING_FOLDER);
    let before = if before.exists() { metrics_text(&before)? } else { String::new() };
    Ok(before + &metrics_text(folder)?)
}

/// Wall time that a run and the one before it have taken by their metrics, s; 0 without any. Each time that it was resumed they count from 0 again.
pub fn wall_seconds(run: &Path) -> f64 {
    let before_it = run.join(PRETRAINING_FOLDER);
    let before_it = if before_it.exists() { wall_seconds(&before_it) } else { 0.0 };
    let lines = metrics(run).unwrap_or_default();
    let readings = lines.iter().filter_map(|line| line["time/wall_seconds"].as_f64());
    let (before, last) = readings.fold((0.0, 0.0), |(before, last), now| match now < last {
        true => (before + last, now),
        false => (before, now),
    });
    before_it + before + last
}

#[cfg(test)]
mod tests {
    use super::*;
    use composer_sim_bridge::faults::Fault;

    /// What is pretrained is a run by itself on the robot as it should be, the run begins with its policy, and stopped after either it goes on as if it
    /// had not been.
    #[test]
    fn a_run_begins_with_what_was_pretrained() {
        let mut config = RunConfig::default();
        for setting in [
            "environments=2",
            "rollout_steps=16",
            "minibatches=1",
            "total_steps=64",
            "sigma=0.2",
            "evaluation_episodes=1",
            "checkpoint_seconds=0.0",
            "pretraining.steps=32",
            "pretraining.environments=2",
            "pretraining.sigma=0.4",
            "faults.probability=0.5",
            "env.lengths=[8, 9]",
            "curriculum.varied=0.5",
        ] {
            config.set(setting).unwrap();
        }
        config.vary = toml::from_str("slope = [0.0, 4.0]").unwrap();
        config.validate().unwrap();
        let before = config.pretraining().unwrap();
        assert_eq!((before.train.total_steps, before.train.sigma), (32, 0.4));
        assert!(before.pretraining().is_none());
        assert_eq!((&before.faults, &before.vary), (&FaultTraining::default(), &Default::default()));
        assert!(before.env.lengths.is_empty());
        let mut blind = config.clone();
        blind.set("pretraining.blind=1").unwrap();
        let drawn = blind.pretraining().unwrap().faults.draw(3, 8);
        assert!(
            drawn.len() == 1 && matches!(drawn[0].fault, Fault::SensorZeroed(_)) && drawn[0].at_ns == 0,
            "{drawn:?}"
        );

        let (a, b, alone) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
        let run = |config: &RunConfig, folder: &Path, resuming| {
            train_in(config, folder, resuming, &Beside::default()).unwrap().unwrap().policy
        };
        let whole = run(&config, a.path(), false);
        let pretrained = run(&before, alone.path(), false);
        assert_eq!(load_run(&a.path().join(PRETRAINING_FOLDER)).unwrap(), (before.clone(), pretrained));
        // It matters what it began with.
        let mut otherwise = config.clone();
        otherwise.train.pretraining.learning_rate = 1e-5;
        let c = tempfile::tempdir().unwrap();
        assert_ne!(run(&otherwise, c.path(), false), whole);

        // Stopped between the two.
        write_whole(&b.path().join(CONFIG_FILE), toml::to_string(&config).unwrap().as_bytes()).unwrap();
        run(&before, &b.path().join(PRETRAINING_FOLDER), false);
        assert_eq!(run(&config, b.path(), true), whole);
        // In another place.
        let moved = tempfile::tempdir().unwrap();
        let moved = moved.path().join("moved");
        std::fs::rename(b.path(), &moved).unwrap();
        assert_eq!(run(&config, &moved, true), whole);
        assert_eq!(metrics_with_pretraining(&moved).unwrap().lines().count(), 1 + 2);
        // Other settings of the pretraining are not those that it had.
        otherwise.train.total_steps = 32;
        std::fs::remove_file(moved.join(checkpoint::FILE)).unwrap();
        let error = train_in(&otherwise, &moved, true, &Beside::default()).err().unwrap().to_string();
        assert!(error.contains("pretraining holds a run with other settings"), "{error}");
    }

    #[test]
    fn the_time_before_an_interruption_counts() {
        let folder = tempfile::tempdir().unwrap();
        assert_eq!(wall_seconds(folder.path()), 0.0);
        let lines = [1.0, 2.5, 0.5, 0.25, 4.0].map(|time| format!("{{\"time/wall_seconds\":{time}}}\n"));
        std::fs::write(folder.path().join(log::FILE), lines.concat()).unwrap();
        assert_eq!(wall_seconds(folder.path()), 2.5 + 0.5 + 4.0);
    }
}
