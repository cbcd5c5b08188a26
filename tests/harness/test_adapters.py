"""Plants of users, given by the place of their code or as classes: found, run, checked, and refused in one line."""

import json
import re
from dataclasses import replace

import pytest

import servobench
from kit.command import servobench as command
from kit.own import CELL, CONFIGURED_CELL, PLAIN_CELL, WHOLE, write
from servobench.harness.batch.differences import changed_source
from servobench.harness.config.registry import choose_controller, choose_plant, find_plant, offered
from servobench.plant.contract.faults import ConfigurationError

SHORT = {"exp1": {"duration": 0.5}}
ENTRY = '\n\nENTRY = servobench.PlantEntry("cell", "one line", CellConfig, Cell)\n'

pytestmark = pytest.mark.usefixtures("own_folder")


@pytest.mark.parametrize(
    ("text", "place", "name"),
    [
        (CELL, "./cell.py", "Cell"),
        (CONFIGURED_CELL, "./cell.py", "Cell"),
        (CONFIGURED_CELL + ENTRY, "./cell.py", "cell"),
        (PLAIN_CELL, "./cell.py", "Plain"),
        (CELL + WHOLE, "./cell.py", "Cell"),  # a file may hold a controller, too
    ],
)
def test_a_plant_is_found_by_the_place_of_its_code(tmp_path, text, place, name):
    path = write(tmp_path, text, "cell.py")
    assert choose_plant(place) == name
    entry = find_plant(name)
    assert entry.name == name
    assert entry.own_robot == (text is PLAIN_CELL)
    record = offered([name])[0].record()
    assert (record["place"], record["file"]) == (place.partition("=")[2] or place, str(path))
    assert re.fullmatch("[0-9a-f]{64}", record["sha256"])


@pytest.mark.parametrize("text", [CELL, CONFIGURED_CELL, CONFIGURED_CELL + ENTRY, PLAIN_CELL])
def test_a_whole_plant_passes_every_check(tmp_path, text):
    write(tmp_path, text, "cell.py")
    report = servobench.check_plant("./cell.py")
    assert {each.verdict for each in report.findings} == {"ok"}, report
    assert len(report.findings) == 9


def test_a_world_has_the_settings_of_a_bench_and_the_noise_that_they_ask_for(tmp_path):
    write(tmp_path, CELL, "cell.py")
    last = {}
    for noise in (0.0, 0.01):
        settings = SHORT | {"Cell": {"sensing": {"feature_noise": noise}}}
        steps = servobench.run("constant", "./cell.py", settings=settings).steps
        last[noise] = (steps["feature_x_m"] - steps["true_feature_x_m"]).std()
    assert last[0.0] == 0.0
    assert 0.003 < last[0.01] < 0.03
    with pytest.raises(
        ConfigurationError, match="plant Cell: the plant has no camera that could be moved; leave"
    ):
        servobench.run("constant", "./cell.py", mismatch="camera_move=30deg", settings=SHORT)


def test_settings_of_a_plant_reach_it(tmp_path):
    write(tmp_path, CONFIGURED_CELL, "cell.py")
    speeds = {}
    for speed in (0.5, 1.0):
        run = servobench.run("constant", "./cell.py", settings={"Cell": {"speed": speed}, **SHORT})
        speeds[speed] = run.steps.filter(regex="^joint_position").diff().abs().max().max() / 0.05
    assert speeds[0.5] == pytest.approx(0.5)
    assert speeds[1.0] == pytest.approx(1.0)


def test_a_class_is_taken_in_python_and_its_robot_may_be_its_own():
    from kit.toy_plants import Plain

    class Fixed(Plain):
        def __init__(self, setup):
            super().__init__(replace(setup, period=0.02))

    target = {"target": [0.0, 0.0], "duration": 6.0}
    how = {
        "mismatch": "none",
        "settings": {"target": target, "constant": {"initial": {"source": "probe"}}},
    }
    run = servobench.run("constant", Plain, task="target", **how)
    assert run.row["outcome"] == "settled", run.row["reason"]
    with pytest.raises(
        ConfigurationError, match=r"Fixed: spec\.period must be that of its setup, 0\.05 s"
    ):
        servobench.run("constant", Fixed, task="target", **how)


def test_what_changed_since_a_batch_began_is_named():
    def manifest(text="1", arm="1"):
        plugin = {"place": "some.law:Mine", "distribution": "some 1.0", "sha256": text}
        return {
            "own_controllers": {},
            "own_plants": {},
            "plugins": {"mine": plugin},
            "files": {"arm.toml": arm},
        }

    there = json.loads(json.dumps(manifest()))
    assert changed_source(there, manifest()) == ""
    assert changed_source({}, manifest()) == ""
    assert changed_source(there, manifest(text="2")) == "some.law:Mine"
    assert changed_source(there, manifest(arm="2")) == "arm.toml"


def test_a_plant_and_a_controller_cannot_share_a_name(tmp_path):
    write(tmp_path, CELL, "cell.py")
    write(tmp_path, WHOLE)
    assert choose_plant("Same=./cell.py") == "Same"
    with pytest.raises(
        ConfigurationError, match=r"\./cell\.py and \./mine\.py are both called 'Same'"
    ):
        choose_controller("Same=./mine.py")
    for name, what in (
        ("kinematic", "a plant"),
        ("ukf_mfac", "a controller"),
        ("run", "a section of settings"),
    ):
        with pytest.raises(ConfigurationError, match=f"{what} called '{name}' exists already"):
            choose_plant(f"{name}=./cell.py")
    with pytest.raises(
        ConfigurationError, match="a task is called 'circle', too; give the plant another name"
    ):
        servobench.run("constant", "circle=./cell.py", task="circle")


BROKEN = {
    "no advance": (CELL.replace("def advance", "def go"), "cell.py:6: class Cell lacks advance, which it must define"),
    "nothing in it": (
        WHOLE,
        "./cell.py defines no plant: no subclass of servobench.Plant or servobench.World and no ENTRY; "
        "it defines the controller Mine",
    ),
    "no setup": (CELL.replace("self, setup", "self"),
        "cell.py:6: Cell.__init__ must take (self, setup) or (self, config, setup), got (self)"),
    "an object": (PLAIN_CELL + "from types import SimpleNamespace\nENTRY = Plain(SimpleNamespace(period=0.05))\n",
        "./cell.py is a plant that is built already; give its class"),
    "exception in the constructor": (CELL.replace("setup.limits", "setup.limit"),
        "plant Cell: cell.py:12: AttributeError: 'PlantSetup' object has no attribute 'limit'"),
    "no spec": (CELL.replace("self.spec = servobench", "spec = servobench"),
        "plant Cell: Cell.__init__ must set self.spec to a servobench.PlantSpec, got nothing"),
    "an entry that builds something else": (CONFIGURED_CELL + ENTRY.replace("Cell)", "lambda config, setup: 3)"),
        "plant cell: it is built as int, wanted a servobench.Plant"),
}  # fmt: skip


@pytest.mark.parametrize("what", BROKEN)
def test_a_broken_file_is_one_line_with_its_place(tmp_path, what):
    text, message = BROKEN[what]
    write(tmp_path, text, "cell.py")
    with pytest.raises(ConfigurationError, match=f"^{re.escape(message)}") as refused:
        servobench.run("constant", "./cell.py", settings=SHORT)
    assert "\n" not in str(refused.value)


@pytest.mark.slow
def test_a_command_refuses_a_broken_engine_with_its_line_and_exit_code_2(refusal_of, tmp_path):
    write(
        tmp_path, CONFIGURED_CELL + ENTRY.replace("Cell)", "Cell, engine=lambda: 1 / 0)"), "cell.py"
    )
    line = refusal_of("run", "--plant", "./cell.py", "constant")
    assert line.startswith("servobench: cell.py:42: ZeroDivisionError: division by zero")
    assert [path.name for path in tmp_path.iterdir()] == ["cell.py"]


SEEN, MOVED = "return self.model.feature(self.q)\n", "return self.q\n\n    def see"
FAILING = [
    (SEEN, "1 / 0", r"ZeroDivisionError: .*cell\.py:26 in Cell\.see"),
    (SEEN, "return 'here'\n", "Cell.see must return 3 features, or None, got 'here'"),
    (
        MOVED,
        MOVED.replace("self.q", "self.q[:5]"),
        r"Cell\.advance must return 6 joint positions, got shape \(5,\)",
    ),
    (
        MOVED,
        MOVED.replace("self.q", "self.q * np.nan"),
        r"Cell\.advance returned \[nan, .* not finite",
    ),
]


@pytest.mark.parametrize(("line", "with_", "reason"), FAILING)
def test_what_fails_in_a_run_is_a_row_that_says_where(tmp_path, line, with_, reason):
    write(tmp_path, CELL.replace(line, with_, 1), "cell.py")
    table = servobench.compare(["constant"], ["./cell.py", "kinematic"], settings=SHORT)
    assert table["outcome"].tolist()[0] != table["outcome"].tolist()[1]
    assert re.search(reason, table["reason"].iloc[0]), table["reason"].iloc[0]


def test_a_plant_is_named_on_every_command_that_takes_one(
    refusal_of, output_of, no_figures, tmp_path, monkeypatch
):
    write(tmp_path, CONFIGURED_CELL, "cell.py")
    assert json.loads(output_of("plants", "./cell.py", "--json"))[0]["setting"] == "Cell.speed"
    assert "./cell.py: keeps its contract" in output_of("check", "plant", "./cell.py")
    assert command(monkeypatch, "init", "--plants", "./cell.py", "cell.toml") == 0
    assert "[Cell]" in (tmp_path / "cell.toml").read_text()
    asked = [
        "--plants",
        "./cell.py",
        "--controllers",
        "constant",
        "--tasks",
        "exp1",
        "--no-report",
        "--workers",
        "1",
    ]
    assert "exp1 on Cell, moderate" in output_of(
        "compare", *asked, "--config", "cell.toml", "--out", "out"
    )
    write(tmp_path, PLAIN_CELL, "own.py")
    line = refusal_of(
        "robustness", "--plant", "./own.py", "--controllers", "constant", "--out", "map"
    )
    assert "the map varies the true robot, and plant Plain brings one of its own" in line
