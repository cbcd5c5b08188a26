from decimal import Decimal

import numpy as np
import pandas as pd
import pytest

from servobench.harness.run.references import FixedPoint, Laps, Waypoints, line, read_waypoints
from servobench.plant.contract.signals import Channel
from servobench.plant.robot.hand_eye import FEATURE

CENTRE = np.array([0.1, -0.2, 1.2])


@pytest.mark.parametrize(
    "reference",
    [
        FixedPoint(CENTRE),
        Laps(CENTRE, 0.3, 10.0),
        Laps(CENTRE, 0.25, 7.0, eight=True),
        Waypoints(np.array([0.3, 1.1, 4.0]), np.random.default_rng(0).normal(size=(3, 3))),
    ],
)
def test_a_reference_sampled_at_once_has_the_bits_of_every_instant_by_itself(reference):
    rows = reference.sampled(0.05, 211)
    np.testing.assert_array_equal(rows, np.stack([reference.at(k * 0.05) for k in range(211)]))
    np.testing.assert_array_equal(rows[190:201], reference.at(np.arange(190, 201) * 0.05))
    with pytest.raises(ValueError, match="read-only"):
        rows[0] = 0.0


def test_a_circle_keeps_its_radius_its_depth_and_its_lap():
    times = np.linspace(0, 10, 201)
    points = Laps(CENTRE, 0.3, 10.0).at(times)
    np.testing.assert_allclose(np.linalg.norm(points - CENTRE, axis=1), 0.3, atol=1e-12)
    assert (points[:, 2] == CENTRE[2]).all()
    np.testing.assert_allclose(points[0], points[-1], atol=1e-12)
    np.testing.assert_allclose(points[50], CENTRE + [0, 0.3, 0], atol=1e-12)  # 200 points a lap


def test_a_lemniscate_crosses_its_centre_twice_a_lap():
    eight = Laps(CENTRE, 0.2, 8.0, eight=True)
    np.testing.assert_allclose(eight.at([2.0, 6.0]), [CENTRE, CENTRE], atol=1e-12)
    np.testing.assert_allclose(eight.at(1.0), CENTRE + [0.2 / np.sqrt(2), 0.1, 0], atol=1e-12)


def test_a_line_moves_at_constant_speed_and_rests_at_its_end():
    path = line(np.zeros(2), np.array([1.0, 2.0]), 4.0)
    np.testing.assert_allclose(
        path.at([-1.0, 1.0, 4.0, 9.0]), [[0, 0], [0.25, 0.5], [1, 2], [1, 2]]
    )


def test_waypoints_come_back_from_a_file(tmp_path):
    file = tmp_path / "points.csv"
    # As spreadsheets write it
    file.write_text("time_s, x_m, y_m, z_m\n0,0,0,1\n2,1,0,1\n", encoding="utf-8-sig")
    np.testing.assert_allclose(read_waypoints(file, FEATURE).at(1.0), [0.5, 0, 1])


def test_the_columns_of_a_waypoint_file_have_the_unit_of_the_feature(tmp_path):
    file = tmp_path / "points.csv"
    file.write_text("time_s,u_px,v_px\n0,0,0\n2,100,50\n")
    pixels = Channel(("u", "v"), "px", 1000.0, np.zeros(2), np.full(2, 1000.0))
    np.testing.assert_allclose(read_waypoints(file, pixels).at(1.0), [50, 25])
    with pytest.raises(
        ValueError, match="points.csv has no column x_m; it needs time_s, x_m, y_m, z_m"
    ):
        read_waypoints(file, FEATURE)


@pytest.mark.parametrize(
    ("kind", "arguments", "message"),
    [
        (Laps, (CENTRE, 0.0, 1.0), "radius must be above 0"),
        (Laps, (CENTRE, 1.0, -1.0), "lap_time must be above 0"),
        (line, (CENTRE, CENTRE, 0.0), "duration must be above 0"),
        (Waypoints, (np.zeros(3), np.zeros((2, 3))), "need times"),
    ],
)
def test_a_reference_that_cannot_be_is_refused(kind, arguments, message):
    with pytest.raises(ValueError, match=message):
        kind(*arguments)


PLACES = pd.DataFrame(
    {"time_s": [0.0, 2.0, 4.0], "x_m": [0.1, 0.15, 0.1], "y_m": [0.1, 0.1, 0.15], "z_m": [1.2] * 3}
)


@pytest.mark.parametrize(
    "change",
    [
        lambda table: table.set_index("time_s"),
        lambda table: table.set_index(["time_s", "x_m"]),
        lambda table: table.set_axis(
            pd.MultiIndex.from_product([["robot"], table.columns]), axis=1
        ),
        lambda table: table.set_axis(
            pd.MultiIndex.from_tuples([(name, "") for name in table]), axis=1
        ),
        lambda table: table.set_index(pd.Index([3, 1, 2])),
        lambda table: table.set_index(pd.Index(["a", "b", "c"], name="label")),
        lambda table: table.map(lambda number: Decimal(f"{number:.3f}")),
        lambda table: table.astype("category"),
        lambda table: table.astype("Float64"),
    ],
)
def test_parquet_is_read_as_pandas_writes_it(tmp_path, change):
    change(PLACES).to_parquet(tmp_path / "way.PARQUET")
    read = read_waypoints(tmp_path / "way.PARQUET", FEATURE)
    np.testing.assert_array_equal(
        read.at([0.0, 1.0, 4.0]), [[0.1, 0.1, 1.2], [0.125, 0.1, 1.2], [0.1, 0.15, 1.2]]
    )


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (lambda table: table.set_axis(range(4), axis=1), "way.parquet has no column time_s; it needs time_s, x_m"),
        (lambda table: table.assign(time_s=pd.to_timedelta(table["time_s"], unit="s")),
         r"time_s must be numbers, got timedelta64.*total_seconds\(\)"),
        (lambda table: table.assign(time_s=pd.to_datetime(table["time_s"], unit="s", utc=True)), "got datetime64"),
        (lambda table: table.set_index(pd.TimedeltaIndex(table.pop("time_s").to_numpy("m8[s]"))),
         "way.parquet has times as its index without a name; for a column time_s in s"),
        (lambda table: table.set_axis(["time_s", "x_m", " x_m", "z_m"], axis=1), "has two columns 'x_m'; leave"),
        (lambda table: table.assign(x_m=[0.1, 1e308, 0.1]), "row 1: x_m must be a number below 1e.30, got '1e.308'"),
    ],
)  # fmt: skip
def test_parquet_that_is_no_table_of_numbers_is_one_line(tmp_path, change, said):
    change(PLACES.copy()).to_parquet(tmp_path / "way.parquet")
    with pytest.raises(ValueError, match=said) as caught:
        read_waypoints(tmp_path / "way.parquet", FEATURE)
    assert "\n" not in str(caught.value)
