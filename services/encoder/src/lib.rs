//! The encoder stage without its network: from camera frames to posteriors over the scene latent.
//!
//! `carff-encoder` computes with ONNX Runtime, and `carff-encoder-tch` with libtorch. Only the latter links libtorch.

use carff_config::{CompareImages, GraphConfig};
use carff_messages::{FrameMeta, Gaussian, ImageCheck, Posterior};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{monotonic_now_ns, topics};
use carff_unknown::{CameraCheck, Known, Measurement};
use ndarray::{Array3, ArrayView3};

/// Side of the image for the warm-up, pixels.
const WARM_UP_PX: usize = 128;
/// Number of runs of the warm-up.
const WARM_UPS: usize = 3;

/// Publishes the posterior of the newest frame until the stage is stopped. `load` returns the encoder, which reads an
/// image (height, width, channel) in place.
pub fn run<E>(
    stage: &mut StageContext,
    load: impl FnOnce(&StageContext) -> anyhow::Result<E>,
    mut encode: impl FnMut(&mut E, ArrayView3<'_, u8>) -> anyhow::Result<Gaussian>,
) -> anyhow::Result<()> {
    let mut frames = stage.input(&topics::FRAME)?;
    let mut posteriors = stage.output(&topics::POSTERIOR)?;
    let mut checks = stage.output(&topics::CHECK)?;
    let limits = Known::load(&stage.checkpoint)?.map(|known| known.camera);
    // The prober compares images with a checkpoint's limits.
    let needs_pose = stage.graph.checks.compare != CompareImages::Off && limits.is_some();
    let mut camera = stage.graph.checks.camera.then(|| CameraCheck::new(limits, frozen_ns(&stage.graph)));
    let mut encoder = load(stage)?;
    // The first frame is then as fast as later ones.
    let grey = Array3::from_elem((WARM_UP_PX, WARM_UP_PX, 3), 128);
    for _ in 0..WARM_UPS {
        encode(&mut encoder, grey.view())?;
    }
    // Images before this frame are not of the same take: the camera was not usable in between.
    let mut usable_from = 0;
    stage.ready();
    while stage.wait(&[&frames])? {
        let started_ns = monotonic_now_ns();
        let Some(frame) = frames.newest()? else { continue };
        let _span = frame_span(&frame.header);
        let mut check = ImageCheck::of_frame(frame.header);
        if let Some(camera) = &mut camera {
            camera.check(frame.image(), measurement(&frame, needs_pose), &mut check);
        }
        checks.send(check)?;
        if !check.is_usable() {
            usable_from = frame.header.frame_id + 1;
            stage.worked(&frame.header, started_ns);
            continue;
        }
        match encode(&mut encoder, frame.image()) {
            Ok(gaussian) => {
                let stage_latency_ns = stage.worked(&frame.header, started_ns);
                let take_start = frame.take_start.max(usable_from);
                posteriors.send(Posterior { header: frame.header, gaussian, take_start, stage_latency_ns })?;
            }
            Err(error) => stage.error(&error),
        }
    }
    Ok(())
}

/// Returns what the check of the camera needs to know of a frame in addition to its image.
fn measurement(frame: &FrameMeta, needs_pose: bool) -> Measurement {
    Measurement {
        has_pose: !needs_pose || frame.camera().validate().is_ok(),
        capture_time_ns: frame.header.capture_time_ns,
        now_ns: monotonic_now_ns(),
        field_of_view_deg: frame.camera().field_of_view_deg(),
    }
}

/// Returns the time for which an image may repeat, nanoseconds; `None` for a camera of rendered images without noise,
/// which shows a still scene as equal images.
fn frozen_ns(graph: &GraphConfig) -> Option<u64> {
    graph.camera.has_noise().then_some(graph.checks.frozen_ms * 1_000_000)
}
