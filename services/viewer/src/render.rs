//! Renders images of scenes on a separate thread. Only the newest request of each kind counts. A view is rendered
//! coarse first, then finer, so that the window stays responsive on a slow machine.

use crate::slice::density_slice;
use carff_base::geometry::PinholeCamera;
use carff_dataset::Image;
use carff_field::{
    Field, HypothesisBuffer, InstructionSet, LATENT_DIM, RenderBuffer, RenderOptions, to_byte, to_bytes,
};
use std::sync::atomic::{AtomicU64, Ordering};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::thread::JoinHandle;
use std::time::Instant;

/// Time budget of a coarse image of a view, milliseconds.
const COARSE_MS: f64 = 40.0;
/// Time budget of an image of a scene that changes by itself, milliseconds.
const STEADY_MS: f64 = 160.0;
/// Assumed render time of a pixel before the first measurement, nanoseconds.
const FIRST_PIXEL_NS: f64 = 6_000.0;
/// Weight of the newest measurement of the pixel time.
const NEWEST_WEIGHT: f64 = 0.3;
/// Minimum length of an image's longer side, pixels: of a view, and of a scene that changes by itself.
const COARSEST_PX: u32 = 56;
const COARSEST_STEADY_PX: u32 = 112;
/// Divisors of a view's sides.
const DIVISORS: [u32; 8] = [1, 2, 3, 4, 6, 8, 12, 16];
/// Number of thumbnails rendered at a time.
const BATCH: usize = 4;
/// Index of the thumbnail job.
const THUMBNAILS: usize = 3;
/// Niceness of the thread: the processes of a running graph come first.
const NICE: i32 = 10;

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
    number: u64,
}

impl View {
    /// Returns a view that has not been started.
    pub fn new(latent: [f32; LATENT_DIM], camera: PinholeCamera, pace: RenderPace) -> Self {
        Self { latent, camera, pace, divisors: Vec::new(), number: 0 }
    }
}

impl Job {
    fn kind(&self) -> usize {
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
struct Desk {
    /// At most one job per kind, with its turn: the lowest is next. A job that replaces another one takes its turn.
    waiting: Vec<(u64, Job)>,
    turns: u64,
    /// Kind of the job in work.
    working: Option<usize>,
    is_stopped: bool,
    done: Vec<Drawn>,
}

impl Desk {
    fn put(&mut self, job: Job) {
        self.turns += 1;
        let in_a_hurry = matches!(&job, Job::View(view) if view.pace == RenderPace::Moving);
        let turn = if in_a_hurry { 0 } else { self.turns };
        match self.waiting.iter_mut().find(|(_, other)| other.kind() == job.kind()) {
            Some((earlier, other)) => (*earlier, *other) = (turn.min(*earlier), job),
            None => self.waiting.push((turn, job)),
        }
    }

    /// Puts back the rest of a started job, unless a newer one of its kind waits.
    fn put_back(&mut self, job: Job) {
        if !self.waiting.iter().any(|(_, other)| other.kind() == job.kind()) {
            self.put(job);
        }
    }

    fn take(&mut self) -> Option<Job> {
        let next = (0..self.waiting.len()).min_by_key(|&i| self.waiting[i].0)?;
        Some(self.waiting.swap_remove(next).1)
    }

    fn deliver(&mut self, drawn: Drawn) {
        self.done.retain(|other| !other.is_replaced_by(&drawn));
        self.done.push(drawn);
    }
}

struct Shared {
    desk: Mutex<Desk>,
    called: Condvar,
    /// Number of the newest requested view.
    newest_view: AtomicU64,
}

impl Shared {
    /// Locks the desk. Its contents are consistent at any time, so a poisoned lock is harmless.
    fn desk(&self) -> MutexGuard<'_, Desk> {
        self.desk.lock().unwrap_or_else(PoisonError::into_inner)
    }
}

/// Renders on its own thread until the worker is dropped.
pub struct RenderWorker {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl RenderWorker {
    /// Starts the thread. It renders with `threads` threads and calls `wake` when it has a result.
    pub fn start(mut field: Field, threads: usize, wake: impl Fn() + Send + 'static) -> std::io::Result<Self> {
        field.set_instruction_set(InstructionSet::detect_for_images());
        let shared =
            Arc::new(Shared { desk: Mutex::default(), called: Condvar::new(), newest_view: AtomicU64::new(0) });
        let theirs = shared.clone();
        let thread = std::thread::Builder::new().name("render".into()).spawn(move || {
            // On Linux this sets the priority of this thread and of the threads that it starts. Rendering also works
            // without it.
            let _ = rustix::process::nice(NICE);
            Painter::new(field, threads).work(&theirs, &wake);
        })?;
        Ok(Self { shared, thread: Some(thread) })
    }

    /// Requests an image. It replaces a waiting request of the same kind.
    pub fn ask(&self, job: Job) {
        let job = match job {
            Job::View(view) => {
                let number = self.shared.newest_view.fetch_add(1, Ordering::Relaxed) + 1;
                Job::View(View { number, ..view })
            }
            other => other,
        };
        self.shared.desk().put(job);
        self.shared.called.notify_one();
    }

    /// Returns the images rendered since the last call, the newest of each kind.
    pub fn take(&self) -> Vec<Drawn> {
        std::mem::take(&mut self.shared.desk().done)
    }

    /// Returns true while requested thumbnails are missing.
    pub fn owes_thumbnails(&self) -> bool {
        let desk = self.shared.desk();
        desk.working == Some(THUMBNAILS) || desk.waiting.iter().any(|(_, job)| job.kind() == THUMBNAILS)
    }

    /// Returns true when all requested images have been rendered and taken.
    pub fn is_idle(&self) -> bool {
        let desk = self.shared.desk();
        desk.waiting.is_empty() && desk.done.is_empty() && desk.working.is_none()
    }
}

impl Drop for RenderWorker {
    fn drop(&mut self) {
        {
            let mut desk = self.shared.desk();
            desk.is_stopped = true;
            desk.waiting.clear();
        }
        // The image in work is abandoned, too.
        self.shared.newest_view.fetch_add(1, Ordering::Relaxed);
        self.shared.called.notify_one();
        if let Some(thread) = self.thread.take() {
            // The thread ends early only by a panic, which has been reported by then.
            let _ = thread.join();
        }
    }
}

/// Returns the divisors of a view's sides, image by image. The first image has at most `budget_px` pixels, or is as
/// coarse as possible (`coarsest_px` along the longer side). Each further image is at least twice as fine; the last one
/// has full size.
fn divisors(width_px: u32, height_px: u32, coarsest_px: u32, budget_px: f64) -> Vec<u32> {
    let pixels = |divisor: u32| f64::from(width_px / divisor) * f64::from(height_px / divisor);
    let longest_px = width_px.max(height_px);
    let allowed = DIVISORS.into_iter().take_while(|d| *d == 1 || longest_px / d >= coarsest_px);
    let mut divisor = 1;
    for coarser in allowed {
        divisor = coarser;
        if pixels(divisor) <= budget_px {
            break;
        }
    }
    let mut all = vec![divisor];
    while divisor > 1 {
        divisor /= 2;
        all.push(divisor);
    }
    all
}

struct Painter {
    field: Field,
    options: RenderOptions,
    buffer: RenderBuffer,
    hypotheses: HypothesisBuffer,
    /// Measured render time of a pixel, nanoseconds.
    pixel_ns: f64,
}

impl Painter {
    fn new(field: Field, threads: usize) -> Self {
        Self {
            field,
            options: RenderOptions { threads: threads.max(1), ..RenderOptions::default() },
            buffer: RenderBuffer::new(),
            hypotheses: HypothesisBuffer::default(),
            pixel_ns: FIRST_PIXEL_NS,
        }
    }

    fn work(&mut self, shared: &Shared, wake: &dyn Fn()) {
        loop {
            let mut desk = shared.desk();
            desk.working = None;
            let job = loop {
                if desk.is_stopped {
                    return;
                }
                match desk.take() {
                    Some(job) => break job,
                    None => desk = shared.called.wait(desk).unwrap_or_else(PoisonError::into_inner),
                }
            };
            desk.working = Some(job.kind());
            drop(desk);
            let (drawn, rest) = self.draw(job, shared);
            let mut desk = shared.desk();
            let any = !drawn.is_empty();
            for drawn in drawn {
                desk.deliver(drawn);
            }
            if let (Some(job), false) = (rest, desk.is_stopped) {
                desk.put_back(job);
            }
            drop(desk);
            if any {
                wake();
            }
        }
    }

    /// Renders a job, or a part of it; returns the images and the rest of the job.
    fn draw(&mut self, job: Job, shared: &Shared) -> (Vec<Drawn>, Option<Job>) {
        match job {
            Job::View(view) => self.draw_view(view, shared),
            Job::BirdsEye { latent, camera } => {
                self.field.render(&camera, &latent, &self.options, &mut self.buffer);
                (vec![Drawn::BirdsEye { latent, image: image_of(&camera, &self.buffer) }], None)
            }
            Job::Slice { latent, height_m, longest_px } => {
                let image = density_slice(&self.field, &latent, height_m, longest_px);
                (vec![Drawn::Slice { latent, image }], None)
            }
            Job::Thumbnails { latents, camera, done } => {
                let end = (done + BATCH).min(latents.len());
                let batch = &latents[done.min(end)..end];
                self.field.render_hypotheses(&camera, batch, &self.options, &mut self.hypotheses);
                let drawn = batch.iter().zip(&self.hypotheses.images).enumerate().map(|(i, (latent, drawn))| {
                    Drawn::Thumbnail { index: done + i, latent: *latent, image: image_of(&camera, drawn) }
                });
                let drawn = drawn.collect();
                (drawn, (end < latents.len()).then_some(Job::Thumbnails { latents, camera, done: end }))
            }
        }
    }

    fn draw_view(&mut self, mut view: View, shared: &Shared) -> (Vec<Drawn>, Option<Job>) {
        let (width_px, height_px) = (view.camera.width_px, view.camera.height_px);
        let begun = !view.divisors.is_empty();
        let mut left = if begun {
            std::mem::take(&mut view.divisors)
        } else {
            let (may_take_ms, coarsest_px) = match view.pace {
                RenderPace::Steady => (STEADY_MS, COARSEST_STEADY_PX),
                RenderPace::Moving | RenderPace::Resting => (COARSE_MS, COARSEST_PX),
            };
            divisors(width_px, height_px, coarsest_px, may_take_ms * 1e6 / self.pixel_ns)
        };
        let divisor = left.remove(0);
        let camera = view.camera.resized((width_px / divisor).max(1), (height_px / divisor).max(1));
        let started = Instant::now();
        // A coarse image is always finished, so that a continuous camera movement stays visible.
        let is_wanted = || !begun || shared.newest_view.load(Ordering::Relaxed) == view.number;
        let Some(image) = self.in_bands(&view.latent, &camera, is_wanted) else { return (Vec::new(), None) };
        let took_ms = started.elapsed().as_secs_f64() * 1e3;
        let pixel_ns = took_ms * 1e6 / (f64::from(camera.width_px) * f64::from(camera.height_px));
        self.pixel_ns += NEWEST_WEIGHT * (pixel_ns - self.pixel_ns);
        let is_final = left.is_empty();
        let drawn = Drawn::View { latent: view.latent, image, camera: view.camera, is_final, took_ms };
        let rest =
            (!is_final && view.pace == RenderPace::Resting).then_some(Job::View(View { divisors: left, ..view }));
        (vec![drawn], rest)
    }

    /// Renders an image in bands, each within the budget of a coarse image. Returns `None` if it is no longer wanted.
    fn in_bands(
        &mut self,
        latent: &[f32; LATENT_DIM],
        camera: &PinholeCamera,
        is_wanted: impl Fn() -> bool,
    ) -> Option<Image> {
        let rows = (COARSE_MS * 1e6 / self.pixel_ns / f64::from(camera.width_px)).max(8.0) as u32;
        let mut rgb = Vec::with_capacity(camera.width_px as usize * camera.height_px as usize * 3);
        for top in (0..camera.height_px).step_by(rows as usize) {
            if !is_wanted() {
                return None;
            }
            let band = PinholeCamera {
                height_px: rows.min(camera.height_px - top),
                cy_px: camera.cy_px - f64::from(top),
                ..*camera
            };
            self.field.render(&band, latent, &self.options, &mut self.buffer);
            rgb.extend(self.buffer.rgb.iter().map(|&value| to_byte(value)));
        }
        Some(Image { width_px: camera.width_px, height_px: camera.height_px, rgb })
    }
}

fn image_of(camera: &PinholeCamera, rendered: &RenderBuffer) -> Image {
    Image { width_px: camera.width_px, height_px: camera.height_px, rgb: to_bytes(&rendered.rgb) }
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_field::FieldConfig;
    use std::sync::mpsc;
    use std::time::Duration;

    /// Longest wait for an image. It only bounds a test that hangs.
    const PATIENCE: Duration = Duration::from_mins(2);

    fn field() -> Field {
        let config = FieldConfig { log2_table_size: 8, occupancy_resolution: 8, ..FieldConfig::default() };
        Field::new(config, 3).unwrap()
    }

    fn camera(width_px: u32, height_px: u32) -> PinholeCamera {
        PinholeCamera::look_at([3.0, -20.0, 9.0], [0.0; 3], [0.0, 0.0, 1.0], width_px, height_px, 50.0)
    }

    /// Returns a worker, and a function that waits until everything is rendered and returns it.
    fn worker() -> (RenderWorker, impl Fn(&RenderWorker) -> Vec<Drawn>) {
        let (told, woken) = mpsc::sync_channel(64);
        let worker = RenderWorker::start(field(), 2, move || told.try_send(()).unwrap_or_default()).unwrap();
        let until_idle = move |worker: &RenderWorker| {
            let mut all = Vec::new();
            let since = Instant::now();
            loop {
                all.extend(worker.take());
                if worker.is_idle() {
                    return all;
                }
                assert!(since.elapsed() < PATIENCE, "rendering has stopped");
                let _ = woken.recv_timeout(Duration::from_millis(20));
            }
        };
        (worker, until_idle)
    }

    /// The first image fits the budget or is the coarsest, each further one is at least twice as fine, and the last has
    /// full size.
    #[test]
    fn views_get_finer() {
        for budget_px in [1.0, 500.0, 3_000.0, 40_000.0, 1e9] {
            let all = divisors(320, 240, 40, budget_px);
            assert!(all.windows(2).all(|pair| pair[1] * 2 <= pair[0]), "{all:?}");
            assert_eq!(all.last(), Some(&1));
            let first = f64::from(320 / all[0]) * f64::from(240 / all[0]);
            assert!(first <= budget_px || all[0] == 8, "{all:?}");
        }
        assert_eq!((divisors(320, 240, 40, 1e9), divisors(30, 20, 40, 1.0)), (vec![1], vec![1]));
    }

    /// A final view equals the field's own image from that camera, for any bands and intermediate sizes.
    #[test]
    fn a_view_ends_as_the_whole_image() {
        let (worker, until_idle) = worker();
        let camera = camera(70, 45);
        worker.ask(Job::View(View::new([0.3; LATENT_DIM], camera, RenderPace::Resting)));
        let drawn = until_idle(&worker);
        let Some(Drawn::View { image, is_final: true, .. }) = drawn.last() else { panic!("{}", drawn.len()) };
        let mut whole = RenderBuffer::new();
        field().render(&camera, &[0.3; LATENT_DIM], &RenderOptions::default(), &mut whole);
        let whole = image_of(&camera, &whole);
        assert_eq!((image.width_px, image.height_px), (70, 45));
        let apart = image.rgb.iter().zip(&whole.rgb).map(|(a, b)| a.abs_diff(*b)).max();
        assert!(apart <= Some(1), "{apart:?}");
    }

    /// If many views are requested at once, the newest is finished last, and no other follows it.
    #[test]
    fn the_newest_view_wins() {
        let (worker, until_idle) = worker();
        for i in 0..20 {
            worker.ask(Job::View(View::new([0.1 * i as f32; LATENT_DIM], camera(100 + i, 75), RenderPace::Resting)));
        }
        let finals: Vec<u32> = until_idle(&worker)
            .iter()
            .filter_map(|d| match d {
                Drawn::View { image, is_final: true, .. } => Some(image.width_px),
                _ => None,
            })
            .collect();
        assert_eq!(finals.last(), Some(&119), "{finals:?}");
    }

    /// All kinds are served while views are requested continuously; each thumbnail comes once, for its own latent.
    #[test]
    fn every_kind_is_served() {
        let (worker, until_idle) = worker();
        let latents: Vec<[f32; LATENT_DIM]> = (0..6).map(|i| [0.2 * i as f32; LATENT_DIM]).collect();
        let small = camera(16, 12);
        worker.ask(Job::Thumbnails { latents: latents.clone(), camera: small, done: 0 });
        worker.ask(Job::BirdsEye { latent: latents[1], camera: small });
        worker.ask(Job::Slice { latent: latents[1], height_m: 1.0, longest_px: 20 });
        for _ in 0..5 {
            worker.ask(Job::View(View::new(latents[2], camera(64, 48), RenderPace::Moving)));
        }
        let drawn = until_idle(&worker);
        let count = |is: fn(&Drawn) -> bool| drawn.iter().filter(|d| is(d)).count();
        assert_eq!(count(|d| matches!(d, Drawn::BirdsEye { .. })), 1);
        assert_eq!(count(|d| matches!(d, Drawn::Slice { .. })), 1);
        assert!(count(|d| matches!(d, Drawn::View { .. })) >= 1);
        let mut indices = Vec::new();
        for d in &drawn {
            if let Drawn::Thumbnail { index, latent, .. } = d {
                assert_eq!(latent, &latents[*index]);
                indices.push(*index);
            }
        }
        indices.sort_unstable();
        assert_eq!(indices, [0, 1, 2, 3, 4, 5]);
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
