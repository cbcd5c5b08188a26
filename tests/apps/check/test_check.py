"""The checks of controllers: a broken one fails one check with its line, a whole or new one (`servobench new`) none."""

import itertools
from dataclasses import replace
from functools import partial

import pytest

import servobench
from kit.broken_controllers import BROKEN, NOTED, stepping
from kit.command import python
from kit.own import CELL, CONFIGURED, WHOLE, write
from servobench.harness.apps.check.controllers import check_controller
from servobench.plant.bench.plant import PlantEntry
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import ENTRY as KINEMATIC

COUNT = itertools.count()

KILLING = {  # step of the controller, begin of the line of its check
    "strikes": ("ctypes.string_at(0)", "mine.py:18: it killed the process by SIGSEGV"),
    "hangs": (
        "while True: time.sleep(0.1)",
        "mine.py:18: no answer after 3 s; is there a loop without an end",
    ),
    "ends": ("os._exit(9)", "it ended the process with exit code 9"),
}

pytestmark = pytest.mark.usefixtures("own_folder")


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_controller_fails_one_check_with_one_line(tmp_path, what):
    text, check, line = BROKEN[what]
    write(tmp_path, text)
    report = check_controller("./mine.py")
    assert [each.check for each in report.failures] == [check], report
    assert report.failures[0].text.startswith(line), report
    assert "\n" not in report.failures[0].text
    assert not report.ok


@pytest.mark.parametrize("what", NOTED)
def test_what_is_no_defect_is_a_note(tmp_path, what):
    text, check, line = NOTED[what]
    write(tmp_path, text)
    report = check_controller("./mine.py")
    assert report.ok, report
    noted = {each.check: each.text for each in report.findings if each.verdict == "note"}
    assert noted[check].startswith(line), report


@pytest.mark.parametrize("text", [WHOLE, CONFIGURED])
def test_a_whole_controller_passes_every_check(tmp_path, text):
    write(tmp_path, text)
    report = servobench.check_controller("./mine.py")
    assert {each.check for each in report.findings if each.verdict != "ok"} == {
        "aids",
        "side by side",
    }
    assert {each.verdict for each in report.findings} == {"ok", "note"}
    assert len(report.findings) == 18
    assert str(report).startswith("Mine:\nok     constructor\nok     command\n")


def findings(subject):
    """Return verdict and line of each check."""
    return {each.check: (each.verdict, each.text) for each in check_controller(subject).findings}


def test_it_is_said_what_gives_a_class_the_aids_and_why_it_cannot_have_them(tmp_path):
    write(tmp_path, WHOLE)
    assert findings("./mine.py")["aids"][1].startswith(
        "without aids; `aids = servobench.EQUIPPED` in the class gives"
    )
    write(tmp_path, WHOLE.replace('"""Does not move."""', "aids = servobench.EQUIPPED"))
    assert findings("./mine.py")["aids"] == ("ok", "")
    write(tmp_path, WHOLE.replace("np.zeros(self.n)", "0.0 * reference[1, 0] * np.ones(self.n)"))
    line = "without aids, and it cannot have them as it is: mine.py:16: IndexError"
    assert findings("./mine.py")["aids"][1].startswith(line)
    write(tmp_path, stepping("return np.zeros(self.n)", inside="\n    aids = servobench.EQUIPPED"))
    assert findings("./mine.py")["command"][1].startswith(
        "mine.py:18: step must return a Command, got ndarray"
    )


IN_PARTS = """
import numpy as np
from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.controller import ControllerEntry
from servobench.controllers.estimators.constant import ConstantEstimator
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.laws.law import Law
from servobench.controllers.servo import Servo, ServoController


class Transpose(Law[None]):
    def start(self, observation):
        return None

    def command(self, state, estimate, observation, reference):
        e = reference[..., 0, :] - observation.feature
        return state, np.vecmat(e, estimate.jacobian) / LENGTH


def build(config, knowledge):
    initial = initial_jacobian(config, knowledge)
    return ServoController(Servo(ConstantEstimator(), Transpose(), initial, knowledge, AidsConfig(**EQUIPPED)))


ENTRY = ControllerEntry("transpose", "u = Jᵀ e", InitialConfig, build, side_by_side=True)
"""


def test_parts_that_say_so_are_checked_side_by_side(tmp_path):
    write(
        tmp_path,
        IN_PARTS.replace("LENGTH", "(1.0 + np.sqrt(np.vecdot(e, e)))[..., None]"),
        "parts.py",
    )
    assert findings("./parts.py")["side by side"] == ("ok", "")
    write(tmp_path, IN_PARTS.replace("LENGTH", "(1.0 + np.linalg.norm(e))"), "parts.py")
    verdict, line = findings("./parts.py")["side by side"]
    assert verdict == "failed"
    assert line.startswith(
        "two runs that advance together have other commands than each alone; its parts must be pure"
    )
    write(
        tmp_path,
        f"{CONFIGURED}\n\nENTRY = servobench.ControllerEntry('own', '', MineConfig, Mine, side_by_side=True)\n",
    )
    line = "its entry says side_by_side=True, so that build must return a ServoController"
    assert findings("./mine.py")["side by side"] == ("failed", line)


@pytest.mark.parametrize("what", KILLING)
def test_a_controller_that_kills_its_process_or_never_answers_loses_no_output(
    output_of, tmp_path, what
):
    step, line = KILLING[what]
    write(tmp_path, stepping(step))
    lines = output_of("check", "./mine.py", "--limit", "3", code=1).splitlines()
    assert lines[0].split() == ["ok", "constructor"]
    assert lines[1].startswith(f"failed {'command':15s}{line}"), lines
    assert lines[2:] == ["./mine.py: 1 of 2 checks failed"]


def test_a_controller_that_cannot_be_loaded_is_refused_as_elsewhere(refusal_of, tmp_path):
    write(tmp_path, WHOLE.replace("def step", "def stepp"))
    assert (
        refusal_of("check", "./mine.py")
        == "servobench: mine.py:6: class Mine lacks step, which it must define\n"
    )


def plant_with(**methods) -> PlantEntry:
    """Return the plant `kinematic` with other methods, each of which gets the plant's own first."""

    def build(config, setup):
        plant = KINEMATIC.build(config, setup)
        for name, method in methods.items():
            setattr(plant, name, partial(method, getattr(plant, name)))
        return plant

    return replace(KINEMATIC, name="broken", build=build)


@pytest.mark.parametrize(
    ("methods", "check", "line"),
    [
        ({"reset": lambda own, seed: own(seed + (seed >= 0) * next(COUNT))}, "repeatable",
         "reset with the same seed gives another run"),
        ({"reset": lambda own, seed: own(abs(seed))}, "negative seed", "reset must refuse the seed -1"),
        ({"step": lambda own, u: own(Command(u.joint_velocity[:own.__self__.spec.n]))}, "wrong size",
         "step must refuse 7 joint velocities"),
        ({"truth": lambda own: replace(own(), jacobian=2 * own().jacobian)}, "truth", "truth().jacobian misses "),
        ({"save": lambda own: None, "restore": lambda own, state: None}, "save",
         "after restore the run goes on otherwise"),
        ({"close": lambda own: 1 / 0}, "close", "ZeroDivisionError"),
    ],
)  # fmt: skip
def test_a_broken_plant_fails_one_check_with_one_line(methods, check, line):
    report = servobench.check_plant(plant_with(**methods))
    assert [each.check for each in report.failures] == [check], report
    assert line in report.failures[0].text


def test_notes_that_an_error_of_the_checked_code_has_are_left_out():
    def close(own):
        error = ValueError("stuck")
        error.add_note("which jax\nexplains at length")
        raise error

    (failure,) = servobench.check_plant(plant_with(close=close)).failures
    assert failure.text.endswith("ValueError: stuck")


MOVING, SEEN = "self.spec.period * joint_velocity", "return self.model.feature(self.q)\n\n"
OTHER = "; this happens with a period of 100 ms and the robot panda"


@pytest.mark.parametrize(
    ("right", "wrong", "line"),
    [
        (
            "self.q = self.start",
            "self.q = np.degrees(self.start)",
            "run: reset must begin at setup.start, [0.55",
        ),
        (
            MOVING,
            f"np.radians({MOVING})",
            "run: q0 moves by -0.000873 rad under commands for -0.05 rad: commands",
        ),
        (MOVING, f"{MOVING} * (np.arange(len(self.q)) != 3)", "run: q3 moves by 0 rad under"),
        (
            MOVING,
            f"{MOVING} * np.sign(self.q[1])",
            "run: q0 moves by 0.05 rad under commands for -0.05 rad",
        ),
        (MOVING, f"3.0 * {MOVING}", "run: q0 moves by -0.15 rad under"),
        (MOVING, "0.05 * joint_velocity", f"run: q0 moves by -0.025 rad {OTHER}"),
        (MOVING, f"{MOVING} * {{6: 1.0}}[len(self.q)]", f"KeyError: 7{OTHER}"),
        (
            '"x", "y", "z"',
            '"u", "v"',
            "run: spec has the features u, v in m, and the camera of the setup has x, y, z in m",
        ),
        (
            "    def __init__",
            "    own_robot = True\n\n    def __init__",
            "ValueError: the setup has no robot: a plant with own_robot = True brings its arm, start and limits",
        ),
        (SEEN, SEEN.replace("\n", "[[1, 0, 2]]\n", 1), "truth: at rest truth().feature is ["),
        (
            SEEN,
            SEEN.replace("\n", " * [1, 1, 1000]\n", 1),
            "; both are of one camera, in one order and unit",
        ),
        (
            "setup.robot()",
            "setup.nominal.nominal, setup.start",
            "; the plant has to be the robot and camera that",
        ),
        (
            "self.model.feature(self.q), ",
            "np.full(3, np.nan), ",
            "truth: at rest truth().feature is [nan",
        ),
        (
            "self.model.jacobian(self.q)",
            "np.full((3, len(self.q)), np.nan)",
            "truth().jacobian misses nan%",
        ),
    ],
)
def test_a_world_that_is_not_the_robot_it_was_given_fails_with_one_line(
    tmp_path, right, wrong, line
):
    assert right in CELL
    write(tmp_path, CELL.replace(right, wrong), "cell.py")
    (failure,) = servobench.check_plant("./cell.py").failures
    assert all(part in f"{failure.check}: {failure.text}" for part in line.partition(OTHER)), (
        failure
    )


def test_a_plant_may_refuse_a_second_robot_or_have_small_errors_of_its_own(tmp_path):
    own = CELL.replace("range(len(self.start))", "range(6)").replace(MOVING, f"0.9 * {MOVING}")
    write(tmp_path, own.replace(SEEN, SEEN.replace("\n", " + 0.01\n", 1)), "cell.py")
    report = servobench.check_plant("./cell.py")
    assert report.ok, report
    assert report.findings[0].text.startswith("not checked: cell.py:13: ValueError: ")
    assert report.findings[0].text.endswith(OTHER)


@pytest.mark.slow
def test_new_files_pass_their_own_tests(output_of, tmp_path):
    for kind, name, check, options in (
        ("controller", "my_law", "check", ()),
        ("controller", "my_aided_law", "check", ("--aids",)),
        ("plant", "my_cell", "check plant", ()),
    ):
        assert f"servobench {check} ./laws/{name}.py" in output_of(
            "new", kind, name, "--folder", "laws", *options
        )
    checks = [
        line.split()[:2] for line in output_of("check", "./laws/my_aided_law.py").splitlines()
    ]
    assert ["ok", "aids"] in checks
    done = python("-m", "pytest", "-q", "-p", "no:cacheprovider", path=tmp_path / "laws")
    assert "6 passed" in done.stdout, done.stdout + done.stderr


@pytest.mark.parametrize("name", ["3d", "class", "my-law", "../mine", "test_mine", ""])
def test_a_name_that_no_module_may_have_is_refused(refusal_of, tmp_path, name):
    assert "the name must be one of a Python module, such as my_law" in refusal_of(
        "new", "controller", name
    )
    assert list(tmp_path.iterdir()) == []
