"""Bounds are given the kinematics of rippled gears; what has no gears, tool or turning camera says so in one line."""

import casadi
import numpy as np
import pytest

from kit.plants import NEEDS_MUJOCO
from servobench.harness.config.settings import Settings
from servobench.harness.pictures.replay import logged_run
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.export import arm_product
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot.mismatch import Mismatch


def test_bounds_are_given_the_kinematics_of_rippled_gears():
    request = RunRequest("kinematic", "calibrated", "circle", Mismatch.parse("moderate+ripple=0.03rad"), 3)
    experiment = build_experiment(request, Settings())
    experiment.plant.reset(0)
    truth, start = experiment.plant.truth(), np.asarray(experiment.scenario.start)
    knowledge = experiment.controller.servo.knowledge
    np.testing.assert_allclose(knowledge.true_jacobian(start), truth.jacobian, atol=1e-12)
    q = casadi.MX.sym("q", 6)
    feature = casadi.Function("h", [q], [knowledge.true_symbolic(q)])
    np.testing.assert_allclose(feature(start).full().ravel(), truth.feature, atol=1e-12)


@NEEDS_MUJOCO
def test_worlds_without_gears_and_tool_are_refused_in_one_line():
    mismatch = Mismatch.parse("moderate+backlash=2deg")
    with pytest.raises(ConfigurationError, match="mujoco has no mechanics.backlash, .*those of kinematic and fmu"):
        resolve(RunRequest("mujoco", "regression_mfac", "circle", mismatch, 3), Settings())
    with pytest.raises(ConfigurationError, match="an arm is exported without backlash: leave it out, and set"):
        arm_product(RunRequest("kinematic", "regression_mfac", "circle", mismatch, 3), "words")


def test_a_run_under_a_turning_camera_is_not_filmed():
    request = RunRequest("kinematic", "regression_mfac", "circle", Mismatch.parse("moderate+camera_turn=15deg"), 3)
    result = run_experiment(request, Settings())
    with pytest.raises(ConfigurationError, match="cannot be shown: films have no camera that turns"):
        logged_run(result.row, result.steps)
