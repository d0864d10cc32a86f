#!/usr/bin/env python3
"""Checks the book and the other pages without network: links and pictures resolve, headings that are linked to exist,
every page of the book is in its summary, no link of the built book is dead, and what a page includes begins and ends
where a block of it does.

That the commands in them are understood is a test of the command's own (launch/src/main.rs).

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

findings: list[str] = []


def find(text: str) -> None:
    findings.append(text)


def anchors(text: str) -> set[str]:
    """The anchors of a page's headings, as GitHub and mdBook make them."""
    headings = HEADING.findall(FENCE.sub("", text))
    return {re.sub(r"[^\w\- ]", "", h.lower()).replace(" ", "-") for h in headings}


def check_links(page: Path, text: str) -> None:
    here = page.relative_to(ROOT)
    for target in LINK.findall(FENCE.sub("", text)):
        if re.match(r"[a-z]+:", target):
            continue
        path, _, anchor = target.partition("#")
        other = (page.parent / path).resolve() if path else page
        if not other.exists():
            find(f"{here}: {target} leads nowhere")
        elif ROOT not in other.parents:
            find(f"{here}: {target} leads out of the project")
        elif anchor and other.suffix == ".md" and anchor not in anchors(other.read_text(encoding="utf-8")):
            find(f"{here}: {target}: there is no such heading")


def check_includes(page: Path, text: str) -> None:
    here = page.relative_to(ROOT)
    for path, first, last in INCLUDE.findall(text):
        other = (page.parent / path).resolve()
        if not other.is_file():
            find(f"{here}: {path} cannot be included: there is no such file")
            continue
        lines = other.read_text(encoding="utf-8").splitlines()
        begin, end = int(first or 1), int(last or len(lines))
        if not 1 <= begin <= end <= len(lines):
            find(f"{here}: {path} has no lines {begin} to {end}")
            continue
        cut = (begin > 1 and lines[begin - 2].strip()) or (end < len(lines) and lines[end].strip())
        if cut or not lines[begin - 1].strip() or not lines[end - 1].strip():
            find(f"{here}: lines {begin} to {end} of {path} do not begin and end where a block does")


def check_built_links() -> None:
    """What the book's preprocessor makes of links that lead out of the book: links to files that are in the repository."""
    pages = sorted(BOOK.glob("**/*.md"))
    chapters = [
        {"Chapter": {"content": p.read_text(encoding="utf-8"), "source_path": str(p.relative_to(BOOK)), "sub_items": []}}
        for p in pages
    ]
    repository = "https://example.org/book"
    context = {"config": {"output": {"html": {"git-repository-url": repository}}}}
    done = subprocess.run(
        [sys.executable, "outside_links.py"], cwd=BOOK.parent, input=json.dumps([context, {"items": chapters}]),
        capture_output=True, text=True, check=True,
    )
    for page, item in zip(pages, json.loads(done.stdout)["items"], strict=True):
        for target in LINK.findall(FENCE.sub("", item["Chapter"]["content"])):
            inside = (page.parent / target.partition("#")[0]).resolve().is_relative_to(BOOK)
            file = target.removeprefix(f"{repository}/blob/main/").partition("#")[0]
            if target.startswith(repository):
                if not (ROOT / file).is_file():
                    find(f"{page.relative_to(ROOT)}: the built book links to {target}, which is no file")
            elif not re.match(r"[a-z]+:", target) and not inside:
                find(f"{page.relative_to(ROOT)}: {target} is dead in the built book")


def main() -> None:
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )
    pages = [ROOT / p for p in listed.stdout.splitlines() if (ROOT / p).is_file()]
    for page in pages:
        text = page.read_text(encoding="utf-8")
        check_links(page, text)
        check_includes(page, text)
    summary = BOOK / "SUMMARY.md"
    named = {(BOOK / t).resolve() for t in LINK.findall(summary.read_text(encoding="utf-8"))}
    for page in sorted(set(BOOK.glob("**/*.md")) - named - {summary}):
        find(f"{page.relative_to(ROOT)}: it is not in {summary.relative_to(ROOT)}")
    check_built_links()
    print(f"pages: {len(pages)}, {len(named)} of them the book's")
    for text in findings:
        print(f"error: {text}", file=sys.stderr)
    if findings:
        sys.exit(f"{len(findings)} findings")
    print("book and pages: all well")


if __name__ == "__main__":
    main()
