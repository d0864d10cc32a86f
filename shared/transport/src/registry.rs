//! Topics with a payload type that is only known at run time: for probes, recordings and links.

use crate::payload::Payload;
use crate::{Input, Node, OpenError, Ports, Publisher, ReceiveError, Receiver, Sample, SendError, Topic, TopicLimits};
use carff_messages::Stage;
use carff_messages::forms::{AnyMessage, FormError, OwnedMessage, Readable, read, schema};
use carff_messages::layout::{Described, Layout};
use serde_json::Value;
use std::cmp::Ordering;
use std::fmt;
use std::hash::{Hash, Hasher};
use std::str::FromStr;

/// A topic of any payload whose message has a JSON form. Every [`Topic`] implements it, including topics of users'
/// stages.
pub trait AnyTopic: fmt::Debug + Sync {
    /// Returns the name within the run.
    fn name(&self) -> &'static str;

    /// Returns true if its payload is an image.
    fn is_image(&self) -> bool;

    /// Returns name and JSON Schema of its message's form.
    fn schema(&self) -> (&'static str, Value);

    /// Returns the limits that all its users share.
    fn limits(&self) -> TopicLimits;

    /// Returns the layout of its message; of an image, the message that describes it. A message of a type that this
    /// program does not know has no fields.
    fn layout(&self) -> Layout;

    /// Reads a message from the JSON of its form, and takes the bytes of its image, which must have the described size.
    fn read(&self, json: &[u8], bytes: Vec<u8>) -> Result<OwnedMessage, FormError>;

    /// Returns the current publishers and subscribers.
    fn ports(&self, node: &Node) -> Result<Ports, OpenError>;

    /// Opens the topic for receiving: each message wakes this process, which costs its sender a system call.
    fn receiver(&self, node: &Node) -> Result<Box<dyn AnyReceiver>, OpenError>;

    /// Opens the topic for polling: senders do not wake this process.
    fn polled_receiver(&self, node: &Node) -> Result<Box<dyn AnyReceiver>, OpenError>;

    /// Opens the topic for sending; `max_bytes` is the size of its largest image, and is ignored for messages.
    fn publisher(&self, node: &Node, max_bytes: usize) -> Result<Box<dyn AnyPublisher>, OpenError>;

    /// Returns the shared memory that a publisher of images of `max_bytes` reserves, bytes.
    #[doc(hidden)]
    fn segment_bytes(&self, max_bytes: usize) -> u64;
}

/// A publisher for a topic of any payload.
pub trait AnyPublisher: fmt::Debug {
    /// Returns the size of the largest image that it can send, bytes.
    fn max_bytes(&self) -> usize;

    /// Stamps, validates and sends a copy of a message. A message of another type than the topic's is an error.
    fn send(&mut self, message: AnyMessage<'_>) -> Result<(), SendError>;

    /// Sends a copy of a message unchanged, sequence number included, without validation.
    fn forward(&mut self, message: AnyMessage<'_>) -> Result<(), SendError>;
}

/// A receiver for a topic of any payload.
pub trait AnyReceiver: Input + fmt::Debug {
    /// Returns the oldest waiting valid message.
    fn next(&mut self) -> Result<Option<Box<dyn Received>>, ReceiveError>;

    /// Returns the receiver as an input for a wait.
    fn as_input(&self) -> &dyn Input;
}

/// A received message of any type, in its sender's memory.
pub trait Received: fmt::Debug {
    /// Returns the message.
    fn message(&self) -> AnyMessage<'_>;
}

impl<P: Payload> AnyTopic for Topic<P>
where
    P::Message: Readable,
{
    fn name(&self) -> &'static str {
        self.name
    }

    fn is_image(&self) -> bool {
        P::IS_IMAGE
    }

    fn schema(&self) -> (&'static str, Value) {
        (P::Message::SCHEMA, schema::<<P::Message as Readable>::Form>())
    }

    fn limits(&self) -> TopicLimits {
        self.limits
    }

    fn layout(&self) -> Layout {
        P::Message::layout()
    }

    fn read(&self, json: &[u8], bytes: Vec<u8>) -> Result<OwnedMessage, FormError> {
        let message: P::Message = read(json)?;
        P::check_size(&message, bytes.len())?;
        Ok(OwnedMessage::new(Box::new(message), bytes))
    }

    fn ports(&self, node: &Node) -> Result<Ports, OpenError> {
        node.ports(self)
    }

    fn receiver(&self, node: &Node) -> Result<Box<dyn AnyReceiver>, OpenError> {
        Ok(Box::new(node.receiver(self)?))
    }

    fn polled_receiver(&self, node: &Node) -> Result<Box<dyn AnyReceiver>, OpenError> {
        Ok(Box::new(node.receiver(self)?.polled()))
    }

    fn publisher(&self, node: &Node, max_bytes: usize) -> Result<Box<dyn AnyPublisher>, OpenError> {
        Ok(Box::new(node.sized_publisher(self, max_bytes)?))
    }

    fn segment_bytes(&self, max_bytes: usize) -> u64 {
        self.segment_bytes(max_bytes)
    }
}

impl<P: Payload> AnyPublisher for Publisher<P>
where
    P::Message: Readable,
{
    fn max_bytes(&self) -> usize {
        self.max_bytes
    }

    fn send(&mut self, message: AnyMessage<'_>) -> Result<(), SendError> {
        let mut typed: P::Message = *message.get().ok_or_else(|| self.of_another_type())?;
        self.stamp(&mut typed)?;
        P::check_size(&typed, message.bytes().len()).map_err(|source| self.invalid(source))?;
        self.forward(typed, message.bytes())
    }

    fn forward(&mut self, message: AnyMessage<'_>) -> Result<(), SendError> {
        let typed = message.get().ok_or_else(|| self.of_another_type())?;
        self.forward(*typed, message.bytes())
    }
}

impl<P: Payload> AnyReceiver for Receiver<P>
where
    P::Message: Readable,
{
    fn next(&mut self) -> Result<Option<Box<dyn Received>>, ReceiveError> {
        Ok(Receiver::next(self)?.map(|sample| Box::new(sample) as Box<dyn Received>))
    }

    fn as_input(&self) -> &dyn Input {
        self
    }
}

impl<P: Payload> Received for Sample<P>
where
    P::Message: Readable,
{
    fn message(&self) -> AnyMessage<'_> {
        AnyMessage::new(&**self, self.bytes())
    }
}

/// A topic by its name. The topics of the graph come first, in the order of the data flow.
///
/// ```
/// use carff_transport::{TopicId, UnknownTopic};
/// let belief: TopicId = "prober/belief".parse()?;
/// assert_eq!(belief, TopicId::BELIEF);
/// let error = "beleif".parse::<TopicId>().unwrap_err();
/// assert!(error.to_string().contains("did you mean `prober/belief`"), "{error}");
/// # Ok::<(), UnknownTopic>(())
/// ```
#[derive(Clone, Copy, Debug)]
pub struct TopicId {
    /// Index in the graph; larger than all others for a user's topic.
    index: usize,
    topic: &'static dyn AnyTopic,
}

/// Error for an unknown topic name.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("there is no topic `{name}`{}. All: {}", carff_base::names::hint(name, TopicId::all().map(TopicId::name)), all_names())]
pub struct UnknownTopic {
    /// The unknown name.
    pub name: String,
}

fn all_names() -> String {
    TopicId::all().map(TopicId::name).collect::<Vec<_>>().join(", ")
}

impl TopicId {
    /// Returns the id of a topic in the graph's table.
    pub(crate) const fn of_graph(index: usize, topic: &'static dyn AnyTopic) -> Self {
        Self { index, topic }
    }

    /// Returns the id of a user's own topic.
    pub fn of(topic: &'static dyn AnyTopic) -> Self {
        let known = Self::all().find(|known| known.name() == topic.name());
        known.unwrap_or(Self { index: usize::MAX, topic })
    }

    /// Returns all topics of the graph.
    pub fn all() -> impl Iterator<Item = Self> {
        Self::FLOW.into_iter().chain(Stage::ALL.into_iter().map(Self::health))
    }

    /// Returns the topic of a stage's results.
    pub fn of_stage(stage: Stage) -> Self {
        match stage {
            Stage::Camera => Self::FRAME,
            Stage::Encoder => Self::POSTERIOR,
            Stage::Forecaster => Self::FORECAST,
            Stage::Prober => Self::BELIEF,
            Stage::Renderer => Self::VIEW,
            Stage::Controller => Self::ACTION,
        }
    }

    /// Returns the name within the run.
    pub fn name(self) -> &'static str {
        self.topic.name()
    }
}

impl std::ops::Deref for TopicId {
    type Target = dyn AnyTopic;

    fn deref(&self) -> &Self::Target {
        self.topic
    }
}

impl PartialEq for TopicId {
    fn eq(&self, other: &Self) -> bool {
        self.name() == other.name()
    }
}

impl Eq for TopicId {}

impl Ord for TopicId {
    fn cmp(&self, other: &Self) -> Ordering {
        self.index.cmp(&other.index).then_with(|| self.name().cmp(other.name()))
    }
}

impl PartialOrd for TopicId {
    fn partial_cmp(&self, other: &Self) -> Option<Ordering> {
        Some(self.cmp(other))
    }
}

impl Hash for TopicId {
    fn hash<H: Hasher>(&self, state: &mut H) {
        self.name().hash(state);
    }
}

impl fmt::Display for TopicId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.pad(self.name())
    }
}

impl FromStr for TopicId {
    type Err = UnknownTopic;

    /// Parses a topic's full name, or its last part (`belief`) if that is unique.
    fn from_str(name: &str) -> Result<Self, UnknownTopic> {
        let last = |topic: &Self| topic.name().rsplit('/').next().unwrap_or_default();
        let by_name = Self::all().find(|t| t.name() == name);
        if let Some(topic) = by_name.or_else(|| Self::FLOW.into_iter().find(|t| last(t) == name)) {
            return Ok(topic);
        }
        Err(UnknownTopic { name: name.to_owned() })
    }
}

/// Returns the shared memory that a whole graph reserves, bytes, with camera frames and rendered views of these sizes.
/// The launcher checks it once, before it starts a stage.
pub fn graph_bytes(frame_bytes: usize, view_bytes: usize) -> u64 {
    let of = |topic: TopicId| {
        let image_bytes = match topic {
            _ if topic == TopicId::FRAME => frame_bytes,
            _ if topic == TopicId::VIEW => view_bytes,
            _ => 0,
        };
        topic.segment_bytes(image_bytes) + crate::space::MANAGEMENT_BYTES
    };
    TopicId::all().map(of).sum()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::topics;
    use carff_messages::Posterior;

    /// Every name maps to its topic, also the last part of data topics; a misspelt name suggests the nearest one.
    #[test]
    fn names_lead_to_topics() {
        for topic in TopicId::all() {
            assert_eq!(topic.name().parse(), Ok(topic));
        }
        assert_eq!("belief".parse(), Ok(TopicId::BELIEF));
        let told = |name: &str| name.parse::<TopicId>().unwrap_err().to_string();
        assert!(told("beleif").contains("did you mean `prober/belief`?"), "{}", told("beleif"));
        assert!(told("health/rendrer").contains("did you mean `health/renderer`?"), "{}", told("health/rendrer"));
    }

    /// Each stage has a heartbeat topic with its name.
    #[test]
    fn every_stage_has_its_health_topic() {
        for stage in Stage::ALL {
            assert_eq!(topics::health(stage).name, format!("health/{stage}"));
        }
    }

    /// A user's own topic has the same type as the graph's topics, and comes after them.
    #[test]
    fn a_users_topic_is_a_topic() {
        static OPINION: Topic<Posterior> = Topic::new("second-encoder/posterior", topics::MESSAGES, 500);
        let own = TopicId::of(&OPINION);
        assert!(TopicId::all().all(|known| known < own && known != own));
        assert_eq!((own.schema().0, own.is_image()), ("carff.Posterior", false));
        assert_eq!(TopicId::of(&topics::BELIEF), TopicId::BELIEF);
    }
}
