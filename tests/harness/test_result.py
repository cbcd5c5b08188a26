"""How a run ended: the place of an error in the reason, and its trace in the log of failures."""

import ctypes
import sys
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import servobench
from kit.command import judged
from kit.folders import made_up_row
from kit.resting import Resting
from kit.toy_plants import Plain
from servobench.controllers.controller import Controller, RobotKnowledge
from servobench.harness.batch import results, store
from servobench.harness.batch.results import ResultsFolder
from servobench.harness.config.source import PACKAGE_FOLDER
from servobench.harness.run.contract import held_to_contract
from servobench.harness.run.result import Ending, RunResult, log_entry
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.faults import FilterDiverged, RunFault
from servobench.plant.contract.signals import Command

SHORT = {"exp2": {"duration": 0.5}, "random": {"duration": 0.5}}


class KeyLost(Resting):
    """Looks for a gain that is not there."""

    def step(self, observation, reference):
        if observation.time < 0.1:
            return super().step(observation, reference)
        return {}["gain"]  # the line of the crash


class Unprepared(Resting):
    """Cannot begin."""

    def reset(self, observation, seed):
        try:
            int("no number")
        except ValueError as error:
            raise RuntimeError("no gains") from error  # the line of the crash


class OwnFault(RunFault):
    """A reason of a third party."""

    status = "gripper_open"


class Faulty(Resting):
    """Ends a run for a reason of its own."""

    def step(self, observation, reference):
        raise OwnFault("the gripper is open")  # the line of the crash


def line_of(kind: type) -> int:
    """Return the line of this file that ends with the comment about a crash, in the class `kind`."""
    lines = Path(__file__).read_text().splitlines()
    begin = lines.index(f"class {kind.__name__}(Resting):")
    return next(
        i
        for i, line in enumerate(lines, 1)
        if i > begin and line.endswith("# the line of the crash")
    )


def wrong(name: str, method: str, answer: str) -> type[Controller]:
    """Return a controller of which one method gives a wrong answer; its code lies in the file wrong.py."""
    code = f"class {name}(Resting):\n    'Answers wrongly.'\n    def {method}:\n        return {answer}\n"
    names = {"np": np, "Command": Command, "Resting": Resting, "sys": sys, "__name__": "wrong"}
    exec(compile(code, "elsewhere/wrong.py", "exec"), names)
    return names[name]


STEP, RESET, LOOK = (
    "step(self, observation, reference)",
    "reset(self, observation, seed)",
    "diagnostics(self)",
)


CRASHES = {
    KeyLost: ("crashed", "KeyError: 'gain'", "step"),
    Unprepared: ("crashed", "RuntimeError: no gains", "reset"),
    Faulty: ("gripper_open", "the gripper is open", "step"),
}


@pytest.mark.parametrize("kind", CRASHES)
def test_the_reason_names_error_message_file_line_and_method(kind):
    result = servobench.run(kind, task="exp2", settings=SHORT)
    status, message, method = CRASHES[kind]
    place = f"(test_result.py:{line_of(kind)} in {kind.__name__}.{method})"
    assert (result.row["status"], result.row["reason"]) == (status, f"{message} {place}")
    assert f'{Path(__file__).name}", line {line_of(kind)}, in {method}' in result.trace
    assert "harness/run" not in result.trace
    assert result.row["periods"] == (2 if kind is KeyLost else 0)


@pytest.mark.parametrize(
    ("answer", "status", "message"),
    [
        ("Command(np.full(6, np.nan))", "crashed",
         "ValueError: joint_velocity must be finite, got [nan, nan, nan, nan, nan, nan]"),
        ("Command(np.linalg.inv(np.zeros((6, 6)))[0])", "crashed", "LinAlgError: Singular matrix"),
        ("Command(np.full(6, 1e300) * 1e300)", "numerical_error", "overflow encountered in multiply"),
        ("sys.exit(3)", "crashed", "SystemExit: 3"),
    ],
)  # fmt: skip
def test_errors_of_numbers_and_exits_end_a_run_likewise(answer, status, message):
    row = servobench.run(wrong("Wrong", STEP, answer), task="exp2", settings=SHORT).row
    assert (row["status"], row["reason"]) == (status, f"{message} (wrong.py:4 in Wrong.step)")


def test_a_trace_tells_the_error_behind_the_error():
    trace = servobench.run(Unprepared, task="exp2", settings=SHORT).trace
    assert "ValueError: invalid literal for int() with base 10: 'no number'" in trace


def test_a_good_run_has_no_reason_and_no_trace():
    result = servobench.run("constant", task="exp2", settings=SHORT)
    assert (result.row["status"], result.row["reason"], result.trace) == ("completed", "", "")


PACKAGE_CODE = """
def caught(function):
    try:
        function()
    except Exception as error:
        return error

def fault():
    raise FilterDiverged("not finite")

def defect():
    return {}["x"]
"""


def test_a_fault_of_this_package_has_no_place_and_a_defect_of_it_has_one():
    code = {"FilterDiverged": FilterDiverged}
    exec(compile(PACKAGE_CODE, str(PACKAGE_FOLDER / "filter.py"), "exec"), code)
    assert Ending.of(code["caught"](code["fault"])) == Ending("filter_diverged", "not finite")
    ending = Ending.of(code["caught"](code["defect"]))
    assert (ending.status, ending.reason) == ("crashed", "KeyError: 'x' (filter.py:12 in defect)")
    assert ending.trace.endswith("KeyError: 'x'\n")


def test_the_log_has_one_entry_a_failed_run_and_only_of_those(tmp_path):
    folder = tmp_path / "out"
    runs = servobench.compare(
        [Resting, KeyLost], tasks=["exp2", "random"], seeds=2, settings=SHORT, out=folder
    )
    log = (folder / results.FAILURES).read_text()
    entries = [line for line in log.splitlines() if line and not line.startswith(" ")]
    failed = runs[runs["status"] != "completed"]
    assert len(failed) == 4
    assert entries == [f"{row.run_id}: {row.status}: {row.reason}" for row in failed.itertuples()]
    assert log.count('return {}["gain"]  # the line of the crash') == 4
    assert not (folder / results.PARTS).exists()


def test_good_runs_leave_no_log(tmp_path):
    servobench.compare(["constant"], tasks=["exp2"], settings=SHORT, out=tmp_path / "out")
    assert not (tmp_path / "out" / results.FAILURES).exists()


def test_an_interrupted_batch_that_is_resumed_has_the_log_of_all_runs(tmp_path):
    folder, rows = tmp_path / "out", []
    store.create_folder(folder, {"run_count": 2})
    for i in range(2):
        row = made_up_row(f"run{i}", seed=i, status="crashed", reason=f"no {i}")
        rows.append(log_entry(row, "a\nb"))
        store.write_part(folder, i, [RunResult(row, None, trace="a\nb")])
        store.collect(ResultsFolder(folder))
        assert (folder / results.FAILURES).read_text() == "".join(rows)


TOO_FEW = "takes 2 positional arguments but 3 were given; it must be `def"
TO_WRITE = "write `return Command(joint_velocity)` with 6 joint velocities in rad/s"


@pytest.mark.parametrize(
    ("method", "answer", "words"),
    [
        (STEP, "np.zeros(6)", f"step must return a Command, got ndarray of shape (6,); {TO_WRITE}"),
        (STEP, "None", f"step must return a Command, got None; {TO_WRITE}"),
        (STEP, "[0.0] * 6", f"step must return a Command, got list; {TO_WRITE}"),
        (STEP, "Command", f"step must return a Command, got the class Command; {TO_WRITE}"),
        (STEP, "Command(np.zeros(5))", "step must return a Command of shape (6,), one rad/s a joint, got (5,)"),
        (STEP, "Command(np.zeros((6, 1)))", "step must return a Command of shape (6,), one rad/s a joint, got (6, 1)"),
        ("step(self, observation)", "Command(np.zeros(6))", f"Wrong.step() {TOO_FEW} {STEP}`"),
        ("reset(self, observation)", "None", f"Wrong.reset() {TOO_FEW} {RESET}`"),
        (RESET, "observation", "reset must return nothing, got Observation; keep it in self"),
        (LOOK, "None",
         "diagnostics must return a mapping of names to numbers, got None; write `return {}` if there are none"),
        (LOOK, "{'error': np.zeros(3)}", "diagnostics must hold numbers, got 'error': ndarray of shape (3,)"),
        (LOOK, "{'state': 'good'}", "diagnostics must hold numbers, got 'state': str"),
        (LOOK, "{3: 1.0}", "diagnostics must have texts of one line and at most 100 letters as names, got 3"),
        ("estimated_jacobian(self)", "np.zeros((6, 3))",
         "estimated_jacobian must return an array of shape (3, 6) or None, got ndarray of shape (6, 3)"),
        ("estimated_jacobian(self)", "np.full((3, 6), object())",
         "estimated_jacobian must hold real numbers, got object"),
        (LOOK, "{f'{name}': 1.0 for name in range(257)}",
         "diagnostics must keep to the same names, at most 256: each is a column; got 257, among them '256'"),
        (STEP, "object.__setattr__(observation, 'time', 7.0)", "step changes its arguments; work on a copy"),
    ],
)  # fmt: skip
def test_a_wrong_answer_is_told_with_what_to_write_instead(method, answer, words):
    kind = wrong("Wrong", method, answer)
    result = servobench.run(kind, task="exp2", settings=SHORT)
    name = method.partition("(")[0]
    assert result.row["reason"] == f"WrongAnswer: {words} (wrong.py:3 in Wrong.{name})"
    assert 'elsewhere/wrong.py", line 3, in' in result.trace


class Writing(Resting):
    """Writes, past every flag, into arrays that it got or gave, once their period is over."""

    def step(self, observation, reference):
        command = super().step(observation, reference)
        self.kept = [observation.joint_position, observation.feature, observation.valid, reference]
        self.kept += [command.joint_velocity]
        return command

    def diagnostics(self):
        for array in self.kept:
            ctypes.memset(array.ctypes.data, 1, array.nbytes)
        return {}


def test_a_controller_that_writes_into_its_arrays_changes_no_row_of_the_log():
    alone, written = (
        servobench.run(kind, task="exp2", settings=SHORT) for kind in (Resting, Writing)
    )
    assert written.row["status"] == "completed"
    pd.testing.assert_frame_equal(
        *(judged(each.steps.drop(columns="run_id")) for each in (alone, written))
    )


class Reusing(Plain):
    """A plant that uses the same array for the truth of all instants."""

    def truth(self):
        self.seen_last = getattr(self, "seen_last", np.zeros(2))
        self.seen_last[:] = self.q
        return servobench.Truth(self.seen_last, np.eye(2))


def test_a_plant_may_use_the_array_of_its_truth_again():
    setup = PlantSetup(None, None, 0.1)
    plant, _ = held_to_contract(Reusing(setup), Resting(RobotKnowledge(Plain(setup).spec, 0)))
    plant.reset(0)
    truth = plant.truth()
    plant.step(Command(np.ones(2)))
    assert plant.truth().feature.tolist() == [0.4, 0.30000000000000004]
    assert truth.feature.tolist() == [0.3, 0.2]


@pytest.mark.parametrize(
    "answer", ["{'a': 1}", "{'a': True}", "{'a': np.float32(2.0)}", "{'a': np.array(2.0)}", "{}"]
)
def test_diagnostics_may_be_any_numbers(answer):
    assert (
        servobench.run(wrong("Right", LOOK, answer), task="exp2", settings=SHORT).row["status"]
        == "completed"
    )


def test_a_type_error_behind_the_call_is_told_as_it_is():
    kind = wrong("Inner", STEP, "len(3)")
    assert servobench.run(kind, task="exp2", settings=SHORT).row["reason"] == (
        "TypeError: object of type 'int' has no len() (wrong.py:4 in Inner.step)"
    )


def test_the_log_of_failures_holds_nothing_that_a_terminal_obeys():
    row = made_up_row("run0", status="crashed", reason="no \x1b[2J\u202e")
    entry = log_entry(row, "File x\n    \x1b]0;title\x07")
    assert (
        entry
        == "run0: crashed: no \\u001b[2J\\u202e\n    File x\n        \\u001b]0;title\\u0007\n\n"
    )
