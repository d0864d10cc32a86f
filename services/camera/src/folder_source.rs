//! Shows the images of a folder, in the order of their names.

use crate::source::Source;
use anyhow::{Context, anyhow, ensure};
use carff_base::geometry::PinholeCamera;
use carff_base::random::Key;
use carff_config::GraphConfig;
use carff_dataset::sensor::{SensorNoise, apply_noise_into};
use carff_dataset::{Image, RawImage, Rectifier, image_files};
use carff_messages::{DatasetView, FrameMeta};
use std::path::Path;

/// The images of a folder, in memory.
#[derive(Debug)]
pub struct FolderSource {
    /// Index of each image in its folder, and the image.
    images: Vec<(i32, Image)>,
    noise: SensorNoise,
    seed: u64,
    repeat: bool,
    frames_per_image: usize,
    shown: usize,
    current: usize,
    /// The camera of rectified images.
    camera: Option<PinholeCamera>,
}

impl FolderSource {
    /// Loads all PNG images of a folder. An image that cannot be read, or has another size than the first, is omitted
    /// with an error that names it. A folder without a usable image is an error.
    pub fn open(folder: &Path, graph: &GraphConfig) -> anyhow::Result<(Self, Vec<anyhow::Error>)> {
        let paths = image_files(folder).with_context(|| format!("cannot read folder {}", folder.display()))?;
        let mut images: Vec<(i32, Image)> = Vec::new();
        let mut errors = Vec::new();
        for (index, path) in (0..).zip(&paths) {
            match Image::load(path) {
                Ok(image) => match images.first() {
                    Some((_, first)) if (first.width_px, first.height_px) != (image.width_px, image.height_px) => {
                        errors.push(anyhow!(
                            "{}: {}x{} pixels, but the first image has {}x{}: omitted; scale it",
                            path.display(),
                            image.width_px,
                            image.height_px,
                            first.width_px,
                            first.height_px
                        ));
                    }
                    _ => images.push((index, image)),
                },
                Err(error) => errors.push(anyhow::Error::new(error).context("left out")),
            }
        }
        ensure!(
            !images.is_empty(),
            "{} contains no readable PNG image ({} tried{})",
            folder.display(),
            paths.len(),
            errors.first().map(|e| format!("; the first: {e:#}")).unwrap_or_default()
        );
        let source = Self {
            images,
            noise: graph.camera.noise,
            seed: graph.run.seed,
            repeat: graph.camera.repeat,
            frames_per_image: graph.camera.frames_per_timestamp as usize,
            shown: 0,
            current: 0,
            camera: None,
        };
        Ok((source, errors))
    }

    /// Rectifies all images.
    pub fn rectified(mut self, rectifier: &Rectifier) -> anyhow::Result<Self> {
        let camera = *rectifier.camera();
        for (_, image) in &mut self.images {
            let mut rectified = Image::filled(camera.width_px, camera.height_px, [0; 3]);
            rectifier.write(&RawImage::rgb([image.width_px, image.height_px], &image.rgb)?, &mut rectified.rgb)?;
            *image = rectified;
        }
        self.camera = Some(camera);
        Ok(self)
    }
}

impl Source for FolderSource {
    fn max_image_bytes(&self) -> usize {
        self.images[0].1.rgb.len()
    }

    fn advance(&mut self) -> anyhow::Result<Option<FrameMeta>> {
        let total = self.images.len() * self.frames_per_image;
        if self.shown >= total && !self.repeat {
            return Ok(None);
        }
        self.current = self.shown % total / self.frames_per_image;
        self.shown += 1;
        let (view, image) = &self.images[self.current];
        let [eye, ahead, up] = [[0.0; 3], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let fov_deg = PinholeCamera::ASSUMED_FOV_DEG;
        let assumed = PinholeCamera::look_at(eye, ahead, up, image.width_px, image.height_px, fov_deg);
        let camera = self.camera.unwrap_or(assumed);
        // Images of a folder need not follow each other: each is a take of its own.
        let take_start = (self.shown - 1) as u64;
        let dataset_view = DatasetView { view: *view, ..DatasetView::UNKNOWN };
        Ok(Some(FrameMeta { take_start, ..FrameMeta::of_camera(&camera, dataset_view) }))
    }

    fn write(&mut self, frame_id: u64, image: &mut [u8]) -> anyhow::Result<()> {
        let key = Key { seed: self.seed, frame: frame_id, step: 0, sample: 0 };
        Ok(apply_noise_into(&self.images[self.current].1.rgb, image, &self.noise, key)?)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn graph() -> GraphConfig {
        let text = "[run]\nname = \"t\"\ndataset = \"d\"\ncheckpoint = \"c\"\n[camera]\nframes_per_timestamp = 2";
        GraphConfig::parse(text, "test.toml".as_ref()).unwrap()
    }

    /// Broken and wrong-sized images are omitted, each with an error that names the file; the others are shown in
    /// order, each as often as configured.
    #[test]
    fn bad_images_are_named_and_left_out() {
        let folder = tempfile::tempdir().unwrap();
        let path = |name: &str| folder.path().join(name);
        Image::filled(4, 2, [10, 10, 10]).save_png(&path("a.png")).unwrap();
        std::fs::write(path("b.png"), b"not an image").unwrap();
        Image::filled(3, 2, [0, 0, 0]).save_png(&path("c.png")).unwrap();
        Image::filled(4, 2, [90, 90, 90]).save_png(&path("d.png")).unwrap();
        std::fs::write(path("notes.txt"), b"no image").unwrap();

        let mut graph = graph();
        let off = SensorNoise::OFF;
        graph.camera.noise.sigma = off.sigma;
        graph.camera.noise.gain_sigma = off.gain_sigma;
        graph.camera.noise.channel_gain_sigma = off.channel_gain_sigma;
        graph.camera.noise.channel_offset_sigma = off.channel_offset_sigma;
        let (mut source, errors) = FolderSource::open(folder.path(), &graph).unwrap();
        let errors: Vec<String> = errors.iter().map(|e| format!("{e:#}")).collect();
        assert_eq!(errors.len(), 2, "{errors:?}");
        assert!(errors[0].contains("b.png") && errors[1].contains("c.png"), "{errors:?}");

        let (mut greys, mut views) = (Vec::new(), Vec::new());
        let mut image = vec![0; source.max_image_bytes()];
        while let Some(meta) = source.advance().unwrap() {
            assert_eq!((meta.width_px, meta.height_px), (4, 2));
            views.push(meta.dataset_view.view);
            source.write(greys.len() as u64, &mut image).unwrap();
            greys.push(image[0]);
        }
        assert_eq!(greys, [10, 10, 90, 90]);
        assert_eq!(views, [0, 0, 3, 3], "the index of the file, also of files that are left out");
    }

    /// A folder without a usable image, and a missing folder, are errors that name it.
    #[test]
    fn nothing_to_show_is_an_error() {
        let folder = tempfile::tempdir().unwrap();
        let error = FolderSource::open(folder.path(), &graph()).unwrap_err();
        assert!(error.to_string().contains("no readable PNG image"), "{error:#}");
        let missing = folder.path().join("missing");
        assert!(FolderSource::open(&missing, &graph()).unwrap_err().to_string().contains("missing"));
    }
}
