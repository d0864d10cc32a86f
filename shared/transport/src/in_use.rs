//! The current users of each topic, as the transport reports them.

use crate::payload::{Opened, Payload};
use crate::{Node, OpenError, Service, Topic};
use iceoryx2::node::{NodeState, NodeView};
use iceoryx2::prelude::{CallbackProgression, PortFactory};
use iceoryx2::service::Service as _;
use iceoryx2::service::dynamic_config::publish_subscribe::DynamicConfig;
use iceoryx2::service::static_config::messaging_pattern::MessagingPattern;
use iceoryx2::service::static_config::publish_subscribe::StaticConfig;
use std::collections::BTreeMap;

/// A process that has joined the run.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Member {
    /// Name under which it joined.
    pub name: String,
    /// Process id of the process.
    pub pid: u32,
}

/// A topic that a process has open.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct OpenTopic {
    /// Name within the run.
    pub name: String,
    /// Name of the message type; for images, of the type that describes them.
    pub message: String,
    pub(crate) config: StaticConfig,
}

/// The ports of a topic.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Ports {
    /// Processes that publish.
    pub publishers: Vec<Member>,
    /// Processes that subscribe.
    pub subscribers: Vec<Member>,
}

/// Members by the node number that ports contain.
type Members = BTreeMap<u128, Member>;

impl Node {
    fn members_by_id(&self) -> Result<Members, OpenError> {
        let failed =
            |cause: String| OpenError::Node { run: self.run().name().to_owned(), path: self.run().folder(), cause };
        let mut members = Members::new();
        for node in crate::run::nodes(self.run(), self.inner().config()).map_err(failed)? {
            if let NodeState::Alive(node) = node
                && let Some(details) = node.details()
            {
                let member = Member { name: details.name().to_string(), pid: details.process_id().value() as u32 };
                members.insert(node.id().value(), member);
            }
        }
        Ok(members)
    }

    /// Returns all open topics of the run by name, with any message type.
    pub fn open_topics(&self) -> Result<Vec<OpenTopic>, OpenError> {
        let mut topics = Vec::new();
        Service::list(self.inner().config(), |service| {
            let details = &service.static_details;
            if let MessagingPattern::PublishSubscribe(topic) = details.messaging_pattern() {
                let types = topic.message_type_details();
                let header = types.user_header.type_name().to_string();
                let message = if header == "()" { types.payload.type_name().to_string() } else { header };
                topics.push(OpenTopic { name: details.name().to_string(), message, config: *topic });
            }
            CallbackProgression::Continue
        })
        .map_err(|e| OpenError::Topic { topic: "*".to_owned(), cause: e.to_string() })?;
        topics.sort_by(|a, b| a.name.cmp(&b.name));
        Ok(topics)
    }

    /// Returns the ports of a topic; empty if no process has it open.
    pub fn ports<P: Payload>(&self, topic: &Topic<P>) -> Result<Ports, OpenError> {
        // Opening fails when no process has the topic open.
        self.ports_of::<P>(P::open(self.unopened(topic)?).ok().as_ref())
    }

    pub(crate) fn ports_of<P: Payload>(&self, opened: Option<&Opened<P>>) -> Result<Ports, OpenError> {
        let members = self.members_by_id()?;
        Ok(opened.map(|service| list(service.dynamic_config(), &members)).unwrap_or_default())
    }
}

fn list(config: &DynamicConfig<<Service as iceoryx2::service::Service>::Bag>, members: &Members) -> Ports {
    let mut ports = Ports::default();
    config.list_publishers(|port| {
        ports.publishers.extend(members.get(&port.node_id.value()).cloned());
        CallbackProgression::Continue
    });
    config.list_subscribers(|port| {
        ports.subscribers.extend(members.get(&port.node_id.value()).cloned());
        CallbackProgression::Continue
    });
    ports
}
