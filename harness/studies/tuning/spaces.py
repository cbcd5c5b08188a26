"""What may be tuned: for each controller three to six parameters and their ranges.

Ranges reach about a factor of ten around the defaults, or as far as a method allows; `log` ones are searched by factor.
Everything else keeps the default of its class, and is the same for all: limits, noise, delay, period and the preview of
ten rows. The preview is offered to all methods alike. `rbfnn_mfac`, `ukf_mpc` and `nmpc_calibrated` look at it by
construction; the laws `mfac` and `pid` may use its first row, and whether they do (`feedforward`) is a parameter, for
all of them. Predictive laws must bridge delay and horizon within the preview, so that what is searched is their `reach`
= horizon_time + delay.

`nmpc_calibrated` has no space. It is a bound that never looks at the camera: tuned where its model of the delay is
exact it gains nothing (0.071 against 0.072) and then cycles around the target on the rendered plant, whose joints
answer one period earlier.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Final, TypeAlias

from optuna.distributions import BaseDistribution, CategoricalDistribution, FloatDistribution, IntDistribution

from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.registry import find_controller
from servobench.harness.config.settings import ConfigurationError, flatten
from servobench.plant.settings import suggest

Space: TypeAlias = Mapping[str, BaseDistribution]

REACH: Final = "reach"
DIGITS: Final = 3  # of a tuned number: more would pretend to a precision that no study has


def _log(low: float, high: float) -> FloatDistribution:
    return FloatDistribution(low, high, log=True)


_SWITCH: Final = CategoricalDistribution((False, True))
_PID: Final[Space] = {
    "law.proportional_gain": _log(0.5, 8.0),  # 1/s
    "law.damping": _log(0.002, 0.2),  # m/rad
    "law.feedforward": _SWITCH,
}
_PID_INTEGRAL: Final[Space] = {**_PID, "law.integral_gain": FloatDistribution(0.0, 3.0)}  # 1/s²
_MFAC: Final[Space] = {
    "law.step_factor": _log(0.03, 0.6),
    "law.step_weight": _log(0.001, 0.2),  # m²/rad²
    "law.feedforward": _SWITCH,
}

SPACES: Final[Mapping[str, Space]] = {
    "rbfnn_mfac": {
        "law.k": _log(0.01, 1.0),
        "law.epsilon": _log(1e-5, 1e-1),  # m⁴
        "law.horizon": IntDistribution(3, 10),  # periods, at most the preview
        "estimator.k2": FloatDistribution(0.05, 1.8),
        "estimator.epsilon": _log(1e-5, 1e-2),  # rad²
        "training.controller.gain": FloatDistribution(2.0, 5.0, step=1.0),  # 1/s; each value is a training of its own
    },
    "rbfnn_mfac_plus": {
        "law.gain": _log(4.0, 30.0),  # 1/s
        "law.k": _log(0.01, 1.0),
        "law.leak": FloatDistribution(0.0, 0.1),
        "law.posture_gain": FloatDistribution(0.0, 1.0),  # 1/s
        "estimator.walk": _log(0.03, 3.0),
        "estimator.model_error": _log(0.01, 0.5),
    },
    "ukf_mfac": {
        **_MFAC,
        "estimator.process_deviation": _log(0.001, 0.3),  # m/rad
        "estimator.initial_deviation": _log(0.005, 0.5),  # m/rad
    },
    "ukf_mpc": {
        "law.decay": _log(0.6, 40.0),  # 1/s
        "law.move_weight": _log(0.001, 1.0),  # m²/rad²
        "law.reach": FloatDistribution(0.25, 0.5, step=0.05),  # s, at most the preview
        "law.delay": FloatDistribution(0.0, 0.15, step=0.05),  # s
        "estimator.process_deviation": _log(0.001, 0.3),  # m/rad
        "estimator.initial_deviation": _log(0.005, 0.5),  # m/rad
    },
    "rbf_pid": {
        "law.proportional_gain": _log(0.5, 8.0),  # 1/s
        "law.integral_gain": FloatDistribution(0.0, 3.0),  # 1/s²
        "law.derivative_gain": FloatDistribution(0.0, 0.5),
        "law.feedforward": _SWITCH,
        "estimator.n2": _log(1e-4, 0.2),  # 1/(m s)
        "estimator.n3": _log(1e-3, 2.0),  # 1/m
    },
    "constant": _PID_INTEGRAL,
    "calibrated": _PID_INTEGRAL,
    "broyden": {
        **_PID,
        "estimator.step_factor": _log(0.02, 1.0),
        "estimator.min_joint_step": _log(0.001, 0.05),  # rad
    },
    "rls": {
        **_PID,
        "estimator.forgetting": FloatDistribution(0.8, 1.0),
        "estimator.initial_covariance": _log(0.5, 100.0),  # 1/rad²; the class bounds it by 100
    },
    "cfdl_mfac": {
        **_MFAC,
        "estimator.step_factor": FloatDistribution(0.05, 1.9),
        "estimator.regularisation": _log(1e-5, 0.1),  # rad²
    },
}


def find_tunable(name: str) -> ControllerEntry:
    """Return the entry of a controller that has a search space.

    Raises:
        ConfigurationError: an unknown controller, or one without a space.
    """
    entry = find_controller(name)
    if name not in SPACES:
        raise ConfigurationError(f"controller {name} has no search space: {suggest(name, SPACES)}")
    return entry


def default_values(entry: ControllerEntry) -> dict[str, Any]:
    """Return the point of the search space that is the default of the controller's class, untuned."""
    flat = flatten(entry.config())
    for key in SPACES[entry.name]:
        prefix, _, last = key.rpartition(REACH)
        if not last and key not in flat:
            flat[key] = flat[f"{prefix}horizon_time"] + flat[f"{prefix}delay"]
    return {key: flat[key] for key in SPACES[entry.name]}


def nested_settings(values: Mapping[str, Any]) -> dict[str, Any]:
    """Return the nested settings of a point of a search space, numbers rounded to three digits."""
    nested: dict[str, Any] = {}
    for key, value in values.items():
        prefix, _, last = key.rpartition(".")
        target = nested
        for word in prefix.split(".") if prefix else ():
            target = target.setdefault(word, {})
        if last == REACH:
            dot = "." if prefix else ""
            target["horizon_time"] = float(f"{value - values[f'{prefix}{dot}delay']:.{DIGITS}g}")
        else:
            target[last] = float(f"{value:.{DIGITS}g}") if isinstance(value, float) else value
    return nested
