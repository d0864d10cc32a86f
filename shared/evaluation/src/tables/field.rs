//! Images of the field against true images, from above and from held-out poses (table 1).

use super::spread;
use crate::stats::pairs::{PairMeans, pair_means};
use crate::{ByRole, Progress, Subject, role_name, ssim};
use carff_base::geometry::PinholeCamera;
use carff_base::statistics::{mean, psnr_db, psnr_where};
use carff_dataset::{Observability, PoseRole};
use carff_decision::Sampling;
use carff_field::Field;
use carff_messages::LATENT_DIM;
use carff_trials::render::{FieldRenderer, mean_image, psnr_of_changed, to_unit};
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// Images of the field against true images.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageTable {
    /// Names of the states, in the order of the matrices.
    pub states: Vec<String>,
    /// Rendered with the latents of the known states. Absent where the dataset has no view from above.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub toggled: Option<FieldImages>,
    /// Rendered with latents drawn from forecasts of the previous step, from unambiguous images.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub predicted: Option<FieldImages>,
    /// PSNR from above of the mean image of all states, which needs no model, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_image_db: Option<f64>,
    /// Images from the dataset's poses, for trained and held-out poses.
    pub novel_views: ByRole<NovelViews>,
}

/// Images from above.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct FieldImages {
    /// `psnr_db[rendered][true]`; null for a state that is never forecast.
    pub psnr_db: Vec<Option<Vec<f64>>>,
    /// Means over all pairs of states that look different.
    pub all: PairMeans,
    /// Means over the rows of each branch.
    pub by_branch: BTreeMap<String, PairMeans>,
    /// Structural similarity of matching pairs.
    pub ssim: Option<f64>,
    /// PSNR of matching pairs inside the dynamic actors' pixels, dB; absent where the dataset has no dynamic boxes.
    pub actor_db: Option<f64>,
    /// PSNR of matching pairs over the pixels that differ from the mean of all states, dB.
    pub changed_db: Option<f64>,
    /// Renderings.
    pub renderings: usize,
}

/// Images from poses of one role.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NovelViews {
    /// Mean PSNR, dB.
    pub psnr_db: f64,
    /// Mean PSNR of the pose's mean image over the states, which is made of the pose's true images, dB.
    pub mean_image_db: f64,
    /// `psnr_db` minus `mean_image_db`, dB.
    pub gain_db: f64,
    /// Mean structural similarity.
    pub ssim: f64,
    /// Mean PSNR inside the dynamic actors' pixels, where any is visible, dB.
    pub actor_db: Option<f64>,
    /// Images.
    pub images: usize,
}

/// Largest number of images of one role.
const MOST_IMAGES: usize = 60;
/// Renderings of each forecast state.
const PREDICTED: usize = 6;

/// Computes the table, or returns the reason why it is missing.
pub fn image_table(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<ImageTable, String> {
    let field = subject.probe.as_ref().map_err(Clone::clone)?.field();
    let states = subject.posed.scenario.state_count();
    let mut artist = Artist { field, renderer: FieldRenderer::new(subject.options.threads) };
    let mut table = ImageTable { states: (0..states).map(|s| subject.state_name(s)).collect(), ..Default::default() };
    let tell = |done, line: &str| on_progress(&Progress { phase: "psnr", done, total: 4, line: line.to_owned() });
    tell(0, "from above");
    if let Some(above) = Above::of(subject) {
        table.mean_image_db = mean(&above.truths.iter().filter_map(|t| psnr_db(&above.mean, t)).collect::<Vec<_>>());
        let toggled: Vec<Vec<[f32; LATENT_DIM]>> = subject.manifest.states.iter().map(|s| vec![s.mean]).collect();
        table.toggled = Some(above.images(subject, &mut artist, &toggled));
        tell(1, "forecasts from above");
        let predicted = predicted_latents(subject);
        if predicted.iter().any(|p| !p.is_empty()) {
            table.predicted = Some(above.images(subject, &mut artist, &predicted));
        }
    }
    for (i, role) in [PoseRole::Rest, PoseRole::Unseen].into_iter().enumerate() {
        tell(2 + i, &format!("{} poses", role_name(role)));
        if let Some(views) = novel_views(subject, &mut artist, role) {
            table.novel_views.set(role, views);
        }
    }
    tell(4, "");
    Ok(table)
}

/// Latents of each state drawn from forecasts of the previous step, one from each of some unambiguous images of trained
/// poses.
fn predicted_latents(subject: &Subject) -> Vec<Vec<[f32; LATENT_DIM]>> {
    let posed = &subject.posed;
    let mut by_state = vec![Vec::new(); posed.scenario.state_count()];
    let Ok(mixture) = &subject.mixture else { return by_state };
    let trained = posed.with_roles(&[PoseRole::Rest]);
    for state in 0..by_state.len() {
        let next = posed.scenario.next_state(state);
        let unambiguous = |i: &usize| posed.labels[*i].state == state && posed.is_unambiguous(*i);
        let inputs: Vec<usize> = trained.iter().copied().filter(unambiguous).collect();
        if next == state || inputs.is_empty() {
            continue;
        }
        for i in spread(&inputs, PREDICTED) {
            let draws = mixture.forecast(&subject.posteriors[i]);
            let draws = draws.draw(1, Sampling::Independent, subject.options.seed, i as u64, 1);
            by_state[next].extend(draws.into_iter().map(|d| d.latent));
        }
    }
    by_state
}

/// Renderer of images that are compared.
struct Artist<'a> {
    field: &'a Field,
    renderer: FieldRenderer,
}

impl Artist<'_> {
    /// Values in 0..=1 of an image, rounded to bytes as any image is.
    fn image(&mut self, camera: &PinholeCamera, latent: &[f32; LATENT_DIM]) -> Vec<f32> {
        to_unit(&self.renderer.image(self.field, camera, latent).rgb)
    }
}

/// The true images from above.
struct Above {
    camera: PinholeCamera,
    truths: Vec<Vec<f32>>,
    mean: Vec<f32>,
}

impl Above {
    fn of(subject: &Subject) -> Option<Self> {
        let posed = &subject.posed;
        let view = posed.scenario.bev_view?;
        let indices: Option<Vec<usize>> = (0..posed.scenario.state_count()).map(|s| posed.at(s, view)).collect();
        let indices = indices?;
        let truths: Vec<Vec<f32>> = indices.iter().map(|&i| to_unit(&posed.images[i].rgb)).collect();
        let mean = mean_image(&truths)?;
        Some(Self { camera: posed.dataset.frames()[*indices.first()?].camera, truths, mean })
    }

    fn images(&self, subject: &Subject, artist: &mut Artist, latents: &[Vec<[f32; LATENT_DIM]>]) -> FieldImages {
        let width = self.camera.width_px as usize;
        let [mut similar, mut actor, mut changed] = [(); 3].map(|()| Vec::new());
        let mut table = FieldImages::default();
        for (state, latents) in latents.iter().enumerate() {
            let truth = &self.truths[state];
            let within = actor_pixels(subject, state, &self.camera);
            let mut rows: Vec<Vec<f64>> = Vec::new();
            for latent in latents {
                let image = artist.image(&self.camera, latent);
                rows.push(self.truths.iter().map(|t| psnr_db(&image, t).unwrap_or(0.0)).collect());
                similar.extend(ssim(&image, truth, width));
                actor.extend(psnr_where(&image, truth, |i| within[i / 3]));
                changed.extend(psnr_of_changed(&image, truth, &self.mean));
            }
            table.renderings += rows.len();
            table.psnr_db.push((!rows.is_empty()).then(|| {
                (0..self.truths.len()).map(|t| rows.iter().map(|r| r[t]).sum::<f64>() / rows.len() as f64).collect()
            }));
        }
        let same = |a: usize, b: usize| subject.same_from_above(a, b);
        let scenario = &subject.posed.scenario;
        table.all = pair_means(&table.psnr_db, 0..latents.len(), same);
        for (branch, name) in scenario.branches.iter().enumerate() {
            let rows = scenario.states_of_branch(branch);
            table.by_branch.insert(name.clone(), pair_means(&table.psnr_db, rows, same));
        }
        table.ssim = mean(&similar);
        table.actor_db = mean(&actor);
        table.changed_db = mean(&changed);
        table
    }
}

fn novel_views(subject: &Subject, artist: &mut Artist, role: PoseRole) -> Option<NovelViews> {
    let posed = &subject.posed;
    let chosen = spread(&posed.with_roles(&[role]), MOST_IMAGES);
    let [mut psnr, mut of_mean, mut similar, mut actor] = [(); 4].map(|()| Vec::new());
    for &i in &chosen {
        let label = posed.labels[i];
        let camera = posed.dataset.frames()[i].camera;
        let truth = to_unit(&posed.images[i].rgb);
        let image = artist.image(&camera, &subject.manifest.states[label.state].mean);
        let of_pose: Vec<Vec<f32>> = (0..posed.scenario.state_count())
            .filter_map(|state| posed.at(state, label.view))
            .map(|i| to_unit(&posed.images[i].rgb))
            .collect();
        let within = actor_pixels(subject, label.state, &camera);
        let valid = posed.dataset.valid_in_all(&[i]);
        let psnr_of = |image: &[f32]| psnr_where(image, &truth, |v| valid(v / 3));
        psnr.extend(psnr_of(&image));
        of_mean.extend(mean_image(&of_pose).and_then(|m| psnr_of(&m)));
        similar.extend(ssim(&image, &truth, camera.width_px as usize));
        if label.observability == Observability::Full {
            actor.extend(psnr_where(&image, &truth, |v| within[v / 3] && valid(v / 3)));
        }
    }
    let (psnr_db, mean_image_db) = (mean(&psnr)?, mean(&of_mean)?);
    Some(NovelViews {
        psnr_db,
        mean_image_db,
        gain_db: psnr_db - mean_image_db,
        ssim: mean(&similar).unwrap_or(0.0),
        actor_db: mean(&actor),
        images: chosen.len(),
    })
}

/// For each pixel, whether its ray meets a dynamic box of a state. Occlusion is ignored: the actor's place is
/// unoccluded from above and from the poses where this is used.
fn actor_pixels(subject: &Subject, state: usize, camera: &PinholeCamera) -> Vec<bool> {
    let info = subject.posed.scenario.states.get(state);
    let boxes: Vec<_> = info.into_iter().flat_map(|s| &s.boxes).filter(|b| b.dynamic).map(|b| b.oriented_box).collect();
    (0..camera.height_px)
        .flat_map(|y| (0..camera.width_px).map(move |x| (x, y)))
        .map(|(x, y)| {
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            boxes.iter().any(|b| b.is_met_by(&ray))
        })
        .collect()
}
