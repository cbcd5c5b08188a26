"""Runs that advance together: many robots, targets and seeds under one method, on one plant with a lane for each run.

The same loop that carries out one run steps a plant, a controller and a log of many lanes. A run that ends early leaves
plant and controller; the loop goes on with the others and keeps its last values in its place. An error in a step of the
controller concerns some lanes only, but does not say which: the step is pure, so it is repeated with ever fewer lanes
until the failing run is found.
"""

from collections.abc import Hashable
from typing import Any, final

import numpy as np

from servobench.controllers.controller import Controller, Diagnostics
from servobench.controllers.servo import Servo, ServoState
from servobench.harness.config.registry import find_controller, find_plant
from servobench.harness.run.log import StepLog, Steps
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import AnyArray, FloatArray, IntArray
from servobench.plant.contract.lanes import Lanes, Tree, map_arrays, take
from servobench.plant.contract.signals import BoolArray, Command, Observation, PlantSpec, Truth


class AllEnded(Exception):
    """No run is under way any more."""


@final
class Ends:
    """Which runs are still under way, and how the others ended.

    Attributes:
        all: indices of all runs.
        running: indices of the runs that are under way, ascending.
        faults: the error that ended a run, by its index.
        rows: rows of the log that such a run has.
    """

    def __init__(self, count: int) -> None:
        """Start `count` runs."""
        self.all = np.arange(count)
        self.running = self.all
        self.faults: dict[int, Exception] = {}
        self.rows: dict[int, int] = {}

    def end(self, lane: int, fault: Exception, rows: int) -> None:
        """End one run; the first fault counts.

        Raises:
            AllEnded: it was the last one.
        """
        if lane not in self.faults:
            self.faults[lane] = fault
            self.rows[lane] = rows
            self.running = self.running[self.running != lane]
        if not len(self.running):
            raise AllEnded

    def left_of(self, tree: Tree, lanes: IntArray) -> Tree:
        """Return of arrays with a place for each of some `lanes` those of the runs that are still under way."""
        if len(lanes) == len(self.running):
            return tree
        return take(tree, np.flatnonzero(np.isin(lanes, self.running)))

    def spread(self, tree: Tree, before: Tree) -> Tree:
        """Return arrays of the runs under way in their places among all runs; the others keep those from before."""

        def placed(values: AnyArray, old: AnyArray) -> AnyArray:
            spread = old.copy()
            spread[self.running] = values
            return spread

        if len(self.running) == len(self.all):
            return tree
        return map_arrays(placed, tree, before)


@final
class ManyBenches(Plant):
    """A bench of many lanes, for the loop."""

    def __init__(self, bench: Bench, ends: Ends) -> None:
        """Take the bench, which has a lane for each run."""
        self.spec: PlantSpec = bench.spec
        self._bench = bench
        self._ends = ends
        self._mine = ends.running  # the runs that have a lane of the bench
        self._k = 0

    def reset(self, seed: Any) -> Observation:  # noqa: ANN401 - a seed of each run
        """See `Plant.reset`."""
        self._last = self._bench.reset(seed)
        self._truth = self._bench.truth()
        return self._last

    def step(self, command: Command) -> Observation:
        """See `Plant.step`; a run whose plant fails ends."""
        self._leave()
        observation = self._bench.step(self._ends.left_of(command, self._ends.all))
        lanes = self._ends.running
        for lane, fault in self._bench.faults.items():
            self._ends.end(int(lanes[lane]), fault, self._k)
        self._leave()
        self._k += 1
        self._last = self._ends.spread(self._ends.left_of(observation, lanes), self._last)
        return self._last

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        self._leave()
        self._truth = self._ends.spread(self._bench.truth(), self._truth)
        return self._truth

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._leave()
        self._bench.move_camera(X_BC[self._ends.running])

    def close(self) -> None:
        """See `Plant.close`."""
        self._bench.close()

    def _leave(self) -> None:
        """Let runs that ended leave the bench."""
        stay = self._ends.left_of(np.arange(len(self._mine)), self._mine)
        if len(stay) < len(self._mine):
            self._bench.keep(stay)
        self._mine = self._ends.running


@final
class ManyServos(Controller):
    """A composed controller of many lanes, for the loop."""

    def __init__(self, servo: Servo, ends: Ends) -> None:
        """Take the servo, which has a lane for each run where its parts know the true robot."""
        self._servo = servo
        self._ends = ends
        self._mine = ends.running  # the runs that have a lane of the state
        self._k = 0

    def reset(self, observation: Observation, seed: Any) -> None:  # noqa: ANN401 - a seed of each run
        """See `Controller.reset`; no part of a servo draws random numbers."""
        self._state = self._servo.start(observation)
        self._u = np.zeros_like(observation.joint_position)
        self._jacobian = self._servo.jacobian(self._state)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """See `Controller.step`; a run whose controller fails ends.

        Raises:
            Exception: a step failed, and repeated with fewer lanes it does not.
        """
        given = self._ends.left_of((observation, reference), self._ends.all)
        lanes = self._ends.running
        self._leave()
        try:
            self._state, u = self._servo.step(self._state, *given)
        except Exception:
            failing = failing_lanes(self._servo, self._state, given, np.arange(len(lanes)))
            if not failing:
                raise
            for lane, fault in failing:
                self._ends.end(int(lanes[lane]), fault, self._k)
            return self.step(observation, reference)
        for lane, fault in self._servo.faults.items():
            self._ends.end(int(lanes[lane]), fault, self._k)
        self._leave()
        self._k += 1
        self._u = self._ends.spread(self._ends.left_of(u, lanes), self._u)
        self._jacobian = self._ends.spread(self._servo.jacobian(self._state), self._jacobian)
        return Command(self._u)

    def _leave(self) -> None:
        """Let runs that ended leave the state."""
        self._state = self._ends.left_of(self._state, self._mine)
        self._mine = self._ends.running

    def estimated_jacobian(self) -> FloatArray:
        """See `Controller.estimated_jacobian`."""
        return self._jacobian

    def diagnostics(self) -> Diagnostics:
        """Return nothing: runs side by side keep no steps."""
        return {}


def failing_lanes(
    servo: Servo, state: ServoState, given: tuple[Any, ...], lanes: IntArray
) -> list[tuple[int, Exception]]:
    """Return the lanes in which a step fails, each with its error as a single run, by halving."""
    error = _error_of_step(servo, state, given, lanes)
    if error is None:
        return []
    if len(lanes) == 1:
        lane = int(lanes[0])
        # The step of a single lane, without the leading axis, fails with the words of a single run.
        return [(lane, _error_of_step(servo, state, given, lane) or error)]
    half = len(lanes) // 2
    return [
        *failing_lanes(servo, state, given, lanes[:half]),
        *failing_lanes(servo, state, given, lanes[half:]),
    ]


def _error_of_step(
    servo: Servo, state: ServoState, given: tuple[Any, ...], lanes: Lanes
) -> Exception | None:
    try:
        servo.step(take(state, lanes), *take(given, lanes))
    except Exception as error:  # noqa: BLE001 - a part may raise anything
        return error
    return None


@final
class ManyLogs(StepLog):
    """The log of runs side by side, without times and diagnostics."""

    def __init__(self, spec: PlantSpec, periods: int, ends: Ends) -> None:
        """Prepare an empty log with a lane for each run."""
        super().__init__(spec, periods, (len(ends.all),))
        self._ends = ends

    def end(self, lanes: BoolArray, fault: Exception) -> None:
        """End the runs in the lanes."""
        for lane in np.flatnonzero(lanes):
            self._ends.end(int(lane), fault, self._count)

    def steps(self) -> Steps:
        """Return the rows so far, without times."""
        for time in (self._rows.controller_time, self._rows.plant_time):
            time.fill(np.nan)
        return super().steps()


def side_by_side_key(run: ResolvedRun) -> Hashable | None:
    """Return the key that runs of one campaign must share to advance together; None for a run that goes alone."""
    request = run.request
    if not find_plant(request.plant).side_by_side:
        return None
    if not find_controller(request.controller).side_by_side:
        return None
    # The bits of a user's measure may be others for many robots than for one.
    if ".py" in request.sensing:
        return None
    moved = request.mismatch.size("camera_move") > 0.0
    names = request.plant, request.controller, request.task, moved, request.robot, request.sensing
    return (*names, *map(id, (run.run, run.plant, run.controller, run.task)))
