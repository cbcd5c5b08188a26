"""A controller of one's own with aids: the chain around it is that of a composed controller."""

import copy
import pickle
from dataclasses import dataclass

import numpy as np
import pytest

import servobench
from servobench.controllers.aids import EQUIPPED, describe_aids
from servobench.harness.apps.check.rig import Driver, Rig
from servobench.harness.config.entries import CONTROLLER
from servobench.harness.config.settings import Settings, flatten
from servobench.plant.contract.faults import ConfigurationError

GAIN = 6.0
DAMPING = 0.02


@dataclass(frozen=True)
class InverseConfig:
    gain: float = GAIN


class Inverse(servobench.Controller):
    """The law of `PidLaw` in its author's words: without limits, with the Jacobian that it is given."""

    aids = servobench.EQUIPPED

    def __init__(self, config: InverseConfig, knowledge):
        self.knowledge = knowledge
        self.resets = []
        self.rate = (1.0 - np.exp(-config.gain * knowledge.spec.period)) / knowledge.spec.period
        self.damping = DAMPING * knowledge.spec.feature.scale

    def reset(self, observation, seed):
        self.resets.append(seed)

    def step(self, observation, reference):
        self.rows = len(reference)
        J = self.J = self.knowledge.nominal_jacobian(observation.joint_position)
        e = reference[0] - observation.feature
        damped = J @ J.T + self.damping**2 * np.eye(len(e))
        return servobench.Command(self.rate * J.T @ np.linalg.solve(damped, e))


def build(aids=EQUIPPED):
    """Return the user's controller, and a driver of it with aids on the rig."""
    entry = CONTROLLER.make_entry(type("Own", (Inverse,), {"aids": aids}), "own.py")
    rig = Rig(6, 3)
    controller = entry.build(entry.config(), rig.knowledge())
    return controller.law.own, Driver(controller, rig).begin()


@pytest.mark.parametrize(("task", "sensing"), [("random", "position"), ("circle", "pixel:hand")])
def test_a_law_written_as_a_controller_moves_the_arm_as_the_same_law_as_a_part_does(task, sensing):
    aids = {"aids": dict(EQUIPPED), "law": {"proportional_gain": GAIN, "damping": DAMPING}}
    where = {"task": task, "sensing": sensing, "seed": 3}
    short = {
        task: {"duration": 2.5} if task == "random" else {"lap_time": 2.0, "laps": 1, "radius": 0.1}
    }
    own = servobench.run(Inverse, settings=short, **where)
    part = servobench.run("pid+constant", settings={"pid+constant": aids} | short, **where)
    assert own.row["status"] == "completed"
    columns = [name for name in own.steps if name.startswith("joint_velocity_command")]
    np.testing.assert_allclose(own.steps[columns], part.steps[columns], atol=1e-8)


def test_it_gets_the_seed_and_one_row_of_the_reference_if_the_chain_feeds_forward():
    for aids, preview in ((EQUIPPED, 0), ({**EQUIPPED, "feedforward": False}, 10)):
        own, driver = build(aids)
        driver.seed = 7
        driver.begin().run(3)
        assert (own.rows, own.knowledge.preview, own.resets[-1]) == (1 + preview, preview, 7)


def test_the_jacobian_is_the_nominal_one_before_a_run_and_a_better_one_in_its_steps():
    own, driver = build()
    rig = driver.rig
    for _ in range(2):
        given = own.knowledge.nominal_jacobian(rig.start)
        model = rig.model_jacobian(rig.start)
        np.testing.assert_array_equal(given, model)
        driver.run(40)
        found = own.J
        model = rig.model_jacobian(rig.q)
        true = rig.jacobian(rig.q)
        # The direction in which something could be learned
        moved = driver.rig.goal - driver.rig.start
        assert np.linalg.norm((found - true) @ moved) < 0.5 * np.linalg.norm((model - true) @ moved)
        driver.begin()


def test_its_settings_are_the_section_law_and_those_of_the_aids_can_be_set():
    entry = CONTROLLER.make_entry(Inverse, "own.py")
    section = {"law": {"gain": 3}, "aids": {"posture": False}}
    config = Settings({"Inverse": section}).resolve("Inverse", entry.config())
    assert config.law.gain == 3
    assert describe_aids(flatten(config)) == "with all aids but posture"
    with pytest.raises(
        ConfigurationError, match=r"Inverse has no setting 'gain': did you mean 'law.gain'"
    ):
        Settings({"Inverse": {"gain": 3}}).resolve("Inverse", entry.config())


@pytest.mark.parametrize(
    ("aids", "line"),
    [
        (True, "own.py: aids must be servobench.EQUIPPED or a mapping like it, got True"),
        (
            {"feedfoward": True},
            "own.py: Own.aids has no setting 'feedfoward': did you mean 'feedforward'",
        ),
        (
            {"limit": "cut"},
            "own.py: Own.aids.limit must be one of scale, clip, redistribute, got 'cut'",
        ),
    ],
)
def test_what_are_no_aids_is_refused_in_one_line(aids, line):
    with pytest.raises(ConfigurationError) as error:
        build(aids)
    assert str(error.value).startswith(line)


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({}, "without aids"),
        ({"gain": 2.0, "aids.delay": "ignored"}, "without aids"),
        ({f"aids.{name}": value for name, value in EQUIPPED.items()}, "with all aids"),
        ({"aids.posture": True, "aids.damping": 0.1}, "with the aids posture alone"),
    ],
)
def test_settings_say_which_aids_a_controller_has(values, words):
    assert describe_aids(values) == words


def test_the_equipment_that_all_share_cannot_be_changed():
    for change in (
        lambda: servobench.EQUIPPED.__setitem__("posture", False),
        lambda: servobench.EQUIPPED.update({}),
    ):
        with pytest.raises(TypeError, match="servobench.EQUIPPED is shared; change a copy"):
            change()
    assert pickle.loads(pickle.dumps(EQUIPPED)) == copy.deepcopy(EQUIPPED) == {**EQUIPPED}
