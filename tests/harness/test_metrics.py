from __future__ import annotations

import dataclasses
import warnings

import numpy as np
import pytest

from kit.straight_move import straight_move
from servobench.harness.run.metrics import (
    judge_run,
    overshoot,
    path_length,
    settling_time,
    sign_switches,
)

PERIOD = 0.1


def test_settling_is_the_first_time_after_which_the_error_stays():
    error = np.array([1.0, 0.001, 0.1, *[0.001] * 10])
    assert settling_time(error, 0.005, PERIOD) == pytest.approx(0.3)


def test_a_run_within_the_band_from_the_start_on_its_edge_settles_at_once():
    assert settling_time(np.full(20, 0.005), 0.005, PERIOD) == 0.0


def test_the_steady_state_of_periods_of_a_second_is_the_last_one():
    got = judge_run(straight_move(periods=3).steps(), "point_to_point", evaluate_from=0.0)
    assert got["steady_state_error"] == 0.0
    assert got["rms_error"] > 0.0


def test_an_error_that_came_in_too_late_or_left_again_has_not_settled():
    assert np.isnan(settling_time(np.array([1.0] * 10 + [0.0] * 4), 0.005, PERIOD))
    assert settling_time(np.array([1.0] * 10 + [0.0] * 5), 0.005, PERIOD) == pytest.approx(1.0)
    assert np.isnan(settling_time(np.array([0.0] * 10 + [1.0]), 0.005, PERIOD))
    assert np.isnan(settling_time(np.full(20, np.nan), 0.005, PERIOD))


def test_settling_and_overshoot_agree_with_python_control():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import control
    system = control.tf([4.0], [1.0, 1.0, 4.0])
    times = np.arange(0.0, 15.0, 0.01)
    _, response = control.step_response(system, times)
    info = control.step_info(response, times, SettlingTimeThreshold=0.05, yfinal=1.0)
    assert settling_time(np.abs(1.0 - response), 0.05, 0.01) == pytest.approx(info["SettlingTime"], abs=0.011)
    track = np.outer(response, [0.3, 0.0, -0.4])
    assert overshoot(track.T, np.array([0.3, 0.0, -0.4])) == pytest.approx(info["Overshoot"] / 100, abs=1e-9)


def test_no_overshoot_when_the_feature_stops_short():
    assert overshoot(np.array([[0.0, 0.5], [0.0, 0.2]]), np.array([1.0, 0.0])) == 0.0


def test_the_path_length_of_a_square_is_its_circumference():
    assert path_length(np.array([[0, 1, 1, 0, 0], [0, 0, 1, 1, 0]], dtype=float)) == 4.0


@pytest.mark.parametrize(
    ("command", "switches"),
    [
        ([1, -1, 1, -1], 3),
        ([1, 0, -1, 0, 1], 2),  # through a small command, within two periods
        ([1, 0, 0, -1], 0),  # too slow
        ([1, 1, -1, -1, -1, 1], 2),
        ([1, -0.05, 1, 0.05, -1], 1),  # a small command of the other sign is none
        ([1, -1, 0, 1], 2),  # the newest large command counts, not an older one of the same sign
        ([0.1, -0.1], 1),
        ([1], 0),
    ],
)
def test_a_switch_is_a_large_command_soon_after_one_of_the_other_sign(command, switches):
    values = 2.0 * np.array([command, np.zeros(len(command))])
    assert sign_switches(values, np.full(2, 2.0)) == switches
    assert sign_switches(-values, np.full(2, 2.0)) == switches
    lanes = np.stack([values, np.ones_like(values), values])
    assert sign_switches(lanes, np.full(2, 2.0)).tolist() == [switches, 0, switches]


def test_a_run_of_one_period_has_no_acceleration_and_no_switch():
    got = judge_run(straight_move(periods=1).steps(), "point_to_point", evaluate_from=0.0)
    assert np.isnan([got[name] for name in got if "acceleration" in name or "jerk" in name]).all()
    assert got["command_switches"] == 0


def test_where_one_time_is_unknown_no_overruns_are_counted():
    steps = straight_move().steps()
    times = np.array([np.nan, 1e9, 1e9, 1e9])
    got = judge_run(dataclasses.replace(steps, controller_time=times), "curve", evaluate_from=0.0)
    assert np.isnan(got["controller_time_overruns"])
