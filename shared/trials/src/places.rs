//! Places that are probed, from the boxes of a scenario's states.

use crate::EvaluationError;
use carff_base::geometry::OrientedBox;
use carff_dataset::{NamedBox, ScenarioInfo};
use carff_decision::Place;
use carff_messages::{MAX_PLACES, MAX_STATES};

/// Share of a place from which a state that covers it occupies it: a probe finds something there.
const COVERED: f64 = 0.6;
/// Points along and across a place that are tested.
const COVERED_POINTS: [usize; 2] = [20, 5];

/// Places of a scenario: every distinct box of the states, and every candidate, with the states in which it is
/// occupied, by its own box or by one that covers most of it. Boxes that are the same in all states are left out. Where
/// there are too many places, boxes that are not dynamic are left out too.
///
/// Too many states are an error, and so are states without any distinguishing box: there would be nothing to probe.
pub fn places(scenario: &ScenarioInfo) -> Result<Vec<Place>, EvaluationError> {
    let states = scenario.state_count();
    if states > MAX_STATES {
        return Err(EvaluationError::Unfit(format!(
            "the scenario has {states} states (branches x timestamps); at most {MAX_STATES} are supported"
        )));
    }
    let of_states = scenario.states.iter().enumerate();
    let boxes = of_states.flat_map(|(state, info)| info.boxes.iter().map(move |b| (Some(state), b)));
    let all: Vec<_> = boxes.chain(scenario.candidates.iter().map(|c| (None, &c.named_box))).collect();
    let mut places = moved(all.iter().copied(), states);
    if places.len() > MAX_PLACES {
        places = moved(all.into_iter().filter(|(_, named)| named.dynamic), states);
    }
    for place in &mut places {
        for (taken, info) in place.occupied_in.iter_mut().zip(&scenario.states) {
            *taken |= info.boxes.iter().any(|named| covered(&place.oriented_box, &named.oriented_box) >= COVERED);
        }
    }
    match places.len() {
        0 => Err(EvaluationError::Unfit(
            "no box distinguishes the scenario's states, so there is nothing to probe: `scenario.states[].boxes` must \
             have the boxes of the dynamic objects of each state"
                .into(),
        )),
        1..=MAX_PLACES => Ok(places),
        many => Err(EvaluationError::Unfit(format!(
            "the scenario's dynamic boxes stand in {many} different places; at most {MAX_PLACES} can be probed"
        ))),
    }
}

/// Distinct places of some boxes in their order, without those that are occupied in all states or in none.
fn moved<'a>(boxes: impl Iterator<Item = (Option<usize>, &'a NamedBox)>, states: usize) -> Vec<Place> {
    let mut places: Vec<Place> = Vec::new();
    for (state, named) in boxes {
        let b = named.oriented_box;
        let near = |other: &Place| {
            let o = other.oriented_box;
            let distance: f64 = (0..3).map(|i| (o.center[i] - b.center[i]).powi(2)).sum();
            // Small objects move by small distances: the places of a hand are closer than those of a car.
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

/// Returns the share of a place that a box covers.
fn covered(place: &OrientedBox, by: &OrientedBox) -> f64 {
    let ([along, across], by) = (COVERED_POINTS, by.turned());
    let at = |i: usize, n: usize| (2 * i + 1) as f64 / n as f64 - 1.0;
    let points = (0..along).flat_map(|x| (0..across).map(move |y| [at(x, along), at(y, across), 0.0]));
    points.filter(|point| by.contains(place.point(*point))).count() as f64 / (along * across) as f64
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_dataset::StateInfo;

    fn named(name: &str, x_m: f64, dynamic: bool) -> NamedBox {
        let oriented_box = OrientedBox { center: [x_m, 0.0, 0.0], half_size: [2.0, 1.0, 1.0], yaw: 0.0 };
        NamedBox { name: name.into(), role: None, oriented_box, dynamic }
    }

    /// A scenario of two branches of `timestamps` states; the boxes of the first branch move.
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
            step_s: None,
            bev_view: None,
            states: (0..2 * timestamps).map(state).collect(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_from_timestamp: 0,
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        }
    }

    /// A place is a box with the states in which it is occupied; a static box is not a place.
    #[test]
    fn places_are_where_states_differ() {
        let found = places(&scenario(2, |t| vec![named("house", 5.0, false), named("truck", 3.0 * t as f64, true)]));
        let found: Vec<_> = found.unwrap().into_iter().map(|p| (p.name, p.occupied_in)).collect();
        let truck = |taken: [bool; 4]| ("truck".to_owned(), taken.to_vec());
        assert_eq!(found, [truck([true, false, true, true]), truck([false, true, false, false])]);
    }

    /// A state whose box covers most of another state's place occupies that place too: a probe finds something there.
    #[test]
    fn covered_places_are_occupied() {
        // The boxes are 4 m long.
        let occupied = |step_m: f64| -> Vec<Vec<bool>> {
            let found = places(&scenario(3, |t| vec![named("truck", step_m * t as f64, true)])).unwrap();
            found.into_iter().map(|place| place.occupied_in[..3].to_vec()).collect()
        };
        let apart = [[true, false, false], [false, true, false], [false, false, true]];
        let close = [[true, true, false], [true, true, true], [false, true, true]];
        assert_eq!(occupied(2.0), apart);
        assert_eq!(occupied(1.0), close);
    }

    /// With too many places, boxes that are not dynamic are left out. Still too many places, and too many states, are
    /// errors with the number.
    #[test]
    fn too_many_are_errors() {
        let both = |t: usize| vec![named("ego", 3.0 * t as f64, false), named("truck", 3.0 * t as f64, true)];
        assert_eq!(places(&scenario(24, both)).unwrap().len(), 48);
        let found = places(&scenario(32, |t| [both(t), vec![named("bus", 3.0 * t as f64, false)]].concat())).unwrap();
        assert!(found.len() == 32 && found.iter().all(|p| p.name == "truck"));
        let trucks = |t: usize| ["truck", "bus", "car"].map(|name| named(name, 3.0 * t as f64, true)).to_vec();
        let told = |info: &ScenarioInfo| places(info).unwrap_err().to_string();
        assert!(told(&scenario(32, trucks)).contains("96 different places; at most 48"));
        assert!(told(&scenario(33, both)).contains("66 states"));
    }

    /// Without boxes, or with boxes that are the same in all states, the error names the key.
    #[test]
    fn nothing_to_probe_is_an_error() {
        for boxes in [vec![named("house", 5.0, true)], Vec::new()] {
            let told = places(&scenario(2, |_| boxes.clone())).unwrap_err().to_string();
            assert!(told.contains("`scenario.states[].boxes`"), "{told}");
        }
    }
}
