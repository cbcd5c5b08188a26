"""Robots on which nothing was tuned: every method best equipped and as published, tuning studies, and one aid less."""

from __future__ import annotations

import json
import tomllib
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any, Final

import pandas as pd

from page_studies import cells, study
from page_studies.cells import CHANGED, CIRCLES, MOVES, Cell, quoted, rows_by_method, where
from page_studies.study import (
    BETTER,
    BOTH,
    CALIBRATES,
    ENGINES,
    FIVE,
    PUBLISHED,
    RENDERED,
    SUFFIX,
    Study,
    Words,
    settings,
    sweep,
)
from servobench.controllers.aids import SWITCHES, AidsConfig
from servobench.harness.analysis.comparison import MISSING
from servobench.harness.batch.results import load_runs
from servobench.harness.config.registry import find_controller
from servobench.harness.config.settings import default_config, flatten, tuned_file

PAIRS: Final = [(BETTER, name) for name in BOTH if name != BETTER] + [
    (name.removesuffix(SUFFIX), name) for name in PUBLISHED
]
"""The better method with each other one, and each method best equipped with itself as published."""
# A file of tuned values has three
TITLES: Final = tuple(f"tuning study {k + 1}: settling time, s" for k in range(3))
USUAL: Final = "all"
LESS: Final[Mapping[str, Any]] = {aid: getattr(AidsConfig(), aid) for aid in SWITCHES}
"""The value of each aid that leaves it out."""


METHOD_CELLS: Final[Mapping[str, Cell]] = {
    "division": lambda runs: (
        "as published" if runs["controller"].iloc[0].endswith(SUFFIX) else "best equipped"
    ),
    "settled, %": where("task", "random", cells.share),
    "settling time, s": where("task", "random", cells.settling),
    "overshoot, %": where("task", "random", cells.overshoot),
    "worst 5 % of final errors, mm": where("task", "random", cells.worst_errors),
    "circle, RMS of the second lap, mm": where("task", "circle", cells.millimetres),
}
HEADLINE_CELLS: Final[Mapping[str, Cell]] = {
    "settled, %": METHOD_CELLS["settled, %"],
    "settling, s": METHOD_CELLS["settling time, s"],
    "circle, mm": METHOD_CELLS["circle, RMS of the second lap, mm"],
}


def method_rows(runs: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield a row for each method from its moves and circles."""
    for row in rows_by_method(runs, METHOD_CELLS):
        yield row | {"method": row["method"].replace(SUFFIX, "")}


def headline_rows(runs: pd.DataFrame) -> Iterator[dict[str, str]]:
    """Yield a row for the better methods and each of the paper's, both divisions beside each other."""
    for name in (CALIBRATES, *FIVE):
        row = {"method": quoted(name)}
        for full, words in ((name, ""), (name + SUFFIX, "as published: ")):
            own = runs[runs["controller"] == full]
            row |= {
                words + title: cell(own) if len(own) else MISSING
                for title, cell in HEADLINE_CELLS.items()
            }
        yield row


def tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the headline, all methods, and their paired differences."""
    both = pd.concat([load_runs(folder / part) for part in HELD_OUT.commands], ignore_index=True)
    pairs = {
        "pair": map(minus, PAIRS),
        "settling time, s": MOVES.differences(both, PAIRS),
        "circle, mm": CIRCLES.differences(both, PAIRS),
    }
    return {
        "headline": pd.DataFrame(headline_rows(both)),
        "held_out": pd.DataFrame(method_rows(both)),
        "held_out_pairs": pd.DataFrame(pairs),
    }


def minus(pair: tuple[str, str]) -> str:
    """Return a pair of methods as a page shows their difference."""
    return f"{quoted(pair[0])} − {quoted(pair[1])}"


def rendered_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return all methods on rendered images, and the better one against each other, on both engines."""
    runs = {engine: load_runs(folder / engine) for engine in ENGINES}
    rows = zip(*(method_rows(runs[engine]) for engine in ENGINES), strict=True)
    beside = [
        {"method": row.pop("method"), "division": row.pop("division"), "plant": engine} | row
        for both in rows
        for engine, row in zip(ENGINES, both, strict=True)
    ]
    pairs = [pair for pair in PAIRS if set(pair) <= set(RENDERED)]
    differences = [
        {"pair": minus(pair)}
        | {f"settling time on `{engine}`, s": cell for engine, cell in move.items()}
        | {f"circle on `{engine}`, mm": cell for engine, cell in circle.items()}
        for pair, move, circle in zip(
            pairs, *(each.on_engines(runs, pairs) for each in (MOVES, CIRCLES)), strict=True
        )
    ]
    return {
        "held_out_rendered": pd.DataFrame(beside),
        "held_out_engines": pd.DataFrame(differences),
    }


def study_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the median settling time of each method with the values of each of its tuning studies."""
    parts = [
        load_runs(folder / part) for part in TUNING_STUDIES.commands if (folder / part).exists()
    ]
    rows = []
    for name in BOTH:
        own = [part[part["controller"] == name] for part in parts]
        if any(len(each) for each in own):
            rows.append(
                {"method": quoted(name)} | dict(zip(TITLES, map(cells.settling, own), strict=False))
            )
    return {"held_out_studies": pd.DataFrame(rows, columns=["method", *TITLES])}


def with_values_of_study(k: int) -> Callable[[Path], Words]:
    """Return what makes the sweep of all methods that have this many tuning studies, with the values of one."""

    def command(_folder: Path) -> Words:
        values = {}
        for name in BOTH:
            file = tuned_file(name)
            studies = (
                tomllib.loads(file.read_text(encoding="utf-8")).get("studies", [])
                if file.is_file()
                else []
            )
            if len(studies) > k:
                values[name] = studies[k]["settings"]
        changes = settings(f"{key}={json.dumps(value)}" for key, value in flatten(values).items())
        return sweep("fmu", values, "random", "40000:40200", *changes) if values else ()

    return command


def without(aid: str | None) -> Words:
    """Return the sweep of all methods that have an aid, without it; of all methods as they are for None."""
    names = [
        name
        for name in FIVE
        if aid is None or getattr(default_config(find_controller(name)).aids, aid) != LESS[aid]
    ]
    less = [f"{name}.aids.{aid}={str(LESS[aid]).lower()}" for name in names if aid]
    return sweep("fmu", names, "random,circle", "48000:48100", "--latency", "0.05", *settings(less))


def aids_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the paired difference that leaving out each aid makes to each method, in moves and on the circle."""
    usual = load_runs(folder / USUAL)
    rows: dict[str, list[dict[str, str]]] = {"aids": [], "aids_circle": []}
    for aid in LESS:
        both = cells.changed_and_usual(load_runs(folder / aid), usual)
        names = [name for name in FIVE if name + CHANGED in set(both["controller"])]
        for table, measure in zip(rows.values(), (MOVES, CIRCLES), strict=True):
            found = measure.differences(both, [(name + CHANGED, name) for name in names])
            row = dict.fromkeys(FIVE, "not in use") | dict(zip(names, found, strict=True))
            table.append(
                {"left out": quoted(aid)} | {quoted(name): cell for name, cell in row.items()}
            )
    return {name: pd.DataFrame(own) for name, own in rows.items()}


HELD_OUT = Study(
    "held_out",
    "1,000 held-out robots, every method best equipped and as published",
    10,
    {
        "moves": sweep("fmu", BOTH, "random", "40000:41000"),
        "circles": sweep("fmu", BOTH, "circle", "41000:41100"),
    },
    tables,
)
RENDERED_STUDY = Study(
    "rendered",
    "36 held-out robots on rendered images, on both physics engines",
    30,
    study.on_engines(lambda plant: sweep(plant, RENDERED, "random,circle", "42004:42040")),
    rendered_tables,
)
TUNING_STUDIES = Study(
    "tuning",
    "200 held-out robots with the values of each of the three tuning studies",
    2,
    {f"study_{k + 1}": with_values_of_study(k) for k in range(len(TITLES))},
    study_tables,
)
AIDS = Study(
    "aids",
    "what each aid carries: best equipped methods with one aid less, 100 robots with a camera 50 ms late",
    6,
    {USUAL: without(None)} | {aid: without(aid) for aid in LESS},
    aids_tables,
)
