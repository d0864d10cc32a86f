//! A message whose kind is only known at run time.

use super::{ActionForm, BeliefForm, ForecastForm, FrameForm, HealthForm, PosteriorForm, ViewForm};
use crate::{Action, Belief, Forecast, FrameMeta, Header, Health, Posterior, ViewMeta};
use serde_json::Value;

/// A message of any topic; of pictures what describes them, and their bytes.
#[derive(Clone, Copy, Debug)]
pub enum AnyMessage<'a> {
    /// A camera frame.
    Frame(&'a FrameMeta, &'a [u8]),
    /// What the encoder saw in it.
    Posterior(&'a Posterior),
    /// A mixture and its samples.
    Forecast(&'a Forecast),
    /// What probing found.
    Belief(&'a Belief),
    /// A rendered view.
    View(&'a ViewMeta, &'a [u8]),
    /// An action.
    Action(&'a Action),
    /// A heartbeat.
    Health(&'a Health),
}

impl<'a> AnyMessage<'a> {
    /// The header.
    pub fn header(self) -> &'a Header {
        match self {
            Self::Frame(m, _) => &m.header,
            Self::Posterior(m) => &m.header,
            Self::Forecast(m) => &m.header,
            Self::Belief(m) => &m.header,
            Self::View(m, _) => &m.header,
            Self::Action(m) => &m.header,
            Self::Health(m) => &m.header,
        }
    }

    /// Bytes that it has in shared memory.
    pub fn size_bytes(self) -> usize {
        match self {
            Self::Frame(m, bytes) => size_of_val(m) + bytes.len(),
            Self::Posterior(m) => size_of_val(m),
            Self::Forecast(m) => size_of_val(m),
            Self::Belief(m) => size_of_val(m),
            Self::View(m, bytes) => size_of_val(m) + bytes.len(),
            Self::Action(m) => size_of_val(m),
            Self::Health(m) => size_of_val(m),
        }
    }

    /// Its form, as JSON; of pictures without their bytes.
    pub fn to_json(self) -> Result<Value, serde_json::Error> {
        match self {
            Self::Frame(m, _) => serde_json::to_value(FrameForm::from(m)),
            Self::Posterior(m) => serde_json::to_value(PosteriorForm::from(m)),
            Self::Forecast(m) => serde_json::to_value(ForecastForm::from(m)),
            Self::Belief(m) => serde_json::to_value(BeliefForm::from(m)),
            Self::View(m, _) => serde_json::to_value(ViewForm::from(m)),
            Self::Action(m) => serde_json::to_value(ActionForm::from(m)),
            Self::Health(m) => serde_json::to_value(HealthForm::from(m)),
        }
    }
}
