"""One interface to an instance of an FMU for FMI 2 and FMI 3, with its ports and saved states.

An FMU of model exchange is stepped by the solver CVode that fmpy brings. Between two steps it is in event mode, where
commands of any kind may be set. A step goes through its events: those of time exactly, those of state where an
indicator changes sign.

The libraries are called by ctypes with argument objects that are made once: a call then costs a third of a
microsecond, whereas converting lists at every call costs several.
"""

import contextlib
import ctypes
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any, ClassVar, Literal, TypeAlias

import numpy as np

from servobench.plant.contract.checks import AnyArray, FloatArray, Shape
from servobench.plant.contract.faults import FmuError, one_line
from servobench.plant.fmu.description import FmuDescription, Variable, total_size
from servobench.plant.fmu.dialect import FmiDialect
from servobench.plant.fmu.library import Library, MessageLog
from servobench.plant.fmu.release import release

Call: TypeAlias = Callable[[], None]
RawCall: TypeAlias = Callable[[], int]  # The caller has to check the returned status.
# Statuses of FMI.
OK = 0
WARNING = 1
DISCARD = 2
FATAL = 4
MIN_PROGRESS = 1e-9  # least share of a step for a partial step
RELATIVE_TOLERANCE = 1e-8
MAX_SOLVER_STEPS = 100_000  # steps of CVode in one step of the plant
MAX_EVENT_ITERATIONS = 1000  # iterations at one instant


class Port:
    """Variables that are read or written together, with their buffer; instances side by side have a row each.

    Attributes:
        values: (..., size), the buffer.
        members: the variables themselves.
        variables: value references and their number, for C.
    """

    def __init__(self, variables: Sequence[Variable], lead: Shape = ()) -> None:
        """Prepare the buffer, whose leading axis is `lead`."""
        self.members = tuple(variables)
        self.values: FloatArray = np.zeros((*lead, total_size(variables)))
        self._address = self.values.ctypes.data
        count = len(variables)
        references = (ctypes.c_uint32 * count)(*(variable.reference for variable in variables))
        self.variables = references, ctypes.c_size_t(count)

    @property
    def labels(self) -> tuple[str, ...]:
        """A name for each number of a row, for messages."""
        return tuple(label for variable in self.members for label in variable.labels())

    @property
    def summary(self) -> str:
        """A few names, for messages."""
        labels = self.labels
        first = ", ".join(labels[:3])
        if len(labels) <= 3:
            return first
        return f"{first}, …"

    def pointer(self, row: int = 0) -> ctypes.c_void_p:
        """Return a row of the buffer, for C."""
        return ctypes.c_void_p(self._address + row * self.values.shape[-1] * self.values.itemsize)


class Instance(ABC):
    """One instance of an FMU."""

    dialect: ClassVar[FmiDialect]  # the version of FMI
    boolean: ClassVar[type[ctypes.c_int | ctypes.c_bool]]  # its truth values, for C

    def __init__(
        self, description: FmuDescription, tolerance: float | None, debug_log: Path | None
    ) -> None:
        """Make an instance; see `open_instance`."""
        self.description = description
        self.tolerance = tolerance
        self._debugs = debug_log is not None
        self.log = MessageLog(description.path.name, debug_log)
        self._begun = False  # whether it has to be terminated before it is freed
        self.library = Library(description)
        self._component = ctypes.c_void_p()
        self._states: list[ctypes.c_void_p] = []  # handles of saved states, freed with the instance
        try:
            self._component = ctypes.c_void_p(self._instantiate())
        except BaseException:
            self.close()
            raise
        if not self._component.value:
            self.close()
            raise self.log.failure(f"instantiation of {description.model_name!r}", -1)

    @abstractmethod
    def _instantiate(self) -> int | None:
        """Make an instance and return its address."""

    def start(self, time: float) -> None:
        """Go through initialisation, to begin at `time`."""
        has_tolerance = self.boolean(self.tolerance is not None)
        tolerance = ctypes.c_double(self.tolerance or 0.0)
        start = ctypes.c_double(time)
        has_stop = self.boolean(False)
        stop = ctypes.c_double()
        self._enter_initialisation(has_tolerance, tolerance, start, has_stop, stop)
        self.call("ExitInitializationMode")
        if self.description.exchange:
            self._integrator = Integrator(self)
        self._begun = True

    @abstractmethod
    def _enter_initialisation(self, *experiment: Any) -> None:  # noqa: ANN401 - types of C
        """Begin initialisation for an experiment: tolerance, start and stop time as the standard has them."""

    @abstractmethod
    def _do_step(self, now: ctypes.c_double, step: ctypes.c_double) -> RawCall:
        """Return the `step_call` of co-simulation."""

    @abstractmethod
    def update_discrete_states(self) -> tuple[bool, bool, float]:
        """Update the discrete states, in event mode of model exchange.

        Returns:
            Whether it has to be repeated, whether the FMU wants to end, and the time of the next event, s.
        """

    def step_call(self, now: ctypes.c_double, step: ctypes.c_double) -> RawCall:
        """Return a function that takes a step of size `step`, s, at the time `now`, s; both are read at every call.

        It returns 0 where the step was taken without anything to report; any other result is for `finish`. That of
        model exchange raises FmuError instead of returning a bad status.
        """
        if not self.description.exchange:
            return self._do_step(now, step)

        def advance() -> int:
            self._integrator.advance(now.value, step.value)
            return OK

        return advance

    @abstractmethod
    def _reached(self, status: int, time: float) -> float | None:
        """Return the time [s] at which a step from `time` ended early, by the result of its `step_call`; else None.

        Raises:
            FmuError: it failed.
        """

    def stepper(self, step: float) -> Callable[[float], None]:
        """Return a function that advances by `step`, s, from its argument, a time in s; it raises FmuError."""
        now = ctypes.c_double()
        call = self.step_call(now, ctypes.c_double(step))

        def advance(time: float) -> None:
            now.value = time
            self.finish(call(), time, step)

        return advance

    def finish(self, status: int, time: float, step: float) -> None:
        """Check a step by the result of its `step_call` and resume it until the whole step is done.

        Raises:
            FmuError: it failed, or made no progress.
        """
        if not status:
            return
        reached = self._reached(status, time)
        end = time + step
        least = MIN_PROGRESS * step
        now = ctypes.c_double()
        rest = ctypes.c_double()
        call = self.step_call(now, rest)
        while reached is not None:
            if not reached > time + least:
                outcome = f"{self.dialect.early} at {reached:.6g} s, no further"
                raise self.log.failure(f"{self.dialect.prefix}DoStep", outcome)
            if reached > end - least:
                return
            time = reached
            now.value = reached
            rest.value = end - reached
            reached = self._reached(call(), time)

    def reset(self) -> None:
        """Return to the state after instantiation."""
        self.call("Reset")
        self._begun = False

    @abstractmethod
    def _buffer(self, pointer: ctypes.c_void_p, size: int) -> tuple[Any, ...]:
        """Return the arguments that pass a buffer of `size` values to C."""

    def access(self, verb: Literal["Get", "Set"], port: Port, row: int = 0) -> RawCall:
        """Return a function that reads or writes the port's variables by a row of its buffer, for the inner loop."""
        width = port.values.shape[-1]
        real = self.dialect.real
        kinds = self.dialect.kinds
        if all(kinds[variable.type] == kinds[real] for variable in port.members):
            # One call of C for all variables, without a copy.
            function = self.function(f"{verb}{real}")
            place = self._buffer(port.pointer(row), width)
            return partial(function, self._component, *port.variables, *place)
        values = port.values.reshape(-1, width)[row]
        ends = np.cumsum([variable.size for variable in port.members])
        parts = np.split(values, ends[:-1])  # views of the buffer
        calls = []
        for variable, part in zip(port.members, parts, strict=True):
            calls.append(self._converted(verb, variable, part))
        return lambda: max(call() for call in calls)

    def _converted(
        self, verb: Literal["Get", "Set"], variable: Variable, values: FloatArray
    ) -> RawCall:
        """Return a function that reads or writes one variable of any numeric type by `values`."""
        word, kind = self.dialect.kinds[variable.type]
        buffer: AnyArray = np.zeros(variable.size, dtype=kind)
        function = self.function(f"{verb}{word}")
        place = self._buffer(ctypes.c_void_p(buffer.ctypes.data), variable.size)
        call = partial(function, self._component, *Port([variable]).variables, *place)

        def convert() -> int:
            if verb == "Set":
                buffer[:] = values
            status: int = call()
            if verb == "Get":
                values[:] = buffer
            return status

        return convert

    def set_texts(self, variables: Sequence[Variable], texts: Sequence[str]) -> None:
        """Give values to variables of text."""
        values = (ctypes.c_char_p * len(texts))(*(text.encode() for text in texts))
        place = self._buffer(ctypes.cast(values, ctypes.c_void_p), len(texts))
        self.call("SetString", *Port(variables).variables, *place)

    def configure(self, port: Port) -> None:
        """Set structural parameters, which give the sizes of arrays, before `start`.

        Raises:
            ValueError: this version of FMI has none.
        """
        raise ValueError(f"{self.description.path.name} has no structural parameters")

    def reader(self, port: Port) -> Call:
        """Return a function that reads the port's variables into its buffer and checks the status."""
        return self._checked("reading", port, self.access("Get", port))

    def writer(self, port: Port, row: int = 0) -> Call:
        """Return a function that writes a row of the port's buffer into its variables and checks the status."""
        return self._checked("writing", port, self.access("Set", port, row))

    def _checked(self, verb: str, port: Port, call: RawCall) -> Call:
        def checked() -> None:
            status = call()
            if status:
                self.check(f"{verb} {port.summary}", status)

        return checked

    def save(self) -> bytes | ctypes.c_void_p:
        """Return the present state as bytes, or as a handle of this instance for an FMU that cannot serialise."""
        if self.description.can_serialise:
            return self.save_bytes()
        state = self._state()
        self._states.append(state)
        return state

    def restore(self, saved: bytes | ctypes.c_void_p) -> None:
        """Return to a state from `save`."""
        if isinstance(saved, bytes):
            self.restore_bytes(saved)
        else:
            self.call(f"Set{self.dialect.state}", saved)

    def _state(self) -> ctypes.c_void_p:
        """Return a handle of the present state, which has to be given to `_free`."""
        state = ctypes.c_void_p()
        self.call(f"Get{self.dialect.state}", ctypes.byref(state))
        return state

    def _free(self, state: ctypes.c_void_p) -> None:
        self.call(f"Free{self.dialect.state}", ctypes.byref(state))

    def save_bytes(self) -> bytes:
        """Return the present state as bytes that another process understands."""
        state = self._state()
        try:
            size = ctypes.c_size_t()
            self.call(f"Serialized{self.dialect.state}Size", state, ctypes.byref(size))
            content = (ctypes.c_char * size.value)()
            self.call(f"Serialize{self.dialect.state}", state, content, size)
            return bytes(content)
        finally:
            self._free(state)

    def restore_bytes(self, content: bytes) -> None:
        """Return to a state from `save_bytes`."""
        state = ctypes.c_void_p()
        size = ctypes.c_size_t(len(content))
        function = f"{self.dialect.deserialise}{self.dialect.state}"
        self.call(function, content, size, ctypes.byref(state))
        try:
            self.restore(state)
        finally:
            self._free(state)

    def close(self) -> None:
        """End and free the instance with its saved states and unload its library; see `release`.

        Calling it twice is allowed.
        """
        release(self._release)

    def _release(self) -> None:
        if self._component.value and not self.library.condemned:
            with contextlib.suppress(FmuError):  # The run has ended.
                for state in self._states:
                    self._free(state)
            if self._begun:
                with contextlib.suppress(FmuError):
                    self.function("Terminate")(self._component)
            with contextlib.suppress(FmuError):
                free = self.function("FreeInstance")
                free.restype = None
                free(self._component)
        self._component = ctypes.c_void_p()
        self._begun = False
        self.library.unload()

    def check(self, function: str, status: int) -> None:
        """Raise unless `status` is good.

        Raises:
            FmuError: it is not.
        """
        if status > WARNING or status < OK:
            self._begun = False  # After an error an instance may only be freed.
            if status == FATAL:
                self.library.condemn()
            raise self.log.failure(function, status)

    def call(self, name: str, *arguments: Any) -> None:  # noqa: ANN401 - types of C
        """Call a function of the library on the instance and check its status; not for the inner loop."""
        if self.library.condemned:
            raise FmuError(
                f"{self.description.path.name} reported a fatal error before, so it cannot be called again"
            )
        status = self.function(name)(self._component, *arguments)
        self.check(f"{self.dialect.prefix}{name}", status)

    def function(self, name: str) -> Any:  # noqa: ANN401 - a ctypes function
        """Return a function of the library by its name without prefix.

        Raises:
            FmuError: the library does not have it.
        """
        full_name = f"{self.dialect.prefix}{name}"
        try:
            return getattr(self.library.loaded, full_name)
        except AttributeError as error:
            file = self.description.path.name
            raise FmuError(f"the library in {file} does not export {full_name}") from error


class Integrator:
    """dx/dt = f(x, u) with events, from one step to the next under held inputs u."""

    def __init__(self, instance: Instance) -> None:
        """Take an instance of model exchange in event mode."""
        self._instance = instance
        self._solver: Any = None
        self._fault: FmuError | None = None

    def advance(self, time: float, step: float) -> None:
        """Take a step of size `step`, s, from `time`, s.

        Raises:
            FmuError: the FMU refused something, wants to end, or the solver found no way.
        """
        event_time = self._settle()
        end = time + step
        self._begin(time)
        while time < end:
            state_event, time = self._solve(time, min(end, event_time))
            if math.isclose(time, end, rel_tol=1e-14, abs_tol=1e-14):
                time = end
            self._instance.call("SetTime", ctypes.c_double(time))
            is_event = state_event or self._asks_for_event() or time >= event_time
            if is_event and time < end:
                self._instance.call("EnterEventMode")
                event_time = self._settle()
                self._begin(time)
        self._instance.call("EnterEventMode")

    def _settle(self) -> float:
        """Update the discrete states until they are settled; return the time of the next event, or infinity."""
        for _ in range(MAX_EVENT_ITERATIONS):
            again, ends, following = self._instance.update_discrete_states()
            if ends:
                raise FmuError(
                    f"{self._instance.description.path.name} asked to end the simulation"
                )
            if not again:
                self._instance.call("EnterContinuousTimeMode")
                return following
        raise FmuError(
            f"{self._instance.description.path.name}: discrete states do not settle at an event"
        )

    def _asks_for_event(self) -> bool:
        """Return whether the FMU wants an event after a step of the solver."""
        enter = ctypes.c_int()
        ends = ctypes.c_int()
        no_earlier_state = ctypes.c_int(1)  # The FMU need not keep states before this one.
        self._instance.call(
            "CompletedIntegratorStep", no_earlier_state, ctypes.byref(enter), ctypes.byref(ends)
        )
        if ends.value:
            raise FmuError(f"{self._instance.description.path.name} asked to end the simulation")
        return bool(enter.value)

    def _begin(self, time: float) -> None:
        """Start the solver from the present states."""
        if self._solver is None:
            self._solver = self._make(time)
        else:
            self._solver.reset(time)
        self._raise_fault()

    def _solve(self, time: float, until: float) -> tuple[bool, float]:
        """Return whether a state event ended the integration before `until`, and the time reached."""
        try:
            event, _, reached = self._solver.step(time, until)
        except RuntimeError as error:
            self._raise_fault()
            raise FmuError(
                f"{self._instance.description.path.name} cannot be integrated: {one_line(error)}"
            ) from error
        self._raise_fault()
        return bool(event), float(reached)

    def _raise_fault(self) -> None:
        if self._fault is not None:
            raise self._fault

    def _make(self, time: float) -> Any:  # noqa: ANN401 - fmpy's solver carries no types
        instance = self._instance
        description = instance.description
        try:
            from fmpy.sundials import CVodeSolver  # noqa: PLC0415 - a library that not every platform has
        except OSError as error:
            raise FmuError(
                f"{description.path.name} offers model exchange only, and fmpy has no solver for this machine"
            ) from error
        set_time = self._guarded(lambda now: instance.call("SetTime", ctypes.c_double(now)))
        # Inputs stay as they are within a step.
        held_inputs = SimpleNamespace(apply=lambda _time: None)
        return CVodeSolver(
            nx=description.n_states,
            nz=description.n_indicators,
            get_x=self._vector("GetContinuousStates"),
            set_x=self._vector("SetContinuousStates"),
            get_dx=self._vector(instance.dialect.derivatives),
            get_z=self._vector("GetEventIndicators"),
            get_nominals=self._vector("GetNominalsOfContinuousStates"),
            set_time=set_time,
            input=held_inputs,
            startTime=time,
            relativeTolerance=instance.tolerance or RELATIVE_TOLERANCE,
            maxNumSteps=MAX_SOLVER_STEPS,
        )

    def _vector(self, name: str) -> Callable[..., None]:
        """Return a callback that reads or writes a vector by a function of the FMU."""
        call = self._instance.call
        return self._guarded(lambda values, size: call(name, values, ctypes.c_size_t(size)))

    def _guarded(self, act: Callable[..., None]) -> Callable[..., None]:
        """Return a callback for C that stores the first exception in place of raising it."""

        def guarded(*arguments: Any) -> None:  # noqa: ANN401 - of the solver
            if self._fault is None:
                try:
                    act(*arguments)
                except FmuError as fault:
                    self._fault = fault

        return guarded
