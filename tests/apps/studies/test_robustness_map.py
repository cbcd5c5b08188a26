"""The robustness map: its cells, its tables, its command."""

import math
from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from kit.command import servobench
from kit.folders import made_up_row
from kit.own import WHOLE
from kit.plants import NEEDS_MUJOCO
from servobench.harness.analysis.comparison import settled_share
from servobench.harness.apps.studies import robustness
from servobench.harness.apps.studies.robustness import (
    BASE,
    KNOWN_LINES,
    LATENCY,
    LINES,
    MOVE,
    TASK,
    Line,
    draw_map,
    find_lines,
    map_cells,
    map_runs,
    predicted_limits,
    settling_median,
)
from servobench.harness.batch.plan import Batch
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.settings import Settings
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.sensing import SENSOR_AXES
from servobench.plant.robot.mismatch import Magnitude

SMALLEST = Batch(("kinematic",), ("constant",), (TASK,), (BASE,), (0,))


def test_the_map_has_every_place_for_every_method_and_no_run_twice():
    cells = [*map_cells(replace(SMALLEST, controllers=("constant", "broyden"), seeds=range(3)))]
    assert (
        len({cell.request.run_id for cell in cells})
        == len(cells)
        == 6 * sum(len(line.places) for line in LINES)
    )
    of = {
        axis: [each.request for each in cells if each.columns["axis"] == axis]
        for axis in (MOVE, LATENCY)
    }
    assert {str(request.mismatch) for request in of[MOVE]} >= {"moderate+camera_move=90deg"}
    assert {request.varied for request in of[MOVE]} == {(("task.duration", 20.0),)}
    assert (("plant.sensing.latency", 0.05),) in {request.varied for request in of[LATENCY]}


def test_a_map_along_axes_of_the_sensor_has_their_words_and_no_moved_camera():
    lines = find_lines(["jitter", "outliers"])
    assert [line.axis for line in lines] == ["outliers", "jitter"]
    requests = [cell.request for cell in map_cells(SMALLEST, lines)]
    assert {request.varied for request in requests} == {()}
    assert {str(request.mismatch) for request in requests} >= {
        "moderate+outliers=40%",
        "moderate+jitter=200ms",
    }
    assert find_lines([]) is LINES
    assert {*SENSOR_AXES} <= {*KNOWN_LINES}
    with pytest.raises(
        ConfigurationError, match="the map has no axis 'outlier': did you mean 'outliers'"
    ):
        find_lines(["outlier"])


def test_a_run_whose_camera_moves_is_longer_unless_the_user_says_how_long(monkeypatch, tmp_path):
    monkeypatch.setattr(robustness, "draw_map", lambda *_: [tmp_path])  # which takes seconds
    monkeypatch.setattr(robustness, "LONGER", ((robustness.DURATION, 0.4),))
    line = Line(MOVE, "camera moved half-way [°]", (Magnitude(0.0, "deg"), Magnitude(90.0, "deg")))
    monkeypatch.setattr(robustness, "KNOWN_LINES", {MOVE: line})
    words = (
        "--axes",
        MOVE,
        "--plant",
        "kinematic",
        "--controllers",
        "constant",
        "--seeds",
        "1",
        "--workers",
        "1",
    )
    for name, given, periods in (("usual", (), 8), ("given", ("--set", "random.duration=0.2"), 4)):
        out = tmp_path / name
        assert servobench(monkeypatch, "robustness", *words, *given, "--out", str(out)) == 0
        runs = map_runs(ResultsFolder(out))
        assert runs["periods"].tolist() == [periods] * 2
        assert runs["moved_at_s"].tolist() == pytest.approx(
            [math.nan, 0.025 * periods], nan_ok=True
        )


def test_settling_counts_from_the_move_of_the_camera():
    runs = pd.DataFrame(
        {"settling_time_s": [11.0, 12.0, np.nan], "status": "completed", "moved_at_s": 10.0}
    )
    assert settling_median(runs).value == 2.0
    assert settling_median(runs.assign(moved_at_s=np.nan)).value == 12.0
    assert settled_share(runs).value == pytest.approx(200 / 3)
    assert math.isinf(settling_median(runs.tail(1)).value)


@pytest.fixture
def figures(monkeypatch):
    """The figures that are saved, none of which is written."""
    figures = []
    monkeypatch.setattr(
        robustness.style, "save_figure", lambda figure, stem: figures.append(figure) or [stem]
    )
    return figures


def rows_of(axis, controller, never=(), seeds=1):
    """Return runs of a controller along an axis, of which none settles at some magnitudes."""
    line = next(line for line in LINES if line.axis == axis)
    return [
        made_up_row("", controller=controller, seed=seed, axis=axis, magnitude=place.number,
                    settling_time_s=math.nan if place.number in never else 1.0 + seed, robot="ur5", moved_at_s=math.nan)
        for place in line.places
        for seed in range(seeds)
    ]  # fmt: skip


def test_the_map_carries_the_predicted_limit_of_the_latency(tmp_path, figures):
    fast = Settings({"pid+true": {"law": {"proportional_gain": 9.0}}})
    limits = predicted_limits(["pid+true", "pid+constant", "nmpc_calibrated"], fast)
    assert 0.0 < limits["pid+true"] < 0.25 < limits["pid+constant"] == math.inf
    assert "nmpc_calibrated" not in limits
    slow = Settings({**fast.sections, "fmu": {"lag": 0.5, "command_delay": 0.15}})
    assert predicted_limits(["pid+true"], slow, plant="fmu")["pid+true"] < limits["pid+true"]
    draw_map(
        pd.DataFrame([row for name in limits for row in rows_of(LATENCY, name)]), tmp_path, limits
    )
    lines = [np.asarray(each.get_xdata()) for each in figures[0].axes[0].get_lines()]
    upright = [x[0] for x in lines if len(x) == 2 and x[0] == x[1]]
    assert upright == [pytest.approx(1000.0 * limits["pid+true"])]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("plant", "robot", "predicted"),
    [("kinematic", "ur5", ["constant"]), ("kinematic", "twin.toml", []),
     pytest.param("mujoco", "ur5", [], marks=NEEDS_MUJOCO)],
)  # fmt: skip
def test_limits_are_predicted_for_kinematic_joints_not_for_twins_and_rendered_arms(
    monkeypatch, tmp_path, plant, robot, predicted
):
    pose = "pose = {frame = 'base', position = [0.4, 0.1, 2.2], rotation = [[0, -1, 0], [-1, 0, 0], [0, 0, -1]]}"
    (tmp_path / "twin.toml").write_text(f"robot = 'ur10e'\n[camera]\n{pose}\n")
    monkeypatch.chdir(tmp_path)
    line = Line(LATENCY, "camera latency [ms]", (Magnitude(0.0, "ms"),))
    monkeypatch.setattr(robustness, "KNOWN_LINES", {LATENCY: line})
    words = ("--axes", LATENCY, "--plant", plant, "--robot", robot, "--controllers", "constant", "--seeds", "1",
             "--workers", "1")  # fmt: skip
    assert (
        servobench(
            monkeypatch, "robustness", *words, "--set", "random.duration=0.2", "--out", "map"
        )
        == 0
    )
    assert pd.read_csv("map/predicted_limits.csv")["controller"].to_list() == predicted


@pytest.mark.parametrize(
    ("robot", "settings", "reason"),
    [
        ("ur5 with cam.toml", {}, "before the bench's camera"),
        ("ur5", {"kinematic": {"overshoot": 0.1}}, "overshoot must be 0"),
    ],
)
def test_a_limit_that_cannot_be_predicted_is_a_remark(
    monkeypatch, tmp_path, caplog, robot, settings, reason
):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "cam.toml").write_text("matrix = [[615, 0, 320], [0, 615, 240], [0, 0, 1]]\n"
                                       "width = 640\nheight = 480\n")  # fmt: skip
    assert predicted_limits(["pid+true"], Settings(settings), robot) == {}
    assert "no latency limit is predicted for pid+true" in caplog.text
    assert reason in caplog.text


def test_limits_of_an_arm_without_a_model_are_those_of_methods_that_need_none():
    assert predicted_limits(["broyden"], Settings({}), "random_arm:7")["broyden"] > 0.0


def test_runs_of_a_map_that_failed_are_told(monkeypatch, tmp_path, capsys):
    line = Line(LATENCY, "camera latency [ms]", (Magnitude(0.0, "ms"),))
    monkeypatch.setattr(robustness, "KNOWN_LINES", {LATENCY: line})
    (tmp_path / "bad.py").write_text(
        WHOLE.replace("np.zeros(self.n)", "np.zeros(self.n) / undefined")
    )
    words = (
        "--axes",
        LATENCY,
        "--plant",
        "kinematic",
        "--controllers",
        str(tmp_path / "bad.py"),
        "--seeds",
        "2",
    )
    assert (
        servobench(
            monkeypatch, "robustness", *words, "--workers", "1", "--out", str(tmp_path / "out")
        )
        == 0
    )
    assert "2 of 2 runs failed; why: " in " ".join(capsys.readouterr().out.split())


def test_the_map_draws_no_panel_in_which_nothing_differs_and_names_it(tmp_path, figures):
    runs = [
        rows_of(axis, name, seeds=3)
        for axis in ("links", "tool")
        for name in ("ukf_mfac", "ukf_mpc", "rls")
    ]
    runs += [rows_of("noise", name, seeds=3) for name in ("ukf_mfac", "ukf_mpc")]
    runs.append(rows_of("noise", "rls", never=(4.0, 8.0), seeds=3))
    draw_map(pd.DataFrame([row for rows in runs for row in rows]), tmp_path, {})
    success = figures[0]
    assert [axes.get_xlabel() for axes in success.axes] == ["sensor noise [times the usual]"]
    note = success.get_suptitle().replace("\n", " ")
    assert (
        "every method has 100 (interval from 44) throughout: link lengths wrong by up to 30 %; tool wrong"
        in note
    )
    (axes,) = success.axes
    drawn = {line.get_label(): line for line in axes.get_lines() if len(line.get_xdata())}
    # To scale, without any shift
    assert np.asarray(drawn["rls"].get_xdata()).tolist() == [0, 1, 2, 4, 8]
    assert np.asarray(drawn["rls"].get_ydata()).tolist() == [100, 100, 100, 0, 0]
    assert "ukf_mpc" not in drawn
    assert (
        axes.texts[0].get_text().replace("\n", " ") == "one line, 100 throughout: ukf_mfac, ukf_mpc"
    )
    assert [text.get_text() for text in success.legends[0].get_texts()] == [
        "ukf_mfac",
        "ukf_mpc",
        "rls",
    ]
    assert "half of the runs or more never settle" in figures[1].get_suptitle()


def test_a_map_of_another_arm_and_pixels_has_them_everywhere_and_its_own_prediction():
    cells = map_cells(replace(SMALLEST, robot="panda", sensings=("stereo:hand",)))
    assert {(cell.request.robot, cell.request.sensing) for cell in cells} == {
        ("panda", "stereo:hand")
    }
    fast = Settings({"pid+constant": {"law": {"proportional_gain": 9.0}}})
    limits = [
        predicted_limits(["pid+constant"], fast, robot)["pid+constant"]
        for robot in ("ur5", "panda")
    ]
    assert 0.0 < limits[1] < 0.25
    assert limits[0] != limits[1]
