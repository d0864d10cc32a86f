//! Reading of a frame's image path, intrinsics and pose.

use std::path::{Component, Path, PathBuf};

use carff_base::geometry::{CameraError, PinholeCamera, cross, dot};
use serde_json::{Map, Value};

use crate::error::DatasetError;
use crate::image::MAX_IMAGE_SIDE_PX;
use crate::place::{Place, numbers, present};

/// Endings that are tried for a name without an existing file, in this order.
const ENDINGS: [&str; 6] = ["png", "jpg", "jpeg", "PNG", "JPG", "JPEG"];
/// Largest deviation of the products of a rotation's columns from those of a rotation that rounded numbers may cause:
/// with two decimals it is up to 0.017.
const ROUNDING: f64 = 0.02;
/// Largest distance of the principal point from the image's centre, as a share of the side, if the file does not
/// contain the size of its images.
const MAX_OFF_CENTRE: f64 = 0.15;
/// Largest distance of the principal point from the image's centre, as a share of the side. A part of a large image has
/// its principal point outside.
const MAX_CROPPED: f64 = 10.0;
/// Range of a camera's field of view, degrees.
const FIELD_OF_VIEW_DEG: [f64; 2] = [0.1, 179.0];
/// Largest coordinate of a camera: maps that span a country have less.
const MAX_POSITION: f64 = 1e9;

/// Returns the path of a file that a frame names, and an error if it does not exist. Backslashes separate folders, as
/// on Windows, unless a file has them in its name.
///
/// # Errors
///
/// If the name is absolute, or is more than one folder above the dataset's: a dataset may share its images with its
/// neighbours, but must not read anything else.
pub(crate) fn read_path(
    dir: &Path,
    place: &Place,
    key: &str,
    name: &str,
) -> Result<(PathBuf, Option<DatasetError>), DatasetError> {
    let name = if dir.join(name).is_file() { name.to_owned() } else { name.replace('\\', "/") };
    let has_drive =
        matches!(name.as_bytes(), [drive, b':', rest @ ..] if drive.is_ascii_alphabetic() && rest.starts_with(b"/"));
    let (mut relative, mut above) = (PathBuf::new(), usize::from(has_drive) * 2);
    for component in Path::new(&name).components() {
        match component {
            Component::Normal(part) => relative.push(part),
            Component::CurDir => {}
            Component::ParentDir => above += usize::from(!relative.pop()),
            Component::RootDir | Component::Prefix(_) => above = 2,
        }
    }
    let path = match above {
        0 => dir.join(relative),
        1 => dir.join("..").join(relative),
        _ => {
            let rule =
                "must be relative, and at most one folder above the dataset's: no leading `/` and one `..` at most";
            return Err(place.error(key, rule));
        }
    };
    let with_ending = |ending: &&str| PathBuf::from(format!("{}.{ending}", path.display()));
    if path.is_file() {
        return Ok((path, None));
    }
    if let Some(found) = ENDINGS.iter().map(with_ending).find(|path| path.is_file()) {
        return Ok((found, None));
    }
    let wanted = if path.extension().is_none() { with_ending(&"png") } else { path };
    let missing = place.error(key, format!("there is no file {}", wanted.display()));
    Ok((wanted, Some(missing)))
}

/// A frame's maps, and where they are: its own keys have precedence over those at top level.
pub(crate) struct Keys<'a> {
    pub place: &'a Place<'a>,
    pub frame: &'a Map<String, Value>,
    pub top: &'a Map<String, Value>,
}

/// Source of a camera's size.
#[derive(Clone, Copy, PartialEq, Eq)]
enum SizeOf {
    /// The keys `w` and `h`.
    Keys,
    /// The image.
    Image,
    /// Neither: the image cannot be read, and the frame is not used.
    Nothing,
}

impl Keys<'_> {
    fn number(&self, key: &str) -> Result<Option<f64>, DatasetError> {
        match self.place.number(self.frame, key)? {
            Some(value) => Ok(Some(value)),
            None => self.place.within("top level".to_owned()).number(self.top, key),
        }
    }

    fn side_px(&self, key: &str) -> Result<Option<u32>, DatasetError> {
        match self.number(key)? {
            None => Ok(None),
            Some(v) if v.fract() == 0.0 && v >= 1.0 && v <= f64::from(MAX_IMAGE_SIDE_PX) => Ok(Some(v as u32)),
            Some(v) => {
                let allowed = format!("must be a whole number from 1 to {MAX_IMAGE_SIDE_PX} pixels, found {v}");
                Err(self.place.error(key, allowed))
            }
        }
    }

    /// Returns the focal lengths along x and y, pixels. A frame's own angle has precedence over a focal length at top
    /// level. Without a value for y, pixels are square.
    fn focal_lengths_px(&self, width_px: u32, height_px: u32) -> Result<[f64; 2], DatasetError> {
        for (place, map) in [(self.place, self.frame), (&self.place.within("top level".to_owned()), self.top)] {
            let x_px = match place.number(map, "fl_x")? {
                Some(fl) => Some(fl),
                None => self.by_angle(place.number(map, "camera_angle_x")?, "camera_angle_x", width_px)?,
            };
            if let Some(x_px) = x_px {
                let y_px = match self.number("fl_y")? {
                    Some(fl) => Some(fl),
                    None => self.by_angle(place.number(map, "camera_angle_y")?, "camera_angle_y", height_px)?,
                };
                return Ok([x_px, y_px.unwrap_or(x_px)]);
            }
        }
        Err(self.place.error("fl_x", "is missing, and so is `camera_angle_x`; one of them is needed"))
    }

    /// Returns the focal length of an angle of view over a side of the image, pixels.
    fn by_angle(&self, angle: Option<f64>, key: &str, side_px: u32) -> Result<Option<f64>, DatasetError> {
        match angle {
            Some(angle) if !(angle > 0.0 && angle < std::f64::consts::PI) => {
                Err(self.place.error(key, format!("must be above 0 and below pi radians, found {angle}")))
            }
            angle => Ok(angle.map(|angle| f64::from(side_px) / 2.0 / (angle / 2.0).tan())),
        }
    }

    /// Returns the camera. `image_size_px` is the image's size if it can be read; it is only read if the keys do not
    /// contain the size. The second result is true if the rotation was rounded and is now exact.
    pub fn camera(
        &self,
        image_size_px: impl FnOnce() -> Option<(u32, u32)>,
    ) -> Result<(PinholeCamera, bool), DatasetError> {
        let place = self.place;
        let (width_px, height_px, size_of) = match (self.side_px("w")?, self.side_px("h")?) {
            (Some(w), Some(h)) => (w, h, SizeOf::Keys),
            (None, Some(_)) => return Err(place.error("w", "is missing while `h` is given")),
            (Some(_), None) => return Err(place.error("h", "is missing while `w` is given")),
            (None, None) => match image_size_px() {
                Some((w, h)) if w > MAX_IMAGE_SIDE_PX || h > MAX_IMAGE_SIDE_PX => {
                    let limit = format!("{w}x{h} pixels; at most {MAX_IMAGE_SIDE_PX} a side");
                    return Err(place.error("file_path", limit));
                }
                Some((w, h)) => (w, h, SizeOf::Image),
                None => (1, 1, SizeOf::Nothing),
            },
        };
        let [fl_x_px, fl_y_px] = self.focal_lengths_px(width_px, height_px)?;
        let (world_from_camera, exact) = exact_pose(place, read_matrix(place, self.frame)?)?;
        let camera = PinholeCamera {
            width_px,
            height_px,
            fl_x_px,
            fl_y_px,
            cx_px: self.number("cx")?.unwrap_or(f64::from(width_px) / 2.0),
            cy_px: self.number("cy")?.unwrap_or(f64::from(height_px) / 2.0),
            world_from_camera,
        };
        camera.validate().map_err(|error| {
            let key = match &error {
                CameraError::NotFinite(key) | CameraError::NotPositive(key) => key,
                CameraError::NotARotation => "transform_matrix",
            };
            let form = "a camera-to-world matrix is a rotation and a translation over the row 0 0 0 1";
            place.error(key, format!("{error}; {form}"))
        })?;
        if size_of != SizeOf::Nothing {
            self.check_range(&camera)?;
        }
        if size_of == SizeOf::Image {
            self.check_size(&camera)?;
        }
        Ok((camera, !exact))
    }

    /// Checks that the numbers can be those of a camera.
    fn check_range(&self, camera: &PinholeCamera) -> Result<(), DatasetError> {
        let (w, h) = (f64::from(camera.width_px), f64::from(camera.height_px));
        let [least, most] = FIELD_OF_VIEW_DEG;
        for (key, focal, side) in [("fl_x", camera.fl_x_px, w), ("fl_y", camera.fl_y_px, h)] {
            let angle = 2.0 * (side / 2.0 / focal).atan().to_degrees();
            if !(least..=most).contains(&angle) {
                let what = format!("{focal:e} pixels is a field of view of {angle:e} degrees over {side} pixels");
                return Err(self.place.error(key, format!("{what}; allowed are {least} to {most} degrees")));
            }
        }
        for (key, centre, side) in [("cx", camera.cx_px, w), ("cy", camera.cy_px, h)] {
            if (centre / side - 0.5).abs() > MAX_CROPPED {
                let what = format!("is {centre}, far outside of the image of {side} pixels");
                return Err(self.place.error(key, what));
            }
        }
        match camera.position_m().into_iter().find(|x| x.abs() > MAX_POSITION) {
            Some(x) => {
                Err(self.place.error("transform_matrix", format!("has the position {x:e}; at most {MAX_POSITION:e}")))
            }
            None => Ok(()),
        }
    }

    /// Checks that intrinsics without a size can be for images of the size that was found.
    fn check_size(&self, camera: &PinholeCamera) -> Result<(), DatasetError> {
        let (w, h) = (camera.width_px, camera.height_px);
        let other_size = |key: &str, what: String| {
            let remedy = "add `w` and `h`, the size that the intrinsics are for";
            Err(self.place.error(key, format!("{what}, but the image has {w}x{h} pixels; {remedy}")))
        };
        for (key, centre, side) in [("cx", camera.cx_px, w), ("cy", camera.cy_px, h)] {
            if (centre / f64::from(side) - 0.5).abs() > MAX_OFF_CENTRE {
                return other_size(key, format!("is {centre}"));
            }
        }
        // Files with a focal length and an angle contain the width.
        let both = |map: &Map<String, Value>| Some((map.get("fl_x")?.as_f64()?, map.get("camera_angle_x")?.as_f64()?));
        match both(self.frame).or_else(|| both(self.top)).map(|(fl, angle)| 2.0 * fl * (angle / 2.0).tan()) {
            Some(width) if (width / f64::from(w) - 1.0).abs() > 0.02 => {
                other_size("fl_x", format!("is for images {width:.0} pixels wide by `camera_angle_x`"))
            }
            _ => Ok(()),
        }
    }
}

fn read_matrix(place: &Place, frame: &Map<String, Value>) -> Result<[[f64; 4]; 4], DatasetError> {
    let matrix = present(frame, "transform_matrix").ok_or_else(|| place.error("transform_matrix", "is missing"))?;
    let rows: Option<Vec<[f64; 4]>> =
        matrix.as_array().and_then(|rows| rows.iter().map(numbers::<4>).collect::<Option<_>>());
    rows.and_then(|rows| rows.try_into().ok())
        .ok_or_else(|| place.error("transform_matrix", "must be 4 rows of 4 finite numbers"))
}

type Columns = [[f64; 3]; 3];

/// Returns the pose with the nearest rotation if its numbers are rounded, and true if it was exact before. Scaled and
/// mirrored matrices are errors with their numbers; other errors are left to the camera's own check.
fn exact_pose(place: &Place, matrix: [[f64; 4]; 4]) -> Result<([[f64; 4]; 4], bool), DatasetError> {
    let columns = [0, 1, 2].map(|j| [0, 1, 2].map(|i| matrix[i][j]));
    let determinant = dot(cross(columns[0], columns[1]), columns[2]);
    let lengths = columns.map(|c| dot(c, c).sqrt());
    let deviation = deviation(&columns);
    if deviation < 1e-3 && determinant > 0.0 || !lengths.iter().all(|l| l.is_finite() && *l > 1e-9) {
        return Ok((matrix, true));
    }
    if deviation <= ROUNDING && determinant > 0.0 {
        let rotation = nearest_rotation(columns);
        let mut pose = matrix;
        (0..9).for_each(|i| pose[i % 3][i / 3] = rotation[i / 3][i % 3]);
        return Ok((pose, false));
    }
    let unit = [0, 1, 2].map(|j| columns[j].map(|v| v / lengths[j]));
    let wrong = |what: String| Err(place.error("transform_matrix", what));
    if self::deviation(&unit) > ROUNDING {
        return Ok((matrix, true));
    }
    if determinant < 0.0 {
        return wrong(format!(
            "is mirrored: its determinant is {determinant:.4}, and that of a rotation is 1; negate one axis"
        ));
    }
    let [x, y, z] = lengths;
    let remedy = "divide the columns of its rotation by that";
    if (x / y - 1.0).abs() < ROUNDING && (x / z - 1.0).abs() < ROUNDING {
        return wrong(format!("is scaled by {:.6}; {remedy}", determinant.cbrt()));
    }
    wrong(format!("is scaled by {x:.6}, {y:.6} and {z:.6} along its axes; {remedy}"))
}

/// Returns the largest deviation of the columns' products from those of a rotation.
fn deviation(columns: &Columns) -> f64 {
    let products = (0..9).map(|i| dot(columns[i / 3], columns[i % 3]) - f64::from(u8::from(i / 3 == i % 3)));
    products.map(f64::abs).fold(0.0, f64::max)
}

/// Returns the nearest rotation: the mean of the matrix and its inverse's transpose converges to it (Higham 1986).
fn nearest_rotation(mut columns: Columns) -> Columns {
    for _ in 0..10 {
        let [x, y, z] = columns;
        let determinant = dot(cross(x, y), z);
        let inverse = [cross(y, z), cross(z, x), cross(x, y)];
        columns = [0, 1, 2].map(|j| [0, 1, 2].map(|i| f64::midpoint(columns[j][i], inverse[j][i] / determinant)));
    }
    columns
}
