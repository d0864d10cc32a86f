//! Table 6: pictures for people.

use crate::ResultsError;
use crate::pictures::{Artist, spread};
use crate::subject::Subject;
use carff_dataset::{Image, Observability, PoseRole};
use carff_decision::Sampling;
use carff_evaluation::hypotheses::{birds_eye_camera, hypotheses};
use carff_field::Field;
use carff_messages::LATENT_DIM;
use carff_plots::{Marks, Panel, Series, StripCell, StripRow};
use carff_random::Key;
use carff_training::{curves, run::Progress, vae::decoded};
use serde::{Deserialize, Serialize};
use std::path::Path;
use tch::{Kind, Tensor};

/// The pictures that were drawn.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Gallery {
    /// In the order of the page.
    pub pictures: Vec<GalleryPicture>,
}

/// One of them.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct GalleryPicture {
    /// File beside the page.
    pub file: String,
    /// Heading.
    pub title: String,
    /// What is to be seen.
    pub text: String,
}

/// Most latents in the t-SNE map; perplexity and steps are the usual ones.
const MOST_LATENTS: usize = 1200;
const PERPLEXITY: f32 = 30.0;
const EPOCHS: usize = 1000;
/// Rows of the grids, samples of a belief, hypotheses that are shown of it.
const ROWS: usize = 8;
const SAMPLES: usize = 10;
const HYPOTHESES: usize = 4;
/// Points along the longer side of a density slice.
const SLICE_PX: usize = 160;
/// A surface in a slice is as opaque as this length of it is, metres: the field's surfaces are thin.
const SLICE_DEPTH_M: f32 = 0.25;
const HAZARD: [u8; 3] = [236, 140, 20];

pub fn gallery(subject: &Subject, out: &Path, on_progress: &dyn Fn(&Progress)) -> Result<Gallery, ResultsError> {
    let mut gallery = Gallery::default();
    let tell = |done, line: &str| on_progress(&Progress { stage: "pictures", done, total: 6, line: line.to_owned() });
    let mut add = |drawn: bool, file: &str, title: &str, text: &str| {
        if drawn {
            let [file, title, text] = [file, title, text].map(str::to_owned);
            gallery.pictures.push(GalleryPicture { file, title, text });
        }
    };
    tell(0, "from above");
    add(
        from_above(subject, &out.join("from-above.png"))?,
        "from-above.png",
        "States from above",
        "Each known state as the field renders it, and as it is.",
    );
    tell(1, "density");
    add(
        density(subject, &out.join("density.png"))?,
        "density.png",
        "Density from above",
        "Slices through the field at the height of the actors' middle: dark is dense.",
    );
    tell(2, "beliefs");
    add(
        beliefs(subject, &out.join("beliefs.png"))?,
        "beliefs.png",
        "Beliefs where the picture hides what comes",
        "Ten samples of the next step's forecast, one picture for each distinct state that they show.",
    );
    tell(3, "reconstructions");
    add(
        reconstructions(subject, &out.join("reconstructions.png"))?,
        "reconstructions.png",
        "Reconstructions",
        "What the encoder sees, the true picture, what the decoder makes of the latent, and what the field shows from \
         the same pose. The decoder knows the trained poses alone.",
    );
    tell(4, "t-SNE of latents");
    add(
        latents(subject, &out.join("latents.png"))?,
        "latents.png",
        "Latents",
        "t-SNE of the posterior means of all pictures, one map in three panels. Where the actor's place is seen, latents \
         of a state lie together and apart from others; where it is hidden, states that are one picture mix, as they \
         must. Pictures that are the same lie on each other.",
    );
    tell(5, "training curves");
    let run = subject.run_dir.as_deref();
    add(
        run.map(|dir| curves::draw_to(dir, &out.join("curves.png"))).transpose()?.unwrap_or(false),
        "curves.png",
        "Training curves",
        "From the run's folder.",
    );
    tell(6, "");
    Ok(gallery)
}

fn cell(image: Image, caption: &[String]) -> StripCell {
    StripCell { image, caption: caption.to_vec(), emphasis: None }
}

fn from_above(subject: &Subject, path: &Path) -> Result<bool, ResultsError> {
    let (Ok(probe), Some(view)) = (&subject.probe, subject.pictures.scenario.bev_view) else { return Ok(false) };
    let mut artist = Artist::new(probe, subject.options.threads);
    let camera = birds_eye_camera(&subject.pictures.dataset, probe.field());
    let by_branch = |branch: usize| -> Vec<usize> {
        let steps = subject.manifest.scenario.timestamps;
        // A long course is shown in parts.
        spread(&(branch * steps..(branch + 1) * steps).collect::<Vec<_>>(), ROWS)
    };
    let mut rows = Vec::new();
    for (branch, name) in subject.manifest.scenario.branches.iter().enumerate() {
        for (kind, rendered) in [("rendered", true), ("true", false)] {
            let mut cells = Vec::new();
            for state in by_branch(branch) {
                let image = if rendered {
                    artist.picture(&camera, &subject.manifest.states[state].mean)
                } else {
                    let Some(index) = subject.pictures.at(state, view) else { continue };
                    subject.pictures.images[index].clone()
                };
                cells.push(cell(image, &[subject.state_name(state)]));
            }
            rows.push(StripRow { caption: vec![name.clone(), kind.to_owned()], cells });
        }
    }
    carff_plots::filmstrip(path, &format!("{}: states from above", subject.manifest.scenario.name), "", &rows)?;
    Ok(true)
}

fn density(subject: &Subject, path: &Path) -> Result<bool, ResultsError> {
    let Ok(probe) = &subject.probe else { return Ok(false) };
    let scenario = &subject.pictures.scenario;
    let dynamic: Vec<f64> =
        scenario.states.iter().flat_map(|s| &s.boxes).filter(|b| b.dynamic).map(|b| b.oriented_box.center[2]).collect();
    let [low, high] = probe.field().config().bounds_m;
    let height_m = carff_metrics::mean(&dynamic).map_or(f32::midpoint(low[2], high[2]), |z| z as f32);
    let steps = scenario.timestamps.max(1);
    let mut rows = Vec::new();
    for (branch, name) in scenario.branches.iter().enumerate() {
        let states: Vec<usize> = (branch * steps..(branch + 1) * steps).collect();
        let cells = spread(&states, ROWS).into_iter().map(|state| {
            cell(slice(probe.field(), &subject.manifest.states[state].mean, height_m), &[subject.state_name(state)])
        });
        rows.push(StripRow { caption: vec![name.clone()], cells: cells.collect() });
    }
    let subtitle = format!(
        "Share of light that {SLICE_DEPTH_M} m of what lies at a height of {height_m:.2} m stops: white none, black all. \
         +X to the right, +Y up, {:.1} x {:.1} m.",
        high[0] - low[0],
        high[1] - low[1]
    );
    carff_plots::filmstrip(path, &format!("{}: density", scenario.name), &subtitle, &rows)?;
    Ok(true)
}

/// One slice of the field.
fn slice(field: &Field, latent: &[f32; LATENT_DIM], height_m: f32) -> Image {
    let [low, high] = field.config().bounds_m;
    let extent = [high[0] - low[0], high[1] - low[1]];
    let pixel_m = extent[0].max(extent[1]) / SLICE_PX as f32;
    let [width, height] = extent.map(|e| ((e / pixel_m).round() as usize).max(1));
    let points: Vec<[f32; 3]> = (0..height)
        .flat_map(|y| (0..width).map(move |x| (x, y)))
        .map(|(x, y)| [low[0] + (x as f32 + 0.5) * pixel_m, high[1] - (y as f32 + 0.5) * pixel_m, height_m])
        .collect();
    let mut densities = vec![0.0; points.len()];
    field.density(&points, latent, &mut densities);
    let rgb = densities.iter().flat_map(|d| [(255.0 * (-d.max(0.0) * SLICE_DEPTH_M).exp()) as u8; 3]).collect();
    Image { width_px: width as u32, height_px: height as u32, rgb }
}

/// Pictures that leave more than one branch open: trained poses first, in the order of poses, and unseen ones.
fn open_pictures(subject: &Subject) -> Vec<usize> {
    let pictures = &subject.pictures;
    let steps = subject.manifest.scenario.timestamps.max(1);
    let open = |&i: &usize| {
        let label = pictures.labels[i];
        let branch = label.state / steps;
        pictures.next_state(label.state) != label.state
            && pictures.alike(label.view, label.state).iter().any(|s| s / steps != branch)
    };
    let of = |role, count| {
        let all: Vec<usize> = pictures.with_roles(&[role]).into_iter().filter(open).collect();
        spread(&all, count)
    };
    let unseen = of(PoseRole::Unseen, ROWS / 2);
    let mut chosen = of(PoseRole::Rest, ROWS - unseen.len());
    chosen.extend(unseen);
    chosen
}

fn beliefs(subject: &Subject, path: &Path) -> Result<bool, ResultsError> {
    let (Ok(probe), Ok(mixture)) = (&subject.probe, &subject.mixture) else { return Ok(false) };
    let pictures = &subject.pictures;
    let chosen = open_pictures(subject);
    if chosen.is_empty() {
        return Ok(false);
    }
    let mut probe_again = probe.clone();
    let mut artist = Artist::new(probe, subject.options.threads);
    let camera = birds_eye_camera(&pictures.dataset, probe.field());
    let mut rows = Vec::new();
    for i in chosen {
        let label = pictures.labels[i];
        let next = pictures.next_state(label.state);
        let draws = mixture.forecast(&subject.posteriors[i]);
        let draws = draws.draw(SAMPLES, Sampling::Stratified, subject.options.seed, i as u64, 1);
        let latents: Vec<[f32; LATENT_DIM]> = draws.iter().map(|d| d.latent).collect();
        let probed = probe_again.probe_all(&latents);
        let names = probed
            .iter()
            .map(|p| p.reading.state.map_or_else(|| "none of the known states".to_owned(), |s| subject.state_name(s)));
        let groups = hypotheses(names.collect::<Vec<_>>());
        let seen = if label.role == Some(PoseRole::Unseen) { "never trained on" } else { "trained" };
        let mut cells = vec![cell(pictures.images[i].clone(), &["camera".into(), format!("pose {}", label.view)])];
        let above = pictures.scenario.bev_view.and_then(|view| pictures.at(next, view));
        if let Some(above) = above {
            cells.push(cell(pictures.images[above].clone(), &["what came".into(), subject.state_name(next)]));
        }
        for group in groups.into_iter().take(HYPOTHESES) {
            let hazard = probed[group.sample].reading.hazard_likelihood > 0.5;
            cells.push(StripCell {
                image: artist.picture(&camera, &latents[group.sample]),
                caption: vec![format!("{} of {SAMPLES}", group.count), group.name],
                emphasis: hazard.then_some(HAZARD),
            });
        }
        let caption = vec![subject.state_name(label.state), format!("pose {}, {seen}", label.view)];
        rows.push(StripRow { caption, cells });
    }
    let title = format!("{}: beliefs where several branches are open", subject.manifest.scenario.name);
    let subtitle = "What the camera shows; what came, from above; and what the samples of the forecast show, rendered \
                    from above, the most frequent first. Framed orange: a hazard.";
    carff_plots::filmstrip(path, &title, subtitle, &rows)?;
    Ok(true)
}

fn reconstructions(subject: &Subject, path: &Path) -> Result<bool, ResultsError> {
    let pictures = &subject.pictures;
    let of = |role, count: usize| {
        // Every pose has all states in a row: a step that is no divisor of their number meets all of them.
        let all = pictures.with_roles(&[role]);
        let step = (all.len() / count.max(1)).max(1) + 1;
        all.into_iter().step_by(step).take(count).collect::<Vec<usize>>()
    };
    let mut chosen = of(PoseRole::Rest, ROWS - ROWS / 4);
    chosen.extend(of(PoseRole::Unseen, ROWS / 4));
    let mut artist = subject.probe.as_ref().ok().map(|probe| Artist::new(probe, subject.options.threads));
    let mut rows = Vec::new();
    for i in chosen {
        let label = pictures.labels[i];
        let unseen = label.role == Some(PoseRole::Unseen);
        let observability = match label.observability {
            Observability::Full => "place fully visible",
            Observability::Partial => "place partly visible",
            Observability::None => "place hidden",
        };
        let mut cells = vec![
            cell(picture_of(&subject.noisy_input(i)), &["input".into(), "with sensor noise".into()]),
            cell(picture_of(&pictures.targets(&[i])), &["true".into()]),
        ];
        let (out, mean) = decoded(pictures, &subject.decoder, subject.residual(), &[(i, subject.posteriors[i].mean)]);
        if !unseen {
            cells.push(cell(picture_of(&out), &["decoded".into()]));
            cells.push(cell(picture_of(&mean), &["mean of the pose".into(), "no model".into()]));
        }
        if let Some(artist) = &mut artist {
            let camera = pictures.dataset.frames()[i].camera;
            let latent = &subject.posteriors[i].mean;
            let longest = camera.width_px.max(camera.height_px).max(1);
            let shown = |side: u32| (side * 128 / longest).max(1);
            let camera = camera.resized(shown(camera.width_px), shown(camera.height_px));
            cells.push(cell(artist.picture(&camera, latent), &["field".into(), "latent of the input".into()]));
        }
        let seen = if unseen { "never trained on" } else { "trained" };
        let caption =
            vec![subject.state_name(label.state), format!("pose {}, {seen}", label.view), observability.to_owned()];
        rows.push(StripRow { caption, cells });
    }
    let title = format!("{}: reconstructions", subject.manifest.scenario.name);
    carff_plots::filmstrip(path, &title, "Pictures of 128 x 128 pixels, the decoder's size.", &rows)?;
    Ok(true)
}

/// A `[1, 3, H, W]` tensor in 0..=1 as a picture.
fn picture_of(tensor: &Tensor) -> Image {
    let size = tensor.size();
    let bytes = (tensor.get(0).permute([1, 2, 0]).clamp(0.0, 1.0) * 255.0 + 0.5).to_kind(Kind::Uint8).contiguous();
    let mut rgb = vec![0_u8; bytes.numel()];
    let count = rgb.len();
    bytes.copy_data(&mut rgb, count);
    Image { width_px: size[3] as u32, height_px: size[2] as u32, rgb }
}

fn latents(subject: &Subject, path: &Path) -> Result<bool, ResultsError> {
    let pictures = &subject.pictures;
    let all: Vec<usize> = (0..pictures.labels.len()).collect();
    let chosen = spread(&all, MOST_LATENTS);
    if chosen.len() < 8 {
        return Ok(false);
    }
    let rows: Vec<&[f32]> = chosen.iter().map(|&i| subject.posteriors[i].mean.as_slice()).collect();
    let points = embedded(&rows, subject.options.seed);
    let states = pictures.scenario.state_count();
    let panel = |title: &str, counts: &dyn Fn(usize) -> bool| Panel {
        title: title.to_owned(),
        series: (0..states)
            .map(|state| Series {
                name: subject.state_name(state),
                points: chosen
                    .iter()
                    .zip(&points)
                    .filter(|(i, _)| pictures.labels[**i].state == state && counts(**i))
                    .map(|(_, p)| *p)
                    .collect(),
                marks: Marks::Dots,
                ..Series::default()
            })
            .collect(),
        ..Panel::default()
    };
    let seen = |i: usize| pictures.labels[i].observability;
    let unseen = |i: usize| pictures.labels[i].role == Some(PoseRole::Unseen);
    let panels = [
        panel("Trained poses, actor's place fully visible", &|i| !unseen(i) && seen(i) == Observability::Full),
        panel("Trained poses, partly visible or hidden", &|i| !unseen(i) && seen(i) != Observability::Full),
        panel("Poses never trained on", &unseen),
    ];
    let title = format!("{}: posterior means, t-SNE", subject.manifest.scenario.name);
    carff_plots::curves(path, &title, &panels)?;
    Ok(true)
}

/// Two-dimensional t-SNE map of rows. The same rows and seed give the same map.
fn embedded(rows: &[&[f32]], seed: u64) -> Vec<(f64, f64)> {
    let start = (0..rows.len()).flat_map(|i| {
        let key = Key { seed, frame: i as u64, step: 0x7473_6e65, sample: 0 };
        carff_random::gaussians::<2>(key).map(|u| u * 1e-2)
    });
    let start: Vec<f32> = start.collect();
    let fit = || {
        let mut map = bhtsne::tSNE::<f32, &[f32], 2>::new(rows);
        map.perplexity(PERPLEXITY.min((rows.len() - 1) as f32 / 4.0))
            .epochs(EPOCHS)
            .initial_embedding(start)
            .exact(|a, b| a.iter().zip(b.iter()).map(|(a, b)| (a - b).powi(2)).sum());
        map.embedding()
    };
    // On several threads it sums in an order of its own each time.
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
                carff_random::gaussians::<8>(Key { seed, frame, step: 0, sample: 0 }).map(|u| centre + 0.1 * u)
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

    /// A tensor becomes a picture of its size, colours side by side, cut to what bytes can hold.
    #[test]
    fn tensors_become_pictures() {
        let planes = Tensor::from_slice(&[0.0_f32, 1.0, 0.5, 2.0, -1.0, 0.2]).view([1, 3, 1, 2]);
        let image = picture_of(&planes);
        assert_eq!((image.width_px, image.height_px), (2, 1));
        assert_eq!(image.rgb, [0, 128, 0, 255, 255, 51]);
    }
}
