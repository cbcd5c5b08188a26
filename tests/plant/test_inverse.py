import numpy as np
import pytest
from scipy.optimize import least_squares

from servobench.plant.contract.lanes import stack
from servobench.plant.robot.arm import SerialArm
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.inverse import CLOSE_ENOUGH, closest_distance
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME

BAND = 0.005  # m
TURN = np.full(6, 2 * np.pi)
NARROW = np.array(HOME) - 0.4, np.array(HOME) + 0.4


def oracle(arm: SerialArm, point: np.ndarray, lower: np.ndarray, upper: np.ndarray) -> float:
    """The distance that scipy's trust-region search within bounds finds, from four other starts."""
    draws = np.random.default_rng(7).uniform(
        np.maximum(lower, -3.0), np.minimum(upper, 3.0), (4, 6)
    )
    found = (
        least_squares(
            lambda q: arm.ball_position(q) - point,
            start,
            lambda q: arm.ball_and_jacobian(q)[1],
            bounds=(lower, upper),
        )
        for start in draws
    )
    return min(float(np.linalg.norm(one.fun)) for one in found)


def arms(count: int) -> list[SerialArm]:
    return [
        sample_mismatch(Mismatch.parse("severe"), find_robot("ur5"), seed)[0].arm
        for seed in range(count)
    ]


@pytest.mark.slow
def test_the_distance_is_that_of_scipy_in_and_out_of_reach():
    points = np.random.default_rng(3).uniform(-1.2, 1.2, (6, 3))
    for arm in arms(2):
        wanted = np.array([oracle(arm, point, -TURN, TURN) for point in points])
        assert 0 < np.count_nonzero(wanted > BAND) < len(points)
        np.testing.assert_allclose(closest_distance(arm, points, -TURN, TURN), wanted, atol=1e-3)


@pytest.mark.slow
def test_narrow_joint_limits_put_the_same_points_out_of_reach_as_for_scipy():
    arm = arms(1)[0]
    points = arm.ball_position(
        np.array(HOME) + np.random.default_rng(4).uniform(-1.0, 1.0, (10, 6))
    )
    wanted = np.array([oracle(arm, point, *NARROW) for point in points])
    assert 0 < np.count_nonzero(wanted > BAND) < len(points)
    got = closest_distance(arm, points, *NARROW)
    assert ((got > BAND) == (wanted > BAND)).all()
    np.testing.assert_allclose(got, wanted, atol=1e-3, rtol=0.03)


def test_every_point_that_the_ball_can_be_at_is_reached():
    arm = arms(1)[0]
    points = arm.ball_position(np.random.default_rng(5).uniform(-np.pi, np.pi, (100, 6)))
    assert (closest_distance(arm, points, -TURN, TURN) <= 1e-3).all()


def test_arms_side_by_side_have_the_bits_of_each_alone():
    points = np.array([[0.5, 0.0, 0.3], [1.5, 0.0, 0.3], [0.2, -0.6, 0.4], [0.0, 0.0, 1.6]])
    robots = arms(4)
    together = closest_distance(stack(robots), points, -TURN, TURN)
    alone = [
        float(closest_distance(arm, point, -TURN, TURN))
        for arm, point in zip(robots, points, strict=True)
    ]
    assert together.tolist() == alone
    assert (together <= CLOSE_ENOUGH).any()
    assert (together > 0.1).any()
