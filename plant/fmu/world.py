"""Any FMI 2 or FMI 3 FMU as a plant; delay, noise, latency and lost frames are those of the bench.

An `FmuMapping` says which variables are commands, joints and features; names are resolved once, at construction. The
FMU is stepped with its own period, which divides that of the world; commands are held meanwhile. Parameters of any type
are set before every run.
"""

import ctypes
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from math import prod
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from servobench.plant.bench.bench import Bench, build_bench
from servobench.plant.bench.plant import PlantEntry, PlantSetup, TrueModel, World
from servobench.plant.contract.checks import (
    AnyArray,
    FloatArray,
    IntArray,
    Shape,
    as_array,
    is_finite,
    whole_steps,
)
from servobench.plant.contract.faults import FmuError, configuration_errors
from servobench.plant.contract.seeds import Seeds
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import Delay, Names, nested, remark, settings
from servobench.plant.contract.signals import BoolArray, JacobianFunction, Truth
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import (
    NUMERIC,
    REAL_TYPES,
    FmuDescription,
    Variable,
    read_description,
    total_size,
)
from servobench.plant.fmu.dialect import INTEGERS
from servobench.plant.fmu.instance import Instance, Port
from servobench.plant.fmu.instances import Instances, Lane, open_instance
from servobench.plant.fmu.library import logger
from servobench.plant.fmu.mapping import (
    FmuMapping,
    LogNames,
    TruthMapping,
    first_instant,
    mapping_spec,
    own_step,
    read_mapping,
    unusual_step,
)
from servobench.plant.fmu.model_exchange import build_model
from servobench.plant.fmu.release import release
from servobench.plant.robot.arm import rpy_from_rotation
from servobench.plant.robot.hand_eye import RobotModel

REHEARSED_STEPS = 5  # periods of an arm at rest in which outputs of foreign FMUs may jump
MIN_JUMP = 1e-6  # [unit of the output]
MAX_JUMP_RATIO = 5.0  # [1] A change that exceeds those after it by this factor is a jump.
# Names in exported arms.
ARM_JOINTS = ("joint_velocity_command", "joint_position")
ARM_FEATURES = ("ball_position", "feature")
SEEN_ABOVE = 0.5  # threshold of an FMU's variable above which a feature is valid
STRUCTURAL = "structuralParameter"
EXACT = 2**53  # largest number up to which float64 holds all whole numbers
ROUNDED_START = 1e-6  # [rad] by which a joint may start out of its limits

Setter = Callable[[Instance, int], None]


@settings
class FmuConfig:
    """Settings of an FMU plant; the same as those of the kinematic plant where both have them."""

    command_delay: Delay = 0.05
    """[s] from command to first effect; rounded by at most 0.5 ms to fit the period."""
    sensing: SensingConfig = nested(SensingConfig)
    """Noise, latency, frame period and lost frames."""
    isolate: bool = True
    """Run the FMU in a process of its own, with limits; false only for one that you trust."""


class FmuState(NamedTuple):
    """A saved state of an FMU's world."""

    # The state of each instance: bytes for any process with the same FMU, or, if it cannot serialise, a handle of the
    # world that saved it.
    fmu: tuple[bytes | ctypes.c_void_p, ...]
    period: int  # number of periods since the start
    integrated: FloatArray  # (..., n), rad, joint positions of an FMU that has none itself.


class FmuWorld(World):
    """y, q ← fmi…GetReal after fmi…DoStep under the held command, with an instance for each run side by side."""

    _seen: BoolArray | None = None
    _captured: FloatArray | None = None

    def __init__(
        self,
        mapping: FmuMapping,
        start: FloatArray | None,
        period: float,
        lag: float | None = None,
        model: RobotModel | None = None,
    ) -> None:
        """Extract and load the FMU and resolve all names.

        Args:
            mapping: the roles of its variables; values of parameters may have leading axes.
            start: (..., n), rad, joint positions at time 0, for an FMU with a home or without joints; None: the FMU's
                own home, or 0. Its leading axis says how many runs there are.
            period: of `advance`, s.
            lag: time constant of the FMU's joints, s; None where it is unknown.
            model: of the FMU, where it is known, for names, unit and natural size of its features.

        Raises:
            ValueError: an FMU that cannot be used, or a name or size that does not fit.
            FmuError: the FMU refused its parameters or its initialisation.
        """
        self._own_step = own_step(mapping.period, period)
        self._substeps = whole_steps(period, self._own_step)
        self._period = period
        self._mapping = mapping
        self.lag = lag
        description = read_sized(mapping.file, mapping.parameters)
        self.description = description
        if description.needs_tool:
            remark(
                f"{mapping.file.name} calls the tool that made it, which has to be installed here"
            )
        if model is None:
            unusual = unusual_step(mapping, description, period)
            if unusual:
                logger.warning(unusual)
        self.spec = mapping_spec(mapping, description, period)
        self._begin = first_instant(mapping.start_time, description, self._own_step)
        if model is not None:
            self.spec = replace(self.spec, feature=model.channel)
            self.noise_unit = model.noise_unit
        self._is_foreign = model is None
        self._has_start = start is not None
        start = np.zeros(self.spec.n) if start is None else start
        self.lead = np.shape(start)[:-1]
        self._start = as_array("start", start, (*self.lead, self.spec.n))
        self._rows: Any = np.arange(*self.lead) if self.lead else ()
        self._instances = Instances(self.fail)
        try:
            self._connect(mapping)
            make = partial(open_instance, description, mapping.tolerance, mapping.debug_log)
            self._instances.open(prod(self.lead), make, self._lane)
            self._initialise()
            if self._is_foreign:
                self._check_start()
            for fault in self.faults.values():
                raise fault  # noqa: TRY301 - the instances are closed below
        except BaseException:
            self.close()
            raise

    def _connect(self, mapping: FmuMapping) -> None:
        """Make the ports; those of parameters are used outside the loop only."""
        truth = mapping.truth
        self._has_joints = bool(mapping.joints)
        self._command = self._port("inputs", mapping.inputs)
        measured = (*mapping.joints, *mapping.features, *mapping.seen)
        self.stamps = mapping.captured is not None
        if mapping.captured is not None:
            measured = (*measured, mapping.captured)
        self._result = self._port("joints, features, seen and captured", measured)
        true_features = truth.features or mapping.features
        self._truth = self._port("truth", (*true_features, *truth.jacobian))
        # Joints come first in a row of results.
        self._split = self.spec.n if mapping.joints else 0
        self._now = ctypes.c_double()
        parameters = dict(mapping.parameters)
        if mapping.home is not None and self._has_start:
            parameters[mapping.home] = self._start
        self._setters = setters(self.description, parameters, self.lead)
        self._camera = []
        for name in mapping.camera or ():
            port = self._port("camera", (name,))
            port.values[...] = parameters.get(name, 0.0)
            self._camera.append(port)
        self._true = build_model(mapping, self.description) if truth.states else None
        nominal = mapping.nominal
        self._nominal = None if nominal is None else build_model(mapping, self.description, nominal)

    def _check_start(self) -> None:
        """Refuse limits that are not kept at the start."""
        lower = self.spec.joint_lower
        upper = self.spec.joint_upper
        off = np.maximum(lower - self._joints, self._joints - upper)
        if off.max() > ROUNDED_START:
            i = off.argmax() % self.spec.n
            name = self.spec.joint_names[i]
            raise ValueError(
                f"{self.description.path.name} starts with {name} out of the limits of its mapping, {lower[i]:g} to "
                f"{upper[i]:g} rad, by {off.max():g} rad"
            )

    def _lane(self, instance: Instance, row: int) -> Lane:
        return Lane(
            instance,
            row,
            instance.access("Set", self._command, row),
            instance.step_call(self._now, ctypes.c_double(self._own_step)),
            instance.access("Get", self._result, row),
            instance.access("Get", self._truth, row),
        )

    def _port(self, role: str, names: Names) -> Port:
        return Port(self.description.select(names, role, NUMERIC), self.lead)

    def reset(self, seed: Seeds) -> FloatArray:
        """Go back to the start; nothing here is random."""
        if not self._at_start:
            self._instances.revive()
            self.faults = {}
            self._instances.each(lambda lane: lane.instance.reset())
            self._initialise()
        return self._joints

    def _initialise(self) -> None:
        """Set the parameters of fresh instances and begin at the first instant."""

        def begin(lane: Lane) -> None:
            for act in self._setters:
                act(lane.instance, lane.row)
            lane.instance.start(self._begin)

        self._instances.each(begin)
        self._k = 0
        self._joints = self._integrated = self._start
        self._feature = np.zeros((*self.lead, self.spec.m))
        self._measure()
        self._at_start = True

    def advance(self, joint_velocity: FloatArray) -> FloatArray:
        """Hold a command for one period of the world; see `World.advance`.

        Raises:
            FmuError: the FMU of a single run failed, or a result is not finite.
        """
        instances = self._instances
        if not instances.lanes:
            raise FmuError("the plant has been closed")
        self._at_start = False
        self._command.values[self._rows] = joint_velocity
        instances.check("writing", self._command, [lane.write() for lane in instances.live])
        for i in range(self._k * self._substeps, (self._k + 1) * self._substeps):
            time = self._begin + i * self._own_step
            self._now.value = time
            instances.finish([lane.step() for lane in instances.live], time, self._own_step)
        self._k += 1
        if not self._has_joints:
            self._integrated = self._integrated + joint_velocity * self._period
        self._measure()
        return self._joints

    def _measure(self) -> None:
        """Read joints and feature; those of a lane that failed stay as they were."""
        status = [lane.read() for lane in self._instances.live]
        self._instances.check("reading", self._result, status)
        values = np.array(self._result.values[self._rows])
        first = self._split
        end = first + self.spec.m
        if self.faults or not is_finite(values):
            for i in np.flatnonzero(~np.isfinite(values).all(axis=-1)).tolist():
                row = values.reshape(-1, values.shape[-1])[i]
                bad = np.array(self._result.labels)[~np.isfinite(row)]
                fault = FmuError(
                    f"{self.description.path.name} returned something that is not finite for {', '.join(bad)}"
                )
                self._instances.drop(self._instances.lanes[i], fault)
            failed = list(self.faults)
            values[failed, first:end] = self._feature[failed]
            if self._has_joints:
                values[failed, :first] = self._joints[failed]
        self._joints = values[..., :first] if self._has_joints else self._integrated
        self._feature = values[..., first:end]
        if self._mapping.seen:
            self._seen = values[..., end : end + self.spec.m] > SEEN_ABOVE
        if self.stamps:
            self._captured = values[..., -1]

    def see(self) -> FloatArray:
        """Return the FMU's features as read after the last step."""
        return self._feature

    def visible(self) -> BoolArray | None:
        """Return which features are valid by the FMU; see `World.visible`."""
        return self._seen

    def captured(self) -> FloatArray | None:
        """Return the time of capture by the FMU; see `World.captured`."""
        return self._captured

    def rehearse(self) -> None:
        """Remark on joints and features that jump from exactly 0 while the arm rests; see `World.rehearse`.

        An FMU that computes its outputs in steps only has no values of them at the start, but returns zeros.
        """
        count = self._split + self.spec.m
        zero = self._result.values[..., :count] == 0.0
        if self._seen is not None:
            zero[..., self._split :] &= self._seen
        if self.lead or not self._is_foreign or not zero.any():
            return
        rows = [self._result.values[:count].copy()]
        for _ in range(REHEARSED_STEPS):
            self.advance(np.zeros(self.spec.n))
            rows.append(self._result.values[:count].copy())
        changes = np.abs(np.diff(rows, axis=0))
        jumps = list[str]()
        for i in np.flatnonzero(zero).tolist():
            first = int(np.argmax(changes[:, i] > MIN_JUMP))
            later = changes[first + 1 :, i].max(initial=0.0)
            if changes[first, i] > max(MIN_JUMP, MAX_JUMP_RATIO * later):
                jumps.append(
                    f"{self._result.labels[i]} (to {rows[first + 1][i]:.3g} in step {first + 1})"
                )
        if jumps:
            remark(
                f"{self.description.path.name} returns 0 at the start for what then jumps though the arm "
                f"rests: {', '.join(jumps)}; runs begin with a wrong measurement: let it compute its outputs "
                "in the initialisation, too, or map `seen`"
            )

    def move_camera(self, X_BC: FloatArray) -> None:
        """Set the parameters of the camera's pose; see `Plant.move_camera`.

        Raises:
            ValueError: the mapping names none.
        """
        if not self._camera:
            super().move_camera(X_BC)
        self._at_start = False
        position = X_BC[..., :3, 3]
        angles = rpy_from_rotation(X_BC[..., :3, :3])
        poses = (position, angles)
        for port, values in zip(self._camera, poses, strict=True):
            port.values[..., :3][self._rows] = values

        def show(lane: Lane) -> None:
            for port in self._camera:
                lane.instance.writer(port, lane.row)()

        self._instances.each(show)

    def truth(self) -> Truth:
        """Return the FMU's own feature and, if the mapping names it or its states, the Jacobian."""
        status = [lane.read_truth() for lane in self._instances.live]
        self._instances.check("reading", self._truth, status)
        values = np.array(self._truth.values[self._rows])
        m = self.spec.m
        n = self.spec.n
        jacobian = None
        if values.shape[-1] > m:
            jacobian = values[..., m:].reshape(*self.lead, m, n)
        elif self._true is not None and self._has_joints:
            jacobian = self._true.jacobian(self._joints)
        return Truth(values[..., :m], jacobian)

    def true_model(self) -> TrueModel:
        """Return the FMU's own kinematics, by the directional derivatives of its model-exchange side.

        Raises:
            ValueError: it has no such side, or the joints and features are not states and outputs of it.
        """
        if self._true is None:
            self._true = build_model(self._mapping, self.description)
        return TrueModel(self._true.jacobian, self._true.symbolic)

    def nominal_jacobian(self) -> JacobianFunction | None:
        """Return the FMU's Jacobian with the mapping's nominal parameters, or None if it has none."""
        if self._nominal is None:
            return None
        return self._nominal.jacobian

    def keep(self, lanes: IntArray) -> None:
        """Close the instances of all other lanes; see `Plant.keep`."""
        chosen = lanes.tolist()
        self._instances.keep(chosen)
        self.faults = {place: self.faults[i] for place, i in enumerate(chosen) if i in self.faults}
        self.lead = (len(chosen),)
        self._rows = self._rows[lanes]
        self._start = self._start[lanes]
        self._joints = self._joints[lanes]
        self._feature = self._feature[lanes]
        self._integrated = self._integrated[lanes]
        if self._seen is not None:
            self._seen = self._seen[lanes]
        if self._captured is not None:
            self._captured = self._captured[lanes]

    def save(self) -> FmuState:
        """Return the present state of the FMU; see `Plant.save`.

        Raises:
            ValueError: the FMU cannot save its state.
        """
        if not self.description.can_save:
            raise ValueError(
                f"{self.description.path.name} cannot save its state (canGetAndSetFMUstate is false)"
            )
        saved = tuple(lane.instance.save() for lane in self._instances.lanes)
        return FmuState(saved, self._k, self._integrated)

    def restore(self, state: FmuState) -> None:
        """Return to a saved state; see `Plant.restore`.

        Raises:
            FmuError: the FMU does not take it.
        """
        self._at_start = False
        self._instances.revive()
        self.faults = {}
        for lane, saved in zip(self._instances.lanes, state.fmu, strict=True):
            lane.instance.restore(saved)
        self._k = state.period
        self._integrated = state.integrated
        self._measure()

    def close(self) -> None:
        """Free all instances and unload the library, and let go of the models, which have instances as well."""
        release(self._free)

    def _free(self) -> None:
        self._instances.close()
        self._true = None
        self._nominal = None


def read_sized(path: Path, values: Mapping[str, AnyArray]) -> FmuDescription:
    """Return the description of the FMU at `path` with the structural parameters that a mapping gives.

    Raises:
        ValueError: an FMU that cannot be used, a parameter that it does not have, or a value that is no size.
    """
    description = read_description(path, extract_fmu(path))
    sizes: dict[str, int] = {}
    for name, value in values.items():
        variables = description.find(name, "parameters", None)
        if variables[0].causality == STRUCTURAL:
            check_value(variables, name, value)
            size = int(np.ravel(value)[0])
            sizes |= {variable.name: size for variable in variables}
    return description.resized(sizes)


def check_value(variables: list[Variable], name: str, value: AnyArray) -> None:
    """Check that a value fits the type of the parameter that a mapping names.

    Raises:
        ValueError: it does not; names the wanted type.
    """
    kind = variables[0].type
    given = np.asarray(value)
    if len({variable.type for variable in variables}) > 1:
        raise ValueError(
            f"parameter {name!r} stands for variables of several types; name each by itself"
        )
    came = given.tolist()
    if kind == "String":
        fits = given.dtype.kind == "U"
        wanted = "text"
    elif kind == "Boolean":
        fits = given.dtype.kind == "b"
        wanted = "true or false"
    elif kind in INTEGERS:
        bounds = np.iinfo(INTEGERS[kind])
        low = max(int(bounds.min), -EXACT)
        high = min(int(bounds.max), EXACT)
        fits = given.dtype.kind == "f"
        if fits:
            within = (low <= given) & (given <= high)
            fits = bool((within & (given == np.round(given))).all())
        wanted = f"a whole number from {low} to {high}"
    elif kind in REAL_TYPES:
        fits = given.dtype.kind == "f"
        wanted = "a number"
    else:
        raise ValueError(f"parameter {name!r} is of type {kind}, which a mapping cannot set")
    if not fits:
        raise ValueError(f"parameter {name!r} is of type {kind}: wanted {wanted}, got {came!r}")


def setters(
    description: FmuDescription,
    parameters: Mapping[str, AnyArray],
    lead: Shape = (),
) -> list[Setter]:
    """Return functions that give parameters their values in an instance, by the row of its run; sizes come first.

    Args:
        description: of the FMU.
        parameters: by name one for all of its values, or each, also for each of the runs side by side.
        lead: leading axes of the runs.

    Raises:
        ValueError: a value of the wrong type or size.
    """
    sizes = list[Setter]()
    others = list[Setter]()
    for name, value in parameters.items():
        variables = description.find(name, "parameters", None)
        check_value(variables, name, value)
        group = sizes if variables[0].causality == STRUCTURAL else others
        group.append(_setter(variables, name, value, lead))
    return sizes + others


def _setter(variables: list[Variable], name: str, value: AnyArray, lead: Shape) -> Setter:
    size = total_size(variables)
    given = np.asarray(value)
    if given.shape not in ((), (size,), (*lead, size)):
        raise ValueError(f"parameter {name!r} must have {size} values, got {given.size}")
    if variables[0].type == "String":
        texts = [str(text) for text in np.broadcast_to(given, (size,)).tolist()]
        return lambda instance, _row: instance.set_texts(variables, texts)
    port = Port(variables, lead)
    port.values[...] = given
    if variables[0].causality == STRUCTURAL:
        return lambda instance, _row: instance.configure(port)
    return lambda instance, row: instance.writer(port, row)()


def build_fmu(
    mapping: FmuMapping,
    setup: PlantSetup,
    command_delay: float,
    sensing: SensingConfig,
    lag: float | None = None,
    model: RobotModel | None = None,
) -> Bench:
    """Return the plant of an FMU, for a registry.

    Args:
        mapping: the roles of its variables.
        setup: start and control period.
        command_delay: between a command and its first effect, s.
        sensing: noise, latency, frame period and lost frames.
        lag: time constant of the FMU's joints, s; None where it is unknown.
        model: of the FMU, where it is known, for names, unit and natural size of its features.

    Raises:
        ValueError: an FMU or mapping that cannot be used; also if the FMU itself says so.
    """
    start = mapping.start if setup.start is None else setup.start

    def make(own: PlantSetup) -> FmuWorld:
        return FmuWorld(mapping, start, own.period, lag, model)

    with configuration_errors("", FmuError):
        return build_bench(make, setup, command_delay, sensing)


def fmu_entry(path: Path) -> PlantEntry:
    """Return the registry's entry of the plant `fmu:PATH`, the FMU that the mapping at `path` describes.

    Raises:
        ValueError: the mapping cannot be used.
    """
    if path.suffix.lower() == ".fmu":
        mapping = _exported_arm(path)
        how = "by the names of exported arms"
    else:
        mapping = read_mapping(FmuMapping, path)
        how = f"as mapped by {path.name}"
    summary = f"the FMU {mapping.file.name}, {how}"
    no_model = mapping.nominal is None
    build = partial(_build, mapping)
    return PlantEntry(f"fmu:{path}", summary, FmuConfig, build, own_robot=True, no_model=no_model)


def _build(mapping: FmuMapping, config: FmuConfig, setup: PlantSetup) -> Bench:
    return build_fmu(mapping, setup, config.command_delay, config.sensing)


def _exported_arm(path: Path) -> FmuMapping:
    """Return the mapping of an arm that was exported, by the names that it has.

    Raises:
        ValueError: an FMU with other names.
    """
    description = read_description(path, extract_fmu(path))
    units = {variable.name.partition("[")[0]: variable.unit for variable in description.variables}
    features = [name for name in ARM_FEATURES if name in units]
    if not (features and {*ARM_JOINTS, "jacobian"} <= units.keys()):
        raise ValueError(
            f"{path.name} has not the names of an exported arm: write a mapping, a TOML that names its file, "
            "inputs and features"
        )
    command, position = ARM_JOINTS
    feature = features[0]
    seen: Names = ()
    if "seen" in units:
        seen = ("seen",)
    truth = TruthMapping(jacobian=("jacobian",))
    names = LogNames(feature_unit=units[feature])
    return FmuMapping(
        path, (command,), (feature,), joints=(position,), seen=seen, truth=truth, names=names
    )
