"""FMI 2.0 co-simulation."""

from __future__ import annotations

import ctypes
import weakref
from collections.abc import Callable
from functools import partial
from typing import Any

from servobench.plant.fmu.instance import DISCARD, MIN_PROGRESS, Instance, MessageLog, Port, RawCall

CO_SIMULATION = 1
LAST_SUCCESSFUL_TIME = 2

_Logger = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)
_Allocate = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t)
_Free = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


class _Callbacks(ctypes.Structure):
    _fields_ = (
        ("logger", _Logger),
        ("allocate", _Allocate),
        ("free", _Free),
        ("step_finished", ctypes.c_void_p),
        ("environment", ctypes.c_void_p),
    )


_logs: weakref.WeakValueDictionary[int, MessageLog] = weakref.WeakValueDictionary()


def _log_message(environment: int | None, _name: bytes, status: int, _category: bytes, message: bytes) -> None:
    """Pass a message to the log of the instance that it came from; the environment says which."""
    log = _logs.get(environment or 0) or MessageLog("fmu")
    log.add(status, (message or b"").decode("utf-8", errors="replace"))


_on_message = _Logger(_log_message)


class Instance2(Instance):
    """One instance of an FMI 2.0 FMU."""

    def _instantiate(self) -> int | None:
        self._callbacks = _callbacks(self.log)
        create = self.function("fmi2Instantiate")
        create.restype = ctypes.c_void_p
        address: int | None = create(
            self.description.model_name.encode(),
            ctypes.c_int(CO_SIMULATION),
            self.description.token.encode(),
            (self.root / "resources").as_uri().encode(),
            ctypes.byref(self._callbacks),
            ctypes.c_int(0),
            ctypes.c_int(0),
        )
        return address

    def _free_instance(self) -> None:
        release = self.function("fmi2FreeInstance")
        release.restype = None
        release(self._component)

    def start(self, time: float) -> None:
        """Go through initialisation, to begin at `time`."""
        nothing = ctypes.c_double(0.0)
        no = ctypes.c_int(0)
        self.call("fmi2SetupExperiment", no, nothing, ctypes.c_double(time), no, nothing)
        self.call("fmi2EnterInitializationMode")
        self.call("fmi2ExitInitializationMode")

    def reset(self) -> None:
        """Return to the state after instantiation."""
        self.call("fmi2Reset")

    def raw_reader(self, port: Port) -> RawCall:
        """Return a function that reads the port's variables into its buffer, for the inner loop."""
        return self.prebuilt("fmi2GetReal", port.references, ctypes.c_size_t(port.count), port.pointer)

    def raw_writer(self, port: Port) -> RawCall:
        """Return a function that writes the port's buffer into its variables, for the inner loop."""
        return self.prebuilt("fmi2SetReal", port.references, ctypes.c_size_t(port.count), port.pointer)

    def stepper(self, step: float) -> Callable[[float], None]:
        """Return a function that advances from the time it is given, s, by `step`, s; it raises FmuError."""
        now, do_step = ctypes.c_double(), self.function("fmi2DoStep")
        call = partial(do_step, self._component, now, ctypes.c_double(step), _YES)

        def advance(time: float) -> None:
            now.value = time
            status = call()
            if status:
                self._recover(status, time, step)

        return advance

    def _recover(self, status: int, time: float, step: float) -> None:
        """Resume a step that the FMU ended early, until the whole step is done.

        Raises:
            FmuError: the step failed, or made no progress.
        """
        do_step, end, least = self.function("fmi2DoStep"), time + step, MIN_PROGRESS * step
        while status == DISCARD:
            reached = self._last_successful_time()
            if not reached > time + least:
                raise self.log.failure("fmi2DoStep", status)
            if reached > end - least:
                return
            time = reached
            status = do_step(self._component, ctypes.c_double(time), ctypes.c_double(end - time), _YES)
        self.check("fmi2DoStep", status)

    def _last_successful_time(self) -> float:
        reached = ctypes.c_double()
        self.call("fmi2GetRealStatus", ctypes.c_int(LAST_SUCCESSFUL_TIME), ctypes.byref(reached))
        return reached.value

    def save(self) -> ctypes.c_void_p:
        """Return the present state; it has to be given to `free`."""
        state = ctypes.c_void_p()
        self.call("fmi2GetFMUstate", ctypes.byref(state))
        return state

    def restore(self, state: ctypes.c_void_p) -> None:
        """Return to a saved state."""
        self.call("fmi2SetFMUstate", state)

    def free(self, state: ctypes.c_void_p) -> None:
        """Free a saved state."""
        self.call("fmi2FreeFMUstate", ctypes.byref(state))

    def to_bytes(self, state: ctypes.c_void_p) -> bytes:
        """Return a saved state as bytes that another process understands."""
        size = ctypes.c_size_t()
        self.call("fmi2SerializedFMUstateSize", state, ctypes.byref(size))
        content = (ctypes.c_char * size.value)()
        self.call("fmi2SerializeFMUstate", state, content, size)
        return bytes(content)

    def from_bytes(self, content: bytes) -> ctypes.c_void_p:
        """Return a state from bytes; it has to be given to `free`."""
        state = ctypes.c_void_p()
        self.call("fmi2DeSerializeFMUstate", content, ctypes.c_size_t(len(content)), ctypes.byref(state))
        return state

    def derivative(self, unknowns: Port, knowns: Port) -> None:
        """Turn the seed in the buffer of `knowns` into the sensitivity in the buffer of `unknowns`."""
        self.call(
            "fmi2GetDirectionalDerivative",
            unknowns.references,
            ctypes.c_size_t(unknowns.count),
            knowns.references,
            ctypes.c_size_t(knowns.count),
            knowns.pointer,
            unknowns.pointer,
        )


_YES = ctypes.c_int(1)


def _callbacks(log: MessageLog) -> _Callbacks:
    """Return the callbacks of an instance; fmpy's proxy formats messages with printf arguments, which ctypes cannot."""
    import fmpy  # noqa: PLC0415 - see read_description

    callbacks = _Callbacks(
        logger=_on_message,
        allocate=ctypes.cast(fmpy.calloc, _Allocate),
        free=ctypes.cast(fmpy.free, _Free),
        environment=id(log),
    )
    _logs[id(log)] = log
    proxy = _logger_proxy()
    if proxy is not None:
        proxy(ctypes.byref(callbacks))
    return callbacks


def _logger_proxy() -> Any:  # noqa: ANN401 - a ctypes function
    try:
        from fmpy.logging import addLoggerProxy  # noqa: PLC0415 - a library that not every platform has
    except OSError:
        return None
    return addLoggerProxy
