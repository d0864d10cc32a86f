//! The part of the page with unknown objects and corrupted images. Writing into a `String` cannot fail, so results of
//! `write!` are dropped.

use super::{
    Results,
    markdown::{head, row},
};
use crate::tables::robustness::CorruptionFigures;
use std::fmt::Write;

/// Writes the table of unknown objects and that of corruptions.
pub fn robustness(page: &mut String, results: &Results) {
    let Some(table) = &results.robustness else { return };
    let _ = writeln!(
        page,
        "## Unknown objects\n\nEach image has the object in sight (100 pixels or more at 128 x 128), from a free pose of \
         its own. On the road, `advance` is wrong. *Without comparison*: the encoder's path only.\n"
    );
    head(page, &["object", "where", "training", "advances", "without comparison", "below 0.05"]);
    for (name, f) in &table.unknown {
        let of = |count: usize| format!("{count} of {}", f.trials);
        let place = if f.beside { "next to the road" } else { "on the road" };
        let training = if f.held_out { "held out" } else { "may be used" };
        row(
            page,
            &[
                name.clone(),
                place.into(),
                training.into(),
                of(f.advances),
                of(f.advances_without_comparison),
                of(f.below_5_percent),
            ],
        );
    }
    let _ = writeln!(
        page,
        "\n## Corrupted images\n\nUnsafe: hazard images (visible, in part, hidden) answered with `advance`. Kept: images of \
         a visible clear place answered with `advance`. One column for each severity; the row `clean` has none.\n"
    );
    head(page, &["corruption: unsafe / kept", "1", "2", "3", "4", "5"]);
    let cell =
        |f: &CorruptionFigures| format!("{} of {} / {} of {}", f.r#unsafe, f.hazard_trials, f.kept, f.clear_trials);
    for (name, severities) in &table.corruptions {
        let mut cells = vec![name.replace('_', " ")];
        cells.extend(severities.values().map(cell));
        cells.resize(6, "-".to_owned());
        row(page, &cells);
    }
    page.push('\n');
}
