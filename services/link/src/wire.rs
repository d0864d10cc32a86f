//! What crosses for each message: its form as JSON, tagged, and beside it the bytes of a picture.

use carff_messages::{Action, Belief, Forecast, FrameMeta, Header, Health, Message, PictureMeta, Posterior, ViewMeta};
use carff_observe::TopicId;
use carff_messages::forms::{ActionForm, AnyMessage, BeliefForm, ForecastForm, FormError, FrameForm, HealthForm, PosteriorForm, ViewForm};
use serde::de::DeserializeOwned;
use serde::{Deserialize, Serialize};

/// Longest form that is read, bytes; that of the largest belief has a tenth of it.
const MAX_FORM_BYTES: usize = 1 << 20;

/// Who put a message on the link.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Tag {
    /// Another one for each sending process.
    pub sender: u64,
    /// Counts the topic's messages, those among them that nobody was there to receive.
    pub sequence: u64,
    /// When it was sent: the sending machine's monotonic clock, nanoseconds.
    pub sent_ns: u64,
}

#[derive(Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
struct Tagged<F> {
    tag: Tag,
    message: F,
}

/// A valid message; of pictures what describes them.
#[derive(Clone, Debug, PartialEq)]
pub enum Arrived {
    /// A camera frame.
    Frame(Box<FrameMeta>),
    /// What the encoder saw in it.
    Posterior(Posterior),
    /// A mixture and its samples.
    Forecast(Box<Forecast>),
    /// What probing found.
    Belief(Box<Belief>),
    /// A rendered view.
    View(Box<ViewMeta>),
    /// An action.
    Action(Action),
    /// A heartbeat.
    Health(Health),
}

/// Why something that arrived is no message.
#[derive(Debug, thiserror::Error)]
pub enum WireError {
    /// There is no form, or one that nobody sends.
    #[error("the form has {0} bytes")]
    Length(usize),
    /// It is not the topic's form.
    #[error("it is not the form of this topic: {0}")]
    Form(#[from] serde_json::Error),
    /// The form stands for no valid message.
    #[error(transparent)]
    Message(#[from] FormError),
    /// The picture is not the one that is described.
    #[error("the picture has {found} bytes, described are {described}")]
    Picture {
        /// Bytes that arrived.
        found: usize,
        /// Bytes that were described.
        described: usize,
    },
}

/// A message's form, tagged.
pub fn encode(message: AnyMessage<'_>, tag: Tag) -> Result<Vec<u8>, serde_json::Error> {
    serde_json::to_vec(&Tagged { tag, message: message.to_json()? })
}

/// A message out of its form, validated, and held against the bytes of its picture (none where it is no picture).
pub fn decode(topic: TopicId, form: &[u8], picture_bytes: usize) -> Result<(Tag, Arrived), WireError> {
    if !(1..=MAX_FORM_BYTES).contains(&form.len()) {
        return Err(WireError::Length(form.len()));
    }
    let (tag, arrived, described) = match topic {
        TopicId::Frame => {
            let (tag, meta) = read::<FrameForm, FrameMeta>(form)?;
            (tag, Arrived::Frame(Box::new(meta)), meta.picture_bytes())
        }
        TopicId::View => {
            let (tag, meta) = read::<ViewForm, ViewMeta>(form)?;
            (tag, Arrived::View(Box::new(meta)), meta.picture_bytes())
        }
        TopicId::Posterior => read::<PosteriorForm, _>(form).map(|(tag, m)| (tag, Arrived::Posterior(m), 0))?,
        TopicId::Forecast => read::<ForecastForm, _>(form).map(|(tag, m)| (tag, Arrived::Forecast(Box::new(m)), 0))?,
        TopicId::Belief => read::<BeliefForm, _>(form).map(|(tag, m)| (tag, Arrived::Belief(Box::new(m)), 0))?,
        TopicId::Action => read::<ActionForm, _>(form).map(|(tag, m)| (tag, Arrived::Action(m), 0))?,
        TopicId::Health(_) => read::<HealthForm, _>(form).map(|(tag, m)| (tag, Arrived::Health(m), 0))?,
    };
    if picture_bytes != described {
        return Err(WireError::Picture { found: picture_bytes, described });
    }
    Ok((tag, arrived))
}

fn read<F, M>(form: &[u8]) -> Result<(Tag, M), WireError>
where
    F: DeserializeOwned,
    M: Message + for<'a> TryFrom<&'a F, Error = FormError>,
{
    let Tagged { tag, message } = serde_json::from_slice::<Tagged<F>>(form)?;
    let message = M::try_from(&message)?;
    message.validate().map_err(FormError::from)?;
    Ok((tag, message))
}

impl Arrived {
    /// Makes it a message of another run, with all its times as `here_ns` says.
    pub fn settle(&mut self, run_id: u64, here_ns: impl Fn(u64) -> u64) {
        match self {
            Self::Action(m) => m.valid_until_ns = here_ns(m.valid_until_ns),
            Self::Health(m) => m.last_progress_ns = here_ns(m.last_progress_ns),
            Self::Frame(_) | Self::Posterior(_) | Self::Forecast(_) | Self::Belief(_) | Self::View(_) => {}
        }
        let header = self.header_mut();
        header.run_id = run_id;
        header.capture_time_ns = here_ns(header.capture_time_ns);
        header.publish_time_ns = here_ns(header.publish_time_ns);
    }

    fn header_mut(&mut self) -> &mut Header {
        match self {
            Self::Frame(m) => &mut m.header,
            Self::Posterior(m) => &mut m.header,
            Self::Forecast(m) => &mut m.header,
            Self::Belief(m) => &mut m.header,
            Self::View(m) => &mut m.header,
            Self::Action(m) => &mut m.header,
            Self::Health(m) => &mut m.header,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{ActionCode, ForecastSource, Gaussian, HealthState, Reason, Rule, Stage, ViewKind};

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
            latent: [0.1, -0.7, 1e-30, 3.3, 0.0, 5.5e8, -2.0, 1.0 / 3.0],
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
        belief.samples[1].densities[..2].copy_from_slice(&[1.0 / 3.0, 1e-20]);
        belief
    }

    fn action() -> Action {
        Action {
            header: header(),
            action: ActionCode::ALL[0].code(),
            reason: Reason::ALL[0].code(),
            rule: Rule::ALL[0].code(),
            sample_count: 10,
            confidence: 0.9,
            hazard_probability: 0.3,
            is_decision: 1,
            reserved: 0,
            valid_until_ns: 9_000,
            based_on_frame: 7,
            latency_ns: 1_000,
        }
    }

    fn health() -> Health {
        Health {
            header: header(),
            stage: Stage::Prober.code(),
            state: HealthState::Ok.code(),
            pid: 1,
            reserved: 0,
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

    /// Messages of all kinds come out as they went in, bit for bit, with their tag.
    #[test]
    fn every_message_survives() {
        let posterior = Posterior { header: header(), gaussian: Gaussian::standard(), stage_latency_ns: 5 };
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
        };
        let (view, belief, action, health) = (view(), belief(), action(), health());
        for (topic, message, picture_bytes, expected) in [
            (TopicId::Frame, AnyMessage::Frame(&frame, &[0; 18]), 18, Arrived::Frame(frame.into())),
            (TopicId::Posterior, AnyMessage::Posterior(&posterior), 0, Arrived::Posterior(posterior)),
            (TopicId::Forecast, AnyMessage::Forecast(&forecast), 0, Arrived::Forecast(forecast.into())),
            (TopicId::Belief, AnyMessage::Belief(&belief), 0, Arrived::Belief(belief.into())),
            (TopicId::View, AnyMessage::View(&view, &[0; 18]), 18, Arrived::View(view.into())),
            (TopicId::Action, AnyMessage::Action(&action), 0, Arrived::Action(action)),
            (TopicId::Health(Stage::Prober), AnyMessage::Health(&health), 0, Arrived::Health(health)),
        ] {
            let form = encode(message, TAG).unwrap();
            assert_eq!(decode(topic, &form, picture_bytes).unwrap(), (TAG, expected), "{topic}");
        }
    }

    /// What is cut off, of another topic, of another size, too long or not valid is refused, whatever it is.
    #[test]
    fn what_is_no_message_is_refused() {
        let (view, mut belief) = (view(), belief());
        let form = encode(AnyMessage::View(&view, &[0; 18]), TAG).unwrap();
        for cut in 0..form.len() {
            assert!(decode(TopicId::View, &form[..cut], 18).is_err(), "{cut}");
        }
        assert!(matches!(decode(TopicId::Frame, &form, 18), Err(WireError::Form(_))));
        let size = decode(TopicId::View, &form, 17).unwrap_err().to_string();
        assert_eq!(size, "the picture has 17 bytes, described are 18");
        let text = String::from_utf8(form).unwrap();
        for (from, to) in [
            ("\"width_px\":3", "\"width_px\":4294967295"),
            ("\"probability\":0.1", "\"probability\":7.1"),
            ("\"probability\":0.1", "\"probability\":1e999"),
            ("\"schema_version\":2", "\"schema_version\":3"),
            ("\"sequence\":3", "\"sequence\":-3"),
            ("\"tag\"", "\"more\":1,\"tag\""),
        ] {
            let wrong = text.replacen(from, to, 1);
            assert_ne!(wrong, text, "{from}");
            assert!(decode(TopicId::View, wrong.as_bytes(), 18).is_err(), "{to}");
        }
        assert!(matches!(decode(TopicId::View, &vec![b' '; MAX_FORM_BYTES + 1], 18), Err(WireError::Length(_))));
        belief.hazard_probability = 1.5;
        let form = encode(AnyMessage::Belief(&belief), TAG).unwrap();
        assert!(matches!(decode(TopicId::Belief, &form, 0), Err(WireError::Message(_))));
    }

    /// A settled message has the run and the times of its new place, and all else as it was, sequence number included.
    #[test]
    fn times_and_run_alone_are_settled() {
        let mut settled = Arrived::Action(action());
        settled.settle(5, |ns| ns + 100);
        let mut expected = action();
        expected.header.run_id = 5;
        (expected.header.capture_time_ns, expected.header.publish_time_ns) = (1_600, 2_600);
        expected.valid_until_ns = 9_100;
        assert_eq!(settled, Arrived::Action(expected));
        let mut settled = Arrived::Health(health());
        settled.settle(5, |ns| ns + 100);
        assert!(matches!(settled, Arrived::Health(h) if h.last_progress_ns == 2_100 && h.pid == 1));
    }
}
