//! What a check found, and how it is shown.

use serde::Serialize;
use std::fmt::Write as _;

/// How bad it is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "lowercase")]
pub enum Level {
    /// As it should be.
    Ok,
    /// A graph runs, but slower, or not after the next log-out.
    Warning,
    /// A graph does not start, or decides wrongly.
    Error,
}

/// What it is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Area {
    /// Processor, memory, clock, disk.
    Machine,
    /// Shared memory, and what runs have left in it.
    SharedMemory,
    /// What the system allows this user.
    Limits,
    /// Programs and libraries.
    Programs,
    /// A graph file, and what it names.
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

/// One finding.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct Finding {
    /// What it is about.
    pub area: Area,
    /// The same more closely, in one or two words.
    pub subject: &'static str,
    /// How bad it is.
    pub level: Level,
    /// What was found.
    pub found: String,
    /// What follows from it; empty when all is well.
    pub means: String,
    /// What to do about it; empty when all is well.
    pub advice: String,
}

impl Finding {
    /// As it should be.
    pub fn ok(area: Area, subject: &'static str, found: impl Into<String>) -> Self {
        Self { area, subject, level: Level::Ok, found: found.into(), means: String::new(), advice: String::new() }
    }

    /// A graph runs, but.
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

    /// No graph runs.
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

/// How many are of a level.
pub fn count(findings: &[Finding], level: Level) -> usize {
    findings.iter().filter(|f| f.level == level).count()
}

/// For people: by area, what is not well with its meaning and advice.
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
    let verdict = if errors == 0 { "a graph can run here" } else { "a graph cannot run so" };
    let _ = writeln!(text, "\n{}, {}: {verdict}", counted(errors, "error"), counted(warnings, "warning"));
    text
}

/// For programs.
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
            Finding::error(Area::Graph, "data set", "it is missing", "nothing to drive through", "render it"),
            Finding::ok(Area::Machine, "cores", "2"),
            Finding::warning(Area::Machine, "governor", "powersave", "slow", "change it"),
        ]
    }

    /// Areas come in their order, each finding that is not well says what it means and what to do, and colours are only
    /// there when they are wanted.
    #[test]
    fn text_for_people() {
        let plain = text(&findings(), false);
        let place = |what: &str| plain.find(what).unwrap_or_else(|| panic!("no `{what}` in:\n{plain}"));
        assert!(place("Machine") < place("cores") && place("cores") < place("governor"), "{plain}");
        assert!(place("governor") < place("so: slow") && place("so: slow") < place("do: change it"), "{plain}");
        assert!(place("do: change it") < place("Graph") && place("Graph") < place("render it"), "{plain}");
        assert!(plain.ends_with("1 error, 1 warning: a graph cannot run so\n"), "{plain}");
        assert!(!plain.contains('\x1b') && text(&findings(), true).contains("\x1b[31mERROR"));
        assert!(text(&findings()[1..2], false).ends_with("no errors, no warnings: a graph can run here\n"));
    }

    /// The JSON holds all of it, with levels and areas as words.
    #[test]
    fn json_for_programs() {
        let json = json(&findings());
        assert_eq!((json["errors"].as_u64(), json["warnings"].as_u64()), (Some(1), Some(1)));
        assert_eq!(json["findings"][0]["level"], "error");
        assert_eq!(json["findings"][0]["area"], "graph");
        assert_eq!(json["findings"][2]["advice"], "change it");
    }
}
