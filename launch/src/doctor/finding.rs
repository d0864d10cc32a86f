//! Findings of `carff doctor`, and their display.

use serde::Serialize;
use std::fmt::Write as _;

/// Severity of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// No problem.
    Ok,
    /// A graph runs, but slower, or not after the next log-out.
    Warning,
    /// A graph does not start, or makes wrong decisions.
    Error,
}

/// Area of a finding.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Area {
    /// Processor, memory, clock, disk.
    Machine,
    /// Shared memory, and leftovers of runs.
    SharedMemory,
    /// Resource limits of this user.
    Limits,
    /// Programs and libraries.
    Programs,
    /// A graph file, and the files that it names.
    Graph,
}

impl Area {
    const ALL: [Self; 5] = [Self::Machine, Self::SharedMemory, Self::Limits, Self::Programs, Self::Graph];

    fn title(self) -> &'static str {
        match self {
            Self::Machine => "Machine",
            Self::SharedMemory => "Shared memory",
            Self::Limits => "Limits",
            Self::Programs => "Programs",
            Self::Graph => "Graph",
        }
    }
}

/// A finding of one check.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// Area of the finding.
    pub area: Area,
    /// Subject within the area, in one or two words.
    pub subject: &'static str,
    /// Severity of the finding.
    pub level: Level,
    /// Observed fact.
    pub found: String,
    /// Consequence; empty if there is no problem.
    pub means: String,
    /// Remedy; empty if there is no problem.
    pub advice: String,
}

impl Finding {
    /// Creates a finding without a problem.
    pub fn ok(area: Area, subject: &'static str, found: impl Into<String>) -> Self {
        Self { area, subject, level: Level::Ok, found: found.into(), means: String::new(), advice: String::new() }
    }

    /// Creates a finding with which a graph still runs.
    pub fn warning(
        area: Area,
        subject: &'static str,
        found: impl Into<String>,
        means: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        let (found, means, advice) = (found.into(), means.into(), advice.into());
        Self { area, subject, level: Level::Warning, found, means, advice }
    }

    /// Creates a finding with which no graph runs.
    pub fn error(
        area: Area,
        subject: &'static str,
        found: impl Into<String>,
        means: impl Into<String>,
        advice: impl Into<String>,
    ) -> Self {
        Self { level: Level::Error, ..Self::warning(area, subject, found, means, advice) }
    }
}

/// Returns the number of findings of a level.
pub fn count(findings: &[Finding], level: Level) -> usize {
    findings.iter().filter(|f| f.level == level).count()
}

/// Formats the findings for people: by area, problems with their consequence and remedy.
pub fn text(findings: &[Finding], coloured: bool) -> String {
    let mut text = String::new();
    for area in Area::ALL {
        let here: Vec<&Finding> = findings.iter().filter(|f| f.area == area).collect();
        if here.is_empty() {
            continue;
        }
        let _ = writeln!(text, "{}", area.title());
        for finding in here {
            let (word, colour) = match finding.level {
                Level::Ok => ("ok     ", 32),
                Level::Warning => ("warning", 33),
                Level::Error => ("ERROR  ", 31),
            };
            let word = if coloured { format!("\x1b[{colour}m{word}\x1b[0m") } else { word.to_owned() };
            let _ = writeln!(text, "  {word}  {:<14} {}", finding.subject, finding.found);
            if finding.level != Level::Ok {
                let _ = writeln!(text, "{:26}so: {}", "", finding.means);
                let _ = writeln!(text, "{:26}do: {}", "", finding.advice);
            }
        }
    }
    let counted = |count: usize, what: &str| match count {
        0 => format!("no {what}s"),
        1 => format!("1 {what}"),
        n => format!("{n} {what}s"),
    };
    let (errors, warnings) = (count(findings, Level::Error), count(findings, Level::Warning));
    let verdict = if errors == 0 { "a graph can run here" } else { "a graph cannot run" };
    let _ = writeln!(text, "\n{}, {}: {verdict}", counted(errors, "error"), counted(warnings, "warning"));
    text
}

/// Formats the findings for programs.
pub fn json(findings: &[Finding]) -> serde_json::Value {
    serde_json::json!({
        "errors": count(findings, Level::Error),
        "warnings": count(findings, Level::Warning),
        "findings": findings,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn findings() -> Vec<Finding> {
        vec![
            Finding::error(Area::Graph, "dataset", "it is missing", "nothing to drive through", "render it"),
            Finding::ok(Area::Machine, "cores", "2"),
            Finding::warning(Area::Machine, "governor", "powersave", "slow", "change it"),
        ]
    }

    /// Areas have a fixed order, each problem shows its consequence and remedy, and colours appear only on request.
    #[test]
    fn text_for_people() {
        let plain = text(&findings(), false);
        let place = |what: &str| plain.find(what).unwrap_or_else(|| panic!("no `{what}` in:\n{plain}"));
        assert!(place("Machine") < place("cores") && place("cores") < place("governor"), "{plain}");
        assert!(place("governor") < place("so: slow") && place("so: slow") < place("do: change it"), "{plain}");
        assert!(place("do: change it") < place("Graph") && place("Graph") < place("render it"), "{plain}");
        assert!(plain.ends_with("1 error, 1 warning: a graph cannot run\n"), "{plain}");
        assert!(!plain.contains('\x1b') && text(&findings(), true).contains("\x1b[31mERROR"));
        assert!(text(&findings()[1..2], false).ends_with("no errors, no warnings: a graph can run here\n"));
    }

    /// The JSON contains all fields, with levels and areas as words.
    #[test]
    fn json_for_programs() {
        let json = json(&findings());
        assert_eq!((json["errors"].as_u64(), json["warnings"].as_u64()), (Some(1), Some(1)));
        assert_eq!(json["findings"][0]["level"], "error");
        assert_eq!(json["findings"][0]["area"], "graph");
        assert_eq!(json["findings"][2]["advice"], "change it");
    }
}
