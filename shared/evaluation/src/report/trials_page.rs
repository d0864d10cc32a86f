//! The part of the page with the trials of six kinds. Writing into a `String` cannot fail, so results of `write!` are
//! dropped.

use super::{
    Results,
    markdown::{head, percent, row},
};
use crate::trials::views::{TrialFigures, kind_names};
use std::fmt::Write;

/// Writes the trials of six kinds with their baselines.
pub fn trials(page: &mut String, results: &Results) {
    if results.trials.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "## Trials of six kinds\n\nEvery pose gives images with a hazard and without. *Visible*, *partial* and *hidden* \
         refer to the actor or its place. Each image is one trial, with fresh sensor noise; the interval of the share \
         of halts (95 %, Wilson) counts poses. Halting is right with a hazard, advancing with a visible clear place. \
         Log loss and Brier score compare the hazard probability with the truth; compare them with those of the exact \
         posterior.\n"
    );
    let parts = [
        ("free", "Poses of no dataset"),
        ("unseen", "Held-out poses of the dataset"),
        ("rest", "Trained poses of the dataset (seen in training)"),
    ];
    for (part, title) in parts {
        let Some(own) = results.trials.get(part) else { continue };
        let _ = writeln!(page, "### {title}\n");
        let kinds: Vec<&str> = kind_names().filter(|kind| own.contains_key(*kind)).collect();
        let counts = |kind: &&str| format!("{kind}: {} images of {} poses", own[*kind].images, own[*kind].poses);
        let _ = writeln!(page, "{}.\n", kinds.iter().map(counts).collect::<Vec<_>>().join("; "));
        let mut cells = vec!["share of halts, %".to_owned()];
        cells.extend(kinds.iter().map(|kind| kind.replace('_', " ")));
        head(page, &cells.iter().map(String::as_str).collect::<Vec<_>>());
        let with_interval = |f: &TrialFigures| {
            let [low, high] = f.halt_interval.map(|v| 100.0 * v);
            format!("{} ({low:.0} to {high:.0})", percent(f.halts as f64 / f.trials.max(1) as f64))
        };
        let probabilities = |f: &TrialFigures| format!("{:.3} / {:.3}", f.log_loss, f.brier);
        trial_rows(page, results, part, &kinds, with_interval);
        "log loss / Brier score".clone_into(&mut cells[0]);
        page.push('\n');
        head(page, &cells.iter().map(String::as_str).collect::<Vec<_>>());
        trial_rows(page, results, part, &kinds, probabilities);
        page.push('\n');
    }
    for (name, baseline) in &results.baselines {
        let _ = writeln!(page, "- *{}*: {}.", name.replace('_', " "), baseline.about);
    }
    page.push('\n');
}

/// One row for the calibrated rule and one for each baseline.
fn trial_rows(
    page: &mut String,
    results: &Results,
    part: &str,
    kinds: &[&str],
    cell: impl Fn(&TrialFigures) -> String,
) {
    let baselines = results.baselines.iter().filter_map(|(name, b)| Some((name.as_str(), b.trials.get(part)?)));
    let own = results.trials.get(part).map(|own| ("calibrated", own));
    for (name, of_part) in own.into_iter().chain(baselines) {
        let mut cells = vec![name.replace('_', " ")];
        cells.extend(kinds.iter().map(|kind| of_part.get(*kind).map_or_else(|| "-".to_owned(), &cell)));
        row(page, &cells);
    }
}
