//! The publishers of the run on the receiving machine, each opened when its first message arrives.

use anyhow::Context;
use carff_messages::forms::AnyMessage;
use carff_transport::{AnyPublisher, Node, TopicId};
use std::collections::BTreeMap;
use std::collections::btree_map::Entry;

/// Publishes the messages that arrive.
#[derive(Debug)]
pub struct TopicOutputs<'a> {
    // Dropped before the node, which the caller owns.
    publishers: BTreeMap<TopicId, Box<dyn AnyPublisher>>,
    node: &'a Node,
}

impl<'a> TopicOutputs<'a> {
    /// Publishes in the run of a node.
    pub fn new(node: &'a Node) -> Self {
        Self { publishers: BTreeMap::new(), node }
    }

    /// Publishes a valid message unchanged, sequence number included.
    pub fn publish(&mut self, topic: TopicId, message: AnyMessage<'_>) -> anyhow::Result<()> {
        let bytes = message.bytes().len();
        // A publisher of smaller images frees its memory first.
        self.publishers.retain(|&open, publisher| open != topic || publisher.max_bytes() >= bytes);
        let publisher = match self.publishers.entry(topic) {
            Entry::Occupied(open) => open.into_mut(),
            Entry::Vacant(place) => {
                let publisher = topic.publisher(self.node, bytes)?;
                // Without reserved memory a write may end this process.
                self.node.run().reserve_shared_memory().context("no memory for it")?;
                place.insert(publisher)
            }
        };
        Ok(publisher.forward(message)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Gaussian, Header, Health, HealthState, Intrinsics, Posterior, Stage, ViewKind, ViewMeta};
    use carff_transport::{Run, remove_run_leftovers, topics};

    /// A message arrives unchanged, numbers and times included; images may grow; each stage's heartbeats have their own
    /// topic.
    #[test]
    fn messages_are_published_unchanged() {
        let run = Run::new(&format!("link-out-{}", std::process::id()), 5).unwrap();
        let header = Header { run_id: 5, sequence: 77, publish_time_ns: 9, ..Header::of_frame(3, 4, 1) };
        {
            let node = Node::open(&run, "test").unwrap();
            let mut posteriors = node.receiver(&topics::POSTERIOR).unwrap();
            let mut views = node.receiver(&topics::VIEW).unwrap();
            let mut hearts = node.receiver(topics::health(Stage::Prober)).unwrap();
            let mut outputs = TopicOutputs::new(&node);

            let posterior = Posterior { header, gaussian: Gaussian::standard(), take_start: 0, stage_latency_ns: 5 };
            outputs.publish(TopicId::POSTERIOR, AnyMessage::new(&posterior, &[])).unwrap();
            assert_eq!(posteriors.next().unwrap().as_deref(), Some(&posterior));

            for side_px in [2_u32, 4, 3] {
                let intrinsics = Intrinsics { fl_x_px: 1.0, fl_y_px: 1.0, cx_px: 1.0, cy_px: 1.0 };
                let (kind, width_px, height_px) = (ViewKind::ALL[0].code(), side_px, side_px);
                let meta = ViewMeta { header, kind, width_px, height_px, intrinsics, ..ViewMeta::default() };
                let image: Vec<u8> = (0..side_px * side_px * 3).map(|i| i as u8 ^ 0x5a).collect();
                outputs.publish(TopicId::VIEW, AnyMessage::new(&meta, &image)).unwrap();
                let got = views.next().unwrap().unwrap();
                assert_eq!((&*got, got.bytes()), (&meta, &image[..]));
            }

            let health = Health {
                header,
                stage: Stage::Prober.code(),
                state: HealthState::Ok.code(),
                pid: 1,
                received: 0,
                published: 0,
                skipped: 0,
                invalid: 0,
                errors: 0,
                last_latency_ns: 0,
                max_latency_ns: 0,
                last_progress_ns: 0,
                rss_bytes: 0,
            };
            outputs.publish(TopicId::health(Stage::Prober), AnyMessage::new(&health, &[])).unwrap();
            assert_eq!(hearts.next().unwrap().as_deref(), Some(&health));
            assert_eq!(node.counters().invalid(), 0);
        }
        remove_run_leftovers(&run).unwrap();
    }
}
