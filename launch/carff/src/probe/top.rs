//! `carff probe top`: shows all stages on one screen.

use super::structure::columns;
use crate::session::{Session, SessionArgs};
use crate::vitals::{RunVitals, StageVitals};
use anyhow::{Context, ensure};
use carff_base::statistics::percentile;
use carff_messages::Stage;
use carff_observe::LiveRun;
use carff_transport::monotonic_now_ns;
use clap::Args;
use ratatui::Frame;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Style, Stylize};
use ratatui::text::{Line, Span};
use ratatui::widgets::{Block, Cell, Paragraph, Row, Table};
use std::collections::VecDeque;
use std::io::IsTerminal;
use std::time::Duration;

/// Time between two screens, nanoseconds.
const DRAW_NS: u64 = 250_000_000;
/// Default time that `--once` listens, seconds.
const ONCE_S: f64 = 3.0;
/// Number of latencies in a sparkline.
const SPARKS: usize = 24;

/// Last line of the screen.
const HINT: &str =
    "q quits   late: heartbeats that reported slow or stale   max, skipped, invalid, errors: since the stage's start";

const HEAD: [&str; 13] = [
    "stage",
    "state",
    "rate",
    "latency",
    "max",
    "recent latency",
    "CPU",
    "memory",
    "skipped",
    "invalid",
    "errors",
    "restarts",
    "late",
];

/// Show the stages.
#[derive(Clone, Debug, Args)]
pub struct TopArgs {
    /// Print the screen once, as plain text, after 3 seconds (or --seconds).
    #[arg(long)]
    pub once: bool,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

pub(super) fn run(args: &TopArgs) -> anyhow::Result<()> {
    let mut session_args = args.session.clone();
    if args.once {
        session_args.seconds = session_args.seconds.or(Some(ONCE_S));
    }
    ensure!(args.once || std::io::stdout().is_terminal(), "the output is not a terminal: use --once");
    let mut session = Session::open(&session_args, "probe-top")?;
    session.listen(RunVitals::topics())?;
    let mut vitals = RunVitals::default();
    if args.once {
        let going = vitals.gather(&mut session, |_| Ok(true))?;
        let live = &session.attached.live;
        print!("{}\n{}", summary(live, &vitals), columns(&rows(&vitals)));
        session.say_end(going);
        return Ok(());
    }
    let mut terminal = ratatui::try_init().context("cannot initialise the terminal")?;
    let live = session.attached.live.clone();
    let mut draw_ns = 0;
    let result = vitals.gather(&mut session, |vitals| {
        let now_ns = monotonic_now_ns();
        if now_ns >= draw_ns {
            draw_ns = now_ns + DRAW_NS;
            terminal.draw(|frame| draw(frame, &live, vitals))?;
        }
        Ok(!wants_out()?)
    });
    ratatui::restore();
    session.say_end(result?);
    Ok(())
}

/// Returns true if a key asks to quit.
fn wants_out() -> anyhow::Result<bool> {
    while event::poll(Duration::ZERO)? {
        if let Event::Key(key) = event::read()? {
            let interrupt = key.code == KeyCode::Char('c') && key.modifiers.contains(KeyModifiers::CONTROL);
            if interrupt || matches!(key.code, KeyCode::Char('q') | KeyCode::Esc) {
                return Ok(true);
            }
        }
    }
    Ok(false)
}

fn summary(live: &LiveRun, vitals: &RunVitals) -> String {
    let decided: Vec<f64> = vitals.decided_ms.iter().copied().collect();
    let ms = |q| percentile(&decided, q).map_or("-".to_owned(), |v| format!("{v:.1}"));
    let (action, reason) = vitals.last_action.unwrap_or(("-", "-"));
    let safe: u64 = vitals.safe_actions.values().sum();
    format!(
        "run {}   graph {}\nsince the start of this probe: frames {}   decisions {}   camera to action p50 {} ms, p99 {} ms\naction {action} ({reason})   \
         hazard {:.3}   safe actions {safe}\n",
        live.name,
        live.graph.file_name().map(|n| n.to_string_lossy()).unwrap_or_default(),
        vitals.frames,
        vitals.decisions,
        ms(0.5),
        ms(0.99),
        vitals.hazard_probability,
    )
}

fn sparks(values: &VecDeque<f64>) -> String {
    const LEVELS: [char; 8] =
        ['\u{2581}', '\u{2582}', '\u{2583}', '\u{2584}', '\u{2585}', '\u{2586}', '\u{2587}', '\u{2588}'];
    let recent: Vec<f64> = values.iter().rev().take(SPARKS).rev().copied().collect();
    let top = recent.iter().copied().fold(1e-9, f64::max);
    recent.iter().map(|v| LEVELS[((v / top * 7.99) as usize).min(7)]).collect()
}

fn rows(vitals: &RunVitals) -> Vec<Vec<String>> {
    let now_ns = monotonic_now_ns();
    let mut rows = vec![HEAD.map(str::to_owned).to_vec()];
    for stage in Stage::ALL {
        let none = StageVitals::default();
        let v = vitals.stages.get(&stage).unwrap_or(&none);
        rows.push(vec![
            stage.name().to_owned(),
            v.state_name(now_ns).to_owned(),
            format!("{:.1} Hz", v.rate_hz(now_ns)),
            v.latency_ms.back().map_or("-".to_owned(), |ms| format!("{ms:.2} ms")),
            format!("{:.1} ms", v.max_latency_ms),
            sparks(&v.latency_ms),
            format!("{:.0} %", v.cpu * 100.0),
            format!("{} MB", v.rss_bytes / 1_000_000),
            v.counts[0].to_string(),
            v.counts[1].to_string(),
            v.counts[2].to_string(),
            v.restarts.to_string(),
            v.late.to_string(),
        ]);
    }
    rows
}

fn draw(frame: &mut Frame<'_>, live: &LiveRun, vitals: &RunVitals) {
    let areas =
        Layout::vertical([Constraint::Length(4), Constraint::Min(9), Constraint::Length(1)]).split(frame.area());
    let plain = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
    let colour = |c: Color| if plain { Style::new() } else { Style::new().fg(c) };
    let lines: Vec<Line<'_>> = summary(live, vitals).lines().map(|l| Line::from(l.to_owned())).collect();
    frame.render_widget(Paragraph::new(lines), areas[0]);
    let rows = rows(vitals);
    let widths = [11, 10, 9, 10, 10, SPARKS as u16, 6, 8, 8, 8, 7, 9, 6].map(Constraint::Length);
    let body = rows.iter().skip(1).map(|cells| {
        Row::new(cells.iter().enumerate().map(|(i, text)| {
            let style = match (i, text.as_str()) {
                (1, "ok" | "done") => colour(Color::Green),
                (1, "slow" | "stale" | "starting" | "restarting") => colour(Color::Yellow),
                (1, _) => colour(Color::Red),
                (5, _) => colour(Color::Cyan),
                (8..=12, "0") => colour(Color::DarkGray),
                _ => Style::new(),
            };
            Cell::from(Span::styled(text.clone(), style))
        }))
    });
    let table = Table::new(body, widths)
        .header(Row::new(HEAD).bold())
        .column_spacing(1)
        .block(Block::bordered().title(" stages "));
    frame.render_widget(table, areas[1]);
    frame.render_widget(Paragraph::new(HINT).style(colour(Color::DarkGray)), areas[2]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    fn live() -> LiveRun {
        LiveRun {
            dir: "/run/carff".into(),
            name: "a-run".into(),
            run_id: 1,
            pid: 1,
            graph: "x/g.toml".into(),
            dataset: "d".into(),
            checkpoint: "c".into(),
            started_unix_s: 0,
        }
    }

    /// The screen names the run, every stage and its state, on a terminal of usual size and on a small one.
    #[test]
    fn the_screen_shows_every_stage() {
        let mut terminal = Terminal::new(TestBackend::new(140, 20)).unwrap();
        terminal.draw(|frame| draw(frame, &live(), &RunVitals::default())).unwrap();
        let screen = terminal.backend().to_string();
        assert!(screen.contains("a-run") && screen.contains("g.toml"), "{screen}");
        for stage in Stage::ALL {
            assert!(screen.lines().any(|l| l.contains(stage.name()) && l.contains("unknown")), "{stage}: {screen}");
        }
        let mut tiny = Terminal::new(TestBackend::new(3, 2)).unwrap();
        tiny.draw(|frame| draw(frame, &live(), &RunVitals::default())).unwrap();
    }

    /// A sparkline has a character for each value, the highest for the largest.
    #[test]
    fn sparklines_are_to_scale() {
        let line: Vec<char> = sparks(&VecDeque::from([1.0, 8.0, 4.0])).chars().collect();
        assert_eq!((line.len(), line[1]), (3, '\u{2588}'));
        assert!(line[0] < line[2] && line[2] < line[1]);
        assert_eq!(sparks(&VecDeque::from(vec![0.0; 100])).chars().count(), SPARKS);
    }
}
