//! Sending: stamp, write in place, wake.

use crate::payload::{ImagePayload, Payload, Port};
use crate::{Counters, Run, SendError, Service, Topic, monotonic_now_ns};
use carff_messages::{Header, ImageMeta, Invalid, Message, SCHEMA_VERSION};
use iceoryx2::port::notifier::Notifier;
use iceoryx2::sample_mut::SampleMut;
use ndarray::ArrayViewMut3;
use std::sync::Arc;

/// Sends the messages of one topic.
#[derive(Debug)]
pub struct Publisher<P: Payload> {
    topic: &'static str,
    run_id: u64,
    sequence: u64,
    port: Port<P>,
    notifier: Notifier<Service>,
    counters: Arc<Counters>,
    pub(crate) max_bytes: usize,
}

impl<P: Payload> Publisher<P> {
    pub(crate) fn new(
        topic: &Topic<P>,
        run: &Run,
        port: Port<P>,
        notifier: Notifier<Service>,
        counters: Arc<Counters>,
        max_bytes: usize,
    ) -> Self {
        Self { topic: topic.name, run_id: run.id(), sequence: 0, port, notifier, counters, max_bytes }
    }

    /// Stamps the header and validates the message.
    pub(crate) fn stamp(&self, message: &mut P::Message) -> Result<(), SendError> {
        let header: &mut Header = message.header_mut();
        header.schema_version = SCHEMA_VERSION;
        header.run_id = self.run_id;
        header.sequence = self.sequence;
        header.publish_time_ns = monotonic_now_ns();
        message.validate().map_err(|source| self.invalid(source))
    }

    /// Sends a copy of a message, and of the image that it describes, without stamping or validation.
    pub(crate) fn forward(&mut self, message: P::Message, bytes: &[u8]) -> Result<(), SendError> {
        self.check_room(bytes.len())?;
        let sample = P::loan(&self.port, message, bytes).map_err(|e| self.failed(&e))?;
        sample.send().map_err(|e| self.failed(&e))?;
        self.sent();
        Ok(())
    }

    /// Counts the message and wakes receivers. A listener that cannot be woken (dead, or stopped with a full socket)
    /// does not stop the sender; it finds the message at its next check.
    fn sent(&mut self) {
        self.sequence += 1;
        self.counters.count_published();
        if let Err(error) = self.notifier.notify() {
            tracing::debug!(topic = self.topic, %error, "a listener was not woken");
        }
    }

    pub(crate) fn invalid(&self, source: Invalid) -> SendError {
        SendError::Invalid { topic: self.topic.to_owned(), source }
    }

    pub(crate) fn of_another_type(&self) -> SendError {
        SendError::Failed { topic: self.topic.to_owned(), cause: "the message is of another type".to_owned() }
    }

    fn check_room(&self, bytes: usize) -> Result<(), SendError> {
        if P::IS_IMAGE && bytes > self.max_bytes { Err(self.size(bytes, self.max_bytes)) } else { Ok(()) }
    }

    fn size(&self, found: usize, max: usize) -> SendError {
        SendError::Size { topic: self.topic.to_owned(), found, max }
    }

    fn failed(&self, error: &dyn std::error::Error) -> SendError {
        SendError::Failed { topic: self.topic.to_owned(), cause: error.to_string() }
    }
}

impl<M: Message> Publisher<M> {
    /// Stamps the header (schema, run, sequence, publish time), validates, sends, and wakes the receivers that wait.
    pub fn send(&mut self, mut message: M) -> Result<(), SendError> {
        self.stamp(&mut message)?;
        self.send_unchecked(message)
    }

    /// Sends without stamping or validation: for replay, and for tests that inject faults.
    pub fn send_unchecked(&mut self, message: M) -> Result<(), SendError> {
        self.forward(message, &[])
    }
}

/// Memory of the publisher that an image is written into and sent from.
///
/// ```
/// use carff_messages::{FrameMeta, Header, Intrinsics};
/// use carff_transport::{Node, Run, monotonic_now_ns, topics};
/// # fn main() -> Result<(), Box<dyn std::error::Error>> {
/// # let name = format!("doc-loan-{}", std::process::id());
/// let run = Run::new(&name, 1)?;
/// let node = Node::open(&run, "example")?;
/// let mut input = node.receiver(&topics::FRAME)?;
/// let mut output = node.image_publisher(&topics::FRAME, 4 * 2 * 3)?;
///
/// let mut loan = output.loan(4 * 2 * 3)?;
/// let mut image = loan.image_mut(4, 2).expect("the loan has this size");
/// image[[1, 3, 0]] = 255; // Row 1, column 3, red.
/// let intrinsics = Intrinsics { fl_x_px: 4.0, fl_y_px: 4.0, cx_px: 2.0, cy_px: 1.0 };
/// let header = Header::of_frame(0, monotonic_now_ns(), 42);
/// output.send_image(loan, FrameMeta { header, width_px: 4, height_px: 2, intrinsics, ..FrameMeta::default() })?;
///
/// let received = input.newest()?.expect("it was sent above");
/// assert_eq!(received.image().dim(), (2, 4, 3));
/// assert_eq!(received.image()[[1, 3, 0]], 255);
/// # drop((received, input, output, node));
/// # carff_transport::remove_run_leftovers(&run)?;
/// # Ok(())
/// # }
/// ```
#[derive(Debug)]
pub struct ImageLoan<M: ImageMeta> {
    sample: SampleMut<Service, [u8], M>,
}

impl<M: ImageMeta> ImageLoan<M> {
    /// Returns the image's bytes, initially zero.
    pub fn bytes_mut(&mut self) -> &mut [u8] {
        self.sample.payload_mut()
    }

    /// Returns the image as (height, width, channel); `None` if the size does not match the loan.
    pub fn image_mut(&mut self, width_px: u32, height_px: u32) -> Option<ArrayViewMut3<'_, u8>> {
        let shape = (height_px as usize, width_px as usize, 3);
        ArrayViewMut3::from_shape(shape, self.sample.payload_mut()).ok()
    }
}

impl<M: ImageMeta> Publisher<ImagePayload<M>> {
    /// Returns memory for an image of `bytes` bytes, in the segment that the receivers read from.
    pub fn loan(&self, bytes: usize) -> Result<ImageLoan<M>, SendError> {
        self.check_room(bytes)?;
        Ok(ImageLoan { sample: self.port.loan_slice(bytes).map_err(|e| self.failed(&e))? })
    }

    /// Stamps the header, validates, sends the written image, and wakes the receivers that wait.
    pub fn send_image(&mut self, loan: ImageLoan<M>, mut meta: M) -> Result<(), SendError> {
        self.stamp(&mut meta)?;
        self.check_size(loan.sample.payload().len(), &meta)?;
        self.send_image_unchecked(loan, meta)
    }

    /// Stamps the header, validates, and sends a copy of an image.
    pub fn send_bytes(&mut self, bytes: &[u8], mut meta: M) -> Result<(), SendError> {
        self.check_room(bytes.len())?;
        self.stamp(&mut meta)?;
        self.check_size(bytes.len(), &meta)?;
        self.forward(meta, bytes)
    }

    fn check_size(&self, found: usize, meta: &M) -> Result<(), SendError> {
        let described = meta.image_bytes();
        if found == described { Ok(()) } else { Err(self.size(found, described)) }
    }

    /// Sends without stamping or validation: for replay, and for tests that inject faults.
    pub fn send_image_unchecked(&mut self, mut loan: ImageLoan<M>, meta: M) -> Result<(), SendError> {
        *loan.sample.user_header_mut() = meta;
        loan.sample.send().map_err(|e| self.failed(&e))?;
        self.sent();
        Ok(())
    }
}
