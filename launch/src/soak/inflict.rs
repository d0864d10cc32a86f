//! Injects the faults of a soak, and waits until the graph has recovered.

use super::{
    DISK_SIZE, Soak,
    answer::Answer,
    graph::{Holdings, Victim},
    patience::Patience,
    recorder::Cramped,
    schedule::Fault,
    stand_in,
};
use crate::NS_PER_MS;
use anyhow::{Context, ensure};
use carff_config::{CameraSource, FaultKind};
use carff_messages::{ImageCondition, Stage};
use carff_transport::{INTERRUPTED, SHARED_MEMORY_DIR, monotonic_now_ns};
use carff_unknown::Known;
use rustix::process::Signal;
use std::collections::BTreeMap;
use std::io::{BufRead, BufReader, Read, Write};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitStatus, Stdio};

/// Times for which a slowed process alternately stops and runs, milliseconds.
const SLOW_MS: (u64, u64) = (40, 20);
/// Time for which the camera is stopped so that frames are dropped, in frames.
const DROPPED_FRAMES: f64 = 4.0;
/// Time after a recovery from which the times of actions count again.
const SETTLE_NS: u64 = 200_000_000;
/// Longest run time of an injector.
const INJECTOR_MS: u64 = 60_000;

impl Soak<'_> {
    /// Injects one fault and checks the contract after it. Returns false if the fault is not possible here.
    pub(super) fn inflict(&mut self, fault: &Fault) -> anyhow::Result<bool> {
        let pids = self.pids();
        match fault.kind {
            FaultKind::Kill => {
                let pid = self.pid_of(fault, &pids)?;
                self.kill(fault.target, pid);
                self.recover(Some(pid))?;
            }
            FaultKind::Stop => self.hold_still(fault, &pids, fault.hold_ms)?,
            FaultKind::Drop => {
                let hold_ms = (DROPPED_FRAMES * 1000.0 / self.graph.config.run.frame_rate_hz) as u64;
                self.hold_still(&Fault { target: Some(Stage::Camera), ..*fault }, &pids, hold_ms)?;
            }
            FaultKind::Stall => {
                self.hold_still(&Fault { target: Some(Stage::Camera), ..*fault }, &pids, fault.hold_ms)?;
            }
            FaultKind::Slow => {
                let victim = Victim::new(self.pid_of(fault, &pids)?)?;
                self.excuse(fault.target, fault.hold_ms);
                for _ in 0..fault.hold_ms.div_ceil(SLOW_MS.0 + SLOW_MS.1) {
                    victim.signal(Signal::STOP);
                    self.look_for(SLOW_MS.0)?;
                    victim.signal(Signal::CONT);
                    self.look_for(SLOW_MS.1)?;
                }
                self.recover(None)?;
            }
            FaultKind::Nan | FaultKind::Garbage | FaultKind::Schema | FaultKind::ForeignRun => self.lie(fault)?,
            FaultKind::DeviceLoss => {
                if self.graph.config.camera.source != CameraSource::Drives {
                    return Ok(false);
                }
                self.lose_device(fault, &pids)?;
            }
            FaultKind::Burst
            | FaultKind::Late
            | FaultKind::Duplicate
            | FaultKind::Reorder
            | FaultKind::Resolution
            | FaultKind::Corrupt => {
                self.injector(fault.kind.name(), fault)?;
                self.recover(None)?;
            }
            FaultKind::Black
            | FaultKind::White
            | FaultKind::Frozen
            | FaultKind::Covered
            | FaultKind::Unfocused
            | FaultKind::Underexposed
            | FaultKind::Overexposed
            | FaultKind::ClockStall
            | FaultKind::ClockJump => {
                let Some(condition) = stand_in::condition(fault.kind).filter(|&c| self.names(c)) else {
                    return Ok(false);
                };
                self.stand_in(fault, condition, &pids)?;
            }
            FaultKind::ProbeStorm => self.storm(fault)?,
            FaultKind::FullMemory => {
                if !self.args.own_memory {
                    return Ok(false);
                }
                let filler = Filler::fill()?;
                self.look_for(fault.hold_ms)?;
                drop(filler);
                self.recover(None)?;
            }
            FaultKind::FullDisk => {
                if !self.args.own_memory {
                    return Ok(false);
                }
                self.fill_disk()?;
            }
            FaultKind::Checkpoint => self.damage_checkpoint(fault, &pids)?,
            FaultKind::StartStop => self.cycle(Signal::INT)?,
            FaultKind::KillLauncher => self.cycle(Signal::KILL)?,
        }
        Ok(true)
    }

    /// Stops a process for a time, and continues it.
    fn hold_still(&mut self, fault: &Fault, pids: &BTreeMap<Stage, u32>, hold_ms: u64) -> anyhow::Result<()> {
        let victim = Victim::new(self.pid_of(fault, pids)?)?;
        self.excuse(fault.target, hold_ms);
        victim.signal(Signal::STOP);
        self.look_for(hold_ms)?;
        victim.signal(Signal::CONT);
        self.recover(None)
    }

    fn pid_of(&self, fault: &Fault, pids: &BTreeMap<Stage, u32>) -> anyhow::Result<u32> {
        match fault.target {
            Some(stage) => pids.get(&stage).copied().with_context(|| format!("stage {stage} never sent a heartbeat")),
            None => self.graph.pid().context("the launcher is not running"),
        }
    }

    fn kill(&mut self, target: Option<Stage>, pid: u32) {
        self.excuse(target, self.config.contract.recovery_ms);
        if Victim::new(pid).is_ok_and(|victim| victim.signal(Signal::KILL)) {
            self.outcome.kills += 1;
        }
    }

    /// Excludes faults on the controller itself from the checks of its actions' times.
    fn excuse(&mut self, target: Option<Stage>, ms: u64) {
        if target == Some(Stage::Controller) {
            self.notes.judge.excuse(monotonic_now_ns() + (ms + 1000) * NS_PER_MS);
        }
    }

    /// Waits until all stages are ok, a new decision has been made, and the graph uses no more resources than before
    /// the fault.
    fn recover(&mut self, killed: Option<u32>) -> anyhow::Result<()> {
        let limit_ms = self.config.contract.recovery_ms;
        let begun_ns = monotonic_now_ns();
        let stalled_ns = self.watcher()?.stalled_ns;
        let mut well_ns = None;
        let recovered = self.look_until(limit_ms, |soak| {
            let watcher = soak.watcher()?;
            if well_ns.is_none() && watcher.all_well(begun_ns, killed) {
                well_ns = Some(monotonic_now_ns());
            }
            Ok(well_ns.is_some_and(|at_ns| watcher.decided_ns > at_ns) || soak.notes.violation.is_some())
        })?;
        let took_ns = monotonic_now_ns() - begun_ns;
        let took_ns = took_ns.saturating_sub(self.watcher()?.stalled_ns - stalled_ns);
        if !recovered && !self.waiter.stop().is_stopped() {
            let states: Vec<String> = self.watcher()?.health.values().map(|h| format!("{h:?}")).collect();
            self.violated(format!("no recovery within {limit_ms} ms: {}", states.join("\n")));
        }
        self.outcome.recoveries_ms.push(took_ns as f64 / 1e6);
        self.notes.judge.excuse_no_more(monotonic_now_ns() + SETTLE_NS);
        // Leftovers of dead processes are removed soon after.
        let Some(baseline) = self.baseline.clone() else { return Ok(()) };
        let mut found = Holdings::default();
        let back = self.look_until(limit_ms, |soak| {
            // A process may end between two checks; the next check decides.
            found = soak.holdings().unwrap_or_default();
            Ok(!found.descriptors.is_empty() && found.excess(&baseline) == 0 || soak.notes.violation.is_some())
        })?;
        if !back && !self.waiter.stop().is_stopped() {
            self.outcome.leaked_files = found.excess(&baseline);
            self.violated(format!("the graph uses more resources than before: {found:?}, at first {baseline:?}"));
        }
        Ok(())
    }

    /// Injects rogue messages: none may reach an action, and the controller must count each rogue belief.
    fn lie(&mut self, fault: &Fault) -> anyhow::Result<()> {
        let controller = |soak: &mut Self| -> anyhow::Result<(u32, u64)> {
            let health = soak.watcher()?.health.get(&Stage::Controller).context("the controller sent no heartbeat")?;
            Ok((health.pid, health.invalid))
        };
        let (pid, before) = controller(self)?;
        let sent: u64 =
            self.injector(fault.kind.name(), fault)?.trim().parse().context("the injector printed no count")?;
        let mut counted = (pid, before);
        let all = self.look_until(self.config.contract.recovery_ms, |soak| {
            counted = controller(soak)?;
            Ok(counted.0 != pid || counted.1 >= before + sent || soak.notes.violation.is_some())
        })?;
        if counted.0 == pid && (!all || counted.1 != before + sent) && self.notes.violation.is_none() {
            let found = counted.1 - before;
            self.violated(format!("the controller counted {found} of {sent} invalid beliefs"));
        }
        self.recover(None)
    }

    fn helper(&self, what: &str, count: u32, seed: u64) -> anyhow::Result<Child> {
        Command::new(std::env::current_exe()?)
            .args([
                "soak-inject",
                self.run.name(),
                &self.run.id().to_string(),
                what,
                &count.to_string(),
                &seed.to_string(),
            ])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .context("cannot start an injector")
    }

    /// Runs an injector; returns its output.
    fn injector(&mut self, what: &str, fault: &Fault) -> anyhow::Result<String> {
        let mut child = self.helper(what, fault.count, fault.seed)?;
        let status = self.ended(&mut child)?;
        ensure!(status.success(), "the injector of `{what}` failed: {status}");
        let mut said = String::new();
        child.stdout.take().context("the injector has no output")?.read_to_string(&mut said)?;
        Ok(said)
    }

    /// Waits for the end of an injector.
    fn ended(&mut self, child: &mut Child) -> anyhow::Result<ExitStatus> {
        let mut patience = Patience::of_ms(INJECTOR_MS);
        loop {
            if let Some(status) = child.try_wait()? {
                return Ok(status);
            }
            if patience.ran_out() {
                child.kill()?;
            }
            self.look()?;
        }
    }

    /// Returns the first line of an injector; empty if it ended without one.
    fn first_line(&mut self, child: &mut Child) -> anyhow::Result<String> {
        let mut line = String::new();
        let mut stdout = BufReader::new(child.stdout.take().context("the injector has no output")?);
        let said = std::thread::spawn(move || stdout.read_line(&mut line).map(|_| line));
        while !said.is_finished() {
            self.look()?;
        }
        Ok(said.join().ok().and_then(Result::ok).unwrap_or_default())
    }

    /// Returns true if the encoder of the graph can name a condition.
    fn names(&self, condition: ImageCondition) -> bool {
        use ImageCondition::{Black, Clock, Frozen, White};
        let config = &self.graph.config;
        config.checks.camera
            && match condition {
                Black | White | Clock => true,
                Frozen => config.camera.has_noise(),
                _ => Known::load(&self.graph.checkpoint).is_ok_and(|known| known.is_some()),
            }
    }

    /// Lets an injector with bad images stand in for the camera. The safe action must come in time, with the condition
    /// as its reason, and end with the fault.
    fn stand_in(
        &mut self,
        fault: &Fault,
        condition: ImageCondition,
        pids: &BTreeMap<Stage, u32>,
    ) -> anyhow::Result<()> {
        let config = &self.graph.config;
        let (period_ns, frozen_ns) = ((1e9 / config.run.frame_rate_hz) as u64, config.checks.frozen_ms * NS_PER_MS);
        // The launcher would replace a camera that stands still for longer.
        let hold_ms = fault.hold_ms.min(config.launcher.hang_timeout_ms / 2);
        let mut injector = self.helper(fault.kind.name(), fault.count, fault.seed)?;
        let first = self.first_line(&mut injector)?;
        let first = first.trim().parse().with_context(|| format!("the injector of `{}` failed", fault.kind.name()))?;
        let answer = Answer::new(condition, first, frozen_ns);
        let limit_ms = answer.limit_ns(period_ns) / NS_PER_MS + self.config.contract.slack_ms;
        self.notes.answer = Some(answer);
        let begun_ns = monotonic_now_ns();
        injector.stdin.take().context("the injector has no input")?.write_all(b"\n")?;
        let camera = pids.get(&Stage::Camera).copied();
        let is_replaced = |soak: &Self| soak.pids().get(&Stage::Camera).copied() != camera;
        self.look_until(limit_ms, |soak| {
            let is_answered = soak.notes.answer.as_ref().is_some_and(|answer| answer.frames.is_some());
            Ok(is_answered || is_replaced(soak) || soak.notes.violation.is_some())
        })?;
        let answer = self.notes.answer.take();
        match answer.and_then(|answer| answer.frames) {
            Some(frames) => {
                let worst = self.outcome.worst_answers_frames.entry(fault.kind.name()).or_default();
                *worst = frames.max(*worst);
            }
            None if !is_replaced(self) && !self.waiter.stop().is_stopped() => {
                self.violated(format!("no safe action for `{condition}` within {limit_ms} ms"));
            }
            None => {}
        }
        self.look_for(hold_ms.saturating_sub((monotonic_now_ns() - begun_ns) / NS_PER_MS))?;
        Victim::new(injector.id())?.signal(Signal::TERM);
        let status = self.ended(&mut injector)?;
        let is_stopped = status.code() == Some(INTERRUPTED.into());
        ensure!(is_stopped, "the injector of `{}` failed: {status}", fault.kind.name());
        self.recover(None)
    }

    /// Attaches probes; half of them detach, the others are killed while they hold a frame.
    fn storm(&mut self, fault: &Fault) -> anyhow::Result<()> {
        let mut probes = Vec::new();
        // As many as fit in addition to the graph's own subscribers, the soak and its recorder.
        for i in 0..fault.count.min(3) {
            let mut probe = self.helper("probe", i, 0)?;
            ensure!(self.first_line(&mut probe)? == "ready\n", "a probe could not attach");
            probes.push(probe);
        }
        self.look_for(fault.hold_ms)?;
        for (i, probe) in probes.iter_mut().enumerate() {
            let signal = if i % 2 == 0 { Signal::KILL } else { Signal::TERM };
            Victim::new(probe.id())?.signal(signal);
            probe.wait()?;
        }
        self.recover(None)
    }

    /// Fills a second recorder's disk: the recorder reports it and keeps its data, and no other process is affected.
    fn fill_disk(&mut self) -> anyhow::Result<()> {
        let mut cramped = Cramped::start(&self.run)?;
        let mut status = None;
        let full = self.look_until(INJECTOR_MS, |soak| {
            status = cramped.ended()?;
            Ok(status.is_some() || soak.notes.violation.is_some())
        })?;
        match status {
            Some(status) => {
                if let Some(complaint) = cramped.complaint(status)? {
                    self.violated(complaint);
                }
            }
            None if !full && !self.waiter.stop().is_stopped() => {
                self.violated(format!("a recorder did not fill a disk of {DISK_SIZE} within {INJECTOR_MS} ms"));
            }
            None => {}
        }
        drop(cramped);
        self.recover(None)
    }

    /// Cuts a stage's weights in half and kills the stage: it cannot return until they are restored.
    fn damage_checkpoint(&mut self, fault: &Fault, pids: &BTreeMap<Stage, u32>) -> anyhow::Result<()> {
        let (stage, file) = match fault.seed % 3 {
            0 => (Stage::Encoder, carff_checkpoint::files::ENCODER),
            1 => (Stage::Forecaster, carff_checkpoint::files::MIXTURE),
            _ => (Stage::Prober, carff_checkpoint::files::FIELD),
        };
        let path = self.graph.checkpoint.join(file);
        let good = std::fs::read(&path)?;
        write_whole(&path, &good[..good.len() / 2])?;
        let pid = pids.get(&stage).copied().context("the stage never sent a heartbeat")?;
        self.kill(Some(stage), pid);
        self.look_for(fault.hold_ms)?;
        write_whole(&path, &good)?;
        self.recover(Some(pid))
    }

    /// Kills the camera and takes its images: it cannot return until they are back.
    fn lose_device(&mut self, fault: &Fault, pids: &BTreeMap<Stage, u32>) -> anyhow::Result<()> {
        let pid = pids.get(&Stage::Camera).copied().context("the camera never sent a heartbeat")?;
        self.graph.unplug(true)?;
        self.kill(Some(Stage::Camera), pid);
        self.look_for(fault.hold_ms)?;
        self.graph.unplug(false)?;
        self.recover(Some(pid))
    }

    /// Ends the graph and starts it again: it may leave nothing behind.
    fn cycle(&mut self, signal: Signal) -> anyhow::Result<()> {
        let limit_ms = self.config.contract.stop_ms;
        // The watcher's and the recorder's files do not belong to the graph.
        self.watcher = None;
        self.recorder.end()?;
        let status = self.graph.end(signal, limit_ms)?;
        match (signal, status.and_then(|s| s.code())) {
            _ if status.is_none() => self.violated(format!("the graph did not end within {limit_ms} ms")),
            (Signal::INT, Some(130)) => {
                let left = self.graph.leftovers()?;
                if !left.is_empty() {
                    self.outcome.leaked_files += left.len();
                    self.violated(format!("a stopped graph left {left:?}"));
                }
            }
            (Signal::INT, code) => self.violated(format!("an interrupted graph ended with exit code {code:?}")),
            // The next launcher removes the leftovers of a killed one.
            _ => {}
        }
        if self.notes.violation.is_some() || self.waiter.stop().is_stopped() {
            return Ok(());
        }
        let begun_ns = monotonic_now_ns();
        self.start_graph()?;
        self.outcome.cycles += 1;
        self.outcome.worst_start_ms = self.outcome.worst_start_ms.max((monotonic_now_ns() - begun_ns) as f64 / 1e6);
        self.recover(None)
    }
}

/// Replaces a file atomically: no reader sees a part of it.
fn write_whole(path: &Path, bytes: &[u8]) -> anyhow::Result<()> {
    let partial = path.with_extension("partial");
    std::fs::write(&partial, bytes)?;
    Ok(std::fs::rename(&partial, path)?)
}

/// Occupies all free shared memory until it is dropped.
struct Filler {
    path: PathBuf,
}

impl Filler {
    fn fill() -> anyhow::Result<Self> {
        let filler = Self { path: Path::new(SHARED_MEMORY_DIR).join("soak-filler") };
        let file = std::fs::File::create(&filler.path)?;
        let stat = rustix::fs::statvfs(SHARED_MEMORY_DIR)?;
        let (mut bytes, mut chunk) = (0, stat.f_bavail * stat.f_frsize);
        while chunk >= stat.f_frsize {
            match rustix::fs::fallocate(&file, rustix::fs::FallocateFlags::empty(), bytes, chunk) {
                Ok(()) => bytes += chunk,
                // Another process took some memory meanwhile.
                Err(_) => chunk /= 2,
            }
        }
        Ok(filler)
    }
}

impl Drop for Filler {
    fn drop(&mut self) {
        let _ = std::fs::remove_file(&self.path);
    }
}
