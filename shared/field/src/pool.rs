//! Threads for independent pieces of work.

use rayon::prelude::*;

/// A number of threads. One thread, and threads that cannot be started, need no pool: results do not depend on it.
#[derive(Debug, Default)]
pub(crate) struct Pool {
    threads: usize,
    pool: Option<rayon::ThreadPool>,
}

impl Pool {
    /// Starts `threads` threads, when there are to be more than one.
    pub fn new(threads: usize) -> Self {
        let mut pool = Self::default();
        pool.set_threads(threads);
        pool
    }

    /// Changes the number of threads.
    pub fn set_threads(&mut self, threads: usize) {
        if threads != self.threads {
            self.threads = threads;
            self.pool =
                (threads > 1).then(|| rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok()).flatten();
        }
    }

    /// Calls `work` with every item and its index.
    pub fn for_each<T: Send>(&self, items: &mut [T], work: impl Fn(usize, &mut T) + Sync) {
        match &self.pool {
            Some(pool) => {
                pool.install(|| items.par_iter_mut().with_max_len(1).enumerate().for_each(|(i, item)| work(i, item)));
            }
            None => items.iter_mut().enumerate().for_each(|(i, item)| work(i, item)),
        }
    }

    /// Calls `work` with chunks of `items`, and returns the results in order.
    pub fn flat_map_chunks<T: Sync, U: Send>(
        &self,
        items: &[T],
        size: usize,
        work: impl Fn(&[T]) -> Vec<U> + Send + Sync,
    ) -> Vec<U> {
        match &self.pool {
            Some(pool) => pool.install(|| items.par_chunks(size).map(work).flatten().collect()),
            None => items.chunks(size).flat_map(work).collect(),
        }
    }
}
