//! Arguments of all stages, and how each program reads its arguments.

use clap::Parser;
use std::ffi::{OsStr, OsString};
use std::io::{Error, Result, Write};
use std::path::{Path, PathBuf};

/// Reads the arguments of this program. A request for help or the version is answered, and ends the process with exit
/// code 0; wrong arguments end it with 2.
///
/// # Errors
///
/// Help or version cannot be written, because standard output is full or closed.
pub fn parse<T: Parser>() -> Result<T> {
    let answer = match T::try_parse() {
        Ok(args) => return Ok(args),
        Err(answer) => answer,
    };
    let printed = answer.print().and_then(|()| std::io::stdout().flush());
    if !answer.use_stderr() {
        printed.map_err(|e| Error::new(e.kind(), format!("cannot write to standard output: {e}")))?;
    }
    std::process::exit(answer.exit_code())
}

/// Run one stage of a CARFF graph. `carff launch` starts all stages; if you start them yourself, use the same run name
/// and id.
///
/// ```
/// use carff_runtime::StageArgs;
/// let args = StageArgs { frames: Some(100), ..StageArgs::new("graph.toml".as_ref(), "crossing", 7) };
/// assert!(args.to_command_line().windows(2).any(|words| words == ["--frames", "100"]));
/// ```
#[derive(Clone, Debug, PartialEq, Eq, Parser)]
#[command(version)]
pub struct StageArgs {
    /// The graph file.
    #[arg(long)]
    pub graph: PathBuf,
    /// Run name; replaces the graph file's.
    #[arg(long)]
    pub run: Option<String>,
    /// Run id: equal for all stages of a run.
    #[arg(long, default_value_t = 0)]
    pub run_id: u64,
    /// Dataset folder; replaces the graph file's.
    #[arg(long)]
    pub dataset: Option<PathBuf>,
    /// Checkpoint folder; replaces the graph file's.
    #[arg(long)]
    pub checkpoint: Option<PathBuf>,
    /// Camera: number of drives; replaces the graph file's.
    #[arg(long)]
    pub drives: Option<u32>,
    /// Camera: stop after this many frames.
    #[arg(long)]
    pub frames: Option<u64>,
    /// Camera: number of the first frame; the camera continues as if it had shown earlier frames.
    #[arg(long, default_value_t = 0)]
    pub first_frame: u64,
    /// Camera: also publish each image before its rectification.
    #[arg(long, hide = true)]
    pub raw: bool,
    /// End when this process, the parent, ends.
    #[arg(long)]
    pub parent_pid: Option<u32>,
}

impl StageArgs {
    /// Returns the arguments of a stage of a run.
    pub fn new(graph: &Path, run: &str, run_id: u64) -> Self {
        Self {
            graph: graph.to_owned(),
            run: Some(run.to_owned()),
            run_id,
            dataset: None,
            checkpoint: None,
            drives: None,
            frames: None,
            first_frame: 0,
            raw: false,
            parent_pid: None,
        }
    }

    /// Returns the command line of these arguments, without the program's name.
    pub fn to_command_line(&self) -> Vec<OsString> {
        let mut line: Vec<OsString> = Vec::new();
        let mut add = |name: &str, value: Option<OsString>| match value {
            // A value that begins as an option does.
            Some(value) if value.as_encoded_bytes().starts_with(b"-") => {
                line.push([OsStr::new(name), OsStr::new("="), &value].into_iter().collect());
            }
            Some(value) => line.extend([OsString::from(name), value]),
            None => {}
        };
        add("--graph", Some(self.graph.clone().into()));
        add("--run", self.run.as_ref().map(Into::into));
        add("--run-id", Some(self.run_id.to_string().into()));
        add("--dataset", self.dataset.as_ref().map(Into::into));
        add("--checkpoint", self.checkpoint.as_ref().map(Into::into));
        add("--drives", self.drives.map(|n| n.to_string().into()));
        add("--frames", self.frames.map(|n| n.to_string().into()));
        add("--first-frame", (self.first_frame > 0).then(|| self.first_frame.to_string().into()));
        add("--parent-pid", self.parent_pid.map(|n| n.to_string().into()));
        line.extend(self.raw.then(|| OsString::from("--raw")));
        line
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The stage reads the same arguments as the launcher writes.
    #[test]
    fn command_line_round_trips() {
        let mut args = StageArgs::new("a b/graph.toml".as_ref(), "run-1", u64::MAX);
        for _ in 0..3 {
            let line = std::iter::once("stage".into()).chain(args.to_command_line());
            assert_eq!(StageArgs::try_parse_from(line).unwrap(), args);
            // Names that begin as an option does.
            if args.dataset.is_some() {
                (args.graph, args.run, args.checkpoint) = ("-g.toml".into(), Some("--run".into()), Some("-".into()));
            } else {
                args.checkpoint = Some("checkpoint".into());
            }
            args.dataset = Some("data".into());
            (args.drives, args.frames, args.parent_pid) = (Some(2), Some(30), Some(1));
            (args.first_frame, args.raw) = (17, true);
        }
    }
}
