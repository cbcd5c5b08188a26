import pickle

import pytest

from kit.plants import NEEDS_BULLET
from servobench.controllers.controller import ControllerEntry, Delays
from servobench.harness.config.entries import CONTROLLER, own_object
from servobench.harness.config.registry import (
    controller_names,
    engine_of,
    find_controller,
    offering,
)
from servobench.harness.config.settings import Settings, read_settings
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import resolve
from servobench.harness.run.variations import varied_in_row
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.robot.mismatch import Mismatch


@pytest.mark.parametrize("controller", [*controller_names(), "mfac+rls"])
def test_a_resolved_run_can_be_sent_to_another_process(controller):
    run = resolve(
        RunRequest(
            "kinematic",
            controller,
            "circle",
            Mismatch("moderate"),
            3,
            {"noise": 2.0, "latency": 0.05},
        ),
        Settings(),
    )
    again = pickle.loads(pickle.dumps(run))
    assert (again.request, again.run, again.plant, again.task) == (
        run.request,
        run.run,
        run.plant,
        run.task,
    )
    assert repr(again.controller) == repr(run.controller)


@pytest.mark.parametrize("varied", [{}, {"latency": 0.1, "controller.law.gain": 3.0}])
def test_a_run_with_another_seed_is_that_run_made_anew(varied):
    place = "kinematic", "ukf_mfac", "circle", "moderate+links=5%"
    first, anew = RunRequest(*place, 3, varied), RunRequest(*place, 41, varied)
    again = first.with_seed(41).with_seed(3)
    for made, wanted in ((first.with_seed(41), anew), (again, first)):
        assert (made, made.run_id) == (wanted, wanted.run_id)
        assert list(made.as_row().items()) == list(wanted.as_row().items())
    with pytest.raises(ConfigurationError, match="seed must be a non-negative integer, got -1"):
        first.with_seed(-1)


def test_a_resolved_run_holds_what_the_user_set_and_what_the_request_varies():
    law = {"law": {"gain": 4.0}}
    settings = Settings({"run": {"preview_time": 0.15}, "circle": {"laps": 1}, "ukf_mfac": law})
    run = resolve(
        RunRequest(
            "kinematic", "ukf_mfac", "circle", Mismatch(), 0, {"latency": 0.1, "period": 0.02}
        ),
        settings,
    )
    assert run.run == RunSettings(0.02, 0.15)
    assert run.task.laps == 1
    assert run.controller.law.gain == 4.0
    assert run.plant.sensing.latency == 0.1


def test_the_text_of_a_mismatch_is_read_and_a_bad_one_refused():
    request = RunRequest("kinematic", "rls", "exp1", "moderate+links=10%", 0)
    assert request.mismatch == Mismatch.parse("moderate+links=10%")
    assert request.as_row()["mismatch"] == "moderate+links=10%"
    assert request.run_id == "kinematic-rls-exp1-moderate+links=10_-0"
    with pytest.raises(ConfigurationError, match="'mild' is not known"):
        RunRequest("kinematic", "rls", "exp1", "mild", 0)


def test_a_run_has_whole_periods():
    assert RunSettings(period=0.05).periods(10.0) == 200
    assert RunSettings(period=0.3).periods(1.0) == 4
    with pytest.raises(ValueError, match="period must be at least"):
        RunSettings(period=0.0)


@pytest.mark.parametrize(
    ("plant", "engine"),
    [
        ("kinematic", ""),
        ("there_is_none", ""),
        pytest.param("bullet", "PyBullet ", marks=NEEDS_BULLET),
    ],
)
def test_a_row_names_the_engine_that_renders_its_plant(plant, engine):
    told = engine_of(plant)
    assert told.startswith(engine)
    assert bool(told) == bool(engine)


def test_varied_settings_are_columns_from_which_they_are_read_again():
    varied = {
        "task.radius": 0.1,
        "mfac.law.gain": 2,
        "noise": 2,
        "period": 0.02,
        "plant.obstacles": [[1.0, 2.0]],
    }
    request = RunRequest("bullet", "mfac", "circle", "none", 0, varied)
    row = request.as_row()
    assert (row["noise_factor"], row["latency_s"], row["period_s"]) == (2.0, None, 0.02)
    assert (row["task.radius"], row["controller.law.gain"]) == (0.1, 2)
    assert row["run_id"].startswith(
        "bullet-mfac-circle-none-noise2-period20ms-controller.law.gain=2-"
    )
    again = RunRequest("bullet", "mfac", "circle", "none", 0, varied_in_row(row))
    assert again == request
    assert hash(again) == hash(request)


LATE = {"command_delay": 0.02, "lag": 0.03, "sensing": {"latency": 0.1}}


def knowledge_of(plant, needs_truth, settings, **request):
    """Return what a controller on a plant is given."""
    seen, constant = [], find_controller("constant")

    def spy(config, knowledge):
        seen.append(knowledge)
        return constant.build(config, knowledge)

    with offering(
        [own_object(CONTROLLER, ControllerEntry("spy", "", constant.config, spy, needs_truth))]
    ):
        run = RunRequest(plant, "spy", "exp1", "moderate", 0, request)
        build(resolve(run, Settings({plant: settings}))).plant.close()
    return seen[0]


def sensor_of(mismatch="moderate", varied=(), robot="ur5", **sections):
    request = RunRequest("kinematic", "constant", "random", mismatch, 3, varied, robot)
    return resolve(request, Settings(sections)).plant.sensing


def test_a_setting_of_the_user_is_kept_beside_a_profile_also_where_it_is_the_default():
    assert sensor_of("lab").latency > 0.0
    assert sensor_of("lab", kinematic={"sensing": {"latency": 0.0}}).latency == 0.0


def test_a_file_that_repeats_defaults_changes_no_world(tmp_path):
    path = tmp_path / "bench.toml"
    path.write_text(
        "[kinematic]\nlag = 0.08\n[kinematic.sensing]\nlatency = 0.0\noutliers = 0.0\njitter = 0.02\n"
    )
    settings = read_settings(path, [])
    plant = resolve(
        RunRequest("kinematic", "constant", "random", "lab+outliers=5%", 3), settings
    ).plant
    assert (plant.sensing.latency, plant.sensing.outliers, plant.lag) == (0.095, 0.05, 0.08)
    with pytest.raises(
        ConfigurationError, match="kinematic.sensing.jitter is set, and the mismatch jitter=50ms"
    ):
        resolve(RunRequest("kinematic", "constant", "random", "jitter=50ms", 3), settings)
    given = read_settings(path, ["kinematic.sensing.latency=0"])
    assert (
        resolve(
            RunRequest("kinematic", "constant", "random", "lab", 3), given
        ).plant.sensing.latency
        == 0.0
    )


@pytest.mark.parametrize("period", [0.005, 0.01, 0.1])
def test_frames_fit_a_period_that_is_varied_as_one_that_is_set(tmp_path, period):
    (tmp_path / "camera.toml").write_text(
        "width = 640\nheight = 480\nvertical_fov = 42.5\nrate = 40.0\n"
    )
    robot = f"ur5 with {tmp_path / 'camera.toml'}"
    varied, given = (
        sensor_of(varied={"period": period}, robot=robot),
        sensor_of(robot=robot, run={"period": period}),
    )
    assert varied == given
    assert varied.frame_period == (0.025 if period < 0.025 else 0.0)


@pytest.mark.parametrize("plant", ["kinematic", "fmu"])
def test_a_bound_knows_the_delays_of_its_plant(plant):
    assert knowledge_of(plant, True, LATE).true_delays == Delays(0.1, 0.02, 0.03)
    assert knowledge_of(plant, True, LATE, latency=0.2, period=0.02).true_delays == Delays(
        0.2, 0.02, 0.03
    )
    known = knowledge_of(
        plant, True, LATE | {"sensing": {"jitter": 0.1, "latency_swing": 0.1, "camera_turn": 0.2}}
    )
    assert known.true_delays == Delays(0.0, 0.02, 0.03, latency_spread=pytest.approx(0.3))
    assert known.true_camera_turn == 0.2


def test_a_competitor_does_not():
    assert knowledge_of("kinematic", False, LATE).true_delays is None


@pytest.mark.parametrize(
    ("period", "rows"), [(0.1, 5), (0.05, 10), (0.02, 25), (0.008, 63), (0.004, 125)]
)
def test_the_preview_is_as_long_at_every_rate(period, rows):
    assert knowledge_of("kinematic", False, {}, period=period).preview == rows


def in_lab(plant, settings=None, mismatch="lab", varied=()):
    request = RunRequest(plant, "constant", "random", Mismatch.parse(mismatch), 0, varied)
    return resolve(request, Settings(settings or {})).plant


def test_a_profile_of_a_laboratory_brings_delays_and_noise_where_the_plant_has_them():
    config = in_lab("kinematic")
    assert (config.command_delay, config.lag, config.sensing.latency) == (0.005, 0.03, 0.095)
    assert config.sensing.feature_noise == 0.0034
    assert in_lab("fmu").command_delay == 0.005
    assert in_lab("kinematic", mismatch="moderate") == KinematicConfig()


@NEEDS_BULLET
def test_features_of_images_keep_their_own_noise_in_a_laboratory():
    config = in_lab("bullet")
    assert (config.lag, config.sensing.latency, config.sensing.feature_noise) == (0.03, 0.095, 0.0)


def test_settings_of_the_user_and_varied_ones_go_before_those_of_a_profile():
    given = {"kinematic": {"sensing": {"latency": 0.009}}}
    assert in_lab("kinematic", given).sensing.latency == 0.009
    assert in_lab("kinematic", given).lag == 0.03
    varied = (("plant.sensing.latency", 0.13),)
    assert in_lab("kinematic", varied=varied).sensing.latency == 0.13
    assert in_lab("kinematic", mismatch="lab+lost_frames=10%").sensing.drop_probability == 0.1
