//! Rays through the occupancy grid: where the samples of a chunk of rays lie, what they weigh, and which of them count.

use carff_geometry::Ray;

use crate::config::{FieldConfig, LATENT_DIM};
use crate::dispatch;
use crate::field::{Field, FirstLayer, Folded, Scratch, grow};
use crate::kernels::{LANES, stride};
use crate::space::Contraction;
use crate::walk::{OCTET, Octet, Placed, Walk};

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
    /// Least step inside the bounds.
    pub step_m: f32,
    /// The step is at least this times the distance.
    pub cone: f32,
    pub near: f32,
    pub far: f32,
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
}

/// State of one ray under one latent.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayState {
    pub transmittance: f32,
    /// Whether enough light passes for what comes next to be seen.
    lit: bool,
}

/// What one latent makes of the samples.
#[derive(Debug, Default)]
pub(crate) struct Seen {
    /// Each sample's ray; `NO_RAY` for samples behind the ray's end, and for those that fill up a block.
    pub ray: Vec<u32>,
    pub density: Vec<f32>,
    /// Share of the light that reaches the camera from this sample.
    pub weight: Vec<f32>,
    /// Transmittance behind it.
    pub behind: Vec<f32>,
    /// Outputs of the density network, one block for each 16 samples.
    pub geometry: Vec<f32>,
    pub rays: Vec<RayState>,
    /// Share of light that passes each sample of one wave.
    passes: Vec<f32>,
}

/// Samples of a chunk of rays, in waves; each wave fills whole blocks.
#[derive(Debug, Default)]
pub(crate) struct Samples {
    pub placed: Placed,
    /// How wide each sample is, in sides of the unit cube; none where features do not depend on it.
    pub widths: Vec<f32>,
    /// One for each latent.
    pub seen: Vec<Seen>,
    /// Features, one block for each 16 samples.
    pub features: Vec<f32>,
    /// What the first layer makes of them before any latent, where there are several; of one wave.
    before: Vec<f32>,
    octets: Vec<Octet>,
    /// How many samples each ray may still take; 0 for a ray that has ended.
    left: Vec<u32>,
}

impl Seen {
    fn begin(&mut self, rays: usize) {
        self.ray.clear();
        self.density.clear();
        self.weight.clear();
        self.behind.clear();
        self.rays.clear();
        self.rays.resize(rays, RayState { transmittance: 1.0, lit: true });
    }

    /// Weighs the samples from `start` on.
    fn weigh(&mut self, placed: &Placed, start: usize, min_transmittance: f32) {
        let end = placed.len();
        self.ray.extend_from_slice(&placed.ray[start..]);
        self.weight.resize(end, 0.0);
        self.behind.resize(end, 0.0);
        for i in start..end {
            let Some(state) = self.rays.get_mut(placed.ray[i] as usize) else { continue };
            if !state.lit {
                // The ray ended earlier in this wave: what it sees does not depend on how long waves are.
                self.ray[i] = NO_RAY;
                self.behind[i] = state.transmittance;
                continue;
            }
            let passes = self.passes[i - start];
            self.weight[i] = state.transmittance * (1.0 - passes);
            state.transmittance *= passes;
            state.lit = state.transmittance >= min_transmittance;
            self.behind[i] = state.transmittance;
        }
    }
}

impl Samples {
    /// Marches all rays until each is opaque or at its end, under each latent (at least one). Where samples lie and
    /// their features are the same for all latents. Where no sample of a block is at a place where states differ, the
    /// first latent's densities serve for all. `jitter` gives the start in steps, 0..1.
    pub fn march(
        &mut self,
        field: &Field,
        latents: &[Folded],
        rays: &[Ray],
        limits: &RayLimits,
        scratch: &mut Scratch,
        jitter: impl Fn(usize) -> f32,
    ) {
        let sf = stride(field.layout.features);
        let m = &field.marcher;
        let Self { placed, widths, seen, features, before, octets, left } = self;
        placed.resize(0, NO_RAY);
        widths.clear();
        seen.resize_with(latents.len(), Seen::default);
        for seen in seen.iter_mut() {
            seen.begin(rays.len());
        }
        octets.clear();
        octets.extend(rays.chunks(OCTET).enumerate().map(|(o, eight)| {
            Octet::new(eight, &field.contraction, |l| m.near + jitter(o * OCTET + l) * m.step_m * limits.step_scale)
        }));
        left.clear();
        left.resize(rays.len(), u32::try_from(limits.max_samples).unwrap_or(u32::MAX));
        let walk = Walk {
            marcher: m,
            occupancy: limits.use_occupancy.then_some(&field.occupancy),
            changing: &field.changing,
            step_scale: limits.step_scale,
        };
        loop {
            let going = left.iter().filter(|n| **n > 0).count();
            if going == 0 {
                break;
            }
            let start = placed.len();
            let wave = (WAVE / going).clamp(*WAVE_OF_RAY.start(), *WAVE_OF_RAY.end()) as u32;
            let mut end = start;
            placed.resize(start + going * wave as usize, NO_RAY);
            for (o, (octet, left)) in octets.iter_mut().zip(left.chunks_mut(OCTET)).enumerate() {
                let mut want = [0; OCTET];
                for (want, left) in want.iter_mut().zip(left.iter()) {
                    *want = wave.min(*left);
                }
                if want == [0; OCTET] {
                    continue;
                }
                let first = o * OCTET;
                let next = dispatch::walk_octet(field.set, &walk, octet, want, first as u32, placed, end);
                for ray in &placed.ray[end..next] {
                    left[*ray as usize - first] -= 1;
                }
                for (l, left) in left.iter_mut().enumerate() {
                    *left = if octet.goes_on(l, m.far) { *left } else { 0 };
                }
                end = next;
            }
            placed.resize(end, NO_RAY);
            if end == start {
                break;
            }
            placed.resize(end.next_multiple_of(LANES), NO_RAY);
            let blocks = start / LANES..placed.len() / LANES;
            grow(features, blocks.end * sf);
            let features = &mut features[blocks.start * sf..blocks.end * sf];
            let widths = field.attenuates().then(|| {
                let spread = |ray: u32| rays.get(ray as usize).map_or(0.0, |ray| ray.spread);
                let samples = placed.ray[start..].iter().zip(&placed.distance_m[start..]);
                widths.extend(samples.map(|(ray, distance)| field.width_in_cube(spread(*ray) * distance)));
                &widths[start..]
            });
            field.encode(&placed.points[start..], widths, features);
            let input = if latents.len() > 1 {
                let before = grow(before, blocks.len() * stride(field.layout.width));
                field.first_layer(features, before);
                FirstLayer::Done(before)
            } else {
                FirstLayer::Features(features)
            };
            see(field, latents, seen, placed, blocks, &input, scratch);
            for seen in seen.iter_mut() {
                seen.weigh(placed, start, limits.min_transmittance);
            }
            for (i, left) in left.iter_mut().enumerate() {
                if !seen.iter().any(|s| s.rays[i].lit) {
                    *left = 0;
                }
            }
        }
    }
}

/// The density network over one wave's blocks, under each latent.
fn see(
    field: &Field,
    latents: &[Folded],
    seen: &mut [Seen],
    placed: &Placed,
    blocks: std::ops::Range<usize>,
    input: &FirstLayer<'_>,
    scratch: &mut Scratch,
) {
    let sg = stride(field.layout.geometry);
    let samples = blocks.start * LANES..blocks.end * LANES;
    let lit = |seen: &Seen, block: usize| {
        let rays = &placed.ray[block * LANES..][..LANES];
        rays.iter().any(|r| seen.rays.get(*r as usize).is_some_and(|r| r.lit))
    };
    for (k, folded) in latents.iter().enumerate() {
        let (first, rest) = seen.split_at_mut(k.min(1));
        let Some(now) = (if k == 0 { rest.first_mut() } else { rest.get_mut(k - 1) }) else { return };
        grow(&mut now.geometry, blocks.end * sg);
        now.density.resize(samples.end, 0.0);
        now.passes.resize(samples.len(), 0.0);
        let shared = |block: usize| {
            first.first().filter(|f| lit(f, block) && !placed.changing[block * LANES..][..LANES].contains(&true))
        };
        let mut at = blocks.start;
        while at < blocks.end {
            if !lit(now, at) {
                at += 1;
                continue;
            }
            if let Some(first) = shared(at) {
                now.geometry[at * sg..(at + 1) * sg].copy_from_slice(&first.geometry[at * sg..(at + 1) * sg]);
                let (from, to) = (at * LANES, (at + 1) * LANES);
                now.density[from..to].copy_from_slice(&first.density[from..to]);
                let (from, to) = (from - samples.start, to - samples.start);
                now.passes[from..to].copy_from_slice(&first.passes[from..to]);
                at += 1;
                continue;
            }
            let mut end = at + 1;
            while end < blocks.end && lit(now, end) && shared(end).is_none() {
                end += 1;
            }
            let geometry = &mut now.geometry[at * sg..end * sg];
            field.density_network(
                folded,
                &input.blocks(field, at - blocks.start..end - blocks.start),
                &mut scratch.hidden_a,
                &mut scratch.hidden_b,
                geometry,
            );
            let (from, to) = (at * LANES, end * LANES);
            dispatch::activate(
                field.set,
                geometry,
                sg,
                field.config.density_offset,
                &placed.length_m[from..to],
                &mut now.density[from..to],
                &mut now.passes[from - samples.start..to - samples.start],
            );
            at = end;
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
            samples.march(self, std::slice::from_ref(&folded), chunk, &limits, &mut scratch, |_| 0.5);
            let (placed, seen) = (&samples.placed, &samples.seen[0]);
            // Waves go round all rays: sorted by ray, each one's samples keep their order.
            let mut order: Vec<usize> = (0..placed.len()).filter(|i| seen.ray[*i] != NO_RAY).collect();
            order.sort_by_key(|i| seen.ray[*i]);
            for i in order {
                out.ray.push((c * CHUNK) as u32 + seen.ray[i]);
                out.distance_m.push(placed.distance_m[i]);
                out.length_m.push(placed.length_m[i]);
                out.weight.push(seen.weight[i]);
            }
            out.transmittance.extend(seen.rays.iter().map(|r| r.transmittance));
        }
    }
}
