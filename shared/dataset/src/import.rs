//! Import of datasets in the formats of nerfstudio and instant-ngp into datasets of one state.
//!
//! Images become opaque, undistorted PNG files with a maximum size, and their cameras are converted. The source does
//! not contain the scene's bounds: by default they are a box around the point that the cameras look at.

use std::path::Path;

use carff_base::geometry::PinholeCamera;
use carff_base::linear::solve;
use image::imageops::{FilterType, resize};
use rayon::prelude::*;

use crate::dataset::collected;
use crate::error::DatasetError;
use crate::image::{Image, load_any, load_mask};
use crate::lens::Lens;
use crate::scenario::{Frame, ScenarioInfo, StateInfo};
use crate::transforms::{read, warning_of_turned};
use crate::views::Views;
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
    /// Number of images with a mask: from the source, or of pixels that the lens does not show.
    pub masked: usize,
    /// Warnings about accepted but unusual values.
    pub warnings: Vec<String>,
}

/// Reads a dataset from `from` and writes a dataset of one state to `out`, which must be new, empty, or a dataset that
/// this program wrote. A dataset that names its scenario is an error.
pub fn import(from: &Path, out: &Path, options: &ImportOptions) -> Result<Imported, DatasetError> {
    let mut set = read(from, Views::InSomeStates)?;
    if set.scenario.is_some() {
        let problem = "the dataset names its scenario: it can be used directly, and need not be imported".to_owned();
        return Err(DatasetError::Image { path: from.to_owned(), problem });
    }
    DatasetError::of_all(set.faults.drain(..).map(|(_, fault)| fault).collect())?;
    let cameras: Vec<PinholeCamera> = set.frames.iter().map(|f| f.camera).collect();
    let bounds = options.bounds.unwrap_or_else(|| bounds_of(&cameras));
    let writer = DatasetWriter::create(out)?;
    let written: Vec<_> =
        set.frames.par_iter().enumerate().map(|(view, frame)| write_frame(&writer, view, frame, options)).collect();
    let written = collected(written)?;
    let undistorted = set.frames.iter().filter(|frame| frame.lens != Lens::Pinhole).count();
    let scaled = written.iter().filter(|(_, was_larger)| *was_larger).count();
    let records: Vec<FrameRecord> = written.into_iter().map(|(record, _)| record).collect();
    let masked = records.iter().filter(|record| record.mask_path.is_some()).count();
    let name = from.file_name().map_or_else(|| "imported".to_owned(), |n| n.to_string_lossy().into_owned());
    let scenario = ScenarioInfo {
        name,
        bounds,
        branches: vec!["scene".to_owned()],
        timestamps: 1,
        step_s: None,
        bev_view: None,
        states: vec![StateInfo { branch: 0, timestamp: 0, boxes: Vec::new() }],
        candidates: Vec::new(),
        static_boxes: Vec::new(),
        hazard_branches: Vec::new(),
        hazard_from_timestamp: 0,
        hazard_action: "none".to_owned(),
        clear_action: "none".to_owned(),
    };
    writer.finish(&records, Some(&scenario))?;
    let warnings = set.warnings.into_iter().chain(warning_of_turned(from, &set.frames)).collect();
    Ok(Imported { frames: records.len(), bounds, undistorted, scaled, masked, warnings })
}

/// Returns the record, and whether the image was too large.
fn write_frame(
    writer: &DatasetWriter,
    view: usize,
    frame: &Frame,
    options: &ImportOptions,
) -> Result<(FrameRecord, bool), DatasetError> {
    let mut image = load_any(&frame.image_path, options.background)?;
    let mut camera = fitting(&frame.camera, &image, &frame.image_path)?;
    let size = |image: &Image| (image.width_px, image.height_px);
    let mask = frame.mask_path.as_ref().map(|path| load_mask(path, size(&image))).transpose()?;
    let mut valid = mask;
    if frame.lens != Lens::Pinhole {
        image = frame.lens.undistorted(&image, &camera);
        valid = Some(frame.lens.valid(&camera, valid.as_deref()));
    }
    let longest = image.width_px.max(image.height_px);
    let larger = longest > options.max_side_px;
    if larger {
        let side = |px: u32| (u64::from(px) * u64::from(options.max_side_px) / u64::from(longest)).max(1) as u32;
        let (from, to) = (size(&image), (side(image.width_px), side(image.height_px)));
        image = scaled_down(&image, to.0, to.1);
        valid = valid.map(|valid| scaled_mask(&valid, from, to));
        camera = camera.resized(to.0, to.1);
    }
    let mut record = FrameRecord::new(format!("images/{view:05}.png"), camera);
    record.branch_and_timestamp = Some((0, 0));
    record.view = Some(view);
    writer.write_image(&record.file_path, &image)?;
    if let Some(valid) = valid.filter(|valid| valid.contains(&false)) {
        if !valid.contains(&true) {
            let problem = "no pixel remains: the mask and the lens exclude all of them".to_owned();
            return Err(DatasetError::Image { path: frame.image_path.clone(), problem });
        }
        let name = format!("masks/{view:05}.png");
        writer.write_mask(&name, &valid, image.width_px, image.height_px)?;
        record.mask_path = Some(name);
    }
    Ok((record, larger))
}

/// Returns the camera for the size of its image. Images may have been scaled after their intrinsics were written: equal
/// aspect ratio, other size.
fn fitting(camera: &PinholeCamera, image: &Image, path: &Path) -> Result<PinholeCamera, DatasetError> {
    if (image.width_px, image.height_px) == (camera.width_px, camera.height_px) {
        return Ok(*camera);
    }
    let across = u64::from(image.width_px) * u64::from(camera.height_px);
    let down = u64::from(image.height_px) * u64::from(camera.width_px);
    if across.abs_diff(down) > u64::from(camera.width_px.max(camera.height_px)) {
        let problem = format!(
            "{}x{} pixels, but its intrinsics (keys `w` and `h`) are for {}x{}",
            image.width_px, image.height_px, camera.width_px, camera.height_px
        );
        return Err(DatasetError::Image { path: path.to_owned(), problem });
    }
    Ok(camera.resized(image.width_px, image.height_px))
}

/// Scales a mask down: a pixel is valid if all pixels that it is made of are.
fn scaled_mask(valid: &[bool], from: (u32, u32), to: (u32, u32)) -> Vec<bool> {
    let bytes = valid.iter().map(|&valid| if valid { 255 } else { 0 }).collect();
    let grey = image::GrayImage::from_raw(from.0, from.1, bytes).unwrap_or_default();
    resize(&grey, to.0, to.1, FilterType::Triangle).into_raw().into_iter().map(|v| v == 255).collect()
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

/// See [`Imported::bounds`]. Parallel cameras have no such point: then it is ahead of them, at the distance of their
/// spread.
fn bounds_of(cameras: &[PinholeCamera]) -> [[f64; 3]; 2] {
    let ahead = |c: &PinholeCamera| [0, 1, 2].map(|i| -c.world_from_camera[i][2]);
    // Sum over lines of (I - d d^T) (x - p) = 0. The pivots of nearly parallel lines are about as large as their number,
    // but for one.
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
    let center = solve(matrix, right, 1e-3 / count).unwrap_or_else(|| {
        let spread = cameras.iter().map(|c| distance(c.position_m(), middle)).fold(0.0, f64::max).max(1.0);
        let direction = mean(&ahead);
        [0, 1, 2].map(|i| middle[i] + 2.0 * spread * direction[i])
    });
    let mut distances: Vec<f64> = cameras.iter().map(|c| distance(c.position_m(), center)).collect();
    distances.sort_by(f64::total_cmp);
    let half = 0.5 * distances.get(distances.len() / 2).copied().unwrap_or(1.0).max(1e-3);
    [center.map(|v| v - half), center.map(|v| v + half)]
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
}
