//! Topics of stages outside the shipped graph, opened by what the transport stores about them.
//!
//! If this program knows the message type, the topic is like those of the graph. Otherwise only the header is read.

use crate::in_use::OpenTopic;
use crate::node::failed;
use crate::payload::{Loaned, Opened, Payload, Port, PublisherFactory, Received, Unopened};
use crate::topics::of_known_payload;
use crate::{
    AnyPublisher, AnyReceiver, AnyTopic, Node, OpenError, Ports, Receiver, Service, Topic, TopicId, TopicLimits,
};
use carff_messages::forms::{FormError, OwnedMessage, Readable};
use carff_messages::layout::Layout;
use carff_messages::{Header, Invalid, ZeroCopySend, described, message};
use iceoryx2::port::LoanError;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::sample::Sample;
use iceoryx2::service::builder::publish_subscribe::{PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError};
use iceoryx2::service::marker::{CustomHeaderMarker, CustomPayloadMarker};
use iceoryx2::service::static_config::message_type_details::{MessageTypeDetails, TypeDetail, TypeVariant};
use serde_json::Value;

/// Deadline of a topic whose own deadline is not known, milliseconds.
const DEADLINE_MS: u64 = 500;

/// A message of an unknown type: its header, which all messages begin with.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("carff.HeaderOnly.v1")]
pub struct HeaderOnly {
    /// The header.
    pub header: Header,
}

impl HeaderOnly {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()
    }
}

message!(HeaderOnly);
described!(HeaderOnly { header });

impl Readable for HeaderOnly {
    type Form = Header;
    const SCHEMA: &'static str = "carff.Header";

    fn to_form(&self) -> Header {
        self.header
    }

    fn of_form(header: &Header) -> Result<Self, FormError> {
        header.validate()?;
        Ok(Self { header: *header })
    }
}

/// Stands for a message that is too small for a header; its version is not valid.
static NO_HEADER: HeaderOnly = HeaderOnly {
    header: Header {
        schema_version: 0,
        step: 0,
        run_id: 0,
        frame_id: 0,
        sequence: 0,
        capture_time_ns: 0,
        publish_time_ns: 0,
        seed: 0,
    },
};

/// The payload of a topic of an unknown message type; with `IMAGE`, the message describes an image.
#[derive(Debug)]
pub(crate) struct Unknown<const IMAGE: bool>;

type UnknownSample = Sample<Service, [CustomPayloadMarker], CustomHeaderMarker>;

fn payload_bytes(sample: &UnknownSample) -> &[u8] {
    let payload = sample.payload();
    // SAFETY: the marker is one byte for each byte of the payload, which any bytes are valid for, and which its sender
    // no longer changes.
    unsafe { std::slice::from_raw_parts(payload.as_ptr().cast::<u8>(), payload.len()) }
}

impl<const IMAGE: bool> Payload for Unknown<IMAGE> {
    type Message = HeaderOnly;
    type Body = [CustomPayloadMarker];
    type UserHeader = CustomHeaderMarker;

    const IS_IMAGE: bool = IMAGE;

    fn open_or_create(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenOrCreateError> {
        service.open_or_create()
    }

    fn open(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenError> {
        service.open()
    }

    fn sized(publisher: PublisherFactory<'_, Self>, _max_bytes: usize) -> PublisherFactory<'_, Self> {
        publisher
    }

    fn receive(port: &Subscriber<Service, Self::Body, Self::UserHeader>) -> Received<Self> {
        port.receive()
    }

    fn message(sample: &UnknownSample) -> &HeaderOnly {
        let bytes = payload_bytes(sample);
        let message = if IMAGE { std::ptr::from_ref(sample.user_header()).cast() } else { bytes.as_ptr() };
        // A topic whose user header is smaller is not opened as an image's.
        let fits = IMAGE || bytes.len() >= size_of::<HeaderOnly>();
        #[allow(clippy::cast_ptr_alignment, reason = "the next line checks the alignment")]
        let message = message.cast::<HeaderOnly>();
        if !fits || !message.is_aligned() {
            return &NO_HEADER;
        }
        // SAFETY: the message is in the sample's memory, is large enough and aligned, and any bytes are a header.
        unsafe { &*message }
    }

    fn bytes(sample: &UnknownSample) -> &[u8] {
        let bytes = payload_bytes(sample);
        if IMAGE { bytes } else { bytes.get(size_of::<HeaderOnly>()..).unwrap_or_default() }
    }

    fn loan(_port: &Port<Self>, _message: HeaderOnly, _bytes: &[u8]) -> Loaned<Self> {
        Err(LoanError::InternalFailure)
    }

    fn check_size(_message: &HeaderOnly, _bytes: usize) -> Result<(), Invalid> {
        Ok(())
    }
}

/// A topic of an unknown message type.
#[derive(Debug)]
struct Untyped<const IMAGE: bool> {
    topic: Topic<Unknown<IMAGE>>,
    message: &'static str,
    types: MessageTypeDetails,
}

impl<const IMAGE: bool> Untyped<IMAGE> {
    fn open(&self, node: &Node) -> Result<Opened<Unknown<IMAGE>>, OpenError> {
        let service = node.unopened(&self.topic)?;
        // SAFETY: the service is only opened, with the types that it was created with, and `Unknown` reads its memory
        // within their sizes.
        let service = unsafe { service.__internal_set_payload_type_details(&self.types.payload) };
        // SAFETY: as above.
        let service = unsafe { service.__internal_set_user_header_type_details(&self.types.user_header) };
        service.open().map_err(|error| failed(self.topic.name, &error))
    }

    fn open_receiver(&self, node: &Node) -> Result<Receiver<Unknown<IMAGE>>, OpenError> {
        node.receiver_of(&self.topic, &self.open(node)?)
    }
}

impl<const IMAGE: bool> AnyTopic for Untyped<IMAGE> {
    fn name(&self) -> &'static str {
        self.topic.name
    }

    fn is_image(&self) -> bool {
        IMAGE
    }

    fn schema(&self) -> (&'static str, Value) {
        (self.message, Value::Bool(true))
    }

    fn limits(&self) -> TopicLimits {
        self.topic.limits
    }

    fn layout(&self) -> Layout {
        let types = if IMAGE { self.types.user_header } else { self.types.payload };
        let (size_bytes, alignment_bytes) = (types.size(), types.alignment());
        Layout { type_name: self.message.to_owned(), size_bytes, alignment_bytes, fields: Vec::new() }
    }

    fn read(&self, json: &[u8], bytes: Vec<u8>) -> Result<OwnedMessage, FormError> {
        self.topic.read(json, bytes)
    }

    fn ports(&self, node: &Node) -> Result<Ports, OpenError> {
        node.ports_of::<Unknown<IMAGE>>(self.open(node).ok().as_ref())
    }

    fn receiver(&self, node: &Node) -> Result<Box<dyn AnyReceiver>, OpenError> {
        Ok(Box::new(self.open_receiver(node)?))
    }

    fn polled_receiver(&self, node: &Node) -> Result<Box<dyn AnyReceiver>, OpenError> {
        Ok(Box::new(self.open_receiver(node)?.polled()))
    }

    fn publisher(&self, _node: &Node, _max_bytes: usize) -> Result<Box<dyn AnyPublisher>, OpenError> {
        let cause = format!("messages of type `{}` are not known to this program", self.message);
        Err(OpenError::Topic { topic: self.topic.name.to_owned(), cause })
    }

    fn segment_bytes(&self, max_bytes: usize) -> u64 {
        self.topic.segment_bytes(max_bytes)
    }
}

impl OpenTopic {
    /// Returns the topic. Of a message type that this program does not know, only the [`HeaderOnly`] is received. The
    /// description of a topic outside the graph remains in memory until the process ends.
    pub fn id(&self) -> TopicId {
        let known = || of_known_payload(self).unwrap_or_else(|| self.untyped());
        TopicId::all().find(|topic| topic.name() == self.name).unwrap_or_else(|| TopicId::of(known()))
    }

    /// Returns the topic if its payload is of this type.
    pub(crate) fn typed<P: Payload>(&self) -> Option<&'static dyn AnyTopic>
    where
        P::Message: Readable,
    {
        let message = TypeDetail::new::<P::Message>(TypeVariant::FixedSize);
        let types = self.config.message_type_details();
        let found = if P::IS_IMAGE { types.user_header } else { types.payload };
        (found == message).then(|| Box::leak(Box::new(self.topic::<P>())) as &dyn AnyTopic)
    }

    fn untyped(&self) -> &'static dyn AnyTopic {
        let types = *self.config.message_type_details();
        let message: &'static str = self.message.clone().leak();
        if types.user_header.size() >= size_of::<HeaderOnly>() {
            Box::leak(Box::new(Untyped::<true> { topic: self.topic(), message, types }))
        } else {
            Box::leak(Box::new(Untyped::<false> { topic: self.topic(), message, types }))
        }
    }

    fn topic<P: Payload>(&self) -> Topic<P> {
        let limits = TopicLimits {
            max_subscribers: self.config.max_subscribers(),
            max_publishers: self.config.max_publishers(),
            max_nodes: self.config.max_nodes(),
            history: self.config.history_size(),
            buffer: self.config.subscriber_max_buffer_size(),
            borrowed: self.config.subscriber_max_borrowed_samples(),
            loaned: 1,
        };
        Topic::new(self.name.clone().leak(), limits, DEADLINE_MS)
    }
}
