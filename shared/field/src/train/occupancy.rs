//! The upkeep of the occupancy grid during training.

use super::trainer::FieldTrainer;
use crate::config::LATENT_DIM;
use crate::kernels::math::{hash, unit};

/// Occupancy cells of one task.
pub(super) const CELLS_PIECE: usize = 512;
/// Cells that the search for an occupied one visits at most.
const SEARCHED_CELLS: usize = 4096;

impl FieldTrainer {
    /// Updates the densities of cells under every state's latent, and the grid by them, when the current step asks for
    /// it.
    pub(super) fn refresh_occupancy(&mut self) {
        let c = &self.config;
        let (warmup, interval) = (c.occupancy_warmup_steps, c.occupancy_interval.max(1));
        if self.state_latents.is_empty() || self.step < warmup || !(self.step - warmup).is_multiple_of(interval) {
            return;
        }
        let round = hash(c.seed, 0x0cc0, self.step);
        // All cells at the end of the warm-up and twice more soon after, then some of all and of the occupied ones.
        let since = self.step - warmup;
        let cells = if [0, 8 * interval, 24 * interval].contains(&since) {
            (0..self.cell_density.len() as u32).collect()
        } else {
            self.random_cells(round)
        };
        let latents = self.latents_for(round);
        let densities = self.max_density(&cells, &latents, round);
        for (cell, density) in cells.iter().zip(densities) {
            let kept = &mut self.cell_density[*cell as usize];
            *kept = (*kept * self.config.occupancy_decay).max(density);
        }
        let densities = &self.cell_density;
        let mean = densities.iter().map(|d| f64::from(d.min(1e3))).sum::<f64>() / densities.len() as f64;
        let threshold = (self.config.occupancy_threshold / self.field.marcher.step_m).min(mean as f32);
        self.field.occupancy.set_from(|i| densities[i] > threshold);
    }

    /// Draws cells, half of them among all cells and half among the occupied ones; sorted and without duplicates.
    fn random_cells(&self, round: u64) -> Vec<u32> {
        let count = self.cell_density.len();
        let half = self.config.occupancy_cells / 2;
        let random = |stream: u64, i: usize| (hash(round, stream, i as u64) % count as u64) as usize;
        let mut cells: Vec<u32> = (0..half).map(|i| random(1, i) as u32).collect();
        for i in 0..half {
            // The next occupied cell from a random one on; the search is bounded.
            let start = random(2, i);
            let found = (0..SEARCHED_CELLS).map(|k| (start + k) % count).find(|cell| self.field.occupancy.cell(*cell));
            cells.extend(found.map(|cell| cell as u32));
        }
        cells.sort_unstable();
        cells.dedup();
        cells
    }

    /// Draws one latent of each state.
    pub(super) fn latents_for(&self, round: u64) -> Vec<[f32; LATENT_DIM]> {
        self.state_latents
            .iter()
            .enumerate()
            .map(|(s, of_state)| of_state[(hash(round, 3, s as u64) % of_state.len() as u64) as usize])
            .collect()
    }

    /// Computes the largest density under any of the latents, at one random point of each cell.
    pub(super) fn max_density(&self, cells: &[u32], latents: &[[f32; LATENT_DIM]], round: u64) -> Vec<f32> {
        self.pool.flat_map_chunks(cells, CELLS_PIECE, |cells| {
            let points = self.random_points(cells, round);
            let mut densities = vec![0.0; points.len() * latents.len()];
            self.field.density_in_cube(&points, latents, &mut densities);
            (0..points.len())
                .map(|p| (0..latents.len()).map(|l| densities[l * points.len() + p]).fold(0.0, f32::max))
                .collect()
        })
    }

    /// Draws one point of each cell, in the unit cube.
    pub(super) fn random_points(&self, cells: &[u32], round: u64) -> Vec<[f32; 3]> {
        let resolution = self.field.occupancy.resolution();
        cells
            .iter()
            .map(|cell| {
                let i = *cell as usize;
                let at = [i % resolution, i / resolution % resolution, i / (resolution * resolution)];
                std::array::from_fn(|a| {
                    let jitter = unit(hash(round, 4 + a as u64, i as u64));
                    (at[a] as f32 + jitter) / resolution as f32
                })
            })
            .collect()
    }
}
