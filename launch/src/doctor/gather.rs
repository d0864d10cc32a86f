//! Collects facts about the machine, without judging them.

use super::checks::{Allowed, Clock, Logind, RunFiles, SharedMemory, Strays};
use crate::supervision::LAUNCHER;
use carff_config::StagesConfig;
use carff_messages::Stage;
use carff_transport::{
    Run, SHARED_MEMORY_DIR, living_nodes, mapping_processes, monotonic_now_ns, runtime_dir, runtime_dirs,
};
use rustix::process::{Resource, getrlimit};
use std::collections::{BTreeMap, BTreeSet};
use std::os::unix::fs::{MetadataExt, PermissionsExt};
use std::path::{Path, PathBuf};

/// Number of readings of the clock.
const READINGS: u32 = 10_000;
/// Bits of the effective capabilities: locking memory, setting priorities.
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;
/// Folders of libtorch, relative to the folder of the programs: installed, built, and of tests.
const LIBTORCH_FOLDERS: [&str; 3] = ["../lib", "../../.libtorch/lib", "../../../.libtorch/lib"];
/// Folders of logind's settings; later ones take precedence.
const LOGIND_FOLDERS: [&str; 3] =
    ["/usr/lib/systemd/logind.conf.d", "/run/systemd/logind.conf.d", "/etc/systemd/logind.conf.d"];

fn read(path: impl AsRef<Path>) -> Option<String> {
    std::fs::read_to_string(path).ok().map(|text| text.trim().to_owned())
}

/// Returns the processor's name and features.
pub fn processor() -> (String, Vec<String>) {
    let text = read("/proc/cpuinfo").unwrap_or_default();
    let field = |wanted: &str| {
        text.lines()
            .find_map(|line| line.split_once(':').filter(|(key, _)| key.trim() == wanted).map(|(_, v)| v.trim()))
    };
    let features = field("flags").or_else(|| field("Features")).unwrap_or_default();
    // Arm has no name of the processor; its boards have one, which ends with a zero.
    let board = || read("/proc/device-tree/model").map(|name| name.trim_end_matches('\0').to_owned());
    let name = field("model name").map(str::to_owned).or_else(board).unwrap_or_else(|| "unknown processor".to_owned());
    (name, features.split_whitespace().map(str::to_owned).collect())
}

/// Returns the memory available to programs, bytes.
pub fn available_memory() -> Option<u64> {
    let text = read("/proc/meminfo")?;
    let line = text.lines().find_map(|line| line.strip_prefix("MemAvailable:"))?;
    Some(line.split_whitespace().next()?.parse::<u64>().ok()? * 1024)
}

/// Measures the monotonic clock.
pub fn clock() -> Clock {
    let (first_ns, mut last_ns, mut steps_back) = (monotonic_now_ns(), 0, 0);
    for _ in 0..READINGS {
        let now_ns = monotonic_now_ns();
        steps_back += u32::from(now_ns < last_ns);
        last_ns = now_ns;
    }
    Clock {
        source: read("/sys/devices/system/clocksource/clocksource0/current_clocksource"),
        steps_back,
        reading_ns: last_ns.saturating_sub(first_ns) as f64 / f64::from(READINGS),
    }
}

/// Returns the governor of each core's clock rate.
pub fn governors() -> Vec<String> {
    let Ok(cores) = std::fs::read_dir("/sys/devices/system/cpu") else { return Vec::new() };
    cores.flatten().filter_map(|core| read(core.path().join("cpufreq/scaling_governor"))).collect()
}

/// Returns the numbers of the online processors.
pub fn online() -> Vec<u32> {
    numbers(&read("/sys/devices/system/cpu/online").unwrap_or_default())
}

/// Parses a list of ranges, such as "0-2,5".
fn numbers(ranges: &str) -> Vec<u32> {
    ranges
        .split(',')
        .filter_map(|range| {
            let (first, last) = range.split_once('-').unwrap_or((range, range));
            Some(first.trim().parse::<u32>().ok()?..=last.trim().parse::<u32>().ok()?)
        })
        .flatten()
        .collect()
}

/// Returns the free bytes of a folder's file system.
pub fn free_bytes(folder: &Path) -> Option<u64> {
    let stat = rustix::fs::statvfs(folder).ok()?;
    Some(stat.f_bavail.saturating_mul(stat.f_frsize))
}

/// Returns the state of the shared memory's folder.
pub fn shared_memory() -> SharedMemory {
    let folder = Path::new(SHARED_MEMORY_DIR);
    let stat = rustix::fs::statvfs(folder).ok();
    let stat = stat.as_ref();
    SharedMemory {
        folder: folder.to_owned(),
        file_system: stat.map(|_| file_system(&read("/proc/mounts").unwrap_or_default(), folder)),
        writable: rustix::fs::access(folder, rustix::fs::Access::WRITE_OK).is_ok(),
        size_bytes: stat.map_or(0, |s| s.f_blocks.saturating_mul(s.f_frsize)),
        free_bytes: stat.map_or(0, |s| s.f_bavail.saturating_mul(s.f_frsize)),
    }
}

/// Returns the type of the file system of a folder.
fn file_system(mounts: &str, folder: &Path) -> String {
    mounts
        .lines()
        .filter_map(|line| {
            let mut words = line.split_whitespace().skip(1);
            let (place, kind) = (Path::new(words.next()?), words.next()?);
            folder.starts_with(place).then(|| (place.components().count(), kind.to_owned()))
        })
        // Of several mounts at one folder, the last is on top.
        .max_by_key(|(depth, _)| *depth)
        .map_or_else(|| "of unknown type".to_owned(), |(_, kind)| kind)
}

/// Returns this user's runs in all folders, and files in shared memory that look like a run's but belong to none.
pub fn runs() -> anyhow::Result<(Vec<RunFiles>, Strays)> {
    let launchers: BTreeMap<(PathBuf, String), u32> =
        carff_observe::runs()?.into_iter().map(|run| ((run.dir, run.name), run.pid)).collect();
    let mut small: BTreeMap<(PathBuf, String), Vec<PathBuf>> = BTreeMap::new();
    for folder in runtime_dirs() {
        for entry in std::fs::read_dir(&folder).into_iter().flatten().flatten() {
            if let Some(name) = entry.file_name().to_str() {
                let name = name.strip_suffix(".run").unwrap_or(name).to_owned();
                small.entry((folder.clone(), name)).or_default().push(entry.path());
            }
        }
    }
    let mut runs = Vec::new();
    let mut known = BTreeSet::new();
    for (key, small) in small {
        // Names that no run can have belong to other programs.
        let Ok(run) = Run::within(&key.0, &key.1, 0) else { continue };
        let segments = run.shared_memory_files().unwrap_or_default();
        known.insert(run.shared_memory_prefix());
        let nodes = if run.folder().is_dir() { living_nodes(&run)? } else { Vec::new() };
        let launcher = launchers.get(&key).copied();
        let mapping = run.mapping_processes();
        let joined = nodes.iter().find(|(name, _)| name == LAUNCHER).map(|(_, pid)| *pid);
        let lost = match launcher {
            Some(pid) => mapping.contains(&pid) && nodes.iter().all(|(_, joined)| *joined != pid),
            // Without the record, a living launcher is still a member; without any member, its memory is still mapped.
            None => joined.is_some() || nodes.is_empty() && !mapping.is_empty(),
        };
        runs.push(RunFiles {
            lost: launcher.or(joined).or(mapping.first().copied()).filter(|_| lost),
            launcher,
            living: if run.folder().is_dir() { nodes.into_iter().map(|(_, pid)| pid).collect() } else { mapping },
            segment_bytes: segments.iter().filter_map(|path| std::fs::metadata(path).ok()).map(|m| m.len()).sum(),
            name: key.1,
            small,
            segments,
        });
    }
    let uid = rustix::process::getuid().as_raw();
    let mut files: Vec<PathBuf> = std::fs::read_dir(SHARED_MEMORY_DIR)
        .into_iter()
        .flatten()
        .flatten()
        .filter(|entry| {
            let name = entry.file_name();
            let name = name.to_string_lossy();
            is_segment(&name)
                && !known.iter().any(|prefix| name.starts_with(prefix.as_str()))
                && entry.metadata().is_ok_and(|m| m.uid() == uid)
        })
        .map(|entry| entry.path())
        .collect();
    files.sort();
    let prefixes: BTreeSet<&str> =
        files.iter().filter_map(|f| Some(f.file_name()?.to_str()?.split_once('_')?.0)).collect();
    let users = prefixes.into_iter().flat_map(mapping_processes).collect();
    Ok((runs, Strays { files, users }))
}

/// Returns the folder of new runs, and true if it can be written.
pub fn run_folder() -> (PathBuf, bool) {
    let folder = runtime_dir();
    let written = carff_transport::make_private_dir(&folder).is_ok()
        && carff_base::files::check_writable(&folder.join(".doctor")).is_ok();
    (folder, written)
}

/// Returns true for the name of a run's shared memory: `carff`, eight digits, an underscore.
fn is_segment(name: &str) -> bool {
    name.strip_prefix("carff")
        .and_then(|rest| rest.split_once('_'))
        .is_some_and(|(hash, _)| hash.len() == 8 && hash.bytes().all(|b| b.is_ascii_hexdigit()))
}

/// Returns the resource limits of this process.
pub fn allowed() -> Allowed {
    let status = read("/proc/self/status").unwrap_or_default();
    let effective = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    let capabilities = effective.and_then(|v| u64::from_str_radix(v.trim(), 16).ok()).unwrap_or(0);
    Allowed {
        locked_bytes: getrlimit(Resource::Memlock).current,
        realtime_priority: getrlimit(Resource::Rtprio).current,
        nice: getrlimit(Resource::Nice).current,
        open_files: getrlimit(Resource::Nofile).current,
        may_lock: capabilities >> CAP_IPC_LOCK & 1 == 1,
        may_schedule: capabilities >> CAP_SYS_NICE & 1 == 1,
    }
}

/// Returns logind's settings for this user's log-out.
pub fn logind() -> Logind {
    let mut paths = vec![PathBuf::from("/usr/lib/systemd/logind.conf"), PathBuf::from("/etc/systemd/logind.conf")];
    let mut additions: Vec<PathBuf> = LOGIND_FOLDERS
        .iter()
        .flat_map(|folder| std::fs::read_dir(folder).into_iter().flatten().flatten().map(|entry| entry.path()))
        .filter(|path| path.extension().is_some_and(|e| e == "conf"))
        .collect();
    // By file name, in whichever folder.
    additions.sort_by(|a, b| a.file_name().cmp(&b.file_name()));
    paths.extend(additions);
    let files: Vec<(PathBuf, String)> =
        paths.into_iter().filter_map(|path| read(&path).map(|text| (path, text))).collect();
    let user = std::env::var("USER").unwrap_or_default();
    Logind {
        runs: Path::new("/run/systemd/seats").is_dir(),
        setting: super::checks::remove_ipc_setting(&files),
        uid: rustix::process::getuid().as_raw(),
        lingers: !user.is_empty() && Path::new("/var/lib/systemd/linger").join(user).exists(),
    }
}

/// Returns the libtorch that the loader finds for the programs of a folder, and the version in the file next to it.
pub fn libtorch(programs: &Path) -> (Option<PathBuf>, Option<String>) {
    let first = std::env::var_os("LD_LIBRARY_PATH").unwrap_or_default();
    let first = std::env::split_paths(&first).filter(|folder| folder.is_absolute());
    let stored = LIBTORCH_FOLDERS.map(|folder| programs.join(folder));
    let library = first.chain(stored).find_map(|folder| folder.join("libtorch_cpu.so").canonicalize().ok());
    let version = library.as_deref().and_then(Path::parent).and_then(Path::parent);
    let version = version.and_then(|root| read(root.join("build-version")));
    (library, version)
}

/// Returns the stages' programs that are missing in a folder or cannot be started.
pub fn missing_programs(folder: &Path, stages: &StagesConfig) -> Vec<String> {
    let is_program = |path: &Path| path.metadata().is_ok_and(|m| m.is_file() && m.permissions().mode() & 0o111 != 0);
    Stage::ALL.iter().map(|&stage| stages.program(stage)).filter(|name| !is_program(&folder.join(name))).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Ranges of processors are parsed as the system writes them.
    #[test]
    fn ranges_of_processors() {
        assert_eq!(numbers("0-2,5"), [0, 1, 2, 5]);
        assert_eq!(numbers("0"), [0]);
        assert_eq!(numbers(""), Vec::<u32>::new());
        assert_eq!(numbers("x-2,3"), [3]);
    }

    /// The deepest mount counts; of two at one folder, the later one.
    #[test]
    fn the_mount_on_top_counts() {
        let mounts =
            "overlay / overlay rw 0 0\ntmpfs /dev tmpfs rw 0 0\nshm /dev/shm ext4 rw 0 0\nshm /dev/shm tmpfs rw 0 0";
        assert_eq!(file_system(mounts, Path::new("/dev/shm")), "tmpfs");
        assert_eq!(file_system(mounts, Path::new("/data")), "overlay");
        assert_eq!(file_system("", Path::new("/data")), "of unknown type");
    }

    /// Only names that the transport gives count as a run's.
    #[test]
    fn names_of_segments() {
        assert!(is_segment("carff0123abcd_service_x"));
        for other in ["carff0123abcd", "carff0123abc_x", "carffxyzxyzxy_x", "psm_1234_x", "iox2_1_x", ""] {
            assert!(!is_segment(other), "{other}");
        }
    }

    /// libtorch is found next to the programs' folder, with its version, and may be missing.
    #[test]
    fn libtorch_next_to_the_programs() {
        let folder = tempfile::tempdir().unwrap();
        let (programs, library) = (folder.path().join("bin"), folder.path().join("lib/libtorch_cpu.so"));
        std::fs::create_dir_all(&programs).unwrap();
        assert_eq!(libtorch(&programs).1, None);
        std::fs::create_dir_all(library.parent().unwrap()).unwrap();
        std::fs::write(&library, "").unwrap();
        std::fs::write(folder.path().join("build-version"), "2.11.0\n").unwrap();
        // A libtorch in LD_LIBRARY_PATH comes first, as for the loader.
        if std::env::var_os("LD_LIBRARY_PATH").is_none() {
            assert_eq!(libtorch(&programs), (library.canonicalize().ok(), Some("2.11.0".to_owned())));
        }
    }

    /// The facts of this machine can be read: it has a processor, a clock that does not go back, and limits.
    #[test]
    fn this_machine_can_be_read() {
        assert!(!processor().1.is_empty());
        assert!(available_memory().is_some_and(|bytes| bytes > 0));
        assert_eq!(clock().steps_back, 0);
        assert!(online().contains(&0) || online().is_empty());
        assert!(runs().is_ok());
    }
}
