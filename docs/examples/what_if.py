"""What if the camera is knocked here? One run, branched into many futures at a period of one's choice.

Plant and controller are saved once; every future starts from the same saved states, with the camera turned by another
angle about its optical axis, and goes on for four seconds.
"""

import numpy as np
from scipy.spatial.transform import Rotation

from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve

REQUEST = RunRequest("kinematic", "regression_mfac", "circle", "moderate", seed=7)
KNOCKED_AT, FUTURE = (40, 120, 200), 80  # [periods]
ANGLES = np.radians([0.0, 15.0, 30.0, 60.0, 90.0])

if __name__ == "__main__":
    experiment = build(resolve(REQUEST, Settings()))
    plant, controller, run = experiment.plant, experiment.controller, experiment.run
    desired = experiment.scenario.reference.sampled(
        run.period, max(KNOCKED_AT) + FUTURE + 1 + run.preview_rows
    )
    pose = experiment.drawn.true.X_BC

    def advance(observation, first, last):
        """Go on from `first` to `last` [periods]; return the last observation and the errors [m]."""
        errors = []
        for k in range(first, last):
            command = controller.step(observation, desired[k : k + 1 + run.preview_rows])
            errors.append(np.linalg.norm(desired[k] - plant.truth().feature))
            observation = plant.step(command)
        return observation, np.array(errors)

    seen, now = plant.reset(1), 0
    controller.reset(seen, 1)
    print("knocked at [s]   turned by [deg]   largest error [mm]   error after 4 s [mm]")
    for period in KNOCKED_AT:
        seen, _ = advance(seen, now, period)
        now, saved = period, (plant.save(), controller.save())
        for angle in ANGLES:
            turned = pose.copy()
            turned[:3, :3] = pose[:3, :3] @ Rotation.from_rotvec([0.0, 0.0, angle]).as_matrix()
            plant.move_camera(turned)
            _, errors = advance(seen, period, period + FUTURE)
            when, turn, largest, last = (
                period * run.period,
                np.degrees(angle),
                1e3 * errors.max(),
                1e3 * errors[-1],
            )
            print(f"{when:14.1f} {turn:17.0f} {largest:20.1f} {last:22.1f}")
            plant.restore(saved[0])
            controller.restore(saved[1])
    plant.close()
