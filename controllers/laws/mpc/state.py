"""The state of the predictive law."""

from __future__ import annotations

from typing import NamedTuple

from servobench.plant.contract.checks import FloatArray


class Plan(NamedTuple):
    """The moves of the last command and how they were found.

    Attributes:
        moves: dq_1 … dq_H, or the one constant step, (..., moves, n), rad.
        success: (...), 1 where they are the optimum, 0 where the fallback was sent; NaN before the first command.
        iterations: (...), of the solver; 0 without an active limit.
        active_limits: (...), NaN without a solution.
    """

    moves: FloatArray
    success: FloatArray
    iterations: FloatArray
    active_limits: FloatArray


class MpcState(NamedTuple):
    """The state of the predictive law.

    Attributes:
        sent: (..., D, n), rad, the steps sent in the last `delay` seconds, the newest one last.
        last: (..., n), rad, the last step sent.
        fallbacks: (...), commands without a solution so far.
        J: (..., m, n), m/rad, of the last command, for the diagnostics; NaN before, as the next two.
        targets: (..., moves, m), of the last command.
        final: (..., m), m, error at the end of the horizon if the arm stood still.
        plan: of the last command.
    """

    sent: FloatArray
    last: FloatArray
    fallbacks: FloatArray
    J: FloatArray
    targets: FloatArray
    final: FloatArray
    plan: Plan
