//! `carff-viewer`: the live window.

use anyhow::{Context, bail};
use carff_observe::{First, Theme, ViewArgs};
use carff_viewer::app::{Options, Viewer, Waker, WindowCommand, icon};
use carff_viewer::input::{Album, ChosenImage};
use carff_viewer::live::LiveFeed;
use carff_viewer::models::SessionModels;
use carff_viewer::session::Session;
use clap::Parser;
use eframe::egui::{ThemePreference, ViewportBuilder};
use std::io::Write;
use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

/// The shipped checkpoint.
const SHIPPED: &str = "configs/checkpoints/approaching-intersection";

/// Threads for encoding and forecasting, as in the shipped graphs.
const MODEL_THREADS: usize = 1;
/// Niceness of the window while it watches a graph.
const NICE: i32 = 5;

/// Shows the scenes that explain an image: forecast, probed, and seen from any pose. Images come from files or from a
/// running graph, which the window does not disturb.
#[derive(Debug, Parser)]
#[command(
    version,
    after_help = "Examples:\n  carff-viewer --dataset data/approaching-intersection\n  carff-viewer --run\n  \
                  carff-viewer --image frame.png --do predict --do probe --screenshot scene.png"
)]
struct Cli {
    #[command(flatten)]
    args: ViewArgs,
}

fn main() -> ExitCode {
    // Log of messages that the transport drops. It fails only if a log is already set up; that log then stays.
    let _ = tracing_subscriber::fmt()
        .with_env_filter("off,carff_transport=warn")
        .with_writer(std::io::stderr)
        .with_ansi(false)
        .with_target(false)
        .without_time()
        .try_init();
    match carff_runtime::parse::<Cli>().map_err(Into::into).and_then(|cli| run(cli.args)) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            // Standard error may be full or closed.
            let _ = writeln!(std::io::stderr(), "error: {}", carff_base::errors::sentence(&*error));
            ExitCode::FAILURE
        }
    }
}

fn run(args: ViewArgs) -> anyhow::Result<()> {
    let waker = Waker::default();
    let live = match args.run {
        Some(name) => {
            // The window gives way to the graph. If the system refuses, the window still works.
            let _ = rustix::process::nice(NICE);
            let waker = waker.clone();
            Some(LiveFeed::attach(Some(name).filter(|n| !n.is_empty()), move || waker.wake_soon())?)
        }
        None => None,
    };
    let watched = live.as_ref().map(|live| live.watched().run.clone());
    let cores = std::thread::available_parallelism().map_or(1, usize::from);
    let threads = args.threads.unwrap_or(if live.is_some() { 1 } else { cores }).max(1);
    let checkpoint = args.checkpoint.or_else(|| watched.as_ref().map(|run| run.checkpoint.clone()));
    let models = SessionModels::load(&checkpoint.unwrap_or_else(|| SHIPPED.into()), MODEL_THREADS)?;
    let album = album(args.dataset.as_deref(), watched.map(|run| run.dataset), &models)?;
    let image = args.image.as_deref().map(ChosenImage::load_png).transpose()?;
    let after = Duration::try_from_secs_f32(args.after).context("--after: must be a number of seconds, 0 or more")?;
    let options = Options {
        threads,
        folder: args.folder,
        theme: match args.theme {
            None => ThemePreference::System,
            Some(Theme::Dark) => ThemePreference::Dark,
            Some(Theme::Light) => ThemePreference::Light,
        },
        one_shot: args.screenshot.clone().map(|path| (path, after)),
    };
    let is_live = live.is_some();
    let mut viewer =
        Viewer::new(Session::new(models), album, live, options, waker).context("cannot start a thread to draw with")?;
    if let Some(input) = image {
        viewer.toggle_input(input).map_err(anyhow::Error::msg)?;
    } else if !is_live {
        viewer.begin();
    }
    let first: Vec<WindowCommand> = args
        .first
        .into_iter()
        .map(|first| match first {
            First::Toggle => WindowCommand::Toggle,
            First::Predict => WindowCommand::Predict,
            First::Probe => WindowCommand::Probe,
            First::ProbeAndPredict => WindowCommand::ProbeAndPredict,
        })
        .collect();
    let title = format!("CARFF viewer: {}", viewer.session.models().manifest.scenario.name);
    let size = [args.size.first().copied().unwrap_or(1440.0), args.size.get(1).copied().unwrap_or(900.0)];
    let viewport = ViewportBuilder::default()
        .with_title(&title)
        .with_app_id("carff-viewer")
        .with_icon(icon())
        .with_inner_size(size)
        .with_min_inner_size([900.0, 600.0]);
    let native = eframe::NativeOptions { viewport, ..eframe::NativeOptions::default() };
    let create: eframe::AppCreator<'_> = Box::new(move |creation| {
        for command in first {
            viewer.run(command, &creation.egui_ctx);
        }
        Ok(Box::new(viewer))
    });
    eframe::run_native(&title, native, create)
        .map_err(|e| anyhow::anyhow!("cannot open a window: {e}; is there a display (DISPLAY or WAYLAND_DISPLAY)?"))?;
    match args.screenshot {
        Some(path) if !path.is_file() => bail!("the window closed before {} was saved", path.display()),
        _ => Ok(()),
    }
}

/// Returns the dataset to choose images from, or the reason why there is none. A dataset that the user named must open.
fn album(
    asked: Option<&Path>,
    of_run: Option<PathBuf>,
    models: &SessionModels,
) -> anyhow::Result<Result<Album, String>> {
    if let Some(dir) = asked {
        return Ok(Ok(Album::open(dir, models)?));
    }
    let dir = of_run.unwrap_or_else(|| models.trained.dataset.clone());
    if !dir.is_dir() {
        let name = &models.manifest.scenario.name;
        let dir = dir.display();
        return Ok(Err(format!(
            "Dataset {dir} does not exist yet. Render it with\n\ncarff dataset render {name} --out {dir}\n\nand start \
             again, or drop a PNG image here."
        )));
    }
    Ok(Album::open(&dir, models).map_err(|e| e.to_string()))
}
