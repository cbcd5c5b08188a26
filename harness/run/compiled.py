"""Composed controllers in C: the step of a servo, recorded and compiled for this machine.

numpy is the source, and goes on where a controller has no form in C or the machine no compiler. Rows equal those of
numpy up to rounding, which a method that learns without bounds may magnify; a run in C has the same bits alone and
beside others.
"""

import contextlib
import json
from dataclasses import asdict, replace
from functools import cache, partial
from pathlib import Path
from typing import Any, NamedTuple, cast, final

import numpy as np

from servobench.controllers.controller import Controller, ControllerEntry, Diagnostics
from servobench.controllers.servo import Servo, ServoController, ServoState, Stepped
from servobench.fmus.compiler import CODE, describe_compiler, this_platform
from servobench.fmus.controllers.branches import NOT_DEFINITE
from servobench.fmus.controllers.export import (
    FEATURE,
    POSITION,
    REFERENCE,
    SEEN,
    controller_groups,
)
from servobench.fmus.controllers.record import Inputs, Recorded, record
from servobench.fmus.variables import INPUT
from servobench.harness.config.registry import find_controller, is_foreign_controller
from servobench.harness.config.source import PACKAGE_FOLDER
from servobench.harness.run.experiment import Experiment
from servobench.harness.run.resolution import ResolvedRun
from servobench.plant.contract.cache import COMPILED, cached, key_of
from servobench.plant.contract.checks import FloatArray, Shape
from servobench.plant.contract.checksums import digest
from servobench.plant.contract.faults import ControllerDiverged, FilterDiverged
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import Observation, trusted_observation

CPU_INFO = Path("/proc/cpuinfo")
# Wide vectors, where the processor has them. No operation is fused or reordered, so that the bits are the same.
WIDE = "avx2"
# No library function sets `errno`, and nobody reads which operations were out of range.
FLAGS = ("-fvisibility=default", "-fno-math-errno", "-fno-trapping-math")
RECORDED = "recorded.json"  # file of a recorded step in the cache
NOT_FINITE = ControllerDiverged, "the estimate or the command is not finite"
# Kinds of faults and words for the codes of faults, other than those of `NOT_FINITE`
CAUSES = {NOT_DEFINITE: (FilterDiverged, "a covariance is not positive definite")}


class NoForm(ValueError):
    """A controller has no form in C; its message goes on after "it cannot be exported"."""


def record_step(entry: ControllerEntry, controller: Controller) -> tuple[Recorded, tuple[str, ...]]:
    """Record the step of a controller that an entry has built.

    Returns:
        The step with the columns [time, inputs], whose outputs are command (n) and Jacobian (m, n), 0 before there is
        one; and the names of the columns' parts.

    Raises:
        NoForm: it has no form in C; says why.
        NotTraceable: its numpy code cannot be recorded; says where.
    """
    if entry.needs_truth:
        raise NoForm(": it is given the true robot")
    if not isinstance(controller, ServoController):
        raise NoForm(": it is not composed of an estimator and a law")
    servo = controller.servo
    if servo.calibration is not None:
        raise NoForm(" while it fits the arm (aids.model=arm): take aids.model=regression")
    if not servo.initial.immediate:
        raise NoForm(
            " while it probes its initial Jacobian: set initial.source to nominal or given"
        )
    spec = servo.knowledge.spec
    groups = controller_groups(spec.n, spec.m, 1 + servo.knowledge.preview, spec.feature_unit)
    shapes: dict[str, tuple[Shape, str]] = {"time": ((), "f")}
    for group in groups:
        if group.role == INPUT:
            shapes[group.name] = (group.shape, "b" if group.name == SEEN else "f")
    modules = {part.__module__ for part in _classes(controller)}
    recorded = record(servo, _start, _step, shapes, shared=servo.knowledge.train, modules=modules)
    return recorded, tuple(shapes)


def _classes(controller: Controller) -> tuple[type, ...]:
    """Return the classes of the parts of a composed controller, some of which may be a user's."""
    if not isinstance(controller, ServoController):
        return (type(controller),)
    servo = controller.servo
    return type(servo.estimation.estimator), type(servo.law), type(servo.initial)


def _observation(inputs: Inputs) -> Observation:
    valid = inputs[SEEN]
    both = inputs[POSITION], inputs[FEATURE]
    return trusted_observation(inputs["time"], *both, np.logical_and.reduce(valid, axis=-1), valid)


def _start(servo: Servo, inputs: Inputs) -> ServoState:
    return servo.start(_observation(inputs))


def _step(servo: Servo, state: ServoState, inputs: Inputs) -> tuple[ServoState, FloatArray]:
    """Return the new state, and command and Jacobian in one row."""
    state, velocity = servo.step(state, _observation(inputs), inputs[REFERENCE])
    jacobian = servo.jacobian(state)
    known = np.where(np.isnan(jacobian), 0.0, jacobian)
    return state, np.concatenate([velocity, known.reshape(-1)])


class CompiledState(NamedTuple):
    """The state of a controller in C."""

    x: FloatArray  # (..., states)
    jacobian: FloatArray  # in the last step, (..., m, n) [unit of the feature/rad]; NaN before


@final
class CompiledServo(Servo):
    """A servo whose step is C, for one run or many side by side.

    Many share one state that each step overwrites; of a single run each step has a state of its own.
    """

    states = CompiledState

    def __init__(self, servo: Servo, recorded: Recorded) -> None:
        """Take a servo and its recorded step."""
        vars(self).update(vars(servo))
        self._recorded = recorded

    def start(self, observation: Observation) -> Any:  # noqa: ANN401 - a state of its own
        """See `Servo.start`."""
        spec = self.knowledge.spec
        unknown = np.zeros((*observation.lead, 1 + self.knowledge.preview, spec.m))
        x, _ = self._recorded.start(_row(observation, unknown))
        return CompiledState(x, np.full((*x.shape[:-1], spec.m, spec.n), np.nan))

    def step(self, state: Any, observation: Observation, reference: FloatArray) -> Any:  # noqa: ANN401
        """See `Servo.step`; the faults of runs side by side are in `faults`.

        Raises:
            RunFault: the estimate or the command of a single run is not finite, or its covariance not definite.
        """
        single = state.x.ndim == 1
        x = state.x.copy() if single else state.x
        outputs, codes = self._recorded.advance(x, _row(observation, reference))
        errors = {}
        for lane in np.flatnonzero(codes):
            kind, cause = CAUSES.get(int(codes.flat[lane]), NOT_FINITE)
            errors[int(lane)] = kind(f"{cause} at {observation.time:.5g} s")
        if single and errors:
            raise errors[0]
        self.faults = errors
        spec = self.knowledge.spec
        velocity, jacobian = np.split(outputs, [spec.n], axis=-1)
        new: Any = CompiledState(x, jacobian.reshape(*codes.shape, spec.m, spec.n))
        return Stepped(new, velocity)

    def jacobian(self, state: Any) -> FloatArray:  # noqa: ANN401
        """See `Servo.jacobian`."""
        return np.asarray(state.jacobian)

    def diagnostics(self, state: Any) -> Diagnostics:  # noqa: ANN401
        """Return nothing: what the stages know stays in C."""
        return {}


def _row(observation: Observation, reference: FloatArray) -> FloatArray:
    """Return the columns of a recorded step, (..., inputs)."""
    lead = observation.lead
    parts = (
        np.full((*lead, 1), observation.time),
        observation.joint_position,
        observation.feature,
        observation.valid,
        reference.reshape(*lead, -1),
    )
    return np.concatenate(parts, axis=-1)


_FOUND: dict[tuple[Any, ...], Recorded | str] = {}


def chosen(run: ResolvedRun, experiment: Experiment) -> Controller:
    """Return the controller of a run, or of runs of its kind side by side, in C.

    Where that cannot be, a remark says why numpy goes on.
    """
    controller = experiment.controller
    request = run.request
    spec = experiment.plant.spec
    kind = (request.controller, run.controller, request.robot, request.sensing, run.run, spec)
    with np.printoptions(floatmode="unique"):
        words = repr(kind)
    key = (words, *_classes(controller))  # A notebook may define a class anew.
    if key not in _FOUND:
        _FOUND[key] = (
            "frames are stamped" if experiment.plant.stamps else _compile(run, experiment, words)
        )
    found = _FOUND[key]
    if isinstance(found, str):
        remark(f"controller {request.controller!r} goes on in numpy: {found}")
        return controller
    return ServoController(CompiledServo(cast(ServoController, controller).servo, found))


def _compile(run: ResolvedRun, experiment: Experiment, kind: str) -> Recorded | str:
    """Return the compiled step of a controller, or why there is none."""
    try:
        fast = replace(_recorded(run, experiment, kind), flags=_flags())
        fast.prepare()
    except NoForm as error:
        return f"it cannot be compiled{error}"
    except ValueError as error:
        return str(error)
    return fast


def _recorded(run: ResolvedRun, experiment: Experiment, kind: str) -> Recorded:
    """Return the recorded step of a controller of some kind.

    It is kept in the user's cache, as recording takes a second; but not where it depends on files of a user's, whose
    words for robots and sensing have a suffix.

    Raises:
        ValueError: as `record_step`.
    """
    name = run.request.controller
    recorded = partial(record_step, find_controller(name), experiment.controller)
    if "." in run.request.robot + run.request.sensing or is_foreign_controller(name):
        return recorded()[0]

    def make(folder: Path) -> None:
        (folder / RECORDED).write_text(json.dumps(asdict(recorded()[0])), encoding="utf-8")

    path = cached(COMPILED, key_of(kind, _package_digest()), make) / RECORDED
    return Recorded(**json.loads(path.read_bytes()))


@cache
def _package_digest() -> str:
    """Return one SHA-256 of the code and the data of this package."""
    files = sorted(PACKAGE_FOLDER.glob("*/**/*.*"))
    return key_of(*(digest(file) for file in files if file.suffix != ".pyc"))


def _flags() -> tuple[str, ...]:
    with contextlib.suppress(OSError):
        if WIDE in CPU_INFO.read_text(encoding="utf-8").split():
            return (*FLAGS, f"-m{WIDE}")
    return FLAGS


def describe_compilation() -> str:
    """Return the compiler of this machine with the flags for controllers; "" without one."""
    with contextlib.suppress(ValueError):
        compiler = describe_compiler(this_platform())
        return " ".join((compiler, *CODE, *_flags()))
    return ""
