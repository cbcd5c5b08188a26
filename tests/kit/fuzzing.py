"""Inputs for parsers, valid ones that were changed a little or much, and the promise that each parser has to keep."""

from __future__ import annotations

import contextlib
import random
import resource
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from types import FrameType

from hypothesis import strategies as st

from kit.parsers import Parser

MAX_SECONDS = 5.0  # [s] of the processor that a parser may take
MAX_BYTES = 500_000_000  # [bytes] that a parser may ask for
MAX_ECHO = 2_000  # [characters] of a message beside what it repeats of the input
LENGTHS = (0, 1, 1, 1, 2, 3, 5, 8, 40)
PAGE = resource.getpagesize()


class Broken(AssertionError):
    """A parser did not keep its promise."""


def inputs(parser: Parser) -> st.SearchStrategy[str | bytes]:
    """Return changed examples, and inputs that have nothing to do with them."""
    raw = isinstance(parser.examples[0], bytes)
    noise = st.binary(max_size=12) if raw else st.text(max_size=12)
    words = [word.encode("latin-1") if raw else word for word in parser.words]
    pieces = st.one_of(st.sampled_from(words), noise) if words else noise
    change = st.tuples(st.sampled_from(CHANGES), st.floats(0.0, 1.0), st.sampled_from(LENGTHS), pieces)
    changed = st.builds(_change, st.sampled_from(parser.examples), st.lists(change, min_size=1, max_size=4))
    joined = st.lists(pieces, max_size=6).map(b"".join if raw else "".join)
    return st.one_of(changed, changed, changed, joined)


def drawn(parser: Parser, source: random.Random) -> str | bytes:
    """Return an input as `inputs` has them, in a hundredth of the time: hypothesis keeps what it needs to shrink it."""
    raw = isinstance(parser.examples[0], bytes)
    words = [word.encode("latin-1") if raw else word for word in parser.words]

    def piece():
        if words and source.random() < 0.5:
            return source.choice(words)
        size = source.randrange(13)
        return source.randbytes(size) if raw else "".join(_letter(source) for _ in range(size))

    if source.random() < 0.25:
        return (b"" if raw else "").join(piece() for _ in range(source.randrange(7)))
    changes = (
        (source.choice(CHANGES), source.random(), source.choice(LENGTHS), piece()) for _ in range(source.randint(1, 4))
    )
    return _change(source.choice(parser.examples), changes)


def _letter(source: random.Random) -> str:
    """Return a letter of any script, often one of ASCII; no half of a pair, which no file holds."""
    code = source.randrange(0x80) if source.random() < 0.7 else source.randrange(0x110000 - 0x800)
    return chr(code if code < 0xD800 else code + 0x800)


def _insert(text, place, _, piece):
    return text[:place] + piece + text[place:]


def _replace(text, place, length, piece):
    return text[:place] + piece + text[place + length :]


def _delete(text, place, length, _):
    return text[:place] + text[place + length :]


def _repeat(text, place, length, _):
    return text[:place] + text[place : place + length] * 3 + text[place + length :]


def _cut(text, place, *_):
    return text[:place]


def _flip(text, place, length, _):
    if isinstance(text, bytes):
        return text[:place] + bytes([byte ^ (1 << length % 8) for byte in text[place : place + 1]]) + text[place + 1 :]
    return (
        text[:place]
        + "".join(chr(ord(each) ^ (1 << length % 7)) for each in text[place : place + 1])
        + text[place + 1 :]
    )


def _move(text, place, length, _):
    return text[place + length :] + text[place : place + length] + text[:place]


CHANGES = (_insert, _replace, _replace, _delete, _repeat, _cut, _flip, _flip, _move)


def _change(text, changes):
    for change, share, length, piece in changes:
        text = change(text, int(share * len(text)), length, piece)
    return text


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
        if type(error) is not parser.error:
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
