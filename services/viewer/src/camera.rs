//! The user's camera: orbit, pan and zoom about a target point, and projection of world points into its image.

use carff_base::geometry::PinholeCamera;

/// Rotation for a drag across the image's shorter side, degrees.
const ORBIT_DEG_PER_SIDE: f64 = 180.0;
/// Highest elevation of the camera, degrees.
const MOST_ELEVATION_DEG: f64 = 90.0;
/// Lowest elevation, degrees: below the horizon the ground hides everything.
const LEAST_ELEVATION_DEG: f64 = -5.0;
/// Nearest and farthest distance to the target point, metres.
const DISTANCE_M: [f64; 2] = [1.0, 200.0];
/// Narrowest and widest field of view, degrees.
pub const FOV_DEG: [f64; 2] = [15.0, 110.0];
/// Widest field of view across an image's longer side, degrees: wider images are distorted.
const MOST_WIDE_DEG: f64 = 150.0;

/// An upright camera that looks at a target point.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct OrbitCamera {
    /// The point that the camera looks at, metres, world space.
    pub target_m: [f64; 3],
    /// Distance to the target, metres.
    pub distance_m: f64,
    /// Direction from the target to the camera about +Z, degrees; 0 is +X.
    pub azimuth_deg: f64,
    /// Angle of that direction above the ground, degrees.
    pub elevation_deg: f64,
    /// Field of view across the image's shorter side, degrees.
    pub fov_deg: f64,
}

impl OrbitCamera {
    /// Returns a camera above a corner of the region of interest, as the renderer stage's free view.
    pub fn over_corner(bounds_m: [[f64; 3]; 2]) -> Self {
        let [low, high] = bounds_m;
        let target_m = [f64::midpoint(low[0], high[0]), f64::midpoint(low[1], high[1]), low[2] + 0.5];
        let extent_m = (high[0] - low[0]).max(high[1] - low[1]);
        Self { target_m, distance_m: 1.25 * extent_m, azimuth_deg: -50.0, elevation_deg: 38.0, fov_deg: 45.0 }
    }

    /// Returns a camera that looks straight down on the region of interest; +Y is up in the image.
    pub fn above(bounds_m: [[f64; 3]; 2]) -> Self {
        let [low, high] = bounds_m;
        let fov_deg = 45.0_f64;
        let extent_m = (high[0] - low[0]).max(high[1] - low[1]);
        Self {
            target_m: [f64::midpoint(low[0], high[0]), f64::midpoint(low[1], high[1]), low[2]],
            distance_m: extent_m / 2.0 / (fov_deg / 2.0).to_radians().tan(),
            azimuth_deg: -90.0,
            elevation_deg: 90.0,
            fov_deg,
        }
    }

    /// Returns the pose of another camera. `ground_m` is the height at which its line of sight ends.
    pub fn from_pinhole(camera: &PinholeCamera, ground_m: f64) -> Self {
        let m = &camera.world_from_camera;
        let eye_m = camera.position_m();
        let back = [m[0][2], m[1][2], m[2][2]];
        let horizontal = back[0].hypot(back[1]);
        // A vertical view direction has no azimuth: take the image's up direction.
        let azimuth = if horizontal > 1e-6 { back[1].atan2(back[0]) } else { (-m[1][1]).atan2(-m[0][1]) };
        let to_ground_m = if back[2] > 1e-3 { (eye_m[2] - ground_m) / back[2] } else { DISTANCE_M[1] };
        let distance_m = to_ground_m.clamp(DISTANCE_M[0], 30.0);
        let shorter_px = f64::from(camera.width_px.min(camera.height_px));
        let fl_px = if camera.width_px <= camera.height_px { camera.fl_x_px } else { camera.fl_y_px };
        Self {
            target_m: [0, 1, 2].map(|i| eye_m[i] - back[i] * distance_m),
            distance_m,
            azimuth_deg: azimuth.to_degrees(),
            elevation_deg: back[2].clamp(-1.0, 1.0).asin().to_degrees(),
            fov_deg: 2.0 * (shorter_px / 2.0 / fl_px).atan().to_degrees(),
        }
    }

    /// Turns about the target for a drag over an image of this size; down and right are positive.
    pub fn orbit(&mut self, drag_px: [f64; 2], image_px: [f64; 2]) {
        let deg_per_px = ORBIT_DEG_PER_SIDE / image_px[0].min(image_px[1]).max(1.0);
        self.azimuth_deg = (self.azimuth_deg - drag_px[0] * deg_per_px).rem_euclid(360.0);
        self.elevation_deg =
            (self.elevation_deg + drag_px[1] * deg_per_px).clamp(LEAST_ELEVATION_DEG, MOST_ELEVATION_DEG);
    }

    /// Moves parallel to the image plane, so that points at the target's distance follow the mouse.
    pub fn pan(&mut self, drag_px: [f64; 2], image_px: [f64; 2]) {
        let shorter_px = image_px[0].min(image_px[1]).max(1.0);
        let metres_per_px = 2.0 * self.distance_m * (self.fov_deg / 2.0).to_radians().tan() / shorter_px;
        let [right, up, _] = self.axes();
        for i in 0..3 {
            self.target_m[i] += metres_per_px * (drag_px[1] * up[i] - drag_px[0] * right[i]);
        }
    }

    /// Moves nearer (`factor` above 1) or farther.
    pub fn zoom(&mut self, factor: f64) {
        if factor.is_finite() && factor > 0.0 {
            self.distance_m = (self.distance_m / factor).clamp(DISTANCE_M[0], DISTANCE_M[1]);
        }
    }

    /// Sets the field of view, within its limits.
    pub fn set_fov(&mut self, fov_deg: f64) {
        self.fov_deg = fov_deg.clamp(FOV_DEG[0], FOV_DEG[1]);
    }

    /// Returns the right, up and back axes, world space.
    fn axes(&self) -> [[f64; 3]; 3] {
        let (sin_a, cos_a) = self.azimuth_deg.to_radians().sin_cos();
        let (sin_e, cos_e) = self.elevation_deg.to_radians().sin_cos();
        [[-sin_a, cos_a, 0.0], [-sin_e * cos_a, -sin_e * sin_a, cos_e], [cos_e * cos_a, cos_e * sin_a, sin_e]]
    }

    /// Returns the camera's position, metres, world space.
    pub fn eye_m(&self) -> [f64; 3] {
        let [_, _, back] = self.axes();
        [0, 1, 2].map(|i| self.target_m[i] + self.distance_m * back[i])
    }

    /// Returns the pinhole camera for an image of this size.
    pub fn pinhole(&self, width_px: u32, height_px: u32) -> PinholeCamera {
        let [_, up, _] = self.axes();
        let half = (self.fov_deg.clamp(FOV_DEG[0], FOV_DEG[1]) / 2.0).to_radians().tan();
        let aspect = f64::from(width_px.max(1)) / f64::from(height_px.max(1));
        let fov_x_deg = (2.0 * (half * aspect.max(1.0)).atan()).to_degrees().min(MOST_WIDE_DEG);
        PinholeCamera::look_at(self.eye_m(), self.target_m, up, width_px.max(1), height_px.max(1), fov_x_deg)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const BOUNDS_M: [[f64; 3]; 2] = [[-17.0, -19.0, 0.0], [5.5, 5.0, 5.4]];

    fn near(a: f64, b: f64) -> bool {
        (a - b).abs() < 1e-6
    }

    /// At any rotation, the target stays in the middle of the image and at its distance, and the pose is a rotation.
    #[test]
    fn orbiting_keeps_target_and_distance() {
        let mut camera = OrbitCamera::over_corner(BOUNDS_M);
        let before = camera;
        for drag in [[40.0, 10.0], [-300.0, 500.0], [7.0, -900.0], [0.0, 90.0]] {
            camera.orbit(drag, [640.0, 480.0]);
            let pinhole = camera.pinhole(640, 480);
            pinhole.validate().unwrap();
            let ([x, y], depth_m) = pinhole.project(camera.target_m).unwrap();
            assert!(near(x, 320.0) && near(y, 240.0) && near(depth_m, before.distance_m), "{x} {y} {depth_m}");
        }
        assert_eq!(camera.target_m, before.target_m);
        assert!((LEAST_ELEVATION_DEG..=MOST_ELEVATION_DEG).contains(&camera.elevation_deg));
    }

    /// Dragging right turns the scene with the mouse: points in front of the target move right.
    #[test]
    fn orbit_follows_the_hand() {
        let mut camera = OrbitCamera::over_corner(BOUNDS_M);
        let eye_m = camera.eye_m();
        let in_front: [f64; 3] = std::array::from_fn(|i| camera.target_m[i] + 0.3 * (eye_m[i] - camera.target_m[i]));
        camera.orbit([20.0, 0.0], [640.0, 480.0]);
        let ([x, _], _) = camera.pinhole(640, 480).project(in_front).unwrap();
        assert!(x > 325.0, "{x}");
    }

    /// Panning moves points at the target's distance by the same number of pixels as the mouse.
    #[test]
    fn pan_follows_the_hand() {
        for size in [[640, 480], [480, 640]] {
            let mut camera = OrbitCamera::over_corner(BOUNDS_M);
            let point = camera.target_m;
            camera.pan([37.0, -12.0], size.map(f64::from));
            let ([x, y], _) = camera.pinhole(size[0], size[1]).project(point).unwrap();
            let [middle_x, middle_y] = size.map(|s| f64::from(s) / 2.0);
            assert!(near(x, middle_x + 37.0) && near(y, middle_y - 12.0), "{x} {y}");
        }
    }

    /// Zooming in by two halves the distance; limits hold, and an invalid factor changes nothing.
    #[test]
    fn zoom_is_limited() {
        let mut camera = OrbitCamera::over_corner(BOUNDS_M);
        let far_m = camera.distance_m;
        camera.zoom(2.0);
        assert!(near(camera.distance_m, far_m / 2.0));
        for factor in [0.0, -1.0, f64::NAN, f64::INFINITY] {
            camera.zoom(factor);
            assert!(near(camera.distance_m, far_m / 2.0));
        }
        camera.zoom(1e9);
        assert!(near(camera.distance_m, DISTANCE_M[0]));
        camera.zoom(1e-9);
        assert!(near(camera.distance_m, DISTANCE_M[1]));
        camera.set_fov(1000.0);
        assert!(near(camera.fov_deg, FOV_DEG[1]));
    }

    /// From above, +Y is up in the image, and the image contains the whole region at any aspect ratio of the window.
    #[test]
    fn above_shows_the_region() {
        let camera = OrbitCamera::above(BOUNDS_M);
        for (w, h) in [(400, 400), (800, 300), (300, 800)] {
            let pinhole = camera.pinhole(w, h);
            for corner in [[-17.0, -19.0, 0.0], [5.5, 5.0, 0.0]] {
                let ([x, y], _) = pinhole.project(corner).unwrap();
                assert!((0.0..=f64::from(w)).contains(&x) && (0.0..=f64::from(h)).contains(&y), "{x} {y}");
            }
            let ([_, y], _) = pinhole.project([camera.target_m[0], 5.0, 0.0]).unwrap();
            assert!(y < f64::from(h) / 2.0);
        }
    }

    /// A camera made from another camera gives the same image: position, direction and field of view.
    #[test]
    fn takes_another_cameras_place() {
        let eyes = [([3.0, -12.0, 5.0], [-2.0, 0.0, 0.5]), ([-6.0, -7.0, 22.0], [-6.0, -7.0, 0.0])];
        for (eye_m, target_m) in eyes {
            let up = if eye_m[0] == target_m[0] { [0.0, 1.0, 0.0] } else { [0.0, 0.0, 1.0] };
            let other = PinholeCamera::look_at(eye_m, target_m, up, 128, 128, 60.0);
            let own = OrbitCamera::from_pinhole(&other, 0.0).pinhole(128, 128);
            for (a, b) in own.world_from_camera.iter().flatten().zip(other.world_from_camera.iter().flatten()) {
                assert!((a - b).abs() < 1e-6, "{own:?}\n{other:?}");
            }
            assert!((own.fl_x_px - other.fl_x_px).abs() < 1e-6);
        }
    }
}
