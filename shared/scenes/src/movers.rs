//! Movers, whose poses depend on the state: vehicles, and objects made of simple shapes.

use carff_base::geometry::OrientedBox;
use carff_dataset::NamedBox;
use toml::Spanned;

use crate::config::{BoxConfig, EllipsoidConfig, ObjectConfig, RodConfig, ScenarioConfig, VehicleConfig};
use crate::materials::Material;
use crate::scenery::{Body, vec3, vehicle_bodies};
use crate::shapes::{Form, Solid, Vec3, turn, upright_along};

/// Pose of a mover.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Pose {
    /// Position, metres, world space; a vehicle's z is ignored.
    pub position_m: [f64; 3],
    /// Heading, radians about +Z.
    pub yaw: f64,
    /// Variant of an object, as an index into [`Mover::variants`].
    pub variant: Option<usize>,
}

impl Pose {
    /// Returns a hashable key that is equal for equal poses.
    pub fn key(&self) -> [u64; 5] {
        let [x, y, z] = self.position_m.map(f64::to_bits);
        [x, y, z, self.yaw.to_bits(), self.variant.map_or(u64::MAX, |v| v as u64)]
    }
}

/// A vehicle or an object.
#[derive(Clone, Copy)]
pub(crate) enum Mover<'a> {
    Vehicle(&'a VehicleConfig),
    Object(&'a ObjectConfig),
}

/// A course in either file format.
pub(crate) struct Course<'a> {
    pub branches: &'a [Spanned<String>],
    /// Byte range of `poses` in the file.
    pub poses_at: std::ops::Range<usize>,
    /// Poses by time step: x, y, z in metres, yaw in degrees.
    pub poses: Vec<[f64; 4]>,
    pub variants: Option<&'a Spanned<Vec<String>>>,
}

/// Returns all movers of a scenario: vehicles, then objects. Object indices and placements use this order.
pub(crate) fn movers(config: &ScenarioConfig) -> impl Iterator<Item = Mover<'_>> {
    config.vehicle.iter().map(Mover::Vehicle).chain(config.object.iter().map(Mover::Object))
}

impl<'a> Mover<'a> {
    /// Returns the key of its table in the file.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Vehicle(_) => "vehicle",
            Self::Object(_) => "object",
        }
    }

    pub fn name(&self) -> &'a str {
        match self {
            Self::Vehicle(v) => &v.name,
            Self::Object(o) => &o.name,
        }
    }

    pub fn dynamic(&self) -> bool {
        match self {
            Self::Vehicle(v) => v.dynamic,
            Self::Object(o) => o.dynamic,
        }
    }

    /// Returns the name of the dynamic object whose presence it shares.
    pub fn follows(&self) -> Option<&'a Spanned<String>> {
        match self {
            Self::Vehicle(_) => None,
            Self::Object(o) => o.follows.as_ref(),
        }
    }

    /// Returns the constant pose of an object without courses.
    pub fn still(&self) -> Option<Pose> {
        match self {
            Self::Object(o) if o.course.is_empty() => {
                let [x, y, z, yaw] = o.at;
                Some(Pose { position_m: [x, y, z], yaw: yaw.to_radians(), variant: None })
            }
            _ => None,
        }
    }

    pub fn courses(&self) -> Vec<Course<'a>> {
        match self {
            Self::Vehicle(v) => v
                .course
                .iter()
                .map(|c| Course {
                    branches: &c.branches,
                    poses_at: c.poses.span(),
                    poses: c.poses.get_ref().iter().map(|[x, y, yaw]| [*x, *y, 0.0, *yaw]).collect(),
                    variants: None,
                })
                .collect(),
            Self::Object(o) => o
                .course
                .iter()
                .map(|c| Course {
                    branches: &c.branches,
                    poses_at: c.poses.span(),
                    poses: c.poses.get_ref().clone(),
                    variants: c.variants.as_ref(),
                })
                .collect(),
        }
    }

    /// Returns the names of an object's variants, without repetition.
    pub fn variants(&self) -> Vec<&'a str> {
        let Self::Object(o) = self else { return Vec::new() };
        let mut names: Vec<&str> = Vec::new();
        let all = (o.boxes.iter().map(|p| &p.variants))
            .chain(o.ellipsoid.iter().map(|p| &p.variants))
            .chain(o.cylinder.iter().chain(&o.capsule).map(|p| &p.variants));
        for name in all.flatten() {
            if !names.contains(&name.as_str()) {
                names.push(name);
            }
        }
        names
    }

    /// Returns its solids at a pose.
    pub fn bodies(&self, pose: Pose, object: u16) -> Vec<Body> {
        let [x, y, z] = pose.position_m;
        match self {
            Self::Vehicle(v) => vehicle_bodies(v, [x, y, pose.yaw + v.heading_deg.to_radians()], object),
            Self::Object(_) => self
                .parts(pose.variant)
                .into_iter()
                .map(|(solid, material)| Body { solid: solid.placed(vec3(x, y, z), pose.yaw as f32), material, object })
                .collect(),
        }
    }

    /// Returns an object's solids in its own axes.
    fn parts(&self, variant: Option<usize>) -> Vec<(Solid, Material)> {
        let Self::Object(o) = self else { return Vec::new() };
        let names = self.variants();
        let current = variant.and_then(|v| names.get(v).copied());
        let shown = |of: &Vec<String>| of.is_empty() || of.iter().any(|name| Some(name.as_str()) == current);
        let mut parts = Vec::new();
        parts.extend(o.boxes.iter().filter(|p| shown(&p.variants)).map(cuboid));
        parts.extend(o.ellipsoid.iter().filter(|p| shown(&p.variants)).map(ellipsoid));
        let rod = |p: &RodConfig, form: fn(f32, f32) -> Form| {
            let (from, to) = (point(p.from), point(p.to));
            let half = (to - from) * 0.5;
            let along = if half.length() > 1e-6 { half.normalize() } else { Vec3::Z };
            let solid = Solid::turned(form(p.radius_m as f32, half.length()), from + half, upright_along(along));
            (solid, Material::Plain { colour: Vec3::from_array(p.colour) })
        };
        let cylinder = |radius: f32, half_length: f32| Form::Cylinder { axis: 2, radius, half_length };
        let capsule = |radius: f32, half_length: f32| Form::Capsule { radius, half_length };
        parts.extend(o.cylinder.iter().filter(|p| shown(&p.variants)).map(|p| rod(p, cylinder)));
        parts.extend(o.capsule.iter().filter(|p| shown(&p.variants)).map(|p| rod(p, capsule)));
        parts
    }

    /// Returns its bounding box at a pose; `None` for an object without parts.
    pub fn named_box(&self, pose: Pose) -> Option<NamedBox> {
        let [x, y, z] = pose.position_m;
        let (center, half_size, heading, role) = match self {
            Self::Vehicle(v) => {
                let [l, w, h] = v.size_m;
                ([x, y, h / 2.0], [l / 2.0, w / 2.0, h / 2.0], v.heading_deg.to_radians(), &v.role)
            }
            Self::Object(o) => {
                let boxes = self.parts(pose.variant).into_iter().map(|(solid, _)| solid.aabb());
                let (low, high) = boxes
                    .map(|b| (b.mins, b.maxs))
                    .reduce(|(low, high), (mins, maxs)| (low.min(mins), high.max(maxs)))?;
                // Rounded to 0.1 mm, so that rounding errors of the sums do not appear.
                let round = |v: f32| (f64::from(v) * 1e4).round() / 1e4;
                let middle = ((low + high) * 0.5).to_array().map(round);
                let (s, c) = pose.yaw.sin_cos();
                let center = [x + c * middle[0] - s * middle[1], y + s * middle[0] + c * middle[1], z + middle[2]];
                (center, ((high - low) * 0.5).to_array().map(round), 0.0, &o.role)
            }
        };
        Some(NamedBox {
            name: self.name().to_owned(),
            role: Some(role.clone()),
            oriented_box: OrientedBox { center, half_size, yaw: pose.yaw + heading },
            dynamic: self.dynamic(),
        })
    }
}

fn point(p: [f64; 3]) -> Vec3 {
    vec3(p[0], p[1], p[2])
}

fn turned(turn_deg: [f64; 3]) -> [Vec3; 3] {
    let [yaw, pitch, roll] = turn_deg.map(|v| v.to_radians() as f32);
    turn(yaw, pitch, roll)
}

fn cuboid(p: &BoxConfig) -> (Solid, Material) {
    let half = point(p.size_m) * 0.5;
    let colour = Vec3::from_array(p.colour);
    let material = match (&p.faces, p.checks) {
        (Some(faces), _) => Material::Faces {
            half,
            colours: faces.colours.map(Vec3::from_array),
            joint: colour,
            tiles: faces.tiles as f32,
        },
        (None, Some(checks)) => {
            Material::Checks { colours: [colour, Vec3::from_array(checks.colour)], size: checks.size_m as f32 }
        }
        (None, None) => Material::Plain { colour },
    };
    (Solid::turned(Form::Cuboid(half), point(p.center), turned(p.turn_deg)), material)
}

fn ellipsoid(p: &EllipsoidConfig) -> (Solid, Material) {
    let form = Form::Ellipsoid(point(p.size_m) * 0.5);
    let material = Material::Plain { colour: Vec3::from_array(p.colour) };
    (Solid::turned(form, point(p.center), turned(p.turn_deg)), material)
}
