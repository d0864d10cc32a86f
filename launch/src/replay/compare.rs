//! What a replayed graph believed and decided, against what was recorded.

use carff_observe::TopicId;
use carff_readable::{ActionForm, AnyMessage, BeliefForm, HeaderForm};
use carff_recording::{OwnedMessage, Reader};
use serde_json::Value;
use std::collections::BTreeMap;
use std::fmt;
use std::path::Path;

/// What a graph made of replayed frames, without times.
#[derive(Debug, Default)]
pub(super) struct Replayed {
    /// By frame and step.
    beliefs: BTreeMap<(u64, u32), BeliefForm>,
    /// By frame.
    decisions: BTreeMap<u64, ActionForm>,
}

/// What came of a comparison.
#[derive(Debug, Default, PartialEq, Eq)]
pub(super) struct Comparison {
    beliefs: u64,
    decisions: u64,
    different: u64,
    missing: u64,
    first: Option<String>,
    cut_off: bool,
}

fn without_times(header: &mut HeaderForm) {
    header.run_id.clear();
    (header.sequence, header.capture_time_ns, header.publish_time_ns) = (0, 0, 0);
}

/// A belief, but for when it was made.
fn belief(message: &carff_messages::Belief) -> BeliefForm {
    let mut form = BeliefForm::from(message);
    without_times(&mut form.header);
    (form.encoder_ns, form.forecaster_ns, form.stage_latency_ns) = (0, 0, 0);
    form
}

/// A decision, but for when it was made.
fn decision(message: &carff_messages::Action) -> ActionForm {
    let mut form = ActionForm::from(message);
    without_times(&mut form.header);
    (form.valid_until_ns, form.latency_ns) = (0, 0);
    form
}

impl Replayed {
    /// Takes what the replayed graph sent.
    pub(super) fn take(&mut self, message: AnyMessage<'_>) {
        match message {
            AnyMessage::Belief(m) => {
                self.beliefs.insert((m.header.frame_id, m.header.step), belief(m));
            }
            AnyMessage::Action(m) if m.is_decision == 1 => {
                self.decisions.insert(m.based_on_frame, decision(m));
            }
            _ => {}
        }
    }

    /// Compares every recorded belief and decision on a recorded frame.
    pub(super) fn compare(&self, recording: &Path) -> anyhow::Result<Comparison> {
        let mut reader = Reader::open(recording)?;
        let mut comparison = Comparison::default();
        let mut frames = std::collections::BTreeSet::new();
        while let Some(entry) = reader.next()? {
            match (&entry.topic, &entry.message) {
                (TopicId::Frame, OwnedMessage::Frame(m, _)) => {
                    frames.insert(m.header.frame_id);
                }
                (_, OwnedMessage::Belief(m)) if frames.contains(&m.header.frame_id) => {
                    comparison.beliefs += 1;
                    let (frame, step) = (m.header.frame_id, m.header.step);
                    let replayed = self.beliefs.get(&(frame, step));
                    comparison.hold(&format!("frame {frame}, belief of step {step}"), &belief(m), replayed);
                }
                (_, OwnedMessage::Action(m)) if m.is_decision == 1 && frames.contains(&m.based_on_frame) => {
                    comparison.decisions += 1;
                    let replayed = self.decisions.get(&m.based_on_frame);
                    comparison.hold(&format!("frame {}, decision", m.based_on_frame), &decision(m), replayed);
                }
                _ => {}
            }
        }
        comparison.cut_off = reader.is_cut_off();
        Ok(comparison)
    }
}

impl Comparison {
    /// Whether all was there, and the same.
    pub(super) fn is_same(&self) -> bool {
        self.different == 0 && self.missing == 0 && self.beliefs + self.decisions > 0
    }

    fn hold<T: serde::Serialize + PartialEq>(&mut self, what: &str, recorded: &T, replayed: Option<&T>) {
        let found = match replayed {
            Some(replayed) if replayed == recorded => return,
            Some(replayed) => {
                self.different += 1;
                let values =
                    [serde_json::to_value(recorded), serde_json::to_value(replayed)].map(Result::unwrap_or_default);
                first_difference("", &values[0], &values[1]).unwrap_or_default()
            }
            None => {
                self.missing += 1;
                "recorded, but not made by the replay".to_owned()
            }
        };
        self.first.get_or_insert_with(|| format!("{what}: {found}"));
    }
}

/// The first place where two JSON values differ.
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
        let Self { beliefs, decisions, different, missing, .. } = self;
        if self.is_same() {
            write!(f, "{beliefs} beliefs and {decisions} decisions: all the same, bit for bit")?;
        } else if beliefs + decisions == 0 {
            write!(
                f,
                "the recording holds no belief and no decision on a recorded frame: there is nothing to compare"
            )?;
        } else {
            write!(f, "{beliefs} beliefs and {decisions} decisions: {different} differ, {missing} are missing")?;
        }
        if let Some(first) = &self.first {
            write!(f, "\nfirst difference: {first}")?;
        }
        if self.cut_off {
            write!(f, "\nthe recording ends in the middle")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Belief, FrameMeta, Header};
    use carff_recording::{About, Writer};

    fn a_belief(frame: u64, hazard: f32) -> Belief {
        let mut belief =
            Belief::empty(Header { publish_time_ns: frame, ..Header::of_frame(frame, frame, 1) }.at_step(1), 1);
        (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (1, 1, 1, 1);
        (belief.component_weights[0], belief.hazard_probability) = (1.0, hazard);
        belief
    }

    fn recorded(path: &Path, frames: u64) {
        let mut writer = Writer::create(path, &About::default(), &[]).unwrap();
        for frame in 0..frames {
            let mut meta = FrameMeta {
                header: Header::of_frame(frame, frame, 1),
                width_px: 1,
                height_px: 1,
                ..FrameMeta::default()
            };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (1.0, 1.0);
            writer.write(TopicId::Frame, AnyMessage::Frame(&meta, &[1, 2, 3])).unwrap();
            writer.write(TopicId::Belief, AnyMessage::Belief(&a_belief(frame, 0.25))).unwrap();
        }
        writer.finish().unwrap();
    }

    /// The same beliefs at other times are the same; one that differs is told with its frame and its field, and one that
    /// did not come is missing.
    #[test]
    fn differences_are_told() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("r.mcap");
        recorded(&path, 3);
        let mut replayed = Replayed::default();
        for frame in 0..3 {
            let mut belief = a_belief(frame, 0.25);
            (belief.header.capture_time_ns, belief.header.sequence, belief.stage_latency_ns) = (99, 77, 55);
            replayed.take(AnyMessage::Belief(&belief));
        }
        let same = replayed.compare(&path).unwrap();
        assert!(same.is_same() && same.beliefs == 3, "{same}");

        replayed.take(AnyMessage::Belief(&a_belief(1, 0.5)));
        replayed.beliefs.remove(&(2, 1));
        let other = replayed.compare(&path).unwrap();
        assert!(!other.is_same() && (other.different, other.missing) == (1, 1));
        let text = other.to_string();
        assert!(text.contains("frame 1, belief of step 1") && text.contains("hazard_probability"), "{text}");
        assert!(text.contains("0.25") && text.contains("0.5"), "{text}");
    }
}
