//! The recorders of a soak: one that runs beside the graph all the time, whose last files are evidence, and one on a
//! disk that is too small.

use super::patience::Patience;
use anyhow::{Context, bail, ensure};
use carff_recording::Reader;
use carff_transport::TopicId;
use carff_transport::{Run, SHARED_MEMORY_DIR};
use rustix::process::{Pid, Signal};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

/// Longest time that a recorder may take to begin or to end, milliseconds.
const LIMIT_MS: u64 = 30_000;
/// Seconds in one file of the recording that is kept.
const FILE_SECONDS: &str = "20";

/// Folder of the small disk, within the soak's own shared memory.
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

/// Records the graph as long as it runs.
#[derive(Debug)]
pub(super) struct FlightRecorder {
    folder: tempfile::TempDir,
    child: Option<Child>,
}

impl FlightRecorder {
    pub(super) fn new() -> anyhow::Result<Self> {
        Ok(Self { folder: tempfile::tempdir()?, child: None })
    }

    /// The files, those of the latest graph alone.
    pub(super) fn files(&self) -> anyhow::Result<Vec<PathBuf>> {
        recordings(self.folder.path())
    }

    /// Begins, if it does not record already; what was recorded before goes.
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
        // It makes its file when it has joined.
        let mut patience = Patience::of_ms(LIMIT_MS);
        while recordings(self.folder.path())?.is_empty() {
            if let Some(status) = child.try_wait()? {
                let said = std::fs::read_to_string(self.folder.path().join("recorder.log")).unwrap_or_default();
                bail!("the recorder ended at its start ({status}): {said}");
            }
            ensure!(!patience.ran_out(), "the recorder did not begin within {LIMIT_MS} ms");
            std::thread::sleep(Duration::from_millis(5));
        }
        Ok(())
    }

    /// Ends it: its files are whole.
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

/// A recorder whose disk will be full in seconds.
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

    /// How it ended, once it has.
    pub(super) fn ended(&mut self) -> anyhow::Result<Option<ExitStatus>> {
        Ok(self.child.try_wait()?)
    }

    /// What is wrong with how it ended: it has to say that its disk is full, and what it wrote before has to be readable.
    pub(super) fn complaint(&self, status: ExitStatus) -> anyhow::Result<Option<String>> {
        let said = std::fs::read_to_string(small_disk().with_extension("log"))?;
        if status.code() != Some(1) || !said.contains("run.mcap") {
            return Ok(Some(format!("a recorder on a full disk ended with {status} and said: {said}")));
        }
        let mut reader = Reader::open(&self.folder.join("run.mcap"))?;
        let mut messages = 0_u64;
        // The last message may be cut.
        while let Ok(Some(_)) = reader.next() {
            messages += 1;
        }
        Ok((messages == 0).then(|| "nothing of a recording on a full disk is readable".to_owned()))
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
