//! The place of a file's summary, which names all channels.

use mcap::{MAGIC, McapResult};
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::ops::Range;

/// Length of the footer: code, length, start of the summary, start of its offsets, checksum.
const FOOTER_BYTES: u64 = 1 + 8 + 8 + 8 + 4;

/// Returns the range of the summary; `None` for a file without one.
pub(crate) fn range(file: &mut File) -> McapResult<Option<Range<u64>>> {
    let end = file.metadata()?.len();
    let Some(footer) = end.checked_sub(FOOTER_BYTES + MAGIC.len() as u64) else { return Ok(None) };
    let mut bytes = [0; FOOTER_BYTES as usize];
    file.seek(SeekFrom::Start(footer))?;
    file.read_exact(&mut bytes)?;
    let start = bytes[9..17].try_into().map_or(0, u64::from_le_bytes);
    let is_footer = bytes[0] == mcap::records::op::FOOTER;
    Ok((is_footer && start > 0 && start < footer).then_some(start..footer))
}
