"""Other robots in the plants that are compiled and rendered, by `servobench fmu …`, and in pictures."""

import numpy as np
import pytest

from kit.command import servobench
from kit.own import write
from kit.plants import NEEDS_BULLET
from kit.robots import FOUR_JOINTS, calibration_text
from servobench.harness.apps.fmu.inspection import read_information, validate_fmu
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS

SHORT = Settings({"exp2": {"duration": 3.0}, "bullet": {"scenery": False}})


@pytest.fixture
def ur10e(tmp_path):
    path = write(tmp_path, calibration_text(UNIVERSAL_ROBOTS["UR10e"], seed=1), "ur10e.yaml")
    return str(path)


@pytest.fixture
def four(tmp_path):
    path = write(tmp_path, FOUR_JOINTS, "four.toml")
    return str(path)


def test_the_fmu_of_a_panda_has_seven_joints_and_its_reference_run(
    output_of, monkeypatch, capsys, tmp_path
):
    path = tmp_path / "panda.fmu"
    arguments = "--robot", "panda", "--mismatch", "moderate", "--seed", "3", "-o", str(path)
    assert servobench(monkeypatch, "fmu", "export", *arguments) == 0
    found = validate_fmu(path)
    assert (found.problems, found.deviation < 1e-9) == ((), True)
    capsys.readouterr()
    shown = output_of("fmu", "info", path)
    assert "Panda with mismatched kinematics" in shown
    assert (
        "capabilities in co-simulation: canNotUseMemoryManagementFunctions, canGetAndSet"
        in " ".join(shown.split())
    )
    assert "joint_offset[7]" in shown
    assert "no problem found" in output_of("fmu", "validate", path)


def test_an_exported_robot_is_that_of_the_run_with_the_same_mismatch_and_seed(
    monkeypatch, tmp_path
):
    path = tmp_path / "ur5.fmu"
    arguments = "--fmi", "3", "--mismatch", "severe", "--seed", "3", "-o", str(path)
    assert servobench(monkeypatch, "fmu", "export", *arguments) == 0
    start = {
        variable.name: variable.start
        for variable in read_information(path).description.modelVariables
    }
    run = build(resolve(RunRequest("kinematic", "constant", "exp2", "severe", 3), Settings()))
    exported = np.array(start["joint_offset"].split(), dtype=float)
    np.testing.assert_allclose(exported, run.drawn.sample.joint_offset, rtol=1e-12)


@pytest.mark.parametrize("name", ["panda", "four", "ur10e"])
def test_an_arm_is_the_same_as_fmu_and_in_numpy(name, request):
    robot = name if name == "panda" else request.getfixturevalue(name)
    runs = [
        run_experiment(
            RunRequest(plant, "regression_mfac", "exp2", "moderate", 3, robot=robot), SHORT
        )
        for plant in ("kinematic", "fmu")
    ]
    features = [run.steps.filter(regex="^true_feature_").to_numpy() for run in runs]
    assert [run.row["outcome"] for run in runs] == ["settled", "settled"]
    np.testing.assert_allclose(features[0], features[1], atol=1e-9)


@NEEDS_BULLET
@pytest.mark.parametrize("name", ["panda", "ur10e"])
def test_a_rendered_arm_settles_and_can_be_shown(name, request):
    from servobench.harness.apps.films.replay import Replay, logged_run

    robot = name if name == "panda" else request.getfixturevalue(name)
    result = run_experiment(
        RunRequest("bullet", "regression_mfac", "exp2", "moderate", 3, robot=robot), SHORT
    )
    assert (result.row["outcome"], result.row["reason"]) == ("settled", "")
    shown = logged_run(result.row, result.steps)
    with Replay(shown) as replay:
        replay.place(0)
        first = replay.overview([])
        replay.place(len(shown.joint_position) - 1)
        assert (first != replay.overview([])).any()
        assert replay.camera_view().shape == (240, 320, 3)
