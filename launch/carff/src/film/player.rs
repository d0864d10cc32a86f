//! A player of films, for tests.

use super::writer::TICKS_HZ;
use openh264::decoder::Decoder;
use openh264::formats::YUVSource;
use shiguredo_mp4::boxes::SampleEntry;
use shiguredo_mp4::demux::{Input, Mp4FileDemuxer};
use std::path::Path;

/// The content of a file for a player: sides, numbers of key images, times in ticks, length in ticks, decoded
/// images.
pub(super) struct Played {
    pub size_px: [u32; 2],
    pub whole: Vec<usize>,
    pub times: Vec<u64>,
    pub ticks: u64,
    pub images: Vec<Vec<u8>>,
}

/// Decodes a film.
pub(super) fn play(path: &Path) -> Played {
    let bytes = std::fs::read(path).unwrap();
    let mut demuxer = Mp4FileDemuxer::new();
    while demuxer.required_input().is_some() {
        demuxer.handle_input(Input { position: 0, data: &bytes });
    }
    let tracks = demuxer.tracks().unwrap().to_vec();
    assert_eq!(tracks.len(), 1);
    assert_eq!(tracks[0].timescale, TICKS_HZ);
    let mut played =
        Played { size_px: [0; 2], whole: Vec::new(), times: Vec::new(), ticks: tracks[0].duration, images: Vec::new() };
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
