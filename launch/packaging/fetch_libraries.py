#!/usr/bin/env python3
"""Fetches the pinned, hash-checked shared libraries of the programs, once.

Usage: python3 launch/packaging/fetch_libraries.py [NAME ...] [--machine MACHINE]     (default: libtorch onnxruntime)

Machines are x86_64 and aarch64; the default is this one. The libraries of another machine go into folders with its name, for
example .onnxruntime-aarch64.

| name | folder | needed by |
|---|---|---|
| onnxruntime | .onnxruntime | the encoder stage, at run time |
| libtorch | .libtorch | training, evaluation, the window, and the encoder with `backend = "tch"`, at build and run time |

The source is Python wheels, which pip's package index provides. The tch crate requires libtorch 2.11.0. Only its CPU
libraries are kept, with the two small CUDA runtime libraries that libtorch_cpu.so links.

You can interrupt and repeat the program: it works in FOLDER.partial and renames the folder at the end. If LIBTORCH or
ORT_DYLIB_PATH is set, that library is not fetched: the user's copy wins.
"""

import argparse
import os
import platform
import shutil
import subprocess
import sys
import threading
import time
import zipfile
from dataclasses import dataclass, field
from pathlib import Path


@dataclass(frozen=True)
class Wheel:
    """A Python package: its hash by machine, and the files to keep as (path in the wheel, target in the folder).

    `only` has further files to keep, by machine.
    """

    name: str
    version: str
    sha256: dict[str, str]
    keep: tuple[tuple[str, str], ...]
    only: dict[str, tuple[tuple[str, str], ...]] = field(default_factory=dict)

    def kept(self, machine: str) -> tuple[tuple[str, str], ...]:
        return self.keep + self.only.get(machine, ())


@dataclass(frozen=True)
class Library:
    """A library: its folder, the variable that names the user's own, its download size by machine, and its wheels."""

    folder: str
    version: str
    own: str
    size_mb: dict[str, int]
    wheels: tuple[Wheel, ...]


# Libraries that libtorch_cpu.so links on 64-bit Arm only.
ARM_LIBRARIES = ("libarm_compute.so", "libarm_compute_graph.so", "libnvpl_lapack_lp64_gomp.so.0", "libnvpl_lapack_core.so.0",
                 "libnvpl_blas_lp64_gomp.so.0", "libnvpl_blas_core.so.0")

LIBRARIES = {
    "onnxruntime": Library(".onnxruntime", "1.32.0", "ORT_DYLIB_PATH", {"x86_64": 28, "aarch64": 23}, (
        Wheel("onnxruntime", "1.32.0", {
            "x86_64": "5a34fc4dfeb5a7b4a74c95dcba1e773d722abda720b474edf1b0c419dc6d163d",
            "aarch64": "2303372a85299b6757b0e11e1cbf13e410ddf7e10c37f4b37e99d1c90e7daf7c",
        }, (
            ("onnxruntime/capi/libonnxruntime.so.1.32.0", "lib/libonnxruntime.so.1"),
            ("onnxruntime/LICENSE", "LICENSE"),
            ("onnxruntime/ThirdPartyNotices.txt", "ThirdPartyNotices.txt"),
        )),
    )),
    "libtorch": Library(".libtorch", "2.11.0", "LIBTORCH", {"x86_64": 520, "aarch64": 420}, (
        Wheel("torch", "2.11.0", {
            "x86_64": "7aa2f9bbc6d4595ba72138026b2074be1233186150e9292865e04b7a63b8c67a",
            "aarch64": "d91aac77f24082809d2c5a93f52a5f085032740a1ebc9252a7b052ef5a4fddc6",
        }, (
            ("torch/lib/libtorch_cpu.so", "lib/libtorch_cpu.so"),
            ("torch/lib/libc10.so", "lib/libc10.so"),
            ("torch/lib/libgomp.so.1", "lib/libgomp.so.1"),
            ("torch/include/", "include/"),
        ), {"aarch64": tuple((f"torch/lib/{name}", f"lib/{name}") for name in ARM_LIBRARIES)}),
        Wheel("nvidia-cuda-runtime", "13.0.96", {
            "x86_64": "7f82250d7782aa23b6cfe765ecc7db554bd3c2870c43f3d1821f1d18aebf0548",
            "aarch64": "ef9bcbe90493a2b9d810e43d249adb3d02e98dd30200d86607d8d02687c43f55",
        }, (("libcudart.so.13", "lib/libcudart.so.13"),)),
        Wheel("nvidia-cuda-cupti", "13.0.85", {
            "x86_64": "4eb01c08e859bf924d222250d2e8f8b8ff6d3db4721288cf35d14252a4d933c8",
            "aarch64": "796bd679890ee55fb14a94629b698b6db54bcfd833d391d5e94017dd9d7d3151",
        }, (("libcupti.so.13", "lib/libcupti.so.13"),)),
    )),
}


def folder_mb(folder: Path) -> float:
    total = 0
    for path in folder.rglob("*"):
        try:
            if path.is_file():
                total += path.stat().st_size
        except OSError:
            pass
    return total / 1e6


def download(name: str, library: Library, machine: str, partial: Path) -> Path:
    """Downloads the wheels with pip, which checks the hashes, and shows one progress line."""
    wheels = partial / "wheels"
    wheels.mkdir(parents=True, exist_ok=True)
    scratch = partial / "tmp"
    scratch.mkdir(exist_ok=True)
    requirements = partial / "requirements.txt"
    requirements.write_text(
        "".join(f"{w.name}=={w.version} --hash=sha256:{w.sha256[machine]}\n" for w in library.wheels)
    )
    platforms = [f"manylinux_2_{minor}_{machine}" for minor in (28, 27, 25, 17)] + [f"manylinux2014_{machine}"]
    command = [sys.executable, "-m", "pip", "download", "--quiet", "--disable-pip-version-check", "--no-cache-dir",
               "--no-deps", "--only-binary=:all:", "--require-hashes", "--python-version", "3.11",
               "--implementation", "cp", "--abi", "cp311", "--abi", "none",
               *[word for tag in platforms for word in ("--platform", tag)],
               "--dest", str(wheels), "--requirement", str(requirements)]
    environment = dict(os.environ, TMPDIR=str(scratch))
    process = subprocess.Popen(command, env=environment, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
    output: list[str] = []
    reader = threading.Thread(target=lambda: output.extend(process.stdout), daemon=True)
    reader.start()
    live = sys.stdout.isatty()
    size_mb = library.size_mb[machine]
    started = time.monotonic()
    last = 0.0
    try:
        while process.poll() is None:
            time.sleep(0.5)
            elapsed = time.monotonic() - started
            if live or elapsed - last >= 10:
                last = elapsed
                done = min(folder_mb(partial), size_mb)
                line = f"{name}: downloading {done:5.0f} of about {size_mb} MB, {elapsed:4.0f} s"
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
            f"{name}: the download failed (see pip's message above). Check that pip reaches its package index, "
            f"or set {library.own} to the {name} {library.version} that you already have."
        )
    return wheels


def target_of(item: str, keep: tuple[tuple[str, str], ...]) -> str | None:
    """Returns the place of a wheel's file in the folder, if it is kept."""
    for pattern, target in keep:
        if pattern.endswith("/") and item.startswith(pattern):
            return target + item[len(pattern):]
        if item == pattern or item.endswith("/" + pattern):
            return target
    return None


def extract(name: str, library: Library, machine: str, wheels: Path, stage: Path) -> None:
    for wheel in library.wheels:
        stem = wheel.name.replace("-", "_")
        found = [w for w in wheels.glob("*.whl") if w.name.lower().replace("-", "_").startswith(f"{stem}_{wheel.version}")]
        if len(found) != 1:
            raise SystemExit(f"{name}: expected one wheel of {wheel.name} {wheel.version}, found {len(found)} in {wheels}")
        with zipfile.ZipFile(found[0]) as archive:
            for item in archive.infolist():
                place = None if item.is_dir() else target_of(item.filename, wheel.kept(machine))
                if place is None:
                    continue
                target = stage / place
                target.parent.mkdir(parents=True, exist_ok=True)
                with archive.open(item) as source, open(target, "wb") as sink:
                    shutil.copyfileobj(source, sink, 1 << 20)
        for _, target in wheel.kept(machine):
            if not (stage / target).exists():
                raise SystemExit(f"{name}: the wheel of {wheel.name} {wheel.version} does not contain {target}")
    if name == "libtorch":
        # tch links against `torch`, and needs only the CPU library.
        (stage / "lib" / "libtorch.so").write_text("INPUT ( libtorch_cpu.so )\n")
    (stage / "build-version").write_text(library.version + "\n")


def folder_of(name: str, machine: str) -> Path:
    """Returns the folder of a library, in the project's folder."""
    folder = LIBRARIES[name].folder
    return Path(folder if machine == platform.machine() else f"{folder}-{machine}")


def fetch(name: str, library: Library, machine: str) -> None:
    own = os.environ.get(library.own)
    if own and machine == platform.machine():
        print(f"{name}: using {library.own}={own}", flush=True)
        return
    target = folder_of(name, machine).absolute()
    marker = target / "build-version"
    if marker.is_file() and marker.read_text().strip() == library.version:
        return
    if not all(machine in wheel.sha256 for wheel in library.wheels):
        raise SystemExit(f"{name}: no package is known for {machine}; set {library.own} to your own {name} {library.version}")
    if target.exists():
        shutil.rmtree(target)
    partial = target.with_name(target.name + ".partial")
    if partial.exists():
        shutil.rmtree(partial)
    partial.mkdir(parents=True)
    print(f"{name}: fetching {name} {library.version} (CPU, {machine}) once, into {target.name}/", flush=True)
    wheels = download(name, library, machine, partial)
    print(f"{name}: unpacking", flush=True)
    stage = partial / "stage"
    extract(name, library, machine, wheels, stage)
    stage.rename(target)
    shutil.rmtree(partial)
    print(f"{name}: ready in {target.name}/ ({folder_mb(target):.0f} MB)", flush=True)


def main() -> None:
    arguments = argparse.ArgumentParser(description="Fetches the pinned, hash-checked shared libraries of the programs, once.")
    arguments.add_argument("names", nargs="*", metavar="NAME", help=f"{' or '.join(LIBRARIES)}; default: all")
    arguments.add_argument("--machine", default=platform.machine(), help="x86_64 or aarch64; default: this machine")
    given = arguments.parse_args()
    names = given.names or list(LIBRARIES)
    if unknown := [name for name in names if name not in LIBRARIES]:
        raise SystemExit(f"unknown: {', '.join(unknown)}; known are {', '.join(LIBRARIES)}")
    for name in names:
        fetch(name, LIBRARIES[name], given.machine)


if __name__ == "__main__":
    try:
        main()
    except KeyboardInterrupt:
        raise SystemExit("interrupted; repeat the command to continue")
