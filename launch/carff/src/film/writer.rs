//! The file of a film: H.264 in MP4.

use anyhow::{Context, ensure};
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
pub(super) const TICKS_HZ: NonZeroU32 = NonZeroU32::new(90_000).unwrap();
/// Coarsest quantization, of 0 to 51; its effect is hardly visible.
const COARSENESS: QpRange = QpRange::new(12, 16);
/// Time between key images, seconds; players seek to these.
const WHOLE_IMAGE_EVERY_S: f64 = 2.0;
/// Shortest side that the encoder accepts.
const MIN_SIDE_PX: u32 = 16;
/// Frame rates that the encoder accepts, hertz.
const RATES_HZ: std::ops::RangeInclusive<f64> = 1.0..=60.0;

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

#[cfg(test)]
mod tests {
    use super::{super::player::play, *};

    /// Returns an image in which everything moves.
    fn image([width_px, height_px]: [u32; 2], number: u32) -> Vec<u8> {
        let pixel = |x: u32, y: u32| {
            let wave = ((x + 3 * number) as f32 / 20.0).sin() + (y as f32 / 15.0).cos();
            [90.0 + 40.0 * wave, 120.0 - 30.0 * wave, 60.0 + (x / 2 + number) as f32].map(|value| value as u8)
        };
        (0..height_px).flat_map(|y| (0..width_px).flat_map(move |x| pixel(x, y))).collect()
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
