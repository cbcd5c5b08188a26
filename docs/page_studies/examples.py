"""Controllers of docs/examples beside methods of the bench: rivals, tuned and untuned, and trained policies."""

from __future__ import annotations

import os
import shutil
from pathlib import Path
from typing import Final

import pandas as pd

from page_studies import cells
from page_studies.study import BETTER, Study, Words, sweep
from servobench.harness.analysis.comparison import median_with_interval, settling_times
from servobench.harness.batch.results import load_runs

FOLDER: Final = Path("docs") / "examples"
# File -> its class; with `Alone` at the end it is the one without aids
RIVALS: Final = {"adrc.py": "Adrc", "pfdl_mfac.py": "PfdlMfac"}
BESIDE: Final = (BETTER, "ukf_mfac", "ukf_mfac:published", "cfdl_mfac:published")
TRAININGS: Final = (0, 1, 2)  # seeds
UNTRAINED: Final = "untrained"
# From the hash of the last commit that changed code before they were drawn: 62fa3
FIRST: Final = 405411
ROBOTS: Final = f"{FIRST}:{FIRST + 60}"
MANY_ROBOTS: Final = f"{FIRST}:{FIRST + 200}"


def here(folder: Path) -> Path:
    """Return a folder as seen from the one in which the commands are carried out."""
    return Path(os.path.relpath(folder))


def classes(folder: Path) -> list[str]:
    """Return the places of the classes of all rivals, whose files are in a folder."""
    return [
        f"{folder / file}:{name}{end}" for file, name in RIVALS.items() for end in ("", "Alone")
    ]


def tuned() -> Words:
    """Return the sweep of the rivals with their tuned values, and of methods of the bench."""
    places = [f"./{place}" for place in classes(FOLDER / "rivals")]
    return sweep("kinematic", (*places, *BESIDE), "random,circle", ROBOTS)


def untuned(folder: Path) -> Words:
    """Return the sweep of copies of the rivals without the files of tuned values."""
    copies = here(folder) / "untuned_code"
    copies.mkdir(exist_ok=True)
    for file in RIVALS:
        shutil.copy(FOLDER / "rivals" / file, copies)
    return sweep("kinematic", classes(copies), "random,circle", ROBOTS)


def rivals_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how fast methods settle and how well they follow, untuned and tuned, a row a method."""
    parts = {part: load_runs(folder / part) for part in RIVALS_STUDY.commands}
    kinds = {"settling, s": ("random", cells.settling), "circle, mm": ("circle", cells.millimetres)}
    rows = []
    for name, _ in cells.by_method(parts["tuned"]):
        row = {"controller": cells.quoted(name)}
        for heading, (task, cell) in kinds.items():
            for part, runs in parts.items():
                of_task = runs[runs["task"] == task]
                own = of_task[of_task["controller"] == name]
                row[f"{heading}, {part}"] = cell(own) if len(own) else ""
        rows.append(row)
    return {"rivals": pd.DataFrame(rows)}


def policy_file(folder: Path, seed: int) -> Path:
    """Return where the policy of a training is."""
    return here(folder) / f"policy_{seed}.onnx"


def controllers(folder: Path) -> list[str]:
    """Return the better method and all policies."""
    names = [f"training_{seed}={policy_file(folder, seed)}" for seed in TRAININGS]
    return [*names, f"{UNTRAINED}={here(folder) / UNTRAINED}.onnx", BETTER]


def judged(folder: Path) -> Words:
    """Return the sweep of the policies on moves, as they were trained on, and of the better method."""
    moves = sweep("kinematic", controllers(folder), "random", MANY_ROBOTS)
    return (*moves, "--mismatch", "moderate,severe")


def judged_on_curves(folder: Path) -> Words:
    """Return the same sweep on the circle, which no policy was trained on."""
    return sweep("kinematic", controllers(folder), "circle", MANY_ROBOTS)


def policies_table(folder: Path) -> dict[str, pd.DataFrame]:
    """Return how many robots settle, how fast and how near, and how well policies follow, a row a policy."""
    runs = pd.concat(load_runs(folder / part) for part in ("judged", "curves"))
    rows = []
    for name, own in cells.by_method(runs):
        row = {"controller": cells.quoted(name) if name == BETTER else name.replace("_", " ")}
        moves = own[own["task"] == "random"]
        for mismatch, there in moves.groupby("mismatch", sort=False):
            time = cells.short(median_with_interval(settling_times(there)), 2)
            row[f"settling, s, `{mismatch}`"] = f"{time}, {cells.settled(there)}/{len(there)}"
        usual = moves[moves["mismatch"] == "moderate"]
        row["rest, mm"] = cells.millimetres(usual, "steady_state_error")
        row["circle, mm"] = cells.millimetres(own[own["task"] == "circle"])
        rows.append(row)
    return {"policies": pd.DataFrame(rows)}


def training(*options: str) -> Words:
    """Return the arguments of the training of a policy."""
    return (str(FOLDER / "train_policy.py"), *options)


RIVALS_STUDY: Final = Study(
    "rivals",
    "ADRC and PFDL-MFAC as laws of one's own, tuned and untuned: 60 robots",
    4,
    {"untuned": untuned, "tuned": tuned()},
    rivals_table,
)
POLICIES: Final = Study(
    "policies",
    "three trainings of a policy, judged on 200 robots",
    15,
    {
        **{f"policy_{seed}.onnx": training("--seed", str(seed)) for seed in TRAININGS},
        f"{UNTRAINED}.onnx": training("--rounds", "0"),
        "judged": judged,
        "curves": judged_on_curves,
    },
    policies_table,
)
