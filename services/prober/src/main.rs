//! The prober stage: forecasts and camera images in, beliefs and comparisons out.

use carff_messages::Stage;
use carff_prober::{Images, believe, load};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{Input, monotonic_now_ns, topics};

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Prober, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut forecasts = stage.input(&topics::FORECAST)?;
    let mut beliefs = stage.output(&topics::BELIEF)?;
    let mut probe = load(&stage.checkpoint)?;
    let mut images = Images::load(&stage.checkpoint, &stage.graph.checks, &probe)?;
    // A publisher that never sends keeps its connections to receivers that have died.
    let mut unknowns = images.is_some().then(|| stage.output(&topics::UNKNOWN)).transpose()?;
    let mut frames = images.is_some().then(|| stage.input(&topics::FRAME)).transpose()?;
    stage.ready();
    loop {
        let cameras = frames.iter().map(|frames| frames as &dyn Input);
        let inputs: Vec<&dyn Input> = cameras.chain([&forecasts as &dyn Input]).collect();
        if !stage.wait(&inputs)? {
            return Ok(());
        }
        let goes_first = images.as_ref().is_some_and(Images::goes_first);
        for compares in [goes_first, !goes_first] {
            let started_ns = monotonic_now_ns();
            if compares {
                let (Some(images), Some(frames), Some(unknowns)) = (&mut images, &mut frames, &mut unknowns) else {
                    continue;
                };
                let Some(frame) = frames.newest()? else { continue };
                if !images.is_due(frame.header.capture_time_ns) {
                    continue;
                }
                if let Some(mut compared) = images.compare(&probe, &frame, frame.image(), stage.threads) {
                    compared.stage_latency_ns = monotonic_now_ns() - started_ns;
                    unknowns.send(compared)?;
                }
            } else {
                let Some(forecast) = forecasts.newest()? else { continue };
                let _span = frame_span(&forecast.header);
                let evidence = images.as_ref().and_then(|images| images.evidence(&forecast.header));
                let mut belief = believe(&mut probe, &forecast, evidence);
                belief.stage_latency_ns = stage.worked(&belief.header, started_ns);
                beliefs.send(belief)?;
            }
        }
    }
}
