"""The variables of the exported arm, with those of a sensing set-up, as one table.

The model description, the C header and the documentation are generated from it.

Every variable is a group of numbers in row-major order. FMI 2 shows each number as a scalar, `lag[3]`; FMI 3 shows the
group as an array, `lag`. Both use the group's offset in one flat vector of values as value reference.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate, product
from math import prod
from typing import Final, NamedTuple, Self

import numpy as np

from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.optics import COLUMNS
from servobench.plant.cameras.setups import Mount, SensingSetup, SetupModel
from servobench.plant.contract.checks import FloatArray
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.arm import SerialArm, narrow_limits, rpy_from_rotation
from servobench.plant.robot.hand_eye import RobotModel
from servobench.plant.robot.mechanics import MechanicsConfig

# Roles of variables.
PARAMETER: Final = "parameter"
FIXED: Final = "fixed parameter"
INPUT: Final = "input"
STATE: Final = "state"
DERIVATIVE: Final = "derivative"
INDICATOR: Final = "event indicator"
OUTPUT: Final = "output"
SAMPLED: Final = "sampled output"

FEATURE: Final = "feature"
BALL: Final = "ball_position"  # name of the feature without a set-up of cameras
SEEN: Final = "seen"


@dataclass(frozen=True)
class Group:
    """One variable of the model."""

    name: str  # as FMI 3 shows it
    shape: tuple[int, ...]  # sizes of its axes
    role: str  # one of the roles above; a fixed parameter holds from the end of initialisation on
    unit: str  # as in the description; "1" for none
    description: str  # one sentence
    minimum: float | None = None  # smallest admissible value, or None
    nominal: float | None = None  # usual size of a value, for a solver's tolerances, or None

    @property
    def size(self) -> int:
        """Number of scalars."""
        return prod(self.shape)

    def scalar_names(self) -> Iterator[str]:
        """Yield the names of its numbers as FMI 2 shows them, in row-major order; indices start at 1."""
        inner = self.name.removeprefix("der(").removesuffix(")")
        axes = [range(1, size + 1) for size in self.shape]
        for index in product(*axes):
            scalar = f"{inner}[{','.join(map(str, index))}]"
            if self.role == DERIVATIVE:
                scalar = f"der({scalar})"
            yield scalar


class View(NamedTuple):
    """The part of a sensing set-up that the equations fix; all else is a parameter.

    A set-up takes the place of the ball, its fixed camera and its position in the table of variables.
    """

    setup: SensingSetup  # the set-up
    mount: Mount  # where its cameras are mounted
    size: tuple[float, float]  # width and height of the images [px]
    calibration: int  # numbers of each camera in `Optics.further`; 0 for none

    @classmethod
    def of(cls, model: SetupModel) -> Self:
        """Return the view of an arm and its cameras."""
        further = model.optics.further
        numbers = 0
        if further is not None:
            numbers = further.shape[-1]
        return cls(model.setup, model.mount, model.optics.size, numbers)

    @property
    def word(self) -> str:
        """Name of set-up and mount, as a word of C."""
        if self.mount == "fixed":
            return self.setup.name
        return f"{self.setup.name}_{self.mount}"

    @property
    def setting(self) -> str:
        """Features and place of the cameras, for descriptions."""
        place = "beside the arm" if self.mount == "fixed" else "on the hand"
        return f"{self.setup.summary}, {place}"

    def parameters(self) -> tuple[Group, ...]:
        """Return the kinematic parameters of target and cameras, in order."""
        c = self.setup.cameras
        p = len(self.setup.target)
        # Cameras beside the arm see a target on the flange, cameras on the hand one beside the arm.
        camera_frame = "base" if self.mount == "fixed" else "flange"
        target_frame = "flange" if self.mount == "fixed" else "base"
        points = f"Points of the target in the {target_frame} frame."
        turned = f"Roll, pitch and yaw of the cameras in the {camera_frame} frame."
        middle = "Principal point, from the upper left corner of the image."
        groups = (
            Group("target", (p, 3), PARAMETER, "m", points),
            Group(
                "camera_position", (c, 3), PARAMETER, "m", f"Cameras in the {camera_frame} frame."
            ),
            Group("camera_rpy", (c, 3), PARAMETER, "rad", turned),
            Group("focal_length", (c,), PARAMETER, "px", "Focal length of each camera."),
            Group("principal_point", (c, 2), PARAMETER, "px", middle),
            Group("distortion", (c,), PARAMETER, "1", "First coefficient of radial distortion."),
        )
        if self.calibration == 0:
            return groups
        further = "f_y/f_x, k2, p1, p2, k3 of OpenCV's model, and the largest squared tangent of a visible ray"
        last = {
            COLUMNS["rational_polynomial"]: ", and k4, k5, k6",
            COLUMNS["equidistant"]: ", and k4 of a fisheye",
        }
        further += last.get(self.calibration, "") + "."
        calibration = Group("calibration", (c, self.calibration), PARAMETER, "1", further)
        return (*groups, calibration)

    def outputs(self, n: int) -> tuple[Group, ...]:
        """Return the outputs of an arm with `n` joints that the generated core computes."""
        m = self.setup.m
        unit = self.setup.unit
        measured = f"Measured features: {', '.join(self.setup.features)}."
        visible = "1 where a camera sees the feature, with nothing in between; 0 elsewhere."
        slope = "Derivative of feature by joint_position; for evaluation."
        return (
            Group(FEATURE, (m,), OUTPUT, unit, measured),
            Group(SEEN, (m,), OUTPUT, "1", visible),
            Group("jacobian", (m, n), OUTPUT, f"{unit}/rad", slope),
        )


def arm_groups(n: int, view: View | None = None) -> tuple[Group, ...]:
    """Return the groups of an arm with `n` joints, in the order of the flat vector.

    The kinematic parameters come first and in the order in which the generated core takes them.

    Args:
        n: number of joints.
        view: the part of a sensing set-up; None for the ball in 3-D by a fixed camera.
    """
    table = "transform after joint i"
    return (
        Group("base_position", (3,), PARAMETER, "m", "Axis of joint 1 in the base frame."),
        Group(
            "base_rpy", (3,), PARAMETER, "rad", "Roll, pitch and yaw of joint 1 in the base frame."
        ),
        Group("a", (n,), PARAMETER, "m", f"DH link length: x of the {table}."),
        Group("y", (n,), PARAMETER, "m", f"Calibration column, 0 in DH: y of the {table}."),
        Group("d", (n,), PARAMETER, "m", f"DH link offset: z of the {table}."),
        Group("alpha", (n,), PARAMETER, "rad", f"DH link twist: roll of the {table}."),
        Group(
            "pitch", (n,), PARAMETER, "rad", f"Calibration column, 0 in DH: pitch of the {table}."
        ),
        Group("yaw", (n,), PARAMETER, "rad", f"Calibration column, 0 in DH: yaw of the {table}."),
        Group(
            "joint_offset",
            (n,),
            PARAMETER,
            "rad",
            "True joint angle at a reported position of zero.",
        ),
        Group("gear_ratio", (n,), PARAMETER, "1", "True joint motion over reported joint motion."),
        *(BALL_PARAMETERS if view is None else view.parameters()),
        Group("backlash", (n,), PARAMETER, "rad", "Half of the play between gear and joint.", 0.0),
        Group("ripple", (n,), PARAMETER, "rad", "Amplitude by which the gear leads the joint."),
        Group("ripple_order", (n,), PARAMETER, "1", "Periods of the ripple in a turn."),
        Group(
            "tool_frequency",
            (1,),
            PARAMETER,
            "rad/s",
            "Natural frequency of a flexible tool; 0 for a rigid one.",
            0.0,
        ),
        Group(
            "tool_damping", (1,), PARAMETER, "1", "Damping ratio of a flexible tool, below 1.", 0.0
        ),
        Group(
            "lag",
            (n,),
            PARAMETER,
            "s",
            "Time constant of the joint's velocity loop; 0 for none.",
            0.0,
        ),
        Group(
            "max_speed",
            (n,),
            PARAMETER,
            "rad/s",
            "Commands beyond it, either way, are clipped.",
            0.0,
        ),
        Group("joint_lower", (n,), PARAMETER, "rad", "The joint stops here."),
        Group("joint_upper", (n,), PARAMETER, "rad", "The joint stops here."),
        Group(
            "encoder_resolution",
            (n,),
            PARAMETER,
            "rad",
            "Step of the encoder; 0 for an exact one.",
            0.0,
        ),
        Group(
            "home", (n,), FIXED, "rad", "Reported joint position at the start, within the stops."
        ),
        Group(
            "joint_velocity_command",
            (n,),
            INPUT,
            "rad/s",
            "Joint velocity command, held over a step.",
        ),
        Group("joint_position", (n,), STATE, "rad", "Reported joint position.", nominal=1.0),
        Group("joint_velocity", (n,), STATE, "rad/s", "Reported joint velocity.", nominal=1.0),
        Group(
            "tool_deflection",
            (3,),
            STATE,
            "m",
            "Deflection of the tool in the base frame.",
            nominal=1.0,
        ),
        Group(
            "tool_velocity",
            (3,),
            STATE,
            "m/s",
            "Velocity of the target in the base frame.",
            nominal=1.0,
        ),
        Group(
            "der(joint_position)", (n,), DERIVATIVE, "rad/s", "Derivative of the joint position."
        ),
        Group(
            "der(joint_velocity)", (n,), DERIVATIVE, "rad/s2", "Derivative of the joint velocity."
        ),
        Group("der(tool_deflection)", (3,), DERIVATIVE, "m/s", "Derivative of the deflection."),
        Group("der(tool_velocity)", (3,), DERIVATIVE, "m/s2", "Derivative of the velocity."),
        Group(
            "stop_indicator",
            (n, 2),
            INDICATOR,
            "1",
            "Distance to lower and upper stop; at a stop the command.",
        ),
        Group(
            "encoder_position", (n,), OUTPUT, "rad", "Joint position in whole steps of the encoder."
        ),
        *(_ball_outputs(n) if view is None else view.outputs(n)),
    )


BALL_PARAMETERS: Final = (
    Group("tool", (3,), PARAMETER, "m", "Ball centre in the flange frame."),
    Group("camera_position", (3,), PARAMETER, "m", "Camera in the base frame."),
    Group(
        "camera_rpy", (3,), PARAMETER, "rad", "Roll, pitch and yaw of the camera in the base frame."
    ),
)


def _ball_outputs(n: int) -> tuple[Group, ...]:
    """Return the outputs that the generated core computes of the ball in 3-D."""
    return (
        Group(BALL, (3,), OUTPUT, "m", "Ball centre in the camera frame."),
        Group(SEEN, (3,), OUTPUT, "1", "1: the camera sees the ball wherever it is."),
        Group(
            "jacobian",
            (3, n),
            OUTPUT,
            "m/rad",
            "Derivative of ball_position by joint_position; for evaluation.",
        ),
    )


@dataclass(frozen=True)
class Layout:
    """The groups and their offsets in the flat vector of values."""

    groups: tuple[Group, ...]  # all variables of the model

    @cached_property
    def by_name(self) -> dict[str, Group]:
        """The groups by name."""
        return {group.name: group for group in self.groups}

    @cached_property
    def offsets(self) -> dict[str, int]:
        """Offset of each group, which is its value reference."""
        ends = accumulate((group.size for group in self.groups), initial=0)
        return dict(zip(self.by_name, ends, strict=False))

    @property
    def size(self) -> int:
        """Number of all scalars."""
        return sum(group.size for group in self.groups)

    def of_role(self, *roles: str) -> list[Group]:
        """Return the groups of these roles, in order."""
        return [group for group in self.groups if group.role in roles]


@dataclass(frozen=True)
class ArmLayout(Layout):
    """The layout of an arm."""

    view: View | None = None  # part of a sensing set-up; None for the ball in 3-D by a fixed camera

    @property
    def kinematic(self) -> tuple[Group, ...]:
        """The parameters of the generated core, which come first."""
        names = list(self.by_name)
        return self.groups[: names.index("lag")]

    @property
    def computed(self) -> tuple[Group, ...]:
        """The outputs of the generated core, which come last: the feature first, the Jacobian last."""
        names = list(self.by_name)
        return self.groups[names.index("encoder_position") + 1 :]


def parameters_of(setup: PlantSetup, config: KinematicConfig) -> dict[str, FloatArray]:
    """Return the FMU's parameters for the kinematic plant of these arguments by group, (..., size)."""
    model, home = setup.robot()
    n = model.arm.n
    stops = narrow_limits(setup.limits, n, config.max_joint_speed, config.joint_range)
    return {
        **_arm_parameters(model.arm),
        **_sensing_parameters(model),
        **_mechanics_parameters(config.mechanics, n),
        "lag": np.full(n, config.lag),
        "max_speed": stops.speed,
        "joint_lower": stops.lower,
        "joint_upper": stops.upper,
        "encoder_resolution": np.zeros(n),
        "home": home,
    }


def _arm_parameters(arm: SerialArm) -> dict[str, FloatArray]:
    """Return the values of the kinematic parameters of an arm by name, (..., size).

    Its first transform leads to joint 1, the others from joint i to joint i + 1.
    """
    base_position = arm.translation[..., 0, :]
    base_rpy = arm.rpy[..., 0, :]
    translation = arm.translation[..., 1:, :]
    rpy = arm.rpy[..., 1:, :]
    return {
        "base_position": base_position,
        "base_rpy": base_rpy,
        "a": translation[..., 0],
        "y": translation[..., 1],
        "d": translation[..., 2],
        "alpha": rpy[..., 0],
        "pitch": rpy[..., 1],
        "yaw": rpy[..., 2],
        "joint_offset": arm.joint_offset,
        "gear_ratio": arm.gear_ratio,
    }


def _mechanics_parameters(mechanics: MechanicsConfig, n: int) -> dict[str, FloatArray]:
    """Return the values of the parameters of gears, the same for all n joints, and of the tool by name, (size,)."""
    return {
        "backlash": np.full(n, mechanics.backlash),
        "ripple": np.full(n, mechanics.ripple),
        "ripple_order": np.full(n, mechanics.ripple_order),
        "tool_frequency": np.array([mechanics.tool_frequency]),
        "tool_damping": np.array([mechanics.tool_damping]),
    }


def _sensing_parameters(model: RobotModel) -> dict[str, FloatArray]:
    """Return the values of the parameters of target and cameras by name, (..., size)."""
    if not isinstance(model, SetupModel):
        X_BC = model.camera
        return {
            "tool": model.arm.tool,
            "camera_position": X_BC[..., :3, 3],
            "camera_rpy": rpy_from_rotation(X_BC[..., :3, :3]),
        }
    optics = model.optics
    positions = model.cameras[..., :3, 3]
    angles = rpy_from_rotation(model.cameras[..., :3, :3])
    values = {
        "target": _flat(model.target),
        "camera_position": _flat(positions),
        "camera_rpy": _flat(angles),
        "focal_length": optics.focal,
        "principal_point": _flat(optics.centre),
        "distortion": optics.distortion,
    }
    if optics.further is not None:
        values["calibration"] = _flat(optics.further)
    return values


def _flat(values: FloatArray) -> FloatArray:
    """Return matrices (..., i, j) as vectors (..., i j)."""
    return np.reshape(values, (*values.shape[:-2], -1))
