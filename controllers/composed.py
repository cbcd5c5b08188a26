"""Estimators and laws by name, and the controllers composed of them.

A new estimator or law is one line in `ESTIMATORS` or `LAWS`; then it can be paired with every part of the other kind.
The named methods (`controllers.ukf_mfac` and the like) are such pairs with a configuration class of their own.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field, make_dataclass
from functools import cache
from typing import Any, Generic, TypeAlias, TypeVar

from servobench.controllers.controller import Controller, ControllerEntry, RobotKnowledge
from servobench.controllers.estimators.broyden import BroydenConfig, BroydenEstimator
from servobench.controllers.estimators.cfdl import CfdlConfig, CfdlEstimator
from servobench.controllers.estimators.constant import ConstantConfig, ConstantEstimator
from servobench.controllers.estimators.estimator import Estimator
from servobench.controllers.estimators.kalman import KalmanConfig, KalmanEstimator
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator
from servobench.controllers.estimators.rbf_aligned import RbfAlignedConfig, RbfAlignedEstimator
from servobench.controllers.estimators.rbf_lyapunov import RbfLyapunovConfig, RbfLyapunovEstimator
from servobench.controllers.estimators.rls import RlsConfig, RlsEstimator
from servobench.controllers.estimators.true import TrueConfig, TrueEstimator
from servobench.controllers.estimators.ukf import UkfConfig, UkfEstimator
from servobench.controllers.initial import InitialConfig, initial_jacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.mfac import MfacConfig, MfacLaw
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.laws.pid import PidConfig, PidLaw
from servobench.controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw
from servobench.controllers.laws.rbfnn_bridged import RbfnnBridgedConfig, RbfnnBridgedLaw
from servobench.controllers.networks.config import TrainingConfig
from servobench.controllers.networks.file import TrainedNetworks
from servobench.controllers.networks.fit import obtain_networks
from servobench.controllers.servo import ServoController

Part = TypeVar("Part")
NetworkSource: TypeAlias = Callable[[], TrainedNetworks]


@dataclass(frozen=True)
class PartEntry(Generic[Part]):
    """An estimator or a control law as `ESTIMATORS` and `LAWS` know it.

    Attributes:
        config: frozen dataclass with a default for every field.
        build: makes the part from its configuration, what it may know and where offline networks come from.
        needs_truth: it is told the true Jacobian.
        trained: it starts from offline networks.
    """

    config: type[Any]
    build: Callable[[Any, RobotKnowledge, NetworkSource], Part]
    needs_truth: bool = False
    trained: bool = False


ESTIMATORS: dict[str, PartEntry[Estimator]] = {
    "constant": PartEntry(ConstantConfig, lambda _config, _knowledge, _networks: ConstantEstimator()),
    "true": PartEntry(TrueConfig, lambda _config, knowledge, _networks: TrueEstimator(knowledge), needs_truth=True),
    "ukf": PartEntry(UkfConfig, lambda config, _knowledge, _networks: UkfEstimator(config)),
    "kalman": PartEntry(KalmanConfig, lambda config, _knowledge, _networks: KalmanEstimator(config)),
    "broyden": PartEntry(BroydenConfig, lambda config, _knowledge, _networks: BroydenEstimator(config)),
    "rls": PartEntry(RlsConfig, lambda config, _knowledge, _networks: RlsEstimator(config)),
    "rbf": PartEntry(
        RbfConfig, lambda config, _knowledge, networks: RbfEstimator(config, networks().jacobian), trained=True
    ),
    "rbf_lyapunov": PartEntry(
        RbfLyapunovConfig,
        lambda config, _knowledge, networks: RbfLyapunovEstimator(config, networks().jacobian),
        trained=True,
    ),
    "rbf_aligned": PartEntry(
        RbfAlignedConfig,
        lambda config, knowledge, networks: RbfAlignedEstimator(config, networks().jacobian, knowledge.spec.period),
        trained=True,
    ),
    "cfdl": PartEntry(CfdlConfig, lambda config, _knowledge, _networks: CfdlEstimator(config)),
}

LAWS: dict[str, PartEntry[Law]] = {
    "pid": PartEntry(PidConfig, lambda config, knowledge, _networks: PidLaw(config, knowledge)),
    "mfac": PartEntry(MfacConfig, lambda config, knowledge, _networks: MfacLaw(config, knowledge)),
    "mpc": PartEntry(MpcConfig, lambda config, knowledge, _networks: MpcLaw(config, knowledge)),
    "rbfnn": PartEntry(
        RbfnnConfig,
        lambda config, knowledge, networks: RbfnnLaw(config, networks().controller, knowledge),
        trained=True,
    ),
    "rbfnn_bridged": PartEntry(
        RbfnnBridgedConfig,
        lambda config, knowledge, networks: RbfnnBridgedLaw(config, networks(), knowledge),
        trained=True,
    ),
}


def servo_entry(name: str, summary: str, config: type[Any], *, law: str, estimator: str) -> ControllerEntry:
    """Return the entry of a controller that is composed of two named parts.

    Args:
        name: the word on the command line.
        summary: one line about it.
        config: frozen dataclass with the fields `estimator`, `law` and `initial`, of the parts' own configurations, and
            `training` where a part starts from offline networks.
        law: a name in `LAWS`.
        estimator: a name in `ESTIMATORS`.

    Raises:
        ValueError: an unknown name.
    """
    law_entry = _find("law", law, LAWS)
    estimator_entry = _find("estimator", estimator, ESTIMATORS)

    def build(settings: Any, knowledge: RobotKnowledge) -> Controller:  # noqa: ANN401 - the entry's own configuration
        networks = cache(lambda: obtain_networks(settings.training, knowledge))  # of both parts the same
        return ServoController(
            estimator_entry.build(settings.estimator, knowledge, networks),
            law_entry.build(settings.law, knowledge, networks),
            initial_jacobian(settings.initial, knowledge),
            knowledge,
        )

    needs_truth = estimator_entry.needs_truth or law_entry.needs_truth
    return ControllerEntry(name, summary, config, build, needs_truth=needs_truth)


@cache
def compose(law: str, estimator: str) -> ControllerEntry:
    """Return the entry of any law with any estimator, both with their own defaults.

    Args:
        law: a name in `LAWS`.
        estimator: a name in `ESTIMATORS`.

    Returns:
        An entry called `law+estimator`, whose configuration has the fields estimator, law and initial, and training
        where one of the two starts from offline networks.

    Raises:
        ValueError: an unknown name.
    """
    parts = _find("estimator", estimator, ESTIMATORS), _find("law", law, LAWS)
    configs = {"estimator": parts[0].config, "law": parts[1].config, "initial": InitialConfig}
    if any(part.trained for part in parts):
        configs["training"] = TrainingConfig
    config = make_dataclass(
        f"{law}_{estimator}_config",
        [(name, kind, field(default_factory=kind)) for name, kind in configs.items()],
        frozen=True,
    )
    summary = f"the law {law} on the Jacobian that the estimator {estimator} tells"
    return servo_entry(f"{law}+{estimator}", summary, config, law=law, estimator=estimator)


def _find(kind: str, name: str, parts: dict[str, Any]) -> Any:  # noqa: ANN401 - either kind of entry
    if name not in parts:
        raise ValueError(f"{kind} must be one of {', '.join(sorted(parts))}, got {name!r}")
    return parts[name]
