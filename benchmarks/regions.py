"""How wrong the learned Jacobian is over the whole working region, after 1, 3 and 10 s of a run.

    python benchmarks/regions.py --robots 20 --first 88700

At each instant the estimates of the regression and of the calibrated arm are asked for their Jacobians at joint
positions that are spread evenly over the working region; the arm does not move for it. Shown are medians over the
robots of ‖Ĵ − J‖/‖J‖ (Frobenius, over all positions), and how far the arm's features are from the true ones.
"""

from collections.abc import Iterable, Iterator
from typing import Final, NamedTuple

import numpy as np
from scipy.stats import qmc

from measuring import options, table
from servobench.controllers.servo import ServoController
from servobench.harness.apps.studies.challenge import find_challenge
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import Experiment, build
from servobench.harness.run.loop import begin, careful, periods
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.checks import FloatArray

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


def positions(controller: ServoController) -> FloatArray:
    """Return joint positions (k, n) [rad] all over the working region."""
    knowledge = controller.servo.knowledge
    assert knowledge.region is not None
    lower, upper = knowledge.region
    evenly = qmc.Sobol(len(lower), seed=1).random(POSITIONS)
    return np.asarray(qmc.scale(evenly, lower, upper))


def errors(experiment: Experiment, seed: int) -> Iterator[Errors]:
    """Yield what is wrong at each instant of a run."""
    controller = experiment.controller
    assert isinstance(controller, ServoController)
    rollout = begin(
        experiment.plant, controller, experiment.desired(), experiment.loop, (seed, seed)
    )
    left = list(INSTANTS)
    with careful():
        for period in periods(rollout, controller):
            if left and period.observation.time >= left[0] - 1e-9:
                left.pop(0)
                yield _wrong(controller, experiment)
            if not left:
                return


def _wrong(controller: ServoController, experiment: Experiment) -> Errors:
    servo = controller.servo
    state = controller.state
    calibration = servo.calibration
    true = experiment.drawn.true
    assert state is not None
    assert state.calibration is not None
    assert calibration is not None
    assert true is not None
    scale = servo.knowledge.unit
    wanted: list[FloatArray] = []
    regressed: list[FloatArray] = []
    calibrated: list[FloatArray] = []
    places: list[FloatArray] = []
    for q in positions(controller):
        wanted.append(true.jacobian(q))
        regressed.append(scale * servo.estimation.ahead(state.estimation, q)[0])
        ahead = calibration.ahead(state.calibration, q, np.zeros(()))
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
        runs = [cell.request for cell in cells if cell.request.controller == METHOD]
        found = [list(errors(build(resolve(run, Settings())), run.seed)) for run in runs]
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
