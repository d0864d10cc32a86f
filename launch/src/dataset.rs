//! `carff dataset`: renders scenarios into datasets, checks datasets, and imports posed images.

use std::ops::ControlFlow;
use std::path::{Path, PathBuf};

#[cfg(feature = "recording")]
use crate::bag::BagArgs;
use anyhow::{Context, bail, ensure};
use carff_dataset::{
    Dataset, DatasetReport, Degradation, ImportOptions, SheetOptions, contact_sheet, degrade, import,
    sensor::SensorNoise,
};
use carff_scenes::{Extras, Scenario};
use carff_trials::places;
use indicatif::{ProgressBar, ProgressStyle};

/// Commands for datasets.
#[derive(Debug, clap::Subcommand)]
pub enum DatasetCommand {
    /// Render a scenario into a posed dataset.
    #[command(after_help = "Example: random cameras
  carff dataset render approaching-intersection --free-poses 50 --seed 3 --out data/free

Example: an actor that no shipped model knows
  carff dataset render approaching-intersection --appearance red-van --out data/red-van")]
    Render {
        /// A scenario file, or the name of one in configs/scenarios.
        scenario: PathBuf,
        /// Folder to write; it must be new, empty, or a dataset that this command wrote.
        #[arg(long)]
        out: PathBuf,
        /// Also write depth (16-bit PNG, millimetres) and actor masks.
        #[arg(long)]
        depth: bool,
        /// Draw this many cameras at random from the ranges of the fixed cameras, and render them instead.
        #[arg(long, value_parser = clap::value_parser!(u32).range(1..=10_000))]
        free_poses: Option<u32>,
        /// Seed of the random cameras.
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// Give the actor another look: the name of an `appearance` of the scenario.
        #[arg(long)]
        appearance: Option<String>,
        /// Add an object to every state: the name of a `bystander` of the scenario.
        #[arg(long)]
        object: Option<String>,
    },
    /// Convert a dataset in the format of nerfstudio or instant-ngp into a dataset of one state.
    #[command(after_help = "Example: a dataset with its region of interest
  carff dataset import path/to/set --out data/mine --bounds -2,-2,0,2,2,2

Example: a ROS 2 bag with images, camera_info and transforms
  carff dataset import bag/ --topic /front/image_raw --out data/mine")]
    Import {
        /// Folder of the dataset: one `transforms.json` or three (`transforms_train.json` and so on), PNG or JPEG images,
        /// and masks (`mask_path`). Lens distortion (`OPENCV`, `OPENCV_FISHEYE`) is undone. Or a recording of another
        /// tool with images, calibration and poses: an MCAP file, or a folder of them.
        dir: PathBuf,
        /// Folder to write; it must be new, empty, or a dataset that this program wrote.
        #[arg(long)]
        out: PathBuf,
        /// Longest side of an image, pixels; larger ones are scaled down.
        #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(16..=8192))]
        max_side: u32,
        /// Region of interest in the dataset's units: x0,y0,z0,x1,y1,z1. Default: about the region that the cameras
        /// look at.
        #[arg(long, value_parser = corners, allow_hyphen_values = true)]
        bounds: Option<[[f64; 3]; 2]>,
        /// Options for recordings.
        #[cfg(feature = "recording")]
        #[command(flatten)]
        recording: BagArgs,
    },
    /// Write a copy of a dataset as a camera gives it: noise, varying exposure and white balance, inexact poses.
    #[command(after_help = "Example: a hard copy
  carff dataset degrade data/approaching-intersection --read-noise 4 --out data/degraded")]
    Degrade {
        /// Folder of the dataset.
        dir: PathBuf,
        /// Folder to write; it must be new, empty, or a dataset that this program wrote.
        #[arg(long)]
        out: PathBuf,
        /// Standard deviation of the read noise, of 255.
        #[arg(long, default_value_t = 4.0)]
        read_noise: f32,
        /// Standard deviation of the relative exposure of each image.
        #[arg(long, default_value_t = 0.05)]
        gain: f32,
        /// Standard deviation of the relative gain of each colour channel of each image.
        #[arg(long, default_value_t = 0.03)]
        white_balance: f32,
        /// Standard deviation of the pose's error, as a shift of the image's centre, pixels.
        #[arg(long, default_value_t = 1.0)]
        pose_jitter_px: f64,
        /// Keep one state of each pose, drawn at random: a camera that drives by takes each image from another pose.
        #[arg(long)]
        one_state: bool,
        /// Seed of all draws.
        #[arg(long, default_value_t = 1)]
        seed: u64,
    },
    /// Check a dataset, list all missing and broken images, and print the statistics of the others.
    #[command(after_help = "Example: with a contact sheet of all images
  carff dataset check data/approaching-intersection --contact-sheet reports/contact.png")]
    Check {
        /// Folder of the dataset.
        dir: PathBuf,
        /// Write a contact sheet of all images here: a row per state, a column per view.
        #[arg(long)]
        contact_sheet: Option<PathBuf>,
        /// Columns of the contact sheet.
        #[arg(long, default_value_t = 12, value_parser = clap::value_parser!(u16).range(1..=64))]
        columns: u16,
    },
}

/// Runs one of the commands.
pub fn run(command: DatasetCommand) -> anyhow::Result<()> {
    match command {
        DatasetCommand::Render { scenario, out, depth, free_poses, seed, appearance, object } => {
            let path = find_scenario(&scenario)?;
            let mut scenario = Scenario::load(&path)?;
            if let Some(name) = appearance {
                scenario = scenario.with_appearance(&name)?;
            }
            if let Some(name) = object {
                scenario = scenario.with_object(&name)?;
            }
            if let Some(count) = free_poses {
                scenario = scenario.with_free_cameras(count as usize, seed)?;
            }
            let extras = if depth { Extras::DepthAndMasks } else { Extras::None };
            let images = render(&scenario, &out, extras)?;
            println!("{images} images in {}", out.display());
            Ok(())
        }
        DatasetCommand::Import {
            dir,
            out,
            max_side,
            bounds,
            #[cfg(feature = "recording")]
            recording,
        } => {
            let options = ImportOptions { max_side_px: max_side, bounds, ..ImportOptions::default() };
            #[cfg(feature = "recording")]
            let (dir, _extracted) = extracted(dir, &recording)?;
            let imported = import(&dir, &out, &options)?;
            println!(
                "{} images in {} ({} undistorted, {} scaled down, {} with a mask)",
                imported.frames,
                out.display(),
                imported.undistorted,
                imported.scaled,
                imported.masked
            );
            let [low, high] = imported.bounds.map(|corner| corner.map(|v| (v * 1000.0).round() / 1000.0));
            println!("Bounds {low:?} to {high:?}; outside is background. Pass --bounds to change it");
            imported.warnings.iter().for_each(|warning| println!("warning: {warning}"));
            Ok(())
        }
        DatasetCommand::Degrade { dir, out, read_noise, gain, white_balance, pose_jitter_px, one_state, seed } => {
            ensure!((0.0..=32.0).contains(&pose_jitter_px), "--pose-jitter-px {pose_jitter_px}: 0 to 32 are allowed");
            let noise = SensorNoise {
                sigma: read_noise,
                gain_sigma: gain,
                channel_gain_sigma: white_balance,
                channel_offset_sigma: 0.0,
            };
            noise.validate()?;
            let degradation = Degradation { noise, pose_jitter_px, one_state, seed };
            let images = degrade(&Dataset::open(&dir)?, &out, &degradation)?;
            println!("{images} images in {}", out.display());
            Ok(())
        }
        DatasetCommand::Check { dir, contact_sheet, columns } => {
            check(&dir, contact_sheet.as_deref(), usize::from(columns))
        }
    }
}

/// Parses two corners from six numbers with commas between them.
fn corners(text: &str) -> Result<[[f64; 3]; 2], String> {
    let values: Result<Vec<f64>, _> = text.split(',').map(|part| part.trim().parse()).collect();
    match values.as_deref() {
        Ok(&[x0, y0, z0, x1, y1, z1])
            if [x0, y0, z0, x1, y1, z1].iter().all(|v| v.is_finite()) && x0 < x1 && y0 < y1 && z0 < z1 =>
        {
            Ok([[x0, y0, z0], [x1, y1, z1]])
        }
        _ => Err("six numbers are needed: x0,y0,z0,x1,y1,z1, the first three below the last three".to_owned()),
    }
}

/// Extracts a recording into a temporary folder. Returns the dataset's folder: that one, or the given folder if it is
/// not a recording; and the temporary folder, which is removed when it is dropped.
#[cfg(feature = "recording")]
fn extracted(dir: PathBuf, args: &BagArgs) -> anyhow::Result<(PathBuf, Option<tempfile::TempDir>)> {
    if !crate::bag::is_recording(&dir) {
        return Ok((dir, None));
    }
    let folder = tempfile::tempdir().context("cannot create a temporary folder")?;
    let set = folder.path().join(dir.file_stem().unwrap_or_default());
    std::fs::create_dir(&set)?;
    let found = crate::bag::extract(&dir, &set, args)?;
    println!(
        "{}: {} images, {} without a pose, {} used",
        dir.display(),
        found.images,
        found.without_pose,
        found.written
    );
    Ok((set, Some(folder)))
}

/// Returns the path of a scenario file, or of the scenario of that name: in configs/scenarios of this folder, of a
/// folder above it, or of the folder in which this program was built or installed.
pub(crate) fn find_scenario(scenario: &Path) -> anyhow::Result<PathBuf> {
    if scenario.is_file() {
        return Ok(scenario.to_owned());
    }
    let named = |folder: &PathBuf| {
        let mut name = folder.join("configs/scenarios").join(scenario).into_os_string();
        name.push(".toml");
        PathBuf::from(name)
    };
    let (here, program) = (std::env::current_dir().unwrap_or_default(), std::env::current_exe().unwrap_or_default());
    let installed = program.ancestors().map(|folder| folder.join("share/carff"));
    let folders: Vec<PathBuf> =
        here.ancestors().chain(program.ancestors()).map(Path::to_owned).chain(installed).collect();
    if let Some(found) = folders.iter().map(named).find(|path| path.is_file()) {
        return Ok(found);
    }
    // The scenarios that exist, for the suggestion.
    let shipped = folders.iter().find(|folder| folder.join("configs/scenarios").is_dir()).unwrap_or(&here);
    let (scenario, named) = (scenario.display(), named(shipped));
    let hint = carff_base::names::beside(&named);
    bail!("no scenario {scenario}: neither this file nor {} exists{hint}", named.display());
}

/// Renders a dataset, with a progress bar. Returns the number of images.
pub fn render(scenario: &Scenario, out: &Path, extras: Extras) -> anyhow::Result<u64> {
    let images = (scenario.cameras().len() * scenario.info().state_count()) as u64;
    let bar = ProgressBar::new(images);
    bar.set_style(ProgressStyle::with_template("{msg} [{bar:40}] {pos}/{len} images, {eta} left")?);
    bar.set_message(scenario.info().name.clone());
    if bar.is_hidden() {
        carff::say(&format!("rendering {images} images of {} into {}", scenario.info().name, out.display()));
    }
    let rendered = scenario.render_dataset(out, extras, |done, _| {
        bar.set_position(done as u64);
        ControlFlow::Continue(())
    });
    bar.finish_and_clear();
    rendered.with_context(|| format!("cannot render {} into {}", scenario.path().display(), out.display()))?;
    Ok(images)
}

fn check(dir: &Path, sheet: Option<&Path>, columns: usize) -> anyhow::Result<()> {
    sheet.map_or(Ok(()), carff_base::files::check_writable)?;
    let (dataset, faults) = Dataset::survey(dir)?;
    for fault in &faults {
        println!("broken: {}", carff_base::errors::sentence(fault));
    }
    if let Some(dataset) = dataset {
        describe(&dataset, sheet, columns)?;
    }
    ensure!(
        faults.is_empty(),
        "{}: {} images or masks cannot be used; they are listed above",
        dir.display(),
        faults.len()
    );
    Ok(())
}

/// Prints the statistics of a dataset, and writes its contact sheet.
fn describe(dataset: &Dataset, sheet: Option<&Path>, columns: usize) -> anyhow::Result<()> {
    let images = dataset.load_all_images()?;
    print!("{}", DatasetReport::of(dataset, &images));
    if let Some(scenario) = dataset.scenario().filter(|s| s.state_count() > 1) {
        match places(scenario) {
            Ok(places) => println!("Probed places: {}", places.len()),
            Err(problem) => println!("warning: {problem}"),
        }
    }
    if let Some(path) = sheet {
        let sheet = contact_sheet(dataset, &images, SheetOptions { columns, ..SheetOptions::default() });
        let title = dataset.scenario().map_or_else(|| dataset.dir().display().to_string(), |s| s.name.clone());
        carff_plots::labelled_sheet(&sheet, &title)?.save_png(path)?;
        println!("Contact sheet: {}", path.display());
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    const SMALL: &str = r#"
name = "small"
bounds_m = [[-2.0, -2.0, 0.0], [2.0, 2.0, 2.0]]
timestamps = 1
branches = ["only"]
image = { width_px = 16, height_px = 16, fov_deg = 60.0 }

[[overhead]]
view_kind = "bev"
count = 2
center = [0.0, 0.0]
height_m = 5.0
spread_m = 1.0
"#;

    fn render_command(scenario: &Path, out: &Path) -> DatasetCommand {
        let (scenario, out) = (scenario.to_owned(), out.to_owned());
        DatasetCommand::Render { scenario, out, depth: true, free_poses: None, seed: 1, appearance: None, object: None }
    }

    /// A rendered dataset passes its own check and can be rendered again; a folder with other files is not changed.
    #[test]
    fn render_then_check() {
        let dir = tempfile::tempdir().unwrap();
        let scenario = dir.path().join("small.toml");
        std::fs::write(&scenario, SMALL).unwrap();
        let out = dir.path().join("set");
        let command = || render_command(&scenario, &out);
        run(command()).unwrap();
        run(command()).unwrap();
        let sheet = dir.path().join("sheet.png");
        run(DatasetCommand::Check { dir: out.clone(), contact_sheet: Some(sheet.clone()), columns: 4 }).unwrap();
        assert!(sheet.is_file());

        let foreign = dir.path().join("foreign");
        std::fs::create_dir(&foreign).unwrap();
        std::fs::write(foreign.join("thesis.txt"), "irreplaceable").unwrap();
        let error = run(render_command(&scenario, &foreign)).unwrap_err();
        assert!(format!("{error:#}").contains("not a dataset that this program wrote"), "{error:#}");
        assert_eq!(std::fs::read_to_string(foreign.join("thesis.txt")).unwrap(), "irreplaceable");
    }

    /// A check without some images prints the report of the others, and fails with their number.
    #[test]
    fn a_check_continues_without_an_image() {
        let dir = tempfile::tempdir().unwrap();
        let scenario = dir.path().join("small.toml");
        std::fs::write(&scenario, SMALL).unwrap();
        let out = dir.path().join("set");
        run(render_command(&scenario, &out)).unwrap();
        let sheet = dir.path().join("sheet.png");
        let check = || run(DatasetCommand::Check { dir: out.clone(), contact_sheet: Some(sheet.clone()), columns: 4 });
        std::fs::remove_file(out.join("images/b0_t0_v001.png")).unwrap();
        let error = check().unwrap_err().to_string();
        assert!(error.ends_with("set: 1 images or masks cannot be used; they are listed above"), "{error}");
        assert!(sheet.is_file());
        std::fs::remove_file(out.join("images/b0_t0_v000.png")).unwrap();
        assert!(check().unwrap_err().to_string().contains("2 images or masks"));
    }

    /// A box has six finite numbers, the lower corner first.
    #[test]
    fn boxes_of_six_numbers() {
        assert_eq!(corners("-1,1,2, 3,4,5.5").unwrap(), [[-1.0, 1.0, 2.0], [3.0, 4.0, 5.5]]);
        for wrong in ["0,1", "0,1,2,3,0.5,5", "0,1,nan,3,4,5", "a,b,c,d,e,f", ""] {
            assert!(corners(wrong).unwrap_err().contains("x0,y0,z0"), "{wrong}");
        }
    }

    /// A scenario that is neither a file nor a name is an error that names both paths.
    #[test]
    fn unknown_scenario() {
        let error = find_scenario(Path::new("nowhere-at-all")).unwrap_err().to_string();
        assert!(error.contains("nowhere-at-all") && error.contains("nowhere-at-all.toml"), "{error}");
    }
}
