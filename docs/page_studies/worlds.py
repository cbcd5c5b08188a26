"""Where methods break: worse worlds one by one, every pair of law and estimator, and the robustness map."""

from __future__ import annotations

import io
import json
from collections.abc import Iterable, Iterator
from pathlib import Path

import pandas as pd
from PIL import Image

from page_studies.methods import BOTH, FOUR, SUFFIX, by_method, millimetres, quoted, settled, settling, short
from page_studies.study import Study, sweep
from servobench.controllers.aids import EQUIPPED
from servobench.controllers.parts import ESTIMATORS, LAWS
from servobench.harness.analysis.statistics import median_with_interval
from servobench.harness.batch.results import load_runs
from servobench.harness.run.result import COMPLETED

SEEDS = "500:600"
MISMATCHES = (
    "severe",
    "moderate+camera_rotation=60deg",
    "moderate+camera_rotation=120deg",
    "moderate+links=20%+tool=60mm",
)
MOVED = "moderate+camera_move=45deg"
PAIRS = tuple(f"{law}+{estimator}" for law in LAWS for estimator in ESTIMATORS)
WITHOUT = "mfac+constant"  # the map alone
LEARNERS = (WITHOUT, "mfac+arm", "mfac+ukf", "mfac+rbf", "mfac+true")
LEARNING_WORLDS = "moderate,gear_ratio=20%,severe+gear_ratio=20%+joint_offsets=15deg"
MAPPED = ("map_mfac", *(name + SUFFIX for name in FOUR))  # best equipped all stay above 90 % everywhere
COLOURS = 128  # of a picture's palette


def worlds_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how many of 100 robots settle in each world, a row a method."""
    parts = [load_runs(folder / part) for part in WORLDS.commands]
    worlds = {
        title: own
        for part in parts
        for (mismatch, latency), own in part.groupby(["mismatch", "latency_s"], sort=False, dropna=False)
        for title in [f"`{mismatch}`" + ("" if pd.isna(latency) else f", latency of {1e3 * latency:g} ms")]
    }
    methods = dict.fromkeys(name for part in parts for name in part["controller"])
    rows = [
        {"method": quoted(name)}
        | {title: str(settled(own[own["controller"] == name])) for title, own in worlds.items()}
        for name in methods
    ]
    return {"worlds": pd.DataFrame(rows)}


def learning_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return what each learner does to the error on the circle and to moves, in chains that differ in nothing else."""
    circles, moves = load_runs(folder / "circles"), load_runs(folder / "moves")
    rows = []
    for world, own in circles.groupby("mismatch", sort=False):
        without = own[own["controller"] == WITHOUT].set_index("seed")["rms_error_evaluated"]
        for name, each in by_method(own):
            move = moves[(moves["mismatch"] == world) & (moves["controller"] == name)]
            ratio = each.set_index("seed")["rms_error_evaluated"] / without
            rows.append({
                "world": f"`{world}`",
                "estimator": quoted(name.partition("+")[2]),
                "circle, RMS of the second lap, mm": millimetres(each, digits=2),
                "over that of `constant`": short(median_with_interval(ratio), 2),
                "moves settled": str(settled(move)),
                "settling time, s": settling(move),
            })  # fmt: skip
    return {"learning": pd.DataFrame(rows)}


def pairs_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how the runs of every pair of law and estimator ended."""
    rows = []
    for name, own in by_method(load_runs(folder / "pairs")):
        early = own.loc[own["status"] != COMPLETED, "status"].value_counts()
        ends = ", ".join(f"{count} {kind}" for kind, count in early.items())
        rows.append({"pair": quoted(name), "runs": str(len(own)), "settled": str(settled(own)), "ended early": ends})
    return {"pairs": pd.DataFrame(rows)}


def map_pictures(folder: Path) -> Iterator[tuple[str, bytes]]:
    """Yield the two pictures of the robustness map."""
    for path in sorted((folder / "map" / "figures").glob("*.png")):
        with Image.open(path) as picture:
            yield f"pictures/{path.name}", small(picture)


def chain(names: Iterable[str]) -> tuple[str, ...]:
    """Return the settings of the same chain for all pairs; the true Jacobian needs no map."""
    values = {**{f"aids.{key}": word for key, word in EQUIPPED.items()}, "law.gain": 27.7, "law.step_weight": 4e-4}
    options: list[str] = []
    for name in names:
        own = values | {"aids.model": "own"} if name.endswith("+true") else values
        options += [word for key, value in own.items() for word in ("--set", f"{name}.{key}={json.dumps(value)}")]
    return tuple(options)


def small(picture: Image.Image) -> bytes:
    """Return a picture as PNG with a palette."""
    stream = io.BytesIO()
    picture.convert("RGB").quantize(COLOURS, dither=Image.Dither.NONE).save(stream, "PNG", optimize=True)
    return stream.getvalue()


WORLDS = Study(
    "worlds",
    "how many of 100 robots settle in worse worlds",
    4,
    {
        "worse": sweep("fmu", BOTH, "random", SEEDS, "--mismatch", ",".join(MISMATCHES)),
        "late": sweep("fmu", BOTH, "random", SEEDS, "--latency", "0.05,0.1"),
        "moved": sweep("fmu", BOTH, "random", SEEDS, "--mismatch", MOVED, "--set", "random.duration=16"),
    },
    worlds_table,
)
LEARNING = Study(
    "learning",
    "what learned parts win where a map cannot do: 100 robots a world, chains that differ in the estimator only",
    5,
    {
        part: sweep("kinematic", LEARNERS, task, "9400:9500", "--mismatch", LEARNING_WORLDS, *chain(LEARNERS))
        for part, task in (("circles", "circle"), ("moves", "random"))
    },
    learning_table,
)
PAIRS_STUDY = Study(
    "pairs",
    "how the runs of every pair of law and estimator end",
    1,
    {"pairs": sweep("kinematic", PAIRS, "random", "500:504")},
    pairs_table,
)
MAP = Study(
    "robustness",
    "the robustness map: its two pictures",
    2,
    {"map": ("robustness", "--plant", "fmu", "--controllers", ",".join(MAPPED), "--seeds", "50000:50030")},
    files=map_pictures,
)
