//! Target figures of a scenario against measured ones. Missed targets are shown like reached ones.

use super::Results;
use carff_dataset::drives::DriveKind;
use carff_trials::{BySamples, Count, PlanningTable};
use serde::{Deserialize, Serialize};

/// One figure and its target.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Target {
    /// Measured quantity.
    pub what: String,
    /// Figure of the paper; empty where the paper has none.
    pub paper: String,
    /// Target.
    pub wanted: String,
    /// Measured figure.
    pub found: String,
    /// True if the target is reached.
    pub reached: bool,
}

/// Targets of all figures that were computed.
pub fn targets(results: &Results) -> Vec<Target> {
    let mut list = List { targets: Vec::new() };
    list.images(results);
    list.encoder(results);
    list.forecast(results);
    list.planning(results);
    list.targets
}

/// The scenarios of the paper.
#[derive(Clone, Copy, PartialEq, Eq)]
enum Kind {
    Single,
    Intersection,
    Merge,
    Hand,
    Other,
}

/// Kind of a scenario by its name. A dataset of another renderer has the targets of its namesake.
fn kind(name: &str) -> Kind {
    let has = |part| name.contains(part);
    match () {
        () if has("single") => Kind::Single,
        () if has("intersection") => Kind::Intersection,
        () if has("merge") => Kind::Merge,
        () if has("hand") => Kind::Hand,
        () => Kind::Other,
    }
}

/// Kinds of trials, in the order of reports.
const KINDS: [DriveKind; 2] = [DriveKind::Hazard, DriveKind::Clear];

struct List {
    targets: Vec<Target>,
}

impl List {
    fn add(&mut self, what: &str, paper: &str, wanted: String, found: String, reached: bool) {
        let [what, paper] = [what, paper].map(str::to_owned);
        self.targets.push(Target { what, paper, wanted, found, reached });
    }

    fn at_least(&mut self, what: &str, paper: &str, value: Option<f64>, least: f64, scale: (f64, &str)) {
        let Some(value) = value else { return };
        let text = |v: f64| format!("{:.1}{}", v * scale.0, scale.1);
        self.add(what, paper, format!("at least {}", text(least)), text(value), value >= least);
    }

    fn images(&mut self, results: &Results) {
        let Some(toggled) = results.images.as_ref().and_then(|t| t.toggled.as_ref()) else { return };
        let kind = kind(&results.subject.scenario);
        let paper = match kind {
            Kind::Single => "29.06 dB",
            Kind::Intersection => "28.1 dB",
            Kind::Merge => "28.2 dB",
            Kind::Hand => "30.4 dB",
            Kind::Other => "",
        };
        let least = if kind == Kind::Hand { 32.0 } else { 31.0 };
        let db = (1.0, " dB");
        self.at_least("PSNR from above, matching states", paper, toggled.all.matching_db, least, db);
        self.at_least("matching minus un-matching", "", toggled.all.margin_db, 5.0, db);
        self.at_least("inside the actors' pixels", "", toggled.actor_db, 22.0, db);
    }

    fn encoder(&mut self, results: &Results) {
        let Some(table) = &results.encoder else { return };
        let paper = match kind(&results.subject.scenario) {
            Kind::Single => "75.20 %",
            Kind::Intersection => "89.17 %",
            Kind::Merge => "88.33 %",
            Kind::Hand | Kind::Other => "",
        };
        let percent = (100.0, " %");
        // Folds by image keep duplicates of the left-out images; the ceiling can be reached only with folds by pose.
        for (folds, paper, svm) in [("image", paper, table.svm.trained), ("pose", "", table.svm.trained_by_pose)] {
            if svm.ceiling <= 0.0 {
                continue;
            }
            let (found, ceiling) = (100.0 * svm.accuracy, 100.0 * svm.ceiling);
            let what = format!("SVM accuracy, 10 folds by {folds}");
            let found_text = format!("{found:.1} %, ceiling {ceiling:.1} %");
            self.add(&what, paper, "at least 97 % of the ceiling".into(), found_text, found >= 0.97 * ceiling);
        }
        let by_role = &table.state_accuracy;
        for (poses, found, least) in [("trained", &by_role.trained, 0.99), ("held-out", &by_role.unseen, 0.9)] {
            let full = found.map(|a| a.full).filter(|s| s.trials > 0);
            let what = format!("state accuracy, place fully visible, {poses} poses");
            self.at_least(&what, "", full.map(|s| s.accuracy()), least, percent);
        }
    }

    fn forecast(&mut self, results: &Results) {
        let Some(curves) = results.forecast.as_ref().and_then(|f| f.parts.trained.as_ref()) else { return };
        let percent = (100.0, " %");
        let [recall, accuracy] = match kind(&results.subject.scenario) {
            Kind::Intersection => ["1.0 at n = 4", "97.4 %"],
            Kind::Merge => ["1.0 at n = 3", "98.0 %"],
            _ => ["", ""],
        };
        let counts = curves.expected_recall.len();
        if curves.recall.trials > 0 {
            self.add(
                "recall, independent draws, against the expected recall",
                recall,
                "in its 95 % band".into(),
                format!("{} of {counts} n in it", curves.within_band),
                curves.within_band * 100 >= counts * 95,
            );
            self.at_least("recall, stratified draws, n = 4", recall, curves.stratified_recall.at(4), 0.99, percent);
        }
        self.at_least("accuracy of samples, n = 50", accuracy, curves.accuracy.at(50), 0.99, percent);
    }

    fn planning(&mut self, results: &Results) {
        let Some(planning) = &results.planning else { return };
        let rule = if planning.threshold.is_some() { "calibrated" } else { "paper" };
        let of_rule = |table: &PlanningTable| -> BySamples {
            if planning.threshold.is_some() { table.calibrated.clone() } else { table.paper.clone() }
        };
        let paper = |samples: usize, kind: DriveKind| match (kind, samples) {
            (DriveKind::Hazard, 2) => "17/30, 21/30",
            (DriveKind::Clear, 35) => "19/30, 22/30",
            (_, 10) => "30/30",
            _ => "",
        };
        for (samples, counts) in of_rule(&planning.one_image) {
            for kind in KINDS {
                let Some(count) = counts.get(kind) else { continue };
                let what = format!("planning, {rule} rule, n = {samples}, one image, {}", kind.name());
                let wanted = format!("{0}/{0}", count.trials);
                let found = format!("{}/{}", count.success, count.trials);
                self.add(&what, paper(samples, kind), wanted, found, count.success == count.trials);
            }
        }
        let free = planning.free_drives.as_ref();
        let n = 10;
        let tables = [
            ("all views", Some(&planning.all_views), 0.99),
            ("held-out views", Some(&planning.unseen_views), 0.95),
            ("free drives", free, 0.95),
        ];
        for (name, table, least) in tables {
            let counts = table.and_then(|table| of_rule(table).get(&n).copied()).unwrap_or_default();
            for kind in KINDS {
                let what = format!("planning, {rule} rule, n = {n}, {name}, {}", kind.name());
                self.at_least(&what, "", counts.get(kind).and_then(Count::rate), least, (100.0, " %"));
            }
        }
        if let Some(found) = results.hazard_reliability.trained.as_ref().filter(|r| r.trials > 0) {
            let error = found.expected_calibration_error;
            self.add(
                "hazard probability, expected calibration error, trained poses",
                "",
                "at most 0.05".into(),
                format!("{error:.3}"),
                error <= 0.05,
            );
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{FieldImages, ImageTable, PairMeans, PlanningResults};
    use carff_messages::Rule;

    /// The SVM's absolute accuracy, with its ceiling, stands next to the paper's absolute accuracy.
    #[test]
    fn equal_quantities_are_compared() {
        let mut table = crate::EncoderTable::default();
        table.svm.trained.accuracy = 0.62;
        table.svm.trained.ceiling = 0.691;
        let mut results = Results { encoder: Some(table), ..Results::default() };
        results.subject.scenario = "approaching-intersection".into();
        let found = targets(&results);
        let svm = found.iter().find(|t| t.what.starts_with("SVM")).unwrap();
        assert_eq!((svm.paper.as_str(), svm.found.as_str(), svm.reached), ("89.17 %", "62.0 %, ceiling 69.1 %", false));
    }

    /// A figure that was not measured has no target; a measured one is reached or missed, next to the paper's figure.
    #[test]
    fn missed_figures_are_shown() {
        assert!(targets(&Results::default()).is_empty());
        let all = PairMeans { matching_db: Some(31.0), unmatching_db: Some(27.0), margin_db: Some(4.0) };
        let toggled = Some(FieldImages { all, ..FieldImages::default() });
        let mut results =
            Results { images: Some(ImageTable { toggled, ..ImageTable::default() }), ..Results::default() };
        results.subject.scenario = "blender-intersection".into();
        let found = targets(&results);
        let brief: Vec<_> = found.iter().map(|t| (t.paper.as_str(), t.found.as_str(), t.reached)).collect();
        assert_eq!(brief, [("28.1 dB", "31.0 dB", true), ("", "4.0 dB", false)]);
        results.subject.scenario = "hand-reaching".into();
        assert!(!targets(&results)[0].reached, "the hand is asked for more");

        let mut planning = PlanningResults::default();
        planning.one_image.add(Rule::Paper, 2, DriveKind::Hazard, false);
        let found = targets(&Results { planning: Some(planning), ..Results::default() });
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].found.as_str(), found[0].reached), ("0/1", false));
    }
}
