"""A logged run as a plant, to step a controller through it."""

from typing import final

import numpy as np
import pandas as pd

from servobench.harness.apps.twin.log import LOG, read_log
from servobench.plant.bench.plant import Plant
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.files import numbers_of
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth, column_names


@final
class LoggedPlant(Plant):
    """A logged run as a plant that returns the logged observations, row by row, and ignores commands.

    After the last row it returns that row again.
    """

    def __init__(self, spec: PlantSpec, table: pd.DataFrame) -> None:
        """Read the observations.

        Args:
            spec: names, units and period.
            table: a row a control period, with columns as `steps.parquet` has them; times do not count, and
                `feature_valid`, `capture_time_s` and `true_feature_…` may be missing.

        Raises:
            ConfigurationError: a column or a number is missing.
        """
        self.spec = spec
        self.log = read_log(spec, table, least=0)
        self._k = 0
        self.reference = numbers_of(LOG, table, column_names(spec)["reference"])
        if not self.log.valid.any():
            raise ConfigurationError("the log has no row whose feature_valid is 1 or true")
        self._true = table.reindex(columns=column_names(spec)["true_feature"]).to_numpy(np.float64)

    def reset(self, seed: int) -> Observation:
        """Go back to the first row; nothing is random. See `Plant.reset`."""
        self._k = 0
        return self._row()

    def step(self, command: Command) -> Observation:
        """Return the next row; the command is ignored. See `Plant.step`."""
        self._k = min(self._k + 1, len(self.reference) - 1)
        return self._row()

    def _row(self) -> Observation:
        k = self._k
        log = self.log
        time = k * self.spec.period
        return Observation(
            time,
            log.joints[k],
            log.features[k],
            bool(log.valid[k]),
            capture_time=log.captured[k],
        )

    def truth(self) -> Truth:
        """Return the true feature of the log, NaN where it has none."""
        return Truth(self._true[self._k], None)

    def close(self) -> None:
        """Nothing is held."""
