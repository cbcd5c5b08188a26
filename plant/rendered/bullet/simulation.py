"""The arm in motion on PyBullet: its own drives and integration, with inertia, torques and contact by the engine."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np

from servobench.plant.contract.checks import FloatArray
from servobench.plant.rendered.bullet.mechanics import Mechanics
from servobench.plant.rendered.drives import Drives, DriveState
from servobench.plant.rendered.engine import Machine, Overlap, Simulation


class BulletSimulation(Simulation):
    """The cascade of `servobench.plant.rendered.drives`, stepped at 1 kHz on the rigid bodies of `Mechanics`."""

    def __init__(self, machine: Machine) -> None:
        """Open a world with the arm in it.

        Raises:
            ValueError: a list of the drives that does not fit the joints.
            ConnectionError: PyBullet opens no world, as too many are open.
        """
        drives = machine.drives
        self._dynamics = drives.dynamics
        self._mechanics = Mechanics(
            machine.arm,
            payload=drives.payload,
            assumed_payload=drives.assumed_payload,
            boxes=machine.boxes,
            robot=machine.robot,
        )
        try:
            self._drives = Drives(drives, machine.lag, self._mechanics.assumed_inertia(machine.start), machine.stops)
        except BaseException:
            self._mechanics.close()
            raise

    def start(self, angle: FloatArray) -> DriveState:
        """See `Simulation.start`."""
        return self._drives.start(angle, self._mechanics.body(angle, np.zeros(len(angle))))

    def advance(self, joints: DriveState, speed: FloatArray, steps: int) -> DriveState:
        """See `Simulation.advance`."""
        drives = self._drives
        drives.take(joints, speed)
        for _ in range(steps):
            if self._dynamics:
                drives.drive(self._mechanics.body(drives.angle, drives.speed))
            else:
                drives.track()
        return drives.give()

    def overlaps(self, angle: FloatArray) -> Iterator[Overlap]:
        """See `Simulation.overlaps`."""
        return self._mechanics.overlaps(angle)

    def close(self) -> None:
        """See `Simulation.close`."""
        self._mechanics.close()
