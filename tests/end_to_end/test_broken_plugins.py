"""Broken plug-ins, installed as entry points: one right line each, in the lists, in a run and beside all others."""

import json
import os
import sys

import pytest

from kit.command import PACKAGE, carried_out
from kit.own import CELL, CONFIGURED, install, write
from servobench.harness.config.registry import RENDERED

POINTS = """[servobench.controllers]
whole = some_law:Mine
import-error = some_crash:ENTRY
half = some_law:Half
crash = some_law:Crash
gone = some_law:Nothing
a/b = some_law:Mine
circle = some_law:Mine
hang = some_law:Hang
ends = some_law:Ends
falls = some_law:Falls
import-ends = some_end:Mine
import-hangs = some_wait:Mine
ukf_mfac = some_law:Mine
all = some_law:Mine
[servobench.plants]
cell = some_cell:Cell
crashing = some_cell:Crash
ending = some_cell:Ends
needy = some_cell:NEEDY
bullet = some_cell:Cell
"""
LAWS = (
    CONFIGURED
    + """

print("a banner")


class Half(servobench.Controller):
    pass


class Crash(Mine):
    def __init__(self, knowledge):
        self.n = knowledge.size


class Hang(Mine):
    def __init__(self, knowledge):
        while True: time.sleep(0.1)


class Ends(Mine):
    def __init__(self, knowledge):
        os._exit(3)


class Falls(Mine):
    def __init__(self, knowledge):
        ctypes.string_at(0)
"""
).replace("import numpy", "import ctypes\nimport os\nimport time\n\nimport numpy")
MODULES = {
    "crash": "1 / 0\n",
    "end": "import os\n\nos._exit(0)\n",
    "wait": "import time\n\ntime.sleep(1000)\n",
}
CELLS = (
    CELL
    + """

class Crash(Cell):
    def __init__(self, setup):
        1 / 0


class Ends(Cell):
    def __init__(self, setup):
        import os

        os._exit(5)


NEEDY = servobench.PlantEntry("needy", "", dict, Cell, needs=("a_package_that_is_not_there",))
NEEDY = servobench.PlantEntry("needy", "", type(NEEDY), Cell)
"""
)
CONTROLLERS = {
    "import-error": "controller 'import-error' (some_crash:ENTRY) cannot be loaded: site/some_crash.py:1: "
    "ZeroDivisionError: division by zero",
    "half": "controller 'half' (some_law:Half) cannot be used: site/some_law.py:36: class Half lacks reset and step, "
    "which it must define",
    "crash": "controller crash: site/some_law.py:42: AttributeError: 'RobotKnowledge' object has no attribute 'size'",
    "gone": "controller 'gone' (some_law:Nothing) cannot be loaded: AttributeError: module 'some_law' has no attribute "
    "'Nothing'",
    "a/b": "controller 'a/b' (some_law:Mine) cannot be used: some_law:Mine: the name must be letters, digits and _, "
    "got 'a/b'",
    "circle": "a task is called 'circle', too; give the controller another name",
}
REMEDY = "raise an error instead, so that the other runs go on"
WAITS = "no answer after 3 s; is there a loop without an end, or something that waits?"
HARMFUL = {  # what only a process of its own survives
    "hang": f"controller 'hang' (some_law:Hang) cannot be used: site/some_law.py:47: {WAITS}",
    "ends": f"controller 'ends' (some_law:Ends) cannot be used: it ended the process with exit code 3; {REMEDY}",
    "falls": "controller 'falls' (some_law:Falls) cannot be used: site/some_law.py:57: it killed the process by "
    "SIGSEGV; compiled code wrote or read outside of its memory",
    "import-ends": "controller 'import-ends' (some_end:Mine) cannot be used: it ended the process with exit code 0; "
    f"{REMEDY}",
    "import-hangs": f"controller 'import-hangs' (some_wait:Mine) cannot be used: site/some_wait.py:3: {WAITS}",
}
PLANTS = {
    "crashing": "plant crashing: site/some_cell.py:37: ZeroDivisionError: division by zero",
    "ending": f"plant 'ending' (some_cell:Ends) cannot be used: it ended the process with exit code 5; {REMEDY}",
    "needy": "plant 'needy' (some_cell:NEEDY) cannot be used: ",
}
UNUSED = {
    "ukf_mfac": "controller 'ukf_mfac' (some_law:Mine) is not used: servobench has a controller of this name, which "
    "cannot be taken over",
    "all": "controller 'all' (some_law:Mine) is not used: the command line has another meaning for this name",
}
UNUSED_PLANT = (
    "plant 'bullet' (some_cell:Cell) is not used: "
    "servobench has a plant of this name, which cannot be taken over"
)
DRIVER = """
import contextlib, io, json, sys
from servobench.controllers import methods
from servobench.harness.batch import trials
from servobench.harness.cli.main import main
from servobench.harness.config import registry

trials.TRIAL_LIMIT = trials.IMPORT_LIMIT = 3.0
own = registry.CONTROLLER_REGISTRY.own
for name in set(own) - {"ukf_mfac", "constant", "nmpc_calibrated", "revealed"}:
    del own[name]
told = []
for arguments in json.loads(sys.argv[1]):
    out, err = io.StringIO(), io.StringIO()
    sys.argv = ["servobench", *arguments]
    with contextlib.redirect_stdout(out), contextlib.redirect_stderr(err):
        try:
            main()
        except SystemExit as stop:
            told.append((stop.code or 0, out.getvalue(), err.getvalue()))
print(json.dumps(told))
"""
SHORT = ("--set", "exp1.duration=0.3", "--task", "exp1", "--no-figures")
NAMED = [*CONTROLLERS, "whole", "ukf_mfac", "import-ends", "import-hangs"]
RUNS = {name: ["run", name, "--plant", "kinematic", *SHORT] for name in NAMED}
COMMANDS = {
    "controllers": ["controllers", "--json"],
    "plants": ["plants", "--json"],
    "compare": ["compare", "--controllers", "all", "--plants", "kinematic,cell", "--tasks", "exp1", "--out", "out",
                "--set", "exp1.duration=0.3", "--no-figures", "--no-report", "--workers", "1"],
    **RUNS,
    "run crashing": ["run", "constant", "--plant", "crashing", *SHORT],
    "run cell": ["run", "constant", "--plant", "cell", *SHORT],
    "settings of others": ["run", "constant", "--plant", "kinematic", "--config", "all.toml", "--out", "one", *SHORT],
    "show all plants": ["init", "--plants", "all", "--controllers", "constant", "-"],
}  # fmt: skip


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What each command answers in an environment with the plug-ins: exit code, output and errors."""
    folder = tmp_path_factory.mktemp("plugins")
    site = install(folder / "site", "some_law", LAWS, POINTS)
    write(site, CELLS, "some_cell.py")
    for name, text in MODULES.items():
        write(site, text, f"some_{name}.py")
    write(folder, "".join(f"[{name}]\ngain = 1\n" for name in ("import-error", "gone")), "all.toml")
    environment = {**os.environ, "PYTHONPATH": f"{PACKAGE}{os.pathsep}{site}", "COLUMNS": "400"}
    driver = sys.executable, "-c", DRIVER, json.dumps(list(COMMANDS.values()))
    done = carried_out(*driver, cwd=folder, env=environment, timeout=900)
    assert done.returncode == 0, done.stderr
    return dict(zip(COMMANDS, json.loads(done.stdout.splitlines()[-1]), strict=True))


def test_the_list_marks_each_and_shows_the_others(told):
    code, out, _ = told["controllers"]
    listed = [(each["name"], each.get("error")) for each in json.loads(out)]
    assert code == 0
    assert {name: error for name, error in listed if error and name in CONTROLLERS} == CONTROLLERS
    others = [error for _, error in listed if error and error not in CONTROLLERS.values()]
    assert others == [*HARMFUL.values(), *UNUSED.values()]
    assert [name for name, error in listed if error is None] == [
        "ukf_mfac",
        "constant",
        "nmpc_calibrated",
        "revealed",
        "whole",
    ]


def test_the_list_of_plants_marks_each_and_shows_the_others(told):
    code, out, _ = told["plants"]
    listed = [(each["name"], each.get("error")) for each in json.loads(out)]
    # An engine may be missing here, which is another error.
    errors = [
        error for name, error in listed if error and (name not in RENDERED or error == UNUSED_PLANT)
    ]
    assert code == 0
    assert errors[0] == PLANTS["crashing"]
    assert errors[1] == PLANTS["ending"]
    assert errors[2].startswith(PLANTS["needy"])
    assert errors[3:] == [UNUSED_PLANT]
    assert {"kinematic", "cell"} < {name for name, error in listed if error is None}


def test_all_others_are_compared_and_each_broken_one_is_a_line(told):
    code, out, errors = told["compare"]
    assert code == 0, errors
    left_out = [
        f"servobench: left out: {line}" for line in [*CONTROLLERS.values(), *HARMFUL.values()]
    ]
    notes = [f"servobench: note: {line}" for line in UNUSED.values()]
    lines = [line for line in errors.splitlines() if line.startswith("servobench: ")]
    assert sorted(lines) == sorted(left_out + notes)
    for name in ("whole", "ukf_mfac", "constant"):
        assert out.count(f" {name} ") == 2, out


@pytest.mark.parametrize("name", CONTROLLERS)
def test_a_run_of_it_is_refused_with_the_same_line(told, name):
    code, _, errors = told[name]
    assert code == 2, told[name]
    assert errors == f"servobench: {CONTROLLERS[name]}\n"


@pytest.mark.parametrize(
    ("name", "why"),
    [
        ("import-ends", f"it ended the process with exit code 0; {REMEDY}"),
        ("import-hangs", f"site/some_wait.py:3: {WAITS}"),
    ],
)
def test_a_run_of_one_whose_import_harms_the_process_is_refused(told, name, why):
    assert told[name] == [2, "", f"servobench: {name} cannot be imported: {why}\n"]


def test_what_is_whole_runs_beside_them(told):
    for name in ("whole", "run cell", "ukf_mfac"):
        assert told[name][0] == 0, told[name]
    assert UNUSED["ukf_mfac"] in told["ukf_mfac"][2]
    assert "not used" not in told["whole"][2]
    assert told["run crashing"][::2] == [2, f"servobench: {PLANTS['crashing']}\n"]
    code, out, errors = told["show all plants"]
    assert (code, "[cell.sensing]" in out) == (0, True), errors
    assert f"servobench: left out: {PLANTS['crashing']}" in errors
    assert f"servobench: note: {UNUSED_PLANT}" in errors


def test_settings_of_what_cannot_be_loaded_are_left_for_where_it_can(told):
    code, _, err = told["settings of others"]
    assert code == 0, err
