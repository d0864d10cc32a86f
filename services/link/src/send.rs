//! The sending end: observes a run, and puts its messages on the link.

use crate::address::AddressArgs;
use crate::wire::{Tag, encode};
use crate::{note, topics};
use anyhow::{Context, ensure};
use carff_messages::forms::AnyMessage;
use carff_observe::{AttachError, Attached, attach, runs};
use carff_transport::{Run, Stop, TopicId, Waiter, Woken, living_processes, monotonic_now_ns};
use clap::Args;
use std::collections::BTreeSet;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

/// Time between two looks at the run, the same for all observers, nanoseconds.
const LOOK_NS: u64 = 10_000_000;
/// Time between two checks for receivers and for the life of the run, nanoseconds.
const CHECK_NS: u64 = 200_000_000;
/// Time between two lines about missed messages, nanoseconds.
const TELL_NS: u64 = 1_000_000_000;
/// Most messages of a topic that one look takes.
const MAX_TAKEN: usize = 64;

/// The topics that are sent, and the address of the receiver.
#[derive(Clone, Debug, Args)]
pub struct SendArgs {
    /// The run, which need not have started.
    #[arg(long, value_parser = topics::run_name)]
    run: String,
    /// Topics, separated by commas: full names or their last parts, `health` for all heartbeats, `all` for everything,
    /// camera frames included.
    #[arg(long, default_value = "belief,action,view,health")]
    topics: String,
    /// The other end.
    #[command(flatten)]
    address: AddressArgs,
}

/// Sends until a stop.
pub fn run(args: &SendArgs, stop: &Stop) -> anyhow::Result<()> {
    let mut chosen = BTreeSet::new();
    for name in args.topics.split(',') {
        chosen.extend(topics::parse(name.trim()).map_err(anyhow::Error::msg)?);
    }
    ensure!(!chosen.is_empty(), "name at least one topic with --topics");
    let session = args.address.open()?;
    // A number for this process among all senders.
    let sender = monotonic_now_ns() ^ (u64::from(std::process::id()) << 40);
    let declare = |topic| Way::declare(&session, &args.run, topic, sender);
    let mut ways = chosen.into_iter().map(declare).collect::<anyhow::Result<Vec<_>>>()?;
    let waiter = Waiter::new(stop.clone());
    let mut told_waiting = false;
    while !stop.is_stopped() {
        if let Some(attached) = join(&args.run)? {
            note(&format!("run `{}` joined, {} topics", args.run, ways.len()));
            forward(&attached, &mut ways, &waiter)?;
            if !stop.is_stopped() {
                note(&format!("run `{}` has ended", args.run));
            }
            told_waiting = false;
        } else {
            if !std::mem::replace(&mut told_waiting, true) {
                note(&format!("waiting for run `{}`", args.run));
            }
            waiter.wait_until(&[], monotonic_now_ns() + CHECK_NS)?;
        }
    }
    for way in &ways {
        println!(
            "{}: {} sent, {} with nobody to receive them, {} missed",
            way.topic, way.sent, way.unheard, way.missed
        );
    }
    Ok(())
}

/// Joins a run, if there is one. A launcher joins its run after it removed what an earlier run left. Until then an
/// observer would count as a process of the earlier run, and block the launch.
fn join(name: &str) -> Result<Option<Attached>, AttachError> {
    let Some(live) = runs()?.into_iter().find(|live| live.name == name) else { return Ok(None) };
    if !living_processes(&Run::new(name, live.run_id)?).is_ok_and(|living| living.contains(&live.pid)) {
        return Ok(None);
    }
    match attach(Some(name), "link") {
        Err(AttachError::NoRun | AttachError::NoSuchRun { .. }) => Ok(None),
        joined => joined.map(Some),
    }
}

/// Sends a run's messages until its end, or until a stop.
fn forward(attached: &Attached, ways: &mut [Way], waiter: &Waiter) -> anyhow::Result<()> {
    let open = |way: &Way| way.topic.polled_receiver(&attached.node);
    let mut receivers = ways.iter().map(open).collect::<Result<Vec<_>, _>>()?;
    let (mut check_ns, mut tell_ns, mut told) = (0, 0, 0);
    let mut heard = false;
    loop {
        let now_ns = monotonic_now_ns();
        if now_ns >= check_ns {
            check_ns = now_ns + CHECK_NS;
            for way in &mut *ways {
                way.look_for_receivers()?;
            }
            if std::mem::replace(&mut heard, ways.iter().any(|way| way.heard)) != heard {
                note(if heard { "linked" } else { "not linked: nobody receives" });
            }
            if !attached.live.is_alive() {
                return Ok(());
            }
        }
        for (way, receiver) in ways.iter_mut().zip(&mut receivers) {
            for _ in 0..MAX_TAKEN {
                let Some(received) = receiver.next()? else { break };
                way.send(received.message())?;
            }
        }
        let missed = ways.iter().map(|way| way.missed).sum();
        if missed > told && now_ns >= tell_ns {
            (told, tell_ns) = (missed, now_ns + TELL_NS);
            note(&format!("{missed} messages so far were gone before this process came to send them"));
        }
        if waiter.wait_until(&[], monotonic_now_ns() + LOOK_NS)? == Woken::Stopped {
            return Ok(());
        }
    }
}

/// The way of a topic to the link.
struct Way {
    topic: TopicId,
    publisher: Publisher<'static>,
    /// True if there is a receiver.
    heard: bool,
    sender: u64,
    sequence: u64,
    /// Sequence number of the next message if none is missing.
    expected: Option<u64>,
    sent: u64,
    unheard: u64,
    missed: u64,
}

impl Way {
    fn declare(session: &Session, run: &str, topic: TopicId, sender: u64) -> anyhow::Result<Self> {
        // Small messages overtake images; a slow link drops messages and never blocks.
        let priority = if topic.is_image() { Priority::DataLow } else { Priority::DataHigh };
        let publisher = session
            .declare_publisher(topics::key(run, topic))
            .congestion_control(CongestionControl::Drop)
            .priority(priority)
            .wait()
            .map_err(anyhow::Error::from_boxed)
            .with_context(|| format!("cannot send {topic}"))?;
        Ok(Self { topic, publisher, heard: false, sender, sequence: 0, expected: None, sent: 0, unheard: 0, missed: 0 })
    }

    fn look_for_receivers(&mut self) -> anyhow::Result<()> {
        let status = self.publisher.matching_status().wait().map_err(anyhow::Error::from_boxed);
        self.heard = status.with_context(|| format!("cannot see who receives {}", self.topic))?.matching();
        Ok(())
    }

    fn send(&mut self, message: AnyMessage<'_>) -> anyhow::Result<()> {
        self.count_missed(message.header().sequence);
        let tag = Tag { sender: self.sender, sequence: self.sequence, sent_ns: monotonic_now_ns() };
        self.sequence += 1;
        if !self.heard {
            self.unheard += 1;
            return Ok(());
        }
        let put = self.publisher.put(message.bytes()).attachment(encode(message, tag)?);
        put.wait().map_err(anyhow::Error::from_boxed).with_context(|| format!("cannot send {}", self.topic))?;
        self.sent += 1;
        Ok(())
    }

    /// A publisher's numbers go up by one; those of a restarted stage begin again.
    fn count_missed(&mut self, sequence: u64) {
        let expected = self.expected.replace(sequence.saturating_add(1));
        self.missed += sequence.saturating_sub(expected.unwrap_or(sequence));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_observe::{RunLock, RunRecord};
    use carff_transport::{Node, remove_run_leftovers, runtime_dir};

    /// A run is joined after its launcher has joined it, and not while the launcher still clears up.
    #[test]
    fn the_launcher_joins_first() {
        let name = format!("link-join-{}", std::process::id());
        let run = Run::new(&name, 7).unwrap();
        let (graph, dataset, checkpoint) = ("g.toml".to_owned(), "d".to_owned(), "c".to_owned());
        let record = RunRecord { pid: std::process::id(), run_id: 7, graph, dataset, checkpoint, started_unix_s: 0 };
        assert!(join(&name).unwrap().is_none());
        let lock = RunLock::take(&runtime_dir(), &name, &record, "--run").unwrap();
        assert!(join(&name).unwrap().is_none());
        assert!(!run.folder().exists());
        let launcher = Node::open(&run, "launcher").unwrap();
        let joined = join(&name).unwrap().unwrap();
        assert_eq!(joined.live.run_id, 7);
        drop((joined, launcher, lock));
        remove_run_leftovers(&run).unwrap();
    }
}
