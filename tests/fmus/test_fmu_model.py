"""The exported UR5 as a model: agreement with numpy and fmpy, derivatives, saved states, reset, refusals."""

import ctypes
import pickle
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from kit.plants import configure, mismatched, setup
from servobench.fmus.ur5_plant import ENTRY, Ur5FmuConfig, cached_fmu
from servobench.fmus.variables import parameters_of
from servobench.plant.contract.faults import FmuError
from servobench.plant.contract.signals import Command
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.description import read_description
from servobench.plant.fmu.instance import Port
from servobench.plant.fmu.instances import open_instance
from servobench.plant.kinematic import ENTRY as KINEMATIC
from servobench.plant.kinematic import KinematicConfig, build_kinematic

VERSIONS = [2, 3]


class Opened:
    """An instance of the exported FMU, for calls below the plant."""

    def __init__(self, version: int, start: bool = True, log: Path | None = None) -> None:
        path = cached_fmu(version)
        self.description = read_description(path, extract_fmu(path))
        self.instance = open_instance(self.description, None, log)
        if start:
            self.instance.start(0.0)

    def port(self, *names: str) -> Port:
        return Port(self.description.select(names, "test"))

    def get(self, *names: str):
        port = self.port(*names)
        self.instance.reader(port)()
        return port.values

    def set(self, name: str, values) -> None:
        port = self.port(name)
        port.values[:] = values
        self.instance.writer(port)()

    def derivative(self, unknown: str, known: str):
        knowns, unknowns = self.port(known), self.port(unknown)
        columns = []
        for k in range(knowns.values.size):
            knowns.values[:] = np.eye(knowns.values.size)[k]
            ports = knowns, unknowns
            buffers = [
                place
                for port in ports
                for place in self.instance._buffer(port.pointer(), port.values.size)
            ]
            places = *unknowns.variables, *knowns.variables, *buffers
            self.instance.call("GetDirectionalDerivative", *places)
            columns.append(unknowns.values.copy())
        return np.column_stack(columns)

    def __enter__(self):
        return self

    def __exit__(self, *_) -> None:
        self.instance.close()


@pytest.mark.parametrize(("version", "mismatch"), [(2, "severe"), (3, "factory")])
def test_the_fmu_agrees_with_the_kinematic_plant_over_five_hundred_random_steps(version, mismatch):
    common = {"feature_noise": 0.002, "latency": 0.05, "drop_probability": 0.1, "joint_range": 2.9}
    plant = ENTRY.build(
        configure(Ur5FmuConfig, fmi_version=version, max_joint_speed=2.0, **common), setup(mismatch)
    )
    oracle = build_kinematic(
        configure(KinematicConfig, max_joint_speed=2.0, **common), setup(mismatch)
    )
    assert plant.spec.joint_names == oracle.spec.joint_names
    generator, stops = np.random.default_rng(1), 0
    pairs = [(plant.reset(7), oracle.reset(7))]
    for k in range(500):
        command = Command(generator.uniform(-3.0, 3.0, 6))
        pairs.append((plant.step(command), oracle.step(command)))
        stops += np.count_nonzero(np.abs(pairs[-1][1].joint_position) == 2.9)
        if k % 20 == 0:
            np.testing.assert_allclose(
                plant.truth().jacobian, oracle.truth().jacobian, rtol=0, atol=1e-9
            )
            np.testing.assert_allclose(
                plant.truth().feature, oracle.truth().feature, rtol=0, atol=1e-9
            )
    for name in ("time", "joint_position", "feature", "feature_valid"):
        came, wanted = (
            np.array([getattr(pair[side], name) for pair in pairs], dtype=float) for side in (0, 1)
        )
        np.testing.assert_allclose(came, wanted, rtol=0, atol=1e-9, err_msg=name)
    assert stops > 0
    plant.close()


def test_each_joint_may_have_a_lag_of_its_own():
    lags, quiet = (0.0, 0.02, 0.05, 0.1, 0.2, 1.0), {"feature_noise": 0.0, "command_delay": 0.0}
    plant = ENTRY.build(configure(Ur5FmuConfig, joint_lags=lags, **quiet), setup())
    oracles = [
        KINEMATIC.build(configure(KinematicConfig, lag=lag, **quiet), setup()) for lag in lags
    ]
    for each in (plant, *oracles):
        each.reset(0)
    for _ in range(20):
        command = Command(np.full(6, 0.7))
        wanted = [oracle.step(command).joint_position[i] for i, oracle in enumerate(oracles)]
        np.testing.assert_allclose(plant.step(command).joint_position, wanted, rtol=0, atol=1e-9)
    plant.close()
    with pytest.raises(ValueError, match="joint_lags must have 6 numbers or none, got 2"):
        ENTRY.build(Ur5FmuConfig(joint_lags=(0.1, 0.2)), setup())


@pytest.mark.parametrize("version", VERSIONS)
def test_encoders_round_the_joint_position_to_their_steps(version):
    steps = np.array([0.0, 1e-3, 1e-2, 0.1, 4.8e-5, 1.0])
    with Opened(version) as opened:
        opened.set("joint_velocity_command", np.linspace(-0.9, 0.9, 6))
        opened.instance.stepper(0.5)(0.0)
        q = opened.get("joint_position").copy()
        np.testing.assert_array_equal(opened.get("encoder_position"), q)
        opened.set("encoder_resolution", steps)
        expected = np.where(steps > 0, np.round(q / np.maximum(steps, 1e-9)) * steps, q)
        np.testing.assert_array_equal(opened.get("encoder_position"), expected)
        np.testing.assert_array_equal(opened.get("joint_position"), q)
        with pytest.raises(FmuError):
            opened.set("encoder_resolution", -1.0)


def test_the_plant_reports_encoder_steps_and_judges_by_exact_positions():
    config = configure(Ur5FmuConfig, feature_noise=0.0)
    coarse, exact = (
        ENTRY.build(replace(config, encoder_resolution=size), setup()) for size in (1e-2, 0.0)
    )
    coarse.reset(0), exact.reset(0)
    for _ in range(5):
        came, wanted = (plant.step(Command(np.full(6, 0.37))) for plant in (coarse, exact))
        expected = np.round(wanted.joint_position / 1e-2) * 1e-2
        np.testing.assert_allclose(came.joint_position, expected, rtol=0, atol=1e-12)
        np.testing.assert_array_equal(came.feature, wanted.feature)
        np.testing.assert_array_equal(coarse.truth().jacobian, exact.truth().jacobian)
    coarse.close(), exact.close()


@pytest.mark.parametrize("version", VERSIONS)
def test_many_small_steps_end_where_one_large_step_ends(version):
    with Opened(version) as once, Opened(version) as often:
        for each in (once, often):
            each.set("joint_velocity_command", np.linspace(-0.9, 0.9, 6))
        once.instance.stepper(0.5)(0.0)
        advance = often.instance.stepper(0.005)
        for k in range(100):
            advance(k * 0.005)
        np.testing.assert_allclose(
            often.get("joint_position", "joint_velocity"),
            once.get("joint_position", "joint_velocity"),
            atol=1e-12,
        )


@pytest.mark.parametrize("version", VERSIONS)
def test_directional_derivatives_equal_the_numpy_jacobian_and_differences(version):
    model = mismatched("severe")
    with Opened(version, start=False) as opened:
        for name, values in parameters_of(setup("severe"), KinematicConfig()).items():
            opened.set(name, values)
        opened.instance.start(0.0)
        opened.set("joint_velocity_command", [0.5, 2.0, -2.0, 0.1, 0.0, -0.3])
        opened.instance.stepper(0.3)(0.0)
        q = opened.get("joint_position")
        ball = opened.derivative("ball_position", "joint_position")
        np.testing.assert_allclose(ball, model.jacobian(q), rtol=0, atol=1e-9)
        np.testing.assert_allclose(
            opened.get("jacobian").reshape(3, 6), model.jacobian(q), rtol=0, atol=1e-9
        )
        hessian = opened.derivative("jacobian", "joint_position")
        step = 1e-6 * np.eye(6)
        differences = [(model.jacobian(q + d) - model.jacobian(q - d)).ravel() / 2e-6 for d in step]
        np.testing.assert_allclose(hessian, np.column_stack(differences), atol=1e-8)
        # Two are clipped
        lag = np.diag(1.0 / KinematicConfig().lag * np.array([1.0, 0.0, 0.0, 1.0, 1.0, 1.0]))
        np.testing.assert_allclose(
            opened.derivative("der(joint_velocity)", "joint_velocity_command"), lag
        )
        np.testing.assert_allclose(
            opened.derivative("der(joint_position)", "joint_velocity"), np.eye(6)
        )


def assert_derivative(opened, unknown, known, **tolerances):
    """Compare a directional derivative with differences."""
    value, came = opened.get(known).copy(), opened.derivative(unknown, known)
    for k, step in enumerate(1e-6 * np.eye(value.size)):
        ends = []
        for sign in (1.0, -1.0):
            opened.set(known, value + sign * step)
            ends.append(opened.get(unknown).copy())
        opened.set(known, value)
        message = f"{unknown} by {known}"
        np.testing.assert_allclose(
            came[:, k], (ends[0] - ends[1]) / 2e-6, err_msg=message, **tolerances
        )


@pytest.mark.parametrize(
    "parameter",
    ["a", "alpha", "pitch", "joint_offset", "gear_ratio", "tool", "camera_rpy", "base_rpy"],
)
def test_derivatives_by_parameters_equal_differences(parameter):
    with Opened(2) as opened:
        assert_derivative(opened, "ball_position", parameter, atol=1e-8)


@pytest.mark.parametrize(
    "known",
    [
        "a",
        "gear_ratio",
        "joint_velocity_command",
        "ripple",
        "ripple_order",
        "tool_frequency",
        "tool_damping",
    ],
)
def test_derivatives_by_parameters_of_gears_and_tool_equal_differences(known):
    play = 0.0 if "ripple" in known else 0.02  # a gear that comes back leaves the joint where it is
    values = {
        "backlash": np.full(6, play),
        "ripple": np.full(6, 0.03),
        "ripple_order": np.full(6, 7.0),
    }
    values |= {"tool_frequency": np.array([12.0]), "tool_damping": np.array([0.05])}
    commands = np.array([0.5, -0.4, 0.3, 0.1, -0.2, 0.3])
    with Opened(2, start=False) as opened:
        for name, value in values.items():
            opened.set(name, value)
        opened.instance.start(0.0)
        opened.set("joint_velocity_command", commands)
        opened.instance.stepper(0.3)(0.0)
        for unknown in ("ball_position", "jacobian", "der(tool_deflection)", "der(tool_velocity)"):
            assert_derivative(opened, unknown, known, rtol=1e-6, atol=1e-7)


def run(plant, count: int, seed: int) -> list[bytes]:
    generator = np.random.default_rng(seed)
    rows = [plant.step(Command(generator.uniform(-1.0, 1.0, 6))) for _ in range(count)]
    return [row.joint_position.tobytes() + row.feature.tobytes() for row in rows]


CONTINUE = """
import pickle, sys
import numpy as np
from servobench.fmus.ur5_plant import ENTRY, Ur5FmuConfig
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.signals import Command
version, setup, state = pickle.load(sys.stdin.buffer)
sensing = SensingConfig(latency=0.1, drop_probability=0.1)
plant = ENTRY.build(Ur5FmuConfig(fmi_version=version, sensing=sensing), setup)
plant.restore(state)
generator = np.random.default_rng(2)
rows = [plant.step(Command(generator.uniform(-1.0, 1.0, 6))) for _ in range(30)]
sys.stdout.buffer.write(b"".join(row.joint_position.tobytes() + row.feature.tobytes() for row in rows))
plant.close()
"""


@pytest.mark.parametrize("version", VERSIONS)
def test_a_restored_state_gives_the_same_bits_here_and_in_another_process(version):
    config = configure(Ur5FmuConfig, fmi_version=version, latency=0.1, drop_probability=0.1)
    plant = ENTRY.build(config, setup("severe"))
    plant.reset(4)
    run(plant, 20, 1)
    state = plant.save()
    wanted = run(plant, 30, 2)
    for _ in range(2):
        plant.restore(state)
        assert run(plant, 30, 2) == wanted
    plant.close()
    task = pickle.dumps((version, setup("severe"), state))
    done = subprocess.run(
        [sys.executable, "-c", CONTINUE], input=task, capture_output=True, check=True
    )
    assert done.stdout == b"".join(wanted)


@pytest.mark.parametrize("version", VERSIONS)
def test_bytes_that_are_no_state_of_this_model_are_refused(version):
    plant = ENTRY.build(Ur5FmuConfig(fmi_version=version), setup())
    plant.reset(0)
    state = plant.save()
    (saved,) = state.world.fmu
    for content in (saved[:-1], b"x" * len(saved)):
        with pytest.raises(FmuError, match="these bytes are no state of this model"):
            plant.restore(state._replace(world=state.world._replace(fmu=(content,))))
    plant.close()


@pytest.mark.parametrize("version", VERSIONS)
def test_the_fmu_refuses_what_makes_no_sense(version):
    with Opened(version) as opened:
        with pytest.raises(FmuError, match="not finite or below the variable's minimum"):
            opened.set("lag", -1.0)
        with pytest.raises(FmuError, match="not finite"):
            opened.set("joint_velocity_command", np.nan)
        with pytest.raises(FmuError, match="computed by the model and cannot be set"):
            opened.set("ball_position", 0.0)
        with pytest.raises(FmuError, match="step size is negative"):
            opened.instance.stepper(-0.1)(0.0)
        with pytest.raises(FmuError, match="communication point is not where the last step ended"):
            opened.instance.stepper(0.1)(1.0)
        with pytest.raises(FmuError, match="not allowed in this phase"):
            opened.instance.start(0.0)
    with Opened(version, start=False) as opened:
        opened.set("joint_lower", 10.0)
        with pytest.raises(FmuError, match="joint_lower is not below joint_upper"):
            opened.instance.start(0.0)
    for name, value in (("tool_frequency", 1e-4), ("tool_frequency", 1e160), ("tool_damping", 1.0)):
        with Opened(version) as opened:
            opened.set(name, value)
            with pytest.raises(FmuError, match=f"{name} is n"):
                opened.instance.stepper(0.05)(0.0)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_tool_made_rigid_or_flexible_within_a_run_is_where_a_rigid_one_is(version):
    with Opened(version) as opened:
        advance = opened.instance.stepper(0.05)
        opened.set("joint_velocity_command", 0.3)
        for k in range(10):
            advance(k * 0.05)
        opened.set("tool_frequency", 30.0)
        advance(0.5)  # at a constant speed, which the tool has already
        speed = np.linalg.norm(opened.get("tool_velocity"))
        assert speed > 0.1
        assert np.linalg.norm(opened.get("tool_deflection")) < 0.1 * speed / 30.0
        opened.set("joint_velocity_command", -0.3)
        advance(0.55)
        assert np.linalg.norm(opened.get("tool_deflection")) > 1e-3
        opened.set("tool_frequency", 0.0)
        advance(0.6)
        assert not opened.get("tool_deflection", "tool_velocity").any()


@pytest.mark.parametrize("version", VERSIONS)
def test_only_the_categories_of_the_last_call_are_logged(version, tmp_path):
    with Opened(version, log=tmp_path / "log") as opened:
        opened.set("joint_lower", opened.get("joint_position") - 0.01)
        advance, flag = (
            opened.instance.stepper(0.05),
            ctypes.c_int if version == 2 else ctypes.c_bool,
        )
        found = []
        for k, (on, category) in enumerate(
            [(1, b"logStatusWarning"), (1, b"logEvents"), (0, b"logStatusWarning")]
        ):
            opened.instance.call(
                "SetDebugLogging", flag(on), ctypes.c_size_t(1), (ctypes.c_char_p * 1)(category)
            )
            opened.set("joint_velocity_command", -1.0 if k < 2 else 1.0)
            advance(k * 0.05)
            found.append((tmp_path / "log").read_text())
    assert ["is held" in text for text in found] == [False, True, True]
    assert found[2] == found[1]


@pytest.mark.parametrize("version", VERSIONS)
def test_memory_stays_flat_over_a_thousand_instances(version):
    """Load, instantiate, run, save, restore, serialise, free and unload; whole plants live in test_fmu_plant."""
    with Opened(version) as opened:
        process = psutil.Process()
        files = process.num_fds()

        def live(count: int) -> None:
            for _ in range(count):
                instance = open_instance(opened.description)
                instance.start(0.0)
                advance = instance.stepper(0.05)
                advance(0.0)
                state = instance.save_bytes()
                advance(0.05)
                instance.restore_bytes(state)
                instance.close()

        live(500)  # until the allocator has what it needs
        before = process.memory_info().rss
        live(1000)
        # One lost state an instance would be 1.2e6
        assert process.memory_info().rss - before < 0.6e6
        assert process.num_fds() == files
