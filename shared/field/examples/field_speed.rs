//! How fast the field's parts are, in processor time: density alone (features and network apart), and a training step.
//!
//! ```text
//! cargo run --release -p carff-field --example field_speed
//! ```

use std::time::Instant;

use anyhow::Result;
use carff_field::{Field, FieldConfig, FieldTrainer, RayBatch, TrainerConfig};
use carff_geometry::Ray;

/// Processor seconds that this program has used, all threads together (Linux; wall time elsewhere).
fn cpu_seconds(start: Instant) -> f64 {
    let Ok(stat) = std::fs::read_to_string("/proc/self/stat") else {
        return start.elapsed().as_secs_f64();
    };
    stat.split(' ').skip(13).take(2).filter_map(|v| v.parse::<f64>().ok()).sum::<f64>() / 100.0
}

fn main() -> Result<()> {
    let start = Instant::now();
    let config = FieldConfig { bounds_m: [[-17.0, -18.5, 0.0], [6.0, 5.0, 5.0]], ..FieldConfig::default() };
    let field = Field::new(config.clone(), 1)?;
    println!("{}, {} numbers", field.instruction_set().name(), field.parameter_count());
    let mut state = 1_u64;
    let mut uniform = || {
        state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (state >> 40) as f32 / 16_777_216.0
    };
    let points: Vec<[f32; 3]> =
        (0..1 << 15).map(|_| [uniform() * 23.0 - 17.0, uniform() * 23.0 - 18.0, uniform() * 5.0]).collect();
    let mut nanoseconds = [0.0; 2];
    for (n, latents) in [1, 9].into_iter().enumerate() {
        let latents = vec![[0.5; 8]; latents];
        let mut out = vec![0.0; points.len() * latents.len()];
        let (rounds, before) = (40 / latents.len().isqrt(), cpu_seconds(start));
        for _ in 0..rounds {
            field.density_by_latent(&points, &latents, &mut out);
        }
        nanoseconds[n] = (cpu_seconds(start) - before) * 1e9 / (rounds * points.len()) as f64;
    }
    let network = (nanoseconds[1] - nanoseconds[0]) / 8.0;
    let products = (32 * 64 + 64 * 64 + 64 * 16) as f64;
    println!(
        "density: features {:.0} ns, network {network:.0} ns a point ({:.1} GFLOP/s a core)",
        nanoseconds[0] - network,
        2.0 * products / network
    );

    // Synthetic rays at ground level and from above; what they see does not matter for speed.
    let trainer_config = TrainerConfig {
        occupancy_warmup_steps: u64::MAX,
        target_samples_per_ray: 24.0,
        samples_per_step: usize::MAX,
        ..TrainerConfig::default()
    };
    let mut trainer = FieldTrainer::new(field, trainer_config)?;
    let mut batch = RayBatch { latents: vec![[0.5; 8]], ..RayBatch::default() };
    for _ in 0..2048 {
        let d = [uniform() - 0.5, uniform() - 0.5, -uniform()];
        let n = d.iter().map(|v| v * v).sum::<f32>().sqrt();
        batch.rays.push(Ray {
            origin: [uniform() * 20.0 - 15.0, uniform() * 20.0 - 15.0, 2.0 + 10.0 * uniform()],
            direction: d.map(|v| v / n),
        });
        batch.target_rgb.push([uniform(), uniform(), uniform()]);
        batch.latent_index.push(0);
    }
    let (mut samples, mut kept, before, wall) = (0, 0, cpu_seconds(start), Instant::now());
    for _ in 0..20 {
        let report = trainer.step(&batch);
        samples += report.samples;
        kept += report.kept_samples;
    }
    let spent = cpu_seconds(start) - before;
    println!(
        "training: {samples} samples ({kept} kept), {:.0} ns of processor time a sample, wall {:.2} s",
        spent * 1e9 / samples as f64,
        wall.elapsed().as_secs_f64()
    );
    Ok(())
}
