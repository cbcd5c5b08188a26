"""The symbolic twin of every arm and its cameras in CasADi: the set-up's own function over expressions.

The kinematics is written from the same table as `servobench.plant.robot.symbolic`; the features are those that the
set-up makes of an array of expressions. A set-up whose function CasADi cannot carry out has no symbolic twin.
"""

from __future__ import annotations

from typing import Any

import casadi
import numpy as np

from servobench.plant.eyes.model import EyeModel
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.sensed import SensedArm
from servobench.plant.robot.symbolic import ArmGeometry, arm_frames
from servobench.plant.robot.symbolic import symbolic_feature as symbolic_ball


def symbolic_feature(model: SensedArm) -> casadi.Function:
    """Return q -> feature, (n,) rad -> (m,), with the numbers of `model` bound.

    Raises:
        ValueError: the set-up's function cannot be carried out over expressions.
    """
    if isinstance(model, HandEyeModel):
        return symbolic_ball(model)
    if not isinstance(model, EyeModel):
        raise ValueError(f"model must be of an arm and its cameras, got {type(model).__name__}")  # noqa: TRY004
    q = casadi.SX.sym("joint_position", model.arm.n)
    # A leading axis keeps whatever the function takes apart an array, whose entries numpy asks for their own functions.
    points = np.empty((1, model.eye.cameras, len(model.target), 3), dtype=object)
    flange, place = _flange(q, model)
    for p, target in enumerate(model.target):
        t = casadi.SX(target)
        mounted = place + flange @ t if model.mount == "fixed" else flange.T @ (t - place)
        for c, camera in enumerate(model.cameras):
            seen = casadi.SX(camera[:3, :3]).T @ (mounted - casadi.SX(camera[:3, 3]))
            points[0, c, p] = [seen[0], seen[1], seen[2]]
    try:
        features: Any = model.eye.measure(points, model.optics)
    except (TypeError, AttributeError, RuntimeError, NotImplementedError) as error:
        raise ValueError(f"sensing {model.eye.name} has no symbolic twin: {error}") from error
    feature = casadi.vertcat(*features[0].tolist())
    return casadi.Function("feature", [q], [feature], ["joint_position"], ["feature"])


def _flange(q: Any, model: EyeModel) -> tuple[Any, Any]:  # noqa: ANN401 - expressions
    """Return rotation and position of the flange as expressions."""
    *_, rotation, position = arm_frames(q, ArmGeometry.of(model.arm))
    return rotation, position
