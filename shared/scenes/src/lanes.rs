//! The roads of a scenario, and the vehicle that looks at them.

use crate::config::RoadConfig;
use crate::scenario::Scenario;
use carff_base::geometry::OrientedBox;

impl Scenario {
    /// Returns the roads as boxes on the ground, metres, world space.
    pub fn roads(&self) -> Vec<OrientedBox> {
        let road = |road: &RoadConfig| {
            let along = [road.to[0] - road.from[0], road.to[1] - road.from[1]];
            let [x, y] = [0, 1].map(|i| f64::midpoint(road.from[i], road.to[i]));
            OrientedBox {
                center: [x, y, 0.0],
                half_size: [along[0].hypot(along[1]) / 2.0, road.width_m / 2.0, 0.5],
                yaw: along[1].atan2(along[0]),
            }
        };
        self.config().road.iter().map(road).collect()
    }

    /// Returns the name of the vehicle with the role `ego`.
    pub fn ego_name(&self) -> Option<&str> {
        self.config().vehicle.iter().find(|v| v.role == "ego").map(|v| v.name.as_str())
    }

    /// Returns the length of the vehicle with the role `ego`, metres; `None` without one.
    pub fn ego_length_m(&self) -> Option<f64> {
        self.config().vehicle.iter().find(|v| v.role == "ego").map(|v| v.size_m[0])
    }
}
