"""Files that a Python file of a user imports from its own folder, found in its text without carrying it out."""

from __future__ import annotations

import ast
from collections.abc import Iterator
from pathlib import Path
from typing import TypeAlias

Name: TypeAlias = tuple[str, ...]  # of a module, by its parts


def neighbours(file: Path, root: Path) -> list[Path]:
    """Return the files below a folder that a file imports, directly or through one of them; not the file itself.

    Args:
        file: the file.
        root: the folder from which its imports start.
    """
    waiting, found = [file], dict[Path, None]()
    while waiting:
        for path in _imported(waiting.pop(), root):
            if path not in found and path != file:
                found[path] = None
                waiting.append(path)
    return sorted(found)


def _imported(file: Path, root: Path) -> Iterator[Path]:
    """Yield the files below a folder that a file imports itself; nothing of one that cannot be read."""
    try:
        tree = ast.parse(file.read_text(encoding="utf-8"))
    except (OSError, SyntaxError, ValueError):
        return
    package = file.parent.relative_to(root).parts
    for node in ast.walk(tree):
        for name in _names(node, package):
            yield from _files(root, name)


def _names(node: ast.AST, package: Name) -> Iterator[Name]:
    """Yield the names that a statement imports, those of modules and of what may be one."""
    match node:
        case ast.Import(names=names):
            yield from (tuple(each.name.split(".")) for each in names)
        case ast.ImportFrom(module=module, names=names, level=level):
            begin = package[: len(package) + 1 - level] if level else ()
            name = (*begin, *module.split(".")) if module else begin
            yield from ((*name, each.name) for each in names)


def _files(root: Path, name: Name) -> Iterator[Path]:
    """Yield the files that an import of a name carries out: those of its packages and its own."""
    for length in range(1, len(name) + 1):
        place = root.joinpath(*name[:length])
        for path in (place / "__init__.py", place.with_name(f"{place.name}.py")):
            if path.is_file():
                yield path
                break
