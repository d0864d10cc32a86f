//! The window: one file per pane. The panes only show values that other modules compute.

mod belief_pane;
mod commands;
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

pub use commands::Command;
pub use shots::ShotError;
pub use theme::icon;

use crate::camera::OrbitCamera;
use crate::input::{Album, Input};
use crate::live::LiveFeed;
use crate::render::{Drawn, Job, Pace, RenderWorker, View};
use crate::session::{Found, Scene, Selection, Session};
use carff_base::geometry::PinholeCamera;
use carff_dataset::{Image, Observability};
use carff_field::LATENT_DIM;
use eframe::egui::{self, CentralPanel, Context, SidePanel, ThemePreference, TopBottomPanel, Vec2, ViewportCommand};
use std::collections::VecDeque;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};
use std::time::{Duration, Instant};
use textures::Textures;

/// Sides of a small image of a scene, pixels.
const THUMBNAIL_PX: [u32; 2] = [80, 60];
/// Longest side of the image from above, pixels.
const BIRDS_EYE_PX: u32 = 128;
/// Points along the longer side of a slice.
const SLICE_PX: u32 = 160;
/// Shortest interval between views while a graph is followed. Other images are drawn less often.
const FOLLOW_VIEW: Duration = Duration::from_millis(200);
const FOLLOW_REST: Duration = Duration::from_secs(1);
/// The camera is at rest after this time without a movement.
const REST: Duration = Duration::from_millis(150);
/// Most recent scenes whose images may still arrive.
const MOST_RECENT: usize = 64;
/// Longest delay until news of a running graph is drawn.
const SOON: Duration = Duration::from_millis(100);
/// Display time of a message.
const MESSAGE: Duration = Duration::from_secs(6);
/// Interval at which an idle window checks for news while a graph is watched.
const WATCH: Duration = Duration::from_millis(500);

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

/// A scene that was shown, with the result of probing it.
struct Recent {
    scene: Scene,
    found: Option<Found>,
}

/// Scenes of the displayed images.
#[derive(Default)]
struct DrawnOf {
    view: Latent,
    birds_eye: Latent,
    slice: Latent,
}

struct Message {
    text: String,
    is_error: bool,
    since: Instant,
}

/// The last request to the renderer, with its time.
struct Asked<T> {
    job: Option<T>,
    at: Instant,
}

impl<T: PartialEq> Asked<T> {
    fn new() -> Self {
        Self { job: None, at: Instant::now() }
    }

    /// Returns whether a job is due; `None` if it must wait.
    fn is_due(&mut self, job: T, not_within: Duration) -> Option<bool> {
        if self.job.as_ref() == Some(&job) {
            return Some(false);
        }
        if self.job.is_some() && self.at.elapsed() < not_within {
            return None;
        }
        (self.job, self.at) = (Some(job), Instant::now());
        Some(true)
    }
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
    asked_view: Asked<(Latent, PinholeCamera, Pace)>,
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
            commands = ctx.input_mut(Command::pressed);
        }
        self.lay_out(ctx, &mut commands);
        for command in commands {
            self.run(command, ctx);
        }
        self.ask(ctx);
        self.take_shot(ctx);
    }

    fn lay_out(&mut self, ctx: &Context, commands: &mut Vec<Command>) {
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

    /// Returns an error with the reason if a command would have no effect now.
    pub fn can(&self, command: Command) -> Result<(), String> {
        let is = |there: bool, why: &str| if there { Ok(()) } else { Err(why.to_owned()) };
        let history = self.session.history();
        match command {
            Command::Toggle => {
                let any = self.album.is_ok() || self.session.moment().is_some();
                is(any, "no image yet: drop a PNG image here, pass --dataset, or attach to a run")
            }
            Command::Predict => self.session.can_predict().map_err(|e| e.to_string()),
            Command::Probe => is(self.session.moment().is_some(), "no image yet: press Toggle"),
            Command::ProbeAndPredict => self.session.can_advance().map_err(|e| e.to_string()),
            Command::Back => is(history.has_back(), "this is the beginning"),
            Command::Forward => is(history.has_forward(), "this is the end"),
            Command::PictureBefore | Command::PictureAfter => is(self.album.is_ok(), "no dataset to choose from"),
            Command::Follow => is(self.live.is_some(), "no running graph is attached"),
            Command::CameraPicture => {
                let known = self.session.moment().is_some_and(|m| m.input.camera.is_some());
                is(known, "the camera pose of this image is unknown")
            }
            Command::SaveView => is(self.view.is_some(), "no scene has been rendered yet"),
            _ => Ok(()),
        }
    }

    /// Runs a command.
    pub fn run(&mut self, command: Command, ctx: &Context) {
        if let Err(why) = self.can(command) {
            self.say(why, true);
            return;
        }
        let done = match command {
            Command::Toggle => self.toggle(),
            Command::Predict => self.predict(),
            Command::Probe => {
                self.is_following = false;
                self.session.probe().map_err(|e| e.to_string())
            }
            Command::ProbeAndPredict => {
                self.is_following = false;
                self.session.probe_and_predict().map_err(|e| e.to_string())
            }
            Command::Back => {
                self.session.back();
                Ok(())
            }
            Command::Forward => {
                self.session.forward();
                Ok(())
            }
            Command::SceneBefore => self.select_by(-1),
            Command::SceneAfter => self.select_by(1),
            Command::PictureBefore => self.leaf(false),
            Command::PictureAfter => self.leaf(true),
            Command::Follow => {
                self.is_following = !self.is_following;
                Ok(())
            }
            Command::CameraCorner => {
                self.camera = OrbitCamera::over_corner(self.session.models().bounds_m());
                Ok(())
            }
            Command::CameraAbove => {
                self.camera = OrbitCamera::above(self.session.models().bounds_m());
                Ok(())
            }
            Command::CameraPicture => {
                if let Some(camera) = self.session.moment().and_then(|m| m.input.camera) {
                    let ground_m = self.session.models().bounds_m()[0][2];
                    self.camera = OrbitCamera::from_pinhole(&camera, ground_m);
                }
                Ok(())
            }
            Command::Boxes => {
                self.overlays.boxes = !self.overlays.boxes;
                Ok(())
            }
            Command::Densities => {
                self.overlays.densities = !self.overlays.densities;
                Ok(())
            }
            Command::Screenshot => {
                shots::request(ctx);
                Ok(())
            }
            Command::SaveView => self.save_view(),
            Command::Theme => {
                let theme = if ctx.theme() == egui::Theme::Dark { egui::Theme::Light } else { egui::Theme::Dark };
                ctx.set_theme(theme);
                Ok(())
            }
            Command::Help => {
                self.shows_help = !self.shows_help;
                Ok(())
            }
            Command::Quit => {
                ctx.send_viewport_cmd(ViewportCommand::Close);
                Ok(())
            }
        };
        if let Err(why) = done {
            self.say(why, true);
        }
    }

    /// Shows the scene of the current image before any forecast, or of the chosen image if there is no current one.
    fn toggle(&mut self) -> Result<(), String> {
        if std::mem::take(&mut self.is_following) {
            // The graph supplied the posterior.
            self.session.go_to(0);
            return Ok(());
        }
        match self.session.moment() {
            Some(moment) => self.toggle_input(moment.input.clone()),
            None => self.toggle_chosen(),
        }
    }

    /// Shows the scene of the image that is chosen from the dataset.
    fn toggle_chosen(&mut self) -> Result<(), String> {
        let Choice { branch, timestamp, view, .. } = self.choice;
        let none = || format!("the dataset has no image of branch {branch}, t{timestamp}, view {view}");
        let album = self.album.as_ref().map_err(Clone::clone)?;
        let models = self.session.models();
        let state = models.state(branch, timestamp).ok_or_else(none)?;
        let input = album.input(state, view, models).map_err(|e| e.to_string())?.ok_or_else(none)?;
        self.toggle_input(input)
    }

    /// Starts with an image that does not reveal the branch, if the dataset has one.
    pub fn begin(&mut self) {
        if let Ok(album) = &self.album {
            let state = self.session.models().state(0, 0).unwrap_or(0);
            let hidden = album.next_view(state, self.choice.view, true, Some(Observability::None));
            self.choice.view = hidden.unwrap_or(self.choice.view);
            if let Err(why) = self.toggle_chosen() {
                self.say(why, true);
            }
        }
    }

    /// Shows the scene of an image.
    pub fn toggle_input(&mut self, input: Arc<Input>) -> Result<(), String> {
        self.is_following = false;
        self.session.toggle(input).map_err(|e| e.to_string())
    }

    fn predict(&mut self) -> Result<(), String> {
        if self.is_following {
            self.is_following = false;
            // The graph made these forecasts.
            if self.session.go_to(1) {
                return Ok(());
            }
        }
        self.session.predict().map_err(|e| e.to_string())
    }

    fn select(&mut self, selection: Selection) {
        if let Err(error) = self.session.select(selection) {
            self.say(error.to_string(), true);
        }
    }

    fn select_by(&mut self, by: isize) -> Result<(), String> {
        let scenes = self.session.scenes();
        let shown = self.session.moment().map(|m| m.selection);
        let at = scenes.iter().position(|s| Some(s.selection) == shown).unwrap_or(0);
        let Some(scene) = at.checked_add_signed(by).and_then(|at| scenes.get(at)) else { return Ok(()) };
        self.session.select(scene.selection).map_err(|e| e.to_string())
    }

    /// Shows the next image of the dataset with the chosen visibility.
    fn leaf(&mut self, forwards: bool) -> Result<(), String> {
        let Ok(album) = &self.album else { return Ok(()) };
        let Choice { branch, timestamp, view, shows } = self.choice;
        let state = self.session.models().state(branch, timestamp);
        let next = state.and_then(|state| album.next_view(state, view, forwards, shows));
        let none = || {
            let much = shows.map_or("any", Observability::name);
            format!("no view of this state has the chosen visibility of the actor: {much}")
        };
        self.choice.view = next.ok_or_else(none)?;
        self.toggle_chosen()
    }

    fn save_view(&mut self) -> Result<(), String> {
        let Some((image, _)) = &self.view else { return Ok(()) };
        let path = shots::free_name(&self.options.folder, "scene").map_err(|e| e.to_string())?;
        shots::save_image(image, &path).map_err(|e| e.to_string())?;
        self.say(format!("saved {}", path.display()), false);
        Ok(())
    }

    fn take_live(&mut self) {
        if let Some(moments) = self.live.as_ref().filter(|_| self.is_following).and_then(LiveFeed::take_newest) {
            self.session.follow(moments);
        }
    }

    fn take_drawn(&mut self, ctx: &Context) {
        for drawn in self.worker.take() {
            match drawn {
                Drawn::View { latent, image, took_ms, .. } => {
                    self.textures.set_view(ctx, &image);
                    self.drawn.view = latent;
                    self.session.journal.took("view", self.views_drawn as f64, took_ms);
                    self.views_drawn += 1;
                    self.view = Some((image, took_ms));
                }
                Drawn::BirdsEye { latent, image } => {
                    self.textures.set_birds_eye(ctx, &image);
                    self.drawn.birds_eye = latent;
                }
                Drawn::Slice { latent, image } => {
                    self.textures.set_slice(ctx, image);
                    self.drawn.slice = latent;
                }
                Drawn::Thumbnail { index, image, .. } => self.textures.set_thumbnail(ctx, index, &image),
            }
        }
    }

    /// Remembers the shown scene, so that images of it that arrive later get the right overlays.
    fn remember(&mut self) {
        let Some(scene) = self.session.shown() else { return };
        let found = self.session.moment().and_then(|m| m.found.clone());
        self.recent.retain(|recent| recent.scene.latent != scene.latent);
        self.recent.push_back(Recent { scene, found });
        if self.recent.len() > MOST_RECENT {
            self.recent.pop_front();
        }
    }

    /// Returns the remembered scene of an image.
    fn recent(&self, latent: &Latent) -> Option<&Recent> {
        self.recent.iter().rev().find(|recent| recent.scene.latent == *latent)
    }

    /// Loads images that were dropped on the window.
    fn take_files(&mut self, ctx: &Context) {
        let paths: Vec<PathBuf> =
            ctx.input(|input| input.raw.dropped_files.iter().filter_map(|file| file.path.clone()).collect());
        if let Some(path) = paths.first() {
            let done = Input::load_png(path).map_err(|e| e.to_string()).and_then(|input| self.toggle_input(input));
            if let Err(why) = done {
                self.say(why, true);
            }
        }
    }

    /// Returns true if all images of the shown scene are drawn; while a graph is followed, if any is.
    pub fn is_drawn(&self) -> bool {
        if self.is_following {
            return self.view.is_some();
        }
        let is_drawn = self.view.is_some() && self.worker.is_idle();
        is_drawn || self.session.moment().is_none()
    }

    fn is_moving(&self) -> bool {
        self.moved.is_some_and(|at| at.elapsed() < REST)
    }

    /// Requests the missing images.
    fn ask(&mut self, ctx: &Context) {
        let Some(scene) = self.session.shown() else { return };
        let latent = scene.latent;
        let (of_view, of_rest) =
            if self.is_following { (FOLLOW_VIEW, FOLLOW_REST) } else { (Duration::ZERO, Duration::ZERO) };
        let pace = match (self.is_moving(), self.is_following) {
            (true, _) => Pace::Moving,
            (false, true) => Pace::Steady,
            (false, false) => Pace::Resting,
        };
        if pace == Pace::Moving {
            ctx.request_repaint_after(REST);
        }
        let camera = self.camera.pinhole(self.view_px[0], self.view_px[1]);
        let not_within = if pace == Pace::Steady { of_view } else { Duration::ZERO };
        let mut is_late = false;
        let mut due = |due: Option<bool>| {
            is_late |= due.is_none();
            due == Some(true)
        };
        if due(self.asked_view.is_due((latent, camera, pace), not_within)) {
            self.worker.ask(Job::View(View::new(latent, camera, pace)));
        }
        let above = self.above();
        if due(self.asked_birds_eye.is_due((latent, above), of_rest)) {
            self.worker.ask(Job::BirdsEye { latent, camera: above });
        }
        let height_m = self.slice_height_m;
        if due(self.asked_slice.is_due((latent, height_m), of_view)) {
            self.worker.ask(Job::Slice { latent, height_m, longest_px: SLICE_PX });
        }
        if pace != Pace::Moving {
            let latents: Vec<Latent> = self.session.scenes().iter().map(|s| s.latent).collect();
            let camera = self.camera.pinhole(THUMBNAIL_PX[0], THUMBNAIL_PX[1]);
            // Images of a followed graph are always finished; otherwise the last one would never be.
            let owes = self.is_following && self.worker.owes_thumbnails();
            let not_within = if owes { Duration::MAX } else { of_rest };
            if due(self.asked_thumbnails.is_due((latents.clone(), camera), not_within)) {
                self.worker.ask(Job::Thumbnails { latents, camera, done: 0 });
            }
        }
        if is_late {
            ctx.request_repaint_after(FOLLOW_VIEW);
        }
        if self.live.is_some() {
            ctx.request_repaint_after(WATCH);
        }
    }

    /// Returns the camera that looks straight down on the region of interest, with the region's aspect ratio.
    fn above(&self) -> PinholeCamera {
        let [low, high] = self.session.models().bounds_m();
        let extent_m = [high[0] - low[0], high[1] - low[1]];
        let longest_m = extent_m[0].max(extent_m[1]);
        let [width_px, height_px] = extent_m.map(|e| ((e / longest_m * f64::from(BIRDS_EYE_PX)) as u32).max(1));
        let mut camera = OrbitCamera::above([low, high]);
        // Its field of view covers the shorter side.
        let shorter_m = extent_m[0].min(extent_m[1]);
        camera.fov_deg = 2.0 * (shorter_m / 2.0 / camera.distance_m).atan().to_degrees();
        camera.pinhole(width_px, height_px)
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
