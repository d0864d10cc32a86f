#!/usr/bin/env python3
"""Checks that no sibling modules of a crate import each other in a circle.

A module's paths (`crate::`, `super::`, `self::`) outside its tests are its imports. A re-exported name counts as an
import of the module that defines it. Imports between a module and its own parents or children are not counted.

Usage: python3 .ci/check_circles.py [ROOT]    exit code 1 and one line per circle
"""

import re
import subprocess
import sys
from pathlib import Path

NOISE = re.compile(r"""//[^\n]*|/\*.*?\*/|r(#*)".*?"\1|"(?:[^"\\]|\\.)*"|'(?:\\.|[^\\'])'""", re.DOTALL)
USE = re.compile(r"\buse ([^;]+);")
INLINE = re.compile(r"(?<![\w:])(?:crate|super)(?:::\w+)+")

Module = tuple[str, ...]


def expand(tree: str) -> list[list[str]]:
    """Returns the paths of a use tree such as `a::{b, c::d as e}`."""
    head, brace, rest = tree.partition("{")
    path = [part for part in head.split(" as ")[0].strip().split("::") if part]
    if not brace:
        return [path]
    inner, depth, parts = rest[: rest.rindex("}")], 0, [""]
    for letter in inner:
        depth += (letter == "{") - (letter == "}")
        if letter == "," and depth == 0:
            parts.append("")
        else:
            parts[-1] += letter
    return [path + below for part in parts if part.strip() for below in expand(part)]


class Crate:
    """The modules of a crate, with the names that each one imports or re-exports."""

    def __init__(self, files: list[Path], src: Path):
        self.code: dict[Module, str] = {}
        for file in files:
            parts = file.relative_to(src).with_suffix("").parts
            module = parts[:-1] if parts[-1] in ("lib", "main", "mod") else parts
            text = NOISE.sub("", file.read_text(encoding="utf-8")).split("#[cfg(test)]\nmod ")[0]
            self.code[module] = self.code.get(module, "") + text
        self.names = {
            module: {path[-1]: path for use in USE.findall(text) for path in expand(use) if self.is_own(module, path)}
            for module, text in self.code.items()
        }

    def is_own(self, module: Module, path: list[str]) -> bool:
        return path[0] in ("crate", "super", "self") or module + (path[0],) in self.code

    def definer(self, module: Module, path: list[str]) -> Module:
        """Returns the module that defines a path's item; re-exports are followed."""
        at = () if path[0] == "crate" else module
        for part in path:
            if part == "super":
                at = at[:-1]
            elif at + (part,) in self.code:
                at += (part,)
            elif at != module and part in self.names[at]:
                return self.definer(at, self.names[at][part])
        return at

    def arrows(self) -> dict[Module, dict[Module, str]]:
        """Returns for each module the siblings that it or its children import, each with one of the paths."""
        arrows: dict[Module, dict[Module, str]] = {}
        for module, text in self.code.items():
            inline = [path.split("::") for path in INLINE.findall(USE.sub("", text))]
            for path in list(self.names[module].values()) + inline:
                other = self.definer(module, path)
                shared = next((i for i, (a, b) in enumerate(zip(module, other)) if a != b), None)
                if shared is not None:
                    arrows.setdefault(module[: shared + 1], {}).setdefault(other[: shared + 1], "::".join(path))
        return arrows

    def circles(self):
        """Yields the shortest circle through each module that is in one, once per set of modules."""
        arrows, known = self.arrows(), set()
        for start in sorted(arrows):
            paths, seen = [[start]], set()
            while paths:
                path = paths.pop(0)
                if start in arrows.get(path[-1], {}):
                    if frozenset(path) not in known:
                        known.add(frozenset(path))
                        yield [(a, b, arrows[a][b]) for a, b in zip(path, path[1:] + [start])]
                    break
                following = [m for m in sorted(arrows.get(path[-1], {})) if m not in seen]
                seen.update(following)
                paths += [path + [m] for m in following]


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent.parent
    listed = subprocess.run(["git", "ls-files", "--cached", "--others", "--exclude-standard", "*/src/*.rs"],
                            cwd=root, capture_output=True, text=True, check=True).stdout.split()
    crates: dict[Path, list[Path]] = {}
    for file in sorted(root / path for path in set(listed)):
        src = next(folder for folder in file.parents if folder.name == "src")
        if file.is_file() and "bin" not in file.relative_to(src).parts:
            crates.setdefault(src, []).append(file)
    found = [(src, circle) for src, files in crates.items() for circle in Crate(files, src).circles()]
    print(f"circles: {len(crates)} crates")
    for src, circle in found:
        steps = "; ".join(f"`{'::'.join(a)}` imports `{path}` of `{'::'.join(b)}`" for a, b, path in circle)
        print(f"error: {src.relative_to(root)}: {steps}. Move one of these items, so that no circle is left",
              file=sys.stderr)
    if found:
        sys.exit(f"{len(found)} circles of imports")
    print("circles: passed")


if __name__ == "__main__":
    main()
