//! The graph under test: its launcher's process, its folder, and its system resources.

use super::patience::Patience;
use anyhow::{Context, bail, ensure};
use carff_config::{GraphConfig, LogLevel, RestartPolicy, SoakConfig};
use carff_messages::Stage;
use carff_observe::RunRecord;
use carff_transport::{Run, living_processes, runtime_dir};
use rustix::process::{Pid, PidfdFlags, Signal, pidfd_open, pidfd_send_signal};
use std::collections::BTreeMap;
use std::os::fd::OwnedFd;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};
use std::time::Duration;

/// Number of frames in the launcher's report: the report is not read, and memory is measured.
const KEEP_FRAMES: u64 = 300;

/// A graph that the soak starts and stops.
pub(super) struct Graph {
    folder: tempfile::TempDir,
    pub(super) config: GraphConfig,
    pub(super) checkpoint: PathBuf,
    name: String,
    launcher: Option<Child>,
}

/// System resources of a process tree.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Holdings {
    /// Number of the run's files in shared memory.
    pub(super) files: usize,
    /// Number of open descriptors by process.
    pub(super) descriptors: BTreeMap<&'static str, usize>,
}

impl Holdings {
    /// Returns the number of resources above a baseline.
    pub(super) fn excess(&self, baseline: &Self) -> usize {
        let of = |name: &str| baseline.descriptors.get(name).copied().unwrap_or(0);
        let descriptors: usize = self.descriptors.iter().map(|(name, n)| n.saturating_sub(of(name))).sum();
        self.files.saturating_sub(baseline.files) + descriptors
    }
}

impl Graph {
    /// Writes the graph file, and copies the checkpoint, because faults may damage it.
    pub(super) fn new(
        soak: &SoakConfig,
        dataset: Option<&Path>,
        checkpoint: Option<&Path>,
        seed: u64,
    ) -> anyhow::Result<Self> {
        let mut config = GraphConfig::load(&soak.graph)?;
        let dataset = config.resolve(dataset.unwrap_or(&config.run.dataset));
        ensure!(
            dataset.is_dir(),
            "dataset {} is missing: `carff launch` renders it, or pass --dataset",
            dataset.display()
        );
        let trained = config.resolve(checkpoint.unwrap_or(&config.run.checkpoint));
        let folder = tempfile::tempdir()?;
        let checkpoint = folder.path().join("checkpoint");
        std::fs::create_dir(&checkpoint)?;
        let entries = std::fs::read_dir(&trained).with_context(|| format!("no checkpoint in {}", trained.display()))?;
        for entry in entries.flatten().filter(|e| e.path().is_file()) {
            std::fs::copy(entry.path(), checkpoint.join(entry.file_name()))?;
        }
        let name = format!("soak-{}", std::process::id());
        config.run.name.clone_from(&name);
        (config.run.seed, config.run.scenario) = (seed, None);
        // A link, so that the camera can lose its images without harm to them.
        let images = folder.path().join("dataset");
        std::os::unix::fs::symlink(std::path::absolute(dataset)?, &images)?;
        (config.run.dataset, config.run.checkpoint) = (images, checkpoint.clone());
        config.camera.repeat = true;
        config.launcher.keep_frames = KEEP_FRAMES;
        // A soak kills more often than any policy for the road allows.
        let often = RestartPolicy::OnFailure { backoff_ms: 50, max_restarts: 1000, within_s: 60 };
        for stage in Stage::ALL {
            let process = config.stages.of_mut(stage);
            (process.restart, process.log) = (often, LogLevel::Warn);
        }
        let graph = Self { folder, config, checkpoint, name, launcher: None };
        std::fs::write(graph.file(), toml::to_string(&graph.config)?)?;
        Ok(graph)
    }

    /// Takes the images from the camera, or gives them back.
    pub(super) fn unplug(&self, unplugged: bool) -> anyhow::Result<()> {
        let (plugged, aside) = (self.folder.path().join("dataset"), self.folder.path().join("unplugged"));
        let (from, to) = if unplugged { (&plugged, &aside) } else { (&aside, &plugged) };
        std::fs::rename(from, to).context("cannot move the link to the dataset")
    }

    fn file(&self) -> PathBuf {
        self.folder.path().join("graph.toml")
    }

    /// Returns the log of the launcher and the stages.
    pub(super) fn log(&self) -> PathBuf {
        self.folder.path().join("launcher.log")
    }

    pub(super) fn pid(&self) -> Option<u32> {
        self.launcher.as_ref().map(Child::id)
    }

    /// Starts the graph, and returns once its run can be joined.
    pub(super) fn start(&mut self) -> anyhow::Result<Run> {
        let log = std::fs::File::options().create(true).append(true).open(self.log())?;
        let mut child = Command::new(std::env::current_exe()?)
            .arg("launch")
            .arg(self.file())
            .stdin(Stdio::null())
            .stdout(log.try_clone()?)
            .stderr(log)
            .spawn()
            .context("cannot start the launcher")?;
        let mut patience = Patience::of_ms(self.config.launcher.start_timeout_ms);
        let named = Run::new(&self.name, 0)?;
        loop {
            if let Some(status) = child.try_wait()? {
                bail!("the launcher ended at its start ({status}): see its log");
            }
            let record = std::fs::read(runtime_dir().join(format!("{}.run", self.name)));
            let record = record.ok().and_then(|bytes| RunRecord::from_bytes(&bytes)).filter(|r| r.pid == child.id());
            // The launcher has removed old leftovers by the time its own node is alive.
            if let Some(record) = record
                && living_processes(&named).is_ok_and(|living| living.contains(&child.id()))
            {
                self.launcher = Some(child);
                return Ok(Run::new(&self.name, record.run_id)?);
            }
            if patience.ran_out() {
                let _ = child.kill();
                let _ = child.wait();
                bail!(
                    "the launcher was not up within {} ms: raise `launcher.start_timeout_ms`, or end other programs",
                    self.config.launcher.start_timeout_ms
                );
            }
            std::thread::sleep(Duration::from_millis(10));
        }
    }

    /// Returns the exit status if the launcher has ended by itself.
    pub(super) fn ended(&mut self) -> anyhow::Result<Option<ExitStatus>> {
        match &mut self.launcher {
            Some(launcher) => Ok(launcher.try_wait()?),
            None => Ok(None),
        }
    }

    /// Ends the launcher by a signal and waits `limit_ms` at most; then waits for its stages.
    pub(super) fn end(&mut self, signal: Signal, limit_ms: u64) -> anyhow::Result<Option<ExitStatus>> {
        let Some(mut launcher) = self.launcher.take() else { return Ok(None) };
        if let Some(pid) = Pid::from_raw(launcher.id() as i32) {
            let _ = rustix::process::kill_process(pid, signal);
        }
        let mut patience = Patience::of_ms(limit_ms);
        let mut status = None;
        let run = Run::new(&self.name, 0)?;
        loop {
            status = status.or(launcher.try_wait()?);
            let alone = !run.folder().is_dir() || living_processes(&run)?.is_empty();
            if status.is_some() && alone {
                return Ok(status);
            }
            if patience.ran_out() {
                let _ = launcher.kill();
                let _ = launcher.wait();
                return Ok(None);
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }

    /// Returns the files that a stopped graph has left: shared memory, the run's folder, its lock.
    pub(super) fn leftovers(&self) -> anyhow::Result<Vec<PathBuf>> {
        let run = Run::new(&self.name, 0)?;
        let mut left = run.shared_memory_files()?;
        left.extend(
            [run.folder(), runtime_dir().join(format!("{}.run", self.name))].into_iter().filter(|p| p.exists()),
        );
        Ok(left)
    }

    /// Returns its current resources; the processes are those of the latest heartbeats.
    pub(super) fn holdings(&self, run: &Run, pids: &BTreeMap<Stage, u32>) -> anyhow::Result<Holdings> {
        let mut descriptors: BTreeMap<&'static str, usize> = BTreeMap::new();
        let count = |pid: u32| std::fs::read_dir(format!("/proc/{pid}/fd")).map(Iterator::count);
        for (stage, &pid) in pids {
            descriptors.insert(stage.name(), count(pid)?);
        }
        if let Some(pid) = self.pid() {
            descriptors.insert("launcher", count(pid)?);
        }
        Ok(Holdings { files: run.shared_memory_files()?.len(), descriptors })
    }
}

impl Drop for Graph {
    fn drop(&mut self) {
        let _ = self.end(Signal::TERM, 5000);
        if let Ok(run) = Run::new(&self.name, 0) {
            let _ = carff_transport::remove_run_leftovers(&run);
        }
    }
}

/// A handle of a process that stays valid if the system reuses the process number.
pub(super) struct Victim {
    handle: OwnedFd,
}

impl Victim {
    /// Returns the process of a number, if it is alive.
    pub(super) fn new(pid: u32) -> anyhow::Result<Self> {
        let pid = Pid::from_raw(pid as i32).context("no process has the number 0")?;
        Ok(Self { handle: pidfd_open(pid, PidfdFlags::empty())? })
    }

    /// Sends a signal; returns false if the process has ended.
    pub(super) fn signal(&self, signal: Signal) -> bool {
        pidfd_send_signal(&self.handle, signal).is_ok()
    }
}

/// Returns the resident memory of a process, bytes.
pub(super) fn resident_bytes(pid: u32) -> Option<u64> {
    let text = std::fs::read_to_string(format!("/proc/{pid}/statm")).ok()?;
    let pages: u64 = text.split_whitespace().nth(1)?.parse().ok()?;
    Some(pages * rustix::param::page_size() as u64)
}
