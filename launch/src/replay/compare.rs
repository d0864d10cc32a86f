//! Compares a replayed graph's posteriors, forecasts, beliefs and decisions with the recorded ones.

use carff_config::{CompareImages, GraphConfig};
use carff_messages::forms::AnyMessage;
use carff_messages::{Action, Belief, Forecast, FrameMeta, Posterior};
use carff_recording::Reader;
use carff_transport::TopicId;
use serde_json::Value;
use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::path::Path;

/// The compared topics, in the order in which a graph publishes them.
pub(super) const COMPARED: [TopicId; 4] = [TopicId::POSTERIOR, TopicId::FORECAST, TopicId::BELIEF, TopicId::ACTION];

/// Key of a compared message: its topic, frame and step.
type Place = (TopicId, u64, u32);

/// Position of a compared message along the path of a frame: frame, index in [`COMPARED`], step. A recorder may write
/// the topics in any order.
type Order = (u64, usize, u32);

/// Messages of a graph about replayed frames, without times.
#[derive(Debug, Default)]
pub(super) struct Replayed {
    made: BTreeMap<Place, Value>,
}

/// Result of a comparison.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Comparison {
    compared: BTreeMap<TopicId, u64>,
    different: u64,
    missing: u64,
    first: Option<(Order, String)>,
    /// Frames whose results depend on earlier frames of their take that the recording does not have.
    left_out: u64,
    cut_off: bool,
}

/// State that a graph carries from frame to frame of a take.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Carried {
    /// Nothing: the results of a frame rest on it only.
    Nothing,
    /// The comparison of the frame before.
    LastFrame,
    /// A memory of all frames.
    Take,
}

impl Carried {
    /// Returns what a graph carries.
    pub(super) fn of(graph: &GraphConfig) -> Self {
        match (graph.remembers(), graph.checks.compare) {
            (true, _) => Self::Take,
            (false, CompareImages::NextFrame) => Self::LastFrame,
            (false, _) => Self::Nothing,
        }
    }

    /// Returns the frames whose results the recording determines, of all recorded ones in their order (number, and
    /// number of the first frame of the take) and of those that the graph has `answered`, up to the last step. A replay
    /// answers each frame: where the graph has skipped one, or its last step, it carried something else.
    fn determined(self, recorded: &[(u64, u64)], answered: &BTreeSet<u64>) -> BTreeSet<u64> {
        let mut frames = BTreeSet::new();
        // The frame before, its take, and whether the take is complete up to it.
        let mut last: Option<(u64, u64, bool)> = None;
        for &(frame, take_start) in recorded {
            let follows = last.filter(|(before, take, _)| *take == take_start && before + 1 == frame);
            let is_first = frame == take_start;
            let is_known = follows.is_some_and(|(before, ..)| answered.contains(&before));
            let is_whole = is_first || is_known && follows.is_some_and(|(.., whole)| whole);
            if match self {
                Self::Nothing => true,
                Self::LastFrame => is_first || is_known,
                Self::Take => is_whole,
            } {
                frames.insert(frame);
            }
            last = Some((frame, take_start, is_whole));
        }
        frames
    }
}

/// Returns a message without its times; `None` for topics that are not compared.
fn timeless(message: AnyMessage<'_>) -> Option<(Place, Value)> {
    let header = message.header();
    let place = if message.get::<Posterior>().is_some() {
        (TopicId::POSTERIOR, header.frame_id, header.step)
    } else if message.get::<Forecast>().is_some() {
        (TopicId::FORECAST, header.frame_id, header.step)
    } else if message.get::<Belief>().is_some() {
        (TopicId::BELIEF, header.frame_id, header.step)
    } else {
        let action = message.get::<Action>().filter(|action| action.is_decision())?;
        (TopicId::ACTION, action.based_on_frame, 0)
    };
    let mut value = message.to_json().unwrap_or_default();
    if let Some(header) = value["header"].as_object_mut() {
        header.retain(|key, _| !key.ends_with("_ns") && !["run_id", "sequence"].contains(&key.as_str()));
    }
    if let Some(fields) = value.as_object_mut() {
        fields.retain(|key, _| !key.ends_with("_ns"));
    }
    Some((place, value))
}

impl Replayed {
    /// Adds a message of the replayed graph.
    pub(super) fn take(&mut self, message: AnyMessage<'_>) {
        self.made.extend(timeless(message));
    }

    /// Compares all recorded messages about the recorded frames that determine them.
    pub(super) fn compare(&self, recording: &Path, carried: Carried) -> anyhow::Result<Comparison> {
        let (mut recorded, mut answered) = (Vec::new(), BTreeSet::new());
        let mut reader = Reader::open(recording)?.without_images();
        while let Some(entry) = reader.next()? {
            let message = entry.message.as_message();
            if let Some(frame) = message.get::<FrameMeta>() {
                recorded.push((frame.header.frame_id, frame.take_start));
            }
            let last_step = message.get::<Belief>().filter(|belief| belief.is_final());
            answered.extend(last_step.map(|belief| belief.header.frame_id));
        }
        let frames = carried.determined(&recorded, &answered);
        let left_out = (recorded.len() - frames.len()) as u64;
        let mut comparison = Comparison { left_out, ..Comparison::default() };
        let mut reader = Reader::open(recording)?.without_images();
        while let Some(entry) = reader.next()? {
            let found = timeless(entry.message.as_message()).filter(|((_, frame, _), _)| frames.contains(frame));
            if let Some((place, recorded)) = found {
                comparison.hold(place, &recorded, self.made.get(&place));
            }
        }
        comparison.cut_off = reader.is_cut_off();
        Ok(comparison)
    }
}

impl Comparison {
    /// Returns true if all messages arrived and are equal.
    pub(super) fn is_same(&self) -> bool {
        self.different == 0 && self.missing == 0 && !self.compared.is_empty()
    }

    fn hold(&mut self, (topic, frame, step): Place, recorded: &Value, replayed: Option<&Value>) {
        *self.compared.entry(topic).or_default() += 1;
        let found = match replayed {
            Some(replayed) if replayed == recorded => return,
            Some(replayed) => {
                self.different += 1;
                first_difference("", recorded, replayed).unwrap_or_default()
            }
            None => {
                self.missing += 1;
                "recorded, but not made by the replay".to_owned()
            }
        };
        let of_step = if step > 0 { format!(" of step {step}") } else { String::new() };
        let order = (frame, COMPARED.iter().position(|t| *t == topic).unwrap_or(COMPARED.len()), step);
        if self.first.as_ref().is_none_or(|(first, _)| order < *first) {
            self.first = Some((order, format!("frame {frame}, {}{of_step}: {found}", noun(topic))));
        }
    }
}

/// Returns the noun for a topic's message.
fn noun(topic: TopicId) -> &'static str {
    if topic == TopicId::ACTION { "decision" } else { topic.name().rsplit('/').next().unwrap_or_default() }
}

/// Returns the first difference between two JSON values.
fn first_difference(path: &str, recorded: &Value, replayed: &Value) -> Option<String> {
    match (recorded, replayed) {
        (Value::Object(a), Value::Object(b)) => a.iter().find_map(|(key, value)| {
            let path = if path.is_empty() { key.clone() } else { format!("{path}.{key}") };
            first_difference(&path, value, b.get(key).unwrap_or(&Value::Null))
        }),
        (Value::Array(a), Value::Array(b)) if a.len() == b.len() => {
            a.iter().zip(b).enumerate().find_map(|(i, (x, y))| first_difference(&format!("{path}[{i}]"), x, y))
        }
        (Value::Array(a), Value::Array(b)) => {
            Some(format!("`{path}` has {} entries in the recording, {} in the replay", a.len(), b.len()))
        }
        (a, b) if a != b => Some(format!("`{path}` is {a} in the recording, {b} in the replay")),
        _ => None,
    }
}

impl fmt::Display for Comparison {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let counts: Vec<String> =
            COMPARED.iter().filter_map(|t| Some(format!("{} {}s", self.compared.get(t)?, noun(*t)))).collect();
        let counts = counts.join(", ");
        if self.is_same() {
            write!(f, "{counts}: all equal, bit for bit")?;
        } else if self.compared.is_empty() {
            write!(
                f,
                "the recording has no posterior, forecast, belief or decision of a recorded frame: nothing to compare"
            )?;
        } else {
            write!(f, "{counts}: {} differ, {} are missing", self.different, self.missing)?;
        }
        if let Some((_, first)) = &self.first {
            write!(f, "\nfirst difference: {first}")?;
        }
        if self.left_out > 0 {
            write!(
                f,
                "\nnot compared: {} frames whose results rest on earlier frames of their take, which the recording does \
                 not have",
                self.left_out
            )?;
        }
        if self.cut_off {
            write!(f, "\nthe recording is incomplete")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Header;
    use carff_recording::{RecordingAbout, Writer};

    fn a_belief(frame: u64, hazard: f32) -> Belief {
        let mut belief =
            Belief::empty(Header { publish_time_ns: frame, ..Header::of_frame(frame, frame, 1) }.at_step(1), 1);
        (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (1, 1, 1, 1);
        (belief.component_weights[0], belief.hazard_probability) = (1.0, hazard);
        belief
    }

    /// Writes a recording with frames in this order, and each belief ahead of its frame. Those of `unfinished` are not of the
    /// last step.
    fn recorded(path: &Path, frames: impl IntoIterator<Item = u64>, unfinished: &[u64]) {
        let mut writer = Writer::create(path, &RecordingAbout::default(), &[]).unwrap();
        for frame in frames {
            let mut belief = a_belief(frame, 0.25);
            if unfinished.contains(&frame) {
                (belief.horizon, belief.is_final) = (2, 0);
            }
            writer.write(TopicId::BELIEF, AnyMessage::new(&belief, &[])).unwrap();
            let mut meta = FrameMeta {
                header: Header::of_frame(frame, frame, 1),
                width_px: 1,
                height_px: 1,
                ..FrameMeta::default()
            };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (1.0, 1.0);
            writer.write(TopicId::FRAME, AnyMessage::new(&meta, &[1, 2, 3])).unwrap();
        }
        writer.finish().unwrap();
    }

    /// A recording that begins within a take determines the frames that rest on themselves; those that rest on the frame
    /// before but for the first, and but for those after a frame without an answer or a gap; and none of the take where a
    /// memory rests on all of them.
    #[test]
    fn what_is_carried_must_be_recorded() {
        let recorded = [(4, 0), (5, 0), (6, 6), (7, 6), (8, 6), (9, 6), (11, 6), (12, 0)];
        let answered = [4, 5, 6, 8, 9, 11, 12].into();
        for (carried, determined) in [
            (Carried::Nothing, &[4, 5, 6, 7, 8, 9, 11, 12][..]),
            (Carried::LastFrame, &[5, 6, 7, 9]),
            (Carried::Take, &[6, 7]),
        ] {
            assert_eq!(carried.determined(&recorded, &answered), determined.iter().copied().collect(), "{carried:?}");
        }
    }

    /// A frame after one whose last step the graph did not reach rests on an earlier comparison.
    #[test]
    fn an_unfinished_frame_determines_none() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.mcap");
        recorded(&path, 0..5, &[1, 3]);
        let left_out = |carried| Replayed::default().compare(&path, carried).unwrap().left_out;
        assert_eq!([Carried::Nothing, Carried::LastFrame, Carried::Take].map(left_out), [0, 2, 3]);
    }

    /// Beliefs that differ only in time are equal, in whichever order they are recorded. The first different belief by
    /// its frame is reported with its field, and an absent one is missing.
    #[test]
    fn differences_are_reported() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.mcap");
        recorded(&path, (0..3).rev(), &[]);
        let mut replayed = Replayed::default();
        for frame in 0..3 {
            let mut belief = a_belief(frame, 0.25);
            (belief.header.capture_time_ns, belief.header.sequence, belief.stage_latency_ns) = (99, 77, 55);
            replayed.take(AnyMessage::new(&belief, &[]));
        }
        let same = replayed.compare(&path, Carried::Nothing).unwrap();
        assert!(same.is_same() && same.compared[&TopicId::BELIEF] == 3, "{same}");

        replayed.take(AnyMessage::new(&a_belief(1, 0.5), &[]));
        replayed.made.remove(&(TopicId::BELIEF, 2, 1));
        let other = replayed.compare(&path, Carried::Nothing).unwrap();
        assert!(!other.is_same() && (other.different, other.missing) == (1, 1));
        let text = other.to_string();
        assert!(text.contains("frame 1, belief of step 1") && text.contains("hazard_probability"), "{text}");
        assert!(text.contains("0.25") && text.contains("0.5"), "{text}");
    }
}
