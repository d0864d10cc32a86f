//! The window: one file per pane. The panes only show values that other modules compute.

mod actions;
mod belief_pane;
mod commands;
mod drawing;
mod help;
mod input_pane;
mod journal_pane;
mod maps;
mod scene_pane;
mod scenes_strip;
mod shots;
mod textures;
mod theme;
mod top_bar;

pub use commands::WindowCommand;
pub use shots::ShotError;
pub use theme::icon;

use crate::camera::OrbitCamera;
use crate::input::{Album, ChosenImage};
use crate::live::LiveFeed;
use crate::render::{RenderPace, RenderWorker};
use crate::session::Session;
use carff_base::geometry::PinholeCamera;
use carff_dataset::{Image, Observability};
use carff_field::LATENT_DIM;
use drawing::{Asked, DrawnOf, Recent};
use eframe::egui::{self, CentralPanel, Context, SidePanel, ThemePreference, TopBottomPanel, Vec2, ViewportCommand};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use textures::Textures;

/// The camera is at rest after this time without a movement.
const REST: Duration = Duration::from_millis(150);
/// Longest delay until news of a running graph is drawn.
const SOON: Duration = Duration::from_millis(100);
/// Display time of a message.
const MESSAGE: Duration = Duration::from_secs(6);

/// Options of the window.
#[derive(Clone, Debug, PartialEq)]
pub struct Options {
    /// Number of threads that render images.
    pub threads: usize,
    /// Folder for screenshots.
    pub folder: PathBuf,
    /// Dark, light, or the system's preference.
    pub theme: ThemePreference,
    /// Path of one image of the window, and the earliest time to save it. The window then closes.
    pub one_shot: Option<(PathBuf, Duration)>,
}

/// Handle that wakes the window from other threads, once the window exists.
#[derive(Clone, Default)]
pub struct Waker(Arc<OnceLock<Context>>);

impl Waker {
    /// Redraws the window.
    pub fn wake(&self) {
        if let Some(ctx) = self.0.get() {
            ctx.request_repaint();
        }
    }

    /// Redraws the window soon, once for all news until then.
    pub fn wake_soon(&self) {
        if let Some(ctx) = self.0.get() {
            ctx.request_repaint_after(SOON);
        }
    }
}

/// The chosen image of the dataset.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Choice {
    /// The hidden branch.
    pub branch: usize,
    /// Time step of the branch.
    pub timestamp: usize,
    /// The camera pose.
    pub view: usize,
    /// Visibility of the actor that the previous and next image must have; `None`: any.
    pub shows: Option<Observability>,
}

/// Overlays on the scene.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Overlays {
    /// Shows the probed boxes.
    pub boxes: bool,
    /// Shows the densities in the boxes.
    pub densities: bool,
}

struct Message {
    text: String,
    is_error: bool,
    since: Instant,
}

type Latent = [f32; LATENT_DIM];

/// The viewer's window.
pub struct Viewer {
    /// Image, forecasts and probes, independent of the window.
    pub session: Session,
    /// The camera that the user moves.
    pub camera: OrbitCamera,
    /// The chosen image of the dataset.
    pub choice: Choice,
    /// Overlays on the scene.
    pub overlays: Overlays,
    /// True while the help is open.
    pub shows_help: bool,
    /// True while the frames of the running graph are shown as they arrive.
    pub is_following: bool,
    /// Longest side of the finest view, pixels.
    pub finest_px: u32,
    album: Result<Album, String>,
    live: Option<LiveFeed>,
    /// The checkpoint of the run, if it differs from this window's.
    other_checkpoint: Option<PathBuf>,
    worker: RenderWorker,
    waker: Waker,
    textures: Textures,
    options: Options,
    slice_height_m: f32,
    message: Option<Message>,
    /// Size of the view in the window, pixels.
    view_px: [u32; 2],
    moved: Option<Instant>,
    asked_view: Asked<(Latent, PinholeCamera, RenderPace)>,
    asked_birds_eye: Asked<(Latent, PinholeCamera)>,
    asked_slice: Asked<(Latent, f32)>,
    asked_thumbnails: Asked<(Vec<Latent>, PinholeCamera)>,
    /// Scenes of the displayed images.
    drawn: DrawnOf,
    /// The scenes shown last, newest at the end. Images arrive later than their requests.
    recent: VecDeque<Recent>,
    /// The newest view, and its render time.
    view: Option<(Image, f64)>,
    /// Number of rendered views.
    views_drawn: u64,
    shot_asked: bool,
    started: Instant,
}

impl Viewer {
    /// Creates a window on a session. `album` is the dataset to choose images from, or the reason why there is none.
    pub fn new(
        session: Session,
        album: Result<Album, String>,
        live: Option<LiveFeed>,
        options: Options,
        waker: Waker,
    ) -> std::io::Result<Self> {
        let field = session.models().field().clone();
        let bounds_m = session.models().bounds_m();
        let wake = waker.clone();
        let places = session.models().probe.layout().places();
        let other_checkpoint = live.as_ref().and_then(|live| other_checkpoint(live, &session));
        let middle_m =
            carff_base::statistics::mean(&places.iter().map(|p| p.oriented_box.center[2]).collect::<Vec<_>>());
        Ok(Self {
            camera: OrbitCamera::over_corner(bounds_m),
            choice: Choice { branch: 0, timestamp: 0, view: 0, shows: None },
            overlays: Overlays { boxes: true, densities: true },
            shows_help: false,
            is_following: live.is_some(),
            album,
            live,
            other_checkpoint,
            worker: RenderWorker::start(field, options.threads, move || wake.wake())?,
            waker,
            textures: Textures::default(),
            options,
            finest_px: 448,
            slice_height_m: middle_m.unwrap_or(1.0) as f32,
            message: None,
            view_px: [320, 240],
            moved: None,
            asked_view: Asked::new(),
            asked_birds_eye: Asked::new(),
            asked_slice: Asked::new(),
            asked_thumbnails: Asked::new(),
            drawn: DrawnOf::default(),
            recent: VecDeque::new(),
            view: None,
            views_drawn: 0,
            shot_asked: false,
            started: Instant::now(),
            session,
        })
    }

    /// Draws the window and runs the commands that were given in it.
    pub fn show(&mut self, ctx: &Context) {
        if self.waker.0.set(ctx.clone()).is_ok() {
            // Fonts take effect in the next frame.
            theme::install(ctx);
            ctx.set_theme(self.options.theme);
            ctx.request_repaint();
            return;
        }
        self.take_live();
        self.take_drawn(ctx);
        self.remember();
        self.take_files(ctx);
        let mut commands = Vec::new();
        if !ctx.wants_keyboard_input() {
            commands = ctx.input_mut(WindowCommand::pressed);
        }
        self.lay_out(ctx, &mut commands);
        for command in commands {
            self.run(command, ctx);
        }
        self.ask(ctx);
        self.take_shot(ctx);
    }

    fn lay_out(&mut self, ctx: &Context, commands: &mut Vec<WindowCommand>) {
        let palette = theme::palette(ctx);
        let frame = theme::pane(palette);
        let Vec2 { x: width, y: height } = ctx.content_rect().size();
        TopBottomPanel::top("bar").frame(frame).show_separator_line(false).show(ctx, |ui| self.top_bar(ui, commands));
        TopBottomPanel::bottom("journal")
            .frame(frame)
            .show_separator_line(false)
            .resizable(true)
            .default_height((height * 0.2).clamp(110.0, 176.0))
            .height_range(90.0..=420.0)
            .show(ctx, |ui| self.journal_pane(ui));
        SidePanel::left("input")
            .frame(frame)
            .show_separator_line(false)
            .resizable(true)
            .default_width((width * 0.21).clamp(190.0, 236.0))
            .width_range(190.0..=420.0)
            .show(ctx, |ui| self.input_pane(ui, commands));
        SidePanel::right("belief")
            .frame(frame)
            .show_separator_line(false)
            .resizable(true)
            .default_width((width * 0.26).clamp(240.0, 316.0))
            .width_range(240.0..=520.0)
            .show(ctx, |ui| self.belief_pane(ui));
        TopBottomPanel::bottom("scenes").frame(frame).show_separator_line(false).show(ctx, |ui| self.scenes_strip(ui));
        CentralPanel::default()
            .frame(egui::Frame::new().fill(palette.ground))
            .show(ctx, |ui| self.scene_pane(ui, commands));
        if ctx.input(|input| input.key_pressed(egui::Key::Escape)) {
            (self.shows_help, self.message) = (false, None);
        }
        if self.shows_help {
            help::show(ctx, &mut self.shows_help);
        }
        self.show_message(ctx);
    }

    fn show_message(&mut self, ctx: &Context) {
        let Some(message) = &self.message else { return };
        let age = message.since.elapsed();
        if age > MESSAGE {
            self.message = None;
            return;
        }
        ctx.request_repaint_after(MESSAGE.saturating_sub(age));
        let palette = theme::palette(ctx);
        let color = if message.is_error { palette.error } else { palette.clear };
        egui::Area::new("message".into())
            .anchor(egui::Align2::CENTER_TOP, [0.0, 64.0])
            .order(egui::Order::Foreground)
            .interactable(false)
            .show(ctx, |ui| {
                let frame = theme::pane(palette).fill(palette.raised).corner_radius(8);
                frame.stroke(egui::Stroke::new(1.0, color)).show(ui, |ui| {
                    ui.set_max_width(520.0);
                    ui.label(egui::RichText::new(&message.text).color(color));
                });
            });
    }

    /// Shows a message for a few seconds.
    fn say(&mut self, text: impl Into<String>, is_error: bool) {
        self.message = Some(Message { text: text.into(), is_error, since: Instant::now() });
    }

    /// Returns the current message.
    pub fn message(&self) -> Option<&str> {
        self.message.as_ref().map(|m| m.text.as_str())
    }

    fn take_live(&mut self) {
        if let Some(moments) = self.live.as_ref().filter(|_| self.is_following).and_then(LiveFeed::take_newest) {
            self.session.follow(moments);
        }
    }

    /// Loads images that were dropped on the window.
    fn take_files(&mut self, ctx: &Context) {
        let paths: Vec<PathBuf> =
            ctx.input(|input| input.raw.dropped_files.iter().filter_map(|file| file.path.clone()).collect());
        if let Some(path) = paths.first() {
            let done =
                ChosenImage::load_png(path).map_err(|e| e.to_string()).and_then(|input| self.toggle_input(input));
            if let Err(why) = done {
                self.say(why, true);
            }
        }
    }

    /// Saves a requested image of the window, or requests the one that a one-shot window saves.
    fn take_shot(&mut self, ctx: &Context) {
        let arrived = shots::arrived(ctx);
        if let Some((path, after)) = self.options.one_shot.clone() {
            if let Some(window) = arrived {
                if let Err(error) = shots::save_window(&window, &path) {
                    eprintln!("error: {error}");
                }
                ctx.send_viewport_cmd(ViewportCommand::Close);
            } else if !self.shot_asked {
                if self.is_drawn() && self.started.elapsed() >= after {
                    self.shot_asked = true;
                    shots::request(ctx);
                }
                ctx.request_repaint_after(REST);
            }
        } else if let Some(window) = arrived {
            let saved = shots::free_name(&self.options.folder, "window")
                .and_then(|path| shots::save_window(&window, &path).map(|()| path));
            match saved {
                Ok(path) => self.say(format!("saved {}", path.display()), false),
                Err(error) => self.say(error.to_string(), true),
            }
        }
    }
}

/// Returns the checkpoint of a run if it differs from the session's.
fn other_checkpoint(live: &LiveFeed, session: &Session) -> Option<PathBuf> {
    let of_run = live.watched().run.checkpoint.clone();
    let whole = |path: &Path| path.canonicalize().unwrap_or_else(|_| path.to_owned());
    (whole(&of_run) != whole(&session.models().dir)).then_some(of_run)
}

impl eframe::App for Viewer {
    fn update(&mut self, ctx: &Context, _: &mut eframe::Frame) {
        self.show(ctx);
    }
}
