//! The sending end: looks at a run, and puts what it sees on the link.

use crate::address::AddressArgs;
use crate::wire::{Tag, encode};
use crate::{note, topics};
use anyhow::{Context, ensure};
use carff_messages::Header;
use carff_observe::{AttachError, Attached, attach, runs};
use carff_transport::{AnyReceiver, Received, TopicId};
use carff_transport::{Run, Stop, Waiter, Woken, living_processes, monotonic_now_ns};
use clap::Args;
use std::collections::BTreeSet;
use zenoh::pubsub::Publisher;
use zenoh::qos::{CongestionControl, Priority};
use zenoh::{Session, Wait};

/// Time between two looks at the run, as for all observers, nanoseconds.
const LOOK_NS: u64 = 10_000_000;
/// Time between two looks at who listens and whether the run lives, nanoseconds.
const CHECK_NS: u64 = 200_000_000;
/// Time between two lines about what is lost, nanoseconds.
const TELL_NS: u64 = 1_000_000_000;
/// Most messages of a topic that one look takes.
const MAX_TAKEN: usize = 64;

/// What is sent, and where to.
#[derive(Clone, Debug, Args)]
pub struct SendArgs {
    /// The run, which need not have started.
    #[arg(long, value_parser = topics::run_name)]
    run: String,
    /// Topics, with commas between: names, in full or their last part, `health` for all heartbeats, `all` for everything,
    /// camera frames too.
    #[arg(long, default_value = "belief,action,view,health")]
    topics: String,
    /// The other end.
    #[command(flatten)]
    address: AddressArgs,
}

/// Sends until it is told to stop.
pub fn run(args: &SendArgs, stop: &Stop) -> anyhow::Result<()> {
    let mut chosen = BTreeSet::new();
    for name in args.topics.split(',') {
        chosen.extend(topics::parse(name.trim()).map_err(anyhow::Error::msg)?);
    }
    ensure!(!chosen.is_empty(), "name at least one topic with --topics");
    let session = args.address.open()?;
    // Names this process among those that send.
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

/// Joins a run, if there is one. Its launcher is in it once it has cleared up what an earlier one left: whoever came before
/// would be taken for a process of that one, and stand in the way.
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

/// Sends what a run publishes until it ends, or until a stop.
fn forward(attached: &Attached, ways: &mut [Way], waiter: &Waiter) -> anyhow::Result<()> {
    let open = |way: &Way| AnyReceiver::open(&attached.node, way.topic);
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
                let Some(message) = receiver.next()? else { break };
                way.send(&message)?;
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

/// A topic's way out.
struct Way {
    topic: TopicId,
    publisher: Publisher<'static>,
    /// Whether somebody receives.
    heard: bool,
    sender: u64,
    sequence: u64,
    /// What the next message's header says, when none is missing.
    expected: Option<u64>,
    sent: u64,
    unheard: u64,
    missed: u64,
}

impl Way {
    fn declare(session: &Session, run: &str, topic: TopicId, sender: u64) -> anyhow::Result<Self> {
        // What is small overtakes pictures; on a slow link each is dropped rather than waited for.
        let priority = match topic {
            TopicId::FRAME | TopicId::VIEW => Priority::DataLow,
            _ => Priority::DataHigh,
        };
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

    fn send(&mut self, received: &Received) -> anyhow::Result<()> {
        let message = received.message();
        self.count_missed(message.header());
        let tag = Tag { sender: self.sender, sequence: self.sequence, sent_ns: monotonic_now_ns() };
        self.sequence += 1;
        if !self.heard {
            self.unheard += 1;
            return Ok(());
        }
        let picture = match received {
            Received::Frame(picture) => picture.bytes(),
            Received::View(picture) => picture.bytes(),
            _ => &[],
        };
        let put = self.publisher.put(picture).attachment(encode(message, tag)?);
        put.wait().map_err(anyhow::Error::from_boxed).with_context(|| format!("cannot send {}", self.topic))?;
        self.sent += 1;
        Ok(())
    }

    /// A publisher's numbers go up by one; those of a stage that was started again begin anew.
    fn count_missed(&mut self, header: &Header) {
        if let Some(expected) = self.expected {
            self.missed += header.sequence.saturating_sub(expected);
        }
        self.expected = Some(header.sequence.saturating_add(1));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_observe::RunRecord;
    use carff_transport::{Node, make_private_dir, remove_run_leftovers, runtime_dir};

    /// A run is joined once its launcher is in it, and not before, when that one still clears up.
    #[test]
    fn the_launcher_joins_first() {
        let name = format!("link-join-{}", std::process::id());
        let run = Run::new(&name, 7).unwrap();
        let (graph, dataset, checkpoint) = ("g.toml".to_owned(), "d".to_owned(), "c".to_owned());
        let record = RunRecord { pid: std::process::id(), run_id: 7, graph, dataset, checkpoint, started_unix_s: 0 };
        make_private_dir(&runtime_dir()).unwrap();
        let path = RunRecord::path(&runtime_dir(), &name);
        assert!(join(&name).unwrap().is_none());
        std::fs::write(&path, record.to_bytes().unwrap()).unwrap();
        assert!(join(&name).unwrap().is_none());
        assert!(!run.folder().exists());
        let launcher = Node::open(&run, "launcher").unwrap();
        let joined = join(&name).unwrap().unwrap();
        assert_eq!(joined.live.run_id, 7);
        drop((joined, launcher));
        std::fs::remove_file(path).unwrap();
        remove_run_leftovers(&run).unwrap();
    }
}
