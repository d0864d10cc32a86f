//! Some of a run's drives as one picture: what the camera showed, what came, and what was thought possible.

use crate::monitor::FrameRecord;
use crate::planning::{Setup, halts};
use anyhow::Context;
use carff_checkpoint::FieldProbe;
use carff_dataset::{Image, drives::DriveKind};
use carff_decision::Step;
use carff_evaluation::hypotheses::{birds_eye_camera, hypotheses, state_names};
use carff_field::{RenderBuffer, RenderOptions};
use carff_geometry::PinholeCamera;
use carff_messages::{Reason, Rule};
use carff_plots::{StripCell, StripRow};
use std::path::Path;

/// Drives that are shown.
const DRIVES: usize = 8;
/// Hypotheses that are shown of each.
const HYPOTHESES: usize = 3;
const RIGHT: [u8; 3] = [46, 155, 90];
const WRONG: [u8; 3] = [205, 50, 45];
const HAZARD: [u8; 3] = [236, 140, 20];

/// Draws some drives of a run, each by the frame whose decision counts, into a PNG file.
pub fn write(path: &Path, setup: &Setup, decisive: &[(FrameRecord, DriveKind)]) -> anyhow::Result<()> {
    let probe = setup.models.probe.clone();
    let names = state_names(&setup.scenario, probe.layout().places());
    let mut artist = Artist { setup, names, probe, buffer: RenderBuffer::new() };
    let rows = chosen(decisive).into_iter().map(|(frame, kind)| artist.row(frame, *kind));
    let rows = rows.collect::<anyhow::Result<Vec<_>>>()?;
    let title = format!("{}: {} drives of run {}", setup.scenario.name, rows.len(), setup.run);
    let subtitle = format!(
        "What the camera showed, framed green where the action was right and red where it was wrong; what came next, \
         seen from above; and what the {} samples of the forecast showed, one picture for each distinct state. Framed \
         orange: the hazard is there.",
        setup.graph.run.samples
    );
    Ok(carff_plots::filmstrip(path, &title, &subtitle, &rows)?)
}

/// The first drives of a run, as many with a hazard as without where there are enough, in their order.
fn chosen(decisive: &[(FrameRecord, DriveKind)]) -> Vec<&(FrameRecord, DriveKind)> {
    let of = |kind| decisive.iter().filter(move |(frame, k)| *k == kind && frame.posterior.is_some());
    let (hazards, clears) = (of(DriveKind::Hazard).count(), of(DriveKind::Clear).count());
    let hazard_rows = hazards.min((DRIVES / 2).max(DRIVES.saturating_sub(clears)));
    let mut rows: Vec<_> = of(DriveKind::Hazard).take(hazard_rows).collect();
    rows.extend(of(DriveKind::Clear).take(DRIVES - hazard_rows));
    rows.sort_by_key(|(frame, _)| frame.drive);
    rows
}

struct Artist<'a> {
    setup: &'a Setup,
    /// What the known states are called.
    names: Vec<String>,
    probe: FieldProbe,
    buffer: RenderBuffer,
}

impl Artist<'_> {
    fn row(&mut self, frame: &FrameRecord, kind: DriveKind) -> anyhow::Result<StripRow> {
        let ([Ok(branch), Ok(timestamp)], view) =
            ([frame.branch, frame.timestamp].map(usize::try_from), usize::try_from(frame.view).ok())
        else {
            anyhow::bail!("frame {} of drive {} names no state", frame.frame_id, frame.drive);
        };
        let samples = self.setup.graph.run.samples as usize;
        let steps = self.setup.look_ahead(&mut self.probe, frame, samples).unwrap_or_default();
        let right = halts(frame) == (kind == DriveKind::Hazard);
        let shown = StripCell {
            image: match view {
                Some(view) => self.picture(branch, timestamp, view)?,
                None => self.free_picture(frame)?,
            },
            caption: vec![
                format!("camera, t{timestamp}"),
                view.map_or("free pose".to_owned(), |view| format!("view {view}")),
            ],
            emphasis: Some(if right { RIGHT } else { WRONG }),
        };
        let above = self.setup.scenario.bev_view;
        let hazard = self.setup.scenario.is_hazard(branch);
        let truth = StripCell {
            image: match above.or(view) {
                Some(view) => self.picture(branch, timestamp + 1, view)?,
                None => anyhow::bail!("the data set names no bird's-eye view (`bev_view`)"),
            },
            caption: vec![
                format!("what came, t{}", timestamp + 1),
                format!("true picture from {}", if above.is_some() { "above" } else { "the same view" }),
            ],
            emphasis: hazard.then_some(HAZARD),
        };
        let mut cells = vec![shown, truth];
        if let Some(step) = steps.first() {
            cells.extend(self.hypotheses(step));
        }
        Ok(StripRow { caption: self.caption(frame, kind, right), cells })
    }

    fn caption(&self, frame: &FrameRecord, kind: DriveKind, right: bool) -> Vec<String> {
        let verdict = if right { "right" } else { "WRONG" };
        let truth = match kind {
            DriveKind::Hazard => "somebody comes, hidden",
            DriveKind::Clear => "nobody comes, in full view",
        };
        let rule = self.setup.graph.controller.rule;
        let mut lines = vec![
            format!("Drive {} {}", frame.drive + 1, if halts(frame) { "halts" } else { "advances" }),
            format!("{verdict}: {truth}"),
            format!("hazard probability {:.2}", frame.hazard_probability),
            match rule {
                Rule::Calibrated => format!("threshold {:.2}", self.setup.threshold),
                _ => format!("rule: {rule}"),
            },
        ];
        if let Some(reason) = frame.reason.filter(|r| *r != Reason::Belief) {
            lines.push(format!("because of: {}", reason.name()));
        }
        lines
    }

    /// What a free drive showed, rendered again.
    fn free_picture(&self, frame: &FrameRecord) -> anyhow::Result<Image> {
        let (scenario, number) = self
            .setup
            .free
            .as_ref()
            .zip(u64::try_from(frame.drive).ok())
            .with_context(|| format!("frame {} of drive {} names no picture", frame.frame_id, frame.drive))?;
        let frames = self.setup.graph.camera.frames_per_timestamp as usize;
        let drive = scenario.free_drive(number, frames, self.setup.seed)?;
        Ok(scenario.free_frame(&drive, usize::try_from(frame.frame_in_drive)?)?.image)
    }

    fn picture(&self, branch: usize, timestamp: usize, view: usize) -> anyhow::Result<Image> {
        let dataset = &self.setup.dataset;
        let index = self.setup.scenario.state(branch, timestamp).and_then(|state| dataset.frame_index(state, view));
        let index = index.with_context(|| {
            format!("{} has no picture of branch {branch}, t{timestamp}, view {view}", dataset.dir().display())
        })?;
        Ok(dataset.load_image(index)?)
    }

    /// A picture for each distinct state that the samples show, the most frequent first.
    fn hypotheses(&mut self, step: &Step) -> Vec<StripCell> {
        let names = step.samples.iter().map(|sample| {
            let known = sample.reading.state.and_then(|state| self.names.get(state));
            known.map_or("none of the known states", String::as_str).to_owned()
        });
        let groups = hypotheses(names);
        let camera = self.camera();
        let hidden: usize = groups.iter().skip(HYPOTHESES).map(|g| g.count).sum();
        let mut cells: Vec<StripCell> = Vec::new();
        for group in groups.into_iter().take(HYPOTHESES) {
            let share = 100.0 * group.count as f64 / step.samples.len() as f64;
            let hazard = step.samples[group.sample].reading.hazard_likelihood > 0.5;
            cells.push(StripCell {
                image: self.rendered(&camera, &step.draws[group.sample].latent),
                caption: vec![
                    format!("{share:.0} %: {}", group.name),
                    format!("{} of {} samples, rendered", group.count, step.samples.len()),
                ],
                emphasis: hazard.then_some(HAZARD),
            });
        }
        if let Some(last) = cells.last_mut().filter(|_| hidden > 0) {
            last.caption.push(format!("not shown: {hidden} that show other states"));
        }
        cells
    }

    /// The camera from above: the data set's own, or else one over the field.
    fn camera(&self) -> PinholeCamera {
        birds_eye_camera(&self.setup.dataset, self.probe.field())
    }

    fn rendered(&mut self, camera: &PinholeCamera, latent: &[f32; carff_messages::LATENT_DIM]) -> Image {
        let threads = std::thread::available_parallelism().map_or(1, std::num::NonZero::get);
        let options = RenderOptions { threads, ..RenderOptions::default() };
        self.probe.field().render(camera, latent, &options, &mut self.buffer);
        let rgb = self.buffer.rgb.iter().map(|v| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8).collect();
        Image { width_px: camera.width_px, height_px: camera.height_px, rgb }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::Gaussian;

    fn drive(drive: i32, kind: DriveKind, seen: bool) -> (FrameRecord, DriveKind) {
        let posterior = seen.then(Gaussian::standard);
        (FrameRecord { drive, posterior, ..crate::planning::tests::frame() }, kind)
    }

    /// Half of the drives shown have a hazard where there are enough of both kinds; where there are not, the other
    /// kind fills up; always the first ones, in their order, and none that nothing was recorded of.
    #[test]
    fn drives_are_chosen_in_order() {
        use DriveKind::{Clear, Hazard};
        let shown = |all: &[(FrameRecord, DriveKind)]| chosen(all).iter().map(|(f, _)| f.drive).collect::<Vec<_>>();
        let run = |kinds: &dyn Fn(i32) -> DriveKind| (0..20).map(|i| drive(i, kinds(i), i != 1)).collect::<Vec<_>>();
        assert_eq!(shown(&run(&|i| if i % 2 == 0 { Hazard } else { Clear })), [0, 2, 3, 4, 5, 6, 7, 9]);
        assert_eq!(shown(&run(&|i| if i == 12 { Hazard } else { Clear })), [0, 2, 3, 4, 5, 6, 7, 12]);
        assert_eq!(shown(&run(&|i| if i < 18 { Hazard } else { Clear })), [0, 2, 3, 4, 5, 6, 18, 19]);
        assert_eq!(shown(&run(&|_| Hazard)), [0, 2, 3, 4, 5, 6, 7, 8]);
        assert!(shown(&[]).is_empty());
    }
}
