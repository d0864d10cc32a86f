//! Channels of recordings and of the live bridge: names, schemas, and encoded messages.

use crate::standard;
use crate::standard::{Events, LogLine};
use carff_decision::Place;
use carff_messages::forms::AnyMessage;
use carff_messages::{Belief, FrameMeta, ImageMeta, Occupancy, Unknowns, ViewKind, ViewMeta};
use carff_transport::TopicId;
use foxglove::messages::RawImage;
use foxglove::{Encode, Schema};

/// Schema and encoding of a channel's messages.
#[derive(Clone, Copy, Debug)]
pub enum Format {
    /// Forms of a topic's messages, as JSON.
    Form(TopicId),
    /// Protobuf messages of a schema that other tools read.
    Protobuf(fn() -> Option<Schema>),
}

impl Format {
    /// Returns the encoding's name in MCAP files and in the Foxglove protocol.
    pub fn encoding(self) -> &'static str {
        match self {
            Self::Form(_) => "json",
            Self::Protobuf(_) => "protobuf",
        }
    }

    /// Returns the schema.
    pub fn schema(self) -> Option<Schema> {
        match self {
            Self::Form(topic) => {
                let (name, schema) = topic.schema();
                Some(Schema::new(name, "jsonschema", schema.to_string().into_bytes()))
            }
            Self::Protobuf(schema) => schema(),
        }
    }
}

/// A message of one channel.
#[derive(Clone, Debug)]
pub struct Encoded {
    /// Name of the channel: a topic's name, or a name for other tools.
    pub channel: String,
    /// Schema and encoding of the channel.
    pub format: Format,
    /// The encoded message.
    pub data: Vec<u8>,
}

impl Encoded {
    fn protobuf<M: Encode>(channel: impl Into<String>, message: &M) -> Self {
        let mut data = Vec::with_capacity(message.encoded_len().unwrap_or(0));
        // Encoding only fails if a buffer is full, and a vector grows.
        let _ = message.encode(&mut data);
        Self { channel: channel.into(), format: Format::Protobuf(M::get_schema), data }
    }
}

impl LogLine {
    /// Encodes the line for the channel `log`.
    pub fn encode(&self) -> Encoded {
        let Self { wall_ns, source, level, message } = self;
        Encoded::protobuf("log", &standard::log_line(*wall_ns, source, level, message))
    }
}

/// Encodes a run's messages for their channels.
///
/// No channel mixes sources: each camera, horizon step and hypothesis has its own.
#[derive(Debug)]
pub struct MessageEncoder {
    places: Vec<Place>,
    wall_offset_ns: u64,
    events: Events,
}

impl MessageEncoder {
    /// Creates an encoder. `places` are the places of the checkpoint. `wall_offset_ns` is the difference of wall-clock
    /// time (nanoseconds since 1970) and monotonic time.
    pub fn new(places: Vec<Place>, wall_offset_ns: u64) -> Self {
        Self { places, wall_offset_ns, events: Events::default() }
    }

    /// Returns a monotonic time as nanoseconds since 1970.
    pub fn wall_ns(&self, monotonic_ns: u64) -> u64 {
        monotonic_ns.saturating_add(self.wall_offset_ns)
    }

    /// Encodes a message for each of its channels, with an image before its description.
    pub fn encode(&mut self, topic: TopicId, message: AnyMessage<'_>) -> Result<Vec<Encoded>, serde_json::Error> {
        let header = message.header();
        let captured = standard::timestamp(self.wall_ns(header.capture_time_ns));
        let mut encoded = Vec::new();
        if let Some(meta) = message.get::<FrameMeta>() {
            let image = standard::image(captured, "camera", meta.size_px(), message.bytes());
            encoded.push(Encoded::protobuf("camera/image", &image));
            let calibration = standard::calibration(captured, "camera", meta.size_px(), &meta.intrinsics);
            encoded.push(Encoded::protobuf("camera/calibration", &calibration));
            let pose = standard::pose(captured, "camera", &meta.world_from_camera);
            encoded.push(Encoded::protobuf("camera/pose", &pose));
        } else if let Some(meta) = message.get::<ViewMeta>() {
            let camera = format!("renderer/{}", ViewKind::try_from(meta.kind).map_or("view", ViewKind::name));
            let image = standard::image(captured, &camera, meta.size_px(), message.bytes());
            let channel = format!("{camera}/step{}/hypothesis{}/image", header.step, meta.hypothesis);
            encoded.push(Encoded::protobuf(channel, &image));
            let calibration = standard::calibration(captured, &camera, meta.size_px(), &meta.intrinsics);
            encoded.push(Encoded::protobuf(format!("{camera}/calibration"), &calibration));
            let pose = standard::pose(captured, &camera, &meta.world_from_camera);
            encoded.push(Encoded::protobuf(format!("{camera}/pose"), &pose));
        } else if let Some(belief) = message.get::<Belief>().filter(|_| !self.places.is_empty()) {
            let boxes = standard::boxes(captured, belief, &self.places);
            encoded.push(Encoded::protobuf(format!("prober/boxes/step{}", header.step), &boxes));
        } else if let Some(unknowns) = message.get::<Unknowns>() {
            encoded.push(Encoded::protobuf("prober/boxes/unknown", &standard::unknown_boxes(captured, unknowns)));
        }
        if let Some(occupancy) = message.get::<Occupancy>() {
            let grid = standard::grid(captured, occupancy);
            encoded.push(Encoded::protobuf(format!("prober/grid/step{}", header.step), &grid));
        }
        let published = standard::timestamp(self.wall_ns(header.publish_time_ns));
        encoded.extend(self.events.log(published, message).map(|log| Encoded::protobuf("log", &log)));
        let data = serde_json::to_vec(&message.to_json()?)?;
        encoded.push(Encoded { channel: topic.name().to_owned(), format: Format::Form(topic), data });
        Ok(encoded)
    }
}

/// Content of a channel that a [`crate::Reader`] reads.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Content {
    /// Forms of a topic's messages.
    Forms(TopicId),
    /// Images that a topic's messages describe.
    Images(TopicId),
}

impl Content {
    /// Returns the content of a channel; `None` for a channel that is not read.
    pub(crate) fn of(name: &str, encoding: &str, schema: &str) -> Option<Self> {
        let images = match name {
            "camera/image" => Some(TopicId::FRAME),
            // Older recordings have one channel for all views.
            "renderer/image" => Some(TopicId::VIEW),
            _ if name.starts_with("renderer/") && name.ends_with("/image") => Some(TopicId::VIEW),
            _ => None,
        };
        match images {
            Some(topic) => {
                let is_image = RawImage::get_schema().is_some_and(|s| s.name == schema);
                (encoding == "protobuf" && is_image).then_some(Self::Images(topic))
            }
            None => TopicId::all().find(|t| t.name() == name && encoding == "json").map(Self::Forms),
        }
    }

    /// Returns the name of the channel, or of the channels, with this content.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Forms(topic) => topic.name(),
            Self::Images(topic) if topic == TopicId::FRAME => "camera/image",
            Self::Images(_) => "renderer/*/image",
        }
    }
}
