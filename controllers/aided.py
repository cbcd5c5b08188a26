"""A controller of your own with the aids of the others: it is the law of a composed controller.

    Observation → pair → estimate → predict → own controller → feedforward, posture, limit, calming → Command

The regression on the nominal Jacobian stands in the estimator's place. The controller gets, in the unit of the plant:

    observation                  joint position q̂ and feature that the arm reaches once all delays have passed
    reference                    the same time later; with feedforward row 0 alone, as that adds the reference's motion
    knowledge.nominal_jacobian   J(q) = J_n(q) + Ĵ(q̂) − J_n(q̂); J_n(q) before the first step, as in the constructor
"""

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import Any, final

from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import (
    Controller,
    ControllerEntry,
    Diagnostics,
    RobotKnowledge,
)
from servobench.controllers.estimators.constant import ConstantConfig, ConstantEstimator
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.laws.law import Estimate, Law
from servobench.controllers.methods import MethodConfig
from servobench.controllers.servo import Servo, ServoController
from servobench.controllers.units import in_natural_units
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.settings import Section, override
from servobench.plant.contract.signals import Command, Observation


@final
class OwnLaw(Law[None]):
    """A controller `own` as the law of one run; it keeps its state itself. `seed` is for its next reset."""

    def __init__(
        self, make: Callable[[RobotKnowledge], Controller], given: RobotKnowledge, aids: AidsConfig
    ) -> None:
        """Make the controller with its knowledge of a robot, in the unit of the plant."""
        # The nominal Jacobian that is corrected by the estimate; None where the controller gets it as it is.
        self._nominal = None if aids.model == "own" else given.nominal_jacobian
        self._unit = given.spec.feature.scale
        self.seed = 0
        self._correction: FloatArray | float = 0.0
        model = given.nominal_jacobian if self._nominal is None else self._jacobian
        self._rows = 1
        self.owns = frozenset()
        if not aids.feedforward:
            self._rows = 1 + given.preview
            self.owns = frozenset({"preview"})
        self.own = make(replace(given, nominal_jacobian=model, preview=self._rows - 1))
        self.in_model_frame = self.own.in_model_frame

    def start(self, observation: Observation) -> None:
        """Reset the controller."""
        self._correction = 0.0
        self.own.reset(self._in_plant_unit(observation), self.seed)

    def command(
        self, state: None, estimate: Estimate, observation: Observation, reference: FloatArray
    ) -> tuple[None, FloatArray]:
        """Return the joint velocity of the controller, (n,) rad/s."""
        if self._nominal is not None:
            nominal = self._nominal(observation.joint_position)
            self._correction = self._unit * estimate.jacobian - nominal
        wanted = self._unit * reference[: self._rows]
        return state, self.own.step(self._in_plant_unit(observation), wanted).joint_velocity

    def diagnostics(self, state: None) -> Diagnostics:
        """Return those of the controller."""
        return self.own.diagnostics()

    def _jacobian(self, joint_position: FloatArray) -> FloatArray:
        nominal: Any = self._nominal
        return nominal(joint_position) + self._correction

    def _in_plant_unit(self, observation: Observation) -> Observation:
        return observation.with_values(observation.joint_position, self._unit * observation.feature)


@final
class AidedController(Controller):
    """A controller of your own, `law.own`, in the chain of a composed one."""

    def __init__(
        self, make: Callable[..., Controller], config: MethodConfig, knowledge: RobotKnowledge
    ) -> None:
        """Make the controller, `make(config.law, knowledge)`, and compose the chain around it."""
        self.law = OwnLaw(partial(make, config.law), knowledge, config.aids)
        natural = in_natural_units(knowledge)
        initial = initial_jacobian(config.initial, natural)
        servo = Servo(ConstantEstimator(), self.law, initial, natural, config.aids)
        self._chain = ServoController(servo)

    def reset(self, observation: Observation, seed: int) -> None:
        """See `Controller.reset`."""
        self.law.seed = seed
        self._chain.reset(observation, seed)

    def step(self, observation: Observation, reference: FloatArray) -> Command:
        """See `Controller.step`."""
        return self._chain.step(observation, reference)

    def diagnostics(self) -> Diagnostics:
        """Return those of the chain and of the controller."""
        return self._chain.diagnostics()

    def estimated_jacobian(self) -> FloatArray | None:
        """Return the estimate of the chain, (m, n)."""
        return self._chain.estimated_jacobian()


def with_aids(entry: ControllerEntry, aids: Section) -> ControllerEntry:
    """Return the entry of a controller with aids, whose own settings become the section `law`.

    Raises:
        ValueError: no such aids.
    """
    if not isinstance(aids, Mapping):
        raise ValueError(f"aids must be servobench.EQUIPPED or a mapping like it, got {aids!r}")  # noqa: TRY004 - one kind
    chosen = override(f"{entry.name}.aids", AidsConfig(), aids)
    config = partial(MethodConfig, ConstantConfig(), entry.config(), InitialConfig(), chosen)
    return replace(entry, config=config, build=partial(AidedController, entry.build))
