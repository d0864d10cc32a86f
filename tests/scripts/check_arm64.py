#!/usr/bin/env python3
"""Runs tests and a drive of programs for 64-bit Arm, emulated on this machine.

Usage: make check-arm64, which builds the programs and calls
       python3 tests/scripts/check_arm64.py TARGET CRATE ...      (TARGET: the folder of both machines' programs)
       python3 tests/scripts/check_arm64.py --requirements       (checks only that the emulator is there)

Requirements:
- The tests of the named crates pass.
- A drive of the shipped graph with emulated processes ends with exit code 0, and has a decision for every frame.
- Every hazard drive halts and every clear drive advances.
- The doctor finds no error, and knows the processor.
- Each decision is that of this machine's own programs, with the same hazard probability up to rounding.

The processes run in their own user namespace. There the kernel starts Arm programs with the emulator, also the ones that
an Arm program starts itself, and /proc/cpuinfo describes an Arm processor: ONNX Runtime reads it, and QEMU before version
8.2 shows this machine's. If such a namespace needs more rights or a later kernel, the system's own registration is used.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
GRAPH = "configs/graphs/approaching-intersection.toml"
ARM64 = "aarch64-unknown-linux-gnu"
EMULATOR = "qemu-aarch64-static"
# A processor of boards with 64-bit Arm, and the libraries of Debian's cross compiler.
ENVIRONMENT = {"QEMU_CPU": "cortex-a76", "QEMU_LD_PREFIX": "/usr/aarch64-linux-gnu"}
# The same processor as the kernel describes it, once for each core.
PROCESSOR = """processor\t: {}
BogoMIPS\t: 50.00
Features\t: fp asimd evtstrm aes pmull sha1 sha2 crc32 atomics fphp asimdhp cpuid asimdrdm lrcpc dcpop asimddp
CPU implementer\t: 0x41
CPU architecture: 8
CPU variant\t: 0x4
CPU part\t: 0xd0b
CPU revision\t: 1

"""
# Registers the emulator ($1) for the first 20 bytes of an Arm program, which only root of a namespace can do. Executes the
# rest of the command as user $2 and group $3, in a second namespace below. File $4 describes the processor.
REGISTER = r"""
mount --bind "$4" /proc/cpuinfo || exit 125
mount -t binfmt_misc none /proc/sys/fs/binfmt_misc || exit 125
magic='\x7fELF\x02\x01\x01\x00\x00\x00\x00\x00\x00\x00\x00\x00\x02\x00\xb7\x00'
mask='\xff\xff\xff\xff\xff\xff\xff\x00\xff\xff\xff\xff\xff\xff\xff\xff\xfe\xff\xff\xff'
printf '%s' ":carff-arm64:M::$magic:$mask:$1:F" > /proc/sys/fs/binfmt_misc/register || exit 125
user=$2 group=$3
shift 4
exec unshare --user --map-user="$user" --map-group="$group" -- "$@"
"""
SYSTEM_REGISTRATION = Path("/proc/sys/fs/binfmt_misc/qemu-aarch64")
# Two drives of three frames. An emulated frame takes seconds, so nothing may count as late.
DRIVES, FRAMES = 2, 6
SETTINGS = ["run.frame_rate_hz=0.1", "camera.frames_per_timestamp=1", "camera.linger_ms=30000", "checks.camera=false",
            "controller.deadline_ms=60000", "controller.rate_hz=1", "renderer.max_rate_hz=0.1",
            "launcher.start_timeout_ms=600000", "launcher.stop_timeout_ms=60000", "launcher.hang_timeout_ms=600000",
            *[f"stages.{stage}.deadline_ms=60000" for stage in ["encoder", "forecaster", "prober", "renderer", "controller"]]]
# Largest difference of a hazard probability between both machines.
TOLERANCE = 0.001


def say(text: str) -> None:
    print(f"check: {text}", flush=True)


def emulated(folder: Path) -> list[str]:
    """Returns the start of a command line whose programs may be Arm programs. The folder must exist as long as they run."""
    emulator = shutil.which(EMULATOR)
    if emulator is None:
        sys.exit(f"{EMULATOR} is missing: sudo apt-get install qemu-user-static")
    if not (Path(ENVIRONMENT["QEMU_LD_PREFIX"]) / "lib/ld-linux-aarch64.so.1").exists():
        sys.exit("the libraries for Arm are missing: sudo apt-get install libc6-dev-arm64-cross libstdc++6-arm64-cross")
    processors = folder / "cpuinfo"
    processors.write_text("".join(PROCESSOR.format(core) for core in range(os.cpu_count() or 1)), encoding="utf-8")
    own = ["unshare", "--user", "--map-root-user", "--mount", "sh", "-c", REGISTER, "sh", emulator,
           str(os.geteuid()), str(os.getegid()), str(processors)]
    done = subprocess.run([*own, "true"], capture_output=True, text=True)
    if done.returncode == 0:
        return own
    if SYSTEM_REGISTRATION.exists():
        return []
    sys.exit(f"the kernel cannot start Arm programs in a user namespace ({done.stderr.strip()}): use Linux 6.7 or later and "
             "allow user namespaces, or register the emulator for the system (sudo apt-get install binfmt-support)")


def run(*command: str, **environment: str) -> None:
    done = subprocess.run(command, cwd=ROOT, env={**os.environ, **ENVIRONMENT, **environment})
    if done.returncode != 0:
        sys.exit(f"{' '.join(command[-12:])}: exit code {done.returncode}")


def drive(start: list[str], programs: Path, folder: Path, **environment: str) -> tuple[dict, list[dict]]:
    """Drives, and returns the report and the decisions."""
    report, decisions = folder / "report.json", folder / "decisions.jsonl"
    settings = [word for setting in SETTINGS for word in ("--set", setting)]
    run(*start, str(programs / "carff"), "launch", GRAPH, "--run", f"check-{os.getpid()}", "--drives", str(DRIVES), *settings,
        "--report", str(report), "--decisions", str(decisions), **environment)
    found = [json.loads(line) for line in decisions.read_text(encoding="utf-8").splitlines()]
    return json.loads(report.read_text(encoding="utf-8")), found


def check_drive(report: dict, decisions: list[dict]) -> None:
    frames = [decision["frame"] for decision in decisions]
    if frames != list(range(FRAMES)) or report["skipped"] or report["restarts"]:
        sys.exit(f"frames {frames} were decided of {FRAMES}, {report['skipped']} skipped, {report['restarts']} restarts")
    for kind in ["hazard", "clear"]:
        result = report["drives"][kind]
        if result["trials"] != DRIVES // 2 or result["success"] != result["trials"]:
            sys.exit(f"{kind} drives: {result['success']} of {result['trials']} correct, {DRIVES // 2} wanted")


def compare(arm: list[dict], native: list[dict]) -> float:
    """Checks that both machines decide the same, and returns the largest difference of a hazard probability."""
    largest = 0.0
    for ours, theirs in zip(arm, native):
        largest = max(largest, abs(ours["hazard"] - theirs["hazard"]))
        same = all(ours[key] == theirs[key] for key in ["frame", "drive", "action", "reason", "source"])
        if not same or largest > TOLERANCE:
            sys.exit(f"emulated: {ours}\nthis machine: {theirs}")
    return largest


def examine(start: list[str], programs: Path, **environment: str) -> None:
    """Checks what the doctor finds on an Arm processor."""
    done = subprocess.run([*start, str(programs / "carff"), "doctor", GRAPH, "--json"], cwd=ROOT, stdout=subprocess.PIPE, text=True,
                          env={**os.environ, **ENVIRONMENT, **environment})
    processor = [finding for finding in json.loads(done.stdout)["findings"] if finding["subject"] == "processor"]
    if done.returncode != 0 or not processor or "NEON" not in processor[0]["found"]:
        sys.exit(f"the doctor, exit code {done.returncode}: {done.stdout}")


def check(folder: Path, target: Path, crates: list[str]) -> None:
    start = emulated(folder)
    run(*start, "cargo", "test", "--release", "--locked", "--target", ARM64, "--target-dir", str(target / "arm64"),
        "--lib", "--tests", "--no-fail-fast", *[word for crate in crates for word in ("-p", crate)])
    say(f"the tests of {', '.join(crates)} pass as Arm programs")
    programs = target / "arm64" / ARM64 / "release"
    library = str(ROOT / ".onnxruntime-aarch64/lib/libonnxruntime.so.1")
    examine(start, programs, ORT_DYLIB_PATH=library)
    say("the doctor finds no error on an Arm processor")
    native = drive([], target / "release", folder)
    check_drive(*native)
    report, decisions = drive(start, programs, folder, ORT_DYLIB_PATH=library)
    check_drive(report, decisions)
    largest = compare(decisions, native[1])
    p50_ms = report["latency_ms"]["camera_to_action"]["p50"]
    say(f"{FRAMES} frames of {DRIVES} drives decided by Arm programs as by this machine's; hazard probabilities differ by at "
        f"most {largest:.1e}; emulated camera to action p50 {p50_ms / 1000:.1f} s")


def main() -> None:
    with tempfile.TemporaryDirectory() as folder:
        if sys.argv[1:] == ["--requirements"]:
            emulated(Path(folder))
        elif len(sys.argv) > 2:
            check(Path(folder), Path(sys.argv[1]).resolve(), sys.argv[2:])
        else:
            sys.exit(__doc__)


if __name__ == "__main__":
    main()
