"""The command line starts without heavy packages, works without extras, and names the extra that is missing."""

import json
from importlib.metadata import version

import pytest

from kit.command import python
from kit.folders import comparison
from kit.forked import servobench_without
from kit.plants import NEEDS_BULLET, NEEDS_MUJOCO
from servobench.harness.config import installation as extras
from servobench.harness.config import registry
from servobench.harness.config.installation import EXTRAS
from servobench.plant.contract.faults import ConfigurationError

HEAVY = (
    "numpy",
    "scipy",
    "pandas",
    "matplotlib",
    "pydantic",
    "pybullet",
    "casadi",
    "fmpy",
    "cv2",
    *EXTRAS,
)
# Together a fifth of a help page's time
SLOW = ("psutil", "multiprocessing", "importlib.metadata", "tomllib")
QUICK = ("run", "--plant", "kinematic", "--set", "exp2.duration=0.5", "--out", "out")


@pytest.mark.parametrize("arguments", [("--help",), ("compare", "--help")])
def test_a_help_text_imports_nothing_heavy(arguments):
    # With which typer reads options
    modules = {*HEAVY, *SLOW} if len(arguments) == 1 else set(HEAVY) - {"pydantic"}
    script = f"""
import sys
sys.argv = ["servobench", *{arguments!r}]
from servobench.harness.cli.main import main
try:
    main()
finally:
    sys.stderr.write(' '.join(sorted(set(sys.modules) & {modules!r})))
"""
    done = python("-c", script)
    assert "Usage: servobench" in done.stdout
    assert done.stderr == ""


def test_lists_load_no_tables_pictures_or_engines():
    unused = {"scipy", "casadi", "pandas", "matplotlib", "pybullet", "mujoco", "cv2"}
    script = f"""
import sys
from servobench.harness.cli.main import main
for listed in ("controllers", "plants", "tasks"):
    sys.argv = ["servobench", listed]
    try:
        main()
    except SystemExit as end:
        assert not end.code
sys.stderr.write(' '.join(sorted(set(sys.modules) & {unused!r})))
"""
    done = python("-c", script)
    assert "ukf_mfac" in done.stdout
    assert done.stderr == ""


def test_a_run_loads_the_law_and_the_estimator_of_its_method_alone(tmp_path):
    script = f"""
import sys
out = {str(tmp_path / "out")!r}
sys.argv = ["servobench", "run", "regression_mfac", "--plant", "kinematic", "--no-figures", "--out", out]
from servobench.harness.cli.main import main
try:
    main()
except SystemExit as end:
    assert not end.code
parts = ("servobench.controllers.laws.", "servobench.controllers.estimators.")
sys.stderr.write(' '.join(sorted(name for name in sys.modules if name.startswith(parts))))
"""
    used = {
        name.removeprefix("servobench.controllers.") for name in python("-c", script).stderr.split()
    }
    # The pseudo-inverse is that of the fingerprint's run.
    wanted = {"estimators.constant", "estimators.estimator", "laws.law", "laws.mfac", "laws.pid"}
    assert used == wanted


def test_without_any_extra_a_run_works_and_everything_can_be_listed(tmp_path):
    done = servobench_without(EXTRAS, (*QUICK, "--report"), tmp_path)
    assert (done.returncode, done.stderr) == (0, "")
    assert (tmp_path / "out" / "runs.parquet").is_file()
    assert "no report: the page needs " in done.stdout
    for listed, name in (("plants", "kinematic"), ("controllers", "ukf_mfac"), ("tasks", "exp1")):
        done = servobench_without(EXTRAS, (listed,), tmp_path)
        assert (done.returncode, done.stderr, name in done.stdout) == (0, "", True)


@pytest.mark.parametrize(
    ("module", "extra", "arguments"),
    [
        ("jinja2", "report", ("report", "made")),
        ("optuna", "tune", ("tune", "--trials", "1")),
        ("viser", "play", ("play",)),
        (
            "distributed",
            "cluster",
            ("sweep", "--out", "out", "--seeds", "1", "--scheduler", "tcp://127.0.0.1:9"),
        ),
        ("onnxruntime", "onnx", ("run", "--plant", "kinematic", "--controller", "x.onnx")),
        ("pybullet", "bullet", ("run", "--plant", "bullet")),
        ("mujoco", "mujoco", ("run", "--plant", "mujoco")),
    ],
)
def test_a_missing_extra_is_one_line_that_says_what_to_install(tmp_path, module, extra, arguments):
    comparison(tmp_path / "made", tasks=("exp1",))
    done = servobench_without((module,), arguments, tmp_path)
    assert done.returncode == 2
    assert done.stderr.startswith("servobench: ")
    assert done.stderr.count("\n") == 1
    assert f" needs {module}: pip install 'servobench[{extra}]'" in done.stderr


def test_without_an_engine_no_film_is_made_and_a_line_says_what_to_install(tmp_path):
    without = ("pybullet", "mujoco")
    words = ("run", "--plant", "kinematic", "--set", "exp2.duration=0.5", "--out", "made")
    assert servobench_without(without, words, tmp_path).returncode == 0
    done = servobench_without(without, ("record", "made"), tmp_path)
    extra, module = ("mujoco", "mujoco") if extras.has_no_wheel() else ("bullet", "pybullet")
    assert done.returncode == 2
    assert not (tmp_path / "made" / "recordings").exists()
    assert done.stderr.startswith(
        f"servobench: plant '{extra}' needs {module}: pip install 'servobench[{extra}]'"
    )
    assert done.stderr.count("\n") == 1


def test_without_an_engine_a_run_that_names_no_plant_is_kinematic_and_says_why(tmp_path):
    done = servobench_without(
        ("pybullet", "mujoco"), ("run", "--set", "exp2.duration=0.5", "--out", "out"), tmp_path
    )
    assert (done.returncode, done.stderr) == (0, "")
    told, *_, folder = done.stdout.splitlines()
    wanted = ("mujoco", "mujoco") if extras.has_no_wheel() else ("bullet", "pybullet")
    assert told.startswith(
        "no plant is named, so this run is on kinematic: plant '{}' needs {}: ".format(*wanted)
    )
    assert folder.endswith(" in out")
    assert json.loads((tmp_path / "out" / "manifest.json").read_text())["engines"] == {}
    listed = servobench_without(("pybullet",), ("plants",), tmp_path).stdout
    assert "'servobench[bullet]'" in listed


@NEEDS_MUJOCO
def test_without_pybullet_mujoco_is_the_rendered_plant(monkeypatch):
    monkeypatch.setattr(
        registry, "check_installed", lambda needs, what: needs == ("pybullet",) and refuse(what)
    )
    line = "" if extras.has_no_wheel() else "plant 'bullet' needs what is not here"
    assert registry.default_plant() == ("mujoco", line)


def refuse(what):
    raise ConfigurationError(f"{what} needs what is not here")


@NEEDS_MUJOCO
@pytest.mark.parametrize(
    ("word", "reason"),
    [
        ("off", "MuJoCo cannot render through off"),
        ("nonsense", "MuJoCo cannot be loaded: invalid value for environment"),
    ],
)
def test_a_machine_that_cannot_render_is_told_what_to_install(tmp_path, word, reason):
    done = servobench_without((), ("run", "--plant", "mujoco"), tmp_path, MUJOCO_GL=word)
    assert done.returncode == 2
    assert done.stderr.startswith(f"servobench: plant 'mujoco' cannot run here: {reason}")
    assert done.stderr.count("\n") == 1
    assert list(tmp_path.iterdir()) == []


@NEEDS_BULLET
def test_a_line_and_the_manifest_name_the_engine_that_renders(tmp_path):
    done = servobench_without(
        (), ("run", "--plant", "bullet", "--set", "exp2.duration=0.1", "--out", "out"), tmp_path
    )
    engine = json.loads((tmp_path / "out" / "manifest.json").read_text())["engines"]["bullet"]
    assert engine.startswith(f"PyBullet {version('pybullet')}, software renderer TinyRenderer")
    assert f"bullet: {engine}\n" in done.stdout


@pytest.mark.parametrize(
    ("running", "compiled"), [((3, 11, 7), False), ((3, 12, 0), True), ((3, 13, 1), True)]
)
def test_where_pybullet_has_no_wheel_the_line_says_that_it_is_compiled(
    monkeypatch, running, compiled
):
    monkeypatch.setattr(extras.sys, "version_info", running)
    line = extras.missing_extra(ModuleNotFoundError("No module", name="pybullet"), "a film")
    assert line.startswith("a film needs pybullet: pip install 'servobench[bullet]'")
    assert ("C++ compiler" in line) == compiled
    assert (f"Python 3.{running[1]}" in line) == compiled
