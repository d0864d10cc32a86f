//! Films: images as H.264 in an MP4 file, each shown from its own time until the next image.

use anyhow::{Context, ensure};
use carff_checkpoint::Manifest;
use carff_dataset::Image;
use carff_messages::{Action, ActionCode, Belief, FrameMeta, ImageMeta, Occupancy, Reason, ViewKind, ViewMeta};
use carff_plots::{Bar, Board};
use carff_recording::Reader;
use carff_transport::TopicId;
use openh264::OpenH264API;
use openh264::encoder::{
    ColorPrimaries, Encoder, EncoderConfig, FrameRate, FrameType, IntraFramePeriod, Profile, QpRange, RateControlMode,
    TransferCharacteristics, VuiConfig,
};
use openh264::formats::{RgbSliceU8, YUVBuffer};
use shiguredo_mp4::boxes::{Avc1Box, AvccBox, SampleEntry, VisualSampleEntryFields};
use shiguredo_mp4::mux::{Mp4FileMuxer, Sample};
use shiguredo_mp4::{TrackKind, Uint};
use std::borrow::Cow;
use std::fs::File;
use std::io::{BufWriter, Seek, SeekFrom, Write};
use std::num::NonZeroU32;
use std::path::{Path, PathBuf};

/// Ticks per second of the film's clock: a multiple of each usual frame rate.
const TICKS_HZ: NonZeroU32 = NonZeroU32::new(90_000).unwrap();
/// Coarsest quantization, of 0 to 51; its effect is hardly visible.
const COARSENESS: QpRange = QpRange::new(12, 16);
/// Time between key images, seconds; players seek to these.
const WHOLE_IMAGE_EVERY_S: f64 = 2.0;
/// Shortest side that the encoder accepts.
const MIN_SIDE_PX: u32 = 16;
/// Frame rates that the encoder accepts, hertz.
const RATES_HZ: std::ops::RangeInclusive<f64> = 1.0..=60.0;

/// Size of the occupancy grid's image.
const GRID_PX: [u32; 2] = [64, 64];
/// Rate of a film from a recording with only one frame, frames per second.
const LONE_FRAME_HZ: f64 = 10.0;

/// A film that is being written.
pub(crate) struct FilmWriter {
    path: PathBuf,
    file: BufWriter<File>,
    encoder: Encoder,
    muxer: Mp4FileMuxer,
    size_px: [u32; 2],
    /// Position of the next bytes in the file.
    position: u64,
    begun_ns: Option<u64>,
    /// The last image and its time, in ticks. The next image determines its duration.
    last: Option<(Sample, u64)>,
    /// Duration of the last image of the film.
    period_ticks: u32,
    count: u64,
}

impl FilmWriter {
    /// Creates the file. `rate_hz` is the approximate rate of images.
    pub(crate) fn create(path: &Path, size_px: [u32; 2], rate_hz: f64) -> anyhow::Result<Self> {
        let config = EncoderConfig::new()
            .profile(Profile::Baseline)
            // Constant quality at any size, and no image is skipped.
            .rate_control_mode(RateControlMode::Bufferbased)
            .qp(COARSENESS)
            .skip_frames(false)
            .background_detection(false)
            .max_frame_rate(FrameRate::from_hz(rate_hz.clamp(*RATES_HZ.start(), *RATES_HZ.end()) as f32))
            .intra_frame_period(IntraFramePeriod::from_num_frames((WHOLE_IMAGE_EVERY_S * rate_hz).max(1.0) as u32))
            .num_threads(1)
            // The colour conversion, and the colour space.
            .vui(
                VuiConfig::bt601()
                    .color_primaries(ColorPrimaries::Bt709)
                    .transfer_characteristics(TransferCharacteristics::Srgb),
            );
        let encoder =
            Encoder::with_api_config(OpenH264API::from_source(), config).context("cannot start the film's encoder")?;
        let muxer = Mp4FileMuxer::new()?;
        let mut film = Self {
            path: path.to_owned(),
            file: BufWriter::new(File::create(path).with_context(|| format!("cannot write {}", path.display()))?),
            encoder,
            muxer,
            size_px,
            position: 0,
            begun_ns: None,
            last: None,
            period_ticks: (f64::from(TICKS_HZ.get()) / rate_hz).clamp(1.0, f64::from(u32::MAX)) as u32,
            count: 0,
        };
        let head = film.muxer.initial_boxes_bytes().to_vec();
        film.write(&head)?;
        Ok(film)
    }

    /// Returns width and height of its images.
    pub(crate) fn size_px(&self) -> [u32; 2] {
        self.size_px
    }

    /// Adds an image, RGB bytes row by row, captured at this time.
    pub(crate) fn add(&mut self, rgb: &[u8], at_ns: u64) -> anyhow::Result<()> {
        let (rgb, [width_px, height_px]) = fitting(rgb, self.size_px);
        let image = RgbSliceU8::new(&rgb, (width_px as usize, height_px as usize));
        let stream = self
            .encoder
            .encode(&YUVBuffer::from_rgb8_source(image))
            .with_context(|| format!("cannot encode images of {width_px} x {height_px} pixels"))?;
        let keyframe = stream.frame_type() == FrameType::IDR;
        let (mut sequence, mut images, mut data) = (Vec::new(), Vec::new(), Vec::new());
        for layer in (0..stream.num_layers()).filter_map(|i| stream.layer(i)) {
            for unit in (0..layer.nal_count()).filter_map(|i| layer.nal_unit(i)) {
                let unit = unit.strip_prefix(&[0, 0, 0, 1]).or_else(|| unit.strip_prefix(&[0, 0, 1])).unwrap_or(unit);
                // The file's index contains the parameter sets once; the rest is the image.
                match unit.first().map(|byte| byte & 0x1f) {
                    Some(7) => sequence.push(unit.to_vec()),
                    Some(8) => images.push(unit.to_vec()),
                    _ => {
                        data.extend((unit.len() as u32).to_be_bytes());
                        data.extend(unit);
                    }
                }
            }
        }
        ensure!(!data.is_empty(), "the film's encoder skipped image {}", self.count);
        let entry = match self.last {
            None => Some(sample_entry([width_px, height_px], sequence, images)?),
            Some(_) => None,
        };

        let begun_ns = *self.begun_ns.get_or_insert(at_ns);
        let since_ns = u128::from(at_ns.saturating_sub(begun_ns));
        let at_ticks = (since_ns * u128::from(TICKS_HZ.get()) / 1_000_000_000) as u64;
        if let Some((mut before, before_ticks)) = self.last.take() {
            before.duration = at_ticks.saturating_sub(before_ticks).clamp(1, u32::MAX.into()) as u32;
            self.muxer.append_sample(&before)?;
        }
        let sample = Sample {
            track_kind: TrackKind::Video,
            sample_entry: entry,
            keyframe,
            timescale: TICKS_HZ,
            duration: self.period_ticks,
            composition_time_offset: None,
            data_offset: self.position,
            data_size: data.len(),
        };
        self.last = Some((sample, at_ticks));
        self.count += 1;
        self.write(&data)
    }

    /// Writes the index. Returns the number of images.
    pub(crate) fn finish(mut self) -> anyhow::Result<u64> {
        if let Some((last, _)) = self.last.take() {
            self.muxer.append_sample(&last)?;
        }
        for (offset, bytes) in self.muxer.finalize()?.offset_and_bytes_pairs() {
            self.file
                .seek(SeekFrom::Start(offset))
                .and_then(|_| self.file.write_all(bytes))
                .with_context(|| format!("cannot write {}", self.path.display()))?;
        }
        self.file.flush().with_context(|| format!("cannot write {}", self.path.display()))?;
        Ok(self.count)
    }

    fn write(&mut self, bytes: &[u8]) -> anyhow::Result<()> {
        self.file.write_all(bytes).with_context(|| format!("cannot write {}", self.path.display()))?;
        self.position += bytes.len() as u64;
        Ok(())
    }
}

/// Returns the description of the encoding, for the index.
fn sample_entry(size_px: [u32; 2], sequence: Vec<Vec<u8>>, images: Vec<Vec<u8>>) -> anyhow::Result<SampleEntry> {
    let [width, height] = size_px.map(u16::try_from);
    let profile = sequence.first().and_then(|unit| unit.get(1..4)).context("the film's encoder gave no parameters")?;
    Ok(SampleEntry::Avc1(Avc1Box {
        visual: VisualSampleEntryFields {
            data_reference_index: VisualSampleEntryFields::DEFAULT_DATA_REFERENCE_INDEX,
            width: width?,
            height: height?,
            horizresolution: VisualSampleEntryFields::DEFAULT_HORIZRESOLUTION,
            vertresolution: VisualSampleEntryFields::DEFAULT_VERTRESOLUTION,
            frame_count: VisualSampleEntryFields::DEFAULT_FRAME_COUNT,
            compressorname: VisualSampleEntryFields::NULL_COMPRESSORNAME,
            depth: VisualSampleEntryFields::DEFAULT_DEPTH,
        },
        avcc_box: AvccBox {
            avc_profile_indication: profile[0],
            profile_compatibility: profile[1],
            avc_level_indication: profile[2],
            length_size_minus_one: Uint::new(3),
            sps_list: sequence,
            pps_list: images,
            chroma_format: None,
            bit_depth_luma_minus8: None,
            bit_depth_chroma_minus8: None,
            sps_ext_list: Vec::new(),
        },
        unknown_boxes: Vec::new(),
    }))
}

/// Returns an image with sides that the encoder accepts: even and long enough. The last column and row are repeated if
/// necessary.
fn fitting(rgb: &[u8], [width_px, height_px]: [u32; 2]) -> (Cow<'_, [u8]>, [u32; 2]) {
    let fitting_px = [width_px, height_px].map(|side_px| side_px.next_multiple_of(2).max(MIN_SIDE_PX));
    if fitting_px == [width_px, height_px] {
        return (Cow::Borrowed(rgb), fitting_px);
    }
    let last = |side_px: u32| side_px.saturating_sub(1);
    let pixel = |x: u32, y: u32| (y.min(last(height_px)) * width_px + x.min(last(width_px))) as usize * 3;
    let places = (0..fitting_px[1]).flat_map(|y| (0..fitting_px[0]).map(move |x| pixel(x, y)));
    (places.flat_map(|at| &rgb[at..at + 3]).copied().collect(), fitting_px)
}

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
    use super::*;
    use openh264::decoder::Decoder;
    use openh264::formats::YUVSource;
    use shiguredo_mp4::demux::{Input, Mp4FileDemuxer};

    /// Returns an image in which everything moves.
    fn image([width_px, height_px]: [u32; 2], number: u32) -> Vec<u8> {
        let pixel = |x: u32, y: u32| {
            let wave = ((x + 3 * number) as f32 / 20.0).sin() + (y as f32 / 15.0).cos();
            [90.0 + 40.0 * wave, 120.0 - 30.0 * wave, 60.0 + (x / 2 + number) as f32].map(|value| value as u8)
        };
        (0..height_px).flat_map(|y| (0..width_px).flat_map(move |x| pixel(x, y))).collect()
    }

    /// The content of a file for a player: sides, numbers of key images, times in ticks, length in ticks, decoded
    /// images.
    struct Played {
        size_px: [u32; 2],
        whole: Vec<usize>,
        times: Vec<u64>,
        ticks: u64,
        images: Vec<Vec<u8>>,
    }

    fn play(path: &Path) -> Played {
        let bytes = std::fs::read(path).unwrap();
        let mut demuxer = Mp4FileDemuxer::new();
        while demuxer.required_input().is_some() {
            demuxer.handle_input(Input { position: 0, data: &bytes });
        }
        let tracks = demuxer.tracks().unwrap().to_vec();
        assert_eq!(tracks.len(), 1);
        assert_eq!(tracks[0].timescale, TICKS_HZ);
        let mut played = Played {
            size_px: [0; 2],
            whole: Vec::new(),
            times: Vec::new(),
            ticks: tracks[0].duration,
            images: Vec::new(),
        };
        let mut decoder = Decoder::new().unwrap();
        while let Some(sample) = demuxer.next_sample().unwrap() {
            let mut stream = Vec::new();
            if let Some(SampleEntry::Avc1(entry)) = sample.sample_entry {
                played.size_px = [entry.visual.width, entry.visual.height].map(u32::from);
                for unit in entry.avcc_box.sps_list.iter().chain(&entry.avcc_box.pps_list) {
                    stream.extend([&[0, 0, 0, 1], unit.as_slice()].concat());
                }
            }
            let mut data = &bytes[sample.data_offset as usize..][..sample.data_size];
            while let Some((length, rest)) = data.split_first_chunk::<4>() {
                let (unit, rest) = rest.split_at(u32::from_be_bytes(*length) as usize);
                stream.extend([&[0, 0, 0, 1], unit].concat());
                data = rest;
            }
            if sample.keyframe {
                played.whole.push(played.times.len());
            }
            played.times.push(sample.timestamp);
            let decoded = decoder.decode(&stream).unwrap().expect("each sample is an image");
            let (width, height) = decoded.dimensions();
            assert_eq!([width as u32, height as u32], played.size_px);
            let mut rgb = vec![0; width * height * 3];
            decoded.write_rgb8(&mut rgb);
            played.images.push(rgb);
        }
        played
    }

    /// A film shows every image, nearly unchanged, at its own time; players can seek to one image every two seconds.
    #[test]
    fn films_show_what_was_filmed() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.mp4");
        let size_px = [128, 72];
        // Ten images per second, with a gap of a second after the 30th.
        let at_ns = |number: u32| 7_000 + u64::from(number) * 100_000_000 + u64::from(number > 29) * 1_000_000_000;
        let mut film = FilmWriter::create(&path, size_px, 10.0).unwrap();
        for number in 0..50 {
            film.add(&image(size_px, number), at_ns(number)).unwrap();
        }
        assert_eq!(film.finish().unwrap(), 50);

        let played = play(&path);
        assert_eq!(played.size_px, size_px);
        let expected: Vec<u64> = (0..50).map(|n| (at_ns(n) - at_ns(0)) * 9 / 100_000).collect();
        assert_eq!(played.times, expected);
        assert_eq!(played.ticks, expected[49] + 9_000);
        assert!(played.whole.contains(&0) && played.whole.windows(2).all(|w| w[1] - w[0] <= 20), "{:?}", played.whole);
        for (number, decoded) in played.images.iter().enumerate() {
            let [found, wanted] = [decoded, &image(size_px, number as u32)]
                .map(|p| p.iter().map(|&byte| f32::from(byte) / 255.0).collect::<Vec<_>>());
            let psnr_db = carff_base::statistics::psnr_db(&found, &wanted).unwrap();
            assert!(psnr_db > 35.0, "image {number}: {psnr_db} dB");
        }
    }

    /// An exported film shows each frame next to its own decision, hazard probability and belief, and the latest hypothesis
    /// from above.
    #[test]
    fn films_show_decision_and_belief() {
        use carff_messages::forms::AnyMessage;
        use carff_messages::{Header, Rule};
        let folder = tempfile::tempdir().unwrap();
        let (recording, file) = (folder.path().join("r.mcap"), folder.path().join("film.mp4"));
        let states = ["actor, t0", "no actor"].map(str::to_owned).to_vec();
        let about = carff_recording::About { states: states.clone(), ..carff_recording::About::default() };
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
                header,
                action: action.code(),
                reason: Reason::Belief.code(),
                rule: Rule::Calibrated.code(),
                sample_count: 1,
                confidence: 1.0,
                hazard_probability: shares[0],
                is_decision: 1,
                unknown_probability: 0.0,
                valid_until_ns: at_ns + 1,
                based_on_frame: frame,
                latency_ns: 0,
                target_speed_mps: 0.0,
                look_gain_bits: 0.0,
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

    /// In images with odd or short sides the last column and row are repeated.
    #[test]
    fn films_have_fitting_sides() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("film.mp4");
        for (size_px, fitting_px) in [([2, 1], [16, 16]), ([37, 21], [38, 22])] {
            let mut film = FilmWriter::create(&path, size_px, 10.0).unwrap();
            film.add(&image(size_px, 0), 5).unwrap();
            assert_eq!(film.finish().unwrap(), 1);
            let played = play(&path);
            assert_eq!((played.size_px, played.images.len(), played.ticks), (fitting_px, 1, 9_000));
        }
        let counting: Vec<u8> = (0..17 * 16 * 3).map(|i| (i / 3) as u8).collect();
        let (rgb, _) = fitting(&counting, [17, 16]);
        let first_row: Vec<u8> = rgb[..18 * 3].chunks_exact(3).map(|pixel| pixel[0]).collect();
        assert_eq!(first_row, [0, 1, 2, 3, 4, 5, 6, 7, 8, 9, 10, 11, 12, 13, 14, 15, 16, 16]);
        assert_eq!((rgb.len(), rgb[18 * 3]), (18 * 16 * 3, 17));
    }
}
