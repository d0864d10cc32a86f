#!/usr/bin/env python3
"""Writes the bill of materials of the shipped programs as CycloneDX 1.5 JSON.

Usage: python3 launch/packaging/build_sbom.py [OUT] [--machine MACHINE]

OUT is target/carff.cdx.json by default, and MACHINE (x86_64 or aarch64) this one. Needs cargo-cyclonedx.

cargo-cyclonedx writes one file per crate into the source folders, so this program runs it on a copy. It merges the files
of the programs into one document with each crate once, and adds libtorch and ONNX Runtime, which are in no lock file. Equal
sources give equal bytes: the time is that of the last commit.
"""

import argparse
import json
import os
import platform
import re
import shutil
import subprocess
import sys
import tempfile
import uuid
from pathlib import Path

from fetch_libraries import LIBRARIES

ROOT = Path(__file__).resolve().parents[2]
PROGRAMS = ["launch", "launch/carff", "launch/lab", "services/camera", "services/encoder", "services/forecaster", "services/prober",
            "services/renderer", "services/controller", "services/viewer"]
TOOL = ["cargo", "cyclonedx"]
# The crate that uses each library.
USERS = {"libtorch": "torch-sys", "onnxruntime": "ort-sys"}


def run(*command: str, **kwargs) -> str:
    done = subprocess.run(command, capture_output=True, text=True, **kwargs)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr.strip()}")
    return done.stdout.strip()


def is_there() -> bool:
    """Returns true if cargo-cyclonedx is installed."""
    return shutil.which("cargo-cyclonedx") is not None


def describe(machine: str) -> list[dict]:
    """Returns the tool's description of each program's crate."""
    target = f"{machine}-unknown-linux-gnu"
    listed = run("git", "ls-files", "-z", "--cached", "--others", "--exclude-standard", "*.toml", "*.rs", "Cargo.lock",
                 cwd=ROOT)
    environment = {**os.environ, "SOURCE_DATE_EPOCH": run("git", "log", "-1", "--format=%ct", cwd=ROOT)}
    with tempfile.TemporaryDirectory() as folder:
        copy = Path(folder).resolve()
        for name in filter(None, listed.split("\0")):
            if (ROOT / name).is_file():
                (copy / name).parent.mkdir(parents=True, exist_ok=True)
                shutil.copyfile(ROOT / name, copy / name)
        run(*TOOL, "--format", "json", "--spec-version", "1.5", "--target", target, "--override-filename", "bom", "--quiet",
            cwd=copy, env=environment)
        texts = [(copy / program / "bom.json").read_text(encoding="utf-8") for program in PROGRAMS]
    # Remove the path of the copy.
    return [json.loads(text.replace(str(copy), "")) for text in texts]


def library(name: str, machine: str) -> list[dict]:
    """Returns the packages of a library that launch/packaging/fetch_libraries.py fetches, or the user's libtorch."""
    if name == "libtorch" and machine == platform.machine() and (own := os.environ.get("LIBTORCH")):
        version = (Path(own) / "build-version").read_text(encoding="utf-8").strip()
        return [{"type": "library", "bom-ref": "libtorch", "name": "libtorch", "version": version}]
    return [
        {
            "type": "library",
            "bom-ref": f"pkg:pypi/{wheel.name}@{wheel.version}",
            "name": wheel.name,
            "version": wheel.version,
            "purl": f"pkg:pypi/{wheel.name}@{wheel.version}",
            "hashes": [{"alg": "SHA-256", "content": wheel.sha256[machine]}],
        }
        for wheel in LIBRARIES[name].wheels
    ]


def merge(bills: list[dict], machine: str) -> dict:
    """Merges all bills into one, with each component once, sorted by name."""
    components: dict[str, dict] = {}
    uses: dict[str, set[str]] = {}
    programs = []
    for bill in bills:
        program = bill["metadata"]["component"]
        programs.append(program["bom-ref"])
        for component in [program, *bill.get("components", [])]:
            # A crate that is both a program and a library counts as the program.
            if component["type"] == "application" or component["bom-ref"] not in components:
                components[component["bom-ref"]] = component
        for entry in bill.get("dependencies", []):
            uses.setdefault(entry["ref"], set()).update(entry.get("dependsOn", []))
    for name, user in USERS.items():
        parts = {part["bom-ref"]: part for part in library(name, machine)}
        for ref in [ref for ref, component in components.items() if component["name"] == user]:
            uses.setdefault(ref, set()).update(parts)
        components.update(parts)
    version = re.search(r'^version = "(.+)"$', (ROOT / "Cargo.toml").read_text(encoding="utf-8"), re.M).group(1)
    metadata = {key: value for key, value in bills[0]["metadata"].items() if key in {"timestamp", "tools"}}
    metadata["component"] = {"type": "application", "bom-ref": "carff", "name": "carff", "version": version}
    bill = {
        "bomFormat": "CycloneDX",
        "specVersion": "1.5",
        "version": 1,
        "metadata": metadata,
        "components": sorted(components.values(), key=lambda c: (c["name"], c.get("version", ""), c["bom-ref"])),
        "dependencies": [{"ref": "carff", "dependsOn": sorted(programs)}]
        + [{"ref": ref, "dependsOn": sorted(used)} for ref, used in sorted(uses.items())],
    }
    known = {"carff", *components}
    missing = {used for entry in bill["dependencies"] for used in entry["dependsOn"]} - known
    if missing:
        sys.exit(f"used but not described: {', '.join(sorted(missing))}")
    return {**bill, "serialNumber": f"urn:uuid:{uuid.uuid5(uuid.NAMESPACE_URL, json.dumps(bill, sort_keys=True))}"}


def build(machine: str) -> str:
    """Returns the bill as text."""
    return json.dumps(merge(describe(machine), machine), indent=1) + "\n"


def main() -> None:
    arguments = argparse.ArgumentParser(description="Writes the bill of materials of the shipped programs.")
    arguments.add_argument("out", nargs="?", type=Path, default=ROOT / "target/carff.cdx.json")
    arguments.add_argument("--machine", default=platform.machine())
    given = arguments.parse_args()
    out = given.out
    if not is_there():
        sys.exit("cargo-cyclonedx is not installed: run `cargo install --locked cargo-cyclonedx`, then repeat")
    text = build(given.machine)
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(text, encoding="utf-8")
    print(f"{out}: {len(json.loads(text)['components'])} components of {len(PROGRAMS)} programs")


if __name__ == "__main__":
    main()
