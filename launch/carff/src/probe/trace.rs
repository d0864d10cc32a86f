//! `carff probe trace`: follows one frame through the stages.

use super::structure::columns;
use crate::runs::newest_file;
use crate::session::{Session, SessionArgs};
use crate::spans::{Span, kept_spans, spans_path, trace_events};
use anyhow::{Context, ensure};
use carff_base::files::check_writable;
use carff_messages::Stage;
use carff_transport::{Run, TopicId, monotonic_now_ns};
use clap::Args;
use std::path::{Path, PathBuf};
use std::str::FromStr;

/// Time to wait for a frame's views after its decision, nanoseconds.
const AFTER_DECISION_NS: u64 = 300_000_000;
/// Width of the chart, characters.
const WIDTH: usize = 50;

/// The frame to trace.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum TracedFrame {
    /// The next frame.
    Next,
    /// The frame with this number.
    Number(u64),
}

impl FromStr for TracedFrame {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "next" => Ok(Self::Next),
            number => number.parse().map(Self::Number).map_err(|_| "give a frame's number, or `next`".to_owned()),
        }
    }
}

/// Trace one frame.
#[derive(Clone, Debug, Args)]
pub struct TraceArgs {
    /// Number of the frame, or `next`.
    #[arg(default_value = "next")]
    pub frame: TracedFrame,
    /// Write the times of all frames to this file, in the trace event format, for ui.perfetto.dev.
    #[arg(long)]
    pub perfetto: Option<PathBuf>,
    /// Trace a frame of this recording instead of a running graph.
    #[cfg(feature = "recording")]
    #[arg(long, value_name = "FILE", conflicts_with_all = ["run", "seconds", "perfetto"])]
    pub recording: Option<PathBuf>,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Returns the first and last frame of the camera among spans.
fn range(spans: &[Span]) -> Option<(u64, u64)> {
    let frames = || spans.iter().filter(|s| s.stage == Stage::Camera).map(|s| s.frame_id);
    frames().min().zip(frames().max())
}

/// Returns a frame's spans.
fn of_frame(spans: &[Span], frame: u64) -> Vec<Span> {
    spans.iter().filter(|s| s.frame_id == frame).cloned().collect()
}

/// Prints the way of a recorded frame; `next` is the first one.
#[cfg(feature = "recording")]
fn recorded(args: &TraceArgs, recording: &std::path::Path) -> anyhow::Result<()> {
    let (_, spans) = crate::spans::recorded_spans(recording)?;
    let range = range(&spans);
    let file = recording.display();
    let frame = match args.frame {
        TracedFrame::Number(number) => number,
        TracedFrame::Next => range.with_context(|| format!("{file} has no frame of the camera"))?.0,
    };
    let spans = of_frame(&spans, frame);
    if spans.is_empty() {
        let range = range.map_or("no frames".to_owned(), |(first, last)| format!("frames {first} to {last}"));
        anyhow::bail!("{file} does not have frame {frame}; it has {range}");
    }
    print_way(frame, spans);
    Ok(())
}

/// Returns the kept spans of a frame of a living run, or of the last run of this name.
fn kept_of_run(run: Option<&str>, frame: u64) -> anyhow::Result<Vec<Span>> {
    let path = match (run, carff_observe::find(run)) {
        (_, Ok(live)) => spans_path(&live.dir, &live.name),
        (Some(name), Err(error)) if Run::new(name, 0).is_ok() => newest_file(name, spans_path).ok_or(error)?,
        (_, Err(error)) => return Err(error.into()),
    };
    kept(&path, frame)
}

/// Returns the kept spans of a frame that the whole graph has processed or skipped by now; none for a later frame.
///
/// # Errors
///
/// Fails for a frame that the run does not keep any more.
fn kept(path: &Path, frame: u64) -> anyhow::Result<Vec<Span>> {
    let all = kept_spans(path);
    let Some((first, last)) = range(&all) else { return Ok(Vec::new()) };
    let end_ns = all.iter().map(|s| s.end_ns).max().unwrap_or(0);
    if frame > last || frame == last && monotonic_now_ns() < end_ns + AFTER_DECISION_NS {
        return Ok(Vec::new());
    }
    let spans = of_frame(&all, frame);
    ensure!(
        !spans.is_empty(),
        "frame {frame} has passed, and is not among the frames that the run keeps ({first} to {last}): trace it in a \
         recording (`carff record -o run.mcap`, then `carff probe trace {frame} --recording run.mcap`), or name one of \
         these, a later one, or `next`"
    );
    Ok(spans)
}

pub(super) fn run(args: &TraceArgs) -> anyhow::Result<()> {
    #[cfg(feature = "recording")]
    if let Some(recording) = &args.recording {
        return recorded(args, recording);
    }
    args.perfetto.as_deref().map_or(Ok(()), check_writable)?;
    if let (TracedFrame::Number(frame), None) = (args.frame, &args.perfetto) {
        let spans = kept_of_run(args.session.run.as_deref(), frame)?;
        if !spans.is_empty() {
            print_way(frame, spans);
            return Ok(());
        }
    }
    let mut session = Session::open(&args.session, "probe-trace")?;
    session.listen(TopicId::FLOW)?;
    session.take(|_, _| Ok(()))?;
    let wanted = std::cell::Cell::new(match args.frame {
        TracedFrame::Next => None,
        TracedFrame::Number(number) => Some(number),
    });
    let (mut all, mut missed): (Vec<Span>, Option<u64>) = (Vec::new(), None);
    let mut decided_ns: Option<u64> = None;
    let to_file = args.perfetto.is_some();
    let going = session.follow(
        |_, message| {
            let Some(span) = Span::of(message.message()) else { return Ok(true) };
            if wanted.get().is_none() && span.stage == Stage::Camera {
                wanted.set(Some(span.frame_id));
            }
            if let Some(frame) = wanted.get() {
                let mine = span.frame_id == frame;
                // A decision on a later frame: this frame was skipped and will not arrive.
                if span.stage == Stage::Controller && span.frame_id >= frame {
                    decided_ns.get_or_insert_with(monotonic_now_ns);
                }
                // Frames are captured in order: a frame that did not arrive before a later one will not arrive.
                let is_mine_seen = mine || all.iter().any(|s| s.frame_id == frame);
                if span.stage == Stage::Camera && span.frame_id > frame && !is_mine_seen {
                    missed = Some(span.frame_id);
                    return Ok(to_file);
                }
                if mine || to_file {
                    all.push(span);
                }
            }
            // With a file the trace lasts for the requested time; without one the frame is enough.
            let waited = decided_ns.is_some_and(|at_ns| monotonic_now_ns() > at_ns + AFTER_DECISION_NS);
            Ok(!waited || (to_file && args.session.seconds.is_some()))
        },
        || Ok(()),
    )?;
    if let Some(path) = &args.perfetto {
        let trace = serde_json::to_string(&trace_events(&session.attached.live.name, &all))?;
        std::fs::write(path, trace).with_context(|| format!("cannot write {}", path.display()))?;
        println!("{}: {} spans; open it at ui.perfetto.dev or chrome://tracing", path.display(), all.len());
    }
    let frame = wanted.get().context("no frame arrived: check with `carff probe list` that the camera runs")?;
    let spans: Vec<Span> = all.into_iter().filter(|s| s.frame_id == frame).collect();
    session.say_end(going);
    if let (Some(later), true) = (missed, spans.is_empty()) {
        ensure!(
            to_file,
            "frame {frame} did not arrive before frame {later}: this probe was too slow. Repeat the command: the run keeps \
             its last minutes"
        );
    }
    ensure!(!spans.is_empty(), "frame {frame} did not arrive");
    print_way(frame, spans);
    Ok(())
}

fn print_way(frame: u64, mut spans: Vec<Span>) {
    spans.sort_by_key(|s| (s.end_ns, s.stage));
    print!("{}", way(frame, &spans));
    if !spans.iter().any(|s| s.stage == Stage::Controller) {
        println!("no decision: a later frame arrived before this one was processed");
    }
}

/// Formats a frame's spans as a table with a chart, milliseconds since capture.
fn way(frame: u64, spans: &[Span]) -> String {
    let capture_ns = spans.iter().map(|s| s.capture_ns).min().unwrap_or(0);
    let ms = |at_ns: u64| at_ns.saturating_sub(capture_ns) as f64 / 1e6;
    let end_ms = spans.iter().map(|s| ms(s.end_ns)).fold(1e-3, f64::max);
    let mut rows = vec![["stage", "step", "in, ms", "out, ms", "took, ms", "", "what"].map(str::to_owned).to_vec()];
    for span in spans {
        let (begin, end) = (ms(span.begin_ns), ms(span.end_ns));
        let at = |ms: f64| ((ms / end_ms * WIDTH as f64) as usize).min(WIDTH - 1);
        let drawn: String =
            (0..WIDTH).map(|i| if (at(begin)..=at(end)).contains(&i) { '\u{2501}' } else { '\u{00b7}' }).collect();
        rows.push(vec![
            span.stage.name().to_owned(),
            span.step.to_string(),
            format!("{begin:>7.2}"),
            format!("{end:>7.2}"),
            format!("{:>7.2}", end - begin),
            drawn,
            span.what.clone(),
        ]);
    }
    format!("frame {frame}, milliseconds since its capture\n{}", columns(&rows))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The table holds each stage's times since the capture, in order, and the decision.
    #[test]
    fn a_way_is_drawn_in_order() {
        let span = |stage, begin_ms: u64, end_ms: u64, what: &str| Span {
            stage,
            frame_id: 3,
            step: 0,
            capture_ns: 100_000_000,
            begin_ns: 100_000_000 + begin_ms * 1_000_000,
            end_ns: 100_000_000 + end_ms * 1_000_000,
            what: what.to_owned(),
        };
        let text = way(
            3,
            &[span(Stage::Camera, 0, 1, ""), span(Stage::Encoder, 1, 16, ""), span(Stage::Controller, 20, 20, "halt")],
        );
        let line = |stage: &str| text.lines().find(|l| l.starts_with(stage)).unwrap_or_default().to_owned();
        assert!(
            line("encoder").contains("1.00") && line("encoder").contains("16.00") && line("encoder").contains("15.00"),
            "{text}"
        );
        assert!(line("controller").ends_with("halt"), "{text}");
    }

    /// A past frame is found among the kept ones. An earlier one is an error that names the kept ones, and a later one, or
    /// one that the stages may still work on, is waited for.
    #[test]
    fn past_frames_are_traced() {
        use crate::spans::KeptSpans;
        use carff_messages::forms::AnyMessage;
        use carff_messages::{FrameMeta, Header};
        let dir = tempfile::tempdir().unwrap();
        let path = spans_path(dir.path(), "r");
        let mut file = KeptSpans::create(dir.path(), "r").unwrap();
        assert_eq!(kept(&path, 6).unwrap(), []);
        let now_ns = monotonic_now_ns();
        for (frame, published_ns) in [(5, 1), (6, 2), (8, now_ns)] {
            let header = Header { publish_time_ns: published_ns, ..Header::of_frame(frame, 0, 1) };
            file.add(AnyMessage::new(&FrameMeta { header, width_px: 2, height_px: 1, ..FrameMeta::default() }, &[]));
        }
        file.write();
        assert_eq!(kept(&path, 6).unwrap().iter().map(|s| (s.frame_id, s.end_ns)).collect::<Vec<_>>(), [(6, 2)]);
        for frame in [4, 7] {
            let error = kept(&path, frame).unwrap_err().to_string();
            assert!(error.contains(&format!("frame {frame}")) && error.contains("5 to 8"), "{error}");
        }
        assert_eq!(kept(&path, 9).unwrap(), []);
        while monotonic_now_ns() < now_ns + AFTER_DECISION_NS {
            std::thread::yield_now();
        }
        assert_eq!(kept(&path, 8).unwrap().len(), 1);
    }

    /// A frame of a recording is found by its number, `next` is the first one, and an error names the recorded frames.
    #[test]
    #[cfg(feature = "recording")]
    fn recorded_frames_are_traced() {
        use carff_messages::forms::AnyMessage;
        use carff_messages::{FrameMeta, Header};
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.mcap");
        let mut writer =
            carff_recording::Writer::create(&path, &carff_recording::RecordingAbout::default(), &[]).unwrap();
        for frame in 5..8 {
            let header = Header { publish_time_ns: frame + 1, ..Header::of_frame(frame, frame, 1) };
            let mut meta = FrameMeta { header, width_px: 2, height_px: 1, ..FrameMeta::default() };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (1.0, 1.0);
            writer.write(TopicId::FRAME, AnyMessage::new(&meta, &[0; 6])).unwrap();
        }
        writer.finish().unwrap();
        let args = |frame| TraceArgs { frame, perfetto: None, recording: None, session: SessionArgs::default() };
        recorded(&args(TracedFrame::Number(6)), &path).unwrap();
        recorded(&args(TracedFrame::Next), &path).unwrap();
        let error = recorded(&args(TracedFrame::Number(9)), &path).unwrap_err().to_string();
        assert!(error.contains("frame 9") && error.contains("5 to 7"), "{error}");
    }

    /// A frame is a number or `next`.
    #[test]
    fn frames_are_numbers_or_next() {
        assert_eq!("next".parse(), Ok(TracedFrame::Next));
        assert_eq!("17".parse(), Ok(TracedFrame::Number(17)));
        assert!("x".parse::<TracedFrame>().is_err());
    }
}
