//! What a process counts of its own traffic.

use std::sync::atomic::{AtomicU64, Ordering};

/// Counts over all ports of one [`crate::Node`], since it was opened.
#[derive(Debug, Default)]
pub struct Counters {
    received: AtomicU64,
    published: AtomicU64,
    skipped: AtomicU64,
    invalid: AtomicU64,
}

impl Counters {
    /// Valid messages received.
    pub fn received(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }

    /// Messages sent.
    pub fn published(&self) -> u64 {
        self.published.load(Ordering::Relaxed)
    }

    /// Messages passed over because a newer one was there.
    pub fn skipped(&self) -> u64 {
        self.skipped.load(Ordering::Relaxed)
    }

    /// Messages dropped because they were not valid.
    pub fn invalid(&self) -> u64 {
        self.invalid.load(Ordering::Relaxed)
    }

    pub(crate) fn count_received(&self) {
        self.received.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn count_published(&self) {
        self.published.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn count_skipped(&self) {
        self.skipped.fetch_add(1, Ordering::Relaxed);
    }

    /// Returns how many there are now.
    pub(crate) fn count_invalid(&self) -> u64 {
        self.invalid.fetch_add(1, Ordering::Relaxed) + 1
    }
}
