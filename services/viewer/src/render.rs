//! Renders images of scenes on a separate thread. Only the newest request of each kind counts. A view is rendered
//! coarse first, then finer, so that the window stays responsive on a slow machine.

mod desk;
mod painter;

pub use desk::{Drawn, Job, RenderPace, View};

use carff_field::{Field, InstructionSet};
use desk::{Shared, THUMBNAILS};
use painter::Painter;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::thread::JoinHandle;

/// Niceness of the thread: the processes of a running graph come first.
const NICE: i32 = 10;

/// Renders on its own thread until the worker is dropped.
pub struct RenderWorker {
    shared: Arc<Shared>,
    thread: Option<JoinHandle<()>>,
}

impl RenderWorker {
    /// Starts the thread. It renders with `threads` threads and calls `wake` when it has a result.
    pub fn start(mut field: Field, threads: usize, wake: impl Fn() + Send + 'static) -> std::io::Result<Self> {
        field.set_instruction_set(InstructionSet::detect_for_images());
        let shared = Arc::new(Shared::default());
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

#[cfg(test)]
mod tests {
    use super::painter::image_of;
    use super::*;
    use carff_base::geometry::PinholeCamera;
    use carff_field::{FieldConfig, LATENT_DIM, RenderBuffer, RenderOptions};
    use std::sync::mpsc;
    use std::time::{Duration, Instant};

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
}
