"""The C sources of exported FMUs, of a plant and of a controller: in clang-tidy's eyes, and under the sanitizers."""

import shutil
from pathlib import Path

import pytest

from kit.command import carried_out
from kit.controller_fmus import recorded
from night.random_calls import arm, build, can_sanitize, controller, run
from servobench.fmus.export import ExportOptions, product

CONFIGURATION = Path(__file__).parents[2] / ".clang-tidy"
CASADI = "-bugprone-macro-parentheses,-clang-analyzer-*"
"""What generated code is spared: a rule that CasADi's macros break, and the paths through 8,000 lines without one."""
ALL = ""  # files
PRODUCTS = {
    "plant": lambda version: product(ExportOptions(version)),
    "controller": lambda version: recorded("ukf_mfac").product(version),
}

NEEDS_TIDY = pytest.mark.skipif(shutil.which("clang-tidy") is None, reason="needs clang-tidy")
CALLS = 20_000


@NEEDS_TIDY
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


@NEEDS_TIDY
def test_a_defect_is_found(tmp_path):
    exported = PRODUCTS["plant"](2)
    write(exported, tmp_path)
    file = tmp_path / "sources" / "instance.c"
    text = file.read_text()
    assert text.count("free(snapshot);") == 1
    file.write_text(text.replace("free(snapshot);", ""))
    assert "clang-analyzer-unix.Malloc" in tidy(file).stdout


def write(exported, folder):
    (folder / "sources").mkdir()
    for name, text in exported.sources().items():
        (folder / name).write_text(text)


def tidy(file, *, generated=False):
    checks = [f"--checks={CASADI}"] if generated else []
    return carried_out(
        "clang-tidy", "--quiet", f"--config-file={CONFIGURATION}", *checks, file, "--", "-std=c11"
    )


NEEDS_SANITIZERS = pytest.mark.skipif(
    not can_sanitize(), reason="needs a C compiler with sanitizers"
)


@NEEDS_SANITIZERS
@pytest.mark.parametrize("kind", [arm, controller])
@pytest.mark.parametrize("version", [2, 3])
def test_random_calls_touch_no_memory_but_their_own(version, kind, tmp_path):
    """Ten million calls in any order are made by `make nightly`: benchmarks/night/random_calls."""
    made, refused = run(build(tmp_path, kind(version)), CALLS, seed=1)
    assert made == CALLS
    assert 0.2 * CALLS < refused < 0.9 * CALLS  # both good and bad calls are among them


@NEEDS_SANITIZERS
def test_a_missing_check_is_found(tmp_path):
    program = build(tmp_path, controller(3), defect="k > variables.n_values")
    with pytest.raises(AssertionError, match="AddressSanitizer|runtime error"):
        run(program, CALLS, seed=1)
