"""Settings of the offline training: region, sizes of the networks, samples and the grids of the held-out choice."""

from typing import Annotated, Literal, TypeAlias

from annotated_types import Ge, Len, Lt

from servobench.controllers.networks.rbf import STEP, Kernel
from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.dependence import Only
from servobench.plant.contract.settings import (
    Count,
    NonNegative,
    Number,
    Periods,
    Positive,
    nested,
    settings,
)

Grid: TypeAlias = Annotated[tuple[Positive, ...], Len(1)]
Samples: TypeAlias = Annotated[int, Ge(10)]


@settings
class JacobianTraining:
    """How the Jacobian network is fitted."""

    centres: Count = 150
    """[1] L, units per joint column."""
    samples: Samples = 4000
    """[1] joint positions, held-out ones included."""
    width_scales: Grid = (0.7, 1.0, 1.5)
    """[1] δ over half the region's diagonal; the best is chosen."""
    regularisations: Grid = (1e-10, 1e-8, 1e-6)
    """[1] of the ridge, over the largest eigenvalue; the best is chosen."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if self.samples < self.centres:
            raise ValueError(
                f"samples must be at least the {self.centres} centres, got {self.samples}"
            )


@settings
class ControllerTraining:
    """Structure of the controller network and how it is fitted."""

    error_history: Count = 1
    """[1] L_e, errors in ξ."""
    position_history: Count = 1
    """[1] L_c, joint positions in ξ."""
    hidden: Annotated[int, Ge(2)] = 60
    """[1] N_h, units."""
    kernel: Kernel = "exponential"
    """Of eq. 16; "gaussian" squares the norm."""
    step: Positive = STEP
    """[s] s, step of the network's commands at any control period."""
    gain: Positive = 3.0
    """[1/s] K_p of the imitated law."""
    damping: NonNegative = 0.0
    """[m/rad] δ of its inverse; 0: directions below a tenth of the strongest are dropped."""
    posture_gain: Annotated[NonNegative, Only(fit="output")] = 0.5
    """[1/s] K_n of null-space centring; 0 as in the paper."""
    fit: Literal["output", "entries"] = "output"
    """Target of the fit: ψ ξ, or the entries of ψ as in the paper."""
    error_range: Positive = 0.5
    """[m] largest error per axis."""
    samples: Samples = 6000
    """[1] held-out ones included."""
    width_scales: Grid = (2.0, 4.0, 8.0)
    """[1] reach of a unit over the spread of ξ; the best is chosen."""
    regularisations: Grid = (1e-12, 1e-10, 1e-8)
    """[1] of the ridge, over the largest eigenvalue; the best is chosen."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if self.samples < self.hidden:
            raise ValueError(
                f"samples must be at least the {self.hidden} hidden units, got {self.samples}"
            )


@settings
class TrainingConfig:
    """Settings of both fits; an empty region means the one in which the robot will work."""

    lower: tuple[Number, ...] = ()
    """[rad] lower corner of the region, by joint."""
    upper: tuple[Number, ...] = ()
    """[rad] upper corner of the region, by joint."""
    seed: Periods = 0
    """[1] of the samples."""
    held_out: Annotated[Positive, Lt(1.0)] = 0.2
    """[1] share of samples on which widths and regularisation are chosen."""
    jacobian: JacobianTraining = nested(JacobianTraining)
    """Fit of the Jacobian network."""
    controller: ControllerTraining = nested(ControllerTraining)
    """Fit of the controller network."""

    def __post_init__(self) -> None:
        """Check across fields."""
        if len(self.lower) != len(self.upper):
            raise ValueError(
                f"lower and upper must be equally long, got {len(self.lower)} and {len(self.upper)}"
            )
        if any(low >= high for low, high in zip(self.lower, self.upper, strict=True)):
            raise ValueError(
                f"lower must be below upper for every joint, got {self.lower} and {self.upper}"
            )
        fewest = min(self.jacobian.samples, self.controller.samples)
        if round(fewest * self.held_out) == fewest:
            raise ValueError(
                f"held_out leaves none of {fewest} samples for the fit, got {self.held_out:g}"
            )

    def region(self, n: int) -> tuple[FloatArray, FloatArray]:
        """Return the box, two arrays (n,) [rad].

        Raises:
            ValueError: it is not of n joints.
        """
        if len(self.lower) != n:
            raise ValueError(f"lower and upper must name {n} joints, got {len(self.lower)}")
        return as_array("lower", self.lower, (n,)), as_array("upper", self.upper, (n,))
