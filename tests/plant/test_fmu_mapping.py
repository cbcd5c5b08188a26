"""Mappings of FMU variables in TOML files."""

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servobench.plant.fmu.description import FmuDescription, Variable
from servobench.plant.fmu.mapping import (
    FmuMapping,
    JointLimits,
    LogNames,
    TruthMapping,
    mapping_spec,
    read_mapping,
    unusual_step,
)

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
    assert (mapping.inputs, mapping.features, mapping.joints) == (
        ("v[1]", "v[2]"),
        ("hook",),
        ("q",),
    )
    assert (mapping.home, mapping.period) == ("q0", 0.01)
    assert mapping.truth == TruthMapping(("hook",), ("J",), ("s",))
    assert mapping.limits == JointLimits(2.0, -3.1, 3.2)
    assert mapping.names == LogNames(("slew", "luff"), ("x", "y"), "mm")
    np.testing.assert_array_equal(mapping.parameters["gains"], [1.0, 2.0])
    assert mapping.parameters["mass"] == 12.0
    assert mapping.nominal == {"gains": 3.0}
    assert mapping.start.tolist() == [0.3, 1.2]
    assert (
        read_mapping(
            FmuMapping, written(tmp_path, WHOLE.replace("[nominal]\ngains = 3.0", ""))
        ).nominal
        is None
    )


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ('file = "crane.fmu"', "", "the key 'file' is missing"),
        ('features = "hook"', "", "the key 'features' is missing"),
        (
            'home = "q0"',
            'hoem = "q0"',
            r"no setting 'hoem': did you mean 'home'\? valid: camera, captured, debug_log, features",
        ),
        (
            "mass = 12",
            "q0 = 1.0",
            "home and parameters name 'q0', the joints at the start: write start instead",
        ),
        (
            "joint_lower",
            "joint_low",
            "limits has no setting 'joint_low': did you mean 'joint_lower'",
        ),
        ('home = "q0"', "home = 3", "home must be text, got 3"),
        ('joints = ["q"]', "joints = [1]", "joints.0 must be text, got 1"),
        (
            "gains = 3.0",
            "gains = 'large'",
            "nominal.gains must be a number or a list of numbers, got 'large'",
        ),
        ('home = "q0"', "", "start needs home, the parameter that takes it"),
        ("period = 0.01", 'period = "short"', "period must be a number, got 'short'"),
        ("period = 0.01", "period = 0.0", "period must be above 0, got 0.0"),
        (
            "mass = 12",
            'mass = [1, "heavy"]',
            "parameters.mass must be a number or a list of numbers",
        ),
        (
            "gains = 3.0",
            "gains = [1.0, true]",
            "nominal.gains must be a number or a list of numbers",
        ),
        ("max_joint_speed = 2", "max_joint_speed = -2", "max_joint_speed must be above 0"),
        (
            "max_joint_speed = 2",
            "max_joint_speed = [2.0, 0.0]",
            "max_joint_speed must be above 0, got .2.0, 0.0.",
        ),
        (
            "[parameters]\nmass = 12\ngains = [1.0, 2.0]",
            "parameters = 1",
            "parameters must be a section",
        ),
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


def spec_of(folder, units=None, own_step=None, **roles):
    """Return the spec of an FMU with an input, outputs and parameters, of the given units, by a mapping of roles."""
    units = {
        "v": "rad/s",
        "q": "rad",
        "y": "",
        "q0": "rad",
        "at": "m",
        "turned": "rad",
        "two": "m",
    } | (units or {})
    causes = dict.fromkeys(units, "output") | {"v": "input", "q0": "parameter"}
    sizes = dict.fromkeys(units, 1) | {"at": 3, "turned": 3, "two": 6}
    variables = [
        Variable(name, i, sizes[name], causes[name], unit=unit)
        for i, (name, unit) in enumerate(units.items())
    ]
    described = FmuDescription(
        folder / "a.fmu", folder, 2, "a", "a", "", False, False, False, tuple(variables)
    )
    described = replace(described, internal_step=own_step)
    mapping = FmuMapping(
        folder / "a.fmu", **{"inputs": ("v",), "features": ("y",), "joints": ("q",)} | roles
    )
    return mapping_spec(mapping, described, 0.05)


@pytest.mark.parametrize(
    ("told", "given", "fits"),
    [("m", "mm", False), ("mm", "m", False), ("m", "m", True), ("1", "px", True), ("", "mm", True), ("rad", "m", False),
     ("m", "rad", False), ("m", "px", False), ("um", "m", False), ("°", "°", True), ("deg", "°", True)],
)  # fmt: skip
def test_a_unit_of_features_that_is_not_the_fmu_s_is_refused(tmp_path, told, given, fits):
    if fits:
        assert (
            spec_of(tmp_path, {"y": told}, names=LogNames(feature_unit=given)).feature_unit == given
        )
        return
    with pytest.raises(
        ValueError, match=f"names.feature_unit must be {told}, the unit of y, got {given}"
    ):
        spec_of(tmp_path, {"y": told}, names=LogNames(feature_unit=given))


@pytest.mark.parametrize(
    ("role", "unit", "message"),
    [
        (
            "v",
            "deg/s",
            "inputs names 'v', whose unit is deg/s; wanted rad/s: convert it in the FMU",
        ),
        ("q", "°", "joints names 'q', whose unit is deg; wanted rad: convert it in the FMU"),
        ("v", "N.m", "inputs names 'v', whose unit is N.m; wanted rad/s: name another variable"),
        ("v", "rpm", "inputs names 'v', whose unit is rpm"),
        ("q", "m", "joints names 'q', whose unit is m; wanted rad: name another variable"),
        ("q0", "deg", "home names 'q0', whose unit is deg; wanted rad: convert"),
        ("at", "mm", r"camera\[1\] names 'at', whose unit is mm; wanted m: convert"),
        ("turned", "m", r"camera\[2\] names 'turned', whose unit is m; wanted rad: name another"),
    ],
)
def test_variables_of_the_fmu_in_other_units_are_refused(tmp_path, role, unit, message):
    spec_of(tmp_path, {"v": "1/s", "q": "1"}, home="q0", camera=("at", "turned"))
    with pytest.raises(ValueError, match=message):
        spec_of(tmp_path, {role: unit}, home="q0", camera=("at", "turned"))


@pytest.mark.parametrize(
    ("roles", "message"),
    [
        ({"inputs": ("v", "v")}, "a.fmu: inputs names 'v' twice"),
        ({"features": ("v",)}, "a.fmu: features names 'v' as inputs does"),
        ({"features": ("y", "y")}, "a.fmu: features names 'y' twice"),
        ({"seen": ("y",)}, "a.fmu: seen names 'y' as features does"),
        ({"camera": ("at", "y")}, r"a.fmu: camera\[2\] names 'y' as features does"),
        ({"camera": ("q0", "turned")}, r"camera\[1\] must name 3 numbers"),
        (
            {"camera": ("two", "at"), "parameters": {"at": (0.0, 0.0, 0.0)}},
            r"camera\[1\] must name 3 numbers for 1 inputs and 1 features, got 6",
        ),
        ({"inputs": ("q",), "joints": ()}, "inputs names 'q', which is of causality output"),
        (
            {"joints": ("q", "y"), "features": ("at",)},
            "joints must name 1 numbers for 1 inputs and 3 features, got 2",
        ),
        (
            {"limits": JointLimits(joint_lower=np.zeros(2))},
            r"limits.joint_lower must have one number or 1, got \[0.0, 0.0\]",
        ),
        ({"names": LogNames(joints=("a", "b"))}, "names.joints must hold 1 names, got 2"),
        (
            {"own_step": 0.02},
            "a.fmu takes steps of multiples of 0.02 s only .* must be one, got 0.05 s",
        ),
        (
            {"own_step": 0.02, "period": 0.01},
            "takes steps of multiples of 0.02 s only .* got 0.01 s",
        ),
    ],
)
def test_a_variable_in_two_roles_or_of_the_wrong_size_is_refused(tmp_path, roles, message):
    with pytest.raises(ValueError, match=message):
        spec_of(tmp_path, {"q0": ""}, **roles)


def test_steps_of_a_multiple_of_the_own_one_and_names_that_are_not_given_are_taken(tmp_path):
    spec = spec_of(tmp_path, own_step=0.01, features=("at",), period=0.03)
    assert (spec.joint_names, spec.feature_names) == (
        ("joint_1",),
        ("feature_1", "feature_2", "feature_3"),
    )


@pytest.mark.parametrize(
    ("usual", "period", "exchange", "told"),
    [(0.01, None, False, True), (0.05, None, False, False), (0.06, None, False, False), (None, None, False, False),
     (0.01, 0.05, False, False), (0.01, None, True, False)],
)  # fmt: skip
def test_a_step_longer_than_that_the_fmu_is_meant_for_is_remarked_on(usual, period, exchange, told):
    names = (Path("a.fmu"), Path(), 2, "a", "a", "", False, False, False, ())
    described = FmuDescription(*names, usual_step=usual, exchange=exchange)
    text = unusual_step(FmuMapping(Path("a.fmu"), ("v",), ("y",), period=period), described, 0.05)
    wanted = "a.fmu is meant to take steps of 0.01 s and takes those of the control period, "
    wanted += "0.05 s; period = 0.01 in the"
    assert text.startswith(wanted) if told else not text


def test_features_of_two_quantities_with_a_joint_and_outputs_named_twice_are_taken(
    tmp_path, caplog
):
    truth = TruthMapping(jacobian=("zero", "zero"))
    spec = spec_of(
        tmp_path,
        {"y": "m", "flag": "", "zero": "m"},
        features=("y", "q"),
        seen=("flag", "flag"),
        truth=truth,
    )
    assert spec.m == 2
    assert "features name the joint q; a camera measures other quantities" in caplog.text
