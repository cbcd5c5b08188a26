import math

import casadi
import numpy as np
import pytest

from kit.plants import nominal_ur5
from kit.toy import plant_spec
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.nmpc_calibrated import NmpcCalibrated, NmpcCalibratedConfig
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.faults import SolverFailed
from servobench.plant.contract.signals import Observation
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.hand_eye import hand_eye_spec

MODEL = nominal_ur5()
SYMBOLIC = symbolic_feature(MODEL)
SPEC = hand_eye_spec(MODEL, 0.05, 1.0, 2 * np.pi)
START = np.array([2.79, -1.45, 2.34, 2.25, -1.22, -0.19])


def knowledge(spec=SPEC, symbolic=SYMBOLIC, preview=12):
    return RobotKnowledge(spec, preview, true_symbolic=symbolic)


def make(**changes):
    return NmpcCalibrated(NmpcCalibratedConfig(**changes), knowledge())


def hold(target, preview=12):
    return np.tile(np.asarray(target, dtype=float), (preview + 1, 1))


def test_first_step_by_hand():
    # h(q) = sin q at q = 0, H = 1, β = ½, q = 1e-9: sin(dq) = ½·0.4, so dq = asin 0.2.
    config = NmpcCalibratedConfig(
        horizon_time=0.05, moves=1, delay=0.0, decay=20 * math.log(2.0), move_weight=1e-9, iterations=20
    )
    controller = NmpcCalibrated(config, knowledge(plant_spec(1, 1, speed=10.0), casadi.sin))
    command = controller.step(Observation(0.0, [0.0], [0.0]), hold([0.4]))
    np.testing.assert_allclose(command.joint_velocity * 0.05, [math.asin(0.2)], rtol=1e-7)


def test_an_affine_robot_gets_the_same_command_as_from_the_linear_law():
    rng = np.random.default_rng(0)
    J, offset = rng.normal(size=(2, 4)), rng.normal(size=2)
    spec = plant_spec(4, 2)
    common = {"horizon_time": 0.3, "moves": 6, "decay": 8.0, "move_weight": 0.05, "delay": 0.1}
    law = MpcLaw(MpcConfig(**common, joint_acceleration_limit=8.0), RobotKnowledge(spec, 12))
    controller = NmpcCalibrated(
        NmpcCalibratedConfig(**common, joint_acceleration_limit=8.0),
        knowledge(spec, lambda q: casadi.DM(J) @ q + casadi.DM(offset)),
    )
    q = np.zeros(4)
    state = law.start(Observation(0.0, q, offset))
    for k in range(10):
        reference = offset + rng.normal(scale=0.02, size=(13, 2)) + [0.3, -0.2]
        observation = Observation(0.05 * k, q, J @ q + offset)
        state, linear = law.command(state, Estimate(J), observation, reference)
        state = law.noted(state, linear, np.False_)
        np.testing.assert_allclose(controller.step(observation, reference).joint_velocity, linear, atol=1e-7)
        q = q + 0.05 * linear


def test_the_plan_minimises_the_nonlinear_criterion():
    config = NmpcCalibratedConfig(horizon_time=0.2, moves=4, delay=0.0, move_weight=0.01, iterations=50)
    controller = NmpcCalibrated(config, knowledge())
    y = MODEL.feature(START)
    reference = y + np.linspace(0.0, 1.0, 13)[:, None] * [0.1, -0.08, 0.05]
    command = controller.step(Observation(0.0, START, y), reference)
    assert controller.diagnostics()["plan_change"] < 1e-8

    dq = casadi.SX.sym("dq", 6, 4)
    feature = symbolic_feature(MODEL)
    cost = 0.005 * casadi.sumsqr(dq)
    for t in range(1, 5):
        error = reference[t] - np.exp(-config.decay * 0.05 * t) * (reference[0] - y)
        cost += 0.5 * casadi.sumsqr(casadi.DM(error) - feature(START + casadi.sum2(dq[:, :t])))
    quiet = {"print_time": False, "ipopt": {"print_level": 0, "sb": "yes", "tol": 1e-12}}
    solver = casadi.nlpsol("oracle", "ipopt", {"x": casadi.vec(dq), "f": cost}, quiet)
    best = np.asarray(solver(x0=np.zeros(24), lbx=-0.05, ubx=0.05)["x"])[:6, 0]
    np.testing.assert_allclose(command.joint_velocity * 0.05, best, atol=1e-5)
    np.testing.assert_allclose(controller.estimated_jacobian(), MODEL.jacobian(START), atol=1e-12)


def test_it_settles_and_then_follows_a_moving_target_within_a_millimetre():
    plant = build_kinematic(KinematicConfig(), PlantSetup(MODEL, START, 0.05))
    controller = NmpcCalibrated(NmpcCalibratedConfig(), knowledge())
    angle = 2 * np.pi * np.arange(110) / 200
    path = MODEL.feature(START) + np.stack([0.15 * np.cos(angle), 0.15 * np.sin(angle), np.zeros_like(angle)], axis=-1)
    observation = plant.reset(0)
    controller.reset(observation, 0)
    errors = []
    for k in range(90):
        errors.append(np.linalg.norm(path[k] - plant.truth().feature))
        observation = plant.step(controller.step(observation, path[k : k + 13]))
    assert errors[0] > 0.1
    assert max(errors[40:]) < 1e-3
    assert controller.diagnostics()["fallbacks"] == 0


def test_a_disturbance_of_the_camera_is_followed_only_with_a_gain():
    y = MODEL.feature(START)
    shifted = Observation(0.0, START, y + np.array([0.01, 0.0, 0.0]))
    for gain, moves in ((0.0, False), (40.0, True)):
        command = make(disturbance_rate=gain).step(shifted, hold(y))
        assert (np.abs(command.joint_velocity).max() > 1e-3) == moves
    lost = Observation(0.0, START, y + np.array([0.01, 0.0, 0.0]), feature_valid=False)
    assert np.abs(make(disturbance_rate=40.0).step(lost, hold(y)).joint_velocity).max() < 1e-6


def infeasible(fallback):
    """A joint at full speed right before its limit cannot brake in time at so low an acceleration."""
    spec = plant_spec(1, 1, reach=1.0)
    config = NmpcCalibratedConfig(delay=0.0, joint_acceleration_limit=0.5, fallback=fallback)
    controller = NmpcCalibrated(config, knowledge(spec, lambda q: 1.0 * q))
    for _ in range(40):
        controller.step(Observation(0.0, [-0.9], [-0.9]), hold([5.0]))
    assert controller.diagnostics()["fallbacks"] == 0
    return controller, Observation(0.0, [0.99], [0.99])


def test_without_a_solution_the_arm_holds_and_it_is_counted():
    controller, observation = infeasible("hold")
    np.testing.assert_array_equal(controller.step(observation, hold([5.0])).joint_velocity, 0.0)
    diagnostics = controller.diagnostics()
    assert diagnostics["fallbacks"] == 1
    assert diagnostics["solver_success"] == 0.0


def test_without_a_solution_and_fallback_it_is_a_named_failure():
    controller, observation = infeasible("raise")
    with pytest.raises(SolverFailed, match="daqp found no solution within the limits"):
        controller.step(observation, hold([5.0]))


def test_knowledge_that_does_not_suffice_is_named():
    config = NmpcCalibratedConfig()
    with pytest.raises(ValueError, match=r"preview must reach horizon_time \+ delay = 0.5 s, got 9 rows of 0.05 s"):
        NmpcCalibrated(config, knowledge(preview=9))
    with pytest.raises(ValueError, match="true_symbolic must be known for nmpc_calibrated"):
        NmpcCalibrated(config, knowledge(symbolic=None))
    with pytest.raises(ValueError, match=r"true_symbolic must give an expression of shape \(3, 1\), got \(6, 1\)"):
        NmpcCalibrated(config, knowledge(symbolic=lambda q: q))
