//! The encoder stage without its network: from camera frames to posteriors over the scene latent.
//!
//! `carff-encoder` computes with ONNX Runtime, and `carff-encoder-tch` with libtorch. Only the latter links libtorch.

use carff_messages::{Gaussian, Posterior};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{monotonic_now_ns, topics};
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
    let mut encoder = load(stage)?;
    // The first frame is then as fast as later ones.
    let grey = Array3::from_elem((WARM_UP_PX, WARM_UP_PX, 3), 128);
    for _ in 0..WARM_UPS {
        encode(&mut encoder, grey.view())?;
    }
    stage.ready();
    while stage.wait(&[&frames])? {
        let started_ns = monotonic_now_ns();
        let Some(frame) = frames.newest()? else { continue };
        let _span = frame_span(&frame.header);
        match encode(&mut encoder, frame.image()) {
            Ok(gaussian) => {
                let stage_latency_ns = stage.worked(&frame.header, started_ns);
                posteriors.send(Posterior { header: frame.header, gaussian, stage_latency_ns })?;
            }
            Err(error) => stage.error(&error),
        }
    }
    Ok(())
}
