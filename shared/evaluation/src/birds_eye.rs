//! Bird's-eye pictures of the states' latents against the true ones (paper tables 1 and 2).

use carff_dataset::{Dataset, DatasetError, Image};
use carff_field::{Field, RenderBuffer, RenderOptions};
use carff_messages::Gaussian;
use carff_metrics::{mean, psnr_db, psnr_where};
use serde::{Deserialize, Serialize};

/// Every state's rendering against every state's true picture.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BirdsEye {
    /// `psnr_db[rendered][true]`.
    pub psnr_db: Vec<Vec<f64>>,
    /// Mean over the diagonal.
    pub matching_db: f64,
    /// Mean off the diagonal.
    pub unmatching_db: f64,
    /// Mean PSNR of the mean picture of all states: what a field scores that knows no state.
    pub mean_picture_db: f64,
    /// PSNR of matching pairs over the pixels that differ by more than 12 of 255 from the mean picture.
    pub changed_db: f64,
    /// Rendered pictures, RGB bytes, by state.
    #[serde(skip)]
    pub pictures: Vec<Image>,
    /// True pictures by state.
    #[serde(skip)]
    pub truths: Vec<Image>,
}

/// Renders the set's bird's-eye view for each state's latent. `None` when the set names no such view.
pub fn birds_eye(
    field: &Field,
    states: &[Gaussian],
    dataset: &Dataset,
    threads: usize,
) -> Result<Option<BirdsEye>, DatasetError> {
    let Some(view) = dataset.scenario().and_then(|s| s.bev_view) else { return Ok(None) };
    let options = RenderOptions { threads, ..RenderOptions::default() };
    let mut buffer = RenderBuffer::new();
    let mut result = BirdsEye::default();
    let mut rendered = Vec::new();
    let mut true_values = Vec::new();
    for (state, posterior) in states.iter().enumerate() {
        let Some(index) = dataset.frame_index(state, view) else { return Ok(None) };
        let camera = dataset.frames()[index].camera;
        field.render(&camera, &posterior.mean, &options, &mut buffer);
        let bytes: Vec<u8> = buffer.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
        rendered.push(unit(&bytes));
        let truth = dataset.load_image(index)?;
        true_values.push(unit(&truth.rgb));
        result.pictures.push(Image { width_px: camera.width_px, height_px: camera.height_px, rgb: bytes });
        result.truths.push(truth);
    }
    let average: Vec<f32> = (0..true_values[0].len())
        .map(|i| true_values.iter().map(|t| t[i]).sum::<f32>() / true_values.len() as f32)
        .collect();
    let (mut matching, mut unmatching, mut of_mean, mut changed) = (Vec::new(), Vec::new(), Vec::new(), Vec::new());
    for (r, picture) in rendered.iter().enumerate() {
        let row: Vec<f64> = true_values.iter().map(|t| psnr_db(picture, t).unwrap_or(0.0)).collect();
        for (t, value) in row.iter().enumerate() {
            if r == t { matching.push(*value) } else { unmatching.push(*value) }
        }
        of_mean.extend(psnr_db(&average, &true_values[r]));
        let differs = |i: usize| {
            let pixel = i / 3 * 3;
            (pixel..pixel + 3).any(|j| (average[j] - true_values[r][j]).abs() > 12.0 / 255.0)
        };
        changed.extend(psnr_where(picture, &true_values[r], differs));
        result.psnr_db.push(row);
    }
    result.matching_db = mean(&matching).unwrap_or(0.0);
    result.unmatching_db = mean(&unmatching).unwrap_or(0.0);
    result.mean_picture_db = mean(&of_mean).unwrap_or(0.0);
    result.changed_db = mean(&changed).unwrap_or(0.0);
    Ok(Some(result))
}

fn unit(bytes: &[u8]) -> Vec<f32> {
    bytes.iter().map(|&b| f32::from(b) / 255.0).collect()
}
