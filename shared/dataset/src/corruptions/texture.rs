//! Random textures.

use super::raster::Raster;
use rand::Rng;

/// Side of a fog map, a power of two, pixels of a 224 x 224 image.
pub(super) const PLASMA_SIDE: usize = 256;

/// Returns a periodic plasma of [`PLASMA_SIDE`], 0..=1, by the diamond-square algorithm. The random part becomes
/// smaller by the square of `decay` with each halving.
pub(super) fn plasma(decay: f32, rng: &mut impl Rng) -> Raster<1> {
    let side = PLASMA_SIDE;
    let mut map = vec![0.0_f32; side * side];
    let (mut step, mut strength) = (side, 1.0_f32);
    while step >= 2 {
        let half = step / 2;
        let mut fill = |map: &mut Vec<f32>, [x, y]: [usize; 2], around: [[usize; 2]; 4]| {
            let mean = around.iter().map(|[u, v]| map[(v % side) * side + u % side]).sum::<f32>() / 4.0;
            map[y * side + x] = mean + strength * rng.random_range(-1.0..=1.0);
        };
        let corners = || (0..side).step_by(step).flat_map(|y| (0..side).step_by(step).map(move |x| (x, y)));
        for (x, y) in corners() {
            let around = [[x, y], [x + step, y], [x, y + step], [x + step, y + step]];
            fill(&mut map, [x + half, y + half], around);
        }
        for (x, y) in corners() {
            for [x, y] in [[x + half, y], [x, y + half]] {
                let (left, up) = (x + side - half, y + side - half);
                fill(&mut map, [x, y], [[left, y], [x + half, y], [x, up], [x, y + half]]);
            }
        }
        step = half;
        strength /= decay * decay;
    }
    let low = map.iter().copied().fold(f32::INFINITY, f32::min);
    let high = map.iter().copied().fold(f32::NEG_INFINITY, f32::max);
    let span = (high - low).max(f32::MIN_POSITIVE);
    Raster { width: side, height: side, pixels: map.into_iter().map(|v| [(v - low) / span]).collect() }
}

/// Smooth noise on an endless lattice, 0..=1.
#[derive(Clone, Copy)]
pub(super) struct ValueNoise(u64);

impl ValueNoise {
    pub fn new(rng: &mut impl Rng) -> Self {
        Self(rng.random())
    }

    /// Returns the value at a position; cells have the side 1.
    pub fn at(self, x: f32, y: f32) -> f32 {
        let (left, top) = (x.floor(), y.floor());
        let smooth = |t: f32| t * t * (3.0 - 2.0 * t);
        let (a, b) = (smooth(x - left), smooth(y - top));
        let (x, y) = (left as i64, top as i64);
        let row = |y: i64| self.corner(x, y) * (1.0 - a) + self.corner(x + 1, y) * a;
        row(y) * (1.0 - b) + row(y + 1) * b
    }

    /// Returns ridges: 1 where the noise passes its middle, and falling to both sides.
    pub fn ridge(self, x: f32, y: f32) -> f32 {
        1.0 - (2.0 * self.at(x, y) - 1.0).abs()
    }

    /// Returns the value of a corner: its position, mixed as in `SplitMix64`.
    fn corner(self, x: i64, y: i64) -> f32 {
        let mut h =
            self.0 ^ (x as u64).wrapping_mul(0x9e37_79b9_7f4a_7c15) ^ (y as u64).wrapping_mul(0xc2b2_ae3d_27d4_eb4f);
        h = (h ^ h >> 30).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        h = (h ^ h >> 27).wrapping_mul(0x94d0_49bb_1331_11eb);
        ((h ^ h >> 31) >> 40) as f32 / (1_u64 << 24) as f32
    }
}
