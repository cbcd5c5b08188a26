"""The variables of a model, from the table `variables.csv` in its folder; and their values for an arm.

The model description, the C header and the documentation are generated from the table. An arm has the ball in 3-D by a
fixed camera, or the features of a sensing set-up.

Every variable is a group of numbers in row-major order. FMI 2 shows each number as a scalar, `lag[3]`; FMI 3 shows the
group as an array, `lag`. Both use the group's offset in one flat vector of values as value reference.
"""

import csv
from collections.abc import Collection, Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from importlib.resources import files
from itertools import accumulate, product
from math import prod
from typing import NamedTuple, Self, TypeAlias

import numpy as np

from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.optics import COLUMNS
from servobench.plant.cameras.setups import SensingSetup, SetupModel
from servobench.plant.contract.checks import FloatArray, NamedArrays, Shape
from servobench.plant.contract.lanes import entries
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.arm import SerialArm, narrow_limits, rpy_from_rotation
from servobench.plant.robot.hand_eye import Mount, RobotModel

ARM = "ur5_mismatched"  # folder of the model that serves every arm
# Roles of variables.
PARAMETER = "parameter"
FIXED = "fixed parameter"
INPUT = "input"
STATE = "state"
DERIVATIVE = "derivative"
INDICATOR = "event indicator"
OUTPUT = "output"
SAMPLED = "sampled output"

# Settings of the mechanics: of each joint, and of the tool.
GEARS = ("backlash", "ripple", "ripple_order")
TOOL = ("tool_frequency", "tool_damping")

# Parts of the generated core.
ARGUMENT = "argument"
RESULT = "result"

FEATURE = "feature"
BALL = "ball_position"  # name of the feature without a set-up of cameras
SEEN = "seen"


@dataclass(frozen=True)
class Group:
    """One variable of the model: a row of `variables.csv` in the folder of the model."""

    name: str  # as FMI 3 shows it
    shape: Shape  # sizes of its axes
    role: str  # one of the roles above; a fixed parameter holds from the end of initialisation on
    unit: str  # as in the description; "1" for none
    description: str  # one sentence
    core: str  # `ARGUMENT` or `RESULT` of the generated core, or empty
    # Further attributes in the description, such as min, and nominal for a solver's tolerances.
    attributes: tuple[tuple[str, str], ...]
    # What it depends on: names, roles and `ARGUMENT`, which stands for all arguments of the core.
    depends: tuple[str, ...]
    initially: tuple[str, ...]  # likewise at the end of initialisation
    elementwise: bool  # whether number k depends on number k of each of these only

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


Groups: TypeAlias = tuple[Group, ...]


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

    @property
    def sizes(self) -> dict[str, int]:
        """Sizes by their letters in the table of variables."""
        return {
            "p": len(self.setup.target),
            "c": self.setup.cameras,
            "k": self.calibration,
            "m": self.setup.m,
        }

    @property
    def words(self) -> dict[str, str]:
        """Words by their names in the table of variables."""
        # Cameras beside the arm see a target on the flange, cameras on the hand one beside the arm.
        frames = ("base", "flange")
        camera_frame, target_frame = frames if self.mount == "fixed" else frames[::-1]
        further = {
            COLUMNS["rational_polynomial"]: ", and k4, k5, k6",
            COLUMNS["equidistant"]: ", and k4 of a fisheye",
        }
        return {
            "camera_frame": camera_frame,
            "target_frame": target_frame,
            "further": further.get(self.calibration, ""),
            "unit": self.setup.unit,
            "features": ", ".join(self.setup.features),
        }


def read_groups(
    model: str,
    sizes: Mapping[str, int],
    words: Mapping[str, str],
    parts: Collection[str] = ("",),
) -> Groups:
    """Return the groups of a model in the order of the flat vector.

    Args:
        model: folder of the model, whose `variables.csv` has a row a group.
        sizes: sizes by the letters that stand for them there.
        words: words by the names in braces that stand for them there.
        parts: the parts of the table that the model has; the empty one is in all.
    """
    table = (files("servobench.fmus") / model / "variables.csv").read_text(encoding="utf-8")
    groups = []
    for row in csv.DictReader(table.splitlines()):
        if row["part"] not in parts:
            continue
        attributes = [pair.split("=") for pair in row["attributes"].split()]
        group = Group(
            name=row["name"],
            shape=tuple(int(sizes.get(size, size)) for size in row["shape"].split()),
            role=row["role"],
            unit=row["unit"].format(**words),
            description=row["description"].format(**words),
            core=row["core"],
            attributes=tuple((name, value) for name, value in attributes),
            depends=tuple(row["depends"].split()),
            initially=tuple(row["initially"].split()),
            elementwise=row["coupling"] == "elementwise",
        )
        groups.append(group)
    return tuple(groups)


def arm_groups(n: int, view: View | None = None) -> Groups:
    """Return the groups of an arm with `n` joints, in the order of the flat vector.

    The kinematic parameters come first and in the order in which the generated core takes them.

    Args:
        n: number of joints.
        view: the part of a sensing set-up; None for the ball in 3-D by a fixed camera.
    """
    if view is None:
        return read_groups(ARM, {"n": n}, {}, ("", "ball"))
    parts = ["", "cameras"]
    if view.calibration:
        parts.append("calibration")
    return read_groups(ARM, {"n": n, **view.sizes}, view.words, parts)


@dataclass(frozen=True)
class Layout:
    """The groups and their offsets in the flat vector of values."""

    groups: Groups  # all variables of the model

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

    def dependencies(self, words: Iterable[str]) -> list[Group]:
        """Return the groups that words stand for, in order; see `Group.depends`."""
        wanted = set(words)
        return [each for each in self.groups if {each.name, each.role, each.core} & wanted]


@dataclass(frozen=True)
class ArmLayout(Layout):
    """The layout of an arm."""

    view: View | None = None  # part of a sensing set-up; None for the ball in 3-D by a fixed camera

    @property
    def kinematic(self) -> list[Group]:
        """The parameters of the generated core, which come first."""
        return self.dependencies([ARGUMENT])

    @property
    def computed(self) -> list[Group]:
        """The outputs of the generated core, which come last: the feature first, the Jacobian last."""
        return self.dependencies([RESULT])


def parameters_of(setup: PlantSetup, config: KinematicConfig) -> dict[str, FloatArray]:
    """Return the FMU's parameters for the kinematic plant of these arguments by group, (..., size)."""
    model, home = setup.robot()
    n = model.arm.n
    stops = narrow_limits(setup.limits, n, config.max_joint_speed, config.joint_range)
    return {
        **_arm_parameters(model.arm),
        **_sensing_parameters(model),
        **{name: np.full(n, getattr(config.mechanics, name)) for name in GEARS},
        **{name: np.array([getattr(config.mechanics, name)]) for name in TOOL},
        "lag": np.full(n, config.lag),
        "max_speed": stops.speed,
        "joint_lower": stops.lower,
        "joint_upper": stops.upper,
        "encoder_resolution": np.zeros(n),
        "home": home,
    }


def _arm_parameters(arm: SerialArm) -> NamedArrays:
    """Return the values of the kinematic parameters of an arm by name, (..., size).

    Its first transform leads to joint 1, the others from joint i to joint i + 1.
    """
    columns = np.concatenate([arm.translation, arm.rpy], axis=-1)
    names = ("a", "y", "d", "alpha", "pitch", "yaw")
    links = np.moveaxis(columns[..., 1:, :], -1, 0)
    return {
        "base_position": arm.translation[..., 0, :],
        "base_rpy": arm.rpy[..., 0, :],
        **dict(zip(names, links, strict=True)),
        "joint_offset": arm.joint_offset,
        "gear_ratio": arm.gear_ratio,
    }


def _sensing_parameters(model: RobotModel) -> NamedArrays:
    """Return the values of the parameters of target and cameras by name, (..., size)."""
    if not isinstance(model, SetupModel):
        return {"tool": model.arm.tool, **_camera_parameters(model.camera)}
    optics = model.optics
    values = {
        "target": model.target,
        **_camera_parameters(model.cameras),
        "principal_point": optics.centre,
    }
    if optics.further is not None:
        values["calibration"] = optics.further
    flat = {name: entries(matrix) for name, matrix in values.items()}
    return {**flat, "focal_length": optics.focal, "distortion": optics.distortion}


def _camera_parameters(X_BC: FloatArray) -> NamedArrays:
    """Return position and angles of cameras, (..., 3), by name."""
    angles = rpy_from_rotation(X_BC[..., :3, :3])
    return {"camera_position": X_BC[..., :3, 3], "camera_rpy": angles}
