"""PyBullet's banner is kept back, and nothing else is."""

import os
import subprocess
import sys

import pytest

pytest.importorskip(
    "pybullet", reason="PyBullet is not installed; from Python 3.12 on it has no wheel"
)

from servobench.plant.rendered.bullet import BANNER, without_banner


def python(program, **streams):
    return subprocess.run(
        [sys.executable, "-c", program], text=True, timeout=120, check=True, **streams
    )


@pytest.mark.slow
def test_importing_the_engine_prints_nothing():
    program = "import sys; sys.stderr.write('a'); import servobench.plant.rendered.bullet; sys.stderr.write('b')"
    done = python(program, capture_output=True)
    assert (done.stdout, done.stderr) == ("", "ab")


@pytest.mark.slow
def test_the_engine_can_be_imported_without_a_standard_error():
    program = "import os; os.close(2); from servobench.plant.rendered.bullet import pybullet; print(pybullet.DIRECT)"
    assert python(program, stdout=subprocess.PIPE).stdout == "2\n"


def test_naming_the_rendered_plants_loads_no_engine():
    python(
        "import sys, servobench.plant.rendered.plants; sys.exit(bool({'pybullet', 'mujoco'} & set(sys.modules)))"
    )


def fail_to_import(descriptor):
    with without_banner(descriptor):
        os.write(descriptor, b"reason\n")
        raise ImportError("no pybullet")


def test_only_the_banner_is_held_back(tmp_path):
    with (tmp_path / "out").open("wb+") as file:
        with without_banner(file.fileno()):
            os.write(file.fileno(), b"one\n" + BANNER + b" Jan 29 2025\ntwo\n")
        os.write(file.fileno(), b"three\n")
        file.seek(0)
        assert file.read() == b"one\ntwo\nthree\n"


def test_what_was_written_is_passed_on_when_the_import_fails(tmp_path):
    with (tmp_path / "out").open("wb+") as file:
        with pytest.raises(ImportError):
            fail_to_import(file.fileno())
        file.seek(0)
        assert file.read() == b"reason\n"
