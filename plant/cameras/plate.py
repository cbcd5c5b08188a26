"""`plate`: four discs on a plate in the image of one camera; m = 8, in pixels, for six degrees of freedom."""

from __future__ import annotations

from typing import Final

from servobench.plant.cameras.eye import Eye, located, pixel_rates, pixels, pixels_per_metre
from servobench.plant.contract.signals import SETTLING_BAND

HALF: Final = 0.12  # [m] half side of the square at whose corners the discs are

PLATE = Eye(
    name="plate",
    summary="four discs on a plate, for position and orientation",
    features=("u1", "v1", "u2", "v2", "u3", "v3", "u4", "v4"),
    unit="px",
    measure=pixels,
    rates=pixel_rates,
    locate=located,
    scale=pixels_per_metre,
    tolerance=2.0 * SETTLING_BAND,  # four discs see a motion of the plate, as long as it does not turn
    target=((-HALF, -HALF, 0.0), (HALF, -HALF, 0.0), (HALF, HALF, 0.0), (-HALF, HALF, 0.0)),
    single=True,
    closeness=0.5,  # a plate that is small in the image tells little about its orientation
    least_joints=6,
    judges_pose=True,
)
