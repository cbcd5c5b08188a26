"""Settings are checked on construction, and every complaint is one line."""

import pickle
import re
from dataclasses import FrozenInstanceError, replace
from typing import Literal

import pytest

from servobench.plant.contract.settings import (
    Count,
    Number,
    Periods,
    Positive,
    Share,
    nested,
    settings,
)
from servobench.plant.robot.camera import PinholeCamera


@settings
class Inner:
    gain: Positive = 1.0
    share: Share = 0.5
    centre: Number = 0.0
    units: Count = 3
    delay: Periods = 0
    word: Literal["one", "two"] = "one"
    grid: tuple[float, ...] = (1.0, 2.0)
    switch: bool = True

    def __post_init__(self):
        if self.delay > self.units:
            raise ValueError(f"delay must be at most units, got {self.delay} and {self.units}")


@settings
class Outer:
    inner: Inner = nested(Inner)
    name: str = "x"


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"gain": 0.0}, "gain must be above 0, got 0.0"),
        ({"gain": float("inf")}, "gain must be finite, got inf"),
        ({"gain": "a"}, "gain must be a number, got 'a'"),
        ({"gain": True}, "gain must be a number, got True"),
        ({"share": -0.1}, "share must be at least 0, got -0.1"),
        ({"share": 1.1}, "share must be at most 1, got 1.1"),
        ({"centre": float("nan")}, "centre must be finite, got nan"),
        ({"units": 0}, "units must be at least 1, got 0"),
        ({"units": 2.5}, "units must be a whole number, got 2.5"),
        ({"word": "three"}, "word must be one of one, two, got 'three'"),
        ({"grid": [1.0]}, "grid must be a list, got [1.0]"),
        ({"grid": ("a",)}, "grid.0 must be a number, got 'a'"),
        ({"switch": 1}, "switch must be true or false, got 1"),
        ({"delay": 4}, "delay must be at most units, got 4 and 3"),
        ({"nothing": 4}, "nothing: Unexpected keyword argument"),
    ],
)
def test_a_bad_value_is_refused_in_one_line(values, message):
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Inner(**values)


def test_settings_are_values():
    outer = Outer(Inner(gain=2))
    assert isinstance(outer.inner.gain, float)
    assert replace(outer, name="y") == Outer(Inner(2.0), "y")
    assert pickle.loads(pickle.dumps(outer)) == outer
    assert hash(outer) == hash(Outer(Inner(2.0)))
    with pytest.raises(FrozenInstanceError):
        outer.name = "z"
    with pytest.raises(ValueError, match="gain must be above 0, got -1"):
        replace(outer.inner, gain=-1)


def test_settings_of_another_class_are_refused():
    with pytest.raises(ValueError, match="inner"):
        Outer(inner=3)


def test_the_clipping_planes_of_a_camera_are_in_order():
    with pytest.raises(ValueError, match=r"far must be above near, 0.1 m, got 0.05 m"):
        PinholeCamera(far=0.05)
