"""The tables of the documentation say what the code does: settings, columns, diagnostics, statuses, profiles, keys."""

import ast
import dataclasses
import math
import re
import tomllib
from pathlib import Path

import pytest

import generated_tables
from kit.documents import names, read, section, tables
from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.initial_jacobian import InitialConfig
from servobench.controllers.methods import ESTIMATORS, LAWS
from servobench.controllers.networks.config import TrainingConfig
from servobench.harness.config import registry
from servobench.harness.config.settings import flatten, read_settings
from servobench.harness.run.episode import run_experiment
from servobench.harness.run.metrics import METRICS
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.result import (
    COMPLETED,
    CRASHED,
    NUMERICAL_ERROR,
    OUT_OF_MEMORY,
    TIMED_OUT,
)
from servobench.harness.run.tasks import TASKS
from servobench.plant.contract.faults import RunFault
from servobench.plant.contract.sensing import SensingConfig
from servobench.plant.fmu.mapping import FmuMapping
from servobench.plant.fmu.world import FmuConfig
from servobench.plant.robot.mechanics import MechanicsConfig
from servobench.plant.robot.mismatch import AXES, PROFILES, Mismatch

PACKAGE = "servobench"


def config_classes():
    """Every class of settings that a user can reach; settings of nested sections are in the table of the outer one."""
    parts = [entry.config for entry in (*ESTIMATORS.values(), *LAWS.values())]
    plants = [registry.find_plant(name).config for name in registry.PLANTS]
    bounds = [registry.find_controller(name).config for name in ("nmpc_calibrated", "revealed")]
    whole = [*plants, FmuConfig, *bounds]
    tasks = [type(entry.default) for entry in TASKS.values()]
    common = [
        AidsConfig,
        InitialConfig,
        TrainingConfig,
        RunSettings,
        SensingConfig,
        MechanicsConfig,
    ]
    return {kind for kind in (*parts, *whole, *tasks, *common) if dataclasses.fields(kind)}


def test_all_settings_have_a_table_and_nothing_else_has():
    text = "".join(page.read_text(encoding="utf-8") for page in generated_tables.PAGES)
    parts = [
        places for _, kind, places, *_ in generated_tables.PART.findall(text) if kind == "settings"
    ]
    shown = [kind for places in parts for kind in generated_tables.labelled(places).values()]
    assert sorted(map(repr, shown)) == sorted(map(repr, config_classes()))


def test_a_section_with_a_table_of_its_own_is_not_printed_again():
    shown = generated_tables.settings_table({"bullet": registry.find_plant("bullet").config})
    assert "`sensing.latency` [s] | 0.05" in shown  # which differs from the default of the section
    assert "sensing.noise_share" not in shown


def test_a_setting_that_several_classes_share_stands_once_and_names_those_with_it():
    laws = {name: LAWS[name].config for name in ("mfac", "pid")}
    shown = generated_tables.settings_table(
        {"one": laws["mfac"], "two": laws["mfac"], "three": laws["pid"]}
    )
    assert shown.count("| `gain` [1/s] of all but `three` | ") == 1
    assert shown.count("| `three.proportional_gain` [1/s] | ") == 1
    both = generated_tables.settings_table({"a": laws["pid"], "b": laws["pid"]})
    assert len(both.splitlines()) == 2 + 5


@pytest.mark.parametrize("page", generated_tables.PAGES, ids=lambda page: page.name)
def test_the_generated_parts_of_a_page_are_up_to_date(page):
    assert generated_tables.renewed(page) == page.read_text(encoding="utf-8"), "run make tables"


def test_the_presets_differ_from_their_parts_only_where_it_is_told():
    rows = next(rows for _, header, rows in tables(read("methods.md")) if header[0] == "preset")
    told = {names(name)[0]: tomllib.loads(f"value = {value}")["value"] for name, value in rows}
    found = {}
    for name in registry.CONTROLLERS:
        for part in dataclasses.fields(config := registry.find_controller(name).config()):
            value = getattr(config, part.name)
            if dataclasses.is_dataclass(value) and part.name != "aids":
                usual = flatten(type(value)())
                changed = {key: new for key, new in flatten(value).items() if new != usual[key]}
                found |= {f"{name}.{part.name}.{key}": new for key, new in changed.items()}
    assert told == found


def told_aids(cell):
    """The aids that a cell of the table of controllers means."""
    if cell == "none":
        return {}
    assert cell.startswith("all")
    other = dict(re.findall(r"`(\w+)` ([\w.]+)", cell))
    switched = {key: False if value == "off" else value for key, value in other.items()}
    numbers = {key: float(value) for key, value in other.items() if "." in value}
    return {**EQUIPPED, **switched, **numbers}


def test_the_table_of_controllers_has_their_parts_and_aids():
    rows = next(
        rows
        for _, header, rows in tables(read("methods.md"))
        if header[:2] == ["controller", "estimator"]
    )
    assert sorted(name for row in rows for name in names(row[0])) == sorted(registry.CONTROLLERS)
    for controllers, estimator, law, aids, networks, truth in rows:
        for name in names(controllers):
            entry = registry.find_controller(name)
            assert entry.needs_truth == (truth == "yes")
            if not names(estimator):
                continue
            config = entry.config()
            assert type(config.estimator) is ESTIMATORS[names(estimator)[0]].config
            assert type(config.law) is LAWS[names(law)[0]].config
            assert config.aids == AidsConfig(
                **({} if name.endswith(":published") else told_aids(aids))
            )
            assert hasattr(config, "training") == (networks != "none")


@pytest.fixture(scope="module")
def short_runs():
    """A short run of each estimator, each law, the aids, and what is no pair."""
    pairs = [f"pid+{name}" for name in ESTIMATORS] + [f"{name}+constant" for name in LAWS]
    controllers = [*pairs, "calibrating_mfac", "nmpc_calibrated"]
    chosen = ["exp2.duration=0.2", "run.full_jacobian=true", "kinematic.sensing.stamps=true"]
    settings = read_settings(None, chosen)
    return [
        run_experiment(RunRequest("kinematic", controller, "exp2", "moderate", 0), settings)
        for controller in controllers
    ]


def test_every_diagnostic_is_told_and_exists(short_runs):
    found = {
        column for run in short_runs for column in run.steps if column.startswith("diagnostic_")
    }
    rows = tables(section(read("settings.md"), "Diagnostics"))[0][2]
    assert {f"diagnostic_{name}" for row in rows for name in names(row[0])} == found


def test_every_column_of_runs_is_told_in_order(short_runs):
    page = section(read("results.md"), "`runs.parquet`: a row a run")
    told = [
        name
        for _, header, rows in tables(page)
        if header[0] == "column"
        for row in rows
        for name in names(row[0])
    ]
    only_by_pose = [name for name, metric in METRICS.items() if metric.values is None]
    only_of_a_kind = [name for name, metric in METRICS.items() if metric.kind is not None]
    varied = [name for name in told if "." in name]  # settings of a sweep, by their keys
    assert [name for name in told if name not in (*only_by_pose, *only_of_a_kind, *varied)] == list(
        short_runs[0].row
    )


def test_every_column_of_steps_is_told_and_every_told_column_exists(short_runs):
    rows = tables(section(read("results.md"), "`steps.parquet`: a row a period"))[0][2]
    places = {
        "feature": "[xyz]",
        "unit": "m",
        "joint": "(?:shoulder|elbow|wrist)[a-z_0-9]*",
        "name": r"\w+",
    }
    patterns = [
        re.sub(r"<(\w+)>", lambda match: places[match[1]], names(row[0])[0]) for row in rows
    ]
    for run in short_runs:
        for column in run.steps:
            assert sum(bool(re.fullmatch(pattern, column)) for pattern in patterns) == 1, column
    for pattern in patterns:
        assert any(re.fullmatch(pattern, column) for column in short_runs[0].steps), pattern


def test_every_status_is_told_and_can_occur():
    rows = next(rows for _, header, rows in tables(read("results.md")) if header[0] == "status")

    def faults(kind):
        own = {kind.status} if kind.__module__.split(".")[0] == PACKAGE else set()
        return own.union(*(faults(child) for child in kind.__subclasses__()))

    assert {names(row[0])[0] for row in rows} == faults(RunFault) | {
        COMPLETED, NUMERICAL_ERROR, CRASHED, TIMED_OUT, OUT_OF_MEMORY,
    }  # fmt: skip


def test_the_profiles_have_the_magnitudes_of_the_code():
    rows = next(rows for _, header, rows in tables(read("mismatch.md")) if header[0] == "profile")
    assert {names(row[0])[0] for row in rows} == set(PROFILES)
    for name, *cells in rows:
        links, offset, camera, tool, gear = (float(cell.split()[0].rstrip("°")) for cell in cells)
        profile = Mismatch(names(name)[0])
        told = (links / 100, math.radians(offset), math.radians(camera), tool / 1000, gear / 100)
        axes = ("links", "joint_offsets", "camera_rotation", "tool", "gear_ratio")
        assert told == pytest.approx(tuple(profile.size(axis) for axis in axes))


def test_the_axes_are_those_of_the_code_and_their_examples_are_understood():
    found = [*tables(read("mismatch.md")), *tables(read("sensor.md"))]
    axes = [names(row[1])[0] for _, header, rows in found if header[0] == "axis" for row in rows]
    words = [
        names(row[0])[0]
        for _, header, rows in found
        if header[0] == "word"
        for row in rows
        if names(row[0])
    ]
    assert {example.partition("=")[0] for example in (*axes, *words)} == set(AXES)
    for example in (*axes, *words):
        assert Mismatch.parse(example).size(example.partition("=")[0]) > 0.0


def test_the_keys_of_a_mapping_are_those_of_the_code():
    rows = next(rows for _, header, rows in tables(read("fmu.md")) if header[0] == "key")
    mapping = FmuMapping(Path("crane.fmu"), ("push",), ("place",))
    wanted = set()
    for key in vars(mapping).keys() - {"parameters", "nominal"}:
        part = getattr(mapping, key)
        wanted |= (
            {f"{key}.{name}" for name in vars(part)} if dataclasses.is_dataclass(part) else {key}
        )
    assert {name for row in rows for name in names(row[0])} == wanted


def test_an_attribute_without_a_line_in_its_docstring_is_refused():
    @dataclasses.dataclass
    class Given:
        """A thing.

        Attributes:
            size: (n,), m,
                in two lines.
        """

        size: float

        @property
        def half(self):
            """Half of it."""

    assert generated_tables.attributes(Given) == {
        "size": "(n,), m, in two lines",
        "half": "half of it",
    }
    Given.__doc__ = "A thing."
    with pytest.raises(ValueError, match="Given has no line on size below Attributes:"):
        generated_tables.attributes(Given)


def test_signatures_are_python():
    text = generated_tables.interface(
        ["servobench.run", "servobench.Controller(*)", "servobench.PlantSetup"]
    )
    function, kind, setup = re.findall(r"```python\n(.*?)\n```", text, re.DOTALL)
    (parsed,) = ast.parse(function).body
    assert [each.arg for each in parsed.args.args] == ["controller", "plant"]
    (parsed,) = ast.parse(kind).body
    assert [each.name for each in parsed.body if isinstance(each, ast.FunctionDef)][:2] == [
        "reset",
        "step",
    ]
    (parsed,) = ast.parse(setup).body
    assert [each.target.id for each in parsed.body[1:]] == ["model", "start", "period", "nominal"]
