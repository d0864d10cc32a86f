//! The renderer stage: forecasts and beliefs in, images of the hypotheses out. The decision path has priority.

use carff_field::HypothesisBuffer;
use carff_messages::{Stage, rgb_bytes};
use carff_renderer::{Pairing, camera, hypotheses, load, meta, render, write};
use carff_runtime::{Overload, StageContext, frame_span};
use carff_transport::{monotonic_now_ns, topics};

/// Minimum side of a view under overload, pixels.
const MIN_SIDE_PX: u32 = 16;

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Renderer, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let settings = stage.graph.renderer.clone();
    let mut forecasts = stage.input(&topics::FORECAST)?;
    let mut beliefs = stage.input(&topics::BELIEF)?;
    let mut views = stage.image_output(&topics::VIEW, rgb_bytes(settings.width_px, settings.height_px))?;
    let field = load(&stage.checkpoint)?;
    let period_ns = (1e9 / settings.max_rate_hz) as u64;
    let (mut buffer, mut pairing, mut next_ns) = (HypothesisBuffer::default(), Pairing::default(), 0);
    let mut overload = Overload::new(&stage.graph);
    stage.ready();
    // Views, then a pause: the rate stays below its limit, and only the newest belief is rendered.
    while stage.pause_until(next_ns)? && stage.wait(&[&beliefs])? {
        while let Some(forecast) = forecasts.next()? {
            pairing.forecast(&forecast);
        }
        let newest = beliefs.newest_of(|belief| {
            overload.observe(belief);
        })?;
        let Some((belief, forecast)) = newest.as_ref().and_then(|b| Some((b, pairing.answered(b)?))) else { continue };
        let _span = frame_span(&belief.header);
        let hypotheses = hypotheses(forecast, belief, settings.hypotheses as usize);
        let divisor = overload.quality().resolution_divisor;
        let [width_px, height_px] = [settings.width_px, settings.height_px].map(|px| (px / divisor).max(MIN_SIDE_PX));
        for &choice in &settings.views {
            if stage.is_stopped() {
                return Ok(());
            }
            let started_ns = monotonic_now_ns();
            let camera = camera(&field, choice, width_px, height_px);
            render(&field, &camera, &hypotheses, stage.threads, &mut buffer);
            let rendered_ns = (monotonic_now_ns() - started_ns) / hypotheses.len().max(1) as u64;
            for (hypothesis, image) in hypotheses.iter().zip(&buffer.images) {
                let written_ns = monotonic_now_ns();
                let mut loan = views.loan(rgb_bytes(width_px, height_px))?;
                write(image, loan.bytes_mut())?;
                let mut meta = meta(forecast, hypothesis, choice, &camera);
                // A view's share of the rendering of all hypotheses, and its own writing.
                meta.stage_latency_ns = stage.worked(&meta.header, written_ns.saturating_sub(rendered_ns));
                views.send_image(loan, meta)?;
                next_ns = next_ns.max(started_ns) + period_ns;
            }
        }
    }
    Ok(())
}
