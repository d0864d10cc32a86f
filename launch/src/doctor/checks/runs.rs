//! Judges the folder of runs, living runs, and what killed runs have left.

use super::size::size;
use crate::doctor::finding::{Area, Finding};
use std::path::{Path, PathBuf};

/// Processes and files of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunFiles {
    /// Name of the run.
    pub name: String,
    /// Process number of its launcher, if alive.
    pub launcher: Option<u32>,
    /// Process to stop if the run lives, but its record or files in its folder are gone.
    pub lost: Option<u32>,
    /// Numbers of its living processes.
    pub living: Vec<u32>,
    /// Its small files: a folder and a record.
    pub small: Vec<PathBuf>,
    /// Its files in shared memory.
    pub segments: Vec<PathBuf>,
    /// Total size of the files in shared memory, bytes.
    pub segment_bytes: u64,
}

/// Files in shared memory of no known run of this user.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Strays {
    /// The files.
    pub files: Vec<PathBuf>,
    /// Processes that use them: of a run whose folder is gone.
    pub users: Vec<u32>,
}

/// Checks the folder of new runs.
pub fn run_folder(folder: &Path, writable: bool) -> Finding {
    let shown = folder.display();
    if writable {
        return Finding::ok(Area::Machine, "run folder", format!("{shown} is writable"));
    }
    Finding::error(
        Area::Machine,
        "run folder",
        format!("{shown} cannot be written"),
        "no graph can start, and no probe can join one",
        "set XDG_RUNTIME_DIR or TMPDIR to a folder that this user can write, with a path of at most 20 bytes",
    )
}

/// Reports living runs and the files of dead runs.
pub fn leftovers(runs: &[RunFiles], strays: &Strays) -> Vec<Finding> {
    let area = Area::SharedMemory;
    let list = |pids: &[u32]| pids.iter().map(u32::to_string).collect::<Vec<_>>().join(" ");
    let lost = |found: String, pid: u32| {
        Finding::error(
            area,
            "lost folder",
            found,
            "no probe sees the run, and none of its stages can restart: a cleaner of temporary files may have removed it",
            format!("stop the run (kill -INT {pid}), start it again, and keep the cleaner from its folder"),
        )
    };
    let mut findings: Vec<Finding> = runs
        .iter()
        .map(|run| match (run.lost, run.launcher, run.living.as_slice()) {
            (Some(pid), ..) => {
                lost(format!("run `{}` lives, but its record or files in its folder are gone", run.name), pid)
            }
            (None, Some(pid), living) => {
                Finding::ok(area, "run", format!("`{}` runs: launcher {pid}, {} processes", run.name, living.len()))
            }
            (None, None, []) if run.segments.is_empty() => Finding::ok(
                area,
                "leftovers",
                format!("run `{}` was killed; its next start removes its remaining small files", run.name),
            ),
            (None, None, []) => Finding::warning(
                area,
                "leftovers",
                format!(
                    "run `{}` was killed and left {} files in shared memory ({})",
                    run.name,
                    run.segments.len(),
                    size(run.segment_bytes)
                ),
                "they use memory until the next start of the run, which removes them",
                format!("rm -r {}", removal(run)),
            ),
            (None, None, living) => Finding::warning(
                area,
                "orphans",
                format!("run `{}` has no launcher, but these processes: {}", run.name, list(living)),
                "the run cannot start while they live; stages end by themselves within seconds",
                format!("kill {}", list(living)),
            ),
        })
        .collect();
    if !strays.users.is_empty() {
        let found = format!("processes {} belong to a run whose folder is gone", list(&strays.users));
        findings.push(lost(found, strays.users[0]));
    } else if !strays.files.is_empty() {
        findings.push(Finding::warning(
            area,
            "strays",
            format!("{} files in shared memory belong to no known run", strays.files.len()),
            "they use memory until they are removed",
            format!("if no graph runs: rm {}", words(strays.files.iter().map(PathBuf::as_path))),
        ));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(area, "leftovers", "none, and no run is alive"));
    }
    findings
}

fn removal(run: &RunFiles) -> String {
    words(run.small.iter().chain(&run.segments).map(PathBuf::as_path))
}

/// Formats paths for a command line; many paths become a prefix with `*`.
fn words<'a>(paths: impl Iterator<Item = &'a Path>) -> String {
    let mut words: Vec<String> = paths
        .map(|path| {
            let text = path.display().to_string();
            // A segment's name starts with its run's prefix and an underscore.
            match path.file_name().and_then(|n| n.to_str()).and_then(|n| n.split_once('_')) {
                Some((prefix, _)) if prefix.starts_with("carff") => {
                    path.with_file_name(format!("{prefix}_*")).display().to_string()
                }
                _ => text,
            }
        })
        .collect();
    words.sort();
    words.dedup();
    words.join(" ")
}

#[cfg(test)]
mod tests {
    use super::super::testing::{MIB, assert_level, levels};
    use super::*;
    use crate::doctor::finding::Level;

    /// A running graph is ok. Files of a dead run, processes without a launcher, and stray files are warnings with the
    /// command that removes them.
    #[test]
    fn what_runs_left() {
        let segments: Vec<PathBuf> =
            ["/dev/shm/carff0123abcd_a", "/dev/shm/carff0123abcd_b"].iter().map(PathBuf::from).collect();
        let dead = RunFiles {
            name: "dead".to_owned(),
            small: vec!["/var/carff-1/dead".into(), "/var/carff-1/dead.run".into()],
            segments: segments.clone(),
            segment_bytes: 3 * MIB,
            ..RunFiles::default()
        };
        let small_run = || RunFiles { name: "small".to_owned(), small: vec!["x.run".into()], ..RunFiles::default() };
        assert_level(&leftovers(&[small_run()], &Strays::default())[0], Level::Ok);
        let alive = RunFiles { name: "alive".to_owned(), launcher: Some(7), living: vec![7, 8], ..RunFiles::default() };
        let orphan = RunFiles { name: "orphan".to_owned(), living: vec![9, 10], ..RunFiles::default() };
        let strays = Strays { files: segments, users: Vec::new() };
        let findings = leftovers(&[dead, alive, orphan], &strays);
        let lost = leftovers(&[], &Strays { users: vec![5, 6], ..strays.clone() });
        assert_eq!(levels(&lost), [("lost folder", Level::Error)]);
        assert!(lost[0].advice.contains("kill -INT 5"), "a living run is never removed: {lost:?}");
        for launcher in [None, Some(7)] {
            let run = RunFiles { lost: Some(7), launcher, living: vec![7, 8], ..small_run() };
            let found = leftovers(&[run], &Strays::default());
            assert_eq!(levels(&found), [("lost folder", Level::Error)]);
            assert!(found[0].advice.contains("kill -INT 7") && found[0].found.contains("`small`"), "{found:?}");
        }
        assert_eq!(
            levels(&findings),
            [
                ("leftovers", Level::Warning),
                ("run", Level::Ok),
                ("orphans", Level::Warning),
                ("strays", Level::Warning)
            ]
        );
        assert!(findings[0].found.contains("`dead`") && findings[0].found.contains("3.0 MiB"), "{findings:?}");
        assert_eq!(findings[0].advice, "rm -r /dev/shm/carff0123abcd_* /var/carff-1/dead /var/carff-1/dead.run");
        assert_eq!(findings[2].advice, "kill 9 10");
        assert!(findings[3].advice.ends_with("rm /dev/shm/carff0123abcd_*"), "{findings:?}");
        assert_eq!(levels(&leftovers(&[], &Strays::default())), [("leftovers", Level::Ok)]);
    }
}
