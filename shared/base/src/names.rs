//! Suggestions of existing names for errors about unknown names. No decision depends on them.
//!
//! ```
//! use carff_base::names::{hint, nearest};
//! let topics = ["camera/frame", "prober/belief", "controller/action"];
//! assert_eq!(nearest("prober/beleif", topics), Some("prober/belief"));
//! assert_eq!(nearest("belief", topics), Some("prober/belief"));
//! assert_eq!(nearest("weather", topics), None);
//! assert_eq!(hint("camra/frame", topics), "; did you mean `camera/frame`?");
//! assert_eq!(hint("weather", topics), "");
//! ```

use std::path::{Path, PathBuf};

/// Minimum length of a name that is searched inside longer ones.
const MIN_PART: usize = 3;
/// Maximum number of folder entries that are compared.
const MAX_ENTRIES: usize = 1000;

/// Returns the known name that is nearest to `name`: at most a third of its letters differ, or it is a part of the
/// known name. The last part of a known name with slashes counts too. `None` if nothing is near.
pub fn nearest<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> Option<&'a str> {
    let wanted = name.to_lowercase();
    let letters = wanted.chars().count();
    let allowed = (letters / 3).max(1);
    let mut best: Option<(usize, &str)> = None;
    for candidate in known {
        let lower = candidate.to_lowercase();
        let last = lower.rsplit('/').next().unwrap_or(&lower);
        let distance = strsim::damerau_levenshtein(&wanted, &lower).min(strsim::damerau_levenshtein(&wanted, last));
        let rank = if distance <= allowed && distance < letters {
            distance
        } else if letters >= MIN_PART && lower.contains(&wanted) {
            // Parts rank behind all misspellings; of two names that contain it, the shorter is nearer.
            letters + lower.len()
        } else {
            continue;
        };
        if best.is_none_or(|(least, _)| rank < least) {
            best = Some((rank, candidate));
        }
    }
    best.map(|(_, candidate)| candidate)
}

/// Returns the end of an error about an unknown name: "; did you mean `x`?", or nothing.
pub fn hint<'a>(name: &str, known: impl IntoIterator<Item = &'a str>) -> String {
    nearest(name, known).map(|found| format!("; did you mean `{found}`?")).unwrap_or_default()
}

/// Adds the hint to a message of serde about an unknown field or variant; other messages are unchanged.
///
/// ```
/// let message = "unknown field `horizn`, expected one of `name`, `horizon`";
/// assert_eq!(carff_base::names::explained(message), format!("{message}; did you mean `horizon`?"));
/// ```
pub fn explained(message: &str) -> String {
    let message = message.trim_end();
    format!("{message}{}", serde_hint(message).unwrap_or_default())
}

fn serde_hint(message: &str) -> Option<String> {
    let (_, rest) = message.split_once("unknown field `").or_else(|| message.split_once("unknown variant `"))?;
    let (name, rest) = rest.split_once('`')?;
    let (_, known) = rest.split_once("expected ")?;
    // Text between backquotes: every second piece.
    Some(hint(name, known.split('`').skip(1).step_by(2)))
}

/// Returns the hint for a path that does not exist: the nearest name in the last existing folder of the path. Empty for
/// an existing path.
pub fn beside(path: &Path) -> String {
    sibling(path).map(|found| format!("; did you mean {}?", found.display())).unwrap_or_default()
}

fn sibling(path: &Path) -> Option<PathBuf> {
    if path.as_os_str().is_empty() || path.exists() {
        return None;
    }
    let folder = match path.parent() {
        Some(folder) if !folder.as_os_str().is_empty() => folder,
        _ => Path::new("."),
    };
    if !folder.is_dir() {
        return sibling(folder).map(|found| found.join(path.file_name().unwrap_or_default()));
    }
    let names: Vec<String> = std::fs::read_dir(folder)
        .ok()?
        .take(MAX_ENTRIES)
        .flatten()
        .filter_map(|e| e.file_name().into_string().ok())
        .collect();
    let found = nearest(path.file_name()?.to_str()?, names.iter().map(String::as_str))
        .or_else(|| nearest(path.file_stem()?.to_str()?, names.iter().map(String::as_str)))?;
    Some(path.with_file_name(found))
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Misspellings, swapped letters, case and parts are found; the nearest name wins; distant names are not suggested.
    #[test]
    fn the_nearest_or_none() {
        let known = ["horizon", "samples", "sampling", "seed", "frame_rate_hz"];
        for (name, want) in [
            ("horizn", Some("horizon")),
            ("Horizon", Some("horizon")),
            ("sampels", Some("samples")),
            ("frame_rate", Some("frame_rate_hz")),
            ("sed", Some("seed")),
            ("x", None),
            ("", None),
            ("temperature", None),
        ] {
            assert_eq!(nearest(name, known), want, "{name}");
        }
    }

    /// Messages of serde of every form get their hint; other messages are unchanged.
    #[test]
    fn messages_of_serde() {
        for (message, end) in [
            ("unknown field `sed`, expected `seed`", "; did you mean `seed`?"),
            ("unknown variant `stratifed`, expected `stratified` or `independent`", "; did you mean `stratified`?"),
            ("unknown field `zzz`, expected one of `a`, `b`", ""),
            ("unknown field `a`, there are no fields", ""),
            ("invalid type: string \"two\", expected u32", ""),
            ("unknown field `", ""),
        ] {
            assert_eq!(explained(message), format!("{message}{end}"));
        }
    }

    /// A missing file is compared with its neighbours, with or without its extension, and so is a missing folder. An
    /// existing path, or one without neighbours, gets no hint.
    #[test]
    fn missing_paths() {
        let root = tempfile::tempdir().unwrap();
        let folder = root.path().join("scenarios");
        std::fs::create_dir(&folder).unwrap();
        let there = folder.join("approaching-intersection.toml");
        std::fs::write(&there, "").unwrap();
        let expected = format!("; did you mean {}?", there.display());
        assert_eq!(beside(&folder.join("aproaching-intersection.toml")), expected);
        assert_eq!(beside(&folder.join("approaching.toml")), expected);
        assert_eq!(beside(&root.path().join("scenario/approaching-intersection.toml")), expected);
        assert_eq!(beside(&there), "");
        assert_eq!(beside(&folder.join("weather.toml")), "");
        assert_eq!(beside(Path::new("")), "");
    }
}
