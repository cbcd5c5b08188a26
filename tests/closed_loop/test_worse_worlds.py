"""Settling times in worlds that are worse than usual; a change in a method must not alter them.

Runs are deterministic. Another processor rounds differently, which may shift a settling time by a period. How often
each method settles on 100 robots is measured by `make nightly`.
"""

import math

import pytest

from kit.nightly import some
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import carry_out_together
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import resolve

NEVER = math.nan
SEEDS = (704, 707)  # whose settling times five kinds of processors give alike to a period or a hundredth
METHODS = ("regression_mfac", "rbfnn_mfac:published", "ukf_mfac:published", "ukf_mpc:published", "rbf_pid:published")
# mismatch, latency [s], duration [s], and for each of METHODS the settling times of SEEDS [s]
WORLDS = {
    "severe": (
        "severe", 0, 10.0,
        ((0.68, 0.674), (1.195, 1.531), (2.163, 2.265), (2.077, 2.214), (1.172, 1.279)),
    ),
    "camera_turned_by_60_degrees": (
        "moderate+camera_rotation=60deg", 0, 10.0,
        ((0.622, 0.656), (3.22, 2.541), (2.047, 1.774), (1.955, 1.932), (1.547, 2.207)),
    ),
    "camera_turned_by_120_degrees": (
        "moderate+camera_rotation=120deg", 0, 10.0,
        ((0.791, 0.962), (3.669, NEVER), (2.519, 2.487), (2.063, 2.265), (2.17, 3.77)),
    ),
    "links_20_percent_tool_60_mm": (
        "moderate+links=20%+tool=60mm", 0, 10.0,
        ((0.706, 0.692), (1.2, 1.042), (2.21, 2.188), (2.082, 2.014), (1.251, 0.995)),
    ),
    "latency_of_50_ms": (
        "moderate", 0.05, 10.0,
        ((0.653, 0.689), (2.451, 2.893), (2.253, 2.537), (2.035, 2.447), (1.252, 1.223)),
    ),
    "camera_moved_by_45_degrees": (
        "moderate+camera_move=45deg", 0, 16.0,
        ((8.412, 8.972), (9.496, 15.09), (9.175, 9.84), (9.189, 9.983), (9.495, 9.328)),
    ),
}  # fmt: skip


@pytest.mark.parametrize("controller", METHODS)
@pytest.mark.parametrize("world", some(WORLDS, "severe", "camera_turned_by_120_degrees", "camera_moved_by_45_degrees"))
def test_methods_settle_as_soon_as_they_did(world, controller):
    mismatch, latency, duration, wanted = WORLDS[world]
    settings = Settings({"random": {"duration": duration}})
    requests = [RunRequest("kinematic", controller, "random", mismatch, seed, {"latency": latency}) for seed in SEEDS]
    results = carry_out_together([resolve(request, settings) for request in requests])
    came = [result.row["settling_time_s"] for result in results]
    one_period = 1.001 * RunSettings().period
    assert came == pytest.approx(wanted[METHODS.index(controller)], abs=one_period, rel=0.01, nan_ok=True)
