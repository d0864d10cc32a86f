//! The encoder as an ONNX file: image bytes in, posterior out.
//!
//! | value | type | shape |
//! |---|---|---|
//! | `image` | bytes, RGB | height, width, 3; any size |
//! | `mean`, `log_variance` | `f32` | 1, 8 |

mod backbone;
mod graph;
mod proto;

use crate::InferenceError;
use crate::weights::StoredWeights;
use carff_checkpoint::{Manifest, files, shapes::EncoderConfig};
use carff_messages::LATENT_DIM;
use graph::{Builder, Name, described, int, ints, text};
use proto::{DataType, Extent};
use std::path::Path;

/// Name of the file in a checkpoint. The stages do not read it; it is for other tools.
pub const FILE: &str = "encoder.onnx";
const LATENT: i64 = LATENT_DIM as i64;

/// Returns the encoder of a checkpoint as the bytes of an ONNX file. Equal weights give equal bytes.
pub fn encoder_onnx(dir: &Path, manifest: &Manifest) -> Result<Vec<u8>, InferenceError> {
    let config = &manifest.encoder;
    let mut head = StoredWeights::read(&dir.join(files::ENCODER))?;
    let file = dir.join(files::BACKBONE);
    // The encoder's own file contains a trained backbone.
    let published = config.backbone.frozen && file.is_file();
    let mut backbone = if published { StoredWeights::read(&file)? } else { head.part("backbone.") };
    let mut head = Head { weights: head.part("encoder."), others: head, config };

    let mut graph = Builder::default();
    let image = graph.node("Cast", &["image"], vec![int("to", DataType::Float as i64)]);
    let image = graph.transpose(&image, &[2, 0, 1]);
    let image = graph.reshape_to_batch(&image);
    let image = head.stem(&mut graph, &image)?;
    let features = backbone::features(&mut graph, &config.backbone, &mut backbone, published, &image)?;
    let (mean, log_variance) = head.posterior(&mut graph, &features)?;
    backbone.finish(|name| published && backbone::is_beyond_the_features(config.backbone.kind, name))?;
    head.weights.finish(|_| false)?;
    head.others.finish(|_| false)?;
    let input = [Extent::Named("height".into()), Extent::Named("width".into()), Extent::Fixed(3)];
    let input = described("image", DataType::Uint8, input.to_vec());
    let outputs = [(mean.as_str(), "mean", LATENT), (log_variance.as_str(), "log_variance", LATENT)];
    let doc = format!("Encoder of {}: RGB bytes to a Gaussian over the scene latent", manifest.scenario.name);
    Ok(graph.finish("encoder", &doc, input, &outputs))
}

/// Writes the encoder of a checkpoint as an ONNX file, atomically.
pub fn save_encoder_onnx(dir: &Path, manifest: &Manifest, path: &Path) -> Result<(), InferenceError> {
    let bytes = encoder_onnx(dir, manifest)?;
    let partial = path.with_extension("partial");
    std::fs::write(&partial, bytes)
        .and_then(|()| std::fs::rename(&partial, path))
        .map_err(|source| InferenceError::File { path: path.into(), source })
}

/// The features of an image, and their shape.
struct Features {
    name: Name,
    channels: i64,
    grid: i64,
}

/// The encoder's trained layers around the backbone.
struct Head<'a> {
    weights: StoredWeights,
    others: StoredWeights,
    config: &'a EncoderConfig,
}

impl Head<'_> {
    /// The optional convolutional stem, whose result is added to the image.
    fn stem(&mut self, graph: &mut Builder, image: &str) -> Result<Name, InferenceError> {
        // 0..=255 to 0..=1.
        let unit = graph.number(1.0 / 255.0);
        let image = graph.node("Mul", &[image, &unit], Vec::new());
        let channels = self.config.stem_channels;
        if channels <= 0 {
            return Ok(image);
        }
        let first = graph.convolution(&mut self.weights, "stem.first", [channels, 3, 3, 3], 1)?;
        let x = graph.apply(first, &image);
        let x = graph.node("Relu", &[&x], Vec::new());
        let last = graph.convolution(&mut self.weights, "stem.last", [3, channels, 3, 3], 1)?;
        let x = graph.apply(last, &x);
        Ok(graph.node("Add", &[&image, &x], Vec::new()))
    }

    /// Mean and log-variance of the posterior.
    fn posterior(&mut self, graph: &mut Builder, features: &Features) -> Result<(Name, Name), InferenceError> {
        let &Features { ref name, channels, grid } = features;
        let &EncoderConfig { reduce_channels, pool_channels, hidden, .. } = self.config;
        let per_channel = [1, channels, 1, 1];
        let center = self.weights.take("head.center", &per_channel)?;
        let scale = self.weights.take("head.scale", &per_channel)?;
        let center = graph.weights("head.center", &center);
        let x = graph.node("Sub", &[name, &center], Vec::new());
        let scale = graph.weights("head.scale", &scale);
        let x = graph.node("Mul", &[&x, &scale], Vec::new());
        let reduce = graph.convolution(&mut self.weights, "head.reduce", [reduce_channels, channels, 1, 1], 1)?;
        let x = graph.apply(reduce, &x);
        let x = graph.node("Relu", &[&x], Vec::new());
        let pool = graph.convolution(&mut self.weights, "head.pool", [pool_channels, reduce_channels, 3, 3], 2)?;
        let x = graph.apply(pool, &x);
        let x = graph.node("Relu", &[&x], Vec::new());
        let x = graph.node("Flatten", &[&x], Vec::new());
        let side = (grid + 1) / 2;
        let x = self.linear(graph, &x, "head.hidden", pool_channels * side * side, hidden)?;
        let x = graph.node("Relu", &[&x], Vec::new());
        let mean = self.linear(graph, &x, "head.mean", hidden, LATENT)?;
        let log_variance = self.linear(graph, &x, "head.log_variance", hidden, LATENT)?;
        let (low, high) = EncoderConfig::LOG_VARIANCES;
        Ok((mean, graph.clip(&log_variance, low, high)))
    }

    fn linear(
        &mut self,
        graph: &mut Builder,
        x: &str,
        layer: &str,
        from: i64,
        to: i64,
    ) -> Result<Name, InferenceError> {
        let [weight, bias] = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
        let weights = self.weights.take(&weight, &[to, from])?;
        let biases = self.weights.take(&bias, &[to])?;
        let (weight, bias) = (graph.weights(&weight, &weights), graph.weights(&bias, &biases));
        Ok(graph.node("Gemm", &[x, &weight, &bias], vec![int("transB", 1)]))
    }
}

/// A convolution that is not yet applied.
struct Convolution {
    weight: Name,
    bias: Name,
    stride: i64,
    /// Pixels added at the top, left, bottom and right.
    pads: [i64; 4],
    groups: i64,
}

impl Builder {
    /// Adds the batch dimension in front.
    fn reshape_to_batch(&mut self, x: &str) -> Name {
        let axis = self.integers(&[0]);
        self.node("Unsqueeze", &[x, &axis], Vec::new())
    }

    /// A convolution with symmetric padding that keeps the size, up to the stride.
    fn convolution(
        &mut self,
        weights: &mut StoredWeights,
        layer: &str,
        shape: [i64; 4],
        stride: i64,
    ) -> Result<Convolution, InferenceError> {
        let [weight, bias] = ["weight", "bias"].map(|part| format!("{layer}.{part}"));
        let values = weights.take(&weight, &shape)?;
        let biases = weights.take(&bias, &shape[..1])?;
        let pad = shape[2] / 2;
        Ok(Convolution {
            weight: self.weights(&weight, &values),
            bias: self.weights(&bias, &biases),
            stride,
            pads: [pad; 4],
            groups: 1,
        })
    }

    fn apply(&mut self, convolution: Convolution, x: &str) -> Name {
        let Convolution { weight, bias, stride, pads, groups } = convolution;
        let attributes = vec![ints("strides", &[stride, stride]), ints("pads", &pads), int("group", groups)];
        self.node("Conv", &[x, &weight, &bias], attributes)
    }

    /// Resizes images to a square of `side` pixels, bilinearly. Where an axis shrinks, averaging removes detail finer
    /// than the new pixels; where it grows, that is ordinary bilinear interpolation.
    fn resize(&mut self, x: &str, side: i64) -> Name {
        let sizes = self.integers(&[1, 3, side, side]);
        let attributes = vec![
            text("mode", "linear"),
            text("coordinate_transformation_mode", "half_pixel"),
            int("antialias", 1),
            int("exclude_outside", 1),
        ];
        self.node("Resize", &[x, "", "", &sizes], attributes)
    }
}
