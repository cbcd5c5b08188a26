"""Bounds know how the camera turns and how gears ripple: they follow where an untold one cannot."""

from __future__ import annotations

import casadi
import numpy as np
import pytest

from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.lanes import side_by_side_key
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.turning import turned
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.robot.mismatch import Mismatch


def request(controller, mismatch, sensing="position"):
    return RunRequest("kinematic", controller, "circle", Mismatch.parse(mismatch), 3, sensing=sensing)


def test_places_turn_about_the_optical_axis():
    np.testing.assert_allclose(
        turned(np.array([[1.0, 0.0, 2.0], [0.0, 1.0, 3.0]]), np.pi / 2), [[0, 1, 2], [-1, 0, 3]], atol=1e-15
    )


def test_a_bound_follows_a_circle_under_a_turning_camera_and_logs_its_jacobian():
    result = run_experiment(request("calibrated", "moderate+camera_turn=15deg"), Settings())
    assert result.row["outcome"] == "followed"
    assert result.row["rms_error_evaluated"] < 0.003
    assert result.steps["jacobian_error"].iloc[-1] < 0.05
    fixed = run_experiment(request("calibrated", "moderate"), Settings()).row
    assert result.row["rms_error_evaluated"] < 2.0 * fixed["rms_error_evaluated"]


def test_a_bound_under_a_turning_camera_runs_by_itself():
    keys = [
        side_by_side_key(resolve(request(controller, mismatch), Settings())) is None
        for controller in ("calibrated", "map_mfac")
        for mismatch in ("moderate", "moderate+camera_turn=15deg")
    ]
    assert keys == [False, True, False, False]


def test_a_bound_under_a_turning_camera_needs_the_place_of_the_ball():
    with pytest.raises(ConfigurationError, match="knows of camera_turn with --sensing position only"):
        build_experiment(request("calibrated", "moderate+camera_turn=15deg", "pixel"), Settings())


def test_bounds_are_given_the_kinematics_of_rippled_gears():
    experiment = build_experiment(request("calibrated", "moderate+ripple=0.03rad"), Settings())
    experiment.plant.reset(0)
    truth, start = experiment.plant.truth(), np.asarray(experiment.scenario.start)
    knowledge = experiment.controller.servo.knowledge
    np.testing.assert_allclose(knowledge.true_jacobian(start), truth.jacobian, atol=1e-12)
    q = casadi.MX.sym("q", 6)
    feature = casadi.Function("h", [q], [knowledge.true_symbolic(q)])
    np.testing.assert_allclose(feature(start).full().ravel(), truth.feature, atol=1e-12)
