//! Pictures of the field: colour, expected depth and opacity for each ray.

use std::cell::RefCell;

use carff_geometry::{PinholeCamera, Ray};
use rayon::prelude::*;

use crate::config::{LATENT_DIM, RenderOptions};
use crate::field::{Field, Folded, Scratch, grow, write_direction};
use crate::kernels::{LANES, stride};
use crate::march::{NO_RAY, RayLimits, Samples};
use crate::math::{sigmoid, spherical_harmonics};

/// Rays that are worked on together: a square of the picture, whose rays meet the same entries of the hash grid.
const CHUNK: usize = TILE_PX as usize * TILE_PX as usize;
/// What differs behind so little light is not seen to differ.
const VISIBLE_LIGHT: f32 = 0.15;
/// Side of that square, pixels.
const TILE_PX: u32 = 8;

/// A rendered picture, and what rendering needs to be done again without allocation.
#[derive(Debug, Default)]
pub struct RenderBuffer {
    /// Colours, row by row, RGB, 0..=1.
    pub rgb: Vec<f32>,
    /// Expected distance along the ray, metres, over what was met; 0 where nothing was.
    pub depth_m: Vec<f32>,
    /// Share of the light that is stopped, 0..=1.
    pub opacity: Vec<f32>,
    /// Whether a ray meets a place where the states differ.
    pub changing: Vec<bool>,
    /// A picture's rays, tile by tile, and each one's pixel.
    rays: Vec<Ray>,
    pixels: Vec<u32>,
    by_ray: Results,
    pool: Option<(usize, rayon::ThreadPool)>,
}

/// What rays found, in their order.
#[derive(Debug, Default)]
struct Results {
    rgb: Vec<f32>,
    depth_m: Vec<f32>,
    opacity: Vec<f32>,
    changing: Vec<bool>,
}

/// Pictures of one camera under several latents, and what rendering them needs to be done again without allocation.
#[derive(Debug, Default)]
pub struct HypothesisBuffer {
    /// One for each latent.
    pub pictures: Vec<RenderBuffer>,
    /// Rays that meet a place where the states differ, by their place in the picture.
    changing: Vec<u32>,
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
    harmonics: Vec<[f32; 16]>,
    pixels: Vec<Pixel>,
}

/// Where the results of some rays go.
struct Piece<'a> {
    rgb: &'a mut [f32],
    depth: &'a mut [f32],
    opacity: &'a mut [f32],
    changing: &'a mut [bool],
}

/// What is summed for one ray.
#[derive(Clone, Copy, Debug, Default)]
struct Pixel {
    /// Weights of all samples.
    weight: f32,
    /// Weights times distances, metres.
    distance: f32,
    /// The heaviest sample, and its weight.
    heaviest: (u32, f32),
    /// Weights of the samples with a colour of their own, and these weights times the colours.
    colored: (f32, [f32; 3]),
}

thread_local! {
    static WORKER: RefCell<Worker> = RefCell::default();
}

impl RenderBuffer {
    /// An empty buffer.
    pub fn new() -> Self {
        Self::default()
    }

    /// Writes what a ray found to a pixel.
    fn put(&mut self, pixel: usize, ray: usize) {
        self.rgb[pixel * 3..pixel * 3 + 3].copy_from_slice(&self.by_ray.rgb[ray * 3..ray * 3 + 3]);
        self.depth_m[pixel] = self.by_ray.depth_m[ray];
        self.opacity[pixel] = self.by_ray.opacity[ray];
        self.changing[pixel] = self.by_ray.changing[ray];
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
        let (width, height) = (camera.width_px, camera.height_px);
        out.rays.clear();
        out.pixels.clear();
        for top in (0..height).step_by(TILE_PX as usize) {
            for left in (0..width).step_by(TILE_PX as usize) {
                for y in top..(top + TILE_PX).min(height) {
                    for x in left..(left + TILE_PX).min(width) {
                        out.rays.push(camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5));
                        out.pixels.push(y * width + x);
                    }
                }
            }
        }
        self.render_into(&out.rays, std::slice::from_ref(latent), options, &mut out.by_ray, &mut out.pool);
        let count = out.rays.len();
        out.rgb.resize(count * 3, 0.0);
        out.depth_m.resize(count, 0.0);
        out.opacity.resize(count, 0.0);
        out.changing.resize(count, false);
        for i in 0..count {
            out.put(out.pixels[i] as usize, i);
        }
    }

    /// Renders what `camera` sees under each of several latents. Rays that meet no place where the states differ
    /// ([`Field::changing`]) are rendered once, under the first latent, for all of them.
    pub fn render_hypotheses(
        &self,
        camera: &PinholeCamera,
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: &mut HypothesisBuffer,
    ) {
        let HypothesisBuffer { pictures, changing, rays, pool } = out;
        pictures.resize_with(latents.len(), RenderBuffer::default);
        let Some((first, others)) = pictures.split_first_mut() else { return };
        self.render(camera, &latents[0], options, first);
        changing.clear();
        changing.extend((0..first.rays.len() as u32).filter(|i| first.by_ray.changing[*i as usize]));
        rays.clear();
        rays.extend(changing.iter().map(|i| first.rays[*i as usize]));
        for (latent, picture) in latents[1..].iter().zip(others) {
            picture.rgb.clone_from(&first.rgb);
            picture.depth_m.clone_from(&first.depth_m);
            picture.opacity.clone_from(&first.opacity);
            picture.changing.clone_from(&first.changing);
            self.render_into(rays, std::slice::from_ref(latent), options, &mut picture.by_ray, pool);
            for (at, i) in changing.iter().enumerate() {
                picture.put(first.pixels[*i as usize] as usize, at);
            }
        }
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
        self.render_into(rays, latents, options, &mut out.by_ray, &mut out.pool);
        out.rgb.clone_from(&out.by_ray.rgb);
        out.depth_m.clone_from(&out.by_ray.depth_m);
        out.opacity.clone_from(&out.by_ray.opacity);
        out.changing.clone_from(&out.by_ray.changing);
    }

    fn render_into(
        &self,
        rays: &[Ray],
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: &mut Results,
        pool: &mut Option<(usize, rayon::ThreadPool)>,
    ) {
        out.rgb.resize(rays.len() * 3, 0.0);
        out.depth_m.resize(rays.len(), 0.0);
        out.opacity.resize(rays.len(), 0.0);
        out.changing.resize(rays.len(), false);
        let threads = options.threads.max(1);
        if threads > 1 && pool.as_ref().is_none_or(|(n, _)| *n != threads) {
            // A pool that cannot be made (no threads to be had) is done without.
            *pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok().map(|pool| (threads, pool));
        }
        let Results { rgb, depth_m, opacity, changing } = out;
        let one = |i: usize, rgb: &mut [f32], depth: &mut [f32], opacity: &mut [f32], changing: &mut [bool]| {
            let first = i * CHUNK;
            let rays = &rays[first..first + depth.len()];
            let out = Piece { rgb, depth, opacity, changing };
            WORKER.with_borrow_mut(|worker| self.render_chunk(worker, rays, first, latents, options, out));
        };
        match pool {
            Some((n, pool)) if threads > 1 && *n == threads => pool.install(|| {
                rgb.par_chunks_mut(CHUNK * 3)
                    .zip(depth_m.par_chunks_mut(CHUNK))
                    .zip(opacity.par_chunks_mut(CHUNK))
                    .zip(changing.par_chunks_mut(CHUNK))
                    .enumerate()
                    .for_each(|(i, (((rgb, depth), opacity), changing))| one(i, rgb, depth, opacity, changing));
            }),
            _ => rgb
                .chunks_mut(CHUNK * 3)
                .zip(depth_m.chunks_mut(CHUNK))
                .zip(opacity.chunks_mut(CHUNK))
                .zip(changing.chunks_mut(CHUNK))
                .enumerate()
                .for_each(|(i, (((rgb, depth), opacity), changing))| one(i, rgb, depth, opacity, changing)),
        }
    }

    fn render_chunk(
        &self,
        worker: &mut Worker,
        rays: &[Ray],
        first: usize,
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: Piece<'_>,
    ) {
        let Piece { rgb, depth, opacity, changing } = out;
        let latent_of = |i: usize| latents.get(first + i).or(latents.last()).copied().unwrap_or_default();
        let mut start = 0;
        while start < rays.len() {
            let latent = latent_of(start);
            let mut end = start + 1;
            while end < rays.len() && latent_of(end) == latent {
                end += 1;
            }
            self.fold(&latent, &mut worker.folded);
            let run = Piece {
                rgb: &mut rgb[start * 3..end * 3],
                depth: &mut depth[start..end],
                opacity: &mut opacity[start..end],
                changing: &mut changing[start..end],
            };
            self.render_run(worker, &rays[start..end], options, run);
            start = end;
        }
    }

    /// Renders rays that share the folded latent of `worker`.
    fn render_run(&self, worker: &mut Worker, rays: &[Ray], options: &RenderOptions, out: Piece<'_>) {
        let Piece { rgb, depth, opacity, changing } = out;
        let l = &self.layout;
        let (sg, si, so) = (stride(l.geometry), stride(l.color[0].inputs), stride(4));
        let Worker { scratch, samples, folded, kept, inputs, output, harmonics, pixels } = worker;
        let limits = RayLimits {
            max_samples: options.max_samples_per_ray.max(1),
            min_transmittance: options.min_transmittance,
            step_scale: 1.0,
            use_occupancy: true,
        };
        samples.march(self, folded, rays, &limits, scratch, |_| 0.5);
        pixels.clear();
        pixels.resize(rays.len(), Pixel::default());
        changing.fill(false);
        for (i, (ray, weight)) in
            samples.ray.iter().zip(&samples.weight).enumerate().filter(|(_, (r, _))| **r != NO_RAY)
        {
            let pixel = &mut pixels[*ray as usize];
            pixel.weight += weight;
            pixel.distance += weight * (samples.distance_m[i] + 0.5 * samples.length_m[i]);
            if *weight > pixel.heaviest.1 {
                pixel.heaviest = (i as u32, *weight);
            }
            let arriving = weight + samples.behind[i];
            changing[*ray as usize] |= arriving > VISIBLE_LIGHT && self.changing.contains(samples.points[i]);
        }
        kept.clear();
        kept.extend((0..samples.ray.len() as u32).filter(|i| {
            let (ray, weight) = (samples.ray[*i as usize], samples.weight[*i as usize]);
            ray != NO_RAY && weight > 0.0 && (weight > options.min_weight || pixels[ray as usize].heaviest.0 == *i)
        }));

        // Background for every ray: its share is what passes.
        let blocks = rays.len().div_ceil(LANES);
        let directions = grow(inputs, blocks * stride(l.direction));
        harmonics.clear();
        harmonics.extend(rays.iter().map(|ray| spherical_harmonics(ray.direction)));
        for (i, harmonics) in harmonics.iter().enumerate() {
            let block = &mut directions[i / LANES * stride(l.direction)..];
            write_direction(block, 0, l.direction, i % LANES, harmonics);
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
            depth[i] = if opacity[i] > 1e-4 { pixels[i].distance / opacity[i] } else { 0.0 };
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
                let harmonics = &harmonics[samples.ray[i] as usize];
                write_direction(block, l.geometry, l.direction, at % LANES, harmonics);
            }
            let out = grow(output, blocks * so);
            self.color_network(folded, inputs, &mut scratch.hidden_a, &mut scratch.hidden_b, out);
            for (at, i) in kept.iter().enumerate() {
                let i = *i as usize;
                let (pixel, weight) = (&mut pixels[samples.ray[i] as usize], samples.weight[i]);
                pixel.colored.0 += weight;
                for c in 0..3 {
                    pixel.colored.1[c] += weight * sigmoid(out[at / LANES * so + c * LANES + at % LANES]);
                }
            }
        }
        for (rgb, pixel) in rgb.chunks_exact_mut(3).zip(pixels.iter()).filter(|(_, p)| p.colored.0 > 0.0) {
            let scale = pixel.weight / pixel.colored.0;
            for (v, sum) in rgb.iter_mut().zip(&pixel.colored.1) {
                *v += scale * sum;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FieldConfig;
    use crate::math::{hash, unit};

    fn field() -> Field {
        let config = FieldConfig { log2_table_size: 10, occupancy_resolution: 16, ..FieldConfig::default() };
        let mut field = Field::new(FieldConfig { density_offset: -2.5, ..config }, 4).unwrap();
        for (i, v) in field.table.iter_mut().enumerate() {
            *v = 2.0 * unit(hash(8, i as u64, 0)) - 1.0;
        }
        field
    }

    fn camera() -> PinholeCamera {
        PinholeCamera::look_at([3.0, -20.0, 12.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 24, 17, 50.0)
    }

    /// Under several latents at once, rays that meet a place where the states differ show what each latent shows alone;
    /// the others show what the first one does. Marking more places never changes a picture that was right.
    #[test]
    fn hypotheses_share_what_does_not_change() {
        let mut field = field();
        let options = RenderOptions::default();
        let latents: Vec<[f32; LATENT_DIM]> = (0..3).map(|i| [0.8 * i as f32 - 0.8; LATENT_DIM]).collect();
        let alone: Vec<Vec<f32>> = latents
            .iter()
            .map(|z| {
                let mut one = RenderBuffer::new();
                field.render(&camera(), z, &options, &mut one);
                one.rgb
            })
            .collect();
        assert_ne!(alone[0], alone[1]);
        let mut buffer = HypothesisBuffer::default();
        field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
        for (picture, alone) in buffer.pictures.iter().zip(&alone) {
            assert_eq!(&picture.rgb, alone);
        }
        field.changing.set_from(|i| i % 16 < 8);
        field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
        let changing = buffer.pictures[0].changing.clone();
        let share = changing.iter().filter(|c| **c).count();
        assert!(share > 20 && share + 20 < changing.len(), "{share} of {}", changing.len());
        for (picture, alone) in buffer.pictures.iter().zip(&alone) {
            for (i, pixel) in picture.rgb.chunks_exact(3).enumerate() {
                let wanted = if changing[i] { alone } else { &buffer.pictures[0].rgb };
                assert_eq!(pixel, &wanted[3 * i..3 * i + 3]);
            }
        }
        field.render_hypotheses(&camera(), &[], &options, &mut buffer);
        assert!(buffer.pictures.is_empty());
    }

    /// Light samples take the mean colour of their ray's others: leaving them out hardly changes a picture.
    #[test]
    fn light_samples_take_their_neighbours_color() {
        let field = field();
        let render = |min_weight: f32| {
            let mut out = RenderBuffer::new();
            let options = RenderOptions { min_weight, min_transmittance: 0.0, ..RenderOptions::default() };
            field.render(&camera(), &[0.3; LATENT_DIM], &options, &mut out);
            out
        };
        let (all, most) = (render(0.0), render(0.02));
        assert_ne!(all.rgb, most.rgb);
        let largest = all.rgb.iter().zip(&most.rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(largest < 0.1, "{largest}");
        assert_eq!((all.opacity, all.depth_m), (most.opacity, most.depth_m));
    }
}
