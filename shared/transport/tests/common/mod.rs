//! Fixtures of the transport's tests: unique runs, messages, and children with a watchdog.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_messages::{DatasetView, FrameMeta, Gaussian, Header, Intrinsics, Posterior};
use carff_transport::{Run, monotonic_now_ns, remove_run_leftovers};
use std::process::{Child, Command, Stdio};
use std::sync::atomic::{AtomicU32, Ordering};

/// A unique run; its files are removed at the end, even if the test fails.
pub struct TestRun(pub Run);

impl TestRun {
    pub fn new() -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("t{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        Self(Run::new(&name, 77).unwrap())
    }
}

impl Drop for TestRun {
    fn drop(&mut self) {
        let _ = remove_run_leftovers(&self.0);
    }
}

/// Returns the time in `seconds` seconds on the monotonic clock: a watchdog, never an assertion about speed.
pub fn in_seconds(seconds: u64) -> u64 {
    monotonic_now_ns() + seconds * 1_000_000_000
}

pub fn posterior(frame_id: u64) -> Posterior {
    let mut gaussian = Gaussian::standard();
    gaussian.mean[0] = frame_id as f32;
    Posterior { header: Header::of_frame(frame_id, 1, 2), gaussian, take_start: 0, stage_latency_ns: 3 }
}

pub fn frame(frame_id: u64, width_px: u32, height_px: u32) -> FrameMeta {
    FrameMeta {
        header: Header::of_frame(frame_id, 1, 2),
        width_px,
        height_px,
        intrinsics: Intrinsics { fl_x_px: 1.0, fl_y_px: 1.0, cx_px: 0.0, cy_px: 0.0 },
        world_from_camera: [0.0; 16],
        dataset_view: DatasetView::UNKNOWN,
        take_start: 0,
    }
}

/// This test program as another process that plays a role in a run.
pub struct Role(pub Child);

impl Role {
    pub fn start(role: &str, run: &Run) -> Self {
        let child = Command::new(std::env::current_exe().unwrap())
            .args(["--exact", "processes::role", "--nocapture", "--test-threads=1"])
            .env("CARFF_TEST_ROLE", role)
            .env("CARFF_TEST_RUN", run.name())
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .stderr(Stdio::inherit())
            .spawn()
            .unwrap();
        Self(child)
    }

    pub fn kill(&mut self) {
        self.0.kill().unwrap();
        self.0.wait().unwrap();
    }

    pub fn signal(&self, signal: rustix::process::Signal) {
        let pid = rustix::process::Pid::from_raw(self.0.id() as i32).unwrap();
        rustix::process::kill_process(pid, signal).unwrap();
    }
}

impl Drop for Role {
    fn drop(&mut self) {
        let _ = self.0.kill();
        let _ = self.0.wait();
    }
}

/// Returns the role of this process, if it has one.
pub fn role() -> Option<(String, Run)> {
    let role = std::env::var("CARFF_TEST_ROLE").ok()?;
    let run = std::env::var("CARFF_TEST_RUN").ok()?;
    Some((role, Run::new(&run, 77).unwrap()))
}
