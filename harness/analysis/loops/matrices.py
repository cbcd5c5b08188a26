"""Discrete linear systems as plain matrices: x₊ = A x + B u, y = C x + D u, every array float64."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
import numpy.typing as npt

from servobench.plant.contract.checks import FloatArray

ComplexArray = npt.NDArray[np.complex128]
STABILITY_TOLERANCE = 1e-4  # [1] of a pole's modulus above 1, which neutral modes have by rounding of differences


class StateSpace(NamedTuple):
    """A discrete linear system.

    Attributes:
        A: (s, s).
        B: (s, inputs).
        C: (outputs, s).
        D: (outputs, inputs).
    """

    A: FloatArray
    B: FloatArray
    C: FloatArray
    D: FloatArray

    def response(self, z: ComplexArray) -> ComplexArray:
        """Return C (zI − A)⁻¹ B + D, (k, outputs, inputs), at the points z, (k,), of the complex plane."""
        resolvent = z[:, None, None] * np.eye(len(self.A)) - self.A
        return np.asarray(self.C @ np.linalg.solve(resolvent, self.B.astype(np.complex128)) + self.D)

    def as_control(self, period: float) -> Any:  # noqa: ANN401 - python-control has no types
        """Return the system as a `control.StateSpace` with the sampling period [s]."""
        import control  # noqa: PLC0415 - costs a second, so it is imported where it is used

        return control.ss(*self, period)


def closed_loop(plant: StateSpace, controller: StateSpace, gain: float = 1.0) -> StateSpace:
    """Return the loop of a strictly proper plant with a controller whose command is multiplied by `gain`.

    Args:
        plant: from the command u to what the controller measures, D = 0.
        controller: from measurements and then references to u.
        gain: factor on u between controller and plant.

    Returns:
        From the references to what the controller measures; the states are those of the plant, then the controller's.
    """
    seen = len(plant.C)
    B, D = controller.B, controller.D
    by_plant, by_law = D[:, :seen] @ plant.C, controller.C
    A = np.block(
        [
            [plant.A + gain * plant.B @ by_plant, gain * plant.B @ by_law],
            [B[:, :seen] @ plant.C, controller.A],
        ]
    )
    references = np.vstack([gain * plant.B @ D[:, seen:], B[:, seen:]])
    C = np.hstack([plant.C, np.zeros((seen, len(controller.A)))])
    return StateSpace(A, references, C, np.zeros((seen, references.shape[1])))


def decay(A: FloatArray) -> float:
    """Return the spectral radius of A, the factor of the slowest or the growing mode in a period; 0 without states."""
    return float(np.abs(np.linalg.eigvals(A)).max(initial=0.0))


def is_stable(A: FloatArray) -> bool:
    """Return whether no mode grows; neutral ones, such as a rest of the arm in any null-space posture, may be there."""
    return decay(A) <= 1.0 + STABILITY_TOLERANCE
