//! The schedule of faults: a pure function of the soak file and the seed.

use carff_base::random::{Key, stream};
use carff_config::{FaultKind, SoakConfig};
use carff_messages::Stage;
use rand::Rng;
use std::fmt;

/// Name of the schedule's random streams.
const STREAM: u32 = 0x50a4;
/// Shortest time for which a process is stopped or slowed, milliseconds.
const MIN_HOLD_MS: u64 = 50;

/// A fault of the schedule.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Fault {
    /// Number in the schedule, from 0.
    pub number: u64,
    /// Pause before the fault, milliseconds.
    pub pause_ms: u64,
    /// Kind of fault.
    pub kind: FaultKind,
    /// The affected stage, for faults on a stage; `None` is the launcher.
    pub target: Option<Stage>,
    /// Duration, for faults that last, milliseconds.
    pub hold_ms: u64,
    /// Number of messages or probes.
    pub count: u32,
    /// Seed of its further random draws.
    pub seed: u64,
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let target = self.target.map_or("launcher", Stage::name);
        write!(
            f,
            "fault {}: {} ({target}, {} ms, count {}) after {} ms",
            self.number,
            self.kind.name(),
            self.hold_ms,
            self.count,
            self.pause_ms
        )
    }
}

/// Returns the fault of a number.
pub fn fault(config: &SoakConfig, seed: u64, number: u64) -> Fault {
    let mut random = stream(Key { seed, frame: number, step: STREAM, sample: 0 });
    let sum: u32 = FaultKind::ALL.iter().map(|&kind| config.faults.of(kind)).sum();
    let mut at = random.random_range(0..sum);
    let drawn = FaultKind::ALL.iter().copied().find(|&kind| {
        let weight = config.faults.of(kind);
        let here = at < weight;
        at = at.saturating_sub(weight);
        here
    });
    // The sum of the weights is above 0, so one of them was chosen.
    let kind = drawn.unwrap_or(FaultKind::Kill);
    let pause_ms = random.random_range(config.pace.min_pause_ms..=config.pace.max_pause_ms);
    // The launcher can be stopped as well.
    let targets = Stage::ALL.len() + usize::from(kind == FaultKind::Stop);
    let target = Stage::ALL.get(random.random_range(0..targets)).copied();
    let hold_ms = random.random_range(MIN_HOLD_MS..=config.pace.max_hold_ms);
    Fault { number, pause_ms, kind, target, hold_ms, count: random.random_range(1..=8), seed: random.random() }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config(faults: &str) -> SoakConfig {
        SoakConfig::parse(&format!("graph = \"g.toml\"\n[faults]\n{faults}"), "s.toml".as_ref()).unwrap()
    }

    fn first(config: &SoakConfig, seed: u64, count: u64) -> Vec<Fault> {
        (0..count).map(|number| fault(config, seed, number)).collect()
    }

    /// The same file and seed give the same schedule in any order of calls; another seed gives another schedule.
    #[test]
    fn a_seed_is_a_schedule() {
        let config = config("kill = 3\nstop = 1\nnan = 2\n");
        assert_eq!(first(&config, 7, 200), first(&config, 7, 200));
        assert_eq!(fault(&config, 7, 150), first(&config, 7, 200)[150]);
        assert_ne!(first(&config, 7, 200), first(&config, 8, 200));
    }

    /// Kinds occur as often as their weights require, kinds without weight never. Times stay within their limits. Every
    /// stage is affected; the launcher is only stopped.
    #[test]
    fn weights_and_limits_hold() {
        let config = config("kill = 30\nstop = 10\n");
        let faults = first(&config, 1, 4000);
        let kills = faults.iter().filter(|f| f.kind == FaultKind::Kill).count();
        assert!(faults.iter().all(|f| matches!(f.kind, FaultKind::Kill | FaultKind::Stop)));
        assert!((2850..3150).contains(&kills), "{kills}");
        for f in &faults {
            assert!((config.pace.min_pause_ms..=config.pace.max_pause_ms).contains(&f.pause_ms));
            assert!((MIN_HOLD_MS..=config.pace.max_hold_ms).contains(&f.hold_ms));
            assert!(f.target.is_some() || f.kind == FaultKind::Stop);
        }
        for stage in Stage::ALL {
            assert!(faults.iter().any(|f| f.target == Some(stage)));
        }
        assert!(faults.iter().any(|f| f.target.is_none()));
    }
}
