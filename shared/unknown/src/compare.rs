//! Render and compare: every known state is rendered from the camera's own pose and compared with the image.

use crate::align::{View, align, reduced_without_specks};
use crate::alike::smooth;
use crate::blobs::{Blob, blobs};
use crate::fit::{Fit, LEAST_NOISE, fit, fit_mixed, median, noise};
use crate::lanes::{ErrorMap, Ground, Lanes};
use crate::residuals::{BothResiduals, Pixels, ResidualKind, explain_together, median_residual, smaller};
use carff_base::geometry::PinholeCamera;
use carff_field::{Field, HypothesisBuffer, RenderBuffer, RenderOptions};
use carff_messages::LATENT_DIM;
use ndarray::ArrayView3;
use std::borrow::Cow;

/// Longest side of the compared images, pixels.
const SIDE_PX: u32 = 64;
/// Pixels around the lanes that are compared too: each residual rests on its neighbours, and objects next to a lane are
/// followed.
const MARGIN_PX: usize = 3;
/// Fewer samples than for images to look at: errors of a few per cent are below the noise. Half the resolution was
/// tried: cars of the road's colour stay within the range of the coarser pixels.
pub(crate) const QUICK: RenderOptions =
    RenderOptions { threads: 1, max_samples_per_ray: 128, min_transmittance: 0.1, min_weight: 0.1, step_scale: 2.0 };
/// Every so many rows and columns, a pixel of the whole view is compared, to find out whether the view is of this place.
const PLACE_STEP_PX: usize = 4;
/// Largest difference that counts in that comparison, of 1: a vehicle that covers a part of the view is not a place.
const PLACE_CAP: f32 = 0.25;
/// A moved image counts if it leaves less than this share of what the image leaves unexplained.
const BETTER: f32 = 0.7;
/// Noise of an image from which on it is smoothed before it is compared, of 1.
const NOISY: f32 = 0.03;
/// A smoothed image counts if it leaves less than this share of the noise: a wrong pose leaves as much.
const SMOOTHER: f32 = 0.6;
/// Residual from which on a pixel is looked at more closely, in deviations. Below it nothing is unknown.
const LEFT_FROM: f32 = 1.0;
/// Rays of such a pixel, one above the other.
const RAYS: u32 = 4;

/// A field with what is known about it: the known states, and the lanes on which something unknown counts.
#[derive(Clone, Copy, Debug)]
pub struct KnownScene<'a> {
    /// The field of the scene.
    pub field: &'a Field,
    /// Latents of the known states.
    pub states: &'a [[f32; LATENT_DIM]],
    /// For each state, true if it has the hazard.
    pub hazard_states: &'a [bool],
    /// The ground on which something unknown counts.
    pub lanes: &'a Lanes,
}

/// An image with its residuals under the known states, at the compared size.
#[derive(Clone, Debug)]
pub struct Comparison {
    /// The camera at the compared size.
    pub camera: PinholeCamera,
    /// The image, 0..=1, RGB, row by row; not numbers where a moved image does not show the rendered view.
    pub image: Vec<f32>,
    /// Gain, offset and noise of the image.
    pub fit: Fit,
    /// For each rendered pixel, the ground that it looks at.
    pub ground: Vec<Option<Ground>>,
    /// True for pixels that were compared.
    pub judged: Vec<bool>,
    /// True for an image that was moved to where its place is rendered.
    pub is_moved: bool,
    /// For each state and kind, the residual of each pixel, in deviations; 0 where it was not compared.
    residuals: Vec<[Vec<f32>; 2]>,
}

impl Comparison {
    /// Returns the number of states.
    pub fn states(&self) -> usize {
        self.residuals.len()
    }

    /// Reports whether a lane is in sight: the camera sees it by its pose, and no known state hides all of it.
    pub fn sees_lanes(&self) -> bool {
        self.on_lanes(0, ResidualKind::Unexpected).next().is_some()
    }

    /// Returns the residual of each pixel of a state, in deviations; 0 where it was not compared.
    pub fn residual(&self, state: usize, kind: ResidualKind) -> &[f32] {
        self.residuals.get(state).map_or(&[], |residuals| &residuals[kind as usize])
    }

    /// Returns the residuals on the lanes with the ground points where they were found, for one state.
    pub fn on_lanes(&self, state: usize, kind: ResidualKind) -> impl Iterator<Item = ([f64; 2], f32)> + '_ {
        let residual = self.residual(state, kind).iter();
        let pixels = residual.zip(&self.ground).zip(&self.judged);
        pixels.filter_map(|((r, ground), judged)| Some((ground.filter(|g| g.on_lanes && *judged)?.at_m, *r)))
    }

    /// Returns the blobs of a state that stand on the lanes, the strongest first.
    pub fn blobs(&self, state: usize, kind: ResidualKind, errors: &ErrorMap) -> Vec<Blob> {
        match self.residual(state, kind) {
            [] => Vec::new(),
            residual => blobs(&self.camera, residual, &self.judged, &self.ground, errors),
        }
    }
}

#[cfg(test)]
impl Comparison {
    /// Replaces the residuals of all states.
    pub(crate) fn with_residuals(self, residuals: Vec<[Vec<f32>; 2]>) -> Self {
        Self { residuals, ..self }
    }
}

/// Renders the known states of one field and compares images with them. It reuses its memory, and the rendered states
/// while the camera stands still.
///
/// The vehicle itself moves between its places in the known states, and carries the camera. So the states are rendered
/// without it. Where they leave something unexplained at one of its places, they are rendered with it, too: either may
/// explain an image.
#[derive(Debug, Default)]
pub struct Comparer {
    /// The field without the vehicle itself; `None` if no state has it.
    without_own: Option<Field>,
    /// The states without the vehicle itself.
    buffer: HypothesisBuffer,
    /// The states with it, in the pixels of `shown_with_own`.
    with_own: HypothesisBuffer,
    shown_with_own: Vec<usize>,
    /// The pixels that look at its places.
    own_pixels: Vec<usize>,
    /// The states without it, with several rays in each of the pixels that are looked at more closely.
    tall: HypothesisBuffer,
    /// The camera, the judged pixels and the states that the buffer shows.
    shown: Option<(PinholeCamera, Vec<bool>, Vec<[f32; LATENT_DIM]>)>,
}

impl Comparer {
    /// A comparer for the states of `field`, with the vehicle itself as `lanes` have it.
    pub fn new(field: &Field, lanes: &Lanes) -> Self {
        Self { without_own: lanes.without_own(field), ..Self::default() }
    }

    /// Returns the field that renders the states without the vehicle itself: `field`, unless a state has the vehicle.
    pub fn without_own<'a>(&'a self, field: &'a Field) -> &'a Field {
        self.without_own.as_ref().unwrap_or(field)
    }

    /// Compares an image (height, width, channel) with each state. A camera that sees no lane by its pose only shows
    /// whether the view is of this place. `None` without states.
    pub fn compare(
        &mut self,
        scene: KnownScene,
        camera: &PinholeCamera,
        image: ArrayView3<'_, u8>,
        threads: usize,
    ) -> Option<Comparison> {
        let KnownScene { field, states, lanes, .. } = scene;
        let small = reduced_camera(camera);
        let (width, height) = (small.width_px as usize, small.height_px as usize);
        let mut ground = lanes.ground_points(&small);
        let seen: Vec<bool> = ground.iter().map(|g| g.is_some_and(|g| g.on_lanes)).collect();
        if states.is_empty() {
            return None;
        }
        let judged = grown(&seen, width, MARGIN_PX);
        let is_shown = |(camera, pixels, of): &(PinholeCamera, Vec<bool>, Vec<_>)| {
            *camera == small && *pixels == judged && of == states
        };
        if !self.shown.as_ref().is_some_and(is_shown) {
            let options = RenderOptions { threads: threads.max(1), ..QUICK };
            let compared = |i| judged[i] || is_sample(i, width);
            let pixels: Vec<usize> = (0..judged.len()).filter(|&i| compared(i)).collect();
            self.own_pixels = lanes.own_pixels(&small, &pixels);
            let without_own = self.without_own.as_ref().unwrap_or(field);
            without_own.render_hypotheses_where(&small, states, compared, &options, &mut self.buffer);
            self.shown_with_own.clear();
            self.shown = Some((small, judged.clone(), states.to_vec()));
        }
        let depths: Vec<&[f32]> = self.buffer.images.iter().map(|image| image.depth_m.as_slice()).collect();
        lanes.leave_out_hidden(&small, &depths, &mut ground);
        Some(self.compared(
            small,
            reduced_without_specks(image, width, height),
            ground,
            judged,
            (scene, &Closer::default()),
        ))
    }

    /// Compares the image of the last comparison again where it leaves something unexplained. At its own places, the
    /// vehicle itself may explain the image. Everywhere, pixels get several rays: a line on the ground ahead is flatter than
    /// a pixel. `None` if nothing is left unexplained.
    pub fn look_closer(&mut self, last: &Comparison, scene: KnownScene, threads: usize) -> Option<Comparison> {
        let options = RenderOptions { threads: threads.max(1), ..QUICK };
        let closer = Closer { own: self.left_own(last), pixels: left_by_all(last) };
        if closer.own.is_empty() && !closer.pixels.contains(&true) {
            return None;
        }
        // Rendered pixels depend in their last bits on those that are rendered with them: only the same ones are kept.
        if !closer.own.is_empty() && closer.own != self.shown_with_own {
            let is_own = |i: usize| closer.own.binary_search(&i).is_ok();
            scene.field.render_hypotheses_where(&last.camera, scene.states, is_own, &options, &mut self.with_own);
            self.shown_with_own.clone_from(&closer.own);
        }
        let tall = last.camera.resized(last.camera.width_px, last.camera.height_px * RAYS);
        let width = last.camera.width_px as usize;
        let is_near = |i: usize| closer.pixels[i / width / RAYS as usize * width + i % width];
        let without_own = self.without_own.as_ref().unwrap_or(scene.field);
        without_own.render_hypotheses_where(&tall, scene.states, is_near, &options, &mut self.tall);
        let Comparison { camera, image, ground, judged, is_moved, .. } = last.clone();
        Some(Comparison { is_moved, ..self.compared(camera, image, ground, judged, (scene, &closer)) })
    }

    /// The pixels at the vehicle's own places that some state leaves unexplained, with those on which they rest.
    fn left_own(&self, last: &Comparison) -> Vec<usize> {
        let is_left = |i: usize| last.residuals.iter().flatten().any(|residual| residual[i] > LEFT_FROM);
        let mut left = vec![false; last.judged.len()];
        self.own_pixels.iter().filter(|i| is_left(**i)).for_each(|i| left[*i] = true);
        // A residual rests on its neighbours.
        let near = grown(&left, last.camera.width_px as usize, 2);
        self.own_pixels.iter().copied().filter(|&i| near[i] && last.judged[i]).collect()
    }

    /// Compares the image of the last comparison again, moved to where its place is rendered: the pose or the lens may
    /// have a small error. `None` if the moved image does not fit the place much better, if it shows less than half of the
    /// lanes, or if `last` is larger than the rendered states.
    pub fn align(&self, last: &Comparison, scene: KnownScene) -> Option<Comparison> {
        let shown = self.buffer.images.first().filter(|shown| shown.changing.len() >= last.judged.len())?;
        let (width, height) = (last.camera.width_px as usize, last.camera.height_px as usize);
        let is_compared = |i: usize| last.judged[i] || is_sample(i, width);
        let is_still = |&i: &usize| is_compared(i) && !shown.changing[i] && !self.is_own(i);
        let still: Vec<usize> = (0..last.judged.len()).filter(is_still).collect();
        let moved = align(View { rgb: &last.image, width, height }, &shown.rgb, &still)?;
        let aligned =
            self.compared(last.camera, moved, last.ground.clone(), last.judged.clone(), (scene, &Closer::default()));
        let left = |of: &Comparison| 1.0 - of.fit.explained;
        let on_lanes = |of: &Comparison| of.on_lanes(0, ResidualKind::Unexpected).count();
        let is_better = left(&aligned) < BETTER * left(last) && 2 * on_lanes(&aligned) >= on_lanes(last);
        is_better.then_some(Comparison { is_moved: true, ..aligned })
    }

    /// Compares an image at the compared size with the rendered states, in the pixels `own` also with the vehicle itself.
    /// Pixels whose values are not numbers do not count.
    fn compared(
        &self,
        camera: PinholeCamera,
        image: Vec<f32>,
        ground: Vec<Option<Ground>>,
        mut judged: Vec<bool>,
        (scene, closer): (KnownScene, &Closer),
    ) -> Comparison {
        let (images, width) = (&self.buffer.images, camera.width_px as usize);
        judged.iter_mut().zip(image.chunks_exact(3)).for_each(|(judged, rgb)| *judged &= !rgb[0].is_nan());
        let still = |counts: &dyn Fn(usize) -> bool| -> Vec<usize> {
            let is_still =
                |&i: &usize| counts(i) && !images[0].changing[i] && !self.is_own(i) && !image[i * 3].is_nan();
            (0..judged.len()).filter(is_still).collect()
        };
        let samples = still(&|i| is_sample(i, width));
        let of_lanes = still(&|i| judged[i]);
        let (mut fit, compared, noise) = fitted_without_noise(&image, &images[0].rgb, [&samples, &of_lanes], width);
        if samples.is_empty() && !judged.contains(&true) {
            fit.explained = 0.0;
        }
        let rendered: Vec<&[f32]> = self.rendered().collect();
        let pixels = Pixels::new(&compared, &judged, &rendered, width);
        let rays = |state: usize| match self.tall.images.get(state) {
            Some(tall) if closer.pixels.contains(&true) => {
                spans(rendered[state], &tall.rgb, &closer.pixels, width).into()
            }
            _ => Vec::new(),
        };
        let of_state = |state: usize| pixels.energy(rendered[state], &rays(state), &fit);
        let mut energies: Vec<Vec<BothResiduals>> = (0..rendered.len()).map(of_state).collect();
        explain_together(&mut energies, &self.own_pixels, scene.hazard_states);
        self.count_own((&compared, &judged, width), &fit, &closer.own, &mut energies);
        let residual = |energy: &[BothResiduals], kind| median_residual(energy, kind, &judged, width, noise);
        let residuals = energies.iter().map(|energy| ResidualKind::ALL.map(|kind| residual(energy, kind))).collect();
        Comparison { camera, image, fit, ground, judged, is_moved: false, residuals }
    }

    /// Reports whether a compared pixel looks at a place of the vehicle itself.
    fn is_own(&self, pixel: usize) -> bool {
        self.own_pixels.binary_search(&pixel).is_ok()
    }

    /// Lets the vehicle itself explain the pixels `own`, which are rendered with it.
    fn count_own(
        &self,
        (image, judged, width): (&[f32], &[bool], usize),
        fit: &Fit,
        own: &[usize],
        energies: &mut [Vec<BothResiduals>],
    ) {
        if own.is_empty() {
            return;
        }
        let with_own = |(without, with): (&RenderBuffer, &RenderBuffer)| {
            let mut rgb = without.rgb.clone();
            for &i in own {
                rgb[i * 3..i * 3 + 3].copy_from_slice(&with.rgb[i * 3..i * 3 + 3]);
            }
            rgb
        };
        let rendered: Vec<Vec<f32>> = self.buffer.images.iter().zip(&self.with_own.images).map(with_own).collect();
        let rendered: Vec<&[f32]> = rendered.iter().map(Vec::as_slice).collect();
        let mut is_own = vec![false; judged.len()];
        for &i in own {
            is_own[i] = true;
        }
        let mut near = grown(&is_own, width, 1);
        near.iter_mut().zip(judged).for_each(|(near, judged)| *near &= judged);
        let pixels = Pixels::new(image, &near, &rendered, width);
        for (energy, rendered) in energies.iter_mut().zip(&rendered) {
            let with = pixels.energy(rendered, &[], fit);
            for &i in own.iter().filter(|i| judged[**i]) {
                energy[i] = smaller(energy[i], with[i]);
            }
        }
    }

    /// The rendered depth of a state in the last comparison, metres, row by row.
    pub(crate) fn depth_m(&self, state: usize) -> &[f32] {
        self.buffer.images.get(state).map_or(&[], |image| &image.depth_m)
    }

    /// The rendered states of the last comparison, RGB, 0..=1, row by row; pixels that were not compared are black.
    pub fn rendered(&self) -> impl Iterator<Item = &[f32]> {
        self.buffer.images.iter().map(|image| image.rgb.as_slice())
    }
}

/// The pixels of a comparison that are looked at more closely.
#[derive(Debug, Default)]
struct Closer {
    /// Those that are rendered with the vehicle itself, too, by index, ascending.
    own: Vec<usize>,
    /// True for those with several rays.
    pixels: Vec<bool>,
}

/// Marks the pixels in which the image has what no state has, and their neighbours, on which they rest.
fn left_by_all(last: &Comparison) -> Vec<bool> {
    let kind = ResidualKind::Unexpected as usize;
    let is_left = |i: usize| !last.residuals.is_empty() && last.residuals.iter().all(|of| of[kind][i] > LEFT_FROM);
    let left: Vec<bool> = (0..last.judged.len()).map(is_left).collect();
    let mut near = grown(&left, last.camera.width_px as usize, 1);
    near.iter_mut().zip(&last.judged).for_each(|(near, judged)| *near &= judged);
    near
}

/// Smallest and largest value of each pixel: those of its rays in `tall` for the pixels that are looked at more closely,
/// RGB, row by row.
fn spans(rendered: &[f32], tall: &[f32], closer: &[bool], width: usize) -> [Vec<f32>; 2] {
    let [mut low, mut high] = [rendered.to_vec(), rendered.to_vec()];
    for pixel in (0..closer.len()).filter(|pixel| closer[*pixel]) {
        let (row, column) = (pixel / width * RAYS as usize, pixel % width);
        for (ray, c) in (0..RAYS as usize).flat_map(|ray| (0..3).map(move |c| (ray, c))) {
            let value = tall[((row + ray) * width + column) * 3 + c];
            let i = pixel * 3 + c;
            (low[i], high[i]) = (low[i].min(value), high[i].max(value));
        }
    }
    [low, high]
}

/// Reports whether a pixel of a view of this width is one of those that show whether the view is of this place.
fn is_sample(i: usize, width: usize) -> bool {
    i % width % PLACE_STEP_PX == 1 && i / width % PLACE_STEP_PX == 1
}

/// The same camera at the compared size.
fn reduced_camera(camera: &PinholeCamera) -> PinholeCamera {
    let longest = u64::from(camera.width_px.max(camera.height_px).max(1));
    let scaled = |side: u32| ((u64::from(side) * u64::from(SIDE_PX) / longest) as u32).max(1);
    camera.resized(scaled(camera.width_px), scaled(camera.height_px))
}

/// Pixels at most `margin` rows and columns away from a marked one.
fn grown(marked: &[bool], width: usize, margin: usize) -> Vec<bool> {
    let height = marked.len() / width.max(1);
    let mut out = vec![false; marked.len()];
    for (i, _) in marked.iter().enumerate().filter(|(_, marked)| **marked) {
        let (x, y) = (i % width, i / width);
        for y in y.saturating_sub(margin)..(y + margin + 1).min(height) {
            out[y * width + x.saturating_sub(margin)..y * width + (x + margin + 1).min(width)].fill(true);
        }
    }
    out
}

/// Fits an image, or the smoothed one where single pixels make the noise. Returns the fit with the noise of the image
/// itself, the image to compare, and its noise.
fn fitted_without_noise<'a>(
    image: &'a [f32],
    rendered: &[f32],
    [samples, lanes]: [&[usize]; 2],
    width: usize,
) -> (Fit, Cow<'a, [f32]>, f32) {
    let fit = fitted(image, rendered, samples, lanes);
    if fit.noise > NOISY {
        let smoothed = smooth(image, width);
        let of_smoothed = fitted(&smoothed, rendered, samples, lanes);
        if of_smoothed.noise < SMOOTHER * fit.noise {
            return (Fit { noise: fit.noise, ..of_smoothed }, smoothed.into(), of_smoothed.noise);
        }
    }
    (fit, image.into(), fit.noise)
}

/// Fits the image over samples of the whole view: the lanes by themselves have too little contrast for a gain, and a
/// vehicle may fill them. The noise is the smaller one of view and lanes: what stands on the lanes is not noise. The camera
/// mixes colours if that explains much more.
fn fitted(image: &[f32], rendered: &[f32], samples: &[usize], lanes: &[usize]) -> Fit {
    let explained = |fit: &Fit| explained(image, rendered, fit, samples);
    let (by_channel, mixed) = (fit(image, rendered, samples), fit_mixed(image, rendered, samples));
    let is_better = mixed.gain().iter().all(|gain| *gain > 0.0)
        && 1.0 - explained(&mixed) < BETTER * (1.0 - explained(&by_channel));
    let fit = if is_better { mixed } else { by_channel };
    let of_lanes = if lanes.is_empty() { fit.noise } else { noise(image, rendered, &fit, lanes) };
    Fit { explained: explained(&fit), noise: fit.noise.min(of_lanes), ..fit }
}

/// Share of an image's variation, over the pixels that count, that the rendered one explains as the camera would show it.
/// A channel with a gain below 0 explains nothing: an inverted image shows another place.
fn explained(image: &[f32], rendered: &[f32], fit: &Fit, pixels: &[usize]) -> f32 {
    let capped = |difference: f32| difference.abs().min(PLACE_CAP).powi(2);
    let (mut left, mut all, mut least) = (0.0, 0.0, 0.0);
    let mut expected = *fit;
    for c in 0..3 {
        if fit.gain()[c] < 0.0 {
            expected.mix[c] = [0.0; 3];
        }
        let seen = || pixels.iter().map(|&i| image[i * 3 + c]);
        let middle = median(&mut seen().collect::<Vec<_>>());
        left += pixels
            .iter()
            .map(|&i| capped(image[i * 3 + c] - expected.seen(&rendered[i * 3..i * 3 + 3])[c]))
            .sum::<f32>();
        all += seen().map(|y| capped(y - middle)).sum::<f32>();
        least += capped(LEAST_NOISE) * seen().count() as f32;
    }
    match least {
        0.0 => 1.0,
        // A view without variation shows no place.
        least if all < least => 0.0,
        _ => 1.0 - left / all,
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::align::reduced;
    use ndarray::Array3;

    /// A view of this place is explained in any exposure and with a ninth of it covered; another image, a negative and a
    /// uniform one are not.
    #[test]
    fn places_explain_their_views() {
        let rendered: Vec<f32> = (0..900).map(|i| 0.1 + 0.8 * ((i / 3 * 37 % 100) as f32) / 100.0).collect();
        let explained = |of: &dyn Fn(usize, f32) -> f32| {
            let image: Vec<f32> = rendered.iter().enumerate().map(|(i, v)| of(i, *v)).collect();
            let pixels: Vec<usize> = (0..300).collect();
            fitted(&image, &rendered, &pixels, &[]).explained
        };
        assert!(explained(&|_, v| 0.6 * v + 0.2) > 0.99);
        assert!(explained(&|i, v| if i / 3 % 9 < 1 { 0.95 } else { v }) > 0.7);
        for share in [
            explained(&|i, _| (i / 3 * 61 % 83) as f32 / 83.0),
            explained(&|_, v| 1.0 - v),
            explained(&|i, _| 0.5 + 0.001 * (i / 3 % 2) as f32),
        ] {
            assert!(share < 0.2, "{share}");
        }
    }

    /// A view that has shifted is moved to where it belongs if it then still shows half of the lanes; another view, and
    /// one that already fits, are not moved.
    #[test]
    fn shifted_views_are_aligned() {
        let side = 48;
        let view = |du: f32| -> Vec<f32> {
            let of_pixel = |i: usize| {
                let (x, y) = ((i % side) as f32 + du, (i / side) as f32);
                let wave = (0.23 * x).sin() * (0.19 * y + 0.5).cos() + 0.5 * (0.41 * y - 0.13 * x).sin();
                [0.5 + 0.2 * wave, 0.45 + 0.2 * wave, 0.4 + 0.15 * wave]
            };
            (0..side * side).flat_map(of_pixel).collect()
        };
        let mut rendered = RenderBuffer::default();
        (rendered.rgb, rendered.changing) = (view(0.0), vec![false; side * side]);
        let mut comparer = Comparer::default();
        comparer.buffer.images = vec![rendered];
        let camera = PinholeCamera::look_at([0.0, -8.0, 6.0], [0.0; 3], [0.0, 0.0, 1.0], 48, 48, 60.0);
        let lanes = Lanes {
            areas: Vec::new(),
            ground_m: 0.0,
            bounds_m: [[-9.0, -9.0], [9.0, 9.0]],
            nearest_m: 1.0,
            own: Vec::new(),
        };
        let field = Field::new(carff_field::FieldConfig { log2_table_size: 10, ..Default::default() }, 1).unwrap();
        let scene = KnownScene { field: &field, states: &[], hazard_states: &[false], lanes: &lanes };
        let aligned = |image: Vec<f32>, lane_px: std::ops::Range<usize>| {
            let is_lane = |i: usize| lane_px.contains(&(i % side));
            let ground = |i| is_lane(i).then_some(Ground { distance_m: 5.0, at_m: [0.0; 2], on_lanes: true });
            let (ground, judged) = (0..side * side).map(|i| (ground(i), is_lane(i))).unzip();
            let last = comparer.compared(camera, image, ground, judged, (scene, &Closer::default()));
            (last.fit.explained, comparer.align(&last, scene).map(|moved| moved.fit.explained))
        };
        let (before, after) = aligned(view(4.0), 0..48);
        assert!(before < 0.8 && after.is_some_and(|share| share > 0.97), "{before} {after:?}");
        assert_eq!(aligned(view(4.0), 0..4).1, None, "the lane is out of view");
        assert_eq!(aligned(view(0.0), 0..48).1, None, "nothing is left to explain");
        assert_eq!(aligned(view(23.0), 0..48).1, None, "another view");
    }

    /// A monochrome camera, and one with swapped channels, shows this place; where one channel explains the image, none is
    /// mixed. A brighter image is explained where it is not saturated.
    #[test]
    fn cameras_may_mix_colours() {
        let rendered: Vec<f32> =
            (0..300).flat_map(|i| [37, 53, 71].map(|k| 0.1 + 0.5 * ((i * k % 100) as f32) / 100.0)).collect();
        let pixels: Vec<usize> = (0..300).collect();
        let of = |camera: &dyn Fn(&[f32]) -> [f32; 3]| {
            let image: Vec<f32> = rendered.chunks_exact(3).flat_map(camera).collect();
            fitted(&image, &rendered, &pixels, &[])
        };
        let grey = of(&|rgb| [0.3 * rgb[0] + 0.6 * rgb[1] + 0.1 * rgb[2]; 3]);
        assert!(grey.explained > 0.99 && (grey.mix[2][1] - 0.6).abs() < 0.01, "{grey:?}");
        let swapped = of(&|rgb| [rgb[2], rgb[0], rgb[1]]);
        assert!(swapped.explained > 0.99 && swapped.gain().iter().all(|gain| (gain - 1.0).abs() < 0.01), "{swapped:?}");
        let inverted = of(&|rgb| [1.0 - rgb[2], 1.0 - rgb[0], 1.0 - rgb[1]]);
        assert!(inverted.explained < 0.2, "{inverted:?}");
        let bright = of(&|rgb| [0, 1, 2].map(|c| (1.2 * rgb[c] + 0.4).min(1.0)));
        assert!(
            bright.explained > 0.99 && bright.mix[0][1] == 0.0 && (bright.mix[0][0] - 1.2).abs() < 0.01,
            "{bright:?}"
        );
        assert_eq!(bright.seen(&[0.6; 3]), [1.0; 3]);
    }

    /// The noise of single pixels is smoothed, so that a vehicle stays as large against it. The error of a wrong pose is
    /// not noise, and the image stays sharp.
    #[test]
    fn noise_is_smoothed() {
        let side = 48;
        let view = |du: f32, noise: f32| -> Vec<f32> {
            let value = |i: usize| {
                let (x, y) = ((i / 3 % side) as f32 + du, (i / 3 / side) as f32);
                let draw = ((i as u32).wrapping_mul(0x9E37_79B9) >> 8) as f32 / (1 << 24) as f32 - 0.5;
                0.5 + 0.2 * (0.4 * x).sin() * (0.3 * y).cos() + noise * draw
            };
            (0..side * side * 3).map(value).collect()
        };
        let (rendered, all): (_, Vec<usize>) = (view(0.0, 0.0), (0..side * side).collect());
        let of = |image: &[f32]| {
            let (fit, compared, noise) = fitted_without_noise(image, &rendered, [&all, &all], side);
            (fit.noise, compared != image, noise)
        };
        let (noise, is_smoothed, left) = of(&view(0.0, 0.3));
        assert!(noise > 0.07 && is_smoothed && left < SMOOTHER * noise, "{noise} {left}");
        let (noise, is_smoothed, left) = of(&view(1.5, 0.0));
        assert!(noise > NOISY && !is_smoothed && left == noise, "{noise} {left}");
    }

    /// A vehicle that fills the lanes stays as large against the noise as one that covers a small part of them.
    #[test]
    fn a_vehicle_that_fills_the_lanes_is_no_noise() {
        let all: Vec<usize> = (0..1600).collect();
        let (samples, lanes): (Vec<usize>, Vec<usize>) = all.iter().partition(|&&i| i % 4 == 1);
        let rendered: Vec<f32> = (0..4800).map(|i| 0.2 + 0.5 * ((i / 3 * 37 % 100) as f32) / 100.0).collect();
        let noise_of = |covered: usize| {
            let shown = |i: usize| if i / 3 % 4 != 1 && i / 12 < covered { 0.95 } else { rendered[i] };
            let image: Vec<f32> = (0..4800).map(shown).collect();
            fitted(&image, &rendered, &samples, &lanes).noise
        };
        assert_eq!(noise_of(20), LEAST_NOISE);
        assert_eq!(noise_of(390), LEAST_NOISE);
    }

    /// Cells are means, without a dead pixel for the comparison; images smaller than the grid repeat their pixels.
    #[test]
    fn reduction_averages() {
        let image = Array3::from_shape_fn((4, 6, 3), |(y, x, c)| if c == 1 { (y * 6 + x) as u8 } else { 51 });
        let out = reduced(image.view(), 3, 2);
        assert_eq!((out[0], out[1]), (0.2, (0.0 + 1.0 + 6.0 + 7.0) / 4.0 / 255.0));
        assert_eq!(reduced(image.view(), 12, 8).len(), 12 * 8 * 3);
        let mut damaged = image.clone();
        (damaged[[0, 0, 0]], damaged[[1, 3, 0]]) = (255, 0);
        let without = reduced_without_specks(damaged.view(), 3, 2);
        assert_eq!((without[0], without[3], without[1]), (0.2, 0.2, 7.0 / 510.0));
        assert_eq!(grown(&[false, true, false, false], 2, 1), [true; 4]);
    }
}
