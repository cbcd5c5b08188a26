"""Runs of a results folder carried out again, and its rows held against its steps."""

import hashlib
from collections.abc import Iterator, Mapping
from dataclasses import dataclass, field
from typing import Any, NamedTuple

import numpy as np
import pandas as pd

from servobench.harness.apps.board.apart import carry_out_apart
from servobench.harness.apps.board.code import Code
from servobench.harness.apps.board.protocol import COLUMNS, Finding, Hear, Verdict
from servobench.harness.batch.consistency import find_contradiction
from servobench.harness.batch.fingerprint import fingerprint
from servobench.harness.batch.logs import run_in_folder
from servobench.harness.batch.results import ResultsFolder, of_one_run
from servobench.harness.config.registry import FILES, is_foreign_controller
from servobench.harness.run.episode import carry_out
from servobench.harness.run.request import RunSettings
from servobench.harness.run.result import COMPLETED, OUT_OF_MEMORY, TIMED_OUT, RunResult
from servobench.harness.run.variations import Row, varied_in_row
from servobench.plant.contract.faults import ConfigurationError, configuration_errors

# Beginnings of columns that no rerun repeats, or that name the run, which are compared elsewhere
LEFT_OUT = ("run_id", "controller", "plant_time", "engine", "reason", "robot", "part")
EXACT = (0.0, 0.0)
# Whether the arithmetic is the same -> the periods whose steps are compared, and relative and absolute differences that
# count as none, in steps and in metrics. Rounding has no time to grow in ten periods; in metrics it has.
ALLOWED = {True: (None, EXACT, EXACT), False: (10, (0.01, 0.003), (0.1, 0.05))}
OF_MACHINE = (TIMED_OUT, OUT_OF_MEMORY)  # endings that another machine need not repeat


@dataclass(frozen=True)
class Given:
    """The controllers that the verifier names, as code that a folder names is never run."""

    codes: Mapping[str, Code] = field(default_factory=dict)  # by the name in the folder
    lacking: Verdict = "unknown"  # about a run that cannot be carried out again


class Difference(NamedTuple):
    """The first cell in which two tables differ."""

    row: int
    column: str
    told: object
    made: object

    def clause(self, usual: str) -> str:
        """Return the clause that it breaks; the usual one of its table if its column has none."""
        return next((COLUMNS[begin] for begin in COLUMNS if self.column.startswith(begin)), usual)

    def __str__(self) -> str:
        """Return it as findings have it."""
        return f"row {self.row} has {self.column} {self.told}, wanted {self.made}"


def first_difference(
    told: pd.DataFrame,
    made: pd.DataFrame,
    left_out: tuple[str, ...] = (),
    tolerance: tuple[float, float] = EXACT,
) -> Difference | None:
    """Return in which cell two tables differ first, row by row; None if they do not.

    Args:
        told: as a folder has it; further columns have no counterpart.
        made: the same, made again.
        left_out: beginnings of columns that do not count.
        tolerance: relative and absolute, by which numbers may differ.
    """
    if len(told) != len(made):
        return Difference(min(len(told), len(made)), "rows", len(told), len(made))
    told = told.reindex(columns=made.columns)
    same = {}
    for name in map(str, made):
        if name.startswith(left_out):
            continue
        before = told[name].to_numpy()
        now = made[name].to_numpy()
        if before.dtype.kind in "bif" and now.dtype.kind in "bif":
            same[name] = np.isclose(before, now, *tolerance, equal_nan=True)
        else:
            same[name] = (before == now) | (pd.isna(before) & pd.isna(now))
    table = pd.DataFrame(same)
    if table.to_numpy().all():
        return None
    row = int(np.argmin(table.all(axis=1)))
    column = str(table.columns[int(np.argmin(table.iloc[row]))])
    return Difference(row, column, told[column].iloc[row], made[column].iloc[row])


def recheck(folder: ResultsFolder, wanted: pd.DataFrame, given: Given, hear: Hear) -> None:
    """Hold the rows of a folder against their steps, and carry out some of its runs again.

    Args:
        folder: of results.
        wanted: rows of the runs that are carried out again.
        given: controllers that are no part of this package.
        hear: receives a finding a line.

    Raises:
        ConfigurationError: not a results folder, or one that is damaged.
    """
    arithmetic = _compare_arithmetic(folder)
    hear(arithmetic)
    for finding in _hold_rows(folder):
        hear(finding)
    rows: Any = wanted.to_dict("records")
    for row in rows:
        for finding in _redo(folder, row, given, same=arithmetic.verdict == "ok"):
            hear(finding)


def draw(runs: pd.DataFrame, count: int) -> pd.DataFrame:
    """Return rows of a table, drawn by its hash."""
    text = hashlib.sha256(runs.to_csv(index=False).encode()).digest()
    generator = np.random.default_rng(int.from_bytes(text))
    return runs.sample(min(count, len(runs)), random_state=generator).sort_index()


def _compare_arithmetic(folder: ResultsFolder) -> Finding:
    """Return whether the folder was made with the arithmetic of this machine."""
    manifest = folder.manifest
    told = manifest.get("fingerprint")
    name = folder.path.name
    if not told:
        return Finding("6.3", "unknown", f"{name} has no fingerprint: differences prove nothing")
    here = fingerprint(manifest.get("plants", ()), manifest.get("controllers", ()))
    others = [key for key, value in told.items() if here.get(key) != value]
    if others:
        return Finding("6.3", "unknown", f"{name}: another arithmetic here in {', '.join(others)}")
    return Finding("6.3", "ok", f"{name}: this machine computes bit for bit as that one")


def _hold_rows(folder: ResultsFolder) -> Iterator[Finding]:
    """Yield which rows contradict their steps, of which metrics are computed again."""
    name = folder.path.name
    if not folder.has_steps():
        yield Finding("6.2", "unknown", f"{name} keeps no steps, of which rows could be computed")
        return
    usual = folder.configuration.get("run", {}).get("period", RunSettings.period)
    known = dict(list(folder.steps().groupby("run_id", sort=False)))
    rows: Any = folder.runs().to_dict("records")
    wrong = 0
    for row in rows:
        period = dict(varied_in_row(row)).get("run.period", usual)
        try:
            with np.errstate(all="ignore"), configuration_errors("", KeyError, TypeError):
                own = of_one_run(known.get(row["run_id"], pd.DataFrame()))
                fault = find_contradiction(row, own, period)
        except ConfigurationError as error:
            fault = f"its steps cannot be read: {error}"
        if fault:
            wrong += 1
            yield Finding("6.2", "failed", f"{row['run_id']}: {fault}")
    if not wrong:
        yield Finding("6.2", "ok", f"{name}: {len(rows)} rows follow from their steps")


def _redo(folder: ResultsFolder, row: Row, given: Given, *, same: bool) -> Iterator[Finding]:
    """Yield what is found when a run is carried out again."""
    name = row["run_id"]
    if row["status"] in OF_MACHINE:
        text = f"{name} is not carried out: a limit of the machine that made it ended it"
        yield Finding("6.3", "unknown", text)
        return
    try:
        made, notices = _carry_out(folder, row, given.codes.get(row["controller"]))
        found = _compare(folder, row, made, same=same)
    except ConfigurationError as error:
        yield Finding("6.3", given.lacking, f"{name} is not carried out: {error}")
        return
    for text in notices:
        yield Finding("1.3", "failed", f"{name}: {row['controller']} {text}")
    yield found or Finding("6.3", "ok", name)


def _carry_out(folder: ResultsFolder, row: Row, code: Code | None) -> tuple[RunResult, list[str]]:
    """Return a run that is carried out again, and what code of users touched."""
    if code is not None:
        return carry_out_apart(folder, row, code)
    name = row["controller"]
    if name.startswith(FILES):
        raise ConfigurationError(f"{name} is no code, which alone is carried out again")
    if is_foreign_controller(name):
        raise ConfigurationError(f"name its controller by --controller {name}=FILE")
    return carry_out(run_in_folder(folder, row, None)), []


def _compare(folder: ResultsFolder, row: Row, made: RunResult, *, same: bool) -> Finding | None:
    """Return in what a run differs first, in its steps, else in its row; own metrics are left aside."""
    name = row["run_id"]
    periods, in_steps, in_row = ALLOWED[same]
    if made.steps is not None and len(made.steps) and folder.has_steps():
        told = folder.steps([name])[:periods]
        if found := first_difference(told, made.steps[:periods], LEFT_OUT, in_steps):
            return Finding(found.clause("6.3"), "failed", f"{name}: steps: {found}")
    found = first_difference(_as_table(row), _as_table(made.row), LEFT_OUT, in_row)
    if found is None:
        return None
    verdict: Verdict = "failed" if same else "unknown"
    return Finding("6.3", verdict, f"{name}: {found}")


def _as_table(row: Row) -> pd.DataFrame:
    """Return the table of a run; of those that ended early it does not count how."""
    table = pd.DataFrame([row])
    table["status"] = table["status"] == COMPLETED
    table["outcome"] = table["outcome"].where(table["status"])
    return table
