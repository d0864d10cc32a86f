//! `carff completions` and `carff man`: shell completions and man pages, generated from the command's description.

use anyhow::Context;
use std::path::PathBuf;

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

/// Prints the completions of a command.
pub fn completions(args: &CompletionsArgs, mut command: clap::Command) {
    let name = command.get_name().to_owned();
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut command, name, &mut script);
    print!("{}", String::from_utf8_lossy(&script));
}

/// Writes the man pages of a command and its subcommands.
pub fn man(args: &ManArgs, command: clap::Command) -> anyhow::Result<()> {
    let dir = args.dir.display();
    std::fs::create_dir_all(&args.dir).with_context(|| format!("cannot create {dir}"))?;
    clap_mangen::generate_to(command, &args.dir).with_context(|| format!("cannot write into {dir}"))?;
    println!("man pages in {dir}: man {dir}/carff.1");
    Ok(())
}
