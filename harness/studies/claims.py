"""The paper's seven claims: the runs behind them, and for each claim a verdict, evidence and its measurements.

The rules, fixed before the runs were made:

| claim | reproduced where |
|---|---|
| 1 faster | the verdict on the paired difference in settling time is *better* in all 12 pairings of move and rival |
| 2 overshoot, path | those on both are *worse*, that is larger than the rival's, in all 12 pairings |
| 3 alike | that on settling times is *equivalent* in all moves |
| 4 leaving the region | its cost in time is *worse* for both RBF methods than for `ukf_mfac`, worst for the proposed |
| 5 circle | the second lap stays within 10 mm RMS in more than 80 % of robots, lower end of the interval |
| 6 cheaper | its median step is shorter than that of `ukf_mpc` by a factor of 2, in the moves and on the circle |
| 7 keeps up | the mean Jacobian error is *better* with learning online than without in all five tasks |

A rule that holds in none of its cases is *not reproduced*, one that holds in some *depends on* them. A case that is
*undecided* needs more robots. Verdicts, margins and lost runs are those of `servobench.harness.analysis.comparison` and
`comparison`; in claim 4 a run that never settles counts as its whole duration.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any, Final

import pandas as pd

from servobench.controllers.methods import PUBLISHED
from servobench.harness.analysis.comparison import (
    Estimate,
    Verdict,
    margin,
    median_with_interval,
    number,
    paired_difference,
    settling_times,
    success_rate,
)
from servobench.harness.batch.campaign import Campaign
from servobench.harness.batch.plan import Batch, Cell
from servobench.harness.config.registry import RENDERED
from servobench.harness.config.settings import Settings
from servobench.harness.run.result import COMPLETED
from servobench.plant.contract.faults import ConfigurationError

CLEAR_RATIO: Final = 2.0  # of step times, so large that every machine shows it
MAX_CIRCLE_ERROR: Final = 0.010  # [m]
MIN_CIRCLE_SHARE: Final = 0.8
Tables = Mapping[str, pd.DataFrame]
DURATION: Final = 10.0  # [s] of a move
REPRODUCED, NOT_REPRODUCED, DEPENDS = "reproduced", "not reproduced", "depends"
UNDECIDED: Final = "too few robots to tell"
PROPOSED: Final = "rbfnn_mfac"
MPC: Final = "ukf_mpc"
OTHERS: Final = ("rbf_pid", "ukf_mfac", MPC)
MOVES: Final = ("exp1", "exp2", "exp3", "exp4")
# Start or target lie outside the region in which networks are trained
LEAVING: Final = ("exp1", "exp4")
STAYING: Final = ("exp2", "exp3")
CIRCLE: Final = "circle"
DIVISIONS: Final[Mapping[str, str]] = {  # equipment of the methods -> suffix of their names
    "best equipped": "",
    "as published": PUBLISHED,
}
FIRST_SEED: Final = 30_000  # far from the seeds that methods are tuned on
MAIN: Final = "main"
FROZEN: Final = "frozen"  # the Jacobian network as it was trained
NO_EPSILON: Final = "no_epsilon"  # the paper as printed: no ε in either step size
ENTRIES: Final = "entries"  # the paper's fit of the entries of ψ
TIMED: Final = "timed"  # few runs, each by itself: how long steps take
TIMED_ROBOTS: Final = 5  # 20 moves and 5 circles a method
READINGS: Final[Mapping[str, Mapping[str, Any]]] = {
    FROZEN: {"estimator": {"k2": 1e-9}},
    NO_EPSILON: {"law": {"epsilon": 0.0}, "estimator": {"epsilon": 0.0}},
    ENTRIES: {"training": {"controller": {"fit": "entries"}}},
}


@dataclass(frozen=True)
class Measurement:
    """One number behind an answer."""

    panel: str  # the measured quantity with its unit
    place: str  # task
    label: str  # controller, reading or pairing
    estimate: Estimate  # value and interval
    # whether the claim's rule holds here; None for a number that no rule judges, and where the robots are too few to
    # tell
    holds: bool | None = None


Cases = Sequence[Measurement]


@dataclass(frozen=True)
class Answer:
    """The answer to one claim on one plant."""

    claim: str  # its number; readings of the paper have a name instead
    statement: str  # the claim in a few words
    plant: str  # on which the claim was tested
    verdict: str  # reproduced, not reproduced, or the cases on which it depends
    evidence: str  # one line
    measurements: tuple[Measurement, ...]  # the numbers, for the table and the figure
    division: str = "best equipped"  # how the methods were equipped

    @property
    def title(self) -> str:
        """Number and statement, or the statement of a reading."""
        return f"{self.claim}: {self.statement}" if self.claim.isdigit() else self.statement


def studies(plants: Sequence[str], seeds: int, division: str, mismatch: str) -> dict[str, Campaign]:
    """Return the studies by name on `plants`: `seeds` robots for each move, two fifths of them for the circle.

    Args:
        plants: names.
        seeds: number of robots.
        division: a key of `DIVISIONS`.
        mismatch: of all robots.
    """
    suffix = DIVISIONS[division]
    # The same observations, bit for bit, in less time
    rendered = {name: {"scenery": False} for name in RENDERED}
    robots = tuple(range(FIRST_SEED, FIRST_SEED + seeds))
    some = robots[: max(2, 2 * seeds // 5)]

    def cells(
        controllers: tuple[str, ...], tasks: tuple[str, ...], chosen: tuple[int, ...]
    ) -> tuple[Cell, ...]:
        batch = Batch(
            tuple(plants), tuple(name + suffix for name in controllers), tasks, (mismatch,), chosen
        )
        return tuple(Cell(request) for request in batch.requests())

    four = (PROPOSED, *OTHERS)
    own = cells((PROPOSED,), (*MOVES, CIRCLE), some)
    both = cells((PROPOSED, MPC), (*MOVES, CIRCLE), robots[:TIMED_ROBOTS])
    read = {
        name: Campaign(own, Settings({**rendered, PROPOSED + suffix: each}))
        for name, each in READINGS.items()
    }
    main = cells(four, MOVES, robots) + cells(four, (CIRCLE,), some)
    return {
        MAIN: Campaign(main, Settings(rendered)),
        TIMED: Campaign(both, Settings(rendered), timed=True),
        **read,
    }


def answer_all(tables: Tables, plant: str, division: str = "best equipped") -> list[Answer]:
    """Return the answers for one plant and division.

    Args:
        tables: tables of runs by name of the study.
        plant: name of the plant.
        division: how the methods were equipped, a key of `DIVISIONS`.

    Raises:
        ConfigurationError: of a study, no run reached its last period, so that there is nothing to compare.
    """
    plain = {name + DIVISIONS[division]: name for name in (PROPOSED, *OTHERS)}
    here = {name: table[table["plant"] == plant] for name, table in tables.items()}
    own = {
        name: table.reset_index(drop=True).replace({"controller": plain})
        for name, table in here.items()
    }
    for name, table in own.items():
        if not (table["status"] == COMPLETED).any():
            raise ConfigurationError(f"no run of {name} on {plant} reached its last period")
    answers = [
        *(
            rule(own, plant)
            for rule in (
                _faster,
                _overshoot_and_path,
                _alike,
                _leaving,
                _circle,
                _cheaper,
                _keeps_up,
            )
        ),
        _reading(own, plant, NO_EPSILON, "ε = 0", "reading: both step sizes without ε, as printed"),
        _reading(
            own, plant, ENTRIES, "entries", "reading: controller network fitted entry by entry"
        ),
    ]
    return [replace(answer, division=division) for answer in answers]


def _faster(tables: Tables, plant: str) -> Answer:
    compared = pairings(
        tables[MAIN], "settling_time_s", "settling time, proposed − rival, mean, s", "better"
    )
    middles = medians(tables[MAIN], "settling time, median, s")
    times = {
        m: f"{m.estimate.value:.2f} s" if isfinite(m.estimate.value) else "never" for m in middles
    }
    words = "; ".join(
        f"{task} " + ", ".join(f"{m.label} {times[m]}" for m in middles if m.place == task)
        for task in MOVES
    )
    evidence = f"faster in {held(compared)} of {len(compared)} pairings; medians {words}"
    return answer("1", "converges faster than the other three", plant, compared, evidence, middles)


def _overshoot_and_path(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN]
    over = pairings(runs, "overshoot", "overshoot, proposed − rival, mean, %", "worse", 100.0)
    path = pairings(runs, "path_length_ratio", "path ratio, proposed − rival, mean", "worse")
    evidence = f"larger overshoot in {held(over)} of {len(over)} pairings, longer path in {held(path)} of {len(path)}"
    return answer(
        "2", "its overshoot is larger and its path longer", plant, [*over, *path], evidence
    )


def _alike(tables: Tables, plant: str) -> Answer:
    panel, small = (
        "settling time, ukf_mpc − ukf_mfac, mean, s",
        margin("settling_time_s", tables[MAIN]),
    )
    times = {
        task: by_seed(tables[MAIN], task, "settling_time_s")[["ukf_mpc", "ukf_mfac"]]
        for task in MOVES
    }
    measured = [judged(panel, task, own, small, "equivalent") for task, own in times.items()]
    laps = [circle_error(tables[MAIN], name) for name in ("ukf_mfac", "ukf_mpc")]
    differences = ", ".join(f"{m.place} {m.estimate:.2f} s" for m in measured)
    circle = " against ".join(f"{m.estimate:.1f} mm ({m.label})" for m in laps)
    return answer(
        "3",
        "UKF+MPC and UKF+MFAC behave alike",
        plant,
        measured,
        f"{differences}; circle {circle}",
        laps,
    )


def _leaving(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN].assign(time=settling_times(tables[MAIN]).fillna(DURATION))
    parts = (runs[runs["task"].isin(tasks)] for tasks in (LEAVING, STAYING))
    leaving, staying = (part.pivot_table("time", "seed", "controller") for part in parts)
    cost = leaving - staying  # [s] by seed and controller
    pairs = ((PROPOSED, "ukf_mfac"), ("rbf_pid", "ukf_mfac"), (PROPOSED, "rbf_pid"))
    panel, small = (
        "extra settling time where the region is left, mean, s",
        margin("settling_time_s", runs),
    )
    measured = [
        judged(panel, "exp1, exp4", cost[list(pair)].dropna(), small, "worse") for pair in pairs
    ]
    evidence = "; ".join(f"{m.label} {m.estimate:.2f} s" for m in measured)
    return answer(
        "4",
        "outside the region both RBF methods suffer, the proposed more",
        plant,
        measured,
        evidence,
    )


def _circle(tables: Tables, plant: str) -> Answer:
    measured = [circle_error(tables[MAIN], name) for name in (PROPOSED, *OTHERS)]
    laps = tables[MAIN][tables[MAIN]["task"] == CIRCLE]
    followed = (laps["rms_error_evaluated"] <= MAX_CIRCLE_ERROR) & (laps["status"] == COMPLETED)
    lost, own = (
        (~followed).groupby(laps["controller"]).sum(),
        followed[laps["controller"] == PROPOSED],
    )
    good = int(own.sum())
    rate, most = success_rate(good, len(own)), success_rate(len(own), len(own))
    holds = (
        rate.low > MIN_CIRCLE_SHARE
        if most.low > MIN_CIRCLE_SHARE or rate.high < MIN_CIRCLE_SHARE
        else None
    )
    share = Measurement("within 10 mm RMS, share", CIRCLE, PROPOSED, rate, holds)
    words = ", ".join(f"{m.label} {m.estimate:.1f} mm ({lost[m.label]} lost)" for m in measured)
    evidence = f"within 10 mm in {good} of {len(own)}; medians {words}"
    return answer("5", "tracks a circle of 0.3 m radius", plant, [share], evidence, measured)


def _cheaper(tables: Tables, plant: str) -> Answer:
    measured = []
    for place, tasks in (("moves", MOVES), (CIRCLE, (CIRCLE,))):
        runs = tables[TIMED][tables[TIMED]["task"].isin(tasks)]
        times = runs.pivot_table(
            index=["task", "seed"], columns="controller", values="controller_time_median_us"
        )
        ratio = median_with_interval(times[PROPOSED] / times[MPC])
        holds = ratio.value < 1.0 / CLEAR_RATIO
        measured.append(
            Measurement(f"step time, proposed over {MPC}", place, PROPOSED, ratio, holds)
        )
    words = ", ".join(f"{_in_words(m.estimate.value)} {m.place}" for m in measured)
    evidence = f"its median step is {words} (a factor of {CLEAR_RATIO:g} counts; the ratios are in measurements.csv)"
    return answer(
        "6", "its update costs less time than an optimising MPC", plant, measured, evidence
    )


def _in_words(ratio: float) -> str:
    """Return a ratio of times in words that do not change from machine to machine."""
    if ratio < 1.0 / CLEAR_RATIO:
        return "clearly shorter than that of ukf_mpc in"
    return (
        "clearly longer than that of ukf_mpc in"
        if ratio > CLEAR_RATIO
        else "about as long as that of ukf_mpc in"
    )


def _keeps_up(tables: Tables, plant: str) -> Answer:
    compared = {"online": tables[MAIN], "frozen": tables[FROZEN]}
    runs = {
        name: each[each["controller"] == PROPOSED].set_index(["task", "seed"])
        for name, each in compared.items()
    }
    errors = {
        name: own["jacobian_error_mean"].where(own["status"] == COMPLETED)
        for name, own in runs.items()
    }
    both = pd.DataFrame(errors)
    small, panel = (
        margin("jacobian_error_mean", tables[MAIN]),
        "Jacobian error, online − as trained, mean, %",
    )
    measured, levels, words = [], [], []
    for task in (*MOVES, CIRCLE):
        own = judged(panel, task, 100.0 * both.loc[[task]], 100.0 * small, "better")
        measured.append(replace(own, label=PROPOSED))
        level = {
            name: median_with_interval(100.0 * both.loc[task][name])
            for name in ("online", "frozen")
        }
        levels += [
            Measurement("Jacobian error, mean of a run, %", task, name, level[name])
            for name in level
        ]
        words.append(
            f"{task} {number(level['online'].value, '.1f')} / {number(level['frozen'].value, '.1f')} %"
        )
    evidence = f"median error online / as trained: {', '.join(words)}"
    return answer(
        "7", "its estimator keeps up with the true Jacobian", plant, measured, evidence, levels
    )


def _reading(tables: Tables, plant: str, name: str, label: str, statement: str) -> Answer:
    """Compare the proposed method in another reading of the paper with the one that is the default here."""
    usual = tables[MAIN][
        (tables[MAIN]["controller"] == PROPOSED) & tables[MAIN]["seed"].isin(tables[name]["seed"])
    ]
    measured, words, settled = [], [], []
    for kind, table in (("default", usual), (label, tables[name])):
        moves = table[table["task"].isin(MOVES)].set_index(["task", "seed"])
        times = settling_times(moves)
        share, time = (
            success_rate(int(times.notna().sum()), len(moves)),
            median_with_interval(times),
        )
        lap = circle_error(table, PROPOSED, kind)
        measured.append(Measurement("moves that settled, share", "moves", kind, share))
        measured += [Measurement("settling time, median, s", "moves", kind, time), lap]
        words.append(
            f"{kind}: settled {100 * share.value:.0f} %, median {time:.2f} s, circle {lap.estimate:.1f} mm"
        )
        settled.append(times)
    found = paired_difference(
        *settled[1].align(settled[0], join="inner"), margin("settling_time_s", usual)
    )
    words.append(f"mean difference {found.mean:+.2f} s, lost {found.lost[0]} : {found.lost[1]}")
    return Answer(label, statement, plant, found.verdict, "; ".join(words), tuple(measured))


def judged(
    panel: str, place: str, pair: pd.DataFrame, small: float, wanted: Verdict
) -> Measurement:
    """Return the mean difference of two columns of robots, which a rule wants to be better, worse or equivalent."""
    found = paired_difference(pair.iloc[:, 0], pair.iloc[:, 1], small)
    holds = None if found.verdict == "undecided" else found.verdict == wanted
    return Measurement(panel, place, " − ".join(pair.columns), found.mean, holds)


def pairings(
    runs: pd.DataFrame, metric: str, panel: str, wanted: Verdict, factor: float = 1.0
) -> list[Measurement]:
    """Compare the proposed method with each rival in each move.

    Args:
        runs: the table of runs.
        metric: column.
        panel: the measured quantity with its unit.
        wanted: verdict; with `worse`, larger, a lost run leaves its pair out instead of being worse than any.
        factor: from the column's unit to the panel's.
    """
    small, found = factor * margin(metric, runs), []
    for task in MOVES:
        values = factor * by_seed(runs, task, metric)
        for rival in OTHERS:
            pair = values[[PROPOSED, rival]]
            measured = judged(
                panel, task, pair.dropna() if wanted == "worse" else pair, small, wanted
            )
            found.append(replace(measured, label=rival))
    return found


def by_seed(runs: pd.DataFrame, task: str, metric: str) -> pd.DataFrame:
    """Return `metric` by seed and controller; NaN where a run has none or did not complete."""
    known = runs.assign(value=runs[metric].where(runs["status"] == COMPLETED))
    return known[known["task"] == task].pivot(index="seed", columns="controller", values="value")


def medians(runs: pd.DataFrame, panel: str) -> list[Measurement]:
    """Return the median settling time of each method in each move [s]."""
    times = settling_times(runs).groupby([runs["task"], runs["controller"]])
    estimates = {key: median_with_interval(values) for key, values in times}
    return [
        Measurement(panel, task, name, estimates[task, name])
        for task in MOVES
        for name in (PROPOSED, *OTHERS)
    ]


def circle_error(runs: pd.DataFrame, controller: str, label: str = "") -> Measurement:
    """Return the median RMS error of the second lap [mm]; infinite if half of the runs do not complete."""
    own = runs[(runs["task"] == CIRCLE) & (runs["controller"] == controller)]
    error = median_with_interval(
        1000.0 * own["rms_error_evaluated"].where(own["status"] == COMPLETED)
    )
    return Measurement("circle, RMS of the second lap, mm", CIRCLE, label or controller, error)


def held(cases: Cases) -> int:
    """Return in how many cases the rule holds."""
    return sum(bool(m.holds) for m in cases)


def answer(
    claim: str, statement: str, plant: str, cases: Cases, evidence: str, further: Cases = ()
) -> Answer:
    """Return the answer whose verdict follows from the cases judged; `further` measurements are for the figure."""
    count, decided = held(cases), sum(m.holds is not None for m in cases)
    if count == len(cases):
        verdict = REPRODUCED
    elif count == decided:
        verdict = UNDECIDED
    else:
        verdict = f"{DEPENDS}: holds in {count} of {decided}" if count else NOT_REPRODUCED
    return Answer(claim, statement, plant, verdict, evidence, (*cases, *further))
