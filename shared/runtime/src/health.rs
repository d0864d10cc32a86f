//! The heartbeat: a separate thread, so that it continues while the stage loads or computes.

use anyhow::Context;
use carff_messages::{Header, Health, HealthState, Stage};
use carff_transport::{Counters, Node, Run, monotonic_now_ns, topics};
use crossbeam::channel::{Receiver, RecvTimeoutError, Sender, bounded, unbounded};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU32, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::Duration;

/// Interval between two heartbeats.
const PERIOD: Duration = Duration::from_millis(100);

/// Longest wait for a requested heartbeat: it only keeps a broken transport from hanging the stage.
const PATIENCE: Duration = Duration::from_secs(1);

/// State that the stage's loop writes and the heartbeat reads.
#[derive(Debug)]
pub(crate) struct Vitals {
    state: AtomicU32,
    frame_id: AtomicU64,
    errors: AtomicU64,
    last_latency_ns: AtomicU64,
    max_latency_ns: AtomicU64,
    last_progress_ns: AtomicU64,
    /// True while the stage waits for input, which is not a hang.
    waiting: AtomicBool,
}

impl Vitals {
    pub(crate) fn new() -> Self {
        Self {
            state: AtomicU32::new(HealthState::Starting.code()),
            frame_id: AtomicU64::new(0),
            errors: AtomicU64::new(0),
            last_latency_ns: AtomicU64::new(0),
            max_latency_ns: AtomicU64::new(0),
            last_progress_ns: AtomicU64::new(monotonic_now_ns()),
            waiting: AtomicBool::new(false),
        }
    }

    pub(crate) fn set_state(&self, state: HealthState) {
        self.state.store(state.code(), Ordering::Relaxed);
    }

    pub(crate) fn progress(&self) {
        self.last_progress_ns.store(monotonic_now_ns(), Ordering::Relaxed);
    }

    /// Records that the loop starts or ends a wait.
    pub(crate) fn set_waiting(&self, waiting: bool) {
        self.progress();
        self.waiting.store(waiting, Ordering::Relaxed);
    }

    pub(crate) fn count_error(&self) {
        self.errors.fetch_add(1, Ordering::Relaxed);
    }

    pub(crate) fn worked(&self, header: &Header, latency_ns: u64) {
        self.frame_id.store(header.frame_id, Ordering::Relaxed);
        self.last_latency_ns.store(latency_ns, Ordering::Relaxed);
        self.max_latency_ns.fetch_max(latency_ns, Ordering::Relaxed);
        self.progress();
    }
}

/// A running heartbeat. Dropping it sends the last beat, with the final state.
#[derive(Debug)]
pub(crate) struct Heartbeat {
    /// Requests a beat at once; the answer confirms that it has been sent.
    ask: Option<Sender<Sender<()>>>,
    thread: Option<JoinHandle<()>>,
}

impl Heartbeat {
    /// Joins the run under the stage's name, and beats from then on. The thread has a node of its own, because the
    /// ports of a node belong to one thread.
    pub(crate) fn start(
        run: &Run,
        stage: Stage,
        seed: u64,
        vitals: Arc<Vitals>,
        counters: Arc<Counters>,
    ) -> anyhow::Result<Self> {
        let (ask, asked) = unbounded::<Sender<()>>();
        let (open, opened) = bounded(1);
        let run = run.clone();
        let thread = std::thread::Builder::new().name("heartbeat".to_owned()).spawn(move || {
            let joined = Node::open(&run, stage.name())
                .and_then(|node| Ok((node.publisher(topics::health(stage))?, node)))
                .map(|(mut publisher, node)| {
                    let beat = move || {
                        if let Err(error) = publisher.send(snapshot(stage, seed, &vitals, &counters)) {
                            tracing::warn!(%error, "no heartbeat");
                        }
                    };
                    (beat, node)
                });
            match joined {
                Ok((beat, _node)) => {
                    let _ = open.send(Ok(()));
                    beat_until_dropped(beat, &asked);
                }
                Err(error) => drop(open.send(Err(error))),
            }
        });
        let thread = thread.context("cannot start the thread of the heartbeat")?;
        // A thread that panicked has reported why.
        opened.recv().context("the thread of the heartbeat ended")??;
        Ok(Self { ask: Some(ask), thread: Some(thread) })
    }

    /// Sends a heartbeat now, and returns when it has been sent: the stage's state is known before its next action.
    pub(crate) fn beat(&self) {
        let (answer, answered) = bounded(1);
        if let Some(ask) = &self.ask
            && ask.send(answer).is_ok()
        {
            let _ = answered.recv_timeout(PATIENCE);
        }
    }
}

/// Beats at each interval and at each request, and once more when the stage ends.
fn beat_until_dropped(mut beat: impl FnMut(), asked: &Receiver<Sender<()>>) {
    loop {
        beat();
        match asked.recv_timeout(PERIOD) {
            Ok(answer) => {
                beat();
                // The requester may have given up.
                let _ = answer.send(());
            }
            Err(RecvTimeoutError::Timeout) => {}
            Err(RecvTimeoutError::Disconnected) => return beat(),
        }
    }
}

impl Drop for Heartbeat {
    fn drop(&mut self) {
        self.ask = None;
        if let Some(thread) = self.thread.take() {
            // A panic of the thread has been printed by then, and the stage is ending anyway.
            let _ = thread.join();
        }
    }
}

fn snapshot(stage: Stage, seed: u64, vitals: &Vitals, counters: &Counters) -> Health {
    let last_progress_ns = if vitals.waiting.load(Ordering::Relaxed) {
        monotonic_now_ns()
    } else {
        vitals.last_progress_ns.load(Ordering::Relaxed)
    };
    Health {
        header: Header::of_frame(vitals.frame_id.load(Ordering::Relaxed), 0, seed),
        stage: stage.code(),
        state: vitals.state.load(Ordering::Relaxed),
        pid: std::process::id(),
        received: counters.received(),
        published: counters.published(),
        skipped: counters.skipped(),
        invalid: counters.invalid(),
        errors: vitals.errors.load(Ordering::Relaxed),
        last_latency_ns: vitals.last_latency_ns.load(Ordering::Relaxed),
        max_latency_ns: vitals.max_latency_ns.load(Ordering::Relaxed),
        last_progress_ns,
        rss_bytes: resident_bytes().unwrap_or(0),
    }
}

/// Returns this process's resident memory, bytes.
fn resident_bytes() -> Option<u64> {
    let text = std::fs::read_to_string("/proc/self/statm").ok()?;
    let pages: u64 = text.split_whitespace().nth(1)?.parse().ok()?;
    Some(pages * rustix::param::page_size() as u64)
}
