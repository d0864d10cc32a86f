//! Tests of a stage's heartbeats.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_config::GraphConfig;
use carff_messages::{Gaussian, Header, HealthState, Posterior, Stage};
use carff_runtime::{StageArgs, StageContext, run_with};
use carff_transport::{Node, Receiver, Run, Stop, Waiter, monotonic_now_ns, remove_run_leftovers, topics};
use std::process::ExitCode;

struct Fixture {
    folder: tempfile::TempDir,
    run: Run,
}

impl Fixture {
    fn new(name: &str) -> Self {
        let run = Run::new(&format!("s{}-{name}", std::process::id()), 5).unwrap();
        let folder = tempfile::tempdir().unwrap();
        let text = format!("[run]\nname = \"{}\"\ndataset = \"d\"\ncheckpoint = \"c\"\n", run.name());
        std::fs::write(folder.path().join("graph.toml"), text).unwrap();
        Self { folder, run }
    }

    fn args(&self) -> StageArgs {
        StageArgs::new(&self.folder.path().join("graph.toml"), self.run.name(), 5)
    }

    fn context(&self, stage: Stage) -> StageContext {
        let args = self.args();
        let graph = GraphConfig::load(&args.graph).unwrap();
        StageContext::new(stage, args, graph).unwrap()
    }
}

impl Drop for Fixture {
    fn drop(&mut self) {
        let _ = remove_run_leftovers(&self.run);
    }
}

/// Waits for a heartbeat with a property; a watchdog bounds the wait.
fn heartbeat(
    input: &mut Receiver<carff_messages::Health>,
    wanted: impl Fn(&carff_messages::Health) -> bool,
) -> carff_messages::Health {
    let waiter = Waiter::new(Stop::new().unwrap());
    let watchdog_ns = monotonic_now_ns() + 30_000_000_000;
    while monotonic_now_ns() < watchdog_ns {
        waiter.wait_until(&[input], watchdog_ns).unwrap();
        while let Some(health) = input.next().unwrap() {
            if wanted(&health) {
                return *health;
            }
        }
    }
    panic!("no such heartbeat");
}

/// The heartbeat of `ready` has been sent when it returns: a stage that dies in its first frame has been ready.
#[test]
fn ready_is_said_before_work_begins() {
    let fixture = Fixture::new("ready");
    let node = Node::open(&fixture.run, "test").unwrap();
    let mut health = node.receiver(topics::health(Stage::Camera)).unwrap();
    let mut stage = fixture.context(Stage::Camera);
    stage.ready();
    let mut states = Vec::new();
    while let Some(health) = health.next().unwrap() {
        states.push(health.state().unwrap());
    }
    assert_eq!(states.last(), Some(&HealthState::Ok), "{states:?}");
}

/// A stage that yields to all others keeps the priority of its heartbeat: under load, it does not seem to hang.
#[test]
fn heartbeats_do_not_yield() {
    // `None` for a task that has ended.
    let niceness = |task: &str| {
        let stat = std::fs::read_to_string(format!("/proc/self/task/{task}/stat")).ok()?;
        // Field 19 of the line; the name of the thread, field 2, may contain spaces.
        stat.rsplit_once(')')?.1.split_whitespace().nth(16)?.parse::<i32>().ok()
    };
    let own = || std::fs::read_link("/proc/thread-self").unwrap().file_name().unwrap().to_str().unwrap().to_owned();
    let before = niceness(&own()).unwrap();
    let fixture = Fixture::new("nice");
    let _stage = fixture.context(Stage::Renderer);
    assert_eq!(niceness(&own()), Some(19));
    let tasks = std::fs::read_dir("/proc/self/task").unwrap().map(|task| task.unwrap());
    let name = |task: &std::fs::DirEntry| std::fs::read_to_string(task.path().join("comm")).unwrap_or_default();
    let beating: Vec<_> = tasks.filter(|task| name(task).trim() == "heartbeat").collect();
    assert!(!beating.is_empty());
    for task in beating {
        assert!(niceness(task.file_name().to_str().unwrap()).is_none_or(|nice| nice <= before));
    }
}

/// Health goes from starting to ok, with counts of received, skipped and invalid messages, while the stage's loop is
/// idle.
#[test]
fn heartbeats_tell_state_and_counts() {
    let fixture = Fixture::new("counts");
    let node = Node::open(&fixture.run, "test").unwrap();
    let mut health = node.receiver(topics::health(Stage::Forecaster)).unwrap();
    let mut posteriors = node.publisher(&topics::POSTERIOR).unwrap();

    let mut stage = fixture.context(Stage::Forecaster);
    let mut input = stage.input(&topics::POSTERIOR).unwrap();
    heartbeat(&mut health, |h| h.state() == Ok(HealthState::Starting));
    stage.ready();
    let ready = heartbeat(&mut health, |h| h.state() == Ok(HealthState::Ok));
    assert_eq!((ready.stage(), ready.pid), (Ok(Stage::Forecaster), std::process::id()));
    assert!(ready.rss_bytes > 0);

    for frame_id in 0..3 {
        let header = Header::of_frame(frame_id, 1, 1);
        posteriors
            .send(Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 })
            .unwrap();
    }
    let mut bad = Posterior {
        header: Header::of_frame(3, 1, 1),
        gaussian: Gaussian::standard(),
        take_start: 0,
        stage_latency_ns: 0,
    };
    bad.gaussian.log_variance[0] = f32::NAN;
    posteriors.send_unchecked(bad).unwrap();
    assert!(stage.wait(&[&input]).unwrap());
    let newest = input.newest().unwrap().unwrap().header;
    assert_eq!(newest.frame_id, 2);
    let slow_ns = monotonic_now_ns() - 1_000_000_000;
    assert!(stage.worked(&newest, slow_ns) >= 1_000_000_000);
    let counted = heartbeat(&mut health, |h| h.state() == Ok(HealthState::Slow));
    assert_eq!((counted.received, counted.skipped, counted.invalid, counted.header.frame_id), (3, 2, 1, 2));
    assert_eq!(counted.published, 0, "heartbeats do not count as work");
    stage.worked(&newest, monotonic_now_ns());
    heartbeat(&mut health, |h| h.state() == Ok(HealthState::Ok) && h.max_latency_ns >= 1_000_000_000);
}

/// The last heartbeat and the exit code show how a stage ended.
#[test]
fn the_end_is_told() {
    let fixture = Fixture::new("ends");
    let node = Node::open(&fixture.run, "test").unwrap();
    let mut health = node.receiver(topics::health(Stage::Prober)).unwrap();
    let code = run_with(Stage::Prober, fixture.args(), |stage| {
        stage.ready();
        // Without a connected receiver, the last heartbeat is lost.
        heartbeat(&mut health, |h| h.state() == Ok(HealthState::Ok));
        Ok(())
    });
    assert_eq!(code, ExitCode::SUCCESS);
    heartbeat(&mut health, |h| h.state() == Ok(HealthState::Done));
    let code = run_with(Stage::Prober, fixture.args(), |_| {
        heartbeat(&mut health, |h| h.state() == Ok(HealthState::Starting));
        anyhow::bail!("no weights")
    });
    assert_eq!(code, ExitCode::FAILURE);
    heartbeat(&mut health, |h| h.state() == Ok(HealthState::Faulty));
}

/// A stage whose launcher has ended does not start.
#[test]
fn without_its_launcher_a_stage_does_not_start() {
    let fixture = Fixture::new("orphan");
    let mut args = fixture.args();
    args.parent_pid = Some(u32::MAX);
    let code = run_with(Stage::Encoder, args, |_| Ok(()));
    assert_eq!(code, ExitCode::FAILURE);
}
