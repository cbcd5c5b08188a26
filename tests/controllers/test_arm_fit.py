"""The fit of an arm to frames: interpolation, whitening, slopes of the cost, and arms that are found again."""

import numpy as np
import pytest

from servobench.controllers.stages.arm_fit import (
    BEGINNING,
    FRAMES,
    KEPT,
    RECENT,
    Fit,
    Fitted,
    Frames,
    added,
    at_latency,
    squared,
    whitened,
)
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mechanics import MechanicsConfig
from servobench.plant.robot.parametric import ParametricModel

PERIOD = 0.05  # [s]
FINE = 0.01  # [s] at which the gears of made-up runs move
LATENCY = 0.08  # [s] of the made-up runs
NOISE = 1e-3  # [m]
PLAY, RIPPLE = -2, -1  # places in θ
NO_PLAY = MechanicsConfig()
TRUE = {"gear_elbow": 0.2, "zero_shoulder_pan": 0.4, "zero_wrist_1": -0.2, "tool_x": 0.02}


def fit_of_ur5():
    return Fit(ParametricModel(find_robot("ur5").nominal), 1.0, PERIOD)


def joints_at(time):
    """Return joint positions (..., 6) that move all joints in different ways."""
    home = np.asarray(find_robot("ur5").workspace.home)
    pace = 1.0 + 0.35 * np.arange(6)
    phase = np.arange(6)
    return home + 0.25 * (np.sin(pace * time[..., None] + phase) - np.sin(phase))


def empty(fit, m=3, n=6):
    return Frames(
        time=np.zeros(FRAMES),
        feature=np.zeros((FRAMES, m)),
        weight=np.zeros((FRAMES, m)),
        path=np.zeros((fit.rows, FRAMES, 2 * n)),
        number=np.int_(0),
    )


def driven(mechanics, times):
    """Return where the plant's joints behind gears are at times, (..., 6)."""
    x = joints_at(times[0])
    rows = []
    for time in times:
        x = mechanics.driven(x, joints_at(time))
        rows.append(x)
    return np.array(rows)


def rows_of_history(fit, time, size):
    """Return joints and their places within a play of ±`size` at times, (..., 12), the oldest of which is first."""
    members = fit.start((), 1, np.float64(0.0))
    members.theta[:, PLAY] = size
    row = np.concatenate([joints_at(time[0]), np.zeros(6)])
    rows = []
    for each in time:
        row = fit.next_row(members, np.ones(1), row, joints_at(each))
        rows.append(row)
    return np.array(rows)


def made_up(fit, seconds=4.0, deviations=TRUE, mechanics=NO_PLAY):
    """Return frames of an arm with deviations and gears, and its θ and cameras."""
    generator = np.random.default_rng(1)
    model = fit.model
    step = np.zeros(len(model.names))
    for name, value in deviations.items():
        step[[each.startswith(name) for each in model.names]] = value
    theta, cameras = model.moved(*model.start(()), step)
    frames = empty(fit)
    times = np.arange(-1.0, seconds, FINE)
    behind = driven(mechanics, times)
    history = rows_of_history(fit, times, 0.5 * mechanics.backlash)
    first = round(1.0 / FINE)
    stride = round(PERIOD / FINE)
    late = round(LATENCY / FINE)
    for last in range(first, len(times), stride):
        exposed = behind[last - late][None]
        y = model.feature(theta, cameras, exposed)[0] + NOISE * generator.standard_normal(3)
        path = history[last - stride * (fit.rows - 1) : last + 1 : stride]
        time = np.float64(times[last])
        frames = added(frames, np.int_(FRAMES), time, y, np.ones(3, dtype=bool), path)
    return frames, theta, cameras


def test_joints_between_rows_are_those_of_a_smooth_motion():
    back = 0.05 * np.arange(12)[::-1]
    path = joints_at(3.0 - back)
    delay = np.array([0.0, 0.02, 0.13, 0.4])
    position, velocity = at_latency(path[:, None], delay, 0.05)
    step = 1e-5
    times = 3.0 - delay
    rates = (joints_at(times + step) - joints_at(times - step)) / (2.0 * step)
    np.testing.assert_allclose(position[2:, 0], joints_at(times[2:]), atol=1e-5)
    # Nothing is known beyond the last row.
    np.testing.assert_allclose(position[:2, 0], joints_at(times[:2]), atol=5e-4)
    np.testing.assert_allclose(velocity[1:, 0], rates[1:], atol=0.02)


@pytest.mark.parametrize("most", [KEPT, FRAMES])
def test_a_full_buffer_keeps_the_first_and_last_frames_and_thins_the_others_evenly(most):
    fit = fit_of_ur5()
    frames = empty(fit)
    count = 1000
    for k in range(count):
        feature = np.full(3, float(k))
        path = np.zeros((fit.rows, 12))
        frames = added(frames, np.int_(most), np.float64(k), feature, np.ones(3, bool), path)
    assert frames.number == most
    np.testing.assert_array_equal(
        frames.time[most - RECENT : most], np.arange(count - RECENT, count)
    )
    np.testing.assert_array_equal(frames.time[:BEGINNING], np.arange(BEGINNING))
    gaps = np.diff(frames.time[BEGINNING : most - RECENT])
    assert gaps.max() <= 3.0 * np.median(gaps)
    np.testing.assert_array_equal(frames.feature[:most, 0], frames.time[:most])


def test_whitening_makes_noise_along_the_motion_white():
    motion = np.array([[[0.3, 0.4, 0.0]]])
    lateness, deviation = 0.02, 0.001
    covariance = deviation**2 * np.eye(3) + lateness**2 * np.outer(motion[0, 0], motion[0, 0])
    residuals = np.eye(3)
    motions = np.repeat(np.swapaxes(motion, -1, -2), 3, axis=-1)
    fitted = Fitted(residual=residuals[None], rates=np.zeros((1, 0, 3, 3)), motion=motions)
    white, _ = whitened(fitted, np.float64(lateness), np.array([deviation**2]))
    squares = squared(white[0]) / deviation**2
    np.testing.assert_allclose(squares, np.diag(np.linalg.inv(covariance)), rtol=1e-9)


def test_an_iteration_steps_downhill_by_the_slope_of_the_cost():
    fit = fit_of_ur5()
    frames, _, _ = made_up(fit, 1.0)
    members = fit.spawned((), np.int_(0), 4, np.float64(0.05))
    variance = np.full(4, 1e-4)
    late = np.float64(0.0)
    before = fit.costs(members, fit.fitted(members, frames), late, variance)[0]
    after, fitted = fit.iterated(members, frames, late, variance)
    assert (after.cost <= before).all()
    assert (after.cost < before).any()
    np.testing.assert_allclose(fitted.residual, fit.residual(after, frames), atol=1e-12)


def test_a_deviating_arm_is_found_again_at_all_places_and_so_is_the_latency():
    fit = fit_of_ur5()
    frames, theta, cameras = made_up(fit, 6.0)
    members, _ = fit.aligned(fit.start((), 8, np.float64(0.1)), frames)
    variance = np.full(8, NOISE**2)
    for _ in range(40):
        members, _ = fit.iterated(members, frames, np.float64(0.0), variance)
    best = int(members.cost.argmin())
    assert members.latency[best] == pytest.approx(LATENCY, abs=2e-3)
    elsewhere = joints_at(np.linspace(20.0, 60.0, 50))
    wanted = fit.model.derivatives(theta, cameras, elsewhere)
    found = fit.model.derivatives(members.theta[best], members.cameras[best], elsewhere)
    wrong = np.linalg.norm(found.by_joint - wanted.by_joint) / np.linalg.norm(wanted.by_joint)
    assert wrong < 0.03
    assert np.abs(found.feature - wanted.feature).max() < 0.02


def test_derivatives_of_residuals_are_those_of_differences():
    fit = fit_of_ur5()
    frames, _, _ = made_up(fit, 1.0)
    members = fit.spawned((), np.int_(1), 2, np.float64(0.06))
    members.theta[:, PLAY] = 0.01
    members.theta[:, RIPPLE] = 0.02
    rates = fit.fitted(members, frames).rates
    size = 1e-6

    def moved(column, change):
        step = np.zeros((2, fit.count + 2))
        step[:, column] = change
        return fit.residual(fit.moved(members, step), frames)

    for column in range(fit.count + 2):
        slope = (moved(column, size) - moved(column, -size)) / (2.0 * size)
        scale = max(1e-3, np.abs(slope).max())
        np.testing.assert_allclose(rates[:, column], -slope, atol=1e-4 * scale, err_msg=column)


def test_play_and_ripple_of_the_plants_gears_are_found():
    fit = fit_of_ur5()
    gears = MechanicsConfig(backlash=0.015, ripple=0.02, ripple_order=10.0)
    frames, _, _ = made_up(fit, 6.0, mechanics=gears)
    members, _ = fit.aligned(fit.start((), 8, np.float64(0.1)), frames)
    variance = np.full(8, NOISE**2)
    for number in range(80):
        if number % 4 == 0:
            members = fit.challenged(members, np.int_(number))
        members, _ = fit.iterated(members, frames, np.float64(0.0), variance)
    first = int(members.cost.argmin())
    best = members.theta[first]
    assert members.order[first] == gears.ripple_order
    assert best[RIPPLE] == pytest.approx(0.02, abs=2e-3)
    assert best[PLAY] == pytest.approx(0.015, abs=3e-3)


def test_places_of_joints_within_their_play_are_those_on_the_plant():
    fit = fit_of_ur5()
    size = 0.015
    times = np.arange(0.0, 6.0, FINE)
    behind = driven(MechanicsConfig(backlash=size), times)
    wanted = (behind - joints_at(times)) / size
    np.testing.assert_allclose(rows_of_history(fit, times, size)[:, 6:], wanted, atol=1e-9)


def test_screening_places_the_camera_and_takes_the_arm_that_fits():
    fit = fit_of_ur5()
    frames, theta, _ = made_up(fit)
    many = fit.spawned((), np.int_(0), 40, np.float64(LATENCY))
    many.theta[17, :PLAY] = theta
    variance = np.full(40, 25.0 * NOISE**2)
    best = fit.screened(many, frames, variance, 3)
    np.testing.assert_allclose(best.theta[0, :PLAY], theta)
    own = np.median(squared(fit.residual(best, frames)), axis=-1)
    # Three coordinates of noise, and what the placed camera fits of it.
    assert own[0] < 3.0 * NOISE**2
    assert np.all(own[1:] > 2.0 * own[0])
