"""Mappings of FMU variables in TOML files."""

import numpy as np
import pytest

from servobench.plant.contract.settings import remark
from servobench.plant.fmu.description import FmuDescription, Variable
from servobench.plant.fmu.mapping import FmuMapping, JointLimits, LogNames, TruthMapping, mapping_spec, read_mapping

WHOLE = """
file = "crane.fmu"
inputs = ["v[1]", "v[2]"]
features = "hook"
joints = ["q"]
home = "q0"
start = [0.3, 1.2]
period = 0.01
[parameters]
mass = 12
gains = [1.0, 2.0]
[nominal]
gains = 3.0
[truth]
features = ["hook"]
jacobian = ["J"]
states = "s"
[limits]
max_joint_speed = 2
joint_lower = -3.1
joint_upper = 3.2
[names]
joints = ["slew", "luff"]
features = ["x", "y"]
feature_unit = "mm"
"""


def written(tmp_path, text):
    path = tmp_path / "crane.toml"
    path.write_text(text)
    return path


def test_every_key_arrives(tmp_path):
    mapping = read_mapping(FmuMapping, written(tmp_path, WHOLE))
    assert mapping.file == tmp_path / "crane.fmu"
    assert (mapping.inputs, mapping.features, mapping.joints) == (("v[1]", "v[2]"), ("hook",), ("q",))
    assert (mapping.home, mapping.period) == ("q0", 0.01)
    assert mapping.truth == TruthMapping(("hook",), ("J",), ("s",))
    assert mapping.limits == JointLimits(2.0, -3.1, 3.2)
    assert mapping.names == LogNames(("slew", "luff"), ("x", "y"), "mm")
    np.testing.assert_array_equal(mapping.parameters["gains"], [1.0, 2.0])
    assert mapping.parameters["mass"] == 12.0
    assert mapping.nominal == {"gains": 3.0}
    assert mapping.start.tolist() == [0.3, 1.2]
    assert read_mapping(FmuMapping, written(tmp_path, WHOLE.replace("[nominal]\ngains = 3.0", ""))).nominal is None


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file = "crane.fmu"', "", "the key 'file' is missing"),
        ('features = "hook"', "", "the key 'features' is missing"),
        ('home = "q0"', 'hoem = "q0"', r"no setting 'hoem': did you mean 'home'\? valid: camera, debug_log, features"),
        ("joint_lower", "joint_low", "limits has no setting 'joint_low': did you mean 'joint_lower'"),
        ('home = "q0"', "home = 3", "home must be text, got 3"),
        ('joints = ["q"]', "joints = [1]", "joints.0 must be text, got 1"),
        ("gains = 3.0", "gains = 'large'", "nominal.gains must be a number or a list of numbers, got 'large'"),
        ('home = "q0"', "", "start needs home, the parameter that takes it"),
        ("period = 0.01", 'period = "short"', "period must be a number, got 'short'"),
        ("period = 0.01", "period = 0.0", "period must be above 0, got 0.0"),
        ("mass = 12", 'mass = [1, "heavy"]', "parameters.mass must be a number or a list of numbers"),
        ("gains = 3.0", "gains = [1.0, true]", "nominal.gains must be a number or a list of numbers"),
        ("max_joint_speed = 2", "max_joint_speed = -2", "max_joint_speed must be above 0"),
        ("[parameters]\nmass = 12\ngains = [1.0, 2.0]", "parameters = 1", "parameters must be a section"),
        ("period = 0.01", "period = ", "is not valid TOML"),
    ],
)
def test_a_bad_mapping_is_one_clear_error_that_names_the_file(tmp_path, old, new, message):
    assert old in WHOLE
    with pytest.raises(ValueError, match=f"mapping .*crane.toml.*{message}"):
        read_mapping(FmuMapping, written(tmp_path, WHOLE.replace(old, new, 1)))


def test_a_missing_mapping_is_told(tmp_path):
    with pytest.raises(ValueError, match=r"mapping .*missing.toml cannot be read"):
        read_mapping(FmuMapping, tmp_path / "missing.toml")


@pytest.mark.parametrize(("told", "given", "fits"), [("m", "mm", False), ("mm", "m", False), ("m", "m", True),
                                                     ("1", "px", True), ("", "mm", True)])  # fmt: skip
def test_a_unit_of_length_that_is_not_the_fmu_s_is_refused(tmp_path, told, given, fits):
    variables = Variable("v", 0, 1, "input"), Variable("y", 1, 1, "output", unit=told)
    described = FmuDescription(tmp_path / "a.fmu", tmp_path, 2, "a", "a", "", False, False, False, variables)
    mapping = FmuMapping(tmp_path / "a.fmu", ("v",), ("y",), names=LogNames(feature_unit=given))
    if fits:
        assert mapping_spec(mapping, described, 0.05).feature_unit == given
        return
    with pytest.raises(ValueError, match=f"names.feature_unit must be {told}, the unit of y, got {given}"):
        mapping_spec(mapping, described, 0.05)


@pytest.mark.parametrize(("role", "unit", "wanted"), [("v", "deg/s", "rad/s"), ("q", "°", "rad")])
def test_degrees_of_the_fmu_are_refused(tmp_path, role, unit, wanted):
    units = {"v": "rad/s", "q": "rad", "y": "m"} | {role: unit}
    variables = (
        Variable("v", 0, 1, "input", unit=units["v"]),
        Variable("q", 1, 1, "output", unit=units["q"]),
        Variable("y", 2, 1, "output", unit=units["y"]),
    )
    described = FmuDescription(tmp_path / "a.fmu", tmp_path, 2, "a", "a", "", False, False, False, variables)
    with pytest.raises(ValueError, match=f"names '{role}', whose unit is deg.*wanted {wanted}: convert it in the FMU"):
        mapping_spec(FmuMapping(tmp_path / "a.fmu", ("v",), ("y",), joints=("q",)), described, 0.05)


def test_an_input_that_is_named_twice_is_refused(tmp_path):
    variables = Variable("v", 0, 1, "input"), Variable("y", 1, 1, "output")
    described = FmuDescription(tmp_path / "a.fmu", tmp_path, 2, "a", "a", "", False, False, False, variables)
    with pytest.raises(ValueError, match="a.fmu: inputs names the input 'v' twice"):
        mapping_spec(FmuMapping(tmp_path / "a.fmu", ("v", "v"), ("y",)), described, 0.05)


def test_features_that_are_the_joints_are_remarked_on(tmp_path, caplog):
    remark.cache_clear()
    variables = Variable("v", 0, 1, "input"), Variable("q", 1, 1, "output"), Variable("y", 2, 1, "output")
    described = FmuDescription(tmp_path / "a.fmu", tmp_path, 2, "a", "a", "", False, False, False, variables)
    mapping_spec(FmuMapping(tmp_path / "a.fmu", ("v",), ("y",), joints=("q",)), described, 0.05)
    assert not caplog.text
    mapping_spec(FmuMapping(tmp_path / "a.fmu", ("v",), ("q",), joints=("q",)), described, 0.05)
    assert "features of the mapping are its joints, q;" in caplog.text
