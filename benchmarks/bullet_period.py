"""What a period of the `bullet` plant costs over the render and physics calls it needs, and over a plain loop.

All are measured in the same run, in turns: a whole `Bench.step`; the calls of PyBullet in it, which are inertia and
torques of the arm in every physics step, contact, and one `getCameraImage` of the same camera; and a loop as
environments of Gymnasium are often written, with a call for each motor, all outputs of the renderer and the mean of the
red points as the feature.
"""

from __future__ import annotations

from functools import partial

import numpy as np
import pybullet

from measuring import milliseconds, print_periods
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.checks import FloatArray, whole_steps
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.bullet import BulletScene, BulletSimulation
from servobench.plant.rendered.drives import PHYSICS_STEP
from servobench.plant.rendered.engine import Machine
from servobench.plant.rendered.plants import build_bullet
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.rendered.world import CONTACT_STEPS
from servobench.plant.robot import ur5
from servobench.plant.robot.camera import view_matrix
from servobench.plant.robot.catalogue import find_robot

HOME = np.array(ur5.HOME)
PERIOD = 0.05  # [s]


class PlainEnvironment:
    """A step in the manner of Gymnasium in a scene of its own."""

    def __init__(self, scene: BulletScene, config: RenderedConfig, X_BC: FloatArray) -> None:
        """Take the scene and the camera's pose."""
        self._arm, self._client, camera = scene._arm, scene._client, config.camera()
        pybullet.setPhysicsEngineParameter(fixedTimeStep=PHYSICS_STEP, physicsClientId=self._client)
        self._size = camera.width, camera.height
        self._matrices = [matrix.T.ravel().tolist() for matrix in (view_matrix(X_BC), camera.projection_matrix())]

    def step(self, action: FloatArray) -> tuple[dict[str, FloatArray], float, bool, bool, dict[str, object]]:
        """Return observation, reward, terminated, truncated and info after an action, (6,) rad/s."""
        for _ in range(whole_steps(PERIOD, PHYSICS_STEP)):
            for joint, speed in enumerate(action):
                pybullet.setJointMotorControl2(
                    self._arm, joint, pybullet.VELOCITY_CONTROL, targetVelocity=speed, force=ur5.MAX_TORQUE[joint],
                    physicsClientId=self._client,
                )  # fmt: skip
            pybullet.stepSimulation(physicsClientId=self._client)
        width, height, rgba, depth, _ = pybullet.getCameraImage(
            *self._size, *self._matrices, renderer=pybullet.ER_TINY_RENDERER, physicsClientId=self._client
        )
        picture = np.reshape(rgba, (height, width, 4)).astype(np.float64) / 255.0
        red = (picture[..., 0] > 0.5) & (picture[..., 1] < 0.3) & (picture[..., 2] < 0.3)
        rows, columns = np.nonzero(red)
        near = np.reshape(depth, (height, width))[red]
        feature = np.array([columns.mean(), rows.mean(), near.mean()]) if len(rows) else np.zeros(3)
        states = [
            pybullet.getJointState(self._arm, joint, physicsClientId=self._client) for joint in range(len(action))
        ]
        joints = np.array([state[0] for state in states])
        return {"joints": joints, "feature": feature}, -float(np.linalg.norm(feature)), False, False, {}


def measure(config: RenderedConfig, repeats: int) -> FloatArray:
    """Return the times of bare periods, whole ones and those of a plain environment, (3, repeats) ms."""
    model = find_robot("ur5").nominal
    plant = build_bullet(config, PlantSetup(model, HOME, PERIOD))
    scenes = [BulletScene(Room(model.arm, config.scenery, find_robot("ur5"))) for _ in range(2)]
    stops = np.full(6, np.pi)
    mechanics = BulletSimulation(
        Machine(model.arm, find_robot("ur5"), (), config.drives, config.lag, HOME, (-stops, stops))
    )
    camera, environment = config.camera(), PlainEnvironment(scenes[1], config, model.X_BC)
    plant.reset(0)
    for scene in scenes:
        scene.place(HOME)
    steps, times = whole_steps(PERIOD, PHYSICS_STEP), np.empty((3, repeats))

    def bare() -> None:
        client, arm, theta, rest = mechanics._client, mechanics._arm, list(ur5.HOME), [0.0] * 6
        for step in range(steps):
            pybullet.calculateMassMatrix(arm, theta, physicsClientId=client)
            for _ in range(2):
                pybullet.calculateInverseDynamics(arm, theta, rest, rest, physicsClientId=client)
            if step % CONTACT_STEPS == 0:
                list(mechanics.overlaps(HOME))
        scenes[0].render(camera, model.X_BC)

    for k in range(repeats):
        speed = 0.2 * np.sin(0.3 * k) * np.ones(6)
        command = Command(speed)
        times[0, k] = milliseconds(bare)
        times[1, k] = milliseconds(partial(plant.step, command))
        times[2, k] = milliseconds(partial(environment.step, speed))
    plant.close()
    mechanics.close()
    for scene in scenes:
        scene.close()
    return times


if __name__ == "__main__":
    print_periods(__doc__, "bullet", ("bare calls", "`Bench.step`", "Gymnasium-style loop"), measure)
