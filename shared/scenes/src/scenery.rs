//! Converts the scenario file to solids: buildings, trees, furniture and vehicles made of simple shapes.

use carff_base::geometry::OrientedBox;
use carff_dataset::NamedBox;

use crate::config::{
    BuildingConfig, PropConfig, PropKind, Roof, ScenarioConfig, SlabSurface, TreeConfig, TreeKind, VehicleConfig,
    VehicleKind, Walls,
};
use crate::materials::{Cabin, Facade, Material, Paint};
use crate::shapes::{Form, Solid, Vec3};

/// A solid with its material and object index.
#[derive(Clone, Debug)]
pub(crate) struct Body {
    pub solid: Solid,
    pub material: Material,
    pub object: u16,
}

/// Object index of the sky.
pub(crate) const SKY: u16 = 0;
/// Object index of the ground and its slabs.
pub(crate) const GROUND: u16 = 1;
const FIRST_OBJECT: u16 = 2;

/// All static solids, except objects.
#[derive(Clone, Debug)]
pub(crate) struct Scenery {
    pub bodies: Vec<Body>,
    pub boxes: Vec<NamedBox>,
    /// First free object index; mover i has this index plus i.
    pub next_object: u16,
}

pub(crate) fn vec3(x: f64, y: f64, z: f64) -> Vec3 {
    Vec3::new(x as f32, y as f32, z as f32)
}

pub(crate) fn scenery(config: &ScenarioConfig) -> Scenery {
    let mut s = Scenery { bodies: Vec::new(), boxes: Vec::new(), next_object: FIRST_OBJECT };
    for slab in &config.slab {
        let (center, half) = block(slab.min, slab.max, 0.0, slab.height_m);
        let material = match slab.surface {
            SlabSurface::Pavement => Material::Slabs { colour: Vec3::new(0.36, 0.355, 0.34), size: 1.2 },
            SlabSurface::Grass => Material::Grass { colour: Vec3::from_array(config.ground_colour) },
        };
        s.bodies.push(Body { solid: Solid::new(Form::Cuboid(half), center, 0.0), material, object: GROUND });
    }
    for building in &config.building {
        let object = s.take_object();
        let roof_height = add_building(&mut s.bodies, building, object);
        let (center, half) = block(building.min, building.max, 0.0, building.height_m + roof_height);
        s.boxes.push(NamedBox {
            name: building.name.clone(),
            role: Some("building".to_owned()),
            oriented_box: OrientedBox {
                center: center.to_array().map(f64::from),
                half_size: half.to_array().map(f64::from),
                yaw: 0.0,
            },
            dynamic: false,
        });
    }
    for (i, tree) in config.tree.iter().enumerate() {
        let object = s.take_object();
        add_tree(&mut s.bodies, tree, object, i);
    }
    for prop in &config.prop {
        let object = s.take_object();
        add_prop(&mut s.bodies, prop, object);
    }
    s
}

impl Scenery {
    fn take_object(&mut self) -> u16 {
        let object = self.next_object;
        self.next_object = self.next_object.saturating_add(1);
        object
    }
}

fn block(min: [f64; 2], max: [f64; 2], low: f64, high: f64) -> (Vec3, Vec3) {
    let center = vec3(f64::midpoint(min[0], max[0]), f64::midpoint(min[1], max[1]), f64::midpoint(low, high));
    (center, vec3((max[0] - min[0]) / 2.0, (max[1] - min[1]) / 2.0, (high - low) / 2.0))
}

/// Adds a building and returns the height of its roof above the walls.
fn add_building(bodies: &mut Vec<Body>, b: &BuildingConfig, object: u16) -> f64 {
    let (center, half) = block(b.min, b.max, 0.0, b.height_m);
    let colour = Vec3::from_array(b.colour);
    let trim = Vec3::from_array(b.trim);
    let facade = Facade {
        half,
        storeys: b.storeys as u32,
        window_spacing: 2.9,
        door_wall: b.door as u32,
        brick: b.walls == Walls::Brick,
        colour,
        trim,
    };
    let mut add = |form: Form, center: Vec3, material: Material| {
        bodies.push(Body { solid: Solid::new(form, center, 0.0), material, object });
    };
    add(Form::Cuboid(half), center, Material::Wall(facade));
    let top = b.height_m as f32;
    match b.roof {
        Roof::Flat => {
            let (rise, thick) = (0.35_f32, 0.12_f32);
            let rim = Material::Mottled { colour: trim * 0.8, size: 0.8, strength: 0.08 };
            for (sx, sy) in [(1.0, 0.0), (-1.0, 0.0), (0.0, 1.0), (0.0, -1.0)] {
                let h = if sx == 0.0 {
                    Vec3::new(half.x + 0.08, thick, rise)
                } else {
                    Vec3::new(thick, half.y + 0.08, rise)
                };
                let c = center + Vec3::new(sx * (half.x - 0.04), sy * (half.y - 0.04), 0.0);
                add(Form::Cuboid(h), Vec3::new(c.x, c.y, top), rim);
            }
            let unit = Vec3::new(0.9_f32.min(half.x * 0.3), 0.7_f32.min(half.y * 0.3), 0.45);
            let material = Material::Mottled { colour: Vec3::splat(0.5), size: 0.7, strength: 0.08 };
            add(Form::Cuboid(unit), Vec3::new(center.x - half.x * 0.4, center.y + half.y * 0.3, top + 0.45), material);
            0.35
        }
        Roof::Gable => {
            let overhang = 0.35;
            let rise = 0.42 * half.y;
            let h = Vec3::new(half.x + overhang, half.y + overhang, rise / 2.0);
            let slope = Vec3::new(0.0, rise, h.y).normalize();
            let offset = slope.z * (rise / 2.0);
            let planes = vec![(slope, offset), (Vec3::new(0.0, -slope.y, slope.z), offset)];
            let material = Material::Mottled { colour: Vec3::new(0.22, 0.085, 0.06), size: 0.7, strength: 0.18 };
            add(Form::Cut { half: h, planes }, Vec3::new(center.x, center.y, top + rise / 2.0), material);
            f64::from(rise)
        }
    }
}

fn add_tree(bodies: &mut Vec<Body>, tree: &TreeConfig, object: u16, index: usize) {
    let [x, y] = tree.at.map(|v| v as f32);
    let h = tree.height_m as f32;
    let at = |z: f32| Vec3::new(x, y, z);
    // Trees vary slightly by index, so that every run gives the same trees.
    let vary = |n: usize| ((index * 7 + n * 13) % 11) as f32 / 10.0 - 0.5;
    let bark = Material::Mottled { colour: Vec3::new(0.12, 0.075, 0.045), size: 0.3, strength: 0.25 };
    let green = Vec3::new(0.055, 0.14, 0.035) * (1.0 + 0.3 * vary(0)) + Vec3::new(0.02, 0.01, 0.0) * vary(5);
    let mut add = |form: Form, center: Vec3, material: Material| {
        bodies.push(Body { solid: Solid::new(form, center, 0.0), material, object });
    };
    match tree.kind {
        TreeKind::Round => {
            add(Form::Cylinder { axis: 2, radius: 0.035 * h, half_length: 0.25 * h }, at(0.25 * h), bark);
            let leaves = Material::Leaves { colour: green };
            let r = 0.26 * h;
            add(Form::Ellipsoid(Vec3::new(r, r, 0.9 * r)), at(0.68 * h), leaves);
            for n in 0..6 {
                let angle = (n as f32 + vary(n)) * std::f32::consts::TAU / 6.0;
                let out = 0.72 * r;
                let c = at((0.66 + 0.12 * vary(n + 3)) * h) + Vec3::new(angle.cos() * out, angle.sin() * out, 0.0);
                add(Form::Ellipsoid(Vec3::splat(r * (0.55 + 0.12 * vary(n + 1)))), c, leaves);
            }
            add(Form::Ellipsoid(Vec3::splat(0.6 * r)), at(h - 0.62 * r), leaves);
        }
        TreeKind::Conifer => {
            add(Form::Cylinder { axis: 2, radius: 0.03 * h, half_length: 0.1 * h }, at(0.1 * h), bark);
            let leaves = Material::Leaves { colour: green * Vec3::new(0.65, 0.72, 0.9) };
            for (low, high, radius) in [(0.14, 0.62, 0.26), (0.36, 0.82, 0.2), (0.58, 1.0, 0.135)] {
                let half_height = (high - low) / 2.0 * h;
                add(Form::Cone { base: radius * h, half_height }, at(low * h + half_height), leaves);
            }
        }
        TreeKind::Bush => {
            let leaves = Material::Leaves { colour: green * 0.9 };
            add(Form::Ellipsoid(Vec3::new(0.6 * h, 0.6 * h, 0.55 * h)), at(0.45 * h), leaves);
            add(Form::Ellipsoid(Vec3::splat(0.4 * h)), at(0.4 * h) + Vec3::new(0.45 * h, 0.2 * h, 0.0), leaves);
        }
    }
}

fn add_prop(bodies: &mut Vec<Body>, prop: &PropConfig, object: u16) {
    let origin = vec3(prop.at[0], prop.at[1], 0.0);
    let yaw = prop.yaw_deg.to_radians() as f32;
    let mut add = |form: Form, center: [f32; 3], colour: [f32; 3]| {
        let material = Material::Mottled { colour: Vec3::from_array(colour), size: 0.4, strength: 0.05 };
        let solid = Solid::new(form, Vec3::from_array(center), 0.0).placed(origin, yaw);
        bodies.push(Body { solid, material, object });
    };
    let rod = |radius: f32, half_length: f32| Form::Cylinder { axis: 2, radius, half_length };
    let slab = |x: f32, y: f32, z: f32| Form::Cuboid(Vec3::new(x, y, z));
    match prop.kind {
        PropKind::Lamp => {
            let steel = [0.16, 0.17, 0.18];
            add(rod(0.07, 2.5), [0.0, 0.0, 2.5], steel);
            add(slab(0.55, 0.05, 0.05), [0.5, 0.0, 4.95], steel);
            add(slab(0.28, 0.12, 0.06), [1.05, 0.0, 4.9], [0.75, 0.75, 0.68]);
        }
        PropKind::Bench => {
            let wood = [0.28, 0.13, 0.06];
            add(slab(0.25, 0.8, 0.04), [0.0, 0.0, 0.45], wood);
            add(slab(0.04, 0.8, 0.2), [-0.25, 0.0, 0.72], wood);
            for y in [-0.65, 0.65] {
                add(slab(0.22, 0.05, 0.22), [0.0, y, 0.22], [0.05; 3]);
            }
        }
        PropKind::Bin => {
            add(rod(0.26, 0.45), [0.0, 0.0, 0.45], [0.05, 0.13, 0.3]);
            add(rod(0.28, 0.05), [0.0, 0.0, 0.93], [0.04; 3]);
        }
        PropKind::Hydrant => {
            let red = [0.55, 0.03, 0.02];
            add(rod(0.13, 0.3), [0.0, 0.0, 0.3], red);
            add(Form::Ellipsoid(Vec3::new(0.15, 0.15, 0.14)), [0.0, 0.0, 0.62], red);
            add(Form::Cylinder { axis: 1, radius: 0.06, half_length: 0.2 }, [0.0, 0.0, 0.42], red);
        }
        PropKind::Cone => {
            add(slab(0.19, 0.19, 0.03), [0.0, 0.0, 0.03], [0.7, 0.16, 0.02]);
            add(Form::Cone { base: 0.15, half_height: 0.33 }, [0.0, 0.0, 0.39], [0.8, 0.19, 0.02]);
        }
        PropKind::Stop => {
            add(rod(0.04, 1.15), [0.0, 0.0, 1.15], [0.4; 3]);
            add(Form::Cylinder { axis: 0, radius: 0.38, half_length: 0.02 }, [0.05, 0.0, 2.4], [0.6, 0.02, 0.03]);
            add(slab(0.005, 0.27, 0.06), [0.075, 0.0, 2.4], [0.85; 3]);
        }
    }
}

/// Returns a cuboid with edges cut off by `c`.
fn chamfered(half: Vec3, c: f32) -> Form {
    let mut planes = Vec::with_capacity(12);
    let unit = std::f32::consts::FRAC_1_SQRT_2;
    for (a, b) in [(0, 1), (0, 2), (1, 2)] {
        for (sa, sb) in [(1.0, 1.0), (1.0, -1.0), (-1.0, 1.0), (-1.0, -1.0)] {
            let mut n = Vec3::ZERO;
            n[a] = sa * unit;
            n[b] = sb * unit;
            planes.push((n, (half[a] + half[b] - c) * unit));
        }
    }
    Form::Cut { half, planes }
}

/// Returns a cabin: front and rear glass lean inwards by `front` and `rear` metres, the sides by `side`.
fn cabin(half: Vec3, front: f32, rear: f32, side: f32) -> Form {
    let mut planes = Vec::with_capacity(8);
    let mut lean = |n: Vec3, through: Vec3| {
        let n = n.normalize();
        planes.push((n, n.dot(through)));
    };
    let height = 2.0 * half.z;
    lean(Vec3::new(height, 0.0, front), Vec3::new(half.x, 0.0, -half.z));
    lean(Vec3::new(-height, 0.0, rear), Vec3::new(-half.x, 0.0, -half.z));
    lean(Vec3::new(0.0, height, side), Vec3::new(0.0, half.y, -half.z));
    lean(Vec3::new(0.0, -height, side), Vec3::new(0.0, -half.y, -half.z));
    // The rounded edges of the roof.
    lean(Vec3::new(1.0, 0.0, 2.2), Vec3::new(half.x - front - 0.12, 0.0, half.z));
    lean(Vec3::new(-1.0, 0.0, 2.2), Vec3::new(-half.x + rear + 0.12, 0.0, half.z));
    lean(Vec3::new(0.0, 1.0, 1.2), Vec3::new(0.0, half.y - side - 0.1, half.z));
    lean(Vec3::new(0.0, -1.0, 1.2), Vec3::new(0.0, -half.y + side + 0.1, half.z));
    Form::Cut { half, planes }
}

/// A panel of a vehicle's body: its extent along, up and across, metres from the centre on the ground.
struct Panel {
    x: [f32; 2],
    z: [f32; 2],
    y: [f32; 2],
    /// Width of the cut-off edges, metres.
    edge: f32,
}

/// The parts in which the kinds of vehicles differ, metres.
struct Shape {
    panels: Vec<Panel>,
    /// Height of the lights.
    lights_z: f32,
    /// Height of the cabin's lower edge.
    belt: f32,
    /// Centre of the cabin along the vehicle.
    cabin_x: f32,
    cabin_half: Vec3,
    /// Lean of the front and rear glass.
    front: f32,
    rear: f32,
    pillars: [f32; 3],
}

/// Returns the parts of a vehicle of this size (length, width, height), whose body starts at the height `low`, metres.
fn shape(kind: VehicleKind, [l, w, h]: [f32; 3], low: f32) -> Shape {
    let (half_l, half_w) = (l / 2.0, w / 2.0);
    let across = [-half_w, half_w];
    match kind {
        VehicleKind::Pickup => {
            let (belt, bed, floor, wall) = (0.54 * h, -0.1 * l, 0.36 * h, 0.1);
            let side = |y| Panel { x: [-half_l + 0.02, bed + 0.1], z: [floor - 0.1, belt], y, edge: 0.025 };
            let cabin_half = Vec3::new(0.19 * l, 0.95 * half_w, (h - belt) / 2.0);
            Shape {
                panels: vec![
                    Panel { x: [bed, half_l], z: [low, belt], y: across, edge: 0.13 },
                    Panel { x: [-half_l, bed + 0.1], z: [low, floor], y: across, edge: 0.06 },
                    side([-half_w, -half_w + wall]),
                    side([half_w - wall, half_w]),
                    Panel { x: [-half_l, -half_l + wall], z: [floor - 0.1, belt], y: across, edge: 0.025 },
                ],
                lights_z: 0.43 * h,
                belt,
                cabin_x: bed + cabin_half.x + 0.02,
                cabin_half,
                front: 0.13 * l,
                rear: 0.03 * l,
                pillars: [-0.03 * l, -cabin_half.x + 0.1, 9.0],
            }
        }
        VehicleKind::Van => {
            let belt = 0.5 * h;
            let cabin_half = Vec3::new(0.475 * l, 0.97 * half_w, (h - belt) / 2.0);
            Shape {
                panels: vec![Panel { x: [-half_l, half_l], z: [low, belt], y: across, edge: 0.14 }],
                lights_z: 0.36 * h,
                belt,
                cabin_x: -half_l + cabin_half.x + 0.03,
                cabin_half,
                front: 0.14 * l,
                rear: 0.02 * l,
                pillars: [0.12 * l, -0.14 * l, -0.4 * l],
            }
        }
        VehicleKind::Car | VehicleKind::Block => {
            let belt = 0.58 * h;
            let cabin_half = Vec3::new(0.345 * l, 0.92 * half_w, (h - belt) / 2.0);
            Shape {
                panels: vec![Panel { x: [-half_l, half_l], z: [low, belt], y: across, edge: 0.17 }],
                lights_z: 0.44 * h,
                belt,
                cabin_x: -half_l + cabin_half.x + 0.12,
                cabin_half,
                front: 0.19 * l,
                rear: 0.12 * l,
                pillars: [0.0, -0.21 * l, 9.0],
            }
        }
    }
}

/// Returns the solids of a vehicle whose centre is on the ground at x, y (metres), rotated by `yaw` (radians).
pub(crate) fn vehicle_bodies(vehicle: &VehicleConfig, [x, y, yaw]: [f64; 3], object: u16) -> Vec<Body> {
    let [l, w, h] = vehicle.size_m.map(|v| v as f32);
    let colour = Vec3::from_array(vehicle.colour);
    let origin = vec3(x, y, 0.0);
    let yaw = yaw as f32;
    let mut bodies = Vec::new();
    let mut add = |form: Form, center: Vec3, material: Material| {
        bodies.push(Body { solid: Solid::new(form, center, 0.0).placed(origin, yaw), material, object });
    };
    if vehicle.kind == VehicleKind::Block {
        let material = Material::Mottled { colour, size: 0.5, strength: 0.03 };
        add(Form::Cuboid(Vec3::new(l, w, h) / 2.0), Vec3::new(0.0, 0.0, h / 2.0), material);
        return bodies;
    }
    let radius = (0.2 * h).clamp(0.28, 0.45);
    let axles = [0.315 * l, -0.30 * l];
    let half_w = w / 2.0;
    let shape = shape(vehicle.kind, [l, w, h], 0.62 * radius);
    for Panel { x: [x0, x1], z: [z0, z1], y: [y0, y1], edge } in shape.panels {
        let center = Vec3::new(f32::midpoint(x0, x1), f32::midpoint(y0, y1), f32::midpoint(z0, z1));
        let paint = Paint {
            colour,
            offset: center,
            half_length: l / 2.0,
            half_width: half_w,
            axles,
            arch_radius: 1.22 * radius,
            lights_z: shape.lights_z,
        };
        let half = Vec3::new((x1 - x0) / 2.0, (y1 - y0) / 2.0, (z1 - z0) / 2.0);
        add(chamfered(half, edge), center, Material::Paint(paint));
    }
    let (half, pillars) = (shape.cabin_half, shape.pillars);
    let center = Vec3::new(shape.cabin_x, 0.0, shape.belt + half.z - 0.02);
    let glass = Material::Cabin(Cabin { colour, half, pillars });
    add(cabin(half, shape.front, shape.rear, 0.13 * half_w), center, glass);
    for (axle, side) in axles.into_iter().flat_map(|axle| [(axle, -1.0), (axle, 1.0)]) {
        let wheel = Form::Cylinder { axis: 1, radius, half_length: 0.11 };
        add(wheel, Vec3::new(axle, side * (half_w - 0.085), radius), Material::Wheel { rim: 0.62 * radius });
    }
    bodies
}
