"""The C sources of exported FMUs, those of a plant and of a controller, as clang-tidy sees them with `.clang-tidy`."""

from __future__ import annotations

import shutil
import subprocess
from pathlib import Path

import pytest

from kit.controller_fmus import recorded
from servobench.fmus.export import ExportOptions, product

CONFIGURATION = Path(__file__).parents[2] / ".clang-tidy"
CASADI = "-bugprone-macro-parentheses,-clang-analyzer-*"
"""What generated code is spared: a rule that CasADi's macros break, and the paths through 8,000 lines without one."""
ALL = ""  # files
PRODUCTS = {
    "plant": lambda version: product(ExportOptions(version)),
    "controller": lambda version: recorded("ukf_mfac").product(version),
}

pytestmark = pytest.mark.skipif(shutil.which("clang-tidy") is None, reason="needs clang-tidy")


@pytest.mark.parametrize(
    ("what", "version", "begin"), [("plant", 2, ALL), ("plant", 3, "fmi3"), ("controller", 3, ALL)]
)
def test_the_sources_of_an_exported_fmu_are_clean(what, version, begin, tmp_path):
    exported = PRODUCTS[what](version)
    write(exported, tmp_path)
    for name in exported.description.sources:
        if name.startswith(begin):
            found = tidy(tmp_path / "sources" / name, generated=name == f"{exported.core}.c")
            assert found.returncode == 0, found.stdout


def test_a_defect_is_found(tmp_path):
    exported = PRODUCTS["plant"](2)
    write(exported, tmp_path)
    file = tmp_path / "sources" / "fmi2.c"
    text = file.read_text()
    assert text.count("free(copy);") == 1
    file.write_text(text.replace("free(copy);", ""))
    assert "clang-analyzer-unix.Malloc" in tidy(file).stdout


def write(exported, folder):
    (folder / "sources").mkdir()
    for name, text in exported.sources().items():
        (folder / name).write_text(text)


def tidy(file, *, generated=False):
    checks = [f"--checks={CASADI}"] if generated else []
    command = ["clang-tidy", "--quiet", f"--config-file={CONFIGURATION}", *checks, str(file), "--", "-std=c11"]
    return subprocess.run(command, capture_output=True, text=True, check=False)
