"""A robot as its maker describes it: the nominal arm, its joint limits, its links, and the room it works in.

A controller may know all of this. The true robot of a run differs from it by a mismatch, and for a robot that is given
by a factory calibration also by that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import numpy as np

from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.limits import JointLimits
from servobench.plant.robot.workspace import Workspace


@dataclass(frozen=True, eq=False)
class Links:
    """The moving links as rigid bodies and as shapes; row i is the link after joint i+1.

    Masses lie in the frame at the link's far end, before the rotation of the next joint: DH frame i+1.

    Attributes:
        mass: (n,) [kg].
        centre: (n, 3) [m], centre of mass.
        inertia: about it [kg m²]: (n, 2), across the link and along it; or (n, 3, 3).
        torque: (n,) [Nm], largest of the joint.
        radius: (n,) [m] of the link's tube.
        aside: (n,) [m] offset of the tube from its joints, along the joint's axis.
        payload: rated load [kg].
    """

    mass: FloatArray
    centre: FloatArray
    inertia: FloatArray
    torque: FloatArray
    radius: FloatArray
    aside: FloatArray
    payload: float

    def __post_init__(self) -> None:
        """Check the shapes and freeze the arrays."""
        n = len(self.mass)
        shape = (n, 3, 3) if np.ndim(self.inertia) == 3 else (n, 2)
        shapes = dict.fromkeys(("mass", "torque", "radius", "aside"), (n,))
        for name, wanted in (shapes | {"centre": (n, 3), "inertia": shape}).items():
            object.__setattr__(self, name, as_array(name, getattr(self, name), wanted))


@dataclass(frozen=True, eq=False)
class Robot:
    """A robot by its maker's description.

    Attributes:
        name: in tables, names of files and of FMUs.
        title: in texts, such as "UR5".
        source: where the numbers come from.
        arm: the nominal arm with the ball on its flange.
        limits: of its joints, by its maker.
        links: masses and shapes.
        workspace: where it works, and where the camera hangs.
        measured: the arm as its factory measured it; None where only the nominal one is known.
        note: a line for the user about what was assumed; empty for none.
        known: whether controllers may know it; of another one they know joints and features alone.
    """

    name: str
    title: str
    source: str
    arm: SerialArm
    limits: JointLimits
    links: Links
    workspace: Workspace
    measured: SerialArm | None = None
    note: str = ""
    known: bool = True

    @property
    def n(self) -> int:
        """Number of joints."""
        return self.arm.n

    @cached_property
    def nominal(self) -> HandEyeModel:
        """The nominal arm under the camera as planned, which controllers may know."""
        return HandEyeModel(self.arm, self.workspace.camera_pose())
