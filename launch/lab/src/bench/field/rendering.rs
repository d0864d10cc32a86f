//! Measures rendering: native kernels against tensor operations, hypotheses together, and the parts of a frame's time.

use super::{Bench, HYPOTHESES, Operations, percent};
use crate::bench::{best, round_and_round};
use crate::reference::{Rays, ReferenceField, Samples};
use carff_base::geometry::{PinholeCamera, Ray};
use carff_bench::report::{Report, number, table};
use carff_bench::stats::{Ratio, Times, alternate, timed};
use carff_field::{Field, HypothesisBuffer, LATENT_DIM, RayLimits, RaySamples, RenderBuffer, RenderOptions};
use tch::Tensor;

impl Bench {
    /// Renders bird's-eye views of every state.
    pub(super) fn rendering(&self, field: &Field, fast: &Field, states: &[[f32; LATENT_DIM]], report: &mut Report) {
        let bounds_m = field.config().bounds_m.map(|corner| corner.map(f64::from));
        let camera = PinholeCamera::above(bounds_m, self.side_px, self.side_px);
        let rays = pixel_rays(&camera);
        let options = RenderOptions { threads: self.threads, ..RenderOptions::default() };
        let samples: Vec<RaySamples> = states.iter().map(|z| samples_of(field, &rays, z, &options)).collect();
        let count = samples.iter().map(|s| s.ray.len()).sum::<usize>() as f64 / states.len() as f64;
        let kept = |s: &RaySamples| s.weight.iter().filter(|w| **w > options.min_weight).count();
        let kept = samples.iter().map(kept).sum::<usize>() as f64 / states.len() as f64;

        let tensor_rays = Rays::new(&rays, field.config().direction_degree);
        let tensor_samples: Vec<Samples> = samples.iter().map(Samples::new).collect();
        let latents: Vec<Tensor> = states.iter().map(|z| Tensor::from_slice(z)).collect();
        let references: Vec<ReferenceField> = self.precisions.iter().map(|p| ReferenceField::new(field, *p)).collect();
        let min_weight = f64::from(options.min_weight);
        let frame = |reference: &ReferenceField, state: usize, chunk: i64| {
            drop(std::hint::black_box(reference.render(
                &tensor_rays,
                &tensor_samples[state],
                &latents[state],
                min_weight,
                chunk,
            )));
        };
        let hypotheses: Vec<[f32; LATENT_DIM]> = (0..HYPOTHESES).map(|i| states[i % states.len()]).collect();
        let mut together = HypothesisBuffer::default();
        let mut buffer = RenderBuffer::new();
        let mut exact = RenderBuffer::new();
        let mut contenders = vec![
            round_and_round(states.len(), |s| fast.render(&camera, &states[s], &options, &mut buffer)),
            round_and_round(states.len(), |s| field.render(&camera, &states[s], &options, &mut exact)),
        ];
        let mut chunks = Vec::new();
        for reference in &references {
            let chunk = best(&[1 << 13, 1 << 12, 1 << 14, 1 << 16, 1 << 22], |chunk| frame(reference, 0, chunk));
            chunks.push(chunk.min(count as i64));
            contenders.push(round_and_round(states.len(), move |s| frame(reference, s, chunk)));
        }
        contenders.push(timed(|| fast.render_hypotheses(&camera, &hypotheses, &options, &mut together)));
        let mut seconds = alternate(self.rounds, &mut contenders);
        drop(contenders);
        println!(
            "bird's-eye view {0} x {0}: {1:.0} samples, {2:.0} of them with colour, a frame",
            self.side_px, count, kept
        );
        let shared = Times::new(seconds.pop().unwrap_or_default()).median() / HYPOTHESES as f64;
        let in_f32 = seconds.remove(1);
        let native = self.versus("render", count, &chunks, &seconds, report);
        println!("(tensor operations receive the positions of the samples, so that they need not march)");
        if fast.instruction_set().is_bf16() {
            bf16_against_f32([fast, field], states, &camera, [&seconds[0], &in_f32], report);
        }
        hypotheses_together(shared, &together.images[0].changing, report);
        println!("one hypothesis: {} rays a second\n", number(rays.len() as f64 / native));
        report.set("field.render_alone_fps", 1.0 / native);
        report.set("field.render_alone_rays_s", rays.len() as f64 / native);
        report.set("field.render_samples", count);
        report.set("field.render_colored_samples", kept);
        self.breakdown(fast, states, &camera, &samples, report);
    }

    /// Splits the time of rendering on one thread into parts, by leaving parts out.
    fn breakdown(
        &self,
        field: &Field,
        states: &[[f32; LATENT_DIM]],
        camera: &PinholeCamera,
        samples: &[RaySamples],
        report: &mut Report,
    ) {
        let (z, samples) = (&states[0], &samples[0]);
        let rays = pixel_rays(camera);
        let points = points_of(&rays, samples);
        let latents: Vec<[f32; LATENT_DIM]> = vec![*z; 9];
        let (mut one, mut nine) = (vec![0.0; points.len()], vec![0.0; points.len() * 9]);
        let (mut buffer, mut without_color) = (RenderBuffer::new(), RenderBuffer::new());
        let mut nothing = RenderBuffer::new();
        let options = RenderOptions::default();
        // No sample has a weight above 1: then only the heaviest sample of each ray has a colour.
        let one_color = RenderOptions { min_weight: 2.0, ..options };
        let colored = samples.weight.iter().filter(|w| **w > options.min_weight).count() as f64;
        let up = out_of_the_field(&rays);
        let seconds = alternate(
            self.rounds,
            &mut [
                timed(|| field.render(camera, z, &options, &mut buffer)),
                timed(|| field.render(camera, z, &one_color, &mut without_color)),
                // In pieces, as in rendering, so that the features stay in the cache.
                timed(|| {
                    for (points, out) in points.chunks(512).zip(one.chunks_mut(512)) {
                        field.density(points, z, out);
                    }
                }),
                timed(|| {
                    for (points, out) in points.chunks(512).zip(nine.chunks_mut(512 * 9)) {
                        field.density_by_latent(points, &latents, out);
                    }
                }),
                timed(|| {
                    field.render_rays(&up, z, &RenderOptions { max_samples_per_ray: 1, ..options }, &mut nothing);
                }),
            ],
        );
        let [all, one_color, density, ninefold, rays_only] =
            [0, 1, 2, 3, 4].map(|i| Times::new(seconds[i].clone()).median());
        // One more latent costs the layers after the first, for the density only; the rest is in proportion.
        let (each, more) = (Operations::of(field.config()), (ninefold - density) / 8.0);
        let network = more * each.whole / each.rest;
        let features = density - more * (each.first + each.rest) / each.rest;
        let color = (all - one_color) * colored / (colored - rays.len() as f64).max(1.0);
        let parts = [
            ("features", features),
            ("density_network", network),
            ("color_network", color),
            ("rays_and_background", rays_only),
            ("marching_and_the_rest", all - color - features - network - rays_only),
        ];
        tell_parts(all, &parts, report);
    }
}

/// Returns the rays through the middles of a camera's pixels, row by row.
fn pixel_rays(camera: &PinholeCamera) -> Vec<Ray> {
    let ray = |i: u32| camera.ray(f64::from(i % camera.width_px) + 0.5, f64::from(i / camera.width_px) + 0.5);
    (0..camera.width_px * camera.height_px).map(ray).collect()
}

/// Returns the samples that rendering takes along rays.
fn samples_of(field: &Field, rays: &[Ray], z: &[f32; LATENT_DIM], options: &RenderOptions) -> RaySamples {
    let limits = RayLimits {
        max_samples: options.max_samples_per_ray,
        min_transmittance: options.min_transmittance,
        step_scale: 1.0,
        use_occupancy: true,
    };
    let mut samples = RaySamples::default();
    field.samples_along(rays, z, &limits, &mut samples);
    samples
}

/// Returns the positions of samples along rays, metres.
fn points_of(rays: &[Ray], samples: &RaySamples) -> Vec<[f32; 3]> {
    let point = |(ray, t): (&u32, &f32)| {
        let ray = &rays[*ray as usize];
        std::array::from_fn(|i| ray.origin[i] + t * ray.direction[i])
    };
    samples.ray.iter().zip(&samples.distance_m).map(point).collect()
}

/// Returns as many rays, high above the field, which meet nothing of it.
fn out_of_the_field(rays: &[Ray]) -> Vec<Ray> {
    let moved = |r: &Ray| Ray {
        origin: [r.origin[0], r.origin[1], 1e6],
        direction: r.direction.map(|v| v * 1e-9),
        spread: r.spread,
    };
    rays.iter().map(moved).collect()
}

/// Prints and records the time of each of the hypotheses that are rendered together, seconds, and the share of the rays
/// that meet what changes.
fn hypotheses_together(each_s: f64, changing: &[bool], report: &mut Report) {
    let rays_s = changing.len() as f64 / each_s;
    let changing = changing.iter().filter(|c| **c).count() as f64 / changing.len() as f64;
    println!(
        "{HYPOTHESES} hypotheses together: {} ms, {} frames a second, each; {} rays a second; {} of the rays meet what changes",
        number(each_s * 1e3),
        number(1.0 / each_s),
        number(rays_s),
        percent(changing)
    );
    report.set("field.render_fps", 1.0 / each_s);
    report.set("field.render_rays_s", rays_s);
    report.set("field.render_changing_rays", changing);
}

/// Prints and records the parts of a frame's time, seconds.
fn tell_parts(all: f64, parts: &[(&str, f64)], report: &mut Report) {
    let mut rows = vec![["parts of a frame's time (one thread)", "ms", "share"].map(str::to_owned)];
    for (name, part) in parts {
        rows.push([name.replace('_', " "), number(part * 1e3), percent(part / all)]);
        report.set(&format!("field.render_parts_ms.{name}"), part * 1e3);
    }
    rows.push(["all".to_owned(), number(all * 1e3), percent(1.0)]);
    report.set("field.render_one_thread_ms", all * 1e3);
    println!("{}", table(&rows));
}

/// Prints and records speed and image quality of kernels with bf16 products against those in f32.
fn bf16_against_f32(
    fields: [&Field; 2],
    states: &[[f32; LATENT_DIM]],
    camera: &PinholeCamera,
    [in_bf16, in_f32]: [&[f64]; 2],
    report: &mut Report,
) {
    let options = RenderOptions::default();
    let mut buffer = RenderBuffer::new();
    let ratio = Ratio::new(in_f32, in_bf16);
    let mut images = [Vec::new(), Vec::new()];
    for z in states {
        for (field, all) in fields.into_iter().zip(&mut images) {
            field.render(camera, z, &options, &mut buffer);
            all.extend_from_slice(&buffer.rgb);
        }
    }
    let db = carff_base::statistics::psnr_db(&images[0], &images[1]).unwrap_or(f64::INFINITY);
    println!("native kernels with bf16 products are {ratio} as fast as in f32; {} dB against it", number(db));
    report.set("field.render_f32_ms", Times::new(in_f32.to_vec()).median() * 1e3);
    report.set("field.render_bf16_vs_f32", ratio.of_medians);
    report.set("field.render_bf16_psnr_db", db);
}
