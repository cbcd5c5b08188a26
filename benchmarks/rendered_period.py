"""Cost of a period of the rendered plants over the render and physics calls that it needs.

All calls of an engine are measured in the same run, in turns, with and without table and floor: the bare calls of the
engine, which are its physics, contact and one image of the ball's window, and a whole `Bench.step`. For `bullet` a loop
as environments of Gymnasium are often written is beside them, with a call for each motor, all outputs of the renderer,
which draws the whole image, and the mean of the red points as the feature.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack, closing
from functools import partial
from importlib.util import find_spec

import numpy as np

from measuring import asked_to_be_quick, table, times_in_turns
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.checks import FloatArray, whole_steps
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.detection import Window, window_around
from servobench.plant.rendered.drives import PHYSICS_STEP
from servobench.plant.rendered.engine import Machine, Scene
from servobench.plant.rendered.plants import BULLET, MUJOCO
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.rendered.world import CONTACT_STEPS
from servobench.plant.robot import ur5
from servobench.plant.robot.camera import CAMERA, view_matrix
from servobench.plant.robot.catalogue import find_robot

ROBOT = find_robot("ur5")
HOME, MODEL = np.array(ur5.HOME), ROBOT.nominal
PERIOD = 0.05  # [s]
STEPS = whole_steps(PERIOD, PHYSICS_STEP)
# of joint velocities [rad/s], by name; the bare calls first
Calls = dict[str, Callable[[FloatArray], object]]


def window_of_ball(scene: Scene) -> Window:
    """Return the window of the image around the ball of a scene."""
    window = window_around(
        MODEL.to_camera(scene.ball_position()), ROBOT.workspace.ball_radius, CAMERA
    )
    assert window is not None, "the ball at HOME is in the image"
    return window


def bullet_calls(config: RenderedConfig, opened: ExitStack) -> Calls:
    """Return the calls of PyBullet, of the plant and of a loop in the manner of Gymnasium."""
    import pybullet

    from servobench.plant.rendered.bullet import BulletScene, BulletSimulation

    plant = opened.enter_context(closing(BULLET.build(config, PlantSetup(MODEL, HOME, PERIOD))))
    scenes = [
        opened.enter_context(closing(BulletScene(Room(MODEL.arm, config.scenery, ROBOT))))
        for _ in range(2)
    ]
    stops = np.full(6, np.pi)
    machine = Machine(MODEL.arm, ROBOT, (), config.drives, config.lag, HOME, (-stops, stops))
    mechanics = opened.enter_context(closing(BulletSimulation(machine)))
    camera = CAMERA
    plant.reset(0)
    for scene in scenes:
        scene.place(HOME)
    window = window_of_ball(scenes[0])
    plain, plain_arm = scenes[1]._world.client, scenes[1]._arm
    pybullet.setPhysicsEngineParameter(fixedTimeStep=PHYSICS_STEP, physicsClientId=plain)
    matrices = [
        each.T.ravel().tolist() for each in (view_matrix(MODEL.X_BC), camera.projection_matrix())
    ]

    def bare(_: FloatArray) -> None:
        client, arm, theta, rest = (
            mechanics._world.client,
            mechanics._arm,
            list(ur5.HOME),
            [0.0] * 6,
        )
        for step in range(STEPS):
            pybullet.calculateMassMatrix(arm, theta, physicsClientId=client)
            for _ in range(2):
                pybullet.calculateInverseDynamics(arm, theta, rest, rest, physicsClientId=client)
            if step % CONTACT_STEPS == 0:
                list(mechanics.overlaps(HOME))
        scenes[0].render(camera, MODEL.X_BC, window)

    def environment(action: FloatArray) -> tuple[FloatArray, FloatArray]:
        for _ in range(STEPS):
            for joint, speed in enumerate(action):
                pybullet.setJointMotorControl2(
                    plain_arm, joint, pybullet.VELOCITY_CONTROL, targetVelocity=speed, force=ur5.MAX_TORQUE[joint],
                    physicsClientId=plain,
                )  # fmt: skip
            pybullet.stepSimulation(physicsClientId=plain)
        width, height, rgba, depth, _ = pybullet.getCameraImage(
            camera.width,
            camera.height,
            *matrices,
            renderer=pybullet.ER_TINY_RENDERER,
            physicsClientId=plain,
        )
        picture = np.reshape(rgba, (height, width, 4)).astype(np.float64) / 255.0
        red = (picture[..., 0] > 0.5) & (picture[..., 1] < 0.3) & (picture[..., 2] < 0.3)
        rows, columns = np.nonzero(red)
        near = np.reshape(depth, (height, width))[red]
        joints = [
            pybullet.getJointState(plain_arm, joint, physicsClientId=plain)[0]
            for joint in range(len(action))
        ]
        return np.array(joints), np.array([columns.mean(), rows.mean(), near.mean()]) if len(
            rows
        ) else np.zeros(3)

    return {
        "bare calls": bare,
        "`Bench.step`": lambda speed: plant.step(Command(speed)),
        "Gymnasium-style loop": environment,
    }


def mujoco_calls(config: RenderedConfig, opened: ExitStack) -> Calls:
    """Return the calls of MuJoCo and of the plant."""
    from servobench.plant.rendered.mujoco import MujocoScene, MujocoSimulation, mujoco

    plant = opened.enter_context(closing(MUJOCO.build(config, PlantSetup(MODEL, HOME, PERIOD))))
    plant.reset(0)
    stops = np.full(6, config.joint_range)
    machine = Machine(MODEL.arm, ROBOT, (), config.drives, config.lag, HOME, (-stops, stops))
    simulation = opened.enter_context(closing(MujocoSimulation(machine)))
    scene = opened.enter_context(closing(MujocoScene(Room(MODEL.arm, config.scenery, ROBOT))))
    simulation.start(HOME)
    scene.place(HOME)
    window = window_of_ball(scene)

    def bare() -> None:
        model, data = simulation._model, simulation._data
        shapes, placed = simulation._shapes, simulation._placed
        data.qpos[:], data.qvel[:] = HOME, 0.0
        for step in range(STEPS):
            mujoco.mj_step1(model, data)
            mujoco.mj_step2(model, data)
            if step % CONTACT_STEPS == 0:
                placed.qpos[:] = HOME
                mujoco.mj_kinematics(shapes, placed)
                mujoco.mj_comPos(shapes, placed)
                mujoco.mj_collision(shapes, placed)
        scene.draw(CAMERA, MODEL.X_BC, window)

    return {
        "bare calls": lambda _: bare(),
        "`Bench.step`": lambda speed: plant.step(Command(speed)),
    }


def rows(make: Callable[[RenderedConfig, ExitStack], Calls], repeats: int) -> list[list[str]]:
    """Return a row for each call: with and without scenery the median [ms] and its ratio to the bare calls."""
    found: dict[str, list[str]] = {}
    for config in (RenderedConfig(), RenderedConfig(scenery=False)):
        with ExitStack() as opened:
            calls = make(config, opened)
            speeds = [0.2 * np.sin(0.3 * k) * np.ones(6) for k in range(repeats)]
            rounds = [
                times_in_turns({name: partial(call, u) for name, call in calls.items()}, 1)
                for u in speeds
            ]
        medians = 1e3 * np.median([[time for (time,) in each.values()] for each in rounds], axis=0)
        for name, value in zip(calls, medians, strict=True):
            found.setdefault(name, [name]).extend((f"{value:.2f} ms", f"{value / medians[0]:.2f}"))
    return list(found.values())


def main() -> None:
    """Print a table for each engine that is installed."""
    repeats = 3 if asked_to_be_quick(__doc__) else 200
    for name, module, make in (
        ("bullet", "pybullet", bullet_calls),
        ("mujoco", "mujoco", mujoco_calls),
    ):
        if find_spec(module) is not None:
            print(
                table(
                    [f"period of `{name}`", "with scenery", "× bare", "without", "× bare"],
                    rows(make, repeats),
                )
            )


if __name__ == "__main__":
    main()
