"""Metrics of users: functions of the steps of a run, in every command that shows metrics."""

import json
import pickle
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from kit.folders import comparison
from servobench.harness.analysis.comparison import compare_pairs, margin
from servobench.harness.analysis.tables import Selection, judge_places
from servobench.harness.apps.figures import figures
from servobench.harness.batch import trials
from servobench.harness.batch.measuring import add_metric
from servobench.harness.batch.results import ResultsFolder, load_runs, load_steps
from servobench.harness.config.registry import offered, offering
from servobench.harness.run import own_metrics
from servobench.harness.run.metrics import METRICS
from servobench.plant.contract.faults import ConfigurationError

MINE = '''
import os
import numpy as np
import servobench

@servobench.metric(unit="m·s²", better="less", margin=0.01)
def itae(steps):
    """Time-weighted absolute error."""
    time = steps["time_s"]
    return np.trapezoid(time * steps["error_norm"], time)

@servobench.metric(unit="1")
def raises(steps):
    return steps["nothing"].sum()

@servobench.metric(unit="1")
def odd(steps):
    if steps["run_id"].iloc[0].endswith("-1"):
        raise ValueError("an odd\\nseed")
    return 1.0

@servobench.metric(unit="1")
def text(steps):
    return "fast"

@servobench.metric(unit="1")
def whole(steps):
    return steps["error_norm"]

@servobench.metric(unit="1")
def endless(steps):
    return float("inf")

@servobench.metric(unit="1")
def unknown(steps):
    return float("nan")

@servobench.metric(unit="1")
def exits(steps):
    os._exit(3)

@servobench.metric(unit="1")
def hangs(steps):
    while True:
        pass

@servobench.metric(unit="1")
def overshoot(steps):
    return 1.0

@servobench.metric(unit="", better="more")
def spoils(steps):
    steps["error_norm"] = 1.0
    return steps["error_norm"].mean()

def plain(steps):
    return 1.0
'''
WRONG = (
    ("mine.py:raises", "raises has no value: KeyError: 'nothing' (mine.py:14 in raises)"),
    ("mine.py:text", "text must return a finite number or NaN, got a str (mine.py:"),
    ("mine.py:whole", "whole must return a finite number or NaN, got a Series (mine.py:"),
    ("mine.py:endless", "endless must return a finite number or NaN, got inf (mine.py:"),
    ("mine.py:unknown", "--metric mine.py:unknown: unknown is NaN in every run"),
    ("mine.py:exits", "it ended the process with exit code 3; raise an error instead"),
    ("mine.py:hangs", ": no answer after 4 s; is there a loop without an end"),
    ("mine.py:overshoot", "has a column overshoot already; give yours another name, such as my_ov"),
    ("mine.py:plain", "plain is the function plain, wanted a function below @servobench.metric("),
    ("mine.py:ita", "mine.py has no 'ita': did you mean 'itae'?"),
    ("mine.py", "mine.py defines itae, raises,"),
    ("mene.py:itae", "there is no file mene.py: did you mean 'mine.py'?"),
    ("higher.py:m", "higher.py:2: ConfigurationError: servobench.metric: better must be one of"),
    ("bare.py:m", "bare.py:2: TypeError: metric() takes 0 positional arguments"),
    ("empty.py", "empty.py defines no metric: wanted a function below @servobench.metric("),
    ("itae", "the table has no column of numbers 'itae'"),
)
SHORT = ("--plants", "kinematic", "--tasks", "exp2", "--set", "exp2.duration=1", "--controllers")


@pytest.fixture
def files(own_folder):
    for name, content in {
        "mine.py": MINE,
        "higher.py": "import servobench\n@servobench.metric(unit='1', better='higher')\ndef m(s): 1",
        "bare.py": "import servobench\n@servobench.metric\ndef m(s): 1",
        "empty.py": "",
    }.items():
        Path(name).write_text(content, encoding="utf-8")


def itae_of(steps):
    """Compute the metric in another way: a sum over trapezoids."""
    times, weighted = steps["time_s"].to_numpy(), (steps["time_s"] * steps["error_norm"]).to_numpy()
    return float((np.diff(times) * 0.5 * (weighted[1:] + weighted[:-1])).sum())


@pytest.mark.slow
def test_a_metric_is_computed_with_the_runs_and_shown_wherever_metrics_are(
    files, output_of, monkeypatch, tmp_path
):
    plans = figures._plans
    # Other figures take most of the time and show no metric of users
    monkeypatch.setattr(
        figures, "_plans", lambda *words: (each for each in plans(*words) if each.kind == "own")
    )
    words = ("constant,ukf_mfac", "--seeds", "2", "--metric", "./mine.py:itae", "--out", "out")
    said = output_of("compare", *SHORT, *words)
    assert "itae [m·s²]" in said
    runs, steps = load_runs(tmp_path / "out"), load_steps(tmp_path / "out")
    for run_id, own in steps.groupby("run_id"):
        (found,) = runs.loc[runs["run_id"] == run_id, "itae"]
        assert found == pytest.approx(itae_of(own), rel=1e-12)
    record = json.loads((tmp_path / "out" / "manifest.json").read_text())["own_metrics"]["itae"]
    assert (record["function"], record["margin"], len(record["sha256"])) == ("itae", 0.01, 64)
    assert (tmp_path / "out" / "figures" / "own_kinematic_moderate.png").is_file()
    page = (tmp_path / "out" / "report.html").read_text(encoding="utf-8")
    assert page.count("itae") > 2
    assert "itae" not in METRICS  # for as long as the command takes
    said = output_of("statistics", "out", "--metric", "itae", "--markdown")
    assert "verdicts with a margin of 0.01 m·s²" in said
    assert "mean difference in itae [m·s²]" in said
    drawn = output_of("figures", "out", "--kind", "own", "--metric", "mine.py:odd", "--out", "new")
    assert drawn.split() == ["new/own_kinematic_moderate.pdf"]


@pytest.mark.slow
def test_in_a_sweep_a_metric_is_a_column_and_one_that_fails_costs_no_run(
    files, output_of, tmp_path
):
    words = ("constant", "--seeds", "3", "--metric", "mine.py:odd", "--metric", "late=mine.py:itae")
    said = output_of("sweep", *SHORT, *words, "--out", "out", "--workers", "2")
    assert "in 1 runs, first in kinematic-constant-exp2-moderate-1: odd has no value: Val" in said
    runs = load_runs(tmp_path / "out")
    assert runs["status"].tolist() == ["completed"] * 3
    assert runs["odd"].fillna(-1.0).tolist() == [1.0, -1.0, 1.0]
    assert (runs["late"] > 0.0).all()
    words = ("constant", "--seeds", "2", "--metric", "mine.py:exits", "--out", "dead")
    output_of("sweep", *SHORT, *words)
    assert load_runs(tmp_path / "dead")["status"].tolist() == ["crashed"] * 2


@pytest.mark.slow
def test_the_suite_shows_a_metric_beside_the_scores(files, output_of, tmp_path):
    words = ("--challenges", "severe", "--plants", "kinematic", "--controllers", "constant")
    said = output_of("suite", *words, "--seeds", "1", "--metric", "mine.py:itae", "--out", "out")
    assert "itae, m·s²" in " ".join(said.split())
    judged = pd.read_csv(tmp_path / "out" / "scores.csv")
    own = load_runs(tmp_path / "out" / "severe")
    assert judged["itae"].tolist() == pytest.approx(own["itae"].tolist(), rel=1e-9)


def test_steps_that_are_kept_give_a_metric_afterwards(files, tmp_path):
    folder = ResultsFolder(comparison(tmp_path / "out", tasks=("exp1",)))
    assert add_metric(folder, "itae=mine.py:itae") == "itae"
    steps = load_steps(tmp_path / "out")
    wanted = {run_id: itae_of(own) for run_id, own in steps.groupby("run_id")}
    runs = folder.runs()
    assert runs["itae"].tolist() == pytest.approx(runs["run_id"].map(wanted).tolist(), rel=1e-12)
    assert "itae" not in load_runs(tmp_path / "out")
    assert add_metric(folder, "mine.py:spoils") == "spoils"
    assert (folder.runs()["spoils"] == 1.0).all()


def test_other_code_of_the_same_name_is_told(files, tmp_path, caplog):
    folder = ResultsFolder(comparison(tmp_path / "out", tasks=("exp1",)))
    with offering():
        add_metric(folder, "mine.py:itae")
        before = folder.runs()["itae"]
        add_metric(folder, "mine.py:itae")  # the same code
    assert not caplog.messages
    (tmp_path / "mine.py").write_text(MINE.replace("(time * steps", "(2.0 * time * steps"))
    with offering():
        add_metric(folder, "mine.py:itae")
        assert "has itae by other code of mine.py:itae: it is computed anew" in caplog.text
        assert folder.runs()["itae"].tolist() == pytest.approx((2.0 * before).tolist())
    (tmp_path / "out" / "steps.parquet").unlink()
    (tmp_path / "out" / "SHA256SUMS").unlink()
    (tmp_path / "mine.py").write_text(MINE)
    with (
        offering(),
        pytest.raises(ConfigurationError, match="by other code of .*, and no steps of"),
    ):
        add_metric(folder, "mine.py:itae")


@pytest.mark.parametrize(("metric", "words"), WRONG, ids=[metric for metric, _ in WRONG])
def test_a_wrong_metric_is_one_right_line(files, refusal_of, monkeypatch, tmp_path, metric, words):
    monkeypatch.setattr("servobench.harness.batch.measuring.LIMIT", 4.0)
    comparison(tmp_path / "out", tasks=("exp1",))
    assert words in refusal_of("statistics", "out", "--metric", metric)


@pytest.fixture
def faster():
    """Runs of two controllers in which `a` has the larger speed on each robot."""
    rows = [
        {"plant": "p", "task": "t", "mismatch": "m", "status": "completed", "controller": name,
         "seed": seed, "task_kind": "point_to_point", "speed": speed + 0.01 * seed, "settling_time_s": 1.0}
        for name, speed in (("a", 3.0), ("b", 2.0)) for seed in range(8)
    ]  # fmt: skip
    return pd.DataFrame(rows)


@pytest.mark.parametrize(
    ("better", "verdict", "heading"),
    [
        ("more", "better", "P(A better)"),
        ("less", "worse", "P(A better)"),
        ("", "more", "P(A less)"),
    ],
)
def test_a_verdict_goes_by_the_direction_that_is_declared(faster, better, verdict, heading):
    with offering():
        own_metrics.declare_metrics(
            {"speed": {"unit": "rad/s", "better": better, "margin": 0.5, "digits": 1}}
        )
        names = {"a": "a", "b": "b"}
        (place,) = judge_places(faster, Selection(names, "speed")).places
        (row,) = place.pairs
        assert (str(row["verdict"]), place.margin) == (verdict, "0.5 rad/s")
        assert str(row["mean difference in speed [rad/s]"]) == "1.00 [1.00, 1.00]"
        assert row[heading].value.value == (1.0 if better == "more" else 0.0)
        own_metrics.declare_metrics({"speed": {"unit": "1", "better": "more", "digits": 1}})
        assert margin("speed", faster) == pytest.approx(0.2035)  # a tenth of b's median
        lost = faster.assign(speed=faster["speed"].where(faster["controller"] == "b"))
        assert (
            compare_pairs(lost, [("a", "b")], metric="speed", keys=("seed",))[0].verdict == "worse"
        )
    assert "speed" not in METRICS


@pytest.mark.parametrize(
    ("name", "change", "words"),
    [
        ("m", {"margin": -1.0}, "own metric m: margin must be at least 0"),
        ("m", {"digits": 10**9}, "own metric m: digits must be one of 0, 1"),
        ("m", {"unit": None}, "own metric m: unit must be"),
        ("overshoot", {}, "own metric overshoot: servobench has one of this name"),
    ],
)
def test_a_folder_that_declares_nonsense_is_refused(name, change, words):
    record = {"unit": "s", "better": "less", "digits": 1} | change
    with offering(), pytest.raises(ConfigurationError, match=words):
        own_metrics.declare_metrics({name: record})
    assert METRICS["overshoot"].unit == "1"


def test_a_metric_goes_to_other_processes_under_the_name_that_it_was_given(files):
    name = trials.choose("metric", "mine=mine.py:itae")
    (own,) = offered([name])
    entry = pickle.loads(pickle.dumps(own.entry))
    assert (entry.name, entry.declared, entry.function) == (
        "mine",
        own.entry.declared,
        own.entry.function,
    )
