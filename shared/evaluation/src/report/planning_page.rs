//! The page's tables of planning.

use super::markdown::{head, row};
use crate::SAMPLE_COUNTS;
use crate::tables::planning::{PlanningResults, ViewCounts};
use carff_trials::{Count, PlanningTable};
use std::fmt::Write;

/// Writes the tables of planning.
pub fn planning(page: &mut String, table: &PlanningResults) {
    let _ = writeln!(
        page,
        "## Planning\n\nTwo kinds of trial have one correct action. *Hazard*: a hazard branch with a hidden actor; \
         halting is correct. *Clear*: another branch with a visible place; advancing is correct. Correct actions out \
         of trials, with 95 % Wilson intervals. {}\n",
        table.threshold.map_or_else(
            || "The checkpoint has no threshold, so the calibrated rule is left out.".to_owned(),
            |t| format!(
                "The calibrated rule halts at a hazard probability of {t:.3} or more. The threshold was chosen on the \
                         calibration poses when the checkpoint was made."
            ),
        )
    );
    let one = [("hazard", table.one_image_views.hazard), ("clear", table.one_image_views.clear)]
        .map(|(kind, image)| image.map(|v| format!("{kind}: pose {}, branch {}, t{}", v.view, v.branch, v.timestamp)));
    let one: Vec<String> = one.into_iter().flatten().collect();
    let of_views = |v: &ViewCounts| {
        format!(
            "{} hazard images with {} trials each, and {} clear images with {} trials each, with fresh sensor noise. \
             Images that differ only in noise are not independent trials.",
            v.hazard, v.hazard_repeats, v.clear, v.clear_repeats
        )
    };
    let parts = [
        (
            "The paper's protocol: one image, 30 trials",
            &table.one_image,
            format!("Drawn by seed ({}).", one.join("; ")),
        ),
        ("All views of trained poses", &table.all_views, of_views(&table.views.all_views)),
        (
            "All views of trained poses, independent draws",
            &table.all_views_independent,
            "The images above with independent draws, as in the paper; the running graph draws stratified samples."
                .to_owned(),
        ),
        ("Unseen views", &table.unseen_views, of_views(&table.views.unseen_views)),
        (
            "Calibration views",
            &table.calibration_views,
            format!("These poses chose the threshold. {}", of_views(&table.views.calibration_views)),
        ),
    ];
    for (title, of_part, text) in parts {
        planning_part(page, title, of_part, &text);
    }
    if let Some(free) = &table.free_drives {
        planning_part(page, "Free drives", free, "Rendered from free poses that were not trained on.");
    }
}

fn planning_part(page: &mut String, title: &str, table: &PlanningTable, text: &str) {
    let _ = writeln!(page, "### {title}\n\n{text}\n");
    if table.is_empty() {
        let _ = writeln!(page, "No image of these poses is a trial.\n");
        return;
    }
    head(page, &["rule", "n", "hazard: halts", "clear: advances"]);
    for (rule, by_samples) in table.rules() {
        // Two rules ignore the samples.
        let any = rule.ends_with("confident");
        let counts = if any { &SAMPLE_COUNTS[..1] } else { &SAMPLE_COUNTS[..] };
        for samples in counts.iter().filter(|_| !by_samples.is_empty()) {
            let counts = by_samples.get(samples).copied().unwrap_or_default();
            let samples = if any { "any".to_owned() } else { samples.to_string() };
            row(page, &[rule.into(), samples, count(counts.hazard), count(counts.clear)]);
        }
    }
    page.push('\n');
}

fn count(count: Option<Count>) -> String {
    count.filter(|c| c.trials > 0).map_or_else(
        || "-".to_owned(),
        |c| {
            let [low, high] = c.interval.map(|v| 100.0 * v);
            format!("{}/{} ({low:.0} to {high:.0} %)", c.success, c.trials)
        },
    )
}
