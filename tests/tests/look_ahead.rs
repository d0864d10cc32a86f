//! Test of the autoregressive loop: the arithmetic of forecaster and prober against the library's look-ahead.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_checkpoint::Manifest;
use carff_config::GraphConfig;
use carff_decision::{Feedback, Plan, Step, look_ahead};
use carff_forecaster::Forecaster;
use carff_inference::MixtureNet;
use carff_messages::{Belief, Forecast, Gaussian, Header, Message, Posterior};
use carff_tests::{TestGraph, shipped_checkpoint};
use std::path::Path;

const HORIZON: u32 = 4;

/// For both kinds of feedback and both kinds of sampling, the messages of the two stages carry the library's steps, bit
/// for bit. Where samples are fed back, each step holds the whole distribution, and sample i follows sample i.
#[test]
fn stages_and_library_look_ahead_alike() {
    let checkpoint = shipped_checkpoint();
    let manifest = Manifest::load(&checkpoint).unwrap();
    let net = MixtureNet::load(&checkpoint, &manifest).unwrap();
    let (mut probe, _) = carff_prober::load(&checkpoint).unwrap();
    for feedback in ["state", "latent"] {
        for sampling in ["stratified", "independent"] {
            let rest = format!("horizon = {HORIZON}\nfeedback = \"{feedback}\"\nsampling = \"{sampling}\"\n");
            let graph = TestGraph::new(Path::new("none"), &checkpoint, &rest);
            let run = GraphConfig::load(&graph.file()).unwrap();
            let forecaster = Forecaster::load(&checkpoint, &run).unwrap();
            let run = run.run;
            for (frame, state) in manifest.states.iter().enumerate() {
                // Between two states, so that the forecast is a mixture of both.
                let other = manifest.states[(frame + 1) % manifest.states.len()];
                let mean = std::array::from_fn(|i| 0.5 * (state.mean[i] + other.mean[i]));
                let gaussian = Gaussian { mean, log_variance: state.log_variance };
                let header = Header::of_frame(frame as u64, 1, 7);
                let posterior = Posterior { header, gaussian, take_start: 0, stage_latency_ns: 0 };
                let (samples, horizon) = (run.samples as usize, run.horizon);
                let plan = Plan {
                    samples,
                    sampling: run.sampling,
                    feedback: run.feedback,
                    horizon,
                    seed: 7,
                    frame: frame as u64,
                };
                let steps = look_ahead(|input, _| net.forecast(input), &mut probe, &gaussian, None, plan);
                assert_eq!(steps.len(), HORIZON as usize);
                let mut forecast = Some(forecaster.from_observation(&posterior));
                for step in &steps {
                    let answered = forecast.take().unwrap();
                    answered.validate().unwrap();
                    let belief = carff_prober::believe(&mut probe, &answered, None, run.feedback);
                    belief.validate().unwrap();
                    check(step, &answered, &belief, run.feedback);
                    forecast = forecaster.from_feedback(&belief);
                }
                assert!(forecast.is_none(), "the last belief is fed back");
            }
        }
    }
}

/// The largest latents that a message may carry give valid messages again: no stage ends because of its input.
#[test]
fn the_largest_latents_are_answered() {
    const LARGEST: f32 = 1e4;
    let checkpoint = shipped_checkpoint();
    let (mut probe, _) = carff_prober::load(&checkpoint).unwrap();
    let graph = TestGraph::new(Path::new("none"), &checkpoint, "horizon = 2\n");
    let run = GraphConfig::load(&graph.file()).unwrap();
    let forecaster = Forecaster::load(&checkpoint, &run).unwrap();
    for signs in 0..=u8::MAX {
        let latent: [f32; 8] = std::array::from_fn(|i| if signs >> i & 1 == 1 { LARGEST } else { -LARGEST });
        for log_variance in [-30.0, 30.0] {
            let gaussian = Gaussian { mean: latent, log_variance: [log_variance; 8] };
            let header = Header::of_frame(signs.into(), 1, 7);
            let posterior = Posterior { header, gaussian, take_start: 0, stage_latency_ns: 0 };
            posterior.validate().unwrap();
            let mut forecast = forecaster.from_observation(&posterior);
            forecast.validate().unwrap();
            forecast.samples = [latent; carff_messages::MAX_SAMPLES];
            forecast.components = [gaussian; carff_messages::MAX_COMPONENTS];
            forecast.validate().unwrap();
            for feedback in [Feedback::State, Feedback::Latent] {
                let belief = carff_prober::believe(&mut probe, &forecast, None, feedback);
                belief.validate().unwrap();
                forecaster.from_feedback(&belief).unwrap().validate().unwrap();
            }
        }
    }
}

fn check(step: &Step, forecast: &Forecast, belief: &Belief, feedback: Feedback) {
    let found = Step::of_messages(forecast, belief);
    assert_eq!((&found.mixture, &found.draws), (&step.mixture, &step.draws));
    assert_eq!(found.path_probability, step.path_probability);
    assert_eq!(found.resolved, step.resolved);
    let count = if feedback == Feedback::Latent && !belief.is_final() { step.draws.len() } else { 0 };
    assert_eq!(belief.fed_back().len(), count);
    if feedback == Feedback::Latent {
        assert_eq!(step.path_probability, 1.0, "later steps do not rest on one state");
        assert!(belief.fed_back().iter().zip(&step.draws).all(|(input, draw)| input.mean == draw.latent));
    }
}
