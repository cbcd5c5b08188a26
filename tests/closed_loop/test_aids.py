"""Methods with and without aids on the kinematic plant: turned, late and moved cameras, circles, settings."""

import numpy as np
import pytest

from kit.nightly import some
from servobench.controllers.methods import METHODS
from servobench.harness.config.settings import read_settings
from servobench.harness.run.episode import carry_out_together, run_experiment
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve

EQUIPPED = ("regression_mfac", "rbfnn_mfac", "ukf_mfac", "ukf_mpc", "rbf_pid")
CALMED = (
    "regression_mfac",
    "calibrating_mfac",
    "ukf_mfac",
    "ukf_mpc",
    "rbf_pid",
)  # `rbfnn_mfac` drifts on
TURNED = "moderate+camera_rotation=120deg"
PLUS, PAPER = "regression_mfac", "rbfnn_mfac:published"
IDENTIFYING = [
    name
    for name in METHODS
    if not name.endswith(":published") and name not in {"constant", "calibrated"}
]


def rows(controller, task, mismatch, seeds, *settings, latency=None):
    """Return the rows of runs with these seeds, which advance side by side."""
    varied = {} if latency is None else {"latency": latency}
    requests = [RunRequest("kinematic", controller, task, mismatch, seed, varied) for seed in seeds]
    return [
        run.row
        for run in carry_out_together(
            [resolve(each, read_settings(None, settings)) for each in requests]
        )
    ]


@pytest.mark.parametrize("name", some([*EQUIPPED, PAPER], PLUS, "ukf_mpc", PAPER))
def test_behind_a_turned_and_late_camera_a_method_settles_soon_only_with_its_aids(name):
    times = [
        each["settling_time_s"] for each in rows(name, "random", TURNED, range(2), latency=0.1)
    ]
    assert np.isnan(times).all() if name == PAPER else max(times) < 5.0


def test_wrong_links_and_tool_and_a_camera_turned_right_round_settle():
    found = rows(PLUS, "random", "links=20%+tool=60mm+camera_rotation=180deg", range(3))
    assert max(each["settling_time_s"] for each in found) < 4.0


@pytest.mark.parametrize("seed", some(range(3), 0))
def test_a_camera_that_is_moved_during_the_run_is_noticed_once_and_recovered_from(seed):
    settings = read_settings(None, ["random.duration=10"])
    run = run_experiment(
        RunRequest("kinematic", PLUS, "random", "moderate+camera_move=90deg", seed), settings
    )
    assert 5.0 < run.row["settling_time_s"] < 9.0
    assert run.steps["diagnostic_camera_moves"].iloc[-1] == 1.0


def test_it_is_sooner_there_with_less_overshoot_than_the_method_of_the_paper():
    found = (rows(name, "random", "moderate", range(2)) for name in (PLUS, PAPER))
    for plus, paper in zip(*found, strict=True):
        assert plus["settling_time_s"] < paper["settling_time_s"]
        assert plus["overshoot"] < 0.5 * paper["overshoot"] + 0.005


@pytest.mark.parametrize("name", some(IDENTIFYING, PLUS))
def test_the_noise_of_frames_hides_no_camera_delay_from_an_arm_that_answers_at_once(name):
    """A law turns the noise of a frame into motion, which at a delay of 0 would explain that this noise is gone."""
    found = rows(name, "circle", "moderate", range(2), "kinematic.command_delay=0", latency=0.05)
    assert max(each["rms_error_evaluated"] for each in found) < 0.003


@pytest.mark.parametrize("name", some([*IDENTIFYING, "calibrated"], "rbf_pid"))
def test_a_latency_of_half_a_period_costs_little_more_than_one_of_a_period(name):
    (half,), (whole,) = (
        rows(name, "circle", "moderate", [2], latency=latency) for latency in (0.025, 0.05)
    )
    assert half["rms_error_evaluated"] < 1.6 * whole["rms_error_evaluated"]


@pytest.mark.parametrize(
    ("name", "sensing", "seed"),
    [
        ("regression_mfac", "position", 40448),
        ("ukf_mfac", "position", 40448),
        ("regression_mfac", "stereo", 40450),
    ],
)
def test_the_posture_moves_the_arm_at_rest_without_spoiling_the_jacobian(name, sensing, seed):
    """The posture moves the feature a little, and the law undoes what is seen of it: no Jacobian explains that."""
    request = RunRequest("kinematic", name, "random", "moderate", seed, sensing=sensing)
    error = run_experiment(request, read_settings(None, [])).steps["jacobian_error"].to_numpy()
    assert error[-1] < 1.2 * error[20] < 0.3


@pytest.mark.parametrize("name", some(CALMED, PLUS, "ukf_mpc"))
def test_before_a_target_out_of_reach_the_arm_comes_to_rest(name):
    """Without calming, the stretched arm is driven to and fro at full speed."""
    calm, wild = (
        rows(name, "unreachable", "moderate", [46003, 46004], f"{name}.aids.calming={on}")
        for on in ("true", "false")
    )
    for one, other in zip(calm, wild, strict=True):
        assert one["command_switches"] < 0.25 * other["command_switches"]
        assert one["steady_state_error"] < 1.02 * other["steady_state_error"]


@pytest.mark.parametrize(
    ("task", "mismatch"), [("random", "latency_swing=200ms"), ("circle", "jitter=200ms")]
)
def test_with_stamps_a_changing_latency_leaves_a_fraction_of_the_error(task, mismatch):
    """The delay bank of the pair stage finds what remains constant: latency and offset of the camera's clock."""
    seeds = (3, 4)
    late = rows(PLUS, task, f"moderate+{mismatch}", seeds)
    clock = ("kinematic.sensing.stamps=true", "kinematic.sensing.clock_offset=1e3")
    stamped = rows(PLUS, task, f"moderate+{mismatch}", seeds, *clock)
    for before, after in zip(late, stamped, strict=True):
        assert after["steady_state_error"] < 0.002
        assert after["steady_state_error"] < 0.5 * before["steady_state_error"]
        assert after["rms_error"] < before["rms_error"]
