//! The common part of all probes: joining a run, reading at intervals, and detecting the end.

use crate::complete;
use anyhow::{Context, anyhow, ensure};
use carff_base::names::hint;
use carff_messages::Header;
use carff_observe::{AttachError, Attached, LiveRun, attach, find};
use carff_transport::{
    AnyReceiver, OpenTopic, Received, Run, Stop, TopicId, Waiter, living_processes, monotonic_now_ns,
};
use clap::Args;
use clap_complete::engine::ArgValueCandidates;
use std::mem::replace;

/// Time between two readings: short enough that no buffer (8 images) overflows at 400 messages per second.
const LOOK_NS: u64 = 10_000_000;
/// Time between two checks that the run is alive.
const ALIVE_NS: u64 = 200_000_000;

/// The run, and the time limit.
#[derive(Clone, Debug, Default, Args)]
pub struct SessionArgs {
    /// Name of the run; optional if only one runs.
    #[arg(long, add = ArgValueCandidates::new(complete::runs))]
    pub run: Option<String>,
    /// Stop after this time, seconds.
    #[arg(long, value_parser = positive)]
    pub seconds: Option<f64>,
}

/// The run, the time limit, and the runs after it.
#[derive(Clone, Debug, Default, Args)]
pub struct WaitArgs {
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
    /// Wait until a run starts, and wait again after its end, until a stop is requested or the time is over.
    #[arg(long)]
    pub wait: bool,
}

/// The runs that a command observes, one after another.
#[derive(Debug)]
pub(crate) struct Sessions<'a> {
    args: &'a WaitArgs,
    /// The name under which it joins.
    name: &'static str,
    stop: Stop,
    until_ns: Option<u64>,
    has_joined: bool,
}

impl<'a> Sessions<'a> {
    /// Returns the runs to join under the name `name`. Without `--wait` there must be one.
    pub(crate) fn new(args: &'a WaitArgs, name: &'static str) -> anyhow::Result<Self> {
        if !args.wait {
            find(args.session.run.as_deref())?;
        }
        let stop = Stop::on_signals().context("cannot handle signals")?;
        let until_ns = args.session.seconds.map(|s| later_ns(monotonic_now_ns(), s));
        Ok(Self { args, name, stop, until_ns, has_joined: false })
    }

    /// Joins the next run; `idle` is called again and again while there is none. Returns none after the last one.
    pub(crate) fn next(&mut self, mut idle: impl FnMut()) -> anyhow::Result<Option<Session>> {
        let (waiter, run) = (Waiter::new(self.stop.clone()), self.args.session.run.as_deref());
        if replace(&mut self.has_joined, true) && !self.args.wait {
            return Ok(None);
        }
        let join = || {
            let session = Session::open(&self.args.session, self.name)?;
            Ok(Some(Session { until_ns: self.until_ns, ..session }))
        };
        if !self.args.wait {
            return join();
        }
        while !self.is_over() {
            match find(run) {
                Ok(live) if is_started(&live) => match join() {
                    // It has ended in between.
                    Err(_) if !live.is_alive() => {}
                    joined => return joined,
                },
                Ok(_) | Err(AttachError::NoRun | AttachError::NoSuchRun { .. }) => {}
                Err(error) => return Err(error.into()),
            }
            idle();
            waiter.wait_until(&[], monotonic_now_ns() + ALIVE_NS)?;
        }
        Ok(None)
    }

    fn is_over(&self) -> bool {
        self.stop.is_stopped() || self.until_ns.is_some_and(|until_ns| monotonic_now_ns() >= until_ns)
    }
}

/// Returns true if the launcher has joined its run. Before that it removes what an earlier launch has left, and takes
/// other processes of the run for leftovers.
fn is_started(live: &LiveRun) -> bool {
    let processes = Run::within(&live.dir, &live.name, live.run_id).ok().and_then(|run| living_processes(&run).ok());
    processes.is_some_and(|processes| processes.contains(&live.pid))
}

/// Returns the time after some seconds; the last possible time if they are too many.
fn later_ns(now_ns: u64, seconds: f64) -> u64 {
    now_ns.saturating_add((seconds * 1e9) as u64)
}

fn positive(text: &str) -> Result<f64, String> {
    match text.parse::<f64>() {
        Ok(seconds) if seconds.is_finite() && seconds > 0.0 => Ok(seconds),
        _ => Err("it must be a number above 0".to_owned()),
    }
}

/// The result of a wait.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Going {
    /// Read again.
    On,
    /// A stop was requested, or the time is over.
    Done,
    /// The run has ended.
    RunEnded,
}

/// A probe that has joined a run.
#[derive(Debug)]
pub(crate) struct Session {
    // Dropped in this order: ports before the node.
    receivers: Vec<(TopicId, Box<dyn AnyReceiver>)>,
    pub(crate) attached: Attached,
    stop: Stop,
    waiter: Waiter,
    until_ns: Option<u64>,
    alive_ns: u64,
}

impl Session {
    /// Joins a run under the name `name`.
    pub(crate) fn open(args: &SessionArgs, name: &str) -> anyhow::Result<Self> {
        let attached = attach(args.run.as_deref(), name)?;
        let stop = Stop::on_signals().context("cannot handle signals")?;
        let now_ns = monotonic_now_ns();
        Ok(Self {
            receivers: Vec::new(),
            attached,
            waiter: Waiter::new(stop.clone()),
            stop,
            until_ns: args.seconds.map(|s| later_ns(now_ns, s)),
            alive_ns: now_ns + ALIVE_NS,
        })
    }

    /// Returns the topic of a name, or of its last part if that is unique: a topic of the graph, or one that a stage of
    /// the run has open.
    pub(crate) fn topic(&self, name: &str) -> anyhow::Result<TopicId> {
        if let Ok(topic) = name.parse() {
            return Ok(topic);
        }
        let open = self.attached.node.open_topics().context("cannot list the topics")?;
        let last: Vec<&OpenTopic> = open.iter().filter(|t| t.name.rsplit('/').next() == Some(name)).collect();
        let found =
            open.iter().find(|topic| topic.name == name).or(if let [one] = last[..] { Some(one) } else { None });
        found.map(OpenTopic::id).ok_or_else(|| {
            let mut all: Vec<&str> = TopicId::all().map(TopicId::name).collect();
            all.extend(open.iter().map(|topic| topic.name.as_str()).filter(|name| name.parse::<TopicId>().is_err()));
            anyhow!("there is no topic `{name}`{}. All: {}", hint(name, all.iter().copied()), all.join(", "))
        })
    }

    /// Opens topics that are read at intervals.
    pub(crate) fn listen(&mut self, topics: impl IntoIterator<Item = TopicId>) -> anyhow::Result<()> {
        for topic in topics {
            self.receivers.push((topic, topic.polled_receiver(&self.attached.node)?));
        }
        Ok(())
    }

    /// Opens a topic whose messages wake this process.
    pub(crate) fn listen_woken(&mut self, topic: TopicId) -> anyhow::Result<()> {
        self.receivers.push((topic, topic.receiver(&self.attached.node)?));
        Ok(())
    }

    /// Returns the messages since the last reading, topic by topic, oldest first.
    pub(crate) fn take(
        &mut self,
        mut each: impl FnMut(TopicId, &dyn Received) -> anyhow::Result<()>,
    ) -> anyhow::Result<()> {
        for (topic, receiver) in &mut self.receivers {
            while let Some(message) = receiver.next()? {
                each(*topic, &*message)?;
            }
        }
        Ok(())
    }

    /// Sleeps until the next reading, or until a message of a waking topic arrives.
    pub(crate) fn pause(&mut self) -> anyhow::Result<Going> {
        let woken = self.receivers.iter().map(|(_, r)| r.as_input()).filter(|i| i.descriptor().is_some());
        let inputs: Vec<_> = woken.collect();
        self.waiter.wait_until(&inputs, monotonic_now_ns() + LOOK_NS)?;
        let now_ns = monotonic_now_ns();
        if self.stop.is_stopped() || self.until_ns.is_some_and(|until_ns| now_ns >= until_ns) {
            return Ok(Going::Done);
        }
        if now_ns >= self.alive_ns {
            self.alive_ns = now_ns + ALIVE_NS;
            let live = &self.attached.live;
            ensure!(
                !live.has_lost_files(),
                "the files of run `{}` are gone although it runs: a cleaner of temporary files may have removed them; \
                 start the run again",
                live.name
            );
            if !live.is_alive() {
                return Ok(Going::RunEnded);
            }
        }
        Ok(Going::On)
    }

    /// Reads until the end, or until `each` returns false.
    pub(crate) fn follow(
        &mut self,
        mut each: impl FnMut(TopicId, &dyn Received) -> anyhow::Result<bool>,
        mut after: impl FnMut() -> anyhow::Result<()>,
    ) -> anyhow::Result<Going> {
        loop {
            let mut enough = false;
            self.take(|topic, message| {
                if !enough {
                    enough = !each(topic, message)?;
                }
                Ok(())
            })?;
            after()?;
            if enough {
                return Ok(Going::Done);
            }
            match self.pause()? {
                Going::On => {}
                over => return Ok(over),
            }
        }
    }

    /// Reports dropped messages, and the end of the run, on standard error.
    pub(crate) fn say_end(&self, going: Going) {
        let invalid = self.attached.node.counters().invalid();
        if invalid > 0 {
            crate::say(&format!("{invalid} messages were dropped: their header or content is not valid"));
        }
        if going == Going::RunEnded {
            crate::say(&format!("run `{}` has ended", self.attached.live.name));
        }
    }
}

/// Returns the time from a header's capture to another time, milliseconds.
pub(crate) fn since_capture_ms(header: &Header, at_ns: u64) -> f64 {
    at_ns.saturating_sub(header.capture_time_ns) as f64 / 1e6
}

/// Returns true if standard output is a terminal and `NO_COLOR` is not set.
pub(crate) fn colours() -> bool {
    use std::io::IsTerminal;
    std::io::stdout().is_terminal() && std::env::var_os("NO_COLOR").is_none_or(|v| v.is_empty())
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A time limit is a number above 0, and one beyond the clock's range never comes.
    #[test]
    fn limits_of_time() {
        assert_eq!(later_ns(5, 1.5), 1_500_000_005);
        for seconds in ["1e11", "1e300"] {
            assert_eq!(later_ns(5, positive(seconds).unwrap()), u64::MAX);
        }
        for wrong in ["0", "-1", "nan", "inf", "1e999", "", "1s"] {
            assert!(positive(wrong).is_err(), "{wrong}");
        }
    }
}
