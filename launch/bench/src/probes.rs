//! Additional subscribers to a running graph, such as viewers and recorders, in one separate process.

use crate::helper::{Helper, end_with_parent, say_ready};
use anyhow::Context;
use carff_messages::{Action, Belief, FrameMeta};
use carff_transport::{ImagePayload, Node, Receiver, Run, Stop, Waiter, Woken, topics};
use std::sync::Barrier;

/// Arguments of the probes' process.
#[derive(Clone, Debug, clap::Args)]
pub struct ProbesArgs {
    /// Name of the run.
    run: String,
    /// Id of the run.
    run_id: u64,
    /// Number of probes.
    count: usize,
}

/// Returns the maximum number of probes, next to the graph's own stages and the measuring process.
pub(crate) fn most_probes() -> usize {
    let spare = [
        // Encoder and measurement.
        topics::FRAME.limits.max_subscribers - 2,
        // Controller, forecaster, renderer and measurement.
        topics::BELIEF.limits.max_subscribers - 4,
        // Measurement.
        topics::ACTION.limits.max_subscribers - 1,
    ];
    spare.into_iter().min().unwrap_or_default()
}

/// Attached probes.
pub(crate) struct Probes {
    helper: Helper,
}

impl Probes {
    /// Attaches `count` probes to a run, and returns when all are attached.
    pub(crate) fn start(run: &Run, count: usize) -> anyhow::Result<Self> {
        let args = ["probes".to_owned(), run.name().to_owned(), run.id().to_string(), count.to_string()];
        let mut helper = Helper::start(&args)?;
        helper.wait_ready()?;
        Ok(Self { helper })
    }

    /// Returns the processor time of their process, seconds.
    pub(crate) fn cpu_seconds(&self) -> f64 {
        self.helper.cpu_seconds()
    }

    /// Ends the probes, and returns the number of messages that they read.
    pub(crate) fn finish(self) -> anyhow::Result<u64> {
        let output = self.helper.finish()?;
        output.trim().parse().with_context(|| format!("the probes' process printed `{output}` instead of a count"))
    }
}

/// Runs each probe in a thread until standard input ends, and then prints the number of messages that they read.
pub(crate) fn run(args: &ProbesArgs) -> anyhow::Result<()> {
    end_with_parent()?;
    let stop = Stop::on_signals()?;
    let run = Run::new(&args.run, args.run_id)?;
    let all_open = Barrier::new(args.count + 1);
    let read = std::thread::scope(|scope| {
        let threads: Vec<_> = (0..args.count)
            .map(|_| {
                scope.spawn(|| {
                    let waiter = Waiter::new(stop.clone());
                    let opened = Node::open(&run, "probes").map_err(anyhow::Error::from);
                    let opened = opened.and_then(|node| Ok((Probe::open(&node)?, node)));
                    all_open.wait();
                    let (probe, _node) = opened?;
                    probe.listen(&waiter)
                })
            })
            .collect();
        all_open.wait();
        say_ready()?;
        threads.into_iter().try_fold(0, |sum, thread| match thread.join() {
            Ok(read) => Ok(sum + read?),
            Err(_) => anyhow::bail!("a probe panicked"),
        })
    })?;
    println!("{read}");
    Ok(())
}

/// A probe that receives frames, beliefs and actions.
struct Probe {
    frames: Receiver<ImagePayload<FrameMeta>>,
    beliefs: Receiver<Belief>,
    actions: Receiver<Action>,
}

impl Probe {
    fn open(node: &Node) -> anyhow::Result<Self> {
        Ok(Self {
            frames: node.receiver(&topics::FRAME)?,
            beliefs: node.receiver(&topics::BELIEF)?,
            actions: node.receiver(&topics::ACTION)?,
        })
    }

    /// Reads all messages with every byte of their images, and returns their number.
    fn listen(mut self, waiter: &Waiter) -> anyhow::Result<u64> {
        let mut read = 0;
        while waiter.wait(&[&self.frames, &self.beliefs, &self.actions])? != Woken::Stopped {
            while let Some(image) = self.frames.next()? {
                std::hint::black_box(image.bytes().iter().fold(0_u64, |sum, byte| sum + u64::from(*byte)));
                read += 1;
            }
            while let Some(belief) = self.beliefs.next()? {
                std::hint::black_box(belief.hazard_probability);
                read += 1;
            }
            while let Some(action) = self.actions.next()? {
                std::hint::black_box(action.action);
                read += 1;
            }
        }
        Ok(read)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The maximum number of probes fits next to the subscribers of a measured graph, and no more.
    #[test]
    fn so_many_probes_fit() {
        let run = Run::new(&format!("bench-fit-{}", std::process::id()), 1).unwrap();
        {
            let node = Node::open(&run, "test").unwrap();
            let frames: Vec<_> = (0..2).map(|_| node.receiver(&topics::FRAME).unwrap()).collect();
            let beliefs: Vec<_> = (0..4).map(|_| node.receiver(&topics::BELIEF).unwrap()).collect();
            let action = node.receiver(&topics::ACTION).unwrap();
            let probes: Vec<_> = (0..most_probes()).map(|_| Probe::open(&node).unwrap()).collect();
            assert!(!probes.is_empty());
            assert!(Probe::open(&node).is_err(), "there is room for more");
            drop((frames, beliefs, action, probes));
        }
        carff_transport::remove_run_leftovers(&run).unwrap();
    }
}
