"""Estimators and control laws by name; a new part is one row and then works with every part of the other kind."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, Generic, TypeVar

from servobench.controllers.estimators import correntropy
from servobench.controllers.estimators.constant import ConstantConfig, ConstantEstimator, TrueConfig, TrueEstimator
from servobench.controllers.estimators.estimator import Estimator
from servobench.controllers.estimators.kalman import KalmanConfig, kalman_estimator
from servobench.controllers.estimators.projection import BroydenConfig, BroydenEstimator, CfdlConfig, CfdlEstimator
from servobench.controllers.estimators.rbf import RbfConfig, RbfEstimator, RbfLyapunovConfig, RbfLyapunovEstimator
from servobench.controllers.estimators.rls import RlsConfig, RlsEstimator
from servobench.controllers.estimators.robust_filter import RobustConfig, RobustEstimator
from servobench.controllers.estimators.ukf import UkfConfig, ukf_estimator
from servobench.controllers.laws.law import Law
from servobench.controllers.laws.mfac import MfacConfig, MfacLaw
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.laws.pid import PidConfig, PidLaw
from servobench.controllers.laws.rbfnn import RbfnnConfig, RbfnnLaw

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Part(Generic[Kind]):
    """An estimator or a control law as `ESTIMATORS` and `LAWS` list it.

    Attributes:
        config: its settings, a frozen dataclass with a default for every field.
        make: its class, called with settings and `RobotKnowledge`, and with `TrainedNetworks` where `trained`.
        needs_truth: whether it needs the true Jacobian.
        trained: whether it starts from networks that are trained offline.
    """

    config: type[Any]
    make: Callable[..., Kind]
    needs_truth: bool = False
    trained: bool = False


ESTIMATORS: dict[str, Part[Estimator[Any]]] = {
    "constant": Part(ConstantConfig, ConstantEstimator),
    "true": Part(TrueConfig, TrueEstimator, needs_truth=True),
    "ukf": Part(UkfConfig, ukf_estimator),
    "kalman": Part(KalmanConfig, kalman_estimator),
    "mckf": Part(correntropy.MckfConfig, correntropy.mckf_estimator),
    "imcckf": Part(correntropy.ImcckfConfig, correntropy.imcckf_estimator),
    "gmckf": Part(correntropy.GmckfConfig, correntropy.gmckf_estimator),
    "rmckf": Part(correntropy.RmckfConfig, correntropy.rmckf_estimator),
    "robust": Part(RobustConfig, RobustEstimator),
    "broyden": Part(BroydenConfig, BroydenEstimator),
    "rls": Part(RlsConfig, RlsEstimator),
    "rbf": Part(RbfConfig, RbfEstimator, trained=True),
    "rbf_lyapunov": Part(RbfLyapunovConfig, RbfLyapunovEstimator, trained=True),
    "cfdl": Part(CfdlConfig, CfdlEstimator),
}

LAWS: dict[str, Part[Law[Any]]] = {
    "pid": Part(PidConfig, PidLaw),
    "mfac": Part(MfacConfig, MfacLaw),
    "mpc": Part(MpcConfig, MpcLaw),
    "rbfnn": Part(RbfnnConfig, RbfnnLaw, trained=True),
}
