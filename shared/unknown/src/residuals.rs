//! Residuals: how far each pixel of an image is from what a known state renders there.

use crate::fit::Fit;

/// Values of a pixel.
const CHANNELS: usize = 3;
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

/// Smallest and largest value of the compared pixels around each pixel, by channel.
#[derive(Debug)]
struct Ranges {
    low: Vec<f32>,
    high: Vec<f32>,
}

impl Ranges {
    /// Finds the ranges of an image, RGB, row by row. Pixels that are not compared do not count.
    fn of(image: &[f32], judged: &[bool], width: usize) -> Self {
        Self {
            low: with_neighbours(image, judged, width, f32::INFINITY, |a, b| if b < a { b } else { a }),
            high: with_neighbours(image, judged, width, f32::NEG_INFINITY, |a, b| if b > a { b } else { a }),
        }
    }

    /// The ranges of both images together.
    fn joined(mut self, other: &Self) -> Self {
        self.low.iter_mut().zip(&other.low).for_each(|(low, v)| *low = low.min(*v));
        self.high.iter_mut().zip(&other.high).for_each(|(high, v)| *high = high.max(*v));
        self
    }

    /// Distance of a value from its range.
    fn beyond(&self, i: usize, value: f32) -> f32 {
        (value - self.high[i]).max(self.low[i] - value).max(0.0)
    }
}

/// Joins the values of each pixel's 3 x 3 neighbourhood, by channel. Pixels that are not compared count as `missing`.
pub(crate) fn with_neighbours(
    image: &[f32],
    judged: &[bool],
    width: usize,
    missing: f32,
    pick: impl Fn(f32, f32) -> f32,
) -> Vec<f32> {
    let mut values = image.to_vec();
    for (pixel, _) in values.chunks_exact_mut(CHANNELS).zip(judged).filter(|(_, judged)| !**judged) {
        pixel.fill(missing);
    }
    let row = (width * CHANNELS).max(1);
    let mut of_rows = values.clone();
    values.chunks(row).zip(of_rows.chunks_mut(row)).for_each(|(from, to)| join(from, CHANNELS, to, &pick));
    values.copy_from_slice(&of_rows);
    join(&of_rows, row, &mut values, &pick);
    values
}

/// Joins each value of `to` with those of `from` that are `step` before and after it.
fn join(from: &[f32], step: usize, to: &mut [f32], pick: impl Fn(f32, f32) -> f32) {
    let step = step.min(to.len());
    to.iter_mut().zip(&from[step..]).for_each(|(to, v)| *to = pick(*to, *v));
    to[step..].iter_mut().zip(from).for_each(|(to, v)| *to = pick(*to, *v));
}

/// The image and the pixels of it that count.
#[derive(Debug)]
pub struct Pixels<'a> {
    image: &'a [f32],
    judged: &'a [bool],
    width: usize,
    /// True where the rendered states do not look alike.
    told_apart: Vec<bool>,
    seen: Ranges,
}

impl<'a> Pixels<'a> {
    /// Describes an image, 0..=1, RGB, row by row. `judged` is true for pixels that were compared with the rendered
    /// `states`.
    pub fn new(image: &'a [f32], judged: &'a [bool], states: &[&[f32]], width: usize) -> Self {
        Self { image, judged, width, told_apart: told_apart(states), seen: Ranges::of(image, judged, width) }
    }

    /// Squared distance of each pixel from the range of its neighbours' rendered values, summed over the channels. The
    /// range forgives what a blurred edge, or a pose that is off by half a pixel, changes. `rays` are further rendered
    /// values of each pixel, which count in the ranges, too.
    ///
    /// It also forgives a vehicle that the state has and the image does not show: the vehicle's edges, windows and
    /// wheels span the road's values. So where the states do not look alike, the distance of the rendered value from the
    /// range of the image's neighbours counts too, as the second kind.
    pub fn energy(&self, rendered: &[f32], rays: &[Vec<f32>], fit: &Fit) -> Vec<BothResiduals> {
        let expected = |rendered: &[f32]| -> Vec<f32> {
            rendered.chunks_exact(CHANNELS).flat_map(|pixel| fit.seen(pixel)).collect()
        };
        let ranges_of = |image: &[f32]| Ranges::of(image, self.judged, self.width);
        let of_rays = rays.iter().map(|rays| ranges_of(&expected(rays)));
        let expected = expected(rendered);
        let ranges = of_rays.fold(ranges_of(&expected), |all, rays| all.joined(&rays));
        let of_pixel = |pixel: usize| {
            let values = pixel * CHANNELS..(pixel + 1) * CHANNELS;
            let both = |i: usize| {
                let missing = if self.told_apart[pixel] { self.seen.beyond(i, expected[i]) } else { 0.0 };
                [ranges.beyond(i, self.image[i]), missing]
            };
            values.map(both).fold([0.0; 2], |sum, both| [0, 1].map(|kind| sum[kind] + both[kind].powi(2)))
        };
        (0..self.judged.len()).map(|i| if self.judged[i] { of_pixel(i) } else { [0.0; 2] }).collect()
    }
}

/// Returns true for each pixel at which the rendered states differ by more than their errors.
fn told_apart(states: &[&[f32]]) -> Vec<bool> {
    let Some(first) = states.first() else { return Vec::new() };
    let (mut low, mut high) = (first.to_vec(), first.to_vec());
    for state in &states[1..] {
        low.iter_mut().zip(*state).for_each(|(low, v)| *low = low.min(*v));
        high.iter_mut().zip(*state).for_each(|(high, v)| *high = high.max(*v));
    }
    let differs = |(low, high): (&[f32], &[f32])| low.iter().zip(high).any(|(low, high)| high - low > TOLD_APART);
    low.chunks_exact(CHANNELS).zip(high.chunks_exact(CHANNELS)).map(differs).collect()
}

/// Lets each state explain some pixels as any state does that agrees about the hazard. `energies` has one entry a state.
pub fn explain_together(energies: &mut [Vec<BothResiduals>], pixels: &[usize], hazard_states: &[bool]) {
    for hazard in [false, true] {
        let is_of_side = |state: &usize| hazard_states.get(*state).copied().unwrap_or(false) == hazard;
        let side: Vec<usize> = (0..energies.len()).filter(is_of_side).collect();
        for &i in pixels {
            let Some(least) = side.iter().map(|&state| energies[state][i]).reduce(smaller) else { break };
            for &state in &side {
                energies[state][i] = least;
            }
        }
    }
}

/// The smaller one of two residuals, by the sum of both kinds.
pub fn smaller(a: BothResiduals, b: BothResiduals) -> BothResiduals {
    if b[0] + b[1] < a[0] + a[1] { b } else { a }
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
        (lower_median(near, count) / 3.0).sqrt() / noise
    };
    (0..judged.len()).map(|i| if judged[i] { of_pixel(i) } else { 0.0 }).collect()
}

/// Returns the lower median of the first `count` values (at least one), of which none is below zero. The others are 0.
fn lower_median(mut values: [f32; 9], count: usize) -> f32 {
    if values == [0.0; 9] {
        return 0.0;
    }
    *values[..count].select_nth_unstable_by((count - 1) / 2, f32::total_cmp).1
}

#[cfg(test)]
mod tests {
    use super::*;

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
        let fit = Fit::EXACT;
        let judged = vec![true; width * width];
        let energy = Pixels::new(&seen, &judged, &[&rendered], width).energy(&rendered, &[], &fit);
        let out = median_residual(&energy, ResidualKind::Unexpected, &judged, width, fit.noise);
        assert!(out[22 * width + 6] > 20.0);
        let elsewhere =
            (0..width * width).filter(|i| !(2..11).contains(&(i % width)) || !(18..27).contains(&(i / width)));
        assert!(elsewhere.map(|i| out[i]).fold(0.0, f32::max) < 1e-3);
    }

    /// A line that the pixels' middles miss is explained by further rays that meet it; something of another colour is not.
    #[test]
    fn further_rays_explain_what_one_misses() {
        let width = 16;
        let image = |value: f32| vec![value; width * width * CHANNELS];
        let is_line = |i: usize| (7..9).contains(&(i / CHANNELS / width));
        let with_line = |line: f32| (0..image(0.0).len()).map(|i| if is_line(i) { line } else { 0.3 }).collect();
        let (road, line): (Vec<f32>, Vec<f32>) = (image(0.3), with_line(0.9));
        let fit = Fit::EXACT;
        let judged = vec![true; width * width];
        let residual = |seen: f32, rays: &[Vec<f32>]| {
            let seen: Vec<f32> = with_line(seen);
            let energy = Pixels::new(&seen, &judged, &[&road], width).energy(&road, rays, &fit);
            median_residual(&energy, ResidualKind::Unexpected, &judged, width, fit.noise)[8 * width + 8]
        };
        let rays = [road.clone(), line];
        assert!(residual(0.5, &[]) > 5.0 && residual(0.5, &rays) == 0.0, "a grey line in place of a white one");
        assert!(residual(0.1, &rays) > 5.0, "something darker than both");
    }

    /// The range of a pixel is that of its compared neighbours, to the edges of the image.
    #[test]
    fn ranges_are_those_of_the_neighbours() {
        let (width, height) = (7, 5);
        let value = |i: usize| (i * 37 % 101) as f32;
        let image: Vec<f32> = (0..width * height * CHANNELS).map(value).collect();
        let judged: Vec<bool> = (0..width * height).map(|i| i % 4 != 1).collect();
        let ranges = Ranges::of(&image, &judged, width);
        for pixel in (0..width * height).filter(|pixel| judged[*pixel]) {
            for c in 0..CHANNELS {
                let near = || neighbours(pixel, &judged, width).map(|n| image[n * CHANNELS + c]);
                let i = pixel * CHANNELS + c;
                assert_eq!(ranges.low[i], near().fold(f32::INFINITY, f32::min));
                assert_eq!(ranges.high[i], near().fold(f32::NEG_INFINITY, f32::max));
            }
        }
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
        let fit = Fit::EXACT;
        let judged = vec![true; width * width];
        let residual = |states: &[&[f32]]| {
            let energy = Pixels::new(&road, &judged, states, width).energy(&with_it, &[], &fit);
            ResidualKind::ALL.map(|kind| median_residual(&energy, kind, &judged, width, fit.noise)[7 * width + 7])
        };
        let [unexpected, missing] = residual(&[&with_it, &road]);
        assert!(unexpected < 1e-3 && missing > 20.0, "{unexpected} {missing}");
        assert_eq!(residual(&[&with_it, &with_it]), [unexpected, 0.0]);
    }

    /// States of one side explain pixels together, and nothing that only the other side has.
    #[test]
    fn a_side_explains_together() {
        // Pixel 0: not shared. Pixel 1: the other state has it. Pixel 2: no state has it. Pixel 3: the hazard.
        let energy = |values: [f32; 4]| values.map(|v| [v, 0.0]).to_vec();
        let mut energies = [energy([0.0, 4.0, 4.0, 4.0]), energy([4.0, 0.0, 4.0, 4.0]), energy([4.0, 4.0, 4.0, 0.0])];
        explain_together(&mut energies, &[1, 2, 3], &[false, false, true]);
        let expected = [energy([0.0, 0.0, 4.0, 4.0]), energy([4.0, 0.0, 4.0, 4.0]), energy([4.0, 4.0, 4.0, 0.0])];
        assert_eq!(energies, expected);
    }
}
