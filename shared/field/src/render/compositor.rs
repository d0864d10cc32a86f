//! From marched samples to pixels.

use carff_base::geometry::Ray;

use super::buffers::PixelsMut;
use crate::config::{LATENT_DIM, RenderOptions};
use crate::kernels::block::{BlockBuffer, LANES};
use crate::kernels::math::spherical_harmonics;
use crate::kernels::traverse::SamplePoints;
use crate::march::samples::{LatentSamples, March, MarchScratch, NO_RAY, RayLimits, Samples};
use crate::model::field::{Field, Folded, RGB_ROWS};
use crate::model::network::{GROUP, Hidden, Input};

/// Differences between states do not count where less than this share of light remains.
const MIN_CHANGING_LIGHT: f32 = 0.15;
/// Depth is given where at least this share of light is stopped.
const MIN_OPACITY: f32 = 1e-4;

/// Buffers of one thread.
#[derive(Default)]
pub(super) struct Worker {
    scratch: MarchScratch,
    samples: Samples,
    /// One entry for each latent.
    folded: Vec<Folded>,
    directions: Directions,
    compositor: Compositor,
}

/// Encoded directions of the rays.
#[derive(Default)]
struct Directions {
    harmonics: Vec<[f32; 16]>,
    blocks: BlockBuffer,
}

/// Buffers for the pixels under one latent.
#[derive(Default)]
struct Compositor {
    kept: Vec<u32>,
    inputs: BlockBuffer,
    hidden: Hidden,
    output: BlockBuffer,
    sums: Vec<PixelSums>,
}

/// Sums over the samples of one ray.
#[derive(Clone, Copy, Debug, Default)]
struct PixelSums {
    /// Weights of all samples.
    weight: f32,
    /// Weights times distances, metres.
    distance: f32,
    /// The sample of the largest weight, and its weight.
    heaviest: (u32, f32),
    /// Weights of the samples with a colour of their own, and these weights times the colours.
    colored: (f32, [f32; 3]),
}

/// The samples to composite, under one latent.
struct Scene<'a> {
    field: &'a Field,
    folded: &'a Folded,
    points: &'a SamplePoints,
    samples: &'a LatentSamples,
    directions: &'a Directions,
}

impl Worker {
    /// Renders rays under each latent; `out` holds all rays of the first latent, then all of the second, and so on.
    pub fn render(
        &mut self,
        field: &Field,
        rays: &[Ray],
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: &mut PixelsMut<'_>,
    ) {
        let Self { scratch, samples, folded, directions, compositor } = self;
        folded.resize_with(latents.len(), Folded::default);
        for (latent, folded) in latents.iter().zip(&mut *folded) {
            field.fold(latent, folded);
        }
        let limits = RayLimits {
            max_samples: options.max_samples_per_ray.max(1),
            min_transmittance: options.min_transmittance,
            step_scale: options.step_scale.max(1.0),
            use_occupancy: true,
        };
        samples.march(&March { field, latents: folded, rays, limits }, scratch, |_| 0.5);
        directions.encode(field, rays);
        let images = out.reborrow().chunks(rays.len());
        for ((of_latent, folded), mut out) in samples.by_latent.iter().zip(&*folded).zip(images) {
            let scene = Scene { field, folded, points: &samples.points, samples: of_latent, directions };
            compositor.composite(&scene, options, &mut out);
        }
    }
}

impl Directions {
    fn encode(&mut self, field: &Field, rays: &[Ray]) {
        self.harmonics.clear();
        self.harmonics.extend(rays.iter().map(|ray| spherical_harmonics(ray.direction)));
        let rows = field.layout.direction;
        let mut blocks = self.blocks.blocks_mut(rows, rays.len().div_ceil(LANES));
        for (i, harmonics) in self.harmonics.iter().enumerate() {
            blocks.write_sample(i, 0, &harmonics[..rows]);
        }
    }
}

impl Compositor {
    /// Computes the pixels under one latent.
    fn composite(&mut self, scene: &Scene<'_>, options: &RenderOptions, out: &mut PixelsMut<'_>) {
        self.sum_samples(scene, out);
        self.background(scene, out);
        self.select(scene, options);
        self.color_samples(scene);
        for (rgb, sums) in out.rgb.chunks_exact_mut(3).zip(&self.sums).filter(|(_, s)| s.colored.0 > 0.0) {
            let scale = sums.weight / sums.colored.0;
            for (v, sum) in rgb.iter_mut().zip(&sums.colored.1) {
                *v += scale * sum;
            }
        }
    }

    /// Sums weights and distances, and finds the rays that meet cells in which states differ.
    fn sum_samples(&mut self, scene: &Scene<'_>, out: &mut PixelsMut<'_>) {
        let Scene { points, samples, .. } = scene;
        self.sums.clear();
        self.sums.resize(out.depth_m.len(), PixelSums::default());
        out.changing.fill(false);
        let weighted = samples.ray.iter().zip(&samples.weight).enumerate();
        for (i, (ray, weight)) in weighted.filter(|(_, (ray, _))| **ray != NO_RAY) {
            let sums = &mut self.sums[*ray as usize];
            sums.weight += weight;
            sums.distance += weight * (points.distance_m[i] + 0.5 * points.delta_m[i]);
            if *weight > sums.heaviest.1 {
                sums.heaviest = (i as u32, *weight);
            }
            out.changing[*ray as usize] |= points.changing[i] && weight + samples.transmittance[i] > MIN_CHANGING_LIGHT;
        }
    }

    /// Writes the background's share of each pixel, opacity and depth.
    fn background(&mut self, scene: &Scene<'_>, out: &mut PixelsMut<'_>) {
        let Scene { field, folded, samples, directions, .. } = scene;
        let l = &field.layout;
        let count = out.depth_m.len().div_ceil(LANES);
        let input = Input::Features(directions.blocks.blocks(l.direction, count));
        let output = self.output.blocks_mut(RGB_ROWS, count);
        l.background.forward(field.weights(), &folded.background, input, &mut self.hidden, output);
        let output = self.output.blocks(RGB_ROWS, count);
        for (i, pixel) in out.rgb.chunks_exact_mut(3).enumerate() {
            let transmittance = samples.rays[i].transmittance;
            for (v, background) in pixel.iter_mut().zip(output.rgb(i)) {
                *v = transmittance * background;
            }
            let opacity = 1.0 - transmittance;
            out.opacity[i] = opacity;
            out.depth_m[i] = if opacity > MIN_OPACITY { self.sums[i].distance / opacity } else { 0.0 };
        }
    }

    /// Selects the samples with a colour of their own: those of enough weight, and the heaviest one of each ray.
    fn select(&mut self, scene: &Scene<'_>, options: &RenderOptions) {
        let samples = scene.samples;
        self.kept.clear();
        self.kept.extend((0..samples.ray.len() as u32).filter(|i| {
            let (ray, weight) = (samples.ray[*i as usize], samples.weight[*i as usize]);
            ray != NO_RAY && weight > 0.0 && (weight > options.min_weight || self.sums[ray as usize].heaviest.0 == *i)
        }));
    }

    /// Computes and sums the colours of the selected samples.
    fn color_samples(&mut self, scene: &Scene<'_>) {
        let Scene { field, folded, samples, directions, .. } = scene;
        let l = &field.layout;
        let geometry = samples.geometry.blocks(l.geometry, samples.ray.len() / LANES);
        for kept in self.kept.chunks(GROUP * LANES) {
            let count = kept.len().div_ceil(LANES);
            let mut inputs = self.inputs.blocks_mut(l.geometry + l.direction, count);
            for (at, i) in kept.iter().enumerate() {
                let i = *i as usize;
                inputs.copy_sample(at, geometry, i, l.geometry);
                let harmonics = &directions.harmonics[samples.ray[i] as usize];
                inputs.write_sample(at, l.geometry, &harmonics[..l.direction]);
            }
            let input = Input::Features(inputs.into_blocks());
            let output = self.output.blocks_mut(RGB_ROWS, count);
            l.color.forward(field.weights(), &folded.color, input, &mut self.hidden, output);
            let output = self.output.blocks(RGB_ROWS, count);
            for (at, i) in kept.iter().enumerate() {
                let i = *i as usize;
                let (sums, weight) = (&mut self.sums[samples.ray[i] as usize], samples.weight[i]);
                sums.colored.0 += weight;
                for (sum, color) in sums.colored.1.iter_mut().zip(output.rgb(at)) {
                    *sum += weight * color;
                }
            }
        }
    }
}
