"""FMI 2.0 co-simulation."""

from __future__ import annotations

import ctypes
import math
import weakref
from functools import partial
from typing import Any, ClassVar

import numpy as np

from servobench.plant.fmu.instance import DISCARD, OK, Instance, Kinds, RawCall
from servobench.plant.fmu.messages import MessageLog

MODEL_EXCHANGE, CO_SIMULATION = 0, 1
LAST_SUCCESSFUL_TIME = 2

_Logger = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_char_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)
_Allocate = ctypes.CFUNCTYPE(ctypes.c_void_p, ctypes.c_size_t, ctypes.c_size_t)
_Free = ctypes.CFUNCTYPE(None, ctypes.c_void_p)


class _EventInfo(ctypes.Structure):
    _fields_ = (
        ("again", ctypes.c_int),
        ("ends", ctypes.c_int),
        ("nominals_changed", ctypes.c_int),
        ("states_changed", ctypes.c_int),
        ("has_next", ctypes.c_int),
        ("next_time", ctypes.c_double),
    )


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

    prefix, real, state, deserialise, early = "fmi2", "Real", "FMUstate", "DeSerialize", "discard"
    derivatives = "GetDerivatives"
    kinds: ClassVar[Kinds] = {
        "Real": ("Real", np.float64),
        "Integer": ("Integer", np.int32),
        "Enumeration": ("Integer", np.int32),
        "Boolean": ("Boolean", np.int32),
    }

    def _instantiate(self) -> int | None:
        self._callbacks = _callbacks(self.log)
        create = self.function("Instantiate")
        create.restype = ctypes.c_void_p
        address: int | None = create(
            self.description.model_name.encode(),
            ctypes.c_int(MODEL_EXCHANGE if self.description.exchange else CO_SIMULATION),
            self.description.token.encode(),
            (self.root / "resources").as_uri().encode(),
            ctypes.byref(self._callbacks),
            ctypes.c_int(0),
            ctypes.c_int(self.asked.debug_log is not None),
        )
        return address

    def _initialise(self, time: float) -> None:
        no, nothing, tolerance = ctypes.c_int(0), ctypes.c_double(0.0), self.asked.tolerance
        wanted = ctypes.c_int(tolerance is not None), ctypes.c_double(tolerance or 0.0)
        self.call("SetupExperiment", *wanted, ctypes.c_double(time), no, nothing)
        self.call("EnterInitializationMode")
        self.call("ExitInitializationMode")

    def step_call(self, now: ctypes.c_double, step: ctypes.c_double) -> RawCall:
        """See `Instance.step_call`."""
        if self.description.exchange:
            return self._integrated(now, step)
        return partial(self.function("DoStep"), self._component, now, step, ctypes.c_int(1))

    def update_discrete_states(self) -> tuple[bool, bool, float]:
        """See `Instance.update_discrete_states`."""
        info = _EventInfo()
        self.call("NewDiscreteStates", ctypes.byref(info))
        return bool(info.again), bool(info.ends), info.next_time if info.has_next else math.inf

    def _reached(self, status: int, time: float) -> float | None:
        if status != DISCARD:
            self.check("fmi2DoStep", status)
            return None
        reached = ctypes.c_double()
        asked = ctypes.c_int(LAST_SUCCESSFUL_TIME), ctypes.byref(reached)
        if self.function("GetRealStatus")(self._component, *asked) != OK:
            raise self.log.failure("fmi2DoStep", "discard and not how far it came")
        return reached.value

    def _buffer(self, pointer: ctypes.c_void_p, size: int) -> tuple[Any, ...]:
        return (pointer,)


def _callbacks(log: MessageLog) -> _Callbacks:
    """Return the callbacks of an instance; fmpy's proxy formats messages with printf arguments, which ctypes cannot."""
    import fmpy  # noqa: PLC0415 - see parse_description

    callbacks = _Callbacks(
        logger=_on_message,
        allocate=ctypes.cast(fmpy.calloc, _Allocate),
        free=ctypes.cast(fmpy.free, _Free),
        environment=id(log),
    )
    _logs[id(log)] = log
    try:
        from fmpy.logging import addLoggerProxy  # noqa: PLC0415 - a library that not every platform has
    except OSError:
        return callbacks
    addLoggerProxy(ctypes.byref(callbacks))
    return callbacks
