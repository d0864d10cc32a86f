//! The restart policy of dead stages: pure logic, without processes.

use carff_config::RestartPolicy;
use std::collections::VecDeque;

/// Longest pause, as a multiple of the first pause.
const MAX_BACKOFF_FACTOR: u64 = 16;

/// Verdict on a stage that died.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// Restart it at this time, nanoseconds on the monotonic clock.
    RestartAt(u64),
    /// Do not restart it.
    Lost,
}

/// Counter of one stage's restarts.
#[derive(Clone, Debug)]
pub struct RestartBudget {
    policy: RestartPolicy,
    restarts: u32,
    /// Times of deaths within the policy's window, nanoseconds.
    recent_ns: VecDeque<u64>,
}

impl RestartBudget {
    /// Creates a supervisor without deaths.
    pub fn new(policy: RestartPolicy) -> Self {
        Self { policy, restarts: 0, recent_ns: VecDeque::new() }
    }

    /// Returns the number of restarts.
    pub fn restarts(&self) -> u32 {
        self.restarts
    }

    /// Judges a death at a time, nanoseconds.
    pub fn died(&mut self, now_ns: u64) -> Verdict {
        let RestartPolicy::OnFailure { backoff_ms, max_restarts, within_s } = self.policy else { return Verdict::Lost };
        let counts_from_ns = now_ns.saturating_sub(within_s.saturating_mul(1_000_000_000));
        self.recent_ns.retain(|&at_ns| at_ns >= counts_from_ns);
        let recent = self.recent_ns.len() as u32;
        if recent >= max_restarts {
            return Verdict::Lost;
        }
        self.recent_ns.push_back(now_ns);
        self.restarts += 1;
        let factor = 1_u64.checked_shl(recent).unwrap_or(u64::MAX).min(MAX_BACKOFF_FACTOR);
        Verdict::RestartAt(now_ns.saturating_add(backoff_ms.saturating_mul(factor * 1_000_000)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const S: u64 = 1_000_000_000;

    /// Pauses double up to 16 times the first, and after the limit the stage is lost.
    #[test]
    fn backoff_doubles_and_ends() {
        let mut budget = RestartBudget::new(RestartPolicy::OnFailure { backoff_ms: 10, max_restarts: 7, within_s: 60 });
        let pauses: Vec<_> = (0..8).map(|_| budget.died(1000)).collect();
        let expected = [10, 20, 40, 80, 160, 160, 160].map(|ms: u64| Verdict::RestartAt(1000 + ms * 1_000_000));
        assert_eq!(pauses[..7], expected);
        assert_eq!(pauses[7], Verdict::Lost);
        assert_eq!(budget.restarts(), 7);
    }

    /// Deaths before the policy's window do not count: a stage may die now and then indefinitely.
    #[test]
    fn old_deaths_are_forgotten() {
        let mut budget = RestartBudget::new(RestartPolicy::OnFailure { backoff_ms: 10, max_restarts: 2, within_s: 60 });
        for i in 0..100 {
            let now_ns = i * 31 * S;
            let pause_ms = if i == 0 { 10 } else { 20 };
            assert_eq!(budget.died(now_ns), Verdict::RestartAt(now_ns + pause_ms * 1_000_000), "death {i}");
        }
        assert_eq!(budget.restarts(), 100);
        assert_eq!(budget.died(99 * 31 * S + 1), Verdict::Lost);
    }

    /// The policy `never` gives up at once.
    #[test]
    fn never_means_never() {
        assert_eq!(RestartBudget::new(RestartPolicy::Never).died(0), Verdict::Lost);
    }
}
