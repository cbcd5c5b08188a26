"""FMI 3.0 co-simulation."""

from __future__ import annotations

import ctypes
import math
import os
from functools import partial
from typing import Any, ClassVar

import numpy as np

from servobench.plant.contract.faults import FmuError
from servobench.plant.fmu.instance import OK, WARNING, Instance, Kinds, RawCall
from servobench.plant.fmu.port import Port

LogMessage = ctypes.CFUNCTYPE(None, ctypes.c_void_p, ctypes.c_int, ctypes.c_char_p, ctypes.c_char_p)


class Instance3(Instance):
    """One instance of an FMI 3.0 FMU; without event mode, so that events are handled inside its steps."""

    prefix, real, state, deserialise, early = "fmi3", "Float64", "FMUState", "Deserialize", "early"
    derivatives = "GetContinuousStateDerivatives"
    kinds: ClassVar[Kinds] = {
        "Float64": ("Float64", np.float64),
        "Float32": ("Float32", np.float32),
        **{
            f"{sign}Int{bits}": (f"{sign}Int{bits}", f"{sign}int{bits}".lower())
            for sign in ("", "U")
            for bits in (8, 16, 32, 64)
        },
        "Enumeration": ("Int64", np.int64),
        "Boolean": ("Boolean", np.bool_),
    }

    def _instantiate(self) -> int | None:
        log = self.log
        self._end, self._early, self._last_time = ctypes.c_bool(), ctypes.c_bool(), ctypes.c_double()

        def on_message(_environment: int | None, status: int, _category: bytes, message: bytes) -> None:
            log.add(status, (message or b"").decode("utf-8", errors="replace"))

        self._on_message = LogMessage(on_message)
        exchange = self.description.exchange
        create = self.function("InstantiateModelExchange" if exchange else "InstantiateCoSimulation")
        create.restype = ctypes.c_void_p
        no, null = ctypes.c_bool(False), ctypes.c_void_p()
        names = self.description.model_name, self.description.token, str(self.root / "resources") + os.sep
        common = [*(name.encode() for name in names), no, ctypes.c_bool(self.asked.debug_log is not None)]
        early_return = [no, ctypes.c_bool(True), null, ctypes.c_size_t(0)]  # without event mode
        end = [null, self._on_message]
        address: int | None = create(*common, *end) if exchange else create(*common, *early_return, *end, null)
        return address

    def _initialise(self, time: float) -> None:
        nothing, no, tolerance = ctypes.c_double(0.0), ctypes.c_bool(False), self.asked.tolerance
        wanted = ctypes.c_bool(tolerance is not None), ctypes.c_double(tolerance or 0.0)
        self.call("EnterInitializationMode", *wanted, ctypes.c_double(time), no, nothing)
        self.call("ExitInitializationMode")

    def step_call(self, now: ctypes.c_double, step: ctypes.c_double) -> RawCall:
        """See `Instance.step_call`."""
        if self.description.exchange:
            return self._integrated(now, step)
        end, early = self._end, self._early
        results = [ctypes.byref(result) for result in (ctypes.c_bool(), end, early, self._last_time)]
        call = partial(self.function("DoStep"), self._component, now, step, ctypes.c_bool(True), *results)
        return lambda: call() or (WARNING if end.value or early.value else OK)

    def update_discrete_states(self) -> tuple[bool, bool, float]:
        """See `Instance.update_discrete_states`."""
        again, ends, nominals, states, has_next = (ctypes.c_bool() for _ in range(5))
        following = ctypes.c_double()
        results = [ctypes.byref(each) for each in (again, ends, nominals, states, has_next, following)]
        self.call("UpdateDiscreteStates", *results)
        return again.value, ends.value, following.value if has_next.value else math.inf

    def _reached(self, status: int, time: float) -> float | None:
        self.check("fmi3DoStep", status)
        if self._end.value:
            raise FmuError(f"{self.description.path.name}: fmi3DoStep asked to end the simulation at {time:.6g} s")
        return self._last_time.value if self._early.value else None

    def _buffer(self, pointer: ctypes.c_void_p, size: int) -> tuple[Any, ...]:
        return pointer, ctypes.c_size_t(size)

    def configure(self, port: Port) -> None:
        """See `Instance.configure`."""
        self.call("EnterConfigurationMode")
        self.writer(port)()
        self.call("ExitConfigurationMode")
