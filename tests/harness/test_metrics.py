import dataclasses
import warnings

import numpy as np
import pytest

from servobench.harness.run.log import Period, StepLog
from servobench.harness.run.metrics import judge_run, overshoot, settling_time, sign_switches
from servobench.plant.contract.signals import Command, Observation, PlantSpec, Truth, column_unit

PERIOD = 0.1
SPEC = PlantSpec.of_joints(
    ("a", "b"), ("x", "y"), np.full(2, 2.0), np.full(2, -9.0), np.full(2, 9.0), period=1.0
)
X = (0.0, 0.5, 1.0, 1.0)
VELOCITY = (2.0, -2.0, 1.0, 0.0)  # of joint a; its limit is 2
CONDITION = (1.0, 3.0, 2.0, 1.0)
ESTIMATE = (1.2, 1.4, None, None)  # times the true Jacobian


def straight_move(
    diagnostics=({}, {}, {}, {}), periods=4, milliseconds=(0.001, 0.002, 0.003, 0.004)
):
    """Return the log of so many periods; the fourth has no valid feature. A step of the controller takes so long."""
    log = StepLog(SPEC, 4)
    for k in range(periods):
        jacobian = np.diag([CONDITION[k], 1.0])
        period = Period(
            Observation(float(k), [0.1 * k, 0.0], [X[k] + 0.01, 0.0], k < 3),
            np.array([[1.0, 0.0]]),
            Command([VELOCITY[k], 0.0]),
            Truth(np.array([X[k], 0.0]), jacobian),
            (int(1e6 * milliseconds[k]), 5000),
        )
        log.add(period, None if ESTIMATE[k] is None else ESTIMATE[k] * jacobian, diagnostics[k])
    return log


@pytest.mark.parametrize(
    ("error", "wanted"),
    [
        (
            [1.0, 0.001, 0.1, *[0.001] * 10],
            PERIOD * (2.0 + 0.095 / 0.099),
        ),  # left again, back between two
        ([0.005] * 20, 0.0),  # on the edge from the start
        ([1.0] * 10 + [0.0] * 5, 0.9995),
        ([1.0] * 10 + [0.0] * 4, np.nan),  # too late
        ([0.0] * 10 + [1.0], np.nan),
        ([np.nan] * 20, np.nan),
    ],
)
def test_settling_is_the_first_time_after_which_the_error_stays_in_the_band(error, wanted):
    assert settling_time(np.array(error), 0.005, PERIOD) == pytest.approx(wanted, nan_ok=True)


def test_the_settling_time_of_an_exponential_is_that_of_its_chord_at_any_period():
    """A chord of exp(−t) crosses the band late, by at most an eighth of the square of the period."""
    for period in (0.05, 0.1, 0.2):
        error = np.exp(-np.arange(0.0, 9.0, period))
        times = settling_time(np.stack([error, error]), [0.05, 0.01], period)
        late = times - np.log([20.0, 100.0])
        assert ((late >= 0.0) & (late <= period**2 / 8.0)).all()


def test_the_steady_state_of_periods_of_a_second_is_the_last_one():
    got = judge_run(straight_move(periods=3).steps(), "point_to_point", evaluate_from=0.0)
    assert got["steady_state_error"] == 0.0
    assert got["rms_error"] > 0.0


def test_settling_and_overshoot_agree_with_python_control():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import control
    system = control.tf([4.0], [1.0, 1.0, 4.0])
    times = np.arange(0.0, 15.0, 0.01)
    _, response = control.step_response(system, times)
    info = control.step_info(response, times, SettlingTimeThreshold=0.05, yfinal=1.0)
    assert settling_time(np.abs(1.0 - response), 0.05, 0.01) == pytest.approx(
        info["SettlingTime"] - 0.005, abs=0.0051
    )
    track = np.outer(response, [0.3, 0.0, -0.4])
    assert overshoot(track.T, np.array([0.3, 0.0, -0.4])) == pytest.approx(
        info["Overshoot"] / 100, abs=1e-9
    )


def test_no_overshoot_when_the_feature_stops_short():
    assert overshoot(np.array([[0.0, 0.5], [0.0, 0.2]]), np.array([1.0, 0.0])) == 0.0


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


COLUMNS = [
    *("run_id", "step", "time_s", "reference_x_m", "reference_y_m", "feature_x_m", "feature_y_m"),
    *("true_feature_x_m", "true_feature_y_m", "joint_position_a_rad", "joint_position_b_rad"),
    *(
        "joint_velocity_command_a_rad_s",
        "joint_velocity_command_b_rad_s",
        "error_norm",
        "jacobian_error",
    ),
    *("jacobian_condition", "feature_valid", "controller_time_us", "plant_time_us"),
]


def test_a_table_holds_what_was_logged_under_names_with_units():
    table = straight_move().steps().table("one")
    assert list(table) == COLUMNS
    assert (table["run_id"] == "one").all()
    assert table["step"].tolist() == [0, 1, 2, 3]
    assert table["joint_velocity_command_a_rad_s"].tolist() == list(VELOCITY)
    assert table["error_norm"].tolist() == [1.0, 0.5, 0.0, 0.0]
    assert table["jacobian_condition"].tolist() == list(CONDITION)
    np.testing.assert_allclose(table["jacobian_error"], [0.2, 0.4, np.nan, np.nan], rtol=1e-14)
    assert table["feature_valid"].tolist() == [True, True, True, False]
    assert table["controller_time_us"].tolist() == [1.0, 2.0, 3.0, 4.0]


def test_stamps_of_frames_have_a_column_where_there_are_any():
    log = StepLog(SPEC, 2)
    for k, captured in enumerate((np.nan, 1e3)):
        seen = Observation(float(k), [0.0, 0.0], [0.0, 0.0], capture_time=captured)
        given = Command([0.0, 0.0]), Truth(np.zeros(2), None), (1, 1)
        log.add(Period(seen, np.zeros((1, 2)), *given), None, {})
    table = log.steps().table("one")
    assert list(table)[list(table).index("feature_valid") + 1] == "capture_time_s"
    np.testing.assert_array_equal(table["capture_time_s"], [np.nan, 1e3])


def test_a_diagnostic_that_comes_late_is_unknown_before():
    log = straight_move(
        ({"probing": 1.0}, {"probing": 1.0}, {"probing": 0.0, "noise": 0.5}, {"noise": 0.25})
    )
    table = log.steps().table("one")
    assert list(table)[len(COLUMNS) :] == ["diagnostic_probing", "diagnostic_noise"]
    np.testing.assert_array_equal(table["diagnostic_probing"], [1.0, 1.0, 0.0, np.nan])
    np.testing.assert_array_equal(table["diagnostic_noise"], [np.nan, np.nan, 0.5, 0.25])


def test_the_full_jacobian_is_logged_on_request():
    table = straight_move().steps().table("one", full_jacobian=True)
    assert table["true_jacobian_x_a"].tolist() == list(CONDITION)
    np.testing.assert_array_equal(table["estimated_jacobian_y_b"], [1.2, 1.4, np.nan, np.nan])


def test_a_run_that_ended_early_has_the_rows_that_it_reached():
    assert len(StepLog(SPEC, 4).steps()) == 0
    assert StepLog(SPEC, 4).steps().table("none").empty


def test_a_singular_jacobian_has_an_infinite_condition():
    log = straight_move()
    log.steps().true_jacobian[1] = 0.0
    assert log.steps().jacobian_condition()[1] == np.inf


@pytest.mark.parametrize(
    ("unit", "suffix"), [("m", "m"), ("rad/s", "rad_s"), ("px", "px"), ("m/s^2", "m_s_2")]
)
def test_units_become_suffixes_of_columns(unit, suffix):
    assert column_unit(unit) == suffix
