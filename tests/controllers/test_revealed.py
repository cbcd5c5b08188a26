"""The bound of learning: two methods one after the other, of which the second one knows what the first one sent."""

import numpy as np
import pytest

from servobench.controllers.controller import Delays, RobotKnowledge
from servobench.controllers.revealed import Revealed, RevealedConfig
from servobench.harness.config.settings import Settings
from servobench.harness.run.episode import carry_out
from servobench.harness.run.experiment import build
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.plant.contract.signals import Observation, PlantSpec

PERIOD = 0.05


def run(controller, reveal_time=None):
    settings = {"random": {"duration": 1.5}}
    if reveal_time is not None:
        settings["revealed"] = {"reveal_time": reveal_time}
    request = RunRequest("kinematic", controller, "random", "moderate+joint_offsets=180deg", 3)
    return carry_out(resolve(request, Settings(settings)))


def commands(result):
    return result.steps.filter(like="joint_velocity_command_").to_numpy()


def test_told_from_the_start_it_is_the_reference_bit_for_bit():
    found, reference = run("revealed", 0.0), run("calibrated")
    assert commands(found).tolist() == commands(reference).tolist()
    assert found.row["settling_time_s"] == reference.row["settling_time_s"]


def test_never_told_it_is_the_method_that_learns():
    assert commands(run("revealed", 9.0)).tolist() == commands(run("regression_mfac")).tolist()


@pytest.mark.parametrize("reveal_time", [0.1, 0.2])
def test_it_changes_from_the_one_to_the_other_at_the_reveal_time(reveal_time):
    found = run("revealed", reveal_time)
    before = round(reveal_time / PERIOD)
    assert commands(found)[:before].tolist() == commands(run("regression_mfac"))[:before].tolist()
    error = found.steps["jacobian_error"].to_numpy()
    assert (error[:before] > 1.0).all()
    assert (error[before:] < 1e-12).all()


def test_the_method_that_knows_counts_the_commands_that_were_sent_and_not_its_own():
    resolved = resolve(RunRequest("kinematic", "revealed", "random", "severe", 0), Settings({}))
    experiment = build(resolved)
    controller, plant = experiment.controller, experiment.plant
    seen = plant.reset(0)
    controller.reset(seen, 0)
    sent = []
    for k in range(6):
        rows = experiment.desired()[k : k + 11]
        command = controller.step(seen, rows)
        sent.append(PERIOD * command.joint_velocity)
        seen = plant.step(command)
    known = controller._knowing.state.predictor.response.commands
    np.testing.assert_allclose(known[:6], sent[::-1], rtol=1e-12)
    saved = controller.save()
    after = controller.step(seen, experiment.desired()[6:17]).joint_velocity
    controller.restore(saved)
    assert (
        controller.step(seen, experiment.desired()[6:17]).joint_velocity.tolist() == after.tolist()
    )


def test_before_it_is_told_nothing_of_the_truth_is_used():
    """Another truth changes no command before the reveal time."""
    spec = PlantSpec.of_joints(("a", "b"), ("x", "y"), np.ones(2), -np.ones(2), np.ones(2), PERIOD)
    seen = Observation(0.0, [0.0, 0.0], [0.0, 0.0])
    wanted = np.array([[0.1, 0.2]] * 2)
    found = []
    for factor in (1.0, -3.0):
        knowledge = RobotKnowledge(
            spec,
            1,
            nominal_jacobian=lambda q: np.broadcast_to(np.eye(2), (*q.shape[:-1], 2, 2)),
            true_jacobian=lambda q, factor=factor: factor * np.eye(2),
            true_delays=Delays(0.1 * abs(factor), 0.05, 0.05),
            region=(-np.ones(2), np.ones(2)),
        )
        controller = Revealed(RevealedConfig(), knowledge)
        controller.reset(seen, 0)
        found.append(controller.step(seen, wanted).joint_velocity.tolist())
    assert found[0] == found[1]
