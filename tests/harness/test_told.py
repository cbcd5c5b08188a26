"""Bounds are given the kinematics of the true robot with its rippled gears."""

from __future__ import annotations

import casadi
import numpy as np

from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.request import RunRequest
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
