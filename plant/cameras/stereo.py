"""`stereo`: the ball in the images of two cameras, without depth and without epipolar calibration; m = 4, in pixels."""

from __future__ import annotations

import math

from servobench.plant.cameras.eye import Eye, located, pixel_rates, pixels, pixels_per_metre
from servobench.plant.contract.signals import SETTLING_BAND

STEREO = Eye(
    name="stereo",
    summary="the ball in the images of two cameras",
    features=("u1", "v1", "u2", "v2"),
    unit="px",
    measure=pixels,
    rates=pixel_rates,
    locate=located,
    scale=pixels_per_metre,
    tolerance=math.sqrt(2.0) * SETTLING_BAND,  # both cameras see a motion across both
    cameras=2,
    single=True,
)
