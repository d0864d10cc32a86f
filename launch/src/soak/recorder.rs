//! The recorders of a soak: one runs next to the graph all the time, and its last files are evidence; another one
//! writes to a disk that is too small.

use super::patience::Patience;
use anyhow::{Context, bail, ensure};
use carff_recording::Reader;
use carff_transport::TopicId;
use carff_transport::{Run, SHARED_MEMORY_DIR};
use rustix::process::{Pid, Signal};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

/// Longest time in which a recorder must start or end, milliseconds.
const LIMIT_MS: u64 = 30_000;
/// Seconds per file of the evidence recording.
const FILE_SECONDS: &str = "20";

/// Returns the folder of the small disk, within the soak's private shared memory.
pub(super) fn small_disk() -> PathBuf {
    Path::new(SHARED_MEMORY_DIR).join("soak-disk")
}

fn recorder(run: &Run, out: &Path) -> std::io::Result<Command> {
    let mut command = Command::new(std::env::current_exe()?.with_file_name("carff"));
    command.args(["record", "--run", run.name(), "--out"]).arg(out).stdin(Stdio::null()).stdout(Stdio::null());
    Ok(command)
}

fn recordings(folder: &Path) -> anyhow::Result<Vec<PathBuf>> {
    let entries = std::fs::read_dir(folder)?.flatten().map(|e| e.path());
    Ok(entries.filter(|p| p.extension().is_some_and(|e| e == "mcap")).collect())
}

/// Records the graph while it runs.
#[derive(Debug)]
pub(super) struct FlightRecorder {
    folder: tempfile::TempDir,
    child: Option<Child>,
}

impl FlightRecorder {
    pub(super) fn new() -> anyhow::Result<Self> {
        Ok(Self { folder: tempfile::tempdir()?, child: None })
    }

    /// Returns the files of the latest graph.
    pub(super) fn files(&self) -> anyhow::Result<Vec<PathBuf>> {
        recordings(self.folder.path())
    }

    /// Starts recording if it is not active; an earlier recording is removed.
    pub(super) fn keep_on(&mut self, run: &Run) -> anyhow::Result<()> {
        if let Some(child) = &mut self.child
            && child.try_wait()?.is_none()
        {
            return Ok(());
        }
        for file in self.files()? {
            std::fs::remove_file(file)?;
        }
        let log = std::fs::File::create(self.folder.path().join("recorder.log"))?;
        let mut command = recorder(run, &self.folder.path().join("run.mcap"))?;
        let child = command.args(["--file-seconds", FILE_SECONDS, "--keep", "2"]).stderr(log).spawn();
        let child = self.child.insert(child.context("cannot start a recorder")?);
        // The recorder creates its file when it has joined.
        let mut patience = Patience::of_ms(LIMIT_MS);
        while recordings(self.folder.path())?.is_empty() {
            if let Some(status) = child.try_wait()? {
                let output = std::fs::read_to_string(self.folder.path().join("recorder.log")).unwrap_or_default();
                bail!("the recorder ended at its start ({status}): {output}");
            }
            ensure!(
                !patience.ran_out(),
                "the recorder did not start within {LIMIT_MS} ms: end other programs, or use a faster machine"
            );
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }

    /// Ends the recorder, which completes its files.
    pub(super) fn end(&mut self) -> anyhow::Result<()> {
        let Some(mut child) = self.child.take() else { return Ok(()) };
        if let Some(pid) = Pid::from_raw(child.id() as i32) {
            let _ = rustix::process::kill_process(pid, Signal::INT);
        }
        let mut patience = Patience::of_ms(LIMIT_MS);
        while child.try_wait()?.is_none() {
            if patience.ran_out() {
                child.kill()?;
            }
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }
}

impl Drop for FlightRecorder {
    fn drop(&mut self) {
        let _ = self.end();
    }
}

/// A recorder whose disk is full within seconds.
#[derive(Debug)]
pub(super) struct Cramped {
    folder: PathBuf,
    child: Child,
}

impl Cramped {
    pub(super) fn start(run: &Run) -> anyhow::Result<Self> {
        let folder = small_disk().join("recording");
        std::fs::create_dir(&folder)?;
        let log = std::fs::File::create(small_disk().with_extension("log"))?;
        let mut command = recorder(run, &folder.join("run.mcap"))?;
        let topics = [TopicId::FRAME, TopicId::BELIEF, TopicId::VIEW].map(|topic| topic.to_string());
        let child = command.args(topics).stderr(log).spawn().context("cannot start a recorder")?;
        Ok(Self { folder, child })
    }

    /// Returns the exit status once it has ended.
    pub(super) fn ended(&mut self) -> anyhow::Result<Option<ExitStatus>> {
        Ok(self.child.try_wait()?)
    }

    /// Returns an error if the recorder did not report its full disk, or if its earlier data is not readable.
    pub(super) fn complaint(&self, status: ExitStatus) -> anyhow::Result<Option<String>> {
        let output = std::fs::read_to_string(small_disk().with_extension("log"))?;
        if status.code() != Some(1) || !output.contains("run.mcap") {
            return Ok(Some(format!("a recorder on a full disk ended with {status} and printed: {output}")));
        }
        let mut reader = Reader::open(&self.folder.join("run.mcap"))?;
        let mut messages = 0_u64;
        // The last message may be cut.
        while let Ok(Some(_)) = reader.next() {
            messages += 1;
        }
        Ok((messages == 0).then(|| "a recording on a full disk has no readable message".to_owned()))
    }
}

impl Drop for Cramped {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
        let _ = std::fs::remove_dir_all(&self.folder);
        let _ = std::fs::remove_file(small_disk().with_extension("log"));
    }
}
