"""Reads the project's pages for tests: links, headings, tables and blocks of code."""

import ast
import importlib
import re
from pathlib import Path

ROOT = Path(__file__).parents[2]
DOCS = sorted((ROOT / "docs").glob("*.md"))
PAGES = [
    *(
        ROOT / name
        for name in (
            "README.md",
            "CONTRIBUTING.md",
            "fmus/README.md",
            "fmus/ur5_mismatched/readme.md",
        )
    ),
    *DOCS,
]
FENCED = re.compile(r"^```([\w{}]*)[^`\n]*\n(.*?)^```$", re.MULTILINE | re.DOTALL)
PLACE = re.compile(r"`([\w/]+\.py):([\w.]+)`")


def read(name):
    return (ROOT / "docs" / name).read_text(encoding="utf-8")


def blocks(text, language):
    """The fenced blocks of one language."""
    return [match[2] for match in FENCED.finditer(text) if match[1] == language]


def section(text, heading):
    """What follows a heading, up to the next one of its level or above."""
    level = len(re.search(rf"^(#+) {re.escape(heading)}$", text, re.MULTILINE)[1])
    rest = FENCED.sub(lambda match: match[0].replace("\n#", "\n\0"), text).split(
        f"\n{'#' * level} {heading}\n", 1
    )[1]
    return re.split(rf"^#{{1,{level}}} ", rest, maxsplit=1, flags=re.MULTILINE)[0].replace(
        "\0", "#"
    )


def tables(text):
    """The tables of a text: for each the line before it and its rows below the header, cells as written."""
    found, before, rows = [], "", []
    for line in [*FENCED.sub("", text).splitlines(), ""]:
        if line.startswith("|"):
            rows.append([cell.strip() for cell in re.split(r"(?<!\\)\|", line)[1:-1]])
            continue
        if rows:
            found.append((before, rows[0], rows[2:]))
            rows = []
        before = line or before
    return found


def names(text):
    """The words in backticks of a cell or a page."""
    return re.findall(r"`([^`\n]+)`", FENCED.sub("", text))


def anchors(text):
    """The anchors that GitHub gives to the headings of a page."""
    headings = re.findall(r"^#+ (.*)$", FENCED.sub("", text), re.MULTILINE)
    return {re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-") for heading in headings}


def find(path, name):
    """What `path.py:name` names; for a test its syntax tree, as tests are not imported."""
    assert (ROOT / path).is_file(), path
    if path.startswith("tests/"):
        tree = ast.parse((ROOT / path).read_text(encoding="utf-8"))
        return next(
            node for node in tree.body if isinstance(node, ast.FunctionDef) and node.name == name
        )
    found = importlib.import_module("servobench." + path.removesuffix(".py").replace("/", "."))
    for part in name.split("."):
        found = getattr(found, part)
    return found
