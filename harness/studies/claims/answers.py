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

A rule that holds in none of its cases is *not reproduced*, one that holds in some *depends on* them. A case of so few
robots that the rule could not hold whatever came out decides nothing. A run that never settles counts as its whole
duration.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from math import isfinite
from typing import Final

import pandas as pd

from servobench.harness.analysis.comparison import differences_of_pairs, settling_times
from servobench.harness.analysis.statistics import median_with_interval, signed_rank_p_value, success_rate
from servobench.harness.run.result import COMPLETED
from servobench.harness.studies.claims.measurements import (
    DURATION,
    LEVEL,
    Answer,
    Measurement,
    answer,
    by_seed,
    circle_error,
    held,
    medians,
    pairings,
    significant,
)
from servobench.harness.studies.claims.studies import (
    CIRCLE,
    ENTRIES,
    FROZEN,
    LEAVING,
    MAIN,
    MOVES,
    MPC,
    NO_EPSILON,
    OTHERS,
    PROPOSED,
    STAYING,
    TIMED,
    plain_names,
)

ALIKE_SHARE: Final = 0.10  # of the median settling time
CLEAR_RATIO: Final = 2.0  # of step times, so large that every machine shows it
MAX_CIRCLE_ERROR: Final = 0.010  # [m]
MIN_CIRCLE_SHARE: Final = 0.8

Tables = Mapping[str, pd.DataFrame]


def answer_all(tables: Tables, plant: str, division: str = "best equipped") -> list[Answer]:
    """Return the answers for one plant and division.

    Args:
        tables: tables of runs by name of the study.
        plant: name of the plant.
        division: how the methods were equipped, a key of `DIVISIONS`.
    """
    own = {
        name: table[table["plant"] == plant].reset_index(drop=True).replace({"controller": plain_names(division)})
        for name, table in tables.items()
    }
    rules = (_faster, _overshoot_and_path, _alike, _leaving, _circle, _cheaper, _keeps_up)
    answers = [
        *(rule(own, plant) for rule in rules),
        _reading(own, plant, NO_EPSILON, "ε = 0", "reading: both step sizes without ε, as printed"),
        _reading(own, plant, ENTRIES, "entries", "reading: controller network fitted entry by entry"),
    ]
    return [replace(answer, division=division) for answer in answers]


def _faster(tables: Tables, plant: str) -> Answer:
    panel = "settling time, proposed − rival, s"
    compared = pairings(tables[MAIN], "settling_time_s", panel, sign=-1, never=DURATION)
    middles = medians(tables[MAIN], "settling time, median, s")
    words = "; ".join(
        f"{task} " + ", ".join(f"{m.label} {_seconds(m.estimate.value)}" for m in middles if m.place == task)
        for task in MOVES
    )
    evidence = f"faster in {held(compared)} of {len(compared)} pairings; medians {words}"
    return answer("1", "converges faster than the other three", plant, compared, evidence, middles)


def _seconds(median: float) -> str:
    """Return a median settling time in words; an infinite one is that of runs of which most never settle."""
    return f"{median:.2f} s" if isfinite(median) else "never"


def _overshoot_and_path(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN]
    over = pairings(runs, "overshoot", "overshoot, proposed − rival, %", sign=1, factor=100.0)
    path = pairings(runs, "path_length_ratio", "path ratio, proposed − rival", sign=1)
    evidence = f"larger overshoot in {held(over)} of {len(over)} pairings, longer path in {held(path)} of {len(path)}"
    return answer("2", "its overshoot is larger and its path longer", plant, [*over, *path], evidence)


def _alike(tables: Tables, plant: str) -> Answer:
    measured = []
    for task in MOVES:
        times = by_seed(tables[MAIN], task, "settling_time_s", DURATION)
        difference = median_with_interval(differences_of_pairs(times["ukf_mpc"], times["ukf_mfac"]).dropna())
        inside = max(abs(difference.low), abs(difference.high)) <= ALIKE_SHARE * float(times["ukf_mfac"].median())
        panel = "settling time, ukf_mpc − ukf_mfac, s"
        measured.append(Measurement(panel, task, "ukf_mpc − ukf_mfac", difference, inside))
    laps = [circle_error(tables[MAIN], name) for name in ("ukf_mfac", "ukf_mpc")]
    differences = ", ".join(f"{m.place} {m.estimate:.2f} s" for m in measured)
    circle = " against ".join(f"{m.estimate:.1f} mm ({m.label})" for m in laps)
    return answer("3", "UKF+MPC and UKF+MFAC behave alike", plant, measured, f"{differences}; circle {circle}", laps)


def _leaving(tables: Tables, plant: str) -> Answer:
    runs = tables[MAIN].assign(time=settling_times(tables[MAIN]).fillna(DURATION))
    leaving, staying = (
        runs[runs["task"].isin(tasks)].pivot_table("time", "seed", "controller") for tasks in (LEAVING, STAYING)
    )
    cost = leaving - staying  # [s] by seed and controller
    pairs = ((PROPOSED, "ukf_mfac"), ("rbf_pid", "ukf_mfac"), (PROPOSED, "rbf_pid"))
    differences = [differences_of_pairs(cost[first], cost[second]).dropna() for first, second in pairs]
    panel = "extra settling time where the region is left, s"
    measured = []
    for (first, second), difference, clear in zip(pairs, differences, significant(differences), strict=True):
        middle = median_with_interval(difference)
        measured.append(Measurement(panel, "exp1, exp4", f"{first} − {second}", middle, clear and middle.value > 0.0))
    evidence = "; ".join(f"{m.label} {m.estimate:.2f} s" for m in measured)
    return answer("4", "outside the region both RBF methods suffer, the proposed more", plant, measured, evidence)


def _circle(tables: Tables, plant: str) -> Answer:
    measured = [circle_error(tables[MAIN], name) for name in (PROPOSED, *OTHERS)]
    own = tables[MAIN][(tables[MAIN]["task"] == CIRCLE) & (tables[MAIN]["controller"] == PROPOSED)]
    good = int(((own["rms_error_evaluated"] <= MAX_CIRCLE_ERROR) & (own["status"] == COMPLETED)).sum())
    rate, most = success_rate(good, len(own)), success_rate(len(own), len(own))
    holds = rate.low > MIN_CIRCLE_SHARE if most.low > MIN_CIRCLE_SHARE or rate.high < MIN_CIRCLE_SHARE else None
    share = Measurement("within 10 mm RMS, share", CIRCLE, PROPOSED, rate, holds)
    words = ", ".join(f"{m.label} {m.estimate:.1f} mm" for m in measured)
    evidence = f"within 10 mm in {good} of {len(own)}; medians {words}"
    return answer("5", "tracks a circle of 0.3 m radius", plant, [share], evidence, measured)


def _cheaper(tables: Tables, plant: str) -> Answer:
    measured = []
    for place, tasks in (("moves", MOVES), (CIRCLE, (CIRCLE,))):
        runs = tables[TIMED][tables[TIMED]["task"].isin(tasks)]
        times = runs.pivot_table(index=["task", "seed"], columns="controller", values="controller_time_median_us")
        ratio = median_with_interval(times[PROPOSED] / times[MPC])
        holds = ratio.value < 1.0 / CLEAR_RATIO
        measured.append(Measurement(f"step time, proposed over {MPC}", place, PROPOSED, ratio, holds))
    words = ", ".join(f"{_in_words(m.estimate.value)} {m.place}" for m in measured)
    evidence = f"its median step is {words} (a factor of {CLEAR_RATIO:g} counts; the ratios are in measurements.csv)"
    return answer("6", "its update costs less time than an optimising MPC", plant, measured, evidence)


def _in_words(ratio: float) -> str:
    """Return a ratio of times in words that do not change from machine to machine."""
    if ratio < 1.0 / CLEAR_RATIO:
        return "clearly shorter than that of ukf_mpc in"
    return "clearly longer than that of ukf_mpc in" if ratio > CLEAR_RATIO else "about as long as that of ukf_mpc in"


def _keeps_up(tables: Tables, plant: str) -> Answer:
    online, frozen = (
        table[table["controller"] == PROPOSED].set_index(["task", "seed"])["jacobian_error_mean"]
        for table in (tables[MAIN], tables[FROZEN])
    )
    both = pd.DataFrame({"online": online, "frozen": frozen}).dropna()
    tasks = (*MOVES, CIRCLE)
    differences = [differences_of_pairs(both.loc[task]["online"], both.loc[task]["frozen"]) for task in tasks]
    measured, levels, words = [], [], []
    for task, difference, clear in zip(tasks, differences, significant(differences), strict=True):
        middle = median_with_interval(100.0 * difference)
        holds = clear and middle.value < 0.0
        measured.append(Measurement("Jacobian error, online − as trained, %", task, PROPOSED, middle, holds))
        level = {name: median_with_interval(100.0 * both.loc[task][name]) for name in ("online", "frozen")}
        levels += [Measurement("Jacobian error, mean of a run, %", task, name, level[name]) for name in level]
        words.append(f"{task} {level['online'].value:.1f} / {level['frozen'].value:.1f} %")
    evidence = f"median error online / as trained: {', '.join(words)}"
    return answer("7", "its estimator keeps up with the true Jacobian", plant, measured, evidence, levels)


def _reading(tables: Tables, plant: str, name: str, label: str, statement: str) -> Answer:
    """Compare the proposed method in another reading of the paper with the one that is the default here."""
    usual = tables[MAIN][(tables[MAIN]["controller"] == PROPOSED) & tables[MAIN]["seed"].isin(tables[name]["seed"])]
    measured, words, settled = [], [], []
    for kind, table in (("default", usual), (label, tables[name])):
        moves = table[table["task"].isin(MOVES)].set_index(["task", "seed"])
        times = settling_times(moves)
        share, time = success_rate(int(times.notna().sum()), len(moves)), median_with_interval(times)
        lap = circle_error(table, PROPOSED, kind)
        measured += [
            Measurement("moves that settled, share", "moves", kind, share),
            Measurement("settling time, median, s", "moves", kind, time),
            lap,
        ]
        words.append(f"{kind}: settled {100 * share.value:.0f} %, median {time:.2f} s, circle {lap.estimate:.1f} mm")
        settled.append(times.fillna(DURATION))
    difference = differences_of_pairs(settled[1], settled[0])
    verdict = "worse" if difference.mean() > 0.0 else "better"
    if signed_rank_p_value(difference.to_numpy()) >= LEVEL:
        verdict = "makes no difference"
    return Answer(label, statement, plant, verdict, "; ".join(words), tuple(measured))
