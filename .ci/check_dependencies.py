#!/usr/bin/env python3
"""Checks dependencies and house rules without network, after the crates are fetched.

The rules of deny.toml cover licences, banned crates, duplicate versions and sources, for each of its targets. This program
also checks the direction of dependencies between our crates, which of them may use libtorch, that `make build` compiles no
library of `make run` again, and that each fetched library has a hash for each target. House rules: no unfinished code, no
paths of one machine, `unsafe` in named modules only, one meaning for each name of a public type.

Usage: python3 .ci/check_dependencies.py      (from anywhere; exit code 1 and one line per finding)
"""

import json
import re
import subprocess
import sys
from pathlib import Path

try:
    import tomllib
except ImportError:  # Python before 3.11: pip brings a reader along.
    from pip._vendor import tomli as tomllib

ROOT = Path(__file__).resolve().parent.parent

# The only modules with `unsafe`, each with its reason.
UNSAFE_MODULES = {
    "shared/field/src/kernels/bf16.rs": "a kernel in AVX-512 BF16 instructions",
    "shared/field/src/kernels/dispatch.rs": "calls kernels compiled for an instruction set that was found at run time",
    "shared/field/src/kernels/prefetch.rs": "the prefetch instruction",
    "shared/messages/src/tests.rs": "makes messages out of arbitrary bytes",
    "shared/networks/src/allocator.rs": "mallopt",
    "shared/networks/src/borrow.rs": "tensors that borrow shared memory",
    "shared/runtime/src/realtime.rs": "sched_setscheduler, malloc_trim",
    "tests/readers/src/raw.rs": "overwrites bytes of messages",
    "shared/transport/src/descriptors.rs": "file descriptors of iceoryx2's listeners",
    "shared/transport/src/untyped.rs": "reads the header of messages whose type is not known",
}

# The only crates that may use libtorch, each with its reason. No other program links it, and `make run` builds none.
TENSOR_CRATE = "torch-sys"
TENSOR_USERS = {
    "carff-encoder": "`carff-encoder-tch`; `carff-encoder` and a build without the feature `tch` do not link it",
    "carff-evaluation": "the networks of training, evaluated",
    "carff-lab": "training and evaluation",
    "carff-networks": "the networks in tensors",
    "carff-readers": "the reader of training files",
    "carff-training": "training",
    "carff-viewer": "the window, which computes without a graph",
}

UNFINISHED = re.compile(r"\b(?:todo|unimplemented)!|\bdbg!\(|\b(?:FIXME|TODO|XXX)\b")
MACHINE_PATH = re.compile(r"(?<![\w.}$])/(?:home|root|work|Users|mnt|media|tmp)/(?!carff-)")
UNSAFE = re.compile(r"\bunsafe\s*(?:\{|fn\b|impl\b|extern\b|trait\b)")
TEXT = {".rs", ".toml", ".py", ".md", ".json", ".sh", ".yml"}
# Largest distance of a SAFETY line above its `unsafe` block; macro arguments may be in between.
SAFETY_LINES = 4

findings: list[str] = []


def find(text: str) -> None:
    findings.append(text)


def run(*command: str) -> str:
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True)
    if done.returncode != 0:
        sys.exit(f"{' '.join(command)} failed:\n{done.stderr.strip()}")
    return done.stdout


def licence_allowed(expression: str, allowed: set[str]) -> bool:
    """Returns true if allowed licences satisfy an SPDX expression. `/` is the old form of OR."""
    tokens = re.findall(r"[()]|[^\s()]+", expression.replace("/", " OR "))
    place = 0

    def one() -> bool:
        nonlocal place
        token = tokens[place]
        place += 1
        if token == "(":
            result = either()
            if tokens[place] != ")":
                raise IndexError
            place += 1
            return result
        if tokens[place:place + 1] == ["WITH"]:
            token = f"{token} WITH {tokens[place + 1]}"
            place += 2
        return token in allowed

    def both() -> bool:
        nonlocal place
        result = one()
        while tokens[place:place + 1] == ["AND"]:
            place += 1
            result &= one()
        return result

    def either() -> bool:
        nonlocal place
        result = both()
        while tokens[place:place + 1] == ["OR"]:
            place += 1
            result |= both()
        return result

    try:
        return either() and place == len(tokens)
    except IndexError:
        return False


def version_matches(version: str, wanted: str) -> bool:
    """Returns true if a version starts with the version of a `crate@version` entry."""
    return version == wanted or version.startswith((wanted + ".", wanted + "+"))


def named(entry: object) -> tuple[str, str]:
    """Returns crate and version (may be empty) of a deny.toml entry."""
    text = entry["crate"] if isinstance(entry, dict) else str(entry)
    name, _, version = text.partition("@")
    return name, version


def check_crates(metadata: dict, deny: dict) -> None:
    ids = {node["id"]: node for node in metadata["resolve"]["nodes"]}
    packages = {p["id"]: p for p in metadata["packages"] if p["id"] in ids}
    ours = set(metadata["workspace_members"])

    allowed = set(deny["licenses"]["allow"])
    for package in packages.values():
        label = f"{package['name']} {package['version']}"
        if not licence_allowed(package["license"] or "", allowed):
            find(f"{label}: licence `{package['license']}` is not among those that deny.toml allows")
        if package["id"] not in ours and not (package["source"] or "").startswith("registry+"):
            find(f"{label}: comes from {package['source'] or 'a path'}, not from a registry")

    users: dict[str, set[str]] = {}
    for node in ids.values():
        for dependency in node["deps"]:
            users.setdefault(packages[dependency["pkg"]]["name"], set()).add(packages[node["id"]]["name"])
    present = {p["name"] for p in packages.values()}
    for entry in deny["bans"]["deny"]:
        name, version = named(entry)
        found = [p for p in packages.values() if p["name"] == name and (not version or version_matches(p["version"], version))]
        strangers = users.get(name, set()) - set(entry.get("wrappers", []))
        if found and (strangers or not entry.get("wrappers")):
            find(f"{name}: banned ({entry['reason']}), but used by {', '.join(sorted(strangers)) or 'the lock file'}")

    versions: dict[str, list[str]] = {}
    for package in packages.values():
        versions.setdefault(package["name"], []).append(package["version"])
    skips = [named(entry) for entry in deny["bans"]["skip"]]
    for name, found in sorted(versions.items()):
        left = [v for v in found if not any(n == name and version_matches(v, w) for n, w in skips)]
        if len(found) > 1 and len(left) > 1:
            find(f"{name}: versions {', '.join(sorted(found))} at once; allow one in deny.toml, with its reason")
    for name, version in skips:
        if not any(version_matches(v, version) for v in versions.get(name, [])) or len(versions[name]) < 2:
            find(f"deny.toml: the line for {name}@{version} is no longer needed")
    for entry in deny["bans"]["deny"] + deny["bans"]["skip"] + deny["advisories"]["ignore"]:
        if not entry.get("reason"):
            find(f"deny.toml: {entry} has no reason")
    for node in ids.values():
        if packages[node["id"]]["name"].startswith("iceoryx2") and "dev_permissions" in node["features"]:
            find("iceoryx2 is built with dev_permissions: any user could write the shared memory")
    print(f"crates: {len(packages)}, {len(ours)} of them ours")


def check_arrows(metadata: dict) -> None:
    """Checks the directions: services and launch use shared, shared uses shared, and messages only uses base."""
    room = {}
    for package in metadata["packages"]:
        if package["source"] is None:
            room[package["name"]] = Path(package["manifest_path"]).parent.relative_to(ROOT).parts[0]
    for package in metadata["packages"]:
        if package["source"] is not None:
            continue
        name = package["name"]
        for dependency in package["dependencies"]:
            used = dependency["name"]
            # `carff-launch` is every command: also those of `carff` and the benchmarks. `carff-lab` is the rest of it.
            if used not in room or (name in ("carff-launch", "carff-lab") and room[used] == "launch"):
                continue
            if room[used] != "shared" and room[name] != "tests":
                find(f"{name} ({room[name]}/) depends on {used} ({room[used]}/): crates may only depend on shared/")
            if room[used] == "tests":
                find(f"{name} depends on {used}: nothing depends on tests/")
            if name == "carff-messages" and used != "carff-base":
                find(f"carff-messages depends on {used}: of our crates it may only use carff-base")


def check_tensors(metadata: dict) -> None:
    """Checks that only the named crates depend on libtorch, over any number of crates; tests may."""
    names = {package["id"]: package["name"] for package in metadata["packages"]}
    uses = {
        node["id"]: [d["pkg"] for d in node["deps"] if any(kind["kind"] is None for kind in d["dep_kinds"])]
        for node in metadata["resolve"]["nodes"]
    }

    def way(package: str) -> list[str]:
        """Returns the names of the crates from a package to libtorch's; none if there is no way."""
        ways, seen = [[package]], {package}
        while ways:
            here = ways.pop(0)
            if names[here[-1]] == TENSOR_CRATE:
                return [names[p] for p in here]
            ways += [[*here, used] for used in uses[here[-1]] if used not in seen and not seen.add(used)]
        return []

    users = {names[package]: found for package in metadata["workspace_members"] if (found := way(package))}
    for name in sorted(users.keys() - TENSOR_USERS.keys()):
        find(f"{name} links libtorch, which only {', '.join(TENSOR_USERS)} may: {' -> '.join(users[name])}")
    for name in sorted(TENSOR_USERS.keys() - users.keys()):
        find(f".ci/check_dependencies.py: {name} does not use libtorch any more")


def check_features(metadata: dict) -> None:
    """Checks that `make run` compiles each library with the features that `make build` asks for, which would otherwise
    compile it, and all that use it, again."""
    ours = {package["name"] for package in metadata["packages"] if package["source"] is None}
    running = re.search(r"^RUNNING := (.+)$", (ROOT / "Makefile").read_text(encoding="utf-8"), re.MULTILINE)[1].split()

    def features(*selection: str) -> dict[str, set[str]]:
        """Returns for each library the sets of features with which it is compiled; more than one for some build tools."""
        found: dict[str, set[str]] = {}
        options = ["--locked", "--offline", "--edges=normal,build", "--prefix=none", "--format={p}|{f}", *selection]
        for package, _, names in (line.partition("|") for line in run("cargo", "tree", *options).splitlines() if line):
            name, version = package.split()[:2]
            if name not in ours:
                found.setdefault(f"{name} {version}", set()).add(names.removesuffix(" (*)"))
        return found

    part = features("--no-default-features", *(f"-p{name}" for name in [*running, "carff-features"]))
    whole = features("--workspace")
    for library in sorted(part):
        if missing := part[library] - whole[library]:
            find(f"{library}: `make run` compiles it with the features {' / '.join(sorted(missing)) or 'none'}, `make build` "
                 f"with {' / '.join(sorted(whole[library]))}; name the difference in launch/features/Cargo.toml")
    print(f"libraries of make run: {len(part)}, of make build: {len(whole)}")


def check_libraries(targets: list[str]) -> None:
    """Checks that the fetched libraries have a hash for each machine."""
    sys.path.insert(0, str(ROOT / "launch/packaging"))
    from fetch_libraries import LIBRARIES

    machines = {target.partition("-")[0] for target in targets}
    for name, library in LIBRARIES.items():
        for wheel in library.wheels:
            known = {machine for machine, value in wheel.sha256.items() if re.fullmatch("[0-9a-f]{64}", value)}
            if known != machines or set(library.size_mb) != machines:
                find(f"{name}: {wheel.name} {wheel.version} has a hash for {', '.join(sorted(known))}; the targets of "
                     f"deny.toml are {', '.join(sorted(machines))}")


def check_sources() -> None:
    files = [Path(f) for f in run("git", "ls-files", "--cached", "--others", "--exclude-standard").splitlines()]
    count = 0
    seen_unsafe = set()
    for file in files:
        if file.suffix not in TEXT and file.name not in {"Makefile", "run"} or not (ROOT / file).is_file():
            continue
        if (ROOT / file).resolve() == Path(__file__).resolve():
            continue
        count += 1
        lines = (ROOT / file).read_text(encoding="utf-8").splitlines()
        for number, line in enumerate(lines, 1):
            here = f"{file}:{number}"
            if MACHINE_PATH.search(line):
                find(f"{here}: a path of one machine: {line.strip()}")
            if file.suffix != ".rs":
                continue
            if UNFINISHED.search(line):
                find(f"{here}: unfinished: {line.strip()}")
            if UNSAFE.search(line) and not line.lstrip().startswith("//"):
                seen_unsafe.add(str(file))
                if str(file) not in UNSAFE_MODULES:
                    find(f"{here}: `unsafe` outside of the modules that .ci/check_dependencies.py names")
                above = lines[max(0, number - 1 - SAFETY_LINES):number - 1]
                if "unsafe {" in line and not any("SAFETY:" in text for text in above):
                    find(f"{here}: no SAFETY line above this `unsafe` block")
    for file in sorted(set(UNSAFE_MODULES) - seen_unsafe):
        find(f".ci/check_dependencies.py: {file} has no `unsafe` any more")
    print(f"files: {count}")


PUBLIC_TYPE = re.compile(r"^ *pub (?:struct|enum|union|trait|type) (\w+)", re.MULTILINE)
# Names of public types in several crates, each with the one meaning that it has in all of them.
SHARED_TYPE_NAMES = {
    "Encoder": "the network from an image to a posterior, in ONNX Runtime and in libtorch",
    "MixtureNet": "the mixture density network, in native code and in libtorch",
}


def check_type_names() -> None:
    """Checks that one name of a public type has one meaning: it is in one crate. Tests and examples may repeat names."""
    files = [Path(f) for f in run("git", "ls-files", "--cached", "--others", "--exclude-standard").splitlines()]
    crates = {file.parent for file in files if file.name == "Cargo.toml"}
    users: dict[str, set[str]] = {}
    for file in files:
        if file.suffix != ".rs" or {"tests", "examples", "benches"} & set(file.parts) or not (ROOT / file).is_file():
            continue
        crate = next(folder for folder in file.parents if folder in crates)
        text = (ROOT / file).read_text(encoding="utf-8").split("#[cfg(test)]\nmod ")[0]
        for name in PUBLIC_TYPE.findall(text):
            users.setdefault(name, set()).add(str(crate))
    for name, found in sorted(users.items()):
        if len(found) > 1 and name not in SHARED_TYPE_NAMES:
            find(f"`{name}` is a public type of {' and '.join(sorted(found))}: one name has one meaning")
    for name in SHARED_TYPE_NAMES:
        if len(users.get(name, ())) < 2:
            find(f".ci/check_dependencies.py: `{name}` is no longer a public type of two crates")
    print(f"public types: {len(users)}")


# The crates whose files of integration tests are a program each, with the reason.
SEPARATE_TESTS = {"shared/training": "libtorch has one stream of random numbers per process"}


def check_test_programs() -> None:
    """Checks that each crate has one program of integration tests, which contains each of its files: cargo would not
    run a file that the program leaves out."""
    for main in sorted(ROOT.glob("**/tests/main.rs")):
        if "target" in main.relative_to(ROOT).parts:
            continue
        modules = set(re.findall(r"^mod (\w+);", main.read_text(encoding="utf-8"), re.MULTILINE))
        files = {file.stem for file in main.parent.glob("*.rs")} - {"main"}
        for name in sorted(files - modules):
            find(f"{main.relative_to(ROOT)}: no `mod {name};`, so that the tests of {name}.rs do not run")
    for manifest in sorted(ROOT.glob("**/Cargo.toml")):
        tests = manifest.parent / "tests"
        if "target" in manifest.relative_to(ROOT).parts or (tests / "main.rs").is_file():
            continue
        programs = sorted(file.name for file in tests.glob("*.rs"))
        if len(programs) > 1 and str(manifest.parent.relative_to(ROOT)) not in SEPARATE_TESTS:
            find(f"{manifest.relative_to(ROOT)}: {', '.join(programs)} are a program each; make them modules of tests/main.rs")


def main() -> None:
    deny = tomllib.loads((ROOT / "deny.toml").read_text(encoding="utf-8"))
    targets = deny["graph"]["targets"]
    platforms = [word for target in targets for word in ("--filter-platform", target)]
    metadata = json.loads(run("cargo", "metadata", "--locked", "--offline", "--format-version", "1", *platforms))
    check_crates(metadata, deny)
    check_arrows(metadata)
    check_tensors(metadata)
    check_features(metadata)
    check_libraries(targets)
    check_sources()
    check_test_programs()
    check_type_names()
    for text in findings:
        print(f"error: {text}", file=sys.stderr)
    if findings:
        sys.exit(f"{len(findings)} findings")
    print("dependencies and house rules: passed")


if __name__ == "__main__":
    main()
