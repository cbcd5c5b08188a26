"""FMUs as controllers by a mapping: ours equal the originals, foreign ones close a loop, bad ones are refused."""

from zipfile import ZipFile

import numpy as np
import pytest

from kit.command import servobench
from kit.controller_fmus import exported
from kit.foreign_fmu import build_crane, build_pilot, mapping
from servobench.harness.batch.api import run
from servobench.harness.config.registry import choose_controller, find_controller
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark

SETTINGS = {"kinematic": {"sensing": {"drop_probability": 0.05}}}
MAPPING = """
file = "map.fmu"
outputs = "joint_velocity_command"
joints = ["joint_position"]
features = "feature"
reference = "reference"
seen = "seen"
"""
PILOT = """
file = "pilot.fmu"
outputs = ["rate.slew", "rate.luff"]
features = ["hook.slew", "hook.luff"]
joints = ["angle.slew", "angle.luff"]
reference = ["goal.slew", "goal.luff"]
seen = ["clear.slew", "clear.luff"]
parameters = {gain = 1.5}
"""


@pytest.mark.parametrize(("name", "version"), [("ukf_mfac:published", 2), ("regression_mfac", 3)])
def test_an_exported_controller_as_an_fmu_equals_the_original_in_every_step(name, version):
    archive = exported(name, version)
    with ZipFile(archive) as opened:
        page = opened.read("documentation/index.html").decode()
    assert "robot = ur5\nsensing = position\n" in page
    fmu = choose_controller(str(archive))
    native, plugged = (
        run(each, task="random", mismatch="moderate", seed=3, settings=SETTINGS)
        for each in (name, fmu)
    )
    assert plugged.row["status"] == native.row["status"] == "completed"
    columns = [
        column
        for column in native.steps
        if column.startswith(("q_", "y_", "u_", "command", "joint", "feature"))
    ]
    assert columns
    difference = np.abs(
        plugged.steps[columns].to_numpy(float) - native.steps[columns].to_numpy(float)
    )
    assert np.nanmax(difference) < 1e-9


def test_a_mapping_names_the_variables_and_a_saved_state_goes_on_with_equal_bits(tmp_path):
    (tmp_path / "map.fmu").write_bytes(exported("ukf_mfac:published", 2).read_bytes())
    (tmp_path / "mine.toml").write_text(MAPPING)
    name = choose_controller(str(tmp_path / "mine.toml"))
    assert name == f"fmu:{tmp_path / 'mine.toml'}"
    request = RunRequest("kinematic", name, "target", "moderate", 1)
    experiment = build(resolve(request, Settings()))
    plant, controller = experiment.plant, experiment.controller
    desired = experiment.scenario.reference.sampled(plant.spec.period, 60)
    rows = 1 + experiment.run.preview_rows

    def go(observation, first, last):
        commands = []
        for k in range(first, last):
            commands.append(controller.step(observation, desired[k : k + rows]))
            observation = plant.step(commands[-1])
        return observation, np.array([command.joint_velocity for command in commands])

    observation = plant.reset(0)
    controller.reset(observation, 0)
    observation, first = go(observation, 0, 20)
    saved = plant.save(), controller.save()
    _, straight = go(observation, 20, 40)
    plant.restore(saved[0])
    controller.restore(saved[1])
    _, again = go(observation, 20, 40)
    np.testing.assert_array_equal(again, straight)
    plant.restore(saved[0])
    controller = build(
        resolve(request, Settings())
    ).controller  # a new one, which goes on and begins anew
    controller.restore(saved[1])
    np.testing.assert_array_equal(go(observation, 20, 40)[1], straight)
    observation = plant.reset(0)
    controller.reset(observation, 0)
    np.testing.assert_array_equal(go(observation, 0, 20)[1], first)
    assert controller.estimated_jacobian() is None
    plant.close()


def test_a_foreign_controller_and_a_foreign_plant_close_a_loop_without_code(tmp_path):
    build_crane(tmp_path / "crane.fmu", 2)
    build_pilot(tmp_path / "pilot.fmu")
    (tmp_path / "crane.toml").write_text(mapping(2))
    (tmp_path / "pilot.toml").write_text(PILOT)
    done = run(
        str(tmp_path / "pilot.toml"), f"fmu:{tmp_path / 'crane.toml'}", task="target", mismatch="none",
        settings={"target": {"target": [0.2, 0.7]}},
    )  # fmt: skip
    assert done.row["outcome"] == "settled", done.row["reason"]


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (MAPPING.replace('"feature"', '"featur"'), "features names 'featur', which map.fmu does not have"),
        (MAPPING.replace('["joint_position"]', '["seen"]'),
         "joints must name 6 numbers for 6 joints and 3 features, got 3"),
        (MAPPING.replace('joints = ["joint_position"]', 'joints = ["joint_velocity_command"]'), "causality output"),
        (MAPPING.replace('"reference"', '"feature"'), r"reference names 'feature\[1\]' as features does"),
        (MAPPING.replace('["joint_position"]', str(["joint_position[1]"] * 6)), r"names 'joint_position\[1\]' twice"),
        (MAPPING.replace("outputs =", "output ="), "the key 'outputs' is missing"),
        (MAPPING.replace("map.fmu", "none.fmu"), "none.fmu"),
    ],
)  # fmt: skip
def test_a_bad_mapping_is_refused_by_a_line(tmp_path, text, message):
    (tmp_path / "map.fmu").write_bytes(exported("ukf_mfac:published", 2).read_bytes())
    (tmp_path / "bad.toml").write_text(text)
    with pytest.raises(ConfigurationError, match=message) as refused:
        build(
            resolve(
                RunRequest("kinematic", f"fmu:{tmp_path / 'bad.toml'}", "target", "none", 1),
                Settings(),
            )
        )
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("text", "period", "message"),
    [
        (MAPPING, 0.02, "map.fmu is meant for a period of 0.05 s, and run.period is 0.02 s"),
        (
            MAPPING.replace("joints =", "# joints ="),
            0.05,
            "no role of the mapping names the input joint_position[1]",
        ),
    ],
)
def test_an_unlikely_mapping_is_remarked_on_by_the_process_that_the_user_sees(
    tmp_path, monkeypatch, caplog, no_figures, text, period, message
):
    (tmp_path / "map.fmu").write_bytes(exported("ukf_mfac:published", 2).read_bytes())
    (tmp_path / "mine.toml").write_text(text)
    settings = (
        "--set",
        "target.duration=0.2",
        "--set",
        f"run.period={period}",
        "--out",
        str(tmp_path / "out"),
    )
    name = str(tmp_path / "mine.toml")
    remark.cache_clear()
    assert (
        servobench(
            monkeypatch,
            "run",
            "--controller",
            name,
            "--plant",
            "kinematic",
            "--task",
            "target",
            *settings,
        )
        == 0
    )
    assert sum(message in line for line in caplog.messages) == 1


def test_an_fmu_without_the_names_of_exported_controllers_asks_for_a_mapping(tmp_path):
    build_pilot(tmp_path / "pilot.fmu")
    with pytest.raises(
        ConfigurationError, match="has no joint_velocity_command, feature, reference.*pilot.toml"
    ):
        find_controller(f"fmu:{tmp_path / 'pilot.fmu'}")
