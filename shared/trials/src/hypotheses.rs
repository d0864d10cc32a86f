//! Hypotheses: names of the known states, groups of samples, and the camera that shows them.

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Dataset, ScenarioInfo};
use carff_decision::Place;
use carff_field::Field;
use std::collections::BTreeSet;

/// Longest side of a rendered hypothesis, pixels.
const MOST_PX: u32 = 256;
/// Side of a rendered hypothesis where the dataset has no camera from above, pixels.
const OWN_CAMERA_PX: u32 = 128;

/// Names of the known states: the dynamic actors present, and the time step if the places make it unambiguous.
pub fn state_names(scenario: &ScenarioInfo, places: &[Place]) -> Vec<String> {
    let boxes = scenario.states.iter().flat_map(|s| &s.boxes).chain(scenario.candidates.iter().map(|c| &c.named_box));
    let coming: BTreeSet<&str> = boxes.filter(|b| b.dynamic).map(|b| b.name.as_str()).collect();
    let taken = |state: usize| places.iter().map(move |p| p.occupied_in.get(state).copied().unwrap_or(false));
    let name = |state: usize| {
        let there: Vec<&str> = places
            .iter()
            .zip(taken(state))
            .filter(|(place, taken)| *taken && coming.contains(place.name.as_str()))
            .map(|(place, _)| place.name.as_str())
            .collect();
        let who = if there.is_empty() { "no actor".to_owned() } else { there.join(" and ") };
        let unambiguous = (0..scenario.state_count()).all(|other| other == state || !taken(other).eq(taken(state)));
        if unambiguous { format!("{who}, t{}", scenario.timestamp_of(state)) } else { who }
    };
    (0..scenario.state_count()).map(name).collect()
}

/// Samples that show the same state.
#[derive(Debug, PartialEq)]
pub struct Hypothesis {
    /// Name of the state.
    pub name: String,
    /// Number of samples.
    pub count: usize,
    /// Index of the first sample.
    pub sample: usize,
}

/// Groups samples by their state, the largest group first. Equally large groups keep the order of their first samples.
pub fn hypotheses(names: impl IntoIterator<Item = String>) -> Vec<Hypothesis> {
    let mut groups: Vec<Hypothesis> = Vec::new();
    for (sample, name) in names.into_iter().enumerate() {
        match groups.iter_mut().find(|g| g.name == name) {
            Some(group) => group.count += 1,
            None => groups.push(Hypothesis { name, count: 1, sample }),
        }
    }
    groups.sort_by_key(|g| std::cmp::Reverse(g.count));
    groups
}

/// Camera from above: that of the dataset, or else one above the field.
pub fn birds_eye_camera(dataset: &Dataset, field: &Field) -> PinholeCamera {
    let of_set = dataset.scenario().and_then(|s| s.bev_view).and_then(|view| {
        let frame = dataset.frames().iter().find(|f| f.view == Some(view))?;
        Some(limited(&frame.camera))
    });
    of_set.unwrap_or_else(|| camera_above(field))
}

/// Camera that looks straight down on a field; up in the image is +Y.
fn camera_above(field: &Field) -> PinholeCamera {
    let bounds_m = field.config().bounds_m.map(|corner| corner.map(f64::from));
    PinholeCamera::above(bounds_m, OWN_CAMERA_PX, OWN_CAMERA_PX)
}

/// The same camera with no side longer than [`MOST_PX`].
fn limited(camera: &PinholeCamera) -> PinholeCamera {
    let longest = camera.width_px.max(camera.height_px);
    if longest <= MOST_PX {
        return *camera;
    }
    let shorter = |side: u32| (u64::from(side) * u64::from(MOST_PX) / u64::from(longest)).max(1) as u32;
    camera.resized(shorter(camera.width_px), shorter(camera.height_px))
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_base::geometry::OrientedBox;
    use carff_dataset::{NamedBox, StateInfo};

    /// Samples are grouped by their state, the largest group first, each with its first sample.
    #[test]
    fn samples_are_grouped() {
        let groups = hypotheses(["b", "a", "c", "a", "c"].map(str::to_owned));
        let found: Vec<_> = groups.iter().map(|g| (g.name.as_str(), g.count, g.sample)).collect();
        assert_eq!(found, [("a", 2, 1), ("c", 2, 2), ("b", 1, 0)]);
    }

    /// States are named by their dynamic actors, without the ego vehicle, and by the time where the places determine
    /// it.
    #[test]
    fn states_have_names() {
        let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
        let named = |name: &str, dynamic| NamedBox { name: name.into(), role: None, oriented_box, dynamic };
        let state = |s: usize| StateInfo {
            branch: s / 2,
            timestamp: s % 2,
            boxes: if s < 2 { vec![named("ego", false), named("truck", true)] } else { vec![named("ego", false)] },
        };
        let scenario = ScenarioInfo {
            name: "crossing".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["truck".into(), "nothing".into()],
            timestamps: 2,
            step_s: None,
            bev_view: None,
            states: (0..4).map(state).collect(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        let place = |name: &str, taken: [bool; 4]| Place { name: name.into(), oriented_box, occupied_in: taken.into() };
        let truck = [place("truck", [true, false, false, false]), place("truck", [false, true, false, false])];
        assert_eq!(state_names(&scenario, &truck), ["truck, t0", "truck, t1", "no actor", "no actor"]);
        let mut all = truck.to_vec();
        all.push(place("ego", [true, false, true, false]));
        assert_eq!(state_names(&scenario, &all), ["truck, t0", "truck, t1", "no actor, t0", "no actor, t1"]);
    }

    /// A camera too large for a filmstrip is scaled down with the same field of view; a small one is unchanged.
    #[test]
    fn large_cameras_are_limited() {
        let camera = PinholeCamera::look_at([0.0, 0.0, 9.0], [0.0; 3], [0.0, 1.0, 0.0], 1024, 512, 60.0);
        let small = limited(&camera);
        assert_eq!((small.width_px, small.height_px), (256, 128));
        let (a, b) = (camera.project([1.0, 2.0, 0.0]).unwrap().0, small.project([1.0, 2.0, 0.0]).unwrap().0);
        assert!((a[0] / 4.0 - b[0]).abs() < 1e-9 && (a[1] / 4.0 - b[1]).abs() < 1e-9);
        assert_eq!(limited(&small), small);
    }

    /// The replacement of the dataset's camera sees the whole ground of the field, +Y up.
    #[test]
    fn camera_above_sees_the_ground() {
        let bounds_m = [[-17.0, -19.0, 0.5], [5.0, 7.0, 5.0]];
        let small = carff_field::FieldConfig { bounds_m, levels: 2, log2_table_size: 8, ..Default::default() };
        let camera = camera_above(&Field::new(small, 1).unwrap());
        let at = |x, y| camera.project([x, y, 0.5]).unwrap().0;
        for (x, y) in [(-17.0, -19.0), (5.0, -19.0), (-17.0, 7.0), (5.0, 7.0)] {
            assert!(at(x, y).iter().all(|v| (-1e-6..=128.0 + 1e-6).contains(v)), "{x} {y}: {:?}", at(x, y));
        }
        assert!(at(0.0, 7.0)[1] < at(0.0, -19.0)[1] && at(-17.0, 0.0)[0] < at(5.0, 0.0)[0]);
    }
}
