"""The result of a run: its rows, and how it ended: a status, a reason in one line and, for a failure, a short trace.

The place of an error is the deepest line of the user's own code: of a script, of a notebook or of a plug-in, but not of
this package, of the standard library or of another installed one. An error without such a line has the place in this
package. A `RunFault` is no defect and has a place only if a plug-in raised it.
"""

from __future__ import annotations

import ctypes
import inspect
import mmap
import traceback
from collections.abc import Callable
from dataclasses import dataclass, field
from multiprocessing import parent_process
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

from servobench.harness.config.source import PACKAGE_FOLDER, is_users
from servobench.harness.run.variations import Row
from servobench.plant.contract.faults import ConfigurationError, RunFault, one_line
from servobench.plant.contract.files import harmless

if TYPE_CHECKING:
    import pandas as pd

    from servobench.plant.bench.plant import ImageArray

COMPLETED = "completed"
NUMERICAL_ERROR = "numerical_error"
CRASHED = "crashed"
TIMED_OUT = "timed_out"  # given by the driver of a batch, which has the limits
OUT_OF_MEMORY = "out_of_memory"
NETWORKS = "networks"  # folder of trained networks, of the cache and of results
LOST = "the run killed the process that carried it out"

# [s] The last control instant of the run that this process carries out, shared with the process above; -inf before it.
INSTANT = ctypes.c_double.from_buffer(mmap.mmap(-1, 8))

TRACE_FRAMES = 12  # the deepest ones of a trace, which shows no more
HARNESS = str(PACKAGE_FOLDER / "harness")


class WrongAnswer(TypeError):
    """A method of a controller or a plant returned something else than its contract says, or cannot be called by it."""

    def __init__(self, text: str, method: Callable[..., Any]) -> None:
        """Take the message and the method that gave the wrong answer."""
        super().__init__(text)
        self.method = method


@dataclass(frozen=True)
class Ending:
    """How a run ended."""

    status: str = COMPLETED
    reason: str = ""  # one line with the place; empty for a run that completed
    trace: str = ""  # lines; empty where there is no defect

    @classmethod
    def of(cls, error: BaseException) -> Ending:
        """Return how a run ended that an error ended."""
        error = _behind(error)
        place = _place(error)
        where = f" ({place})" if place else ""
        if isinstance(error, RunFault):
            status, reason = error.status, _one_line(error)
        elif isinstance(error, FloatingPointError):
            status, reason = NUMERICAL_ERROR, _one_line(error)
        else:
            status = OUT_OF_MEMORY if isinstance(error, MemoryError) else CRASHED
            reason = f"{type(error).__name__}: {_one_line(error)}".removesuffix(": ")
            reason = "; ".join((reason, *getattr(error, "__notes__", ())))
        return cls(status, f"{reason}{where}", _trace(error) if place else "")


@dataclass(frozen=True)
class RunResult:
    """The result of a run.

    Attributes:
        row: the run's row in the table of runs.
        steps: one row a period; None if not asked for.
        picture: the last picture of the camera; None without a camera or if not asked for.
        trace: of the error that ended the run, for the log of failures; empty without one.
    """

    row: dict[str, Any]
    steps: pd.DataFrame | None
    picture: ImageArray | None = field(default=None, repr=False)
    trace: str = ""

    @classmethod
    def failed(cls, identity: Row, ending: Ending) -> RunResult:
        """Return the result of a run of which only the columns of its request and its ending are known."""
        known = {
            "status": ending.status,
            "outcome": ending.status,
            "periods": 0,
            "reason": ending.reason,
        }
        return cls({**identity, **known, "mismatch_values": "{}"}, None, trace=ending.trace)


def ends_batch(error: BaseException) -> bool:
    """Return whether an error is Ctrl-C; no Ctrl-C reaches a worker process, where code of users raised it itself."""
    return isinstance(error, KeyboardInterrupt) and parent_process() is None


def log_entry(row: Row, trace: str) -> str:
    """Return the entry of a run in the log of failures; empty for one that completed.

    Args:
        row: its row in the table of runs.
        trace: of its `Ending`.
    """
    if row.get("status", COMPLETED) == COMPLETED:
        return ""
    head = f"{row['run_id']}: {row['status']}: {row.get('reason', '')}"
    lines = [harmless(head), *(f"    {harmless(line)}" for line in trace.splitlines()), "", ""]
    return "\n".join(lines)


class Place(NamedTuple):
    """A line of code."""

    file: str
    line: int
    function: str

    def __str__(self) -> str:
        """Return it as reasons have it."""
        return f"{Path(self.file).name}:{self.line} in {self.function}"


def _behind(error: BaseException) -> BaseException:
    """Return the error in code of users of which a line for the command line was made, or the error itself."""
    behind = error
    while isinstance(behind, ConfigurationError) and behind.__cause__ is not None:
        behind = behind.__cause__
    files = (frame.f_code.co_filename for frame, _ in traceback.walk_tb(behind.__traceback__))
    if any(map(is_users, files)):
        return behind
    return error


def _place(error: BaseException) -> Place | None:
    """Return the place of the defect; None for a fault that this package raised."""
    if isinstance(error, WrongAnswer):
        return beginning(error.method)
    frames = list(traceback.walk_tb(error.__traceback__))
    own = [(frame, line) for frame, line in frames if is_users(frame.f_code.co_filename)]
    if not own and not isinstance(error, RunFault):
        own = [
            (frame, line)
            for frame, line in frames
            if Path(frame.f_code.co_filename).is_relative_to(PACKAGE_FOLDER)
            and frame.f_globals.get("__name__") != ConfigurationError.__module__
        ]
    if not own:
        return None
    frame, line = own[-1]
    code = frame.f_code
    function = code.co_name if "<locals>" in code.co_qualname else code.co_qualname
    return Place(code.co_filename, line, function)


def beginning(method: Callable[..., Any]) -> Place | None:
    """Return where a method is defined; None for one without source."""
    function = inspect.unwrap(getattr(method, "__func__", method))
    code = getattr(function, "__code__", None)
    if code:
        return Place(code.co_filename, code.co_firstlineno, code.co_qualname)
    return None


def _trace(error: BaseException) -> str:
    """Return a trace from the first line that is not the harness's, and those of the errors behind it."""
    whole = shown = traceback.TracebackException.from_exception(error, compact=True)
    if isinstance(error, WrongAnswer) and (place := beginning(error.method)):
        whole.stack = traceback.StackSummary.from_list([traceback.FrameSummary(*place)])
        return "".join(whole.format())
    seen = set()
    while shown is not None and id(shown) not in seen:
        seen.add(id(shown))
        inner = next(
            (i for i, frame in enumerate(shown.stack) if not frame.filename.startswith(HARNESS)), 0
        )
        shown.stack = traceback.StackSummary.from_list(shown.stack[inner:][-TRACE_FRAMES:])
        shown = shown.__cause__ or shown.__context__  # type: ignore[assignment]
    return "".join(whole.format())


def _one_line(error: BaseException) -> str:
    try:
        return one_line(error)
    except BaseException as second:  # noqa: BLE001 - code of users
        return f"its text cannot be had, which raises {type(second).__name__}"
