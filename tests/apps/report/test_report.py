"""The report: a page of every kind of folder, which works in a browser without a network; and the notebook."""

import json
import re
from pathlib import Path

import pandas as pd
import pytest

from kit.browser import browser_page, find_browser
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
from servobench.harness.apps.report import page as report
from servobench.harness.batch import results
from servobench.harness.batch.results import ResultsFolder
from servobench.plant.contract.checksums import write_vouched
from servobench.plant.contract.faults import ConfigurationError

RUN = ("run", "constant", "--plant", "kinematic", "--set", "exp2.duration=0.5", "--no-figures")
needs_browser = pytest.mark.skipif(
    find_browser() is None, reason="no Chromium: the report is not opened in a browser"
)


@pytest.fixture(scope="module")
def compared(tmp_path_factory):
    """A real, small comparison with its report, and what the command said."""
    out = tmp_path_factory.mktemp("compared") / "out"
    with pytest.MonkeyPatch.context() as patch:
        arguments = [
            "--plants",
            "kinematic",
            "--controllers",
            "constant,calibrated",
            "--tasks",
            "exp2",
        ]
        quick = ["--set", "exp2.duration=2", "--workers", "1", "--no-figures"]
        assert servobench(patch, "compare", *arguments, *quick, "--out", str(out)) == 0
    return out


@pytest.fixture(scope="module")
def swept(tmp_path_factory):
    folder = sweep(tmp_path_factory.mktemp("swept") / "out")
    report.write_report(ResultsFolder(folder))
    return folder


def notebook_cells():
    notebook = json.loads((Path(__file__).parents[3] / "notebooks" / "analysis.ipynb").read_text())
    return [cell for cell in notebook["cells"] if cell["cell_type"] == "code"]


def test_the_notebook_is_committed_without_outputs():
    assert all(
        cell["outputs"] == [] and cell["execution_count"] is None for cell in notebook_cells()
    )


def test_the_notebook_shows_every_kind_of_figure_of_the_report():
    calls = re.findall(
        r"show_pictures\((\".*\")\)",
        "\n".join("".join(cell["source"]) for cell in notebook_cells()),
    )
    assert set(", ".join(calls).split(", ")) == {
        f'"{name}"' for name, kind in report.KINDS.items() if kind.in_page
    }


def small_comparison(folder: Path) -> Path:
    return comparison(folder, CONTROLLERS[:2], ("exp1", "circle"))


@pytest.mark.parametrize("folder", [small_comparison, sweep, failed_only])
def test_the_notebook_runs_on_every_kind_of_folder(monkeypatch, capsys, tmp_path, folder):
    monkeypatch.setenv("SERVOBENCH_RESULTS", str(folder(tmp_path / "out")))
    names: dict[str, object] = {"__name__": "notebook"}
    for cell in notebook_cells():
        exec(compile("".join(cell["source"]), "analysis.ipynb", "exec"), names)
    assert "HTML object" in capsys.readouterr().out


def test_a_comparison_ends_with_a_report_that_holds_everything_in_itself(compared):
    page = (compared / report.NAME).read_text()
    assert len(page) < 5e6
    assert not re.search(r'<(script|link|img)[^>]+(src|href)="(?!data:)', page)
    assert page.count('<img class="drawn"') >= 5


def test_a_folder_with_failed_runs_only_gives_an_honest_report(tmp_path):
    page = report.write_report(ResultsFolder(failed_only(tmp_path / "out"))).read_text()
    assert "ended exp1 on kinematic early: crashed." in page
    assert "of which 0 reached the last period" in page
    assert "ValueError: no such thing" in page
    assert 'id="moves"' not in page
    assert 'id="space"' not in page


def test_a_folder_of_many_runs_stays_small_and_shows_what_went_wrong_first(tmp_path):
    fine = [made_up_row(f"fine-{i}", seed=i, outcome="settled") for i in range(1200)]
    lost = made_up_row("lost", seed=9999, outcome="joint_at_limit")
    steps = [made_up_steps(row["run_id"], periods=30) for row in fine[::400]]
    path = report.write_report(ResultsFolder(write_folder(tmp_path / "out", [*fine, lost], steps)))
    page = path.read_text()
    assert path.stat().st_size < 1.5e6
    assert page.count('<tr id="run-') == report.SHOWN_RUNS
    assert '<tr id="run-1200"' in page
    assert f"The page shows {report.SHOWN_RUNS} of 1201 runs" in page


def test_the_path_of_the_report_is_told_at_the_end(output_of, monkeypatch, tmp_path):
    made = []
    monkeypatch.setattr(
        report,
        "write_report",
        lambda folder, out: made.append(folder.path) or (folder.path / results.RUNS),
    )
    *_, last = output_of(*RUN, "--report", "--out", tmp_path / "a").strip().splitlines()
    assert last.startswith(f"report: {tmp_path / 'a'}")
    assert "report:" not in output_of(*RUN, "--out", tmp_path / "b")
    assert made == [tmp_path / "a"]


def test_runs_whose_report_fails_are_kept_and_the_failure_is_told(output_of, monkeypatch, tmp_path):
    def fail(folder, out):
        raise ConfigurationError(f"report on {folder.path}: out of luck")

    monkeypatch.setattr(report, "write_report", fail)
    assert "no report: report on" in output_of(*RUN, "--report", "--out", tmp_path / "out")
    assert len(results.load_runs(tmp_path / "out")) == 1


def test_a_folder_with_further_tables_shows_them(tmp_path):
    folder = write_folder(tmp_path / "out", [made_up_row("a")], [])
    pd.DataFrame({"claim": ["converges faster"], "answer": ["not reproduced"]}).to_csv(
        folder / "claims.csv"
    )
    page = report.write_report(ResultsFolder(folder), tmp_path / "page.html").read_text()
    assert "not reproduced" in page
    assert not (folder / report.NAME).exists()


def test_a_folder_that_cannot_be_reported_is_one_line(refusal_of, tmp_path):
    empty = comparison(tmp_path / "empty")
    write_vouched(empty, {results.RUNS: pd.read_parquet(empty / results.RUNS).iloc[:0].to_parquet})
    assert "holds no finished run" in refusal_of("report", empty)


def test_a_page_that_cannot_be_written_is_named(monkeypatch, tmp_path):
    monkeypatch.setattr(report, "_page", lambda folder, runs: "page")
    with pytest.raises(
        ConfigurationError, match=r"report .*none/page.html cannot be written: No such file"
    ):
        report.write_report(
            ResultsFolder(comparison(tmp_path / "out")), tmp_path / "none" / "page.html"
        )


@needs_browser
def test_the_browser_would_have_noticed(tmp_path):
    bad = tmp_path / "bad.html"
    bad.write_text('<script>missing()</script><img src="http://127.0.0.1:9/picture.png">')
    with browser_page(tmp_path / "profile") as page:
        page.open(bad)
        assert any("missing" in complaint for complaint in page.complaints())
        assert page.requests() == ["http://127.0.0.1:9/picture.png"]
