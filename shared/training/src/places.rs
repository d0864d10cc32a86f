//! The boxes that are probed, out of what a scenario says stands where in each of its states.

use crate::TrainingError;
use carff_dataset::{NamedBox, ScenarioInfo};
use carff_decision::Place;
use carff_messages::{MAX_PLACES, MAX_STATES};

/// Every distinct box of the states, and every candidate, with the states in which it is taken. Boxes that no state
/// moves tell nothing and are left out; where there are too many, so are those that are not dynamic.
///
/// An error where states are too many, or where no box tells any of them apart: there would be nothing to probe.
pub fn places(scenario: &ScenarioInfo) -> Result<Vec<Place>, TrainingError> {
    let states = scenario.state_count();
    if states > MAX_STATES {
        return Err(TrainingError::Unfit(format!(
            "the scenario has {states} states (branches x timestamps); at most {MAX_STATES} can be told apart"
        )));
    }
    let of_states = scenario.states.iter().enumerate();
    let boxes = of_states.flat_map(|(state, info)| info.boxes.iter().map(move |b| (Some(state), b)));
    let all: Vec<_> = boxes.chain(scenario.candidates.iter().map(|c| (None, &c.named_box))).collect();
    let mut places = moved(all.iter().copied(), states);
    if places.len() > MAX_PLACES {
        places = moved(all.into_iter().filter(|(_, named)| named.dynamic), states);
    }
    match places.len() {
        0 => Err(TrainingError::Unfit(
            "no box tells the scenario's states apart, so there is nothing to probe: `scenario.states[].boxes` must say \
             where in each state what moves, comes or goes stands"
                .into(),
        )),
        1..=MAX_PLACES => Ok(places),
        many => Err(TrainingError::Unfit(format!(
            "the scenario's dynamic boxes stand in {many} different places; at most {MAX_PLACES} can be probed"
        ))),
    }
}

/// The distinct places of some boxes, in their order, but for those that are taken in every state or in none.
fn moved<'a>(boxes: impl Iterator<Item = (Option<usize>, &'a NamedBox)>, states: usize) -> Vec<Place> {
    let mut places: Vec<Place> = Vec::new();
    for (state, named) in boxes {
        let b = named.oriented_box;
        let near = |other: &Place| {
            let o = other.oriented_box;
            let distance: f64 = (0..3).map(|i| (o.center[i] - b.center[i]).powi(2)).sum();
            // What is small moves by little: a hand's places lie closer than a car's.
            let close = (0.2 * b.half_size.iter().map(|h| h * h).sum::<f64>().sqrt()).min(0.25);
            other.name == named.name && distance.sqrt() < close && (o.yaw - b.yaw).abs() < 0.1
        };
        let at = places.iter().position(near).unwrap_or_else(|| {
            places.push(Place { name: named.name.clone(), oriented_box: b, occupied_in: vec![false; states] });
            places.len() - 1
        });
        if let Some(state) = state {
            places[at].occupied_in[state] = true;
        }
    }
    places.retain(|p| p.occupied_in.contains(&true) && p.occupied_in.contains(&false));
    places
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_dataset::StateInfo;
    use carff_geometry::OrientedBox;

    fn named(name: &str, x_m: f64, dynamic: bool) -> NamedBox {
        let oriented_box = OrientedBox { center: [x_m, 0.0, 0.0], half_size: [2.0, 1.0, 1.0], yaw: 0.0 };
        NamedBox { name: name.into(), role: None, oriented_box, dynamic }
    }

    /// `timestamps` states of two branches, in the first of which `boxes` stand.
    fn scenario(timestamps: usize, boxes: impl Fn(usize) -> Vec<NamedBox>) -> ScenarioInfo {
        let state = |s: usize| {
            let (branch, timestamp) = (s / timestamps, s % timestamps);
            StateInfo { branch, timestamp, boxes: if branch == 0 { boxes(timestamp) } else { boxes(0) } }
        };
        ScenarioInfo {
            name: "small".into(),
            bounds: [[-9.0; 3], [9.0; 3]],
            branches: vec!["moves".into(), "stands".into()],
            timestamps,
            bev_view: None,
            states: (0..2 * timestamps).map(state).collect(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        }
    }

    /// A place is a box with the states in which it is taken; one that stands still tells nothing.
    #[test]
    fn places_are_where_states_differ() {
        let found = places(&scenario(2, |t| vec![named("house", 5.0, false), named("truck", 3.0 * t as f64, true)]));
        let found: Vec<_> = found.unwrap().into_iter().map(|p| (p.name, p.occupied_in)).collect();
        let truck = |taken: [bool; 4]| ("truck".to_owned(), taken.to_vec());
        assert_eq!(found, [truck([true, false, true, true]), truck([false, true, false, false])]);
    }

    /// With more places than there can be, what is not dynamic is left out; what is still too much is refused, as are too
    /// many states, each with the number.
    #[test]
    fn too_many_are_told() {
        let both = |t: usize| vec![named("ego", 3.0 * t as f64, false), named("truck", 3.0 * t as f64, true)];
        assert_eq!(places(&scenario(24, both)).unwrap().len(), 48);
        let found = places(&scenario(32, |t| [both(t), vec![named("bus", 3.0 * t as f64, false)]].concat())).unwrap();
        assert!(found.len() == 32 && found.iter().all(|p| p.name == "truck"));
        let trucks = |t: usize| ["truck", "bus", "car"].map(|name| named(name, 3.0 * t as f64, true)).to_vec();
        let told = |info: &ScenarioInfo| places(info).unwrap_err().to_string();
        assert!(told(&scenario(32, trucks)).contains("96 different places; at most 48"));
        assert!(told(&scenario(33, both)).contains("66 states"));
    }

    /// Boxes that are the same in every state, or none, leave nothing to probe: the error names the key.
    #[test]
    fn nothing_to_probe_is_told() {
        for boxes in [vec![named("house", 5.0, true)], Vec::new()] {
            let told = places(&scenario(2, |_| boxes.clone())).unwrap_err().to_string();
            assert!(told.contains("`scenario.states[].boxes`"), "{told}");
        }
    }
}
