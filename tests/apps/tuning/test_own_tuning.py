"""A controller of a user is tuned like those of the bench, and its values are taken while its code stays as it is."""

import json
import shutil

import pytest
from optuna.distributions import FloatDistribution, IntDistribution

import servobench
from kit.tuning import read_tuned
from servobench.controllers.aids import EQUIPPED
from servobench.harness.analysis.folder import describe_tuning
from servobench.harness.apps.tuning.spaces import SPACES, find_space
from servobench.harness.batch.results import load_runs
from servobench.harness.config.entries import CONTROLLER, read_own
from servobench.harness.config.installation import installed_version
from servobench.harness.config.registry import choose_controller, find_controller
from servobench.harness.config.settings import default_config
from servobench.harness.config.source import SourceFile

MINE = """\
from dataclasses import dataclass
from typing import Annotated

import numpy as np

import servobench
from servobench import Tuned


@dataclass(frozen=True)
class Config:
    gain: Annotated[float, Tuned(0.5, 20.0, log=True)] = 0.5


class Mine(servobench.Controller):
    aids = None

    def __init__(self, config: Config, knowledge):
        self.gain = config.gain
        self.jacobian = knowledge.nominal_jacobian

    def reset(self, observation, seed):
        pass

    def step(self, observation, reference):
        e = reference[0] - observation.feature
        J = self.jacobian(observation.joint_position)
        return servobench.Command(np.clip(self.gain * J.T @ np.linalg.solve(J @ J.T + 4e-4 * np.eye(3), e), -1, 1))
"""
SMALL = ("--robots", "1", "--studies", "1", "--workers", "1")
VALUES = """\
budget = "1 × 2 trials"
seeds = ["10000:10008", "15000:15008"]
sha256 = "{code}"

[settings]
gain = 3.0
"""


@pytest.fixture
def mine(own_folder, tmp_path):
    """The file of a controller in the present folder."""
    file = tmp_path / "mine.py"
    file.write_text(MINE)
    return file


@pytest.fixture
def tuned(mine):
    """The file of values that says that they are of this controller."""
    own = read_own(CONTROLLER, "./mine.py")
    file = mine.with_name("mine.Mine.tuned.toml")
    file.write_text(VALUES.format(code=own.code))
    return file


def gain_of(place):
    """Return the gain that a controller at a place has if nothing is set."""
    return default_config(find_controller(choose_controller(place))).gain


@pytest.mark.usefixtures("short_runs")
def test_tuned_values_are_found_beside_the_code_and_taken_by_every_command(
    mine, output_of, no_figures, tmp_path
):
    told = output_of("tune", "--controllers", "./mine.py", *SMALL, "--trials", 4, "--out", "s")
    assert "of your controllers lie beside their code and are taken from now on" in told
    values = read_tuned(tmp_path / "mine.Mine.tuned.toml")
    assert values.second_score < values.second_score_of_defaults
    assert values.seeds == ("10000:10008", "15000:15008")
    assert (values.version, len(values.sha256)) == (installed_version(), 64)
    gain = values.settings["gain"]
    assert gain > 0.5
    compared = ("--plants", "kinematic", "--tasks", "exp2", "--no-report", "--workers", "2")
    words = ("compare", "--controllers", "./mine.py,constant,mfac+rls", *compared, "--out", "c")
    told = output_of(*words)
    assert "Mine †" in told
    budget = "1 × 4 trials on robots 10000:10008 and 15000:15008"
    assert f"\n† Mine was tuned: {budget}\n" in told
    assert "\nNot tuned, unlike the others: mfac+rls\n" in told
    manifest = json.loads((tmp_path / "c" / "manifest.json").read_text())
    assert manifest["configuration"]["Mine"]["gain"] == gain
    assert manifest["tuned"]["Mine"]["sha256"] == values.sha256
    times = r"$\times$"
    latex = output_of("statistics", "c", "--latex")
    assert r"Mine $^\dagger$" in latex
    assert rf"$^\dagger$ Mine was tuned: {budget.replace('×', times)}. Not tuned" in latex
    assert "Not tuned, unlike the others: mfac+rls. " in latex
    row = load_runs(tmp_path / "c").set_index("controller").loc["Mine"]
    assert row["settling_time_s"] == servobench.run("./mine.py", task="exp2").row["settling_time_s"]


def test_values_move_with_the_code_and_have_any_name(tuned, mine, tmp_path):
    assert gain_of("./mine.py") == 3.0
    (tmp_path / "else").mkdir()
    for file in (mine, tuned):
        shutil.move(file, tmp_path / "else")
    assert gain_of("other=./else/mine.py:Mine") == 3.0
    assert gain_of("third=else.mine:Mine") == 3.0


def test_edited_code_is_not_tuned_and_a_line_says_so(tuned, mine, caplog):
    mine.write_text(f"{MINE}\n# edited\n")
    assert gain_of("./mine.py") == 0.5
    assert caplog.messages == [
        "servobench: note: ./mine.py was edited after mine.Mine.tuned.toml was made: it is not tuned and has its "
        "default values"
    ]


def test_an_edited_module_beside_the_code_counts_as_an_edit(mine, tmp_path):
    (tmp_path / "part_of_mine.py").write_text("")
    mine.write_text(f"import part_of_mine\n{MINE}")
    before = read_own(CONTROLLER, "./mine.py").code
    (tmp_path / "part_of_mine.py").write_text("GAIN = 2.0\n")
    assert read_own(CONTROLLER, "./mine.py").code != before


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("10000:10008", "0:8", "tune makes: robots 0:8 may judge, only 10000:20000 are for tuning"),
        ("10000:10008", "9999:10008", "robots 9999:10008 may judge"),
        ("15000:15008", "19999:20001", "robots 19999:20001 may judge"),
        (
            "15000:15008",
            "none",
            "tuned values mine.Mine.tuned.toml, which servobench tune makes: invalid",
        ),
        ("15000:15008", "1:x", "invalid literal for int() with base 10: 'x'"),
        ("seeds", "robots", "mine.Mine.tuned.toml, which servobench tune makes: 'seeds'"),
        ("gain", "grain", "Mine has no setting 'grain': did you mean 'gain'?"),
        ("gain = 3.0", "gain = 'x'", "tune makes: Mine.gain must be a number, got 'x'"),
        ("[settings]", "[settings", "is not valid TOML"),
    ],
)
def test_a_wrong_file_of_values_is_refused_in_one_line(tuned, refusal_of, old, new, message):
    tuned.write_text(tuned.read_text().replace(old, new))
    assert message in refusal_of("run", "./mine.py", "--plant", "kinematic", "--out", "r")


def test_a_batch_is_not_resumed_with_other_tuned_values(tuned, output_of, refusal_of):
    words = ("sweep", "--controllers", "./mine.py", "--plants", "kinematic", "--tasks", "exp2")
    words = (*words, "--seeds", "1", "--workers", "1", "--out", "s")
    assert "Mine †" in output_of(*words)
    tuned.write_text(tuned.read_text().replace("gain = 3.0", "gain = 4.0"))
    assert "Mine.gain 3.0 there, 4.0 here" in refusal_of(*words, "--resume")


@pytest.mark.usefixtures("short_runs")
def test_a_study_of_other_code_is_not_continued(mine, output_of, refusal_of):
    words = ("tune", "--controllers", "./mine.py", *SMALL, "--trials", "1", "--out", "s")
    output_of(*words)
    mine.write_text(f"{MINE}\n# edited\n")
    line = refusal_of(*words)
    assert "Mine.jsonl was made with other code of the controller; name another folder" in line


def test_a_class_given_in_python_has_the_values_beside_its_file(tuned, tmp_path):
    module = SourceFile.read("./mine.py").load()
    rows = [servobench.run(each, task="exp2").row for each in (module.Mine, "./mine.py")]
    untuned = servobench.run(module.Mine, task="exp2", settings={"Mine": {"gain": 0.5}}).row
    given, named = (row["settling_time_s"] for row in rows)
    assert given == named < untuned["settling_time_s"]


@pytest.mark.parametrize(
    ("field", "message"),
    [
        ("float, Tuned(5.0, 1.0)] = 2.0", "mine.py:13: ValueError: wanted two finite numbers, the"),
        ("float, Tuned(1.0, 1.0)] = 1.0", "; got Tuned(low=1.0, high=1.0, log=False)"),
        ("float, Tuned('a', 1.0)] = 1.0", "; got Tuned(low='a', high=1.0, log=False)"),
        ("float, Tuned(1.0, float('inf'))] = 1.0", "wanted two finite numbers"),
        ("float, Tuned(0, 1.0, log=True)] = 1.0", "and above 0 with log=True; got Tuned(low=0, "),
        ("float, Tuned(1.0)] = 1.0", "missing 1 required positional argument: 'high'"),
        ("float, Tuned(1.0, 2.0)] = 3.0", "must hold the default, a number; it is 3.0"),
        ("str, Tuned(1.0, 2.0)] = 'a'", "must hold the default, a number; it is 'a'"),
        ("bool, Tuned(0, 1)] = True", "must hold the default, a number; it is True"),
        ("int, Tuned(0.5, 9)] = 3", "Mine.gain must be a whole number, got 0.5"),
        ("NonNegative, Tuned(-1.0, 9.0)] = 3.0", "Mine.gain must be at least 0, got -1.0"),
        ("'Unknown', Tuned(1.0, 2.0)] = 1.0", "name 'Unknown' is not defined"),
        ("float, 1.0] = 1.0", "controller Mine declares no range: write for instance gain: Anno"),
    ],
)
def test_a_wrong_range_is_refused_in_one_line(mine, refusal_of, tmp_path, field, message):
    number = "from servobench.plant.contract.settings import NonNegative\n"
    text = MINE.replace("float, Tuned(0.5, 20.0, log=True)] = 0.5", field)
    mine.write_text(f"{number}{text}")
    assert message in refusal_of("tune", "--controllers", "./mine.py", *SMALL, "--out", "s")
    assert not (tmp_path / "s").exists()


def test_whole_numbers_and_nested_settings_are_searched_where_declared(mine):
    inner = (
        "@dataclass(frozen=True)\nclass Inner:\n    window: Annotated[int, Tuned(2, 9)] = 3\n\n\n"
    )
    text = MINE.replace("@dataclass", f"{inner}@dataclass", 1)
    text = text.replace("class Config:\n", "class Config:\n    inner: Inner = Inner()\n")
    mine.write_text(text)
    space = find_space(choose_controller("./mine.py"))
    assert space["inner.window"] == IntDistribution(2, 9)
    assert space["gain"] == FloatDistribution(0.5, 20.0, log=True)


def test_with_aids_the_space_has_those_that_are_on_as_that_of_our_methods(mine):
    mine.write_text(MINE.replace("aids = None", "aids = servobench.EQUIPPED"))
    ours = {key: box for key, box in SPACES["ukf_mfac"].items() if key.startswith("aids.")}
    space = find_space(choose_controller("./mine.py"))
    assert {key: box for key, box in space.items() if key != "law.gain"} == ours
    some = "{**servobench.EQUIPPED, 'feedforward': False}"
    mine.write_text(MINE.replace("aids = None", f"aids = {some}"))
    fewer = find_space(choose_controller("fewer=./mine.py"))
    assert set(space) - set(fewer) == {"aids.feedforward"}
    assert len(EQUIPPED) > 6


def test_the_untuned_among_tuned_are_named_with_the_command():
    manifest = {
        "controllers": ["Mine", "ukf_mfac", "nmpc_calibrated"],
        "own_controllers": {"Mine": {"place": "./mine.py"}, "Given": {"place": "Given"}},
    }
    line = "Not tuned, unlike the others: Mine"
    remedy = "; remedy: servobench tune --controllers ./mine.py"
    assert describe_tuning(manifest) == [f"{line}{remedy}"]
    assert describe_tuning(manifest, command=False) == [line]
    more = manifest | {"controllers": ["Mine", "Given", "ukf_mfac", "mfac+rls"]}
    assert describe_tuning(more) == [f"{line}, Given, mfac+rls{remedy}"]
    assert describe_tuning(manifest | {"controllers": ["Mine", "nmpc_calibrated"]}) == []
    pilot = {"controllers": ["pilot", "rls"], "own_controllers": {"pilot": {"place": "fmu:a.fmu"}}}
    assert describe_tuning(pilot) == []
    tuned = manifest | {"tuned": {"Mine": {"budget": "1 × 2 trials"}}}
    assert describe_tuning(tuned) == ["† Mine was tuned: 1 × 2 trials"]
    (line,) = describe_tuning(tuned | {"changed": {"run.period": 0.1, "Mine.gain": 2.0}})
    assert line == "† Mine was tuned: 1 × 2 trials, and then given other settings"


def test_values_are_only_those_of_the_folder_of_the_code(tuned, own_folder):
    assert gain_of("./mine.py") == 3.0
    tuned.unlink()
    assert gain_of("again=./mine.py") == 0.5
