"""Controllers and plants of third parties, held to their contracts: each answer of a method is checked first.

They get copies, and copies of their answers are kept, so that code that writes into its arrays changes no row of a log.
Without this a step that returns an array ends in an attribute error of the loop, far from the line that is wrong. The
controllers and plants that this package composes itself are not checked, so that they cost nothing.
"""

from collections.abc import Callable, Mapping
from numbers import Real
from typing import Any, final

import numpy as np

from servobench.controllers.aided import AidedController
from servobench.controllers.controller import Controller, Diagnostics
from servobench.controllers.servo import ServoController
from servobench.harness.run.result import WrongAnswer
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.checks import REAL, FloatArray
from servobench.plant.contract.signals import (
    Command,
    Observation,
    PlantSpec,
    Truth,
    trusted_observation,
)

PLAIN = (float, int, np.float64)  # kinds of numbers in diagnostics that need no second check
MAX_NAMES = 256  # names of diagnostics in a run, each of which is a column
MAX_LETTERS = 100  # letters of such a name


def held_to_contract(plant: Plant, controller: Controller) -> tuple[Plant, Controller]:
    """Return plant and controller such that each raises `WrongAnswer` where it breaks its contract."""
    held = (
        controller
        if isinstance(controller, ServoController)
        else HeldController(controller, plant.spec)
    )
    return plant if isinstance(plant, Bench) else HeldPlant(plant), held


@final
class HeldController(Controller):
    """A controller whose answers are checked."""

    def __init__(self, controller: Controller, spec: PlantSpec) -> None:
        """Take a controller and the spec of its plant; with aids it is the user's controller that is checked, too."""
        if isinstance(controller, AidedController):
            controller.law.own = HeldController(controller.law.own, spec)
        self._controller = controller
        self._spec = spec
        self._names: set[str] = set()

    def reset(self, observation: Observation, seed: int) -> None:
        """See `Controller.reset`."""
        method = self._controller.reset
        given = _call(method, "reset(self, observation, seed)", _copied(observation), seed)
        if given is not None:
            raise WrongAnswer(
                f"reset must return nothing, got {_kind(given)}; keep it in self", method
            )

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """See `Controller.step`."""
        method = self._controller.step
        n = self._spec.n
        given = _copied(observation), _frozen(reference)
        command = _call(method, "step(self, observation, reference)", *given)
        if _bytes(*given) != _bytes(observation, reference):
            raise WrongAnswer("step changes its arguments; work on a copy", method)
        if not isinstance(command, Command):
            raise WrongAnswer(
                f"step must return a Command, got {_kind(command)}; write `return Command(joint_velocity)` with "
                f"{n} joint velocities in rad/s",
                method,
            )
        shape = command.joint_velocity.shape
        if shape != (n,):
            raise WrongAnswer(
                f"step must return a Command of shape ({n},), one rad/s a joint, got {shape}",
                method,
            )
        return Command(command.joint_velocity)

    def diagnostics(self) -> Diagnostics:
        """See `Controller.diagnostics`."""
        method = self._controller.diagnostics
        given = _call(method, "diagnostics(self)")
        if not isinstance(given, Mapping):
            text = "diagnostics must return a mapping of names to numbers"
            raise WrongAnswer(
                f"{text}, got {_kind(given)}; write `return {{}}` if there are none", method
            )
        for name, value in given.items():
            if type(value) not in PLAIN and not _is_number(value):
                raise WrongAnswer(
                    f"diagnostics must hold numbers, got {name!r}: {_kind(value)}", method
                )
            if not isinstance(name, str) or not name.isprintable() or len(name) > MAX_LETTERS:
                text = f"diagnostics must have texts of one line and at most {MAX_LETTERS} letters as names, got"
                raise WrongAnswer(f"{text} {name!r:.{MAX_LETTERS}}", method)
        self._names.update(given)
        if len(self._names) > MAX_NAMES:
            text = f"diagnostics must keep to the same names, at most {MAX_NAMES}: each is a column; got"
            raise WrongAnswer(f"{text} {len(self._names)}, among them {list(given)[-1]!r}", method)
        return given

    def estimated_jacobian(self) -> FloatArray | None:
        """See `Controller.estimated_jacobian`."""
        method = self._controller.estimated_jacobian
        wanted = (self._spec.m, self._spec.n)
        estimate = _call(method, "estimated_jacobian(self)")
        if estimate is None:
            return None
        if not isinstance(estimate, np.ndarray) or estimate.shape != wanted:
            text = f"estimated_jacobian must return an array of shape {wanted} or None"
            raise WrongAnswer(f"{text}, got {_kind(estimate)}", method)
        if estimate.dtype.kind not in REAL:
            text = f"estimated_jacobian must hold real numbers, got {estimate.dtype}"
            raise WrongAnswer(text, method)
        return np.asarray(estimate)


@final
class HeldPlant(Plant):
    """A plant whose answers are checked."""

    def __init__(self, plant: Plant) -> None:
        """Take a plant."""
        self._plant = plant
        self.spec = plant.spec
        self.stamps = plant.stamps

    def reset(self, seed: int) -> Observation:
        """See `Plant.reset`."""
        return self._observation(self._plant.reset, "reset(self, seed)", seed)

    def step(self, command: Command) -> Observation:
        """See `Plant.step`."""
        return self._observation(self._plant.step, "step(self, command)", command)

    def truth(self) -> Truth:
        """See `Plant.truth`."""
        method = self._plant.truth
        m = self.spec.m
        truth = _call(method, "truth(self)")
        if not isinstance(truth, Truth):
            raise WrongAnswer(f"truth of the plant must return a Truth, got {_kind(truth)}", method)
        for name, shape in (("feature", (m,)), ("jacobian", (m, self.spec.n))):
            value = getattr(truth, name)
            if value is None:
                continue
            what = f"truth of the plant: {name}"
            if np.shape(value) != shape:
                text = f"{what} must have shape {shape}, got {np.shape(value)}"
                raise WrongAnswer(text, method)
            kind = np.asarray(value).dtype
            if kind.kind not in REAL:
                raise WrongAnswer(f"{what} must hold real numbers, got {kind}", method)
        jacobian = None if truth.jacobian is None else _frozen(truth.jacobian)
        return Truth(_frozen(truth.feature), jacobian)

    def move_camera(self, X_BC: FloatArray) -> None:
        """See `Plant.move_camera`."""
        self._plant.move_camera(X_BC)

    def close(self) -> None:
        """See `Plant.close`."""
        self._plant.close()

    def _observation(
        self, method: Callable[..., Any], signature: str, argument: object
    ) -> Observation:
        observation = _call(method, signature, argument)
        name, _, _ = signature.partition("(")
        if not isinstance(observation, Observation):
            raise WrongAnswer(
                f"{name} of the plant must return an Observation, got {_kind(observation)}; write `return "
                "Observation(time, joint_position, feature)`",
                method,
            )
        for what, size in (("joint_position", self.spec.n), ("feature", self.spec.m)):
            shape = getattr(observation, what).shape
            if shape != (size,):
                raise WrongAnswer(
                    f"{name} of the plant: {what} must have shape ({size},), got {shape}", method
                )
        return _copied(observation)


def _copied(observation: Observation) -> Observation:
    """Return an observation whose arrays are its own."""
    joints = _frozen(observation.joint_position)
    feature = _frozen(observation.feature)
    valid = _frozen(observation.valid)
    return trusted_observation(
        observation.time,
        joints,
        feature,
        observation.feature_valid,
        valid,
        observation.capture_time,
    )


def _bytes(observation: Observation, reference: FloatArray) -> tuple[float | bytes, ...]:
    arrays = observation.joint_position, observation.feature, observation.valid, reference
    return observation.time, *(array.tobytes() for array in arrays)


def _frozen(array: Any) -> Any:  # noqa: ANN401 - an array of any kind
    """Return a read-only copy."""
    copy = np.array(array)
    copy.flags.writeable = False
    return copy


def _call(method: Callable[..., Any], signature: str, *arguments: object) -> Any:  # noqa: ANN401 - any answer
    """Call a method; if it does not take these arguments, the error names the signature that it needs."""
    try:
        return method(*arguments)
    except TypeError as error:
        trace = error.__traceback__
        # With a further frame the call was possible, and something behind it was not.
        if trace is None or trace.tb_next is not None:
            raise
        raise WrongAnswer(f"{error}; it must be `def {signature}`", method) from None


def _is_number(value: object) -> bool:
    array = np.asarray(value)
    return array.ndim == 0 and (isinstance(array.item(), Real) or array.dtype.kind in "biuf")


def _kind(value: object) -> str:
    if isinstance(value, np.ndarray):
        return f"ndarray of shape {value.shape}"
    if isinstance(value, type):
        return f"the class {value.__name__}"
    if value is None:
        return "None"
    return type(value).__name__
