//! Pictures of the field: colour, expected depth and opacity for each ray.

use std::cell::RefCell;

use carff_geometry::{PinholeCamera, Ray};
use rayon::prelude::*;

use crate::config::{LATENT_DIM, RenderOptions};
use crate::field::{Field, Folded, Scratch, grow, write_direction};
use crate::kernels::{LANES, stride};
use crate::march::{NO_RAY, RayLimits, Samples};
use crate::math::{sigmoid, spherical_harmonics};

/// Rays that are worked on together.
const CHUNK: usize = 64;

/// A rendered picture, and what rendering needs to be done again without allocation.
#[derive(Debug, Default)]
pub struct RenderBuffer {
    /// Colours, row by row, RGB, 0..=1.
    pub rgb: Vec<f32>,
    /// Expected distance along the ray, metres, over what was met; 0 where nothing was.
    pub depth_m: Vec<f32>,
    /// Share of the light that is stopped, 0..=1.
    pub opacity: Vec<f32>,
    rays: Vec<Ray>,
    pool: Option<(usize, rayon::ThreadPool)>,
}

/// What one thread works in.
#[derive(Default)]
struct Worker {
    scratch: Scratch,
    samples: Samples,
    folded: Folded,
    kept: Vec<u32>,
    inputs: Vec<f32>,
    output: Vec<f32>,
}

thread_local! {
    static WORKER: RefCell<Worker> = RefCell::default();
}

impl RenderBuffer {
    /// An empty buffer.
    pub fn new() -> Self {
        Self::default()
    }
}

impl Field {
    /// Renders what `camera` sees under `latent`. `out` holds width x height pixels afterwards.
    pub fn render(
        &self,
        camera: &PinholeCamera,
        latent: &[f32; LATENT_DIM],
        options: &RenderOptions,
        out: &mut RenderBuffer,
    ) {
        let mut rays = std::mem::take(&mut out.rays);
        rays.clear();
        for y in 0..camera.height_px {
            for x in 0..camera.width_px {
                rays.push(camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5));
            }
        }
        self.render_rays(&rays, std::slice::from_ref(latent), options, out);
        out.rays = rays;
    }

    /// Renders rays, with one latent for all or one for each (runs of equal latents are worked on together). When
    /// `latents` is shorter than `rays`, its last one serves the rest; when it is empty, the zero latent serves all.
    pub fn render_rays(
        &self,
        rays: &[Ray],
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: &mut RenderBuffer,
    ) {
        out.rgb.resize(rays.len() * 3, 0.0);
        out.depth_m.resize(rays.len(), 0.0);
        out.opacity.resize(rays.len(), 0.0);
        let threads = options.threads.max(1);
        if threads > 1 && out.pool.as_ref().is_none_or(|(n, _)| *n != threads) {
            // A pool that cannot be made (no threads to be had) is done without.
            out.pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok().map(|pool| (threads, pool));
        }
        let RenderBuffer { rgb, depth_m, opacity, pool, .. } = out;
        let one = |i: usize, rgb: &mut [f32], depth: &mut [f32], opacity: &mut [f32]| {
            let first = i * CHUNK;
            WORKER.with_borrow_mut(|worker| {
                self.render_chunk(
                    worker,
                    &rays[first..first + depth.len()],
                    first,
                    latents,
                    options,
                    rgb,
                    depth,
                    opacity,
                );
            });
        };
        match pool {
            Some((n, pool)) if threads > 1 && *n == threads => pool.install(|| {
                rgb.par_chunks_mut(CHUNK * 3)
                    .zip(depth_m.par_chunks_mut(CHUNK))
                    .zip(opacity.par_chunks_mut(CHUNK))
                    .enumerate()
                    .for_each(|(i, ((rgb, depth), opacity))| one(i, rgb, depth, opacity));
            }),
            _ => rgb
                .chunks_mut(CHUNK * 3)
                .zip(depth_m.chunks_mut(CHUNK))
                .zip(opacity.chunks_mut(CHUNK))
                .enumerate()
                .for_each(|(i, ((rgb, depth), opacity))| one(i, rgb, depth, opacity)),
        }
    }

    #[allow(clippy::too_many_arguments)]
    fn render_chunk(
        &self,
        worker: &mut Worker,
        rays: &[Ray],
        first: usize,
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        rgb: &mut [f32],
        depth: &mut [f32],
        opacity: &mut [f32],
    ) {
        let latent_of = |i: usize| latents.get(first + i).or(latents.last()).copied().unwrap_or_default();
        let mut start = 0;
        while start < rays.len() {
            let latent = latent_of(start);
            let mut end = start + 1;
            while end < rays.len() && latent_of(end) == latent {
                end += 1;
            }
            self.fold(&latent, &mut worker.folded);
            self.render_run(
                worker,
                &rays[start..end],
                options,
                &mut rgb[start * 3..end * 3],
                &mut depth[start..end],
                &mut opacity[start..end],
            );
            start = end;
        }
    }

    /// Renders rays that share the folded latent of `worker`.
    fn render_run(
        &self,
        worker: &mut Worker,
        rays: &[Ray],
        options: &RenderOptions,
        rgb: &mut [f32],
        depth: &mut [f32],
        opacity: &mut [f32],
    ) {
        let l = &self.layout;
        let (sg, si, so) = (stride(l.geometry), stride(l.color[0].inputs), stride(4));
        let Worker { scratch, samples, folded, kept, inputs, output } = worker;
        let limits = RayLimits {
            max_samples: options.max_samples_per_ray.max(1),
            min_transmittance: options.min_transmittance,
            step_scale: 1.0,
            use_occupancy: true,
        };
        samples.march(self, folded, rays, &limits, scratch, |_| 0.5);
        kept.clear();
        kept.extend(
            (0..samples.ray.len() as u32)
                .filter(|i| samples.ray[*i as usize] != NO_RAY && samples.weight[*i as usize] > options.min_weight),
        );

        // Background for every ray: its share is what passes.
        let blocks = rays.len().div_ceil(LANES);
        let directions = grow(inputs, blocks * stride(l.direction));
        for (i, ray) in rays.iter().enumerate() {
            let block = &mut directions[i / LANES * stride(l.direction)..];
            write_direction(block, 0, l.direction, i % LANES, &spherical_harmonics(ray.direction));
        }
        let out = grow(output, blocks * so);
        let hidden = grow(&mut scratch.hidden_a, blocks * stride(l.background[0].outputs));
        self.background_network(folded, directions, hidden, out);
        for (i, pixel) in rgb.chunks_exact_mut(3).enumerate() {
            let passes = samples.rays[i].transmittance;
            for (c, v) in pixel.iter_mut().enumerate() {
                *v = passes * sigmoid(out[i / LANES * so + c * LANES + i % LANES]);
            }
            opacity[i] = 1.0 - passes;
            depth[i] = 0.0;
        }

        // Colours of the samples that count.
        for kept in kept.chunks(LANES * crate::field::GROUP) {
            let blocks = kept.len().div_ceil(LANES);
            let inputs = grow(inputs, blocks * si);
            for (at, i) in kept.iter().enumerate() {
                let i = *i as usize;
                let from = &samples.geometry[i / LANES * sg..];
                let block = &mut inputs[at / LANES * si..];
                for r in 0..l.geometry {
                    block[r * LANES + at % LANES] = from[r * LANES + i % LANES];
                }
                let harmonics = spherical_harmonics(rays[samples.ray[i] as usize].direction);
                write_direction(block, l.geometry, l.direction, at % LANES, &harmonics);
            }
            let out = grow(output, blocks * so);
            self.color_network(folded, inputs, &mut scratch.hidden_a, &mut scratch.hidden_b, out);
            for (at, i) in kept.iter().enumerate() {
                let i = *i as usize;
                let (ray, weight) = (samples.ray[i] as usize, samples.weight[i]);
                for c in 0..3 {
                    rgb[ray * 3 + c] += weight * sigmoid(out[at / LANES * so + c * LANES + at % LANES]);
                }
                depth[ray] += weight * (samples.distance_m[i] + 0.5 * samples.length_m[i]);
            }
        }
        for (d, o) in depth.iter_mut().zip(opacity.iter()) {
            *d = if *o > 1e-4 { *d / o } else { 0.0 };
        }
    }
}
