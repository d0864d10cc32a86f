//! Images of an MP4 file with H.264 video.

use crate::recorded::Recorded;
use anyhow::{Context, anyhow, bail, ensure};
use carff_dataset::{CameraCalibration, RawImage};
use openh264::decoder::{DecodeOptions, DecodedYUV, Decoder, Flush};
use openh264::formats::YUVSource;
use shiguredo_mp4::TrackKind;
use shiguredo_mp4::boxes::SampleEntry;
use shiguredo_mp4::demux::{Input, Mp4FileDemuxer};
use std::collections::VecDeque;
use std::fs::File;
use std::io::{Read, Seek, SeekFrom};
use std::path::{Path, PathBuf};

/// Largest part of the file that is read at once, bytes: its table of contents, or one image.
const MAX_READ_BYTES: u64 = 1 << 28;
/// Mark of the beginning of a unit in a stream.
const START: [u8; 4] = [0, 0, 0, 1];

/// A coded image in the file.
#[derive(Clone, Debug)]
struct Coded {
    at: u64,
    bytes: usize,
    /// Time at which it is shown, nanoseconds.
    time_ns: u64,
    /// Parameters that precede it, as a stream; empty if they are unchanged.
    parameters: Vec<u8>,
    length_bytes: usize,
}

/// The images of the first video track.
pub struct VideoSource {
    path: PathBuf,
    file: File,
    coded: Vec<Coded>,
    next: usize,
    /// Times of the images in the order in which they are shown.
    times_ns: Vec<u64>,
    shown: usize,
    decoder: Decoder,
    /// The current image.
    image: Rgb,
    /// The last images, which the decoder holds back until the end.
    last: Option<VecDeque<Rgb>>,
}

/// A decoded image.
#[derive(Clone, Debug, Default)]
struct Rgb {
    size_px: [u32; 2],
    bytes: Vec<u8>,
}

impl Rgb {
    fn take(&mut self, yuv: &DecodedYUV<'_>) {
        let (width, height) = yuv.dimensions();
        self.bytes.resize(width * height * 3, 0);
        yuv.write_rgb8(&mut self.bytes);
        self.size_px = [width as u32, height as u32];
    }
}

impl std::fmt::Debug for VideoSource {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("VideoSource").field("path", &self.path).finish_non_exhaustive()
    }
}

impl VideoSource {
    /// Reads the file's table of contents.
    pub fn open(path: &Path) -> anyhow::Result<Self> {
        let mut file = File::open(path).with_context(|| format!("cannot read {}", path.display()))?;
        let coded = table(&mut file).with_context(|| format!("{} cannot be shown", path.display()))?;
        let mut times_ns: Vec<u64> = coded.iter().map(|coded| coded.time_ns).collect();
        times_ns.sort_unstable();
        let (decoder, image) = (Decoder::new()?, Rgb::default());
        let path = path.to_owned();
        Ok(Self { path, file, coded, next: 0, times_ns, shown: 0, decoder, image, last: None })
    }

    /// Decodes up to the next image that can be shown.
    fn decode(&mut self) -> anyhow::Result<bool> {
        while let Some(coded) = self.coded.get(self.next) {
            self.next += 1;
            let data = read(&mut self.file, coded.at, coded.bytes as u64)?;
            let mut stream = coded.parameters.clone();
            append_units(&mut stream, &data, coded.length_bytes);
            // Images come out in the order in which they are shown; the decoder holds some back.
            let options = DecodeOptions::new().flush_after_decode(Flush::NoFlush);
            let image = self.decoder.decode_with_options(&stream, options);
            if let Some(yuv) = image.map_err(|e| anyhow!("image {} is damaged: {}", self.next, reason(&e)))? {
                self.image.take(&yuv);
                return Ok(true);
            }
        }
        if self.last.is_none() {
            // An error at the end happens once.
            self.last = Some(VecDeque::new());
            let rest = self.decoder.flush_remaining().map_err(|e| anyhow!("the end is damaged: {}", reason(&e)))?;
            let images = rest.iter().map(|yuv| {
                let mut image = Rgb::default();
                image.take(yuv);
                image
            });
            self.last = Some(images.collect());
        }
        let next = self.last.as_mut().and_then(VecDeque::pop_front);
        Ok(next.map(|image| self.image = image).is_some())
    }
}

impl Recorded for VideoSource {
    fn calibration(&mut self) -> anyhow::Result<Option<CameraCalibration>> {
        Ok(None)
    }

    fn next(&mut self) -> anyhow::Result<Option<u64>> {
        // A damaged image is left out; those that depend on it follow when they can be decoded again.
        let (mut errors, mut first) = (0, None);
        while !match self.decode() {
            Ok(true) => true,
            Ok(false) => return first.filter(|_| self.shown == 0).map_or(Ok(None), Err),
            Err(error) => {
                errors += 1;
                if first.is_none() {
                    tracing::warn!("{}: {error}", self.path.display());
                    first = Some(error);
                }
                false
            }
        } {}
        let time_ns = self.times_ns.get(self.shown).or(self.times_ns.last()).copied();
        self.shown += 1 + errors;
        Ok(time_ns)
    }

    fn with_image(&mut self, each: &mut dyn FnMut(&RawImage<'_>) -> anyhow::Result<()>) -> anyhow::Result<()> {
        each(&RawImage::rgb(self.image.size_px, &self.image.bytes)?)
    }

    fn rewind(&mut self) -> anyhow::Result<()> {
        (self.next, self.shown, self.last) = (0, 0, None);
        self.decoder = Decoder::new()?;
        Ok(())
    }
}

/// Returns the first line of a decoder's error.
fn reason(error: &openh264::Error) -> String {
    error.to_string().lines().next().unwrap_or_default().to_owned()
}

/// Returns the coded images of the first video track.
fn table(file: &mut File) -> anyhow::Result<Vec<Coded>> {
    let mut demuxer = Mp4FileDemuxer::new();
    let end = file.metadata()?.len();
    while let Some(wanted) = demuxer.required_input() {
        let most = end.saturating_sub(wanted.position);
        let bytes = wanted.size.map_or(most, |size| (size as u64).min(most));
        let data = read(file, wanted.position, bytes)?;
        demuxer.handle_input(Input { position: wanted.position, data: &data });
    }
    let tracks = demuxer.tracks().map_err(|e| anyhow!("not an MP4 file, or damaged: {e}"))?;
    let video = tracks.iter().find(|track| track.kind == TrackKind::Video).context("it has no video track")?;
    let (id, ticks_hz) = (video.track_id, u128::from(video.timescale.get()));
    let (mut coded, mut length_bytes) = (Vec::new(), 4);
    while let Some(sample) = demuxer.next_sample().map_err(|e| anyhow!("its table of contents is damaged: {e}"))? {
        if sample.track.track_id != id {
            continue;
        }
        let mut parameters = Vec::new();
        match sample.sample_entry {
            Some(SampleEntry::Avc1(entry)) => {
                length_bytes = usize::from(entry.avcc_box.length_size_minus_one.get()) + 1;
                for unit in entry.avcc_box.sps_list.iter().chain(&entry.avcc_box.pps_list) {
                    parameters.extend(START.iter().chain(unit));
                }
            }
            Some(other) => bail!(
                "its codec is {}; only H.264 is supported: convert it (ffmpeg -i FILE -c:v libx264 NEW.mp4)",
                codec(other)
            ),
            None => {}
        }
        let end_of_sample = sample.data_offset.saturating_add(sample.data_size as u64);
        ensure!(end_of_sample <= end, "the file is cut off: image {} is not in it", coded.len());
        let ticks = i128::from(sample.timestamp) + i128::from(sample.composition_time_offset.unwrap_or(0));
        let time_ns = u128::try_from(ticks).unwrap_or(0) * 1_000_000_000 / ticks_hz;
        coded.push(Coded {
            at: sample.data_offset,
            bytes: sample.data_size,
            time_ns: time_ns as u64,
            parameters,
            length_bytes,
        });
    }
    ensure!(!coded.is_empty(), "its video track has no images");
    Ok(coded)
}

fn codec(entry: &SampleEntry) -> &'static str {
    match entry {
        SampleEntry::Hev1(_) | SampleEntry::Hvc1(_) => "H.265",
        SampleEntry::Vp08(_) => "VP8",
        SampleEntry::Vp09(_) => "VP9",
        SampleEntry::Av01(_) => "AV1",
        _ => "not known",
    }
}

fn read(file: &mut File, at: u64, bytes: u64) -> anyhow::Result<Vec<u8>> {
    ensure!(bytes <= MAX_READ_BYTES, "a part of {bytes} bytes, at most {MAX_READ_BYTES} are read");
    file.seek(SeekFrom::Start(at))?;
    let mut data = Vec::new();
    file.take(bytes).read_to_end(&mut data)?;
    Ok(data)
}

/// Appends the units of an image, which begin with their length in the file, as a stream.
fn append_units(stream: &mut Vec<u8>, mut data: &[u8], length_bytes: usize) {
    while let Some((length, rest)) = data.split_at_checked(length_bytes) {
        let length = length.iter().fold(0, |sum, byte| sum << 8 | usize::from(*byte));
        let unit = &rest[..length.min(rest.len())];
        stream.extend(START.iter().chain(unit));
        data = &rest[unit.len()..];
    }
}
