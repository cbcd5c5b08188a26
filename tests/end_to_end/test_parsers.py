"""Whatever stands in a file or behind an option is read, or refused in one line, in little time and memory.

The long campaign is `python -m night.fuzzing`; FOUND holds its finds.
"""

import os
from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from night.fuzzing import Broken, check, fuzz
from night.parsers import HOLDER, LEDGER, PARSERS, Parser
from servobench.plant.contract.faults import ConfigurationError

LONG = "9" * 400
FOUND: tuple[tuple[str, str | bytes], ...] = (  # what once was a traceback, a hang or gigabytes
    ("--seeds", "91092500"),
    ("--seeds", "910079250"),
    ("--seeds", "9" * 31),
    ("--seeds", f"0:{LONG}"),
    ("--seeds", f"{LONG},1"),
    ("--seeds", ","),
    ("--vary", "camera_rotation=0:1000000000000000000000000000000:30deg"),
    ("--vary", f"camera_rotation=0:{LONG}:{LONG}deg"),
    ("--vary", "ripple"),
    ("--set", f"kinematic.lag={LONG}"),
    ("--set", f"target.target=[{LONG},0,0]"),
    ("--set", "kinematic.lag=" + "9" * 5000),
    ("--set", "kinematic.lag=" + "[" * 3000),
    ("--robot", "~nobody_of_this_name/arm.toml"),
    ("--robot", "p\x1eq.urdf"),
    ("--plants", "fmu:a\nb\x9a.toml"),
    ("--plants", "fmu:~nobody_of_this_name/a.toml"),
    ("--controllers", "~nobody_of_this_name/a.py:Mine"),
    ("configuration", f"[kinematic]\nlag = {LONG}\n"),
    ("configuration", "[kinematic]\nlag = " + "9" * 5000),
    ("configuration", "a = " + "[" * 3000),
    ("mapping", f'file = "a.fmu"\ninputs = "a"\nfeatures = "b"\nstart = [{LONG}]\n'),
    ("mapping", f'file = "a.fmu"\ninputs = "a"\nfeatures = "b"\nparameters = {{mass = {LONG}}}\n'),
    ("mapping", 'file = "a.fmu"\ninputs = "a"\nfeatures = "b"\ncamera = ["position"]\n'),
    ("waypoints", f"time_s,x_m,y_m,z_m\n0,0.1,0.2,1.2\n{LONG},0.2,1.2,1\n"),
    ("calibration", f"kinematics: {{shoulder: {{x: {LONG}}}}}"),
    ("calibration", "[" * 3000),
    ("reference run", "time,a\n0,1\r7\n"),
    ("modelDescription", '<?xml version="1.0" encoding="klingon"?><fmiModelDescription/>'),
    ("modelDescription", "<a>" * 200_000),
    ("journal", LEDGER + "[" * 3000 + "\n"),
    ("journal", LEDGER.replace("[0.5, 2]", "[]")),
    ("journal", LEDGER.replace("[0.5, 2]", '["a", 2]')),
    ("journal", LEDGER.replace("[0.5, 2]", "0.5")),
    ("journal", LEDGER.replace("[0.5, 2]", f"[{LONG}]")),
    ("other table", ""),
    ("other table", 'a,b\n"1,2\n'),
    ("other table", "a\n1\n1,2,3\n"),
    ("other table", "\ud800"),
    ("manifest", "[" * 3000),
)


PASSED_OVER: tuple[
    tuple[str, str], ...
] = (  # what does not keep a folder from being used, and was a traceback, too
    ("lock", "[" * 3000),
    ("lock", HOLDER.replace('"pid": 4', '"pid": 1e999')),
    ("lock", HOLDER.replace('"pid": 4', '"pid": -1')),
    ("lock", HOLDER.replace('"pid": 4', '"pid": 9999999999999999999999')),
    ("cache entry", "[" * 3000),
    ("cache entry", "7  files/a/b.txt\n"),
)


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))


@pytest.mark.parametrize("name", PARSERS)
def test_every_example_is_taken(name, tmp_path):
    for example in PARSERS[name].examples:
        assert check(PARSERS[name], example, tmp_path)


@pytest.mark.parametrize(
    ("name", "given_"), FOUND, ids=[f"{i}-{name}" for i, (name, _) in enumerate(FOUND)]
)
def test_what_once_broke_is_refused_in_one_line(name, given_, tmp_path):
    assert not check(PARSERS[name], given_, tmp_path)


@pytest.mark.parametrize(("name", "given_"), PASSED_OVER)
def test_what_once_broke_is_passed_over(name, given_, tmp_path):
    assert check(PARSERS[name], given_, tmp_path)


@pytest.mark.parametrize("name", PARSERS)
def test_changed_inputs_are_read_or_refused(name, tmp_path):
    with np.errstate(all="warn"):
        assert fuzz(name, 4 if PARSERS[name].share < 0.1 else 30, 0, tmp_path).breaks == {}


BREAKS = {
    "KeyError": lambda *_: {}["a"],
    "not one line": lambda *_: (_ for _ in ()).throw(ConfigurationError("")),
    "MemoryError": lambda *_: bytearray(700_000_000),
    "UnicodeDecodeError": lambda *_: b"\xff".decode(),
}


@pytest.mark.parametrize("message", BREAKS)
def test_a_broken_promise_is_seen(message, tmp_path):
    with pytest.raises(Broken, match=message):
        check(Parser(BREAKS[message], ("a",)), "a", tmp_path)


def test_a_parser_that_hangs_is_seen(tmp_path, monkeypatch):
    monkeypatch.setattr("night.fuzzing.MAX_SECONDS", 0.1)

    def hang(_text: str, _folder: Path) -> None:
        while True:
            os.getpid()

    with pytest.raises(Broken, match=r"took more than 0\.1 s"):
        check(Parser(hang, ("a",)), "a", tmp_path)


@given(st.text())
def test_a_message_is_one_line_without_control_characters_whatever_it_repeats(text):
    message = str(ConfigurationError(f"got {text}"))
    assert message.isprintable()
