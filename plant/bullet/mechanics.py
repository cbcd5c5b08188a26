"""The arm as rigid bodies: its inertia and gravity torques, and what touches what; computed by PyBullet.

A physics world of its own, without looks: the arm with its true load, the arm as the drives believe it, and the table,
the floor and the boxes around it. The motion itself is integrated in `servobench.plant.bullet.drives`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servobench.plant.bullet.drives import RigidBody
from servobench.plant.bullet.engine import pybullet
from servobench.plant.bullet.urdf import Box, arm_mechanics, boxes_urdf, room_boxes
from servobench.plant.robot.catalogue import UR5, find_robot

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servobench.plant.checks import FloatArray
    from servobench.plant.robot.arm import SerialArm
    from servobench.plant.robot.robot import Robot

GRAVITY = 9.81  # m/s²
CONTACT_DISTANCE = 8  # place of the distance in a contact point of PyBullet; negative where bodies overlap
MIN_OVERLAP = 0.01  # [m] less is no contact, as the shapes are schematic
LAST_ON_TABLE = 1  # base and shoulder stand on the table
BUILT_INTO_EACH_OTHER = (0, 2)  # base and upper arm, whose housings meet inside the shoulder in every pose


class Mechanics:
    """An arm in a PyBullet world without looks; joint angles here are the true ones, θ."""

    def __init__(
        self,
        arm: SerialArm,
        *,
        payload: float,
        assumed_payload: float,
        boxes: tuple[Box, ...] = (),
        robot: Robot | None = None,
    ) -> None:
        """Open a world and load the arm twice, with the true and with the assumed load.

        Args:
            arm: the true kinematics.
            payload: kg, point load at the ball.
            assumed_payload: kg, that of the drives' model.
            boxes: obstacles beside table and floor.
            robot: by its maker's description, for masses and shapes; None for the UR5.

        Raises:
            ConnectionError: PyBullet opens no world, as too many are open.
        """
        described = robot or find_robot(UR5)
        self._client: int = pybullet.connect(pybullet.DIRECT)
        if self._client < 0:
            raise ConnectionError("PyBullet could not open a physics world")
        try:
            pybullet.setGravity(0.0, 0.0, -GRAVITY, physicsClientId=self._client)
            pybullet.setPhysicsEngineParameter(enableFileCaching=0, physicsClientId=self._client)
            loaded = arm_mechanics(arm, payload, shapes=True, robot=described)
            self._arm = self._load(loaded, pybullet.URDF_USE_SELF_COLLISION)
            self._assumed = self._load(arm_mechanics(arm, assumed_payload, shapes=False, robot=described), 0)
            room = (*room_boxes(described.workspace.scale), *boxes)
            self._boxes = {self._load(boxes_urdf((box,)), 0): box.name for box in room}
        except BaseException:
            self.close()
            raise
        self._joints = list(range(arm.n))
        self._rest = [0.0] * arm.n
        self._names = ["base", *arm.joint_names]
        self._built_in = {BUILT_INTO_EACH_OTHER}
        if described.name != UR5:
            self._built_in |= self._meeting(arm.joint_angle(described.workspace.home))

    def _load(self, urdf: str, flags: int) -> int:
        with tempfile.TemporaryDirectory(prefix="servobench-") as folder:
            path = Path(folder) / "body.urdf"
            path.write_text(urdf, encoding="utf-8")
            return int(
                pybullet.loadURDF(
                    str(path),
                    useFixedBase=True,
                    flags=pybullet.URDF_USE_INERTIA_FROM_FILE | flags,
                    physicsClientId=self._client,
                )
            )

    def assumed_inertia(self, angle: FloatArray) -> FloatArray:
        """Return the inertia by the drives' model at joint angles (n,) [rad], (n, n) [kg m²]."""
        return np.array(pybullet.calculateMassMatrix(self._assumed, angle.tolist(), physicsClientId=self._client))

    def body(self, angle: FloatArray, speed: FloatArray) -> RigidBody:
        """Return inertia and torques at joint angles (n,) [rad] and speeds (n,) [rad/s]."""
        theta, rest, client, torques = angle.tolist(), self._rest, self._client, pybullet.calculateInverseDynamics
        return RigidBody(
            np.array(pybullet.calculateMassMatrix(self._arm, theta, physicsClientId=client)),
            np.array(torques(self._arm, theta, speed.tolist(), rest, physicsClientId=client)),
            np.array(torques(self._assumed, theta, rest, rest, physicsClientId=client)),
        )

    def contact(self, angle: FloatArray, *, room: bool = True, own: bool = True) -> tuple[str, str] | None:
        """Return the names of two bodies that overlap, or None.

        Neighbouring links never count, nor do base and shoulder on their table. Flange, tool and ball belong to the
        last link.

        Args:
            angle: (n,) [rad], joint angles.
            room: whether contact with table, floor and boxes counts.
            own: whether contact of the arm with itself counts.
        """
        for first, second, other in self._overlaps(angle):
            if room and other is not None and first > LAST_ON_TABLE:
                return self._names[first], other
            pair = min(first, second), max(first, second)
            if own and other is None and pair[1] - pair[0] > 1 and pair not in self._built_in:
                return self._names[pair[0]], self._names[pair[1]]
        return None

    def _meeting(self, angle: FloatArray) -> set[tuple[int, int]]:
        """Return the pairs of links that overlap at joint angles (n,) [rad] in which nothing touches in truth."""
        return {
            (min(first, second), max(first, second)) for first, second, other in self._overlaps(angle) if other is None
        }

    def _overlaps(self, angle: FloatArray) -> Iterator[tuple[int, int, str | None]]:
        """Yield the bodies that overlap: two links, counted from the base, or a link and the name of a box."""
        client, n = self._client, len(self._joints)
        for joint, value in zip(self._joints, angle.tolist(), strict=True):
            pybullet.resetJointState(self._arm, joint, value, physicsClientId=client)
        pybullet.performCollisionDetection(physicsClientId=client)
        for point in pybullet.getContactPoints(bodyA=self._arm, physicsClientId=client):
            if point[CONTACT_DISTANCE] <= -MIN_OVERLAP:
                first, second = (min(link, n - 1) + 1 for link in point[3:5])  # PyBullet counts the base as -1
                yield first, second, self._boxes.get(point[2])

    def close(self) -> None:
        """Leave the world; calling it twice is allowed."""
        if self._client >= 0:
            client, self._client = self._client, -1
            if pybullet.isConnected(client):
                pybullet.disconnect(client)
