//! Cameras, rays and boxes, with their spaces and units.
//!
//! World: metres, +Z up. Camera: OpenGL axes (+X right, +Y up, -Z forward).
//! Images: pixel (0, 0) is the top left one, with its centre at (0.5, 0.5).
//!
//! ```
//! use carff_base::geometry::PinholeCamera;
//! let camera = PinholeCamera::look_at([0.0, 0.0, 10.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 128, 128, 60.0);
//! let ray = camera.ray(64.0, 64.0);
//! assert!((ray.direction[2] + 1.0).abs() < 1e-6);
//! ```

use serde::{Deserialize, Serialize};

/// Distance of the near plane of a projected segment, metres.
const NEAR_M: f64 = 0.05;

/// A ray in world space; `direction` has unit length.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ray {
    /// Start, metres, world space.
    pub origin: [f32; 3],
    /// Unit vector, world space.
    pub direction: [f32; 3],
    /// Width of its pixel at one metre along the ray, metres; 0 for a ray without a pixel.
    pub spread: f32,
}

/// Reason why a camera is not usable.
#[derive(Debug, thiserror::Error, PartialEq, Eq)]
pub enum CameraError {
    /// A number is NaN or infinite.
    #[error("`{0}` must be finite")]
    NotFinite(&'static str),
    /// Sizes and focal lengths must be above zero.
    #[error("`{0}` must be greater than zero")]
    NotPositive(&'static str),
    /// The rotation part must be orthonormal and right-handed.
    #[error(
        "the rotation part of `transform_matrix` is not a rotation: its columns must be perpendicular, of \
         length 1 and right-handed"
    )]
    NotARotation,
}

/// An ideal pinhole camera at a known pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PinholeCamera {
    /// Image width, pixels.
    pub width_px: u32,
    /// Image height, pixels.
    pub height_px: u32,
    /// Focal length along x, pixels.
    pub fl_x_px: f64,
    /// Focal length along y, pixels.
    pub fl_y_px: f64,
    /// Principal point, x, pixels.
    pub cx_px: f64,
    /// Principal point, y, pixels.
    pub cy_px: f64,
    /// Row-major 4x4; maps camera space (OpenGL axes) to world space (metres).
    pub world_from_camera: [[f64; 4]; 4],
}

impl PinholeCamera {
    /// Field of view of [`Self::above`], degrees.
    pub const ABOVE_FOV_DEG: f64 = 60.0;
    /// Assumed horizontal field of view of a camera without a calibration, degrees.
    pub const ASSUMED_FOV_DEG: f64 = 60.0;

    /// Returns a camera that looks straight down on a region (two opposite corners, metres) and sees its longer side from
    /// edge to edge. The image's up direction is +Y.
    pub fn above(bounds_m: [[f64; 3]; 2], width_px: u32, height_px: u32) -> Self {
        let [low, high] = bounds_m;
        let [x, y] = [0, 1].map(|i| f64::midpoint(low[i], high[i]));
        let height_m = Self::height_above_m(bounds_m);
        let position_m = [x, y, low[2] + height_m];
        Self::look_at(position_m, [x, y, low[2]], [0.0, 1.0, 0.0], width_px, height_px, Self::ABOVE_FOV_DEG)
    }

    /// Height of [`Self::above`] over the bottom of the region, metres.
    pub fn height_above_m([low, high]: [[f64; 3]; 2]) -> f64 {
        let extent_m = (high[0] - low[0]).max(high[1] - low[1]);
        extent_m / 2.0 / (Self::ABOVE_FOV_DEG / 2.0).to_radians().tan()
    }

    /// Returns a camera at `eye` that looks at `target`, with a horizontal field of view in degrees and square pixels.
    /// If the view direction is parallel to `up`, another up vector is used.
    pub fn look_at(
        eye: [f64; 3],
        target: [f64; 3],
        up: [f64; 3],
        width_px: u32,
        height_px: u32,
        fov_x_deg: f64,
    ) -> Self {
        let back = normalize(sub(eye, target));
        let mut right = cross(up, back);
        if dot(right, right) < 1e-12 {
            right = cross(if back[2].abs() > 0.9 { [0.0, 1.0, 0.0] } else { [0.0, 0.0, 1.0] }, back);
        }
        let right = normalize(right);
        let true_up = cross(back, right);
        let fl = f64::from(width_px) / 2.0 / (fov_x_deg.to_radians() / 2.0).tan();
        Self {
            width_px,
            height_px,
            fl_x_px: fl,
            fl_y_px: fl,
            cx_px: f64::from(width_px) / 2.0,
            cy_px: f64::from(height_px) / 2.0,
            world_from_camera: [
                [right[0], true_up[0], back[0], eye[0]],
                [right[1], true_up[1], back[1], eye[1]],
                [right[2], true_up[2], back[2], eye[2]],
                [0.0, 0.0, 0.0, 1.0],
            ],
        }
    }

    /// Returns the camera's position, metres, world space.
    pub fn position_m(&self) -> [f64; 3] {
        let m = &self.world_from_camera;
        [m[0][3], m[1][3], m[2][3]]
    }

    /// Returns the ray through image coordinates (`x_px`, `y_px`); a pixel's centre is at +0.5.
    pub fn ray(&self, x_px: f64, y_px: f64) -> Ray {
        let in_camera = [(x_px - self.cx_px) / self.fl_x_px, -(y_px - self.cy_px) / self.fl_y_px, -1.0];
        let m = &self.world_from_camera;
        let world = [0, 1, 2].map(|i| m[i][0] * in_camera[0] + m[i][1] * in_camera[1] + m[i][2] * in_camera[2]);
        let direction = normalize(world);
        let length = in_camera.iter().map(|v| v * v).sum::<f64>().sqrt();
        let spread = 1.0 / ((self.fl_x_px * self.fl_y_px).sqrt() * length);
        Ray {
            origin: self.position_m().map(|v| v as f32),
            direction: direction.map(|v| v as f32),
            spread: spread as f32,
        }
    }

    /// Projects a world point into the image: (x, y) in pixels, and the depth along the optical axis in metres; `None`
    /// if it is behind the camera.
    pub fn project(&self, point_m: [f64; 3]) -> Option<([f64; 2], f64)> {
        let m = &self.world_from_camera;
        let d = sub(point_m, self.position_m());
        let c = [0, 1, 2].map(|j| m[0][j] * d[0] + m[1][j] * d[1] + m[2][j] * d[2]);
        let depth = -c[2];
        (depth > 1e-9)
            .then(|| ([self.cx_px + self.fl_x_px * c[0] / depth, self.cy_px - self.fl_y_px * c[1] / depth], depth))
    }

    /// Projects a segment, pixels. The part behind the near plane is cut off; `None` if nothing remains.
    pub fn project_segment(&self, a_m: [f64; 3], b_m: [f64; 3]) -> Option<[[f64; 2]; 2]> {
        let m = &self.world_from_camera;
        let eye_m = self.position_m();
        let depth_m = |p: [f64; 3]| -(0..3).map(|i| m[i][2] * (p[i] - eye_m[i])).sum::<f64>();
        let (depth_a_m, depth_b_m) = (depth_m(a_m), depth_m(b_m));
        if depth_a_m < NEAR_M && depth_b_m < NEAR_M {
            return None;
        }
        let share = (NEAR_M - depth_a_m) / (depth_b_m - depth_a_m);
        let cut = [0, 1, 2].map(|i| a_m[i] + share * (b_m[i] - a_m[i]));
        let a_m = if depth_a_m < NEAR_M { cut } else { a_m };
        let b_m = if depth_b_m < NEAR_M { cut } else { b_m };
        Some([self.project(a_m)?.0, self.project(b_m)?.0])
    }

    /// Returns the horizontal and vertical field of view, degrees.
    pub fn field_of_view_deg(&self) -> [f64; 2] {
        let angle = |centre: f64, side: u32, focal: f64| {
            ((centre / focal).atan() + ((f64::from(side) - centre) / focal).atan()).to_degrees()
        };
        [angle(self.cx_px, self.width_px, self.fl_x_px), angle(self.cy_px, self.height_px, self.fl_y_px)]
    }

    /// Returns the same camera with another image size.
    #[must_use]
    pub fn resized(&self, width_px: u32, height_px: u32) -> Self {
        let sx = f64::from(width_px) / f64::from(self.width_px);
        let sy = f64::from(height_px) / f64::from(self.height_px);
        Self {
            width_px,
            height_px,
            fl_x_px: self.fl_x_px * sx,
            fl_y_px: self.fl_y_px * sy,
            cx_px: self.cx_px * sx,
            cy_px: self.cy_px * sy,
            world_from_camera: self.world_from_camera,
        }
    }

    /// Checks that sizes are positive, all numbers are finite, and the pose is a rigid motion.
    pub fn validate(&self) -> Result<(), CameraError> {
        for (name, value) in [("fl_x", self.fl_x_px), ("fl_y", self.fl_y_px)] {
            if !value.is_finite() {
                return Err(CameraError::NotFinite(name));
            }
            if value <= 0.0 {
                return Err(CameraError::NotPositive(name));
            }
        }
        for (name, value) in [("cx", self.cx_px), ("cy", self.cy_px)] {
            if !value.is_finite() {
                return Err(CameraError::NotFinite(name));
            }
        }
        if self.width_px == 0 {
            return Err(CameraError::NotPositive("w"));
        }
        if self.height_px == 0 {
            return Err(CameraError::NotPositive("h"));
        }
        if self.world_from_camera.iter().flatten().any(|v| !v.is_finite()) {
            return Err(CameraError::NotFinite("transform_matrix"));
        }
        if is_rigid(&self.world_from_camera) { Ok(()) } else { Err(CameraError::NotARotation) }
    }
}

/// Returns true if a matrix is a rotation and a translation over the row 0 0 0 1.
pub fn is_rigid(m: &[[f64; 4]; 4]) -> bool {
    let column = |j: usize| [m[0][j], m[1][j], m[2][j]];
    let (x, y, z) = (column(0), column(1), column(2));
    let unit = |v: [f64; 3]| (dot(v, v) - 1.0).abs() < 1e-3;
    let right_handed = dot(cross(x, y), z) > 0.0;
    let orthogonal = dot(x, y).abs() < 1e-3 && dot(y, z).abs() < 1e-3 && dot(x, z).abs() < 1e-3;
    let finite = m.iter().flatten().all(|v| v.is_finite());
    let last_row = m[3] == [0.0, 0.0, 0.0, 1.0];
    finite && unit(x) && unit(y) && unit(z) && orthogonal && right_handed && last_row
}

/// A box that is rotated about the vertical axis.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct OrientedBox {
    /// Centre, metres, world space.
    pub center: [f64; 3],
    /// Half of the extent along the box's own axes, metres.
    pub half_size: [f64; 3],
    /// Rotation about +Z, radians; 0 puts the box's length along +X.
    #[serde(default)]
    pub yaw: f64,
}

impl OrientedBox {
    /// Returns the world point of box coordinates in [-1, 1]^3.
    pub fn point(&self, unit: [f64; 3]) -> [f64; 3] {
        let (s, c) = self.yaw.sin_cos();
        let l = [0, 1, 2].map(|i| unit[i] * self.half_size[i]);
        [self.center[0] + c * l[0] - s * l[1], self.center[1] + s * l[0] + c * l[1], self.center[2] + l[2]]
    }

    /// Returns the twelve edges, metres, world space.
    pub fn edges(&self) -> [[[f64; 3]; 2]; 12] {
        let corner = |i: usize| self.point([0, 1, 2].map(|axis| if i >> axis & 1 == 1 { 1.0 } else { -1.0 }));
        let pairs = [0, 1, 2].map(|axis| {
            let across = [(axis + 1) % 3, (axis + 2) % 3];
            [0, 1, 2, 3].map(|k| {
                let from = (k & 1) << across[0] | (k >> 1) << across[1];
                [corner(from), corner(from | 1 << axis)]
            })
        });
        std::array::from_fn(|i| pairs[i / 4][i % 4])
    }

    /// Returns true if a ray hits the box in front of its origin.
    pub fn is_met_by(&self, ray: &Ray) -> bool {
        self.turned().is_met_by(ray)
    }

    /// Returns true if a world point is inside the box (including its faces).
    pub fn contains(&self, point_m: [f64; 3]) -> bool {
        self.turned().contains(point_m)
    }

    /// Returns the box with its rotation worked out, for many rays or points.
    pub fn turned(&self) -> TurnedBox {
        TurnedBox { center: self.center, half_size: self.half_size, sin_cos: self.yaw.sin_cos() }
    }

    /// Returns the gap between the footprints of two boxes on the ground, metres, along the axis of either box that
    /// separates them best: at most their distance, and negative if they overlap.
    ///
    /// ```
    /// use carff_base::geometry::OrientedBox;
    /// let car = |x: f64, yaw: f64| OrientedBox { center: [x, 0.0, 0.8], half_size: [2.0, 1.0, 0.8], yaw };
    /// assert_eq!(car(0.0, 0.0).gap_m(&car(5.0, 0.0)), 1.0);
    /// assert!(car(0.0, 0.0).gap_m(&car(3.5, 0.0)) < 0.0);
    /// ```
    pub fn gap_m(&self, other: &Self) -> f64 {
        let axes = |b: &Self| {
            let (s, c) = b.yaw.sin_cos();
            [[c, s], [-s, c]]
        };
        let reach = |b: &Self, axis: [f64; 2]| {
            let of = |i: usize| (axes(b)[i][0] * axis[0] + axes(b)[i][1] * axis[1]).abs() * b.half_size[i];
            of(0) + of(1)
        };
        let between = sub(other.center, self.center);
        let gap = |axis: [f64; 2]| {
            (between[0] * axis[0] + between[1] * axis[1]).abs() - reach(self, axis) - reach(other, axis)
        };
        axes(self).into_iter().chain(axes(other)).map(gap).fold(f64::NEG_INFINITY, f64::max)
    }
}

/// A box with its rotation worked out ([`OrientedBox::turned`]).
#[derive(Clone, Copy, Debug)]
pub struct TurnedBox {
    center: [f64; 3],
    half_size: [f64; 3],
    sin_cos: (f64, f64),
}

impl TurnedBox {
    /// Returns a vector along the box's own axes.
    fn along_axes(&self, v: [f64; 3]) -> [f64; 3] {
        let (s, c) = self.sin_cos;
        [c * v[0] + s * v[1], -s * v[0] + c * v[1], v[2]]
    }

    /// As [`OrientedBox::is_met_by`].
    pub fn is_met_by(&self, ray: &Ray) -> bool {
        let origin = self.along_axes(sub(ray.origin.map(f64::from), self.center));
        let direction = self.along_axes(ray.direction.map(f64::from));
        let (mut near, mut far) = (0.0_f64, f64::INFINITY);
        for axis in 0..3 {
            let [a, b] = [-1.0, 1.0].map(|side| (side * self.half_size[axis] - origin[axis]) / direction[axis]);
            // Along a face both values are infinite or NaN, and `min` and `max` ignore NaN.
            near = near.max(a.min(b));
            far = far.min(a.max(b));
        }
        near <= far
    }

    /// As [`OrientedBox::contains`].
    pub fn contains(&self, point_m: [f64; 3]) -> bool {
        let l = self.along_axes(sub(point_m, self.center));
        (0..3).all(|i| l[i].abs() <= self.half_size[i])
    }
}

fn sub(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[0] - b[0], a[1] - b[1], a[2] - b[2]]
}

/// Returns the scalar product.
pub fn dot(a: [f64; 3], b: [f64; 3]) -> f64 {
    a[0] * b[0] + a[1] * b[1] + a[2] * b[2]
}

/// Returns the vector product.
pub fn cross(a: [f64; 3], b: [f64; 3]) -> [f64; 3] {
    [a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]]
}

fn normalize(a: [f64; 3]) -> [f64; 3] {
    let n = dot(a, a).sqrt();
    a.map(|v| v / n)
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Projecting a point of a pixel's ray returns that pixel.
    #[test]
    fn project_inverts_ray() {
        let camera = PinholeCamera::look_at([3.0, -4.0, 2.0], [0.0, 1.0, 0.5], [0.0, 0.0, 1.0], 128, 96, 60.0);
        camera.validate().unwrap();
        let ray = camera.ray(17.5, 80.5);
        let point = [0, 1, 2].map(|i| f64::from(ray.origin[i]) + 7.0 * f64::from(ray.direction[i]));
        let (pixel, depth) = camera.project(point).unwrap();
        assert!((pixel[0] - 17.5).abs() < 1e-4 && (pixel[1] - 80.5).abs() < 1e-4);
        assert!(depth > 0.0 && depth < 7.0);
    }

    /// A segment that crosses the camera's plane is cut off there; a segment behind the camera is not drawn.
    #[test]
    fn segments_are_cut_at_the_camera() {
        let camera = PinholeCamera::look_at([0.0; 3], [1.0, 0.0, 0.0], [0.0, 0.0, 1.0], 100, 100, 90.0);
        assert_eq!(camera.project_segment([-1.0, 0.0, 0.0], [-5.0, 1.0, 0.0]), None);
        let [a, b] = camera.project_segment([4.0, 0.0, 0.0], [-4.0, 1.0, 0.0]).unwrap();
        assert!((a[0] - 50.0).abs() < 1e-6 && (a[1] - 50.0).abs() < 1e-6);
        assert!(b[0] < 0.0 && b[0].is_finite());
    }

    /// The edges of a box join each corner with its three neighbours.
    #[test]
    fn a_box_has_twelve_edges() {
        let of = OrientedBox { center: [1.0, 2.0, 3.0], half_size: [1.0, 2.0, 3.0], yaw: 0.4 };
        let mut lengths: Vec<f64> =
            of.edges().iter().map(|[a, b]| (0..3).map(|i| (a[i] - b[i]).powi(2)).sum::<f64>().sqrt()).collect();
        lengths.sort_by(f64::total_cmp);
        for (i, length) in lengths.into_iter().enumerate() {
            assert!((length - [2.0, 4.0, 6.0][i / 4]).abs() < 1e-9, "{length}");
        }
    }

    /// A camera can look straight down, with the given up direction in the image.
    #[test]
    fn look_straight_down() {
        let camera = PinholeCamera::look_at([0.0, 0.0, 20.0], [0.0, 0.0, 0.0], [0.0, 1.0, 0.0], 128, 128, 60.0);
        camera.validate().unwrap();
        let (pixel, _) = camera.project([0.0, 5.0, 0.0]).unwrap();
        assert!(pixel[1] < 64.0);
    }

    /// A mirrored or sheared pose is refused.
    #[test]
    fn validate_refuses_what_is_not_rigid() {
        let mut camera = PinholeCamera::look_at([0.0, 0.0, 2.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 8, 8, 60.0);
        camera.world_from_camera[0][0] = 3.0;
        assert_eq!(camera.validate(), Err(CameraError::NotARotation));
        camera.world_from_camera[0][0] = f64::NAN;
        assert_eq!(camera.validate(), Err(CameraError::NotFinite("transform_matrix")));
    }

    /// A rotated box contains its own points, and not a point above it.
    #[test]
    fn a_box_contains_its_points() {
        let b = OrientedBox { center: [1.0, 2.0, 3.0], half_size: [2.0, 1.0, 0.5], yaw: 0.7 };
        let sides = [-0.9, 0.0, 0.9];
        for (x, y, z) in sides.iter().flat_map(|x| sides.iter().flat_map(move |y| sides.map(|z| (*x, *y, z)))) {
            assert!(b.contains(b.point([x, y, z])));
        }
        assert!(!b.contains([1.0, 2.0, 3.6]));
    }

    /// A camera above a region looks straight down and sees its longer side from edge to edge.
    #[test]
    fn a_camera_above_sees_the_region() {
        let camera = PinholeCamera::above([[-4.0, -1.0, 0.5], [6.0, 3.0, 2.0]], 64, 64);
        assert!((camera.ray(32.0, 32.0).direction[2] + 1.0).abs() < 1e-6);
        let ([x, _], _) = camera.project([6.0, 1.0, 0.5]).unwrap();
        assert!((x - 64.0).abs() < 1e-9, "{x}");
    }

    /// Rays through the box from any side hit it, rotated or not; rays next to it, away from it, or parallel to it do
    /// not.
    #[test]
    fn boxes_are_met() {
        let upright = OrientedBox { center: [3.0, 0.0, 1.0], half_size: [1.0, 0.2, 1.0], yaw: 0.0 };
        let turned = OrientedBox { yaw: std::f64::consts::FRAC_PI_2, ..upright };
        let ray = |origin, direction| Ray { origin, direction, spread: 0.0 };
        let along_x = |y| ray([-5.0, y, 1.0], [1.0, 0.0, 0.0]);
        assert!(upright.is_met_by(&along_x(0.1)) && !upright.is_met_by(&along_x(0.5)));
        assert!(turned.is_met_by(&along_x(0.5)) && !turned.is_met_by(&along_x(1.5)));
        assert!(!upright.is_met_by(&ray([-5.0, 0.0, 1.0], [-1.0, 0.0, 0.0])));
        assert!(upright.is_met_by(&ray([3.5, 0.1, 9.0], [0.0, 0.0, -1.0])));
        assert!(!upright.is_met_by(&ray([4.5, 0.1, 9.0], [0.0, 0.0, -1.0])));
        assert!(upright.is_met_by(&ray([3.0, 0.0, 1.0], [0.0, 1.0, 0.0])), "from within");
    }
}
