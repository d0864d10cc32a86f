use super::*;
use crate::{
    Action, Belief, DatasetView, Forecast, ForecastSource, FrameMeta, Gaussian, Header, Health, Intrinsics, Occupancy,
    Posterior, ProbeResult, ViewMeta,
};

/// Returns deterministic numbers with bit patterns over the range of finite numbers.
fn numbers() -> impl FnMut() -> f32 {
    let mut state = 0x9e37_79b9_7f4a_7c15_u64;
    move || {
        loop {
            state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
            let value = f32::from_bits((state >> 32) as u32);
            if value.is_finite() {
                return value;
            }
        }
    }
}

/// Returns a probability with full precision.
fn probability(next: &mut impl FnMut() -> f32) -> f32 {
    (next().to_bits() >> 8) as f32 / (1 << 24) as f32
}

fn header() -> Header {
    Header {
        run_id: u64::MAX - 3,
        sequence: 5,
        publish_time_ns: (1 << 53) - 1,
        ..Header::of_frame(u64::from(u32::MAX), 123_456_789_012_345, 42)
    }
}

/// Returns a latent's value with full precision.
fn latent(next: &mut impl FnMut() -> f32) -> f32 {
    probability(next).mul_add(2e4, -1e4)
}

fn gaussian(next: &mut impl FnMut() -> f32) -> Gaussian {
    Gaussian {
        mean: std::array::from_fn(|_| latent(next)),
        log_variance: std::array::from_fn(|_| probability(next) * -9.7),
    }
}

fn there_and_back<M: Readable>(message: &M) -> M {
    read(serde_json::to_string(&message.to_form()).unwrap().as_bytes()).unwrap()
}

fn health() -> Health {
    Health {
        header: header(),
        stage: 4,
        state: 2,
        pid: 77,
        received: 1,
        published: 2,
        skipped: 3,
        invalid: 4,
        errors: 5,
        last_latency_ns: 6,
        max_latency_ns: 7,
        last_progress_ns: 8,
        rss_bytes: 9,
    }
}

fn belief(next: &mut impl FnMut() -> f32) -> Belief {
    let mut belief = Belief::empty(header().at_step(1), 2);
    (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (6, 3, 2, 7);
    belief.state_probability[..6].fill_with(|| probability(next) / 6.0);
    belief.component_weights[..2].copy_from_slice(&[0.3, 0.7]);
    let mut probe = |state| {
        let mut occupancies = ProbeResult::NONE.occupancies;
        occupancies[..3].fill_with(|| probability(next));
        ProbeResult { state, confidence: probability(next), hazard_likelihood: probability(next), occupancies }
    };
    for i in 0..7 {
        belief.samples[i] = probe(i as i32 - 1);
        belief.sample_component[i] = (i % 2) as u8;
    }
    belief.components[..2].fill_with(|| probe(-1));
    belief.resolved_state = 5;
    belief.resolved = gaussian(next);
    belief.fed_back[..7].fill_with(|| gaussian(next));
    belief.fed_back_count = 7;
    (belief.encoder_ns, belief.forecaster_ns, belief.stage_latency_ns) = (1, 2, 3);
    belief
}

/// Every message is converted to JSON text and back without a change, bit for bit, for any finite numbers.
#[test]
fn messages_survive_their_forms() {
    let mut next = numbers();
    for _ in 0..200 {
        let posterior =
            Posterior { header: header(), gaussian: gaussian(&mut next), take_start: 0, stage_latency_ns: 7 };
        assert_eq!(there_and_back(&posterior), posterior);

        let belief = belief(&mut next);
        assert_eq!(there_and_back(&belief), belief);

        let mut forecast = Forecast::empty(header().at_step(2), ForecastSource::Probed, 3);
        (forecast.component_count, forecast.sample_count, forecast.resolved_state) = (2, 5, 4);
        forecast.weights[..2].copy_from_slice(&[0.25, 0.75]);
        forecast.components[..2].fill_with(|| gaussian(&mut next));
        for i in 0..5 {
            forecast.samples[i].fill_with(|| latent(&mut next));
            forecast.sample_component[i] = (i % 2) as u8;
        }
        assert_eq!(there_and_back(&forecast), forecast);

        let frame = FrameMeta {
            header: header(),
            width_px: 128,
            height_px: 96,
            intrinsics: Intrinsics { fl_x_px: 100.1, fl_y_px: 1.0 / 3.0, cx_px: 64.0, cy_px: f64::MIN_POSITIVE },
            world_from_camera: std::array::from_fn(|_| f64::from(next()) / 3.0),
            dataset_view: DatasetView { known: 1, view: 3, observability: 2, ..DatasetView::UNKNOWN },
            take_start: 0,
        };
        assert_eq!(there_and_back(&frame), frame);
        let nowhere = FrameMeta { dataset_view: DatasetView::UNKNOWN, ..frame };
        assert_eq!(there_and_back(&nowhere), nowhere);

        let view = ViewMeta {
            header: header().at_step(1),
            hypothesis: 3,
            kind: 1,
            state: -1,
            width_px: 64,
            height_px: 64,
            probability: probability(&mut next),
            latent: std::array::from_fn(|_| next()),
            intrinsics: frame.intrinsics,
            world_from_camera: frame.world_from_camera,
            stage_latency_ns: 9,
        };
        assert_eq!(there_and_back(&view), view);

        let action = Action {
            header: header(),
            action: 1,
            reason: 2,
            rule: 3,
            sample_count: 10,
            confidence: probability(&mut next),
            hazard_probability: probability(&mut next),
            is_decision: 1,
            unknown_probability: 0.0,
            valid_until_ns: 99,
            based_on_frame: u64::MAX,
            latency_ns: 0,
            target_speed_mps: 1.0 / 3.0,
            look_gain_bits: probability(&mut next),
            clear_m: probability(&mut next),
        };
        assert_eq!(there_and_back(&action), action);

        let mut occupancy = Occupancy::empty(header().at_step(2));
        (occupancy.columns, occupancy.rows, occupancy.cell_m) = (7, 5, 0.7);
        occupancy.low_corner_m = [-17.3, 1.0 / 3.0];
        occupancy.unknown_probability = probability(&mut next);
        occupancy.probability[..35].fill_with(|| probability(&mut next));
        assert_eq!(there_and_back(&occupancy), occupancy);
    }
    assert_eq!(there_and_back(&health()), health());
}

/// A grid with more cells than fit, or with a cell above 1, is refused.
#[test]
fn grids_are_checked() {
    let mut form = OccupancyForm::from(&Occupancy::empty(header().at_step(1)));
    (form.columns, form.rows) = (33, 32);
    assert!(Occupancy::try_from(&form).unwrap_err().to_string().contains("columns x rows"));
    (form.columns, form.rows, form.probability) = (2, 1, vec![0.5, 1.5]);
    assert!(Occupancy::try_from(&form).unwrap_err().to_string().contains("probability"));
    form.probability = vec![0.0; 1025];
    assert!(Occupancy::try_from(&form).unwrap_err().to_string().contains("probability"));
}

/// An invalid form is refused with its field's name: unknown names, lists that are too long, invalid numbers.
#[test]
fn what_is_no_message_is_refused() {
    let mut form = BeliefForm::from(&belief(&mut numbers()));
    form.samples[0].occupancies = vec![0.0; 49];
    assert!(Belief::try_from(&form).unwrap_err().to_string().contains("occupancies"));
    form.samples[0].occupancies = vec![0.0; 3];
    form.hazard_probability = 2.0;
    assert!(Belief::try_from(&form).unwrap_err().to_string().contains("hazard_probability"));

    let posterior = Posterior { header: header(), gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 };
    let mut form = serde_json::to_value(posterior).unwrap();
    form["gaussian"]["mean"].as_array_mut().unwrap().pop();
    assert!(serde_json::from_value::<Posterior>(form).unwrap_err().to_string().contains("array of length 8"));

    let mut form = ForecastForm::from(&Forecast::empty(header().at_step(1), ForecastSource::Observed, 1));
    form.source = "guessed".to_owned();
    let error = Forecast::try_from(&form).unwrap_err().to_string();
    assert!(error.contains("source") && error.contains("observed, probed"), "{error}");

    let health = serde_json::to_string(&health()).unwrap();
    for (right, wrong, named) in [
        (r#""stage":"prober""#, r#""stage":"probr""#, "`stage` is `probr`, must be one of: camera"),
        (r#""state":"slow""#, r#""state":"tired""#, "`state` is `tired`"),
        (r#""run_id":"fffffffffffffffc""#, r#""run_id":"no run""#, "`no run` must be 16 hexadecimal digits"),
    ] {
        assert!(health.contains(right), "{health}");
        let error = read::<Health>(health.replace(right, wrong).as_bytes()).unwrap_err().to_string();
        assert!(error.contains(named), "{error}");
    }
}

/// A belief from an old recording, with `densities` for occupancies, can be read.
#[test]
fn the_old_name_of_occupancies_is_read() {
    let belief = belief(&mut numbers());
    let old = serde_json::to_string(&BeliefForm::from(&belief)).unwrap().replace("occupancies", "densities");
    assert_eq!(Belief::try_from(&serde_json::from_str::<BeliefForm>(&old).unwrap()).unwrap(), belief);
}

/// Every field of a form is described by its schema.
#[test]
fn schemas_name_the_fields() {
    let schema = schema::<BeliefForm>();
    let form = serde_json::to_value(BeliefForm::from(&belief(&mut numbers()))).unwrap();
    for key in form.as_object().unwrap().keys() {
        assert!(schema["properties"][key].is_object(), "{key}");
    }
}

/// Text has a line for each plain value, and no braces.
#[test]
fn text_is_indented() {
    let value = serde_json::json!({"a": 1, "b": {"c": null, "d": [1, 2]}, "e": [{"f": true, "g": "x"}]});
    assert_eq!(as_text(&value), "a: 1\nb:\n  c: none\n  d: [1, 2]\ne:\n  - f: yes\n    g: x\n");
}
