"""How wrong the learned Jacobian is over the whole working region, after 1, 3 and 10 s of a run.

    python benchmarks/regions.py --robots 20 --first 88700

At each instant the estimates of the regression and of the calibrated arm are asked for their Jacobians at joint
positions that are spread evenly over the working region; the arm does not move for it. Shown are medians over the
robots of ‖Ĵ − J‖/‖J‖ (Frobenius, over all positions), and how far the arm's features are from the true ones.
"""

from collections.abc import Iterable
from typing import Any, Final, NamedTuple

import numpy as np
from scipy.stats import qmc

from measuring import options, table
from servobench.harness.apps.studies.challenge import find_challenge
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.loop import begin, careful, periods
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_seed

METHOD: Final = "calibrating_mfac"
CHALLENGES: Final = ("gears50", "zeros90", "zeros180_tour", "unknown_arm_tour")
INSTANTS: Final = (1.0, 3.0, 10.0)  # [s]
POSITIONS: Final = 64


class Errors(NamedTuple):
    """What is wrong over the region at an instant."""

    regression: float  # [1] of its Jacobian
    arm: float  # [1] of the arm's Jacobian
    place: float  # [m] median distance of the arm's features from the true ones
    believed: bool  # whether the method uses the arm


def evenly(region: tuple[FloatArray, FloatArray]) -> FloatArray:
    """Return joint positions (k, n) [rad] all over a box of joint positions."""
    lower, upper = region
    shares = qmc.Sobol(len(lower), seed=1).random(POSITIONS)
    return np.asarray(qmc.scale(shares, lower, upper))


def errors(request: RunRequest) -> list[Errors]:
    """Return what is wrong at each instant of a run."""
    experiment = build(resolve(request, Settings()))
    plant = experiment.plant
    controller = experiment.controller
    seeds = named_seed(request.seed, "plant"), named_seed(request.seed, "controller")
    rollout = begin(plant, controller, experiment.desired(), experiment.loop, seeds)
    found: list[Errors] = []
    with careful():
        for period in periods(rollout, controller):
            if period.observation.time >= INSTANTS[len(found)] - 1e-9:
                found.append(_wrong(controller, experiment.drawn.true))
            if len(found) == len(INSTANTS):
                break
    return found


def _wrong(controller: Any, true: Any) -> Errors:  # noqa: ANN401 - a `ServoController`, and the true robot
    servo = controller.servo
    state = controller.state
    scale = servo.knowledge.unit
    wanted: list[FloatArray] = []
    regressed: list[FloatArray] = []
    calibrated: list[FloatArray] = []
    places: list[FloatArray] = []
    for q in evenly(servo.knowledge.region):
        wanted.append(true.jacobian(q))
        regressed.append(scale * servo.estimation.ahead(state.estimation, q)[0])
        ahead = servo.calibration.ahead(state.calibration, q, np.zeros(()))
        calibrated.append(scale * ahead.jacobian)
        places.append(scale * ahead.feature - true.feature(q))
    size = np.linalg.norm(wanted)
    return Errors(
        regression=float(np.linalg.norm(np.subtract(regressed, wanted)) / size),
        arm=float(np.linalg.norm(np.subtract(calibrated, wanted)) / size),
        place=float(np.median(np.linalg.norm(places, axis=-1))),
        believed=bool(state.calibration.used),
    )


def shown(values: Iterable[float], factor: float, digits: int) -> str:
    """Return the median and the 90 % quantile of values."""
    middle, high = factor * np.quantile(list(values), (0.5, 0.9))
    return f"{middle:.{digits}f} ({high:.{digits}f})"


def main() -> None:
    """Print a row for each world and instant: medians over the robots, with 90 % quantiles."""
    chosen = options(__doc__, robots=(20, "how many"), first=(88700, "seed of the first robot"))
    seeds = range(chosen.first, chosen.first + chosen.robots)
    rows = []
    for name in CHALLENGES:
        cells = find_challenge(name).cells(("kinematic",), (METHOD,), seeds)
        found = [errors(cell.request) for cell in cells if cell.request.controller == METHOD]
        for instant, each in zip(INSTANTS, zip(*found, strict=True), strict=True):
            row = [
                shown((one.regression for one in each), 100.0, 1),
                shown((one.arm for one in each), 100.0, 1),
                shown((one.place for one in each), 1000.0, 1),
                f"{sum(one.believed for one in each)} of {len(each)}",
            ]
            rows.append([f"`{name}`", f"{instant:g} s", *row])
    header = ("challenge", "after", "regression [%]", "arm [%]", "places [mm]", "arm believed")
    print(table(header, rows))


if __name__ == "__main__":
    main()
