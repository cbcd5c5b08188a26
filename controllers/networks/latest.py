"""A memo of the Jacobian network at the joint positions that were asked for last."""

from __future__ import annotations

from typing import final

import numpy as np

from servobench.controllers.networks.rbf import JacobianNetwork
from servobench.plant.contract.checks import FloatArray


@final
class LatestFeatures:
    """θ and Ĵ at the joint positions that were asked for last.

    An estimator asks for the same ones in `estimate` and in the next `update`. This saves time only: it is a memo of
    pure functions, and rows of weights never change.
    """

    def __init__(self, network: JacobianNetwork) -> None:
        """Take the network; nothing is known yet."""
        self._network = network
        self._position, self._shape = b"", (-1,)
        self._theta, self._rows, self._jacobian = (np.empty(0),) * 3

    def at(self, q: FloatArray) -> FloatArray:
        """Return θ, (..., U, L), at q, (..., n), rad."""
        position = q.tobytes()
        if position != self._position or q.shape != self._shape:
            self._theta = self._network.features(q)
            self._position, self._shape, self._rows = position, q.shape, np.empty(0)
        return self._theta

    def jacobian(self, rows: FloatArray, q: FloatArray) -> FloatArray:
        """Return Ĵ, (..., m, n), m/rad, at q, (..., n), rad, with weights by rows, (..., m, n, L)."""
        theta = self.at(q)
        if rows is not self._rows:
            self._jacobian = self._network.output(rows, theta[..., None, :, :])[..., 0, :, :]
            self._rows = rows
        return self._jacobian
