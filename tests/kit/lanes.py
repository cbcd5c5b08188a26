"""Rows of runs side by side, compared with those of each run alone."""

from collections.abc import Sequence

import numpy as np

from servobench.harness.run.episode import carry_out, carry_out_together
from servobench.harness.run.resolution import ResolvedRun
from servobench.harness.run.result import RunResult


def rows(results: Sequence[RunResult]) -> list[dict[str, object]]:
    """Return the row of each run without wall-clock times."""
    return [{name: value for name, value in each.row.items() if "_time_" not in name or "settling" in name}
            for each in results]  # fmt: skip


def alone(resolved: Sequence[ResolvedRun]) -> list[dict[str, object]]:
    """Return the rows of runs that are carried out one by one."""
    return rows([carry_out(run, steps=False) for run in resolved])


def assert_rows_of_single_runs(resolved: Sequence[ResolvedRun]) -> list[dict[str, object]]:
    """Compare the rows of runs side by side with those of each alone, bit for bit, and return them."""
    single = alone(resolved)
    np.testing.assert_equal(rows(carry_out_together(resolved)), single)
    return single
