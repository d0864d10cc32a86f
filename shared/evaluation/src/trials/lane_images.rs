//! Images of the others' lane with a vehicle at any place.

use carff_base::geometry::PinholeCamera;
use carff_dataset::Image;

/// One image of a drive with at most one other vehicle.
#[derive(Clone, Debug)]
pub struct LaneImage {
    /// Time, seconds.
    pub time_s: f64,
    /// The image, without sensor noise.
    pub image: Image,
    /// The camera.
    pub camera: PinholeCamera,
    /// Heading of the vehicle with the camera about +Z, radians.
    pub heading_rad: f64,
    /// Centre of the other vehicle, x and y, metres.
    pub vehicle_m: [f64; 2],
    /// Its speed along the lane, m/s.
    pub speed_mps: f64,
    /// Visibility of that vehicle.
    pub visibility: Visibility,
}

/// Visibility of a vehicle in an image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Visibility {
    /// Nearly all of it is in view.
    Whole,
    /// At least 100 pixels show it, but a part is hidden or out of view.
    Partial,
    /// A few pixels show it: neither found nor missed.
    Hardly,
    /// Nothing of it is in view.
    None,
}
