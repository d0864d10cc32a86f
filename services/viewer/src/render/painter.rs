//! Renders requests: a view coarse first, then finer, each image in bands within a budget of time.

use super::desk::{Drawn, Job, RenderPace, Shared, View};
use crate::slice::density_slice;
use carff_base::geometry::PinholeCamera;
use carff_dataset::Image;
use carff_field::{Field, HypothesisBuffer, LATENT_DIM, RenderBuffer, RenderOptions, to_byte, to_bytes};
use std::sync::PoisonError;
use std::sync::atomic::Ordering;
use std::time::Instant;

/// Time budget of a coarse image of a view, milliseconds.
const COARSE_MS: f64 = 40.0;
/// Time budget of an image of a scene that changes by itself, milliseconds.
const STEADY_MS: f64 = 160.0;
/// Assumed render time of a pixel before the first measurement, nanoseconds.
const FIRST_PIXEL_NS: f64 = 6_000.0;
/// Weight of the newest measurement of the pixel time.
const NEWEST_WEIGHT: f64 = 0.3;
/// Minimum length of an image's longer side, pixels: of a view, and of a scene that changes by itself.
const COARSEST_PX: u32 = 56;
const COARSEST_STEADY_PX: u32 = 112;
/// Divisors of a view's sides.
const DIVISORS: [u32; 8] = [1, 2, 3, 4, 6, 8, 12, 16];
/// Number of thumbnails rendered at a time.
const BATCH: usize = 4;

/// Returns the divisors of a view's sides, image by image. The first image has at most `budget_px` pixels, or is as
/// coarse as possible (`coarsest_px` along the longer side). Each further image is at least twice as fine; the last one
/// has full size.
fn divisors(width_px: u32, height_px: u32, coarsest_px: u32, budget_px: f64) -> Vec<u32> {
    let pixels = |divisor: u32| f64::from(width_px / divisor) * f64::from(height_px / divisor);
    let longest_px = width_px.max(height_px);
    let allowed = DIVISORS.into_iter().take_while(|d| *d == 1 || longest_px / d >= coarsest_px);
    let mut divisor = 1;
    for coarser in allowed {
        divisor = coarser;
        if pixels(divisor) <= budget_px {
            break;
        }
    }
    let mut all = vec![divisor];
    while divisor > 1 {
        divisor /= 2;
        all.push(divisor);
    }
    all
}

/// Renders requests with one field, and measures how long a pixel takes.
pub(super) struct Painter {
    field: Field,
    options: RenderOptions,
    buffer: RenderBuffer,
    hypotheses: HypothesisBuffer,
    /// Measured render time of a pixel, nanoseconds.
    pixel_ns: f64,
}

impl Painter {
    /// Returns a painter that renders with `threads` threads.
    pub(super) fn new(field: Field, threads: usize) -> Self {
        Self {
            field,
            options: RenderOptions { threads: threads.max(1), ..RenderOptions::default() },
            buffer: RenderBuffer::new(),
            hypotheses: HypothesisBuffer::default(),
            pixel_ns: FIRST_PIXEL_NS,
        }
    }

    /// Renders what waits at the desk until it is stopped.
    pub(super) fn work(&mut self, shared: &Shared, wake: &dyn Fn()) {
        loop {
            let mut desk = shared.desk();
            desk.working = None;
            let job = loop {
                if desk.is_stopped {
                    return;
                }
                match desk.take() {
                    Some(job) => break job,
                    None => desk = shared.called.wait(desk).unwrap_or_else(PoisonError::into_inner),
                }
            };
            desk.working = Some(job.kind());
            drop(desk);
            let (drawn, rest) = self.draw(job, shared);
            let mut desk = shared.desk();
            let any = !drawn.is_empty();
            for drawn in drawn {
                desk.deliver(drawn);
            }
            if let (Some(job), false) = (rest, desk.is_stopped) {
                desk.put_back(job);
            }
            drop(desk);
            if any {
                wake();
            }
        }
    }

    /// Renders a job, or a part of it; returns the images and the rest of the job.
    fn draw(&mut self, job: Job, shared: &Shared) -> (Vec<Drawn>, Option<Job>) {
        match job {
            Job::View(view) => self.draw_view(view, shared),
            Job::BirdsEye { latent, camera } => {
                self.field.render(&camera, &latent, &self.options, &mut self.buffer);
                (vec![Drawn::BirdsEye { latent, image: image_of(&camera, &self.buffer) }], None)
            }
            Job::Slice { latent, height_m, longest_px } => {
                let image = density_slice(&self.field, &latent, height_m, longest_px);
                (vec![Drawn::Slice { latent, image }], None)
            }
            Job::Thumbnails { latents, camera, done } => {
                let end = (done + BATCH).min(latents.len());
                let batch = &latents[done.min(end)..end];
                self.field.render_hypotheses(&camera, batch, &self.options, &mut self.hypotheses);
                let drawn = batch.iter().zip(&self.hypotheses.images).enumerate().map(|(i, (latent, drawn))| {
                    Drawn::Thumbnail { index: done + i, latent: *latent, image: image_of(&camera, drawn) }
                });
                let drawn = drawn.collect();
                (drawn, (end < latents.len()).then_some(Job::Thumbnails { latents, camera, done: end }))
            }
        }
    }

    fn draw_view(&mut self, mut view: View, shared: &Shared) -> (Vec<Drawn>, Option<Job>) {
        let (width_px, height_px) = (view.camera.width_px, view.camera.height_px);
        let begun = !view.divisors.is_empty();
        let mut left = if begun {
            std::mem::take(&mut view.divisors)
        } else {
            let (may_take_ms, coarsest_px) = match view.pace {
                RenderPace::Steady => (STEADY_MS, COARSEST_STEADY_PX),
                RenderPace::Moving | RenderPace::Resting => (COARSE_MS, COARSEST_PX),
            };
            divisors(width_px, height_px, coarsest_px, may_take_ms * 1e6 / self.pixel_ns)
        };
        let divisor = left.remove(0);
        let camera = view.camera.resized((width_px / divisor).max(1), (height_px / divisor).max(1));
        let started = Instant::now();
        // A coarse image is always finished, so that a continuous camera movement stays visible.
        let is_wanted = || !begun || shared.newest_view.load(Ordering::Relaxed) == view.number;
        let Some(image) = self.in_bands(&view.latent, &camera, is_wanted) else { return (Vec::new(), None) };
        let took_ms = started.elapsed().as_secs_f64() * 1e3;
        let pixel_ns = took_ms * 1e6 / (f64::from(camera.width_px) * f64::from(camera.height_px));
        self.pixel_ns += NEWEST_WEIGHT * (pixel_ns - self.pixel_ns);
        let is_final = left.is_empty();
        let drawn = Drawn::View { latent: view.latent, image, camera: view.camera, is_final, took_ms };
        let rest =
            (!is_final && view.pace == RenderPace::Resting).then_some(Job::View(View { divisors: left, ..view }));
        (vec![drawn], rest)
    }

    /// Renders an image in bands, each within the budget of a coarse image. Returns `None` if it is no longer wanted.
    fn in_bands(
        &mut self,
        latent: &[f32; LATENT_DIM],
        camera: &PinholeCamera,
        is_wanted: impl Fn() -> bool,
    ) -> Option<Image> {
        let rows = (COARSE_MS * 1e6 / self.pixel_ns / f64::from(camera.width_px)).max(8.0) as u32;
        let mut rgb = Vec::with_capacity(camera.width_px as usize * camera.height_px as usize * 3);
        for top in (0..camera.height_px).step_by(rows as usize) {
            if !is_wanted() {
                return None;
            }
            let band = PinholeCamera {
                height_px: rows.min(camera.height_px - top),
                cy_px: camera.cy_px - f64::from(top),
                ..*camera
            };
            self.field.render(&band, latent, &self.options, &mut self.buffer);
            rgb.extend(self.buffer.rgb.iter().map(|&value| to_byte(value)));
        }
        Some(Image { width_px: camera.width_px, height_px: camera.height_px, rgb })
    }
}

/// Returns a rendered image as bytes.
pub(super) fn image_of(camera: &PinholeCamera, rendered: &RenderBuffer) -> Image {
    Image { width_px: camera.width_px, height_px: camera.height_px, rgb: to_bytes(&rendered.rgb) }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The first image fits the budget or is the coarsest, each further one is at least twice as fine, and the last has
    /// full size.
    #[test]
    fn views_get_finer() {
        for budget_px in [1.0, 500.0, 3_000.0, 40_000.0, 1e9] {
            let all = divisors(320, 240, 40, budget_px);
            assert!(all.windows(2).all(|pair| pair[1] * 2 <= pair[0]), "{all:?}");
            assert_eq!(all.last(), Some(&1));
            let first = f64::from(320 / all[0]) * f64::from(240 / all[0]);
            assert!(first <= budget_px || all[0] == 8, "{all:?}");
        }
        assert_eq!((divisors(320, 240, 40, 1e9), divisors(30, 20, 40, 1.0)), (vec![1], vec![1]));
    }
}
