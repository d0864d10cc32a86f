//! Table 1: pictures of the field against true ones, from above and from poses it was not trained on.

use crate::subject::{ROLES, Subject};
use carff_checkpoint::FieldProbe;
use carff_dataset::{Image, PoseRole};
use carff_decision::Sampling;
use carff_evaluation::{PairMeans, pair_means};
use carff_field::{RenderBuffer, RenderOptions};
use carff_geometry::PinholeCamera;
use carff_messages::LATENT_DIM;
use carff_metrics::{mean, psnr_db, psnr_where, ssim};
use carff_training::run::Progress;
use serde::{Deserialize, Serialize};
use std::collections::BTreeMap;

/// The field's pictures against true ones.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PictureTable {
    /// What the states are called, in the order of the matrices.
    pub states: Vec<String>,
    /// Rendered with the latents that stand for the known states. Absent where the set names no view from above.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub toggled: Option<FieldPictures>,
    /// Rendered with latents drawn from forecasts of the step before, from pictures that tell their state.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub predicted: Option<FieldPictures>,
    /// From above: the mean picture of all states, which takes no model, dB.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub mean_picture_db: Option<f64>,
    /// Pictures from other poses, by part of the poses: `trained`, `unseen`. Unseen poses were held out from the field's
    /// training.
    pub novel_views: BTreeMap<String, NovelViews>,
}

/// Pictures from above.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct FieldPictures {
    /// `psnr_db[rendered][true]`; null for a state that nothing forecasts.
    pub psnr_db: Vec<Option<Vec<f64>>>,
    /// Means over all pairs of states that look different.
    pub all: PairMeans,
    /// Means over the rows of each branch.
    pub by_branch: BTreeMap<String, PairMeans>,
    /// Structural similarity of matching pairs.
    pub ssim: Option<f64>,
    /// PSNR of matching pairs inside the dynamic actors' pixels, dB; absent where the set has no dynamic boxes.
    pub actor_db: Option<f64>,
    /// PSNR of matching pairs over the pixels that differ by more than 12 of 255 from the mean of all states, dB.
    pub changed_db: Option<f64>,
    /// Renderings.
    pub renderings: usize,
}

/// Pictures from poses of one part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct NovelViews {
    /// Mean PSNR, dB.
    pub psnr_db: f64,
    /// Mean PSNR of the pose's mean picture over the states, which takes no model but knows the pose's true pictures, dB.
    pub mean_picture_db: f64,
    /// PSNR minus that, dB.
    pub gain_db: f64,
    /// Mean structural similarity.
    pub ssim: f64,
    /// Mean PSNR inside the dynamic actors' pixels, where any are in sight, dB.
    pub actor_db: Option<f64>,
    /// Pictures.
    pub pictures: usize,
}

/// Most pictures of one part of the poses.
const MOST_PICTURES: usize = 60;
/// Renderings for each forecast state.
const PREDICTED: usize = 6;

pub fn picture_table(subject: &Subject, on_progress: &dyn Fn(&Progress)) -> Result<PictureTable, String> {
    let probe = subject.probe.as_ref().map_err(Clone::clone)?;
    let states = subject.manifest.scenario.state_count();
    let mut artist = Artist::new(probe, subject.options.threads);
    let mut table = PictureTable { states: (0..states).map(|s| subject.state_name(s)).collect(), ..Default::default() };
    let tell = |done, line: &str| on_progress(&Progress { stage: "psnr", done, total: 4, line: line.to_owned() });
    tell(0, "from above");
    if let Some(above) = Above::of(subject) {
        table.mean_picture_db = mean(&above.truths.iter().filter_map(|t| psnr_db(&above.mean, t)).collect::<Vec<_>>());
        let toggled: Vec<Vec<[f32; LATENT_DIM]>> = subject.manifest.states.iter().map(|s| vec![s.mean]).collect();
        table.toggled = Some(above.pictures(subject, &mut artist, &toggled));
        tell(1, "forecasts from above");
        let predicted = predicted_latents(subject);
        if predicted.iter().any(|p| !p.is_empty()) {
            table.predicted = Some(above.pictures(subject, &mut artist, &predicted));
        }
    }
    for (i, (role, name)) in ROLES.into_iter().filter(|(role, _)| *role != PoseRole::Calibration).enumerate() {
        tell(2 + i, &format!("{name} poses"));
        if let Some(views) = novel_views(subject, &mut artist, role) {
            table.novel_views.insert(name.to_owned(), views);
        }
    }
    tell(4, "");
    Ok(table)
}

/// Per state latents drawn from forecasts of the step before it, one from each of some pictures of trained poses that
/// look like no other state's.
fn predicted_latents(subject: &Subject) -> Vec<Vec<[f32; LATENT_DIM]>> {
    let pictures = &subject.pictures;
    let mut by_state = vec![Vec::new(); pictures.scenario.state_count()];
    let Ok(mixture) = &subject.mixture else { return by_state };
    let trained = pictures.with_roles(&[PoseRole::Rest]);
    for state in 0..by_state.len() {
        let next = pictures.next_state(state);
        let telling = |i: &usize| {
            let label = pictures.labels[*i];
            label.state == state && pictures.alike(label.view, state).len() == 1
        };
        let inputs: Vec<usize> = trained.iter().copied().filter(telling).collect();
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

/// At most `count` of them, evenly spread.
pub fn spread(all: &[usize], count: usize) -> Vec<usize> {
    let n = all.len().min(count);
    (0..n).map(|i| all[i * all.len() / n]).collect()
}

/// Renders for pictures that are compared.
pub struct Artist<'a> {
    probe: &'a FieldProbe,
    options: RenderOptions,
    buffer: RenderBuffer,
}

impl<'a> Artist<'a> {
    pub fn new(probe: &'a FieldProbe, threads: usize) -> Self {
        let options = RenderOptions { threads: threads.max(1), ..RenderOptions::default() };
        Self { probe, options, buffer: RenderBuffer::new() }
    }

    /// A picture, rounded to bytes as any picture is.
    pub fn picture(&mut self, camera: &PinholeCamera, latent: &[f32; LATENT_DIM]) -> Image {
        self.probe.field().render(camera, latent, &self.options, &mut self.buffer);
        let rgb = self.buffer.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
        Image { width_px: camera.width_px, height_px: camera.height_px, rgb }
    }
}

/// The true pictures from above.
struct Above {
    camera: PinholeCamera,
    truths: Vec<Vec<f32>>,
    mean: Vec<f32>,
}

impl Above {
    fn of(subject: &Subject) -> Option<Self> {
        let pictures = &subject.pictures;
        let view = pictures.scenario.bev_view?;
        let indices: Option<Vec<usize>> = (0..pictures.scenario.state_count()).map(|s| pictures.at(s, view)).collect();
        let indices = indices?;
        let truths: Vec<Vec<f32>> = indices.iter().map(|&i| unit(&pictures.images[i])).collect();
        let mean = mean_picture(&truths)?;
        Some(Self { camera: pictures.dataset.frames()[*indices.first()?].camera, truths, mean })
    }

    fn pictures(&self, subject: &Subject, artist: &mut Artist, latents: &[Vec<[f32; LATENT_DIM]>]) -> FieldPictures {
        let width = self.camera.width_px as usize;
        let [mut similar, mut actor, mut changed] = [(); 3].map(|()| Vec::new());
        let mut table = FieldPictures::default();
        for (state, latents) in latents.iter().enumerate() {
            let truth = &self.truths[state];
            let within = actor_pixels(subject, state, &self.camera);
            let mut rows: Vec<Vec<f64>> = Vec::new();
            for latent in latents {
                let picture = unit(&artist.picture(&self.camera, latent));
                rows.push(self.truths.iter().map(|t| psnr_db(&picture, t).unwrap_or(0.0)).collect());
                similar.extend(ssim(&picture, truth, width));
                actor.extend(psnr_where(&picture, truth, |i| within[i / 3]));
                changed.extend(psnr_where(&picture, truth, |i| {
                    let pixel = i / 3 * 3;
                    (pixel..pixel + 3).any(|j| (self.mean[j] - truth[j]).abs() > 12.0 / 255.0)
                }));
            }
            table.renderings += rows.len();
            table.psnr_db.push((!rows.is_empty()).then(|| {
                (0..self.truths.len()).map(|t| rows.iter().map(|r| r[t]).sum::<f64>() / rows.len() as f64).collect()
            }));
        }
        let same = |a: usize, b: usize| subject.same_from_above(a, b);
        let scenario = &subject.manifest.scenario;
        table.all = pair_means(&table.psnr_db, 0..latents.len(), same);
        for (branch, name) in scenario.branches.iter().enumerate() {
            let rows = branch * scenario.timestamps..(branch + 1) * scenario.timestamps;
            table.by_branch.insert(name.clone(), pair_means(&table.psnr_db, rows, same));
        }
        table.ssim = mean(&similar);
        table.actor_db = mean(&actor);
        table.changed_db = mean(&changed);
        table
    }
}

fn novel_views(subject: &Subject, artist: &mut Artist, role: PoseRole) -> Option<NovelViews> {
    let pictures = &subject.pictures;
    let chosen = spread(&pictures.with_roles(&[role]), MOST_PICTURES);
    let [mut psnr, mut of_mean, mut similar, mut actor] = [(); 4].map(|()| Vec::new());
    for &i in &chosen {
        let label = pictures.labels[i];
        let camera = pictures.dataset.frames()[i].camera;
        let truth = unit(&pictures.images[i]);
        let picture = unit(&artist.picture(&camera, &subject.manifest.states[label.state].mean));
        let of_pose: Vec<Vec<f32>> = (0..pictures.scenario.state_count())
            .filter_map(|state| pictures.at(state, label.view))
            .map(|i| unit(&pictures.images[i]))
            .collect();
        let within = actor_pixels(subject, label.state, &camera);
        psnr.extend(psnr_db(&picture, &truth));
        of_mean.extend(mean_picture(&of_pose).and_then(|m| psnr_db(&m, &truth)));
        similar.extend(ssim(&picture, &truth, camera.width_px as usize));
        if label.observability == carff_dataset::Observability::Full {
            actor.extend(psnr_where(&picture, &truth, |i| within[i / 3]));
        }
    }
    let (psnr_db, mean_picture_db) = (mean(&psnr)?, mean(&of_mean)?);
    Some(NovelViews {
        psnr_db,
        mean_picture_db,
        gain_db: psnr_db - mean_picture_db,
        ssim: mean(&similar).unwrap_or(0.0),
        actor_db: mean(&actor),
        pictures: chosen.len(),
    })
}

/// Per pixel whether its ray meets a dynamic box of a state. What stands before the box is not asked: from above, and
/// from poses that show the place fully, that is nothing.
fn actor_pixels(subject: &Subject, state: usize, camera: &PinholeCamera) -> Vec<bool> {
    let info = subject.pictures.scenario.states.get(state);
    let boxes: Vec<_> = info.into_iter().flat_map(|s| &s.boxes).filter(|b| b.dynamic).map(|b| b.oriented_box).collect();
    (0..camera.height_px)
        .flat_map(|y| (0..camera.width_px).map(move |x| (x, y)))
        .map(|(x, y)| {
            let ray = camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5);
            boxes.iter().any(|b| b.is_met_by(&ray))
        })
        .collect()
}

/// The mean of pictures; `None` for none, or of different sizes.
fn mean_picture(pictures: &[Vec<f32>]) -> Option<Vec<f32>> {
    let first = pictures.first()?;
    let n = pictures.len() as f32;
    let sum = |i: usize| pictures.iter().map(|p| p[i]).sum::<f32>();
    pictures.iter().all(|p| p.len() == first.len()).then(|| (0..first.len()).map(|i| sum(i) / n).collect())
}

fn unit(image: &Image) -> Vec<f32> {
    image.rgb.iter().map(|&b| f32::from(b) / 255.0).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All of few, and so many of many, from the first on and evenly spread.
    #[test]
    fn spread_is_even() {
        assert_eq!(spread(&[3, 5], 4), [3, 5]);
        assert_eq!(spread(&(0..100).collect::<Vec<_>>(), 4), [0, 25, 50, 75]);
        assert!(spread(&[], 4).is_empty());
    }

    /// The mean of pictures is taken pixel by pixel; of different sizes there is none.
    #[test]
    fn mean_of_pictures() {
        assert_eq!(mean_picture(&[vec![0.0, 1.0], vec![1.0, 1.0]]), Some(vec![0.5, 1.0]));
        assert_eq!(mean_picture(&[vec![0.0, 1.0], vec![1.0]]), None);
        assert_eq!(mean_picture(&[]), None);
    }
}
