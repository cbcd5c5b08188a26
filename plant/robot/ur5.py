"""Facts of the UR5 (CB3) and the bench around it: the arm on a table, the camera above, the ball on the flange.

Sources: Universal Robots, "DH parameters for calculations of kinematics and dynamics" (lengths, masses, centres of mass
and torques); inertia tensors by the cylinder approximation that the vendor's ROS description uses.
"""

from importlib.resources import files
from pathlib import Path

import numpy as np

from servobench.plant.robot.arm import SerialArm, arm_from_dh

UR5 = "ur5"  # name of the robot in the catalogue
JOINT_NAMES = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")

# Standard DH, T_i = Rz(q_i) Tz(d_i) Tx(a_i) Rx(alpha_i): lengths in m, angles in rad.
DH_A = (0.0, -0.425, -0.39225, 0.0, 0.0, 0.0)
DH_D = (0.089159, 0.0, 0.0, 0.10915, 0.09465, 0.0823)
DH_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)

MASS = (3.7, 8.393, 2.33, 1.219, 1.219, 0.1879)  # kg
# Centre of mass of link i in its DH frame (the frame after T_i), m.
CENTRE_OF_MASS = (
    (0.0, -0.02561, 0.00193),
    (0.2125, 0.0, 0.11336),
    (0.15, 0.0, 0.0265),
    (0.0, -0.0018, 0.01634),
    (0.0, 0.0018, 0.01634),
    (0.0, 0.0, -0.001159),
)
# About the centre of mass, kg m²: across the link (ixx = iyy) and along it (izz).
INERTIA = (
    (0.01497, 0.01041),
    (0.13389, 0.01511),
    (0.03122, 0.00410),
    (0.00201, 0.00219),
    (0.00183, 0.00219),
    (0.0000806, 0.000132),
)
MAX_TORQUE = (150.0, 150.0, 150.0, 28.0, 28.0, 28.0)  # Nm

# Appearance only: tube radii, and the offset of a link's tube from its joints along the joint's axis.
TUBE_RADIUS = (0.062, 0.056, 0.047, 0.04, 0.04, 0.038)  # m
SIDE_STEP = (0.0, 0.136, 0.0165, 0.0, 0.0, 0.0)  # m

# The ball stands off the flange so that the wrist does not hide it from above.
TOOL = (0.0, 0.0, 0.10)  # m, ball centre in the flange frame

# The start of most runs: elbow up, flange forward, the ball at (0.5, 0, 0.3) m in the base frame.
HOME = (0.35, -1.69, -2.34, 0.89, 1.22, 0.0)  # rad

# Start and target of the moves as joint positions [rad]; the comments give the ball on the nominal robot, base frame.
MOVES = {
    "exp1": (
        (0.169, -1.669, -2.250, 0.893, 1.156, 0.0),  # (0.50, -0.10, 0.35) m
        (1.484, -1.897, -2.052, 0.793, 1.624, 0.0),  # (0.15, 0.58, 0.30) m; the shoulder is 0.63 rad outside the box
    ),
    "exp2": (
        (0.097, -1.434, -2.282, 0.990, 1.124, 0.0),  # (0.40, -0.15, 0.45) m
        (0.441, -2.006, -2.124, 0.760, 1.255, 0.0),  # (0.60, 0.10, 0.20) m
    ),
    "exp3": (
        (0.583, -2.093, -1.976, 0.720, 1.301, 0.0),  # (0.62, 0.22, 0.20) m
        (-0.114, -1.648, -2.157, 0.894, 1.067, 0.0),  # (0.45, -0.25, 0.40) m
    ),
    "exp4": (
        (-0.938, -1.724, -1.814, 0.812, 0.855, 0.0),  # (0.12, -0.55, 0.50) m; the shoulder is 0.69 rad outside the box
        (0.403, -1.847, -2.248, 0.826, 1.231, 0.0),  # (0.55, 0.05, 0.25) m
    ),
}
# The arm stretched level over the table, the ball at (1.03, 0, 0.09) m; its Jacobian is nearly singular.
STRETCHED = (0.132772, -3.141593, 0.0, -0.483504, 1.421076, -0.000417)  # rad

SHOULDER = (0.0, 0.0, 0.09)  # m, base frame

# The box of joint positions in which networks are trained on the nominal model, rad.
TRAINING_LOWER = (-0.25, -2.29, -3.04, 0.39, 0.92, -0.3)
TRAINING_UPPER = (0.85, -1.09, -1.54, 1.39, 1.92, 0.3)


def ur5_arm() -> SerialArm:
    """Return the UR5 by its data sheet."""
    return arm_from_dh(DH_A, DH_D, DH_ALPHA, TOOL, JOINT_NAMES)


def shipped_calibration() -> Path:
    """Return the calibration file of one real UR5, which is part of the package."""
    return Path(str(files("servobench.plant") / "data" / "ur5_factory_calibration.yaml"))
