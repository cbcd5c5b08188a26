"""Predicted limits of latency and gain against the simulated ones, in small motions without noise."""

import numpy as np
import pytest

from kit import small_loop
from kit.nightly import some
from kit.small_loop import SmallLoop
from servobench.harness.apps.loops.equilibrium import warm_up
from servobench.harness.apps.loops.loop_analysis import analyse_loop
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve

PUBLISHED = some(("mfac+ukf", "mpc+true", "rbf_pid:published"), "mpc+true")
# The law of rbfnn_mfac is not among them: what it learns grows with the error, which no linear model has.
# A posture term moves the arm all the time, so that the gain of the feature filter is not that of the rest.
NO_POSTURE = {"aids": {"posture": False}}
NEAR = 0.1  # [1] of a gain


def analysed(controller, settings):
    """Return the predicted limits and the simulated loop, which has the true Jacobian, and whole periods of latency."""
    run = resolve(
        RunRequest("kinematic", controller, "random", "none", 0), Settings({controller: settings})
    )
    return analyse_loop(run), SmallLoop(warm_up(run)), run.run.period


def test_simulated_limits_are_the_predicted_ones(monkeypatch):
    monkeypatch.setattr(small_loop, "GAIN_PRECISION", 0.5 * NEAR)
    predicted, loop, period = analysed("pid+true", {})
    assert loop.gain_limit() == pytest.approx(predicted.margins.gain_margin, rel=NEAR)
    # The search goes on from the latency of the loop period by period, and a search from none is long
    loop.latency = predicted.latency_limit - 4.0 * period
    assert abs(loop.latency_limit() - predicted.latency_limit) <= 2.0 * period


@pytest.mark.parametrize(
    ("controller", "settings"),
    [*((name, {}) for name in PUBLISHED), ("regression_mfac", NO_POSTURE)],
)
def test_small_motions_die_out_below_the_predicted_limits_and_not_above_them(controller, settings):
    predicted, loop, period = analysed(controller, settings)
    limit = (predicted.latency_limit - loop.latency) / period
    for periods, stable in ((max(np.ceil(limit) - 2, 0), True), (np.floor(limit) + 3, False)):
        assert loop.is_stable(latency=loop.latency + periods * period) == stable
    for factor, stable in ((1.0 - NEAR, True), (1.0 + NEAR, False)):
        assert loop.is_stable(factor * predicted.margins.gain_margin) == stable
