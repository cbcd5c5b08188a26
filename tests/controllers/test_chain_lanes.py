"""Tests of whole chains over leading axes: a lane has the same bits alone and among others, in any order."""

import dataclasses
from functools import partial

import numpy as np
import pytest

from kit.toy import KNOWLEDGE, PERIOD, PREVIEW, A, M, N, assert_lanes, networks
from servobench.controllers.aids import AidsConfig
from servobench.controllers.controller import Delays
from servobench.controllers.initial_jacobian import InitialConfig
from servobench.controllers.methods import METHODS, compose
from servobench.plant.contract.signals import trusted_observation

LANES, PERIODS = 3, 50
KNOWING = dataclasses.replace(
    KNOWLEDGE,
    true_jacobian=KNOWLEDGE.nominal_jacobian,
    true_delays=Delays(PERIOD, PERIOD, 0.04),
    region=(np.full(N, -2.0), np.full(N, 2.0)),
    train=lambda config: networks(),
)
OTHERS = [
    ("mfac", "broyden", {"delay": "identified", "model": "nominal", "filter": True, "limit": "clip"}),
    ("pid", "kalman", {"noise": "identified", "model": "regression", "score_memory": 0.9}),
    ("pid", "rls", {"response": "given", "delay": "given", "filter": True, "model": "regression"}),
    ("mfac", "rbf", {"delay": "identified", "delay_margin": 0.0, "model": "regression", "longest_delay": 0.1}),
    ("mpc", "cfdl", {"response": "identified", "posture": True}),
]
CHAINS = [
    *(pytest.param(entry, None, "nominal", id=name) for name, entry in METHODS.items()),
    *(pytest.param(compose(law, estimator), aids, "probe", id=f"{law}+{estimator}") for law, estimator, aids in OTHERS),
]


def closed_loop(servo, lanes):
    """Run y(k) = A_lane q(k − delay) with lost frames; return commands, Ĵ and diagnostics, and what is learned.

    In one lane the camera is moved, one rests for a while, one loses 18 frames at a stretch.
    """
    rng = np.random.default_rng(3)
    turned = np.stack([A, -A + 0.05 * rng.normal(size=A.shape), A[[1, 2, 0]]])
    noise, valid = 0.001 * rng.normal(size=(PERIODS, LANES, M)), rng.random((PERIODS, LANES)) < 0.85
    valid[0], valid[15:33, 1] = True, False
    goal = 0.2 * rng.normal(size=(LANES, M))
    goal[2] = 0.0
    phase = 0.1 * np.maximum(np.arange(PERIODS + PREVIEW + 1) - 15.0, 0.0)[:, None, None]
    reference = goal + 0.1 * np.sin(phase + np.arange(M)) - 0.1 * np.sin(np.arange(M))
    moved = np.where((np.arange(PERIODS)[:, None, None] > 30) & (np.arange(LANES)[:, None] == 0), 0.5, 0.0)
    delay, q = np.array([0, 3, 1])[lanes], np.zeros((*np.shape(lanes), N))
    past, feature, found, state = [q] * 4, np.zeros((*np.shape(lanes), M)), [], None
    for k in range(PERIODS):
        late = np.stack(past[-4:])[::-1]
        exposed = np.take_along_axis(late, np.asarray(delay)[None, ..., None], axis=0)[0]
        now = np.matvec(turned[lanes], exposed) + noise[k, lanes] + moved[k, lanes]
        feature = np.where(valid[k, lanes][..., None], now, feature)
        bits = np.repeat(valid[k, lanes][..., None], M, -1)
        look = trusted_observation(k * PERIOD, q, feature, valid[k, lanes], bits)
        state = servo.start(look) if state is None else state
        ahead = np.ascontiguousarray(np.moveaxis(reference[k : k + PREVIEW + 1, lanes], 0, -2))
        state, u = servo.step(state, look, ahead)
        found.append({**servo.diagnostics(state), "u": u, "J": state.jacobian})
        q = q + 0.9 * u * PERIOD
        past.append(q)
    return [found, state.estimation]


@pytest.mark.slow
@pytest.mark.parametrize(("entry", "aids", "source"), CHAINS)
def test_a_lane_has_the_same_bits_alone_and_among_others_in_any_order(entry, aids, source):
    initial = InitialConfig(source, probe_step=0.01, settle_periods=1, average_periods=1)
    config = dataclasses.replace(entry.config(), initial=initial)
    if aids is not None:
        config = dataclasses.replace(config, aids=AidsConfig(**aids))
    found, _ = assert_lanes(partial(closed_loop, entry.build(config, KNOWING).servo))
    assert np.isfinite([each["u"] for each in found]).all()
