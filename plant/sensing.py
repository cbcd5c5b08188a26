"""What lies between a measured feature and the observation: latency, lost frames, and the feature that is held."""

from __future__ import annotations

from collections import deque
from dataclasses import replace
from typing import Any, TypeVar

import numpy as np

from servobench.plant.checks import FloatArray, check_number

Config = TypeVar("Config")


def vary_sensing(
    config: Config, noise_factor: float, latency_periods: int | None, noise: str = "feature_noise"
) -> Config:
    """Return a plant's configuration with other noise and latency; see `PlantEntry.sense`.

    Args:
        config: frozen dataclass with the fields `latency_periods` and `noise`.
        noise_factor: on the noise.
        latency_periods: None leaves it as it is.
        noise: name of the field that the noise is in proportion to.
    """
    values: Any = config
    latency = values.latency_periods if latency_periods is None else latency_periods
    changed: Config = replace(values, latency_periods=latency, **{noise: noise_factor * getattr(values, noise)})
    return changed


class FeatureChannel:
    """Delays features by whole periods, loses frames at random and holds the last valid feature.

    A frame that was lost, or in which the feature was not found, comes out as "not valid" after the same latency.
    """

    def __init__(self, latency_periods: int, drop_probability: float) -> None:
        """Prepare a channel.

        Args:
            latency_periods: whole control periods between exposure and delivery.
            drop_probability: chance that a frame is lost, each on its own.

        Raises:
            ValueError: a negative latency, or a probability outside [0, 1).
        """
        check_number("latency_periods", latency_periods, at_least=0)
        check_number("drop_probability", drop_probability, at_least=0.0, below=1.0)
        self._latency = latency_periods
        self._drop_probability = drop_probability
        self._pending: deque[FloatArray | None] = deque()
        self._held = np.zeros(0)
        self._generator = np.random.default_rng(0)

    def reset(self, first: FloatArray, generator: np.random.Generator) -> None:
        """Start with the feature `first` (m,) seen at rest; later losses are drawn from `generator`."""
        self._generator = generator
        self._held = first
        self._pending = deque([first] * self._latency)

    def deliver(self, measured: FloatArray | None) -> tuple[FloatArray, bool]:
        """Pass the frame of this instant in and the newest delivered feature out.

        Args:
            measured: (m,), or None where the feature was not found.

        Returns:
            The feature, (m,), and whether it is valid (else it is the last valid one).
        """
        lost = self._drop_probability > 0.0 and self._generator.random() < self._drop_probability
        self._pending.append(None if lost else measured)
        delivered = self._pending.popleft()
        if delivered is None:
            return self._held, False
        self._held = delivered
        return delivered, True
