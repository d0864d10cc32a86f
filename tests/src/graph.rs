//! A graph for one test: a unique run name, a folder, a graph file.

use crate::{Finished, Process, program};
use carff_messages::Stage;
use carff_transport::{Run, living_processes, remove_run_leftovers, runtime_dir};
use serde_json::Value;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::atomic::{AtomicU32, Ordering};

/// Run id of stages that a test starts by itself.
const RUN_ID: u64 = 7;

/// Settings under which the speed of the machine changes no decision: nothing becomes stale on a busy machine.
pub const PATIENT: &str = "[controller]\nrate_hz = 4.0\ndeadline_ms = 60000\n[launcher]\nstart_timeout_ms = 600000\n\
                           stop_timeout_ms = 30000\n";

/// [`PATIENT`], with drives that continue until the run is stopped.
pub const PATIENT_AND_ENDLESS: &str = "[camera]\nrepeat = true\n[controller]\nrate_hz = 4.0\ndeadline_ms = 60000\n\
                                       [launcher]\nstart_timeout_ms = 600000\nstop_timeout_ms = 30000\n";

/// Counts the decisions that a launcher has printed: each is one line.
pub fn decisions(text: &str) -> usize {
    text.lines().filter(|line| line.contains("hazard ") && line.trim_end().ends_with(" ms")).count()
}

/// A graph for one test. Dropping it removes leftovers of its run.
#[derive(Debug)]
pub struct TestGraph {
    folder: tempfile::TempDir,
    run: Run,
}

impl TestGraph {
    /// Writes the graph file: `[run]` with a unique name and these paths, then `rest`, which starts inside `[run]`.
    pub fn new(dataset: &Path, checkpoint: &Path, rest: &str) -> Self {
        static NEXT: AtomicU32 = AtomicU32::new(0);
        let name = format!("x{}-{}", std::process::id(), NEXT.fetch_add(1, Ordering::Relaxed));
        let folder = tempfile::tempdir().unwrap();
        let text = format!(
            "[run]\nname = \"{name}\"\ndataset = \"{}\"\ncheckpoint = \"{}\"\n{rest}\n",
            dataset.display(),
            checkpoint.display()
        );
        std::fs::write(folder.path().join("graph.toml"), text).unwrap();
        Self { folder, run: Run::new(&name, RUN_ID).unwrap() }
    }

    /// Returns its run, for tests that join the stages of [`Self::stage`].
    pub fn run(&self) -> &Run {
        &self.run
    }

    /// Returns a path in its folder.
    pub fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }

    /// Returns the path of the graph file.
    pub fn file(&self) -> PathBuf {
        self.path("graph.toml")
    }

    /// Returns the command `carff launch` on its graph file, or on another one under its run name.
    pub fn launch(&self, file: &Path, args: &[&str]) -> Command {
        // Also where the tests themselves run under `nohup`.
        let mut command = Command::new("env");
        command
            .current_dir(self.folder.path())
            .arg("--default-signal=HUP")
            .arg(program("carff"))
            .args(["launch", "--verbose"])
            .arg(file)
            .args(["--run", self.run.name()])
            .args(args);
        command
    }

    /// Runs `carff launch` on its graph file to the end.
    pub fn launch_to_end(&self, args: &[&str]) -> Finished {
        Process::start(&mut self.launch(&self.file(), args)).end()
    }

    /// Starts one stage by itself.
    pub fn stage(&self, stage: Stage) -> Process {
        let mut command = Command::new(program(&format!("carff-{stage}")));
        command.current_dir(self.folder.path()).arg("--graph").arg(self.file());
        Process::start(command.args(["--run", self.run.name(), "--run-id", &RUN_ID.to_string()]))
    }

    /// Returns the process of a stage of the launched run, found by its command line.
    pub fn stage_pid(&self, stage: Stage) -> Option<u32> {
        let wanted = format!("carff-{stage}");
        std::fs::read_dir("/proc").unwrap().flatten().find_map(|entry| {
            let pid: u32 = entry.file_name().to_str()?.parse().ok()?;
            let line = std::fs::read(entry.path().join("cmdline")).ok()?;
            let mut words = line.split(|&b| b == 0).map(String::from_utf8_lossy);
            let first = words.next()?;
            (Path::new(&*first).file_name()? == wanted.as_str() && words.any(|w| w == self.run.name())).then_some(pid)
        })
    }

    /// Returns the report of a launch with `--report report.json`.
    pub fn report(&self) -> Value {
        serde_json::from_str(&std::fs::read_to_string(self.path("report.json")).unwrap()).unwrap()
    }

    /// Fails if a process, a file in shared memory, the run's folder or its lock still exists.
    #[track_caller]
    pub fn assert_nothing_left(&self) {
        assert_eq!(living_processes(&self.run).unwrap(), Vec::<u32>::new());
        assert_eq!(self.run.shared_memory_files().unwrap(), Vec::<PathBuf>::new());
        assert!(!self.run.folder().exists(), "{} is left", self.run.folder().display());
        let lock = runtime_dir().join(format!("{}.run", self.run.name()));
        assert!(!lock.exists(), "{} is left", lock.display());
        for stage in Stage::ALL {
            assert_eq!(self.stage_pid(stage), None, "stage {stage} lives");
        }
    }
}

impl Drop for TestGraph {
    fn drop(&mut self) {
        // A failed test must not leave anything behind; a passed test has left nothing.
        let _ = remove_run_leftovers(&self.run);
    }
}
