//! How two images of one pose are compared: exactly, or through the noise of a camera.

use crate::dataset::Dataset;
use crate::image::{Image, looks_same_where};
use rayon::prelude::*;
use std::iter::Sum;
use std::ops::Add;

/// Largest difference of nearly equal pixels, of 255: less than a camera's noise.
const NEARLY: u8 = 2;

/// How two images of one pose are compared. A dataset has one comparison for all its images.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Comparison {
    /// By [`looks_same_where`]: images without noise.
    Exact,
    /// By [`carff_unknown::shows_same`]: images of a camera.
    ThroughNoise,
}

impl Comparison {
    /// Returns the comparison that a dataset's images need: [`Self::ThroughNoise`] if in most pairs of images of a view
    /// less than half of the pixels are nearly equal. Rendered images of one pose are equal wherever nothing changes.
    /// `images` are those of [`Dataset::load_all_images`].
    pub fn of(dataset: &Dataset, images: &[Image]) -> Self {
        let mut of_view: Vec<Vec<usize>> = vec![Vec::new(); dataset.view_count()];
        for (i, frame) in dataset.frames().iter().enumerate().take(images.len()) {
            if let Some(view) = frame.view {
                of_view[view].push(i);
            }
        }
        let count = |frames: &Vec<usize>| -> Pairs {
            let pairs = frames.iter().enumerate().flat_map(|(i, &a)| frames[..i].iter().map(move |&b| (a, b)));
            pairs.map(|(a, b)| Pairs::one(&images[a], &images[b], dataset.valid_in_all(&[a, b]))).sum()
        };
        of_view.par_iter().map(count).sum::<Pairs>().comparison()
    }

    /// Returns true if two images show the same in the pixels that count, by index row by row.
    pub fn same(self, a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> bool {
        match (self, a.view().zip(b.view())) {
            (Self::ThroughNoise, Some((a, b))) => carff_unknown::shows_same(a, b, counts),
            _ => looks_same_where(a, b, counts),
        }
    }
}

/// Counts of pairs of images, by which their comparison is chosen.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Pairs {
    all: usize,
    mostly_equal: usize,
}

impl Pairs {
    /// Returns the count of one pair; at least half of the pixels that count are nearly equal in a mostly equal one.
    pub(crate) fn one(a: &Image, b: &Image, counts: impl Fn(usize) -> bool) -> Self {
        let (mut equal, mut all) = (0, 0);
        let pixels = a.rgb.chunks_exact(3).zip(b.rgb.chunks_exact(3)).enumerate();
        for (_, (a, b)) in pixels.filter(|(i, _)| counts(*i)) {
            equal += usize::from(a.iter().zip(b).all(|(a, b)| a.abs_diff(*b) <= NEARLY));
            all += 1;
        }
        Self { all: 1, mostly_equal: usize::from(2 * equal >= all) }
    }

    /// Returns the comparison that such images need.
    pub(crate) fn comparison(self) -> Comparison {
        if 2 * self.mostly_equal < self.all { Comparison::ThroughNoise } else { Comparison::Exact }
    }
}

impl Add for Pairs {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        Self { all: self.all + other.all, mostly_equal: self.mostly_equal + other.mostly_equal }
    }
}

impl Sum for Pairs {
    fn sum<I: Iterator<Item = Self>>(pairs: I) -> Self {
        pairs.fold(Self::default(), Self::add)
    }
}
