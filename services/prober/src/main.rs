//! The prober stage: forecasts and camera images in, beliefs and comparisons out.

use carff_messages::Stage;
use carff_prober::{Frames, Outlook, believe, load};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{Input, monotonic_now_ns, topics};

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Prober, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut forecasts = stage.input(&topics::FORECAST)?;
    let mut beliefs = stage.output(&topics::BELIEF)?;
    let mut occupancies = stage.output(&topics::OCCUPANCY)?;
    let (mut probe, grid) = load(&stage.checkpoint)?;
    let mut frames = Frames::open(stage, &probe)?;
    let mut outlook = Outlook::open(stage, &probe)?;
    stage.ready();
    loop {
        let cameras = frames.iter().filter_map(Frames::input);
        let inputs: Vec<&dyn Input> = cameras.chain([&forecasts as &dyn Input]).collect();
        if !stage.wait(&inputs)? {
            return Ok(());
        }
        let started_ns = monotonic_now_ns();
        let forecast = forecasts.newest()?;
        if let Some(frames) = &mut frames {
            frames.take(&probe, forecast.as_ref().map(|forecast| &forecast.header), stage.threads)?;
        }
        let Some(forecast) = forecast else { continue };
        let _span = frame_span(&forecast.header);
        let evidence = frames.as_ref().map_or(Ok(None), |frames| frames.evidence(&forecast, probe.layout()));
        match evidence {
            Ok(evidence) => {
                let mut belief = believe(&mut probe, &forecast, evidence.as_ref(), stage.graph.run.feedback);
                if let (Some(outlook), Some(frames), 1) = (&mut outlook, &frames, belief.header.step) {
                    outlook.publish(&probe, frames, &belief, stage)?;
                }
                belief.stage_latency_ns = stage.worked(&belief.header, started_ns);
                let believed_ns = monotonic_now_ns();
                beliefs.send(belief)?;
                // After the belief, which a decision waits for.
                let boxes = frames.as_ref().map_or(&[][..], |frames| frames.unknown_boxes(&belief.header));
                let mut occupancy = grid.occupancy(&belief, boxes);
                occupancy.stage_latency_ns = monotonic_now_ns() - believed_ns;
                occupancies.send(occupancy)?;
                if let Some(frames) = &mut frames {
                    frames.after(&probe, &belief, stage.threads)?;
                }
            }
            Err(error) => stage.refuse(&error),
        }
    }
}
