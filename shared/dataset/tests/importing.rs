//! Tests of imports: both common formats become datasets of one state that can be read like others.

#![allow(clippy::unwrap_used)] // The helpers below are parts of tests.

use std::path::Path;

use carff_base::geometry::PinholeCamera;
use carff_dataset::{Dataset, Image, ImportOptions, import};
use serde_json::{Value, json};

/// Returns cameras around the point (0, 0, 1), at a distance of 4.
fn cameras(count: usize) -> Vec<PinholeCamera> {
    (0..count)
        .map(|i| {
            let a = i as f64 * std::f64::consts::TAU / count as f64;
            PinholeCamera::look_at([4.0 * a.cos(), 4.0 * a.sin(), 1.0], [0.0, 0.0, 1.0], [0.0, 0.0, 1.0], 40, 30, 60.0)
        })
        .collect()
}

fn put(dir: &Path, name: &str, set: &Value) {
    std::fs::write(dir.join(name), set.to_string()).unwrap();
}

/// The format of instant-ngp and of the `NeRF` authors' synthetic scenes is imported: an angle as focal length, names
/// without extension, a file per split, transparent images.
#[test]
fn instant_ngp_layout() {
    let (from, to) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let cameras = cameras(5);
    for (split, range) in [("train", 0..3), ("test", 3..5)] {
        std::fs::create_dir(from.path().join(split)).unwrap();
        let frames: Vec<Value> = range
            .map(|i| {
                // The left half is transparent, the right half is green.
                let mut image = image::RgbaImage::from_pixel(40, 30, image::Rgba([0, 200, 0, 255]));
                for (x, _, pixel) in image.enumerate_pixels_mut() {
                    pixel.0[3] = if x < 20 { 0 } else { 255 };
                }
                image.save(from.path().join(format!("{split}/r_{i}.png"))).unwrap();
                json!({"file_path": format!("./{split}/r_{i}"), "rotation": 0.01,
                    "transform_matrix": cameras[i].world_from_camera})
            })
            .collect();
        let angle = 2.0 * (20.0 / cameras[0].fl_x_px).atan();
        put(from.path(), &format!("transforms_{split}.json"), &json!({"camera_angle_x": angle, "frames": frames}));
    }
    let out = to.path().join("set");
    let options = ImportOptions { background: [0, 0, 255], ..ImportOptions::default() };
    let imported = import(from.path(), &out, &options).unwrap();
    assert_eq!((imported.frames, imported.undistorted, imported.scaled), (5, 0, 0));
    for i in 0..3 {
        let (low, high) = ([-2.0, -2.0, -1.0][i], [2.0, 2.0, 3.0][i]);
        assert!((imported.bounds[0][i] - low).abs() < 1e-6 && (imported.bounds[1][i] - high).abs() < 1e-6);
    }

    let set = Dataset::open(&out).unwrap();
    let scenario = set.scenario().unwrap();
    assert_eq!((scenario.state_count(), set.view_count(), set.frames().len()), (1, 5, 5));
    assert_eq!(scenario.bounds, imported.bounds);
    for (i, frame) in set.frames().iter().enumerate() {
        assert_eq!((frame.state, frame.view), (Some(0), Some(i)));
        let (a, b) = (frame.camera, cameras[i]);
        assert!((a.fl_x_px - b.fl_x_px).abs() < 1e-6);
        assert_eq!(a.world_from_camera, b.world_from_camera);
        let image = set.load_image(i).unwrap();
        assert_eq!((image.pixel(5, 9).unwrap(), image.pixel(35, 9).unwrap()), ([0, 0, 255], [0, 200, 0]));
    }
    // A second import into the same folder works; a dataset that names its scenario is not imported.
    import(from.path(), &out, &options).unwrap();
    let error = import(&out, &to.path().join("again"), &options).unwrap_err().to_string();
    assert!(error.contains("need not be imported"), "{error}");
}

/// The format of nerfstudio is imported: intrinsics with lens distortion, and JPEG images that are larger than the
/// limit, or smaller than their intrinsics because they were scaled down.
#[test]
fn nerfstudio_layout() {
    let (from, to) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    std::fs::create_dir(from.path().join("images")).unwrap();
    let cameras = cameras(4);
    let frames: Vec<Value> = cameras
        .iter()
        .enumerate()
        .map(|(i, camera)| {
            let name = format!("images/frame_{i:05}.jpg");
            let side = if i == 3 { (100, 75) } else { (200, 150) };
            image::RgbImage::from_pixel(side.0, side.1, image::Rgb([200, 40, 40]))
                .save(from.path().join(&name))
                .unwrap();
            json!({"file_path": name, "transform_matrix": camera.world_from_camera, "colmap_im_id": i})
        })
        .collect();
    put(
        from.path(),
        "transforms.json",
        &json!({"w": 200, "h": 150, "fl_x": 173.2, "fl_y": 173.0, "cx": 101.0, "cy": 74.0, "k1": -0.1, "k2": 0.01,
            "p1": 0.0, "p2": 0.0, "camera_model": "OPENCV", "frames": frames, "applied_transform": [[1, 0, 0, 0]]}),
    );
    let direct = Dataset::open(from.path()).unwrap();
    assert!(direct.warnings()[0].contains("lens distortion (key `k1`) is undone"), "{:?}", direct.warnings());
    assert!(direct.load_image(0).is_ok() && direct.load_image(3).is_err(), "only an import scales the intrinsics");
    let bounds = [[-1.0, -1.0, 0.0], [1.0, 1.0, 2.0]];
    let options = ImportOptions { max_side_px: 80, bounds: Some(bounds), ..ImportOptions::default() };
    let out = to.path().join("set");
    let imported = import(from.path(), &out, &options).unwrap();
    assert_eq!((imported.frames, imported.undistorted, imported.scaled, imported.bounds), (4, 4, 4, bounds));
    let set = Dataset::open(&out).unwrap();
    assert!(set.warnings().is_empty(), "{:?}", set.warnings());
    for (i, frame) in set.frames().iter().enumerate() {
        let camera = frame.camera;
        assert_eq!((camera.width_px, camera.height_px), (80, 60));
        assert!((camera.fl_x_px - 173.2 * 0.4).abs() < 1e-6 && (camera.cx_px - 101.0 * 0.4).abs() < 1e-6, "{camera:?}");
        let [r, g, _] = set.load_image(i).unwrap().pixel(40, 30).unwrap();
        assert!(r > 180 && g < 60);
    }
}

/// An image with another aspect ratio than its intrinsics is an error that names it; so is a missing image.
#[test]
fn wrong_images_are_named() {
    let (from, to) = (tempfile::tempdir().unwrap(), tempfile::tempdir().unwrap());
    let set = |name: &str| {
        json!({"w": 40, "h": 30, "fl_x": 30.0, "frames": [
            {"file_path": name, "transform_matrix": cameras(1)[0].world_from_camera}]})
    };
    let attempt = |name: &str| {
        put(from.path(), "transforms.json", &set(name));
        import(from.path(), &to.path().join("set"), &ImportOptions::default()).unwrap_err().to_string()
    };
    Image::filled(30, 30, [1; 3]).save_png(&from.path().join("square.png")).unwrap();
    let error = attempt("square.png");
    assert!(error.contains("square.png") && error.contains("30x30") && error.contains("40x30"), "{error}");
    let error = attempt("missing.jpg");
    assert!(error.contains("missing.jpg") && error.contains("there is no file"), "{error}");
    std::fs::write(from.path().join("broken.jpg"), "no image").unwrap();
    let error = attempt("broken.jpg");
    assert!(error.contains("broken.jpg") && error.contains("not a readable PNG or JPEG image"), "{error}");
}
