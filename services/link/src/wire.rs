//! The parts of a message on the link: its form as tagged JSON, and the bytes of its image.

use carff_messages::forms::{AnyMessage, FormError, OwnedMessage};
use carff_messages::{Action, Health};
use carff_transport::TopicId;
use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;

/// Longest form that is read, bytes; the largest belief has a tenth of it.
const MAX_FORM_BYTES: usize = 1 << 20;

/// The sender of a message, and the message's place among those that it sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tag {
    /// Number of the sending process.
    pub sender: u64,
    /// Counts the topic's messages, including those that had no receiver.
    pub sequence: u64,
    /// Time of sending: the sending machine's monotonic clock, nanoseconds.
    pub sent_ns: u64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Tagged<F> {
    tag: Tag,
    message: F,
}

/// Why the data that arrived is not a message.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// The form is missing or too long.
    #[error("the form has {0} bytes")]
    Length(usize),
    /// The data is not a tagged form.
    #[error("it is not a tagged form: {0}")]
    Tag(#[from] serde_json::Error),
    /// The form is of another topic, or not that of a valid message, or describes another image.
    #[error(transparent)]
    Message(#[from] FormError),
}

/// Returns a message's form as tagged JSON.
pub fn encode(message: AnyMessage<'_>, tag: Tag) -> Result<Vec<u8>, serde_json::Error> {
    serde_json::to_vec(&Tagged { tag, message: message.to_json()? })
}

/// Reads a message from its tagged form and the bytes of its image, if any, and validates it.
pub fn decode(topic: TopicId, form: &[u8], bytes: Vec<u8>) -> Result<(Tag, OwnedMessage), WireError> {
    if !(1..=MAX_FORM_BYTES).contains(&form.len()) {
        return Err(WireError::Length(form.len()));
    }
    let Tagged { tag, message } = serde_json::from_slice::<Tagged<&RawValue>>(form)?;
    Ok((tag, topic.read(message.get().as_bytes(), bytes)?))
}

/// Makes a message one of another run, and changes all its times by `here_ns`.
pub fn settle(message: &mut OwnedMessage, run_id: u64, here_ns: impl Fn(u64) -> u64) {
    if let Some(action) = message.get_mut::<Action>() {
        action.valid_until_ns = here_ns(action.valid_until_ns);
    }
    if let Some(health) = message.get_mut::<Health>() {
        health.last_progress_ns = here_ns(health.last_progress_ns);
    }
    let header = message.header_mut();
    header.run_id = run_id;
    header.capture_time_ns = here_ns(header.capture_time_ns);
    header.publish_time_ns = here_ns(header.publish_time_ns);
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::forms::Readable;
    use carff_messages::{
        ActionCode, Belief, Forecast, ForecastSource, FrameMeta, Gaussian, Header, HealthState, Posterior, Reason,
        Rule, SCHEMA_VERSION, Stage, ViewKind, ViewMeta,
    };

    const TAG: Tag = Tag { sender: u64::MAX, sequence: 3, sent_ns: 1 << 60 };

    fn header() -> Header {
        Header { run_id: u64::MAX - 1, publish_time_ns: 2_500, sequence: 9, ..Header::of_frame(7, 1_500, 42) }
    }

    fn view() -> ViewMeta {
        ViewMeta {
            header: header().at_step(1),
            kind: ViewKind::ALL[0].code(),
            state: -1,
            width_px: 3,
            height_px: 2,
            probability: 0.1,
            latent: [0.1, -0.7, 1e-30, 3.3, 0.0, 5.5e3, -2.0, 1.0 / 3.0],
            intrinsics: carff_messages::Intrinsics { fl_x_px: 0.1, fl_y_px: 1.0 / 3.0, cx_px: 1.5, cy_px: 1.0 },
            world_from_camera: std::array::from_fn(|i| (i as f64).sqrt() / 7.0),
            ..ViewMeta::default()
        }
    }

    fn belief() -> Belief {
        let mut belief = Belief::empty(header().at_step(2), 2);
        (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (3, 2, 1, 2);
        belief.state_probability[..3].copy_from_slice(&[0.1, 0.7, 1.0 / 7.0]);
        belief.component_weights[0] = 1.0;
        belief.samples[1].occupancies[..2].copy_from_slice(&[1.0 / 3.0, 1e-20]);
        belief
    }

    fn action() -> Action {
        Action {
            action: ActionCode::ALL[0].code(),
            sample_count: 10,
            confidence: 0.9,
            hazard_probability: 0.3,
            is_decision: 1,
            valid_until_ns: 9_000,
            based_on_frame: 7,
            latency_ns: 1_000,
            ..Action::halt(header(), Reason::ALL[0], Rule::ALL[0])
        }
    }

    fn health() -> Health {
        Health {
            header: header(),
            stage: Stage::Prober.code(),
            state: HealthState::Ok.code(),
            pid: 1,
            received: 2,
            published: u64::MAX,
            skipped: 0,
            invalid: 0,
            errors: 0,
            last_latency_ns: 5,
            max_latency_ns: 6,
            last_progress_ns: 2_000,
            rss_bytes: 7,
        }
    }

    fn survives<M: Readable + PartialEq>(topic: TopicId, message: M, bytes: &[u8]) {
        let form = encode(AnyMessage::new(&message, bytes), TAG).unwrap();
        let (tag, decoded) = decode(topic, &form, bytes.to_vec()).unwrap();
        assert_eq!((tag, decoded.as_message().get(), decoded.as_message().bytes()), (TAG, Some(&message), bytes));
    }

    /// Messages of all kinds come out unchanged, bit for bit, with their tag.
    #[test]
    fn every_message_survives() {
        let posterior =
            Posterior { header: header(), gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 5 };
        let mut forecast = Forecast::empty(header().at_step(1), ForecastSource::ALL[0], 2);
        (forecast.component_count, forecast.sample_count, forecast.weights[0]) = (1, 1, 1.0);
        forecast.samples[0] = view().latent;
        let frame = FrameMeta {
            header: header(),
            width_px: 2,
            height_px: 3,
            intrinsics: view().intrinsics,
            world_from_camera: view().world_from_camera,
            dataset_view: carff_messages::DatasetView::UNKNOWN,
            take_start: 5,
        };
        survives(TopicId::FRAME, frame, &[7; 18]);
        survives(TopicId::POSTERIOR, posterior, &[]);
        survives(TopicId::FORECAST, forecast, &[]);
        survives(TopicId::BELIEF, belief(), &[]);
        survives(TopicId::VIEW, view(), &[7; 18]);
        survives(TopicId::ACTION, action(), &[]);
        survives(TopicId::health(Stage::Prober), health(), &[]);
    }

    /// A form that is cut off, of another topic, of another size, too long or not valid is refused.
    #[test]
    fn what_is_no_message_is_refused() {
        let (view, mut belief) = (view(), belief());
        let form = encode(AnyMessage::new(&view, &[0; 18]), TAG).unwrap();
        let decode = |topic, form: &[u8], bytes| decode(topic, form, vec![0; bytes]);
        for cut in 0..form.len() {
            assert!(decode(TopicId::VIEW, &form[..cut], 18).is_err(), "{cut}");
        }
        assert!(matches!(decode(TopicId::FRAME, &form, 18), Err(WireError::Message(FormError::Json(_)))));
        let size = decode(TopicId::VIEW, &form, 17).unwrap_err().to_string();
        assert_eq!(size, "`image bytes` is 17, expected 18");
        let text = String::from_utf8(form).unwrap();
        for (from, to) in [
            ("\"width_px\":3", "\"width_px\":4294967295"),
            ("\"probability\":0.1", "\"probability\":7.1"),
            ("\"probability\":0.1", "\"probability\":1e999"),
            (format!("\"schema_version\":{SCHEMA_VERSION}").as_str(), "\"schema_version\":1"),
            ("\"sequence\":3", "\"sequence\":-3"),
            ("\"tag\"", "\"more\":1,\"tag\""),
        ] {
            let wrong = text.replacen(from, to, 1);
            assert_ne!(wrong, text, "{from}");
            assert!(decode(TopicId::VIEW, wrong.as_bytes(), 18).is_err(), "{to}");
        }
        assert!(matches!(decode(TopicId::VIEW, &vec![b' '; MAX_FORM_BYTES + 1], 18), Err(WireError::Length(_))));
        belief.hazard_probability = 1.5;
        let form = encode(AnyMessage::new(&belief, &[]), TAG).unwrap();
        assert!(matches!(decode(TopicId::BELIEF, &form, 0), Err(WireError::Message(FormError::Invalid(_)))));
    }

    fn settled<M: Readable>(message: M) -> M {
        let mut settled = OwnedMessage::new(Box::new(message), Vec::new());
        settle(&mut settled, 5, |ns| ns + 100);
        *settled.as_message().get().unwrap()
    }

    /// A settled message has the run and the times of its new place, and is otherwise unchanged.
    #[test]
    fn only_times_and_run_are_settled() {
        let mut expected = action();
        expected.header.run_id = 5;
        (expected.header.capture_time_ns, expected.header.publish_time_ns) = (1_600, 2_600);
        expected.valid_until_ns = 9_100;
        assert_eq!(settled(action()), expected);
        let health = settled(health());
        assert_eq!((health.last_progress_ns, health.pid), (2_100, 1));
    }
}
