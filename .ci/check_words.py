#!/usr/bin/env python3
"""Checks the words of documents and of Rust docs and strings, by the rules in CONTRIBUTING.md, "Words".

- Banned words, and words for which the glossary (ARCHITECTURE.md) has another.
- Sentences of documents that open with What, Who, Which, Whether or Of.
- First doc lines of public Rust items that open with What, Which, Who, How, Whether, Where, When or Of.
- Sentences of the main pages that are too long. Code, tables and headings do not count.

Documents are Markdown files, and the comments of TOML files, the Makefile and Python programs. Of Rust files, docs and
strings are checked.

Usage: python3 .ci/check_words.py [ROOT]    exit code 1 and one line per finding
"""

import re
import subprocess
import sys
from pathlib import Path

# Files that are not checked, with the reason.
NOT_CHECKED = {
    ".ci/check_words.py": "contains the banned words",
}

# kind: (pattern, suggestion). A space also matches a line break.
BANNED = {
    "is no": (r"(?<!there\s)\b(?:is|are|was|were) no (?!longer\b|more\b|such\b)", "is not a, has no"),
    "alone": (r"(?<!let\s)(?<!stand-)\balone\b", "only"),
    "beside": (r"\bbesides?\b", "next to, in addition to"),
    "whoever": (r"\b(?:whoever|whatever|whomever)\b", "a named subject"),
    "as it is": (r"\bas (?:it is|they are|it stands)(?=[,.;:)\"]|$)", "unchanged"),
    "for ever": (r"\bfor ever\b", "forever, indefinitely"),
    "in turns": (r"\bin turns\b", "alternately"),
    "by heart": (r"\bby heart\b", "memorised"),
    "lies": (r"\b(?:lies?|lay) (?:in|beside|there|together|apart)\b", "is in, is stored in"),
    "stands": (r"\b(?:stands?|stood) (?:beside|above|below|around|there)\b", "is"),
    "goes on": (r"\b(?:go|goes|went|going|gone) on\b", "continues"),
    "says": (r"\b(?:says?|said)\b", "reports, states, contains"),
    "the same": (r"\|\sthe\ssame\b", "a row or cell that names its subject"),
    "tells": (r"\b(?:tells?|told)\b(?!(?: \w+){0,4} apart\b)", "shows, reports"),
}
TERMS = {
    "picture": (r"\bpictures?\b", "image"),
    "data set": (r"\bdata sets?\b", "dataset"),
    "course of events": (r"\bcourses? of events\b", "branch"),
    "unseen": (r"\bunseen\b", "held-out"),
    "telling view": (r"\btelling (?:views?|images?|pictures?)\b", "unambiguous view"),
}
OPENING = r"(?:^|(?<=[.!?] )|(?<=[.!?]\n))(?:What|Who|Which|Whether|Of)\b(?![^.?!]*\?)"
# Longest sentence of the main pages, words.
LONGEST = 30
MAIN_PAGES = re.compile(r"(?:README|ARCHITECTURE)\.md|docs/book/src/.*\.md")
FIRST_LINE = re.compile(r"(?:What|Which|Who|How|Whether|Where|When|Of)\b")

# (file, matched text): reason. An entry that matches nothing is a finding.
ALLOWED: dict[tuple[str, str], str] = {
    ("shared/trials/src/figures.rs", "unseen"): "key of the manifest",
    ("shared/evaluation/src/role.rs", "unseen"): "key of `results.json`",
}

FENCE = re.compile(r"^```.*?^```|<!--.*?-->", re.MULTILINE | re.DOTALL)
INLINE = re.compile(r"`[^`\n]*(?:\n[^`\n]*)?`|\]\([^)]*\)|https?://\S+")
HEADING = re.compile(r"^#.*$", re.MULTILINE)
TABLE_ROW = re.compile(r"^\s*\|.*$", re.MULTILINE)
# The end of a sentence, or of the paragraph or list item that it is in.
SENTENCE_END = re.compile(r"[.!?][)*_\"]*(?=\s|$)|\n[ \t]*(?=\n)|\n(?=\s*(?:[-*]|\d+\.)\s)")
TOKEN = re.compile(
    r"""(?P<doc>//[/!](?!/)[^\n]*)|(?P<comment>//[^\n]*)|/\*.*?\*/|(?P<raw>r(?P<hash>\#*)".*?"(?P=hash))"""
    r"""|(?P<text>"(?:[^"\\]|\\.)*")|'(?:\\.[^']*|[^'\\])'""",
    re.DOTALL,
)
GAP = "\x00"

PATTERNS = {
    kind: (re.compile(pattern.replace(" ", r"[ \n]+"), re.IGNORECASE | re.MULTILINE), advice)
    for kind, (pattern, advice) in {**BANNED, **TERMS}.items()
}


def blank(found: re.Match, filler: str = " ") -> str:
    """Replaces all but the line breaks of a match."""
    return re.sub(r"[^\n]", filler, found[0])


def prose_of_markdown(text: str) -> str:
    text = FENCE.sub(lambda m: blank(m, GAP), text)
    return INLINE.sub(lambda m: re.sub(r"[^\n]", GAP, m[0]), text)


def prose_of_comments(text: str) -> str:
    """Returns the comments of a TOML file or a Makefile, and the reasons of deny.toml."""
    lines = []
    for line in text.splitlines():
        found = re.match(r"\s*#(?!:schema)(.*)", line) or re.match(r".*?(?: ## ?|\s# )(.*)", line)
        reason = re.search(r'reason = "(.*)"', line)
        lines.append((found or reason)[1] if found or reason else GAP)
    return INLINE.sub(lambda m: blank(m, GAP), "\n".join(lines))


def prose_of_python(text: str) -> str:
    """Returns comments and docstrings; everything else is blank."""
    keep = re.compile(r'(?P<doc>""".*?""")|(?P<text>"(?:[^"\\\n]|\\.)*")|(?P<comment>#[^\n]*)', re.DOTALL)
    parts, end = [], 0
    for token in keep.finditer(text):
        parts.append(re.sub(r"[^\n]", GAP, text[end:token.start()]))
        end = token.end()
        parts.append(blank(token, GAP) if token["text"] else re.sub(r'"""|#', GAP, token[0]))
    prose = "".join(parts) + re.sub(r"[^\n]", GAP, text[end:])
    return INLINE.sub(lambda m: blank(m, GAP), prose)


def prose_of_rust(text: str) -> str:
    """Returns docs, comments, and strings of three words or more; everything else is blank."""
    parts, end = [], 0
    for token in TOKEN.finditer(text):
        parts.append(re.sub(r"[^\n]", GAP, text[end:token.start()]))
        end = token.end()
        if token["doc"]:
            parts.append("   " + token["doc"][3:])
        elif token["comment"]:
            parts.append("  " + GAP + token["comment"][3:])
        elif (token["text"] or token["raw"]) and len(re.findall(r"[A-Za-z]+ ", token[0])) >= 2:
            parts.append(re.sub(r"\\\n", " \n", token[0]).replace('"', GAP, 1))
        else:
            parts.append(blank(token, GAP))
    prose = "".join(parts) + re.sub(r"[^\n]", GAP, text[end:])
    # A doc comment continues in the next line after its indentation.
    prose = re.sub(rf"\n{GAP}*(?=   )", lambda m: "\n" + " " * (len(m[0]) - 1), prose)
    return INLINE.sub(lambda m: blank(m, GAP), prose)


def first_lines(text: str) -> list[tuple[int, str]]:
    """Returns number and text of the first doc line of each item, field and variant."""
    lines, found, number = text.splitlines(), [], 0
    while number < len(lines):
        if not re.match(r"\s*///(?!/)", lines[number]):
            number += 1
            continue
        first = number
        while number < len(lines) and re.match(r"\s*(?:///|#\[|#!\[)", lines[number]):
            number += 1
        found.append((first + 1, re.sub(r"^\s*/// ?", "", lines[first])))
    return found


def long_sentences(prose: str) -> list[tuple[int, int, str]]:
    """Returns line, number of words and first words of each sentence of a page that is too long."""
    prose, found, start = TABLE_ROW.sub(blank, HEADING.sub(blank, prose)), [], 0
    for end in [*(m.end() for m in SENTENCE_END.finditer(prose)), len(prose)]:
        sentence = prose[start:end]
        words = [word for word in sentence.replace(GAP, " ").split() if re.search(r"\w", word)]
        if len(words) > LONGEST:
            line = prose.count("\n", 0, start + len(sentence) - len(sentence.lstrip())) + 1
            found.append((line, len(words), " ".join(words[:6])))
        start = end
    return found


def findings_of(path: str, text: str) -> list[tuple[int, str, str, str]]:
    """Returns line, kind, matched text and advice of each finding of a file."""
    if path.endswith(".rs"):
        prose = prose_of_rust(text)
    elif path.endswith(".md"):
        prose = prose_of_markdown(text)
    elif path.endswith(".py"):
        prose = prose_of_python(text)
    else:
        prose = prose_of_comments(text)
    found = []
    for kind, (pattern, advice) in PATTERNS.items():
        for match in pattern.finditer(prose):
            found.append((prose.count("\n", 0, match.start()) + 1, kind, re.sub(r"\s+", " ", match[0]).strip(), advice))
    if path.endswith(".rs"):
        for number, line in first_lines(text):
            if FIRST_LINE.match(line):
                found.append((number, "first line", line[:40], "what the item is or does, in the third person"))
    else:
        for match in re.finditer(OPENING, HEADING.sub(blank, prose) if path.endswith(".md") else prose, re.MULTILINE):
            found.append((prose.count("\n", 0, match.start()) + 1, "opening", match[0], "a subject that is named"))
    if MAIN_PAGES.fullmatch(path):
        for number, words, first in long_sentences(prose):
            found.append((number, "long sentence", first, f"at most {LONGEST} words, not {words}, in a sentence"))
    return sorted(found)


def main() -> None:
    root = Path(sys.argv[1]) if len(sys.argv) > 1 else Path(__file__).resolve().parent.parent
    listed = subprocess.run(
        ["git", "ls-files", "--cached", "--others", "--exclude-standard", "*.md", "*.rs", "*.toml", "*.py", "Makefile"],
        cwd=root, capture_output=True, text=True, check=True,
    )
    files = sorted(p for p in set(listed.stdout.splitlines()) if (root / p).is_file() and p not in NOT_CHECKED)
    found, unused = [], set(ALLOWED)
    for path in files:
        for number, kind, text, advice in findings_of(path, (root / path).read_text(encoding="utf-8")):
            key = (path, text.lower())
            unused.discard(key)
            if key not in ALLOWED:
                found.append(f"{path}:{number}: {kind}: `{text}`; write: {advice}")
    found += [f".ci/check_words.py: the allowed `{text}` of {path} does not occur" for path, text in sorted(unused)]
    print(f"words: {len(files)} files")
    for text in found:
        print(f"error: {text}", file=sys.stderr)
    if found:
        sys.exit(f"{len(found)} findings")
    print("words: passed")


if __name__ == "__main__":
    main()
