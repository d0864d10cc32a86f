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
    if !table.other_places.is_empty() {
        let _ = writeln!(
            page,
            "\n## Other places\n\nImages of other scenarios from their own poses, and images of this place that are mirrored, \
             turned upside down, or claim another pose. `advance` is wrong.\n"
        );
        head(page, &["images", "advances", "without comparison"]);
        for (name, f) in &table.other_places {
            let of = |count: usize| format!("{count} of {}", f.trials);
            row(page, &[name.clone(), of(f.advances), of(f.advances_without_comparison)]);
        }
    }
    let b = &table.bound;
    if b.drives > 0 {
        let level = b.level.map_or("none".to_owned(), |level| format!("at most {:.1} %", 100.0 * level));
        let _ = writeln!(
            page,
            "\n## Bound\n\nFree drives from another seed than the bound's. Bound of the checkpoint: {level}. Advances with the \
             hazard: {:.2} % of {} (95 % interval {:.2} to {:.2} %). Clear drives kept: {} of {}.\n",
            100.0 * b.found,
            b.drives,
            100.0 * b.interval[0],
            100.0 * b.interval[1],
            b.kept,
            b.clear_drives
        );
    }
    let _ = writeln!(
        page,
        "\n## Corrupted images\n\nUnsafe: hazard images (visible, in part, hidden) answered with `advance`. Kept: images of \
         a visible clear place answered with `advance`; in brackets, those that would be without the comparison. One column \
         for each severity; the row `clean` has none.\n"
    );
    head(page, &["corruption: unsafe / kept", "1", "2", "3", "4", "5"]);
    let cell = |f: &CorruptionFigures| {
        let kept = format!("{} ({}) of {}", f.kept, f.kept_without_comparison, f.clear_trials);
        format!("{} of {} / {kept}", f.r#unsafe, f.hazard_trials)
    };
    for (name, severities) in &table.corruptions {
        let mut cells = vec![name.replace('_', " ")];
        cells.extend(severities.values().map(cell));
        cells.resize(6, "-".to_owned());
        row(page, &cells);
    }
    page.push('\n');
}
