//! Contracts of the trainer.

use carff_base::geometry::Ray;

use crate::kernels::math::{hash, sigmoid, unit};
use crate::model::network::Dense;
use crate::space::marcher::Marcher;
use crate::{
    Field, FieldConfig, FieldTrainer, InstructionSet, LATENT_DIM, NamedTensor, RayBatch, RenderBuffer, RenderOptions,
    TrainerConfig,
};

fn small_config() -> FieldConfig {
    FieldConfig {
        bounds_m: [[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]],
        levels: 4,
        log2_table_size: 10,
        base_resolution: 4,
        max_resolution: 32,
        hidden_width: 16,
        geometry_features: 7,
        background_width: 8,
        density_offset: 0.0,
        occupancy_resolution: 16,
        samples_across: 32.0,
        near_m: 0.05,
        far_m: 12.0,
        ..FieldConfig::default()
    }
}

fn normal(seed: u64, i: u64) -> f32 {
    (0..6).map(|k| unit(hash(seed, i, k))).sum::<f32>() * 1.4 - 4.2
}

fn latent(seed: u64) -> [f32; LATENT_DIM] {
    std::array::from_fn(|k| normal(seed, k as u64))
}

/// Rays from a circle around the bounds towards points inside.
fn random_rays(count: usize, seed: u64) -> Vec<Ray> {
    (0..count as u64)
        .map(|i| {
            let a = std::f32::consts::TAU * unit(hash(seed, i, 10));
            let origin = [4.0 * a.cos(), 4.0 * a.sin(), 1.0 + 2.0 * unit(hash(seed, i, 11))];
            let target = [normal(seed, 3 * i), normal(seed, 3 * i + 1), 0.5 + 0.3 * normal(seed, 3 * i + 2)];
            let d = [0, 1, 2].map(|k| target[k] - origin[k]);
            let n = d.iter().map(|v| v * v).sum::<f32>().sqrt();
            Ray { origin, direction: d.map(|v| v / n), spread: 0.02 }
        })
        .collect()
}

fn random_batch(count: usize, latents: usize, seed: u64) -> RayBatch {
    RayBatch {
        rays: random_rays(count, seed),
        target_rgb: (0..count as u64).map(|i| [0, 1, 2].map(|c| unit(hash(seed, i, 20 + c)))).collect(),
        latent_index: (0..count).map(|i| (i * 7 % latents) as u32).collect(),
        latents: (0..latents as u64).map(|l| latent(seed + 50 + l)).collect(),
    }
}

/// Makes a field with values large enough for gradients to exceed rounding errors.
fn rough_field(seed: u64) -> Field {
    let mut field = Field::new(FieldConfig { density_offset: -2.0, ..small_config() }, seed).unwrap();
    for (i, v) in field.table.iter_mut().enumerate() {
        *v = 0.5 * normal(seed + 1, i as u64);
    }
    for (i, v) in field.networks.iter_mut().enumerate() {
        if *v == 0.0 {
            *v = 0.1 * normal(seed + 2, i as u64);
        }
    }
    field
}

fn exact_config() -> TrainerConfig {
    TrainerConfig {
        threads: 1,
        jitter: false,
        roulette_weight: 0.0,
        min_transmittance: 0.0,
        huber_delta: 0.3,
        opacity_entropy: 0.05,
        distortion: 0.2,
        samples_per_step: usize::MAX,
        latent_gradient: true,
        occupancy_warmup_steps: 10,
        most_step_scale: 1.0,
        ..TrainerConfig::default()
    }
}

fn loss_of(field: &Field, batch: &RayBatch) -> f64 {
    FieldTrainer::new(field.clone(), exact_config()).unwrap().accumulate(batch).loss
}

/// Central differences of the loss along each parameter group's gradient agree with the gradient: for tables, every
/// layer's weights, latent columns and biases, and the latents; with points of no width and of some width.
#[test]
fn gradients_agree_with_finite_differences() {
    for point_width_m in [0.0, 0.1] {
        gradients_agree(point_width_m);
    }
}

fn gradients_agree(point_width_m: f32) {
    let mut field = rough_field(3);
    field.config.point_width_m = point_width_m;
    let batch = random_batch(40, 3, 9);
    let mut trainer = FieldTrainer::new(field.clone(), exact_config()).unwrap();
    let report = trainer.accumulate(&batch);
    let mut table = vec![0.0_f32; field.table.len()];
    let mut networks = vec![0.0_f32; field.networks.len()];
    for shard in &trainer.shards {
        for (a, b) in table.iter_mut().zip(&shard.table_gradient) {
            *a += b;
        }
        for (a, b) in networks.iter_mut().zip(&shard.network_gradient) {
            *a += b;
        }
    }
    let check = |name: &str, norm2: f64, at: &dyn Fn(f64) -> f64| {
        assert!(norm2 > 1e-12, "{name}: no gradient");
        let step = 1e-2 / norm2.sqrt();
        let slope = (at(step) - at(-step)) / (2.0 * step);
        assert!((slope - norm2).abs() < 0.02 * norm2, "{name}: slope {slope}, squared gradient {norm2}");
    };
    let squared = |g: &[f32]| g.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>();

    for level in &field.layout.grid.levels {
        let f = field.config.features_per_level;
        let range = level.first * f..(level.first + level.entries) * f;
        check(&format!("level {}", level.resolution), squared(&table[range.clone()]), &|step| {
            let mut moved = field.clone();
            for i in range.clone() {
                moved.table[i] += (step * f64::from(table[i])) as f32;
            }
            loss_of(&moved, &batch)
        });
    }
    let group = |name: String, range: std::ops::Range<usize>| {
        check(&name, squared(&networks[range.clone()]), &|step| {
            let mut moved = field.clone();
            for i in range.clone() {
                moved.networks[i] += (step * f64::from(networks[i])) as f32;
            }
            loss_of(&moved, &batch)
        });
    };
    for (name, layer) in field.layout.named_layers() {
        let Dense { inputs, latents, outputs, weight, bias, .. } = layer;
        group(format!("{name} weight"), weight..weight + inputs * outputs);
        if latents > 0 {
            group(format!("{name} latent columns"), weight + inputs * outputs..bias);
        }
        group(format!("{name} bias"), bias..bias + outputs);
    }
    for (l, g) in report.latent_gradient.iter().enumerate() {
        check(&format!("latent {l}"), squared(g), &|step| {
            let mut moved = batch.clone();
            for (z, g) in moved.latents[l].iter_mut().zip(g) {
                *z += (step * f64::from(*g)) as f32;
            }
            loss_of(&field, &moved)
        });
    }
}

/// A slab of constant density has opacity 1 - exp(-density x thickness), and its colour is over the background's.
#[test]
fn constant_density_renders_as_beer_and_lambert_say() {
    let mut field = Field::new(small_config(), 5).unwrap();
    field.networks.fill(0.0);
    let density = 0.4_f32;
    let raw = field.layout.density.layers[2].bias;
    field.networks[raw] = density.ln();
    // Colour logits 2, -1, 0; the background's are 0.
    let color = field.layout.color.layers[2].bias;
    field.networks[color] = 2.0;
    field.networks[color + 1] = -1.0;
    // Matter only in two layers of cells: z in [8, 10) of 16, which is a slab of known thickness.
    let n = 16;
    field.occupancy.set_from(|i| (8..10).contains(&(i / (n * n))));
    let c = *field.contraction();
    let (top, bottom) = (c.uncontract([0.5, 0.5, 10.0 / 16.0])[2], c.uncontract([0.5, 0.5, 0.5])[2]);
    let ray = Ray { origin: [0.3, -0.2, 5.0], direction: [0.0, 0.0, -1.0], spread: 0.0 };
    let mut fine = field.clone();
    fine.marcher.step_m = 1e-3;
    let mut out = RenderBuffer::new();
    let options = RenderOptions {
        max_samples_per_ray: 100_000,
        min_transmittance: 0.0,
        min_weight: 0.0,
        ..RenderOptions::default()
    };
    let mut config = fine.config.clone();
    config.samples_across = 4000.0;
    config.cone_angle = 0.0;
    fine.marcher = Marcher::new(&config, *field.contraction());
    fine.render_rays(&[ray], &[0.0; LATENT_DIM], &options, &mut out);
    let opacity = 1.0 - (-density * (top - bottom)).exp();
    assert!((out.opacity[0] - opacity).abs() < 2e-3, "{} {opacity}", out.opacity[0]);
    for (ch, logit) in [2.0_f32, -1.0, 0.0].iter().enumerate() {
        let want = opacity * sigmoid(*logit) + (1.0 - opacity) * 0.5;
        assert!((out.rgb[ch] - want).abs() < 2e-3);
    }
    assert!(out.depth_m[0] > 5.0 - top && out.depth_m[0] < 5.0 - bottom);
}

/// Training gives the same bits in two runs, with one thread or two, and after being saved and resumed half-way.
#[test]
fn training_is_reproducible() {
    let config = |threads| TrainerConfig {
        threads,
        occupancy_warmup_steps: 3,
        occupancy_interval: 2,
        occupancy_cells: 512,
        ..TrainerConfig::default()
    };
    let states = vec![vec![latent(1)], vec![latent(2)]];
    let steps = |trainer: &mut FieldTrainer, range: std::ops::Range<u64>| {
        trainer.set_state_latents(&states);
        for i in range {
            trainer.step(&random_batch(100, 4, i));
        }
    };
    let start = || Field::new(small_config(), 1).unwrap();
    let mut one = FieldTrainer::new(start(), config(1)).unwrap();
    steps(&mut one, 0..12);
    let mut two = FieldTrainer::new(start(), config(2)).unwrap();
    steps(&mut two, 0..12);
    assert_eq!(one.field.table, two.field.table);
    assert_eq!(one.field.networks, two.field.networks);
    assert_eq!(one.field.occupancy, two.field.occupancy);

    let owned = |tensors: Vec<NamedTensor>| -> Vec<_> {
        tensors.into_iter().map(|t| (t.name.into_owned(), t.shape, t.data.into_owned())).collect()
    };
    let mut half = FieldTrainer::new(start(), config(2)).unwrap();
    steps(&mut half, 0..6);
    let field = Field::from_tensors(small_config(), owned(half.field().tensors())).unwrap();
    let state = half.state();
    let mut resumed = FieldTrainer::from_state(field, config(1), state.step, owned(state.tensors)).unwrap();
    steps(&mut resumed, 6..12);
    assert_eq!(one.field.table, resumed.field.table);
    assert_eq!(one.field.networks, resumed.field.networks);
    assert_eq!(one.field.occupancy, resumed.field.occupancy);
}

/// The error on a state of another configuration lists every key that differs.
#[test]
fn foreign_state_is_refused() {
    let trainer = FieldTrainer::new(Field::new(small_config(), 1).unwrap(), exact_config()).unwrap();
    let tensors: Vec<_> = trainer
        .state()
        .tensors
        .into_iter()
        .filter(|t| t.name != "occupancy.density")
        .map(|t| (t.name.into_owned(), t.shape, t.data.into_owned()))
        .chain([("strange".to_owned(), vec![1], vec![0.0])])
        .collect();
    let other = Field::new(FieldConfig { hidden_width: 32, ..small_config() }, 1).unwrap();
    let error = FieldTrainer::from_state(other, exact_config(), 0, tensors).unwrap_err().to_string();
    for part in ["`first.density.0.weight` has shape", "`strange` is not known", "`occupancy.density` is missing"] {
        assert!(error.contains(part), "{error}");
    }
}

/// A ball that only exists in one of four states is learned: it is visible in that state and in no other, and its cell
/// is occupied.
#[test]
fn occupancy_keeps_what_exists_in_any_state() {
    let states: Vec<[f32; LATENT_DIM]> = (0..4).map(|s| latent(70 + s)).collect();
    let radius = 0.6_f32;
    let center = [0.5_f32, 0.0, 1.0];
    let hits = |ray: &Ray| {
        let o = [0, 1, 2].map(|k| ray.origin[k] - center[k]);
        let b: f32 = (0..3).map(|k| o[k] * ray.direction[k]).sum();
        let c: f32 = o.iter().map(|v| v * v).sum::<f32>() - radius * radius;
        b * b > c && b < 0.0
    };
    let mut trainer = FieldTrainer::new(
        Field::new(FieldConfig { density_offset: -1.0, ..small_config() }, 2).unwrap(),
        TrainerConfig {
            threads: 1,
            occupancy_warmup_steps: 100,
            occupancy_interval: 4,
            occupancy_cells: 2048,
            learning_rate_networks: 1e-2,
            most_step_scale: 1.0,
            ..TrainerConfig::default()
        },
    )
    .unwrap();
    trainer.set_state_latents(&states.iter().map(|z| vec![*z]).collect::<Vec<_>>());
    for step in 0..400 {
        let mut batch = random_batch(128, 4, 1000 + step);
        batch.latents = states.clone();
        for (i, ray) in batch.rays.iter().enumerate() {
            let red = batch.latent_index[i] == 2 && hits(ray);
            batch.target_rgb[i] = if red { [0.9, 0.1, 0.1] } else { [0.2, 0.5, 0.8] };
        }
        trainer.step(&batch);
    }
    let field = trainer.field();
    let opacity = |state: usize| {
        let rays: Vec<Ray> = random_rays(400, 5).into_iter().filter(hits).collect();
        let mut out = RenderBuffer::new();
        field.render_rays(&rays, &states[state], &RenderOptions::default(), &mut out);
        let red = out.rgb.chunks_exact(3).filter(|p| p[0] > p[2]).count();
        red as f32 / rays.len() as f32
    };
    assert!(opacity(2) > 0.8, "the ball is visible in its state: {}", opacity(2));
    for state in [0, 1, 3] {
        assert!(opacity(state) < 0.1, "and in no other: {}", opacity(state));
    }
    let center = field.contraction().contract(center);
    assert!(field.occupancy().contains(center));
    // When training ends, the ball's cell is marked as changing.
    let field = trainer.into_field();
    assert!(field.occupancy().contains(center) && field.changing().contains(center));
}

/// Matter of only one of four states keeps its cells occupied; without that state the same refresh empties them. When
/// training ends, cells are marked as changing where not all states have matter. (Weights are set by hand: density only
/// depends on the latent.)
#[test]
fn occupancy_is_the_maximum_over_states() {
    let mut field = Field::new(small_config(), 2).unwrap();
    field.networks.fill(0.0);
    let [d0, d1, d2] = field.layout.density.layers;
    // raw density = 12 relu(z0 - 1) - 6.
    field.networks[d0.weight + d0.inputs * d0.outputs] = 1.0;
    field.networks[d0.bias] = -1.0;
    field.networks[d1.weight] = 1.0;
    field.networks[d2.weight] = 12.0;
    field.networks[d2.bias] = -6.0;
    let state = |z0: f32| {
        let mut z = [0.3; LATENT_DIM];
        z[0] = z0;
        vec![z]
    };
    let share = |states: &[Vec<[f32; LATENT_DIM]>]| {
        let config = TrainerConfig { threads: 1, occupancy_warmup_steps: 0, ..TrainerConfig::default() };
        let mut trainer = FieldTrainer::new(field.clone(), config).unwrap();
        trainer.set_state_latents(states);
        trainer.step(&RayBatch::default());
        let before = trainer.field().occupancy().occupied_share();
        let field = trainer.into_field();
        assert_eq!(field.occupancy().occupied_share(), before);
        [before, field.changing().occupied_share()]
    };
    assert_eq!(share(&[state(0.0), state(0.5), state(2.0), state(-1.0)]), [1.0, 1.0]);
    assert_eq!(share(&[state(2.0), state(2.0)]), [1.0, 0.0]);
    assert_eq!(share(&[state(0.0), state(0.5), state(-1.0)]), [0.0, 0.0]);
}

/// The portable and the dispatched kernels give the same gradients and losses up to rounding.
#[test]
fn portable_and_dispatched_paths_agree() {
    let field = rough_field(11);
    let batch = random_batch(50, 2, 4);
    let gradients = |set: InstructionSet| {
        let mut field = field.clone();
        field.set_instruction_set(set);
        let mut trainer = FieldTrainer::new(field, exact_config()).unwrap();
        let loss = trainer.accumulate(&batch).loss;
        let networks: Vec<f32> = (0..trainer.field.networks.len())
            .map(|i| trainer.shards.iter().map(|s| s.network_gradient[i]).sum())
            .collect();
        trainer.update();
        (loss, networks, trainer.field.networks.clone())
    };
    let (a, b) = (gradients(InstructionSet::portable()), gradients(InstructionSet::detect()));
    assert!((a.0 - b.0).abs() < 1e-5 * a.0);
    let largest = a.1.iter().fold(0.0_f32, |m, v| m.max(v.abs()));
    for (x, y) in a.1.iter().zip(&b.1) {
        assert!((x - y).abs() < 1e-4 * largest, "{x} {y}");
    }
}

/// Batches with lists of unequal length, numbers that are not finite, unknown latents or no rays do no harm.
#[test]
fn bad_batches_are_left_out() {
    let mut trainer = FieldTrainer::new(Field::new(small_config(), 1).unwrap(), exact_config()).unwrap();
    assert_eq!(trainer.step(&RayBatch::default()).rays, 0);
    let mut batch = random_batch(10, 2, 1);
    batch.rays[0].origin[1] = f32::NAN;
    batch.target_rgb[1][2] = f32::INFINITY;
    batch.latent_index[2] = 9;
    batch.target_rgb.pop();
    let report = trainer.step(&batch);
    assert_eq!(report.rays, 6);
    assert!(report.loss.is_finite());
    assert!(trainer.field().table.iter().chain(&trainer.field().networks).all(|v| v.is_finite()));
}
