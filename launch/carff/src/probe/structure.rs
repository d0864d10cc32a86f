//! `carff probe list` and `graph`: the topics of a run and the processes that use them.

use crate::session::{Going, Session, SessionArgs};
use anyhow::Context;
use carff_messages::SCHEMA_VERSION;
use carff_transport::{Member, monotonic_now_ns};
use carff_transport::{Received, TopicId};
use serde_json::{Value, json};
use std::collections::{BTreeMap, BTreeSet};
use std::fmt::Write;

/// Default time over which rates are measured, seconds.
const COUNT_S: f64 = 2.0;

/// The format of a graph.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, clap::ValueEnum)]
pub enum GraphFormat {
    /// Plain text.
    #[default]
    Text,
    /// Graphviz.
    Dot,
    /// Mermaid, for Markdown viewers.
    Mermaid,
}

/// A topic of a run and its current users.
#[derive(Clone, Debug, PartialEq)]
struct TopicInUse {
    topic: TopicId,
    message: String,
    publishers: Vec<String>,
    subscribers: Vec<String>,
    /// Messages per second; none if not measured.
    rate_hz: Option<f64>,
}

pub(super) fn list(args: &SessionArgs, as_json: bool) -> anyhow::Result<()> {
    let seconds = args.seconds.unwrap_or(COUNT_S);
    let mut session = Session::open(&SessionArgs { seconds: Some(seconds), ..args.clone() }, PROBE)?;
    let mut topics = in_use(&session)?;
    session.listen(topics.iter().map(|t| t.topic))?;
    // Messages from the topic's history are not part of the rate.
    session.take(|_, _| Ok(()))?;
    let started_ns = monotonic_now_ns();
    let mut counts: BTreeMap<TopicId, u64> = BTreeMap::new();
    let going = session.follow(
        |topic, _: &dyn Received| {
            *counts.entry(topic).or_default() += 1;
            Ok(true)
        },
        || Ok(()),
    )?;
    let counted_s = (monotonic_now_ns() - started_ns) as f64 / 1e9;
    for topic in &mut topics {
        topic.rate_hz = Some(counts.get(&topic.topic).copied().unwrap_or(0) as f64 / counted_s);
    }
    if as_json {
        println!("{}", serde_json::to_string_pretty(&topics.iter().map(TopicInUse::json).collect::<Value>())?);
    } else {
        print!("{}", table(&topics));
    }
    session.say_end(if going == Going::RunEnded { going } else { Going::Done });
    Ok(())
}

pub(super) fn graph(args: &SessionArgs, format: GraphFormat) -> anyhow::Result<()> {
    let session = Session::open(args, PROBE)?;
    let topics = in_use(&session)?;
    print!(
        "{}",
        match format {
            GraphFormat::Text => text(&session.attached.live.name, &topics),
            GraphFormat::Dot => dot(&topics),
            GraphFormat::Mermaid => mermaid(&topics),
        }
    );
    Ok(())
}

/// The name under which these commands join a run; their output omits it.
const PROBE: &str = "probe-list";

fn in_use(session: &Session) -> anyhow::Result<Vec<TopicInUse>> {
    let node = &session.attached.node;
    let here = std::process::id();
    let names = |members: &[Member]| -> Vec<String> {
        members.iter().filter(|m| m.pid != here).map(|m| m.name.clone()).collect()
    };
    let mut topics = Vec::new();
    for open in node.open_topics().context("cannot list the topics")? {
        let topic = open.id();
        let ports = topic.ports(node)?;
        let (publishers, subscribers) = (names(&ports.publishers), names(&ports.subscribers));
        topics.push(TopicInUse { topic, message: open.message, publishers, subscribers, rate_hz: None });
    }
    // The data path first, in its order.
    topics.sort_by_key(|t| t.topic);
    Ok(topics)
}

impl TopicInUse {
    fn json(&self) -> Value {
        json!({
            "topic": self.topic.name(),
            "type": self.message,
            "schema_version": SCHEMA_VERSION,
            "publishers": self.publishers,
            "subscribers": self.subscribers,
            "rate_hz": self.rate_hz,
        })
    }
}

/// Formats rows with columns as wide as their widest entry.
pub(super) fn columns(rows: &[Vec<String>]) -> String {
    let count = rows.iter().map(Vec::len).max().unwrap_or(0);
    let widths: Vec<usize> = (0..count)
        .map(|i| rows.iter().filter_map(|r| r.get(i)).map(|c| c.chars().count()).max().unwrap_or(0))
        .collect();
    let mut text = String::new();
    for row in rows {
        let cells = row.iter().zip(&widths).map(|(cell, &width)| format!("{cell:<width$}"));
        text += cells.collect::<Vec<_>>().join("  ").trim_end();
        text.push('\n');
    }
    text
}

fn table(topics: &[TopicInUse]) -> String {
    let head = ["topic", "type", "schema", "from", "to", "rate"].map(str::to_owned).to_vec();
    let rows = topics.iter().map(|t| {
        let list = |names: &[String]| if names.is_empty() { "-".to_owned() } else { names.join(" ") };
        let rate = t.rate_hz.map_or("-".to_owned(), |hz| format!("{hz:.1} Hz"));
        let (from, to) = (list(&t.publishers), list(&t.subscribers));
        vec![t.topic.name().to_owned(), t.message.clone(), SCHEMA_VERSION.to_string(), from, to, rate]
    });
    columns(&std::iter::once(head).chain(rows).collect::<Vec<_>>())
}

fn text(run: &str, topics: &[TopicInUse]) -> String {
    let mut text = format!("run {run}\n");
    for topic in topics {
        let _ = writeln!(text, "{} ({})", topic.topic, topic.message);
        for (arrow, names) in [("<-", &topic.publishers), ("->", &topic.subscribers)] {
            for name in names {
                let _ = writeln!(text, "  {arrow} {name}");
            }
        }
    }
    text
}

fn processes(topics: &[TopicInUse]) -> BTreeSet<&String> {
    topics.iter().flat_map(|t| t.publishers.iter().chain(&t.subscribers)).collect()
}

fn dot(topics: &[TopicInUse]) -> String {
    let mut text = "digraph carff {\n  rankdir=LR;\n  node [shape=box, style=rounded];\n".to_owned();
    for process in processes(topics) {
        let _ = writeln!(text, "  {process:?};");
    }
    for topic in topics {
        let _ = writeln!(text, "  {:?} [shape=ellipse, style=solid];", topic.topic.name());
        for name in &topic.publishers {
            let _ = writeln!(text, "  {name:?} -> {:?};", topic.topic.name());
        }
        for name in &topic.subscribers {
            let _ = writeln!(text, "  {:?} -> {name:?};", topic.topic.name());
        }
    }
    text + "}\n"
}

fn mermaid(topics: &[TopicInUse]) -> String {
    let id = |name: &str| name.chars().map(|c| if c.is_ascii_alphanumeric() { c } else { '_' }).collect::<String>();
    let mut text = "flowchart LR\n".to_owned();
    for process in processes(topics) {
        let _ = writeln!(text, "  p_{}[{process}]", id(process));
    }
    for topic in topics {
        let name = id(topic.topic.name());
        let _ = writeln!(text, "  t_{name}([{}])", topic.topic);
        for process in &topic.publishers {
            let _ = writeln!(text, "  p_{} --> t_{name}", id(process));
        }
        for process in &topic.subscribers {
            let _ = writeln!(text, "  t_{name} --> p_{}", id(process));
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Posterior;
    use carff_transport::{Topic, topics};

    fn two() -> Vec<TopicInUse> {
        static OWN: Topic<Posterior> = Topic::new("my/topic", topics::MESSAGES, 500);
        let topic = |topic: TopicId, publishers: &[&str], subscribers: &[&str]| TopicInUse {
            topic,
            message: "carff.X.v1".to_owned(),
            publishers: publishers.iter().map(|&s| s.to_owned()).collect(),
            subscribers: subscribers.iter().map(|&s| s.to_owned()).collect(),
            rate_hz: Some(10.0),
        };
        vec![topic(TopicId::FRAME, &["camera"], &["encoder", "probe-image"]), topic(TopicId::of(&OWN), &["gate"], &[])]
    }

    /// Each format names every process and topic, with arrows from publisher to topic to subscriber.
    #[test]
    fn graphs_show_who_sends_to_whom() {
        let dot = dot(&two());
        assert!(
            dot.contains(r#""camera" -> "camera/frame";"#) && dot.contains(r#""camera/frame" -> "encoder";"#),
            "{dot}"
        );
        let mermaid = mermaid(&two());
        assert!(
            mermaid.contains("p_camera --> t_camera_frame") && mermaid.contains("p_gate --> t_my_topic"),
            "{mermaid}"
        );
        let text = text("r", &two());
        assert!(text.contains("<- camera") && text.contains("-> probe-image") && text.contains("<- gate"), "{text}");
        let table = table(&two());
        assert!(
            table.lines().nth(1).is_some_and(|l| l.contains("encoder probe-image") && l.contains("10.0 Hz")),
            "{table}"
        );
    }
}
