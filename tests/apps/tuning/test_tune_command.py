"""`servobench tune` as a user meets it."""

import os
import signal

import pytest

from kit.command import finish, servobench, start, wait_for
from kit.tuning import read_tuned
from servobench.harness.apps.tuning import objective
from servobench.harness.apps.tuning.spaces import default_values, find_tunable, nested_settings

SHORT = [
    "--controllers",
    "rls",
    "--robots",
    "1",
    "--studies",
    "1",
    "--workers",
    "1",
]


pytestmark = pytest.mark.usefixtures("short_runs")


def test_tuning_leaves_studies_and_values_and_goes_on_with_more_trials(
    output_of, monkeypatch, tmp_path
):
    out = tmp_path / "out"
    told = " ".join(output_of("tune", *SHORT, "--trials", "1", "--out", out).split())
    assert (
        "at most 1 method × 1 studies × 1 trials × 8 runs = 8 runs; --controllers, --studies, --trials"
        in told
    )
    first = read_tuned(out / "rls.toml")
    assert first.settings == nested_settings(default_values(find_tunable("rls")))
    assert first.score == first.score_of_defaults
    assert servobench(monkeypatch, "tune", *SHORT, "--trials", "2", "--out", str(out)) == 0
    second = read_tuned(out / "rls.toml")
    assert (second.studies[0].trials, second.score_of_defaults) == (2, first.score)
    assert sorted(path.name for path in out.iterdir()) == [
        "rls.jsonl",
        "rls.second.jsonl",
        "rls.toml",
    ]


def test_a_folder_with_other_things_and_one_of_another_study_are_left_alone(
    refusal_of, monkeypatch, tmp_path
):
    note = tmp_path / "note.txt"
    note.write_text("mine")
    for out in (tmp_path, note):
        line = refusal_of("tune", *SHORT, "--trials", "1", "--out", out)
        assert "exists already and holds no study; name another folder with --out" in line
    out = str(tmp_path / "out")
    assert servobench(monkeypatch, "tune", *SHORT, "--trials", "1", "--out", out) == 0
    line = refusal_of("tune", *SHORT, "--trials", "1", "--out", out, "--offset", "40")
    assert "rls.jsonl was made with other robots; name another folder with --out" in line


@pytest.mark.slow
def test_a_plant_of_the_user_is_tuned_on_and_another_version_of_it_refused(
    output_of, refusal_of, tmp_path
):
    output_of("new", "plant", "cell", "--folder", tmp_path)
    words = (
        "tune",
        *SHORT,
        "--trials",
        "1",
        "--plants",
        tmp_path / "cell.py",
        "--out",
        tmp_path / "out",
    )
    output_of(*words)
    assert read_tuned(tmp_path / "out" / "rls.toml").score < objective.WORST
    with (tmp_path / "cell.py").open("a") as file:
        file.write("Cell.advance = None")
    assert "rls.jsonl was made with other plants" in refusal_of(*words)
    output_of(*words[:-1], tmp_path / "lost", code=2)
    assert sorted(path.name for path in (tmp_path / "lost").iterdir()) == [
        "rls.jsonl",
        "rls.second.jsonl",
    ]


def test_ctrl_c_keeps_the_study(tmp_path):
    out = tmp_path / "out"
    arguments = (
        "tune",
        "--controllers",
        "constant",
        "--robots",
        "1",
        "--workers",
        "2",
        "--trials",
        "500",
    )
    process, ledger = start(*arguments, "--out", str(out)), out / "constant.jsonl"
    wait_for(lambda: ledger.exists() and ledger.read_text().count('"costs"') >= 2)
    os.killpg(process.pid, signal.SIGINT)
    code, output = finish(process)
    assert code == 130, output
    assert "Traceback" not in output
    assert (
        f"servobench: interrupted: finished points are kept in {out}; the same call continues"
        in output
    )
    assert [path.name for path in out.iterdir()] == ["constant.jsonl"]
    assert ledger.read_text().count('"costs"') >= 2
