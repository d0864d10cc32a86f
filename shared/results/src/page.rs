//! The page for a reader: every table in words and figures, with the pictures.

use crate::planning::PlanningResults;
use crate::targets::cell;
use crate::{EncoderTable, FieldPictures, FrequencyTable, PictureTable, Results};
use carff_evaluation::{Count, PairMeans, PlanningTable, SAMPLE_COUNTS, draws::Frequencies};
use std::collections::BTreeMap;
use std::fmt::Write;

/// The parts of the poses, in the order they are shown.
const PARTS: [&str; 3] = ["trained", "calibration", "unseen"];

/// The page as Markdown. Writing into a `String` cannot fail, so results of `write!` are dropped.
pub fn page(results: &Results) -> String {
    let mut page = String::new();
    let about = &results.subject;
    let _ = writeln!(page, "# {}: results\n", about.scenario);
    let poses = |part: &str| about.poses.get(part).copied().unwrap_or(0);
    let _ = writeln!(
        page,
        "Checkpoint `{}` on data set `{}`: {} branches ({}) of {} steps, {} pictures from {} poses. {} poses were \
         trained on and chose nothing (*trained*), {} were trained on and chose the threshold (*calibration*), {} were \
         never trained on (*unseen*). Seeds: training {}, split {}, draws here {}. All tables say *trained* and *unseen* \
         apart; nothing on this page chose a setting. `results.json` has every figure.\n",
        about.checkpoint,
        about.dataset,
        about.branches.len(),
        about.branches.join(", "),
        about.timestamps,
        about.pictures,
        poses("trained") + poses("calibration") + poses("unseen"),
        poses("trained"),
        poses("calibration"),
        poses("unseen"),
        about.training_seed,
        about.split_seed,
        about.seed
    );
    targets(&mut page, results);
    if let Some(table) = &results.pictures {
        pictures(&mut page, table);
    }
    if let Some(table) = &results.encoder {
        let _ = writeln!(page, "## Encoder and decoder\n");
        encoder(&mut page, &[("this checkpoint".to_owned(), table)]);
        state_accuracy(&mut page, table);
    }
    forecast(&mut page, results);
    if let Some(table) = &results.planning {
        planning(&mut page, table);
    }
    reliability(&mut page, results);
    frequencies(&mut page, &results.frequencies);
    for picture in results.gallery.iter().flat_map(|g| &g.pictures) {
        let _ = writeln!(page, "## {}\n\n{}\n\n![{0}]({})\n", picture.title, picture.text, picture.file);
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

/// A head row with its rule.
fn head(page: &mut String, cells: &[&str]) {
    let _ = writeln!(page, "| {} |\n|{}", cells.join(" | "), "---|".repeat(cells.len()));
}

fn row(page: &mut String, cells: &[String]) {
    let _ = writeln!(page, "| {} |", cells.join(" | "));
}

fn db(value: Option<f64>) -> String {
    value.map_or_else(|| "-".into(), |v| format!("{v:.1}"))
}

fn percent(value: f64) -> String {
    // No minus before a zero.
    format!("{:.1}", 100.0 * value + 0.0)
}

fn targets(page: &mut String, results: &Results) {
    if results.targets.is_empty() {
        return;
    }
    let missed = results.targets.iter().filter(|t| !t.reached).count();
    let _ = writeln!(
        page,
        "## Wanted and found\n\n{} of {} figures are reached, {missed} missed.\n",
        results.targets.len() - missed,
        results.targets.len()
    );
    head(page, &["figure", "paper", "wanted", "found", ""]);
    for t in &results.targets {
        let verdict = if t.reached { "reached" } else { "**missed**" };
        row(page, &[t.what.clone(), t.paper.clone(), t.wanted.clone(), t.found.clone(), verdict.into()]);
    }
    page.push('\n');
}

fn pictures(page: &mut String, table: &PictureTable) {
    let _ = writeln!(page, "## Pictures of the field\n");
    if let Some(toggled) = &table.toggled {
        let _ = writeln!(
            page,
            "From above, PSNR in dB of each rendered state (row) against every true one (column). *Matching* is the \
             diagonal; *un-matching* all else, but for pairs of states that look the same from above.\n\n### Known \
             states, toggled\n\nRendered with the latent that stands for the state: {} renderings.\n",
            toggled.renderings
        );
        matrix(page, &table.states, toggled);
        means(page, toggled, table.mean_picture_db);
    }
    if let Some(predicted) = &table.predicted {
        let _ = writeln!(
            page,
            "### Forecast states\n\nRendered with latents drawn from the forecast of the step before, from pictures of \
             trained poses that tell their state: {} renderings. Rows that are missing are first steps, which nothing \
             forecasts.\n",
            predicted.renderings
        );
        matrix(page, &table.states, predicted);
        means(page, predicted, table.mean_picture_db);
    } else if table.toggled.is_some() {
        let _ = writeln!(
            page,
            "No forecast states: there is no forecast, or no picture of a state with a next step tells that state alone.\n"
        );
    }
    if !table.novel_views.is_empty() {
        let _ = writeln!(
            page,
            "### Other poses\n\nThe field from the poses of the data set, with the latent that stands for the state. \
             Unseen poses were held out from its training. The pose's mean picture over all states is made of true \
             pictures: it knows the background, and no state. Where little changes, little is to be gained over it, and \
             on unseen poses it has seen what the field has not.\n"
        );
        head(page, &["poses", "pictures", "PSNR, dB", "mean picture, dB", "gain, dB", "SSIM", "inside the actors, dB"]);
        for part in PARTS {
            let Some(v) = table.novel_views.get(part) else { continue };
            row(
                page,
                &[
                    part.into(),
                    v.pictures.to_string(),
                    db(Some(v.psnr_db)),
                    db(Some(v.mean_picture_db)),
                    format!("{:+.1}", v.gain_db),
                    format!("{:.3}", v.ssim),
                    db(v.actor_db),
                ],
            );
        }
        page.push('\n');
    }
}

fn matrix(page: &mut String, states: &[String], table: &FieldPictures) {
    let mut cells = vec!["rendered \\ true"];
    cells.extend(states.iter().map(String::as_str));
    head(page, &cells);
    for (r, values) in table.psnr_db.iter().enumerate() {
        let Some(values) = values else { continue };
        let value = |(t, v): (usize, &f64)| if r == t { format!("**{v:.1}**") } else { format!("{v:.1}") };
        let mut cells = vec![states.get(r).cloned().unwrap_or_default()];
        cells.extend(values.iter().enumerate().map(value));
        row(page, &cells);
    }
    page.push('\n');
}

fn means(page: &mut String, table: &FieldPictures, mean_picture_db: Option<f64>) {
    head(page, &["branch", "matching, dB", "un-matching, dB", "difference, dB"]);
    let mut line = |name: &str, m: &PairMeans| {
        row(page, &[name.into(), db(m.matching_db), db(m.unmatching_db), db(m.margin_db)]);
    };
    for (branch, m) in &table.by_branch {
        line(branch, m);
    }
    line("all", &table.all);
    let gain = table.all.matching_db.zip(mean_picture_db).map(|(a, b)| format!("{:+.1}", a - b));
    let _ = writeln!(
        page,
        "\nMatching pairs: SSIM {}, {} dB inside the dynamic actors' pixels, {} dB over the pixels that change among \
         states; {} dB over the mean picture of all states, which has {} dB.\n",
        table.ssim.map_or_else(|| "-".into(), |s| format!("{s:.3}")),
        db(table.actor_db),
        db(table.changed_db),
        gain.unwrap_or_else(|| "-".into()),
        db(mean_picture_db)
    );
}

/// The encoder table, one row for each named encoder.
pub fn encoder(page: &mut String, rows: &[(String, &EncoderTable)]) {
    let _ = writeln!(
        page,
        "*Train PSNR*: the decoder on trained poses, from each picture's own latent; beside it the pose's mean picture, \
         which takes no encoder. *Novel view*: the decoder from the latent of another pose's picture of the same state. \
         *SVM*: support vector machine (RBF, C = 1, gamma = 1 / (8 variance)) on latents, share of states named right; \
         some states are one picture, hence its ceiling. Trained poses: 10 folds by picture, as in the paper, where the \
         doubles of a picture that is left out stay in under other names and push it below the ceiling; and 10 folds by \
         pose, where none does. Unseen: fitted on all trained.\n"
    );
    head(
        page,
        &[
            "encoder",
            "train PSNR, dB",
            "mean picture, dB",
            "pixels that change, dB",
            "novel view, dB",
            "the same, pixels that change, dB",
            "SVM, % of ceiling %, trained",
            "up to what looks the same, %",
            "by pose, %",
            "up to what looks the same, %",
            "SVM, % of ceiling %, unseen",
            "up to what looks the same, %",
        ],
    );
    for (name, t) in rows {
        let svm = |s: &crate::SvmScore| format!("{} of {}", percent(s.accuracy), percent(s.ceiling));
        row(
            page,
            &[
                name.clone(),
                db(Some(t.train.psnr_db)),
                db(Some(t.train.mean_picture_psnr_db)),
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
            "\n{} pictures of trained poses, {} of unseen ones, {} decoded from another pose's latent.\n",
            t.svm.trained.pictures, t.svm.unseen.pictures, t.novel_view.pictures
        );
    }
}

fn state_accuracy(page: &mut String, table: &EncoderTable) {
    if table.state_accuracy.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "### State accuracy\n\nThe nearest of the states' centres names the state; right is what looks, from that pose, \
         like the true one. In brackets: right by name, of what is to be expected at best. By how much is seen of the \
         place where the actor is or may be.\n"
    );
    head(page, &["poses", "place fully visible, %", "partly, %", "not, %"]);
    for part in PARTS {
        let Some(a) = table.state_accuracy.get(part) else { continue };
        let share = |s: &carff_training::accuracy::Share| match s.trials {
            0 => "-".to_owned(),
            n => {
                format!("{} of {n} pictures ({} of {})", percent(s.accuracy()), percent(s.raw()), percent(s.ceiling()))
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
        "## Accuracy and recall against the number of samples\n\n*Accuracy* is over pictures that show the actor's place \
         fully and leave one branch open: share of samples whose state looks, from that pose, like one that can come \
         next; and whether the state that most samples show does. *Recall* is over pictures that leave several branches \
         open: whether any of n samples shows the branch that came. With independent draws and an even belief over two \
         branches that is 1 - 0.5^n; stratified draws, which the running graph takes, have each component's share of the \
         samples. *Posterior alone*: drawn from the encoder's posterior, without forecast, about the picture's own step. \
         Each picture is taken once with sensor noise and tried several times with fresh draws: trials of one picture \
         are no independent ones.\n\n![Accuracy and recall](recall.png)\n"
    );
    let counts = [1, 2, 3, 4, 5, 10, 20, 50];
    for part in PARTS {
        let Some(c) = table.parts.get(part) else { continue };
        let _ = writeln!(
            page,
            "### {} poses\n\nAccuracy: {} trials of {} pictures. Recall: {} trials of {} pictures.\n",
            capital(part),
            c.accuracy.trials,
            c.accuracy.pictures,
            c.recall.trials,
            c.recall.pictures
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
        line("accuracy of samples (80 % of the pictures)", &c.accuracy.mean, &c.accuracy.band);
        line("what most samples show", &c.majority_accuracy.mean, &c.majority_accuracy.band);
        line("posterior alone, accuracy", &c.posterior_accuracy.mean, &c.posterior_accuracy.band);
        line("recall, independent draws", &c.recall.mean, &c.recall.band);
        line("expected of them", &c.expected_recall, &c.expected_band);
        line("recall, stratified draws", &c.stratified_recall.mean, &c.stratified_recall.band);
        line("the same, all open branches shown", &c.stratified_recall_of_all.mean, &[]);
        line("posterior alone, recall", &c.posterior_recall.mean, &c.posterior_recall.band);
        page.push('\n');
    }
}

fn capital(text: &str) -> String {
    let mut letters = text.chars();
    letters.next().map_or_else(String::new, |first| first.to_uppercase().collect::<String>() + letters.as_str())
}

fn planning(page: &mut String, table: &PlanningResults) {
    let _ = writeln!(
        page,
        "## Planning\n\nTwo kinds of trial have one right answer. *Hazard*: a hazard's branch, and the actor is hidden; to \
         halt is right. *Clear*: another branch, and that can be seen; to advance is right. Right actions out of trials, \
         with 95 % Wilson intervals. {}\n",
        table.threshold.map_or_else(
            || "The checkpoint has no threshold, so there is no calibrated rule.".to_owned(),
            |t| format!(
                "The calibrated rule halts from a hazard probability of {t:.3} on, chosen on the calibration \
                         poses when the checkpoint was made."
            ),
        )
    );
    let of_one = |kind: &str| {
        table
            .one_image_views
            .get(kind)
            .map(|v| format!("{kind}: pose {}, branch {}, t{}", v.view, v.branch, v.timestamp))
    };
    let one: Vec<String> = ["hazard", "clear"].into_iter().filter_map(of_one).collect();
    let of_views = |name: &str| {
        table.views.get(name).map_or_else(String::new, |v| {
            format!(
                "{} hazard pictures, each taken {} times, and {} clear ones, each {} times, with fresh sensor noise. \
                 Pictures that differ in noise alone are no independent trials.",
                v.hazard, v.hazard_repeats, v.clear, v.clear_repeats
            )
        })
    };
    let parts = [
        (
            "The paper's protocol: one image, 30 trials",
            &table.one_image,
            format!("Drawn by seed ({}).", one.join("; ")),
        ),
        ("All views of trained poses", &table.all_views, of_views("all_views")),
        (
            "The same, independent draws",
            &table.all_views_independent,
            "As above, each sample drawn by itself, as in the paper; the running graph's are stratified.".to_owned(),
        ),
        ("Unseen views", &table.unseen_views, of_views("unseen_views")),
        (
            "Calibration views",
            &table.calibration_views,
            format!("These chose the threshold. {}", of_views("calibration_views")),
        ),
    ];
    for (title, of_part, text) in parts {
        planning_part(page, title, of_part, &text);
    }
    if let Some(free) = &table.free_drives {
        planning_part(page, "Free drives", free, "Rendered from poses that no training saw.");
    }
}

fn planning_part(page: &mut String, title: &str, table: &PlanningTable, text: &str) {
    let _ = writeln!(page, "### {title}\n\n{text}\n");
    if table.is_empty() {
        let _ = writeln!(page, "No picture of these poses is a trial.\n");
        return;
    }
    head(page, &["rule", "n", "hazard: halts", "clear: advances"]);
    for rule in ["underconfident", "overconfident", "paper", "calibrated"] {
        // Two rules look at no sample.
        let any = rule.ends_with("confident");
        let counts = if any { &SAMPLE_COUNTS[..1] } else { &SAMPLE_COUNTS[..] };
        for samples in counts.iter().filter(|_| table.contains_key(rule)) {
            let count = |kind| count(cell(table, rule, &samples.to_string(), kind));
            let samples = if any { "any".to_owned() } else { samples.to_string() };
            row(page, &[rule.into(), samples, count("hazard"), count("clear")]);
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

fn reliability(page: &mut String, results: &Results) {
    if results.hazard_reliability.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "## Does the hazard probability mean what it says?\n\nHazard probability (n = 10, stratified) of every picture \
         that has a next step, taken once with sensor noise, against whether its branch is one with a hazard. Bins of a \
         tenth.\n\n![Reliability](reliability.png)\n"
    );
    head(page, &["poses", "pictures", "expected calibration error", "bins: forecast, found share, pictures"]);
    for part in PARTS {
        let Some(r) = results.hazard_reliability.get(part) else { continue };
        let bin = |b: &carff_metrics::ReliabilityBin| format!("{:.2}: {:.2} of {}", b.forecast, b.happened, b.trials);
        let bins: Vec<String> = r.bins.iter().map(bin).collect();
        let error = format!("{:.3}", r.expected_calibration_error);
        row(page, &[part.into(), r.trials.to_string(), error, bins.join("; ")]);
    }
    page.push('\n');
}

fn frequencies(page: &mut String, parts: &BTreeMap<String, FrequencyTable>) {
    if parts.is_empty() {
        return;
    }
    let _ = writeln!(
        page,
        "## Frequencies where several outcomes are open\n\nSamples of the next step's forecast, drawn independently, from \
         pictures that leave several outcomes open: how often each is drawn, and how often it should be by all that the \
         picture tells. Pictures are grouped by what they leave open; intervals (95 %) are from how pictures differ.\n"
    );
    for part in PARTS {
        let Some(table) = parts.get(part) else { continue };
        let _ = writeln!(page, "### {} poses\n", capital(part));
        head(page, &["open", "pictures, samples", "outcome", "drawn, %", "expected, %", "other outcomes, unknown, %"]);
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
                first(format!("{}, {}", group.pictures, group.samples)),
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
    use carff_training::accuracy::ByObservability;

    /// Every table of a page is one that Markdown readers take: as many cells in each row as in its head.
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

    /// A page without any result still says what it is about, and what was left out and why.
    #[test]
    fn a_page_without_results() {
        let mut results = Results::default();
        results.subject.scenario = "crossing".into();
        results.left_out.insert("planning".into(), "there is one branch".into());
        let page = page(&results);
        assert!(page.starts_with("# crossing: results\n") && page.contains("- *planning*: there is one branch."));
        assert!(!page.contains("Wanted and found"));
    }

    /// Tables are even, missing values are dashes, and figures are rounded.
    #[test]
    fn tables_are_even() {
        let pictures = FieldPictures {
            psnr_db: vec![Some(vec![30.04, 20.0]), None],
            by_branch: BTreeMap::from([("a".into(), PairMeans::default())]),
            ..FieldPictures::default()
        };
        let mut planning = PlanningResults { threshold: Some(0.25), ..PlanningResults::default() };
        carff_evaluation::count(&mut planning.all_views, "paper", 10, carff_dataset::drives::DriveKind::Clear, true);
        let results = Results {
            pictures: Some(PictureTable {
                states: vec!["a t0".into(), "a t1".into()],
                toggled: Some(pictures),
                ..PictureTable::default()
            }),
            encoder: Some(EncoderTable {
                state_accuracy: BTreeMap::from([("unseen".into(), ByObservability::default())]),
                ..EncoderTable::default()
            }),
            planning: Some(planning),
            ..Results::default()
        };
        let page = page(&results);
        assert_tables_are_even(&page);
        assert!(page.contains("| a t0 | **30.0** | 20.0 |") && !page.contains("\n| a t1 "), "{page}");
        assert!(page.contains("| paper | 10 | - | 1/1 (21 to 100 %) |"), "{page}");
        assert!(page.contains("| unseen | - | - | - |"), "{page}");
    }
}
