//! Errors as sentences.

use std::error::Error;

/// Returns an error and its causes as one sentence. A cause that the sentence already contains is left out.
///
/// ```
/// let cause = std::io::Error::other("disk on fire");
/// assert_eq!(carff_base::errors::sentence(&cause), "disk on fire");
/// ```
///
/// Control characters, which names of files can contain, are replaced, so that they do not reach a terminal.
pub fn sentence(error: &(dyn Error + 'static)) -> String {
    let mut sentence = error.to_string();
    let mut source = error.source();
    while let Some(error) = source {
        let cause = error.to_string();
        if !sentence.contains(&cause) {
            sentence = format!("{sentence}: {cause}");
        }
        source = error.source();
    }
    printable(&sentence)
}

/// Returns a text whose control characters, other than tabs and the ends of lines, are replaced by U+FFFD.
///
/// ```
/// assert_eq!(carff_base::errors::printable("a\u{1b}[31m\nb"), "a\u{fffd}[31m\nb");
/// ```
pub fn printable(text: &str) -> String {
    text.chars()
        .map(|c| if c.is_control() && !matches!(c, '\n' | '\t') { char::REPLACEMENT_CHARACTER } else { c })
        .collect()
}

/// Returns a description, with a remedy, of a file that tools leave in place of the wanted data: a Git LFS pointer, a
/// web page, or the XML reply of a server. `head` is the start of the file, 64 bytes or more.
///
/// ```
/// let pointer = b"version https://git-lfs.github.com/spec/v1\noid sha256:0";
/// assert!(carff_base::errors::stand_in(pointer).unwrap().contains("git lfs pull"));
/// assert_eq!(carff_base::errors::stand_in(b"\x89PNG"), None);
/// ```
pub fn stand_in(head: &[u8]) -> Option<&'static str> {
    let text = String::from_utf8_lossy(head).trim_start_matches('\u{feff}').trim_start().to_ascii_lowercase();
    if text.starts_with("version https://git-lfs.github.com/spec") {
        return Some("a Git LFS pointer, not the data; run `git lfs pull` in the repository that it is from");
    }
    ["<!doctype", "<!--", "<html", "<?xml", "<head"].iter().any(|start| text.starts_with(start)).then_some(
        "a web page or an XML reply, not the data; download the file from its direct (`raw` or `resolve`) address",
    )
}
