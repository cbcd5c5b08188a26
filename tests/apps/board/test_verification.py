"""Runs that are carried out again: honest ones recur, and code that knew more than its observations is named."""

import json
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from kit.command import python, servobench
from kit.own import WHOLE, write
from servobench.harness.apps.board.code import find_code
from servobench.harness.apps.board.submission import HEAD
from servobench.harness.apps.board.verification import Given, draw, first_difference, recheck
from servobench.harness.batch.api import compare
from servobench.harness.batch.results import RUNS, STEPS, ResultsFolder
from servobench.harness.batch.schema import MANIFEST
from servobench.plant.contract.checksums import SUMS
from servobench.plant.contract.faults import ConfigurationError

HONEST = WHOLE.replace("np.zeros(self.n)", "0.1 * np.sin(np.arange(self.n) + observation.time)")
BY_THE_WAY = {  # what a controller does in its step -> words of the finding
    "open('/tmp/servobench-test-note', 'a').close()": "opens the file /tmp/servobench-test-note",
    "import subprocess; subprocess.run(['true'])": "starts a program",
    "import os; os.system('true')": "starts a program",
    "[each.close() for each in __import__('socket').socketpair()]": "uses the network",
}
KNOWING = {  # how it gets a number that is not in its observations
    "chance": "np.random.default_rng().random()",
    "global chance": "np.random.rand()",
    "clock": "__import__('datetime').datetime.now().timestamp() % 1.0",
    "memory": "next(Mine.count)",
    "robot": "self.truth()",
}
PEEKING = """
    def truth(self):
        try:
            raise ValueError
        except ValueError as error:
            frame = error.__traceback__.tb_frame
        while "rollout" not in frame.f_locals and frame.f_back is not None:
            frame = frame.f_back
        rollout = frame.f_locals.get("rollout")
        return 0.0 if rollout is None else float(rollout.plant.truth().feature[0])

    count = __import__("itertools").count()
"""

pytestmark = pytest.mark.usefixtures("own_folder")


def made(folder, text, seeds=1):
    write(folder, text)
    compare(["./mine.py"], tasks=["exp1"], seeds=seeds, out=folder / "out")
    return ResultsFolder(folder / "out")


def findings_of(folder, count=9):
    return hold(folder, {"Mine": find_code("./mine.py")}, count)


def hold(folder, codes, count=1):
    found = []
    recheck(folder, draw(folder.runs(), count), Given(codes), found.append)
    return found


def again(folder, name, change):
    """Change a file of a results folder, and its checksum."""
    path = folder.path / name
    if name == MANIFEST:
        path.write_text(json.dumps(change(json.loads(path.read_text()))))
    else:
        change(pd.read_parquet(path)).to_parquet(path, index=False)
    (folder.path / SUMS).unlink(missing_ok=True)
    return ResultsFolder(folder.path)


def test_runs_of_methods_and_of_own_code_recur_bit_for_bit(tmp_path):
    write(tmp_path, HONEST)
    compare(["ukf_mfac", "calibrated", "./mine.py"], tasks=["exp1"], out=tmp_path / "out")
    said = python(
        "-m", "servobench", "verify", "out", "--rerun", 3, "--controller", "Mine=./mine.py",
        path=tmp_path,
    )  # fmt: skip
    assert said.returncode == 0, said
    assert said.stdout.count("6.3 runs recur: kinematic-") == 3
    assert said.stdout.endswith("findings: 0 wrong, 0 unknown\n")
    misspelt = ("--rerun", 1, "--controller", "Mien=./mine.py")
    said = python("-m", "servobench", "verify", "out", *misspelt, path=tmp_path)
    assert said.returncode == 2, said
    assert "no run of out is of 'Mien': did you mean 'Mine'" in said.stderr


@pytest.mark.parametrize("code", BY_THE_WAY)
def test_code_that_reaches_out_is_named_though_its_commands_are_the_same(tmp_path, code):
    folder = made(
        tmp_path, HONEST.replace("        return serv", f"        {code}\n        return serv")
    )
    wrong = [each for each in findings_of(folder) if each.verdict == "failed"]
    assert [each.clause for each in wrong] == ["1.3"], wrong
    assert BY_THE_WAY[code] in wrong[0].text


@pytest.mark.parametrize("name", ["sub/../mine.py", "link/mine.py"])
def test_code_is_its_own_by_any_path(tmp_path, name):
    (tmp_path / "sub").mkdir()
    (tmp_path / "link").symlink_to(tmp_path)
    own = "        open(__file__).close()\n        return serv"
    folder = made(tmp_path, HONEST.replace("        return serv", own))
    found = hold(folder, {"Mine": find_code(f"./{name}")}, 9)
    assert {each.verdict for each in found} == {"ok"}, found


def test_rows_of_several_sensings_follow_from_their_own_steps(tmp_path):
    folder = tmp_path / "out"
    compare(["constant"], tasks=["exp1"], seeds=1, sensings=["position", "pixel"], out=folder)
    opened = ResultsFolder(folder)
    found = hold(opened, {})
    assert {each.verdict for each in found} == {"ok"}, found
    of_pixels = opened.steps(["kinematic-pixel-constant-exp1-moderate-0"])
    features = [name for name in of_pixels if name.startswith(("reference_", "true_feature_"))]
    assert features
    assert all(name.endswith("_px") for name in features)


@pytest.mark.parametrize("what", KNOWING)
def test_commands_from_more_than_the_observations_are_found(tmp_path, what):
    text = HONEST.replace("np.arange(self.n) +", f"np.arange(self.n) + {KNOWING[what]} +")
    folder = made(tmp_path, text + PEEKING, seeds=2)
    wrong = [each for each in findings_of(folder) if each.verdict == "failed"]
    assert {each.clause for each in wrong} == {"1.4"}, what


def test_an_edited_metric_contradicts_its_steps(tmp_path):
    folder = made(tmp_path, HONEST)
    folder = again(folder, RUNS, lambda runs: runs.assign(rms_error=0.5 * runs["rms_error"]))
    wrong = [each for each in findings_of(folder, 1) if each.verdict == "failed"]
    assert wrong[0].clause == "6.2"
    assert "rms_error" in wrong[0].text


def test_a_log_that_no_plant_made_is_found_though_its_row_fits(tmp_path):
    forging = """

from servobench.harness.run.log import StepLog

steps = StepLog.steps


def nearer(self):
    rows = steps(self)
    rows.true_feature[:] += 0.5 * (rows.reference - rows.true_feature)
    return rows


StepLog.steps = nearer
"""
    folder = made(tmp_path, HONEST)
    honest = folder.runs()["rms_error"][0]
    (tmp_path / "other").mkdir()
    write(tmp_path / "other", HONEST + forging)
    said = python(
        "-c",
        "import servobench; servobench.compare(['./mine.py'], tasks=['exp1'], out='out')",
        path=tmp_path / "other",
    )
    assert said.returncode == 0, said
    forged = ResultsFolder(tmp_path / "other" / "out")
    assert forged.runs()["rms_error"][0] == pytest.approx(honest / 2)
    found = hold(forged, {"Mine": find_code(str(tmp_path / "other" / "mine.py"))})
    verdicts = {each.clause: each.verdict for each in found}
    assert verdicts["6.2"] == "ok"  # the row fits the log
    assert verdicts["6.4"] == "failed"


@pytest.mark.parametrize("column", ["joint_velocity_command_elbow_rad_s", "feature_x_m"])
def test_steps_that_lack_a_column_are_a_finding(tmp_path, column):
    folder = made(tmp_path, HONEST)
    folder = again(folder, STEPS, lambda steps: steps.drop(columns=column))
    wrong = {each.clause for each in findings_of(folder, 1) if each.verdict == "failed"}
    assert wrong & {"1.4", "6.2", "6.4"}


def test_a_setting_of_the_manifest_with_which_the_run_was_not_made_is_found(tmp_path):
    def easier(manifest):
        manifest["configuration"]["kinematic"]["command_delay"] = 0.0
        return manifest

    folder = again(made(tmp_path, HONEST), MANIFEST, easier)
    wrong = [each for each in findings_of(folder, 1) if each.verdict == "failed"]
    assert [each.clause for each in wrong] == ["6.4"]


@pytest.mark.parametrize("fingerprint", [{}, {"blas": "another"}])
def test_another_arithmetic_hides_no_change_of_the_first_steps(tmp_path, fingerprint):
    folder = made(tmp_path, HONEST)
    folder = again(folder, MANIFEST, lambda each: {**each, "fingerprint": fingerprint})
    assert [each.verdict for each in findings_of(folder)] == ["unknown", "ok", "ok"]
    nearer = {"true_feature_x_m": lambda steps: 0.02 + steps["true_feature_x_m"]}
    folder = again(folder, STEPS, lambda steps: steps.assign(**nearer))
    assert ("6.4", "failed") in {each[:2] for each in findings_of(folder)}


def test_a_folder_without_a_fingerprint_is_unknown_and_not_refused(tmp_path):
    folder = made(tmp_path, HONEST)
    folder = again(folder, MANIFEST, lambda each: {**each, "fingerprint": {}})
    found = findings_of(folder, 1)
    assert found[0].verdict == "unknown"
    assert "no fingerprint" in found[0].text
    assert [each.verdict for each in found[1:]] == ["ok"] * 2


def test_code_that_the_folder_names_is_not_run(tmp_path):
    folder = made(tmp_path, HONEST)
    found = hold(folder, {})
    assert found[-1].verdict == "unknown"
    assert "name its controller by --controller Mine=FILE" in found[-1].text


def test_a_run_that_is_too_slow_here_or_there_is_unknown(tmp_path):
    folder = made(tmp_path, HONEST)
    folder = again(
        folder, RUNS, lambda runs: runs.assign(status="timed_out", outcome="timed_out", periods=0)
    )
    found = findings_of(folder)
    assert found[-1].verdict == "unknown"
    assert "a limit of the machine" in found[-1].text


def test_a_controller_that_knows_the_true_robot_is_not_carried_out_apart(tmp_path):
    folder = made(tmp_path, HONEST)
    entry = """
import dataclasses

config = dataclasses.make_dataclass("Config", (), frozen=True)
ENTRY = servobench.ControllerEntry("Mine", "", config, lambda _, knowledge: Mine(knowledge), needs_truth=True)
"""
    write(tmp_path, HONEST + entry)
    found = findings_of(folder)
    assert found[-1].verdict == "unknown"
    assert "asks for the true robot" in found[-1].text


def test_a_controller_that_fails_apart_as_it_did_recurs(tmp_path):
    failing = "if observation.time > 0.5: raise ValueError('no')"
    text = HONEST.replace("        return serv", f"        {failing}\n        return serv")
    folder = made(tmp_path, text)
    assert folder.runs()["status"].tolist() == ["crashed"]
    found = findings_of(folder)
    assert [each.verdict for each in found] == ["ok"] * 3, found


def test_the_first_difference_is_found_row_by_row():
    told = pd.DataFrame({"a": [1.0, np.nan, 3.0], "b": ["x", "y", "z"], "own": [0, 0, 0]})
    made_again = told.drop(columns="own")
    assert first_difference(told, made_again) is None
    other = made_again.assign(a=[1.0, np.nan, 4.0], b=["x", "-", "z"])
    found = first_difference(told, other)
    assert (found.row, found.column, found.told, found.made) == (1, "b", "y", "-")
    found = first_difference(told, other, ("b",))
    assert (found.row, found.column) == (2, "a")
    assert first_difference(told, other, ("b",), (0.5, 0.0)) is None
    assert first_difference(told, other[:2]).column == "rows"


def test_the_drawn_runs_are_those_of_the_table():
    runs = pd.DataFrame({"run_id": [f"run-{place}" for place in range(8)]})
    drawn = draw(runs, 3)
    assert drawn.equals(draw(runs, 3))
    assert len(drawn) == 3
    assert draw(runs, 99).equals(runs)
    others = {tuple(draw(runs.assign(seed=seed), 3)["run_id"]) for seed in range(9)}
    assert len(others) > 1


@pytest.mark.parametrize(
    ("given", "told"),
    [
        ("absent.py", "there is no file absent.py"),
        ("mine", "mine is no code: wanted a file .py, or a wheel"),
        ("mine.fmu", "mine.fmu is no code: wanted a file .py, or a wheel"),
    ],
)
def test_a_controller_is_a_file_or_a_wheel(tmp_path, monkeypatch, given, told):
    monkeypatch.chdir(tmp_path)
    Path("mine.fmu").write_text("")
    with pytest.raises(ConfigurationError, match=told):
        find_code(given)


def test_no_socket_can_be_opened_once_the_network_is_closed(tmp_path):
    code = """
import os, socket, subprocess, sys
from servobench.harness.apps.board.network import close_network

assert close_network()
for family in (socket.AF_INET, socket.AF_INET6):
    try:
        socket.socket(family)
    except PermissionError:
        print("refused")
a, b = socket.socketpair()
child = "import socket; socket.socket(socket.AF_INET)"
print("PermissionError" in subprocess.run([sys.executable, "-c", child], capture_output=True, text=True).stderr)
"""
    said = python("-c", code, path=tmp_path)
    assert said.stdout == "refused\nrefused\nTrue\n", said


def test_code_without_runs_to_carry_out_is_refused_in_one_line(tmp_path, monkeypatch, capsys):
    assert servobench(monkeypatch, "verify", "out", "--controller", "Mine=mine.py") == 2
    assert "give both" in capsys.readouterr().err
    for_one = ("--rerun", "1", "--controller", "mine.py")
    assert servobench(monkeypatch, "verify", "out", *for_one) == 2
    assert "--controller mine.py: wanted NAME=FILE" in capsys.readouterr().err
    write(tmp_path, HONEST)
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / HEAD).touch()
    monkeypatch.chdir(tmp_path)
    assert (
        servobench(monkeypatch, "verify", "out", "--rerun", "1", "--controller", "Mine=mine.py")
        == 2
    )
    assert "a submission, which brings its code" in capsys.readouterr().err
