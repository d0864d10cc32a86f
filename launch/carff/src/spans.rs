//! The time that each stage spent on each frame, from its messages: as lines, and as a trace file for Perfetto and
//! Chrome.

use crate::vitals::stage_latency_ns;
use carff_messages::forms::AnyMessage;
use carff_messages::{Action, ActionCode, Belief, Forecast, FrameMeta, Reason, Stage, ViewMeta};
use serde_json::{Value, json};
#[cfg(feature = "recording")]
use std::path::Path;

/// A stage's work on a frame.
#[derive(Clone, Debug, PartialEq, Eq)]
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
