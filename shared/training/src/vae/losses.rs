//! Loss terms of the pose-conditional VAE.

use crate::config::VaeTraining;
use carff_evaluation::changed_pixels;
use tch::{Kind, Tensor};

/// Draws from Gaussians with means and log-variances `[N, 8]`, given standard normal `noise` `[N, 8]`. Gradients reach
/// both inputs (Kingma and Welling 2014).
pub fn reparameterised(mean: &Tensor, log_variance: &Tensor, noise: &Tensor) -> Tensor {
    mean + (log_variance * 0.5).exp() * noise
}

/// Mean squared error of decoded images `[N, 3, H, W]`, times ten. Pixels of `targets` that differ from `means`, the
/// mean images of the poses, have the weight `foreground_weight`; pixels outside of `valid` `[N, 1, H, W]` have none. The
/// decoder's target is the residual over the mean image where `residual` is set, else the image.
pub fn reconstruction_error(
    made: &Tensor,
    targets: &Tensor,
    means: &Tensor,
    valid: Option<&Tensor>,
    settings: &VaeTraining,
) -> Tensor {
    let residual = targets - means;
    let weight = changed_pixels(&residual) * (settings.foreground_weight - 1.0) + 1.0;
    let weight = valid.map_or_else(|| weight.shallow_clone(), |valid| &weight * valid);
    let wanted = if settings.residual { &residual } else { targets };
    ((made - wanted).square() * weight).mean(Kind::Float) * 10.0
}

/// Mean over the batch of the cross entropy of `logits` `[N, S]` with the `wanted` distributions `[N, S]`.
pub fn cross_entropy(logits: &Tensor, wanted: &Tensor) -> Tensor {
    let log = logits.log_softmax(-1, Kind::Float);
    -(wanted * log).sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float).mean(Kind::Float)
}

/// Mean over the batch of KL(N(mean, exp(log variance)) || N(0, 1)), summed over dimensions. Inputs `[N, 8]`.
pub fn kl_divergence(mean: &Tensor, log_variance: &Tensor) -> Tensor {
    ((mean.square() + log_variance.exp() - log_variance - 1.0) * 0.5)
        .sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float)
        .mean(Kind::Float)
}

/// Supervised contrastive loss (Khosla et al. 2020) of normalised means `[N, 8]` with state numbers `[N]`.
pub fn contrastive(mean: &Tensor, states: &Tensor, temperature: f64) -> Tensor {
    let n = mean.size()[0];
    let unit = mean / (mean.square().sum_dim_intlist([-1_i64].as_slice(), true, Kind::Float) + 1e-8).sqrt();
    let eye = Tensor::eye(n, (Kind::Float, mean.device()));
    let others = eye.ones_like() - eye;
    let positive = states.unsqueeze(0).eq_tensor(&states.unsqueeze(1)).to_kind(Kind::Float) * &others;
    let logits: Tensor = unit.matmul(&unit.transpose(0, 1)) / temperature - (others.ones_like() - &others) * 1e9;
    let log = logits.log_softmax(-1, Kind::Float);
    let count = positive.sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float);
    let sum = (log * positive).sum_dim_intlist([-1_i64].as_slice(), false, Kind::Float);
    -(sum / count.clamp_min(1.0)).mean(Kind::Float)
}

#[cfg(test)]
mod tests {
    use super::*;
    use tch::Device;

    /// The divergence is the closed form: zero for the standard normal, and 8 * (0.5 m^2) for a mean of m.
    #[test]
    fn kl_is_the_closed_form() {
        let zero = Tensor::zeros([2, 8], (Kind::Float, Device::Cpu));
        assert!(kl_divergence(&zero, &zero).double_value(&[]).abs() < 1e-6);
        assert!((kl_divergence(&(&zero + 0.5), &zero).double_value(&[]) - 1.0).abs() < 1e-5);
    }

    /// Pixels that are not valid have no weight and no gradient.
    #[test]
    fn masked_pixels_have_no_loss() {
        let images = |value: f64| Tensor::zeros([2, 3, 4, 4], (Kind::Float, Device::Cpu)) + value;
        let settings = VaeTraining::default();
        let valid = Tensor::ones([2, 1, 4, 4], (Kind::Float, Device::Cpu));
        let _ = valid.narrow(3, 2, 2).fill_(0.0);
        let made = images(0.5).set_requires_grad(true);
        let loss = |valid| reconstruction_error(&made, &images(0.2), &images(0.2), valid, &settings);
        let (whole, half) = (loss(None).double_value(&[]), loss(Some(&valid)));
        assert!((half.double_value(&[]) - whole / 2.0).abs() < 1e-6);
        half.backward();
        assert_eq!(made.grad().narrow(3, 2, 2).abs().max().double_value(&[]), 0.0);
        assert!(made.grad().narrow(3, 0, 2).abs().min().double_value(&[]) > 0.0);
    }

    /// Views of one state closer together, states further apart: a smaller loss.
    #[test]
    fn contrastive_prefers_clusters() {
        let states = Tensor::from_slice(&[0_i64, 0, 1, 1]);
        let of = |rows: [[f32; 2]; 4]| {
            let flat: Vec<f32> = rows.iter().flat_map(|r| [r[0], r[1], 0.0, 0.0, 0.0, 0.0, 0.0, 0.0]).collect();
            contrastive(&Tensor::from_slice(&flat).view([4, 8]), &states, 0.2).double_value(&[])
        };
        let clustered = of([[1.0, 0.0], [1.0, 0.1], [-1.0, 0.0], [-1.0, 0.1]]);
        let mixed = of([[1.0, 0.0], [-1.0, 0.1], [-1.0, 0.0], [1.0, 0.1]]);
        assert!(clustered < 0.1 && mixed > 1.0, "{clustered} {mixed}");
    }
}
