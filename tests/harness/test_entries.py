"""Controllers of users, given by the place of their code or as objects: found, named, and refused in one line."""

import re
import sys
from pathlib import Path

import pytest

import servobench
from kit.command import servobench as command
from kit.own import CONFIGURED, WHOLE, write
from servobench.harness.batch import trials
from servobench.harness.config.registry import choose_controller, find_controller, offered
from servobench.harness.config.settings import default_config
from servobench.plant.contract.faults import ConfigurationError

SHORT = {"exp1": {"duration": 0.5}}
TWO = WHOLE + "\n\nclass Other(Mine):\n    pass\n"
ENTRY = '\n\nENTRY = servobench.ControllerEntry("mine", "one line", MineConfig, Mine)\n'

pytestmark = pytest.mark.usefixtures("own_folder")


@pytest.mark.parametrize(
    ("text", "place", "name"),
    [
        (WHOLE, "./mine.py", "Mine"),
        (WHOLE, "mine.py:Mine", "Mine"),
        (WHOLE, "first=./mine.py", "first"),
        (TWO, "./mine.py:Other", "Other"),
        (CONFIGURED + ENTRY, "./mine.py", "mine"),
        (CONFIGURED + ENTRY, "./mine.py:ENTRY", "mine"),
        (CONFIGURED + ENTRY, "./mine.py:Mine", "Mine"),
        (
            "from abc import ABC\n" + TWO.replace("Controller)", "Controller, ABC)"),
            "./mine.py:Mine",
            "Mine",
        ),
    ],
)
def test_a_controller_is_found_by_the_place_of_its_code(tmp_path, text, place, name):
    path = write(tmp_path, text)
    assert choose_controller(place) == name
    assert choose_controller(place) == name  # asked for again, it is the same one
    assert find_controller(name).name == name
    record = offered([name])[0].record()
    assert (record["place"], record["file"]) == (place.partition("=")[2] or place, str(path))
    assert re.fullmatch("[0-9a-f]{64}", record["sha256"])


def test_a_module_of_the_present_folder_is_found_by_its_name(tmp_path):
    write(tmp_path, WHOLE, "own_package_of_a_user/laws.py")
    assert choose_controller("own_package_of_a_user.laws:Mine") == "Mine"


def test_files_beside_it_can_be_imported_and_it_changes_no_folder_of_the_command(tmp_path):
    write(tmp_path, "GAIN = 3.0\n", "elsewhere/own_gains_of_a_user.py")
    moves = "import os\nos.chdir('elsewhere')\nopen('own_gains_of_a_user.py').close()\n"
    write(tmp_path, f"{moves}from own_gains_of_a_user import GAIN\n{WHOLE}", "elsewhere/mine.py")
    assert choose_controller("elsewhere/mine.py") == "Mine"
    assert Path.cwd() == tmp_path
    assert choose_controller("other=elsewhere.mine:Mine") == "other"
    assert Path.cwd() == tmp_path


def test_a_class_may_take_settings_and_has_none_otherwise(tmp_path):
    write(tmp_path, CONFIGURED)
    assert default_config(find_controller(choose_controller("./mine.py"))).gain == 2.0
    write(tmp_path, WHOLE, "plain.py")
    assert vars(default_config(find_controller(choose_controller("plain=./plain.py")))) == {}


def test_two_controllers_of_one_name_are_refused_and_can_be_renamed(tmp_path):
    write(tmp_path, WHOLE, "a.py")
    write(tmp_path, WHOLE, "b.py")
    write(tmp_path, CONFIGURED + ENTRY.replace('"mine"', '"ukf_mfac"'), "c.py")
    assert choose_controller("./a.py") == "Mine"
    with pytest.raises(
        ConfigurationError,
        match=r"\./a\.py and \./b\.py are both called 'Mine'; .* my_Mine=\./b\.py",
    ):
        choose_controller("./b.py")
    assert choose_controller("my_Mine=./b.py") == "my_Mine"
    with pytest.raises(
        ConfigurationError, match=r"called 'ukf_mfac' exists already; .* my_ukf_mfac=\./c\.py"
    ):
        choose_controller("./c.py")


@pytest.mark.parametrize("path", ["mine.py", "../{folder}/mine.py", "{whole}/mine.py"])
def test_a_file_may_be_given_again_by_another_path(tmp_path, path):
    write(tmp_path, WHOLE, "mine.py")
    assert choose_controller("./mine.py:Mine") == "Mine"
    again = path.format(folder=tmp_path.name, whole=tmp_path)
    assert choose_controller(f"{again}:Mine") == "Mine"


def test_a_place_is_understood_in_python_too(tmp_path):
    write(tmp_path)
    table = servobench.compare(["./mine.py", "constant"], settings=SHORT)
    assert table["controller"].tolist() == ["Mine", "constant"]
    assert offered(["Mine"]) == ()  # only for as long as the call took


class Memory(servobench.Controller):
    """Counts its steps from the value that it is made with."""

    def __init__(self, count):
        self.count = self.first = count

    def reset(self, observation, seed):
        self.count = self.first

    def step(self, observation, reference):
        self.count += 1
        return servobench.Command([0.0] * 6)

    def diagnostics(self):
        return {"count": self.count}


def test_an_object_is_copied_for_each_run():
    mine = Memory(3)
    result = servobench.run(mine, settings=SHORT)
    assert result.steps["diagnostic_count"].tolist() == list(range(4, 14))
    assert mine.count == 3


BROKEN = {
    "syntax": (WHOLE.replace("np.zeros(self.n))", "np.zeros(self.n)"), "mine.py:16: SyntaxError: '(' was never closed"),
    "indentation": (WHOLE.replace("        pass", "pass"), "mine.py:13: IndentationError: expected an indented block"),
    "no such module": ("import torhc\n" + WHOLE, "mine.py:1: ModuleNotFoundError: No module named 'torhc'"),
    "relative import": ("from .law import Law\n", "mine.py:1: ImportError: attempted relative import"),
    "exception at import": ("1 / 0\n", "mine.py:1: ZeroDivisionError: division by zero"),
    "exit at import": ("import sys\nsys.exit(3)\n", "mine.py:2: SystemExit: 3"),
    "no step": (WHOLE.replace("def step", "def stepp"), "mine.py:6: class Mine lacks step, which it must define"),
    "no reset, no step": (WHOLE.replace("def step", "def stepp").replace("def reset", "def rest"),
        "mine.py:6: class Mine lacks reset and step, which it must define"),
    "nothing in it": ("import numpy\n",
        "./mine.py defines no controller: no subclass of servobench.Controller and no ENTRY"),
    "two of them": (TWO, "./mine.py defines Mine, Other; name one of them, such as ./mine.py:Mine"),
    "no knowledge": (WHOLE.replace("self, knowledge)", "self)").replace("knowledge.spec.n", "6"),
        "mine.py:6: Mine.__init__ must take (self, knowledge) or (self, config, knowledge), got (self)"),
    "too many arguments": (
        WHOLE.replace("self, knowledge", "self, gain, damping, knowledge"),
        "mine.py:6: Mine.__init__ must take (self, knowledge) or (self, config, knowledge), "
        "got (self, gain, damping, knowledge)",
    ),
    "settings without a class": (WHOLE.replace("self, knowledge", "self, config, knowledge"),
        "mine.py:6: Mine.__init__ must name the dataclass of its settings, such as config: MineConfig"),
    "settings of an unknown class": (
        WHOLE.replace("self, knowledge", "self, config: 'Missing', knowledge"),
        "mine.py:6: Mine.__init__ must name the dataclass of its settings, such as config: MineConfig; "
        "NameError: name 'Missing' is not defined",
    ),
    "settings without a default": (CONFIGURED.replace("gain: float = 2.0", "gain: float"),
        "mine.py:8: every field of MineConfig needs a default; gain has none"),
    "settings that are no dataclass": (CONFIGURED.replace("@dataclass(frozen=True)\n", ""),
        "mine.py:8: the settings MineConfig are no dataclass; put @dataclass(frozen=True) above class MineConfig"),
    "settings that fail": (
        CONFIGURED.replace("= 2.0", "= 2.0\n    def __post_init__(self):\n        raise ValueError('no')"),
        "mine.py:12: ValueError: no",
    ),
    "an entry that is a dictionary": (WHOLE + "ENTRY = {}\n", "./mine.py is of type dict, wanted a subclass of"),
    "an entry without a name": (
        CONFIGURED + ENTRY.replace('"mine"', '"a b"'), "./mine.py: the name must be letters, digits and _, got 'a b'",
    ),
    "an entry whose settings are a number": (
        CONFIGURED + ENTRY.replace("MineConfig", "3"), "./mine.py: config must be a dataclass or a function, got 3",
    ),
    "an entry whose class lacks a method": (
        CONFIGURED.replace("def step", "def stepp") + ENTRY, "mine.py:13: class Mine lacks step, which it must define",
    ),
    "not derived": (WHOLE.replace("(servobench.Controller)", "") + "ENTRY = Mine\n",
        "./mine.py is the class Mine, wanted a subclass"),
    "exception in the constructor": (WHOLE.replace("knowledge.spec.n", "knowledge.size"),
        "controller Mine: mine.py:10: AttributeError: 'RobotKnowledge' object has no attribute 'size'"),
    "numpy in the constructor": (WHOLE.replace("knowledge.spec.n", "np.linalg.inv(np.zeros((2, 2)))"),
        "controller Mine: mine.py:10: LinAlgError: Singular matrix"),
    "exit in the constructor": (
        WHOLE.replace("self.n = knowledge.spec.n", "raise SystemExit"), "controller Mine: mine.py:10: SystemExit",
    ),
    "an entry that builds something else": (CONFIGURED + ENTRY.replace("Mine)", "lambda config, knowledge: 3)"),
        "controller mine: it is built as int, wanted a servobench.Controller"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_one_line_with_its_place(tmp_path, what):
    text, message = BROKEN[what]
    write(tmp_path, text)
    with pytest.raises(ConfigurationError, match=f"^{re.escape(message)}") as refused:
        servobench.run("./mine.py", settings=SHORT)
    assert "\n" not in str(refused.value)
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]


@pytest.mark.slow
@pytest.mark.parametrize(
    "what", ["syntax", "exception in the constructor", "an entry that builds something else"]
)
def test_a_command_refuses_a_broken_file_with_this_line_and_exit_code_2(refusal_of, tmp_path, what):
    text, message = BROKEN[what]
    write(tmp_path, text)
    assert refusal_of("run", "--plant", "kinematic", "--controller", "./mine.py").startswith(
        f"servobench: {message}"
    )
    assert [path.name for path in tmp_path.iterdir()] == ["mine.py"]


@pytest.mark.parametrize(
    ("place", "message"),
    [
        ("./mien.py", r"there is no file \./mien\.py: did you mean 'mine\.py'\?"),
        ("nowhere/mine.py", r"there is no file nowhere/mine\.py: nowhere holds no Python file"),
        (
            "my-own=./mine.py",
            r"there is no file my-own=\./mine\.py: a name before = has letters, digits and _ only",
        ),
        ("./a=b/mine.py", r"there is no file \./a=b/mine\.py: a=b holds no Python file"),
        ("./mine.py:Mien", r"\./mine\.py has no 'Mien': did you mean 'Mine'"),
        (
            "./mine.py:np",
            r"\./mine\.py:np is of type module, wanted a subclass of servobench\.Controller",
        ),
        ("mine", r"unknown controller 'mine': did you mean your file '\./mine\.py'\?"),
        (
            "ukf_mfca:published",
            "unknown controller 'ukf_mfca:published': did you mean 'ukf_mfac:published'",
        ),
        ("kit.own:Mine", "kit.own has no 'Mine': it defines no controller"),
        ("kit.nothing:Mine", "ModuleNotFoundError: No module named 'kit.nothing'"),
    ],
)
def test_a_place_without_a_controller_is_refused_with_the_nearest_one(tmp_path, place, message):
    write(tmp_path)
    with pytest.raises(ConfigurationError, match=message):
        choose_controller(place)


def test_a_present_folder_that_was_deleted_is_named(tmp_path, monkeypatch):
    (folder := tmp_path / "gone").mkdir()
    monkeypatch.chdir(folder)
    folder.rmdir()
    with pytest.raises(
        ConfigurationError, match="the present folder was deleted; change to one that exists"
    ):
        choose_controller("./mine.py")


def test_two_files_beside_two_controllers_that_have_one_name_are_refused(tmp_path):
    for folder in "ab":
        write(tmp_path, f"GAIN = {folder!r}\n", f"{folder}/own_helper_of_a_user.py")
        write(tmp_path, "from own_middle_of_a_user import GAIN\n" + WHOLE, f"{folder}/mine.py")
    write(tmp_path, "from own_helper_of_a_user import GAIN\n", "a/own_middle_of_a_user.py")
    write(tmp_path, "import own_helper_of_a_user\n" + WHOLE, "b/direct.py")
    assert choose_controller("first=a/mine.py") == "first"
    taken = "import own_helper_of_a_user would take a/own_helper_of_a_user.py instead of b/own_helper_of_a_user.py"
    with pytest.raises(
        ConfigurationError, match=f"^b/direct.py:1: {taken}, as a process has one module of a name"
    ):
        choose_controller("b/direct.py")
    assert choose_controller("again=a/mine.py") == "again"


@pytest.mark.parametrize("name", ["json", "rich", "sys"])
def test_a_file_that_an_installed_module_would_hide_is_refused(tmp_path, name):
    write(tmp_path, "GAIN = 3.0\n", f"{name}.py")
    write(tmp_path, f"import {name}\n" + WHOLE)
    with pytest.raises(
        ConfigurationError, match=rf"^mine\.py:1: import {name} would take .* instead of {name}\.py"
    ):
        choose_controller("./mine.py")
    write(tmp_path, WHOLE, "other.py")  # which does not import it
    assert choose_controller("./other.py") == "Mine"


HARMFUL = {
    "os._exit(3)": "it ended the process with exit code 3; raise an error instead",
    "ctypes.string_at(0)": "mine.py:4: it killed the process by SIGSEGV",
    "time.sleep(1000)": "mine.py:4: no answer after 2 s; is there a loop without an end",
    "signal.raise_signal(signal.SIGKILL)": "it killed the process by SIGKILL",
    "raise KeyboardInterrupt": "KeyboardInterrupt (mine.py:4 in <module>)",
}
COMMANDS = {
    "run": ("run", "./mine.py", "--plant", "kinematic", "--out", "out"),
    "compare": ("compare", "--controllers", "constant,./mine.py:Mine", "--out", "out"),
    "sweep of a module": ("sweep", "--controllers", "mine:Mine", "--out", "out"),
    "list": ("controllers", "./mine.py"),
    "plant": ("run", "constant", "--plant", "./mine.py", "--out", "out"),
    "check": ("check", "./mine.py"),
    "shadow": ("shadow", "log.csv", "--controller", "./mine.py"),
    "fmu export": ("fmu", "export", "--controller", "./mine.py", "--output", "mine.fmu"),
    "fmu ssp": ("fmu", "ssp", "--controller", "./mine.py", "--output", "loop.ssp"),
}


@pytest.mark.slow
@pytest.mark.parametrize(("line", "why"), HARMFUL.items())
def test_an_import_that_ends_or_hangs_its_process_is_one_line(
    tmp_path, monkeypatch, capfd, line, why
):
    monkeypatch.setattr(trials, "IMPORT_LIMIT", 2.0)
    write(tmp_path, f"import ctypes, os, signal, time\nprint('a banner')\n\n{line}\n{WHOLE}")
    assert command(monkeypatch, *COMMANDS["run"]) == 2
    out, errors = capfd.readouterr()
    assert out == ""
    assert errors.startswith(f"servobench: ./mine.py cannot be imported: {why}")
    assert len(errors.splitlines()) == 1
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize("name", COMMANDS)
def test_every_command_outlives_an_import_that_ends_its_process(tmp_path, monkeypatch, capfd, name):
    monkeypatch.delitem(sys.modules, "mine", raising=False)
    monkeypatch.syspath_prepend(str(tmp_path))  # before folders of other tests
    write(tmp_path, f"import os\nos._exit(3)\n{WHOLE}")
    assert command(monkeypatch, *COMMANDS[name]) == (1 if name == "check" else 2)
    told = "".join(capfd.readouterr())
    assert "it ended the process with exit code 3" in told
    assert "Traceback" not in told


def test_what_an_import_prints_is_printed_once(tmp_path, monkeypatch, capfd):
    write(tmp_path, f"print('a banner')\n{CONFIGURED}")
    assert command(monkeypatch, "controllers", "./mine.py") == 0
    assert capfd.readouterr().out.count("a banner") == 1
