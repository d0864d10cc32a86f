//! Sends recorded messages in place of their stages.

use super::compare::{COMPARED, Replayed};
use anyhow::{Context, ensure};
use carff::terminal::Terminal;
use carff_messages::forms::{AnyMessage, OwnedMessage};
use carff_messages::{Action, Header, MAX_IMAGE_BYTES};
use carff_recording::{Entry, Reader};
use carff_transport::{AnyPublisher, AnyReceiver, Node, Run, Stop, TopicId, Waiter, Woken, monotonic_now_ns};
use rustix::event::{PollFd, PollFlags, Timespec, poll};
use std::collections::{BTreeMap, BTreeSet};
use std::io::{BufRead, IsTerminal, stdin};
use std::path::PathBuf;
use std::sync::mpsc::{Receiver, TryRecvError, channel};
use std::sync::{Arc, Mutex};

/// Number of frames whose new capture time is remembered.
const FRAMES: usize = 256;
/// Longest wait for a frame's decision, nanoseconds.
const PATIENCE_NS: u64 = 3_000_000_000;
/// Wait after the last frame, nanoseconds.
const LINGER_NS: u64 = 500_000_000;
/// Interval between two checks for answers, nanoseconds.
const LOOK_NS: u64 = 2_000_000;

/// Error of a replay by single steps without the input for a step.
pub(super) const NO_INPUT: &str = "standard input ended before the recording: `--step` sends one frame for each line; \
                                   start it in a terminal, or use `--rate` or `--verify`";

/// Timing of the next message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pace {
    /// At its recorded time, sped up by this factor.
    Rate(f64),
    /// Frames: at each press of Enter.
    OnEnter,
    /// Frames: after the decision on the previous frame.
    AfterEachDecision,
}

/// Plays a recording.
pub(super) struct Player {
    pub(super) recording: PathBuf,
    pub(super) topics: BTreeSet<TopicId>,
    pub(super) pace: Pace,
    /// Start of the played part, nanoseconds after the recording's first message.
    pub(super) from_ns: u64,
    pub(super) to_ns: u64,
    pub(super) terminal: Arc<Terminal>,
    /// Collects the graph's answers.
    pub(super) replayed: Option<Arc<Mutex<Replayed>>>,
}

/// A publisher for each played topic.
#[derive(Default)]
struct Publishers(BTreeMap<TopicId, Box<dyn AnyPublisher>>);

impl Publishers {
    /// Opens the topics; `largest_bytes` contains the size of each topic's largest image.
    fn open(node: &Node, wanted: &BTreeSet<TopicId>, largest_bytes: &BTreeMap<TopicId, usize>) -> anyhow::Result<Self> {
        let open = |topic: &TopicId| {
            let bytes = largest_bytes.get(topic).copied().unwrap_or(0);
            Ok((*topic, topic.publisher(node, bytes)?))
        };
        let flow = wanted.iter().filter(|topic| TopicId::FLOW.contains(topic));
        Ok(Self(flow.map(open).collect::<anyhow::Result<_>>()?))
    }

    fn send(&mut self, topic: TopicId, mut message: OwnedMessage, times: &mut Times) -> anyhow::Result<()> {
        let Some(publisher) = self.0.get_mut(&topic) else { return Ok(()) };
        if let Some(action) = message.get_mut::<Action>() {
            let valid_for_ns = action.valid_until_ns.saturating_sub(action.header.publish_time_ns);
            action.valid_until_ns = monotonic_now_ns() + valid_for_ns;
        }
        times.renew(message.header_mut());
        Ok(publisher.send(message.as_message())?)
    }
}

/// New capture times: equal for all messages of a frame, which keeps the frame's recorded age.
#[derive(Default)]
struct Times(BTreeMap<u64, u64>);

impl Times {
    fn renew(&mut self, header: &mut Header) {
        let age_ns = header.publish_time_ns.saturating_sub(header.capture_time_ns);
        let capture_ns = *self.0.entry(header.frame_id).or_insert_with(|| monotonic_now_ns().saturating_sub(age_ns));
        header.capture_time_ns = capture_ns;
        while self.0.len() > FRAMES {
            self.0.pop_first();
        }
    }
}

impl Player {
    /// Plays to the end, or until it is stopped.
    pub(super) fn play(self, run: &Run, stop: &Stop) -> anyhow::Result<()> {
        let node = Node::open(run, "replay")?;
        let waiter = Waiter::new(stop.clone());
        let largest_bytes = self.largest_images()?;
        let mut publishers = Publishers::open(&node, &self.topics, &largest_bytes)?;
        let mut back = Vec::new();
        for topic in COMPARED {
            if !self.topics.contains(&topic) {
                back.push(topic.polled_receiver(&node)?);
            }
        }
        let keys = (self.pace == Pace::OnEnter).then(keys);
        let mut reader = Reader::open(&self.recording)?;
        reader.select(self.topics.iter().copied())?;
        let mut times = Times::default();
        let (mut begun_ns, mut frames) = (0, 0_u64);
        while let Some(Entry { topic, message, wall_time_ns }) = reader.next()? {
            let header = *message.as_message().header();
            let at_ns = wall_time_ns.saturating_sub(reader.first_ns());
            if at_ns < self.from_ns || at_ns > self.to_ns {
                continue;
            }
            let is_frame = topic == TopicId::FRAME;
            let go_on = match self.pace {
                Pace::Rate(rate) => {
                    if begun_ns == 0 {
                        begun_ns = monotonic_now_ns();
                        self.terminal.note(&format!(
                            "replaying {} from {:.1} s",
                            self.recording.display(),
                            at_ns as f64 / 1e9
                        ));
                    }
                    // At rate 0 everything is sent at once.
                    let waited_ns = (at_ns - self.from_ns.min(at_ns)) as f64 / rate.max(1e-9);
                    let due_ns = begun_ns.saturating_add(waited_ns as u64);
                    let due_ns = if rate > 0.0 { due_ns } else { 0 };
                    self.look_until(&waiter, &mut back, due_ns, |_| false)?
                }
                Pace::OnEnter if is_frame => {
                    self.terminal.note(&format!("frame {}: press Enter", header.frame_id));
                    self.wait_for_key(&waiter, &mut back, keys.as_ref())?
                }
                Pace::OnEnter | Pace::AfterEachDecision => true,
            };
            if !go_on {
                return Ok(());
            }
            publishers.send(topic, message, &mut times)?;
            frames += u64::from(is_frame);
            if is_frame && self.pace == Pace::AfterEachDecision {
                let frame = header.frame_id;
                let until_ns = monotonic_now_ns() + PATIENCE_NS;
                let decided = |message: AnyMessage<'_>| {
                    message.get::<Action>().is_some_and(|a| a.is_decision() && a.based_on_frame == frame)
                };
                if !self.look_until(&waiter, &mut back, until_ns, decided)? {
                    return Ok(());
                }
                self.terminal.status(format!("replayed {frames} frames"));
            }
        }
        self.terminal.status(String::new());
        if reader.is_cut_off() {
            self.terminal.note("the recording is incomplete: it was replayed up to its last message");
        }
        // The last frame's results are still in progress.
        self.look_until(&waiter, &mut back, monotonic_now_ns() + LINGER_NS, |_| false)?;
        Ok(())
    }

    /// Receives answers until a time, or until `enough`; returns false on a stop.
    fn look_until(
        &self,
        waiter: &Waiter,
        back: &mut [Box<dyn AnyReceiver>],
        until_ns: u64,
        enough: impl Fn(AnyMessage<'_>) -> bool,
    ) -> anyhow::Result<bool> {
        loop {
            let mut is_enough = false;
            for receiver in back.iter_mut() {
                while let Some(message) = receiver.next()? {
                    is_enough |= enough(message.message());
                    if let Some(replayed) = &self.replayed {
                        let mut replayed = replayed.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
                        replayed.take(message.message());
                    }
                }
            }
            let now_ns = monotonic_now_ns();
            if is_enough || now_ns >= until_ns {
                return Ok(!waiter.stop().is_stopped());
            }
            if waiter.wait_until(&[], (now_ns + LOOK_NS).min(until_ns))? == Woken::Stopped {
                return Ok(false);
            }
        }
    }

    fn wait_for_key(
        &self,
        waiter: &Waiter,
        back: &mut [Box<dyn AnyReceiver>],
        keys: Option<&Receiver<()>>,
    ) -> anyhow::Result<bool> {
        let Some(keys) = keys else { return Ok(true) };
        loop {
            match keys.try_recv() {
                Ok(()) => return Ok(true),
                Err(TryRecvError::Disconnected) => {
                    // The last frame's results are still in progress.
                    self.look_until(waiter, back, monotonic_now_ns() + LINGER_NS, |_| false)?;
                    ensure!(stdin().is_terminal(), NO_INPUT);
                    return Ok(false);
                }
                Err(TryRecvError::Empty) => {}
            }
            if !self.look_until(waiter, back, monotonic_now_ns() + 10 * LOOK_NS, |_| false)? {
                return Ok(false);
            }
        }
    }

    /// Returns the size of the largest image of each topic, bytes.
    fn largest_images(&self) -> anyhow::Result<BTreeMap<TopicId, usize>> {
        let mut largest = BTreeMap::from([(TopicId::FRAME, 1), (TopicId::VIEW, 1)]);
        let mut reader = Reader::open(&self.recording)?;
        reader.select(self.topics.iter().copied().filter(|topic| topic.is_image()))?;
        while let Some(entry) = reader.next().context("the recording cannot be replayed")? {
            let bytes = entry.message.as_message().bytes().len().min(MAX_IMAGE_BYTES);
            let known = largest.entry(entry.topic).or_default();
            *known = bytes.max(*known);
        }
        Ok(largest)
    }
}

/// Returns true unless standard input has ended. It does not wait for input.
pub(super) fn has_input() -> bool {
    let waiting = poll(&mut [PollFd::new(&stdin(), PollFlags::IN)], Some(&Timespec::default())).is_ok_and(|n| n > 0);
    stdin().is_terminal() || !waiting || stdin().lock().fill_buf().is_ok_and(|bytes| !bytes.is_empty())
}

/// Returns a channel with a message for each line of standard input; a thread reads it, because a read cannot be
/// interrupted.
fn keys() -> Receiver<()> {
    let (sender, receiver) = channel();
    std::thread::spawn(move || {
        for line in stdin().lock().lines() {
            if line.is_err() || sender.send(()).is_err() {
                return;
            }
        }
    });
    receiver
}

#[cfg(test)]
mod tests {
    use super::*;

    /// All messages of a frame get one capture time, with the frame's recorded age.
    #[test]
    fn a_frame_is_captured_once() {
        let mut times = Times::default();
        let recorded = Header { publish_time_ns: 1_000_500, ..Header::of_frame(3, 1_000_000, 1) };
        let (mut first, mut second) = (recorded, Header { publish_time_ns: 9_000_000, ..recorded });
        let before_ns = monotonic_now_ns();
        times.renew(&mut first);
        times.renew(&mut second);
        assert_eq!(first.capture_time_ns, second.capture_time_ns);
        assert!(first.capture_time_ns + 500 >= before_ns);
    }
}
