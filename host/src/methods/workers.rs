//! The threads that share the work of a run.

use std::sync::{Arc, Mutex};

use rayon::iter::{IntoParallelRefMutIterator, ParallelIterator};

use super::ranks::Ranks;

/// The threads of a run. They live as long as this and its clones do.
#[derive(Clone, Debug)]
pub struct Workers {
    pool: Arc<rayon::ThreadPool>,
    ranks: Option<Arc<dyn Ranks>>,
}

impl Workers {
    /// Starts so many threads.
    ///
    /// # Errors
    ///
    /// If the system does not give them.
    pub fn new(threads: usize) -> anyhow::Result<Self> {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads.max(1)).build()?;
        Ok(Self { pool: Arc::new(pool), ranks: None })
    }

    /// Shares the work of a run with other processes from now on.
    pub fn join_ranks(&mut self, ranks: Arc<dyn Ranks>) {
        self.ranks = Some(ranks);
    }

    /// The processes that the work of the run is shared with, if it is.
    pub fn ranks(&self) -> Option<&dyn Ranks> {
        self.ranks.as_deref()
    }

    /// How many there are.
    pub fn threads(&self) -> usize {
        self.pool.current_num_threads()
    }

    /// Runs `work` on one of the threads: what it asks the workers for in turn then starts without a switch of threads.
    pub fn enter<R: Send>(&self, work: impl FnOnce() -> R + Send) -> R {
        self.pool.install(work)
    }

    /// Applies `task` to every item; whoever is free takes the next. Each thread has an entry of `scratch` for itself meanwhile, so there
    /// should be as many as threads.
    pub fn for_each<I, S>(&self, items: I, scratch: &mut [S], task: impl Fn(I::Item, &mut S) + Sync)
    where
        I: IntoIterator,
        I::IntoIter: Send,
        S: Send,
    {
        let items = Mutex::new(items.into_iter());
        self.pool.install(|| {
            scratch.par_iter_mut().for_each(|scratch| {
                loop {
                    // The lock is held only to take the next item.
                    let next = items.lock().unwrap_or_else(|poisoned| poisoned.into_inner()).next();
                    let Some(item) = next else { return };
                    task(item, scratch);
                }
            });
        });
    }

    /// Runs `job(index)` for every index below `count`; the results come in order.
    pub fn map<T: Send>(&self, count: usize, job: impl Fn(usize) -> T + Sync) -> Vec<T> {
        let mut results: Vec<Option<T>> = (0..count).map(|_| None).collect();
        let mut scratch = vec![(); self.threads()];
        self.for_each(results.iter_mut().enumerate(), &mut scratch, |(index, result), ()| *result = Some(job(index)));
        results.into_iter().flatten().collect()
    }

    /// Runs both, side by side if two threads are free.
    pub fn join<A: Send, B: Send>(&self, a: impl FnOnce() -> A + Send, b: impl FnOnce() -> B + Send) -> (A, B) {
        self.pool.join(a, b)
    }
}
