//! Tests of lenses and masks: points are at the right pixels, and pixels without content are not used.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::path::Path;

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Dataset, DatasetReport, Equivalence, Image, ImportOptions, Imported, import};
use serde_json::{Value, json};

const W: u32 = 240;
const H: u32 = 180;

fn camera() -> PinholeCamera {
    let camera = PinholeCamera::look_at([4.0, 0.0, 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], W, H, 60.0);
    PinholeCamera { fl_x_px: 90.0, fl_y_px: 90.0, ..camera }
}

/// Returns a grey image with a white dot at (u, v).
fn dot([u, v]: [f64; 2]) -> Image {
    let rgb = (0..W * H).flat_map(|i| {
        let distance = (f64::from(i % W) + 0.5 - u).hypot(f64::from(i / W) + 0.5 - v);
        [20 + (220.0 * (-distance * distance / 8.0).exp()) as u8; 3]
    });
    Image { width_px: W, height_px: H, rgb: rgb.collect() }
}

/// Returns the centre of the light of an image's dot.
fn centre(image: &Image) -> [f64; 2] {
    let (mut sum, mut at) = (0.0, [0.0; 2]);
    for (i, p) in image.rgb.chunks_exact(3).enumerate().filter(|(_, p)| p[0] > 40) {
        let (weight, i) = (f64::from(p[0] - 20), i as u32);
        sum += weight;
        at = [
            at[0] + weight * (f64::from(i % image.width_px) + 0.5),
            at[1] + weight * (f64::from(i / image.width_px) + 0.5),
        ];
    }
    at.map(|v| v / sum)
}

/// Writes a dataset of one image with these additional keys of the file and of the frame.
fn put(dir: &Path, image: &Image, keys: &Value, of_frame: &Value) {
    image.save_png(&dir.join("a.png")).unwrap();
    let mut frame = json!({"file_path": "a.png", "transform_matrix": camera().world_from_camera});
    frame.as_object_mut().unwrap().extend(of_frame.as_object().unwrap().clone());
    let mut set = json!({"w": W, "h": H, "fl_x": 90.0, "fl_y": 90.0, "cx": 120.0, "cy": 90.0, "frames": [frame]});
    set.as_object_mut().unwrap().extend(keys.as_object().unwrap().clone());
    std::fs::write(dir.join("transforms.json"), set.to_string()).unwrap();
}

fn imported(dir: &Path, max_side_px: u32) -> (Imported, Dataset) {
    let out = dir.join("out");
    let options = ImportOptions { max_side_px, ..ImportOptions::default() };
    let imported = import(dir, &out, &options).unwrap();
    (imported, Dataset::open(&out).unwrap())
}

fn refused(dir: &Path) -> String {
    let opened = Dataset::open(dir).unwrap_err().to_string();
    assert_eq!(opened, import(dir, &dir.join("out"), &ImportOptions::default()).unwrap_err().to_string());
    opened
}

/// A point that a fisheye lens shows is at its pinhole position, within half a pixel: with coefficients and without, for
/// the file and for a frame, with the keys of nerfstudio and of instant-ngp, at full size and scaled down.
#[test]
fn fisheye_images() {
    let dir = tempfile::tempdir().unwrap();
    let model = json!("OPENCV_FISHEYE");
    let some = json!({"k1": 0.03, "k2": 0.005, "k3": 0.0007, "k4": 0.0001});
    let list = json!({"distortion_params": [0.03, 0.005, 0.0007, 0.0001, 0.0, 0.0]});
    let zero = json!({"k1": 0, "k2": 0, "k3": 0, "k4": 0});
    for (coefficients, values) in [
        (some, [0.03, 0.005, 0.0007, 0.0001]),
        (list, [0.03, 0.005, 0.0007, 0.0001]),
        (zero, [0.0; 4]),
        (json!({}), [0.0; 4]),
    ] {
        for flag in [
            json!({"camera_model": model}),
            json!({"is_fisheye": true}),
            json!({"camera_model": "OPENCV", "is_fisheye": true}),
        ] {
            for point in [[150.0, 100.0], [30.0, 40.0], [200.0, 160.0]] {
                let [x, y] = [(point[0] - 120.0) / 90.0, (point[1] - 90.0) / 90.0];
                let theta = f64::hypot(x, y).atan();
                let polynomial = 1.0 + (0..4).map(|i| values[i] * theta.powi(2 * i as i32 + 2)).sum::<f64>();
                let scale = theta * polynomial / f64::hypot(x, y);
                let seen = [120.0 + 90.0 * x * scale, 90.0 + 90.0 * y * scale];
                let mut keys = coefficients.clone();
                keys.as_object_mut().unwrap().extend(flag.as_object().unwrap().clone());
                for (of_file, of_frame) in [(&keys, &json!({})), (&json!({"k1": 0.9}), &keys)] {
                    if of_file.get("k1") == Some(&json!(0.9)) && keys.get("k1").is_none() {
                        continue;
                    }
                    put(dir.path(), &dot(seen), of_file, of_frame);
                    let set = Dataset::open(dir.path()).unwrap();
                    let [a, b] = centre(&set.load_image(0).unwrap());
                    assert!((a - point[0]).abs() < 0.5 && (b - point[1]).abs() < 0.5, "{a} {b} for {point:?}, {keys}");
                    assert!(set.warnings()[0].contains("key `camera_model`"), "{:?}", set.warnings());
                }
                let (counts, set) = imported(dir.path(), 120);
                let [a, b] = centre(&set.load_image(0).unwrap()).map(|v| v * 2.0);
                assert!((a - point[0]).abs() < 0.5 && (b - point[1]).abs() < 0.5, "{a} {b} for {point:?}, {keys}");
                assert_eq!((counts.undistorted, counts.scaled), (1, 1));
            }
        }
    }
}

/// Lenses that are not supported are refused by key, value and frame, also if only a frame has them.
#[test]
fn other_lenses_are_refused() {
    let dir = tempfile::tempdir().unwrap();
    for (key, value, shown) in [
        ("camera_model", json!("EQUIRECTANGULAR"), "is `EQUIRECTANGULAR`"),
        ("camera_model", json!("FISHEYE624"), "is `FISHEYE624`"),
        ("camera_model", json!("OMNIDIRECTIONALSTEREO_L"), "is `OMNIDIRECTIONALSTEREO_L`"),
        ("camera_model", json!(3), "must be a text"),
        ("ftheta_p0", json!(0.1), "is 0.1"),
        ("equirectangular", json!(true), "is true"),
        ("k6", json!(0.02), "is 0.02"),
        ("distortion_params", json!([0.1, 0.2]), "must be 6 finite numbers"),
        ("k1", json!("much"), "must be a finite number"),
        ("is_fisheye", json!("false"), "must be true or false, found a text"),
        ("fisheye_crop_radius", json!(900), "is 900, and is not supported; write the circle as a mask"),
    ] {
        for in_frame in [false, true] {
            let with = json!({key: value});
            let (of_file, of_frame) = if in_frame { (json!({}), with) } else { (with, json!({})) };
            put(dir.path(), &dot([9.0, 9.0]), &of_file, &of_frame);
            let error = refused(dir.path());
            assert!(error.contains(&format!("frame 0 (a.png): key `{key}`: {shown}")), "{error}");
        }
    }
    put(dir.path(), &dot([9.0, 9.0]), &json!({"camera_model": "OPENCV_FISHEYE", "p1": 0.01}), &json!({}));
    assert!(refused(dir.path()).contains("key `p1`: is 0.01; a fisheye lens has only k1 to k4"));
    put(
        dir.path(),
        &dot([9.0, 9.0]),
        &json!({"equirectangular": false, "k6": 0, "camera_model": "pinhole"}),
        &json!({}),
    );
    assert!(Dataset::open(dir.path()).unwrap().warnings().is_empty());
}

/// Pixels beyond a pincushion image are not white but invalid, in the dataset itself and in the imported one.
#[test]
fn pincushion_corners_are_not_used() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &Image::filled(W, H, [200, 30, 30]), &json!({"k1": 0.1}), &json!({}));
    let direct = Dataset::open(dir.path()).unwrap();
    let (counts, set) = imported(dir.path(), 240);
    assert_eq!((counts.undistorted, counts.masked), (1, 1));
    let valid = set.valid_pixels(0).unwrap();
    assert_eq!(direct.valid_pixels(0), Some(valid));
    for (i, valid) in (0..W * H).zip(valid) {
        let [x, y] = [(f64::from(i % W) + 0.5 - 120.0) / 90.0, (f64::from(i / W) + 0.5 - 90.0) / 90.0];
        let scale = 1.0 + 0.1 * (x * x + y * y);
        let inside = (x * scale * 90.0).abs() < 120.0 && (y * scale * 90.0).abs() < 90.0;
        assert_eq!(*valid, inside, "pixel {} {}", i % W, i / W);
    }
    let image = set.load_image(0).unwrap();
    assert!(image.rgb.chunks_exact(3).all(|p| p == [200, 30, 30]), "the edge's colour, not the background's");
    let (_, small) = imported(dir.path(), 60);
    let valid = small.valid_pixels(0).unwrap();
    assert!(!valid[0] && valid[22 * 60 + 30] && valid.len() == 60 * 45);
    let report = DatasetReport::of(&set, &[image]).to_string();
    assert!(report.contains("Masks       1 images; training ignores"), "{report}");
}

/// Masked pixels (zero) are excluded, through import and scaling. A mask of another size, of no pixel, or without a file
/// is named.
#[test]
fn masks_are_used() {
    let dir = tempfile::tempdir().unwrap();
    let mask = |paint: &dyn Fn(u32, u32) -> u8| image::GrayImage::from_fn(W, H, |x, y| image::Luma([paint(x, y)]));
    put(dir.path(), &dot([100.0, 100.0]), &json!({}), &json!({"mask_path": "masks/a.png"}));
    assert!(refused(dir.path()).contains("frame 0 (a.png): key `mask_path`: there is no file"));
    std::fs::create_dir(dir.path().join("masks")).unwrap();
    let path = dir.path().join("masks/a.png");
    mask(&|x, y| u8::from(x >= 100 || y < 40)).save(&path).unwrap();
    let direct = Dataset::open(dir.path()).unwrap();
    let (counts, set) = imported(dir.path(), 240);
    assert_eq!((counts.masked, counts.undistorted), (1, 0));
    for set in [&direct, &set] {
        assert!((0..W * H).zip(set.valid_pixels(0).unwrap()).all(|(i, &v)| v != (i % W < 100 && i / W >= 40)));
        assert_eq!(set.load_image(0).unwrap(), dot([100.0, 100.0]), "the image remains whole");
    }
    let (_, small) = imported(dir.path(), 120);
    assert!((0..120 * 90).zip(small.valid_pixels(0).unwrap()).all(|(i, &v)| !(v && i % 120 < 50 && i / 120 >= 20)));

    mask(&|_, _| 255).save(&path).unwrap();
    assert_eq!(Dataset::open(dir.path()).unwrap().valid_pixels(0), None);
    assert_eq!(imported(dir.path(), 240).0.masked, 0);
    mask(&|_, _| 0).save(&path).unwrap();
    assert!(Dataset::open(dir.path()).unwrap_err().to_string().contains("a.png: no pixel remains"));
    image::GrayImage::new(9, 9).save(&path).unwrap();
    assert!(refused(dir.path()).contains("masks/a.png: the mask has 9x9 pixels, and its image 240x180"));
}

/// Masks that no key names are not passed over in silence.
#[test]
fn unnamed_masks_are_warned_of() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &dot([100.0, 100.0]), &json!({}), &json!({}));
    image::GrayImage::new(W, H).save(dir.path().join("dynamic_mask_a.png")).unwrap();
    let warnings = Dataset::open(dir.path()).unwrap().warnings().to_vec();
    assert!(warnings[0].contains("1 of 1 images have a `dynamic_mask_` file") && warnings[0].contains("`mask_path`"));
    image::GrayImage::from_pixel(W, H, image::Luma([9])).save(dir.path().join("mask.png")).unwrap();
    put(dir.path(), &dot([100.0, 100.0]), &json!({}), &json!({"mask_path": "mask.png"}));
    assert!(Dataset::open(dir.path()).unwrap().warnings().is_empty());
}

/// States that differ only in masked pixels look the same.
#[test]
fn masked_differences_do_not_count() {
    let dir = tempfile::tempdir().unwrap();
    let mut plain = image::RgbImage::from_pixel(16, 16, image::Rgb([90; 3]));
    plain.save(dir.path().join("0.png")).unwrap();
    (0..16).for_each(|y| plain.put_pixel(3, y, image::Rgb([0; 3])));
    plain.save(dir.path().join("1.png")).unwrap();
    let mask = image::GrayImage::from_fn(16, 16, |x, _| image::Luma([u8::from(x != 3)]));
    mask.save(dir.path().join("mask.png")).unwrap();
    let frames: Vec<Value> = (0..2)
        .map(
            |i| json!({"file_path": format!("{i}.png"), "transform_matrix": camera().world_from_camera, "scene_id": i}),
        )
        .collect();
    let mut set = json!({"w": 16, "h": 16, "fl_x": 16.0, "frames": frames,
        "scenario": {"bounds": [[-1, -1, 0], [1, 1, 2]], "branches": ["a", "b"], "timestamps": 1}});
    for masked in [false, true] {
        if masked {
            set["frames"][1]["mask_path"] = json!("mask.png");
        }
        std::fs::write(dir.path().join("transforms.json"), set.to_string()).unwrap();
        let set = Dataset::open(dir.path()).unwrap();
        let images = set.load_all_images().unwrap();
        assert_eq!(Equivalence::from_dataset(&set, &images).same(0, 0, 1), masked);
        let wanted = if masked { "none" } else { "full" };
        assert!(set.frames().iter().all(|f| f.observability.unwrap().name() == wanted));
        let report = DatasetReport::of(&set, &images);
        assert_eq!(report.hidden_pairs.first().map(|pair| pair.max_difference), masked.then_some(0));
        assert_eq!(report.pose_mean_psnr_db.is_none(), masked);
    }
}

/// A large camera of a small image costs nothing.
#[test]
fn the_size_of_an_image_is_its_own() {
    let dir = tempfile::tempdir().unwrap();
    put(dir.path(), &Image::filled(2, 2, [9; 3]), &json!({"w": 8192, "h": 8192, "k1": 0.1}), &json!({}));
    let set = Dataset::open(dir.path()).unwrap();
    assert_eq!(set.valid_pixels(0), None);
    assert!(set.load_image(0).unwrap_err().to_string().contains("is 2x2 pixels, but its intrinsics"));
}
