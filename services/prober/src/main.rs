//! The prober stage: forecasts in, beliefs out.

use carff_messages::Stage;
use carff_prober::{believe, load};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{monotonic_now_ns, topics};

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Prober, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut forecasts = stage.input(&topics::FORECAST)?;
    let mut beliefs = stage.output(&topics::BELIEF)?;
    let mut probe = load(&stage.checkpoint)?;
    stage.ready();
    while stage.wait(&[&forecasts])? {
        let started_ns = monotonic_now_ns();
        let Some(forecast) = forecasts.newest()? else { continue };
        let _span = frame_span(&forecast.header);
        let mut belief = believe(&mut probe, &forecast);
        belief.stage_latency_ns = stage.worked(&belief.header, started_ns);
        beliefs.send(belief)?;
    }
    Ok(())
}
