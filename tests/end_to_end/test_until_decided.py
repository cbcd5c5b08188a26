"""A comparison that ends when it is decided says the same however it is interrupted or divided."""

import json
from pathlib import Path

import pandas as pd
import pytest

from kit.command import judged, servobench
from servobench.harness.analysis.decisions import DECISIONS
from servobench.harness.batch import results
from servobench.harness.batch.results import ResultsFolder

COMPARE = (
    "compare", "--until-decided", "--plants", "kinematic", "--controllers", "constant,broyden", "--tasks", "exp2",
    "--seeds", "48", "--workers", "1", "--no-figures", "--no-report", "--set", "exp2.duration=4",
    "--set", "run.period=0.1",
)  # fmt: skip


@pytest.fixture(scope="module")
def undisturbed(tmp_path_factory) -> Path:
    out = tmp_path_factory.mktemp("decided") / "whole"
    with pytest.MonkeyPatch.context() as patch:
        assert servobench(patch, *COMPARE, "--out", str(out)) == 0
    return out


@pytest.mark.slow
def test_it_ends_at_the_look_that_decides_and_says_so(undisturbed, capsys, monkeypatch):
    (row,) = pd.read_csv(undisturbed / DECISIONS).to_dict("records")
    assert row["verdict"] == "worse"
    assert isinstance(row["mean clipped difference"], float)
    assert row["seeds"] < 48
    assert len(results.load_runs(undisturbed)) == 2 * row["seeds"]
    assert ResultsFolder(undisturbed).manifest["until_decided"]["runs"] == 2 * row["seeds"]
    assert servobench(monkeypatch, "verify", str(undisturbed)) == 0
    assert servobench(monkeypatch, "statistics", str(undisturbed)) == 0
    told = capsys.readouterr().out
    assert results.STOPPED in told
    assert "constant − broyden" in told
    assert "--resume carries out" not in told


@pytest.mark.slow
def test_it_is_the_same_after_an_interruption(undisturbed, tmp_path, monkeypatch, capsys):
    out = tmp_path / "again"
    again = (*COMPARE, "--out", str(out), "--resume")
    assert servobench(monkeypatch, *COMPARE, "--part", "1/6", "--out", str(out)) == 0
    assert len(results.load_runs(out)) == 16
    assert servobench(monkeypatch, *again) == 0
    assert (out / DECISIONS).read_text() == (undisturbed / DECISIONS).read_text()
    one, other = (judged(results.load_runs(folder)) for folder in (out, undisturbed))
    pd.testing.assert_frame_equal(one, other, check_exact=True)
    capsys.readouterr()
    before = (out / results.RUNS).read_bytes()
    assert servobench(monkeypatch, *again) == 0
    assert (out / results.RUNS).read_bytes() == before
    assert "1 of 1 verdicts decided" in capsys.readouterr().out


@pytest.mark.slow
def test_parts_that_are_merged_and_resumed_give_the_same_verdict(
    undisturbed, tmp_path, monkeypatch
):
    folders = [str(tmp_path / f"{number}") for number in (1, 3)]
    for number, folder in zip((1, 3), folders, strict=True):
        assert servobench(monkeypatch, *COMPARE, "--part", f"{number}/3", "--out", folder) == 0
    merged = str(tmp_path / "merged")
    assert servobench(monkeypatch, "merge", *folders, "--out", merged) == 0
    assert servobench(monkeypatch, *COMPARE, "--resume", "--out", merged) == 0
    assert Path(merged, DECISIONS).read_text() == (undisturbed / DECISIONS).read_text()


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("--seeds", "8"), "got 8; give 200, for instance"),
        (("--controllers", "constant"), "constant are too few"),
        (("--against", "ukf_mfac"), "--against: unknown 'ukf_mfac'"),
        (("--first-seed-on", "mujoco"), "leave --first-seed-on away"),
    ],
)
def test_what_cannot_be_decided_is_one_line(words, message, tmp_path, refusal_of):
    assert message in refusal_of(*COMPARE, *words, "--out", tmp_path / "none")
    assert not (tmp_path / "none").exists()


def test_against_without_until_decided_is_refused(tmp_path, refusal_of):
    words = [word for word in COMPARE if word != "--until-decided"]
    told = refusal_of(*words, "--against", "constant", "--out", tmp_path / "none")
    assert "--against chooses the pairs of --until-decided" in told


@pytest.mark.slow
def test_another_question_is_another_batch(undisturbed, refusal_of):
    told = refusal_of(*COMPARE, "--against", "broyden", "--resume", "--out", undisturbed)
    assert "holds results of other runs or settings" in told
    assert json.loads((undisturbed / "manifest.json").read_text())["until_decided"]["worlds"] == 1
