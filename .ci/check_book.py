#!/usr/bin/env python3
"""Checks the book and the other pages without network.

The README has its length and its images. Links and images resolve, linked headings exist, every page of the book is in its summary, the built book has no dead
link, and included line ranges begin and end where a block does. Tests parse the commands in the pages
(launch/src/main.rs).

Usage: python3 .ci/check_book.py      (from anywhere; exit code 1 and one line per finding)
"""

import json
import re
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).resolve().parent.parent
BOOK = ROOT / "docs/book/src"

LINK = re.compile(r"!?\[[^\]]*\]\(([^)\s]+)\)")
HEADING = re.compile(r"^#+\s+(.*?)\s*$", re.MULTILINE)
INCLUDE = re.compile(r"\{\{#include ([^:}\s]+)(?::(\d+):(\d*))?\}\}")
FENCE = re.compile(r"^```.*?^```", re.MULTILINE | re.DOTALL)

# The README is read in one go.
README_LINES, README_IMAGES = 150, 3

findings: list[str] = []


def find(text: str) -> None:
    findings.append(text)


def anchors(text: str) -> set[str]:
    """Returns the anchors of a page's headings, as GitHub and mdBook make them."""
    headings = HEADING.findall(FENCE.sub("", text))
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def check_readme(text: str) -> None:
    lines, images = text.count("\n"), len(re.findall(r"!\[", text))
    if lines > README_LINES:
        find(f"README.md: {lines} lines; at most {README_LINES}")
    if images != README_IMAGES:
        find(f"README.md: {images} images; it has {README_IMAGES}")


def check_links(page: Path, text: str) -> None:
    here = page.relative_to(ROOT)
    for target in LINK.findall(FENCE.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        other = (page.parent / path).resolve() if path else page
        if not other.exists():
            find(f"{here}: {target} does not exist")
        elif ROOT not in other.parents:
            find(f"{here}: {target} is outside of the project")
        elif anchor and other.suffix == ".md" and anchor not in anchors(other.read_text(encoding="utf-8")):
            find(f"{here}: {target}: the page has no such heading")


def check_includes(page: Path, text: str) -> None:
    here = page.relative_to(ROOT)
    for path, first, last in INCLUDE.findall(text):
        other = (page.parent / path).resolve()
        if not other.is_file():
            find(f"{here}: {path} cannot be included: the file does not exist")
            continue
        lines = other.read_text(encoding="utf-8").splitlines()
        begin, end = int(first or 1), int(last or len(lines))
        if not 1 <= begin <= end <= len(lines):
            find(f"{here}: {path} does not have lines {begin} to {end}")
            continue
        cut = (begin > 1 and lines[begin - 2].strip()) or (end < len(lines) and lines[end].strip())
        if cut or not lines[begin - 1].strip() or not lines[end - 1].strip():
            find(f"{here}: lines {begin} to {end} of {path} do not begin and end where a block does")


def check_built_links() -> None:
    """Runs the book's preprocessor: no link that is left may leave the book."""
    pages = sorted(BOOK.glob("**/*.md"))
    chapters = [
        {"Chapter": {"content": p.read_text(encoding="utf-8"), "source_path": str(p.relative_to(BOOK)), "sub_items": []}}
        for p in pages
    ]
    done = subprocess.run(
        [sys.executable, "outside_links.py"], cwd=BOOK.parent, input=json.dumps([{}, {"items": chapters}]),
        capture_output=True, text=True, check=True,
    )
    for page, item in zip(pages, json.loads(done.stdout)["items"], strict=True):
        for target in LINK.findall(FENCE.sub("", item["Chapter"]["content"])):
            inside = (page.parent / target.partition("#")[0]).resolve().is_relative_to(BOOK)
            if not re.match(r"[a-z]+:", target) and not inside:
                find(f"{page.relative_to(ROOT)}: {target} is dead in the built book")


def main() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )
    pages = [ROOT / p for p in listed.stdout.splitlines() if (ROOT / p).is_file()]
    check_readme((ROOT / "README.md").read_text(encoding="utf-8"))
    for page in pages:
        text = page.read_text(encoding="utf-8")
        check_links(page, text)
        check_includes(page, text)
    summary = BOOK / "SUMMARY.md"
    named = {(BOOK / t).resolve() for t in LINK.findall(summary.read_text(encoding="utf-8"))}
    for page in sorted(set(BOOK.glob("**/*.md")) - named - {summary}):
        find(f"{page.relative_to(ROOT)}: missing in {summary.relative_to(ROOT)}")
    check_built_links()
    print(f"pages: {len(pages)}, of which {len(named)} in the book")
    for text in findings:
        print(f"error: {text}", file=sys.stderr)
    if findings:
        sys.exit(f"{len(findings)} findings")
    print("book and pages: passed")


if __name__ == "__main__":
    main()
