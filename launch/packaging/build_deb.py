#!/usr/bin/env python3
"""Builds a Debian package from the built programs.

Usage: python3 launch/packaging/build_deb.py [TARGET] [OUT]     (default: target, target/carff_VERSION_ARCH.deb)

| content | path |
|---|---|
| programs (the link and optional cameras only if they were built), libtorch, ONNX Runtime | /usr/lib/carff/bin, /usr/lib/carff/lib |
| checkpoints, graphs, scenarios, schemas | /usr/share/carff/configs |
| graph file of the service | /etc/carff/vehicle.toml |
| units | /lib/systemd/system |
| manual pages, completions, documents | the system's usual paths |

Needs dpkg-deb. With cargo-cyclonedx, the documents include a bill of materials. Equal files give an equal package: its
times are those of the last commit.
"""

import gzip
import os
import re
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path

import build_sbom

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ["carff", "carff-launch", "carff-camera", "carff-encoder", "carff-encoder-tch", "carff-forecaster", "carff-prober",
            "carff-renderer", "carff-controller", "carff-viewer"]
# Included if they were built with `make link`, `make camera-rtsp` and `make camera-gst`.
OPTIONAL = ["carff-link", "carff-camera-rtsp", "carff-camera-gst"]
# The run path of a program built in the project, and its replacement in the package.
BUILT_RUNPATH = b"$ORIGIN/../../.libtorch/lib:$ORIGIN/../../../.libtorch/lib"
INSTALLED_RUNPATH = b"$ORIGIN/../lib"
DEPENDS = "libc6 (>= 2.34), libgcc-s1, libstdc++6, libgomp1, passwd"
# Only the window needs the libraries of a display.
SUGGESTS = "libgl1, libxkbcommon0, libwayland-client0, ffmpeg"


def run(*command: str, **kwargs) -> str:
    return subprocess.run(command, check=True, stdout=subprocess.PIPE, text=True, cwd=ROOT, **kwargs).stdout.strip()


def put(source: Path, target: Path, mode: int = 0o644) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(source, target)
    target.chmod(mode)


def put_program(source: Path, target: Path) -> None:
    data = source.read_bytes()
    if data.count(BUILT_RUNPATH) != 1:
        sys.exit(f"{source}: its run path is not that of .cargo/config.toml: build it with `make build`")
    # Shorter, and padded with zeros: a string of the dynamic section ends at the first zero.
    data = data.replace(BUILT_RUNPATH, INSTALLED_RUNPATH.ljust(len(BUILT_RUNPATH), b"\0"))
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(data)
    target.chmod(0o755)
    run("strip", "--strip-debug", str(target))


def put_tree(source: Path, target: Path) -> None:
    for name in run("git", "ls-files", "-z", str(source)).split("\0"):
        if name:
            put(ROOT / name, target / Path(name).relative_to(source))


def put_compressed(text: bytes, target: Path) -> None:
    target.parent.mkdir(parents=True, exist_ok=True)
    target.write_bytes(gzip.compress(text, mtime=0))
    target.chmod(0o644)


def fill(tree: Path, target: Path) -> None:
    home, share, doc = tree / "usr/lib/carff", tree / "usr/share/carff", tree / "usr/share/doc/carff"
    for program in PROGRAMS + [name for name in OPTIONAL if (target / "release" / name).is_file()]:
        put_program(target / "release" / program, home / "bin" / program)
    libtorch = Path(os.environ.get("LIBTORCH") or ROOT / ".libtorch")
    for library in sorted((libtorch / "lib").glob("*.so*")):
        put(library, home / "lib" / library.name)
    if (libtorch / "build-version").is_file():
        put(libtorch / "build-version", home / "build-version")
    put(Path(os.environ.get("ORT_DYLIB_PATH") or ROOT / ".onnxruntime/lib/libonnxruntime.so.1"), home / "lib/libonnxruntime.so.1")
    (tree / "usr/bin").mkdir(parents=True)
    (tree / "usr/bin/carff").symlink_to("../lib/carff/bin/carff")
    for part in ["checkpoints", "graphs", "scenarios", "schemas", "soak", "training"]:
        put_tree(Path("configs") / part, share / "configs" / part)
    for page in ["README.md", "THIRD_PARTY.md", "CHANGELOG.md", "LICENSE-MIT", "LICENSE-APACHE"]:
        put(ROOT / page, doc / page)
    put_tree(Path("docs"), doc / "docs")
    if build_sbom.is_there():
        (doc / "carff.cdx.json").write_text(build_sbom.build(), encoding="utf-8")
        (doc / "carff.cdx.json").chmod(0o644)
    else:
        print("the package has no bill of materials: cargo-cyclonedx is not installed (see `make sbom`)")
    debian = ROOT / "launch/packaging/debian"
    put(debian / "vehicle.toml", tree / "etc/carff/vehicle.toml")
    for unit in ["carff.service", "carff-metrics.service", "carff-record.service", "carff.target"]:
        put(debian / unit, tree / "lib/systemd/system" / unit)
    for drop_in in ["camera-device.conf", "camera-network.conf"]:
        put(debian / drop_in, doc / "examples" / drop_in)
    put(debian / "carff.tmpfiles", tree / "usr/lib/tmpfiles.d/carff.conf")

    carff = str(target / "release/carff")
    environment = {**os.environ, "LD_LIBRARY_PATH": str(libtorch / "lib")}
    with tempfile.TemporaryDirectory() as folder:
        run(carff, "man", folder, env=environment)
        for page in sorted(Path(folder).iterdir()):
            put_compressed(page.read_bytes(), tree / "usr/share/man/man1" / f"{page.name}.gz")
    for shell, place in [
        ("bash", "usr/share/bash-completion/completions/carff"),
        ("zsh", "usr/share/zsh/vendor-completions/_carff"),
        ("fish", "usr/share/fish/vendor_completions.d/carff.fish"),
    ]:
        (tree / place).parent.mkdir(parents=True, exist_ok=True)
        (tree / place).write_text(run(carff, "completions", shell, env=environment) + "\n")


def control(tree: Path, version: str, architecture: str) -> None:
    folder = tree / "DEBIAN"
    folder.mkdir()
    kilobytes = sum(p.stat().st_size for p in tree.rglob("*") if p.is_file() and not p.is_symlink()) // 1024
    (folder / "control").write_text(
        f"Package: carff\nVersion: {version}\nArchitecture: {architecture}\nMaintainer: The CARFF engineers\n"
        f"Installed-Size: {kilobytes}\nDepends: {DEPENDS}\nSuggests: {SUGGESTS}\nSection: science\nPriority: optional\n"
        "Description: driving decisions from one camera image under occlusion\n"
        " CARFF computes a belief over the possible 3D scenes of a camera image, forecasts them, and decides to\n"
        " advance or to halt. It runs as processes over shared memory, with probes, recordings and a systemd\n"
        " service.\n"
    )
    for script in ["postinst", "prerm", "postrm"]:
        put(ROOT / "launch/packaging/debian" / script, folder / script, 0o755)
    put(ROOT / "launch/packaging/debian/conffiles", folder / "conffiles")


def main() -> None:
    target = Path(sys.argv[1] if len(sys.argv) > 1 else "target").resolve()
    version = re.search(r'^version = "(.+)"$', (ROOT / "Cargo.toml").read_text(), re.M).group(1)
    architecture = run("dpkg", "--print-architecture")
    out = Path(sys.argv[2] if len(sys.argv) > 2 else target / f"carff_{version}_{architecture}.deb").resolve()
    with tempfile.TemporaryDirectory(dir=target) as folder:
        tree = Path(folder) / "carff"
        tree.mkdir(mode=0o755)
        fill(tree, target)
        control(tree, version, architecture)
        for path in tree.rglob("*"):
            if path.is_dir():
                path.chmod(0o755)
        environment = {**os.environ, "SOURCE_DATE_EPOCH": run("git", "log", "-1", "--format=%ct")}
        run("dpkg-deb", "--root-owner-group", "-Zzstd", "-z9", "--build", str(tree), str(out), env=environment)
    print(f"{out}: {out.stat().st_size / 1e6:.0f} MB")


if __name__ == "__main__":
    main()
