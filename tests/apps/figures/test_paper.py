"""Tables and methods of a results folder in LaTeX."""

import re
import shutil

import pandas as pd
import pytest

from kit.command import carried_out, servobench
from kit.folders import made_up_row, sweep
from servobench.harness.analysis.folder import describe_folder, titled_runs
from servobench.harness.analysis.latex import latex_tables, methods_paragraph
from servobench.harness.analysis.tables import statistics_tables
from servobench.harness.apps.figures.figures import Choice, folder_figures
from servobench.harness.batch.api import compare
from servobench.harness.batch.results import ResultsFolder, load_runs, load_steps

TABLE = pd.DataFrame(
    {
        "controller": ["ukf_mfac", "my & own"],
        "settled [%]": ["100.0 [83.9, 100.0]", "–"],
        "its worst 5 % [mm]": ["∞", "-0.5 [-1.0, 2.0]"],
    }
)
PAIRS = pd.DataFrame({"A − B": ["a − b"], "verdict": ["better"]})
PAGE = r"""\documentclass[conference]{IEEEtran}
\usepackage{booktabs}
\begin{document}
%s
\end{document}
"""


def test_a_table_has_headings_in_lines_units_below_and_every_sign_escaped():
    table, pairs = latex_tables([("100 % of a_task", TABLE), ("paired differences", PAIRS)])
    assert r"\caption{100 \% of a\_task}" in table
    assert r"\begin{tabular}{@{}lrr@{}}\toprule" in table
    assert r"its worst\\{}5~\%\\{}[mm]" in table
    assert r"ukf\_mfac & 100.0 {\scriptsize [83.9, 100.0]} & $\infty$ \\" in table
    assert r"my \& own & -- & $-$0.5 {\scriptsize [$-$1.0, 2.0]} \\" in table
    assert r"\caption{100 \% of a\_task: paired differences}" in pairs
    assert r"a $-$ b & better \\" in pairs


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


def test_the_paragraph_on_methods_names_what_a_sweep_varies(tmp_path):
    folder = sweep(tmp_path / "sweep")
    assert ". Varied: latency [ms] 0, 50. " in methods_paragraph(
        ResultsFolder(folder).manifest, load_runs(folder)
    )


def test_the_paragraph_on_methods_names_python_alone_where_no_packages_are_listed():
    runs = pd.DataFrame([made_up_row("a", seed=3)])
    text = methods_paragraph({"python": "3.11.7", "created": "2026-11-28"}, runs)
    start = r"All runs were made with servobench unknown~\cite{servobench} "
    assert rf"\paragraph{{Methods}} {start}(commit unknown, Python 3.11.7). Controllers: " in text
    assert "the same 1 random robot (seeds 3; 1 runs)" in text
    assert "All settings are in the file manifest.json of the results." in text
    assert "year = {2026}" in text
    versions = {"packages": {"numpy": "2.2.1", "scipy": None}, "engines": {"bullet": "Bullet 3"}}
    text = methods_paragraph({"python": "3.11.7", **versions}, runs)
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
    text = methods_paragraph(ResultsFolder(out).manifest, runs)
    assert (
        "(UR5 twin); sensing: position; mismatch between true and nominal robot: drawn from the twin. "
        in text
    )
    (drawn,) = folder_figures(ResultsFolder(out), Choice(["errors"]))
    assert drawn.title.endswith("kinematic, mismatch drawn from the twin, seed 0")
    assert describe_folder(ResultsFolder(out).manifest, runs)["mismatch"] == "drawn from the twin"
    assert [title for title, _ in statistics_tables(runs)] == [
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
