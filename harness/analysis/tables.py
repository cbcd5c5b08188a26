"""Tables of runs: statistics of a folder, the summary at the end of a command, and the tables of the page.

A cell of the statistics is text for a reader and a plain value for a program. The columns of the page's tables are
pairs (group, heading) and its cells are text with the interval; the columns that say which runs a row is about are in
the group without a name. Numbers are in handy units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, NamedTuple, TypeAlias, cast

import numpy as np
import pandas as pd

from servobench.controllers.methods import PUBLISHED
from servobench.harness.analysis.comparison import (
    CURVE,
    MISSING,
    NO_ESTIMATE,
    POINT_TO_POINT,
    SEQUENCE,
    Estimate,
    PageRow,
    Pair,
    achieved_share,
    achievement,
    column_of,
    compare_pairs,
    completed,
    direction,
    grouped,
    holm,
    in_handy_units,
    is_superfluous,
    margin,
    median_with_interval,
    metric_heading,
    number,
    outcomes,
    settling_band,
    settling_times,
    shown_unit,
    shown_value,
    split_conditions,
    split_tasks,
    success_rate,
    tail_mean,
    texts_of,
    with_places,
)
from servobench.harness.analysis.fineness import (
    MIN_AGREEMENT,
    agreement_of_halves,
    least_difference,
)
from servobench.harness.analysis.verdict import judged_column, judged_metric
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.outcome import (
    ACHIEVED,
    FOLLOWED,
    FOLLOWING_BANDS,
    JOINT_AT_LIMIT,
    NOT_FOLLOWED,
    NOT_SETTLED,
    OUTCOMES,
    SETTLED,
    TARGET_UNREACHABLE,
)
from servobench.harness.run.own_metrics import GROUP
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.scenario import Task
from servobench.harness.run.tasks import TASKS
from servobench.harness.run.variations import SHORT_NAMES, varied_columns
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import suggest

Tables = Iterator[tuple[str, pd.DataFrame]]  # title, rows of text
Row: TypeAlias = "dict[str, Cell]"
BAND = ("settling_band", "feature_unit")
# Columns that `sweep_tables` and `outcome_legend` read
SWEEP_COLUMNS = (
    "plant",
    "mismatch",
    *(short.column for short in SHORT_NAMES.values()),
    "sensing",
    "task",
    "controller",
    "status",
    "outcome",
    "settling_time_s",
    "task_kind",
    "rms_error_evaluated",
    *BAND,
)
# Headings of columns of paired differences
PAIR = "A − B"
DIFFERENCE = "mean difference"
P_VALUE = "p (Holm)"
STEP_TIME = "controller_time_median_us"
LATE = "*"  # mark of a controller of which a step took longer than the period


@dataclass(frozen=True)
class Cell:
    """A value and how it is written."""

    value: str | float | Estimate | PValue
    spec: str = ""  # of `format`

    def __str__(self) -> str:
        """Return it as a reader gets it."""
        text = format(self.value, self.spec)
        if isinstance(self.value, float):
            return text.replace("inf", "∞")
        return text

    def plain(self) -> object:
        """Return it as JSON can have it: an estimate with its ends, None for no number, "inf" for infinity."""
        if isinstance(self.value, Estimate | PValue):
            return {name: _plain(number) for name, number in asdict(self.value).items()}
        if isinstance(self.value, str):
            return self.value
        return _plain(self.value)


def _plain(number: float) -> object:
    """Return a number as JSON can have it: None for no number, "inf" for infinity."""
    if math.isnan(number):
        return None
    if math.isinf(number):
        return str(float(number))
    return number


def as_text(rows: list[Row]) -> pd.DataFrame:
    """Return a table of text."""
    return pd.DataFrame([{name: str(cell) for name, cell in row.items()} for row in rows])


def as_plain(rows: list[Row]) -> list[dict[str, object]]:
    """Return rows of plain values."""
    return [{name: cell.plain() for name, cell in row.items()} for row in rows]


class Selection(NamedTuple):
    """What statistics show of the controllers of a folder."""

    names: Mapping[str, str]  # those that are shown, in this order, with their names in tables
    metric: str | None = None  # column by which pairs are compared; None for the usual one
    against: str | None = None  # which is A in all pairs that are shown; None for all pairs


class JudgedPlace(NamedTuple):
    """The statistics of a plant, task and condition."""

    words: str  # which one it is
    controllers: list[Row]
    pairs: list[Row]
    measure: str  # metric by which pairs are compared, with its unit; empty without pairs
    margin: str  # difference that does not matter, with its unit; likewise
    least: str = ""  # difference that the median pair could tell, with its unit; likewise
    stable: int = 0  # number of pairs that halves of the robots order alike


class Statistics(NamedTuple):
    """How each controller does in each place, and how each pair of them differs."""

    places: list[JudgedPlace]
    verdicts: int  # pairs of all controllers of the folder, in all places

    @property
    def family(self) -> str:
        """The number of verdicts shown, over which p-values are corrected, and that of the folder."""
        shown = sum(len(place.pairs) for place in self.places)
        verdicts = "verdicts"
        if shown == 1:
            verdicts = "verdict"
        return f"{shown} {verdicts} shown, {self.verdicts} in this folder"

    @property
    def legend(self) -> str:
        """The levels of intervals, and the test behind p-values with its family."""
        if not any(place.pairs for place in self.places):
            return "brackets: 95 %"
        stable = sum(place.stable for place in self.places)
        return (
            "brackets: 95 %, of mean differences 90 %; resampled and split: robots\n"
            f"p: two-sided sign test; after Holm's correction over the {self.family}\n"
            f"halves of the robots order {stable} of these pairs alike in {100 * MIN_AGREEMENT:.0f} % of the splits"
        )

    def tables(self) -> Tables:
        """Yield a table of the controllers of each place, and one of their pairs if it has any."""
        for place in self.places:
            yield place.words, as_text(place.controllers)
            if place.pairs:
                title = f"paired differences, verdicts with a margin of {place.margin}"
                if place.least:
                    title += f"; the runs can tell {place.least}"
                yield title, as_text(place.pairs)


@dataclass(frozen=True)
class PValue:
    """A p-value; `f"{p:.3f}"` is `0.004 (0.021)`, the second one after Holm's correction."""

    p: float
    holm: float

    def __format__(self, spec: str) -> str:
        """Return both, each formatted with `spec`, of which .3f says no more than <0.001."""
        return f"{self.p:{spec}} ({self.holm:{spec}})".replace("0.000", "<0.001")


def judge_places(runs: pd.DataFrame, selection: Selection | None = None) -> Statistics:
    """Return how controllers of a folder do, and how pairs of them differ, for each plant, task and condition.

    Args:
        runs: all runs of the folder, as margins do not depend on those that are shown.
        selection: of those that are shown; None for all.

    Raises:
        ConfigurationError: a metric that is no column of numbers, or without a pair to compare.
    """
    known = list(runs["controller"].unique())
    shown = selection or Selection({name: name for name in known})
    conditions = split_conditions(runs)
    metric = shown.metric
    filled = runs.select_dtypes("number").dropna(axis=1, how="all").columns
    numbers = {*filled, *(judged_metric(place) for _, place in conditions)} & set(runs) - {"seed"}
    if metric is not None and metric not in numbers:
        raise ConfigurationError(
            f"--metric: the table has no column of numbers {metric!r}: {suggest(metric, numbers)}"
        )
    places = []
    verdicts = 0
    for words, place in conditions:
        verdicts += len(_pairs(place, known))
        places.append(JudgedPlace(words, _controller_rows(place, shown), *_pair_rows(place, shown)))
    pairs = [row for place in places for row in place.pairs]
    if metric is not None and not pairs:
        raise ConfigurationError(
            f"no two controllers have runs of one seed to compare; leave --metric {metric} out"
        )
    p_values = [cast("float", row[P_VALUE].value) for row in pairs]
    for row, p_value, corrected in zip(pairs, p_values, holm(p_values), strict=True):
        row[P_VALUE] = Cell(PValue(p_value, corrected), ".3f")
    return Statistics(places, verdicts)


def _controller_rows(runs: pd.DataFrame, selection: Selection) -> list[Row]:
    """Return how each controller of a place does: good runs, medians, the worst runs and the failures."""
    heading = {name: metric_heading(name, runs) for name in METRICS}
    is_curve = achievement(runs) == FOLLOWED
    metric = judged_metric(runs)
    judged = metric if is_curve else "steady_state_error"
    unit_of_error = heading[judged].rpartition(" ")[2]
    _, factor = shown_unit(judged, runs)
    rows = []
    by_controller = dict(list(runs.groupby("controller")))
    for name in [name for name in selection.names if name in by_controller]:
        own = by_controller[name]
        ended = outcomes(own)
        failed = ended[~ended.isin(ACHIEVED)].value_counts()
        failures = ", ".join(f"{count} {kind}" for kind, count in failed.items())
        error = factor * completed(own, judged)
        row = {"controller": Cell(selection.names[name]), "runs": Cell(len(own))}
        row[f"{achievement(runs)} [%]"] = Cell(achieved_share(own), ".1f")
        if not is_curve:
            overshoot = 100.0 * column_of(own, "overshoot")
            row[heading[metric]] = Cell(_median(completed(own, metric)), ".2f")
            row[heading["overshoot"]] = Cell(_median(overshoot), ".1f")
        row[heading[judged]] = Cell(_median(error), ".1f")
        row[f"its worst 5 % {unit_of_error}"] = Cell(tail_mean(error), ".1f")
        row["failures"] = Cell(failures or "none")
        rows.append(row)
    return rows


def _pairs(runs: pd.DataFrame, names: Iterable[str], against: str | None = None) -> list[Pair]:
    """Return pairs of some controllers of a place, those that share a seed: a batch may be unfinished."""
    seeds = {str(name): set(own["seed"]) for name, own in runs.groupby("controller")}
    present = [name for name in names if name in seeds]
    pairs = list(combinations(present, 2))
    if against is not None:
        pairs = [(against, name) for name in present if name != against]
    return [(first, second) for first, second in pairs if seeds.get(first, set()) & seeds[second]]


def _pair_rows(runs: pd.DataFrame, selection: Selection) -> tuple[list[Row], str, str, str, int]:
    """Return a row for each pair of a place that is shown, and what a `JudgedPlace` says of all of them."""
    pairs = _pairs(runs, selection.names, selection.against)
    judged = judged_metric(runs)
    metric = selection.metric or judged
    # Overshoot, say, is no measure of a curve
    applies = metric == judged or column_of(runs, metric).notna().any()
    if not pairs or not applies:
        return [], "", "", "", 0
    compared = compare_pairs(runs, pairs, metric=metric, keys=("seed",))
    unit, factor, digits = "1", 1.0, 2  # a column that is no metric
    heading = metric.replace("_", " ")
    words = {"better": "less", "worse": "more"}  # nobody knows whether less of it is better
    if metric in METRICS:
        unit, factor = shown_unit(metric, runs)
        heading = metric_heading(metric, runs)
        digits = max(digits, METRICS[metric].digits)
        if METRICS[metric].better:
            words = {}
    better = words.get("better", "better")
    sign = direction(metric)
    rows = []
    for (first, second), each in zip(pairs, compared, strict=True):
        lost_first, lost_second = each.lost
        verdict = words.get(each.verdict, each.verdict)
        if each.on_average:
            verdict += " on average"
        row = {
            PAIR: Cell(f"{selection.names[first]} − {selection.names[second]}"),
            "runs lost": Cell(f"{lost_first} : {lost_second}"),
            f"{DIFFERENCE} in {heading}": Cell(each.mean.scaled(sign * factor), f".{digits}f"),
            "verdict": Cell(verdict),
            f"P(A {better})": Cell(each.probability, ".2f"),
            P_VALUE: Cell(each.p_value),
        }
        rows.append(row)
    small = margin(metric, runs)
    least = factor * float(np.median([least_difference(each.mean, small) for each in compared]))
    agreements = [agreement_of_halves(each.signs, each.probability.count) for each in compared]
    stable = sum(each >= MIN_AGREEMENT for each in agreements)
    shown = [f"{each:.2g} {unit}".removesuffix(" 1") for each in (factor * small, least)]
    if np.isnan(least):
        shown[1] = ""
    return rows, heading, shown[0], shown[1], stable


def _median(values: pd.Series[float]) -> Estimate:
    """Return the median of a column, a missing value counting as ∞; no estimate where all are missing."""
    if values.notna().any():
        return median_with_interval(values)
    return NO_ESTIMATE


def outcome_legend(parts: Iterable[pd.DataFrame]) -> str:
    """Return the meaning of the good outcomes that these runs can have, a line each; the table of runs has parts."""
    columns = [*BAND, "task_kind"]
    known = pd.concat([part.reindex(columns=columns).drop_duplicates() for part in parts])
    kinds = set(known["task_kind"])
    lines = []
    if POINT_TO_POINT in kinds:
        lines.append(f"{SETTLED}: came within {settling_band(known)} and stayed")
    if SEQUENCE in kinds:
        lines.append(f"{SETTLED}: came within {settling_band(known)} and stayed in each move")
    if CURVE in kinds:
        label = METRICS["rms_error_evaluated"].label
        lines.append(f"{FOLLOWED}: {label} at most {settling_band(known, FOLLOWING_BANDS)}")
    return "\n".join(lines)


def summary_legend(runs: pd.DataFrame) -> str:
    """Return the meaning of the words in `summary_tables`, a line each."""
    _, curves = split_tasks(runs)
    lines = [
        outcome_legend([runs]),
        _judged_parts(curves["task"].unique()),
        "sign switches: large joint commands of opposite sign within two periods",
    ]
    if len(runs) > 1:
        lines.append("numbers: medians over runs")
    if _is_late(runs):
        lines.append(f"{LATE} some steps took longer than the period; simulated time waits")
    return "\n".join(filter(None, lines))


def _judged_parts(curves: Iterable[str]) -> str:
    """Return the judged part of each of these tasks in words; a task of a user's names its own in its code."""
    parts: dict[str, list[str]] = {}
    for name in curves:
        task = TASKS[name].default if name in TASKS else Task
        parts.setdefault(task.judged_part, []).append(name)
    return "; ".join(f"judged part of {', '.join(names)}: {part}" for part, names in parts.items())


def summary_tables(runs: pd.DataFrame) -> Tables:
    """Yield the summary of a comparison: a table for each plant, mismatch and task, a row for each controller."""
    for (plant, mismatch, task), place in with_places(runs).groupby(
        ["plant", "mismatch", "task"], sort=False
    ):
        kinds = set(texts_of(place, "task_kind"))
        kind = next((each for each in (SEQUENCE, CURVE) if each in kinds), POINT_TO_POINT)
        summaries = [
            (column, metric.summary)
            for wanted in (kind, None)  # measures of such tasks first
            for column, metric in METRICS.items()
            if metric.summary and metric.summary.kind == wanted
            if not is_superfluous(column, place)
        ]
        rows = []
        for name, own in place.groupby("controller", sort=False):
            row = {"controller": str(name), "outcome": _shares(own)}
            for column, summary in summaries:
                heading = metric_heading(column, place)
                _, factor = shown_unit(column, place)
                values = column_of(own, column)
                if column == "settling_time_s":
                    values = settling_times(own)
                    # Runs that never settled count, unless all are such.
                    if values.notna().any():
                        values = values.fillna(math.inf)
                middle = factor * values.median()
                row[heading] = number(middle, f".{summary.digits}f")
                if column == STEP_TIME and _is_late(own):
                    row[heading] += LATE
            rows.append(row)
        yield f"{task} on {plant}, {mismatch}", pd.DataFrame(rows)


def _shares(runs: pd.DataFrame) -> str:
    """Return the outcome that all runs have, or a line for each outcome with its share."""
    shares = 100.0 * outcomes(runs).value_counts(normalize=True)
    if len(shares) == 1:
        return str(shares.index[0])
    return "\n".join(f"{share:.0f} % {word}" for word, share in shares.items())


def sweep_tables(parts: Iterable[pd.DataFrame]) -> Tables:
    """Yield the summary of a sweep, for each plant and task.

    That is the share of settled runs, or of those that followed their curve, a row for each condition; and where there
    are others, the share of each outcome over all conditions. Of each part of the table of runs only numbers of runs
    are kept.
    """
    counted = []
    curves = set()
    for part in parts:
        counted.append(_count_outcomes(part))
        _, followed = split_tasks(part)
        curves |= set(followed["task"])
    keys = list(counted[0].columns[:-2])  # plant, task, conditions, controller
    same = pd.concat(counted).groupby([*keys, "outcome"], sort=False, as_index=False)
    counts = same[["runs"]].sum()
    for (plant, task), place in counts.groupby(["plant", "task"], sort=False):
        good = place["runs"].where(place["outcome"].isin(ACHIEVED), 0)
        sums = place.assign(good=good).groupby(keys[2:], sort=False)[["good", "runs"]].sum()
        percent = (100.0 * sums["good"] / sums["runs"]).unstack(sort=False)
        table = percent.map(number, spec=".1f")
        most_runs = sums["runs"].unstack(sort=False).max(axis=1)
        table["runs"] = most_runs.map("{:.0f}".format)
        shares = table.rename_axis(columns=None).reset_index()
        period = SHORT_NAMES["period"].heading
        if (shares[period] == MISSING).all():
            del shares[period]
        word = FOLLOWED if task in curves else SETTLED
        yield f"{task} on {plant}: {word} [%]", shares
        if good.sum() < place["runs"].sum():
            yield f"{task} on {plant}: outcomes of the runs [%]", _outcome_shares(place)


def _outcome_shares(counts: pd.DataFrame) -> pd.DataFrame:
    """Return the shares of outcomes in percent, a row for each controller, from numbers of runs."""
    kinds = counts.pivot_table(
        values="runs", index="controller", columns="outcome", aggfunc="sum", sort=False
    )
    shares = 100.0 * kinds.div(kinds.sum(axis=1), axis=0)
    return shares.map(number, spec=".1f").rename_axis(columns=None).reset_index()


def _count_outcomes(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how many runs of each condition had which outcome: plant, task, conditions, controller, outcome, runs."""
    texts = {}
    varied = varied_columns([*SWEEP_COLUMNS, *runs.columns])
    for column, (heading, factor) in varied.items():
        values = texts_of(runs, column)
        texts[heading] = [shown_value(value, factor, MISSING) for value in values]
    keys = ["plant", "task", "mismatch", *texts, "controller", "outcome"]
    named = with_places(runs).assign(outcome=outcomes(runs), **texts)
    return named.groupby(keys, sort=False).size().rename("runs").reset_index()


def _is_late(runs: pd.DataFrame) -> bool:
    """Return whether a step of a controller took longer than the control period."""
    return bool((column_of(runs, "controller_time_overruns") > 0.0).any())


WHICH = ""  # the group of columns that say which runs a row is about
CONDITIONS = ("plant", "robot", "sensing", "mismatch")  # with the settings that are varied
# Table -> groups of columns in order; a metric says in which of them it is
GROUPS = {
    "moves": ("Time", "Error", "Motion", GROUP),
    "curves": ("RMS error", "Motion", GROUP),
    "cost": ("Step of the controller", "Joints", "Estimate"),
    "runs": ("Time", "Error", "Motion", GROUP),
}
MEANINGS = {
    NOT_SETTLED: "the true error did not come into the settling band, or left it again",
    NOT_FOLLOWED: "the RMS error of the judged part of the curve is too large",
    TARGET_UNREACHABLE: "the true arm cannot come that near to the target or to the judged part of the curve",
    JOINT_AT_LIMIT: "a joint stood at its stop for a second while the error was too large",
}
MOST_PLACES = 5  # that have columns of their own in the overview


def overview(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the success rate and score of each controller, a group of columns for each place.

    Where there are many conditions, a group is a task with all its conditions; medians are over all its runs then, and
    have no interval, as runs of one seed in several conditions are no independent ones.
    """
    places = split_conditions(runs)
    is_pooled = len(places) > MOST_PLACES
    if is_pooled:
        places = _pooled_conditions(runs)
    single = runs["plant"].nunique() * runs["mismatch"].nunique() == 1
    rows = []
    for name in ordered(runs["controller"]):
        row = {(WHICH, "controller"): name}
        for words, place in places:
            where = words
            if single and place["task"].nunique() == 1 and len(places) > 1:
                where = str(place["task"].iloc[0])
            is_own = place["controller"] == name
            share = achieved_share(place[is_own]) if is_own.any() else NO_ESTIMATE
            row[where, f"{achievement(place)} [%]"] = f"{share:.0f}"
            metric = judged_metric(place)
            values = judged_column(place)[is_own]
            middle = _median(values)
            if is_pooled:
                middle = Estimate(middle.value, math.nan, math.nan, middle.count)
            row[where, metric_heading(metric, place)] = f"{middle:.{METRICS[metric].digits}f}"
        rows.append(row)
    return grouped(rows)


def _pooled_conditions(runs: pd.DataFrame) -> list[tuple[str, pd.DataFrame]]:
    """Return the runs of each task over all conditions, with words for it; runs in other units are apart."""
    several_units = runs["feature_unit"].nunique(dropna=False) > 1
    places = []
    for (task, unit), own in runs.groupby(["task", "feature_unit"], sort=False, dropna=False):
        words = f"{task}, features in {unit}" if several_units else str(task)
        places.append((words, own))
    return places


def move_tables(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each move the share of runs that settled, their settling times and errors."""
    return _by_task(split_tasks(in_handy_units(runs))[0], "moves")


def curve_tables(runs: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return for each curve the share of runs that followed it, and their errors."""
    return _by_task(split_tasks(in_handy_units(runs))[1], "curves")


def outcome_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the shares of outcomes [%] of each condition, task and controller of which a run failed."""
    rows = _rows(runs.assign(outcome=outcomes(runs)), [*_varied(runs), "task"])
    mixed = [(row, own) for row, own in rows if not own["outcome"].isin(ACHIEVED).all()]
    found = {str(word) for _, own in mixed for word in own["outcome"]}
    words = [*(word for word in OUTCOMES if word in found), *sorted(found - set(OUTCOMES))]
    table = []
    for row, own in mixed:
        row[WHICH, "runs"] = str(len(own))
        for word in words:
            count = int((own["outcome"] == word).sum())
            share = success_rate(count, len(own)).scaled(100.0)
            row[_kind_of(word), f"{word} [%]"] = f"{share:.0f}" if count else MISSING
        table.append(row)
    return grouped(table)


def meanings(table: pd.DataFrame) -> dict[str, str]:
    """Return the meaning of each outcome in an outcome table; the words of faults explain themselves."""
    shown = {str(name[1]).removesuffix(" [%]") for name in list(table) if isinstance(name, tuple)}
    return {word: meaning for word, meaning in MEANINGS.items() if word in shown}


def cost_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return computing times, as far as known, and use of the joints for each plant and controller."""
    keys = ["plant"] if runs["plant"].nunique() > 1 else []
    return _table(runs, "cost", keys, counted=False)


def failure_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each way in which runs of a controller ended early, with the reason of the first."""
    failed = runs[runs["status"] != COMPLETED]
    rows = []
    for (controller, plant, status), own in failed.groupby(
        ["controller", "plant", "status"], sort=False
    ):
        is_same = (runs["controller"] == controller) & (runs["plant"] == plant)
        first = own.iloc[0]
        row = {
            (WHICH, "controller"): str(controller),
            (WHICH, "plant"): str(plant),
            (WHICH, "ended by"): str(status),
            (WHICH, "runs"): f"{len(own)} of {is_same.sum()}",
            ("The first of them", "run"): str(first["run_id"]),
            ("The first of them", "reason"): str(first.get("reason") or MISSING),
        }
        rows.append(row)
    return grouped(rows)


def runs_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row per run: identity, status, outcome and main metrics."""
    runs = in_handy_units(runs)
    named = runs.assign(outcome=outcomes(runs))
    table = {}
    headings = varied_columns(runs.columns)
    for name in ("controller", "task", *_varied(runs)):
        heading, factor = headings.get(name, (name, 1.0))
        table[WHICH, heading] = [shown_value(value, factor) for value in named[name]]
    table[WHICH, "seed"] = named["seed"].astype(str).tolist()
    for name in ("status", "outcome"):
        table["How it ended", name] = named[name].astype(str).tolist()
    for group, name in _columns("runs", runs):
        _, factor = shown_unit(name, runs)
        spec = f".{METRICS[name].digits}f"
        table[group, metric_heading(name, runs)] = [
            number(factor * value, spec) for value in column_of(runs, name)
        ]
    return grouped(table)


def ordered(names: pd.Series[str]) -> list[str]:
    """Return names in order of appearance, each method's published division directly after the method."""
    found = [str(name) for name in dict.fromkeys(names)]
    methods = list(dict.fromkeys(name.removesuffix(PUBLISHED) for name in found))
    return [name for method in methods for name in (method, method + PUBLISHED) if name in found]


def _by_task(runs: pd.DataFrame, kind: str) -> dict[str, pd.DataFrame]:
    return {
        str(task): _table(own, kind, _varied(runs), counted=True)
        for task, own in runs.groupby("task", sort=False)
    }


def _table(runs: pd.DataFrame, kind: str, keys: Sequence[str], *, counted: bool) -> pd.DataFrame:
    """Return medians of measures with their intervals in groups of columns, a row for each of `keys` and controller."""
    rows = []
    columns = [(group, metric_heading(name, runs), name) for group, name in _columns(kind, runs)]
    for row, own in _rows(runs, keys):
        share = achieved_share(own)
        if counted:
            row["Runs", "number"] = str(len(own))
            row["Runs", f"{achievement(runs)} [%]"] = f"{share:.0f}"
        else:
            row["Runs", "lost [%]"] = f"{100.0 - share.value:.0f}"
        for group, heading, name in columns:
            _, factor = shown_unit(name, runs)
            middle = _median_of(own, name, factor)
            row[group, heading] = f"{middle:.{METRICS[name].digits}f}"
        rows.append(row)
    return grouped(rows)


def _rows(runs: pd.DataFrame, keys: Sequence[str]) -> Iterator[tuple[PageRow, pd.DataFrame]]:
    """Yield the runs of each condition and controller with the cells that say which they are."""
    names = ordered(runs["controller"])
    headings = varied_columns(runs.columns)
    places: Iterable[tuple[Any, pd.DataFrame]] = [((), runs)]
    if keys:
        places = runs.groupby(list(keys), sort=False, dropna=False)
    for key, place in places:
        for name in names:
            own = place[place["controller"] == name]
            if len(own):
                row: PageRow = {(WHICH, "controller"): name}
                for column, value in zip(keys, key, strict=True):
                    heading, factor = headings.get(column, (column, 1.0))
                    row[WHICH, heading] = shown_value(value, factor)
                yield row, own


def _varied(runs: pd.DataFrame) -> list[str]:
    """Return the columns of conditions that differ between the runs."""
    known = (*CONDITIONS, *varied_columns(runs.columns))
    return [name for name in known if name in runs and runs[name].nunique(dropna=False) > 1]


def _columns(kind: str, runs: pd.DataFrame) -> list[tuple[str, str]]:
    """Return the metrics of a table that these runs have, each with its group, in the order of the groups."""
    return [
        (group, name)
        for group in GROUPS[kind]
        for name, metric in METRICS.items()
        if metric.tables.get(kind) == group
        and column_of(runs, name).notna().any()
        and not is_superfluous(name, runs)
    ]


def _median_of(own: pd.DataFrame, name: str, factor: float) -> Estimate:
    """Return the median of a measure; a move that never settled counts as ∞, of other measures a gap is left out."""
    if name == "settling_time_s":
        return median_with_interval(factor * settling_times(own))
    values = factor * column_of(own, name)
    if values.isna().all():
        return NO_ESTIMATE
    return median_with_interval(values, missing="left_out")


def _kind_of(word: str) -> str:
    """Return the group of columns of an outcome."""
    if word in ACHIEVED:
        return "As asked"
    if word in OUTCOMES:
        return "Reached the last period"
    return "Ended early"
