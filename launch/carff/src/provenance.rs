//! The origin of a result: the program, the machine, the start of the run and the checkpoint.

use carff_base::errors::sentence;
use jiff::Timestamp;
use sha2::{Digest, Sha256};
use std::collections::BTreeMap;
use std::fmt::Write;
use std::fs::File;
use std::io;
use std::path::Path;

/// Commit of the source that this program was built from; `unknown` if it was built without git.
pub const COMMIT: &str = env!("CARFF_COMMIT");
/// Version and commit.
pub const VERSION: &str = concat!(env!("CARGO_PKG_VERSION"), " (", env!("CARFF_COMMIT"), ")");

/// Origin of a result, by name.
pub type Origin = BTreeMap<&'static str, String>;

/// Returns version and commit of this program, name of this machine, start of the run (ISO 8601; now, if it is not
/// given), and SHA-256 of the checkpoint, or the reason why it has none.
pub fn of(started_unix_s: Option<u64>, checkpoint: Option<&Path>) -> Origin {
    let second = started_unix_s.map_or(Timestamp::now().as_second(), |s| s.try_into().unwrap_or(i64::MAX));
    let started = Timestamp::from_second(second).unwrap_or(Timestamp::MAX);
    let mut origin = Origin::from([
        ("version", env!("CARGO_PKG_VERSION").to_owned()),
        ("commit", COMMIT.to_owned()),
        ("host", rustix::system::uname().nodename().to_string_lossy().into_owned()),
        ("started", started.to_string()),
    ]);
    if let Some(folder) = checkpoint {
        let hash = sha256_of_folder(folder);
        origin.insert("checkpoint_sha256", hash.unwrap_or_else(|e| format!("unknown: {}", sentence(&e))));
    }
    origin
}

/// Returns the origin as one line of text.
pub fn text(origin: &Origin) -> String {
    let of = |name: &str| origin.get(name).map_or("unknown", String::as_str);
    let checkpoint =
        origin.get("checkpoint_sha256").map_or(String::new(), |hash| format!(", checkpoint SHA-256 {hash}"));
    format!("carff {} ({}) on {}, started {}{checkpoint}", of("version"), of("commit"), of("host"), of("started"))
}

/// Returns the SHA-256 of a folder's files: that of the output of `sha256sum *` in the C locale.
fn sha256_of_folder(folder: &Path) -> io::Result<String> {
    let entries = std::fs::read_dir(folder)?.map(|entry| entry.map(|e| e.path())).collect::<io::Result<Vec<_>>>()?;
    let mut files: Vec<_> = entries.into_iter().filter(|path| path.is_file()).collect();
    files.sort();
    let mut listed = Sha256::new();
    for path in files {
        let mut file = Sha256::new();
        io::copy(&mut File::open(&path)?, &mut file)?;
        let name = path.file_name().unwrap_or_default().to_string_lossy();
        listed.update(format!("{}  {name}\n", hex(file)));
    }
    Ok(hex(listed))
}

fn hex(hash: Sha256) -> String {
    hash.finalize().iter().fold(String::new(), |mut text, byte| {
        // Writing into a string does not fail.
        let _ = write!(text, "{byte:02x}");
        text
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The hash is that of `sha256sum * | sha256sum`, and changes with each byte. A missing checkpoint is not an error.
    #[test]
    fn origins_are_complete() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::write(folder.path().join("manifest.json"), "{}").unwrap();
        std::fs::write(folder.path().join("field.safetensors"), "abc").unwrap();
        std::fs::create_dir(folder.path().join("sub")).unwrap();
        let origin = of(Some(1_700_000_000), Some(folder.path()));
        assert_eq!(origin["started"], "2023-11-14T22:13:20Z");
        assert!(VERSION.starts_with(&origin["version"]) && VERSION.contains(&origin["commit"]), "{VERSION}");
        assert!(!origin["host"].is_empty());
        let (abc, braces) = (
            "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad",
            "44136fa355b3678a1146ad16f7e8649e94fb4fc21fe77e8310c060f61caaff8a",
        );
        let listed = Sha256::new().chain_update(format!("{abc}  field.safetensors\n{braces}  manifest.json\n"));
        assert_eq!(origin["checkpoint_sha256"], hex(listed));
        std::fs::write(folder.path().join("manifest.json"), "{ }").unwrap();
        assert_ne!(of(None, Some(folder.path()))["checkpoint_sha256"], origin["checkpoint_sha256"]);
        assert!(of(None, Some(&folder.path().join("none")))["checkpoint_sha256"].starts_with("unknown: "));
        assert!(!of(None, None).contains_key("checkpoint_sha256"));
    }
}
