"""The figures of made-up folders: what is drawn, that it is labelled, and that oddities do not spoil it."""

import io
import re
import shutil
from base64 import b64decode
from pathlib import Path

import numpy as np
import pandas as pd
import pytest
from matplotlib.text import Text
from PIL import Image

from kit.command import servobench
from kit.folders import (
    CONTROLLERS,
    comparison,
    failed_only,
    made_up_row,
    made_up_steps,
    sweep,
    write_folder,
)
from servobench.harness.analysis.comparison import FROM_TWIN, split_tasks
from servobench.harness.apps.figures import style
from servobench.harness.apps.figures.figures import (
    KINDS,
    Choice,
    Order,
    draw_figures,
    folder_figures,
)
from servobench.harness.apps.figures.measures import draw_conditions
from servobench.harness.apps.figures.style import (
    ENDED,
    NARROW,
    TEXT,
    WIDE,
    Layout,
    drawing_of,
    figure_style,
    fitted,
    method_styles,
)
from servobench.harness.apps.figures.tracks import Track, load_groups
from servobench.harness.apps.report.page import path_views
from servobench.harness.batch import results, shares
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.registry import CONTROLLERS as KNOWN
from servobench.plant.contract.checksums import write_vouched

OTHERS = [f"method_{i}" for i in range(20)]


def kinds(folder):
    return [named.kind for named in folder_figures(ResultsFolder(folder))]


def drawn(folder):
    return draw_figures(Order(ResultsFolder(folder), folder / "figures"))


def legend_of(figure) -> list[str]:
    return [text.get_text() for legend in figure.legends for text in legend.get_texts()]


def test_every_method_has_a_line_and_marker_of_its_own_so_that_colour_is_not_needed():
    styles = method_styles([*KNOWN, *OTHERS])
    looks = {(str(style.line), style.marker) for style in styles.values()}
    assert len(looks) == len(KNOWN) + len(OTHERS)
    markers = [style.marker for name, style in styles.items() if name in OTHERS]
    assert len(set(markers)) == len(OTHERS)


def test_a_method_looks_the_same_whatever_stands_beside_it():
    for name in KNOWN:
        alone, among = method_styles([name])[name], method_styles([*OTHERS, *KNOWN])[name]
        assert (alone.colour, alone.line, alone.marker) == (among.colour, among.line, among.marker)


def test_marks_lie_evenly_along_a_path_and_not_in_time():
    points = np.zeros((100, 3))
    points[90:, 0] = np.arange(10.0)  # at rest, then moving
    marks = method_styles(["ukf_mfac"])["ukf_mfac"].path_arguments(points)["markevery"]
    assert marks[0] == 0
    assert min(marks[1:]) > 90
    assert len(marks) >= 7


def test_the_page_of_results_names_every_kind_of_figure_in_its_order():
    text = (
        (Path(__file__).parents[2] / "docs" / "results.md")
        .read_text(encoding="utf-8")
        .split("## Figures")[1]
    )
    assert re.findall(r"^\| `(\w+)` \|", text, re.MULTILINE) == list(KINDS)


def test_the_figures_of_a_comparison_have_a_unit_at_every_axis_and_every_controller(tmp_path):
    figures = list(folder_figures(ResultsFolder(comparison(tmp_path / "out"))))
    assert [named.kind for named in figures] == [
        "errors", "features", "paths", "tracking", "tracking_path", "jacobian", "settling", "effort", "smoothness",
        "joint_speeds", "joint_speeds", "joint_speeds",
    ]  # fmt: skip
    for named in figures:
        figure = named.figure
        figure.canvas.draw()
        assert figure.get_suptitle().startswith(named.title.split(":")[0]), named.stem
        if figure.subfigs:
            assert all("[" in part.get_supxlabel() for part in figure.subfigs), named.stem
        elif named.kind == "joint_speeds":
            assert all("[" in axes.get_title() for axes in figure.axes[:3])
            assert [axes.get_xlabel() for axes in figure.axes[-3:]] == ["time [s]"] * 3
        else:
            for axes in filter(lambda axes: axes.get_visible(), figure.axes):
                assert axes.get_xlabel() or not any(
                    label.get_visible() for label in axes.get_xticklabels()
                ), named.stem
                labels = [axes.get_xlabel(), axes.get_ylabel()]
                assert all("[" in label for label in labels if label), named.stem
        words = legend_of(figure)
        for axes in figure.axes:
            words += [axes.get_ylabel(), *(text.get_text() for text in axes.get_yticklabels())]
        assert set(CONTROLLERS) <= set(words), named.stem


def test_more_than_four_moves_go_into_several_figures(tmp_path):
    tasks = ("exp1", "exp2", "exp3", "exp4", "random")
    figures = list(
        folder_figures(ResultsFolder(comparison(tmp_path / "out", ("ukf_mfac",), tasks)))
    )
    assert [named.kind for named in figures].count("errors") == 2
    assert len({named.stem for named in figures}) == len(figures)


def test_a_page_has_each_task_apart_for_a_screen_and_for_a_phone_and_nothing_is_cut(tmp_path):
    names = ("ukf_mfac", "./a_folder/my_own_controller.py:MyVeryOwnController", *OTHERS[:9])
    folder = comparison(tmp_path / "out", names, ("exp1", "exp2"))
    choice = Choice(("errors", "paths", "settling"), layouts=(WIDE, NARROW), title=False)
    drawn = folder_figures(ResultsFolder(folder), choice)
    figures = list(zip(drawn, drawn, strict=True))
    assert [wide.tasks for wide, _ in figures if wide.kind == "errors"] == [("exp1",), ("exp2",)]
    assert all(wide.tasks == narrow.tasks and len(wide.tasks) == 1 for wide, narrow in figures)
    for wide, narrow in (pair for pair in figures if pair[0].tasks == ("exp1",)):
        for figure, layout in ((wide.figure, WIDE), (narrow.figure, NARROW)):
            assert (
                min(text.get_fontsize() for text in figure.findobj(Text) if text.get_text())
                >= TEXT - 2.0
            )
            figure.suptitle("")
            width = drawing_of(figure, layout).width
            assert width <= layout.pixels + 2
        columns = {
            round(axes.get_position().x0, 2) for axes in narrow.figure.axes if axes.get_visible()
        }
        assert len(columns) <= 2  # panels below each other, differing by the width of their numbers


def test_a_long_name_is_broken_where_it_can_be():
    assert fitted("rbf_pid:published", 20) == "rbf_pid:published"
    assert fitted("rbf_pid:published", 12) == "rbf_pid:\npublished"
    assert fitted("./a/b.py:Mine", 6) == "./a/\nb.py:\nMine"
    assert fitted("x" * 25, 10).splitlines() == ["x" * 10, "x" * 10, "x" * 5]


def test_figures_of_a_run_are_the_same_pictures_by_one_process_and_by_copies(tmp_path, monkeypatch):
    monkeypatch.setattr(shares, "available_processors", lambda: 3)
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac",), tasks=("exp1",))
    paths = drawn(folder)
    assert {path.suffix for path in paths} == {".png"}
    assert len(paths) == 5
    before = {path.name: path.read_bytes() for path in paths}
    monkeypatch.setattr(shares, "available_processors", lambda: 1)
    assert before == {path.name: path.read_bytes() for path in drawn(folder)}


def test_a_run_that_ended_after_three_periods_is_drawn_and_marked(tmp_path):
    folder = comparison(tmp_path / "out", tasks=("exp1",))
    runs, steps = pd.read_parquet(folder / results.RUNS), pd.read_parquet(folder / results.STEPS)
    first = runs["run_id"][0]
    runs.loc[0, "status"] = "feature_lost"
    short = steps[(steps["run_id"] != first) | (steps["step"] < 3)]
    write_vouched(folder, {results.RUNS: runs.to_parquet, results.STEPS: short.to_parquet})
    figures = list(folder_figures(ResultsFolder(folder)))
    marked = {named.kind for named in figures if ENDED in legend_of(named.figure)}
    assert {"errors", "paths", "jacobian"} <= marked
    assert any("hollow: the run ended early" in named.figure.get_supxlabel() for named in figures)


def test_a_single_period_and_missing_numbers_do_no_harm(tmp_path):
    short = made_up_steps("a", periods=1)
    gaps = made_up_steps("b")
    gaps[["jacobian_error", "error_norm"]] = np.nan
    gaps.loc[5:9, ["true_feature_x_m", "feature_x_m"]] = np.nan
    rows = [made_up_row("a", controller="ukf_mfac"), made_up_row("b", controller="rbf_pid")]
    folder = write_folder(tmp_path / "out", rows, [short, gaps])
    drawn = [drawing_of(named.figure) for named in folder_figures(ResultsFolder(folder))]
    assert drawn
    for picture, width, height in drawn:
        assert b64decode(picture).startswith(b"\x89PNG")
        assert min(width, height) > 100


def test_without_a_true_jacobian_its_error_has_no_figure_and_an_exact_one_is_told(tmp_path):
    unknown = made_up_steps("a")
    unknown["jacobian_error"] = np.nan
    assert "jacobian" not in kinds(
        write_folder(tmp_path / "unknown", [made_up_row("a")], [unknown])
    )
    exact = made_up_steps("a")
    exact["jacobian_error"] = 0.0
    folder = write_folder(tmp_path / "exact", [made_up_row("a", controller="calibrated")], [exact])
    (figure,) = [
        named.figure for named in folder_figures(ResultsFolder(folder)) if named.kind == "jacobian"
    ]
    assert legend_of(figure) == ["calibrated (exact)"]


def test_a_plant_with_other_features_and_joints_is_drawn_under_its_own_names(tmp_path):
    steps = made_up_steps("a", features=("sway_angle_rad", "trolley_m"))
    row = made_up_row(
        "a",
        plant="fmu:/some where/crane.toml",
        mismatch="none",
        task="target",
        feature_unit="rad",
        settling_band=0.1,
    )
    drawn = {
        named.kind: named
        for named in folder_figures(ResultsFolder(write_folder(tmp_path / "out", [row], [steps])))
    }
    assert set("".join(named.stem for named in drawn.values())) <= set(
        "abcdefghijklmnopqrstuvwxyz_0123456789."
    )
    errors, features, paths = (drawn[kind].figure for kind in ("errors", "features", "paths"))
    assert [axes.get_ylabel() for axes in errors.axes] == ["true error [rad]"]
    assert "settling band, 0.1 rad" in legend_of(errors)
    assert [axes.get_ylabel() for axes in features.axes] == [
        "measured\nsway_angle [rad]",
        "measured\ntrolley [m]",
    ]
    (axes,) = paths.axes
    assert (axes.get_xlabel(), axes.get_ylabel()) == ("sway_angle [rad]", "trolley [m]")
    assert axes.get_aspect() == "auto"


def test_a_single_feature_has_no_path(tmp_path):
    folder = write_folder(
        tmp_path / "out", [made_up_row("a")], [made_up_steps("a", features=("level_m",))]
    )
    found = set(kinds(folder))
    assert {"errors", "features"} < found
    assert "paths" not in found


def test_half_an_hour_is_drawn_with_few_points(tmp_path):
    kind, run_id = (
        {"task": "endurance", "task_kind": "curve"},
        "kinematic-ukf_mfac-endurance-moderate-0",
    )
    steps = made_up_steps(run_id, curve=True, periods=36_000)
    folder = write_folder(tmp_path / "out", [made_up_row(run_id, **kind)], [steps])
    lines = [
        line
        for named in folder_figures(ResultsFolder(folder))
        for axes in named.figure.axes
        for line in axes.get_lines()
    ]
    assert 100 < max(len(line.get_xdata()) for line in lines) <= 700
    assert (
        100 < str(path_views(ResultsFolder(folder), results.load_runs(folder))).count(",") < 20_000
    )


def test_an_overview_keeps_the_root_mean_square_error_and_a_closing_the_last_rows():
    steps = made_up_steps("a", curve=True, periods=12_000).assign(
        error_norm=np.tile([3.0, 4.0], 6000)
    )
    track = Track(made_up_row("a"), steps)
    overview, closing = track.overview(), track.closing()
    assert len(overview.table) == 600
    np.testing.assert_allclose(overview.error(), 1000.0 * np.sqrt(12.5))
    assert overview.time[[0, -1]].tolist() == [0.0, 0.05 * 11_980]
    assert closing.time.tolist() == track.time[-400:].tolist()
    short = Track(made_up_row("a"), steps.iloc[:6000])
    assert short.overview() is short.closing() is short.for_path() is short


@pytest.mark.parametrize(("folder", "wanted"), [(sweep, ["conditions.png"]), (failed_only, [])])
def test_a_folder_without_steps_has_no_figures_of_them(tmp_path, folder, wanted):
    assert [path.name for path in drawn(folder(tmp_path / "out"))] == wanted
    assert (tmp_path / "out" / "figures").exists() == bool(wanted)


def test_a_sweep_is_drawn_over_what_it_varies_and_a_lost_run_has_not_settled(tmp_path):
    moves, _ = split_tasks(results.load_runs(sweep(tmp_path / "out")))
    figure = draw_conditions(moves, method_styles(CONTROLLERS))
    labels = [axes.get_xlabel() for axes in figure.axes if axes.get_visible()]
    assert labels == ["latency [ms]", "camera rotation [deg]"]
    share = np.asarray(figure.axes[1].get_lines()[0].get_ydata(), dtype=float)
    assert "all methods" in figure.axes[1].texts[0].get_text().replace("\n", " ")
    np.testing.assert_allclose(share, [100.0, 100 * 4 / 6, 50.0])
    moves, _ = split_tasks(results.load_runs(comparison(tmp_path / "same")))
    assert draw_conditions(moves, method_styles(CONTROLLERS)) is None
    late, drawn = moves.assign(mismatch="jitter=50ms"), moves.assign(mismatch=FROM_TWIN)
    line = (
        draw_conditions(pd.concat([drawn, late]), method_styles(CONTROLLERS)).axes[0].get_lines()[0]
    )
    assert line.get_xdata().tolist() == [0.0, 50.0]


def test_noise_has_a_panel_of_its_own_only_where_it_is_crossed_with_another_axis(tmp_path):
    runs = results.load_runs(sweep(tmp_path / "out"))
    moves = split_tasks(runs)[0].assign(axis="links", magnitude=5.0, unit="%", latency_s=np.nan)
    turned = moves.assign(axis="tool", magnitude=9.0)

    def labels(table):
        figure = draw_conditions(table, method_styles(CONTROLLERS))
        return (
            None
            if figure is None
            else [axes.get_xlabel() for axes in figure.axes if axes.get_visible()]
        )

    assert (
        labels(pd.concat([moves.assign(noise_factor=0.0), turned.assign(noise_factor=4.0)])) is None
    )
    assert labels(
        pd.concat([each.assign(noise_factor=n) for each in (moves, turned) for n in (0.0, 4.0)])
    ) == ["noise factor"]


def test_a_picture_for_a_page_keeps_the_colour_of_each_method(tmp_path):
    moves, _ = split_tasks(results.load_runs(sweep(tmp_path / "out")))
    styles = method_styles(CONTROLLERS)
    with figure_style(TEXT):
        figure = draw_conditions(moves, styles)
    with Image.open(io.BytesIO(b64decode(drawing_of(figure, WIDE).data))) as picture:
        known = np.asarray(picture.convert("RGB")).reshape(-1, 3).astype(int)
    for name in moves["controller"].unique():
        wanted = [int(styles[name].colour[i : i + 2], 16) for i in (1, 3, 5)]
        assert np.abs(known - wanted).max(axis=1).min() <= 4, name


def test_one_seed_of_each_plant_and_mismatch_is_shown(tmp_path):
    rows = [made_up_row(f"run{seed}", seed=seed) for seed in (7, 3, 5)]
    folder = write_folder(tmp_path / "out", rows, [made_up_steps(row["run_id"]) for row in rows])
    (group,) = load_groups(ResultsFolder(folder), results.load_runs(folder))
    assert group.seed == 3
    assert group.tasks["exp1"]["ukf_mfac"].row["run_id"] == "run3"


def paper(monkeypatch, folder, *arguments):
    """Return the exit code of `servobench figures` for a column of a paper, and the files that it made."""
    out = folder.parent / "paper"
    code = servobench(
        monkeypatch, "figures", str(folder), "--width", "3.5in", "--out", str(out), *arguments
    )
    return code, sorted(out.glob("*")) if out.exists() else []


def test_every_figure_of_the_report_fits_a_column_of_a_paper(monkeypatch, tmp_path):
    folder = comparison(tmp_path / "out", ("ukf_mfac", "mine"), ("exp1", "circle"))
    wanted = {name for name, kind in KINDS.items() if kind.in_page} - {"conditions", "own"}
    words = ("--no-title", "--names", "Proposed,$K_p$ alone", "--kind", ",".join(wanted))
    code, files = paper(monkeypatch, folder, *words)
    assert code == 0
    assert {
        kind for kind in wanted if any(path.name.startswith(f"{kind}_") for path in files)
    } == wanted
    for path in files:
        content = path.read_bytes()
        assert re.search(rb"/MediaBox \[ ?0 0 (\S+) ", content)[1] == b"252", path.name
        assert b"/Type3" not in content


@pytest.mark.parametrize("width", [252.0, 516.0])
def test_a_figure_is_as_wide_as_a_column_of_ieeetran_or_both(tmp_path, width):
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac",), tasks=("exp1",))
    choice = Choice(
        ("errors",), {"ukf_mfac": "Mine"}, (Layout.of_width(f"{width:g}pt"),), title=False
    )
    (named,) = folder_figures(ResultsFolder(folder), choice)
    (path,) = style.save_figure(named.figure, tmp_path / "errors", ("pdf",), exact_width=True)
    points = float(re.search(rb"/MediaBox \[ ?0 0 (\S+) ", path.read_bytes())[1])
    assert 72.27 / 72.0 * points == pytest.approx(width, abs=1e-3)


def test_figures_show_the_chosen_controllers_by_their_new_names_in_their_usual_style(tmp_path):
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac", "mine", "rls"))
    choice = Choice(
        ("errors",),
        {"rls": "UKF+MFAC", "ukf_mfac": "Mine"},
        (Layout.of_width("89mm"),),
        title=False,
    )
    figures = list(folder_figures(ResultsFolder(folder), choice))
    assert [named.tasks for named in figures] == [("exp1",), ("exp2",)]
    for named in figures:
        assert named.figure.get_suptitle() == ""
        colours = {line.get_label(): line.get_color() for line in named.figure.axes[0].get_lines()}
        assert colours["UKF+MFAC"] == method_styles(["rls"])["rls"].colour
        assert colours["Mine"] == method_styles(["ukf_mfac"])["ukf_mfac"].colour
        assert "mine" not in colours


def test_figures_come_in_the_formats_that_are_asked_for_and_the_same_each_time(
    monkeypatch, tmp_path
):
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac",), tasks=("exp1",))
    _, files = paper(monkeypatch, folder, "--kind", "errors", "--format", "pdf,svg,png")
    before = {path.name: path.read_bytes() for path in files}
    assert [path.suffix for path in files] == [".pdf", ".png", ".svg"]
    _, files = paper(monkeypatch, folder, "--kind", "errors", "--format", "pdf,svg,png")
    assert before == {path.name: path.read_bytes() for path in files}


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="there is no TeX")
def test_a_figure_for_tex_has_the_width_of_the_column(monkeypatch, tmp_path):
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac",), tasks=("exp1",))
    _, (path,) = paper(monkeypatch, folder, "--kind", "errors", "--format", "pgf")
    width = re.search(
        r"\\pgfpathrectangle\{\\pgfpointorigin\}\{\\pgfqpoint\{([\d.]+)in", path.read_text()
    )[1]
    assert float(width) == pytest.approx(3.5)
    assert "ukf\\_mfac" in path.read_text()


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        (("--kind", "error"), "--kind: unknown 'error': did you mean 'errors'?"),
        (
            ("--controllers", "ukf_mfca"),
            "--controllers: unknown 'ukf_mfca': did you mean 'ukf_mfac'?",
        ),
        (("--names", "a,b"), "--names has 2 names for 1 controllers: ukf_mfac"),
        (("--width", "3.5"), "--width must be from 2in to 20in, as 3.5in, 89mm or 252pt, got 3.5"),
        (("--format", "eps"), "--format: unknown 'eps': "),
        (
            ("--format", "pgf"),
            "--format pgf needs a TeX while it is drawn, pdflatex, lualatex or xelatex, and there",
        ),
        (
            ("--kind", "tracking"),
            "has no figure of tracking: errors and paths are of moves, tracking is of curves",
        ),
    ],
)
def test_what_cannot_be_drawn_is_one_line(monkeypatch, capsys, tmp_path, arguments, line):
    monkeypatch.setattr(style.shutil, "which", lambda _: None)
    folder = comparison(tmp_path / "out", controllers=("ukf_mfac",), tasks=("exp1",))
    assert paper(monkeypatch, folder, *arguments) == (2, [])
    error = capsys.readouterr().err
    assert line in error
    assert error.count("\n") == 1
