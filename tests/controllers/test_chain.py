"""Whole chains: promises of the best equipped one on an arm of constant Jacobian, and lanes of all of them.

A lane has the same bits alone and among others, in any order.
"""

import dataclasses
from functools import partial
from itertools import cycle

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from kit.nightly import some
from kit.toy import KNOWLEDGE, PERIOD, PREVIEW, A, M, N, SineModel, ToyArm, assert_lanes, networks
from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.algebra import damped_inverse
from servobench.controllers.controller import Delays
from servobench.controllers.initial_jacobian import InitialConfig
from servobench.controllers.methods import ESTIMATORS, LAWS, METHODS, compose
from servobench.plant.contract.signals import trusted_observation

TURN = Rotation.from_rotvec(np.radians(100.0) * np.array([0.0, 0.6, 0.8])).as_matrix()
RESPONSE = (0.0, 0.6, 0.4)
GAIN = 14.0
WEIGHT = 1e-9


def chain(**aids):
    """Return `regression_mfac` with a gain of 14/s and undamped inverses."""
    config = METHODS["regression_mfac"].config()
    law = dataclasses.replace(config.law, gain=GAIN, step_weight=WEIGHT)
    aids = AidsConfig(**{**EQUIPPED, "damping": 1e-4, **aids})
    return METHODS["regression_mfac"].build(
        dataclasses.replace(config, law=law, aids=aids), KNOWLEDGE
    )


def test_the_error_of_what_the_arm_is_bound_for_contracts_as_promised():
    """‖e⁺‖ ≤ (1 − f γ (1 − δ)) ‖e‖, δ = ‖I − J Ĵ⁺‖, once response and delay are known.

    f is the share of the wanted feature step that the limits let through, γ = 1 − exp(−K dt).
    """
    gamma = 1.0 - np.exp(-GAIN * PERIOD)
    arm = ToyArm(TURN, RESPONSE, latency=2)
    target = np.array([0.9, 0.5, 0.2])
    servo = chain(posture=False, filter=False)
    checked = 0
    limited = 0
    observation = arm.observe()
    servo.reset(observation, 0)
    for k in range(60):
        e = target - arm.end()
        u = servo.step(observation, np.tile(target, (1 + PREVIEW, 1))).joint_velocity
        observation = arm.step(u)
        J = servo.estimated_jacobian()
        after = target - arm.end()
        if k < 12 or np.linalg.norm(e) < 1e-6:
            continue
        assert servo.diagnostics()["delay"] == pytest.approx(2 * PERIOD)
        delta = np.linalg.norm(np.eye(M) - TURN @ A @ damped_inverse(J, 1e-6), 2)
        f = min(1.0, float(np.linalg.norm(J @ u * PERIOD) / (gamma * np.linalg.norm(e))))
        limited += f < 0.99
        assert delta < 1.0
        assert np.linalg.norm(after) <= (1.0 - f * gamma * (1.0 - delta)) * np.linalg.norm(e) + 2e-4
        checked += 1
    assert checked > 15
    assert limited > 3
    assert np.linalg.norm(after) < 1e-3


def following_error(**aids):
    """The largest error on a circle that moves by 7.5 mm a period, once it is followed, m."""
    arm = ToyArm(np.eye(M), RESPONSE, latency=1)
    servo = chain(**aids)
    observation = arm.observe()
    errors = []
    servo.reset(observation, 0)

    def desired(k):
        return 0.15 * np.array([np.sin(0.05 * k), 1.0 - np.cos(0.05 * k), 0.0])

    for k in range(140):
        reference = np.array([desired(k + ahead) for ahead in range(1 + PREVIEW)])
        observation = arm.step(servo.step(observation, reference).joint_velocity)
        errors.append(np.linalg.norm(desired(k + 1) - A @ arm.q))
    return max(errors[90:])


def test_a_moving_reference_is_followed_with_a_tenth_of_a_period_of_lag():
    assert following_error() < 0.1 * 0.0075
    assert following_error(response="ignored") > 0.1 * 0.0075
    assert following_error(delay="ignored", response="ignored", filter=False) > 0.0075
    assert following_error(feedforward=False) > 0.0075


@pytest.mark.parametrize("aids", [{}, {"feedforward": True}, {"posture": False}])
def test_the_command_that_is_sent_keeps_the_acceleration_limit_of_the_law(aids):
    config = METHODS["ukf_mpc"].config()
    knowledge = dataclasses.replace(KNOWLEDGE, region=(np.zeros(N), np.full(N, 2.0)))
    law = dataclasses.replace(
        config.law, joint_acceleration_limit=2.0, use_preview="feedforward" not in aids
    )
    config = dataclasses.replace(config, law=law, aids=dataclasses.replace(config.aids, **aids))
    arm = ToyArm(np.eye(M), RESPONSE)
    servo = METHODS["ukf_mpc"].build(config, knowledge)
    sent = [np.zeros(N)]
    observation = arm.observe()
    reference = 0.1 * np.outer(np.arange(1.0 + PREVIEW), [1.0, 0.5, 0.0])
    servo.reset(observation, 0)
    for _ in range(30):
        sent.append(servo.step(observation, reference).joint_velocity)
        observation = arm.step(sent[-1])
        assert servo.diagnostics()["solver_success"] == 1.0
    assert np.abs(np.diff(sent, axis=0)).max() == pytest.approx(2.0 * PERIOD, rel=1e-6)


LANES = 3
PERIODS = 42
KNOWING = dataclasses.replace(
    KNOWLEDGE,
    nominal_model=SineModel(A, np.ones(N)),
    true_jacobian=KNOWLEDGE.nominal_jacobian,
    true_delays=Delays(PERIOD, PERIOD, 0.04),
    region=(np.full(N, -2.0), np.full(N, 2.0)),
    train=lambda config: networks(),
)
TIGHT = {"joint_acceleration_limit": 6.0, "view_tangent": (0.5, 0.4)}
OF_LAWS = [  # name, settings, aids
    ("pid", {"integral_gain": 0.5, "derivative_gain": 0.1}, {"feedforward": True, "posture": True, "limit": "clip"}),
    ("pid", {"damping": 0.0}, {"limit": "redistribute"}),
    ("mfac", {}, {"feedforward": True, "limit": "redistribute"}),
    ("mpc", {}, {"posture": True}),
    ("mpc", {**TIGHT, "horizon_time": 0.4, "delay": 0.1},
     {"delay": "ignored", "response": "ignored", "filter": False}),
    ("mpc", {**TIGHT, "mode": "constant", "terminal_weight": 1.0, "use_preview": False}, {"posture": True}),
    ("rbfnn", {}, {}),
    ("rbfnn", {"row_space_only": False, "position": "commanded", "anti_windup": False, "preview": False},
     {"feedforward": True}),
]  # fmt: skip
OF_ESTIMATORS = [
    *((name, {}) for name in ESTIMATORS), ("ukf", {"form": "sigma_points"}),
    ("rbf", {"window": 1}),
]  # fmt: skip
AIDS = [
    {"delay": "identified", "model": "nominal", "filter": True},
    {"noise": "identified", "model": "regression", "score_memory": 0.9},
    {"response": "given", "delay": "given", "filter": True, "model": "regression"},
    {"delay": "identified", "delay_margin": 0.0, "model": "regression", "longest_delay": 0.1},
    {"response": "identified"},
]


def others():
    """Yield a chain and its settings for every estimator; laws and aids take turns."""
    for (law, ofl, own), (estimator, ofe), aids in zip(
        cycle(OF_LAWS), OF_ESTIMATORS, cycle(AIDS), strict=False
    ):
        entry = compose(law, estimator)
        config = entry.config()
        parts = {
            "law": dataclasses.replace(config.law, **ofl),
            "estimator": dataclasses.replace(config.estimator, **ofe),
        }
        initial = InitialConfig("probe", probe_step=0.01, settle_time=0.05, average_time=0.05)
        config = dataclasses.replace(
            config, **parts, aids=AidsConfig(**(aids | own)), initial=initial
        )
        yield pytest.param(entry, config, id=f"{law}+{estimator}")


# Named methods are pairs of the parts of `others`
NAMED = some(
    METHODS, "calibrating_mfac", "regression_mfac", "rbfnn_mfac", "ukf_mpc", "rbf_pid:published"
)
CHAINS = [
    *(
        pytest.param(
            METHODS[name],
            dataclasses.replace(METHODS[name].config(), initial=InitialConfig()),
            id=name,
        )
        for name in NAMED
    ),
    *others(),
]


def lane_loop(servo, lanes):
    """Run y(k) = A_lane q(k − delay) with lost frames; return commands, Ĵ and diagnostics, and what is learned.

    In one lane the camera is moved, one rests for a while and loses one feature, one loses 18 frames at a stretch.
    """
    rng = np.random.default_rng(3)
    turned = np.stack([A, -A + 0.05 * rng.normal(size=A.shape), A[[1, 2, 0]]])
    noise = 0.001 * rng.normal(size=(PERIODS, LANES, M))
    valid = rng.random((PERIODS, LANES, 1)) < 0.85
    valid = np.repeat(valid, M, axis=-1)
    valid[0] = True
    valid[15:33, 1] = False
    valid[36:40, 2, 1] = False
    goal = 0.2 * rng.normal(size=(LANES, M))
    goal[2] = 0.0
    phase = 0.1 * np.maximum(np.arange(PERIODS + PREVIEW + 1) - 15.0, 0.0)[:, None, None]
    reference = goal + 0.1 * np.sin(phase + np.arange(M)) - 0.1 * np.sin(np.arange(M))
    moved = np.where(
        (np.arange(PERIODS)[:, None, None] > 30) & (np.arange(LANES)[:, None] == 0), 0.5, 0.0
    )
    delay = np.array([0, 3, 1])[lanes]
    q = np.zeros((*np.shape(lanes), N))
    past = [q] * 4
    feature = np.zeros((*np.shape(lanes), M))
    found = []
    state = None
    for k in range(PERIODS):
        late = np.stack(past[-4:])[::-1]
        exposed = np.take_along_axis(late, np.asarray(delay)[None, ..., None], axis=0)[0]
        now = np.matvec(turned[lanes], exposed) + noise[k, lanes] + moved[k, lanes]
        feature = np.where(valid[k, lanes], now, feature)
        look = trusted_observation(
            k * PERIOD, q, feature, valid[k, lanes].all(axis=-1), valid[k, lanes]
        )
        state = servo.start(look) if state is None else state
        ahead = np.ascontiguousarray(np.moveaxis(reference[k : k + PREVIEW + 1, lanes], 0, -2))
        state, u = servo.step(state, look, ahead)
        found.append({**servo.diagnostics(state), "u": u, "J": state.jacobian})
        q = q + 0.9 * u * PERIOD
        past.append(q)
    return [found, state.estimation]


@pytest.mark.parametrize(("entry", "config"), CHAINS)
def test_a_lane_has_the_same_bits_alone_and_among_others_in_any_order(entry, config):
    found, _ = assert_lanes(partial(lane_loop, entry.build(config, KNOWING).servo))
    assert np.isfinite([each["u"] for each in found]).all()
    limited = np.sum([each["saturated"] for each in found], axis=-1)
    # In one period in some lanes only
    assert {1, 2} & set(limited.tolist()) or "solver_success" in found[-1]
    assert found[-1].get("camera_moves", [1])[0] >= 1


def test_all_laws_are_in_the_table():
    assert {name for name, *_ in OF_LAWS} == set(LAWS)
