//! `carff completions` and `carff man`: shell completions and man pages, generated from the command's description.

use anyhow::Context;
use clap_complete::CompleteEnv;
use clap_complete::env::Shells;
use std::path::PathBuf;

/// Environment variable by which a shell asks for completions.
const REQUEST: &str = "CARFF_COMPLETE";
/// Name of the command.
const NAME: &str = "carff";

/// Print a shell's completions.
#[derive(Clone, Debug, clap::Args)]
pub struct CompletionsArgs {
    /// The shell.
    pub shell: clap_complete::Shell,
}

/// Write man pages.
#[derive(Clone, Debug, clap::Args)]
pub struct ManArgs {
    /// Folder for the pages, one per command; it is created if it is missing.
    pub dir: PathBuf,
}

/// Prints the script by which a shell asks this program for completions.
pub fn completions(args: &CompletionsArgs) -> anyhow::Result<()> {
    let (shells, name) = (Shells::builtins(), args.shell.to_string());
    let shell = shells.completer(&name).with_context(|| format!("there are no completions for {name}"))?;
    let mut script = Vec::new();
    shell.write_registration(REQUEST, NAME, NAME, NAME, &mut script)?;
    // Without it, bash does not quote file names that contain blanks.
    print!("{}", String::from_utf8_lossy(&script).replace("complete -o nospace", "complete -o filenames -o nospace"));
    Ok(())
}

/// Answers a shell that asks for completions, and ends the process; returns if none does.
pub fn answer_shell(command: fn() -> clap::Command) {
    CompleteEnv::with_factory(command).var(REQUEST).bin(NAME).completer(NAME).complete();
}

/// Writes the man pages of a command and its subcommands.
pub fn man(args: &ManArgs, command: clap::Command) -> anyhow::Result<()> {
    let dir = args.dir.display();
    std::fs::create_dir_all(&args.dir).with_context(|| format!("cannot create {dir}"))?;
    clap_mangen::generate_to(command, &args.dir).with_context(|| format!("cannot write into {dir}"))?;
    println!("man pages in {dir}: man {dir}/carff.1");
    Ok(())
}
