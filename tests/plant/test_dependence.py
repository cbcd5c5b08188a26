"""Declarations of the settings with which another one has an effect."""

from dataclasses import fields, is_dataclass, replace
from typing import Annotated, Literal

import pytest
from annotated_types import Gt

from servobench.controllers.methods import ESTIMATORS, LAWS
from servobench.harness.config import registry
from servobench.harness.run.tasks import TASKS
from servobench.plant.contract.dependence import Only, declared, reasons_for_no_effect
from servobench.plant.contract.settings import NonNegative, check_field, nested, settings


@settings
class Tool:
    """Settings of a tool."""

    frequency: NonNegative = 0.0
    damping: Annotated[NonNegative, Only(frequency=Gt(0.0))] = 0.02


@settings
class Camera:
    """Settings of a camera."""

    delay: Literal["ignored", "identified", "given"] = "ignored"
    filter: bool = False
    latency: Annotated[NonNegative, Only(delay="given")] = 0.0
    noise: Annotated[NonNegative, Only(delay=("identified", "given"), filter=True)] = 0.0
    margin: Annotated[NonNegative, Only(delay=("ignored", "identified", "given"))] = 0.0
    tool: Tool = nested(Tool)


@pytest.mark.parametrize(
    ("config", "key", "reasons"),
    [
        (Camera(), "latency", {"delay": "ignored"}),
        (Camera("identified"), "latency", {"delay": "identified"}),
        (Camera("given"), "latency", {}),
        (Camera(), "noise", {"delay": "ignored", "filter": False}),
        (Camera("identified"), "noise", {}),
        (Camera(filter=True), "noise", {}),
        (Camera(), "delay", {}),
        (Camera(), "tool", {}),
        (Camera(), "tool.size.width", {}),
        (Camera(), "tool.damping", {"tool.frequency": 0.0}),
        (Camera(tool=Tool(5.0)), "tool.damping", {}),
    ],
)
def test_a_setting_has_no_effect_without_any_of_those_that_it_needs(config, key, reasons):
    assert reasons_for_no_effect(config, key) == reasons


def test_a_declaration_is_a_sentence():
    assert str(declared(Camera, Only)["latency"]) == "Only with `delay` given."
    assert (
        str(declared(Camera, Only)["noise"])
        == "Only with `delay` identified or given, or `filter`."
    )
    assert (
        str(declared(Camera, Only)["margin"]) == "Only with `delay` ignored, identified or given."
    )
    assert str(declared(Tool, Only)["damping"]) == "Only with `frequency` above 0."


def test_a_class_without_settings_declares_nothing():
    assert declared(dict, Only) == {}
    assert reasons_for_no_effect(object(), "latency") == {}


def parts(config):
    yield config
    for item in fields(config):
        value = getattr(config, item.name)
        if is_dataclass(value):
            yield from parts(value)


def test_every_declaration_names_settings_beside_it_and_values_that_they_can_have():
    configs = [part.config() for part in (*ESTIMATORS.values(), *LAWS.values())]
    configs += [registry.find_controller(name).config() for name in registry.CONTROLLERS]
    configs += [registry.find_plant(name).config() for name in registry.PLANTS]
    configs += [task.default for task in TASKS.values()]
    declarations = {
        (type(part), name, only)
        for config in configs
        for part in parts(config)
        for name, only in declared(type(part), Only).items()
    }
    assert len(declarations) > 40
    for kind, name, only in declarations:
        for other, wanted in only.needed.items():
            values = wanted if isinstance(wanted, tuple) else (wanted,)
            for value in values:
                given = 1.1 * value.gt + 0.5 if isinstance(value, Gt) else value
                checked = check_field(other, kind, other, given)
                assert reasons_for_no_effect(replace(kind(), **{other: checked}), name) == {}
