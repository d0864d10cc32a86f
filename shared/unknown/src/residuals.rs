//! Residuals: how far each pixel of an image is from what a known state renders there.

use crate::fit::Fit;

/// Difference of the states' rendered values, of 1, from which on a pixel shows which of them it is.
const TOLD_APART: f32 = 0.05;

/// Kinds of residuals.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ResidualKind {
    /// The image has a value that the state does not have there.
    Unexpected,
    /// The state has a value that the image does not have there: a vehicle that is not there.
    Missing,
}

impl ResidualKind {
    /// Both kinds.
    pub const ALL: [Self; 2] = [Self::Unexpected, Self::Missing];
}

/// Both residuals of a pixel, or their squares.
pub type BothResiduals = [f32; 2];

/// Pixels of a 3 x 3 neighbourhood that were compared.
fn neighbours(i: usize, judged: &[bool], width: usize) -> impl Iterator<Item = usize> {
    let height = judged.len() / width.max(1);
    let around = |v: usize, n: usize| v.saturating_sub(1)..(v + 2).min(n);
    let (columns, rows) = (around(i % width, width), around(i / width, height));
    let all = rows.flat_map(move |y| columns.clone().map(move |x| y * width + x));
    all.filter(|&n| judged[n])
}

/// The image and the pixels of it that count.
#[derive(Clone, Copy)]
pub struct Pixels<'a> {
    /// The image, 0..=1, RGB, row by row.
    pub image: &'a [f32],
    /// True for pixels that were compared.
    pub judged: &'a [bool],
    /// True where the rendered states do not look alike.
    pub told_apart: &'a [bool],
    /// Width of the image, pixels.
    pub width: usize,
}

/// Returns true for each pixel at which the rendered states differ by more than their errors.
pub fn told_apart(states: &[&[f32]]) -> Vec<bool> {
    let Some(first) = states.first() else { return Vec::new() };
    let differs = |i: usize| {
        let (low, high) = range(states.iter().map(|state| state[i]));
        high - low > TOLD_APART
    };
    (0..first.len() / 3).map(|pixel| (pixel * 3..pixel * 3 + 3).any(differs)).collect()
}

/// Smallest and largest value.
fn range(values: impl Iterator<Item = f32>) -> (f32, f32) {
    values.fold((f32::INFINITY, f32::NEG_INFINITY), |(low, high), v| (low.min(v), high.max(v)))
}

/// Distance of a value from the range of some others.
fn beyond(value: f32, others: impl Iterator<Item = f32>) -> f32 {
    let (low, high) = range(others);
    (value - high).max(low - value).max(0.0)
}

/// Squared distance of each pixel from the range of its neighbours' rendered values, summed over the channels. The
/// range forgives what a blurred edge, or a pose that is off by half a pixel, changes.
///
/// It also forgives a vehicle that the state has and the image does not show: the vehicle's edges, windows and wheels
/// span the road's values. So where the states do not look alike, the distance of the rendered value from the range of
/// the image's neighbours counts too, as the second kind.
pub fn energy(pixels: Pixels, rendered: &[f32], fit: &Fit) -> Vec<BothResiduals> {
    let Pixels { image, judged, told_apart, width } = pixels;
    let of_channel = |i: usize, c: usize| -> BothResiduals {
        let expected = |n: usize| fit.gain[c] * rendered[n * 3 + c] + fit.offset[c];
        let seen = |n: usize| image[n * 3 + c];
        let unexpected = beyond(seen(i), neighbours(i, judged, width).map(expected));
        let missing = if told_apart[i] { beyond(expected(i), neighbours(i, judged, width).map(seen)) } else { 0.0 };
        [unexpected.powi(2), missing.powi(2)]
    };
    let of_pixel = |i: usize| (0..3).map(|c| of_channel(i, c)).fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
    (0..judged.len()).map(|i| if judged[i] { of_pixel(i) } else { [0.0; 2] }).collect()
}

/// Lets each state explain the pixels of the vehicle itself as the other states do that have it elsewhere, but agree about
/// the hazard: the vehicle's place varies. `energies` and `own` have one entry a state, and `own` is sorted.
pub fn explain_own(energies: &mut [Vec<BothResiduals>], own: &[Vec<usize>], hazard_states: &[bool]) {
    let before = energies.to_vec();
    for (state, pixels) in own.iter().enumerate() {
        for &i in pixels {
            let elsewhere = |other: &usize| {
                hazard_states.get(*other) == hazard_states.get(state) && own[*other].binary_search(&i).is_err()
            };
            let others = (0..own.len()).filter(elsewhere).map(|other| before[other][i]);
            let smaller = |a: BothResiduals, b: BothResiduals| if b[0] + b[1] < a[0] + a[1] { b } else { a };
            energies[state][i] = others.fold(before[state][i], smaller);
        }
    }
}

/// Root of the median over 3 x 3 pixels (the lower one of an even number), of the mean over channels, in deviations: a
/// speck or a thin line that the field misses is not an object.
pub fn median_residual(
    energy: &[BothResiduals],
    kind: ResidualKind,
    judged: &[bool],
    width: usize,
    noise: f32,
) -> Vec<f32> {
    let of_pixel = |i: usize| {
        let (mut near, mut count) = ([0.0; 9], 0);
        for at in neighbours(i, judged, width) {
            near[count] = energy[at][kind as usize];
            count += 1;
        }
        let near = &mut near[..count];
        near.sort_unstable_by(f32::total_cmp);
        (near[(count - 1) / 2] / 3.0).sqrt() / noise
    };
    (0..judged.len()).map(|i| if judged[i] { of_pixel(i) } else { 0.0 }).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::fit::LEAST_NOISE;

    /// A patch that the rendered image does not have is the only residual; a shift by one pixel and a thin line leave none.
    #[test]
    fn residuals_are_where_something_is() {
        let width = 32;
        let rendered: Vec<f32> = (0..width * width * 3).map(|i| if i / 3 % width < 16 { 0.2 } else { 0.7 }).collect();
        let seen: Vec<f32> = (0..width * width * 3)
            .map(|i| {
                let (x, y) = (i / 3 % width, i / 3 / width);
                if (4..9).contains(&x) && (20..25).contains(&y) {
                    0.9
                } else if x == 25 && y % 3 > 0 {
                    0.1
                } else if x < 17 {
                    0.2
                } else {
                    0.7
                }
            })
            .collect();
        let fit = Fit { gain: [1.0; 3], offset: [0.0; 3], noise: LEAST_NOISE, explained: 1.0 };
        let judged = vec![true; width * width];
        let pixels = Pixels { image: &seen, judged: &judged, told_apart: &vec![true; width * width], width };
        let out =
            median_residual(&energy(pixels, &rendered, &fit), ResidualKind::Unexpected, &judged, width, fit.noise);
        assert!(out[22 * width + 6] > 20.0);
        let elsewhere =
            (0..width * width).filter(|i| !(2..11).contains(&(i % width)) || !(18..27).contains(&(i / width)));
        assert!(elsewhere.map(|i| out[i]).fold(0.0, f32::max) < 1e-3);
    }

    /// A vehicle that a state has and the image does not show is a residual, where another state looks different; a
    /// detail that all states have and the image has lost is none.
    #[test]
    fn a_missing_vehicle_counts() {
        let width = 16;
        // The vehicle's dark and bright parts alternate, so the road's value is in the range at each of its pixels.
        let vehicle = |i: usize| if (i % width).is_multiple_of(2) { 0.1 } else { 0.9 };
        let is_vehicle = |i: usize| (4..11).contains(&(i % width)) && (4..11).contains(&(i / width));
        let with_it: Vec<f32> =
            (0..width * width * 3).map(|i| if is_vehicle(i / 3) { vehicle(i / 3) } else { 0.5 }).collect();
        let road = vec![0.5; width * width * 3];
        let fit = Fit { gain: [1.0; 3], offset: [0.0; 3], noise: LEAST_NOISE, explained: 1.0 };
        let judged = vec![true; width * width];
        let residual = |states: &[&[f32]]| {
            let pixels = Pixels { image: &road, judged: &judged, told_apart: &told_apart(states), width };
            let energy = energy(pixels, &with_it, &fit);
            ResidualKind::ALL.map(|kind| median_residual(&energy, kind, &judged, width, fit.noise)[7 * width + 7])
        };
        let [unexpected, missing] = residual(&[&with_it, &road]);
        assert!(unexpected < 1e-3 && missing > 20.0, "{unexpected} {missing}");
        assert_eq!(residual(&[&with_it, &with_it]), [unexpected, 0.0]);
    }

    /// The place where a state has the vehicle itself hides nothing: its pixels must be explained with the vehicle there, or
    /// as by a state of the same side that has it elsewhere.
    #[test]
    fn the_own_place_hides_nothing() {
        // Pixel 0: the vehicle is there. Pixel 1: the road is seen. Pixel 2: something else. Pixel 3: the hazard.
        let energy = |values: [f32; 4]| values.map(|v| [v, 0.0]).to_vec();
        let with_it = energy([0.0, 4.0, 4.0, 4.0]);
        let without = energy([4.0, 0.0, 4.0, 4.0]);
        let hazard = energy([4.0, 0.0, 4.0, 0.0]);
        let mut energies = [with_it, without.clone(), hazard.clone()];
        explain_own(&mut energies, &[vec![0, 1, 2, 3], vec![], vec![]], &[false, false, true]);
        assert_eq!(energies, [energy([0.0, 0.0, 4.0, 4.0]), without, hazard]);
    }
}
