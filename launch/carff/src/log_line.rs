//! One line of the log of a stage or the launcher, as text or as JSON.

use carff_config::LogFormat;
use jiff::Timestamp;
use serde_json::{Map, Value};

/// Levels as stages write them, in text and in JSON.
const LEVELS: [&str; 5] = ["ERROR", "WARN", "INFO", "DEBUG", "TRACE"];

/// Formats a line for output. `source` is a stage's name or `launcher`. `said` is the line that it wrote: a JSON
/// object, or text that may begin with a level. Text has the time of day (UTC), JSON has date and time.
pub(crate) fn formatted(format: LogFormat, time: &Timestamp, source: &str, said: &str) -> String {
    match format {
        LogFormat::Text => format!("{} [{source}] {}", time.strftime("%H:%M:%S%.3fZ"), said.trim_start()),
        LogFormat::Json => {
            let mut object = fields(said);
            object.insert("time".into(), time.to_string().into());
            object.insert("source".into(), source.into());
            Value::Object(object).to_string()
        }
    }
}

/// Reads a line of a log file, written before `now`. A line of another form is a warning of the launcher at `now`.
#[cfg(feature = "recording")]
pub(crate) fn parsed(line: &str, now: &Timestamp) -> carff_recording::LogLine {
    let text = |time: Timestamp, source: &str, said: &str| {
        let mut fields = fields(said);
        let mut take = |key| fields.remove(key).and_then(|v| v.as_str().map(str::to_owned));
        let (source, level) = (take("source").unwrap_or(source.to_owned()), take("level").unwrap_or("WARN".to_owned()));
        let time = take("time").and_then(|time| time.parse().ok()).unwrap_or(time);
        let message = take("message").unwrap_or_default();
        let rest = fields.iter().map(|(key, value)| format!(" {key}={value}"));
        let message = std::iter::once(message).chain(rest).collect();
        carff_recording::LogLine { wall_ns: u64::try_from(time.as_nanosecond()).unwrap_or(0), source, level, message }
    };
    let (clock, rest) = line.split_once(" [").unwrap_or_default();
    let date = now.strftime("%Y-%m-%d");
    match (format!("{date}T{clock}").parse::<Timestamp>(), rest.split_once("] ")) {
        // The time of day is in the past: after midnight it is that of the day before.
        (Ok(time), Some((source, said))) if time > *now => {
            text(time.saturating_sub(jiff::SignedDuration::from_hours(24)).unwrap_or(time), source, said)
        }
        (Ok(time), Some((source, said))) => text(time, source, said),
        _ => text(*now, "launcher", line),
    }
}

/// Returns the message of a line that reports an error.
pub fn error_in(said: &str) -> Option<String> {
    let fields = fields(said);
    let text = |key: &str| fields.get(key).and_then(Value::as_str).unwrap_or_default();
    (text("level") == "ERROR" || text("message").contains("panicked at")).then(|| text("message").to_owned())
}

/// Returns level, message and fields of a line. A line without a level, such as a panic or a library's output, is a
/// warning.
fn fields(said: &str) -> Map<String, Value> {
    if let Ok(Value::Object(fields)) = serde_json::from_str(said) {
        return fields;
    }
    let said = said.trim();
    let (level, message) = match said.split_once(' ') {
        Some((word, rest)) if LEVELS.contains(&word) => (word, rest.trim()),
        _ => ("WARN", said),
    };
    Map::from_iter([("level".to_owned(), level.into()), ("message".to_owned(), message.into())])
}

#[cfg(test)]
mod tests {
    use super::*;

    const TIME: Timestamp = Timestamp::constant(1_767_225_600, 0);

    fn json(said: &str) -> Value {
        serde_json::from_str(&formatted(LogFormat::Json, &TIME, "encoder", said)).unwrap()
    }

    /// Text is passed on with the time and the source. In JSON every line is an object with time, source, level and
    /// message, and keeps the fields of the stage.
    #[test]
    fn every_line_has_its_form() {
        assert_eq!(
            formatted(LogFormat::Text, &TIME, "encoder", " INFO ready threads=1"),
            "00:00:00.000Z [encoder] INFO ready threads=1"
        );
        let ready = json(r#"{"level":"INFO","message":"ready","threads":1}"#);
        assert_eq!(
            (&ready["source"], &ready["message"], &ready["threads"]),
            (&"encoder".into(), &"ready".into(), &1.into())
        );
        assert_eq!(ready["time"], "2026-01-01T00:00:00Z");
        for (said, level, message) in [
            ("ERROR no weights: gone", "ERROR", "no weights: gone"),
            (" WARN late", "WARN", "late"),
            ("thread 'main' panicked at x.rs:1", "WARN", "thread 'main' panicked at x.rs:1"),
            ("[1, 2]", "WARN", "[1, 2]"),
            ("", "WARN", ""),
        ] {
            let line = json(said);
            assert_eq!((line["level"].as_str(), line["message"].as_str()), (Some(level), Some(message)), "{said}");
        }
    }

    /// Errors are found in both forms, and no other line is an error.
    #[test]
    fn errors_are_found_in_both_forms() {
        assert_eq!(error_in("ERROR no weights"), Some("no weights".into()));
        assert_eq!(error_in(r#"{"level":"ERROR","message":"no weights"}"#), Some("no weights".into()));
        assert!(error_in("thread 'main' panicked at x.rs:1").is_some());
        assert_eq!(error_in(" INFO ready"), None);
        assert_eq!(error_in(r#"{"level":"INFO","message":"no ERROR"}"#), None);
    }

    /// A line of a log file is read back with its time, also one from before midnight, source, level and text.
    #[test]
    #[cfg(feature = "recording")]
    fn lines_are_read_back() {
        let now: Timestamp = "2026-01-02T00:00:01Z".parse().unwrap();
        for format in [LogFormat::Text, LogFormat::Json] {
            for (time, said, level, message) in [
                ("2026-01-01T23:59:59.250Z", " INFO ready threads=1", "INFO", "ready threads=1"),
                ("2026-01-02T00:00:00.500Z", "ERROR no weights: [a] gone", "ERROR", "no weights: [a] gone"),
                ("2026-01-02T00:00:01Z", "thread 'main' panicked", "WARN", "thread 'main' panicked"),
            ] {
                let time: Timestamp = time.parse().unwrap();
                let line = parsed(&formatted(format, &time, "encoder", said), &now);
                let wall_ns = time.as_nanosecond() as u64;
                let (source, level, message) = ("encoder".to_owned(), level.to_owned(), message.to_owned());
                assert_eq!(line, carff_recording::LogLine { wall_ns, source, level, message });
            }
        }
        let said = r#"{"level":"WARN","message":"late","frame":7}"#;
        assert_eq!(parsed(&formatted(LogFormat::Json, &TIME, "prober", said), &now).message, "late frame=7");
        for line in ["", "free text", " [", "12:00 [x] y", "25:00:00Z [x] y"] {
            let read = parsed(line, &now);
            assert_eq!((read.source.as_str(), read.message.as_str()), ("launcher", line.trim()));
        }
    }
}
