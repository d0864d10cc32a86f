//! The part of the page with several horizons. Writing into a `String` cannot fail, so results of `write!` are dropped.

use super::{
    Results,
    markdown::{head, row},
};
use std::fmt::Write;

/// Writes the table of horizons.
pub fn horizon(page: &mut String, results: &Results) {
    let Some(table) = &results.horizon else { return };
    let _ = writeln!(
        page,
        "## Horizon\n\n{} images of {} free poses, one of each branch at each pose; the calibrated rule has the threshold \
         {:.3}. The right decision is that of the exact posterior, which knows scenario and pose: to halt if the \
         probability that the hazard comes at any later time reaches the threshold. Log losses are of that event.\n",
        table.images, table.poses, table.threshold
    );
    head(
        page,
        &[
            "feedback",
            "horizon",
            "log loss",
            "exact, as far ahead",
            "Brier score",
            "hazard comes: advances",
            "hazard excluded: halts",
            "decisions changed against horizon 1",
            "of these right",
        ],
    );
    for (feedback, rows) in &table.feedback {
        for figures in rows {
            row(
                page,
                &[
                    feedback.clone(),
                    figures.horizon.to_string(),
                    format!("{:.3}", figures.log_loss),
                    format!("{:.3}", figures.exact_log_loss),
                    format!("{:.3}", figures.brier),
                    format!("{} of {}", figures.unsafe_advances, table.hazard_images),
                    format!("{} of {}", figures.needless_halts, table.excluding_images),
                    figures.changed.to_string(),
                    figures.improved.to_string(),
                ],
            );
        }
    }
    page.push('\n');
}
