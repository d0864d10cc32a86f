//! `carff probe belief`: shows the belief over states as bars.

use crate::session::{Session, SessionArgs, colours};
use carff_checkpoint::{Manifest, ScenarioIdentity};
use carff_messages::{Action, ActionCode, Belief};
use carff_transport::TopicId;
use clap::Args;
use std::fmt::Write as _;
use std::io::{IsTerminal, Write as _};

/// Width of a full bar, characters.
const BAR: usize = 40;

/// Show the belief over states.
#[derive(Clone, Debug, Args)]
pub struct BeliefArgs {
    /// Stop after this number of frames.
    #[arg(long)]
    pub count: Option<u64>,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

pub(super) fn run(args: &BeliefArgs) -> anyhow::Result<()> {
    let mut session = Session::open(&args.session, "probe-belief")?;
    session.listen([TopicId::BELIEF, TopicId::ACTION])?;
    let states = Manifest::load(&session.attached.live.checkpoint).map_or(Vec::new(), |m| states(&m.scenario));
    let live = std::io::stdout().is_terminal();
    let colour = colours();
    let (mut steps, mut decided, mut shown): (Vec<Belief>, String, u64) = (Vec::new(), String::new(), 0);
    let going = session.follow(
        |_, message| {
            let message = message.message();
            if let Some(action) = message.get::<Action>() {
                decided = match action.code() {
                    Ok(code @ (ActionCode::Advance | ActionCode::Creep)) => code.name().to_owned(),
                    _ => format!("HALT ({})", action.reason().map_or("unknown", carff_messages::Reason::name)),
                };
            } else if let Some(belief) = message.get::<Belief>() {
                if steps.first().is_some_and(|b| b.header.frame_id != belief.header.frame_id) {
                    steps.clear();
                }
                steps.push(*belief);
                // A frame whose first steps came before the probe is not shown.
                if belief.is_final() && steps.first().is_some_and(|b| b.header.step == 1) {
                    let text = image(&steps, &states, &decided, colour);
                    // On a terminal the bars stay in place.
                    let begin = if live { "\x1b[H\x1b[J" } else { "" };
                    let mut out = std::io::stdout().lock();
                    let written = writeln!(out, "{begin}{text}").and_then(|()| out.flush());
                    shown += 1;
                    return Ok(written.is_ok() && args.count.is_none_or(|count| shown < count));
                }
            }
            Ok(true)
        },
        || Ok(()),
    )?;
    session.say_end(going);
    Ok(())
}

/// A state of the scenario.
#[derive(Clone, Debug)]
struct State {
    name: String,
    is_hazard: bool,
}

fn states(scenario: &ScenarioIdentity) -> Vec<State> {
    let hazards = scenario.hazard_states();
    scenario.state_names().into_iter().zip(hazards).map(|(name, is_hazard)| State { name, is_hazard }).collect()
}

fn bar(probability: f32) -> String {
    let eighths = (probability.clamp(0.0, 1.0) * (BAR * 8) as f32).round() as usize;
    let part = ["", "\u{258f}", "\u{258e}", "\u{258d}", "\u{258c}", "\u{258b}", "\u{258a}", "\u{2589}"][eighths % 8];
    format!("{}{part}", "\u{2588}".repeat(eighths / 8))
}

/// Formats a frame's beliefs, step by step: hazard states in red, others in green, and what is not known in no colour.
fn image(steps: &[Belief], known: &[State], decided: &str, colour: bool) -> String {
    let paint = |text: &str, code: &str| if colour { format!("\x1b[{code}m{text}\x1b[0m") } else { text.to_owned() };
    let mut text = String::new();
    if let Some(first) = steps.first() {
        let _ = writeln!(text, "frame {}   controller: {decided}", first.header.frame_id);
    }
    for belief in steps {
        let _ = writeln!(
            text,
            "\nstep {} of {}   hazard {:.3}   path {:.3}   {} samples",
            belief.header.step, belief.horizon, belief.hazard_probability, belief.path_probability, belief.sample_count
        );
        let states = &belief.state_probability[..(belief.state_count as usize).min(belief.state_probability.len())];
        let count = |state: i32| belief.samples().iter().filter(|s| s.state == state).count();
        let name_of = |state: usize| known.get(state).map_or_else(|| format!("state {state}"), |s| s.name.clone());
        let width = (0..states.len()).map(|s| name_of(s).chars().count()).max().unwrap_or(0).max(7);
        let rest = (1.0 - states.iter().sum::<f32>()).max(0.0);
        let rows = states.iter().enumerate().map(|(s, &p)| (name_of(s), p, s as i32));
        for (name, probability, state) in rows.chain([("unknown".to_owned(), rest, -1)]) {
            let resolved = if state == belief.resolved_state && state >= 0 { ">" } else { " " };
            let bar = bar(probability);
            let blank = " ".repeat(BAR.saturating_sub(bar.chars().count()));
            let painted = match usize::try_from(state).ok().and_then(|state| known.get(state)) {
                Some(State { is_hazard: true, .. }) => paint(&bar, "31"),
                Some(State { is_hazard: false, .. }) => paint(&bar, "32"),
                None => bar,
            };
            let _ = writeln!(
                text,
                "{resolved} {name:<width$} {probability:>6.3} {painted}{blank} {}",
                "\u{2022}".repeat(count(state))
            );
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::{Header, ProbeResult};

    /// Each state has its name, probability and a dot for each of its samples; the rest of the probability is unknown.
    #[test]
    fn beliefs_are_drawn() {
        let mut belief = Belief::empty(Header::of_frame(12, 1, 1).at_step(1), 1);
        (belief.state_count, belief.sample_count, belief.component_count) = (2, 4, 1);
        belief.state_probability[..2].copy_from_slice(&[0.5, 0.25]);
        for (sample, state) in belief.samples.iter_mut().zip([0, 0, 1, -1]) {
            *sample = ProbeResult { state, ..ProbeResult::NONE };
        }
        belief.resolved_state = 0;
        let states = [("truck, t0", true), ("no actor, t0", false)]
            .map(|(name, is_hazard)| State { name: name.into(), is_hazard });
        let text = image(std::slice::from_ref(&belief), &states, "advance", false);
        let line = |name: &str| text.lines().find(|l| l.contains(name)).unwrap_or_default().to_owned();
        assert!(line("truck").starts_with("> truck, t0") && line("truck").ends_with("\u{2022}\u{2022}"), "{text}");
        assert!(line("truck").contains(&"\u{2588}".repeat(20)) && line("no actor").contains("0.250"), "{text}");
        assert!(line("unknown").contains("0.250") && line("frame 12").contains("advance"), "{text}");
    }

    /// The colour of a state is that of its meaning, also if no sample shows it; what is not known has no colour.
    #[test]
    fn colours_are_of_the_states() {
        let scenario = ScenarioIdentity {
            name: "s".into(),
            branches: vec!["no actor".into(), "truck".into()],
            timestamps: 2,
            hazard_branches: vec![1],
            hazard_from_timestamp: 0,
            poses: 1,
        };
        let mut belief = Belief::empty(Header::of_frame(12, 1, 1).at_step(1), 1);
        (belief.state_count, belief.sample_count, belief.component_count) = (4, 1, 1);
        belief.state_probability[..4].copy_from_slice(&[0.25, 0.25, 0.25, 0.125]);
        // Only a harmless state has a sample, which contradicts the scenario.
        belief.samples[0] = ProbeResult { state: 0, hazard_likelihood: 0.9, ..ProbeResult::NONE };
        let text = image(std::slice::from_ref(&belief), &states(&scenario), "advance", true);
        let line = |text: &str, name: &str| text.lines().find(|l| l.contains(name)).unwrap_or_default().to_owned();
        for (name, colour) in [("no actor, t0", "32"), ("no actor, t1", "32"), ("truck, t0", "31"), ("truck, t1", "31")]
        {
            assert!(line(&text, name).contains(&format!("\x1b[{colour}m")), "{name}: {text:?}");
        }
        assert!(!line(&text, "unknown").contains('\x1b'), "{text:?}");
        let without_manifest = image(std::slice::from_ref(&belief), &[], "advance", true);
        assert!(line(&without_manifest, "state 3").contains("0.125") && !without_manifest.contains('\x1b'));
    }

    /// A bar is as long as its probability, to an eighth of a character.
    #[test]
    fn bars_are_to_scale() {
        assert_eq!(bar(0.0), "");
        assert_eq!(bar(1.0).chars().count(), BAR);
        assert_eq!(bar(0.5 / BAR as f32), "\u{258c}");
        assert_eq!(bar(7.0).chars().count(), BAR);
    }
}
