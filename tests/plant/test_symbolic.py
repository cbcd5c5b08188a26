import casadi
import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.plants import factory_ur5, nominal_ur5
from servobench.fmus.export import arm_layout
from servobench.fmus.sources import core_functions
from servobench.fmus.variables import Actuation, parameters_of
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.hand_eye import HandEyeModel


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
    return [nominal, HandEyeModel(factory_ur5(), nominal.X_BC), *random]


@pytest.mark.parametrize("model", models())
def test_the_symbolic_feature_and_its_jacobians_equal_the_numpy_ones(model):
    n, layout = model.arm.n, arm_layout(model.arm.n)
    q, values = casadi.SX.sym("q", n), parameters_of(model, Actuation(0.05, 1.0, 2 * np.pi, np.zeros(n)))
    p = casadi.DM(np.concatenate([np.ravel(values[group.name]) for group in layout.kinematic]))
    exported_feature, exported_jacobian, _ = core_functions(layout)
    feature = symbolic_feature(model)(q)
    outputs = [feature, casadi.jacobian(feature, q), exported_feature(q, p)[:3], exported_jacobian(q, p)]
    function = casadi.Function("all", [q], outputs)
    for pose in np.random.default_rng(1).uniform(-2 * np.pi, 2 * np.pi, (50, n)):
        y, J, exported_y, exported_J = (np.asarray(value) for value in function(pose))
        np.testing.assert_allclose([y, exported_y], [model.feature(pose)[:, None]] * 2, rtol=0, atol=1e-12)
        np.testing.assert_allclose([J, exported_J.reshape(3, n)], [model.jacobian(pose)] * 2, rtol=0, atol=1e-12)
