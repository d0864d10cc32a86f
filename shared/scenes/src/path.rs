//! Ways along straight segments, by their length.

use carff_base::geometry::OrientedBox;

/// Height of the strips that a way covers, metres: above every vehicle.
const STRIP_HEIGHT_M: f64 = 10.0;

/// A way of straight segments.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Path {
    /// Two or more points: x, y in metres. Points that follow each other differ.
    points: Vec<[f64; 2]>,
}

impl Path {
    /// Creates a way through points.
    pub fn new(points: Vec<[f64; 2]>) -> Self {
        Self { points }
    }

    /// Returns the way with its first and last segment extended.
    pub fn extended(mut self, by_m: f64) -> Self {
        let n = self.points.len();
        let beyond = |from: [f64; 2], to: [f64; 2]| {
            let [x, y] = direction(from, to);
            [to[0] + by_m * x, to[1] + by_m * y]
        };
        let (first, last) = (beyond(self.points[1], self.points[0]), beyond(self.points[n - 2], self.points[n - 1]));
        self.points.insert(0, first);
        self.points.push(last);
        self
    }

    /// Returns the length, metres.
    pub fn length_m(&self) -> f64 {
        self.segments().map(|[from, to]| length_m(from, to)).sum()
    }

    /// Returns x, y in metres and heading in radians, `at_m` metres from the start. Before the start and beyond the end,
    /// the way continues straight.
    pub fn at(&self, at_m: f64) -> [f64; 3] {
        let mut left_m = at_m;
        let last = self.points.len() - 2;
        for (i, [from, to]) in self.segments().enumerate() {
            let along_m = length_m(from, to);
            if left_m <= along_m || i == last {
                let [x, y] = direction(from, to);
                return [from[0] + left_m * x, from[1] + left_m * y, y.atan2(x)];
            }
            left_m -= along_m;
        }
        [0.0; 3]
    }

    /// Returns the heading of the segment that is nearest to a point, radians.
    pub fn heading_near(&self, [x, y]: [f64; 2]) -> f64 {
        let distance_m = |[from, to]: [[f64; 2]; 2]| {
            let [along_x, along_y] = direction(from, to);
            let along_m = ((x - from[0]) * along_x + (y - from[1]) * along_y).clamp(0.0, length_m(from, to));
            length_m([x, y], [from[0] + along_m * along_x, from[1] + along_m * along_y])
        };
        let nearest = self.segments().min_by(|a, b| distance_m(*a).total_cmp(&distance_m(*b)));
        nearest.map_or(0.0, |[from, to]| (to[1] - from[1]).atan2(to[0] - from[0]))
    }

    /// Returns the boxes that something of a width covers along the way.
    pub fn strips(&self, width_m: f64) -> Vec<OrientedBox> {
        let strip = |[from, to]: [[f64; 2]; 2]| {
            let [x, y] = direction(from, to);
            let center = [f64::midpoint(from[0], to[0]), f64::midpoint(from[1], to[1]), 0.0];
            OrientedBox {
                center,
                half_size: [length_m(from, to) / 2.0, width_m / 2.0, STRIP_HEIGHT_M],
                yaw: y.atan2(x),
            }
        };
        self.segments().map(strip).collect()
    }

    fn segments(&self) -> impl Iterator<Item = [[f64; 2]; 2]> + '_ {
        self.points.windows(2).map(|pair| [pair[0], pair[1]])
    }
}

fn length_m(from: [f64; 2], to: [f64; 2]) -> f64 {
    (to[0] - from[0]).hypot(to[1] - from[1])
}

fn direction(from: [f64; 2], to: [f64; 2]) -> [f64; 2] {
    let length_m = length_m(from, to).max(f64::MIN_POSITIVE);
    [(to[0] - from[0]) / length_m, (to[1] - from[1]) / length_m]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A place on a way has the heading of its segment; beyond the ends, the way continues straight.
    #[test]
    fn places_are_along_the_way() {
        let path = Path::new(vec![[0.0, 0.0], [3.0, 0.0], [3.0, 4.0]]);
        assert_eq!(path.length_m(), 7.0);
        assert_eq!(path.at(1.0), [1.0, 0.0, 0.0]);
        assert_eq!(path.at(5.0), [3.0, 2.0, std::f64::consts::FRAC_PI_2]);
        assert_eq!(path.at(-1.0), [-1.0, 0.0, 0.0]);
        assert_eq!(path.at(8.0), [3.0, 5.0, std::f64::consts::FRAC_PI_2]);
        assert_eq!((path.heading_near([1.0, 1.0]), path.heading_near([4.0, 3.0])), (0.0, std::f64::consts::FRAC_PI_2));
        let longer = path.extended(2.0);
        assert_eq!((longer.length_m(), longer.at(0.0)[0]), (11.0, -2.0));
    }
}
