//! The two forms of a message in shared memory: by itself, or as the user header of an image.

use crate::Service;
use carff_messages::check::equals;
use carff_messages::{ImageMeta, Invalid, Message};
use iceoryx2::port::publisher::Publisher;
use iceoryx2::port::subscriber::Subscriber;
use iceoryx2::port::{LoanError, ReceiveError};
use iceoryx2::prelude::{AllocationStrategy, IceoryxSend, ZeroCopySend};
use iceoryx2::sample::Sample;
use iceoryx2::sample_mut::SampleMut;
use iceoryx2::service::builder::publish_subscribe::{
    Builder, PublishSubscribeOpenError, PublishSubscribeOpenOrCreateError,
};
use iceoryx2::service::port_factory::publish_subscribe::PortFactory;
use iceoryx2::service::port_factory::publisher::PortFactoryPublisher;
use std::fmt::Debug;
use std::marker::PhantomData;

/// The payload of an image topic: RGB bytes, with `M` to describe them.
#[derive(Debug)]
pub struct ImagePayload<M>(PhantomData<M>);

/// The payload of a topic: a [`Message`] by itself, or an [`ImagePayload`] that a message describes.
pub trait Payload: Debug + 'static {
    /// The message, which carries the header.
    type Message: Message;
    /// The payload that iceoryx2 transports.
    #[doc(hidden)]
    type Body: IceoryxSend + ZeroCopySend + Debug + ?Sized;
    /// The user header that iceoryx2 transports with it.
    #[doc(hidden)]
    type UserHeader: ZeroCopySend + Debug;

    #[doc(hidden)]
    const IS_IMAGE: bool;

    #[doc(hidden)]
    fn open_or_create(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenOrCreateError>;

    #[doc(hidden)]
    fn open(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenError>;

    /// Reserves memory for images of at most `max_bytes`.
    #[doc(hidden)]
    fn sized(publisher: PublisherFactory<'_, Self>, max_bytes: usize) -> PublisherFactory<'_, Self>;

    #[doc(hidden)]
    fn receive(port: &Subscriber<Service, Self::Body, Self::UserHeader>) -> Received<Self>;

    #[doc(hidden)]
    fn message(sample: &Sample<Service, Self::Body, Self::UserHeader>) -> &Self::Message;

    /// Returns the bytes of an image; empty for a message by itself.
    #[doc(hidden)]
    fn bytes(sample: &Sample<Service, Self::Body, Self::UserHeader>) -> &[u8];

    /// Copies a message, and the image that it describes, into the port's memory.
    #[doc(hidden)]
    fn loan(port: &Port<Self>, message: Self::Message, bytes: &[u8]) -> Loaned<Self>;

    /// Checks that the number of bytes matches the description; 0 for a message by itself.
    #[doc(hidden)]
    fn check_size(message: &Self::Message, bytes: usize) -> Result<(), Invalid>;
}

#[doc(hidden)]
pub type Unopened<P> = Builder<<P as Payload>::Body, <P as Payload>::UserHeader, Service>;
#[doc(hidden)]
pub type Opened<P> = PortFactory<Service, <P as Payload>::Body, <P as Payload>::UserHeader>;
#[doc(hidden)]
pub type PublisherFactory<'a, P> = PortFactoryPublisher<'a, Service, <P as Payload>::Body, <P as Payload>::UserHeader>;
#[doc(hidden)]
pub type Port<P> = Publisher<Service, <P as Payload>::Body, <P as Payload>::UserHeader>;
#[doc(hidden)]
pub type Loaned<P> = Result<SampleMut<Service, <P as Payload>::Body, <P as Payload>::UserHeader>, LoanError>;
#[doc(hidden)]
pub type Received<P> = Result<Option<Sample<Service, <P as Payload>::Body, <P as Payload>::UserHeader>>, ReceiveError>;

impl<M: Message> Payload for M {
    type Message = M;
    type Body = M;
    type UserHeader = ();

    const IS_IMAGE: bool = false;

    fn open_or_create(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenOrCreateError> {
        service.open_or_create()
    }

    fn open(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenError> {
        service.open()
    }

    fn sized(publisher: PublisherFactory<'_, Self>, _max_bytes: usize) -> PublisherFactory<'_, Self> {
        publisher
    }

    fn receive(port: &Subscriber<Service, M, ()>) -> Received<Self> {
        port.receive()
    }

    fn message(sample: &Sample<Service, M, ()>) -> &M {
        sample.payload()
    }

    fn bytes(_sample: &Sample<Service, M, ()>) -> &[u8] {
        &[]
    }

    fn loan(port: &Port<Self>, message: M, _bytes: &[u8]) -> Loaned<Self> {
        Ok(port.loan_uninit()?.write_payload(message))
    }

    fn check_size(_message: &M, bytes: usize) -> Result<(), Invalid> {
        equals("image bytes", bytes as u64, 0)
    }
}

impl<M: ImageMeta> Payload for ImagePayload<M> {
    type Message = M;
    type Body = [u8];
    type UserHeader = M;

    const IS_IMAGE: bool = true;

    fn open_or_create(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenOrCreateError> {
        service.open_or_create()
    }

    fn open(service: Unopened<Self>) -> Result<Opened<Self>, PublishSubscribeOpenError> {
        service.open()
    }

    fn sized(publisher: PublisherFactory<'_, Self>, max_bytes: usize) -> PublisherFactory<'_, Self> {
        publisher.initial_max_slice_len(max_bytes).allocation_strategy(AllocationStrategy::Static)
    }

    fn receive(port: &Subscriber<Service, [u8], M>) -> Received<Self> {
        port.receive()
    }

    fn message(sample: &Sample<Service, [u8], M>) -> &M {
        sample.user_header()
    }

    fn bytes(sample: &Sample<Service, [u8], M>) -> &[u8] {
        sample.payload()
    }

    fn loan(port: &Port<Self>, message: M, bytes: &[u8]) -> Loaned<Self> {
        let mut sample = port.loan_slice_uninit(bytes.len())?.write_from_slice(bytes);
        *sample.user_header_mut() = message;
        Ok(sample)
    }

    fn check_size(message: &M, bytes: usize) -> Result<(), Invalid> {
        equals("image bytes", bytes as u64, message.image_bytes() as u64)
    }
}
