//! What is wanted of a scenario, beside what was found. A missed figure is shown like any other.

use crate::Results;
use carff_evaluation::{Count, PlanningTable};
use serde::{Deserialize, Serialize};

/// One figure.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Target {
    /// What was measured.
    pub what: String,
    /// What the paper reports, where it does.
    pub paper: String,
    /// What is wanted.
    pub wanted: String,
    /// What was found.
    pub found: String,
    /// Whether that is enough.
    pub reached: bool,
}

/// The figures that can be had from what was computed.
pub fn targets(results: &Results) -> Vec<Target> {
    let mut list = List { targets: Vec::new() };
    list.pictures(results);
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

/// A scenario by its name. A set from elsewhere has the targets of the scenario it is called after.
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

    fn pictures(&mut self, results: &Results) {
        let Some(toggled) = results.pictures.as_ref().and_then(|t| t.toggled.as_ref()) else { return };
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
        // In folds by picture the doubles of what is left out stay in under other names; only by pose can the ceiling be
        // reached.
        for (folds, paper, svm) in [("picture", paper, table.svm.trained), ("pose", "", table.svm.trained_by_pose)] {
            let of_ceiling = (svm.ceiling > 0.0).then(|| svm.accuracy / svm.ceiling);
            let (found, ceiling) = (100.0 * svm.accuracy, 100.0 * svm.ceiling);
            let what = format!("SVM accuracy, 10 folds by {folds}, {found:.1} % of a ceiling of {ceiling:.1} %");
            self.at_least(&what, paper, of_ceiling, 0.97, (100.0, " % of it"));
        }
        for (part, least) in [("trained", 0.99), ("unseen", 0.9)] {
            let full = table.state_accuracy.get(part).map(|a| a.full).filter(|s| s.trials > 0);
            let what = format!("state accuracy, place fully visible, {part} poses");
            self.at_least(&what, "", full.map(|s| s.accuracy()), least, percent);
        }
    }

    fn forecast(&mut self, results: &Results) {
        let Some(curves) = results.forecast.as_ref().and_then(|f| f.parts.get("trained")) else { return };
        let percent = (100.0, " %");
        let [recall, accuracy] = match kind(&results.subject.scenario) {
            Kind::Intersection => ["1.0 at n = 4", "97.4 %"],
            Kind::Merge => ["1.0 at n = 3", "98.0 %"],
            _ => ["", ""],
        };
        let counts = curves.expected_recall.len();
        if curves.recall.trials > 0 {
            self.add(
                "recall, independent draws, against what the belief should be",
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
        let paper = |samples: &str, kind: &str| match (kind, samples) {
            ("hazard", "2") => "17/30, 21/30",
            ("clear", "35") => "19/30, 22/30",
            (_, "10") => "30/30",
            _ => "",
        };
        for samples in ["2", "10", "35"] {
            for kind in ["hazard", "clear"] {
                let Some(count) = cell(&planning.one_image, rule, samples, kind) else { continue };
                let what = format!("planning, {rule} rule, n = {samples}, one image, {kind}");
                let wanted = format!("{0}/{0}", count.trials);
                let found = format!("{}/{}", count.success, count.trials);
                self.add(&what, paper(samples, kind), wanted, found, count.success == count.trials);
            }
        }
        let free = planning.free_drives.as_ref();
        let tables = [
            ("all views", Some(&planning.all_views), 0.99),
            ("unseen views", Some(&planning.unseen_views), 0.95),
            ("free drives", free, 0.95),
        ];
        for (name, table, least) in tables {
            for kind in ["hazard", "clear"] {
                let count = table.and_then(|t| cell(t, rule, "10", kind)).filter(|c| c.trials > 0);
                let share = count.map(|c| c.success as f64 / c.trials as f64);
                self.at_least(
                    &format!("planning, {rule} rule, n = 10, {name}, {kind}"),
                    "",
                    share,
                    least,
                    (100.0, " %"),
                );
            }
        }
        if let Some(found) = results.hazard_reliability.get("trained").filter(|r| r.trials > 0) {
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

/// One count of a planning table.
pub fn cell(table: &PlanningTable, rule: &str, samples: &str, kind: &str) -> Option<Count> {
    table.get(rule)?.get(samples)?.get(kind).copied()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{FieldPictures, PictureTable, PlanningResults};
    use carff_evaluation::PairMeans;

    /// What was not measured has no target; what was is compared, reached or missed, with the paper's figure beside it.
    #[test]
    fn missed_figures_are_shown() {
        assert!(targets(&Results::default()).is_empty());
        let all = PairMeans { matching_db: Some(31.0), unmatching_db: Some(27.0), margin_db: Some(4.0) };
        let toggled = Some(FieldPictures { all, ..FieldPictures::default() });
        let mut results =
            Results { pictures: Some(PictureTable { toggled, ..PictureTable::default() }), ..Results::default() };
        results.subject.scenario = "blender-intersection".into();
        let found = targets(&results);
        let brief: Vec<_> = found.iter().map(|t| (t.paper.as_str(), t.found.as_str(), t.reached)).collect();
        assert_eq!(brief, [("28.1 dB", "31.0 dB", true), ("", "4.0 dB", false)]);
        results.subject.scenario = "hand-reaching".into();
        assert!(!targets(&results)[0].reached, "the hand is asked for more");

        let mut planning = PlanningResults::default();
        carff_evaluation::count(&mut planning.one_image, "paper", 2, carff_dataset::drives::DriveKind::Hazard, false);
        let found = targets(&Results { planning: Some(planning), ..Results::default() });
        assert_eq!(found.len(), 1);
        assert_eq!((found[0].found.as_str(), found[0].reached), ("0/1", false));
    }
}
