"""The page of performance, which a script of its own measures and writes."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

from page_studies.study import Study


def page(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the page and its pictures."""
    out = folder / "page"
    for path in (out / "performance.md", *sorted((out / "pictures").glob("*.png"))):
        yield path.relative_to(out).as_posix(), path.read_bytes()


PERFORMANCE = Study("performance", "the page of performance", 20, {"page": ("benchmarks/page.py",)}, files=page)
