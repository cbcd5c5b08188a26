"""The arithmetic of this machine in numbers: elementary functions, linear algebra, short runs of plants and methods.

Two machines with equal fingerprints compute the same tables bit for bit. Code of users has no part in it.
"""

import hashlib
import math
from collections.abc import Iterable
from contextlib import closing
from dataclasses import replace
from functools import cache

import numpy as np

from servobench.harness.config.registry import is_foreign_controller, is_foreign_plant
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.log import StepLog
from servobench.harness.run.loop import careful, run_loop
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.checks import FloatArray, NamedArrays
from servobench.plant.robot.mismatch import Mismatch

PERIODS = 10  # length of the short run
PLAIN_PLANT = "kinematic"  # on which methods run
PLAIN_METHOD = "constant"  # which plants run with
LIBM = (math.sin, math.cos, math.exp, math.log, math.atan)
UFUNCS = (np.sin, np.cos, np.exp, np.log, np.arctan)


@cache
def elementary() -> NamedArrays:
    """Return values of the C library, of numpy's vector functions and of BLAS and LAPACK, by name."""
    x = np.linspace(0.1, 4.0, 64)
    A = np.arange(64.0).reshape(8, 8) % 7.0 + 8.0 * np.eye(8)
    return {
        "libm": np.array([[f(each) for each in x] for f in LIBM]),
        "ufuncs": np.array([f(x) for f in UFUNCS]),
        "blas": np.array([A @ A.T, np.linalg.inv(A)]),
    }


@cache
def roll_out(plant: str, controller: str) -> FloatArray:
    """Return joints [rad], true feature and commands [rad/s], a row a period, of the first periods of the circle."""
    request = RunRequest(plant, controller, "circle", Mismatch.parse("moderate"), seed=0)
    experiment = build(resolve(request, Settings()))
    log = StepLog(experiment.plant.spec, PERIODS)
    loop = replace(experiment.loop, periods=PERIODS)
    desired = experiment.desired(PERIODS)
    with closing(experiment.plant), careful():
        run_loop(experiment.plant, experiment.controller, desired, loop, request.seed, log)
    steps = log.steps()
    return np.hstack([steps.joint_position, steps.true_feature, steps.command])


def numbers(plants: Iterable[str], controllers: Iterable[str]) -> NamedArrays:
    """Return `elementary`, and a roll-out of each plant and of each controller of this package, by name."""
    values = dict(elementary())
    for name in plants:
        if not is_foreign_plant(name):
            values[name] = roll_out(name, PLAIN_METHOD)
    for name in controllers:
        if not is_foreign_controller(name):
            values[name] = roll_out(PLAIN_PLANT, name)
    return values


def fingerprint(plants: Iterable[str], controllers: Iterable[str]) -> dict[str, str]:
    """Return the SHA-256 of each of `numbers`."""
    return {
        name: hashlib.sha256(each.data).hexdigest()
        for name, each in numbers(plants, controllers).items()
    }
