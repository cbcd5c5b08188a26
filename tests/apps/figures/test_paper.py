"""Tables and methods of a results folder in LaTeX."""

import math
import re
import shutil

import pandas as pd
import pytest

from kit.command import carried_out, servobench
from kit.folders import made_up_row, sweep
from servobench.harness.analysis.comparison import NO_ESTIMATE, Estimate
from servobench.harness.analysis.folder import describe_folder, titled_runs
from servobench.harness.analysis.latex import latex_tables, methods_paragraph
from servobench.harness.analysis.tables import (
    Cell,
    JudgedPlace,
    PValue,
    Statistics,
    judge_places,
)
from servobench.harness.apps.figures.figures import Choice, folder_figures
from servobench.harness.batch.api import compare
from servobench.harness.batch.results import ResultsFolder, load_runs, load_steps
from servobench.harness.config.installation import read_checkout, short_commit

ROWS = [
    {
        "controller": Cell("ukf_mfac"),
        "settled [%]": Cell(Estimate(100.0, 83.9, 100.0, 20), ".1f"),
        "its worst 5 % [mm]": Cell(math.inf, ".1f"),
    },
    {
        "controller": Cell("my & own"),
        "settled [%]": Cell(NO_ESTIMATE, ".1f"),
        "its worst 5 % [mm]": Cell(Estimate(-0.5, -1.0, 2.0, 20), ".1f"),
    },
]
PAIRS = [
    {
        "A − B": Cell("a − b"),
        "mean difference in settling time [s]": Cell(0.25, ".2f"),
        "p (Holm)": Cell(PValue(0.0004, 0.0312), ".3f"),
    }
]
PAGE = r"""\documentclass[conference]{IEEEtran}
\usepackage{booktabs}
\begin{document}
%s
\end{document}
"""


def place(words, measure="settling time [s]"):
    pairs = [{name.replace("settling time [s]", measure): cell for name, cell in PAIRS[0].items()}]
    return JudgedPlace(words, ROWS, pairs, measure, "0.05 s")


def test_a_table_has_headings_in_lines_units_below_and_every_sign_escaped():
    controllers, pairs = latex_tables(Statistics([place("100 % of a_task")], 3), "my results")
    assert r"medians and failures: 100 \% of a\_task}\label{tab:my-results-settled}" in controllers
    assert r"\begin{tabular}{@{}lrr@{}}\toprule" in controllers
    assert r"its worst\\{}5~\%\\{}[mm]" in controllers
    assert r"ukf\_mfac & 100.0 {\scriptsize [83.9, 100.0]} & $\infty$ \\" in controllers
    assert r"my \& own & -- & $-$0.5 {\scriptsize [$-$1.0, 2.0]} \\" in controllers
    caption = r"\caption{Paired differences, p corrected (Holm) over the 1 verdict shown, 3 in this"
    assert caption in pairs
    assert r"a\_task: settling time [s], margin 0.05 s}\label{tab:my-results-pairs}" in pairs
    assert r"a $-$ b & 0.25 & $<$0.001 (0.031) \\" in pairs


def test_places_with_the_same_columns_share_a_table():
    places = [place("exp1"), place("exp2", "overshoot [%]")]
    controllers, pairs = latex_tables(Statistics(places, 2), "out")
    for table, last in ((controllers, r"& -- & $-$0.5"), (pairs, "a $-$ b")):
        assert table.count(r"\begin{tabular}[b]") == 3
        first, second = table.split(r"\midrule")[1:]
        assert r"\multicolumn{3}{@{}l}{\itshape exp1" in first
        assert r"\multicolumn{3}{@{}l}{\itshape exp2" in second
        assert last in first
        assert last in second
    assert r"exp2: overshoot [\%], margin 0.05 s" in pairs


@pytest.fixture(scope="module")
def printed(tmp_path_factory):
    """The LaTeX of two short runs in which a setting is not the default."""
    out = tmp_path_factory.mktemp("paper") / "out"
    compare(
        ["constant", "calibrated"],
        tasks=["exp2"],
        seeds=2,
        settings={"exp2": {"duration": 2.0}},
        out=out,
    )
    return out


def test_the_paragraph_on_methods_has_versions_seeds_and_changed_settings_alone(output_of, printed):
    text = output_of("statistics", printed, "--latex")
    assert r"All runs were made with servobench 0." in text
    assert re.search(r"Python 3\.\d+\.\d+, numpy [\d.]+, scipy [\d.]+\)", text)
    assert "Controllers: constant, calibrated; tasks: exp2; plant: kinematic (UR5)" in text
    assert "the same 2 random robots (seeds 0, 1; 4 runs)" in text
    assert (
        "any controller can have): without aids: constant; with all aids but model: calibrated."
        in text
    )
    assert "Varied" not in text
    assert "Settings other than the defaults: exp2.duration = 2." in text
    assert "@misc{servobench," in text
    commit, _ = read_checkout()
    assert f"(commit {short_commit(commit)}, Python" in text
    assert f"commit {short_commit(commit)}}}" in text
    assert "Holm's correction (1 verdict shown, 1 in this folder)" in text


def test_names_stand_in_all_tables_and_beside_those_of_servobench_in_the_methods(
    output_of, printed
):
    names = ("--controllers", "calibrated,constant", "--names", "constant=Fixed $J$")
    text = output_of("statistics", printed, "--latex", *names)
    assert r"calibrated $-$ Fixed \$J\$" in text
    assert "Controllers: calibrated, Fixed \\$J\\$ (constant); tasks: exp2" in text
    assert "without aids: Fixed \\$J\\$." in text
    assert r"\label{tab:out-settled}" in text
    text = output_of("statistics", printed, "--latex", "--controllers", "constant")
    assert "Controllers: constant; tasks" in text
    assert "seeds 0, 1; 2 runs" in text
    assert "calibrated" not in text.partition("@misc")[0]


def methods(manifest, runs):
    """Return the paragraph on all controllers of some runs."""
    return methods_paragraph(
        manifest, runs, judge_places(runs), {name: name for name in runs["controller"].unique()}
    )


def test_the_paragraph_on_methods_names_what_a_sweep_varies(tmp_path):
    folder = sweep(tmp_path / "sweep")
    assert ". Settings of the runs: latency [ms] 0, 50. " in methods(
        ResultsFolder(folder).manifest, load_runs(folder)
    )


def test_latex_tells_what_all_runs_share_and_a_camera_of_a_file():
    own = {"latency_s": 0.15, "noise_factor": 4.0, "plant.lag": 0.12, "period_s": math.nan}
    runs = pd.DataFrame([made_up_row("a", seed=seed, **own) for seed in (3, 4)])
    robot = {"name": "ur10e with lab/cam.toml", "title": "UR10e"}
    text = methods({"robots": [robot], "changed": {}}, runs)
    assert ". Settings of the runs: noise factor 4; latency [ms] 150; plant.lag 0.12. " in text
    assert "(UR10e with cam.toml)" in text
    usual = methods({"changed": {}}, pd.DataFrame([made_up_row("a", noise_factor=1.0)]))
    assert "Settings of the runs" not in usual


def test_the_paragraph_on_methods_names_python_alone_where_no_packages_are_listed():
    runs = pd.DataFrame([made_up_row("a", seed=3)])
    text = methods({"python": "3.11.7", "created": "2026-11-28"}, runs)
    start = r"All runs were made with servobench unknown~\cite{servobench} "
    assert rf"\paragraph{{Methods}} {start}(commit unknown, Python 3.11.7). Controllers: " in text
    assert "the same 1 random robot (seeds 3; 1 runs)" in text
    assert "All settings are in the file manifest.json of the results." in text
    assert "year = {2026}" in text
    versions = {"packages": {"numpy": "2.2.1", "scipy": None}, "engines": {"bullet": "Bullet 3"}}
    text = methods({"python": "3.11.7", **versions}, runs)
    assert "(commit unknown, Python 3.11.7, numpy 2.2.1, Bullet 3)" in text


def test_the_paragraph_on_methods_says_that_robots_are_those_of_a_twin(tmp_path):
    twin, out = tmp_path / "twin.toml", tmp_path / "out"
    pose = "pose = {frame = 'base', position = [0.4, 0.1, 2.2], rotation = [0, 0, 0, 1]}"
    twin.write_text(f"robot = 'ur5'\n[camera]\n{pose}\n", encoding="utf-8")
    short = {"exp2": {"duration": 0.5}}
    compare(
        ["constant"], tasks=["exp2"], robot=str(twin), mismatches=["none"], settings=short, out=out
    )
    runs = titled_runs(ResultsFolder(out))
    text = methods(ResultsFolder(out).manifest, runs)
    assert (
        "(UR5 twin); sensing: position; mismatch between true and nominal robot: drawn from the twin. "
        in text
    )
    (drawn,) = folder_figures(ResultsFolder(out), Choice(["errors"]))
    assert drawn.title.endswith("kinematic, mismatch drawn from the twin, seed 0")
    assert describe_folder(ResultsFolder(out).manifest, runs)["mismatch"] == "drawn from the twin"
    assert [title for title, _ in judge_places(runs).tables()] == [
        "exp2 on kinematic, drawn from the twin"
    ]
    pytest.importorskip("cv2")
    from servobench.harness.apps.films import film, replay

    shown = replay.logged_run(load_runs(out).to_dict("records")[0], load_steps(out))
    assert film._title(shown).endswith("mismatch drawn from the twin, seed 0")


@pytest.mark.skipif(shutil.which("pdflatex") is None, reason="there is no TeX")
def test_a_page_of_a_paper_can_be_typeset_with_what_is_printed(
    monkeypatch, capsys, printed, tmp_path
):
    servobench(monkeypatch, "statistics", str(printed), "--latex")
    (tmp_path / "page.tex").write_text(PAGE % capsys.readouterr().out)
    made = carried_out(
        "pdflatex", "-interaction=nonstopmode", "-halt-on-error", "page.tex", cwd=tmp_path
    )
    if "IEEEtran.cls' not found" in made.stdout or "booktabs.sty' not found" in made.stdout:
        pytest.skip("this TeX has no IEEEtran or no booktabs")
    assert made.returncode == 0, made.stdout[-2000:]
    assert (tmp_path / "servobench.bib").read_text().startswith("@misc{servobench,")
