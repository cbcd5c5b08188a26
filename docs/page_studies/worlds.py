"""Where methods break: worse worlds, chains of learners, every pair of law and estimator, every sensing set-up."""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path
from typing import Final

import pandas as pd

from page_studies import cells
from page_studies.study import (
    BOTH,
    CALIBRATES,
    FIVE,
    RENDERED,
    SUFFIX,
    Study,
    Words,
    settings,
    sweep,
)
from servobench.controllers.methods import ESTIMATORS, LAWS
from servobench.harness.analysis.comparison import (
    Estimate,
    column_of,
    mean_with_interval,
    median_with_interval,
)
from servobench.harness.apps.studies.challenge import MEASURES
from servobench.harness.batch.results import load_runs
from servobench.harness.config.settings import flatten

SEEDS = "500:600"
MISMATCHES = (
    "severe",
    "moderate+camera_rotation=60deg",
    "moderate+camera_rotation=120deg",
    "moderate+links=20%+tool=60mm",
)
MOVED = "moderate+camera_move=45deg"
PAIRS = tuple(f"{law}+{estimator}" for law in LAWS for estimator in ESTIMATORS)
# A camera that deviates or turns; an arm that does; frames that are late; everything
LEARNED_IN = (
    "severe",
    "turning_camera",
    "gears50",
    "zeros90",
    "unknown_arm_tour",
    "backlash",
    "jitter",
    "all_at_once",
)
LEARNED_BY = ("regression_mfac", "ukf_mpc", "rbfnn_mfac", CALIBRATES, "revealed")
JUDGED = (*FIVE, CALIBRATES, "revealed")
COMPARED = (*JUDGED, *(name for name in RENDERED if name.endswith(SUFFIX)))
# Challenges without a grade, which the suite runs only if named: later moves, and frames with stamps
UNGRADED = ("unknown_arm_tour", "jitter_stamped", "latency_swing_stamped")
FRESH = "804203:804403"  # from the hash of the last commit that changed code before they were drawn: c456b
_UKF = {"aids.model": "nominal", "estimator.walk": "1e-12", "estimator.initial_deviation": "1e-12"}
# Settings without which a method keeps the Jacobian of the nominal model
FROZEN: Final[Mapping[str, Mapping[str, str]]] = {
    CALIBRATES: {"aids.model": "nominal"},
    "regression_mfac": {"aids.model": "nominal"},
    "ukf_mfac": _UKF,
    "ukf_mpc": _UKF,
    "rbf_pid": {"aids.model": "nominal", "estimator.n2": "1e-12", "estimator.n3": "1e-12"},
    "rbfnn_mfac": {"aids.model": "nominal", "estimator.k2": "1e-9"},
    "broyden": {"aids.model": "nominal", "estimator.step_factor": "1e-9"},
    "rls": {
        "aids.model": "nominal",
        "estimator.initial_covariance": "1e-12",
        "estimator.memory": "1000",
    },
    "cfdl_mfac": {"aids.model": "nominal", "estimator.step_factor": "1e-9"},
}


def worlds_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how many of 100 robots settle in each world, a row a method."""
    runs = pd.concat(load_runs(folder / part) for part in WORLDS.commands)
    late = [
        f", latency of {1e3 * each:g} ms" if pd.notna(each) else "" for each in runs["latency_s"]
    ]
    runs["world"] = runs["mismatch"].map(cells.quoted) + late
    shown = {
        world: cells.where("world", world, cells.settled) for world in dict.fromkeys(runs["world"])
    }
    return {"worlds": pd.DataFrame(cells.rows_by_method(runs, shown))}


def learning_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return mean scores with learning and without it, a row a challenge."""
    learning, frozen = (pd.read_csv(folder / part / "methods.csv") for part in LEARNING.commands)
    rows = []
    for (grade, name), runs in learning.groupby(["grade", "challenge"], sort=False):
        own = runs.set_index("controller")["score"]
        without = frozen[frozen["challenge"] == name].set_index("controller")["score"]
        scores = {
            cells.quoted(each): f"{own[each]:.2f}/{without[each]:.2f}"
            for each in (*FIVE, CALIBRATES)
        }
        rows.append({"challenge": f"`{name}`", "grade": grade} | scores)
    return {"learning": pd.DataFrame(rows).sort_values("grade", kind="stable")}


def scored(row: pd.Series[float]) -> str:
    """Return the mean score of a method in a challenge, and its share of runs that settle or follow."""
    return f"{row['score']:.2f} ({row['good.value']:.0f} %)"


def _judged(folder: Path) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Return the scored runs and the rows of methods of all challenges, those without a grade last."""
    parts = [folder / part for part in CHALLENGES.commands]
    scores = pd.concat(pd.read_csv(part / "scores.csv") for part in parts)
    methods = pd.concat(pd.read_csv(part / "methods.csv") for part in parts)
    return scores.dropna(subset=["score"]), methods


def _best_published(own: pd.DataFrame) -> str:
    """Return which method as published has the best score; rows are indexed by method."""
    published = [method for method in own.index if method.endswith(SUFFIX)]
    return str(own.loc[published]["score"].idxmax())


def challenges_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return mean scores and shares of good runs, a row a challenge, the ranking, and the tables of what is learned."""
    scores, methods = _judged(folder)
    rows = []
    for name, runs in methods.groupby("challenge", sort=False):
        own = runs.set_index("controller")
        by_method = dict(iter(scores[scores["challenge"] == name].groupby("controller")["score"]))
        unit = MEASURES[own["measure"].iloc[0]].unit
        grade = own["grade"].iloc[0]
        row = {
            "challenge": f"`{name}`",
            "grade": "–" if pd.isna(grade) else grade,
            "reference": f"{own['reference'].iloc[0]:.2f} {unit}",
        }
        for method in JUDGED:
            row[cells.quoted(method)] = interval_scored(own.loc[method], by_method[method])
        best = _best_published(own)
        row["best as published"] = (
            f"{cells.quoted(best.removesuffix(SUFFIX))} {scored(own.loc[best])}"
        )
        rows.append(row)
    ranking = pd.read_csv(folder / "runs" / "ranking.csv")
    ranked = [
        {"method": cells.quoted(each["controller"]), "rank": str(each["rank"]),
         "interquartile mean": f"{each['score.value']:.2f} [{each['score.low']:.2f}, {each['score.high']:.2f}]",
         "lost, %": f"{each['lost, %']:.0f}", **{key: f"{each[key]:.2f}" for key in ranking if "within" in key}}
        for _, each in ranking.iterrows()
    ]  # fmt: skip
    return {
        "challenges": pd.DataFrame(rows).sort_values("grade", kind="stable"),
        "ranking": pd.DataFrame(ranked),
        **learned_tables(scores, methods),
    }


def interval_scored(row: pd.Series[float], scores: pd.Series[float]) -> str:
    """Return the mean of the scores of a method in a challenge with its interval, and its share of good runs."""
    estimate = mean_with_interval(scores.to_numpy())
    # No score is above 1, but Student's interval may be.
    mean = cells.short(replace(estimate, high=min(1.0, estimate.high)), 2)
    return f"{mean} ({row['good.value']:.0f} %)"


def variance_shares(scores: pd.DataFrame) -> dict[str, float]:
    """Return what share of the variance of scores goes with worlds, methods, both together, robots and what is left.

    It is the analysis of variance of a table of all methods on all robots of all worlds: a robot belongs to its world.
    """
    table = scores.pivot_table(index=["challenge", "seed"], columns="controller", values="score")
    grand = table.to_numpy().mean()
    by_world = table.groupby("challenge").transform("mean")
    world = by_world.mean(axis="columns") - grand
    method = table.mean() - grand
    both = by_world.sub(world + grand, axis="index") - method
    robot = table.mean(axis="columns") - world - grand
    rest = table.sub(robot, axis="index") - by_world
    count, methods = table.shape
    squares = {
        "world": methods * float((world**2).sum()),
        "method": count * float((method**2).sum()),
        "method in a world": float((both**2).to_numpy().sum()),
        "robot": methods * float((robot**2).sum()),
        "rest": float((rest**2).to_numpy().sum()),
    }
    return {name: each / sum(squares.values()) for name, each in squares.items()}


def shares_table(scores: pd.DataFrame) -> pd.DataFrame:
    """Return the shares of variance [%] with and without the method that calibrates, a row a set of methods."""
    equipped = LEARNED_BY[:3]
    rows = []
    for methods in (LEARNED_BY[:2], equipped, (*equipped, CALIBRATES)):
        shares = variance_shares(scores[scores["controller"].isin(methods)])
        row = {"methods": ", ".join(map(cells.quoted, methods))}
        rows.append(row | {name: f"{100.0 * share:.1f}" for name, share in shares.items()})
    return pd.DataFrame(rows)


def middle(row: pd.Series[float]) -> str:
    """Return the median of the measure of a method in a challenge, with its interval; a dash where it is infinite."""
    value, low, high = (row[f"median.{part}"] for part in ("value", "low", "high"))
    return cells.short(Estimate(value, low, high, int(row["median.count"])), 2)


def learned_tables(scores: pd.DataFrame, methods: pd.DataFrame) -> dict[str, pd.DataFrame]:
    """Return the scores of what is known or learned in eight worlds, a row a world, and shares of their variance.

    Beside the scores, which end at 1, stand the medians of times and errors, which tell who is better than that.
    """
    scores = scores[scores["challenge"].isin(LEARNED_IN)]
    rows = []
    medians = []
    for name in LEARNED_IN:
        own = methods[methods["challenge"] == name].set_index("controller")
        by_method = dict(iter(scores[scores["challenge"] == name].groupby("controller")["score"]))
        shown = {
            method: interval_scored(own.loc[method], by_method[method])
            for method in own.index
            if method in by_method
        }
        best = _best_published(own)
        unit = MEASURES[own["measure"].iloc[0]].unit
        row = {"world": f"`{name}`", "best as published": scored(own.loc[best])}
        row |= {cells.quoted(method): shown[method] for method in LEARNED_BY}
        rows.append(row | {"score 1 is": f"{own['reference'].iloc[0]:.2f} {unit}"})
        each = {cells.quoted(method): middle(own.loc[method]) for method in own.index}
        medians.append({"world": f"`{name}`", "unit": unit} | each)
    return {
        "learned": pd.DataFrame(rows),
        "learned_shares": shares_table(scores),
        "learned_medians": pd.DataFrame(medians),
    }


def pairs_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how the runs of every pair of law and estimator ended."""
    shown = {
        "runs": lambda runs: str(len(runs)),
        "settled": cells.settled,
        "ended early": cells.ended_early,
    }
    return {
        "pairs": pd.DataFrame(
            cells.rows_by_method(load_runs(folder / "pairs"), shown, title="pair")
        )
    }


def path_ratio(runs: pd.DataFrame) -> str:
    """Return the median ratio of the path of the features to the straight one, with its interval."""
    return cells.short(
        median_with_interval(column_of(runs, "path_length_ratio"), missing="left_out"), 2
    )


def in_view(runs: pd.DataFrame) -> str:
    """Return the mean share of features that were seen [%]."""
    return f"{100.0 * (1.0 - column_of(runs, 'feature_invalid_fraction').mean()):.1f}"


SENSING_CELLS: Final[Mapping[str, cells.Cell]] = {
    "eyes": cells.share, "eyes_time": cells.settling, "eyes_path": path_ratio, "eyes_view": in_view,
}  # fmt: skip
"""Name of a table -> what a cell of it says of the runs of a method under a sensing set-up."""


def sensing_tables(folder: Path) -> dict[str, pd.DataFrame]:
    """Return a table for each measure, with a row for each method and a column for each sensing set-up."""
    runs, tables = load_runs(folder / "runs"), {}
    for name, cell in SENSING_CELLS.items():
        shown = {
            cells.quoted(each): cells.where("sensing", each, cell)
            for each in dict.fromkeys(runs["sensing"])
        }
        tables[name] = pd.DataFrame(cells.rows_by_method(runs, shown))
    return tables


def suite(controllers: Iterable[str], seeds: str, reference_seeds: str, *options: str) -> Words:
    """Return the arguments of a suite of all challenges, or of those that options name."""
    names = ("--plants", "kinematic", "--controllers", ",".join(controllers))
    return ("suite", *names, "--seeds", seeds, "--reference-seeds", reference_seeds, *options)


LEARNING_SUITE: Final = suite(FROZEN, "489414:489454", "10")
WORLDS = Study(
    "worlds",
    "how many of 100 robots settle in worse worlds",
    4,
    {
        "worse": sweep("fmu", BOTH, "random", SEEDS, "--mismatch", ",".join(MISMATCHES)),
        "late": sweep("fmu", BOTH, "random", SEEDS, "--latency", "0.05,0.1"),
        "moved": sweep(
            "fmu", BOTH, "random", SEEDS, "--mismatch", MOVED, "--set", "random.duration=16"
        ),
    },
    worlds_table,
)
LEARNING = Study(
    "learning",
    "every equipped method in every challenge, with learning and frozen: 40 robots",
    10,
    {
        "learning": LEARNING_SUITE,
        "frozen": (
            *LEARNING_SUITE,
            *settings(f"{key}={value}" for key, value in flatten(FROZEN).items()),
        ),
    },
    learning_table,
)
CHALLENGES = Study(
    "challenges",
    "every method in every challenge: 200 robots, with references, that nothing was tuned or chosen on",
    120,
    {
        "runs": suite(COMPARED, FRESH, "200"),
        "ungraded": suite(COMPARED, FRESH, "200", "--challenges", ",".join(UNGRADED)),
    },
    challenges_tables,
)
PAIRS_STUDY = Study(
    "pairs",
    "how the runs of every pair of law and estimator end",
    1,
    {"pairs": sweep("kinematic", PAIRS, "random", "500:504")},
    pairs_table,
)
SENSING = Study(
    "eyes",
    "every method under every sensing set-up, 200 robots",
    4,
    {"runs": sweep("kinematic", BOTH, "random", "66000:66200", "--sensing", "all")},
    sensing_tables,
)
