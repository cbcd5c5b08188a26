"""Natural units: laws and estimators get features divided by their natural size, so that one set of values serves all.

    y' = y / s,   J' = J / s          s the scale of the feature's channel: 1 m of a place, pixels per metre of a pixel

With s = 1 nothing is changed. Settings in metres are therefore metres of a ball that moves across the optical axis.
"""

from dataclasses import dataclass, replace

from servobench.controllers.controller import RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.signals import JacobianFunction


@dataclass(frozen=True, eq=False)
class NaturalJacobian:
    """A Jacobian in natural units; its lanes are those of the function, where that has some."""

    function: JacobianFunction  # (..., n) rad -> (..., m, n), in the unit of the feature.
    scale: float  # s, in that unit

    def __call__(self, joint_position: FloatArray) -> FloatArray:
        """Return J / s, (..., m, n)."""
        return self.function(joint_position) / self.scale


def in_natural_units(knowledge: RobotKnowledge) -> RobotKnowledge:
    """Return the knowledge of a robot with its features in natural units; its `unit` is one of these in the plant's."""
    feature = knowledge.spec.feature
    scale = feature.scale
    if scale == 1.0:
        return knowledge
    natural = replace(feature, scale=1.0, lower=feature.lower / scale, upper=feature.upper / scale)
    nominal = knowledge.nominal_jacobian
    true = knowledge.true_jacobian
    symbolic = knowledge.true_symbolic
    return replace(
        knowledge,
        spec=replace(knowledge.spec, feature=natural),
        nominal_jacobian=None if nominal is None else NaturalJacobian(nominal, scale),
        true_jacobian=None if true is None else NaturalJacobian(true, scale),
        true_symbolic=None if symbolic is None else lambda q: symbolic(q) / scale,
        unit=scale * knowledge.unit,
    )
