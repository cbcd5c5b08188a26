"""The FMU plant: a foreign FMU in a closed loop, what may be wrong with one, and what must not be left behind."""

import ctypes
import zipfile
from dataclasses import replace
from pathlib import Path

import numpy as np
import psutil
import pytest

from kit.foreign_fmu import ROLES, build_crane, describe_with, mapping
from kit.plants import nominal_ur5
from servobench.fmus.compiler import this_platform
from servobench.fmus.ur5_plant import Ur5FmuConfig, build_ur5
from servobench.plant.bench.bench import Bench
from servobench.plant.bench.plant import PlantSetup
from servobench.plant.contract.cache import cache_folder
from servobench.plant.contract.faults import FmuError
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.signals import Command
from servobench.plant.fmu.archive import extract_fmu
from servobench.plant.fmu.mapping import FmuMapping, JointLimits, LogNames, TruthMapping
from servobench.plant.fmu.world import FmuConfig, FmuWorld, fmu_entry
from servobench.plant.robot.ur5 import HOME

QUIET = FmuConfig(0.0, SensingConfig(0.0))
START = np.array([0.3, 1.2])
PERIOD = 0.05
ARMS = {
    2: 'parameters = {"arm.slew" = 0.6, "arm.luff" = 0.3}\n',
    3: "parameters = {arm = [0.6, 0.3]}\n",
}
TOML = """
period = 0.01
limits = {max_joint_speed = 2.0}
names = {joints = ["slew", "luff"], features = ["x", "y"]}
"""


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch) -> Path:
    """The folder below which FMUs are extracted, empty for each test."""
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "cache"))
    return cache_folder("extracted")


def crane(tmp_path: Path, version: int, config: FmuConfig = QUIET, **changes) -> Bench:
    path = build_crane(tmp_path / "crane.fmu", version)
    arguments = {"file": path, "limits": JointLimits(2.0), **ROLES[version], **changes}
    plant = Bench(
        FmuWorld(FmuMapping(**arguments), START, PERIOD), config.command_delay, config.sensing
    )
    plant.reset(0)
    return plant


def place_of(q, arm=(0.5, 0.4)):
    reach = arm[0] * np.exp(1j * q[0]) + arm[1] * np.exp(1j * (q[0] + q[1]))
    return np.array([reach.real, reach.imag])


@pytest.mark.parametrize("version", [2, 3])
def test_a_loop_closes_on_a_foreign_fmu_through_a_mapping_alone(tmp_path, version):
    build_crane(tmp_path / "crane.fmu", version)
    (tmp_path / "crane.toml").write_text(mapping(version) + ARMS[version] + TOML)
    entry = fmu_entry(tmp_path / "crane.toml")
    plant = entry.build(QUIET, PlantSetup(nominal_ur5(), START, PERIOD))
    assert plant.spec.joint_names == ("slew", "luff")
    assert plant.spec.feature_names == ("x", "y")
    observation, target = plant.reset(0), np.array([0.2, 0.7])
    np.testing.assert_allclose(observation.feature, place_of(START, (0.6, 0.3)), atol=1e-15)
    for _ in range(120):
        q = observation.joint_position
        columns = [
            (place_of(q + d, (0.6, 0.3)) - place_of(q - d, (0.6, 0.3))) / 2e-6
            for d in 1e-6 * np.eye(2)
        ]
        u = 2.0 * np.linalg.solve(np.column_stack(columns), target - observation.feature)
        observation = plant.step(Command(u))
    assert np.linalg.norm(observation.feature - target) < 1e-4
    assert plant.truth().jacobian is None
    plant.close()


@pytest.mark.parametrize("version", [2, 3])
def test_commands_are_clipped_delayed_and_held_over_the_fmus_own_steps(tmp_path, version):
    plant = crane(tmp_path, version, FmuConfig(PERIOD, SensingConfig(0.0)), period=0.01)
    plant.reset(0)
    assert plant.step(Command([9.0, -1.0])).joint_position.tolist() == START.tolist()
    observation = plant.step(Command([0.0, 0.0]))
    np.testing.assert_allclose(
        observation.joint_position, START + PERIOD * np.array([2.0, -1.0]), atol=1e-14
    )
    assert observation.time == 2 * PERIOD
    plant.close()


def test_without_joints_the_commands_are_integrated(tmp_path):
    plant = crane(tmp_path, 2, joints=())
    for _ in range(3):
        observation = plant.step(Command([1.0, -3.0]))
    np.testing.assert_allclose(
        observation.joint_position, START + 3 * PERIOD * np.array([1.0, -2.0]), atol=1e-14
    )
    plant.close()


@pytest.mark.parametrize("quirk", [3.0, 8.0])
@pytest.mark.parametrize("version", [2, 3])
def test_a_step_that_ends_early_is_taken_up_where_it_ended_however_often(tmp_path, version, quirk):
    plant = crane(tmp_path, version, parameters={"quirk": np.array(quirk)})
    for k in (1, 2):
        observation = plant.step(Command([1.0, 0.5]))
        np.testing.assert_allclose(
            observation.joint_position, START + k * PERIOD * np.array([1.0, 0.5]), atol=1e-12
        )
    plant.close()


@pytest.mark.parametrize("version", [2, 3])
def test_a_failed_step_is_an_fmu_error_with_the_fmus_last_message(tmp_path, version, caplog):
    plant = crane(tmp_path, version, parameters={"quirk": np.array(1.0)})
    with pytest.raises(FmuError, match="load 900 kg is too heavy at noon"):
        plant.step(Command([0.0, 0.0]))
    assert "load 900 kg" in caplog.text
    assert FmuError.status == "fmu_error"
    plant.close()


@pytest.mark.parametrize(
    ("version", "quirk", "message"),
    [
        (2, 2, "not finite for place.luff"),
        (3, 2, r"not finite for place\[2\]"),
        (2, 4, "fmi2DoStep returned discard"),
        (3, 4, "returned early at 0 s"),
        (2, 5, "fmi2EnterInitializationMode returned error"),
        (3, 5, "fmi3EnterInitializationMode returned error"),
        (3, 6, "asked to end the simulation"),
    ],
)
def test_misbehaviour_at_run_time_is_an_fmu_error(tmp_path, version, quirk, message):
    with pytest.raises(FmuError, match=message):
        crane(tmp_path, version, parameters={"quirk": np.array(float(quirk))}).step(
            Command([0.0, 0.0])
        )


@pytest.mark.parametrize(
    ("quirk", "message"), [(1.0, "DoStep returned error"), (7.0, "not finite for place")]
)
@pytest.mark.parametrize("version", [2, 3])
def test_an_instance_that_fails_does_not_disturb_those_beside_it(tmp_path, version, quirk, message):
    starts, commands = (
        np.array([[0.3, 1.2], [0.1, 0.9], [-0.4, 1.5]]),
        np.random.default_rng(0).normal(size=(9, 3, 2)),
    )
    path = build_crane(tmp_path / "crane.fmu", version)

    def seen_alone(lane):
        plant = Bench(
            FmuWorld(FmuMapping(path, **ROLES[version]), starts[lane], PERIOD),
            0,
            SensingConfig(0.0),
        )
        plant.reset(0)
        seen = [plant.step(Command(u)) for u in commands[:, lane]]
        plant.close()
        return [(each.joint_position.tobytes(), each.feature.tobytes()) for each in seen]

    alone = [seen_alone(lane) for lane in range(3)]
    crane_mapping = FmuMapping(
        path, **ROLES[version], parameters={"quirk": np.array([[0.0], [quirk], [0.0]])}
    )
    plant = Bench(FmuWorld(crane_mapping, starts, PERIOD), 0, SensingConfig(0.0))
    plant.reset([0, 0, 0])
    lanes = np.arange(3)
    for k, u in enumerate(commands):
        seen = plant.step(Command(u[lanes]))
        assert np.isfinite(seen.feature).all()
        for place, lane in enumerate(lanes):
            if place not in plant.faults:
                assert (
                    seen.joint_position[place].tobytes(),
                    seen.feature[place].tobytes(),
                ) == alone[lane][k]
        if plant.faults and k > 6:  # it rests for a while before it is dropped
            (fault,) = plant.faults.values()
            assert (list(plant.faults), message in str(fault)) == ([1], True)
            plant.keep(np.array([2, 0]))
            lanes = np.array([2, 0])
            assert not plant.faults
    assert len(lanes) == 2
    plant.close()
    plant.close()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        (
            {"inputs": ("pusch.slew", "push.luff")},
            r"inputs names 'pusch.slew'.*did you mean 'push.slew'.*wheel.slew",
        ),
        ({"inputs": ("place.slew", "place.luff")}, "causality output"),
        (
            {"joints": ("wheel.slew",)},
            "joints must name 2 numbers for 2 inputs and 2 features, got 1",
        ),
        ({"truth": TruthMapping(jacobian=("arm.slew",))}, "truth.jacobian must name 4 numbers"),
        ({"home": "gear"}, "type Integer; wanted a real variable"),
        (
            {"parameters": {"arm.slew": np.array([1.0, 2.0])}},
            "parameter 'arm.slew' must have 1 values, got 2",
        ),
        (
            {"limits": JointLimits(2.0, np.array(0.5), np.array(1.0))},
            r"crane.fmu starts with joint_. out of the limits of its mapping, 0.5 to 1 rad, by",
        ),
        ({"names": LogNames(("slew",))}, "names.joints must hold 2 names, got 1"),
        ({"period": 0.03}, "whole multiple of the plant's own step of 0.03 s"),
        ({"inputs": ()}, "inputs must be of length 1 or more"),
        ({"period": 0.0}, "period must be above 0"),
    ],
)
def test_a_mapping_that_does_not_fit_is_one_clear_error(tmp_path, changes, message):
    with pytest.raises(ValueError, match=message):
        crane(tmp_path, 2, **changes)


def test_a_state_that_cannot_be_serialised_is_kept_by_the_plant_that_saved_it():
    plant = build_ur5(Ur5FmuConfig(), PlantSetup(nominal_ur5(), np.array(HOME), PERIOD))
    instance = plant.world._instances.lanes[0].instance
    instance.description = replace(instance.description, can_serialise=False)
    plant.reset(0)
    plant.step(Command(np.full(6, 0.3)))
    state = plant.save()
    runs = []
    for _ in range(2):
        plant.restore(state)
        runs.append([plant.step(Command(np.full(6, -0.5))).feature.tobytes() for _ in range(5)])
    assert runs[0] == runs[1]
    assert not isinstance(state.world.fmu[0], bytes)
    plant.close()


def test_an_fmu_that_cannot_save_its_state_says_so(tmp_path):
    plant = crane(tmp_path, 2)
    with pytest.raises(ValueError, match="cannot save its state"):
        plant.save()
    plant.close()


def test_a_closed_plant_may_be_closed_again_but_not_stepped(tmp_path):
    plant = crane(tmp_path, 2)
    plant.close()
    plant.close()
    with pytest.raises(FmuError, match="has been closed"):
        plant.step(Command([0.0, 0.0]))


@pytest.mark.parametrize(
    "name", ["../evil.txt", "/etc/evil.txt", "a\\..\\evil.txt", "c:evil.txt", "a/../../evil.txt"]
)
def test_an_archive_that_climbs_out_of_its_folder_is_refused(tmp_path, name):
    path = tmp_path / "evil.fmu"
    with zipfile.ZipFile(path, "w") as archive:
        archive.writestr("modelDescription.xml", "<x/>")
        archive.writestr(name, "evil")
    with pytest.raises(ValueError, match="would climb out"):
        extract_fmu(path)
    assert not list(tmp_path.rglob("evil.txt"))


def test_an_fmu_is_extracted_once_and_again_where_its_content_changes(tmp_path, cache):
    path = build_crane(tmp_path / "crane.fmu", 2)
    folder = extract_fmu(path)
    copy = tmp_path / "copy.fmu"
    copy.write_bytes(path.read_bytes())
    assert extract_fmu(path) == extract_fmu(copy) == folder
    assert [each for each in cache.iterdir() if each.is_dir()] == [folder.parent]
    build_crane(path, 3)
    changed = extract_fmu(path)
    assert changed != folder
    assert "3.0" in (changed / "modelDescription.xml").read_text()
    assert extract_fmu(copy) == folder


def test_a_second_plant_of_an_fmu_reads_neither_archive_nor_description(tmp_path, monkeypatch):
    path = build_crane(tmp_path / "crane.fmu", 2)
    first = FmuWorld(FmuMapping(path, **ROLES[2]), START, PERIOD)
    monkeypatch.setattr(zipfile, "ZipFile", None)
    monkeypatch.setattr("fmpy.read_model_description", None)
    second = FmuWorld(FmuMapping(path, **ROLES[2]), START, PERIOD)
    assert second.description is first.description
    first.close(), second.close()


@pytest.mark.parametrize("only_once", [False, True])
def test_an_fmu_that_bears_one_instance_a_process_gets_a_library_for_each(tmp_path, only_once):
    # The crane keeps its callbacks in a static variable, so in one library the second instance gets the messages.
    flag = f'canBeInstantiatedOnlyOncePerProcess="{str(only_once).lower()}"'
    description = describe_with(2, "<CoSimulation", f"<CoSimulation {flag}")
    path = build_crane(tmp_path / "crane.fmu", 2, description=description)
    crane_mapping = FmuMapping(path, **ROLES[2], parameters={"quirk": np.array(1.0)})
    first, second = FmuWorld(crane_mapping, START, PERIOD), FmuWorld(crane_mapping, START, PERIOD)
    with pytest.raises(FmuError) as caught:
        first.advance(np.zeros(2))
    assert ("too heavy at noon" in str(caught.value)) == only_once
    first.close(), second.close()


def test_what_cannot_be_extracted_leaves_nothing_behind(tmp_path, cache):
    path = build_crane(tmp_path / "crane.fmu", 2)
    content = bytearray(path.read_bytes())
    content[content.index(b"<?xml") + 20] ^= 0xFF
    path.write_bytes(content)
    with pytest.raises(ValueError, match="cannot be extracted"):
        extract_fmu(path)
    assert list(cache.iterdir()) == []


@pytest.mark.parametrize("version", [2, 3])
def test_memory_stays_flat_over_many_lives_of_a_plant(tmp_path, version):
    def live(count: int) -> None:
        for _ in range(count):
            plant = crane(tmp_path, version)
            plant.step(Command([0.1, 0.1]))
            plant.close()

    live(30)
    before = psutil.Process().memory_info().rss
    live(100)
    assert psutil.Process().memory_info().rss - before < 5e6


def counts(path: Path, version: int) -> tuple[int, int]:
    """Return how often the crane was terminated, and how often it was called after a fatal error."""
    folder = extract_fmu(path) / "binaries" / this_platform().folder(version)
    library = ctypes.CDLL(str(folder / f"crane{this_platform().suffix}"))
    return tuple(
        ctypes.c_int.in_dll(library, name).value for name in ("terminated", "called_after_fatal")
    )


@pytest.mark.parametrize("version", [2, 3])
def test_an_fmu_is_terminated_before_it_is_freed(tmp_path, version):
    before = counts(build_crane(tmp_path / "crane.fmu", version), version)[0]
    plant = crane(tmp_path, version)
    plant.step(Command([0.0, 0.0]))
    plant.close()
    plant.close()
    failed = crane(tmp_path, version, parameters={"quirk": np.array(1.0)})
    with pytest.raises(FmuError, match="DoStep returned error"):
        failed.step(Command([0.0, 0.0]))
    failed.close()  # after an error it may be freed only
    assert counts(tmp_path / "crane.fmu", version) == (before + 1, 0)


@pytest.mark.parametrize("version", [2, 3])
def test_nothing_of_an_fmu_is_called_after_a_fatal_error(tmp_path, version):
    path = build_crane(tmp_path / "crane.fmu", version)
    # Those beside it in a period are called before that is known
    quirks = np.array([[0.0], [0.0], [9.0]])
    crane_mapping = FmuMapping(path, **ROLES[version], parameters={"quirk": quirks})
    world = FmuWorld(crane_mapping, np.tile(START, (3, 1)), PERIOD)
    world.advance(np.zeros((3, 2)))
    world.advance(np.zeros((3, 2)))
    assert set(world.faults) == {0, 1, 2}
    assert "DoStep returned fatal" in str(world.faults[0])
    world.close()
    assert counts(path, version)[1] == 0
    again = crane(tmp_path, version)  # which loads the library once more
    again.step(Command([0.1, 0.1]))
    again.close()
    assert counts(path, version)[1] == 0
