"""The rendered plants as a whole, on every engine: truth, bits, save and restore."""

import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from kit.rendered import HOME, IDEAL, MODEL, geared_ur5, wiggle
from servobench.plant.contract.signals import Command


def test_another_process_sees_the_same_bits(open_plant, engine):
    code = (
        "import sys; sys.path[:0] = ['tests']\n"
        "from kit.rendered import *\n"
        f"plant = build(engine={engine!r})\n"
        "print('bits', wiggle(plant, 3).tobytes().hex())"
    )
    root = Path(__file__).resolve().parents[2]
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=root, capture_output=True, text=True, check=True
    )
    bits = next(line for line in done.stdout.splitlines() if line.startswith("bits")).split()[1]
    assert bits == wiggle(open_plant(), 3).tobytes().hex()


def test_two_plants_do_not_disturb_each_other(open_plant):
    alone = wiggle(open_plant(), 3)
    one, two = open_plant(), open_plant(start=HOME + 0.1)
    one.reset(3), two.reset(5)
    rng = np.random.default_rng(7)
    for row in alone[1:]:
        command = Command(rng.uniform(-0.5, 0.5, 6))
        two.step(command)
        np.testing.assert_array_equal(one.step(command).joint_position, row[1:7])


@pytest.mark.parametrize("model", [MODEL, geared_ur5()], ids=["nominal", "geared"])
def test_the_simulators_truth_is_the_models_feature_and_jacobian(open_plant, model):
    start = (HOME - model.arm.joint_offset) / model.arm.gear_ratio
    plant = open_plant(IDEAL, start, model=model)
    plant.reset(0)
    for _ in range(5):
        observation = plant.step(Command(np.linspace(-0.4, 0.4, 6)))
    q = observation.joint_position
    np.testing.assert_allclose(plant.truth().feature, model.feature(q), atol=1e-6)
    np.testing.assert_array_equal(plant.truth().jacobian, model.jacobian(q))
    np.testing.assert_allclose(observation.feature, plant.truth().feature, atol=1e-3)
