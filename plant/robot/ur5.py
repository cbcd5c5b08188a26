"""Facts of the UR5 (CB3) and the bench around it: the arm on a table, the camera above, the ball on the flange.

Sources: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (lengths, masses, centres of mass
and torques); inertia tensors by the cylinder approximation that the vendor's ROS description uses.
"""

from collections.abc import Mapping
from dataclasses import replace
from importlib.resources import files
from pathlib import Path
from typing import Any, Final

from servobench.plant.contract.files import read_toml
from servobench.plant.contract.settings import with_tuples
from servobench.plant.robot.arm import SerialArm, arm_from_dh

DATA: Final = Path(str(files("servobench.plant") / "data"))
UR5 = "ur5"  # name of the robot in the catalogue
JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")

ARMS: Final[Mapping[str, Any]] = with_tuples(read_toml("facts of arms", DATA / "arms.toml"))
"""Facts by arm, with units and sources in the file."""
_FACTS = ARMS["ur5"]
DH_A = _FACTS["a"]
DH_D = _FACTS["d"]
DH_ALPHA = _FACTS["alpha"]
MASS = _FACTS["mass"]
CENTRE_OF_MASS = _FACTS["centre"]
INERTIA = _FACTS["inertia"]
MAX_TORQUE = _FACTS["torque"]
TUBE_RADIUS = _FACTS["tube_radius"]
SIDE_STEP = _FACTS["side_step"]

TOOL = _FACTS["tool"]
SHOULDER = _FACTS["shoulder"]
MOVES = _FACTS["moves"]
HOME = _FACTS["home"]
STRETCHED = _FACTS["stretched"]
CALIBRATION: Final = DATA / "ur5_factory_calibration.yaml"  # the file of one real UR5
TRAINING_LOWER = _FACTS["training_lower"]
TRAINING_UPPER = _FACTS["training_upper"]


def ur5_arm() -> SerialArm:
    """Return the UR5 by its data sheet."""
    return replace(arm_from_dh(DH_A, DH_D, DH_ALPHA, JOINT_NAMES), tool=TOOL)
