import casadi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.hand_eye import HandEyeModel
from servobench.plant.robot.symbolic import (
    geometry_of,
    geometry_symbols,
    parametric_model,
    symbolic_feature,
    symbolic_model,
)
from servobench.plant.robot.ur5 import nominal_ur5, ur5_arm_from_calibration


def random_model(seed, n=6):
    rng = np.random.default_rng(seed)
    arm = SerialArm(
        tuple(f"joint_{i}" for i in range(n)),
        rng.uniform(-0.5, 0.5, (n + 1, 3)),
        rng.uniform(-np.pi, np.pi, (n + 1, 3)),
        rng.uniform(-0.3, 0.3, n),
        rng.uniform(0.8, 1.2, n),
        rng.uniform(-0.2, 0.2, 3),
    )
    pose = np.eye(4)
    pose[:3, :3] = Rotation.random(random_state=seed).as_matrix()
    pose[:3, 3] = rng.uniform(-1.0, 1.0, 3)
    return HandEyeModel(arm, pose)


def models():
    nominal = nominal_ur5()
    random = [random_model(seed, n) for seed, n in enumerate((6, 6, 6, 2, 3, 7, 8))]
    return [nominal, HandEyeModel(ur5_arm_from_calibration(), nominal.X_BC), *random]


@pytest.mark.parametrize("model", models())
def test_symbolic_feature_and_jacobian_equal_the_numpy_ones(model):
    function = symbolic_model(model)
    q = np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, (50, model.arm.n))
    for pose, feature, jacobian in zip(q, model.feature(q), model.jacobian(q), strict=True):
        symbolic_feature, symbolic_jacobian = function(pose)
        np.testing.assert_allclose(np.asarray(symbolic_feature)[:, 0], feature, rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.asarray(symbolic_jacobian), jacobian, rtol=0, atol=1e-12)


@pytest.mark.parametrize("model", models())
def test_symbolic_jacobian_equals_automatic_differentiation(model):
    q = casadi.SX.sym("q", model.arm.n)
    _, jacobian = symbolic_model(model)(q)
    feature = symbolic_feature(model)(q)
    difference = casadi.Function("difference", [q], [casadi.jacobian(feature, q) - jacobian])
    for pose in np.random.default_rng(2).uniform(-np.pi, np.pi, (20, model.arm.n)):
        np.testing.assert_allclose(np.asarray(difference(pose)), 0.0, atol=1e-12)


def test_parametric_model_with_numbers_equals_the_bound_one():
    function = parametric_model(6)
    for seed in range(3):
        model = random_model(seed)
        geometry = geometry_of(model)
        numbers = [casadi.DM(getattr(geometry, name)) for name in function.name_in()[1:]]
        q = np.random.default_rng(seed).uniform(-np.pi, np.pi, 6)
        feature, jacobian = function(q, *numbers)
        np.testing.assert_allclose(np.asarray(feature)[:, 0], model.feature(q), rtol=0, atol=1e-12)
        np.testing.assert_allclose(np.asarray(jacobian), model.jacobian(q), rtol=0, atol=1e-12)


def test_a_geometry_without_joints_is_refused():
    with pytest.raises(ValueError, match="n must be at least 1, got 0"):
        geometry_symbols(0)
