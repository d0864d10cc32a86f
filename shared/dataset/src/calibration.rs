//! Calibrations: the lens and the intrinsics of a real camera, from a graph file or from ROS.

use carff_base::geometry::PinholeCamera;
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};
use std::path::{Path, PathBuf};

use crate::lens::Lens;
use crate::raw::MAX_SIDE_PX;

/// Model of a lens's distortion, with ROS's names.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum DistortionModel {
    /// No distortion.
    #[default]
    Pinhole,
    /// Brown and Conrady: k1, k2, p1, p2, k3.
    PlumbBob,
    /// Kannala and Brandt, also called equidistant: k1, k2, k3, k4.
    #[serde(alias = "equidistant")]
    Fisheye,
}

/// Calibration of a camera, with the numbers that ROS and `OpenCV` print: the centre of the top left pixel is at 0.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct CameraCalibration {
    /// Width of the calibrated images, pixels, 1 to 8192.
    #[schemars(range(min = 1, max = 8192))]
    pub width_px: u32,
    /// Height of the calibrated images, pixels, 1 to 8192.
    #[schemars(range(min = 1, max = 8192))]
    pub height_px: u32,
    /// Focal length along x, pixels.
    pub fl_x_px: f64,
    /// Focal length along y, pixels.
    pub fl_y_px: f64,
    /// Principal point, x, pixels.
    pub cx_px: f64,
    /// Principal point, y, pixels.
    pub cy_px: f64,
    /// Distortion model: `pinhole`, `plumb_bob`, or `fisheye` (also `equidistant`). Default `pinhole`.
    #[serde(default)]
    pub model: DistortionModel,
    /// Coefficients of the model: none, k1 k2 p1 p2 k3, or k1 k2 k3 k4; missing ones are 0. Default: none.
    #[serde(default)]
    pub distortion: Vec<f64>,
}

/// Reason why a calibration cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum CalibrationError {
    /// The file cannot be read.
    #[error("cannot read the calibration {}: {source}{}", path.display(), carff_base::names::beside(path))]
    Read {
        /// Path of the file.
        path: PathBuf,
        /// Error of the system.
        source: std::io::Error,
    },
    /// The file is not a ROS `camera_info`.
    #[error("{}: not a ROS camera_info file: {problem}", path.display())]
    Yaml {
        /// Path of the file.
        path: PathBuf,
        /// The error.
        problem: String,
    },
    /// A value is missing or out of range.
    #[error("the calibration's `{key}` is {value}; {allowed}")]
    Value {
        /// Name of the key.
        key: &'static str,
        /// The value found.
        value: String,
        /// The allowed values.
        allowed: &'static str,
    },
    /// The lens does not show all of the field of view.
    #[error(
        "the calibrated lens shows {:.1} x {:.1} degrees, but the checkpoint was trained for {:.1} x {:.1}: use a wider \
         lens, or train with the field of view of this one",
        .lens_deg[0], .lens_deg[1], .trained_deg[0], .trained_deg[1]
    )]
    FieldOfView {
        /// Field of view of the lens, degrees.
        lens_deg: [f64; 2],
        /// Field of view that is needed, degrees.
        trained_deg: [f64; 2],
    },
    /// An image has another size than the calibration.
    #[error(
        "an image of {}x{} pixels, but the calibration is for {}x{}: calibrate at the size that the camera delivers",
        .found_px[0], .found_px[1], .calibrated_px[0], .calibrated_px[1]
    )]
    Size {
        /// Size of the image.
        found_px: [u32; 2],
        /// Size of the calibration.
        calibrated_px: [u32; 2],
    },
}

/// A matrix of a `camera_info` file: with its size, or as a plain list.
#[derive(Debug, Deserialize)]
#[serde(untagged)]
enum Matrix {
    Sized { data: Vec<f64> },
    List(Vec<f64>),
}

impl Matrix {
    fn data(self) -> Vec<f64> {
        match self {
            Self::Sized { data } | Self::List(data) => data,
        }
    }
}

/// A `camera_info` file of a calibrator, or a message as `ros2 topic echo` prints it.
#[derive(Debug, Deserialize)]
struct CameraInfo {
    #[serde(alias = "width")]
    image_width: u32,
    #[serde(alias = "height")]
    image_height: u32,
    #[serde(default)]
    distortion_model: String,
    #[serde(alias = "k", alias = "K")]
    camera_matrix: Matrix,
    #[serde(default, alias = "d", alias = "D")]
    distortion_coefficients: Option<Matrix>,
}

impl CameraCalibration {
    /// Reads a ROS `camera_info` YAML file.
    pub fn load(path: &Path) -> Result<Self, CalibrationError> {
        let text =
            std::fs::read_to_string(path).map_err(|source| CalibrationError::Read { path: path.to_owned(), source })?;
        let wrong = |problem: String| CalibrationError::Yaml { path: path.to_owned(), problem };
        // `ros2 topic echo` ends each message with a line of dashes.
        let text = text.trim_start_matches("---\n").split("\n---").next().unwrap_or_default();
        let info: CameraInfo =
            serde_saphyr::from_str(text).map_err(|e| wrong(e.to_string().lines().next().unwrap_or_default().into()))?;
        let distortion = info.distortion_coefficients.map(Matrix::data).unwrap_or_default();
        Self::of_ros(
            [info.image_width, info.image_height],
            &info.distortion_model,
            &info.camera_matrix.data(),
            &distortion,
        )
    }

    /// Converts the values of ROS's `CameraInfo`: the model's name, `k` (3x3, row by row) and `d`.
    pub fn of_ros(size_px: [u32; 2], model: &str, k: &[f64], d: &[f64]) -> Result<Self, CalibrationError> {
        let value = |key, value: String, allowed| CalibrationError::Value { key, value, allowed };
        let &[fl_x_px, _, cx_px, _, fl_y_px, cy_px, ..] = k else {
            return Err(value("camera_matrix", format!("{} numbers", k.len()), "it has 9"));
        };
        let zero = |values: &[f64]| values.iter().all(|v| v.abs() <= 1e-12);
        let (model, used) = match model {
            // An equidistant lens may have zeros too, and differs from a pinhole.
            "equidistant" | "fisheye" => (DistortionModel::Fisheye, 4),
            "" | "none" | "plumb_bob" | "rational_polynomial" | "thin_prism_model" if zero(d) => {
                (DistortionModel::Pinhole, 0)
            }
            "plumb_bob" => (DistortionModel::PlumbBob, 5),
            // Equal to plumb_bob without its denominator.
            "rational_polynomial" if zero(d.get(5..).unwrap_or_default()) => (DistortionModel::PlumbBob, 5),
            other => {
                let allowed = "supported are plumb_bob and equidistant (fisheye): calibrate with one of them";
                return Err(value("distortion_model", format!("`{other}`"), allowed));
            }
        };
        let [width_px, height_px] = size_px;
        let distortion = if used == 0 { Vec::new() } else { d.iter().copied().take(used.max(1)).collect() };
        if !zero(d.get(used..).unwrap_or_default()) && used > 0 {
            return Err(value("distortion_coefficients", format!("{} numbers", d.len()), "the model has fewer"));
        }
        let calibration = Self { width_px, height_px, fl_x_px, fl_y_px, cx_px, cy_px, model, distortion };
        calibration.check().map(|()| calibration)
    }

    /// Checks the values.
    pub fn check(&self) -> Result<(), CalibrationError> {
        let value = |key, value: String, allowed| Err(CalibrationError::Value { key, value, allowed });
        for (key, side) in [("width_px", self.width_px), ("height_px", self.height_px)] {
            if !(1..=MAX_SIDE_PX).contains(&side) {
                return value(key, side.to_string(), "allowed are 1 to 8192");
            }
        }
        for (key, focal) in [("fl_x_px", self.fl_x_px), ("fl_y_px", self.fl_y_px)] {
            if !(focal.is_finite() && focal > 0.0) {
                return value(key, focal.to_string(), "a focal length is finite and above 0");
            }
        }
        for (key, centre, side) in [("cx_px", self.cx_px, self.width_px), ("cy_px", self.cy_px, self.height_px)] {
            if !(0.0..=f64::from(side)).contains(&centre) {
                return value(key, centre.to_string(), "the principal point is inside the image");
            }
        }
        let most = match self.model {
            DistortionModel::Pinhole => 0,
            DistortionModel::PlumbBob => 5,
            DistortionModel::Fisheye => 4,
        };
        if self.distortion.len() > most || self.distortion.iter().any(|v| !v.is_finite()) {
            return value(
                "distortion",
                format!("{:?}", self.distortion),
                "allowed are finite numbers: none for pinhole, at most 5 for plumb_bob, at most 4 for fisheye",
            );
        }
        Ok(())
    }

    /// Returns the size of the calibrated images, pixels.
    pub fn size_px(&self) -> [u32; 2] {
        [self.width_px, self.height_px]
    }

    /// Returns the intrinsics as a camera at the origin.
    pub(crate) fn sensor(&self) -> PinholeCamera {
        let world_from_camera = [0, 1, 2, 3].map(|i| [0, 1, 2, 3].map(|j| f64::from(u8::from(i == j))));
        PinholeCamera {
            width_px: self.width_px,
            height_px: self.height_px,
            fl_x_px: self.fl_x_px,
            fl_y_px: self.fl_y_px,
            // Ours count a pixel's centre at +0.5.
            cx_px: self.cx_px + 0.5,
            cy_px: self.cy_px + 0.5,
            world_from_camera,
        }
    }

    pub(crate) fn lens(&self) -> Lens {
        let d = |i: usize| self.distortion.get(i).copied().unwrap_or(0.0);
        match self.model {
            DistortionModel::Pinhole => Lens::Pinhole,
            DistortionModel::PlumbBob => {
                Lens::Perspective { radial: [d(0), d(1), d(4), 0.0], tangential: [d(2), d(3)] }
            }
            DistortionModel::Fisheye => Lens::Fisheye([d(0), d(1), d(2), d(3)]),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CALIBRATOR: &str = "image_width: 640\nimage_height: 480\ncamera_name: front\ncamera_matrix:\n  rows: 3\n  \
        cols: 3\n  data: [438.7, 0.0, 305.5, 0.0, 437.3, 243.7, 0.0, 0.0, 1.0]\ndistortion_model: plumb_bob\n\
        distortion_coefficients:\n  rows: 1\n  cols: 5\n  data: [-0.36, 0.11, 0.001, 0.0005, 0.0]\n\
        rectification_matrix:\n  rows: 3\n  cols: 3\n  data: [1, 0, 0, 0, 1, 0, 0, 0, 1]\n";
    const ECHOED: &str = "header:\n  frame_id: cam\nheight: 480\nwidth: 640\ndistortion_model: equidistant\nd:\n- 0.1\n\
        - 0.0\n- 0.0\n- 0.0\nk:\n- 400.0\n- 0.0\n- 319.5\n- 0.0\n- 400.0\n- 239.5\n- 0.0\n- 0.0\n- 1.0\n---\nheight: 1\n";

    fn load(text: &str) -> Result<CameraCalibration, CalibrationError> {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("camera.yaml");
        std::fs::write(&path, text).unwrap();
        CameraCalibration::load(&path)
    }

    /// The files of calibrators and the text of `ros2 topic echo` are read.
    #[test]
    fn files_of_ros_are_read() {
        let plumb_bob = load(CALIBRATOR).unwrap();
        assert_eq!((plumb_bob.size_px(), plumb_bob.fl_x_px, plumb_bob.cy_px), ([640, 480], 438.7, 243.7));
        assert_eq!((plumb_bob.model, plumb_bob.distortion[1]), (DistortionModel::PlumbBob, 0.11));
        let fisheye = load(ECHOED).unwrap();
        assert_eq!((fisheye.model, fisheye.distortion.len()), (DistortionModel::Fisheye, 4));
        let zeros = CALIBRATOR.replace("[-0.36, 0.11, 0.001, 0.0005, 0.0]", "[0, 0, 0, 0, 0]");
        assert_eq!(load(&zeros).unwrap().model, DistortionModel::Pinhole);
        // An equidistant lens with coefficients of zero bends as well.
        let equidistant = load(&ECHOED.replace("- 0.1\n", "- 0.0\n")).unwrap();
        assert_eq!(equidistant.model, DistortionModel::Fisheye);
        assert_eq!(equidistant.lens(), Lens::Fisheye([0.0; 4]));
        let other = load(&zeros.replace("plumb_bob", "omnidirectional")).unwrap_err().to_string();
        assert!(other.contains("`distortion_model` is `omnidirectional`"), "{other}");
    }

    /// Wrong files are errors that name the file or the key.
    #[test]
    fn wrong_files_are_refused() {
        for (text, words) in [
            ("not: a calibration\n", "camera.yaml"),
            (": [", "camera.yaml"),
            ("", "camera.yaml"),
            (&CALIBRATOR.replace("plumb_bob", "thin_prism"), "`distortion_model` is `thin_prism`"),
            (&CALIBRATOR.replace("640", "0"), "`width_px` is 0"),
            (&CALIBRATOR.replace("438.7", ".nan"), "line 7"),
            (&CALIBRATOR.replace("438.7", "-1"), "`fl_x_px` is -1"),
            (&CALIBRATOR.replace("305.5", "900"), "`cx_px` is 900"),
            (&CALIBRATOR.replace("[438.7, 0.0, 305.5, 0.0, 437.3, 243.7, 0.0, 0.0, 1.0]", "[1]"), "`camera_matrix`"),
        ] {
            let error = load(text).unwrap_err().to_string();
            assert!(error.contains(words), "{words}: {error}");
        }
        let missing = CameraCalibration::load(Path::new("no/such/file.yaml")).unwrap_err().to_string();
        assert!(missing.contains("no/such/file.yaml"), "{missing}");
    }
}
