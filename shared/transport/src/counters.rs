//! Counters of a process's own messages.

use std::sync::atomic::{AtomicU64, Ordering};

/// Counters over all ports of one [`crate::Node`], since it was opened.
#[derive(Debug, Default)]
pub struct Counters {
    received: AtomicU64,
    published: AtomicU64,
    skipped: AtomicU64,
    invalid: AtomicU64,
}

impl Counters {
    /// Returns the number of valid messages received.
    pub fn received(&self) -> u64 {
        self.received.load(Ordering::Relaxed)
    }

    /// Returns the number of messages sent.
    pub fn published(&self) -> u64 {
        self.published.load(Ordering::Relaxed)
    }

    /// Returns the number of messages skipped in favour of newer ones.
    pub fn skipped(&self) -> u64 {
        self.skipped.load(Ordering::Relaxed)
    }

    /// Returns the number of messages dropped because they were invalid.
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

    /// Counts an invalid message and returns the new count.
    pub(crate) fn count_invalid(&self) -> u64 {
        self.invalid.fetch_add(1, Ordering::Relaxed) + 1
    }
}
