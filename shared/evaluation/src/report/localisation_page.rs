//! The part of the page with both methods of localisation. Writing into a `String` cannot fail, so results of `write!`
//! are dropped.

use super::{
    Results,
    markdown::{head, row},
};
use std::fmt::Write;

/// Writes the table of both methods.
pub fn localisation(page: &mut String, results: &Results) {
    let Some(table) = &results.localisation else { return };
    let _ = writeln!(
        page,
        "## Localisation\n\nTen samples of the next step's forecast of each image, read by density probing and by \
         segmentation of the view from above (64 pixels; a network trained on {} rendered views with masks). Times are \
         of one thread, without the training of the network.\n",
        table.trained_views
    );
    head(
        page,
        &["poses", "method", "possible next state", "no known state", "fails alone", "ms a sample", "same state"],
    );
    for (role, figures) in table.parts.iter() {
        for (name, method) in [("density", &figures.density), ("segmentation", &figures.segmentation)] {
            let of = |count: usize| format!("{count} of {}", figures.samples);
            row(
                page,
                &[
                    role.to_owned(),
                    name.to_owned(),
                    of(method.possible),
                    method.unknown.to_string(),
                    method.only_this_fails.to_string(),
                    format!("{:.2}", method.ms_per_sample),
                    of(figures.agree),
                ],
            );
        }
    }
    page.push('\n');
}
