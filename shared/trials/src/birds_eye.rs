//! Bird's-eye images of the states' latents against true images (paper tables 1 and 2).

use crate::render::{FieldRenderer, mean_image, psnr_of_changed, to_unit};
use carff_base::statistics::{mean, psnr_db};
use carff_dataset::{Dataset, DatasetError, Image};
use carff_field::Field;
use carff_messages::Gaussian;
use serde::{Deserialize, Serialize};

/// Every state's rendering against every state's true image.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BirdsEye {
    /// `psnr_db[rendered][true]`.
    pub psnr_db: Vec<Vec<f64>>,
    /// Mean over the diagonal.
    pub matching_db: f64,
    /// Mean off the diagonal.
    pub unmatching_db: f64,
    /// Mean PSNR of the mean image of all states: the score of a field without states.
    #[serde(alias = "mean_picture_db")]
    pub mean_image_db: f64,
    /// PSNR of matching pairs over the pixels that differ from the mean image by more than the pixel tolerance.
    pub changed_db: f64,
    /// Rendered images by state.
    #[serde(skip)]
    pub images: Vec<Image>,
    /// True images by state.
    #[serde(skip)]
    pub truths: Vec<Image>,
}

/// Renders the dataset's bird's-eye view for each state's latent. `None` when the dataset has no such view.
pub fn birds_eye(
    field: &Field,
    states: &[Gaussian],
    dataset: &Dataset,
    threads: usize,
) -> Result<Option<BirdsEye>, DatasetError> {
    let Some(view) = dataset.scenario().and_then(|s| s.bev_view) else { return Ok(None) };
    let mut renderer = FieldRenderer::new(threads);
    let mut result = BirdsEye::default();
    let [mut rendered, mut true_values] = [Vec::new(), Vec::new()];
    for (state, posterior) in states.iter().enumerate() {
        let Some(index) = dataset.frame_index(state, view) else { return Ok(None) };
        let image = renderer.image(field, &dataset.frames()[index].camera, &posterior.mean);
        let truth = dataset.load_image(index)?;
        rendered.push(to_unit(&image.rgb));
        true_values.push(to_unit(&truth.rgb));
        result.images.push(image);
        result.truths.push(truth);
    }
    let Some(average) = mean_image(&true_values) else { return Ok(None) };
    let [mut matching, mut unmatching, mut of_mean, mut changed] = [(); 4].map(|()| Vec::new());
    for (r, (image, truth)) in rendered.iter().zip(&true_values).enumerate() {
        let row: Vec<f64> = true_values.iter().map(|t| psnr_db(image, t).unwrap_or(0.0)).collect();
        for (t, value) in row.iter().enumerate() {
            if r == t { matching.push(*value) } else { unmatching.push(*value) }
        }
        of_mean.extend(psnr_db(&average, truth));
        changed.extend(psnr_of_changed(image, truth, &average));
        result.psnr_db.push(row);
    }
    result.matching_db = mean(&matching).unwrap_or(0.0);
    result.unmatching_db = mean(&unmatching).unwrap_or(0.0);
    result.mean_image_db = mean(&of_mean).unwrap_or(0.0);
    result.changed_db = mean(&changed).unwrap_or(0.0);
    Ok(Some(result))
}
