"""The arm as rigid bodies: its inertia and gravity torques, and what touches what; computed by PyBullet.

A physics world of its own, without looks: the arm with its true load, the arm as the drives believe it, and the table,
the floor and the boxes around it. The motion itself is integrated in `servobench.plant.rendered.bullet.simulation`.
"""

from __future__ import annotations

import tempfile
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servobench.plant.rendered.bullet.engine import pybullet
from servobench.plant.rendered.drives import RigidBody
from servobench.plant.rendered.engine import MIN_OVERLAP, Overlap
from servobench.plant.rendered.urdf import Box, arm_mechanics, boxes_urdf, room_boxes
from servobench.plant.robot.catalogue import UR5, find_robot
from servobench.plant.robot.robot import GRAVITY

if TYPE_CHECKING:
    from collections.abc import Iterator

    from servobench.plant.contract.checks import FloatArray
    from servobench.plant.robot.arm import SerialArm
    from servobench.plant.robot.robot import Robot

CONTACT_DISTANCE = 8  # place of the distance in a contact point of PyBullet; negative where bodies overlap


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

    def overlaps(self, angle: FloatArray) -> Iterator[Overlap]:
        """See `Simulation.overlaps`."""
        client, n = self._client, len(self._joints)
        for joint, value in zip(self._joints, angle.tolist(), strict=True):
            pybullet.resetJointState(self._arm, joint, value, physicsClientId=client)
        pybullet.performCollisionDetection(physicsClientId=client)
        for point in pybullet.getContactPoints(bodyA=self._arm, physicsClientId=client):
            if point[CONTACT_DISTANCE] <= -MIN_OVERLAP:
                link, other = (min(each, n - 1) + 1 for each in point[3:5])  # PyBullet counts the base as -1
                yield Overlap(link, self._boxes.get(point[2], other))

    def close(self) -> None:
        """Leave the world; calling it twice is allowed."""
        if self._client >= 0:
            client, self._client = self._client, -1
            if pybullet.isConnected(client):
                pybullet.disconnect(client)
