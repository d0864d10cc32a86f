#!/usr/bin/env python3
"""Fetches the pinned, hash-checked CPU part of libtorch into .libtorch/ (once).

Usage: python3 launch/packaging/fetch_libtorch.py [TARGET]     (default TARGET: .libtorch)

The source is Python wheels: the tch crate requires libtorch 2.11.0, which pip's package
index provides. Only the CPU libraries are kept, with the two small CUDA runtime libraries
that libtorch_cpu.so links.

You can interrupt and repeat the program: it works in TARGET.partial and renames the folder
at the end. If LIBTORCH is set, nothing is fetched: the user's copy wins.
"""

import os
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from pathlib import Path

BUILD_VERSION = "2.11.0"

# name, version, sha256, files to keep: (prefix in the wheel, target folder)
WHEELS = [
    (
        "torch",
        "2.11.0",
        "7aa2f9bbc6d4595ba72138026b2074be1233186150e9292865e04b7a63b8c67a",
        [
            ("torch/lib/libtorch_cpu.so", "lib"),
            ("torch/lib/libc10.so", "lib"),
            ("torch/lib/libgomp.so.1", "lib"),
            ("torch/include/", "include"),
        ],
    ),
    (
        "nvidia-cuda-runtime",
        "13.0.96",
        "7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548",
        [("libcudart.so.13", "lib")],
    ),
    (
        "nvidia-cuda-cupti",
        "13.0.85",
        "4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8",
        [("libcupti.so.13", "lib")],
    ),
]

EXPECTED_MB = 520


def say(text: str) -> None:
    print(f"libtorch: {text}", flush=True)


def folder_mb(folder: Path) -> float:
    total = 0
    for path in folder.rglob("*"):
        try:
            if path.is_file():
                total += path.stat().st_size
        except OSError:
            pass
    return total / 1e6


def download(partial: Path) -> Path:
    """Downloads the wheels with pip, which checks the hashes, and shows one progress line."""
    wheels = partial / "wheels"
    wheels.mkdir(parents=True, exist_ok=True)
    scratch = partial / "tmp"
    scratch.mkdir(exist_ok=True)
    requirements = partial / "requirements.txt"
    requirements.write_text(
        "".join(f"{name}=={version} --hash=sha256:{digest}\n" for name, version, digest, _ in WHEELS)
    )
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-cache-dir",
               "--no-deps", "--only-binary=:all:", "--require-hashes", "--python-version", "3.11",
               "--implementation", "cp", "--abi", "cp311", "--abi", "none",
               "--platform", "manylinux_2_28_x86_64", "--platform", "manylinux_2_25_x86_64",
               "--platform", "manylinux_2_17_x86_64", "--platform", "manylinux2014_x86_64",
               "--dest", str(wheels), "--requirement", str(requirements)]
    environment = dict(os.environ, TMPDIR=str(scratch))
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    output: list[str] = []
    reader = threading.Thread(target=lambda: output.extend(process.stdout), daemon=True)
    reader.start()
    live = sys.stdout.isatty()
    started = time.monotonic()
    last = 0.0
    try:
        while process.poll() is None:
            time.sleep(0.5)
            elapsed = time.monotonic() - started
            if live or elapsed - last >= 10:
                last = elapsed
                done = min(folder_mb(partial), EXPECTED_MB)
                line = f"libtorch: downloading {done:5.0f} of about {EXPECTED_MB} MB, {elapsed:4.0f} s"
                print(line, end="\r" if live else "\n", flush=True)
    except KeyboardInterrupt:
        process.terminate()
        process.wait()
        raise
    finally:
        if live:
            print()
    reader.join(timeout=5)
    if process.returncode != 0:
        sys.stderr.write("".join(output))
        raise SystemExit(
            "libtorch: the download failed (see pip's message above). Check that pip reaches its package index, "
            "or set LIBTORCH to the folder of a libtorch " + BUILD_VERSION + " you already have."
        )
    return wheels


def extract(wheels: Path, stage: Path) -> None:
    for name, version, _, wanted in WHEELS:
        stem = name.replace("-", "_")
        found = [w for w in wheels.glob("*.whl") if w.name.lower().replace("-", "_").startswith(f"{stem}_{version}")]
        if len(found) != 1:
            raise SystemExit(f"libtorch: expected one wheel of {name} {version}, found {len(found)} in {wheels}")
        with zipfile.ZipFile(found[0]) as archive:
            for item in archive.infolist():
                if item.is_dir():
                    continue
                for pattern, folder in wanted:
                    if pattern.endswith("/"):
                        if not item.filename.startswith(pattern):
                            continue
                        target = stage / folder / item.filename[len(pattern):]
                    elif item.filename == pattern or item.filename.endswith("/" + pattern):
                        target = stage / folder / Path(pattern).name
                    else:
                        continue
                    target.parent.mkdir(parents=True, exist_ok=True)
                    with archive.open(item) as source, open(target, "wb") as sink:
                        shutil.copyfileobj(source, sink, 1 << 20)
    for library in ["libtorch_cpu.so", "libc10.so", "libgomp.so.1", "libcudart.so.13", "libcupti.so.13"]:
        if not (stage / "lib" / library).is_file():
            raise SystemExit(f"libtorch: the wheels do not contain {library}")
    # tch links against `torch`, and needs only the CPU library.
    (stage / "lib" / "libtorch.so").write_text("INPUT ( libtorch_cpu.so )\n")
    (stage / "build-version").write_text(BUILD_VERSION + "\n")


def main() -> None:
    if os.environ.get("LIBTORCH"):
        say(f"using LIBTORCH={os.environ['LIBTORCH']}")
        return
    target = Path(sys.argv[1] if len(sys.argv) > 1 else ".libtorch").absolute()
    marker = target / "build-version"
    if marker.is_file() and marker.read_text().strip() == BUILD_VERSION:
        return
    if target.exists():
        shutil.rmtree(target)
    partial = target.with_name(target.name + ".partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    say(f"fetching libtorch {BUILD_VERSION} (CPU) once, into {target.name}/")
    wheels = download(partial)
    say("unpacking")
    stage = partial / "stage"
    extract(wheels, stage)
    stage.rename(target)
    shutil.rmtree(partial)
    say(f"ready in {target.name}/ ({folder_mb(target):.0f} MB)")


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit("libtorch: interrupted; repeat the command to continue")
