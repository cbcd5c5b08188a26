"""Runs side by side: a lane of a plant has the same bits alone, with other neighbours and after others were dropped."""

from itertools import product

import numpy as np
import pytest

from kit.plants import configure, mismatched, nominal_ur5
from servobench.harness.config.registry import find_plant
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract import lanes
from servobench.plant.contract.faults import PlantDiverged
from servobench.plant.contract.signals import Command
from servobench.plant.kinematic import KinematicConfig, KinematicWorld
from servobench.plant.robot.hand_eye import TrueJacobian
from servobench.plant.robot.mechanics import MechanicsConfig
from servobench.plant.robot.ur5 import HOME

SEEDS = (11, 4, 7)
MODELS = [mismatched("severe+gear_ratio=5%", seed) for seed in SEEDS]
STARTS = np.array(HOME) + np.random.default_rng(0).uniform(-0.3, 0.3, (3, 6))
PERIODS, MOVE = 70, 40  # further than one block of random numbers
COMMANDS = np.random.default_rng(1).uniform(-1.5, 1.5, (PERIODS, 3, 6))
MOVED = np.array([mismatched("camera_rotation=40deg", seed).X_BC for seed in SEEDS])
WORST = {
    "command_delay": 0.15, "latency": 0.1, "drop_probability": 0.2, "camera_turn": 0.3, "stamps": True,
}  # fmt: skip
# Sub-steps of 10 ms
FINE = {"command_delay": 0.13, "latency": 0.07, "frame_period": 0.03, "drop_probability": 0.3}
DISTURBED = {
    "noise": "stable", "latency": 0.05, "jitter": 0.09, "latency_swing": 0.1, "swing_period": 2.0,
    "stamps": True, "clock_offset": 7.0,
    "outliers": 0.3, "outlier_duration": 0.2, "quantum": 1e-4,
    "occlusions": 0.2, "occlusion_duration": 0.3, "occlusion_windows": ((1.2, 1.4),),
}  # fmt: skip
MECHANICS = {"mechanics": MechanicsConfig(backlash=0.035, ripple=0.03, tool_frequency=12.0)}


@pytest.fixture(
    params=[
        ("kinematic", WORST),
        ("fmu", WORST),
        ("kinematic", FINE | {"overshoot": 0.3}),
        ("fmu", FINE | MECHANICS),
        ("kinematic", DISTURBED | MECHANICS),
    ]
)
def build(request):
    """Return a function that builds a plant for one lane or for an array of lanes, under bad sensing."""
    name, settings = request.param
    entry, opened = find_plant(name), []
    assert entry.side_by_side

    def made(chosen):
        model = (
            MODELS[chosen]
            if np.ndim(chosen) == 0
            else lanes.stack([MODELS[lane] for lane in chosen])
        )
        opened.append(
            entry.build(
                configure(entry.config, **settings), PlantSetup(model, STARTS[chosen], 0.05)
            )
        )
        opened[-1].reset(
            SEEDS[chosen] if np.ndim(chosen) == 0 else [SEEDS[lane] for lane in chosen]
        )
        return opened[-1]

    yield made
    for plant in opened:
        plant.close()


def walk(plant, chosen, periods=range(PERIODS)):
    """Return what a plant shows at each period, as arrays (periods, ...)."""
    rows = []
    for k in periods:
        if k == MOVE:
            plant.move_camera(MOVED[chosen])
        seen, truth = plant.step(Command(COMMANDS[k, chosen])), plant.truth()
        assert not any(
            each.flags.writeable
            for each in (seen.joint_position, seen.feature, seen.valid, seen.capture_time)
        )
        rows.append(
            (
                seen.joint_position,
                seen.feature,
                seen.feature_valid,
                seen.valid,
                seen.capture_time,
                truth.feature,
                truth.jacobian,
            )
        )
    return [np.array(column) for column in zip(*rows, strict=True)]


def assert_same(walked, lane, alone):
    for together, one in zip(walked, alone, strict=True):
        np.testing.assert_array_equal(together[:, lane], one)


def test_an_arm_has_the_same_bits_alone_and_among_others():
    order = np.array([2, 0, 1])
    stacked = lanes.stack(MODELS)
    q = STARTS + np.random.default_rng(3).uniform(-2.0, 2.0, (20, 3, 6))

    def everything(model, q):
        points = model.feature(q)
        return (
            model.arm.frames(q),
            points,
            model.jacobian(q),
            TrueJacobian(model)(q),
            model.to_base(points),
        )

    together, permuted = everything(stacked, q), everything(lanes.take(stacked, order), q[:, order])
    for k, (place, lane) in product(range(20), enumerate(order)):
        alone = everything(lanes.take(stacked, lane), q[k, lane])
        for many, other, one in zip(together, permuted, alone, strict=True):
            np.testing.assert_array_equal(many[k, lane], one)
            np.testing.assert_array_equal(other[k, place], one)


@pytest.mark.slow
def test_a_lane_has_the_same_bits_alone_in_another_order_and_after_others_are_gone(build):
    alone = [walk(build(lane), lane) for lane in range(3)]
    assert 0.1 < 1.0 - np.mean(alone[0][2]) < 0.4
    order = np.array([2, 0, 1])
    for chosen in (np.arange(3), order):
        walked = walk(build(chosen), chosen)
        for place, lane in enumerate(chosen):
            assert_same(walked, place, alone[lane])
    plant, late = build(np.arange(3)), range(20, PERIODS)
    walk(plant, np.arange(3), range(20))
    plant.keep(np.array([2, 0]))
    walked = walk(plant, np.array([2, 0]), late)
    for place, lane in enumerate((2, 0)):
        assert_same(walked, place, [column[20:] for column in alone[lane]])
    with pytest.raises(ValueError, match=r"seed must have shape \(2,\), got \(3,\)"):
        plant.reset(SEEDS)
    first = plant.reset([SEEDS[2], SEEDS[0]])
    np.testing.assert_array_equal(first.feature[1], build(0).reset(SEEDS[0]).feature)


def test_what_does_not_fit_the_number_of_runs_is_refused(build):
    with pytest.raises(ValueError, match="one run only"):
        build(0).keep(np.array([0]))
    with pytest.raises(ValueError, match=r"seed must have shape \(\), got \(3,\)"):
        build(0).reset(SEEDS)
    with pytest.raises(ValueError, match=r"X_BC must have shape \(3, 4, 4\), got \(2, 4, 4\)"):
        build(np.arange(3)).move_camera(MOVED[:2])
    with pytest.raises(ValueError, match=r"joint_velocity must have shape \(3, 6\), got \(6,\)"):
        build(np.arange(3)).step(Command(np.zeros(6)))
    with pytest.raises(ValueError, match="state must be of runs of shape"):
        build(np.array([0, 2])).restore(build(np.arange(3)).save())


@pytest.mark.parametrize("lane", [None, 1])
def test_joints_that_leave_the_finite_numbers_end_their_run_only(lane):
    model = nominal_ur5() if lane is None else lanes.stack([nominal_ur5()] * 3)
    world = KinematicWorld(
        KinematicConfig(), PlantSetup(model, STARTS[0] if lane is None else STARTS, 0.05)
    )
    q = world.reset(SEEDS)
    v = np.zeros(q.shape)
    v[lane] = np.inf
    world.restore(world.save()._replace(v=v))
    if lane is None:
        with pytest.raises(PlantDiverged, match="joint positions are not finite"):
            world.advance(np.zeros(6))
        return
    for _ in range(2):
        np.testing.assert_array_equal(world.advance(np.zeros((3, 6))), STARTS)
        assert [(place, fault.status) for place, fault in world.faults.items()] == [
            (1, "plant_diverged")
        ]
        assert np.isfinite(world.truth().feature).all()
    world.keep(np.array([0, 2]))
    assert not world.faults
    np.testing.assert_array_equal(world.advance(np.zeros((2, 6))), STARTS[[0, 2]])
