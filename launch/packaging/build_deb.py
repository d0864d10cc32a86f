#!/usr/bin/env python3
"""Builds two Debian packages from the built programs: what a vehicle carries, and what needs libtorch.

Usage: python3 launch/packaging/build_deb.py [TARGET] [OUT] [--machine MACHINE]     (default: target, TARGET, this one)

OUT is the folder of carff_VERSION_ARCH.deb and carff-lab_VERSION_ARCH.deb. For another machine than this one, only the first is
built, from the programs that `make deb-arm64` cross-builds. Content of the first:

| content | path |
|---|---|
| programs (the link and optional cameras only if they were built), ONNX Runtime | /usr/lib/carff/bin, /usr/lib/carff/lib |
| checkpoints, graphs, scenarios, schemas | /usr/share/carff/configs |
| graph file of the service | /etc/carff/vehicle.toml |
| units | /lib/systemd/system |
| manual pages, completions, documents | the system's usual paths |

The second adds to the same folders: `carff-lab` (training, evaluation), the window, `carff-encoder-tch`, and libtorch.

Needs dpkg-deb. With cargo-cyclonedx, the documents include a bill of materials. Equal files give equal packages: their
times are those of the last commit.
"""

import argparse
import gzip
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import build_sbom
from fetch_libraries import folder_of

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ["carff", "carff-launch", "carff-camera", "carff-encoder", "carff-forecaster", "carff-prober", "carff-renderer",
            "carff-controller"]
# Included if they were built with `make link`, `make camera-rtsp` and `make camera-gst`.
OPTIONAL = ["carff-link", "carff-camera-rtsp", "carff-camera-gst"]
# Debian's name of each machine, and its number in the header of a program.
MACHINES = {"x86_64": ("amd64", 62), "aarch64": ("arm64", 183)}
# Programs that link libtorch.
LAB_PROGRAMS = ["carff-lab", "carff-encoder-tch", "carff-viewer"]
# The run path of a program built in the project, and its replacement in the package.
BUILT_RUNPATH = b"$ORIGIN/../../.libtorch/lib:$ORIGIN/../../../.libtorch/lib"
INSTALLED_RUNPATH = b"$ORIGIN/../lib"
# The newest version 2.x of the C library whose functions a program uses.
LIBC = 35
DEPENDS = f"libc6 (>= 2.{LIBC}), libgcc-s1, libstdc++6, passwd"
LAB_DEPENDS = f"libc6 (>= 2.{LIBC}), libgcc-s1, libstdc++6, libgomp1"
# Only the window needs the libraries of a display.
LAB_SUGGESTS = "libgl1, libxkbcommon0, libwayland-client0"


def run(*command: str, **kwargs) -> str:
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT, **kwargs).stdout.strip()


def put(source: Path, target: Path, mode: int = 0o644) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    target.chmod(mode)


def put_program(source: Path, target: Path, machine: str) -> None:
    data = source.read_bytes()
    if int.from_bytes(data[18:20], "little") != MACHINES[machine][1]:
        sys.exit(f"{source} is not a program for {machine}")
    libc = max(map(int, re.findall(rb"\0GLIBC_2\.(\d+)(?=\0)", data)), default=0)
    if libc > LIBC:
        sys.exit(f"{source} needs version 2.{libc} of the C library, and the package depends on 2.{LIBC}")
    if data.count(BUILT_RUNPATH) != 1:
        sys.exit(f"{source}: its run path is not that of .cargo/config.toml: build it with `make build`")
    # Shorter, and padded with zeros: a string of the dynamic section ends at the first zero.
    data = data.replace(BUILT_RUNPATH, INSTALLED_RUNPATH.ljust(len(BUILT_RUNPATH), b"\0"))
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    target.chmod(0o755)
    run("strip" if machine == platform.machine() else f"{machine}-linux-gnu-strip", "--strip-debug", str(target))


def put_tree(source: Path, target: Path) -> None:
    for name in run("git", "ls-files", "-z", str(source)).split("\0"):
        link, to = ROOT / name, target / Path(name).relative_to(source)
        if name and link.is_symlink():
            # Checkpoints share a backbone.
            to.parent.mkdir(parents=True, exist_ok=True)
            to.symlink_to(link.readlink())
        elif name:
            put(link, to)


def put_compressed(text: bytes, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(gzip.compress(text, mtime=0))
    target.chmod(0o644)


def programs_of(target: Path, machine: str) -> Path:
    """Returns the folder of a machine's programs."""
    if machine == platform.machine():
        return target / "release"
    return target / MACHINES[machine][0] / f"{machine}-unknown-linux-gnu" / "release"


def onnxruntime(machine: str) -> Path:
    own = os.environ.get("ORT_DYLIB_PATH") if machine == platform.machine() else None
    return Path(own or ROOT / folder_of("onnxruntime", machine) / "lib/libonnxruntime.so.1")


def fill(tree: Path, target: Path, machine: str) -> None:
    home, share, doc = tree / "usr/lib/carff", tree / "usr/share/carff", tree / "usr/share/doc/carff"
    programs = programs_of(target, machine)
    for program in PROGRAMS + [name for name in OPTIONAL if (programs / name).is_file()]:
        put_program(programs / program, home / "bin" / program, machine)
    put(onnxruntime(machine), home / "lib/libonnxruntime.so.1")
    (tree / "usr/bin").mkdir(parents=True)
    (tree / "usr/bin/carff").symlink_to("../lib/carff/bin/carff")
    for part in ["checkpoints", "graphs", "scenarios", "schemas", "soak", "training"]:
        put_tree(Path("configs") / part, share / "configs" / part)
    for page in ["README.md", "THIRD_PARTY.md", "CHANGELOG.md", "LICENSE-MIT", "LICENSE-APACHE"]:
        put(ROOT / page, doc / page)
    put_tree(Path("docs"), doc / "docs")
    if build_sbom.is_there():
        (doc / "carff.cdx.json").write_text(build_sbom.build(machine), encoding="utf-8")
        (doc / "carff.cdx.json").chmod(0o644)
    else:
        print("the package has no bill of materials: cargo-cyclonedx is not installed (see `make sbom`)")
    debian = ROOT / "launch/packaging/debian"
    put(debian / "vehicle.toml", tree / "etc/carff/vehicle.toml")
    for unit in ["carff.service", "carff-metrics.service", "carff-record.service", "carff-bridge.service", "carff.target"]:
        put(debian / unit, tree / "lib/systemd/system" / unit)
    for drop_in in ["camera-device.conf", "camera-network.conf"]:
        put(debian / drop_in, doc / "examples" / drop_in)
    put(debian / "carff.tmpfiles", tree / "usr/lib/tmpfiles.d/carff.conf")

    # This machine's program prints the same pages as the package's.
    carff = str(target / "release/carff")
    with tempfile.TemporaryDirectory() as folder:
        run(carff, "man", folder)
        for page in sorted(Path(folder).iterdir()):
            put_compressed(page.read_bytes(), tree / "usr/share/man/man1" / f"{page.name}.gz")
    for shell, place in [
        ("bash", "usr/share/bash-completion/completions/carff"),
        ("zsh", "usr/share/zsh/vendor-completions/_carff"),
        ("fish", "usr/share/fish/vendor_completions.d/carff.fish"),
    ]:
        (tree / place).parent.mkdir(parents=True, exist_ok=True)
        (tree / place).write_text(run(carff, "completions", shell) + "\n")


def fill_lab(tree: Path, target: Path, machine: str) -> None:
    home = tree / "usr/lib/carff"
    for program in LAB_PROGRAMS:
        put_program(programs_of(target, machine) / program, home / "bin" / program, machine)
    libtorch = Path(os.environ.get("LIBTORCH") or ROOT / ".libtorch")
    for library in sorted((libtorch / "lib").glob("*.so*")):
        put(library, home / "lib" / library.name)
    if (libtorch / "build-version").is_file():
        put(libtorch / "build-version", home / "build-version")
    for page in ["LICENSE-MIT", "LICENSE-APACHE", "THIRD_PARTY.md"]:
        put(ROOT / page, tree / "usr/share/doc/carff-lab" / page)


def write_control(tree: Path, fields: dict[str, str], description: str) -> Path:
    folder = tree / "DEBIAN"
    folder.mkdir()
    kilobytes = sum(p.stat().st_size for p in tree.rglob("*") if p.is_file() and not p.is_symlink()) // 1024
    fields = {**fields, "Maintainer": "The CARFF engineers", "Installed-Size": str(kilobytes), "Section": "science",
              "Priority": "optional", "Description": description}
    (folder / "control").write_text("".join(f"{key}: {value}\n" for key, value in fields.items()))
    return folder


def control(tree: Path, version: str, architecture: str) -> None:
    fields = {"Package": "carff", "Version": version, "Architecture": architecture, "Depends": DEPENDS,
              "Suggests": f"carff-lab (= {version}), ffmpeg"}
    folder = write_control(
        tree,
        fields,
        "driving decisions from one camera image under occlusion\n"
        " CARFF computes a belief over the possible 3D scenes of a camera image, forecasts them, and decides to\n"
        " advance or to halt. It runs as processes over shared memory, with probes, recordings and a systemd\n"
        " service.",
    )
    for script in ["postinst", "prerm", "postrm"]:
        put(ROOT / "launch/packaging/debian" / script, folder / script, 0o755)
    put(ROOT / "launch/packaging/debian/conffiles", folder / "conffiles")


def control_lab(tree: Path, version: str, architecture: str) -> None:
    fields = {"Package": "carff-lab", "Version": version, "Architecture": architecture,
              "Depends": f"carff (= {version}), {LAB_DEPENDS}", "Suggests": LAB_SUGGESTS}
    write_control(
        tree,
        fields,
        "training, evaluation and window of CARFF\n"
        " The programs of CARFF that compute with libtorch, and libtorch. A vehicle that drives does not need them.",
    )


def build(name: str, folder: Path, out: Path) -> None:
    tree = folder / name
    for path in tree.rglob("*"):
        if path.is_dir():
            path.chmod(0o755)
    environment = {**os.environ, "SOURCE_DATE_EPOCH": run("git", "log", "-1", "--format=%ct")}
    run("dpkg-deb", "--root-owner-group", "-Zzstd", "-z9", "--build", str(tree), str(out), env=environment)
    print(f"{out}: {out.stat().st_size / 1e6:.0f} MB")


def main() -> None:
    arguments = argparse.ArgumentParser(description="Builds the Debian packages from the built programs.")
    arguments.add_argument("target", nargs="?", type=Path, default=Path("target"))
    arguments.add_argument("out", nargs="?", type=Path)
    arguments.add_argument("--machine", choices=sorted(MACHINES), default=platform.machine())
    given = arguments.parse_args()
    target, machine = given.target.resolve(), given.machine
    version = re.search(r'^version = "(.+)"$', (ROOT / "Cargo.toml").read_text(), re.M).group(1)
    architecture = MACHINES[machine][0]
    out = (given.out or target).resolve()
    out.mkdir(parents=True, exist_ok=True)
    parts = [("carff", fill, control), ("carff-lab", fill_lab, control_lab)]
    if machine != platform.machine():
        parts = parts[:1]
    with tempfile.TemporaryDirectory(dir=target) as folder:
        for name, content, describe in parts:
            tree = Path(folder) / name
            tree.mkdir(mode=0o755)
            content(tree, target, machine)
            describe(tree, version, architecture)
            build(name, Path(folder), out / f"{name}_{version}_{architecture}.deb")


if __name__ == "__main__":
    main()
