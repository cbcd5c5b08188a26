"""What each aid carries: the best equipped methods with one aid less."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Final

import pandas as pd

from page_studies.held_out import LOST
from page_studies.methods import MOVE, SIX, difference, paired, quoted
from page_studies.study import Study, Words, sweep
from servobench.controllers.aids import SWITCHES, AidsConfig
from servobench.harness.batch.results import load_runs
from servobench.harness.config.defaults import default_config
from servobench.harness.config.registry import find_controller

USUAL: Final = "all"
LESS: Final[Mapping[str, Any]] = {aid: getattr(AidsConfig(), aid) for aid in SWITCHES}
"""The value of each aid that leaves it out."""
METRICS: Final = (
    ("aids", "random", "settling_time_s", MOVE, 1.0, 2),
    ("aids_circle", "circle", "rms_error_evaluated", LOST, 1e3, 1),
)


def has(name: str, aid: str) -> bool:
    """Return whether a method has an aid in the values in use."""
    aids: Any = default_config(find_controller(name))
    return bool(getattr(aids.aids, aid) != LESS[aid])


def without(aid: str | None) -> Words:
    """Return the sweep of all methods that have an aid, without it; of all methods as they are for None."""
    names = [name for name in SIX if aid is None or has(name, aid)]
    options = [word for name in names if aid for word in ("--set", f"{name}.aids.{aid}={str(LESS[aid]).lower()}")]
    return sweep("fmu", names, "random,circle", "48000:48100", "--latency", "0.05", *options)


def tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return the paired difference that leaving out each aid makes to each method, in moves and on the circle."""
    usual = load_runs(folder / USUAL)
    made: dict[str, pd.DataFrame] = {}
    for table, task, metric, never, factor, digits in METRICS:
        rows = []
        for aid in LESS:
            changed = load_runs(folder / aid)
            row = {"left out": quoted(aid)}
            for name in SIX:
                parts = [
                    runs[(runs["controller"] == name) & (runs["task"] == task)].assign(controller=label)
                    for label, runs in (("changed", changed), ("usual", usual))
                ]
                if len(parts[0]):
                    compared = paired(pd.concat(parts), [("changed", "usual")], metric=metric, never=never)[0]
                    row[quoted(name)] = difference(compared, digits, factor)
                else:
                    row[quoted(name)] = "not in use"
            rows.append(row)
        made[table] = pd.DataFrame(rows)
    return made


AIDS: Final = Study(
    "aids",
    "what each aid carries: best equipped methods with one aid less, 100 robots with a camera 50 ms late",
    6,
    {USUAL: without(None)} | {aid: without(aid) for aid in LESS},
    tables,
)
