"""The exported FMU to the letter of the standard, with fmpy as importer: times, parameters, ranges, stops, states."""

import xml.etree.ElementTree as ET
import zipfile

import numpy as np
import pytest
from fmpy import read_model_description, simulate_fmu
from fmpy.fmi1 import FMICallException
from fmpy.model_description import read_build_description

from kit.fmpy_instance import Driven
from servobench.fmus.export import arm_layout
from servobench.fmus.ur5_plant import cached_fmu

VERSIONS = [2, 3]
LAYOUT = arm_layout(6)


class Fmu(Driven):
    """The exported UR5."""

    def __init__(self, version: int, exchange: bool = False) -> None:
        super().__init__(cached_fmu(version), version, exchange=exchange)

    def set(self, name: str, value: float) -> None:
        self.write([value] * sizes([name])[0], name)

    def get(self, name: str) -> np.ndarray:
        return self.read(sizes([name])[0], name)


def sizes(names) -> list[int]:
    return [next(group.size for group in LAYOUT.groups if group.name == name) for name in names]


def refused():
    return pytest.raises(FMICallException, match="status 3")


@pytest.mark.parametrize("version", VERSIONS)
def test_a_step_that_ends_after_the_stop_time_is_refused(version):
    with Fmu(version) as arm:
        arm.start(stop=1.0)
        arm.step(0.0, 0.5)
        with refused():
            arm.step(0.5, 0.6)
        arm.step(0.5, 0.5 + 1e-9)  # rounding of the importer
    with Fmu(version) as arm:
        arm.start()
        arm.step(0.0, 5.0)
    with Fmu(version) as arm, refused():
        arm.start(time=2.0, stop=1.0)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_solver_may_look_beyond_the_stop_time_and_not_step_there(version):
    with Fmu(version, exchange=True) as arm:
        arm.start(stop=1.0)
        arm.fmu.enterContinuousTimeMode()
        arm.fmu.setTime(1.2)
        arm.get("der(joint_velocity)")
        for ended in (arm.fmu.completedIntegratorStep, arm.fmu.enterEventMode):
            with refused():
                ended()
        arm.fmu.setTime(1.0)
        arm.fmu.completedIntegratorStep()
        arm.fmu.enterEventMode()


@pytest.mark.parametrize("version", VERSIONS)
def test_no_step_is_lost_or_taken_twice_a_day_after_the_start(version):
    with Fmu(version) as arm:
        arm.start(time=1e5)
        arm.step(1e5, 0.05)
        for wrong in (1e5, 1e5 + 0.1, 1e5 + 0.0501):
            with refused():
                arm.step(wrong, 0.05)
        for k in range(1, 1000):
            arm.step(1e5 + k * 0.05, 0.05)


@pytest.mark.parametrize("version", VERSIONS)
def test_home_is_fixed_from_the_end_of_initialisation_on(version):
    variability = {each.name: each.variability for each in Fmu(version).description.modelVariables}
    assert variability["home[1]" if version == 2 else "home"] == "fixed"
    assert variability["a[1]" if version == 2 else "a"] == "tunable"
    with Fmu(version) as arm:
        arm.set("home", 0.25)
        arm.start()
        assert arm.get("joint_position").tolist() == [0.25] * 6
        with refused():
            arm.set("home", 0.5)
        assert arm.get("home").tolist() == [0.25] * 6
    with Fmu(version) as arm, refused():
        arm.set("home", 50.0)
        arm.start()


@pytest.mark.parametrize("version", VERSIONS)
def test_stops_are_checked_while_stepping(version):
    with Fmu(version) as arm:
        arm.set("home", 0.0)
        arm.start()
        arm.set("joint_lower", 3.0)
        arm.set("joint_upper", -3.0)
        with refused():
            arm.step(0.0, 0.05)
        arm.set("joint_upper", 4.0)  # a range without the joint in it
        with refused():
            arm.step(0.0, 0.05)
        assert arm.get("joint_position").tolist() == [0.0] * 6
        arm.set("joint_lower", -0.01)
        arm.set("joint_velocity_command", -1.0)
        arm.step(0.0, 0.05)
        assert arm.get("joint_position").tolist() == [-0.01] * 6


def drive(version: int, kind: str, **options) -> tuple[np.ndarray, np.ndarray]:
    """Return position and velocity of joint 1, which is driven into its stop for half a second and then back."""
    time, commands = np.array([0.0, 0.5, 0.5, 1.0]), np.array([1.0, 1.0, -0.3, -0.3])
    if version == 2:
        names = [f"joint_velocity_command[{i + 1}]" for i in range(6)]
        signal = np.zeros(4, dtype=[("time", float), *((name, float) for name in names)])
        for name in names:
            signal[name] = commands
        start = {
            f"{name}[{i + 1}]": value
            for name, value in (("joint_upper", 0.1), ("home", 0.0))
            for i in range(6)
        }
        outputs = ["joint_position[1]", "joint_velocity[1]"]
    else:
        signal = np.zeros(4, dtype=[("time", float), ("joint_velocity_command", float, (6,))])
        signal["joint_velocity_command"] = commands[:, None]
        start, outputs = (
            {"joint_upper": [0.1] * 6, "home": [0.0] * 6},
            ["joint_position", "joint_velocity"],
        )
    signal["time"] = time
    result = simulate_fmu(
        str(cached_fmu(version)),
        fmi_type=kind,
        stop_time=1.0,
        output_interval=0.05,
        start_values=start,
        input=signal,
        output=outputs,
        record_events=False,
        **options,
    )
    return tuple(np.reshape(result[name], (len(result), -1))[:, 0] for name in outputs)


@pytest.mark.parametrize("version", VERSIONS)
def test_co_simulation_and_model_exchange_agree_at_a_stop(version):
    q, v = drive(version, "CoSimulation", step_size=0.05)
    solved_q, solved_v = drive(version, "ModelExchange", relative_tolerance=1e-9)
    assert q.max() == 0.1
    assert v[9] == 0.0  # at rest while it is driven into the stop
    assert q[-1] < 0.0
    np.testing.assert_allclose(solved_q, q, rtol=0, atol=2e-8)
    np.testing.assert_allclose(solved_v, v, rtol=0, atol=2e-7)


@pytest.mark.parametrize("version", VERSIONS)
def test_a_damaged_state_and_one_of_the_other_interface_are_refused(version):
    with Fmu(version) as arm, Fmu(version, exchange=True) as model:
        arm.start(), model.start()
        names = ("getFMU{}", "setFMU{}", "serializeFMU{}", "deSerializeFMU{}")
        if version == 3:
            names = (*names[:3], "deserializeFMU{}")
        word = "state" if version == 2 else "State"
        get, put, read, write = (getattr(arm.fmu, name.format(word)) for name in names)
        state = get()
        content = bytes(read(state))
        put(write(content))
        for k in (64, len(content) // 2, len(content) - 12):
            with refused():
                write(content[:k] + bytes([content[k] ^ 1]) + content[k + 1 :])
        with refused():
            (model.fmu.setFMUstate if version == 2 else model.fmu.setFMUState)(state)


@pytest.mark.parametrize("version", VERSIONS)
def test_derivatives_can_be_asked_after_the_end(version):
    with Fmu(version) as arm:
        arm.start()
        arm.step(0.0, 0.05)
        arm.fmu.terminate()
        known, unknown = arm.references("joint_position")[:1], arm.references("ball_position")
        if version == 2:
            column = arm.fmu.getDirectionalDerivative(unknown, known, [1.0])
        else:
            column = arm.fmu.getDirectionalDerivative(unknown, known, [1.0] + 5 * [0.0], 3)
        np.testing.assert_allclose(column, arm.get("jacobian").reshape(3, 6)[:, 0], atol=1e-12)


KNOWNS = ("tool", "gear_ratio", "lag", "max_speed", "home", "joint_velocity_command")
UNKNOWNS = (
    "ball_position",
    "jacobian",
    "joint_position",
    "der(joint_position)",
    "der(joint_velocity)",
    "stop_indicator",
)


@pytest.mark.parametrize("starting", [True, False])
def test_adjoint_derivatives_are_the_transposed_product_of_the_directional_ones(starting):
    generator = np.random.default_rng(4)
    with Fmu(3) as arm:
        if starting:
            arm.fmu.enterInitializationMode(startTime=0.0)
        else:
            arm.start()
        arm.fmu.setFloat64(
            arm.references("joint_velocity_command"), [0.5, 2.0, -2.0, 0.1, 0.0, -0.3]
        )
        if not starting:
            arm.step(0.0, 0.3)
        states = () if starting else ("joint_position", "joint_velocity")
        knowns, unknowns = (
            [arm.references(name)[0] for name in names] for names in ((*KNOWNS, *states), UNKNOWNS)
        )
        n, m = sum(sizes((*KNOWNS, *states))), sum(sizes(UNKNOWNS))
        matrix = [
            arm.fmu.getDirectionalDerivative(unknowns, knowns, row.tolist(), m) for row in np.eye(n)
        ]
        seed = generator.standard_normal(m)
        came = arm.fmu.getAdjointDerivative(unknowns, knowns, seed.tolist(), n)
        assert np.count_nonzero(came) > n / 2
        np.testing.assert_allclose(came, np.array(matrix) @ seed, rtol=0, atol=1e-12)


def test_one_adjoint_call_gives_a_row_of_the_jacobian_and_equals_differences():
    with Fmu(3) as arm:
        arm.start()
        arm.set("joint_velocity_command", 0.5)
        arm.step(0.0, 0.4)
        ball, q, tool = (
            arm.references(name) for name in ("ball_position", "joint_position", "tool")
        )
        row = arm.fmu.getAdjointDerivative(ball, q, [0.0, 1.0, 0.0], 6)
        np.testing.assert_allclose(row, arm.get("jacobian").reshape(3, 6)[1], rtol=0, atol=1e-12)
        weights, at = np.array([0.3, -1.0, 0.7]), arm.get("tool")
        came = arm.fmu.getAdjointDerivative(ball, tool, weights.tolist(), len(at))
        for k, derivative in enumerate(came):
            heights = []
            for sign in (1.0, -1.0):
                arm.fmu.setFloat64(tool, (at + sign * 1e-6 * np.eye(len(at))[k]).tolist())
                heights.append(weights @ arm.get("ball_position"))
            assert derivative == pytest.approx((heights[0] - heights[1]) / 2e-6, abs=1e-8)


@pytest.mark.parametrize(
    ("unknown", "known", "seed", "size"),
    [
        ("ball_position", "ball_position", 3, 3),
        ("ball_position", "tool", 2, 3),
        ("ball_position", "tool", 3, 4),
    ],
)
def test_adjoint_derivatives_of_what_does_not_fit_are_refused(unknown, known, seed, size):
    with Fmu(3) as arm:
        arm.start()
        with refused():
            arm.fmu.getAdjointDerivative(
                arm.references(unknown), arm.references(known), [1.0] * seed, size
            )


def test_the_description_says_what_tools_ask_for():
    with zipfile.ZipFile(cached_fmu(3)) as archive:
        build = ET.fromstring(archive.read("sources/buildDescription.xml"))
        references = ET.fromstring(
            archive.read("extra/org.fmi-standard.fmi-ls-ref/fmi-ls-manifest.xml")
        )
        for related in references.iter("Related"):
            assert "extra/" + related.attrib["source"].removeprefix("../") in archive.namelist()
    assert [each.attrib["name"] for each in build.iter("Library")] == ["m"]
    assert len(read_build_description(str(cached_fmu(3)))) == 1
    assert [each.attrib["role"] for each in references.iter("Related")] == ["testcase", "result"]
    for version in VERSIONS:
        description = read_model_description(str(cached_fmu(version)))
        assert float(description.defaultExperiment.tolerance) == 1e-6
        assert (description.numberOfContinuousStates, description.numberOfEventIndicators) == (
            18,
            12,
        )
        variables = {each.name.removesuffix("[1]"): each for each in description.modelVariables}
        assert float(variables["joint_velocity"].nominal) == 1.0
        assert variables["joint_position"].displayUnit == "deg"
