"""The tables of the named methods on the page of methods, as the registry has them."""

from __future__ import annotations

from typing import Any

from servobench.controllers.aids import EQUIPPED, AidsConfig
from servobench.controllers.methods import METHODS, PUBLISHED
from servobench.controllers.parts import ESTIMATORS, LAWS, Part
from servobench.harness.config import registry
from servobench.harness.config.settings import flatten

METHODS_HEADER = ("controller", "estimator", "law", "aids", "offline networks", "gets the truth")
PRESETS_HEADER = ("preset", "default")
SECTIONS = ("estimator", "law", "initial")


def methods_rows() -> list[tuple[str, ...]]:
    """Return a row for each method, as published in the row of its plain name, and one for what is no pair."""
    rows = []
    for name in registry.CONTROLLERS:
        entry = registry.find_controller(name)
        truth = "yes" if entry.needs_truth else "no"
        if name not in METHODS:
            rows.append((f"`{name}`", "–", "–", "–", "none", truth))
        elif not name.endswith(PUBLISHED):
            config = entry.config()
            estimator, law = part_of(config.estimator, ESTIMATORS), part_of(config.law, LAWS)
            called = f"`{name}`" + (f", `{name}{PUBLISHED}`" if name + PUBLISHED in METHODS else "")
            networks = trained(ESTIMATORS[estimator], LAWS[law])
            rows.append((called, f"`{estimator}`", f"`{law}`", aids_in_words(config.aids), networks, truth))
    return rows


def presets_rows() -> list[tuple[str, str, object]]:
    """Return controller, setting and value wherever a method differs from the defaults of its parts."""
    return [
        (name, f"{section}.{key}", value)
        for name in METHODS
        for section in SECTIONS
        for key, value in differences(getattr(registry.find_controller(name).config(), section)).items()
    ]


def differences(config: Any) -> dict[str, Any]:  # noqa: ANN401 - any settings
    """Return the settings that differ from the defaults of their class."""
    usual = flatten(type(config)())
    return {key: value for key, value in flatten(config).items() if value != usual[key]}


def part_of(config: Any, parts: dict[str, Part[Any]]) -> str:  # noqa: ANN401 - any settings
    """Return the name of the part that has these settings."""
    return next(name for name, part in parts.items() if part.config is type(config))


def trained(estimator: Part[Any], law: Part[Any]) -> str:
    """Return which offline networks a method starts from."""
    found = [word for word, part in (("Jacobian", estimator), ("controller", law)) if part.trained]
    return " and ".join(found) or "none"


def aids_in_words(aids: AidsConfig) -> str:
    """Return `none`, `all`, or all with what differs from all."""
    if not differences(aids):
        return "none"
    other = [key for key, value in EQUIPPED.items() if getattr(aids, key) != value]
    words = (f"`{key}` {getattr(aids, key)}".replace("False", "off") for key in other)
    return "all" + (f", but {', '.join(words)}" if other else "")
