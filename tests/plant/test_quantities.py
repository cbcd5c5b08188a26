"""Quantities are read in any of their units, and answered in the unit in which they were written."""

import logging
import math
import re

import pytest

from servobench.controllers.methods import METHODS
from servobench.harness.config.settings import read_settings
from servobench.harness.run.request import RunSettings
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.contract.settings import remark
from servobench.plant.contract.units import UNITS, in_own_unit, in_unit, split_quantity, units_of
from servobench.plant.kinematic import KinematicConfig
from servobench.plant.rendered.settings import RenderedConfig
from servobench.plant.robot.mismatch import Mismatch

DEFAULTS = {
    "bullet": RenderedConfig(),
    "kinematic": KinematicConfig(),
    "run": RunSettings(),
    "ukf_mfac": METHODS["ukf_mfac"].config(),
}


def read(assignment):
    section = assignment.partition(".")[0]
    return read_settings(None, [assignment]).resolve(section, DEFAULTS[section])


@pytest.mark.parametrize("own", UNITS)
def test_a_number_survives_its_way_through_every_unit(own):
    for unit in units_of(own):
        assert in_own_unit(in_unit(0.8, unit, own), unit, own) == pytest.approx(0.8, rel=1e-15)


def test_decimal_parts_are_the_numbers_that_they_are_written_as():
    for k in range(1000):
        assert in_own_unit(*split_quantity(f"{k}ms"), "s") == float(f"{k}e-3")
    assert in_own_unit(*split_quantity("90 °"), "rad") == math.pi / 2
    assert in_own_unit(*split_quantity("125Hz"), "s") == 0.008


def test_settings_take_units():
    config = read("kinematic.sensing.latency=80ms")
    assert config.sensing.latency == 0.08
    assert read(
        "kinematic.sensing.occlusion_windows=[['100ms', 0.5]]"
    ).sensing.occlusion_windows == ((0.1, 0.5),)
    assert (
        read("run.period=1/30").period
        == read("run.period=1/30 s").period
        == read("run.period=30Hz").period
    )
    assert read("kinematic.sensing.feature_noise=2px").sensing.feature_noise == "2px"
    assert read("kinematic.sensing.feature_noise=2mm").sensing.feature_noise == 0.002
    assert read("run.period=125Hz").period == 0.008


@pytest.mark.parametrize(
    ("assignment", "message"),
    [
        ("kinematic.lag=-80ms", "kinematic.lag must be at least 0ms, got -80ms"),
        ("kinematic.lag=5deg", "kinematic.lag must be a number in s, ms, us, min, Hz, got '5deg'"),
        ("kinematic.lag=0,05", "kinematic.lag must be a number in s, ms, us, min, Hz, got '0,05'"),
        ("kinematic.lag=1/0", "kinematic.lag must be a number, got '1/0'"),
        ("kinematic.lag=fast", "kinematic.lag must be a number, got 'fast'"),
        (
            "kinematic.max_joint_speed=-57deg/s",
            "kinematic.max_joint_speed must be above 0deg/s, got -57deg/s",
        ),
        (
            "kinematic.sensing.drop_probability=5",
            "kinematic.sensing.drop_probability must be below 1, got 5; if 5% is meant, write the unit, too",
        ),
        (
            "kinematic.sensing.drop_probability=120%",
            "drop_probability must be below 100%, got 120%",
        ),
        ("kinematic.sensing.feature_noise=-2px", "feature_noise must be at least 0"),
        (
            "kinematic.sensing.feature_noise=2kg",
            "feature_noise must be a number in m, cm, mm, px, got '2kg'",
        ),
        (
            "ukf_mfac.aids.feature_noise=2px",
            "aids.feature_noise must be a number in m, cm, mm, got '2px'",
        ),
    ],
)
def test_a_refusal_is_in_the_unit_that_was_written(assignment, message):
    with pytest.raises(ValueError, match=re.escape(message)):
        read(assignment)


def test_a_rare_value_is_used_with_one_remark(caplog):
    remark.cache_clear()
    with caplog.at_level(logging.WARNING):
        assert read("kinematic.max_joint_speed=57").max_joint_speed == 57.0
        read("kinematic.max_joint_speed=57")
    (line,) = caplog.messages
    assert (
        "kinematic.max_joint_speed is 57, and usually at most 20 rad/s; if 57deg/s is meant, write the unit"
        in line
    )


def test_pixels_are_pixels_where_features_are():
    config = SensingConfig(feature_noise="2px", quantum="1px")
    assert config.extents("px", 160.0)[:4] == (0.0125, 0.02, 0.00625, 0.05)
    with pytest.raises(
        ValueError, match=r"sensing.feature_noise is 2px, but the features are in m; write it in m"
    ):
        config.extents("m", 1.0)


@pytest.mark.parametrize(
    "assignment",
    ["kinematic.lag=5", "kinematic.sensing.latency=3", "kinematic.mechanics.backlash=2", "run.period=5",
     "bullet.drives.payload=2500", "bullet.drives.assumed_payload=900"],
)  # fmt: skip
def test_times_and_angles_of_likely_other_units_are_remarked_on(assignment, caplog):
    remark.cache_clear()
    read(assignment)
    assert f"{assignment.replace('=', ' is ')}, and usually at most" in caplog.text


def test_an_obstacle_in_millimetres_is_remarked_on(caplog):
    remark.cache_clear()
    read("bullet.obstacles=[[0.6,0,0.2,0.1,0.1,0.4]]")
    assert not caplog.text
    read("bullet.obstacles=[[600,0,200,100,100,400]]")
    assert "bullet.obstacles is 600, and usually at most 20 m; if 600mm is meant" in caplog.text


def test_a_plain_share_that_is_likely_one_of_percent_is_remarked_on(caplog):
    remark.cache_clear()
    Mismatch.parse("gear_ratio=0.5")
    assert "gear_ratio=0.5 is 50%; if 0.5% is meant, write the unit, too" in caplog.text
    caplog.clear()
    Mismatch.parse("links=50%+gear_ratio=0.05")
    assert not caplog.text
