//! A time limit that excludes times in which the waiting process itself got no processor.

use carff_transport::monotonic_now_ns;

/// Maximum time that counts between two checks, nanoseconds.
const MOST_NS: u64 = 100_000_000;

/// Remaining waiting time.
#[derive(Clone, Copy, Debug)]
pub(super) struct Patience {
    left_ns: u64,
    looked_ns: u64,
}

impl Patience {
    /// Returns a limit of `limit_ms` milliseconds from now.
    pub(super) fn of_ms(limit_ms: u64) -> Self {
        Self { left_ns: limit_ms.saturating_mul(1_000_000), looked_ns: monotonic_now_ns() }
    }

    /// Returns true when the time is over. Call it often: a long time between two calls counts only up to the maximum.
    pub(super) fn ran_out(&mut self) -> bool {
        self.ran_out_at(monotonic_now_ns())
    }

    fn ran_out_at(&mut self, now_ns: u64) -> bool {
        let passed_ns = now_ns.saturating_sub(std::mem::replace(&mut self.looked_ns, now_ns));
        self.left_ns = self.left_ns.saturating_sub(passed_ns.min(MOST_NS));
        self.left_ns == 0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The limit expires after its time in small steps, and a long gap counts as a short one.
    #[test]
    fn gaps_do_not_count() {
        let mut patience = Patience::of_ms(1000);
        let begun_ns = patience.looked_ns;
        assert!(!patience.ran_out_at(begun_ns + 3600 * 1_000_000_000));
        let later_ns = begun_ns + 3600 * 1_000_000_000;
        let ran_out = (1..=100).find(|step| patience.ran_out_at(later_ns + step * 10_000_000));
        assert_eq!(ran_out, Some(90));
    }
}
