"""Time of one unscented update of a 3x6 Jacobian, against filterpy's filter on the same problem in the same run.

filterpy keeps the sigma points it had before the process noise was added. Its result is compared with points redrawn
from P + Q, as the unscented filter asks; its time is taken without that extra work.
"""

from __future__ import annotations

import sys
import time
from functools import partial

import numpy as np

from measuring import asked_to_be_quick, table, times_in_turns
from servobench.controllers.estimators.kalman import UkfConfig, split_update, unscented_update

M, N, MOTIONS, BLOCK = 3, 6, 200, 128
SIZE = M * N
P0, q, r = 1e-2 * np.eye(SIZE), 4e-4, np.float64(2e-6)
Q, R = q * np.eye(SIZE), r * np.eye(M)
CONFIG = UkfConfig(alpha=1.0, beta=2.0, kappa=0.0)
BESIDE = f"split form, {BLOCK} runs side by side"


def motions() -> list[tuple[np.ndarray, np.ndarray]]:
    """Return joint steps (n,) and the feature steps (m,) that a fixed Jacobian and 1 mm of noise make of them."""
    rng = np.random.default_rng(0)
    J = rng.normal(scale=0.4, size=(M, N))
    steps = rng.normal(scale=0.03, size=(MOTIONS, N))
    return [(dq, J @ dq + rng.normal(scale=0.0014, size=M)) for dq in steps]


def sigma_points(data: list[tuple[np.ndarray, np.ndarray]]) -> np.ndarray:
    """Run the project's sigma-point filter and return vec(J)."""
    J, P = np.zeros((M, N)), P0
    for dq, dy in data:
        J, P = unscented_update(J, P + Q, dq, dy, r=r, config=CONFIG)
    return J.ravel()


def split(data: list[tuple[np.ndarray, np.ndarray]], lead: tuple[int, ...] = ()) -> np.ndarray:
    """Run the project's split filter for runs side by side, or for one, and return vec(J) of the first."""
    J, P = np.zeros((*lead, M, N)), np.broadcast_to(P0[:N, :N], (*lead, N, N)).copy()
    for dq, dy in data:
        J, P = split_update(
            J, P + q * np.eye(N), np.tile(dq, (*lead, 1)), np.tile(dy, (*lead, 1)), r=r
        )
    return J.reshape(-1, SIZE)[0]


def filterpy_filter(data: list[tuple[np.ndarray, np.ndarray]], *, redraw: bool) -> np.ndarray:
    """Run filterpy's filter and return vec(J)."""
    from filterpy.kalman import MerweScaledSigmaPoints, UnscentedKalmanFilter

    points = MerweScaledSigmaPoints(SIZE, alpha=1.0, beta=2.0, kappa=0.0)
    ukf = UnscentedKalmanFilter(
        SIZE, M, 1.0, hx=lambda x, dq: x.reshape(M, N) @ dq, fx=lambda x, dt: x, points=points
    )
    ukf.P, ukf.Q, ukf.R = P0.copy(), Q.copy(), R.copy()
    for dq, dy in data:
        ukf.predict()
        if redraw:
            ukf.sigmas_f = points.sigma_points(ukf.x, ukf.P)
        ukf.update(dy, dq=dq)
    return np.asarray(ukf.x)


def main() -> None:
    """Compare results and times; exit with 1 when a result differs."""
    rounds = 1 if asked_to_be_quick(__doc__) else 7
    try:
        import filterpy  # noqa: F401 - only to see whether it is there
    except ImportError as error:
        print(
            f"The comparison with filterpy is left out: {error}; `pip install filterpy` into this environment.\n"
        )
        return
    data = motions()
    reference = filterpy_filter(data, redraw=True)
    own = {"sigma points": sigma_points, "split form": split, BESIDE: partial(split, lead=(BLOCK,))}
    worst = max(float(np.abs(run(data) - reference).max()) for run in own.values())
    calls = {"filterpy": partial(filterpy_filter, data, redraw=False)}
    calls |= {name: partial(run, data) for name, run in own.items()}
    measured = times_in_turns(calls, rounds, time.perf_counter)
    times = {
        name: min(each) / MOTIONS / (BLOCK if name == BESIDE else 1)
        for name, each in measured.items()
    }
    rows = [
        [name, f"{1e6 * each:.1f} µs", f"{times['filterpy'] / each:.1f}"]
        for name, each in times.items()
    ]
    print(table(["unscented update of a 3 × 6 Jacobian", "an update", "filterpy / this"], rows))
    print(f"Largest difference of an entry of J after {MOTIONS} motions: {worst:.1e} m/rad.\n")
    if worst > 1e-9:
        sys.exit("ukf_update: another result than that of filterpy")


if __name__ == "__main__":
    main()
