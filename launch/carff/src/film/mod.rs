//! Films: a recording's images as H.264 in an MP4 file, each shown from its own time until the next image.

#[cfg(test)]
mod player;
mod writer;

use anyhow::{Context, ensure};
use carff_checkpoint::Manifest;
use carff_dataset::Image;
use carff_messages::{Action, ActionCode, Belief, FrameMeta, ImageMeta, Occupancy, Reason, ViewKind, ViewMeta};
use carff_plots::{Bar, Board};
use carff_recording::Reader;
use carff_transport::TopicId;
use std::path::{Path, PathBuf};
pub(crate) use writer::FilmWriter;

/// Size of the occupancy grid's image.
const GRID_PX: [u32; 2] = [64, 64];
/// Rate of a film from a recording with only one frame, frames per second.
const LONE_FRAME_HZ: f64 = 10.0;

/// Returns the frames per second, from the median time between frames.
pub(crate) fn frame_rate_hz(recording: &Path) -> anyhow::Result<f64> {
    let mut reader = Reader::open(recording)?.without_images();
    let (mut before_ns, mut between) = (None, Vec::new());
    while let Some(entry) = reader.next()? {
        if let Some(m) = entry.message.as_message().get::<FrameMeta>() {
            let at_ns = m.header.capture_time_ns;
            if let Some(before_ns) = before_ns.replace(at_ns) {
                between.push(at_ns.saturating_sub(before_ns) as f64);
            }
        }
    }
    let median_ns = carff_base::statistics::percentile(&between, 0.5).filter(|&ns| ns > 0.0);
    Ok(median_ns.map_or(LONE_FRAME_HZ, |ns| 1e9 / ns))
}

/// Writes the camera's frames of a recording as a film, each with the decision and the belief about it, and with the
/// latest rendered hypothesis from above, where the recording has them. Returns the number of frames.
pub(crate) fn export(recording: &Path, file: &Path) -> anyhow::Result<u64> {
    let rate_hz = frame_rate_hz(recording)?;
    let mut reader = Reader::open(recording)?;
    ensure!(reader.has(TopicId::FRAME), "{} contains no camera frame", recording.display());
    let states = reader.about().map_or_else(Vec::new, |about| about.states.clone());
    let wanted = [TopicId::FRAME, TopicId::BELIEF, TopicId::OCCUPANCY, TopicId::ACTION, TopicId::VIEW];
    let present: Vec<TopicId> = wanted.into_iter().filter(|topic| reader.has(*topic)).collect();
    let grid_px = present.contains(&TopicId::OCCUPANCY).then_some(GRID_PX);
    reader.select(present)?;
    let checkpoint = reader.about().map(|about| PathBuf::from(&about.checkpoint));
    let manifest = checkpoint.and_then(|folder| Manifest::load(&folder).ok());
    let hazards = manifest.map_or_else(Vec::new, |manifest| manifest.scenario.hazard_states());
    let view_px = first_view_px(recording)?;
    let mut scene =
        Scene { states, hazards, view_px, grid_px, frame: None, belief: None, grid: None, action: None, view: None };
    let mut film = None;
    while let Some(entry) = reader.next()? {
        let message = entry.message.as_message();
        if let Some(meta) = message.get::<FrameMeta>() {
            scene.show(&mut film, file, rate_hz)?;
            let [width_px, height_px] = meta.size_px();
            let image = Image { width_px, height_px, rgb: message.bytes().to_vec() };
            (scene.frame, scene.belief, scene.action) = (Some((*meta, image)), None, None);
            scene.grid = None;
        } else if let Some(belief) = message.get::<Belief>().filter(|belief| belief.header.step == 1) {
            scene.belief = Some(*belief);
        } else if let Some(grid) = message.get::<Occupancy>().filter(|grid| grid.header.step == 1) {
            scene.grid = Some(*grid);
        } else if let Some(action) = message.get::<Action>().filter(|action| action.is_decision()) {
            scene.action = Some(*action);
        } else if let Some(view) = message.get::<ViewMeta>().filter(|view| view.kind == ViewKind::BirdsEye.code()) {
            let [width_px, height_px] = view.size_px();
            scene.view = Some((*view, Image { width_px, height_px, rgb: message.bytes().to_vec() }));
        }
    }
    scene.show(&mut film, file, rate_hz)?;
    film.context("the recording contains no camera frame")?.finish()
}

/// Returns the size of the first hypothesis from above; `None` if the recording has none.
fn first_view_px(recording: &Path) -> anyhow::Result<Option<[u32; 2]>> {
    let mut reader = Reader::open(recording)?.without_images();
    while let Some(entry) = reader.next()? {
        let view = entry.message.as_message().get::<ViewMeta>().copied();
        if let Some(view) = view.filter(|view| view.kind == ViewKind::BirdsEye.code()) {
            return Ok(Some(view.size_px()));
        }
    }
    Ok(None)
}

/// Draws a grid from above, +y up: from white for a free cell to red for a taken one.
fn grid_image(grid: &Occupancy) -> Image {
    let colour = |p: f32| [1.0, 1.0 - 0.85 * p, 1.0 - 0.9 * p].map(|v| (255.0 * v.clamp(0.0, 1.0)) as u8);
    let cells = grid.grid();
    let rgb =
        cells.outer_iter().rev().flat_map(|row| row.iter().flat_map(|p| colour(*p)).collect::<Vec<_>>()).collect();
    Image { width_px: grid.columns, height_px: grid.rows, rgb }
}

/// Returns an image at another size, each pixel from the nearest one.
fn resized(image: &Image, [width_px, height_px]: [u32; 2]) -> Image {
    let pixel = |x: u32, y: u32| {
        let (x, y) = (x * image.width_px / width_px, y * image.height_px / height_px);
        let at = ((y * image.width_px + x) * 3) as usize;
        image.rgb[at..at + 3].iter().copied()
    };
    let rgb = (0..height_px).flat_map(|y| (0..width_px).flat_map(move |x| pixel(x, y))).collect();
    Image { width_px, height_px, rgb }
}

/// The newest frame and what is known about it.
struct Scene {
    /// Names of the states, and which of them are hazards, where the checkpoint is at hand.
    states: Vec<String>,
    hazards: Vec<bool>,
    /// Size of rendered hypotheses; overload makes some of them smaller.
    view_px: Option<[u32; 2]>,
    /// Size of the occupancy grid's image, where the recording has grids.
    grid_px: Option<[u32; 2]>,
    frame: Option<(FrameMeta, Image)>,
    belief: Option<Belief>,
    grid: Option<Occupancy>,
    action: Option<Action>,
    view: Option<(ViewMeta, Image)>,
}

impl Scene {
    /// Adds the frame to the film.
    fn show(&mut self, film: &mut Option<FilmWriter>, file: &Path, rate_hz: f64) -> anyhow::Result<()> {
        let Some((meta, image)) = self.frame.take() else { return Ok(()) };
        let board = self.board(&meta, image).draw()?;
        let size_px = [board.width_px, board.height_px];
        let film = match film {
            Some(film) => film,
            None => film.insert(FilmWriter::create(file, size_px, rate_hz)?),
        };
        let frame = meta.header.frame_id;
        ensure!(film.size_px() == size_px, "frame {frame} does not have the size of the first frame");
        film.add(&board.rgb, meta.header.capture_time_ns)
    }

    fn board(&self, meta: &FrameMeta, image: Image) -> Board {
        let frame = meta.header.frame_id;
        let above = self.view_px.map(|size_px| match &self.view {
            Some((view, image)) => {
                let state = self.state_name(view.state);
                let (of, share) = (view.header.frame_id, 100.0 * view.probability);
                let caption = format!("a hypothesis of frame {of} ({share:.0} %): {state}");
                (caption, resized(image, size_px))
            }
            None => ("no rendered hypothesis yet".to_owned(), Image::filled(size_px[0], size_px[1], [228, 230, 234])),
        });
        let taken = self.grid_px.map(|size_px| match self.grid.filter(|grid| grid.header.frame_id == frame) {
            Some(grid) if !grid.cells().is_empty() => {
                ("taken, next step".to_owned(), resized(&grid_image(&grid), size_px))
            }
            _ => ("no occupancy yet".to_owned(), Image::filled(size_px[0], size_px[1], [228, 230, 234])),
        });
        let action = self.action.filter(|action| action.based_on_frame == frame);
        let belief = self.belief.filter(|belief| belief.header.frame_id == frame);
        let code = action.map(|action| action.code().unwrap_or(ActionCode::Halt));
        let halts = code.is_some_and(ActionCode::is_safe);
        let decision = match code {
            None => "no decision",
            Some(ActionCode::Halt) => "HALT",
            Some(other) => other.name(),
        };
        let reason = action.and_then(|action| action.reason().ok()).map_or("-", Reason::name);
        let hazard = belief.map_or("-".to_owned(), |b| format!("{:.2}", b.hazard_probability));
        Board {
            images: [Some((format!("camera, frame {frame}"), image)), above, taken].into_iter().flatten().collect(),
            decision: decision.to_owned(),
            alarm: halts,
            lines: vec![
                format!("reason: {reason}"),
                format!("hazard probability: {hazard}"),
                "belief, next step:".into(),
            ],
            bars: self.bars(belief.as_ref()),
        }
    }

    /// One bar for each state, and one for what is not known.
    fn bars(&self, belief: Option<&Belief>) -> Vec<Bar> {
        let share = |state: usize| belief.and_then(|b| b.state_probability.get(state).copied()).unwrap_or(0.0);
        let hazard = |state: usize| self.hazards.get(state).copied();
        let known: Vec<Bar> = (0..self.states.len())
            .map(|state| Bar { name: self.states[state].clone(), share: share(state), hazard: hazard(state) })
            .collect();
        let rest = belief.map_or(0.0, |_| (1.0 - known.iter().map(|bar| bar.share).sum::<f32>()).max(0.0));
        known.into_iter().chain([Bar { name: "unknown".into(), share: rest, hazard: None }]).collect()
    }

    fn state_name(&self, state: i32) -> String {
        let known = usize::try_from(state).ok().and_then(|state| self.states.get(state));
        known.map_or_else(|| "unknown".to_owned(), Clone::clone)
    }
}

#[cfg(test)]
mod tests {
    use super::{player::play, *};

    /// An exported film shows each frame next to its own decision, hazard probability and belief, and the latest hypothesis
    /// from above.
    #[test]
    fn films_show_decision_and_belief() {
        use carff_messages::forms::AnyMessage;
        use carff_messages::{Header, Rule};
        let folder = tempfile::tempdir().unwrap();
        let (recording, file) = (folder.path().join("r.mcap"), folder.path().join("film.mp4"));
        let states = ["actor, t0", "no actor"].map(str::to_owned).to_vec();
        let about =
            carff_recording::RecordingAbout { states: states.clone(), ..carff_recording::RecordingAbout::default() };
        let mut writer = carff_recording::Writer::create(&recording, &about, &[]).unwrap();
        let [camera_px, view_px] = [[64, 48], [40, 40]];
        let image = |[width_px, height_px]: [u32; 2], level: u8| Image::filled(width_px, height_px, [level, 60, 90]);
        // Level of both images, shares of the states, action.
        let frames = [(200, [0.75, 0.25], ActionCode::Halt), (40, [0.0, 1.0], ActionCode::Advance)];
        for (frame, (level, shares, action)) in (0..).zip(frames) {
            let at_ns = 100_000_000 * (frame + 1);
            let header = Header { publish_time_ns: at_ns, ..Header::of_frame(frame, at_ns, 1) };
            let mut meta = FrameMeta { header, width_px: 64, height_px: 48, ..FrameMeta::default() };
            (meta.intrinsics.fl_x_px, meta.intrinsics.fl_y_px) = (50.0, 50.0);
            let mut belief = Belief::empty(header.at_step(1), 1);
            (belief.state_count, belief.place_count, belief.component_count, belief.sample_count) = (2, 1, 1, 1);
            (belief.component_weights[0], belief.hazard_probability) = (1.0, shares[0]);
            belief.state_probability[..2].copy_from_slice(&shares);
            let view = ViewMeta {
                header: header.at_step(1),
                kind: ViewKind::BirdsEye.code(),
                state: i32::from(shares[0] < 0.5),
                probability: 0.5,
                width_px: view_px[0],
                height_px: view_px[1],
                intrinsics: meta.intrinsics,
                ..ViewMeta::default()
            };
            let action = Action {
                action: action.code(),
                sample_count: 1,
                confidence: 1.0,
                hazard_probability: shares[0],
                is_decision: 1,
                valid_until_ns: at_ns + 1,
                based_on_frame: frame,
                ..Action::halt(header, Reason::Belief, Rule::Calibrated)
            };
            writer.write(TopicId::FRAME, AnyMessage::new(&meta, &image(camera_px, level).rgb)).unwrap();
            writer.write(TopicId::BELIEF, AnyMessage::new(&belief, &[])).unwrap();
            writer.write(TopicId::VIEW, AnyMessage::new(&view, &image(view_px, level).rgb)).unwrap();
            writer.write(TopicId::ACTION, AnyMessage::new(&action, &[])).unwrap();
        }
        writer.finish().unwrap();
        assert_eq!(export(&recording, &file).unwrap(), 2);

        let boards = (0..).zip(frames).map(|(frame, (level, shares, action))| {
            let named = |name: &str, share| Bar { name: name.to_owned(), share, hazard: None };
            let state = &states[usize::from(shares[0] < 0.5)];
            Board {
                images: vec![
                    (format!("camera, frame {frame}"), image(camera_px, level)),
                    (format!("a hypothesis of frame {frame} (50 %): {state}"), image(view_px, level)),
                ],
                decision: if action == ActionCode::Halt { "HALT" } else { "advance" }.to_owned(),
                alarm: action == ActionCode::Halt,
                lines: vec![
                    "reason: belief".to_owned(),
                    format!("hazard probability: {:.2}", shares[0]),
                    "belief, next step:".to_owned(),
                ],
                bars: vec![named(&states[0], shares[0]), named(&states[1], shares[1]), named("unknown", 0.0)],
            }
        });
        let boards: Vec<Image> = boards.map(|board| board.draw().unwrap()).collect();
        let played = play(&file);
        assert_eq!(played.size_px, [boards[0].width_px, boards[0].height_px]);
        let psnr_db = |shown: &[u8], board: &Image| {
            let [shown, board] =
                [shown, &board.rgb].map(|p| p.iter().map(|&b| f32::from(b) / 255.0).collect::<Vec<_>>());
            carff_base::statistics::psnr_db(&shown, &board).unwrap()
        };
        for (shown, [own, other]) in played.images.iter().zip([[0, 1], [1, 0]]) {
            let [own, other] = [own, other].map(|board| psnr_db(shown, &boards[board]));
            assert!(own > 30.0 && other < 20.0, "own board {own} dB, the other frame's {other} dB");
        }
    }
}
