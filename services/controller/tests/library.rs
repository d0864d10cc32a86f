//! The controller, fed with messages, makes the decisions of the decision library on the same steps.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::geometry::OrientedBox;
use carff_base::random::{Key, uniform};
use carff_controller::{Controller, Settings};
use carff_decision::{
    Approach, Draw, Evidence, Feedback, Mixture, Place, Policy, ProbeLayout, Probed, Reading, Resolved, Sampling,
    Speeds, Step, set_mixture_and_draws,
};
use carff_messages::{
    Action, ActionCode, Forecast, ForecastSource, Gaussian, Header, MAX_HORIZON, Message, Reason, Rule,
};

const STATES: usize = 6;
const MS: u64 = 1_000_000;

/// Returns uniform random numbers in [0, 1), named by the trial.
fn draws(trial: u64) -> impl FnMut() -> f32 {
    let mut sample = 0;
    move || {
        sample += 1;
        uniform(Key { seed: 77, frame: trial, step: 0, sample }) as f32
    }
}

fn layout() -> ProbeLayout {
    let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
    let occupied_in = (0..STATES).map(|s| s < 3).collect::<Vec<_>>();
    ProbeLayout::new(vec![Place { name: "actor".into(), oriented_box, occupied_in: occupied_in.clone() }], occupied_in)
        .unwrap()
}

/// Returns a random probed latent; `clear_share` of the latents show no hazard.
fn probed(next: &mut impl FnMut() -> f32, clear_share: f32) -> Probed {
    let hazard_likelihood = match next() {
        _ if next() < clear_share => 0.01 * next(),
        p if p < 0.5 => 0.5,
        p if p < 0.6 => 1.0 - 0.01 * next(),
        _ => next(),
    };
    let state = (next() > 0.005).then_some((next() * STATES as f32) as usize);
    let reading = Reading { state, confidence: next(), hazard_likelihood, state_probabilities: Vec::new() };
    Probed { occupancies: vec![next()], reading }
}

/// Returns random steps of one frame.
fn steps(next: &mut impl FnMut() -> f32) -> Vec<Step> {
    let horizon = 1 + (next() * MAX_HORIZON as f32) as u32;
    let samples = 1 + (next() * 64.0) as usize;
    let clear_share = if next() < 0.5 { 1.0 } else { next() };
    let mut path_probability = 1.0;
    (0..horizon)
        .map(|_| {
            let weight = next();
            let mixture = Mixture { weights: vec![weight, 1.0 - weight], components: vec![Gaussian::standard(); 2] };
            let draws: Vec<Draw> = mixture.draw(samples, Sampling::Stratified, 1, 0, 1);
            let unknown_probability = if next() < 0.9 { 0.0 } else { next() };
            let step = Step {
                components: (0..2).map(|_| probed(next, clear_share)).collect(),
                samples: (0..samples).map(|_| probed(next, clear_share)).collect(),
                resolved: Resolved {
                    state_probabilities: vec![(1.0 - unknown_probability) / STATES as f32; STATES],
                    unknown_probability,
                    hazard_probability: if next() < 0.3 { 0.3 } else { next() },
                    state: 2,
                },
                path_probability,
                mixture,
                draws,
            };
            path_probability *= next();
            step
        })
        .collect()
}

/// Sends the steps of one frame through messages and a controller, and returns its action.
fn act(policy: Policy, layout: &ProbeLayout, steps: &[Step], feedback: Feedback) -> Action {
    let mut controller = Controller::new(Settings {
        policy,
        deadline_ns: 150 * MS,
        period_ns: 50 * MS,
        seed: 1,
        approach: Approach::Stop,
        speeds: Speeds { advance_mps: 5.0, creep_mps: 1.5, others_mps: 0.0 },
    });
    let mut action = None;
    for (k, step) in steps.iter().enumerate() {
        let header = Header::of_frame(1, 100 * MS, 1).at_step(k as u32 + 1);
        let mut forecast = Forecast::empty(header, ForecastSource::Observed, steps.len() as u32);
        forecast.path_probability = step.path_probability;
        set_mixture_and_draws(&mut forecast, &step.mixture, &step.draws);
        forecast.validate().unwrap();
        let belief = step.to_belief(&forecast, layout, Some(&Gaussian::standard()), feedback);
        belief.validate().unwrap();
        action = controller.on_belief(&belief, 110 * MS);
    }
    action.unwrap()
}

/// For 2000 random frames and every rule, action, confidence, hazard probability and number of samples are equal.
#[test]
fn controller_and_library_agree() {
    let layout = layout();
    let mut halts = [0; Rule::ALL.len()];
    for trial in 0..2000 {
        let steps = steps(&mut draws(trial));
        let evidence = Evidence::of_steps(&steps);
        let ignores_unknown = trial % 4 == 0;
        for (policy, halts) in Policy::all(0.3).into_iter().zip(&mut halts) {
            let policy = Policy { ignores_unknown, ..policy };
            let decision = policy.decide(&evidence);
            let feedback = if trial % 3 == 0 { Feedback::Latent } else { Feedback::State };
            let action = act(policy, &layout, &steps, feedback);
            let code = if decision.halt { ActionCode::Halt } else { ActionCode::Advance };
            assert_eq!((action.code(), action.reason()), (Ok(code), Ok(Reason::Belief)), "{policy:?} {steps:?}");
            assert_eq!(action.confidence, decision.confidence as f32);
            assert_eq!(action.hazard_probability, evidence.hazard_probability() as f32);
            assert_eq!(action.sample_count as usize, evidence.sample_count());
            *halts += usize::from(decision.halt);
        }
    }
    // Both actions occur, so that the comparison is meaningful.
    let [under, over, paper, calibrated] = halts;
    assert_eq!((under, over), (2000, 0));
    assert!((200..1990).contains(&paper) && (200..1800).contains(&calibrated), "{halts:?}");
}

/// A step is converted to messages and back; only the probabilities of single samples are lost.
#[test]
fn steps_round_trip_through_messages() {
    let layout = layout();
    for trial in 0..200 {
        let steps = steps(&mut draws(trial));
        let step = &steps[0];
        let header = Header::of_frame(1, 100 * MS, 1).at_step(1);
        let mut forecast = Forecast::empty(header, ForecastSource::Observed, steps.len() as u32);
        set_mixture_and_draws(&mut forecast, &step.mixture, &step.draws);
        let belief = step.to_belief(&forecast, &layout, Some(&Gaussian::standard()), Feedback::Latent);
        assert_eq!(&Step::of_messages(&forecast, &belief), step);
    }
}
