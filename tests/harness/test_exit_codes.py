"""The exit codes of the table in docs/results.md, and what is printed with them."""

import errno
import re
import signal
import subprocess
import sys
import tempfile
import threading
from functools import partial
from pathlib import Path

import pytest

from kit.command import no_file_above, python, servobench
from kit.resting import Resting
from servobench.controllers.controller import ControllerEntry
from servobench.harness.batch import results
from servobench.harness.config.entries import CONTROLLER, NoSettings, own_object
from servobench.harness.config.registry import offering


class Ending(Resting):
    """Rests for three periods and then raises something."""

    def __init__(self, raised, knowledge):
        super().__init__(knowledge)
        self.raised = raised

    def step(self, observation, reference):
        if observation.time > 0.1:
            raise self.raised
        return super().step(observation, reference)


def ending(name: str, raised: BaseException) -> ControllerEntry:
    return ControllerEntry(name, "ends", NoSettings, lambda _, knowledge: Ending(raised, knowledge))


ENTRIES = (
    ending("crashing", KeyError("gain")),
    ending("leaving", SystemExit(3)),
    ending("interrupted", KeyboardInterrupt()),
)


@pytest.fixture
def call(monkeypatch, tmp_path, no_figures):
    """Return a function that runs a command in an empty folder and returns its exit code; it draws nothing."""
    monkeypatch.chdir(tmp_path)
    with offering([own_object(CONTROLLER, each) for each in ENTRIES]):
        yield partial(servobench, monkeypatch)


EXP2 = ("--set", "exp2.duration=0.5", "--out", "out")
RUN = ("run", "--plant", "kinematic", *EXP2, "--controller")
COMPARE = ("compare", "--tasks", "exp2", "--workers", "1", "--no-report", *EXP2, "--controllers")
SWEEP = ("sweep", "--tasks", "exp2", "--workers", "1", "--seeds", "2", *EXP2, "--controllers")


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        ((*RUN, "constant"), 0),
        ((*RUN, "crashing"), 1),
        ((*RUN, "leaving"), 1),
        ((*RUN, "interrupted"), 130),
        ((*COMPARE, "constant,crashing"), 0),
        ((*COMPARE, "constant,crashing", "--strict"), 1),
        ((*COMPARE, "constant", "--strict"), 0),
        ((*COMPARE, "constant", "--debug"), 0),
        ((*COMPARE, "constant,interrupted", "--strict"), 130),
        ((*SWEEP, "crashing,constant"), 0),
        ((*SWEEP, "crashing,constant", "--strict"), 1),
        ((*SWEEP, "constant,interrupted"), 130),
        ((*RUN, "nothing"), 2),
        ((*COMPARE, "nothing", "--strict"), 2),
        ((*SWEEP, "constant", "--debug", "--workers", "2"), 2),
    ],
)
def test_exit_codes(call, arguments, code):
    assert call(*arguments) == code


def test_a_run_that_failed_is_told_with_its_place_and_the_log(call, capsys):
    call(*RUN, "crashing")
    lines = capsys.readouterr().out.splitlines()
    reason = next(line for line in lines if line.startswith("kinematic-crashing-exp2-moderate-0: "))
    assert reason.startswith(
        "kinematic-crashing-exp2-moderate-0: crashed: KeyError: 'gain' (test_exit_codes.py:"
    )
    assert reason.endswith(" in Ending.step)")
    assert lines[-1] == f"1 of 1 run failed; why: out/{results.FAILURES}"


@pytest.mark.parametrize("command", [RUN, COMPARE, SWEEP])
def test_debug_raises_in_this_process(call, monkeypatch, command):
    monkeypatch.setattr("sys.argv", ["servobench", *command, "crashing", "--debug"])
    from servobench.harness.cli.main import main

    with pytest.raises(KeyError, match="gain") as caught:
        main()
    assert caught.traceback[-1].name == "step"


def test_a_full_disk_is_one_line(call, monkeypatch, capsys):
    def write(*_: object) -> None:
        raise OSError(errno.ENOSPC, "Error writing bytes to file")

    monkeypatch.setattr("servobench.harness.batch.store.write_part", write)
    assert call(*SWEEP, "constant") == 1
    assert capsys.readouterr().err == (
        "servobench: No space left on device (in the temporary folder or in the one that is written); finished runs "
        "are kept, --resume continues\n"
    )


def test_a_temporary_folder_without_room_is_one_line(call, monkeypatch, capsys, tmp_path):
    monkeypatch.setattr(tempfile, "tempdir", None)  # it is sought anew
    with no_file_above(0):
        assert call("fmu", "export", "--output", str(tmp_path / "arm.fmu")) == 1
    error = capsys.readouterr().err
    assert error.count("\n") == 1
    assert error.startswith(
        "servobench: no temporary folder takes a file; free room in one, or name another: TMPDIR="
    )
    assert list(tmp_path.iterdir()) == []


def test_a_segmentation_fault_says_in_which_line(tmp_path):
    plugin = "import ctypes\n\ndef strike():\n    ctypes.string_at(0)\n\nstrike()\n"
    (tmp_path / "striking.py").write_text(plugin)
    code = "import sys; sys.argv = ['servobench', 'tasks']\n"
    code += "import servobench.harness.cli.main as main\n"
    code += "main.command_line = lambda *_: __import__('striking')\n"
    code += "main.main()"
    ended = python("-c", code, path=tmp_path)
    assert ended.returncode == -signal.SIGSEGV
    assert f'File "{tmp_path / "striking.py"}", line 4 in strike' in ended.stderr


def test_a_backend_for_windows_and_a_wrong_epoch_leave_no_traceback(
    refusal_of, tmp_path, monkeypatch
):
    words = ("run", "constant", "--plant", "kinematic", *EXP2[:2], "--out", tmp_path / "out")
    monkeypatch.setenv("SOURCE_DATE_EPOCH", "abc")
    line = "servobench: SOURCE_DATE_EPOCH must be a whole number of seconds since 1970, got 'abc'; unset it\n"
    assert refusal_of(*words) == line
    drawn = python(
        "-m", "servobench", *words, path=tmp_path, MPLBACKEND="nonsense", SOURCE_DATE_EPOCH=""
    )
    assert (drawn.returncode, drawn.stderr) == (0, "")
    assert "5 figures in" in drawn.stdout


def test_threads_that_the_system_refuses_are_one_line(monkeypatch, capsys):
    def refuse(*_: object) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    assert servobench(monkeypatch, "compare", "--controllers", "constant", "--out", "none") == 1
    assert capsys.readouterr().err.startswith(
        "servobench: no more threads or processes may be started here"
    )


def test_a_script_without_a_guard_ends_with_the_line_alone(tmp_path):
    script = tmp_path / "script.py"
    script.write_text("import servobench\nservobench.compare(['constant'], seeds=2, workers=2)\n")
    ended = python(script)
    assert ended.returncode == 1
    assert ended.stdout == ""
    assert re.fullmatch(
        "the worker processes cannot be started; a script .*__main__':`\n", ended.stderr
    )


WAITING = """
import atexit, ctypes, sys
import servobench.__main__ as entry
import servobench.harness.cli.main as main

def command():
    atexit.register(print, "registered for the end")
    ctypes.CDLL(None).printf(b"written by a library\\n")
    carried_out()

carried_out, main.main = main.main, command
entry.main()
"""


def test_a_command_that_succeeds_ends_at_once_and_loses_no_output(tmp_path):
    ended = python("-c", WAITING, "tasks", path=tmp_path)
    assert (ended.returncode, ended.stderr) == (0, "")
    for words in ("endurance", "registered for the end", "written by a library"):
        assert ended.stdout.count(words) == 1


def test_a_command_whose_output_is_lost_fails(tmp_path):
    with Path("/dev/full").open("w") as full:
        ended = subprocess.run(
            [sys.executable, "-m", "servobench", "tasks"],
            stdout=full, stderr=subprocess.PIPE, text=True, check=False, cwd=tmp_path,
        )  # fmt: skip
    assert ended.returncode != 0
    assert "No space left on device" in ended.stderr
