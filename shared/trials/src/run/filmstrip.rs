//! Filmstrip of a run's drives: the camera image, the true next state, and the forecast states.

use super::{DecidedFrame, JudgedRun};
use crate::hypotheses::{birds_eye_camera, hypotheses, state_names};
use crate::{EvaluationError, FieldRenderer};
use carff_checkpoint::FieldProbe;
use carff_dataset::{Image, drives::DriveKind};
use carff_decision::{Place, Probed, Step};
use carff_messages::Rule;
use carff_plots::{StripCell, StripRow};
use std::collections::BTreeMap;
use std::ops::RangeInclusive;
use std::path::Path;

/// Largest number of drives that are shown.
const DRIVES: usize = 8;
/// Largest number of hypotheses that are shown of each drive.
const HYPOTHESES: usize = 3;
/// Occupancies at which an object is visibly transparent.
const FAINT: RangeInclusive<f32> = 0.2..=0.8;
const RIGHT: [u8; 3] = [46, 155, 90];
const WRONG: [u8; 3] = [205, 50, 45];
const HAZARD: [u8; 3] = [236, 140, 20];

impl JudgedRun {
    /// Draws some drives of the run into a PNG file, each by its decisive frame.
    pub fn write_filmstrip(&self, path: &Path, decisive: &[(DecidedFrame, DriveKind)]) -> Result<(), EvaluationError> {
        let probe = self.probe.clone();
        let names = state_names(&self.scenario, probe.layout().places());
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let mut artist = Artist { run: self, names, probe, renderer: FieldRenderer::new(threads) };
        let rows = chosen(decisive).into_iter().map(|(frame, kind)| artist.row(frame, *kind));
        let rows = rows.collect::<Result<Vec<_>, _>>()?;
        let title = format!("{}: {} drives of run {}", self.scenario.name, rows.len(), self.settings.run);
        let subtitle = format!(
            "Each row is a drive. Columns: the camera image, with a green frame where the action was correct and a red \
             one where it was wrong; the true next state from above; the states that the prober reads in the {} samples \
             of the forecast, with one sample rendered for each. Orange frame: the state is a hazard. A half-transparent \
             object: the sample is between two states; the caption gives the occupancy of the object's place (the share \
             of light that it absorbs).",
            self.settings.samples
        );
        Ok(carff_plots::filmstrip(path, &title, &subtitle, &rows)?)
    }
}

/// The first drives of a run in their order, half of them with a hazard where there are enough of both kinds.
fn chosen(decisive: &[(DecidedFrame, DriveKind)]) -> Vec<&(DecidedFrame, DriveKind)> {
    let of = |kind| decisive.iter().filter(move |(frame, k)| *k == kind && frame.posterior.is_some());
    let (hazards, clears) = (of(DriveKind::Hazard).count(), of(DriveKind::Clear).count());
    let hazard_rows = hazards.min((DRIVES / 2).max(DRIVES.saturating_sub(clears)));
    let mut rows: Vec<_> = of(DriveKind::Hazard).take(hazard_rows).collect();
    rows.extend(of(DriveKind::Clear).take(DRIVES - hazard_rows));
    rows.sort_by_key(|(frame, _)| frame.drive);
    rows
}

struct Artist<'a> {
    run: &'a JudgedRun,
    /// Names of the known states.
    names: Vec<String>,
    probe: FieldProbe,
    renderer: FieldRenderer,
}

impl Artist<'_> {
    fn row(&mut self, frame: &DecidedFrame, kind: DriveKind) -> Result<StripRow, EvaluationError> {
        let &DecidedFrame { branch, timestamp, view, .. } = frame;
        let run = self.run;
        let steps = run.look_ahead(&mut self.probe, frame, run.settings.samples).unwrap_or_default();
        let right = frame.halted == (kind == DriveKind::Hazard);
        let shown = StripCell {
            image: match view {
                Some(view) => self.image(branch, timestamp, view)?,
                None => self.free_image(frame)?,
            },
            caption: vec![
                format!("camera, t{timestamp}"),
                view.map_or("free pose".to_owned(), |view| format!("view {view}")),
            ],
            emphasis: Some(if right { RIGHT } else { WRONG }),
        };
        let above = run.scenario.bev_view;
        let hazard = run.scenario.is_hazard_at(branch, timestamp + 1);
        let truth = StripCell {
            image: match above.or(view) {
                Some(view) => self.image(branch, timestamp + 1, view)?,
                None => return Err(EvaluationError::Unfit("it has no bird's-eye view (`bev_view`)".into())),
            },
            caption: vec![
                format!("true next state, t{}", timestamp + 1),
                format!("true image from {}", if above.is_some() { "above" } else { "the same view" }),
            ],
            emphasis: hazard.then_some(HAZARD),
        };
        let mut cells = vec![shown, truth];
        if let Some(step) = steps.first() {
            cells.extend(self.hypotheses(step));
        }
        Ok(StripRow { caption: self.caption(frame, kind, right), cells })
    }

    fn caption(&self, frame: &DecidedFrame, kind: DriveKind, right: bool) -> Vec<String> {
        let verdict = if right { "correct" } else { "WRONG" };
        let truth = match kind {
            DriveKind::Hazard => "the hazard comes, not shown",
            DriveKind::Clear => "no hazard comes, in full view",
        };
        let rule = self.run.settings.rule;
        let mut lines = vec![
            format!("Drive {} {}", frame.drive + 1, if frame.halted { "halts" } else { "advances" }),
            format!("{verdict}: {truth}"),
            format!("hazard probability {:.2}", frame.hazard_probability),
            match rule {
                Rule::Calibrated => format!("threshold {:.2}", self.run.settings.threshold),
                _ => format!("rule: {}", rule.name()),
            },
        ];
        if let Some(reason) = &frame.other_reason {
            lines.push(format!("because of: {reason}"));
        }
        lines
    }

    /// Image of a free drive, rendered again.
    fn free_image(&self, frame: &DecidedFrame) -> Result<Image, EvaluationError> {
        let settings = &self.run.settings;
        let scenario = settings.free.as_ref().ok_or_else(|| {
            EvaluationError::Unfit(format!("frame {} of drive {} has no image", frame.frame, frame.drive))
        })?;
        let drive = scenario.free_drive(frame.drive, settings.frames_per_timestamp, settings.seed)?;
        Ok(scenario.free_frame(&drive, frame.frame_in_drive)?.image)
    }

    fn image(&self, branch: usize, timestamp: usize, view: usize) -> Result<Image, EvaluationError> {
        let dataset = &self.run.dataset;
        let index = self.run.scenario.state(branch, timestamp).and_then(|state| dataset.frame_index(state, view));
        let index = index.ok_or_else(|| {
            let dir = dataset.dir().display();
            EvaluationError::Unfit(format!("{dir} has no image of branch {branch}, t{timestamp}, view {view}"))
        })?;
        Ok(dataset.load_image(index)?)
    }

    /// An image for each distinct state of the samples, the most frequent first.
    fn hypotheses(&mut self, step: &Step) -> Vec<StripCell> {
        let names = step.samples.iter().map(|sample| {
            let known = sample.reading.state.and_then(|state| self.names.get(state));
            known.map_or("no known state", String::as_str).to_owned()
        });
        let groups = hypotheses(names);
        let camera = birds_eye_camera(&self.run.dataset, self.probe.field());
        let hidden: usize = groups.iter().skip(HYPOTHESES).map(|g| g.count).sum();
        let mut cells: Vec<StripCell> = Vec::new();
        for group in groups.into_iter().take(HYPOTHESES) {
            let share = 100.0 * group.count as f64 / step.samples.len() as f64;
            let sample = &step.samples[group.sample];
            let hazard = sample.shows_hazard();
            let mut caption = vec![
                format!("{share:.0} %: {}", group.name),
                format!("{} of {} samples, one rendered", group.count, step.samples.len()),
            ];
            caption.extend(faint(self.probe.layout().places(), sample));
            cells.push(StripCell {
                image: self.renderer.image(self.probe.field(), &camera, &step.draws[group.sample].latent),
                caption,
                emphasis: hazard.then_some(HAZARD),
            });
        }
        if let Some(last) = cells.last_mut().filter(|_| hidden > 0) {
            let plural = if hidden == 1 { "" } else { "s" };
            last.caption.push(format!("not shown: {hidden} sample{plural} of other states"));
        }
        cells
    }
}

/// Names the objects that a rendered sample shows half-transparent, each with the largest occupancy of its places that
/// are between empty and taken.
fn faint(places: &[Place], sample: &Probed) -> Option<String> {
    let mut found: BTreeMap<&str, f32> = BTreeMap::new();
    for (place, &occupancy) in places.iter().zip(&sample.occupancies).filter(|(_, o)| FAINT.contains(o)) {
        let most = found.entry(&place.name).or_default();
        *most = most.max(occupancy);
    }
    let parts: Vec<String> = found.iter().map(|(name, o)| format!("{name} {:.0} %", 100.0 * o)).collect();
    (!parts.is_empty()).then(|| format!("half-transparent: {}", parts.join(", ")))
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Gaussian, LATENT_DIM};

    fn drive(drive: u64, kind: DriveKind, seen: bool) -> (DecidedFrame, DriveKind) {
        let posterior = seen.then_some(Gaussian { mean: [0.0; LATENT_DIM], log_variance: [0.0; LATENT_DIM] });
        (DecidedFrame { drive, posterior, ..crate::run::tests::frame() }, kind)
    }

    /// Half of the shown drives have a hazard where there are enough of both kinds; else the other kind fills up. The
    /// first drives are shown in their order, without those that have no posterior.
    #[test]
    fn drives_are_chosen_in_order() {
        use DriveKind::{Clear, Hazard};
        let shown = |all: &[(DecidedFrame, DriveKind)]| chosen(all).iter().map(|(f, _)| f.drive).collect::<Vec<_>>();
        let run = |kinds: &dyn Fn(u64) -> DriveKind| (0..20).map(|i| drive(i, kinds(i), i != 1)).collect::<Vec<_>>();
        assert_eq!(shown(&run(&|i| if i % 2 == 0 { Hazard } else { Clear })), [0, 2, 3, 4, 5, 6, 7, 9]);
        assert_eq!(shown(&run(&|i| if i == 12 { Hazard } else { Clear })), [0, 2, 3, 4, 5, 6, 7, 12]);
        assert_eq!(shown(&run(&|i| if i < 18 { Hazard } else { Clear })), [0, 2, 3, 4, 5, 6, 18, 19]);
        assert_eq!(shown(&run(&|_| Hazard)), [0, 2, 3, 4, 5, 6, 7, 8]);
        assert!(shown(&[]).is_empty());
    }

    /// A half-transparent object is named with its occupancy in every read state; an empty or a taken
    /// place is not.
    #[test]
    fn half_transparent_objects_are_named() {
        let place = |name: &str| Place {
            name: name.to_owned(),
            oriented_box: carff_base::geometry::OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 },
            occupied_in: vec![true, false],
        };
        let places = [place("actor"), place("actor"), place("ego")];
        let reading = carff_decision::Reading {
            state: Some(1),
            confidence: 0.7,
            hazard_likelihood: 0.3,
            state_probabilities: vec![0.3, 0.7],
        };
        let of = |occupancies: [f32; 3]| {
            faint(&places, &Probed { occupancies: occupancies.to_vec(), reading: reading.clone() })
        };
        assert_eq!(of([0.34, 0.25, 0.99]).as_deref(), Some("half-transparent: actor 34 %"));
        assert_eq!(of([0.02, 0.98, 0.5]).as_deref(), Some("half-transparent: ego 50 %"));
        // A faint trace next to an opaque object is not a half-transparent object.
        assert_eq!(of([0.13, 0.98, 0.86]), None);
    }
}
