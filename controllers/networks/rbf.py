"""The two radial-basis-function networks of the proposed method, as pure functions and frozen records.

Jacobian network (eqs. 28–30, 40, 41), one network for each joint column i:

    Ĵ_i(q) = W_i θ_i(q),   θ_il = exp(−(‖q − c_il‖ / δ_il)²)

Controller network (eqs. 11–17), one weight matrix for each column ψ_j, all on the same hidden layer:

    q_cmd = ψ ξ,   ψ_j = W_j h(ξ),   h_l = exp(−‖ξ − c_l‖ / γ_l²)

Eq. 16 does not square the norm; that is the default here ("exponential") and the Gaussian is an option. Departure from
the paper: exponents are cut at 60, so that a unit far away is 1e-26 instead of an underflow.
"""

from dataclasses import dataclass
from functools import cached_property
from typing import Literal, get_args

import numpy as np

from servobench.plant.contract.checks import FloatArray, IntArray, Shape

Kernel = Literal["exponential", "gaussian"]
KERNELS: tuple[str, ...] = get_args(Kernel)
STEP = 0.05  # [s] default step of a controller network
MAX_EXPONENT = 60.0
MIN_EXPONENT = np.array(-MAX_EXPONENT)


def hidden_features(
    xi: FloatArray, centres: FloatArray, widths: FloatArray, kernel: Kernel
) -> FloatArray:
    """Return the hidden layer h of the controller network (eq. 16), or θ_i of a joint column (eqs. 29, 40).

    Args:
        xi: ξ, (..., p), m and rad; for a joint column q, (..., n), rad, and the kernel "gaussian".
        centres: c, (N_h, p).
        widths: γ, (N_h,); for "exponential" γ² has the unit of ξ, for "gaussian" γ has it.
        kernel: "exponential" for exp(−‖ξ − c‖/γ²), "gaussian" for exp(−‖ξ − c‖²/γ²).

    Returns:
        h, (..., N_h).
    """
    offset = xi[..., None, :] - centres
    square = np.einsum("...p,...p->...", offset, offset)
    distance = square if kernel == "gaussian" else np.sqrt(square)
    exponent = distance / widths**2
    return np.exp(-np.minimum(exponent, MAX_EXPONENT))


def _layer(
    x: FloatArray, kernel: Kernel, centres: FloatArray, ones: FloatArray, decay: FloatArray
) -> FloatArray:
    """Return a hidden layer, (..., L), at x, (..., p), for centres (p, L), ones (p,) and the negative decay (L,)."""
    offset = x[..., :, None] - centres
    offset *= offset
    square: FloatArray = np.vecmat(ones, offset)
    if kernel != "gaussian":
        np.sqrt(square, out=square)
    exponent = square * decay
    np.maximum(exponent, MIN_EXPONENT, out=exponent)
    return np.exp(exponent, out=exponent)


def controller_output(weights: FloatArray, xi: FloatArray, h: FloatArray) -> FloatArray:
    """Return q_cmd = ψ ξ with ψ_j = W_j h (eqs. 12, 17).

    Args:
        weights: W, (..., n, p, N_h), rad per unit of ξ.
        xi: ξ, (..., p).
        h: (..., N_h).

    Returns:
        (..., n), rad.
    """
    *lead, n, p, hidden = weights.shape
    psi = np.matvec(weights.reshape(*lead, n * p, hidden), h)
    return np.matvec(psi.reshape(*psi.shape[:-1], n, p), xi)


def information_vector(errors: FloatArray, positions: FloatArray) -> FloatArray:
    """Return ξ = [e(k) … e(k−L_e+1), q(k−1) … q(k−L_c)] (eq. 11).

    Args:
        errors: (..., L_e, m), m, the newest first.
        positions: (..., L_c, n), rad, the newest first.

    Returns:
        (..., m L_e + n L_c).
    """
    lead = errors.shape[:-2]
    return np.concatenate([errors.reshape(*lead, -1), positions.reshape(*lead, -1)], axis=-1)


@dataclass(frozen=True, eq=False)
class JacobianNetwork:
    """n Gaussian networks, one for each joint column of the Jacobian."""

    centres: FloatArray  # c, (n, L, n), rad; `centres[i, l]` is a joint position at which unit l of column i is 1
    widths: FloatArray  # δ, (n, L), rad, positive
    weights: (
        FloatArray  # W, (n, m, L), m/rad; `weights[i]` maps the units of column i to the column
    )

    def __post_init__(self) -> None:
        """Check that the three arrays fit together and freeze them."""
        solid = self.centres.ndim == 3 and self.weights.ndim == 3
        if not solid or 0 in self.centres.shape + self.weights.shape:
            raise ValueError(
                "centres and weights must be (n, L, n) and (n, m, L) with all sizes at least 1, "
                f"got {self.centres.shape} and {self.weights.shape}"
            )
        n, units = self.centres.shape[:2]
        _freeze(self, centres=(n, units, n), widths=(n, units), weights=(n, self.m, units))

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.weights.shape[0])

    @property
    def m(self) -> int:
        """Number of features."""
        return int(self.weights.shape[1])

    @property
    def layers(self) -> tuple[int, int]:
        """Number of different hidden layers, U, and of units in each, L."""
        return self._members.shape[0], self.weights.shape[-1]

    @cached_property
    def layer_of(self) -> IntArray:
        """Index of the hidden layer of each column, (n,): columns of equal centres and widths share one."""
        layers: dict[bytes, int] = {}
        indices = []
        for centres, widths in zip(self.centres, self.widths, strict=True):
            layer = centres.tobytes() + widths.tobytes()
            indices.append(layers.setdefault(layer, len(layers)))
        return np.array(indices)

    @cached_property
    def rows(self) -> FloatArray:
        """W by rows of the Jacobian, (m, n, L), m/rad: the layout of weights that learn online; read-only."""
        rows = np.ascontiguousarray(self.weights.swapaxes(0, 1))
        rows.flags.writeable = False
        return rows

    def features(self, q: FloatArray) -> FloatArray:
        """Return the U different layers θ of all columns, (..., U, L), at q, (..., n), rad."""
        return _layer(q[..., None, :], "gaussian", *self._prepared)

    def output(self, rows: FloatArray, theta: FloatArray) -> FloatArray:
        """Return Ĵ_i = W_i θ_i (eqs. 30, 41) at T joint positions, (..., T, m, n), m/rad.

        Args:
            rows: W by rows of the Jacobian, (..., m, n, L), m/rad.
            theta: from `features`, (..., T, U, L).
        """
        *lead, count, layers, units = theta.shape
        # One product of all layers with all columns is faster than one for each column, although most are not wanted.
        flat = theta.reshape(*lead, count * layers, units)
        columns = rows.reshape(*rows.shape[:-3], -1, units)
        every = flat @ columns.mT
        return every.reshape(*lead, count, -1).take(self._places, axis=-1)

    def gradient(
        self, errors: FloatArray, joint_steps: FloatArray, theta: FloatArray
    ) -> FloatArray:
        """Return Σ_t e_t Δq_{i,t} θ_i(q_t)ᵀ by rows of the Jacobian, (..., m, n, L): −½ ∂/∂W Σ_t ‖e_t‖² (eqs. 31, 32).

        Args:
            errors: e_t = Δy_t − Ĵ(q_t) Δq_t, (..., T, m), m.
            joint_steps: Δq_t, (..., T, n), rad.
            theta: θ(q_t) from `features`, (..., T, U, L).
        """
        *lead, count, layers, units = theta.shape
        # Δq_{i,t} in the layer of joint column i, and 0 in all others.
        steps = joint_steps[..., None, :] * self._members
        factors = errors[..., None, :, None] * steps[..., None, :]
        flat = theta.reshape(*lead, count * layers, units)
        gradient = factors.reshape(*lead, count * layers, -1).mT @ flat
        return gradient.reshape(*lead, self.m, self.n, units)

    def jacobian(self, q: FloatArray, rows: FloatArray | None = None) -> FloatArray:
        """Return Ĵ, (..., m, n), m/rad, at joint positions (..., n), rad, with the trained weights or with others."""
        theta = self.features(q)[..., None, :, :]
        return self.output(self.rows if rows is None else rows, theta)[..., 0, :, :]

    @cached_property
    def _prepared(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Centres of the layers, (U, n, L), or (1, n, L) where all share them; ones, (n,); and −1/δ², (U, L)."""
        _, first = np.unique(self.layer_of, return_index=True)
        centres = self.centres[first].mT
        if (centres == centres[0]).all():
            centres = centres[:1]
        decay = -1.0 / self.widths[first] ** 2
        return np.ascontiguousarray(centres), np.ones(self.n), decay

    @cached_property
    def _members(self) -> FloatArray:
        """1 where a column has a layer, else 0, (U, n)."""
        return np.asarray(self.layer_of == np.unique(self.layer_of)[:, None], dtype=np.float64)

    @cached_property
    def _places(self) -> IntArray:
        """Where the entries of Ĵ are among the products of all U layers with all columns, (m, n)."""
        entries = np.arange(self.m * self.n).reshape(self.m, self.n)
        return self.layer_of * self.m * self.n + entries


@dataclass(frozen=True, eq=False)
class ControllerNetwork:
    """p = m L_e + n L_c networks on one hidden layer, one for each column of the controller matrix ψ."""

    centres: FloatArray  # c, (N_h, p), m and rad, points in the space of ξ
    widths: FloatArray  # γ, (N_h,), positive
    weights: FloatArray  # W, (n, p, N_h); `weights[:, j]` maps the hidden layer to the column ψ_j
    error_history: int  # L_e, how many errors ξ holds
    position_history: int  # L_c, how many joint positions ξ holds
    kernel: Kernel = "exponential"  # kernel of the hidden layer, see `hidden_features`
    step: float = STEP  # [s] between the instants of ξ, and from q to the position ψ ξ
    offset_free: bool = False  # whether `origin` is the trained network's own command at rest

    def __post_init__(self) -> None:
        """Check that arrays and sizes fit together and freeze the arrays."""
        if self.kernel not in KERNELS:
            raise ValueError(f"kernel must be one of {', '.join(KERNELS)}, got {self.kernel!r}")
        if not 0.0 < self.step < np.inf:
            raise ValueError(f"step must be positive, got {self.step}")
        if self.weights.ndim != 3 or 0 in self.weights.shape:
            raise ValueError(
                f"weights must be (n, p, N_h) with all sizes at least 1, got {self.weights.shape}"
            )
        n, p, hidden = self.weights.shape
        _freeze(self, centres=(hidden, p), widths=(hidden,), weights=(n, p, hidden))
        lengths = (self.error_history, self.position_history)
        left = p - n * self.position_history
        if min(lengths) < 1 or left < 1 or left % self.error_history:
            raise ValueError(
                f"weights must have m L_e + n L_c columns with L_e = {self.error_history}, n = {n} and "
                f"L_c = {self.position_history}, got {p}"
            )

    @property
    def n(self) -> int:
        """Number of joints."""
        return int(self.weights.shape[0])

    @property
    def m(self) -> int:
        """Number of features."""
        return int(self.weights.shape[1] - self.n * self.position_history) // self.error_history

    def features(self, xi: FloatArray) -> FloatArray:
        """Return h, (..., N_h), at ξ (..., p), as `hidden_features` does, in less time; last bits may differ."""
        return _layer(xi, self.kernel, *self._prepared)

    def command(self, xi: FloatArray) -> FloatArray:
        """Return q_cmd = ψ(ξ) ξ, (..., n), rad, with the weights as they were trained."""
        return controller_output(self.weights, xi, self.features(xi))

    def origin(self, xi: FloatArray) -> FloatArray:
        """Return from where the joints step to ψ ξ, (..., n), rad: q(k−1), or the trained command without errors."""
        newest = self.m * self.error_history
        if not self.offset_free:
            return xi[..., newest : newest + self.n]
        is_position = np.arange(xi.shape[-1]) >= newest
        return self.command(xi * is_position)

    @cached_property
    def _prepared(self) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Centres, (p, N_h), ones, (p,), and −1/γ², (N_h,)."""
        centres = np.ascontiguousarray(self.centres.T)
        return centres, np.ones(len(centres)), -1.0 / self.widths**2


def _freeze(network: JacobianNetwork | ControllerNetwork, **shapes: Shape) -> None:
    """Check shapes and values of the arrays of a network and make them read-only."""
    for name, wanted in shapes.items():
        array = np.array(getattr(network, name), dtype=np.float64)
        if array.shape != wanted:
            raise ValueError(f"{name} must have shape {wanted}, got {array.shape}")
        if not np.isfinite(array).all():
            raise ValueError(f"{name} of a network must be finite")
        array.flags.writeable = False
        object.__setattr__(network, name, array)
    if not (network.widths > 0.0).all():
        raise ValueError(f"widths must be positive, the smallest is {network.widths.min()}")
