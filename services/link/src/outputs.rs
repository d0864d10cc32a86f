//! The publishers of the run on the receiving machine, each opened when its first message is there.

use crate::wire::Arrived;
use carff_messages::{
    Action, Belief, Forecast, FrameMeta, Health, Invalid, Message, ImageMeta, Posterior, Stage, ViewMeta,
    ZeroCopySend,
};
use carff_transport::{Node, OpenError, Image, Publisher, Topic, SendError, topics};
use std::collections::BTreeMap;
use std::fmt::Debug;

/// Publishes what has arrived.
#[derive(Debug)]
pub struct Outputs<'a> {
    // Dropped before the node, which is somebody else's.
    frame: Option<Pictures<FrameMeta>>,
    posterior: Option<Publisher<Posterior>>,
    forecast: Option<Publisher<Forecast>>,
    belief: Option<Publisher<Belief>>,
    view: Option<Pictures<ViewMeta>>,
    action: Option<Publisher<Action>>,
    health: BTreeMap<Stage, Publisher<Health>>,
    node: &'a Node,
}

/// A publisher of pictures of at most so many bytes.
#[derive(Debug)]
struct Pictures<M: ImageMeta + ZeroCopySend + Debug + 'static> {
    publisher: Publisher<Image<M>>,
    max_bytes: usize,
}

/// Why a valid message was not published.
#[derive(Debug, thiserror::Error)]
pub enum OutputError {
    /// The topic cannot be opened.
    #[error(transparent)]
    Open(#[from] OpenError),
    /// No memory can be set aside for it.
    #[error("no memory for it: {0}")]
    Memory(#[from] std::io::Error),
    /// It could not be sent.
    #[error(transparent)]
    Send(#[from] SendError),
    /// It is of no stage that there is.
    #[error(transparent)]
    Invalid(#[from] Invalid),
}

impl<'a> Outputs<'a> {
    /// For the run that a node is in.
    pub fn new(node: &'a Node) -> Self {
        Self {
            frame: None,
            posterior: None,
            forecast: None,
            belief: None,
            view: None,
            action: None,
            health: BTreeMap::new(),
            node,
        }
    }

    /// Publishes a valid message as it is, sequence number included, and a picture's bytes with it.
    pub fn publish(&mut self, arrived: &Arrived, picture: &[u8]) -> Result<(), OutputError> {
        let node = self.node;
        match arrived {
            Arrived::Frame(m) => send_picture(node, &topics::FRAME, &mut self.frame, **m, picture),
            Arrived::View(m) => send_picture(node, &topics::VIEW, &mut self.view, **m, picture),
            Arrived::Posterior(m) => send(node, &topics::POSTERIOR, &mut self.posterior, *m),
            Arrived::Forecast(m) => send(node, &topics::FORECAST, &mut self.forecast, **m),
            Arrived::Belief(m) => send(node, &topics::BELIEF, &mut self.belief, **m),
            Arrived::Action(m) => send(node, &topics::ACTION, &mut self.action, *m),
            Arrived::Health(m) => {
                let stage = m.stage()?;
                let mut publisher = self.health.remove(&stage);
                let sent = send(node, topics::health(stage), &mut publisher, *m);
                self.health.extend(publisher.map(|publisher| (stage, publisher)));
                sent
            }
        }
    }
}

fn send<M>(node: &Node, topic: &Topic<M>, slot: &mut Option<Publisher<M>>, message: M) -> Result<(), OutputError>
where
    M: Message + ZeroCopySend + Debug + 'static,
{
    if slot.is_none() {
        *slot = Some(node.publisher(topic)?);
        reserve(node, slot)?;
    }
    if let Some(publisher) = slot {
        publisher.send_unchecked(message)?;
    }
    Ok(())
}

fn send_picture<M>(
    node: &Node,
    topic: &Topic<Image<M>>,
    slot: &mut Option<Pictures<M>>,
    meta: M,
    picture: &[u8],
) -> Result<(), OutputError>
where
    M: ImageMeta + ZeroCopySend + Debug + 'static,
{
    if slot.as_ref().is_none_or(|pictures| pictures.max_bytes < picture.len()) {
        // The smaller one's place is freed first.
        *slot = None;
        let publisher = node.image_publisher(topic, picture.len())?;
        *slot = Some(Pictures { publisher, max_bytes: picture.len() });
        reserve(node, slot)?;
    }
    if let Some(Pictures { publisher, .. }) = slot {
        let mut loan = publisher.loan(picture.len())?;
        loan.bytes_mut().copy_from_slice(picture);
        publisher.send_unchecked(loan, meta)?;
    }
    Ok(())
}

/// Sets memory aside for what was just opened, or gives it up: written to without, it may end this process.
fn reserve<P>(node: &Node, slot: &mut Option<P>) -> std::io::Result<()> {
    let reserved = node.run().reserve_shared_memory();
    if reserved.is_err() {
        *slot = None;
    }
    reserved
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Gaussian, Header, HealthState, Intrinsics, ViewKind};
    use carff_transport::{Run, remove_run_leftovers};

    /// What is published arrives as it was, numbers and times included; pictures may grow on the way; heartbeats of each
    /// stage have their own topic.
    #[test]
    fn messages_are_published_as_they_are() {
        let run = Run::new(&format!("link-out-{}", std::process::id()), 5).unwrap();
        let header = Header { run_id: 5, sequence: 77, publish_time_ns: 9, ..Header::of_frame(3, 4, 1) };
        {
            let node = Node::open(&run, "test").unwrap();
            let mut posteriors = node.receiver(&topics::POSTERIOR).unwrap();
            let mut views = node.receiver(&topics::VIEW).unwrap();
            let mut hearts = node.receiver(topics::health(Stage::Prober)).unwrap();
            let mut outputs = Outputs::new(&node);

            let posterior = Posterior { header, gaussian: Gaussian::standard(), stage_latency_ns: 5 };
            outputs.publish(&Arrived::Posterior(posterior), &[]).unwrap();
            assert_eq!(posteriors.next().unwrap().as_deref(), Some(&posterior));

            for side_px in [2_u32, 4, 3] {
                let intrinsics = Intrinsics { fl_x_px: 1.0, fl_y_px: 1.0, cx_px: 1.0, cy_px: 1.0 };
                let (kind, width_px, height_px) = (ViewKind::ALL[0].code(), side_px, side_px);
                let meta = ViewMeta { header, kind, width_px, height_px, intrinsics, ..ViewMeta::default() };
                let picture: Vec<u8> = (0..side_px * side_px * 3).map(|i| i as u8 ^ 0x5a).collect();
                outputs.publish(&Arrived::View(meta.into()), &picture).unwrap();
                let got = views.next().unwrap().unwrap();
                assert_eq!((got.meta(), got.bytes()), (&meta, &picture[..]));
            }

            let health = Health {
                header,
                stage: Stage::Prober.code(),
                state: HealthState::Ok.code(),
                pid: 1,
                reserved: 0,
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
            outputs.publish(&Arrived::Health(health), &[]).unwrap();
            assert_eq!(hearts.next().unwrap().as_deref(), Some(&health));
            assert_eq!(node.counters().invalid(), 0);
        }
        remove_run_leftovers(&run).unwrap();
    }
}
