//! Channels of recordings and of the live bridge: names, schemas, and encoded messages.

use crate::{StandardMessage, standard_messages};
use carff_decision::Place;
use carff_messages::forms::AnyMessage;
use carff_transport::TopicId;
use foxglove::messages::{CameraCalibration, FrameTransform, RawImage, SceneUpdate};
use foxglove::{Encode, Schema};

/// A channel: a name with a schema of its messages.
#[derive(Clone, Debug)]
pub struct Channel {
    /// Name of the channel: a topic's name, or a name for other tools.
    pub name: &'static str,
    /// Encoding of the messages: `json` or `protobuf`.
    pub encoding: String,
    /// Schema of the messages.
    pub schema: Option<Schema>,
}

/// Returns all channels.
pub fn channels() -> Vec<Channel> {
    let mut channels: Vec<Channel> = TopicId::all()
        .map(|topic| {
            let (name, schema) = topic.schema();
            let schema = Schema::new(name, "jsonschema", schema.to_string().into_bytes());
            Channel { name: topic.name(), encoding: "json".to_owned(), schema: Some(schema) }
        })
        .collect();
    channels.extend([
        standard::<RawImage>("camera/image"),
        standard::<CameraCalibration>("camera/calibration"),
        standard::<FrameTransform>("camera/pose"),
        standard::<RawImage>("renderer/image"),
        standard::<SceneUpdate>("prober/boxes"),
    ]);
    channels
}

fn standard<M: Encode>(name: &'static str) -> Channel {
    Channel { name, encoding: M::get_message_encoding(), schema: M::get_schema() }
}

/// Encodes a message for each of its channels. An image comes before its description, so that a reader of the
/// description has the image. `wall_ns` is its publication time, nanoseconds since 1970.
pub fn encode(
    topic: TopicId,
    message: AnyMessage<'_>,
    places: &[Place],
    wall_ns: u64,
) -> Result<Vec<(&'static str, Vec<u8>)>, serde_json::Error> {
    let mut encoded: Vec<(&'static str, Vec<u8>)> = standard_messages(message, places, wall_ns)
        .iter()
        .map(|(name, standard)| {
            let bytes = match standard {
                StandardMessage::Image(m) => bytes(m),
                StandardMessage::Calibration(m) => bytes(m),
                StandardMessage::Pose(m) => bytes(m),
                StandardMessage::Boxes(m) => bytes(m),
            };
            (*name, bytes)
        })
        .collect();
    encoded.push((topic.name(), serde_json::to_vec(&message.to_json()?)?));
    Ok(encoded)
}

fn bytes<M: Encode>(message: &M) -> Vec<u8> {
    let mut bytes = Vec::with_capacity(message.encoded_len().unwrap_or(0));
    // Encoding only fails if a buffer is full, and a vector grows.
    let _ = message.encode(&mut bytes);
    bytes
}
