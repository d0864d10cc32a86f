#!/usr/bin/env python3
"""mdBook preprocessor: replaces links that leave the book, because the built book does not contain their targets.

A link to another file of the project becomes its text and the file's path. An image becomes part of the page.
mdBook runs this program in the book's folder (book.toml).
"""

import base64
import json
import os
import re
import sys
from pathlib import Path, PurePosixPath

ROOT = Path(__file__).resolve().parent.parent.parent
# The book's pages, relative to the project's root.
SOURCES = PurePosixPath("docs/book/src")
FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"(!?)\[([^\]]*)\]\(([^)\s]+)\)")
MEDIA = {".png": "image/png", ".svg": "image/svg+xml"}


def inward(content: str, page: str) -> str:
    """Returns the page without links that leave the book; `page` is its path below the sources."""

    def replace(found: re.Match) -> str:
        image, text, target = found.groups()
        path = target.partition("#")[0]
        if not path or re.match(r"[a-z]+:", path):
            return found[0]
        file = PurePosixPath(os.path.normpath(SOURCES / PurePosixPath(page).parent / path))
        if file.is_relative_to(SOURCES):
            return found[0]
        if image:
            data = base64.b64encode((ROOT / file).read_bytes()).decode()
            return f"![{text}](data:{MEDIA[file.suffix]};base64,{data})"
        return f"`{file}`" if text == str(file) else f"{text} (`{file}`)"

    parts = FENCE.split(content)
    return "".join(part if i % 2 else LINK.sub(replace, part) for i, part in enumerate(parts))


def walk(items: list) -> None:
    for chapter in (item["Chapter"] for item in items if isinstance(item, dict) and "Chapter" in item):
        if chapter.get("source_path"):
            chapter["content"] = inward(chapter["content"], chapter["source_path"])
        walk(chapter["sub_items"])


def main() -> None:
    if sys.argv[1:2] == ["supports"]:
        sys.exit(0 if sys.argv[2:3] == ["html"] else 1)
    _context, book = json.load(sys.stdin)
    walk(book["items"])
    json.dump(book, sys.stdout)


if __name__ == "__main__":
    main()
