//! `carff camera check`: the frames that arrive, their rate and delay, and side by side the camera's image, the model's
//! input and a training image.

use crate::probe::{Inline, columns};
use crate::session::colours;
use anyhow::{Context, bail, ensure};
use carff_base::files::check_writable;
use carff_base::statistics::percentile;
use carff_checkpoint::Manifest;
use carff_config::{CameraSource, GraphConfig};
use carff_dataset::{Dataset, Image};
use carff_messages::FrameMeta;
use carff_observe::{AttachError, Attached, RunLock, RunRecord, attach};
use carff_plots::Board;
use carff_runtime::StageArgs;
use carff_transport::{
    ImagePayload, Node, Receiver, Run, Sample, Stop, Waiter, Woken, monotonic_now_ns, remove_run_leftovers, run_id_of,
    runtime_dir, topics,
};
use clap::ValueHint;
use image::imageops::{FilterType, resize};
use rustix::process::{Pid, Signal, kill_process};
use std::io::Read;
use std::path::{Path, PathBuf};
use std::process::{Child, Command, ExitCode, Stdio};
use std::time::{Duration, SystemTime};

/// Longest wait for the first frame, nanoseconds.
const FIRST_NS: u64 = 30_000_000_000;
/// Interval of looking at the camera's process.
const LOOK_NS: u64 = 50_000_000;
/// Longest time from the request to end until the camera is killed.
const END: Duration = Duration::from_secs(2);
/// Longest side of an image of the result, pixels.
const SIDE_PX: u32 = 320;
/// Side of the thumbnails by which the most similar training image is found, pixels.
const THUMB_PX: u32 = 16;

/// The commands of `carff camera`.
#[derive(Clone, Debug, clap::Subcommand)]
pub enum CameraCommand {
    /// Show what the camera of a graph delivers: of the running graph, or else of a camera that is started for this.
    #[command(after_help = "Example: in the terminal; as an image file, on a machine without a screen
  carff camera check configs/graphs/approaching-intersection.toml
  carff camera check configs/graphs/approaching-intersection.toml --image check.png")]
    Check(CheckArgs),
}

/// A graph, and the form of the result.
#[derive(Clone, Debug, clap::Args)]
pub struct CheckArgs {
    /// The graph file.
    #[arg(value_hint = ValueHint::FilePath)]
    graph: PathBuf,
    /// Time over which frames are counted, seconds, 0.5 to 3600.
    #[arg(long, default_value_t = 3.0)]
    seconds: f64,
    /// Write the images here as a PNG file instead of showing them in the terminal.
    #[arg(long, value_name = "FILE", value_hint = ValueHint::FilePath)]
    image: Option<PathBuf>,
    /// Dataset folder; replaces the graph file's.
    #[arg(long, value_hint = ValueHint::DirPath)]
    dataset: Option<PathBuf>,
    /// Set a key of the graph file, for example `camera.file=drive.mcap`; may be given several times.
    #[arg(long, value_name = "KEY=VALUE")]
    set: Vec<String>,
    /// Protocol for images in the terminal.
    #[arg(long = "as", value_name = "WAY", value_enum, default_value_t, conflicts_with = "image")]
    inline: Inline,
}

/// Runs one of the commands.
pub fn run(command: &CameraCommand) -> anyhow::Result<ExitCode> {
    let CameraCommand::Check(args) = command;
    ensure!((0.5..=3600.0).contains(&args.seconds), "--seconds is {}; allowed: 0.5 to 3600", args.seconds);
    args.image.as_deref().map_or(Ok(()), check_writable)?;
    let graph = GraphConfig::load_with(&args.graph, &args.set)?;
    let dataset = graph.resolve(args.dataset.as_ref().unwrap_or(&graph.run.dataset));
    let stop = Stop::on_signals().context("cannot handle signals")?;
    let mut watched = Watched::open(&graph, &dataset)?;
    let seen = watched.watch(&Waiter::new(stop), (args.seconds * 1e9) as u64, graph.camera.source)?;
    drop(watched);
    let lines = seen.lines(&graph);
    for line in &lines {
        println!("{line}");
    }
    let board = Board { images: seen.images(&graph, &dataset)?, decision: "camera".into(), lines, ..Board::default() };
    if let Some(path) = &args.image {
        board.draw()?.save_png(path)?;
        println!("{}", path.display());
    } else if args.inline != Inline::Auto || colours() {
        for (caption, image) in &board.images {
            let shown = args.inline.resolved().encode(&image.rgb, [image.width_px, image.height_px], columns())?;
            println!("{caption}\n{shown}");
        }
    }
    Ok(ExitCode::SUCCESS)
}

/// A camera that is watched: of a living run, or of a run that this command owns. Dropping it ends the latter.
struct Watched {
    frames: Receiver<ImagePayload<FrameMeta>>,
    raw: Receiver<ImagePayload<FrameMeta>>,
    node: Option<Node>,
    own: Option<Own>,
}

/// A run of this command, with the camera that it has started.
struct Own {
    run: Run,
    camera: Option<Child>,
    _copy: tempfile::TempPath,
    _lock: RunLock,
}

/// Frames of a camera.
struct Seen {
    arrived_ns: Vec<u64>,
    delays_ns: Vec<u64>,
    invalid: u64,
    meta: FrameMeta,
    frame: Image,
    /// The image before rectification, where the camera stage published it.
    raw: Option<Image>,
}

impl Watched {
    fn open(graph: &GraphConfig, dataset: &Path) -> anyhow::Result<Self> {
        let (node, own) = match attach(Some(&graph.run.name), "camera-check") {
            Ok(Attached { node, .. }) => (node, None),
            Err(AttachError::NoRun | AttachError::NoSuchRun { .. }) => {
                let own = Own::new(graph, dataset)?;
                (Node::open(&own.run, "camera-check")?, Some(own))
            }
            Err(error) => return Err(error.into()),
        };
        let (frames, raw) = (node.receiver(&topics::FRAME)?, node.receiver(&topics::RAW)?);
        let mut watched = Self { frames, raw, node: Some(node), own };
        // The camera starts when its topics are open, so that no frame is missed.
        if let Some(own) = &mut watched.own {
            own.start(graph, dataset)?;
        }
        Ok(watched)
    }

    /// Collects frames for a time from the first one.
    fn watch(&mut self, waiter: &Waiter, span_ns: u64, source: CameraSource) -> anyhow::Result<Seen> {
        if let (CameraSource::External, Some(own)) = (source, &self.own) {
            let name = own.run.name();
            println!(
                "waiting for another process to publish camera/frame; `carff run info {name} --json` prints how it joins"
            );
        }
        let begun_ns = monotonic_now_ns();
        let mut seen: Option<Seen> = None;
        loop {
            let now_ns = monotonic_now_ns();
            let end_ns = seen.as_ref().map_or(begun_ns + FIRST_NS, |seen| seen.arrived_ns[0] + span_ns);
            if now_ns >= end_ns {
                break;
            }
            let woken = waiter.wait_until(&[&self.frames, &self.raw], end_ns.min(now_ns + LOOK_NS))?;
            while let Some(frame) = self.frames.next()? {
                note(&mut seen, &frame);
            }
            if let (Some(raw), Some(seen)) = (self.raw.newest()?, &mut seen) {
                seen.raw = Some(image_of(&raw));
            }
            if woken == Woken::Stopped {
                break;
            }
            if self.own.as_mut().map_or(Ok(None), Own::ended)?.is_some() {
                break;
            }
        }
        let invalid = self.node.as_ref().map_or(0, |node| node.counters().invalid());
        let why = match &mut self.own {
            Some(own) if seen.is_none() => own.last_error()?,
            _ => None,
        };
        match (seen, why) {
            (Some(seen), _) => Ok(Seen { invalid, ..seen }),
            (None, Some(error)) => bail!("{error}"),
            (None, None) if invalid > 0 => {
                bail!("no valid frame has arrived, but {invalid} invalid ones: `carff run info` prints the layout")
            }
            (None, None) => bail!("no frame has arrived"),
        }
    }
}

impl Drop for Watched {
    fn drop(&mut self) {
        if let Some(own) = &mut self.own {
            own.end();
            self.node = None;
            // Files that remain belong to a process that has ended, and the next launch removes them.
            let _ = remove_run_leftovers(&own.run);
        }
    }
}

impl Own {
    /// Takes the lock of the graph's run, as a launch does.
    fn new(graph: &GraphConfig, dataset: &Path) -> anyhow::Result<Self> {
        let name = &graph.run.name;
        let run = Run::new(name, run_id_of(name, monotonic_now_ns()))?;
        let file = runtime_dir().join(format!("{name}.toml"));
        let absolute = |path: &Path| std::path::absolute(path).map(|path| path.display().to_string());
        let record = RunRecord {
            pid: std::process::id(),
            run_id: run.id(),
            graph: absolute(&file)?,
            dataset: absolute(dataset)?,
            checkpoint: absolute(&graph.resolve(&graph.run.checkpoint))?,
            started_unix_s: SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs(),
        };
        let lock = RunLock::take(&runtime_dir(), name, &record, "--set run.name")?;
        lock.sweep(&run, "--set run.name")?;
        std::fs::write(&file, graph.to_toml()?).with_context(|| format!("cannot write {}", file.display()))?;
        Ok(Self { run, camera: None, _copy: tempfile::TempPath::try_from_path(file)?, _lock: lock })
    }

    fn start(&mut self, graph: &GraphConfig, dataset: &Path) -> anyhow::Result<()> {
        let Some(program) = graph.camera.source.program() else { return Ok(()) };
        let program = std::env::current_exe()?.with_file_name(program);
        let mut args =
            StageArgs::new(&runtime_dir().join(format!("{}.toml", self.run.name())), self.run.name(), self.run.id());
        (args.dataset, args.parent_pid, args.raw) = (Some(dataset.to_owned()), Some(std::process::id()), true);
        let child = Command::new(&program)
            .args(args.to_command_line())
            .stdin(Stdio::null())
            .stdout(Stdio::null())
            .stderr(Stdio::piped())
            .spawn()
            .with_context(|| format!("cannot start {}: build it first", program.display()))?;
        self.camera = Some(child);
        Ok(())
    }

    /// Returns a value if the camera has ended.
    fn ended(&mut self) -> anyhow::Result<Option<()>> {
        Ok(self.camera.as_mut().map(Child::try_wait).transpose()?.flatten().map(drop))
    }

    /// Ends the camera; returns the last error that it logged.
    fn last_error(&mut self) -> anyhow::Result<Option<String>> {
        self.end();
        let mut text = Vec::new();
        if let Some(mut stderr) = self.camera.as_mut().and_then(|camera| camera.stderr.take()) {
            stderr.read_to_end(&mut text)?;
        }
        let text = String::from_utf8_lossy(&text).into_owned();
        Ok(text.lines().rev().find_map(crate::log_line::error_in))
    }

    fn end(&mut self) {
        let Some(camera) = &mut self.camera else { return };
        if let Some(pid) = Pid::from_raw(camera.id() as i32).filter(|_| matches!(camera.try_wait(), Ok(None))) {
            let _ = kill_process(pid, Signal::TERM);
        }
        let patience = std::time::Instant::now();
        while matches!(camera.try_wait(), Ok(None)) {
            if patience.elapsed() > END {
                let _ = camera.kill();
                let _ = camera.wait();
            }
            std::thread::sleep(Duration::from_millis(5));
        }
    }
}

fn note(seen: &mut Option<Seen>, frame: &Sample<ImagePayload<FrameMeta>>) {
    let now_ns = monotonic_now_ns();
    let seen = seen.get_or_insert_with(|| Seen {
        arrived_ns: Vec::new(),
        delays_ns: Vec::new(),
        invalid: 0,
        meta: **frame,
        frame: image_of(frame),
        raw: None,
    });
    seen.arrived_ns.push(now_ns);
    seen.delays_ns.push(now_ns.saturating_sub(frame.header.capture_time_ns));
    (seen.meta, seen.frame) = (**frame, image_of(frame));
}

fn image_of(frame: &Sample<ImagePayload<FrameMeta>>) -> Image {
    Image { width_px: frame.width_px, height_px: frame.height_px, rgb: frame.bytes().to_vec() }
}

impl Seen {
    /// Describes rate, delay and field of view.
    fn lines(&self, graph: &GraphConfig) -> Vec<String> {
        let ms = |values: &[u64], share: f64| {
            percentile(&values.iter().map(|&ns| ns as f64 / 1e6).collect::<Vec<_>>(), share).unwrap_or_default()
        };
        let periods: Vec<u64> = self.arrived_ns.windows(2).map(|pair| pair[1] - pair[0]).collect();
        let span_s = self.arrived_ns.last().zip(self.arrived_ns.first()).map_or(0.0, |(l, f)| (l - f) as f64 / 1e9);
        let rate = if span_s > 0.0 { (self.arrived_ns.len() - 1) as f64 / span_s } else { 0.0 };
        let [across, down] = self.meta.camera().field_of_view_deg();
        let size = |image: &Image| format!("{}x{}", image.width_px, image.height_px);
        let mut lines = vec![
            format!("frames    {} of {} pixels, {} invalid", self.arrived_ns.len(), size(&self.frame), self.invalid),
            format!("rate      {rate:.1} Hz; the graph expects {}", graph.run.frame_rate_hz),
        ];
        if !periods.is_empty() {
            lines.push(format!("period    p50 {:.1} ms, p99 {:.1} ms", ms(&periods, 0.5), ms(&periods, 0.99)));
        }
        lines.push(format!(
            "delay     p50 {:.1} ms, p99 {:.1} ms",
            ms(&self.delays_ns, 0.5),
            ms(&self.delays_ns, 0.99)
        ));
        lines.push(format!("view      {across:.1} x {down:.1} degrees"));
        if let Some(raw) = &self.raw {
            lines.push(format!("camera    shown at {} pixels", size(raw)));
        }
        lines
    }

    /// Returns the images with their captions: the camera's, the model's input, and the most similar training image.
    fn images(&self, graph: &GraphConfig, dataset: &Path) -> anyhow::Result<Vec<(String, Image)>> {
        let mut images = Vec::new();
        if let Some(raw) = &self.raw {
            images.push(("camera".to_owned(), scaled(raw, SIDE_PX)?));
        }
        // The encoder scales each frame to a square.
        let input_px = Manifest::load(&graph.resolve(&graph.run.checkpoint)).ok().map(|m| m.encoder.backbone.input_px);
        let input = match input_px {
            Some(side_px) => resized(&self.frame, side_px as u32, side_px as u32)?,
            None => self.frame.clone(),
        };
        images.push(("model's input".to_owned(), scaled(&input, SIDE_PX)?));
        if let Ok(dataset) = Dataset::open(dataset)
            && let Some(trained) = most_similar(&self.frame, &dataset)?
        {
            images.push(("training image".to_owned(), scaled(&trained, SIDE_PX)?));
        }
        Ok(images)
    }
}

/// Returns the dataset's image that is most similar to a frame as a thumbnail.
fn most_similar(frame: &Image, dataset: &Dataset) -> anyhow::Result<Option<Image>> {
    let wanted = resized(frame, THUMB_PX, THUMB_PX)?;
    let mut best: Option<(f64, Image)> = None;
    for image in dataset.load_all_images()? {
        let thumb = resized(&image, THUMB_PX, THUMB_PX)?;
        let psnr_db = thumb.psnr_db(&wanted).unwrap_or(0.0);
        if best.as_ref().is_none_or(|(known, _)| psnr_db > *known) {
            best = Some((psnr_db, image));
        }
    }
    Ok(best.map(|(_, image)| image))
}

/// Returns an image with this longest side.
fn scaled(image: &Image, side_px: u32) -> anyhow::Result<Image> {
    let longest = image.width_px.max(image.height_px);
    let side = |px: u32| (px * side_px / longest).max(1);
    resized(image, side(image.width_px), side(image.height_px))
}

fn resized(image: &Image, width_px: u32, height_px: u32) -> anyhow::Result<Image> {
    let buffer = image::RgbImage::from_raw(image.width_px, image.height_px, image.rgb.clone())
        .context("an image without pixels")?;
    let rgb = resize(&buffer, width_px, height_px, FilterType::Triangle).into_raw();
    Ok(Image { width_px, height_px, rgb })
}
