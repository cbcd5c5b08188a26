"""The log of a run made by hand: a move of 1 m along x in four periods of 1 s, whose figures are known."""

import numpy as np

from servobench.harness.run.log import Period, StepLog
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth

SPEC = PlantSpec.of_joints(("a", "b"), ("x", "y"), np.full(2, 2.0), np.full(2, -9.0), np.full(2, 9.0), period=1.0)
X = (0.0, 0.5, 1.0, 1.0)
VELOCITY = (2.0, -2.0, 1.0, 0.0)  # of joint a; its limit is 2
CONDITION = (1.0, 3.0, 2.0, 1.0)
ESTIMATE = (1.2, 1.4, None, None)  # times the true Jacobian


def straight_move(diagnostics=({}, {}, {}, {}), periods=4, milliseconds=(0.001, 0.002, 0.003, 0.004)):
    """Return the log of so many periods; the fourth has no valid feature. A step of the controller takes so long."""
    log = StepLog(SPEC, 4)
    for k in range(periods):
        jacobian = np.diag([CONDITION[k], 1.0])
        period = Period(
            Observation(float(k), [0.1 * k, 0.0], [X[k] + 0.01, 0.0], k < 3),
            np.array([[1.0, 0.0]]),
            Command([VELOCITY[k], 0.0]),
            Truth(np.array([X[k], 0.0]), jacobian),
            (int(1e6 * milliseconds[k]), 5000),
        )
        log.add(period, None if ESTIMATE[k] is None else ESTIMATE[k] * jacobian, diagnostics[k])
    return log
