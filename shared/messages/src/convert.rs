//! Conversions between messages and the types of the libraries.

use crate::{DatasetView, EgoPose, FrameMeta, Header, Intrinsics, ViewMeta};
use carff_base::geometry::PinholeCamera;

impl From<&PinholeCamera> for Intrinsics {
    fn from(camera: &PinholeCamera) -> Self {
        Self { fl_x_px: camera.fl_x_px, fl_y_px: camera.fl_y_px, cx_px: camera.cx_px, cy_px: camera.cy_px }
    }
}

impl Intrinsics {
    fn camera(&self, width_px: u32, height_px: u32, world_from_camera: &[f64; 16]) -> PinholeCamera {
        let Self { fl_x_px, fl_y_px, cx_px, cy_px } = *self;
        let world_from_camera = rows(world_from_camera);
        PinholeCamera { width_px, height_px, fl_x_px, fl_y_px, cx_px, cy_px, world_from_camera }
    }
}

/// Returns a pose as messages store it: row-major.
pub fn row_major(world_from_camera: &[[f64; 4]; 4]) -> [f64; 16] {
    std::array::from_fn(|i| world_from_camera[i / 4][i % 4])
}

/// Returns the rows of a pose that is stored row-major.
fn rows(pose: &[f64; 16]) -> [[f64; 4]; 4] {
    let (rows, _) = pose.as_chunks::<4>();
    std::array::from_fn(|row| rows[row])
}

impl EgoPose {
    /// Returns the message of a pose.
    pub fn new(header: Header, world_from_vehicle: &[[f64; 4]; 4]) -> Self {
        Self { header, world_from_vehicle: row_major(world_from_vehicle) }
    }

    /// Returns the pose: vehicle space to world space.
    pub(crate) fn pose(&self) -> [[f64; 4]; 4] {
        rows(&self.world_from_vehicle)
    }

    /// Returns the pose in the world of a camera on the vehicle.
    pub fn world_from_camera(&self, vehicle_from_camera: &[[f64; 4]; 4]) -> [[f64; 4]; 4] {
        let pose = self.pose();
        std::array::from_fn(|i| {
            std::array::from_fn(|j| (0..4).map(|k| pose[i][k] * vehicle_from_camera[k][j]).sum::<f64>())
        })
    }
}

impl FrameMeta {
    /// Describes a frame of a camera; the header is set on send.
    pub fn of_camera(camera: &PinholeCamera, dataset_view: DatasetView) -> Self {
        Self {
            header: Header::default(),
            width_px: camera.width_px,
            height_px: camera.height_px,
            intrinsics: camera.into(),
            world_from_camera: row_major(&camera.world_from_camera),
            dataset_view,
            take_start: 0,
        }
    }

    /// Returns the camera that took the frame.
    pub fn camera(&self) -> PinholeCamera {
        self.intrinsics.camera(self.width_px, self.height_px, &self.world_from_camera)
    }
}

impl ViewMeta {
    /// Returns the camera that the view is rendered from.
    pub fn camera(&self) -> PinholeCamera {
        self.intrinsics.camera(self.width_px, self.height_px, &self.world_from_camera)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A camera is converted to a message and back without a change, bit for bit.
    #[test]
    fn cameras_round_trip() {
        let camera = PinholeCamera::look_at([3.0, -1.5, 2.0], [0.1, 0.2, 0.3], [0.0, 0.0, 1.0], 64, 48, 70.0);
        assert_eq!(FrameMeta::of_camera(&camera, DatasetView::UNKNOWN).camera(), camera);
    }
}
