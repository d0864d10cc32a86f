//! The scene contraction: from world metres to the unit cube and back.

use crate::config::FieldConfig;
use std::hint::select_unpredictable;

/// Maps world space onto the unit cube, axis by axis.
///
/// The bounds fill the middle half linearly. Space outside is squeezed into the rest by g(u) = 2 - 1/u (mip-NeRF 360's
/// contraction, per axis so that it is separable).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contraction {
    center: [f32; 3],
    half: [f32; 3],
    inverse_half: [f32; 3],
}

impl Contraction {
    /// Makes the contraction of a configuration.
    pub fn new(config: &FieldConfig) -> Self {
        let [low, high] = config.bounds_m;
        let half = [0, 1, 2].map(|i| 0.5 * (high[i] - low[i]));
        let longest = half[0].max(half[1]).max(half[2]);
        let half = half.map(|h| h.max(longest * config.min_axis_ratio));
        Self { center: [0, 1, 2].map(|i| 0.5 * (high[i] + low[i])), half, inverse_half: half.map(|h| 1.0 / h) }
    }

    /// Returns the longest half extent of the inner part, metres.
    pub fn longest_half_m(&self) -> f32 {
        self.half[0].max(self.half[1]).max(self.half[2])
    }

    /// Maps world metres to box units: the inner part is [-1, 1]^3.
    #[inline(always)]
    pub fn normalized(&self, point_m: [f32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|i| (point_m[i] - self.center[i]) * self.inverse_half[i])
    }

    /// Maps box units to the unit cube.
    #[inline(always)]
    fn contract_normalized(u: [f32; 3]) -> [f32; 3] {
        u.map(Self::contract_axis)
    }

    /// Maps one coordinate in box units to the unit cube.
    #[inline(always)]
    pub(crate) fn contract_axis(u: f32) -> f32 {
        let a = u.abs();
        let outside = 2.0 - 1.0 / a;
        // With `if`, the compiler divides behind a branch on 64-bit Arm, one lane at a time.
        let g = select_unpredictable(a <= 1.0, a, outside);
        0.5 + 0.25 * g.copysign(u)
    }

    /// Maps world metres to the unit cube.
    #[inline(always)]
    pub fn contract(&self, point_m: [f32; 3]) -> [f32; 3] {
        Self::contract_normalized(self.normalized(point_m))
    }

    /// Maps the unit cube (open) to world metres; its faces, which are infinitely far away, map to 1e4 extents.
    pub fn uncontract(&self, q: [f32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|i| self.center[i] + self.half[i] * Self::uncontract_axis(q[i]))
    }

    /// Maps one coordinate of the unit cube to box units.
    #[inline(always)]
    pub(crate) fn uncontract_axis(q: f32) -> f32 {
        let g = (q - 0.5) * 4.0;
        let a = g.abs();
        let rest = 2.0 - a;
        let outside = 1.0 / if rest > 1e-4 { rest } else { 1e-4 };
        let u = if a <= 1.0 { a } else { outside };
        u.copysign(g)
    }

    /// Returns 1 / half extents, 1/metre.
    #[inline(always)]
    pub(crate) fn inverse_half(&self) -> [f32; 3] {
        self.inverse_half
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The contraction is monotone along each axis, stays in the cube, and `uncontract` inverts it.
    #[test]
    fn contraction_is_monotone_and_invertible() {
        let config = FieldConfig { bounds_m: [[-17.0, -18.5, 0.0], [6.0, 5.0, 5.0]], ..FieldConfig::default() };
        let c = Contraction::new(&config);
        for axis in 0..3 {
            let mut last = f32::NEG_INFINITY;
            for i in -3000..3000 {
                let mut p = [1.0, 2.0, 3.0];
                p[axis] = i as f32 * 0.1;
                let q = c.contract(p);
                assert!(q[axis] > last && q[axis] > 0.0 && q[axis] < 1.0);
                last = q[axis];
                let back = c.uncontract(q);
                for j in 0..3 {
                    assert!((back[j] - p[j]).abs() < 2e-4 * (1.0 + p[j] * p[j]), "{p:?} {back:?}");
                }
            }
        }
        let inner = c.contract([-17.0, -18.5, 2.5]);
        assert!(inner[0] >= 0.25 - 1e-6 && (inner[1] - 0.25).abs() < 1e-6);
    }
}
