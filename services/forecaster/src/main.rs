//! The forecaster stage: posteriors, comparisons of images and fed-back beliefs in, forecasts out.

use carff_forecaster::Forecaster;
use carff_messages::Stage;
use carff_runtime::{Overload, StageContext, frame_span};
use carff_transport::{Receiver, monotonic_now_ns, topics};

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Forecaster, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut posteriors = stage.input(&topics::POSTERIOR)?;
    let mut beliefs = stage.input(&topics::BELIEF)?;
    let mut comparisons = stage.graph.remembers().then(|| stage.input(&topics::UNKNOWN)).transpose()?;
    let mut forecasts = stage.output(&topics::FORECAST)?;
    let mut overload = Overload::new(&stage.graph);
    let mut forecaster = Forecaster::load(&stage.checkpoint, &stage.graph)?;
    let mut newest_frame = 0;
    stage.ready();
    while stage.wait(&[&posteriors, &beliefs])? {
        let started_ns = monotonic_now_ns();
        while let Some(unknowns) = comparisons.as_mut().map_or(Ok(None), Receiver::next)? {
            forecaster.compare(&unknowns);
        }
        if let Some(posterior) = posteriors.newest_of(|posterior| forecaster.remember(posterior))? {
            let _span = frame_span(&posterior.header);
            newest_frame = posterior.header.frame_id;
            let mut forecast = forecaster.from_observation(&posterior);
            forecast.stage_latency_ns = stage.worked(&forecast.header, started_ns);
            forecasts.send(forecast)?;
        }
        while let Some(belief) = beliefs.next()? {
            // A belief about a frame older than the newest one is not forecast from.
            let started_ns = monotonic_now_ns();
            let _span = frame_span(&belief.header);
            if overload.observe(&belief) {
                let quality = overload.quality();
                forecaster.set_quality(quality.samples as usize, quality.horizon);
            }
            if belief.header.frame_id < newest_frame {
                continue;
            }
            if let Some(mut forecast) = forecaster.from_feedback(&belief) {
                forecast.stage_latency_ns = stage.worked(&forecast.header, started_ns);
                forecasts.send(forecast)?;
            }
        }
    }
    Ok(())
}
