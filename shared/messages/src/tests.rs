use super::*;
use carff_base::random::{Key, stream};
use rand::RngCore;

fn header() -> Header {
    Header::of_frame(3, 10, 1)
}

fn forecast() -> Forecast {
    let mut forecast = Forecast::empty(header().at_step(1), ForecastSource::Observed, 2);
    forecast.component_count = 2;
    forecast.sample_count = 10;
    forecast.weights[..2].copy_from_slice(&[0.25, 0.75]);
    forecast
}

fn belief() -> Belief {
    let mut belief = Belief::empty(header().at_step(2), 2);
    belief.state_count = 6;
    belief.place_count = 3;
    belief.component_count = 2;
    belief.sample_count = 10;
    belief.component_weights[..2].copy_from_slice(&[0.25, 0.75]);
    belief.state_probability[4] = 0.9;
    belief
}

fn frame() -> FrameMeta {
    FrameMeta {
        header: header(),
        width_px: 128,
        height_px: 96,
        intrinsics: Intrinsics { fl_x_px: 100.0, fl_y_px: 100.0, cx_px: 64.0, cy_px: 48.0 },
        world_from_camera: [0.0; 16],
        dataset_view: DatasetView::UNKNOWN,
        take_start: 0,
    }
}

/// Each message from its constructor is valid, and each single wrong field makes it invalid.
#[test]
fn one_wrong_field_is_enough() {
    assert_eq!(forecast().validate(), Ok(()));
    assert_eq!(belief().validate(), Ok(()));
    assert_eq!(frame().validate(), Ok(()));
    assert_eq!(frame().image_bytes(), 128 * 96 * 3);

    let wrong_forecasts: [fn(&mut Forecast); 10] = [
        |m| m.header.schema_version += 1,
        |m| m.header.step = 0,
        |m| m.header.step = 3,
        |m| m.source = 9,
        |m| m.component_count = 9,
        |m| m.sample_count = 0,
        |m| m.weights[0] = 0.5,
        |m| m.components[1].log_variance[0] = f32::INFINITY,
        |m| m.samples[9][7] = f32::NAN,
        |m| m.sample_component[0] = 2,
    ];
    for (i, wrong) in wrong_forecasts.iter().enumerate() {
        let mut message = forecast();
        wrong(&mut message);
        assert!(message.validate().is_err(), "forecast {i}");
    }
    let wrong_beliefs: [fn(&mut Belief); 14] = [
        |m| m.state_count = 65,
        |m| m.place_count = 49,
        |m| m.is_final = 0,
        |m| m.is_final = 7,
        |m| m.state_probability[0] = 0.2,
        |m| m.hazard_probability = -0.1,
        |m| m.path_probability = f32::NAN,
        |m| m.samples[9].state = 6,
        |m| m.samples[9].occupancies[2] = -1.0,
        |m| m.components[1].confidence = 1.5,
        |m| m.resolved.mean[0] = f32::NEG_INFINITY,
        |m| m.resolved.mean[3] = -1.1e4,
        |m| m.fed_back_count = 65,
        |m| (m.fed_back_count, m.fed_back[63].mean[7]) = (64, f32::NAN),
    ];
    for (i, wrong) in wrong_beliefs.iter().enumerate() {
        let mut message = belief();
        wrong(&mut message);
        assert!(message.validate().is_err(), "belief {i}");
    }
    let wrong_frames: [fn(&mut FrameMeta); 6] = [
        |m| m.width_px = 0,
        |m| m.height_px = 5000,
        |m| (m.width_px, m.height_px) = (4096, 4096),
        |m| m.intrinsics.fl_x_px = 0.0,
        |m| m.world_from_camera[5] = f64::NAN,
        |m| m.dataset_view.observability = 5,
    ];
    for (i, wrong) in wrong_frames.iter().enumerate() {
        let mut message = frame();
        wrong(&mut message);
        assert!(message.validate().is_err(), "frame {i}");
    }
}

/// Entries beyond the counts are ignored: a NaN there does not make a message invalid.
#[test]
fn entries_beyond_the_counts_mean_nothing() {
    let mut forecast = forecast();
    forecast.samples[10][0] = f32::NAN;
    forecast.weights[2] = f32::NAN;
    assert_eq!(forecast.validate(), Ok(()));
    let mut belief = belief();
    belief.samples[10].state = 1000;
    belief.samples[0].occupancies[3] = f32::NAN;
    assert_eq!(belief.validate(), Ok(()));
}

/// Codes are converted to numbers and back; unknown codes are refused.
#[test]
fn codes_round_trip() {
    for state in HealthState::ALL {
        assert_eq!(HealthState::try_from(state.code()), Ok(state));
    }
    for observability in Observability::ALL {
        assert_eq!(Observability::try_from(observability.code()), Ok(observability));
    }
    assert!(Stage::try_from(0).is_err() && Stage::try_from(7).is_err());
    assert_eq!(ActionCode::Halt.code(), 0, "zeroed memory must read as the safe action");
}

/// Random bytes never panic and practically never pass: 300 messages per type.
#[test]
fn garbage_never_panics() {
    let mut rng = stream(Key { seed: 5, frame: 0, step: 0, sample: 0 });
    // An interpreter (`make miri`) takes seconds per message.
    let rounds = if cfg!(miri) { 2 } else { 300 };
    for round in 0..rounds {
        // Half of the messages have plausible headers and counts, so that the deeper checks run too.
        let plausible = round % 2 == 0;
        let mut forecast: Forecast = random_bytes::value(&mut rng);
        let mut belief: Belief = random_bytes::value(&mut rng);
        let mut frame: FrameMeta = random_bytes::value(&mut rng);
        let mut view: ViewMeta = random_bytes::value(&mut rng);
        let mut posterior: Posterior = random_bytes::value(&mut rng);
        let mut action: Action = random_bytes::value(&mut rng);
        let mut health: Health = random_bytes::value(&mut rng);
        if plausible {
            for header in [&mut forecast.header, &mut belief.header] {
                *header = super::Header::of_frame(0, 0, 0).at_step(1);
            }
            for header in [&mut frame.header, &mut view.header, &mut posterior.header, &mut action.header] {
                *header = super::Header::of_frame(0, 0, 0);
            }
            health.header = super::Header::of_frame(0, 0, 0);
            (forecast.horizon, forecast.source, forecast.component_count, forecast.sample_count) = (2, 0, 4, 64);
            (belief.horizon, belief.state_count, belief.place_count) = (2, 64, 48);
            (belief.component_count, belief.sample_count, belief.is_final) = (4, 64, 0);
        }
        assert!(forecast.validate().is_err());
        assert!(belief.validate().is_err());
        assert!(frame.validate().is_err());
        assert!(view.validate().is_err());
        let _ = (posterior.validate(), action.validate());
        assert!(health.validate().is_err() || health.stage().is_ok());
        let _ = (rng.next_u32(), forecast.samples().len(), belief.samples().len());
    }
}

/// Values with random bit patterns.
mod random_bytes {
    use crate::Message;
    use rand::RngCore;

    pub fn value<T: Message>(rng: &mut impl RngCore) -> T {
        let mut value = std::mem::MaybeUninit::<T>::uninit();
        // SAFETY: the slice covers exactly the value's memory, which nothing else refers to; writing bytes to
        // uninitialised memory is allowed through a pointer to u8 as no byte of it is read before.
        unsafe { std::ptr::write_bytes(value.as_mut_ptr().cast::<u8>(), 0, size_of::<T>()) };
        // SAFETY: all bytes are initialised by the line above; the borrow ends before `value` is read.
        let bytes = unsafe { std::slice::from_raw_parts_mut(value.as_mut_ptr().cast::<u8>(), size_of::<T>()) };
        rng.fill_bytes(bytes);
        // SAFETY: each `Message` of this crate consists only of integers and floats, for which any bits are valid.
        unsafe { value.assume_init() }
    }
}

/// Fields are at the same places as in recordings and processes of this schema version.
#[test]
fn layouts_are_fixed() {
    use std::mem::offset_of;
    assert_eq!(
        (offset_of!(Action, is_decision), offset_of!(Action, valid_until_ns), size_of::<Action>()),
        (80, 88, 128)
    );
    assert_eq!((offset_of!(Health, pid), offset_of!(Health, received), size_of::<Health>()), (64, 72, 144));
    assert_eq!((offset_of!(Belief, resolved_state), offset_of!(Belief, resolved)), (15_128, 15_136));
    assert_eq!((offset_of!(Belief, fed_back_count), size_of::<Belief>()), (19_296, 19_328));
}
