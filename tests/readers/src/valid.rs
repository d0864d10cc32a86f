//! A valid message of each kind.

use carff_messages::{
    Action, Belief, DatasetView, Forecast, ForecastSource, FrameMeta, Gaussian, Header, Health, Intrinsics, Posterior,
    ProbeResult, Reason, Rule, ViewMeta,
};

fn header() -> Header {
    Header { run_id: 5, sequence: 2, publish_time_ns: 2_000_000, ..Header::of_frame(1, 1_000_000, 9) }
}

const INTRINSICS: Intrinsics = Intrinsics { fl_x_px: 3.3, fl_y_px: 3.4, cx_px: 2.0, cy_px: 1.0 };
const WORLD_FROM_CAMERA: [f64; 16] = [1.0, 0.0, 0.0, 0.1, 0.0, 1.0, 0.0, 0.2, 0.0, 0.0, 1.0, 0.3, 0.0, 0.0, 0.0, 1.0];

pub(crate) fn posterior() -> Posterior {
    Posterior { header: header(), gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 3 }
}

pub(crate) fn forecast() -> Forecast {
    let mut forecast = Forecast::empty(header().at_step(1), ForecastSource::Observed, 2);
    (forecast.component_count, forecast.sample_count) = (2, 10);
    forecast.weights[..2].copy_from_slice(&[0.25, 0.75]);
    forecast
}

pub(crate) fn belief() -> Belief {
    let mut belief = Belief::empty(header().at_step(1), 1);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (2, 1, 1, 1);
    belief.state_probability[..2].copy_from_slice(&[0.3, 0.6]);
    belief.component_weights[0] = 1.0;
    belief.samples[0] = ProbeResult { state: 1, confidence: 0.9, ..ProbeResult::NONE };
    belief
}

pub(crate) fn action() -> Action {
    Action {
        action: 1,
        sample_count: 10,
        confidence: 0.5,
        hazard_probability: 0.25,
        is_decision: 1,
        valid_until_ns: 77,
        based_on_frame: 1,
        latency_ns: 20,
        ..Action::halt(header(), Reason::Belief, Rule::Calibrated)
    }
}

pub(crate) fn health() -> Health {
    Health {
        header: header(),
        stage: 1,
        state: 1,
        pid: 7,
        received: 2,
        published: 2,
        skipped: 0,
        invalid: 0,
        errors: 0,
        last_latency_ns: 5,
        max_latency_ns: 6,
        last_progress_ns: 1_000_000,
        rss_bytes: 4096,
    }
}

pub(crate) fn frame() -> FrameMeta {
    FrameMeta {
        header: header(),
        width_px: 4,
        height_px: 2,
        intrinsics: INTRINSICS,
        world_from_camera: WORLD_FROM_CAMERA,
        dataset_view: DatasetView::UNKNOWN,
        take_start: 0,
    }
}

pub(crate) fn view() -> ViewMeta {
    ViewMeta {
        header: header().at_step(1),
        hypothesis: 0,
        kind: 0,
        state: 1,
        width_px: 2,
        height_px: 2,
        probability: 0.5,
        latent: Gaussian::standard().mean,
        intrinsics: INTRINSICS,
        world_from_camera: WORLD_FROM_CAMERA,
        stage_latency_ns: 1,
    }
}
