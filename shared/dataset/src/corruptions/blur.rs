//! Blurs of optics and motion. Lengths are pixels of a 224 x 224 image.

use super::raster::Raster;
use rand::Rng;

/// Radius of the disk, and standard deviation of its soft edge.
const DEFOCUS: [(f32, f32); 5] = [(3.0, 0.1), (4.0, 0.5), (6.0, 0.5), (8.0, 0.5), (10.0, 0.5)];
/// Standard deviation of the blur, largest shift along each axis, and number of passes.
const GLASS: [(f32, f32, usize); 5] = [(0.7, 1.0, 2), (0.9, 2.0, 1), (1.0, 2.0, 3), (1.1, 3.0, 2), (1.5, 4.0, 2)];
/// Radius and standard deviation of the motion.
const MOTION: [(usize, f32); 5] = [(10, 3.0), (15, 5.0), (15, 8.0), (15, 12.0), (20, 15.0)];
/// Largest angle of the motion to the horizontal, degrees.
const MOTION_ANGLE_DEG: f32 = 45.0;
/// Number of zooms after the first, and step of the zoom.
const ZOOM: [(usize, f32); 5] = [(10, 0.01), (15, 0.01), (10, 0.02), (12, 0.02), (10, 0.03)];
/// Points along each axis of a pixel that decide its share of a disk.
const DISK_POINTS: usize = 8;

pub(super) fn defocus(raster: &Raster<3>, level: usize) -> Raster<3> {
    let (radius, edge) = DEFOCUS[level];
    let (radius, edge) = (radius * raster.scale(), edge * raster.scale());
    let disk = disk(radius);
    let total: f32 = disk.iter().map(|(_, _, weight)| weight).sum();
    let blurred = raster.like(|x, y| {
        let mut sum = [0.0; 3];
        for (dx, dy, weight) in &disk {
            let value = raster.at(x as isize + dx, y as isize + dy);
            sum.iter_mut().zip(value).for_each(|(s, v)| *s += weight * v);
        }
        sum.map(|v| v / total)
    });
    blurred.blurred(edge)
}

/// Returns the pixels of a disk: column, row, and covered share.
fn disk(radius: f32) -> Vec<(isize, isize, f32)> {
    let reach = radius.ceil() as isize;
    let point = |i: usize| (i as f32 + 0.5) / DISK_POINTS as f32 - 0.5;
    let points = || (0..DISK_POINTS).flat_map(|i| (0..DISK_POINTS).map(move |j| (point(i), point(j))));
    let share = |dx: isize, dy: isize| {
        let inside = |(u, v): &(f32, f32)| (dx as f32 + u).hypot(dy as f32 + v) <= radius;
        points().filter(inside).count() as f32
    };
    let all = (-reach..=reach).flat_map(|dy| (-reach..=reach).map(move |dx| (dx, dy)));
    let covered: Vec<_> = all.map(|(dx, dy)| (dx, dy, share(dx, dy))).filter(|(_, _, share)| *share > 0.0).collect();
    if covered.is_empty() { vec![(0, 0, 1.0)] } else { covered }
}

pub(super) fn glass(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let (sigma, shift, passes) = GLASS[level];
    let (sigma, shift) = (sigma * raster.scale(), shift * raster.scale());
    let mut shuffled = raster.blurred(sigma);
    let (width, height) = (shuffled.width, shuffled.height);
    for _ in 0..passes {
        for (y, x) in (0..height).rev().flat_map(|y| (0..width).rev().map(move |x| (y, x))) {
            // A shift below half a pixel is rounded to none: images below 112 x 112 are only blurred at severity 1.
            let mut near = |at: usize, count: usize| {
                let moved = at as f32 + rng.random_range(-shift..=shift);
                (moved.round().max(0.0) as usize).min(count - 1)
            };
            let other = (near(x, width), near(y, height));
            shuffled.pixels.swap(y * width + x, other.1 * width + other.0);
        }
    }
    shuffled.blurred(sigma)
}

pub(super) fn motion(raster: &Raster<3>, level: usize, rng: &mut impl Rng) -> Raster<3> {
    let (radius, sigma) = MOTION[level];
    let angle = rng.random_range(-MOTION_ANGLE_DEG..=MOTION_ANGLE_DEG);
    raster.moved(radius, sigma, angle, raster.scale())
}

pub(super) fn zoom(raster: &Raster<3>, level: usize) -> Raster<3> {
    let (count, step) = ZOOM[level];
    let [cx, cy] = raster.middle();
    raster.like(|x, y| {
        let (dx, dy) = (x as f32 - cx, y as f32 - cy);
        // The unchanged image counts twice: as itself and as the first zoom.
        let mut sum = raster.pixels[y * raster.width + x].map(|v| 2.0 * v);
        for i in 1..=count {
            let factor = 1.0 + step * i as f32;
            let value = raster.sample(cx + dx / factor, cy + dy / factor);
            sum.iter_mut().zip(value).for_each(|(s, v)| *s += v);
        }
        sum.map(|v| v / (count + 2) as f32)
    })
}
