//! Waiting requests, the order of their turns, and finished images.

use carff_base::geometry::PinholeCamera;
use carff_dataset::Image;
use carff_field::LATENT_DIM;
use std::sync::atomic::AtomicU64;
use std::sync::{Condvar, Mutex, MutexGuard, PoisonError};

/// Index of the thumbnail job.
pub(super) const THUMBNAILS: usize = 3;

/// A render request.
#[derive(Clone, Debug, PartialEq)]
pub enum Job {
    /// The scene from the user's camera.
    View(View),
    /// The scene from above.
    BirdsEye {
        /// Latent of the scene.
        latent: [f32; LATENT_DIM],
        /// Pose and size of the image.
        camera: PinholeCamera,
    },
    /// The density of the scene at a height.
    Slice {
        /// Latent of the scene.
        latent: [f32; LATENT_DIM],
        /// The height, metres.
        height_m: f32,
        /// Points along the longer side.
        longest_px: u32,
    },
    /// Several scenes from one camera, small.
    Thumbnails {
        /// Latents of the scenes.
        latents: Vec<[f32; LATENT_DIM]>,
        /// Pose and size of each image.
        camera: PinholeCamera,
        /// Number of finished thumbnails.
        done: usize,
    },
}

/// Resolution and urgency of a view.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum RenderPace {
    /// The camera is moving: one coarse image at once.
    Moving,
    /// The scene changes by itself: one image, always of the same resolution.
    Steady,
    /// Nothing moves: a coarse image, then finer ones up to full resolution.
    Resting,
}

/// A view to render.
#[derive(Clone, Debug, PartialEq)]
pub struct View {
    /// Latent of the scene.
    pub latent: [f32; LATENT_DIM],
    /// Pose and final size of the image.
    pub camera: PinholeCamera,
    /// Resolution and urgency of the view.
    pub pace: RenderPace,
    /// Remaining divisors of the sides, one image each; empty: not started.
    pub divisors: Vec<u32>,
    /// Number of the request: only the newest is refined.
    pub(super) number: u64,
}

impl View {
    /// Returns a view that has not been started.
    pub fn new(latent: [f32; LATENT_DIM], camera: PinholeCamera, pace: RenderPace) -> Self {
        Self { latent, camera, pace, divisors: Vec::new(), number: 0 }
    }
}

impl Job {
    /// Returns the index of the job's kind.
    pub(super) fn kind(&self) -> usize {
        match self {
            Self::View(_) => 0,
            Self::BirdsEye { .. } => 1,
            Self::Slice { .. } => 2,
            Self::Thumbnails { .. } => THUMBNAILS,
        }
    }
}

/// A rendered image.
#[derive(Clone, Debug, PartialEq)]
pub enum Drawn {
    /// A view.
    View {
        /// Latent of the scene.
        latent: [f32; LATENT_DIM],
        /// The image, coarse or fine.
        image: Image,
        /// Camera of the requested size.
        camera: PinholeCamera,
        /// True if the image has the requested size.
        is_final: bool,
        /// Render time, milliseconds.
        took_ms: f64,
    },
    /// A scene from above.
    BirdsEye {
        /// Latent of the scene.
        latent: [f32; LATENT_DIM],
        /// The image.
        image: Image,
    },
    /// Density at a height.
    Slice {
        /// Latent of the scene.
        latent: [f32; LATENT_DIM],
        /// The image: brightness is the share of absorbed light.
        image: Image,
    },
    /// A thumbnail of one of several scenes.
    Thumbnail {
        /// Index of the scene.
        index: usize,
        /// Latent of the scene.
        latent: [f32; LATENT_DIM],
        /// The image.
        image: Image,
    },
}

impl Drawn {
    /// Returns true if another job replaces this one.
    fn is_replaced_by(&self, other: &Self) -> bool {
        match (self, other) {
            (Self::Thumbnail { index: a, .. }, Self::Thumbnail { index: b, .. }) => a == b,
            _ => std::mem::discriminant(self) == std::mem::discriminant(other),
        }
    }
}

/// Waiting jobs and finished images.
#[derive(Default)]
pub(super) struct Desk {
    /// At most one job per kind, with its turn: the lowest is next. A job that replaces another one takes its turn.
    pub(super) waiting: Vec<(u64, Job)>,
    turns: u64,
    /// Kind of the job in work.
    pub(super) working: Option<usize>,
    pub(super) is_stopped: bool,
    /// Images that the window has not taken yet.
    pub(super) done: Vec<Drawn>,
}

impl Desk {
    pub(super) fn put(&mut self, job: Job) {
        self.turns += 1;
        let in_a_hurry = matches!(&job, Job::View(view) if view.pace == RenderPace::Moving);
        let turn = if in_a_hurry { 0 } else { self.turns };
        match self.waiting.iter_mut().find(|(_, other)| other.kind() == job.kind()) {
            Some((earlier, other)) => (*earlier, *other) = (turn.min(*earlier), job),
            None => self.waiting.push((turn, job)),
        }
    }

    /// Puts back the rest of a started job, unless a newer one of its kind waits.
    pub(super) fn put_back(&mut self, job: Job) {
        if !self.waiting.iter().any(|(_, other)| other.kind() == job.kind()) {
            self.put(job);
        }
    }

    pub(super) fn take(&mut self) -> Option<Job> {
        let next = (0..self.waiting.len()).min_by_key(|&i| self.waiting[i].0)?;
        Some(self.waiting.swap_remove(next).1)
    }

    pub(super) fn deliver(&mut self, drawn: Drawn) {
        self.done.retain(|other| !other.is_replaced_by(&drawn));
        self.done.push(drawn);
    }
}

/// The desk, between the window and the thread that renders.
#[derive(Default)]
pub(super) struct Shared {
    desk: Mutex<Desk>,
    /// Called when a job waits or the thread must end.
    pub(super) called: Condvar,
    /// Number of the newest requested view.
    pub(super) newest_view: AtomicU64,
}

impl Shared {
    /// Locks the desk. Its contents are consistent at any time, so a poisoned lock is harmless.
    pub(super) fn desk(&self) -> MutexGuard<'_, Desk> {
        self.desk.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn camera(width_px: u32, height_px: u32) -> PinholeCamera {
        PinholeCamera::look_at([3.0, -20.0, 9.0], [0.0; 3], [0.0, 0.0, 1.0], width_px, height_px, 50.0)
    }

    /// A waiting job keeps its turn when a newer request replaces it; a view in motion goes first.
    #[test]
    fn turns_are_kept() {
        let mut desk = Desk::default();
        let latent = [0.0; LATENT_DIM];
        let view = |pace| Job::View(View::new(latent, camera(8, 8), pace));
        let slice = |height_m| Job::Slice { latent, height_m, longest_px: 8 };
        desk.put(slice(1.0));
        desk.put(Job::BirdsEye { latent, camera: camera(8, 8) });
        desk.put(view(RenderPace::Resting));
        desk.put(slice(2.0));
        assert_eq!(desk.take(), Some(slice(2.0)));
        desk.put(slice(3.0));
        desk.put(view(RenderPace::Moving));
        assert_eq!(desk.take(), Some(view(RenderPace::Moving)));
        assert!(matches!(desk.take(), Some(Job::BirdsEye { .. })));
        desk.put_back(slice(4.0));
        assert_eq!((desk.take(), desk.take()), (Some(slice(3.0)), None));
    }
}
