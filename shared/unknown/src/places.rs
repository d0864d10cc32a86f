//! What an image shows of the places of the known states: each place is rendered with and without what is there.
//!
//! Two known states that differ at one place look the same elsewhere. Only pixels in which their rendered images differ
//! count, and only the part of the image's error along this difference: errors that both images have cancel. So a few
//! pixels of a vehicle that is mostly hidden count, although the encoder does not see them.

use crate::compare::{Comparison, QUICK};
use crate::fit::Fit;
use crate::known::Seen;
use crate::lanes::OwnBox;
use carff_base::geometry::{OrientedBox, PinholeCamera, TurnedBox};
use carff_field::{Field, HypothesisBuffer, RenderOptions};
use carff_messages::LATENT_DIM;
use ndarray::ArrayView3;

/// Margin of a place's box, metres: what is there reaches a little beyond it.
const MARGIN_M: f64 = 0.3;
/// Most pixels of a place that are rendered; of more, every second, third, ... is.
const MOST_PX: usize = 256;
/// Smallest difference of the two rendered images in a channel, of 1.
const LEAST_DIFFERENCE: f32 = 0.02;
/// Limit of a pixel's position between the two rendered images: half of their difference, and a little more.
const LIMIT: f32 = 0.6;
/// Sum of squared differences from which on an image shows a place: half of the evidence counts at this sum.
const HALF_SHOWN: f32 = 4.0;

/// A place, and two known states that differ there, and in few other places.
#[derive(Clone, Copy, Debug)]
struct PlacePair {
    with_margin: OrientedBox,
    taken: usize,
    free: usize,
}

/// The places of the known states, to be found in images. Places of the vehicle itself show nothing: its pose varies, and it
/// carries the camera.
#[derive(Debug, Default)]
pub struct PlaceViews {
    pairs: Vec<Option<PlacePair>>,
    buffer: HypothesisBuffer,
}

impl PlaceViews {
    /// Takes the box of each place, with the states that take it, and the boxes of the vehicle itself.
    pub fn new<'a>(places: impl IntoIterator<Item = (OrientedBox, &'a [bool])>, own: &[OwnBox]) -> Self {
        let places: Vec<(OrientedBox, &[bool])> = places.into_iter().collect();
        let pair = |(oriented_box, taken_in): &(OrientedBox, &[bool])| {
            if own.iter().any(|own| own.oriented_box == *oriented_box) {
                return None;
            }
            let others = |a: usize, b: usize| places.iter().filter(|(_, taken)| taken[a] != taken[b]).count();
            let states = || 0..taken_in.len();
            let pairs = states().filter(|&s| taken_in[s]).flat_map(|a| states().map(move |b| (a, b)));
            let (taken, free) = pairs.filter(|&(_, b)| !taken_in[b]).min_by_key(|&(a, b)| others(a, b))?;
            let half_size = oriented_box.half_size.map(|half| half + MARGIN_M);
            Some(PlacePair { with_margin: OrientedBox { half_size, ..*oriented_box }, taken, free })
        };
        let pairs = places.iter().map(pair).collect();
        Self { pairs, buffer: HypothesisBuffer::default() }
    }

    /// Returns what an image (height, width, channel) shows of each place: -1 for free, 1 for taken, 0 for nothing;
    /// -2 to 2. `compared` is its comparison: a view of another place shows nothing, nor does one from another pose than
    /// the camera's.
    pub fn look(
        &mut self,
        field: &Field,
        states: &[[f32; LATENT_DIM]],
        (camera, image): (&PinholeCamera, ArrayView3<'_, u8>),
        (seen, compared): (&Seen, &Comparison),
        threads: usize,
    ) -> Vec<f32> {
        let Self { pairs, buffer } = self;
        if compared.is_moved || seen.ratios.iter().all(|ratio| *ratio == 0.0) {
            return vec![0.0; pairs.len()];
        }
        let options = RenderOptions { threads: threads.max(1), ..QUICK };
        let size = (camera.height_px as usize, camera.width_px as usize, 3);
        let mut look = |pair: &PlacePair| {
            let latents = [*states.get(pair.taken)?, *states.get(pair.free)?];
            let (pixels, step) = pixels(&pair.with_margin, camera);
            if pixels.is_empty() || image.dim() != size {
                return None;
            }
            let mut selected = vec![false; size.0 * size.1];
            for &pixel in &pixels {
                selected[pixel] = true;
            }
            field.render_hypotheses_where(camera, &latents, |pixel| selected[pixel], &options, buffer);
            let [taken, free] = [0, 1].map(|of| buffer.images[of].rgb.as_slice());
            let value = |i: usize| f32::from(image[[i / 3 / size.1, i / 3 % size.1, i % 3]]) / 255.0;
            Some(shown(&pixels, step, [taken, free], value, &compared.fit))
        };
        pairs.iter().map(|pair| pair.as_ref().and_then(&mut look).unwrap_or(0.0)).collect()
    }
}

/// The pixels of a camera that look at a box, or every so many of them. None from within the box.
fn pixels(place: &OrientedBox, camera: &PinholeCamera) -> (Vec<usize>, usize) {
    let turned: TurnedBox = place.turned();
    if turned.contains(camera.position_m()) {
        return (Vec::new(), 1);
    }
    let (width, height) = (camera.width_px as usize, camera.height_px as usize);
    let [columns, rows] = extent_px(place, camera).map(|[low, high]| low..high);
    let inside = rows.flat_map(|y| columns.clone().map(move |x| (x, y))).filter(|&(x, y)| x < width && y < height);
    let met = inside.filter(|&(x, y)| turned.is_met_by(&camera.ray(x as f64 + 0.5, y as f64 + 0.5)));
    let all: Vec<usize> = met.map(|(x, y)| y * width + x).collect();
    let step = all.len().div_ceil(MOST_PX).max(1);
    (all.into_iter().step_by(step).collect(), step)
}

/// First and last pixels of a box, along x and y; the whole image if a part of the box is behind the camera.
fn extent_px(place: &OrientedBox, camera: &PinholeCamera) -> [[usize; 2]; 2] {
    let sides = [camera.width_px, camera.height_px];
    let corners: Option<Vec<[f64; 2]>> =
        place.edges().iter().flatten().map(|corner| camera.project(*corner).map(|(at, _)| at)).collect();
    [0, 1].map(|axis| {
        let side = sides[axis] as usize;
        let Some(corners) = &corners else { return [0, side] };
        let along = || corners.iter().map(|corner| corner[axis]);
        let low = along().fold(f64::INFINITY, f64::min).clamp(0.0, side as f64);
        let high = along().fold(f64::NEG_INFINITY, f64::max).clamp(0.0, side as f64);
        [low.floor() as usize, high.ceil() as usize]
    })
}

/// Position of the image between two rendered ones, over some pixels: -1 at `free`, 1 at `taken`, and nearer to 0 the less
/// they differ. `step` pixels stand for one.
fn shown(pixels: &[usize], step: usize, [taken, free]: [&[f32]; 2], seen: impl Fn(usize) -> f32, fit: &Fit) -> f32 {
    let (mut along, mut energy) = (0.0, 0.0);
    for &pixel in pixels {
        let of = |rendered: &[f32]| fit.seen(&rendered[pixel * 3..pixel * 3 + 3]);
        let (taken, free) = (of(taken), of(free));
        let difference = [0, 1, 2].map(|c| taken[c] - free[c]);
        if difference.iter().all(|d| d.abs() < LEAST_DIFFERENCE) {
            continue;
        }
        let error = |c: usize| seen(pixel * 3 + c) - 0.5 * (taken[c] + free[c]);
        let squared: f32 = difference.iter().map(|d| d * d).sum();
        let at = (0..3).map(|c| difference[c] * error(c)).sum::<f32>() / squared;
        along += squared * at.clamp(-LIMIT, LIMIT);
        energy += squared;
    }
    let energy = energy * step as f32;
    if energy > 0.0 { 2.0 * along * step as f32 / (energy + HALF_SHOWN) } else { 0.0 }
}

#[cfg(test)]
mod tests {
    use super::*;

    const FIT: Fit = Fit {
        mix: [[0.5, 0.0, 0.0], [0.0, 0.5, 0.0], [0.0, 0.0, 0.5]],
        offset: [0.25; 3],
        noise: 0.02,
        explained: 1.0,
    };

    /// An image of the vehicle is at 1, one of the road at -1, one in which both look alike or of which a half shows each
    /// at 0; a few pixels count less than many. A brighter camera changes nothing.
    #[test]
    fn an_image_is_between_two_rendered_ones() {
        let (taken, free) = (vec![0.9_f32; 300], vec![0.3_f32; 300]);
        let camera = |rendered: f32| 0.5 * rendered + 0.25;
        let all: Vec<usize> = (0..100).collect();
        let of = |pixels: &[usize], seen: &dyn Fn(usize) -> f32| shown(pixels, 1, [&taken, &free], seen, &FIT);
        assert!((of(&all, &|_| camera(0.9)) - 27.0 / 31.0).abs() < 1e-4);
        assert!((of(&all, &|_| camera(0.3)) + 27.0 / 31.0).abs() < 1e-4);
        assert!(of(&all, &|i| camera(if i < 150 { 0.9 } else { 0.3 })).abs() < 1e-4);
        assert!(of(&all[..3], &|_| camera(0.9)) < 0.5);
        assert_eq!(shown(&all, 1, [&taken, &taken], |_| 0.0, &FIT), 0.0);
        // Something else, far brighter than both, counts as a pixel of the nearer one at most.
        assert!(of(&all, &|_| 30.0) <= 1.2);
        let half: Vec<usize> = (0..100).step_by(2).collect();
        let halves = shown(&half, 2, [&taken, &free], |_| camera(0.9), &FIT);
        assert!((halves - 27.0 / 31.0).abs() < 1e-4, "every second pixel stands for two: {halves}");
    }

    /// The pixels are those of the box; of a large box every so many, and none from within it or for a box behind the
    /// camera.
    #[test]
    fn pixels_are_those_of_the_box() {
        let camera = PinholeCamera::look_at([0.0, -10.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 64, 64, 90.0);
        let place = |y: f64, half: f64| OrientedBox { center: [0.0, y, 1.0], half_size: [half; 3], yaw: 0.0 };
        let (found, step) = pixels(&place(0.0, 1.0), &camera);
        assert!(step == 1 && (36..=64).contains(&found.len()), "{}", found.len());
        assert!(found.iter().all(|p| (26..38).contains(&(p % 64)) && (26..38).contains(&(p / 64))));
        let (found, step) = pixels(&place(0.0, 5.0), &camera);
        assert!(step > 1 && found.len() <= MOST_PX, "{}", found.len());
        assert!(pixels(&place(-10.0, 1.0), &camera).0.is_empty());
        assert!(pixels(&place(-20.0, 1.0), &camera).0.is_empty());
    }

    /// A place is compared in two states that differ in it, and in as few others as possible; the vehicle's own place is
    /// not compared.
    #[test]
    fn pairs_differ_in_one_place() {
        let place = |x: f64| OrientedBox { center: [x, 0.0, 0.0], half_size: [1.0; 3], yaw: 0.0 };
        let taken_in: [[bool; 4]; 3] =
            [[true, false, false, false], [true, false, true, false], [false, true, false, true]];
        let places = [0.0, 1.0, 2.0].map(place);
        let own = OwnBox { oriented_box: places[2], margin_m: 0.5 };
        let views = PlaceViews::new(places.into_iter().zip(taken_in.iter().map(<[bool; 4]>::as_slice)), &[own]);
        let pairs: Vec<_> = views.pairs.iter().map(|pair| pair.map(|pair| (pair.taken, pair.free))).collect();
        assert_eq!(pairs, [Some((0, 2)), Some((2, 1)), None]);
    }
}
