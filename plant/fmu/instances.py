"""The instances of one FMU for runs side by side, which share its library: opened, called, dropped and closed together.

A single run has one instance. The inner loop calls one function of all instances and then the next; a call returns a
status, which is 0 unless there is something to settle. An instance that fails is not called again.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from servobench.plant.contract.faults import FmuError
from servobench.plant.fmu.asked import NOTHING, Asked
from servobench.plant.fmu.description import FmuDescription
from servobench.plant.fmu.instance import OK, Instance, RawCall
from servobench.plant.fmu.instance2 import Instance2
from servobench.plant.fmu.instance3 import Instance3
from servobench.plant.fmu.library import load_library, unload_library
from servobench.plant.fmu.port import Port


@dataclass(frozen=True, eq=False)
class Lane:
    """The instance of a run and the calls of the inner loop, which return a status.

    Attributes:
        instance: of the FMU.
        row: its row in the buffers of all ports.
        write: writes the command.
        step: takes one step.
        read: reads joints and feature.
        read_truth: reads the true feature and, where it is mapped, the Jacobian.
        states: saved states that are handles, freed with the instance.
    """

    instance: Instance
    row: int
    write: RawCall
    step: RawCall
    read: RawCall
    read_truth: RawCall
    states: list[ctypes.c_void_p] = field(default_factory=list)

    def resting(self) -> Lane:
        """Return the lane with calls that do nothing, for an instance that has failed."""
        return replace(self, write=_nothing, step=_nothing, read=_nothing, read_truth=_nothing)

    def save(self, *, as_bytes: bool) -> bytes | ctypes.c_void_p:
        """Return the state as bytes, or as a handle of this instance for an FMU that cannot serialise."""
        if as_bytes:
            return self.instance.states.save_bytes()
        self.states.append(self.instance.states.save())
        return self.states[-1]

    def restore(self, saved: bytes | ctypes.c_void_p) -> None:
        """Return to a state from `save`."""
        if isinstance(saved, bytes):
            self.instance.states.restore_bytes(saved)
        else:
            self.instance.states.restore(saved)

    def close(self) -> None:
        """Free the instance and its states."""
        while self.states and not self.instance.fatal:
            self.instance.states.free(self.states.pop())
        self.instance.close()


class Instances:
    """The lanes of an FMU.

    Attributes:
        lanes: one for each run.
        live: the same for the inner loop, where those that failed rest; empty after `close`.
    """

    def __init__(
        self, description: FmuDescription, root: Path, fail: Callable[[int, FmuError], None], asked: Asked = NOTHING
    ) -> None:
        """Load the library; `open` makes the instances.

        Args:
            description: of the FMU.
            root: folder to which it is extracted.
            fail: takes the fault of a lane, or raises it.
            asked: what the user asks of each.

        Raises:
            ValueError: see `load_library`.
        """
        self._description, self._root, self._fail, self._asked = description, root, fail, asked
        self._library = None if description.once_per_process else load_library(description, root)
        self.lanes: list[Lane] = []
        self.live: list[Lane] = []

    def open(self, count: int, connect: Callable[[Instance, int], Lane]) -> None:
        """Make `count` instances; `connect` makes the lane of an instance with the row of its buffers."""
        for row in range(count):
            instance = open_instance(self._description, self._root, self._library, self._asked)
            try:
                self.lanes.append(connect(instance, row))
            except BaseException:
                instance.close()
                raise
        self.revive()

    def revive(self) -> None:
        """Call all instances again, also those that failed."""
        self.live = list(self.lanes)

    def each(self, act: Callable[[Lane], None]) -> None:
        """Do something outside the inner loop with each lane that has not failed."""
        for i, lane in enumerate(self.live):
            if lane is self.lanes[i]:
                try:
                    act(lane)
                except FmuError as fault:
                    self.drop(i, fault)

    def check(self, verb: str, port: Port, statuses: Sequence[int]) -> None:
        """Check the statuses of calls that read or write a port."""
        if any(statuses):
            self._settle(statuses, lambda instance, status: instance.check(f"{verb} {port.summary}", status))

    def finish(self, results: Sequence[int], time: float, step: float) -> None:
        """Check the results of steps of size `step`, s, from `time`, s, and resume those that ended early."""
        if any(results):
            self._settle(results, lambda instance, result: instance.finish(result, time, step))

    def _settle(self, results: Sequence[int], settle: Callable[[Instance, int], None]) -> None:
        for i, result in enumerate(results):
            if result and self.live[i] is self.lanes[i]:
                try:
                    settle(self.lanes[i].instance, result)
                except FmuError as fault:
                    self.drop(i, fault)

    def drop(self, i: int, fault: FmuError) -> None:
        """Call an instance no more, because of a fault, nor any other if it is fatal; that of a single run raises."""
        for j in range(len(self.lanes)) if self.lanes[i].instance.fatal else (i,):
            if self.live[j] is self.lanes[j]:
                self._fail(j, fault)
                self.live[j] = self.lanes[j].resting()

    def keep(self, chosen: Sequence[int]) -> None:
        """Close all other instances."""
        for i in set(range(len(self.lanes))).difference(chosen):
            self.lanes[i].close()
        self.lanes, self.live = [self.lanes[i] for i in chosen], [self.live[i] for i in chosen]

    def close(self) -> None:
        """Free all instances and unload the library; calling it twice is allowed."""
        self.live = []
        for lane in self.lanes:
            lane.close()
        if self._library is not None:
            unload_library(self._library)
            self._library = None


def open_instance(
    description: FmuDescription,
    root: Path,
    library: Any = None,  # noqa: ANN401 - ctypes
    asked: Asked = NOTHING,
) -> Instance:
    """Return an instance of the FMU that is extracted to `root`, which the caller closes; see `Instance`."""
    kind: type[Instance2 | Instance3] = Instance2 if description.version == 2 else Instance3
    return kind(description, root, library, asked)


def _nothing() -> int:
    return OK
