//! Turns facts about the machine into findings. This module does not access the machine.

use super::finding::{Area, Finding};
use carff_config::{StageConfig, StagesConfig};
use carff_messages::Stage;
use std::path::{Path, PathBuf};

/// The libtorch version that the programs are built for.
pub const LIBTORCH: &str = "2.11.0";
/// Memory that the six processes of a graph need, with a margin.
const GRAPH_BYTES: u64 = 1 << 30;
/// Clock sources whose reading takes a microsecond or more.
const SLOW_CLOCKS: [&str; 4] = ["hpet", "acpi_pm", "jiffies", "refined-jiffies"];
/// Governors that raise the clock rate only after a longer load.
const SLOW_GOVERNORS: [&str; 2] = ["powersave", "conservative"];
/// Free disk space below which recordings soon fill the disk, and below which nothing can be written.
const DISK_BYTES: (u64, u64) = (2 << 30, 64 << 20);
/// Locked memory below which a stage cannot be locked.
const LOCKED_BYTES: u64 = 1 << 30;
/// Maximum number of open files of a process in a graph with all probes.
const OPEN_FILES: u64 = 1024;
/// First user number of a person: logind keeps the files of system users.
const FIRST_PERSON: u32 = 1000;

/// Formats a number of bytes.
pub fn size(bytes: u64) -> String {
    const UNITS: [(&str, u64); 3] = [("GiB", 1 << 30), ("MiB", 1 << 20), ("KiB", 1 << 10)];
    match UNITS.iter().find(|(_, unit)| bytes >= *unit) {
        Some((name, unit)) => format!("{:.1} {name}", bytes as f64 / *unit as f64),
        None => format!("{bytes} bytes"),
    }
}

/// Checks the processor's features, named as the system names them.
pub fn processor(name: &str, features: &[&str]) -> Finding {
    let has = |all: &[&str]| all.iter().all(|f| features.contains(f));
    if !has(&["avx2", "fma"]) {
        return Finding::warning(
            Area::Machine,
            "processor",
            format!("{name}, without AVX2 and FMA"),
            "the field uses portable kernels, which are several times slower",
            "use an x86-64 processor of 2013 or later; in a virtual machine, pass the host's processor through \
             (QEMU: -cpu host)",
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

/// The file system of shared memory.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct SharedMemory {
    /// The folder.
    pub folder: PathBuf,
    /// Type of its file system; `None` if it is not mounted.
    pub file_system: Option<String>,
    /// True if this user can create files in it.
    pub writable: bool,
    /// Size, bytes.
    pub size_bytes: u64,
    /// Free space, bytes.
    pub free_bytes: u64,
}

/// Compares shared memory with the needs of a graph.
pub fn shared_memory(memory: &SharedMemory, needed_bytes: u64) -> Vec<Finding> {
    let folder = memory.folder.display();
    let area = Area::SharedMemory;
    let Some(file_system) = &memory.file_system else {
        return vec![Finding::error(
            area,
            "folder",
            format!("{folder} does not exist"),
            "processes cannot exchange images",
            format!("sudo mount -t tmpfs -o size=512m,mode=1777 tmpfs {folder}"),
        )];
    };
    let mut findings = Vec::new();
    findings.push(if !memory.writable {
        Finding::error(
            area,
            "rights",
            format!("this user cannot write to {folder}"),
            "processes cannot exchange images",
            format!("sudo chmod 1777 {folder}"),
        )
    } else if file_system == "tmpfs" {
        Finding::ok(area, "rights", format!("{folder} is writable, and is tmpfs"))
    } else {
        Finding::warning(
            area,
            "rights",
            format!("{folder} is {file_system}, not tmpfs"),
            "images go to a disk: the loop stalls while the disk is busy",
            format!("sudo mount -t tmpfs -o size=512m,mode=1777 tmpfs {folder}"),
        )
    });
    let found = format!(
        "{} free of {}; a graph needs up to {}",
        size(memory.free_bytes),
        size(memory.size_bytes),
        size(needed_bytes)
    );
    let advice = format!(
        "sudo mount -o remount,size={}m {folder}; a container has 64 MB by default: start it with --shm-size=512m",
        (2 * needed_bytes).next_power_of_two().max(512 << 20) >> 20
    );
    findings.push(if memory.free_bytes < needed_bytes {
        Finding::error(area, "size", found, "`carff launch` refuses to start: full shared memory kills stages", advice)
    } else if memory.free_bytes < 2 * needed_bytes {
        Finding::warning(area, "size", found, "a second graph or a viewer may not find enough space", advice)
    } else {
        Finding::ok(area, "size", found)
    });
    findings
}

/// Processes and files of a run.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct RunFiles {
    /// Name of the run.
    pub name: String,
    /// Process number of its launcher, if alive.
    pub launcher: Option<u32>,
    /// Numbers of its living processes.
    pub living: Vec<u32>,
    /// Its small files: a folder and a record.
    pub small: Vec<PathBuf>,
    /// Its files in shared memory.
    pub segments: Vec<PathBuf>,
    /// Total size of the files in shared memory, bytes.
    pub segment_bytes: u64,
}

/// Files in shared memory of no known run of this user.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Strays {
    /// The files.
    pub files: Vec<PathBuf>,
    /// Processes that use them: of a run whose folder is gone.
    pub users: Vec<u32>,
}

/// Checks the folder of new runs.
pub fn run_folder(folder: &Path, writable: bool) -> Finding {
    let shown = folder.display();
    if writable {
        return Finding::ok(Area::Machine, "run folder", format!("{shown} is writable"));
    }
    Finding::error(
        Area::Machine,
        "run folder",
        format!("{shown} cannot be written"),
        "no graph can start, and no probe can join one",
        "set XDG_RUNTIME_DIR or TMPDIR to a folder that this user can write, with a path of at most 20 bytes",
    )
}

/// Reports living runs and the files of dead runs.
pub fn leftovers(runs: &[RunFiles], strays: &Strays) -> Vec<Finding> {
    let area = Area::SharedMemory;
    let list = |pids: &[u32]| pids.iter().map(u32::to_string).collect::<Vec<_>>().join(" ");
    let mut findings: Vec<Finding> = runs
        .iter()
        .map(|run| match (run.launcher, run.living.as_slice()) {
            (Some(pid), living) => {
                Finding::ok(area, "run", format!("`{}` runs: launcher {pid}, {} processes", run.name, living.len()))
            }
            (None, []) if run.segments.is_empty() => Finding::ok(
                area,
                "leftovers",
                format!("run `{}` was killed; its next start removes its remaining small files", run.name),
            ),
            (None, []) => Finding::warning(
                area,
                "leftovers",
                format!(
                    "run `{}` was killed and left {} files in shared memory ({})",
                    run.name,
                    run.segments.len(),
                    size(run.segment_bytes)
                ),
                "they use memory until the next start of the run, which removes them",
                format!("rm -r {}", removal(run)),
            ),
            (None, living) => Finding::warning(
                area,
                "orphans",
                format!("run `{}` has no launcher, but these processes: {}", run.name, list(living)),
                "the run cannot start while they live; stages end by themselves within seconds",
                format!("kill {}", list(living)),
            ),
        })
        .collect();
    if !strays.users.is_empty() {
        findings.push(Finding::error(
            area,
            "lost folder",
            format!("processes {} belong to a run whose folder is gone", list(&strays.users)),
            "no probe sees the run, and none of its stages can restart: a cleaner of temporary files may have removed it",
            format!("stop the run (kill -INT {}), start it again, and keep the cleaner from its folder", strays.users[0]),
        ));
    } else if !strays.files.is_empty() {
        findings.push(Finding::warning(
            area,
            "strays",
            format!("{} files in shared memory belong to no known run", strays.files.len()),
            "they use memory until they are removed",
            format!("if no graph runs: rm {}", words(strays.files.iter().map(PathBuf::as_path))),
        ));
    }
    if findings.is_empty() {
        findings.push(Finding::ok(area, "leftovers", "none, and no run is alive"));
    }
    findings
}

fn removal(run: &RunFiles) -> String {
    words(run.small.iter().chain(&run.segments).map(PathBuf::as_path))
}

/// Formats paths for a command line; many paths become a prefix with `*`.
fn words<'a>(paths: impl Iterator<Item = &'a Path>) -> String {
    let mut words: Vec<String> = paths
        .map(|path| {
            let text = path.display().to_string();
            // A segment's name starts with its run's prefix and an underscore.
            match path.file_name().and_then(|n| n.to_str()).and_then(|n| n.split_once('_')) {
                Some((prefix, _)) if prefix.starts_with("carff") => {
                    path.with_file_name(format!("{prefix}_*")).display().to_string()
                }
                _ => text,
            }
        })
        .collect();
    words.sort();
    words.dedup();
    words.join(" ")
}

/// Resource limits of a process of this user. `None`: unlimited.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Allowed {
    /// Lockable memory, bytes.
    pub locked_bytes: Option<u64>,
    /// Highest real-time priority.
    pub realtime_priority: Option<u64>,
    /// `RLIMIT_NICE`: 20 less the lowest niceness.
    pub nice: Option<u64>,
    /// Number of open files.
    pub open_files: Option<u64>,
    /// True if the user may lock unlimited memory (`CAP_IPC_LOCK`).
    pub may_lock: bool,
    /// True if the user may take any priority (`CAP_SYS_NICE`).
    pub may_schedule: bool,
}

/// Compares limits with the requests of a graph.
pub fn limits(allowed: &Allowed, stages: &StagesConfig) -> Vec<Finding> {
    let area = Area::Limits;
    let without = "the stage logs a warning, and continues without it";
    let raise = |line: &str, unit: &str| {
        format!("write `USER - {line}` to /etc/security/limits.d/carff.conf, log in again; in a systemd unit: {unit}")
    };
    let show = |limit: Option<u64>, show: &dyn Fn(u64) -> String| limit.map_or_else(|| "no limit".to_owned(), show);
    let each = || Stage::ALL.into_iter().map(|stage| (stage.name(), stages.of(stage)));
    let asking = |asks: &dyn Fn(&StageConfig) -> bool| {
        each().filter(|(_, s)| asks(s)).map(|(name, _)| name).collect::<Vec<_>>().join(", ")
    };

    let locking = asking(&|s| s.lock_memory);
    let locked = show(allowed.locked_bytes, &size);
    let may_lock = allowed.may_lock || allowed.locked_bytes.is_none_or(|bytes| bytes >= LOCKED_BYTES);
    let memlock = if locking.is_empty() || may_lock {
        let privilege = if allowed.may_lock { ", and the privilege to lock more" } else { "" };
        Finding::ok(area, "memlock", format!("{locked}{privilege}"))
    } else {
        Finding::warning(
            area,
            "memlock",
            format!("{locked}, and the graph locks the memory of: {locking}"),
            without,
            raise("memlock unlimited", "LimitMEMLOCK=infinity"),
        )
    };

    let highest = each().filter_map(|(_, s)| s.fifo_priority).max().unwrap_or(0);
    let priority = show(allowed.realtime_priority, &|p| p.to_string());
    let may_rise = allowed.may_schedule || allowed.realtime_priority.is_none_or(|p| p >= u64::from(highest));
    let rtprio = if may_rise {
        let privilege = if allowed.may_schedule { ", and the privilege to take any" } else { "" };
        Finding::ok(area, "rtprio", format!("{priority}{privilege}"))
    } else {
        Finding::warning(
            area,
            "rtprio",
            format!("{priority}, and the graph asks for {highest}"),
            without,
            raise("rtprio 99", "LimitRTPRIO=99"),
        )
    };

    let lowest = each().filter_map(|(_, s)| s.nice).min().unwrap_or(0);
    let floor = allowed.nice.map_or(-20, |limit| 20 - limit.min(40) as i64);
    let mut findings = vec![memlock, rtprio];
    if lowest < 0 {
        let found = format!("niceness down to {floor}; the graph asks for {lowest}");
        findings.push(if allowed.may_schedule || i64::from(lowest) >= floor {
            Finding::ok(area, "nice", found)
        } else {
            let (line, unit) = (format!("nice {lowest}"), format!("LimitNICE={lowest}"));
            Finding::warning(area, "nice", found, without, raise(&line, &unit))
        });
    }
    let files = show(allowed.open_files, &|n| n.to_string());
    findings.push(if allowed.open_files.is_none_or(|n| n >= OPEN_FILES) {
        Finding::ok(area, "open files", files)
    } else {
        Finding::warning(
            area,
            "open files",
            format!("{files}; {OPEN_FILES} are usual"),
            "probes and viewers may fail to attach",
            raise("nofile 4096", "LimitNOFILE=4096"),
        )
    });
    findings
}

/// Checks that the processors of the stages' affinities exist.
pub fn bound_cores(online: &[u32], stages: &StagesConfig) -> Option<Finding> {
    let missing: Vec<String> = Stage::ALL
        .into_iter()
        .flat_map(|stage| {
            let cpus = &stages.of(stage).cpus;
            cpus.iter().filter(|cpu| !online.contains(cpu)).map(move |cpu| format!("{stage}: {cpu}"))
        })
        .collect();
    (!missing.is_empty()).then(|| {
        Finding::warning(
            Area::Limits,
            "cores",
            format!("the graph binds stages to processors that do not exist ({})", missing.join(", ")),
            "the stage logs a warning, and runs on any processor",
            "change `stages.*.cpus` in the graph file",
        )
    })
}

/// Settings that decide whether logind removes shared memory at log-out.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Logind {
    /// True if logind runs.
    pub runs: bool,
    /// Value of `RemoveIPC`, and the file that sets it.
    pub setting: Option<(bool, PathBuf)>,
    /// Number of this user.
    pub uid: u32,
    /// True if the user's services continue after log-out.
    pub lingers: bool,
}

/// Returns the last `RemoveIPC` of logind's configuration files, in the order in which logind reads them.
pub fn remove_ipc_setting(files: &[(PathBuf, String)]) -> Option<(bool, PathBuf)> {
    let mut setting = None;
    for (path, text) in files {
        for line in text.lines() {
            if let Some((key, value)) = line.split_once('=')
                && key.trim() == "RemoveIPC"
            {
                let on = matches!(value.trim().to_ascii_lowercase().as_str(), "yes" | "true" | "on" | "1" | "y" | "t");
                setting = Some((on, path.clone()));
            }
        }
    }
    setting
}

/// Checks that a log-out does not remove shared memory of a running graph.
pub fn remove_ipc(logind: &Logind) -> Finding {
    let ok = |found: String| Finding::ok(Area::Limits, "RemoveIPC", found);
    if !logind.runs {
        return ok("logind does not run here".to_owned());
    }
    if logind.uid < FIRST_PERSON {
        return ok(format!("not for user {}, a system user", logind.uid));
    }
    let found = match &logind.setting {
        Some((false, path)) => return ok(format!("no ({})", path.display())),
        Some((true, path)) => format!("yes ({})", path.display()),
        None => "not set, which means yes".to_owned(),
    };
    if logind.lingers {
        return ok(format!("{found}, but this user lingers"));
    }
    Finding::warning(
        Area::Limits,
        "RemoveIPC",
        found,
        "when you log out, logind removes the shared memory of running graphs: they fail",
        "write `[Login]` and `RemoveIPC=no` to /etc/systemd/logind.conf.d/carff.conf and restart systemd-logind; or \
         loginctl enable-linger; or run the graph as a service of a system user",
    )
}

/// Checks the version of the libtorch that the programs find; `needed` if the encoder computes with it.
pub fn libtorch(library: Option<&Path>, version: Option<&str>, needed: bool) -> Finding {
    let area = Area::Programs;
    let advice = "make libtorch, or use your own libtorch: make build LIBTORCH=/path/to/libtorch, and \
                  LD_LIBRARY_PATH=/path/to/libtorch/lib at run time";
    let Some(library) = library else {
        if needed {
            return Finding::error(area, "libtorch", "it is missing", "the encoder stage cannot start", advice);
        }
        let found = "none; training, evaluation, the window and `backend = \"tch\"` need it, this graph does not";
        return Finding::ok(area, "libtorch", found);
    };
    match version {
        Some(version) if version == LIBTORCH || version.starts_with(&format!("{LIBTORCH}+")) => {
            Finding::ok(area, "libtorch", format!("{version} ({})", library.display()))
        }
        Some(version) => {
            let found = format!("{version} ({}); the programs are built for {LIBTORCH}", library.display());
            let finding = if needed { Finding::error } else { Finding::warning };
            finding(area, "libtorch", found, "its programs may crash, or compute wrong results", advice)
        }
        None => Finding::warning(
            area,
            "libtorch",
            format!("{}, without a file `build-version` next to it", library.display()),
            format!("the version may differ from {LIBTORCH}"),
            advice,
        ),
    }
}

/// Checks the build of ONNX Runtime, or the reason why it cannot be loaded; `needed` if the encoder computes with it.
pub fn onnx_runtime(library: &Path, build: Result<&str, &str>, needed: bool) -> Finding {
    let (area, subject, wanted) = (Area::Programs, "ONNX Runtime", carff_inference::library::VERSION);
    let advice = format!("make onnxruntime, or name a libonnxruntime.so of {wanted} in ORT_DYLIB_PATH");
    match build {
        Ok(build) if build.contains(carff_inference::library::BUILD) => {
            Finding::ok(area, subject, format!("{wanted} ({})", library.display()))
        }
        Ok(build) => Finding::warning(
            area,
            subject,
            format!("{} is not {wanted}: {build}", library.display()),
            "the encoder's last bits may differ",
            advice,
        ),
        Err(error) => {
            let finding = if needed { Finding::error } else { Finding::warning };
            finding(area, subject, error, "the encoder stage cannot start with `backend = \"onnx\"`", advice.as_str())
        }
    }
}

/// Checks that a folder contains the stages' programs.
pub fn programs(folder: &Path, missing: &[String]) -> Finding {
    if missing.is_empty() {
        return Finding::ok(Area::Programs, "stages", format!("all in {}", folder.display()));
    }
    Finding::error(
        Area::Programs,
        "stages",
        format!("{} not in {}", missing.join(", "), folder.display()),
        "`carff launch` cannot start them",
        "make build; programs that are installed elsewhere must be in one folder",
    )
}

#[cfg(test)]
mod tests {
    use super::super::finding::Level;
    use super::*;

    const MIB: u64 = 1 << 20;

    fn with_prober(prober: StageConfig) -> StagesConfig {
        StagesConfig { prober, ..StagesConfig::default() }
    }

    fn levels(findings: &[Finding]) -> Vec<(&'static str, Level)> {
        findings.iter().map(|f| (f.subject, f.level)).collect()
    }

    /// A finding that is not ok has a meaning and advice; an ok finding has neither.
    #[track_caller]
    fn assert_level(finding: &Finding, level: Level) {
        assert_eq!(finding.level, level, "{finding:?}");
        assert_eq!(finding.means.is_empty(), level == Level::Ok, "{finding:?}");
        assert_eq!(finding.advice.is_empty(), level == Level::Ok, "{finding:?}");
    }

    /// Kernels need AVX2 and FMA; AVX-512 is mentioned if present.
    #[test]
    fn processors() {
        assert_level(&processor("old", &["sse4_2"]), Level::Warning);
        assert_level(&processor("half", &["avx2"]), Level::Warning);
        assert_level(&processor("new", &["avx2", "fma"]), Level::Ok);
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

    /// Shared memory must exist, be writable, be in memory, and have space for the graph; the advice is a command.
    #[test]
    fn shared_memory_in_every_state() {
        let good = SharedMemory {
            folder: "/dev/shm".into(),
            file_system: Some("tmpfs".to_owned()),
            writable: true,
            size_bytes: 1024 * MIB,
            free_bytes: 1024 * MIB,
        };
        let check = |memory: &SharedMemory| levels(&shared_memory(memory, 50 * MIB));
        assert_eq!(check(&good), [("rights", Level::Ok), ("size", Level::Ok)]);
        let missing = SharedMemory { file_system: None, ..good.clone() };
        assert_eq!(check(&missing), [("folder", Level::Error)]);
        let foreign = SharedMemory { writable: false, ..good.clone() };
        assert_eq!(check(&foreign)[0], ("rights", Level::Error));
        let disk = SharedMemory { file_system: Some("ext4".to_owned()), ..good.clone() };
        assert_eq!(check(&disk)[0], ("rights", Level::Warning));
        for (free, level) in [(40, Level::Error), (60, Level::Warning), (100, Level::Ok)] {
            let findings = shared_memory(&SharedMemory { free_bytes: free * MIB, ..good.clone() }, 50 * MIB);
            assert_level(&findings[1], level);
        }
        let small = shared_memory(&SharedMemory { free_bytes: 0, ..good }, 600 * MIB);
        assert!(small[1].advice.contains("size=2048m") && small[1].advice.contains("--shm-size"), "{small:?}");
    }

    /// A running graph is ok. Files of a dead run, processes without a launcher, and stray files are warnings with the
    /// command that removes them.
    #[test]
    fn what_runs_left() {
        let segments: Vec<PathBuf> =
            ["/dev/shm/carff0123abcd_a", "/dev/shm/carff0123abcd_b"].iter().map(PathBuf::from).collect();
        let dead = RunFiles {
            name: "dead".to_owned(),
            small: vec!["/var/carff-1/dead".into(), "/var/carff-1/dead.run".into()],
            segments: segments.clone(),
            segment_bytes: 3 * MIB,
            ..RunFiles::default()
        };
        let small = RunFiles { name: "small".to_owned(), small: vec!["x.run".into()], ..RunFiles::default() };
        assert_level(&leftovers(&[small], &Strays::default())[0], Level::Ok);
        let alive = RunFiles { name: "alive".to_owned(), launcher: Some(7), living: vec![7, 8], ..RunFiles::default() };
        let orphan = RunFiles { name: "orphan".to_owned(), living: vec![9, 10], ..RunFiles::default() };
        let strays = Strays { files: segments, users: Vec::new() };
        let findings = leftovers(&[dead, alive, orphan], &strays);
        let lost = leftovers(&[], &Strays { users: vec![5, 6], ..strays.clone() });
        assert_eq!(levels(&lost), [("lost folder", Level::Error)]);
        assert!(lost[0].advice.contains("kill -INT 5"), "a living run is never removed: {lost:?}");
        assert_eq!(
            levels(&findings),
            [
                ("leftovers", Level::Warning),
                ("run", Level::Ok),
                ("orphans", Level::Warning),
                ("strays", Level::Warning)
            ]
        );
        assert!(findings[0].found.contains("`dead`") && findings[0].found.contains("3.0 MiB"), "{findings:?}");
        assert_eq!(findings[0].advice, "rm -r /dev/shm/carff0123abcd_* /var/carff-1/dead /var/carff-1/dead.run");
        assert_eq!(findings[2].advice, "kill 9 10");
        assert!(findings[3].advice.ends_with("rm /dev/shm/carff0123abcd_*"), "{findings:?}");
        assert_eq!(levels(&leftovers(&[], &Strays::default())), [("leftovers", Level::Ok)]);
    }

    /// Limits only matter if the graph needs more, and privileges lift them.
    #[test]
    fn limits_against_what_is_asked() {
        let low = Allowed {
            locked_bytes: Some(8 * MIB),
            realtime_priority: Some(0),
            nice: Some(0),
            open_files: Some(20_000),
            ..Allowed::default()
        };
        let greedy = with_prober(StageConfig {
            lock_memory: true,
            fifo_priority: Some(50),
            nice: Some(-5),
            ..StageConfig::default()
        });
        let all = |level| [("memlock", level), ("rtprio", level), ("nice", level), ("open files", Level::Ok)];
        let findings = limits(&low, &greedy);
        assert_eq!(levels(&findings), all(Level::Warning));
        assert!(findings[0].found.contains("prober") && findings[1].found.contains("50"), "{findings:?}");
        assert!(findings.iter().all(|f| f.level == Level::Ok || f.advice.contains("limits.d")), "{findings:?}");
        let modest = limits(&low, &StagesConfig::default());
        assert!(modest.iter().all(|f| f.level == Level::Ok), "{modest:?}");
        let privileged = Allowed { may_lock: true, may_schedule: true, ..low };
        assert_eq!(levels(&limits(&privileged, &greedy)), all(Level::Ok));
        let raised = Allowed { locked_bytes: None, realtime_priority: Some(99), nice: Some(25), ..low };
        assert_eq!(levels(&limits(&raised, &greedy)), all(Level::Ok));
        let few = Allowed { open_files: Some(256), ..low };
        assert_eq!(limits(&few, &StagesConfig::default()).last().map(|f| f.level), Some(Level::Warning));
    }

    /// Stages bound to missing processors are reported with their processors.
    #[test]
    fn processors_that_are_not_there() {
        let bound = with_prober(StageConfig { cpus: vec![1, 9], ..StageConfig::default() });
        assert_eq!(bound_cores(&[0, 1, 9], &bound), None);
        let finding = bound_cores(&[0, 1], &bound).unwrap();
        assert_level(&finding, Level::Warning);
        assert!(finding.found.contains("(prober: 9)"), "{finding:?}");
    }

    /// The last file that sets the value wins; comments are ignored.
    #[test]
    fn settings_of_logind() {
        let file = |name: &str, text: &str| (PathBuf::from(name), text.to_owned());
        let files =
            [file("a", "[Login]\n#RemoveIPC=no\n"), file("b", "RemoveIPC = yes\n"), file("c", "RemoveIPC=no\n")];
        assert_eq!(remove_ipc_setting(&files[..1]), None);
        assert_eq!(remove_ipc_setting(&files[..2]), Some((true, "b".into())));
        assert_eq!(remove_ipc_setting(&files), Some((false, "c".into())));
    }

    /// Only a person's files are removed, at a log-out that logind sees, unless a setting or lingering prevents it.
    #[test]
    fn log_outs() {
        let person = Logind { runs: true, setting: None, uid: 1000, lingers: false };
        assert_level(&remove_ipc(&person), Level::Warning);
        assert_level(&remove_ipc(&Logind { setting: Some((true, "x".into())), ..person.clone() }), Level::Warning);
        for well in [
            Logind { runs: false, ..person.clone() },
            Logind { uid: 999, ..person.clone() },
            Logind { lingers: true, ..person.clone() },
            Logind { setting: Some((false, "x".into())), ..person },
        ] {
            assert_level(&remove_ipc(&well), Level::Ok);
        }
    }

    /// The version must be the version of the build, with any suffix. Without need of it, none may be there.
    #[test]
    fn versions_of_libtorch() {
        let library = Some(Path::new("lib/libtorch_cpu.so"));
        assert_level(&libtorch(library, Some("2.11.0"), true), Level::Ok);
        assert_level(&libtorch(library, Some("2.11.0+cu130"), true), Level::Ok);
        assert_level(&libtorch(library, Some("2.11.01"), true), Level::Error);
        assert_level(&libtorch(library, Some("2.13.0"), true), Level::Error);
        assert_level(&libtorch(library, Some("2.13.0"), false), Level::Warning);
        assert_level(&libtorch(library, None, true), Level::Warning);
        assert_level(&libtorch(None, None, true), Level::Error);
        assert_level(&libtorch(None, None, false), Level::Ok);
    }

    /// A missing library is an error where the encoder needs it; another version is a warning.
    #[test]
    fn versions_of_onnx_runtime() {
        let library = Path::new("lib/libonnxruntime.so.1");
        assert_level(&onnx_runtime(library, Ok(carff_inference::library::BUILD), true), Level::Ok);
        assert_level(&onnx_runtime(library, Ok("git-commit-id=0123456"), true), Level::Warning);
        assert_level(&onnx_runtime(library, Err("not found"), true), Level::Error);
        assert_level(&onnx_runtime(library, Err("not found"), false), Level::Warning);
    }

    /// Missing programs are reported by name.
    #[test]
    fn missing_programs() {
        assert_level(&programs(Path::new("bin"), &[]), Level::Ok);
        let finding = programs(Path::new("bin"), &["carff-prober".to_owned()]);
        assert_level(&finding, Level::Error);
        assert!(finding.found.contains("carff-prober not in bin"), "{finding:?}");
    }

    /// Sizes are shown in the largest unit that they fill.
    #[test]
    fn sizes() {
        assert_eq!(size(0), "0 bytes");
        assert_eq!(size(1536), "1.5 KiB");
        assert_eq!(size(8 * MIB), "8.0 MiB");
        assert_eq!(size(3 << 30), "3.0 GiB");
    }
}
