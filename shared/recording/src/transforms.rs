//! Coordinate transforms in recordings of other tools: from them the pose of a camera at any time.

use crate::bag::{Bag, BagMessage, Channel};
use crate::cdr::Cdr;
use crate::{ImageOrigin, MessageError, RecordingError};
use foxglove::Decode;
use foxglove::messages::{FrameTransform, FrameTransforms, Pose, PoseInFrame, Quaternion, Timestamp, Vector3};
use std::collections::BTreeMap;
use std::path::Path;

/// Longest time between two transforms between which a pose is interpolated, nanoseconds.
const LONGEST_GAP_NS: u64 = 1_000_000_000;
/// Largest number of transforms from a camera to the world.
const LONGEST_CHAIN: usize = 64;

/// A rigid transform, row by row.
type Matrix = [[f64; 4]; 4];

/// Kinds of messages that contain transforms.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Kind {
    RosPose,
    RosOdometry,
    RosTransforms,
    FoxglovePose,
    FoxgloveTransform,
    FoxgloveTransforms,
}

/// Schema names and message encodings of the kinds.
const KINDS: [(&str, &str, Kind); 7] = [
    ("geometry_msgs/msg/PoseStamped", "cdr", Kind::RosPose),
    // The covariance follows the pose.
    ("geometry_msgs/msg/PoseWithCovarianceStamped", "cdr", Kind::RosPose),
    ("nav_msgs/msg/Odometry", "cdr", Kind::RosOdometry),
    ("tf2_msgs/msg/TFMessage", "cdr", Kind::RosTransforms),
    ("foxglove.PoseInFrame", "protobuf", Kind::FoxglovePose),
    ("foxglove.FrameTransform", "protobuf", Kind::FoxgloveTransform),
    ("foxglove.FrameTransforms", "protobuf", Kind::FoxgloveTransforms),
];

/// A transform from a child frame to its parent.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Rigid {
    translation: [f64; 3],
    /// Unit quaternion: x, y, z, w.
    rotation: [f64; 4],
}

impl Rigid {
    fn new([x, y, z]: [f64; 3], rotation: [f64; 4]) -> Result<Self, MessageError> {
        let length = rotation.iter().map(|v| v * v).sum::<f64>().sqrt();
        let is_valid = [x, y, z].iter().all(|v| v.is_finite()) && (length - 1.0).abs() < 1e-2;
        if !is_valid {
            return Err(MessageError("a transform is not a position and a unit quaternion".to_owned()));
        }
        Ok(Self { translation: [x, y, z], rotation: rotation.map(|v| v / length) })
    }

    /// Returns the transform at `share` of the way to another one.
    fn towards(&self, other: &Self, share: f64) -> Self {
        let mix = |a: f64, b: f64| a + (b - a) * share;
        let same = self.rotation.iter().zip(&other.rotation).map(|(a, b)| a * b).sum::<f64>() >= 0.0;
        let sign = if same { 1.0 } else { -1.0 };
        let mixed = [0, 1, 2, 3].map(|i| mix(self.rotation[i], sign * other.rotation[i]));
        let length = mixed.iter().map(|v| v * v).sum::<f64>().sqrt();
        Self {
            translation: [0, 1, 2].map(|i| mix(self.translation[i], other.translation[i])),
            rotation: if length > 0.0 { mixed.map(|v| v / length) } else { self.rotation },
        }
    }

    fn matrix(&self) -> Matrix {
        let ([x, y, z, w], [tx, ty, tz]) = (self.rotation, self.translation);
        [
            [1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y - z * w), 2.0 * (x * z + y * w), tx],
            [2.0 * (x * y + z * w), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z - x * w), ty],
            [2.0 * (x * z - y * w), 2.0 * (y * z + x * w), 1.0 - 2.0 * (x * x + y * y), tz],
            [0.0, 0.0, 0.0, 1.0],
        ]
    }
}

/// The transforms of a frame to its parent, by time.
#[derive(Clone, Debug, Default)]
struct Edge {
    parent: String,
    /// True if the transform holds at all times.
    is_static: bool,
    at: BTreeMap<u64, Rigid>,
}

impl Edge {
    /// Returns the transform at a time; `None` before the first, after the last, and in a gap.
    fn at(&self, at_ns: u64) -> Option<Rigid> {
        if self.is_static || self.at.len() == 1 {
            return self.at.last_key_value().map(|(_, rigid)| *rigid);
        }
        let (before_ns, before) = self.at.range(..=at_ns).next_back()?;
        let (after_ns, after) = self.at.range(at_ns..).next()?;
        let gap_ns = after_ns - before_ns;
        if gap_ns == 0 {
            return Some(*before);
        }
        (gap_ns <= LONGEST_GAP_NS).then(|| before.towards(after, (at_ns - before_ns) as f64 / gap_ns as f64))
    }
}

/// The transforms of a recording: ROS 2's `TFMessage` (where the name of a topic ends with `tf_static`, they hold at all
/// times), `Odometry` and `PoseStamped`, and Foxglove's `FrameTransform` and `PoseInFrame`.
///
/// A pose without a child frame is that of the camera itself; it is used if no transform begins at the camera's frame.
/// Between two times a transform is interpolated, over a second at most.
#[derive(Clone, Debug, Default)]
pub struct Transforms {
    /// By the name of the child frame; poses without a child have an empty name.
    edges: BTreeMap<String, Edge>,
}

impl Transforms {
    /// Reads all transforms of a recording, or of the recordings in a folder; of the poses (`PoseStamped`,
    /// `PoseInFrame`, `Odometry`) only those on `topic`, if it is given.
    ///
    /// # Errors
    ///
    /// If a file is damaged, a transform is not a rigid one, or the poses of several topics have the same child frame.
    pub fn read(path: &Path, topic: Option<&str>) -> Result<Self, RecordingError> {
        let mut bag = Bag::open(path)?;
        let mut transforms = Self::default();
        let mut sources: BTreeMap<String, String> = BTreeMap::new();
        let is_pose = |kind| matches!(kind, Kind::RosPose | Kind::RosOdometry | Kind::FoxglovePose);
        let kind_of = |channel: &Channel| {
            channel.kind(&KINDS).filter(|kind| topic.is_none_or(|topic| !is_pose(*kind) || channel.topic == topic))
        };
        while let Some(message) = bag.next(|channel| kind_of(channel).is_some())? {
            let Some(kind) = kind_of(&message.channel) else { continue };
            let wrong = |cause: String| RecordingError::Message {
                path: bag.path().to_owned(),
                channel: message.channel.topic.clone(),
                sequence: message.sequence,
                cause,
            };
            for stamped in transforms_of(kind, &message).map_err(|e| wrong(e.0))? {
                if is_pose(kind) {
                    let source = sources.entry(stamped.child.clone()).or_insert(message.channel.topic.clone());
                    if *source != message.channel.topic {
                        return Err(wrong(format!("`{source}` has poses too: name one of the two")));
                    }
                }
                transforms.add(stamped, message.channel.topic.ends_with("tf_static"));
            }
        }
        Ok(transforms)
    }

    fn add(&mut self, stamped: Stamped, is_static: bool) {
        let edge = self.edges.entry(stamped.child).or_default();
        edge.parent = stamped.parent;
        edge.is_static |= is_static;
        edge.at.insert(stamped.at_ns, stamped.rigid);
    }

    /// Returns the pose of the camera that took an image: the transform from its coordinate frame to the root of the
    /// transforms, row by row; the camera looks along -z with +y up. `None` where a transform is missing at this time.
    pub fn world_from_camera(&self, origin: &ImageOrigin) -> Option<[[f64; 4]; 4]> {
        let mut frame = self.first(&origin.frame)?;
        let mut pose: Option<Matrix> = None;
        for _ in 0..LONGEST_CHAIN {
            let Some(edge) = self.edges.get(frame) else { break };
            let step = edge.at(origin.captured_ns)?.matrix();
            pose = Some(pose.map_or(step, |pose| product(&step, &pose)));
            frame = &edge.parent;
        }
        // The axes of computer vision and of ROS: x right, y down, z forward.
        let is_root = !self.edges.contains_key(frame);
        pose.filter(|_| is_root).map(|m| m.map(|[x, y, z, t]| [x, -y, -z, t]))
    }

    /// Returns the name of the frame with which the transforms of a camera begin.
    fn first(&self, frame: &str) -> Option<&str> {
        [frame, ""].into_iter().find_map(|frame| self.edges.get_key_value(frame)).map(|(name, _)| name.as_str())
    }

    /// Returns an error if no transform begins at a camera's frame.
    pub fn check(&self, path: &Path, frame: &str) -> Result<(), RecordingError> {
        if self.first(frame).is_some() {
            return Ok(());
        }
        let named: Vec<String> =
            self.edges.iter().map(|(child, edge)| format!("`{child}` in `{}`", edge.parent)).collect();
        let found = if named.is_empty() {
            "it has no transforms; TFMessage, Odometry and PoseStamped of ROS 2, and FrameTransform and PoseInFrame of \
             Foxglove are read"
                .to_owned()
        } else {
            format!("it has those of {}", named.join(", "))
        };
        Err(RecordingError::Poses { path: path.to_owned(), frame: frame.to_owned(), found })
    }
}

fn product(a: &Matrix, b: &Matrix) -> Matrix {
    let cell = |row: usize, column: usize| (0..4).map(|k| a[row][k] * b[k][column]).sum();
    [0, 1, 2, 3].map(|row| [0, 1, 2, 3].map(|column| cell(row, column)))
}

/// A transform at a time.
struct Stamped {
    at_ns: u64,
    parent: String,
    /// Empty for a pose without a child frame.
    child: String,
    rigid: Rigid,
}

fn transforms_of(kind: Kind, message: &BagMessage) -> Result<Vec<Stamped>, MessageError> {
    let wrong = |error: &dyn std::error::Error| MessageError(error.to_string());
    let data = || message.data.clone();
    match kind {
        Kind::RosPose | Kind::RosOdometry => {
            let mut cdr = Cdr::new(&message.data)?;
            let (at_ns, parent) = cdr.header()?;
            let child = if kind == Kind::RosOdometry { cdr.text()? } else { "" };
            Ok(vec![ros_transform(&mut cdr, at_ns, parent, child)?])
        }
        Kind::RosTransforms => {
            let mut cdr = Cdr::new(&message.data)?;
            let count = cdr.u32()?;
            let one = |_| {
                let (at_ns, parent) = cdr.header()?;
                let child = cdr.text()?;
                ros_transform(&mut cdr, at_ns, parent, child)
            };
            // A wrong count ends at the end of the message, before it reserves memory.
            (0..count).map(one).collect()
        }
        Kind::FoxglovePose => {
            let PoseInFrame { timestamp, frame_id, pose } = PoseInFrame::decode(data()).map_err(|e| wrong(&e))?;
            let Pose { position, orientation } = pose.unwrap_or_default();
            Ok(vec![foxglove_transform(timestamp, frame_id, String::new(), position, orientation)?])
        }
        Kind::FoxgloveTransform => Ok(vec![one_of(FrameTransform::decode(data()).map_err(|e| wrong(&e))?)?]),
        Kind::FoxgloveTransforms => {
            FrameTransforms::decode(data()).map_err(|e| wrong(&e))?.transforms.into_iter().map(one_of).collect()
        }
    }
}

/// Reads a position and a quaternion, which begin a pose and a transform.
fn ros_transform(cdr: &mut Cdr<'_>, at_ns: u64, parent: &str, child: &str) -> Result<Stamped, MessageError> {
    let numbers = cdr.f64s(7)?;
    let &[x, y, z, qx, qy, qz, qw] = &numbers[..] else { return Err(MessageError("7 numbers are missing".to_owned())) };
    let rigid = Rigid::new([x, y, z], [qx, qy, qz, qw])?;
    Ok(Stamped { at_ns, parent: parent.to_owned(), child: child.to_owned(), rigid })
}

fn one_of(transform: FrameTransform) -> Result<Stamped, MessageError> {
    let FrameTransform { timestamp, parent_frame_id, child_frame_id, translation, rotation } = transform;
    foxglove_transform(timestamp, parent_frame_id, child_frame_id, translation, rotation)
}

fn foxglove_transform(
    timestamp: Option<Timestamp>,
    parent: String,
    child: String,
    translation: Option<Vector3>,
    rotation: Option<Quaternion>,
) -> Result<Stamped, MessageError> {
    let Vector3 { x, y, z } = translation.unwrap_or_default();
    let turned = rotation.map_or([0.0, 0.0, 0.0, 1.0], |q| [q.x, q.y, q.z, q.w]);
    let at_ns = timestamp.map_or(0, |time| time.total_nanos());
    Ok(Stamped { at_ns, parent, child, rigid: Rigid::new([x, y, z], turned)? })
}
