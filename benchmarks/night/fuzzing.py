"""Inputs for parsers, valid ones that were changed a little or much, and the promise that each parser has to keep.

A long campaign over every parser, with `tests` and `benchmarks` on the path:

    python -m night.fuzzing --inputs 1000000

prints for each parser how many inputs it took and refused, how long the longest took, and each broken promise; the exit
code is then 1. Batches have seeds of their own: `--first` goes on where another campaign ended.
"""

from __future__ import annotations

import contextlib
import os
import random
import resource
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path
from types import FrameType

import numpy as np

from measuring import options
from night.parsers import PARSERS, Parser
from servobench.plant.contract.faults import ConfigurationError

MAX_SECONDS = 5.0  # [s] of the processor that a parser may take
MAX_BYTES = 500_000_000  # [bytes] that a parser may ask for
MAX_ECHO = 2_000  # [characters] of a message beside what it repeats of the input
LENGTHS = (0, 1, 1, 1, 2, 3, 5, 8, 40)
PAGE = resource.getpagesize()
BATCH = 2_000  # [inputs] of one seed, and of one folder


class Broken(AssertionError):
    """A parser did not keep its promise."""


def drawn(parser: Parser, source: random.Random) -> str | bytes:
    """Return a changed example, or an input that has nothing to do with them."""
    raw = isinstance(parser.examples[0], bytes)
    words = [word.encode("latin-1") if raw else word for word in parser.words]

    def piece():
        if words and source.random() < 0.5:
            return source.choice(words)
        size = source.randrange(13)
        return source.randbytes(size) if raw else "".join(_letter(source) for _ in range(size))

    if source.random() < 0.25:
        return (b"" if raw else "").join(piece() for _ in range(source.randrange(7)))
    number, text = source.randint(1, 4), source.choice(parser.examples)
    for _ in range(number):
        text = _change(
            text, source.choice(CHANGES), source.random(), source.choice(LENGTHS), piece()
        )
    return text


def _letter(source: random.Random) -> str:
    """Return a letter of any script, often one of ASCII; no half of a pair, which no file holds."""
    code = source.randrange(0x80) if source.random() < 0.7 else source.randrange(0x110000 - 0x800)
    return chr(code if code < 0xD800 else code + 0x800)


CHANGES = ("insert", "replace", "replace", "delete", "repeat", "cut", "flip", "flip", "move")


def _change(text, change, share, length, piece):
    """Change a text, or bytes, at a share of its length."""
    place = int(share * len(text))
    head, middle, tail = text[:place], text[place : place + length], text[place + length :]
    match change:
        case "insert":
            return head + piece + middle + tail
        case "replace":
            return head + piece + tail
        case "delete":
            return head + tail
        case "repeat":
            return head + middle * 3 + tail
        case "cut":
            return head
        case "move":
            return tail + middle + head
    flipped, rest = text[place : place + 1], text[place + 1 :]
    if isinstance(text, bytes):
        return head + bytes(byte ^ (1 << length % 8) for byte in flipped) + rest
    return head + "".join(chr(ord(each) ^ (1 << length % 7)) for each in flipped) + rest


def check(parser: Parser, given: str | bytes, folder: Path) -> bool:
    """Return whether a parser took an input; raise `Broken` if it did not keep its promise.

    Args:
        parser: what reads.
        given: the input.
        folder: for its files.
    """
    begin = time.process_time()
    try:
        with limited():
            parser.read(given, folder)
    except ValueError as error:
        if type(error) not in (parser.error, ConfigurationError):
            raise Broken(f"{type(error).__name__}: {error}") from error
        text = str(error)
        if not text.strip() or len(text.splitlines()) > 1:
            raise Broken(f"not one line: {text!r}") from error
        if len(text) > MAX_ECHO + 8 * len(given):
            raise Broken(f"a message of {len(text)} characters") from error
        return False
    except BaseException as error:
        if isinstance(error, KeyboardInterrupt):
            raise
        raise Broken(f"{type(error).__name__}: {error}") from error
    finally:
        seconds = time.process_time() - begin
    if seconds > MAX_SECONDS:
        raise Broken(f"took {seconds:.1f} s")
    return True


@contextlib.contextmanager
def limited() -> Iterator[None]:
    """Let what runs within take so much time of the processor and so much more memory, as far as the system can."""

    def stop(_signal: int, _frame: FrameType | None) -> None:
        raise TimeoutError(f"took more than {MAX_SECONDS:g} s")

    soft, hard = resource.getrlimit(resource.RLIMIT_AS)
    statm = Path("/proc/self/statm")
    if statm.exists():
        used = int(statm.read_text().split()[0]) * PAGE
        resource.setrlimit(resource.RLIMIT_AS, (used + MAX_BYTES, hard))
    before = signal.signal(signal.SIGVTALRM, stop)
    signal.setitimer(signal.ITIMER_VIRTUAL, MAX_SECONDS)
    try:
        yield
    finally:
        signal.setitimer(signal.ITIMER_VIRTUAL, 0.0)
        signal.signal(signal.SIGVTALRM, before)
        resource.setrlimit(resource.RLIMIT_AS, (soft, hard))


def main() -> int:
    """Carry the campaign out."""
    inputs, first = (1_000_000, "number of inputs over all parsers"), (0, "seed of the first batch")
    chosen = options(
        __doc__, inputs=inputs, first=first, only=("", "comma-separated names of parsers")
    )
    names = chosen.only.split(",") if chosen.only else list(PARSERS)
    shares = sum(PARSERS[name].share for name in names)
    found, total, begin = 0, 0, time.monotonic()
    with (
        tempfile.TemporaryDirectory(prefix="servobench-fuzz-") as scratch,
        np.errstate(all="ignore"),
    ):
        os.environ["XDG_CACHE_HOME"] = scratch
        for name in names:
            wanted = max(1, round(chosen.inputs * PARSERS[name].share / shares))
            tried = fuzz(name, wanted, chosen.first, Path(scratch))
            total += tried.counts.total()
            found += len(tried.breaks)
            taken, refused = tried.counts[True], tried.counts[False]
            counts = f"{taken} taken, {refused} refused, {len(tried.breaks)} broken"
            line = f"{name}: {counts}, longest {tried.longest:.2f} s"
            print(line, *tried.breaks.values(), sep="\n    ", flush=True)
    largest = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    print(
        f"{total} inputs, {found} broken, {time.monotonic() - begin:.0f} s, at most {largest:.0f} MB in memory"
    )
    return min(found, 1)


@dataclass
class Tried:
    """Counts of the inputs of a parser, and its broken promises."""

    counts: Counter[bool] = field(
        default_factory=Counter
    )  # how many it took (True) and refused (False)
    breaks: dict[str, str] = field(default_factory=dict)  # what broke its promise, each kind once
    longest: float = 0.0  # [s] of the processor


def fuzz(name: str, wanted: int, first: int, scratch: Path) -> Tried:
    """Give a parser inputs and note the outcomes; each batch has a seed and a folder of its own."""
    parser, tried, folder = PARSERS[name], Tried(), scratch / "batch"
    for number in range(wanted):
        if number % BATCH == 0:
            source = random.Random(f"{name} {first + number // BATCH}")
            shutil.rmtree(folder, ignore_errors=True)
            folder.mkdir()
        value = drawn(parser, source)
        begin = time.process_time()
        try:
            tried.counts[check(parser, value, folder)] += 1
        except Broken as error:
            tried.counts[False] += 1
            kind = "".join(each for each in str(error)[:60] if not each.isdigit())
            tried.breaks.setdefault(kind, f"{error}  <-  {value!r}"[:2000])
        tried.longest = max(tried.longest, time.process_time() - begin)
    return tried


if __name__ == "__main__":
    sys.exit(main())
