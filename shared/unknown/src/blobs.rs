//! Connected residuals: how strong they are, and where on the ground they stand.

use crate::lanes::{ErrorMap, Ground};
use carff_base::geometry::PinholeCamera;
use std::collections::BTreeMap;

/// Pixels that count for the strength of a blob: a vehicle of 100 pixels in an image of 128 x 128 has 25 at the
/// compared size.
const STRONGEST: usize = 25;
/// Smallest and largest height of a blob's box, as a share of its width.
const HEIGHT_SHARE: [f64; 2] = [0.3, 1.2];

/// Connected pixels that a state does not explain, and that stand on the lanes.
#[derive(Clone, Debug, PartialEq)]
pub struct Blob {
    /// Root mean square of the 25 largest residuals, in units in which 1 is the field's own error.
    pub strength: f32,
    /// Its pixels at the compared size, by index, row by row.
    pub pixels: Vec<usize>,
    /// Place where it stands, x and y, metres: the nearest ground that it covers, on the lanes.
    pub foot_m: [f64; 2],
    /// The nearest ground that each of its columns covers, x and y, metres.
    pub feet_m: Vec<[f64; 2]>,
    /// Distance of that place from the camera, metres.
    pub distance_m: f64,
    /// Width across the view, metres.
    pub width_m: f64,
    /// Height of the box, metres.
    pub height_m: f64,
}

impl Blob {
    /// Returns centre and half sizes of an upright box at the blob's place, metres; its depth equals its width.
    pub fn upright_box(&self, camera: &PinholeCamera, ground_m: f64) -> ([f64; 3], [f64; 3]) {
        let eye = camera.position_m();
        let away = [self.foot_m[0] - eye[0], self.foot_m[1] - eye[1]];
        let length = away[0].hypot(away[1]).max(1e-9);
        let half = self.width_m / 2.0;
        let center = [0, 1].map(|i| self.foot_m[i] + away[i] / length * half);
        ([center[0], center[1], ground_m + self.height_m / 2.0], [half, half, self.height_m / 2.0])
    }
}

/// Finds the blobs of one state that stand on the lanes, the strongest first. `residual` has the residual of each pixel
/// in deviations, `ground` what the pixels look at, and `judged` is true where a residual was computed.
pub(crate) fn blobs(
    camera: &PinholeCamera,
    residual: &[f32],
    judged: &[bool],
    ground: &[Option<Ground>],
    errors: &ErrorMap,
) -> Vec<Blob> {
    let width = camera.width_px as usize;
    let relative: Vec<f32> = residual
        .iter()
        .zip(ground)
        .zip(judged)
        .map(|((r, ground), judged)| match ground {
            Some(ground) if *judged && *r > 0.0 => r / errors.at(ground.at_m),
            _ => 0.0,
        })
        .collect();
    let mut taken = vec![false; relative.len()];
    let mut found = Vec::new();
    for start in 0..relative.len() {
        if taken[start] || relative[start] <= 1.0 {
            continue;
        }
        let mut pixels = connected(start, width, &relative, &mut taken);
        pixels.sort_unstable();
        found.extend(blob(camera, &pixels, &relative, ground));
    }
    found.sort_by(|a: &Blob, b: &Blob| b.strength.total_cmp(&a.strength));
    found
}

/// Takes the pixels above 1 that are connected with a first one by edges or corners.
fn connected(start: usize, width: usize, relative: &[f32], taken: &mut [bool]) -> Vec<usize> {
    let height = relative.len() / width;
    let (mut waiting, mut pixels) = (vec![start], Vec::new());
    taken[start] = true;
    while let Some(pixel) = waiting.pop() {
        pixels.push(pixel);
        let (x, y) = (pixel % width, pixel / width);
        for ny in y.saturating_sub(1)..(y + 2).min(height) {
            for nx in x.saturating_sub(1)..(x + 2).min(width) {
                let next = ny * width + nx;
                if !taken[next] && relative[next] > 1.0 {
                    taken[next] = true;
                    waiting.push(next);
                }
            }
        }
    }
    pixels
}

/// The nearest ground that some pixels look at.
fn foot(pixels: impl Iterator<Item = usize>, ground: &[Option<Ground>]) -> Option<Ground> {
    pixels.filter_map(|p| ground[p]).min_by(|a, b| a.distance_m.total_cmp(&b.distance_m))
}

/// Returns those of the connected pixels whose column stands on the lanes, column by column with its foot. Each column
/// stands for itself: a vehicle that fills the lanes is connected with its shadow next to them.
fn on_lanes(pixels: &[usize], width: usize, ground: &[Option<Ground>]) -> Vec<(Ground, Vec<usize>)> {
    let mut columns: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
    for &pixel in pixels {
        columns.entry(pixel % width).or_default().push(pixel);
    }
    let with_foot = |column: Vec<usize>| {
        let foot = foot(column.iter().copied(), ground).filter(|foot| foot.on_lanes)?;
        Some((foot, column))
    };
    columns.into_values().filter_map(with_foot).collect()
}

/// Describes connected pixels; `None` if no column of them stands on the lanes.
fn blob(camera: &PinholeCamera, pixels: &[usize], relative: &[f32], ground: &[Option<Ground>]) -> Option<Blob> {
    let width = camera.width_px as usize;
    let standing = on_lanes(pixels, width, ground);
    let foot = standing.iter().map(|(foot, _)| *foot).min_by(|a, b| a.distance_m.total_cmp(&b.distance_m))?;
    let feet_m = standing.iter().map(|(foot, _)| foot.at_m).collect();
    let pixels: Vec<usize> = standing.into_iter().flat_map(|(_, column)| column).collect();
    let mut strongest: Vec<f32> = pixels.iter().map(|&p| relative[p]).collect();
    strongest.sort_by(|a, b| b.total_cmp(a));
    let sum: f32 = strongest.iter().take(STRONGEST).map(|v| v * v).sum();
    let columns = || pixels.iter().map(|p| p % width);
    let rows = || pixels.iter().map(|p| p / width);
    let span = |low: Option<usize>, high: Option<usize>| (high.unwrap_or(0) - low.unwrap_or(0) + 1) as f64;
    let width_m = span(columns().min(), columns().max()) * foot.distance_m / camera.fl_x_px;
    let height_m = span(rows().min(), rows().max()) * foot.distance_m / camera.fl_y_px;
    Some(Blob {
        strength: (sum / STRONGEST as f32).sqrt(),
        foot_m: foot.at_m,
        feet_m,
        distance_m: foot.distance_m,
        width_m,
        height_m: height_m.clamp(HEIGHT_SHARE[0] * width_m, HEIGHT_SHARE[1] * width_m),
        pixels,
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::lanes::Lanes;
    use carff_base::geometry::OrientedBox;

    /// A vehicle on the lane is found although it is connected with a shadow that reaches nearer ground next to the lane;
    /// the shadow by itself is not found.
    #[test]
    fn each_column_stands_for_itself() {
        let camera = PinholeCamera::look_at([0.0, -8.0, 6.0], [0.0; 3], [0.0, 0.0, 1.0], 32, 32, 60.0);
        let lanes = Lanes {
            areas: vec![OrientedBox { center: [0.0, 1.0, 0.0], half_size: [9.0, 2.0, 1.0], yaw: 0.0 }],
            ground_m: 0.0,
            bounds_m: [[-9.0, -9.0], [9.0, 9.0]],
            nearest_m: 1.0,
            own: Vec::new(),
        };
        let (ground, judged, errors) = (lanes.ground_points(&camera), [true; 32 * 32], ErrorMap::even(&lanes, 1.0));
        let found = |is_residual: &dyn Fn(usize, usize) -> bool| {
            let residual: Vec<f32> =
                (0..32 * 32).map(|i| if is_residual(i % 32, i / 32) { 9.0 } else { 0.0 }).collect();
            blobs(&camera, &residual, &judged, &ground, &errors)
        };
        let is_lane = |y: &usize| ground[y * 32 + 10].is_some_and(|g| g.on_lanes);
        let (first, last) = ((0..32).find(is_lane).unwrap(), (0..32).rfind(is_lane).unwrap());
        let vehicle = |x: usize, y: usize| (8..16).contains(&x) && (first..=last).contains(&y);
        let shadow = |x: usize, y: usize| (16..20).contains(&x) && (first..last + 4).contains(&y);
        let both = found(&|x, y| vehicle(x, y) || shadow(x, y));
        assert_eq!(both, found(&vehicle));
        assert_eq!(both.len(), 1);
        assert!(found(&shadow).is_empty());
    }
}
