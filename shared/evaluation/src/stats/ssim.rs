//! Structural similarity of two images.

/// Half the side of a window of [`ssim`], pixels, and the deviation of its Gaussian weights.
const SSIM_REACH: usize = 5;
const SSIM_SIGMA: f64 = 1.5;

/// Structural similarity (Wang et al. 2004) of interleaved RGB images in 0..=1 with rows of `width_px` pixels: mean
/// over all 11x11 windows inside the image and over the channels, -1..=1. `None` for different sizes, or smaller than a
/// window.
pub fn ssim(image: &[f32], truth: &[f32], width_px: usize) -> Option<f64> {
    let side = 2 * SSIM_REACH + 1;
    let rows = image.len() / (3 * width_px.max(1));
    if image.len() != truth.len() || rows * width_px * 3 != image.len() || rows < side || width_px < side {
        return None;
    }
    let weights: Vec<f64> =
        (0..side).map(|i| (-(i as f64 - SSIM_REACH as f64).powi(2) / (2.0 * SSIM_SIGMA.powi(2))).exp()).collect();
    let total: f64 = weights.iter().sum();
    let blurred = |value: &dyn Fn(usize) -> f64| -> Vec<f64> {
        let across: Vec<f64> = (0..rows)
            .flat_map(|y| (0..=width_px - side).map(move |x| y * width_px + x))
            .map(|first| weights.iter().enumerate().map(|(i, w)| w * value(first + i)).sum::<f64>() / total)
            .collect();
        let width = width_px - side + 1;
        (0..(rows - side + 1) * width)
            .map(|at| weights.iter().enumerate().map(|(i, w)| w * across[at + i * width]).sum::<f64>() / total)
            .collect()
    };
    let [c1, c2] = [0.01_f64.powi(2), 0.03_f64.powi(2)];
    let (mut sum, mut count) = (0.0, 0_usize);
    for channel in 0..3 {
        let a = |pixel: usize| f64::from(image[pixel * 3 + channel]);
        let b = |pixel: usize| f64::from(truth[pixel * 3 + channel]);
        let (mean_a, mean_b) = (blurred(&a), blurred(&b));
        let (aa, bb) = (blurred(&|i| a(i) * a(i)), blurred(&|i| b(i) * b(i)));
        let ab = blurred(&|i| a(i) * b(i));
        for i in 0..ab.len() {
            let (ma, mb) = (mean_a[i], mean_b[i]);
            let (va, vb, cov) = (aa[i] - ma * ma, bb[i] - mb * mb, ab[i] - ma * mb);
            sum += (2.0 * ma * mb + c1) * (2.0 * cov + c2) / ((ma * ma + mb * mb + c1) * (va + vb + c2));
        }
        count += ab.len();
    }
    Some(sum / count as f64)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Equal images have 1. Two uniform images have the closed form of their brightness. Noise has less than a small
    /// shift. Different sizes, and images smaller than a window, have none.
    #[test]
    fn ssim_is_the_textbook_one() {
        let noise = |seed: usize| -> Vec<f32> {
            (0..20 * 16 * 3).map(|i| ((i * 7919 + seed * 104_729) % 1009) as f32 / 1009.0).collect()
        };
        assert!((ssim(&noise(1), &noise(1), 20).unwrap() - 1.0).abs() < 1e-9);
        let even = |v: f32| vec![v; 20 * 16 * 3];
        let (a, b) = (f64::from(0.2_f32), f64::from(0.6_f32));
        let closed = (2.0 * a * b + 1e-4) / (a * a + b * b + 1e-4);
        assert!((ssim(&even(0.2), &even(0.6), 20).unwrap() - closed).abs() < 1e-6);
        let lighter: Vec<f32> = noise(1).iter().map(|v| v + 0.05).collect();
        assert!(ssim(&noise(1), &lighter, 20).unwrap() > ssim(&noise(1), &noise(2), 20).unwrap() + 0.3);
        assert_eq!(ssim(&even(0.2)[..20 * 10 * 3], &even(0.2)[..20 * 10 * 3], 20), None);
        assert_eq!(ssim(&even(0.2), &even(0.2)[..60], 20), None);
    }
}
