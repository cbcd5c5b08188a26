"""Any FMI 2 or FMI 3 co-simulation FMU as a world.

An `FmuMapping` says which variables are commands, joints and features; names are looked up once, at construction. The
FMU is stepped with its own period, which divides the control period; commands are held meanwhile. Delay, noise, latency
and lost frames are those of `servobench.plant.bench`.
"""

from __future__ import annotations

import ctypes
from collections.abc import Callable
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from servobench.plant.bench import Bench, SensingConfig, World
from servobench.plant.checks import FloatArray, as_vector, whole_steps
from servobench.plant.faults import FmuError
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import FmuDescription, read_description
from servobench.plant.fmu.instance import Call, Instance, Port
from servobench.plant.fmu.instance2 import Instance2
from servobench.plant.fmu.instance3 import Instance3
from servobench.plant.fmu.mapping import FmuMapping, mapping_spec, read_mapping
from servobench.plant.fmu.model_exchange import mapped_model
from servobench.plant.plant import PlantEntry, PlantSetup, TrueModel
from servobench.plant.robot.arm import rpy_from_rotation
from servobench.plant.settings import Names, Periods, nested, settings
from servobench.plant.signals import Truth


@settings
class FmuConfig:
    """Settings of an FMU plant; the same as those of the kinematic plant where both have them."""

    command_delay_periods: Periods = 1
    """[periods] between a command and its first effect."""
    sensing: SensingConfig = nested(SensingConfig)
    """Noise, latency and lost frames."""


@dataclass(frozen=True, eq=False)
class FmuState:
    """A saved state of an FMU's world.

    Attributes:
        fmu: bytes for any process with the same FMU, or, if it cannot serialise, a handle of the world that saved it.
        period: number of periods since the start.
        integrated: (n,), rad, joint positions of an FMU that has none itself.
    """

    fmu: bytes | ctypes.c_void_p
    period: int
    integrated: FloatArray


class FmuWorld(World):
    """y, q ← fmi…GetReal after fmi…DoStep under the held command."""

    def __init__(self, mapping: FmuMapping, start: FloatArray | None, period: float) -> None:
        """Extract and load the FMU and look all names up.

        Args:
            mapping: the roles of its variables.
            start: (n,), rad, joint positions at time 0, for an FMU with a home or without joints; None: the FMU's own
                home, or 0.
            period: control period, s.

        Raises:
            ValueError: an FMU that cannot be used, or a name or size that does not fit.
            FmuError: the FMU refused its parameters or its initialisation.
        """
        self._substeps = whole_steps(period, mapping.period or period)
        self._own_step, self._period = mapping.period or period, period
        self._states: list[ctypes.c_void_p] = []
        self._mapping = mapping
        root = extract_fmu(mapping.file)
        self.description = read_description(mapping.file, root)
        self.spec = mapping_spec(mapping, self.description, period)
        self._has_start = start is not None
        self._start = as_vector("start", np.zeros(self.spec.n) if start is None else start, self.spec.n)
        self._instance = open_instance(self.description, root)
        try:
            self._connect(mapping)
            self._initialise()
        except BaseException:
            self.close()
            raise

    def _connect(self, mapping: FmuMapping) -> None:
        """Make the ports; the parameters' and the truth's are used outside the loop only."""
        find, instance = self.description.select, self._instance
        self._has_joints = bool(mapping.joints)
        self._command = Port(find(mapping.inputs, "inputs"))
        self._result = Port(find((*mapping.joints, *mapping.features), "joints and features"))
        self._write, self._read = instance.access("Set", self._command), instance.access("Get", self._result)
        self._step = instance.stepper(self._own_step)
        self._split = self._result.values.size - self.spec.m
        self._parameters = [self._parameter(name, values) for name, values in mapping.parameters.items()]
        if mapping.home is not None and self._has_start:
            self._parameters.append(self._parameter(mapping.home, self._start))
        self._camera = mapping.camera
        self._true_feature = self._port(mapping.truth.features or mapping.features)
        self._true_jacobian = self._port(mapping.truth.jacobian) if mapping.truth.jacobian else None
        self._true = mapped_model(mapping, self.description) if mapping.truth.states else None
        nominal = mapping.nominal
        self._nominal = None if nominal is None else mapped_model(mapping, self.description, nominal)

    def _parameter(self, name: str, values: FloatArray) -> Call:
        port = Port(self.description.find(name, "parameters"))
        if np.shape(values) not in ((), port.values.shape):
            raise ValueError(f"parameter {name!r} must have {port.values.size} values, got {np.size(values)}")
        port.values[:] = values
        return self._instance.writer(port)

    def _port(self, names: Names) -> tuple[Port, Call]:
        port = Port(self.description.select(names, "truth"))
        return port, self._instance.reader(port)

    def reset(self, seed: int) -> FloatArray:
        """Go back to the start; nothing here is random."""
        if not self._at_start:
            self._instance.reset()
            self._initialise()
        return self._joints

    def _initialise(self) -> None:
        """Set the parameters of a fresh instance and begin at time 0."""
        for write in self._parameters:
            write()
        self._instance.start(0.0)
        self._k = 0
        self._integrated = self._start
        self._measure()
        self._at_start = True

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period; see `World.advance`.

        Raises:
            FmuError: the FMU failed, or a result is not finite.
        """
        self._at_start = False
        self._command.values[:] = joint_velocity
        status = self._write()
        if status:
            self._instance.check(f"writing {self._command.summary}", status)
        for i in range(self._k * self._substeps, (self._k + 1) * self._substeps):
            self._step(i * self._own_step)
        self._k += 1
        if not self._has_joints:
            self._integrated = self._integrated + joint_velocity * self._period
            self._integrated.setflags(write=False)
        self._measure()
        return self._joints

    def _measure(self) -> None:
        """Read joints and feature, both read-only."""
        status = self._read()
        if status:
            self._instance.check(f"reading {self._result.summary}", status)
        values = self._result.values.copy()
        # Any value that is not finite makes the sum not finite; a mask costs five times as much.
        if not isfinite(sum(values.tolist())):
            bad = [label for label, value in zip(self._result.labels, values, strict=True) if not np.isfinite(value)]
            raise FmuError(f"{self.description.path.name} returned something that is not finite for {', '.join(bad)}")
        values.setflags(write=False)
        self._joints = values[: self._split] if self._has_joints else self._integrated
        self._feature = values[self._split :]

    def see(self) -> FloatArray:
        """Return the FMU's feature as read after the last step."""
        return self._feature

    def move_camera(self, X_BC: FloatArray) -> None:
        """Set the parameters of the camera's pose; see `Plant.move_camera`.

        Raises:
            ValueError: the mapping names none.
        """
        if self._camera is None:
            super().move_camera(X_BC)
            return
        self._at_start = False
        for name, values in zip(self._camera, (X_BC[:3, 3], rpy_from_rotation(X_BC[:3, :3])), strict=True):
            self._parameter(name, values)()

    def truth(self) -> Truth:
        """Return the FMU's own feature and, if the mapping names it or its states, the Jacobian."""
        port, read = self._true_feature
        read()
        jacobian = None
        if self._true_jacobian is not None:
            matrix, read_matrix = self._true_jacobian
            read_matrix()
            jacobian = matrix.values.reshape(self.spec.m, self.spec.n).copy()
        elif self._true is not None and self._has_joints:
            jacobian = self._true.jacobian(self._joints)
        return Truth(port.values.copy(), jacobian)

    def true_model(self) -> TrueModel:
        """Return the FMU's own kinematics, by the directional derivatives of its model-exchange side.

        Raises:
            ValueError: it has no such side, or the joints and features are not states and outputs of it.
        """
        if self._true is None:
            self._true = mapped_model(self._mapping, self.description)
        return TrueModel(self._true.jacobian, self._true.symbolic)

    def nominal_jacobian(self) -> Callable[[FloatArray], FloatArray] | None:
        """Return the FMU's Jacobian with the mapping's nominal parameters, or None if it has none."""
        return None if self._nominal is None else self._nominal.jacobian

    def save(self) -> FmuState:
        """Return the present state of the FMU; see `Plant.save`.

        Raises:
            ValueError: the FMU cannot save its state.
        """
        if not self.description.can_save:
            raise ValueError(f"{self.description.path.name} cannot save its state (canGetAndSetFMUstate is false)")
        state = self._instance.save()
        if not self.description.can_serialise:
            self._states.append(state)
            return FmuState(state, self._k, self._integrated)
        try:
            return FmuState(self._instance.to_bytes(state), self._k, self._integrated)
        finally:
            self._instance.free(state)

    def restore(self, state: FmuState) -> None:
        """Return to a saved state; see `Plant.restore`.

        Raises:
            FmuError: the FMU does not take it.
        """
        self._at_start = False
        if isinstance(state.fmu, bytes):
            handle = self._instance.from_bytes(state.fmu)
            try:
                self._instance.restore(handle)
            finally:
                self._instance.free(handle)
        else:
            self._instance.restore(state.fmu)
        self._k, self._integrated = state.period, state.integrated
        self._measure()

    def close(self) -> None:
        """Free the instance and unload the library."""
        self._write = self._read = _closed
        while self._states:
            self._instance.free(self._states.pop())
        self._instance.close()


def open_instance(description: FmuDescription, root: Path) -> Instance:
    """Return an instance of the FMU that is extracted to `root`; the caller closes it."""
    kind: Callable[[FmuDescription, Path], Instance] = Instance2 if description.version == 2 else Instance3
    return kind(description, root)


def _closed() -> int:
    raise FmuError("the plant has been closed")


def build_fmu(mapping: FmuMapping, setup: PlantSetup, command_delay_periods: int, sensing: SensingConfig) -> Bench:
    """Return the plant of an FMU, for a registry.

    Raises:
        ValueError: an FMU or mapping that cannot be used; also if the FMU itself says so.
    """
    try:
        start = mapping.start if setup.start is None else setup.start
        return Bench(FmuWorld(mapping, start, setup.period), command_delay_periods, sensing)
    except FmuError as error:
        raise ValueError(str(error)) from error


def mapped_entry(path: Path) -> PlantEntry:
    """Return the registry's entry of the plant `fmu:PATH`, the FMU that the mapping at `path` describes.

    Raises:
        ValueError: the mapping cannot be used.
    """
    mapping = read_mapping(path)

    def build(config: FmuConfig, setup: PlantSetup) -> Bench:
        return build_fmu(mapping, setup, config.command_delay_periods, config.sensing)

    summary = f"the FMU {mapping.file.name}, as mapped by {path.name}"
    return PlantEntry(f"fmu:{path}", summary, FmuConfig, build, own_robot=True)
