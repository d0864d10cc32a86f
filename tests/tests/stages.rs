//! Tests of the decision path's four stages on the shipped checkpoint, with a test in place of the camera that also
//! publishes invalid messages.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_base::geometry::PinholeCamera;
use carff_messages::{
    Belief, DatasetView, Forecast, ForecastSource, FrameMeta, Gaussian, Header, Health, HealthState, Message,
    Posterior, Stage,
};
use carff_tests::{Process, TestGraph, eventually, shipped_checkpoint};
use carff_transport::{Node, Receiver, monotonic_now_ns, topics};
use rustix::process::Signal;
use std::path::Path;

const SIDE: u32 = 128;
const BYTES: usize = (SIDE * SIDE * 3) as usize;
const PATH: [Stage; 4] = [Stage::Controller, Stage::Prober, Stage::Forecaster, Stage::Encoder];

fn header(run_id: u64, frame_id: u64, step: u32) -> Header {
    Header { run_id, ..Header::of_frame(frame_id, monotonic_now_ns(), 1).at_step(step) }
}

fn frame(run_id: u64, frame_id: u64) -> FrameMeta {
    let camera = PinholeCamera::look_at([-8.0, -12.0, 9.0], [-8.0, -1.0, 0.0], [0.0, 0.0, 1.0], SIDE, SIDE, 60.0);
    FrameMeta { header: header(run_id, frame_id, 0), ..FrameMeta::of_camera(&camera, DatasetView::UNKNOWN) }
}

/// A NaN in a message of any topic, and an image of another size than its description, is dropped and counted by each
/// stage that reads the topic. No action is based on it, and valid messages are still decided on.
#[test]
fn rogue_messages_stop_at_the_next_stage() {
    // An image without detail is decided on like any other.
    let rest = "[checks]\ncamera = false\n[controller]\nrate_hz = 4.0\ndeadline_ms = 60000\n";
    let graph = TestGraph::new(Path::new("none"), &shipped_checkpoint(), rest);
    let run_id = graph.run().id();
    let node = Node::open(graph.run(), "test").unwrap();
    let mut frames = node.image_publisher(&topics::FRAME, BYTES).unwrap();
    let mut posteriors = node.publisher(&topics::POSTERIOR).unwrap();
    let mut forecasts = node.publisher(&topics::FORECAST).unwrap();
    let mut beliefs = node.publisher(&topics::BELIEF).unwrap();
    let mut actions = node.receiver(&topics::ACTION).unwrap();
    let mut healths: Vec<Receiver<Health>> =
        PATH.iter().map(|&stage| node.receiver(topics::health(stage)).unwrap()).collect();
    let processes: Vec<Process> = PATH.iter().map(|&stage| graph.stage(stage)).collect();
    let said = || processes.iter().map(Process::text).collect::<Vec<_>>().join("\n");

    let mut latest: [Option<Health>; PATH.len()] = [None; PATH.len()];
    let mut until = |what: &str, holds: &dyn Fn(Stage, &Health) -> bool| {
        let came = eventually(|| {
            for (slot, healths) in latest.iter_mut().zip(&mut healths) {
                if let Some(health) = healths.newest().unwrap() {
                    *slot = Some(*health);
                }
            }
            PATH.iter().zip(&latest).all(|(&stage, health)| health.is_some_and(|h| holds(stage, &h)))
        });
        assert!(came, "waited in vain until {what}:\n{latest:?}\n{}", said());
    };
    until("all are ready", &|_, health| health.state == HealthState::Ok.code());

    let mut blind = frame(run_id, 900);
    blind.intrinsics.fl_x_px = f64::NAN;
    frames.send_image_unchecked(frames.loan(BYTES).unwrap(), blind).unwrap();
    frames.send_image_unchecked(frames.loan(BYTES / 2).unwrap(), frame(run_id, 901)).unwrap();
    let mut posterior = Posterior {
        header: header(run_id, 902, 0),
        gaussian: Gaussian::standard(),
        take_start: 0,
        stage_latency_ns: 0,
    };
    posterior.gaussian.mean[5] = f32::NAN;
    posteriors.send_unchecked(posterior).unwrap();
    let mut forecast = Forecast::empty(header(run_id, 903, 1), ForecastSource::Observed, 2);
    (forecast.component_count, forecast.sample_count, forecast.weights[0]) = (1, 1, 1.0);
    forecast.samples[0][7] = f32::NAN;
    forecasts.send_unchecked(forecast).unwrap();
    let mut belief = Belief::empty(header(run_id, 904, 2), 2);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (6, 1, 1, 1);
    belief.component_weights[0] = 1.0;
    belief.hazard_probability = f32::NAN;
    beliefs.send_unchecked(belief).unwrap();
    // The forecaster reads beliefs too, and the prober frames.
    until("each has dropped the invalid messages", &|stage, health| {
        health.invalid
            == match stage {
                Stage::Encoder | Stage::Forecaster => 2,
                Stage::Prober => 3,
                _ => 1,
            }
    });

    let mut loan = frames.loan(BYTES).unwrap();
    loan.bytes_mut().fill(128);
    frames.send_image(loan, frame(run_id, 1)).unwrap();
    let mut based_on = Vec::new();
    let decided = eventually(|| {
        while let Some(action) = actions.next().unwrap() {
            assert!(action.validate().is_ok(), "{:?}", *action);
            based_on.push(action.based_on_frame);
        }
        based_on.contains(&1)
    });
    assert!(decided, "{}", said());
    assert!(
        based_on.iter().all(|frame| [1, u64::MAX].contains(frame)),
        "an action is based on a rogue message: {based_on:?}"
    );
    for process in processes {
        process.signal(Signal::TERM);
        process.end().assert_success();
    }
}
