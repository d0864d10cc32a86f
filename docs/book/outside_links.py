#!/usr/bin/env python3
"""A preprocessor of mdBook: links from the book to other files of the project become links to the repository.

In the sources they are relative, so that every page reads as it is; the built book has no such files beside it. mdBook
runs this in the book's folder (book.toml).
"""

import json
import os
import re
import sys
from pathlib import PurePosixPath

# Where the book's pages are in the project.
SOURCES = PurePosixPath("docs/book/src")
FENCE = re.compile(r"(^```.*?^```)", re.MULTILINE | re.DOTALL)
LINK = re.compile(r"\]\(([^)\s]+)\)")


def outward(content: str, page: str, repository: str) -> str:
    """A page's text; `page` is its path in the sources."""

    def replace(found: re.Match) -> str:
        path, mark, anchor = found[1].partition("#")
        if not path or re.match(r"[a-z]+:", path):
            return found[0]
        place = PurePosixPath(os.path.normpath(SOURCES / PurePosixPath(page).parent / path))
        return found[0] if place.is_relative_to(SOURCES) else f"]({repository}/blob/main/{place}{mark}{anchor})"

    parts = FENCE.split(content)
    return "".join(part if i % 2 else LINK.sub(replace, part) for i, part in enumerate(parts))


def walk(items: list, repository: str) -> None:
    for chapter in (item["Chapter"] for item in items if isinstance(item, dict) and "Chapter" in item):
        if chapter.get("source_path"):
            chapter["content"] = outward(chapter["content"], chapter["source_path"], repository)
        walk(chapter["sub_items"], repository)


def main() -> None:
    if sys.argv[1:2] == ["supports"]:
        sys.exit(0 if sys.argv[2:3] == ["html"] else 1)
    context, book = json.load(sys.stdin)
    walk(book["items"], context["config"]["output"]["html"]["git-repository-url"])
    json.dump(book, sys.stdout)


if __name__ == "__main__":
    main()
