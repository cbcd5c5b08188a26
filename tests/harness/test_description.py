"""The configuration file that `servobench init` writes."""

import re
import tomllib
from dataclasses import replace
from itertools import product

import numpy as np
import pytest

from kit.own import write
from servobench.controllers.aids import AidsConfig
from servobench.controllers.initial_jacobian import InitialConfig
from servobench.controllers.methods import ESTIMATORS, LAWS
from servobench.harness.config import registry
from servobench.harness.config.description import configuration_file, describe_settings
from servobench.harness.config.registry import controller_names
from servobench.harness.config.settings import Settings, flatten, read_settings
from servobench.harness.run.request import RunRequest, RunSettings
from servobench.harness.run.resolution import resolve_sections
from servobench.harness.run.tasks import TASKS
from servobench.plant.contract.faults import ConfigurationError

PLANTS = ("kinematic", "bullet", "mujoco", "fmu")


def sections(plants, controllers, tasks, *assignments, path=None):
    requests = [RunRequest(*each, "none", 0) for each in product(plants, controllers, tasks)]
    return resolve_sections(requests, read_settings(path, assignments), to_run=False)


def assert_same(found, wanted):
    assert found.keys() == wanted.keys()
    for name, config in wanted.items():
        np.testing.assert_equal(flatten(found[name]), flatten(config))


@pytest.mark.slow
def test_a_file_of_everything_reads_back_to_the_same_settings(tmp_path):
    names = PLANTS, (*controller_names(), "mfac+rls"), tuple(TASKS)
    wanted = sections(*names)
    path = write(
        tmp_path,
        configuration_file(wanted, wanted, dict.fromkeys(wanted, "about"), "run"),
        "all.toml",
    )
    assert_same(sections(*names, path=path), wanted)
    read = tomllib.loads(path.read_text(encoding="utf-8"))
    for name, config in wanted.items():
        for setting in describe_settings(config):
            section = read[name]
            for part in setting.group.split(".") * bool(setting.group):
                section = section[part]
            assert (setting.name in section) == (setting.value is not None)


def test_changed_settings_are_kept_and_their_defaults_told(output_of, tmp_path):
    path = tmp_path / "bench.toml"
    changes = ("kinematic.sensing.feature_noise=0.5", "ukf_mfac.law.step_weight=0.25")
    arguments = [word for change in changes for word in ("--set", change)]
    printed = output_of("init", path, "--plants", "kinematic", *arguments)
    assert printed.replace("\n", "") == f"{path}: run, kinematic, ukf_mfac, exp2"
    names = ("kinematic",), ("ukf_mfac",), ("exp2",)
    assert_same(sections(*names, path=path), sections(*names, *changes))
    lines = path.read_text(encoding="utf-8").splitlines()
    at = lines.index("feature_noise = 0.5")
    told = " ".join(line.removeprefix("# ") for line in lines[at - 2 : at])
    assert told.startswith("[m or px] standard deviation")
    assert told.endswith("(≥ 0; default 0.001)")
    assert max(map(len, (line for line in lines if line.startswith("#")))) <= 120


def test_a_file_of_settings_serves_commands_that_read_a_part_of_it(output_of, tmp_path):
    path = tmp_path / "bench.toml"
    output_of("init", path, "--plants", "all", "--controllers", "constant,mfac+rls")
    again = output_of(
        "init", "-", "--plants", "kinematic", "--controllers", "constant", "--config", path
    )
    assert list(tomllib.loads(again)) == ["run", "kinematic", "constant", "exp2"]
    output_of(
        "fmu", "export", "--controller", "constant", "-o", tmp_path / "loop.fmu", "--config", path
    )
    assert (tmp_path / "loop.fmu").exists()


def test_a_dash_prints_the_file(output_of, monkeypatch, tmp_path):
    monkeypatch.chdir(tmp_path)
    text = output_of("init", "-", "--plants", "kinematic", "--tasks", "waypoints")
    assert list(tomllib.loads(text)) == ["run", "kinematic", "ukf_mfac", "waypoints"]
    assert list(tmp_path.iterdir()) == []


def test_settings_of_a_plant_that_cannot_run_here_can_be_written(monkeypatch):
    missing = replace(registry.find_plant("bullet"), needs=("a_package_that_is_not_there",))
    monkeypatch.setattr(registry, "find_plant", lambda _: missing)
    assert "bullet" in sections(("bullet",), ("constant",), ("exp2",))
    with pytest.raises(
        ConfigurationError, match="plant 'bullet' needs a_package_that_is_not_there"
    ):
        resolve_sections([RunRequest("bullet", "constant", "exp2", "none", 0)], Settings())


BOUND = re.compile(r"(≥|>|≤|<) ([\d.e+-]+)")
BEYOND = {"≥": -1.0, ">": 0.0, "≤": 1.0, "<": 0.0}  # from a bound to a value that it rules out
CONFIGS = {name: entry.config() for name, entry in (*ESTIMATORS.items(), *LAWS.items())}
CONFIGS |= {name: registry.find_plant(name).config() for name in PLANTS}
CONFIGS |= {name: entry.default for name, entry in TASKS.items()}
CONFIGS |= {"aids": AidsConfig(), "initial": InitialConfig(), "run": RunSettings()}
CONFIGS |= {
    name: registry.find_controller(name).config() for name in ("rbfnn_mfac", "nmpc_calibrated")
}


def ruled_out(setting):
    """Yield values that the words of a setting do not allow."""
    for sign, number in BOUND.findall(setting.allowed):
        value = float(number) + BEYOND[sign]
        value = int(value) if "whole" in setting.allowed else value
        yield [value] * max(len(setting.value or ()), 1) if "each" in setting.allowed else value
    if setting.allowed.startswith('"'):
        yield "nonsense"


@pytest.mark.parametrize("name", CONFIGS)
def test_no_setting_takes_a_value_that_its_words_rule_out(name):
    for setting in describe_settings(CONFIGS[name]):
        for value in ruled_out(setting):
            values = value
            for part in reversed(setting.key.split(".")):
                values = {part: values}
            with pytest.raises(
                ConfigurationError, match=rf"{name}\.{setting.key}(\.\d+)* must be [^\n]*$"
            ):
                Settings({name: values}).resolve(name, CONFIGS[name])


def test_most_settings_have_a_bound():
    settings = [setting for config in CONFIGS.values() for setting in describe_settings(config)]
    assert (
        sum(any(True for _ in ruled_out(setting)) for setting in settings)
        > 0.7 * len(settings)
        > 250
    )
