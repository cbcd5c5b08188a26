"""Providers of the initial Jacobian: the nominal model, small probing moves, or a given matrix.

Probing needs no model. One joint after the other makes a small move and rests until command delay, joint lag and camera
latency have died out; the features of a rest are averaged. With the rest-to-rest motions as columns of ΔY (m, n) and
ΔQ (n, n), the least-squares Jacobian is

    Ĵ₀ = ΔY ΔQ⁺
"""

from abc import ABC, abstractmethod
from typing import Annotated, Any, Generic, Literal, NamedTuple, TypeVar, final

import numpy as np
import numpy.typing as npt

from servobench.controllers.controller import JacobianFunction, RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.faults import ControllerDiverged
from servobench.plant.contract.lanes import branch, pick, transposed
from servobench.plant.contract.settings import Count, Number, Periods, Positive, Usual, settings
from servobench.plant.contract.signals import BoolArray, Observation, PlantSpec

State = TypeVar("State")
IntArray = npt.NDArray[np.int_]


@settings
class InitialConfig:
    """Settings of the initial Jacobian; by default a probe rests for longer than lag, delay and latency last."""

    source: Literal["nominal", "probe", "given"] = "nominal"
    """Where Ĵ₀ comes from: the nominal model, probing moves, or `given`."""
    probe_step: Annotated[Positive, Usual(0.3)] = 0.03
    """[rad] size of a probing move: some 20 mm at the ball, far above 1 mm of noise."""
    probe_periods: Count = 2
    """[periods] over which a probing move is spread."""
    settle_periods: Periods = 7
    """[periods] of rest before a feature counts."""
    average_periods: Count = 3
    """[periods] valid features that are averaged at each rest."""
    given: tuple[tuple[Number, ...], ...] = ()
    """[m/rad] m rows of n entries; only for source "given"."""


class InitialJacobian(ABC, Generic[State]):
    """Provides Ĵ₀, at once or after probing moves; pure, with leading axes, as estimators are."""

    duration: int = 0  # [periods] until Ĵ₀ is known, where no frame is lost

    @property
    def immediate(self) -> bool:
        """Whether Ĵ₀ is known from the start."""
        return self.duration == 0

    @abstractmethod
    def start(self, observation: Observation) -> State:
        """Return the state at the start of a run that begins with `observation`."""

    def step(self, state: State, observation: Observation) -> tuple[State, FloatArray, BoolArray]:
        """Return the new state, a velocity (..., n) [rad/s] of a probing move, and whether Ĵ₀ is known now, (...)."""
        return state, np.zeros_like(observation.joint_position), np.full(observation.feature.shape[:-1], True)

    @abstractmethod
    def jacobian(self, state: State) -> FloatArray:
        """Return Ĵ₀, (..., m, n), m/rad; only where it is known."""


@final
class KnownJacobian(InitialJacobian[FloatArray]):
    """Ĵ₀ = J(q(0)) of a model, which may be constant; the state is Ĵ₀ itself."""

    def __init__(self, model: JacobianFunction, spec: PlantSpec) -> None:
        """Take the model, (..., n) rad -> (..., m, n) m/rad, and the sizes that it must have."""
        self._model = model
        self._shape = (spec.m, spec.n)

    def start(self, observation: Observation) -> FloatArray:
        """Evaluate the model at the start.

        Raises:
            ValueError: the model is that of another robot.
        """
        jacobian = np.array(self._model(observation.joint_position), dtype=np.float64, order="C")
        if jacobian.shape[-2:] != self._shape:
            raise ValueError(f"nominal_jacobian must return shape {self._shape}, got {jacobian.shape}")
        return jacobian

    def jacobian(self, state: FloatArray) -> FloatArray:
        """Return Ĵ₀, (..., m, n), m/rad."""
        return state


class ProbeState(NamedTuple):
    """Progress of the probing."""

    rests: IntArray  # (...), rests that are over, the start included
    rest_positions: FloatArray  # (..., n+1, n) [rad], mean joint positions of the rests
    rest_features: FloatArray  # (..., n+1, m), mean features of the rests
    gathered: IntArray  # (...), observations gathered at the present rest
    positions: FloatArray  # (..., a, n) [rad], their joint positions
    features: FloatArray  # (..., a, m), their features
    phase: IntArray  # (...) [periods] since the present move began
    rest_begins: IntArray  # (...) [periods] duration of the present move


@final
class ProbedJacobian(InitialJacobian[ProbeState]):
    """Ĵ₀ = ΔY ΔQ⁺ from one small move of each joint, rest to rest.

    Encoder readings are used for ΔQ, so a joint that falls short of its command does no harm. Lost frames prolong a
    rest: it ends with the wanted number of valid features.
    """

    def __init__(self, config: InitialConfig, spec: PlantSpec) -> None:
        """Plan the moves.

        Raises:
            ValueError: a probing move that is faster than a joint may be, or too large for its range.
        """
        self._config = config
        self._spec = spec
        rest = config.average_periods
        self.duration = rest + spec.n * (config.probe_periods + config.settle_periods + rest - 1)
        self._speed = config.probe_step / (config.probe_periods * spec.period)
        slowest = float(spec.joint_velocity_limit.min())
        if self._speed > slowest:
            largest = slowest * config.probe_periods * spec.period
            raise ValueError(
                f"probe_step must be at most {largest:.6g} rad for probe_periods = {config.probe_periods}, or a joint "
                f"exceeds its limit of {slowest:g} rad/s; got {config.probe_step:g} rad"
            )
        narrowest = float((spec.joint_upper - spec.joint_lower).min())
        if 2.0 * config.probe_step > narrowest:
            half = f"half the joint range of {narrowest:g} rad"
            raise ValueError(f"probe_step must be at most {half}, got {config.probe_step:g}")

    def start(self, observation: Observation) -> ProbeState:
        """Return the state at the first rest, which is the start of the run."""
        lead, (m, n), count = observation.feature.shape[:-1], (self._spec.m, self._spec.n), self._config.average_periods
        return ProbeState(
            rests=np.zeros(lead, dtype=np.int_),
            rest_positions=np.zeros((*lead, n + 1, n)),
            rest_features=np.zeros((*lead, n + 1, m)),
            gathered=np.zeros(lead, dtype=np.int_),
            positions=np.zeros((*lead, count, n)),
            features=np.zeros((*lead, count, m)),
            phase=np.full(lead, self._config.settle_periods),  # the arm starts at rest
            rest_begins=np.zeros(lead, dtype=np.int_),
        )

    def step(self, state: ProbeState, observation: Observation) -> tuple[ProbeState, FloatArray, BoolArray]:
        """Return the velocity of the probing move, zero while resting or done, and whether all joints have moved."""
        config, n = self._config, self._spec.n
        settled = (state.phase >= state.rest_begins + config.settle_periods) & observation.feature_valid
        state = branch(settled, self._gather, state, observation)
        state = branch(state.gathered == config.average_periods, self._end_rest, state)
        done = state.rests == n + 1
        joint = np.minimum(state.rests, n) - 1
        moves = (state.phase < state.rest_begins) & ~done
        chosen = np.arange(n) == np.asarray(joint)[..., None]
        last = pick(state.rest_positions, joint)
        room = ((last + config.probe_step <= self._spec.joint_upper) & chosen).any(axis=-1)
        speed = np.where(room, self._speed, -self._speed) * moves
        return state._replace(phase=state.phase + 1), np.asarray(chosen * np.asarray(speed)[..., None]), done

    def _gather(self, state: ProbeState, observation: Observation) -> ProbeState:
        return state._replace(
            positions=_with_entry(state.positions, state.gathered, observation.joint_position),
            features=_with_entry(state.features, state.gathered, observation.feature),
            gathered=state.gathered + 1,
        )

    def _end_rest(self, state: ProbeState) -> ProbeState:
        zero = np.zeros_like(state.phase)
        return state._replace(
            rest_positions=_with_entry(state.rest_positions, state.rests, state.positions.mean(axis=-2)),
            rest_features=_with_entry(state.rest_features, state.rests, state.features.mean(axis=-2)),
            rests=state.rests + 1,
            gathered=zero,
            phase=zero,
            rest_begins=zero + self._config.probe_periods,
        )

    def jacobian(self, state: ProbeState) -> FloatArray:
        """Return Ĵ₀, (..., m, n), m/rad.

        Raises:
            ControllerDiverged: a joint did not move, so its column is unknown.
        """
        Q, Y = np.diff(state.rest_positions, axis=-2), np.diff(state.rest_features, axis=-2)
        if (np.linalg.svd(Q, compute_uv=False)[..., -1] < 0.1 * self._config.probe_step).any():
            raise ControllerDiverged(
                f"probing moved the joints too little to measure a Jacobian: joint steps {Q.tolist()} rad"
            )
        return np.ascontiguousarray(transposed(np.linalg.solve(Q, Y)))


def _with_entry(rows: FloatArray, index: IntArray, row: FloatArray) -> FloatArray:
    """Return rows (..., k, n) in which row `index`, (...), is `row`, (..., n)."""
    chosen = np.arange(rows.shape[-2]) == np.asarray(index)[..., None]
    return np.where(chosen[..., None], row[..., None, :], rows)


def initial_jacobian(config: InitialConfig, knowledge: RobotKnowledge) -> InitialJacobian[Any]:
    """Return the provider that `config` asks for.

    Raises:
        ValueError: the nominal Jacobian is wanted where no model exists, or settings that do not fit the plant.
    """
    spec, model = knowledge.spec, knowledge.nominal_jacobian
    if config.source == "probe":
        return ProbedJacobian(config, spec)
    if config.source == "given":
        lengths = [len(row) for row in config.given]
        if lengths != [spec.n] * spec.m:
            raise ValueError(f"given must hold {spec.m} rows of {spec.n} entries, got rows of length {lengths}")
        given = np.array(config.given)
        return KnownJacobian(lambda q: np.broadcast_to(given, (*q.shape[:-1], *given.shape)), spec)
    if model is None:
        raise ValueError(
            "source 'nominal' needs a nominal model, and this plant has none; take 'probe' or 'given' instead"
        )
    return KnownJacobian(model, spec)
