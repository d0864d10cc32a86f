//! Derives the observability of frames from their images, for datasets that do not contain it.

use crate::comparison::{ImageComparison, Pairs};
use crate::error::DatasetError;
use crate::image::Image;
use crate::scenario::Frame;
use carff_messages::Observability;
use rayon::prelude::*;

/// Observability of each frame; `None` without an image to compare with.
type Seen = Vec<Option<Observability>>;

/// Returns the observability of each frame by comparison with the other branches' images at its time step from its
/// view: `none` if all of them look the same, `full` if none does, else `partial`; `None` without another image. Images
/// of a camera are compared through their noise. The first error of an image is returned.
///
/// `image` loads the image of a frame. `valid` returns the test for pixels that the masks of two frames include.
pub(crate) fn seen_in_images<V: Fn(usize) -> bool>(
    frames: &[Frame],
    image: impl Fn(usize) -> Result<Image, DatasetError> + Sync,
    valid: impl Fn([usize; 2]) -> V + Sync,
) -> Result<Seen, DatasetError> {
    let view_count = frames.iter().filter_map(|frame| frame.view).max().map_or(0, |view| view + 1);
    let mut of_view: Vec<Vec<usize>> = vec![Vec::new(); view_count];
    for (i, frame) in frames.iter().enumerate() {
        if let Some(list) = frame.view.and_then(|view| of_view.get_mut(view)) {
            list.push(i);
        }
    }
    let compared = |comparison: ImageComparison| -> Result<(Seen, Pairs), DatasetError> {
        let of_views: Vec<(Seen, Pairs)> = of_view
            .par_iter()
            .map(|of_view| {
                let images: Vec<Image> = of_view.iter().map(|&i| image(i)).collect::<Result<_, _>>()?;
                let valid = |[a, b]: [usize; 2]| valid([of_view[a], of_view[b]]);
                let of_view: Vec<&Frame> = of_view.iter().map(|&i| &frames[i]).collect();
                let pairs = Pairs::of_view(&images.iter().collect::<Vec<_>>(), valid);
                Ok((seen_from_view(comparison, &of_view, &images, valid), pairs))
            })
            .collect::<Result<_, DatasetError>>()?;
        let mut all = vec![None; frames.len()];
        for (&frame, seen) in of_view.iter().flatten().zip(of_views.iter().flat_map(|(seen, _)| seen)) {
            all[frame] = *seen;
        }
        Ok((all, of_views.into_iter().map(|(_, pairs)| pairs).sum()))
    };
    let (seen, pairs) = compared(ImageComparison::Exact)?;
    match pairs.comparison() {
        ImageComparison::Exact => Ok(seen),
        ImageComparison::ThroughNoise => Ok(compared(ImageComparison::ThroughNoise)?.0),
    }
}

/// Returns the observability of frames whose images come from one view. `valid` returns the test for pixels that count
/// in two of the images.
fn seen_from_view<V: Fn(usize) -> bool>(
    comparison: ImageComparison,
    frames: &[&Frame],
    images: &[Image],
    valid: impl Fn([usize; 2]) -> V,
) -> Seen {
    let mut found = vec![(0, 0); frames.len()];
    for [a, b] in (0..frames.len()).flat_map(|a| (0..a).map(move |b| [a, b])) {
        if frames[a].timestamp != frames[b].timestamp || frames[a].branch == frames[b].branch {
            continue;
        }
        let same = comparison.same(&images[a], &images[b], valid([a, b]));
        for i in [a, b] {
            found[i].0 += usize::from(same);
            found[i].1 += usize::from(!same);
        }
    }
    let seen = found.into_iter().map(|(alike, different)| match (alike, different) {
        (0, 0) => None,
        (0, _) => Some(Observability::Full),
        (_, 0) => Some(Observability::None),
        _ => Some(Observability::Partial),
    });
    seen.collect()
}
