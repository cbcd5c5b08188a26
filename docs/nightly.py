"""Checks of the pages that take hours: every pair of law and estimator, 100 robots in each world, the claims.

    make nightly        # or: PYTHONPATH=tests python docs/nightly.py FOLDER

The same call goes on after an interruption. The figures that it expects are those of the pages: the table "Where they
break, in numbers" of docs/methods.md and docs/claims/answers.csv. Exit code 1 and a line each where they do not hold.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pandas as pd

from kit.documents import names, read, section, tables
from servobench.controllers.parts import ESTIMATORS, LAWS
from servobench.harness.analysis.comparison import settling_times
from servobench.harness.batch.results import load_runs

ROBOTS = 100
ROUNDING = 3  # robots of which another processor may decide otherwise
SEEDS = f"500:{500 + ROBOTS}"
PAIRS = ",".join(f"{law}+{estimator}" for law in LAWS for estimator in ESTIMATORS)
MISMATCHES = (
    "severe",
    "moderate+camera_rotation=60deg",
    "moderate+camera_rotation=120deg",
    "moderate+links=20%+tool=60mm",
)
MOVE = "moderate+camera_move=45deg"
METHODS = "rbfnn_mfac,rbf_pid,ukf_mfac,ukf_mpc"
SWEEPS = {
    "pairs": ("--plants", "kinematic", "--controllers", PAIRS, "--seeds", "500:504"),
    "worse": ("--plants", "fmu", "--controllers", METHODS, "--seeds", SEEDS, "--mismatch", ",".join(MISMATCHES)),
    "late": ("--plants", "fmu", "--controllers", METHODS, "--seeds", SEEDS, "--latency", "0.05,0.1"),
    "moved": (
        "--plants",
        "fmu",
        "--controllers",
        METHODS,
        "--seeds",
        SEEDS,
        "--mismatch",
        MOVE,
        "--set",
        "random.duration=16",
    ),
}


def main(folder: Path) -> int:
    """Carry out what is not there yet in `folder`, print every figure that does not hold, and return their number."""
    for name, options in SWEEPS.items():
        servobench("sweep", *options, "--out", str(folder / name), *going_on(folder / name))
    problems = [*unfinished_pairs(load_runs(folder / "pairs")), *changed_counts(folder)]
    claims = folder / "claims"
    answers = Path("docs") / "claims" / "answers.csv"
    if servobench("claims", "--out", str(claims), "--check", str(answers), *going_on(claims)):
        problems.append("the answers to the claims differ from docs/claims/answers.csv")
    print("\n".join(problems) or "every figure of the pages holds")  # noqa: T201 - the output of the command
    return len(problems)


def servobench(*arguments: str) -> int:
    """Run one command of the package and return its exit code."""
    return subprocess.run([sys.executable, "-m", "servobench", *arguments], check=False).returncode


def going_on(folder: Path) -> tuple[str, ...]:
    """Return the option that continues what `folder` holds already."""
    return ("--resume",) if folder.exists() else ()


def unfinished_pairs(runs: pd.DataFrame) -> Iterator[str]:
    """Yield a line for each pair of which a run did not complete."""
    for controller, group in runs[runs["status"] != "completed"].groupby("controller"):
        yield f"{controller}: {len(group)} runs ended as {', '.join(sorted(group['status'].unique()))}"


def changed_counts(folder: Path) -> Iterator[str]:
    """Yield a line for each count of settled robots that is not the one in docs/methods.md."""
    worse, late, moved = (load_runs(folder / name) for name in ("worse", "late", "moved"))
    worlds = [worse[worse["mismatch"] == mismatch] for mismatch in MISMATCHES]
    worlds += [late[late["latency_s"] == latency] for latency in (0.05, 0.1)] + [moved]
    header, rows = next(
        (header, rows)
        for _, header, rows in tables(section(read("methods.md"), "Where they break, in numbers"))
        if header[0] == "world"
    )
    for world, row in zip(worlds, rows, strict=True):
        for method, cell in zip(header[1:], row[1:], strict=True):
            came = int(settling_times(world[world["controller"] == names(method)[0]]).notna().sum())
            if abs(came - int(cell)) > ROUNDING:
                yield f"{names(method)[0]}, {row[0]}: {came} robots settled, the page says {cell}"


if __name__ == "__main__":
    sys.exit(1 if main(Path(sys.argv[1])) else 0)
