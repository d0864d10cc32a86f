//! Tables of `carff eval`.

pub mod encoder;
pub mod field;
pub mod forecast;
pub mod horizon;
pub mod localisation;
pub mod memory;
pub mod planning;
pub mod robustness;
pub mod trials;
pub mod vehicles;

/// At most `count` entries, evenly spread.
pub fn spread(all: &[usize], count: usize) -> Vec<usize> {
    let n = all.len().min(count);
    (0..n).map(|i| all[i * all.len() / n]).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A short list is kept; of a long one, evenly spread entries are kept, beginning with the first.
    #[test]
    fn spread_is_even() {
        assert_eq!(spread(&[3, 5], 4), [3, 5]);
        assert_eq!(spread(&(0..100).collect::<Vec<_>>(), 4), [0, 25, 50, 75]);
        assert!(spread(&[], 4).is_empty());
    }
}
