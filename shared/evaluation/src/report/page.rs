//! The page `README.md`: every table as text, with the images.

use super::{
    Results,
    horizon_page::horizon,
    images_page::images,
    localisation_page::localisation,
    markdown::{db, head, percent, row},
    memory_page::memory,
    planning_page::planning,
    robustness_page::robustness,
    trials_page::trials,
    vehicles_page::vehicles,
};
use crate::stats::draws::Frequencies;
use crate::{ByRole, EncoderTable, FrequencyTable, Share, SvmScore};
use std::fmt::Write;

/// Returns the page as Markdown. Writing into a `String` cannot fail, so results of `write!` are dropped.
pub fn page(results: &Results) -> String {
    let mut page = String::new();
    let about = &results.subject;
    let _ = writeln!(page, "# {}: results\n", about.scenario);
    let [trained, calibration, held_out] =
        [about.poses.trained, about.poses.calibration, about.poses.unseen].map(Option::unwrap_or_default);
    let _ = writeln!(
        page,
        "Checkpoint `{}` on dataset `{}`: {} branches ({}) of {} steps, {} images from {} poses. {trained} poses were \
         used for training only (*trained*), {calibration} for training and the threshold (*calibration*), and \
         {held_out} were held out (*held-out*, in files `unseen`). Seeds: training {}, split {}, draws of this \
         evaluation {}. All tables separate *trained* and *held-out* poses. Nothing on this page chose a setting. \
         `results.json` has every figure.\n",
        about.checkpoint,
        about.dataset,
        about.branches.len(),
        about.branches.join(", "),
        about.timestamps,
        about.images,
        trained + calibration + held_out,
        about.training_seed,
        about.split_seed,
        about.seed
    );
    targets(&mut page, results);
    if let Some(table) = &results.images {
        images(&mut page, table);
    }
    if let Some(table) = &results.encoder {
        let _ = writeln!(page, "## Encoder and decoder\n");
        encoder_rows(&mut page, &[("this checkpoint".to_owned(), table)]);
        state_accuracy(&mut page, table);
    }
    forecast(&mut page, results);
    if let Some(table) = &results.planning {
        planning(&mut page, table);
    }
    trials(&mut page, results);
    horizon(&mut page, results);
    robustness(&mut page, results);
    localisation(&mut page, results);
    memory(&mut page, results);
    vehicles(&mut page, results);
    reliability(&mut page, results);
    frequencies(&mut page, &results.frequencies);
    for image in results.gallery.iter().flat_map(|g| &g.images) {
        let _ = writeln!(page, "## {}\n\n{}\n\n![{0}]({})\n", image.title, image.text, image.file);
    }
    if !results.left_out.is_empty() {
        let _ = writeln!(page, "## Left out\n");
        for (table, why) in &results.left_out {
            let _ = writeln!(page, "- *{table}*: {why}.");
        }
    }
    page.truncate(page.trim_end().len());
    page.push('\n');
    page
}

fn targets(page: &mut String, results: &Results) {
    if results.targets.is_empty() {
        return;
    }
    let missed = results.targets.iter().filter(|t| !t.reached).count();
    let _ = writeln!(
        page,
        "## Targets\n\n{} of {} targets are reached, {missed} are missed.\n",
        results.targets.len() - missed,
        results.targets.len()
    );
    head(page, &["figure", "paper", "target", "measured", ""]);
    for t in &results.targets {
        let verdict = if t.reached { "reached" } else { "**missed**" };
        row(page, &[t.what.clone(), t.paper.clone(), t.wanted.clone(), t.found.clone(), verdict.into()]);
    }
    page.push('\n');
}

/// Writes the encoder table with one row for each named encoder.
pub fn encoder_rows(page: &mut String, rows: &[(String, &EncoderTable)]) {
    let _ = writeln!(
        page,
        "*Train PSNR*: the decoder on trained poses, from each image's own latent. *Mean image*: the pose's mean \
         image, which needs no encoder. *Novel view*: the decoder from the latent of another pose's image of the same \
         state. *SVM*: exact-state accuracy of a support vector machine (RBF, C = 1, gamma = 1 / (8 variance)) on \
         latents; its ceiling is below 100 % where states look the same. Trained poses: 10 folds by image, as in the \
         paper, where duplicates of a left-out image stay in the training folds under other states and keep the \
         accuracy below the ceiling; and 10 folds by pose, without duplicates. Held-out poses: fitted on all \
         trained poses.\n"
    );
    head(
        page,
        &[
            "encoder",
            "train PSNR, dB",
            "mean image, dB",
            "pixels that change, dB",
            "novel view, dB",
            "novel view, pixels that change, dB",
            "SVM, % of ceiling %, trained",
            "up to equivalence, %",
            "by pose, %",
            "up to equivalence, %",
            "SVM, % of ceiling %, held-out",
            "up to equivalence, %",
        ],
    );
    for (name, t) in rows {
        let svm = |s: &SvmScore| format!("{} of {}", percent(s.accuracy), percent(s.ceiling));
        row(
            page,
            &[
                name.clone(),
                db(Some(t.train.psnr_db)),
                db(Some(t.train.mean_image_psnr_db)),
                db(Some(t.train.changed_pixels_psnr_db)),
                db(Some(t.novel_view.psnr_db)),
                db(Some(t.novel_view.changed_pixels_psnr_db)),
                svm(&t.svm.trained),
                percent(t.svm.trained.up_to_equivalence),
                percent(t.svm.trained_by_pose.accuracy),
                percent(t.svm.trained_by_pose.up_to_equivalence),
                svm(&t.svm.unseen),
                percent(t.svm.unseen.up_to_equivalence),
            ],
        );
    }
    if let Some((_, t)) = rows.first() {
        let _ = writeln!(
            page,
            "\n{} images of trained poses, {} of held-out poses, {} decoded from the latent of another pose.\n",
            t.svm.trained.images, t.svm.unseen.images, t.novel_view.images
        );
    }
}

fn state_accuracy(page: &mut String, table: &EncoderTable) {
    if table.state_accuracy.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "### State accuracy\n\nThe state is that of the nearest state centroid. An answer is correct when its state \
         looks, from that pose, like the true one. In brackets: exact-state accuracy and its upper bound. Columns: \
         visibility of the actor's place.\n"
    );
    head(page, &["poses", "place fully visible, %", "partly, %", "not, %"]);
    for (part, a) in table.state_accuracy.iter() {
        let share = |s: &Share| match s.trials {
            0 => "-".to_owned(),
            n => {
                format!("{} of {n} images ({} of {})", percent(s.accuracy()), percent(s.raw()), percent(s.ceiling()))
            }
        };
        row(page, &[part.into(), share(&a.full), share(&a.partial), share(&a.none)]);
    }
    page.push('\n');
}

fn forecast(page: &mut String, results: &Results) {
    let Some(table) = &results.forecast else { return };
    let _ = writeln!(
        page,
        "## Accuracy and recall against the number of samples\n\n*Accuracy* is over images that show the actor's place \
         fully and leave one branch open: share of samples whose state looks, from that pose, like a possible next \
         state; and whether the most frequent state does. *Recall* is over images that leave several branches open: \
         whether any of n samples shows the true branch. With independent draws and an even belief over two branches \
         the recall is 1 - 0.5^n; stratified draws, as in the running graph, give each component its share of the \
         samples. *Posterior only*: drawn from the encoder's posterior, without a forecast, for the image's own step. \
         Each image has sensor noise once and several trials with fresh draws: trials of one image are not \
         independent.\n\n![Accuracy and recall](recall.png)\n"
    );
    let counts = [1, 2, 3, 4, 5, 10, 20, 50];
    for (part, c) in table.parts.iter() {
        let _ = writeln!(
            page,
            "### {} poses\n\nAccuracy: {} trials of {} images. Recall: {} trials of {} images.\n",
            capital(part),
            c.accuracy.trials,
            c.accuracy.images,
            c.recall.trials,
            c.recall.images
        );
        let mut cells = vec!["%".to_owned()];
        cells.extend(counts.iter().map(|n| format!("n = {n}")));
        head(page, &cells.iter().map(String::as_str).collect::<Vec<_>>());
        let mut line = |name: &str, values: &[f64], band: &[[f64; 2]]| {
            if values.is_empty() {
                return;
            }
            let mut cells = vec![name.to_owned()];
            cells.extend(counts.iter().map(|&n| match (values.get(n - 1), band.get(n - 1)) {
                (Some(v), Some([low, high])) => {
                    format!("{} ({:.0} to {:.0})", percent(*v), 100.0 * low, 100.0 * high)
                }
                (Some(v), None) => percent(*v),
                _ => "-".to_owned(),
            }));
            row(page, &cells);
        };
        line("accuracy of samples (80 % of the images)", &c.accuracy.mean, &c.accuracy.band);
        line("most frequent state", &c.majority_accuracy.mean, &c.majority_accuracy.band);
        line("posterior only, accuracy", &c.posterior_accuracy.mean, &c.posterior_accuracy.band);
        line("recall, independent draws", &c.recall.mean, &c.recall.band);
        line("expected recall", &c.expected_recall, &c.expected_band);
        line("recall, stratified draws", &c.stratified_recall.mean, &c.stratified_recall.band);
        line("recall of all open branches, stratified", &c.stratified_recall_of_all.mean, &[]);
        line("posterior only, recall", &c.posterior_recall.mean, &c.posterior_recall.band);
        page.push('\n');
    }
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().collect::<String>() + letters.as_str())
}

fn reliability(page: &mut String, results: &Results) {
    if results.hazard_reliability.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "## Reliability of the hazard probability\n\nHazard probability (n = 10, stratified) of every image that has a \
         next step, once with sensor noise, against whether its branch has a hazard. Bins of one tenth.\n\n\
         ![Reliability](reliability.png)\n"
    );
    head(page, &["poses", "images", "expected calibration error", "bins: forecast, measured share, images"]);
    for (part, r) in results.hazard_reliability.iter() {
        let bin = |b: &carff_trials::ReliabilityBin| format!("{:.2}: {:.2} of {}", b.forecast, b.happened, b.trials);
        let bins: Vec<String> = r.bins.iter().map(bin).collect();
        let error = format!("{:.3}", r.expected_calibration_error);
        row(page, &[part.into(), r.trials.to_string(), error, bins.join("; ")]);
    }
    page.push('\n');
}

fn frequencies(page: &mut String, parts: &ByRole<FrequencyTable>) {
    if parts.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "## Frequencies where several outcomes are open\n\nIndependent samples of the next step's forecast, from \
         images that leave several outcomes open: measured and expected frequency of each outcome. Images are grouped \
         by their open outcomes; 95 % intervals are from the spread among images.\n"
    );
    for (part, table) in parts.iter() {
        let _ = writeln!(page, "### {} poses\n", capital(part));
        head(page, &["open", "images, samples", "outcome", "drawn, %", "expected, %", "other outcomes, unknown, %"]);
        for group in table.by_branch.iter().chain(&table.by_presence) {
            group_rows(page, group);
        }
        page.push('\n');
    }
}

fn group_rows(page: &mut String, group: &Frequencies) {
    let open: Vec<&str> = group.outcomes.iter().map(|o| o.outcome.as_str()).collect();
    for (i, outcome) in group.outcomes.iter().enumerate() {
        let first = |text: String| if i == 0 { text } else { String::new() };
        let [low, high] = outcome.interval;
        row(
            page,
            &[
                first(open.join(", ")),
                first(format!("{}, {}", group.images, group.samples)),
                outcome.outcome.clone(),
                format!("{} ({:.0} to {:.0})", percent(outcome.drawn), 100.0 * low, 100.0 * high),
                percent(outcome.expected),
                first(format!("{}, {}", percent(group.ruled_out), percent(group.unknown))),
            ],
        );
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tables::planning::PlanningResults;
    use crate::{ByObservability, FieldImages, ImageTable, PairMeans};
    use carff_dataset::drives::DriveKind;
    use carff_messages::Rule;
    use std::collections::BTreeMap;

    /// Every table of a page has the same number of cells in each row, as Markdown readers expect.
    fn assert_tables_are_even(page: &str) {
        let cells = |line: &str| line.matches('|').count();
        let mut wanted = None;
        for line in page.lines() {
            if line.starts_with('|') {
                assert_eq!(*wanted.get_or_insert(cells(line)), cells(line), "{line}");
            } else {
                wanted = None;
            }
        }
    }

    /// A page without results names its subject, and the tables that are left out with the reasons.
    #[test]
    fn a_page_without_results() {
        let mut results = Results::default();
        results.subject.scenario = "crossing".into();
        results.left_out.insert("planning".into(), "there is one branch".into());
        let page = page(&results);
        assert!(page.starts_with("# crossing: results\n") && page.contains("- *planning*: there is one branch."));
        assert!(!page.contains("## Targets"));
    }

    /// Tables are even, missing values are dashes, and figures are rounded.
    #[test]
    fn tables_are_even() {
        let images = FieldImages {
            psnr_db: vec![Some(vec![30.04, 20.0]), None],
            by_branch: BTreeMap::from([("a".into(), PairMeans::default())]),
            ..FieldImages::default()
        };
        let mut planning = PlanningResults { threshold: Some(0.25), ..PlanningResults::default() };
        planning.all_views.add(Rule::Paper, 10, DriveKind::Clear, true);
        let results = Results {
            images: Some(ImageTable {
                states: vec!["a t0".into(), "a t1".into()],
                toggled: Some(images),
                ..ImageTable::default()
            }),
            encoder: Some(EncoderTable {
                state_accuracy: ByRole { unseen: Some(ByObservability::default()), ..ByRole::default() },
                ..EncoderTable::default()
            }),
            planning: Some(planning),
            ..Results::default()
        };
        let page = page(&results);
        assert_tables_are_even(&page);
        assert!(page.contains("| a t0 | **30.0** | 20.0 |") && !page.contains("\n| a t1 "), "{page}");
        assert!(page.contains("| paper | 10 | - | 1/1 (21 to 100 %) |"), "{page}");
        assert!(page.contains("| held-out | - | - | - |"), "{page}");
    }
}
