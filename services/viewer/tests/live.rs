//! Tests of watching a running graph: its messages become moments, and its end is noticed.

use carff_messages::{
    Action, ActionCode, Belief, DatasetView, Forecast, ForecastSource, FrameMeta, Gaussian, Header, Intrinsics,
    Posterior, Reason, Rule,
};
use carff_observe::{RunLock, RunRecord};
use carff_transport::{Node, Run, monotonic_now_ns, remove_run_leftovers, runtime_dir, topics};
use carff_viewer::live::LiveFeed;
use std::time::{Duration, Instant};

/// Longest wait. It only bounds a test that hangs.
const PATIENCE: Duration = Duration::from_mins(1);

fn wait_for<T>(mut look: impl FnMut() -> Option<T>) -> T {
    let since = Instant::now();
    loop {
        if let Some(found) = look() {
            return found;
        }
        assert!(since.elapsed() < PATIENCE, "no news arrives");
        std::thread::sleep(Duration::from_millis(5));
    }
}

/// A frame with its posterior, forecast, belief and action becomes two moments and a decision. A missing run is refused
/// by name. When the run's record disappears, the window reports the end of the run.
#[test]
fn watches_a_run_from_frame_to_decision() {
    let name = format!("viewer-{}", std::process::id());
    let error = LiveFeed::attach(Some(name.clone()), || ()).err().unwrap();
    assert!(error.to_string().contains(&format!("no run `{name}` is alive")), "{error}");

    let run = Run::new(&name, 17).unwrap();
    let node = Node::open(&run, "test").unwrap();
    let record = RunRecord {
        pid: std::process::id(),
        run_id: 17,
        graph: "graph.toml".into(),
        dataset: "set".into(),
        checkpoint: "checkpoint".into(),
        started_unix_s: 1,
    };
    let lock = RunLock::take(&runtime_dir(), &name, &record, "--run").unwrap();
    let mut frames = node.image_publisher(&topics::FRAME, 12).unwrap();
    let mut posteriors = node.publisher(&topics::POSTERIOR).unwrap();
    let mut forecasts = node.publisher(&topics::FORECAST).unwrap();
    let mut beliefs = node.publisher(&topics::BELIEF).unwrap();
    let mut actions = node.publisher(&topics::ACTION).unwrap();
    let feed = LiveFeed::attach(Some(name.clone()), || ()).unwrap();
    assert_eq!(feed.watched().run.checkpoint, std::path::Path::new("checkpoint"));

    let header = Header::of_frame(4, monotonic_now_ns(), 9);
    let mut world_from_camera = [0.0; 16];
    for i in 0..4 {
        world_from_camera[5 * i] = 1.0;
    }
    let meta = FrameMeta {
        header,
        width_px: 2,
        height_px: 2,
        intrinsics: Intrinsics { fl_x_px: 2.0, fl_y_px: 2.0, cx_px: 1.0, cy_px: 1.0 },
        world_from_camera,
        dataset_view: DatasetView::UNKNOWN,
        take_start: 0,
    };
    let mut loan = frames.loan(12).unwrap();
    loan.bytes_mut().copy_from_slice(&[7; 12]);
    frames.send_image(loan, meta).unwrap();
    // As in a graph: each message follows the one that it depends on.
    wait_for(|| (feed.watched().frames == 5).then_some(()));
    posteriors
        .send(Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 3_000_000 })
        .unwrap();
    let mut forecast = Forecast::empty(header.at_step(1), ForecastSource::Observed, 1);
    (forecast.component_count, forecast.sample_count) = (1, 2);
    forecast.weights[0] = 1.0;
    forecast.samples[1] = [0.5; 8];
    forecasts.send(forecast).unwrap();
    let mut belief = Belief::empty(header.at_step(1), 1);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (2, 1, 1, 2);
    belief.component_weights[0] = 1.0;
    belief.state_probability[..2].copy_from_slice(&[0.25, 0.75]);
    belief.resolved_state = 1;
    beliefs.send(belief).unwrap();
    let moments = wait_for(|| feed.take_newest());
    assert_eq!(moments.iter().map(|m| m.step).collect::<Vec<_>>(), [0, 1]);
    assert_eq!(
        (moments[1].input.image.rgb.as_slice(), moments[1].input.title.as_str()),
        ([7; 12].as_slice(), "frame 4")
    );
    assert_eq!(moments[1].forecast.as_ref().unwrap().draws[1].latent, [0.5; 8]);
    assert_eq!(moments[1].belief.as_ref().unwrap().resolved.state_probabilities, [0.25, 0.75]);
    assert!(feed.take_newest().is_none(), "each frame is reported once");

    let action = Action {
        sample_count: 2,
        confidence: 0.75,
        hazard_probability: 0.75,
        is_decision: 1,
        based_on_frame: 4,
        latency_ns: 8_000_000,
        ..Action::halt(header, Reason::Belief, Rule::Paper)
    };
    actions.send(action).unwrap();
    let decision = wait_for(|| feed.watched().journal.decisions().next().cloned());
    assert_eq!(
        (decision.rests_on.as_str(), decision.action, decision.latency_ms),
        ("frame 4", ActionCode::Halt, Some(8.0))
    );
    let encoder_ms = feed.watched().journal.times().iter().find(|t| t.name == "encoder").map(|t| t.values[0]);
    assert_eq!(encoder_ms, Some([4.0, 3.0]));

    drop(lock);
    let why = wait_for(|| feed.watched().joined.clone().err());
    assert!(why.contains(&name), "{why}");
    drop(feed);
    drop((frames, posteriors, forecasts, beliefs, actions, node));
    remove_run_leftovers(&run).unwrap();
}
