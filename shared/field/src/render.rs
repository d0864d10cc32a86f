//! Pictures of the field: colour, expected depth and opacity for each ray.

use std::cell::RefCell;

use carff_geometry::{PinholeCamera, Ray};
use rayon::prelude::*;

use crate::config::{LATENT_DIM, RenderOptions};
use crate::field::{Field, Folded, Scratch, grow, write_direction};
use crate::kernels::{LANES, stride};
use crate::march::{NO_RAY, RayLimits, Samples, Seen};
use crate::math::spherical_harmonics;
use crate::walk::Placed;

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
    /// What these rays find under each latent but the first, see [`Latents::Together`].
    by_ray: Results,
    pool: Option<(usize, rayon::ThreadPool)>,
}

/// Which latents rays are rendered under.
enum Latents<'a> {
    /// The latent of each ray; the last one serves the rest. One result for each ray.
    ByRay(&'a [[f32; LATENT_DIM]]),
    /// Every ray under every latent. Results lie chunk by chunk, in each chunk latent by latent.
    Together(&'a [[f32; LATENT_DIM]]),
}

impl Latents<'_> {
    /// Results for each ray.
    fn each(&self) -> usize {
        match self {
            Self::ByRay(_) => 1,
            Self::Together(latents) => latents.len(),
        }
    }
}

/// What one thread works in.
#[derive(Default)]
struct Worker {
    scratch: Scratch,
    samples: Samples,
    /// One for each latent.
    folded: Vec<Folded>,
    harmonics: Vec<[f32; 16]>,
    directions: Vec<f32>,
    colors: Colors,
}

/// What turns weighed samples into pixels.
#[derive(Default)]
struct Colors {
    kept: Vec<u32>,
    inputs: Vec<f32>,
    output: Vec<f32>,
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
    fn put(&mut self, pixel: usize, found: &Results, ray: usize) {
        self.rgb[pixel * 3..pixel * 3 + 3].copy_from_slice(&found.rgb[ray * 3..ray * 3 + 3]);
        self.depth_m[pixel] = found.depth_m[ray];
        self.opacity[pixel] = found.opacity[ray];
        self.changing[pixel] = found.changing[ray];
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
        let latents = Latents::ByRay(std::slice::from_ref(latent));
        self.render_into(&out.rays, &latents, options, &mut out.by_ray, &mut out.pool);
        let count = out.rays.len();
        out.rgb.resize(count * 3, 0.0);
        out.depth_m.resize(count, 0.0);
        out.opacity.resize(count, 0.0);
        out.changing.resize(count, false);
        let found = std::mem::take(&mut out.by_ray);
        for i in 0..count {
            out.put(out.pixels[i] as usize, &found, i);
        }
        out.by_ray = found;
    }

    /// Renders what `camera` sees under each of several latents. Rays that meet no place where the states differ
    /// ([`Field::changing`]) are rendered once, under the first latent, for all of them. The others are marched once for
    /// all other latents, and where such a ray crosses places where the states do not differ, one latent's density
    /// serves for all.
    pub fn render_hypotheses(
        &self,
        camera: &PinholeCamera,
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: &mut HypothesisBuffer,
    ) {
        let HypothesisBuffer { pictures, changing, rays, by_ray, pool } = out;
        pictures.resize_with(latents.len(), RenderBuffer::default);
        let Some((first, others)) = pictures.split_first_mut() else { return };
        self.render(camera, &latents[0], options, first);
        changing.clear();
        changing.extend((0..first.rays.len() as u32).filter(|i| first.by_ray.changing[*i as usize]));
        rays.clear();
        rays.extend(changing.iter().map(|i| first.rays[*i as usize]));
        if others.is_empty() {
            return;
        }
        self.render_into(rays, &Latents::Together(&latents[1..]), options, by_ray, pool);
        for (k, picture) in others.iter_mut().enumerate() {
            picture.rgb.clone_from(&first.rgb);
            picture.depth_m.clone_from(&first.depth_m);
            picture.opacity.clone_from(&first.opacity);
            picture.changing.clone_from(&first.changing);
            for (at, i) in changing.iter().enumerate() {
                let start = at - at % CHUNK;
                let place = start * (latents.len() - 1) + k * CHUNK.min(rays.len() - start) + at % CHUNK;
                picture.put(first.pixels[*i as usize] as usize, by_ray, place);
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
        self.render_into(rays, &Latents::ByRay(latents), options, &mut out.by_ray, &mut out.pool);
        out.rgb.clone_from(&out.by_ray.rgb);
        out.depth_m.clone_from(&out.by_ray.depth_m);
        out.opacity.clone_from(&out.by_ray.opacity);
        out.changing.clone_from(&out.by_ray.changing);
    }

    fn render_into(
        &self,
        rays: &[Ray],
        latents: &Latents<'_>,
        options: &RenderOptions,
        out: &mut Results,
        pool: &mut Option<(usize, rayon::ThreadPool)>,
    ) {
        let each = latents.each();
        let count = rays.len() * each;
        out.rgb.resize(count * 3, 0.0);
        out.depth_m.resize(count, 0.0);
        out.opacity.resize(count, 0.0);
        out.changing.resize(count, false);
        let threads = options.threads.max(1);
        if threads > 1 && pool.as_ref().is_none_or(|(n, _)| *n != threads) {
            // A pool that cannot be made (no threads to be had) is done without.
            *pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().ok().map(|pool| (threads, pool));
        }
        let Results { rgb, depth_m, opacity, changing } = out;
        let chunk = CHUNK * each;
        let one = |i: usize, rgb: &mut [f32], depth: &mut [f32], opacity: &mut [f32], changing: &mut [bool]| {
            let first = i * CHUNK;
            let rays = &rays[first..first + depth.len() / each];
            let out = Piece { rgb, depth, opacity, changing };
            WORKER.with_borrow_mut(|worker| match latents {
                Latents::ByRay(latents) => self.render_runs(worker, rays, first, latents, options, out),
                Latents::Together(latents) => self.render_chunk(worker, rays, latents, options, out),
            });
        };
        match pool {
            Some((n, pool)) if threads > 1 && *n == threads => pool.install(|| {
                rgb.par_chunks_mut(chunk * 3)
                    .zip(depth_m.par_chunks_mut(chunk))
                    .zip(opacity.par_chunks_mut(chunk))
                    .zip(changing.par_chunks_mut(chunk))
                    .enumerate()
                    .for_each(|(i, (((rgb, depth), opacity), changing))| one(i, rgb, depth, opacity, changing));
            }),
            _ => rgb
                .chunks_mut(chunk * 3)
                .zip(depth_m.chunks_mut(chunk))
                .zip(opacity.chunks_mut(chunk))
                .zip(changing.chunks_mut(chunk))
                .enumerate()
                .for_each(|(i, (((rgb, depth), opacity), changing))| one(i, rgb, depth, opacity, changing)),
        }
    }

    /// Renders the rays of one chunk, each under its own latent; runs of equal latents go together.
    fn render_runs(
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
            let run = Piece {
                rgb: &mut rgb[start * 3..end * 3],
                depth: &mut depth[start..end],
                opacity: &mut opacity[start..end],
                changing: &mut changing[start..end],
            };
            self.render_chunk(worker, &rays[start..end], &[latent], options, run);
            start = end;
        }
    }

    /// Renders rays under each latent; `out` holds all rays of the first latent, then all of the second, and so on.
    fn render_chunk(
        &self,
        worker: &mut Worker,
        rays: &[Ray],
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: Piece<'_>,
    ) {
        let Piece { rgb, depth, opacity, changing } = out;
        let l = &self.layout;
        worker.folded.resize_with(latents.len(), Folded::default);
        for (latent, folded) in latents.iter().zip(&mut worker.folded) {
            self.fold(latent, folded);
        }
        let limits = RayLimits {
            max_samples: options.max_samples_per_ray.max(1),
            min_transmittance: options.min_transmittance,
            step_scale: 1.0,
            use_occupancy: true,
        };
        worker.samples.march(self, &worker.folded, rays, &limits, &mut worker.scratch, |_| 0.5);
        let Worker { samples, folded, harmonics, directions, scratch, colors } = worker;
        harmonics.clear();
        harmonics.extend(rays.iter().map(|ray| spherical_harmonics(ray.direction)));
        let directions = grow(directions, rays.len().div_ceil(LANES) * stride(l.direction));
        for (i, harmonics) in harmonics.iter().enumerate() {
            let block = &mut directions[i / LANES * stride(l.direction)..];
            write_direction(block, 0, l.direction, i % LANES, harmonics);
        }
        let count = rays.len();
        let pieces = rgb
            .chunks_mut(3 * count)
            .zip(depth.chunks_mut(count))
            .zip(opacity.chunks_mut(count))
            .zip(changing.chunks_mut(count));
        for ((seen, folded), (((rgb, depth), opacity), changing)) in samples.seen.iter().zip(folded.iter()).zip(pieces)
        {
            let out = Piece { rgb, depth, opacity, changing };
            colors.pixels(self, folded, &samples.placed, seen, harmonics, directions, options, scratch, out);
        }
    }
}

impl Colors {
    /// Pixels under one latent, from its weighed samples.
    #[allow(clippy::too_many_arguments)]
    fn pixels(
        &mut self,
        field: &Field,
        folded: &Folded,
        placed: &Placed,
        seen: &Seen,
        harmonics: &[[f32; 16]],
        directions: &[f32],
        options: &RenderOptions,
        scratch: &mut Scratch,
        out: Piece<'_>,
    ) {
        let Piece { rgb, depth, opacity, changing } = out;
        let Self { kept, inputs, output, pixels } = self;
        let l = &field.layout;
        let (sg, si, so) = (stride(l.geometry), stride(l.color[0].inputs), stride(4));
        pixels.clear();
        pixels.resize(depth.len(), Pixel::default());
        changing.fill(false);
        for (i, (ray, weight)) in seen.ray.iter().zip(&seen.weight).enumerate().filter(|(_, (r, _))| **r != NO_RAY) {
            let pixel = &mut pixels[*ray as usize];
            pixel.weight += weight;
            pixel.distance += weight * (placed.distance_m[i] + 0.5 * placed.length_m[i]);
            if *weight > pixel.heaviest.1 {
                pixel.heaviest = (i as u32, *weight);
            }
            changing[*ray as usize] |= placed.changing[i] && weight + seen.behind[i] > VISIBLE_LIGHT;
        }
        kept.clear();
        kept.extend((0..seen.ray.len() as u32).filter(|i| {
            let (ray, weight) = (seen.ray[*i as usize], seen.weight[*i as usize]);
            ray != NO_RAY && weight > 0.0 && (weight > options.min_weight || pixels[ray as usize].heaviest.0 == *i)
        }));

        // Background for every ray: its share is what passes.
        let blocks = depth.len().div_ceil(LANES);
        let out = grow(output, blocks * so);
        let hidden = grow(&mut scratch.hidden_a, blocks * stride(l.background[0].outputs));
        field.background_network(folded, directions, hidden, out);
        for (i, pixel) in rgb.chunks_exact_mut(3).enumerate() {
            let passes = seen.rays[i].transmittance;
            for (c, v) in pixel.iter_mut().enumerate() {
                *v = passes * out[i / LANES * so + c * LANES + i % LANES];
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
                let from = &seen.geometry[i / LANES * sg + i % LANES..];
                let block = &mut inputs[at / LANES * si..];
                for r in 0..l.geometry {
                    block[r * LANES + at % LANES] = from[r * LANES];
                }
                let harmonics = &harmonics[seen.ray[i] as usize];
                write_direction(block, l.geometry, l.direction, at % LANES, harmonics);
            }
            let out = grow(output, blocks * so);
            field.color_network(folded, inputs, &mut scratch.hidden_a, &mut scratch.hidden_b, out);
            for (at, i) in kept.iter().enumerate() {
                let i = *i as usize;
                let (pixel, weight) = (&mut pixels[seen.ray[i] as usize], seen.weight[i]);
                pixel.colored.0 += weight;
                for c in 0..3 {
                    pixel.colored.1[c] += weight * out[at / LANES * so + c * LANES + at % LANES];
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

    fn largest_difference<'a>(a: impl IntoIterator<Item = &'a f32>, b: impl IntoIterator<Item = &'a f32>) -> f32 {
        a.into_iter().zip(b).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    /// Under several latents at once, every picture is what its latent shows alone while all places may differ. Where
    /// none may, all show what the first one does; and rays that meet no place that may differ do so in any case.
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
        assert!(largest_difference(&alone[0], &alone[1]) > 1e-2);
        let mut buffer = HypothesisBuffer::default();
        for threads in [1, 2] {
            let options = RenderOptions { threads, ..options };
            field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
            for (picture, alone) in buffer.pictures.iter().zip(&alone) {
                assert!(largest_difference(&picture.rgb, alone) < 1e-5);
            }
        }
        field.changing.set_from(|i| i % 16 < 8);
        field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
        let changing = buffer.pictures[0].changing.clone();
        let share = changing.iter().filter(|c| **c).count();
        assert!(share > 20 && share + 20 < changing.len(), "{share} of {}", changing.len());
        for (k, picture) in buffer.pictures.iter().enumerate() {
            let mut apart = 0;
            for (i, pixel) in picture.rgb.chunks_exact(3).enumerate() {
                let first = &alone[0][3 * i..3 * i + 3];
                assert!(changing[i] || pixel == first);
                apart += usize::from(largest_difference(pixel, first) > 1e-3);
            }
            assert!(if k == 0 { apart == 0 } else { apart > 20 }, "{apart} pixels of picture {k}");
        }
        field.changing.set_from(|_| false);
        field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
        for picture in &buffer.pictures {
            assert_eq!(largest_difference(&picture.rgb, &alone[0]), 0.0);
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
