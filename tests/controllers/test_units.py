"""Natural units: what a controller is told of features, divided by their natural size."""

from dataclasses import replace

import numpy as np
import pytest

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.networks.fit import MIN_SINGULAR_SHARE
from servobench.controllers.units import in_natural_units
from servobench.plant.contract.signals import Channel, PlantSpec


def knowledge(scale, **more):
    spec = PlantSpec.of_joints(("a", "b"), ("u", "v"), [1.0, 1.0], [-3, -3], [3, 3], 0.05, "px")
    feature = Channel(("u", "v"), "px", scale, np.array([0.0, 0.0]), np.array([320.0, np.inf]))
    return RobotKnowledge(replace(spec, feature=feature), 5, **more)


def test_everything_about_features_is_divided_by_their_scale():
    J = np.array([[160.0, 0.0], [32.0, 8.0]])
    given = knowledge(
        16.0,
        nominal_jacobian=lambda q: np.broadcast_to(J, (*q.shape[:-1], 2, 2)),
        true_jacobian=lambda q: 2.0 * J,
        true_symbolic=lambda q: 48.0 * q,
    )
    natural = in_natural_units(given)
    nominal = natural.nominal_jacobian(np.zeros((3, 2)))
    np.testing.assert_array_equal(nominal[2], [[10.0, 0.0], [2.0, 0.5]])
    np.testing.assert_array_equal(natural.true_jacobian(np.zeros(2)), [[20.0, 0.0], [4.0, 1.0]])
    assert natural.true_symbolic(2.0) == 6.0
    assert natural.unit == 16.0
    assert natural.spec.feature.scale == 1.0
    np.testing.assert_array_equal(natural.spec.feature.upper, [20.0, np.inf])
    assert in_natural_units(natural) is natural


def test_nothing_that_is_unknown_becomes_known():
    natural = in_natural_units(knowledge(16.0))
    assert natural.nominal_jacobian is natural.true_jacobian is natural.true_symbolic is None
    one = knowledge(1.0)
    assert in_natural_units(one) is one


@pytest.mark.parametrize("robot", ["ur3", "ur5", "ur10e", "panda"])
def test_the_ideal_controller_keeps_all_directions_of_the_ball_in_3_d(robot):
    from servobench.plant.robot.catalogue import find_robot

    arm = find_robot(robot)
    work = arm.workspace
    q = np.random.default_rng(0).uniform(work.lower, work.upper, (2000, arm.n))
    J = arm.nominal.jacobian(q)
    np.testing.assert_array_equal(np.linalg.pinv(J, rcond=MIN_SINGULAR_SHARE), np.linalg.pinv(J))
