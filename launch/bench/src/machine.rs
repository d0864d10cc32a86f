//! Describes the machine of the figures.

use serde_json::{Value, json};
use std::path::Path;
use std::time::SystemTime;

/// Instruction sets that the kernels use, in the system's spelling.
const FEATURES: [&str; 9] = ["avx2", "fma", "f16c", "avx512f", "avx512vl", "avx512_bf16", "amx_bf16", "asimd", "bf16"];

/// Returns processor, its features, cores, memory, system, libtorch and date. Unknown values are null; so is libtorch in
/// a program without it.
pub(crate) fn describe() -> Value {
    let cpuinfo = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let field = |name: &str| {
        let line = cpuinfo.lines().find(|l| l.split(':').next().is_some_and(|key| key.trim() == name))?;
        Some(line.split_once(':')?.1.trim().to_owned())
    };
    let family = field("cpu family").zip(field("model")).or_else(|| field("CPU implementer").zip(field("CPU part")));
    let flags = field("flags").or(field("Features")).unwrap_or_default();
    let flags: Vec<&str> = flags.split_whitespace().collect();
    let meminfo = std::fs::read_to_string("/proc/meminfo").unwrap_or_default();
    let memory_kb = meminfo.lines().find_map(|l| {
        l.strip_prefix("MemTotal:").and_then(|v| v.split_whitespace().next()).and_then(|v| v.parse::<f64>().ok())
    });
    json!({
        "cpu": field("model name"),
        "cpu_family_and_model": family.map(|(f, m)| format!("{f}/{m}")),
        "features": FEATURES.iter().filter(|f| flags.contains(f)).collect::<Vec<_>>(),
        "cores": std::thread::available_parallelism().map(usize::from).ok(),
        "memory_gb": memory_kb.map(|kb| (kb / 1e6 * 10.0).round() / 10.0),
        "system": std::fs::read_to_string("/proc/sys/kernel/osrelease").ok().map(|s| s.trim().to_owned()),
        "libtorch": libtorch_version(),
        "date": date(SystemTime::now().duration_since(SystemTime::UNIX_EPOCH).unwrap_or_default().as_secs()),
    })
}

/// Returns the description as a sentence.
pub(crate) fn sentence(machine: &Value) -> String {
    let text = |key: &str| machine[key].as_str().unwrap_or("unknown").to_owned();
    let features: Vec<&str> = machine["features"].as_array().into_iter().flatten().filter_map(Value::as_str).collect();
    format!(
        "{} ({}; {}), {} cores, {} GB, Linux {}{}, {}",
        text("cpu"),
        text("cpu_family_and_model"),
        features.join(" "),
        machine["cores"],
        machine["memory_gb"],
        text("system"),
        machine["libtorch"].as_str().map_or(String::new(), |version| format!(", libtorch {version}")),
        text("date")
    )
}

/// Returns the version of the libtorch that this process runs, from a file next to the library.
fn libtorch_version() -> Option<String> {
    let maps = std::fs::read_to_string("/proc/self/maps").ok()?;
    let library = maps.lines().find(|l| l.contains("libtorch_cpu.so")).and_then(|l| l.split_whitespace().nth(5))?;
    let version = Path::new(library).parent()?.parent()?.join("build-version");
    Some(std::fs::read_to_string(version).ok()?.trim().to_owned())
}

/// Returns the Gregorian date of a time since 1970, UTC.
fn date(unix_s: u64) -> String {
    // Days since 1 March of the year 0, so that leap days end a year (400 years have 146097 days).
    let days = unix_s / 86_400 + 719_468;
    let (era, day) = (days / 146_097, days % 146_097);
    let year = (day - day / 1460 + day / 36_524 - day / 146_096) / 365;
    let day = day - (365 * year + year / 4 - year / 100);
    let month = (5 * day + 2) / 153;
    let day = day - (153 * month + 2) / 5 + 1;
    let (year, month) = if month < 10 { (era * 400 + year, month + 3) } else { (era * 400 + year + 1, month - 9) };
    format!("{year}-{month:02}-{day:02}")
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Dates are correct at the ends of months, and in leap years.
    #[test]
    fn dates_are_right() {
        for (unix_s, want) in [
            (0, "1970-01-01"),
            (951_782_399, "2000-02-28"),
            (951_782_400, "2000-02-29"),
            (951_868_800, "2000-03-01"),
            (1_709_164_800, "2024-02-29"),
            (1_735_689_599, "2024-12-31"),
            (1_735_689_600, "2025-01-01"),
            (4_107_542_400, "2100-03-01"),
        ] {
            assert_eq!(date(unix_s), want);
        }
    }

    /// The description contains all values that a reader of figures needs.
    #[test]
    fn descriptions_are_complete() {
        let machine = describe();
        assert!(machine["cores"].as_u64().is_some_and(|n| n > 0));
        for key in ["cpu", "features", "memory_gb", "libtorch", "date"] {
            assert!(machine.get(key).is_some(), "{key}");
        }
        assert!(sentence(&machine).contains("cores"));
    }
}
