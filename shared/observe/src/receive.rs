//! Receiving from a topic whose kind is only known at run time.

use crate::TopicId;
use carff_messages::forms::AnyMessage;
use carff_messages::{Action, Belief, Forecast, FrameMeta, Health, Posterior, ViewMeta};
use carff_transport::{Input, Node, OpenError, Picture, PictureReceiver, ReceiveError, Receiver, Sample, topics};

/// A message of any topic, in its sender's memory.
#[derive(Debug)]
pub enum Received {
    /// A camera frame.
    Frame(Picture<FrameMeta>),
    /// What the encoder saw in it.
    Posterior(Sample<Posterior>),
    /// A mixture and its samples.
    Forecast(Sample<Forecast>),
    /// What probing found.
    Belief(Sample<Belief>),
    /// A rendered view.
    View(Picture<ViewMeta>),
    /// An action.
    Action(Sample<Action>),
    /// A heartbeat.
    Health(Sample<Health>),
}

impl Received {
    /// The message.
    pub fn message(&self) -> AnyMessage<'_> {
        match self {
            Self::Frame(m) => AnyMessage::Frame(m.meta(), m.bytes()),
            Self::Posterior(m) => AnyMessage::Posterior(m),
            Self::Forecast(m) => AnyMessage::Forecast(m),
            Self::Belief(m) => AnyMessage::Belief(m),
            Self::View(m) => AnyMessage::View(m.meta(), m.bytes()),
            Self::Action(m) => AnyMessage::Action(m),
            Self::Health(m) => AnyMessage::Health(m),
        }
    }
}

/// Receives from a topic of any kind.
#[derive(Debug)]
pub enum AnyReceiver {
    /// Camera frames.
    Frame(PictureReceiver<FrameMeta>),
    /// Posteriors.
    Posterior(Receiver<Posterior>),
    /// Forecasts.
    Forecast(Receiver<Forecast>),
    /// Beliefs.
    Belief(Receiver<Belief>),
    /// Rendered views.
    View(PictureReceiver<ViewMeta>),
    /// Actions.
    Action(Receiver<Action>),
    /// Heartbeats.
    Health(Receiver<Health>),
}

impl AnyReceiver {
    /// Opens a topic to be looked at now and then: senders wake nobody for it.
    pub fn open(node: &Node, topic: TopicId) -> Result<Self, OpenError> {
        Ok(match Self::open_woken(node, topic)? {
            Self::Frame(r) => Self::Frame(r.polled()),
            Self::Posterior(r) => Self::Posterior(r.polled()),
            Self::Forecast(r) => Self::Forecast(r.polled()),
            Self::Belief(r) => Self::Belief(r.polled()),
            Self::View(r) => Self::View(r.polled()),
            Self::Action(r) => Self::Action(r.polled()),
            Self::Health(r) => Self::Health(r.polled()),
        })
    }

    /// Opens a topic to be waited for: each message wakes this process, at the cost of a system call to its sender.
    pub fn open_woken(node: &Node, topic: TopicId) -> Result<Self, OpenError> {
        Ok(match topic {
            TopicId::Frame => Self::Frame(node.picture_receiver(&topics::FRAME)?),
            TopicId::Posterior => Self::Posterior(node.receiver(&topics::POSTERIOR)?),
            TopicId::Forecast => Self::Forecast(node.receiver(&topics::FORECAST)?),
            TopicId::Belief => Self::Belief(node.receiver(&topics::BELIEF)?),
            TopicId::View => Self::View(node.picture_receiver(&topics::VIEW)?),
            TopicId::Action => Self::Action(node.receiver(&topics::ACTION)?),
            TopicId::Health(stage) => Self::Health(node.receiver(&topics::health(stage))?),
        })
    }

    /// The oldest valid message that waits, if any.
    #[allow(clippy::should_implement_trait, reason = "an iterator would borrow the receiver for a whole loop")]
    pub fn next(&mut self) -> Result<Option<Received>, ReceiveError> {
        Ok(match self {
            Self::Frame(r) => r.next()?.map(Received::Frame),
            Self::Posterior(r) => r.next()?.map(Received::Posterior),
            Self::Forecast(r) => r.next()?.map(Received::Forecast),
            Self::Belief(r) => r.next()?.map(Received::Belief),
            Self::View(r) => r.next()?.map(Received::View),
            Self::Action(r) => r.next()?.map(Received::Action),
            Self::Health(r) => r.next()?.map(Received::Health),
        })
    }

    /// What a wait is told.
    pub fn as_input(&self) -> &dyn Input {
        match self {
            Self::Frame(r) => r,
            Self::Posterior(r) => r,
            Self::Forecast(r) => r,
            Self::Belief(r) => r,
            Self::View(r) => r,
            Self::Action(r) => r,
            Self::Health(r) => r,
        }
    }
}
