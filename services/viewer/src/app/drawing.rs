//! Requests to the renderer, and the images that arrive.

use super::{Latent, REST, Viewer};
use crate::camera::OrbitCamera;
use crate::render::{Drawn, Job, RenderPace, View};
use crate::session::{Found, Scene};
use carff_base::geometry::PinholeCamera;
use eframe::egui::Context;
use std::time::{Duration, Instant};

/// Sides of a small image of a scene, pixels.
const THUMBNAIL_PX: [u32; 2] = [80, 60];
/// Longest side of the image from above, pixels.
const BIRDS_EYE_PX: u32 = 128;
/// Points along the longer side of a slice.
const SLICE_PX: u32 = 160;
/// Shortest interval between views while a graph is followed. Other images are drawn less often.
const FOLLOW_VIEW: Duration = Duration::from_millis(200);
const FOLLOW_REST: Duration = Duration::from_secs(1);
/// Most recent scenes whose images may still arrive.
const MOST_RECENT: usize = 64;
/// Interval at which an idle window checks for news while a graph is watched.
const WATCH: Duration = Duration::from_millis(500);

/// A scene that was shown, with the result of probing it.
pub(super) struct Recent {
    pub scene: Scene,
    pub found: Option<Found>,
}

/// Scenes of the displayed images.
#[derive(Default)]
pub(super) struct DrawnOf {
    pub view: Latent,
    pub birds_eye: Latent,
    pub slice: Latent,
}

/// The last request to the renderer, with its time.
pub(super) struct Asked<T> {
    job: Option<T>,
    at: Instant,
}

impl<T: PartialEq> Asked<T> {
    pub fn new() -> Self {
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

impl Viewer {
    pub(super) fn take_drawn(&mut self, ctx: &Context) {
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
    pub(super) fn remember(&mut self) {
        let Some(scene) = self.session.shown() else { return };
        let found = self.session.moment().and_then(|m| m.found.clone());
        self.recent.retain(|recent| recent.scene.latent != scene.latent);
        self.recent.push_back(Recent { scene, found });
        if self.recent.len() > MOST_RECENT {
            self.recent.pop_front();
        }
    }

    /// Returns the remembered scene of an image.
    pub(super) fn recent(&self, latent: &Latent) -> Option<&Recent> {
        self.recent.iter().rev().find(|recent| recent.scene.latent == *latent)
    }

    /// Returns true if all images of the shown scene are drawn; while a graph is followed, if any is.
    pub fn is_drawn(&self) -> bool {
        if self.is_following {
            return self.view.is_some();
        }
        let is_drawn = self.view.is_some() && self.worker.is_idle();
        is_drawn || self.session.moment().is_none()
    }

    pub(super) fn is_moving(&self) -> bool {
        self.moved.is_some_and(|at| at.elapsed() < REST)
    }

    /// Requests the missing images.
    pub(super) fn ask(&mut self, ctx: &Context) {
        let Some(scene) = self.session.shown() else { return };
        let latent = scene.latent;
        let (of_view, of_rest) =
            if self.is_following { (FOLLOW_VIEW, FOLLOW_REST) } else { (Duration::ZERO, Duration::ZERO) };
        let pace = match (self.is_moving(), self.is_following) {
            (true, _) => RenderPace::Moving,
            (false, true) => RenderPace::Steady,
            (false, false) => RenderPace::Resting,
        };
        if pace == RenderPace::Moving {
            ctx.request_repaint_after(REST);
        }
        let camera = self.camera.pinhole(self.view_px[0], self.view_px[1]);
        let not_within = if pace == RenderPace::Steady { of_view } else { Duration::ZERO };
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
        if pace != RenderPace::Moving {
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
    pub(super) fn above(&self) -> PinholeCamera {
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
}
