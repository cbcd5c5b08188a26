"""The bench around any world: limits, delay, noise, latency, lost frames, and saved states."""

import pickle

import numpy as np
import pytest

from kit.plants import configure, mismatched
from servobench.harness.config.registry import find_plant
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantSetup, World
from servobench.plant.contract.faults import FeatureLost
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Command, PlantSpec, Truth
from servobench.plant.robot.ur5 import HOME

SPEC = PlantSpec.of_joints(("a", "b"), ("x",), [1.0, 0.5], [-9.0, -9.0], [9.0, 9.0], 0.1)
QUIET = SensingConfig(0.0)
COMMANDS = np.random.default_rng(3).uniform(-0.5, 0.5, (20, 2))


class Counter(World):
    """Joints move by the command times the period; the feature is the first joint, unless it is hidden there."""

    spec = SPEC

    def __init__(self, hidden=()):
        self.hidden, self.joints, self.closed = hidden, np.zeros(2), 0

    def reset(self, seed):
        self.joints, self.frame = np.zeros(2), 0
        return self.joints

    def advance(self, joint_velocity):
        self.joints, self.frame = self.joints + joint_velocity * 0.1, self.frame + 1
        return self.joints

    def see(self):
        return None if self.frame in self.hidden else self.joints[:1]

    def truth(self):
        return Truth(self.joints[:1], None)

    def close(self):
        self.closed += 1


def bench(delay=0, sensing=QUIET, hidden=(), seed=0) -> Bench:
    plant = Bench(Counter(hidden), delay, sensing)
    plant.reset(seed)
    return plant


def walk(plant, commands=COMMANDS):
    return [plant.step(Command(u)) for u in commands]


def test_a_command_arrives_after_its_delay_and_the_arm_rests_until_then():
    moved = [o.joint_position[0] for o in walk(bench(delay=0.2), np.full((4, 2), 0.5))]
    np.testing.assert_allclose(moved, [0.0, 0.0, 0.05, 0.1], atol=1e-15)


def test_the_latency_of_a_frame_swings_about_its_mean_by_its_time_of_exposure():
    plant = bench(sensing=SensingConfig(0.0, 0.1, latency_swing=0.2, swing_period=4.0))
    exposed = 0.1 * np.arange(61)
    arrival = exposed + 0.3 + 0.2 * np.sin(2 * np.pi * exposed / 4.0)
    for k, seen in enumerate(walk(plant, np.full((60, 2), 0.5)), 1):
        arrived = exposed[1:][arrival[1:] <= 0.1 * k + 1e-9]
        assert seen.feature[0] == pytest.approx(0.5 * arrived.max(initial=0.0))
        new = ((arrival[1:] > 0.1 * (k - 1) + 1e-9) & (arrival[1:] <= 0.1 * k + 1e-9)).any()
        # The first frame under way shows the start
        assert k <= 1 or bool(seen.feature_valid) == new


def test_a_camera_turns_about_its_optical_axis_at_the_same_speed_on_every_plant():
    model, rate = mismatched("moderate"), 0.3
    for name in ("kinematic", "fmu"):
        entry = find_plant(name)
        config = configure(entry.config, camera_turn=rate, feature_noise=0.0, latency=0.1)
        plant = entry.build(config, PlantSetup(model, np.array(HOME), 0.05))
        plant.reset(0)
        seen = [plant.step(Command(np.full(6, 0.1))) for _ in range(20)]
        for back, shown in (
            (0, plant.truth().feature),
            (2, seen[-1].feature),
        ):  # two periods of latency
            angle = rate * 0.05 * (20 - back)
            x, y, z = model.feature(seen[-1 - back].joint_position)
            turned = x * np.cos(angle) + y * np.sin(angle), y * np.cos(angle) - x * np.sin(angle), z
            np.testing.assert_allclose(shown, turned, rtol=0, atol=1e-12)
        plant.close()
    with pytest.raises(ValueError, match="camera_turn needs a camera whose pose is known"):
        bench(sensing=SensingConfig(0.0, camera_turn=0.1))


def test_a_lost_frame_is_not_valid_and_the_last_feature_is_held():
    plant = bench(sensing=SensingConfig(0.0, drop_probability=0.5))
    held, valid = np.zeros(1), []
    for observation in walk(plant, np.full((200, 2), 0.1)):
        valid.append(observation.feature_valid)
        assert observation.valid.tolist() == [observation.feature_valid]
        expected = observation.joint_position[:1] if observation.feature_valid else held
        np.testing.assert_array_equal(observation.feature, expected)
        held = observation.feature
    assert 60 < sum(valid) < 140


def test_a_frame_without_the_feature_comes_out_late_as_well():
    seen = walk(bench(sensing=SensingConfig(0.0, 0.1), hidden=(2,)), np.full((4, 2), 0.5))
    assert [o.feature_valid for o in seen] == [True, True, False, True]
    np.testing.assert_allclose([o.feature[0] for o in seen], [0.0, 0.05, 0.05, 0.15], atol=1e-15)


def test_a_feature_that_is_hidden_at_the_start_ends_the_run():
    with pytest.raises(FeatureLost, match="not visible at the start"):
        bench(hidden=(0,))


def test_a_run_begins_with_a_reset():
    with pytest.raises(ValueError, match="reset must be called before the first step"):
        Bench(Counter(), 0, QUIET).step(Command(np.zeros(2)))


def test_a_saved_state_restores_delay_latency_noise_and_lost_frames():
    plant = bench(0.2, SensingConfig(0.01, 0.2, 0.3), seed=5)
    walk(plant)
    state = plant.save()
    first = walk(plant)
    for saved in (state, pickle.loads(pickle.dumps(state))):
        plant.restore(saved)
        again = walk(plant)
        for name in ("time", "joint_position", "feature", "feature_valid"):
            np.testing.assert_array_equal(
                *([getattr(o, name) for o in run] for run in (first, again))
            )
    assert not plant.step(Command(np.zeros(2))).feature.flags.writeable


def test_closing_closes_the_world():
    plant = bench()
    plant.close()
    assert plant.world.closed == 1


STAMPED = {"stamps": True, "clock_offset": 1e3, "clock_drift": 1e-3}


def shown_at(time):
    """Return what the clock of `STAMPED` shows."""
    return time + 1e3 + 1e-3 * time


def test_without_stamps_no_time_of_capture_is_known():
    assert all(np.isnan(seen.capture_time) for seen in walk(bench(sensing=SensingConfig(0.0, 0.2))))


@pytest.mark.parametrize(
    "late", [{}, {"jitter": 0.35}, {"latency_swing": 0.15, "swing_period": 1.0}]
)
def test_a_stamp_is_the_exposure_of_the_frame_that_is_seen_however_late_it_comes(late):
    """The joint moves by 0.5 rad/s from 0 s on, so the feature tells when its frame was exposed."""
    plant = bench(sensing=SensingConfig(0.0, 0.2, **late, **STAMPED), seed=4)
    seen = walk(plant, np.full((60, 2), 0.5))
    exposed = np.array([each.feature[0] / 0.5 for each in seen])
    moving = exposed > 0.0
    assert moving.sum() > 50
    stamps = np.array([each.capture_time for each in seen])
    np.testing.assert_allclose(stamps[moving], shown_at(exposed[moving]), atol=1e-9)
    ages = np.array([each.time for each in seen]) - exposed
    assert (np.ptp(ages[moving]) > 0.2) == bool(late)


def test_the_first_frame_was_exposed_a_latency_before():
    plant = Bench(Counter(), 0.0, SensingConfig(0.0, 0.2, stamps=True))
    assert plant.reset(0).capture_time == pytest.approx(-0.2)
    slow = Bench(Counter(), 0.0, SensingConfig(0.0, 0.1, frame_period=0.3, stamps=True))
    stamps = [slow.reset(0).capture_time, *(each.capture_time for each in walk(slow))]
    np.testing.assert_allclose(stamps[:8], [-0.3, 0, 0, 0, 0.3, 0.3, 0.3, 0.6], atol=1e-12)


def test_a_frame_without_a_feature_leaves_the_stamp_of_the_last_one():
    plant = bench(sensing=SensingConfig(0.0, stamps=True), hidden=(2, 3))
    stamps = [each.capture_time for each in walk(plant, np.zeros((5, 2)))]
    np.testing.assert_allclose(stamps, [0.1, 0.1, 0.1, 0.4, 0.5], atol=1e-12)


def test_a_saved_state_restores_the_stamps():
    plant = bench(sensing=SensingConfig(0.01, 0.2, 0.3, jitter=0.2, **STAMPED), seed=5)
    walk(plant)
    state = pickle.loads(pickle.dumps(plant.save()))
    first = [each.capture_time for each in walk(plant)]
    plant.restore(state)
    assert [each.capture_time for each in walk(plant)] == first
