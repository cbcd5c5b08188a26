"""The observation and action spaces of a policy and its reward, over any leading axes."""

from typing import Final, TypeAlias, final

import numpy as np
import numpy.typing as npt
from gymnasium.spaces import Box

from servobench.plant.contract.checks import FloatArray, as_array
from servobench.plant.contract.lanes import norm
from servobench.plant.contract.signals import Observation, PlantSpec, Truth

Floats32: TypeAlias = npt.NDArray[np.float32]
FEATURE_BOUND: Final = 10.0  # natural sizes, beyond which features and errors are clipped


@final
class Spaces:
    """The observation of a policy: that of every controller, and its own last action, as one vector.

    | part | size | unit |
    |---|---|---|
    | reported joint positions | n | rad |
    | features | m | natural size of a feature |
    | reference minus feature, now and for each row of the preview | (1 + preview) m | the same |
    | whether each feature was measured | m | 0 or 1 |
    | last action | n | share of the joints' speed limits |

    Positions are clipped to the joints' limits and features to ten natural sizes, so that the space is bounded.
    """

    def __init__(self, spec: PlantSpec, preview: int) -> None:
        """Take the plant's spec and the number of future rows of the reference."""
        self.spec = spec
        feature = np.full(spec.m, FEATURE_BOUND)
        error = np.full((1 + preview) * spec.m, 2 * FEATURE_BOUND)
        ones = np.ones(spec.n)
        lower = np.concatenate([spec.joint_lower, -feature, -error, np.zeros(spec.m), -ones])
        upper = np.concatenate([spec.joint_upper, feature, error, np.ones(spec.m), ones])
        self._lower, self._upper = lower.astype(np.float32), upper.astype(np.float32)
        self.observations = Box(self._lower, self._upper, dtype=np.float32)
        self.actions = Box(-1.0, 1.0, (spec.n,), np.float32)

    def command(self, action: npt.ArrayLike) -> FloatArray:
        """Return joint velocities, (..., n) rad/s, for an action, (..., n) shares of the limits; clipped to them."""
        return np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0) * self.spec.joint_velocity_limit

    def action(self, given: npt.ArrayLike, *lanes: int) -> FloatArray:
        """Return an action as an array, (*lanes, n).

        Raises:
            ValueError: no numbers, another shape, or an entry that is not finite.
        """
        try:
            numbers = np.asarray(given)
        except ValueError:  # rows of unequal lengths
            numbers = np.asarray(None)
        if numbers.dtype.kind not in "fiu":
            raise ValueError(f"action must be an array of numbers, got {given!r}")
        return as_array("action", numbers, (*lanes, self.spec.n))

    def observe(self, observation: Observation, reference: FloatArray, action: npt.ArrayLike) -> Floats32:
        """Return the policy's observation.

        Args:
            observation: of the plant, (...).
            reference: (..., 1 + preview, m), from now on, in the unit of the feature.
            action: (..., n), the last one.

        Returns:
            (..., k).
        """
        scale, feature = self.spec.feature.scale, observation.feature
        errors = (reference - feature[..., None, :]) / scale
        action = np.clip(np.asarray(action, dtype=np.float64), -1.0, 1.0)
        parts = observation.joint_position, feature / scale, errors.reshape(*feature.shape[:-1], -1)
        whole = np.concatenate([*parts, observation.valid.astype(np.float64), action], axis=-1)
        return np.clip(whole.astype(np.float32), self._lower, self._upper)

    def error(self, truth: Truth, desired: FloatArray) -> FloatArray:
        """Return the norm of the true feature's error, (...), in natural sizes of a feature."""
        return norm(desired - truth.feature) / self.spec.feature.scale
