//! Images of unknown objects: the input, the best known state, the residual, and the boxes.

use crate::tables::spread;
use crate::{EvaluationError, Subject};
use carff_base::geometry::{OrientedBox, PinholeCamera};
use carff_dataset::Image;
use carff_decision::ImageEvidence;
use carff_plots::{StripCell, StripRow};
use carff_trials::Compared;
use carff_unknown::ResidualKind;
use std::path::Path;

/// Largest number of objects.
const ROWS: usize = 8;
/// Residual that is drawn white, in deviations of the image's noise.
const WHITE_DEVIATIONS: f32 = 12.0;
/// Colour of the boxes.
const BOX: [u8; 3] = [230, 30, 230];
/// Colour of the frame of images with something unknown.
const UNKNOWN: [u8; 3] = [236, 140, 20];
/// Steps along a drawn line for each pixel of its length.
const STEPS_PER_PX: f64 = 2.0;

/// Draws one row for each of at most eight objects; returns false if nothing is compared.
pub fn unknown_objects(subject: &Subject, path: &Path) -> Result<bool, EvaluationError> {
    let perception = subject.perception();
    let Some(known) = &perception.known else { return Ok(false) };
    let mut rows = Vec::new();
    // The first pose that has each in sight, with any result.
    let in_sight: Vec<usize> =
        (0..subject.novelties.len()).filter(|&i| !subject.novelties[i].views.is_empty()).collect();
    for index in spread(&in_sight, ROWS) {
        let novelty = &subject.novelties[index];
        let Some(view) = novelty.views.first() else { continue };
        let Some(compared) = known.compare(&view.camera, &view.image) else { continue };
        let evidence = ImageEvidence::new(&compared.seen.ratios);
        let unknown = evidence.unknown_probability();
        let place = if novelty.beside { "next to the road" } else { "on the road" };
        let boxes = compared.seen.boxes.len();
        let image = StripCell {
            emphasis: carff_decision::is_likely(unknown).then_some(UNKNOWN),
            ..StripCell::new(with_boxes(&view.image, &view.camera, &compared), &[format!("unknown {unknown:.2}")])
        };
        let best = subject.state_name(compared.best);
        let cells = vec![
            image,
            StripCell::new(enlarged(&rendered(&compared), &view.image), &["best state".into(), best]),
            StripCell::new(enlarged(&residual(&compared), &view.image), &["residual".into(), format!("{boxes} boxes")]),
        ];
        rows.push(StripRow { caption: vec![novelty.name.clone(), place.to_owned()], cells });
    }
    if rows.is_empty() {
        return Ok(false);
    }
    let subtitle = format!(
        "Orange frame: unknown with a probability of 0.5 or more. Only the lanes, with a margin, are compared. White in \
         the residual: {WHITE_DEVIATIONS} deviations."
    );
    carff_plots::filmstrip(path, &format!("{}: unknown objects", subject.posed.scenario.name), &subtitle, &rows)?;
    Ok(true)
}

/// The image with the boxes that were found.
fn with_boxes(image: &Image, camera: &PinholeCamera, compared: &Compared) -> Image {
    let mut drawn = image.clone();
    for unknown in &compared.seen.boxes {
        let oriented = OrientedBox { center: unknown.center, half_size: unknown.half_size, yaw: 0.0 };
        for [a, b] in oriented.edges() {
            if let Some(segment) = camera.project_segment(a, b) {
                line(&mut drawn, segment);
            }
        }
    }
    drawn
}

/// Draws the part of a line that the image shows.
fn line(image: &mut Image, [from, to]: [[f64; 2]; 2]) {
    let (width, height) = (f64::from(image.width_px), f64::from(image.height_px));
    let along = [to[0] - from[0], to[1] - from[1]];
    // A line from far outside has only a short part in the image.
    let steps = (along[0].hypot(along[1]) * STEPS_PER_PX).clamp(1.0, 1e5) as u32;
    for step in 0..=steps {
        let share = f64::from(step) / f64::from(steps);
        let [x, y] = [0, 1].map(|i| from[i] + share * along[i]);
        if (0.0..width).contains(&x) && (0.0..height).contains(&y) {
            let at = 3 * (y as usize * image.width_px as usize + x as usize);
            image.rgb[at..at + 3].copy_from_slice(&BOX);
        }
    }
}

/// The best state under the image's gain and offset.
fn rendered(compared: &Compared) -> Image {
    let fit = &compared.comparison.fit;
    let pixel = |(rgb, judged): (&[f32], &bool)| {
        let seen = if *judged { fit.seen(rgb) } else { [0.0; 3] };
        seen.map(|v| (255.0 * v) as u8)
    };
    of_size(compared, compared.rendered.chunks_exact(3).zip(&compared.comparison.judged).flat_map(pixel).collect())
}

/// The residual of the best state, the larger one of both kinds, black to white.
fn residual(compared: &Compared) -> Image {
    let [unexpected, missing] = ResidualKind::ALL.map(|kind| compared.comparison.residual(compared.best, kind));
    let larger = unexpected.iter().zip(missing).map(|(a, b)| a.max(*b));
    let grey = larger.flat_map(|r| [(255.0 * (r / WHITE_DEVIATIONS).clamp(0.0, 1.0)) as u8; 3]);
    of_size(compared, grey.collect())
}

/// Repeats pixels up to the size of another image.
fn enlarged(image: &Image, other: &Image) -> Image {
    let (width, height) = (other.width_px as usize, other.height_px as usize);
    let at = |i: usize, n: usize, of: u32| i * of as usize / n.max(1);
    let pixel = |i: usize| {
        let (x, y) = (at(i % width, width, image.width_px), at(i / width, height, image.height_px));
        let from = 3 * (y * image.width_px as usize + x);
        [image.rgb[from], image.rgb[from + 1], image.rgb[from + 2]]
    };
    let rgb = (0..width * height).flat_map(pixel).collect();
    Image { width_px: other.width_px, height_px: other.height_px, rgb }
}

fn of_size(compared: &Compared, rgb: Vec<u8>) -> Image {
    let camera = &compared.comparison.camera;
    Image { width_px: camera.width_px, height_px: camera.height_px, rgb }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Each pixel of a smaller image becomes a block.
    #[test]
    fn pixels_become_blocks() {
        let small = Image { width_px: 2, height_px: 1, rgb: vec![1, 2, 3, 4, 5, 6] };
        let large = enlarged(&small, &Image::filled(4, 2, [0; 3]));
        assert_eq!(large.rgb, [1, 2, 3, 1, 2, 3, 4, 5, 6, 4, 5, 6].repeat(2));
    }

    /// A line marks the pixels between its ends, and parts outside the image are left out.
    #[test]
    fn lines_are_clipped() {
        let mut image = Image { width_px: 8, height_px: 4, rgb: vec![0; 96] };
        line(&mut image, [[2.5, 1.5], [1e4, 1.5]]);
        let marked: Vec<usize> = (0..32).filter(|i| image.rgb[3 * i..3 * i + 3] == BOX).collect();
        assert_eq!(marked, [10, 11, 12, 13, 14, 15]);
        let before = image.clone();
        line(&mut image, [[-5.0, -5.0], [f64::NAN, 3.0]]);
        assert_eq!(image, before);
    }
}
