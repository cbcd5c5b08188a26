"""Parameters of every type, arrays whose sizes are set, results of single precision, and steps that an FMU can take."""

from pathlib import Path

import numpy as np
import pytest

from kit.foreign_fmu import ROLES, build_crane, describe_with
from servobench.harness.apps.fmu.inspection import read_information
from servobench.plant.fmu.mapping import FmuMapping, read_mapping
from servobench.plant.fmu.world import FmuWorld

START = np.array([0.3, 1.2])


def moved(path: Path, version: int, **changes) -> np.ndarray:
    """Return by how much the joints moved in a period, under (0.1, 0.2) rad/s, after a reset."""
    world = FmuWorld(FmuMapping(path, **{**ROLES[version], **changes}), None, 0.05)
    world.advance(np.array([1.0, 1.0]))
    start = world.reset(0)
    motion = world.advance(np.array([0.1, 0.2])) - start
    world.close()
    return motion


@pytest.mark.parametrize(
    ("version", "parameters", "factor"),
    [
        (2, {"gear": 3.0}, 3.0),
        (3, {"gear": -3.0}, -3.0),
        (2, {"on": np.array(False)}, 0.0),
        (3, {"on": np.array(False)}, 0.0),
        (2, {"mood": np.array("contrary")}, -1.0),
        (3, {"mood": np.array("contrary"), "gear": 2.0}, -2.0),
        (3, {"trim": 0.25}, 0.25),
    ],
)
def test_parameters_of_every_type_reach_the_fmu_before_every_run(
    tmp_path, version, parameters, factor
):
    path = build_crane(tmp_path / "crane.fmu", version)
    motion = moved(path, version, parameters=parameters)
    np.testing.assert_allclose(motion, factor * 0.05 * np.array([0.1, 0.2]), rtol=1e-9, atol=1e-15)


@pytest.mark.parametrize("on", [True, False])
def test_features_are_seen_where_an_fmu_says_true(tmp_path, on):
    path = build_crane(tmp_path / "crane.fmu", 2)
    world = FmuWorld(
        FmuMapping(path, **ROLES[2], seen=("on", "on"), parameters={"on": np.array(on)}), None, 0.05
    )
    assert world.visible().tolist() == [on, on]
    world.close()


def test_a_file_gives_truth_values_and_texts(tmp_path):
    build_crane(tmp_path / "crane.fmu", 3)
    text = 'file = "crane.fmu"\ninputs = "push"\nfeatures = "place"\n[parameters]\non = true\nmood = "x"\ngear = 2\n'
    (tmp_path / "crane.toml").write_text(text)
    parameters = read_mapping(FmuMapping, tmp_path / "crane.toml").parameters
    assert {name: value.tolist() for name, value in parameters.items()} == {
        "on": True,
        "mood": "x",
        "gear": 2.0,
    }


def test_results_of_single_precision_are_features(tmp_path):
    path = build_crane(tmp_path / "crane.fmu", 3)
    worlds = [
        FmuWorld(FmuMapping(path, **{**ROLES[3], "features": (name,)}), None, 0.05)
        for name in ("place", "shade")
    ]
    for world in worlds:
        world.advance(np.array([0.3, 0.4]))
    double, single = (world.see() for world in worlds)
    np.testing.assert_array_equal(single, double.astype(np.float32))
    for world in worlds:
        world.close()


def test_information_tells_sizes_that_parameters_give(tmp_path):
    path = build_crane(tmp_path / "crane.fmu", 3)
    shapes = {each.name: each.shape for each in read_information(path).description.modelVariables}
    assert (shapes["wheel"], shapes["probe"], shapes["gear"]) == ((2,), (1,), ())


def test_a_structural_parameter_gives_an_array_its_size(tmp_path):
    path = build_crane(tmp_path / "crane.fmu", 3)
    parameters = {"samples": np.array(4.0)}
    world = FmuWorld(
        FmuMapping(path, **{**ROLES[3], "features": ("probe",)}, parameters=parameters), None, 0.05
    )
    for _ in range(2):
        assert world.spec.m == 4
        np.testing.assert_allclose(np.diff(world.see()), 1.0)
        world.advance(np.array([0.1, 0.1]))
        world.reset(0)
    world.close()


def test_a_structural_parameter_that_leaves_no_feature_is_one_clear_line(tmp_path):
    path = build_crane(tmp_path / "crane.fmu", 3)
    with pytest.raises(
        ValueError, match="inputs and features must name at least one number each, got 2 and 0"
    ):
        moved(path, 3, features=("probe",), parameters={"samples": 0.0})


@pytest.mark.parametrize(
    ("version", "parameters", "message"),
    [
        (
            2,
            {"gear": 1.5},
            r"'gear' is of type Integer: wanted a whole number from -2147483648 to 2147483647, got 1.5",
        ),
        (
            3,
            {"gear": 200.0},
            r"'gear' is of type Int8: wanted a whole number from -128 to 127, got 200.0",
        ),
        (3, {"on": 1.0}, "'on' is of type Boolean: wanted true or false, got 1.0"),
        (3, {"mood": 1.0}, "'mood' is of type String: wanted text, got 1.0"),
        (2, {"quirk": np.array("heavy")}, "'quirk' is of type Real: wanted a number, got 'heavy'"),
        (3, {"samples": -1.0}, "'samples' is of type UInt64: wanted a whole number from 0 to"),
        (3, {"arm": np.array([1.0, 2.0, 3.0])}, "'arm' must have 2 values, got 3"),
        (
            2,
            {"wheel.slew": 1.0},
            "names 'wheel.slew', which takes no value; wanted a parameter or a start value",
        ),
    ],
)
def test_a_value_of_another_type_is_one_clear_line(tmp_path, version, parameters, message):
    path = build_crane(tmp_path / "crane.fmu", version)
    with pytest.raises(ValueError, match=f"parameters? {message}"):
        moved(path, version, parameters=parameters)


def test_a_structural_parameter_that_makes_an_array_too_large_is_one_clear_line(tmp_path):
    path = build_crane(tmp_path / "crane.fmu", 3)
    with pytest.raises(
        ValueError, match="the size of 'probe' must be a whole number up to 1,000,000, got 1000001"
    ):
        moved(path, 3, parameters={"samples": 1_000_001.0})


def test_a_step_that_the_fmu_cannot_take_names_the_remedy(tmp_path):
    fixed = describe_with(
        3, 'modelIdentifier="crane"', 'modelIdentifier="crane" fixedInternalStepSize="0.02"'
    )
    path = build_crane(tmp_path / "crane.fmu", 3, description=fixed)
    with pytest.raises(
        ValueError, match=r"multiples of 0.02 s only .* period must be one, got 0.05 s"
    ):
        moved(path, 3)
    world = FmuWorld(FmuMapping(path, **ROLES[3]), None, 0.04)
    world.close()


def test_an_fmu_that_needs_its_tool_says_so(tmp_path, caplog):
    tool = describe_with(
        2, 'modelIdentifier="crane"', 'modelIdentifier="crane" needsExecutionTool="true"'
    )
    path = build_crane(tmp_path / "crane.fmu", 2, description=tool)
    moved(path, 2)
    assert "crane.fmu calls the tool that made it" in caplog.text


@pytest.mark.parametrize("version", [2, 3])
def test_the_debug_log_of_an_fmu_is_on_where_a_file_is_named_and_it_gets_a_tolerance(
    version, tmp_path
):
    path, log = build_crane(tmp_path / "crane.fmu", version), tmp_path / "crane.log"
    moved(path, version)
    moved(path, version, debug_log=log)
    assert log.read_text().splitlines() == ["an instance of crane.fmu", "ok: crane number 7"]
    moved(path, version, debug_log=log, tolerance=1e-3)
    assert log.read_text().splitlines()[2:] == [
        "an instance of crane.fmu", "ok: crane number 7", *["ok: tolerance 0.001"] * 2,
    ]  # fmt: skip


def test_a_debug_log_stands_beside_the_mapping_and_an_unwritable_one_is_refused(tmp_path):
    build_crane(tmp_path / "crane.fmu", 3)
    file = tmp_path / "crane.toml"
    file.write_text(
        'file = "crane.fmu"\ninputs = ["push"]\nfeatures = ["place"]\ndebug_log = "no/such/folder.log"\n'
    )
    mapping = read_mapping(FmuMapping, file)
    assert mapping.debug_log == tmp_path / "no/such/folder.log"
    with pytest.raises(ValueError, match="debug_log .*folder.log cannot be written: No such file"):
        FmuWorld(mapping, START, 0.05)


def test_an_fmu_that_is_meant_to_take_shorter_steps_gets_a_remark(tmp_path, caplog):
    text = describe_with(
        2, "<ModelVariables>", '<DefaultExperiment stepSize="0.002"/><ModelVariables>'
    )
    path = build_crane(tmp_path / "crane.fmu", 2, description=text)
    moved(path, 2, period=0.002)
    assert caplog.text == ""
    moved(path, 2)
    assert (
        "is meant to take steps of 0.002 s and takes those of the control period, 0.05 s; period = 0.002"
        in caplog.text
    )
