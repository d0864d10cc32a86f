//! The health of each stage, from its heartbeats and the silence of its topic: pure logic, without processes and
//! without a clock. It never reads logs; they are for people.
//!
//! ```text
//! starting --ready--> ok <--> slow, stale          its own words, and its topics' deadlines
//!     |                \------> faulty              its own word, or it hangs: no heartbeat, or its loop stands still
//!     \--not in time-->/           |
//!                            killed, or it died --> restarting --> starting ...   within the limits of its policy
//!                                                 \-> lost                        beyond them
//! ```

use crate::NS_PER_MS;
use carff_messages::{Health, HealthState};
use std::fmt;

/// Time limits of a stage, nanoseconds.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[allow(clippy::struct_field_names, reason = "the postfix is the unit")]
pub struct HealthLimits {
    /// Limit from the start until the stage is ready.
    pub start_ns: u64,
    /// Time without a heartbeat after which the stage is stale.
    pub silence_ns: u64,
    /// Time without a heartbeat after which the stage hangs.
    pub hang_ns: u64,
    /// Time without a round of its loop after which the stage hangs.
    pub standstill_ns: u64,
    /// Time without a message on its topic, once the topic has begun, after which the stage is stale.
    pub quiet_ns: u64,
}

/// Reason why a stage must be killed.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Ailment {
    /// It was not ready in time.
    NotReady {
        /// The limit, nanoseconds.
        limit_ns: u64,
    },
    /// No heartbeat arrives: the process is stopped, or gets no processor time.
    Silent {
        /// Time without a heartbeat, nanoseconds.
        for_ns: u64,
    },
    /// Heartbeats arrive, but the loop makes no rounds.
    Standstill {
        /// Time without a round, nanoseconds.
        for_ns: u64,
    },
}

impl fmt::Display for Ailment {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotReady { limit_ns } => write!(f, "was not ready within {} ms", limit_ns / NS_PER_MS),
            Self::Silent { for_ns } => write!(f, "hangs: no heartbeat for {} ms", for_ns / NS_PER_MS),
            Self::Standstill { for_ns } => write!(f, "hangs: no round of its loop for {} ms", for_ns / NS_PER_MS),
        }
    }
}

/// A process of the stage.
#[derive(Clone, Copy, Debug)]
struct Life {
    pid: u32,
    started_ns: u64,
    ready: bool,
    /// Arrival and sequence number of its latest heartbeat.
    beat: Option<(u64, u64)>,
    /// State in the latest heartbeat.
    said: HealthState,
    standstill_ns: u64,
    /// Arrival of the latest message on the topic.
    spoke_ns: Option<u64>,
}

/// Phase of the stage's life.
#[derive(Clone, Copy, Debug)]
enum Phase {
    Runs(Life),
    Restarting,
    Lost,
    Done,
}

/// The health of one stage.
#[derive(Clone, Copy, Debug)]
pub struct StageHealth {
    limits: HealthLimits,
    phase: Phase,
    was_ready: bool,
}

impl StageHealth {
    /// Creates the health of a stage whose first process has just started.
    pub fn started(limits: HealthLimits, pid: u32, now_ns: u64) -> Self {
        let mut health = Self { limits, phase: Phase::Restarting, was_ready: false };
        health.restarted(pid, now_ns);
        health
    }

    /// Records the start of another process.
    pub fn restarted(&mut self, pid: u32, now_ns: u64) {
        self.phase = Phase::Runs(Life {
            pid,
            started_ns: now_ns,
            ready: false,
            beat: None,
            said: HealthState::Starting,
            standstill_ns: 0,
            spoke_ns: None,
        });
    }

    /// Records a heartbeat. Repeated heartbeats, and heartbeats of earlier processes, are ignored.
    pub fn heard(&mut self, health: &Health, now_ns: u64) {
        let Phase::Runs(life) = &mut self.phase else { return };
        let sequence = health.header.sequence;
        if health.pid != life.pid || life.beat.is_some_and(|(_, heard)| sequence <= heard) {
            return;
        }
        life.beat = Some((now_ns, sequence));
        // An unknown code has been refused on arrival.
        life.said = health.state().unwrap_or(HealthState::Faulty);
        life.standstill_ns = health.header.publish_time_ns.saturating_sub(health.last_progress_ns);
        if !matches!(life.said, HealthState::Starting | HealthState::Faulty) {
            (life.ready, self.was_ready) = (true, true);
        }
    }

    /// Records the time of a message on the stage's topic.
    pub fn spoke(&mut self, at_ns: u64) {
        if let Phase::Runs(life) = &mut self.phase
            && at_ns >= life.started_ns
        {
            life.spoke_ns = Some(at_ns);
        }
    }

    /// Records the end of its process; a restart follows.
    pub fn died(&mut self) {
        self.phase = Phase::Restarting;
    }

    /// Records the end of its process; no restart follows.
    pub fn lost(&mut self) {
        self.phase = Phase::Lost;
    }

    /// Records that the stage has completed its work.
    pub fn done(&mut self) {
        self.phase = Phase::Done;
    }

    /// Excludes a gap in which the judge itself was not running.
    pub fn forgive(&mut self, gap_ns: u64) {
        if let Phase::Runs(life) = &mut self.phase {
            life.started_ns += gap_ns;
            life.beat = life.beat.map(|(at_ns, sequence)| (at_ns + gap_ns, sequence));
            life.spoke_ns = life.spoke_ns.map(|at_ns| at_ns + gap_ns);
            life.standstill_ns = 0;
        }
    }

    /// Returns true if the current process is ready.
    pub fn is_ready(&self) -> bool {
        matches!(&self.phase, Phase::Runs(life) if life.ready)
    }

    /// Returns true if any of its processes has ever been ready.
    pub fn was_ready(&self) -> bool {
        self.was_ready
    }

    /// Returns the reason to kill the stage, if there is one.
    pub fn ailment(&self, now_ns: u64) -> Option<Ailment> {
        let Phase::Runs(life) = &self.phase else { return None };
        if !life.ready {
            let limit_ns = self.limits.start_ns;
            return (now_ns.saturating_sub(life.started_ns) > limit_ns).then_some(Ailment::NotReady { limit_ns });
        }
        let silent_ns = life.silent_ns(now_ns);
        if silent_ns > self.limits.hang_ns {
            return Some(Ailment::Silent { for_ns: silent_ns });
        }
        // A stage that is ending makes no more rounds.
        let standstill_ns = if life.said == HealthState::Done { 0 } else { life.standstill_ns };
        (standstill_ns > self.limits.standstill_ns).then_some(Ailment::Standstill { for_ns: standstill_ns })
    }

    /// Returns its state.
    pub fn state(&self, now_ns: u64) -> HealthState {
        let life = match &self.phase {
            Phase::Runs(life) => life,
            Phase::Restarting => return HealthState::Restarting,
            Phase::Lost => return HealthState::Lost,
            Phase::Done => return HealthState::Done,
        };
        if self.ailment(now_ns).is_some() {
            return HealthState::Faulty;
        }
        let quiet = life.spoke_ns.is_some_and(|at_ns| now_ns.saturating_sub(at_ns) > self.limits.quiet_ns);
        match life.said {
            HealthState::Starting | HealthState::Faulty | HealthState::Done => life.said,
            _ if life.silent_ns(now_ns) > self.limits.silence_ns || quiet => HealthState::Stale,
            HealthState::Ok | HealthState::Slow | HealthState::Stale => life.said,
            // A living process cannot report these states of itself.
            HealthState::Restarting | HealthState::Lost => HealthState::Faulty,
        }
    }
}

impl Life {
    fn silent_ns(&self, now_ns: u64) -> u64 {
        now_ns.saturating_sub(self.beat.map_or(self.started_ns, |(at_ns, _)| at_ns))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Header, Stage};

    const MS: u64 = 1_000_000;
    const LIMITS: HealthLimits = HealthLimits {
        start_ns: 5000 * MS,
        silence_ns: 1000 * MS,
        hang_ns: 2000 * MS,
        standstill_ns: 3000 * MS,
        quiet_ns: 500 * MS,
    };

    fn beat(pid: u32, sequence: u64, state: HealthState, standstill_ms: u64) -> Health {
        let mut header = Header::of_frame(0, 0, 1);
        header.sequence = sequence;
        header.publish_time_ns = 1_000_000 * MS;
        Health {
            header,
            stage: Stage::Encoder.code(),
            state: state.code(),
            pid,
            received: 0,
            published: 0,
            skipped: 0,
            invalid: 0,
            errors: 0,
            last_latency_ns: 0,
            max_latency_ns: 0,
            last_progress_ns: header.publish_time_ns - standstill_ms * MS,
            rss_bytes: 0,
        }
    }

    /// Returns a stage of process 7 that became ready at 100 ms.
    fn ready() -> StageHealth {
        let mut health = StageHealth::started(LIMITS, 7, 0);
        health.heard(&beat(7, 0, HealthState::Starting, 0), 50 * MS);
        assert_eq!(health.state(60 * MS), HealthState::Starting);
        health.heard(&beat(7, 1, HealthState::Ok, 0), 100 * MS);
        health
    }

    /// A stage goes from starting to ok; it reports slow and stale itself, and recovers by itself.
    #[test]
    fn a_stage_says_how_it_is() {
        let mut health = ready();
        assert!(health.is_ready() && health.was_ready());
        for (sequence, state) in
            [HealthState::Slow, HealthState::Ok, HealthState::Stale, HealthState::Faulty, HealthState::Ok]
                .into_iter()
                .enumerate()
        {
            health.heard(&beat(7, 2 + sequence as u64, state, 0), 200 * MS);
            assert_eq!((health.state(210 * MS), health.ailment(210 * MS)), (state, None));
        }
    }

    /// Without heartbeats it is first stale, then hangs; repeated heartbeats and those of other processes do not count.
    #[test]
    fn silence_is_stale_then_a_hang() {
        let mut health = ready();
        health.heard(&beat(7, 1, HealthState::Ok, 0), 900 * MS);
        health.heard(&beat(6, 99, HealthState::Ok, 0), 900 * MS);
        assert_eq!(health.state(1100 * MS), HealthState::Ok);
        assert_eq!(health.state(1101 * MS), HealthState::Stale);
        assert_eq!(health.ailment(2100 * MS), None);
        assert_eq!(health.state(2101 * MS), HealthState::Faulty);
        let ailment = health.ailment(2101 * MS).unwrap();
        assert_eq!(ailment.to_string(), "hangs: no heartbeat for 2001 ms");
    }

    /// Heartbeats do not suffice: a stage whose loop makes no rounds hangs too. A stage that has completed its work
    /// does not.
    #[test]
    fn a_loop_that_stands_still_hangs() {
        let mut health = ready();
        health.heard(&beat(7, 2, HealthState::Ok, 3000), 200 * MS);
        assert_eq!(health.ailment(200 * MS), None);
        health.heard(&beat(7, 3, HealthState::Ok, 3001), 300 * MS);
        assert_eq!(health.ailment(300 * MS), Some(Ailment::Standstill { for_ns: 3001 * MS }));
        assert_eq!(health.state(300 * MS), HealthState::Faulty);
        health.heard(&beat(7, 4, HealthState::Done, 9000), 400 * MS);
        assert_eq!((health.ailment(400 * MS), health.state(400 * MS)), (None, HealthState::Done));
    }

    /// A process that is not ready in time hangs, even if it reports that it is starting, and also after a restart.
    #[test]
    fn start_up_has_a_limit() {
        let mut health = StageHealth::started(LIMITS, 7, 0);
        health.heard(&beat(7, 0, HealthState::Starting, 0), 4900 * MS);
        assert_eq!(health.ailment(5000 * MS), None);
        assert_eq!(health.ailment(5001 * MS).unwrap().to_string(), "was not ready within 5000 ms");
        let mut health = ready();
        health.died();
        assert_eq!((health.state(0), health.is_ready(), health.was_ready()), (HealthState::Restarting, false, true));
        health.restarted(8, 6000 * MS);
        health.heard(&beat(7, 50, HealthState::Ok, 0), 6100 * MS);
        assert_eq!(health.state(6100 * MS), HealthState::Starting);
        assert_eq!(health.ailment(11_001 * MS), Some(Ailment::NotReady { limit_ns: 5000 * MS }));
        // The counts of the new process start again.
        health.heard(&beat(8, 0, HealthState::Ok, 0), 6200 * MS);
        assert_eq!((health.state(6200 * MS), health.ailment(6200 * MS)), (HealthState::Ok, None));
    }

    /// A topic that has begun and falls silent makes its stage stale, even if the stage reports ok. A topic that has
    /// not begun does not. Silence is never a reason to kill.
    #[test]
    fn a_quiet_topic_is_stale() {
        let mut health = ready();
        assert_eq!(health.state(1000 * MS), HealthState::Ok);
        health.spoke(300 * MS);
        health.heard(&beat(7, 2, HealthState::Ok, 0), 800 * MS);
        assert_eq!(health.state(800 * MS), HealthState::Ok);
        assert_eq!((health.state(801 * MS), health.ailment(801 * MS)), (HealthState::Stale, None));
        health.spoke(810 * MS);
        assert_eq!(health.state(820 * MS), HealthState::Ok);
    }

    /// A time in which the judge itself was not running counts for no stage.
    #[test]
    fn the_judges_own_pause_is_forgiven() {
        let mut health = ready();
        health.forgive(60_000 * MS);
        assert_eq!(health.state(60_200 * MS), HealthState::Ok);
        let mut starting = StageHealth::started(LIMITS, 7, 0);
        starting.forgive(60_000 * MS);
        assert_eq!(starting.ailment(64_000 * MS), None);
    }

    /// The final states lost and done do not change.
    #[test]
    fn the_ends_are_final() {
        let mut health = ready();
        health.lost();
        health.heard(&beat(7, 9, HealthState::Ok, 0), 100 * MS);
        assert_eq!((health.state(u64::MAX), health.ailment(u64::MAX)), (HealthState::Lost, None));
        health.done();
        assert_eq!(health.state(0), HealthState::Done);
    }
}
