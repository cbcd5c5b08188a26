"""The last stages, between law and command: feedforward, null-space centring (posture), and saturation (limit).

    dq = dq_law + Ĵ⁺ (y_ref(k + lead + 1) − y_ref(k + lead)) + κ (I − Ĵ⁺Ĵ) (q_c − q̂),   κ = 1 − exp(−K_n dt)

within the limits of the joints' speeds (`limit`); Ĵ⁺ is the damped pseudo-inverse.
"""

import math
from collections.abc import Collection
from typing import final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.algebra import damped_inverse
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.stages.limit import largest_excess, redistribute
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import BoolArray


def step_with_posture(
    inverse: FloatArray, jacobian: FloatArray, feature_step: FloatArray, away: FloatArray, share: float
) -> FloatArray:
    """Return J⁺ v + κ (I − J⁺J)(q_c − q), (..., n), rad.

    Args:
        inverse: J⁺, damped or not, (..., n, m), rad/m.
        jacobian: J, (..., m, n), m/rad.
        feature_step: v, (..., m), m.
        away: q_c − q, from the present joint position to the wanted posture, (..., n), rad.
        share: κ, of that distance; 0 for no posture.
    """
    step: FloatArray = np.matvec(inverse, feature_step - share * np.matvec(jacobian, away)) + share * away
    return step


@final
class Finish:
    """Applies those of the stages above whose aids are on; they have no state."""

    def __init__(self, aids: AidsConfig, knowledge: RobotKnowledge, law: str, owns: Collection[str]) -> None:
        """Take settings, limits and the working region.

        Args:
            aids: the settings.
            knowledge: of the robot.
            law: name of the law, for error messages.
            owns: the stages that it brings.

        Raises:
            ValueError: a stage that the law brings itself, or a feedforward without a preview.
        """
        for stage, asked in (("preview", aids.feedforward), ("limit", aids.limit != "scale")):
            if asked and stage in owns:
                raise ValueError(f"aids: {law} brings its own {stage}; leave that aid off")
        if aids.feedforward and knowledge.preview < 1:
            raise ValueError(f"preview must be at least 1 for feedforward, got {knowledge.preview}")
        spec = knowledge.spec
        self._aids, self._period, self._limit = aids, spec.period, spec.joint_velocity_limit
        self._region = knowledge.region or (spec.joint_lower, spec.joint_upper)
        self._centre: FloatArray = (self._region[0] + self._region[1]) / 2.0
        self._share = 1.0 - math.exp(-aids.posture_gain * spec.period) if aids.posture else 0.0
        self._adds = aids.feedforward or aids.posture

    def finish(
        self, wanted: FloatArray, jacobian: FloatArray, joint_position: FloatArray, forward: FloatArray
    ) -> tuple[FloatArray, BoolArray]:
        """Return the joint velocity (..., n), rad/s, that leaves the chain, and whether it was limited, (...).

        Args:
            wanted: by the law, (..., n), rad/s.
            jacobian: Ĵ, (..., m, n).
            joint_position: q̂, (..., n), rad.
            forward: the reference's own step, (..., m), in this period; 0 without feedforward.
        """
        aids = self._aids
        if self._adds:
            inverse = damped_inverse(jacobian, aids.damping)
            step = step_with_posture(inverse, jacobian, forward, self._centre - joint_position, self._share)
            wanted = wanted + step / self._period
        excess = largest_excess(wanted, self._limit)
        if aids.limit == "clip":
            return np.clip(wanted, -self._limit, self._limit), excess > 1.0
        if aids.limit == "redistribute":
            lower, upper = self._region
            further = np.maximum(joint_position - lower, 0.0), np.maximum(upper - joint_position, 0.0)
            step = redistribute(wanted * self._period, jacobian, self._limit * self._period, aids.damping, further)
            return step / self._period, excess > 1.0
        return wanted / np.maximum(excess, 1.0)[..., None], excess > 1.0
