//! The occupancy grid of the contracted cube.

/// One bit for each cell of the contracted cube: set where there may be matter in any state.
///
/// A second, 4 times coarser level lets rays cross empty space in long steps. (A third level, 16 times coarser, made no
/// frame faster.)
///
/// ```
/// use carff_field::OccupancyGrid;
/// let mut grid = OccupancyGrid::full(8);
/// grid.set_from(|cell| cell < 8 * 8);
/// assert!(grid.contains([0.5, 0.5, 0.1]) && !grid.contains([0.5, 0.5, 0.2]));
/// assert_eq!(grid.occupied_share(), 1.0 / 8.0);
/// ```
#[derive(Clone, Debug, PartialEq)]
pub struct OccupancyGrid {
    resolution: usize,
    bits: Vec<u64>,
    /// One bit for each cube of `COARSE` cells along a side: set where any of its cells is occupied.
    coarse: Vec<u64>,
}

/// Side of the coarser level's cells, in cells.
pub(crate) const COARSE: usize = 4;

impl OccupancyGrid {
    /// Makes a grid of `resolution`^3 cells, all occupied.
    pub fn full(resolution: usize) -> Self {
        let mut grid = Self {
            resolution,
            bits: vec![u64::MAX; (resolution.pow(3)).div_ceil(64)],
            coarse: vec![0; resolution.div_ceil(COARSE).pow(3).div_ceil(64)],
        };
        grid.update_coarse();
        grid
    }

    /// Returns the number of cells along a side.
    pub fn resolution(&self) -> usize {
        self.resolution
    }

    /// Returns the share of cells that are occupied, 0..=1.
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

    /// Returns a grid of the same space with cells of half the side.
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

    /// Returns true if the cell of this index is occupied.
    #[inline(always)]
    pub fn cell(&self, index: usize) -> bool {
        (self.bits[index >> 6] >> (index & 63)) & 1 == 1
    }

    /// Returns true if the cell of a point of the unit cube is occupied.
    pub fn contains(&self, q: [f32; 3]) -> bool {
        let r = self.resolution;
        let c = q.map(|v| ((v * r as f32) as usize).min(r - 1));
        self.cell((c[2] * r + c[1]) * r + c[0])
    }

    /// Returns true if any cell in the coarse cell of this index is occupied.
    #[inline(always)]
    pub(crate) fn coarse_cell(&self, index: usize) -> bool {
        (self.coarse[index >> 6] >> (index & 63)) & 1 == 1
    }

    /// Returns the bits as bytes, cell 0 in the lowest bit of byte 0.
    pub(crate) fn bytes(&self) -> impl Iterator<Item = u8> + '_ {
        self.bits.iter().flat_map(|w| w.to_le_bytes())
    }

    /// Sets all bits from bytes as [`Self::bytes`] returns them.
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

    /// Bytes and refinement keep the bits, and a coarse cell is set exactly when one of its cells is.
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
