//! World points to hash-grid features, and directions to spherical harmonics.

use carff_field::FieldConfig;
use tch::{Kind, Tensor};

/// Levels whose entries are addressed in the same way, gathered together.
#[derive(Debug)]
struct Group {
    /// Cells along a side, `[L, 1]`, f32.
    resolution: Tensor,
    /// First entry of each level, `[L, 1, 1, 1]`, i32.
    first: Tensor,
    /// Multiplies whole coordinates: `[L, 3]`, i32.
    factors: Tensor,
    /// Entries less one (a power of two less one) where entries are addressed by hash; `None` for coordinates.
    mask: Option<i64>,
}

/// The hash grid's encoding of world points.
#[derive(Debug)]
pub(crate) struct Encoding {
    point_width_m: f32,
    /// Sides of the unit cube per metre, along the bounds' longest side.
    cubes_a_metre: f64,
    center: Tensor,
    inverse_half: Tensor,
    groups: Vec<Group>,
}

impl Encoding {
    pub(crate) fn new(config: &FieldConfig) -> Self {
        let [low, high] = config.bounds_m;
        let half = [0, 1, 2].map(|i| 0.5 * (high[i] - low[i]));
        let longest = half.iter().copied().fold(0.0, f32::max);
        let half = half.map(|h| h.max(longest * config.min_axis_ratio));
        let center = [0, 1, 2].map(|i| 0.5 * (high[i] + low[i]));

        // Resolutions grow by a constant factor; a level is hashed once its vertices outnumber the table's entries.
        let most = 1_i64 << config.log2_table_size;
        let (coarse, fine) = (f64::from(config.base_resolution), f64::from(config.max_resolution));
        let growth = if config.levels > 1 { (fine / coarse).powf(1.0 / (config.levels - 1) as f64) } else { 1.0 };
        let resolutions: Vec<i64> =
            (0..config.levels).map(|l| (coarse * growth.powi(l as i32) + 1e-6).floor() as i64).collect();
        let hashed_from = resolutions.iter().position(|r| (r + 1).pow(3) > most).unwrap_or(config.levels);
        let mut first = 0;
        let groups = [(0..hashed_from, None), (hashed_from..config.levels, Some(most - 1))]
            .into_iter()
            .filter(|(levels, _)| !levels.is_empty())
            .map(|(levels, mask)| {
                let (mut sizes, mut firsts, mut factors) = (Vec::new(), Vec::new(), Vec::new());
                for level in levels {
                    let side = resolutions[level] + 1;
                    sizes.push(resolutions[level] as f32);
                    firsts.push(first as i32);
                    first += if mask.is_some() { most } else { side.pow(3) };
                    // The hash's products wrap at 32 bits (primes of Teschner et al. 2003).
                    factors.extend(match mask {
                        Some(_) => [1, 2_654_435_761_u32 as i32, 805_459_861],
                        None => [1, side as i32, (side * side) as i32],
                    });
                }
                let count = sizes.len() as i64;
                Group {
                    resolution: Tensor::from_slice(&sizes).view([count, 1]),
                    first: Tensor::from_slice(&firsts).view([count, 1, 1, 1]),
                    factors: Tensor::from_slice(&factors).view([count, 3]),
                    mask,
                }
            })
            .collect();
        Self {
            point_width_m: config.point_width_m,
            cubes_a_metre: 0.25 / f64::from(longest),
            center: Tensor::from_slice(&center),
            inverse_half: Tensor::from_slice(&half.map(|h| 1.0 / h)),
            groups,
        }
    }

    /// Maps world metres to the unit cube: linear inside the bounds, squeezed by 2 - 1/u outside, axis by axis.
    fn contract(&self, points_m: &Tensor) -> Tensor {
        let u = (points_m - &self.center) * &self.inverse_half;
        let a = u.abs();
        let squeezed = a.where_self(&a.le(1.0), &(a.reciprocal() * -1.0 + 2.0));
        squeezed.copysign(&u) * 0.25 + 0.5
    }

    /// Computes the features `[N, levels x features per level]` of world points `[N, 3]`, `widths_m` `[N]` wide (see
    /// [`FieldConfig::point_width_m`]), from the table `[entries, features]`.
    pub(crate) fn features(&self, table: &Tensor, points_m: &Tensor, widths_m: Option<&Tensor>) -> Tensor {
        let (indices, weights): (Vec<Tensor>, Vec<Tensor>) = tch::no_grad(|| {
            let q = self.contract(points_m).clamp(0.0, 1.0).unsqueeze(1);
            self.groups.iter().map(|group| group.corners(&q)).unzip()
        });
        let (n, levels) = (points_m.size()[0], weights.iter().map(|w| w.size()[1]).sum::<i64>());
        let f = table.size()[1];
        let (indices, weights) = (Tensor::cat(&indices, 1), Tensor::cat(&weights, 1));
        let entries = table.index_select(0, &indices.view(-1)).view([n, levels, 8, f]);
        let features = (entries * weights.unsqueeze(-1)).sum_dim_intlist([2_i64].as_slice(), false, Kind::Float);
        if self.point_width_m <= 0.0 {
            return features.view([n, levels * f]);
        }
        let resolutions: Vec<Tensor> = self.groups.iter().map(|group| group.resolution.view([1, -1])).collect();
        let widths_m = widths_m.map_or_else(|| Tensor::from(self.point_width_m).view([1, 1]), |w| w.unsqueeze(1));
        let cells = widths_m * self.cubes_a_metre * Tensor::cat(&resolutions, 1);
        let weight = (cells.square() * 0.5 + 1.0).rsqrt();
        (features * weight.unsqueeze(-1)).view([n, levels * f])
    }
}

impl Group {
    /// Computes the entry numbers (i32) and blend weights of the eight corners of each point's cell, both `[N, L, 8]`.
    /// `q` is `[N, 1, 3]` in the unit cube.
    fn corners(&self, q: &Tensor) -> (Tensor, Tensor) {
        let n = q.size()[0];
        let levels = self.resolution.size()[0];
        let scaled = q * &self.resolution;
        let low = scaled.floor().minimum(&(&self.resolution - 1.0));
        let part = scaled - &low;
        let low = low.to_kind(Kind::Int);
        // Lower and upper coordinate of each axis, and their shares: [N, L, 3, 2].
        let coordinates = Tensor::stack(&[&low, &(&low + 1)], 3) * self.factors.unsqueeze(-1);
        let shares = Tensor::stack(&[&(part.neg() + 1.0), &part], 3);
        let axis = |t: &Tensor, axis: i64, shape: [i64; 5]| t.select(2, axis).reshape(shape);
        let shapes = [[n, levels, 1, 1, 2], [n, levels, 1, 2, 1], [n, levels, 2, 1, 1]];
        let [x, y, z] = [0, 1, 2].map(|a| axis(&coordinates, a as i64, shapes[a]));
        let index = match self.mask {
            Some(mask) => x.bitwise_xor_tensor(&y).bitwise_xor_tensor(&z).bitwise_and(mask) + &self.first,
            None => x + y + z + &self.first,
        };
        let [x, y, z] = [0, 1, 2].map(|a| axis(&shares, a as i64, shapes[a]));
        (index.view([n, levels, 8]), (x * (y * z)).view([n, levels, 8]))
    }
}

/// Computes the real spherical harmonics of unit vectors `[N, 3]` up to a degree of 1 to 4: `[N, degree x degree]`.
pub fn spherical_harmonics(directions: &Tensor, degree: usize) -> Tensor {
    let [x, y, z] = [0, 1, 2].map(|i| directions.select(1, i));
    let (x2, y2, z2) = (x.square(), y.square(), z.square());
    let (xy, xz, yz) = (&x * &y, &x * &z, &y * &z);
    let mut bands = vec![x.ones_like() * 0.282_094_791_773_878_14];
    if degree > 1 {
        let c = 0.488_602_511_902_919_9;
        bands.extend([&y * -c, &z * c, &x * -c]);
    }
    if degree > 2 {
        let c = 1.092_548_430_592_079;
        bands.extend([
            &xy * c,
            &yz * -c,
            &z2 * 0.946_174_695_757_560_1 - 0.315_391_565_252_520_1,
            &xz * -c,
            (&x2 - &y2) * (0.5 * c),
        ]);
    }
    if degree > 3 {
        let (a, b) = (0.590_043_589_926_643_5, 0.457_045_799_464_465_8);
        bands.extend([
            &y * (&x2 * -3.0 + &y2) * a,
            &xy * &z * 2.890_611_442_640_554,
            &y * (&z2 * -5.0 + 1.0) * b,
            &z * (&z2 * 5.0 - 3.0) * 0.373_176_332_590_115_4,
            &x * (&z2 * -5.0 + 1.0) * b,
            &z * (&x2 - &y2) * 1.445_305_721_320_277,
            &x * (&y2 * 3.0 - &x2) * a,
        ]);
    }
    Tensor::stack(&bands, 1)
}
