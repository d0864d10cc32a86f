//! Visibility of the actor, or of its place, in the images of one camera.

use super::{Actor, ActorView, Placement, PlacementKey, Scenario, key_of};
use crate::movers::{Pose, movers};
use crate::tracer::{Scene, ray};
use carff_base::geometry::PinholeCamera;
use carff_dataset::{Image, Observability, looks_same};
use std::collections::HashMap;

/// Minimum visible fraction of a `full` view.
pub const FULL_FRACTION: f64 = 0.75;
/// Minimum number of visible pixels of a `full` view (in an image of 128 x 128; proportional for other sizes).
pub const FULL_PIXELS: u32 = 12;
/// Maximum visible fraction of a `none` view.
pub const NONE_FRACTION: f64 = 0.02;
/// Maximum mean difference, of 255, between a `none` view's images with and without the actor.
pub const NONE_MEAN_DIFFERENCE: f64 = 0.02;
/// Size of the extended image in which hidden pixels are counted: this many widths beyond each edge.
const BEYOND: i64 = 3;

impl Scenario {
    /// Casts a ray per pixel centre at only the actor, in an unbounded image, and at the whole scene. Returns `None` if
    /// nothing is dynamic.
    pub(super) fn actor_view(&self, shots: &mut Shots, placement: &Placement, timestamp: usize) -> Option<ActorView> {
        let camera = shots.camera;
        let others = counterparts(placement, &self.placements, self.actor.as_ref(), timestamp);
        let dynamic = self.actor.as_ref()?.dynamic;
        let mover = movers(&self.config).nth(dynamic)?;
        let object = self.scenery.next_object + dynamic as u16;
        let (mut visible, mut would_be) = (0_u32, 0_u32);
        let poses: Vec<Pose> = match placement[dynamic] {
            Some(pose) => vec![pose],
            None => others.iter().filter_map(|o| o[dynamic]).collect(),
        };
        for pose in poses {
            let alone = Scene::new(mover.bodies(pose, object));
            let shot = shots.take(placement);
            let corners = alone.bodies().iter().flat_map(|b| {
                let aabb = b.solid.aabb();
                (0..8).map(move |i| {
                    let pick =
                        |axis: usize| f64::from(if i >> axis & 1 == 0 { aabb.mins[axis] } else { aabb.maxs[axis] });
                    [pick(0), pick(1), pick(2)]
                })
            });
            let (w, h) = (i64::from(camera.width_px), i64::from(camera.height_px));
            let (low, high) = reach(camera, corners);
            for y in low[1].max(-BEYOND * h)..high[1].min((BEYOND + 1) * h) {
                for x in low[0].max(-BEYOND * w)..high[0].min((BEYOND + 1) * w) {
                    let (origin, direction) = ray(camera, x as f64 + 0.5, y as f64 + 0.5);
                    let (t, hit) = alone.probe(origin, direction);
                    if hit != object {
                        continue;
                    }
                    would_be += 1;
                    if (0..w).contains(&x) && (0..h).contains(&y) {
                        // In a branch with the actor the first hit is the actor itself, at the same distance.
                        let at = (y * w + x) as usize;
                        visible += u32::from(shot.object_id[at] == object || t < shot.depth_m[at]);
                    }
                }
            }
        }
        let fraction = if would_be == 0 { 0.0 } else { f64::from(visible) / f64::from(would_be) };
        let scale = f64::from(camera.width_px) * f64::from(camera.height_px) / (128.0 * 128.0);
        let observability = if fraction >= FULL_FRACTION && f64::from(visible) >= f64::from(FULL_PIXELS) * scale {
            Observability::Full
        } else if fraction <= NONE_FRACTION {
            let own = shots.take(placement).image.clone();
            let hidden = others.iter().all(|other| {
                let image = &shots.take(other).image;
                looks_same(&own, image) && mean_difference(&own, image) <= NONE_MEAN_DIFFERENCE
            });
            if hidden { Observability::None } else { Observability::Partial }
        } else {
            Observability::Partial
        };
        Some(ActorView { visible_fraction: fraction as f32, actor_px: visible, observability })
    }
}

/// A camera's image of one placement.
pub(super) struct Shot {
    pub image: Image,
    pub depth_m: Vec<f32>,
    pub object_id: Vec<u16>,
}

/// The images of one camera by placement: equal states share an image.
pub(super) struct Shots<'a> {
    pub scenario: &'a Scenario,
    pub camera: &'a PinholeCamera,
    pub taken: HashMap<PlacementKey, Shot>,
}

impl Shots<'_> {
    pub fn take(&mut self, placement: &Placement) -> &Shot {
        let key = key_of(placement);
        let scenario = self.scenario;
        self.taken.entry(key).or_insert_with_key(|key| {
            let snap = |scene: &Scene| {
                let (image, depth_m, object_id) = scene.trace(&scenario.setting, self.camera);
                Shot { image, depth_m, object_id }
            };
            if let Some(scene) = scenario.scenes.get(key) {
                return snap(scene);
            }
            snap(&scenario.scene(placement))
        })
    }
}

fn mean_difference(a: &Image, b: &Image) -> f64 {
    let sum: u64 = a.rgb.iter().zip(&b.rgb).map(|(a, b)| u64::from(a.abs_diff(*b))).sum();
    sum as f64 / a.rgb.len().max(1) as f64
}

/// Returns the pixel range of projected points: lowest, and one past the highest. It is the maximum range if a point is
/// behind the camera.
fn reach(camera: &PinholeCamera, points: impl Iterator<Item = [f64; 3]>) -> ([i64; 2], [i64; 2]) {
    let (mut low, mut high) = ([f64::INFINITY; 2], [f64::NEG_INFINITY; 2]);
    let (mut behind, mut ahead) = (false, false);
    for point in points {
        match camera.project(point) {
            Some((pixel, depth)) if depth > 0.05 => {
                ahead = true;
                for i in 0..2 {
                    low[i] = low[i].min(pixel[i]);
                    high[i] = high[i].max(pixel[i]);
                }
            }
            _ => behind = true,
        }
    }
    match (ahead, behind) {
        (false, _) => ([0; 2], [0; 2]),
        (true, true) => ([i64::MIN / 4; 2], [i64::MAX / 4; 2]),
        (true, false) => (low.map(|v| v.floor() as i64 - 1), high.map(|v| v.ceil() as i64 + 1)),
    }
}

/// Returns counterparts of a placement: without the actor if it is present; else with the actor at each of its poses in
/// other branches at this time step.
pub(super) fn counterparts(
    own: &Placement,
    placements: &[Vec<Placement>],
    actor: Option<&Actor>,
    timestamp: usize,
) -> Vec<Placement> {
    let Some(actor) = actor else { return Vec::new() };
    let as_in = |other: Option<&Placement>| {
        let mut placement = own.clone();
        for &m in std::iter::once(&actor.dynamic).chain(&actor.followers) {
            placement[m] = other.and_then(|o| o[m]);
        }
        placement
    };
    if own[actor.dynamic].is_some() {
        return vec![as_in(None)];
    }
    let mut all: Vec<Placement> = Vec::new();
    for other in placements.iter().map(|b| &b[timestamp]).filter(|o| o[actor.dynamic].is_some()) {
        let with = as_in(Some(other));
        if !all.contains(&with) {
            all.push(with);
        }
    }
    all
}
