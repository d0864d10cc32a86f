//! Further subscribers to a running graph, as viewers and recorders are, in a process of their own.

use crate::helper::{Helper, end_with_parent, say_ready};
use anyhow::Context;
use carff_messages::{Action, Belief, FrameMeta};
use carff_transport::{Image, Node, Receiver, Run, Stop, Waiter, Woken, topics};

/// The process of `scale`'s probes.
#[derive(Clone, Debug, clap::Args)]
pub struct ProbesArgs {
    /// The run's name.
    run: String,
    /// The run's id.
    run_id: u64,
    /// How many probes.
    count: usize,
}

/// Most probes that the graph's topics have room for beside the graph's own stages and the measuring process.
pub(crate) fn most_probes() -> usize {
    let spare = [
        // The encoder and the measurement.
        topics::FRAME.limits.max_subscribers - 2,
        // Controller, forecaster, renderer, and the measurement.
        topics::BELIEF.limits.max_subscribers - 4,
        // The measurement.
        topics::ACTION.limits.max_subscribers - 1,
    ];
    spare.into_iter().min().unwrap_or_default()
}

/// Probes that listen.
pub(crate) struct Probes {
    helper: Helper,
}

impl Probes {
    /// Attaches `count` probes to a run; returns when all listen.
    pub(crate) fn start(run: &Run, count: usize) -> anyhow::Result<Self> {
        let args = ["probes".to_owned(), run.name().to_owned(), run.id().to_string(), count.to_string()];
        let mut helper = Helper::start(&args)?;
        helper.wait_ready()?;
        Ok(Self { helper })
    }

    /// Processor time that their process has used.
    pub(crate) fn cpu_seconds(&self) -> f64 {
        self.helper.cpu_seconds()
    }

    /// Ends them; returns how many messages they read.
    pub(crate) fn finish(self) -> anyhow::Result<u64> {
        let said = self.helper.finish()?;
        said.trim().parse().with_context(|| format!("the probes said `{said}` in place of a count"))
    }
}

/// The probes' process: each in a thread of its own, until it is told to end. Then it says how much all have read.
pub(crate) fn run(args: &ProbesArgs) -> anyhow::Result<()> {
    end_with_parent()?;
    let stop = Stop::on_signals()?;
    let node = Node::open(&Run::new(&args.run, args.run_id)?, "probes")?;
    let probes = (0..args.count).map(|_| Probe::open(&node)).collect::<anyhow::Result<Vec<_>>>()?;
    let read = std::thread::scope(|scope| {
        let threads: Vec<_> = probes
            .into_iter()
            .map(|probe| {
                let waiter = Waiter::new(stop.clone());
                scope.spawn(move || probe.listen(&waiter))
            })
            .collect();
        say_ready()?;
        threads.into_iter().try_fold(0, |sum, thread| match thread.join() {
            Ok(read) => Ok(sum + read?),
            Err(_) => anyhow::bail!("a probe panicked"),
        })
    })?;
    println!("{read}");
    Ok(())
}

/// One probe: hears frames, beliefs and actions.
struct Probe {
    frames: Receiver<Image<FrameMeta>>,
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

    /// Reads all that comes, every byte of a picture; returns how many messages.
    fn listen(mut self, waiter: &Waiter) -> anyhow::Result<u64> {
        let mut read = 0;
        while waiter.wait(&[&self.frames, &self.beliefs, &self.actions])? != Woken::Stopped {
            while let Some(picture) = self.frames.next()? {
                std::hint::black_box(picture.bytes().iter().fold(0_u64, |sum, byte| sum + u64::from(*byte)));
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

    /// As many probes as are said to fit do fit, beside the subscribers that a measured graph has anyway.
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
