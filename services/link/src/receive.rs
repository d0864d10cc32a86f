//! The receiving end: a run that publishes the messages of the link.

use crate::address::AddressArgs;
use crate::clock::ClockDifference;
use crate::outputs::TopicOutputs;
use crate::wire::{Tag, decode, settle};
use crate::{note, topics};
use anyhow::{Context, anyhow};
use carff_config::GraphConfig;
use carff_observe::{RunLock, RunRecord};
use carff_transport::{Node, Run, Stop, TopicId, monotonic_now_ns, remove_run_leftovers, run_id_of, runtime_dir};
use clap::Args;
use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::time::{Duration, SystemTime};
use zenoh::Wait;
use zenoh::handlers::RingChannel;
use zenoh::sample::Sample;

/// Most messages that wait to be published; one more drops the oldest.
const WAITING: usize = 32;
/// Longest wait for a message before a look at the stop.
const LOOK: Duration = Duration::from_millis(100);
/// Time between two cleanings after dead observers, and between two lines about lost messages, nanoseconds.
const TELL_NS: u64 = 1_000_000_000;
/// Time without a message after which the receiver reports it, nanoseconds.
const QUIET_NS: u64 = 2_000_000_000;

/// The run that is received, and its description on this machine.
#[derive(Clone, Debug, Args)]
pub struct ReceiveArgs {
    /// The run's name on the sending machine.
    #[arg(long, value_parser = topics::run_name)]
    run: String,
    /// The run's name on this machine. Default: the same.
    #[arg(long = "as", value_name = "NAME", value_parser = topics::run_name)]
    name: Option<String>,
    /// The vehicle's graph file: recordings store it, and it names dataset and models.
    #[arg(long)]
    graph: PathBuf,
    /// Dataset folder, in place of the graph file's.
    #[arg(long)]
    dataset: Option<PathBuf>,
    /// Checkpoint folder, in place of the graph file's.
    #[arg(long)]
    checkpoint: Option<PathBuf>,
    /// The other end.
    #[command(flatten)]
    address: AddressArgs,
}

/// Receives until a stop.
pub fn run(args: &ReceiveArgs, stop: &Stop) -> anyhow::Result<()> {
    let graph = GraphConfig::load(&args.graph)?;
    let name = args.name.as_ref().unwrap_or(&args.run);
    let run = Run::new(name, run_id_of(name, monotonic_now_ns()))?;
    let absolute = |path: &Path| std::path::absolute(path).map(|p| p.display().to_string());
    let record = RunRecord {
        pid: std::process::id(),
        run_id: run.id(),
        graph: absolute(&args.graph)?,
        dataset: absolute(&graph.resolve(args.dataset.as_ref().unwrap_or(&graph.run.dataset)))?,
        checkpoint: absolute(&graph.resolve(args.checkpoint.as_ref().unwrap_or(&graph.run.checkpoint)))?,
        started_unix_s: SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs(),
    };
    let lock = RunLock::take(&runtime_dir(), name, &record, "--as")?;
    lock.sweep(&run, "--as")?;
    note(&format!(
        "run `{name}`; a renderer joins it with --graph {} --run {name} --run-id {}",
        record.graph,
        run.id()
    ));
    let result = Node::open(&run, "link").map_err(anyhow::Error::from).and_then(|node| receive(args, &node, stop));
    // The lock is held, so that all leftovers are of this run.
    remove_run_leftovers(&run)?;
    result
}

fn receive(args: &ReceiveArgs, node: &Node, stop: &Stop) -> anyhow::Result<()> {
    let session = args.address.open()?;
    let arrivals = session
        .declare_subscriber(topics::keys(&args.run))
        .with(RingChannel::new(WAITING))
        .wait()
        .map_err(anyhow::Error::from_boxed)
        .context("cannot receive")?;
    let mut end = End {
        run: &args.run,
        node,
        outputs: TopicOutputs::new(node),
        clock: ClockDifference::default(),
        told_sender: None,
        tally: Tally::default(),
    };
    let mut tell_ns = monotonic_now_ns() + TELL_NS;
    while !stop.is_stopped() {
        if let Some(sample) = arrivals.recv_timeout(LOOK).map_err(anyhow::Error::from_boxed)? {
            end.take(&sample);
        }
        let now_ns = monotonic_now_ns();
        if now_ns >= tell_ns {
            tell_ns = now_ns + TELL_NS;
            node.cleanup_dead();
            end.tell(now_ns);
        }
    }
    end.tally.summary();
    Ok(())
}

struct End<'a> {
    /// The run's name on the sending machine.
    run: &'a str,
    node: &'a Node,
    outputs: TopicOutputs<'a>,
    clock: ClockDifference,
    told_sender: Option<u64>,
    tally: Tally,
}

impl End<'_> {
    /// Reports what is new.
    fn tell(&mut self, now_ns: u64) {
        let sender = self.clock.sender();
        if std::mem::replace(&mut self.told_sender, sender) != sender {
            let seconds = self.clock.difference_ns() as f64 / 1e9;
            note(&format!(
                "a sender is there; its clock is {seconds:.3} s behind this one's, and times are moved by that"
            ));
        }
        self.tally.tell(now_ns);
    }

    /// Publishes a message, or counts it as refused.
    fn take(&mut self, sample: &Sample) {
        let now_ns = monotonic_now_ns();
        let key = sample.key_expr().as_str();
        let topic = topics::of_key(self.run, key);
        match topic
            .ok_or_else(|| anyhow!("there is no such topic"))
            .and_then(|topic| self.publish(topic, sample, now_ns))
        {
            Ok(()) => self.tally.arrived(now_ns),
            Err(error) => self.tally.refused(key, &error),
        }
    }

    fn publish(&mut self, topic: TopicId, sample: &Sample, now_ns: u64) -> anyhow::Result<()> {
        let form = sample.attachment().map(zenoh::bytes::ZBytes::to_bytes).unwrap_or_default();
        let (tag, mut message) = decode(topic, &form, sample.payload().to_bytes().into_owned())?;
        self.clock.observe(tag.sender, tag.sent_ns, now_ns);
        self.tally.count(topic, tag);
        settle(&mut message, self.node.run().id(), |there_ns| self.clock.here_ns(there_ns));
        self.outputs.publish(topic, message.as_message())
    }
}

/// Counts of the messages that arrived, were lost and were refused.
#[derive(Debug, Default)]
struct Tally {
    topics: BTreeMap<TopicId, Line>,
    refused: u64,
    /// Time of the last message; `None` before the first.
    last_ns: Option<u64>,
    quiet: bool,
    told_lost: u64,
}

#[derive(Debug, Default)]
struct Line {
    sender: Option<u64>,
    /// Number of the next message if none is missing.
    expected: u64,
    arrived: u64,
    lost: u64,
}

impl Tally {
    fn count(&mut self, topic: TopicId, tag: Tag) {
        let line = self.topics.entry(topic).or_default();
        if line.sender.replace(tag.sender) == Some(tag.sender) {
            line.lost = line.lost.saturating_add(tag.sequence.saturating_sub(line.expected));
        }
        line.expected = tag.sequence.saturating_add(1);
        line.arrived += 1;
    }

    fn arrived(&mut self, now_ns: u64) {
        let before_ns = self.last_ns.replace(now_ns);
        if let (true, Some(before_ns)) = (std::mem::take(&mut self.quiet), before_ns) {
            note(&format!("messages come again, after {:.1} s", now_ns.saturating_sub(before_ns) as f64 / 1e9));
        }
    }

    /// Counts each; of a flood it reports ever fewer.
    fn refused(&mut self, key: &str, error: &anyhow::Error) {
        self.refused += 1;
        if self.refused <= 8 || self.refused.is_power_of_two() {
            note(&format!("dropped, {} so far: {key}: {error:#}", self.refused));
        }
    }

    fn lost(&self) -> u64 {
        self.topics.values().fold(0, |sum, line| sum.saturating_add(line.lost))
    }

    fn tell(&mut self, now_ns: u64) {
        if self.last_ns.is_some_and(|last_ns| now_ns.saturating_sub(last_ns) > QUIET_NS) && !self.quiet {
            self.quiet = true;
            note("nothing comes: the link is cut, or the run has ended");
        }
        let lost = self.lost();
        if lost > self.told_lost {
            self.told_lost = lost;
            let each: Vec<String> =
                self.topics.iter().filter(|(_, l)| l.lost > 0).map(|(t, l)| format!("{t} {}", l.lost)).collect();
            note(&format!("lost on the way so far: {}", each.join(", ")));
        }
    }

    fn summary(&self) {
        for (topic, line) in &self.topics {
            println!("{topic}: {} received, {} lost on the way", line.arrived, line.lost);
        }
        println!("{} dropped", self.refused);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A gap in a topic's numbers is a loss; the numbers of another sender start again, which is not a loss.
    #[test]
    fn gaps_are_counted() {
        let mut tally = Tally::default();
        let mut count = |topic, sender, sequence| tally.count(topic, Tag { sender, sequence, sent_ns: 0 });
        for sequence in [5, 6, 9, 10] {
            count(TopicId::BELIEF, 1, sequence);
        }
        count(TopicId::ACTION, 1, 70);
        count(TopicId::ACTION, 2, 0);
        count(TopicId::ACTION, 2, 2);
        count(TopicId::ACTION, 2, u64::MAX);
        count(TopicId::ACTION, 2, 0);
        assert_eq!((tally.topics[&TopicId::BELIEF].lost, tally.topics[&TopicId::BELIEF].arrived), (2, 4));
        assert_eq!(tally.topics[&TopicId::ACTION].lost, 1 + (u64::MAX - 3));
    }
}
