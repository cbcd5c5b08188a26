"""The limit of `kinematic` with `ukf_mfac:published`: its bare arithmetic, in C and in numpy for many runs."""

from __future__ import annotations

import subprocess
import tempfile
import time
from pathlib import Path

import numpy as np

from measuring import PERIODS, asked_to_be_quick, microseconds, resolved_runs, table
from servobench.harness.run.episode import carry_out_together
from servobench.plant.contract.checks import FloatArray
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.ur5 import HOME

PERIOD, KEPT = 0.05, np.exp(-1.0)  # [s]; share of a joint's velocity that is left after a period
RHO, LAMBDA = 0.287, 0.00163  # gains of the law
# Variances of the filter, smallest motion [rad]
WALK, NOISE, START, LEAST = (1.04e-4, 2e-6, 4.65e-5, 0.002)
SOURCE = Path(__file__).with_name("bare_loop.c")


def bare_numpy(runs: int) -> float:
    """Return the processor time of a period of one run [s], all runs in one array; the arms are nominal ones."""
    rng, arm, eye, m, n = np.random.default_rng(0), find_robot("ur5").nominal, np.eye(6), 3, 6
    q = np.array(HOME) + 0.05 * rng.normal(size=(runs, n))
    v = sent = np.zeros((runs, n))
    y, J, _ = arm.observe(q)
    goal, P = y + 0.1 * rng.normal(size=(runs, m)), np.tile(START * eye, (runs, 1, 1))
    seen_q, seen_y = q, y
    noise = 1e-3 * rng.normal(size=(PERIODS, runs, m))
    began = time.process_time()
    for k in range(PERIODS):
        y = arm.feature(q) + noise[k]
        dq, dy, seen_q, seen_y = q - seen_q, y - seen_y, q, y
        J, P = _learn(J, P, dq, dy, eye)
        gram = J @ J.mT + LAMBDA * eye[:m, :m]
        u = np.vecmat(np.linalg.solve(gram, (RHO / PERIOD) * (goal - y)[..., None])[..., 0], J)
        u = u / np.maximum(np.abs(u).max(axis=-1, keepdims=True), 1.0)
        q = q + PERIOD * ((1.0 - KEPT) * v + KEPT * sent)
        v, sent = KEPT * v + (1.0 - KEPT) * sent, u
    return (time.process_time() - began) / runs / PERIODS


def _learn(
    J: FloatArray, P: FloatArray, dq: FloatArray, dy: FloatArray, eye: FloatArray
) -> tuple[FloatArray, FloatArray]:
    """Return Jacobians and covariances after a motion; those that hardly moved stay."""
    wide = P + WALK * eye
    seen = np.matvec(wide, dq)
    gain = seen / (np.vecdot(dq, seen) + NOISE)[:, None]
    moved = (np.vecdot(dq, dq) >= LEAST**2)[:, None, None]
    learned = J + (dy - np.matvec(J, dq))[..., None] * gain[:, None, :]
    return np.where(moved, learned, J), np.where(
        moved, wide - gain[..., None] * seen[:, None, :], P
    )


def bare_c(runs: int) -> float:
    """Return the same for the loop in C, with an arm of its own for each run."""
    with tempfile.TemporaryDirectory() as scratch:
        program = f"{scratch}/bare_loop"
        subprocess.run(
            ["cc", "-O3", "-march=native", "-o", program, str(SOURCE), "-lm"], check=True
        )
        printed = subprocess.run(
            [program, str(runs)], capture_output=True, text=True, check=True
        ).stdout
    return 1e-9 * float(printed.split()[0])


def block(runs: int) -> float:
    """Return the same for the package, with building and judging."""
    resolved = resolved_runs("kinematic", "ukf_mfac:published", runs)
    began = time.process_time()
    carry_out_together(resolved)
    return (time.process_time() - began) / runs / PERIODS


def main() -> None:
    """Print a table."""
    runs, rounds = (4, 1) if asked_to_be_quick(__doc__) else (128, 5)
    limit = bare_c(8 * runs)
    costs = {
        "C, one run after the other": limit,
        f"numpy, {runs} runs side by side": min(bare_numpy(runs) for _ in range(rounds)),
        f"numpy, {8 * runs} runs side by side": min(bare_numpy(8 * runs) for _ in range(rounds)),
        f"the package, a block of {runs}": min(block(runs) for _ in range(rounds + 1)),
    }
    rows = [
        [name, f"{microseconds(cost)} µs", f"{cost / limit:.1f}"] for name, cost in costs.items()
    ]
    print(
        table(["bare arithmetic of `kinematic` with `ukf_mfac:published`", "a period", "× C"], rows)
    )


if __name__ == "__main__":
    main()
