"""Sensing set-ups in rendered images, against the closed form of `kinematic`."""

import re
from dataclasses import replace

import numpy as np
import pytest

from kit.own import write
from kit.rendered import IDEAL
from kit.robots import FOUR_JOINTS
from servobench.harness.config.registry import find_plant
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.cameras.registry import Sensing
from servobench.plant.cameras.setups import SensingSetup
from servobench.plant.contract.faults import FeatureLost
from servobench.plant.contract.signals import Command
from servobench.plant.rendered.detectors import ImageNoise, open_detector
from servobench.plant.rendered.plants import load_engine
from servobench.plant.rendered.room import Room
from servobench.plant.rendered.settings import rendered_config
from servobench.plant.robot.catalogue import find_robot
from servobench.plant.robot.mismatch import Mismatch, sample_mismatch

UR5 = find_robot("ur5")
HOME = UR5.workspace.home
MODERATE = Mismatch.parse("moderate")
IN_PIXELS = ("pixel", "pixel:hand", "stereo", "stereo:hand", "plate", "plate:hand")


def true_model(word, robot=UR5):
    arm, sample = sample_mismatch(MODERATE, robot, 3)
    return Sensing.parse(word).true(robot, arm, sample, MODERATE, 3)[0]


@pytest.fixture
def open_setup(engine):
    """A builder of noiseless plants under a sensing set-up, which are closed after the test."""
    plants = []

    def build(model, config=IDEAL, start=HOME, robot=UR5):
        plants.append(find_plant(engine).build(config, PlantSetup(model, start, 0.05, robot)))
        return plants[-1]

    yield build
    for plant in plants:
        plant.close()


@pytest.mark.parametrize("word", IN_PIXELS)
def test_what_is_found_is_where_the_closed_form_has_it_and_discs_are_not_confused(word, engine):
    model, rng = true_model(word), np.random.default_rng(5)
    scene = load_engine(engine).scene(Room(model.arm, scenery=False, robot=UR5, model=model))
    detector, errors, poses = open_detector(model, scene, IDEAL, UR5), [], 0
    noise = ImageNoise(0)
    while poses < 8:
        q = rng.uniform(UR5.workspace.lower, UR5.workspace.upper)
        true, _, in_view = model.observe(q)
        if not in_view.all():
            continue
        poses += 1
        scene.place(model.arm.joint_angle(q))
        found, seen = detector.measure(model, q, noise)
        errors += [np.linalg.norm(each) for each in (found - true)[seen].reshape(-1, 2)]
    scene.close()
    assert len(errors) > 0.6 * poses * model.setup.m / 2
    assert np.median(errors) <= 0.2
    assert max(errors) < 5.0  # discs are 30 px apart or more


@pytest.mark.parametrize("word", [*IN_PIXELS, "position:hand"])
def test_a_plant_sees_its_target_from_the_start_and_follows_it(word, open_setup):
    model = true_model(word)
    plant = open_setup(model)
    observation = plant.reset(0)
    assert observation.feature_valid
    for _ in range(4):
        observation = plant.step(Command(np.full(6, 0.1)))
    truth = plant.truth()
    np.testing.assert_allclose(truth.feature, model.feature(observation.joint_position), atol=1e-9)
    assert np.linalg.norm(observation.feature - truth.feature) < (
        0.003 if word == "position:hand" else 1.0
    )
    assert plant.picture().shape == (240, 320 * model.setup.cameras, 3)


def test_another_arm_carries_the_plate_at_its_own_scale(open_setup):
    panda, model = find_robot("panda"), true_model("plate", find_robot("panda"))
    plant = open_setup(model, rendered_config(panda), panda.workspace.home, panda)
    assert plant.reset(0).feature_valid


@pytest.mark.parametrize(
    ("scale", "word"), [(0.08, "pixel:hand"), (0.08, "position"), (5.0, "pixel"), (5.0, "position")]
)
def test_cameras_of_small_and_large_arms_see_the_target(tmp_path, open_setup, scale, word):
    lengths = {length: f"{scale * float(length):g}" for length in ("0.45", "0.4", "0.1", "0.35")}
    text = re.sub(r"\b0\.\d+\b", lambda found: lengths.get(found[0], found[0]), FOUR_JOINTS)
    robot = find_robot(str(write(tmp_path, text, "arm.toml")))
    model = Sensing.parse(word).nominal(robot)
    plant = open_setup(
        model, replace(IDEAL, drives=rendered_config(robot).drives), robot.workspace.home, robot
    )
    observation = plant.reset(0)
    assert observation.feature_valid
    np.testing.assert_allclose(
        observation.feature,
        plant.truth().feature,
        atol=0.005 * scale if word == "position" else 1.0,
    )


def test_a_hidden_disc_is_lost_alone_and_held(open_setup):
    model = true_model("plate")
    points = model.points(HOME)
    towards = model.cameras[0][:3, 3] - points[2]
    box = (*(points[2] + 0.1 * towards), 0.03, 0.03, 0.03)
    plant = open_setup(model, replace(IDEAL, obstacles=(box,), room_contact=False))
    with pytest.raises(FeatureLost, match="u3, v3 cannot be seen at the start"):
        plant.reset(0)
    world = plant.world
    np.testing.assert_array_equal(world.visible(), [True] * 4 + [False] * 2 + [True] * 2)
    assert np.isfinite(world.see()).all()


def test_what_cannot_be_rendered_is_refused(open_setup):
    model = true_model("pixel")
    two = SensingSetup(
        "two",
        "",
        ("a", "b", "c", "d"),
        "px",
        model.setup.measure,
        target=((0.0,) * 3, (0.1, 0.0, 0.0)),
    )
    with pytest.raises(
        ValueError, match="a ball, of one point, or a plate with three or four discs"
    ):
        open_setup(replace(model, setup=two, target=np.array(two.target)))
    deep = replace(
        model.setup,
        name="deep",
        measure=lambda points, optics: optics.focal * points[..., 0, 0, :2],
    )
    with pytest.raises(ValueError, match="sensing deep needs depth, and the intrinsics"):
        open_setup(replace(model, setup=deep))
