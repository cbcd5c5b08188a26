"""A long campaign of fuzzing over every parser: python tests/fuzz/campaign.py --inputs 1000000.

It prints for each parser how many inputs it took and refused, how long the longest took, and what broke the promise of
tests/kit/fuzzing.py; the exit code is 1 if something did. Batches have seeds of their own: `--first` goes on where
another campaign ended.
"""

from __future__ import annotations

import argparse
import os
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[1]))

from kit.fuzzing import Broken, check, drawn
from kit.parsers import PARSERS

BATCH = 2_000  # [inputs] of one seed, and of one folder


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
            tried = fuzz(name, wanted, chosen.first, Path(scratch))
            total += tried.counts.total()
            found += len(tried.breaks)
            taken, refused = tried.counts[True], tried.counts[False]
            say(f"{name}: {taken} taken, {refused} refused, {len(tried.breaks)} broken, longest {tried.longest:.2f} s")
            for text in tried.breaks.values():
                say(f"    {text}")
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    say(f"{total} inputs, {found} broken, {time.monotonic() - begin:.0f} s, at most {largest:.0f} MB in memory")
    return min(found, 1)


@dataclass
class Tried:
    """What came of the inputs of a parser."""

    counts: Counter[bool] = field(default_factory=Counter)  # how many it took (True) and refused (False)
    breaks: dict[str, str] = field(default_factory=dict)  # what broke its promise, each kind once
    longest: float = 0.0  # [s] of the processor


def fuzz(name: str, wanted: int, first: int, scratch: Path) -> Tried:
    """Give a parser inputs, in batches."""
    tried, batch = Tried(), first
    while tried.counts.total() < wanted:
        with tempfile.TemporaryDirectory(dir=scratch) as folder:
            run_batch(name, min(BATCH, wanted - tried.counts.total()), batch, Path(folder), tried)
        batch += 1
    return tried


def run_batch(name: str, size: int, number: int, folder: Path, tried: Tried) -> None:
    """Give a parser `size` inputs and note what it made of them."""
    parser, source = PARSERS[name], random.Random(f"{name} {number}")
    for _ in range(size):
        value = drawn(parser, source)
        begin = time.process_time()
        try:
            tried.counts[check(parser, value, folder)] += 1
        except Broken as error:
            tried.counts[False] += 1
            kind = "".join(each for each in str(error)[:60] if not each.isdigit())
            tried.breaks.setdefault(kind, f"{error}  <-  {value!r}"[:2000])
        tried.longest = max(tried.longest, time.process_time() - begin)


def say(text: str) -> None:
    """Write a line at once."""
    sys.stdout.write(text + "\n")
    sys.stdout.flush()


if __name__ == "__main__":
    sys.exit(main())
