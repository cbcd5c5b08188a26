"""`servobench new`: what it writes runs, keeps the contract, and overwrites nothing."""

import os
import subprocess
import sys

import pytest

from kit.command import PACKAGE, servobench


@pytest.fixture(autouse=True)
def _own_folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("kind", "check", "options"),
    [("controller", "check", ()), ("controller", "check", ("--aids",)), ("plant", "check plant", ())],
)
def test_a_new_file_passes_its_own_test(monkeypatch, capsys, tmp_path, kind, check, options):
    assert servobench(monkeypatch, "new", kind, "my_law", "--folder", "laws", *options) == 0
    assert f"servobench {check} ./laws/my_law.py" in capsys.readouterr().out
    done = subprocess.run(
        [sys.executable, "-m", "pytest", "-q", "-p", "no:cacheprovider", "test_my_law.py"],
        cwd=tmp_path / "laws", env={**os.environ, "PYTHONPATH": str(PACKAGE)},
        capture_output=True, text=True, timeout=300, check=False,
    )  # fmt: skip
    assert "2 passed" in done.stdout, done.stdout + done.stderr


def test_a_new_controller_with_aids_says_so_and_a_plant_has_none(monkeypatch, capsys, tmp_path):
    assert servobench(monkeypatch, "new", "controller", "my_law", "--aids") == 0
    assert servobench(monkeypatch, "check", "./my_law.py") == 0
    lines = [line.split(maxsplit=2) for line in capsys.readouterr().out.splitlines()]
    assert ["ok", "aids"] in lines
    assert servobench(monkeypatch, "new", "plant", "my_cell", "--aids") == 2
    assert "--aids are those of a controller; leave the option out for a plant" in capsys.readouterr().err
    assert not (tmp_path / "my_cell.py").exists()


def test_nothing_is_overwritten(monkeypatch, capsys, tmp_path):
    (tmp_path / "test_mine.py").write_text("mine")
    assert servobench(monkeypatch, "new", "controller", "mine") == 2
    assert "test_mine.py exists already and is left as it is" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["test_mine.py"]
    assert (tmp_path / "test_mine.py").read_text() == "mine"


@pytest.mark.parametrize("name", ["3d", "class", "my-law", "../mine", "test_mine", ""])
def test_a_name_that_no_module_may_have_is_refused(monkeypatch, capsys, tmp_path, name):
    assert servobench(monkeypatch, "new", "controller", name) == 2
    assert "the name must be one of a Python module, such as my_law" in capsys.readouterr().err
    assert servobench(monkeypatch, "new", "robot", "mine") == 2
    assert "'robot' is nothing to begin with" in capsys.readouterr().err
    assert list(tmp_path.iterdir()) == []
