"""Every preset brings a mismatched arm to rest at its target, through noise, lag, delay and camera latency."""

import dataclasses

import numpy as np
import pytest

from kit.plants import configure
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.initial import InitialConfig
from servobench.controllers.methods import METHODS
from servobench.harness.config.defaults import default_config
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.arm import arm_from_dh, rotation_from_rpy
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.ur5 import DH_A, DH_ALPHA, DH_D, JOINT_NAMES, TOOL, nominal_ur5

PRESETS = [METHODS[name] for name in ("broyden", "calibrated", "cfdl_mfac", "constant", "rls", "ukf_mfac")]
START = np.array([0.35, -1.69, -2.34, 0.89, 1.22, 0.0])
GOAL = START + np.array([0.3, 0.25, 0.3, -0.2, 0.1, 0.0])
BAND = 0.005  # m


def mismatched_model(degrees):
    """The UR5 with links 5 % longer or shorter and the camera turned about its three axes together."""
    signs = np.array([1, -1, 1, -1, 1, -1])
    arm = arm_from_dh((1 + 0.05 * signs) * DH_A, (1 - 0.05 * signs) * DH_D, DH_ALPHA, TOOL, JOINT_NAMES)
    pose = nominal_ur5().X_BC.copy()
    pose[:3, :3] = pose[:3, :3] @ rotation_from_rpy(np.deg2rad(degrees) * np.array([0.58, -0.58, 0.58]))
    return HandEyeModel(arm, pose)


def true_errors(entry, config, degrees=15.0, periods=160, **plant_settings):
    """Return the true error norms of a run, (periods,), m."""
    model, nominal = mismatched_model(degrees), nominal_ur5()
    plant = build_kinematic(configure(KinematicConfig, **plant_settings), PlantSetup(model, START, 0.05))
    controller = entry.build(config, RobotKnowledge(plant.spec, 1, nominal.jacobian, model.jacobian))
    observation, goal, errors = plant.reset(0), model.feature(GOAL), []
    controller.reset(observation, 0)
    for _ in range(periods):
        errors.append(np.linalg.norm(plant.truth().feature - goal))
        observation = plant.step(controller.step(observation, np.tile(goal, (2, 1))))
    return np.array(errors)


@pytest.mark.parametrize("entry", PRESETS, ids=lambda entry: entry.name)
@pytest.mark.parametrize("settings", [{}, {"latency": 0.05, "drop_probability": 0.1}], ids=["default", "late"])
def test_a_preset_settles_within_5_mm(entry, settings):
    errors = true_errors(entry, default_config(entry), **settings)
    assert errors[0] > 0.1
    assert errors[-40:].max() < BAND


def test_an_estimator_settles_where_its_first_jacobian_comes_from_probing_alone():
    config = dataclasses.replace(default_config(METHODS["ukf_mfac"]), initial=InitialConfig("probe"))
    assert true_errors(METHODS["ukf_mfac"], config, degrees=90.0, periods=220)[-40:].max() < BAND


def test_an_estimator_beats_the_constant_jacobian_under_a_strongly_turned_camera():
    def periods_outside(entry):
        return int(np.sum(true_errors(entry, default_config(entry), degrees=50.0) > BAND))

    assert periods_outside(METHODS["ukf_mfac"]) < periods_outside(METHODS["constant"])
