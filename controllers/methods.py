"""Estimators, control laws and the methods made of them by name, one row each.

A new part works with every part of the other kind. A method is a control law, an estimator and the defaults that differ
from those of the parts. A plain name is the method with all aids that help it; `NAME:published` has none and its law as
printed. Any other pair is a method too, called `law+estimator`. Method numbers and equations in the summaries are the
paper's.
"""

import re
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cache, partial
from importlib import import_module
from typing import Any, Generic, Self, TypeVar

from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.controller import ControllerEntry, RobotKnowledge
from servobench.controllers.estimators.estimator import Estimator
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.networks.config import ControllerTraining, TrainingConfig
from servobench.controllers.networks.fit import obtain_networks
from servobench.controllers.servo import Servo, ServoController
from servobench.controllers.units import in_natural_units
from servobench.plant.contract.settings import Section, did_you_mean

Kind = TypeVar("Kind")


@dataclass(frozen=True)
class Part(Generic[Kind]):
    """An estimator or a control law as `ESTIMATORS` and `LAWS` list it; its module is imported once it is used."""

    module: str  # below `servobench.controllers`
    # The class of its settings, a frozen dataclass with a default for every field
    config_name: str
    # Its class, called with settings and `RobotKnowledge`, and with `TrainedNetworks` where `trained`
    make_name: str
    needs_truth: bool = False  # whether it needs the true Jacobian
    trained: bool = False  # whether it starts from networks that are trained offline

    @property
    def config(self) -> type[Any]:
        """The class of its settings."""
        found: type[Any] = self._find(self.config_name)
        return found

    @property
    def make(self) -> Callable[..., Kind]:
        """Its class, or a function that makes it."""
        found: Callable[..., Kind] = self._find(self.make_name)
        return found

    def _find(self, name: str) -> Any:  # noqa: ANN401 - anything that a module holds
        return getattr(import_module(f"servobench.controllers.{self.module}"), name)


ESTIMATORS: dict[str, Part[Estimator[Any]]] = {
    "constant": Part("estimators.constant", "ConstantConfig", "ConstantEstimator"),
    "true": Part("estimators.constant", "TrueConfig", "TrueEstimator", needs_truth=True),
    "ukf": Part("estimators.kalman", "UkfConfig", "ukf_estimator"),
    "kalman": Part("estimators.kalman", "KalmanConfig", "kalman_estimator"),
    "mckf": Part("estimators.correntropy", "MckfConfig", "mckf_estimator"),
    "imcckf": Part("estimators.correntropy", "ImcckfConfig", "imcckf_estimator"),
    "gmckf": Part("estimators.correntropy", "GmckfConfig", "gmckf_estimator"),
    "rmckf": Part("estimators.correntropy", "RmckfConfig", "rmckf_estimator"),
    "robust": Part("estimators.robust_filter", "RobustConfig", "RobustEstimator"),
    "broyden": Part("estimators.projection", "BroydenConfig", "ProjectionEstimator"),
    "rls": Part("estimators.kalman", "RlsConfig", "RlsEstimator"),
    "rbf": Part("estimators.rbf", "RbfConfig", "RbfEstimator", trained=True),
    "rbf_lyapunov": Part(
        "estimators.rbf", "RbfLyapunovConfig", "RbfLyapunovEstimator", trained=True
    ),
    "cfdl": Part("estimators.projection", "CfdlConfig", "ProjectionEstimator"),
}

LAWS: dict[str, Part[Law[Any]]] = {
    "pid": Part("laws.pid", "PidConfig", "PidLaw"),
    "mfac": Part("laws.mfac", "MfacConfig", "MfacLaw"),
    "mpc": Part("laws.mpc.mpc", "MpcConfig", "MpcLaw"),
    "rbfnn": Part("laws.rbfnn", "RbfnnConfig", "RbfnnLaw", trained=True),
}

PUBLISHED = ":published"  # after the name of a method: without aids, its law as printed


@dataclass(frozen=True)
class MethodConfig:
    """Settings of a composed controller."""

    estimator: Any  # settings of its estimator
    law: Any  # settings of its control law
    initial: InitialConfig  # where the first Jacobian comes from
    aids: AidsConfig  # the stages around them


@dataclass(frozen=True)
class TrainedMethodConfig(MethodConfig):
    """Settings of a composed controller of which a part starts from networks that are trained offline."""

    training: TrainingConfig  # the offline fits; methods with equal settings share the networks


@dataclass(frozen=True)
class Method:
    """A row of the table of methods."""

    name: str  # the word on the command line
    law: str  # a name in `LAWS`
    estimator: str  # a name in `ESTIMATORS`
    summary: str  # one line for `servobench controllers`
    # settings of the law that differ from its own defaults
    law_defaults: Section = field(default_factory=dict)
    # settings of the aids that differ from none
    aids: Section = field(default_factory=dict)
    # settings of the law as published that differ from its own defaults; None: it is not published
    printed: Section | None = None
    # settings of the estimator that differ from its own defaults where there are aids
    estimator_defaults: Section = field(default_factory=dict)
    # those of the controller network's training, likewise
    network_defaults: Section = field(default_factory=dict)

    def divisions(self) -> list[Self]:
        """Return the method best equipped and, where there is one, as published: without aids, its law as printed."""
        if self.printed is None:
            return [self]
        summary = f"{self.summary}; as published, without aids"
        printed = replace(
            self, law_defaults=self.printed, aids={}, estimator_defaults={}, network_defaults={}
        )
        return [self, replace(printed, name=self.name + PUBLISHED, summary=summary)]

    def config(self) -> MethodConfig:
        """Return the default settings."""
        law, estimator = self._parts()
        settings = (
            estimator.config(**self.estimator_defaults),
            law.config(**self.law_defaults),
            InitialConfig(),
            AidsConfig(**self.aids),
        )
        if law.trained or estimator.trained:
            training = TrainingConfig(controller=ControllerTraining(**self.network_defaults))
            return TrainedMethodConfig(*settings, training)
        return MethodConfig(*settings)

    def build(self, config: MethodConfig, knowledge: RobotKnowledge) -> ServoController:
        """Return the controller for these settings and this robot; its parts see features in natural units."""
        law, estimator = self._parts()
        knowledge = in_natural_units(knowledge)
        networks = []
        if isinstance(config, TrainedMethodConfig):
            networks.append(obtain_networks(config.training, knowledge))
        estimator_networks = networks if estimator.trained else []
        law_networks = networks if law.trained else []
        servo = Servo(
            estimator.make(config.estimator, knowledge, *estimator_networks),
            law.make(config.law, knowledge, *law_networks),
            initial_jacobian(config.initial, knowledge),
            knowledge,
            config.aids,
        )
        return ServoController(servo)

    def entry(self) -> ControllerEntry:
        """Return the method as the registry lists it.

        Raises:
            ValueError: an unknown law or estimator.
        """
        needs_truth = any(part.needs_truth for part in self._parts())
        return ControllerEntry(
            self.name, self.summary, self.config, self.build, needs_truth, side_by_side=True
        )

    def _parts(self) -> tuple[Part[Any], Part[Any]]:
        _check_name("law", self.law, LAWS)
        _check_name("estimator", self.estimator, ESTIMATORS)
        return LAWS[self.law], ESTIMATORS[self.estimator]


def _check_name(kind: str, name: str, known: Mapping[str, Part[Any]]) -> None:
    if name not in known:
        hint = did_you_mean(name, list(known))
        raise ValueError(f"{kind} must be one of {', '.join(sorted(known))}, got {name!r}{hint}")


# The predictive law brings a preview and limits itself.
_MPC_AIDS = {key: word for key, word in EQUIPPED.items() if key not in {"feedforward", "limit"}}
_GIVEN_DELAYS = {**EQUIPPED, "delay": "given", "response": "given", "model": "own"}
_PRINTED_MPC = {"mode": "constant", "use_preview": False, "limit_position": False}

# Methods best equipped, and as published with the law's defaults
_both = partial(Method, aids=EQUIPPED, printed={})

_ROWS = (
    Method(
        "rbfnn_mfac", "rbfnn", "rbf",
        "the proposed method: a controller network and a Jacobian network that learn online (eqs. 7-39)",
        {"preview": False, "offset_free": True}, EQUIPPED, printed={}, estimator_defaults={"leak": 0.1},
        network_defaults={"damping": 0.02},
    ),
    Method(
        "regression_mfac", "mfac", "constant",
        "a regression on the nominal Jacobian, with model-free adaptive control",
        {"gain": 27.7, "step_weight": 4e-4}, EQUIPPED,
    ),
    Method(
        "calibrating_mfac", "mfac", "constant",
        "the nominal arm and camera, calibrated from the frames of the run, with model-free adaptive control",
        {"gain": 27.7, "step_weight": 4.56e-3}, {**EQUIPPED, "model": "arm", "posture_gain": 0.167},
    ),
    _both("ukf_mfac", "mfac", "ukf", "unscented Kalman filter with model-free adaptive control (eq. 45)"),
    Method(
        "ukf_mpc", "mpc", "ukf", "unscented Kalman filter with model predictive control (eq. 46)",
        {}, _MPC_AIDS, printed=_PRINTED_MPC,
    ),
    _both(
        "rbf_pid", "pid", "rbf_lyapunov",
        "Jacobian network under a Lyapunov update with the pseudo-inverse law (eqs. 40-43)",
    ),
    Method("constant", "pid", "constant", "pseudo-inverse of the unchanged first Jacobian: the lower bound"),
    Method(
        "calibrated", "pid", "true", "pseudo-inverse of the true Jacobian with the true delays: a bound of its law",
        {}, _GIVEN_DELAYS,
    ),
    _both("broyden", "pid", "broyden", "Broyden's rank-one update with the pseudo-inverse law"),
    _both("rls", "pid", "rls", "recursive least squares with forgetting, with the pseudo-inverse law"),
    _both("cfdl_mfac", "mfac", "cfdl", "compact-form model-free adaptive control of Hou and Jin"),
)  # fmt: skip
METHODS: Mapping[str, ControllerEntry] = {
    method.name: method.entry() for row in _ROWS for method in row.divisions()
}


@cache
def compose(law: str, estimator: str) -> ControllerEntry:
    """Return the entry, called `law+estimator`, of any law with any estimator, both with their own defaults.

    Args:
        law: a name in `LAWS`.
        estimator: a name in `ESTIMATORS`.

    Raises:
        ValueError: an unknown name.
    """
    if law in ESTIMATORS and estimator in LAWS:
        raise ValueError(f"the law stands first: write {estimator}+{law}")
    summary = f"the law {law} with the Jacobian of the estimator {estimator}"
    return Method(f"{law}+{estimator}", law, estimator, summary).entry()


def suggest_pair(name: str) -> str:
    """Return the advice for the name of a law or an estimator given as that of a controller; empty for others."""
    if name not in {*LAWS, *ESTIMATORS}:
        return ""
    kind = "an estimator"
    pair = f"mfac+{name}"
    if name in LAWS:
        kind = "a law"
        pair = f"{name}+ukf"
    methods = [method for method in METHODS if name in re.split("[_:]", method)]
    ready = f"; methods with it: {', '.join(methods)}" if methods else ""
    return f"it is {kind} and makes a pair, such as {pair}{ready}"
