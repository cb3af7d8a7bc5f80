//! Long pieces of work some at a time, each with threads of its own.

use std::path::Path;
use std::sync::atomic::{AtomicBool, AtomicUsize, Ordering};

use anyhow::Result;

use crate::train::Signals;

/// Threads to use when nobody says otherwise: one a core.
pub fn cores() -> usize {
    std::thread::available_parallelism().map_or(1, usize::from)
}

/// Runs `job(index)` for every index below `count` on `threads` threads of their own and returns the results in order. A job has workers of
/// its own in turn; on a worker's thread it might be begun while another waits for those.
pub fn side_by_side_threads<T: Send>(count: usize, threads: usize, job: impl Fn(usize) -> T + Sync) -> Vec<T> {
    let next = AtomicUsize::new(0);
    let mut results: Vec<(usize, T)> = std::thread::scope(|scope| {
        let workers: Vec<_> = (0..threads.max(1))
            .map(|_| {
                scope.spawn(|| {
                    let mut done = Vec::new();
                    loop {
                        let index = next.fetch_add(1, Ordering::Relaxed);
                        if index >= count {
                            return done;
                        }
                        done.push((index, job(index)));
                    }
                })
            })
            .collect();
        workers.into_iter().flat_map(|w| w.join().expect("a worker thread does not panic")).collect()
    });
    results.sort_by_key(|r| r.0);
    results.into_iter().map(|r| r.1).collect()
}

/// Works on all runs, `jobs` at a time (default: the cores), each on its share of the cores: `job` gets a run's number and its threads. False:
/// interrupted; the runs that had not begun are left out.
///
/// # Errors
///
/// The first that a job had; those that had not begun by then are left out.
pub fn side_by_side(
    folders: &[&Path],
    jobs: Option<u64>,
    job: impl Fn(usize, usize) -> Result<()> + Sync,
) -> Result<bool> {
    let jobs = jobs.map_or_else(cores, |jobs| jobs as usize).min(folders.len()).max(1);
    let threads = (cores() / jobs).max(1);
    let stop = Signals::new()?;
    let failed = AtomicBool::new(false);
    let results = side_by_side_threads(folders.len(), jobs, |number| {
        if stop.raised() || failed.load(Ordering::Relaxed) {
            return Ok(());
        }
        eprintln!("run {} of {}: {}", number + 1, folders.len(), folders[number].display());
        job(number, threads).inspect_err(|_| failed.store(true, Ordering::Relaxed))
    });
    results.into_iter().collect::<Result<()>>()?;
    Ok(!stop.raised())
}
