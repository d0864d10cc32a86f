//! The encoder stage: camera frames in, posteriors out.

use carff_encoder::{encode, load};
use carff_messages::{Posterior, Stage};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{monotonic_now_ns, topics};

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Encoder, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut frames = stage.input(&topics::FRAME)?;
    let mut posteriors = stage.output(&topics::POSTERIOR)?;
    let encoder = load(&stage.checkpoint, stage.threads)?;
    stage.ready();
    while stage.wait(&[&frames])? {
        let started_ns = monotonic_now_ns();
        let Some(frame) = frames.newest()? else { continue };
        let _span = frame_span(&frame.header);
        match encode(&encoder, frame.image()) {
            Ok(gaussian) => {
                let stage_latency_ns = stage.worked(&frame.header, started_ns);
                posteriors.send(Posterior { header: frame.header, gaussian, stage_latency_ns })?;
            }
            Err(error) => stage.error(&error),
        }
    }
    Ok(())
}
