"""The search spaces: for each controller its switches and its numbers with their ranges.

Ranges reach about a factor of ten around the defaults, or as far as a method allows; `log` ones are searched by factor.
Everything else keeps the default of its class, and is the same for all: limits, delays, period and the preview.

Every best equipped method has all words of the section `aids` as switches, but for those that its law brings itself,
and the same three numbers of the aids. The posture is no choice: a run of some seconds gains nothing by it, and without
it an arm drifts to its stops in half an hour. A delay or response that is given by a number is no choice: it would be a
guess where latencies differ. `NAME:published` has the numbers of its law as printed and of its estimator, and no aid.
A combination that cannot be built has the worst score without a run.

A number that a study leaves at an edge of its box is reported beside the tuned values, and the next study of the method
searches a box that is wider there (`widened`), unless the end is one of `LIMITS`.

The bounds `constant` and `calibrated` have their gains only, `nmpc_calibrated` has no space: by default it ignores
the camera, and tuned where its model of the delay is exact it gains nothing (0.071 against 0.072) and then cycles
around the target on the rendered plant, whose joints answer one period earlier.
"""

import math
from collections.abc import Collection, Mapping
from typing import Any, Final, TypeAlias

from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from servobench.controllers.aids import RANGES, SWITCHES
from servobench.controllers.controller import ControllerEntry
from servobench.harness.config.registry import find_controller
from servobench.harness.config.settings import flatten, nest, tuned_settings
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import suggest

Distribution: TypeAlias = CategoricalDistribution | FloatDistribution | IntDistribution
Space: TypeAlias = Mapping[str, Distribution]
Point: TypeAlias = Mapping[str, Any]
"""A value for each key of a space."""

DIGITS: Final = 3  # of a tuned number: more would pretend to a precision that no study has
EDGE: Final = 0.05  # [1] share of a box, by factor where it is searched so, within which a value is at its edge
WIDER: Final = 4.0  # factor by which a box is widened; one with a linear scale gets as much again at its upper end
LIMITS: Final[Mapping[str, float]] = {
    "law.horizon": 10,  # the preview has no more steps,
    "law.horizon_time": 0.5,  # and is no longer
    "law.k": 1.9,  # below 2, from which on these two diverge
    "estimator.k2": 1.9,
    "estimator.step_factor": 1.0,  # bounds of the classes; of cfdl_mfac the box ends beside the bound
    "estimator.initial_covariance": 100.0,
}
"""Upper ends of boxes that are no choice; a lower end of 0, or of one step, is none either."""


def _log(low: float, high: float) -> FloatDistribution:
    return FloatDistribution(low, high, log=True)


_SWITCH: Final = CategoricalDistribution((False, True))
_AIDS: Final[Space] = {
    **{f"aids.{name}": CategoricalDistribution(aid.tuned) for name, aid in SWITCHES.items() if aid.tuned},  # type: ignore[arg-type]
    **{f"aids.{name}": FloatDistribution(each.low, each.high, log=each.log) for name, each in RANGES.items()},
}
_P: Final[Space] = {
    "law.proportional_gain": _log(0.5, 30.0),  # 1/s
    "law.damping": _log(0.002, 0.2),  # m/rad
}
_PI: Final[Space] = {**_P, "law.integral_gain": FloatDistribution(0.0, 3.0)}  # 1/s²
_PID: Final[Space] = {**_PI, "law.derivative_gain": FloatDistribution(0.0, 0.5)}
_MFAC: Final[Space] = {
    "law.gain": _log(0.6, 40.0),  # 1/s
    "law.step_weight": _log(1e-4, 0.2),  # m²/rad²
}
_MPC: Final[Space] = {
    "law.decay": _log(0.6, 40.0),  # 1/s
    "law.move_weight": _log(0.001, 1.0),  # m²/rad²
    "law.horizon_time": FloatDistribution(0.2, 0.5, step=0.05),  # s, at most the preview
}
_RBFNN: Final[Space] = {
    "law.k": _log(0.01, 1.0),
    "law.epsilon": _log(1e-5, 1e-1),  # m⁴
    "law.horizon": IntDistribution(3, 10),  # steps of 0.05 s, at most the preview
    "training.controller.gain": FloatDistribution(2.0, 5.0, step=1.0),  # 1/s; each value is a training of its own
}
_RBF: Final[Space] = {
    "estimator.k2": _log(0.05, 1.8),
    "estimator.epsilon": _log(1e-5, 1e-2),  # rad²
}
_LYAPUNOV: Final[Space] = {
    "estimator.n2": _log(1e-4, 0.2),  # 1/(m s)
    "estimator.n3": _log(1e-3, 2.0),  # 1/m
}
_UKF: Final[Space] = {
    "estimator.walk": _log(0.004, 1.5),  # m/rad/√rad
    "estimator.initial_deviation": _log(0.005, 0.5),  # m/rad
}
_BROYDEN: Final[Space] = {
    "estimator.step_factor": _log(0.02, 1.0),
    "estimator.min_joint_step": _log(0.001, 0.05),  # rad
}
_RLS: Final[Space] = {
    "estimator.memory": _log(0.2, 20.0),  # s
    "estimator.initial_covariance": _log(0.5, 100.0),  # 1/rad²; the class bounds it by 100
}
_CFDL: Final[Space] = {
    "estimator.reset": _SWITCH,
    "estimator.step_factor": FloatDistribution(0.05, 1.9),
    "estimator.regularisation": _log(1e-5, 0.1),  # rad²
}


def _aids(without: Collection[str] = ()) -> Space:
    """Return the space of the aids but for those that a law or an estimator brings."""
    return {key: values for key, values in _AIDS.items() if key.removeprefix("aids.") not in without}


_MPC_SWITCHES: Final[Space] = {"law.mode": CategoricalDistribution(("constant", "moves")), "law.use_preview": _SWITCH}
_START: Final[Space] = {"initial.source": CategoricalDistribution(("nominal", "probe"))}
_RBFNN_SWITCHES: Final[Space] = {
    "law.offset_free": _SWITCH,
    "law.preview": _SWITCH,
    "law.row_space_only": _SWITCH,
    "law.anti_windup": _SWITCH,
}

SPACES: Final[Mapping[str, Space]] = {
    "rbfnn_mfac": {**_aids(), **_RBFNN_SWITCHES, **_RBFNN, **_RBF},
    "rbfnn_mfac:published": {**_RBFNN, **_RBF},
    "regression_mfac": {**_aids(), **_MFAC},
    "ukf_mfac": {**_aids(), **_START, **_MFAC, **_UKF},
    "ukf_mfac:published": {**_MFAC, **_UKF},
    "ukf_mpc": {**_aids({"feedforward", "limit"}), **_START, **_MPC_SWITCHES, **_MPC, **_UKF},
    "ukf_mpc:published": {**_MPC, **_UKF},
    "rbf_pid": {**_aids(), **_PID, **_LYAPUNOV},
    "rbf_pid:published": {**_P, **_LYAPUNOV},
    "constant": _PI,
    "calibrated": _PI,
    "broyden": {**_aids(), **_START, **_PID, **_BROYDEN},
    "broyden:published": {**_P, **_BROYDEN},
    "rls": {**_aids(), **_START, **_PID, **_RLS},
    "rls:published": {**_P, **_RLS},
    "cfdl_mfac": {**_aids(), **_START, **_MFAC, **_CFDL},
    "cfdl_mfac:published": {**_MFAC, **_CFDL},
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


def find_space(name: str) -> Space:
    """Return the search space of a controller, its switches first and its boxes widened around the values in use.

    Raises:
        ConfigurationError: an unknown controller, or one without a space.
    """
    find_tunable(name)
    space = widened(SPACES[name], flatten(tuned_settings(name)))
    return {key: space[key] for key in sorted(space, key=lambda key: not is_switch(space[key]))}


def edges(space: Space, values: Point) -> dict[str, str]:
    """Return which numbers lie at an edge of their box, or beyond: by key the word lower or upper.

    Args:
        space: the boxes.
        values: of some of its keys.
    """
    found = {}
    for key, value in values.items():
        box = space.get(key)
        if box is None or isinstance(box, CategoricalDistribution):
            continue
        low, high, at = (math.log(each) if box.log else each for each in (box.low, box.high, value))
        share = (at - low) / (high - low)
        if share < EDGE and box.low > (box.step or 0.0):
            found[key] = "lower"
        elif share > 1.0 - EDGE and box.high < LIMITS.get(key, math.inf):
            found[key] = "upper"
    return found


def widened(space: Space, values: Point) -> Space:
    """Return the space with wider boxes for those of `values` that lie at an edge; see `edges`."""
    wider = dict(space)
    for key, end in edges(space, values).items():
        box: Any = space[key]
        low, high = min(box.low, values[key]), max(box.high, values[key])
        if end == "upper":
            high = min(high * WIDER if box.log else 2 * high - low, LIMITS.get(key, math.inf))
        else:
            low = low / WIDER if box.step is None else max(2 * low - high, box.step)
        wider[key] = type(box)(low, high, log=box.log, step=box.step)
    return wider


def is_switch(distribution: Distribution) -> bool:
    """Return whether a parameter is a choice, not a number."""
    return isinstance(distribution, CategoricalDistribution)


def default_values(entry: ControllerEntry) -> Point:
    """Return the point of the search space that is the default of the controller's class, untuned."""
    return values_of(entry.name, entry.config())


def values_of(name: str, config: Any) -> Point:  # noqa: ANN401 - any configuration dataclass
    """Return the point of a controller's search space that its settings are."""
    flat = flatten(config)
    return {key: flat[key] for key in find_space(name)}


def nested_settings(values: Point) -> dict[str, Any]:
    """Return the nested settings of a point of a search space, numbers rounded to three digits."""
    rounded = {key: float(f"{each:.{DIGITS}g}") if isinstance(each, float) else each for key, each in values.items()}
    return nest(rounded)
