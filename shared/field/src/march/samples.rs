//! Samples of a chunk of rays: their positions, densities, weights and transmittances.

use std::ops::Range;

use carff_base::geometry::Ray;

use crate::kernels::block::{BlockBuffer, BlocksMut, LANES};
use crate::kernels::dispatch;
use crate::kernels::traverse::{PACKET, RayPacket, SamplePoints, Traversal};
use crate::model::field::{Field, Folded};
use crate::model::network::{Hidden, Input};

/// Samples of all rays together that are evaluated before transmittances are updated: enough to fill blocks.
const WAVE: usize = 256;
/// The fewest and the most samples of one ray in a wave: samples after the point where it turns opaque are wasted.
const WAVE_OF_RAY: std::ops::RangeInclusive<usize> = 4..=16;
/// Marks a lane that fills up a block.
pub(crate) const NO_RAY: u32 = u32::MAX;

/// The end of rays, and their step size.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct RayLimits {
    /// A ray ends after this number of samples, at least 1.
    pub max_samples: usize,
    /// A ray ends when its transmittance falls below this.
    pub min_transmittance: f32,
    /// Multiplies the steps, above zero.
    pub step_scale: f32,
    /// Skip cells without matter in any state.
    pub use_occupancy: bool,
}

/// The rays to march, and the latents to march them under (at least one).
#[derive(Clone, Copy)]
pub(crate) struct March<'a> {
    pub field: &'a Field,
    pub latents: &'a [Folded],
    pub rays: &'a [Ray],
    pub limits: RayLimits,
}

/// State of one ray under one latent.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayState {
    pub transmittance: f32,
    /// True while the transmittance is high enough for further samples to count.
    active: bool,
}

/// Densities and weights of the samples under one latent. All lists but the last two have one entry for each sample.
#[derive(Debug, Default)]
pub(crate) struct LatentSamples {
    /// Each sample's ray; `NO_RAY` for samples after the ray's end, and for lanes that fill up a block.
    pub ray: Vec<u32>,
    /// Density, 1/metre.
    pub sigma: Vec<f32>,
    /// Share of the ray's light that comes from the sample: alpha times the transmittance in front of it.
    pub weight: Vec<f32>,
    /// Transmittance of the ray from its origin to the sample's far end.
    pub transmittance: Vec<f32>,
    /// Outputs of the density network.
    pub geometry: BlockBuffer,
    pub rays: Vec<RayState>,
    /// 1 - alpha of each sample of the last wave.
    one_minus_alpha: Vec<f32>,
}

/// Samples of a chunk of rays, in waves; each wave fills whole blocks.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    pub points: SamplePoints,
    /// Widths of the samples, in sides of the unit cube; empty where features do not depend on them.
    pub widths: Vec<f32>,
    /// One entry for each latent.
    pub by_latent: Vec<LatentSamples>,
    /// Features of the samples.
    pub features: BlockBuffer,
    packets: Vec<RayPacket>,
    /// Samples that each ray may still take; 0 for a ray that has ended.
    remaining: Vec<u32>,
}

/// Buffers of the density network over one wave.
#[derive(Debug, Default)]
pub(crate) struct MarchScratch {
    hidden: Hidden,
    projected: BlockBuffer,
}

impl LatentSamples {
    fn begin(&mut self, rays: usize) {
        self.ray.clear();
        self.sigma.clear();
        self.weight.clear();
        self.transmittance.clear();
        self.rays.clear();
        self.rays.resize(rays, RayState { transmittance: 1.0, active: true });
    }

    /// Makes room for the samples of the wave from `start` to `end`.
    fn begin_wave(&mut self, start: usize, end: usize, geometry_rows: usize) {
        self.geometry.blocks_mut(geometry_rows, end / LANES);
        self.sigma.resize(end, 0.0);
        self.one_minus_alpha.resize(end - start, 0.0);
    }

    /// Composites the samples from `start` on: computes their weights and transmittances, front to back.
    fn composite(&mut self, points: &SamplePoints, start: usize, min_transmittance: f32) {
        let end = points.len();
        self.ray.extend_from_slice(&points.ray[start..]);
        self.weight.resize(end, 0.0);
        self.transmittance.resize(end, 0.0);
        for i in start..end {
            let Some(state) = self.rays.get_mut(points.ray[i] as usize) else { continue };
            if !state.active {
                // The ray ended earlier in this wave: its samples do not depend on the length of waves.
                self.ray[i] = NO_RAY;
                self.transmittance[i] = state.transmittance;
                continue;
            }
            let one_minus_alpha = self.one_minus_alpha[i - start];
            self.weight[i] = state.transmittance * (1.0 - one_minus_alpha);
            state.transmittance *= one_minus_alpha;
            state.active = state.transmittance >= min_transmittance;
            self.transmittance[i] = state.transmittance;
        }
    }

    /// Returns true if any ray of a block is active.
    fn is_active(&self, points: &SamplePoints, block: usize) -> bool {
        let rays = &points.ray[block * LANES..][..LANES];
        rays.iter().any(|r| self.rays.get(*r as usize).is_some_and(|r| r.active))
    }

    /// Copies one block's outputs from another latent.
    fn copy_block(&mut self, from: &Self, block: usize, wave_start: usize, geometry_rows: usize) {
        let one = block..block + 1;
        let geometry = from.geometry.blocks(geometry_rows, block + 1).range(one.clone());
        let to = self.geometry.blocks_mut(geometry_rows, block + 1).range(one);
        to.into_mut_slice().copy_from_slice(geometry.as_slice());
        let samples = block * LANES..(block + 1) * LANES;
        self.sigma[samples.clone()].copy_from_slice(&from.sigma[samples.clone()]);
        let samples = samples.start - wave_start..samples.end - wave_start;
        self.one_minus_alpha[samples.clone()].copy_from_slice(&from.one_minus_alpha[samples]);
    }
}

impl Samples {
    /// Marches all rays until each is opaque or at its end, under each latent. Positions and features of samples are
    /// the same for all latents. In blocks where the states do not differ, all latents use the first latent's
    /// densities. `jitter(ray)` gives the start in steps, 0..1.
    pub fn march(&mut self, march: &March<'_>, scratch: &mut MarchScratch, jitter: impl Fn(usize) -> f32) {
        self.begin(march, jitter);
        while let Some(wave) = self.place_wave(march) {
            self.evaluate_wave(march, scratch, wave.clone());
            for of_latent in &mut self.by_latent {
                of_latent.composite(&self.points, wave.start, march.limits.min_transmittance);
            }
            for (i, remaining) in self.remaining.iter_mut().enumerate() {
                if !self.by_latent.iter().any(|s| s.rays[i].active) {
                    *remaining = 0;
                }
            }
        }
    }

    fn begin(&mut self, march: &March<'_>, jitter: impl Fn(usize) -> f32) {
        let March { field, latents, rays, limits } = march;
        let m = &field.marcher;
        self.points.resize(0, NO_RAY);
        self.widths.clear();
        self.by_latent.resize_with(latents.len(), LatentSamples::default);
        for of_latent in &mut self.by_latent {
            of_latent.begin(rays.len());
        }
        self.packets.clear();
        self.packets.extend(rays.chunks(PACKET).enumerate().map(|(p, rays)| {
            let first = p * PACKET;
            let start_m = |lane: usize| m.near_m + jitter(first + lane) * m.step_m * limits.step_scale;
            RayPacket::new(rays, first, &field.contraction, start_m)
        }));
        self.remaining.clear();
        self.remaining.resize(rays.len(), u32::try_from(limits.max_samples).unwrap_or(u32::MAX));
    }

    /// Appends the next samples of all active rays and fills up the last block; returns the range of these samples, or
    /// none when all rays have ended.
    fn place_wave(&mut self, march: &March<'_>) -> Option<Range<usize>> {
        let March { field, limits, .. } = march;
        let traversal = Traversal {
            marcher: &field.marcher,
            occupancy: limits.use_occupancy.then_some(&field.occupancy),
            changing: &field.changing,
            step_scale: limits.step_scale,
        };
        let active = self.remaining.iter().filter(|n| **n > 0).count();
        if active == 0 {
            return None;
        }
        let points = &mut self.points;
        let start = points.len();
        let wave = (WAVE / active).clamp(*WAVE_OF_RAY.start(), *WAVE_OF_RAY.end()) as u32;
        let mut end = start;
        points.resize(start + active * wave as usize, NO_RAY);
        for (p, (packet, remaining)) in self.packets.iter_mut().zip(self.remaining.chunks_mut(PACKET)).enumerate() {
            let mut want = [0; PACKET];
            for (want, remaining) in want.iter_mut().zip(remaining.iter()) {
                *want = wave.min(*remaining);
            }
            if want == [0; PACKET] {
                continue;
            }
            let next = dispatch::traverse(field.set, &traversal, packet, want, points, end);
            for ray in &points.ray[end..next] {
                remaining[*ray as usize - p * PACKET] -= 1;
            }
            for (lane, remaining) in remaining.iter_mut().enumerate() {
                *remaining = if packet.is_before(lane, field.marcher.far_m) { *remaining } else { 0 };
            }
            end = next;
        }
        points.resize(end.next_multiple_of(LANES), NO_RAY);
        (end > start).then_some(start..points.len())
    }

    /// Computes features and densities of one wave.
    fn evaluate_wave(&mut self, march: &March<'_>, scratch: &mut MarchScratch, wave: Range<usize>) {
        let Self { points, widths, by_latent, features, .. } = self;
        let March { field, latents, rays, .. } = march;
        let l = &field.layout;
        let blocks = wave.start / LANES..wave.end / LANES;
        let mut x = features.blocks_mut(l.features, blocks.end).range(blocks.clone());
        let widths = field.has_point_width().then(|| {
            let spread = |ray: u32| rays.get(ray as usize).map_or(0.0, |ray| ray.spread);
            let samples = points.ray[wave.start..].iter().zip(&points.distance_m[wave.start..]);
            widths.extend(samples.map(|(ray, distance)| field.width_in_cube(spread(*ray) * distance)));
            &widths[wave.start..]
        });
        field.encode(&points.points[wave.start..], widths, x.reborrow());
        let MarchScratch { hidden, projected } = scratch;
        let input = if latents.len() > 1 {
            let mut y = projected.blocks_mut(field.config.hidden_width, blocks.len());
            l.density.project(field.weights(), x.into_blocks(), y.reborrow());
            Input::Projected(y.into_blocks())
        } else {
            Input::Features(x.into_blocks())
        };
        let wave = Wave { field, points, blocks, input };
        for k in 0..latents.len() {
            let (first, rest) = by_latent.split_at_mut(k.min(1));
            wave.evaluate(&latents[k], first.first(), &mut rest[k.saturating_sub(1)], hidden);
        }
    }
}

/// One wave's samples, and the density network's input for their blocks.
struct Wave<'a> {
    field: &'a Field,
    points: &'a SamplePoints,
    blocks: Range<usize>,
    input: Input<'a>,
}

impl Wave<'_> {
    /// Computes densities under one latent, where rays are active. Blocks in which the states do not differ are copied
    /// from the `first` latent.
    fn evaluate(&self, folded: &Folded, first: Option<&LatentSamples>, out: &mut LatentSamples, hidden: &mut Hidden) {
        let Range { start, end } = self.blocks;
        let rows = self.field.layout.geometry;
        out.begin_wave(start * LANES, end * LANES, rows);
        let shared = |block: usize| {
            let differs = || self.points.changing[block * LANES..][..LANES].contains(&true);
            first.filter(|first| first.is_active(self.points, block) && !differs())
        };
        let mut at = start;
        while at < end {
            if !out.is_active(self.points, at) {
                at += 1;
            } else if let Some(first) = shared(at) {
                out.copy_block(first, at, start * LANES, rows);
                at += 1;
            } else {
                let mut next = at + 1;
                while next < end && out.is_active(self.points, next) && shared(next).is_none() {
                    next += 1;
                }
                self.evaluate_blocks(folded, at..next, out, hidden);
                at = next;
            }
        }
    }

    fn evaluate_blocks(&self, folded: &Folded, blocks: Range<usize>, out: &mut LatentSamples, hidden: &mut Hidden) {
        let (field, first) = (self.field, self.blocks.start);
        let input = self.input.range(blocks.start - first..blocks.end - first);
        let mut geometry: BlocksMut<'_> =
            out.geometry.blocks_mut(field.layout.geometry, blocks.end).range(blocks.clone());
        field.layout.density.forward(field.weights(), &folded.density, input, hidden, geometry.reborrow());
        let samples = blocks.start * LANES..blocks.end * LANES;
        dispatch::sigma_and_alpha(
            field.set,
            geometry.into_blocks(),
            field.config.density_offset,
            &self.points.delta_m[samples.clone()],
            &mut out.sigma[samples.clone()],
            &mut out.one_minus_alpha[samples.start - first * LANES..samples.end - first * LANES],
        );
    }
}
