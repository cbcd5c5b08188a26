"""How costs grow with the number of runs side by side, centres of a network, the horizon and joints: log-log plots.

Only the methods or parts that depend on a size are measured over it. Parts work on a linear robot y = J q, which has
any number of joints.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import numpy as np
from matplotlib.figure import Figure

import measuring
from measuring import METHODS, PERIODS, microseconds, processor_time, resolved_runs
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.estimator import Motion
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.networks.rbf import JacobianNetwork
from servobench.harness.apps.figures import style
from servobench.harness.config.registry import find_controller
from servobench.harness.config.settings import default_config
from servobench.harness.run.episode import carry_out_together
from servobench.plant.contract.signals import Observation, PlantSpec, trusted_observation

PERIOD, FEATURES, BLOCK = 0.05, 3, 128
PREVIEW = 20  # periods
Lead = tuple[int, ...]
Curve = tuple[list[int], list[float]]  # sizes and costs of a period of one run [s]
Curves = dict[str, Curve]


def linear_spec(n: int) -> PlantSpec:
    """Return the spec of n joints and three features."""
    names = tuple(f"q{i}" for i in range(n)), tuple("xyz")
    return PlantSpec.of_joints(*names, np.ones(n), np.full(n, -6.0), np.full(n, 6.0), PERIOD)


def seen(k: int, q: np.ndarray, y: np.ndarray) -> Observation:
    """Return what is observed in period k; every feature is valid."""
    lead = q.shape[:-1]
    return trusted_observation(
        k * PERIOD, q, y, np.ones(lead, dtype=np.bool_)[()], np.ones(y.shape, dtype=np.bool_)
    )


def side_by_side(counts: Sequence[int]) -> Curves:
    """Return the cost of a period of whole runs, building and judging included."""
    curves: Curves = {}
    for method in METHODS:
        runs = resolved_runs("kinematic", method, max(*counts, 4))
        carry_out_together(runs[:1])
        costs = []
        for count in counts:
            began = time.process_time()
            for first in range(0, max(count, 4), count):
                carry_out_together(runs[first : first + count])
            costs.append((time.process_time() - began) / max(count, 4) / PERIODS)
        curves[f"`{method}`"] = list(counts), costs
    return curves


def network(lead: Lead, units: int) -> Callable[[], object]:
    """Return an update and a prediction of a Jacobian network of six joints."""
    rng, n = np.random.default_rng(0), 6
    weights = rng.normal(scale=0.1, size=(n, FEATURES, units))
    offline = JacobianNetwork(rng.normal(size=(n, units, n)), np.ones((n, units)), weights)
    unused, networks = cast(Any, None), cast(Any, SimpleNamespace(jacobian=offline))
    estimator = RbfEstimator(RbfConfig(), unused, networks)
    state, q = estimator.start(np.zeros((*lead, FEATURES, n))), rng.normal(size=(*lead, n))
    dq, dy = rng.normal(scale=0.01, size=(*lead, n)), rng.normal(scale=0.01, size=(*lead, FEATURES))

    def step() -> None:
        nonlocal state, q
        state = estimator.update(state, Motion(q, dq, dy, dy, np.asarray(PERIOD)))
        q = q + dq
        estimator.jacobian(state, q)

    return step


def plan(lead: Lead, horizon: int, reach: float) -> Callable[[], object]:
    """Return a predictive command for six joints and an error of `reach` [m] on each axis."""
    rng, n = np.random.default_rng(0), 6
    J, zero = rng.normal(scale=0.4, size=(*lead, FEATURES, n)), np.zeros((*lead, FEATURES))
    spec = linear_spec(n)
    law = MpcLaw(
        MpcConfig(horizon_time=horizon * spec.period, moves=horizon), RobotKnowledge(spec, horizon)
    )
    observation = seen(0, np.zeros((*lead, n)), zero)
    reference = np.repeat(zero[..., None, :] + reach, horizon + 1, axis=-2)
    state = law.start(observation)
    return lambda: law.command(state, Estimate(J), observation, reference)


def loop(lead: Lead, n: int, method: str) -> Callable[[], object]:
    """Return a period of a whole controller with a linear robot of n joints, which moves to and fro."""
    rng, entry, k = np.random.default_rng(0), find_controller(method), 0
    J = rng.normal(scale=0.4, size=(FEATURES, n))
    nominal = lambda q: np.broadcast_to(J, (*q.shape[:-1], *J.shape))  # noqa: E731
    controller: Any = entry.build(
        default_config(entry), RobotKnowledge(linear_spec(n), PREVIEW, nominal)
    )
    q, noise = rng.normal(size=(*lead, n)), 1e-3 * rng.normal(size=(16, *lead, FEATURES))
    goals = [np.matvec(J, q + 0.3 * rng.normal(size=q.shape)) for _ in range(2)]
    references = [np.repeat(goal[..., None, :], PREVIEW + 1, axis=-2) for goal in goals]
    state = controller.servo.start(seen(0, q, np.matvec(J, q)))

    def step() -> None:
        nonlocal state, q, k
        k += 1
        state, u = controller.servo.step(
            state, seen(k, q, np.matvec(J, q) + noise[k % 16]), references[k // 10 % 2]
        )
        q = q + PERIOD * u

    return step


def curve(
    make: Callable[..., Callable[[], object]],
    lead: Lead,
    sizes: Sequence[int],
    calls: int,
    *more: Any,  # noqa: ANN401
) -> Curve:
    """Return the cost of what `make(lead, size, *more)` returns, for one run."""
    calls = max(calls // 6, 2) if lead else calls
    return list(sizes), [
        processor_time(make(lead, size, *more), calls) / (*lead, 1)[0] for size in sizes
    ]


def sides(lead: Lead) -> str:
    """Return how many runs are side by side, in words."""
    return f"{lead[0]} runs" if lead else "one run"


def draw(panels: dict[str, tuple[str, Curves]], path: Path) -> None:
    """Draw a panel for each size."""
    with style.figure_style():
        figure = Figure(figsize=(measuring.WIDTH, 6.4), layout="constrained")
        for axes, (title, (unit, curves)) in zip(
            figure.subplots(2, 2).flat, panels.items(), strict=True
        ):
            styles = style.method_styles(label.split("`")[1] for label in curves)
            for label, (sizes, costs) in curves.items():
                look = styles[label.split("`")[1]].line_arguments(8) | {
                    "linestyle": ":" if "one run" in label else "-"
                }
                if "limits active" in label:
                    look |= {"color": style.COLOURS["vermilion"]}
                axes.loglog(
                    sizes, [1e6 * cost for cost in costs], **look, label=label.replace("`", "")
                )
            axes.set_xticks(sizes, map(str, sizes))
            axes.minorticks_off()
            axes.set(title=title, xlabel=unit, ylabel="µs a run and period")
            axes.legend(fontsize=6.5)
        measuring.write_picture(figure, path)


def main() -> None:
    """Print a table of exponents, and the picture's line."""
    given = measuring.options(__doc__, quick=measuring.QUICK, picture={"type": Path})
    count, calls = (2, 2) if given.quick else (None, 60)
    sizes = {
        "units": (50, 100, 150, 300, 600),
        "horizon": (4, 7, 10, 20, 40),
        "joints": (3, 6, 12, 24),
    }
    units, horizons, joints = (each[:count] for each in sizes.values())
    panels = {
        "runs side by side": ("runs", side_by_side([2**i for i in range(10)][:count])),
        "units of a network": ("units a joint column", {
            f"`rbf`, {sides((BLOCK,))}": curve(network, (BLOCK,), units, calls)
        }),
        "horizon": ("periods", {
            f"`mpc`, no limit active, {sides((BLOCK,))}": curve(plan, (BLOCK,), horizons, calls, 0.01),
            "`mpc`, limits active, one run": curve(plan, (), horizons, calls, 1.0),
        }),
        "joints": ("joints", {
            f"`ukf_mfac`, {sides(lead)}": curve(loop, lead, joints, calls, "ukf_mfac") for lead in ((), (BLOCK,))
        }),
    }  # fmt: skip
    rows = []
    for title, (_, curves) in panels.items():
        for label, (over, costs) in curves.items():
            ends = f"{microseconds(costs[0])} … {microseconds(costs[-1])} µs"
            power = f"{measuring.exponent(over, costs):+.2f}"
            if len(over) > 5:
                power += f"; from 64 on {measuring.exponent(over[-4:], costs[-4:]):+.2f}"
            rows.append([title, f"{over[0]} … {over[-1]}", label, ends, power])
    print(measuring.table(["size", "from … to", "what", "a run and period", "exponent"], rows))
    if given.picture:
        draw(panels, given.picture)


if __name__ == "__main__":
    main()
