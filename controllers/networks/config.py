"""Settings of the offline training: region, sizes of the networks, samples and the grids of the held-out choice."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

from servobench.controllers.networks.rbf import KERNELS, Kernel
from servobench.controllers.networks.samples import PLACEMENTS, Placement
from servobench.plant.checks import FloatArray, as_vector, check_number

Fit = Literal["output", "entries"]
FITS: tuple[str, ...] = get_args(Fit)


@dataclass(frozen=True)
class JacobianTraining:
    """How the Jacobian network is fitted."""

    centres: int = 150  # L, units of each joint column
    samples: int = 4000  # joint positions, held-out ones included
    placement: Placement = "halton"  # of the centres: halton, sobol or kmeans
    width_scales: tuple[float, ...] = (0.7, 1.0, 1.5)  # δ over half the region's diagonal
    regularisations: tuple[float, ...] = (1e-10, 1e-8, 1e-6)  # ridge, over the largest eigenvalue

    def __post_init__(self) -> None:
        """Check the numbers."""
        _check_fit("jacobian", self.centres, self.samples, self.placement, self.width_scales, self.regularisations)


@dataclass(frozen=True)
class ControllerTraining:
    """Structure of the controller network and how it is fitted."""

    error_history: int = 1  # L_e, errors in ξ
    position_history: int = 1  # L_c, joint positions in ξ
    hidden: int = 60  # N_h, units
    kernel: Kernel = "exponential"  # of eq. 16; "gaussian" squares the norm
    gain: float = 3.0  # K_p of the law that is imitated, 1/s
    posture_gain: float = 0.5  # K_n, 1/s, towards the region's middle in the null space; 0 as in the paper
    fit: Fit = "output"  # of the product ψ ξ, or "entries" of ψ as the paper reads
    error_range: float = 0.5  # m, largest error an axis
    samples: int = 6000  # held-out ones included
    placement: Placement = "halton"  # of the centres: halton, sobol or kmeans
    width_scales: tuple[float, ...] = (2.0, 4.0, 8.0)  # reach of a unit over the spread of ξ
    regularisations: tuple[float, ...] = (1e-12, 1e-10, 1e-8)  # ridge, over the largest eigenvalue

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("error_history", self.error_history, at_least=1)
        check_number("position_history", self.position_history, at_least=1)
        check_number("hidden", self.hidden, at_least=1)
        check_number("gain", self.gain, above=0.0)
        check_number("posture_gain", self.posture_gain, at_least=0.0)
        check_number("error_range", self.error_range, above=0.0)
        _check_word("kernel", self.kernel, KERNELS)
        _check_word("fit", self.fit, FITS)
        _check_fit("controller", self.hidden, self.samples, self.placement, self.width_scales, self.regularisations)


@dataclass(frozen=True)
class TrainingConfig:
    """Settings of both fits; an empty region means the one in which the robot will work."""

    lower: tuple[float, ...] = ()  # rad, one a joint
    upper: tuple[float, ...] = ()  # rad, one a joint
    seed: int = 0  # of the samples; independent of any run
    held_out: float = 0.2  # share of the samples on which widths and regularisation are chosen
    jacobian: JacobianTraining = field(default_factory=JacobianTraining)
    controller: ControllerTraining = field(default_factory=ControllerTraining)

    def __post_init__(self) -> None:
        """Check the numbers."""
        check_number("seed", self.seed, at_least=0)
        check_number("held_out", self.held_out, above=0.0, below=1.0)
        if len(self.lower) != len(self.upper):
            raise ValueError(f"lower and upper must be equally long, got {len(self.lower)} and {len(self.upper)}")
        as_vector("lower", self.lower, len(self.lower))
        as_vector("upper", self.upper, len(self.upper))
        if any(low >= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(f"lower must be below upper for every joint, got {self.lower} and {self.upper}")

    def region(self, n: int) -> tuple[FloatArray, FloatArray]:
        """Return the box, two arrays (n,), rad.

        Raises:
            ValueError: it is not of n joints.
        """
        if len(self.lower) != n:
            raise ValueError(f"lower and upper must name {n} joints, got {len(self.lower)}")
        return as_vector("lower", self.lower, n), as_vector("upper", self.upper, n)


def _check_fit(
    name: str,
    centres: int,
    samples: int,
    placement: str,
    width_scales: tuple[float, ...],
    regularisations: tuple[float, ...],
) -> None:
    check_number(f"{name}.centres", centres, at_least=1)
    check_number(f"{name}.samples", samples, at_least=max(centres, 10))
    _check_word(f"{name}.placement", placement, PLACEMENTS)
    for word, grid in (("width_scales", width_scales), ("regularisations", regularisations)):
        if not grid:
            raise ValueError(f"{name}.{word} must hold at least one number")
        for value in grid:
            check_number(f"{name}.{word}", value, above=0.0)


def _check_word(name: str, value: str, known: tuple[str, ...]) -> None:
    if value not in known:
        raise ValueError(f"{name} must be one of {', '.join(known)}, got {value!r}")
