"""Tests of the MFAC law (eq. 45) against least squares, the limit λ → 0 and a step by hand."""

import math

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from kit.toy import PERIOD, Commanding, plant_spec, seen
from servobench.controllers.controller import RobotKnowledge
from servobench.controllers.laws.law import Estimate
from servobench.controllers.laws.mfac import MfacConfig, MfacLaw, mfac_step

HALF = math.log(2.0) / PERIOD  # [1/s] ρ = ½


def fresh(n, m, limit=1e6, preview=1, **settings):
    knowledge = RobotKnowledge(plant_spec(n, m, limit), preview)
    return Commanding(
        MfacLaw(MfacConfig(**settings), knowledge), seen(np.zeros(n), np.zeros(m)), knowledge
    )


@given(
    seed=st.integers(0, 10**6), n=st.integers(1, 8), m=st.integers(1, 4), lam=st.floats(1e-3, 10.0)
)
def test_the_step_minimises_error_plus_weighted_motion(seed, n, m, lam):
    rng = np.random.default_rng(seed)
    J = rng.normal(size=(m, n))
    e = rng.normal(size=m)
    stacked = np.vstack([J, np.sqrt(lam) * np.eye(n)])
    expected = np.linalg.lstsq(stacked, np.concatenate([e, np.zeros(n)]), rcond=None)[0]
    np.testing.assert_allclose(mfac_step(J, e, 1.0, lam), expected, atol=1e-10)


def test_with_the_exact_jacobian_and_no_weight_an_affine_plant_arrives_in_one_step():
    rng = np.random.default_rng(2)
    J = rng.normal(size=(3, 6))
    y = rng.normal(size=3)
    law = fresh(6, 3, gain=math.inf, step_weight=1e-13)
    ref = rng.normal(size=(2, 3))
    u = law.command(Estimate(J), seen(np.zeros(6), y), ref)
    np.testing.assert_allclose(y + J @ u * 0.05, ref[0], atol=1e-10)


@given(seed=st.integers(0, 10**6), degrees=st.integers(0, 180), share=st.floats(0.01, 0.99))
def test_behind_a_turned_camera_the_error_shrinks_as_the_page_of_derivations_says(
    seed, degrees, share
):
    rng = np.random.default_rng(seed)
    turn = math.radians(degrees)
    J = rng.normal(size=(3, 6))
    R = Rotation.from_rotvec([0.0, 0.0, turn]).as_matrix()
    law = fresh(6, 3, gain=-math.log1p(-share) / PERIOD, step_weight=1e-13)
    across = np.array([math.cos(seed), math.sin(seed), 0.0])
    along = np.array([0.0, 0.0, 1.0])
    factors = []
    for error in (across, along):
        u = law.command(Estimate(J), seen(np.zeros(6), -error), np.zeros((2, 3)))
        factors.append(np.linalg.norm(error - R @ J @ u * PERIOD))
    assert factors[0] == pytest.approx(abs(1.0 - share * np.exp(1j * turn)), rel=1e-6)
    assert factors[1] == pytest.approx(1.0 - share, rel=1e-6)
    assert (factors[0] < 1.0) == (share < 2.0 * math.cos(turn)) or abs(
        share - 2.0 * math.cos(turn)
    ) < 1e-6


def test_the_first_step_equals_the_one_computed_by_hand():
    law = fresh(1, 1, gain=HALF, step_weight=0.75)
    # dq = 0.5 · 0.5 · 0.1 / (0.75 + 0.25) = 0.025, u = dq / 0.05
    u = law.command(Estimate(np.array([[0.5]])), seen([0.0], [0.0]), np.full((2, 1), 0.1))
    np.testing.assert_allclose(u, [0.5], rtol=1e-14)
