//! Renders images: rays, light, anti-aliasing. Every pixel depends only on the scene and the camera, with fixed
//! sampling patterns. So images are the same bytes for any number of threads, and two scenes that differ in a vehicle
//! give the same bytes wherever neither it nor its shadow is visible.

use carff_base::geometry::PinholeCamera;
use carff_dataset::Image;
use parry3d::partitioning::{Bvh, BvhBuildStrategy};
use parry3d::query::Ray;
use rayon::prelude::*;

use crate::config::{GroundSurface, MarkingConfig, RoadConfig, ScenarioConfig};
use crate::materials::{Material, Surface, asphalt, marking};
use crate::scenery::{Body, GROUND, SKY};
use crate::shapes::Vec3;

const FAR_M: f32 = 2000.0;
/// Offset of light rays from a surface, metres, for objects as large as vehicles.
const START_M: f32 = 2e-3;
/// Range of ambient occlusion for such objects, metres.
const VEHICLE_SHADE_REACH_M: f32 = 1.6;
const SUN: Vec3 = Vec3::new(1.50, 1.42, 1.27);
const SKY_LIGHT: Vec3 = Vec3::new(0.50, 0.58, 0.70);
const BOUNCE: Vec3 = Vec3::new(0.20, 0.20, 0.175);
const ZENITH: Vec3 = Vec3::new(0.22, 0.40, 0.72);
const HORIZON: Vec3 = Vec3::new(0.62, 0.74, 0.88);
/// Order of a pixel's samples: the first four are a rotated grid, one per quadrant.
const ORDER: [usize; 16] = [1, 7, 8, 14, 0, 2, 3, 4, 5, 6, 9, 10, 11, 12, 13, 15];
/// Largest difference in brightness of four samples of one object at which a pixel is finished.
const FLAT_ENOUGH: f32 = 0.045;

/// A straight strip on the ground, prepared for hit tests.
#[derive(Clone, Debug)]
struct Strip {
    from: [f32; 2],
    along: [f32; 2],
    length: f32,
    half_width: f32,
    period: f32,
    dash: f32,
    colour: Vec3,
    low: [f32; 2],
    high: [f32; 2],
}

impl Strip {
    fn new(from: [f64; 2], to: [f64; 2], width: f64, dash: f64, gap: f64, colour: [f32; 3]) -> Self {
        let d = [to[0] - from[0], to[1] - from[1]];
        let length = d[0].hypot(d[1]).max(1e-6);
        let reach = width / 2.0;
        let side = |i: usize, sign: f64| {
            let edge = if sign < 0.0 { from[i].min(to[i]) } else { from[i].max(to[i]) };
            (edge + sign * reach) as f32
        };
        Self {
            from: from.map(|v| v as f32),
            along: d.map(|v| (v / length) as f32),
            length: length as f32,
            half_width: reach as f32,
            period: if dash > 0.0 { (dash + gap) as f32 } else { 0.0 },
            dash: dash as f32,
            colour: Vec3::from_array(colour),
            low: [side(0, -1.0), side(1, -1.0)],
            high: [side(0, 1.0), side(1, 1.0)],
        }
    }

    fn road(r: &RoadConfig) -> Self {
        Self::new(r.from, r.to, r.width_m, 0.0, 0.0, [0.0; 3])
    }

    fn marking(m: &MarkingConfig) -> Self {
        Self::new(m.from, m.to, m.width_m, m.dash_m, m.gap_m, m.colour)
    }

    fn covers(&self, p: Vec3) -> bool {
        if p.x < self.low[0] || p.x > self.high[0] || p.y < self.low[1] || p.y > self.high[1] {
            return false;
        }
        let (x, y) = (p.x - self.from[0], p.y - self.from[1]);
        let along = x * self.along[0] + y * self.along[1];
        let across = y * self.along[0] - x * self.along[1];
        across.abs() <= self.half_width
            && (0.0..=self.length).contains(&along)
            && (self.period == 0.0 || along.rem_euclid(self.period) < self.dash)
    }
}

/// The ground at z = 0 and the sun: equal in all states of a scenario.
#[derive(Clone, Debug)]
pub(crate) struct Setting {
    roads: Vec<Strip>,
    markings: Vec<Strip>,
    open: Material,
    sun: Vec3,
    /// Range of ambient occlusion, metres.
    shade_reach_m: f32,
    /// Offset of light rays from a surface, metres.
    start_m: f32,
    /// Directions to 16 points of the sun's disc.
    sun_points: [Vec3; 16],
}

impl Setting {
    pub fn new(config: &ScenarioConfig) -> Self {
        let azimuth = config.sun.azimuth_deg.to_radians() as f32;
        let elevation = config.sun.elevation_deg.to_radians() as f32;
        let sun =
            Vec3::new(elevation.cos() * azimuth.cos(), elevation.cos() * azimuth.sin(), elevation.sin()).normalize();
        let (u, v) = tangents(sun);
        let radius = config.sun.radius_deg.to_radians().tan() as f32;
        let sun_points = std::array::from_fn(|i| {
            // A sunflower pattern: evenly spread over the disc; the permutation also spreads the first four samples.
            let n = (SHUFFLE[i] as f32) + 0.5;
            let (r, a) = ((n / 16.0).sqrt() * radius, n * 2.399_963);
            (sun + u * (r * a.cos()) + v * (r * a.sin())).normalize()
        });
        let shade_reach_m = config.shade_reach_m as f32;
        Self {
            shade_reach_m,
            start_m: START_M * (shade_reach_m / VEHICLE_SHADE_REACH_M),
            roads: config.road.iter().map(Strip::road).collect(),
            markings: config.marking.iter().map(Strip::marking).collect(),
            open: match config.ground_surface {
                GroundSurface::Grass => Material::Grass { colour: Vec3::from_array(config.ground_colour) },
                GroundSurface::Plain => Material::Plain { colour: Vec3::from_array(config.ground_colour) },
            },
            sun,
            sun_points,
        }
    }

    fn ground(&self, p: Vec3, footprint: f32) -> Surface {
        if self.roads.iter().any(|r| r.covers(p)) {
            return match self.markings.iter().find(|m| m.covers(p)) {
                Some(m) => marking(p, m.colour, footprint),
                None => asphalt(p, footprint),
            };
        }
        self.open.at(p, p, Vec3::Z, footprint)
    }
}

/// Pairs sub-pixel i with light sample `SHUFFLE[i]`; those of the first four in [`ORDER`] are spread over the disc.
const SHUFFLE: [usize; 16] = [5, 2, 12, 9, 15, 7, 0, 6, 10, 3, 13, 1, 8, 11, 14, 4];

/// Returns two unit vectors orthogonal to a unit vector and to each other.
fn tangents(n: Vec3) -> (Vec3, Vec3) {
    let helper = if n.z.abs() < 0.9 { Vec3::Z } else { Vec3::X };
    let u = helper.cross(n).normalize();
    (u, n.cross(u))
}

/// All solids of a state, prepared for rays.
#[derive(Clone)]
pub(crate) struct Scene {
    bodies: Vec<Body>,
    tree: Bvh,
}

/// The first hit of a ray.
#[derive(Clone, Copy)]
struct Hit {
    t: f32,
    /// Index of the hit body; `None`: the ground.
    body: Option<u32>,
}

impl Scene {
    pub fn new(bodies: Vec<Body>) -> Self {
        let boxes: Vec<_> = bodies.iter().map(|b| b.solid.aabb()).collect();
        Self { tree: Bvh::from_leaves(BvhBuildStrategy::Binned, &boxes), bodies }
    }

    pub fn bodies(&self) -> &[Body] {
        &self.bodies
    }

    fn nearest_body(&self, origin: Vec3, direction: Vec3, limit: f32) -> Option<(u32, f32)> {
        self.tree.cast_ray(&Ray::new(origin, direction), limit, |i, best| {
            self.bodies[i as usize].solid.enter(origin, direction, best).map(|e| e.t)
        })
    }

    fn blocked(&self, origin: Vec3, direction: Vec3, limit: f32) -> bool {
        // A hit reports distance 0, so that the search ends with it.
        self.tree
            .cast_ray(&Ray::new(origin, direction), limit, |i, _| {
                self.bodies[i as usize].solid.enter(origin, direction, limit).map(|_| 0.0)
            })
            .is_some()
    }

    fn first_hit(&self, origin: Vec3, direction: Vec3) -> Option<Hit> {
        let ground = if direction.z < 0.0 && origin.z > 0.0 { -origin.z / direction.z } else { FAR_M };
        let limit = ground.min(FAR_M);
        match self.nearest_body(origin, direction, limit) {
            Some((body, t)) => Some(Hit { t, body: Some(body) }),
            None if ground < FAR_M => Some(Hit { t: ground, body: None }),
            None => None,
        }
    }

    /// Returns the distance along a ray to the first solid or the ground, metres, and its object index.
    pub fn probe(&self, origin: Vec3, direction: Vec3) -> (f32, u16) {
        match self.first_hit(origin, direction) {
            None => (f32::INFINITY, SKY),
            Some(Hit { t, body: None }) => (t, GROUND),
            Some(Hit { t, body: Some(i) }) => (t, self.bodies[i as usize].object),
        }
    }

    /// Returns linear colour and object along a ray; `sample` selects the sun and sky directions.
    fn shade(&self, setting: &Setting, origin: Vec3, direction: Vec3, pixel_angle: f32, sample: usize) -> (Vec3, u16) {
        let Some(hit) = self.first_hit(origin, direction) else {
            return (sky(direction), SKY);
        };
        let p = origin + direction * hit.t;
        let (surface, normal, object) = match hit.body {
            None => {
                // The footprint across the line of sight; grazing views stretch it, and half of the stretch counts.
                let stretch = (1.0 / -direction.z).min(6.0).sqrt();
                (setting.ground(p, hit.t * pixel_angle * stretch), Vec3::Z, GROUND)
            }
            Some(index) => {
                let body = &self.bodies[index as usize];
                // The test equals that of the search, hence the entry is equal.
                let local_normal = body.solid.enter(origin, direction, FAR_M).map_or(Vec3::Z, |entry| entry.normal);
                let local = body.solid.to_local(p - body.solid.center);
                let stretch = (1.0 / body.solid.to_world(local_normal).dot(direction).abs().max(0.03)).min(6.0).sqrt();
                let surface = body.material.at(p, local, local_normal, hit.t * pixel_angle * stretch);
                (surface, body.solid.to_world(local_normal), body.object)
            }
        };
        let start = p + normal * setting.start_m;
        let to_sun = setting.sun_points[sample];
        let facing = normal.dot(setting.sun);
        let sun = if facing > 0.0 && !self.blocked(start, to_sun, FAR_M) { facing } else { 0.0 };
        let open = if self.blocked(start, sky_direction(normal, sample), setting.shade_reach_m) { 0.0 } else { 1.0 };
        let up = 0.5 + 0.5 * normal.z;
        let ambient = (SKY_LIGHT * up + BOUNCE * (1.0 - up)) * (0.25 + 0.75 * open);
        let mut colour = surface.albedo * (SUN * sun + ambient);
        if surface.mirror > 0.0 || surface.highlight > 0.0 {
            let mirrored = direction - normal * (2.0 * direction.dot(normal));
            let grazing = 1.0 - direction.dot(normal).abs();
            colour += sky(mirrored) * (surface.mirror * (0.6 + grazing * grazing));
            if sun > 0.0 {
                let gleam = mirrored.dot(setting.sun).max(0.0).powi(24);
                colour += SUN * (surface.highlight * gleam * 0.35);
            }
        }
        // Distant objects fade into the horizon's colour.
        let haze = 1.0 - (-hit.t / 320.0).exp();
        (colour + (HORIZON - colour) * haze, object)
    }

    /// Renders an image with only RGB.
    pub fn image(&self, setting: &Setting, camera: &PinholeCamera) -> Image {
        let (w, h) = (camera.width_px as usize, camera.height_px as usize);
        let mut rgb = vec![0_u8; w * h * 3];
        rgb.par_chunks_mut(w * 3).enumerate().for_each(|(y, row)| self.row(setting, camera, y, row));
        Image { width_px: camera.width_px, height_px: camera.height_px, rgb }
    }

    /// Renders an image with RGB, depth along the ray through each pixel's centre (metres; infinite for the sky), and
    /// the object index of the first hit there.
    pub fn trace(&self, setting: &Setting, camera: &PinholeCamera) -> (Image, Vec<f32>, Vec<u16>) {
        let (w, h) = (camera.width_px as usize, camera.height_px as usize);
        let mut rgb = vec![0_u8; w * h * 3];
        let mut depth_m = vec![0.0_f32; w * h];
        let mut object_id = vec![0_u16; w * h];
        rgb.par_chunks_mut(w * 3).zip(depth_m.par_chunks_mut(w)).zip(object_id.par_chunks_mut(w)).enumerate().for_each(
            |(y, ((rgb, depth_m), object_id))| {
                self.row(setting, camera, y, rgb);
                for x in 0..w {
                    let (origin, direction) = ray(camera, x as f64 + 0.5, y as f64 + 0.5);
                    (depth_m[x], object_id[x]) = self.probe(origin, direction);
                }
            },
        );
        (Image { width_px: camera.width_px, height_px: camera.height_px, rgb }, depth_m, object_id)
    }

    fn row(&self, setting: &Setting, camera: &PinholeCamera, y: usize, rgb: &mut [u8]) {
        let pixel_angle = (1.0 / camera.fl_x_px) as f32;
        for (x, pixel) in rgb.chunks_exact_mut(3).enumerate() {
            let colour = self.pixel(setting, camera, x, y, pixel_angle);
            for (to, c) in pixel.iter_mut().zip(colour.to_array()) {
                *to = (encode(c) * 255.0).round() as u8;
            }
        }
    }

    fn pixel(&self, setting: &Setting, camera: &PinholeCamera, x: usize, y: usize, pixel_angle: f32) -> Vec3 {
        let take = |sample: usize| {
            let (sx, sy) = ((sample % 4) as f64, (sample / 4) as f64);
            let (origin, direction) = ray(camera, x as f64 + (sx + 0.5) / 4.0, y as f64 + (sy + 0.5) / 4.0);
            let (colour, object) = self.shade(setting, origin, direction, pixel_angle, sample);
            (colour.min(Vec3::ONE), object)
        };
        let mut sum = Vec3::ZERO;
        let (mut low, mut high) = (Vec3::ONE, Vec3::ZERO);
        let mut first_object = SKY;
        let mut mixed = false;
        for (n, &sample) in ORDER[..4].iter().enumerate() {
            let (colour, object) = take(sample);
            if n == 0 {
                first_object = object;
            }
            mixed |= object != first_object;
            sum += colour;
            let bright = Vec3::new(colour.x.max(0.0).sqrt(), colour.y.max(0.0).sqrt(), colour.z.max(0.0).sqrt());
            low = low.min(bright);
            high = high.max(bright);
        }
        if !mixed && (high - low).max_element() < FLAT_ENOUGH {
            return sum / 4.0;
        }
        for &sample in &ORDER[4..] {
            sum += take(sample).0;
        }
        sum / 16.0
    }
}

/// Returns origin and direction of a camera's ray; no component is exactly zero, so that slab tests never divide 0 by
/// 0.
pub(crate) fn ray(camera: &PinholeCamera, x_px: f64, y_px: f64) -> (Vec3, Vec3) {
    let ray = camera.ray(x_px, y_px);
    let direction = ray.direction.map(|d| if d.abs() < 1e-7 { 1e-7_f32.copysign(d) } else { d });
    (Vec3::from_array(ray.origin), Vec3::from_array(direction))
}

fn sky(direction: Vec3) -> Vec3 {
    let t = direction.z.max(0.0).sqrt().min(1.0);
    HORIZON + (ZENITH - HORIZON) * t
}

/// Returns one of 16 directions about a normal, with cosine distribution.
fn sky_direction(normal: Vec3, sample: usize) -> Vec3 {
    let (u, v) = tangents(normal);
    let n = SHUFFLE[(sample * 5 + 3) % 16] as f32 + 0.5;
    let (r, a) = ((n / 16.0).sqrt(), n * 2.399_963);
    u * (r * a.cos()) + v * (r * a.sin()) + normal * (1.0 - r * r).max(0.0).sqrt()
}

/// Converts linear to sRGB, 0..=1.
fn encode(c: f32) -> f32 {
    let c = c.clamp(0.0, 1.0);
    if c <= 0.003_130_8 { 12.92 * c } else { 1.055 * c.powf(1.0 / 2.4) - 0.055 }
}
