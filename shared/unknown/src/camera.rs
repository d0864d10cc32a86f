//! The condition of a camera, from its images: no network and no pose is needed.

use carff_messages::{ImageCheck, ImageCondition};
use ndarray::{Array2, ArrayView3, Axis, Zip, s};
use serde::{Deserialize, Serialize};

/// Cells along each side of the grid in which covered parts are found.
const CELLS: usize = 12;
/// Luminance (0..=1) below which a whole image is black, and above which it is white.
const BLACK: f32 = 0.03;
const WHITE: f32 = 0.97;
/// Largest deviation of a cell without detail, of 255, and its largest luminance if it is covered.
const FLAT: f32 = 4.0;
const DARK: f32 = 0.14;
/// Share of the image that may be dark and without detail, beyond that of trained images.
const COVERED_BEYOND: f32 = 0.06;
/// Share of the trained images' smallest sharpness below which an image is out of focus.
const LEAST_SHARPNESS: f32 = 0.12;
/// Factors of the trained images' darkest and brightest mean luminance.
const DARKER: f32 = 0.35;
const BRIGHTER_REST: f32 = 0.25;
/// Mean absolute difference, of 255, up to which two images are the same one, beyond any sensor's noise.
const SAME: f32 = 0.3;
/// Largest relative difference of the fields of view.
const LENS: f64 = 0.1;
/// Longest step forward of the capture time against the clock, nanoseconds: the image is older than that.
const LATE_NS: u64 = 2_000_000_000;

/// Statistics of images of a camera in order.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CameraLimits {
    /// Smallest and largest mean luminance, 0..=1.
    pub luminance: [f32; 2],
    /// Smallest and median contrast of fine detail.
    pub sharpness: [f32; 2],
    /// Largest share of the image that is dark and without detail.
    pub covered: f32,
    /// Horizontal and vertical field of view, degrees.
    pub field_of_view_deg: [f64; 2],
}

/// Measurements of one image.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Measured {
    /// Mean luminance, 0..=1.
    pub luminance: f32,
    /// Contrast of fine detail: mean absolute Laplacian against the image's deviation.
    pub sharpness: f32,
    /// Share of the image that is dark and without detail, 0..=1.
    pub covered: f32,
}

impl Measured {
    /// Measures an image (height, width, channel).
    ///
    /// ```
    /// use carff_unknown::Measured;
    /// let black = ndarray::Array3::zeros((48, 64, 3));
    /// assert_eq!(Measured::of(black.view()).luminance, 0.0);
    /// ```
    pub fn of(image: ArrayView3<'_, u8>) -> Self {
        Self::of_luminance(&luminances(image))
    }

    fn of_luminance(luminance: &Array2<f32>) -> Self {
        let (height, width) = luminance.dim();
        if height < 3 || width < 3 {
            return Self::default();
        }
        let mean = luminance.iter().sum::<f32>() / luminance.len() as f32;
        let deviation = (luminance.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / luminance.len() as f32).sqrt();
        Self {
            luminance: (mean / 255.0).clamp(0.0, 1.0),
            sharpness: detail(luminance) / deviation.max(1.0),
            covered: covered(luminance),
        }
    }
}

/// Luminance of each pixel (height, width), 0..=255.
fn luminances(image: ArrayView3<'_, u8>) -> Array2<f32> {
    let [red, green, blue] = [0, 1, 2].map(|channel| image.index_axis(Axis(2), channel));
    Zip::from(red).and(green).and(blue).map_collect(|&r, &g, &b| {
        let [r, g, b] = [r, g, b].map(f32::from);
        0.299 * r + 0.587 * g + 0.114 * b
    })
}

/// Mean absolute Laplacian over cells of 2 x 2 pixels, which averages the sensor's noise.
fn detail(luminance: &Array2<f32>) -> f32 {
    let (height, width) = luminance.dim();
    let cells = Array2::from_shape_fn((height / 2, width / 2), |(y, x)| {
        let at = |dy, dx| luminance[[2 * y + dy, 2 * x + dx]];
        0.25 * (at(0, 0) + at(0, 1) + at(1, 0) + at(1, 1))
    });
    let (mut sum, mut n) = (0.0, 0);
    for block in cells.windows((3, 3)) {
        sum += (4.0 * block[[1, 1]] - block[[1, 0]] - block[[1, 2]] - block[[0, 1]] - block[[2, 1]]).abs();
        n += 1;
    }
    sum / n.max(1) as f32
}

/// Share of the cells that are dark and without detail.
fn covered(luminance: &Array2<f32>) -> f32 {
    let (height, width) = luminance.dim();
    let (columns, rows) = (CELLS.min(width), CELLS.min(height));
    let is_covered = |cell: usize| {
        let (cx, cy) = (cell % columns, cell / columns);
        let (x, y) = (cx * width / columns..(cx + 1) * width / columns, cy * height / rows..(cy + 1) * height / rows);
        let cell = luminance.slice(s![y, x]);
        let n = cell.len().max(1) as f32;
        let mean = cell.iter().sum::<f32>() / n;
        let deviation = (cell.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n).sqrt();
        mean < DARK * 255.0 && deviation < FLAT
    };
    (0..columns * rows).filter(|&cell| is_covered(cell)).count() as f32 / (columns * rows) as f32
}

impl CameraLimits {
    /// Fits on measurements of images of a camera in order, with its field of view in degrees. Without images nothing
    /// is refused but black and white ones.
    pub fn fit(measured: &[Measured], field_of_view_deg: [f64; 2]) -> Self {
        let values = |of: fn(&Measured) -> f32| {
            let mut values: Vec<f32> = measured.iter().map(of).collect();
            values.sort_by(f32::total_cmp);
            values
        };
        let (luminance, sharpness, covered) = (values(|m| m.luminance), values(|m| m.sharpness), values(|m| m.covered));
        let of = |values: &[f32], index: usize, default: f32| values.get(index).copied().unwrap_or(default);
        Self {
            luminance: [of(&luminance, 0, 0.0), luminance.last().copied().unwrap_or(1.0)],
            sharpness: [of(&sharpness, 0, 0.0), of(&sharpness, sharpness.len() / 2, 1.0)],
            covered: covered.last().copied().unwrap_or(1.0),
            field_of_view_deg,
        }
    }
}

/// Measurements of a frame that are not in its image.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measurement {
    /// Capture time: monotonic clock, nanoseconds.
    pub capture_time_ns: u64,
    /// The clock's time at which the frame is checked, nanoseconds.
    pub now_ns: u64,
    /// Horizontal and vertical field of view, degrees.
    pub field_of_view_deg: [f64; 2],
    /// False for a frame without the pose that its comparison needs.
    pub has_pose: bool,
}

/// The check of a camera over its frames.
#[derive(Clone, Debug)]
pub struct CameraCheck {
    limits: Option<CameraLimits>,
    /// Time for which an image may repeat, nanoseconds; `None` switches the check off.
    frozen_ns: Option<u64>,
    /// The image before, its capture time, and the capture time since which the image repeats.
    before: Option<Before>,
}

#[derive(Clone, Debug)]
struct Before {
    luminance: Array2<f32>,
    capture_time_ns: u64,
    same_since_ns: u64,
}

impl CameraCheck {
    /// Creates the check. Without limits, only black, white and frozen images and the clock are checked. A camera is
    /// frozen when its image repeats for `frozen_ns` while capture times advance; `None` accepts repeated images, as a
    /// camera of rendered images without sensor noise sends them.
    pub fn new(limits: Option<CameraLimits>, frozen_ns: Option<u64>) -> Self {
        Self { limits, frozen_ns, before: None }
    }

    /// Checks a frame and writes condition and measurements to `check`.
    pub fn check(&mut self, image: ArrayView3<'_, u8>, frame: Measurement, check: &mut ImageCheck) {
        let luminance = luminances(image);
        let measured = Measured::of_luminance(&luminance);
        check.luminance = measured.luminance;
        check.covered = measured.covered;
        let median = self.limits.map_or(1.0, |limits| limits.sharpness[1]);
        check.sharpness = measured.sharpness / median.max(1e-6);
        let clock = self.clock(frame);
        let same_since_ns = self.same_since_ns(&luminance, frame.capture_time_ns, check);
        self.before = Some(Before { luminance, capture_time_ns: frame.capture_time_ns, same_since_ns });
        let repeats_ns = frame.capture_time_ns.saturating_sub(same_since_ns);
        let frozen = self.frozen_ns.is_some_and(|limit_ns| repeats_ns >= limit_ns);
        check.repeats_s = (repeats_ns as f64 * 1e-9) as f32;
        let condition = clock
            .or((!frame.has_pose).then_some(ImageCondition::NoPose))
            .or_else(|| lens(self.limits, frame))
            .or_else(|| exposure(self.limits, &measured))
            .or(frozen.then_some(ImageCondition::Frozen))
            .or_else(|| focus(self.limits, &measured));
        check.condition = condition.unwrap_or(ImageCondition::Usable).code();
    }

    /// Capture times must advance, and be near the clock.
    fn clock(&self, frame: Measurement) -> Option<ImageCondition> {
        let stands = self.before.as_ref().is_some_and(|before| frame.capture_time_ns <= before.capture_time_ns);
        let late = frame.now_ns.saturating_sub(frame.capture_time_ns) > LATE_NS;
        let early = frame.capture_time_ns > frame.now_ns;
        (stands || late || early).then_some(ImageCondition::Clock)
    }

    /// Capture time since which the image repeats; its own for another image.
    fn same_since_ns(&self, luminance: &Array2<f32>, capture_time_ns: u64, check: &mut ImageCheck) -> u64 {
        let Some(before) = self.before.as_ref().filter(|before| before.luminance.dim() == luminance.dim()) else {
            return capture_time_ns;
        };
        let sum: f32 = luminance.iter().zip(&before.luminance).map(|(a, b)| (a - b).abs()).sum();
        check.change = sum / luminance.len().max(1) as f32;
        if check.change <= SAME { before.same_since_ns } else { capture_time_ns }
    }
}

fn lens(limits: Option<CameraLimits>, frame: Measurement) -> Option<ImageCondition> {
    let limits = limits?;
    let differs = |i: usize| {
        let trained = limits.field_of_view_deg[i];
        trained > 0.0 && (frame.field_of_view_deg[i] / trained - 1.0).abs() > LENS
    };
    (differs(0) || differs(1)).then_some(ImageCondition::AnotherLens)
}

fn exposure(limits: Option<CameraLimits>, measured: &Measured) -> Option<ImageCondition> {
    let luminance = measured.luminance;
    if luminance < BLACK {
        return Some(ImageCondition::Black);
    }
    if luminance > WHITE {
        return Some(ImageCondition::White);
    }
    let [darkest, brightest] = limits?.luminance;
    if luminance < DARKER * darkest {
        return Some(ImageCondition::Underexposed);
    }
    (1.0 - luminance < BRIGHTER_REST * (1.0 - brightest)).then_some(ImageCondition::Overexposed)
}

fn focus(limits: Option<CameraLimits>, measured: &Measured) -> Option<ImageCondition> {
    let limits = limits?;
    if measured.covered > limits.covered + COVERED_BEYOND {
        return Some(ImageCondition::Covered);
    }
    (measured.sharpness < LEAST_SHARPNESS * limits.sharpness[0]).then_some(ImageCondition::Unfocused)
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Header;
    use ndarray::Array3;

    const MS: u64 = 1_000_000;

    /// A checkerboard of `cell` pixels with a little noise that `shot` draws.
    fn scene(cell: usize, shot: usize) -> Array3<u8> {
        Array3::from_shape_fn((64, 64, 3), |(y, x, c)| {
            let noise = (x * 31 + y * 17 + c * 7 + shot * 13) % 5;
            (if (x / cell + y / cell).is_multiple_of(2) { 90 } else { 170 }) + noise as u8
        })
    }

    fn limits() -> CameraLimits {
        CameraLimits::fit(&[Measured::of(scene(4, 0).view()), Measured::of(scene(6, 1).view())], [60.0, 60.0])
    }

    fn checked(check: &mut CameraCheck, image: &Array3<u8>, at_ms: u64) -> ImageCondition {
        let mut message = ImageCheck::of_frame(Header::of_frame(at_ms, at_ms * MS, 1));
        let frame = Measurement {
            capture_time_ns: at_ms * MS,
            now_ns: (at_ms + 5) * MS,
            field_of_view_deg: [60.0, 60.0],
            has_pose: true,
        };
        check.check(image.view(), frame, &mut message);
        carff_messages::Message::validate(&message).unwrap();
        message.condition().unwrap()
    }

    fn condition(image: &Array3<u8>) -> ImageCondition {
        checked(&mut CameraCheck::new(Some(limits()), None), image, 100)
    }

    /// Each bad image has its name, and a good one is usable.
    #[test]
    fn bad_images_are_named() {
        let good = scene(4, 7);
        assert_eq!(condition(&good), ImageCondition::Usable);
        assert_eq!(condition(&good.mapv(|v| v / 100)), ImageCondition::Black);
        assert_eq!(condition(&good.mapv(|v| 252 + v / 90)), ImageCondition::White);
        assert_eq!(condition(&good.mapv(|v| v / 5)), ImageCondition::Underexposed);
        assert_eq!(condition(&good.mapv(|v| 220 + v / 10)), ImageCondition::Overexposed);
        let blurred = Array3::from_shape_fn((64, 64, 3), |(y, x, _)| (100 + usize::midpoint(x, y)) as u8);
        assert_eq!(condition(&blurred), ImageCondition::Unfocused);
        let mut covered = good.clone();
        covered.slice_mut(ndarray::s![20.., ..30, ..]).fill(12);
        assert_eq!(condition(&covered), ImageCondition::Covered);
        assert_eq!(condition(&Array3::zeros((1, 2, 3))), ImageCondition::Black, "a tiny image does not fail the check");
    }

    /// A repeated image is frozen after the limit in capture time, and usable again with the first other image; without
    /// a limit it may repeat.
    #[test]
    fn frozen_cameras_are_noticed_and_recover() {
        let mut check = CameraCheck::new(Some(limits()), Some(300 * MS));
        let image = scene(4, 3);
        let conditions: Vec<_> = (0..5).map(|i| checked(&mut check, &image, 100 + 100 * i)).collect();
        let (usable, frozen) = (ImageCondition::Usable, ImageCondition::Frozen);
        assert_eq!(conditions, [usable, usable, usable, frozen, frozen]);
        assert_eq!(checked(&mut check, &scene(4, 4), 600), usable);
        let mut patient = CameraCheck::new(Some(limits()), None);
        assert!((0..9).all(|i| checked(&mut patient, &image, 100 + 1000 * i) == usable));
    }

    /// Capture times must advance and be near the clock; the lens must be the trained one; a needed pose must be there.
    #[test]
    fn clocks_lenses_and_poses_are_checked() {
        let mut check = CameraCheck::new(Some(limits()), None);
        assert_eq!(checked(&mut check, &scene(4, 0), 100), ImageCondition::Usable);
        assert_eq!(checked(&mut check, &scene(4, 1), 100), ImageCondition::Clock);
        assert_eq!(checked(&mut check, &scene(4, 2), 90), ImageCondition::Clock);
        assert_eq!(checked(&mut check, &scene(4, 3), 200), ImageCondition::Usable);
        let mut message = ImageCheck::of_frame(Header::of_frame(1, 300 * MS, 1));
        for (now_ms, field, wanted) in [
            (9000, 60.0, ImageCondition::Clock),
            (200, 60.0, ImageCondition::Clock),
            (9001, 90.0, ImageCondition::AnotherLens),
        ] {
            let capture_time_ns = if wanted == ImageCondition::AnotherLens { 9000 * MS } else { 300 * MS };
            let field_of_view_deg = [field, field];
            let frame = Measurement { capture_time_ns, now_ns: now_ms * MS, field_of_view_deg, has_pose: true };
            CameraCheck::new(Some(limits()), None).check(scene(4, 5).view(), frame, &mut message);
            assert_eq!(message.condition(), Ok(wanted));
        }
        let frame = Measurement {
            capture_time_ns: 300 * MS,
            now_ns: 301 * MS,
            field_of_view_deg: [60.0, 60.0],
            has_pose: false,
        };
        CameraCheck::new(Some(limits()), None).check(scene(4, 5).view(), frame, &mut message);
        assert_eq!(message.condition(), Ok(ImageCondition::NoPose));
    }
}
