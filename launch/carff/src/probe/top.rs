//! `carff probe top`: shows all stages on one screen.

use super::structure::columns;
use crate::session::{Session, SessionArgs};
use crate::vitals::{RunVitals, StageVitals};
use anyhow::{Context, ensure};
use carff_base::statistics::percentile;
use carff_messages::Stage;
use carff_observe::LiveRun;
use carff_transport::monotonic_now_ns;
use clap::{Args, ValueEnum};
use ratatui::Frame;
use ratatui::crossterm::event::{self, Event, KeyCode, KeyModifiers};
use ratatui::crossterm::terminal;
use ratatui::layout::{Constraint, Layout};
use ratatui::style::{Color, Style, Stylize};
use ratatui::text::Span;
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
/// Maximum width of the lines above the table in plain text.
const PLAIN_WIDTH: usize = 120;
/// Maximum width of the camera's line.
const CAMERA_WIDTH: usize = 80;

/// Columns of the table.
#[derive(Clone, Copy, Debug, PartialEq, Eq, ValueEnum)]
pub enum Column {
    /// Name of the stage.
    Stage,
    /// Reported state.
    State,
    /// Messages per second.
    Rate,
    /// Latest latency.
    Latency,
    /// Longest latency since the stage's start.
    Max,
    /// Chart of the latest latencies.
    Recent,
    /// Share of a processor core.
    Cpu,
    /// Resident memory.
    Memory,
    /// Inputs skipped for newer ones since the stage's start.
    Skipped,
    /// Invalid inputs since the stage's start.
    Invalid,
    /// Errors since the stage's start.
    Errors,
    /// New processes since the start of this probe.
    Restarts,
    /// Heartbeats that reported slow or stale since the start of this probe.
    Late,
}

/// Columns by priority: on a narrow terminal the last ones are hidden.
const PRIORITY: [Column; 13] = {
    use Column::{Cpu, Errors, Invalid, Late, Latency, Max, Memory, Rate, Recent, Restarts, Skipped, Stage, State};
    [Stage, State, Rate, Latency, Errors, Restarts, Cpu, Memory, Late, Max, Skipped, Invalid, Recent]
};

/// Show the stages.
#[derive(Clone, Debug, Args)]
pub struct TopArgs {
    /// Print the screen once, as plain text, after 3 seconds (or --seconds).
    #[arg(long)]
    pub once: bool,
    /// Columns to show, separated by commas. By default all are shown; a narrow terminal hides the less important ones.
    #[arg(long, value_enum, value_delimiter = ',')]
    pub columns: Vec<Column>,
    /// Column to sort by, largest value first; `stage` is the order of the data flow. Keys: s next column, r reverse.
    #[arg(long, value_enum, default_value_t = Column::Stage)]
    pub sort: Column,
    /// Reverse the order.
    #[arg(long)]
    pub reverse: bool,
    /// The run, and the time limit.
    #[command(flatten)]
    pub session: SessionArgs,
}

/// Columns and order of the table.
#[derive(Clone, Debug)]
struct Shape {
    columns: Vec<Column>,
    sort: Column,
    reverse: bool,
}

impl Shape {
    fn of(args: &TopArgs) -> Self {
        let all = || Column::value_variants().to_vec();
        let columns = if args.columns.is_empty() { all() } else { args.columns.clone() };
        Self { columns, sort: args.sort, reverse: args.reverse }
    }

    /// Returns the columns that fit a width with whole values, and their widths. At least one is shown.
    fn fit(&self, rows: &[Stats], width: usize) -> Vec<(Column, usize)> {
        let mut shown: Vec<(Column, usize)> = self.columns.iter().map(|&c| (c, c.width(rows))).collect();
        let rank = |column: Column| PRIORITY.iter().position(|&c| c == column);
        while shown.iter().map(|(_, width)| width + 1).sum::<usize>() - 1 > width && shown.len() > 1 {
            let last = (0..shown.len()).max_by_key(|&i| rank(shown[i].0)).unwrap_or_default();
            shown.remove(last);
        }
        shown
    }

    /// Obeys a key. Returns false if it asks to quit.
    fn obey(&mut self, code: KeyCode, modifiers: KeyModifiers) -> bool {
        match code {
            KeyCode::Char('c') => return !modifiers.contains(KeyModifiers::CONTROL),
            KeyCode::Char('q') | KeyCode::Esc => return false,
            KeyCode::Char('s') => {
                let at = self.columns.iter().position(|&c| c == self.sort).map_or(0, |at| at + 1);
                self.sort = self.columns[at % self.columns.len()];
            }
            KeyCode::Char('r') => self.reverse = !self.reverse,
            _ => {}
        }
        true
    }
}

pub(super) fn run(args: &TopArgs) -> anyhow::Result<()> {
    let mut session_args = args.session.clone();
    if args.once {
        session_args.seconds = session_args.seconds.or(Some(ONCE_S));
    }
    ensure!(args.once || std::io::stdout().is_terminal(), "the output is not a terminal: use --once");
    let mut session = Session::open(&session_args, "probe-top")?;
    session.listen(RunVitals::topics())?;
    let (mut vitals, mut shape) = (RunVitals::default(), Shape::of(args));
    let live = session.attached.live.clone();
    if args.once {
        let going = vitals.gather(&mut session, |_| Ok(true))?;
        let size = std::io::stdout().is_terminal().then(|| terminal::size().ok()).flatten();
        print!("{}", plain(&live, &vitals, &shape, size.map_or(usize::MAX, |(width, _)| width.into())));
        session.say_end(going);
        return Ok(());
    }
    let mut terminal = ratatui::try_init().context("cannot initialise the terminal")?;
    let mut draw_ns = 0;
    let result = vitals.gather(&mut session, |vitals| {
        while event::poll(Duration::ZERO)? {
            if let Event::Key(key) = event::read()? {
                if !shape.obey(key.code, key.modifiers) {
                    return Ok(false);
                }
                draw_ns = 0;
            }
        }
        let now_ns = monotonic_now_ns();
        if now_ns >= draw_ns {
            draw_ns = now_ns + DRAW_NS;
            terminal.draw(|frame| draw(frame, &live, vitals, &shape))?;
        }
        Ok(true)
    });
    ratatui::restore();
    session.say_end(result?);
    Ok(())
}

/// Returns the facts about the whole run.
fn summary(live: &LiveRun, vitals: &RunVitals) -> Vec<String> {
    let decided: Vec<f64> = vitals.decided_ms.iter().copied().collect();
    let ms = |q| percentile(&decided, q).map_or("-".to_owned(), |v| format!("{v:.1}"));
    let (action, reason) = vitals.last_action.unwrap_or(("-", "-"));
    vec![
        format!("run {}", live.name),
        format!("graph {}", live.graph.file_name().map(|n| n.to_string_lossy()).unwrap_or_default()),
        format!("action {action} ({reason})"),
        format!("hazard {:.3}, unknown {:.3}", vitals.hazard_probability, vitals.unknown_probability),
        format!("camera to action p50 {} ms, p99 {} ms", ms(0.5), ms(0.99)),
        format!("since the start of this probe: frames {}", vitals.frames),
        format!("decisions {}", vitals.decisions),
        format!("safe actions {}", vitals.safe_actions.values().sum::<u64>()),
    ]
}

/// Puts texts into lines of at most this width; a text is not broken.
fn lines(texts: &[String], width: usize) -> Vec<String> {
    let mut lines: Vec<String> = Vec::new();
    for text in texts {
        match lines.last_mut() {
            Some(line) if line.chars().count() + 3 + text.chars().count() <= width => {
                line.push_str("   ");
                line.push_str(text);
            }
            _ => lines.push(text.clone()),
        }
    }
    lines
}

/// Returns the lines above the table: the facts about the run, and the camera's conditions in a line of their own.
fn heading(live: &LiveRun, vitals: &RunVitals, width: usize) -> Vec<String> {
    let mut heading = lines(&summary(live, vitals), width);
    heading.push(vitals.conditions.line(width.min(CAMERA_WIDTH)));
    heading
}

/// Returns the screen as plain text.
fn plain(live: &LiveRun, vitals: &RunVitals, shape: &Shape, width: usize) -> String {
    let stats = rows(vitals, shape);
    let fit = shape.fit(&stats, width);
    let mut table = vec![fit.iter().map(|(column, _)| column.head().to_owned()).collect::<Vec<_>>()];
    table.extend(stats.iter().map(|row| fit.iter().map(|(column, _)| column.text(row)).collect()));
    format!("{}\n\n{}", heading(live, vitals, width.min(PLAIN_WIDTH)).join("\n"), columns(&table))
}

fn sparks(values: &VecDeque<f64>) -> String {
    const LEVELS: [char; 8] =
        ['\u{2581}', '\u{2582}', '\u{2583}', '\u{2584}', '\u{2585}', '\u{2586}', '\u{2587}', '\u{2588}'];
    let recent: Vec<f64> = values.iter().rev().take(SPARKS).rev().copied().collect();
    let top = recent.iter().copied().fold(1e-9, f64::max);
    recent.iter().map(|v| LEVELS[((v / top * 7.99) as usize).min(7)]).collect()
}

/// A stage with its observations.
#[derive(Clone, Debug)]
struct Stats {
    stage: Stage,
    state: &'static str,
    rate_hz: f64,
    vitals: StageVitals,
}

impl Column {
    fn head(self) -> &'static str {
        match self {
            Self::Stage => "stage",
            Self::State => "state",
            Self::Rate => "rate",
            Self::Latency => "latency",
            Self::Max => "max",
            Self::Recent => "recent latency",
            Self::Cpu => "CPU",
            Self::Memory => "memory",
            Self::Skipped => "skipped",
            Self::Invalid => "invalid",
            Self::Errors => "errors",
            Self::Restarts => "restarts",
            Self::Late => "late",
        }
    }

    /// Returns the width of the widest value; at least a usual one, so that columns keep their places.
    fn width(self, rows: &[Stats]) -> usize {
        let usual = match self {
            Self::Stage | Self::State => 10,
            Self::Rate | Self::Latency | Self::Max => 9,
            Self::Recent => SPARKS,
            Self::Cpu => 5,
            Self::Memory => 7,
            _ => self.head().len(),
        };
        rows.iter().map(|row| self.text(row).chars().count()).fold(usual, usize::max)
    }

    /// Returns the value that the stage is sorted by.
    fn key(self, row: &Stats) -> f64 {
        let v = &row.vitals;
        match self {
            Self::Stage => -f64::from(row.stage.code()),
            Self::State => f64::from(severity(row.state)),
            Self::Rate => row.rate_hz,
            Self::Latency | Self::Recent => v.latency_ms.back().copied().unwrap_or_default(),
            Self::Max => v.max_latency_ms,
            Self::Cpu => v.cpu,
            Self::Memory => v.rss_bytes as f64,
            Self::Skipped => v.counts[0] as f64,
            Self::Invalid => v.counts[1] as f64,
            Self::Errors => v.counts[2] as f64,
            Self::Restarts => v.restarts as f64,
            Self::Late => v.late as f64,
        }
    }

    fn text(self, row: &Stats) -> String {
        let v = &row.vitals;
        match self {
            Self::Stage => row.stage.name().to_owned(),
            Self::State => row.state.to_owned(),
            Self::Rate => format!("{:.1} Hz", row.rate_hz),
            Self::Latency => v.latency_ms.back().map_or("-".to_owned(), |ms| format!("{ms:.2} ms")),
            Self::Max => format!("{:.1} ms", v.max_latency_ms),
            Self::Recent => sparks(&v.latency_ms),
            Self::Cpu => format!("{:.0} %", v.cpu * 100.0),
            Self::Memory => format!("{} MB", v.rss_bytes / 1_000_000),
            _ => format!("{}", self.key(row)),
        }
    }

    fn colour(self, row: &Stats) -> Option<Color> {
        match self {
            Self::State => Some([Color::Green, Color::Yellow, Color::Red][usize::from(severity(row.state))]),
            Self::Recent => Some(Color::Cyan),
            Self::Skipped | Self::Invalid | Self::Errors | Self::Restarts | Self::Late => {
                (self.key(row) == 0.0).then_some(Color::DarkGray)
            }
            _ => None,
        }
    }
}

/// Returns 0 for a healthy state, 1 for one that may pass, and 2 for the others.
fn severity(state: &str) -> u8 {
    match state {
        "ok" | "done" => 0,
        "slow" | "stale" | "starting" | "restarting" => 1,
        _ => 2,
    }
}

fn rows(vitals: &RunVitals, shape: &Shape) -> Vec<Stats> {
    let now_ns = monotonic_now_ns();
    let stats = |stage| {
        let vitals = vitals.stages.get(&stage).cloned().unwrap_or_default();
        Stats { stage, state: vitals.state_name(now_ns), rate_hz: vitals.rate_hz(now_ns), vitals }
    };
    let mut rows: Vec<Stats> = Stage::ALL.into_iter().map(stats).collect();
    rows.sort_by(|a, b| shape.sort.key(b).total_cmp(&shape.sort.key(a)));
    if shape.reverse {
        rows.reverse();
    }
    rows
}

fn draw(frame: &mut Frame<'_>, live: &LiveRun, vitals: &RunVitals, shape: &Shape) {
    let width = usize::from(frame.area().width);
    let (stats, heading) = (rows(vitals, shape), heading(live, vitals, width));
    let fit = shape.fit(&stats, width.saturating_sub(2));
    let mut hint = vec!["q quits".to_owned(), "s, r: sort, reverse".to_owned()];
    let hidden = shape.columns.len() - fit.len();
    if hidden > 0 {
        hint.push(format!("{hidden} columns hidden: widen, or choose with --columns"));
    }
    let hint = lines(&hint, width);
    let heights = [heading.len() as u16 + 1, stats.len() as u16 + 3, hint.len() as u16].map(Constraint::Length);
    let areas = Layout::vertical(heights).split(frame.area());
    let no_colour = std::env::var_os("NO_COLOR").is_some_and(|v| !v.is_empty());
    let style = |c: Option<Color>| c.filter(|_| !no_colour).map_or(Style::new(), |c| Style::new().fg(c));
    frame.render_widget(Paragraph::new(heading.join("\n")), areas[0]);
    let body = stats.iter().map(|row| {
        Row::new(fit.iter().map(|(column, _)| Cell::from(Span::styled(column.text(row), style(column.colour(row))))))
    });
    let head = fit.iter().map(|(column, _)| column.head());
    let title = format!(" stages by {}{} ", shape.sort.head(), if shape.reverse { ", reversed" } else { "" });
    let table = Table::new(body, fit.iter().map(|(_, width)| Constraint::Length(*width as u16)))
        .header(Row::new(head).bold())
        .column_spacing(1)
        .block(Block::bordered().title(title));
    frame.render_widget(table, areas[1]);
    frame.render_widget(Paragraph::new(hint.join("\n")).style(style(Some(Color::DarkGray))), areas[2]);
}

#[cfg(test)]
mod tests {
    use super::*;
    use carff_messages::forms::AnyMessage;
    use carff_messages::{Header, ImageCheck, ImageCondition};
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

    fn shape() -> Shape {
        Shape { columns: Column::value_variants().to_vec(), sort: Column::Stage, reverse: false }
    }

    fn screen(width: u16, vitals: &RunVitals, shape: &Shape) -> String {
        let mut terminal = Terminal::new(TestBackend::new(width, 20)).unwrap();
        terminal.draw(|frame| draw(frame, &live(), vitals, shape)).unwrap();
        terminal.backend().to_string()
    }

    /// A run with wide values in each column.
    fn busy() -> RunVitals {
        let mut vitals = RunVitals { frames: 1_234_567, decisions: 1_234_321, ..RunVitals::default() };
        for condition in ImageCondition::ALL {
            let usable = ImageCheck::of_frame(Header::default());
            vitals.take(AnyMessage::new(&ImageCheck { condition: condition.code(), ..usable }, &[]));
        }
        vitals.decided_ms.extend([123.4, 567.8]);
        for (i, stage) in (1..).zip(Stage::ALL) {
            let v = vitals.stages.entry(stage).or_default();
            v.latency_ms.extend([1234.56 + f64::from(i), 2000.0 + f64::from(i)]);
            (v.max_latency_ms, v.rss_bytes, v.cpu) = (99_999.9, 12_345_000_000, 15.99);
            (v.counts, v.restarts, v.late) = ([i as u64, 7_654_321, 7_654_322], 7_654_323, 7_654_324);
        }
        vitals
    }

    /// Each screen names the run, the camera's condition and every stage. Every shown column has its whole values; a narrow terminal shows the
    /// important columns, and reports the number of hidden ones.
    #[test]
    fn narrow_screens_hide_whole_columns() {
        for (width, vitals, least) in [
            (
                80,
                RunVitals::default(),
                &["state", "rate", "latency", "errors", "restarts", "CPU", "memory", "late"][..],
            ),
            (100, RunVitals::default(), &["max", "skipped"][..]),
            (140, RunVitals::default(), &["invalid", "recent latency"][..]),
            (80, busy(), &["state", "rate", "latency", "errors", "restarts"][..]),
            (100, busy(), &["CPU", "memory"][..]),
            (140, busy(), &["late", "max", "skipped", "invalid"][..]),
        ] {
            let screen = screen(width, &vitals, &shape());
            assert!(least.iter().all(|head| screen.contains(head)), "{width}: {screen}");
            let rows = rows(&vitals, &shape());
            let fit = shape().fit(&rows, usize::from(width) - 2);
            for row in &rows {
                let begin = format!("\u{2502}{}", row.stage.name());
                let line = screen.lines().find(|l| l.contains(&begin)).unwrap_or_default();
                for (column, _) in &fit {
                    let text = column.text(row);
                    assert!(
                        line.contains(&format!("{text} ")) || line.contains(&format!("{text}\u{2502}")),
                        "{text}: {line}"
                    );
                }
            }
            let camera = vitals.conditions.line(usize::from(width).min(CAMERA_WIDTH));
            assert!(screen.lines().any(|l| l.trim_matches('"').trim_end() == camera), "{width}: {camera}: {screen}");
            for fact in summary(&live(), &vitals) {
                assert!(screen.contains(&fact), "{width}: {fact}: {screen}");
            }
            assert_eq!(screen.contains("columns hidden"), fit.len() < 13, "{width}: {screen}");
        }
        screen(3, &busy(), &shape());
    }

    /// Rows are sorted by any column. Keys change the column and the order, and quit; columns are those that were
    /// named.
    #[test]
    fn rows_are_sorted_and_columns_are_chosen() {
        let mut shape = Shape { columns: vec![Column::Skipped, Column::Stage], sort: Column::Skipped, reverse: false };
        let order = |shape: &Shape| rows(&busy(), shape).iter().map(|row| row.stage).collect::<Vec<_>>();
        let flow = Stage::ALL.to_vec();
        assert_eq!(order(&shape), flow.iter().rev().copied().collect::<Vec<_>>());
        assert!(shape.obey(KeyCode::Char('r'), KeyModifiers::NONE));
        assert_eq!(order(&shape), flow);
        assert!(
            shape.obey(KeyCode::Char('s'), KeyModifiers::NONE) && shape.obey(KeyCode::Char('r'), KeyModifiers::NONE)
        );
        assert_eq!((shape.sort, order(&shape)), (Column::Stage, flow));
        let text = plain(&live(), &busy(), &shape, usize::MAX);
        assert!(text.lines().any(|l| l.trim_end() == "skipped  stage"), "{text}");
        assert!(!shape.obey(KeyCode::Char('q'), KeyModifiers::NONE) && !shape.obey(KeyCode::Esc, KeyModifiers::NONE));
        assert!(!shape.obey(KeyCode::Char('c'), KeyModifiers::CONTROL));
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
