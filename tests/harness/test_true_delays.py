"""The true delays of a plant go to controllers that ask for the truth, and to no other."""

from __future__ import annotations

import pytest

from servobench.controllers.controller import ControllerEntry, Delays
from servobench.harness.config.entries import CONTROLLER, own_object
from servobench.harness.config.registry import find_controller, offering
from servobench.harness.config.settings import Settings
from servobench.harness.run.experiment import build_experiment
from servobench.harness.run.request import RunRequest

LATE = {"command_delay": 0.02, "lag": 0.03, "sensing": {"latency": 0.1}}


def knowledge_of(plant, needs_truth, settings, **request):
    """Return what a controller on a plant is given."""
    seen, constant = [], find_controller("constant")

    def build(config, knowledge):
        seen.append(knowledge)
        return constant.build(config, knowledge)

    with offering([own_object(CONTROLLER, ControllerEntry("spy", "", constant.config, build, needs_truth))]):
        run = RunRequest(plant, "spy", "exp1", "moderate", 0, request)
        build_experiment(run, Settings({plant: settings})).plant.close()
    return seen[0]


@pytest.mark.parametrize("plant", ["kinematic", "fmu"])
def test_a_bound_knows_the_delays_of_its_plant(plant):
    assert knowledge_of(plant, True, LATE).true_delays == Delays(0.1, 0.02, 0.03)
    assert knowledge_of(plant, True, LATE, latency=0.2, period=0.02).true_delays == Delays(0.2, 0.02, 0.03)


def test_a_competitor_does_not():
    assert knowledge_of("kinematic", False, LATE).true_delays is None


@pytest.mark.parametrize(("period", "rows"), [(0.1, 5), (0.05, 10), (0.02, 25), (0.008, 63), (0.004, 125)])
def test_the_preview_is_as_long_at_every_rate(period, rows):
    assert knowledge_of("kinematic", False, {}, period=period).preview == rows
