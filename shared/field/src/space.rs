//! From world metres to the unit cube and back: the scene contraction, and the occupancy grid that lives in the cube.

use crate::config::FieldConfig;

/// Maps world space onto the unit cube, axis by axis: the bounds fill the middle half linearly, all that lies outside
/// is squeezed into the rest by g(u) = 2 - 1/u (mip-NeRF 360's contraction, taken per axis so that it is separable).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contraction {
    center: [f32; 3],
    half: [f32; 3],
    inverse_half: [f32; 3],
}

impl Contraction {
    /// The contraction of a configuration.
    pub fn new(config: &FieldConfig) -> Self {
        let [low, high] = config.bounds_m;
        let half = [0, 1, 2].map(|i| 0.5 * (high[i] - low[i]));
        let longest = half[0].max(half[1]).max(half[2]);
        let half = half.map(|h| h.max(longest * config.min_axis_ratio));
        Self { center: [0, 1, 2].map(|i| 0.5 * (high[i] + low[i])), half, inverse_half: half.map(|h| 1.0 / h) }
    }

    /// Longest half extent of the inner part, metres.
    pub fn longest_half_m(&self) -> f32 {
        self.half[0].max(self.half[1]).max(self.half[2])
    }

    /// World metres to box units: the inner part is [-1, 1]^3.
    #[inline(always)]
    pub fn normalized(&self, point_m: [f32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|i| (point_m[i] - self.center[i]) * self.inverse_half[i])
    }

    /// Box units to the unit cube.
    #[inline(always)]
    pub fn contract_normalized(u: [f32; 3]) -> [f32; 3] {
        u.map(Self::contract_axis)
    }

    /// One coordinate in box units to the unit cube.
    #[inline(always)]
    pub(crate) fn contract_axis(u: f32) -> f32 {
        let a = u.abs();
        let outside = 2.0 - 1.0 / a;
        let g = if a <= 1.0 { a } else { outside };
        0.5 + 0.25 * g.copysign(u)
    }

    /// World metres to the unit cube.
    #[inline(always)]
    pub fn contract(&self, point_m: [f32; 3]) -> [f32; 3] {
        Self::contract_normalized(self.normalized(point_m))
    }

    /// The unit cube (open) to world metres; the faces, which are infinitely far away, are brought to 1e4 extents.
    pub fn uncontract(&self, q: [f32; 3]) -> [f32; 3] {
        [0, 1, 2].map(|i| self.center[i] + self.half[i] * Self::uncontract_axis(q[i]))
    }

    /// One coordinate of the unit cube to box units.
    #[inline(always)]
    pub(crate) fn uncontract_axis(q: f32) -> f32 {
        let g = (q - 0.5) * 4.0;
        let a = g.abs();
        let rest = 2.0 - a;
        let outside = 1.0 / if rest > 1e-4 { rest } else { 1e-4 };
        let u = if a <= 1.0 { a } else { outside };
        u.copysign(g)
    }

    /// 1 / half extents, metres.
    #[inline(always)]
    pub(crate) fn inverse_half(&self) -> [f32; 3] {
        self.inverse_half
    }
}

/// One bit for each cell of the contracted cube: may there be matter in ANY state? A second, 4 times coarser level
/// lets rays cross empty space in long steps. (A third one, 16 times coarser, made no frame faster.)
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    resolution: usize,
    bits: Vec<u64>,
    /// Whether any cell of each cube of `COARSE` cells along a side is occupied.
    coarse: Vec<u64>,
}

/// Side of the coarser level's cells, in cells.
pub(crate) const COARSE: usize = 4;

impl OccupancyGrid {
    /// A grid of `resolution`^3 cells, all occupied.
    pub fn full(resolution: usize) -> Self {
        let mut grid = Self {
            resolution,
            bits: vec![u64::MAX; (resolution.pow(3)).div_ceil(64)],
            coarse: vec![0; resolution.div_ceil(COARSE).pow(3).div_ceil(64)],
        };
        grid.update_coarse();
        grid
    }

    /// Cells along a side.
    pub fn resolution(&self) -> usize {
        self.resolution
    }

    /// Share of cells that are occupied.
    pub fn occupied_share(&self) -> f32 {
        self.bits.iter().map(|w| u64::from(w.count_ones())).sum::<u64>() as f32 / self.resolution.pow(3) as f32
    }

    /// Sets all bits by a predicate on the cell index ((z * resolution + y) * resolution + x).
    pub fn set_from(&mut self, occupied: impl Fn(usize) -> bool) {
        let cells = self.resolution.pow(3);
        for (i, word) in self.bits.iter_mut().enumerate() {
            let mut w = 0_u64;
            for b in 0..64.min(cells - i * 64) {
                w |= u64::from(occupied(i * 64 + b)) << b;
            }
            *word = w;
        }
        self.update_coarse();
    }

    /// The same space in cells of half the side.
    #[must_use]
    pub fn refined(&self) -> Self {
        let (half, whole) = (self.resolution, self.resolution * 2);
        let mut grid = Self::full(whole);
        grid.set_from(|i| {
            let [x, y, z] = [i % whole, i / whole % whole, i / (whole * whole)].map(|v| v / 2);
            self.cell((z * half + y) * half + x)
        });
        grid
    }

    /// Whether a cell is occupied, by its index.
    #[inline(always)]
    pub fn cell(&self, index: usize) -> bool {
        (self.bits[index >> 6] >> (index & 63)) & 1 == 1
    }

    /// Whether the cell of a point of the unit cube is occupied.
    pub fn contains(&self, q: [f32; 3]) -> bool {
        let r = self.resolution;
        let c = q.map(|v| ((v * r as f32) as usize).min(r - 1));
        self.cell((c[2] * r + c[1]) * r + c[0])
    }

    /// Whether any cell of a cell of the coarser level is occupied, by the latter's index.
    #[inline(always)]
    pub(crate) fn coarse_cell(&self, index: usize) -> bool {
        (self.coarse[index >> 6] >> (index & 63)) & 1 == 1
    }

    /// The bits as bytes, cell 0 in the lowest bit of byte 0.
    pub(crate) fn bytes(&self) -> impl Iterator<Item = u8> + '_ {
        self.bits.iter().flat_map(|w| w.to_le_bytes())
    }

    pub(crate) fn set_bytes(&mut self, bytes: impl Iterator<Item = u8>) {
        let mut bytes = bytes;
        for word in &mut self.bits {
            let mut b = [0_u8; 8];
            for byte in &mut b {
                *byte = bytes.next().unwrap_or(0);
            }
            *word = u64::from_le_bytes(b);
        }
        self.update_coarse();
    }

    fn update_coarse(&mut self) {
        let r = self.resolution;
        let n = r.div_ceil(COARSE);
        self.coarse.fill(0);
        for z in 0..r {
            for y in 0..r {
                for x in 0..r {
                    if self.cell((z * r + y) * r + x) {
                        let c = ((z / COARSE) * n + y / COARSE) * n + x / COARSE;
                        self.coarse[c >> 6] |= 1 << (c & 63);
                    }
                }
            }
        }
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

    /// Bits survive the way through bytes and a refinement, and a coarse cell is set exactly when one of its cells is.
    #[test]
    fn grid_bytes_and_coarse_level() {
        let mut grid = OccupancyGrid::full(16);
        assert_eq!(grid.occupied_share(), 1.0);
        grid.set_from(|i| i % 37 == 5);
        let mut copy = OccupancyGrid::full(16);
        copy.set_bytes(grid.bytes());
        assert_eq!(grid, copy);
        let fine = grid.refined();
        assert_eq!((fine.resolution(), fine.occupied_share()), (32, grid.occupied_share()));
        for q in [[0.1, 0.2, 0.3], [0.99, 0.5, 0.01], [0.34, 0.7, 0.55]] {
            assert_eq!(fine.contains(q), grid.contains(q));
        }
        grid.set_from(|i| i == (9 * 16 + 2) * 16 + 14);
        assert_eq!((0..64).filter(|i| grid.coarse_cell(*i)).collect::<Vec<_>>(), [(2 * 4) * 4 + 3]);
    }
}
