//! Compares the field's kernels with the same model in tensor operations and with the machine's limits.

mod rendering;

use super::best;
use super::inputs::{Piece, TRAINING_RAYS, pieces, random_latent, random_point, training_batch};
use super::limits::{matrix_product, triad};
use crate::reference::{Precision, ReferenceField, huber_sum};
use anyhow::Context;
use carff_bench::FieldArgs;
use carff_bench::report::{Report, number, table};
use carff_bench::stats::{Contender, Ratio, Times, alternate, timed};
use carff_checkpoint::{FieldProbe, Manifest, load_field_probe};
use carff_decision::{Draw, Mixture};
use carff_field::{Field, FieldConfig, FieldTrainer, InstructionSet, LATENT_DIM, RaySamples, TrainerConfig};
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
