"""Files and folders that may not be read or written: each is one right line, and nothing is left half written."""

import errno
import json
import os
import shutil
import sys

import pytest

from kit.command import PACKAGE, carried_out, servobench
from kit.folders import comparison
from kit.robots import calibration_text
from servobench.plant.robot.makers import UNIVERSAL_ROBOTS

FULL = (  # calls that write files, and the file that each names
    ("init bench2.toml", "bench2.toml"),
    ("new controller law", "law.py"),
    ("export results --out csv", "csv/runs.csv"),
    ("export results --out mcap --format mcap", "mcap/kinematic-"),
    ("shadow steps.csv --controller constant --out seen.csv", "seen.csv"),
)


def two_steps() -> str:
    """Return a log of two periods, as a user may have one."""
    joints = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
    columns = [f"{what}_{axis}_m" for what in ("feature", "reference") for axis in "xyz"]
    columns += [f"joint_position_{name}_rad" for name in joints]
    return (
        ",".join(["time_s", *columns])
        + "".join(f"\n{time}" + ",0.1" * len(columns) for time in (0, 0.05))
        + "\n"
    )


@pytest.mark.parametrize(("call", "file"), FULL)
def test_a_full_disk_is_one_line_with_the_file_and_leaves_none(
    call, file, tmp_path, monkeypatch, capsys
):
    def full(_path):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.chdir(tmp_path)
    comparison(tmp_path / "results", ("constant",), ("exp1",))
    (tmp_path / "steps.csv").write_text(two_steps())
    before = sorted(tmp_path.rglob("*"))
    monkeypatch.setattr("servobench.plant.contract.files.sync", full)
    assert servobench(monkeypatch, *call.split()) in (1, 2)
    error = capsys.readouterr().err
    assert file in error
    assert "No space left on device" in error
    assert error.count("\n") == 1
    assert sorted(tmp_path.rglob("*")) == before


RUN = "run --plant kinematic --controller constant --set exp2.duration=0.5 --out new"
LOCKED, HIDDEN = 0o500, 0  # modes of a folder that takes no file, and of what cannot be read
CASES = {  # call -> (what may not be used, its mode, words of the line)
    f"{RUN[:-3]}locked/new": ("locked", LOCKED, "results folder locked/new cannot be written: Permission denied"),
    "sweep --controllers constant --tasks exp2 --seeds 1 --out locked/new": (
        "locked", LOCKED, "results folder locked/new cannot be written: Permission denied"),
    "init locked/bench.toml": ("locked", LOCKED, "locked/bench.toml cannot be written: Permission denied"),
    "new controller law --folder locked": ("locked", LOCKED, "locked/law.py cannot be written: Permission denied"),
    "export results --out locked/csv": ("locked", LOCKED, "locked/csv cannot be written: Permission denied"),
    "report results --out locked/page.html": (
        "locked", LOCKED, "report locked/page.html cannot be written: Permission denied"),
    "record results --out locked/films": ("locked", LOCKED, "locked/films cannot be written: Permission denied"),
    "tune --trials 2 --controllers ukf_mfac --out locked/new": (
        "locked", LOCKED, "results folder locked/new cannot be written: Permission denied"),
    "shadow steps.csv --controller constant --out locked/seen.csv": (
        "locked", LOCKED, "locked/seen.csv cannot be written: Permission denied"),
    "analyse pid+true --out locked/loops": ("locked", LOCKED, "locked/loops cannot be written: Permission denied"),
    "fmu export -o locked/arm.fmu": ("locked", LOCKED, "locked/arm.fmu cannot be written: Permission denied"),
    f"{RUN} --config bench.toml": ("bench.toml", HIDDEN, "path 'bench.toml' is not readable"),
    f"{RUN} --controller ./law.py --no-isolate": ("law.py", HIDDEN, "./law.py cannot be read: Permission denied"),
    "run --plant fmu:arm.toml --mismatch none --task target --out new": (
        "arm.toml", HIDDEN, "mapping arm.toml cannot be read: Permission denied"),
    "fmu info arm.fmu": ("arm.fmu", HIDDEN, "file 'arm.fmu' is not readable"),
    f"{RUN} --robot arm.yaml": ("arm.yaml", HIDDEN, "calibration file arm.yaml cannot be read: Permission denied"),
    "run --plant kinematic --controller constant --task waypoints --set waypoints.file=way.csv --out new": (
        "way.csv", HIDDEN, "waypoint file way.csv cannot be read: Permission denied"),
    "statistics results": ("results/runs.parquet", HIDDEN, "results/runs.parquet cannot be read: Permission denied"),
    "export results --out new": (
        "results/steps.parquet", HIDDEN, "results/steps.parquet cannot be read: Permission denied"),
    "report results": ("results", HIDDEN, "path 'results' is not readable"),
    "collect results": ("results", LOCKED, "results folder results cannot be written: Permission denied"),
}  # fmt: skip
SCRIPT = """
import contextlib, io, json, os, sys
from servobench.harness.cli.main import main
told = {}
for call, (path, mode, _) in json.load(sys.stdin).items():
    before, usual = sorted(os.walk(".")), os.stat(path).st_mode
    sys.argv, error = ["servobench", *call.split()], io.StringIO()
    os.chmod(path, mode)
    try:
        with contextlib.redirect_stdout(io.StringIO()), contextlib.redirect_stderr(error):
            main()
    except SystemExit as stop:
        code = stop.code
    os.chmod(path, usual)
    told[call] = code, error.getvalue(), sorted(os.walk(".")) == before
print(json.dumps(told))
"""


@pytest.fixture(scope="module")
def told(tmp_path_factory):
    """What each call says, carried out by a user who may not read and write everywhere."""
    folder = tmp_path_factory.mktemp("permissions")
    comparison(folder / "results", ("constant",), ("exp1",))
    (folder / "locked").mkdir()
    for name in ("bench.toml", "law.py", "arm.toml", "arm.fmu", "way.csv"):
        (folder / name).write_text("")
    (folder / "arm.yaml").write_text(calibration_text(UNIVERSAL_ROBOTS["UR10e"], seed=1))
    (folder / "steps.csv").write_text(two_steps())
    without = ["setpriv", "--bounding-set=-all", "--inh-caps=-all"] if os.geteuid() == 0 else []
    own = os.environ | {"PYTHONPATH": str(PACKAGE)}
    made = carried_out(
        *without, sys.executable, "-c", SCRIPT, cwd=folder, input=json.dumps(CASES), env=own
    )
    return json.loads(made.stdout)


@pytest.mark.skipif(os.name != "posix", reason="modes of files are those of POSIX")
@pytest.mark.skipif(
    os.name == "posix" and os.geteuid() == 0 and shutil.which("setpriv") is None,
    reason="root may write everywhere",
)
@pytest.mark.parametrize("call", CASES)
def test_what_may_not_be_read_or_written_is_one_right_line(told, call):
    code, error, unchanged = told[call]
    assert code == 2, error
    assert error.startswith("servobench: ")
    assert error.count("\n") == 1
    assert CASES[call][2] in error
    assert unchanged
