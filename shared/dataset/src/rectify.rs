//! The precomputed map from a real camera's image to the image that the trained camera would have taken.

use carff_base::geometry::PinholeCamera;

use crate::calibration::{CalibrationError, CameraCalibration};
use crate::lens::neighbours;
use crate::raw::RawImage;

/// Sum of a pixel's weights.
const WHOLE: u32 = 1 << 15;
/// Largest number of samples of a pixel along each axis, where the camera has more pixels than the result.
const MAX_SAMPLES: u32 = 16;

/// A pixel of the camera's image, and its share of a pixel of the result.
#[derive(Clone, Copy, Debug)]
struct Tap {
    x: u16,
    y: u16,
    weight: u16,
}

/// Rectifies, crops and scales a camera's images to a pinhole camera's field of view and size.
///
/// ```
/// use carff_base::geometry::PinholeCamera;
/// use carff_dataset::{CameraCalibration, DistortionModel, RawImage, Rectifier};
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// let trained = PinholeCamera::look_at([0.0; 3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 32, 32, 60.0);
/// let calibration = CameraCalibration {
///     width_px: 64, height_px: 64, fl_x_px: 50.0, fl_y_px: 50.0, cx_px: 31.5, cy_px: 31.5,
///     model: DistortionModel::PlumbBob, distortion: vec![-0.1, 0.01],
/// };
/// let rectifier = Rectifier::new(&calibration, &trained)?;
/// let (camera_bytes, mut image) = (vec![7; 64 * 64 * 3], vec![0; 32 * 32 * 3]);
/// rectifier.write(&RawImage::rgb([64, 64], &camera_bytes)?, &mut image)?;
/// assert!(image.iter().all(|&value| value == 7));
/// # Ok(())
/// # }
/// ```
#[derive(Clone, Debug)]
pub struct Rectifier {
    calibrated_px: [u32; 2],
    trained: PinholeCamera,
    /// The taps of each pixel of the result, row by row; each pixel has the same number.
    taps: Vec<Tap>,
    taps_per_pixel: usize,
}

impl Rectifier {
    /// Computes the map from a calibrated camera to the trained one.
    ///
    /// # Errors
    ///
    /// If the lens does not show the whole field of view of the trained camera.
    pub fn new(calibration: &CameraCalibration, trained: &PinholeCamera) -> Result<Self, CalibrationError> {
        calibration.check()?;
        let (lens, sensor) = (calibration.lens(), calibration.sensor());
        let scale = (sensor.fl_x_px / trained.fl_x_px).max(sensor.fl_y_px / trained.fl_y_px);
        let across = (scale.ceil() as u32).clamp(1, MAX_SAMPLES);
        let position = lens.mapping(trained, &sensor);
        let (w, h) = (f64::from(sensor.width_px), f64::from(sensor.height_px));
        let shown = |u: f64, v: f64| {
            position(u, v).filter(|[u, v]| *u > -1.0 && *v > -1.0 && *u < w && *v < h).ok_or_else(|| {
                CalibrationError::FieldOfView {
                    lens_deg: lens.field_of_view_deg(&sensor),
                    trained_deg: trained.field_of_view_deg(),
                }
            })
        };
        let mut taps = Vec::new();
        for (y, x) in (0..trained.height_px).flat_map(|y| (0..trained.width_px).map(move |x| (y, x))) {
            for (j, i) in (0..across).flat_map(|j| (0..across).map(move |i| (j, i))) {
                let inside = |pixel: u32, sample: u32| f64::from(pixel) + (f64::from(sample) + 0.5) / f64::from(across);
                let at = shown(inside(x, i), inside(y, j))?;
                taps.extend(taps_at(at, &sensor, across));
            }
        }
        let taps_per_pixel = taps.len() / (trained.width_px * trained.height_px) as usize;
        taps.chunks_exact_mut(taps_per_pixel).for_each(complete);
        Ok(Self { calibrated_px: calibration.size_px(), trained: *trained, taps, taps_per_pixel })
    }

    /// Returns the camera of the results.
    pub fn camera(&self) -> &PinholeCamera {
        &self.trained
    }

    /// Returns an error if the image has another size than the calibration.
    pub fn check(&self, raw: &RawImage<'_>) -> Result<(), CalibrationError> {
        let (found_px, calibrated_px) = (raw.size_px(), self.calibrated_px);
        if found_px == calibrated_px { Ok(()) } else { Err(CalibrationError::Size { found_px, calibrated_px }) }
    }

    /// Writes the rectified image; `out` has the bytes of [`Self::camera`]'s images.
    ///
    /// # Errors
    ///
    /// As [`Self::check`].
    pub fn write(&self, raw: &RawImage<'_>, out: &mut [u8]) -> Result<(), CalibrationError> {
        self.check(raw)?;
        for (pixel, taps) in out.chunks_exact_mut(3).zip(self.taps.chunks_exact(self.taps_per_pixel)) {
            let mut sum = [WHOLE / 2; 3];
            for tap in taps {
                let colour = raw.pixel(tap.x.into(), tap.y.into());
                for (sum, value) in sum.iter_mut().zip(colour) {
                    *sum += u32::from(value) * u32::from(tap.weight);
                }
            }
            pixel.copy_from_slice(&sum.map(|sum| (sum / WHOLE) as u8));
        }
        Ok(())
    }
}

/// Returns the pixels at a position: the four nearest, weighted, for a single sample; one of several samples takes the
/// nearest.
fn taps_at([u, v]: [f64; 2], sensor: &PinholeCamera, across: u32) -> Vec<Tap> {
    let (w, h) = (sensor.width_px as usize, sensor.height_px as usize);
    let tap = |pixel: usize, weight: f64| Tap {
        x: (pixel % w) as u16,
        y: (pixel / w) as u16,
        weight: (weight * f64::from(WHOLE)).round() as u16,
    };
    if across > 1 {
        let (pixels, _) = neighbours(u.round(), v.round(), w, h);
        return vec![tap(pixels[0], 1.0 / f64::from(across * across))];
    }
    let (pixels, [a, b]) = neighbours(u, v, w, h);
    let weights = [(1.0 - a) * (1.0 - b), a * (1.0 - b), (1.0 - a) * b, a * b];
    pixels.into_iter().zip(weights).map(|(pixel, weight)| tap(pixel, weight)).collect()
}

/// Adds what rounding has left over to the largest weight of a pixel.
fn complete(taps: &mut [Tap]) {
    let sum: u32 = taps.iter().map(|tap| u32::from(tap.weight)).sum();
    if let Some(largest) = taps.iter_mut().max_by_key(|tap| tap.weight) {
        largest.weight = (u32::from(largest.weight) + WHOLE).saturating_sub(sum) as u16;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::DistortionModel;
    use crate::image::Image;

    fn trained(side_px: u32, fov_deg: f64) -> PinholeCamera {
        PinholeCamera::look_at([0.0; 3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], side_px, side_px, fov_deg)
    }

    fn calibration(side_px: u32, fl_px: f64, model: DistortionModel, distortion: &[f64]) -> CameraCalibration {
        let centre = f64::from(side_px) / 2.0 - 0.5;
        CameraCalibration {
            width_px: side_px,
            height_px: side_px,
            fl_x_px: fl_px,
            fl_y_px: fl_px,
            cx_px: centre,
            cy_px: centre,
            model,
            distortion: distortion.to_vec(),
        }
    }

    /// A camera that equals the trained one passes each pixel unchanged.
    #[test]
    fn the_same_camera_changes_nothing() {
        let camera = trained(24, 60.0);
        let same = calibration(24, camera.fl_x_px, DistortionModel::Pinhole, &[]);
        let image: Vec<u8> = (0..24 * 24 * 3).map(|i| (i * 7 % 251) as u8).collect();
        let mut out = vec![0; image.len()];
        Rectifier::new(&same, &camera).unwrap().write(&RawImage::rgb([24, 24], &image).unwrap(), &mut out).unwrap();
        assert_eq!(out, image);
    }

    /// A dot at the position at which the lens shows a direction moves to the position at which the trained camera shows
    /// it, for each lens, with another size and field of view.
    #[test]
    fn directions_arrive_where_the_trained_camera_shows_them() {
        let camera = trained(64, 60.0);
        let (x, y): (f64, f64) = (0.3, -0.22);
        let (r, wanted) = (x.hypot(y), [x * camera.fl_x_px + 32.0, y * camera.fl_y_px + 32.0]);
        let theta = r.atan();
        let lenses = [
            (DistortionModel::Pinhole, vec![], 1.0),
            (DistortionModel::PlumbBob, vec![-0.2, 0.03], 1.0 - 0.2 * r * r + 0.03 * r.powi(4)),
            (
                DistortionModel::Fisheye,
                vec![0.02, -0.003],
                theta * (1.0 + 0.02 * theta.powi(2) - 0.003 * theta.powi(4)) / r,
            ),
        ];
        for (model, distortion, scale) in lenses {
            let calibration = calibration(320, 200.0, model, &distortion);
            let mut image = Image::filled(320, 320, [0; 3]);
            let dot = [x * scale * 200.0 + 160.0, y * scale * 200.0 + 160.0];
            for (i, pixel) in image.rgb.chunks_exact_mut(3).enumerate() {
                let (u, v) = ((i % 320) as f64 + 0.5, (i / 320) as f64 + 0.5);
                let distance = (u - dot[0]).hypot(v - dot[1]);
                pixel.fill((255.0 * (-distance * distance / 50.0).exp()) as u8);
            }
            let mut out = vec![0; 64 * 64 * 3];
            let raw = RawImage::rgb([320, 320], &image.rgb).unwrap();
            Rectifier::new(&calibration, &camera).unwrap().write(&raw, &mut out).unwrap();
            let (mut sum, mut at) = (0.0, [0.0; 2]);
            for (i, pixel) in out.chunks_exact(3).enumerate() {
                let weight = f64::from(pixel[0]);
                sum += weight;
                at = [at[0] + weight * ((i % 64) as f64 + 0.5), at[1] + weight * ((i / 64) as f64 + 0.5)];
            }
            let found = at.map(|v| v / sum);
            assert!((0..2).all(|i| (found[i] - wanted[i]).abs() < 0.3), "{model:?}: {found:?} {wanted:?}");
        }
    }

    /// A lens that shows less than the trained camera is refused with both fields of view, and so is an image of another
    /// size.
    #[test]
    fn narrow_lenses_and_other_sizes_are_refused() {
        let camera = trained(64, 60.0);
        // 2 atan(50 / 100) is 53 degrees.
        let narrow = calibration(100, 100.0, DistortionModel::Pinhole, &[]);
        let error = Rectifier::new(&narrow, &camera).unwrap_err().to_string();
        assert!(error.contains("53.1 x 53.1") && error.contains("60.0 x 60.0"), "{error}");
        // A barrel lens whose polynomial turns back before the trained corner.
        let turning = calibration(400, 200.0, DistortionModel::PlumbBob, &[-1.5]);
        assert!(Rectifier::new(&turning, &camera).is_err());
        let wide = calibration(400, 200.0, DistortionModel::Pinhole, &[]);
        let rectifier = Rectifier::new(&wide, &camera).unwrap();
        let small = vec![0; 200 * 200 * 3];
        let raw = RawImage::rgb([200, 200], &small).unwrap();
        let error = rectifier.write(&raw, &mut vec![0; 64 * 64 * 3]).unwrap_err().to_string();
        assert!(error.contains("200x200") && error.contains("400x400"), "{error}");
    }

    /// Detail that is finer than a pixel of the result is averaged and does not alias.
    #[test]
    fn fine_detail_is_averaged() {
        let camera = trained(16, 60.0);
        let sharp = calibration(256, 16.0 * camera.fl_x_px, DistortionModel::Pinhole, &[]);
        let stripes: Vec<u8> = (0..256 * 256).flat_map(|i| [if i % 2 == 0 { 0 } else { 200 }; 3]).collect();
        let mut out = vec![0; 16 * 16 * 3];
        let raw = RawImage::rgb([256, 256], &stripes).unwrap();
        Rectifier::new(&sharp, &camera).unwrap().write(&raw, &mut out).unwrap();
        assert!(out.iter().all(|v| (85..=115).contains(v)), "{out:?}");
    }
}
