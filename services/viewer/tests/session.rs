//! Tests of the session on the shipped checkpoint, without a window.

use crate::common;

use crate::common::{ABOVE_VIEW, HIDING_VIEW, copy_without, image, models, scenario};
use carff_dataset::Image;
use carff_decision::{Evidence, Feedback, Plan, Sampling, Step, look_ahead};
use carff_messages::ActionCode;
use carff_scenes::{Detail, Extras};
use carff_viewer::input::{Album, ChosenImage};
use carff_viewer::models::SessionModels;
use carff_viewer::session::{Moment, Selection, Session, SessionError, SessionSettings};
use std::ops::ControlFlow;

fn session() -> Session {
    Session::new(models())
}

/// Toggling an unambiguous image shows a scene in which probing finds the true actor.
#[test]
fn toggle_shows_what_the_image_shows() {
    let mut session = session();
    for (branch, timestamp) in [(0, 1), (1, 1)] {
        session.toggle(image(branch, timestamp, ABOVE_VIEW)).unwrap();
        session.probe().unwrap();
        let found = session.moment().unwrap().found.as_ref().unwrap();
        let state = session.models().state(branch, timestamp).unwrap();
        assert_eq!(found.probed.reading.state, Some(state));
        let prober = session.models().probe.layout();
        for (place, occupancy) in prober.places().iter().zip(&found.probed.occupancies) {
            assert_eq!(place.occupied_in[state], *occupancy > 0.5, "{} {occupancy}", place.name);
        }
        assert_eq!(found.densities.len(), prober.points().len());
        assert_eq!(session.shown().unwrap().latent, session.moment().unwrap().source.mean);
    }
}

/// Predicting, probing and continuing by the belief's most probable state computes the same as the stages, bit for bit.
/// The recorded decisions use these steps.
#[test]
fn follows_the_stages_path() {
    let mut session = session();
    let settings = SessionSettings { samples: 7, horizon: 3, seed: 5, ..session.settings() };
    session.set_settings(settings);
    let input = image(0, 0, HIDING_VIEW);
    let (sampling, feedback, frame) = (Sampling::Stratified, Feedback::State, HIDING_VIEW as u64);
    let plan = Plan { samples: 7, sampling, feedback, horizon: 3, seed: 5, frame };
    session.toggle(input).unwrap();
    let posterior = session.moment().unwrap().source;
    let mut probe = session.models().probe.clone();
    let net = session.models().mixture.as_ref().unwrap();
    let wanted = look_ahead(|input, _| net.forecast(input), &mut probe, &posterior, None, plan);
    session.predict().unwrap();
    for step in &wanted {
        session.probe().unwrap();
        assert_eq!(session.moment().unwrap().belief.as_ref(), Some(step));
        session.select(Selection::State(step.resolved.state)).unwrap();
        assert_eq!(session.moment().unwrap().found.as_ref().unwrap().probed.reading.state, Some(step.resolved.state));
        if session.can_advance().is_ok() {
            session.probe_and_predict().unwrap();
            let moment = session.moment().unwrap();
            assert_eq!(Some(&moment.source), probe.state_posterior(step.resolved.state));
            assert_eq!(moment.source_state, Some(step.resolved.state));
        }
    }
    let steps: Vec<Step> = session.moment().unwrap().steps().cloned().collect();
    assert_eq!(steps, wanted);
    let last = session.journal.decisions().next_back().unwrap();
    assert_eq!(last.action == ActionCode::Halt, session.models().policy.decide(&Evidence::of_steps(&wanted)).halt);
    assert_eq!(session.journal.decisions().len(), 3);
}

/// Continuing follows the shown scene's state, not the most probable one; the path's probability is that state's.
#[test]
fn goes_on_from_the_shown_scene() {
    let mut session = session();
    session.toggle(image(0, 0, HIDING_VIEW)).unwrap();
    session.predict().unwrap();
    session.probe().unwrap();
    let belief = session.moment().unwrap().belief.clone().unwrap();
    let other = (0..belief.samples.len())
        .find(|&i| belief.samples[i].reading.state.is_some_and(|s| s != belief.resolved.state))
        .expect("a view that hides the place is ambiguous");
    session.select(Selection::Sample(other)).unwrap();
    assert_eq!(session.shown().unwrap().latent, belief.draws[other].latent);
    assert_eq!(session.moment().unwrap().found.as_ref().unwrap().probed, belief.samples[other]);
    let state = belief.samples[other].reading.state.unwrap();
    session.probe_and_predict().unwrap();
    let moment = session.moment().unwrap();
    assert_eq!((moment.step, moment.source_state), (2, Some(state)));
    assert_eq!(moment.path_probability, belief.resolved.state_probabilities[state]);
    assert!(moment.belief.is_none() && moment.found.is_none());
}

/// Back and forward restore the entry with its chosen scene. The horizon limits the path, and a longer horizon extends
/// it.
#[test]
fn history_and_horizon() {
    let mut session = session();
    assert_eq!(session.settings().horizon, 2);
    session.toggle(image(0, 1, HIDING_VIEW)).unwrap();
    session.predict().unwrap();
    session.select(Selection::Sample(4)).unwrap();
    let first = session.shown().unwrap();
    session.probe_and_predict().unwrap();
    assert_eq!(session.can_advance(), Err(SessionError::Horizon { step: 2 }));
    assert_eq!(session.probe_and_predict(), Err(SessionError::Horizon { step: 2 }));
    assert!(session.back());
    assert_eq!((session.shown().unwrap().latent, session.shown().unwrap().selection), (first.latent, first.selection));
    assert!(session.moment().unwrap().belief.is_some(), "a probed step stays probed");
    assert!(session.back() && !session.back());
    assert_eq!(session.moment().unwrap().step, 0);
    assert!(session.forward() && session.forward() && !session.forward());
    session.set_settings(SessionSettings { horizon: 3, ..session.settings() });
    session.probe_and_predict().unwrap();
    assert_eq!(session.moment().unwrap().step, 3);
    assert_eq!(session.history().entries().len(), 4);
}

/// Predicting again draws again in place: equal latents for the same seed, others for another seed, in the requested
/// number.
#[test]
fn predicting_again_draws_again() {
    let mut session = session();
    session.toggle(image(1, 0, HIDING_VIEW)).unwrap();
    let draws = |session: &mut Session, settings: SessionSettings| {
        session.set_settings(settings);
        session.predict().unwrap();
        session.moment().unwrap().forecast.clone().unwrap()
    };
    let settings = session.settings();
    let first = draws(&mut session, settings);
    assert_eq!(first, draws(&mut session, settings));
    let other = draws(&mut session, SessionSettings { seed: 2, ..settings });
    assert!(other.mixture == first.mixture && other.draws != first.draws);
    assert_eq!(draws(&mut session, SessionSettings { samples: 1000, ..settings }).draws.len(), 64);
    assert_eq!((session.history().entries().len(), session.scenes().len()), (2, 1 + first.mixture.weights.len() + 64));
}

/// An impossible command returns an error with a remedy, and changes nothing.
#[test]
fn errors_say_what_to_do() {
    let mut session = session();
    assert_eq!(session.predict(), Err(SessionError::NoInput));
    assert_eq!(session.probe(), Err(SessionError::NoInput));
    assert!(session.shown().is_none() && session.scenes().is_empty());
    let broken = Image { width_px: 4, height_px: 4, rgb: vec![0; 5] };
    let error = session.toggle(ChosenImage::of_image("broken.png", broken)).unwrap_err();
    assert!(error.to_string().contains("broken.png"), "{error}");
    session.toggle(image(0, 0, ABOVE_VIEW)).unwrap();
    assert_eq!(session.select(Selection::Sample(0)), Err(SessionError::NoScene));
    assert_eq!(session.select(Selection::State(99)), Err(SessionError::NoScene));
    assert_eq!(session.moment().unwrap().selection, Selection::Source);
}

/// A checkpoint without a forecaster still toggles and probes; forecasting reports how to train the missing part.
#[test]
fn a_checkpoint_without_forecaster_toggles() {
    let folder = copy_without(&["mixture.safetensors"]);
    let mut session = Session::new(SessionModels::load(folder.path(), 1).unwrap());
    session.toggle(image(0, 0, ABOVE_VIEW)).unwrap();
    session.probe().unwrap();
    let error = session.predict().unwrap_err();
    assert!(error.to_string().contains("carff train --phase mdn"), "{error}");
}

/// A newer frame of the graph replaces the shown one: the step and a chosen sample stay in view. Scenes are marked as
/// far as the graph's belief is known.
#[test]
fn follows_a_running_graph() {
    let mut other = session();
    let mut moments = |view: usize| -> Vec<Moment> {
        other.toggle(image(0, 0, view)).unwrap();
        let first = other.moment().unwrap().clone();
        other.predict().unwrap();
        other.probe().unwrap();
        vec![first, other.moment().unwrap().clone()]
    };
    let (older, newer) = (moments(HIDING_VIEW), moments(ABOVE_VIEW));
    let mut session = session();
    session.follow(older);
    assert_eq!(session.moment().unwrap().step, 1, "the first forecast is shown first");
    session.select(Selection::Sample(3)).unwrap();
    session.follow(newer.clone());
    let moment = session.moment().unwrap();
    assert_eq!((moment.step, moment.selection), (1, Selection::Sample(3)));
    assert_eq!(moment.found.as_ref().unwrap().probed, newer[1].belief.as_ref().unwrap().samples[3]);
    assert_eq!(session.history().entries().len(), 2);

    // Without a choice, a component stays while its weight is at least half of the largest weight.
    let weighed = |weights: [f32; 4]| {
        let mut moments = newer.clone();
        moments[1].forecast.as_mut().unwrap().mixture.weights = weights.to_vec();
        let forecast = moments[1].forecast.clone().unwrap();
        let belief = moments[1].belief.take();
        moments[1] = Moment { belief, ..Moment::of_forecast(&moments[0], 1, forecast) };
        moments
    };
    let mut session = Session::new(models());
    for (weights, wanted) in
        [([0.5, 0.4, 0.1, 0.0], 0), ([0.4, 0.5, 0.1, 0.0], 0), ([0.2, 0.7, 0.1, 0.0], 1), ([0.6, 0.4, 0.0, 0.0], 1)]
    {
        session.follow(weighed(weights));
        assert_eq!(session.moment().unwrap().selection, Selection::Component(wanted), "{weights:?}");
    }
}

/// Images are found by state and view, and browsing skips views with another visibility. A dataset of another scenario
/// is refused with the key that differs.
#[test]
fn albums_are_leafed_through() {
    let folder = copy_without(&["manifest.json"]);
    let manifest = std::fs::read_to_string(common::checkpoint().join("manifest.json")).unwrap();
    let of_two = manifest.replacen("\"poses\": 100", "\"poses\": 2", 1);
    std::fs::write(folder.path().join("manifest.json"), of_two).unwrap();
    let models = SessionModels::load(folder.path(), 1).unwrap();
    let set = tempfile::tempdir().unwrap();
    let scenario = scenario().with_free_cameras(2, 3).unwrap();
    scenario.render_dataset(set.path(), Extras::default(), |_, _| ControlFlow::Continue(())).unwrap();
    let album = Album::open(set.path(), &models).unwrap();
    assert_eq!((album.view_count(), album.steps()), (2, 3));
    let input = album.input(4, 1, &models).unwrap().unwrap();
    let truth = input.truth.unwrap();
    assert_eq!((truth.branch, truth.timestamp, truth.view), (1, 1, 1));
    assert_eq!(input.image, scenario.render(1, 1, &input.camera.unwrap(), Detail::default()).unwrap().image);
    assert!(album.input(4, 2, &models).unwrap().is_none() && album.input(6, 0, &models).unwrap().is_none());
    assert_eq!([album.next_view(0, 0, true, None), album.next_view(0, 0, false, None)], [Some(1), Some(1)]);
    for view in 0..2 {
        let shows = album.observability(0, view);
        let next = album.next_view(0, 1 - view, true, shows).unwrap();
        assert_eq!(album.observability(0, next), shows);
    }
    let error = Album::open(set.path(), &common::models()).unwrap_err();
    assert!(error.to_string().contains("scenario.poses"), "{error}");
}
