//! The other programs of this project, in the same folder.

use anyhow::{Context, bail};
use std::ffi::OsString;
use std::os::unix::process::CommandExt;
use std::path::PathBuf;
use std::process::{Command, ExitCode, Stdio};

/// Libraries of libtorch by which the loader can be misled.
const LIBRARIES: [&str; 3] = ["libtorch_cpu.so", "libc10.so", "libtorch.so"];
/// Exit code of the loader when a library or a symbol is missing.
const LOADER_FAILED: i32 = 127;

/// Replaces this process with a program; returns if that fails. Names the library if `LD_LIBRARY_PATH` leads the loader
/// to a libtorch that the program cannot use.
pub fn become_program(name: &str, args: &[OsString]) -> anyhow::Result<ExitCode> {
    let program = std::env::current_exe()?.with_file_name(name);
    if let Some(library) = misleading_library() {
        let tried = Command::new(&program).arg("--version").stdin(Stdio::null()).output();
        if let Ok(output) = tried
            && output.status.code() == Some(LOADER_FAILED)
        {
            bail!(
                "the loader takes {} from LD_LIBRARY_PATH, and {} cannot use it: take its folder out of \
                 LD_LIBRARY_PATH, or put the libtorch of the build first ({})",
                library.display(),
                program.display(),
                String::from_utf8_lossy(&output.stderr).trim()
            );
        }
    }
    let error = Command::new(&program).args(args).exec();
    let package = if name == "carff-launch" { "carff" } else { "carff-lab" };
    Err(error).with_context(|| {
        format!("cannot start {}; build it with `make build`, or install the package `{package}`", program.display())
    })
}

/// Returns the first library of libtorch in `LD_LIBRARY_PATH`, which the loader prefers to the one of the build.
fn misleading_library() -> Option<PathBuf> {
    let folders = std::env::var_os("LD_LIBRARY_PATH")?;
    let files = std::env::split_paths(&folders).flat_map(|folder| LIBRARIES.map(|name| folder.join(name)));
    files.into_iter().find(|file| file.exists())
}
