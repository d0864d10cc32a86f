//! `carff ps`, `stop` and `logs`: the living runs of this user, their end, and their log.

use crate::complete;
use crate::log_file::LogTail;
use anyhow::{Context, bail, ensure};
use carff_observe::{LiveRun, runs};
use carff_transport::{Run, Stop, Waiter, Woken, monotonic_now_ns, runtime_dirs};
use clap_complete::engine::ArgValueCandidates;
use rustix::process::{Pid, Signal, kill_process};
use serde_json::json;
use std::io::{Write, stdout};
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::{Duration, SystemTime};

/// Interval of looking at a run or a log.
const LOOK_NS: u64 = 100_000_000;

/// List the living runs.
#[derive(Clone, Debug, clap::Args)]
pub struct PsArgs {
    /// Print JSON.
    #[arg(long)]
    json: bool,
}

/// Stop a run.
#[derive(Clone, Debug, clap::Args)]
pub struct StopArgs {
    /// Name of the run; optional if only one runs.
    #[arg(add = ArgValueCandidates::new(complete::runs))]
    run: Option<String>,
    /// Longest wait for its end, seconds.
    #[arg(long, default_value_t = 30)]
    seconds: u64,
}

/// Print the log of a run.
#[derive(Clone, Debug, clap::Args)]
pub struct LogsArgs {
    /// Name of a run, also of one that has ended; optional if only one runs.
    #[arg(add = ArgValueCandidates::new(complete::runs))]
    run: Option<String>,
    /// Continue with new lines until the run ends.
    #[arg(long, short)]
    follow: bool,
}

/// Returns the log file of a run. The launcher writes it, and keeps one earlier file of the same size limit.
pub fn log_path(dir: &Path, run: &str) -> PathBuf {
    dir.join(format!("{run}.log"))
}

/// Prints the living runs.
pub fn ps(args: &PsArgs) -> anyhow::Result<ExitCode> {
    let runs = runs()?;
    let now_s = SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs();
    let up = |run: &LiveRun| Duration::from_secs(now_s.saturating_sub(run.started_unix_s));
    if args.json {
        let list = runs.iter().map(|run| {
            let (up_s, folder) = (up(run).as_secs(), &run.dir);
            json!({ "run": run.name, "pid": run.pid, "up_s": up_s, "graph": run.graph, "folder": folder.to_string_lossy() })
        });
        println!("{}", serde_json::to_string_pretty(&list.collect::<Vec<_>>())?);
        return Ok(ExitCode::SUCCESS);
    }
    println!("{:<24} {:>8} {:>10}  GRAPH", "RUN", "LAUNCHER", "UP");
    for run in &runs {
        let up = format!("{:#}", jiff::SignedDuration::try_from(up(run))?);
        println!("{:<24} {:>8} {up:>10}  {}", run.name, run.pid, run.graph.display());
    }
    Ok(ExitCode::SUCCESS)
}

/// Asks the launcher of a run to end, as Ctrl-C does, and waits for the end.
pub fn stop(args: &StopArgs) -> anyhow::Result<ExitCode> {
    let live = carff_observe::find(args.run.as_deref())?;
    let processes = Run::within(&live.dir, &live.name, live.run_id)?.mapping_processes();
    ensure!(
        processes.contains(&live.pid),
        "the launcher of run `{}` is not in this namespace of processes: stop its container or service",
        live.name
    );
    let pid = i32::try_from(live.pid).ok().and_then(Pid::from_raw).context("the launcher has no process id")?;
    kill_process(pid, Signal::INT).with_context(|| format!("cannot stop process {}", live.pid))?;
    let end_ns = monotonic_now_ns().saturating_add(args.seconds.saturating_mul(1_000_000_000));
    let waiter = Waiter::new(Stop::on_signals()?);
    while live.is_alive() {
        if monotonic_now_ns() >= end_ns {
            bail!("run `{}` has not ended within {} s", live.name, args.seconds);
        }
        if waiter.wait_until(&[], monotonic_now_ns() + LOOK_NS)? == Woken::Stopped {
            break;
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// Prints the log of a run.
pub fn logs(args: &LogsArgs) -> anyhow::Result<ExitCode> {
    let (live, path) = match (&args.run, carff_observe::find(args.run.as_deref())) {
        (_, Ok(live)) => (Some(live.clone()), log_path(&live.dir, &live.name)),
        (Some(name), Err(_)) if Run::new(name, 0).is_ok() => {
            let path = newest_file(name, log_path);
            (None, path.with_context(|| format!("no run `{name}` is alive, and none has left a log"))?)
        }
        (_, Err(error)) => return Err(error.into()),
    };
    let mut log = LogTail::open(&path).with_context(|| format!("cannot read {}", path.display()))?;
    let waiter = Waiter::new(Stop::on_signals()?);
    loop {
        // In this order, so that the last lines of a run are read after its end.
        let lives = args.follow && live.as_ref().is_some_and(LiveRun::is_alive);
        stdout().write_all(log.read()?.as_bytes())?;
        stdout().flush()?;
        if !lives || waiter.wait_until(&[], monotonic_now_ns() + LOOK_NS)? == Woken::Stopped {
            return Ok(ExitCode::SUCCESS);
        }
    }
}

/// Returns the newest file that runs of a name have left in their folders.
pub(crate) fn newest_file(name: &str, path: fn(&Path, &str) -> PathBuf) -> Option<PathBuf> {
    let paths = runtime_dirs().into_iter().map(|dir| path(&dir, name));
    paths.filter_map(|path| Some((path.metadata().ok()?.modified().ok()?, path))).max().map(|(_, path)| path)
}
