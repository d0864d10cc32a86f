//! The time that each stage spent on each frame, from its messages: as lines, as a trace file for Perfetto and Chrome,
//! and as a file of the last minutes of a run.

use crate::log_file::{LogFile, earlier};
use crate::vitals::stage_latency_ns;
use carff_messages::forms::AnyMessage;
use carff_messages::{Action, ActionCode, Belief, Forecast, FrameMeta, Reason, Stage, ViewMeta};
use serde::{Deserialize, Serialize};
use serde_json::{Value, json};
use std::path::{Path, PathBuf};

/// A stage's work on a frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(crate) struct Span {
    pub(crate) stage: Stage,
    pub(crate) frame_id: u64,
    pub(crate) step: u32,
    /// Capture time of the frame.
    pub(crate) capture_ns: u64,
    /// Arrival time of the input. For the controller, and for stages that do not report it, the end of the work.
    pub(crate) begin_ns: u64,
    /// Publish time of the output.
    pub(crate) end_ns: u64,
    /// Short description of the output.
    pub(crate) what: String,
}

impl Span {
    /// Returns the work behind a message; none for heartbeats and for actions that are not decisions.
    pub(crate) fn of(message: AnyMessage<'_>) -> Option<Self> {
        let header = message.header();
        let (stage, took_ns) = if message.get::<FrameMeta>().is_some() {
            (Stage::Camera, header.publish_time_ns.saturating_sub(header.capture_time_ns))
        } else if message.get::<Action>().is_some_and(Action::is_decision) {
            (Stage::Controller, 0)
        } else {
            stage_latency_ns(message)?
        };
        let end_ns = header.publish_time_ns;
        Some(Self {
            stage,
            frame_id: header.frame_id,
            step: header.step,
            capture_ns: header.capture_time_ns,
            begin_ns: end_ns.saturating_sub(took_ns),
            end_ns,
            what: what(message),
        })
    }
}

/// Returns the path of a run's kept spans.
pub(crate) fn spans_path(dir: &Path, run: &str) -> PathBuf {
    dir.join(format!("{run}.spans"))
}

/// The spans of the last minutes of a run: a file of JSON lines next to the run's log. At 10 frames per second and two
/// steps it holds 5 to 10 minutes.
#[derive(Debug)]
pub struct KeptSpans {
    file: LogFile,
    /// Lines that are not written yet.
    lines: String,
}

impl KeptSpans {
    /// Creates the file of a run; one of an earlier run is replaced.
    pub fn create(dir: &Path, run: &str) -> std::io::Result<Self> {
        Ok(Self { file: LogFile::create(&spans_path(dir, run))?, lines: String::new() })
    }

    /// Adds the work behind a message, if it is a stage's work on a frame.
    pub fn add(&mut self, message: AnyMessage<'_>) {
        if let Some(Ok(line)) = Span::of(message).map(|span| serde_json::to_string(&span)) {
            self.lines.push_str(&line);
            self.lines.push('\n');
        }
    }

    /// Writes what was added.
    pub fn write(&mut self) {
        if !self.lines.is_empty() {
            // A full disk must not disturb the run.
            let _ = self.file.line(self.lines.trim_end());
            self.lines.clear();
        }
    }
}

/// Returns the kept spans of a run, in the order in which they were written; empty if the file is missing.
pub(crate) fn kept_spans(path: &Path) -> Vec<Span> {
    let read = |path: &Path| std::fs::read(path).unwrap_or_default();
    // In this order, nothing is lost if the next file begins in between: the newest lines are then in the earlier file.
    let (newest, before) = (read(path), read(&earlier(path)));
    let bytes = if before.starts_with(&newest) { before } else { [before, newest].concat() };
    // The launcher writes the last line at this moment: it may be incomplete.
    bytes.split(|&byte| byte == b'\n').filter_map(|line| serde_json::from_slice(line).ok()).collect()
}

/// Returns the run of a recording, and the work of its stages.
#[cfg(feature = "recording")]
pub(crate) fn recorded_spans(recording: &Path) -> anyhow::Result<(String, Vec<Span>)> {
    let mut reader = carff_recording::Reader::open(recording)?.without_images();
    let mut spans = Vec::new();
    while let Some(entry) = reader.next()? {
        spans.extend(Span::of(entry.message.as_message()));
    }
    Ok((reader.about().map_or("unknown", |about| &about.run).to_owned(), spans))
}

/// The result that a message carries, in a few words.
fn what(message: AnyMessage<'_>) -> String {
    if let Some(m) = message.get::<FrameMeta>() {
        format!("{} x {} pixels", m.width_px, m.height_px)
    } else if let Some(m) = message.get::<Forecast>() {
        format!("{} samples of {} components", m.sample_count, m.component_count)
    } else if let Some(m) = message.get::<Belief>() {
        format!("hazard {:.3}, unknown {:.3}", m.hazard_probability, m.unknown_probability)
    } else if let Some(m) = message.get::<ViewMeta>() {
        format!("view of hypothesis {}", m.hypothesis)
    } else if let Some(m) = message.get::<Action>() {
        let action = m.code().map_or("?", ActionCode::name);
        let reason = m.reason().map_or("?", Reason::name);
        format!("{action} ({reason}), hazard {:.3}, unknown {:.3}", m.hazard_probability, m.unknown_probability)
    } else {
        "posterior".to_owned()
    }
}

/// Returns spans in the trace event format, with one row per stage and times in microseconds.
pub(crate) fn trace_events(run: &str, spans: &[Span]) -> Value {
    let names = Stage::ALL.iter().map(|stage| {
        json!({ "name": "thread_name", "ph": "M", "pid": 1, "tid": stage.code(), "args": { "name": stage.name() } })
    });
    let process =
        json!({ "name": "process_name", "ph": "M", "pid": 1, "args": { "name": format!("carff run {run}") } });
    let events = spans.iter().map(|span| {
        json!({
            "name": format!("{} frame {}", span.stage, span.frame_id),
            "cat": span.stage.name(),
            "ph": "X",
            "pid": 1,
            "tid": span.stage.code(),
            "ts": span.begin_ns as f64 / 1e3,
            // A span of no duration must stay visible.
            "dur": (span.end_ns - span.begin_ns).max(1_000) as f64 / 1e3,
            "args": { "frame": span.frame_id, "step": span.step, "what": span.what },
        })
    });
    json!({ "traceEvents": std::iter::once(process).chain(names).chain(events).collect::<Vec<_>>() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Gaussian, Header, Posterior};

    /// Kept spans are read back as they were added, while the run continues. A line that is cut off is left out.
    #[test]
    fn kept_spans_are_read_back() {
        use std::io::Write;
        let dir = tempfile::tempdir().unwrap();
        let path = spans_path(dir.path(), "r");
        let mut kept = KeptSpans::create(dir.path(), "r").unwrap();
        assert_eq!(kept_spans(&path), []);
        let posterior = |frame| Posterior {
            header: Header { publish_time_ns: frame + 9, ..Header::of_frame(frame, frame, 1) },
            gaussian: Gaussian::standard(),
            take_start: 0,
            stage_latency_ns: 5,
        };
        for frame in 1..4 {
            kept.add(AnyMessage::new(&posterior(frame), &[]));
            kept.write();
        }
        let spans: Vec<_> = (1..4).filter_map(|f| Span::of(AnyMessage::new(&posterior(f), &[]))).collect();
        assert_eq!(kept_spans(&path), spans);
        std::fs::OpenOptions::new().append(true).open(&path).unwrap().write_all(b"{\"stage\":\"enc").unwrap();
        assert_eq!(kept_spans(&path), spans);
    }

    /// A span ends at its message's publish time and has the length that the stage reports. A trace has one event per
    /// span.
    #[test]
    fn spans_are_where_the_messages_say() {
        let header = Header { publish_time_ns: 30_000_000, ..Header::of_frame(4, 10_000_000, 1) };
        let posterior =
            Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 15_000_000 };
        let span = Span::of(AnyMessage::new(&posterior, &[])).unwrap();
        assert_eq!(
            (span.stage, span.frame_id, span.begin_ns, span.end_ns),
            (Stage::Encoder, 4, 15_000_000, 30_000_000)
        );
        let trace = trace_events("r", &[span]);
        let events = trace["traceEvents"].as_array().unwrap();
        let event = events.iter().find(|e| e["ph"] == "X").unwrap();
        assert_eq!((event["ts"].as_f64(), event["dur"].as_f64()), (Some(15_000.0), Some(15_000.0)));
        assert_eq!(events.iter().filter(|e| e["ph"] == "M").count(), 1 + Stage::ALL.len());
    }
}
