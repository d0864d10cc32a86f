//! The shared library of ONNX Runtime.
//!
//! The first of these that exists is loaded:
//!
//! 1. the file that the environment variable `ORT_DYLIB_PATH` names;
//! 2. `libonnxruntime.so.1` in `../lib` of the program's folder, where the Debian package puts it;
//! 3. the one that `make onnxruntime` stores in `.onnxruntime/lib` of the project, for a program in `target/release`;
//! 4. the one that the system's loader finds, for example by `LD_LIBRARY_PATH`.
//!
//! The published builds report their use to their maker: they keep a database and an identifier of the device in the
//! user's home folder, and send events. The environment variable `ORT_DISABLE_TELEMETRY` prevents all of it, and the
//! library is not loaded without it.

use crate::InferenceError;
use ort::environment::Environment;
use std::os::unix::process::CommandExt;
use std::path::{Path, PathBuf};
use std::process::Command;
use std::sync::OnceLock;

/// Version that the fetch script stores.
pub const VERSION: &str = "1.32.0";
/// Part of that version's description of its build.
pub const BUILD: &str = "git-commit-id=fab30a4";
/// Name of the library.
pub const NAME: &str = "libonnxruntime.so.1";
/// Variable that names another file.
const VARIABLE: &str = "ORT_DYLIB_PATH";
/// Variable that keeps the library from reporting its use, and its value.
const NO_TELEMETRY: (&str, &str) = ("ORT_DISABLE_TELEMETRY", "1");
/// Folders of the library, relative to the folder of the program. Tests are one folder deeper.
const FOLDERS: [&str; 3] = ["../lib", "../../.onnxruntime/lib", "../../../.onnxruntime/lib"];

/// Returns the path of the library; a bare name if only the system's loader can find it.
pub fn path() -> PathBuf {
    if let Some(named) = std::env::var_os(VARIABLE).filter(|v| !v.is_empty()) {
        return named.into();
    }
    let program = std::env::current_exe().ok();
    let folder = program.as_deref().and_then(Path::parent);
    let stored = folder.into_iter().flat_map(|folder| FOLDERS.map(|f| folder.join(f).join(NAME)));
    stored.into_iter().find(|file| file.exists()).unwrap_or_else(|| NAME.into())
}

/// Starts this program again with the variable that keeps the library from reporting its use, unless it is set. Call it
/// first in `main`; the process and its arguments stay the same.
///
/// # Errors
///
/// The program cannot be started again.
pub fn without_telemetry() -> std::io::Result<()> {
    if is_silent() {
        return Ok(());
    }
    let mut words = std::env::args_os();
    let mut again = Command::new(std::env::current_exe()?);
    words.next().map(|name| again.arg0(name));
    Err(again.args(words).env(NO_TELEMETRY.0, NO_TELEMETRY.1).exec())
}

fn is_silent() -> bool {
    std::env::var_os(NO_TELEMETRY.0).is_some_and(|value| value == NO_TELEMETRY.1)
}

/// Loads the library, once in a process.
///
/// # Errors
///
/// [`InferenceError::Library`] if it is missing, is another library, is too old, or would report its use.
pub fn load() -> Result<Environment, InferenceError> {
    static LOADED: OnceLock<Result<Environment, String>> = OnceLock::new();
    LOADED.get_or_init(|| open(&path())).clone().map_err(|what| InferenceError::Library { what })
}

fn open(path: &Path) -> Result<Environment, String> {
    if path.parent().is_some_and(|folder| folder != Path::new("")) && !path.exists() {
        return Err(format!("{} does not exist", path.display()));
    }
    if !is_silent() {
        let (name, value) = NO_TELEMETRY;
        return Err(format!("{NAME} would report its use to its maker; set {name}={value} in the environment"));
    }
    let builder = ort::init_from(path).map_err(|e| format!("{e} ({NAME} {VERSION} is wanted)"))?;
    builder.with_name("carff").with_telemetry(false).build().map_err(|e| format!("{}: {e}", path.display()))
}

/// Loads the library, and returns its description of the build.
///
/// # Errors
///
/// As [`load`].
pub fn build() -> Result<&'static str, InferenceError> {
    load()?;
    Ok(ort::info())
}
