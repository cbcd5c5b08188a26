"""Central differences of a composed controller around an equilibrium, and the part of its state that they reach.

The state of a `Servo` is a tree of arrays. Its numbers are put in one vector x, so that a step is

    x₊ = f(x, w),   u = g(x, w),      w = (measured feature, measured joint positions, reference)

Only the subspace of x is kept that w reaches and u shows (Kalman's decomposition): shift registers, filters, integrals.
It is found by block Krylov steps with differences along directions, so that the thousands of weights of a network cost
nothing. Truth values and whole numbers stay as they are.
"""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, final

import numpy as np

from servobench.controllers.controller import JacobianFunction
from servobench.controllers.servo import Servo, ServoState
from servobench.controllers.stages.estimation import Estimation, EstimationState
from servobench.harness.analysis.loops.systems import StateSpace
from servobench.plant.contract.checks import FloatArray
from servobench.plant.contract.lanes import map_arrays
from servobench.plant.contract.signals import Observation, trusted_observation

STEP = 1e-6  # of a difference, in the unit of each number: a micrometre, a microradian
RANK_TOLERANCE = 1e-6  # [1] a direction that is reached less than this counts as not reached

Linear = Callable[[FloatArray], FloatArray]


@final
class FrozenEstimation:
    """Pair and estimate stages that learn nothing more: a Jacobian of the joint positions, and the delay found so far.

    Attributes:
        pairing: the pair stage; None without one.
    """

    def __init__(self, estimation: Estimation, jacobian: JacobianFunction) -> None:
        """Take the stages, of which the pair stage goes on to remember joint positions, and the Jacobian."""
        self.pairing, self._jacobian = estimation.pairing, jacobian
        self.into_model_frame = estimation.into_model_frame  # of the Jacobian that was learned before

    def update(self, state: EstimationState, observation: Observation, desired: FloatArray) -> EstimationState:
        """Return the state at an observation; see `Estimation.update`."""
        del desired
        q, learned = observation.joint_position, state.learned
        if self.pairing is not None:
            learned = learned._replace(pair=self.pairing.advance(learned.pair, q))
        jacobian = np.broadcast_to(self._jacobian(q), state.jacobian.shape)
        return state._replace(learned=learned, jacobian=jacobian)


def frozen(servo: Servo, state: ServoState, jacobian: JacobianFunction) -> tuple[Servo, ServoState]:
    """Return a servo that identifies nothing more, with a given Jacobian, and its state.

    Of the past joint positions only those are kept that the present delay needs.
    """
    other, pairing, estimation = copy.copy(servo), servo.estimation.pairing, state.estimation
    estimation = estimation._replace(learned=estimation.learned._replace(estimator=None))  # it may be large
    other.estimation = FrozenEstimation(servo.estimation, jacobian)  # type: ignore[assignment]
    other.predictor = None if servo.predictor is None else servo.predictor.frozen()
    if pairing is not None:
        pair = estimation.learned.pair
        window = 0 if servo.predictor is None else servo.predictor.window
        rows = max(int(pairing.delay(pair)) + 3, window + 1)
        learned = estimation.learned._replace(pair=pair._replace(past=pair.past[:rows]))
        estimation = estimation._replace(learned=learned)
    return other, state._replace(estimation=estimation)


@dataclass(frozen=True, eq=False)
class Rest:
    """An arm at rest.

    Attributes:
        joint_position: (n,) [rad].
        feature: (m,), the measured and the desired one.
        time: of the next step [s].
        preview: future rows of the reference.
    """

    joint_position: FloatArray
    feature: FloatArray
    time: float
    preview: int

    def observation(self, feature: FloatArray, joint_position: FloatArray, after: float = 0.0) -> Observation:
        """Return the observation of other values, (..., m) and (..., n), `after` [s] later."""
        lead = feature.shape[:-1]
        valid: Any = np.full(lead, True)[()] if lead else np.True_
        return trusted_observation(
            self.time + after, joint_position, feature, valid, np.full(feature.shape, fill_value=True)
        )

    def reference(self, feature: FloatArray) -> FloatArray:
        """Return the constant reference (..., 1 + preview, m) at a desired feature, (..., m)."""
        return np.repeat(feature[..., None, :], 1 + self.preview, axis=-2)


def linearise(servo: Servo, state: ServoState, rest: Rest) -> StateSpace:
    """Return the controller's deviations from a rest: from feature, joint positions and reference to the command.

    Args:
        servo: of a single run.
        state: at the rest, in which a step changes nothing that matters.
        rest: where.

    Returns:
        A system with the inputs (m + n + m,) and the outputs u, (n,) rad/s. All rows of the reference move together.
    """
    packing = Packing(state)
    m, n = len(rest.feature), len(rest.joint_position)

    def stepped(x: FloatArray, w: FloatArray) -> tuple[FloatArray, FloatArray]:
        measured = rest.observation(rest.feature + w[:, :m], rest.joint_position + w[:, m : m + n])
        new, u = servo.step(packing.unpack(x), measured, rest.reference(rest.feature + w[:, m + n :]))
        return packing.pack(new, len(x)), u

    def differences(dx: FloatArray, dw: FloatArray) -> tuple[FloatArray, FloatArray]:
        """Return the derivatives of x₊ and u along directions, a row each."""
        size = len(dx)
        x = packing.centre + STEP * np.vstack([dx, -dx])
        new, u = stepped(x, STEP * np.vstack([dw, -dw]))
        with np.errstate(invalid="ignore"):
            change = np.nan_to_num((new[:size] - new[size:]) / (2.0 * STEP), nan=0.0, posinf=0.0, neginf=0.0)
        return change, (u[:size] - u[size:]) / (2.0 * STEP)

    inputs = np.eye(2 * m + n)
    B, D = differences(np.zeros((len(inputs), len(packing.centre))), inputs)
    shown: list[FloatArray] = []

    def forward(directions: FloatArray) -> FloatArray:
        new, u = differences(directions.T, np.zeros((directions.shape[1], len(inputs))))
        shown.append(u.T)
        return new.T

    basis, images = reached(forward, B.T)
    C = np.hstack([*shown, np.zeros((n, 0))])
    return observed(StateSpace(basis.T @ images, basis.T @ B.T, C, D.T))


def observed(system: StateSpace) -> StateSpace:
    """Return a system without the states that its outputs never show."""
    basis, images = reached(lambda directions: system.A.T @ directions, system.C.T)
    return StateSpace(images.T @ basis, basis.T @ system.B, system.C @ basis, system.D)


def reached(image: Linear, first: FloatArray) -> tuple[FloatArray, FloatArray]:
    """Return an orthonormal basis V, (s, r), of the span of first, A first, A² first, …, and A V.

    Args:
        image: of directions (s, k) under A.
        first: (s, k).
    """
    basis, images = np.zeros((len(first), 0)), np.zeros((len(first), 0))
    candidates, scale = first, max(1.0, float(np.abs(first).max(initial=0.0)))
    while candidates.size:
        for _ in range(2):  # once more for the rounding of the first time
            candidates = candidates - basis @ (basis.T @ candidates)
        tall, small = np.linalg.qr(candidates)
        left, values, _ = np.linalg.svd(small)
        new = (tall @ left)[:, values > RANK_TOLERANCE * scale]
        if new.shape[1] == 0:
            break
        candidates = image(new)
        basis, images = np.hstack([basis, new]), np.hstack([images, candidates])
    return basis, images


class Packing:
    """The numbers of a state as a vector, and back."""

    def __init__(self, state: ServoState) -> None:
        """Take the state of a single run, around which directions are measured."""
        self._state = state
        self.centre = self._numbers(state, 0)[0]

    def unpack(self, x: FloatArray) -> ServoState:
        """Return the states of runs side by side whose numbers are x, (lanes, s)."""
        place = 0

        def filled(array: Any) -> Any:  # noqa: ANN401 - an array of any kind
            nonlocal place
            if not np.issubdtype(array.dtype, np.floating):
                return np.broadcast_to(array, (len(x), *array.shape))
            begin, place = place, place + array.size
            return x[:, begin:place].reshape(len(x), *array.shape)

        full: ServoState = map_arrays(filled, self._state)
        return full

    def pack(self, state: ServoState, lanes: int) -> FloatArray:
        """Return the numbers of runs side by side, (lanes, s)."""
        return self._numbers(state, lanes)

    def _numbers(self, state: ServoState, lanes: int) -> FloatArray:
        parts: list[FloatArray] = []

        def noted(array: Any) -> Any:  # noqa: ANN401 - an array of any kind
            if np.issubdtype(array.dtype, np.floating):
                lead = (lanes, *array.shape[1:]) if lanes else array.shape
                parts.append(np.broadcast_to(array, lead).reshape(max(lanes, 1), -1))
            return array

        map_arrays(noted, state)
        return np.hstack(parts) if parts else np.zeros((max(lanes, 1), 0))
