"""What is installed: one package, with everything in it that is read at run time."""

from __future__ import annotations

import subprocess
import sys
import tarfile
import zipfile
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
FOLDERS = ("plant", "controllers", "fmus", "harness")
CODE = (".py", ".toml", ".c", ".h", ".j2", ".urdf", ".yaml")


def build(source: Path, target: str, folder: Path) -> Path:
    subprocess.run(
        [sys.executable, "-m", "hatchling", "build", "-t", target, "-d", str(folder)],
        cwd=source, check=True, capture_output=True,
    )  # fmt: skip
    (made,) = [path for path in folder.iterdir() if path.is_file()]
    return made


@pytest.fixture(scope="module")
def wheel_names(tmp_path_factory):
    with zipfile.ZipFile(build(ROOT, "wheel", tmp_path_factory.mktemp("wheel"))) as wheel:
        return set(wheel.namelist())


def test_the_wheel_holds_one_package_with_its_types(wheel_names):
    assert {name.split("/")[0].split("-")[0] for name in wheel_names} == {"servobench"}
    assert {"servobench/py.typed", "servobench/__main__.py", "servobench/plant/signals.py"} <= wheel_names
    assert {name.split("/")[1] for name in wheel_names if name.startswith("servobench/") and name.count("/") > 1} == {
        *FOLDERS
    }


def test_the_wheel_holds_every_file_that_the_package_reads(wheel_names):
    wanted = {
        f"servobench/{path.relative_to(ROOT).as_posix()}"
        for folder in FOLDERS
        for path in (ROOT / folder).rglob("*")
        if path.suffix in CODE
    }
    assert wanted <= wheel_names
    assert "servobench/harness/notebooks/analysis.ipynb" in wheel_names


def test_the_source_distribution_makes_the_same_wheel(wheel_names, tmp_path):
    with tarfile.open(build(ROOT, "sdist", tmp_path / "sdist")) as archive:
        archive.extractall(tmp_path / "source", filter="data")
    (source,) = (tmp_path / "source").iterdir()
    with zipfile.ZipFile(build(source, "wheel", tmp_path / "again")) as wheel:
        assert set(wheel.namelist()) == wheel_names


def test_the_package_is_a_command():
    done = subprocess.run([sys.executable, "-m", "servobench", "--help"], capture_output=True, text=True, check=True)
    assert "compare" in done.stdout
