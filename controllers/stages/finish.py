"""The last stages, between law and command: feedforward, null-space centring (posture), saturation (limit), calming.

    dq = dq_law + Ĵ⁺ (y_ref(k + lead + 1) − y_ref(k + lead)) + κ (I − Ĵ⁺Ĵ) (q_c − q̂),   κ = 1 − exp(−K_n dt)

within the limits of the joints' speeds; Ĵ⁺ is the damped pseudo-inverse. A joint step or velocity beyond its limits is
scaled as a whole or redistributed among the joints: an arm with more joints than features can go on when one joint is
at its limit, as the others take over. `redistribute` first shrinks the wanted step until no joint exceeds its limit.
The joints that have room then make the rest of the feature's step, until one after the other has none left, always
along the wanted direction of the feature.

Where the target is out of reach, the stretched arm steps over the nearest point again and again, at full speed and in
turn to both sides. Calming halves the speed that is allowed with each such turn, from the seventh in a row on.
"""

import math
from collections.abc import Collection
from functools import partial
from typing import NamedTuple, final

import numpy as np

from servobench.controllers.aids import AidsConfig
from servobench.controllers.algebra import damped_inverse
from servobench.controllers.controller import RobotKnowledge
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import branch, repeat
from servobench.plant.contract.signals import BoolArray, Observation

PATIENCE = 64.0  # [1] usual bound; from the seventh halving in a row on, it is one
CRAWLING = 1.0 / 64.0  # [1] bound at which no turn halves it further: the arm can still leave
SLOWER = 0.5  # [1] factor on the bound after a turn
FASTER = 1.25  # [1] the same after any other period
MIN_ROOM = 1e-9  # [1] of its limit; a joint with less room is left out
REMAINDER_TOLERANCE = 1e-6  # [1] of the step that may be left undone


def largest_excess(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Return the largest |u_i| / limit_i, (...), of joint velocities (..., n); above 1 some joint exceeds its limit."""
    return np.maximum.reduce(np.abs(joint_velocity) / limit, axis=-1)


def scale_to_limit(joint_velocity: FloatArray, limit: FloatArray) -> FloatArray:
    """Shrink a joint velocity until every joint keeps its limit; the direction stays, and so does the path.

    Args:
        joint_velocity: (..., n), rad/s.
        limit: (n,), rad/s, positive.

    Returns:
        (..., n), rad/s.
    """
    return joint_velocity / np.maximum(largest_excess(joint_velocity, limit), 1.0)[..., None]


class _Shared(NamedTuple):
    """A joint step that is being redistributed."""

    joint_step: FloatArray  # (..., n), rad, within the limits
    left: FloatArray  # (...), share of the wanted step that is still to be made
    free: BoolArray  # (..., n), joints that may still take over
    jacobian: FloatArray  # Ĵ, (..., m, n), m/rad
    wanted: FloatArray  # the wanted step of the feature, (..., m), m
    down: FloatArray  # (..., n), rad, how far a joint may go down in total
    up: FloatArray  # the same upwards


def redistribute(
    joint_step: FloatArray,
    jacobian: FloatArray,
    limit: FloatArray,
    damping: float,
    further: tuple[FloatArray, FloatArray],
) -> FloatArray:
    """Return a joint step within the limits that moves the feature by f Ĵ dq, 0 < f ≤ 1, with a large f.

    Args:
        joint_step: dq, (..., n), rad, as wanted.
        jacobian: Ĵ, (..., m, n), m/rad.
        limit: (n,), rad, positive.
        damping: m/rad, positive; the remaining joints make little motion in directions in which they are weaker, and
            the feature's direction is kept except for the part that they leave out.
        further: how far a joint that takes over may go down and up in total, two arrays (..., n), rad, at least 0.

    Returns:
        (..., n), rad; `joint_step` itself where it keeps the limits.
    """
    take_over = partial(_take_over, limit=limit, damping=damping)

    def shared(
        joint_step: FloatArray, jacobian: FloatArray, down: FloatArray, up: FloatArray
    ) -> FloatArray:
        excess = largest_excess(joint_step, limit)
        dq = joint_step / excess[..., None]
        free = np.abs(dq) < limit - MIN_ROOM * limit
        wanted = np.matvec(jacobian, joint_step)
        down, up = np.minimum(limit, down), np.minimum(limit, up)
        state = _Shared(dq, 1.0 - 1.0 / excess, free, jacobian, wanted, down, up)
        # Each pass excludes a joint, brings one to its limit, or finishes: two passes for each joint are enough.
        state = repeat(_is_unfinished, take_over, state, 2 * joint_step.shape[-1] + 1)
        return np.minimum(np.maximum(state.joint_step, -limit), limit)

    return branch(largest_excess(joint_step, limit) > 1.0, shared, joint_step, jacobian, *further)


def _is_unfinished(state: _Shared) -> BoolArray:
    enough = np.add.reduce(state.free, axis=-1) >= state.jacobian.shape[-2]
    return (state.left > REMAINDER_TOLERANCE) & enough


def _take_over(state: _Shared, limit: FloatArray, damping: float) -> _Shared:
    """Move the free joints until one reaches its limit; a joint that is at its limit already is only excluded."""
    dq, free = state.joint_step, state.free
    J = np.where(free[..., None, :], state.jacobian, 0.0)
    more = state.left[..., None] * np.matvec(damped_inverse(J, damping), state.wanted)
    room = np.where(more > 0.0, state.up - dq, state.down + dq)
    stuck = free & (room <= MIN_ROOM * limit)
    free = free & ~stuck
    use = np.divide(np.abs(more), room, where=free, out=np.zeros_like(more))
    share = (1.0 - np.logical_or.reduce(stuck, axis=-1)) / np.maximum.reduce(
        use, axis=-1, initial=1.0
    )
    return state._replace(
        joint_step=dq + share[..., None] * more, left=state.left * (1.0 - share), free=free
    )


def step_with_posture(
    inverse: FloatArray,
    jacobian: FloatArray,
    feature_step: FloatArray,
    away: FloatArray,
    share: float,
) -> FloatArray:
    """Return J⁺ v + κ (I − J⁺J)(q_c − q), (..., n), rad.

    Args:
        inverse: J⁺, damped or not, (..., n, m), rad/m.
        jacobian: J, (..., m, n), m/rad.
        feature_step: v, (..., m), m.
        away: q_c − q, from the present joint position to the wanted posture, (..., n), rad.
        share: κ, of that distance; 0 for no posture.
    """
    return np.matvec(inverse, feature_step - share * np.matvec(jacobian, away)) + share * away


class Pace(NamedTuple):
    """How fast the arm may go, by calming."""

    bound: FloatArray  # (...), share of the joints' speed limits; above 1 it is none yet
    command: FloatArray  # the last one, (..., n), rad/s


@final
class Finish:
    """Applies those of the stages above whose aids are on; calming alone has a state."""

    def __init__(
        self, aids: AidsConfig, knowledge: RobotKnowledge, law: str, owns: Collection[str]
    ) -> None:
        """Take settings, limits and the working region.

        Args:
            aids: the settings.
            knowledge: of the robot.
            law: name of the law, for error messages.
            owns: the stages that it brings.

        Raises:
            ValueError: a stage that the law brings itself, or a feedforward without a preview.
        """
        asked = (
            ("preview", "feedforward", aids.feedforward),
            ("limit", "limit", aids.limit != "scale"),
        )
        for stage, aid, on in asked:
            if on and stage in owns:
                raise ValueError(f"aids.{aid}: {law} brings its own {stage}; leave this aid out")
        if aids.feedforward and knowledge.preview < 1:
            raise ValueError(f"preview must be at least 1 for feedforward, got {knowledge.preview}")
        spec = knowledge.spec
        self._aids, self._period, self._limit = aids, spec.period, spec.joint_velocity_limit
        self._region = knowledge.region or (spec.joint_lower, spec.joint_upper)
        self._centre: FloatArray = (self._region[0] + self._region[1]) / 2.0
        self._share = 1.0 - math.exp(-aids.posture_gain * spec.period) if aids.posture else 0.0
        self._adds = aids.feedforward or aids.posture

    def finish(
        self,
        wanted: FloatArray,
        jacobian: FloatArray,
        joint_position: FloatArray,
        forward: FloatArray,
    ) -> tuple[FloatArray, BoolArray]:
        """Return the joint velocity (..., n), rad/s, that leaves the chain, and whether it was limited, (...).

        Args:
            wanted: by the law, (..., n), rad/s.
            jacobian: Ĵ, (..., m, n).
            joint_position: q̂, (..., n), rad.
            forward: the reference's own step, (..., m), in this period; 0 without feedforward.
        """
        aids = self._aids
        if self._adds:
            inverse = damped_inverse(jacobian, aids.damping)
            step = step_with_posture(
                inverse, jacobian, forward, self._centre - joint_position, self._share
            )
            wanted = wanted + step / self._period
        excess = largest_excess(wanted, self._limit)
        if aids.limit == "clip":
            return np.clip(wanted, -self._limit, self._limit), excess > 1.0
        if aids.limit == "redistribute":
            lower, upper = self._region
            further = (
                np.maximum(joint_position - lower, 0.0),
                np.maximum(upper - joint_position, 0.0),
            )
            step = redistribute(
                wanted * self._period, jacobian, self._limit * self._period, aids.damping, further
            )
            return step / self._period, excess > 1.0
        return wanted / np.maximum(excess, 1.0)[..., None], excess > 1.0

    def start(self, observation: Observation) -> Pace | None:
        """Return the state of calming at the start of a run; None without that aid."""
        if not self._aids.calming:
            return None
        bound = np.full(observation.lead, PATIENCE)[()]
        return Pace(bound, np.zeros_like(observation.joint_position))

    def calm(
        self, pace: Pace, joint_velocity: FloatArray, limited: BoolArray
    ) -> tuple[Pace, FloatArray, BoolArray]:
        """Slow a command down that turned back at its limit in each of the last periods.

        Args:
            pace: the state.
            joint_velocity: within its limits, (..., n), rad/s.
            limited: whether a larger one was wanted, (...).

        Returns:
            The new state, the joint velocity, and whether it is limited now.
        """
        size = largest_excess(joint_velocity, self._limit)
        limited = limited | (size > pace.bound)
        turned = limited & (np.vecdot(joint_velocity, pace.command) < 0.0)
        bound = np.where(turned, SLOWER * pace.bound, FASTER * pace.bound)
        bound = np.minimum(np.maximum(bound, CRAWLING), PATIENCE)
        slowed = joint_velocity * (bound / np.maximum(size, bound))[..., None]
        joint_velocity = np.where((bound < 1.0)[..., None], slowed, joint_velocity)
        return Pace(bound, joint_velocity), joint_velocity, limited
