//! The part of the page with the belief with and without memory. Writing into a `String` cannot fail, so results of
//! `write!` are dropped.

use super::{
    Results,
    markdown::{head, row},
};
use crate::tables::memory::{ObserverFigures, RightFrames};
use std::fmt::Write;

/// Observers, in the order of the page.
const OBSERVERS: [(&str, &str); 6] = [
    ("none", "each image by itself"),
    ("compared", "each image by itself, with its comparison"),
    ("filter", "with memory"),
    ("graph", "with memory, and with the comparison of each image"),
    ("exact", "exact posterior, each image by itself"),
    ("exact_filter", "exact posterior of all images: the ceiling"),
];

/// Writes the table of observers.
pub fn memory(page: &mut String, results: &Results) {
    let Some(table) = &results.memory else { return };
    let _ = writeln!(
        page,
        "## Memory\n\n{} drives with {} frames; the camera pans, so that the place passes in and out of sight. The exact \
         posterior knows scenario and pose, with equally probable states. Counts are frames, with their drives. Share of \
         repeated evidence {}, distrust {}, strength of places {}.\n",
        table.drives,
        table.frames,
        table.settings.repeated_share,
        table.settings.distrust,
        table.settings.place_strength
    );
    head(
        page,
        &[
            "observer",
            "log loss a frame",
            "calibration error",
            "seen, then hidden: at least 0.95",
            "seen clear, then hidden: at most 0.05",
            "never seen: 0.4 to 0.6",
            "wrong, corrected in 3 frames",
        ],
    );
    let count = |f: &RightFrames| format!("{} of {} ({} drives)", f.right, f.frames, f.drives);
    for (name, about) in OBSERVERS {
        let Some(figures) = table.observers.get(name) else { continue };
        let ObserverFigures { log_loss, calibration_error, seen_then_hidden, clear_then_hidden, never_seen, corrected } =
            figures;
        let cells = [seen_then_hidden, clear_then_hidden, never_seen, corrected].map(count);
        let numbers = [about.to_owned(), format!("{log_loss:.3}"), format!("{calibration_error:.3}")];
        row(page, &numbers.into_iter().chain(cells).collect::<Vec<_>>());
    }
    page.push('\n');
}
