#!/usr/bin/env python3
"""Installs the Debian packages, drives as their user, tries to access the run as another user, and removes them.

Usage (as root, on a machine where carff is not installed): python3 tests/scripts/check_deb.py CARFF.deb [CARFF-LAB.deb]

Requirements:
- The units are valid, and the doctor finds no error.
- With only the first package, which contains no libtorch, a drive as user carff ends with exit code 0.
- During the drive another user (nobody) can neither read nor write any of its files.
- With the second package, a command that computes with libtorch starts.
- After a purge no file, user or shared memory of the package is left.
"""

import json
import os
import pwd
import subprocess
import sys
import tempfile
import time
from pathlib import Path

HOMES = ["/usr/lib/carff", "/usr/share/carff", "/etc/carff", "/var/lib/carff", "/usr/bin/carff",
         "/lib/systemd/system/carff.service", "/usr/share/man/man1/carff.1.gz"]


def say(text: str) -> None:
    print(f"check: {text}", flush=True)


def run(*command: str, user: str | None = None, check: bool = True) -> subprocess.CompletedProcess:
    if user:
        command = ("runuser", "-u", user, "--", *command)
    done = subprocess.run(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd="/")
    if check and done.returncode != 0:
        sys.exit(f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}")
    return done


def run_files(uid: int) -> list[Path]:
    """Returns all files of runs: shared memory, small files and sockets."""
    shared = [p for p in Path("/dev/shm").iterdir() if p.name.startswith("carff") and p.lstat().st_uid == uid]
    folder = Path("/tmp") / f"carff-{uid}"
    return shared + ([folder, *folder.rglob("*")] if folder.exists() else [])


def look_as_nobody(files: list[Path]) -> None:
    # Every user can list the names in /dev/shm, but must not read the content.
    script = (
        'for f in "$@"; do '
        'if head -c 1 "$f" > /dev/null 2>&1; then echo "reads $f"; fi; '
        'if [ -e "$f" ] && (: >> "$f") 2> /dev/null; then echo "writes $f"; fi; done'
    )
    seen = run("sh", "-c", script, "sh", *map(str, files), user="nobody").stdout.strip()
    if seen:
        sys.exit(f"another user can do this:\n{seen}")


def main() -> None:
    packages = [str(Path(name).resolve()) for name in sys.argv[1:]]
    if not 1 <= len(packages) <= 2:
        sys.exit(__doc__)
    if os.geteuid() != 0 or any(os.path.lexists(home) for home in HOMES):
        sys.exit("this must be root, on a machine where carff is not installed")
    try:
        run("dpkg", "--install", packages[0])
        if list(Path("/usr/lib/carff").rglob("libtorch*")):
            sys.exit("the package of a vehicle contains libtorch")
        uid = pwd.getpwnam("carff").pw_uid
        say(f"installed, user carff is {uid}")
        units = [f"/lib/systemd/system/{unit}"
                 for unit in ["carff.service", "carff-metrics.service", "carff-record.service", "carff-bridge.service", "carff.target"]]
        run("systemd-analyze", "verify", *units)
        exposure = run("systemd-analyze", "security", "--offline=true", units[0], check=False).stdout.strip()
        say(exposure.splitlines()[-1])
        say(run("carff", "doctor", "/etc/carff/vehicle.toml", user="carff").stdout.strip().splitlines()[-1])

        report = "/var/lib/carff/report.json"
        launch = ["runuser", "-u", "carff", "--", "carff", "launch", "/etc/carff/vehicle.toml", "--frames", "100",
                  "--report", report]
        with tempfile.NamedTemporaryFile("w", suffix=".log", encoding="utf-8") as log:
            launcher = subprocess.Popen(launch, stdout=log, stderr=log, cwd="/var/lib/carff")
            # The first launch renders the dataset.
            while launcher.poll() is None and "hazard " not in Path(log.name).read_text(encoding="utf-8"):
                time.sleep(0.2)
            files = run_files(uid)
            if len(files) < 10:
                sys.exit(f"a run has more files than {files}:\n{Path(log.name).read_text(encoding='utf-8')}")
            look_as_nobody(files)
            say(f"another user can neither read nor write any of {len(files)} files")
            if launcher.wait() != 0:
                sys.exit(f"the launch failed:\n{Path(log.name).read_text(encoding='utf-8')}")
        found = json.loads(Path(report).read_text(encoding="utf-8"))
        say(f"{found['frames']} frames, {found['actions']} actions, {found['restarts']} restarts, "
            f"camera to action p50 {found['latency_ms']['camera_to_action']['p50']:.1f} ms")
        for package in packages[1:]:
            run("dpkg", "--install", package)
            run("carff", "schema", "training", user="carff")
            say("carff-lab computes with its own libtorch")
    finally:
        # After a failure its processes may still run, and their user could not be removed.
        run("pkill", "-KILL", "-u", "carff", check=False)
        run("dpkg", "--purge", "carff-lab", "carff", check=False)
    left = [home for home in HOMES if os.path.lexists(home)] + run_files(uid)
    left += [entry.pw_name for entry in pwd.getpwall() if entry.pw_name == "carff"]
    if left:
        sys.exit(f"left after a purge: {left}")
    say("purged, nothing left")


if __name__ == "__main__":
    main()
