//! Axes that are measured on a running graph: samples, horizon, size of the camera image, attached probes. All stages
//! run at ten frames per second.

use super::{Axis, AxisName, Law, Row};
use crate::graph::{Measured, Plan, Subject, measure};
use crate::probes::most_probes;
use crate::report::number;
use crate::stats::Times;
use anyhow::{Context, ensure};
use carff_config::CameraSource;
use carff_dataset::{Image, sensor::SensorNoise};
use carff_messages::{MAX_HORIZON, MAX_SAMPLES, Stage};
use std::fmt::Display;
use std::path::{Path, PathBuf};
use std::time::Duration;

const RATE_HZ: f64 = 10.0;
/// No deadline drops a frame, because its time is the measurement.
const DEADLINE_MS: u64 = 60_000;
const SAMPLES: [u32; 8] = [1, 2, 5, 10, 20, 35, 50, MAX_SAMPLES as u32];
const SAMPLES_QUICK: [u32; 3] = [1, 10, MAX_SAMPLES as u32];
const HORIZONS: [u32; 5] = [1, 2, 3, 5, MAX_HORIZON];
const HORIZONS_QUICK: [u32; 2] = [2, MAX_HORIZON];
const IMAGES_PX: [u32; 5] = [64, 128, 256, 512, 1024];
const IMAGES_PX_QUICK: [u32; 2] = [128, 512];
/// Number of images at each size.
const IMAGES: usize = 12;

/// One setting of the graph.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Setting {
    samples: u32,
    horizon: u32,
    /// Side of images from a folder; `None` for the dataset's drives.
    image_px: Option<u32>,
    probes: u32,
}

/// Setting that the axes share.
const MAIN: Setting = Setting { samples: 10, horizon: 2, image_px: None, probes: 0 };

impl Display for Setting {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        write!(f, "n {}, horizon {}", self.samples, self.horizon)?;
        if let Some(side_px) = self.image_px {
            write!(f, ", images of {side_px} x {side_px}")?;
        }
        if self.probes > 0 {
            write!(f, ", {} probes", self.probes)?;
        }
        Ok(())
    }
}

/// Measurements of one setting in all rounds.
#[derive(Clone, Debug, Default)]
struct Sum {
    latency_ms: Vec<f64>,
    missed: usize,
    /// Cores of the decision path, and of the renderer, which uses the remaining time at any setting.
    cores: Vec<f64>,
    renderer_cores: Vec<f64>,
    probe_cores: Vec<f64>,
    probed: u64,
}

impl Sum {
    fn add(&mut self, measured: Measured) {
        self.latency_ms.extend(measured.latency_ms);
        self.missed += measured.missed;
        let cores = |renderer: bool| {
            let uses = measured.uses.iter().filter(|used| (used.stage == Stage::Renderer) == renderer);
            uses.map(|used| used.cores).sum()
        };
        self.cores.push(cores(false));
        self.renderer_cores.push(cores(true));
        self.probe_cores.push(measured.probe_cores);
        self.probed += measured.probed;
    }

    fn row(&self, x: u32, probes: bool) -> Row {
        let mean = |values: &[f64]| values.iter().sum::<f64>() / values.len() as f64;
        let mut row = Row::new(x, &Times::new(self.latency_ms.clone()), mean(&self.cores));
        row.missed = Some(self.missed);
        row.more = vec![("renderer_cores", mean(&self.renderer_cores))];
        if probes {
            row.more.extend([("probe_cores", mean(&self.probe_cores)), ("probe_messages", self.probed as f64)]);
        }
        row
    }
}

/// Graph to measure, and the time for it.
pub(crate) struct GraphBench {
    pub(crate) subject: Subject,
    pub(crate) quick: bool,
    /// Time for each setting in all rounds, seconds.
    pub(crate) seconds: f64,
}

impl GraphBench {
    /// Measures the settings of all axes alternately. A setting of several axes is measured once.
    pub(crate) fn measure(&self, axes: &[AxisName]) -> anyhow::Result<Vec<Axis>> {
        let axes: Vec<(Axis, Vec<(u32, Setting)>)> = axes.iter().filter_map(|axis| self.axis(*axis)).collect();
        let settings = distinct(axes.iter().flat_map(|(_, points)| points.iter().map(|(_, setting)| *setting)));
        if settings.is_empty() {
            return Ok(Vec::new());
        }
        self.subject.check_dataset()?;
        let folder = tempfile::tempdir()?;
        for side_px in settings.iter().filter_map(|s| s.image_px) {
            write_images(&self.subject.dataset.join("images"), &folder.path().join(side_px.to_string()), side_px)?;
        }
        let rounds = if self.quick { 1 } else { 2 };
        let mut sums = vec![Sum::default(); settings.len()];
        for round in 0..rounds {
            for i in 0..settings.len() {
                let i = if round % 2 == 0 { i } else { settings.len() - 1 - i };
                let measured = self.run(settings[i], folder.path(), self.seconds / f64::from(rounds))?;
                let p50 = Times::new(measured.latency_ms.clone()).median();
                println!("{}: {} frames, p50 {} ms", settings[i], measured.frames, number(p50));
                sums[i].add(measured);
            }
        }
        println!();
        let rows_of = |points: Vec<(u32, Setting)>, probes: bool| {
            let found = |(x, setting)| Some(sums[settings.iter().position(|s| *s == setting)?].row(x, probes));
            points.into_iter().filter_map(found).collect()
        };
        Ok(axes
            .into_iter()
            .map(|(axis, points)| {
                let rows = rows_of(points, axis.key == "probes");
                Axis { rows, ..axis }
            })
            .collect())
    }

    /// Returns an axis without figures, and its settings; `None` for an axis that is not measured on a graph.
    fn axis(&self, name: AxisName) -> Option<(Axis, Vec<(u32, Setting)>)> {
        fn choose(quick: bool, few: &[u32], all: &[u32]) -> Vec<u32> {
            if quick { few.to_vec() } else { all.to_vec() }
        }
        let probes = most_probes() as u32;
        let all_probes: Vec<u32> = [0, 1, 2, 4, 6, 8, 16].into_iter().filter(|n| *n < probes).chain([probes]).collect();
        let (key, title, x_label, each, law, values) = match name {
            AxisName::Samples => (
                "samples",
                "Samples: camera to action",
                "samples n",
                "sample",
                Law::Linear,
                choose(self.quick, &SAMPLES_QUICK, &SAMPLES),
            ),
            AxisName::Horizon => (
                "horizon",
                "Horizon: camera to action",
                "look-ahead steps",
                "step",
                Law::Linear,
                choose(self.quick, &HORIZONS_QUICK, &HORIZONS),
            ),
            AxisName::Image => (
                "image",
                "Camera image: camera to action",
                "side of the image (px)",
                "px",
                Law::Area,
                choose(self.quick, &IMAGES_PX_QUICK, &IMAGES_PX),
            ),
            AxisName::Probes => (
                "probes",
                "Attached probes: camera to action",
                "probes attached",
                "probe",
                Law::Linear,
                choose(self.quick, &[0, probes], &all_probes),
            ),
            AxisName::View | AxisName::Candidates | AxisName::Stages => return None,
        };
        let setting = |x: u32| match name {
            AxisName::Samples => Setting { samples: x, ..MAIN },
            AxisName::Horizon => Setting { horizon: x, ..MAIN },
            AxisName::Image => Setting { image_px: Some(x), ..MAIN },
            _ => Setting { probes: x, ..MAIN },
        };
        let (cost_key, cost_label) = ("cores", "cores in use, less the renderer");
        let axis = Axis { key, title, x_label, each, law, cost_key, cost_label, rows: Vec::new() };
        Some((axis, values.into_iter().map(|x| (x, setting(x))).collect()))
    }

    fn run(&self, setting: Setting, images: &Path, seconds: f64) -> anyhow::Result<Measured> {
        let mut graph = self.subject.graph.clone();
        graph.run.samples = setting.samples;
        graph.run.horizon = setting.horizon;
        graph.run.frame_rate_hz = RATE_HZ;
        graph.camera.repeat = true;
        graph.controller.deadline_ms = DEADLINE_MS;
        if let Some(side_px) = setting.image_px {
            graph.camera.source = CameraSource::Folder;
            graph.camera.folder = Some(images.join(side_px.to_string()));
            // A real sensor's noise takes no time. The time of simulated noise grows with the number of pixels.
            graph.camera.noise = SensorNoise::OFF;
        }
        measure(&Plan {
            graph,
            dataset: &self.subject.dataset,
            checkpoint: &self.subject.checkpoint,
            warm_up: Duration::from_secs_f64(if self.quick { 0.3 } else { 1.5 }),
            measured: Duration::from_secs_f64(seconds),
            probes: setting.probes as usize,
        })
        .with_context(|| format!("with {setting}"))
    }
}

/// Returns each setting once, in the order of first occurrence.
fn distinct(settings: impl Iterator<Item = Setting>) -> Vec<Setting> {
    settings.fold(Vec::new(), |mut all, setting| {
        if !all.contains(&setting) {
            all.push(setting);
        }
        all
    })
}

/// Writes scaled squares of a folder's images to another folder.
fn write_images(from: &Path, to: &Path, side_px: u32) -> anyhow::Result<()> {
    let entries = std::fs::read_dir(from).with_context(|| format!("cannot read folder {}", from.display()))?;
    let mut paths: Vec<PathBuf> = entries.filter_map(|e| Some(e.ok()?.path())).collect();
    paths.retain(|path| path.extension().is_some_and(|e| e.eq_ignore_ascii_case("png")));
    paths.sort();
    ensure!(!paths.is_empty(), "folder {} contains no PNG image", from.display());
    std::fs::create_dir_all(to)?;
    // Evenly spread over the folder, so that they show different states.
    let stride = (paths.len() / IMAGES).max(1);
    for (i, path) in paths.iter().step_by(stride).take(IMAGES).enumerate() {
        scaled(&Image::load(path)?, side_px).save_png(&to.join(format!("{i:03}.png")))?;
    }
    Ok(())
}

/// Scales an image to a square, by the nearest pixels.
fn scaled(image: &Image, side_px: u32) -> Image {
    let pixel = |i: u32| {
        let at = |k: u32, length_px: u32| (u64::from(k) * u64::from(length_px) / u64::from(side_px)) as u32;
        image.pixel(at(i % side_px, image.width_px), at(i / side_px, image.height_px)).unwrap_or_default()
    };
    Image { width_px: side_px, height_px: side_px, rgb: (0..side_px * side_px).flat_map(pixel).collect() }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_config::GraphConfig;

    /// A setting of several axes is measured once, and each axis has all its settings.
    #[test]
    fn shared_settings_are_measured_once() {
        let graph = GraphConfig::parse("[run]\nname = \"t\"\ndataset = \"d\"\ncheckpoint = \"c\"", Path::new("t.toml"));
        for quick in [false, true] {
            let bench = GraphBench {
                subject: Subject {
                    graph: graph.as_ref().unwrap().clone(),
                    dataset: PathBuf::new(),
                    checkpoint: PathBuf::new(),
                },
                quick,
                seconds: 1.0,
            };
            let names = [AxisName::Samples, AxisName::Horizon, AxisName::Image, AxisName::Probes];
            let axes: Vec<_> = names.iter().map(|name| bench.axis(*name).unwrap().1).collect();
            let all = distinct(axes.iter().flatten().map(|(_, setting)| *setting));
            assert_eq!(all.iter().filter(|s| **s == MAIN).count(), 1);
            // Samples, horizon and probes all include the main setting.
            assert_eq!(all.len(), axes.iter().map(Vec::len).sum::<usize>() - 2);
            assert!(axes.iter().flatten().all(|(_, setting)| all.contains(setting)));
            assert!(axes.iter().all(|points| points.is_sorted_by_key(|(x, _)| *x) && points.len() > 1));
            assert_eq!(axes[3].last().unwrap().1.probes as usize, most_probes());
        }
    }

    /// Rounds are combined: the sums of frames and misses, and the means of the cores, with the renderer apart.
    #[test]
    fn rounds_add_up() {
        let round = |latency_ms: &[f64], missed, cores| Measured {
            hand_overs_ms: std::collections::BTreeMap::new(),
            latency_ms: latency_ms.to_vec(),
            ipc_share: 0.0,
            frames: latency_ms.len() + missed,
            missed,
            rate_hz: RATE_HZ,
            views: 0,
            uses: [Stage::Encoder, Stage::Prober, Stage::Renderer]
                .map(|stage| crate::graph::Use { stage, cores, resident_bytes: 0.0 })
                .to_vec(),
            probe_cores: cores / 2.0,
            probed: 7,
        };
        let mut sum = Sum::default();
        sum.add(round(&[3.0, 1.0], 1, 0.25));
        sum.add(round(&[2.0], 2, 0.5));
        let row = sum.row(5, true);
        assert_eq!((row.x, row.p50_ms, row.max_ms, row.counted), (5, 2.0, 3.0, 3));
        assert_eq!((row.missed, row.cost), (Some(3), 0.75));
        assert_eq!(row.more, [("renderer_cores", 0.375), ("probe_cores", 0.1875), ("probe_messages", 14.0)]);
        assert_eq!(sum.row(5, false).more, row.more[..1]);
    }

    /// An image is unchanged at its own size, and each of its pixels is a square at twice the size.
    #[test]
    fn images_are_scaled_by_whole_pixels() {
        let image = Image { width_px: 2, height_px: 2, rgb: (0..12).collect() };
        assert_eq!(scaled(&image, 2), image);
        let twice = scaled(&image, 4);
        for (x, y) in (0..4).flat_map(|y| (0..4).map(move |x| (x, y))) {
            assert_eq!(twice.pixel(x, y), image.pixel(x / 2, y / 2));
        }
    }
}
