"""What only the rendered plant on MuJoCo has, and how near it is to the one on PyBullet."""

# ruff: noqa: E402 - MuJoCo is an extra
from dataclasses import replace

import numpy as np
import pytest

mujoco = pytest.importorskip("mujoco", reason="the extra mujoco is not installed")

from kit.plants import NEEDS_BULLET, mismatched
from kit.rendered import BARE, HOME, IDEAL, MODEL, UR5, build
from servobench.plant.contract.faults import PlantDiverged
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.mujoco import MujocoScene, describe_renderer
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import DriveConfig
from servobench.plant.robot.camera import PinholeCamera

ROBOTS = 4
SMOOTH = replace(BARE, encoder_resolution=0.0, room_contact=False)


@pytest.fixture
def engine():
    return "mujoco"


def swing(plant, periods=40):
    """Return the joint positions under slow sines, (periods, 6) rad."""
    plant.reset(0)
    rates = np.linspace(1.0, 3.0, 6)
    commands = [0.4 * np.sin(rates * 0.05 * k + np.arange(6)) for k in range(periods)]
    return np.array([plant.step(Command(u)).joint_position for u in commands])


@NEEDS_BULLET
@pytest.mark.parametrize("seed", range(ROBOTS))
def test_joints_move_as_on_bullet_to_a_milliradian(seed):
    paths = {}
    for name in ("bullet", "mujoco"):
        plant = build(SMOOTH, model=mismatched("moderate+gear_ratio=5%", seed), engine=name)
        paths[name] = swing(plant)
        plant.close()
    apart = np.abs(paths["mujoco"] - paths["bullet"])
    assert np.ptp(paths["bullet"], axis=0).min() > 0.2
    assert 1e-6 < apart.max() < 2e-3


@NEEDS_BULLET
def test_without_friction_the_engines_differ_by_their_integrators_alone():
    smooth = DriveConfig(coulomb_friction=(0.0,), viscous_friction=(0.0,), payload=0.9)
    paths = []
    for name in ("bullet", "mujoco"):
        plant = build(replace(SMOOTH, drives=smooth), engine=name)
        paths.append(swing(plant))
        plant.close()
    np.testing.assert_allclose(paths[0], paths[1], atol=5e-5)


def test_a_joint_with_weak_motors_stays_behind_as_its_torque_limit_says(open_plant):
    strong, weak = (
        swing(open_plant(replace(SMOOTH, drives=DriveConfig(torque_limit=limit))), 20)
        for limit in (
            (150.0, 150.0, 150.0, 28.0, 28.0, 28.0),
            (150.0, 40.0, 150.0, 28.0, 28.0, 28.0),
        )
    )
    assert np.abs(strong - weak)[:, 1].max() > 0.01


def test_joints_stay_at_rest_under_a_known_load(open_plant):
    plant = open_plant(replace(SMOOTH, drives=DriveConfig(payload=2.5, assumed_payload=2.5)))
    plant.reset(0)
    for _ in range(20):
        q = plant.step(Command(np.zeros(6))).joint_position
    np.testing.assert_allclose(q, HOME, atol=1e-5)


@NEEDS_BULLET
def test_a_camera_sees_the_ball_where_that_of_bullet_sees_it():
    seen = []
    for name in ("bullet", "mujoco"):
        plant = build(IDEAL, engine=name)
        plant.reset(0)
        seen.append([plant.step(Command(np.full(6, 0.2))).feature for _ in range(4)])
        plant.close()
    np.testing.assert_allclose(*seen, atol=1e-6)


@NEEDS_BULLET
def test_depths_are_those_of_bullet_but_at_edges():
    from servobench.plant.rendered.bullet import BulletScene

    camera, depths = PinholeCamera(), []
    for kind in (BulletScene, MujocoScene):
        scene = kind(Room(MODEL.arm, scenery=True, robot=UR5))
        scene.place(HOME)
        depths.append(camera.metric_depth(scene.render(camera, MODEL.X_BC)[1]))
        scene.close()
    assert np.isclose(*depths, atol=1e-3).mean() > 0.98


def test_an_image_larger_than_any_before_is_rendered_and_white_beyond_the_floor(open_scene):
    scene = open_scene(scenery=False)
    rgb, depth = scene.render(PinholeCamera(1000, 900), MODEL.X_BC)
    assert rgb.shape == (900, 1000, 3)
    assert (rgb[depth == 1.0] == 255).all()
    assert 0.5 < (depth == 1.0).mean() < 1.0


def test_joint_angles_that_are_not_finite_end_the_run_and_leave_no_file(
    open_plant, monkeypatch, tmp_path
):
    monkeypatch.chdir(tmp_path)
    plant = open_plant()
    plant.reset(0)
    drives = plant.world._simulation._drives
    monkeypatch.setattr(drives, "step", lambda: drives.torque.fill(np.nan))
    with pytest.raises(PlantDiverged, match="joint positions are not finite"):
        plant.step(Command(np.zeros(6)))
    assert list(tmp_path.iterdir()) == []


def test_closing_frees_the_context_and_may_be_repeated(open_plant):
    plant = open_plant()
    plant.reset(0)
    plant.close()
    plant.close()
    assert plant.world._scene._gl is None


def test_the_engine_is_named_with_what_renders():
    assert describe_renderer().startswith(f"MuJoCo {mujoco.__version__}, rendered by ")


def test_a_window_is_refused(open_plant):
    with pytest.raises(ValueError, match="view needs the plant bullet: mujoco opens no window"):
        open_plant(replace(BARE, view=True))
