//! A small network that names the object at each pixel of a view, and the localisation of actors by it (paper
//! section 3.2).
//!
//! It is an alternative to density probing that `carff eval` compares; a running graph probes densities.

use carff_base::geometry::PinholeCamera;
use carff_base::random::{Key, gaussians, stream};
use carff_dataset::Dataset;
use carff_decision::{Localiser, Place, ProbeCalibration, ProbeLayout, SceneProbe};
use carff_field::Field;
use carff_messages::{Gaussian, LATENT_DIM};
use carff_trials::{FieldRenderer, hypotheses::birds_eye_camera};
use rand::Rng;
use tch::{
    Device, Kind, Tensor,
    nn::{self, Module, OptimizerConfig},
};

/// Channels of the hidden layers.
const CHANNELS: i64 = 16;
/// Dilations of the 3 x 3 layers: a pixel's class rests on 15 x 15 pixels.
const DILATIONS: [i64; 3] = [1, 2, 4];
/// Steps, views of a step, and learning rate of the training.
const STEPS: usize = 400;
const BATCH: usize = 8;
const LEARNING_RATE: f64 = 3e-3;
/// Weight of an object's pixels in the loss; those of the background, which is most of a view, have 1.
const OBJECT_WEIGHT: f32 = 4.0;
/// Deviation of the noise that is added to the training's views, of 1: rendered fields are less sharp.
const NOISE: f32 = 0.03;

/// A view with the class of each pixel; class 0 is the background.
#[derive(Clone, Debug, PartialEq)]
pub struct MaskedView {
    /// RGB, 0..=1, row by row.
    pub rgb: Vec<f32>,
    /// Class of each pixel.
    pub classes: Vec<u8>,
}

/// The network for views of one size.
#[derive(Debug)]
pub struct Segmenter {
    layers: nn::Sequential,
    /// Width and height of a view, pixels.
    size_px: [u32; 2],
}

impl Segmenter {
    /// Trains the network on views of `size_px` (width, height). Equal arguments give an equal network. Views of another
    /// size are left out; `None` without views.
    pub fn fit(views: &[MaskedView], classes: usize, size_px: [u32; 2], seed: u64) -> Option<Self> {
        let pixels = size_px[0] as usize * size_px[1] as usize;
        let views: Vec<&MaskedView> =
            views.iter().filter(|v| v.classes.len() == pixels && v.rgb.len() == 3 * pixels).collect();
        if views.is_empty() || pixels == 0 {
            return None;
        }
        tch::manual_seed(seed as i64);
        let weights = nn::VarStore::new(Device::Cpu);
        let this = Self { layers: layers(&weights.root(), classes as i64), size_px };
        let mut adam = nn::Adam::default().build(&weights, LEARNING_RATE).ok()?;
        let mut of_class = vec![OBJECT_WEIGHT; classes.max(1)];
        of_class[0] = 1.0;
        let of_class = Tensor::from_slice(&of_class);
        let mut rng = stream(Key::named("segm", seed, 0));
        for _ in 0..STEPS {
            let (mut rgb, mut targets) = (Vec::new(), Vec::new());
            for _ in 0..BATCH {
                let view = views[rng.random_range(0..views.len())];
                rgb.extend_from_slice(&view.rgb);
                targets.extend(view.classes.iter().map(|&class| i64::from(class)));
            }
            let rgb = Tensor::from_slice(&rgb);
            let logits = this.logits(&(&rgb + rgb.randn_like() * f64::from(NOISE)));
            let targets = Tensor::from_slice(&targets).view([BATCH as i64, -1]);
            let loss =
                logits.flatten(2, 3).cross_entropy_loss(&targets, Some(&of_class), tch::Reduction::Mean, -100, 0.0);
            adam.backward_step(&loss);
        }
        Some(this)
    }

    /// Returns the class of each pixel of some views, RGB in 0..=1, row by row and view by view.
    fn classes(&self, rgb: &[f32]) -> Vec<u8> {
        tch::no_grad(|| {
            let classes = self.logits(&Tensor::from_slice(rgb)).argmax(1, false).to_kind(Kind::Uint8).contiguous();
            let mut out = vec![0; classes.numel()];
            let count = out.len();
            classes.copy_data(&mut out, count);
            out
        })
    }

    /// Logits `[N, classes, H, W]` of views, row by row and view by view.
    fn logits(&self, rgb: &Tensor) -> Tensor {
        let [width, height] = self.size_px.map(i64::from);
        let input = rgb.view([-1, height, width, 3]).permute([0, 3, 1, 2]).contiguous();
        self.layers.forward(&input)
    }
}

/// Draws of each known state on which the reading of occupancies is calibrated.
const CALIBRATION_DRAWS: usize = 32;

/// Longest side of the views, pixels.
const VIEW_PX: u32 = 64;

/// Camera of the views: the dataset's camera from above, or else one above the field, at the network's size.
pub fn view_camera(dataset: &Dataset, field: &Field) -> PinholeCamera {
    let camera = birds_eye_camera(dataset, field);
    let longest = camera.width_px.max(camera.height_px).max(1);
    let shorter = |side: u32| (side * VIEW_PX / longest).max(1);
    camera.resized(shorter(camera.width_px), shorter(camera.height_px))
}

/// Names of the occupants of places, in the order of their classes from 1 on.
pub fn occupants(layout: &ProbeLayout) -> Vec<String> {
    let mut names: Vec<String> = layout.places().iter().map(|place| place.name.clone()).collect();
    names.sort_unstable();
    names.dedup();
    names
}

/// Localisation by segmentation: each latent's scene is rendered from above, and a place is as occupied as the share of
/// its pixels that show its occupant.
pub struct SegmentedField {
    field: Field,
    camera: PinholeCamera,
    network: Segmenter,
    /// Class of each place's occupant, and the pixels that look at the place.
    footprints: Vec<(usize, Vec<usize>)>,
    renderer: FieldRenderer,
}

impl SegmentedField {
    /// Combines a field with a network whose classes are those of [`occupants`], for views of `camera`.
    pub fn new(field: Field, camera: PinholeCamera, network: Segmenter, layout: &ProbeLayout, threads: usize) -> Self {
        let names = occupants(layout);
        let width = camera.width_px as usize;
        let footprint = |place: &Place| {
            let looks_at = |pixel: &usize| {
                let (x_px, y_px) = ((pixel % width) as f64 + 0.5, (pixel / width) as f64 + 0.5);
                place.oriented_box.is_met_by(&camera.ray(x_px, y_px))
            };
            let class = names.iter().position(|name| *name == place.name).map_or(0, |index| index + 1);
            (class, (0..width * camera.height_px as usize).filter(looks_at).collect())
        };
        let footprints = layout.places().iter().map(footprint).collect();
        Self { field, camera, network, footprints, renderer: FieldRenderer::new(threads) }
    }

    /// Returns a probe that reads states from the occupancies, calibrated on draws from the known states' posteriors.
    /// `None` if these have no places.
    pub fn into_probe(mut self, layout: ProbeLayout, states: Vec<Gaussian>, seed: u64) -> Option<SceneProbe<Self>> {
        let draw = |state: &Gaussian, number: u64| -> [f32; LATENT_DIM] {
            let normal = gaussians::<LATENT_DIM>(Key::named("segc", seed, number));
            std::array::from_fn(|i| state.mean[i] + (0.5 * state.log_variance[i]).exp() * normal[i])
        };
        let places = layout.places().len();
        let occupancies: Vec<Vec<f32>> = states
            .iter()
            .enumerate()
            .map(|(state, posterior)| {
                let number = |i: usize| (state * CALIBRATION_DRAWS + i) as u64;
                let latents: Vec<_> = (0..CALIBRATION_DRAWS).map(|i| draw(posterior, number(i))).collect();
                let mut rows = vec![0.0; CALIBRATION_DRAWS * places];
                self.occupancies(&layout, &latents, &mut rows);
                rows
            })
            .collect();
        let calibration = ProbeCalibration::fit(&layout, &occupancies).ok()?;
        Some(SceneProbe::new(self, layout, calibration, states))
    }
}

impl Localiser for SegmentedField {
    fn occupancies(&mut self, layout: &ProbeLayout, latents: &[[f32; LATENT_DIM]], occupancies: &mut [f32]) {
        for (latent, row) in latents.iter().zip(occupancies.chunks_exact_mut(layout.places().len().max(1))) {
            let classes = self.network.classes(self.renderer.values(&self.field, &self.camera, latent));
            for (occupancy, (class, footprint)) in row.iter_mut().zip(&self.footprints) {
                let shown = footprint.iter().filter(|pixel| usize::from(classes[**pixel]) == *class).count();
                *occupancy = shown as f32 / footprint.len().max(1) as f32;
            }
        }
    }
}

fn layers(path: &nn::Path, classes: i64) -> nn::Sequential {
    let mut layers = nn::seq();
    let mut channels = 3;
    for (i, dilation) in DILATIONS.into_iter().enumerate() {
        let config = nn::ConvConfig { padding: dilation, dilation, ..nn::ConvConfig::default() };
        layers = layers.add(nn::conv2d(path / i, channels, CHANNELS, 3, config)).add_fn(Tensor::relu);
        channels = CHANNELS;
    }
    layers.add(nn::conv2d(path / "classes", CHANNELS, classes, 1, nn::ConvConfig::default()))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A view with a red square of class 1 at (x, y), and a blue one of class 2 two pixels below it.
    fn view(x: usize, y: usize) -> MaskedView {
        let (mut rgb, mut classes) = (vec![0.4; 16 * 16 * 3], vec![0; 256]);
        for (class, top) in [(1_u8, y), (2, y + 5)] {
            for (row, column) in (top..top + 3).flat_map(|row| (x..x + 3).map(move |column| (row, column))) {
                let at = row * 16 + column;
                classes[at] = class;
                rgb[3 * at..3 * at + 3].copy_from_slice(if class == 1 { &[0.9, 0.2, 0.1] } else { &[0.1, 0.2, 0.9] });
            }
        }
        MaskedView { rgb, classes }
    }

    /// Objects are found at places that the training has not shown; equal arguments give an equal network; views of
    /// another size are left out.
    #[test]
    fn objects_are_found_at_other_places() {
        let views: Vec<MaskedView> = (0..6).map(|i| view(2 * i, i)).collect();
        let network = Segmenter::fit(&views, 3, [16, 16], 1).unwrap();
        let other = view(3, 6);
        let found = network.classes(&other.rgb);
        let right = found.iter().zip(&other.classes).filter(|(a, b)| a == b).count();
        assert!(right >= 250, "{right} of 256");
        assert_eq!(found, Segmenter::fit(&views, 3, [16, 16], 1).unwrap().classes(&other.rgb));
        assert!(Segmenter::fit(&views, 3, [8, 8], 1).is_none());
    }
}
