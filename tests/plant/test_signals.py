import numpy as np
import pytest

from servobench.harness.run.scenario import Scenario
from servobench.plant.contract.checks import check_number, whole_steps
from servobench.plant.contract.signals import Channel, Command, Observation, PlantSpec


def test_messages_keep_read_only_copies():
    source = np.zeros(2)
    command = Command(source)
    source[0] = 1.0
    assert command.joint_velocity.tolist() == [0.0, 0.0]
    with pytest.raises(ValueError, match="read-only"):
        command.joint_velocity[0] = 1.0


@pytest.mark.parametrize("name", ["time", "joint_position", "feature"])
def test_an_observation_must_be_finite(name):
    values = {"time": 0.0, "joint_position": np.zeros(2), "feature": np.zeros(1)}
    with pytest.raises(ValueError, match=f"{name} must be finite"):
        Observation(**(values | {name: np.inf * np.ones_like(values[name])}))


@pytest.mark.parametrize(
    ("speed", "lower", "period", "message"),
    [
        ([0.0], [-1.0], 0.1, "joint_velocity_limit must be positive"),
        ([1.0, 1.0], [-1.0], 0.1, "joint_velocity_limit must have shape"),
        ([1.0], [3.0], 0.1, "joint_lower must be below joint_upper"),
        ([1.0], [-1.0], 0.0, "period must be above 0, got 0.0"),
    ],
)
def test_a_spec_is_checked(speed, lower, period, message):
    with pytest.raises(ValueError, match=message):
        PlantSpec.of_joints(("a",), ("x",), np.array(speed), np.array(lower), np.ones(1), period)


def test_a_number_is_held_against_its_bounds():
    check_number("x", 0.1, above=0.0)
    for value in (0.0, np.inf, np.nan):
        with pytest.raises(ValueError, match=f"x must be above 0, got {value}"):
            check_number("x", value, above=0.0)


@pytest.mark.parametrize(
    "make",
    [
        lambda: Observation(None, [0.0], [0.0]), lambda: Observation(0.0, None, [0.0]),
        lambda: PlantSpec(None, None, [0.0], [1.0], 0.1), lambda: PlantSpec.of_joints(None, ("x",), [1], [0], [1], 0.1),
        lambda: PlantSpec.of_joints(("a",), "xy", [1], [0], [1], 0.1), lambda: Scenario(None, None, None, 0.0),
        lambda: PlantSpec.of_joints(("a",), ("x",), [1], [0], [1], None), lambda: Scenario(None, None, 1.0, None),
    ],
)  # fmt: skip
def test_none_and_a_text_for_names_are_refused_by_their_argument(make):
    with pytest.raises(
        ValueError, match=r"(must be real numbers|names .* must be lists|must be Channels), got"
    ):
        make()


def test_a_period_is_a_whole_number_of_own_steps():
    assert whole_steps(0.05, 1 / 240) == 12
    with pytest.raises(
        ValueError, match=r"whole multiple of the plant's own step of 0.00416666667 s, got 0.051 s"
    ):
        whole_steps(0.051, 1 / 240)
    with pytest.raises(ValueError, match="whole multiple"):
        whole_steps(-0.05, 1 / 240)


def test_each_feature_says_whether_it_is_valid():
    assert Observation(0.0, np.zeros(1), np.zeros(2)).valid.tolist() == [True, True]
    assert Observation(0.0, np.zeros(1), np.zeros(2), feature_valid=False).valid.tolist() == [
        False,
        False,
    ]
    partial = Observation(0.0, np.zeros(1), np.zeros(2), valid=np.array([True, False]))
    assert (partial.valid.tolist(), partial.feature_valid) == ([True, False], False)
    with pytest.raises(ValueError, match=r"valid must have shape \(2,\), got \(1,\)"):
        Observation(0.0, np.zeros(1), np.zeros(2), valid=np.array([True]))


def test_a_spec_describes_features_and_commands_as_channels():
    spec = PlantSpec.of_joints(("a", "b"), ("x",), [1.0, 2.0], [-3.0, -3.0], [3.0, 3.0], 0.1, "px")
    assert (spec.n, spec.m, spec.feature_names, spec.feature_unit) == (2, 1, ("x",), "px")
    assert (spec.joint_names, spec.command.unit) == (("a", "b"), "rad/s")
    assert spec.joint_velocity_limit.tolist() == [1.0, 2.0]
    assert (spec.command.lower == -spec.joint_velocity_limit).all()


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"scale": 0.0}, "scale must be above 0, got 0.0"),
        ({"lower": np.zeros(2)}, "lower must hold 1 numbers, got"),
        ({"upper": np.array([np.nan])}, "upper must hold 1 numbers, got"),
        ({"lower": np.array([2.0])}, "lower must be below upper for every one of x"),
    ],
)
def test_a_channel_is_checked(change, message):
    values = {
        "names": ("x",),
        "unit": "m",
        "scale": 1.0,
        "lower": np.array([-np.inf]),
        "upper": np.ones(1),
    }
    with pytest.raises(ValueError, match=message):
        Channel(**(values | change))


def test_command_limits_must_be_symmetric():
    one = np.ones(1)
    feature, command = (
        Channel(("x",), "m", 1.0, -one, one),
        Channel(("a",), "rad/s", 1.0, -2 * one, one),
    )
    with pytest.raises(ValueError, match="command limits must be symmetric"):
        PlantSpec(feature, command, -one, one, 0.1)


def test_a_time_of_capture_is_a_number_or_missing():
    assert np.isnan(Observation(0.0, [0.0], [0.0]).capture_time)
    given = Observation(0.0, [0.0], [0.0], capture_time=np.float64(7.5))
    assert given.capture_time == 7.5
    assert given.with_values(given.joint_position, given.feature).capture_time == 7.5
    for wrong in (np.inf, [1.0], None, "soon"):
        with pytest.raises(ValueError, match="capture_time must"):
            Observation(0.0, [0.0], [0.0], capture_time=wrong)
