//! The multi-resolution hash grid (Müller et al. 2022): features of points, and the gradient by the table.

use super::block::LANES;
use super::math::fma;
use super::prefetch::prefetch;

/// One level of the hash grid.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Level {
    /// Cells along the cube's side.
    pub resolution: u32,
    /// First entry in the table.
    pub first: usize,
    /// Number of entries.
    pub entries: usize,
    /// True when entries are addressed by coordinates (else by hash, and `entries` is a power of two).
    pub dense: bool,
}

/// The levels of a hash grid, coarsest first.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct HashGrid {
    pub levels: Vec<Level>,
    /// Features of one entry: 2, 4 or 8.
    pub features_per_level: usize,
}

/// Computes the entry numbers and blend weights of the eight corners of the cells of 16 points, `[corner][lane]`.
#[inline(always)]
fn corners(level: &Level, points: &[[f32; LANES]; 3], index: &mut [[u32; LANES]; 8], weight: &mut [[f32; LANES]; 8]) {
    const PY: u32 = 2_654_435_761;
    const PZ: u32 = 805_459_861;
    let n = level.resolution;
    let scale = n as f32;
    let mut low = [[0_u32; LANES]; 3];
    let mut part = [[0.0_f32; LANES]; 3];
    for a in 0..3 {
        for l in 0..LANES {
            let scaled = points[a][l] * scale;
            // Below 2^23: adding it leaves the whole part in the low bits. (Rounding by truncation of a value >= 0.)
            let cell = scaled.floor().min(scale - 1.0);
            low[a][l] = (cell + 8_388_608.0).to_bits() & 0x007f_ffff;
            part[a][l] = scaled - cell;
        }
    }
    let first = level.first as u32;
    if level.dense {
        let side = n + 1;
        for l in 0..LANES {
            low[0][l] = (low[2][l] * side + low[1][l]) * side + low[0][l] + first;
        }
        for c in 0..8_u32 {
            let offset = (c & 1) + ((c >> 1) & 1) * side + (c >> 2) * side * side;
            for l in 0..LANES {
                index[c as usize][l] = low[0][l] + offset;
            }
        }
    } else {
        let mask = level.entries as u32 - 1;
        for l in 0..LANES {
            low[1][l] = low[1][l].wrapping_mul(PY);
            low[2][l] = low[2][l].wrapping_mul(PZ);
        }
        for c in 0..8_u32 {
            let (dx, dy, dz) = (c & 1, ((c >> 1) & 1).wrapping_mul(PY), (c >> 2).wrapping_mul(PZ));
            for l in 0..LANES {
                let hash = (low[0][l] + dx) ^ low[1][l].wrapping_add(dy) ^ low[2][l].wrapping_add(dz);
                index[c as usize][l] = (hash & mask) + first;
            }
        }
    }
    for c in 0..8 {
        for l in 0..LANES {
            let x = if c & 1 == 1 { part[0][l] } else { 1.0 - part[0][l] };
            let y = if c & 2 == 2 { part[1][l] } else { 1.0 - part[1][l] };
            let z = if c & 4 == 4 { part[2][l] } else { 1.0 - part[2][l] };
            weight[c][l] = x * (y * z);
        }
    }
}

/// Returns points lane by lane, clamped to the cube (NaN goes to its corner, and so do lanes without a point).
#[inline(always)]
fn lanes_of(points: &[[f32; 3]]) -> [[f32; LANES]; 3] {
    let mut lanes = [[0.0; LANES]; 3];
    for (l, q) in points.iter().enumerate().take(LANES) {
        for a in 0..3 {
            lanes[a][l] = if q[a].is_nan() { 0.0 } else { q[a].clamp(0.0, 1.0) };
        }
    }
    lanes
}

/// Writes the features of up to 16 points to one block (rows = levels x F); lanes past the last point are zeroed.
#[inline(always)]
pub(crate) fn encode<const FMA: bool, const F: usize>(
    levels: &[Level],
    table: &[f32],
    points: &[[f32; 3]],
    block: &mut [f32],
) {
    let table = table.as_chunks::<F>().0;
    let count = points.len().min(LANES);
    let points = lanes_of(points);
    let mut index = [[0_u32; LANES]; 8];
    let mut weight = [[0.0_f32; LANES]; 8];
    for (level, rows) in levels.iter().zip(block.chunks_exact_mut(F * LANES)) {
        corners(level, &points, &mut index, &mut weight);
        // All at once, so that cache misses overlap: the gathers below would wait for a few at a time.
        for c in 0..8 {
            for l in 0..count {
                prefetch(table, index[c][l] as usize);
            }
        }
        let mut sums = [[0.0_f32; F]; LANES];
        for l in 0..count {
            // All eight before the sums: a bounds check between the sums would keep them from being vectorised.
            let entries: [&[f32; F]; 8] = std::array::from_fn(|c| &table[index[c][l] as usize]);
            let mut sum = [0.0_f32; F];
            for c in 0..8 {
                for f in 0..F {
                    sum[f] = fma::<FMA>(entries[c][f], weight[c][l], sum[f]);
                }
            }
            sums[l] = sum;
        }
        for f in 0..F {
            for l in 0..LANES {
                rows[f * LANES + l] = sums[l][f];
            }
        }
    }
}

/// Scales one block's features, level by level, by 1 / sqrt(1 + w^2 / 2) for samples w cells wide.
///
/// This is within 0.11 of Zip-NeRF's erf(1 / sqrt(8 s^2)) (Barron et al. 2023, section 3) for s = w / sqrt(12), the
/// deviation of a uniform distribution over w. `widths` has one entry for each lane, in sides of the unit cube. The
/// operation is its own adjoint.
#[inline(always)]
pub(crate) fn attenuate<const FMA: bool>(grid: &HashGrid, widths: &[f32], block: &mut [f32]) {
    let mut width = [0.0_f32; LANES];
    for (to, from) in width.iter_mut().zip(widths) {
        *to = *from;
    }
    let mut weight = [0.0_f32; LANES];
    for (level, rows) in grid.levels.iter().zip(block.chunks_exact_mut(grid.features_per_level * LANES)) {
        let cells = level.resolution as f32;
        for l in 0..LANES {
            let w = width[l] * cells;
            weight[l] = 1.0 / fma::<FMA>(0.5 * w, w, 1.0).sqrt();
        }
        for row in rows.as_chunks_mut::<LANES>().0 {
            for l in 0..LANES {
                row[l] *= weight[l];
            }
        }
    }
}

/// Adjoint of `encode`: adds the gradients by the features to the gradient by the table.
#[inline(always)]
pub(crate) fn scatter<const FMA: bool, const F: usize>(
    levels: &[Level],
    gradient: &mut [f32],
    points: &[[f32; 3]],
    block: &[f32],
) {
    let gradient = gradient.as_chunks_mut::<F>().0;
    let count = points.len().min(LANES);
    let points = lanes_of(points);
    let mut index = [[0_u32; LANES]; 8];
    let mut weight = [[0.0_f32; LANES]; 8];
    for (level, rows) in levels.iter().zip(block.chunks_exact(F * LANES)) {
        corners(level, &points, &mut index, &mut weight);
        for c in 0..8 {
            for l in 0..count {
                prefetch(gradient, index[c][l] as usize);
            }
        }
        for l in 0..count {
            let mut d = [0.0_f32; F];
            for f in 0..F {
                d[f] = rows[f * LANES + l];
            }
            for c in 0..8 {
                let entry = &mut gradient[index[c][l] as usize];
                for f in 0..F {
                    entry[f] = fma::<FMA>(d[f], weight[c][l], entry[f]);
                }
            }
        }
    }
}
