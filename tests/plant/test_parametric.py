"""Features of a robot by its joints and parameters: the features of its model, and derivatives by differences."""

import numpy as np
import pytest

from servobench.harness.config.sensing import find_sensing
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.hand_eye import rotation_matrix
from servobench.plant.robot.parametric import ParametricModel
from servobench.plant.robot.twin import deviated

SENSINGS = ("position", "pixel", "stereo", "plate", "pixel:hand", "plate:hand")
STEP = 1e-6


def parametric(sensing="position", robot="ur5"):
    own = find_robot(robot)
    return ParametricModel(find_sensing(sensing).nominal(own)), np.asarray(own.workspace.home)


def states(model, home, generator):
    """Return four deviating robots with five joint positions each."""
    theta, cameras = model.start((4,))
    step = 0.02 * generator.standard_normal((4, len(model.names)))
    joints = home + 0.05 * generator.standard_normal((4, 5, len(home)))
    return *model.moved(theta, cameras, step), joints


def worst(found, wanted):
    return np.abs(found - wanted).max() / np.abs(wanted).max()


@pytest.mark.parametrize("robot", ["ur5", "panda"])
@pytest.mark.parametrize("sensing", SENSINGS)
def test_without_deviation_features_and_jacobian_are_those_of_the_planned_robot(sensing, robot):
    model, home = parametric(sensing, robot)
    joints = home + np.linspace(-0.05, 0.05, 3)[:, None]
    found = model.derivatives(*model.start(()), joints)
    wanted = model.planned.feature(joints)
    np.testing.assert_allclose(found.feature, wanted, rtol=0, atol=1e-12 * np.abs(wanted).max())
    np.testing.assert_allclose(found.by_joint, model.planned.jacobian(joints), rtol=0, atol=1e-12)


@pytest.mark.parametrize("turning", [False, True])
@pytest.mark.parametrize("sensing", SENSINGS)
def test_derivatives_are_those_of_differences(sensing, turning):
    generator = np.random.default_rng(4)
    model, home = parametric(sensing)
    theta, cameras, joints = states(model, home, generator)
    turn = generator.uniform(-0.1, 0.1, joints.shape[:-1]) if turning else None
    found = model.derivatives(theta, cameras, joints, turn)
    for index in range(len(model.names)):
        step = np.zeros(len(model.names))
        step[index] = STEP
        ahead = model.feature(*model.moved(theta, cameras, step), joints, turn)
        behind = model.feature(*model.moved(theta, cameras, -step), joints, turn)
        difference = (ahead - behind) / (2.0 * STEP)
        scale = np.abs(found.by_parameter).max()
        assert np.abs(found.by_parameter[..., index] - difference).max() < 1e-8 * scale
    for joint, step in enumerate(STEP * np.eye(len(home))):
        ahead = model.feature(theta, cameras, joints + step, turn)
        behind = model.feature(theta, cameras, joints - step, turn)
        assert worst(found.by_joint[..., joint], (ahead - behind) / (2.0 * STEP)) < 1e-7


@pytest.mark.parametrize("sensing", ["position", "pixel"])
def test_parameters_deviate_the_robot_as_those_of_a_twin_do(sensing):
    model, home = parametric(sensing)
    generator = np.random.default_rng(5)
    values = dict(zip(model.names, 0.02 * generator.standard_normal(len(model.names)), strict=True))
    theta, cameras = model.moved(*model.start(()), np.array(list(values.values())))
    joints = home[None]
    twin = deviated(model.planned, values)
    np.testing.assert_allclose(
        model.feature(theta, cameras, joints), twin.feature(joints), rtol=1e-12
    )


def test_a_turned_camera_sees_the_opposite_turn():
    model, home = parametric()
    theta, cameras = model.start(())
    straight = model.feature(theta, cameras, home[None])
    quarter = model.feature(theta, cameras, home[None], np.array([np.pi / 2.0]))
    x, y, z = straight[0]
    np.testing.assert_allclose(quarter[0], (y, -x, z), atol=1e-12)


def test_a_camera_is_placed_where_it_sees_an_arm_that_is_known():
    model, home = parametric()
    generator = np.random.default_rng(6)
    joints = home + 0.3 * generator.standard_normal((40, len(home)))
    theta, cameras = model.start(())
    true = cameras.copy()
    true[0, :3, :3] = cameras[0, :3, :3] @ rotation_matrix([0.3, -0.2, 1.0])
    true[0, :3, 3] += (0.1, -0.2, 0.05)
    seen = model.feature(theta, true, joints)
    found = model.placed(theta, cameras, joints, seen, np.ones(len(joints)))
    # The planned rotation counts a little, too.
    np.testing.assert_allclose(found, true, atol=5e-3)
