"""Sensing set-ups as FMUs: against the kinematic eye, by the plant and by FMPy."""

from dataclasses import replace

import fmpy
import numpy as np
import pytest

from servobench.fmus.export import ExportOptions, export_fmu, nominal_setup
from servobench.fmus.ur5_plant import ENTRY, Ur5FmuConfig
from servobench.harness.apps.fmu.inspection import validate_fmu
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.registry import Sensing
from servobench.plant.contract.lanes import stack
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

UR5 = find_robot("ur5")
HOME = UR5.workspace.home
MODERATE = Mismatch.parse("moderate+gear_ratio=5%")
QUIET = SensingConfig(feature_noise=0.0)


def true_model(word, seed=2):
    arm, sample = sample_mismatch(MODERATE, UR5, seed)
    return Sensing.parse(word).true(UR5, arm, sample, MODERATE, seed)[0]


def plants(word, version, seeds=()):
    """The same arm as FMU and in numpy; side by side for several seeds."""
    model, start = true_model(word), HOME
    if seeds:
        model, start = (
            stack([true_model(word, seed) for seed in seeds]),
            np.stack([HOME] * len(seeds)),
        )
    setup = PlantSetup(model, start, 0.05, UR5)
    return (
        ENTRY.build(Ur5FmuConfig(fmi_version=version, sensing=QUIET), setup),
        build_kinematic(KinematicConfig(sensing=QUIET), setup),
    )


@pytest.mark.parametrize(
    ("word", "version"), [("pixel", 2), ("stereo", 3), ("plate:hand", 2), ("position:hand", 3)]
)
def test_a_run_by_the_fmu_is_that_of_the_kinematic_eye(word, version):
    fmu, numpy = plants(word, version)
    assert fmu.spec.feature.names == numpy.spec.feature.names
    assert (fmu.spec.feature.unit, fmu.spec.feature.scale) == (
        numpy.spec.feature.unit,
        numpy.spec.feature.scale,
    )
    seen = [(fmu.reset(0), numpy.reset(0))]
    rng, lost = np.random.default_rng(3), 0
    for _ in range(40):
        u = Command(rng.uniform(-1.0, 1.0, 6))
        seen.append((fmu.step(u), numpy.step(u)))
        np.testing.assert_array_equal(seen[-1][0].valid, seen[-1][1].valid)
        lost += not seen[-1][0].feature_valid
        np.testing.assert_allclose(fmu.truth().feature, numpy.truth().feature, rtol=1e-9, atol=1e-9)
        np.testing.assert_allclose(
            fmu.truth().jacobian, numpy.truth().jacobian, rtol=1e-9, atol=1e-7
        )
    for by_fmu, by_numpy in seen:
        np.testing.assert_allclose(by_fmu.feature, by_numpy.feature, rtol=1e-9, atol=1e-9)
    assert lost < 40
    fmu.close()


def test_a_mark_that_leaves_the_image_is_lost_alone():
    fmu, numpy = plants("plate", 2)
    fmu.reset(0), numpy.reset(0)
    partly = 0
    for _ in range(60):
        u = Command(np.array([1.0, 0.0, 0.0, 0.0, 0.0, 0.0]))
        valid = fmu.step(u).valid
        np.testing.assert_array_equal(valid, numpy.step(u).valid)
        partly += valid.any() and not valid.all()
    assert partly
    fmu.close()


def test_runs_side_by_side_have_the_numbers_of_single_ones():
    fmu, numpy = plants("pixel", 2, seeds=(0, 1, 2))
    fmu.reset([5, 6, 7]), numpy.reset([5, 6, 7])
    for _ in range(3):
        u = Command(np.full((3, 6), 0.3))
        np.testing.assert_allclose(fmu.step(u).feature, numpy.step(u).feature, rtol=1e-9, atol=1e-9)
    fmu.close()


def test_a_camera_that_moves_moves_in_the_fmu():
    fmu, numpy = plants("pixel", 2)
    fmu.reset(0), numpy.reset(0)
    pose = true_model("pixel").turned(np.array([0.0, 0.0, 0.3]), UR5.workspace.centre).camera
    fmu.move_camera(pose), numpy.move_camera(pose)
    rest = Command(np.zeros(6))
    for plant in (fmu, numpy):
        plant.step(rest)
    np.testing.assert_allclose(
        fmu.step(rest).feature, numpy.step(rest).feature, rtol=1e-9, atol=1e-9
    )
    fmu.close()


@pytest.mark.parametrize("version", [2, 3])
def test_fmpy_reads_features_in_pixels_and_cameras_are_parameters(tmp_path, version):
    model = true_model("stereo")
    path = export_fmu(
        tmp_path / "stereo.fmu", ExportOptions(version, replace(nominal_setup(UR5), model=model))
    )
    assert validate_fmu(path).problems == ()
    names = [f"feature[{i + 1}]" for i in range(4)] if version == 2 else ["feature"]
    focal = "focal_length[1]" if version == 2 else "focal_length"
    result = fmpy.simulate_fmu(str(path), stop_time=0.1, output_interval=0.05, output=names)
    first = np.concatenate([np.ravel(result[name][0]) for name in names])
    np.testing.assert_allclose(first, model.feature(HOME), atol=1e-9)
    told = fmpy.read_model_description(str(path)).description
    assert told.startswith(
        "A UR5 and its cameras: the ball in the images of two cameras, beside the arm;"
    )
    double = 2.0 * model.optics.focal
    start = {focal: double[0] if version == 2 else double}
    result = fmpy.simulate_fmu(
        str(path), stop_time=0.1, output_interval=0.05, output=names, start_values=start
    )
    wider = np.concatenate([np.ravel(result[name][0]) for name in names])[:2]
    centre = model.optics.centre[0]
    np.testing.assert_allclose(wider - centre, 2.0 * (first[:2] - centre), atol=1e-9)
