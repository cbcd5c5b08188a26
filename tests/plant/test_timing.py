"""Physical time: the same world at every control rate, with features late by exactly the latency."""

import re

import numpy as np
import pytest

from kit.plants import NEEDS_BULLET, configure, setup
from kit.small_loop import TIME_DIGITS
from servobench.harness.config.registry import find_plant
from servobench.plant.bench.bench import Bench, build_bench, common_step
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, KinematicWorld
from servobench.plant.rendered.settings import DriveConfig, RenderedConfig

RATES = (10, 20, 50, 125, 250)  # [Hz]
CAMERA_RATES = (15, 30, 60, 90, 120)  # [Hz] whose periods are no whole milliseconds
DURATION = 1.0  # [s]
COMMON = 0.2  # [s] multiples of it are control instants at every rate
QUIET = {"feature_noise": 0.0}


def wanted(time):
    """Return a command that changes at multiples of `COMMON` only, (6,) rad/s."""
    return 0.5 * np.sin(1.0 + round(time // COMMON) + np.arange(6.0))


def run(plant, rate):
    """Return the observations of a run, the first one included."""
    seen = [plant.reset(3)]
    for k in range(round(DURATION * rate)):
        seen.append(plant.step(Command(wanted(k / rate + 1e-9))))
    return seen


@pytest.fixture(params=["kinematic", "fmu"])
def build(request):
    """Return a function that builds a plant for a control rate; plants are closed at the end."""
    entry, opened = find_plant(request.param), []

    def made(rate, **settings):
        config = configure(entry.config, **{**QUIET, **settings})
        opened.append(entry.build(config, setup("moderate", 1.0 / rate)))
        return opened[-1]

    yield made
    for plant in opened:
        plant.close()


def every(seen, rate):
    """Return joints and features at multiples of `COMMON`."""
    step = round(COMMON * rate)
    return [
        np.array([getattr(o, name) for o in seen[::step]]) for name in ("joint_position", "feature")
    ]


@pytest.mark.parametrize("command_delay", [0.0, 0.05, 0.07])
def test_the_physical_world_is_the_same_at_every_rate(build, command_delay):
    settings = {"command_delay": command_delay, "latency": 0.07}
    walks = {
        rate: every(run(build(rate, **settings), rate), rate) for rate in (*RATES, *CAMERA_RATES)
    }
    assert np.ptp(walks[250][0], axis=0).max() > 0.05
    for joints, features in walks.values():
        np.testing.assert_allclose(joints, walks[250][0], rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(features, walks[250][1], rtol=0.0, atol=1e-9)


@pytest.mark.slow
@NEEDS_BULLET
def test_the_rendered_world_is_the_same_at_two_rates():
    entry, walks = find_plant("bullet"), []
    late = {
        "command_delay": 0.05,
        "latency": 0.07,
        "drop_probability": 0.0,
        "depth_noise": "none",
        "scenery": False,
    }
    for rate in (10, 20):
        plant = entry.build(configure(entry.config, **late), setup("moderate", 1.0 / rate))
        walks.append(every(run(plant, rate), rate))
        plant.close()
    for one, other in zip(*walks, strict=True):
        np.testing.assert_allclose(one, other, rtol=0.0, atol=1e-9)
        assert np.ptp(one, axis=0).max() > 0.05


@NEEDS_BULLET
@pytest.mark.parametrize("rate", [15, 29.97, 30, 90])
def test_physics_steps_add_up_to_the_period(rate):
    config = configure(
        RenderedConfig, lag=0.0, latency=0.0, scenery=False, drives=DriveConfig(dynamics=False)
    )
    plant = find_plant("bullet").build(config, setup(period=1 / rate))
    start = plant.reset(3).joint_position
    moved = [plant.step(Command(np.full(6, 0.3))).joint_position - start for _ in range(3)]
    plant.close()
    np.testing.assert_allclose(moved[-1], 0.3 * 3 / rate, atol=config.encoder_resolution)


@pytest.mark.parametrize("rate", RATES)
def test_a_feature_is_late_by_exactly_the_latency(build, rate):
    late, fine = (
        [o.feature for o in run(build(own, latency=latency), own)]
        for own, latency in ((rate, 0.033), (1000, 0.0))
    )
    instants = [round(1000 * k / rate) for k in range(len(late))]
    np.testing.assert_allclose(
        late, [fine[max(0, ms - 33)] for ms in instants], rtol=0.0, atol=1e-9
    )


@pytest.mark.parametrize("rate", RATES)
def test_a_slow_camera_shows_frames_of_its_own_clock_and_the_feature_is_held_between(build, rate):
    seen = run(build(rate, latency=0.02, frame_period=0.04), rate)
    fine = [o.feature for o in run(build(1000), 1000)]
    held, last = fine[0], 0
    for k, observation in enumerate(seen[1:], 1):
        newest = (round(1000 * k / rate) - 20) // 40  # number of the newest frame that is delivered
        assert observation.feature_valid == (
            newest > last or (newest == 0 and (k - 1) / rate < 0.02 <= k / rate)
        )
        held, last = fine[40 * newest] if newest > 0 else held, max(newest, last)
        np.testing.assert_allclose(observation.feature, held, rtol=0.0, atol=1e-9)


def test_a_camera_of_the_control_period_is_the_default_camera(build):
    first, second = (run(build(20, latency=0.1, frame_period=period), 20) for period in (0.0, 0.05))
    for one, other in zip(first, second, strict=True):
        np.testing.assert_array_equal(one.feature, other.feature)
        assert one.feature_valid
        assert other.feature_valid


def test_lost_frames_are_frames_of_the_camera():
    config = configure(KinematicConfig, drop_probability=0.5, frame_period=0.1, **QUIET)
    seen = run(find_plant("kinematic").build(config, setup(period=0.02)), 50)
    assert not any(o.feature_valid for k, o in enumerate(seen) if k % 5)
    assert 1 < sum(o.feature_valid for o in seen) < 10


def test_no_frame_is_taken_that_is_not_exposed(monkeypatch):
    taken, see = [], KinematicWorld.see
    monkeypatch.setattr(KinematicWorld, "see", lambda world: taken.append(1) or see(world))
    config = configure(KinematicConfig, command_delay=0.001, latency=0.033, **QUIET)
    run(find_plant("kinematic").build(config, setup(period=0.05)), 20)
    assert len(taken) == 1 + 20


@pytest.mark.parametrize(
    ("period", "delay", "sensing", "step"),
    [
        (0.05, 0.05, SensingConfig(), 0.05),
        (1 / 240, 0.05, SensingConfig(), 1 / 240),
        (0.05, 0.0, SensingConfig(latency=0.15), 0.05),
        (0.1, 0.05, SensingConfig(), 0.05),
        (0.02, 0.05, SensingConfig(), 0.01),
        (0.008, 0.05, SensingConfig(latency=0.1), 0.002),
        (0.004, 0.05, SensingConfig(frame_period=0.033), 0.001),
        (1 / 30, 0.05, SensingConfig(latency=0.1), 1 / 60),
        (0.0333333, 0.05, SensingConfig(latency=0.1), 0.0333333 / 2),
        (1 / 90, 0.05, SensingConfig(), 1 / 180),
        (0.05, 0.05, SensingConfig(frame_period=1 / 30), 0.05 / 3),
        (0.05, 0.0, SensingConfig(latency=0.0205), 0.0005),
        (1 / 29.97, 0.05, SensingConfig(), 1 / 29.97 / 34),
        (0.05, 0.083, SensingConfig(frame_period=1 / 29.97), 0.001),
    ],
)
def test_the_sub_step_is_the_greatest_common_divisor(period, delay, sensing, step):
    assert common_step(period, delay, sensing) == step


def test_a_control_period_of_nothing_is_refused():
    with pytest.raises(ValueError, match=re.escape("period must be above 0, got 0.0")):
        common_step(0.0, 0.05, SensingConfig())


@pytest.mark.parametrize("rate", [6, 24, 29.97, 48, 1000 / 3])
def test_a_command_acts_after_its_delay_to_within_half_a_millisecond(rate):
    world = configure(KinematicConfig, lag=0.0, command_delay=0.05, latency=0.083, **QUIET)
    plant = find_plant("kinematic").build(world, setup(period=1 / rate))
    start = plant.reset(3).joint_position
    for _ in range(round(rate)):
        seen = plant.step(Command(np.full(6, 0.3)))
    np.testing.assert_allclose(seen.time - (seen.joint_position - start) / 0.3, 0.05, atol=0.0005)


@pytest.mark.parametrize(
    ("rate", "frames"), [(125, 30), (60, 30), (20, 29.97), (20, 15), (30, 24), (1000 / 3, 29.97)]
)
def test_a_camera_keeps_its_own_rate_under_every_control_rate(monkeypatch, rate, frames):
    taken, see = [], KinematicWorld.see
    monkeypatch.setattr(KinematicWorld, "see", lambda world: taken.append(1) or see(world))
    config = configure(
        KinematicConfig, command_delay=0.05, latency=0.083, frame_period=1 / frames, **QUIET
    )
    plant = find_plant("kinematic").build(config, setup(period=1 / rate))
    plant.reset(3)
    for _ in range(round(20 * rate)):
        plant.step(Command(np.zeros(6)))
    assert abs(len(taken) - 1 - 20 * frames) <= 1


def test_rounded_times_are_named_once(caplog):
    remark.cache_clear()
    for _ in range(2):
        find_plant("kinematic").build(
            configure(KinematicConfig, command_delay=0.05, **QUIET), setup(period=1 / 29.97)
        )
    said = "command_delay: rounded to multiples of 0.981374 ms, 1/34 of the control period of 0.0333667 s"
    assert [said in record.getMessage() for record in caplog.records] == [True]


def test_a_bench_refuses_a_world_that_is_too_coarse():
    world = KinematicWorld(KinematicConfig(), setup(period=0.05))
    with pytest.raises(
        ValueError,
        match=r"latency must be a multiple of the world's period of 0\.05 s, got 0\.02 s",
    ):
        Bench(world, 0.05, SensingConfig(latency=0.02))


@pytest.mark.parametrize("periods", [1, 7, 88])
def test_latencies_that_an_analysis_tries_need_no_fine_sub_steps(periods):
    sensing = SensingConfig(latency=round(0.05 + periods / 30.0, TIME_DIGITS))
    assert common_step(1.0 / 30.0, 0.05, sensing) == pytest.approx(1.0 / 60.0)


def test_an_own_step_that_fits_no_sub_step_is_refused_with_a_remedy():
    def refuse(_):
        raise ValueError("its step is 0.01 s")

    said = r"sub-steps of 0.0166667 s.*0.01 s; run.period, command_delay and latency that are multiples of its own step"
    with pytest.raises(ValueError, match=said):
        build_bench(refuse, setup("none", 1.0 / 30.0), 0.05, SensingConfig())
