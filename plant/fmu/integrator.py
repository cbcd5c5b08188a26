"""Steps an FMU that offers model exchange only, by the solver CVode that fmpy brings.

Between two steps the FMU is in event mode, where commands of any kind may be set. A step goes through its events: those
of time exactly, those of state where an indicator changes sign.
"""

import ctypes
import math
from collections.abc import Callable
from typing import Any, Final, Protocol

from servobench.plant.contract.faults import FmuError
from servobench.plant.fmu.description import FmuDescription
from servobench.plant.fmu.library import InstanceOptions

RELATIVE_TOLERANCE: Final = 1e-8
MAX_SOLVER_STEPS: Final = 100_000  # steps of CVode in one step of the plant
MAX_EVENT_ITERATIONS: Final = 1000  # iterations at one instant


class Exchanging(Protocol):
    """The part of an instance of model exchange that is used here."""

    description: FmuDescription
    options: InstanceOptions

    def call(self, name: str, *arguments: Any) -> None:  # noqa: ANN401 - types of C
        """Call a function of the library and check its status; raises FmuError."""

    def update_discrete_states(self) -> tuple[bool, bool, float]:
        """Return whether to repeat it, whether the FMU wants to end, and the time of the next event, s."""


class _Held:
    """Inputs that stay as they are within a step, as fmpy's solver asks for them."""

    def apply(self, _time: float) -> None:
        """Do nothing."""


class Integrator:
    """dx/dt = f(x, u) with events, from one step to the next under held inputs u."""

    def __init__(self, instance: Exchanging, derivatives: str) -> None:
        """Take an instance in event mode.

        Args:
            instance: of model exchange.
            derivatives: name of the function that returns derivatives.
        """
        self._instance, self._derivatives = instance, derivatives
        self._solver: Any = None
        self._fault: FmuError | None = None

    def advance(self, time: float, step: float) -> None:
        """Take a step of size `step`, s, from `time`, s.

        Raises:
            FmuError: the FMU refused something, wants to end, or the solver found no way.
        """
        event_time, end = self._settle(), time + step
        self._begin(time)
        while time < end:
            reached = self._solve(time, min(end, event_time))
            time = end if math.isclose(reached[1], end, rel_tol=1e-14, abs_tol=1e-14) else reached[1]
            self._instance.call("SetTime", ctypes.c_double(time))
            if (reached[0] or self._asks_for_event() or time >= event_time) and time < end:
                self._instance.call("EnterEventMode")
                event_time = self._settle()
                self._begin(time)
        self._instance.call("EnterEventMode")

    def _settle(self) -> float:
        """Update the discrete states until they are settled; return the time of the next event, or infinity."""
        for _ in range(MAX_EVENT_ITERATIONS):
            again, ends, following = self._instance.update_discrete_states()
            if ends:
                raise FmuError(f"{self._instance.description.path.name} asked to end the simulation")
            if not again:
                self._instance.call("EnterContinuousTimeMode")
                return following
        raise FmuError(f"{self._instance.description.path.name}: discrete states do not settle at an event")

    def _asks_for_event(self) -> bool:
        enter, ends = ctypes.c_int(), ctypes.c_int()
        self._instance.call("CompletedIntegratorStep", ctypes.c_int(1), ctypes.byref(enter), ctypes.byref(ends))
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
            words = " ".join(str(error).split())
            raise FmuError(f"{self._instance.description.path.name} cannot be integrated: {words}") from error
        self._raise_fault()
        return bool(event), float(reached)

    def _raise_fault(self) -> None:
        if self._fault is not None:
            raise self._fault

    def _make(self, time: float) -> Any:  # noqa: ANN401 - fmpy's solver carries no types
        try:
            from fmpy.sundials import CVodeSolver  # noqa: PLC0415 - a library that not every platform has
        except OSError as error:
            name = self._instance.description.path.name
            raise FmuError(f"{name} offers model exchange only, and fmpy has no solver for this machine") from error
        description = self._instance.description
        return CVodeSolver(
            nx=description.n_states,
            nz=description.n_indicators,
            get_x=self._vector("GetContinuousStates"),
            set_x=self._vector("SetContinuousStates"),
            get_dx=self._vector(self._derivatives),
            get_z=self._vector("GetEventIndicators"),
            get_nominals=self._vector("GetNominalsOfContinuousStates"),
            set_time=self._guarded(lambda now: self._instance.call("SetTime", ctypes.c_double(now))),
            input=_Held(),
            startTime=time,
            relativeTolerance=self._instance.options.tolerance or RELATIVE_TOLERANCE,
            maxNumSteps=MAX_SOLVER_STEPS,
        )

    def _vector(self, name: str) -> Callable[..., None]:
        return self._guarded(lambda values, size: self._instance.call(name, values, ctypes.c_size_t(size)))

    def _guarded(self, act: Callable[..., None]) -> Callable[..., None]:
        """Return a callback for C that stores the first exception in place of raising it."""

        def guarded(*arguments: Any) -> None:  # noqa: ANN401 - of the solver
            if self._fault is None:
                try:
                    act(*arguments)
                except FmuError as fault:
                    self._fault = fault

        return guarded
