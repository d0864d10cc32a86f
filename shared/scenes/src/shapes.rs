//! Solids and their intersections with rays.
//!
//! Parry's `Bvh` is the tree that finds candidate solids of a ray. It is maintained, builds by binned surface area
//! heuristic, and casts rays best first with a custom leaf test. Its general shape casts (convex solids and cylinders
//! by GJK iterations) are slower and less exact than closed formulas, so this module implements the leaf tests.

use parry3d::bounding_volume::Aabb;
pub(crate) use parry3d::math::Vector as Vec3;

/// The shape of a solid, in its own axes, centred at the origin.
#[derive(Clone, Debug)]
pub(crate) enum Form {
    /// A cuboid, by half extents.
    Cuboid(Vec3),
    /// A cuboid cut by planes: each keeps the points with `normal . p <= offset`.
    Cut { half: Vec3, planes: Vec<(Vec3, f32)> },
    /// A closed cylinder about axis 0, 1 or 2.
    Cylinder { axis: usize, radius: f32, half_length: f32 },
    /// A closed cone about Z, with radius `base` at the bottom and 0 at the top.
    Cone { base: f32, half_height: f32 },
    /// An ellipsoid, by radii.
    Ellipsoid(Vec3),
    /// A cylinder about Z with a half ball on each end; `half_length` is that of the cylinder.
    Capsule { radius: f32, half_length: f32 },
}

/// A shape with its pose.
#[derive(Clone, Debug)]
pub(crate) struct Solid {
    pub form: Form,
    pub center: Vec3,
    /// The solid's own X, Y and Z, in world space.
    axes: [Vec3; 3],
}

/// Entry point of a ray into a solid.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Entry {
    pub t: f32,
    /// Outward normal in the solid's own axes.
    pub normal: Vec3,
}

impl Solid {
    /// Creates a solid that is rotated about the vertical axis.
    pub fn new(form: Form, center: Vec3, yaw: f32) -> Self {
        Self::turned(form, center, turn(yaw, 0.0, 0.0))
    }

    /// Creates a solid whose own X, Y and Z are along `axes`.
    pub fn turned(form: Form, center: Vec3, axes: [Vec3; 3]) -> Self {
        Self { form, center, axes }
    }

    /// Returns the solid, rotated about the world's vertical axis by `yaw` and then moved.
    pub fn placed(mut self, origin: Vec3, yaw: f32) -> Self {
        let (s, c) = yaw.sin_cos();
        let about = |p: Vec3| Vec3::new(c * p.x - s * p.y, s * p.x + c * p.y, p.z);
        self.center = origin + about(self.center);
        self.axes = self.axes.map(about);
        self
    }

    pub fn to_local(&self, v: Vec3) -> Vec3 {
        Vec3::new(self.axes[0].dot(v), self.axes[1].dot(v), self.axes[2].dot(v))
    }

    pub fn to_world(&self, v: Vec3) -> Vec3 {
        self.axes[0] * v.x + self.axes[1] * v.y + self.axes[2] * v.z
    }

    fn half(&self) -> Vec3 {
        match &self.form {
            Form::Cuboid(half) | Form::Cut { half, .. } => *half,
            Form::Cylinder { axis, radius, half_length } => {
                let mut half = Vec3::splat(*radius);
                half[*axis] = *half_length;
                half
            }
            Form::Cone { base, half_height } => Vec3::new(*base, *base, *half_height),
            Form::Ellipsoid(radii) => *radii,
            Form::Capsule { radius, half_length } => Vec3::new(*radius, *radius, half_length + radius),
        }
    }

    pub fn aabb(&self) -> Aabb {
        let h = self.half();
        let half = self.axes[0].abs() * h.x + self.axes[1].abs() * h.y + self.axes[2].abs() * h.z;
        Aabb::new(self.center - half, self.center + half)
    }

    /// Returns the entry of a ray at 0 < t < `limit`; `None` if it misses or starts inside.
    pub fn enter(&self, origin: Vec3, direction: Vec3, limit: f32) -> Option<Entry> {
        let o = self.to_local(origin - self.center);
        let d = self.to_local(direction);
        match &self.form {
            Form::Cuboid(half) => cuboid(o, d, *half, &[], limit),
            Form::Cut { half, planes } => cuboid(o, d, *half, planes, limit),
            Form::Cylinder { axis, radius, half_length } => cylinder(o, d, *axis, *radius, *half_length, limit),
            Form::Cone { base, half_height } => cone(o, d, *base, *half_height, limit),
            Form::Ellipsoid(radii) => ellipsoid(o, d, *radii, limit),
            Form::Capsule { radius, half_length } => capsule(o, d, *radius, *half_length, limit),
        }
    }
}

/// Returns axes rotated about Z by `yaw`, then about their own Y by `pitch` (positive is down), then about their own X
/// by `roll`, radians.
pub(crate) fn turn(yaw: f32, pitch: f32, roll: f32) -> [Vec3; 3] {
    let ((sy, cy), (sp, cp), (sr, cr)) = (yaw.sin_cos(), pitch.sin_cos(), roll.sin_cos());
    [
        Vec3::new(cy * cp, sy * cp, -sp),
        Vec3::new(cy * sp * sr - sy * cr, sy * sp * sr + cy * cr, cp * sr),
        Vec3::new(cy * sp * cr + sy * sr, sy * sp * cr - cy * sr, cp * cr),
    ]
}

/// Returns axes of which the third is along a unit vector.
pub(crate) fn upright_along(z: Vec3) -> [Vec3; 3] {
    let helper = if z.z.abs() < 0.9 { Vec3::Z } else { Vec3::X };
    let x = helper.cross(z).normalize();
    [x, z.cross(x), z]
}

fn cuboid(o: Vec3, d: Vec3, half: Vec3, planes: &[(Vec3, f32)], limit: f32) -> Option<Entry> {
    let (mut near, mut far) = (0.0_f32, limit);
    let mut normal = None;
    for axis in 0..3 {
        let inverse = 1.0 / d[axis];
        let (a, b) = ((-half[axis] - o[axis]) * inverse, (half[axis] - o[axis]) * inverse);
        let (enter, leave) = if a < b { (a, b) } else { (b, a) };
        if enter > near {
            near = enter;
            normal = Some(axis);
        }
        far = far.min(leave);
        if near >= far {
            return None;
        }
    }
    let mut entry = normal.map(|axis| {
        let mut n = Vec3::ZERO;
        n[axis] = -d[axis].signum();
        n
    });
    for (plane, offset) in planes {
        let along = plane.dot(d);
        let distance = offset - plane.dot(o);
        if along < 0.0 {
            let t = distance / along;
            if t > near {
                near = t;
                entry = Some(*plane);
            }
        } else if along > 0.0 {
            far = far.min(distance / along);
        } else if distance < 0.0 {
            return None;
        }
        if near >= far {
            return None;
        }
    }
    entry.map(|normal| Entry { t: near, normal })
}

fn cylinder(o: Vec3, d: Vec3, axis: usize, radius: f32, half_length: f32, limit: f32) -> Option<Entry> {
    let (u, v) = ((axis + 1) % 3, (axis + 2) % 3);
    let a = d[u] * d[u] + d[v] * d[v];
    let b = o[u] * d[u] + o[v] * d[v];
    let c = o[u] * o[u] + o[v] * o[v] - radius * radius;
    let discriminant = b * b - a * c;
    if discriminant <= 0.0 {
        return None;
    }
    let side = (-b - discriminant.sqrt()) / a;
    let leave = (-b + discriminant.sqrt()) / a;
    let inverse = 1.0 / d[axis];
    let (p, q) = ((-half_length - o[axis]) * inverse, (half_length - o[axis]) * inverse);
    let (cap, cap_leave) = if p < q { (p, q) } else { (q, p) };
    let t = side.max(cap);
    if t <= 0.0 || t >= limit || t >= leave.min(cap_leave) {
        return None;
    }
    let mut normal = Vec3::ZERO;
    if cap > side {
        normal[axis] = -d[axis].signum();
    } else {
        normal[u] = (o[u] + t * d[u]) / radius;
        normal[v] = (o[v] + t * d[v]) / radius;
    }
    Some(Entry { t, normal })
}

fn cone(o: Vec3, d: Vec3, base: f32, half_height: f32, limit: f32) -> Option<Entry> {
    // With s = z distance below the apex: x^2 + y^2 = (k s)^2.
    let k = base / (2.0 * half_height);
    let s0 = half_height - o.z;
    let a = d.x * d.x + d.y * d.y - k * k * d.z * d.z;
    let b = o.x * d.x + o.y * d.y + k * k * s0 * d.z;
    let c = o.x * o.x + o.y * o.y - k * k * s0 * s0;
    let mut best: Option<Entry> = None;
    let mut offer = |t: f32, normal: Vec3| {
        if t > 0.0 && t < limit && best.is_none_or(|e| t < e.t) {
            best = Some(Entry { t, normal });
        }
    };
    let discriminant = b * b - a * c;
    if discriminant > 0.0 && a.abs() > 1e-9 {
        let root = discriminant.sqrt();
        for t in [(-b - root) / a, (-b + root) / a] {
            let p = o + d * t;
            if p.z.abs() <= half_height {
                let radial = Vec3::new(p.x, p.y, 0.0).normalize_or_zero();
                offer(t, (radial + Vec3::new(0.0, 0.0, k)).normalize_or_zero());
            }
        }
    }
    let t = (-half_height - o.z) / d.z;
    let p = o + d * t;
    if p.x * p.x + p.y * p.y <= base * base {
        offer(t, Vec3::new(0.0, 0.0, -1.0));
    }
    best.filter(|e| e.normal.dot(d) < 0.0)
}

fn ellipsoid(o: Vec3, d: Vec3, radii: Vec3, limit: f32) -> Option<Entry> {
    let (p, q) = (o / radii, d / radii);
    let a = q.dot(q);
    let b = p.dot(q);
    let c = p.dot(p) - 1.0;
    let discriminant = b * b - a * c;
    if discriminant <= 0.0 {
        return None;
    }
    let t = (-b - discriminant.sqrt()) / a;
    (t > 0.0 && t < limit).then(|| Entry { t, normal: ((p + q * t) / radii).normalize_or_zero() })
}

fn capsule(o: Vec3, d: Vec3, radius: f32, half_length: f32, limit: f32) -> Option<Entry> {
    let mut best: Option<Entry> = None;
    let mut offer = |t: f32, normal: Vec3| {
        if t > 0.0 && t < limit && best.is_none_or(|e| t < e.t) {
            best = Some(Entry { t, normal });
        }
    };
    let a = d.x * d.x + d.y * d.y;
    let b = o.x * d.x + o.y * d.y;
    let discriminant = b * b - a * (o.x * o.x + o.y * o.y - radius * radius);
    if discriminant > 0.0 && a > 1e-12 {
        let t = (-b - discriminant.sqrt()) / a;
        let p = o + d * t;
        if p.z.abs() <= half_length {
            offer(t, Vec3::new(p.x, p.y, 0.0) / radius);
        }
    }
    for end in [-1.0, 1.0] {
        let middle = Vec3::new(0.0, 0.0, end * half_length);
        if let Some(entry) = ellipsoid(o - middle, d, Vec3::splat(radius), limit) {
            let p = o + d * entry.t;
            if (p.z - middle.z) * end >= 0.0 {
                offer(entry.t, entry.normal);
            }
        }
    }
    best
}

#[cfg(test)]
mod tests {
    use super::*;

    fn along_x(solid: &Solid, y: f32, z: f32) -> Option<Entry> {
        solid.enter(Vec3::new(-10.0, y, z), Vec3::new(1.0, 1e-8, 1e-8), f32::MAX)
    }

    /// A ray enters each shape at the position of its formula, with the outward normal there.
    #[test]
    fn entries_of_known_solids() {
        let up = 0.5;
        for (form, t, normal) in [
            (Form::Cuboid(Vec3::new(2.0, 1.0, 1.0)), 8.0, Vec3::new(-1.0, 0.0, 0.0)),
            (Form::Cylinder { axis: 2, radius: 2.0, half_length: 1.0 }, 8.0, Vec3::new(-1.0, 0.0, 0.0)),
            (Form::Cylinder { axis: 0, radius: 2.0, half_length: 1.0 }, 9.0, Vec3::new(-1.0, 0.0, 0.0)),
            (Form::Ellipsoid(Vec3::new(3.0, 1.0, 1.0)), 10.0 - 3.0 * 0.75_f32.sqrt(), Vec3::ZERO),
            (Form::Capsule { radius: 2.0, half_length: 0.6 }, 8.0, Vec3::new(-1.0, 0.0, 0.0)),
            (Form::Capsule { radius: 2.0, half_length: 0.2 }, 10.0 - 3.91_f32.sqrt(), Vec3::ZERO),
            (Form::Cone { base: 2.0, half_height: 1.0 }, 9.5, Vec3::new(-1.0, 0.0, 1.0).normalize()),
        ] {
            let entry = along_x(&Solid::new(form.clone(), Vec3::ZERO, 0.0), 0.0, up).unwrap();
            assert!((entry.t - t).abs() < 1e-4, "{form:?}: {}", entry.t);
            if normal != Vec3::ZERO {
                assert!((entry.normal - normal).length() < 1e-4, "{form:?}: {}", entry.normal);
            }
            assert!(along_x(&Solid::new(form, Vec3::ZERO, 0.0), 0.0, 2.7).is_none());
        }
    }

    /// A cuboid with a cut corner is entered at the cutting plane, and a cut plane does not enlarge it.
    #[test]
    fn cut_cuboid() {
        let diagonal = Vec3::new(-1.0, 0.0, 1.0).normalize();
        let form = Form::Cut { half: Vec3::ONE, planes: vec![(diagonal, 0.5_f32.sqrt())] };
        let solid = Solid::new(form, Vec3::ZERO, 0.0);
        let entry = along_x(&solid, 0.0, 0.5).unwrap();
        assert!((entry.t - 9.5).abs() < 1e-4);
        assert!((entry.normal - diagonal).length() < 1e-6);
        assert!((along_x(&solid, 0.0, -0.5).unwrap().t - 9.0).abs() < 1e-5);
    }

    /// Yaw turns left, pitch down, and roll the left side up; axes stay orthogonal and right-handed. A ray enters a
    /// rotated solid at its rotated faces, and the bounding box contains its corners.
    #[test]
    fn turns_are_about_the_own_axes() {
        let quarter = std::f32::consts::FRAC_PI_2;
        let near = |a: Vec3, b: Vec3| (a - b).length() < 1e-5;
        assert!(near(turn(quarter, 0.0, 0.0)[0], Vec3::Y));
        assert!(near(turn(0.0, quarter, 0.0)[0], -Vec3::Z));
        assert!(near(turn(0.0, 0.0, quarter)[1], Vec3::Z));
        for axes in [turn(0.7, -0.4, 1.9), upright_along(Vec3::new(0.3, -0.8, 0.5).normalize()), upright_along(Vec3::Z)]
        {
            assert!(near(axes[0].cross(axes[1]), axes[2]) && axes[0].dot(axes[1]).abs() < 1e-6);
        }
        // A rod of 2 x 0.2 x 0.2 half extents, nose down: it is upright, 0.2 m wide towards the ray.
        let rod = Solid::turned(Form::Cuboid(Vec3::new(2.0, 0.2, 0.2)), Vec3::ZERO, turn(0.0, quarter, 0.0));
        assert!((along_x(&rod, 0.0, 1.9).unwrap().t - 9.8).abs() < 1e-4);
        assert!(along_x(&rod, 0.0, 2.1).is_none());
        assert!((rod.aabb().maxs - Vec3::new(0.2, 0.2, 2.0)).length() < 1e-5);
    }

    /// Rotating and moving a solid moves its entry and its bounding box equally.
    #[test]
    fn placing_turns_and_moves() {
        let solid = Solid::new(Form::Cuboid(Vec3::new(2.0, 1.0, 0.5)), Vec3::new(3.0, 0.0, 0.0), 0.0)
            .placed(Vec3::new(0.0, 1.0, 0.0), std::f32::consts::FRAC_PI_2);
        let aabb = solid.aabb();
        assert!((aabb.mins - Vec3::new(-1.0, 2.0, -0.5)).length() < 1e-5);
        assert!((aabb.maxs - Vec3::new(1.0, 6.0, 0.5)).length() < 1e-5);
        assert!((along_x(&solid, 4.0, 0.0).unwrap().t - 9.0).abs() < 1e-5);
    }
}
