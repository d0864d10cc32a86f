//! Import of datasets in the formats of nerfstudio and instant-ngp into datasets of one state.
//!
//! Images become opaque, undistorted PNG files with a maximum size, and their cameras are converted. The source does
//! not contain the scene's bounds: by default they are a box around the point that the cameras look at.

use std::path::Path;

use carff_base::geometry::PinholeCamera;
use image::imageops::{FilterType, resize};
use rayon::prelude::*;

use crate::error::DatasetError;
use crate::image::{Image, load_any};
use crate::scenario::{Frame, ScenarioInfo, StateInfo};
use crate::transforms::{Distortion, Pictures, read};
use crate::writer::{DatasetWriter, FrameRecord};

/// Options of an import.
#[derive(Clone, Debug, PartialEq)]
pub struct ImportOptions {
    /// Longest side of a written image, pixels; larger images are scaled down.
    pub max_side_px: u32,
    /// Background of transparent pixels, sRGB.
    pub background: [u8; 3],
    /// Lower and upper corner of the region of interest, in the dataset's own units. Default: see [`Imported::bounds`].
    pub bounds: Option<[[f64; 3]; 2]>,
}

impl Default for ImportOptions {
    fn default() -> Self {
        Self { max_side_px: 256, background: [255; 3], bounds: None }
    }
}

/// Result of an import.
#[derive(Clone, Debug, PartialEq)]
pub struct Imported {
    /// Number of written images.
    pub frames: usize,
    /// Region of interest: the given one, or else a cube around the point nearest to the cameras' lines of sight. Each
    /// side of the cube extends half of the cameras' median distance from it.
    pub bounds: [[f64; 3]; 2],
    /// Number of undistorted images.
    pub undistorted: usize,
    /// Number of images that were scaled down.
    pub scaled: usize,
}

/// Reads a dataset from `from` and writes a dataset of one state to `out`, which must be new, empty, or a dataset that
/// this program wrote. A dataset that names its scenario is an error.
pub fn import(from: &Path, out: &Path, options: &ImportOptions) -> Result<Imported, DatasetError> {
    let set = read(from, Pictures::PngOrJpeg)?;
    if set.scenario.is_some() {
        let problem = "the dataset names its scenario: it can be used directly, and need not be imported".to_owned();
        return Err(DatasetError::Image { path: from.to_owned(), problem });
    }
    let cameras: Vec<PinholeCamera> = set.frames.iter().map(|f| f.camera).collect();
    let bounds = options.bounds.unwrap_or_else(|| bounds_of(&cameras));
    let writer = DatasetWriter::create(out)?;
    let written: Vec<_> = set
        .frames
        .par_iter()
        .zip(&set.distortions)
        .enumerate()
        .map(|(view, (frame, distortion))| write_frame(&writer, view, frame, distortion, options))
        .collect();
    let (mut records, mut undistorted, mut scaled) = (Vec::with_capacity(written.len()), 0, 0);
    for frame in written {
        let (record, was_distorted, was_larger) = frame?;
        records.push(record);
        undistorted += usize::from(was_distorted);
        scaled += usize::from(was_larger);
    }
    let name = from.file_name().map_or_else(|| "imported".to_owned(), |n| n.to_string_lossy().into_owned());
    let scenario = ScenarioInfo {
        name,
        bounds,
        branches: vec!["scene".to_owned()],
        timestamps: 1,
        bev_view: None,
        states: vec![StateInfo { branch: 0, timestamp: 0, boxes: Vec::new() }],
        candidates: Vec::new(),
        static_boxes: Vec::new(),
        hazard_branches: Vec::new(),
        hazard_action: "none".to_owned(),
        clear_action: "none".to_owned(),
    };
    writer.finish(&records, Some(&scenario))?;
    Ok(Imported { frames: records.len(), bounds, undistorted, scaled })
}

/// Returns the record, whether the image was distorted, and whether it was too large.
fn write_frame(
    writer: &DatasetWriter,
    view: usize,
    frame: &Frame,
    distortion: &Distortion,
    options: &ImportOptions,
) -> Result<(FrameRecord, bool, bool), DatasetError> {
    let mut image = load_any(&frame.image_path, options.background)?;
    let mut camera = frame.camera;
    if (image.width_px, image.height_px) != (camera.width_px, camera.height_px) {
        // Images may have been scaled after their intrinsics were written: equal aspect ratio, other size.
        let across = u64::from(image.width_px) * u64::from(camera.height_px);
        let down = u64::from(image.height_px) * u64::from(camera.width_px);
        if across.abs_diff(down) > u64::from(camera.width_px.max(camera.height_px)) {
            let problem = format!(
                "{}x{} pixels, but its intrinsics (keys `w` and `h`) are for {}x{}",
                image.width_px, image.height_px, camera.width_px, camera.height_px
            );
            return Err(DatasetError::Image { path: frame.image_path.clone(), problem });
        }
        camera = camera.resized(image.width_px, image.height_px);
    }
    let distorted = distortion.iter().any(|v| v.abs() > 1e-9);
    if distorted {
        image = undistort(&image, &camera, distortion, options.background);
    }
    let longest = image.width_px.max(image.height_px);
    let larger = longest > options.max_side_px;
    if larger {
        let side = |px: u32| (u64::from(px) * u64::from(options.max_side_px) / u64::from(longest)).max(1) as u32;
        image = scaled_down(&image, side(image.width_px), side(image.height_px));
        camera = camera.resized(image.width_px, image.height_px);
    }
    let mut record = FrameRecord::new(format!("images/{view:05}.png"), camera);
    record.branch_and_timestamp = Some((0, 0));
    record.view = Some(view);
    writer.write_image(&record.file_path, &image)?;
    Ok((record, distorted, larger))
}

fn scaled_down(image: &Image, width_px: u32, height_px: u32) -> Image {
    match image::RgbImage::from_raw(image.width_px, image.height_px, image.rgb.clone()) {
        Some(buffer) => {
            let rgb = resize(&buffer, width_px, height_px, FilterType::Triangle).into_raw();
            Image { width_px, height_px, rgb }
        }
        // The number of bytes always matches the size.
        None => image.clone(),
    }
}

/// Returns the image that a pinhole camera of the same intrinsics would have taken.
fn undistort(image: &Image, camera: &PinholeCamera, [k1, k2, k3, k4, p1, p2]: &Distortion, beyond: [u8; 3]) -> Image {
    let mut result = Image::filled(image.width_px, image.height_px, beyond);
    let (w, h) = (image.width_px as usize, image.height_px as usize);
    for (i, pixel) in result.rgb.chunks_exact_mut(3).enumerate() {
        let x = ((i % w) as f64 + 0.5 - camera.cx_px) / camera.fl_x_px;
        let y = ((i / w) as f64 + 0.5 - camera.cy_px) / camera.fl_y_px;
        let r2 = x * x + y * y;
        let radial = 1.0 + r2 * (k1 + r2 * (k2 + r2 * (k3 + r2 * k4)));
        let xd = x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x);
        let yd = y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y;
        let (u, v) = (xd * camera.fl_x_px + camera.cx_px - 0.5, yd * camera.fl_y_px + camera.cy_px - 0.5);
        if !(u > -0.5 && v > -0.5 && u < w as f64 - 0.5 && v < h as f64 - 0.5) {
            continue;
        }
        let (u, v) = (u.clamp(0.0, (w - 1) as f64), v.clamp(0.0, (h - 1) as f64));
        let (left, top) = (u.floor() as usize, v.floor() as usize);
        let (right, bottom) = ((left + 1).min(w - 1), (top + 1).min(h - 1));
        let (a, b) = (u - left as f64, v - top as f64);
        for (c, value) in pixel.iter_mut().enumerate() {
            let at = |x: usize, y: usize| f64::from(image.rgb[(y * w + x) * 3 + c]);
            let upper = at(left, top) * (1.0 - a) + at(right, top) * a;
            let lower = at(left, bottom) * (1.0 - a) + at(right, bottom) * a;
            *value = (upper * (1.0 - b) + lower * b).round() as u8;
        }
    }
    result
}

/// See [`Imported::bounds`]. Parallel cameras have no such point: then it is ahead of them, at the distance of their
/// spread.
fn bounds_of(cameras: &[PinholeCamera]) -> [[f64; 3]; 2] {
    let ahead = |c: &PinholeCamera| [0, 1, 2].map(|i| -c.world_from_camera[i][2]);
    // Sum over lines of (I - d d^T) (x - p) = 0.
    let (mut matrix, mut right) = ([[0.0; 3]; 3], [0.0; 3]);
    for camera in cameras {
        let (p, d) = (camera.position_m(), ahead(camera));
        for i in 0..3 {
            for j in 0..3 {
                let projection = f64::from(u8::from(i == j)) - d[i] * d[j];
                matrix[i][j] += projection;
                right[i] += projection * p[j];
            }
        }
    }
    let count = cameras.len().max(1) as f64;
    let mean = |of: &dyn Fn(&PinholeCamera) -> [f64; 3]| {
        [0, 1, 2].map(|i| cameras.iter().map(|c| of(c)[i]).sum::<f64>() / count)
    };
    let middle = mean(&PinholeCamera::position_m);
    let distance = |a: [f64; 3], b: [f64; 3]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt();
    let center = solve(matrix, right, 1e-3 * count).unwrap_or_else(|| {
        let spread = cameras.iter().map(|c| distance(c.position_m(), middle)).fold(0.0, f64::max).max(1.0);
        let direction = mean(&ahead);
        [0, 1, 2].map(|i| middle[i] + 2.0 * spread * direction[i])
    });
    let mut distances: Vec<f64> = cameras.iter().map(|c| distance(c.position_m(), center)).collect();
    distances.sort_by(f64::total_cmp);
    let half = 0.5 * distances.get(distances.len() / 2).copied().unwrap_or(1.0).max(1e-3);
    [center.map(|v| v - half), center.map(|v| v + half)]
}

/// Solves a symmetric 3x3 system; `None` if its determinant is so small that the lines are nearly parallel.
fn solve(m: [[f64; 3]; 3], right: [f64; 3], least: f64) -> Option<[f64; 3]> {
    let determinant = |m: &[[f64; 3]; 3]| {
        m[0][0] * (m[1][1] * m[2][2] - m[1][2] * m[2][1]) - m[0][1] * (m[1][0] * m[2][2] - m[1][2] * m[2][0])
            + m[0][2] * (m[1][0] * m[2][1] - m[1][1] * m[2][0])
    };
    let whole = determinant(&m);
    if whole.abs() < least {
        return None;
    }
    Some([0, 1, 2].map(|column| {
        let mut replaced = m;
        for (row, value) in replaced.iter_mut().zip(right) {
            row[column] = value;
        }
        determinant(&replaced) / whole
    }))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn look(eye: [f64; 3], target: [f64; 3]) -> PinholeCamera {
        PinholeCamera::look_at(eye, target, [0.0, 0.0, 1.0], 64, 48, 60.0)
    }

    /// The box surrounds the point that all cameras look at, half as wide as their distance; for parallel cameras it is
    /// ahead of them.
    #[test]
    fn the_box_is_where_cameras_look() {
        let target = [3.0, -2.0, 1.0];
        let around: Vec<_> = (0..8)
            .map(|i| {
                let a = f64::from(i) * std::f64::consts::TAU / 8.0;
                look([target[0] + 4.0 * a.cos(), target[1] + 4.0 * a.sin(), target[2]], target)
            })
            .collect();
        let [low, high] = bounds_of(&around);
        for i in 0..3 {
            assert!((low[i] - (target[i] - 2.0)).abs() < 1e-6 && (high[i] - (target[i] + 2.0)).abs() < 1e-6);
        }
        let side_by_side: Vec<_> = (0..3).map(|i| look([f64::from(i), 0.0, 0.0], [f64::from(i), 5.0, 0.0])).collect();
        let [low, high] = bounds_of(&side_by_side);
        assert!(low[1] > 0.5 && high[1] > 2.0 && (low[0] + high[0] - 2.0).abs() < 1e-6, "{low:?} {high:?}");
    }

    /// Undistortion inverts the lens: a dot at the distorted position moves to the pinhole camera's position.
    #[test]
    fn lenses_are_straightened() {
        let camera = look([0.0; 3], [0.0, 1.0, 0.0]);
        let distortion = [-0.25, 0.05, 0.0, 0.0, 0.002, -0.001];
        let (x, y) = (0.35, -0.2);
        let r2: f64 = x * x + y * y;
        let radial = 1.0 + distortion[0] * r2 + distortion[1] * r2 * r2;
        let xd = x * radial + 2.0 * distortion[4] * x * y + distortion[5] * (r2 + 2.0 * x * x);
        let yd = y * radial + distortion[4] * (r2 + 2.0 * y * y) + 2.0 * distortion[5] * x * y;
        let pixel = |x: f64, y: f64| [x * camera.fl_x_px + camera.cx_px, y * camera.fl_y_px + camera.cy_px];
        let [u, v] = pixel(xd, yd);
        let mut bent = Image::filled(64, 48, [0; 3]);
        for (i, p) in bent.rgb.chunks_exact_mut(3).enumerate() {
            let distance = ((i % 64) as f64 + 0.5 - u).hypot((i / 64) as f64 + 0.5 - v);
            p.fill((255.0 * (-distance * distance / 4.0).exp()) as u8);
        }
        let straight = undistort(&bent, &camera, &distortion, [0; 3]);
        let (mut sum, mut at) = (0.0, [0.0; 2]);
        for (i, p) in straight.rgb.chunks_exact(3).enumerate() {
            let weight = f64::from(p[0]);
            sum += weight;
            at[0] += weight * ((i % 64) as f64 + 0.5);
            at[1] += weight * ((i / 64) as f64 + 0.5);
        }
        let [u, v] = pixel(x, y);
        assert!((at[0] / sum - u).abs() < 0.2 && (at[1] / sum - v).abs() < 0.2, "{at:?} {sum} {u} {v}");
    }
}
