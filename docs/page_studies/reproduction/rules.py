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
*undecided* needs more robots. Verdicts, margins and lost runs are those of `servobench.harness.analysis.comparison`;
in claim 4 a run that never settles counts as its whole duration.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from math import isfinite
from typing import Any

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

CLEAR_RATIO = 2.0  # [1] ratio of step times, so large that every machine shows it
MAX_CIRCLE_ERROR = 0.010  # [m]
MIN_CIRCLE_SHARE = 0.8
Tables = Mapping[str, pd.DataFrame]
DURATION = 10.0  # [s] length of a move
REPRODUCED = "reproduced"
NOT_REPRODUCED = "not reproduced"
DEPENDS = "depends"
UNDECIDED = "too few robots to tell"
PROPOSED = "rbfnn_mfac"
MPC = "ukf_mpc"
OTHERS = ("rbf_pid", "ukf_mfac", MPC)
MOVES = ("exp1", "exp2", "exp3", "exp4")
# Start or target lie outside the region in which networks are trained
LEAVING = ("exp1", "exp4")
STAYING = ("exp2", "exp3")
CIRCLE = "circle"
DIVISIONS: Mapping[str, str] = {  # equipment of the methods -> suffix of their names
    "best equipped": "",
    "as published": PUBLISHED,
}
MIN_ROBOTS = 6  # with fewer pairs, Wilcoxon's test cannot reach significance
FIRST_SEED = 30_000  # far from the seeds that methods are tuned on
MAIN = "main"
FROZEN = "frozen"  # the Jacobian network as it was trained
NO_EPSILON = "no_epsilon"  # the paper as printed: no ε in either step size
ENTRIES = "entries"  # the paper's fit of the entries of ψ
TIMED = "timed"  # few runs, each by itself: how long steps take
TIMED_ROBOTS = 5  # 20 moves and 5 circles a method
READINGS: Mapping[str, Mapping[str, Any]] = {
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
    # Whether the claim's rule holds here; None for a number that no rule judges, and where robots are too few to tell
    holds: bool | None = None


Cases = Sequence[Measurement]


@dataclass(frozen=True)
class Answer:
    """The answer to one claim on one plant."""

    claim: str  # its number; readings of the paper have a name instead
    statement: str  # the claim in a few words
    plant: str  # the plant on which the claim was tested; `answer_all` fills it in
    verdict: str  # reproduced, not reproduced, or the cases on which it depends
    evidence: str  # one line
    measurements: tuple[Measurement, ...]  # the numbers, for the table and the figure
    division: str = "best equipped"  # how the methods were equipped

    @property
    def title(self) -> str:
        """Number and statement, or the statement of a reading."""
        if not self.claim.isdigit():
            return self.statement
        return f"{self.claim}: {self.statement}"


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
        equipped = tuple(name + suffix for name in controllers)
        batch = Batch(tuple(plants), equipped, tasks, (mismatch,), chosen)
        return tuple(Cell(request) for request in batch.requests())

    four = (PROPOSED, *OTHERS)
    main = cells(four, MOVES, robots) + cells(four, (CIRCLE,), some)
    timed = cells((PROPOSED, MPC), (*MOVES, CIRCLE), robots[:TIMED_ROBOTS])
    read = cells((PROPOSED,), (*MOVES, CIRCLE), some)
    campaigns = {
        MAIN: Campaign(main, Settings(rendered)),
        TIMED: Campaign(timed, Settings(rendered), timed=True),
    }
    for name, reading in READINGS.items():
        campaigns[name] = Campaign(read, Settings({**rendered, PROPOSED + suffix: reading}))
    return campaigns


def answer_all(tables: Tables, plant: str, division: str = "best equipped") -> list[Answer]:
    """Return the answers for one plant and division.

    Args:
        tables: tables of runs by name of the study.
        plant: name of the plant.
        division: how the methods were equipped, a key of `DIVISIONS`.

    Raises:
        ConfigurationError: no run of a study reached its last period, so that there is nothing to compare.
    """
    plain = {name + DIVISIONS[division]: name for name in (PROPOSED, *OTHERS)}
    own = {}
    for name, table in tables.items():
        here = table[table["plant"] == plant].reset_index(drop=True)
        if not (here["status"] == COMPLETED).any():
            raise ConfigurationError(f"no run of {name} on {plant} reached its last period")
        own[name] = here.replace({"controller": plain})
    claims = (_faster, _overshoot_and_path, _alike, _leaving, _circle, _cheaper, _keeps_up)
    answers = [claim(own) for claim in claims]
    printed = "reading: both step sizes without ε, as printed"
    answers.append(_reading(own, NO_EPSILON, "ε = 0", printed))
    by_entry = "reading: controller network fitted entry by entry"
    answers.append(_reading(own, ENTRIES, "entries", by_entry))
    return [replace(answer, plant=plant, division=division) for answer in answers]


def _faster(tables: Tables) -> Answer:
    panel = "settling time, proposed − rival, mean, s"
    compared = pairings(tables[MAIN], "settling_time_s", panel, "better")
    middles = medians(tables[MAIN], "settling time, median, s")
    words = []
    for task in MOVES:
        times = [f"{m.label} {_time_in_words(m)}" for m in middles if m.place == task]
        words.append(f"{task} {', '.join(times)}")
    evidence = f"faster in {held(compared)} of {len(compared)} pairings; medians {'; '.join(words)}"
    return answer("1", "converges faster than the other three", compared, evidence, middles)


def _time_in_words(measurement: Measurement) -> str:
    """Return a settling time with its unit, or a word where half of the runs or more never settle."""
    time = measurement.estimate.value
    if isfinite(time):
        return f"{time:.2f} s"
    return "never"


def _overshoot_and_path(tables: Tables) -> Answer:
    runs = tables[MAIN]
    over = pairings(runs, "overshoot", "overshoot, proposed − rival, mean, %", "worse", 100.0)
    path = pairings(runs, "path_length_ratio", "path ratio, proposed − rival, mean", "worse")
    statement = "its overshoot is larger and its path longer"
    return answer(
        "2",
        statement,
        [*over, *path],
        f"larger overshoot in {held(over)} of {len(over)} pairings, longer path in {held(path)} of {len(path)}",
    )


def _alike(tables: Tables) -> Answer:
    runs = tables[MAIN]
    panel = "settling time, ukf_mpc − ukf_mfac, mean, s"
    small = margin("settling_time_s", runs)
    measured = []
    for task in MOVES:
        times = by_seed(runs, task, "settling_time_s")[["ukf_mpc", "ukf_mfac"]]
        measured.append(judged(panel, task, times, small, "equivalent"))
    laps = [circle_error(runs, name) for name in ("ukf_mfac", "ukf_mpc")]
    differences = ", ".join(f"{m.place} {m.estimate:.2f} s" for m in measured)
    circle = " against ".join(f"{m.estimate:.1f} mm ({m.label})" for m in laps)
    evidence = f"{differences}; circle {circle}"
    return answer("3", "UKF+MPC and UKF+MFAC behave alike", measured, evidence, laps)


def _leaving(tables: Tables) -> Answer:
    runs = tables[MAIN].assign(time=settling_times(tables[MAIN]).fillna(DURATION))
    cost = _mean_times(runs, LEAVING) - _mean_times(runs, STAYING)  # [s]
    panel = "extra settling time where the region is left, mean, s"
    small = margin("settling_time_s", runs)
    measured = []
    for pair in ((PROPOSED, "ukf_mfac"), ("rbf_pid", "ukf_mfac"), (PROPOSED, "rbf_pid")):
        costs = cost[list(pair)].dropna()
        measured.append(judged(panel, "exp1, exp4", costs, small, "worse"))
    evidence = "; ".join(f"{m.label} {m.estimate:.2f} s" for m in measured)
    statement = "outside the region both RBF methods suffer, the proposed more"
    return answer("4", statement, measured, evidence)


def _mean_times(runs: pd.DataFrame, tasks: Sequence[str]) -> pd.DataFrame:
    """Return the mean of the column `time` over some tasks, by seed and controller [s]."""
    return runs[runs["task"].isin(tasks)].pivot_table("time", "seed", "controller")


def _circle(tables: Tables) -> Answer:
    measured = [circle_error(tables[MAIN], name) for name in (PROPOSED, *OTHERS)]
    laps = tables[MAIN][tables[MAIN]["task"] == CIRCLE]
    followed = (laps["rms_error_evaluated"] <= MAX_CIRCLE_ERROR) & (laps["status"] == COMPLETED)
    lost = (~followed).groupby(laps["controller"]).sum()
    own = followed[laps["controller"] == PROPOSED]
    good = int(own.sum())
    rate = success_rate(good, len(own))
    # Few robots cannot show the share even if all of them follow; that it is missed may still show.
    most = success_rate(len(own), len(own))
    is_decided = most.low > MIN_CIRCLE_SHARE or rate.high < MIN_CIRCLE_SHARE
    holds = rate.low > MIN_CIRCLE_SHARE if is_decided else None
    share = Measurement("within 10 mm RMS, share", CIRCLE, PROPOSED, rate, holds)
    words = ", ".join(f"{m.label} {m.estimate:.1f} mm ({lost[m.label]} lost)" for m in measured)
    evidence = f"within 10 mm in {good} of {len(own)}; medians {words}"
    return answer("5", "tracks a circle of 0.3 m radius", [share], evidence, measured)


def _cheaper(tables: Tables) -> Answer:
    panel = f"step time, proposed over {MPC}"
    every = tables[TIMED]
    measured = []
    for place, tasks in (("moves", MOVES), (CIRCLE, (CIRCLE,))):
        runs = every[every["task"].isin(tasks)]
        times = runs.pivot_table("controller_time_median_us", ["task", "seed"], "controller")
        ratio = median_with_interval(times[PROPOSED] / times[MPC])
        holds = ratio.value < 1.0 / CLEAR_RATIO
        measured.append(Measurement(panel, place, PROPOSED, ratio, holds))
    words = ", ".join(f"{_ratio_in_words(m.estimate.value)} {m.place}" for m in measured)
    evidence = f"its median step is {words} (a factor of {CLEAR_RATIO:g} counts; the ratios are in measurements.csv)"
    statement = "its update costs less time than an optimising MPC"
    return answer("6", statement, measured, evidence)


def _ratio_in_words(ratio: float) -> str:
    """Return a ratio of times in words that do not change from machine to machine."""
    if ratio < 1.0 / CLEAR_RATIO:
        return "clearly shorter than that of ukf_mpc in"
    if ratio > CLEAR_RATIO:
        return "clearly longer than that of ukf_mpc in"
    return "about as long as that of ukf_mpc in"


def _keeps_up(tables: Tables) -> Answer:
    """Compare errors on the robots that ran with frozen learning as well; rendered, these are fewer."""
    frozen = _jacobian_errors(tables[FROZEN])
    online = _jacobian_errors(tables[MAIN]).reindex(frozen.index)
    both = pd.DataFrame({"online": online, "frozen": frozen})
    small = margin("jacobian_error_mean", tables[MAIN])
    measured, levels, words = [], [], []
    for task in (*MOVES, CIRCLE):
        panel = "Jacobian error, online − as trained, mean, %"
        own = judged(panel, task, 100.0 * both.loc[[task]], 100.0 * small, "better")
        measured.append(replace(own, label=PROPOSED))
        middles = []
        for name in ("online", "frozen"):
            middle = median_with_interval(100.0 * both.loc[task][name])
            middles.append(number(middle.value, ".1f"))
            levels.append(Measurement("Jacobian error, mean of a run, %", task, name, middle))
        words.append(f"{task} {' / '.join(middles)} %")
    evidence = f"median error online / as trained: {', '.join(words)}"
    statement = "its estimator keeps up with the true Jacobian"
    return answer("7", statement, measured, evidence, levels)


def _jacobian_errors(runs: pd.DataFrame) -> pd.Series[float]:
    """Return the mean Jacobian error of each completed run of the proposed method, by task and seed."""
    own = runs[runs["controller"] == PROPOSED].set_index(["task", "seed"])
    return own["jacobian_error_mean"].where(own["status"] == COMPLETED)


def _reading(tables: Tables, name: str, label: str, statement: str) -> Answer:
    """Compare the proposed method in another reading of the paper with the one that is the default here."""
    runs = tables[MAIN]
    other = tables[name]
    usual = runs[(runs["controller"] == PROPOSED) & runs["seed"].isin(other["seed"])]
    measured, words = [], []
    for kind, table in (("default", usual), (label, other)):
        times = _times_of_moves(table)
        share = success_rate(int(times.notna().sum()), len(times))
        time = median_with_interval(times)
        lap = circle_error(table, PROPOSED, kind)
        measured.append(Measurement("moves that settled, share", "moves", kind, share))
        measured.append(Measurement("settling time, median, s", "moves", kind, time))
        measured.append(lap)
        words.append(
            f"{kind}: settled {100 * share.value:.0f} %, median {time:.2f} s, circle {lap.estimate:.1f} mm"
        )
    first, second = _times_of_moves(other).align(_times_of_moves(usual), join="inner")
    found = paired_difference(first, second, margin("settling_time_s", usual))
    words.append(f"mean difference {found.mean:+.2f} s, lost {found.lost[0]} : {found.lost[1]}")
    return Answer(label, statement, "", found.verdict, "; ".join(words), tuple(measured))


def _times_of_moves(runs: pd.DataFrame) -> pd.Series[float]:
    """Return the settling times of moves by task and seed [s]; NaN where a run never settled."""
    moves = runs[runs["task"].isin(MOVES)]
    return settling_times(moves.set_index(["task", "seed"]))


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
    small = factor * margin(metric, runs)
    found = []
    for task in MOVES:
        values = factor * by_seed(runs, task, metric)
        for rival in OTHERS:
            pair = values[[PROPOSED, rival]]
            if wanted == "worse":
                pair = pair.dropna()
            measured = judged(panel, task, pair, small, wanted)
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
    completed = own["rms_error_evaluated"].where(own["status"] == COMPLETED)
    error = median_with_interval(1000.0 * completed)
    return Measurement("circle, RMS of the second lap, mm", CIRCLE, label or controller, error)


def held(cases: Cases) -> int:
    """Return in how many cases the rule holds."""
    return sum(bool(m.holds) for m in cases)


def answer(claim: str, statement: str, cases: Cases, evidence: str, further: Cases = ()) -> Answer:
    """Return the answer whose verdict follows from the cases judged; `further` measurements are for the figure."""
    count = held(cases)
    decided = sum(m.holds is not None for m in cases)
    if count == len(cases):
        verdict = REPRODUCED
    elif count == decided:
        verdict = UNDECIDED
    elif count == 0:
        verdict = NOT_REPRODUCED
    else:
        verdict = f"{DEPENDS}: holds in {count} of {decided}"
    return Answer(claim, statement, "", verdict, evidence, (*cases, *further))
