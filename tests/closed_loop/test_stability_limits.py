"""Predicted limits of latency and gain against the simulated ones, in small motions without noise."""

import pytest

from kit.nightly import some
from servobench.harness.analysis.loops.equilibrium import SmallLoop, warm_up
from servobench.harness.analysis.loops.loop_analysis import analyse_loop
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve

PUBLISHED = some(("pid+true", "mfac+ukf", "mpc+true", "rbf_pid:published"), "pid+true", "mpc+true")
# The law of rbfnn_mfac is not among them: what it learns grows with the error, which no linear model has.
# A posture term moves the arm all the time, so that the gain of the feature filter is not that of the rest.
NO_POSTURE = {"aids": {"posture": False}}


@pytest.mark.parametrize(
    ("controller", "settings"), [*((name, {}) for name in PUBLISHED), ("regression_mfac", NO_POSTURE)]
)
def test_predicted_limits_are_those_of_small_motions(controller, settings):
    run = resolve(RunRequest("kinematic", controller, "random", "none", 0), Settings({controller: settings}))
    predicted, warm = analyse_loop(run), warm_up(run)
    loop = SmallLoop(warm)
    # the loop has the true Jacobian and a limit of whole periods, the prediction the estimated one
    assert abs(loop.latency_limit() - predicted.latency_limit) <= 2.0 * run.run.period
    assert loop.gain_limit() == pytest.approx(predicted.margins.gain, rel=0.1)
