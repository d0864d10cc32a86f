//! Rays on their way through the occupancy grid, eight side by side: where their samples lie. The inner loop of marching.

// Loops over lanes by index: that is the form which vectorises, and all of a loop's arrays read alike.
#![allow(clippy::needless_range_loop)]

use carff_geometry::Ray;

use crate::march::Marcher;
use crate::math::fma;
use crate::space::{COARSE, Contraction, OccupancyGrid};

/// Rays that walk side by side.
pub(crate) const OCTET: usize = 8;
/// In place of 1 / 0.
const VAST: f32 = 1e30;

/// Eight rays on their way; lanes without a ray are past their end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Octet {
    /// In box units.
    origin: [[f32; OCTET]; 3],
    /// Box units a metre, and the inverse.
    speed: [[f32; OCTET]; 3],
    inverse_speed: [[f32; OCTET]; 3],
    /// 1 where a ray leaves a cell by its upper wall, 0 where by its lower one.
    ahead: [[f32; OCTET]; 3],
    /// Distance of the next step's start, metres; not below the end for a ray that has ended.
    t: [f32; OCTET],
}

/// Where samples lie; all lists are equally long.
#[derive(Debug, Default)]
pub(crate) struct Placed {
    /// In the unit cube.
    pub points: Vec<[f32; 3]>,
    pub distance_m: Vec<f32>,
    pub length_m: Vec<f32>,
    pub ray: Vec<u32>,
    /// Whether the states differ there.
    pub changing: Vec<bool>,
}

/// What all rays have in common.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Walk<'a> {
    pub marcher: &'a Marcher,
    /// Where to take samples; everywhere when there is none.
    pub occupancy: Option<&'a OccupancyGrid>,
    /// Of the same resolution.
    pub changing: &'a OccupancyGrid,
    /// Multiplies the steps.
    pub step_scale: f32,
}

impl Placed {
    pub fn len(&self) -> usize {
        self.ray.len()
    }

    /// Cuts or fills all lists with samples of ray `ray` in the middle of the cube, of no length.
    pub fn resize(&mut self, len: usize, ray: u32) {
        self.points.resize(len, [0.5; 3]);
        self.distance_m.resize(len, 0.0);
        self.length_m.resize(len, 0.0);
        self.ray.resize(len, ray);
        self.changing.resize(len, false);
    }
}

impl Octet {
    /// Up to eight rays, each at its `start`, metres.
    pub fn new(rays: &[Ray], contraction: &Contraction, start: impl Fn(usize) -> f32) -> Self {
        let mut octet = Self {
            origin: [[0.0; OCTET]; 3],
            speed: [[0.0; OCTET]; 3],
            inverse_speed: [[VAST; OCTET]; 3],
            ahead: [[1.0; OCTET]; 3],
            t: [f32::INFINITY; OCTET],
        };
        let inverse_half = contraction.inverse_half();
        for (l, ray) in rays.iter().enumerate().take(OCTET) {
            let origin = contraction.normalized(ray.origin);
            for a in 0..3 {
                let speed = ray.direction[a] * inverse_half[a];
                octet.origin[a][l] = origin[a];
                octet.speed[a][l] = speed;
                octet.inverse_speed[a][l] = if speed.abs() > 1e-9 { 1.0 / speed } else { VAST };
                octet.ahead[a][l] = if speed < -1e-9 { 0.0 } else { 1.0 };
            }
            octet.t[l] = start(l);
        }
        octet
    }

    /// Whether a lane's ray is not past its end.
    pub fn goes_on(&self, lane: usize, far: f32) -> bool {
        self.t[lane] < far
    }
}

/// Places up to `want` samples of each lane's ray into `out` from `at` on (there must be room for all of them); the
/// rays are numbered from `first`. Returns where the next sample goes.
#[inline(always)]
pub(crate) fn walk<const FMA: bool>(
    walk: &Walk<'_>,
    octet: &mut Octet,
    mut want: [u32; OCTET],
    first: u32,
    out: &mut Placed,
    mut at: usize,
) -> usize {
    let (far, step, cone) = (walk.marcher.far, walk.marcher.step_m, walk.marcher.cone);
    let r = walk.changing.resolution() as u32;
    let n = r.div_ceil(COARSE as u32);
    let (fine_cells, coarse_cells) = (r as f32, r as f32 / COARSE as f32);
    loop {
        let mut live = [false; OCTET];
        for l in 0..OCTET {
            live[l] = want[l] > 0 && octet.t[l] < far;
        }
        if live == [false; OCTET] {
            return at;
        }
        let (mut u, mut q) = ([[0.0_f32; OCTET]; 3], [[0.0_f32; OCTET]; 3]);
        let mut stretch = [1.0_f32; OCTET];
        let mut cell = [[0_u32; OCTET]; 3];
        for a in 0..3 {
            for l in 0..OCTET {
                let v = fma::<FMA>(octet.t[l], octet.speed[a][l], octet.origin[a][l]);
                u[a][l] = v;
                let c = Contraction::contract_axis(v);
                q[a][l] = c;
                stretch[l] = if v.abs() > stretch[l] { v.abs() } else { stretch[l] };
                // Whole part in the low bits, see `kernels::corners`; what is not a number ends in some cell.
                let whole = ((c * fine_cells).floor() + 8_388_608.0).to_bits() & 0x007f_ffff;
                cell[a][l] = whole.min(r - 1);
            }
        }
        let (mut dt, mut fine, mut coarse) = ([0.0_f32; OCTET], [0_u32; OCTET], [0_u32; OCTET]);
        for l in 0..OCTET {
            let least = cone * octet.t[l];
            dt[l] = (if least > step { least } else { step }) * stretch[l] * walk.step_scale;
            fine[l] = (cell[2][l] * r + cell[1][l]) * r + cell[0][l];
            let [x, y, z] = [cell[0][l], cell[1][l], cell[2][l]].map(|c| c / COARSE as u32);
            coarse[l] = (z * n + y) * n + x;
        }
        // The side of the empty cell around each lane's point, as cells along the cube's side; 0 where it is not empty.
        let mut cells = [0.0_f32; OCTET];
        let mut skips = false;
        for l in (0..OCTET).filter(|l| live[*l]) {
            if let Some(grid) = walk.occupancy {
                if !grid.coarse_cell(coarse[l] as usize) {
                    cells[l] = coarse_cells;
                } else if !grid.cell(fine[l] as usize) {
                    cells[l] = fine_cells;
                }
            }
            if cells[l] == 0.0 {
                out.points[at] = [q[0][l], q[1][l], q[2][l]];
                out.distance_m[at] = octet.t[l];
                out.length_m[at] = dt[l];
                out.ray[at] = first + l as u32;
                out.changing[at] = walk.changing.cell(fine[l] as usize);
                at += 1;
                want[l] -= 1;
            } else {
                skips = true;
            }
        }
        let mut steps = [1.0_f32; OCTET];
        if skips {
            // To the far wall of the empty cell, in whole steps, so that the jitter of the start is kept.
            let mut distance = [VAST; OCTET];
            let side = cells.map(|c| 1.0 / c.max(1.0));
            for a in 0..3 {
                let (mut wall, mut along) = ([0.0_f32; OCTET], [0.0_f32; OCTET]);
                for l in 0..OCTET {
                    wall[l] = ((q[a][l] * cells[l]).floor() + octet.ahead[a][l]) * side[l];
                }
                for l in 0..OCTET {
                    wall[l] = Contraction::uncontract_axis(wall[l]);
                }
                for l in 0..OCTET {
                    along[l] = (wall[l] - u[a][l]) * octet.inverse_speed[a][l];
                }
                for l in 0..OCTET {
                    distance[l] = if along[l] < distance[l] { along[l] } else { distance[l] };
                }
            }
            for l in 0..OCTET {
                let whole = (distance[l] / dt[l]).ceil();
                steps[l] = if cells[l] > 0.0 && whole > 1.0 { whole } else { 1.0 };
            }
        }
        for l in 0..OCTET {
            octet.t[l] = if live[l] { fma::<FMA>(steps[l], dt[l], octet.t[l]) } else { octet.t[l] };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FieldConfig;
    use crate::math::{hash, unit};

    fn config() -> FieldConfig {
        FieldConfig { occupancy_resolution: 32, ..FieldConfig::default() }
    }

    fn rays(count: u64) -> Vec<Ray> {
        (0..count)
            .map(|i| {
                let v = |k: u64| unit(hash(5, i, k)) * 2.0 - 1.0;
                let d = [v(3), v(4), v(5)];
                let norm = d.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-3);
                Ray { origin: [30.0 * v(0), 30.0 * v(1), 10.0 * v(2)], direction: d.map(|v| v / norm), spread: 0.0 }
            })
            .collect()
    }

    fn all_samples(rays: &[Ray], occupancy: Option<&OccupancyGrid>, wave: u32) -> Vec<Vec<([f32; 3], f32, f32)>> {
        let config = config();
        let contraction = Contraction::new(&config);
        let marcher = Marcher::new(&config, contraction);
        let changing = OccupancyGrid::full(config.occupancy_resolution);
        let about = Walk { marcher: &marcher, occupancy, changing: &changing, step_scale: 1.0 };
        let mut found = vec![Vec::new(); rays.len()];
        for (o, eight) in rays.chunks(OCTET).enumerate() {
            let mut octet = Octet::new(eight, &contraction, |_| 0.3);
            while (0..OCTET).any(|l| octet.goes_on(l, marcher.far)) {
                let mut out = Placed::default();
                out.resize(OCTET * wave as usize, 0);
                let end = walk::<false>(&about, &mut octet, [wave; OCTET], (o * OCTET) as u32, &mut out, 0);
                for i in 0..end {
                    found[out.ray[i] as usize].push((out.points[i], out.distance_m[i], out.length_m[i]));
                }
            }
        }
        found
    }

    /// Skipping leaves out exactly the samples in empty cells and moves none (but for rounding, which may tip one that
    /// lies on a cell's wall), whether a ray walks alone, beside others, or in waves of any length.
    #[test]
    fn skipping_keeps_the_rest_where_it_is() {
        let mut grid = OccupancyGrid::full(config().occupancy_resolution);
        grid.set_from(|i| hash(3, (i / 5) as u64, 0).is_multiple_of(9));
        let rays = rays(187);
        let everywhere = all_samples(&rays, None, 16);
        let some = all_samples(&rays, Some(&grid), 16);
        assert_eq!(some, all_samples(&rays, Some(&grid), 3));
        let alone: Vec<_> = rays.iter().flat_map(|r| all_samples(&[*r], Some(&grid), 7)).collect();
        assert_eq!(some, alone);
        let (mut left, mut tipped) = (0, 0);
        for (all, some) in everywhere.iter().zip(&some) {
            assert!(all.windows(2).all(|w| w[0].1 < w[1].1) && some.windows(2).all(|w| w[0].1 < w[1].1));
            // Inside the bounds, where steps are equal, the samples that are left are samples of the whole list.
            let inside = |s: &&([f32; 3], f32, f32)| s.0.iter().all(|q| (0.25..=0.75).contains(q)) && s.1 < 40.0;
            let starts_inside = all.first().is_some_and(|s| inside(&s));
            if !starts_inside {
                continue;
            }
            for s in some.iter().filter(inside) {
                assert!(grid.contains(s.0));
                left += 1;
            }
            let wanted: Vec<_> = all.iter().take_while(inside).filter(|s| grid.contains(s.0)).collect();
            let missing = |s: &&&([f32; 3], f32, f32)| !some.iter().any(|o| (o.1 - s.1).abs() < 2e-3);
            tipped += wanted.iter().filter(missing).count();
        }
        assert!(left > 300 && tipped * 100 < left, "{tipped} of {left}");
    }
}
