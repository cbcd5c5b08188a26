"""Any FMI 2 or FMI 3 co-simulation FMU as a plant.

Which variables are commands, joints and features is told by an `FmuMapping`; names are looked up once, at construction.
The FMU is stepped with its own period, which divides the control period; commands are held meanwhile. As in the
kinematic plant, a command may take effect some periods late, and the feature may be noisy, late or lost.
"""

from __future__ import annotations

import copy
import ctypes
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from math import isfinite
from pathlib import Path

import numpy as np

from servobench.plant.checks import FloatArray, as_vector
from servobench.plant.faults import FmuError
from servobench.plant.fmu.archive import FmuFolder
from servobench.plant.fmu.config import FmuConfig
from servobench.plant.fmu.description import FmuDescription, read_description
from servobench.plant.fmu.mapping import FmuMapping, Names, mapping_spec
from servobench.plant.fmu.model_exchange import FmuModel, mapped_model
from servobench.plant.fmu.slave import Call, Port, Slave
from servobench.plant.fmu.slave2 import Slave2
from servobench.plant.fmu.slave3 import Slave3
from servobench.plant.plant import Plant, TrueModel, whole_steps
from servobench.plant.robot.arm import rpy_from_rotation
from servobench.plant.seeds import named_generator
from servobench.plant.sensing import FeatureChannel
from servobench.plant.signals import Command, Observation, PlantSpec, Truth, trusted_observation


@dataclass(frozen=True, eq=False)
class FmuPlantState:
    """A saved state of an FMU plant: that of the FMU and that of everything around it.

    Attributes:
        fmu: as bytes, where the FMU can serialise; then any process with the same FMU can restore it. Else a handle of
            the plant that saved it.
        rest: step count, delayed commands, feature channel and random generator.
    """

    fmu: bytes | ctypes.c_void_p
    rest: tuple[int, deque[FloatArray], FeatureChannel, np.random.Generator, FloatArray]


class FmuPlant(Plant):
    """y, q ← fmi…GetReal after fmi…DoStep under the held, clipped and delayed command; feature = y + noise."""

    def __init__(self, config: FmuConfig, mapping: FmuMapping, start: FloatArray | None, period: float) -> None:
        """Extract and load the FMU and look all names up.

        Args:
            config: delay, noise and latency.
            mapping: which variables are what.
            start: (n,), rad, joint positions at time 0, for an FMU with a home or without joints; None: the FMU's own
                home, or 0.
            period: control period, s.

        Raises:
            ValueError: an FMU that cannot be used, a name or size that does not fit, or a setting out of its bounds.
            FmuError: the FMU refused its parameters or its initialisation.
        """
        self._config = config
        self._channel = FeatureChannel(config.latency_periods, config.drop_probability)
        self._substeps = whole_steps(period, mapping.period or period)
        self._own_step, self._period = mapping.period or period, period
        self._delays = config.command_delay_periods > 0
        self._has_channel = config.latency_periods > 0 or config.drop_probability > 0.0
        self._states: list[ctypes.c_void_p] = []
        self._mapping, self._models = mapping, list[FmuModel]()
        self._folder = FmuFolder(mapping.path)
        try:
            self.description = read_description(mapping.path, self._folder.root)
            self._spec = mapping_spec(mapping, self.description, period)
            self._has_start = start is not None
            self._start = as_vector("start", np.zeros(self._spec.n) if start is None else start, self._spec.n)
            self._slave = open_slave(self.description, self._folder)
            self._connect(mapping)
            self._fresh = True
            self.reset(0)
        except BaseException:
            self.close()
            raise

    def _connect(self, mapping: FmuMapping) -> None:
        """Make the ports; the parameters' and the truth's are used outside the loop only."""
        find, slave = self.description.select, self._slave
        self._has_joints, self._clips_itself = bool(mapping.joints), mapping.clips_itself
        self._command = Port(find(mapping.inputs, "inputs"))
        self._shape = self._command.values.shape
        self._result = Port(find((*mapping.joints, *mapping.features), "joints and features"))
        self._write, self._read = slave.raw_writer(self._command), slave.raw_reader(self._result)
        self._advance = slave.stepper(self._own_step)
        self._split, self._noise_scale = self._result.values.size - self._spec.m, self._config.feature_noise
        self._lower, self._upper = -self._spec.joint_velocity_limit, self._spec.joint_velocity_limit
        self._parameters = [self._parameter(name, values) for name, values in mapping.parameters.items()]
        if mapping.home is not None and self._has_start:
            self._parameters.append(self._parameter(mapping.home, self._start))
        self._camera = mapping.camera
        self._true_feature = self._port(mapping.true_features or mapping.features)
        self._true_jacobian = self._port(mapping.true_jacobian) if mapping.true_jacobian else None
        self._true = self._model({}) if mapping.true_states else None
        self._nominal = None if mapping.nominal is None else self._model(mapping.nominal)

    def _model(self, parameters: Mapping[str, FloatArray]) -> FmuModel:
        """Return the equations of the FMU, by its model-exchange side; they are closed with the plant."""
        model = mapped_model(self._mapping, self.description, parameters)
        self._models.append(model)
        return model

    def _parameter(self, name: str, values: FloatArray) -> Call:
        port = Port(self.description.find(name, "parameters"))
        if np.shape(values) not in ((), port.values.shape):
            raise ValueError(f"parameter {name!r} must have {port.values.size} values, got {np.size(values)}")
        port.values[:] = values
        return self._slave.writer(port)

    def _port(self, names: Names) -> tuple[Port, Call]:
        port = Port(self.description.select(names, "truth"))
        return port, self._slave.reader(port)

    @property
    def spec(self) -> PlantSpec:
        """Sizes, names, limits and period."""
        return self._spec

    def reset(self, seed: int) -> Observation:
        """Return to the start; feature noise and lost frames get streams of their own."""
        if not self._fresh:
            self._slave.reset()
        self._fresh = False
        for write in self._parameters:
            write()
        self._slave.start(0.0)
        self._k = 0
        self._noise = named_generator(seed, "feature_noise")
        self._commands: deque[FloatArray] = deque([np.zeros(self._spec.n)] * self._config.command_delay_periods)
        self._integrated = self._start
        joints, feature = self._measure()
        self._channel.reset(feature, named_generator(seed, "dropped_frames"))
        return Observation(0.0, joints, feature)

    def step(self, command: Command) -> Observation:
        """Apply `command` for one period; see `Plant.step`.

        Raises:
            FmuError: the FMU failed, or a result is not finite.
        """
        wanted, buffer = command.joint_velocity, self._command.values
        if wanted.shape != self._shape:
            raise ValueError(f"joint_velocity must have shape {self._shape}, got {wanted.shape}")
        if self._delays:
            self._commands.append(wanted)
            wanted = self._commands.popleft()
        if self._clips_itself:
            buffer[:] = wanted
        else:
            np.minimum(wanted, self._upper, out=buffer)
            np.maximum(buffer, self._lower, out=buffer)
        status = self._write()
        if status:
            self._slave.check(f"writing {self._command.summary}", status)
        if self._substeps == 1:
            self._advance(self._k * self._own_step)
        else:
            for i in range(self._k * self._substeps, (self._k + 1) * self._substeps):
                self._advance(i * self._own_step)
        self._k += 1
        if not self._has_joints:
            self._integrated = self._integrated + buffer * self._period
            self._integrated.setflags(write=False)
        joints, feature = self._measure()
        feature, valid = self._channel.deliver(feature) if self._has_channel else (feature, True)
        return trusted_observation(self._k * self._period, joints, feature, valid)

    def move_camera(self, X_BC: FloatArray) -> None:
        """Set the parameters of the camera's pose; see `Plant.move_camera`.

        Raises:
            ValueError: the mapping names none.
        """
        if self._camera is None:
            super().move_camera(X_BC)
            return
        for name, values in zip(self._camera, (X_BC[:3, 3], rpy_from_rotation(X_BC[:3, :3])), strict=True):
            self._parameter(name, values)()

    def truth(self) -> Truth:
        """Return the FMU's own feature and, where the mapping names it or its states, the Jacobian."""
        port, read = self._true_feature
        read()
        jacobian = None
        if self._true_jacobian is not None:
            matrix, read_matrix = self._true_jacobian
            read_matrix()
            jacobian = matrix.values.reshape(self._spec.m, self._spec.n).copy()
        elif self._true is not None and self._has_joints:
            jacobian = self._true.jacobian(self._result.values[: self._split])
        return Truth(port.values.copy(), jacobian)

    def true_model(self) -> TrueModel:
        """Return the FMU's own kinematics, by the directional derivatives of its model-exchange side.

        Raises:
            ValueError: it has no such side, or the joints and features are not states and outputs of it.
        """
        if self._true is None:
            self._true = self._model({})
        return TrueModel(self._true.jacobian, self._true.symbolic)

    def nominal_jacobian(self) -> Callable[[FloatArray], FloatArray] | None:
        """Return the FMU's Jacobian with the mapping's nominal parameters, or None where it has none."""
        return None if self._nominal is None else self._nominal.jacobian

    def save_state(self) -> FmuPlantState:
        """Return the present state of the FMU and of everything around it.

        Raises:
            ValueError: the FMU cannot save its state.
        """
        if not self.description.can_save:
            raise ValueError(f"{self.description.path.name} cannot save its state (canGetAndSetFMUstate is false)")
        rest = (self._k, self._commands, self._channel, self._noise, self._integrated)
        state = self._slave.save()
        if not self.description.can_serialise:
            self._states.append(state)
            return FmuPlantState(state, copy.deepcopy(rest))
        try:
            return FmuPlantState(self._slave.to_bytes(state), copy.deepcopy(rest))
        finally:
            self._slave.free(state)

    def restore_state(self, state: FmuPlantState) -> None:
        """Return to a saved state; the run that follows has the same bits.

        Raises:
            FmuError: the FMU does not take it.
        """
        if isinstance(state.fmu, bytes):
            handle = self._slave.from_bytes(state.fmu)
            try:
                self._slave.restore(handle)
            finally:
                self._slave.free(handle)
        else:
            self._slave.restore(state.fmu)
        self._k, self._commands, self._channel, self._noise, self._integrated = copy.deepcopy(state.rest)

    def close(self) -> None:
        """Free the instance, unload the library and remove the extracted files."""
        slave: Slave | None = self.__dict__.pop("_slave", None)
        if slave is not None:
            for state in self._states:
                slave.free(state)
            self._states.clear()
            self._write = self._read = _closed
            slave.close()
        for model in self._models:
            model.close()
        self._folder.close()

    def _measure(self) -> tuple[FloatArray, FloatArray]:
        """Read joints and feature, both read-only; the feature with noise."""
        status = self._read()
        if status:
            self._slave.check(f"reading {self._result.summary}", status)
        values = self._result.values.copy()
        # Anything that is not finite leaves the sum so; a mask costs five times as much.
        if not isfinite(sum(values.tolist())):
            bad = [label for label, value in zip(self._result.labels, values, strict=True) if not np.isfinite(value)]
            raise FmuError(f"{self.description.path.name} returned something that is not finite for {', '.join(bad)}")
        values.setflags(write=False)
        feature = values[self._split :]
        if self._noise_scale > 0.0:
            feature = feature + self._noise.normal(scale=self._noise_scale, size=feature.size)
            feature.setflags(write=False)
        return (values[: self._split] if self._has_joints else self._integrated), feature


def open_slave(description: FmuDescription, folder: FmuFolder) -> Slave:
    """Return an instance of an extracted FMU; it has to be closed before its folder."""
    kind: Callable[[FmuDescription, Path], Slave] = Slave2 if description.version == 2 else Slave3
    return kind(description, folder.root)


def _closed() -> int:
    raise FmuError("the plant has been closed")
