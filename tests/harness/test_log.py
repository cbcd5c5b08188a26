from __future__ import annotations

import numpy as np
import pytest

from kit.straight_move import CONDITION, SPEC, VELOCITY, straight_move
from servobench.harness.run.log import StepLog, column_unit

COLUMNS = [
    *("run_id", "step", "time_s", "reference_x_m", "reference_y_m", "feature_x_m", "feature_y_m"),
    *("true_feature_x_m", "true_feature_y_m", "joint_position_a_rad", "joint_position_b_rad"),
    *("joint_velocity_command_a_rad_s", "joint_velocity_command_b_rad_s", "error_norm", "jacobian_error"),
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


def test_a_diagnostic_that_comes_late_is_unknown_before():
    log = straight_move(({"probing": 1.0}, {"probing": 1.0}, {"probing": 0.0, "noise": 0.5}, {"noise": 0.25}))
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


@pytest.mark.parametrize(("unit", "suffix"), [("m", "m"), ("rad/s", "rad_s"), ("px", "px"), ("m/s^2", "m_s_2")])
def test_units_become_suffixes_of_columns(unit, suffix):
    assert column_unit(unit) == suffix
