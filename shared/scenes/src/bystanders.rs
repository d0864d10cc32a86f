//! Bystanders as objects of simple shapes. Lengths follow the bystander's own length, width and height.

use crate::config::{BoxConfig, BystanderConfig, BystanderKind, EllipsoidConfig, ObjectConfig, RodConfig, SlabConfig};

/// Colour of rubber, dark cloth and shadowed parts, linear RGB.
const DARK: [f32; 3] = [0.02, 0.02, 0.022];
/// Colour of skin, linear RGB.
const SKIN: [f32; 3] = [0.5, 0.28, 0.19];
/// Colour of cut wood, linear RGB.
const CUT_WOOD: [f32; 3] = [0.5, 0.33, 0.16];
/// Colour of steel posts and bands, linear RGB.
const STEEL: [f32; 3] = [0.3, 0.31, 0.32];

/// Returns a bystander as a static object, on top of the highest slab at its position.
pub(crate) fn object_of(bystander: &BystanderConfig, slabs: &[SlabConfig]) -> ObjectConfig {
    let [x, y, yaw] = bystander.at;
    let below =
        |slab: &&SlabConfig| (slab.min[0]..=slab.max[0]).contains(&x) && (slab.min[1]..=slab.max[1]).contains(&y);
    let z = slabs.iter().filter(below).map(|slab| slab.height_m).fold(0.0, f64::max);
    let mut parts = Parts::default();
    parts.add(bystander);
    ObjectConfig {
        name: bystander.name.clone(),
        role: bystander.kind.name().to_owned(),
        dynamic: false,
        follows: None,
        at: [x, y, z, yaw],
        boxes: parts.boxes,
        ellipsoid: parts.ellipsoids,
        cylinder: parts.cylinders,
        capsule: parts.capsules,
        course: Vec::new(),
    }
}

/// Shapes in the object's own axes: +X ahead, +Z up, the ground at z = 0.
#[derive(Default)]
struct Parts {
    boxes: Vec<BoxConfig>,
    ellipsoids: Vec<EllipsoidConfig>,
    cylinders: Vec<RodConfig>,
    capsules: Vec<RodConfig>,
}

impl Parts {
    fn add(&mut self, bystander: &BystanderConfig) {
        let (size, colour) = (bystander.size_m, bystander.colour);
        match bystander.kind {
            BystanderKind::Crate => self.add_crate(size, colour),
            BystanderKind::Trunk => self.add_trunk(size, colour),
            BystanderKind::Pedestrian => self.add_pedestrian(size, colour),
            BystanderKind::Bicycle => self.add_bicycle(size, colour),
            BystanderKind::Animal => self.add_animal(size, colour),
            BystanderKind::Barrel => self.add_barrel(size, colour),
            BystanderKind::Board => self.add_board(size, colour),
        }
    }

    fn cuboid(&mut self, center: [f64; 3], size_m: [f64; 3], colour: [f32; 3]) {
        let turn_deg = [0.0; 3];
        self.boxes.push(BoxConfig {
            center,
            size_m,
            turn_deg,
            colour,
            checks: None,
            faces: None,
            variants: Vec::new(),
        });
    }

    fn ellipsoid(&mut self, center: [f64; 3], size_m: [f64; 3], colour: [f32; 3]) {
        self.ellipsoids.push(EllipsoidConfig { center, size_m, turn_deg: [0.0; 3], colour, variants: Vec::new() });
    }

    fn cylinder(&mut self, from: [f64; 3], to: [f64; 3], radius_m: f64, colour: [f32; 3]) {
        self.cylinders.push(RodConfig { from, to, radius_m, colour, variants: Vec::new() });
    }

    fn capsule(&mut self, from: [f64; 3], to: [f64; 3], radius_m: f64, colour: [f32; 3]) {
        self.capsules.push(RodConfig { from, to, radius_m, colour, variants: Vec::new() });
    }

    fn add_crate(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        self.cuboid([0.0, 0.0, 0.5 * h], [0.94 * l, 0.94 * w, 0.98 * h], colour);
        for z in [0.07, 0.5, 0.93] {
            self.cuboid([0.0, 0.0, z * h], [l, w, 0.12 * h], colour.map(|v| 0.55 * v));
        }
    }

    fn add_trunk(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        let r = 0.5 * h.min(w);
        self.cylinder([-0.49 * l, 0.0, r], [0.49 * l, 0.0, r], r, colour);
        for end in [-1.0, 1.0] {
            self.cylinder([end * 0.49 * l, 0.0, r], [end * 0.5 * l, 0.0, r], 0.86 * r, CUT_WOOD);
        }
        for (x, y, z) in [(0.22, 0.5, 1.0), (-0.05, -0.5, 0.8), (0.34, -0.3, 1.0)] {
            self.cylinder([x * l - 0.3 * r, 0.0, r], [x * l, y * w, z * h], 0.28 * r, colour);
        }
    }

    fn add_pedestrian(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        let r = 0.5 * l.min(w);
        for y in [-0.22, 0.22] {
            self.capsule([0.0, y * w, 0.16 * r + 0.02], [0.0, y * w, 0.45 * h], 0.38 * r, DARK);
        }
        self.capsule([0.0, 0.0, 0.52 * h], [0.0, 0.0, 0.74 * h], 0.8 * r, colour);
        for y in [-0.42, 0.42] {
            self.capsule([0.0, y * w, 0.44 * h], [0.0, y * w, 0.76 * h], 0.24 * r, colour);
        }
        self.ellipsoid([0.0, 0.0, 0.93 * h], [0.92 * r, 0.84 * r, 0.14 * h], SKIN);
    }

    fn add_bicycle(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        let r = (0.2 * l).min(0.5 * h);
        let (rear, front) = (r - 0.5 * l, 0.5 * l - r);
        for x in [rear, front] {
            self.cylinder([x, -0.03, r], [x, 0.03, r], r, DARK);
            self.cylinder([x, -0.035, r], [x, 0.035, r], 0.78 * r, STEEL);
        }
        let (pedals, seat, head) = ([-0.04 * l, 0.0, 0.9 * r], [-0.12 * l, 0.0, 0.86 * h], [0.22 * l, 0.0, 0.84 * h]);
        let tube = 0.035;
        for (from, to) in [(pedals, seat), (pedals, head), (seat, head)] {
            self.cylinder(from, to, tube, colour);
        }
        for (from, to) in [([rear, 0.0, r], seat), ([rear, 0.0, r], pedals), ([front, 0.0, r], head)] {
            self.cylinder(from, to, tube, colour);
        }
        self.cylinder([0.2 * l, -0.5 * w, 0.97 * h], [0.2 * l, 0.5 * w, 0.97 * h], tube, DARK);
        self.cylinder(head, [0.2 * l, 0.0, 0.97 * h], tube, colour);
        self.ellipsoid([-0.13 * l, 0.0, 0.9 * h], [0.16 * l, 0.16, 0.08], DARK);
    }

    fn add_animal(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        self.ellipsoid([-0.08 * l, 0.0, 0.6 * h], [0.78 * l, w, 0.46 * h], colour);
        for (x, y) in [(-0.36, -0.26), (-0.36, 0.26), (0.18, -0.26), (0.18, 0.26)] {
            self.capsule([x * l, y * w, 0.06 * w + 0.01], [x * l, y * w, 0.5 * h], 0.1 * w, colour.map(|v| 0.6 * v));
        }
        self.capsule([0.22 * l, 0.0, 0.66 * h], [0.36 * l, 0.0, 0.86 * h], 0.16 * w, colour);
        self.ellipsoid([0.4 * l, 0.0, 0.88 * h], [0.2 * l, 0.36 * w, 0.2 * h], colour.map(|v| 0.8 * v));
    }

    fn add_barrel(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        let r = 0.5 * l.min(w);
        self.cylinder([0.0; 3], [0.0, 0.0, h], 0.94 * r, colour);
        for z in [0.03, 0.33, 0.66, 0.95] {
            self.cylinder([0.0, 0.0, z * h], [0.0, 0.0, (z + 0.05) * h], r, STEEL);
        }
    }

    fn add_board(&mut self, [l, w, h]: [f64; 3], colour: [f32; 3]) {
        for y in [-0.4, 0.4] {
            self.cylinder([0.0, y * w, 0.0], [0.0, y * w, 0.95 * h], 0.045, STEEL);
        }
        self.cuboid([0.0, 0.0, 0.66 * h], [l, w, 0.68 * h], colour);
        self.cuboid([0.0, 0.0, 0.66 * h], [1.02 * l, 0.86 * w, 0.14 * h], [0.8; 3]);
    }
}
