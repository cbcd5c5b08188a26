"""Runs with another robot than the UR5, or of gears that are rippled: names, tables, tasks, and refusals."""

from dataclasses import replace

import casadi
import numpy as np
import pytest

from kit.lanes import assert_rows_of_single_runs
from kit.plants import NEEDS_MUJOCO
from kit.robots import DRIVEN_TWIN, FOUR_JOINTS
from servobench.harness.apps.films.replay import logged_run
from servobench.harness.apps.fmu.products import arm_product, loop_products
from servobench.harness.batch.manifest import describe_robot
from servobench.harness.config import registry
from servobench.harness.config.registry import find_controller
from servobench.harness.config.settings import Settings, default_config
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve, resolve_sections
from servobench.harness.run.tasks import TASKS, fitted
from servobench.harness.run.training import train_networks
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.settings import remark
from servobench.plant.kinematic import ENTRY
from servobench.plant.robot.catalogue import find_robot

PANDA = RunRequest("kinematic", "regression_mfac", "exp2", "moderate", 3, robot="panda")
SHORT = Settings({"exp2": {"duration": 3.0}})


def test_a_run_of_a_panda_settles_and_says_whose_it_is():
    result = run_experiment(PANDA, SHORT)
    assert (result.row["outcome"], result.row["robot"]) == ("settled", "panda")
    assert result.row["run_id"] == "kinematic-panda-regression_mfac-exp2-moderate-3"
    assert sum(name.startswith("joint_position_") for name in result.steps) == 7


def test_the_ur5_is_not_named():
    assert replace(PANDA, robot="ur5").run_id == "kinematic-regression_mfac-exp2-moderate-3"
    assert [fitted(entry.name, find_robot("ur5")) for entry in TASKS.values()] == [
        each.default for each in TASKS.values()
    ]


def test_runs_of_a_panda_side_by_side_have_the_rows_of_single_ones():
    settings = Settings({"random": {"duration": 1.0}})
    requests = [replace(PANDA, task="random", seed=seed) for seed in (1, 2)]
    assert_rows_of_single_runs([resolve(each, settings) for each in requests])


@pytest.mark.parametrize(
    "task", ["circle", "lemniscate", "line", "target", "unreachable", "endurance", "random"]
)
def test_a_task_is_as_far_away_as_the_arm_is_long(task):
    robot, entry = find_robot("ur3e"), TASKS[task]
    own, scale = fitted(task, robot), robot.workspace.scale
    for name in ("centre", "begin", "end", "target"):
        if hasattr(own, name):
            np.testing.assert_allclose(
                getattr(own, name), scale * np.array(getattr(entry.default, name))
            )
    for name in ("radius", "shortest", "lowest"):
        if getattr(own, name, None) is not None:
            assert getattr(own, name) == pytest.approx(scale * getattr(entry.default, name))
    for name in ("duration", "lap_time", "laps"):
        assert getattr(own, name, None) == getattr(entry.default, name, None)


def test_a_taught_random_move_is_free_of_contact():
    work = find_robot("panda").workspace
    for seed in range(5):
        request = replace(PANDA, task="random", mismatch="none", seed=seed)
        assert work.clear(build(resolve(request, Settings())).scenario.start)


def test_a_batch_has_one_robot():
    with pytest.raises(ConfigurationError, match="a batch has one robot, got panda, ur5"):
        resolve_sections([PANDA, replace(PANDA, robot="ur5")], Settings())


def test_the_manifest_says_which_arm_it_was(tmp_path):
    path = tmp_path / "four.toml"
    path.write_text(FOUR_JOINTS)
    told = describe_robot(str(path))
    assert (told["title"], len(told["home_rad"])) == ("four", 4)
    assert "estimated from the lengths" in told["note"]


def test_a_robot_for_a_plant_that_brings_its_own_is_refused(monkeypatch):
    monkeypatch.setattr(registry, "installed_plant", lambda name: replace(ENTRY, own_robot=True))
    with pytest.raises(
        ConfigurationError, match="brings a robot of its own, so the robot panda does not apply"
    ):
        resolve(PANDA, Settings())


@pytest.mark.slow
def test_of_an_arm_that_nobody_knows_a_method_probes_and_learns_all():
    request = replace(
        PANDA, robot="random_arm:3", controller="ukf_mfac", task="random", mismatch="none"
    )
    experiment = build(resolve(request, Settings()))
    knowledge = experiment.controller.servo.knowledge
    assert (knowledge.nominal_jacobian, knowledge.train) == (None, None)
    config, known = (
        default_config(find_controller("ukf_mfac"), model_known=each) for each in (False, True)
    )
    assert (config.initial.source, known.initial.source) == ("probe", "nominal")
    assert config.estimator == type(config.estimator)() != known.estimator
    assert (config.law, config.aids) == (known.law, known.aids)
    assert run_experiment(request, Settings(), steps=False).row["outcome"] == "settled"
    with pytest.raises(ConfigurationError, match="controllers know none of random_arm_3"):
        train_networks("rbfnn_mfac", Settings(), lambda share, what: None, "random_arm:3")


def test_what_counts_on_no_model_keeps_its_values_on_an_arm_that_nobody_knows():
    published, bound = find_controller("ukf_mfac:published"), find_controller("calibrated")
    assert (
        default_config(published, model_known=False).estimator
        == default_config(published).estimator
    )
    assert default_config(bound, model_known=False) == default_config(bound)


def test_bounds_are_given_the_kinematics_of_rippled_gears():
    request = RunRequest("kinematic", "calibrated", "circle", "moderate+ripple=0.03rad", 3)
    experiment = build(resolve(request, Settings()))
    experiment.plant.reset(0)
    truth, start = experiment.plant.truth(), np.asarray(experiment.scenario.start)
    knowledge = experiment.controller.servo.knowledge
    np.testing.assert_allclose(knowledge.true_jacobian(start), truth.jacobian, atol=1e-12)
    q = casadi.MX.sym("q", 6)
    feature = casadi.Function("h", [q], [knowledge.true_symbolic(q)])
    np.testing.assert_allclose(feature(start).full().ravel(), truth.feature, atol=1e-12)


@NEEDS_MUJOCO
def test_worlds_without_gears_and_tool_are_refused_in_one_line():
    mismatch = "moderate+backlash=2deg"
    with pytest.raises(
        ConfigurationError, match="mujoco has no mechanics.backlash, .*those of kinematic and fmu"
    ):
        resolve(RunRequest("mujoco", "regression_mfac", "circle", mismatch, 3), Settings())


@pytest.mark.parametrize(
    ("mismatch", "robot", "lag", "backlash"),
    [
        ("none", "ur5", 0.05, 0.0),
        ("lab", "ur5", 0.03, 0.0),
        ("moderate+backlash=2deg", "ur5", 0.05, np.radians(2.0)),
        ("none", "twin.toml", None, 0.005),
    ],
)
def test_an_exported_arm_has_the_drive_of_its_run(
    tmp_path, monkeypatch, mismatch, robot, lag, backlash
):
    monkeypatch.chdir(tmp_path)
    play = "[plant.mechanics]\nbacklash = 0.005\n"
    (tmp_path / "twin.toml").write_text(DRIVEN_TWIN + play, encoding="utf-8")
    request = RunRequest("kinematic", "constant", "target", mismatch, 3, robot=robot)
    plant = resolve(request, Settings()).plant
    assert lag in (None, plant.lag)
    assert abs(plant.lag - 0.2) > 0.001  # of seed 3, not the mean
    start = arm_product(request, "words").description.start
    np.testing.assert_array_equal(start["lag"], np.full(6, plant.lag))
    np.testing.assert_allclose(start["backlash"], np.full(6, backlash), rtol=1e-12)


def test_the_arm_of_a_loop_has_the_settings_of_its_plant_or_refuses_them():
    request = RunRequest("kinematic", "rbf_pid:published", "target", "none", 2)
    own = {"lag": 0.2, "max_joint_speed": 0.5, "mechanics": {"tool_frequency": 12.0}}
    plant, controller, _ = loop_products(
        request, Settings({"kinematic": own, "run": {"period": 0.02}})
    )
    assert plant.description.step == controller.description.step == 0.02
    start = plant.description.start
    assert [float(np.max(start[name])) for name in ("lag", "max_speed", "tool_frequency")] == [
        0.2,
        0.5,
        12.0,
    ]
    with pytest.raises(
        ConfigurationError, match="commanded a period later: leave kinematic.sensing.latency out"
    ):
        loop_products(request, Settings({"kinematic": {"sensing": {"latency": 0.1}}}))


def test_a_run_under_a_turning_camera_is_not_filmed():
    request = RunRequest("kinematic", "regression_mfac", "circle", "moderate+camera_turn=15deg", 3)
    result = run_experiment(request, Settings())
    with pytest.raises(
        ConfigurationError, match="cannot be shown: films have no camera that turns"
    ):
        logged_run(result.row, result.steps)


@pytest.mark.parametrize(
    "setting", [{"sensing": {"camera_turn": 0.2}}, {"mechanics": {"tool_frequency": 12.0}}, {}]
)
def test_a_film_whose_ball_is_elsewhere_than_the_arm_has_it_says_so(caplog, setting):
    remark.cache_clear()
    request = RunRequest("kinematic", "regression_mfac", "exp1", "moderate", 3)
    result = run_experiment(request, Settings({"kinematic": setting, "exp1": {"duration": 3.0}}))
    logged_run(result.row, result.steps)
    assert (
        "films have no play of gears, no flexible tool and no camera that turns" in caplog.text
    ) == bool(setting)
