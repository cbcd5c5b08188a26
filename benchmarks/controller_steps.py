"""Processor time of a step of each named method over a real closed loop, all in one run: the circle on `kinematic`.

Every method drives a plant of its own and the methods take turns of some steps each, so that a disturbance meets all
alike while each finds its data in the caches as in a run of its own. What is timed is `Controller.step` with one
thread; the first steps, in which solvers are made, do not count, and processor time leaves out waiting for a processor.
The paper claims that the proposed method's update costs less than an optimising controller: the last lines are that
claim, for its method, which costs about as much, and for the better one, which must cost less.
Run it from an installed checkout: `python benchmarks/controller_steps.py`.
"""

from __future__ import annotations

import argparse
import sys
import time

import numpy as np
from threadpoolctl import threadpool_limits

from servobench.harness.config.registry import CONTROLLERS
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.request import RunRequest
from servobench.plant.seeds import named_seed

PROPOSED, BETTER, OPTIMISING = "rbfnn_mfac", "rbfnn_mfac_plus", "ukf_mpc"
WARM_UP = 20  # steps
TURN = 20  # steps


class Loop:
    """One method in closed loop with its plant."""

    def __init__(self, request: RunRequest) -> None:
        """Build both and put them at the start."""
        self._experiment = build_experiment(request, Settings())
        self._observation = self._experiment.plant.reset(named_seed(request.seed, "plant"))
        self._experiment.controller.reset(self._observation, named_seed(request.seed, "controller"))
        run = self._experiment.run
        self._desired = self._experiment.scenario.reference.sampled(run.period, self._experiment.periods + run.preview)
        self.times: list[float] = []

    def advance(self) -> None:
        """Take a step and note what the controller's part of it cost, s."""
        experiment, k = self._experiment, len(self.times)
        desired = self._desired[k : k + 1 + experiment.run.preview]
        began = time.process_time()
        command = experiment.controller.step(self._observation, desired)
        self.times.append(time.process_time() - began)
        self._observation = experiment.plant.step(command)

    @property
    def finished(self) -> bool:
        """Whether the task is done."""
        return len(self.times) >= self._experiment.periods


def main() -> None:
    """Print medians, 95th percentiles and ratios to the optimising method.

    Raises:
        SystemExit: the better method's step is not the cheaper one.
    """
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--mismatch", default="moderate")
    parser.add_argument("--seed", type=int, default=0)
    options = parser.parse_args()
    loops = {
        name: Loop(RunRequest("kinematic", name, "circle", options.mismatch, options.seed)) for name in CONTROLLERS
    }
    with threadpool_limits(1):
        while not loops[OPTIMISING].finished:
            for loop in loops.values():
                for _ in range(TURN):
                    loop.advance()
    times = {name: 1e6 * np.array(loop.times[WARM_UP:]) for name, loop in loops.items()}
    medians = {name: float(np.median(steps)) for name, steps in times.items()}
    for name, steps in times.items():
        ratio = medians[name] / medians[OPTIMISING]
        late = float(np.percentile(steps, 95))
        print(f"{name:16} median {medians[name]:6.1f} µs   95 % {late:6.1f} µs   {ratio:5.2f} × {OPTIMISING}")
    ratios = {name: medians[name] / medians[OPTIMISING] for name in (PROPOSED, BETTER)}
    for name, ratio in ratios.items():
        print(f"{name} / {OPTIMISING}: {ratio:.2f}")
    if ratios[BETTER] >= 1.0:
        sys.exit(f"controller_steps: a step of {BETTER} costs {ratios[BETTER]:.2f} times one of {OPTIMISING}")


if __name__ == "__main__":
    main()
