//! Visual equivalence of states per view, and the accuracy limit that follows from it.

use crate::comparison::{ImageComparison, Pairs};
use crate::dataset::Dataset;
use crate::image::{Image, looks_same};
use rayon::prelude::*;

/// Visual equivalence of states, per view.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Equivalence {
    states: usize,
    /// Flags of views x states x states.
    same: Vec<bool>,
}

impl Equivalence {
    /// Takes the truth of `alike_states` where frames have it, and compares images where they do not. Only for
    /// evaluation: [`Self::from_images`] is what training may know. `images` are those of [`Dataset::load_all_images`].
    pub fn from_dataset(dataset: &Dataset, images: &[Image]) -> Self {
        let known = dataset.frames().iter().all(|frame| frame.alike_states.is_some());
        let comparison = if known { ImageComparison::Exact } else { Self::comparison(dataset, images) };
        let mut all = Self::between(dataset, images, |a, b| {
            let (of_a, of_b) = (&dataset.frames()[a], &dataset.frames()[b]);
            let known = of_a.alike_states.as_ref().zip(of_b.state).map(|(alike, state)| alike.contains(&state));
            known.unwrap_or_else(|| comparison.same(&images[a], &images[b], dataset.valid_in_all(&[a, b])))
        });
        // States without an image of their own from the view.
        for frame in dataset.frames() {
            if let (Some(view), Some(alike)) = (frame.view, &frame.alike_states) {
                all.join(view, alike);
            }
        }
        all
    }

    /// Makes states look the same from a view.
    fn join(&mut self, view: usize, alike: &[usize]) {
        for (&a, &b) in alike.iter().flat_map(|a| alike.iter().map(move |b| (a, b))) {
            if let Some(same) = self.same.get_mut((view * self.states + a) * self.states + b) {
                *same = true;
            }
        }
    }

    /// Takes over what `other` has for its view `from`, which is of the same pose and the same states.
    pub fn adopt(&mut self, view: usize, other: &Self, from: usize) {
        let row = self.states * self.states;
        if let Some(of_other) = other.same.get(from * row..(from + 1) * row)
            && let Some(own) = self.same.get_mut(view * row..(view + 1) * row)
        {
            own.copy_from_slice(of_other);
        }
    }

    /// Returns the comparison that a dataset's images need. `images` are those of [`Dataset::load_all_images`].
    pub fn comparison(dataset: &Dataset, images: &[Image]) -> ImageComparison {
        let mut of_view: Vec<Vec<usize>> = vec![Vec::new(); dataset.view_count()];
        for (i, frame) in dataset.frames().iter().enumerate().take(images.len()) {
            if let Some(view) = frame.view {
                of_view[view].push(i);
            }
        }
        let count = |frames: &Vec<usize>| {
            let of_view: Vec<&Image> = frames.iter().map(|&i| &images[i]).collect();
            Pairs::of_view(&of_view, |[a, b]| dataset.valid_in_all(&[frames[a], frames[b]]))
        };
        of_view.par_iter().map(count).sum::<Pairs>().comparison()
    }

    /// Compares all pairs of states in each view, in the pixels that are valid in both images. `images` are those of
    /// [`Dataset::load_all_images`]. A state without an image in a view is only equivalent to itself.
    pub fn from_images(dataset: &Dataset, images: &[Image], comparison: ImageComparison) -> Self {
        Self::between(dataset, images, |a, b| comparison.same(&images[a], &images[b], dataset.valid_in_all(&[a, b])))
    }

    fn between(dataset: &Dataset, images: &[Image], alike: impl Fn(usize, usize) -> bool + Sync) -> Self {
        let (views, states) = (dataset.view_count(), dataset.state_count());
        let mut frames = vec![vec![None; states]; views];
        for (i, frame) in dataset.frames().iter().enumerate().take(images.len()) {
            if let (Some(view), Some(state)) = (frame.view, frame.state) {
                frames[view][state] = Some(i);
            }
        }
        Self::of(states, &frames, |&a, &b| alike(a, b))
    }

    /// Compares all pairs of states in each view; `images` has a row of `states` images per view.
    pub fn of_images(states: usize, images: &[Vec<Option<&Image>>]) -> Self {
        Self::of(states, images, |a, b| looks_same(a, b))
    }

    fn of<T: Sync>(states: usize, rows: &[Vec<Option<T>>], alike: impl Fn(&T, &T) -> bool + Sync) -> Self {
        let same = rows
            .par_iter()
            .flat_map_iter(|of_view| {
                let of = |state: usize| of_view.get(state).and_then(Option::as_ref);
                let mut same = vec![false; states * states];
                for a in 0..states {
                    same[a * states + a] = true;
                    for b in 0..a {
                        let equal = of(a).zip(of(b)).is_some_and(|(a, b)| alike(a, b));
                        same[a * states + b] = equal;
                        same[b * states + a] = equal;
                    }
                }
                same
            })
            .collect();
        Self { states, same }
    }

    /// Returns true if states `a` and `b` look the same from `view`. Out of range, only equal indices do.
    pub fn same(&self, view: usize, a: usize, b: usize) -> bool {
        if a >= self.states || b >= self.states {
            return a == b;
        }
        self.same.get((view * self.states + a) * self.states + b).copied().unwrap_or(a == b)
    }

    /// Returns the states that look like `state` from `view`, including itself.
    pub fn alike(&self, view: usize, state: usize) -> impl Iterator<Item = usize> + '_ {
        (0..self.states).filter(move |&other| self.same(view, other, state))
    }

    /// Returns the number of states that look like `state` from `view`, including itself: at least 1.
    fn class_size(&self, view: usize, state: usize) -> usize {
        self.alike(view, state).count().max(1)
    }

    /// Returns the best mean accuracy of naming the state from an image, over the given (view, state) pairs: the mean
    /// of 1 / class size. `None` if there are no pairs.
    pub fn ceiling(&self, pairs: impl IntoIterator<Item = (usize, usize)>) -> Option<f64> {
        let (mut sum, mut count) = (0.0, 0_usize);
        for (view, state) in pairs {
            sum += 1.0 / self.class_size(view, state) as f64;
            count += 1;
        }
        (count > 0).then(|| sum / count as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// One view of three states, of which two look the same: class sizes 2, 2, 1, ceiling (1/2 + 1/2 + 1) / 3.
    #[test]
    fn ceiling_of_a_known_case() {
        let e = Equivalence { states: 3, same: vec![true, true, false, true, true, false, false, false, true] };
        assert_eq!([0, 1, 2].map(|s| e.class_size(0, s)), [2, 2, 1]);
        assert_eq!(e.alike(0, 1).collect::<Vec<_>>(), [0, 1]);
        let ceiling = e.ceiling((0..3).map(|s| (0, s))).unwrap();
        assert!((ceiling - 2.0 / 3.0).abs() < 1e-12);
        assert_eq!(e.ceiling([]), None);
        assert!(e.same(0, 0, 1) && !e.same(0, 0, 2) && e.same(9, 5, 5) && !e.same(9, 0, 1));
    }

    /// A view takes over another's classes; a view that is not there changes nothing.
    #[test]
    fn a_view_takes_over_another() {
        let other = Equivalence { states: 2, same: vec![true, false, false, true, true, true, true, true] };
        let mut own = Equivalence { states: 2, same: vec![true, false, false, true] };
        own.adopt(0, &other, 1);
        assert!(own.same(0, 0, 1));
        own.adopt(0, &other, 2);
        own.adopt(1, &other, 0);
        assert!(own.same(0, 0, 1));
        own.adopt(0, &other, 0);
        assert!(!own.same(0, 0, 1));
        own.join(0, &[0, 1, 7]);
        assert!(own.same(0, 1, 0));
    }
}
