"""What a period of the `bullet` plant costs over the render and physics calls it cannot do without.

Both are measured in the same run, in turns: a whole `Bench.step`, and the same number of motor and physics steps
plus one `getCameraImage` of the same camera in a world like it.
Run it from an installed checkout: `python benchmarks/bullet_period.py`.
"""

from __future__ import annotations

import argparse
import time
from collections.abc import Callable

import numpy as np

from servobench.plant.bullet.bullet_plant import PHYSICS_STEP, BulletConfig, build_bullet
from servobench.plant.bullet.scene import Scene
from servobench.plant.checks import whole_steps
from servobench.plant.plant import PlantSetup
from servobench.plant.robot import ur5
from servobench.plant.robot.ur5 import nominal_ur5
from servobench.plant.signals import Command

HOME = np.array(ur5.HOME)


def milliseconds(call: Callable[[], object]) -> float:
    """Return how long a call takes, ms."""
    start = time.perf_counter()
    call()
    return 1e3 * (time.perf_counter() - start)


def measure(config: BulletConfig, period: float, repeats: int) -> tuple[np.ndarray, np.ndarray]:
    """Return the times, ms, (repeats,) of whole periods and of bare ones."""
    model = nominal_ur5()
    plant = build_bullet(config, PlantSetup(model, HOME, period))
    scene = Scene(model.arm, physics_step=PHYSICS_STEP, scenery=config.scenery, window=False)
    camera = config.camera()
    plant.reset(0)
    scene.place(HOME)
    steps = whole_steps(period, PHYSICS_STEP)
    whole, bare = np.empty(repeats), np.empty(repeats)
    for k in range(repeats):
        speed = 0.2 * np.sin(0.3 * k) * np.ones(6)
        targets = [speed.tolist()] * steps
        command = Command(speed)
        bare[k] = milliseconds(lambda targets=targets: (scene.advance(targets), scene.render(camera, model.X_BC)))
        whole[k] = milliseconds(lambda command=command: plant.step(command))
    plant.close()
    scene.close()
    return whole, bare


def main() -> None:
    """Print medians and their ratio, with and without table and floor."""
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--repeats", type=int, default=300)
    parser.add_argument("--period", type=float, default=0.05, help="s")
    options = parser.parse_args()
    for name, config in (("default", BulletConfig()), ("without scenery", BulletConfig(scenery=False))):
        whole, bare = measure(config, options.period, options.repeats)
        ratio = np.median(whole) / np.median(bare)
        print(f"{name:16s} whole {np.median(whole):6.2f} ms   bare {np.median(bare):6.2f} ms   ratio {ratio:.3f}")


if __name__ == "__main__":
    main()
