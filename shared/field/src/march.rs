//! Rays through the occupancy grid: where the samples of a chunk of rays lie, what they weigh, and which of them count.

use carff_geometry::Ray;

use crate::config::{FieldConfig, LATENT_DIM};
use crate::dispatch;
use crate::field::{Field, Folded, Scratch, grow};
use crate::kernels::{LANES, stride};
use crate::space::{Contraction, OccupancyGrid};

/// Samples of all rays together that are evaluated before transmittances are looked at again: enough to fill blocks.
const WAVE: usize = 256;
/// The fewest and the most of one ray: what comes after it has turned opaque is for nothing.
const WAVE_OF_RAY: std::ops::RangeInclusive<usize> = 4..=16;
/// Rays that are worked on together where their samples are listed.
const CHUNK: usize = 64;
/// Marks a lane that fills up a block.
pub(crate) const NO_RAY: u32 = u32::MAX;

/// Step sizes and limits of rays.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Marcher {
    contraction: Contraction,
    pub step_m: f32,
    cone: f32,
    near: f32,
    far: f32,
    /// Half the longest extent of the bounds, metres.
    half_m: f32,
}

/// What ends a ray, and how finely it is sampled.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayLimits {
    /// A ray ends after so many samples, at least 1.
    pub max_samples: usize,
    /// A ray ends when less than this share of light passes.
    pub min_transmittance: f32,
    /// Multiplies the steps, above zero.
    pub step_scale: f32,
    /// Leave out cells in which there is no matter in any state.
    pub use_occupancy: bool,
}

/// Samples along rays, sorted by ray and along each ray. All lists but the last have one entry for each sample.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RaySamples {
    /// The sample's ray.
    pub ray: Vec<u32>,
    /// Its distance from the ray's origin, metres.
    pub distance_m: Vec<f32>,
    /// The length of ray that it stands for, metres.
    pub length_m: Vec<f32>,
    /// Share of the ray's light that comes from it, 0..=1.
    pub weight: Vec<f32>,
    /// For each ray, the share of light that passes all of its samples, 0..=1.
    pub transmittance: Vec<f32>,
}

impl Marcher {
    pub fn new(config: &FieldConfig, contraction: Contraction) -> Self {
        Self {
            contraction,
            step_m: 2.0 * contraction.longest_half_m() / config.samples_across,
            half_m: contraction.longest_half_m(),
            cone: config.cone_angle,
            near: config.near_m,
            far: config.far_m,
        }
    }

    /// A distance brought into 0..1, so that far and near count alike: t / (t + half the longest extent).
    pub fn bounded(&self, distance_m: f32) -> f32 {
        distance_m / (distance_m + self.half_m)
    }

    #[inline(always)]
    fn step_at(&self, t: f32, u: [f32; 3], scale: f32) -> f32 {
        let stretch = u[0].abs().max(u[1].abs()).max(u[2].abs()).max(1.0);
        self.step_m.max(self.cone * t) * stretch * scale
    }

    /// Emits up to `most` samples (cube point, distance, length) from `t` on; false when the ray is past its end.
    #[inline(always)]
    fn advance(
        &self,
        grid: &OccupancyGrid,
        ray: &Ray,
        t: &mut f32,
        most: usize,
        limits: &RayLimits,
        mut emit: impl FnMut([f32; 3], f32, f32),
    ) -> bool {
        let mut left = most;
        let inverse_half = self.contraction.inverse_half();
        let speed: [f32; 3] = std::array::from_fn(|i| ray.direction[i] * inverse_half[i]);
        let inverse_speed = speed.map(|v| 1.0 / v);
        while left > 0 {
            if *t >= self.far || t.is_nan() {
                return false;
            }
            let p = [0, 1, 2].map(|i| ray.origin[i] + *t * ray.direction[i]);
            let u = self.contraction.normalized(p);
            let dt = self.step_at(*t, u, limits.step_scale);
            let q = Contraction::contract_normalized(u);
            if limits.use_occupancy
                && let Some(cells) = grid.empty_around(q)
            {
                // To the far wall of the empty cell, in whole steps, so that the jitter of the start is kept.
                let mut distance = f32::INFINITY;
                for i in 0..3 {
                    if speed[i].abs() > 1e-9 {
                        let here = (q[i] * cells).floor();
                        let wall = if speed[i] > 0.0 { here + 1.0 } else { here };
                        distance = distance.min((Contraction::uncontract_axis(wall / cells) - u[i]) * inverse_speed[i]);
                    }
                }
                *t += (distance / dt).ceil().max(1.0) * dt;
                continue;
            }
            emit(q, *t, dt);
            *t += dt;
            left -= 1;
        }
        true
    }
}

/// State of one ray.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayState {
    t: f32,
    pub transmittance: f32,
    samples: usize,
    alive: bool,
}

/// Samples of a chunk of rays, in waves; each wave fills whole blocks.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    /// In the unit cube.
    pub points: Vec<[f32; 3]>,
    pub distance_m: Vec<f32>,
    pub length_m: Vec<f32>,
    pub ray: Vec<u32>,
    pub density: Vec<f32>,
    /// Share of the light that reaches the camera from this sample.
    pub weight: Vec<f32>,
    /// Transmittance behind it.
    pub behind: Vec<f32>,
    /// Share of light that passes it, for the samples of one wave.
    passes: Vec<f32>,
    /// Features, one block for each 16 samples.
    pub features: Vec<f32>,
    /// Outputs of the density network, blocks like `features`.
    pub geometry: Vec<f32>,
    pub rays: Vec<RayState>,
}

impl Samples {
    /// Marches all rays (one latent) until each is opaque or at its end. `jitter` gives the start in steps, 0..1.
    pub fn march(
        &mut self,
        field: &Field,
        folded: &Folded,
        rays: &[Ray],
        limits: &RayLimits,
        scratch: &mut Scratch,
        jitter: impl Fn(usize) -> f32,
    ) {
        let (sf, sg) = (stride(field.layout.features), stride(field.layout.geometry));
        let m = &field.marcher;
        self.points.clear();
        self.distance_m.clear();
        self.length_m.clear();
        self.ray.clear();
        self.density.clear();
        self.weight.clear();
        self.behind.clear();
        self.rays.clear();
        self.rays.extend(rays.iter().enumerate().map(|(i, _)| {
            let t = m.near + jitter(i) * m.step_m * limits.step_scale;
            RayState { t, transmittance: 1.0, samples: 0, alive: true }
        }));
        let mut alive = self.rays.len();
        while alive > 0 {
            let start = self.points.len();
            let wave = (WAVE / alive).clamp(*WAVE_OF_RAY.start(), *WAVE_OF_RAY.end());
            for (i, (ray, state)) in rays.iter().zip(&mut self.rays).enumerate().filter(|(_, (_, s))| s.alive) {
                let most = wave.min(limits.max_samples - state.samples);
                let before = self.points.len();
                state.alive = m.advance(&field.occupancy, ray, &mut state.t, most, limits, |q, t, dt| {
                    self.points.push(q);
                    self.distance_m.push(t);
                    self.length_m.push(dt);
                    self.ray.push(i as u32);
                });
                state.samples += self.points.len() - before;
                state.alive &= state.samples < limits.max_samples;
            }
            let count = self.points.len();
            if count == start {
                break;
            }
            let end = count.next_multiple_of(LANES);
            self.points.resize(end, [0.5; 3]);
            self.distance_m.resize(end, 0.0);
            self.length_m.resize(end, 0.0);
            self.ray.resize(end, NO_RAY);
            self.density.resize(end, 0.0);
            self.weight.resize(end, 0.0);
            self.behind.resize(end, 0.0);
            let blocks = start / LANES..end / LANES;
            grow(&mut self.features, blocks.end * sf);
            grow(&mut self.geometry, blocks.end * sg);
            let features = &mut self.features[blocks.start * sf..blocks.end * sf];
            let geometry = &mut self.geometry[blocks.start * sg..blocks.end * sg];
            field.encode(&self.points[start..end], features);
            field.density_network(folded, features, &mut scratch.hidden_a, &mut scratch.hidden_b, geometry);
            self.passes.resize(end - start, 0.0);
            dispatch::activate(
                field.set,
                geometry,
                sg,
                field.config.density_offset,
                &self.length_m[start..end],
                &mut self.density[start..end],
                &mut self.passes,
            );
            for i in start..count {
                let state = &mut self.rays[self.ray[i] as usize];
                if state.transmittance < limits.min_transmittance {
                    // The ray ended earlier in this wave: what it sees does not depend on how long waves are.
                    self.ray[i] = NO_RAY;
                    self.weight[i] = 0.0;
                    self.behind[i] = state.transmittance;
                    continue;
                }
                let passes = self.passes[i - start];
                self.weight[i] = state.transmittance * (1.0 - passes);
                state.transmittance *= passes;
                self.behind[i] = state.transmittance;
            }
            alive = 0;
            for state in &mut self.rays {
                state.alive &= state.transmittance >= limits.min_transmittance;
                alive += usize::from(state.alive);
            }
        }
    }
}

impl Field {
    /// The samples that rendering (or training without jitter) takes along rays under one latent: where they lie and
    /// what they weigh. For measurements and parity tests; rendering itself keeps no such lists.
    pub fn samples_along(&self, rays: &[Ray], latent: &[f32; LATENT_DIM], limits: &RayLimits, out: &mut RaySamples) {
        let limits = RayLimits { max_samples: limits.max_samples.max(1), ..*limits };
        let (mut samples, mut scratch, mut folded) = (Samples::default(), Scratch::default(), Folded::default());
        for list in [&mut out.distance_m, &mut out.length_m, &mut out.weight, &mut out.transmittance] {
            list.clear();
        }
        out.ray.clear();
        self.fold(latent, &mut folded);
        for (c, chunk) in rays.chunks(CHUNK).enumerate() {
            samples.march(self, &folded, chunk, &limits, &mut scratch, |_| 0.5);
            // Waves go round all rays: sorted by ray, each one's samples keep their order.
            let mut order: Vec<usize> = (0..samples.ray.len()).filter(|i| samples.ray[*i] != NO_RAY).collect();
            order.sort_by_key(|i| samples.ray[*i]);
            for i in order {
                out.ray.push((c * CHUNK) as u32 + samples.ray[i]);
                out.distance_m.push(samples.distance_m[i]);
                out.length_m.push(samples.length_m[i]);
                out.weight.push(samples.weight[i]);
            }
            out.transmittance.extend(samples.rays.iter().map(|r| r.transmittance));
        }
    }
}
