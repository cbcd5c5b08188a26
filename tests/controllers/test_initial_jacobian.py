"""Tests of the providers of the first Jacobian, alone and inside a controller on the kinematic plant."""

from dataclasses import replace

import numpy as np
import pytest

from kit.plants import configure, nominal_ur5
from kit.toy import plant_spec
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.initial_jacobian import InitialConfig, initial_jacobian
from servobench.controllers.methods import compose
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.faults import ControllerDiverged
from servobench.plant.contract.signals import Command, Observation
from servobench.plant.kinematic import KinematicConfig, build_kinematic

START = np.array([0.35, -1.69, -2.34, 0.89, 1.22, 0.0])


def spec(reach=1.0):
    return plant_spec(2, 1, reach=reach)


def kinematic(period=0.05, **settings):
    return build_kinematic(
        configure(KinematicConfig, **settings), PlantSetup(nominal_ur5(), START, period)
    )


def probe(plant, seed=0, **settings):
    """Run a provider on a plant until it is done."""
    provider = initial_jacobian(
        InitialConfig(source="probe", **settings), RobotKnowledge(plant.spec, 0)
    )
    observation = plant.reset(seed)
    state = provider.start(observation)
    periods = 0
    while True:
        state, u, done = provider.step(state, observation)
        if done:
            assert not u.any()
            return provider.jacobian(state), periods
        assert (np.abs(u) <= plant.spec.joint_velocity_limit).all()
        observation = plant.step(Command(u))
        periods += 1


@pytest.mark.parametrize("period", [0.1, 0.05, 0.02, 0.01])
def test_probing_finds_the_true_jacobian_through_lag_delay_and_latency_at_any_rate(period):
    J, periods = probe(kinematic(period, feature_noise=0.0, latency=0.05), probe_step=0.002)
    assert periods * period == pytest.approx(3.35, abs=0.4)  # times are whole periods
    np.testing.assert_allclose(J, nominal_ur5().jacobian(START), atol=0.006)


def test_probing_through_default_noise_is_as_good_as_the_averaged_noise_allows():
    truth = nominal_ur5().jacobian(START)
    errors = [probe(kinematic(latency=0.05), seed)[0] - truth for seed in range(20)]
    # each column: √(2 / 3) mm of averaged noise over 0.03 rad = 0.027 m/rad an entry, besides the arm's curvature
    assert np.sqrt(np.mean(np.square(errors))) < 0.04


def test_probing_takes_the_periods_that_its_settings_tell():
    plant = kinematic()
    config = InitialConfig(source="probe")
    _, periods = probe(plant)
    each = config.probe_time + config.settle_time + config.average_time
    assert periods == round((config.average_time + 6 * each) / 0.05) - 1 - 6
    assert initial_jacobian(config, RobotKnowledge(plant.spec, 0)).duration == periods + 1


def test_lost_frames_prolong_probing_and_do_no_harm():
    J, periods = probe(kinematic(feature_noise=0.0, drop_probability=0.4), probe_step=0.002)
    assert periods > probe(kinematic())[1]
    np.testing.assert_allclose(J, nominal_ur5().jacobian(START), atol=0.006)


def test_frames_slower_than_the_control_prolong_a_rest_until_there_are_three():
    assert probe(kinematic(0.01, frame_period=0.05))[1] * 0.01 == pytest.approx(
        7 * 0.15 + 6 * 0.45, abs=0.4
    )
    assert probe(kinematic(0.01, frame_period=0.2))[1] * 0.01 == pytest.approx(
        7 * 0.6 + 6 * 0.4, abs=0.6
    )


def test_the_matrix_of_a_model_is_stored_by_rows_whatever_layout_the_model_returns():
    """Products of another layout have other bits, and in some lanes only a copy would change the layout."""
    J = np.asfortranarray(np.arange(8.0).reshape(2, 4))
    knowledge = RobotKnowledge(plant_spec(4, 2), 0, nominal_jacobian=lambda q: J)
    provider = initial_jacobian(InitialConfig(), knowledge)
    found = provider.jacobian(provider.start(Observation(0.0, np.zeros(4), np.zeros(2))))
    np.testing.assert_array_equal(found, J)
    assert found.flags.c_contiguous


def test_a_probing_move_turns_away_from_a_joint_limit():
    provider = initial_jacobian(
        InitialConfig("probe", average_time=0.05), RobotKnowledge(spec(), 0)
    )
    at = Observation(0.0, np.array([0.99, 0.0]), np.zeros(1))
    _, u, _ = provider.step(provider.start(at), at)
    np.testing.assert_allclose(u, [-0.3, 0.0])


def test_a_joint_that_does_not_move_is_a_named_fault():
    provider = initial_jacobian(InitialConfig("probe"), RobotKnowledge(plant_spec(3, 1), 0))
    q = np.zeros(3)
    done = False
    state = provider.start(Observation(0.0, q, np.zeros(1)))
    while not done:
        state, u, done = provider.step(state, Observation(0.0, q, np.zeros(1)))
        q = q + 0.05 * u * [1.0, 1.0, 0.0]
    with pytest.raises(ControllerDiverged, match="moved the joints too little"):
        provider.jacobian(state)


def test_a_controller_says_that_it_probes_and_servoes_afterwards():
    entry = compose("mfac", "kalman")
    plant = kinematic()
    controller = entry.build(
        replace(entry.config(), initial=InitialConfig(source="probe")),
        RobotKnowledge(plant.spec, 0),
    )
    observation = plant.reset(1)
    controller.reset(observation, 1)
    goal = plant.truth().feature + 0.1
    probing = []
    for _ in range(160):
        observation = plant.step(controller.step(observation, goal[None, :]))
        probing.append(controller.diagnostics()["probing"])
    assert probing == sorted(probing, reverse=True)
    assert sum(probing) == probe(kinematic())[1]
    assert np.linalg.norm(plant.truth().feature - goal) < 0.005


def test_a_nominal_model_of_another_robot_is_refused():
    provider = initial_jacobian(
        InitialConfig(), RobotKnowledge(spec(), 0, nominal_jacobian=lambda q: np.zeros((3, 6)))
    )
    with pytest.raises(
        ValueError, match=r"nominal_jacobian must return shape \(1, 2\), got \(3, 6\)"
    ):
        provider.start(Observation(0.0, np.zeros(2), np.zeros(1)))


@pytest.mark.parametrize(
    ("config", "jacobian"),
    [(InitialConfig(), [[0.2, 0.6]]), (InitialConfig("given", given=((1.0, 2.0),)), [[1.0, 2.0]])],
)
def test_the_nominal_model_is_evaluated_at_the_start_and_a_given_jacobian_is_kept(config, jacobian):
    provider = initial_jacobian(
        config, RobotKnowledge(spec(), 0, nominal_jacobian=lambda q: 2.0 * q[None, :])
    )
    assert provider.immediate
    state = provider.start(Observation(0.0, np.array([0.1, 0.3]), np.zeros(1)))
    np.testing.assert_array_equal(provider.jacobian(state), jacobian)


@pytest.mark.parametrize(
    ("settings", "reach", "message"),
    [
        (
            {},
            1.0,
            r"source 'nominal' needs a nominal model.*set initial.source to 'probe' or 'given'",
        ),
        *(
            (
                {"source": "given", "given": given},
                1.0,
                "^initial.given must hold 1 rows of 2 entries",
            )
            for given in ((), ((1.0,),), ((1.0, 2.0), (3.0,)))
        ),
        ({"source": "probe", "probe_step": 0.2}, 1.0, r"probe_step must be at most 0\.1 rad"),
        ({"source": "probe"}, 0.029, "probe_step must be at most half the joint range"),
    ],
)
def test_a_source_that_does_not_fit_the_robot_is_refused(settings, reach, message):
    with pytest.raises(ValueError, match=message):
        initial_jacobian(InitialConfig(**settings), RobotKnowledge(spec(reach), 0))


def test_a_probing_move_of_half_the_joint_range_is_taken():
    assert initial_jacobian(
        InitialConfig(source="probe", probe_step=0.03), RobotKnowledge(spec(0.03), 0)
    )
