//! Tests of corruptions: named draws, growing severities, any size.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use carff_base::random::Key;
use carff_dataset::{Corruption, Image};

const KEY: Key = Key { seed: 7, frame: 3, step: 1, sample: 0 };
/// Corruptions without random draws.
const FIXED: [Corruption; 9] = [
    Corruption::DefocusBlur,
    Corruption::ZoomBlur,
    Corruption::Brightness,
    Corruption::Contrast,
    Corruption::Pixelate,
    Corruption::JpegCompression,
    Corruption::Monochrome,
    Corruption::NarrowLens,
    Corruption::BarrelDistortion,
];

/// Returns a sky over a road with boxes of several sizes and colours.
fn street(width_px: u32, height_px: u32) -> Image {
    let mut image = Image::filled(width_px, height_px, [0; 3]);
    for (i, pixel) in image.rgb.chunks_exact_mut(3).enumerate() {
        let u = (i as u32 % width_px) as f64 / f64::from(width_px);
        let v = (i as u32 / width_px) as f64 / f64::from(height_px);
        let fine = 25.0 * (u * 61.0 + v * 7.0).sin() * (v * 53.0 - u * 5.0).sin();
        // Slanted edges, because large pixels may match upright ones by chance.
        let colour = match (u + 0.13 * v, v + 0.09 * u) {
            (0.1..0.35, 0.3..0.7) => [150.0, 70.0, 60.0],
            (0.55..0.7, 0.5..0.65) => [220.0, 180.0, 30.0],
            (0.8..0.84, 0.2..0.8) => [40.0, 90.0, 160.0],
            (_, ..0.45) => [120.0 + 60.0 * v, 150.0 + 60.0 * v, 190.0],
            _ => [70.0 + 40.0 * v, 72.0, 75.0],
        };
        pixel.iter_mut().zip(colour).for_each(|(p, c)| *p = (c + fine) as u8);
    }
    image
}

/// Returns the root mean square of the difference.
fn distance(a: &Image, b: &Image) -> f64 {
    let sum: f64 = a.rgb.iter().zip(&b.rgb).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum();
    (sum / a.rgb.len() as f64).sqrt()
}

/// Equal keys give equal bytes. Another seed, frame, step or sample gives others, except where nothing is drawn, or
/// where the draw is one of five orders of channels.
#[test]
fn the_key_names_the_draws() {
    let image = street(128, 128);
    for corruption in Corruption::ALL {
        let made = |key| corruption.apply(&image, 1, key).unwrap();
        assert_eq!(made(KEY), made(KEY), "{}", corruption.name());
        let others =
            [Key { seed: 8, ..KEY }, Key { frame: 4, ..KEY }, Key { step: 2, ..KEY }, Key { sample: 1, ..KEY }];
        let same = others.iter().filter(|key| made(**key) == made(KEY)).count();
        match corruption {
            Corruption::ChannelSwap => assert!(same < 4),
            fixed if FIXED.contains(&fixed) => assert_eq!(same, 4, "{}", corruption.name()),
            _ => assert_eq!(same, 0, "{}", corruption.name()),
        }
    }
}

/// A higher severity is farther from the clean image. Snow, frost and the elastic transform are two series each, because
/// their definitions change another part of the image from severity 2 to 3, or from 3 to 4.
#[test]
fn severities_grow() {
    for (width_px, height_px) in [(128, 128), (200, 90)] {
        let image = street(width_px, height_px);
        for corruption in Corruption::ALL {
            let far = |severity| distance(&image, &corruption.apply(&image, severity, KEY).unwrap());
            let distances: Vec<f64> = corruption.severities().map(far).collect();
            let series: Vec<&[f64]> = match corruption {
                Corruption::Frost => vec![&distances[..3], &distances[3..]],
                Corruption::ElasticTransform | Corruption::Snow => vec![&distances[..2], &distances[2..]],
                // The largest shift is beyond the street's own pattern.
                Corruption::TurnedCamera => vec![&distances[..4]],
                _ => vec![&distances],
            };
            for series in series {
                assert!(series[0] > 0.5, "{} {distances:?}", corruption.name());
                assert!(series.windows(2).all(|w| w[0] < w[1]), "{} {distances:?}", corruption.name());
            }
        }
    }
}

/// Any size works, down to one pixel, and stays.
#[test]
fn outputs_have_the_size_of_the_input() {
    for (width_px, height_px) in [(1, 1), (16, 16), (128, 128), (200, 90), (3, 40)] {
        let image = street(width_px, height_px);
        for corruption in Corruption::ALL {
            for severity in corruption.severities() {
                let made = corruption.apply(&image, severity, KEY).unwrap();
                assert_eq!((made.width_px, made.height_px), (width_px, height_px), "{}", corruption.name());
                assert_eq!(made.rgb.len(), image.rgb.len());
            }
        }
    }
}

/// A severity means the same at every size: an image of twice the side differs from its clean one by about as much.
/// Noise of single pixels, and compression in blocks of 8 pixels, have no such length.
#[test]
fn severities_mean_the_same_at_every_size() {
    let (small, large) = (street(112, 112), street(224, 224));
    for corruption in [
        Corruption::DefocusBlur,
        Corruption::MotionBlur,
        Corruption::ZoomBlur,
        Corruption::Fog,
        Corruption::Frost,
        Corruption::Dirt,
        Corruption::Rain,
        Corruption::BarrelDistortion,
    ] {
        let far = |image| distance(image, &corruption.apply(image, 3, KEY).unwrap());
        let ratio = far(&small) / far(&large);
        assert!((0.8..1.25).contains(&ratio), "{}: {ratio}", corruption.name());
    }
}

/// Names are unique, are found again, and are those of files.
#[test]
fn names_are_those_of_files() {
    for corruption in Corruption::ALL {
        assert_eq!(Corruption::from_name(corruption.name()), Some(corruption));
        assert_eq!(serde_json::to_value(corruption).unwrap(), corruption.name());
    }
    assert_eq!(Corruption::from_name("hail"), None);
}

/// Other severities, empty images and wrong numbers of bytes are refused.
#[test]
fn wrong_input_is_refused() {
    let image = street(16, 16);
    let error = |corruption: Corruption, image: &Image, severity| {
        corruption.apply(image, severity, KEY).unwrap_err().to_string()
    };
    assert!(error(Corruption::Fog, &image, 0).contains("`fog` has no severity 0; from 1 to 5"));
    assert!(error(Corruption::Fog, &image, 6).contains("no severity 6"));
    assert!(error(Corruption::Monochrome, &image, 2).contains("from 1 to 1"));
    assert!(error(Corruption::Fog, &Image::filled(0, 5, [0; 3]), 1).contains("at least one pixel"));
    let cut = Image { rgb: vec![0; 5], ..image };
    assert!(error(Corruption::JpegCompression, &cut, 1).contains("5 bytes are not an image of 16x16"));
}
