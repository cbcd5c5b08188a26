"""The contract of a plant, held against every registered one."""

import contextlib
from dataclasses import replace
from functools import partial

import numpy as np
import pytest

from kit.plants import ALL_PLANTS, nominal_ur5
from servobench.harness.apps.check.plants import check_plant
from servobench.harness.config.registry import RENDERED, find_plant
from servobench.plant.bench.plant import PlantEntry, PlantSetup
from servobench.plant.contract.settings import override
from servobench.plant.contract.signals import Command
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch
from servobench.plant.robot.ur5 import HOME

PERIOD = 0.05
COMMANDS = np.random.default_rng(2).uniform(-0.5, 0.5, (6, 6))
MODEL, SAMPLE = sample_mismatch(
    Mismatch.parse("moderate+gear_ratio=5%+camera_move=20deg"), find_robot("ur5"), 1
)
MOVED = SAMPLE.moved(MODEL, find_robot("ur5"))  # the same robot after a move of its camera


@pytest.fixture(params=ALL_PLANTS)
def entry(request) -> PlantEntry:
    """The entry of each plant, without table and floor, which change no bit of an observation."""
    found = find_plant(request.param)
    return (
        replace(found, config=partial(found.config, scenery=False))
        if request.param in RENDERED
        else found
    )


@pytest.fixture
def plant(entry):
    made = entry.build(entry.config(), PlantSetup(MODEL, np.array(HOME), PERIOD))
    yield made
    made.close()


def test_it_keeps_the_contract_of_plants(entry):
    report = check_plant(entry.name)  # as it is registered
    assert report.ok, report
    assert len(report.findings) == 9


def test_a_start_of_the_wrong_size_is_refused(entry):
    with pytest.raises(ValueError, match="start must have shape"):
        entry.build(entry.config(), PlantSetup(nominal_ur5(), np.zeros(2), PERIOD))


def test_a_restored_state_continues_with_the_same_bits_also_after_a_camera_move(plant):
    def continued() -> list[bytes]:
        seen = [plant.step(Command(u)) for u in COMMANDS]
        truth = plant.truth()
        arrays = [each for o in seen for each in (o.joint_position, o.feature)] + [
            truth.feature,
            truth.jacobian,
        ]
        return [each.tobytes() for each in arrays]

    plant.reset(5)
    before = plant.save()
    first = continued()
    plant.move_camera(MOVED.X_BC)
    between = plant.save()
    second = continued()
    for state, expected in ((before, first), (between, second), (before, first)):
        plant.restore(state)
        assert continued() == expected


def test_a_picture_disturbs_neither_the_run_nor_its_random_streams(plant):
    runs, pictures = [], []
    for seed, drawn in ((3, False), (3, True), (8, False)):
        plant.reset(seed)
        runs.append([])
        for u in COMMANDS:
            pictures += [plant.picture()] if drawn else []
            runs[-1].append(plant.step(Command(u)).feature.tobytes())
    assert runs[0] == runs[1] != runs[2]
    for picture in pictures:
        assert picture is None or (
            picture.dtype == np.uint8 and picture.ndim == 3 and picture.std() > 0
        )


def test_a_moved_camera_shows_the_ball_elsewhere_after_its_latency_until_the_reset(entry):
    config = override("plant", entry.config(), {"sensing": {"latency": 3 * PERIOD}})
    # Far from the point about which the camera turns
    start = np.add(HOME, [0.6, 0.0, 0.0, 0.0, 0.0, 0.0])
    with contextlib.closing(entry.build(config, PlantSetup(MODEL, start, PERIOD))) as plant:
        plant.reset(0)
        before = plant.truth()
        plant.move_camera(MOVED.X_BC)
        seen = [plant.step(Command(np.zeros(6))) for _ in range(5)]
        after, q = plant.truth(), seen[-1].joint_position
        assert np.linalg.norm(after.feature - before.feature) > 0.03
        np.testing.assert_allclose(after.feature, MOVED.feature(q), atol=5e-5)
        np.testing.assert_allclose(after.jacobian, MOVED.jacobian(q), atol=5e-5)
        for k, observation in enumerate(seen):
            assert np.linalg.norm(observation.feature - (before if k < 3 else after).feature) < 0.01
        plant.reset(0)
        np.testing.assert_allclose(plant.truth().feature, before.feature, atol=1e-9)


def test_noise_can_be_varied(entry):
    def spread(factor: float) -> float:
        config = override("plant", entry.config(), {"sensing": {"noise_factor": factor}})
        with contextlib.closing(
            entry.build(config, PlantSetup(nominal_ur5(), np.array(HOME), PERIOD))
        ) as plant:
            seen = [
                plant.reset(4).feature,
                *(plant.step(Command(np.zeros(6))).feature for _ in range(12)),
            ]
        return float(np.std(seen, axis=0).max())

    quiet, usual, loud = spread(0.0), spread(1.0), spread(3.0)
    assert quiet < 0.5 * usual
    assert loud > 1.8 * usual
