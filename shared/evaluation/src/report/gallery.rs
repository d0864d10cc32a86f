//! Gallery of images (table 6).

use super::unknown_sheet::unknown_objects;
use crate::tables::spread;
use crate::{EvaluationError, Progress, Subject};
use carff_base::random::Key;
use carff_dataset::{Image, Observability, PoseRole};
use carff_decision::Sampling;
use carff_field::{Field, to_bytes};
use carff_messages::LATENT_DIM;
use carff_plots::{Marks, Panel, Series, StripCell, StripRow};
use carff_trials::SAMPLES;
use carff_trials::hypotheses::{birds_eye_camera, hypotheses};
use carff_trials::render::FieldRenderer;
use serde::{Deserialize, Serialize};
use std::path::Path;
use tch::Tensor;

/// The images that were drawn.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gallery {
    /// In the order of the page.
    pub images: Vec<GalleryImage>,
}

/// One image of the gallery.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GalleryImage {
    /// File name, in the folder of the page.
    pub file: String,
    /// Heading.
    pub title: String,
    /// Description.
    pub text: String,
}

/// Largest number of latents in the t-SNE map; perplexity and steps are the usual ones.
const MOST_LATENTS: usize = 1200;
const PERPLEXITY: f32 = 30.0;
const EPOCHS: usize = 1000;
/// Rows of the grids, and shown hypotheses of a belief.
const ROWS: usize = 8;
const HYPOTHESES: usize = 4;
/// Points along the longer side of a density slice.
const SLICE_PX: u32 = 160;
/// Path length through the field that gives a slice its opacity, metres: the field's surfaces are thin.
const SLICE_DEPTH_M: f32 = 0.25;
const HAZARD: [u8; 3] = [236, 140, 20];

/// Draws all images of the gallery into `out`.
pub fn gallery(subject: &Subject, out: &Path, on_progress: &dyn Fn(&Progress)) -> Result<Gallery, EvaluationError> {
    let mut gallery = Gallery::default();
    let tell = |done, line: &str| on_progress(&Progress { phase: "images", done, total: 7, line: line.to_owned() });
    let mut add = |drawn: bool, file: &str, title: &str, text: &str| {
        if drawn {
            let [file, title, text] = [file, title, text].map(str::to_owned);
            gallery.images.push(GalleryImage { file, title, text });
        }
    };
    tell(0, "from above");
    add(
        from_above(subject, &out.join("from-above.png"))?,
        "from-above.png",
        "States from above",
        "Each known state: the rendering of the field, and the true image.",
    );
    tell(1, "density");
    add(
        density(subject, &out.join("density.png"))?,
        "density.png",
        "Density from above",
        "Slices through the field at the height of the actors' centres: dark is dense.",
    );
    tell(2, "beliefs");
    add(
        beliefs(subject, &out.join("beliefs.png"))?,
        "beliefs.png",
        "Beliefs where the image leaves the branch open",
        "Ten samples of the next step's forecast, with one image for each distinct state that they show.",
    );
    tell(3, "reconstructions");
    add(
        reconstructions(subject, &out.join("reconstructions.png"))?,
        "reconstructions.png",
        "Reconstructions",
        "Input of the encoder, true image, image of the decoder, and image of the field from the same pose. The \
         decoder knows only the trained poses.",
    );
    tell(4, "t-SNE of latents");
    add(
        latents(subject, &out.join("latents.png"))?,
        "latents.png",
        "Latents",
        "t-SNE of the posterior means of all images, one map in three panels. Where the actor's place is visible, the \
         latents of a state form a cluster; where it is hidden, the latents of equivalent states mix, which is \
         correct. Equal images have equal points.",
    );
    tell(5, "training curves");
    let curves = &subject.training_curves;
    if !curves.is_empty() {
        carff_plots::curves(&out.join("curves.png"), "Training", curves)?;
    }
    add(!curves.is_empty(), "curves.png", "Training curves", "From the folder of the training run.");
    tell(6, "unknown objects");
    add(
        unknown_objects(subject, &out.join("unknown.png"))?,
        "unknown.png",
        "Unknown objects",
        "Camera image with the boxes of what no known state explains, the known state that explains the image best, and \
         the residual: how far each pixel is from that state, in deviations of the image's noise. Images come from the \
         first free pose that has each object in sight.",
    );
    tell(7, "");
    Ok(gallery)
}

fn from_above(subject: &Subject, path: &Path) -> Result<bool, EvaluationError> {
    let posed = &subject.posed;
    let (Ok(probe), Some(view)) = (&subject.probe, posed.scenario.bev_view) else { return Ok(false) };
    let mut renderer = FieldRenderer::new(subject.options.threads);
    let camera = birds_eye_camera(&posed.dataset, probe.field());
    // A long branch is shown in parts.
    let by_branch = |branch| spread(&posed.scenario.states_of_branch(branch).collect::<Vec<_>>(), ROWS);
    let mut rows = Vec::new();
    for (branch, name) in posed.scenario.branches.iter().enumerate() {
        for (kind, rendered) in [("rendered", true), ("true", false)] {
            let mut cells = Vec::new();
            for state in by_branch(branch) {
                let image = if rendered {
                    renderer.image(probe.field(), &camera, &subject.manifest.states[state].mean)
                } else {
                    let Some(index) = posed.at(state, view) else { continue };
                    posed.images[index].clone()
                };
                cells.push(StripCell::new(image, &[subject.state_name(state)]));
            }
            rows.push(StripRow { caption: vec![name.clone(), kind.to_owned()], cells });
        }
    }
    carff_plots::filmstrip(path, &format!("{}: states from above", subject.posed.scenario.name), "", &rows)?;
    Ok(true)
}

fn density(subject: &Subject, path: &Path) -> Result<bool, EvaluationError> {
    let Ok(probe) = &subject.probe else { return Ok(false) };
    let scenario = &subject.posed.scenario;
    let dynamic: Vec<f64> =
        scenario.states.iter().flat_map(|s| &s.boxes).filter(|b| b.dynamic).map(|b| b.oriented_box.center[2]).collect();
    let [low, high] = probe.field().config().bounds_m;
    let height_m = carff_base::statistics::mean(&dynamic).map_or(f32::midpoint(low[2], high[2]), |z| z as f32);
    let mut rows = Vec::new();
    for (branch, name) in scenario.branches.iter().enumerate() {
        let states: Vec<usize> = scenario.states_of_branch(branch).collect();
        let cells = spread(&states, ROWS).into_iter().map(|state| {
            StripCell::new(
                slice(probe.field(), &subject.manifest.states[state].mean, height_m),
                &[subject.state_name(state)],
            )
        });
        rows.push(StripRow { caption: vec![name.clone()], cells: cells.collect() });
    }
    let subtitle = format!(
        "Share of light that {SLICE_DEPTH_M} m of the field at a height of {height_m:.2} m absorb: white none, black \
         all. +X to the right, +Y up, {:.1} x {:.1} m.",
        high[0] - low[0],
        high[1] - low[1]
    );
    carff_plots::filmstrip(path, &format!("{}: density", scenario.name), &subtitle, &rows)?;
    Ok(true)
}

/// Horizontal slice of the field.
fn slice(field: &Field, latent: &[f32; LATENT_DIM], height_m: f32) -> Image {
    let (width_px, height_px, densities) = field.density_slice(latent, height_m, SLICE_PX);
    let rgb = densities.iter().flat_map(|d| [(255.0 * (-d.max(0.0) * SLICE_DEPTH_M).exp()) as u8; 3]).collect();
    Image { width_px, height_px, rgb }
}

/// Images that leave more than one branch open: trained poses first, in the order of poses, then held-out poses.
fn open_images(subject: &Subject) -> Vec<usize> {
    let posed = &subject.posed;
    let scenario = &posed.scenario;
    let open = |&i: &usize| {
        let label = posed.labels[i];
        let branch = scenario.branch_of(label.state);
        scenario.next_state(label.state) != label.state
            && posed.equivalent_states(label.view, label.state).iter().any(|&s| scenario.branch_of(s) != branch)
    };
    let of = |role, count| {
        let all: Vec<usize> = posed.with_roles(&[role]).into_iter().filter(open).collect();
        spread(&all, count)
    };
    let unseen = of(PoseRole::Unseen, ROWS / 2);
    let mut chosen = of(PoseRole::Rest, ROWS - unseen.len());
    chosen.extend(unseen);
    chosen
}

fn beliefs(subject: &Subject, path: &Path) -> Result<bool, EvaluationError> {
    let (Ok(probe), Ok(mixture)) = (&subject.probe, &subject.mixture) else { return Ok(false) };
    let posed = &subject.posed;
    let chosen = open_images(subject);
    if chosen.is_empty() {
        return Ok(false);
    }
    let mut probe_again = probe.clone();
    let mut renderer = FieldRenderer::new(subject.options.threads);
    let camera = birds_eye_camera(&posed.dataset, probe.field());
    let mut rows = Vec::new();
    for i in chosen {
        let label = posed.labels[i];
        let next = posed.scenario.next_state(label.state);
        let draws = mixture.forecast(&subject.posteriors[i]);
        let draws = draws.draw(SAMPLES, Sampling::Stratified, subject.options.seed, i as u64, 1);
        let latents: Vec<[f32; LATENT_DIM]> = draws.iter().map(|d| d.latent).collect();
        let probed = probe_again.probe_all(&latents);
        let names = probed
            .iter()
            .map(|p| p.reading.state.map_or_else(|| "no known state".to_owned(), |s| subject.state_name(s)));
        let groups = hypotheses(names.collect::<Vec<_>>());
        let seen = if label.role == Some(PoseRole::Unseen) { "held out" } else { "trained" };
        let mut cells =
            vec![StripCell::new(posed.images[i].clone(), &["camera".into(), format!("pose {}", label.view)])];
        let above = posed.scenario.bev_view.and_then(|view| posed.at(next, view));
        if let Some(above) = above {
            cells.push(StripCell::new(
                posed.images[above].clone(),
                &["true next state".into(), subject.state_name(next)],
            ));
        }
        for group in groups.into_iter().take(HYPOTHESES) {
            let hazard = probed[group.sample].shows_hazard();
            cells.push(StripCell {
                image: renderer.image(probe.field(), &camera, &latents[group.sample]),
                caption: vec![format!("{} of {SAMPLES}", group.count), group.name],
                emphasis: hazard.then_some(HAZARD),
            });
        }
        let caption = vec![subject.state_name(label.state), format!("pose {}, {seen}", label.view)];
        rows.push(StripRow { caption, cells });
    }
    let title = format!("{}: beliefs where several branches are open", subject.posed.scenario.name);
    let subtitle = "Camera image; true next state from above; and states of the forecast's samples, rendered from \
                    above, the most frequent first. Orange frame: a hazard.";
    carff_plots::filmstrip(path, &title, subtitle, &rows)?;
    Ok(true)
}

fn reconstructions(subject: &Subject, path: &Path) -> Result<bool, EvaluationError> {
    let posed = &subject.posed;
    let of = |role, count: usize| {
        // Every pose has all states in a row: a step that does not divide their number reaches all of them.
        let all = posed.with_roles(&[role]);
        let step = (all.len() / count.max(1)).max(1) + 1;
        all.into_iter().step_by(step).take(count).collect::<Vec<usize>>()
    };
    let mut chosen = of(PoseRole::Rest, ROWS - ROWS / 4);
    chosen.extend(of(PoseRole::Unseen, ROWS / 4));
    let mut renderer = FieldRenderer::new(subject.options.threads);
    let mut rows = Vec::new();
    for i in chosen {
        let label = posed.labels[i];
        let unseen = label.role == Some(PoseRole::Unseen);
        let observability = match label.observability {
            Observability::Full => "place fully visible",
            Observability::Partial => "place partly visible",
            Observability::None => "place hidden",
        };
        let mut cells = vec![
            StripCell::new(image_of(&subject.noisy_input(i)), &["input".into(), "with sensor noise".into()]),
            StripCell::new(image_of(&posed.targets(&[i])), &["true".into()]),
        ];
        let (out, mean) = subject.decoding().images(&[(i, subject.posteriors[i].mean)]);
        if !unseen {
            cells.push(StripCell::new(image_of(&out), &["decoded".into()]));
            cells.push(StripCell::new(image_of(&mean), &["mean of the pose".into(), "no model".into()]));
        }
        if let Ok(probe) = &subject.probe {
            let camera = posed.dataset.frames()[i].camera;
            let latent = &subject.posteriors[i].mean;
            let longest = camera.width_px.max(camera.height_px).max(1);
            let shown = |side: u32| (side * 128 / longest).max(1);
            let camera = camera.resized(shown(camera.width_px), shown(camera.height_px));
            cells.push(StripCell::new(
                renderer.image(probe.field(), &camera, latent),
                &["field".into(), "latent of the input".into()],
            ));
        }
        let seen = if unseen { "held out" } else { "trained" };
        let caption =
            vec![subject.state_name(label.state), format!("pose {}, {seen}", label.view), observability.to_owned()];
        rows.push(StripRow { caption, cells });
    }
    let title = format!("{}: reconstructions", subject.posed.scenario.name);
    carff_plots::filmstrip(path, &title, "Images of 128 x 128 pixels, the decoder's size.", &rows)?;
    Ok(true)
}

/// Image of a `[1, 3, H, W]` tensor in 0..=1.
fn image_of(tensor: &Tensor) -> Image {
    let size = tensor.size();
    let pixels = tensor.get(0).permute([1, 2, 0]).contiguous();
    let mut values = vec![0.0_f32; pixels.numel()];
    let count = values.len();
    pixels.copy_data(&mut values, count);
    Image { width_px: size[3] as u32, height_px: size[2] as u32, rgb: to_bytes(&values) }
}

fn latents(subject: &Subject, path: &Path) -> Result<bool, EvaluationError> {
    let posed = &subject.posed;
    let all: Vec<usize> = (0..posed.labels.len()).collect();
    let chosen = spread(&all, MOST_LATENTS);
    if chosen.len() < 8 {
        return Ok(false);
    }
    let rows: Vec<&[f32]> = chosen.iter().map(|&i| subject.posteriors[i].mean.as_slice()).collect();
    let points = embedded(&rows, subject.options.seed);
    let states = posed.scenario.state_count();
    let panel = |title: &str, counts: &dyn Fn(usize) -> bool| Panel {
        title: title.to_owned(),
        series: (0..states)
            .map(|state| Series {
                name: subject.state_name(state),
                points: chosen
                    .iter()
                    .zip(&points)
                    .filter(|(i, _)| posed.labels[**i].state == state && counts(**i))
                    .map(|(_, p)| *p)
                    .collect(),
                marks: Marks::Dots,
                ..Series::default()
            })
            .collect(),
        ..Panel::default()
    };
    let seen = |i: usize| posed.labels[i].observability;
    let unseen = |i: usize| posed.labels[i].role == Some(PoseRole::Unseen);
    let panels = [
        panel("Trained poses, actor's place fully visible", &|i| !unseen(i) && seen(i) == Observability::Full),
        panel("Trained poses, partly visible or hidden", &|i| !unseen(i) && seen(i) != Observability::Full),
        panel("Held-out poses", &unseen),
    ];
    let title = format!("{}: posterior means, t-SNE", subject.posed.scenario.name);
    carff_plots::curves(path, &title, &panels)?;
    Ok(true)
}

/// Two-dimensional t-SNE map of rows, reproducible for equal rows and seed.
fn embedded(rows: &[&[f32]], seed: u64) -> Vec<(f64, f64)> {
    let start = (0..rows.len())
        .flat_map(|i| carff_base::random::gaussians::<2>(Key::named("tsne", seed, i as u64)).map(|u| u * 1e-2));
    let start: Vec<f32> = start.collect();
    let fit = || {
        let mut map = bhtsne::tSNE::<f32, &[f32], 2>::new(rows);
        map.perplexity(PERPLEXITY.min((rows.len() - 1) as f32 / 4.0))
            .epochs(EPOCHS)
            .initial_embedding(start)
            .exact(|a, b| a.iter().zip(b.iter()).map(|(a, b)| (a - b).powi(2)).sum());
        map.embedding()
    };
    // On several threads the order of summation varies.
    let map = match rayon::ThreadPoolBuilder::new().num_threads(1).build() {
        Ok(pool) => pool.install(fit),
        Err(_) => fit(),
    };
    map.chunks_exact(2).map(|p| (f64::from(p[0]), f64::from(p[1]))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Two clouds apart stay apart on the map, each point nearer to its own cloud; the same seed gives the same map.
    #[test]
    fn clouds_stay_apart() {
        let cloud = |centre: f32, seed| {
            (0..40).map(move |frame| {
                carff_base::random::gaussians::<8>(Key { seed, frame, step: 0, sample: 0 }).map(|u| centre + 0.1 * u)
            })
        };
        let points: Vec<[f32; 8]> = cloud(-1.0, 1).chain(cloud(1.0, 2)).collect();
        let rows: Vec<&[f32]> = points.iter().map(<[f32; 8]>::as_slice).collect();
        let map = embedded(&rows, 3);
        let centre = |of: &[(f64, f64)]| {
            let n = of.len() as f64;
            (of.iter().map(|p| p.0).sum::<f64>() / n, of.iter().map(|p| p.1).sum::<f64>() / n)
        };
        let centres = [centre(&map[..40]), centre(&map[40..])];
        let distance = |p: (f64, f64), c: (f64, f64)| (p.0 - c.0).hypot(p.1 - c.1);
        for (i, p) in map.iter().enumerate() {
            assert!(distance(*p, centres[i / 40]) < distance(*p, centres[1 - i / 40]), "point {i} of {map:?}");
        }
        assert_eq!(map, embedded(&rows, 3));
    }

    /// A tensor becomes an image of its size, with interleaved colours clamped to bytes.
    #[test]
    fn tensors_become_images() {
        let planes = Tensor::from_slice(&[0.0_f32, 1.0, 0.5, 2.0, -1.0, 0.2]).view([1, 3, 1, 2]);
        let image = image_of(&planes);
        assert_eq!((image.width_px, image.height_px), (2, 1));
        assert_eq!(image.rgb, [0, 128, 0, 255, 255, 51]);
    }
}
