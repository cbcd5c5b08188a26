"""What a period of the `mujoco` plant costs over the render and physics calls it needs, and beside one of `bullet`.

All are measured in the same run, in turns: a whole `Bench.step` of `mujoco`; the calls of MuJoCo in it, which are the
physics steps, contact, and one image with its depths from the same camera, once whole, as whoever calls MuJoCo takes
it, and once the ball's window alone, as the plant takes it; the two largest parts of a step; and, where PyBullet is
installed, a whole `Bench.step` of `bullet`, whose bare calls are in `bullet_period.py`.
"""

from __future__ import annotations

from functools import partial
from importlib.util import find_spec

import numpy as np

from measuring import milliseconds, print_periods
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.checks import FloatArray, whole_steps
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.detection import Window, whole, window_around
from servobench.plant.rendered.drives import PHYSICS_STEP
from servobench.plant.rendered.engine import Machine
from servobench.plant.rendered.mujoco import MujocoScene, MujocoSimulation, mujoco
from servobench.plant.rendered.plants import build_mujoco
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.rendered.world import CONTACT_STEPS
from servobench.plant.robot import ur5
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.workspace import BALL_RADIUS

HOME = np.array(ur5.HOME)
PERIOD = 0.05  # [s]
KINDS = (
    "bare calls",
    "bare calls with the ball's window alone",
    "`Bench.step`",
    "of it: drives and physics",
    "of it: image, its noise and detection",
    "`Bench.step` of `bullet`",
)


class BareCalls:
    """The calls of MuJoCo that a period needs, and nothing else."""

    def __init__(self, config: RenderedConfig) -> None:
        """Open a scene and a simulation of their own."""
        self._model, self._camera = find_robot("ur5").nominal, config.camera()
        arm, stops = self._model.arm, np.full(6, config.joint_range)
        machine = Machine(arm, find_robot("ur5"), (), config.drives, config.lag, HOME, (-stops, stops))
        self._simulation = MujocoSimulation(machine)
        self._scene = MujocoScene(Room(arm, config.scenery, find_robot("ur5")))
        self._simulation.start(HOME)
        self._scene.place(HOME)

    def period(self, window: Window) -> None:
        """Carry out a period with a window of the image."""
        model, data = self._simulation._model, self._simulation._data
        shapes, placed = self._simulation._shapes, self._simulation._placed
        data.qpos[:], data.qvel[:] = HOME, 0.0
        for step in range(whole_steps(PERIOD, PHYSICS_STEP)):
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)
            if step % CONTACT_STEPS == 0:
                placed.qpos[:] = HOME
                mujoco.mj_kinematics(shapes, placed)
                mujoco.mj_comPos(shapes, placed)
                mujoco.mj_collision(shapes, placed)
        self._scene.draw(self._camera, self._model.X_BC, window)

    def windows(self) -> tuple[Window, Window]:
        """Return the window of the whole image, and that around the ball."""
        ball = self._model.to_camera(self._scene.ball_position())
        around = window_around(ball, BALL_RADIUS, self._camera)
        if around is None:
            raise RuntimeError("the ball is not in the image")
        return whole(self._camera), around

    def close(self) -> None:
        """Free scene and simulation."""
        self._scene.close()
        self._simulation.close()


def measure(config: RenderedConfig, repeats: int) -> FloatArray:
    """Return the times of `KINDS`, (5 or 6, repeats) ms; without PyBullet the last one is missing."""
    setup, bare = PlantSetup(find_robot("ur5").nominal, HOME, PERIOD), BareCalls(config)
    plants = [build_mujoco(config, setup)]
    if find_spec("pybullet") is not None:
        from servobench.plant.rendered.plants import build_bullet

        plants.append(build_bullet(config, setup))
    for plant in plants:
        plant.reset(0)
    world, steps = plants[0].world, whole_steps(PERIOD, PHYSICS_STEP)
    times, windows = np.empty((4 + len(plants), repeats)), bare.windows()
    for k in range(repeats):
        speed = 0.2 * np.sin(0.3 * k) * np.ones(6)
        whole_periods = [partial(plant.step, Command(speed)) for plant in plants]
        motion = partial(world._simulation.advance, world._joints, speed, steps)
        bares = [partial(bare.period, window) for window in windows]
        for row, call in enumerate((*bares, whole_periods[0], motion, world.see, *whole_periods[1:])):
            times[row, k] = milliseconds(call)
    for plant in plants:
        plant.close()
    bare.close()
    return times


if __name__ == "__main__":
    print_periods(__doc__, "mujoco", KINDS, measure)
