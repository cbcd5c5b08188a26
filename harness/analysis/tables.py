"""Tables of runs: statistics of a folder, the summary at the end of a command, and the tables of the page.

A cell of the statistics is text for a reader and a plain value for a program. The columns of the page's tables are
pairs (group, heading) and its cells are text with the interval; the columns that say which runs a row is about are in
the group without a name. Numbers are in handy units.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import asdict, dataclass
from itertools import combinations
from typing import Any, Final, TypeAlias

import pandas as pd

from servobench.controllers.methods import PUBLISHED
from servobench.harness.analysis.comparison import (
    CURVE,
    MISSING,
    NO_ESTIMATE,
    POINT_TO_POINT,
    Estimate,
    achieved_share,
    achievement,
    column_of,
    compare_pairs,
    grouped,
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
from servobench.harness.run.request import SHORT_NAMES, varied_columns
from servobench.harness.run.result import COMPLETED
from servobench.harness.run.scenario import Task
from servobench.harness.run.tasks import TASKS
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import suggest

Tables = Iterator[tuple[str, pd.DataFrame]]  # title, rows of text
Row: TypeAlias = "dict[str, Cell]"
BAND: Final = ("settling_band", "feature_unit")
# Columns that `sweep_tables` and `outcome_legend` read
SWEEP_COLUMNS: Final = (
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
PAIR: Final = "A − B"  # heading of the first column of paired differences
STEP_TIME: Final = "controller_time_median_us"
LATE: Final = "*"  # mark of a controller of which a step took longer than the period


@dataclass(frozen=True)
class Cell:
    """A value and how it is written."""

    value: str | float | Estimate
    spec: str = ""  # of `format`

    def __str__(self) -> str:
        """Return it as a reader gets it."""
        text = format(self.value, self.spec)
        return text.replace("inf", "∞") if isinstance(self.value, float) else text

    def plain(self) -> object:
        """Return it as JSON can have it: an estimate with its ends, None for no number, "inf" for infinity."""
        if isinstance(self.value, Estimate):
            return {name: _plain(number) for name, number in asdict(self.value).items()}
        return self.value if isinstance(self.value, str) else _plain(self.value)


def _plain(number: float) -> object:
    return None if math.isnan(number) else number if math.isfinite(number) else str(float(number))


def as_text(rows: list[Row]) -> pd.DataFrame:
    """Return a table of text."""
    return pd.DataFrame([{name: str(cell) for name, cell in row.items()} for row in rows])


def as_plain(rows: list[Row]) -> list[dict[str, object]]:
    """Return rows of plain values."""
    return [{name: cell.plain() for name, cell in row.items()} for row in rows]


def statistics_tables(runs: pd.DataFrame, metric: str | None = None) -> Tables:
    """Yield for each plant, task and condition how each controller does, and how each pair of them differs."""
    for words, controllers, pairs in statistics_rows(runs, metric):
        yield words, as_text(controllers)
        if pairs:
            table = as_text(pairs)
            yield f"paired differences, verdicts with a margin of {table.pop('margin')[0]}", table


def statistics_rows(
    runs: pd.DataFrame, metric: str | None = None
) -> Iterator[tuple[str, list[Row], list[Row]]]:
    """Yield for each plant, task and condition its words, a row for each controller and one for each pair of them."""
    for words, place in split_conditions(runs):
        yield words, _controller_rows(place), _pair_rows(place, metric)


def _controller_rows(runs: pd.DataFrame) -> list[Row]:
    heading = {name: metric_heading(name, runs) for name in METRICS}
    judged = "rms_error_evaluated" if achievement(runs) == FOLLOWED else "steady_state_error"
    factor = shown_unit(judged, runs)[1]
    rows = []
    for name, own in runs.groupby("controller", sort=False):
        ended = outcomes(own)
        failed = ended[~ended.isin(ACHIEVED)].value_counts()
        error = factor * column_of(own, judged).where(own["status"] == COMPLETED)
        row = {"controller": Cell(str(name)), "runs": Cell(len(own))}
        row[f"{achievement(runs)} [%]"] = Cell(achieved_share(own), ".1f")
        if judged == "steady_state_error":
            row[heading["settling_time_s"]] = Cell(_median(settling_times(own)), ".2f")
            row[heading["overshoot"]] = Cell(_median(100.0 * column_of(own, "overshoot")), ".1f")
        row[heading[judged]] = Cell(_median(error), ".1f")
        row[f"its worst 5 % {heading[judged].rpartition(' ')[2]}"] = Cell(tail_mean(error), ".1f")
        row["failures"] = Cell(
            ", ".join(f"{count} {kind}" for kind, count in failed.items()) or "none"
        )
        rows.append(row)
    return rows


def _pair_rows(runs: pd.DataFrame, metric: str | None) -> list[Row]:
    seeds = {str(name): set(own["seed"]) for name, own in runs.groupby("controller", sort=False)}
    # A batch may be unfinished
    pairs = [pair for pair in combinations(seeds, 2) if seeds[pair[0]] & seeds[pair[1]]]
    if not pairs and metric is None:
        return []
    if not pairs:
        raise ConfigurationError(
            f"no two controllers have runs of one seed to compare; leave --metric {metric} out"
        )
    judged = judged_metric(runs)
    metric = judged if metric is None else metric
    filled = runs.select_dtypes("number").dropna(axis=1, how="all").columns
    numbers = {judged, *map(str, filled)} & set(runs) - {"seed"}
    if metric not in numbers:
        raise ConfigurationError(
            f"--metric: the table has no column of numbers {metric!r}: {suggest(metric, numbers)}"
        )
    compared = compare_pairs(runs, pairs, metric=metric, keys=("seed",))
    unit, factor = shown_unit(metric, runs) if metric in METRICS else ("1", 1.0)
    heading = metric_heading(metric, runs) if metric in METRICS else metric.replace("_", " ")
    words = (
        {} if metric in METRICS and METRICS[metric].better else {"better": "less", "worse": "more"}
    )
    return [
        {
            PAIR: Cell(f"{first} − {second}"),
            "runs lost": Cell("{} : {}".format(*each.lost)),
            f"mean difference in {heading}": Cell(each.mean.scaled(factor), ".2f"),
            "verdict": Cell(words.get(each.verdict, each.verdict)),
            f"P(A {words.get('better', 'better')})": Cell(each.probability, ".2f"),
            "margin": Cell(f"{factor * margin(metric, runs):.2g} {unit}".removesuffix(" 1")),
        }
        for (first, second), each in zip(pairs, compared, strict=True)
    ]


def _median(values: pd.Series[float]) -> Estimate:
    """Return the median of a column, a missing value counting as ∞; no estimate where all are missing."""
    return median_with_interval(values) if values.notna().any() else NO_ESTIMATE


def outcome_legend(parts: Iterable[pd.DataFrame]) -> str:
    """Return the meaning of the good outcomes that these runs can have, a line each; the table of runs has parts."""
    known = pd.concat(
        [part.reindex(columns=[*BAND, "task_kind"]).drop_duplicates() for part in parts]
    )
    lines = {
        POINT_TO_POINT: f"{SETTLED}: came within {settling_band(known)} and stayed",
        CURVE: f"{FOLLOWED}: {METRICS['rms_error_evaluated'].label} at most {settling_band(known, FOLLOWING_BANDS)}",
    }
    return "\n".join(line for kind, line in lines.items() if (known["task_kind"] == kind).any())


def summary_legend(runs: pd.DataFrame) -> str:
    """Return the meaning of the words in `summary_tables`, a line each."""
    lines = [
        outcome_legend([runs]),
        _judged_parts(split_tasks(runs)[1]["task"].unique()),
        "sign switches: large joint commands of opposite sign within two periods",
        "numbers: medians over runs" * (len(runs) > 1),
        f"{LATE} some steps took longer than the period" * _is_late(runs),
    ]
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
        kind = CURVE if achievement(place) == FOLLOWED else POINT_TO_POINT
        summaries = [
            (column, metric.summary)
            for wanted in (kind, None)  # measures of such tasks first
            for column, metric in METRICS.items()
            if metric.summary
            and metric.summary.kind == wanted
            and not is_superfluous(column, place)
        ]
        rows = []
        for name, own in place.groupby("controller", sort=False):
            row = {"controller": str(name), "outcome": _shares(own)}
            for column, summary in summaries:
                heading = metric_heading(column, place)
                if column == "settling_time_s":
                    times = settling_times(own)
                    middle = times.fillna(math.inf).median() if times.notna().any() else math.nan
                else:
                    middle = shown_unit(column, place)[1] * column_of(own, column).median()
                row[heading] = number(middle, f".{summary.digits}f")
                if column == STEP_TIME and _is_late(own):
                    row[heading] += LATE
            rows.append(row)
        yield f"{task} on {plant}, {mismatch}", pd.DataFrame(rows)


def _shares(runs: pd.DataFrame) -> str:
    """Return the outcome that all runs have, or a line for each outcome with its share."""
    shares = 100.0 * outcomes(runs).value_counts(normalize=True)
    return (
        shares.index[0]
        if len(shares) == 1
        else "\n".join(f"{share:.0f} % {word}" for word, share in shares.items())
    )


def sweep_tables(parts: Iterable[pd.DataFrame]) -> Tables:
    """Yield the summary of a sweep, for each plant and task.

    That is the share of settled runs, or of those that followed their curve, a row for each condition; and where there
    are others, the share of each outcome over all conditions. Of each part of the table of runs only numbers of runs
    are kept.
    """
    counted, curves = [], set[str]()
    for part in parts:
        counted.append(_count_outcomes(part))
        curves |= set(split_tasks(part)[1]["task"])
    keys = list(counted[0].columns[:-2])
    counts = (
        pd.concat(counted).groupby([*keys, "outcome"], sort=False, as_index=False)["runs"].sum()
    )
    for (plant, task), place in counts.groupby(["plant", "task"], sort=False):
        good = place["runs"].where(place["outcome"].isin(ACHIEVED), 0)
        sums = place.assign(good=good).groupby(keys[2:], sort=False)[["good", "runs"]].sum()
        table = (100.0 * sums["good"] / sums["runs"]).unstack(sort=False).map(number, spec=".1f")
        table["runs"] = sums["runs"].unstack(sort=False).max(axis=1).map("{:.0f}".format)
        word = FOLLOWED if task in curves else SETTLED
        shares = table.rename_axis(columns=None).reset_index()
        if (shares[SHORT_NAMES["period"].heading] == MISSING).all():
            del shares[SHORT_NAMES["period"].heading]
        yield f"{task} on {plant}: {word} [%]", shares
        if good.sum() < place["runs"].sum():
            kinds = place.pivot_table(
                values="runs", index="controller", columns="outcome", aggfunc="sum", sort=False
            )
            table = (100.0 * kinds.div(kinds.sum(axis=1), axis=0)).map(number, spec=".1f")
            yield (
                f"{task} on {plant}: outcomes of the runs [%]",
                table.rename_axis(columns=None).reset_index(),
            )


def _count_outcomes(runs: pd.DataFrame) -> pd.DataFrame:
    """Return how many runs of each condition had which outcome: plant, task, conditions, controller, outcome, runs."""
    varied = varied_columns([*SWEEP_COLUMNS, *runs.columns])
    texts = {
        heading: [shown_value(value, factor, MISSING) for value in texts_of(runs, column)]
        for column, (heading, factor) in varied.items()
    }
    keys = ["plant", "task", "mismatch", *texts, "controller", "outcome"]
    named = with_places(runs).assign(outcome=outcomes(runs), **texts)
    return named.groupby(keys, sort=False).size().rename("runs").reset_index()


def _is_late(runs: pd.DataFrame) -> bool:
    """Return whether a step of a controller took longer than the control period."""
    return bool((column_of(runs, "controller_time_overruns") > 0.0).any())


WHICH: Final = ""  # the group of columns that say which runs a row is about
CONDITIONS: Final = ("plant", "robot", "sensing", "mismatch")  # with the settings that are varied
# Table -> groups of columns in order; a metric says in which of them it is
GROUPS: Final = {
    "moves": ("Time", "Error", "Motion"),
    "curves": ("RMS error", "Motion"),
    "cost": ("Step of the controller", "Joints", "Estimate"),
    "runs": ("Time", "Error", "Motion"),
}
MEANINGS: Final = {
    NOT_SETTLED: "the true error did not come into the settling band, or left it again",
    NOT_FOLLOWED: "the RMS error of the judged part of the curve is too large",
    TARGET_UNREACHABLE: "the true arm cannot come that near to the target or to the judged part of the curve",
    JOINT_AT_LIMIT: "a joint stood at its stop for a second while the error was too large",
}
MOST_PLACES: Final = 5  # that have columns of their own in the overview

PageRow = dict[tuple[str, str], Any]


def overview(runs: pd.DataFrame) -> pd.DataFrame:
    """Return the success rate and score of each controller, a group of columns for each place.

    Where there are many conditions, a group is a task with all its conditions; medians are over all its runs then, and
    have no interval, as runs of one seed in several conditions are no independent ones.
    """
    places, interval = split_conditions(runs), True
    if len(places) > MOST_PLACES:
        pooled = runs.groupby(["task", "feature_unit"], sort=False, dropna=False)
        units = runs["feature_unit"].nunique(dropna=False) > 1
        places = [
            (f"{task}, features in {unit}" if units else str(task), own)
            for (task, unit), own in pooled
        ]
        interval = False
    single = runs["plant"].nunique() * runs["mismatch"].nunique() == 1
    rows = []
    for name in ordered(runs["controller"]):
        row: PageRow = {(WHICH, "controller"): name}
        for words, place in places:
            own = place[place["controller"] == name]
            where = (
                str(place["task"].iloc[0])
                if single and place["task"].nunique() == 1 and len(places) > 1
                else words
            )
            row[where, f"{achievement(place)} [%]"] = (
                f"{achieved_share(own):.0f}" if len(own) else MISSING
            )
            metric = judged_metric(place)
            values = judged_column(place)[place["controller"] == name]
            middle = median_with_interval(values) if len(values) else NO_ESTIMATE
            middle = (
                middle if interval else Estimate(middle.value, math.nan, math.nan, middle.count)
            )
            row[where, metric_heading(metric, place)] = f"{middle:.{METRICS[metric].digits}f}"
        rows.append(row)
    return grouped(rows)


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
    table = []
    for row, own in mixed:
        row[WHICH, "runs"] = str(len(own))
        for word in [*(word for word in OUTCOMES if word in found), *sorted(found - set(OUTCOMES))]:
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
    return _table(runs, "cost", ["plant"] if runs["plant"].nunique() > 1 else [], counted=False)


def failure_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return a row for each way in which runs of a controller ended early, with the reason of the first."""
    failed = runs[runs["status"] != COMPLETED]
    rows = []
    for (controller, plant, status), own in failed.groupby(
        ["controller", "plant", "status"], sort=False
    ):
        total = ((runs["controller"] == controller) & (runs["plant"] == plant)).sum()
        first = own.iloc[0]
        which = {
            "controller": controller,
            "plant": plant,
            "ended by": status,
            "runs": f"{len(own)} of {total}",
        }
        example = {"run": first["run_id"], "reason": first.get("reason") or MISSING}
        rows.append({(WHICH, name): str(text) for name, text in which.items()}
                    | {("The first of them", name): str(text) for name, text in example.items()})  # fmt: skip
    return grouped(rows)


def runs_table(runs: pd.DataFrame) -> pd.DataFrame:
    """Return one row per run: identity, status, outcome and main metrics."""
    runs = in_handy_units(runs)
    named = runs.assign(outcome=outcomes(runs))
    table: dict[tuple[str, str], list[str]] = {}
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
        if counted:
            row["Runs", "number"] = str(len(own))
            row["Runs", f"{achievement(runs)} [%]"] = f"{achieved_share(own):.0f}"
        else:
            row["Runs", "lost [%]"] = f"{100.0 - achieved_share(own).value:.0f}"
        for group, heading, name in columns:
            row[group, heading] = (
                f"{_median_of(own, name, shown_unit(name, runs)[1]):.{METRICS[name].digits}f}"
            )
        rows.append(row)
    return grouped(rows)


def _rows(runs: pd.DataFrame, keys: Sequence[str]) -> Iterator[tuple[PageRow, pd.DataFrame]]:
    """Yield the runs of each condition and controller with the cells that say which they are."""
    names, headings = ordered(runs["controller"]), varied_columns(runs.columns)
    for key, place in runs.groupby(list(keys), sort=False, dropna=False) if keys else [((), runs)]:
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
    return median_with_interval(values, missing="left_out") if values.notna().any() else NO_ESTIMATE


def _kind_of(word: str) -> str:
    if word in ACHIEVED:
        return "As asked"
    return "Reached the last period" if word in OUTCOMES else "Ended early"
