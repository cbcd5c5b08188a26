"""The rendered plant without its rendering: the view of the workspace, refusals."""

import numpy as np
import pytest

from kit.plants import NEEDS_BULLET, configure, nominal_ur5
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.rendered.plants import BULLET
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot import ur5
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.camera import PinholeCamera
from servobench.plant.robot.hand_eye import HandEyeModel

HOME = np.array(ur5.HOME)
BARE = RenderedConfig(scenery=False)
MODEL = nominal_ur5()


@pytest.mark.parametrize("height", [0.15, 0.25, 0.35])
def test_the_camera_sees_the_circle_of_the_workspace_with_a_margin(height):
    angle, camera = np.linspace(0, 2 * np.pi, 60), PinholeCamera()
    circle = np.column_stack([0.5 + 0.35 * np.cos(angle), 0.35 * np.sin(angle), np.full(60, height)])
    pixel = camera.project(MODEL.to_camera(circle))
    assert (pixel > 15).all()
    assert (pixel < (camera.width - 15, camera.height - 15)).all()


@NEEDS_BULLET
def test_a_period_that_physics_does_not_divide_is_refused():
    with pytest.raises(ValueError, match=r"period must be a whole multiple of the plant's own step of 0\.001 s"):
        BULLET.build(configure(RenderedConfig, scenery=False, latency=0.0), PlantSetup(MODEL, HOME, 0.0305))


@NEEDS_BULLET
def test_a_gear_ratio_of_zero_is_refused():
    arm = MODEL.arm
    stuck = SerialArm(arm.joint_names, arm.translation, arm.rpy, arm.joint_offset, np.eye(6)[0], arm.tool)
    with pytest.raises(ValueError, match="gear_ratio must not be zero"):
        BULLET.build(BARE, PlantSetup(HandEyeModel(stuck, MODEL.X_BC), HOME, 0.05))


def test_an_obstacle_that_is_no_box_is_refused():
    with pytest.raises(ValueError, match="obstacles"):
        RenderedConfig(obstacles=((0.1, 0.2, 0.3),))
