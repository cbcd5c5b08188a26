"""Any FMI 2 or FMI 3 co-simulation FMU as a controller, by a mapping of names; no code is needed.

    file = "mine.fmu"                       # beside the TOML file
    outputs = ["qd_cmd[1]", "qd_cmd[2]"]
    joints = ["q"]
    features = ["image_point"]
    reference = ["target"]

Without a mapping, variables are looked for under the names that exported controllers have. In each period the inputs
are written, a step of one period is taken, and the outputs are read.
"""

import contextlib
import weakref
from collections.abc import Mapping
from functools import partial
from itertools import chain
from pathlib import Path
from typing import Any, final

import numpy as np

from servobench.controllers.controller import Controller, ControllerEntry, RobotKnowledge
from servobench.harness.config.entries import NoSettings
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import FmuError, configuration_errors
from servobench.plant.contract.settings import (
    File,
    Names,
    Positive,
    SomeNames,
    Values,
    nested,
    remark,
    settings,
)
from servobench.plant.contract.signals import Command, Observation
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import NUMERIC, FmuDescription, read_description, total_size
from servobench.plant.fmu.instance import Port
from servobench.plant.fmu.instances import open_instance
from servobench.plant.fmu.mapping import (
    check_roles,
    check_unit,
    count_steps,
    first_instant,
    read_mapping,
)
from servobench.plant.fmu.world import read_sized, setters

CONVENTION: Mapping[str, str] = {
    "outputs": "joint_velocity_command",
    "jacobian": "jacobian",
    "joints": "joint_position",
    "features": "feature",
    "seen": "seen",
    "reference": "reference",
}
INPUTS = ("joints", "features", "seen", "reference")  # roles in the order of their values


@settings
class ControllerMapping:
    """The roles of an FMU's variables; a name is that of a scalar, an array, or the scalars `name[1]`, `name[2]`."""

    file: File
    """The .fmu file."""
    outputs: SomeNames
    """Joint velocity commands, rad/s."""
    features: SomeNames
    """Inputs for the measured features, in the unit of the plant."""
    reference: SomeNames
    """Inputs for the desired feature: now, and if there are more at the next instants, row by row."""
    joints: Names = ()
    """Inputs for joint positions, rad."""
    seen: Names = ()
    """Inputs for which features were measured for this instant: 1 or true, else 0 or false."""
    jacobian: Names = ()
    """Outputs with the estimated Jacobian, row-major (m, n), for the log."""
    parameters: Mapping[str, Values] = nested(dict)
    """Values by name, set before every run: numbers, `true` and `false`, or texts, as the FMU declares them."""
    start_time: float | None = None
    """[s] of the FMU's clock at the start of a run; None for that of its default experiment, or else 0."""
    tolerance: Positive | None = None
    """[1] relative one of the FMU's own solver; None for the solver's own."""
    debug_log: File | None = None
    """A file to which all messages of the FMU are appended, with its debug log turned on; None: it is off."""


@final
class FmuController(Controller):
    """u ← fmi…GetReal after fmi…DoStep with the measured features as inputs."""

    def __init__(self, mapping: ControllerMapping, knowledge: RobotKnowledge) -> None:
        """Extract and load the FMU and look all names up.

        Raises:
            ValueError: an FMU that cannot be used, or a name or size that does not fit.
            FmuError: the FMU refused its parameters.
        """
        self._description = read_sized(mapping.file, mapping.parameters)
        self._period, self._shape = knowledge.spec.period, (knowledge.spec.m, knowledge.spec.n)
        self._rows = self._check(mapping, knowledge.preview, knowledge.spec.feature_unit)
        self._setters = setters(self._description, mapping.parameters)
        self._instance = open_instance(self._description, mapping.tolerance, mapping.debug_log)
        weakref.finalize(self, self._instance.close)
        roles: tuple[Names, ...] = tuple(getattr(mapping, role) for role in INPUTS)
        self._given = tuple(map(bool, roles))
        names = list(chain.from_iterable(roles))
        self._inputs = Port(self._description.select(names, "inputs", NUMERIC))
        self._outputs = Port(
            self._description.select((*mapping.outputs, *mapping.jacobian), "outputs", NUMERIC)
        )
        self._write, self._read = (
            self._instance.writer(self._inputs),
            self._instance.reader(self._outputs),
        )
        self._advance = self._instance.stepper(self._period)
        self._first = first_instant(mapping.start_time, self._description, self._period)
        self._fresh = True

    def _check(self, mapping: ControllerMapping, preview: int, feature_unit: str) -> int:
        """Return how many rows of the reference it takes, and refuse sizes and units that do not fit."""
        (m, n), file = self._shape, self._description.path.name
        sizes = {"outputs": n, "jacobian": m * n, "joints": n, "features": m, "seen": m}
        found = {
            role: self._description.select(getattr(mapping, role), role, NUMERIC)
            for role in CONVENTION
        }
        for role, size in sizes.items():
            came = total_size(found[role])
            if found[role] and came != size:
                raise ValueError(
                    f"{file}: {role} must name {size} numbers for {n} joints and {m} features, got {came}"
                )
        given = {role: found[role] for role in INPUTS}
        check_roles(found, given, self._description)
        values = self._description.select(mapping.parameters, "parameters", None)
        check_roles({**given, "parameters": values}, (), self._description)
        units = {
            "outputs": "rad/s",
            "joints": "rad",
            "features": feature_unit,
            "reference": feature_unit,
        }
        for role, unit in units.items():
            check_unit(role, found[role], unit, any_quantity=role in ("features", "reference"))
        taken = {variable.name for variables in given.values() for variable in variables}
        idle = [
            variable.name
            for variable in self._description.variables
            if variable.causality == "input" and variable.name not in taken
        ]
        if idle:
            remark(
                f"{file}: no role of the mapping names the input {idle[0]}, which keeps its start value"
            )
        usual = self._description.usual_step
        if usual is not None and count_steps(self._period, usual) != 1:
            remark(
                f"{file} is meant for a period of {usual:g} s, and run.period is {self._period:g} s"
            )
        came = total_size(found["reference"])
        rows, rest = divmod(came, m)
        if rest or rows > 1 + preview:
            raise ValueError(
                f"{file}: reference must name {m} numbers a row for at most {1 + preview} rows, got {came}; "
                "run.preview_time says how far it reaches"
            )
        return rows

    def reset(self, observation: Observation, seed: int) -> None:
        """Go through initialisation again; nothing here is random.

        Raises:
            FmuError: the FMU refused.
        """
        del seed
        if not self._fresh:
            self._instance.reset()
        self._begin(observation.time)

    def _begin(self, time: float) -> None:
        self._fresh = False
        for act in self._setters:
            act(self._instance, 0)
        self._instance.start(self._first + time)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """Return the output of the FMU for this instant.

        Raises:
            FmuError: the FMU failed, or its answer is not finite.
        """
        parts = (
            observation.joint_position,
            observation.feature,
            observation.valid,
            reference[: self._rows],
        )
        given = [np.ravel(part) for part, wanted in zip(parts, self._given, strict=True) if wanted]
        self._inputs.values[:] = np.concatenate(given)
        self._write()
        self._advance(self._first + observation.time)
        self._read()
        velocity = self._outputs.values[: self._shape[1]].copy()
        if not np.isfinite(velocity).all():
            name = self._description.path.name
            raise FmuError(
                f"{name} returned a command that is not finite at {observation.time:g} s"
            )
        return Command(velocity)

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the Jacobian that the FMU tells, or None where it tells none, or zeros."""
        told = self._outputs.values[self._shape[1] :]
        if told.any():
            return told.reshape(self._shape).copy()
        return None

    def save(self) -> bytes:
        """Return the state of the FMU.

        Raises:
            ValueError: it cannot save or serialise its state.
        """
        if not self._description.can_serialise:
            name = self._description.path.name
            raise ValueError(f"{name} cannot serialise its state (canSerializeFMUstate is false)")
        return self._instance.save_bytes()

    def restore(self, state: object) -> None:
        """Go back to a state that `save` returned.

        Raises:
            TypeError: not such a state.
            FmuError: the FMU does not take it.
        """
        if not isinstance(state, bytes):
            raise TypeError(f"state must come from save, got {type(state).__name__}")
        if self._fresh:
            self._begin(0.0)
        self._instance.restore_bytes(state)


def mapped_controller(path: Path, name: str) -> ControllerEntry:
    """Return the entry of the controller called `name`: an FMU, or the one that a mapping (TOML) describes.

    Raises:
        ValueError: the mapping cannot be used.
    """
    if path.suffix.lower() == ".fmu":
        mapping, how = _conventional(path), "by the names of exported controllers"
    else:
        mapping = read_mapping(ControllerMapping, path)
        how = f"as mapped by {path.name}"

    return ControllerEntry(
        name, f"the FMU {mapping.file.name}, {how}", NoSettings, partial(_build, mapping)
    )


@configuration_errors("", FmuError)
def _build(
    mapping: ControllerMapping, _config: NoSettings, knowledge: RobotKnowledge
) -> FmuController:
    return FmuController(mapping, knowledge)


def _conventional(path: Path) -> ControllerMapping:
    """Return the mapping of an FMU with the names of exported controllers; `seen` and `jacobian` may be missing."""
    description = read_description(path, extract_fmu(path))
    names: dict[str, Any] = {
        role: (name,) for role, name in CONVENTION.items() if _has(description, name)
    }
    lacking = [
        CONVENTION[role] for role in ("outputs", "features", "reference") if role not in names
    ]
    if lacking:
        raise ValueError(
            f"{path.name} has no {', '.join(lacking)}, as exported controllers have; write a mapping of its "
            f"names, such as {path.stem}.toml"
        )
    return ControllerMapping(path, **names)


def _has(description: FmuDescription, name: str) -> bool:
    with contextlib.suppress(ValueError):
        return bool(description.find(name, "convention", NUMERIC))
    return False
