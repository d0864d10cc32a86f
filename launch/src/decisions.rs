//! Shows the decisions of a run, and writes them as JSON lines.

use crate::planning::decided;
use crate::supervision::monitor::FrameHistory;
use anyhow::{Context, anyhow};
use carff::terminal::Terminal;
use carff_config::{CameraSource, GraphConfig};
use carff_dataset::ScenarioInfo;
use carff_dataset::drives::DriveKind;
use carff_messages::{ActionCode, Observability, Reason};
use carff_trials::run::decisive_frames;
use serde_json::json;
use std::fmt::Write as _;
use std::fs::File;
use std::io::{LineWriter, Write};
use std::path::{Path, PathBuf};
use std::sync::Arc;

/// The lines that a run prints.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Shown {
    /// None.
    Nothing,
    /// One for each drive, or for each change of the action of a source without drives.
    Drives,
    /// One for each frame.
    Frames,
}

/// The decisions of a run: one result line for each drive, or, where asked for, one line for each frame.
pub(crate) struct Decisions {
    terminal: Arc<Terminal>,
    shown: Shown,
    drives: u32,
    frames_per_timestamp: u32,
    scenario: Option<ScenarioInfo>,
    /// Image files of a folder source, by index.
    images: Vec<PathBuf>,
    file: Option<(PathBuf, LineWriter<File>)>,
    failed: Option<anyhow::Error>,
    /// Decided frames of the current drive.
    drive: Vec<FrameHistory>,
    /// The latest action of a source without drives.
    action: Option<ActionCode>,
}

impl Decisions {
    /// Prepares the output; `path` is the file of the JSON lines.
    pub(crate) fn new(
        graph: &GraphConfig,
        drives: u32,
        shown: Shown,
        path: Option<&Path>,
        scenario: Option<ScenarioInfo>,
        terminal: &Arc<Terminal>,
    ) -> anyhow::Result<Self> {
        let create = |path: &Path| -> anyhow::Result<_> {
            let file = File::create(path).with_context(|| format!("cannot write {}", path.display()))?;
            Ok((path.to_owned(), LineWriter::new(file)))
        };
        let images = match (graph.camera.source, &graph.camera.folder) {
            (CameraSource::Folder, Some(folder)) => {
                carff_dataset::image_files(&graph.resolve(folder)).unwrap_or_default()
            }
            _ => Vec::new(),
        };
        Ok(Self {
            terminal: terminal.clone(),
            shown,
            drives,
            frames_per_timestamp: graph.camera.frames_per_timestamp,
            scenario,
            images,
            file: path.map(create).transpose()?,
            failed: None,
            drive: Vec::new(),
            action: None,
        })
    }

    /// Takes one decided frame.
    pub(crate) fn take(&mut self, frame: &FrameHistory) {
        if let Some((path, file)) = &mut self.file
            && let Err(error) = writeln!(file, "{}", record(frame, &self.images))
        {
            // The run continues; its end reports the error.
            self.failed = Some(anyhow!(error).context(format!("cannot write {}", path.display())));
            self.file = None;
        }
        let is_change =
            frame.drive < 0 && self.action.replace(frame.action.unwrap_or(ActionCode::Halt)) != frame.action;
        if self.shown == Shown::Frames || is_change && self.shown == Shown::Drives {
            self.terminal.line(&self.frame_line(frame));
        }
        if frame.drive >= 0 {
            if self.drive.first().is_some_and(|first| first.drive != frame.drive) {
                self.end_drive();
            }
            self.drive.push(frame.clone());
        }
    }

    /// Ends the output: prints the last drive, and returns the error that stopped the file.
    pub(crate) fn finish(mut self) -> anyhow::Result<()> {
        self.end_drive();
        self.failed.map_or(Ok(()), Err)
    }

    fn end_drive(&mut self) {
        let frames = std::mem::take(&mut self.drive);
        if let Some(last) = frames.last().filter(|_| self.shown == Shown::Drives) {
            self.terminal.line(&self.drive_line(last.drive, &frames));
        }
    }

    /// Number of a drive, its actions, and its decisive frame where it has one.
    fn drive_line(&self, drive: i32, frames: &[FrameHistory]) -> String {
        let halts = frames.iter().filter(|f| f.action.is_none_or(ActionCode::is_safe)).count();
        let mut line = format!("drive {:>3}/{}  {:>3} frames, {halts:>3} halts", drive + 1, self.drives, frames.len());
        let decisive = self.scenario.as_ref().map(|s| decisive_frames(frames.iter().filter_map(decided), s));
        if let Some((frame, kind)) = decisive.and_then(|found| found.into_iter().next()) {
            let right = frame.halted == (kind == DriveKind::Hazard);
            let (action, verdict) = (action_name(frame.halted), if right { "correct" } else { "WRONG" });
            let _ = write!(
                line,
                "  {:<6} t{}  hazard {:.2}  {}  {}",
                kind.name(),
                frame.timestamp,
                frame.hazard_probability,
                self.terminal.alarm(action, frame.halted),
                self.terminal.alarm(verdict, !right)
            );
        }
        line
    }

    fn frame_line(&self, frame: &FrameHistory) -> String {
        let halted = frame.action.is_none_or(ActionCode::is_safe);
        let name = if frame.action == Some(ActionCode::Creep) { "creep  " } else { action_name(halted) };
        let action = self.terminal.alarm(name, halted);
        format!(
            "{}  hazard {:.2}  {action}  {:>6.1} ms",
            self.place(frame),
            frame.hazard_probability,
            latency_ms(frame)
        )
    }

    fn place(&self, frame: &FrameHistory) -> String {
        if frame.drive < 0 {
            return format!("frame {:>6}", frame.frame_id);
        }
        format!(
            "drive {:>3}/{}  t{} frame {:>2}/{}  view {:>3}  {:<8}",
            frame.drive + 1,
            self.drives,
            frame.timestamp,
            frame.frame_in_drive % self.frames_per_timestamp as i32 + 1,
            self.frames_per_timestamp,
            frame.view,
            frame.observability.map_or("unknown", Observability::name)
        )
    }
}

fn action_name(halted: bool) -> &'static str {
    if halted { "HALT   " } else { "advance" }
}

fn latency_ms(frame: &FrameHistory) -> f64 {
    frame.latency_ns as f64 / 1e6
}

/// Image file of a view, or its number; null for a free pose.
fn source(view: i32, images: &[PathBuf]) -> serde_json::Value {
    let view = usize::try_from(view).ok();
    match view.and_then(|view| images.get(view)) {
        // A name that is not UTF-8 has no exact form in JSON.
        Some(file) => json!(file.to_string_lossy()),
        None => json!(view),
    }
}

/// A decided frame as one JSON object.
fn record(frame: &FrameHistory, images: &[PathBuf]) -> serde_json::Value {
    json!({
        "frame": frame.frame_id,
        "drive": u32::try_from(frame.drive).ok(),
        "source": source(frame.view, images),
        "capture_time_ns": frame.capture_time_ns,
        "hazard": frame.hazard_probability,
        "unknown": frame.unknown_probability,
        "action": frame.action.map(ActionCode::name),
        "reason": frame.reason.map(Reason::name),
        "latency_ms": latency_ms(frame),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::ffi::OsStr;
    use std::os::unix::ffi::OsStrExt;

    /// A source is a file, under any name that the system allows, or a view, or unknown.
    #[test]
    fn sources_have_any_name() {
        let images = ["a b.png".into(), PathBuf::from(OsStr::from_bytes(b"\xff.png"))];
        assert_eq!(source(0, &images), "a b.png");
        assert_eq!(source(1, &images), "\u{fffd}.png");
        assert_eq!((source(2, &images), source(-1, &images)), (json!(2), json!(null)));
    }
}
