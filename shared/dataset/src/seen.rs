//! Derives the observability of frames from their images, for datasets that do not contain it.

use crate::error::DatasetError;
use crate::image::{Image, looks_same_where};
use crate::scenario::Frame;
use carff_messages::Observability;
use rayon::prelude::*;

/// Returns the observability of each frame by comparison with the other branches' images at its time step from its
/// view: `none` if all of them look the same, `full` if none does, else `partial`; `None` without another image. The
/// first error of an image is returned.
///
/// `image` loads the image of a frame. `valid` returns the test for pixels that the masks of two frames include.
pub(crate) fn told_by_images<V: Fn(usize) -> bool>(
    frames: &[Frame],
    image: impl Fn(usize) -> Result<Image, DatasetError> + Sync,
    valid: impl Fn([usize; 2]) -> V + Sync,
) -> Result<Vec<Option<Observability>>, DatasetError> {
    let view_count = frames.iter().filter_map(|frame| frame.view).max().map_or(0, |view| view + 1);
    let mut of_view: Vec<Vec<usize>> = vec![Vec::new(); view_count];
    for (i, frame) in frames.iter().enumerate() {
        if let Some(list) = frame.view.and_then(|view| of_view.get_mut(view)) {
            list.push(i);
        }
    }
    let told: Vec<Vec<(usize, Option<Observability>)>> = of_view
        .par_iter()
        .map(|of_view| {
            let images: Vec<Image> = of_view.iter().map(|&i| image(i)).collect::<Result<_, _>>()?;
            let frame_of = |place: usize| &frames[of_view[place]];
            let tell = |own: usize| {
                let (branch, timestamp) = (frame_of(own).branch, frame_of(own).timestamp);
                let others = (0..of_view.len())
                    .filter(|&other| frame_of(other).timestamp == timestamp && frame_of(other).branch != branch);
                let (alike, different): (Vec<usize>, Vec<usize>) = others.partition(|&other| {
                    let valid = valid([of_view[own], of_view[other]]);
                    looks_same_where(&images[own], &images[other], valid)
                });
                match (alike.is_empty(), different.is_empty()) {
                    (true, true) => None,
                    (true, false) => Some(Observability::Full),
                    (false, true) => Some(Observability::None),
                    (false, false) => Some(Observability::Partial),
                }
            };
            Ok((0..of_view.len()).map(|own| (of_view[own], tell(own))).collect())
        })
        .collect::<Result<_, DatasetError>>()?;
    let mut all = vec![None; frames.len()];
    for (frame, observability) in told.into_iter().flatten() {
        all[frame] = observability;
    }
    Ok(all)
}
