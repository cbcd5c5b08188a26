"""Both network methods on the kinematic plant: turned, late and moved cameras, circles; one method within the other."""

import dataclasses
from functools import cache

import numpy as np
import pytest

from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.estimators.rbf_aligned import RbfAlignedConfig
from servobench.controllers.laws.rbfnn_bridged import RbfnnBridgedConfig
from servobench.controllers.methods import METHODS
from servobench.controllers.networks.fit import train
from servobench.harness.config.settings import read_settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.request import RunRequest
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.plant import PlantSetup
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import TRAINING_LOWER, TRAINING_UPPER, nominal_ur5

PERIOD, PREVIEW = 0.05, 10
PLUS, PAPER = "rbfnn_mfac_plus", "rbfnn_mfac"
MODEL = nominal_ur5()
SPEC = hand_eye_spec(MODEL, PERIOD, KinematicConfig().max_joint_speed, KinematicConfig().joint_range)
ALL_OFF = dataclasses.replace(
    METHODS[PLUS].config(),
    estimator=RbfAlignedConfig(
        window=8, epsilon=1e-3, align=False, find_delay=False, detect_moves=False, find_noise=False
    ),
    law=RbfnnBridgedConfig(
        base="network", horizon=8, frame=False, bridge=False, observe=False, feedforward=False, redistribute=False
    ),
)


def row(controller, task, mismatch, seed, *settings, latency=None):
    request = RunRequest("kinematic", controller, task, mismatch, seed, latency=latency)
    return run_experiment(request, read_settings(None, settings)).row


@pytest.mark.parametrize("seed", range(3))
def test_a_turned_and_late_camera_is_no_obstacle_where_it_stops_the_paper_s_method(seed):
    mismatch = "moderate+camera_rotation=120deg"
    assert row(PLUS, "random", mismatch, seed, latency=0.1)["settling_time_s"] < 5.0
    assert np.isnan(row(PAPER, "random", mismatch, seed, latency=0.1)["settling_time_s"])


@pytest.mark.parametrize("seed", range(3))
def test_wrong_links_and_tool_and_a_camera_turned_right_round_settle(seed):
    found = row(PLUS, "random", "links=20%+tool=60mm+camera_rotation=180deg", seed)
    assert found["settling_time_s"] < 4.0


@pytest.mark.parametrize("seed", range(3))
def test_a_camera_that_is_moved_during_the_run_is_noticed_once_and_recovered_from(seed):
    settings = read_settings(None, ["random.duration=10"])
    run = run_experiment(RunRequest("kinematic", PLUS, "random", "moderate+camera_move=90deg", seed), settings)
    assert 5.0 < run.row["settling_time_s"] < 9.0
    assert run.steps["diagnostic_camera_moves"].iloc[-1] == 1.0


def test_it_is_sooner_there_with_less_overshoot_and_tracks_better_than_the_method_of_the_paper():
    for seed in range(2):
        plus, paper = (row(name, "random", "moderate", seed) for name in (PLUS, PAPER))
        assert plus["settling_time_s"] < paper["settling_time_s"]
        assert plus["overshoot"] < 0.5 * paper["overshoot"] + 0.005
    assert row(PLUS, "circle", "moderate", 1)["rms_error_evaluated"] < 0.004


def test_the_method_of_the_paper_tracks_a_circle_within_10_mm_and_worse_without_the_row_space():
    kept, leaking = (
        row(PAPER, "circle", "moderate", 1, f"{PAPER}.law.row_space_only={only}")["rms_error_evaluated"]
        for only in ("true", "false")
    )
    assert kept < 0.010
    assert leaking > 1.5 * kept


def test_the_settings_reach_the_parts():
    slow, fast = (
        row(PLUS, "random", "none", 0, f"{PLUS}.law.k=0.0", f"{PLUS}.law.gain={gain}") for gain in (2.0, 20.0)
    )
    assert slow["settling_time_s"] > 1.3 * fast["settling_time_s"]


@pytest.fixture(scope="module")
def knowledge():
    source = cache(lambda config: train(config, MODEL.jacobian, SPEC))
    region = np.array(TRAINING_LOWER), np.array(TRAINING_UPPER)
    return RobotKnowledge(SPEC, PREVIEW, MODEL.jacobian, region=region, train=source)


def commands(controller, steps=60):
    robot, _ = sample_mismatch(Mismatch("moderate"), MODEL, 5)
    rng = np.random.default_rng(0)
    start, goal = (rng.uniform(TRAINING_LOWER, TRAINING_UPPER) for _ in range(2))
    plant, target = build_kinematic(KinematicConfig(), PlantSetup(robot, start, PERIOD)), robot.feature(goal)
    observation, sent = plant.reset(0), []
    controller.reset(observation, 0)
    for k in range(steps):
        ahead = 0.002 * (k + np.arange(1 + PREVIEW))[:, None]  # a target that moves, so that the preview counts
        command = controller.step(observation, target + ahead)
        sent.append(command.joint_velocity)
        observation = plant.step(command)
    return np.array(sent)


def test_with_all_additions_off_it_is_the_method_of_the_paper(knowledge):
    paper = commands(METHODS[PAPER].build(METHODS[PAPER].config(), knowledge))
    np.testing.assert_allclose(commands(METHODS[PLUS].build(ALL_OFF, knowledge)), paper, atol=1e-7)
    on = commands(METHODS[PLUS].build(METHODS[PLUS].config(), knowledge))
    assert np.abs(on - paper).max() > 0.1
