"""The rendered plant without its rendering: motor targets, the view of the workspace, refusals."""

import numpy as np
import pytest

from servobench.plant.bullet.bullet_plant import PHYSICS_STEP, BulletConfig, build_bullet, velocity_targets
from servobench.plant.plant import PlantSetup
from servobench.plant.robot import ur5
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.hand_eye import HandEyeModel

HOME = np.array(ur5.HOME)
BARE = BulletConfig(scenery=False)
MODEL = ur5.nominal_ur5()


def test_velocity_targets_without_lag_are_the_command():
    free = np.full(2, -9.0), np.full(2, 9.0)
    targets = velocity_targets(np.array([1.0, 0.0]), np.array([0.3, -0.2]), 0.0, 4, free)
    np.testing.assert_array_equal(targets, np.tile([0.3, -0.2], (4, 1)))


def test_velocity_targets_follow_the_recursion_and_stop_at_the_limit():
    v, u, decay = np.array([0.5, -0.5]), np.array([1.0, -1.0]), 0.9
    rows = []
    for _ in range(6):
        v = v + (1 - decay) * (u - v)
        rows.append(v)
    start, room = np.array([0.5, -0.5]), (np.full(2, -9.0), np.full(2, 9.0))
    np.testing.assert_allclose(velocity_targets(start, u, decay, 6, room), rows, atol=1e-14)
    tight = np.full(2, -9.0), np.array([0.004, 9.0])
    targets = velocity_targets(start, u, decay, 6, tight)
    assert PHYSICS_STEP * targets[:, 0].sum() == pytest.approx(0.004)
    assert targets[-1, 0] == 0.0
    np.testing.assert_allclose(targets[:, 1], np.array(rows)[:, 1], atol=1e-14)


@pytest.mark.parametrize("height", [0.15, 0.25, 0.35])
def test_the_camera_sees_the_circle_of_the_workspace_with_a_margin(height):
    angle, camera = np.linspace(0, 2 * np.pi, 60), PinholeCamera()
    circle = np.column_stack([0.5 + 0.35 * np.cos(angle), 0.35 * np.sin(angle), np.full(60, height)])
    pixel = camera.project(MODEL.to_camera(circle))
    assert (pixel > 15).all()
    assert (pixel < (camera.width - 15, camera.height - 15)).all()


def test_a_period_that_physics_does_not_divide_is_refused():
    with pytest.raises(
        ValueError, match=r"period must be a whole multiple of the plant's own step of 0\.00416666667 s"
    ):
        build_bullet(BARE, PlantSetup(MODEL, HOME, 0.03))


def test_a_gear_ratio_of_zero_is_refused():
    arm = MODEL.arm
    stuck = SerialArm(arm.joint_names, arm.translation, arm.rpy, arm.joint_offset, np.eye(6)[0], arm.tool)
    with pytest.raises(ValueError, match="gear_ratio must not be zero"):
        build_bullet(BARE, PlantSetup(HandEyeModel(stuck, MODEL.X_BC), HOME, 0.05))
