"""The predict stage: the feature that the arm is bound for, past all delays.

    ŷ = z + Ĵ (q(k) − q(k−d) + flight)              where the feature will be when all commands are carried out
    q̂ = q(k) + flight                               and the joints
    compared with the reference at k + lead

z is the feature at its exposure, d periods ago (`feature_filter`); flight and lead follow from the part of the commands
that is still to come (`joint_response`).
"""

from __future__ import annotations

from dataclasses import KW_ONLY, dataclass
from typing import final

import numpy as np

from servobench.controllers.estimate import MAX_DELAY, Estimate
from servobench.controllers.laws.feature_filter import FeatureFilter
from servobench.controllers.laws.joint_response import JointResponse
from servobench.controllers.noise_level import NoiseLevel
from servobench.plant.checks import FloatArray
from servobench.plant.signals import Observation


@dataclass(frozen=True, eq=False, slots=True)
class Prediction:
    """What the predict stage hands to a law.

    Attributes:
        feature: ŷ, (m,), m.
        joint_position: q̂, (n,), rad.
        lead: [periods] by which the reference is to be shifted, a fraction.
    """

    feature: FloatArray
    joint_position: FloatArray
    lead: float


@final
@dataclass(eq=False)
class Predictor:
    """ŷ, q̂ and lead as above; each half can be switched off, and with both off they are what is measured.

    The keywords are those settings of `RbfnnBridgedConfig`.
    """

    joints: int
    _: KW_ONLY
    bridge: bool = True
    response_length: int = 12
    observe: bool = True
    feature_noise: float = 0.001
    find_noise: bool = True
    model_error: float = 0.2

    def __post_init__(self) -> None:
        """Start with an arm at rest."""
        self.reset()

    def reset(self) -> None:
        """Forget everything."""
        self._response = JointResponse(self.response_length, self.joints)
        self._filter: FeatureFilter | None = None
        self._noise = NoiseLevel(self.feature_noise)
        self._filtered_delay = 0
        self._past: FloatArray | None = None  # q(k), q(k−1), …

    @property
    def lead(self) -> float:
        """The present lead [periods]."""
        return self._response.lead if self.bridge else 0.0

    def predict(self, estimate: Estimate, observation: Observation) -> Prediction:
        """Return the prediction of this period.

        Raises:
            ValueError: a delay beyond what is kept of the past.
        """
        if not 0 <= estimate.delay <= MAX_DELAY:
            raise ValueError(f"delay must be from 0 to {MAX_DELAY} periods, got {estimate.delay}")
        J, past = estimate.jacobian, pushed(self._past, observation.joint_position, MAX_DELAY + 2)
        self._past, delay, flight = past, 0, np.zeros(self.joints)
        if self.bridge:
            self._response.learn(past[0] - past[1])
            delay, flight = estimate.delay, self._response.flight()
        seen = self._seen(J, past, delay, observation)
        return Prediction(seen + J @ (past[0] - past[delay] + flight), past[0] + flight, self.lead)

    def note(self, joint_step: FloatArray) -> None:
        """Take the joint step (n,), rad, that left the chain."""
        self._response.command(joint_step)

    def _seen(self, jacobian: FloatArray, past: FloatArray, delay: int, observation: Observation) -> FloatArray:
        """Return z, (m,), m: where the feature was at its exposure, `delay` periods ago."""
        y = observation.feature
        if not self.observe:
            return y
        if self._filter is None or delay != self._filtered_delay:
            self._filter = FeatureFilter(self._noise, self.model_error, y, find_noise=self.find_noise)
            self._filtered_delay = delay
        else:
            step = past[delay] - past[delay + 1]
            self._filter.advance(jacobian, step, y if observation.feature_valid else None)
        return self._filter.feature


def pushed(history: FloatArray | None, newest: FloatArray, length: int) -> FloatArray:
    """Return the history (length, …) with the newest value first; a first value fills it."""
    if history is None:
        return np.repeat(newest[None], length, axis=0)
    return np.concatenate([newest[None], history[:-1]])


def shifted(reference: FloatArray, lead: float, rows: int) -> FloatArray:
    """Return the reference `lead` periods later, (rows, m): interpolated, and extrapolated beyond its end.

    Args:
        reference: (1 + preview, m), m.
        lead: periods, at least 0.
        rows: how many instants are wanted, at most 1 + preview.
    """
    if lead == 0.0 or len(reference) == 1:
        return reference[:rows]
    whole = int(lead)
    missing = whole + rows + 1 - len(reference)
    if missing > 0:
        further = np.arange(1, missing + 1)[:, None] * (reference[-1] - reference[-2])
        reference = np.concatenate([reference, reference[-1] + further])
    before = reference[whole : whole + rows]
    return np.asarray(before + (lead - whole) * (reference[whole + 1 : whole + 1 + rows] - before))
