//! The field: its weights and occupancy grid, evaluation at points, and its tensors by name.

use std::borrow::Cow;
use std::cell::RefCell;

use crate::bf16;
use crate::config::{FieldConfig, FieldError, LATENT_DIM, MAX_GRID_RESOLUTION, MAX_HIDDEN_WIDTH};
use crate::dispatch::{self, InstructionSet};
use crate::kernels::{LANES, stride};
use crate::layout::{Layer, Layout};
use crate::march::Marcher;
use crate::math::{hash, round_to_f16, spherical_harmonics, unit};
use crate::space::{Contraction, OccupancyGrid};

/// Blocks that go through a network together: their activations stay in the second-level cache.
pub(crate) const GROUP: usize = 8;

/// A named array of numbers, row-major.
#[derive(Clone, Debug, PartialEq)]
pub struct NamedTensor<'a> {
    /// Its key in a checkpoint.
    pub name: Cow<'static, str>,
    /// Sizes, outermost first.
    pub shape: Vec<usize>,
    /// The numbers, row-major.
    pub data: Cow<'a, [f32]>,
}

/// First-layer biases with one latent's share added.
#[derive(Clone, Debug, Default)]
pub(crate) struct Folded {
    pub latent: [f32; LATENT_DIM],
    pub density: Vec<f32>,
    pub color: Vec<f32>,
    pub background: Vec<f32>,
}

/// What the density network begins with, block by block.
#[derive(Clone, Copy, Debug)]
pub(crate) enum FirstLayer<'a> {
    /// Features.
    Features(&'a [f32]),
    /// What `Field::first_layer` made of them.
    Done(&'a [f32]),
}

impl FirstLayer<'_> {
    /// Some of the blocks.
    pub(crate) fn blocks(&self, field: &Field, blocks: std::ops::Range<usize>) -> Self {
        match self {
            Self::Features(all) => {
                let apart = stride(field.layout.features);
                Self::Features(&all[blocks.start * apart..blocks.end * apart])
            }
            Self::Done(all) => {
                let apart = stride(field.layout.width);
                Self::Done(&all[blocks.start * apart..blocks.end * apart])
            }
        }
    }
}

/// Activations of one group of blocks, reused from call to call.
#[derive(Debug, Default)]
pub(crate) struct Scratch {
    pub features: Vec<f32>,
    pub hidden_a: Vec<f32>,
    pub hidden_b: Vec<f32>,
    pub geometry: Vec<f32>,
    pub output: Vec<f32>,
    pub points: Vec<[f32; 3]>,
    pub folded: Folded,
}

pub(crate) fn grow(buffer: &mut Vec<f32>, len: usize) -> &mut [f32] {
    if buffer.len() < len {
        buffer.resize(len, 0.0);
    }
    &mut buffer[..len]
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
    /// The networks' weights in bf16, layer by layer ([`Layer::pairs`]); empty unless `set` works in bf16.
    pairs: Vec<u32>,
    pub(crate) occupancy: OccupancyGrid,
    pub(crate) changing: OccupancyGrid,
}

impl Field {
    /// A field with random weights, all of space occupied. Errors when the configuration is out of range.
    pub fn new(config: FieldConfig, seed: u64) -> Result<Self, FieldError> {
        config.validate()?;
        let layout = Layout::new(&config);
        let table = (0..layout.table_len).map(|i| (unit(hash(seed, 1, i as u64)) * 2.0 - 1.0) * 1e-4).collect();
        let mut networks = vec![0.0; layout.networks_len];
        for (name, layer) in layout.named_layers() {
            // He's uniform bound for ReLU layers; small last layers, so that training starts from thin grey fog.
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

    /// Its structure.
    pub fn config(&self) -> &FieldConfig {
        &self.config
    }

    /// The map from world space to the unit cube.
    pub fn contraction(&self) -> &Contraction {
        &self.contraction
    }

    /// Where there may be matter in any state.
    pub fn occupancy(&self) -> &OccupancyGrid {
        &self.occupancy
    }

    /// Where density or colour differ among the states; everywhere until a training has ended.
    pub fn changing(&self) -> &OccupancyGrid {
        &self.changing
    }

    /// Trained numbers in the tables and the networks.
    pub fn parameter_count(&self) -> usize {
        self.table.len() + self.networks.len()
    }

    /// The instruction set that its kernels run on.
    pub fn instruction_set(&self) -> InstructionSet {
        self.set
    }

    /// Runs its kernels on another instruction set: [`InstructionSet::detect_for_pictures`] where nothing but pictures is
    /// wanted, others for parity tests and benchmarks. A field begins with [`InstructionSet::detect`].
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

    /// Rounds every weight to half precision, as a checkpoint in f16 would.
    pub fn round_to_f16(&mut self) {
        for v in self.table.iter_mut().chain(&mut self.networks) {
            *v = round_to_f16(*v);
        }
        self.set_instruction_set(self.set);
    }

    /// Halves the side of the grids' cells, as far as their resolution may go.
    pub(crate) fn refine_grids(&mut self) {
        if self.config.occupancy_resolution * 2 <= MAX_GRID_RESOLUTION {
            self.occupancy = self.occupancy.refined();
            self.changing = self.changing.refined();
            self.config.occupancy_resolution = self.occupancy.resolution();
        }
    }

    /// A latent brought to unit scale, as the networks see it.
    pub(crate) fn unit_scaled(&self, latent: &[f32; LATENT_DIM]) -> [f32; LATENT_DIM] {
        let c = &self.config;
        std::array::from_fn(|k| (latent[k] - c.latent_mean[k]) * c.latent_scale[k])
    }

    pub(crate) fn fold(&self, latent: &[f32; LATENT_DIM], folded: &mut Folded) {
        folded.latent = self.unit_scaled(latent);
        self.layout.density[0].fold(&self.networks, &folded.latent, &mut folded.density);
        self.layout.color[0].fold(&self.networks, &folded.latent, &mut folded.color);
        self.layout.background[0].fold(&self.networks, &folded.latent, &mut folded.background);
    }

    /// Whether features depend on how wide a sample is.
    pub(crate) fn attenuates(&self) -> bool {
        self.config.point_width_m > 0.0
    }

    /// A width in sides of the unit cube. Outside of the bounds, where the cube is squeezed, it is taken as if it were not.
    pub(crate) fn width_in_cube(&self, width_m: f32) -> f32 {
        0.25 * width_m / self.contraction.longest_half_m()
    }

    /// Features of points of the unit cube, 16 to a block; each as wide as `widths` says (in sides of the cube), or with
    /// none as [`FieldConfig::point_width_m`] says.
    pub(crate) fn encode(&self, points: &[[f32; 3]], widths: Option<&[f32]>, features: &mut [f32]) {
        let l = &self.layout;
        let all_alike = [self.width_in_cube(self.config.point_width_m); LANES];
        let blocks = features.chunks_exact_mut(stride(l.features));
        for (i, (points, block)) in points.chunks(LANES).zip(blocks).enumerate() {
            dispatch::encode(self.set, l.features_per_level, &l.levels, &self.table, points, block);
            if self.attenuates() {
                let widths = widths.map_or(&all_alike[..], |widths| &widths[i * LANES..][..points.len()]);
                dispatch::attenuate(self.set, &l.levels, l.features_per_level, widths, block);
            }
        }
    }

    /// One layer over blocks: y = W^T x + `bias`, clamped from below at zero when `relu`.
    pub(crate) fn dense(&self, layer: &Layer, bias: &[f32], x: &[f32], y: &mut [f32], relu: bool) {
        let (sx, sy) = (stride(layer.inputs), stride(layer.outputs));
        if self.set.is_bf16() {
            dispatch::dense_forward_bf16(self.set, &self.pairs[layer.pairs()], layer.inputs, bias, x, sx, y, sy, relu);
        } else {
            dispatch::dense_forward(self.set, layer.weights(&self.networks), bias, x, sx, y, sy, relu);
        }
    }

    /// What the density network's first layer makes of blocks of features, before any latent.
    pub(crate) fn first_layer(&self, features: &[f32], before: &mut [f32]) {
        let none = [0.0; MAX_HIDDEN_WIDTH];
        let first = &self.layout.density[0];
        self.dense(first, &none[..first.outputs], features, before, false);
    }

    /// Density network over blocks: raw density and geometry features into `geometry`.
    pub(crate) fn density_network(
        &self,
        folded: &Folded,
        input: &FirstLayer<'_>,
        hidden_a: &mut Vec<f32>,
        hidden_b: &mut Vec<f32>,
        geometry: &mut [f32],
    ) {
        let l = &self.layout;
        let (sf, sw, sg) = (stride(l.features), stride(l.width), stride(l.geometry));
        for (group, geometry) in geometry.chunks_mut(GROUP * sg).enumerate() {
            let blocks = geometry.len() / sg;
            let a = grow(hidden_a, blocks * sw);
            let b = grow(hidden_b, blocks * sw);
            let w = &self.networks;
            let at = group * GROUP;
            match input {
                FirstLayer::Features(features) => {
                    let features = &features[at * sf..(at + blocks) * sf];
                    self.dense(&l.density[0], &folded.density, features, a, true);
                }
                FirstLayer::Done(before) => {
                    dispatch::bias_relu(self.set, &before[at * sw..(at + blocks) * sw], &folded.density, a, sw);
                }
            }
            let [_, second, last] = &l.density;
            self.dense(second, second.biases(w), a, b, true);
            self.dense(last, last.biases(w), b, geometry, false);
        }
    }

    /// Colour network over blocks of (geometry features, direction); colours (0..=1) to `output`.
    pub(crate) fn color_network(
        &self,
        folded: &Folded,
        inputs: &[f32],
        hidden_a: &mut Vec<f32>,
        hidden_b: &mut Vec<f32>,
        output: &mut [f32],
    ) {
        let l = &self.layout;
        let (si, sw, so) = (stride(l.color[0].inputs), stride(l.width), stride(4));
        for (inputs, output) in inputs.chunks(GROUP * si).zip(output.chunks_mut(GROUP * so)) {
            let blocks = inputs.len() / si;
            let a = grow(hidden_a, blocks * sw);
            let b = grow(hidden_b, blocks * sw);
            let w = &self.networks;
            let [first, second, last] = &l.color;
            self.dense(first, &folded.color, inputs, a, true);
            self.dense(second, second.biases(w), a, b, true);
            self.dense(last, last.biases(w), b, output, false);
            dispatch::logistic(self.set, output);
        }
    }

    /// Background network over blocks of directions; colours (0..=1) to `output`.
    pub(crate) fn background_network(&self, folded: &Folded, inputs: &[f32], hidden: &mut [f32], output: &mut [f32]) {
        let [first, last] = &self.layout.background;
        self.dense(first, &folded.background, inputs, hidden, true);
        self.dense(last, last.biases(&self.networks), hidden, output, false);
        dispatch::logistic(self.set, output);
    }

    /// Density (1/metre) and colour (0..=1) at world points (metres) seen along unit `directions`, under one latent.
    /// Handles as many points as all four slices have.
    pub fn density_and_color(
        &self,
        points_m: &[[f32; 3]],
        directions: &[[f32; 3]],
        latent: &[f32; LATENT_DIM],
        out_density: &mut [f32],
        out_rgb: &mut [[f32; 3]],
    ) {
        let n = points_m.len().min(directions.len()).min(out_density.len()).min(out_rgb.len());
        let l = &self.layout;
        let (sf, sg, si, so) = (stride(l.features), stride(l.geometry), stride(l.color[0].inputs), stride(4));
        SCRATCH.with_borrow_mut(|s| {
            let mut folded = std::mem::take(&mut s.folded);
            self.fold(latent, &mut folded);
            let mut inputs = vec![0.0; si];
            for at in (0..n).step_by(LANES) {
                let end = (at + LANES).min(n);
                s.points.clear();
                s.points.extend(points_m[at..end].iter().map(|p| self.contraction.contract(*p)));
                self.encode(&s.points, None, grow(&mut s.features, sf));
                let geometry = grow(&mut s.geometry, sg);
                let input = FirstLayer::Features(&s.features[..sf]);
                self.density_network(&folded, &input, &mut s.hidden_a, &mut s.hidden_b, geometry);
                dispatch::densities(self.set, geometry, sg, self.config.density_offset, &mut out_density[at..end]);
                inputs[..l.geometry * LANES].copy_from_slice(&geometry[..l.geometry * LANES]);
                for (lane, d) in directions[at..end].iter().enumerate() {
                    write_direction(&mut inputs, l.geometry, l.direction, lane, &spherical_harmonics(*d));
                }
                let output = grow(&mut s.output, so);
                self.color_network(&folded, &inputs, &mut s.hidden_a, &mut s.hidden_b, output);
                for lane in 0..end - at {
                    out_rgb[at + lane] = [0, 1, 2].map(|c| output[c * LANES + lane]);
                }
            }
            s.folded = folded;
        });
    }

    /// Every number of the field by name, as a checkpoint holds it.
    ///
    /// `grid.table` is `[entries of all levels, features per level]`. Layers are as in `torch.nn.Linear`: `weight` is
    /// `[outputs, inputs]`, y = W x + b, the latent's 8 inputs last. Inputs: `density.0` (grid features level by level,
    /// z), `color.0` (all outputs of `density.2`, raw density first; direction harmonics; z), `background.0` (direction
    /// harmonics, z). `occupancy.bytes` and `changing.bytes` hold 8 cells a number (0..=255, exact in f16 and bf16),
    /// cell (z * n + y) * n + x in bit x % 8, lowest first.
    pub fn tensors(&self) -> Vec<NamedTensor<'_>> {
        let f = self.config.features_per_level;
        let mut tensors = vec![NamedTensor {
            name: "grid.table".into(),
            shape: vec![self.table.len() / f, f],
            data: Cow::Borrowed(&self.table),
        }];
        tensors.extend(network_tensors(&self.layout, &self.networks, ""));
        for (name, grid) in [("occupancy.bytes", &self.occupancy), ("changing.bytes", &self.changing)] {
            let bytes: Vec<f32> = grid.bytes().map(f32::from).collect();
            tensors.push(NamedTensor { name: name.into(), shape: vec![bytes.len()], data: Cow::Owned(bytes) });
        }
        tensors
    }

    /// A field from the tensors of `tensors`. The error lists every key that is missing, unknown, of another shape or
    /// not finite.
    pub fn from_tensors(
        config: FieldConfig,
        tensors: impl IntoIterator<Item = (String, Vec<usize>, Vec<f32>)>,
    ) -> Result<Self, FieldError> {
        let mut field = Self::new(config, 0)?;
        let wanted: Vec<(String, Vec<usize>)> =
            field.tensors().into_iter().map(|t| (t.name.into_owned(), t.shape)).collect();
        let mut seen = vec![false; wanted.len()];
        let mut differences = Vec::new();
        for (name, shape, data) in tensors {
            let Some(at) = wanted.iter().position(|(n, _)| *n == name) else {
                differences.push(format!("`{name}` is not known"));
                continue;
            };
            seen[at] = true;
            if shape != wanted[at].1 || data.len() != shape.iter().product::<usize>() {
                differences.push(format!(
                    "`{name}` has shape {shape:?} and {} values, wanted shape {:?}",
                    data.len(),
                    wanted[at].1
                ));
                continue;
            }
            if data.iter().any(|v| !v.is_finite()) {
                differences.push(format!("`{name}` holds values that are not finite"));
                continue;
            }
            match name.as_str() {
                "grid.table" => field.table = data,
                "occupancy.bytes" | "changing.bytes" => {
                    if data.iter().any(|v| v.fract() != 0.0 || !(0.0..=255.0).contains(v)) {
                        differences.push(format!("`{name}` holds values that are not whole numbers in 0..=255"));
                    } else {
                        let grid = if name == "changing.bytes" { &mut field.changing } else { &mut field.occupancy };
                        grid.set_bytes(data.iter().map(|v| *v as u8));
                    }
                }
                _ => set_network_tensor(&field.layout, &mut field.networks, &name, &data),
            }
        }
        for ((name, _), _) in wanted.iter().zip(&seen).filter(|(_, seen)| !**seen) {
            differences.push(format!("`{name}` is missing"));
        }
        if differences.is_empty() { Ok(field) } else { Err(FieldError::Tensors { differences }) }
    }
}

#[inline(always)]
pub(crate) fn write_direction(block: &mut [f32], first_row: usize, rows: usize, lane: usize, harmonics: &[f32; 16]) {
    for (r, h) in harmonics.iter().enumerate().take(rows) {
        block[(first_row + r) * LANES + lane] = *h;
    }
}

/// Layers of a flat network buffer (weights, gradients or moments) as tensors in the layout of `torch.nn.Linear`.
pub(crate) fn network_tensors(layout: &Layout, networks: &[f32], prefix: &str) -> Vec<NamedTensor<'static>> {
    let mut tensors = Vec::new();
    for (name, layer) in layout.named_layers() {
        let weight = (0..layer.outputs_used)
            .flat_map(|o| (0..layer.rows()).map(move |k| networks[layer.weight + k * layer.outputs + o]))
            .collect();
        tensors.push(NamedTensor {
            name: format!("{prefix}{name}.weight").into(),
            shape: vec![layer.outputs_used, layer.rows()],
            data: Cow::Owned(weight),
        });
        tensors.push(NamedTensor {
            name: format!("{prefix}{name}.bias").into(),
            shape: vec![layer.outputs_used],
            data: Cow::Owned(networks[layer.bias..layer.bias + layer.outputs_used].to_vec()),
        });
    }
    tensors
}

/// Puts one tensor of `network_tensors` back; its shape has been checked.
pub(crate) fn set_network_tensor(layout: &Layout, networks: &mut [f32], name: &str, data: &[f32]) {
    for (layer_name, layer) in layout.named_layers() {
        match name.strip_prefix(layer_name) {
            Some(".weight") => {
                for (i, v) in data.iter().enumerate() {
                    networks[layer.weight + (i % layer.rows()) * layer.outputs + i / layer.rows()] = *v;
                }
            }
            Some(".bias") => networks[layer.bias..layer.bias + data.len()].copy_from_slice(data),
            _ => {}
        }
    }
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

    /// Plain, unblocked evaluation from the exported tensors, as a tensor library would do it.
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
        for level in crate::layout::grid_levels(&field.config) {
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

    /// Folded, blocked, vectorised evaluation equals the plain one from the exported tensors to 1e-4, on every
    /// instruction set here.
    #[test]
    fn evaluation_equals_the_unfolded_one() {
        let mut field = busy_field();
        let (p, z) = (points(50), [0.3, -1.0, 0.5, 2.0, -0.7, 0.1, 0.0, 1.0]);
        let d: Vec<[f32; 3]> = (0..50).map(|i| [(i as f32).sin(), 0.0, (i as f32).cos()]).collect();
        for set in [InstructionSet::portable(), InstructionSet::detect()] {
            field.set_instruction_set(set);
            let (mut density, mut alone, mut rgb) = (vec![0.0; 50], vec![0.0; 50], vec![[0.0; 3]; 50]);
            field.density_and_color(&p, &d, &z, &mut density, &mut rgb);
            field.density(&p, &z, &mut alone);
            for i in 0..50 {
                assert!((density[i] - alone[i]).abs() < 2e-5 * density[i], "{} {}", density[i], alone[i]);
                let (want, want_rgb) = reference(&field, p[i], d[i], &z);
                assert!((f64::from(density[i]) - want).abs() < 1e-4 * want, "{} {want}", density[i]);
                for c in 0..3 {
                    assert!((f64::from(rgb[i][c]) - want_rgb[c]).abs() < 1e-4);
                }
            }
        }
    }

    /// Several latents at once give what each gives alone, and prepared points what they give unprepared.
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

    /// Tensors make an equal field, and what does not fit is named key by key.
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

    /// Values out of range are named, with what is allowed.
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
