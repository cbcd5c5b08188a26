"""From tables of runs to answers: a verdict, one line of evidence and the measurements behind it, for each claim.

The rules, fixed before the runs were made:

| claim | reproduced where |
|---|---|
| 1 faster | the paired settling time difference is below 0 (p < 0.05 after Holm) in all 12 pairings of move and rival |
| 2 overshoot, path | both are larger than the rival's in all 12 pairings, in the same sense |
| 3 alike | in all tasks the interval of the paired difference in settling time lies within ±10 % of the median |
| 4 leaving the region | it costs both RBF methods more time than it costs `ukf_mfac`, and the proposed one most |
| 5 circle | the second lap stays within 10 mm RMS in more than 80 % of robots, lower end of the interval |
| 6 cheaper | its median step is shorter than that of `ukf_mpc` by a factor of 2, in the moves and on the circle |
| 7 keeps up | learning online lowers the mean Jacobian error (p < 0.05 after Holm) in all five tasks |

A rule that holds in none of its cases is *not reproduced*, one that holds in some *depends on* them. A run that never
settles counts as its whole duration.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np
import pandas as pd

from servobench.harness.analysis.comparison import compare_pairs, settling_times
from servobench.harness.analysis.statistics import holm, median_with_interval, signed_rank_p_value, success_rate
from servobench.harness.run.episode import COMPLETED
from servobench.harness.studies.claims.measurements import (
    DURATION,
    LEVEL,
    Answer,
    Measurement,
    answer,
    circle_error,
    held,
    listed,
    medians,
    pairings,
)
from servobench.harness.studies.claims.studies import (
    CIRCLE,
    ENTRIES,
    FROZEN,
    LEAVING,
    MAIN,
    MOVES,
    NO_EPSILON,
    OTHERS,
    PROPOSED,
    STAYING,
)

ALIKE: Final = 0.10  # of the median settling time
CLEARLY: Final = 2.0  # times: a ratio of times that is seen on every machine
GOOD_CIRCLE: Final = 0.010  # m
MOST: Final = 0.8

Tables = Mapping[str, pd.DataFrame]


def answer_all(tables: Tables, plant: str) -> list[Answer]:
    """Return the answers for one plant.

    Args:
        tables: tables of runs by name of the study.
        plant: whose runs are looked at.
    """
    own = {name: table[table["plant"] == plant].reset_index(drop=True) for name, table in tables.items()}
    return [
        answer_one(own, plant)
        for answer_one in (
            _faster,
            _overshoot_and_path,
            _alike,
            _leaving,
            _circle,
            _cheaper,
            _keeps_up,
            _without_epsilon,
            _entries,
        )
    ]


def _faster(tables: Tables, plant: str) -> Answer:
    compared = pairings(tables[MAIN], "settling_time_s", DURATION, "settling time, proposed − rival, s", sign=-1)
    middles = medians(tables[MAIN], "settling time, median, s")
    evidence = f"faster in {held(compared)} of {len(compared)} pairings; medians {listed(middles)}"
    return answer("1", "converges faster than the other three", plant, compared, evidence, middles)


def _overshoot_and_path(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN]
    over = pairings(runs, "overshoot", np.nan, "overshoot, proposed − rival, %", sign=1, factor=100.0)
    path = pairings(runs, "path_length_ratio", np.nan, "path ratio, proposed − rival", sign=1)
    evidence = f"larger overshoot in {held(over)} of {len(over)} pairings, longer path in {held(path)} of {len(path)}"
    return answer("2", "its overshoot is larger and its path longer", plant, [*over, *path], evidence)


def _alike(tables: Tables, plant: str) -> Answer:
    measured = []
    for task in MOVES:
        runs = tables[MAIN][tables[MAIN]["task"] == task]
        (pair,) = compare_pairs(runs, [("ukf_mpc", "ukf_mfac")], never=DURATION)
        middle = float(settling_times(runs[runs["controller"] == "ukf_mfac"]).fillna(DURATION).median())
        inside = max(abs(pair.difference.low), abs(pair.difference.high)) <= ALIKE * middle
        panel = "settling time, ukf_mpc − ukf_mfac, s"
        measured.append(Measurement(panel, task, "ukf_mpc − ukf_mfac", pair.difference, inside))
    laps = [
        Measurement("circle, RMS of the second lap, mm", CIRCLE, name, circle_error(tables[MAIN], name))
        for name in ("ukf_mfac", "ukf_mpc")
    ]
    differences = ", ".join(f"{m.place} {m.estimate:.2f} s" for m in measured)
    circle = " against ".join(f"{m.estimate:.1f} mm ({m.label})" for m in laps)
    return answer("3", "UKF+MPC and UKF+MFAC behave alike", plant, measured, f"{differences}; circle {circle}", laps)


def _leaving(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN].assign(time=settling_times(tables[MAIN]).fillna(DURATION))
    cost = {name: _cost_of_leaving(runs, name) for name in (PROPOSED, "rbf_pid", "ukf_mfac")}
    excess = {name: cost[name] - cost["ukf_mfac"] for name in (PROPOSED, "rbf_pid")}
    pairs = {**{f"{name} − ukf_mfac": excess[name] for name in excess},
             f"{PROPOSED} − rbf_pid": cost[PROPOSED] - cost["rbf_pid"]}  # fmt: skip
    corrected = holm([signed_rank_p_value(difference.to_numpy()) for difference in pairs.values()])
    panel = "extra settling time where the region is left, s"
    measured = []
    for (label, difference), p_value in zip(pairs.items(), corrected, strict=True):
        middle = median_with_interval(difference)
        measured.append(Measurement(panel, "exp1, exp4", label, middle, p_value < LEVEL and middle.value > 0.0))
    evidence = "; ".join(f"{m.label} {m.estimate:.2f} s" for m in measured)
    return answer("4", "outside the region both RBF methods suffer, the proposed more", plant, measured, evidence)


def _cost_of_leaving(runs: pd.DataFrame, controller: str) -> pd.Series[float]:
    """Return by seed how much longer the moves that leave the region take than those that stay in it, s."""
    own = runs[runs["controller"] == controller]
    leaving, staying = (own[own["task"].isin(tasks)].groupby("seed")["time"].mean() for tasks in (LEAVING, STAYING))
    return leaving - staying


def _circle(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN][tables[MAIN]["task"] == CIRCLE]
    measured = [
        Measurement("circle, RMS of the second lap, mm", CIRCLE, name, circle_error(runs, name))
        for name in (PROPOSED, *OTHERS)
    ]
    own = runs[runs["controller"] == PROPOSED]
    good = int(((own["rms_error_evaluated"] <= GOOD_CIRCLE) & (own["status"] == COMPLETED)).sum())
    rate = success_rate(good, len(own))
    share = Measurement("within 10 mm RMS, share", CIRCLE, PROPOSED, rate, rate.low > MOST)
    evidence = f"within 10 mm in {good} of {len(own)}; medians " + ", ".join(
        f"{m.label} {m.estimate:.1f} mm" for m in measured
    )
    return answer("5", "tracks a circle of 0.3 m radius", plant, [share], evidence, measured)


def _cheaper(tables: Tables, plant: str) -> Answer:
    measured = []
    for place, tasks in (("moves", MOVES), (CIRCLE, (CIRCLE,))):
        runs = tables[MAIN][tables[MAIN]["task"].isin(tasks)]
        times = runs.pivot_table(index=["task", "seed"], columns="controller", values="controller_time_median_us")
        ratio = median_with_interval(times[PROPOSED] / times["ukf_mpc"])
        holds = ratio.value < 1.0 / CLEARLY
        measured.append(Measurement("step time, proposed over ukf_mpc", place, PROPOSED, ratio, holds))
    words = ", ".join(f"{_in_words(m.estimate.value)} {m.place}" for m in measured)
    evidence = f"its median step is {words} (a factor of {CLEARLY:g} counts; the ratios are in measurements.csv)"
    return answer("6", "its update costs less time than an optimising MPC", plant, measured, evidence)


def _in_words(ratio: float) -> str:
    """Return a ratio of times in words that do not change from machine to machine."""
    if ratio < 1.0 / CLEARLY:
        return "clearly shorter than that of ukf_mpc in"
    return "clearly longer than that of ukf_mpc in" if ratio > CLEARLY else "about as long as that of ukf_mpc in"


def _keeps_up(tables: Tables, plant: str) -> Answer:
    keys = ["task", "seed"]
    online, frozen = (
        table[table["controller"] == PROPOSED].set_index(keys)["jacobian_error_mean"]
        for table in (tables[MAIN], tables[FROZEN])
    )
    both = pd.DataFrame({"online": online, "frozen": frozen}).dropna()
    tasks = (*MOVES, CIRCLE)
    differences = [both.loc[task]["online"] - both.loc[task]["frozen"] for task in tasks]
    corrected = holm([signed_rank_p_value(difference.to_numpy()) for difference in differences])
    measured, levels = [], []
    for task, difference, p_value in zip(tasks, differences, corrected, strict=True):
        middle = median_with_interval(100.0 * difference)
        holds = p_value < LEVEL and middle.value < 0.0
        measured.append(Measurement("Jacobian error, online − as trained, %", task, PROPOSED, middle, holds))
        for label in ("online", "frozen"):
            level = median_with_interval(100.0 * both.loc[task][label])
            levels.append(Measurement("Jacobian error, mean of a run, %", task, label, level))
    evidence = "median error online / as trained: " + ", ".join(
        f"{task} {levels[2 * i].estimate.value:.1f} / {levels[2 * i + 1].estimate.value:.1f} %"
        for i, task in enumerate(tasks)
    )
    return answer("7", "its estimator keeps up with the true Jacobian", plant, measured, evidence, levels)


def _without_epsilon(tables: Tables, plant: str) -> Answer:
    return _reading(tables, plant, NO_EPSILON, "ε = 0", "reading: both step sizes without ε, as printed")


def _entries(tables: Tables, plant: str) -> Answer:
    return _reading(tables, plant, ENTRIES, "entries", "reading: controller network fitted entry by entry")


def _reading(tables: Tables, plant: str, name: str, label: str, statement: str) -> Answer:
    """Compare the proposed method in another reading of the paper with the one that is the default here."""
    seeds = set(tables[name]["seed"])
    usual = tables[MAIN][(tables[MAIN]["controller"] == PROPOSED) & tables[MAIN]["seed"].isin(seeds)]
    measured = []
    for kind, table in (("default", usual), (label, tables[name])):
        moves = table[table["task"].isin(MOVES)]
        times = settling_times(moves)
        measured += [
            Measurement("moves that settled, share", "moves", kind, success_rate(int(times.notna().sum()), len(moves))),
            Measurement("settling time, median, s", "moves", kind, median_with_interval(times)),
            Measurement("circle, RMS of the second lap, mm", CIRCLE, kind, circle_error(table, PROPOSED)),
        ]
    texts = [
        f"{kind}: settled {100 * share.estimate.value:.0f} %, median {time.estimate:.2f} s, circle "
        f"{lap.estimate:.1f} mm"
        for kind, (share, time, lap) in zip(("default", label), (measured[:3], measured[3:]), strict=True)
    ]
    keys = ["task", "seed"]
    table = tables[name]
    before, after = (
        settling_times(runs[runs["task"].isin(MOVES)]).fillna(DURATION).set_axis(
            pd.MultiIndex.from_frame(runs[runs["task"].isin(MOVES)][keys])
        )
        for runs in (usual, table)
    )  # fmt: skip
    p_value = signed_rank_p_value((after - before).to_numpy())
    verdict = "makes no difference" if p_value >= LEVEL else ("worse" if (after - before).mean() > 0.0 else "better")
    return Answer(label, statement, plant, verdict, "; ".join(texts), tuple(measured))
