"""Providers of the initial Jacobian: the nominal model, small probing moves, or a given matrix.

Probing needs no model. One joint after the other makes a small move and rests until command delay, joint lag and camera
latency have died out; the features of a rest are averaged. With the rest-to-rest motions as columns of ΔY (m, n) and
ΔQ (n, n), the least-squares Jacobian is

    Ĵ₀ = ΔY ΔQ⁺
"""

from abc import ABC, abstractmethod
from math import ceil
from typing import Annotated, Any, Generic, Literal, NamedTuple, TypeVar, final

import numpy as np

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.periods import in_periods
from servobench.plant.contract.checks import FloatArray, IntArray
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.faults import ControllerDiverged
from servobench.plant.contract.lanes import branch, pick
from servobench.plant.contract.settings import Delay, Positive, Rows, Usual, settings
from servobench.plant.contract.signals import BoolArray, JacobianFunction, Observation, PlantSpec

MIN_FEATURES = 3  # number of features that end a rest after its time where frames are lost or slow
MIN_MOVED_SHARE = 0.1  # [1] least singular value of ΔQ in probing moves
State = TypeVar("State")


@settings
class InitialConfig:
    """Settings of the initial Jacobian; by default a probe rests for longer than lag, delay and latency last."""

    source: Literal["nominal", "probe", "given"] = "nominal"
    """Source of Ĵ₀: nominal model, probing moves, or `given`."""
    probe_step: Annotated[Positive, Usual(0.3), Only(source="probe")] = 0.03
    """[rad] size of a probing move; some 20 mm at the ball."""
    probe_time: Annotated[Positive, Usual(1.0), Only(source="probe")] = 0.1
    """[s] duration of a probing move."""
    settle_time: Annotated[Delay, Only(source="probe")] = 0.35
    """[s] rest before a feature counts."""
    average_time: Annotated[Positive, Usual(2.0), Only(source="probe")] = 0.15
    """[s] averaging of valid features at each rest."""
    given: Annotated[Rows, Only(source="given")] = ()
    """[m/rad] m rows of n entries."""


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
        velocity = np.zeros_like(observation.joint_position)
        known = np.full(observation.lead, True)
        return state, velocity, known

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
            raise ValueError(
                f"nominal_jacobian must return shape {self._shape}, got {jacobian.shape}"
            )
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
    positions: FloatArray  # (..., n) [rad], sum of their joint positions
    features: FloatArray  # (..., m), sum of their features
    phase: IntArray  # (...) [periods] since the present move began
    rest_begins: IntArray  # (...) [periods] duration of the present move


@final
class ProbedJacobian(InitialJacobian[ProbeState]):
    """Ĵ₀ = ΔY ΔQ⁺ from one small move of each joint, rest to rest.

    Encoder readings are used for ΔQ, so a joint that falls short of its command does no harm. Times are rounded up to
    control periods. A rest ends with a valid feature for each period of its time, or after it with `MIN_FEATURES`.
    """

    def __init__(self, config: InitialConfig, spec: PlantSpec) -> None:
        """Plan the moves.

        Raises:
            ValueError: a probing move that is faster than a joint may be, or too large for its range.
        """
        self._config = config
        self._spec = spec
        self._move = ceil(in_periods(config.probe_time, spec.period))
        self._settle = ceil(in_periods(config.settle_time, spec.period))
        self._rest = ceil(in_periods(config.average_time, spec.period))
        periods_a_joint = self._move + self._settle + self._rest - 1
        self.duration = self._rest + spec.n * periods_a_joint
        self._speed = config.probe_step / (self._move * spec.period)
        slowest = float(spec.joint_velocity_limit.min())
        if self._speed > slowest:
            largest = slowest * self._move * spec.period
            raise ValueError(
                f"probe_step must be at most {largest:.6g} rad for probe_time = {config.probe_time:g} s, or a joint "
                f"exceeds its limit of {slowest:g} rad/s; got {config.probe_step:g} rad"
            )
        ranges = spec.joint_upper - spec.joint_lower
        narrowest = float(ranges.min())
        if 2.0 * config.probe_step > narrowest:
            raise ValueError(
                f"probe_step must be at most half the joint range of {narrowest:g} rad, got {config.probe_step:g}"
            )

    def start(self, observation: Observation) -> ProbeState:
        """Return the state at the first rest, which is the start of the run."""
        lead = observation.lead
        n = self._spec.n
        m = self._spec.m
        none = np.zeros(lead, dtype=np.int_)
        q = np.zeros((*lead, n))
        y = np.zeros((*lead, m))
        rest_positions = np.zeros((*lead, n + 1, n))
        rest_features = np.zeros((*lead, n + 1, m))
        settled = np.full(lead, self._settle)  # The arm starts at rest.
        return ProbeState(
            rests=none,
            rest_positions=rest_positions,
            rest_features=rest_features,
            gathered=none,
            positions=q,
            features=y,
            phase=settled,
            rest_begins=none,
        )

    def step(
        self, state: ProbeState, observation: Observation
    ) -> tuple[ProbeState, FloatArray, BoolArray]:
        """Return the velocity of the probing move, zero while resting or done, and whether all joints have moved."""
        n = self._spec.n
        rested = state.phase - state.rest_begins - self._settle
        state = branch((rested >= 0) & observation.feature_valid, self._gather, state, observation)
        # Where frames are lost, a rest goes on after its time until there are a few features.
        enough = np.where(rested + 1 < self._rest, self._rest, min(self._rest, MIN_FEATURES))
        state = branch(state.gathered >= enough, self._end_rest, state)
        done = state.rests == n + 1

        moves = (state.phase < state.rest_begins) & ~done
        joint = np.minimum(state.rests, n) - 1
        chosen = np.arange(n) == np.asarray(joint)[..., None]
        # A joint without room above moves downwards.
        last = pick(state.rest_positions, joint)
        fits = last + self._config.probe_step <= self._spec.joint_upper
        room = (fits & chosen).any(axis=-1)
        speed = np.where(room, self._speed, -self._speed) * moves
        velocity = np.asarray(chosen * np.asarray(speed)[..., None])
        return state._replace(phase=state.phase + 1), velocity, done

    def _gather(self, state: ProbeState, observation: Observation) -> ProbeState:
        q = state.positions + observation.joint_position
        y = state.features + observation.feature
        return state._replace(positions=q, features=y, gathered=state.gathered + 1)

    def _end_rest(self, state: ProbeState) -> ProbeState:
        """Return the state in which the present rest is over and its means are kept."""
        zero = np.zeros_like(state.phase)
        count = np.asarray(state.gathered)[..., None]
        q = state.positions / count
        y = state.features / count
        rest_positions = _with_entry(state.rest_positions, state.rests, q)
        rest_features = _with_entry(state.rest_features, state.rests, y)
        no_position = np.zeros_like(q)
        no_feature = np.zeros_like(y)
        return state._replace(
            rest_positions=rest_positions,
            rest_features=rest_features,
            rests=state.rests + 1,
            gathered=zero,
            positions=no_position,
            features=no_feature,
            phase=zero,
            rest_begins=zero + self._move,
        )

    def jacobian(self, state: ProbeState) -> FloatArray:
        """Return Ĵ₀, (..., m, n), m/rad.

        Raises:
            ControllerDiverged: a joint did not move, so its column is unknown.
        """
        # Rows of Q and Y are ΔQᵀ and ΔYᵀ.
        Q = np.diff(state.rest_positions, axis=-2)
        Y = np.diff(state.rest_features, axis=-2)
        smallest = np.linalg.svd(Q, compute_uv=False)[..., -1]
        if (smallest < MIN_MOVED_SHARE * self._config.probe_step).any():
            raise ControllerDiverged(
                f"probing moved the joints too little to measure a Jacobian: joint steps {Q.tolist()} rad"
            )
        return np.ascontiguousarray(np.linalg.solve(Q, Y).mT)


def _with_entry(rows: FloatArray, index: IntArray, row: FloatArray) -> FloatArray:
    """Return rows (..., k, n) in which row `index`, (...), is `row`, (..., n)."""
    places = np.arange(rows.shape[-2])
    chosen = places == np.asarray(index)[..., None]
    return np.where(chosen[..., None], row[..., None, :], rows)


def initial_jacobian(config: InitialConfig, knowledge: RobotKnowledge) -> InitialJacobian[Any]:
    """Return the provider that `config` asks for.

    Raises:
        ValueError: the nominal Jacobian is wanted where no model exists, or settings that do not fit the plant.
    """
    spec = knowledge.spec
    model = knowledge.nominal_jacobian
    if config.source == "probe":
        return ProbedJacobian(config, spec)
    if config.source == "given":
        lengths = [len(row) for row in config.given]
        if lengths != [spec.n] * spec.m:
            raise ValueError(
                f"initial.given must hold {spec.m} rows of {spec.n} entries, got rows of length {lengths}"
            )
        given = np.array(config.given)
        return KnownJacobian(lambda q: np.broadcast_to(given, (*q.shape[:-1], *given.shape)), spec)
    if model is None:
        raise ValueError(
            "source 'nominal' needs a nominal model, and this plant has none; set initial.source to 'probe' or 'given'"
        )
    return KnownJacobian(model, spec)
