//! The field in plain tensor operations: the reference for the native kernels.
//!
//! The same latent-conditioned hash grid and networks as [`carff_field::Field`], built from its tensors, with gradients
//! by automatic differentiation. It does no operation that is not needed: the latent's share is folded into the first
//! layers' biases, and all levels of the grid are gathered at once. Parity tests compare the native kernels with it,
//! and the benchmarks measure both.
//!
//! Shapes: N points or samples, R rays. All tensors are on the processor.

mod encoding;
mod rays;

use carff_field::{Field, FieldConfig};
use encoding::Encoding;
use tch::{Device, Kind, Tensor, nn};

pub use encoding::spherical_harmonics;
pub use rays::{Rays, Samples, huber_sum};

/// The arithmetic of the networks. Grid features, densities and sums along rays are always f32.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Precision {
    /// Networks in f32.
    F32,
    /// Weights and activations in bf16, as the tensor library computes them.
    Bf16,
}

impl Precision {
    fn kind(self) -> Kind {
        match self {
            Self::F32 => Kind::Float,
            Self::Bf16 => Kind::BFloat16,
        }
    }
}

/// One fully connected layer; the latent's 8 columns last where it has them.
#[derive(Debug)]
struct Layer {
    weight: Tensor,
    bias: Tensor,
    latents: i64,
}

impl Layer {
    /// Computes y = W x + b, x in the networks' arithmetic.
    fn forward(&self, x: &Tensor) -> Tensor {
        let kind = x.kind();
        x.linear(&self.weight.to_kind(kind), Some(self.bias.to_kind(kind)))
    }

    /// Computes a layer that takes the latent `z`, `[8]` for all rows or `[N, 8]`.
    fn forward_with(&self, x: &Tensor, z: &Tensor) -> Tensor {
        let kind = x.kind();
        let inputs = self.weight.size()[1] - self.latents;
        let by_input = self.weight.narrow(1, 0, inputs).to_kind(kind);
        let shift = (z.matmul(&self.weight.narrow(1, inputs, self.latents).tr()) + &self.bias).to_kind(kind);
        if z.dim() == 1 { x.linear(&by_input, Some(shift)) } else { x.matmul(&by_input.tr()) + shift }
    }
}

/// The field, as tensors.
#[derive(Debug)]
pub struct ReferenceField {
    store: nn::VarStore,
    config: FieldConfig,
    precision: Precision,
    encoding: Encoding,
    table: Tensor,
    density: [Layer; 3],
    color: [Layer; 3],
    background: [Layer; 2],
    latent_mean: Tensor,
    latent_scale: Tensor,
}

impl ReferenceField {
    /// Copies `field`'s weights, all of them trainable.
    pub fn new(field: &Field, precision: Precision) -> Self {
        let store = nn::VarStore::new(Device::Cpu);
        let config = field.config().clone();
        let tensors = field.tensors();
        let variable = |name: &str| {
            let shape_and_data = tensors.iter().find(|t| t.name == name);
            let (shape, data) = shape_and_data.map_or((vec![0], &[][..]), |t| (t.shape.clone(), &t.data[..]));
            let shape: Vec<i64> = shape.iter().map(|&s| s as i64).collect();
            let mut path = store.root();
            let mut parts: Vec<&str> = name.split('.').collect();
            let last = parts.pop().unwrap_or_default();
            for part in parts {
                path = path / part;
            }
            path.var_copy(last, &Tensor::from_slice(data).view(shape.as_slice()))
        };
        let layer = |name: &str, latents: usize| Layer {
            weight: variable(&format!("{name}.weight")),
            bias: variable(&format!("{name}.bias")),
            latents: latents as i64,
        };
        let z = carff_field::LATENT_DIM;
        Self {
            table: variable("grid.table"),
            density: [layer("density.0", z), layer("density.1", 0), layer("density.2", 0)],
            color: [layer("color.0", z), layer("color.1", 0), layer("color.2", 0)],
            background: [layer("background.0", z), layer("background.1", 0)],
            latent_mean: Tensor::from_slice(&config.latent_mean),
            latent_scale: Tensor::from_slice(&config.latent_scale),
            encoding: Encoding::new(&config),
            store,
            config,
            precision,
        }
    }

    /// Returns all weights by the names of [`Field::tensors`], for optimisers and for reading gradients.
    pub fn store(&self) -> &nn::VarStore {
        &self.store
    }

    /// Returns the field's structure.
    pub fn config(&self) -> &FieldConfig {
        &self.config
    }

    /// Computes the density, 1/metre, `[N]`, at `points_m` `[N, 3]`; `latent` is `[8]` for all or `[N, 8]`.
    pub fn density(&self, points_m: &Tensor, latent: &Tensor) -> Tensor {
        self.activate(&self.geometry(points_m, None, latent))
    }

    /// Computes density `[N]` and colour `[N, 3]` (0..=1) at `points_m` `[N, 3]` for unit viewing `directions` `[N,
    /// 3]`.
    pub fn density_and_color(&self, points_m: &Tensor, directions: &Tensor, latent: &Tensor) -> (Tensor, Tensor) {
        let geometry = self.geometry(points_m, None, latent);
        let harmonics = spherical_harmonics(directions, self.config.direction_degree);
        (self.activate(&geometry), self.color(&geometry, &harmonics, latent))
    }

    /// Computes the density network's outputs `[N, 1 + geometry features]`, raw density first, in the networks'
    /// arithmetic. Points are `widths_m` `[N]` wide; without them, as wide as in the configuration.
    pub(crate) fn geometry(&self, points_m: &Tensor, widths_m: Option<&Tensor>, latent: &Tensor) -> Tensor {
        let features = self.encoding.features(&self.table, points_m, widths_m).to_kind(self.precision.kind());
        let hidden = self.density[0].forward_with(&features, &self.normalized(latent)).relu();
        self.density[2].forward(&self.density[1].forward(&hidden).relu())
    }

    /// Computes densities from raw outputs.
    pub(crate) fn activate(&self, geometry: &Tensor) -> Tensor {
        let raw = geometry.select(1, 0).to_kind(Kind::Float);
        (raw + f64::from(self.config.density_offset)).clamp_max(15.0).exp()
    }

    /// Computes colours from outputs of the density network and direction harmonics.
    pub(crate) fn color(&self, geometry: &Tensor, harmonics: &Tensor, latent: &Tensor) -> Tensor {
        let input = Tensor::cat(&[geometry, &harmonics.to_kind(geometry.kind())], 1);
        let hidden = self.color[0].forward_with(&input, &self.normalized(latent)).relu();
        self.color[2].forward(&self.color[1].forward(&hidden).relu()).to_kind(Kind::Float).sigmoid()
    }

    /// Computes the background's colour, `[R, 3]`, from direction harmonics.
    pub(crate) fn background(&self, harmonics: &Tensor, latent: &Tensor) -> Tensor {
        let input = harmonics.to_kind(self.precision.kind());
        let hidden = self.background[0].forward_with(&input, &self.normalized(latent)).relu();
        self.background[1].forward(&hidden).to_kind(Kind::Float).sigmoid()
    }

    fn normalized(&self, latent: &Tensor) -> Tensor {
        (latent - &self.latent_mean) * &self.latent_scale
    }
}
