//! Tests of the video source on a file of another encoder.

#![allow(clippy::unwrap_used, reason = "a helper of a test fails it by panicking")]

use carff_camera::VideoSource;
use carff_camera::recorded::Recorded;
use std::path::{Path, PathBuf};

fn ball() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("testdata/ball.mp4")
}

/// Returns the error of opening a changed copy of the file.
fn refused(change: impl FnOnce(&mut Vec<u8>)) -> String {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("changed.mp4");
    let mut bytes = std::fs::read(ball()).unwrap();
    change(&mut bytes);
    std::fs::write(&path, bytes).unwrap();
    VideoSource::open(&path).map_or_else(|e| format!("{e:#}"), |_| String::new())
}

/// Every image is shown, in the order of its time: the ball is bright, moves in small steps, and the times are a tenth
/// of a second apart. A rewind shows the same again.
#[test]
fn all_images_are_shown_in_order() {
    let mut source = VideoSource::open(&ball()).unwrap();
    let mut show = || {
        let (mut times, mut centres) = (Vec::new(), Vec::new());
        while let Some(time_ns) = source.next().unwrap() {
            times.push(time_ns);
            let mut at = [0.0; 2];
            source
                .with_image(&mut |raw| {
                    assert_eq!(raw.size_px(), [64, 64]);
                    let bright: Vec<[usize; 2]> =
                        (0..64 * 64).map(|i| [i % 64, i / 64]).filter(|[x, y]| raw.pixel(*x, *y)[0] > 128).collect();
                    assert!(bright.len() > 100, "{}", bright.len());
                    at = [0, 1].map(|axis| bright.iter().map(|p| p[axis] as f64).sum::<f64>() / bright.len() as f64);
                    Ok(())
                })
                .unwrap();
            centres.push(at);
        }
        source.rewind().unwrap();
        (times, centres)
    };
    let (times, centres) = show();
    assert_eq!(times.len(), 20);
    assert!(times.windows(2).all(|pair| (90_000_000..=110_000_000).contains(&(pair[1] - pair[0]))), "{times:?}");
    for pair in centres.windows(2) {
        let step = (pair[1][0] - pair[0][0]).hypot(pair[1][1] - pair[0][1]);
        assert!((0.3..2.0).contains(&step) && pair[1][0] > pair[0][0], "{centres:?}");
    }
    assert_eq!(show(), (times, centres));
}

/// Files without video, of another codec, or cut off are errors with the remedy.
#[test]
fn unusable_files_are_refused() {
    let cut = refused(|bytes| bytes.truncate(5000));
    assert!(cut.contains("changed.mp4 cannot be shown"), "{cut}");
    let other = refused(|bytes| {
        let at = bytes.windows(4).rposition(|word| word == b"avc1").unwrap();
        bytes[at..at + 4].copy_from_slice(b"mjpg");
    });
    assert!(other.contains("only H.264") && other.contains("ffmpeg"), "{other}");
    let empty = refused(Vec::clear);
    assert!(empty.contains("not an MP4 file"), "{empty}");
    let text = refused(|bytes| *bytes = b"no video at all, only text that is long enough".to_vec());
    assert!(text.contains("not an MP4 file"), "{text}");
    assert!(VideoSource::open(Path::new("missing.mp4")).unwrap_err().to_string().contains("missing.mp4"));
}

/// A damaged image costs some images, and later ones are shown again; no byte makes the source panic.
#[test]
fn damaged_images_are_left_out() {
    let whole = std::fs::read(ball()).unwrap();
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("damaged.mp4");
    for at in (40..whole.len()).step_by(61) {
        let mut bytes = whole.clone();
        for byte in bytes.iter_mut().skip(at).take(7) {
            *byte ^= 0x5a;
        }
        std::fs::write(&path, bytes).unwrap();
        let Ok(mut source) = VideoSource::open(&path) else { continue };
        let mut shown = 0;
        while let Ok(Some(_)) = source.next() {
            let _ = source.with_image(&mut |raw| {
                let _ = raw.pixel(0, 0);
                Ok(())
            });
            shown += 1;
            assert!(shown <= 100);
        }
    }
}
