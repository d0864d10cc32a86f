//! Looks from further on: what the shipped field would show from poses ahead of a vehicle.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::geometry::PinholeCamera;
use carff_decision::look_gain_bits;
use carff_messages::LATENT_DIM;
use carff_prober::load;
use carff_unknown::{Known, Sight};
use std::path::{Path, PathBuf};

fn checkpoint() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("../../configs/checkpoints/approaching-intersection")
}

/// From behind the corner, a truck at the second place and an empty road look the same, and a look gains nothing; from
/// the stop line they differ, and a look gains the whole bit. A camera that sees no lane shows nothing.
#[test]
fn what_is_hidden_is_seen_from_further_on() {
    let (probe, _) = load(&checkpoint()).unwrap();
    let lanes = Known::load(&checkpoint()).unwrap().unwrap().lanes;
    let states: Vec<[f32; LATENT_DIM]> = probe.states().iter().map(|state| state.mean).collect();
    let mut sight = Sight::default();
    let mut look = |at: [f64; 3], to: [f64; 3]| {
        let camera = PinholeCamera::look_at(at, to, [0.0, 0.0, 1.0], 128, 128, 60.0);
        let sees = sight.look(probe.field(), &states, &lanes, &camera, 1);
        (sees, sees && sight.alike(1, 4))
    };
    let (line, place) = ([1.8, -7.0, 2.0], [-10.1, -1.9, 0.9]);
    assert_eq!(look(line, place), (true, false), "from the stop line");
    assert_eq!(look([1.8, -16.2, 2.0], place), (true, true), "from behind the corner");
    assert!(!look([1.8, -16.2, 2.0], [1.8, -16.2, 50.0]).0, "at the sky");

    let hazards = probe.layout().hazard_states();
    let mut belief = vec![0.0; states.len()];
    (belief[1], belief[4]) = (0.5, 0.5);
    assert!(sight.look(
        probe.field(),
        &states,
        &lanes,
        &PinholeCamera::look_at(line, place, [0.0, 0.0, 1.0], 128, 128, 60.0),
        1
    ));
    assert!(look_gain_bits(&belief, hazards, |a, b| sight.alike(a, b)) > 0.99);
}
