//! Every command of `carff` with its help.

use crate::dataset::DatasetCommand;
use crate::doctor::DoctorArgs;
use crate::drive::DriveArgs;
use crate::lab::LabCommand;
use crate::launch::LaunchArgs;
#[cfg(feature = "recording")]
use crate::replay::ReplayArgs;
use crate::schema::SchemaArgs;
use crate::shell::{CompletionsArgs, ManArgs};
#[cfg(feature = "recording")]
use crate::soak::{InjectArgs, SoakArgs};
use carff::Attach;
#[cfg(feature = "bench")]
use carff_bench::BenchCommand;
use clap::{Parser, Subcommand};

/// Common end of every command's help.
const ENDS: &str = "\
Example: check a graph, then start it
  carff doctor configs/graphs/approaching-intersection.toml
  carff launch configs/graphs/approaching-intersection.toml

Exit codes:
    0  done
    1  an error, reported in one sentence
       (doctor: a graph cannot run; soak: the contract was violated)
    2  wrong arguments
  130  interrupted (Ctrl-C)

Environment:
  NO_COLOR  no colours in any output";

/// CARFF: from a camera image to a driving decision, in separate processes.
#[derive(Debug, Parser)]
#[command(name = "carff", bin_name = "carff", version = carff::provenance::VERSION, after_help = ENDS)]
pub struct Cli {
    /// The command.
    #[command(subcommand)]
    pub command: Command,
}

/// Every command.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Start a graph, print its decisions, and end with a report.
    #[command(after_help = "Example: two drives, with a report
  carff launch configs/graphs/approaching-intersection.toml --drives 2 --report reports/run.json")]
    Launch(LaunchArgs),
    /// Drive through a scenario in closed loop: the ego moves by its controller's actions.
    #[command(after_help = "Example: 20 episodes with the rule that looks, and the same with one that stops and creeps
  carff drive approaching-intersection --checkpoint configs/checkpoints/approaching-intersection --episodes 20
  carff drive approaching-intersection --checkpoint configs/checkpoints/approaching-intersection --rule peek")]
    Drive(DriveArgs),
    /// Commands that observe a run.
    #[command(flatten)]
    Attach(Attach),
    /// Send a recording through a graph again, and compare.
    #[command(after_help = "Example: compare all decisions; then replay at half the speed
  carff replay run.mcap --verify
  carff replay run.mcap --rate 0.5

Exit code: 1 when --verify finds a difference.")]
    #[cfg(feature = "recording")]
    Replay(ReplayArgs),
    /// Replay a recording (not part of this build).
    #[cfg(not(feature = "recording"))]
    #[command(hide = true)]
    Replay(carff::NotBuilt),
    /// Render and check datasets.
    #[command(
        subcommand,
        after_help = "Example: render a scenario, and check the images
  carff dataset render approaching-intersection --out data/approaching-intersection
  carff dataset check data/approaching-intersection --contact-sheet reports/contact.png"
    )]
    Dataset(DatasetCommand),
    /// Commands that compute with libtorch.
    #[command(flatten)]
    Lab(LabCommand),
    /// Measure the program's parts and the whole loop on this machine.
    #[command(
        subcommand,
        after_help = "Example: from camera to action, in a minute
  carff bench loop --quick"
    )]
    #[cfg(feature = "bench")]
    Bench(BenchCommand),
    /// Measure the program's parts (not part of this build).
    #[cfg(not(feature = "bench"))]
    #[command(hide = true)]
    Bench(carff::NotBuilt),
    /// Run a graph under a seeded schedule of faults, and check its contract.
    #[command(after_help = "Example: ten minutes of every kind of fault
  carff soak configs/soak/all.toml --minutes 10 --seed 7 --json reports/soak.json")]
    #[cfg(feature = "recording")]
    Soak(SoakArgs),
    /// Run a graph under faults (not part of this build).
    #[cfg(not(feature = "recording"))]
    #[command(hide = true)]
    Soak(carff::NotBuilt),
    /// Inject one fault, for a soak.
    #[cfg(feature = "recording")]
    #[command(hide = true)]
    SoakInject(InjectArgs),
    /// Check the machine and a graph: problems, their consequences, and remedies.
    #[command(after_help = "Example: check the machine, and all requirements of a graph
  carff doctor configs/graphs/approaching-intersection.toml
  carff doctor --json

Exit code: 1 if a finding is an error, else 0.")]
    Doctor(DoctorArgs),
    /// Print the JSON Schema of a kind of file, for editors, or the layouts of the messages, for other languages.
    #[command(after_help = "Example: write a file of configs/schemas; the layouts of the Python package
  carff schema graph > graph.schema.json
  carff schema --python > layouts.py

A TOML file names its schema in its first line, for editors that know taplo: #:schema ../schemas/graph.schema.json")]
    Schema(SchemaArgs),
    /// Print shell completions of this command.
    #[command(after_help = "Example: for bash, from the next login
  carff completions bash > ~/.local/share/bash-completion/completions/carff")]
    Completions(CompletionsArgs),
    /// Write this command's man pages.
    #[command(after_help = "Example: into a folder of man's search path
  carff man ~/.local/share/man/man1")]
    Man(ManArgs),
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// Collects all visible commands with their subcommands.
    fn all(command: &clap::Command, found: &mut Vec<clap::Command>) {
        found.push(command.clone());
        command.get_subcommands().filter(|c| !c.is_hide_set() && c.get_name() != "help").for_each(|c| all(c, found));
    }

    /// Each command's help ends with an example, and each line of it parses as a command line.
    #[test]
    fn every_help_has_examples_that_parse() {
        let mut commands = Vec::new();
        all(&Cli::command(), &mut commands);
        assert!(commands.len() > 15, "{}", commands.len());
        for command in commands {
            let help = command.get_after_help().map(ToString::to_string).unwrap_or_default();
            assert!(help.starts_with("Example"), "`{}` has no example", command.get_name());
            let mut lines = 0;
            for line in help.lines().filter(|line| line.starts_with("  carff ")) {
                let words = line.split_whitespace().take_while(|word| !["|", ">"].contains(word));
                let parsed = Cli::try_parse_from(words);
                assert!(parsed.is_ok(), "{line}: {}", parsed.err().map(|e| e.to_string()).unwrap_or_default());
                lines += 1;
            }
            assert!(lines > 0, "the help of `{}` has no example command", command.get_name());
        }
    }

    /// Every command line in a block of the book and the other pages parses.
    #[test]
    fn commands_in_the_book_parse() {
        let root = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("..");
        let mut lines = 0;
        for folder in ["", "docs", "docs/book/src"] {
            for entry in std::fs::read_dir(root.join(folder)).unwrap() {
                let path = entry.unwrap().path();
                if path.extension().is_none_or(|e| e != "md") {
                    continue;
                }
                // A command that continues after a backslash is one command.
                let text = std::fs::read_to_string(&path).unwrap().replace("\\\n", " ");
                for line in text.split("```").skip(1).step_by(2).flat_map(str::lines) {
                    let line = line.trim_start_matches("target/release/").trim_start_matches("bin/");
                    if !line.starts_with("carff ") {
                        continue;
                    }
                    // The column of a second terminal is far to the right.
                    let line = line.split("     ").next().unwrap_or(line);
                    let words = line.split_whitespace().take_while(|word| !["|", ">", "&", "#"].contains(word));
                    let shown = |e: &clap::Error| e.kind() == clap::error::ErrorKind::DisplayHelp;
                    if let Err(error) = Cli::try_parse_from(words)
                        && !shown(&error)
                    {
                        panic!("{}: {line}: {error}", path.display());
                    }
                    lines += 1;
                }
            }
        }
        assert!(lines > 30, "{lines}");
    }

    /// The graph file of the book's deployment page is valid, without a warning.
    #[test]
    fn the_graph_in_the_book_is_valid() {
        let path = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("packaging/debian/vehicle.toml");
        let graph = carff_config::GraphConfig::load(&path).unwrap();
        assert_eq!(graph.warnings(), Vec::<String>::new());
    }

    fn completed(words: &[&str]) -> Vec<String> {
        let words: Vec<std::ffi::OsString> = words.iter().map(Into::into).collect();
        let at = words.len() - 1;
        let found = clap_complete::engine::complete(&mut Cli::command(), words, at, None).unwrap();
        found.iter().map(|candidate| candidate.get_value().to_string_lossy().into_owned()).collect()
    }

    /// Shells are offered commands that are not hidden, topics where a topic belongs, and files only where a file does.
    /// File names with blanks stay whole.
    #[test]
    fn completions_offer_what_belongs_there() {
        let commands = completed(&["carff", ""]);
        assert!(commands.contains(&"probe".to_owned()) && !commands.iter().any(|c| c == "soak-inject"), "{commands:?}");
        for words in [&["carff", "probe", "echo", "pro"][..], &["carff", "record", "-o", "x.mcap", "pro"]] {
            // Topics of living runs follow, on the machine of the test.
            assert_eq!(completed(words)[..2], ["prober/belief", "prober/unknown"], "{words:?}");
        }
        assert!(completed(&["carff", "view", "--scr"]).contains(&"--screenshot".to_owned()));
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("a b.mcap");
        std::fs::write(&file, "").unwrap();
        let begin = folder.path().join("a").display().to_string();
        assert_eq!(completed(&["carff", "replay", &begin]), [file.display().to_string()]);
        for words in [["carff", "stop", &begin], ["carff", "logs", &begin]] {
            assert_eq!(completed(&words), Vec::<String>::new(), "{words:?}");
        }
    }

    /// The description is consistent (names and shortcuts do not clash), and its completions and pages can be
    /// generated.
    #[test]
    fn completions_and_pages() {
        Cli::command().debug_assert();
        for shell in <clap_complete::Shell as clap::ValueEnum>::value_variants() {
            let mut script = Vec::new();
            clap_complete::generate(*shell, &mut Cli::command(), "carff", &mut script);
            assert!(String::from_utf8_lossy(&script).contains("doctor"), "{shell}");
        }
        let folder = tempfile::tempdir().unwrap();
        crate::shell::man(&ManArgs { dir: folder.path().join("man1") }, Cli::command()).unwrap();
        let page = std::fs::read_to_string(folder.path().join("man1/carff-launch.1")).unwrap();
        assert!(page.contains("carff launch configs/graphs"), "{page}");
        let page = std::fs::read_to_string(folder.path().join("man1/carff-view.1")).unwrap();
        assert!(page.contains("screenshot") && page.contains("theme"), "{page}");
    }
}
