//! `carff soak`: runs the real graph in real processes under a seeded schedule of faults, and checks its contract after
//! each.
//!
//! ```text
//! soak --starts--> carff launch --starts--> stages         signals: SIGKILL, SIGSTOP, SIGCONT, SIGINT
//!  | \--starts--> injector --lies--> topics; probes; a recorder
//!  \<------------- beliefs, actions, heartbeats --------- topics
//! ```

mod answer;
mod graph;
mod inflict;
mod inject;
mod judge;
mod patience;
mod recorder;
mod report;
mod schedule;
mod seen;
mod stand_in;
mod watch;

pub use inject::{InjectArgs, run as inject};
pub use schedule::{Fault, fault};

use crate::{NS_PER_MS, NS_PER_S};
use anyhow::{Context, ensure};
use carff_base::files::check_writable;
use carff_config::SoakConfig;
use carff_messages::Stage;
use carff_transport::{Node, Run, SHARED_MEMORY_DIR, Stop, Waiter, monotonic_now_ns};
use graph::{Graph, Holdings, resident_bytes};
use judge::Terms;
use patience::Patience;
use recorder::{FlightRecorder, small_disk};
use report::{Lives, Outcome};
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::{Command, ExitCode, Stdio};
use watch::{Notes, Watcher};

/// Size of the soak's private shared memory, so that filling it harms no other process.
const MEMORY_SIZE: &str = "size=256m";
/// Size of the disk that fills under a recorder.
const DISK_SIZE: &str = "size=4m";
/// Interval between two measurements of the processes' memory.
const MEMORY_PERIOD_NS: u64 = 5 * NS_PER_S;

/// Error of a fault that is inflicted before the first graph runs.
const NOT_WATCHED: &str = "no graph is watched: start one before a fault is inflicted";

/// Soak a graph.
#[derive(Clone, Debug, clap::Args)]
pub struct SoakArgs {
    /// The soak file, as in configs/soak.
    pub config: PathBuf,
    /// Duration, minutes.
    #[arg(long, default_value_t = 2.0)]
    pub minutes: f64,
    /// Stop after this number of faults, also before the time is over.
    #[arg(long)]
    pub faults: Option<u64>,
    /// Seed of the schedule.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// Write the result here, as JSON; evidence of a violation goes into a folder next to it.
    #[arg(long)]
    pub json: Option<PathBuf>,
    /// Dataset folder; replaces the graph file's.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Checkpoint folder; replaces the graph file's.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Set by the program itself once it has private shared memory.
    #[arg(long, hide = true)]
    pub own_memory: bool,
}

/// Soaks a graph; exit code 0 if the contract always held, 1 at the first violation, 130 on Ctrl-C.
pub fn run(args: &SoakArgs) -> anyhow::Result<ExitCode> {
    let config = SoakConfig::load(&args.config)?;
    args.json.as_deref().map_or(Ok(()), check_writable)?;
    ensure!(args.minutes > 0.0 && args.minutes.is_finite(), "--minutes is {}; it must be above 0", args.minutes);
    if !args.own_memory && (config.faults.full_memory > 0 || config.faults.full_disk > 0) {
        with_own_memory();
        carff::say("this system does not let users mount: full shared memory and full disks are not tested");
    }
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let graph = Graph::new(&config, args.dataset.as_deref(), args.checkpoint.as_deref(), args.seed)?;
    let terms = Terms::new(&graph.config, &graph.checkpoint, &config.contract)?;
    let mut soak = Soak {
        args,
        config: &config,
        graph,
        waiter: Waiter::new(stop),
        run: Run::new("unnamed", 0)?,
        watcher: None,
        recorder: FlightRecorder::new()?,
        notes: Notes::new(terms),
        baseline: None,
        outcome: Outcome::default(),
        lives: Lives::default(),
        memory_ns: 0,
    };
    let result = soak.drive();
    soak.watcher = None;
    soak.recorder.end()?;
    let stalled = soak.graph.end(Signal::TERM, config.contract.stop_ms)?.is_none();
    let interrupted = soak.waiter.stop().is_stopped();
    if stalled && !interrupted && soak.notes.violation.is_none() && result.is_ok() {
        soak.notes.violation = Some("the graph did not end on request".to_owned());
    }
    result?;
    soak.outcome.finish(&soak.notes, &soak.lives, &config.contract);
    if let Some(violation) = soak.notes.violation.take() {
        soak.outcome.violation = Some(violation);
        soak.keep_evidence()?;
    }
    let json = soak.outcome.json(args, &soak.notes);
    let text = serde_json::to_string_pretty(&json)? + "\n";
    match &args.json {
        Some(path) => {
            if let Some(folder) = path.parent().filter(|f| !f.as_os_str().is_empty()) {
                std::fs::create_dir_all(folder)?;
            }
            std::fs::write(path, &text).with_context(|| format!("cannot write {}", path.display()))?;
            println!("{}\nJSON: {}", soak.outcome.summary(), path.display());
        }
        None => print!("{text}"),
    }
    Ok(match (&soak.outcome.violation, interrupted) {
        (Some(_), _) => ExitCode::FAILURE,
        (None, true) => ExitCode::from(130),
        (None, false) => ExitCode::SUCCESS,
    })
}

/// Continues as a process with private shared memory. Returns if the system does not allow it.
fn with_own_memory() {
    let user = rustix::process::getuid();
    let enter = |command: &mut Command, what: &str| {
        command.arg("--mount").args(["sh", "-c"]).arg(format!(
            "mount -t tmpfs -o {MEMORY_SIZE} tmpfs {SHARED_MEMORY_DIR} && mkdir {disk} && \
                 mount -t tmpfs -o {DISK_SIZE} tmpfs {disk} && {what}",
            disk = small_disk().display()
        ));
    };
    let new = |what: &str| {
        let mut command = Command::new("unshare");
        if !user.is_root() {
            command.args(["--user", "--map-root-user"]);
        }
        enter(&mut command, what);
        command
    };
    let possible = new("true").stdout(Stdio::null()).stderr(Stdio::null()).status().is_ok_and(|s| s.success());
    let Ok(program) = std::env::current_exe() else { return };
    if possible {
        // Inside, switch back to this user: the run's folder is named after the user.
        let back = if user.is_root() { String::new() } else { format!("unshare --user --map-user={} ", user.as_raw()) };
        let error = new(&format!("exec {back}\"$@\""))
            .arg("sh")
            .arg(program)
            .args(std::env::args_os().skip(1))
            .arg("--own-memory")
            .exec();
        carff::say(&format!("cannot enter a private mount: {error}"));
    }
}

/// A running soak.
struct Soak<'a> {
    args: &'a SoakArgs,
    config: &'a SoakConfig,
    graph: Graph,
    waiter: Waiter,
    run: Run,
    watcher: Option<Watcher>,
    recorder: FlightRecorder,
    notes: Notes,
    /// System resources of the undisturbed graph.
    baseline: Option<Holdings>,
    outcome: Outcome,
    lives: Lives,
    memory_ns: u64,
}

impl Soak<'_> {
    /// Starts the graph and injects faults until the time is over, a violation occurs, or the user interrupts.
    fn drive(&mut self) -> anyhow::Result<()> {
        self.start_graph()?;
        let begun_ns = monotonic_now_ns();
        let end_ns = begun_ns + (self.args.minutes * 60e9) as u64;
        let mut number = 0;
        while monotonic_now_ns() < end_ns && self.args.faults.is_none_or(|most| number < most) && self.goes_on()? {
            let fault = fault(self.config, self.args.seed, number);
            number += 1;
            self.recorder.keep_on(&self.run)?;
            self.notes.calm = true;
            self.look_for(fault.pause_ms)?;
            self.notes.calm = false;
            if !self.goes_on()? || monotonic_now_ns() >= end_ns {
                break;
            }
            self.notes.note(fault.to_string());
            self.outcome.schedule.push(fault.to_string());
            let recovered = self.outcome.recoveries_ms.len();
            let inflicted = self.inflict(&fault)?;
            self.outcome.note_recoveries(fault.kind.name(), recovered);
            if inflicted {
                *self.outcome.faults.entry(fault.kind.name()).or_default() += 1;
            } else {
                *self.outcome.not_tried.entry(fault.kind.name()).or_default() += 1;
            }
        }
        self.outcome.seconds = (monotonic_now_ns() - begun_ns) as f64 / 1e9;
        Ok(())
    }

    /// Returns true if there is no violation and no interrupt, and the launcher is alive.
    fn goes_on(&mut self) -> anyhow::Result<bool> {
        if let Some(status) = self.graph.ended()? {
            self.violated(format!("the launcher ended by itself: {status}"));
        }
        Ok(self.notes.violation.is_none() && !self.waiter.stop().is_stopped())
    }

    fn violated(&mut self, what: String) {
        self.notes.violation.get_or_insert(what);
    }

    fn watcher(&mut self) -> anyhow::Result<&mut Watcher> {
        self.watcher.as_mut().context(NOT_WATCHED)
    }

    fn look(&mut self) -> anyhow::Result<()> {
        let watcher = self.watcher.as_mut().context(NOT_WATCHED)?;
        watcher.look(&mut self.notes)?;
        let now_ns = monotonic_now_ns();
        if now_ns >= self.memory_ns {
            self.memory_ns = now_ns + MEMORY_PERIOD_NS;
            let pids = watcher.health.iter().map(|(stage, health)| (stage.name(), health.pid));
            for (name, pid) in pids.chain(self.graph.pid().map(|pid| ("launcher", pid))) {
                if let Some(bytes) = resident_bytes(pid) {
                    self.lives.note(name, pid, now_ns, bytes);
                }
            }
        }
        Ok(())
    }

    fn look_for(&mut self, ms: u64) -> anyhow::Result<()> {
        let until_ns = monotonic_now_ns() + ms * NS_PER_MS;
        while monotonic_now_ns() < until_ns && self.notes.violation.is_none() && !self.waiter.stop().is_stopped() {
            self.look()?;
        }
        Ok(())
    }

    /// Polls until a condition holds; returns false after `limit_ms`, excluding times without a processor.
    fn look_until(
        &mut self,
        limit_ms: u64,
        mut holds: impl FnMut(&mut Self) -> anyhow::Result<bool>,
    ) -> anyhow::Result<bool> {
        let mut patience = Patience::of_ms(limit_ms);
        loop {
            if holds(self)? {
                return Ok(true);
            }
            if patience.ran_out() || self.waiter.stop().is_stopped() {
                return Ok(false);
            }
            self.look()?;
        }
    }

    fn start_graph(&mut self) -> anyhow::Result<()> {
        self.run = self.graph.start()?;
        let node = Node::open(&self.run, "soak")?;
        self.watcher = Some(Watcher::open(node, self.waiter.clone())?);
        self.notes.judge.restarted(monotonic_now_ns() + NS_PER_S);
        let start_ms = self.graph.config.launcher.start_timeout_ms;
        let up = self.look_until(start_ms, |soak| {
            let watcher = soak.watcher()?;
            Ok(watcher.all_well(0, None) && watcher.decided_ns > 0 || soak.graph.ended()?.is_some())
        })?;
        if !up && !self.waiter.stop().is_stopped() {
            self.violated(format!("the graph was not up within {start_ms} ms of its start"));
        }
        if self.goes_on()? {
            self.recorder.keep_on(&self.run)?;
        }
        if self.baseline.is_none() && self.goes_on()? {
            // The renderer's first views, and other late messages.
            self.look_for(3000)?;
            self.baseline = Some(self.holdings()?);
        }
        Ok(())
    }

    fn pids(&self) -> BTreeMap<Stage, u32> {
        self.watcher.iter().flat_map(|w| &w.health).map(|(stage, health)| (*stage, health.pid)).collect()
    }

    fn holdings(&self) -> anyhow::Result<Holdings> {
        self.graph.holdings(&self.run, &self.pids())
    }

    /// Stores log, latest messages, recording and schedule in a folder next to the JSON file.
    fn keep_evidence(&mut self) -> anyhow::Result<()> {
        let folder = self.args.json.as_deref().unwrap_or(Path::new("soak.json")).with_extension("evidence");
        std::fs::create_dir_all(&folder)?;
        let text =
            |lines: &mut dyn Iterator<Item = &String>| lines.fold(String::new(), |text, line| text + line + "\n");
        std::fs::write(folder.join("messages.txt"), text(&mut self.notes.evidence.iter()))?;
        std::fs::write(folder.join("schedule.txt"), text(&mut self.outcome.schedule.iter()))?;
        std::fs::copy(self.graph.log(), folder.join("launcher.log"))?;
        for file in self.recorder.files()? {
            std::fs::copy(&file, folder.join(file.file_name().context("a recording without a name")?))?;
        }
        self.outcome.evidence = Some(folder.display().to_string());
        Ok(())
    }
}
