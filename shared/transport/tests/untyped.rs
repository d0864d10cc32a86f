//! Tests of topics outside the graph, as probes open them: by name only.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use crate::common::{TestRun, frame, posterior};
use carff_messages::{FrameMeta, Header, ImageMeta, Invalid, Posterior, ZeroCopySend, message};
use carff_transport::{
    HeaderOnly, ImagePayload, Node, OpenTopic, Topic, TopicId, TopicLimits, monotonic_now_ns, topics,
};

/// A message that no program of this workspace knows.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, ZeroCopySend)]
#[type_name("stranger.Note.v1")]
struct Note {
    header: Header,
    values: [f32; 3],
    size_px: [u32; 2],
}

impl Note {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()
    }
}

message!(Note);

impl ImageMeta for Note {
    fn size_px(&self) -> [u32; 2] {
        self.size_px
    }
}

/// A message whose header is not at its beginning, and that is smaller than a header.
#[repr(C)]
#[derive(Clone, Copy, Debug, ZeroCopySend)]
#[type_name("stranger.Late.v1")]
struct Late {
    value: u64,
    header: Header,
}

impl Late {
    fn check(&self) -> Result<(), Invalid> {
        self.header.validate()
    }
}

message!(Late);

const FEW: TopicLimits = TopicLimits { max_subscribers: 3, max_nodes: 5, buffer: 4, ..topics::MESSAGES };
const NOTE: Topic<Note> = Topic::new("stranger/note", FEW, 500);
const IMAGE: Topic<ImagePayload<Note>> = Topic::new("stranger/image", topics::IMAGES, 500);
const OPINION: Topic<Posterior> = Topic::new("stranger/posterior", FEW, 500);
const EYE: Topic<ImagePayload<FrameMeta>> = Topic::new("stranger/frame", topics::IMAGES, 500);
const LATE: Topic<Late> = Topic::new("stranger/late", FEW, 500);

fn found(node: &Node, name: &str) -> (TopicId, OpenTopic) {
    let topic = node.open_topics().unwrap().into_iter().find(|topic| topic.name == name).unwrap();
    (topic.id(), topic)
}

/// The header and the size of an unknown type are received, whether it is a message or describes an image.
#[test]
fn headers_of_unknown_types_are_received() {
    let run = TestRun::new();
    let (stranger, probe) = (Node::open(&run.0, "stranger").unwrap(), Node::open(&run.0, "probe").unwrap());
    let mut notes = stranger.publisher(&NOTE).unwrap();
    let mut images = stranger.image_publisher(&IMAGE, 1000).unwrap();
    for (name, is_image, size) in [(NOTE.name, false, size_of::<Note>()), (IMAGE.name, true, 56 + 12)] {
        let (topic, open) = found(&probe, name);
        assert_eq!((topic.name(), topic.is_image(), open.message.as_str()), (name, is_image, "stranger.Note.v1"));
        assert_eq!(topic.ports(&probe).unwrap().publishers[0].name, "stranger");
        assert!(topic.publisher(&probe, 0).unwrap_err().to_string().contains("stranger.Note.v1"));
        let mut receivers = [topic.receiver(&probe).unwrap(), topic.polled_receiver(&probe).unwrap()];
        let note = Note { header: Header::of_frame(7, 1, 2), values: [1.5; 3], size_px: [2, 2] };
        if is_image {
            images.send_bytes(&[9; 12], note).unwrap();
        } else {
            notes.send(note).unwrap();
        }
        for receiver in &mut receivers {
            let received = receiver.next().unwrap().unwrap();
            let message = received.message();
            assert!(message.get::<HeaderOnly>().is_some());
            let header = message.header();
            assert_eq!((header.frame_id, header.run_id, header.capture_time_ns), (7, 77, 1));
            assert!((1..=monotonic_now_ns()).contains(&header.publish_time_ns));
            assert_eq!(message.size_bytes(), size, "{name}");
            assert_eq!(message.to_json().unwrap()["frame_id"], 7);
        }
    }
    assert_eq!(probe.counters().invalid(), 0);
}

/// A known type on a topic of another name is received whole.
#[test]
fn known_types_are_received_whole() {
    let run = TestRun::new();
    let (stranger, probe) = (Node::open(&run.0, "stranger").unwrap(), Node::open(&run.0, "probe").unwrap());
    let mut posteriors = stranger.publisher(&OPINION).unwrap();
    let mut frames = stranger.image_publisher(&EYE, 1000).unwrap();
    let mut opinions = found(&probe, OPINION.name).0.receiver(&probe).unwrap();
    let mut eyes = found(&probe, EYE.name).0.polled_receiver(&probe).unwrap();
    posteriors.send(posterior(3)).unwrap();
    frames.send_bytes(&[5; 6], frame(4, 2, 1)).unwrap();
    let received = opinions.next().unwrap().unwrap();
    assert_eq!(received.message().get::<Posterior>().unwrap().gaussian.mean[0], 3.0);
    let received = eyes.next().unwrap().unwrap();
    assert_eq!(received.message().get::<FrameMeta>().unwrap().header.frame_id, 4);
    assert_eq!(received.message().bytes(), &[5; 6]);
    assert_eq!(found(&probe, OPINION.name).0, found(&probe, OPINION.name).0);
}

/// A message that does not begin with a header is dropped and counted.
#[test]
fn messages_without_a_header_are_dropped() {
    let run = TestRun::new();
    let (stranger, probe) = (Node::open(&run.0, "stranger").unwrap(), Node::open(&run.0, "probe").unwrap());
    let mut late = stranger.publisher(&LATE).unwrap();
    let mut receiver = found(&probe, LATE.name).0.receiver(&probe).unwrap();
    late.send(Late { value: u64::MAX, header: Header::of_frame(1, 1, 1) }).unwrap();
    assert!(receiver.next().unwrap().is_none());
    assert_eq!(probe.counters().invalid(), 1);
}
