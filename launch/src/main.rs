//! Every command of `carff` with its help, completions and manual pages.

use carff::{Attach, run_program};
#[cfg(feature = "bench")]
use carff_bench::BenchCommand;
use carff_launch::ablate::AblateArgs;
#[cfg(feature = "import")]
use carff_launch::backbone::BackboneCommand;
use carff_launch::checkpoint::CheckpointCommand;
use carff_launch::dataset::DatasetCommand;
use carff_launch::doctor::DoctorArgs;
use carff_launch::eval::EvalArgs;
use carff_launch::launch::LaunchArgs;
#[cfg(feature = "recording")]
use carff_launch::replay::ReplayArgs;
use carff_launch::schema::SchemaArgs;
use carff_launch::shell::{CompletionsArgs, ManArgs};
#[cfg(feature = "recording")]
use carff_launch::soak::{InjectArgs, SoakArgs};
use carff_launch::train::TrainArgs;
use clap::{CommandFactory, Parser, Subcommand};
use std::process::ExitCode;

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
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Start a graph, print its decisions, and end with a report.
    #[command(after_help = "Example: two drives, with a report
  carff launch configs/graphs/approaching-intersection.toml --drives 2 --report reports/run.json")]
    Launch(LaunchArgs),
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
    /// Train a scenario's models; continues an earlier run that stopped.
    #[command(after_help = "Example: train the shipped models into your own folder
  carff train configs/training/approaching-intersection.toml --out runs/mine/checkpoint --run-dir runs/mine")]
    Train(TrainArgs),
    /// Evaluate a checkpoint: every table and image, as JSON and one page.
    #[command(after_help = "Example: only the planning table
  carff eval configs/checkpoints/approaching-intersection --only planning --out reports/results")]
    Eval(EvalArgs),
    /// Train the encoder with one change at a time, and tabulate; continues an earlier run that stopped.
    #[command(after_help = "Example: two of the variants
  carff ablate configs/training/approaching-intersection-ablation.toml --only full --only stem --out reports/ablation")]
    Ablate(AblateArgs),
    /// Convert published weights of an image backbone for training.
    #[command(
        subcommand,
        after_help = "Example: a vision transformer, as timm and Hugging Face publish them
  carff backbone import model.safetensors --out runs/vit.safetensors"
    )]
    #[cfg(feature = "import")]
    Backbone(BackboneCommand),
    /// Import published weights (not part of this build).
    #[cfg(not(feature = "import"))]
    #[command(hide = true)]
    Backbone(carff::NotBuilt),
    /// Export trained models for other programs.
    #[command(
        subcommand,
        after_help = "Example: the encoder as an ONNX file
  carff checkpoint onnx configs/checkpoints/approaching-intersection --out encoder.onnx"
    )]
    Checkpoint(CheckpointCommand),
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

fn main() -> ExitCode {
    run_program(run)
}

fn run() -> anyhow::Result<ExitCode> {
    carff_launch::shell::answer_shell(Cli::command);
    match Cli::parse().command {
        Command::Launch(args) => carff_launch::launch::run(&args),
        Command::Attach(command) => command.run(),
        #[cfg(feature = "recording")]
        Command::Replay(args) => carff_launch::replay::run(&args),
        #[cfg(not(feature = "recording"))]
        Command::Replay(args) => args.run("carff replay"),
        Command::Train(args) => carff_launch::train::run(&args),
        Command::Eval(args) => carff_launch::eval::run(&args),
        Command::Ablate(args) => carff_launch::ablate::run(&args),
        #[cfg(feature = "import")]
        Command::Backbone(command) => carff_launch::backbone::run(&command),
        #[cfg(not(feature = "import"))]
        Command::Backbone(args) => args.run("carff backbone"),
        #[cfg(feature = "bench")]
        Command::Bench(command) => carff_bench::run(command),
        #[cfg(not(feature = "bench"))]
        Command::Bench(args) => args.run("carff bench"),
        #[cfg(feature = "recording")]
        Command::Soak(args) => carff_launch::soak::run(&args),
        #[cfg(not(feature = "recording"))]
        Command::Soak(args) => args.run("carff soak"),
        #[cfg(feature = "recording")]
        Command::SoakInject(args) => carff_launch::soak::inject(&args).map(|()| ExitCode::SUCCESS),
        Command::Checkpoint(command) => carff_launch::checkpoint::run(&command),
        Command::Doctor(args) => carff_launch::doctor::run(&args),
        Command::Schema(args) => carff_launch::schema::run(&args).map(|()| ExitCode::SUCCESS),
        Command::Completions(args) => carff_launch::shell::completions(&args).map(|()| ExitCode::SUCCESS),
        Command::Man(args) => carff_launch::shell::man(&args, Cli::command()).map(|()| ExitCode::SUCCESS),
        Command::Dataset(command) => carff_launch::dataset::run(command).map(|()| ExitCode::SUCCESS),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
                let text = std::fs::read_to_string(&path).unwrap();
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
            assert_eq!(completed(words), ["prober/belief", "prober/unknown"], "{words:?}");
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
        carff_launch::shell::man(&ManArgs { dir: folder.path().join("man1") }, Cli::command()).unwrap();
        let page = std::fs::read_to_string(folder.path().join("man1/carff-launch.1")).unwrap();
        assert!(page.contains("carff launch configs/graphs"), "{page}");
        let page = std::fs::read_to_string(folder.path().join("man1/carff-view.1")).unwrap();
        assert!(page.contains("screenshot") && page.contains("theme"), "{page}");
    }
}
