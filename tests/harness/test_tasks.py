"""Tasks of users: a file, a module or a published entry point brings one, and each refusal is one line."""

import json
import re
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

import servobench
from kit.command import judged
from kit.command import servobench as command
from kit.documents import blocks
from kit.own import CELL, WHOLE, install, write
from kit.resting import Resting
from servobench.harness.config import registry
from servobench.harness.config.registry import offering
from servobench.harness.config.settings import Settings
from servobench.harness.run.rehearsal import build_once
from servobench.harness.run.request import RunRequest
from servobench.harness.run.resolution import resolve
from servobench.harness.run.tasks import TASKS, choose_task, find_task
from servobench.plant.contract.faults import ConfigurationError

PAGE = Path(__file__).parents[2] / "docs" / "tasks.md"
(SPIRAL,) = (
    block for block in blocks(PAGE.read_text(encoding="utf-8"), "python") if "class Spiral" in block
)
pytestmark = pytest.mark.usefixtures("own_folder")
ENDS = """from servobench.harness.run.references import FixedPoint
class Ends(FixedPoint):
    def at(self, time):
        return np.where(np.asarray(time)[..., None] < 1.04, super().at(time), np.nan)
class Short(FixedPoint):
    def at(self, time):
        return super().at(time)[: 29 if np.size(time) == 30 else None]
"""
WRONG = "from servobench import TaskEntry\nENTRY = TaskEntry('wrong', 'a number', 3)"


def test_a_task_of_a_file_is_carried_out_with_its_settings_and_recorded(tmp_path):
    write(tmp_path, SPIRAL, "spiral.py")
    run = servobench.run(
        "ukf_mfac", task="./spiral.py", seed=1, settings={"Spiral": {"duration": 2.0}}
    )
    assert (run.row["task"], run.row["status"], run.row["periods"]) == ("Spiral", "completed", 40)
    assert run.row["run_id"] == "kinematic-ukf_mfac-Spiral-moderate-1"
    reached = run.steps.filter(regex="^reference_").to_numpy()[-1]
    np.testing.assert_allclose(np.hypot(*reached[:2]), 0.1, rtol=0.05)


@pytest.mark.slow
def test_workers_carry_out_the_same_runs_of_users_code_and_the_manifest_names_it(tmp_path):
    for name, text in {"a/cell.py": CELL, "b/mine.py": WHOLE, "c/spiral.py": SPIRAL}.items():
        write(tmp_path, text, name)
    asked = ["b/mine.py", Resting], ["a/cell.py", "kinematic"], ["c/spiral.py", "exp1"]
    settings = {"exp1": {"duration": 0.5}, "Spiral": {"duration": 0.5}}
    tables = [
        servobench.compare(*asked, seeds=2, settings=settings, workers=n, out=str(n))
        for n in (1, 2)
    ]
    pd.testing.assert_frame_equal(*map(judged, tables), check_exact=True)
    assert set(tables[0]["status"]) == {"completed"}
    assert (tables[0]["control_effort_rad"] == 0.0).all()
    manifest = json.loads((tmp_path / "2" / "manifest.json").read_text())
    own = {name: record["place"] for kind in ("controllers", "plants", "tasks")
           for name, record in manifest[f"own_{kind}"].items()}  # fmt: skip
    assert own == {
        "Mine": "b/mine.py",
        "Resting": "Resting",
        "Cell": "a/cell.py",
        "Spiral": "c/spiral.py",
    }
    assert "c/spiral.py" in " ".join(manifest["files"])


def test_the_command_line_takes_a_task_of_a_file_and_shows_its_settings(
    output_of, no_figures, tmp_path, monkeypatch
):
    write(tmp_path, SPIRAL, "spiral.py")
    assert "Spiral.radius = 0.1" in output_of("tasks", "./spiral.py")
    options = (
        "--plants",
        "kinematic",
        "--controllers",
        "constant",
        "--tasks",
        "round=./spiral.py",
        "--out",
        "runs",
    )
    options += ("--workers", "1", "--no-report")
    assert command(monkeypatch, "compare", *options, "--set", "round.radius=0.2") == 0
    assert servobench.load("runs").runs["task"].unique().tolist() == ["round"]


def test_a_task_fits_itself_to_another_robot(tmp_path):
    write(tmp_path, SPIRAL, "spiral.py")
    run = servobench.run("constant", task="./spiral.py", robot="ur3e", mismatch="none")
    assert run.row["status"] == "completed"
    assert run.steps.filter(regex="^reference_x").to_numpy().max() < 0.09


@pytest.mark.parametrize(
    ("text", "place", "words"),
    [
        (SPIRAL, "./spirals.py", "there is no file ./spirals.py: did you mean 'spiral.py'?"),
        ("x = 1", "./spiral.py", "./spiral.py defines no task: no subclass of servobench.Task and no ENTRY"),
        (SPIRAL.replace("radius: float = 0.1", "radius: float"), "./spiral.py", "of Spiral needs a default; radius"),
        (SPIRAL.replace("def scenario", "def scenery"), "./spiral.py", "class Spiral lacks scenario, which it must"),
        (SPIRAL, "circle=./spiral.py", "a task called 'circle' exists already; give yours another name"),
        (SPIRAL, "kinematic=./spiral.py", "a plant called 'kinematic' exists already"),
        (SPIRAL, "./spiral.py:Helix", "./spiral.py has no 'Helix'"),
        (WRONG, "./spiral.py", "the settings of a task must be a dataclass below Task, got int"),
        (SPIRAL, "spiral", "did you mean your file './spiral.py'?"),
        (SPIRAL, "exp9", "unknown task 'exp9'"),
    ],
    ids=range(10),
)  # fmt: skip
def test_a_task_that_cannot_be_used_is_refused_in_a_line(tmp_path, text, place, words):
    write(tmp_path, text, "spiral.py")
    with offering(), pytest.raises(ConfigurationError, match=re.escape(words)) as refused:
        choose_task(place)
    assert "\n" not in str(refused.value)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        (("return Scenario", "Scenario"), "its method scenario must return a servobench.Scenario, got None"),
        (("radius * np.sin(angle)", "np.nan * angle"), "its reference must be 3 finite features at 12 .*, got .*nan"),
        (("curve = setting.followed(", "curve = FixedPoint(np.zeros(2)) or ("),
         r"its .* 3 finite features .*got shape \(12, 2\)"),
        (("self.duration / 2)", "self.duration - 0.01)"), ".*begins at 0.99 s, after the last .* at 0.95 s"),
        (("self.duration / 2)", "self.duration / 2, 'point')"), "kind must be one of .*, got 'point'"),
        (("self.radius * times", "np.random.random() * times"), "its scenario differs from one call to the next"),
        (("        times =", "        type(self).once = 1 / (not hasattr(self, 'once'))\n        times ="),
         "its scenario differs from one call to the next: division by zero"),
    ],
)  # fmt: skip
def test_a_task_that_returns_something_else_is_refused_in_a_line(tmp_path, change, words):
    write(tmp_path, ENDS + SPIRAL.replace(*change), "spiral.py")
    with pytest.raises(ConfigurationError, match=f"^task Spiral: {words}"):
        servobench.run("constant", task="./spiral.py")


@pytest.mark.parametrize(
    ("reference", "words"),
    [
        ("Ends", r"the reference of the task must be finite .*got \[nan, nan, nan\] at 1.05 s"),
        ("Short", r"the task's reference needs a row for each of 30 times, got \(29, 3\)"),
    ],
)
def test_a_reference_without_numbers_beyond_its_end_is_no_fault_of_the_controller(
    tmp_path, reference, words
):
    write(
        tmp_path,
        ENDS + SPIRAL.replace("Waypoints(times, points)", f"{reference}(np.zeros(3))"),
        "spiral.py",
    )
    assert re.search(words, servobench.run("constant", task="./spiral.py").row["reason"])
    request = RunRequest("kinematic", "constant", choose_task("./spiral.py"), "moderate", 0)
    with pytest.raises(ConfigurationError, match=f"task Spiral: {words}"), offering():
        build_once(resolve(request, Settings()))


def test_a_task_that_fails_to_make_its_scenario_is_refused_with_its_reason(tmp_path):
    broken = SPIRAL.replace(
        "        times =", '        raise ValueError("the spiral is too tight")\n        times ='
    )
    write(tmp_path, broken, "spiral.py")
    with pytest.raises(ConfigurationError, match="task Spiral: the spiral is too tight"):
        servobench.run("constant", task="./spiral.py")


def test_a_published_task_is_found_by_its_name(tmp_path, monkeypatch):
    points = "[servobench.tasks]\nspiral = spirals:Spiral\ncircle = spirals:Spiral\nlost = spirals:Lost\n"
    monkeypatch.syspath_prepend(install(tmp_path, "spirals", SPIRAL, points))
    for function in (registry._published, registry._points, registry._load):
        function.cache_clear()
    try:
        assert find_task("spiral").summary == "A spiral from the middle of the image outwards."
        assert find_task("circle") is TASKS["circle"]
        with pytest.raises(
            ConfigurationError, match=r"task 'lost' \(spirals:Lost\) cannot be loaded"
        ):
            find_task("lost")
        run = servobench.run("constant", task="spiral")
        assert run.row["status"] == "completed"
    finally:
        monkeypatch.undo()
        for function in (registry._published, registry._points, registry._load):
            function.cache_clear()
