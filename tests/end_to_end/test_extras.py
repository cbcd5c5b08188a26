"""The command line starts without heavy packages, works without extras, and names the extra that is missing."""

from __future__ import annotations

import subprocess
import sys

import pytest

from kit.folders import comparison
from servobench.harness.config.extras import EXTRAS

HEAVY = ("numpy", "scipy", "pandas", "matplotlib", "pydantic", "pybullet", "casadi", "fmpy", "cv2", *EXTRAS)
QUICK = ("run", "--plant", "kinematic", "--set", "exp2.duration=0.5", "--out", "out")


def servobench_without(blocked, arguments, folder, then="pass"):
    script = f"""
import sys
for name in {tuple(blocked)!r}:
    sys.modules[name] = None
sys.argv = ["servobench", *{tuple(arguments)!r}]
from servobench.harness.cli.main import main
try:
    main()
finally:
    {then}
"""
    command = [sys.executable, "-c", script]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, check=False)


@pytest.mark.parametrize("arguments", [("--help",), ("compare", "--help"), ("fmu", "--help"), ("record", "--help")])
def test_a_help_text_imports_nothing_heavy(tmp_path, arguments):
    modules = set(HEAVY) if len(arguments) == 1 else set(HEAVY) - {"pydantic"}  # with which typer reads options
    loaded = f"sys.stderr.write(' '.join(sorted(set(sys.modules) & {modules!r})))"
    done = servobench_without((), arguments, tmp_path, loaded)
    assert "Usage: servobench" in done.stdout
    assert done.stderr == ""


def test_without_any_extra_a_run_works_and_everything_can_be_listed(tmp_path):
    done = servobench_without(EXTRAS, (*QUICK, "--report"), tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "runs.parquet").is_file()
    assert "no report: the page needs " in done.stdout
    for listed in ("plants", "controllers", "tasks"):
        done = servobench_without(EXTRAS, (listed,), tmp_path)
        assert (done.returncode, done.stderr) == (0, "")
    assert "ukf_mfac" in servobench_without(EXTRAS, ("controllers",), tmp_path).stdout


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("jinja2", "report", ("report", "made")),
        ("plotly", "report", ("report", "made")),
        ("itables", "report", ("report", "made")),
        ("optuna", "tune", ("tune", "--trials", "1")),
        ("distributed", "cluster", ("sweep", "--out", "out", "--seeds", "1", "--scheduler", "tcp://127.0.0.1:9")),
        ("imageio_ffmpeg", "animation", ("record", "--plant", "kinematic", "--set", "circle.laps=1")),
    ],
)
def test_a_missing_extra_is_one_line_that_says_what_to_install(tmp_path, module, extra, arguments):
    comparison(tmp_path / "made", tasks=("exp1",))
    done = servobench_without((module,), arguments, tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("servobench: ")
    assert done.stderr.count("\n") == 1
    assert f" needs {module}: pip install 'servobench[{extra}]'" in done.stderr
