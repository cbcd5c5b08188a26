"""Where a robot works: start, targets and training box, and the camera above them.

Lengths of the bench grow with the arm: `scale` is 1 for a UR5, so that the room around another arm looks like the room
around a UR5.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Final

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray

CENTRE: Final = (0.5, 0.0, 0.25)  # [m] base frame of a UR5
CAMERA_DISTANCE: Final = 1.3  # [m] from the camera to the workspace's centre, for a UR5
BALL_RADIUS: Final = 0.035  # [m] for a UR5
REACH: Final = (0.35, 0.75)  # [m] from a UR5's shoulder to the ball: away from the column and from the stretched arm
# The camera hangs above the workspace and looks straight down; image up is +x of the base.
R_BC_DOWN: Final = ((0.0, -1.0, 0.0), (-1.0, 0.0, 0.0), (0.0, 0.0, -1.0))

Clear = Callable[[FloatArray], npt.NDArray[np.bool_]]
Move = tuple[FloatArray, FloatArray]  # start and target, (n,) and (n,) [rad]


@dataclass(frozen=True, eq=False)
class Workspace:
    """The part of a robot's reach in which tasks are taught.

    Attributes:
        scale: of all lengths, over those of a UR5's bench.
        centre: (3,) [m], base frame; the camera looks at it and turns about it.
        shoulder: (3,) [m], base frame.
        home: (n,) [rad], the start of most runs.
        lower: (n,) [rad], lower corner of the box in which networks are trained and random moves are drawn.
        upper: (n,) [rad].
        moves: start and target of the moves by name.
        stretched: (n,) [rad], a start at which the Jacobian is nearly singular.
        clear: tells for joint positions (..., n) whether the arm is free of contact and the ball in view; None where
            all of the box is.
    """

    scale: float
    centre: FloatArray
    shoulder: FloatArray
    home: FloatArray
    lower: FloatArray
    upper: FloatArray
    moves: Mapping[str, Move]
    stretched: FloatArray
    clear: Clear | None = None

    @property
    def camera_distance(self) -> float:
        """From the camera to the centre [m]."""
        return CAMERA_DISTANCE * self.scale

    @property
    def ball_radius(self) -> float:
        """Of the ball, which looks as large in every image [m]."""
        return BALL_RADIUS * self.scale

    @property
    def reach(self) -> tuple[float, float]:
        """Distances of the ball from the shoulder that are easily reached [m]."""
        return REACH[0] * self.scale, REACH[1] * self.scale

    def camera_pose(self, R_BC: npt.ArrayLike = R_BC_DOWN) -> FloatArray:
        """Return X_BC, (4, 4), of a camera with rotation `R_BC` (3, 3) that looks at the centre."""
        return camera_pose(R_BC, self.centre, self.camera_distance)


def camera_pose(R_BC: npt.ArrayLike, centre: npt.ArrayLike, distance: float) -> FloatArray:
    """Return X_BC, (4, 4), of a camera with rotation `R_BC` (3, 3) at a `distance` [m] from `centre` (3,) [m]."""
    pose = np.eye(4)
    pose[:3, :3] = R_BC
    pose[:3, 3] = np.asarray(centre) - distance * pose[:3, 2]
    return pose
