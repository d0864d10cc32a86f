//! The end of training: finer grids, without thin fog, and the cells in which states differ.

use super::occupancy::CELLS_PIECE;
use super::trainer::FieldTrainer;
use crate::config::LATENT_DIM;
use crate::kernels::math::{hash, unit};
use crate::model::field::Field;

/// Random points of each cell whose density is evaluated, under one latent of each state.
const DENSITY_POINTS: u64 = 10;
/// A cell stays occupied when a step inside the bounds through its densest point is at least this opaque.
const VISIBLE_OPACITY: f32 = 0.03;
/// Random points of each cell at which states are compared.
const COMPARED_POINTS: u64 = 8;
/// States differ in a cell where their mean opacities of a step inside the bounds, or their mean colours times opacity,
/// differ by more than this.
const VISIBLE_CHANGE: f32 = 0.12;

impl FieldTrainer {
    /// Ends training and returns the field.
    ///
    /// Its grids get cells of half the side. Cells in which no state has matter that an image would show become empty:
    /// training keeps thin fog, which rendering can skip. Cells in which states differ are marked.
    pub fn into_field(mut self) -> Field {
        if self.step < self.config.occupancy_warmup_steps || self.state_latents.is_empty() {
            return self.field;
        }
        self.field.refine_grids();
        let count = self.field.occupancy.resolution().pow(3);
        let cells: Vec<u32> = (0..count as u32).filter(|cell| self.field.occupancy.cell(*cell as usize)).collect();
        let visible = self.visible_cells(&cells);
        let occupied = flags(count, &visible);
        self.field.occupancy.set_from(|cell| occupied[cell]);
        let differences = self.state_differences(&visible);
        let changing: Vec<u32> =
            visible.iter().zip(differences).filter(|(_, change)| *change > VISIBLE_CHANGE).map(|(c, _)| *c).collect();
        let changing = flags(count, &changing);
        self.field.changing.set_from(|cell| changing[cell]);
        self.field
    }

    /// Returns the cells in which any state has visible matter.
    fn visible_cells(&self, cells: &[u32]) -> Vec<u32> {
        let mut largest = vec![0.0_f32; cells.len()];
        for point in 0..DENSITY_POINTS {
            let round = hash(self.config.seed, 0x1a57, point);
            let latents = self.latents_for(round);
            for (largest, density) in largest.iter_mut().zip(self.max_density(cells, &latents, round)) {
                *largest = largest.max(density);
            }
        }
        let threshold = VISIBLE_OPACITY / self.field.marcher.step_m;
        cells.iter().zip(largest).filter(|(_, density)| *density > threshold).map(|(cell, _)| *cell).collect()
    }

    /// Computes how much the states' means over each cell differ: the largest difference in the opacity of a step
    /// inside the bounds and in colour times opacity.
    fn state_differences(&self, cells: &[u32]) -> Vec<f32> {
        let rounds: Vec<u64> = (0..COMPARED_POINTS).map(|point| hash(self.config.seed, 0xc4a9, point)).collect();
        self.pool.flat_map_chunks(cells, CELLS_PIECE, |cells| {
            // Per cell the least and the largest of the states' means.
            let mut range = vec![([f32::INFINITY; 4], [f32::NEG_INFINITY; 4]); cells.len()];
            for latents in &self.state_latents {
                for ((low, high), mean) in range.iter_mut().zip(self.state_means(cells, latents, &rounds)) {
                    for k in 0..4 {
                        low[k] = low[k].min(mean[k]);
                        high[k] = high[k].max(mean[k]);
                    }
                }
            }
            range.iter().map(|(low, high)| (0..4).map(|k| high[k] - low[k]).fold(0.0, f32::max)).collect()
        })
    }

    /// Computes one state's means over each cell: opacity of a step, and RGB times opacity.
    fn state_means(&self, cells: &[u32], latents: &[[f32; LATENT_DIM]], rounds: &[u64]) -> Vec<[f32; 4]> {
        let field = &self.field;
        let (mut densities, mut colors) = (vec![0.0; cells.len()], vec![[0.0; 3]; cells.len()]);
        let mut means = vec![[0.0_f32; 4]; cells.len()];
        for (round, latent) in rounds.iter().zip(latents.iter().cycle()) {
            let points: Vec<[f32; 3]> =
                self.random_points(cells, *round).into_iter().map(|q| field.contraction.uncontract(q)).collect();
            let directions: Vec<[f32; 3]> = cells.iter().map(|cell| random_direction(*round, *cell)).collect();
            field.density_and_color(&points, &directions, latent, &mut densities, &mut colors);
            for ((mean, density), [r, g, b]) in means.iter_mut().zip(&densities).zip(&colors) {
                let opacity = 1.0 - (-density * field.marcher.step_m).exp();
                for (sum, v) in mean.iter_mut().zip([1.0, *r, *g, *b]) {
                    *sum += opacity * v / COMPARED_POINTS as f32;
                }
            }
        }
        means
    }
}

/// Returns a flag for each of `count` cells: true for the listed ones.
fn flags(count: usize, cells: &[u32]) -> Vec<bool> {
    let mut flags = vec![false; count];
    for cell in cells {
        flags[*cell as usize] = true;
    }
    flags
}

fn random_direction(round: u64, cell: u32) -> [f32; 3] {
    let d = [7, 8, 9].map(|salt| unit(hash(round, salt, u64::from(cell))) - 0.5);
    let n = d.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-3);
    d.map(|v| v / n)
}
