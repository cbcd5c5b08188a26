"""The instances of one FMU for runs side by side, by FMI 2.0 or FMI 3.0: opened, called, dropped and closed together.

The instances share the library. A single run has one instance. The inner loop calls one function of all instances and
then the next; a call returns a status, which is 0 unless there is something to settle. An instance that fails is not
called again.
"""

import ctypes
import math
import os
import weakref
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

from servobench.plant.contract.faults import FmuError
from servobench.plant.fmu.description import FmuDescription
from servobench.plant.fmu.dialect import FMI2, FMI3
from servobench.plant.fmu.instance import DISCARD, OK, WARNING, Instance, Port, RawCall
from servobench.plant.fmu.library import MessageLog, plain_root

# Codes of FMI 2: types of an FMU, and a status that can be asked for.
MODEL_EXCHANGE = 0
CO_SIMULATION = 1
LAST_SUCCESSFUL_TIME = 2


@dataclass(frozen=True, eq=False)
class Lane:
    """The instance of a run and the calls of the inner loop, which return a status."""

    instance: Instance  # the lane's own instance of the FMU
    row: int  # its row in the buffers of all ports
    write: RawCall  # writes the command
    step: RawCall  # takes one step
    read: RawCall  # reads joints and feature
    read_truth: RawCall  # reads the true feature and, where it is mapped, the Jacobian


class Instances:
    """The lanes of an FMU.

    Attributes:
        lanes: one for each run; empty after `close`.
        live: those of them that have not failed.
    """

    def __init__(self, fail: Callable[[int, FmuError], None]) -> None:
        """Begin without lanes; `fail` takes the fault of a lane, or raises it."""
        self._fail = fail
        self.lanes: list[Lane] = []
        self.live: list[Lane] = []

    def open(
        self, count: int, make: Callable[[], Instance], connect: Callable[[Instance, int], Lane]
    ) -> None:
        """Make `count` instances; `connect` makes the lane of an instance with the row of its buffers."""
        for row in range(count):
            instance = make()
            try:
                self.lanes.append(connect(instance, row))
            except BaseException:
                instance.close()
                raise
        self.revive()

    def revive(self) -> None:
        """Call all instances again, also those that failed."""
        self.live = list(self.lanes)

    def each(self, act: Callable[..., None], *results: Sequence[int]) -> None:
        """Call `act`, outside the inner loop, with each lane that has not failed and with its results."""
        for lane, *own in list(zip(self.live, *results, strict=True)):
            if lane in self.live:
                try:
                    act(lane, *own)
                except FmuError as fault:
                    self.drop(lane, fault)

    def check(self, verb: str, port: Port, statuses: Sequence[int]) -> None:
        """Check the statuses of calls that read or write a port."""
        if any(statuses):
            what = f"{verb} {port.summary}"
            self.each(lambda lane, status: lane.instance.check(what, status), statuses)

    def finish(self, results: Sequence[int], time: float, step: float) -> None:
        """Check the results of steps of size `step`, s, from `time`, s, and resume those that ended early."""
        if any(results):
            self.each(lambda lane, result: lane.instance.finish(result, time, step), results)

    def drop(self, lane: Lane, fault: FmuError) -> None:
        """Stop calling an instance after a fault, and all others if the fault is fatal; that of a single run raises."""
        fatal = lane.instance.library.condemned
        stopped = [each for each in self.live if fatal or each is lane]
        for each in stopped:
            self._fail(self.lanes.index(each), fault)
            self.live.remove(each)

    def keep(self, chosen: Sequence[int]) -> None:
        """Close all other instances."""
        others = set(range(len(self.lanes))).difference(chosen)
        for i in others:
            self.lanes[i].instance.close()
        self.lanes = [self.lanes[i] for i in chosen]
        self.live = [lane for lane in self.lanes if lane in self.live]

    def close(self) -> None:
        """Free all instances; calling it twice is allowed."""
        for lane in self.lanes:
            lane.instance.close()
        self.lanes = self.live = []


def open_instance(
    description: FmuDescription, tolerance: float | None = None, debug_log: Path | None = None
) -> Instance:
    """Return an instance of an FMU, which the caller closes.

    Args:
        description: of the FMU.
        tolerance: relative one of its own solver, or of CVode in model exchange; None: the solver's own.
        debug_log: file to which all of its messages are appended, with its debug log turned on; None: it is off.

    Raises:
        ValueError: no library for this machine, or one that cannot be loaded.
        FmuError: the FMU refused to make an instance.
    """
    return INSTANCES[description.version](description, tolerance, debug_log)


_Logger = ctypes.CFUNCTYPE(
    None, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p
)

_logs: weakref.WeakValueDictionary[int, MessageLog] = weakref.WeakValueDictionary()


def _log_message(
    environment: int | None, _name: bytes, status: int, _category: bytes, message: bytes | None
) -> None:
    """Pass a message to the log of the instance that it came from; the environment identifies it."""
    log = _logs.get(environment or 0) or MessageLog("fmu")
    log.add(status, message)


_on_message = _Logger(_log_message)


class Instance2(Instance):
    """One instance of an FMI 2.0 FMU."""

    dialect = FMI2
    boolean = ctypes.c_int

    def _instantiate(self) -> int | None:
        self._callbacks = _callbacks(self.log)
        create = self.function("Instantiate")
        create.restype = ctypes.c_void_p
        description = self.description
        interface = MODEL_EXCHANGE if description.exchange else CO_SIMULATION
        resources = (plain_root(description.root) / "resources").as_uri()
        invisible = 0
        return create(
            description.model_name.encode(),
            interface,
            description.token.encode(),
            resources.encode(),
            ctypes.byref(self._callbacks),
            invisible,
            int(self._debugs),
        )

    def _enter_initialisation(self, *experiment: Any) -> None:  # noqa: ANN401 - types of C
        self.call("SetupExperiment", *experiment)
        self.call("EnterInitializationMode")

    def _do_step(self, now: ctypes.c_double, step: ctypes.c_double) -> RawCall:
        return partial(self.function("DoStep"), self._component, now, step, ctypes.c_int(1))

    def update_discrete_states(self) -> tuple[bool, bool, float]:
        """See `Instance.update_discrete_states`."""
        from fmpy.fmi2 import fmi2EventInfo  # noqa: PLC0415 - see parse_description

        info = fmi2EventInfo()
        self.call("NewDiscreteStates", ctypes.byref(info))
        again = bool(info.newDiscreteStatesNeeded)
        ends = bool(info.terminateSimulation)
        following = info.nextEventTime if info.nextEventTimeDefined else math.inf
        return again, ends, following

    def _reached(self, status: int, time: float) -> float | None:
        if status != DISCARD:
            self.check(f"at {time:.6g} s, fmi2DoStep", status)
            return None
        reached = ctypes.c_double()
        lack = "not how far it came"
        try:
            read = self.function("GetRealStatus")
            answer = read(
                self._component, ctypes.c_int(LAST_SUCCESSFUL_TIME), ctypes.byref(reached)
            )
        except FmuError as fault:
            answer = DISCARD
            lack += f": {fault}"
        if answer != OK:
            raise self.log.failure(f"at {time:.6g} s, fmi2DoStep", f"discard and {lack}")
        return reached.value

    def _buffer(self, pointer: ctypes.c_void_p, size: int) -> tuple[Any, ...]:
        return (pointer,)


def _callbacks(log: MessageLog) -> Any:  # noqa: ANN401 - fmpy's structures carry no types
    """Return the callbacks of an instance; fmpy's proxy formats messages with printf arguments, which ctypes cannot."""
    import fmpy  # noqa: PLC0415 - see parse_description
    from fmpy import fmi2  # noqa: PLC0415

    callbacks = fmi2.fmi2CallbackFunctions(
        logger=_on_message,
        allocateMemory=ctypes.cast(fmpy.calloc, fmi2.fmi2CallbackAllocateMemoryTYPE),
        freeMemory=ctypes.cast(fmpy.free, fmi2.fmi2CallbackFreeMemoryTYPE),
        componentEnvironment=id(log),
    )
    _logs[id(log)] = log
    try:
        from fmpy.logging import addLoggerProxy  # noqa: PLC0415 - a library that not every platform has
    except OSError:
        return callbacks
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks


LogMessage = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)


class Instance3(Instance):
    """One instance of an FMI 3.0 FMU; without event mode, so that events are handled inside its steps."""

    dialect = FMI3
    boolean = ctypes.c_bool

    def _instantiate(self) -> int | None:
        log = self.log
        # Results of a step: whether the FMU wants to end, whether it ended early, and when.
        self._end = ctypes.c_bool()
        self._early = ctypes.c_bool()
        self._last_time = ctypes.c_double()

        def on_message(
            _environment: int | None, status: int, _category: bytes, message: bytes | None
        ) -> None:
            log.add(status, message)

        self._on_message = LogMessage(on_message)
        exchange = self.description.exchange
        create = self.function(
            "InstantiateModelExchange" if exchange else "InstantiateCoSimulation"
        )
        create.restype = ctypes.c_void_p
        no = ctypes.c_bool(False)
        null = ctypes.c_void_p()
        resources = plain_root(self.description.root) / "resources"
        common = [
            self.description.model_name.encode(),
            self.description.token.encode(),
            (str(resources) + os.sep).encode(),
            no,  # visible
            ctypes.c_bool(self._debugs),
        ]
        messages = [null, self._on_message]
        # Without event mode and intermediate updates; steps may return early.
        steps = [no, ctypes.c_bool(True), null, ctypes.c_size_t(0)]
        arguments = [*common, *messages] if exchange else [*common, *steps, *messages, null]
        return create(*arguments)

    def _enter_initialisation(self, *experiment: Any) -> None:  # noqa: ANN401 - types of C
        self.call("EnterInitializationMode", *experiment)

    def _do_step(self, now: ctypes.c_double, step: ctypes.c_double) -> RawCall:
        end = self._end
        early = self._early
        needs_event = ctypes.c_bool()  # not used without event mode
        results = [ctypes.byref(each) for each in (needs_event, end, early, self._last_time)]
        no_earlier_state = ctypes.c_bool(True)  # The FMU need not keep states before this step.
        function = self.function("DoStep")
        call = partial(function, self._component, now, step, no_earlier_state, *results)
        return lambda: call() or (WARNING if end.value or early.value else OK)

    def update_discrete_states(self) -> tuple[bool, bool, float]:
        """See `Instance.update_discrete_states`."""
        again, ends, nominals, states, has_next = (ctypes.c_bool() for _ in range(5))
        following = ctypes.c_double()
        results = (again, ends, nominals, states, has_next, following)
        self.call("UpdateDiscreteStates", *(ctypes.byref(each) for each in results))
        event_time = following.value if has_next.value else math.inf
        return again.value, ends.value, event_time

    def _reached(self, status: int, time: float) -> float | None:
        self.check(f"at {time:.6g} s, fmi3DoStep", status)
        if self._end.value:
            raise FmuError(
                f"{self.description.path.name}: fmi3DoStep asked to end the simulation at {time:.6g} s"
            )
        if self._early.value:
            return self._last_time.value
        return None

    def _buffer(self, pointer: ctypes.c_void_p, size: int) -> tuple[Any, ...]:
        return pointer, ctypes.c_size_t(size)

    def configure(self, port: Port) -> None:
        """See `Instance.configure`."""
        self.call("EnterConfigurationMode")
        self.writer(port)()
        self.call("ExitConfigurationMode")


INSTANCES = {kind.dialect.version: kind for kind in (Instance2, Instance3)}
