"""Which of an arm's overlaps, with itself and with the room, count as contact."""

from __future__ import annotations

from collections.abc import Callable, Iterable

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.engine import Overlap
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.catalogue import UR5
from servobench.plant.robot.robot import Robot

LAST_ON_TABLE = 1  # base and shoulder stand on the table
BUILT_INTO_EACH_OTHER = (0, 2)  # base and upper arm, whose housings meet inside the shoulder in every pose


class Contacts:
    """The contact of one arm; neighbouring links never count, nor do base and shoulder on their table."""

    def __init__(self, overlaps: Callable[[FloatArray], Iterable[Overlap]], arm: SerialArm, robot: Robot) -> None:
        """Find the links that are built into each other.

        Args:
            overlaps: from joint angles (n,) [rad] to the bodies that overlap.
            arm: the true kinematics.
            robot: by its maker's description; its home is free of contact.
        """
        self._overlaps = overlaps
        self._names = ["base", *arm.joint_names]
        self._built_in = {BUILT_INTO_EACH_OTHER}
        if robot.name != UR5:
            at_home = overlaps(arm.joint_angle(robot.workspace.home))
            self._built_in |= {_pair(link, other) for link, other in at_home if isinstance(other, int)}

    def find(self, angle: FloatArray, *, room: bool = True, own: bool = True) -> tuple[str, str] | None:
        """Return the names of two bodies that are in contact, or None.

        Args:
            angle: (n,) [rad], joint angles.
            room: whether contact with table, floor and boxes counts.
            own: whether contact of the arm with itself counts.
        """
        for link, other in self._overlaps(angle):
            if isinstance(other, str):
                if room and link > LAST_ON_TABLE:
                    return self._names[link], other
            elif own:
                first, second = pair = _pair(link, other)
                if second - first > 1 and pair not in self._built_in:
                    return self._names[first], self._names[second]
        return None


def _pair(link: int, other: int) -> tuple[int, int]:
    """Return the numbers of two links in order."""
    return min(link, other), max(link, other)
