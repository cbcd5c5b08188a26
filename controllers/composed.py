"""Estimators and laws by name, and the controllers composed of them.

A new estimator or law is one line in `ESTIMATORS` or `LAWS`; then it can be paired with every part of the other kind.
The named methods (`controllers.ukf_mfac` and the like) are such pairs with a configuration class of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, make_dataclass
from functools import cache
from typing import Any

from controllers.controller import Controller, ControllerEntry, RobotKnowledge
from controllers.estimators.broyden import BroydenConfig, BroydenEstimator
from controllers.estimators.cfdl import CfdlConfig, CfdlEstimator
from controllers.estimators.constant import ConstantConfig, ConstantEstimator
from controllers.estimators.estimator import Estimator
from controllers.estimators.kalman import KalmanConfig, KalmanEstimator
from controllers.estimators.rbf import RbfConfig, RbfEstimator
from controllers.estimators.rbf_aligned import RbfAlignedConfig, RbfAlignedEstimator
from controllers.estimators.rbf_lyapunov import RbfLyapunovConfig, RbfLyapunovEstimator
from controllers.estimators.rls import RlsConfig, RlsEstimator
from controllers.estimators.true import TrueConfig, TrueEstimator
from controllers.estimators.ukf import UkfConfig, UkfEstimator
from controllers.initial import InitialConfig, initial_jacobian
from controllers.laws.law import Law
from controllers.laws.mfac import MfacConfig, MfacLaw
from controllers.laws.mpc import MpcConfig, MpcLaw
from controllers.laws.pid import PidConfig, PidLaw
from controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw
from controllers.laws.rbfnn_bridged import RbfnnBridgedConfig, RbfnnBridgedLaw
from controllers.network_file import TrainedNetworks
from controllers.servo import ServoController
from controllers.training import obtain_networks
from controllers.training_config import TrainingConfig


@dataclass(frozen=True)
class EstimatorEntry:
    """An estimator as `ESTIMATORS` knows it.

    Attributes:
        config: frozen dataclass with a default for every field.
        build: makes the estimator from its configuration and what it may know.
        needs_truth: it is told the true Jacobian.
    """

    config: type[Any]
    build: Callable[[Any, RobotKnowledge], Estimator]
    needs_truth: bool = False


@dataclass(frozen=True)
class LawEntry:
    """A control law as `LAWS` knows it.

    Attributes:
        config: frozen dataclass with a default for every field.
        build: makes the law from its configuration and what it may know.
    """

    config: type[Any]
    build: Callable[[Any, RobotKnowledge], Law]


def _default_networks(knowledge: RobotKnowledge) -> TrainedNetworks:
    """Return the networks of the default training; with a cache behind `knowledge.train` both parts share one."""
    return obtain_networks(TrainingConfig(), knowledge)


ESTIMATORS: dict[str, EstimatorEntry] = {
    "constant": EstimatorEntry(ConstantConfig, lambda _config, _knowledge: ConstantEstimator()),
    "true": EstimatorEntry(TrueConfig, lambda _config, knowledge: TrueEstimator(knowledge), needs_truth=True),
    "ukf": EstimatorEntry(UkfConfig, lambda config, _knowledge: UkfEstimator(config)),
    "kalman": EstimatorEntry(KalmanConfig, lambda config, _knowledge: KalmanEstimator(config)),
    "broyden": EstimatorEntry(BroydenConfig, lambda config, _knowledge: BroydenEstimator(config)),
    "rls": EstimatorEntry(RlsConfig, lambda config, _knowledge: RlsEstimator(config)),
    "rbf": EstimatorEntry(
        RbfConfig, lambda config, knowledge: RbfEstimator(config, _default_networks(knowledge).jacobian)
    ),
    "rbf_lyapunov": EstimatorEntry(
        RbfLyapunovConfig,
        lambda config, knowledge: RbfLyapunovEstimator(config, _default_networks(knowledge).jacobian),
    ),
    "rbf_aligned": EstimatorEntry(
        RbfAlignedConfig,
        lambda config, knowledge: RbfAlignedEstimator(
            config, _default_networks(knowledge).jacobian, knowledge.spec.period
        ),
    ),
    "cfdl": EstimatorEntry(CfdlConfig, lambda config, _knowledge: CfdlEstimator(config)),
}

LAWS: dict[str, LawEntry] = {
    "pid": LawEntry(PidConfig, PidLaw),
    "mfac": LawEntry(MfacConfig, MfacLaw),
    "mpc": LawEntry(MpcConfig, MpcLaw),
    "rbfnn": LawEntry(
        RbfnnConfig, lambda config, knowledge: RbfnnLaw(config, _default_networks(knowledge).controller, knowledge)
    ),
    "rbfnn_bridged": LawEntry(
        RbfnnBridgedConfig, lambda config, knowledge: RbfnnBridgedLaw(config, _default_networks(knowledge), knowledge)
    ),
}


def servo_entry(name: str, summary: str, config: type[Any], *, law: str, estimator: str) -> ControllerEntry:
    """Return the entry of a controller that is composed of two named parts.

    Args:
        name: the word on the command line.
        summary: one line about it.
        config: frozen dataclass with the fields `estimator`, `law` and `initial`, of the parts' own configurations.
        law: a name in `LAWS`.
        estimator: a name in `ESTIMATORS`.

    Raises:
        ValueError: an unknown name.
    """
    law_entry = _find("law", law, LAWS)
    estimator_entry = _find("estimator", estimator, ESTIMATORS)

    def build(settings: Any, knowledge: RobotKnowledge) -> Controller:  # noqa: ANN401 - the entry's own configuration
        return ServoController(
            estimator_entry.build(settings.estimator, knowledge),
            law_entry.build(settings.law, knowledge),
            initial_jacobian(settings.initial, knowledge),
            knowledge,
        )

    return ControllerEntry(name, summary, config, build, needs_truth=estimator_entry.needs_truth)


@cache
def compose(law: str, estimator: str) -> ControllerEntry:
    """Return the entry of any law with any estimator, both with their own defaults.

    Args:
        law: a name in `LAWS`.
        estimator: a name in `ESTIMATORS`.

    Returns:
        An entry called `law+estimator`, whose configuration has the fields estimator, law and initial.

    Raises:
        ValueError: an unknown name.
    """
    estimator_config = _find("estimator", estimator, ESTIMATORS).config
    law_config = _find("law", law, LAWS).config
    config = make_dataclass(
        f"{law}_{estimator}_config",
        [
            ("estimator", estimator_config, field(default_factory=estimator_config)),
            ("law", law_config, field(default_factory=law_config)),
            ("initial", InitialConfig, field(default_factory=InitialConfig)),
        ],
        frozen=True,
    )
    summary = f"the law {law} on the Jacobian that the estimator {estimator} tells"
    return servo_entry(f"{law}+{estimator}", summary, config, law=law, estimator=estimator)


def _find(kind: str, name: str, parts: dict[str, Any]) -> Any:  # noqa: ANN401 - either kind of entry
    if name not in parts:
        raise ValueError(f"{kind} must be one of {', '.join(sorted(parts))}, got {name!r}")
    return parts[name]
