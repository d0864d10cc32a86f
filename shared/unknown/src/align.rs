//! Moves an image to where its place is rendered: small errors of the camera's pose, or of its lens.

use crate::fit::least_squares;
use carff_field::Displacement;
use ndarray::{ArrayView2, ArrayView3, Axis, s};

/// Terms of the affine map from rendered to seen pixels, for each axis.
const TERMS: usize = 3;
/// Largest number of steps of the search for the map.
const STEPS: usize = 15;
/// Smallest change of a term in a step, pixels: the search then ends.
const SMALL_STEP_PX: f32 = 0.03;
/// Largest change of a term in a step, pixels.
const LARGE_STEP_PX: f32 = 2.0;
/// Largest distance between a rendered and a seen pixel along an axis, as a share of the view's longer side.
const FARTHEST: f32 = 0.12;
/// Distance between the first guesses of a shift, pixels.
const GUESS_PX: i32 = 2;
/// Largest difference that counts for a guess, of 1.
const GUESS_CAP: f32 = 0.15;
/// Largest difference that counts in a step, of 1, and half the distance over which slopes are measured, pixels: of the
/// first step, and of the last ones.
const COARSE: [f32; 2] = [0.3, 2.0];
const FINE: [f32; 2] = [0.08, 0.5];
/// Factor of both from step to step.
const FINER: f32 = 0.8;

/// An image, 0..=1, RGB, row by row.
#[derive(Clone, Copy)]
pub(crate) struct View<'a> {
    pub rgb: &'a [f32],
    pub width: usize,
    pub height: usize,
}

/// Returns the means of an image (height, width, channel) over the cells of a grid: RGB, 0..=1, row by row, `width` x
/// `height`.
pub fn reduced(image: ArrayView3<'_, u8>, width: usize, height: usize) -> Vec<f32> {
    let mean = |values: ArrayView2<'_, u8>| {
        values.iter().map(|v| f32::from(*v)).sum::<f32>() / (values.len().max(1) as f32 * 255.0)
    };
    of_cells(image, width, height, mean)
}

/// Returns what [`reduced`] does, without the largest and the smallest value of a cell: a dead pixel does not count.
pub(crate) fn reduced_without_specks(image: ArrayView3<'_, u8>, width: usize, height: usize) -> Vec<f32> {
    of_cells(image, width, height, trimmed_mean)
}

fn of_cells(
    image: ArrayView3<'_, u8>,
    width: usize,
    height: usize,
    value: impl Fn(ArrayView2<'_, u8>) -> f32,
) -> Vec<f32> {
    let (rows, columns, _) = image.dim();
    let cell = |i: usize, n: usize, all: usize| {
        let start = (i * all / n).min(all.saturating_sub(1));
        start..((i + 1) * all / n).clamp(start + 1, all.max(start + 1))
    };
    let mut out = Vec::with_capacity(width * height * 3);
    for y in 0..height {
        for x in 0..width {
            let part = image.slice(s![cell(y, height, rows), cell(x, width, columns), ..]);
            out.extend(part.axis_iter(Axis(2)).take(3).map(&value));
        }
    }
    out
}

/// Mean of values, 0..=1, without the largest and the smallest one of at least four: a dead pixel does not count.
fn trimmed_mean(values: ArrayView2<'_, u8>) -> f32 {
    let sum: u32 = values.iter().map(|v| u32::from(*v)).sum();
    let ends = values.iter().fold([u8::MAX, 0], |[low, high], v| [low.min(*v), high.max(*v)]).map(u32::from);
    let (sum, count) = match values.len() {
        0..4 => (sum, values.len()),
        all => (sum - ends[0] - ends[1], all - 2),
    };
    sum as f32 / (255.0 * count.max(1) as f32)
}

/// Brightness of an image, row by row.
struct Brightness {
    values: Vec<f32>,
    width: usize,
    height: usize,
}

/// The maps that are searched.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Maps {
    /// All affine maps: errors of a lens too.
    Affine,
    /// Shifts and turns: small rotations of the camera.
    Rigid,
}

/// Affine map from a rendered pixel to the seen one: for each axis the shift, and its change along both axes from the
/// middle of the view to the end of its longer side, pixels.
#[derive(Clone, Copy, Debug, PartialEq)]
struct AffineMap([[f32; TERMS]; 2]);

/// Pixels and weights of a value between four pixels.
type Between = [(usize, f32); 4];

/// Returns how to interpolate at a position, or `None` outside the view.
fn between([u, v]: [f32; 2], width: usize, height: usize) -> Option<Between> {
    let (right, bottom) = ((width - 1) as f32, (height - 1) as f32);
    let is_inside = |v: f32, last: f32| v >= -0.5 && v <= last + 0.5;
    if !is_inside(u, right) || !is_inside(v, bottom) {
        return None;
    }
    let (u, v) = (u.clamp(0.0, right), v.clamp(0.0, bottom));
    let (x, y) = (u as usize, v as usize);
    let (x1, y1) = ((x + 1).min(width - 1), (y + 1).min(height - 1));
    let (fx, fy) = (u - x as f32, v - y as f32);
    Some([
        (y * width + x, (1.0 - fx) * (1.0 - fy)),
        (y * width + x1, fx * (1.0 - fy)),
        (y1 * width + x, (1.0 - fx) * fy),
        (y1 * width + x1, fx * fy),
    ])
}

impl Brightness {
    fn of(rgb: &[f32], width: usize, height: usize) -> Self {
        Self { values: rgb.chunks_exact(3).map(|rgb| rgb.iter().sum::<f32>() / 3.0).collect(), width, height }
    }

    fn at(&self, position: [f32; 2]) -> Option<f32> {
        let of = between(position, self.width, self.height)?;
        Some(of.iter().map(|&(i, weight)| weight * self.values[i]).sum())
    }

    /// Change along both axes, a pixel; 0 at the border.
    fn slopes(&self, [u, v]: [f32; 2], px: f32) -> [f32; 2] {
        let change = |low, high| Some((self.at(high)? - self.at(low)?) / (2.0 * px));
        [change([u - px, v], [u + px, v]), change([u, v - px], [u, v + px])].map(Option::unwrap_or_default)
    }
}

impl AffineMap {
    /// Position that a rendered pixel is seen at, and the terms of the map there.
    fn seen(&self, i: usize, (width, height): (usize, usize)) -> ([f32; 2], [f32; TERMS]) {
        let half = width.max(height) as f32 / 2.0;
        let (x, y) = ((i % width) as f32, (i / width) as f32);
        let terms = [1.0, (x + 0.5 - width as f32 / 2.0) / half, (y + 0.5 - height as f32 / 2.0) / half];
        let by = self.0.map(|axis| axis.iter().zip(terms).map(|(factor, term)| factor * term).sum::<f32>());
        ([x + by[0], y + by[1]], terms)
    }

    /// Largest distance that a corner of the view moves along an axis.
    fn farthest(&self) -> f32 {
        self.0.iter().map(|[shift, a, b]| shift.abs() + a.abs() + b.abs()).fold(0.0, f32::max)
    }
}

/// Returns the displacement of an image (height, width, channel) against a rendered one (RGB, 0..=1, row by row, `width` x
/// `height`) of the same camera: a shift and a turn, up to gain and offset. `None` if no small displacement fits. `counts`
/// is true for the rendered pixels that count, by index row by row.
///
/// ```
/// use ndarray::Array3;
/// let scene = |x: f32, y: f32| 0.5 + 0.2 * (0.3 * x).sin() * (0.23 * y).cos() + 0.1 * (0.2 * y - 0.1 * x).sin();
/// let rendered: Vec<f32> = (0..48 * 48).flat_map(|i| [scene((i % 48) as f32, (i / 48) as f32); 3]).collect();
/// // Seen two pixels farther right.
/// let seen = Array3::from_shape_fn((48, 48, 3), |(y, x, _)| (255.0 * scene(x as f32 - 2.0, y as f32)) as u8);
/// let [across, down] = carff_unknown::displacement(seen.view(), &rendered, 48, 48, |_| true).unwrap();
/// assert!((48.0 * across[0] - 2.0).abs() < 0.1 && down.iter().all(|term| (48.0 * term).abs() < 0.1));
/// ```
pub fn displacement(
    image: ArrayView3<'_, u8>,
    rendered: &[f32],
    width: usize,
    height: usize,
    counts: impl Fn(usize) -> bool,
) -> Option<Displacement> {
    if rendered.len() != width * height * 3 || width == 0 || height == 0 {
        return None;
    }
    let counting: Vec<usize> = (0..width * height).filter(|&i| counts(i)).collect();
    let image = Brightness::of(&reduced(image, width, height), width, height);
    let map = fitted(&image, &Brightness::of(rendered, width, height), &counting, Maps::Rigid)?;
    Some(map.0.map(|axis| axis.map(|term| term / width.max(height) as f32)))
}

/// Returns the view as the rendered pixels would show it, with values that are not numbers where it was not seen; `None`
/// if no small affine map moves it there. `still` are the rendered pixels of the place that never change.
pub(crate) fn align(view: View, rendered: &[f32], still: &[usize]) -> Option<Vec<f32>> {
    let size = (view.width, view.height);
    let (image, place) = (Brightness::of(view.rgb, size.0, size.1), Brightness::of(rendered, size.0, size.1));
    let map = fitted(&image, &place, still, Maps::Affine)?;
    let moved = |i: usize| {
        let colour = |of: Between| [0, 1, 2].map(|c| of.iter().map(|&(i, weight)| weight * view.rgb[i * 3 + c]).sum());
        between(map.seen(i, size).0, size.0, size.1).map_or([f32::NAN; 3], colour)
    };
    Some((0..size.0 * size.1).flat_map(moved).collect())
}

/// The small map from the place to the image that fits best.
fn fitted(image: &Brightness, place: &Brightness, still: &[usize], maps: Maps) -> Option<AffineMap> {
    let size = (image.width, image.height);
    let farthest = FARTHEST * size.0.max(size.1) as f32;
    let (mut map, mut light) = guess(image, place, still, farthest)?;
    let mut scale = COARSE;
    for _ in 0..STEPS {
        let step = step(&map, &mut light, image, place, still, (maps, scale))?;
        for (term, change) in map.0.iter_mut().flatten().zip(step) {
            *term += change.clamp(-LARGE_STEP_PX, LARGE_STEP_PX);
        }
        if map.farthest() > 2.0 * farthest {
            return None;
        }
        if scale == FINE && step.iter().all(|change| change.abs() < SMALL_STEP_PX) {
            break;
        }
        scale = [0, 1].map(|i| (scale[i] * FINER).max(FINE[i]));
    }
    (map.farthest() <= farthest).then_some(map)
}

/// A step of Gauss and Newton towards a better map, after one towards a better gain and offset. Differences beyond the
/// first value of the scale do not count; slopes are measured over the second one.
fn step(
    map: &AffineMap,
    light: &mut [f32; 2],
    image: &Brightness,
    place: &Brightness,
    still: &[usize],
    (maps, [cap, slope_px]): (Maps, [f32; 2]),
) -> Option<[f32; 2 * TERMS]> {
    let size = (image.width, image.height);
    let seen = still.iter().filter_map(|&i| {
        let (at, terms) = map.seen(i, size);
        Some((place.values[i], image.at(at)?, at, terms))
    });
    let seen: Vec<(f32, f32, [f32; 2], [f32; TERMS])> = seen.collect();
    let left = |[gain, offset]: [f32; 2], shown: f32, seen: f32| gain * shown + offset - seen;
    let counts = |&&(shown, seen, ..): &&(f32, f32, _, _)| left(*light, shown, seen).abs() <= cap;
    *light = least_squares(seen.iter().filter(counts).map(|&(shown, seen, ..)| ([shown, 1.0], seen)))?;
    let counting = seen.iter().filter(|&&(shown, seen, ..)| left(*light, shown, seen).abs() <= cap);
    let slopes =
        counting.map(|&(shown, seen, at, terms)| (image.slopes(at, slope_px), terms, left(*light, shown, seen)));
    match maps {
        Maps::Affine => {
            least_squares(slopes.map(|([du, dv], [_, x, y], left)| ([du, du * x, du * y, dv, dv * x, dv * y], left)))
        }
        Maps::Rigid => {
            let rows = slopes.map(|([du, dv], [_, x, y], left)| ([du, dv, du * y - dv * x], left));
            let [across, down, turn] = least_squares(rows)?;
            Some([across, 0.0, turn, down, -turn, 0.0])
        }
    }
}

/// The shift by whole pixels under which the image fits the place best, with its gain and offset.
fn guess(image: &Brightness, place: &Brightness, still: &[usize], farthest: f32) -> Option<(AffineMap, [f32; 2])> {
    let (width, height) = (image.width as i32, image.height as i32);
    let reach = farthest as i32 / GUESS_PX;
    let mut best = None;
    let mut least = f32::INFINITY;
    for by in (-reach..=reach).flat_map(|dv| (-reach..=reach).map(move |du| [du * GUESS_PX, dv * GUESS_PX])) {
        let pairs: Vec<(f32, f32)> = still
            .iter()
            .filter_map(|&i| {
                let (u, v) = (i as i32 % width + by[0], i as i32 / width + by[1]);
                let is_inside = (0..width).contains(&u) && (0..height).contains(&v);
                is_inside.then(|| (place.values[i], image.values[(v * width + u) as usize]))
            })
            .collect();
        let Some([gain, offset]) = least_squares(pairs.iter().map(|(x, y)| ([*x, 1.0], *y))) else { continue };
        let left = |(x, y): &(f32, f32)| (y - gain * x - offset).abs().min(GUESS_CAP);
        let mean = pairs.iter().map(left).sum::<f32>() / pairs.len() as f32;
        if mean < least {
            (least, best) = (mean, Some((AffineMap(by.map(|px| [px as f32, 0.0, 0.0])), [gain, offset])));
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    const SIDE: usize = 48;

    /// A scene of smooth patches, brighter by `gain`.
    fn scene([u, v]: [f32; 2], gain: f32) -> [f32; 3] {
        let wave = (0.23 * u).sin() * (0.19 * v + 0.5).cos() + 0.5 * (0.41 * v - 0.13 * u).sin();
        [0.5 + 0.2 * wave, 0.45 + 0.22 * wave, 0.4 + 0.15 * wave].map(|value| gain * value)
    }

    fn image(gain: f32, seen: impl Fn(f32, f32) -> [f32; 2]) -> Vec<f32> {
        (0..SIDE * SIDE).flat_map(|i| scene(seen((i % SIDE) as f32, (i / SIDE) as f32), gain)).collect()
    }

    fn largest_difference(a: &[f32], b: &[f32]) -> f32 {
        let seen = a.iter().zip(b).filter(|(a, _)| !a.is_nan());
        seen.map(|(a, b)| (a - b).abs()).fold(0.0, f32::max)
    }

    /// A shifted, turned and darker view of the place is moved to where it is rendered; what it does not show is marked.
    #[test]
    fn small_errors_of_the_pose_are_found() {
        let rendered = image(1.0, |x, y| [x, y]);
        let still: Vec<usize> = (0..SIDE * SIDE).step_by(3).collect();
        for (shift, turn) in [([4.0, -2.0], 0.0), ([-3.0, 1.5], 0.03), ([0.0, 0.0], -0.05)] {
            let seen = image(0.8, |x, y| [x - shift[0] + turn * (y - 24.0), y - shift[1] - turn * (x - 24.0)]);
            let view = View { rgb: &seen, width: SIDE, height: SIDE };
            let moved = align(view, &rendered, &still).expect("a map");
            let expected = image(0.8, |x, y| [x, y]);
            let largest = largest_difference(&moved, &expected);
            assert!(largest < 0.03, "{shift:?} {turn}: {largest}");
            assert!(largest_difference(&seen, &expected) > 0.03);
            assert_eq!(moved.iter().any(|v| v.is_nan()), shift != [0.0; 2] || turn != 0.0);
        }
    }

    /// A patch that only the image has stays where it is: a map has no means to hide it.
    #[test]
    fn nothing_is_hidden() {
        let rendered = image(1.0, |x, y| [x, y]);
        let still: Vec<usize> = (0..SIDE * SIDE).step_by(3).collect();
        let mut seen = rendered.clone();
        for i in (0..SIDE * SIDE).filter(|i| (12..22).contains(&(i % SIDE)) && (20..30).contains(&(i / SIDE))) {
            seen[i * 3..i * 3 + 3].fill(0.0);
        }
        let moved = align(View { rgb: &seen, width: SIDE, height: SIDE }, &rendered, &still).expect("a map");
        assert!(moved[(25 * SIDE + 17) * 3] < 0.05);
        assert!(largest_difference(&moved[..12 * SIDE * 3], &rendered[..12 * SIDE * 3]) < 0.05);
    }

    /// A view that is too far off, and one without any pattern, have no map.
    #[test]
    fn other_views_have_no_map() {
        let rendered = image(1.0, |x, y| [x, y]);
        let still: Vec<usize> = (0..SIDE * SIDE).step_by(3).collect();
        let far = image(1.0, |x, y| [x - 13.0, y]);
        let flat = vec![0.4; SIDE * SIDE * 3];
        for seen in [far, flat] {
            let moved = align(View { rgb: &seen, width: SIDE, height: SIDE }, &rendered, &still);
            let fits = moved.is_some_and(|moved| largest_difference(&moved, &rendered) < 0.05);
            assert!(!fits);
        }
        assert_eq!(align(View { rgb: &rendered, width: SIDE, height: SIDE }, &rendered, &[]), None);
    }
}
