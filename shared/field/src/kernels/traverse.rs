//! Traversal of the occupancy grid by packets of eight rays: the positions of samples. The inner loop of marching.

use carff_base::geometry::Ray;

use super::math::fma;
use crate::space::contraction::Contraction;
use crate::space::marcher::Marcher;
use crate::space::occupancy::{COARSE, OccupancyGrid};

/// Rays of one packet.
pub(crate) const PACKET: usize = 8;
/// Replaces 1 / 0.
const VAST: f32 = 1e30;

/// Eight rays that traverse the grid side by side; lanes without a ray are past their end.
#[derive(Clone, Copy, Debug)]
pub(crate) struct RayPacket {
    /// Origins, box units.
    origin: [[f32; PACKET]; 3],
    /// Directions, box units per metre, and the inverse.
    speed: [[f32; PACKET]; 3],
    inverse_speed: [[f32; PACKET]; 3],
    /// 1 where a ray leaves a cell through its upper wall, 0 for the lower one.
    exit_wall: [[f32; PACKET]; 3],
    /// Distance at which the next step starts, metres; at least `far_m` for a ray that has ended.
    t: [f32; PACKET],
    /// Number of the first lane's ray.
    first: u32,
}

/// Positions of samples along rays. All lists have one entry for each sample.
#[derive(Debug, Default)]
pub(crate) struct SamplePoints {
    /// Positions in the unit cube.
    pub points: Vec<[f32; 3]>,
    /// Distances from the rays' origins, metres.
    pub distance_m: Vec<f32>,
    /// Lengths of ray that the samples represent, metres.
    pub delta_m: Vec<f32>,
    /// Numbers of the samples' rays.
    pub ray: Vec<u32>,
    /// True where the states differ.
    pub changing: Vec<bool>,
}

/// The grids and step sizes that all rays of a traversal share.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Traversal<'a> {
    pub marcher: &'a Marcher,
    /// Cells in which samples are taken; all cells when there is none.
    pub occupancy: Option<&'a OccupancyGrid>,
    /// Cells in which the states differ; of the same resolution.
    pub changing: &'a OccupancyGrid,
    /// Multiplies the steps.
    pub step_scale: f32,
}

impl SamplePoints {
    /// Returns the number of samples.
    pub fn len(&self) -> usize {
        self.ray.len()
    }

    /// Cuts the lists, or fills them with samples of ray `ray` in the middle of the cube, of no length.
    pub fn resize(&mut self, len: usize, ray: u32) {
        self.points.resize(len, [0.5; 3]);
        self.distance_m.resize(len, 0.0);
        self.delta_m.resize(len, 0.0);
        self.ray.resize(len, ray);
        self.changing.resize(len, false);
    }
}

impl RayPacket {
    /// Makes a packet of up to eight rays, numbered from `first`; `start_m(lane)` is the distance at which each starts.
    pub fn new(rays: &[Ray], first: usize, contraction: &Contraction, start_m: impl Fn(usize) -> f32) -> Self {
        let mut packet = Self {
            origin: [[0.0; PACKET]; 3],
            speed: [[0.0; PACKET]; 3],
            inverse_speed: [[VAST; PACKET]; 3],
            exit_wall: [[1.0; PACKET]; 3],
            t: [f32::INFINITY; PACKET],
            first: first as u32,
        };
        let inverse_half = contraction.inverse_half();
        for (l, ray) in rays.iter().enumerate().take(PACKET) {
            let origin = contraction.normalized(ray.origin);
            for a in 0..3 {
                let speed = ray.direction[a] * inverse_half[a];
                packet.origin[a][l] = origin[a];
                packet.speed[a][l] = speed;
                packet.inverse_speed[a][l] = if speed.abs() > 1e-9 { 1.0 / speed } else { VAST };
                packet.exit_wall[a][l] = if speed < -1e-9 { 0.0 } else { 1.0 };
            }
            packet.t[l] = start_m(l);
        }
        packet
    }

    /// Returns true if a lane's ray has not reached its end.
    pub fn is_before(&self, lane: usize, far_m: f32) -> bool {
        self.t[lane] < far_m
    }
}

/// Writes up to `want` samples of each lane's ray to `out` from index `at` on; there must be room for all of them.
/// Returns the index after the last sample.
#[inline(always)]
pub(crate) fn traverse<const FMA: bool>(
    traversal: &Traversal<'_>,
    packet: &mut RayPacket,
    mut want: [u32; PACKET],
    out: &mut SamplePoints,
    mut at: usize,
) -> usize {
    let (far, step, cone) = (traversal.marcher.far_m, traversal.marcher.step_m, traversal.marcher.cone);
    let first = packet.first;
    let r = traversal.changing.resolution() as u32;
    let n = r.div_ceil(COARSE as u32);
    let (fine_cells, coarse_cells) = (r as f32, r as f32 / COARSE as f32);
    loop {
        let mut active = [false; PACKET];
        for l in 0..PACKET {
            active[l] = want[l] > 0 && packet.t[l] < far;
        }
        if active == [false; PACKET] {
            return at;
        }
        let (mut u, mut q) = ([[0.0_f32; PACKET]; 3], [[0.0_f32; PACKET]; 3]);
        let mut stretch = [1.0_f32; PACKET];
        let mut cell = [[0_u32; PACKET]; 3];
        for a in 0..3 {
            for l in 0..PACKET {
                let v = fma::<FMA>(packet.t[l], packet.speed[a][l], packet.origin[a][l]);
                u[a][l] = v;
                let c = Contraction::contract_axis(v);
                q[a][l] = c;
                stretch[l] = if v.abs() > stretch[l] { v.abs() } else { stretch[l] };
                // Whole part in the low bits, as in `hash_grid::corners`; NaN ends in some cell.
                let whole = ((c * fine_cells).floor() + 8_388_608.0).to_bits() & 0x007f_ffff;
                cell[a][l] = whole.min(r - 1);
            }
        }
        let (mut dt, mut fine, mut coarse) = ([0.0_f32; PACKET], [0_u32; PACKET], [0_u32; PACKET]);
        for l in 0..PACKET {
            let least = cone * packet.t[l];
            dt[l] = (if least > step { least } else { step }) * stretch[l] * traversal.step_scale;
            fine[l] = (cell[2][l] * r + cell[1][l]) * r + cell[0][l];
            let [x, y, z] = [cell[0][l], cell[1][l], cell[2][l]].map(|c| c / COARSE as u32);
            coarse[l] = (z * n + y) * n + x;
        }
        // The size of the empty cell around each lane's point, as cells along the cube's side; 0 in occupied cells.
        let mut cells = [0.0_f32; PACKET];
        let mut any_empty = false;
        for l in (0..PACKET).filter(|l| active[*l]) {
            if let Some(grid) = traversal.occupancy {
                if !grid.coarse_cell(coarse[l] as usize) {
                    cells[l] = coarse_cells;
                } else if !grid.cell(fine[l] as usize) {
                    cells[l] = fine_cells;
                }
            }
            if cells[l] == 0.0 {
                out.points[at] = [q[0][l], q[1][l], q[2][l]];
                out.distance_m[at] = packet.t[l];
                out.delta_m[at] = dt[l];
                out.ray[at] = first + l as u32;
                out.changing[at] = traversal.changing.cell(fine[l] as usize);
                at += 1;
                want[l] -= 1;
            } else {
                any_empty = true;
            }
        }
        let mut steps = [1.0_f32; PACKET];
        if any_empty {
            // To the far wall of the empty cell, in whole steps: the start's jitter is kept.
            let mut distance = [VAST; PACKET];
            let side = cells.map(|c| 1.0 / c.max(1.0));
            for a in 0..3 {
                let (mut wall, mut along) = ([0.0_f32; PACKET], [0.0_f32; PACKET]);
                for l in 0..PACKET {
                    wall[l] = ((q[a][l] * cells[l]).floor() + packet.exit_wall[a][l]) * side[l];
                }
                for l in 0..PACKET {
                    wall[l] = Contraction::uncontract_axis(wall[l]);
                }
                for l in 0..PACKET {
                    along[l] = (wall[l] - u[a][l]) * packet.inverse_speed[a][l];
                }
                for l in 0..PACKET {
                    distance[l] = if along[l] < distance[l] { along[l] } else { distance[l] };
                }
            }
            for l in 0..PACKET {
                let whole = (distance[l] / dt[l]).ceil();
                steps[l] = if cells[l] > 0.0 && whole > 1.0 { whole } else { 1.0 };
            }
        }
        for l in 0..PACKET {
            packet.t[l] = if active[l] { fma::<FMA>(steps[l], dt[l], packet.t[l]) } else { packet.t[l] };
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::FieldConfig;
    use crate::kernels::math::{hash, unit};

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
        let traversal = Traversal { marcher: &marcher, occupancy, changing: &changing, step_scale: 1.0 };
        let mut found = vec![Vec::new(); rays.len()];
        for (p, eight) in rays.chunks(PACKET).enumerate() {
            let mut packet = RayPacket::new(eight, p * PACKET, &contraction, |_| 0.3);
            while (0..PACKET).any(|l| packet.is_before(l, marcher.far_m)) {
                let mut out = SamplePoints::default();
                out.resize(PACKET * wave as usize, 0);
                let end = traverse::<false>(&traversal, &mut packet, [wave; PACKET], &mut out, 0);
                for i in 0..end {
                    found[out.ray[i] as usize].push((out.points[i], out.distance_m[i], out.delta_m[i]));
                }
            }
        }
        found
    }

    /// Skipping leaves out exactly the samples in empty cells and moves no other (except that rounding may change the
    /// cell of a sample on a wall), for single rays, for packets, and for waves of any length.
    #[test]
    fn skipping_keeps_the_rest_where_it_is() {
        let mut grid = OccupancyGrid::full(config().occupancy_resolution);
        grid.set_from(|i| hash(3, (i / 5) as u64, 0).is_multiple_of(9));
        let rays = rays(187);
        let everywhere = all_samples(&rays, None, 16);
        let some = all_samples(&rays, Some(&grid), 16);
        assert_eq!(some, all_samples(&rays, Some(&grid), 3));
        let single: Vec<_> = rays.iter().flat_map(|r| all_samples(&[*r], Some(&grid), 7)).collect();
        assert_eq!(some, single);
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
