//! The controller stage: an action for each belief and each unusable image, and one at each tick. It always publishes.

use anyhow::Context;
use carff_checkpoint::load_policy;
use carff_controller::{Controller, Settings};
use carff_decision::{Approach, Policy};
use carff_messages::{ImageCheck, ImageCondition, Stage};
use carff_runtime::{StageContext, frame_span};
use carff_transport::{Receiver, Woken, monotonic_now_ns, topics};

/// Maximum number of beliefs between two reads of the clock, so that a flood of them delays no tick.
const MOST_AT_ONCE: usize = 16;

fn main() -> std::process::ExitCode {
    carff_runtime::main(Stage::Controller, run)
}

fn run(stage: &mut StageContext) -> anyhow::Result<()> {
    let mut beliefs = stage.input(&topics::BELIEF)?;
    let mut checks = stage.input(&topics::CHECK)?;
    let mut actions = stage.output(&topics::ACTION)?;
    let settings = settings(stage)?;
    let moves = settings.approach != Approach::Stop;
    let mut motions = moves.then(|| stage.input(&topics::EGO_MOTION)).transpose()?.map(Receiver::polled);
    let looks = (settings.approach == Approach::Look).then(|| stage.input(&topics::LOOK)).transpose()?;
    let mut looks = looks.map(Receiver::polled);
    let mut controller = Controller::new(settings);
    stage.ready();

    let mut invalid = 0;
    let mut condition = ImageCondition::Usable.code();
    let mut tick_ns = monotonic_now_ns();
    loop {
        // The expiry of a decision is handled at once, not at the next tick.
        let wake_ns = tick_ns.min(controller.expires_ns());
        if stage.wait_until(&[&checks, &beliefs], wake_ns)? == Woken::Stopped {
            return Ok(actions.send(controller.on_stop(monotonic_now_ns()))?);
        }
        for _ in 0..MOST_AT_ONCE {
            let Some(check) = checks.next()? else { break };
            if let Some(action) = controller.on_check(&check, monotonic_now_ns()) {
                actions.send(action)?;
            }
            if check.condition != std::mem::replace(&mut condition, check.condition) {
                report_condition(&check);
            }
        }
        for _ in 0..MOST_AT_ONCE {
            let Some(belief) = beliefs.next()? else { break };
            let started_ns = monotonic_now_ns();
            let _span = frame_span(&belief.header);
            // Both are published before the belief that they belong to.
            while let Some(motion) = motions.as_mut().map_or(Ok(None), Receiver::next)? {
                controller.on_motion(&motion);
            }
            while let Some(look) = looks.as_mut().map_or(Ok(None), Receiver::next)? {
                controller.on_look(&look);
            }
            if let Some(action) = controller.on_belief(&belief, started_ns) {
                actions.send(action)?;
                stage.worked(&action.header, started_ns);
                tracing::debug!(frame = action.based_on_frame, action = action.action, "decided");
            }
        }
        if stage.invalid_count() > invalid {
            invalid = stage.invalid_count();
            controller.on_invalid();
        }
        // Ticks keep their rate during any load.
        let now_ns = monotonic_now_ns();
        if now_ns >= tick_ns.min(controller.expires_ns()) {
            actions.send(controller.on_tick(now_ns))?;
            if now_ns >= tick_ns {
                tick_ns = (tick_ns + settings.period_ns).max(now_ns);
            }
        }
    }
}

fn report_condition(check: &ImageCheck) {
    let frame = check.header.frame_id;
    match check.condition() {
        Ok(ImageCondition::Usable) => tracing::info!(frame, "the image is usable again"),
        Ok(condition) => tracing::warn!(frame, "the image is not usable: {condition}"),
        Err(_) => {} // The receiver drops checks that are not valid.
    }
}

fn settings(stage: &StageContext) -> anyhow::Result<Settings> {
    let config = &stage.graph.controller;
    let remembers = stage.graph.remembers();
    let policy = load_policy(config.rule, config.threshold, &stage.checkpoint, remembers)
        .context("no threshold for the calibrated rule: set `controller.threshold`, or use a checkpoint")?;
    Ok(Settings {
        policy: Policy { ignores_unknown: stage.graph.checks.ignores_unknown(), ..policy },
        deadline_ns: config.deadline_ms * 1_000_000,
        period_ns: (1e9 / config.rate_hz) as u64,
        seed: stage.seed(),
        approach: config.approach,
        speeds: config.speeds(),
    })
}
