"""Facts of the UR5 (CB3) and the bench around it: the arm on a table, the camera above, the ball on the flange.

Sources: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (lengths, masses, centres of mass
and torques); inertia tensors by the cylinder approximation that the vendor's ROS description uses.
"""

from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

import numpy as np

from servobench.plant.contract.files import read_toml
from servobench.plant.contract.settings import with_tuples
from servobench.plant.robot.arm import SerialArm, arm_from_dh

DATA: Final = Path(str(files("servobench.plant") / "data"))
UR5 = "ur5"  # name of the robot in the catalogue
JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")

ARMS: Final[Mapping[str, Any]] = with_tuples(read_toml("facts of arms", DATA / "arms.toml"))
"""Facts by arm, with units and sources in the file."""
_FACTS = ARMS["ur5"]
DH_A, DH_D, DH_ALPHA = _FACTS["a"], _FACTS["d"], _FACTS["alpha"]
MASS, CENTRE_OF_MASS, INERTIA = _FACTS["mass"], _FACTS["centre"], _FACTS["inertia"]
MAX_TORQUE = _FACTS["torque"]
TUBE_RADIUS, SIDE_STEP = _FACTS["tube_radius"], _FACTS["side_step"]

# The ball stands off the flange so that the wrist does not hide it from above.
TOOL = (0.0, 0.0, 0.10)  # m, ball centre in the flange frame

# The start of most runs: elbow up, flange forward, the ball at (0.5, 0, 0.3) m in the base frame.
HOME = (0.35, -1.69, -2.34, 0.89, 1.22, 0.0)  # rad

MOVES: Final[Mapping[str, tuple[tuple[float, ...], tuple[float, ...]]]] = _FACTS["moves"]
# The arm stretched level over the table, the ball at (1.03, 0, 0.09) m; its Jacobian is nearly singular.
STRETCHED = (0.132772, -3.141593, 0.0, -0.483504, 1.421076, -0.000417)  # rad

SHOULDER = (0.0, 0.0, 0.09)  # m, base frame

# The box of joint positions in which networks are trained on the nominal model, rad.
TRAINING_LOWER = (-0.25, -2.29, -3.04, 0.39, 0.92, -0.3)
TRAINING_UPPER = (0.85, -1.09, -1.54, 1.39, 1.92, 0.3)


def ur5_arm() -> SerialArm:
    """Return the UR5 by its data sheet."""
    return replace(arm_from_dh(DH_A, DH_D, DH_ALPHA, JOINT_NAMES), tool=np.array(TOOL))


def shipped_calibration() -> Path:
    """Return the calibration file of one real UR5, which is part of the package."""
    return DATA / "ur5_factory_calibration.yaml"
