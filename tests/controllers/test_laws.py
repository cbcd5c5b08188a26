"""Test of all laws with the last stages: a lane has the same bits alone and among others, in any order."""

from functools import partial

import numpy as np
import pytest

from kit.toy import KNOWLEDGE, PERIOD, PREVIEW, A, Commanding, M, N, assert_lanes, networks
from servobench.controllers.laws.law import Estimate
from servobench.controllers.methods import LAWS
from servobench.plant.contract.signals import trusted_observation

LANES, PERIODS = 3, 60
TIGHT = {"joint_acceleration_limit": 6.0, "view_tangent": (0.5, 0.4)}
SETTINGS = [
    ("pid", {"integral_gain": 0.5, "derivative_gain": 0.1}, {"feedforward": True, "posture": True, "limit": "clip"}),
    ("pid", {"damping": 0.0}, {"limit": "redistribute"}),
    ("mfac", {}, {"feedforward": True, "limit": "redistribute"}),
    ("mpc", {}, {}),
    ("mpc", {**TIGHT, "horizon_time": 0.4, "delay": 0.1, "fallback": "closed_form"}, {}),
    ("mpc", {**TIGHT, "mode": "constant", "terminal_weight": 1.0, "use_preview": False}, {"posture": True}),
    ("rbfnn", {}, {}),
    ("rbfnn", {"row_space_only": False, "position": "commanded", "anti_windup": False, "preview": False},
     {"feedforward": True}),
]  # fmt: skip


def closed_loop(law, aids, lanes):
    """Run y(k) = A_lane q(k − delay) with lost frames; return commands, diagnostics and where frames were valid."""
    rng = np.random.default_rng(3)
    turned = A + 0.1 * rng.normal(size=(LANES, M, N))
    J = turned + 0.03 * rng.normal(size=(PERIODS, LANES, M, N))
    noise, valid = 0.002 * rng.normal(size=(PERIODS, LANES, M)), rng.random((PERIODS, LANES)) < 0.8
    phase = 0.1 * np.arange(PERIODS + PREVIEW + 1)[:, None] + np.arange(LANES)
    reference = np.stack([0.3 * np.sin(phase), 0.2 * np.cos(phase), 0.1 * phase], axis=-1)
    for lane in range(LANES):
        reference[20 + 9 * lane :, lane] += 0.3  # a step that no joint can follow at once, in each lane at another time
    delay, q = np.array([0, 3, 1])[lanes], np.zeros((*np.shape(lanes), N))
    past, seen, found = [q] * 4, np.zeros((*np.shape(lanes), M)), []
    for k in range(PERIODS):
        late = np.stack(past[-4:])[::-1]
        exposed = np.take_along_axis(late, np.asarray(delay)[None, ..., None], axis=0)[0]
        now = np.matvec(turned[lanes], exposed) + noise[k, lanes]
        seen = np.where(valid[k, lanes][..., None], now, seen)
        look = trusted_observation(k * PERIOD, q, seen, valid[k, lanes], np.repeat(valid[k, lanes][..., None], M, -1))
        if k == 0:
            made = Commanding(law, look, KNOWLEDGE, **aids)
        ahead = np.moveaxis(reference[k : k + PREVIEW + 1, lanes], 0, -2)
        u = made.command(Estimate(J[k, lanes]), look, np.ascontiguousarray(ahead))
        found.append({**made.diagnostics(), "u": u, "saturated": made.limited, "valid": valid[k, lanes]})
        q = q + 0.9 * u * PERIOD
        past.append(q)
    return found


@pytest.mark.parametrize(("name", "changes", "aids"), SETTINGS)
def test_a_lane_has_the_same_bits_alone_and_among_others_in_any_order(name, changes, aids):
    part = LAWS[name]
    law = part.make(part.config(**changes), KNOWLEDGE, *([networks()] if part.trained else []))
    found = assert_lanes(partial(closed_loop, law, aids))
    saturated, valid = (np.array([each[key] for each in found]).T for key in ("saturated", "valid"))
    for differs in (saturated, valid) if name != "mpc" else (valid,):
        assert differs.any()
        assert not differs.all()
        assert (differs.any(axis=0) & ~differs.all(axis=0)).any()  # in one period in some lanes only


def test_all_laws_are_in_the_table():
    assert {name for name, *_ in SETTINGS} == set(LAWS)


def test_only_the_law_that_was_trained_on_the_nominal_model_works_in_its_frame():
    assert {name for name, part in LAWS.items() if part.make.in_model_frame} == {"rbfnn"}


def test_laws_declare_the_stages_that_they_bring():
    for name, config, owned in (
        ("pid", {}, set()),
        ("mfac", {}, set()),
        ("mpc", {}, {"limit", "preview"}),
        ("mpc", {"use_preview": False, "delay": 0.1}, {"limit", "predict"}),
        ("rbfnn", {}, {"preview"}),
        ("rbfnn", {"preview": False}, set()),
    ):
        part = LAWS[name]
        made = part.make(part.config(**config), KNOWLEDGE, *([networks()] if part.trained else []))
        assert made.owns == owned
