"""How far `mujoco` is from `bullet`: the same robots under the same commands, and the same ball in both images.

    python benchmarks/engines.py            # 100 robots: some minutes

Each robot of the mismatch `moderate` swings all its joints for two seconds on both engines. What differs is then taken
away in turns: friction, which MuJoCo solves as a constraint; dynamics, without which nothing is left to differ. Last,
the ball is looked for in the images of both at random poses, without the noise of a sensor.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Final

import numpy as np

from measuring import asked_to_be_quick, table
from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.bullet import BulletScene, BulletSimulation
from servobench.plant.rendered.detection import find_ball
from servobench.plant.rendered.engine import Machine
from servobench.plant.rendered.mujoco import MujocoScene, MujocoSimulation
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import DriveConfig, RenderedConfig
from servobench.plant.robot.camera import CAMERA
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME
from servobench.plant.robot.workspace import BALL_RADIUS

FIRST_SEED = 50_000
PERIODS, STEPS, PERIOD = 40, 50, 0.05  # of a swing, of physics in a period, [s]
RATES = np.linspace(1.0, 3.0, 6)  # [rad/s] of the sines by which joints swing
AMPLITUDE = 0.5  # [rad/s]
DRIVES: Final[Mapping[str, DriveConfig]] = {
    "default": DriveConfig(),
    "without friction": DriveConfig(coulomb_friction=(0.0,), viscous_friction=(0.0,)),
    "torque limits a third": DriveConfig(torque_limit=(50.0, 50.0, 50.0, 9.0, 9.0, 9.0)),
    "without dynamics": DriveConfig(dynamics=False),
}


def swings(drives: DriveConfig, robots: int) -> tuple[FloatArray, FloatArray]:
    """Return the joint angles on both engines, (robots, PERIODS, 6) rad each."""
    paths = np.empty((2, robots, PERIODS, 6))
    described, config, start = find_robot("ur5"), RenderedConfig(), np.array(HOME)
    phases = np.random.default_rng(FIRST_SEED).uniform(0.0, 2.0 * np.pi, (robots, 6))
    for robot in range(robots):
        arm = sample_mismatch(Mismatch.parse("moderate"), described, FIRST_SEED + robot)[0].arm
        angle, stops = arm.joint_angle(start), np.full(6, 4.0 * np.pi)
        machine = Machine(arm, described, (), drives, config.lag, angle, (-stops, stops))
        for path, kind in zip(paths, (BulletSimulation, MujocoSimulation), strict=True):
            simulation = kind(machine)
            joints = simulation.start(angle)
            for k in range(PERIODS):
                speed = AMPLITUDE * np.sin(RATES * PERIOD * k + phases[robot])
                joints = simulation.advance(joints, arm.gear_ratio * speed, STEPS)
                path[robot, k] = joints.angle
            simulation.close()
    return paths[0], paths[1]


def detections(poses: int) -> FloatArray:
    """Return how far detected balls are from the true ones on both engines, and from each other, (k, 3) m."""
    model, camera, rng = find_robot("ur5").nominal, CAMERA, np.random.default_rng(FIRST_SEED)
    scenes = [
        kind(Room(model.arm, False, find_robot("ur5"))) for kind in (BulletScene, MujocoScene)
    ]
    rows = []
    for _ in range(poses):
        theta = np.array(HOME) + rng.uniform(-0.6, 0.6, 6)
        for scene in scenes:
            scene.place(theta)
        found = [
            find_ball(*scene.render(camera, model.X_BC), camera, BALL_RADIUS) for scene in scenes
        ]
        if found[0] is not None and found[1] is not None:
            one, other = found[0].centre, found[1].centre
            true = model.to_camera(scenes[0].ball_position())
            rows.append(
                [
                    np.linalg.norm(one - true),
                    np.linalg.norm(other - true),
                    np.linalg.norm(one - other),
                ]
            )
    for scene in scenes:
        scene.close()
    return np.array(rows)


def main() -> None:
    """Print how far joints, and detected balls, are from each other."""
    robots, poses = (2, 5) if asked_to_be_quick(__doc__) else (100, 200)
    rows = []
    for name, drives in DRIVES.items():
        one, other = swings(drives, robots)
        apart = 1e3 * np.abs(one - other)
        worst = apart.max(axis=(1, 2))
        rows.append(
            [
                name,
                *(
                    f"{value:.3f}"
                    for value in (np.sqrt(np.mean(apart**2)), np.median(worst), worst.max())
                ),
            ]
        )
    print(
        table(
            [f"joints of {robots} robots", "RMS, mrad", "largest, median robot", "largest of all"],
            rows,
        )
    )
    print()
    found = 1e3 * detections(poses)
    names = ("`bullet` to the true centre", "`mujoco` to the true centre", "between them")
    rows = [
        [name, *(f"{value:.4f}" for value in (np.median(column), column.max()))]
        for name, column in zip(names, found.T, strict=True)
    ]
    print(table([f"balls in {len(found)} of {poses} images", "median, mm", "largest, mm"], rows))


if __name__ == "__main__":
    main()
