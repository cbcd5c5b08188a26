import warnings
from dataclasses import replace

import numpy as np
import pytest

from kit.plants import configure, setup
from servobench.controllers.algebra import damped_inverse
from servobench.controllers.laws.mfac import mfac_step
from servobench.controllers.servo import ServoController
from servobench.harness.apps.loops.equilibrium import arm_model, at_rest, linearise, warm_up
from servobench.harness.apps.loops.loop_analysis import (
    SmallMotions,
    analyse_loop,
    controller_response,
    delay_margin,
    excite,
    linear_response,
)
from servobench.harness.apps.loops.loop_pictures import one_line
from servobench.harness.apps.loops.systems import (
    ArmModel,
    LoopResponse,
    StateSpace,
    closed_loop,
    frequencies,
    gain_crossings,
    is_stable,
    phase_crossings,
)
from servobench.harness.config.settings import Settings
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, build_kinematic
from servobench.plant.robot.mechanics import MechanicsConfig

PERIOD = 0.05
JACOBIAN = np.random.default_rng(0).normal(size=(3, 6))


def resolved(controller, **settings):
    request = RunRequest("kinematic", controller, "random", "none", 0)
    return resolve(request, Settings({controller: settings} if settings else {}))


@pytest.mark.parametrize(
    ("delay", "latency"), [(0.0, 0.0), (0.05, 0.1), (0.03, 0.07), (0.12, 0.0), (0.0, 0.02)]
)
def test_the_arm_is_the_same_at_a_finer_period(delay, latency):
    whole, fine = (
        ArmModel(JACOBIAN, dt, 0.05, delay, latency).matrices() for dt in (PERIOD, PERIOD / 5)
    )
    x, x_fine, random = np.zeros(len(whole.A)), np.zeros(len(fine.A)), np.random.default_rng(1)
    for _ in range(20):
        u = random.normal(size=6)
        x = whole.A @ x + whole.B @ u
        for _ in range(5):
            x_fine = fine.A @ x_fine + fine.B @ u
        np.testing.assert_allclose(whole.C @ x, fine.C @ x_fine, atol=1e-13)


@pytest.mark.parametrize(("delay", "latency"), [(0.05, 0.0), (0.02, 0.03), (0.07, 0.12)])
def test_the_arm_is_the_kinematic_plant_in_small_motions(delay, latency):
    config = configure(KinematicConfig, command_delay=delay, latency=latency, feature_noise=0.0)
    plant, small = build_kinematic(config, setup()), 1e-5
    first = plant.reset(0)
    arm = arm_model(config, plant.truth().jacobian, PERIOD).matrices()
    x, random = np.zeros(len(arm.A)), np.random.default_rng(1)
    for _ in range(20):
        u = random.normal(size=6)
        seen = plant.step(Command(small * u))
        x = arm.A @ x + arm.B @ u
        moved = (
            np.concatenate(
                [seen.feature - first.feature, seen.joint_position - first.joint_position]
            )
            / small
        )
        np.testing.assert_allclose(arm.C @ x, moved, atol=1e-4)


@pytest.mark.parametrize("latency", [0.0, 0.02, 0.1])
def test_the_response_of_the_arm_is_that_of_its_matrices(latency):
    arm = ArmModel(JACOBIAN, PERIOD, 0.05, 0.03, latency)
    z = np.exp(1j * frequencies(PERIOD, 7) * PERIOD)
    exposed, joints = arm.response(z)
    response = arm.matrices().response(z)
    np.testing.assert_allclose(response[:, :3], exposed[:, None, None] * JACOBIAN, atol=1e-9)
    np.testing.assert_allclose(response[:, 3:], joints[:, None, None] * np.eye(6), atol=1e-9)


def test_a_pid_controller_is_linearised_as_its_closed_form_says():
    warm = warm_up(resolved("pid+constant", law={"integral_gain": 0.7, "derivative_gain": 0.1}))
    z = np.exp(1j * frequencies(PERIOD, 9) * PERIOD)
    response = linearise(*at_rest(warm, "true")).response(z)
    tau = 0.1
    integral = PERIOD * z / (z - 1.0)
    derivative = (z - 1.0) / ((tau + PERIOD) * z - tau)
    law = -np.expm1(-2.5 * PERIOD) / PERIOD + 0.7 * integral + 0.1 * derivative
    inverse = damped_inverse(warm.arm.jacobian, 0.02)
    np.testing.assert_allclose(
        response[:, :, :3], -law[:, None, None] * inverse, rtol=1e-6, atol=1e-6
    )
    np.testing.assert_allclose(response[:, :, 3:9], 0.0, atol=1e-6)
    np.testing.assert_allclose(
        response[:, :, 9:], law[:, None, None] * inverse, rtol=1e-6, atol=1e-6
    )


def test_an_mfac_controller_is_linearised_as_its_closed_form_says():
    warm = warm_up(resolved("mfac+constant"))
    controller, J = linearise(*at_rest(warm, "true")), warm.arm.jacobian
    gain = (
        np.stack(
            [mfac_step(J, each, -np.expm1(-3.25 * PERIOD), 0.02) for each in np.eye(3)], axis=-1
        )
        / PERIOD
    )
    assert len(controller.A) == 0
    np.testing.assert_allclose(controller.D, np.hstack([-gain, np.zeros((6, 6)), gain]), atol=1e-7)


def test_a_model_has_the_age_of_slow_frames_and_names_what_it_leaves_out(caplog):
    remark.cache_clear()
    sensing, mechanics = (
        SensingConfig(latency=0.1, frame_period=0.4, jitter=0.2),
        MechanicsConfig(tool_frequency=12.0),
    )
    arm = arm_model(KinematicConfig(sensing=sensing, mechanics=mechanics), JACOBIAN, PERIOD)
    assert (arm.latency, arm.age) == (0.1, pytest.approx(0.175))
    late = ArmModel(JACOBIAN, PERIOD, arm.lag, arm.command_delay, 0.275)
    for one, other in zip(arm.matrices(), late.matrices(), strict=True):
        np.testing.assert_allclose(one, other, atol=1e-12)
    assert (
        "the linear model leaves out sensing.jitter, mechanics.tool_frequency: margins"
        in caplog.text
    )


def test_margins_of_a_single_channel_are_those_of_the_library():
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        import control
    arm = ArmModel(np.eye(1), PERIOD, 0.05, 0.05, 0.1)
    controller = StateSpace(np.eye(1), PERIOD * np.eye(1), -0.5 * np.eye(1), np.array([[-2.5]]))
    both = StateSpace(
        controller.A,
        np.hstack([controller.B, [[0.0]]]),
        controller.C,
        np.hstack([controller.D, [[0.0]]]),
    )
    margins = linear_response(both, arm).margins()
    plant = arm.matrices()
    loop = -control.ss(*controller, PERIOD) * control.ss(
        plant.A, plant.B, plant.C[:1], plant.D[:1], PERIOD
    )
    gain, phase, stability, _, crossover, _ = control.stability_margins(loop)
    assert margins.gain_margin == pytest.approx(gain, rel=2e-3)
    assert margins.phase_margin_deg == pytest.approx(phase, rel=2e-3)
    assert margins.crossover_rad_s == pytest.approx(crossover, rel=2e-3)
    assert margins.delay_margin_s == pytest.approx(np.deg2rad(phase) / crossover, rel=2e-3)
    assert margins.sensitivity_peak == pytest.approx(1.0 / stability, rel=2e-3)
    assert margins.disk_margin == pytest.approx(
        control.disk_margins(loop, frequencies(PERIOD))[0], rel=2e-3
    )


@pytest.mark.parametrize("latency", [0.0, 0.03, 0.1])
def test_the_loop_is_at_the_border_of_stability_at_its_gain_margin(latency):
    warm = warm_up(resolved("rbf_pid:published"))
    controller, arm = linearise(*at_rest(warm, "true")), replace(warm.arm, latency=latency)
    limit = linear_response(controller, arm).gain_limit()
    for factor, stable in ((0.995 * limit, True), (1.005 * limit, False)):
        scaled = controller._replace(C=factor * controller.C, D=factor * controller.D)
        assert is_stable(closed_loop(arm.matrices(), scaled).A) == stable


def test_coupled_channels_are_judged_by_their_common_loci():
    turn = np.array([[0.6, -0.8], [0.8, 0.6]])
    frequency = frequencies(PERIOD)
    single = 1.0 / (1j * frequency) * np.exp(-0.1j * frequency)
    L = turn @ (single[:, None, None] * np.diag([1.0, 3.0])) @ turn.T
    np.testing.assert_allclose(
        np.sort(gain_crossings(L))[:2], np.array([np.pi / 0.6, np.pi / 0.2]), rtol=1e-3
    )
    phase, where = phase_crossings(L, frequency)
    np.testing.assert_allclose(np.sort(where), [1.0, 3.0], rtol=1e-3)
    np.testing.assert_allclose(np.sort(phase), np.pi / 2 - np.array([0.3, 0.1]), rtol=1e-3)


def test_a_frozen_controller_is_identified_as_it_is_linearised():
    warm = warm_up(resolved("rbf_pid:published"))
    servo, state, rest = at_rest(warm, "true")
    controller = ServoController(servo)
    controller.state = state
    frequency, identified = controller_response(
        excite(SmallMotions(controller, warm.arm, rest), 9, length=128), PERIOD
    )
    linear = linearise(*at_rest(warm, "true")).response(np.exp(1j * frequency * PERIOD))[:, :, :9]
    np.testing.assert_allclose(identified, linear, atol=2e-3 * np.abs(linear).max())
    margins, wanted = (
        LoopResponse(frequency, each, warm.arm).margins() for each in (identified, linear)
    )
    assert margins.delay_margin_s == pytest.approx(wanted.delay_margin_s, rel=0.01)
    assert margins.gain_margin == pytest.approx(wanted.gain_margin, rel=0.01)


@pytest.mark.slow
def test_an_identified_loop_has_the_margins_and_the_step_of_the_linearised_one():
    run = resolved("pid+true", law={"integral_gain": 0.7})
    linear, identified = (analyse_loop(run, identify=each) for each in (False, True))
    assert (linear.model, identified.model) == ("linearised", "identified")
    assert identified.margins.delay_margin_s == pytest.approx(
        linear.margins.delay_margin_s, rel=0.02
    )
    np.testing.assert_allclose(identified.step, linear.step, atol=0.01)


def test_the_delay_margin_shrinks_with_the_gain_and_is_zero_for_an_unstable_loop():
    late = KinematicConfig(sensing=SensingConfig(latency=0.2))
    slow, fast, unstable = (
        delay_margin(
            resolved("pid+constant", law={"proportional_gain": gain}).controller,
            "pid+constant",
            plant=plant,
        )
        for gain, plant in ((2.5, None), (8.0, None), (20.0, late))
    )
    assert slow > 3.0 * fast > 0.0
    assert unstable == 0.0


def test_a_law_that_was_trained_on_the_nominal_model_has_a_delay_margin():
    small = {"jacobian": {"centres": 8, "samples": 60}, "controller": {"hidden": 4, "samples": 60}}
    warm = warm_up(resolved("rbfnn_mfac", training=small))
    linear = linearise(*at_rest(warm, "true"))
    assert np.isfinite(linear.D).all()
    assert np.abs(linear.D).max() > 0.0


def test_a_controller_is_warm_after_its_probing_however_long_that_takes():
    warm = warm_up(resolved("ukf_mfac", initial={"source": "probe", "average_time": 1.0}))
    assert warm.controller.state.ready
    linearise(*at_rest(warm, "true"))


def test_only_a_composed_controller_has_a_fast_delay_margin():
    with pytest.raises(TypeError, match="controller must be a ServoController"):
        delay_margin(resolved("nmpc_calibrated").controller, "nmpc_calibrated")


def test_a_loop_without_states_is_stable():
    assert is_stable(np.zeros((0, 0)))


def test_a_heading_on_the_page_has_no_breaks_of_the_terminal():
    assert [one_line(each) for each in ("over-\nshoot, %", "settling\ntime, s", "M_s")] == [
        "overshoot, %",
        "settling time, s",
        "M_s",
    ]
