"""FMI 3.0 co-simulation."""

from __future__ import annotations

import ctypes
import os
from collections.abc import Callable
from functools import partial

from servobench.plant.faults import FmuError
from servobench.plant.fmu.instance import MIN_PROGRESS, Instance, Port, RawCall

LogMessage = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)


class Instance3(Instance):
    """One instance of an FMI 3.0 FMU; without event mode, so that events are handled inside its steps."""

    def _instantiate(self) -> int | None:
        log = self.log

        def on_message(_environment: int | None, status: int, _category: bytes, message: bytes) -> None:
            log.add(status, (message or b"").decode("utf-8", errors="replace"))

        self._on_message = LogMessage(on_message)
        create = self.function("fmi3InstantiateCoSimulation")
        create.restype = ctypes.c_void_p
        no, null = ctypes.c_bool(False), ctypes.c_void_p()
        address: int | None = create(
            self.description.model_name.encode(),
            self.description.token.encode(),
            (str(self.root / "resources") + os.sep).encode(),
            no,
            no,
            no,
            ctypes.c_bool(True),  # it may return early
            null,
            ctypes.c_size_t(0),
            null,
            self._on_message,
            null,
        )
        return address

    def _free_instance(self) -> None:
        release = self.function("fmi3FreeInstance")
        release.restype = None
        release(self._component)

    def start(self, time: float) -> None:
        """Go through initialisation, to begin at `time`."""
        nothing, no = ctypes.c_double(0.0), ctypes.c_bool(False)
        self.call("fmi3EnterInitializationMode", no, nothing, ctypes.c_double(time), no, nothing)
        self.call("fmi3ExitInitializationMode")

    def reset(self) -> None:
        """Return to the state after instantiation."""
        self.call("fmi3Reset")

    def raw_reader(self, port: Port) -> RawCall:
        """Return a function that reads the port's variables into its buffer, for the inner loop."""
        return self._access("fmi3GetFloat64", port)

    def raw_writer(self, port: Port) -> RawCall:
        """Return a function that writes the port's buffer into its variables, for the inner loop."""
        return self._access("fmi3SetFloat64", port)

    def _access(self, function: str, port: Port) -> RawCall:
        sizes = ctypes.c_size_t(port.count), ctypes.c_size_t(port.values.size)
        return self.prebuilt(function, port.references, sizes[0], port.pointer, sizes[1])

    def stepper(self, step: float) -> Callable[[float], None]:
        """Return a function that advances from the time it is given, s, by `step`, s; it raises FmuError."""
        take = self._taker(ctypes.c_double(step))

        def advance(time: float) -> None:
            reached = take(time)
            if reached is not None:
                self._resume(reached, time, step)

        return advance

    def _taker(self, step: ctypes.c_double) -> Callable[[float], float | None]:
        """Return a function that takes one step from a time, s, and returns where it ended if it ended early.

        It reads the size of the step from `step` at every call.
        """
        now, reached = ctypes.c_double(), ctypes.c_double()
        event, end, early = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_bool()
        results = [ctypes.byref(result) for result in (event, end, early, reached)]
        call = partial(self.function("fmi3DoStep"), self._component, now, step, ctypes.c_bool(True), *results)

        def take(time: float) -> float | None:
            now.value = time
            status = call()
            if status:
                self.check("fmi3DoStep", status)
            if end.value:
                raise FmuError(f"{self.description.path.name}: fmi3DoStep asked to end the simulation at {time:.6g} s")
            return reached.value if early.value else None

        return take

    def _resume(self, reached: float | None, time: float, step: float) -> None:
        """Resume a step that returned early, until the whole step is done.

        Raises:
            FmuError: it made no progress.
        """
        end, least, rest = time + step, MIN_PROGRESS * step, ctypes.c_double()
        take = self._taker(rest)
        while reached is not None:
            if not reached > time + least:
                name = self.description.path.name
                raise FmuError(f"{name}: fmi3DoStep returned early at {reached:.6g} s, no further")
            if reached > end - least:
                return
            time, rest.value = reached, end - reached
            reached = take(time)

    def save(self) -> ctypes.c_void_p:
        """Return the present state; it has to be given to `free`."""
        state = ctypes.c_void_p()
        self.call("fmi3GetFMUState", ctypes.byref(state))
        return state

    def restore(self, state: ctypes.c_void_p) -> None:
        """Return to a saved state."""
        self.call("fmi3SetFMUState", state)

    def free(self, state: ctypes.c_void_p) -> None:
        """Free a saved state."""
        self.call("fmi3FreeFMUState", ctypes.byref(state))

    def to_bytes(self, state: ctypes.c_void_p) -> bytes:
        """Return a saved state as bytes that another process understands."""
        size = ctypes.c_size_t()
        self.call("fmi3SerializedFMUStateSize", state, ctypes.byref(size))
        content = (ctypes.c_char * size.value)()
        self.call("fmi3SerializeFMUState", state, content, size)
        return bytes(content)

    def from_bytes(self, content: bytes) -> ctypes.c_void_p:
        """Return a state from bytes; it has to be given to `free`."""
        state = ctypes.c_void_p()
        self.call("fmi3DeserializeFMUState", content, ctypes.c_size_t(len(content)), ctypes.byref(state))
        return state

    def derivative(self, unknowns: Port, knowns: Port) -> None:
        """Turn the seed in the buffer of `knowns` into the sensitivity in the buffer of `unknowns`."""
        self.call(
            "fmi3GetDirectionalDerivative",
            unknowns.references,
            ctypes.c_size_t(unknowns.count),
            knowns.references,
            ctypes.c_size_t(knowns.count),
            knowns.pointer,
            ctypes.c_size_t(knowns.values.size),
            unknowns.pointer,
            ctypes.c_size_t(unknowns.values.size),
        )
