//! The pose of the vehicle, from another program: a localisation, or a simulator.

use carff_base::geometry::is_rigid;
use carff_config::Pose;
use carff_messages::{Header, Invalid, ZeroCopySend, check, described, message};
use carff_transport::{Topic, topics};

/// The pose of the vehicle in the world.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, ZeroCopySend)]
#[type_name("carff.EgoPose.v1")]
pub struct EgoPose {
    /// Header; its capture time is the time of the pose.
    pub header: Header,
    /// Row-major 4x4: vehicle space to world space (metres).
    pub world_from_vehicle: [f64; 16],
}

/// Topic of the vehicle's pose. A camera with `camera.vehicle_from_camera` takes the newest one for each frame.
pub const EGO_POSE: Topic<EgoPose> = Topic::new("ego/pose", topics::STATUS, 500);

impl EgoPose {
    fn pose(&self) -> Pose {
        std::array::from_fn(|row| std::array::from_fn(|column| self.world_from_vehicle[row * 4 + column]))
    }

    /// Returns the pose in the world of a camera on the vehicle.
    pub fn world_from_camera(&self, vehicle_from_camera: &Pose) -> Pose {
        let pose = self.pose();
        std::array::from_fn(|i| {
            std::array::from_fn(|j| (0..4).map(|k| pose[i][k] * vehicle_from_camera[k][j]).sum::<f64>())
        })
    }

    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()?;
        check::finite_f64("world_from_vehicle", &self.world_from_vehicle)?;
        let field = "world_from_vehicle (1: a rotation and a translation)";
        check::equals(field, is_rigid(&self.pose()).into(), 1)
    }
}

message!(EgoPose);
described!(EgoPose { header, world_from_vehicle });

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Message;

    /// A camera one metre ahead of a vehicle that has turned left by a right angle and moved is where both together
    /// place it. A pose that is not a rigid motion is not valid.
    #[test]
    fn poses_are_composed() {
        let mut ego = EgoPose { header: Header::of_frame(0, 1, 0), ..EgoPose::default() };
        assert!(ego.validate().is_err());
        ego.world_from_vehicle = [0.0, -1.0, 0.0, 5.0, 1.0, 0.0, 0.0, 7.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0];
        assert_eq!(ego.validate(), Ok(()));
        let ahead = [[1.0, 0.0, 0.0, 1.0], [0.0, 1.0, 0.0, 0.0], [0.0, 0.0, 1.0, 1.5], [0.0, 0.0, 0.0, 1.0]];
        let pose = ego.world_from_camera(&ahead);
        assert_eq!([pose[0][3], pose[1][3], pose[2][3]], [5.0, 8.0, 1.5]);
        assert_eq!([pose[0][0], pose[1][0]], [0.0, 1.0]);
        ego.world_from_vehicle[0] = f64::NAN;
        assert!(ego.validate().is_err());
    }
}
