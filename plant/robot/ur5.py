"""Facts of the UR5 (CB3) and the bench around it: the arm on a table, the camera above, the ball on the flange.

Sources: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (lengths, masses, centres of mass
and torques); inertia tensors by the cylinder approximation that the vendor's ROS description uses.
"""

from dataclasses import replace

from servobench.plant.contract.facts import DATA, read_facts
from servobench.plant.robot.arm import SerialArm, arm_from_dh

UR5 = "ur5"  # name of the robot in the catalogue
JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")

ARMS = read_facts("arms")
"""Facts by arm, with units and sources in the file."""
_FACTS = ARMS["ur5"]
DH_A = _FACTS["a"]
DH_D = _FACTS["d"]
DH_ALPHA = _FACTS["alpha"]
LINKS = _FACTS["links"]
"""Fields of `servobench.plant.robot.robot.Links` but for the payload."""
MAX_TORQUE = LINKS["torque"]
TOOL = _FACTS["tool"]
WORKSPACE = _FACTS["workspace"]
"""Fields of `servobench.plant.robot.workspace.Workspace`."""
MOVES = WORKSPACE["moves"]
HOME = WORKSPACE["home"]
STRETCHED = WORKSPACE["stretched"]
CALIBRATION = DATA / "ur5_factory_calibration.yaml"  # the file of one real UR5
TRAINING_LOWER = WORKSPACE["lower"]
TRAINING_UPPER = WORKSPACE["upper"]


def ur5_arm() -> SerialArm:
    """Return the UR5 by its data sheet."""
    return replace(arm_from_dh(DH_A, DH_D, DH_ALPHA, JOINT_NAMES), tool=TOOL)
