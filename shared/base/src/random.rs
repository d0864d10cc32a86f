//! Counter-based random streams, one per draw of a run.
//!
//! A stream is named by (run seed, frame, step, sample). So a draw does not depend on earlier draws, on its thread or
//! process, or on skipped frames.
//!
//! ```
//! let a = carff_base::random::gaussians::<8>(carff_base::random::Key { seed: 7, frame: 3, step: 1, sample: 0 });
//! let b = carff_base::random::gaussians::<8>(carff_base::random::Key { seed: 7, frame: 3, step: 1, sample: 0 });
//! assert_eq!(a, b);
//! ```

use rand::{Rng, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Name of a stream.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub struct Key {
    /// The run's seed.
    pub seed: u64,
    /// Frame number in the run.
    pub frame: u64,
    /// Horizon step, or any other small index of the user's.
    pub step: u32,
    /// Sample index.
    pub sample: u32,
}

impl Key {
    /// Returns the key of one purpose's stream: its step is the purpose's name, at most four ASCII characters.
    ///
    /// ```
    /// let key = carff_base::random::Key::named("mdn", 7, 3);
    /// assert_eq!((key.seed, key.frame, key.step, key.sample), (7, 3, 0x6d64_6e00, 0));
    /// ```
    ///
    /// # Panics
    ///
    /// A longer name panics, or is a compile error in a constant.
    pub const fn named(purpose: &str, seed: u64, frame: u64) -> Self {
        assert!(purpose.len() <= 4, "a purpose in a key's step has at most four characters");
        Self { seed, frame, step: (tag(purpose) >> 32) as u32, sample: 0 }
    }
}

/// Returns the number of a purpose's name: at most eight ASCII characters, the first in the highest byte.
///
/// ```
/// assert_eq!(carff_base::random::tag("svm fold"), 0x7376_6d20_666f_6c64);
/// ```
///
/// # Panics
///
/// A longer name panics, or is a compile error in a constant.
pub const fn tag(purpose: &str) -> u64 {
    let name = purpose.as_bytes();
    assert!(name.len() <= 8, "a purpose has at most eight characters");
    let (mut number, mut i) = (0, 0);
    while i < 8 {
        number = number << 8 | if i < name.len() { name[i] as u64 } else { 0 };
        i += 1;
    }
    number
}

/// Returns the stream of a key.
pub fn stream(key: Key) -> ChaCha8Rng {
    let mut seed = [0_u8; 32];
    seed[0..8].copy_from_slice(&key.seed.to_le_bytes());
    seed[8..16].copy_from_slice(&key.frame.to_le_bytes());
    seed[16..20].copy_from_slice(&key.step.to_le_bytes());
    seed[20..24].copy_from_slice(&key.sample.to_le_bytes());
    ChaCha8Rng::from_seed(seed)
}

/// Returns `N` independent draws from the standard normal distribution.
pub fn gaussians<const N: usize>(key: Key) -> [f32; N] {
    let mut rng = stream(key);
    std::array::from_fn(|_| rng.sample(StandardNormal))
}

/// Returns a uniform draw in [0, 1).
pub fn uniform(key: Key) -> f64 {
    stream(key).random()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each part of the key changes the stream.
    #[test]
    fn every_part_of_the_key_counts() {
        let base = Key { seed: 1, frame: 2, step: 3, sample: 4 };
        let others =
            [Key { seed: 2, ..base }, Key { frame: 3, ..base }, Key { step: 4, ..base }, Key { sample: 5, ..base }];
        for other in others {
            assert_ne!(gaussians::<8>(base), gaussians::<8>(other));
        }
    }

    /// Draws over samples have the moments of a standard normal (4000 x 8 draws, 5 standard errors).
    #[test]
    fn gaussians_have_unit_variance() {
        let draws: Vec<f32> =
            (0..4000).flat_map(|sample| gaussians::<8>(Key { seed: 9, frame: 0, step: 0, sample })).collect();
        let n = draws.len() as f32;
        let mean = draws.iter().sum::<f32>() / n;
        let variance = draws.iter().map(|v| (v - mean).powi(2)).sum::<f32>() / n;
        assert!(mean.abs() < 5.0 / n.sqrt());
        assert!((variance - 1.0).abs() < 5.0 * (2.0 / n).sqrt());
    }
}
