//! When a dead stage is started again: pure logic, without processes.

use carff_config::RestartPolicy;

/// Longest pause, as a multiple of the first one.
const MAX_BACKOFF_FACTOR: u64 = 16;

/// What to do about a stage that died.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Start it again at this time, nanoseconds on the monotonic clock.
    RestartAt(u64),
    /// Give the run up.
    Lost,
}

/// Counts the restarts of one stage.
#[derive(Clone, Copy, Debug)]
pub struct RestartBudget {
    policy: RestartPolicy,
    restarts: u32,
}

impl RestartBudget {
    /// Nothing has died yet.
    pub fn new(policy: RestartPolicy) -> Self {
        Self { policy, restarts: 0 }
    }

    /// Restarts so far.
    pub fn restarts(&self) -> u32 {
        self.restarts
    }

    /// Judges a death at a time, nanoseconds.
    pub fn died(&mut self, now_ns: u64) -> Verdict {
        match self.policy {
            RestartPolicy::OnFailure { backoff_ms, max_restarts } if self.restarts < max_restarts => {
                let factor = 1_u64.checked_shl(self.restarts).unwrap_or(u64::MAX).min(MAX_BACKOFF_FACTOR);
                self.restarts += 1;
                Verdict::RestartAt(now_ns.saturating_add(backoff_ms.saturating_mul(factor * 1_000_000)))
            }
            _ => Verdict::Lost,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Pauses double up to 16 times the first, and after the limit the stage is lost.
    #[test]
    fn backoff_doubles_and_ends() {
        let mut budget = RestartBudget::new(RestartPolicy::OnFailure { backoff_ms: 10, max_restarts: 7 });
        let pauses: Vec<_> = (0..8).map(|_| budget.died(1000)).collect();
        let expected = [10, 20, 40, 80, 160, 160, 160].map(|ms: u64| Verdict::RestartAt(1000 + ms * 1_000_000));
        assert_eq!(pauses[..7], expected);
        assert_eq!(pauses[7], Verdict::Lost);
        assert_eq!(budget.restarts(), 7);
    }

    /// The policy `never` gives up at once.
    #[test]
    fn never_means_never() {
        assert_eq!(RestartBudget::new(RestartPolicy::Never).died(0), Verdict::Lost);
    }
}
