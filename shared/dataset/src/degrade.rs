//! Datasets as a camera gives them: read noise, exposure and white balance that vary, and poses that are not exact.

use crate::{
    Dataset, DatasetError, DatasetWriter, Equivalence, FrameRecord, Image,
    sensor::{SensorNoise, apply_noise_into},
};
use carff_base::{geometry::PinholeCamera, random::Key};
use rand::{Rng, seq::SliceRandom};
use rand_distr::StandardNormal;
use std::path::Path;

/// Errors of a camera that [`degrade`] adds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Degradation {
    /// Read noise, exposure and white balance, drawn for each image.
    pub noise: SensorNoise,
    /// Standard deviation of the error of the pose's rotation, as the shift of the image's centre along each axis,
    /// pixels. The recorded pose is the one without the error.
    pub pose_jitter_px: f64,
    /// Keeps the image of one state from each pose, as a camera that drives by takes it.
    pub one_state: bool,
    /// Seed of all draws.
    pub seed: u64,
}

/// Writes a degraded copy of a dataset of known states into `out`. Each image gets its own draws. The states that look
/// the same in the original are recorded as `alike_states`, because the degraded images cannot show it. With
/// `one_state`, states have equal numbers of poses, as far as possible. Returns the number of images.
pub fn degrade(dataset: &Dataset, out: &Path, degradation: &Degradation) -> Result<usize, DatasetError> {
    let images = dataset.load_all_images()?;
    let equivalence = Equivalence::from_dataset(dataset, &images);
    let kept = degradation.one_state.then(|| one_state_of_each_pose(dataset, degradation.seed));
    let writer = DatasetWriter::create(out)?;
    let mut records = Vec::with_capacity(images.len());
    for (i, (frame, image)) in dataset.frames().iter().zip(&images).enumerate() {
        if kept.as_ref().zip(frame.view).is_some_and(|(kept, view)| frame.state != Some(kept[view])) {
            continue;
        }
        let file_path = format!("images/{i:06}.png");
        writer.write_image(&file_path, &degraded(image, &frame.camera, degradation, i as u64))?;
        let mask_path = dataset.valid_pixels(i).map(|_| format!("masks/{i:06}.png"));
        if let Some((path, mask)) = mask_path.as_ref().zip(dataset.valid_pixels(i)) {
            writer.write_mask(path, mask, image.width_px, image.height_px)?;
        }
        records.push(FrameRecord {
            mask_path,
            branch_and_timestamp: frame.branch.zip(frame.timestamp),
            view: frame.view,
            observability: frame.observability,
            visible_fraction: frame.visible_fraction,
            actor_px: frame.actor_px,
            view_kind: frame.view_kind.clone(),
            alike_states: frame.view.zip(frame.state).map(|(v, s)| equivalence.alike(v, s).collect()),
            ..FrameRecord::new(file_path, frame.camera)
        });
    }
    writer.finish(&records, dataset.scenario())?;
    Ok(records.len())
}

/// A state for each pose: all states in turn, over the poses in random order.
fn one_state_of_each_pose(dataset: &Dataset, seed: u64) -> Vec<usize> {
    let mut poses: Vec<usize> = (0..dataset.view_count()).collect();
    poses.shuffle(&mut carff_base::random::stream(Key::named("stat", seed, 0)));
    let mut states = vec![0; poses.len()];
    for (i, &pose) in poses.iter().enumerate() {
        states[pose] = i % dataset.state_count();
    }
    states
}

/// The image behind a camera that is rotated by a random error, with sensor noise.
fn degraded(image: &Image, camera: &PinholeCamera, degradation: &Degradation, number: u64) -> Image {
    let mut rng = carff_base::random::stream(Key::named("jitt", degradation.seed, number));
    let mut shift = || degradation.pose_jitter_px * rng.sample::<f64, _>(StandardNormal);
    // Small rotations about the right, up and view axes. The last one moves the edge of the image by as much as the
    // others move its centre.
    let (dx, dy, edge) = (shift(), shift(), shift());
    let roll = 2.0 * edge / f64::from(image.width_px.max(image.height_px));
    let moved = Image { rgb: rotated(image, camera, [dx, dy], roll), ..*image };
    let mut noisy = moved.clone();
    let key = Key::named("sens", degradation.seed, number);
    match apply_noise_into(&moved.rgb, &mut noisy.rgb, &degradation.noise, key) {
        Ok(()) => noisy,
        Err(_) => moved,
    }
}

/// Samples an image bilinearly at pixels that are shifted by `shift_px` and rolled about the principal point by `roll`
/// radians; beyond the image the edge is repeated.
fn rotated(image: &Image, camera: &PinholeCamera, shift_px: [f64; 2], roll: f64) -> Vec<u8> {
    let (width, height) = (image.width_px as usize, image.height_px as usize);
    let (sin, cos) = roll.sin_cos();
    let at = |x: usize, y: usize, c: usize| f64::from(image.rgb[(y * width + x) * 3 + c]);
    let mut rgb = Vec::with_capacity(image.rgb.len());
    for (y, x) in (0..height).flat_map(|y| (0..width).map(move |x| (y, x))) {
        let (right, down) = (x as f64 - camera.cx_px, y as f64 - camera.cy_px);
        let u = (cos * right - sin * down + camera.cx_px + shift_px[0]).clamp(0.0, (width - 1) as f64);
        let v = (sin * right + cos * down + camera.cy_px + shift_px[1]).clamp(0.0, (height - 1) as f64);
        let (x0, y0) = (u as usize, v as usize);
        let (x1, y1) = ((x0 + 1).min(width - 1), (y0 + 1).min(height - 1));
        let (a, b) = (u - x0 as f64, v - y0 as f64);
        for c in 0..3 {
            let top = at(x0, y0, c) * (1.0 - a) + at(x1, y0, c) * a;
            let bottom = at(x0, y1, c) * (1.0 - a) + at(x1, y1, c) * a;
            rgb.push((top * (1.0 - b) + bottom * b).round() as u8);
        }
    }
    rgb
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> PinholeCamera {
        PinholeCamera::look_at([0.0, 0.0, 5.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 16, 16, 60.0)
    }

    /// No rotation is the image itself; a shift by one pixel takes the neighbour, and a half turn is upside down.
    #[test]
    fn rotation_moves_pixels() {
        let mut image = Image::filled(16, 16, [0; 3]);
        image.rgb.iter_mut().enumerate().for_each(|(i, v)| *v = (i % 251) as u8);
        assert_eq!(rotated(&image, &camera(), [0.0; 2], 0.0), image.rgb);
        let shifted = rotated(&image, &camera(), [1.0, 0.0], 0.0);
        assert_eq!(shifted[..45], image.rgb[3..48]);
        let turned =
            rotated(&image, &PinholeCamera { cx_px: 7.5, cy_px: 7.5, ..camera() }, [0.0; 2], std::f64::consts::PI);
        assert_eq!(turned[..3], image.rgb[255 * 3..]);
    }

    /// Each image has its own draws, and the same number the same ones.
    #[test]
    fn draws_are_named_by_number() {
        let image = Image::filled(16, 16, [100; 3]);
        let degradation = Degradation { noise: SensorNoise::default(), pose_jitter_px: 1.0, one_state: false, seed: 3 };
        let made = |number| degraded(&image, &camera(), &degradation, number);
        assert_eq!(made(1), made(1));
        assert_ne!(made(1), made(2));
    }
}
