//! Images of a camera, under one latent or several.

use std::cell::RefCell;

use carff_base::geometry::{PinholeCamera, Ray};

use super::buffers::{HypothesisBuffer, PixelsMut, RayPixels, RenderBuffer};
use super::compositor::Worker;
use crate::config::{LATENT_DIM, RenderOptions};
use crate::model::field::Field;
use crate::pool::Pool;

/// Side of a tile, pixels: neighbouring rays meet the same entries of the hash grid.
const TILE_PX: u32 = 8;
/// Rays that are marched together: those of one tile.
const CHUNK: usize = TILE_PX as usize * TILE_PX as usize;

thread_local! {
    static WORKER: RefCell<Worker> = RefCell::default();
}

impl Field {
    /// Renders the image of `camera` under `latent`. `out` holds width x height pixels afterwards.
    pub fn render(
        &self,
        camera: &PinholeCamera,
        latent: &[f32; LATENT_DIM],
        options: &RenderOptions,
        out: &mut RenderBuffer,
    ) {
        self.render_where(camera, latent, |_| true, options, out);
    }

    /// Renders the pixels of which `selected` is true, by index row by row; the others are black at distance 0.
    fn render_where(
        &self,
        camera: &PinholeCamera,
        latent: &[f32; LATENT_DIM],
        selected: impl Fn(usize) -> bool,
        options: &RenderOptions,
        out: &mut RenderBuffer,
    ) {
        let (width, height) = (camera.width_px, camera.height_px);
        out.rays.clear();
        out.pixels.clear();
        for top in (0..height).step_by(TILE_PX as usize) {
            for left in (0..width).step_by(TILE_PX as usize) {
                for y in top..(top + TILE_PX).min(height) {
                    for x in (left..(left + TILE_PX).min(width)).filter(|x| selected((y * width + x) as usize)) {
                        out.rays.push(camera.ray(f64::from(x) + 0.5, f64::from(y) + 0.5));
                        out.pixels.push(y * width + x);
                    }
                }
            }
        }
        self.render_chunks(&out.rays, &[*latent], options, (&mut out.by_ray, &mut out.pool));
        out.resize(width as usize * height as usize);
        out.blank(out.rays.len());
        let by_ray = std::mem::take(&mut out.by_ray);
        for ray in 0..out.rays.len() {
            out.set(out.pixels[ray] as usize, &by_ray, ray);
        }
        out.by_ray = by_ray;
    }

    /// Renders the images of `camera` under each of several latents.
    ///
    /// Rays that meet no cell in which the states differ ([`Field::changing`]) are only rendered under the first
    /// latent. The others are marched once for all other latents, which share the first one's densities in cells in
    /// which the states do not differ.
    pub fn render_hypotheses(
        &self,
        camera: &PinholeCamera,
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        out: &mut HypothesisBuffer,
    ) {
        self.render_hypotheses_where(camera, latents, |_| true, options, out);
    }

    /// As [`Self::render_hypotheses`], but only the pixels of which `selected` is true, by index row by row; the others
    /// are black at distance 0.
    pub fn render_hypotheses_where(
        &self,
        camera: &PinholeCamera,
        latents: &[[f32; LATENT_DIM]],
        selected: impl Fn(usize) -> bool,
        options: &RenderOptions,
        out: &mut HypothesisBuffer,
    ) {
        let HypothesisBuffer { images, changing, rays, by_ray, pool } = out;
        images.resize_with(latents.len(), RenderBuffer::default);
        let Some((first, others)) = images.split_first_mut() else { return };
        self.render_where(camera, &latents[0], selected, options, first);
        changing.clear();
        changing.extend((0..first.rays.len() as u32).filter(|i| first.by_ray.changing[*i as usize]));
        rays.clear();
        rays.extend(changing.iter().map(|i| first.rays[*i as usize]));
        if others.is_empty() {
            return;
        }
        self.render_chunks(rays, &latents[1..], options, (by_ray, pool));
        for (k, image) in others.iter_mut().enumerate() {
            image.copy_pixels(first);
            for (at, i) in changing.iter().enumerate() {
                let start = at - at % CHUNK;
                let from = start * (latents.len() - 1) + k * CHUNK.min(rays.len() - start) + at % CHUNK;
                image.set(first.pixels[*i as usize] as usize, by_ray, from);
            }
        }
    }

    /// Renders single rays under one latent: `out` holds one pixel for each ray.
    pub fn render_rays(
        &self,
        rays: &[Ray],
        latent: &[f32; LATENT_DIM],
        options: &RenderOptions,
        out: &mut RenderBuffer,
    ) {
        self.render_chunks(rays, &[*latent], options, (&mut out.by_ray, &mut out.pool));
        out.resize(rays.len());
        let by_ray = std::mem::take(&mut out.by_ray);
        for ray in 0..rays.len() {
            out.set(ray, &by_ray, ray);
        }
        out.by_ray = by_ray;
    }

    /// Renders rays under each latent, chunk by chunk.
    fn render_chunks(
        &self,
        rays: &[Ray],
        latents: &[[f32; LATENT_DIM]],
        options: &RenderOptions,
        (out, pool): (&mut RayPixels, &mut Pool),
    ) {
        pool.set_threads(options.threads.max(1));
        let out = out.resize(rays.len() * latents.len());
        let mut chunks: Vec<(&[Ray], PixelsMut<'_>)> =
            rays.chunks(CHUNK).zip(out.chunks(CHUNK * latents.len())).collect();
        pool.for_each(&mut chunks, |_, (rays, out)| {
            WORKER.with_borrow_mut(|worker| worker.render(self, rays, latents, options, out));
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FieldConfig;
    use crate::kernels::math::{hash, unit};

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

    /// Each of several images equals the one that its latent gives by itself, if states may differ in all cells. When
    /// they differ in none, all images equal the first; so do the pixels of rays that meet no such cell.
    #[test]
    fn hypotheses_share_what_does_not_change() {
        let mut field = field();
        let options = RenderOptions::default();
        let latents: Vec<[f32; LATENT_DIM]> = (0..3).map(|i| [0.8 * i as f32 - 0.8; LATENT_DIM]).collect();
        let single: Vec<Vec<f32>> = latents
            .iter()
            .map(|z| {
                let mut one = RenderBuffer::new();
                field.render(&camera(), z, &options, &mut one);
                one.rgb
            })
            .collect();
        assert!(largest_difference(&single[0], &single[1]) > 1e-2);
        let mut buffer = HypothesisBuffer::default();
        for threads in [1, 2] {
            let options = RenderOptions { threads, ..options };
            field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
            for (image, single) in buffer.images.iter().zip(&single) {
                assert!(largest_difference(&image.rgb, single) < 1e-5);
            }
        }
        field.changing.set_from(|i| i % 16 < 8);
        field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
        let changing = buffer.images[0].changing.clone();
        let share = changing.iter().filter(|c| **c).count();
        assert!(share > 20 && share + 20 < changing.len(), "{share} of {}", changing.len());
        for (k, image) in buffer.images.iter().enumerate() {
            let mut apart = 0;
            for (i, pixel) in image.rgb.chunks_exact(3).enumerate() {
                let first = &single[0][3 * i..3 * i + 3];
                assert!(changing[i] || pixel == first);
                apart += usize::from(largest_difference(pixel, first) > 1e-3);
            }
            assert!(if k == 0 { apart == 0 } else { apart > 20 }, "{apart} pixels of image {k}");
        }
        // Selected pixels have nearly the same colours, as other rays share their blocks of samples; the others are black.
        let mut some = HypothesisBuffer::default();
        field.render_hypotheses_where(&camera(), &latents, |i| i % 3 == 0, &options, &mut some);
        for (all, some) in buffer.images.iter().zip(&some.images) {
            for (i, (all, some)) in all.rgb.chunks_exact(3).zip(some.rgb.chunks_exact(3)).enumerate() {
                assert!(
                    if i % 3 == 0 { largest_difference(all, some) < 2e-2 } else { some == [0.0; 3] },
                    "{i}: {all:?} {some:?}"
                );
            }
        }
        field.changing.set_from(|_| false);
        field.render_hypotheses(&camera(), &latents, &options, &mut buffer);
        for image in &buffer.images {
            assert_eq!(largest_difference(&image.rgb, &single[0]), 0.0);
        }
        field.render_hypotheses(&camera(), &[], &options, &mut buffer);
        assert!(buffer.images.is_empty());
    }

    /// A copy without a part of space shows nothing of it, and everything else as before; densities stay.
    #[test]
    fn a_part_of_space_is_left_out() {
        let field = field();
        let render = |field: &Field| {
            let mut out = RenderBuffer::new();
            field.render(&camera(), &[0.3; LATENT_DIM], &RenderOptions::default(), &mut out);
            (out.rgb, out.opacity)
        };
        assert_eq!(render(&field.without(|_| false)), render(&field));
        let (_, opacity) = render(&field.without(|_| true));
        assert!(opacity.iter().all(|opacity| *opacity == 0.0));
        let without = field.without(|[x, _, _]| x < 0.0);
        let ((all, _), (some, _)) = (render(&field), render(&without));
        let differ = all.iter().zip(&some).filter(|(a, b)| (*a - *b).abs() > 1e-3).count();
        assert!(differ > 100 && differ < all.len(), "{differ} of {}", all.len());
        let (at, mut before, mut after) = ([[-1.0, 2.0, 0.5]], [0.0], [0.0]);
        field.density(&at, &[0.3; LATENT_DIM], &mut before);
        without.density(&at, &[0.3; LATENT_DIM], &mut after);
        assert_eq!(before, after);
    }

    /// Samples of low weight take the mean colour of their ray's other samples: that hardly changes an image.
    #[test]
    fn samples_of_low_weight_take_the_mean_color() {
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
