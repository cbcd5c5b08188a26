"""`pixel`: the ball in the image of one camera, without depth; m = 2, in pixels."""

from __future__ import annotations

from servobench.plant.cameras.eye import Eye, located, pixel_rates, pixels, pixels_per_metre

PIXEL = Eye(
    name="pixel",
    summary="the ball in the image of one camera",
    features=("u", "v"),
    unit="px",
    measure=pixels,
    rates=pixel_rates,
    locate=located,
    scale=pixels_per_metre,
    single=True,
)
