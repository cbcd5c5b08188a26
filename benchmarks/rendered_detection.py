"""How exactly marks are found in rendered images: against the closed form of the plant `kinematic`, without noise.

Postures are drawn in the box of the task `random`; those count at which all marks would be in the image and face their
camera if nothing were in between. Robots and cameras are those of moderate mismatch. A wrong association is a disc that
is found nearer to where another one is.

    python benchmarks/rendered_detection.py [--quick]
"""

from __future__ import annotations

import time
from dataclasses import replace
from typing import cast

import numpy as np

from measuring import asked_to_be_quick, table
from servobench.plant.cameras.registry import Sensing
from servobench.plant.cameras.setups import SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.seeds import named_seed
from servobench.plant.rendered.bullet import BulletScene
from servobench.plant.rendered.detectors import ImageNoise, open_detector
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

SET_UPS = ("pixel", "pixel:hand", "stereo", "stereo:hand", "plate", "plate:hand")
POSES, ROBOTS = 200, 4
MODERATE = Mismatch.parse("moderate")
ROBOT = find_robot("ur5")
NOISELESS = replace(RenderedConfig(), colour_noise=0.0)


def true_model(word: str, seed: int) -> SetupModel:
    """Return a true UR5 and its cameras."""
    drawn = named_seed(seed, "mismatch")
    arm, sample = sample_mismatch(MODERATE, ROBOT, drawn)
    return cast(SetupModel, Sensing.parse(word).true(ROBOT, arm, sample, MODERATE, drawn)[0])


def measure(word: str, seed: int, poses: int) -> tuple[FloatArray, FloatArray, float]:
    """Return true and found pixels (poses, c, p, 2), NaN where a mark is not found, and the time of a look [ms]."""
    model, rng = true_model(word, seed), np.random.default_rng(seed)
    scene = BulletScene(Room(model.arm, NOISELESS.scenery, robot=ROBOT, model=model))
    detector, work, took = open_detector(model, scene, NOISELESS, ROBOT), ROBOT.workspace, 0.0
    noise = ImageNoise(seed)
    true, found = [], []
    while len(true) < poses:
        q = rng.uniform(work.lower, work.upper)
        exact, _, in_view = model.observe(q)
        if not in_view.all():
            continue
        scene.place(model.arm.joint_angle(q))
        began = time.process_time()
        seen, valid = detector.measure(model, q, noise)
        noise = noise.next()
        took += time.process_time() - began
        true.append(exact)
        found.append(np.where(valid, seen, np.nan))
    scene.close()
    shape = (poses, model.setup.cameras, len(model.target), 2)
    return np.reshape(true, shape), np.reshape(found, shape), 1e3 * took / poses


def row(word: str, poses: int, robots: int) -> list[str]:
    """Return the row of a set-up."""
    parts = [measure(word, seed, poses // robots) for seed in range(robots)]
    true, found = (np.concatenate([part[i] for part in parts]) for i in (0, 1))
    apart = np.linalg.norm(found[..., :, None, :] - true[..., None, :, :], axis=-1)
    error = np.diagonal(apart, axis1=-2, axis2=-1)
    seen = np.isfinite(error)
    wrong = np.count_nonzero(error[seen] > apart.min(axis=-1)[seen])
    median, most, largest = np.quantile(error[seen], [0.5, 0.95, 1.0])
    return [
        f"`{word}`", f"{100 * seen.mean():.1f} %", f"{median:.3f}", f"{most:.3f}", f"{largest:.2f}", f"{wrong}",
        f"{np.mean([part[2] for part in parts]):.0f}",
    ]  # fmt: skip


def main() -> None:
    """Print a row for each set-up."""
    poses, robots = (4, 1) if asked_to_be_quick(__doc__) else (POSES, ROBOTS)
    header = [
        "`--sensing`",
        "marks found",
        "median error, px",
        "95 %",
        "largest",
        "wrong associations",
        "ms a look",
    ]
    print(table(header, [row(word, poses, robots) for word in SET_UPS]))


if __name__ == "__main__":
    main()
