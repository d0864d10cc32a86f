//! Lenses: their polynomials, their keys in transforms files, and the images that a pinhole camera would have taken.

use carff_base::geometry::PinholeCamera;
use serde_json::{Map, Value};

use crate::error::DatasetError;
use crate::image::Image;
use crate::place::{Place, kind, numbers, present};

/// Lens of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(crate) enum Lens {
    /// A lens without distortion.
    #[default]
    Pinhole,
    /// `OPENCV`: radial coefficients of the 2nd, 4th, 6th and 8th power of the radius, and tangential ones.
    Perspective { radial: [f64; 4], tangential: [f64; 2] },
    /// `OPENCV_FISHEYE`: coefficients of the 2nd, 4th, 6th and 8th power of the angle from the axis. An equidistant lens
    /// has zeros.
    Fisheye([f64; 4]),
}

const SUPPORTED: &str = "supported are OPENCV (also PINHOLE, SIMPLE_PINHOLE, SIMPLE_RADIAL, RADIAL, PERSPECTIVE) and \
                         OPENCV_FISHEYE (also RADIAL_FISHEYE, SIMPLE_RADIAL_FISHEYE); convert the images first";

/// Coefficients of other models: an image with one of them cannot be undistorted.
const UNSUPPORTED: [&str; 14] = [
    "k5",
    "k6",
    "s1",
    "s2",
    "s3",
    "s4",
    "ftheta_p0",
    "ftheta_p1",
    "ftheta_p2",
    "ftheta_p3",
    "ftheta_p4",
    "latlong",
    "equirectangular",
    "orthographic",
];

impl Lens {
    /// Reads the frame's own keys, or else those at top level.
    pub fn read(place: &Place, frame: &Map<String, Value>, top: &Map<String, Value>) -> Result<Self, DatasetError> {
        let map = |key: &str| if present(frame, key).is_some() { frame } else { top };
        for key in UNSUPPORTED {
            if let Some(value) = present(map(key), key).filter(|v| is_set(v)) {
                return Err(place.error(key, format!("is {value}; this lens is not supported; {SUPPORTED}")));
            }
        }
        let radius = "fisheye_crop_radius";
        if let Some(value) = present(map(radius), radius).filter(|v| is_set(v)) {
            let problem = format!("is {value}, and is not supported; write the circle as a mask (`mask_path`)");
            return Err(place.error(radius, problem));
        }
        let model = place.text(map("camera_model"), "camera_model")?;
        let fisheye = match model.map(str::to_ascii_uppercase).as_deref() {
            None | Some("OPENCV" | "PINHOLE" | "SIMPLE_PINHOLE" | "SIMPLE_RADIAL" | "RADIAL" | "PERSPECTIVE") => {
                place.flag(map("is_fisheye"), "is_fisheye")?
            }
            Some("OPENCV_FISHEYE" | "RADIAL_FISHEYE" | "SIMPLE_RADIAL_FISHEYE") => true,
            Some(other) => return Err(place.error("camera_model", format!("is `{other}`; {SUPPORTED}"))),
        };
        let [k1, k2, k3, k4, p1, p2] = coefficients(place, &map)?;
        if fisheye {
            return match [("p1", p1), ("p2", p2)].iter().find(|(_, value)| value.abs() > 1e-9) {
                Some((key, value)) => Err(place.error(key, format!("is {value}; a fisheye lens has only k1 to k4"))),
                None => Ok(Self::Fisheye([k1, k2, k3, k4])),
            };
        }
        let none = [k1, k2, k3, k4, p1, p2].iter().all(|v| v.abs() <= 1e-9);
        let perspective = Self::Perspective { radial: [k1, k2, k3, k4], tangential: [p1, p2] };
        Ok(if none { Self::Pinhole } else { perspective })
    }

    /// Returns the key that a warning names.
    pub fn key(&self) -> &'static str {
        match self {
            Self::Perspective { radial, tangential } => {
                let values = radial.iter().chain(tangential);
                let keys = ["k1", "k2", "k3", "k4", "p1", "p2"];
                keys.into_iter().zip(values).find(|(_, v)| v.abs() > 1e-9).map_or("k1", |(key, _)| key)
            }
            _ => "camera_model",
        }
    }

    /// Returns the polynomial of the distance from the axis: the radius of a point at distance 1 for a perspective lens,
    /// its angle for a fisheye lens.
    fn polynomial(&self, t: f64) -> f64 {
        let [a, b, c, d] = match self {
            Self::Pinhole => [0.0; 4],
            Self::Perspective { radial: k, .. } | Self::Fisheye(k) => *k,
        };
        let t2 = t * t;
        1.0 + t2 * (a + t2 * (b + t2 * (c + t2 * d)))
    }

    /// Returns the argument of the polynomial for a radius at distance 1.
    fn argument(&self, radius: f64) -> f64 {
        if matches!(self, Self::Fisheye(_)) { radius.atan() } else { radius }
    }

    /// Returns the largest argument below `limit` up to which points keep their order from the axis outwards. A
    /// polynomial of measured coefficients turns back beyond the image that it was measured on.
    fn reach(&self, limit: f64) -> f64 {
        const STEPS: u32 = 4096;
        let bent =
            |i: u32| limit * f64::from(i) / f64::from(STEPS) * self.polynomial(limit * f64::from(i) / f64::from(STEPS));
        let turn = (1..=STEPS).find(|&i| bent(i).partial_cmp(&bent(i - 1)) != Some(std::cmp::Ordering::Greater));
        turn.map_or(limit, |i| limit * f64::from(i - 1) / f64::from(STEPS))
    }

    /// Returns the position at distance 1 at which the lens shows the point (x, y) at distance 1.
    fn bent(&self, x: f64, y: f64) -> [f64; 2] {
        let radius = x.hypot(y);
        match self {
            Self::Pinhole => [x, y],
            Self::Fisheye(_) => {
                let angle = radius.atan();
                let scale = if radius > 1e-9 { angle * self.polynomial(angle) / radius } else { 1.0 };
                [x * scale, y * scale]
            }
            Self::Perspective { tangential: [p1, p2], .. } => {
                let (r2, radial) = (radius * radius, self.polynomial(radius));
                [
                    x * radial + 2.0 * p1 * x * y + p2 * (r2 + 2.0 * x * x),
                    y * radial + p1 * (r2 + 2.0 * y * y) + 2.0 * p2 * x * y,
                ]
            }
        }
    }

    /// Returns the function from a position in a pinhole camera's image (pixels; a pixel's centre is at +0.5) to the
    /// position in the lens's image on `sensor` (pixels; a pixel's centre is at 0); `None` where the lens shows nothing.
    pub fn mapping<'a>(
        &'a self,
        camera: &'a PinholeCamera,
        sensor: &'a PinholeCamera,
    ) -> impl Fn(f64, f64) -> Option<[f64; 2]> + 'a {
        let (w, h) = (f64::from(camera.width_px), f64::from(camera.height_px));
        let at = |u: f64, v: f64| [(u - camera.cx_px) / camera.fl_x_px, (v - camera.cy_px) / camera.fl_y_px];
        let corners = [at(0.0, 0.0), at(w, 0.0), at(0.0, h), at(w, h)];
        let reach = self.reach(corners.iter().map(|[x, y]| self.argument(x.hypot(*y))).fold(0.0, f64::max));
        move |u, v| {
            let [x, y] = at(u, v);
            let [x, y] = Some([x, y]).filter(|_| self.argument(x.hypot(y)) <= reach).map(|[x, y]| self.bent(x, y))?;
            let (u, v) = (x * sensor.fl_x_px + sensor.cx_px - 0.5, y * sensor.fl_y_px + sensor.cy_px - 0.5);
            (u.is_finite() && v.is_finite()).then_some([u, v])
        }
    }

    /// Returns, for each pixel of a pinhole camera of these intrinsics, its position in the lens's image in pixels;
    /// `None` where the lens shows nothing.
    fn positions<'a>(&'a self, camera: &'a PinholeCamera) -> impl Iterator<Item = Option<[f64; 2]>> + 'a {
        let position = self.mapping(camera, camera);
        let pixels = (0..camera.height_px).flat_map(move |v| (0..camera.width_px).map(move |u| (u, v)));
        pixels.map(move |(u, v)| position(f64::from(u) + 0.5, f64::from(v) + 0.5))
    }

    /// Returns the field of view of the lens on a sensor, from edge to edge through the principal point: horizontal and
    /// vertical, degrees.
    pub fn field_of_view_deg(&self, sensor: &PinholeCamera) -> [f64; 2] {
        /// Steps of a twentieth of a degree up to the angle that a pinhole camera can show.
        const STEPS: u32 = 1790;
        let degrees = |step: u32| f64::from(step) / 20.0;
        let angle = |step: u32| degrees(step).to_radians();
        let reach = self.reach(self.argument(angle(STEPS).tan()));
        let (w, h) = (f64::from(sensor.width_px), f64::from(sensor.height_px));
        let shown = |direction: [f64; 2], step: u32| {
            let radius = angle(step).tan();
            let [x, y] = self.bent(direction[0] * radius, direction[1] * radius);
            let (u, v) = (x * sensor.fl_x_px + sensor.cx_px, y * sensor.fl_y_px + sensor.cy_px);
            self.argument(radius) <= reach && u >= 0.0 && v >= 0.0 && u <= w && v <= h
        };
        let side =
            |direction: [f64; 2]| (0..=STEPS).take_while(|&step| shown(direction, step)).last().map_or(0.0, degrees);
        [side([-1.0, 0.0]) + side([1.0, 0.0]), side([0.0, -1.0]) + side([0.0, 1.0])]
    }

    /// Returns the pixels of the undistorted image that the lens's image shows, and that `mask` (of the lens's image)
    /// has not excluded.
    pub fn valid(&self, camera: &PinholeCamera, mask: Option<&[bool]>) -> Vec<bool> {
        if let (Self::Pinhole, Some(mask)) = (self, mask) {
            return mask.to_vec();
        }
        let (w, h) = (camera.width_px as usize, camera.height_px as usize);
        let shown = |position: Option<[f64; 2]>| {
            let Some([u, v]) = position else { return false };
            let inside = u > -0.5 && v > -0.5 && u < w as f64 - 0.5 && v < h as f64 - 0.5;
            inside && mask.is_none_or(|mask| neighbours(u, v, w, h).0.iter().all(|&i| mask[i]))
        };
        self.positions(camera).map(shown).collect()
    }

    /// Returns the image that a pinhole camera of the same intrinsics would have taken. Pixels that the lens does not
    /// show have the colour of the nearest edge, or are black; [`Self::valid`] excludes them.
    pub fn undistorted(&self, image: &Image, camera: &PinholeCamera) -> Image {
        let (w, h) = (image.width_px as usize, image.height_px as usize);
        let mut result = Image::filled(image.width_px, image.height_px, [0; 3]);
        for (pixel, position) in result.rgb.chunks_exact_mut(3).zip(self.positions(camera)) {
            let Some([u, v]) = position else { continue };
            let (at, [a, b]) = neighbours(u, v, w, h);
            for (c, value) in pixel.iter_mut().enumerate() {
                let [upper_left, upper_right, lower_left, lower_right] = at.map(|i| f64::from(image.rgb[i * 3 + c]));
                let upper = upper_left * (1.0 - a) + upper_right * a;
                let lower = lower_left * (1.0 - a) + lower_right * a;
                *value = (upper * (1.0 - b) + lower * b).round() as u8;
            }
        }
        result
    }
}

/// Returns the four pixels around a position, and the position between them, 0..1.
pub(crate) fn neighbours(u: f64, v: f64, w: usize, h: usize) -> ([usize; 4], [f64; 2]) {
    let (u, v) = (u.clamp(0.0, (w - 1) as f64), v.clamp(0.0, (h - 1) as f64));
    let (left, top) = (u.floor() as usize, v.floor() as usize);
    let (right, bottom) = ((left + 1).min(w - 1), (top + 1).min(h - 1));
    let at = [(left, top), (right, top), (left, bottom), (right, bottom)].map(|(x, y)| y * w + x);
    (at, [u - left as f64, v - top as f64])
}

/// Returns true for `true` and for numbers other than zero.
fn is_set(value: &Value) -> bool {
    value.as_bool().unwrap_or_else(|| value.as_f64().is_none_or(|v| v.abs() > 1e-9))
}

/// Reads k1, k2, k3, k4, p1, p2: from these keys, or from nerfstudio's list `distortion_params`.
fn coefficients<'m>(place: &Place, map: &impl Fn(&str) -> &'m Map<String, Value>) -> Result<[f64; 6], DatasetError> {
    let list = "distortion_params";
    if let Some(value) = present(map(list), list) {
        let wrong =
            || place.error(list, format!("must be 6 finite numbers, k1, k2, k3, k4, p1, p2; found {}", kind(value)));
        return numbers::<6>(value).ok_or_else(wrong);
    }
    let mut values = [0.0; 6];
    for (value, key) in values.iter_mut().zip(["k1", "k2", "k3", "k4", "p1", "p2"]) {
        *value = place.number(map(key), key)?.unwrap_or(0.0);
    }
    Ok(values)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera() -> PinholeCamera {
        PinholeCamera::look_at([0.0; 3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], 64, 48, 60.0)
    }

    /// Returns the centre of the light of a dot at (u, v) in the lens's image, after undistortion.
    fn moved(lens: Lens, camera: &PinholeCamera, [u, v]: [f64; 2]) -> [f64; 2] {
        let (w, h) = (camera.width_px, camera.height_px);
        let mut bent = Image::filled(w, h, [0; 3]);
        let centre = |i: usize| [(i % w as usize) as f64 + 0.5, (i / w as usize) as f64 + 0.5];
        for (i, p) in bent.rgb.chunks_exact_mut(3).enumerate() {
            let distance = (centre(i)[0] - u).hypot(centre(i)[1] - v);
            p.fill((255.0 * (-distance * distance / 4.0).exp()) as u8);
        }
        let (mut sum, mut at) = (0.0, [0.0; 2]);
        for (i, p) in lens.undistorted(&bent, camera).rgb.chunks_exact(3).enumerate() {
            let weight = f64::from(p[0]);
            sum += weight;
            at = [0, 1].map(|axis| at[axis] + weight * centre(i)[axis]);
        }
        at.map(|v| v / sum)
    }

    /// Undistortion inverts the lens: a dot at the distorted position moves to the pinhole camera's position.
    #[test]
    fn lenses_are_straightened() {
        let camera = camera();
        let distortion = [-0.25, 0.05, 0.0, 0.0, 0.002, -0.001];
        let (x, y) = (0.35, -0.2);
        let r2: f64 = x * x + y * y;
        let radial = 1.0 + distortion[0] * r2 + distortion[1] * r2 * r2;
        let xd = x * radial + 2.0 * distortion[4] * x * y + distortion[5] * (r2 + 2.0 * x * x);
        let yd = y * radial + distortion[4] * (r2 + 2.0 * y * y) + 2.0 * distortion[5] * x * y;
        let pixel = |x: f64, y: f64| [x * camera.fl_x_px + camera.cx_px, y * camera.fl_y_px + camera.cy_px];
        let [k1, k2, k3, k4, p1, p2] = distortion;
        let lens = Lens::Perspective { radial: [k1, k2, k3, k4], tangential: [p1, p2] };
        let ([a, b], [u, v]) = (moved(lens, &camera, pixel(xd, yd)), pixel(x, y));
        assert!((a - u).abs() < 0.2 && (b - v).abs() < 0.2, "{a} {b} {u} {v}");
    }

    /// A fisheye lens shows a point at the angle theta at theta (1 + k1 theta^2 + ..) focal lengths from the centre, also
    /// with coefficients of zero.
    #[test]
    fn fisheye_lenses_are_straightened() {
        let camera = camera();
        for k in [[0.0; 4], [0.03, 0.005, 0.0007, 0.0001], [-0.02, 0.001, 0.0, 0.0]] {
            let (x, y): (f64, f64) = (-0.38, 0.3);
            let theta = x.hypot(y).atan();
            let t2 = theta * theta;
            let theta_d = theta * (1.0 + k[0] * t2 + k[1] * t2 * t2 + k[2] * t2.powi(3) + k[3] * t2.powi(4));
            let scale = theta_d / x.hypot(y);
            let pixel = |x: f64, y: f64| [x * camera.fl_x_px + camera.cx_px, y * camera.fl_y_px + camera.cy_px];
            let ([a, b], [u, v]) = (moved(Lens::Fisheye(k), &camera, pixel(x * scale, y * scale)), pixel(x, y));
            assert!((a - u).abs() < 0.2 && (b - v).abs() < 0.2, "{k:?}: {a} {b} {u} {v}");
        }
    }

    /// Pixels beyond the lens's image, and beyond the turn of its polynomial, are not valid; neither are those whose
    /// source is masked.
    #[test]
    fn pixels_without_a_source_are_not_valid() {
        let camera = camera();
        let pincushion = Lens::Perspective { radial: [0.3, 0.0, 0.0, 0.0], tangential: [0.0; 2] };
        let valid = pincushion.valid(&camera, None);
        assert!(!valid[0] && valid[24 * 64 + 32] && !valid[63]);
        // The derivative of r (1 - r^2) is zero at r = 0.577: the corner at 0.72 would show the middle of the image.
        let barrel = Lens::Perspective { radial: [-1.0, 0.0, 0.0, 0.0], tangential: [0.0; 2] };
        let valid = barrel.valid(&camera, None);
        assert!(!valid[0] && valid[24 * 64 + 32] && valid[24 * 64 + 2] && !valid[64 * 48 - 1]);
        let mut mask = vec![true; 64 * 48];
        mask[10 * 64 + 7] = false;
        let valid = Lens::Pinhole.valid(&camera, Some(&mask));
        assert_eq!(valid, mask);
        for k in [f64::MAX, 1e300, -1e300] {
            let lens = Lens::Perspective { radial: [k, k, k, k], tangential: [k, k] };
            assert!(lens.valid(&camera, None).len() == 64 * 48);
            let _ = lens.undistorted(&Image::filled(64, 48, [1; 3]), &camera);
        }
    }
}
