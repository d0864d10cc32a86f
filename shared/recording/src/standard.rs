//! Messages in the standard robotics schemas: images, calibrations, poses, boxes, logs.

use carff_base::geometry::OrientedBox;
use carff_decision::Place;
use carff_messages::forms::AnyMessage;
use carff_messages::{
    Action, ActionCode, Belief, Header, Health, HealthState, Intrinsics, Occupancy, Reason, Stage, UnknownBox, Unknowns,
};
use foxglove::messages::log::Level;
use foxglove::messages::packed_element_field::NumericType;
use foxglove::messages::scene_entity_deletion::Type as Deleted;
use foxglove::messages::{
    CameraCalibration, Color, CubePrimitive, Duration, FrameTransform, Grid, Log, PackedElementField, Pose, Quaternion,
    RawImage, SceneEntity, SceneEntityDeletion, SceneUpdate, TextPrimitive, Timestamp, Vector2, Vector3,
};
use std::collections::BTreeMap;

/// Name of the fixed coordinate frame.
const WORLD: &str = "world";
/// Time for which boxes are shown after their publication, nanoseconds. A newer belief of their step replaces them.
const BOXES_SHOWN_NS: u64 = 1_000_000_000;
/// Size of the boxes' labels, pixels.
const LABEL_PX: f64 = 14.0;

/// Converts nanoseconds since 1970.
pub(crate) fn timestamp(wall_ns: u64) -> Timestamp {
    Timestamp::new((wall_ns / 1_000_000_000) as u32, (wall_ns % 1_000_000_000) as u32)
}

/// Returns the places, each with its occupancy probability at the belief's step.
pub(crate) fn boxes(captured: Timestamp, belief: &Belief, places: &[Place]) -> SceneUpdate {
    let header = &belief.header;
    let states = belief.state_probability.iter().take(belief.state_count as usize);
    let entities = places.iter().enumerate().map(|(index, place)| {
        let taken: f32 = states.clone().zip(&place.occupied_in).filter(|(_, taken)| **taken).map(|(p, _)| p).sum();
        let taken = f64::from(taken.clamp(0.0, 1.0));
        let (name, step) = (&place.name, header.step);
        SceneEntity {
            // Several places have one name: the possible positions of one actor.
            id: format!("step {step}, place {index}: {name}"),
            // From green to red, more opaque for higher probabilities.
            cubes: vec![cube(&place.oriented_box, Color { r: taken, g: 1.0 - taken, b: 0.1, a: 0.15 + 0.7 * taken })],
            texts: vec![label(&place.oriented_box, format!("{name}, step {step}: {:.0} %", 100.0 * taken))],
            ..entity(captured, header)
        }
    });
    SceneUpdate { deletions: Vec::new(), entities: entities.collect() }
}

/// Returns an occupancy grid, with one byte for each cell: 0 free, 255 taken.
pub(crate) fn grid(captured: Timestamp, occupancy: &Occupancy) -> Grid {
    let [x, y] = occupancy.low_corner_m.map(f64::from);
    let side = f64::from(occupancy.cell_m);
    let field = PackedElementField { name: "occupancy".to_owned(), offset: 0, r#type: NumericType::Uint8 as i32 };
    Grid {
        timestamp: Some(captured),
        frame_id: WORLD.to_owned(),
        pose: Some(Pose {
            position: Some(Vector3 { x, y, z: 0.0 }),
            orientation: Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }),
        }),
        column_count: occupancy.columns,
        cell_size: Some(Vector2 { x: side, y: side }),
        row_stride: occupancy.columns,
        cell_stride: 1,
        fields: vec![field],
        data: occupancy.cells().iter().map(|p| (255.0 * p).round() as u8).collect::<Vec<u8>>().into(),
    }
}

/// Returns the boxes in which something stands that no known state explains. They replace those of earlier images.
pub(crate) fn unknown_boxes(captured: Timestamp, unknowns: &Unknowns) -> SceneUpdate {
    let entities = unknowns.boxes().iter().enumerate().map(|(index, unknown)| {
        let UnknownBox { center, half_size, probability, .. } = *unknown;
        let (oriented, sure) = (OrientedBox { center, half_size, yaw: 0.0 }, f64::from(probability.clamp(0.0, 1.0)));
        SceneEntity {
            id: format!("unknown {index}"),
            cubes: vec![cube(&oriented, Color { r: 0.8, g: 0.1, b: 0.9, a: 0.15 + 0.7 * sure })],
            texts: vec![label(&oriented, format!("unknown: {:.0} %", 100.0 * sure))],
            ..entity(captured, &unknowns.header)
        }
    });
    let earlier = SceneEntityDeletion { timestamp: Some(captured), r#type: Deleted::All.into(), id: String::new() };
    SceneUpdate { deletions: vec![earlier], entities: entities.collect() }
}

/// Returns an empty entity of the world that is shown for a while after its publication.
fn entity(captured: Timestamp, header: &Header) -> SceneEntity {
    // A lifetime counts from the time of capture.
    let shown_ns = header.publish_time_ns.saturating_sub(header.capture_time_ns).saturating_add(BOXES_SHOWN_NS);
    let lifetime = Duration::new_checked((shown_ns / 1_000_000_000) as i32, (shown_ns % 1_000_000_000) as u32);
    SceneEntity { timestamp: Some(captured), frame_id: WORLD.to_owned(), lifetime, ..SceneEntity::default() }
}

/// Returns an image of the camera `frame`.
pub(crate) fn image(captured: Timestamp, frame: &str, [width, height]: [u32; 2], bytes: &[u8]) -> RawImage {
    RawImage {
        timestamp: Some(captured),
        frame_id: frame.to_owned(),
        width,
        height,
        encoding: "rgb8".to_owned(),
        step: width * 3,
        data: bytes.to_vec().into(),
    }
}

/// Returns the intrinsics of the camera `frame`.
pub(crate) fn calibration(
    captured: Timestamp,
    frame: &str,
    [width, height]: [u32; 2],
    intrinsics: &Intrinsics,
) -> CameraCalibration {
    let &Intrinsics { fl_x_px, fl_y_px, cx_px, cy_px } = intrinsics;
    CameraCalibration {
        timestamp: Some(captured),
        frame_id: frame.to_owned(),
        width,
        height,
        // An ideal pinhole: no distortion.
        distortion_model: String::new(),
        d: Vec::new(),
        k: vec![fl_x_px, 0.0, cx_px, 0.0, fl_y_px, cy_px, 0.0, 0.0, 1.0],
        r: vec![1.0, 0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 1.0],
        p: vec![fl_x_px, 0.0, cx_px, 0.0, 0.0, fl_y_px, cy_px, 0.0, 0.0, 0.0, 1.0, 0.0],
    }
}

/// Returns the pose of the camera `frame`. Its axes are those of computer vision: x right, y down, z forward.
pub(crate) fn pose(captured: Timestamp, frame: &str, world_from_camera: &[f64; 16]) -> FrameTransform {
    let m = world_from_camera;
    // OpenGL's camera looks along -z with y up: y and z change sign.
    let rotation = [[m[0], -m[1], -m[2]], [m[4], -m[5], -m[6]], [m[8], -m[9], -m[10]]];
    FrameTransform {
        timestamp: Some(captured),
        parent_frame_id: WORLD.to_owned(),
        child_frame_id: frame.to_owned(),
        translation: Some(Vector3 { x: m[3], y: m[7], z: m[11] }),
        rotation: Some(quaternion(&rotation)),
    }
}

/// Returns the unit quaternion of a rotation matrix. The largest of its four numbers is computed first, to avoid
/// division by a small number.
fn quaternion(r: &[[f64; 3]; 3]) -> Quaternion {
    let [xx, yy, zz] = [r[0][0], r[1][1], r[2][2]];
    let squares = [1.0 + xx + yy + zz, 1.0 + xx - yy - zz, 1.0 - xx + yy - zz, 1.0 - xx - yy + zz];
    let (zy, xz, yx) = (r[2][1] - r[1][2], r[0][2] - r[2][0], r[1][0] - r[0][1]);
    let (xy, xz_sum, yz) = (r[0][1] + r[1][0], r[0][2] + r[2][0], r[1][2] + r[2][1]);
    let largest = (0..4).max_by(|&a, &b| squares[a].total_cmp(&squares[b])).unwrap_or(0);
    let [w, x, y, z] = match largest {
        0 => [squares[0], zy, xz, yx],
        1 => [zy, squares[1], xy, xz_sum],
        2 => [xz, xy, squares[2], yz],
        _ => [yx, xz_sum, yz, squares[3]],
    };
    let length = (w * w + x * x + y * y + z * z).sqrt();
    // A matrix that is not a rotation has no quaternion.
    if length > 0.0 && length.is_finite() {
        Quaternion { x: x / length, y: y / length, z: z / length, w: w / length }
    } else {
        Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 }
    }
}

fn cube(oriented: &OrientedBox, color: Color) -> CubePrimitive {
    let half_yaw = oriented.yaw / 2.0;
    let [x, y, z] = oriented.center;
    let size = oriented.half_size.map(|half| half * 2.0);
    CubePrimitive {
        pose: Some(Pose {
            position: Some(Vector3 { x, y, z }),
            orientation: Some(Quaternion { x: 0.0, y: 0.0, z: half_yaw.sin(), w: half_yaw.cos() }),
        }),
        size: Some(Vector3 { x: size[0], y: size[1], z: size[2] }),
        color: Some(color),
    }
}

/// Returns a text above a box.
fn label(oriented: &OrientedBox, text: String) -> TextPrimitive {
    let ([x, y, z], [.., half_height]) = (oriented.center, oriented.half_size);
    let position = Some(Vector3 { x, y, z: z + half_height });
    let orientation = Some(Quaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 });
    TextPrimitive {
        pose: Some(Pose { position, orientation }),
        billboard: true,
        font_size: LABEL_PX,
        scale_invariant: true,
        color: Some(Color { r: 1.0, g: 1.0, b: 1.0, a: 1.0 }),
        text,
    }
}

/// A line of a run's log, from a stage or the launcher.
///
/// ```
/// use carff_recording::LogLine;
/// let [source, level, message] = ["encoder", "WARN", "slow"].map(str::to_owned);
/// let line = LogLine { wall_ns: 1_700_000_000_000_000_000, source, level, message };
/// assert_eq!(line.encode().channel, "log");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct LogLine {
    /// Time of the line, nanoseconds since 1970.
    pub wall_ns: u64,
    /// Stage that wrote it, or `launcher`.
    pub source: String,
    /// Level: `ERROR`, `WARN`, `INFO`, `DEBUG` or `TRACE`.
    pub level: String,
    /// The text.
    pub message: String,
}

/// Returns a line of a run's log.
pub(crate) fn log_line(wall_ns: u64, source: &str, level: &str, message: &str) -> Log {
    let level = match level {
        "TRACE" | "DEBUG" => Level::Debug,
        "INFO" => Level::Info,
        "ERROR" => Level::Error,
        _ => Level::Warning,
    };
    Log {
        timestamp: Some(timestamp(wall_ns)),
        level: level.into(),
        message: message.to_owned(),
        name: source.to_owned(),
        file: String::new(),
        line: 0,
    }
}

/// The changes of a run: of each stage's health, and of the action.
#[derive(Debug, Default)]
pub(crate) struct Events {
    health: BTreeMap<Stage, (u32, u64, u64)>,
    action: Option<(u32, u32)>,
}

impl Events {
    /// Returns a log entry if a message changes a stage's health or the action.
    pub(crate) fn log(&mut self, at: Timestamp, message: AnyMessage<'_>) -> Option<Log> {
        let (stage, level, text) = if let Some(m) = message.get::<Health>() {
            let stage = m.stage().ok()?;
            let now = (m.state, m.invalid, m.errors);
            if self.health.insert(stage, now) == Some(now) {
                return None;
            }
            let level = match m.state() {
                Ok(HealthState::Starting | HealthState::Ok | HealthState::Done) => Level::Info,
                Ok(HealthState::Slow | HealthState::Stale) => Level::Warning,
                _ => Level::Error,
            };
            let state = m.state().map_or("unknown", HealthState::name);
            (stage, level, format!("{state}; {} invalid inputs, {} errors", m.invalid, m.errors))
        } else {
            let m = message.get::<Action>()?;
            if self.action.replace((m.action, m.reason)) == Some((m.action, m.reason)) {
                return None;
            }
            let level = if m.reason() == Ok(Reason::Belief) { Level::Info } else { Level::Warning };
            let (action, reason) =
                (m.code().map_or("unknown", ActionCode::name), m.reason().map_or("unknown", Reason::name));
            let frame = m.header.frame_id;
            (
                Stage::Controller,
                level,
                format!("{action} ({reason}), frame {frame}, hazard {:.3}", m.hazard_probability),
            )
        };
        let (level, name) = (level.into(), stage.name().to_owned());
        Some(Log { timestamp: Some(at), level, message: text, name, file: String::new(), line: 0 })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn rotate(q: &Quaternion, v: [f64; 3]) -> [f64; 3] {
        let (w, u) = (q.w, [q.x, q.y, q.z]);
        let cross = |a: [f64; 3], b: [f64; 3]| {
            [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
        };
        let t = cross(u, v).map(|c| 2.0 * c);
        let c = cross(u, t);
        std::array::from_fn(|i| v[i] + w * t[i] + c[i])
    }

    /// The quaternion rotates vectors as the matrix does, also for half turns, where a naive formula divides by zero.
    #[test]
    fn quaternions_turn_as_their_matrices() {
        let turn = |axis: usize, angle: f64| {
            let (s, c) = angle.sin_cos();
            let (i, j) = ((axis + 1) % 3, (axis + 2) % 3);
            let mut m = [[0.0; 3]; 3];
            m[axis][axis] = 1.0;
            (m[i][i], m[i][j], m[j][i], m[j][j]) = (c, -s, s, c);
            m
        };
        for axis in 0..3 {
            for angle in [0.0, 0.3, 2.0, std::f64::consts::PI, -1.2] {
                let m = turn(axis, angle);
                let q = quaternion(&m);
                for v in [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.2, -0.5, 0.9]] {
                    let expected: [f64; 3] = std::array::from_fn(|i| (0..3).map(|k| m[i][k] * v[k]).sum());
                    let found = rotate(&q, v);
                    assert!((0..3).all(|i| (expected[i] - found[i]).abs() < 1e-12), "{axis} {angle}: {found:?}");
                }
            }
        }
        assert_eq!(quaternion(&[[f64::NAN; 3]; 3]).w, 1.0);
    }

    /// A camera that looks along +x, z up, has its forward axis (z of computer vision) along +x.
    #[test]
    fn cameras_look_forward() {
        // Columns: right (-y), up (z), back (-x).
        let m = [0.0, 0.0, -1.0, 5.0, -1.0, 0.0, 0.0, 6.0, 0.0, 1.0, 0.0, 7.0, 0.0, 0.0, 0.0, 1.0];
        let pose = pose(timestamp(0), "camera", &m);
        let forward = rotate(&pose.rotation.unwrap(), [0.0, 0.0, 1.0]);
        let down = rotate(&pose.rotation.unwrap(), [0.0, 1.0, 0.0]);
        assert!((forward[0] - 1.0).abs() < 1e-12 && (down[2] + 1.0).abs() < 1e-12, "{forward:?} {down:?}");
        assert_eq!(pose.translation, Some(Vector3 { x: 5.0, y: 6.0, z: 7.0 }));
    }
}
