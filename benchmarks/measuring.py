"""Shared parts of the benchmarks: options, the methods, times, tables in Markdown, fitted exponents and pictures."""

from __future__ import annotations

import argparse
import math
import resource
import subprocess
import tempfile
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure

METHODS = ("ukf_mfac", "ukf_mfac:published", "rbfnn_mfac:published")
PERIODS = 200  # of a run of the task random
FIRST_SEED = 40_000
WIDTH, DOTS_PER_INCH = 7.5, 110
QUICK = {"action": "store_true", "help": "few runs only: test the page, not the speed"}  # an option


def options(description: str | None, **named: Any) -> argparse.Namespace:  # noqa: ANN401 - of any type
    """Return the options of a command, each given by its default, default and help text, or keywords of argparse."""
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    for name, given in named.items():
        default, text = given if isinstance(given, tuple) else (given, None)
        keywords = (
            given
            if isinstance(given, dict)
            else {"default": default, "type": type(default), "help": text}
        )
        parser.add_argument(f"--{name}", **keywords)
    return parser.parse_args()


def asked_to_be_quick(description: str | None) -> bool:
    """Return whether `--quick` was given, the only option."""
    return bool(options(description, quick=QUICK).quick)


def resolved_runs(plant: str, method: str, count: int, duration: float | None = None) -> list[Any]:
    """Return runs with moderate mismatch, and with another duration [s] if one is given."""
    from servobench.harness.config.settings import Settings
    from servobench.harness.run.request import RunRequest
    from servobench.harness.run.resolution import resolve

    settings, mismatch = (
        Settings({"random": {"duration": duration}} if duration else {}),
        cast(Any, "moderate"),
    )
    return [
        resolve(RunRequest(plant, method, "random", mismatch, FIRST_SEED + i), settings)
        for i in range(count)
    ]


def processor_time(call: Callable[[], object], calls: int, rounds: int = 3) -> float:
    """Return the processor time of a call [s]: the best mean of some rounds, after one call that does not count."""
    call()
    times = []
    for _ in range(rounds):
        began = time.process_time()
        for _ in range(calls):
            call()
        times.append((time.process_time() - began) / calls)
    return min(times)


def times_in_turns(
    calls: Mapping[str, Callable[[], object]],
    rounds: int,
    clock: Callable[[], float] = time.process_time,
) -> dict[str, list[float]]:
    """Return the times of each call [s], a number a round: calls take turns, so that a disturbance meets all alike.

    Processor time is that of all threads, also of a renderer's, and leaves other work out.
    """
    times: dict[str, list[float]] = {name: [] for name in calls}
    for _ in range(rounds):
        for name, call in calls.items():
            began = clock()
            call()
            times[name].append(clock() - began)
    return times


def sweep_times(command: Sequence[str], **surroundings: Any) -> tuple[float, float]:  # noqa: ANN401
    """Return the processor time with all processes, and the wall-clock time, of a sweep into a scratch folder [s]."""
    with tempfile.TemporaryDirectory() as scratch:
        before, began = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
        whole = [*command, "--out", f"{scratch}/sweep"]
        subprocess.run(whole, capture_output=True, check=True, **surroundings)
        ended, after = time.perf_counter(), resource.getrusage(resource.RUSAGE_CHILDREN)
    return after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime, ended - began


def seeds(count: int) -> str:
    """Return the range of so many seeds."""
    return f"{FIRST_SEED}:{FIRST_SEED + count}"


def table(header: Sequence[str], rows: Iterable[Sequence[object]]) -> str:
    """Return a table in Markdown."""
    lines = ["| " + " | ".join(map(str, line)) + " |" for line in (header, *rows)]
    lines.insert(1, "|---" * len(header) + "|")
    return "\n".join(lines) + "\n"


def microseconds(seconds: float) -> str:
    """Return a time in µs with three significant digits."""
    value = 1e6 * seconds
    return f"{value:.{max(0, 2 - math.floor(math.log10(value)))}f}"


def exponent(sizes: Sequence[float], costs: Sequence[float]) -> float:
    """Return p of the least-squares fit cost = a sizeᵖ."""
    return float(np.polyfit(np.log(sizes), np.log(costs), 1)[0])


def write_picture(figure: Figure, path: Path) -> None:
    """Write a picture as PNG and print the line that shows it on the page."""
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=DOTS_PER_INCH)
    print(f"![{path.stem.replace('_', ' ')}](pictures/{path.name})\n")
