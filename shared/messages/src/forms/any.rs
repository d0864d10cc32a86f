//! Messages with a type that is only known at run time.

use super::{ActionForm, BeliefForm, ForecastForm, FormError, FrameForm, OccupancyForm, UnknownsForm, ViewForm};
use crate::layout::Described;
use crate::{
    Action, Belief, EgoMotion, EgoPose, Forecast, FrameMeta, Header, Health, ImageCheck, LookGain, Message, Occupancy,
    Posterior, Unknowns, ViewMeta,
};
use schemars::JsonSchema;
use serde::Serialize;
use serde::de::DeserializeOwned;
use serde_json::Value;
use std::any::Any;
use std::fmt::Debug;

/// A message that has a JSON form: probes, recordings and links handle it without knowing its type.
pub trait Readable: Message + Described {
    /// The JSON form of the message.
    type Form: Serialize + DeserializeOwned + JsonSchema;
    /// Name of the form's schema, for example `carff.Belief`.
    const SCHEMA: &'static str;

    /// Converts the message into its form.
    fn to_form(&self) -> Self::Form;

    /// Converts a form into a valid message.
    fn of_form(form: &Self::Form) -> Result<Self, FormError>;
}

macro_rules! readable {
    ($($message:ty: $form:ty = $schema:literal;)+) => {
        $(impl Readable for $message {
            type Form = $form;
            const SCHEMA: &'static str = $schema;

            fn to_form(&self) -> $form {
                self.into()
            }

            fn of_form(form: &$form) -> Result<Self, FormError> {
                form.try_into()
            }
        })+
    };
}

/// Messages that are their own form.
macro_rules! plain {
    ($($message:ty = $schema:literal;)+) => {
        $(impl Readable for $message {
            type Form = Self;
            const SCHEMA: &'static str = $schema;

            fn to_form(&self) -> Self {
                *self
            }

            fn of_form(form: &Self) -> Result<Self, FormError> {
                form.validate()?;
                Ok(*form)
            }
        })+
    };
}

plain! {
    Posterior = "carff.Posterior";
    Health = "carff.Health";
    ImageCheck = "carff.ImageCheck";
    EgoPose = "carff.EgoPose";
    EgoMotion = "carff.EgoMotion";
    LookGain = "carff.LookGain";
}

readable! {
    FrameMeta: FrameForm = "carff.Frame";
    Forecast: ForecastForm = "carff.Forecast";
    Belief: BeliefForm = "carff.Belief";
    Unknowns: UnknownsForm = "carff.Unknowns";
    Occupancy: OccupancyForm = "carff.Occupancy";
    ViewMeta: ViewForm = "carff.View";
    Action: ActionForm = "carff.Action";
}

/// Reads a message from the JSON of its form.
pub fn read<M: Readable>(json: &[u8]) -> Result<M, FormError> {
    M::of_form(&serde_json::from_slice(json)?)
}

/// A [`Readable`] message of any type.
pub trait DynMessage: Any + Debug + Send + Sync {
    /// Returns the header.
    fn header(&self) -> &Header;

    /// Returns the header for changes.
    fn header_mut(&mut self) -> &mut Header;

    /// Returns the message's size in shared memory, bytes.
    fn size_bytes(&self) -> usize;

    /// Returns the message's form as JSON.
    fn to_json(&self) -> Result<Value, serde_json::Error>;

    /// Returns a copy.
    fn boxed(&self) -> Box<dyn DynMessage>;
}

impl<M: Readable> DynMessage for M {
    fn header(&self) -> &Header {
        Message::header(self)
    }

    fn header_mut(&mut self) -> &mut Header {
        Message::header_mut(self)
    }

    fn size_bytes(&self) -> usize {
        size_of::<M>()
    }

    fn to_json(&self) -> Result<Value, serde_json::Error> {
        serde_json::to_value(self.to_form())
    }

    fn boxed(&self) -> Box<dyn DynMessage> {
        Box::new(*self)
    }
}

/// A borrowed message of any type, with the bytes of the image that it describes, if any.
///
/// ```
/// use carff_messages::forms::AnyMessage;
/// use carff_messages::{Action, Gaussian, Header, Posterior};
/// let header = Header::of_frame(7, 1_000, 42);
/// let posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 5 };
/// let message = AnyMessage::new(&posterior, &[]);
/// assert_eq!(message.get::<Posterior>(), Some(&posterior));
/// assert!(message.get::<Action>().is_none());
/// ```
#[derive(Clone, Copy, Debug)]
pub struct AnyMessage<'a> {
    message: &'a dyn DynMessage,
    bytes: &'a [u8],
}

impl<'a> AnyMessage<'a> {
    /// Wraps a message and the bytes of the image that it describes.
    pub fn new(message: &'a dyn DynMessage, bytes: &'a [u8]) -> Self {
        Self { message, bytes }
    }

    /// Returns the message if it is of this type.
    pub fn get<M: Readable>(self) -> Option<&'a M> {
        let message: &dyn Any = self.message;
        message.downcast_ref()
    }

    /// Returns the image's bytes; empty for a message by itself.
    pub fn bytes(self) -> &'a [u8] {
        self.bytes
    }

    /// Returns the header.
    pub fn header(self) -> &'a Header {
        self.message.header()
    }

    /// Returns its size in shared memory, bytes, including the image.
    pub fn size_bytes(self) -> usize {
        self.message.size_bytes() + self.bytes.len()
    }

    /// Returns the message's form as JSON, without an image's bytes.
    pub fn to_json(self) -> Result<Value, serde_json::Error> {
        self.message.to_json()
    }

    /// Returns a copy that owns its memory.
    pub fn to_owned(self) -> OwnedMessage {
        OwnedMessage { message: self.message.boxed(), bytes: self.bytes.to_vec() }
    }
}

/// A message of any type that owns its memory.
///
/// ```
/// use carff_messages::forms::OwnedMessage;
/// use carff_messages::{Gaussian, Header, Posterior};
/// let header = Header::of_frame(7, 1_000, 42);
/// let posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 0 };
/// let mut message = OwnedMessage::new(Box::new(posterior), Vec::new());
/// message.get_mut::<Posterior>().expect("it is a posterior").stage_latency_ns = 9;
/// assert_eq!(message.as_message().get::<Posterior>().map(|p| p.stage_latency_ns), Some(9));
/// ```
#[derive(Debug)]
pub struct OwnedMessage {
    message: Box<dyn DynMessage>,
    bytes: Vec<u8>,
}

impl OwnedMessage {
    /// Wraps a message and the bytes of the image that it describes.
    pub fn new(message: Box<dyn DynMessage>, bytes: Vec<u8>) -> Self {
        Self { message, bytes }
    }

    /// Returns the header for changes.
    pub fn header_mut(&mut self) -> &mut Header {
        self.message.header_mut()
    }

    /// Returns the message for changes, if it is of this type.
    pub fn get_mut<M: Readable>(&mut self) -> Option<&mut M> {
        let message: &mut dyn Any = &mut *self.message;
        message.downcast_mut()
    }

    /// Returns the message, borrowed.
    pub fn as_message(&self) -> AnyMessage<'_> {
        AnyMessage { message: &*self.message, bytes: &self.bytes }
    }
}

impl Clone for OwnedMessage {
    fn clone(&self) -> Self {
        self.as_message().to_owned()
    }
}
