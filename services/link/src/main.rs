//! `carff-link` sends topics of a run to another machine, where they are a run again. The tool is optional: no stage
//! depends on it.
//!
//! The sending end is an observer of the run, with spare subscriber slots that no sender waits for. It publishes
//! nothing in the run, and subscribes to nothing on the network. The receiving end is a run with its own name, record
//! and lock, so that probes, recorder, viewer and renderers work on it. One zenoh connection joins two given addresses;
//! neither end searches for others.

mod address;
mod clock;
mod outputs;
mod receive;
mod send;
mod topics;
mod wire;

use anyhow::Context;
use carff_transport::Stop;
use clap::{Parser, Subcommand};

/// Topics of a run, on another machine.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Example: on the vehicle, and on the desk, which listens
  carff-link send --run intersection --connect 192.168.7.2:7447
  carff-link receive --run intersection --graph configs/graphs/approaching-intersection.toml --listen 192.168.7.2:7447
  carff probe belief

The data is neither encrypted nor signed: on a shared network, send it through a tunnel (WireGuard, ssh -L).
Ctrl-C ends it; exit code 0 then, 1 after an error, 2 for wrong arguments."
)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Debug, Subcommand)]
enum Command {
    /// Send topics of a run on this machine. The sender waits for each launch of the run; the run never waits for it.
    #[command(after_help = "Example: what an off-board renderer needs, and the actions
  carff-link send --run intersection --topics forecast,belief,action --connect 192.168.7.2:7447")]
    Send(send::SendArgs),
    /// Receive topics, and publish them in a run on this machine.
    #[command(after_help = "Example: behind a tunnel, under another name than on the vehicle
  ssh -N -R 7447:127.0.0.1:7447 vehicle &
  carff-link receive --run intersection --as vehicle --graph configs/graphs/approaching-intersection.toml --listen
  carff probe top --run vehicle")]
    Receive(receive::ReceiveArgs),
}

fn main() -> anyhow::Result<()> {
    let cli: Cli = carff_runtime::parse()?;
    let stop = Stop::on_signals().context("cannot handle signals")?;
    match cli.command {
        Command::Send(args) => send::run(&args, &stop),
        Command::Receive(args) => receive::run(&args, &stop),
    }
}

/// Prints a line about progress; results go to standard output.
fn note(text: &str) {
    eprintln!("carff-link: {text}");
}

#[cfg(test)]
mod tests {
    use super::*;
    use clap::CommandFactory;

    /// The arguments are well defined, and every example in the helps and in the book parses.
    #[test]
    fn examples_parse() {
        Cli::command().debug_assert();
        let book = std::path::Path::new(env!("CARGO_MANIFEST_DIR")).join("../../docs/book/src/deploy-on-a-vehicle.md");
        let mut texts = vec![std::fs::read_to_string(book).unwrap()];
        texts.extend(Cli::command().get_after_help().map(ToString::to_string));
        for command in Cli::command().get_subcommands() {
            texts.extend(command.get_after_help().map(ToString::to_string));
        }
        let mut lines = 0;
        for line in texts.iter().flat_map(|text| text.lines()) {
            let line = line.trim_start().trim_start_matches("target/release/");
            if line.starts_with("carff-link ") {
                let parsed = Cli::try_parse_from(line.split_whitespace().take_while(|word| !word.starts_with('#')));
                assert!(parsed.is_ok(), "{line}: {}", parsed.err().map(|e| e.to_string()).unwrap_or_default());
                lines += 1;
            }
        }
        assert!(lines >= 6, "{lines}");
    }

    /// Each end needs exactly one address: it never listens by itself.
    #[test]
    fn an_address_is_asked_for() {
        assert!(Cli::try_parse_from(["carff-link", "send", "--run", "a"]).is_err());
        assert!(Cli::try_parse_from(["carff-link", "send", "--run", "a", "--connect", "b:1", "--listen"]).is_err());
    }
}
