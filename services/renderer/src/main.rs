//! The renderer stage: forecasts and beliefs in, images of the hypotheses out. The decision path has priority.

use carff_field::HypothesisBuffer;
use carff_messages::Stage;
use carff_renderer::{camera, hypotheses, load, meta, render, write};
use carff_runtime::{Overload, StageContext, frame_span};
use carff_transport::{Woken, monotonic_now_ns, topics};

/// Minimum side of a view under overload, pixels.
const MIN_SIDE_PX: u32 = 16;

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Renderer, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let settings = stage.graph.renderer.clone();
    let bytes = settings.width_px as usize * settings.height_px as usize * 3;
    let mut forecasts = stage.input(&topics::FORECAST)?;
    let mut beliefs = stage.input(&topics::BELIEF)?;
    let mut views = stage.image_output(&topics::VIEW, bytes)?;
    let field = load(&stage.checkpoint)?;
    let mut buffer = HypothesisBuffer::default();
    let period_ns = (1e9 / settings.max_rate_hz) as u64;
    let mut next_ns = 0;
    let mut overload = Overload::new(&stage.graph);
    stage.ready();
    loop {
        // Views, then a pause: the rate stays below its limit, and only the newest belief is used.
        while monotonic_now_ns() < next_ns {
            if stage.wait_until(&[], next_ns)? == Woken::Stopped {
                return Ok(());
            }
        }
        if !stage.wait(&[&beliefs])? {
            return Ok(());
        }
        let mut pair = None;
        while let Some(forecast) = forecasts.next()? {
            pair = Some(*forecast);
        }
        let newest = beliefs.newest_of(|belief| {
            overload.observe(belief);
        })?;
        let Some(belief) = newest else { continue };
        let belief = *belief;
        let Some(forecast) =
            pair.filter(|f| f.header.frame_id == belief.header.frame_id && f.header.step == belief.header.step)
        else {
            continue;
        };
        let _span = frame_span(&belief.header);
        let hypotheses = hypotheses(&forecast, &belief, settings.hypotheses as usize);
        let divisor = overload.quality().resolution_divisor;
        let [width_px, height_px] =
            [settings.width_px, settings.height_px].map(|side| (side / divisor).max(MIN_SIDE_PX));
        let bytes = width_px as usize * height_px as usize * 3;
        for &choice in &settings.views {
            if stage.is_stopped() {
                return Ok(());
            }
            let started_ns = monotonic_now_ns();
            let camera = camera(&field, choice, width_px, height_px);
            render(&field, &camera, &hypotheses, stage.threads, &mut buffer);
            let own_ns = (monotonic_now_ns() - started_ns) / hypotheses.len().max(1) as u64;
            for (hypothesis, picture) in hypotheses.iter().zip(&buffer.pictures) {
                let written_ns = monotonic_now_ns();
                let mut loan = views.loan(bytes)?;
                match write(picture, loan.bytes_mut()) {
                    Ok(()) => {
                        let mut meta = meta(&forecast, hypothesis, choice, &camera);
                        // The view's share of the common rendering time, and its own writing.
                        meta.stage_latency_ns = stage.worked(&meta.header, written_ns.saturating_sub(own_ns));
                        views.send_image(loan, meta)?;
                    }
                    Err(error) => stage.error(&error),
                }
                next_ns = next_ns.max(started_ns) + period_ns;
            }
        }
    }
}
