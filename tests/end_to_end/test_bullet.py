"""What only the rendered plant on PyBullet has: its physics, its files, its worlds."""

# ruff: noqa: E402 - PyBullet is an extra
import sys
import tempfile
from dataclasses import replace

import numpy as np
import pytest

pybullet = pytest.importorskip(
    "pybullet", reason="PyBullet is not installed; from Python 3.12 on it has no wheel"
)

from kit.rendered import BARE, HOME, IDEAL, MODEL, UR5
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.faults import PlantDiverged
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.bullet import BulletSimulation
from servobench.plant.rendered.drives import PHYSICS_STEP
from servobench.plant.rendered.engine import Machine
from servobench.plant.rendered.plants import BULLET
from servobench.plant.rendered.settings import DriveConfig


@pytest.fixture
def engine():
    return "bullet"


def test_loading_leaves_no_files_behind_even_when_it_fails(open_plant, tmp_path, monkeypatch):
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    open_plant()
    assert list(tmp_path.iterdir()) == []

    def crash(*_, **__):
        raise pybullet.error("cannot load")

    monkeypatch.setattr(pybullet, "loadURDF", crash)
    before = [pybullet.isConnected(client) for client in range(20)]
    with pytest.raises(pybullet.error, match="cannot load"):
        open_plant()
    assert list(tmp_path.iterdir()) == []
    assert [pybullet.isConnected(client) for client in range(20)] == before


def test_closing_disconnects_and_may_be_repeated():
    before = [pybullet.isConnected(client) for client in range(20)]
    plant = BULLET.build(BARE, PlantSetup(MODEL, HOME, 0.05))
    assert [pybullet.isConnected(client) for client in range(20)] != before
    plant.close()
    plant.close()
    assert [pybullet.isConnected(client) for client in range(20)] == before


def test_motion_under_torques_is_that_of_pybullets_own_engine():
    drives, stops, h, q = (
        DriveConfig(payload=1.0, assumed_payload=0.0),
        np.full(6, np.pi),
        PHYSICS_STEP,
        HOME,
    )
    mechanics = BulletSimulation(Machine(MODEL.arm, UR5, (), drives, 0.0, HOME, (-stops, stops)))
    client, arm, joints, v = mechanics._world.client, mechanics._arm, list(range(6)), np.zeros(6)
    torque, body = np.array([5.0, -8.0, 10.0, 2.0, 0.5, 0.0]), mechanics.body(HOME, v)
    pybullet.setPhysicsEngineParameter(fixedTimeStep=h, physicsClientId=client)
    pybullet.setJointMotorControlArray(
        arm, joints, pybullet.VELOCITY_CONTROL, forces=[0.0] * 6, physicsClientId=client
    )
    for joint in range(-1, 8):
        pybullet.changeDynamics(
            arm, joint, linearDamping=0.0, angularDamping=0.0, physicsClientId=client
        )
        pybullet.setCollisionFilterGroupMask(arm, joint, 0, 0, physicsClientId=client)
    for joint, angle in enumerate(HOME):
        pybullet.changeDynamics(arm, joint, jointDamping=0.0, physicsClientId=client)
        pybullet.resetJointState(arm, joint, angle, physicsClientId=client)
    torque[5] = 0.0
    for _ in range(100):
        body = mechanics.body(q, v)
        v = v + h * np.linalg.solve(body.inertia, torque - body.bias)
        q = q + h * v
        pybullet.setJointMotorControlArray(
            arm, joints, pybullet.TORQUE_CONTROL, forces=torque.tolist(), physicsClientId=client
        )
        pybullet.stepSimulation(physicsClientId=client)
    simulated = np.array(
        [state[0] for state in pybullet.getJointStates(arm, joints, physicsClientId=client)]
    )
    mechanics.close()
    assert np.abs(q - HOME).max() > 0.01
    np.testing.assert_allclose(q, simulated, atol=1e-3 * np.abs(q - HOME).max())


def test_joint_angles_that_are_not_finite_end_the_run(open_plant, monkeypatch):
    plant = open_plant()
    plant.reset(0)
    monkeypatch.setattr(pybullet, "calculateInverseDynamics", lambda *_, **__: (np.nan,) * 6)
    with pytest.raises(PlantDiverged, match="joint positions are not finite"):
        plant.step(Command(np.zeros(6)))


def test_a_pybullet_without_numpy_works_too(open_plant, monkeypatch):
    plant = open_plant(IDEAL)
    expected, original = plant.reset(0), pybullet.getCameraImage

    def tuples(*args, **options):
        width, height, rgba, depth, labels = original(*args, **options)
        return (
            width,
            height,
            tuple(np.ravel(rgba).tolist()),
            tuple(np.ravel(depth).tolist()),
            labels,
        )

    monkeypatch.setattr(pybullet, "getCameraImage", tuples)
    np.testing.assert_allclose(plant.reset(0).feature, expected.feature, atol=1e-9)


@pytest.mark.skipif(
    not sys.platform.startswith("linux"), reason="only X11 names its display in the environment"
)
def test_a_window_without_a_display_is_refused(open_plant, monkeypatch):
    monkeypatch.delenv("DISPLAY", raising=False)
    with pytest.raises(ValueError, match="view needs a display"):
        open_plant(replace(BARE, view=True))
