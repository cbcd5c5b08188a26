"""A long campaign of fuzzing over every parser: python tests/fuzz/campaign.py --inputs 1000000.

It prints for each parser how many inputs it took and refused, and what broke the promise of tests/kit/fuzzing.py; the
exit code is 1 if something did. Batches have seeds of their own: `--first` goes on where another campaign ended.
"""

from __future__ import annotations

import argparse
import os
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

import numpy as np
from hypothesis import HealthCheck, Phase, given, seed, settings

sys.path.insert(0, str(Path(__file__).parents[1]))

from kit.fuzzing import Broken, check, inputs
from kit.parsers import PARSERS, Parser

BATCH = 2_000  # [inputs] of one call of hypothesis, whose memory of what it tried grows with them


def main() -> int:
    """Carry the campaign out."""
    options = argparse.ArgumentParser(description=__doc__)
    options.add_argument("--inputs", type=int, default=1_000_000, help="number of inputs over all parsers")
    options.add_argument("--first", type=int, default=0, help="seed of the first batch")
    options.add_argument("--only", default="", help="comma-separated names of parsers")
    chosen = options.parse_args()
    names = chosen.only.split(",") if chosen.only else list(PARSERS)
    shares = sum(PARSERS[name].share for name in names)
    found, total, begin = 0, 0, time.monotonic()
    with tempfile.TemporaryDirectory(prefix="servobench-fuzz-") as scratch, np.errstate(all="ignore"):
        os.environ["XDG_CACHE_HOME"] = scratch
        for name in names:
            wanted = max(1, round(chosen.inputs * PARSERS[name].share / shares))
            counts, breaks = fuzz(name, wanted, chosen.first, Path(scratch))
            total += counts.total()
            found += len(breaks)
            say(f"{name}: {counts.total()} inputs, {counts[True]} taken, {counts[False]} refused, {len(breaks)} broken")
            for text in breaks:
                say(f"    {text}")
    say(f"{total} inputs, {found} broken, {time.monotonic() - begin:.0f} s")
    return min(found, 1)


def fuzz(name: str, wanted: int, first: int, scratch: Path) -> tuple[Counter[bool], list[str]]:
    """Return how many inputs a parser took (True) and refused (False), and what broke its promise, each kind once."""
    counts, breaks, batch = Counter[bool](), dict[str, str](), first
    while counts.total() < wanted:
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            run_batch(PARSERS[name], min(BATCH, wanted - counts.total()), batch, Path(folder), counts, breaks)
        batch += 1
    return counts, list(breaks.values())


def run_batch(
    parser: Parser, size: int, number: int, folder: Path, counts: Counter[bool], breaks: dict[str, str]
) -> None:
    """Give a parser `size` inputs and note what it made of them."""

    @seed(number)
    @settings(
        max_examples=size,
        deadline=None,
        database=None,
        phases=[Phase.generate],
        suppress_health_check=list(HealthCheck),
    )
    @given(inputs(parser))
    def once(value: str | bytes) -> None:
        try:
            counts[check(parser, value, folder)] += 1
        except Broken as error:
            counts[False] += 1
            kind = "".join(each for each in str(error)[:60] if not each.isdigit())
            breaks.setdefault(kind, f"{error}  <-  {value!r}"[:2000])

    once()


def say(text: str) -> None:
    """Write a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
