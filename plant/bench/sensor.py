"""The random side of a sensor in a run: noise, outliers, quantisation, occlusion, lost frames and late ones.

    y = round_Δ(h(q) + σ·family + outlier)        the features of a frame, round_Δ to multiples of the quantum
    hidden(t) or lost                             a frame that arrives without the feature, or not at all
    latency + A (1 + sin(2π t/P)) + U(0, jitter)  between exposure and delivery; frames do not overtake each other
    t + offset + drift t                          the stamp of a frame exposed at t, by the camera's clock

Each part draws from a random stream of its own, frame by frame, so that switching one on changes no other.

A spell is a stretch of frames in which something is wrong with the sensor, such as an outlier or an occlusion. In a
frame outside of a spell, a spell begins with probability p and lasts d frames:

    share of the frames in spells  π = p d / (p d + 1 − p),   so p = π / (π + d (1 − π))

For d = 1 the frames are independent and p = π. A signal that is drawn anew for each spell, with mean 0 and variance s²,
and is 0 outside, has the autocovariance s² π (d − h)/d at a lag of h < d frames and 0 beyond.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial
from typing import NamedTuple

import numpy as np

from servobench.plant.contract.checks import FloatArray, IntArray, Shape
from servobench.plant.contract.lanes import take, where
from servobench.plant.contract.seeds import Seeds, Stream
from servobench.plant.contract.sensing import (
    Extents,
    SensingConfig,
    draw_directions,
    family_of,
    quantise,
)
from servobench.plant.contract.signals import BoolArray

TIME_TOLERANCE = 1e-9  # [s] within which two times are equal


class Sensor:
    """The random disturbances of a sensor over a run, or over runs side by side; it can be copied and pickled.

    Attributes:
        jitters: whether frames are late by different times.
    """

    def __init__(
        self,
        config: SensingConfig,
        extents: Extents,
        m: int,
        interval: float,
        seed: Seeds,
        lead: Shape,
    ) -> None:
        """Begin all streams.

        Args:
            config: the settings.
            extents: the lengths among them, in multiples of the world's unit of noise.
            m: number of features.
            interval: between two frames, s.
            seed: one, or one for each of the runs side by side.
            lead: shape of the leading axis, () for a single run.

        Raises:
            ValueError: a negative seed.
        """
        self._config = config
        self.jitters = config.jitter > 0.0 or config.latency_swing > 0.0
        self._quantum = extents.quantum
        self._scale = config.noise_factor * extents.feature_noise
        stream: Callable[..., Stream] = partial(Stream, seed)
        self._shape = np.array(config.noise_shape)
        if config.noise_shape and self._shape.shape != (m, m):
            raise ValueError(
                f"sensing.noise_shape needs {m} rows of {m} numbers, got {list(config.noise_shape)}"
            )
        self._noise = stream("feature_noise", family_of(config, extents), (m,), self._scale)
        share = np.random.Generator.random
        self._losses = stream("dropped_frames", share)
        self._lateness = stream("late_frames", share)
        self._outlier_begins = stream("outliers", share)
        self._occlusion_begins = stream("occlusions", share)
        self._outlier_values = stream("outlier_values", draw_directions, (m,), extents.outlier_size)
        self._outlier_frames = max(1, round(config.outlier_duration / interval))
        self._occlusion_frames = max(1, round(config.occlusion_duration / interval))
        self._outlier = Spell.none(lead, np.zeros((*lead, m)))
        self._occlusion = Spell.none(lead, np.zeros(lead)[()])
        # Number of the sub-step after which the last frame is delivered.
        self._due: FloatArray = np.zeros(lead)[()]
        self._no_stamp: FloatArray = np.full(lead, np.nan)[()]

    def measured(self, feature: FloatArray) -> FloatArray:
        """Return a true feature, (..., m), as the next frame shows it."""
        config = self._config
        if self._scale > 0.0:
            noise = self._noise.next()
            if self._shape.size:
                noise = np.matvec(self._shape, noise)
            feature = feature + noise
        if config.outliers > 0.0:
            probability = begin_probability(config.outliers, self._outlier_frames)
            begins = self._outlier_begins.next() < probability
            value = self._outlier_values.next()
            self._outlier = self._outlier.next(begins, self._outlier_frames, value)
            feature = where(self._outlier.inside, feature + self._outlier.value, feature)
        if self._quantum > 0.0:
            feature = quantise(feature, self._quantum)
        return feature

    def missing(self, time: float) -> BoolArray | None:
        """Return in which lanes the frame exposed at `time` [s] arrives without the feature, (...); None for none."""
        config = self._config
        absent = None
        if config.drop_probability > 0.0:
            absent = self._losses.next() < config.drop_probability
        if config.occlusions > 0.0:
            probability = begin_probability(config.occlusions, self._occlusion_frames)
            begins = self._occlusion_begins.next() < probability
            value = self._occlusion.value
            self._occlusion = self._occlusion.next(begins, self._occlusion_frames, value)
            hidden = self._occlusion.inside
            absent = hidden if absent is None else np.logical_or(absent, hidden)
        if any(begin <= time + TIME_TOLERANCE < end for begin, end in config.occlusion_windows):
            absent = np.ones_like(self._occlusion.inside)[()]
        if absent is None or not absent.any():
            return None
        return absent

    def stamp(self, time: float) -> FloatArray:
        """Return what the camera's clock shows at `time` [s], (...) [s]; NaN without stamps."""
        config = self._config
        if not config.stamps:
            return self._no_stamp
        shown = time + config.clock_offset + config.clock_drift * time
        stamp = np.full_like(self._no_stamp, shown)
        stamp.setflags(write=False)
        return stamp[()]

    def due(self, step: int, latency: int, size: float) -> FloatArray:
        """Return the sub-step after which a frame is delivered, (...), a fraction.

        Args:
            step: number of the sub-step after which it is exposed.
            latency: without swing and jitter, sub-steps.
            size: of a sub-step, s.
        """
        config = self._config
        phase = 2.0 * math.pi * step * size / config.swing_period
        swing = config.latency_swing / size * (1.0 + math.sin(phase))
        jitter = config.jitter / size * self._lateness.next()
        due = step + latency + swing + jitter
        # Frames do not overtake each other.
        self._due = np.maximum(self._due, due)
        return self._due

    def keep(self, lanes: IntArray) -> None:
        """Drop all other lanes."""
        for part in vars(self).values():
            if isinstance(part, Stream):
                part.keep(lanes)
        self._outlier = take(self._outlier, lanes)
        self._occlusion = take(self._occlusion, lanes)
        self._due = take(self._due, lanes)
        self._no_stamp = take(self._no_stamp, lanes)


def begin_probability(share: float, frames: int) -> float:
    """Return p, the probability that a spell begins in a frame outside of one.

    Args:
        share: π, of the frames that are in spells, below 1.
        frames: d, length of a spell.
    """
    return share / (share + frames * (1.0 - share))


class Spell(NamedTuple):
    """The state of the spells of each lane."""

    left: IntArray  # (...), frames of the present spell that are left after this one
    inside: BoolArray  # (...), whether the present frame is in a spell
    value: FloatArray  # (..., *), drawn for the present spell, or for the last one

    @classmethod
    def none(cls, lead: Shape, value: FloatArray) -> Spell:
        """Return the state before the first frame, outside of any spell."""
        left = np.zeros(lead, dtype=np.int_)[()]
        inside = np.zeros(lead, dtype=np.bool_)[()]
        return cls(left, inside, value)

    def next(self, begins: BoolArray, frames: int, value: FloatArray) -> Spell:
        """Return the state at the next frame.

        Args:
            begins: (...), whether a spell begins in lanes that are outside of one.
            frames: length of a spell.
            value: (..., *), of a spell that begins.
        """
        goes_on = self.left > 0
        new = np.logical_and(begins, np.logical_not(goes_on))
        left = np.where(new, frames - 1, np.maximum(self.left - 1, 0))[()]
        inside = np.logical_or(goes_on, new)
        return Spell(left, inside, where(new, value, self.value))
