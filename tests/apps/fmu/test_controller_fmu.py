"""Exported controllers in FMPy's hands: equal to the original over a run, saved, reset, in steps of other lengths."""

from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from itertools import product

import numpy as np
import pytest
from fmpy.validation import validate_fmu as validate_by_fmpy

from kit.controller_fmus import PERIODS, experiment, exported, inputs_of, periods
from kit.fmpy_instance import Driven
from kit.nightly import some
from servobench.fmus.controllers.branches import leaves_of
from servobench.harness.apps.fmu import products as controller_fmu
from servobench.harness.apps.fmu.inspection import validate_fmu
from servobench.harness.config.settings import Settings
from servobench.harness.run import compiled
from servobench.harness.run.request import RunRequest
from servobench.plant.contract.faults import ConfigurationError
from servobench.plant.contract.lanes import map_arrays

PERIOD, N, M = 0.05, 6, 3
METHODS = [
    "ukf_mfac:published", "rbf_pid:published", "rbfnn_mfac:published", "regression_mfac", "ukf_mfac", "rbfnn_mfac",
    "mfac+mckf", "pid+gmckf",
]  # fmt: skip
INPUTS = 0  # value reference of the first input


class Loaded(Driven):
    """A controller with all its inputs and all its outputs at once."""

    def __init__(self, name: str, version: int, time: float = 0.0) -> None:
        super().__init__(exported(name, version), version)
        self.outputs = self.references("joint_velocity_command")
        self.start(time)

    def set(self, values) -> None:
        self.write(values, "joint_position", "feature", "seen", "reference")

    def get(self) -> np.ndarray:
        return self.read(N, "joint_velocity_command")

    def answer(self, k: int, values) -> np.ndarray:
        self.set(values)
        self.step(k * PERIOD, PERIOD)
        return self.get()


@contextmanager
def loaded(name: str, version: int) -> Iterator[Loaded]:
    with Loaded(name, version) as controller:
        yield controller
        controller.fmu.terminate()


@cache
def original(name: str) -> tuple[np.ndarray, np.ndarray]:
    """Return inputs and commands of a run of the original."""
    run = experiment(name)
    try:
        rows = [
            (inputs_of(seen, reference), command.joint_velocity)
            for seen, reference, command in periods(run)
        ]
    finally:
        run.plant.close()
    inputs, commands = zip(*rows, strict=True)
    return np.array(inputs), np.array(commands)


@pytest.mark.parametrize(
    ("name", "version"),
    some(
        list(product(METHODS, (2, 3))),
        ("ukf_mfac:published", 2), ("rbf_pid:published", 3), ("rbfnn_mfac:published", 2), ("regression_mfac", 3),
        ("mfac+mckf", 3),
    ),
)  # fmt: skip
def test_an_exported_controller_equals_the_original_over_a_run(name, version):
    inputs, commands = original(name)
    assert (inputs[:, N + M] == 0.0).any()  # frames are lost
    with loaded(name, version) as controller:
        came = [controller.answer(k, values) for k, values in enumerate(inputs)]
    assert np.abs(commands).max() > 0.1
    np.testing.assert_allclose(came, commands, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("name", "version"),
    some(list(product(METHODS[:4], (2, 3))), ("ukf_mfac:published", 2), ("regression_mfac", 3)),
)
def test_fmpy_and_the_reference_run_find_no_problem(name, version):
    assert validate_by_fmpy(str(exported(name, version))) == []
    found = validate_fmu(exported(name, version))
    assert found.problems == ()
    assert found.deviation < 1e-9


@pytest.mark.parametrize("version", [2, 3])
def test_outputs_follow_inputs_at_once_and_hold_until_the_next_ones(version):
    inputs, commands = original("ukf_mfac:published")
    with loaded("ukf_mfac:published", version) as controller:
        assert not controller.get().any()
        for k in range(5):
            controller.set(inputs[(k + 1) % 5])
            controller.get()  # is tried and changes nothing
            controller.set(inputs[k])
            np.testing.assert_allclose(controller.get(), commands[k], rtol=0, atol=1e-12)
            controller.step(k * PERIOD, PERIOD)
            np.testing.assert_allclose(controller.get(), commands[k], rtol=0, atol=1e-12)


def test_short_steps_take_a_sample_a_period_and_a_long_one_takes_several():
    inputs, commands = original("ukf_mfac:published")
    with loaded("ukf_mfac:published", 2) as controller:
        for k in range(4):
            for part in range(5):
                controller.set(inputs[k] if part == 0 else inputs[(k + 2) % 4])
                controller.step(k * PERIOD + part * PERIOD / 5, PERIOD / 5)
                np.testing.assert_allclose(controller.get(), commands[k], rtol=0, atol=1e-12)
    with loaded("ukf_mfac:published", 2) as controller, loaded("ukf_mfac:published", 2) as other:
        for k in range(3):
            other.answer(k, inputs[0])
        controller.set(inputs[0])
        controller.step(0.0, 3 * PERIOD)
        np.testing.assert_allclose(controller.get(), other.get(), rtol=0, atol=1e-15)


@pytest.mark.parametrize(("first", "step"), [(1.7e9, PERIOD), (0.0, PERIOD * (1.0 - 5e-7))])
def test_time_that_is_a_sum_of_steps_misses_no_sample(first, step):
    inputs, commands = original("ukf_mfac:published")
    with Loaded("ukf_mfac:published", 2, first) as controller:
        time = first
        for values, command in zip(inputs, commands, strict=True):
            controller.set(values)
            # A time has 10 digits before s
            np.testing.assert_allclose(controller.get(), command, rtol=0, atol=1e-6)
            controller.step(time, step)
            time += step


@pytest.mark.parametrize("step", [1e6, 1e300])
def test_a_step_of_more_samples_than_one_waits_for_is_refused_and_changes_nothing(step):
    inputs, commands = original("ukf_mfac:published")
    with loaded("ukf_mfac:published", 2) as controller:
        np.testing.assert_allclose(controller.answer(0, inputs[0]), commands[0], rtol=0, atol=1e-12)
        with pytest.raises(Exception, match="fmi2DoStep failed"):
            controller.step(PERIOD, step)
        np.testing.assert_allclose(controller.answer(1, inputs[1]), commands[1], rtol=0, atol=1e-12)


@pytest.mark.parametrize("version", [2, 3])
def test_a_saved_state_goes_on_with_equal_bits_and_reset_begins_anew(version):
    inputs, _ = original("regression_mfac")
    with loaded("regression_mfac", version) as controller:
        fmu = controller.fmu
        save, restore = (
            (fmu.getFMUstate, fmu.setFMUstate)
            if version == 2
            else (fmu.getFMUState, fmu.setFMUState)
        )
        before = [controller.answer(k, inputs[k]) for k in range(30)]
        state = save()
        after = [controller.answer(k, inputs[k]) for k in range(30, PERIODS)]
        restore(state)
        np.testing.assert_array_equal(
            [controller.answer(k, inputs[k]) for k in range(30, PERIODS)], after
        )
        (fmu.freeFMUstate if version == 2 else fmu.freeFMUState)(state)
        fmu.reset()
        controller.start()
        np.testing.assert_array_equal([controller.answer(k, inputs[k]) for k in range(30)], before)


def test_inputs_that_are_not_finite_and_values_that_are_computed_are_refused():
    with loaded("ukf_mfac:published", 2) as controller:
        with pytest.raises(Exception, match="fmi2SetReal failed"):
            controller.fmu.setReal([INPUTS], [np.nan])
        with pytest.raises(Exception, match="fmi2SetReal failed"):
            controller.fmu.setReal(controller.outputs[:1], [0.0])


@pytest.mark.parametrize(
    ("begin", "fault", "growth"), [(0.0, 1e-6, 0.0), (5.0, 1e-6, 0.0), (0.0, 0.0, 1e-10)]
)
def test_an_export_that_would_not_equal_its_original_is_refused(monkeypatch, begin, fault, growth):
    recorded = compiled._step

    def faulty(servo, state, inputs):
        state, output = recorded(servo, state, inputs)
        grown = map_arrays(
            lambda each: each if each.dtype == np.bool_ else each * (1.0 + growth), state
        )
        return grown if growth else state, output + fault * (inputs["time"] >= begin)

    monkeypatch.setattr(compiled, "_step", faulty)
    with pytest.raises(
        ConfigurationError,
        match="over 5 periods it would differ from the original by .e-.., allowed",
    ):
        controller_fmu.controller_model(
            RunRequest("kinematic", "cfdl_mfac:published", "target", "none", 0), Settings()
        )


def test_a_network_that_magnifies_rounding_errors_equals_the_original_in_every_step():
    name, before, differences = "rbfnn_mfac:published", None, []
    model = controller_fmu.controller_model(
        RunRequest("kinematic", name, "target", "none", 0, sensing="plate"), Settings()
    )
    assert len(model.run["time"]) < PERIODS  # the run inside ends early
    run = experiment(name, "plate")
    for seen, reference, command in periods(run):
        if before is not None:
            _, output, _ = model.recorded.step(before, [seen.time, *inputs_of(seen, reference)])
            differences.append(np.abs(output[:N] - command.joint_velocity).max())
        before = np.hstack([*map(np.ravel, leaves_of(run.controller.save()))])
    assert max(differences) < 1e-9
