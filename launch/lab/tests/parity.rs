//! The native kernels against the same field in plain tensor operations: values, images, gradients.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::geometry::Ray;
use carff_base::random::{Key, gaussians};
use carff_field::{
    Field, FieldConfig, FieldTrainer, InstructionSet, LATENT_DIM, RayBatch, RayLimits, RaySamples, RenderBuffer,
    RenderOptions, TrainerConfig,
};
use carff_lab::reference::{Precision, Rays, ReferenceField, Samples, huber_sum};
use tch::Tensor;

fn normals<const N: usize>(seed: u64, i: usize) -> [f32; N] {
    gaussians(Key { seed, frame: i as u64, step: 0, sample: 0 })
}

fn latent(seed: u64) -> [f32; LATENT_DIM] {
    normals(seed, 7)
}

/// Makes a field with values as large as training makes them.
fn rough_field(config: FieldConfig, seed: u64) -> Field {
    let field = Field::new(config.clone(), seed).unwrap();
    let tensors: Vec<_> = field
        .tensors()
        .into_iter()
        .map(|t| {
            let mut data = t.data.into_owned();
            for (i, v) in data.iter_mut().enumerate() {
                let [noise] = normals(seed + 1, i);
                match &*t.name {
                    "grid.table" => *v = 0.4 * noise,
                    name if name.split('.').next_back() == Some("bias") => *v = 0.1 * noise,
                    _ => {}
                }
            }
            (t.name.into_owned(), t.shape, data)
        })
        .collect();
    Field::from_tensors(config, tensors).unwrap()
}

fn config() -> FieldConfig {
    FieldConfig {
        bounds_m: [[-17.0, -18.5, 0.0], [6.0, 5.0, 5.0]],
        log2_table_size: 14,
        occupancy_resolution: 16,
        latent_mean: latent(1),
        latent_scale: [0.8, 1.2, 0.5, 1.0, 2.0, 0.7, 1.1, 0.9],
        ..FieldConfig::default()
    }
}

/// Points inside and far outside the bounds, and directions.
fn points(count: usize, seed: u64) -> (Vec<[f32; 3]>, Vec<[f32; 3]>) {
    let points = (0..count).map(|i| {
        let [x, y, z] = normals::<3>(seed, i);
        let far = if i % 5 == 0 { 10.0 } else { 1.0 };
        [-5.0 + 8.0 * far * x, -6.0 + 8.0 * far * y, 2.0 + 2.0 * far * z]
    });
    let directions = (0..count).map(|i| unit(normals(seed + 1, i)));
    (points.collect(), directions.collect())
}

fn unit(v: [f32; 3]) -> [f32; 3] {
    let n = v.iter().map(|v| v * v).sum::<f32>().sqrt();
    v.map(|v| v / n)
}

fn rows<const N: usize>(rows: &[[f32; N]]) -> Tensor {
    Tensor::from_slice(rows.as_flattened()).view([-1, N as i64])
}

fn values(t: &Tensor) -> Vec<f32> {
    Vec::try_from(t.contiguous().view(-1)).unwrap()
}

/// Densities agree to 1e-4 of their value and colours to 1e-4, in f32, for dense and hashed levels, 2, 4 and 8
/// features, each degree of the directions, points with and without a width, several latents, and every instruction set
/// of this processor.
#[test]
fn values_agree_in_f32() {
    for (seed, (features_per_level, levels, direction_degree)) in
        [(2, 8, 1), (4, 8, 3), (8, 4, 4), (4, 1, 2)].into_iter().enumerate()
    {
        let point_width_m = 0.1 * (seed % 2) as f32;
        let config = FieldConfig { features_per_level, levels, direction_degree, point_width_m, ..config() };
        let mut field = rough_field(config, seed as u64);
        let reference = ReferenceField::new(&field, Precision::F32);
        let (points, directions) = points(500, 10 + seed as u64);
        for z in (0..3).map(latent) {
            let (want_density, want_rgb) = tch::no_grad(|| {
                reference.density_and_color(&rows(&points), &rows(&directions), &Tensor::from_slice(&z))
            });
            let separate = tch::no_grad(|| reference.density(&rows(&points), &Tensor::from_slice(&z)));
            let (want_density, want_rgb, separate) = (values(&want_density), values(&want_rgb), values(&separate));
            assert_eq!(want_density, separate);
            for set in [InstructionSet::portable(), InstructionSet::detect()] {
                field.set_instruction_set(set);
                let (mut density, mut rgb) = (vec![0.0; points.len()], vec![[0.0; 3]; points.len()]);
                field.density_and_color(&points, &directions, &z, &mut density, &mut rgb);
                for i in 0..points.len() {
                    let error = (density[i] - want_density[i]).abs() / want_density[i];
                    assert!(error < 1e-4, "{}: point {i}: {} {}", set.name(), density[i], want_density[i]);
                    for c in 0..3 {
                        let error = (rgb[i][c] - want_rgb[3 * i + c]).abs();
                        assert!(error < 1e-4, "{}: point {i}: {:?}", set.name(), rgb[i]);
                    }
                }
            }
        }
    }
}

/// A latent for each point gives the same values as one latent at a time.
#[test]
fn latents_by_point() {
    let field = rough_field(config(), 3);
    let reference = ReferenceField::new(&field, Precision::F32);
    let (points, _) = points(40, 5);
    let latents: Vec<_> = (0..40).map(|i| latent(i % 3)).collect();
    let all = values(&tch::no_grad(|| reference.density(&rows(&points), &rows(&latents))));
    for (i, z) in latents.iter().enumerate() {
        let mut density = [0.0];
        field.density(&points[i..=i], z, &mut density);
        assert!((density[0] - all[i]).abs() < 1e-4 * density[0], "{} {}", density[0], all[i]);
    }
}

/// With networks in bf16 in either implementation, the logarithm of the density is off by less than 0.1 and colour by
/// less than 0.03. (In the native one where the processor has the instruction.)
#[test]
fn values_in_bf16_are_near() {
    let (points, directions) = points(500, 20);
    let z = latent(2);
    let mut field = rough_field(config(), 4);
    for (set, precision) in
        [(InstructionSet::detect(), Precision::Bf16), (InstructionSet::detect_for_images(), Precision::F32)]
    {
        if precision == Precision::F32 && !set.is_bf16() {
            continue;
        }
        let reference = ReferenceField::new(&field, precision);
        let (want_density, want_rgb) =
            tch::no_grad(|| reference.density_and_color(&rows(&points), &rows(&directions), &Tensor::from_slice(&z)));
        let (want_density, want_rgb) = (values(&want_density), values(&want_rgb));
        field.set_instruction_set(set);
        let (mut density, mut rgb) = (vec![0.0; points.len()], vec![[0.0; 3]; points.len()]);
        field.density_and_color(&points, &directions, &z, &mut density, &mut rgb);
        let mut largest = [0.0_f32; 2];
        for i in 0..points.len() {
            largest[0] = largest[0].max((density[i].ln() - want_density[i].ln()).abs());
            for c in 0..3 {
                largest[1] = largest[1].max((rgb[i][c] - want_rgb[3 * i + c]).abs());
            }
        }
        assert!(largest[0] < 0.1 && largest[1] < 0.03, "{}: {largest:?}", set.name());
        assert!(largest[0] > 1e-4, "{}: bf16 makes a difference: {largest:?}", set.name());
    }
}

/// Rays from a circle around the bounds towards points inside.
fn rays(count: usize, seed: u64) -> Vec<Ray> {
    (0..count)
        .map(|i| {
            let [a, h, x, y, z] = normals::<5>(seed, i);
            let origin = [-5.0 + 25.0 * a.cos(), -6.0 + 25.0 * a.sin(), 4.0 + h.abs()];
            let target = [-5.0 + 5.0 * x, -6.0 + 5.0 * y, 1.0 + z];
            Ray { origin, direction: unit([0, 1, 2].map(|k| target[k] - origin[k])), spread: 0.01 }
        })
        .collect()
}

/// Images agree pixel by pixel, including volume rendering, background, occupancy and early ends, with pixels of no
/// width and of some width.
#[test]
fn images_agree() {
    for point_width_m in [0.0, 0.1] {
        images_agree_with(&FieldConfig { point_width_m, ..config() });
    }
}

fn images_agree_with(config: &FieldConfig) {
    let tensors: Vec<_> = rough_field(config.clone(), 6)
        .tensors()
        .into_iter()
        .map(|t| {
            let mut data = t.data.into_owned();
            if t.name == "occupancy.bytes" {
                for (i, v) in data.iter_mut().enumerate() {
                    *v = ((i * 37) % 256) as f32;
                }
            }
            (t.name.into_owned(), t.shape, data)
        })
        .collect();
    let field = Field::from_tensors(config.clone(), tensors).unwrap();
    let reference = ReferenceField::new(&field, Precision::F32);
    let (rays, z) = (rays(300, 4), latent(5));
    let options = RenderOptions::default();
    let mut buffer = RenderBuffer::new();
    field.render_rays(&rays, &z, &options, &mut buffer);
    let mut samples = RaySamples::default();
    let limits = RayLimits {
        max_samples: options.max_samples_per_ray,
        min_transmittance: options.min_transmittance,
        step_scale: 1.0,
        use_occupancy: true,
    };
    field.samples_along(&rays, &z, &limits, &mut samples);
    for (ray, transmittance) in samples.transmittance.iter().enumerate() {
        assert!((1.0 - transmittance - buffer.opacity[ray]).abs() < 1e-6);
        let sum: f32 = samples.ray.iter().zip(&samples.weight).filter(|(r, _)| **r as usize == ray).map(|p| p.1).sum();
        assert!((sum - buffer.opacity[ray]).abs() < 1e-4);
    }
    assert!(buffer.opacity.iter().any(|o| *o > 0.5) && buffer.opacity.iter().any(|o| *o < 0.999));
    let rays = Rays::new(&rays, config.direction_degree);
    let min_weight = f64::from(options.min_weight);
    for chunk in [100, 1 << 20] {
        let image =
            values(&reference.render(&rays, &Samples::new(&samples), &Tensor::from_slice(&z), min_weight, chunk));
        let largest = image.iter().zip(&buffer.rgb).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(largest < 1e-4, "{largest}");
    }
}

fn small_config() -> FieldConfig {
    FieldConfig {
        levels: 4,
        log2_table_size: 10,
        base_resolution: 4,
        max_resolution: 32,
        hidden_width: 16,
        geometry_features: 7,
        background_width: 8,
        samples_across: 32.0,
        // Thin fog: the background has a gradient too.
        density_offset: -5.0,
        far_m: 60.0,
        ..config()
    }
}

fn trainer_config() -> TrainerConfig {
    TrainerConfig {
        threads: 2,
        jitter: false,
        roulette_weight: 0.0,
        min_transmittance: 0.0,
        huber_delta: 0.3,
        samples_per_step: usize::MAX,
        occupancy_warmup_steps: 10,
        most_step_scale: 1.0,
        latent_gradient: true,
        ..TrainerConfig::default()
    }
}

fn batch(count: usize, seed: u64) -> RayBatch {
    RayBatch {
        rays: rays(count, seed),
        target_rgb: (0..count).map(|i| normals::<3>(seed + 9, i).map(|v| (0.5 + 0.3 * v).clamp(0.0, 1.0))).collect(),
        latent_index: (0..count).map(|i| (i * 7 % 3) as u32).collect(),
        latents: (0..3).map(|l| latent(50 + l)).collect(),
    }
}

/// Computes the mean loss of a batch by tensor operations, at the native trainer's samples.
fn reference_loss(reference: &ReferenceField, trainer: &FieldTrainer, batch: &RayBatch, latents: &Tensor) -> Tensor {
    let mut samples = RaySamples::default();
    trainer.field().samples_along(&batch.rays, &batch.latents[0], &trainer.limits(), &mut samples);
    let rays = Rays::new(&batch.rays, reference.config().direction_degree);
    let index: Vec<i64> = batch.latent_index.iter().map(|&i| i64::from(i)).collect();
    let of_rays = latents.index_select(0, &Tensor::from_slice(&index));
    let pixels = reference.pixels(&rays, &Samples::new(&samples), &of_rays);
    huber_sum(&pixels, &rows(&batch.target_rgb), 0.3) / (3.0 * batch.rays.len() as f64)
}

/// The native step's loss and its gradients by every tensor and by the latents are those of automatic
/// differentiation: to 1e-5 and to 1e-3 of each tensor's largest gradient, with pixels of no width and of some.
#[test]
fn gradients_agree_with_automatic_differentiation() {
    for point_width_m in [0.0, 0.1] {
        gradients_agree(FieldConfig { point_width_m, ..small_config() });
    }
}

fn gradients_agree(config: FieldConfig) {
    let field = rough_field(config, 8);
    let batch = batch(60, 12);
    let mut trainer = FieldTrainer::new(field.clone(), trainer_config()).unwrap();
    let reference = ReferenceField::new(&field, Precision::F32);
    let latents = rows(&batch.latents).set_requires_grad(true);
    let loss = reference_loss(&reference, &trainer, &batch, &latents);
    loss.backward();
    let (report, gradients) = trainer.gradients(&batch);
    assert!((report.loss - loss.double_value(&[])).abs() < 1e-5 * report.loss, "{} {loss}", report.loss);

    let variables = reference.store().variables();
    assert_eq!(variables.len(), gradients.len());
    let near = |name: &str, found: &[f32], want: &Tensor| {
        let want = values(want);
        assert_eq!(found.len(), want.len(), "{name}");
        let largest = want.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
        assert!(largest > 1e-7, "{name} has no gradient");
        let error = found.iter().zip(&want).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
        assert!(error < 1e-3 * largest, "{name}: {error} of {largest}");
    };
    for gradient in &gradients {
        near(&gradient.name, &gradient.data, &variables[&*gradient.name].grad());
    }
    near("latents", report.latent_gradient.as_flattened(), &latents.grad());

    // A second call gives the same: nothing was left in the trainer's sums, and no step was taken.
    let again = trainer.gradients(&batch);
    assert_eq!(again.1, gradients);
    assert_eq!(trainer.step_count(), 0);
}

/// Automatic differentiation itself agrees with central differences along each tensor's gradient, to 2 %.
#[test]
fn automatic_differentiation_agrees_with_finite_differences() {
    let field = rough_field(small_config(), 9);
    let batch = batch(40, 13);
    let trainer = FieldTrainer::new(field.clone(), trainer_config()).unwrap();
    let reference = ReferenceField::new(&field, Precision::F32);
    let latents = rows(&batch.latents);
    reference_loss(&reference, &trainer, &batch, &latents).backward();
    for (name, mut variable) in reference.store().variables() {
        let gradient = variable.grad().copy();
        let squares = gradient.square().sum(tch::Kind::Double).double_value(&[]);
        let step = 1e-2 / squares.sqrt();
        let mut at = |by: f64| {
            tch::no_grad(|| {
                let _ = variable.g_add_(&(&gradient * by));
                let loss = reference_loss(&reference, &trainer, &batch, &latents).double_value(&[]);
                let _ = variable.g_sub_(&(&gradient * by));
                loss
            })
        };
        let slope = (at(step) - at(-step)) / (2.0 * step);
        assert!((slope - squares).abs() < 0.02 * squares, "{name}: slope {slope}, squared gradient {squares}");
    }
}
