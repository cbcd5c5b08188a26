"""1,000 robots on which nothing was tuned: every method best equipped and as published, and what tuning leaves open."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pandas as pd

from page_studies.methods import (
    BETTER,
    BOTH,
    MOVE,
    PUBLISHED,
    SIX,
    SUFFIX,
    by_method,
    difference,
    division,
    millimetres,
    overshoot,
    paired,
    quoted,
    settling,
    share,
    worst_errors,
)
from page_studies.side_by_side import ENGINES, bare, differences, on_engines
from page_studies.study import Study, Words, sweep
from servobench.harness.analysis.statistics import MISSING
from servobench.harness.batch.results import load_runs
from servobench.harness.config.defaults import tuned_file

LOST: Final = 1.0  # [m] that a circle counts as which was not completed
STUDIES: Final = 3  # that a file of tuned values holds
RENDERED: Final = (*SIX, *(name for name in PUBLISHED if name.removesuffix(SUFFIX) in SIX))


def tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the headline, all methods, and their paired differences."""
    both = pd.concat([load_runs(folder / part) for part in HELD_OUT.commands], ignore_index=True)
    return {
        "headline": pd.DataFrame(headline_rows(both)),
        "held_out": pd.DataFrame(method_rows(both)),
        "held_out_pairs": pd.DataFrame(pair_rows(both)),
    }


def rendered_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the same of all methods on rendered images, and the differences between methods, on both engines."""
    runs = {engine: load_runs(folder / engine) for engine in ENGINES}
    rows = zip(*(method_rows(runs[engine]) for engine in ENGINES), strict=True)
    beside = [
        {"method": row.pop("method"), "division": row.pop("division"), "plant": engine} | row
        for both in rows
        for engine, row in zip(ENGINES, both, strict=True)
    ]
    return {"held_out_rendered": pd.DataFrame(beside), "held_out_engines": pd.DataFrame(engine_rows(runs))}


def engine_rows(runs: Mapping[str, pd.DataFrame]) -> Iterator[dict[str, str]]:
    """Yield the better method against each other one on both engines, what holds on one only in bold."""
    pairs = [pair for pair in method_pairs() if set(pair) <= set(RENDERED)]
    moves, circles = (
        differences(
            {engine: own[own["task"] == task] for engine, own in runs.items()},
            pairs, metric=metric, never=never, digits=digits, factor=factor,
        )
        for task, metric, never, digits, factor in (
            ("random", "settling_time_s", MOVE, 2, 1.0),
            ("circle", "rms_error_evaluated", LOST, 1, 1e3),
        )
    )  # fmt: skip
    for (first, second), move, circle in zip(pairs, moves, circles, strict=True):
        row = {"pair": f"{quoted(first)} − {quoted(second)}"}
        row |= {f"settling time on `{engine}`, s": move[engine] for engine in ENGINES}
        yield row | {f"circle on `{engine}`, mm": circle[engine] for engine in ENGINES}


def studies_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how much the three tuning studies differ."""
    return {"held_out_studies": pd.DataFrame(study_rows(folder), columns=["method", *map(title, range(STUDIES))])}


def method_rows(runs: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield a row for each method from its moves and circles."""
    for name, own in by_method(runs):
        move, circle = (own[own["task"] == task] for task in ("random", "circle"))
        yield {
            "method": quoted(name.removesuffix(SUFFIX)),
            "division": division(name),
            "settled, %": share(move),
            "settling time, s": settling(move),
            "overshoot, %": overshoot(move),
            "worst 5 % of final errors, mm": worst_errors(move),
            "circle, RMS of the second lap, mm": millimetres(circle),
        }


def headline_rows(runs: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield a row for the better method and each of the paper's, both divisions beside each other."""
    for name in SIX:
        row = {"method": quoted(name)}
        for full in (name, name + SUFFIX):
            own = runs[runs["controller"] == full]
            move, circle = (own[own["task"] == task] for task in ("random", "circle"))
            cells = (share(move), settling(move), millimetres(circle)) if len(own) else (MISSING,) * 3
            words = "" if full == name else "as published: "
            row |= dict(zip([f"{words}settled, %", f"{words}settling, s", f"{words}circle, mm"], cells, strict=True))
        yield row


def pair_rows(runs: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield the better method against each other one, and each method best equipped against itself as published."""
    pairs = method_pairs()
    moves, circles = (
        paired(runs[runs["task"] == task], pairs, metric=metric, never=never)
        for task, metric, never in (("random", "settling_time_s", MOVE), ("circle", "rms_error_evaluated", LOST))
    )
    for move, circle in zip(moves, circles, strict=True):
        yield {
            "pair": f"{quoted(move.first)} − {quoted(move.second)}",
            "settling time, s": difference(move),
            "circle, mm": difference(circle, 1, 1e3),
        }


def method_pairs() -> list[tuple[str, str]]:
    """Return the better method with each other one, and each method best equipped with itself as published."""
    pairs = [(BETTER, name) for name in BOTH if name != BETTER]
    return pairs + [(name.removesuffix(SUFFIX), name) for name in PUBLISHED]


def study_rows(folder: Path) -> Iterator[dict[str, str]]:
    """Yield for each method its median settling time with the values of each of its tuning studies."""
    parts = [load_runs(folder / part_of(k)) for k in range(STUDIES) if (folder / part_of(k)).exists()]
    for name in BOTH:
        own = [part[part["controller"] == name] for part in parts]
        if any(len(each) for each in own):
            yield {"method": quoted(name)} | {title(k): settling(each) for k, each in enumerate(own)}


def title(k: int) -> str:
    """Return the heading of a tuning study."""
    return f"tuning study {k + 1}: settling time, s"


def part_of(k: int) -> str:
    """Return the part with the values of a tuning study."""
    return f"study_{k + 1}"


def with_values_of_study(k: int) -> Callable[[Path], Words]:
    """Return what makes the sweep of all methods that have this many tuning studies, with the values of one."""

    def command(_folder: Path) -> Words:
        values = {}
        for name in BOTH:
            file = tuned_file(name)
            studies = tomllib.loads(file.read_text(encoding="utf-8")).get("studies", []) if file.is_file() else []
            if len(studies) > k:
                values[name] = studies[k]["settings"]
        options = [word for name, own in values.items() for each in assignments(name, own) for word in ("--set", each)]
        return sweep("fmu", values, "random", "40000:40200", *options) if values else ()

    return command


def assignments(section: str, values: Mapping[str, Any]) -> Iterator[str]:
    """Yield nested settings as `section.key=value`."""
    for key, value in values.items():
        if isinstance(value, Mapping):
            yield from assignments(f"{section}.{key}", value)
        else:
            yield f"{section}.{key}={json.dumps(value)}"


HELD_OUT = Study(
    "held_out",
    "1,000 held-out robots, every method best equipped and as published",
    10,
    {"moves": sweep("fmu", BOTH, "random", "40000:41000"), "circles": sweep("fmu", BOTH, "circle", "41000:41100")},
    tables,
)
RENDERED_STUDY = Study(
    "rendered",
    "36 held-out robots on rendered images, on both physics engines",
    30,
    on_engines(lambda plant: sweep(plant, RENDERED, "random,circle", "42004:42040", *bare(plant))),
    rendered_tables,
)
TUNING_STUDIES = Study(
    "tuning",
    "200 held-out robots with the values of each of the three tuning studies",
    10,
    {part_of(k): with_values_of_study(k) for k in range(STUDIES)},
    studies_table,
)
