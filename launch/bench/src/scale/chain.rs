//! Measures the transport's cost per stage with a chain of processes that pass an image on.
//!
//! Only the longest chain runs. Each relay reads an image from the frame topic of one run. It writes the image to the
//! next run, or to the run that leads back if the image's chain ends there. The same processes therefore measure all
//! lengths alternately, and no relay is woken without work.

use super::{Axis, Law, Row};
use crate::helper::{Helper, end_with_parent, say_ready};
use crate::stats::Times;
use anyhow::{Context, ensure};
use carff_messages::{DatasetView, FrameMeta, Header, Intrinsics};
use carff_transport::{
    ImagePayload, Node, Publisher, Receiver, Run, Stop, Waiter, Woken, monotonic_now_ns, remove_run_leftovers, topics,
};

/// Number of relays of the longest chain.
const MOST_RELAYS: usize = 8;
/// Side of the image, pixels: that of the shipped dataset.
const SIDE_PX: u32 = 128;
const IMAGE_BYTES: usize = (SIDE_PX * SIDE_PX * 3) as usize;
/// Number of images in a turn of one length.
const IMAGES_PER_TURN: usize = 50;
/// Time limit for an image.
const PATIENCE_NS: u64 = 5_000_000_000;
/// Id of all runs of a chain, which differ in their names.
const RUN_ID: u64 = 1;

/// Arguments of a relay process.
#[derive(Clone, Debug, clap::Args)]
pub struct RelayArgs {
    /// Name of the chain.
    chain: String,
    /// Place in the chain, from 1.
    place: usize,
    /// Number of relays of the chain.
    length: usize,
}

/// Returns the run that leads into the relay at a place.
fn run_into(chain: &str, place: usize) -> anyhow::Result<Run> {
    Ok(Run::new(&format!("{chain}-h{place}"), RUN_ID)?)
}

/// Returns the run that leads back from the relay at a place.
fn run_back(chain: &str, place: usize) -> anyhow::Result<Run> {
    Ok(Run::new(&format!("{chain}-b{place}"), RUN_ID)?)
}

/// Destination of a relay's image.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum To {
    Next,
    Back,
}

/// Returns the destination of the relay at `place` for an image that must pass `relays` relays, at most all of them.
fn route(place: usize, length: usize, relays: u64) -> To {
    if place as u64 >= relays || place >= length { To::Back } else { To::Next }
}

/// A publisher and its node. The node must outlive it.
struct Output {
    publisher: Publisher<ImagePayload<FrameMeta>>,
    _node: Node,
}

impl Output {
    fn open(run: &Run) -> anyhow::Result<Self> {
        let node = Node::open(run, "sender")?;
        Ok(Self { publisher: node.image_publisher(&topics::FRAME, IMAGE_BYTES)?, _node: node })
    }

    fn send(&mut self, bytes: &[u8], meta: &FrameMeta) -> anyhow::Result<()> {
        let mut loan = self.publisher.loan(bytes.len())?;
        loan.bytes_mut().copy_from_slice(bytes);
        Ok(self.publisher.send_image(loan, *meta)?)
    }
}

/// A receiver and its node.
struct Incoming {
    receiver: Receiver<ImagePayload<FrameMeta>>,
    _node: Node,
}

impl Incoming {
    fn open(run: &Run) -> anyhow::Result<Self> {
        let node = Node::open(run, "receiver")?;
        Ok(Self { receiver: node.receiver(&topics::FRAME)?, _node: node })
    }
}

/// Passes images on until standard input ends.
pub(crate) fn relay(args: &RelayArgs) -> anyhow::Result<()> {
    end_with_parent()?;
    let waiter = Waiter::new(Stop::on_signals()?);
    let mut input = Incoming::open(&run_into(&args.chain, args.place)?)?;
    let mut back = Output::open(&run_back(&args.chain, args.place)?)?;
    let mut next =
        if args.place < args.length { Some(Output::open(&run_into(&args.chain, args.place + 1)?)?) } else { None };
    say_ready()?;
    while waiter.wait(&[&input.receiver])? != Woken::Stopped {
        while let Some(image) = input.receiver.next()? {
            let meta = *image;
            let output = match (route(args.place, args.length, meta.header.seed), &mut next) {
                (To::Next, Some(next)) => next,
                _ => &mut back,
            };
            output.send(image.bytes(), &meta)?;
        }
    }
    Ok(())
}

/// The sending end of a chain, and the ends that lead back from each place. Dropping removes all runs.
struct Chain {
    name: String,
    // Dropped first: all ports of this process, then the relays, then the runs' files.
    ports: Option<(Output, Vec<Incoming>)>,
    relays: Vec<Helper>,
    waiter: Waiter,
    image: Vec<u8>,
    sent: u64,
}

impl Chain {
    fn start(length: usize) -> anyhow::Result<Self> {
        let mut chain = Self {
            name: format!("bench-{}", std::process::id()),
            ports: None,
            relays: Vec::new(),
            waiter: Waiter::new(Stop::on_signals()?),
            image: (0..IMAGE_BYTES).map(|i| (i * 31) as u8).collect(),
            sent: 0,
        };
        for place in 1..=length {
            let args = ["relay".to_owned(), chain.name.clone(), place.to_string(), length.to_string()];
            chain.relays.push(Helper::start(&args)?);
        }
        for relay in &mut chain.relays {
            relay.wait_ready()?;
        }
        let back = (1..=length).map(|place| Incoming::open(&run_back(&chain.name, place)?));
        let back = back.collect::<anyhow::Result<Vec<_>>>()?;
        chain.ports = Some((Output::open(&run_into(&chain.name, 1)?)?, back));
        Ok(chain)
    }

    /// Sends an image through `relays` relays. Returns the time from before its writing to after its reading, ms.
    fn pass(&mut self, relays: usize) -> anyhow::Result<f64> {
        let (output, back) = self.ports.as_mut().context("the chain is not open")?;
        let back = &mut back.get_mut(relays - 1).context("the chain is shorter than that")?.receiver;
        let started_ns = monotonic_now_ns();
        let meta = FrameMeta {
            header: Header::of_frame(self.sent, started_ns, relays as u64),
            width_px: SIDE_PX,
            height_px: SIDE_PX,
            intrinsics: Intrinsics { fl_x_px: 1.0, fl_y_px: 1.0, ..Intrinsics::default() },
            dataset_view: DatasetView::UNKNOWN,
            ..FrameMeta::default()
        };
        output.send(&self.image, &meta)?;
        let woken = self.waiter.wait_until(&[&*back], started_ns + PATIENCE_NS)?;
        ensure!(woken != Woken::Stopped, "interrupted");
        let image = back.newest()?.with_context(|| format!("an image was lost on its way past {relays} relays"))?;
        ensure!(image.header.frame_id == self.sent, "an image came back late");
        std::hint::black_box(image.bytes().iter().fold(0_u64, |sum, byte| sum + u64::from(*byte)));
        self.sent += 1;
        Ok((monotonic_now_ns() - started_ns) as f64 / 1e6)
    }

    /// Returns the processor time of the first relays, seconds.
    fn cpu_seconds(&self, relays: usize) -> f64 {
        self.relays.iter().take(relays).map(Helper::cpu_seconds).sum()
    }
}

impl Drop for Chain {
    fn drop(&mut self) {
        self.ports = None;
        let length = self.relays.len();
        self.relays.clear();
        for place in 1..=length {
            for run in [run_into(&self.name, place), run_back(&self.name, place)].into_iter().flatten() {
                // The next run of this name removes the rest.
                let _ = remove_run_leftovers(&run);
            }
        }
    }
}

/// Times of one length.
#[derive(Clone, Debug, Default)]
struct Passed {
    milliseconds: Vec<f64>,
    cpu_s: f64,
}

/// Measures all lengths alternately, every second round backwards.
pub(crate) fn measure(quick: bool) -> anyhow::Result<Axis> {
    let rounds = if quick { 4 } else { 40 };
    let mut chain = Chain::start(MOST_RELAYS)?;
    let mut passed = vec![Passed::default(); MOST_RELAYS];
    // The first round does not count.
    for round in 0..=rounds {
        for i in 0..MOST_RELAYS {
            let i = if round % 2 == 0 { i } else { MOST_RELAYS - 1 - i };
            let before_s = chain.cpu_seconds(i + 1);
            let times = (0..IMAGES_PER_TURN).map(|_| chain.pass(i + 1)).collect::<anyhow::Result<Vec<_>>>()?;
            if round > 0 {
                passed[i].cpu_s += chain.cpu_seconds(i + 1) - before_s;
                passed[i].milliseconds.extend(times);
            }
        }
    }
    Ok(Axis {
        key: "stages",
        title: "Stages: a chain of relay processes",
        x_label: "relay processes",
        each: "relay",
        law: Law::Linear,
        cost_key: "cpu_ms",
        cost_label: "CPU of the relays (ms per image)",
        rows: passed
            .into_iter()
            .enumerate()
            .map(|(i, passed)| {
                let count = passed.milliseconds.len();
                Row::new(i as u32 + 1, &Times::new(passed.milliseconds), passed.cpu_s * 1e3 / count as f64)
            })
            .collect(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

    /// An image passes exactly the requested relays of a chain in order, and comes back from the last one. If more
    /// relays are requested than exist, it comes back from the end.
    #[test]
    fn images_pass_the_requested_relays() {
        for length in 1..=MOST_RELAYS {
            for relays in 1..=MOST_RELAYS + 2 {
                let mut place = 1;
                while route(place, length, relays as u64) == To::Next {
                    place += 1;
                    assert!(place <= length, "the image goes past the last relay");
                }
                assert_eq!(place, relays.min(length));
            }
        }
    }

    /// All runs of a chain have different names, short enough for the largest process id.
    #[test]
    fn each_hop_has_its_own_run() {
        let chain = format!("bench-{}", 1 << 22);
        let names = (1..=MOST_RELAYS).flat_map(|p| [run_into(&chain, p).unwrap(), run_back(&chain, p).unwrap()]);
        assert_eq!(names.map(|run| run.name().to_owned()).collect::<HashSet<_>>().len(), 2 * MOST_RELAYS);
    }
}
