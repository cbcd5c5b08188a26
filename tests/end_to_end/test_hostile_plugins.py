"""What a plug-in does to one run costs no other run, whichever command carries the runs out."""

from pathlib import Path

import pytest

from kit.command import finish, start
from kit.own import install
from kit.tuning import read_tuned
from servobench.harness.batch import results

HOSTILE = """
import os
import time
from dataclasses import replace

from servobench.plant.kinematic import ENTRY as KINEMATIC

HOW = os.environ["HOSTILE"]


def build(config, setup):
    plant = KINEMATIC.build(config, setup)
    share = 4 if HOW == "hang" else 2  # one of so many robots, and not the start at which plug-ins are tried
    if int(abs(setup.start[0]) * 1e4) % share != 1:
        return plant
    if HOW == "build":
        raise RuntimeError("no licence")
    step, close = plant.step, plant.close

    def attack(command):
        if HOW == "exit":
            os._exit(9)
        while HOW == "hang":
            time.sleep(0.1)
        return step(command)

    def fail():
        close()
        raise RuntimeError("the window is gone")

    plant.step = attack
    if HOW == "close":
        plant.close = fail
    return plant


ENTRY = replace(KINEMATIC, name="hostile", build=build)
"""


def place(words: str, function: str) -> str:
    """Return how a reason names the line of the plug-in that raises with `words`."""
    line = next(i for i, line in enumerate(HOSTILE.splitlines(), 1) if f'("{words}")' in line)
    return f"(hostile.py:{line} in {function})"


REASONS = {
    "exit": (
        "crashed",
        "the run killed the process that carried it out: exit code 9, in the period from 0 s on",
    ),
    "build": ("crashed", f"RuntimeError: no licence {place('no licence', 'build')}"),
    "close": ("crashed", f"RuntimeError: the window is gone {place('the window is gone', 'fail')}"),
    "hang": ("timed_out", "the run took longer than 8 s"),
}
LINES = {"build": 2, "close": 2, "hang": 1}  # of the trace of a run that name the plug-in
COMMANDS = {
    "compare": (
        "--no-figures",
        "--no-report",
        "--tasks",
        "random",
        "--seeds",
        "4",
        "--set",
        "random.duration=1",
    ),
    "sweep": ("--seeds", "4", "--set", "random.duration=1"),
    "tune": ("--robots", "1", "--studies", "1", "--trials", "1"),
}


@pytest.fixture
def plugin(tmp_path) -> Path:
    """A third party's plant, installed as far as Python can tell."""
    return install(
        tmp_path / "site", "hostile", HOSTILE, "[servobench.plants]\nhostile = hostile:ENTRY\n"
    )


@pytest.mark.parametrize(
    ("command", "how", "workers"),
    [
        ("compare", "exit", "1"),
        ("sweep", "build", "1"),
        ("sweep", "close", "1"),
        ("tune", "hang", "2"),
    ],
)
def test_a_run_that_fails_is_a_row_and_takes_no_other_run_with_it(
    plugin, tmp_path, command, how, workers
):
    out = tmp_path / "out"
    arguments = (
        "--plants",
        "hostile",
        "--controllers",
        "constant",
        "--workers",
        workers,
        *COMMANDS[command],
    )
    limit = ("--run-timeout", "3" if command == "tune" else "8") if how == "hang" else ()
    code, output = finish(
        start(command, *arguments, *limit, "--out", str(out), path=plugin, HOSTILE=how)
    )
    assert code == 0, output
    assert "Traceback" not in output
    if command == "tune":
        assert 0.0 < read_tuned(out / "constant.toml").score < 2.0
        assert "2.0" in (out / "constant.jsonl").read_text()
        return
    runs = results.load_runs(out)
    failed = runs[runs["status"] != "completed"]
    assert len(runs) == 4
    assert 0 < len(failed) < 4
    assert set(zip(failed["status"], failed["reason"], strict=True)) == {REASONS[how]}
    assert not (out / results.PARTS).exists()
    log = (out / results.FAILURES).read_text()
    assert [
        line.split(":")[0] for line in log.splitlines() if line.startswith("hostile-")
    ] == failed["run_id"].tolist()
    assert log.count("hostile.py") == LINES.get(how, 0) * len(failed)
