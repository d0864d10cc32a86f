//! Watches a running graph frame by frame. It attaches as a probe, so it never delays a stage.

mod assembly;

use crate::journal::{Journal, ShownDecision};
use crate::session::Moment;
use assembly::{Assembly, input};
use carff_messages::{Action, ActionCode, Belief, FrameMeta, Health, Posterior, Reason, Rule, Stage, Unknowns};
use carff_observe::{AttachError, Attached, LiveRun, attach};
use carff_transport::{OpenError, ReceiveError, Receiver, topics};
use std::collections::BTreeMap;
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError, mpsc};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

/// Polling interval of the topics.
const LOOK: Duration = Duration::from_millis(20);
/// Interval at which the feed checks whether the run is still alive or has come back.
const LOOK_FOR_RUN: Duration = Duration::from_secs(1);
/// Reason why a run cannot be watched.
#[derive(Debug, thiserror::Error)]
pub enum LiveError {
    /// The run cannot be joined.
    #[error(transparent)]
    Attach(#[from] AttachError),
    /// A topic cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// A topic can no longer be read.
    #[error(transparent)]
    Receive(#[from] ReceiveError),
    /// No thread could be started.
    #[error("cannot start a thread to watch the run: {0}")]
    Thread(std::io::Error),
}

/// State of a watched run.
#[derive(Clone, Debug)]
pub struct WatchedRun {
    /// The run at the last join.
    pub run: LiveRun,
    /// Ok while joined, else the reason why not. The feed retries every second.
    pub joined: Result<(), String>,
    /// Number of frames received.
    pub frames: u64,
    /// Decisions, and durations by frame.
    pub journal: Journal,
    /// Last health report of each stage.
    pub health: BTreeMap<Stage, Health>,
    /// Moments of the newest frame with a complete belief, until they are taken.
    newest: Option<Vec<Moment>>,
}

/// Watches a run on its own thread until the feed is dropped.
pub struct LiveFeed {
    watched: Arc<Mutex<WatchedRun>>,
    stopped: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

impl LiveFeed {
    /// Joins the named run, or the only live run. The feed calls `wake` when it has news.
    pub fn attach(run: Option<String>, wake: impl Fn() + Send + 'static) -> Result<Self, LiveError> {
        let stopped = Arc::new(AtomicBool::new(false));
        let theirs = stopped.clone();
        // The thread joins, so that everything of the run stays in it. This function waits for its first answer.
        let (answer, answered) = mpsc::sync_channel(1);
        let thread = std::thread::Builder::new()
            .name("live".into())
            .spawn(move || match Watcher::join(run.as_deref()) {
                Err(error) => drop(answer.send(Err(error))),
                Ok(watcher) => {
                    let watched = Arc::new(Mutex::new(WatchedRun::of(watcher.attached.live.clone())));
                    if answer.send(Ok(watched.clone())).is_ok() {
                        watch(watcher, &watched, &theirs, &wake);
                    }
                }
            })
            .map_err(LiveError::Thread)?;
        let gone = |_| LiveError::Thread(std::io::Error::other("it ended at once"));
        let watched = answered.recv().map_err(gone)??;
        Ok(Self { watched, stopped, thread: Some(thread) })
    }

    /// Returns the current state of the run.
    pub fn watched(&self) -> MutexGuard<'_, WatchedRun> {
        locked(&self.watched)
    }

    /// Returns the moments of the newest frame if they are new.
    pub fn take_newest(&self) -> Option<Vec<Moment>> {
        self.watched().newest.take()
    }
}

impl Drop for LiveFeed {
    fn drop(&mut self) {
        self.stopped.store(true, Ordering::Relaxed);
        if let Some(thread) = self.thread.take() {
            // The thread ends early only by a panic, which has been reported by then.
            let _ = thread.join();
        }
    }
}

/// Locks the state. It is consistent at any time, so a poisoned lock is harmless.
fn locked(watched: &Mutex<WatchedRun>) -> MutexGuard<'_, WatchedRun> {
    watched.lock().unwrap_or_else(PoisonError::into_inner)
}

impl WatchedRun {
    fn of(run: LiveRun) -> Self {
        Self { run, joined: Ok(()), frames: 0, journal: Journal::default(), health: BTreeMap::new(), newest: None }
    }
}

/// Watches until it is stopped, and rejoins when the run ends and comes back.
fn watch(first: Watcher, watched: &Mutex<WatchedRun>, stopped: &AtomicBool, wake: &dyn Fn()) {
    let name = first.attached.live.name.clone();
    let mut watcher = Some(first);
    let mut looked = Instant::now();
    while !stopped.load(Ordering::Relaxed) {
        let mut lost = None;
        if let Some(joined) = &mut watcher {
            match joined.drain(watched) {
                Ok(true) => wake(),
                Ok(false) => {}
                Err(error) => lost = Some(error.to_string()),
            }
        }
        if looked.elapsed() >= LOOK_FOR_RUN || lost.is_some() {
            looked = Instant::now();
            match &watcher {
                Some(joined) if lost.is_none() && joined.attached.live.is_alive() => {}
                Some(_) => {
                    watcher = None;
                    let why = lost.unwrap_or_else(|| format!("run `{name}` has ended"));
                    locked(watched).joined = Err(why);
                    wake();
                }
                None => match Watcher::join(Some(&name)) {
                    Ok(joined) => {
                        *locked(watched) = WatchedRun::of(joined.attached.live.clone());
                        watcher = Some(joined);
                        wake();
                    }
                    Err(LiveError::Attach(AttachError::NoRun | AttachError::NoSuchRun { .. })) => {}
                    Err(error) => locked(watched).joined = Err(error.to_string()),
                },
            }
        }
        std::thread::sleep(LOOK);
    }
}

/// Subscriptions to a run's topics.
struct Watcher {
    attached: Attached,
    frames: Receiver<carff_transport::ImagePayload<FrameMeta>>,
    posteriors: Receiver<Posterior>,
    forecasts: Receiver<carff_messages::Forecast>,
    unknowns: Receiver<Unknowns>,
    beliefs: Receiver<Belief>,
    actions: Receiver<Action>,
    healths: Vec<Receiver<Health>>,
    assembly: Assembly,
    /// The last action that was not a decision; only changes are recorded.
    last_safe: Option<(ActionCode, Reason)>,
}

impl Watcher {
    fn join(run: Option<&str>) -> Result<Self, LiveError> {
        let attached = attach(run, "viewer")?;
        let node = &attached.node;
        let healths = Stage::ALL.iter().map(|&stage| Ok(node.receiver(topics::health(stage))?.polled()));
        Ok(Self {
            frames: node.receiver(&topics::FRAME)?.polled(),
            posteriors: node.receiver(&topics::POSTERIOR)?.polled(),
            forecasts: node.receiver(&topics::FORECAST)?.polled(),
            unknowns: node.receiver(&topics::UNKNOWN)?.polled(),
            beliefs: node.receiver(&topics::BELIEF)?.polled(),
            actions: node.receiver(&topics::ACTION)?.polled(),
            healths: healths.collect::<Result<_, OpenError>>()?,
            assembly: Assembly::default(),
            last_safe: None,
            attached,
        })
    }

    /// Reads all waiting messages; returns whether the window has news.
    fn drain(&mut self, watched: &Mutex<WatchedRun>) -> Result<bool, ReceiveError> {
        let mut is_new = false;
        // Topics are read in the order of the data flow, so that each message finds its frame.
        while let Some(frame) = self.frames.next()? {
            let meta = &*frame;
            locked(watched).frames = meta.header.frame_id + 1;
            self.assembly.frame(meta.header.frame_id, input(meta, frame.bytes()));
        }
        while let Some(posterior) = self.posteriors.next()? {
            let (frame, took_ns) = (posterior.header.frame_id, posterior.stage_latency_ns);
            locked(watched).journal.took("encoder", frame as f64, took_ns as f64 * 1e-6);
            self.assembly.posterior(&posterior);
        }
        while let Some(forecast) = self.forecasts.next()? {
            self.assembly.forecast(&forecast);
        }
        while let Some(unknowns) = self.unknowns.next()? {
            self.assembly.unknowns(&unknowns);
        }
        while let Some(belief) = self.beliefs.next()? {
            let frame = belief.header.frame_id as f64;
            let mut now = locked(watched);
            now.journal.took("forecaster", frame, belief.forecaster_ns as f64 * 1e-6);
            now.journal.took("prober", frame, belief.stage_latency_ns as f64 * 1e-6);
            if let Some(moments) = self.assembly.belief(&belief) {
                now.newest = Some(moments);
                is_new = true;
            }
        }
        while let Some(action) = self.actions.next()? {
            let mut now = locked(watched);
            if let Some(decision) = decision(&action, &mut self.last_safe) {
                if let Some(ms) = decision.latency_ms {
                    now.journal.took("camera to action", action.based_on_frame as f64, ms);
                }
                now.journal.decided(decision);
                is_new = true;
            }
        }
        for receiver in &mut self.healths {
            while let Some(health) = receiver.next()? {
                if let Ok(stage) = health.stage() {
                    locked(watched).health.insert(stage, *health);
                }
            }
        }
        Ok(is_new)
    }
}

/// Returns an entry for the first action on a frame, and for a safe action that differs from the last one.
fn decision(action: &Action, last_safe: &mut Option<(ActionCode, Reason)>) -> Option<ShownDecision> {
    let (code, reason) = (action.code().ok()?, action.reason().ok()?);
    let decided = action.is_decision();
    if reason == Reason::Belief {
        *last_safe = None;
        if !decided {
            return None;
        }
    } else if last_safe.replace((code, reason)) == Some((code, reason)) {
        return None;
    }
    let rule = Rule::try_from(action.rule).ok()?;
    let rests_on = match action.based_on_frame {
        u64::MAX => "no frame".to_owned(),
        frame => format!("frame {frame}"),
    };
    Some(ShownDecision {
        rests_on,
        action: code,
        confidence: action.confidence,
        hazard_probability: action.hazard_probability,
        reason: if reason == Reason::Belief { rule.name() } else { reason.name() }.to_owned(),
        latency_ms: (decided && action.latency_ns > 0).then_some(action.latency_ns as f64 * 1e-6),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Header;

    /// A decision is recorded once per frame; a safe action is recorded when it begins and when its reason changes.
    #[test]
    fn decisions_are_written_down_once() {
        let action = |reason: Reason, is_decision| Action {
            sample_count: 10,
            confidence: 0.5,
            hazard_probability: 0.5,
            is_decision,
            based_on_frame: 4,
            latency_ns: 2_500_000,
            ..Action::halt(Header::of_frame(4, 5, 77), reason, Rule::Calibrated)
        };
        let mut last = None;
        let stream = [
            (Reason::NoBeliefYet, 0, true),
            (Reason::NoBeliefYet, 0, false),
            (Reason::Belief, 1, true),
            (Reason::Belief, 0, false),
            (Reason::StaleBelief, 0, true),
            (Reason::NoBeliefYet, 0, true),
        ];
        for (reason, is_decision, written) in stream {
            assert_eq!(decision(&action(reason, is_decision), &mut last).is_some(), written, "{reason}");
        }
        let decided = decision(&action(Reason::Belief, 1), &mut last).unwrap();
        assert_eq!(
            (decided.latency_ms, decided.reason.as_str(), decided.action),
            (Some(2.5), "calibrated", ActionCode::Halt)
        );
    }
}
