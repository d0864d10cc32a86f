//! Some of a run's drives as one picture: what the camera showed, what came, and what was thought possible.

use crate::monitor::FrameRecord;
use crate::planning::{Setup, halts};
use anyhow::Context;
use carff_belief::{Probe, Step};
use carff_dataset::{Image, ScenarioInfo, drives::DriveKind};
use carff_field::{Field, RenderBuffer, RenderOptions};
use carff_geometry::PinholeCamera;
use carff_messages::Reason;
use carff_plots::{StripCell, StripRow};
use carff_probing::Place;
use std::collections::BTreeSet;
use std::path::Path;

/// Drives that are shown.
const DRIVES: usize = 8;
/// Hypotheses that are shown of each.
const HYPOTHESES: usize = 3;
/// Longest side of a rendered hypothesis, pixels.
const MOST_PX: u32 = 256;
/// Side of a rendered hypothesis where the data set has no camera for it, pixels.
const OWN_CAMERA_PX: u32 = 128;
const RIGHT: [u8; 3] = [46, 155, 90];
const WRONG: [u8; 3] = [205, 50, 45];
const HAZARD: [u8; 3] = [236, 140, 20];

/// Draws some drives of a run, each by the frame whose decision counts, into a PNG file.
pub fn write(path: &Path, setup: &Setup, decisive: &[(FrameRecord, DriveKind)]) -> anyhow::Result<()> {
    let probe = setup.models.probe.clone();
    let names = state_names(&setup.scenario, probe.prober().places());
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

/// What each known state is called: who of those that may come is there, and when, if that can be told.
fn state_names(scenario: &ScenarioInfo, places: &[Place]) -> Vec<String> {
    let boxes = scenario.states.iter().flat_map(|s| &s.boxes).chain(scenario.candidates.iter().map(|c| &c.named_box));
    let coming: BTreeSet<&str> = boxes.filter(|b| b.dynamic).map(|b| b.name.as_str()).collect();
    let taken = |state: usize| places.iter().map(move |p| p.occupied_in.get(state).copied().unwrap_or(false));
    let name = |state: usize| {
        let there: Vec<&str> = places
            .iter()
            .zip(taken(state))
            .filter(|(place, taken)| *taken && coming.contains(place.name.as_str()))
            .map(|(place, _)| place.name.as_str())
            .collect();
        let who = if there.is_empty() { "nobody".to_owned() } else { there.join(" and ") };
        let alone = (0..scenario.state_count()).all(|other| other == state || !taken(other).eq(taken(state)));
        if alone { format!("{who}, t{}", state % scenario.timestamps.max(1)) } else { who }
    };
    (0..scenario.state_count()).map(name).collect()
}

/// Samples that show the same.
#[derive(Debug, PartialEq)]
struct Hypothesis {
    /// What they show.
    name: String,
    /// How many they are.
    count: usize,
    /// The first of them.
    sample: usize,
}

/// Groups samples by what they show, the largest group first; of equally large ones the one that was drawn first.
fn hypotheses(names: impl IntoIterator<Item = String>) -> Vec<Hypothesis> {
    let mut groups: Vec<Hypothesis> = Vec::new();
    for (sample, name) in names.into_iter().enumerate() {
        match groups.iter_mut().find(|g| g.name == name) {
            Some(group) => group.count += 1,
            None => groups.push(Hypothesis { name, count: 1, sample }),
        }
    }
    groups.sort_by_key(|g| std::cmp::Reverse(g.count));
    groups
}

/// Looks straight down on a field, the picture's up = +Y.
fn camera_above(field: &Field) -> PinholeCamera {
    let [low, high] = field.config().bounds_m.map(|corner| corner.map(f64::from));
    let [x, y] = [0, 1].map(|i| f64::midpoint(low[i], high[i]));
    let fov_deg = 60.0_f64;
    let distance = (high[0] - low[0]).max(high[1] - low[1]) / 2.0 / (fov_deg / 2.0).to_radians().tan();
    let side = OWN_CAMERA_PX;
    PinholeCamera::look_at([x, y, low[2] + distance], [x, y, low[2]], [0.0, 1.0, 0.0], side, side, fov_deg)
}

/// The same camera with no side longer than [`MOST_PX`].
fn limited(camera: &PinholeCamera) -> PinholeCamera {
    let longest = camera.width_px.max(camera.height_px);
    if longest <= MOST_PX {
        return *camera;
    }
    let shorter = |side: u32| (u64::from(side) * u64::from(MOST_PX) / u64::from(longest)).max(1) as u32;
    camera.resized(shorter(camera.width_px), shorter(camera.height_px))
}

struct Artist<'a> {
    setup: &'a Setup,
    /// What the known states are called.
    names: Vec<String>,
    probe: Probe,
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
        let rule = self.setup.live_rule();
        let mut lines = vec![
            format!("Drive {} {}", frame.drive + 1, if halts(frame) { "halts" } else { "advances" }),
            format!("{verdict}: {truth}"),
            format!("hazard probability {:.2}", frame.hazard_probability),
            match rule.as_str() {
                "calibrated" => format!("threshold {:.2}", self.setup.threshold),
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
        let dataset = &self.setup.dataset;
        let of_set = self.setup.scenario.bev_view.and_then(|view| {
            let frame = dataset.frames().iter().find(|f| f.view == Some(view))?;
            Some(limited(&frame.camera))
        });
        of_set.unwrap_or_else(|| camera_above(self.probe.field()))
    }

    fn rendered(&mut self, camera: &PinholeCamera, latent: &[f32; carff_models::LATENT_DIM]) -> Image {
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
    use carff_dataset::{NamedBox, StateInfo};
    use carff_geometry::OrientedBox;
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

    /// Samples are grouped by what they show, the largest group first, each with its first sample.
    #[test]
    fn samples_are_grouped() {
        let groups = hypotheses(["b", "a", "c", "a", "c"].map(str::to_owned));
        let found: Vec<_> = groups.iter().map(|g| (g.name.as_str(), g.count, g.sample)).collect();
        assert_eq!(found, [("a", 2, 1), ("c", 2, 2), ("b", 1, 0)]);
    }

    /// States are named by those who may come, not by the ego vehicle; the time is given where the places tell it.
    #[test]
    fn states_have_names() {
        let oriented_box = OrientedBox { center: [0.0; 3], half_size: [1.0; 3], yaw: 0.0 };
        let named = |name: &str, dynamic| NamedBox { name: name.into(), role: None, oriented_box, dynamic };
        let state = |s: usize| StateInfo {
            branch: s / 2,
            timestamp: s % 2,
            boxes: if s < 2 { vec![named("ego", false), named("truck", true)] } else { vec![named("ego", false)] },
        };
        let scenario = ScenarioInfo {
            name: "crossing".into(),
            bounds: [[-1.0; 3], [1.0; 3]],
            branches: vec!["truck".into(), "nothing".into()],
            timestamps: 2,
            bev_view: None,
            states: (0..4).map(state).collect(),
            candidates: Vec::new(),
            static_boxes: Vec::new(),
            hazard_branches: vec![0],
            hazard_action: "halt".into(),
            clear_action: "advance".into(),
        };
        let place = |name: &str, taken: [bool; 4]| Place { name: name.into(), oriented_box, occupied_in: taken.into() };
        let truck = [place("truck", [true, false, false, false]), place("truck", [false, true, false, false])];
        assert_eq!(state_names(&scenario, &truck), ["truck, t0", "truck, t1", "nobody", "nobody"]);
        let mut all = truck.to_vec();
        all.push(place("ego", [true, false, true, false]));
        assert_eq!(state_names(&scenario, &all), ["truck, t0", "truck, t1", "nobody, t0", "nobody, t1"]);
    }

    /// A camera too large for a filmstrip is made smaller and sees the same; a small one stays as it is.
    #[test]
    fn large_cameras_are_limited() {
        let camera = PinholeCamera::look_at([0.0, 0.0, 9.0], [0.0; 3], [0.0, 1.0, 0.0], 1024, 512, 60.0);
        let small = limited(&camera);
        assert_eq!((small.width_px, small.height_px), (256, 128));
        let (a, b) = (camera.project([1.0, 2.0, 0.0]).unwrap().0, small.project([1.0, 2.0, 0.0]).unwrap().0);
        assert!((a[0] / 4.0 - b[0]).abs() < 1e-9 && (a[1] / 4.0 - b[1]).abs() < 1e-9);
        assert_eq!(limited(&small), small);
    }

    /// The camera that stands in for the data set's sees the whole ground of the field, +Y up.
    #[test]
    fn camera_above_sees_the_ground() {
        let bounds_m = [[-17.0, -19.0, 0.5], [5.0, 7.0, 5.0]];
        let small = carff_field::FieldConfig { bounds_m, levels: 2, log2_table_size: 8, ..Default::default() };
        let camera = camera_above(&Field::new(small, 1).unwrap());
        let at = |x, y| camera.project([x, y, 0.5]).unwrap().0;
        for (x, y) in [(-17.0, -19.0), (5.0, -19.0), (-17.0, 7.0), (5.0, 7.0)] {
            assert!(at(x, y).iter().all(|v| (-1e-6..=128.0 + 1e-6).contains(v)), "{x} {y}: {:?}", at(x, y));
        }
        assert!(at(0.0, 7.0)[1] < at(0.0, -19.0)[1] && at(-17.0, 0.0)[0] < at(5.0, 0.0)[0]);
    }
}
