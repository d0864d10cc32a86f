//! The field: its weights and grids, and evaluation at points.

use std::borrow::Cow;
use std::cell::RefCell;

use super::layout::Layout;
use super::network::{Hidden, Input, Weights};
use super::tensors::{NamedTensor, load_tensors, names_and_shapes, network_tensors, set_network_tensor, table_tensor};
use crate::config::{FieldConfig, FieldError, LATENT_DIM, MAX_GRID_RESOLUTION};
use crate::kernels::bf16;
use crate::kernels::block::{BlockBuffer, BlocksMut, LANES};
use crate::kernels::dispatch::{self, InstructionSet};
use crate::kernels::math::{hash, round_to_f16, spherical_harmonics, unit};
use crate::space::contraction::Contraction;
use crate::space::marcher::Marcher;
use crate::space::occupancy::OccupancyGrid;

/// Rows of a colour network's output: RGB and a row of padding.
pub(crate) const RGB_ROWS: usize = 4;

/// First-layer biases with one latent's share added.
#[derive(Clone, Debug, Default)]
pub(crate) struct Folded {
    pub latent: [f32; LATENT_DIM],
    pub density: Vec<f32>,
    pub color: Vec<f32>,
    pub background: Vec<f32>,
}

/// Buffers of [`Field::density_and_color`], one block each.
#[derive(Debug, Default)]
struct Scratch {
    points: Vec<[f32; 3]>,
    features: BlockBuffer,
    hidden: Hidden,
    geometry: BlockBuffer,
    inputs: BlockBuffer,
    output: BlockBuffer,
    folded: Folded,
}

thread_local! {
    static SCRATCH: RefCell<Scratch> = RefCell::default();
}

/// The latent-conditioned radiance field.
///
/// World point -> contraction -> hash-grid features; (features, z) -> density and geometry features;
/// (geometry features, direction, z) -> colour. CARFF section 3.2; Müller et al. 2022 (instant-ngp).
///
/// ```
/// use carff_field::{Field, FieldConfig};
/// let config = FieldConfig { log2_table_size: 10, occupancy_resolution: 16, ..FieldConfig::default() };
/// let field = Field::new(config, 7)?;
/// let mut density = [0.0];
/// field.density(&[[1.0, 2.0, 0.5]], &[0.0; 8], &mut density);
/// assert!(density[0] > 0.0);
/// # Ok::<(), carff_field::FieldError>(())
/// ```
#[derive(Clone, Debug)]
pub struct Field {
    pub(crate) config: FieldConfig,
    pub(crate) layout: Layout,
    pub(crate) contraction: Contraction,
    pub(crate) marcher: Marcher,
    pub(crate) set: InstructionSet,
    pub(crate) table: Vec<f32>,
    pub(crate) networks: Vec<f32>,
    /// The networks' weights in bf16; empty unless `set` works in bf16.
    pairs: Vec<u32>,
    pub(crate) occupancy: OccupancyGrid,
    pub(crate) changing: OccupancyGrid,
}

impl Field {
    /// Makes a field with random weights, all of space occupied. Fails when the configuration is out of range.
    pub fn new(config: FieldConfig, seed: u64) -> Result<Self, FieldError> {
        config.validate()?;
        let layout = Layout::new(&config);
        let table = (0..layout.table_len).map(|i| (unit(hash(seed, 1, i as u64)) * 2.0 - 1.0) * 1e-4).collect();
        let mut networks = vec![0.0; layout.networks_len];
        for (name, layer) in layout.named_layers() {
            // He's uniform bound for ReLU layers; last layers are small, so that training starts from thin grey fog.
            let last = matches!(name, "density.2" | "color.2" | "background.1");
            let bound = (6.0 / layer.rows() as f32).sqrt() * if last { 0.3 } else { 1.0 };
            for k in 0..layer.rows() {
                for o in 0..layer.outputs_used {
                    let at = layer.weight + k * layer.outputs + o;
                    networks[at] = (unit(hash(seed, 2, at as u64)) * 2.0 - 1.0) * bound;
                }
            }
        }
        let contraction = Contraction::new(&config);
        Ok(Self {
            marcher: Marcher::new(&config, contraction),
            occupancy: OccupancyGrid::full(config.occupancy_resolution),
            changing: OccupancyGrid::full(config.occupancy_resolution),
            set: InstructionSet::detect(),
            config,
            layout,
            contraction,
            table,
            networks,
            pairs: Vec::new(),
        })
    }

    /// Returns the field's structure.
    pub fn config(&self) -> &FieldConfig {
        &self.config
    }

    /// Returns the map from world space to the unit cube.
    pub fn contraction(&self) -> &Contraction {
        &self.contraction
    }

    /// Returns the cells in which there may be matter in any state.
    pub fn occupancy(&self) -> &OccupancyGrid {
        &self.occupancy
    }

    /// Returns the cells in which density or colour differ among the states: all cells until a training has ended.
    pub fn changing(&self) -> &OccupancyGrid {
        &self.changing
    }

    /// Returns a copy whose images leave out what is at some world points, metres, by cells of the grid. Densities stay.
    #[must_use]
    pub fn without(&self, is_left_out: impl Fn([f32; 3]) -> bool) -> Self {
        let (r, mut copy) = (self.occupancy.resolution(), self.clone());
        copy.occupancy.set_from(|i| {
            let middle = [i % r, i / r % r, i / (r * r)].map(|v| (v as f32 + 0.5) / r as f32);
            self.occupancy.cell(i) && !is_left_out(self.contraction.uncontract(middle))
        });
        copy
    }

    /// Returns the number of trained parameters in the tables and the networks.
    pub fn parameter_count(&self) -> usize {
        self.table.len() + self.networks.len()
    }

    /// Returns the instruction set that the kernels run on.
    pub fn instruction_set(&self) -> InstructionSet {
        self.set
    }

    /// Sets the instruction set that the kernels run on; a new field runs on [`InstructionSet::detect`]. Fields that
    /// only render images may run on [`InstructionSet::detect_for_images`].
    pub fn set_instruction_set(&mut self, set: InstructionSet) {
        self.set = set;
        self.pairs.clear();
        if set.is_bf16() {
            self.pairs.resize(self.networks.len() / 2, 0);
            for (_, layer) in self.layout.named_layers() {
                bf16::pack(layer.weights(&self.networks), layer.outputs, &mut self.pairs[layer.pairs()]);
            }
        }
    }

    /// Rounds every weight to half precision, as a checkpoint in f16 does.
    pub fn round_to_f16(&mut self) {
        for v in self.table.iter_mut().chain(&mut self.networks) {
            *v = round_to_f16(*v);
        }
        self.set_instruction_set(self.set);
    }

    /// Doubles the resolution of the grids, unless it would exceed its limit.
    pub(crate) fn refine_grids(&mut self) {
        if self.config.occupancy_resolution * 2 <= MAX_GRID_RESOLUTION {
            self.occupancy = self.occupancy.refined();
            self.changing = self.changing.refined();
            self.config.occupancy_resolution = self.occupancy.resolution();
        }
    }

    /// Returns a latent at unit scale, the networks' input.
    pub(crate) fn unit_scaled(&self, latent: &[f32; LATENT_DIM]) -> [f32; LATENT_DIM] {
        let c = &self.config;
        std::array::from_fn(|k| (latent[k] - c.latent_mean[k]) * c.latent_scale[k])
    }

    /// Folds a latent into the biases of the first layers.
    pub(crate) fn fold(&self, latent: &[f32; LATENT_DIM], folded: &mut Folded) {
        folded.latent = self.unit_scaled(latent);
        self.layout.density.layers[0].fold(&self.networks, &folded.latent, &mut folded.density);
        self.layout.color.layers[0].fold(&self.networks, &folded.latent, &mut folded.color);
        self.layout.background.layers[0].fold(&self.networks, &folded.latent, &mut folded.background);
    }

    /// Returns the numbers of the networks.
    pub(crate) fn weights(&self) -> Weights<'_> {
        Weights { set: self.set, numbers: &self.networks, pairs: &self.pairs }
    }

    /// Returns true if features depend on the widths of samples.
    pub(crate) fn has_point_width(&self) -> bool {
        self.config.point_width_m > 0.0
    }

    /// Converts a width to sides of the unit cube, by the scale inside the bounds.
    pub(crate) fn width_in_cube(&self, width_m: f32) -> f32 {
        0.25 * width_m / self.contraction.longest_half_m()
    }

    /// Computes the features of points of the unit cube, 16 to a block. `widths` are in sides of the cube; without them
    /// all points are [`FieldConfig::point_width_m`] wide.
    pub(crate) fn encode(&self, points: &[[f32; 3]], widths: Option<&[f32]>, mut features: BlocksMut<'_>) {
        let grid = &self.layout.grid;
        let default_widths = [self.width_in_cube(self.config.point_width_m); LANES];
        for (i, (points, block)) in points.chunks(LANES).zip(features.iter_mut()).enumerate() {
            dispatch::encode(self.set, grid, &self.table, points, block);
            if self.has_point_width() {
                let widths = widths.map_or(&default_widths[..], |widths| &widths[i * LANES..][..points.len()]);
                dispatch::attenuate(self.set, grid, widths, block);
            }
        }
    }

    /// Computes density (1/metre) and colour (0..=1) at world points (metres) for unit viewing `directions`, under one
    /// latent, for as many points as all four slices have.
    pub fn density_and_color(
        &self,
        points_m: &[[f32; 3]],
        directions: &[[f32; 3]],
        latent: &[f32; LATENT_DIM],
        out_density: &mut [f32],
        out_rgb: &mut [[f32; 3]],
    ) {
        let n = points_m.len().min(directions.len()).min(out_density.len()).min(out_rgb.len());
        let (l, weights) = (&self.layout, self.weights());
        SCRATCH.with_borrow_mut(|scratch| {
            let Scratch { points, features, hidden, geometry, inputs, output, folded } = scratch;
            self.fold(latent, folded);
            for at in (0..n).step_by(LANES) {
                let end = (at + LANES).min(n);
                points.clear();
                points.extend(points_m[at..end].iter().map(|p| self.contraction.contract(*p)));
                self.encode(points, None, features.blocks_mut(l.features, 1));
                let x = Input::Features(features.blocks(l.features, 1));
                l.density.forward(weights, &folded.density, x, hidden, geometry.blocks_mut(l.geometry, 1));
                let raw = geometry.blocks(l.geometry, 1);
                dispatch::sigma(self.set, raw, self.config.density_offset, &mut out_density[at..end]);
                let mut x = inputs.blocks_mut(l.geometry + l.direction, 1);
                for (lane, d) in directions[at..end].iter().enumerate() {
                    x.copy_sample(lane, raw, lane, l.geometry);
                    x.write_sample(lane, l.geometry, &spherical_harmonics(*d)[..l.direction]);
                }
                let x = Input::Features(x.into_blocks());
                l.color.forward(weights, &folded.color, x, hidden, output.blocks_mut(RGB_ROWS, 1));
                for lane in 0..end - at {
                    out_rgb[at + lane] = output.blocks(RGB_ROWS, 1).rgb(lane);
                }
            }
        });
    }

    /// Returns every number of the field by name, for a checkpoint.
    ///
    /// `grid.table` is `[entries of all levels, features per level]`. Layers are as in `torch.nn.Linear`: `weight` is
    /// `[outputs, inputs]`, y = W x + b, the latent's 8 inputs last. Inputs: `density.0` (grid features level by level,
    /// z), `color.0` (all outputs of `density.2`, raw density first; direction harmonics; z), `background.0` (direction
    /// harmonics, z). `occupancy.bytes` and `changing.bytes` hold 8 cells a number (0..=255, exact in f16 and bf16),
    /// cell (z * n + y) * n + x in bit x % 8, lowest first.
    pub fn tensors(&self) -> Vec<NamedTensor<'_>> {
        let mut tensors = vec![table_tensor("grid.table", &self.layout, &self.table[..])];
        tensors.extend(network_tensors(&self.layout, &self.networks, ""));
        for (name, grid) in [("occupancy.bytes", &self.occupancy), ("changing.bytes", &self.changing)] {
            let bytes: Vec<f32> = grid.bytes().map(f32::from).collect();
            tensors.push(NamedTensor { name: name.into(), shape: vec![bytes.len()], data: Cow::Owned(bytes) });
        }
        tensors
    }

    /// Makes a field from the tensors of [`Self::tensors`]. The error lists every key that is missing, unknown, of
    /// another shape or not finite.
    pub fn from_tensors(
        config: FieldConfig,
        tensors: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
    ) -> Result<Self, FieldError> {
        let mut field = Self::new(config, 0)?;
        load_tensors(&names_and_shapes(field.tensors()), tensors, |name, data| {
            match name {
                "grid.table" => field.table = data,
                "occupancy.bytes" => set_grid(&mut field.occupancy, name, &data)?,
                "changing.bytes" => set_grid(&mut field.changing, name, &data)?,
                _ => set_network_tensor(&field.layout, &mut field.networks, name, &data),
            }
            Ok(())
        })?;
        Ok(field)
    }
}

fn set_grid(grid: &mut OccupancyGrid, name: &str, data: &[f32]) -> Result<(), String> {
    if data.iter().any(|v| v.fract() != 0.0 || !(0.0..=255.0).contains(v)) {
        return Err(format!("`{name}` holds values that are not whole numbers in 0..=255"));
    }
    grid.set_bytes(data.iter().map(|v| *v as u8));
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    fn config() -> FieldConfig {
        FieldConfig { log2_table_size: 12, occupancy_resolution: 16, ..FieldConfig::default() }
    }

    fn points(n: usize) -> Vec<[f32; 3]> {
        (0..n as u64).map(|i| [0, 1, 2].map(|k| 60.0 * unit(hash(3, i, k)) - 30.0)).collect()
    }

    fn busy_field() -> Field {
        let mut field = Field::new(config(), 4).unwrap();
        for (i, v) in field.table.iter_mut().enumerate() {
            *v = unit(hash(8, i as u64, 0)) - 0.5;
        }
        field
    }

    /// Evaluates the exported tensors as a tensor library does, without blocks or folding.
    fn reference(field: &Field, point_m: [f32; 3], direction: [f32; 3], z: &[f32; LATENT_DIM]) -> (f64, [f64; 3]) {
        let tensors = field.tensors();
        let layer = |name: &str, x: &[f64], relu: bool| -> Vec<f64> {
            let find = |key: String| tensors.iter().find(|t| t.name == key).unwrap();
            let (w, b) = (find(format!("{name}.weight")), find(format!("{name}.bias")));
            assert_eq!(w.shape, [b.data.len(), x.len()]);
            let row = |o: usize| (0..x.len()).map(|k| f64::from(w.data[o * x.len() + k]) * x[k]).sum::<f64>();
            (0..b.data.len())
                .map(|o| row(o) + f64::from(b.data[o]))
                .map(|v| if relu { v.max(0.0) } else { v })
                .collect()
        };
        let f = field.config.features_per_level;
        let q = field.contraction.contract(point_m).map(f64::from);
        let mut x = Vec::new();
        let mut first = 0;
        for level in &field.layout.grid.levels {
            let n = f64::from(level.resolution);
            let cell = q.map(|v| (v * n).floor());
            for k in 0..f {
                let mut sum = 0.0;
                for corner in 0..8_u32 {
                    let bit = [corner & 1, (corner >> 1) & 1, corner >> 2];
                    let v = [0, 1, 2].map(|i| cell[i] as u32 + bit[i]);
                    let weight: f64 = (0..3)
                        .map(|i| if bit[i] == 1 { q[i] * n - cell[i] } else { 1.0 - (q[i] * n - cell[i]) })
                        .product();
                    let side = level.resolution + 1;
                    let at = if level.dense {
                        (v[2] * side + v[1]) * side + v[0]
                    } else {
                        (v[0] ^ v[1].wrapping_mul(2_654_435_761) ^ v[2].wrapping_mul(805_459_861))
                            % level.entries as u32
                    };
                    sum += weight * f64::from(tensors[0].data[(first + at as usize) * f + k]);
                }
                x.push(sum);
            }
            first += level.entries;
        }
        let z = z.map(f64::from);
        x.extend(z);
        let h = layer("density.1", &layer("density.0", &x, true), true);
        let g = layer("density.2", &h, false);
        let density = (g[0] + f64::from(field.config.density_offset)).exp();
        let mut x = g;
        x.extend(spherical_harmonics(direction)[..field.layout.direction].iter().map(|v| f64::from(*v)));
        x.extend(z);
        let c = layer("color.2", &layer("color.1", &layer("color.0", &x, true), true), false);
        (density, [0, 1, 2].map(|i| 1.0 / (1.0 + (-c[i]).exp())))
    }

    /// Folded, blocked, vectorised evaluation equals the plain evaluation of the exported tensors to 1e-4, on every
    /// instruction set of this processor.
    #[test]
    fn evaluation_equals_the_unfolded_one() {
        let mut field = busy_field();
        let (p, z) = (points(50), [0.3, -1.0, 0.5, 2.0, -0.7, 0.1, 0.0, 1.0]);
        let d: Vec<[f32; 3]> = (0..50).map(|i| [(i as f32).sin(), 0.0, (i as f32).cos()]).collect();
        for set in [InstructionSet::portable(), InstructionSet::detect()] {
            field.set_instruction_set(set);
            let (mut density, mut separate, mut rgb) = (vec![0.0; 50], vec![0.0; 50], vec![[0.0; 3]; 50]);
            field.density_and_color(&p, &d, &z, &mut density, &mut rgb);
            field.density(&p, &z, &mut separate);
            for i in 0..50 {
                assert!((density[i] - separate[i]).abs() < 2e-5 * density[i], "{} {}", density[i], separate[i]);
                let (want, want_rgb) = reference(&field, p[i], d[i], &z);
                assert!((f64::from(density[i]) - want).abs() < 1e-4 * want, "{} {want}", density[i]);
                for c in 0..3 {
                    assert!((f64::from(rgb[i][c]) - want_rgb[c]).abs() < 1e-4);
                }
            }
        }
    }

    /// Several latents at once give the same as one by one, and prepared points the same as unprepared ones.
    #[test]
    fn density_by_latent_equals_one_by_one() {
        let field = busy_field();
        let p = points(37);
        let latents: Vec<[f32; LATENT_DIM]> = (0..3).map(|i| [i as f32 - 1.0; LATENT_DIM]).collect();
        let mut all = vec![0.0; 3 * 37];
        field.density_by_latent(&p, &latents, &mut all);
        let (prepared, mut again) = (field.prepare(&p), vec![0.0; 3 * 37]);
        field.density_prepared(&prepared, &latents, &mut again);
        assert_eq!((all.clone(), 37), (again, prepared.len()));
        for (z, all) in latents.iter().zip(all.chunks(37)) {
            let mut one = vec![0.0; 37];
            field.density(&p, z, &mut one);
            assert_eq!(one, all);
        }
        assert_ne!(all[..37], all[37..74]);
    }

    /// Tensors make an equal field, and the error names every key that does not fit.
    #[test]
    fn tensors_round_trip_and_mismatches_are_named() {
        let mut field = busy_field();
        field.occupancy.set_from(|i| i % 7 == 0);
        field.changing.set_from(|i| i % 5 == 0);
        let owned = |field: &Field| -> Vec<(String, Vec<usize>, Vec<f32>)> {
            field.tensors().into_iter().map(|t| (t.name.into_owned(), t.shape, t.data.into_owned())).collect()
        };
        let tensors = owned(&field);
        let copy = Field::from_tensors(config(), tensors.clone()).unwrap();
        assert_eq!(copy.table, field.table);
        assert_eq!((&copy.occupancy, &copy.changing), (&field.occupancy, &field.changing));
        assert_eq!(owned(&copy), tensors);

        let mut bad = tensors;
        bad.retain(|t| t.0 != "color.1.bias");
        bad[0].2[5] = f32::NAN;
        bad.push(("grid.stable".into(), vec![1], vec![0.0]));
        let at = bad.iter().position(|t| t.0 == "density.1.bias").unwrap();
        bad[at].1 = vec![3];
        let last = bad.iter().position(|t| t.0 == "occupancy.bytes").unwrap();
        bad[last].2[0] = 0.5;
        let Err(FieldError::Tensors { differences }) = Field::from_tensors(config(), bad) else { panic!() };
        let text = differences.join("\n");
        for key in ["color.1.bias", "grid.table", "grid.stable", "density.1.bias", "occupancy.bytes"] {
            assert!(text.contains(&format!("`{key}`")), "{text}");
        }
        assert_eq!(differences.len(), 5);
    }

    /// Errors name the value that is out of range.
    #[test]
    fn bad_configurations_are_refused() {
        let bad = [
            (FieldConfig { levels: 0, ..config() }, "levels"),
            (FieldConfig { hidden_width: 30, ..config() }, "hidden_width"),
            (FieldConfig { bounds_m: [[0.0; 3]; 2], ..config() }, "bounds_m"),
            (FieldConfig { near_m: f32::NAN, ..config() }, "near_m"),
            (FieldConfig { occupancy_resolution: 100, ..config() }, "occupancy_resolution"),
        ];
        for (config, name) in bad {
            let error = Field::new(config, 0).unwrap_err();
            assert!(matches!(error, FieldError::Config { key, .. } if key == name), "{error}");
        }
    }

    /// Points that are not finite, and empty inputs, do not panic.
    #[test]
    fn strange_points_do_no_harm() {
        let field = busy_field();
        let mut out = [0.0; 3];
        field.density(&[[f32::NAN, 0.0, 0.0], [f32::INFINITY, 0.0, 1e30], [0.0; 3]], &[0.0; 8], &mut out);
        assert!(out[2].is_finite());
        field.density(&[], &[0.0; 8], &mut []);
        field.density_by_latent(&[[0.0; 3]], &[], &mut []);
    }
}
