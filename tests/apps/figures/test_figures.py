"""What figures show, on ensembles and tracks made by hand."""

import json
import math

import matplotlib as mpl
import numpy as np
import pandas as pd
import pytest
from matplotlib.figure import Figure

from kit.command import no_file_above
from kit.folders import made_up_row, made_up_steps, write_folder
from servobench.controllers.methods import METHODS
from servobench.harness.analysis.comparison import Estimate
from servobench.harness.apps.figures.measures import draw_measures, same_curves
from servobench.harness.apps.figures.paths import draw_paths
from servobench.harness.apps.figures.responses import draw_joint_motion, draw_moves, draw_tracking
from servobench.harness.apps.figures.style import (
    SETTLED,
    divisions,
    figure_style,
    method_styles,
    panel_grid,
    save_figure,
)
from servobench.harness.apps.figures.tracks import Track, load_ensembles, quantile, shown_until
from servobench.harness.batch import results, store
from servobench.harness.batch.results import ResultsFolder

STYLES = method_styles(METHODS)


def load(folder, rows, steps):
    write_folder(folder, rows, steps)
    return load_ensembles(ResultsFolder(folder), results.load_runs(folder))


def seeds_of(folder, factors, name="ukf_mfac", task="exp1", **values):
    """Return the ensemble of runs whose errors are those of `made_up_steps` times a factor."""
    rows = [
        made_up_row(f"r{i}", seed=i, controller=name, task=task, **values)
        for i in range(len(factors))
    ]
    steps = [made_up_steps(f"r{i}") for i in range(len(factors))]
    for table, factor in zip(steps, factors, strict=True):
        table["error_norm"] *= factor
    return load(folder, rows, steps)[task]


def lines_of(axes, label):
    return [line for line in axes.get_lines() if line.get_label() == label]


@pytest.mark.parametrize("share", [0.0, 0.1, 0.5, 0.77, 1.0])
def test_a_quantile_over_finite_runs_is_that_of_numpy(share):
    values = np.random.default_rng(0).random((7, 5))
    np.testing.assert_allclose(quantile(values, share), np.quantile(values, share, axis=0))


def test_a_run_that_ended_is_infinitely_far_in_a_quantile():
    values = np.array([[1.0, 1.0], [3.0, 3.0], [5.0, math.inf], [7.0, math.inf]])
    assert quantile(values, 0.5).tolist() == [4.0, math.inf]
    assert quantile(values, 0.0).tolist() == [1.0, 1.0]
    assert quantile(values[:3], 0.5).tolist() == [3.0, 3.0]


def test_runs_that_ended_before_their_first_period_count_in_curve_and_mark(tmp_path):
    rows = [made_up_row(f"r{i}", seed=i) for i in range(2)]
    rows += [
        made_up_row(f"r{i}", seed=i, status="crashed", periods=0, settling_time_s=np.nan)
        for i in range(2, 5)
    ]
    ensemble = load(tmp_path / "out", rows, [made_up_steps("r0"), made_up_steps("r1")])["exp1"][
        "ukf_mfac"
    ]
    assert len(ensemble.error) == 5
    assert np.isinf(quantile(ensemble.error, 0.5)).all()
    assert ensemble.settling_time == math.inf
    assert ensemble.mostly_ended


def test_the_error_over_time_is_the_median_of_all_seeds_and_a_band(tmp_path):
    ensembles = seeds_of(tmp_path / "out", [1.0, 2.0, 4.0])
    axes = draw_moves({"exp1": ensembles}, STYLES).axes[0]
    (line,) = lines_of(axes, "ukf_mfac")
    once = 500.0 * np.exp(-np.arange(60) / 10.0)
    np.testing.assert_allclose(line.get_ydata(), 2.0 * once)
    (band,) = axes.collections
    edges = band.get_paths()[0].vertices[:, 1]
    assert (edges.min(), edges.max()) == pytest.approx((1.2 * once[-1], 3.6 * once[0]))
    (mark,) = [line for line in axes.get_lines() if line.get_gid() == SETTLED]
    assert (mark.get_xdata()[0], mark.get_ydata()[0]) == (1.5, 5.0)
    assert axes.get_ylim()[0] == 0.5  # a tenth of the settling band


def test_a_run_that_ended_early_takes_its_seed_out_of_the_median(tmp_path):
    rows = [
        made_up_row(f"r{i}", seed=i, status="completed" if i else "feature_lost") for i in range(3)
    ]
    steps = [made_up_steps(f"r{i}", periods=60 if i else 5) for i in range(3)]
    (ensemble,) = load(tmp_path / "out", rows, steps)["exp1"].values()
    assert np.isinf(ensemble.error[0, 5:]).all()
    assert np.isfinite(quantile(ensemble.error, 0.5)).all()
    assert not ensemble.mostly_ended


def test_a_move_is_shown_for_one_and_a_half_settling_times_of_its_slowest_method(tmp_path):
    quick = seeds_of(tmp_path / "a", [1.0], settling_time_s=0.6)
    slow = seeds_of(tmp_path / "b", [1.0, 1.0, 1.0], "rls", settling_time_s=1.2)
    never = seeds_of(tmp_path / "c", [1.0], "broyden", settling_time_s=math.nan)
    assert shown_until(quick) == pytest.approx(0.9)
    assert shown_until(quick | slow | never) == pytest.approx(1.8)
    assert shown_until(never) == 59 * 0.05


@pytest.mark.parametrize(
    "mismatch", ["moderate+camera_move=45deg", "moderate+word_of_another_version=3deg"]
)
def test_a_camera_that_moved_is_marked_and_the_whole_move_is_shown(tmp_path, mismatch):
    drawn = json.dumps({"move_angle": 0.785})
    write_folder(
        tmp_path, [made_up_row("a", mismatch=mismatch, mismatch_values=drawn)], [made_up_steps("a")]
    )
    manifest = ResultsFolder(tmp_path).manifest | {
        "configuration": {"run": {"camera_moves_at": 0.5}}
    }
    store.write_manifest(tmp_path, manifest)
    ensembles = load_ensembles(ResultsFolder(tmp_path), results.load_runs(tmp_path))
    assert shown_until(ensembles["exp1"]) == 59 * 0.05
    axes = draw_moves(ensembles, STYLES).axes[0]
    assert lines_of(axes, "camera moves")[0].get_xdata()[0] == 1.5


def test_methods_as_published_have_a_panel_of_their_own_beside_the_upper_bounds(tmp_path):
    assert divisions(["ukf_mfac", "rls", "calibrated"]) == {"": ["ukf_mfac", "rls", "calibrated"]}
    names = ["ukf_mfac", "ukf_mfac:published", "calibrated"]
    wanted = {
        "with aids": ["ukf_mfac", "calibrated"],
        "as published": ["ukf_mfac:published", "calibrated"],
    }
    assert divisions(names) == wanted
    assert divisions(names[1:]) == {"": names[1:]}
    # A class of a user's may have none
    assert list(divisions([*names, "Mine"])) == ["others", "as published"]

    run_ids = [name.replace(":", ".") for name in names]
    rows = [
        made_up_row(run_id, controller=name) for run_id, name in zip(run_ids, names, strict=True)
    ]
    ensembles = load(tmp_path / "out", rows, [made_up_steps(run_id) for run_id in run_ids])
    panels = draw_moves(ensembles, STYLES).axes
    assert [axes.get_title() for axes in panels] == ["exp1, with aids", "exp1, as published"]
    for axes, labels in zip(panels, wanted.values(), strict=True):
        assert [
            line.get_label() for line in axes.get_lines() if line.get_label() in names
        ] == labels
    equipped, published = STYLES["ukf_mfac"], STYLES["ukf_mfac:published"]
    assert equipped.colour == published.colour
    assert (equipped.line, equipped.hollow, published.hollow) == ("-", False, True)


def test_many_methods_are_divided_evenly_with_the_bounds_in_each_part():
    many = [f"method_{i}" for i in range(10)]
    parts = divisions([*many, "calibrated"])
    assert parts == {"1 of 2": [*many[:5], "calibrated"], "2 of 2": [*many[5:], "calibrated"]}
    assert list(divisions([*many, "ukf_mfac:published"])) == [
        f"others {k} of 2" for k in (1, 2)
    ] + ["as published"]


def test_along_a_curve_the_error_is_a_root_mean_square_over_half_a_second(tmp_path):
    steps = made_up_steps("a", curve=True).assign(error_norm=np.tile([0.003, 0.004], 30))
    ensembles = load(
        tmp_path / "out", [made_up_row("a", task="circle", task_kind="curve")], [steps]
    )["circle"]
    figure = draw_tracking(ensembles, {"ukf_mfac": Track(made_up_row("a"), steps)}, STYLES)
    (line,) = lines_of(figure.axes[0], "ukf_mfac")
    np.testing.assert_allclose(line.get_ydata()[9:], np.sqrt(12.5))
    assert "RMS over 0.5 s" in figure.axes[0].get_ylabel()


def test_paths_are_drawn_to_scale_in_two_views_that_share_the_abscissa():
    tracks = {"ukf_mfac": Track(made_up_row("a"), made_up_steps("a"))}
    front, side = draw_paths({"exp1": tracks}, STYLES).axes
    assert (front.get_title(), side.get_title()) == ("exp1: camera's view", "exp1: from the side")
    assert front.get_aspect() == side.get_aspect() == 1.0
    assert front.get_xlim() == side.get_xlim()
    assert front.yaxis_inverted()
    assert side.yaxis_inverted()  # the camera hangs above and looks down
    assert [axes.get_ylabel() for axes in (front, side)] == [
        "y, downwards [m]",
        "z, depth downwards [m]",
    ]
    for axes, row in ((front, 1), (side, 2)):
        (start,), (target,) = lines_of(axes, "start"), lines_of(axes, "target")
        assert (start.get_xdata()[0], start.get_ydata()[0]) == pytest.approx((0.3, 0.1 * row + 0.3))
        assert (target.get_xdata()[0], target.get_ydata()[0]) == pytest.approx((0.0, 0.1 * row))


def test_a_desired_curve_and_its_direction_are_drawn():
    row = made_up_row("a", task="circle", task_kind="curve")
    tracks = {"ukf_mfac": Track(row, made_up_steps("a", curve=True))}
    for axes in draw_paths({"circle": tracks}, STYLES).axes:
        assert len(lines_of(axes, "desired")[0].get_xdata()) == 60
        assert any(
            hasattr(text, "arrow_patch") and text.arrow_patch is not None for text in axes.texts
        )


def test_speed_acceleration_and_jerk_of_joints_stand_side_by_side_in_a_row_a_method():
    steps = made_up_steps("a").assign(joint_velocity_command_lift_rad_s=np.tile([1.0, -1.0], 30))
    row = made_up_row("a", command_switches=59.0, joint_jerk_rms_rad_s3=1131.4)
    figure = draw_joint_motion(
        {"ukf_mfac": Track(row, steps), "rls": Track(row, made_up_steps("b"))}, 2.0
    )
    speed, acceleration, jerk = figure.axes[:3]
    peaks = [
        float(np.abs(lines_of(axes, "lift")[0].get_ydata()).max())
        for axes in (speed, acceleration, jerk)
    ]
    assert peaks == pytest.approx([1.0, 40.0, 1600.0])
    assert speed.texts[0].get_text() == "59 sign switches"
    assert jerk.texts[0].get_text() == "RMS 1.13e+03"
    assert [axes.get_ylabel() for axes in figure.axes[::3]] == ["ukf_mfac", "rls"]
    assert speed.get_xlim()[1] == 2.0


def test_moves_that_never_settled_stand_at_the_edge_and_are_counted():
    times = [1.0, 2.0, math.nan, 3.0]
    runs = pd.DataFrame(
        [made_up_row(str(i), seed=i, settling_time_s=time) for i, time in enumerate(times)]
    )
    figure = draw_measures(runs, "settling", STYLES)
    axes = figure.axes[0]
    assert [text.get_text() for text in axes.texts] == ["1 of 4"]
    points, middle = axes.get_lines()
    assert np.asarray(points.get_xdata()).tolist() == pytest.approx(
        [1.0, 2.0, axes.get_xlim()[1], 3.0]
    )
    assert middle.get_xdata()[0] == 2.5
    assert "never settled" in figure.get_supxlabel()


def test_only_curves_with_the_same_intervals_are_one_line():
    one, other = Estimate(100.0, 88.0, 100.0, 30), Estimate(100.0, 44.0, 100.0, 3)
    assert same_curves({"a": [one, one], "b": [one, other], "c": [one, one]}) == [["a", "c"], ["b"]]


def test_a_name_that_the_font_lacks_is_drawn_without_a_word(tmp_path):
    with figure_style():
        figure = Figure()
        figure.text(0.5, 0.5, "\x00\U0001f600")
    assert [path.name for path in save_figure(figure, tmp_path / "a", ["png"])] == ["a.png"]


def test_a_style_of_the_user_changes_no_picture(tmp_path):
    table = pd.DataFrame({"controller": ["mfac", "ukf"], "settling_time_s": [1.0, 2.0]})
    own = {
        "font.size": 30.0,
        "text.usetex": True,
        "axes.facecolor": "black",
        "figure.autolayout": True,
        "savefig.dpi": 7,
    }
    for folder, style in (("plain", {}), ("own", own)):
        with mpl.rc_context(style):
            with figure_style():
                figure, (panel,) = panel_grid(1, 2.0)
                panel.scatter(table["controller"], table["settling_time_s"])
            save_figure(figure, tmp_path / folder / "a", ["pdf", "png"])
    for name in ("a.pdf", "a.png"):
        assert (tmp_path / "own" / name).read_bytes() == (tmp_path / "plain" / name).read_bytes()


@pytest.mark.parametrize("ending", ["png", "pdf", "svg"])
def test_a_figure_for_which_there_is_no_room_is_named_and_the_old_one_stays(ending, tmp_path):
    path = tmp_path / f"a.{ending}"
    path.write_text("old")
    figure = Figure()
    figure.subplots().plot([0.0, 1.0])
    with no_file_above(1000), pytest.raises(OSError, match="File too large") as caught:
        save_figure(figure, tmp_path / "a", [ending])
    assert caught.value.filename == str(path)
    assert [(each.name, each.read_text()) for each in tmp_path.iterdir()] == [(path.name, "old")]


def test_settling_times_of_equal_methods_stand_side_by_side_below_the_band(tmp_path):
    times = {"rls": 1.02, "ukf_mfac": 1.0, "broyden": 1.01, "constant": 1.5, "rbf_pid": math.nan}
    ensembles = {}
    for name, time in times.items():
        ensembles |= seeds_of(tmp_path / name, [1.0], name, settling_time_s=time)
    axes = draw_moves({"exp1": ensembles}, method_styles(list(times))).axes[0]
    marks = [line for line in axes.get_lines() if line.get_gid() == SETTLED]
    places = [mark.get_transform().transform(mark.get_xydata())[0] for mark in marks]
    assert np.diff(places, axis=0)[:2] == pytest.approx(
        np.array([[6.5, 0.0]] * 2) * axes.figure.dpi / 72
    )
    band = axes.transData.transform([(1.5, 5.0)])[0]
    assert places[3][0] == pytest.approx(band[0])
    assert all(y < band[1] for _, y in places)
