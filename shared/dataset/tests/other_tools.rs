//! Tests of datasets as other tools write them: encodings, paths, formats, matrices, sizes, and missing or broken files.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::path::Path;

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Dataset, DatasetReport, Image, ImportOptions, import};
use serde_json::{Value, json};

const SIDE_PX: u32 = 32;

fn cameras() -> Vec<PinholeCamera> {
    (0..4)
        .map(|i| {
            let a = f64::from(i) * 1.3 + 0.4;
            let eye = [4.0 * a.cos(), 4.0 * a.sin(), 2.0];
            PinholeCamera::look_at(eye, [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], SIDE_PX, SIDE_PX, 60.0)
        })
        .collect()
}

fn image(i: usize) -> Image {
    let rgb = (0..SIDE_PX * SIDE_PX).flat_map(|p| [(p % SIDE_PX * 6) as u8, (p / SIDE_PX * 6) as u8, 40 * i as u8]);
    Image { width_px: SIDE_PX, height_px: SIDE_PX, rgb: rgb.collect() }
}

/// Returns four frames with the names that `name` returns.
fn set(name: impl Fn(usize) -> String) -> Value {
    let frames: Vec<Value> = cameras()
        .iter()
        .enumerate()
        .map(|(i, c)| json!({"file_path": name(i), "transform_matrix": c.world_from_camera}))
        .collect();
    let c = cameras()[0];
    json!({"w": SIDE_PX, "h": SIDE_PX, "fl_x": c.fl_x_px, "fl_y": c.fl_y_px, "cx": c.cx_px, "cy": c.cy_px, "frames": frames})
}

fn plain() -> Value {
    set(|i| format!("images/{i}.png"))
}

/// Writes the images `images/0.png` to `images/3.png`, and the transforms file.
fn put(dir: &Path, set: &Value) {
    std::fs::create_dir_all(dir.join("images")).unwrap();
    for i in 0..4 {
        image(i).save_png(&dir.join(format!("images/{i}.png"))).unwrap();
    }
    std::fs::write(dir.join("transforms.json"), set.to_string()).unwrap();
}

fn jpeg(image: &Image) -> Vec<u8> {
    let mut bytes = Vec::new();
    image::RgbImage::from_raw(image.width_px, image.height_px, image.rgb.clone())
        .unwrap()
        .write_to(&mut std::io::Cursor::new(&mut bytes), image::ImageFormat::Jpeg)
        .unwrap();
    bytes
}

/// Opens a dataset, and imports it into a folder that is removed; both give the same images.
fn opened_and_imported(dir: &Path) -> Dataset {
    let opened = Dataset::open(dir).unwrap();
    let out = tempfile::tempdir().unwrap();
    let out = out.path().join("imported");
    assert_eq!(import(dir, &out, &ImportOptions::default()).unwrap().warnings, opened.warnings());
    let imported = Dataset::open(&out).unwrap();
    assert_eq!(opened.load_all_images().unwrap(), imported.load_all_images().unwrap());
    for i in 0..opened.frames().len() {
        assert_eq!(opened.valid_pixels(i), imported.valid_pixels(i));
    }
    opened
}

fn refused(dir: &Path) -> String {
    let opened = Dataset::open(dir).and_then(|set| set.load_all_images()).unwrap_err().to_string();
    let out = tempfile::tempdir().unwrap();
    let imported = import(dir, &out.path().join("imported"), &ImportOptions::default()).unwrap_err().to_string();
    assert_eq!(opened, imported);
    opened
}

/// UTF-8 with a byte order mark, and UTF-16 in both byte orders with and without one, are read. Odd UTF-16 is not.
#[test]
fn encodings() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &plain());
    let path = dir.path().join("transforms.json");
    let text = plain().to_string();
    let marked = format!("\u{feff}{text}");
    let little = |text: &str| text.encode_utf16().flat_map(u16::to_le_bytes).collect::<Vec<_>>();
    let big = |text: &str| text.encode_utf16().flat_map(u16::to_be_bytes).collect::<Vec<_>>();
    for bytes in [marked.clone().into_bytes(), little(&marked), big(&marked), little(&text), big(&text)] {
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(opened_and_imported(dir.path()).frames().len(), 4);
    }
    let indented = format!("\t{}", text.replace("],", "],\r\n\t"));
    for bytes in [indented.clone().into_bytes(), little(&indented), big(&indented)] {
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(opened_and_imported(dir.path()).frames().len(), 4);
    }
    std::fs::write(&path, &little(&marked)[..301]).unwrap();
    assert!(refused(dir.path()).contains("transforms.json: not valid JSON: not valid UTF-16"));
    std::fs::write(&path, "version https://git-lfs.github.com/spec/v1\noid sha256:0\n").unwrap();
    assert!(refused(dir.path()).contains("git lfs pull"));
}

/// Backslashes, names without an ending, names of neighbour folders, and formats under another ending are read; an exact
/// name has precedence.
#[test]
fn paths_and_formats() {
    let parent = tempfile::tempdir().unwrap();
    let dir = parent.path().join("set");
    for name in ["images\\", "images/./", ".\\images\\", "../images/", "..\\images\\", "images/../images/"] {
        put(&dir, &set(|i| format!("{name}{i}.png")));
        put(parent.path(), &plain());
        let set = opened_and_imported(&dir);
        assert_eq!(set.load_all_images().unwrap(), [0, 1, 2, 3].map(image), "{name}");
    }
    put(&dir, &set(|i| format!("images/r_{i}")));
    for (i, ending) in ["jpg", "JPEG", "png", "jpeg"].into_iter().enumerate() {
        std::fs::write(dir.join(format!("images/r_{i}.{ending}")), jpeg(&image(i))).unwrap();
    }
    let images = opened_and_imported(&dir).load_all_images().unwrap();
    assert!((0..4).all(|i| images[i].psnr_db(&image(i)).unwrap() > 30.0), "JPEG by content, also named .png");
    image(0).save_png(&dir.join("images/r_0.png")).unwrap();
    std::fs::rename(dir.join("images/r_0.png"), dir.join("images/r_0")).unwrap();
    assert_eq!(opened_and_imported(&dir).load_image(0).unwrap(), image(0));
    std::fs::write(dir.join("images/r_1.jpg"), "GIF89a, and more").unwrap();
    assert!(refused(&dir).contains("r_1.jpg: not a readable PNG or JPEG image: a Gif file"));
    std::fs::write(dir.join("images/r_1.jpg"), "version https://git-lfs.github.com/spec/v1\n").unwrap();
    assert!(refused(&dir).contains("git lfs pull"));
}

/// Each missing or broken image is listed, once. A check continues with the others.
#[test]
fn all_missing_images_are_listed() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &plain());
    std::fs::remove_file(dir.path().join("images/2.png")).unwrap();
    assert!(refused(dir.path()).contains("frame 2 (images/2.png): key `file_path`: there is no file"));
    let (rest, faults) = Dataset::survey(dir.path()).unwrap();
    let rest = rest.unwrap();
    assert_eq!((rest.frames().len(), faults.len()), (3, 1));
    assert_eq!(rest.load_all_images().unwrap(), [0, 1, 3].map(image));
    std::fs::remove_file(dir.path().join("images/0.png")).unwrap();
    let error = refused(dir.path());
    assert!(error.starts_with("2 images or masks cannot be used:") && error.contains("images/0.png"), "{error}");
    std::fs::write(dir.path().join("images/3.png"), "no image").unwrap();
    Image::filled(9, 9, [0; 3]).save_png(&dir.path().join("images/1.png")).unwrap();
    let (rest, faults) = Dataset::survey(dir.path()).unwrap();
    assert!(rest.is_none() && faults.len() == 4, "{faults:?}");
    // Without `w` and `h`, the size of a missing image is unknown.
    let mut unsized_set = plain();
    unsized_set.as_object_mut().unwrap().retain(|key, _| !["w", "h"].contains(&key.as_str()));
    put(dir.path(), &unsized_set);
    std::fs::remove_file(dir.path().join("images/1.png")).unwrap();
    assert!(refused(dir.path()).contains("there is no file"));
    assert_eq!(Dataset::survey(dir.path()).unwrap().1.len(), 1);
}

/// A scenario without one image continues a check without that view; later views are renumbered.
#[test]
fn a_view_without_an_image_is_left_out() {
    let dir = tempfile::tempdir().unwrap();
    let mut set = plain();
    set["scenario"] =
        json!({"bounds": [[-1, -1, 0], [1, 1, 2]], "branches": ["a", "b"], "timestamps": 1, "bev_view": 1});
    let pose = set["frames"][0]["transform_matrix"].clone();
    let other = set["frames"][3]["transform_matrix"].clone();
    for (i, frame) in set["frames"].as_array_mut().unwrap().iter_mut().enumerate() {
        frame["scene_id"] = json!(i % 2);
        frame["view_id"] = json!(i / 2);
        frame["transform_matrix"] = if i < 2 { pose.clone() } else { other.clone() };
    }
    put(dir.path(), &set);
    assert!(Dataset::open(dir.path()).is_ok());
    std::fs::remove_file(dir.path().join("images/1.png")).unwrap();
    let (rest, faults) = Dataset::survey(dir.path()).unwrap();
    let rest = rest.unwrap();
    assert_eq!((faults.len(), rest.view_count(), rest.scenario().unwrap().bev_view), (1, 1, Some(0)));
    assert_eq!(rest.load_all_images().unwrap(), [2, 3].map(image));
    let images = rest.load_all_images().unwrap();
    assert!(DatasetReport::of(&rest, &images).to_string().contains("2 of 32x32 px"));
}

/// Rounded rotations become the nearest rotation; scaled and mirrored ones are refused with their numbers.
#[test]
fn matrices() {
    let dir = tempfile::tempdir().unwrap();
    let changed = |change: &dyn Fn(usize, usize, f64) -> f64| {
        let mut set = plain();
        for frame in set["frames"].as_array_mut().unwrap() {
            for (i, row) in frame["transform_matrix"].as_array_mut().unwrap().iter_mut().take(3).enumerate() {
                for (j, value) in row.as_array_mut().unwrap().iter_mut().enumerate() {
                    *value = json!(change(i, j, value.as_f64().unwrap()));
                }
            }
        }
        put(dir.path(), &set);
    };
    for digits in [100.0, 1000.0, 10000.0] {
        changed(&|_, _, v| (v * digits).round() / digits);
        let set = opened_and_imported(dir.path());
        for (frame, camera) in set.frames().iter().zip(cameras()) {
            let (m, exact) = (frame.camera.world_from_camera, camera.world_from_camera);
            for i in 0..9 {
                assert!((m[i / 3][i % 3] - exact[i / 3][i % 3]).abs() < 1.0 / digits);
                let product: f64 = (0..3).map(|k| m[k][i / 3] * m[k][i % 3]).sum();
                let wanted = if i / 3 == i % 3 { 1.0 } else { 0.0 };
                assert!((product - wanted).abs() < if digits < 500.0 { 1e-9 } else { 1e-3 });
            }
        }
        assert_eq!(set.warnings().iter().any(|w| w.contains("rounded")), digits < 5000.0, "{:?}", set.warnings());
    }
    changed(&|_, j, v| if j < 3 { v * 0.01 } else { v });
    assert!(refused(dir.path()).contains("key `transform_matrix`: is scaled by 0.010000;"));
    changed(&|_, j, v| if j == 1 { v * 2.5 } else { v });
    assert!(refused(dir.path()).contains("is scaled by 1.000000, 2.500000 and 1.000000 along its axes"));
    changed(&|_, j, v| if j == 2 { -v } else { v });
    assert!(refused(dir.path()).contains("is mirrored: its determinant is -1.0000,"));
    changed(&|_, j, v| if j < 3 { v * -2.0 } else { v });
    assert!(refused(dir.path()).contains("is mirrored: its determinant is -8.0000,"));
    changed(&|i, j, v| if (i, j) == (0, 0) { v + 0.3 } else { v });
    assert!(refused(dir.path()).contains("the rotation part of `transform_matrix` is not a rotation"));
}

/// A key that appears twice, NaN, numbers beyond the range and deep nesting are errors of the file; none of two values is
/// chosen in silence.
#[test]
fn ambiguous_and_odd_json() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &plain());
    let text = plain().to_string();
    let with = |more: &str| std::fs::write(dir.path().join("transforms.json"), text.replacen('{', more, 1)).unwrap();
    with("{\"frames\": [],");
    assert!(refused(dir.path()).contains("transforms.json: not valid JSON: key `frames` appears twice"));
    for value in ["NaN", "-Infinity", "1e999", &"[".repeat(100_000)] {
        with(&format!("{{\"k1\": {value},"));
        assert!(refused(dir.path()).contains("transforms.json: not valid JSON"), "{value:.9}");
    }
    with("{\"k1\": 1e300,");
    assert!(refused(dir.path()).contains("images/3.png: no pixel remains"), "the lens shows nothing");
}

/// Numbers that no camera has are refused by key; a principal point outside of the image is warned of.
#[test]
fn numbers_of_cameras() {
    let dir = tempfile::tempdir().unwrap();
    let with = |key: &str, value: f64| {
        let mut set = plain();
        set[key] = json!(value);
        put(dir.path(), &set);
    };
    for (key, value) in
        [("fl_x", 1e300), ("fl_x", 1e-300), ("fl_y", 1e6), ("fl_y", 1e-3), ("cx", 1e9), ("cx", -400.0), ("cy", 1e300)]
    {
        with(key, value);
        assert!(refused(dir.path()).contains(&format!("frame 0 (images/0.png): key `{key}`: ")), "{key} {value}");
    }
    for (key, value, warned) in [("cx", -5.0, true), ("cy", 33.0, true), ("cx", 32.0, false), ("fl_x", 5000.0, false)] {
        with(key, value);
        let set = opened_and_imported(dir.path());
        assert_eq!(set.warnings().iter().any(|w| w.contains("principal point")), warned, "{:?}", set.warnings());
    }
    for (value, allowed) in [(1e300, false), (-2e9, false), (5e6, true)] {
        let mut set = plain();
        set["frames"][0]["transform_matrix"][0][3] = json!(value);
        put(dir.path(), &set);
        assert_eq!(Dataset::open(dir.path()).is_ok(), allowed, "{value}");
    }
}

/// A vertical field of view gives the focal length along y, with that of its own level along x.
#[test]
fn both_fields_of_view() {
    let dir = tempfile::tempdir().unwrap();
    let focal = |change: &dyn Fn(&mut Value)| {
        let mut set = plain();
        set.as_object_mut().unwrap().retain(|key, _| !["fl_x", "fl_y"].contains(&key.as_str()));
        change(&mut set);
        put(dir.path(), &set);
        let camera = opened_and_imported(dir.path()).frames()[0].camera;
        [camera.fl_x_px, camera.fl_y_px].map(|f| (f * 1e6).round() / 1e6)
    };
    let [x, y] = [1.0_f64, 0.8].map(|angle| (16.0 / (angle / 2.0).tan() * 1e6).round() / 1e6);
    assert_eq!(focal(&|set| set["camera_angle_x"] = json!(1.0)), [x, x]);
    let both = |set: &mut Value| {
        set["camera_angle_x"] = json!(1.0);
        set["camera_angle_y"] = json!(0.8);
    };
    assert_eq!(focal(&both), [x, y]);
    let own = |set: &mut Value| {
        both(set);
        set["frames"][0]["fl_x"] = json!(40.0);
    };
    assert_eq!(focal(&own), [40.0, 40.0]);
}

/// Intrinsics without a size that belong to images of another size are refused with both numbers; with the size, an
/// import scales them.
#[test]
fn images_of_another_size() {
    let dir = tempfile::tempdir().unwrap();
    let shrink = |side: u32| {
        for i in 0..4 {
            Image::filled(side, side, [60; 3]).save_png(&dir.path().join(format!("images/{i}.png"))).unwrap();
        }
    };
    let without = |keys: &[&str]| {
        let mut set = plain();
        set.as_object_mut().unwrap().retain(|key, _| !keys.contains(&key.as_str()));
        set
    };
    for side in [8, 16, 64] {
        put(dir.path(), &without(&["w", "h"]));
        assert_eq!(opened_and_imported(dir.path()).frames().len(), 4);
        shrink(side);
        let error = refused(dir.path());
        let wanted = format!("key `cx`: is 16, but the image has {side}x{side} pixels; add `w` and `h`");
        assert!(error.contains(&wanted), "{error}");
        let mut set = without(&["w", "h", "cx", "cy"]);
        set["camera_angle_x"] = json!(60.0_f64.to_radians());
        std::fs::write(dir.path().join("transforms.json"), set.to_string()).unwrap();
        assert!(refused(dir.path()).contains("key `fl_x`: is for images 32 pixels wide by `camera_angle_x`, but"));
    }
    put(dir.path(), &plain());
    shrink(16);
    assert!(Dataset::open(dir.path()).unwrap().load_image(0).is_err());
    let out = dir.path().join("out");
    import(dir.path(), &out, &ImportOptions::default()).unwrap();
    let camera = Dataset::open(&out).unwrap().frames()[0].camera;
    assert_eq!((camera.width_px, camera.cx_px, camera.fl_x_px), (16, 8.0, cameras()[0].fl_x_px / 2.0));
}

/// An EXIF orientation, which viewers obey and which the pixels are not turned by, is warned of.
#[test]
fn turned_images() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &set(|i| format!("images/{i}.jpg")));
    for orientation in [None, Some(1), Some(3), Some(6)] {
        for i in 0..4 {
            let mut bytes = jpeg(&image(i));
            if let Some(orientation) = orientation {
                // A TIFF header, and one directory with one entry: tag 0x0112, type SHORT, count 1.
                let exif = [
                    &b"\xFF\xE1\0\x22Exif\0\0MM\0\x2A\0\0\0\x08\0\x01\x01\x12\0\x03\0\0\0\x01\0"[..],
                    &[orientation, 0, 0, 0, 0, 0, 0],
                ];
                bytes.splice(2..2, exif.concat());
            }
            std::fs::write(dir.path().join(format!("images/{i}.jpg")), bytes).unwrap();
        }
        let opened = Dataset::open(dir.path()).unwrap();
        let images = opened.load_all_images().unwrap();
        let checked = DatasetReport::of(&opened, &images).warnings;
        let imported = import(dir.path(), &dir.path().join("out"), &ImportOptions::default()).unwrap().warnings;
        for warnings in [checked, imported] {
            let warned = warnings.iter().any(|w| w.contains("4 of 4 images have an EXIF orientation"));
            assert_eq!(warned, orientation.is_some_and(|o| o != 1), "{orientation:?}: {warnings:?}");
        }
        assert!(images[2].psnr_db(&image(2)).unwrap() > 30.0, "the pixels are as stored");
    }
}

/// A JPEG file whose data ends too early is an error, although it has an end marker: with one scan, with restart markers,
/// and with the scans of a progressive file. A whole file, also with more after its end, has its image.
#[test]
fn cut_off_images_with_an_end() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("a.jpg");
    let shipped =
        |name: &str| std::fs::read(Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/data").join(name)).unwrap();
    let files =
        [jpeg(&image(0)), jpeg(&image(3)), shipped("restarts.jpg"), shipped("progressive.jpg"), shipped("grey.jpg")];
    for (file, bytes) in files.iter().enumerate() {
        std::fs::write(&path, [&bytes[..], b"\xFF\xD8 more"].concat()).unwrap();
        let whole = Image::load(&path).unwrap();
        std::fs::write(&path, bytes).unwrap();
        assert_eq!(Image::load(&path).unwrap(), whole);
        assert_eq!(Image::decode(bytes, &path).unwrap(), whole, "file {file}");
        for length in 2..bytes.len() - 2 {
            std::fs::write(&path, [&bytes[..length], b"\xFF\xD9"].concat()).unwrap();
            match Image::load(&path) {
                // The last byte may have no bit of the image that shows.
                Ok(image) => assert_eq!(image, whole, "file {file}, {length} of {} bytes", bytes.len()),
                Err(error) => assert!(error.to_string().contains("a.jpg: not a readable"), "{error}"),
            }
        }
        std::fs::write(&path, [&bytes[..bytes.len() - 20], b"\xFF\xD9"].concat()).unwrap();
        let error = Image::load(&path).unwrap_err().to_string();
        assert!(error.contains("image data is missing before its end marker"), "{error}");
    }
}

/// A cut-off file is an error that names it, or has all of its pixels.
#[test]
fn cut_off_images() {
    let dir = tempfile::tempdir().unwrap();
    let path = dir.path().join("images/0.png");
    put(dir.path(), &plain());
    // A preview before the image has an end marker of its own.
    let mut with_preview = jpeg(&image(0));
    let preview = [0xFF, 0xE1, 0, 8, 0xFF, 0xD8, 0xFF, 0xD9, 0, 0];
    with_preview.splice(2..2, preview);
    for bytes in [jpeg(&image(0)), with_preview, std::fs::read(&path).unwrap()] {
        std::fs::write(&path, &bytes).unwrap();
        let whole = Image::load(&path).unwrap();
        for length in 1..bytes.len() {
            std::fs::write(&path, &bytes[..length]).unwrap();
            match Image::load(&path) {
                Ok(image) => assert_eq!(image, whole, "cut off after {length} of {} bytes", bytes.len()),
                Err(error) => assert!(error.to_string().contains("images/0.png: not a readable"), "{error}"),
            }
        }
        std::fs::write(&path, &bytes[..bytes.len() * 2 / 5]).unwrap();
        assert!(refused(dir.path()).contains("images/0.png"));
        std::fs::write(&path, [&bytes[..], b"more after the end"].concat()).unwrap();
        assert_eq!(Image::load(&path).unwrap(), whole);
    }
    std::fs::write(&path, b"").unwrap();
    assert!(refused(dir.path()).contains("images/0.png: not a readable PNG or JPEG image: the file is empty"));
}
