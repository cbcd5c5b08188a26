"""Checks in a process of their own: code that kills it, or never answers, loses nothing of what was found before."""

from __future__ import annotations

import contextlib
import faulthandler
import os
import signal
import sys
import tempfile
from collections.abc import Callable, Iterator
from multiprocessing import get_context
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any, Final, TypeAlias

from servobench.harness.check.report import Finding
from servobench.harness.config.settings import ConfigurationError
from servobench.harness.config.source import PACKAGES, place_in_trace

CHECK_LIMIT: Final = 60.0  # [s] of one check
GRACE: Final = 10.0  # [s] more, after which the process is ended from outside
START_LIMIT: Final = 120.0  # [s] until a process has started and imported this package
LOADING: Final = "loading"
TIMED_OUT: Final = "Timeout ("  # begins the trace of a process that ended itself
ENGINE: Final = Path(__file__).parents[2]  # whose own lines are not the place of a defect

Checks: TypeAlias = Callable[..., Any]


def check_guarded(checks: Checks, subject: str, limit: float = CHECK_LIMIT) -> Iterator[Finding]:
    """Carry checks out in another process and yield what each finds.

    Args:
        checks: `check_controller` or `check_plant`.
        subject: what is checked, as text.
        limit: [s] time limit of one check.

    Raises:
        ConfigurationError: the subject cannot be loaded.
    """
    with tempfile.TemporaryDirectory(prefix="servobench-check-") as folder:
        trace = Path(folder) / "trace"
        context = get_context("spawn")
        ours, theirs = context.Pipe(duplex=False)
        process = context.Process(target=_check, args=(theirs, checks, subject, limit, trace), daemon=True)
        process.start()
        theirs.close()
        current, patience = LOADING, START_LIMIT
        try:
            while ours.poll(patience):
                patience = limit + GRACE
                kind, content = ours.recv()
                if kind == "done":
                    return
                if kind == "refused":
                    raise ConfigurationError(content)
                if kind == "begin":
                    current = content
                else:
                    yield content
        except EOFError:
            process.join(GRACE)
        finally:
            if process.is_alive():
                process.kill()
            process.join()
        yield Finding(current, "failed", _why(process.exitcode, trace, limit))


def _why(code: int | None, trace: Path, limit: float) -> str:
    """Return why a process ended in the middle of a check, with the place in the code of the user."""
    text = trace.read_text(errors="replace") if trace.exists() else ""
    place = place_in_trace(text, _is_users)
    if text.startswith(TIMED_OUT):
        return f"{place}no answer after {limit:g} s; is there a loop without an end, or something that waits?"
    if code is not None and code < 0:
        name = signal.Signals(-code).name
        return f"{place}it killed the process by {name}; compiled code wrote or read outside of its memory"
    return f"{place}it ended the process with exit code {code}; raise an error instead, so that the other runs go on"


def _is_users(path: Path) -> bool:
    inside = any(path.is_relative_to(folder) for folder in (Path(os.__file__).parent, ENGINE))
    return not (inside or PACKAGES in path.parts or str(path).startswith("<"))


def _check(connection: Connection, checks: Checks, subject: str, limit: float, trace: Path) -> None:
    """Carry the checks out; what is printed on the way goes nowhere."""
    sys.stdout.flush()
    nowhere = os.open(os.devnull, os.O_WRONLY)
    os.dup2(nowhere, 1)
    with trace.open("w") as file:
        faulthandler.enable(file)

        def begin(name: str) -> None:
            faulthandler.dump_traceback_later(limit, exit=True, file=file)
            connection.send(("begin", name))

        begin(LOADING)
        try:
            checks(subject, begin, lambda finding: connection.send(("found", finding)))
            connection.send(("done", None))
        except ConfigurationError as error:
            connection.send(("refused", str(error)))
        finally:
            faulthandler.cancel_dump_traceback_later()
            with contextlib.suppress(OSError):
                connection.close()
