//! `carff record`: writes the messages of a running graph into an MCAP file.

use crate::log_file::LogTail;
use crate::log_line;
use crate::runs::log_path;
use crate::session::{Session, Sessions, WaitArgs};
use crate::terminal::Terminal;
use crate::{complete, provenance};
use anyhow::Context;
use carff_checkpoint::Manifest;
use carff_observe::LiveRun;
use carff_recording::{LogLine, RecordingAbout, RecordingQueue, RotatingWriter, RotationLimits};
use carff_transport::TopicId;
use carff_transport::monotonic_now_ns;
use clap::Args;
use clap_complete::engine::ArgValueCandidates;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::SystemTime;

/// Time between two status lines, nanoseconds.
const STATUS_NS: u64 = 1_000_000_000;

/// Record a run.
#[derive(Clone, Debug, Args)]
pub struct RecordArgs {
    /// Topics to record; all by default, with the run's log.
    #[arg(add = ArgValueCandidates::new(complete::graph_topics))]
    pub topics: Vec<TopicId>,
    /// File to write; it must not exist. With --wait, the names of the files also have the run and the start (UTC).
    #[arg(short, long)]
    pub out: PathBuf,
    /// Begin another file at this size, megabytes.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub file_mb: Option<u64>,
    /// Begin another file after this time, seconds.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub file_seconds: Option<u64>,
    /// Number of files to keep; the oldest is removed.
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub keep: Option<u64>,
    /// Memory for messages that a slow disk has not written yet, megabytes. If it is full, whole messages are dropped
    /// and counted.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u64).range(1..))]
    pub queue_mb: u64,
    /// The run, the time limit, and the runs after it.
    #[command(flatten)]
    pub runs: WaitArgs,
}

/// Records until a stop is requested, the time is over, or the run ends; with `--wait`, each run.
pub fn run(args: &RecordArgs) -> anyhow::Result<ExitCode> {
    let mut sessions = Sessions::new(&args.runs, "recorder")?;
    while let Some(session) = sessions.next(|| {})? {
        let out = if args.runs.wait { out_of(&args.out, &session.attached.live.name) } else { args.out.clone() };
        record(args, session, &out)?;
    }
    Ok(ExitCode::SUCCESS)
}

/// Largest number of runs that start within one second.
const MOST_IN_A_SECOND: u32 = 1000;

/// Returns the file of one run of several. Runs that start within one second have numbers.
fn out_of(out: &Path, run: &str) -> PathBuf {
    let stem = out.file_stem().unwrap_or_default().to_string_lossy();
    let extension = out.extension().map_or("mcap".into(), |extension| extension.to_string_lossy());
    let time = jiff::Timestamp::now().strftime("%Y%m%dT%H%M%SZ");
    let named = |number: String| out.with_file_name(format!("{stem}-{run}-{time}{number}.{extension}"));
    let first = named(String::new());
    if first.exists() {
        (2..=MOST_IN_A_SECOND).map(|n| named(format!("-{n}"))).find(|path| !path.exists()).unwrap_or(first)
    } else {
        first
    }
}

/// Records one run.
fn record(args: &RecordArgs, mut session: Session, out: &Path) -> anyhow::Result<()> {
    let topics: Vec<TopicId> = if args.topics.is_empty() { TopicId::all().collect() } else { args.topics.clone() };
    session.listen(topics)?;
    let live = &session.attached.live;
    let (states, places) = match Manifest::load(&live.checkpoint) {
        Ok(manifest) => (manifest.scenario.state_names(), manifest.places),
        Err(error) => {
            crate::say(&format!("warning: neither boxes nor names of states are recorded: {error}"));
            Default::default()
        }
    };
    let limits = RotationLimits {
        file_bytes: args.file_mb.map(|mb| mb.saturating_mul(1_000_000)),
        file_ns: args.file_seconds.map(|s| s.saturating_mul(1_000_000_000)),
        files: args.keep.map(|n| n as usize),
    };
    let writer = RotatingWriter::create(out, about(live, states)?, places, limits)?;
    let queue =
        RecordingQueue::start(writer, args.queue_mb.saturating_mul(1_000_000)).context("cannot start the writer")?;
    let mut log = RunLog::of(live, args.topics.is_empty());
    let terminal = Terminal::new();
    let name = live.name.clone();
    let (mut status_ns, mut told) = (0, 0);
    let going = session.follow(
        // A failed writer ends the recording; its error is reported below.
        |topic, message| Ok(queue.push(topic, message.message().to_owned())),
        || {
            log.lines().into_iter().for_each(|line| _ = queue.push_log(line));
            let now_ns = monotonic_now_ns();
            if now_ns >= status_ns {
                status_ns = now_ns + STATUS_NS;
                let counts = queue.counts();
                terminal.status(format!("recording {name}: {} messages, {} dropped", counts.written, counts.dropped));
                if counts.dropped > told {
                    terminal.note(&format!(
                        "the disk is too slow: {} messages dropped so far (a larger --queue-mb bridges longer delays)",
                        counts.dropped
                    ));
                    told = counts.dropped;
                }
            }
            Ok(())
        },
    )?;
    terminal.status(String::new());
    session.say_end(going);
    // The next launch of the run waits for its processes: a slow disk must not delay it.
    drop(session);
    let counts = queue.finish().context("the recording ended early; its file is readable")?;
    println!("{}: {} messages of run {name}, {} dropped", out.display(), counts.written, counts.dropped);
    Ok(())
}

/// The log of a run from now on.
#[derive(Debug)]
pub(crate) struct RunLog(Option<LogTail>);

impl RunLog {
    /// Opens the log of a run if it is `wanted`. A run that another program started has none.
    pub(crate) fn of(live: &LiveRun, wanted: bool) -> Self {
        Self(wanted.then(|| LogTail::open_at_end(&log_path(&live.dir, &live.name)).ok()).flatten())
    }

    /// Returns the lines since the last call. An unreadable log has none: messages matter more.
    pub(crate) fn lines(&mut self) -> Vec<LogLine> {
        let text = self.0.as_mut().and_then(|log| log.read().ok()).unwrap_or_default();
        let now = jiff::Timestamp::now();
        text.lines().map(|line| log_line::parsed(line, &now)).collect()
    }
}

/// Returns the difference of wall-clock time (nanoseconds since 1970) and monotonic time.
pub(crate) fn wall_offset_ns() -> u64 {
    let wall_ns = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_nanos() as u64;
    wall_ns.saturating_sub(monotonic_now_ns())
}

fn about(live: &LiveRun, states: Vec<String>) -> anyhow::Result<RecordingAbout> {
    let origin = provenance::of(Some(live.started_unix_s), Some(&live.checkpoint));
    let origin = origin.into_iter().map(|(name, value)| (name.to_owned(), value)).collect();
    Ok(RecordingAbout {
        run: live.name.clone(),
        run_id: live.run_id,
        graph: live.graph.display().to_string(),
        graph_text: std::fs::read_to_string(&live.graph)
            .with_context(|| format!("cannot read the graph file {}", live.graph.display()))?,
        dataset: live.dataset.display().to_string(),
        checkpoint: live.checkpoint.display().to_string(),
        wall_offset_ns: wall_offset_ns(),
        states,
        origin,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Runs that start within one second have recordings of their own.
    #[test]
    fn each_run_has_its_own_file() {
        let folder = tempfile::tempdir().unwrap();
        let mut files = Vec::new();
        for _ in 0..3 {
            let file = out_of(&folder.path().join("drive.mcap"), "x");
            assert!(!file.exists() && file.extension().is_some_and(|e| e == "mcap"));
            std::fs::write(&file, "").unwrap();
            files.push(file);
        }
        files.dedup();
        assert_eq!(files.len(), 3);
    }
}
