//! The work on a comparison, run by run. What is done is skipped; what was stopped goes on where it was.

use std::path::Path;

use anyhow::{Context, Result, bail};
use crc::{CRC_32_ISO_HDLC, Crc};
use serde::{Deserialize, Serialize};

use super::Run;
use crate::files::{create_folder, write_whole};
use crate::run_folder::{NETWORK_FILE, begun, trained};
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
    format!("{:08x}", Crc::<u32>::new(&CRC_32_ISO_HDLC).checksum(bytes))
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
    if let Ok(was) = crate::run_folder::load_config(&folder.join(crate::run_folder::CONFIG_FILE)) {
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
fn finish(run: &Run, out: &Path, threads: usize) -> Result<bool> {
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

/// Works on all runs, `jobs` at a time (default: the cores). False: interrupted, the next time it goes on from there.
///
/// # Errors
///
/// If a run has other settings, diverges, or cannot be written.
pub fn work(runs: &[Run], out: &Path, jobs: Option<u64>) -> Result<bool> {
    create_folder(out)?;
    let folders: Vec<_> = runs.iter().map(|run| run.folder(out)).collect();
    let folders: Vec<&Path> = folders.iter().map(|folder| &**folder).collect();
    side_by_side(&folders, jobs, |number, threads| finish(&runs[number], out, threads).map(drop))
}
