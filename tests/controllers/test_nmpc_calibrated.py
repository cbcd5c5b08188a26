import math
from dataclasses import replace

import casadi
import numpy as np
import pytest
from scipy.signal import lsim
from scipy.spatial.transform import Rotation

from kit.plants import nominal_ur5
from kit.toy import plant_spec
from servobench.controllers.controller import Delays, RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mpc.closed_form import bridging_shares
from servobench.controllers.laws.mpc.mpc import MpcConfig, MpcLaw
from servobench.controllers.nmpc_calibrated import (
    NmpcCalibrated,
    NmpcCalibratedConfig,
    exposure_ages,
    shaped_shares,
    zero_vibration_taps,
)
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.symbolic import symbolic_feature
from servobench.plant.contract.faults import SolverFailed
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Observation
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.hand_eye import hand_eye_spec
from servobench.plant.robot.mechanics import MechanicsConfig

MODEL = nominal_ur5()
SYMBOLIC = symbolic_feature(MODEL)
SPEC = hand_eye_spec(MODEL, 0.05, 1.0, 2 * np.pi)
START = np.array([2.79, -1.45, 2.34, 2.25, -1.22, -0.19])


def knowledge(spec=SPEC, symbolic=SYMBOLIC, preview=12):
    return RobotKnowledge(spec, preview, true_symbolic=symbolic)


def hold(target, preview=12):
    return np.tile(np.asarray(target, dtype=float), (preview + 1, 1))


def test_first_step_by_hand():
    # h(q) = sin q at q = 0, H = 1, β = ½, q = 1e-9: sin(dq) = ½·0.4, so dq = asin 0.2.
    config = NmpcCalibratedConfig(
        horizon_time=0.05,
        moves=1,
        delay=0.0,
        decay=20 * math.log(2.0),
        move_weight=1e-9,
        iterations=20,
    )
    controller = NmpcCalibrated(config, knowledge(plant_spec(1, 1, speed=10.0), casadi.sin))
    command = controller.step(Observation(0.0, [0.0], [0.0]), hold([0.4]))
    np.testing.assert_allclose(command.joint_velocity * 0.05, [math.asin(0.2)], rtol=1e-7)


def test_an_affine_robot_gets_the_same_command_as_from_the_linear_law():
    rng = np.random.default_rng(0)
    J = rng.normal(size=(2, 4))
    offset = rng.normal(size=2)
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
        np.testing.assert_allclose(
            controller.step(observation, reference).joint_velocity, linear, atol=1e-7
        )
        q = q + 0.05 * linear


def test_the_plan_minimises_the_nonlinear_criterion():
    config = NmpcCalibratedConfig(
        horizon_time=0.2, moves=4, delay=0.0, move_weight=0.01, iterations=50
    )
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
    path = MODEL.feature(START) + np.stack(
        [0.15 * np.cos(angle), 0.15 * np.sin(angle), np.zeros_like(angle)], axis=-1
    )
    observation = plant.reset(0)
    controller.reset(observation, 0)
    errors = []
    for k in range(90):
        errors.append(np.linalg.norm(path[k] - plant.truth().feature))
        observation = plant.step(controller.step(observation, path[k : k + 13]))
    assert errors[0] > 0.1
    assert max(errors[40:]) < 1e-3
    assert controller.diagnostics()["fallbacks"] == 0


def commands(target, *, offset=(0.0, 0.0, 0.0), latency=0.0, disturb=None, periods=60, **changes):
    """Return the commands of a loop of ideal joints and, at its end, the error of the feature at the target."""
    known = replace(knowledge(), true_delays=Delays(latency, 0.0, 0.0, changes.pop("spread", 0.0)))
    controller = NmpcCalibrated(NmpcCalibratedConfig(delay=0.0, **changes), known)
    joints = [START]
    found = []
    for k in range(periods):
        age = round(latency / 0.05) if disturb is None else disturb(k)
        measured = (
            MODEL.feature(joints[max(0, k - age)] if isinstance(age, int) else joints[k] + age)
            + offset
        )
        observation = Observation(0.05 * k, joints[k], measured)
        found.append(controller.step(observation, hold(target)).joint_velocity)
        joints.append(joints[k] + 0.05 * found[k])
    return np.array(found), np.linalg.norm(MODEL.feature(joints[-1]) + offset - target)


TARGET = MODEL.feature(START) + [0.1, -0.05, 0.05]


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_without_disturbance_the_image_changes_no_command(latency):
    alone, _ = commands(TARGET, latency=latency)
    fed_back, error = commands(TARGET, latency=latency, image=True)
    np.testing.assert_allclose(fed_back, alone, atol=1e-9)
    assert error < 1e-6


@pytest.mark.parametrize("latency", [0.0, 0.1])
def test_a_constant_offset_of_the_image_is_removed_by_the_image_only(latency):
    offset = np.array([0.03, -0.02, 0.01])
    assert commands(TARGET, offset=offset, latency=latency)[1] > 0.03
    assert commands(TARGET, offset=offset, latency=latency, image=True)[1] < 1e-6


def test_a_fifth_of_the_frames_may_be_outliers():
    def outlier(k):
        return np.full(6, 0.3) if k % 5 == 0 else np.zeros(6)

    alone, _ = commands(TARGET)
    fed_back, error = commands(TARGET, disturb=outlier, image=True)
    np.testing.assert_allclose(fed_back, alone, atol=1e-9)
    assert error < 1e-6


def test_frames_that_are_late_by_unknown_times_within_known_bounds_disturb_no_motion():
    alone, _ = commands(TARGET)
    fed_back, _ = commands(TARGET, disturb=lambda k: k * k % 3, image=True, spread=0.1)
    np.testing.assert_allclose(fed_back, alone, atol=1e-9)
    unaware, _ = commands(TARGET, disturb=lambda k: k * k % 3, image=True)
    assert np.abs(unaware - alone).max() > 1e-3
    np.testing.assert_allclose(
        exposure_ages(Delays(0.1, 0.0, 0.0, 0.05), 0.05), 2.0 + 0.25 * np.arange(8)
    )


def test_a_camera_that_is_known_to_turn_shows_the_target_in_its_place():
    def seen(joints, time):
        return Rotation.from_rotvec([0.0, 0.0, -0.3 * time]).apply(np.array(MODEL.feature(joints)))

    for image in (True, False):
        controller = NmpcCalibrated(
            NmpcCalibratedConfig(image=image), replace(knowledge(), true_camera_turn=0.3)
        )
        joints = START
        errors = []
        for k in range(60):
            feature = seen(joints, 0.05 * k)
            command = controller.step(Observation(0.05 * k, joints, feature), hold(TARGET))
            joints = joints + 0.05 * command.joint_velocity
            errors.append(np.linalg.norm(seen(joints, 0.05 * (k + 1)) - TARGET))
        assert (max(errors[40:]) < 1e-3) == image


def test_the_taps_leave_an_oscillator_at_rest_after_a_step():
    omega = 20.0
    damping = 0.1
    period = 0.001
    taps = zero_vibration_taps(omega, damping, period)
    assert taps.sum() == pytest.approx(1.0)
    np.testing.assert_array_equal(zero_vibration_taps(0.0, 0.02, 0.05), [1.0])
    A = [[0.0, 1.0], [-(omega**2), -2.0 * damping * omega]]
    B = [[0.0], [omega**2]]
    step = np.cumsum(np.pad(taps, (0, 1000)))
    swing = lsim((A, B, [[1.0, 0.0]], 0.0), step, period * np.arange(len(step)), interp=False)[1]
    alone = lsim((A, B, [[1.0, 0.0]], 0.0), np.ones(1000), period * np.arange(1000), interp=False)[
        1
    ]
    assert np.abs(swing[len(taps) :] - 1.0).max() < 2e-3
    assert alone.max() > 1.7


def test_the_steps_to_come_behind_a_shaper_are_those_of_a_simulated_pipeline():
    # Of a step, 3/4 is commanded at once and 1/4 a period later; commands take effect after 1.5 periods.
    to_come = bridging_shares(0.075, 0.05)
    np.testing.assert_allclose(to_come, [0.5, 1.0])
    np.testing.assert_allclose(shaped_shares(to_come, np.array([0.75, 0.25])), [0.125, 0.625, 1.0])
    np.testing.assert_array_equal(shaped_shares(to_come, np.ones(1)), to_come)


def test_a_flexible_tool_that_is_known_comes_to_rest_at_the_target():
    config = KinematicConfig(
        sensing=SensingConfig(feature_noise=0.0), mechanics=MechanicsConfig(tool_frequency=20.0)
    )
    errors = {}
    for tool in ((0.0, 0.0), (20.0, 0.02)):
        plant = build_kinematic(config, PlantSetup(MODEL, START, 0.05))
        controller = NmpcCalibrated(
            NmpcCalibratedConfig(image=True), replace(knowledge(preview=16), true_tool=tool)
        )
        observation = plant.reset(0)
        for _ in range(40):
            observation = plant.step(controller.step(observation, hold(TARGET, 16)))
            errors.setdefault(tool, []).append(np.linalg.norm(plant.truth().feature - TARGET))
    assert 5.0 * max(errors[20.0, 0.02][10:]) < max(errors[0.0, 0.0][10:])
    assert np.mean(errors[20.0, 0.02][30:]) < 0.001


def test_a_lost_frame_leaves_the_offset_as_it_is():
    y = MODEL.feature(START)
    controller = NmpcCalibrated(NmpcCalibratedConfig(image=True), knowledge())
    lost = Observation(0.0, START, y + np.array([0.01, 0.0, 0.0]), feature_valid=False)
    for _ in range(20):
        assert np.abs(controller.step(lost, hold(y)).joint_velocity).max() < 1e-6


def infeasible(fallback):
    """A joint at full speed right before its limit cannot brake in time at so low an acceleration."""
    spec = plant_spec(1, 1, reach=1.0)
    config = NmpcCalibratedConfig(delay=0.0, joint_acceleration_limit=0.5, fallback=fallback)
    controller = NmpcCalibrated(config, knowledge(spec, lambda q: 1.0 * q))
    for _ in range(40):
        controller.step(Observation(0.0, [-0.9], [-0.9]), hold([5.0]))
    assert controller.diagnostics()["fallbacks"] == 0
    return controller, Observation(0.0, [0.99], [0.99])


def test_without_a_solution_the_arm_holds_and_it_is_counted_or_it_is_a_named_failure():
    controller, observation = infeasible("hold")
    np.testing.assert_array_equal(controller.step(observation, hold([5.0])).joint_velocity, 0.0)
    diagnostics = controller.diagnostics()
    assert (diagnostics["fallbacks"], diagnostics["solver_success"]) == (1, 0.0)
    controller, observation = infeasible("raise")
    with pytest.raises(SolverFailed, match="daqp found no solution within the limits"):
        controller.step(observation, hold([5.0]))


def test_knowledge_that_does_not_suffice_is_named():
    config = NmpcCalibratedConfig()
    with pytest.raises(
        ValueError, match=r"preview must reach horizon_time \+ delay = 0.5 s, got 9 rows of 0.05 s"
    ):
        NmpcCalibrated(config, knowledge(preview=9))
    with pytest.raises(ValueError, match="true_symbolic must be known for nmpc_calibrated"):
        NmpcCalibrated(config, knowledge(symbolic=None))
    with pytest.raises(
        ValueError, match=r"true_symbolic must give an expression of shape \(3, 1\), got \(6, 1\)"
    ):
        NmpcCalibrated(config, knowledge(symbolic=lambda q: q))
