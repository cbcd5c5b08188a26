"""Files that describe robots, for tests."""

import numpy as np

FOUR_JOINTS = """
convention = "standard"
a = [0.0, 0.45, 0.4, 0.1]
d = [0.35, 0.0, 0.0, 0.0]
alpha = [1.570796326794897, 0.0, 0.0, 0.0]
joint_lower = [-3.0, -2.0, -2.8, -2.8]
joint_upper = [3.0, 2.0, 2.8, 2.8]
joint_speed = [2.0, 2.0, 2.0, 2.0]
"""


DRIVEN_TWIN = """
robot = "ur10e"
parameters = ["latency", "zero_elbow", "lag"]
factor = [[0.004, 0.02, 0.01], [0.0, -0.01, 0.02]]
[camera]
latency = 0.083
pose = { frame = "base", position = [0.75, 0.03, 2.2], rotation = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]] }
[mean]
command_delay = 0.02
lag = 0.2
tool_x = 0.03
zero_elbow = 0.2
"""


def calibration_text(row, seed):
    """Return a factory calibration of an arm of Universal Robots that is wrong by tenths of a millimetre."""
    rng = np.random.default_rng(seed)
    half = np.pi / 2
    blocks = {
        "shoulder": (0, 0, row.d1, 0, 0, 0),
        "upper_arm": (0, 0, 0, half, 0, 0),
        "forearm": (row.a2, 0, 0, 0, 0, 0),
        "wrist_1": (row.a3, 0, row.d4, 0, 0, 0),
        "wrist_2": (0, -row.d5, 0, half, 0, 0),
        "wrist_3": (0, row.d6, 0, half, np.pi, -np.pi),
    }
    lines = ["kinematics:"]
    for name, numbers in blocks.items():
        values = np.array(numbers, dtype=float) + 3e-4 * rng.uniform(-1.0, 1.0, 6)
        keys = zip(("x", "y", "z", "roll", "pitch", "yaw"), values.tolist(), strict=True)
        lines.append(f"  {name}: {{{', '.join(f'{key}: {value}' for key, value in keys)}}}")
    return "\n".join([*lines, "  hash: calib_1", ""])


def odd_urdf():
    """Return a URDF with joints about x, −y and a slanted axis, fixed links between them, and a finger."""
    joints = [
        ("joint_1", "revolute", "foot", "link_1", "0 0 0.3", "0 0 0", "0 0 1", 2.5),
        ("joint_2", "revolute", "link_1", "link_2", "0 0 0", "0 0 0", "0 -1 0", 1.5),
        ("bridge", "fixed", "link_2", "bridge_link", "0.2 0 0", "0.1 0 0", None, None),
        ("joint_3", "revolute", "bridge_link", "link_3", "0.2 0 0", "0 0 0", "0 1 0.2", 2.5),
        ("joint_4", "revolute", "link_3", "link_4", "0.35 0 0", "0 0.2 0", "0.1 1 0", 2.5),
        ("hand_joint", "fixed", "link_4", "hand", "0.1 0 0", "0 1.5708 0", None, None),
        ("finger_joint", "prismatic", "hand", "finger", "0 0 0.05", "0 0 0", "1 0 0", 0.04),
    ]
    names = ["foot", *(joint[3] for joint in joints)]
    parts = [f'<link name="{name}"/>' for name in names]
    for name, kind, parent, child, xyz, rpy, axis, limit in joints:
        turning = "" if axis is None else f'<axis xyz="{axis}"/>'
        if limit is not None:
            turning += f'<limit lower="-{limit}" upper="{limit}" effort="50" velocity="2"/>'
        parts.append(
            f'<joint name="{name}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>'
            f'<origin xyz="{xyz}" rpy="{rpy}"/>{turning}</joint>'
        )
    return f'<robot name="odd">{"".join(parts)}</robot>'


def urdf_of(*joints, name="arm"):
    """Return a URDF of joints with their links.

    Args:
        joints: (name, type, parent link, child link, further elements); a rotating or sliding joint that has no limit
            among these gets one.
        name: of the robot.
    """
    links = dict.fromkeys(link for joint in joints for link in joint[2:4])
    parts = [f'<link name="{link}"/>' for link in links]
    for own, kind, parent, child, *further in joints:
        elements = "".join(further)
        if kind in ("revolute", "prismatic") and "<limit" not in elements:
            elements += '<limit lower="-0.04" upper="2.5" effort="50" velocity="2"/>'
        parts.append(
            f'<joint name="{own}" type="{kind}"><parent link="{parent}"/><child link="{child}"/>{elements}</joint>'
        )
    return f'<robot name="{name}">{"".join(parts)}</robot>'


def arm_joints(n, prefix="", root="base"):
    """Return n rotating joints one after another as `urdf_of` takes them; joint i leads to link i."""
    links = [root, *(f"{prefix}link_{i}" for i in range(1, n + 1))]
    place = '<origin xyz="0 0.1 0.2"/>'
    return [
        (f"{prefix}joint_{i}", "revolute", links[i - 1], links[i], place) for i in range(1, n + 1)
    ]
