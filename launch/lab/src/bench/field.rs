//! Compares the field's kernels with the same model in tensor operations and with the machine's limits.

use super::inputs::{Piece, TRAINING_RAYS, pieces, random_latent, random_point, training_batch};
use super::limits::{matrix_product, triad};
use super::{best, round_and_round};
use crate::reference::{Precision, Rays, ReferenceField, Samples, huber_sum};
use anyhow::Context;
use carff_base::geometry::{PinholeCamera, Ray};
use carff_bench::FieldArgs;
use carff_bench::report::{Report, number, table};
use carff_bench::stats::{Contender, Ratio, Times, alternate, timed};
use carff_checkpoint::{FieldProbe, Manifest, load_field_probe};
use carff_decision::{Draw, Mixture};
use carff_field::{
    Field, FieldConfig, FieldTrainer, HypothesisBuffer, InstructionSet, LATENT_DIM, RayLimits, RaySamples,
    RenderBuffer, RenderOptions, TrainerConfig,
};
use std::time::Instant;
use tch::{Kind, Tensor, nn::OptimizerConfig};

/// Number of hypotheses that are probed.
const HYPOTHESES: usize = 10;
/// Samples of a ray in a training step, which has 2^17 of them.
const SAMPLES_PER_RAY: usize = 32;
/// Learning rate that leaves the field unchanged, so that each step is the same work.
const STANDSTILL: f32 = 1e-12;
/// Points for the rate of the networks; with the latents, the features stay in the second-level cache.
const POINTS: usize = 2048;
const LATENTS: usize = 32;

pub(crate) fn run(args: &FieldArgs) -> anyhow::Result<Report> {
    carff_networks::allocator::keep_large_blocks();
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = args.threads.unwrap_or(cores).max(1);
    tch::set_num_threads(threads as i32);
    let manifest = Manifest::load(&args.checkpoint)?;
    let field = carff_checkpoint::load_field(&args.checkpoint, &manifest)?;
    let mut probe = load_field_probe(&args.checkpoint, &manifest)?;
    let states: Vec<[f32; LATENT_DIM]> = manifest.states.iter().map(|s| s.mean).collect();
    anyhow::ensure!(!states.is_empty(), "checkpoint {} has no states", args.checkpoint.display());
    println!(
        "field of {}: {} numbers, {} instructions ({} for images), {} threads\n",
        args.checkpoint.display(),
        field.parameter_count(),
        field.instruction_set().name(),
        InstructionSet::detect_for_images().name(),
        threads
    );
    let bench = Bench {
        threads,
        side_px: args.side_px.clamp(16, 2048),
        rounds: if args.quick { 3 } else { 15 },
        precisions: precisions(&field),
    };

    let mut fast = field.clone();
    fast.set_instruction_set(InstructionSet::detect_for_images());
    let mut report = Report::default();
    report.set_value("field.instruction_set", field.instruction_set().name().into());
    report.set_value("field.instruction_set_for_images", fast.instruction_set().name().into());
    report.set("field.threads", threads as f64);
    bench.networks(&field, &fast, &mut report);
    bench.rendering(&field, &fast, &states, &mut report);
    bench.probes(&mut probe, &states, &mut report);
    bench.training(&field, &states, &mut report)?;
    Ok(report)
}

/// Number of multiplications and additions of the density network for one sample.
#[derive(Clone, Copy, Debug)]
struct Operations {
    /// First layer; several latents share it.
    first: f64,
    /// Other layers, for the density only (four outputs, of which one counts).
    rest: f64,
    /// All layers with all outputs, as rendering needs them.
    whole: f64,
}

impl Operations {
    fn of(c: &FieldConfig) -> Self {
        let (features, width) = (c.levels * c.features_per_level, c.hidden_width);
        let twice = |products: usize| 2.0 * products as f64;
        Self {
            first: twice(features * width),
            rest: twice(width * width + width * 4),
            whole: twice(features * width + width * width + width * (1 + c.geometry_features)),
        }
    }
}

struct Bench {
    threads: usize,
    side_px: u32,
    rounds: usize,
    precisions: Vec<Precision>,
}

impl Bench {
    /// Compares the density network's rate with that of matrix products, in f32 and with the kernels for images.
    fn networks(&self, field: &Field, fast: &Field, report: &mut Report) {
        let points: Vec<[f32; 3]> = (0..POINTS).map(|i| random_point(field.config(), i as u64)).collect();
        let latents: Vec<[f32; LATENT_DIM]> = (0..LATENTS).map(|i| random_latent(i as u64)).collect();
        let each = Operations::of(field.config());
        let operations = (each.first + each.rest * LATENTS as f64) * (POINTS * self.threads) as f64;
        let native = |field| {
            let mut outs = vec![vec![0.0_f32; POINTS * LATENTS]; self.threads];
            let (points, latents) = (&points, &latents);
            timed(move || {
                std::thread::scope(|scope| {
                    for out in &mut outs {
                        scope.spawn(move || Field::density_by_latent(field, points, latents, out));
                    }
                });
            })
        };
        let width = field.config().hidden_width as i64;
        let square = [1024, 1024, 1024];
        let layer = [1 << 17, width, width];
        let named = [
            ("density network, native f32", (native(field), operations)),
            ("matrix product 1024^3, f32", matrix_product(Kind::Float, square)),
            ("matrix product 131072 x width x width, f32", matrix_product(Kind::Float, layer)),
            ("matrix product 1024^3, bf16", matrix_product(Kind::BFloat16, square)),
            ("matrix product 131072 x width x width, bf16", matrix_product(Kind::BFloat16, layer)),
            ("memory bandwidth (GB/s)", triad(self.threads)),
            ("density network, native, kernels for images", (native(fast), operations)),
        ];
        let (names, measured): (Vec<_>, Vec<_>) = named.into_iter().unzip();
        let (mut contenders, amounts): (Vec<_>, Vec<_>) = measured.into_iter().unzip();
        let seconds = alternate(self.rounds, &mut contenders);
        let rates: Vec<Times> =
            seconds.iter().zip(&amounts).map(|(s, a)| Times::new(s.iter().map(|s| a / s / 1e9).collect())).collect();
        let mut rows = vec![["rate", "median", "lowest", "highest"].map(str::to_owned)];
        for (name, rate) in names.iter().zip(&rates) {
            let [median, low, high] = [0.5, 0.0, 1.0].map(|q| number(rate.quantile(q)));
            let unit = if name.contains("GB/s") { "" } else { " (GFLOP/s)" };
            rows.push([format!("{name}{unit}"), median, low, high]);
        }
        print!("{}", table(&rows));
        let native = rates[0].median();
        let limit = rates[1].median().max(rates[2].median());
        let share = native / limit;
        println!("networks: {} of the measured limit of f32 matrix products", percent(share));
        if fast.instruction_set().is_bf16() {
            let limit = rates[3].median().max(rates[4].median());
            let share = rates[6].median() / limit;
            println!("with bf16 products: {} of that of bf16 matrix products", percent(share));
            report.set("field.mlp_bf16_gflops", rates[6].median());
            report.set("field.mlp_bf16_share_of_limit", share);
        }
        println!();
        report.set("field.mlp_gflops", native);
        report.set("field.mlp_share_of_limit", share);
        report.set("field.limit.f32_gflops", limit);
        report.set("field.limit.bf16_gflops", rates[3].median().max(rates[4].median()));
        report.set("field.limit.bandwidth_gb_s", rates[5].median());
    }

    /// Renders bird's-eye views of every state.
    fn rendering(&self, field: &Field, fast: &Field, states: &[[f32; LATENT_DIM]], report: &mut Report) {
        let bounds_m = field.config().bounds_m.map(|corner| corner.map(f64::from));
        let camera = PinholeCamera::above(bounds_m, self.side_px, self.side_px);
        let rays: Vec<Ray> = (0..self.side_px * self.side_px)
            .map(|i| camera.ray(f64::from(i % self.side_px) + 0.5, f64::from(i / self.side_px) + 0.5))
            .collect();
        let options = RenderOptions { threads: self.threads, ..RenderOptions::default() };
        let limits = RayLimits {
            max_samples: options.max_samples_per_ray,
            min_transmittance: options.min_transmittance,
            step_scale: 1.0,
            use_occupancy: true,
        };
        let samples: Vec<RaySamples> = states
            .iter()
            .map(|z| {
                let mut samples = RaySamples::default();
                field.samples_along(&rays, z, &limits, &mut samples);
                samples
            })
            .collect();
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
        let changing =
            together.images[0].changing.iter().filter(|c| **c).count() as f64 / f64::from(self.side_px * self.side_px);
        println!(
            "{HYPOTHESES} hypotheses together: {} ms, {} frames a second, each; {} of the rays meet what changes\n",
            number(shared * 1e3),
            number(1.0 / shared),
            percent(changing)
        );
        report.set("field.render_fps", 1.0 / shared);
        report.set("field.render_alone_fps", 1.0 / native);
        report.set("field.render_changing_rays", changing);
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
        let rays: Vec<Ray> = (0..self.side_px * self.side_px)
            .map(|i| camera.ray(f64::from(i % self.side_px) + 0.5, f64::from(i / self.side_px) + 0.5))
            .collect();
        let points: Vec<[f32; 3]> = samples
            .ray
            .iter()
            .zip(&samples.distance_m)
            .map(|(ray, t)| {
                let ray = &rays[*ray as usize];
                std::array::from_fn(|i| ray.origin[i] + t * ray.direction[i])
            })
            .collect();
        let latents: Vec<[f32; LATENT_DIM]> = vec![*z; 9];
        let (mut one, mut nine) = (vec![0.0; points.len()], vec![0.0; points.len() * 9]);
        let (mut buffer, mut without_color) = (RenderBuffer::new(), RenderBuffer::new());
        let mut nothing = RenderBuffer::new();
        let options = RenderOptions::default();
        // No sample has a weight above 1: then only the heaviest sample of each ray has a colour.
        let one_color = RenderOptions { min_weight: 2.0, ..options };
        let colored = samples.weight.iter().filter(|w| **w > options.min_weight).count() as f64;
        let up: Vec<Ray> = rays
            .iter()
            .map(|r| Ray {
                origin: [r.origin[0], r.origin[1], 1e6],
                direction: r.direction.map(|v| v * 1e-9),
                spread: r.spread,
            })
            .collect();
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
        let mut rows = vec![["parts of a frame's time (one thread)", "ms", "share"].map(str::to_owned)];
        for (name, part) in parts {
            rows.push([name.replace('_', " "), number(part * 1e3), percent(part / all)]);
            report.set(&format!("field.render_parts_ms.{name}"), part * 1e3);
        }
        rows.push(["all".to_owned(), number(all * 1e3), percent(1.0)]);
        report.set("field.render_one_thread_ms", all * 1e3);
        println!("{}", table(&rows));
    }

    /// Probes ten hypotheses as the prober does (one thread), and computes only their densities.
    fn probes(&self, probe: &mut FieldProbe, states: &[[f32; LATENT_DIM]], report: &mut Report) {
        let draws: Vec<[f32; LATENT_DIM]> = (0..HYPOTHESES)
            .map(|i| {
                let noise = random_latent(i as u64);
                std::array::from_fn(|k| states[i % states.len()][k] + 0.2 * noise[k])
            })
            .collect();
        let field = Field::clone(probe.field());
        let points = field.prepare(probe.layout().points());
        let mut densities = vec![0.0; points.len() * draws.len()];
        let mixture = Mixture { weights: Vec::new(), components: Vec::new() };
        let drawn = || draws.iter().map(|z| Draw { latent: *z, component: 0 }).collect::<Vec<_>>();
        let seconds = alternate(
            self.rounds * 20,
            &mut [
                timed(|| {
                    std::hint::black_box(probe.step(mixture.clone(), drawn(), 1.0, None));
                }),
                timed(|| field.density_prepared(&points, &draws, &mut densities)),
            ],
        );
        let [step, densities_only] = [0, 1].map(|i| Times::new(seconds[i].clone()));
        let mut rows = vec![["probing, one thread (ms)", "p50", "p99"].map(str::to_owned)];
        for (name, times) in [
            (format!("{HYPOTHESES} hypotheses at {} points, with readings", points.len()), &step),
            ("densities only, features shared".to_owned(), &densities_only),
        ] {
            rows.push([name, number(times.median() * 1e3), number(times.quantile(0.99) * 1e3)]);
        }
        println!("{}", table(&rows));
        report.set("field.probe_ms", step.median() * 1e3);
        report.set("field.probe_p99_ms", step.quantile(0.99) * 1e3);
        report.set("field.probe_densities_ms", densities_only.median() * 1e3);
        report.set("field.probe_points", points.len() as f64);
    }

    /// Measures a training step of 2^17 samples, each with a colour and a gradient.
    fn training(&self, field: &Field, states: &[[f32; LATENT_DIM]], report: &mut Report) -> anyhow::Result<()> {
        let batch = training_batch(field.config(), states);
        let config = TrainerConfig {
            threads: self.threads,
            gradient_shards: self.threads,
            learning_rate_table: STANDSTILL,
            learning_rate_networks: STANDSTILL,
            max_samples_per_ray: SAMPLES_PER_RAY,
            samples_per_step: usize::MAX,
            min_transmittance: 0.0,
            roulette_weight: 0.0,
            jitter: false,
            occupancy_warmup_steps: u64::MAX,
            target_samples_per_ray: SAMPLES_PER_RAY as f32,
            most_step_scale: 4.0,
            ..TrainerConfig::default()
        };
        let mut trainer = FieldTrainer::new(field.clone(), config.clone())?;
        let mut samples = RaySamples::default();
        field.samples_along(&batch.rays, &batch.latents[0], &trainer.limits(), &mut samples);
        let count = trainer.step(&batch).kept_samples;
        anyhow::ensure!(count == samples.ray.len(), "{count} samples instead of {}", samples.ray.len());

        let references: Vec<ReferenceField> = self.precisions.iter().map(|p| ReferenceField::new(field, *p)).collect();
        let mut contenders: Vec<Contender<'_>> = vec![timed(|| {
            std::hint::black_box(trainer.step(&batch));
        })];
        let mut chunks = Vec::new();
        let degree = field.config().direction_degree;
        for reference in &references {
            let mut optimizer = tch::nn::Adam::default()
                .build(reference.store(), f64::from(STANDSTILL))
                .context("no optimizer from libtorch")?;
            let mut step = move |pieces: &[Piece]| {
                optimizer.zero_grad();
                for piece in pieces {
                    let pixels = reference.pixels(&piece.rays, &piece.samples, &piece.latents);
                    let loss = huber_sum(&pixels, &piece.targets, f64::from(config.huber_delta));
                    (loss / (3.0 * TRAINING_RAYS as f64)).backward();
                }
                optimizer.step();
            };
            let rays_at_once = best(&[512, TRAINING_RAYS as i64, 1024, 256, 128], |rays| {
                step(&pieces(&batch, &samples, rays as usize, degree));
            });
            let pieces = pieces(&batch, &samples, rays_at_once as usize, degree);
            chunks.push(rays_at_once * SAMPLES_PER_RAY as i64);
            contenders.push(timed(move || step(&pieces)));
        }
        let seconds = alternate(self.rounds.min(9), &mut contenders);
        drop(contenders);
        println!("training step of {count} samples, all with colour and gradient");
        self.versus("train", count as f64, &chunks, &seconds, report);
        Ok(())
    }

    /// Prints and records native kernels against tensor operations; returns the native median, seconds.
    fn versus(&self, what: &str, count: f64, chunks: &[i64], seconds: &[Vec<f64>], report: &mut Report) -> f64 {
        let medians: Vec<f64> = seconds.iter().map(|s| Times::new(s.clone()).median()).collect();
        let mut rows = vec![["by", "ms", "a second", "ns/sample"].map(str::to_owned)];
        let mut row = |name: String, median: f64| {
            rows.push([name, number(median * 1e3), number(1.0 / median), number(median * 1e9 / count)]);
        };
        row("native kernels".to_owned(), medians[0]);
        report.set(&format!("field.{what}_ms"), medians[0] * 1e3);
        for ((precision, chunk), median) in self.precisions.iter().zip(chunks).zip(&medians[1..]) {
            let kind = precision_name(*precision);
            row(format!("tensor operations, {kind}, {chunk} samples at a time"), *median);
            report.set(&format!("field.{what}_tch_{kind}_ms"), median * 1e3);
        }
        let better = (1..medians.len()).min_by(|a, b| medians[*a].total_cmp(&medians[*b])).unwrap_or(0);
        let ratio = Ratio::new(&seconds[better], &seconds[0]);
        println!("{}native kernels are {ratio} as fast as tensor operations at their best", table(&rows));
        report.set(&format!("field.{what}_vs_tch"), ratio.of_medians);
        report.set(&format!("field.{what}_vs_tch_low"), ratio.low);
        report.set(&format!("field.{what}_vs_tch_high"), ratio.high);
        medians[0]
    }
}

fn precision_name(precision: Precision) -> &'static str {
    match precision {
        Precision::F32 => "f32",
        Precision::Bf16 => "bf16",
    }
}

/// Returns the precisions to measure: bf16 only if the tensor library is not far slower with it than with f32.
fn precisions(field: &Field) -> Vec<Precision> {
    let points: Vec<f32> = (0..1 << 12).flat_map(|i| random_point(field.config(), i)).collect();
    let (points, latent) = (Tensor::from_slice(&points).view([-1, 3]), Tensor::from_slice(&random_latent(0)));
    let seconds = [Precision::F32, Precision::Bf16].map(|precision| {
        let reference = ReferenceField::new(field, precision);
        let mut least = f64::INFINITY;
        for _ in 0..3 {
            let start = Instant::now();
            drop(std::hint::black_box(tch::no_grad(|| reference.density(&points, &latent))));
            least = least.min(start.elapsed().as_secs_f64());
        }
        least
    });
    let slower = seconds[1] / seconds[0];
    if slower > 1.5 {
        println!("networks in bf16 are left out: tensor operations are {slower:.1} times slower with them here\n");
        vec![Precision::F32]
    } else {
        vec![Precision::F32, Precision::Bf16]
    }
}

fn percent(share: f64) -> String {
    format!("{:.1} %", share * 100.0)
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
