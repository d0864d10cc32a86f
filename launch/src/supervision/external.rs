//! The camera of another process, seen from the launcher: how its frames arrive ([`ExternalCamera`], pure logic without
//! a clock), and who publishes them ([`ForeignCamera`]).

use super::monitor::Records;
use crate::NS_PER_S;
use carff_config::GraphConfig;
use carff_messages::{Header, Health, HealthState, Stage};
use carff_transport::{Node, Publisher, Run, monotonic_now_ns, topics};
use std::collections::VecDeque;

/// Interval of the heartbeats for a camera of another process.
const BEAT_NS: u64 = 100_000_000;

/// Number of newest frames that the rate is measured over.
const RECENT: usize = 32;
/// Share of the expected rate below which the camera is slow.
const SLOW_SHARE: f64 = 0.8;

/// Frames of a camera that the launcher has not started.
#[derive(Clone, Debug)]
pub struct ExternalCamera {
    expected_hz: f64,
    quiet_ns: u64,
    /// Arrival times of the newest frames.
    recent_ns: VecDeque<u64>,
    seen: u64,
    state: HealthState,
}

impl ExternalCamera {
    /// Creates the watch of a camera that is expected to publish at a rate, and that is stale after `quiet_ns` without a
    /// frame.
    pub fn new(expected_hz: f64, quiet_ns: u64) -> Self {
        Self { expected_hz, quiet_ns, recent_ns: VecDeque::new(), seen: 0, state: HealthState::Starting }
    }

    /// Takes the number of valid frames so far.
    fn saw(&mut self, frames: u64, now_ns: u64) {
        let new = frames.saturating_sub(std::mem::replace(&mut self.seen, frames));
        let quiet = |last_ns: &u64| now_ns.saturating_sub(*last_ns) > self.quiet_ns;
        if new > 0 && self.recent_ns.back().is_some_and(quiet) {
            // Older frames do not show the rate after the gap.
            self.recent_ns.clear();
        }
        for _ in 0..new.min(RECENT as u64) {
            self.recent_ns.push_back(now_ns);
        }
        while self.recent_ns.len() > RECENT {
            self.recent_ns.pop_front();
        }
    }

    /// Excludes a gap in which the launcher itself was not running.
    pub fn forgive(&mut self, gap_ns: u64) {
        self.recent_ns.iter_mut().for_each(|at_ns| *at_ns += gap_ns);
    }

    /// Returns the state at the last look.
    pub fn state(&self) -> HealthState {
        self.state
    }

    /// Returns the rate of the newest frames; `None` before there are enough of them.
    pub fn rate_hz(&self) -> Option<f64> {
        let (first, last) = (self.recent_ns.front()?, self.recent_ns.back()?);
        let span_s = (last - first) as f64 / NS_PER_S as f64;
        (self.recent_ns.len() >= 4 && span_s > 0.0).then(|| (self.recent_ns.len() - 1) as f64 / span_s)
    }

    /// Renews the state. Returns a log line if it has changed; `publisher` describes the process that has the topic
    /// open.
    pub fn look(&mut self, now_ns: u64, publisher: Option<&str>) -> Option<String> {
        let quiet_ns = now_ns.saturating_sub(*self.recent_ns.back()?);
        let slow = self.rate_hz().filter(|hz| *hz < SLOW_SHARE * self.expected_hz);
        let state = match slow {
            _ if quiet_ns > self.quiet_ns => HealthState::Stale,
            Some(_) if self.recent_ns.len() == RECENT => HealthState::Slow,
            _ => HealthState::Ok,
        };
        let before = std::mem::replace(&mut self.state, state);
        if state == before {
            return None;
        }
        let who = publisher.unwrap_or("a process that has ended");
        Some(match state {
            HealthState::Stale => {
                let whose = publisher.map_or("its process has ended", |_| "its process lives");
                format!(
                    "WARN camera: no frame for {} ms ({whose}): the safe action applies until frames come",
                    quiet_ns / 1_000_000
                )
            }
            HealthState::Slow => format!(
                "WARN camera: {:.1} frames a second from {who}, but `run.frame_rate_hz` is {}",
                slow.unwrap_or_default(),
                self.expected_hz
            ),
            _ if before == HealthState::Slow => "INFO camera: at the expected rate again".to_owned(),
            _ => format!("INFO camera: frames from {who}"),
        })
    }
}

/// The camera of another process. The launcher sends its heartbeats, because observers expect some of each stage; it
/// leaves that to the process if that sends its own.
pub(crate) struct ForeignCamera {
    frames: ExternalCamera,
    heartbeat: Publisher<Health>,
    seed: u64,
    linger_ns: u64,
    published: u64,
    /// Number and process of the latest frame.
    frame_id: u64,
    pid: u32,
    beat_ns: u64,
    /// Time at which the wanted number of frames had arrived.
    complete_ns: Option<u64>,
}

impl ForeignCamera {
    /// Prepares the watch of a camera, which is stale after `quiet_ns` without a frame.
    pub(crate) fn expect(node: &Node, graph: &GraphConfig, quiet_ns: u64) -> anyhow::Result<Self> {
        Ok(Self {
            frames: ExternalCamera::new(graph.run.frame_rate_hz, quiet_ns),
            heartbeat: node.publisher(topics::health(Stage::Camera))?,
            seed: graph.run.seed,
            linger_ns: graph.camera.linger_ms * 1_000_000,
            published: 0,
            frame_id: 0,
            pid: 0,
            beat_ns: 0,
            complete_ns: None,
        })
    }

    /// Returns the log line that names who is expected.
    pub(crate) fn invitation(run: &Run) -> String {
        let (topic, name) = (topics::FRAME.name, run.name());
        format!(
            "INFO camera: waiting for another process to publish `{topic}` of run `{name}`; `carff run info {name} \
             --json` prints what it needs to join"
        )
    }

    /// Takes the launcher's records, renews the state, and sends a heartbeat. Returns a log line if the state has
    /// changed.
    pub(crate) fn watch(&mut self, node: &Node, records: &Records) -> anyhow::Result<Option<String>> {
        let now_ns = monotonic_now_ns();
        self.frames.saw(records.frames_seen, now_ns);
        if now_ns < self.beat_ns {
            return Ok(None);
        }
        self.beat_ns = now_ns + BEAT_NS;
        (self.published, self.frame_id) = (records.frames_seen, records.frame_count().saturating_sub(1));
        let publishers = node.ports(&topics::FRAME)?.publishers;
        let who = publishers.first().map(|member| format!("{} (process {})", member.name, member.pid));
        self.pid = publishers.first().map_or(0, |member| member.pid);
        let line = self.frames.look(now_ns, who.as_deref());
        let own = std::process::id();
        if node.ports(topics::health(Stage::Camera))?.publishers.iter().all(|member| member.pid == own) {
            self.heartbeat.send(self.health(now_ns))?;
        }
        Ok(line)
    }

    /// Returns true once the wanted number of frames has arrived, and time to work on them has passed. The camera may
    /// continue meanwhile: it does not know the number.
    pub(crate) fn is_complete(&mut self, wanted: Option<u64>) -> bool {
        if wanted.is_none_or(|wanted| self.published < wanted) {
            return false;
        }
        let now_ns = monotonic_now_ns();
        now_ns - *self.complete_ns.get_or_insert(now_ns) >= self.linger_ns
    }

    /// Excludes a gap in which the launcher itself was not running.
    pub(crate) fn forgive(&mut self, gap_ns: u64) {
        self.frames.forgive(gap_ns);
    }

    /// Returns the state at the last look.
    pub(crate) fn state(&self) -> HealthState {
        self.frames.state()
    }

    fn health(&self, now_ns: u64) -> Health {
        Health {
            header: Header::of_frame(self.frame_id, 0, self.seed),
            stage: Stage::Camera.code(),
            state: self.frames.state().code(),
            pid: self.pid,
            received: 0,
            published: self.published,
            skipped: 0,
            invalid: 0,
            errors: 0,
            last_latency_ns: 0,
            max_latency_ns: 0,
            last_progress_ns: now_ns,
            rss_bytes: 0,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    /// A camera is waited for, then ok; stale when it is quiet, and ok again; slow when it falls behind.
    #[test]
    fn a_camera_comes_goes_and_falls_behind() {
        let mut camera = ExternalCamera::new(10.0, 500 * MS);
        assert_eq!((camera.look(9000 * MS, None), camera.state()), (None, HealthState::Starting));
        let mut at = 10_000 * MS;
        let mut frames = 0;
        let mut run = |camera: &mut ExternalCamera, count: u64, period_ms: u64, at: &mut u64| {
            (0..count)
                .filter_map(|_| {
                    *at += period_ms * MS;
                    frames += 1;
                    camera.saw(frames, *at);
                    camera.look(*at, Some("cam (process 7)"))
                })
                .collect::<Vec<_>>()
        };
        assert_eq!(run(&mut camera, 40, 100, &mut at), ["INFO camera: frames from cam (process 7)"]);
        assert!((camera.rate_hz().unwrap() - 10.0).abs() < 0.1);
        let quiet = camera.look(at + 501 * MS, None).unwrap();
        assert!(quiet.contains("no frame for 501 ms (its process has ended)"), "{quiet}");
        assert_eq!((camera.look(at + 900 * MS, None), camera.state()), (None, HealthState::Stale));
        at += 5000 * MS;
        assert_eq!(run(&mut camera, 1, 100, &mut at), ["INFO camera: frames from cam (process 7)"]);
        assert_eq!(run(&mut camera, 40, 100, &mut at), Vec::<String>::new());
        let slow = run(&mut camera, 40, 200, &mut at);
        assert!(slow.len() == 1 && slow[0].contains("frames a second") && slow[0].contains("is 10"), "{slow:?}");
        assert_eq!(run(&mut camera, 40, 100, &mut at), ["INFO camera: at the expected rate again"]);
    }

    /// A gap of the launcher itself is not the camera's.
    #[test]
    fn the_launchers_own_pause_is_forgiven() {
        let mut camera = ExternalCamera::new(10.0, 500 * MS);
        camera.saw(1, 0);
        camera.look(0, None);
        camera.forgive(10_000 * MS);
        assert_eq!(camera.look(10_400 * MS, None), None);
        assert_eq!(camera.state(), HealthState::Ok);
    }
}
