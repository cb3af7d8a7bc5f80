//! The work on a comparison, run by run. What is done is skipped; what was stopped goes on where it was.

use std::path::Path;

use anyhow::{Context, Result, bail};
use composer_shared::CRC_32;
use composer_shared::policies;
use composer_shared::policy::{Policy as Image, Task};
use serde::{Deserialize, Serialize};

use super::measure::{ATTENDED, Measured, Point, kept, measure};
use super::tune::{self, Tuned};
use super::{Comparison, Run, protocol};
use crate::env::EnvConfig;
use crate::files::{create_folder, write_whole};
use crate::methods::Method;
use crate::run_folder::{
    CALIBRATION_EPISODES, CONFIG_FILE, NETWORK_FILE, alone, begun, freeze_run, load_config, load_run, trained,
};
use crate::shard::Shard;
use crate::side_by_side::side_by_side;
use crate::train::checkpoint;

/// Says that a run is trained to its end, in its folder.
const TRAINED_FILE: &str = "trained.json";

/// What [`TRAINED_FILE`] holds.
#[derive(Debug, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Trained {
    /// CRC-32 of the policy at the end.
    network: String,
}

fn digest(bytes: &[u8]) -> String {
    format!("{:08x}", CRC_32.checksum(bytes))
}

/// How far a run is.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Progress {
    /// There is nothing of it.
    Nothing,
    /// It was begun and stopped before its end.
    Begun,
    /// It is trained.
    Trained,
}

/// How far the run in an output is.
///
/// # Errors
///
/// If there is a run of that name with other settings, or if its policy is not the one that it ended with.
pub fn progress(run: &Run, out: &Path) -> Result<Progress> {
    let folder = run.folder(out);
    let mut config = run.config.clone();
    // It may have been any number of them.
    if let Ok(was) = load_config(&folder.join(CONFIG_FILE)) {
        config.train.threads = was.train.threads;
    }
    if !begun(&folder, &config)? {
        return Ok(Progress::Nothing);
    }
    let Ok(text) = std::fs::read(folder.join(TRAINED_FILE)) else { return Ok(Progress::Begun) };
    let Trained { network } = serde_json::from_slice(&text)
        .with_context(|| format!("{} is damaged; remove the folder, and it is made anew", folder.display()))?;
    let policy = std::fs::read(folder.join(NETWORK_FILE)).unwrap_or_default();
    if digest(&policy) != network {
        bail!(
            "{} holds another policy than the one that its training ended with; remove the folder, and it is made anew",
            folder.display()
        );
    }
    Ok(Progress::Trained)
}

/// Trains a run on `threads` threads as far as that is not done. False: interrupted.
fn finish_training(run: &Run, out: &Path, threads: usize) -> Result<bool> {
    let folder = run.folder(out);
    if progress(run, out)? != Progress::Trained {
        if !trained(&folder, &run.config, threads)? {
            return Ok(false);
        }
        let policy = std::fs::read(folder.join(NETWORK_FILE))?;
        write_whole(&folder.join(TRAINED_FILE), &serde_json::to_vec(&Trained { network: digest(&policy) })?)?;
        // That of SMP holds its whole replay buffer.
        let _ = std::fs::remove_file(folder.join(checkpoint::FILE));
    }
    Ok(true)
}

/// Trains a run on `threads` threads and measures it over so many episodes a point, as far as that is not done. False: interrupted.
fn finish(run: &Run, out: &Path, episodes: u64, threads: usize) -> Result<bool> {
    let folder = run.folder(out);
    if !finish_training(run, out, threads)? {
        return Ok(false);
    }
    let _alone = alone(&folder)?;
    let (config, policy) = load_run(&folder)?;
    let env = config.evaluation();
    let measured = Measured { rows: &kept(&folder)?, digest: &policy_digest(&folder)?, env: &env, episodes };
    let image = || match policy.runs_on_modules() {
        Ok(()) => Ok(Ok(freeze_run(&folder, CALIBRATION_EPISODES, threads)?.1)),
        Err(why) => Ok(Err(why.to_string())),
    };
    let points = run.points();
    measure(&measured, &run.name, &*policy.policy(), points, attends(run), image, threads)?;
    Ok(true)
}

/// Whether it is drawn where the modules of a run attend: of the first run of COMPOSER on the tasks of the paper's figure.
pub fn attends(run: &Run) -> bool {
    !run.tuned && run.method() == Method::Composer && run.seed() == 1 && ATTENDED.contains(&run.task())
}

/// Digest of the policy in a folder: what its results are kept under.
pub fn policy_digest(folder: &Path) -> Result<String> {
    let path = folder.join(NETWORK_FILE);
    Ok(digest(&std::fs::read(&path).with_context(|| format!("cannot read {}", path.display()))?))
}

/// Name of the folder with the results of the policy of a task that ships.
pub fn robust_name(task: Task) -> String {
    format!("robust-{task}")
}

/// The environment of the policy of a task that ships, its image and its digest.
pub fn robust(task: Task) -> Result<(EnvConfig, &'static [u8], String)> {
    let image = policies::shipped(task.name()).context("a policy ships for every task")?;
    // The checksum over an image and its own checksum is the same for all images.
    let crc = Image::parse(image).map_err(|e| anyhow::anyhow!("the policy of {task} that ships: {e}"))?.crc();
    Ok((protocol::settings(task, Method::Composer, 1, None).evaluation(), image, format!("{crc:08x}")))
}

/// Measures the policy of a task that ships.
fn finish_robust(task: Task, out: &Path, episodes: u64, threads: usize) -> Result<()> {
    let folder = out.join(robust_name(task));
    let _alone = alone(&folder)?;
    let (env, image, digest) = robust(task)?;
    let policy = Image::parse(image).map_err(|e| anyhow::anyhow!("{e}"))?;
    let measured = Measured { rows: &kept(&folder)?, digest: &digest, env: &env, episodes };
    measure(&measured, &robust_name(task), &policy, Point::all(task), false, || Ok(Ok(image.to_vec())), threads)
}

/// Works on one part of a comparison, all of it by default, `jobs` pieces at a time (default: the cores). False: interrupted, the next time it goes
/// on from there.
///
/// # Errors
///
/// If a run has other settings, diverges, or cannot be written.
pub fn work(
    comparison: &Comparison,
    shard: Option<Shard>,
    out: &Path,
    episodes: u64,
    jobs: Option<u64>,
) -> Result<bool> {
    let mut pieces: Vec<Piece> = comparison.runs()?.into_iter().map(|run| Piece::Run(Box::new(run))).collect();
    create_folder(out)?;
    pieces.extend(comparison.tasks.iter().map(|task| Piece::Robust(*task)));
    if let Some(shard) = shard {
        pieces = shard.select(pieces).collect();
    }
    let folder = |piece: &Piece| match piece {
        Piece::Run(run) => run.folder(out),
        Piece::Robust(task) => out.join(robust_name(*task)),
    };
    let folders: Vec<_> = pieces.iter().map(folder).collect();
    let folders: Vec<&Path> = folders.iter().map(|folder| &**folder).collect();
    side_by_side(&folders, jobs, |number, threads| match &pieces[number] {
        Piece::Run(run) => finish(run, out, episodes, threads).map(drop),
        Piece::Robust(task) => finish_robust(*task, out, episodes, threads),
    })
}

/// Trains all trials of a tuning and chooses among them. None: interrupted, the next time it goes on from there.
///
/// # Errors
///
/// As [`work`].
pub fn tune(comparison: &Comparison, trials: u64, out: &Path, jobs: Option<u64>) -> Result<Option<Tuned>> {
    let (runs, trials_in) = (tune::trials(comparison, trials)?, tune::folder(out));
    create_folder(&trials_in)?;
    let folders: Vec<_> = runs.iter().map(|run| run.folder(&trials_in)).collect();
    let folders: Vec<&Path> = folders.iter().map(|folder| &**folder).collect();
    let done =
        side_by_side(&folders, jobs, |number, threads| finish_training(&runs[number], &trials_in, threads).map(drop))?;
    if done { tune::choose(comparison, trials, out).map(Some) } else { Ok(None) }
}

/// A piece of work.
enum Piece {
    /// A run to train and measure.
    Run(Box<Run>),
    /// The policy of a task that ships, to measure.
    Robust(Task),
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use super::*;

    /// What was measured of another policy is not taken for this one's.
    #[test]
    fn policies_that_ship_have_digests_of_their_own() {
        let digests: BTreeSet<String> = Task::ALL.iter().map(|task| robust(*task).unwrap().2).collect();
        assert_eq!(digests.len(), Task::ALL.len());
    }
}
