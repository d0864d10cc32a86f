//! Judges processor, memory, clock and disk.

use super::size::size;
use crate::doctor::finding::{Area, Finding};
use carff_config::StagesConfig;
use std::path::Path;

/// Memory that the six processes of a graph need, with a margin.
const GRAPH_BYTES: u64 = 1 << 30;
/// Clock sources whose reading takes a microsecond or more.
const SLOW_CLOCKS: [&str; 4] = ["hpet", "acpi_pm", "jiffies", "refined-jiffies"];
/// Governors that raise the clock rate only after a longer load.
const SLOW_GOVERNORS: [&str; 2] = ["powersave", "conservative"];
/// Free disk space below which recordings soon fill the disk, and below which nothing can be written.
const DISK_BYTES: (u64, u64) = (2 << 30, 64 << 20);

/// Checks the processor's features, named as the system names them.
pub fn processor(name: &str, features: &[&str]) -> Finding {
    let has = |all: &[&str]| all.iter().all(|f| features.contains(f));
    if has(&["asimd"]) {
        return Finding::ok(Area::Machine, "processor", format!("{name}, 64-bit Arm with NEON"));
    }
    if !has(&["avx2", "fma"]) {
        return Finding::warning(
            Area::Machine,
            "processor",
            format!("{name}, without AVX2 and FMA"),
            "the field uses portable kernels, which are several times slower",
            "use an x86-64 processor of 2013 or later, or a 64-bit Arm processor; in a virtual machine, pass the host's \
             processor through (QEMU: -cpu host)",
        );
    }
    let wide = if has(&["avx512f", "avx512vl"]) { ", AVX-512" } else { "" };
    Finding::ok(Area::Machine, "processor", format!("{name}, with AVX2 and FMA{wide}"))
}

/// Compares cores with the threads of a graph. Encoder, forecaster and prober run one after another; the renderer runs
/// in parallel.
pub fn cores(cores: usize, stages: &StagesConfig) -> Finding {
    let path = stages.encoder.threads.max(stages.forecaster.threads).max(stages.prober.threads);
    let wanted = (path + stages.renderer.threads) as usize;
    if cores >= wanted {
        return Finding::ok(Area::Machine, "cores", format!("{cores}, for {wanted} concurrent threads"));
    }
    Finding::warning(
        Area::Machine,
        "cores",
        format!(
            "{cores}, for {wanted} concurrent threads ({path} on the frame, {} rendering)",
            stages.renderer.threads
        ),
        "stages wait for each other: frames are skipped, and actions come late",
        "lower `stages.*.threads` in the graph file, or give the machine (or container) more cores",
    )
}

/// Checks the memory available to programs, bytes.
pub fn memory(available_bytes: u64) -> Finding {
    if available_bytes >= GRAPH_BYTES {
        return Finding::ok(Area::Machine, "memory", format!("{} available", size(available_bytes)));
    }
    Finding::warning(
        Area::Machine,
        "memory",
        format!("{} available, and a graph needs about {}", size(available_bytes), size(GRAPH_BYTES)),
        "the system may swap, or kill a stage",
        "end other programs, or give the machine (or container) more memory",
    )
}

/// Measurements of the monotonic clock over many readings.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Clock {
    /// Name of the clock source.
    pub source: Option<String>,
    /// Number of readings below the previous one.
    pub steps_back: u32,
    /// Duration of a reading, nanoseconds.
    pub reading_ns: f64,
}

/// Checks the clock that orders all messages.
pub fn clock(clock: &Clock) -> Finding {
    let name = clock.source.as_deref().unwrap_or("unknown source");
    let found = format!("{name}, {:.0} ns a reading", clock.reading_ns);
    if clock.steps_back > 0 {
        return Finding::error(
            Area::Machine,
            "clock",
            format!("{found}; it went back {} times", clock.steps_back),
            "messages are ordered by this clock: new frames would look old",
            "choose another clock source (/sys/devices/system/clocksource/clocksource0), and report it to the maker of \
             the machine",
        );
    }
    if SLOW_CLOCKS.contains(&name) {
        return Finding::warning(
            Area::Machine,
            "clock",
            found,
            "every message reads it several times, and each reading needs at least a system call",
            "boot with tsc=reliable if the processor's counter is reliable; in a virtual machine, choose the host's \
             clock (kvm-clock)",
        );
    }
    Finding::ok(Area::Machine, "clock", found)
}

/// Checks the governors of the cores' clock rates; the list is empty if the host controls the rates.
pub fn governor(governors: &[String]) -> Finding {
    let slow = governors.iter().filter(|g| SLOW_GOVERNORS.contains(&g.as_str())).count();
    if let Some(name) = governors.iter().find(|g| SLOW_GOVERNORS.contains(&g.as_str())) {
        return Finding::warning(
            Area::Machine,
            "governor",
            format!("{name} on {slow} of {} cores", governors.len()),
            "cores return to a low clock rate between frames: each frame takes longer",
            "sudo cpupower frequency-set -g performance",
        );
    }
    let mut names = governors.to_vec();
    names.sort();
    names.dedup();
    let found =
        if names.is_empty() { "none here (virtual machine, or fixed rate)".to_owned() } else { names.join(", ") };
    Finding::ok(Area::Machine, "governor", found)
}

/// Checks the free space of the current folder, which receives datasets, reports and recordings.
pub fn disk(folder: &Path, free_bytes: u64) -> Finding {
    let found = format!("{} free in {}", size(free_bytes), folder.display());
    let advice = "free some space, or start in another folder";
    if free_bytes < DISK_BYTES.1 {
        return Finding::error(Area::Machine, "disk", found, "no dataset, report or recording can be written", advice);
    }
    if free_bytes < DISK_BYTES.0 {
        return Finding::warning(Area::Machine, "disk", found, "a recording of a few minutes fills the disk", advice);
    }
    Finding::ok(Area::Machine, "disk", found)
}

#[cfg(test)]
mod tests {
    use super::super::testing::{MIB, assert_level};
    use super::*;
    use crate::doctor::finding::Level;

    /// Kernels need AVX2 and FMA, or NEON (which Linux calls asimd); AVX-512 is mentioned if present.
    #[test]
    fn processors() {
        assert_level(&processor("old", &["sse4_2"]), Level::Warning);
        assert_level(&processor("half", &["avx2"]), Level::Warning);
        assert_level(&processor("new", &["avx2", "fma"]), Level::Ok);
        assert_level(&processor("arm", &["fp", "asimd"]), Level::Ok);
        assert!(processor("newer", &["avx2", "fma", "avx512f", "avx512vl"]).found.ends_with("AVX-512"));
    }

    /// The largest path stage and the renderer together decide how many cores are needed.
    #[test]
    fn cores_against_threads() {
        let mut stages = StagesConfig::default();
        assert_level(&cores(2, &stages), Level::Ok);
        assert_level(&cores(1, &stages), Level::Warning);
        (stages.encoder.threads, stages.prober.threads) = (3, 2);
        assert_level(&cores(4, &stages), Level::Ok);
        assert_level(&cores(3, &stages), Level::Warning);
    }

    /// A clock that goes back is an error, a slow clock is a warning, any other clock is ok.
    #[test]
    fn clocks() {
        let with = |source: Option<&str>, steps_back| {
            clock(&Clock { source: source.map(str::to_owned), steps_back, reading_ns: 20.0 })
        };
        assert_level(&with(Some("tsc"), 0), Level::Ok);
        assert_level(&with(None, 0), Level::Ok);
        assert_level(&with(Some("hpet"), 0), Level::Warning);
        assert_level(&with(Some("tsc"), 1), Level::Error);
    }

    /// One slow governor causes a warning; no governor is ok.
    #[test]
    fn governors() {
        let with = |names: &[&str]| governor(&names.iter().map(|&n| n.to_owned()).collect::<Vec<_>>());
        assert_level(&with(&["performance", "performance"]), Level::Ok);
        assert_level(&with(&[]), Level::Ok);
        let slow = with(&["performance", "powersave"]);
        assert_level(&slow, Level::Warning);
        assert!(slow.found.contains("powersave on 1 of 2"), "{slow:?}");
    }

    /// Memory and disk have their limits; the disk has two.
    #[test]
    fn room() {
        assert_level(&memory(4 << 30), Level::Ok);
        assert_level(&memory(100 * MIB), Level::Warning);
        assert_level(&disk(Path::new("here"), 100 << 30), Level::Ok);
        assert_level(&disk(Path::new("here"), 500 * MIB), Level::Warning);
        assert_level(&disk(Path::new("here"), MIB), Level::Error);
    }
}
